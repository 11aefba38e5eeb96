"""Training of one policy for each agent: the loop, its state, its checkpoints and its log.

The state (world, networks, optimisers, random numbers) is saved and loaded whole, so that a run
that was interrupted continues as if it had not been. See `ppo` for the algorithm.
"""

from __future__ import annotations

import functools
import json
import math
import shutil
import signal
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from torch import Tensor

from surgisoft.agents.actor import ScaledActor
from surgisoft.agents.compiled_update import compile_arms
from surgisoft.agents.distributed import Processes
from surgisoft.agents.graphed_rollout import rollouts
from surgisoft.agents.learned import ActorPolicy, agent_sizes, check_weights
from surgisoft.agents.loggers import TENSORBOARD, open_writer
from surgisoft.agents.policy_network import acting
from surgisoft.agents.ppo import RolloutMeans, make_ppo, set_noise, update
from surgisoft.agents.presets import Plan
from surgisoft.agents.run_folder import BEST, LAST, RunFolder, create_run, damaged
from surgisoft.agents.selection import evaluate_checkpoint, is_better
from surgisoft.agents.vec_env import JointEnv
from surgisoft.errors import AssumptionWarning, InputError, counted
from surgisoft.files import write_atomically
from surgisoft.tasks.base import Task
from surgisoft.tasks.episodes.file import save_episode
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.world.pytree import tree_map

_FAR = 1 << 20
"""Distance between the numbers of the first episodes of two processes."""


@dataclass
class Clock:
    """Time that training took so far, resumptions included."""

    wall_s: float = 0.0
    """Wall time, s."""
    cpu_s: float = 0.0
    """Time of all threads of this process on a processor, s."""
    _last: tuple[float, float] = field(
        default_factory=lambda: (time.monotonic(), time.process_time())
    )

    def tick(self) -> None:
        """Count the time since the last tick."""
        now = (time.monotonic(), time.process_time())
        self.wall_s += now[0] - self._last[0]
        self.cpu_s += now[1] - self._last[1]
        self._last = now


FEW_EPISODES = 64
"""Up to so many episodes are evaluated on the CPU: a step of 64 takes a core as long as the graphs
of a GPU take for any number, which have to be recorded first (docs/results/speed.md)."""


@dataclass(frozen=True, eq=False)
class Iteration:
    """Results of one iteration: a rollout and an update of every agent."""

    gathered: RolloutMeans
    """Rewards and measures of the rollout."""
    losses: dict[str, float]
    """agent/loss -> value of the update."""
    learning_rate: float
    """Of the first agent's optimiser."""
    noise: float
    """Mean standard deviation of the first agent's actions, in outputs."""


class Training:
    """The agents of a task while they learn; `state` and `load_state` save and restore all of it.

    `iteration` counts rollouts with their updates, `share` 0..1 is how much of the plan is done,
    `best` the evaluation of the best policies so far.
    """

    def __init__(self, plan: Plan, task: Task, processes: Processes):
        self.plan, self.task, self.processes = plan, task, processes
        preset, rank = plan.preset, processes.rank
        torch.manual_seed(plan.seed)
        given = (plan.seed, preset.action_kPa, rank * _FAR, preset.privileged)
        self.env = JointEnv(task, preset.envs, *given)
        self.agents = make_ppo(self.env, preset, processes)
        if preset.compile and task.world.device.type == "cuda":
            compile_arms(task.world, preset.envs)
        if processes.count > 1:
            torch.manual_seed(plan.seed + rank * _FAR)
            for ppo in self.agents.values():
                ppo.broadcast_parameters()
        self._rolled_out = rollouts(self.env, self.agents, preset.rollout)
        self.seen = self.env.get_observations()
        self.iteration, self.clock = 0, Clock()
        self.best: dict[str, float] | None = None
        self.share = 0.0

    @functools.cached_property
    def evaluation_task(self) -> Task:
        """The task in which policies are evaluated: on a CPU where that is faster."""
        few = self.plan.preset.evaluation_episodes <= FEW_EPISODES
        if self.task.world.device.type == "cpu" or not few:
            return self.task
        return make_task(self.plan.task, self.plan.task_config)

    @property
    def steps(self) -> int:
        """Steps so far, over the episodes of all processes."""
        preset = self.plan.preset
        return self.iteration * preset.envs * preset.rollout * self.processes.count

    def _shared(self) -> float:
        """Share of the training that is done; all processes call this together."""
        seconds = 0.0
        if self.plan.minutes is not None:
            seconds = self.processes.of_leader(self.clock.wall_s)
        return self.plan.share(self.steps, seconds)

    def iterate(self) -> Iteration:
        """One rollout, and one update of every agent."""
        preset = self.plan.preset
        for ppo in self.agents.values():
            set_noise(ppo, preset, self.share)
        self.seen, gathered = self._rolled_out(self.seen)
        self._check_terms(gathered)
        losses: dict[str, float] = {}
        for agent, ppo in self.agents.items():
            try:
                found = update(ppo)
            except RuntimeError as error:  # of a draw from a distribution that is NaN
                if _finite(ppo):
                    raise
                raise self._diverged(agent) from error
            losses |= {f"{agent}/{name}": value for name, value in found.items()}
        bad = [agent for agent, ppo in self.agents.items() if not _finite(ppo)]
        if self.processes.any(bool(bad)):
            raise self._diverged(", ".join(bad or self.agents))
        self.iteration += 1
        self.clock.tick()
        self.share = self._shared()
        first = next(iter(self.agents.values()))
        noise = first.get_policy().distribution.log_std_param.detach().exp().mean().item()
        return Iteration(gathered, losses, first.learning_rate, noise)

    def _check_terms(self, gathered: RolloutMeans) -> None:
        """Raise InputError where a reward term is not finite: what is learned of it is nothing."""
        bad = [name for name, value in gathered.terms.items() if not math.isfinite(value)]
        if self.processes.any(bool(bad)):
            named = [f"'{term}' of '{agent}'" for agent, _, term in (n.partition("/") for n in bad)]
            preset = self.plan.preset
            steps = (self.iteration + 1) * preset.envs * preset.rollout * self.processes.count
            which = f"reward term {', '.join(named)}" if named else "a reward term"
            raise InputError(
                f"{which} is NaN or infinite within the first {steps:,} steps; correct the rewards "
                f"of the task '{self.plan.task}'"
            )

    def _diverged(self, agents: str) -> InputError:
        """The error where weights are not finite: nothing is learned any more.

        Observations of the last rollout that are NaN are its cause, else the size of the steps.
        """
        preset = self.plan.preset
        steps = (self.iteration + 1) * preset.envs * preset.rollout * self.processes.count
        for agent, ppo in self.agents.items():
            seen = ppo.storage.observations[agent].isnan().any(-1)
            if bad := int(seen.sum()):
                return InputError(
                    f"the training diverged within the first {steps:,} steps: the observation of "
                    f"'{agent}' is NaN in {bad:,} of the last {seen.numel():,}; correct observe of "
                    f"the task '{self.plan.task}'"
                )
        return InputError(
            f"the training diverged: after {steps:,} steps the weights of {agents} are NaN or "
            f"infinite; train again with a smaller ppo.learning_rate (now {preset.learning_rate:g})"
            " or smaller weights of the rewards"
        )

    def policies(self) -> dict[str, dict[str, Tensor]]:
        """agent -> weights of its actor, copied."""
        return {
            agent: _copied(ppo.save()["actor_state_dict"]) for agent, ppo in self.agents.items()
        }

    def state(self) -> dict[str, Any] | None:
        """All that resuming needs, as plain tensors and numbers; None but in the leading process.

        Worlds and random numbers are those of every process, in the order of their ranks.
        """
        parts: list[Tensor] = []

        def kept(value: Tensor) -> Tensor:
            parts.append(value.detach().cpu().clone())
            return value

        tree_map(kept, self.env.state)
        device, random = self.task.world.device, {"cpu": torch.get_rng_state()}
        if device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(device)
        local = {"world": parts, "random": random}
        everyone = self.processes.gather(local)
        if everyone is None:
            return None
        agents = {
            agent: {**ppo.save(), "learning_rate": ppo.learning_rate}
            for agent, ppo in self.agents.items()
        }
        return {
            "iteration": self.iteration,
            "wall_s": self.clock.wall_s,
            "cpu_s": self.clock.cpu_s,
            "best": self.best,
            "agents": agents,
            "processes": everyone,
        }

    def load_state(self, saved: dict[str, Any]) -> None:
        """Restore a saved state, in as many processes as it was saved by."""
        count, device = len(saved["processes"]), self.task.world.device
        if count != self.processes.count:
            raise InputError(
                f"the run was trained by {count} processes, now there are {self.processes.count}; "
                f"resume it with torchrun --nproc-per-node {count}"
            )
        for agent, ppo in self.agents.items():
            content = dict(saved["agents"][agent])
            rate = content.pop("learning_rate")
            ppo.load(content, None, strict=True)
            ppo.learning_rate = float(rate)
        local = saved["processes"][self.processes.rank]
        parts = list(local["world"])

        def restored(present: Tensor) -> Tensor:
            part = parts.pop(0)
            if part.shape != present.shape or part.dtype != present.dtype:
                raise ValueError(
                    f"a part of the world has shape {list(part.shape)} and type {part.dtype}, "
                    f"expected {list(present.shape)} and {present.dtype}"
                )
            return part.to(device).clone()

        with torch.inference_mode():
            self.env.state = tree_map(restored, self.env.state)
        if parts:
            raise ValueError(f"{len(parts)} parts of the world too many")
        self.seen = self.env.get_observations()
        torch.set_rng_state(local["random"]["cpu"].cpu())
        if device.type == "cuda":
            torch.cuda.set_rng_state(local["random"]["cuda"].cpu(), device)
        self.iteration, self.best = int(saved["iteration"]), _evaluation(saved["best"])
        self.clock = Clock(float(saved["wall_s"]), float(saved["cpu_s"]))
        self.share = self._shared()


def _finite(ppo: PPO) -> bool:
    """Whether all weights of an agent's actor and critic are finite."""
    networks = (ppo.get_policy(), ppo.critic)
    found = [each.detach().isfinite().all() for net in networks for each in net.parameters()]
    return bool(torch.stack(found).all())


def _evaluation(saved: Any) -> dict[str, float] | None:
    """The evaluation in a checkpoint; numbers by name, or None."""
    return None if saved is None else {str(name): float(saved[name]) for name in saved}


def _copied(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu().clone() for name, value in weights.items()}


REPLAYS = "replays"
"""Folder of a run that holds the first episode of each evaluation, for `surgisoft replay`."""
CHECKPOINT_S = 30.0
"""Longest time between two checkpoints, s; what comes after the last is computed again."""


@dataclass(frozen=True)
class TrainingProgress:
    """How far a training run is, reported after each iteration."""

    share: float
    """Share 0..1 of the training that is done."""
    steps: int
    """Steps so far, over all episodes and processes."""
    steps_per_s: float
    """Steps per second of the last iteration."""
    reward: float
    """Mean reward of a step, over all agents."""
    evaluation: dict[str, float] | None
    """Result of the last evaluation."""


@dataclass(frozen=True)
class Result:
    """State of a run when training returned."""

    done: bool
    """Whether the plan is done; else the run was interrupted and can be resumed."""
    steps: int
    """Steps over all episodes and processes."""
    wall_s: float
    """Wall time, s."""
    cpu_s: float
    """Time on a processor of the leading process, s."""
    best: dict[str, float] | None
    """Evaluation of the best checkpoint."""
    updates: int = 1
    """Updates of this call: 0 where the plan was done before."""


def train_new(
    folder: Path,
    plan: Plan,
    processes: Processes,
    device: torch.device,
    report: Callable[[TrainingProgress], None] = lambda progress: None,
    logger: str = TENSORBOARD,
) -> Result:
    """Train a new run; its folder is complete before training begins.

    Where training raises before there is a checkpoint, nothing was learned, and no folder is left.
    """
    task = make_task(plan.task, plan.task_config, device)
    if processes.leads:
        create_run(folder, plan, task, agent_sizes(task), processes.count)
    processes.wait()
    # Everything is read back from the folder, so that resuming finds the same.
    run = RunFolder(folder)
    try:
        return _continue(run, processes, device, report, logger)
    except (Exception, SystemExit):  # also those of code of the user's
        if processes.leads and not any(run.checkpoint(each).is_file() for each in (LAST, BEST)):
            with suppress(OSError):
                shutil.rmtree(folder)
        raise


def resume(
    folder: Path,
    processes: Processes,
    device: torch.device,
    report: Callable[[TrainingProgress], None] = lambda progress: None,
    logger: str = TENSORBOARD,
    steps: int | None = None,
) -> Result:
    """Continue a run from its last checkpoint.

    A run that ended before its first checkpoint begins again, with a warning. Raises InputError
    where a checkpoint was lost, and leaves the run as it is.

    steps: all steps of the run from now on, see `RunFolder.longer_plan`; None: those of its plan.
    """
    run = RunFolder(folder)
    if not run.checkpoint(LAST).is_file():
        _check_begun(run)
        if processes.leads:
            warnings.warn(
                f"{run.path}: there is no checkpoint yet; the training begins again at its start",
                AssumptionWarning,
                stacklevel=2,
            )
    return _continue(run, processes, device, report, logger, steps)


def _check_begun(run: RunFolder) -> None:
    """Raise InputError where a run without its last checkpoint has records that come after one.

    The first checkpoint is written after the record of the first evaluation, or of the first
    iteration that ends more than `CHECKPOINT_S` after the start. Twice that time allows for what
    comes before the first iteration.
    """
    rows = [row for row, _ in _records(run.path / METRICS)]
    for row in rows[:-1]:
        seconds = row.get("wall_s")
        late = isinstance(seconds, int | float) and seconds > 2.0 * CHECKPOINT_S
        if late or any(name.startswith("evaluation/") for name in row):
            raise InputError(
                f"{run.checkpoint(LAST)}: there is no such checkpoint, but {METRICS} has "
                f"{counted(rows[-1]['iteration'], 'iteration')}; put the file back, or train "
                "again in a new folder"
            )


def reopened(
    folder: Path, processes: Processes, device: torch.device, steps: int | None = None
) -> Training:
    """The training of a run at its last checkpoint, ready to go on; new where it has none.

    steps: as for `resume`.
    """
    run = RunFolder(folder)
    longer = None if steps is None else run.longer_plan(steps)
    saved = run.load(LAST) if run.checkpoint(LAST).is_file() else None
    plan = longer or run.plan()
    if saved is not None:
        with damaged(run.checkpoint(LAST)):
            _check_saved(run, saved, plan)
    training = Training(plan, run.task(device), processes)
    if saved is not None:
        with damaged(run.checkpoint(LAST)):
            training.load_state(saved)
    return training


def _check_saved(run: RunFolder, saved: dict[str, Any], plan: Plan) -> None:
    """Raise unless a checkpoint has the sizes of its run, before memory is taken for them."""
    for agent, size in run.agents.items():
        weights = saved["agents"][agent]["actor_state_dict"]
        sizes = size["observation"], size["chambers"]
        check_weights(run.checkpoint(LAST), agent, weights, *sizes, plan.preset)
    for local in saved["processes"]:
        if len(local["world"][0]) != plan.preset.envs:
            raise ValueError(
                f"{len(local['world'][0])} episodes, expected {plan.preset.envs} by config.json"
            )


def _continue(run, processes, device, report, logger: str, steps: int | None = None) -> Result:
    training = reopened(run.path, processes, device, steps)
    processes.wait()  # until each of them has read the plan
    if steps is not None and processes.leads:
        run.set_steps(steps)
    plan, first = training.plan, training.iteration
    ahead = training.share < 1.0
    log = _Log(run, training.iteration, logger) if processes.leads and ahead else None
    written, found = time.monotonic(), training.best
    stopped = reached = False
    with _asked_to_stop() as asked, closing(log) if log else nullcontext():
        while training.share < 1.0 and not (stopped or reached):
            before = training.clock.wall_s
            turn = training.iterate()
            ends = training.share >= 1.0
            row = {}
            if ends or training.iteration % plan.preset.evaluate_every == 0:
                found = row = _evaluated(run, training)
                reached = processes.any(_good_enough(plan, found))
            stopped = processes.any(asked.is_set())
            late = processes.any(time.monotonic() - written > CHECKPOINT_S)
            if log:
                seconds = training.clock.wall_s - before
                log.add(training, turn, row, seconds)
                report(_progress(training, turn, found, seconds))
            if ends or stopped or reached or late or row:
                _save_last(run, training)
                written = time.monotonic()
    clock = training.clock
    done = reached or training.share >= 1.0
    updates = training.iteration - first
    return Result(done, training.steps, clock.wall_s, clock.cpu_s, training.best, updates)


def _evaluated(run: RunFolder, training: Training) -> dict[str, float]:
    """Evaluate the present policies, and save them if no earlier ones were better.

    Only the leading process does; the others wait for it at the next exchange.
    """
    if not training.processes.leads:
        return {"error_mm": math.nan}
    preset, task = training.plan.preset, training.evaluation_task
    actors = {
        agent: ScaledActor(
            acting(ppo.get_policy()),
            preset.action_kPa,
            task.world.arms[agent].pneumatics.step_kPa,
        )
        .eval()
        .to(task.world.device)
        for agent, ppo in training.agents.items()
    }
    found, log = evaluate_checkpoint(task, ActorPolicy(actors), preset.evaluation_episodes)
    (run.path / REPLAYS).mkdir(exist_ok=True)
    save_episode(log, run.path / REPLAYS / f"{training.steps:012d}.npz")
    if is_better(found, training.best):
        training.best = found
        run.save(
            BEST,
            {
                "iteration": training.iteration,
                "evaluation": found,
                "agents": training.policies(),
            },
        )
    training.clock.tick()
    return found


def _good_enough(plan: Plan, found: dict[str, float]) -> bool:
    if plan.target_error is None:
        return False
    good = found.get("error_mm", math.inf) <= plan.target_error
    return good and found.get("success", 1.0) >= 1.0


def _save_last(run: RunFolder, training: Training) -> None:
    state = training.state()
    if state is not None:
        run.save(LAST, state)


def _progress(training: Training, turn: Iteration, found, seconds: float) -> TrainingProgress:
    preset, rewards = training.plan.preset, turn.gathered.rewards
    steps = preset.envs * preset.rollout * training.processes.count
    reward = sum(rewards.values()) / len(rewards)
    return TrainingProgress(training.share, training.steps, steps / seconds, reward, found)


METRICS = "metrics.jsonl"
"""File of a run's folder with one line for each iteration."""


def _records(file: Path) -> list[tuple[dict[str, Any], str]]:
    """Whole lines of a run's metrics, as tables and as they are; what else is there is left out."""
    found = []
    for line in file.read_text(errors="replace").splitlines() if file.is_file() else ():
        with suppress(ValueError, RecursionError):
            row = json.loads(line)
            if isinstance(row, dict) and type(row.get("iteration")) is int:
                found.append((row, line + "\n"))
    return found


class _Log:
    """`metrics.jsonl`, one line for each iteration, and the curves of a logger."""

    def __init__(self, run: RunFolder, iteration: int, logger: str):
        """Lines after `iteration` are dropped: those iterations are computed again."""
        self._board = open_writer(logger, run.path, run.plan(), iteration + 1)
        file = run.path / METRICS
        kept = [line for row, line in _records(file) if row["iteration"] <= iteration]
        write_atomically(file, "".join(kept), noted=False)
        self._file = file.open("a")

    def add(self, training: Training, turn: Iteration, found: dict, seconds: float) -> None:
        """Write one iteration, and the evaluation after it."""
        got = turn.gathered
        values = {
            **{f"reward/{name}": value for name, value in got.rewards.items()},
            **{f"term/{name}": value for name, value in got.terms.items()},
            **{f"measure/{name}": value for name, value in got.measures.items()},
            **{f"loss/{name}": value for name, value in turn.losses.items()},
            **{f"evaluation/{name}": value for name, value in found.items()},
            "learning_rate": turn.learning_rate,
            "noise": turn.noise,
        }
        row = {
            "iteration": training.iteration,
            "steps": training.steps,
            "wall_s": round(training.clock.wall_s, 3),
            "cpu_s": round(training.clock.cpu_s, 3),
            "turn_s": round(seconds, 3),
            **{name: value for name, value in values.items() if math.isfinite(value)},
        }
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()
        for name, value in values.items():
            self._board.add_scalar(name, value, training.iteration)

    def close(self) -> None:
        """Write what is left."""
        self._file.close()
        self._board.close()


@contextmanager
def _asked_to_stop():
    """A flag that Ctrl-C or SIGTERM sets; a second one interrupts at once."""
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def ask(number, frame):
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
