"""The axis of time that charts, tables and replays of several runs and recordings share."""

import numpy as np

PAUSE = 20.0
"""A step of time longer than this many usual steps is a pause, across which no line is drawn."""


def continued(t_s: np.ndarray) -> np.ndarray:
    """(S,) s since the first row, never decreasing, of times (S,) s of runs one after another.

    Pauses between runs stay. A run or a recording whose time starts again continues one usual step
    after the one before, so that one recording that starts at 0 keeps its own times.
    """
    steps = np.diff(t_s)
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    steps = np.where(steps < 0.0, usual, steps)
    return np.concatenate(([0.0], np.cumsum(steps)))


def pauses(time_s: np.ndarray) -> np.ndarray:
    """(P,) rows of times (S,) s after which there is a pause."""
    steps = np.diff(time_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return np.flatnonzero(steps > PAUSE * max(usual, 1e-9))


def with_gaps(time_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and values (S,) with a NaN in each pause, so that a plotted line ends there."""
    after = pauses(time_s) + 1
    return np.insert(time_s, after, time_s[after - 1]), np.insert(
        np.asarray(values, float), after, np.nan
    )
