"""Plays a block of episodes of one setting: a row of numbers and, for some, a log of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from torch import Tensor

from surgisoft.agents.evaluate import episode_table
from surgisoft.agents.referee import EpisodeReferee, Verdict
from surgisoft.agents.rollout import Instant, Rollout, rollout
from surgisoft.experiments.controllers import REASONS, Hands, PhasedAblation
from surgisoft.experiments.plan import Setting, build_task
from surgisoft.experiments.spec import Experiment
from surgisoft.files import json_safe
from surgisoft.tasks.episodes.log import EpisodeLog, EpisodeRecorder

DROPPED = ("phase", "reason", "reason_phase", "beam", "beam_unsafe", "safe")
"""Measures of single steps of which a mean says nothing."""

Row = dict[str, float | int | str | None]


@dataclass(frozen=True, eq=False)
class Block:
    """Episodes that were played at once."""

    rows: list[Row]
    """One for each, see `Results`."""
    logs: dict[int, EpisodeLog]
    """Episode's number -> log: number 0, and the worst of the block."""


@lru_cache(maxsize=1)
def opened(spec: Experiment, setting: Setting) -> tuple[PhasedAblation, Hands]:
    """A setting's task and who drives it; the last one is kept."""
    task = build_task(spec, setting)
    return task, Hands(spec, task, setting.case.policy)


def play_block(
    spec: Experiment,
    setting: Setting,
    first: int,
    count: int,
    progress: Callable[[int, int], None] | None = None,
) -> Block:
    """Play episodes `first` to `first + count - 1` of a setting."""
    task, hands = opened(spec, setting)
    judge, recorders = EpisodeReferee(task), _Recorders(task, spec, setting)

    def watch(now: Instant) -> None:
        judge(now)
        recorders(now)

    played = rollout(task, hands, count, spec.seed, count, progress, watch, first)
    rows = _rows(task, setting, first, played, judge.verdicts())
    worst = max(rows, key=badness)["episode"]
    kept = {0, worst} & {row["episode"] for row in rows}
    return Block(rows, {number: recorders.log(number) for number in sorted(kept)})


def badness(row: Row) -> tuple:
    """Sorts episodes from good to bad: success, share cut, error of the beam."""
    error = row.get("beam_error_mean_mm")
    return (1.0 - row["success"], 1.0 - row["completion"], error or 0.0)


class _Recorders:
    """Watches a rollout and records each of its episodes."""

    def __init__(self, task: PhasedAblation, spec: Experiment, setting: Setting):
        self.task, self.recorders = task, {}
        self._about = {
            "driver": setting.case.policy,
            "seed": spec.seed,
            "on": setting.case.plant,
        }

    def __call__(self, now: Instant) -> None:
        for row in now.live.nonzero()[:, 0].tolist():
            number = int(now.episodes[row])
            if now.outcome is None:
                self.recorders[number] = EpisodeRecorder(
                    self.task, now.state, row, episode=number, **self._about
                )
            else:
                self.recorders[number].step(now.state, now.outcome, now.actions, row)

    def log(self, number: int) -> EpisodeLog:
        return self.recorders[number].log()


def _rows(
    task: PhasedAblation, setting: Setting, first: int, played: Rollout, verdicts: list[Verdict]
) -> list[Row]:
    table = episode_table(task, played, verdicts)
    for name in DROPPED:
        table.pop(name, None)
    table |= _timings(task, played)
    about: Row = {"setting": setting.label, "case": setting.case.name}
    about |= {"lesion": setting.lesion.name} if setting.lesion else {}
    about |= dict(setting.values)
    outcomes = _outcomes(task, played, verdicts)
    return [
        about
        | {"episode": first + i, "outcome": outcomes[i]}
        | {name: json_safe(float(values[i])) for name, values in table.items()}
        for i in range(played.episodes)
    ]


def _timings(task: PhasedAblation, played: Rollout) -> dict[str, np.ndarray]:
    """How long each phase took, the beam was on, and was on at the end of an unsafe step, s."""
    steps = played.measures["phase"]
    found = {
        f"{phase.name}_s": (steps == number).sum(1) * task.dt_s
        for number, phase in enumerate(task.phases)
    }
    found["beam_s"] = played.measures["beam"].nansum(1) * task.dt_s
    unsafe = played.measures["beam_unsafe"].nan_to_num(0.0) > 0.0
    found["beam_unsafe_longest_s"] = _longest(unsafe) * task.dt_s
    return {name: value.double().cpu().numpy() for name, value in found.items()}


def _longest(on: Tensor) -> Tensor:
    """(N,) int64: the most steps in a row that (N, T) bool holds."""
    best = run = on.new_zeros(len(on)).long()
    for column in on.T:
        run = (run + 1) * column
        best = best.maximum(run)
    return best


def _outcomes(task: PhasedAblation, played: Rollout, verdicts: list[Verdict]) -> list[str]:
    """How each episode ended, in words."""
    reason, where = played.end("reason").tolist(), played.end("reason_phase").tolist()
    names, found = [phase.name for phase in task.phases], []
    for i, verdict in enumerate(verdicts):
        if verdict.contact is not None:
            found.append(f"contact of {verdict.contact.between[0]}, {verdict.contact.between[1]}")
        elif played.failed[i]:
            found.append("an arm is no longer finite")
        elif reason[i]:
            found.append(f"aborted in {names[int(where[i])]}: {REASONS[int(reason[i])]}")
        else:
            found.append("done" if played.terminated[i] else "time out")
    return found
