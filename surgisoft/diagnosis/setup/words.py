"""Set-up faults in words, with their numbers."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from surgisoft.diagnosis.setup.alignment import Frame, angle
from surgisoft.diagnosis.setup.sample import Arrangement
from surgisoft.diagnosis.setup.search import LENGTH_MISTAKES, Fitted, Kind
from surgisoft.measurement.units import PLURAL
from surgisoft.units import MM_PER

NEAR_AXIS_RAD = 0.1
"""An axis of rotation is named x, y or z up to this angle, rad."""
LEAST_SHIFT_SD, LEAST_SHIFT_MM = 3.0, 0.5
"""Least shift of a turned frame that is reported as part of the fault: in standard errors, and in
mm."""
LEAST_HIDDEN_LAG_S = 0.01
"""Least lag within an offset of the clocks that is told, s."""
TIME_NAMES = {1e-3: "ms", 1e-6: "us"}
"""Names of units of time by their seconds."""


@dataclass(frozen=True)
class SetupFault:
    """One thing that is wrong with the set-up of a recording."""

    kind: str
    """`time_unit`, `chambers`, `actuation_unit`, `key_points`, `length_unit`, `frame`, `time`,
    `dead_chamber` or `dead_key_point`."""
    sentence: str
    """What is wrong, in words."""
    numbers: dict[str, float | list] = field(default_factory=dict)
    """Its numbers; the name of each ends with its unit."""
    errors: dict[str, float | list] = field(default_factory=dict)
    """Standard errors of those of the numbers that are estimated, by the same names."""


def signed_axes() -> np.ndarray:
    """(48, 3, 3) every permutation of the axes with every choice of signs."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            found.append(matrix)
    return np.array(found)


def faults_of(given: Fitted, frame: Frame, unit: str, mistake: tuple[str, str]) -> list[SetupFault]:
    """The faults of one explanation; frame: as it will be corrected; unit: of the model.

    mistake: the true unit of the actuation, and the unit that it was read as.
    """
    words = {
        "chambers": lambda: _chambers(given.hypothesis.arrangement),
        "actuation_unit": lambda: SetupFault(
            "actuation_unit",
            _unit("the actuation is", given.hypothesis.arrangement.factor, mistake, unit, "is"),
            {"factor": given.hypothesis.arrangement.factor},
        ),
        "key_points": lambda: _key_points(given.hypothesis.points),
        "length_unit": lambda: _length(given.hypothesis.mm_per_unit),
        "frame": lambda: frame_fault(given, frame),
        "time": lambda: _time(given),
    }
    kinds: tuple[Kind, ...] = given.hypothesis.kinds
    return [words[kind]() for kind in kinds]


def time_unit_fault(factor: float, true_s: float) -> SetupFault:
    """The fault that times are in another unit.

    factor: seconds in what the recording calls one; true_s: true time between rows [s].
    """
    unit = TIME_NAMES[min(factor, 1.0 / factor)]
    what = f"{1 / factor:,.0f} times too large: {unit} were read as s"
    if factor > 1.0:
        what = f"{factor:,.0f} times too small: s were read as {unit}"
    rows = f"one row each {true_s:.3g} s, where {true_s / factor:.3g} s is stated"
    return SetupFault("time_unit", f"the times are {what} ({rows})", {"s_per_recorded_s": factor})


def joined(faults: Sequence[SetupFault]) -> str:
    """The sentences of faults that hold together."""
    return "; ".join(fault.sentence for fault in faults)


def _chambers(arrangement: Arrangement) -> SetupFault:
    order, sign = arrangement.order, arrangement.sign
    parts = []
    if order != tuple(range(len(order))):
        listed = ", ".join(str(k + 1) for k in order)
        parts.append(
            f"the chambers are permuted: chambers {_numbers(range(len(order)))} are driven by "
            f"channels {listed}"
        )
    flipped = [k for k, s in enumerate(sign) if s < 0]
    if flipped:
        many = len(flipped) > 1
        parts.append(
            f"the sign{'s' * many} of chamber{'s' * many} {_numbers(flipped)} "
            f"{'are' if many else 'is'} flipped"
        )
    idle = [k for k, s in enumerate(sign) if s == 0]
    if idle:
        parts.append(
            f"chamber {_numbers(idle)} does not act: the body moves as if it stayed at rest"
        )
    return SetupFault(
        "chambers",
        "; ".join(parts),
        {"channel_of_chamber": [k + 1 for k in order], "sign": list(sign)},
    )


def _numbers(some) -> str:
    return ", ".join(str(k + 1) for k in some)


def _key_points(points: tuple[int, ...]) -> SetupFault:
    if points == tuple(range(len(points)))[::-1]:
        text = "the key points are in reverse order, tip to base"
    else:
        text = "the key points are permuted: base to tip they are " + ", ".join(
            f"k{k}" for k in points
        )
    return SetupFault("key_points", text, {"order": list(points)})


def _length(mm: float) -> SetupFault:
    mistake = next((pair for pair, by in LENGTH_MISTAKES.items() if by == mm), None)
    text = _unit("the positions are", mm, mistake, "mm", "are")
    return SetupFault("length_unit", text, {"mm_per_recorded_mm": mm})


def model_in_other_unit(factor: float) -> str:
    """That a model may return another unit of length; factor: mm in what it calls one."""
    unit = next((name for name, mm in MM_PER.items() if math.isclose(mm, factor)), None)
    if unit is not None:
        return f"the model returns {PLURAL.get(unit, unit)} where mm are expected"
    return f"the positions of the model are {_times(factor)}"


def _times(factor: float) -> str:
    """How much too large or too small values are that have to be multiplied by a factor."""
    return f"{1 / factor:.6g} times too large" if factor < 1.0 else f"{factor:.6g} times too small"


def _unit(what: str, factor: float, mistake: tuple[str, str] | None, unit: str, are: str) -> str:
    """A wrong unit in words; unit: the stated one; factor: of it in what the recording calls one.

    mistake: the true unit, and the one that the values were read as.
    """
    wrong = _times(factor)
    if mistake is None:
        return f"{what} {wrong}"
    true, read = (PLURAL.get(each, each) for each in mistake)
    if mistake[1] == unit:
        return f"{what} in {true} where {unit} {are} stated"
    converted = "" if mistake[0] == unit else f" and converted to {unit}"
    return f"{what} {wrong}: {true} were read as {read}{converted}"


def frame_fault(given: Fitted, frame: Frame) -> SetupFault:
    """The fault that the key points are in another frame; frame: as it will be corrected."""
    turn_sd, shift_sd = given.turn_and_shift_errors()
    rotation, scale = frame.rotation, float(frame.scale)
    shift = frame.shift / scale
    exact = _signed(rotation)
    numbers: dict[str, float | list] = {"rotation": rotation.tolist()}
    mirrored = np.linalg.det(rotation) < 0
    if mirrored:
        text = _mirrored(rotation) if exact else _mirrored_and_turned(rotation)
    else:
        turn = float(angle(rotation))
        numbers["turn_deg"] = float(np.degrees(turn))
        axis = _axis(rotation)
        numbers["axis"] = axis.tolist()
        text = f"turned by {np.degrees(turn):.1f} deg about {_axis_name(axis)}"
        if exact:
            text += f" (axes {_axes(rotation)})"
    turned = mirrored or numbers.get("turn_deg", 0.0) > max(1.0, 3 * np.degrees(turn_sd))
    far = np.abs(shift) > np.maximum(LEAST_SHIFT_SD * shift_sd, LEAST_SHIFT_MM)
    where = "(" + ", ".join(f"{v:.1f}" for v in shift) + ") mm"
    if not turned:
        text = f"shifted by {where}"
    elif far.any():
        text += f" and shifted by {where}"
    numbers["shift_mm"] = shift.tolist()
    errors = {"turn_deg": float(np.degrees(turn_sd)), "shift_mm": shift_sd.tolist()}
    return SetupFault("frame", f"the frame of the key points is {text}", numbers, errors)


def _signed(rotation: np.ndarray) -> bool:
    return bool(np.abs(rotation - np.round(rotation)).max() < 1e-9)


def _axis(rotation: np.ndarray) -> np.ndarray:
    vector = Rotation.from_matrix(rotation).as_rotvec()
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _axis_name(axis: np.ndarray) -> str:
    at = int(np.abs(axis).argmax())
    if np.arccos(min(abs(axis[at]), 1.0)) <= NEAR_AXIS_RAD:
        return ("-" if axis[at] < 0 else "") + "xyz"[at]
    return "(" + ", ".join(f"{v:.2f}" for v in axis) + ")"


def _axes(rotation: np.ndarray) -> str:
    """What the recorded x, y and z truly are, of a signed permutation."""
    rows = [(int(np.abs(row).argmax()), row.sum() < 0) for row in np.round(rotation)]
    return "x y z are " + " ".join(("-" if minus else "") + "xyz"[axis] for axis, minus in rows)


def _mirrored(rotation: np.ndarray) -> str:
    whole = np.round(rotation)
    if np.abs(whole - np.diag(np.diag(whole))).max() < 0.5:
        axes = ["xyz"[k] for k in range(3) if whole[k, k] < 0]
        return f"mirrored: the sign of {' and '.join(axes)} is wrong"
    if (whole >= 0).all():
        moved = ["xyz"[k] for k in range(3) if whole[k, k] < 0.5]
        return f"mirrored: the axes {' and '.join(moved)} are swapped"
    return f"mirrored: the axes {_axes(whole)}"


def _mirrored_and_turned(rotation: np.ndarray) -> str:
    """A mirrored frame as a mirrored x axis and a turn."""
    turn = rotation @ np.diag([-1.0, 1.0, 1.0])
    axis = _axis(turn)
    return (
        f"mirrored (the sign of one axis is wrong; with x as that axis it is also turned by "
        f"{np.degrees(float(angle(turn))):.1f} deg about {_axis_name(axis)})"
    )


def _time(given: Fitted) -> SetupFault:
    late, spread = given.hypothesis.later_s, given.later_sd_s
    how = "late" if late > 0 else "early"
    text = (
        f"the key points are {abs(late):.3f} +- {spread:.3f} s {how} relative to the actuation: "
        "their clocks are apart"
    )
    lag, likelier = given.hidden_lag_s, given.likelier_lag_s
    numbers: dict[str, float | list] = {"late_s": late, "hidden_lag_s": lag}
    better = ""
    if likelier:
        beside = given.likelier_later_s
        numbers |= {"likelier_lag_s": likelier, "likelier_late_s": beside}
        better = (
            f"{abs(beside):.2f} s {'late' if beside > 0 else 'early'} and a lag that has grown by "
            f"{likelier:.2f} s since the fit leave less error; "
        )
    if lag >= LEAST_HIDDEN_LAG_S:
        text += (
            f" ({better}a lag that has changed by up to {lag:.2f} s would look the same: to "
            "tell them apart, start both logs by one trigger)"
        )
    return SetupFault("time", text, numbers, {"late_s": spread})
