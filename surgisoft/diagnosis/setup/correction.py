"""The correction of a set-up: applied to a recording, or as the lines of an import's map."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tomli_w

from surgisoft.diagnosis.setup.channels import frozen_points
from surgisoft.diagnosis.setup.sample import Arrangement
from surgisoft.diagnosis.weight import SAME_DEG, angle_deg
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import AlarmInfo, Recording
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.measurement.recordings.quality import without_frozen
from surgisoft.measurement.units import SECONDS_PER

LEAST_ALIKE = 0.05
"""Least gain of the correlation with the corrected measurement for which a command is corrected
too [-]."""
ORIGIN_DIGITS = 4
"""Digits behind the point of an origin in mm in a map; one in a larger unit has more."""
ROUNDED = 6
"""Digits behind the point of a rotation in a map."""


@dataclass(frozen=True, eq=False)
class Correction:
    """Correction of recordings of a faulty set-up."""

    arrangement: Arrangement
    """Which recorded channel drives each chamber, in which unit."""
    points: tuple[int, ...]
    """(n,) recorded key point of each true one, from 0."""
    unit: str
    """Unit of actuation that the model is in."""
    recorded_unit: str
    """Unit of actuation that the recording is truly in; the model's unit where no unit, but only
    the factor of the arrangement corrects it."""
    mm_per_unit: float = 1.0
    """Millimetres in what the recording calls one."""
    rotation: np.ndarray | None = None
    """(3, 3) true axes in the recorded frame; determinant -1 where it is mirrored. None: right."""
    origin_mm: np.ndarray | None = None
    """(3,) true origin in the recorded frame, mm. None: right."""
    time_factor: float = 1.0
    """Seconds in what the recording calls one."""
    delay_s: float = 0.0
    """Delay of the actuation's log, s: what it records at t was true at t - delay_s."""
    from_command: tuple[int, ...] = ()
    """Recorded channels that are dead, in whose place the command is taken, from 0."""
    lost: tuple[int, ...] = ()
    """Recorded key points that are dead: they become missing."""
    stale: tuple[int, ...] = ()
    """Recorded key points that are frozen in some rows: they become missing there."""
    frozen: bool = False
    """Whether a channel is frozen in some rows: these are left out."""
    gravity: tuple[float, float, float] | None = None
    """(3,) unit vector along the weight where the model was fitted, true axes; None: unknown."""

    def applied(self, recording: Recording) -> Recording:
        """The corrected recording; rows that a shifted clock does not reach are left out."""
        if self.stale:
            lost = frozen_points(recording)
            lost[:, [k for k in range(recording.key_points) if k not in self.stale]] = False
            points = np.where(lost[..., None], np.nan, recording.key_points_mm)
            recording = replace(recording, key_points_mm=points)
        if self.frozen:
            recording, _ = without_frozen(recording)
        measured, commanded = recording.measured, recording.commanded
        if self.from_command:
            if commanded is None:
                raise InputError(
                    f"{recording.label}: no commanded actuation (columns c1_{recording.unit} ...), "
                    "expected one to replace a dead channel; record again"
                )
            measured = measured.copy()
            measured[:, list(self.from_command)] = commanded[:, list(self.from_command)]
        corrected = self.arrangement.of(measured)
        if commanded is not None:
            commanded = self._commanded(commanded, corrected)
        fresh = replace(
            recording,
            measured=corrected,
            commanded=commanded,
            key_points_mm=self._points(recording.key_points_mm),
            gravity=self._gravity(recording.gravity),
            unit=self.unit,
            source=None,
        )
        if self.time_factor != 1.0:
            fresh = _in_time(fresh, self.time_factor)
        return self._on_time(fresh) if self.delay_s else fresh

    def _commanded(self, commanded: np.ndarray, corrected: np.ndarray) -> np.ndarray:
        """The command corrected like the measurement where it then follows it better."""
        like = self.arrangement.of(commanded)
        better = _correlation(like, corrected) - _correlation(commanded, corrected)
        same_unit = self.arrangement.factor != 1.0 and np.ptp(commanded) < np.ptp(corrected) / 2
        too_large = self.arrangement.factor < 1.0 and np.ptp(commanded) > 2 * np.ptp(corrected)
        return like if better > LEAST_ALIKE or same_unit or too_large else commanded

    def _points(self, points: np.ndarray) -> np.ndarray:
        """(T, n, 3) true key points from the recorded ones, mm."""
        points = points.copy()
        points[:, list(self.lost)] = np.nan
        points = self.mm_per_unit * points[:, list(self.points)]
        if self.origin_mm is not None:
            points = points - self.origin_mm
        return points if self.rotation is None else points @ self.rotation.T

    def _gravity(self, stated: np.ndarray | None) -> np.ndarray | None:
        """(3,) unit vector along the weight, true axes, from the one that a recording states.

        It is stated in the recorded frame, like the key points. A direction that is that of the
        model as it stands, and would not be if it were turned, was stated in the true frame.
        """
        if stated is None or self.rotation is None:
            return stated
        turned = self.rotation @ stated
        model = self.gravity
        if model is not None and angle_deg(model, stated) <= SAME_DEG < angle_deg(model, turned):
            return stated
        return turned

    def _on_time(self, recording: Recording) -> Recording:
        """Each row with the actuation that the log has at t + delay_s."""
        measured, keep = recording.measured.copy(), np.zeros(recording.samples, bool)
        commanded = None if recording.commanded is None else recording.commanded.copy()
        for run in recording.runs:
            t_s = recording.t_s[run]
            at = t_s + self.delay_s
            keep[run] = (at >= t_s[0] - 1e-9) & (at <= t_s[-1] + 1e-9)
            for k in range(recording.chambers):
                measured[run, k] = np.interp(at, t_s, recording.measured[run, k])
            if commanded is not None and recording.commanded is not None:
                held = np.clip(np.searchsorted(t_s, at + 1e-9) - 1, 0, len(t_s) - 1)
                commanded[run] = recording.commanded[run][held]
        if not keep.any():
            raise InputError(
                f"{recording.label}: every run is shorter than the offset of the clocks, "
                f"{abs(self.delay_s):.3g} s; record longer runs"
            )
        whole = replace(recording, measured=measured, commanded=commanded)
        return _rows(whole, keep)

    def tables(self, commanded: bool = True) -> dict[str, dict[str, Any]]:
        """Fields of a map by which `import` corrects the recording as it reads it.

        commanded: whether the recording has a command.
        """
        given = self.arrangement
        time: dict[str, Any] = {}
        if self.time_factor != 1.0:
            unit = next((u for u, s in SECONDS_PER.items() if s == self.time_factor), None)
            time = {"column": "t_s"} | ({"unit": unit} if unit else {"scale": self.time_factor})
        measured: dict[str, Any] = {}
        moved = given.order != tuple(range(len(given.order)))
        another = self.recorded_unit != self.unit
        if moved or self.from_command or another:
            # Columns that are found by their names have the unit that their names state.
            measured["columns"] = [
                f"{'c' if k in self.from_command else 'p'}{k + 1}_{self.unit}" for k in given.order
            ]
            measured["unit"] = self.recorded_unit
        scale = given.sign if another else tuple(float(gain) for gain in given.gain)
        if any(by != 1.0 for by in scale):
            measured["scale"] = list(scale)
        if another:
            measured["to"] = self.unit
        if self.delay_s:
            measured["delay_s"] = round(self.delay_s, 4)
        key_points: dict[str, Any] = {}
        if self.lost:
            key_points["lost"] = list(self.lost)
        if self.stale:
            key_points["repeated"] = "missing"
        if self.points != tuple(range(len(self.points))):
            key_points["order"] = list(self.points)
        if self.mm_per_unit != 1.0:
            unit = next((u for u, mm in MM_PER.items() if mm == self.mm_per_unit), None)
            key_points |= {"unit": unit} if unit else {"scale": self.mm_per_unit}
        frame: dict[str, Any] = {}
        if self.origin_mm is not None:
            digits = ORIGIN_DIGITS + max(0, math.ceil(math.log10(self.mm_per_unit)))
            frame["origin"] = [round(float(v) / self.mm_per_unit, digits) for v in self.origin_mm]
        if self.rotation is not None:
            frame["rotation"] = _rotation(self.rotation)
            if np.linalg.det(self.rotation) < 0:
                frame["mirror"] = True
        command = {"delay_s": measured["delay_s"]} if self.delay_s and commanded else {}
        tables = {
            "time": time,
            "measured": measured,
            "commanded": command,
            "key_points": key_points,
            "frame": frame,
            "rows": {"frozen": "drop"} if self.frozen else {},
        }
        return {name: table for name, table in tables.items() if table}

    def lines(self, commanded: bool = True) -> str:
        """The fields of `tables` as the lines of a map."""
        parts = []
        for name, table in self.tables(commanded).items():
            fields = [f"{key} = {_plain(value)}" for key, value in table.items()]
            parts.append("\n".join([f"[{name}]", *fields]))
        return "\n".join(parts)


def _plain(value: Any) -> str:
    """A TOML value on one line."""
    if isinstance(value, list):
        return "[" + ", ".join(_plain(item) for item in value) + "]"
    return tomli_w.dumps({"v": value}).partition(" = ")[2].strip()


def _rotation(rotation: np.ndarray) -> str | list[list[float]]:
    """A rotation as a map states it: signed axes where it is exact, else rows."""
    whole = np.round(rotation)
    if np.abs(rotation - whole).max() < 1e-9:
        rows = [(int(np.abs(row).argmax()), row.sum() < 0) for row in whole]
        return " ".join(("-" if minus else "") + "xyz"[axis] for axis, minus in rows)
    return [[round(float(v), ROUNDED) for v in row] for row in rotation]


def _in_time(recording: Recording, factor: float) -> Recording:
    """The recording with times so many times as long."""
    alarm = recording.alarm
    if alarm is not None:
        alarm = AlarmInfo(alarm.raised_s * factor, alarm.since_s * factor)
    return replace(recording, t_s=recording.t_s * factor, alarm=alarm)


def _rows(recording: Recording, keep: np.ndarray) -> Recording:
    """The recording's rows that a mask (T,) keeps."""
    names = ("t_s", "measured", "commanded", "key_points_mm", "run", "temp_C", "payload_g")
    values = {name: getattr(recording, name) for name in (*names, "predicted_mm")}
    return replace(recording, **{k: v[keep] for k, v in values.items() if v is not None})


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Mean correlation of the columns (T, m) that move in both."""
    a, b = first - first.mean(0), second - second.mean(0)
    size = np.sqrt((a**2).sum(0) * (b**2).sum(0))
    moves = size > 1e-9
    return float(np.mean((a * b).sum(0)[moves] / size[moves])) if moves.any() else 0.0
