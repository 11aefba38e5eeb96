"""Which marker is which key point, in which frame: the map of a bench with motion capture."""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from surgisoft.config import Rule, from_table, read_toml
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import ArmInfo
from surgisoft.rig.drivers.motion_capture import Frame
from surgisoft.rig.motion_capture import circle_centre

SEVERAL = "+"
"""Joins the markers of one plane: `m1+m2+m3` is the centre of the circle through them."""
SWAP_GAIN_MM = 8.0
"""Distance by which an exchange of key points has to shorten their ways since the last frame to be
taken for swapped labels [mm]. Key planes are centimetres apart, and an arm moves a few millimetres
between two frames."""

Direction = Annotated[
    tuple[float, float, float],
    Rule("a direction of three numbers, not all 0", lambda v: math.sqrt(sum(x * x for x in v)) > 0),
]
Points = Annotated[
    tuple[str, ...], Rule("names of at least one point, base to tip", lambda names: len(names) > 0)
]


@dataclass(frozen=True)
class FrameMap:
    """Where the arm's base frame is in the frame of the cameras."""

    body: str = ""
    """Rigid body on the base: the arm's base frame is fixed to it; empty: to the cameras' frame."""
    origin_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the base frame in that frame [mm]."""
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation from the base frame to that frame: about its fixed x, then y, then z axis [deg]."""

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) matrix from the base frame to the frame that it is fixed to."""
        found = np.eye(3)
        for axis, degrees in enumerate(self.rotation_deg):
            c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
            i, j = (axis + 1) % 3, (axis + 2) % 3
            turn = np.eye(3)
            turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
            found = turn @ found
        return found


@dataclass(frozen=True)
class BenchMap:
    """Content of a bench's map file."""

    points: Points
    """Key points from the base to the tip: each the name of a marker or of a rigid body, or several
    markers of one plane joined with `+`, whose circle's centre is the key point."""
    channels: tuple[int, ...] = ()
    """Channel of the controller, from 1, for each chamber of the arm; empty: in order."""
    frame: FrameMap = field(default_factory=FrameMap)
    """Table [frame]."""
    arm: ArmInfo = field(default_factory=ArmInfo)
    """Table [arm]: size of the arm."""
    gravity: Direction | None = None
    """Direction of weight, arm base frame."""
    payload_g: float | None = None
    """Known mass at the arm [g]."""


def load_bench_map(path: str | Path) -> BenchMap:
    """Read a map file; an InputError names file, line and field of what is wrong."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file, expected the map of a bench (docs/rigs.md)")
    return from_table(BenchMap, *read_toml(path))


def map_of(frame: Frame) -> BenchMap:
    """The map without a file: points k0, k1, ... as they come, in the frame of the cameras."""
    names = [name for name in frame.points if re.fullmatch(r"k\d+", name)]
    names = names or [name for name in frame.bodies if re.fullmatch(r"k\d+", name)]
    if not names:
        seen = ", ".join([*frame.points, *frame.bodies]) or "none"
        raise InputError(
            f"motion capture: names of key points are not k0, k1, ... (there are: {seen}); name "
            "them in a map file: map=BENCH.toml"
        )
    return BenchMap(points=tuple(sorted(names, key=lambda name: int(name[1:]))))


class KeyPoints:
    """Key points in the arm's base frame from frames of the cameras; undoes swapped labels.

    Where two bodies exchange their labels, the points jump from one plane to another. Of all
    assignments of names to planes the one with the shortest ways since the last frame is kept, once
    it is shorter than the present one by `SWAP_GAIN_MM`.
    """

    def __init__(self, bench: BenchMap) -> None:
        self.bench = bench
        self.swaps = 0
        """Times that labels were exchanged so far."""
        self._order = np.arange(len(bench.points))
        self._last: np.ndarray | None = None

    def require(self, frame: Frame) -> None:
        """Raise InputError for a name of the map that the stream does not have."""
        known = {*frame.points, *frame.bodies}
        wanted = [part for name in self.bench.points for part in name.split(SEVERAL)]
        wanted += [self.bench.frame.body] if self.bench.frame.body else []
        missing = [name for name in wanted if name not in known]
        if missing:
            raise InputError(
                f"motion capture: no '{missing[0]}' among the streamed names "
                f"({', '.join(sorted(known)) or 'none'}); correct the map"
            )

    def __call__(self, frame: Frame) -> np.ndarray:
        """(n, 3) key points, arm base frame [mm]; NaN where they are not seen."""
        found = np.array([self._point(frame, name) for name in self.bench.points])
        found = self._in_base(frame, found)
        return self._unswapped(found)

    def _point(self, frame: Frame, name: str) -> np.ndarray:
        if SEVERAL in name:
            markers = np.array([self._point(frame, part) for part in name.split(SEVERAL)])
            centre = np.full(3, np.nan)
            circle_centre(np.ascontiguousarray(markers, np.float64), centre)
            return centre
        if name in frame.bodies:
            return frame.bodies[name].position_mm
        return frame.points.get(name, np.full(3, np.nan))

    def _in_base(self, frame: Frame, points: np.ndarray) -> np.ndarray:
        fixed = self.bench.frame
        if fixed.body:
            body = frame.bodies.get(fixed.body)
            if body is None or not np.isfinite(body.position_mm).all():
                return np.full_like(points, np.nan)
            if not np.square(body.rotation).sum() > 0.0:  # also without an orientation: NaN
                return np.full_like(points, np.nan)
            turn = Rotation.from_quat(body.rotation).as_matrix()
            points = (points - body.position_mm) @ turn
        return (points - np.array(fixed.origin_mm)) @ fixed.rotation

    def _unswapped(self, found: np.ndarray) -> np.ndarray:
        ordered = found[self._order]
        last, whole = self._last, bool(np.isfinite(found).all())
        if last is not None and whole:
            ways = np.linalg.norm(last[:, None] - found[None], axis=2)
            planes, names = linear_sum_assignment(ways)
            present = ways[planes, self._order].sum()
            if present - ways[planes, names].sum() > SWAP_GAIN_MM:
                self._order = names
                self.swaps += 1
                ordered = found[self._order]
        if whole:
            self._last = ordered
        return ordered
