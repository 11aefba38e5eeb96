"""The parts of an episode's log: arms, beam, camera, dose, bodies, events.

T rows, the first the start; world frame, mm, s, kPa.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEVELS = ("info", "warning", "error")
"""How grave an event is."""
ROLES = ("organ", "keep-out", "support")
"""Roles of bodies, as in a scene."""
TOOLS = ("laser", "endoscope", "tip")
"""Tools of arms, as in a scene."""


@dataclass(frozen=True, eq=False)
class Event:
    """Something that happened."""

    time_s: float
    """Since the episode began, s."""
    level: str
    """One of `LEVELS`."""
    text: str
    """What happened, in a few words."""


@dataclass(frozen=True, eq=False)
class ArmLog:
    """One arm over an episode."""

    command_kPa: np.ndarray
    """(T, m) kPa: commanded pressure."""
    pressure_kPa: np.ndarray
    """(T, m) kPa: pressure in the chambers."""
    action_kPa: np.ndarray
    """(T, m) kPa: change of pressure asked for in the step before; nan in row 0."""
    points_mm: np.ndarray
    """(T, n, 3) mm: key points, base to tip."""
    seen_mm: np.ndarray
    """(T, n, 3) mm: key points as measured, which is what a policy is given."""
    line_mm: np.ndarray
    """(T, K, 3) mm: centreline, base to tip, led by the far end of the shaft where there is one."""
    tip_direction: np.ndarray
    """(T, 3): unit tangent at the tip."""
    mount: np.ndarray
    """(4, 4): base frame to world frame, mm."""
    radius_mm: float
    """Radius of the body, mm."""
    shaft_mm: float
    """Length of the rigid shaft behind the base, mm; 0: none."""
    tool: str = ""
    """Tool of the arm, as in a scene; empty where there is no scene."""


@dataclass(frozen=True, eq=False)
class BeamLog:
    """A laser's beam; it leaves the laser arm's tip along its direction."""

    power_w: np.ndarray
    """(T,) W: mean power that reached the organ in the step before; 0 while the beam is off."""
    end_mm: np.ndarray
    """(T, 3) mm: where the beam ends, or would end while it is off."""
    hits_organ: np.ndarray
    """(T,) bool: it ends on an organ."""

    @property
    def on(self) -> np.ndarray:
        """(T,) bool: the beam burnt in the step before."""
        return self.power_w > 0.0


@dataclass(frozen=True, eq=False)
class CameraLog:
    """The camera in an endoscope's tip; it looks along the tip's direction."""

    fov_rad: float
    """Full cone angle of the round field of view, rad."""
    range_mm: tuple[float, float]
    """Least and greatest distance at which the picture is sharp, mm."""


@dataclass(frozen=True, eq=False)
class DoseLog:
    """Dose of P small triangles of the organ around a ring of N stations, over time.

    Only changes are stored: those of row `rows[i]` are `starts[i]` to `starts[i + 1]`.
    """

    body: str
    """Name of the organ."""
    points_mm: np.ndarray
    """(P, 3) mm: centroids of the triangles."""
    normals: np.ndarray
    """(P, 3): outward unit normals."""
    areas_mm2: np.ndarray
    """(P,) mm^2: areas of the triangles."""
    faces: np.ndarray
    """(P,) face of the organ's mesh that each triangle lies on."""
    offset_mm: np.ndarray
    """(P,) mm: distance from the ring's path, negative inside the ring."""
    station: np.ndarray
    """(P,) nearest of the N equal stretches of the ring."""
    zone: np.ndarray
    """(P,) 0: inside the ring, 1: on it, 2: healthy tissue."""
    stations: int
    """Number N of stations of the ring."""
    ring_length_mm: float
    """Length of the ring's closed path, mm."""
    threshold_j_per_mm2: float
    """Dose from which tissue is ablated, J/mm^2."""
    cut_j_per_mm2: float
    """Dose from which the ring counts as cut, J/mm^2."""
    rows: np.ndarray
    """(S,) rows of the log in which the dose changed, rising."""
    starts: np.ndarray
    """(S + 1,) index at which each row's changes begin."""
    sample: np.ndarray
    """(C,) number of the triangle that changed."""
    dose_j_per_mm2: np.ndarray
    """(C,) J/mm^2: dose of that triangle from this row on."""

    def at(self, row: int) -> np.ndarray:
        """(P,) J/mm^2: the dose in a row of the log; a negative row counts from the end."""
        dose = np.zeros(len(self.points_mm), dtype=np.float32)
        last = len(self.rows) if row == -1 else np.searchsorted(self.rows, row, side="right")
        changes = slice(0, int(self.starts[last]))
        # Later changes come later, and the last one written stays.
        dose[self.sample[changes]] = self.dose_j_per_mm2[changes]
        return dose


@dataclass(frozen=True, eq=False)
class BodyLog:
    """One body of the scene: name, role and mesh."""

    name: str
    """Name of the body."""
    role: str
    """`organ`, `keep-out` or `support`."""
    vertices_mm: np.ndarray
    """(V, 3) mm, world frame; of a body that moves at rest."""
    faces: np.ndarray
    """(F, 3) int32."""
    motion: np.ndarray | None = None
    """(T, 4, 4): world frame at rest to world frame in each row, affine, mm; None: at rest."""

    def moved_mm(self, row: int) -> np.ndarray:
        """(V, 3) mm: the vertices in a row of the log."""
        if self.motion is None:
            return self.vertices_mm
        return self.vertices_mm @ self.motion[row, :3, :3].T + self.motion[row, :3, 3]
