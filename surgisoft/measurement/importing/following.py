"""Whether key points follow the actuation at all: else it may be the log of another recording.

Four regressions are cross-validated by blocks of time. Moves of the body are regressed on those of
a quadratic function of the actuation, shifted by a few seconds (`Moves`), and then by any time at
which half of the recording is left; positions on the actuation behind lags of up to minutes, and on
the body's own past with and without functions of each channel, for arms that swing on for long.
The best one says what share the actuation explains: much of it on usual arms, nearly nothing where
files were mixed up. A small share is no proof: an arm may depend on its actuation in another way.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from surgisoft.measurement.importing.timing import (
    BLOCKS,
    FOLDS,
    LEAST_ROWS,
    RIDGE,
    Moves,
    lagged,
    set_delay,
)
from surgisoft.measurement.recordings import Recording

EXPLAINED = 0.3
"""Share of the body's motion beyond which it follows the actuation as recorded: no long shift is
tried [-]."""
HARDLY = 0.15
"""Share of the body's motion as recorded up to which an actuation may be that of another recording:
at the best of many long shifts, chance explains up to EXPLAINED [-]."""
LEAST_OFFSET = 0.6
"""Least share that the actuation explains where it is shifted by a time that is named [-]."""
LEAST_DEAD_S = 0.5
"""Least time after which a body that follows all at once is late by its clock and not by its line:
pressure and light take less to arrive [s]."""
LEAST_DEAD = 0.8
"""Least share that the actuation explains at that time [-]."""
HALVED = 0.5
"""Most of the unexplained motion that another time leaves, as a share of what the times as they are
leave, at once or behind lags [-]."""
LEAST_LEFT = 0.1
"""Least share of the motion that the times as they are leave, where the body is early [-]."""
LEAST_T = 3.0
"""... and the least mean over standard error, over blocks of time, of its logarithm [-]."""
LAG_STRETCHES = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Lags, in units of the time, that are compared with a shift by the whole time [-]."""
LAG_ORDERS = (1, 2, 3)
"""Equal first-order lags that such a lag consists of (counts)."""
LAG_SHARES = (0.0, 0.25)
"""Shares of the time that are a shift, before such a lag [-]."""
ABOVE_NOISE = 4.0
"""Least mean square of the longest moves, as a multiple of those from one sample to the next: where
the body moves no more than that, noise may be all there is [-]."""
LEAST_JUDGED = 0.5
"""Least mean square of the moves that are judged, as a share of that of all moves [-]."""
LEAST_LENGTHS = 20
"""Least duration, in lengths of the longest moves: fewer are no sample (a count)."""
SHIFTED_ROWS = 1500
"""Most moves that are compared at each long shift (a count)."""
MOST_SHIFTS = 600
"""Most long shifts that are tried (a count)."""
LAGS_S = (0.0, 1.0, 4.0, 16.0, 60.0)
"""Lags of the actuation behind which positions are looked at [s]."""
PAST, MAIN_MOTIONS = 3, 3
"""Positions of the body's past, and directions of its motion that are looked at (counts)."""
AHEAD = (1, 3)
"""Times between these positions, in lengths of the longest moves [-]."""
KNOTS = 7
"""Knots of the piecewise linear functions of a channel (a count)."""
LAGGED_ROWS = 3000
"""Most rows of that regression (a count)."""


@dataclass(frozen=True)
class Following:
    """How much of the body's motion an actuation explains."""

    explained: float
    """Largest share of the motion, or of what the body's own past leaves of it, that is explained
    as recorded, at most a few seconds late [-]."""
    shifted: float
    """Largest share with the actuation shifted by any time [-]."""
    shift_s: float
    """By how much the body is late at that shift [s]."""
    apart: bool = False
    """Whether no lag explains as much as that shift, so that clocks are apart."""


FALLEN = 0.5
"""Autocorrelation below which an actuation is another one than at first [-]."""
REPEATED = 0.9
"""Autocorrelation from which it has come again after that; a sine without noise reaches 1 [-]."""


def following(recording: Recording) -> Following | None:
    """How much the actuation explains; None where the recording cannot show it.

    It cannot with steady-state samples, few rows, and a body or an actuation that hardly moves, or
    moves mostly in the first seconds of its runs, which no shift leaves to look at.
    """
    if recording.kind == "settled":
        return None
    moves = Moves.of(recording)
    if moves is None or not _moving(moves):
        return None
    shifts, best, errors = moves.search(moves.longest)
    explained = 1 - float(errors[best].sum()) / moves.power(moves.longest)
    shift_s = float(shifts[best]) * moves.step_s
    found = (explained, shift_s)
    if explained <= EXPLAINED or best in (0, len(shifts) - 1):
        found = max(_far(moves), found)
    if explained > EXPLAINED:
        return Following(explained, *found, apart=_apart(moves, explained, *found))
    for share in (_behind_lags, _beyond_own_past):
        explained = max(explained, share(moves))
        if explained > EXPLAINED:
            return Following(explained, *found, apart=_apart(moves, explained, *found))
    shifted, late_s = max(found, (explained, shift_s))
    return Following(explained, shifted, late_s, apart=shifted >= LEAST_OFFSET)


def _apart(moves: Moves, explained: float, shifted: float, shift_s: float) -> bool:
    """Whether body and actuation are apart by this time, and not by a lag.

    explained: the largest share at a usual shift; shifted: the share at this one. A clock delays
    fast and slow motion alike, a lag spreads it. No lag moves the body first. Where the actuation
    repeats itself, a time is as good as one that is a period later.
    """
    shift = shift_s / moves.step_s
    if shifted < LEAST_DEAD or abs(shift_s) < LEAST_DEAD_S:
        return False
    if shift < 0:
        causal = 1 - max(explained, _behind_lags(moves))
        return causal >= LEAST_LEFT and 1 - shifted <= HALVED * causal
    if repeats(moves.actuation):
        return False
    most = round(shift)
    pure = moves.errors_at(most, most, moves.longest)
    for share in LAG_SHARES:
        for by in LAG_STRETCHES:
            for lags in LAG_ORDERS:
                samples = (1 - share) * by * shift / lags
                slow = moves.behind(samples, lags)
                left = slow.errors_at(round(share * shift), most, moves.longest)
                if pure.sum() > HALVED * left.sum():
                    return False
                gain = np.log(np.maximum(left, 1e-12) / np.maximum(pure, 1e-12))
                if gain.mean() < LEAST_T * gain.std(ddof=1) / np.sqrt(len(gain)):
                    return False
    return True


def repeats(actuation: Sequence[np.ndarray]) -> bool:
    """Whether an actuation, each run's (G, m), nearly comes again at a later time, as a periodic
    one does: its autocorrelation, once it has fallen below `FALLEN`, is `REPEATED` or more."""
    for run in actuation:
        x = run - run.mean(axis=0)
        count = len(x)
        spectrum = np.fft.rfft(x, 2 * count, axis=0)
        product = np.fft.irfft(np.square(np.abs(spectrum)).sum(axis=1))[: count // 2]
        energy = np.concatenate([[0.0], np.cumsum(np.square(x).sum(axis=1))])
        later = np.arange(len(product))
        size = np.sqrt(energy[count - later] * (energy[-1] - energy[later]))
        alike = product / np.maximum(size, 1e-12)
        fallen = np.flatnonzero(alike < FALLEN)
        if len(fallen) and alike[fallen[0] :].max() >= REPEATED:
            return True
    return False


def following_warnings(recording: Recording, delays_s: Mapping[str, float]) -> list[str]:
    """A warning where the key points do not follow the actuation, or only at another time.

    delays_s: as for `set_delay`.
    """
    return warnings_of(following(recording), delays_s)


def warnings_of(found: Following | None, delays_s: Mapping[str, float]) -> list[str]:
    """The same, of how much the actuation explains."""
    if found is None:
        return []
    if found.apart:
        how = "late" if found.shift_s > 0 else "early"
        as_it_is = f", and {_percent(found.explained)} as the times are"
        if found.shift_s > 0 and found.explained > EXPLAINED:
            as_it_is = ", and a lag leaves at least twice as much of it"
        return [
            f"the key points follow the actuation {abs(found.shift_s):.3g} s {how}, with the arm's "
            "own lag "
            f"({found.shifted:.0%} of their motion is explained then{as_it_is}): if the clocks of "
            f"the files are apart, {set_delay(delays_s, -found.shift_s, '.3g')}"
        ]
    if found.explained > EXPLAINED:
        return []
    if found.explained > HARDLY or found.shifted > EXPLAINED:
        return []
    return [
        f"the key points hardly follow the actuation: it explains {_percent(found.shifted)} of "
        "their motion (cross-validated, at the best shift in time): check that the files are of "
        "the same recording, and the columns of [measured] and [key_points] in the map"
    ]


def _percent(share: float) -> str:
    return f"{max(share, 0.0):.0%}"


def _moving(moves: Moves) -> bool:
    """Whether the body moves above its noise, for long enough, and body and actuation do so where
    they are judged, too."""
    length = moves.longest
    duration = sum(len(part) for part in moves.body)
    if length < 2 or duration < LEAST_LENGTHS * length:
        return False
    judged = moves.mean_square(length)
    if judged <= 0.0 or judged < LEAST_JUDGED * _mean_square(moves.body, length):
        return False
    actuated = replace(moves, body=moves.actuation).mean_square(length)
    if actuated < LEAST_JUDGED * _mean_square(moves.actuation, length):
        return False
    return judged >= ABOVE_NOISE * max(moves.mean_square(length, 1), _mean_square(moves.body, 1))


def _mean_square(parts: list[np.ndarray], length: int) -> float:
    """Mean square of all moves of this length of runs (G, d)."""
    moved = [part[length:] - part[:-length] for part in parts if len(part) > length]
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
    """Share of the positions' variance that the actuation behind lags explains."""
    features, places = [], []
    every = max(1, sum(len(part) for part in moves.body) // LAGGED_ROWS)
    for actuation, body in zip(moves.actuation, moves.body, strict=True):
        behind = np.concatenate([lagged(actuation, s / moves.step_s) for s in LAGS_S], axis=1)
        behind = np.concatenate([behind, actuation**2], axis=1)
        rows = slice(None, None, every)
        known = ~np.isnan(body[rows]).any(axis=1)
        features.append(behind[rows][known])
        places.append(body[rows][known])
    x, y = np.concatenate(features), np.concatenate(places)
    if len(x) < BLOCKS:
        return 0.0
    left, total = _errors(x, y)
    return 1 - left / max(total, 1e-300)


def _beyond_own_past(moves: Moves) -> float:
    """Share of what the body's own past leaves of its positions that the actuation explains.

    The past tells where a swing goes on to, whatever its frequency and damping.
    """
    return max(_beyond_past(moves, times * moves.longest) for times in AHEAD)


def _beyond_past(moves: Moves, length: int) -> float:
    """The share where the past ends so many samples before each position."""
    every = max(1, sum(len(part) for part in moves.body) // LAGGED_ROWS)
    known = np.concatenate(moves.body)
    known = known[~np.isnan(known).any(axis=1)]
    _, axes = np.linalg.eigh(np.cov(known.T).reshape(known.shape[1], -1))
    main = axes[:, -MAIN_MOTIONS:]
    pasts, causes, places = [], [], []
    for actuation, body in zip(moves.actuation, moves.body, strict=True):
        at = np.arange(PAST * length, len(body), every)
        past = np.concatenate([body[at - k * length] @ main for k in range(1, PAST + 1)], axis=1)
        seen = ~np.isnan(past).any(axis=1) & ~np.isnan(body[at]).any(axis=1)
        at = at[seen]
        delays = (np.arange(2 * PAST - 1) * length) // 2
        causes.append(np.concatenate([_bent(actuation[at - late]) for late in delays], axis=1))
        pasts.append(past[seen])
        places.append(body[at] @ main)
    past, cause, y = (np.concatenate(each) for each in (pasts, causes, places))
    if len(y) < LEAST_ROWS:
        return 0.0
    alone, _ = _errors(past, y)
    both, _ = _errors(np.concatenate([past, cause], axis=1), y)
    return 1 - both / max(alone, 1e-300)


def _bent(actuation: np.ndarray) -> np.ndarray:
    """(S, k) of actuation (S, m) in [-1, 1]: piecewise linear functions of each channel."""
    knots = np.linspace(-1.0, 1.0, KNOTS)
    hats = np.maximum(0.0, 1.0 - np.abs(actuation[:, :, None] - knots) / (knots[1] - knots[0]))
    return hats.reshape(len(actuation), -1)


def _errors(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Cross-validated squared error of y (S, d) regressed on x (S, k), and that of its mean."""
    x = x / np.maximum(x.std(axis=0), 1e-12)
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
    return left, total
