"""What surrounds the arms: bodies to keep clear of, tissue under the beam, a lesion in view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import unknown_name
from surgisoft.scene import frames
from surgisoft.scene.ablation import AblationMap, AblationState
from surgisoft.scene.batched import BatchClearance, BatchedScene
from surgisoft.scene.camera import View, view
from surgisoft.scene.dose_patch import SPACING_WAISTS, cut_patches
from surgisoft.scene.folder import Scene
from surgisoft.scene.lesions import lesions_like
from surgisoft.scene.packaged import PHANTOM as PHANTOM
from surgisoft.scene.rays import RayHit
from surgisoft.scene.refereed import RefereedScene
from surgisoft.scene.tissue import Tissue
from surgisoft.tasks.world.arm import ArmPart, Randomisation
from surgisoft.tasks.world.random import Stream

GEOMETRIES = ("batched", "fcl")
"""Who may decide about clearance and the beam's hit."""
LASER, ENDOSCOPE = "laser", "endoscope"
"""Names of the arm that carries the beam and of the one that carries the camera."""
BEAM_BEYOND_MM = 50.0
"""The beam is followed so far beyond the greatest distance at which the laser works (mm)."""
PATH_POINTS = 360
"""Points of the ring's path as the laser follows it."""
EVER_THE_SAME = Randomisation()
"""One lesion: the scene's own."""


@dataclass(frozen=True, eq=False)
class Scenery:
    """A batch of surroundings at one instant; what a world does not have is None."""

    clearance: BatchClearance | None = None
    """Signed clearances of every arm, mm."""
    hit: RayHit | None = None
    """Where the beam ends, (B,)."""
    dose: AblationState | None = None
    """What the beam has done."""
    view: View | None = None
    """What the endoscope sees of the ring, (B,)."""
    lesion: Tensor | None = None
    """(B,) int64: which of the surroundings' lesions the organ bears in this episode."""


@dataclass(frozen=True)
class SceneryConfig:
    """What of the surroundings is computed, and how finely."""

    view_points: int = 24
    """Points of the ring that the endoscope looks for."""
    depth_mm: float = 0.3
    """The ring counts as cut where it is this deep, mm."""
    band_mm: float = 2.0
    """Width of the ring's band, mm."""
    geometry: str = "batched"
    """Who decides about clearance and the beam's hit: `batched`, or `fcl`, the referee, one
    environment after the other. The endoscope's lines of sight are batched either way."""

    def __post_init__(self):
        if self.geometry not in GEOMETRIES:
            raise unknown_name("geometry", self.geometry, GEOMETRIES)


class Surroundings:
    """A scene with its engines; built once, asked every step, holds no state.

    `spec` is the scene's file; of its K lesions `paths_mm` (K, 360, 3) are the rings' closed paths
    and `centres_mm` (K, 3) their middles, world frame, mm. `path_mm` and `centre_mm` are the first.
    """

    def __init__(
        self,
        scene: Scene,
        config: SceneryConfig | None = None,
        device: str | torch.device = "cpu",
        engine: str | None = None,
        vary: Randomisation = EVER_THE_SAME,
    ):
        """`engine` is as for `BatchedScene`: compiled on the CPU, torch anywhere."""
        config, spec, self.device = config or SceneryConfig(), scene.spec, torch.device(device)
        radii = {mount.tool: 0.5 * mount.diameter_mm for mount in spec.mounts}
        self.geometry = BatchedScene(scene.bodies, radii, device, engine=engine)
        self.judge = judge_of(config.geometry, self.geometry)
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

    def start(self, stream: Stream, parts: Mapping[str, ArmPart]) -> tuple[Stream, Scenery]:
        """Untouched tissue, on a lesion that the stream draws, around arms at the start."""
        lesion = torch.zeros_like(stream.count)
        if self.lesions > 1:
            stream, draw = stream.uniform(0.0, float(self.lesions))
            lesion = draw.long().clamp(max=self.lesions - 1)
        scenery = self._look(parts, lesion)
        dose = self.ablation.start(*self._beam(scenery, parts), lesion)
        return stream, replace(scenery, dose=dose)

    def step(
        self,
        scenery: Scenery,
        parts: Mapping[str, ArmPart],
        power_w: float | Tensor,
        dt_s: float,
        in_place: bool,
    ) -> Scenery:
        """The surroundings of the moved arms, the beam having swept with `power_w` (B,) W."""
        after = self._look(parts, scenery.lesion)
        beam = self._beam(after, parts)
        in_place = in_place and _may_change(scenery.dose.dose)
        dose = self.ablation.advance(scenery.dose, *beam, power_w, dt_s, in_place)
        return replace(after, dose=dose)

    def fresh_dose(
        self,
        dose: AblationState,
        mask: Tensor,
        scenery: Scenery,
        parts: Mapping[str, ArmPart],
        in_place: bool,
    ) -> AblationState:
        """Untouched tissue where mask (B,) is set, under the beam as `scenery` has it."""
        beam, in_place = self._beam(scenery, parts), in_place and _may_change(dose.dose)
        return self.ablation.reset(dose, mask, *beam, in_place, scenery.lesion)

    def _look(self, parts: Mapping[str, ArmPart], lesion: Tensor) -> Scenery:
        lines = {name: part.line_mm for name, part in parts.items()}
        beam, eye = parts[LASER], parts[ENDOSCOPE]
        clearance = self.judge.clearance(lines)
        hit = self.judge.cast(beam.tip_mm, beam.tip_direction, self.beam_mm, lines, own=LASER)
        pose = frames.pose_from_z(eye.tip_mm, eye.tip_direction)
        ring = (self.rings_mm[lesion], self.ring_normals[lesion])
        seen = view(self.geometry, self.camera, pose, *ring, lines, own=ENDOSCOPE)
        return Scenery(clearance, hit, None, seen, lesion)

    def _beam(self, scenery: Scenery, parts: Mapping[str, ArmPart]) -> tuple[Tensor, ...]:
        on = scenery.hit.on_organ & (scenery.hit.body == self.organ)
        return scenery.hit.point_mm, parts[LASER].tip_direction, on


def judge_of(geometry: str, engine: BatchedScene) -> BatchedScene | RefereedScene:
    """Who decides: the batched engine itself, or FCL about the same bodies and arms."""
    if geometry == "batched":
        return engine
    return RefereedScene(engine.bodies, engine.radii_mm, engine.device)


def _may_change(tensor: Tensor) -> bool:
    """Whether a tensor may be changed in place: one made under inference_mode only there."""
    return torch.is_inference_mode_enabled() or not tensor.is_inference()
