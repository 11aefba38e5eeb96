"""Recordings as the tensors that arm models are fitted to and evaluated on."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch

from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.noise import known_noise
from surgisoft.measurement.recordings import Recording
from surgisoft.measurement.units import factor
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.history import History, pack

ACTUATIONS = ("measured", "commanded")
BAND_SHARE = (0.003, 0.02)
"""Least and largest half width of the direction's dead band, as shares of a chamber's range."""
BAND_NOISES = 4.0
"""Half width of the dead band in standard deviations of the pressure at rest."""


STILL_SHARE = 0.1
"""A chamber that moved less than this share of the widest range is scaled as if it had moved all of
it: its motion may be noise for the greater part."""
SIZES = 20.0
"""Factor by which the key points' extent and the arm's length differ when a unit is wrong."""
OUTSIDE_SHARE = 0.03
"""How far beyond the fitted range, as a share of it, an actuation may go without a note."""
SPEED_S = 0.25
"""Time over which the speed of the actuation is taken, s: noise of the pressure counts little."""
SPEED_QUANTILE = 0.95
"""Share of the rows in which the actuation moves more slowly than its speed."""
FASTER = 1.5
"""How many times as fast as in the training data an actuation may move without a note."""
IDLE_SHARE = 0.02
"""A chamber that moved no more than this share of the widest range is ignored as not moved."""
TOGETHER = 0.95
"""Correlation of two channels, or of one with a sum of all others, from which on recordings hardly
tell what each of them does [-]."""


def actuation_of(recording: Recording, actuation: str) -> np.ndarray:
    """(T, m) measured or commanded actuation, in the recording's unit."""
    if actuation not in ACTUATIONS:
        raise unknown_name("actuation", actuation, ACTUATIONS)
    if actuation == "measured":
        return recording.measured
    if recording.commanded is None:
        raise InputError(
            f"{recording.label}: no commanded actuation (columns c1_{recording.unit} ...), which a "
            "model of commanded actuation takes; add these columns, or fit a model with "
            "--actuation measured"
        )
    return recording.commanded


def history_of(recordings: list[Recording], actuation: str = "measured") -> History:
    """All runs of all recordings as one padded history.

    A continuous run begins where its first measured actuation says; one of steady-state points
    begins at rest, from where its first point was approached.
    """
    times, pressures, points, warmth, stood, predicted = [], [], [], [], [], []
    for recording in recordings:
        signal = actuation_of(recording, actuation)
        for run in recording.runs:
            times.append(torch.from_numpy(recording.t_s[run].copy()))
            pressures.append(torch.from_numpy(signal[run].copy()))
            points.append(torch.from_numpy(recording.key_points_mm[run].astype(np.float32)))
            first = torch.from_numpy(recording.measured[run.start].copy())
            settled = recording.kind == "settled"
            stood.append(torch.full_like(first, torch.nan) if settled else first)
            if recording.predicted_mm is not None:
                predicted.append(torch.from_numpy(recording.predicted_mm[run].copy()))
            room = recording.temp_C
            warmth.append(
                torch.full((len(times[-1]),), torch.nan)
                if room is None
                else torch.from_numpy(room[run].copy())
            )
    noise = np.max([actuation_noise(recording, actuation) for recording in recordings], axis=0)
    rooms = None if all(room.isnan().all() for room in warmth) else warmth
    known = predicted if len(predicted) == len(times) else None
    packed = pack(times, pressures, points, tuple(float(x) for x in noise), rooms, stood, known)
    return replace(packed, noise_mm=known_noise(recordings))


def actuation_noise(recording: Recording, actuation: str = "measured") -> np.ndarray:
    """(m,) standard deviation of the actuation at rest, in the recording's unit.

    Estimated from differences between neighbouring samples of equal command; without commands,
    from those differences that are small beside the chamber's range. Robust by the median.
    """
    signal = actuation_of(recording, actuation)
    noise = np.zeros(recording.chambers)
    if actuation == "commanded":
        return noise
    inside = np.diff(recording.run) == 0
    steps = np.diff(signal, axis=0)
    span = np.ptp(signal, axis=0)
    for chamber in range(recording.chambers):
        if recording.commanded is not None:
            rest = inside & (np.diff(recording.commanded[:, chamber]) == 0)
        else:
            rest = inside & (np.abs(steps[:, chamber]) < BAND_SHARE[1] * span[chamber])
        if rest.sum() >= 10:
            # 1.4826: from the median absolute deviation to the standard deviation (normal noise).
            noise[chamber] = 1.4826 * np.median(np.abs(steps[rest, chamber])) / np.sqrt(2)
    return noise


def arm_spec(recordings: list[Recording], actuation: str = "measured") -> ArmSpec:
    """The arm that the recordings were made on: ranges, dead bands, proportions."""
    signal = np.concatenate([actuation_of(recording, actuation) for recording in recordings])
    low, high = signal.min(0), signal.max(0)
    noise = np.max([actuation_noise(recording, actuation) for recording in recordings], axis=0)
    still = high - low <= IDLE_SHARE * (high - low).max()
    idle = [float(x) if s else None for x, s in zip(signal.mean(0), still, strict=True)]
    low, high = _with_room(low, high)
    span = high - low
    band = np.clip(BAND_NOISES * noise, BAND_SHARE[0] * span, BAND_SHARE[1] * span)
    first = recordings[0]
    return ArmSpec(
        chambers=first.chambers,
        key_points=first.key_points,
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        unit=first.unit,
        actuation=actuation,
        band=tuple(band.tolist()),
        idle=tuple(idle),
        length_mm=first.arm.length_mm,
        diameter_mm=first.arm.diameter_mm,
        gravity=None if first.gravity is None else tuple(first.gravity.tolist()),
        temperature_C=_mean_temperature(recordings),
        speed_per_s=speed_of(recordings, span, actuation),
    )


def speed_of(
    recordings: list[Recording], span: np.ndarray | tuple[float, ...], actuation: str = "measured"
) -> float:
    """How fast the actuation moves, as a share of its range in a second, 1/s.

    It is the `SPEED_QUANTILE` over all rows of the change within `SPEED_S`, of the chamber that
    moves most; 0 where recordings have steady states alone. span: (m,) range of each chamber, in
    the recordings' unit, 0 of one that rests.
    """
    ranges = np.asarray(span, float)
    own = np.where(ranges > 0.0, ranges, np.inf)
    runs = [
        (recording.t_s[run], actuation_of(recording, actuation)[run] / own)
        for recording in recordings
        if recording.kind != "settled"
        for run in recording.runs
    ]
    return speed_of_runs(runs)


def speed_of_runs(runs: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """The speed of `speed_of` of runs, each as its times (T,), s, and its actuation (T, m) as a
    share of its range."""
    found = [np.zeros(1)]
    for t_s, x in runs:
        later = np.searchsorted(t_s, t_s + SPEED_S)
        rows = np.flatnonzero(later < len(t_s))
        later = later[rows]
        moved = np.abs(x[later] - x[rows]).max(axis=1) / (t_s[later] - t_s[rows])
        found.append(moved)
    return float(np.quantile(np.concatenate(found), SPEED_QUANTILE))


def faster_in_words(came: float, known: float, there: str) -> str:
    """That an actuation moves faster than elsewhere, in words; empty unless `FASTER` times as fast.

    came, known: its speed here and there, 1/s; there: these recordings in words.
    """
    if came <= FASTER * known:
        return ""
    slow = f"and {there} have steady states alone"
    if known:
        slow = f"{came / known:.2g} times as fast as in {there}"
    percent = float(f"{100 * came:.2g}")
    return f"the actuation moves by {percent:g} % of its range in a second, {slow}"


def faster_than_fit(spec: ArmSpec, recordings: list[Recording]) -> list[str]:
    """A note where recordings move the arm faster than the training data of its model did."""
    if spec.speed_per_s is None:
        return []
    came = speed_of(recordings, spec.span, spec.actuation)
    faster = faster_in_words(came, spec.speed_per_s, "the recordings of the fit")
    if not faster:
        return []
    return [
        f"{faster}: the model may have lacked effects of speed from the start; fit it to motion as "
        "fast as this, too ('surgisoft diagnose' tells what has changed since the fit)"
    ]


def moved_together(actuation: np.ndarray) -> str:
    """Which channels of an actuation (T, m) hardly move apart from each other, in words; empty for
    none.

    Two channels whose correlation is at least `TOGETHER`, and channels of which each follows from a
    sum of the others as closely. Channels that hardly move are left aside.
    """
    spread = np.ptp(actuation, axis=0)
    live = np.flatnonzero(spread > IDLE_SHARE * spread.max(initial=0.0))
    if len(live) < 2:
        return ""
    r = np.corrcoef(actuation[:, live].T)
    parts, seen = [], set[int]()
    for i in range(len(live)):
        like = np.flatnonzero(np.abs(r[i]) >= TOGETHER)
        if i in seen or len(like) < 2:
            continue
        seen |= set(like.tolist())
        first, last = ", ".join(map(str, live[like[:-1]] + 1)), live[like[-1]] + 1
        each = r[i, like[1:]]
        how = "together" if each.min() > 0 else "against each other"
        how = how if len(like) == 2 else "together or against each other"
        least = each[np.abs(each).argmin()]
        parts.append(f"channels {first} and {last} move {how} (r = {least:.2f})")
    # 1 - R^2 of a channel on all others is one over its element of the inverse of all r.
    alone = 1.0 / np.diagonal(np.linalg.inv(r + 1e-6 * np.eye(len(live))))
    if not parts:
        summed = live[alone <= 1.0 - TOGETHER**2] + 1
        if len(summed) > 2:
            first, last = ", ".join(map(str, summed[:-1])), summed[-1]
            parts = [f"each of channels {first} and {last} follows from the others"]
    return ", ".join(parts)


def tied_channels(actuation: np.ndarray) -> int:
    """Number of moving channels of an actuation (T, m) that move as another one does (`TOGETHER`).

    Of three that move as one, two count: so many directions the actuation does not explore.
    """
    spread = np.ptp(actuation, axis=0)
    live = np.flatnonzero(spread > IDLE_SHARE * spread.max(initial=0.0))
    if len(live) < 2:
        return 0
    alike = np.abs(np.corrcoef(actuation[:, live].T)) >= TOGETHER
    return int(sum(alike[i, :i].any() for i in range(len(live))))


def _mean_temperature(recordings: list[Recording]) -> float | None:
    """Mean temperature of the room, degrees Celsius; None where no recording knows it."""
    known = [r.temp_C for r in recordings if r.temp_C is not None]
    room = np.concatenate(known) if known else np.zeros(0)
    room = room[np.isfinite(room)]
    return float(room.mean()) if len(room) else None


def outside_range(spec: ArmSpec, recordings: list[Recording]) -> list[str]:
    """A note for each chamber that recordings move where the model was not fitted."""
    signal = np.concatenate([actuation_of(recording, spec.actuation) for recording in recordings])
    notes = []
    for chamber in range(spec.chambers):
        came = (float(signal[:, chamber].min()), float(signal[:, chamber].max()))
        room = OUTSIDE_SHARE * spec.span[chamber]
        low, high = spec.low[chamber] - room, spec.high[chamber] + room
        what = f"range {spec.low[chamber]:.4g} to {spec.high[chamber]:.4g}"
        idle = spec.idle[chamber]
        if idle is not None:
            low, high = idle - room, idle + room
            what = f"place, where it stood still at {idle:.4g}"
        if came[0] < low or came[1] > high:
            notes.append(
                f"chamber {chamber + 1} goes from {came[0]:.4g} to {came[1]:.4g} {spec.unit}, "
                f"outside its fitted {what} {spec.unit}: errors there say little about the model"
            )
    return notes


def _with_room(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (m,) in which a chamber that hardly moved is as wide as the widest one.

    Its little motion is mostly noise: scaled to the full input range of a network it would be
    taken for signal.
    """
    span = high - low
    still = span < STILL_SHARE * span.max()
    middle = (high + low) / 2
    return (
        np.where(still, middle - span.max() / 2, low),
        np.where(still, middle + span.max() / 2, high),
    )


def check_fits(spec: ArmSpec, recordings: list[Recording], sized: bool = True) -> None:
    """Raise unless every recording has the model's chambers, key points, unit and size.

    sized: whether the size counts; a wrong unit of length is a fault that `diagnose` names.
    """
    for recording in recordings:
        for what, came, expected in (
            ("chambers", recording.chambers, spec.chambers),
            ("key points", recording.key_points, spec.key_points),
            ("actuation unit", recording.unit, spec.unit),
        ):
            if came != expected:
                advice = "use recordings of the arm that the model was fitted to"
                if what == "actuation unit" and factor(recording.unit, spec.unit) is not None:
                    advice = (
                        f"if the values are in {expected}, correct unit in [measured] and "
                        f"[commanded] of the map; if they are in {came}, add "
                        f'to = "{expected}" there, and import again'
                    )
                raise InputError(
                    f"{recording.label}: {what}: {came}, but the model has {expected}; {advice}"
                )
        extent = _extent_mm(recording.key_points_mm) if sized else float("nan")
        if spec.length_mm and (extent > SIZES * spec.length_mm or extent < spec.length_mm / SIZES):
            raise InputError(
                f"{recording.label}: its key points span {extent:.3g} mm, the model's arm is "
                f"{spec.length_mm:.3g} mm long; import them again in the right unit of length"
            )


def _extent_mm(points: np.ndarray) -> float:
    """Median distance, mm, between the first and last measured of the key points (N, n, 3); NaN."""
    seen = np.isfinite(points).all(2)
    measured = np.flatnonzero(seen.any(0))
    if len(measured) < 2:
        return float("nan")
    first, last = measured[0], measured[-1]
    both = seen[:, first] & seen[:, last]
    apart = np.linalg.norm(points[both, last] - points[both, first], axis=1)
    return float(np.median(apart)) if len(apart) else float("nan")
