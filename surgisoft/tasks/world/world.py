"""The batched simulator: arms that bend in a scene, state in, state out.

This is the one place where geometry and arm physics meet. A single environment is a batch of one,
and a batch of N environments gives what N batches of one give. World frame, mm, kPa, s.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from surgisoft.command_line import typed
from surgisoft.errors import AssumptionWarning, InputError
from surgisoft.scene.folder import Scene, open_scene
from surgisoft.scene.mounted_arm import AXIS_MM as AXIS_MM
from surgisoft.scene.mounted_arm import FEED_MM
from surgisoft.scene.spec import MountSpec
from surgisoft.surrogate.backbone import TIP_TASKS
from surgisoft.surrogate.checkpoint import default_arm, load_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.reach import require_millimetres
from surgisoft.tasks.world.arm import (
    Arm,
    ArmPart,
    LoneArm,
    ModelArm,
    Mounted,
    Pneumatics,
    Randomisation,
)
from surgisoft.tasks.world.images import ImageConfig
from surgisoft.tasks.world.observer import AlphaBetaFilter
from surgisoft.tasks.world.pytree import rows, with_rows
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.respiration import Respiration
from surgisoft.tasks.world.scene import (
    ObstacleEngine,
    Power,
    SceneEngine,
    SceneEngineConfig,
    SceneState,
)
from surgisoft.tasks.world.treatment import Plan

OTHER_LENGTH = 0.1
"""An arm that takes the place of a scene's own may differ by this share of the mount's length: a
longer one begins inside the organ, a shorter one does not reach the lesion."""


@dataclass(frozen=True)
class WorldConfig:
    """Step, resolution, pumps, domain randomization and scene of a world."""

    dt_s: float = 0.1
    """Duration of a step, s."""
    samples: int = 21
    """Points of each arm's centreline (a count)."""
    pneumatics: Pneumatics = field(default_factory=Pneumatics)
    """The pumps."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Domain randomization: what differs between episodes."""
    observer: AlphaBetaFilter = field(default_factory=AlphaBetaFilter)
    """The state observer of every simulated arm; on a rig the rig's own takes its place."""
    scene_engine: SceneEngineConfig = field(default_factory=SceneEngineConfig)
    """Resolution of the scene and its collision engine."""
    endoscope_images: ImageConfig = field(default_factory=ImageConfig)
    """The endoscope's image as a part of the observations."""

    FORMER_NAMES: ClassVar[dict[str, str]] = {"scenery": "scene_engine"}

    def __post_init__(self):
        if not (math.isfinite(self.dt_s) and self.dt_s > 0.0):
            raise InputError(f"world: dt_s is {self.dt_s}, expected more than 0 s")
        if self.samples < 2:
            raise InputError(f"world: samples is {self.samples}, expected at least 2")


@dataclass(frozen=True)
class Feed:
    """Carriages that feed all arms in along their axes at the beginning of an episode."""

    way_mm: float = FEED_MM
    """Distance of each base behind its mount when an episode begins, mm."""
    speed_mm_s: float = 10.0
    """Speed of the feed until the bases are at their mounts, mm/s."""
    wait_s: float = 5.0
    """Time before the feed begins, in which the arms can be straightened, s."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= (0.0 if name == "wait_s" else 1e-3)):
                raise InputError(f"feed: {name} is {value}, expected above 0 (wait_s: 0 or more)")

    def move_mm(self, out_mm: Tensor, steps: Tensor, dt_s: float) -> Tensor:
        """(B,) mm: the feed in a step of bases (B,) mm behind their mounts, after (B,) steps."""
        begun = steps * dt_s >= self.wait_s - 0.5 * dt_s
        return out_mm.clamp(max=self.speed_mm_s * dt_s) * begun


@dataclass(frozen=True, eq=False)
class WorldState:
    """The state of B environments."""

    stream: Stream
    """Random number stream of each environment."""
    steps: Tensor
    """(B,) int64: steps since the episode began."""
    arms: dict[str, ArmPart]
    """Each arm by name."""
    scene: SceneState
    """The scene around them."""
    failed: Tensor
    """(B,) bool: an arm is not finite; the environment stays failed until it is reset."""
    out_mm: Tensor | None = None
    """(B,) mm: by how much the arms' bases are behind their mounts; None without a feed."""

    def donated(self) -> WorldState:
        """Copy of the state whose buffers a step or reset may overwrite.

        Only the owner of a state may ask for this, because the state is invalid afterwards.
        """
        return replace(self, scene=replace(self.scene, donated=True))


class World:
    """Arms by name in a scene, or in empty space; built once, holds no state."""

    def __init__(
        self,
        arms: Mapping[str, Mounted],
        config: WorldConfig | None = None,
        scene: SceneEngine | ObstacleEngine | None = None,
        device: str | torch.device = "cpu",
        passive: Sequence[str] = (),
        feed: Feed | None = None,
    ):
        """Without a scene the arms bend in empty space: no clearance, no beam, no view.

        passive: names of arms that no agent drives; they hold their commanded pressures. feed: how
        the arms are fed in; None: their bases are at the mounts from the beginning.
        """
        self.config, self.device = config or WorldConfig(), torch.device(device)
        self.passive, self.feed = tuple(passive), feed
        self.scene = scene
        if scene is not None:
            for name, mounted in arms.items():
                mounted.model.require_body(f"arm '{name}'")
        c = self.config
        self.arms: dict[str, Arm] = {}
        made: dict[int, ModelArm] = {}
        for name, mounted in arms.items():
            arm = ModelArm(
                name,
                mounted,
                c.pneumatics,
                c.randomisation,
                c.samples,
                self.device,
                c.observer,
                c.dt_s,
                made.get(id(mounted.model)),
            )
            self.arms[name] = made[id(mounted.model)] = arm

    def start(self, stream: Stream) -> WorldState:
        """Start an episode of the world for each of the (B,) random number streams."""
        parts = {}
        for name, arm in self.arms.items():
            stream, parts[name] = arm.start(stream)
        out_mm = None
        if self.feed:
            out_mm = torch.full_like(stream.count, self.feed.way_mm, dtype=torch.float32)
            for name, arm in self.arms.items():
                part = fed(parts[name], -out_mm)
                parts[name] = arm.posed(part, part.points_mm)
        scene = SceneState()
        if self.scene:
            stream, scene = self.scene.start(stream, parts)
        steps = torch.zeros_like(stream.count)
        return WorldState(stream, steps, parts, scene, _not_finite(parts), out_mm)

    def reset(self, state: WorldState, mask: Tensor) -> WorldState:
        """Restart the environments where mask (B,) is set, each with its random number stream."""
        index = mask.nonzero()[:, 0]
        if not len(index):
            return state
        dose, state = state.scene.dose, _without_dose(state)
        fresh = _without_dose(self.start(rows(state.stream, index)))
        state = with_rows(state, index, fresh)
        if dose is None or not isinstance(self.scene, SceneEngine):
            return state
        dose = self.scene.fresh_dose(dose, mask, state.scene, state.arms)
        return replace(state, scene=replace(state.scene, dose=dose))

    def step(
        self,
        state: WorldState,
        actions: Mapping[str, Tensor],
        power_w: Power = 0.0,
    ) -> WorldState:
        """Advance every environment by one step of `config.dt_s`.

        actions: arm's name -> (B, m) change of the commanded pressure, kPa, clipped to the pumps'
        largest step; `passive` arms need none and hold theirs. power_w: the lasers' power, constant
        over the step. Raises InputError where an action is missing or has another shape.
        """
        dt_s, stream, parts = self.config.dt_s, state.stream, {}
        out_mm, move_mm = state.out_mm, None
        if self.feed and out_mm is not None:
            move_mm = self.feed.move_mm(out_mm, state.steps, dt_s)
            out_mm = out_mm - move_mm
        for name, arm in self.arms.items():
            part = state.arms[name]
            part = part if move_mm is None else fed(part, move_mm)
            held = name in self.passive and name not in actions
            action = torch.zeros_like(part.command) if held else _action(actions, name, part)
            stream, parts[name] = arm.step(stream, part, action, dt_s)
        scene = state.scene
        if self.scene:
            scene = self.scene.step(scene, parts, power_w, dt_s)
        failed = state.failed | _not_finite(parts)
        return WorldState(stream, state.steps + 1, parts, scene, failed, out_mm)


def _action(actions: Mapping[str, Tensor], name: str, part: ArmPart) -> Tensor:
    """An arm's action. The compiled loops of a step read as many numbers as it has to have."""
    if name not in actions:
        raise InputError(f"no action for '{name}', expected one for each arm that an agent drives")
    action, expected = actions[name], part.command.shape
    if action.shape != expected:
        raise InputError(
            f"action of '{name}' has shape {tuple(action.shape)}, expected {tuple(expected)}"
        )
    return action


class LoneWorld:
    """One environment of a world with a laser and an endoscope, stepped in kept arrays.

    At a batch of one the cost of a step is that of its calls and not of its arithmetic. This world
    calls the compiled loops of `World.step` with arrays that are allocated once, and makes tensors
    only where a state is asked for.
    """

    def __init__(self, world: World, state: WorldState, arms: dict[str, LoneArm], scene):
        self._state, self.dt_s = state, world.config.dt_s
        self.arms, self.scene = arms, scene
        self.steps = int(state.steps[0])
        """Steps since the episode began."""
        self.failed = bool(state.failed[0])
        """An arm is not finite."""

    @classmethod
    def of(cls, world: World, state: WorldState) -> LoneWorld | None:
        """The world of a state's only environment; None where only `World.step` can advance it."""
        still = world.feed is None and not world.passive
        if not still or len(state.steps) != 1 or world.device.type != "cpu":
            return None
        if not isinstance(world.scene, SceneEngine):
            return None
        arms: dict[str, LoneArm] = {}
        for name, arm in world.arms.items():
            lone = arm.alone(state.arms[name], world.config.dt_s) if type(arm) is ModelArm else None
            if lone is None:
                return None
            arms[name] = lone
        scene = world.scene.alone(state.scene, arms)
        return None if scene is None else cls(world, state, arms, scene)

    def step(self, actions: Mapping[str, np.ndarray], power_w: float) -> None:
        """Advance by one step; actions: arm's name -> (m,) kPa."""
        for name, arm in self.arms.items():
            arm.action[0] = actions[name]
            arm.step()
            self.failed = self.failed or not math.isfinite(arm.points_mm.sum())
        self.scene.step(power_w, self.dt_s)
        self.steps += 1

    @property
    def state(self) -> WorldState:
        """A copy of the present state."""
        return replace(
            self._state,
            steps=torch.full_like(self._state.steps, self.steps),
            arms={name: arm.part for name, arm in self.arms.items()},
            scene=self.scene.state,
            failed=torch.full_like(self._state.failed, self.failed),
        )


def fed(part: ArmPart, move_mm: Tensor) -> ArmPart:
    """The arm with base and key points moved by (B,) mm along its base's axis."""
    shift = move_mm[:, None] * part.mount[:, :3, 2]
    mount = part.mount.clone()
    mount[:, :3, 3] += shift
    points, seen = part.points_mm + shift[:, None], part.seen_mm + shift[:, None]
    belief = part.belief
    if belief is not None:
        # the feed is known to the observer
        belief = replace(belief, fed_mm=belief.fed_mm + shift[:, None])
    known = part.known_mount
    if known is not None:
        known = known.clone()
        known[:, :3, 3] += shift
    return replace(
        part, mount=mount, points_mm=points, seen_mm=seen, belief=belief, known_mount=known
    )


def _not_finite(parts: Mapping[str, ArmPart]) -> Tensor:
    """(B,) bool: some key point is not finite, or so far away that their sum is not."""
    finite = [part.points_mm.flatten(1).sum(1).isfinite() for part in parts.values()]
    return ~torch.stack(finite).all(0)


def _without_dose(state: WorldState) -> WorldState:
    return replace(state, scene=replace(state.scene, dose=None))


def say_assumed(task: str, arms: Mapping[str, Arm]) -> None:
    """Warn the caller of the caller where the body of an arm in the named task is an assumption."""
    arcs = [name for name, arm in arms.items() if arm.key_points == 1]
    if arcs and task not in TIP_TASKS:
        named = " and ".join(f"'{name}'" for name in arcs)
        warnings.warn(
            f"{task}: only the tip of arm {named} was measured; body and tip axis are those "
            "of an arc of constant curvature from the base to the tip, which no data check",
            AssumptionWarning,
            stacklevel=3,
        )


def single_arm_world(
    config: WorldConfig | None = None,
    model: ArmModel | None = None,
    start_kPa: tuple[float, ...] | None = None,
    device: str | torch.device = "cpu",
) -> World:
    """A world of one arm, named `arm`, in empty space; its base frame is the world frame."""
    model = model or default_arm(device)
    return World({"arm": Mounted(model, torch.eye(4), start_kPa)}, config, None, device)


def scene_world(
    scene: Scene | str | Path,
    config: WorldConfig | None = None,
    device: str | torch.device = "cpu",
    engine: str | None = None,
    arm: str | Path | None = None,
    agents: Sequence[str] | None = None,
    plan: Plan | None = None,
    respiration: Respiration | None = None,
    time_s: float = 0.0,
    feed: Feed | None = None,
) -> World:
    """World of a scene (or its folder): its bodies and its arms, named as in the scene.

    arm: a model for all arms instead of those that the scene names, as for `named_arm`. agents:
    names of the arms that a task drives, the others are passive; None: all arms. plan: what is to
    be treated; None: a ring around the scene's lesion. respiration: how the organ moves, in
    episodes of up to time_s seconds; None: not at all. feed: see `World`.
    """
    config = config or WorldConfig()
    scene = scene if isinstance(scene, Scene) else open_scene(scene)
    agents = tuple(scene.spec.arms if agents is None else agents)
    check_arms(scene, agents)
    arms, models = {}, {}
    for arm_name, mount in scene.spec.arms.items():
        pose = torch.tensor(mount.pose(), dtype=torch.float32)
        name, folder = (mount.arm, scene.folder) if arm is None else (arm, ".")
        if name not in models:
            models[name] = named_arm(name, device, folder)
        model = models[name]
        if arm is not None:
            _check_length(model, mount, scene, arm)
        arms[arm_name] = Mounted(model, pose, shaft_mm=mount.shaft_mm)
    vary = config.randomisation
    given = (config.scene_engine, device, engine, vary, plan, respiration, time_s)
    around = SceneEngine(scene, *given)
    passive = [name for name in arms if name not in agents]
    return World(arms, config, around, device, passive, feed)


def check_arms(scene: Scene, agents: Sequence[str]) -> None:
    """Raise unless a scene has the named arms."""
    absent = [name for name in agents if name not in scene.spec.arms]
    if absent:
        raise InputError(
            f"scene '{scene.spec.name}' has the arms {', '.join(scene.spec.arms)}, expected "
            f"{', '.join(agents)}; make a scene with 'surgisoft scene new --arms TOOL,...', or "
            "name the arms of its mounts so"
        )


def _check_length(model: ArmModel, mount: MountSpec, scene: Scene, arm: str | Path) -> None:
    """Raise where the mounts of a scene were found for an arm of another length."""
    length = model.spec.length_mm
    if length is None or abs(length - mount.length_mm) <= OTHER_LENGTH * mount.length_mm:
        return
    raise InputError(
        f"arm '{arm}' is {length:g} mm long, and the scene '{scene.spec.name}' mounts an arm of "
        f"{mount.length_mm:g} mm as the {mount.tool}; make a scene for it: surgisoft scene new "
        f"MESH --arm {typed(arm)} -o DIR"
    )


def named_arm(
    name: str | Path, device: str | torch.device = "cpu", folder: str | Path = "."
) -> ArmModel:
    """Load `default`, or the fitted model in a folder, relative to `folder` or as it is.

    Raises InputError where its key points are not in mm.
    """
    if str(name) == "default":
        return default_arm(device)
    places = (Path(folder) / name, Path(name))
    model = load_model(next((place for place in places if place.is_dir()), Path(name)), device)
    require_millimetres(model, str(name))
    return model
