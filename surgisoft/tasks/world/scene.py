"""The scene around the arms: clearance to bodies, laser hit and dose, the endoscope's view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import unknown_name
from surgisoft.scene.ablation import AblationMap, AblationState, Tissue
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import View, seen_from
from surgisoft.scene.capsules import BatchClearance
from surgisoft.scene.collision import ExactScene
from surgisoft.scene.dose_patch import SPACING_WAISTS, cut_patches
from surgisoft.scene.folder import Scene
from surgisoft.scene.lesion import lesions_like
from surgisoft.scene.mesh import Body
from surgisoft.scene.rays import RayHit
from surgisoft.scene.spec import PHANTOM as PHANTOM
from surgisoft.tasks.world.arm import ArmPart, Randomisation
from surgisoft.tasks.world.pytree import overwritable
from surgisoft.tasks.world.random_streams import Stream

GEOMETRIES = ("batched", "fcl")
"""Collision engines: `batched` for training, `fcl` exact."""
LASER, ENDOSCOPE = "laser", "endoscope"
"""Names of the arm that carries the beam and of the one that carries the camera."""
BEAM_BEYOND_MM = 50.0
"""The beam is followed this far beyond the laser's largest working distance (mm)."""
PATH_POINTS = 360
"""Points of the ring's path that the laser follows."""
NOT_RANDOMISED = Randomisation()
"""Default: the scene's own lesion only."""


@dataclass(frozen=True, eq=False)
class SceneState:
    """The scene's state in B environments; None for what a world does not have."""

    clearance: BatchClearance | None = None
    """Signed clearances of every arm, mm."""
    hit: RayHit | None = None
    """Where the beam ends, (B,)."""
    dose: AblationState | None = None
    """Dose map of the tissue."""
    view: View | None = None
    """What the endoscope sees of the ring, (B,)."""
    lesion: Tensor | None = None
    """(B,) int64: number of the episode's lesion among those laid out."""
    donated: bool = False
    """Whether the next step or reset may overwrite this state's dose map instead of copying it
    (buffer donation). Only the owner of the state sets it, see `base.Episodes`."""


def measured_view(fraction: Tensor) -> SceneState:
    """A scene of which only the share (B,) of the ring that the endoscope sees is known."""
    unknown = torch.full_like(fraction, torch.nan)
    points = unknown[:, None].isfinite()
    return SceneState(view=View(points, points, fraction, unknown, unknown, unknown))


def measured_clearance(least_mm: Tensor) -> SceneState:
    """A scene of which only one arm's least clearance (B,) mm to the bodies is known."""
    least = least_mm[:, None]
    return SceneState(BatchClearance(least[:, None], least[:, :0], torch.full_like(least, 1.0)))


@dataclass(frozen=True)
class SceneEngineConfig:
    """Resolution of the scene's computations, and the collision engine."""

    view_points: int = 24
    """Points of the ring that are tested for visibility (a count)."""
    depth_mm: float = 0.3
    """Depth from which the ring counts as cut, mm."""
    band_mm: float = 2.0
    """Width of the ring to be cut, mm."""
    geometry: str = "batched"
    """Engine that computes clearance and the beam's hit: `batched`, or `fcl`, the exact collision
    checker, one environment after the other. Lines of sight are batched with either."""

    def __post_init__(self):
        if self.geometry not in GEOMETRIES:
            raise unknown_name("geometry", self.geometry, GEOMETRIES)


class SceneEngine:
    """Computes the state of a scene from the arms in it; built once, holds no state.

    `spec` is the scene's file. `paths_mm` (K, 360, 3) mm, world frame, are the closed paths of the
    rings around its K lesions, `centres_mm` (K, 3) mm their centres; `path_mm` and `centre_mm` are
    those of the first. `collision` is the engine of clearance and of the beam's hit.
    """

    def __init__(
        self,
        scene: Scene,
        config: SceneEngineConfig | None = None,
        device: str | torch.device = "cpu",
        engine: str | None = None,
        vary: Randomisation = NOT_RANDOMISED,
    ):
        """`engine` is as for `BatchedScene`: compiled on the CPU, torch anywhere."""
        config, spec, self.device = config or SceneEngineConfig(), scene.spec, torch.device(device)
        radii = {mount.tool: 0.5 * mount.diameter_mm for mount in spec.mounts}
        self.geometry = BatchedScene(scene.bodies, radii, device, engine=engine)
        self.collision = collision_engine(config.geometry, self.geometry)
        self.camera = spec.camera.camera()
        self.beam_mm = spec.laser.standoff_mm[1] + BEAM_BEYOND_MM
        self.organ = scene.bodies.index(scene.organ)
        mesh, waist = scene.organ.world_mesh, 0.5 * spec.laser.spot_mm
        place = (vary.lesions, vary.lesion_mm, vary.lesion_size)
        scenes = [scene.with_lesion(one) for one in lesions_like(mesh, spec.lesion, *place)]
        rings = [(one.ring.points_mm, one.ring.normals, one.ring.centre_mm) for one in scenes]
        patches = cut_patches(mesh, rings, SPACING_WAISTS * waist, config.band_mm)
        tissue = Tissue(spec.laser.absorption_per_mm)
        self.ablation = AblationMap(patches, waist, tissue, config.depth_mm, device)
        looks = [one.ring_of(count=config.view_points) for one in scenes]
        paths = [one.ring_of(count=PATH_POINTS).points_mm for one in scenes]

        def held(arrays) -> Tensor:
            return torch.tensor(np.stack(arrays), dtype=torch.float32, device=self.device)

        self.spec, self.lesions = spec, len(scenes)
        self.paths_mm, self.centres_mm = held(paths), held([centre for _, _, centre in rings])
        self.path_mm, self.centre_mm = self.paths_mm[0], self.centres_mm[0]
        self.rings_mm = held([look.points_mm for look in looks])
        self.ring_normals = held([look.normals for look in looks])

    def start(self, stream: Stream, parts: Mapping[str, ArmPart]) -> tuple[Stream, SceneState]:
        """Draw a lesion for each random number stream; the scene with untouched tissue."""
        lesion = torch.zeros_like(stream.count)
        if self.lesions > 1:
            stream, draw = stream.uniform(0.0, float(self.lesions))
            lesion = draw.long().clamp(max=self.lesions - 1)
        scene = self._look(parts, lesion)
        dose = self.ablation.start(*self._beam(scene, parts), lesion)
        return stream, replace(scene, dose=dose)

    def step(
        self,
        scene: SceneState,
        parts: Mapping[str, ArmPart],
        power_w: float | Tensor,
        dt_s: float,
    ) -> SceneState:
        """The scene after the arms moved and the beam swept with `power_w` (B,) W for dt_s."""
        after = self._look(parts, scene.lesion)
        beam = self._beam(after, parts)
        in_place = scene.donated and overwritable(scene.dose.dose)
        dose = self.ablation.advance(scene.dose, *beam, power_w, dt_s, in_place)
        return replace(after, dose=dose, donated=scene.donated)

    def fresh_dose(
        self,
        dose: AblationState,
        mask: Tensor,
        scene: SceneState,
        parts: Mapping[str, ArmPart],
    ) -> AblationState:
        """Replace the tissue by untouched tissue where mask (B,) is set, under the scene's beam."""
        beam = self._beam(scene, parts)
        in_place = scene.donated and overwritable(dose.dose)
        return self.ablation.reset(dose, mask, *beam, in_place, scene.lesion)

    def aimed(self, parts: Mapping[str, ArmPart]) -> RayHit:
        """Where the beam of the arms in `parts` ends, (B,)."""
        lines = {name: part.line_mm for name, part in parts.items()}
        beam = parts[LASER]
        return self.collision.cast(beam.tip_mm, beam.tip_direction, self.beam_mm, lines, own=LASER)

    def _look(self, parts: Mapping[str, ArmPart], lesion: Tensor) -> SceneState:
        lines, eye = {name: part.line_mm for name, part in parts.items()}, parts[ENDOSCOPE]
        clearance, hit = self.collision.clearance(lines), self.aimed(parts)
        ring = (self.rings_mm[lesion], self.ring_normals[lesion])
        at = (eye.tip_mm, eye.tip_direction)
        seen = seen_from(self.geometry, self.camera, *at, *ring, lines, own=ENDOSCOPE)
        return SceneState(clearance, hit, None, seen, lesion)

    def _beam(self, scene: SceneState, parts: Mapping[str, ArmPart]) -> tuple[Tensor, ...]:
        on = scene.hit.on_organ & (scene.hit.body == self.organ)
        return scene.hit.point_mm, parts[LASER].tip_direction, on


class ObstacleEngine:
    """Computes how clear the arms are of some bodies, without beam, tissue or camera; no state."""

    def __init__(
        self,
        bodies: Sequence[Body],
        radii_mm: Mapping[str, float],
        geometry: str,
        device: str | torch.device,
        clearance_mm: float = 0.0,
    ):
        """clearance_mm: limit below which an arm is too close, mm; geometry: see `GEOMETRIES`."""
        self.clearance_mm, self.geometry = clearance_mm, BatchedScene(bodies, radii_mm, device)
        self.collision = collision_engine(geometry, self.geometry)

    def start(self, stream: Stream, parts: Mapping[str, ArmPart]) -> tuple[Stream, SceneState]:
        """The arms' clearances at the start of an episode; draws no random number."""
        return stream, self._look(parts, donated=False)

    def step(
        self,
        scene: SceneState,
        parts: Mapping[str, ArmPart],
        power_w: float | Tensor,
        dt_s: float,
    ) -> SceneState:
        """The moved arms' clearances; there is no beam, so power and time have no effect."""
        return self._look(parts, scene.donated)

    def _look(self, parts: Mapping[str, ArmPart], donated: bool) -> SceneState:
        lines = {name: part.line_mm for name, part in parts.items()}
        return SceneState(self.collision.clearance(lines), donated=donated)


def collision_engine(geometry: str, engine: BatchedScene) -> BatchedScene | ExactScene:
    """The batched engine itself, or FCL with the same bodies and arms, by `GEOMETRIES` name."""
    if geometry == "batched":
        return engine
    return ExactScene(engine.bodies, engine.radii_mm, engine.device)
