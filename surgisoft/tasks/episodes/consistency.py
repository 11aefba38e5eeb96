"""Whether the arrays of an episode's log fit each other.

A log that was recorded does. One from a damaged or edited file may not, and what draws it or
reports it relies on the shapes, types and indices that `EpisodeLog` and its parts state.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from surgisoft.tasks.episodes.log import EpisodeLog
from surgisoft.tasks.episodes.parts import (
    LEVELS,
    ROLES,
    TOOLS,
    ArmLog,
    BeamLog,
    BodyLog,
    CameraLog,
    DoseLog,
    Event,
)

Shape = tuple[int | str, ...]
"""Sizes of an array; a letter stands for one size, the same wherever it stands in one part."""

SHAPES: dict[type, dict[str, tuple[Shape, str]]] = {
    EpisodeLog: {
        "time_s": (("T",), "f"),
        "targets_mm": (("T", "k", 3), "f"),
        "actuals_mm": (("T", "k", 3), "f"),
        "path_mm": (("M", 3), "f"),
        "path_starts": (("J",), "i"),
        "path_closed": (("J",), "b"),
        "clearance_mm": (("T",), "f"),
    },
    ArmLog: {
        "command_kPa": (("T", "m"), "f"),
        "pressure_kPa": (("T", "m"), "f"),
        "action_kPa": (("T", "m"), "f"),
        "points_mm": (("T", "n", 3), "f"),
        "seen_mm": (("T", "n", 3), "f"),
        "line_mm": (("T", "K", 3), "f"),
        "tip_direction": (("T", 3), "f"),
        "mount": ((4, 4), "f"),
    },
    BeamLog: {
        "power_w": (("T",), "f"),
        "end_mm": (("T", 3), "f"),
        "hits_organ": (("T",), "b"),
    },
    CameraLog: {},
    DoseLog: {
        "points_mm": (("P", 3), "f"),
        "normals": (("P", 3), "f"),
        "areas_mm2": (("P",), "f"),
        "faces": (("P",), "i"),
        "offset_mm": (("P",), "f"),
        "station": (("P",), "i"),
        "zone": (("P",), "i"),
        "rows": (("S",), "i"),
        "starts": (("S1",), "i"),
        "sample": (("C",), "i"),
        "dose_j_per_mm2": (("C",), "f"),
    },
    BodyLog: {
        "vertices_mm": (("V", 3), "f"),
        "faces": (("F", 3), "i"),
        "motion": (("T", 4, 4), "f"),
    },
    Event: {},
}
"""Shape and kind (floating point, integer, truth value) of every array of a log and its parts."""

TEXTS = {
    EpisodeLog: ("task", "policy", "on"),
    ArmLog: ("tool",),
    DoseLog: ("body",),
    BodyLog: ("name", "role"),
    Event: ("level", "text"),
}
"""Fields that are texts."""
NUMBERS = {
    EpisodeLog: ("dt_s",),
    ArmLog: ("radius_mm", "shaft_mm"),
    CameraLog: ("fov_rad",),
    DoseLog: ("ring_length_mm", "threshold_j_per_mm2", "cut_j_per_mm2"),
    Event: ("time_s",),
}
"""Fields that are finite numbers."""
INTEGERS = {EpisodeLog: ("seed", "episode"), DoseLog: ("stations",)}
"""Fields that are integers."""
FINITE = {
    EpisodeLog: ("time_s", "path_mm"),
    ArmLog: ("mount",),
    BodyLog: ("vertices_mm", "motion"),
    DoseLog: ("points_mm", "normals", "areas_mm2", "offset_mm", "dose_j_per_mm2"),
}
"""Arrays without NaN; the other ones have it where something does not apply or has failed."""
LARGEST_MM = 1e6
"""A place or length of this size is none of a scene, mm."""


@dataclass
class _Sizes:
    """Sizes of one part, by their letters; the number of rows T is the log's."""

    known: dict[str, int] = field(default_factory=dict)

    def wrong(self, array: np.ndarray, shape: Shape) -> bool:
        """Whether an array has another shape than stated or than the arrays before it."""
        if array.ndim != len(shape):
            return True
        for size, stated in zip(array.shape, shape, strict=True):
            expected = self.known.setdefault(stated, size) if isinstance(stated, str) else stated
            if size != expected:
                return True
        return False


def contradiction(log: EpisodeLog) -> str | None:
    """Contradiction within a log, in words; None if its parts fit each other."""
    time = log.time_s
    if not isinstance(time, np.ndarray) or time.ndim != 1 or not len(time):
        return "it has no rows"
    return next(_contradictions(log, len(time)), None)


def _contradictions(log: EpisodeLog, rows: int):
    yield from _of_part("the log", log, rows)
    if not (log.dt_s > 0.0 and np.all(np.diff(log.time_s) > 0.0)):
        yield "its times do not rise"
    if not (log.targets_mm.shape == log.actuals_mm.shape and log.targets_mm.shape[1]):
        yield "its targets and actual places do not belong together"
    if not isinstance(log.agents, tuple) or not all(name in log.arms for name in log.agents):
        yield "its agents are none of its arms"
    if not log.arms:
        yield "it has no arms"
    if (log.path_starts is None) != (log.path_closed is None):
        yield "its paths have no beginnings or no ends"
    elif log.path_starts is not None:
        starts = log.path_starts
        if (
            not len(starts)
            or starts[0] != 0
            or (np.diff(starts, append=len(log.path_mm)) < 1).any()
        ):
            yield "its paths do not begin one after the other"
    for name, arm in log.arms.items():
        yield from _of_part(f"arm '{name}'", arm, rows)
        if min(arm.points_mm.shape[1], arm.line_mm.shape[1] - 2, arm.command_kPa.shape[1]) < 1:
            yield f"arm '{name}' has no body"
        if arm.tool not in ("", *TOOLS):
            yield f"arm '{name}' has an unknown tool '{arm.tool}'"
        if not (0.0 < arm.radius_mm < LARGEST_MM and 0.0 <= arm.shaft_mm < LARGEST_MM):
            yield f"arm '{name}' has a radius or a shaft of an impossible size"
    yield from _numbers_by_name("measures", log.measures, rows)
    yield from _not_a_table("rewards", log.rewards)
    for agent, terms in log.rewards.items():
        yield from _numbers_by_name(f"rewards of '{agent}'", terms, rows)
    if not _is_table(log.limits) or not all(map(_is_finite, log.limits.values())):
        yield "its limits are not numbers"
    elif log.limits and "clearance_mm" not in log.limits:
        yield "its limits lack the one of the clearance"
    for parts, what in ((log.beams, "beam"), (log.cameras, "camera"), (log.views, "view")):
        yield from _not_a_table(f"{what}s", parts)
        for name in parts:
            if name not in log.arms:
                yield f"it has a {what} without the arm '{name}'"
    for name, beam in log.beams.items():
        yield from _of_part(f"the beam of '{name}'", beam, rows)
    yield from _numbers_by_name("views", log.views, rows)
    if log.views and "view_fraction" not in log.limits:
        yield "it has a view without its limit"
    for camera in log.cameras.values():
        yield from _of_camera(camera)
    names = [body.name for body in log.bodies]
    for body in log.bodies:
        yield from _of_part(f"body '{body.name}'", body, rows)
        yield from _of_body(body)
    if len(set(names)) < len(names):
        yield "two of its bodies have one name"
    if log.dose is not None:
        yield from _of_part("the dose", log.dose, rows)
        yield from _of_dose(log.dose, rows)
        organ = next((body for body in log.bodies if body.name == log.dose.body), None)
        if organ is None:
            yield "it has a dose on a body that is not in it"
        elif log.dose.faces.max(initial=-1) >= len(organ.faces):
            yield "its dose is on faces that its organ does not have"
    for event in log.events:
        yield from _of_part("an event", event, rows)
        if event.level not in LEVELS:
            yield f"it has an event of an unknown level '{event.level}'"


def _of_part(name: str, part: Any, rows: int):
    """What is wrong with the shapes and types of one dataclass of a log."""
    kind, sizes = type(part), _Sizes({"T": rows})
    for one in fields(part) if is_dataclass(part) else ():
        value, stated = getattr(part, one.name), SHAPES[kind].get(one.name)
        if stated is None or (value is None and one.default is None):
            continue
        shape, letter = stated
        if not isinstance(value, np.ndarray):
            yield f"'{one.name}' of {name} is not an array"
        elif value.dtype.kind != letter:
            yield f"'{one.name}' of {name} holds {value.dtype}"
        elif sizes.wrong(value, shape):
            expected = ", ".join(str(sizes.known.get(str(size), size)) for size in shape)
            yield f"'{one.name}' of {name} has shape {value.shape}, expected ({expected})"
        elif one.name in FINITE.get(kind, ()) and not np.isfinite(value).all():
            yield f"'{one.name}' of {name} holds NaN or infinite numbers"
        elif letter == "f" and "mm" in one.name and np.any(np.abs(value) > LARGEST_MM):
            yield f"'{one.name}' of {name} holds lengths of an impossible size"
        elif letter == "f" and np.isinf(value).any() and kind is not EpisodeLog:
            yield f"'{one.name}' of {name} holds infinite numbers"
    for text in TEXTS.get(kind, ()):
        if not isinstance(getattr(part, text), str):
            yield f"'{text}' of {name} is not a text"
    for number in NUMBERS.get(kind, ()):
        if not _is_finite(getattr(part, number)):
            yield f"'{number}' of {name} is not a number"
    for integer in INTEGERS.get(kind, ()):
        if type(getattr(part, integer)) is not int:
            yield f"'{integer}' of {name} is not an integer"


def _of_camera(camera: CameraLog):
    near_far = camera.range_mm
    if not (isinstance(near_far, tuple) and len(near_far) == 2 and all(map(_is_finite, near_far))):
        yield "the camera's range is not a pair of numbers"
    elif not (0.0 < camera.fov_rad < math.pi and 0.0 <= near_far[0] < near_far[1] < LARGEST_MM):
        yield "the camera's field of view or range is impossible"


def _of_body(body: BodyLog):
    if body.role not in ROLES:
        yield f"body '{body.name}' has an unknown role '{body.role}'"
    if len(body.faces) and not 0 <= body.faces.min() <= body.faces.max() < len(body.vertices_mm):
        yield f"body '{body.name}' has faces without their vertices"
    if not len(body.faces):
        yield f"body '{body.name}' has no face"


def _of_dose(dose: DoseLog, rows: int):
    count, changes = len(dose.points_mm), len(dose.sample)
    if (
        dose.stations < 1
        or not (dose.station.min(initial=0) >= 0)
        or not (dose.station.max(initial=0) < dose.stations)
    ):
        yield "the dose has stations that are not on its ring"
    if not (dose.zone.min(initial=0) >= 0 and dose.zone.max(initial=0) <= 2):
        yield "the dose has an unknown zone"
    if dose.faces.min(initial=0) < 0:
        yield "the dose is on a face of a negative number"
    if (
        len(dose.starts) != len(dose.rows) + 1
        or np.any(np.diff(dose.starts) < 0)
        or ((dose.starts[0], dose.starts[-1]) != (0, changes))
    ):
        yield "the changes of the dose do not add up"
    if np.any(np.diff(dose.rows) <= 0) or not (
        dose.rows.min(initial=0) >= 0 and dose.rows.max(initial=0) < rows
    ):
        yield "the dose changes in rows that the log does not have"
    if changes and not 0 <= dose.sample.min() <= dose.sample.max() < count:
        yield "the dose changes on triangles that it does not have"
    if min(dose.ring_length_mm, dose.threshold_j_per_mm2, dose.cut_j_per_mm2) <= 0.0:
        yield "the dose has a limit that is not above 0"


def _not_a_table(name: str, table: Any):
    if not _is_table(table):
        yield f"its {name} are not a table"


def _numbers_by_name(name: str, table: Any, rows: int):
    """A table of (T,) arrays of numbers."""
    if not _is_table(table):
        yield f"its {name} are not a table"
        return
    for key, value in table.items():
        fits = isinstance(value, np.ndarray) and value.dtype.kind in "fiub"
        if not fits or value.shape != (rows,):
            yield f"'{key}' of its {name} is not a number for each of {rows} rows"


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping)


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= sys.float_info.max
