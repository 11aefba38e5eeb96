"""Rays against the scene: what a beam or a line of sight meets first.

`RayHit` is the answer of both engines (the referee in `collision`, the batched caster here).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from surgisoft.scene.mesh import Body


class Struck(IntEnum):
    """What a ray meets first."""

    NOTHING = 0
    ORGAN = 1
    KEEP_OUT = 2
    SUPPORT = 3
    OTHER_ARM = 4
    OWN_ARM = 5


STRUCK_BY_ROLE = {
    "organ": Struck.ORGAN,
    "keep-out": Struck.KEEP_OUT,
    "support": Struck.SUPPORT,
}


def struck_of(body: Body) -> Struck:
    """What a ray reports that meets this body."""
    return STRUCK_BY_ROLE[body.role]


@dataclass(frozen=True, eq=False)
class RayHit:
    """First hits of rays; numpy or torch arrays of one leading shape (...). World frame.

    A miss is finite: struck NOTHING, the point at the end of the range, normal against the ray.
    """

    struck: Any
    """(...) int8, a `Struck`: what was met first."""
    body: Any
    """(...) int32, index of the body met, -1 for an arm or nothing."""
    face: Any
    """(...) int32, face of that body's mesh, -1 for an arm or nothing."""
    distance_mm: Any
    """(...) mm along the ray; the range for a miss."""
    point_mm: Any
    """(..., 3) mm, where the ray ends."""
    normal: Any
    """(..., 3) outward unit normal of the surface met."""
    incidence_rad: Any
    """(...) rad in 0..pi/2 between the ray and the surface's normal; 0 for a miss."""

    @property
    def on_organ(self):
        """(...) bool: the ray lands on the organ with nothing before it."""
        return self.struck == int(Struck.ORGAN)

    @property
    def missed(self):
        """(...) bool: nothing within the range."""
        return self.struck == int(Struck.NOTHING)

    @property
    def blocked(self):
        """(...) bool: something that is not the organ stands first on the ray."""
        return self.struck > int(Struck.ORGAN)
