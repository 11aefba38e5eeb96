"""What is to be treated in a scene: where the beam has to go, what counts, what has to be seen.

A `Treatment` holds arrays only. Each builder here makes one kind: rings around lesions, contours
that are cut one after another, areas that are covered by a raster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from surgisoft.errors import InputError
from surgisoft.scene.ablation import Tissue
from surgisoft.scene.contours import SurfacePath, contour_path, raster
from surgisoft.scene.dose_patch import (
    SPACING_WAISTS,
    DosePatch,
    area_patch,
    cut_patches,
    path_patch,
)
from surgisoft.scene.folder import Scene
from surgisoft.scene.lesion import lesions_like
from surgisoft.scene.spec import ContourSpec as ContourSpec
from surgisoft.tasks.world.arm import Randomisation

PATH_POINTS = 360
"""Points of a ring's path that the laser follows."""
FINE_STEP_MM = 0.2
"""Spacing of the points of an outline that nothing follows (mm)."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """One path among those of a treatment: points `first` to `first + count - 1`."""

    first: int
    """Number of its first point."""
    count: int
    """Number of its points."""
    closed: bool
    """Whether the last point is followed by the first."""


@dataclass(frozen=True, eq=False)
class Treatment:
    """Where the beam has to go on the organ, K alternatives; world frame, mm."""

    patches: tuple[DosePatch, ...]
    """Where the dose is stored and what counts, for each of the K alternatives."""
    spot_mm: float
    """Diameter of the beam on the tissue at 1/e^2 (mm)."""
    paths_mm: np.ndarray
    """(K, M, 3) mm: points that the beam follows."""
    normals: np.ndarray
    """(K, M, 3): outward unit normals of the surface there."""
    centres_mm: np.ndarray
    """(K, 3) mm: middle of what is treated."""
    looks_mm: np.ndarray
    """(W, V, 3) mm: sets of points that the endoscope may have to see, one of them at a time."""
    look_normals: np.ndarray
    """(W, V, 3): outward unit normals there."""
    stretches: tuple[Stretch, ...]
    """The paths of which the points consist."""
    field_rad: float | None = None
    """Full cone angle in which they have to be seen (rad); None: the camera's field of view."""
    depth_mm: float | None = None
    """Depth from which a place counts as treated (mm); None: that of the engine's configuration."""
    exact_lesion: bool = False
    """Whether a place inside (LESION) counts as treated from the dose that cuts, instead of from
    the threshold of ablation."""


Plan = Callable[[Scene, Randomisation, float, int], Treatment]
"""(scene, what is randomised, band of a path in mm, points to be seen) -> what is to be treated."""


@dataclass(frozen=True)
class _Planned:
    """What a treatment follows from, equal for scenes of equal content."""

    plan: Plan
    content: str
    vary: Randomisation
    band_mm: float
    view_points: int
    scene: Scene = field(compare=False)


@lru_cache(maxsize=8)
def _of_planned(what: _Planned) -> Treatment:
    return what.plan(what.scene, what.vary, what.band_mm, what.view_points)


def treatment_of(
    plan: Plan, scene: Scene, vary: Randomisation, band_mm: float, view_points: int
) -> Treatment:
    """What a plan treats; a few are kept, so that the next environment of a scene is made sooner.

    Kept are those of `rings` and of plans that are frozen dataclasses: any other plan may answer
    otherwise the next time. The arrays are shared, and not to be changed.
    """
    if not _is_fixed(plan):
        return plan(scene, vary, band_mm, view_points)
    return _of_planned(_Planned(plan, scene.content_hash, vary, band_mm, view_points, scene))


def _is_fixed(plan: Plan) -> bool:
    """Whether a plan is `rings`, or a frozen dataclass of values that have a hash."""
    values = getattr(type(plan), "__dataclass_params__", None)
    if values is None or not values.frozen:
        return plan is rings
    try:
        hash(plan)
    except TypeError:
        return False
    return True


def rings(scene: Scene, vary: Randomisation, band_mm: float, view_points: int) -> Treatment:
    """Rings around the scene's lesion, or around K random variations of it."""
    spec = scene.spec
    mesh, spot = scene.organ.world_mesh, spec.laser.spot_mm
    place = (vary.lesions, vary.lesion_mm, vary.lesion_size)
    off = scene.keep_out, spec.limits.clearance_mm
    scenes = [scene.with_lesion(one) for one in lesions_like(mesh, spec.lesion, *place, *off)]
    around = [(one.ring.points_mm, one.ring.normals, one.ring.centre_mm) for one in scenes]
    looks = [one.ring_of(count=view_points) for one in scenes]
    paths = [one.ring_of(count=PATH_POINTS) for one in scenes]
    return Treatment(
        patches=cut_patches(mesh, around, SPACING_WAISTS * 0.5 * spot, band_mm),
        spot_mm=spot,
        paths_mm=np.stack([path.points_mm for path in paths]),
        normals=np.stack([path.normals for path in paths]),
        centres_mm=np.stack([centre for _, _, centre in around]),
        looks_mm=np.stack([look.points_mm for look in looks]),
        look_normals=np.stack([look.normals for look in looks]),
        stretches=(Stretch(0, PATH_POINTS, True),),
    )


@dataclass(frozen=True)
class ContourPlan:
    """Contours that are cut one after another."""

    step_mm: float
    """Largest distance of two neighbouring points of a path, mm: that of a step."""
    contours: tuple[ContourSpec, ...] = ()
    """The contours; none: those of the scene, or the ring around its lesion where it has none."""
    margin_mm: float = 0.0
    """Margin by which every closed contour is grown further, mm."""
    window_mm: float = 8.0
    """Length of path on either side of the target that has to be seen, mm."""
    field_deg: float = 24.0
    """Full cone angle in which it has to be seen, degrees."""

    def __call__(
        self, scene: Scene, vary: Randomisation, band_mm: float, view_points: int
    ) -> Treatment:
        """The contours in a scene."""
        _check_fixed(vary, "contours")
        mesh, spot = scene.organ.world_mesh, scene.spec.laser.spot_mm
        paths = outlines(scene, self.contours, self.margin_mm, self.step_mm)
        patch = path_patch(mesh, paths, SPACING_WAISTS * 0.5 * spot, band_mm)
        seen = [windows(path, self.window_mm, view_points) for path in paths]
        return _joined(
            patch,
            spot,
            paths,
            np.concatenate([points for points, _ in seen]),
            np.concatenate([normals for _, normals in seen]),
            field_rad=math.radians(self.field_deg),
        )


@dataclass(frozen=True)
class AreaPlan:
    """Areas inside of outlines that are covered by a raster, one after another."""

    step_mm: float
    """Largest distance of two neighbouring points of the raster, mm: that of a step."""
    pitch_mm: float
    """Distance of neighbouring lines of the raster, mm."""
    overrun_mm: float
    """Distance by which the raster reaches beyond the outline, mm."""
    spared_mm: float
    """Margin outside of the outline in which a dose does not count, mm."""
    spot_mm: float
    """Diameter of the beam on the tissue at 1/e^2, mm."""
    dose_j_per_mm2: float
    """Dose from which a place counts as treated, J/mm^2."""
    contours: tuple[ContourSpec, ...] = ()
    """The outlines; none: the ring around the scene's lesion."""

    def __call__(
        self, scene: Scene, vary: Randomisation, band_mm: float, view_points: int
    ) -> Treatment:
        """The areas in a scene."""
        _check_fixed(vary, "areas")
        mesh, tissue = scene.organ.world_mesh, Tissue(scene.spec.laser.absorption_per_mm)
        if self.dose_j_per_mm2 < tissue.threshold_j_per_mm2:
            raise InputError(
                f"a dose of {self.dose_j_per_mm2:g} J/mm2 ablates nothing of this tissue; expected "
                f"at least its threshold of {tissue.threshold_j_per_mm2:.3g} J/mm2"
            )
        ratio = self.dose_j_per_mm2 / tissue.threshold_j_per_mm2
        around = outlines(scene, self.contours or (_ring(scene),), 0.0, FINE_STEP_MM)
        patch = area_patch(mesh, around, SPACING_WAISTS * 0.5 * self.spot_mm, self.spared_mm)
        rasters = [
            raster(mesh, one.points_mm, self.pitch_mm, -self.overrun_mm, self.step_mm)
            for one in around
        ]
        lines = [
            replace(line, name=one.name)
            for one, parts in zip(around, rasters, strict=True)
            for line in parts
        ]
        looks = [_spread(one, view_points) for one in around]
        counts = [sum(len(line.points_mm) for line in parts) for parts in rasters]
        return _joined(
            patch,
            self.spot_mm,
            lines,
            *(
                np.concatenate(
                    [np.repeat(look[k][None], n, 0) for look, n in zip(looks, counts, strict=True)]
                )
                for k in (0, 1)
            ),
            depth_mm=math.log(ratio) / tissue.absorption_per_mm,
            exact_lesion=True,
        )


def check_names(field: str, contours: Sequence[ContourSpec]) -> None:
    """Raise an InputError that names the field where two contours have one name."""
    names = [contour.name for contour in contours]
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise InputError(f"{field}: a second contour '{twice[0]}'; expected names that differ")


def outlines(
    scene: Scene, contours: Sequence[ContourSpec], margin_mm: float, step_mm: float
) -> tuple[SurfacePath, ...]:
    """The given contours on the scene's organ; none: the scene's own, else its lesion's ring.

    margin_mm: by which every closed one is grown beyond its own margin.
    """
    mesh = scene.organ.world_mesh
    chosen = tuple(contours) or scene.spec.contours
    chosen = chosen or (_ring(scene),)
    grown = [replace(each, margin_mm=each.margin_mm + margin_mm * each.closed) for each in chosen]
    return tuple(contour_path(mesh, each, step_mm) for each in grown)


def _ring(scene: Scene) -> ContourSpec:
    """The ring around the scene's lesion as a contour."""
    points = scene.ring_of(count=PATH_POINTS).points_mm.tolist()
    return ContourSpec("lesion", tuple((x, y, z) for x, y, z in points))


def windows(path: SurfacePath, window_mm: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, V, 3) mm and normals of the stretch around each of M points of a path.

    The V points lie within window_mm of arc length on either side; an open path ends at its ends.
    """
    size = len(path.points_mm)
    step = path.length_mm / (size if path.closed else size - 1)
    reach = window_mm / step
    if path.closed:
        reach = min(reach, 0.5 * size)
    offsets = np.rint(np.linspace(-reach, reach, count)).astype(int)
    place = np.arange(size)[:, None] + offsets
    place = place % size if path.closed else place.clip(0, size - 1)
    return path.points_mm[place], path.normals[place]


def _spread(path: SurfacePath, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` of a path's points and their normals, evenly spread."""
    place = np.linspace(0, len(path.points_mm), count, endpoint=False).astype(int)
    return path.points_mm[place], path.normals[place]


def _joined(
    patch: DosePatch,
    spot_mm: float,
    paths: Sequence[SurfacePath],
    looks_mm: np.ndarray,
    look_normals: np.ndarray,
    **more,
) -> Treatment:
    """The treatment of paths that follow one another."""
    counts = [len(path.points_mm) for path in paths]
    points = np.concatenate([path.points_mm for path in paths])
    return Treatment(
        patches=(patch,),
        spot_mm=spot_mm,
        paths_mm=points[None],
        normals=np.concatenate([path.normals for path in paths])[None],
        centres_mm=points.mean(axis=0)[None],
        looks_mm=looks_mm,
        look_normals=look_normals,
        stretches=tuple(
            Stretch(sum(counts[:i]), counts[i], path.closed) for i, path in enumerate(paths)
        ),
        **more,
    )


def _check_fixed(vary: Randomisation, what: str) -> None:
    if vary.lesion_mm or vary.lesion_size:
        raise InputError(
            f"randomisation: lesion_mm and lesion_size are for one ring; leave both at 0 for {what}"
        )
