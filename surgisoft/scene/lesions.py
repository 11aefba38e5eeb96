"""Lesions like a scene's own, a little aside and of other sizes, for episodes that differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.lesion import circle_on, nearest_on_surface, patch_normal
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.spec import LesionSpec

TRIES = 20
"""Places drawn for each lesion that is wanted before it is given up."""


def lesions_like(
    mesh: Mesh, lesion: LesionSpec, count: int, shift_mm: float, size: float
) -> tuple[LesionSpec, ...]:
    """`count` lesions on the organ's mesh (world frame), the same ones each time.

    Centres lie evenly within shift_mm of the lesion's own, along the surface; diameters are even
    within the share `size` of its own (0.1: from 90 to 110 %). With both 0 there is the own one
    only.
    """
    if shift_mm == 0.0 and size == 0.0:
        return (lesion,)
    if lesion.path_mm:
        raise InputError("a lesion with its own path_mm cannot be moved or scaled; leave both at 0")
    if not 0.0 <= size < 1.0:
        raise InputError(f"lesions differ in size by a share of {size}; expected 0 to below 1")
    if shift_mm > lesion.diameter_mm:
        raise InputError(
            f"lesions move by up to {shift_mm:g} mm; expected at most the scene's own diameter of "
            f"{lesion.diameter_mm:g} mm"
        )
    own, face = (part[0] for part in nearest_on_surface(mesh, np.array([lesion.centre_mm])))
    plane = frames.rotation_from_z(patch_normal(mesh, own, int(face), 0.5 * lesion.diameter_mm))
    rng, found = np.random.default_rng(0), []
    for _ in range(TRIES * count):
        turn, share, spread = rng.uniform((0.0, 0.0, -1.0), (2.0 * np.pi, 1.0, 1.0))
        aside = shift_mm * np.sqrt(share) * np.array([np.cos(turn), np.sin(turn)])
        diameter = lesion.diameter_mm * (1.0 + size * spread)
        centre, face = (part[0] for part in nearest_on_surface(mesh, own + plane[:, :2] @ aside))
        if circle_on(mesh, centre, int(face), diameter) is not None:
            found.append(
                replace(lesion, centre_mm=tuple(centre.tolist()), diameter_mm=float(diameter))
            )
        if len(found) == count:
            return tuple(found)
    raise InputError(
        f"only {len(found)} of {count} lesions up to {shift_mm:g} mm aside and {100 * size:g} % "
        f"larger lie on '{lesion.body}'; expected a smaller spread or a flatter place"
    )
