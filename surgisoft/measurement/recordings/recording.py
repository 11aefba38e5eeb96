"""A recording in memory, and the checks that every recording passes.

Times, actuation and run ids have no missing values; a key point is either known in x, y and z or
missing (NaN) as a whole.
"""

import itertools
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np

from surgisoft.config import POSITIVE, Rule
from surgisoft.errors import InputError, counted

KINDS = ("continuous", "settled")
"""Kinds of recordings and protocols: samples at a rate, or steady-state averages."""

NOT_NEGATIVE = Rule("a number >= 0", lambda value: value >= 0)
"""For standard deviations."""

UNIT_TOLERANCE = 0.01
"""Largest accepted deviation from 1 of the length of gravity's direction."""


@dataclass(frozen=True)
class ArmInfo:
    """The arm's size, where the lab stated it."""

    length_mm: Annotated[float, POSITIVE] | None = None
    """Length of the arm at rest [mm]."""
    diameter_mm: Annotated[float, POSITIVE] | None = None
    """Outer diameter of the arm [mm]."""


@dataclass(frozen=True)
class AlarmInfo:
    """The first alarm of the run that was recorded (`surgisoft run`): the model no longer held."""

    raised_s: float
    """Time of the recording at which it was raised [s]."""
    since_s: float
    """Estimated time of the change [s]."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One table of measurements: T samples of m actuation channels and n key points."""

    name: str
    """What messages and reports call it; the file's stem where it came from a file."""
    t_s: np.ndarray
    """(T,) float64, time since the start of the recording [s], strictly increasing inside a run."""
    measured: np.ndarray
    """(T, m) float64, measured actuation [`unit`]."""
    key_points_mm: np.ndarray
    """(T, n, 3) float64, key points base to tip, arm base frame [mm]; NaN where missing."""
    commanded: np.ndarray | None = None
    """(T, m) float64, commanded actuation [`unit`]."""
    run: np.ndarray = None  # type: ignore[assignment]  # always an array once constructed
    """(T,) int64 id of each sample's run, equal ids in one block; left out, one run with id 0."""
    unit: str = "kPa"
    """Unit of the actuation: the suffix of the table's columns."""
    temp_C: np.ndarray | None = None
    """(T,) float64 temperature [degrees Celsius], NaN where missing."""
    payload_g: np.ndarray | None = None
    """(T,) float64 mass attached to the arm [g], NaN where missing."""
    arm: ArmInfo = field(default_factory=ArmInfo)
    """The arm's size."""
    gravity: np.ndarray | None = None
    """(3,) unit vector along the weight, arm base frame."""
    kind: str = "continuous"
    """"continuous", or "settled" where each sample is one steady-state average."""
    noise_mm: float | None = None
    """Standard deviation of a key point's coordinate as the lab knows it [mm]."""
    note: str = ""
    """Free text, for people."""
    alarm: AlarmInfo | None = None
    """The alarm of the run that was recorded; None where none was raised."""
    source: Path | None = None
    """The file that it was read from."""
    predicted_mm: np.ndarray | None = None
    """(T, n, 3) float64, what a model in question predicts in these rows, arm base frame [mm]; not
    saved with the recording."""

    def __post_init__(self) -> None:
        run = np.zeros(np.shape(self.t_s), np.int64) if self.run is None else self.run
        points = _with_whole_key_points(np.asarray(self.key_points_mm, np.float64))
        object.__setattr__(self, "run", np.asarray(run, np.int64))
        object.__setattr__(self, "key_points_mm", points)
        for name in (
            "t_s",
            "measured",
            "commanded",
            "temp_C",
            "payload_g",
            "gravity",
            "predicted_mm",
        ):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        if self.gravity is not None:
            object.__setattr__(self, "gravity", with_unit_length(self.gravity))
        _check(self)

    @property
    def samples(self) -> int:
        """Number of samples T."""
        return len(self.t_s)

    @property
    def chambers(self) -> int:
        """Number of actuation channels m."""
        return self.measured.shape[1]

    @property
    def key_points(self) -> int:
        """Number of key points n."""
        return self.key_points_mm.shape[1]

    @cached_property
    def runs(self) -> list[slice]:
        """The samples of each run, in order."""
        edges = [0, *(np.flatnonzero(np.diff(self.run)) + 1).tolist(), self.samples]
        return [slice(a, b) for a, b in itertools.pairwise(edges)]

    @cached_property
    def actuation_ranges(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Measured and commanded actuation (T, m) as far as known, each with its ranges (m,)."""
        known = [values for values in (self.measured, self.commanded) if values is not None]
        return [(values, np.ptp(values, axis=0)) for values in known if len(values)]

    @property
    def label(self) -> str:
        """Name of the recording in error messages: the file, where there is one."""
        return str(self.source) if self.source else f"recording '{self.name}'"


def _with_whole_key_points(points: np.ndarray) -> np.ndarray:
    """The key points (T, n, 3) with a partly missing one missing as a whole."""
    missing = np.isnan(points)
    if not missing.any():
        return points
    partly = missing.any(axis=-1) & ~missing.all(axis=-1)
    return np.where(partly[..., None], np.nan, points) if partly.any() else points


def with_unit_length(vector: np.ndarray) -> np.ndarray:
    """The direction (3,) at length 1, where its length is 1 within the tolerance; else as it is."""
    off = abs(np.linalg.norm(vector) - 1)
    return vector / np.linalg.norm(vector) if 1e-12 < off <= UNIT_TOLERANCE else vector


def _check(recording: Recording) -> None:
    _check_shapes(recording)
    _check_values(recording)
    _check_sidecar_values(recording)


def _fail(recording: Recording, message: str) -> None:
    raise InputError(f"{recording.label}: {message}")


def _check_shapes(recording: Recording) -> None:
    samples = len(recording.t_s) if recording.t_s.ndim == 1 else -1
    if samples < 1:
        _fail(recording, f"times have shape {recording.t_s.shape}, expected (T,) with T >= 1")
    if recording.measured.ndim != 2 or recording.measured.shape[1] < 1:
        shape = recording.measured.shape
        _fail(recording, f"measured actuation has shape {shape}, expected (T, m) with m >= 1")
    shape = recording.key_points_mm.shape
    if len(shape) != 3 or shape[1] < 1 or shape[2] != 3:
        _fail(recording, f"key points have shape {shape}, expected (T, n, 3) with n >= 1")
    expected = {
        "measured": (samples, recording.chambers),
        "commanded": (samples, recording.chambers),
        "key_points_mm": (samples, recording.key_points, 3),
        "run": (samples,),
        "temp_C": (samples,),
        "payload_g": (samples,),
        "gravity": (3,),
        "predicted_mm": (samples, recording.key_points, 3),
    }
    for name, wanted in expected.items():
        array = getattr(recording, name)
        if array is not None and array.shape != wanted:
            _fail(recording, f"{name} has shape {array.shape}, expected {wanted}")


def _check_values(recording: Recording) -> None:
    for name in ("t_s", "measured", "commanded", "predicted_mm"):
        array = getattr(recording, name)
        if array is not None and not np.isfinite(array).all():
            row = int(np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))[0])
            _fail(recording, f"{name} of sample {row} is not finite; leave such samples out")
    for name in ("key_points_mm", "temp_C", "payload_g"):
        array = getattr(recording, name)
        if array is not None and np.isinf(array).any():
            row = int(np.argwhere(np.isinf(array))[0][0])
            _fail(recording, f"{name} of sample {row} is infinite; NaN means missing")
    back = first_time_backwards(recording.t_s, recording.run)
    if back is not None:
        before, now = recording.t_s[back - 1], recording.t_s[back]
        _fail(recording, f"time of sample {back} is {now} s after {before} s, expected an increase")
    again = first_run_again(recording.run)
    if again is not None:
        _fail(
            recording,
            f"run {recording.run[again]} appears again at sample {again}, after another run",
        )


def _check_sidecar_values(recording: Recording) -> None:
    if recording.kind not in KINDS:
        _fail(recording, f"kind is '{recording.kind}', expected one of {', '.join(KINDS)}")
    if recording.gravity is not None and abs(np.linalg.norm(recording.gravity) - 1) > 1e-6:
        _fail(recording, f"gravity is {recording.gravity.tolist()}, expected a unit vector")
    sizes = {"length_mm": recording.arm.length_mm, "diameter_mm": recording.arm.diameter_mm}
    for name, value in sizes.items():
        if value is not None and not (np.isfinite(value) and value > 0):
            _fail(recording, f"{name} is {value}, expected a positive number")
    alarm = recording.alarm
    if alarm is not None and not np.isfinite([alarm.raised_s, alarm.since_s]).all():
        _fail(recording, f"alarm at {alarm.raised_s} s since {alarm.since_s} s, expected times")
    noise = recording.noise_mm
    if noise is not None and not (np.isfinite(noise) and noise >= 0):
        _fail(recording, f"noise_mm is {noise}, expected a number >= 0")


def first_time_backwards(t_s: np.ndarray, run: np.ndarray) -> int | None:
    """Index of the first sample that is not later than the one before it in its run.

    t_s: (T,) [s]; run: (T,) ids.
    """
    bad = np.flatnonzero((np.diff(t_s) <= 0) & (np.diff(run) == 0))
    return int(bad[0]) + 1 if len(bad) else None


def usable_samples(
    t_s: np.ndarray, run: np.ndarray, measured: np.ndarray, commanded: np.ndarray | None
) -> np.ndarray:
    """(T,) bool: the samples of a bench that a recording can have.

    Those whose actuation is known and whose time is later than that of every usable one before it
    in its run; a pressure sensor may be silent for a moment, and a clock may repeat a time. t_s:
    (T,) [s]; run: (T,) ids; measured, commanded: (T, m).
    """
    usable = np.isfinite(t_s) & np.isfinite(measured).all(axis=1)
    if commanded is not None:
        usable &= np.isfinite(commanded).all(axis=1)
    kept = np.flatnonzero(usable)
    if first_time_backwards(t_s[kept], run[kept]) is None:
        return usable
    latest: dict[int, float] = {}
    for k in kept.tolist():
        usable[k] = t_s[k] > latest.get(int(run[k]), -np.inf)
        if usable[k]:
            latest[int(run[k])] = float(t_s[k])
    return usable


def left_out(count: int) -> str:
    """What is said about so many samples that are not usable, see `usable_samples`."""
    return (
        f"{counted(count, 'sample')} left out: without a pressure, or with a time that is not "
        "later than the one before"
    )


def first_run_again(run: np.ndarray) -> int | None:
    """Index of the first sample where a run's id (T,) appears again after another run."""
    starts = np.flatnonzero(np.diff(run, prepend=run[0] - 1) != 0)
    seen: set[int] = set()
    for start in starts.tolist():
        if int(run[start]) in seen:
            return start
        seen.add(int(run[start]))
    return None


def check_same_arm(recordings: list[Recording]) -> None:
    """Raise where the recordings differ in channels, key points or unit of the actuation."""
    for other in recordings[1:]:
        first = recordings[0]
        for what, a, b in (
            ("actuation channels", first.chambers, other.chambers),
            ("key points", first.key_points, other.key_points),
            ("as unit of the actuation", first.unit, other.unit),
        ):
            if a != b:
                raise InputError(
                    f"{other.label} has {b} {what}, expected {a} as in {first.label}; "
                    "recordings of one arm belong together"
                )


def check_rows(recordings: list[Recording], least: int, purpose: str) -> None:
    """Raise where the recordings together have fewer samples than `purpose` needs."""
    rows = sum(recording.samples for recording in recordings)
    if rows < least:
        names = ", ".join(recording.label for recording in recordings) or "no recording"
        raise InputError(f"{names}: {rows} rows, expected at least {least} to {purpose}")
