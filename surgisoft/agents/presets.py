"""Hyper-parameters of training: presets, their changes for each task, and plans of runs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any

from surgisoft.config import POSITIVE, Rule, at_least, one_of
from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.registry import spec_of
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.images import ImageConfig
from surgisoft.tasks.world.observer import AlphaBetaFilter
from surgisoft.tasks.world.world import WorldConfig

ACTIVATIONS: tuple[str, ...] = (
    "elu",
    "selu",
    "relu",
    "crelu",
    "lrelu",
    "tanh",
    "sigmoid",
    "softplus",
)
ACTIVATIONS += ("softplus", "gelu", "swish", "mish", "identity")
"""Activations by rsl-rl's names."""
MOST_TRANSITIONS = 1 << 21
"""Most steps, over all episodes, between two updates: their storage has to fit into memory."""
Count = Annotated[int, at_least(1)]
Share = Annotated[float, Rule("a number from 0 to 1", lambda value: 0.0 <= value <= 1.0)]
Widths = Annotated[
    tuple[int, ...],
    Rule(
        "a list of 1 to 100 widths from 1 to 10,000",
        lambda widths: 1 <= len(widths) <= 100 and all(1 <= width <= 10_000 for width in widths),
    ),
]
Episodes = Annotated[
    int, Rule("a whole number from 1 to 100,000", lambda count: 1 <= count <= 100_000)
]


@dataclass(frozen=True)
class Preset:
    """Hyper-parameters of one PPO for each agent (Schulman et al. 2017), and of its networks."""

    envs: Count = 256
    """Episodes that run side by side."""
    rollout: Count = 12
    """Steps of each episode between two updates."""
    epochs: Count = 5
    """Passes over those steps in an update."""
    batches: Count = 4
    """Minibatches of a pass."""
    gamma: Share = 0.9
    """Discount of a step."""
    lam: Share = 0.7
    """Lambda of generalised advantage estimation (Schulman et al. 2016)."""
    clip: Annotated[float, POSITIVE] = 0.2
    """Clipping of the probability ratio."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    learning_rate: Annotated[float, POSITIVE] = 1e-3
    """First learning rate of Adam."""
    desired_kl: Annotated[float, POSITIVE] | None = 0.01
    """The learning rate is adapted to this KL divergence of an update; None: it is not."""
    hidden: Widths = (64, 64)
    """Widths of the hidden layers of actors and critics."""
    activation: Annotated[str, one_of(ACTIVATIONS)] = "tanh"
    """Activation of the hidden layers, by rsl-rl's name."""
    normalise: bool = False
    """Whether observations are normalised by their running mean and deviation. Those of the tasks
    are of the order of 1, and a moving normaliser changes the policy between two updates."""
    privileged: bool = False
    """Whether critics also observe what only a simulation knows: the true key points, gains, mounts
    and effects of the episode. Actors never do (asymmetric actor-critic, Pinto et al. 2018)."""
    action_kPa: Annotated[float, POSITIVE] = 1.0
    """Change of pressure for an output of 1, kPa; it is also clipped to the limit of the pumps."""
    noise: Annotated[float, POSITIVE] = 0.5
    """First standard deviation of the actions, in outputs."""
    last_noise: Annotated[float, POSITIVE] | None = 0.005
    """The deviation falls to this, evenly in its logarithm, until the end; None: it is learned."""
    compile: bool = False
    """Whether `torch.compile` builds the loss of an update; on a GPU the arms' step."""
    evaluate_every: Annotated[int, at_least(1)] = 100
    """Updates between two evaluations."""
    evaluation_episodes: Episodes = 32
    """Episodes of an evaluation."""

    def __post_init__(self):
        for name in ("envs", "rollout", "epochs", "batches", "learning_rate", "action_kPa"):
            if not getattr(self, name) > 0:
                raise InputError(f"preset: {name} is {getattr(self, name)}, expected more than 0")
        if self.envs * self.rollout > MOST_TRANSITIONS:
            raise InputError(
                f"preset: {self.envs} envs x {self.rollout} steps are more than "
                f"{MOST_TRANSITIONS} in an update; take fewer envs"
            )
        if (self.envs * self.rollout) // self.batches < 2:
            raise InputError(
                f"preset: {self.envs} envs x {self.rollout} steps in {self.batches} minibatches "
                "leaves fewer than 2 samples in each; take more envs"
            )


RANDOMISED = "randomised"
"""Preset that trains under domain randomization, with the state observer."""

ROBUST = "robust"
"""Preset that trains for robots that differ from the model: wide domain randomization, effects out
of the library, an observer that adapts, and privileged critics."""

PRESETS: dict[str, Preset] = {
    "fast": Preset(),
    RANDOMISED: Preset(),
    ROBUST: Preset(privileged=True),
    "paper": Preset(
        envs=64,
        rollout=64,
        gamma=0.99,
        lam=0.95,
        clip=0.2,
        entropy=0.01,
        learning_rate=3e-4,
        desired_kl=None,
        action_kPa=3.0,
        noise=1.0,
        last_noise=None,
    ),
}
"""Every preset by name. `randomised`: as `fast`, in the world of `RANDOMISED_WORLD`. `robust`: with
privileged critics, in the world of `ROBUST_WORLD`. `paper`: Chen et al. (2025, sec. IV-A): 4096
steps an update, discount 0.99, lambda 0.95, entropy 0.01, clipping 0.2, two layers of 64; what it
does not name is as in Schulman et al. (2017)."""


RANDOMISED_WORLD = {
    "randomisation": Randomisation(mount_mm=0.5, gain=0.02, noise_mm=0.05),
    "observer": AlphaBetaFilter(gain=0.3, drift_gain=0.01),
}
"""Fields of `WorldConfig` with the preset `randomised`: bases that are mounted half a millimetre
off, chambers that push 2 % more or less, cameras with twice the noise of the virtual rig's
(0.022 mm), and the state observer with the gains that it has on rigs (`on_rig.RigConfig`)."""


ROBUST_WORLD = {
    "randomisation": Randomisation(
        mount_mm=1.5, mount_rad=0.02, gain=0.05, noise_mm=0.05, effects_mm=1.5
    ),
    "observer": AlphaBetaFilter(gain=0.3, drift_gain=0.01, adapts=True),
}
"""Fields of `WorldConfig` with the preset `robust`: what two robots of one make differ in, and one
effect an episode that moves the tip by up to 1.5 mm (the virtual rig's hidden effects: about 1 mm
at strength 1)."""
WORLDS = {RANDOMISED: RANDOMISED_WORLD, ROBUST: ROBUST_WORLD}
"""Preset -> fields of `WorldConfig` in which it trains, where it names any."""

PAPER_STEPS = 20_000_000
"""Steps of the paper's training (Chen et al. 2025, sec. IV-A), and of tasks that name no number of
their own."""


def preset_for(name: str, task: str, **changes) -> Preset:
    """The named preset for a task, with some fields changed (None: unchanged).

    An unknown name raises an InputError that lists the known ones.
    """
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    of_task = {} if name == "paper" else spec_of(task).preset
    given = {key: value for key, value in changes.items() if value is not None}
    return replace(PRESETS[name], **{**of_task, **given})


def config_for(name: str, config: Any) -> Any:
    """A task's configuration as the named preset trains it.

    Fields of the world that the configuration sets itself stay as they are.
    """
    if name not in WORLDS:
        return config
    usual = WorldConfig()
    fields = {
        key: value
        for key, value in WORLDS[name].items()
        if getattr(config.world, key) == getattr(usual, key)
    }
    return replace(config, world=replace(config.world, **fields))


def steps_for(name: str, task: str) -> int:
    """Default number of steps that a preset trains a task."""
    steps = None if name == "paper" else spec_of(task).training_steps
    return PAPER_STEPS if steps is None else steps


LEAST_ENVS = 64
"""Fewest episodes side by side that a short training is given by itself."""


def envs_for(name: str, task: str, steps: int) -> int:
    """Episodes side by side of a training of so many steps, where none are named.

    A training that is shorter than the task's own runs fewer of them, by powers of two: so it
    keeps the number of updates, by which the noise falls and on which the final error depends.
    """
    envs = preset_for(name, task).envs
    while envs > LEAST_ENVS and envs * steps_for(name, task) > preset_for(name, task).envs * steps:
        envs //= 2
    return envs


def check_vectors(images: ImageConfig) -> None:
    """Raise InputError where agents would observe images, of which this trainer learns nothing."""
    if images.kinds:
        raise InputError(
            f"images is '{images.images}', but policies of this trainer see vectors only: "
            "leave it empty, or train on surgisoft.batched_env"
        )


@dataclass(frozen=True)
class Plan:
    """One training run."""

    task: str
    """Name of the task."""
    task_config: Any
    """Configuration of the task."""
    preset_name: str
    """Preset that the hyper-parameters come from."""
    preset: Preset
    """Hyper-parameters of networks, rollouts and updates."""
    steps: int | None
    """Steps to train, over all episodes; None: until the time is out."""
    minutes: float | None = None
    """Time to train, minutes; None: until the steps are done."""
    target_error: float | None = None
    """Training ends when evaluation finds no more than this error, mm, and full success."""
    seed: int = 0
    """Seed of weights, noise and episodes."""

    def __post_init__(self):
        if self.steps is None and self.minutes is None:
            raise InputError("train: neither steps nor minutes are given; expected one of them")
        if not 0 <= self.seed < 2**63:
            raise InputError(
                f"train: seed is {self.seed}, expected a whole number from 0 to 2^63 - 1"
            )
        for name in ("steps", "minutes", "target_error"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"train: {name} is {value}, expected more than 0")
        if (world := getattr(self.task_config, "world", None)) is not None:
            check_vectors(world.endoscope_images)

    def whole_steps(self, processes: int = 1) -> int | None:
        """Steps that are trained: those of the plan, rounded up to whole updates of all processes;
        None where the time decides."""
        if self.steps is None:
            return None
        update = self.preset.envs * self.preset.rollout * processes
        return -(-self.steps // update) * update

    def share(self, steps: int, seconds: float) -> float:
        """Share 0..1 of the training that is done."""
        done = [0.0]
        if self.steps is not None:
            done.append(steps / self.steps)
        if self.minutes is not None:
            done.append(seconds / (60.0 * self.minutes))
        return min(1.0, max(done))
