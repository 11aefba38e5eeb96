"""Evaluate policies by the names of their tasks and the folders of their runs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch

from surgisoft.agents.evaluate import (
    CONFIDENCE,
    Evaluation,
    differences,
    exact_checks_of,
    summarised,
    watched_by,
)
from surgisoft.agents.exact_checks import ExactChecks
from surgisoft.agents.learned import check_fits
from surgisoft.agents.policies import POLICIES, Policy, check_policy, open_policy
from surgisoft.agents.policy_names import short_names, without_repeats
from surgisoft.agents.rollout import BATCH, EpisodeRecorders, rollout
from surgisoft.agents.run_folder import RunFolder
from surgisoft.config import to_table
from surgisoft.errors import InputError, Interrupted, counted, wrong_type
from surgisoft.files import json_safe, with_former_keys
from surgisoft.progress import Progress, silent
from surgisoft.scene.folder import Scene, open_scene
from surgisoft.tasks.base import Episodes, Task
from surgisoft.tasks.episodes.log import EpisodeLog
from surgisoft.tasks.laser_dose import weak_laser
from surgisoft.tasks.path_following import beyond_reach
from surgisoft.tasks.registry import (
    config_of,
    make_task,
    read_config,
    spec_of,
    task_names,
    with_fields,
)
from surgisoft.tasks.world.reach import beam_beyond_limits

if TYPE_CHECKING:
    from surgisoft.agents.on_rig import RigConfig


NOT_COMPARED = {"scene", "arm", "weights"}
"""Parts of the names of a configuration's fields that a warning leaves out: folders of the run
itself, whose content is compared, and weights of the reward, on which no measure depends."""
MOST_FIELDS = 4
"""Most fields that a warning lists."""
LONGEST_VALUE = 40
"""Longest text of a list that a warning shows (characters)."""


def task_config(
    task: str,
    config: Any = None,
    arm: str | Path | None = None,
    scene: str | Path | None = None,
) -> Any:
    """The configuration of a task with another arm or scene where one is given.

    config: the task's configuration, a TOML file with fields of it, or None for the default.
    """
    if config is None:
        config = config_of(task)
    elif isinstance(config, str | Path):
        config = read_config(task, Path(config))
    given = {"arm": arm, "scene": scene}
    return with_fields(config, **{name: str(v) for name, v in given.items() if v is not None})


class Rules(Protocol):
    """Rules that an experiment lays over a task: its phases, interlock and limits."""

    @property
    def name(self) -> str:
        """Name of the experiment."""
        ...

    @property
    def task(self) -> str:
        """Name of the task that the rules are for."""
        ...

    @property
    def config(self) -> Any:
        """Configuration of the task, with the scene of the experiment."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the experiment's episodes."""
        ...

    @property
    def without(self) -> Collection[str]:
        """Measures of single steps whose means mean nothing."""
        ...

    @property
    def left_out(self) -> Sequence[str]:
        """What the experiment varies and an evaluation does not, one line each."""
        ...

    def over(self, task: Task) -> Task:
        """The task, in simulation or on rigs, under the rules."""
        ...

    def policy(self, name: str, task: Task) -> Policy:
        """A policy by name, for a task that `over` gave: it acts where the rules let it."""
        ...


@dataclass(frozen=True)
class EvaluationRequest:
    """Which policies to evaluate, on what."""

    policies: Sequence[str]
    """`scripted`, `random`, or folders of training runs."""
    task: str | None = None
    """Name of the task; None: that of the rules, else of the first run."""
    episodes: int = 20
    """Episodes of each policy."""
    seed: int | None = None
    """Seed of the episodes, equal for each policy; None: that of the rules, else 0."""
    rig: RigConfig | None = None
    """The arms are on these rigs; None: in simulation."""
    exact_checks: bool = True
    """Whether FCL checks contact, clearance and beam, where there is a scene."""
    arm: str | Path | None = None
    """Arm model of all arms; None: the configuration's."""
    scene: str | Path | None = None
    """Scene; None: the configuration's."""
    config: Any = None
    """Configuration of the task, or a TOML file with fields of it; None: that of the rules, else
    of the first run."""
    rules: Rules | None = None
    """Rules of an experiment that are laid over the task, which they name, with its configuration
    and the seed of the episodes; None: the task alone."""
    log: Collection[str] = ()
    """Policies whose first episode is logged."""

    @property
    def place(self) -> str:
        """Plant of the episodes: `simulation` or `rig`."""
        return "simulation" if self.rig is None else "rig"

    def under_rules(self) -> EvaluationRequest:
        """The request with task, configuration and seed of its rules, where it has rules.

        Raises InputError where the rules are those of another task, and for a configuration beside
        them.
        """
        if self.rules is None:
            return replace(self, seed=self.seed or 0)
        if self.config is not None:
            raise InputError("--config and --rules both set the task's fields; give one of the two")
        if self.task not in (None, self.rules.task):
            raise InputError(
                f"--rules {self.rules.name}: is an experiment of {self.rules.task}, not of "
                f"{self.task}"
            )
        seed = self.rules.seed if self.seed is None else self.seed
        return replace(self, task=self.rules.task, config=self.rules.config, seed=seed)

    def resolved(self, on_warning: Callable[[str], None]) -> tuple[Task, Any]:
        """The task and its configuration; a training run determines both."""
        if not self.policies:
            raise InputError("no policy is given; expected scripted, random or a run's folder")
        for name in self.policies:
            check_policy(name)
        runs = [RunFolder(name) for name in self.policies if name not in POLICIES]
        if self.task is None and not runs:
            raise InputError(f"--task is missing; expected one of {', '.join(task_names())}")
        task = self.task or runs[0].config["task"]
        brought = [run for run in runs if run.config["task"] == task]
        config = self.config
        if config is None and brought:
            config = brought[0].plan().task_config
            self._warn_of_fields(brought, on_warning)
        config = task_config(task, config, self.arm, self.scene)
        made = make_task(task, config)
        for run in runs:
            if run not in brought:
                check_fits(run, made)
                on_warning(f"{run.path} was trained on {run.config['task']}, not on {task}")
        self._warn_of_scenes(brought, config, on_warning)
        return made, config

    def _warn_of_scenes(
        self, runs: list[RunFolder], config: Any, on_warning: Callable[[str], None]
    ) -> None:
        """Warn of runs that were trained in another scene than that of a configuration."""
        place = getattr(config, "scene", None)
        trained = [run for run in runs if run.config["scene"]]
        given = self.scene is not None or self.config is not None
        if place is None or not (trained if given else trained[1:]):
            return
        name = Path(place).name if given else f"{_scene_of(trained[0])} of {trained[0].path}"
        here = open_scene(place)
        for run in trained:
            if line := trained_elsewhere(run, here, name):
                on_warning(line)

    def _warn_of_fields(self, runs: list[RunFolder], on_warning: Callable[[str], None]) -> None:
        """Warn of runs whose arm models, or fields of the configuration, are not those of the first
        run, in whose world all act."""
        first = runs[0]
        here = _leaves(to_table(first.plan().task_config))
        for run in runs[1:]:
            there = _leaves(to_table(run.plan().task_config))
            differ = [
                f"{name} = {_shown(there.get(name))} in place of {_shown(here.get(name))}"
                for name in {**here, **there}
                if here.get(name) != there.get(name) and not NOT_COMPARED & {*name.split(".")}
            ]
            if self.arm is None and self.scene is None:
                differ += [
                    f"another model of the arm '{name}'"
                    for name in run.config["arms"]
                    if run.arm_parts(name) != first.arm_parts(name)
                ]
            if differ:
                more = f" and {len(differ) - MOST_FIELDS} more" if len(differ) > MOST_FIELDS else ""
                on_warning(
                    f"{run.path} was trained with {', '.join(differ[:MOST_FIELDS])}{more}; it is "
                    f"evaluated in the configuration of {first.path}: evaluate it alone for its own"
                )


def trained_elsewhere(run: RunFolder, scene: Scene, name: str) -> str:
    """One line where a run was trained in another scene than this one, else an empty text.

    Bodies, lesion, mounts and tools are compared. name: what the line calls the scene.
    """
    if not run.config["scene"] or _geometry(open_scene(run.path / "scene")) == _geometry(scene):
        return ""
    return (
        f"{run.path} was trained in another scene ({_scene_of(run)}) than {name}; its result here "
        "says nothing about the scene: train there"
    )


def _scene_of(run: RunFolder) -> str:
    """Name of the scene that a run was trained in."""
    return Path(run.config["scene"]["from"]).name


def _leaves(table: Any, above: str = "") -> dict[str, Any]:
    """The values of a nested table by their dotted names."""
    if not isinstance(table, dict):
        return {above: table}
    parts = [_leaves(part, f"{above}.{name}".lstrip(".")) for name, part in table.items()]
    return {name: value for part in parts for name, value in part.items()}


def _shown(value: Any) -> str:
    """A value of a configuration in words; a long list by its length."""
    text = str(value)
    return (
        text
        if len(text) <= LONGEST_VALUE or not isinstance(value, list)
        else (f"a list of {len(value)}")
    )


def _geometry(scene: Scene) -> str:
    """Digest of a scene's bodies, lesion, mounts and tools, whatever its names and arm models."""
    mounts = tuple(replace(mount, arm="default", name="") for mount in scene.spec.mounts)
    plain = replace(scene.spec, name="", note="", contours=(), mounts=mounts)
    return replace(scene, spec=plain).content_hash


@dataclass(frozen=True, eq=False)
class Evaluations:
    """How well several policies do one task, on the same episodes."""

    request: EvaluationRequest
    """What was asked for, with the seed that the episodes have."""
    task: str
    """Name of the task."""
    task_config: dict
    """Its configuration as a table."""
    dt_s: float
    """Time of a step, s."""
    results: tuple[Evaluation, ...]
    """One for each policy, in order."""
    logs: dict[str, EpisodeLog]
    """The first episode of each policy that was to be logged."""
    measured_arms: tuple[str, ...] = ()
    """Arms on a real bench: their errors are those of the measured key points, camera noise
    included."""
    success_rule: str = ""
    """What an episode needs to be a success, in words; empty for a task without success."""
    interrupted: bool = False
    """Whether Ctrl-C ended the evaluation: results are those of the episodes finished before."""

    @property
    def interruption(self) -> str:
        """How many episodes of each policy an interrupted evaluation has, in words; else empty."""
        if not self.interrupted:
            return ""
        done = {result.policy: result.episodes for result in self.results}
        words = short_names(self.request.policies)
        parts = [f"{word} {done.get(name, 0):,}" for name, word in words.items()]
        of = counted(self.request.episodes, "episode")
        return f"interrupted; finished of {of} each: {', '.join(parts)}"

    def to_json(self) -> dict:
        """Plain values, as `evaluate --json` writes them."""
        asked = self.request
        values = {
            "task": self.task,
            "task_config": self.task_config,
            "on": asked.place,
            "rig": asked.rig and to_table(asked.rig),
            "measured_arms": list(self.measured_arms),
            "success_rule": self.success_rule or None,
            "seed": asked.seed,
            "episodes": asked.episodes,
            "interrupted": self.interrupted,
            "dt_s": self.dt_s,
            "confidence": CONFIDENCE,
            "policies": {
                name: result.to_json()
                for name, result in zip(asked.policies, self.results, strict=not self.interrupted)
            },
            "differences": {
                result.policy: {
                    name: json_safe(asdict(value))
                    for name, value in differences(self.results[0], result).items()
                }
                for result in self.results[1:]
            },
        }
        return with_former_keys(values, {"drivers": "policies"})


def evaluate(
    policies: str | Path | Sequence[str | Path],
    task: str | None = None,
    *,
    progress: Progress = silent,
    on_warning: Callable[[str], None] = warnings.warn,
    **fields: Any,
) -> Evaluations:
    """Evaluate policies on the same episodes of a task, with 95 % intervals.

    Returns, for each policy, the mean of every measure (mm, s, or a share 0..1, as its name states)
    with its interval: Wilson's (1927) for rates, Student's (1908) over episodes for others. Raises
    InputError for an unknown task, and for a run that was trained on other observations.

    policies: `scripted` (inverse kinematics with privileged information), `random`, or folders of
    training runs. A run brings its task and the task's configuration.
    fields: other fields of `EvaluationRequest`, such as `episodes=100` or `rig=RigConfig(seed=3)`;
    `rules=ExperimentRules.of("liver")` (`surgisoft.experiments.session`) evaluates under the rules
    of an experiment.
    progress: called with (episodes done, episodes to do, policy). Ctrl-C raises `Interrupted`
    (`surgisoft.errors`) with the policies and batches of episodes that are finished (on a real
    bench, which is vented first, a batch is one episode), or KeyboardInterrupt where none is.
    """
    given = [policies] if isinstance(policies, str | Path) else policies
    if not isinstance(given, Iterable):
        raise wrong_type("policies", given, "the name of a policy, or several names")
    names, repeated = without_repeats([str(name) for name in given])
    for name in dict.fromkeys(repeated):
        on_warning(f"policy {name} is given more than once; it is evaluated once")
    request = EvaluationRequest(tuple(names), task, **fields).under_rules()
    for line in () if request.rules is None else request.rules.left_out:
        on_warning(line)
    plain, config = request.resolved(on_warning)
    _warn_of_reach(plain, on_warning)
    if beyond := beam_beyond_limits_of(config):
        on_warning(beyond)
    if request.rules is None and (weak := weak_laser(plain)):
        on_warning(weak)
    place = plain
    if request.rig is not None:
        from surgisoft.agents.on_rig import on_rig

        place = on_rig(plain, request.rig, on_warning=on_warning)
    if request.rules is not None:
        plain, place = request.rules.over(plain), request.rules.over(place)
    return _evaluated(request, plain, place, config, progress)


def beam_beyond_limits_of(config: Any) -> str:
    """See `beam_beyond_limits`, of the scene of a task's configuration; empty without a scene, and
    where the arms are not those of its mounts."""
    place = getattr(config, "scene", None)
    if place is None or getattr(config, "arm", None) is not None:
        return ""
    return beam_beyond_limits(open_scene(place))


def _warn_of_reach(task: Task, on_warning: Callable[[str], None]) -> None:
    """Warn of a path that leaves the arm's reach, as far as a search shows."""
    if beyond := beyond_reach(task):
        on_warning(
            f"{beyond}: a search of the arm's steady states found none that comes nearer; make the "
            "path smaller (size_mm) or move its centre (docs/evaluate.md)"
        )


def _warm_up(task: Task, policy: Policy) -> None:
    """Let a policy act once in simulation.

    The first action takes seconds where code is compiled or read from the disk, for which no real
    bench should wait under pressure.
    """
    with torch.inference_mode():
        runner = Episodes(task)
        state = runner.seeded(0, 1)
        runner.step(state, policy.act(task, state, runner.observe(state)))


def _evaluated(
    request: EvaluationRequest, plain: Task, place: Task, config: Any, progress: Progress
) -> Evaluations:
    """Roll out every policy of a request on a task that is placed in simulation or on rigs."""
    measured: tuple[str, ...] = ()
    benches: AbstractContextManager[object] = nullcontext()
    if request.rig is not None:
        from surgisoft.agents.on_rig import at_benches, real_benches

        measured, benches = tuple(real_benches(place)), at_benches(place)
    seed = request.seed or 0
    logs = {
        name: EpisodeRecorders(place, name, seed, request.place, only=0) for name in request.log
    }
    without = () if request.rules is None else request.rules.without
    results: list[Evaluation] = []
    checks: list[ExactChecks | None] = []
    interrupted = False
    try:
        with benches:
            opening = open_policy if request.rules is None else request.rules.policy
            opened = {name: opening(name, place) for name in request.policies}
            if measured:
                for policy in opened.values():
                    _warm_up(plain, policy)
            for number, (name, policy) in enumerate(opened.items()):

                def tell(
                    done: float, total: float, note: str = "", first: int = number, name: str = name
                ) -> None:
                    progress(first * total + done, len(opened) * total, name)

                checks.append(exact_checks_of(place, request.exact_checks))
                rolled = rollout(
                    place,
                    policy,
                    request.episodes,
                    seed,
                    batch=1 if measured else BATCH,
                    progress=tell,
                    watch=watched_by(checks[-1], logs.get(name)),
                )
                results.append(summarised(place, name, rolled, checks[-1], without))
    except Interrupted as ended:  # here, and not above, because benches are vented by now
        interrupted, name = True, request.policies[len(results)]
        results.append(summarised(place, name, ended.result, checks[-1], without))
    except KeyboardInterrupt:
        if not results:
            raise
        interrupted = True
    done = {result.policy for result in results}
    found = Evaluations(
        request,
        plain.name,
        to_table(config),
        plain.world.config.dt_s,
        tuple(results),
        {name: each.log(0) for name, each in logs.items() if name in done},
        measured,
        rule(config) if (rule := spec_of(plain.name).success_rule) else "",
        interrupted,
    )
    if interrupted:
        raise Interrupted(found)
    return found
