"""Benchmark `robust`: `circle_ablation` on rigs of robots that took no part in any training.

Every method is judged with the model of the package, so that the rig is another robot of the same
make, and with models of the robot itself: a lab records ten minutes of it and fits a model to them
(`surgisoft fit`), or adds to the model of the package what they show (`surgisoft improve`). Hidden
effects, which no model has, are then switched on one at a time. Every case, one robot with one
method, is a file in the folder of the study, so that an interrupted study goes on where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import cycle, groupby
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.cache import Cache
from benchmarks.robust_floor import Floor, floor
from surgisoft.agents.evaluate import evaluate, student
from surgisoft.agents.on_rig import RigConfig, named_rig, on_rig
from surgisoft.agents.policies import open_policy
from surgisoft.agents.run_folder import RunFolder
from surgisoft.diagnosis.improve import improve
from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.histories import arm_spec, history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.progress import Progress, Stages
from surgisoft.rig import Rig, VirtualRig
from surgisoft.rig.hidden import HIDDEN
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.surrogate.fit import FitConfig, fit
from surgisoft.tasks.base import Task
from surgisoft.tasks.registry import config_of, make_task, with_fields
from surgisoft.tasks.world.arm import Randomisation

TASK = "circle_ablation"
"""The task that is judged."""
DEVELOPMENT = range(21)
"""Seeds of robots on which the observer's constants were chosen, or that earlier results show."""
MINUTES_POINTS = 12_000
"""Samples of a robot's own recording: ten minutes of `mixed` at 20 Hz."""
SIDE_BY_SIDE = 300
"""Most episodes in one batch, a count: the cost of a step hardly grows up to some hundred."""
POSES = Randomisation.history
"""Usual number of random pressures before an episode."""
FIRE_MM = 0.5
"""Measured distance of the beam from its target within which it is released, mm."""
FILTER, LEARNS = "filter", "learns"
"""The two observers: an alpha-beta filter with one gain, or `tasks.world.adaptation`."""
DEFAULT, OWN, IMPROVED = "of the package", "of the robot", "of the package, improved"
"""The arm models. The second is fitted to ten minutes of the robot, and the third is the first one
with the effects that `improve` adds to it by the same recording."""


@dataclass(frozen=True)
class Method:
    """A controller and what estimates the arms for it."""

    name: str
    """Name in the table."""
    policy: str
    """`scripted`, or the folder or name of a training run."""
    observer: str
    """`FILTER` or `LEARNS`."""


@dataclass(frozen=True)
class Study:
    """Size of the study."""

    methods: tuple[Method, ...]
    """What is compared."""
    robots: tuple[int, ...]
    """Seeds of the robots."""
    own: tuple[int, ...]
    """Those that a model is fitted to, too."""
    improved: tuple[int, ...]
    """Those for which the package's model is improved, too."""
    episodes: int
    """Episodes of each robot."""
    hidden_methods: tuple[str, ...]
    """Names of the methods that are judged with hidden effects."""
    hidden_robots: tuple[int, ...]
    """Robots with hidden effects."""
    hidden_episodes: int
    """Episodes of each hidden effect on each of these robots."""
    hidden: tuple[str, ...] = tuple(HIDDEN)
    """Names of the hidden effects."""
    exact: bool = True
    """Whether FCL decides about contact; else the engine of training."""
    poses: int = POSES
    """Random pressures, 4 s each, before an episode: observers that learn learn from them."""
    seed: int = 2000
    """Seed of the episodes, which no training has; robots that are judged together have different
    episodes of it."""

    def __post_init__(self):
        every = {*self.robots, *self.own, *self.improved, *self.hidden_robots}
        known = sorted(robot for robot in every if robot in DEVELOPMENT)
        if known:
            raise InputError(
                f"robust: robots {', '.join(map(str, known))} took part in the development; "
                f"expected seeds from {DEVELOPMENT.stop}"
            )
        for name in self.hidden:
            if name not in HIDDEN:
                raise unknown_name("hidden effect", name, HIDDEN)
        names = [method.name for method in self.methods]
        for name in self.hidden_methods:
            if name not in names:
                raise InputError(f"robust: method '{name}', expected one of {', '.join(names)}")


@dataclass(frozen=True)
class Row:
    """One robot with one method."""

    method: str
    """Name of the method."""
    model: str
    """`DEFAULT`, `OWN` or `IMPROVED`."""
    robot: int
    """Seed of the robot."""
    hidden: str
    """Name of the hidden effect; empty without one."""
    cut: list[bool]
    """Of each episode: whether the ring was cut without contact."""
    contact: list[bool]
    """Whether anything touched anything."""
    beam_error_mm: list[float]
    """Mean true distance of the beam's axis from its target while the beam is on."""
    pointing_error_mm: list[float]
    """The same at every step after the first 5 s, with the beam on or off: not truncated."""
    pointing_error_p95_mm: list[float]
    """95 % quantile of that distance over the episode."""
    share_on: list[float]
    """Time in which the ring was cut over the time that was allowed; 1 where it was not cut."""
    clearance_mm: list[float]
    """Least clearance."""


@dataclass(frozen=True)
class Case:
    """One robot with one method: what a `Row` is made of, and its place in the cache."""

    method: Method
    """What drives the arms."""
    model: str
    """`DEFAULT`, `OWN` or `IMPROVED`."""
    robot: int
    """Seed of the robot."""
    hidden: str
    """Name of the hidden effect; empty without one."""
    episodes: int
    """Number of episodes."""
    seed: int
    """Seed of the episodes."""
    exact: bool
    """Whether FCL decides about contact."""
    poses: int
    """Random pressures before an episode."""

    @property
    def name(self) -> str:
        """Name of the case in the cache."""
        return f"{self.method.name}-{self.robot}".replace(" ", "-")

    @property
    def about(self) -> dict[str, Any]:
        """What the results depend on."""
        poses = {} if self.poses == POSES else {"poses": self.poses}
        return {
            **poses,
            "policy": _identity(self.method.policy),
            "observer": self.method.observer,
            "model": self.model,
            "robot": self.robot,
            "hidden": self.hidden,
            "episodes": self.episodes,
            "seed": self.seed,
            "exact": self.exact,
        }

    def place(self, cache: Cache) -> Path:
        """File of the case's results."""
        return cache.place(self.name, self.about).with_suffix(".json")

    def kept(self, cache: Cache, make: Callable[[], dict[str, list]]) -> dict[str, list]:
        """Results out of the cache, which `make` gives where they are not there."""
        return cache.values(self.name, self.about, make)


def _absent(case: Case) -> dict[str, list]:
    raise InputError(f"robust: the result of {case.name} went missing from the folder of the study")


def _together(cases: Sequence[Case]) -> Iterator[list[Case]]:
    """Cases in groups whose episodes run side by side: one method, one arm model, one length."""

    def alike(case: Case) -> tuple:
        own = None if case.model == DEFAULT else case.robot
        return case.method, case.model, own, case.episodes

    for _, same in groupby(cases, alike):
        some = list(same)
        size = max(1, SIDE_BY_SIDE // some[0].episodes)
        yield from (some[first : first + size] for first in range(0, len(some), size))


def run(study: Study, folder: Path, report: Progress) -> tuple[list[Row], list[Floor]]:
    """Judge all methods; cases that are in the folder are not judged again."""
    kept = Cache(folder / "cases")
    jobs = [
        (method, model, robot, "", study.episodes)
        for method in study.methods
        for model, robots in (
            (DEFAULT, study.robots),
            (OWN, study.own),
            (IMPROVED, study.improved),
        )
        for robot in robots
    ]
    jobs += [
        (method, DEFAULT, robot, hidden, study.hidden_episodes)
        for method in study.methods
        if method.name in study.hidden_methods
        for hidden in study.hidden
        for robot in study.hidden_robots
    ]
    cases = [
        Case(method, model, robot, hidden, episodes, study.seed, study.exact, study.poses)
        for method, model, robot, hidden, episodes in jobs
    ]
    missing = [case for case in cases if not case.place(kept).is_file()]
    stages = Stages(report, len(missing))
    for some in _together(missing):
        first, arm = some[0], None
        note = f"{first.method.name}, model {first.model}, robot {first.robot} {first.hidden}"
        stage = stages.stage(len(some), f"{note.strip()} and {len(some) - 1} further cases")
        if first.model == OWN:
            arm = own_model(first.robot, folder)
        elif first.model == IMPROVED:
            arm = improved_model(first.robot, folder)
        for case, values in zip(some, _judged(some, arm, stage), strict=True):
            case.kept(kept, lambda values=values: values)
    rows = []
    for case in cases:
        values = case.kept(kept, partial(_absent, case))
        rows.append(Row(case.method.name, case.model, case.robot, case.hidden, **values))
    about = {"floor": list(study.robots), "poses": study.poses}
    robots, poses = study.robots, study.poses
    floors = kept.values("floor", about, lambda: [asdict(floor(r, poses)) for r in robots])
    return rows, [Floor(**each) for each in floors]


def _identity(policy: str) -> str:
    """What a policy depends on, for the cache."""
    if policy == "scripted":
        return policy
    return str(RunFolder(policy).checkpoint("best").stat().st_size) + RunFolder(policy).path.name


def ten_minutes(robot: int) -> Recording:
    """A robot's own recording, from which its models are made."""
    rig = VirtualRig(robot)
    recording, _ = rig.record(make_protocol("mixed", rig.limits, MINUTES_POINTS, seed=robot))
    return recording


def own_model(robot: int, folder: Path) -> Path:
    """Folder of the model that is fitted to ten minutes of a robot; made once."""
    place = folder / "models" / f"robot-{robot}"
    if not (place / "config.json").is_file():
        recording = ten_minutes(robot)
        config = FitConfig(effects=("hysteresis",), prior="none", seed=robot)
        result = fit(history_of([recording]), None, arm_spec([recording]), config)
        save_model(result.model, place, result.report(), force=True, known=result.known)
    return place


def improved_model(robot: int, folder: Path) -> Path:
    """Folder of the package's model after `improve` with ten minutes of a robot; made once."""
    place = folder / "models" / f"robot-{robot}-improved"
    if not (place / "config.json").is_file():
        result = improve(default_arm(), [ten_minutes(robot)])
        save_model(result.model, place, result.to_json(), force=True)
    return place


def _judged(cases: Sequence[Case], arm: Path | None, report: Progress) -> list[dict[str, list]]:
    """Fields of a `Row` for each of the cases, whose episodes run side by side.

    Episode i of the seed is on the robot of case i // episodes. arm: folder of the model, None for
    that of the package.
    """
    one = cases[0]
    task = robust_task(arm, one.poses)
    config = RigConfig(adapts=one.method.observer == LEARNS)
    place = on_rig(task, config, Robots(cases))
    policy = open_policy(one.method.policy, place)
    count = len(cases) * one.episodes
    found = evaluate(place, one.method.name, policy, count, one.seed, one.exact, count, report)
    each = found.per_episode
    allowed = task.steps * task.world.config.dt_s
    columns = {
        "cut": [bool(value) for value in each["success"]],
        "contact": [bool(value) for value in each["collided"]],
        "beam_error_mm": _plain(each["beam_error_mean_mm"]),
        "pointing_error_mm": _plain(each["pointing_error_mean_mm"]),
        "pointing_error_p95_mm": _plain(each["pointing_error_p95_mm"]),
        "share_on": _plain(each["time_s"] / allowed),
        "clearance_mm": _plain(each["clearance_mm"]),
    }
    size = one.episodes
    return [
        {name: values[first : first + size] for name, values in columns.items()}
        for first in range(0, count, size)
    ]


class Robots:
    """Makes the rigs of episodes that run side by side, each on the robot of its case.

    Every arm is asked for one rig to check, and then for the rigs of all episodes in their order.
    """

    def __init__(self, cases: Sequence[Case]):
        self._rows = cycle([case for case in cases for _ in range(case.episodes)])
        self._first = cases[0]

    def __call__(self, config: RigConfig, trial: int) -> Rig:
        """The rig of a trial; 0 is that of the check."""
        case = next(self._rows) if trial else self._first
        hidden = ((case.hidden, 1.0),) if case.hidden else ()
        return named_rig(replace(config, seed=case.robot, hidden=hidden), trial)


def robust_task(arm: Path | None, poses: int) -> Task:
    """The task with its usual rules, and the model of the package or one of the robot."""
    config: Any = with_fields(config_of(TASK), fire_mm=FIRE_MM)
    vary = replace(config.world.randomisation, history=poses)
    config = replace(config, world=replace(config.world, randomisation=vary))
    return make_task(TASK, config if arm is None else with_fields(config, arm=str(arm)))


def _plain(values: np.ndarray) -> list[float]:
    return [float(value) for value in values]


def _rate(flags: Sequence[bool]) -> str:
    """`37 of 40 (80 to 97 %)`: with Wilson's (1927) 95 % interval."""
    low, high = binomtest(sum(flags), len(flags)).proportion_ci(0.95, "wilson")
    return f"{sum(flags)} of {len(flags)} ({100 * low:.0f} to {100 * high:.0f} %)"


def _mean(values: Sequence[float]) -> str:
    """Mean with its 95 % interval, Student's (1908) over the robots."""
    known = np.array([value for value in values if np.isfinite(value)])
    if len(known) < 2:
        return f"{known.mean():.3f}" if len(known) else "-"
    low, high = student(known)
    return f"{known.mean():.3f} ({low:.3f} to {high:.3f})"


def _of(rows: Sequence[Row], field: str) -> list:
    return [value for row in rows for value in getattr(row, field)]


def _by_robot(rows: Sequence[Row], field: str) -> list[float]:
    return [float(np.nanmean(values)) for row in rows if (values := getattr(row, field))]


def markdown(rows: list[Row], floors: list[Floor], study: Study) -> str:
    """The tables of the study."""
    robots = f"{study.robots[0]} to {study.robots[-1]}"
    lines = [
        f"`{TASK}` with the beam released within {FIRE_MM} mm of its target, as measured; "
        f"{study.episodes} episodes (seed {study.seed}) on each of the robots {robots} of the "
        "virtual rig. None of them took part in a training, a fit of the package, or a choice of a "
        f"constant. Before an episode each arm goes through {study.poses} random pressures, 4 s "
        "each. Errors are true ones; "
        f"{'FCL' if study.exact else 'the engine of training'} decides about contact. Rates with "
        "Wilson's 95 % interval, means with Student's over the robots.",
        "",
        "| policy, observer | arm model | ring cut | beam error, mm | pointing error, mm "
        "| its 95 % quantile, mm | contact | time, share |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for method in study.methods:
        for model in (DEFAULT, OWN, IMPROVED):
            some = [r for r in rows if (r.method, r.model, r.hidden) == (method.name, model, "")]
            if not some:
                continue
            lines.append(
                f"| {method.name} | {model} | {_rate(_of(some, 'cut'))} "
                f"| {_mean(_by_robot(some, 'beam_error_mm'))} "
                f"| {_mean(_by_robot(some, 'pointing_error_mm'))} "
                f"| {np.mean(_of(some, 'pointing_error_p95_mm')):.2f} "
                f"| {sum(_of(some, 'contact'))} | {np.mean(_of(some, 'share_on')):.2f} |"
            )
    lines += ["", *_hidden_lines(rows, study), "", *_floor_lines(rows, floors, study)]
    return "\n".join(lines) + "\n"


def _hidden_lines(rows: list[Row], study: Study) -> list[str]:
    """The table of hidden effects."""
    names = study.hidden_methods
    if not (names and study.hidden_robots):
        return []
    number = len(study.hidden_robots) * study.hidden_episodes
    lines = [
        "## With a hidden effect",
        "",
        f"Each hidden effect at strength 1, model of the package, {number} episodes (robots "
        f"{', '.join(map(str, study.hidden_robots))}): rings cut, and mean beam error in mm.",
        "",
        "| hidden effect | " + " | ".join(names) + " |",
        "|---" * (len(names) + 1) + "|",
    ]

    def cell(some: list[Row]) -> str:
        error = np.nanmean(_of(some, "beam_error_mm"))
        return f"{sum(_of(some, 'cut'))} of {len(_of(some, 'cut'))}, {error:.2f}"

    for hidden in study.hidden:
        parts = [[r for r in rows if (r.method, r.hidden) == (name, hidden)] for name in names]
        if all(parts):
            lines.append(f"| `{hidden}` | " + " | ".join(cell(part) for part in parts) + " |")
    every = [[r for r in rows if r.method == name and r.hidden] for name in names]
    if all(every):
        cells = [f"{_rate(_of(e, 'cut'))}, contact {sum(_of(e, 'contact'))}" for e in every]
        lines.append("| all | " + " | ".join(cells) + " |")
    return lines


def _floor_lines(rows: list[Row], floors: list[Floor], study: Study) -> list[str]:
    """What the cameras' noise alone allows."""

    def mean(field: str) -> float:
        return float(np.mean([getattr(each, field) for each in floors]))

    return [
        "## What the cameras allow",
        "",
        "The robots' own camera noise on an arm that is exactly the model: mean error of the "
        "estimated beam at its target along the ring, over the same robots.",
        "",
        "| estimate | mm |",
        "|---|---|",
        f"| a single picture | {mean('raw_mm'):.3f} |",
        f"| alpha-beta filter | {mean('filter_mm'):.3f} |",
        f"| observer that learns | {mean('learns_mm'):.3f} |",
        "",
        f"1.5 times that floor is {1.5 * mean('learns_mm'):.3f} mm.",
    ]


def draw(rows: list[Row], floors: list[Floor], study: Study, folder: Path) -> Path:
    """Write the figure: mean beam error of every robot by method and model."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    groups = [
        (method, model)
        for method in study.methods
        for model in (DEFAULT, OWN, IMPROVED)
        if any((r.method, r.model, r.hidden) == (method.name, model, "") for r in rows)
    ]
    figure, axes = plt.subplots(figsize=(8.0, 0.42 * len(groups) + 1.4), layout="constrained")
    for place, (method, model) in enumerate(groups):
        some = [r for r in rows if (r.method, r.model, r.hidden) == (method.name, model, "")]
        each, cut = _by_robot(some, "pointing_error_mm"), _of(some, "cut")
        colour = "tab:blue" if method.observer == LEARNS else "tab:orange"
        axes.plot(each, np.full(len(each), place), "o", color=colour, alpha=0.6, ms=5)
        axes.text(
            1.02,
            place,
            f"{sum(cut)} of {len(cut)}",
            va="center",
            transform=axes.get_yaxis_transform(),
        )
    axes.set_yticks(range(len(groups)), [f"{m.name}, model {kind}" for m, kind in groups])
    level = float(np.mean([each.learns_mm for each in floors]))
    axes.axvline(level, color="0.5", ls=":", label="cameras' noise alone")
    axes.axvline(0.15, color="0.3", ls="--", label="goal")
    axes.set(
        xlabel="mean distance of the beam from its target [mm], one dot a robot", xlim=(0, None)
    )
    axes.text(1.02, -0.8, "rings cut", transform=axes.get_yaxis_transform())
    axes.set_ylim(len(groups) - 0.4, -0.6)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "robust.png"
    figure.savefig(file, dpi=150)
    plt.close(figure)
    return file
