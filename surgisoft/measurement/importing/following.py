"""Whether key points follow the actuation at all: else it may be the log of another recording.

Three regressions on a quadratic function of the actuation are cross-validated by blocks of time.
Moves of the body are regressed on moves of the actuation, shifted by a few seconds (`Moves`), and
then by any time at which half of the recording is left; and positions on the actuation behind lags
of up to minutes. The best one says what share of the body's motion the actuation explains: nearly
all on an arm, whatever its lag and its hysteresis, and nothing where files were mixed up.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from surgisoft.measurement.importing.timing import BLOCKS, FOLDS, RIDGE, Moves, set_delay
from surgisoft.measurement.recordings import Recording

EXPLAINED = 0.3
"""Largest share of the body's motion that an actuation explains by chance [-]."""
LEAST_OFFSET = 0.6
"""Least share that the actuation explains where it is shifted by a time that is named [-]."""
ABOVE_NOISE = 4.0
"""Least mean square of the longest moves, as a multiple of those from one sample to the next: where
the body moves no more than that, noise may be all there is [-]."""
LEAST_LENGTHS = 20
"""Least duration, in lengths of the longest moves: fewer are no sample (a count)."""
SHIFTED_ROWS = 1500
"""Most moves that are compared at each long shift (a count)."""
MOST_SHIFTS = 600
"""Most long shifts that are tried (a count)."""
LAGS_S = (0.0, 1.0, 4.0, 16.0, 60.0)
"""Lags of the actuation behind which positions are looked at [s]."""
LAGGED_ROWS = 3000
"""Most rows of that regression (a count)."""


@dataclass(frozen=True)
class Following:
    """How much of the body's motion an actuation explains."""

    explained: float
    """Largest share of the motion that is explained as recorded, at most a few seconds late [-]."""
    shifted: float
    """Largest share with the actuation shifted by any time [-]."""
    shift_s: float
    """By how much the body is late at that shift [s]."""


def following(recording: Recording) -> Following | None:
    """How much the actuation explains; None where the recording cannot show it.

    It cannot with steady-state samples, few rows, and a body or an actuation that hardly moves.
    """
    if recording.kind == "settled":
        return None
    moves = Moves.of(recording)
    if moves is None or not _moving(moves):
        return None
    shifts, best, errors = moves.search(moves.longest)
    explained = 1 - float(errors[best].sum()) / moves.power(moves.longest)
    shift_s = float(shifts[best]) * moves.step_s
    if explained > EXPLAINED:
        return Following(explained, explained, shift_s)
    explained = max(explained, _behind_lags(moves))
    if explained > EXPLAINED:
        return Following(explained, explained, shift_s)
    shifted, late = max(_far(moves), (explained, shift_s))
    return Following(explained, shifted, late)


def following_warnings(recording: Recording, delays_s: Mapping[str, float]) -> list[str]:
    """A warning where the key points do not follow the actuation, or only at another time.

    delays_s: as for `set_delay`.
    """
    found = following(recording)
    if found is None or found.explained > EXPLAINED:
        return []
    if found.shifted >= LEAST_OFFSET:
        how = "late" if found.shift_s > 0 else "early"
        return [
            f"the key points follow the actuation {abs(found.shift_s):.3g} s {how} "
            f"({found.shifted:.0%} of their motion is explained then, and none as the times are): "
            f"if the clocks of the files are apart, {set_delay(delays_s, -found.shift_s, '.3g')}"
        ]
    if found.shifted > EXPLAINED:
        return []
    return [
        "the key points do not follow the actuation: it explains nothing of their motion "
        "(cross-validated, at any shift in time): check that the files are of the same recording, "
        "and the columns of [measured] and [key_points] in the map"
    ]


def _moving(moves: Moves) -> bool:
    """Whether the body moves above its noise, for long enough."""
    length = moves.longest
    duration = sum(len(part) for part in moves.body)
    if duration < LEAST_LENGTHS * length:
        return False
    mean = [_mean_square(moves, each) for each in (length, 1)]
    return length > 1 and mean[0] >= ABOVE_NOISE * mean[1]


def _mean_square(moves: Moves, length: int) -> float:
    moved = [part[length:] - part[:-length] for part in moves.body if len(part) > length]
    return float(np.nanmean(np.square(np.concatenate(moved)), axis=0).sum())


def _far(moves: Moves) -> tuple[float, float]:
    """The largest share that a long shift explains, and how late the body is then [s]."""
    length = moves.longest
    usual = int(np.median([len(part) for part in moves.body])) // 2
    every = max(1, length // 4, 2 * usual // MOST_SHIFTS)
    found = [
        (moves.explained_at(shift, length, SHIFTED_ROWS), float(shift))
        for shift in range(-usual, usual + 1, every)
    ]
    share, shift = max(found, default=(0.0, 0.0))
    if share <= EXPLAINED:
        return share, shift * moves.step_s
    near = range(int(shift) - every, int(shift) + every + 1, max(1, every // 8))
    share, shift = max((moves.explained_at(at, length, SHIFTED_ROWS), float(at)) for at in near)
    return share, shift * moves.step_s


def _behind_lags(moves: Moves) -> float:
    """Share of the positions' variance that the actuation behind lags explains, each run from its
    own mean."""
    features, places = [], []
    every = max(1, sum(len(part) for part in moves.body) // LAGGED_ROWS)
    for actuation, body in zip(moves.actuation, moves.body, strict=True):
        lagged = np.concatenate([_lagged(actuation, s / moves.step_s) for s in LAGS_S], axis=1)
        lagged = np.concatenate([lagged, actuation**2], axis=1)
        rows = slice(None, None, every)
        known = ~np.isnan(body[rows]).any(axis=1)
        features.append(lagged[rows][known])
        places.append(body[rows][known])
    x, y = np.concatenate(features), np.concatenate(places)
    if len(x) < BLOCKS:
        return 0.0
    fold = (np.arange(len(x)) * BLOCKS // len(x)) % FOLDS
    left = total = 0.0
    for k in range(FOLDS):
        own, others = fold == k, fold != k
        centre, mean = x[others].mean(0), y[others].mean(0)
        inside = x[others] - centre
        gram = inside.T @ inside
        gram += max(RIDGE * np.trace(gram) / len(gram), 1e-12) * np.eye(len(gram))
        slope = np.linalg.solve(gram, inside.T @ (y[others] - mean))
        left += float(np.square(y[own] - mean - (x[own] - centre) @ slope).sum())
        total += float(np.square(y[own] - mean).sum())
    return 1 - left / max(total, 1e-300)


def _lagged(values: np.ndarray, rows: float) -> np.ndarray:
    """(G, m) of values (G, m) behind a first-order lag of so many rows, at rest at the begin."""
    if rows <= 0.0:
        return values
    keep, answer = float(np.exp(-1.0 / rows)), np.empty_like(values)
    state = values[0]
    for row, value in enumerate(values):
        state = value + keep * (state - value)
        answer[row] = state
    return answer
