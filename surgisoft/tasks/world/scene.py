"""The scene around the arms: clearance to bodies, laser hit and dose, the endoscope's view."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError, unknown_name
from surgisoft.on_device import on_device
from surgisoft.scene.ablation import AblationMap, AblationState, Tissue
from surgisoft.scene.ablation import RingReport as RingReport
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import LIFT_MM, SHORT_MM, View, seen_from
from surgisoft.scene.capsules import BatchClearance, segment_distance
from surgisoft.scene.collision import ExactScene
from surgisoft.scene.folder import Scene
from surgisoft.scene.mesh import Body
from surgisoft.scene.moving import Placement
from surgisoft.scene.rays import RayHit, Struck
from surgisoft.scene.spec import PHANTOM as PHANTOM
from surgisoft.scene.spec import WALL as WALL
from surgisoft.tasks.world.arm import ArmPart, LoneArm, Randomisation
from surgisoft.tasks.world.pytree import overwritable
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.respiration import Breaths, OrganMotion, Respiration
from surgisoft.tasks.world.treatment import Plan, rings, treatment_of

GEOMETRIES = ("batched", "fcl")
"""Collision engines: `batched` for training, `fcl` exact."""
LASER, ENDOSCOPE = "laser", "endoscope"
"""Tools of the arms that carry a beam and of those that carry a camera; where one arm of a scene
carries the tool, the arm has its name."""
BEAM_BEYOND_MM = 50.0
"""The beam is followed this far beyond the laser's largest working distance (mm)."""
NOT_RANDOMISED = Randomisation()
"""Default: the scene's own lesion only."""


Power = float | Tensor | Mapping[str, float | Tensor]
"""Power of the beams, W: a number or (B,) for every laser, or one of them for each laser by name;
a laser that is left out is off."""
Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class SceneState:
    """The scene's state in B environments; None or empty for what a world does not have."""

    clearance: BatchClearance | None = None
    """Signed clearances of every arm, mm."""
    hits: dict[str, RayHit] = field(default_factory=dict)
    """Where each laser's beam ends, (B,), by the arm's name."""
    dose: AblationState | None = None
    """Dose map of the tissue."""
    views: dict[str, View] = field(default_factory=dict)
    """What each endoscope sees of the ring, (B,), by the arm's name."""
    lit: dict[str, Tensor] = field(default_factory=dict)
    """Whether each laser's beam burnt in the last step, (B,) bool, by the arm's name."""
    lesion: Tensor | None = None
    """(B,) int64: number of the episode's lesion among those laid out."""
    watched: Tensor | None = None
    """(B,) int64: number of the points that the endoscopes have to see from the next step on; a
    task sets it where its target moves, and it begins with the lesion's number."""
    breaths: Breaths | None = None
    """Respiration of the organ; None: it does not move."""
    measured: dict[str, Tensor] = field(default_factory=dict)
    """Signals (B,) by name, where the scene is not simulated but measured; see `base.Signal`."""
    donated: bool = False
    """Whether the next step or reset may overwrite this state's dose map instead of copying it
    (buffer donation). Only the owner of the state sets it, see `base.Episodes`."""

    @property
    def hit(self) -> RayHit:
        """Where the beam of the scene's only laser ends, (B,)."""
        return only(self.hits, "laser")

    @property
    def view(self) -> View:
        """View of the ring by the scene's only endoscope, (B,)."""
        return only(self.views, "endoscope")


def only(by_arm: Mapping[str, Item], tool: str) -> Item:
    """The entry of the only arm that carries a tool; an InputError where it is not one arm."""
    if len(by_arm) != 1:
        names = ", ".join(by_arm) or "none"
        raise InputError(f"arms with the tool '{tool}': {names}; expected one, or an arm's name")
    return next(iter(by_arm.values()))


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
        for name in ("view_points", "depth_mm", "band_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"scene_engine: {name} is {getattr(self, name)}, expected above 0")


class SceneEngine:
    """Computes the state of a scene from the arms in it; built once, holds no state.

    `spec` is the scene's file. `paths_mm` (K, M, 3) mm, world frame, are the points that the beam
    follows around its K lesions, `stretches` the paths of which they consist, `centres_mm` (K, 3)
    mm their centres; `path_mm` and `centre_mm` are those of the first. `looks_mm` (W, V, 3) mm are
    what endoscopes have to see. `collision` is the engine of clearance and of the beams' hits.
    `lasers` and `endoscopes` are the names of the arms with these tools.
    """

    def __init__(
        self,
        scene: Scene,
        config: SceneEngineConfig | None = None,
        device: str | torch.device = "cpu",
        engine: str | None = None,
        vary: Randomisation = NOT_RANDOMISED,
        plan: Plan | None = None,
        respiration: Respiration | None = None,
        time_s: float = 0.0,
    ):
        """`engine` is as for `BatchedScene`: compiled on the CPU, torch anywhere.

        plan: what is to be treated; None: rings around the scene's lesion (`treatment.rings`).
        respiration: how the organ moves; None: not at all. time_s: longest episode, s, for it.
        """
        config, spec, self.device = config or SceneEngineConfig(), scene.spec, torch.device(device)
        radii = {name: 0.5 * mount.diameter_mm for name, mount in spec.arms.items()}
        self.lasers, self.endoscopes = spec.arms_with(LASER), spec.arms_with(ENDOSCOPE)
        self.motion: OrganMotion | None = None
        if respiration is not None:
            about = np.array(scene.spec.lesion.centre_mm)
            self.motion = OrganMotion(respiration, scene.bodies, about, time_s, self.device)
        stretch = self.motion.stretch if self.motion else 1.0
        self.geometry = BatchedScene(scene.bodies, radii, device, engine=engine, stretch=stretch)
        self.collision = collision_engine(config.geometry, self.geometry)
        self.camera = spec.camera.camera()
        self.beam_mm = spec.laser.standoff_mm[1] + BEAM_BEYOND_MM
        self.organ = scene.bodies.index(scene.organ)
        treated = treatment_of(plan or rings, scene, vary, config.band_mm, config.view_points)
        self.work_camera = self.camera
        if treated.field_rad is not None:
            narrow = min(treated.field_rad, self.camera.fov_rad)
            self.work_camera = replace(self.camera, fov_rad=narrow)
        self.ablation = AblationMap(
            treated.patches,
            0.5 * treated.spot_mm,
            Tissue(spec.laser.absorption_per_mm),
            config.depth_mm if treated.depth_mm is None else treated.depth_mm,
            device,
            exact_lesion=treated.exact_lesion,
        )

        def held(array: np.ndarray) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=self.device)

        self.spec, self.lesions = spec, len(treated.patches)
        self.stretches = treated.stretches
        self.paths_mm, self.centres_mm = held(treated.paths_mm), held(treated.centres_mm)
        self.path_normals = held(treated.normals)
        self.path_mm, self.centre_mm = self.paths_mm[0], self.centres_mm[0]
        self.looks_mm, self.look_normals = held(treated.looks_mm), held(treated.look_normals)

    def start(self, stream: Stream, parts: Mapping[str, ArmPart]) -> tuple[Stream, SceneState]:
        """Draw a lesion for each random number stream; the scene with untouched tissue."""
        lesion = torch.zeros_like(stream.count)
        if self.lesions > 1:
            stream, draw = stream.uniform(0.0, float(self.lesions))
            lesion = draw.long().clamp(max=self.lesions - 1)
        breaths = None
        if self.motion is not None:
            stream, breaths = self.motion.start(stream)
        scene = self._look(parts, lesion, lesion, breaths)
        if not self.lasers:
            return stream, scene
        dose = self.ablation.start(*self._beams(scene, parts), ring=lesion)
        lit = {name: torch.zeros_like(lesion, dtype=torch.bool) for name in self.lasers}
        return stream, replace(scene, dose=dose, lit=lit)

    def step(
        self,
        scene: SceneState,
        parts: Mapping[str, ArmPart],
        power_w: Power,
        dt_s: float,
    ) -> SceneState:
        """The scene after the arms moved and the beams swept with `power_w` for dt_s."""
        breaths = None if scene.breaths is None else scene.breaths.after(dt_s)
        lesion, watched = scene.lesion, scene.watched
        assert lesion is not None, "a state of `start` has a lesion"
        assert watched is not None, "a state of `start` has what is watched"
        after = self._look(parts, lesion, watched, breaths)
        if scene.dose is None:
            return replace(after, donated=scene.donated)
        beams, power = self._beams(after, parts), self._power(power_w, lesion)
        in_place = scene.donated and overwritable(scene.dose.dose)
        dose = self.ablation.advance(
            scene.dose, *beams, power_w=power, dt_s=dt_s, in_place=in_place
        )
        lit = self._lit(power, lesion)
        return replace(after, dose=dose, lit=lit, donated=scene.donated)

    def alone(self, scene: SceneState, arms: Mapping[str, LoneArm]) -> LoneSceneEngine | None:
        """The scene of a state's only environment; None where only `step` can advance it."""
        still = self.motion is None and self.geometry.compiled and len(arms) > 1
        if not still or len(self.lasers) != 1 or len(self.endoscopes) != 1 or scene.dose is None:
            return None
        return LoneSceneEngine(self, scene, arms)

    def fresh_dose(
        self,
        dose: AblationState,
        mask: Tensor,
        scene: SceneState,
        parts: Mapping[str, ArmPart],
    ) -> AblationState:
        """Replace the tissue by untouched tissue where mask (B,) is set, under the scene's beam."""
        beams = self._beams(scene, parts)
        in_place = scene.donated and overwritable(dose.dose)
        return self.ablation.reset(dose, mask, *beams, in_place=in_place, ring=scene.lesion)

    def placement(self, breaths: Breaths | None, ahead_s: float = 0.0) -> Placement | None:
        """Where the moving bodies are, `ahead_s` seconds from now; None where nothing moves."""
        if breaths is None or self.motion is None:
            return None
        return self.motion.placement(self.motion.displacement_mm(breaths, ahead_s)[0])

    def aimed(
        self, parts: Mapping[str, ArmPart], laser: str = LASER, breaths: Breaths | None = None
    ) -> RayHit:
        """Where the beam of a laser ends, (B,), with the arms as in `parts`."""
        return self._aimed(parts, laser, self.placement(breaths))

    def _aimed(self, parts: Mapping[str, ArmPart], laser: str, poses: Placement | None) -> RayHit:
        lines = {name: part.line_mm for name, part in parts.items()}
        beam = parts[laser]
        place = (beam.tip_mm, beam.tip_direction, self.beam_mm, lines, laser)
        return self.collision.cast(*place, poses)

    def path_clearance_mm(
        self, parts: Mapping[str, ArmPart], laser: str, target_mm: Tensor
    ) -> Tensor:
        """(B,) mm: least distance of a beam's path from the skin of the other arms, without limit.

        The path runs along the tip's direction as far as a target (B, 3) mm lies ahead.
        """
        beam = parts[laser]
        ahead = ((target_mm - beam.tip_mm) * beam.tip_direction).sum(1, keepdim=True).clamp(min=0.0)
        tip, end = beam.tip_mm[:, None], (beam.tip_mm + ahead * beam.tip_direction)[:, None]
        away = [
            segment_distance(tip, end, part.line_mm[:, :-1], part.line_mm[:, 1:]).amin(1)
            - self.geometry.radius_mm(name)
            for name, part in parts.items()
            if name != laser
        ]
        return torch.stack(away).amin(0)

    def _look(
        self,
        parts: Mapping[str, ArmPart],
        lesion: Tensor,
        watched: Tensor,
        breaths: Breaths | None,
    ) -> SceneState:
        lines = {name: part.line_mm for name, part in parts.items()}
        poses = self.placement(breaths)
        clearance = self.collision.clearance(lines, poses)
        hits = {name: self._aimed(parts, name, poses) for name in self.lasers}
        points, normals = self.looks_mm[watched], self.look_normals[watched]
        if poses is not None:
            points, normals = poses.points(points), poses.normals(normals)
        ring = (points, normals)
        views = {n: self._seen(parts[n], n, ring, lines, poses) for n in self.endoscopes}
        return SceneState(
            clearance, hits, None, views, lesion=lesion, watched=watched, breaths=breaths
        )

    def _seen(
        self, eye: ArmPart, name: str, ring: tuple[Tensor, Tensor], lines, poses: Placement | None
    ) -> View:
        """What an endoscope sees of the ring's points and normals (B, M, 3)."""
        at = (eye.tip_mm, eye.tip_direction)
        moved = {} if poses is None else {"poses": poses}
        return seen_from(self.geometry, self.work_camera, *at, *ring, lines, own=name, **moved)

    def _beams(
        self, scene: SceneState, parts: Mapping[str, ArmPart]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Ends (B, 3), directions (B, 3) and whether it is on the organ (B,), of one laser's beam.

        With L lasers (B, L, 3), (B, L, 3) and (B, L), in the order of `lasers`.
        """
        each = []
        poses = self.placement(scene.breaths)
        for name in self.lasers:
            hit, aim = scene.hits[name], parts[name].tip_direction
            on = hit.on_organ & (hit.body == self.organ)
            point = hit.point_mm
            if poses is not None:  # the dose is stored in the frame of the organ at rest
                point, aim = poses.at_rest_of(point), poses.directions_at_rest(aim)
            each.append((point, aim, on))
        if len(each) == 1:
            return each[0]
        points, aims, on_organ = zip(*each, strict=True)
        return torch.stack(points, 1), torch.stack(aims, 1), torch.stack(on_organ, 1)

    def _lit(self, power: float | Tensor, like: Tensor) -> dict[str, Tensor]:
        """Whether each laser burns with a power as `_power` gives it; `like` is (B,)."""
        on = on_device(power, self.centre_mm) > 0.0
        on = on if on.ndim == 2 else on.expand(len(like))[:, None]
        return dict(zip(self.lasers, on.unbind(1), strict=True))

    def _power(self, power_w: Power, like: Tensor) -> float | Tensor:
        """W: a number or (B,) for one laser, (B, L) for L lasers; `like` is (B,)."""
        if not isinstance(power_w, Mapping):
            each = [power_w] * len(self.lasers)
        else:
            each = [power_w.get(name, 0.0) for name in self.lasers]
        if len(each) == 1:
            return each[0]
        held = (on_device(one, self.centre_mm) for one in each)
        return torch.stack([one.expand(len(like)) for one in held], 1)


class LoneSceneEngine:
    """The scene of one environment whose bodies do not move, in kept arrays.

    Clearance and the beam's end come from the engine that the task's configuration names, lines of
    sight from the batched one, as in `SceneEngine`. The arrays have a batch of one in front.
    """

    def __init__(self, engine: SceneEngine, scene: SceneState, arms: Mapping[str, LoneArm]):
        assert scene.lesion is not None
        assert scene.watched is not None
        assert scene.dose is not None
        self._engine, self._scene = engine, scene
        laser, eye = engine.lasers[0], engine.endoscopes[0]
        lines = {name: arm.line_mm for name, arm in arms.items()}
        sight = engine.geometry.alone(lines)
        own = engine.collision is engine.geometry
        self.collision = sight if own else engine.collision.alone(lines)
        self._aim = arms[laser].tip_direction
        self.beam = self.collision.beam(arms[laser].tip_mm, self._aim, engine.beam_mm, laser)
        camera, watched = engine.work_camera, int(scene.watched[0])
        nearest, farthest = (float(far) for far in camera.range_mm)
        picture = (LIFT_MM, 0.5 * camera.fov_rad, nearest, farthest)
        points, normals = (
            t[watched][None].contiguous().numpy() for t in (engine.looks_mm, engine.look_normals)
        )
        at = (arms[eye].tip_mm, arms[eye].tip_direction)
        self._look = sight.look(*at, points, normals, picture, SHORT_MM, eye)
        self.dose = engine.ablation.alone(scene.dose)
        self._lit = bool(scene.lit[laser][0])
        self._find()

    def step(self, power_w: float, dt_s: float) -> None:
        """The arms have moved, and the beam swept with power_w for dt_s."""
        self._find()
        on = self.on_organ and self.beam.body[0] == self._engine.organ
        self.dose.advance(self.beam.point_mm, self._aim, on, power_w, dt_s)
        self._lit = power_w > 0.0

    def _find(self) -> None:
        self.collision.clearance()
        self.beam.cast()
        self.view = self._look()

    @property
    def on_organ(self) -> bool:
        """Whether the beam meets the organ."""
        return bool(self.beam.struck[0] == Struck.ORGAN)

    @property
    def least_mm(self) -> float:
        """Least clearance to bodies and between arms, mm."""
        found = self.collision
        return float(min(found.bodies_mm.min(), found.arms_mm.min()))

    @property
    def collides(self) -> bool:
        """An arm touches a body, another arm or itself."""
        found = self.collision
        return bool(min(found.bodies_mm.min(), found.arms_mm.min(), found.self_mm.min()) < 0.0)

    @property
    def state(self) -> SceneState:
        """A copy of the present state."""
        found, beam, view = self.collision, self.beam, self.view
        names = ("struck", "body", "face", "distance_mm", "point_mm", "normal", "incidence_rad")
        hit = RayHit(**{name: _tensor(getattr(beam, name)) for name in names})
        visible = _tensor(view.visible)
        error, reach = _tensor(view.middle).unbind(1)
        laser, eye = self._engine.lasers[0], self._engine.endoscopes[0]
        return replace(
            self._scene,
            clearance=BatchClearance(
                *map(_tensor, (found.bodies_mm, found.arms_mm, found.self_mm))
            ),
            hits={laser: hit},
            dose=self.dose.state,
            views={
                eye: View(
                    visible=visible,
                    hidden=_tensor(view.wanted) & ~visible,
                    fraction=visible.float().mean(-1),
                    axis_error_rad=error,
                    axis_error_mm=reach * error.clamp(0.0, 0.5 * math.pi).sin(),
                    distance_mm=reach,
                )
            },
            lit={laser: torch.tensor([self._lit])},
        )


def _tensor(array: np.ndarray) -> Tensor:
    """A copy of an array as a tensor."""
    return torch.from_numpy(array.copy())


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
        power_w: Power,
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
