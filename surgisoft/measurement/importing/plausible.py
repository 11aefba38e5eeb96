"""Notes of an import about a set-up that cannot be right, as far as no model is needed for it."""

import itertools

import numpy as np

from surgisoft.measurement.importing.align import renewal_s
from surgisoft.measurement.recordings import Recording
from surgisoft.measurement.recordings.clock import (
    USUAL_S,
    follows_motion,
    likeliest,
    usual,
    usual_step_s,
)
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.measurement.recordings.quality import largest_motion
from surgisoft.measurement.units import PLURAL, SECONDS_PER, factor, unit_mistakes
from surgisoft.units import KPA_PER

LARGEST_RATIO = 2.0
"""Key points that span more than this multiple of the arm's length are in a wrong unit."""
LEAST_RATIO = 0.2
"""Key points that span less than this share of the arm's length are in a wrong unit: trackers may
cover a part of the arm only."""
UNIT_TOLERANCE = 0.5
"""Largest difference, in the logarithm of the length, of a unit that is proposed."""
BASE_MOTION = 3.0
"""Key points are taken for reversed where the first moves so many times more than the last."""
LEAST_CORRELATION = 0.9
"""A measured channel is said to follow another command only from this correlation on: one below it
has lost too much to noise, clipping or a slow line to be assigned [-]."""
LEAST_UNEXPLAINED = 0.1
"""... and where its own command leaves at least this share of its variance unexplained [-] ..."""
LEAST_RATIO_UNEXPLAINED = 4.0
"""... which is so many times what the other command leaves: twice the error [-]."""
SHIFT_S = 0.05
"""Step of the delays between a command and its measured channel at which their correlation is
taken; the largest one counts, so that a lag or clocks that differ are no wrong order [s]."""
LARGEST_SHIFT_S = 3.0
"""Largest such delay, either way [s]."""
LEAST_LEAD_S = 0.1
"""Least time by which measured actuation is said to precede its command: two of these steps [s]."""
LEAST_FOLLOWING = 0.95
"""Least correlation of a measured channel with its own command from which the ratio of the two is
that of a wrong unit [-]."""
SPREAD = (0.05, 0.95)
"""Quantiles between which values lie whose spread is compared [-]."""
SAME_RATIO = 0.05
"""Largest difference, as a share, of that ratio from the one of two units, in every channel [-]."""
USUAL_KPA = (2.0, 10_000.0)
"""Range of the pressure of the channel that is driven most, of an arm that moves: films on the one
side and hydraulic muscles on the other are near its ends [kPa]."""
TYPICAL_KPA = 100.0
"""The unit in which that range is nearest to this one, by ratio, is proposed [kPa]."""
MISTAKEN = ("Pa", "mbar", "psi", "bar", "MPa", "kPa")
"""Units that are proposed."""
LEAST_MOTION = 0.1
"""Least motion of a key point, as a share of the arm's length, of an arm that is driven [-]."""
MOST_ROWS = 6000
"""Rows, evenly over the recording, whose measured actuation is compared with the commands: they
determine a correlation of 0.9 to within 0.01 (a count)."""


HELD = 10.0
"""A pressure that varies by less than its largest value over this is held, and says nothing of its
unit: an arm that moves then is moved by something else."""


def plausibility_notes(
    recording: Recording, unit: str | None, time_unit: str | None = None
) -> list[str]:
    """Contradictions to the arm's stated length, the order base to tip, a moving arm's rows, and
    the order, the clock and the unit of the commanded channels.

    unit: of positions; time_unit: of the column of times, None where the map states a rate.
    """
    return [
        *_length(recording, unit),
        *_order(recording),
        *_step(recording, time_unit),
        *_channels(recording),
        *_pressure(recording),
    ]


def _pressure(recording: Recording) -> list[str]:
    """A note where an arm moves at pressures that are those of another unit."""
    by = factor(recording.unit, "kPa")
    span = float(np.ptp(recording.measured, axis=0).max())
    _, moved_mm, length_mm = largest_motion([recording])
    if by is None or span == 0.0 or not length_mm or moved_mm < LEAST_MOTION * length_mm:
        return []
    low, high = USUAL_KPA
    held = float(np.abs(recording.measured).max()) > HELD * span
    if low <= by * span <= high or held:
        return []
    others = [unit for unit in MISTAKEN if unit != recording.unit]
    near = min(others, key=lambda unit: abs(np.log(KPA_PER[unit] * span / TYPICAL_KPA)))
    return [
        f"the actuation moves by {span:.3g} {recording.unit} at most, expected {low:g} to "
        f"{high:g} kPa of an arm that moves: if the values are in {near}, set unit = "
        f'"{near}" in [measured] and [commanded] of the map'
    ]


def _channels(recording: Recording) -> list[str]:
    """Notes where measured channels follow each other's commands and not their own; else where they
    precede their commands, and where they are a unit's multiple of them."""
    if recording.commanded is None:
        return []
    shifts, each = _correlations(recording)
    order = _channel_order(each.max(axis=0))
    if order:
        return order
    own = np.diagonal(each, axis1=1, axis2=2)
    return [*_lead(recording, shifts, own), *_unit(recording, shifts, own)]


def _channel_order(follows: np.ndarray) -> list[str]:
    """A note where measured channels follow each other's commands, by their correlations (m, m)."""
    if len(follows) < 2:
        return []
    own = np.diagonal(follows)
    best = follows.argmax(axis=1)
    highest = follows.max(axis=1)
    other = (
        (best != np.arange(len(best)))
        & (highest >= LEAST_CORRELATION)
        & (1 - own**2 >= np.maximum(LEAST_RATIO_UNEXPLAINED * (1 - highest**2), LEAST_UNEXPLAINED))
    )
    moved = np.flatnonzero(other)
    if not len(moved) or {*best[moved].tolist()} != {*moved.tolist()}:
        return []
    order = np.arange(len(best))
    order[best[moved]] = moved
    return [
        f"measured channels {_listed(moved + 1)} follow commanded channels "
        f"{_listed(best[moved] + 1)} (correlation {_listed(highest[moved], '.2f')}, with their own "
        f"{_listed(own[moved], '.2f')}): if the columns of [measured] are in another order than "
        f"those of [commanded], put them in the order {(order + 1).tolist()} in the map"
    ]


def _lead(recording: Recording, shifts: np.ndarray, own: np.ndarray) -> list[str]:
    """A note where measured actuation precedes its command, which nothing that follows it can.

    shifts: (S,) how late the measured values are [s]; own: (S, m) correlation of each channel with
    its command there. A command that is logged seldom is held, and late by as much.
    """
    command = recording.commanded
    late, early = own[shifts >= 0].max(axis=0), own[shifts < 0]
    if command is None or not len(early):
        return []
    moving = late > 0
    unexplained = 1 - np.square(early[:, moving])
    best = shifts[shifts < 0][unexplained.mean(axis=1).argmin()] if moving.any() else 0.0
    held = renewal_s([(recording.t_s[run], command[run]) for run in recording.runs])
    if -best < max(LEAST_LEAD_S, 2 * held):
        return []
    least = unexplained.mean(axis=1).min()
    if least > 1 - LEAST_CORRELATION**2:
        return []
    if np.mean(1 - np.square(late[moving])) < LEAST_RATIO_UNEXPLAINED * least:
        return []
    return [
        f"measured actuation moves about {-best:.2f} s before its command, which nothing that "
        "follows a command can: if both are of one log or clock, set the same delay_s in [measured]"
        " and [commanded] of the map"
    ]


def _unit(recording: Recording, shifts: np.ndarray, own: np.ndarray) -> list[str]:
    """A note where measured actuation is so many times its command as one unit is of another.

    shifts, own: as for `_lead`.
    """
    command = recording.commanded
    best = own.max(axis=0)
    moving = best > 0
    if command is None or not moving.any() or (best[moving] < LEAST_FOLLOWING).any():
        return []
    # A measured value is about as large as its command at any lag, so spreads give the ratio.
    measured, commanded = (
        np.ptp(np.quantile(values[:, moving], SPREAD, axis=0), axis=0)
        for values in (recording.measured, command)
    )
    ratios = measured / np.maximum(commanded, 1e-300)
    for units, by in unit_mistakes(recording.unit).items():
        if any((np.abs(ratios / factor - 1) <= SAME_RATIO).all() for factor in (by, 1 / by)):
            one, other = (PLURAL.get(unit, unit) for unit in units)
            return [
                f"measured actuation is {np.median(ratios):.3g} times its command, as if one were "
                f"in {one} and the other in {other}: check unit and to in [measured] and "
                "[commanded] of the map"
            ]
    return []


def _listed(values: np.ndarray, form: str = "d") -> str:
    *first, last = (format(value, form) for value in values.tolist())
    return f"{', '.join(first)} and {last}"


def _correlations(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Delays (S,) of the measured channels up to LARGEST_SHIFT_S either way [s], and at each of
    them the correlation (S, m, m) of each measured channel (row) with each command (column): 0
    where one of them is constant, and at least 0."""
    commanded, measured = recording.commanded, recording.measured
    assert commanded is not None, "only recordings with a command are compared"
    steps = 0 if recording.kind == "settled" else round(LARGEST_SHIFT_S / SHIFT_S)
    every = max(1, -(-len(measured) // MOST_ROWS))
    clock, begin, end = _clock(recording)
    asked, own, begin, end = (part[::every] for part in (clock, measured, begin, end))
    shifts = SHIFT_S * np.arange(-steps, steps + 1)
    found = np.zeros((len(shifts), recording.chambers, recording.chambers))
    for place, shift in enumerate(shifts):
        at = asked - shift
        inside = (at >= begin) & (at <= end)
        row = np.searchsorted(clock, at[inside] + 1e-9, side="right") - 1
        both = np.concatenate([own[inside], commanded[row]], axis=1)
        both = both[~np.isnan(both).any(axis=1)]
        if len(both) < 2:
            continue
        from_mean = both - both.mean(axis=0)
        size = np.sqrt(np.square(from_mean).sum(axis=0))
        moves = size > 1e-9 * np.abs(both).max(axis=0) * np.sqrt(len(both))
        unit = np.where(moves, from_mean / np.where(moves, size, 1.0), 0.0)
        m = recording.chambers
        found[place] = np.maximum(unit[:, :m].T @ unit[:, m:], 0.0)
    return shifts, found


def _step(recording: Recording, time_unit: str | None) -> list[str]:
    """A note where rows are too far apart, or too near, to follow a moving arm."""
    step = usual_step_s([recording])
    if step is None or usual(step):
        return []
    if not follows_motion([recording.measured[run] for run in recording.runs]):
        return []
    low, high = USUAL_S
    text = f"one row each {step:.3g} s, expected {low:g} to {high:g} s of an arm that moves"
    by = SECONDS_PER.get(time_unit or "")
    others = {} if by is None else {u: s / by for u, s in SECONDS_PER.items() if u != time_unit}
    likely = likeliest(step, others.values())
    named = next((u for u, factor in others.items() if factor == likely), None)
    advice = "check rate_hz, column and unit in [time]"
    if named is not None:
        advice = f'if the times are in {named}, set unit = "{named}" in [time]'
    slow = ' (steady-state samples: kind = "settled" in [recording])' if step > high else ""
    return [f"{text}: {advice}{slow}"]


def _length(recording: Recording, unit: str | None) -> list[str]:
    """A note where the key points span far more or less than the arm's length."""
    stated, points = recording.arm.length_mm, recording.key_points_mm
    if stated is None or recording.key_points < 2:
        return []
    links = np.linalg.norm(np.diff(points, axis=1), axis=2)
    known = ~np.isnan(links).any(axis=1)
    if not known.any():
        return []
    span = float(np.median(links[known].sum(axis=1)))
    if LEAST_RATIO * stated <= span <= LARGEST_RATIO * stated:
        return []
    text = f"the key points span {span:.3g} mm, the arm is {stated:.3g} mm long"
    ratio = stated / max(span, 1e-12)
    by = MM_PER.get(unit or "mm", 1.0)
    known_units = {name: mm / by for name, mm in MM_PER.items() if name != unit}
    best = min(known_units, key=lambda name: abs(np.log(known_units[name] / ratio)))
    if abs(np.log(known_units[best] / ratio)) > UNIT_TOLERANCE:
        return [f"{text}: check unit and scale in [key_points] and length_mm in [arm]"]
    return [f'{text}: if the positions are in {best}, set unit = "{best}" in [key_points]']


def _order(recording: Recording) -> list[str]:
    """A note where the key points move less and less from the first to the last."""
    motion = []
    for k in range(recording.key_points):
        point = recording.key_points_mm[:, k]
        seen = ~np.isnan(point[:, 0])  # missing ones are missing as a whole
        if seen.sum() < 2:
            return []
        motion.append(float(np.sqrt(sum(axis[seen].var() for axis in point.T))))
    falls = all(a > b for a, b in itertools.pairwise(motion))
    if len(motion) < 3 or not falls or motion[0] < BASE_MOTION * motion[-1]:
        return []
    order = [*range(recording.key_points)][::-1]
    return [
        f"key point k0 moves by {motion[0]:.3g} mm and the last one by {motion[-1]:.3g} mm (rms), "
        f"expected base to tip: if they are in reverse order, set order = {order} in [key_points]"
    ]


def _clock(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(T,) times [s] on a clock that increases from run to run, and the first and the last one of
    each row's run."""
    begin, end = np.empty((2, len(recording.t_s)))
    shifted, at = np.empty(len(recording.t_s)), 0.0
    for run in recording.runs:
        t_s = recording.t_s[run]
        shifted[run] = t_s - t_s[0] + at
        begin[run], end[run] = at, shifted[run][-1]
        at = float(shifted[run][-1]) + 1.0
    return shifted, begin, end
