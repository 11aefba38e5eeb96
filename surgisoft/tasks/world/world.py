"""The batched core: arms that bend in a scene, state in, state out.

The one place where geometry and arm physics meet. A single environment is a batch of one; a batch
of N does what N batches of one do. World frame, mm, kPa, s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.scene.folder import Scene, open_scene
from surgisoft.surrogate.checkpoint import default_arm, load_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.tasks.world.arm import Arm, ArmPart, Mounted, Pneumatics, Randomisation
from surgisoft.tasks.world.pytree import rows, with_rows
from surgisoft.tasks.world.random import Stream
from surgisoft.tasks.world.scene import Scenery, SceneryConfig, Surroundings


@dataclass(frozen=True)
class WorldConfig:
    """The numbers of a world."""

    dt_s: float = 0.1
    """Time of a step, s."""
    samples: int = 21
    """Points of each arm's centreline."""
    pneumatics: Pneumatics = field(default_factory=Pneumatics)
    """The pumps."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """What differs from episode to episode."""
    scenery: SceneryConfig = field(default_factory=SceneryConfig)
    """What of the surroundings is computed."""

    def __post_init__(self):
        if not (math.isfinite(self.dt_s) and self.dt_s > 0.0):
            raise InputError(f"world: dt_s is {self.dt_s}, expected more than 0 s")
        if self.samples < 2:
            raise InputError(f"world: samples is {self.samples}, expected at least 2")


@dataclass(frozen=True, eq=False)
class WorldState:
    """A batch of worlds at one instant."""

    stream: Stream
    """Each environment's own random numbers."""
    steps: Tensor
    """(B,) int64: steps since the episode began."""
    arms: dict[str, ArmPart]
    """Each arm by name."""
    scenery: Scenery
    """What surrounds them."""
    failed: Tensor
    """(B,) bool: an arm is not finite; only a reset helps."""


class World:
    """Arms by name, and what surrounds them; built once, holds no state."""

    def __init__(
        self,
        arms: Mapping[str, Mounted],
        config: WorldConfig | None = None,
        surroundings: Surroundings | None = None,
        device: str | torch.device = "cpu",
    ):
        """Without surroundings the arms bend in empty space: no clearance, no beam, no view."""
        self.config, self.device = config or WorldConfig(), torch.device(device)
        self.surroundings = surroundings
        c = self.config
        self.arms = {
            name: Arm(name, mounted, c.pneumatics, c.randomisation, c.samples, self.device)
            for name, mounted in arms.items()
        }

    def start(self, stream: Stream) -> WorldState:
        """Worlds at the start of an episode, one for each of the (B,) streams."""
        parts = {}
        for name, arm in self.arms.items():
            stream, parts[name] = arm.start(stream)
        scenery = Scenery()
        if self.surroundings:
            stream, scenery = self.surroundings.start(stream, parts)
        return WorldState(
            stream, torch.zeros_like(stream.count), parts, scenery, _not_finite(parts)
        )

    def reset(self, state: WorldState, mask: Tensor, in_place: bool = False) -> WorldState:
        """A fresh start where mask (B,) is set, out of each environment's own stream.

        With in_place the old state's dose map is given up.
        """
        index = mask.nonzero()[:, 0]
        if not len(index):
            return state
        dose, state = state.scenery.dose, _without_dose(state)
        fresh = _without_dose(self.start(rows(state.stream, index)))
        state = with_rows(state, index, fresh)
        if dose is None:
            return state
        scenery = state.scenery
        dose = self.surroundings.fresh_dose(dose, mask, scenery, state.arms, in_place)
        return replace(state, scenery=replace(scenery, dose=dose))

    def step(
        self,
        state: WorldState,
        actions: Mapping[str, Tensor],
        power_w: float | Tensor = 0.0,
        in_place: bool = False,
    ) -> WorldState:
        """One step later.

        actions: arm's name -> (B, m) change of pressure, kPa, held to the pumps' largest step.
        power_w: the laser's power, W, a number or (B,), held over the step. With in_place the old
        state's dose map is given up, unless it belongs to an inference_mode that has ended.
        """
        dt_s, stream, parts = self.config.dt_s, state.stream, {}
        for name, arm in self.arms.items():
            stream, parts[name] = arm.step(stream, state.arms[name], actions[name], dt_s)
        scenery = state.scenery
        if self.surroundings:
            scenery = self.surroundings.step(scenery, parts, power_w, dt_s, in_place)
        failed = state.failed | _not_finite(parts)
        return WorldState(stream, state.steps + 1, parts, scenery, failed)


def _not_finite(parts: Mapping[str, ArmPart]) -> Tensor:
    """(B,) bool: some key point is not finite."""
    finite = [part.points_mm.isfinite().flatten(1).all(1) for part in parts.values()]
    return ~torch.stack(finite).all(0)


def _without_dose(state: WorldState) -> WorldState:
    return replace(state, scenery=replace(state.scenery, dose=None))


def lone_arm(
    config: WorldConfig | None = None,
    model: ArmModel | None = None,
    start_kPa: tuple[float, ...] | None = None,
    device: str | torch.device = "cpu",
) -> World:
    """One arm, named `arm`, in empty space; its base frame is the world frame."""
    model = model or default_arm(device)
    return World({"arm": Mounted(model, torch.eye(4), start_kPa)}, config, None, device)


def scene_world(
    scene: Scene | str | Path,
    config: WorldConfig | None = None,
    device: str | torch.device = "cpu",
    engine: str | None = None,
    arm: str | Path | None = None,
) -> World:
    """The two arms of a scene (or its folder), named `laser` and `endoscope`, among its bodies.

    arm: a model for both in place of the scene's own, as for `named_arm`.
    """
    config = config or WorldConfig()
    scene = scene if isinstance(scene, Scene) else open_scene(scene)
    arms = {}
    for mount in scene.spec.mounts:
        pose = torch.tensor(mount.pose(), dtype=torch.float32)
        name, folder = (mount.arm, scene.folder) if arm is None else (arm, ".")
        arms[mount.tool] = Mounted(named_arm(name, device, folder), pose, shaft_mm=mount.shaft_mm)
    vary = config.randomisation
    around = Surroundings(scene, config.scenery, device, engine, vary)
    return World(arms, config, around, device)


def named_arm(name: str | Path, device="cpu", folder: str | Path = ".") -> ArmModel:
    """`default`, or the fitted model in a folder, looked for in `folder`, then as it is."""
    if str(name) == "default":
        return default_arm(device)
    places = (Path(folder) / name, Path(name))
    return load_model(next((place for place in places if place.is_dir()), Path(name)), device)
