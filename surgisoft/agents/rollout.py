"""Rollouts: whole episodes of a policy, in batches, with the task's measures and logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from surgisoft.agents.policies import Policy
from surgisoft.errors import InputError, Interrupted
from surgisoft.progress import Progress, silent
from surgisoft.tasks.arguments import actions_of
from surgisoft.tasks.base import Episodes, Outcome, Task, TaskState
from surgisoft.tasks.episodes.log import EpisodeLog, EpisodeRecorder
from surgisoft.tasks.graphed import donated_episodes
from surgisoft.tasks.world.pytree import rows
from surgisoft.threads import rows_on_threads

BATCH = 256
"""Default number of episodes that run side by side."""


@dataclass(frozen=True, eq=False)
class Instant:
    """One instant of a batch of R episodes for `rollout(watch=...)`: the start, then every step."""

    episodes: Tensor
    """(R,) int64: number of each episode."""
    state: TaskState
    """The state reached. The next step overwrites its dose map, so copy what you store."""
    actions: dict[str, Tensor] | None
    """agent -> (R, m) kPa that led here; None at the start."""
    outcome: Outcome | None
    """Rewards and ends of the step; None at the start."""
    live: Tensor
    """(R,) bool: the episode was not over before this step; ignore the others."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """Results of N episodes, step by step."""

    task: str
    """Name of the task."""
    dt_s: float
    """Time of a step, s."""
    steps: Tensor
    """(N,) int64: number of steps until the end of each episode."""
    returns: dict[str, Tensor]
    """agent -> (N,): sum of its rewards."""
    terminated: Tensor
    """(N,) bool: ended before the time was out."""
    failed: Tensor
    """(N,) bool: an arm was no longer finite."""
    measures: dict[str, Tensor]
    """name -> (N, T), see `Task.measures`; nan where it does not apply and after the end."""

    @property
    def episodes(self) -> int:
        """Number N of episodes."""
        return len(self.steps)

    @property
    def time_s(self) -> Tensor:
        """(N,) s: duration of each episode."""
        return self.steps * self.dt_s

    def mean(self, name: str) -> Tensor:
        """(N,): mean of a measure over each episode; nan where it never applied."""
        return self.measures[name].nanmean(1)

    def rms(self, name: str) -> Tensor:
        """(N,): root mean square of a measure over each episode."""
        return self.measures[name].square().nanmean(1).sqrt()

    def quantile(self, name: str, share: float) -> Tensor:
        """(N,): quantile of the measure over each episode; share: 0..1."""
        return self.measures[name].nanquantile(share, 1)

    def largest(self, name: str) -> Tensor:
        """(N,): largest value of a measure in each episode."""
        return _extreme(self.measures[name], torch.amax, -torch.inf)

    def smallest(self, name: str) -> Tensor:
        """(N,): smallest value of a measure in each episode."""
        return _extreme(self.measures[name], torch.amin, torch.inf)

    def end(self, name: str) -> Tensor:
        """(N,) value of a measure at the last step of each episode."""
        last = (self.steps - 1).clamp(min=0)[:, None]
        return self.measures[name].gather(1, last)[:, 0]


def _extreme(values: Tensor, of: Callable, empty: float) -> Tensor:
    known = ~values.isnan()
    found = of(values.where(known, values.new_tensor(empty)), 1)
    return found.where(known.any(1), found.new_tensor(torch.nan))


def _report_from(progress: Progress, before: int, total: int, steps: int) -> None:
    progress(before + steps, total)


def rollout(
    task: Task,
    policy: Policy,
    episodes: int,
    seed: int,
    batch: int = BATCH,
    progress: Progress = silent,
    watch: Callable[[Instant], None] | None = None,
    first: int = 0,
) -> Rollout:
    """Roll out episodes `first` to `first + episodes - 1` of a seed with a policy.

    batch: how many run side by side, which changes no result. progress: called with the steps done
    and the most that may be to do. watch: called with every instant. Ctrl-C raises `Interrupted`
    with the episodes of the batches that were finished, or KeyboardInterrupt in the first one:
    episodes of an unfinished batch that have ended are those that end early.
    """
    if episodes < 1 or batch < 1:
        raise InputError(f"rollout: {episodes} episodes in batches of {batch}, expected 1 or more")
    parts: list[Rollout] = []
    total = task.steps * -(-episodes // batch)
    for number, done in enumerate(range(0, episodes, batch)):
        count, before = min(batch, episodes - done), number * task.steps
        try:
            part = _rolled_out(
                task,
                policy,
                seed,
                first + done,
                count,
                partial(_report_from, progress, before, total),
                watch,
            )
        except KeyboardInterrupt:
            if not parts:
                raise
            raise Interrupted(joined(parts)) from None
        parts.append(part)
    return joined(parts)


@rows_on_threads()
@torch.inference_mode()
def _rolled_out(
    task: Task,
    policy: Policy,
    seed: int,
    first: int,
    count: int,
    report: Callable[[int], None],
    watch: Callable[[Instant], None] | None,
) -> Rollout:
    """Episodes `first` to `first + count - 1` side by side. Finished ones leave the batch, except
    where a CUDA graph steps it."""
    runner, device = donated_episodes(task, count), task.world.device
    state = runner.seeded(seed, count, first)
    sizes = {agent: task.world.arms[agent].chambers for agent in task.agents}
    at = torch.arange(count, device=device)
    live = torch.ones(count, dtype=torch.bool, device=device)
    steps = torch.zeros(count, dtype=torch.int64, device=device)
    terminated, failed = torch.zeros_like(live), torch.zeros_like(live)
    returns = {agent: torch.zeros(count, device=device) for agent in task.agents}
    traces: list[Tensor] = []
    if watch:
        watch(Instant(first + at, state, None, None, live))
    for step in range(task.steps):
        shapes = {agent: (len(live), size) for agent, size in sizes.items()}
        given = policy.act(task, state, runner.observe(state))
        checked = actions_of(given, shapes, device)
        actions = {**given, **checked}  # it may also move arms that no agent drives
        state, outcome = runner.step(state, actions)
        if watch:
            watch(Instant(first + at, state, actions, outcome, live))
        if outcome.measures:
            values = torch.stack([value.float() for value in outcome.measures.values()])
            row = torch.full((len(values), count), torch.nan, device=device)
            traces.append(row.index_copy_(1, at, values.masked_fill_(~live, torch.nan)))
        for agent, value in outcome.rewards.items():
            returns[agent].index_add_(0, at, value.masked_fill(~live, 0.0))
        steps.index_add_(0, at, live.long())
        terminated[at] |= live & outcome.terminated
        failed[at] |= live & state.world.failed
        live = live & ~outcome.done
        report(step + 1)
        remaining = live.nonzero()[:, 0]
        if not len(remaining):
            break
        if isinstance(runner, Episodes) and 2 * len(remaining) <= len(live):
            state, at, live = rows(state, remaining), at[remaining], live[remaining]
    report(task.steps)
    whole = torch.stack(traces, 1).unbind(0) if traces else ()  # (T, N) of each measure
    names = outcome.measures
    measures = {n: _padded(one, task.steps) for n, one in zip(names, whole, strict=True)}
    dt_s = task.world.config.dt_s
    return Rollout(task.name, dt_s, steps, returns, terminated, failed, measures)


def _padded(values: Tensor, length: int) -> Tensor:
    """(T, N) to (N, length) with nan."""
    return torch.nn.functional.pad(values.T, (0, length - len(values)), value=torch.nan)


def joined(parts: list[Rollout]) -> Rollout:
    """All episodes of all parts, one after the other."""
    one = parts[0]
    if len(parts) == 1:
        return one

    def all_of(field: str) -> dict[str, Tensor]:
        return {
            name: torch.cat([getattr(part, field)[name] for part in parts])
            for name in getattr(one, field)
        }

    steps, terminated, failed = (
        torch.cat([getattr(part, field) for part in parts])
        for field in ("steps", "terminated", "failed")
    )
    return Rollout(
        one.task, one.dt_s, steps, all_of("returns"), terminated, failed, all_of("measures")
    )


class EpisodeRecorders:
    """Records episodes of a rollout as logs; given as `rollout(watch=...)`."""

    def __init__(
        self, task: Task, policy: str, seed: int, on: str = "simulation", only: int | None = None
    ):
        """policy, seed, on: what the logs state about their origin; only: one episode's number."""
        self.task, self.only = task, only
        self.policy, self.seed, self.on = policy, seed, on
        self._recorders: dict[int, EpisodeRecorder] = {}

    def __call__(self, now: Instant) -> None:
        """Record every live episode of an instant."""
        live = now.live if self.only is None else now.live & (now.episodes == self.only)
        for row in live.nonzero()[:, 0].tolist():
            number = int(now.episodes[row])
            if now.outcome is None or now.actions is None:
                self._recorders[number] = EpisodeRecorder(
                    self.task,
                    now.state,
                    row,
                    policy=self.policy,
                    seed=self.seed,
                    on=self.on,
                    episode=number,
                )
            else:
                self._recorders[number].step(now.state, now.outcome, now.actions, row)

    def log(self, episode: int) -> EpisodeLog:
        """The log of an episode, after the rollout."""
        return self._recorders[episode].log()
