"""The clock of a recording: usual time between rows, wrong units of time, gaps inside runs."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from surgisoft.measurement.recordings.recording import Recording

POSSIBLE_S = (1e-4, 10.0)
"""Time between two rows that follow a moving arm lies between these, s. Cameras of motion capture
take at most some thousand frames a second; and in 10 s an arm with its line settles, so rows as far
apart are steady-state samples."""
USUAL_S = (5e-4, 2.0)
"""Beyond these the time between two rows is so unusual that an import mentions it, s: 2 kHz is
faster than most cameras, and within 2 s most arms settle."""
TIME_FACTORS = (1e-3, 1e3, 1e-6, 1e6)
"""Seconds in what a recording calls one that are tried: ms or us read as s, and the other way."""
TYPICAL_S = 0.03
"""Typical time between rows, s: the geometric mean of 1 kHz and 1 Hz. Of several units the one
that comes nearest is proposed."""
SMOOTH = 0.5
"""A motion is followed where the mean square of the actuation's steps from row to row is below this
multiple of twice its variance, a ratio that is 1 for unordered rows (von Neumann 1941)."""
GAP_S = 1.0
"""Shortest gap inside a run, s, as between the rows of two files that `import` joins by time."""
GAP_STEPS = 10.0
"""... and its least length in units of the usual time between rows, so that a slow recording with
some lost rows has none."""
MOST_NAMED = 3
"""Most gaps that a sentence names."""


@dataclass(frozen=True)
class Gap:
    """A stretch inside a run in which nothing was recorded."""

    begin_s: float
    """Time of the last row before it, s."""
    end_s: float
    """Time of the first row after it, s."""

    @property
    def length_s(self) -> float:
        """Its length, s."""
        return self.end_s - self.begin_s


def usual_step_s(recordings: Sequence[Recording]) -> float | None:
    """Median time between rows inside runs, s; None without any, or of steady-state samples."""
    if any(recording.kind == "settled" for recording in recordings):
        return None
    steps = [np.diff(r.t_s[run]) for r in recordings for run in r.runs]
    every = np.concatenate([np.empty(0), *steps])
    return float(np.median(every)) if len(every) else None


def follows_motion(runs: Sequence[np.ndarray]) -> bool:
    """Whether an actuation moves, and its rows follow it rather than jump from value to value.

    runs: (T, m) actuation of each run, in one unit.
    """
    every = np.concatenate([np.asarray(run, float) for run in runs])
    variance = every.var(axis=0).sum() * len(every)
    squares = sum(float(np.square(np.diff(run, axis=0)).sum()) for run in runs)
    return bool(variance > 0 and squares < SMOOTH * 2 * variance)


def usual(step_s: float) -> bool:
    """Whether rows so far apart [s] are usual for a moving arm."""
    return USUAL_S[0] <= step_s <= USUAL_S[1]


def impossible(step_s: float) -> bool:
    """Whether no recording of a moving arm has rows so far apart [s]."""
    return not POSSIBLE_S[0] * (1 + 1e-9) < step_s < POSSIBLE_S[1] * (1 - 1e-9)


def time_factors(step_s: float) -> list[float]:
    """Other units of time that give a possible time between rows: seconds in what is called one.

    step_s: usual time between rows as read [s]. The likeliest comes first.
    """
    found = [factor for factor in TIME_FACTORS if not impossible(step_s * factor)]
    return sorted(found, key=lambda factor: _from_typical(step_s * factor))


def likeliest(step_s: float, factors: Iterable[float]) -> float | None:
    """The factor that gives the most typical time between rows; None where none is usual.

    step_s: usual time between rows as read [s].
    """
    found = [factor for factor in factors if usual(step_s * factor)]
    return min(found, key=lambda factor: _from_typical(step_s * factor), default=None)


def _from_typical(step_s: float) -> float:
    """How far a time between rows [s] is from the typical one, as a logarithm."""
    return abs(float(np.log(step_s / TYPICAL_S)))


def gaps(recording: Recording) -> tuple[list[Gap], float]:
    """Gaps inside runs in time order, and the longest time between rows that is none [s].

    Steady-state samples have none.
    """
    step = usual_step_s([recording])
    if step is None:
        return [], 0.0
    limit = max(GAP_S, GAP_STEPS * step)
    found = []
    for run in recording.runs:
        t_s = recording.t_s[run]
        for row in np.flatnonzero(np.diff(t_s) > limit).tolist():
            found.append(Gap(float(t_s[row]), float(t_s[row + 1])))
    return found, limit


def gaps_in_words(recording: Recording) -> str:
    """The gaps inside runs and the line of a map that begins a new run there; empty without any."""
    found, limit = gaps(recording)
    if not found:
        return ""
    named = [f"{g.length_s:.4g} s from {g.begin_s:.4g} s on" for g in found[:MOST_NAMED]]
    more = f" and {len(found) - MOST_NAMED} more" if len(found) > MOST_NAMED else ""
    several = len(found) > 1
    return (
        f"{'gaps' if several else 'a gap'} without rows inside a run ({', '.join(named)}{more}), "
        f"over which the past of the arm is not known: set gap_s = {float(f'{limit:.3g}'):g} in "
        f"[runs] of the map, so that a new run begins behind {'each' if several else 'it'}"
    )
