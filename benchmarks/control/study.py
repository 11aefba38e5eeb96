"""Benchmark `control`: learned, scripted and random policies on every task and plant.

Runs are in one folder as `TASK-seed-N`; missing ones are trained, others are used as they are.
Evaluations are cached beside them by the content of the policy.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from benchmarks.cache import Cache
from benchmarks.control.policies import Cost, cost, evaluated, plan_of, trained
from benchmarks.control.two_processes import trained_by_two
from surgisoft.agents.on_rig import RigConfig
from surgisoft.agents.presets import PAPER_STEPS
from surgisoft.agents.run_folder import BEST, RunFolder
from surgisoft.config import to_table
from surgisoft.errors import InputError, unknown_name
from surgisoft.progress import Progress, Stages
from surgisoft.tasks.registry import config_of

TASKS = (
    "track_circle",
    "track_square",
    "laser_plane",
    "circle_ablation",
    "track_body",
    "keyhole",
    "two_laser_ring",
    "keyhole_ablation",
)
"""Tasks that policies are trained for and evaluated on."""
PLACES = ("simulation", "rig")
"""Plants of the evaluation."""
RATE_TASK = "track_circle"
"""Task on which the rate of a preset is measured."""


@dataclass(frozen=True)
class ControlConfig:
    """Size of the study."""

    tasks: tuple[str, ...] = TASKS
    """Names of the tasks."""
    seeds: tuple[int, ...] = (1, 2, 3)
    """Seeds of the training runs."""
    episodes: int = 100
    """Episodes of each policy in simulation."""
    rig_episodes: int = 20
    """Episodes of each policy on the rig."""
    episode_seed: int = 1000
    """Seed of the evaluated episodes; training and checkpoint selection use others."""
    rate_steps: int = 1_048_576
    """Steps of preset `paper` for measuring its rate; 0: no measurement."""
    whole_steps: int = PAPER_STEPS
    """Steps of a training by two processes on `RATE_TASK`; 0: none."""

    def __post_init__(self):
        for name in self.tasks:
            if name not in TASKS:
                raise unknown_name("task of this study", name, TASKS)
        if not self.seeds:
            raise InputError("control: no seeds; expected at least one")


@dataclass(frozen=True)
class Trained:
    """One training run."""

    task: str
    """Name of the task."""
    seed: int
    """Seed of the training."""
    preset: str
    """Preset of the training."""
    cost: Cost
    """Cost of the training."""
    best: dict[str, float]
    """Evaluation of the selected checkpoint."""


@dataclass(frozen=True)
class Evaluated:
    """Evaluation of one policy on one task and plant."""

    task: str
    """Name of the task."""
    place: str
    """`simulation` or `rig`."""
    policy: str
    """`learned, seed N`, `scripted` or `random`."""
    numbers: dict[str, dict]
    """name with unit -> fields of `Summary`."""


@dataclass(frozen=True)
class Results:
    """All results of the benchmark."""

    runs: tuple[Trained, ...]
    """All training runs."""
    evaluated: tuple[Evaluated, ...]
    """Evaluations of all policies on all plants."""
    paper: Cost | None
    """The run that measures the rate of preset `paper`."""
    whole: Cost | None = None
    """A run with the paper's number of steps by two processes, for its wall time."""


def run(config: ControlConfig, folder: Path, report: Progress) -> Results:
    """Train what is missing, then evaluate everything that is not in the cache."""
    learned = [(task, seed) for task in TASKS if task in config.tasks for seed in config.seeds]
    plays = 2 * (len(learned) + 2 * len(config.tasks))
    whole = config.whole_steps if RATE_TASK in config.tasks else 0
    alone = 25 * bool(config.rate_steps) + 100 * bool(whole)
    meter = Stages(report, 100 * len(learned) + alone + 5 * (plays + 2 * bool(whole)))
    folder.mkdir(parents=True, exist_ok=True)
    policies, runs, both = [], [], None
    if whole:
        place = folder / f"{RATE_TASK}-{whole}-steps"
        both = trained_by_two(place, RATE_TASK, whole, meter.stage(100, f"train {place.name}"))
        policies.append((RATE_TASK, f"learned, {whole:,} steps", str(place)))
    for task, seed in learned:
        place = folder / f"{task}-seed-{seed}"
        one = _learned(place, task, seed, meter.stage(100, f"train {place.name}"))
        runs.append(one)
        policies.append((task, f"learned, seed {one.seed}", str(place)))
    paper = _paper(config, folder, meter) if config.rate_steps else None
    policies += [(task, name, name) for task in config.tasks for name in ("scripted", "random")]
    kept, shown = Cache(folder / "results"), []
    for where in PLACES:
        for task, name, policy in policies:
            tell = meter.stage(5, f"{task}: {name}, {where}")
            shown.append(
                Evaluated(task, where, name, _evaluated(config, kept, task, where, policy, tell))
            )
    return Results(tuple(runs), tuple(shown), paper, cost(both) if both else None)


def _learned(folder: Path, task: str, seed: int, report: Progress) -> Trained:
    """A finished run as it is, or one trained with the task's number of steps."""
    there = RunFolder(folder) if (folder / "config.json").is_file() else None
    if there is not None and there.config["task"] != task:
        raise InputError(f"{folder}: was trained on {there.config['task']}, expected {task}")
    opened = trained(folder, there.plan() if there else plan_of(task, seed), report)
    best = opened.load(BEST)["evaluation"]
    return Trained(task, opened.config["seed"], opened.config["preset"], cost(opened), best)


def _paper(config: ControlConfig, folder: Path, meter: Stages) -> Cost:
    """A run of preset `paper`, long enough to know its rate."""
    place = folder / f"rate-paper-{config.rate_steps}"
    plan = plan_of(RATE_TASK, 1, config.rate_steps, preset="paper")
    return cost(trained(place, plan, meter.stage(25, "rate of preset paper")))


def _evaluated(
    config: ControlConfig, kept: Cache, task: str, where: str, policy: str, report: Progress
) -> dict:
    """Evaluation of one policy, from the cache where it is there."""
    rig = RigConfig() if where == "rig" else None
    count = config.episodes if rig is None else config.rig_episodes
    about = {
        "task": task,
        "config": to_table(config_of(task)),
        "policy": policy,
        "rig": rig and to_table(rig),
        "episodes": count,
        "seed": config.episode_seed,
    }
    if policy not in ("scripted", "random"):
        content = RunFolder(policy).checkpoint(BEST).read_bytes()
        about["policy"] = hashlib.sha256(content).hexdigest()
    name = f"{task}-{where}"
    return kept.values(
        name, about, lambda: evaluated(task, policy, count, config.episode_seed, rig, report=report)
    )
