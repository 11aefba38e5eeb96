"""Whether a recording's actuation and body fit together in time.

An arm moves after its actuation, never before it: a body that leads its actuation at every speed
of motion says that the actuation was logged late. And a sensor that is slower than the log repeats
each reading until the next one, which makes it late by half its period on average.
"""

from dataclasses import dataclass, replace

import numpy as np

from surgisoft.measurement.importing_clock import renewal_s, renewed_rows, without_holds
from surgisoft.measurement.recording import Recording
from surgisoft.measurement.recording_moves import LEAST_ROWS, Moves

LEAST_SHARE = 0.05
"""Least share of the squared error that a lead must remove beyond every lag."""
LEAST_T = 4.0
"""Least mean over standard error, over blocks, of what a lead removes."""
LEAST_SPEED_R2 = 0.3
"""A length of move counts where its actuation explains at least this share of it."""
SAME_LEAD = 0.6
"""Least lead of shorter moves, as a share of that of the longest ones."""

HELD_RANGE = (0.5, 1.6)
"""A held reading lasts so many times the usual period."""
HELD_REGULAR = 0.8
"""Least share of readings that last so long, for the sensor to be called slow."""


@dataclass(frozen=True)
class Lead:
    """By how much time the body leads its measured actuation."""

    seconds: float
    """Best estimate; the arm's own lag comes on top [s]."""
    ci95_s: tuple[float, float]
    """95 % interval, by a jackknife over blocks of time [s]."""


def held_period_s(recording: Recording) -> float | None:
    """The period of a sensor that is slower than the log while the body moves on [s], if it is.

    Not where readings come irregularly, as quantised or resting ones do, nor where the command
    changes in the very same rows: then the actuation may be a staircase indeed.
    """
    if recording.kind == "settled":
        return None
    gaps, alive, same = [], [], []
    for run in recording.runs:
        fresh = renewed_rows(recording.measured[run])
        gaps.append(np.diff(fresh))
        points = recording.key_points_mm[run].reshape(run.stop - run.start, -1)
        moved = (np.diff(points, axis=0) != 0) & ~np.isnan(np.diff(points, axis=0))
        held = np.setdiff1d(np.arange(1, len(points)), fresh)
        alive.append(moved[held - 1].any(axis=1))
        if recording.commanded is not None:
            same.append(np.isin(fresh[1:], renewed_rows(recording.commanded[run])[1:]))
    steps = np.concatenate(gaps)
    usual = np.median(steps) if len(steps) >= LEAST_ROWS else 1.0
    if usual < 2 or np.concatenate(alive).mean() < 0.5:
        return None
    low, high = (factor * usual for factor in HELD_RANGE)
    if ((steps >= low) & (steps <= high)).mean() < HELD_REGULAR:
        return None
    if same and np.concatenate(same).mean() > 0.9 and _staircase(recording, usual):
        return None
    return renewal_s([(recording.t_s[run], recording.measured[run]) for run in recording.runs])


def _staircase(recording: Recording, usual: float) -> bool:
    """Whether the command is renewed as seldom as the measurement."""
    steps = [np.diff(renewed_rows(recording.commanded[run])) for run in recording.runs]
    return bool(np.median(np.concatenate(steps)) >= 0.8 * usual)


def released(recording: Recording, period_s: float) -> Recording:
    """The recording with readings on a line between those of a slow sensor."""
    measured = recording.measured.copy()
    for run in recording.runs:
        measured[run] = without_holds(recording.t_s[run], measured[run], period_s)
    return replace(recording, measured=measured)


def body_lead(recording: Recording) -> Lead | None:
    """The body's lead before its measured actuation, where the recording shows one beyond doubt.

    Moves of the body x(t) - x(t - w) are regressed on those of a quadratic function of the
    actuation, shifted in time; judged on blocks that took no part. A lead is called one where it
    leaves less than every lag (so that a periodic motion, whose lead is as good as a lag, shows
    none), and where shorter moves show it too: a late log shifts every speed of motion alike,
    whereas an arm's relaxation, or a readings' hold, shifts some of them only.
    """
    if recording.kind == "settled":
        return None
    moves = Moves.of(recording)
    if moves is None:
        return None
    first, best, error = moves.search(moves.longest)
    causal = error[first >= 0].sum(axis=1)
    won = error[first >= 0][causal.argmin()] - error[best]
    if first[best] >= 0 or won.sum() < LEAST_SHARE * causal.min():
        return None
    if won.mean() < LEAST_T * won.std(ddof=1) / np.sqrt(len(won)):
        return None
    length = moves.longest
    while length > 1:
        length = length // 2
        shifts, at, losses = moves.search(length)
        explained = 1 - losses[at].sum() / moves.power(length)
        if explained >= LEAST_SPEED_R2 and shifts[at] > SAME_LEAD * first[best]:
            return None
    seconds, spread = _jackknife(first, error)
    if seconds + 2 * spread >= 0:
        return None
    step = moves.step_s
    return Lead(-seconds * step, (-(seconds + 2 * spread) * step, -(seconds - 2 * spread) * step))


def timing_notes(recording: Recording, delay_s: float) -> list[str]:
    """What the data say about the actuation's clock, with what to put into the import's map.

    delay_s: by how much the map has already taken the actuation's log to be late [s].
    """
    notes = []
    period = held_period_s(recording)
    if period is not None:
        recording = released(recording, period)
        notes.append(
            f"measured actuation is renewed every {period:.4g} s only and held in between, while "
            'the body moves on: if its sensor is slower than the log, set repeated = "interpolate" '
            "in [measured] of the map"
        )
    lead = body_lead(recording)
    if lead is not None:
        low, high = lead.ci95_s
        notes.append(
            f"the body moves {lead.seconds:.3f} s ({low:.3f} to {high:.3f}) before its measured "
            "actuation, which no arm that follows it can: if the actuation was logged late, set "
            f"delay_s = {delay_s + lead.seconds:.3f} in [measured] of the map"
        )
    return notes


def _jackknife(shifts: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """The best of shifts (K,), in samples, by errors (K, blocks), and its standard error."""
    total = error.sum(axis=1)
    blocks = error.shape[1]
    without = [_lowest(shifts, total - error[:, k]) for k in range(blocks)]
    spread = np.sqrt((blocks - 1) / blocks * np.square(without - np.mean(without)).sum())
    return _lowest(shifts, total), float(spread)


def _lowest(shifts: np.ndarray, total: np.ndarray) -> float:
    """Where the parabola through the lowest of totals (K,) and its two neighbours is lowest."""
    at = int(total.argmin())
    if at in (0, len(total) - 1):
        return float(shifts[at])
    a, b, _ = np.polyfit(shifts[at - 1 : at + 2] - shifts[at], total[at - 1 : at + 2], 2)
    return float(shifts[at] - b / (2 * a)) if a > 0 else float(shifts[at])
