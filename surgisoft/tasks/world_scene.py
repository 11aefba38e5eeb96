"""What surrounds the arms: bodies to keep clear of, tissue under the beam, a lesion in view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surgisoft.scene import frames
from surgisoft.scene.ablation import AblationMap, AblationState
from surgisoft.scene.batched import BatchClearance, BatchedScene
from surgisoft.scene.camera import View, view
from surgisoft.scene.dose_patch import SPACING_WAISTS, cut_patch
from surgisoft.scene.folder import Scene
from surgisoft.scene.rays import RayHit
from surgisoft.scene.tissue import Tissue
from surgisoft.tasks.world_arm import ArmPart

LASER, ENDOSCOPE = "laser", "endoscope"
"""Names of the arm that carries the beam and of the one that carries the camera."""
BEAM_BEYOND_MM = 50.0
"""The beam is followed so far beyond the greatest distance at which the laser works (mm)."""


PATH_POINTS = 360
"""Points of the ring's path as the laser follows it."""


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


@dataclass(frozen=True)
class SceneryConfig:
    """What of the surroundings is computed, and how finely."""

    view_points: int = 24
    """Points of the ring that the endoscope looks for."""
    depth_mm: float = 0.3
    """The ring counts as cut where it is this deep, mm."""
    band_mm: float = 2.0
    """Width of the ring's band, mm."""


class Surroundings:
    """A scene with its engines; built once, asked every step, holds no state.

    `spec` is the scene's file; `path_mm` (360, 3) the ring's closed path and `centre_mm` (3,) its
    middle, world frame, mm.
    """

    def __init__(
        self,
        scene: Scene,
        config: SceneryConfig | None = None,
        device: str | torch.device = "cpu",
        engine: str | None = None,
    ):
        """`engine` is as for `BatchedScene`: compiled on the CPU, torch anywhere."""
        config, spec, self.device = config or SceneryConfig(), scene.spec, torch.device(device)
        radii = {mount.tool: 0.5 * mount.diameter_mm for mount in spec.mounts}
        self.geometry = BatchedScene(scene.bodies, radii, device, engine=engine)
        self.camera = spec.camera.camera()
        self.beam_mm = spec.laser.standoff_mm[1] + BEAM_BEYOND_MM
        self.organ = scene.bodies.index(scene.organ)
        ring, waist = scene.ring, 0.5 * spec.laser.spot_mm
        patch = cut_patch(
            scene.organ.world_mesh,
            ring.points_mm,
            ring.normals,
            ring.centre_mm,
            SPACING_WAISTS * waist,
            config.band_mm,
        )
        tissue = Tissue(spec.laser.absorption_per_mm)
        self.ablation = AblationMap(patch, waist, tissue, config.depth_mm, device)
        look, row = scene.ring_of(count=config.view_points), {"dtype": torch.float32}
        row["device"] = self.device
        self.spec = spec
        self.path_mm = torch.tensor(scene.ring_of(count=PATH_POINTS).points_mm, **row)
        self.centre_mm = torch.tensor(ring.centre_mm, **row)
        self.ring_mm = torch.tensor(look.points_mm, **row)
        self.ring_normals = torch.tensor(look.normals, **row)

    def start(self, parts: Mapping[str, ArmPart]) -> Scenery:
        """Untouched tissue around arms at the start of an episode."""
        scenery = self._look(parts)
        return replace(scenery, dose=self.ablation.start(*self._beam(scenery, parts)))

    def step(
        self,
        scenery: Scenery,
        parts: Mapping[str, ArmPart],
        power_w: float | Tensor,
        dt_s: float,
        in_place: bool,
    ) -> Scenery:
        """The surroundings of the moved arms, the beam having swept with `power_w` (B,) W."""
        after = self._look(parts)
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
        beam = self._beam(scenery, parts)
        return self.ablation.reset(dose, mask, *beam, in_place and _may_change(dose.dose))

    def _look(self, parts: Mapping[str, ArmPart]) -> Scenery:
        lines = {name: part.line_mm for name, part in parts.items()}
        beam, eye = parts[LASER], parts[ENDOSCOPE]
        clearance = self.geometry.clearance(lines)
        hit = self.geometry.cast(beam.tip_mm, beam.tip_direction, self.beam_mm, lines, own=LASER)
        pose = frames.pose_from_z(eye.tip_mm, eye.tip_direction)
        seen = view(
            self.geometry, self.camera, pose, self.ring_mm, self.ring_normals, lines, own=ENDOSCOPE
        )
        return Scenery(clearance, hit, None, seen)

    def _beam(self, scenery: Scenery, parts: Mapping[str, ArmPart]) -> tuple[Tensor, ...]:
        on = scenery.hit.on_organ & (scenery.hit.body == self.organ)
        return scenery.hit.point_mm, parts[LASER].tip_direction, on


def _may_change(tensor: Tensor) -> bool:
    """Whether a tensor may be changed in place: one made under inference_mode only there."""
    return torch.is_inference_mode_enabled() or not tensor.is_inference()
