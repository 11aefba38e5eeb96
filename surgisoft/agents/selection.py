"""The log of a rollout's first episode."""

from __future__ import annotations

import math

from surgisoft.agents.policies import Driver
from surgisoft.agents.rollout import Instant, rollout
from surgisoft.tasks.base import Task
from surgisoft.tasks.episodes.log import EpisodeLog, EpisodeRecorder


class FirstEpisode:
    """Watches a rollout, see `rollout(watch=...)`, and records its episode 0."""

    def __init__(self, task: Task, driver: str, seed: int, on: str = "simulation"):
        """driver, seed, on: what the log shall say of where it comes from."""
        self.task, self._about = task, {"driver": driver, "seed": seed, "on": on}
        self._recorder: EpisodeRecorder | None = None

    def __call__(self, now: Instant) -> None:
        """Keep what an instant holds of episode 0."""
        row = (now.live & (now.episodes == 0)).nonzero()[:, 0].tolist()
        if not row:
            return
        if now.outcome is None:
            self._recorder = EpisodeRecorder(self.task, now.state, row[0], episode=0, **self._about)
        else:
            self._recorder.step(now.state, now.outcome, now.actions, row[0])

    def log(self) -> EpisodeLog:
        """The episode, after the rollout."""
        return self._recorder.log()


SEED = 0x5EED
"""Seed of the episodes that choose the best checkpoint; no other evaluation should use it."""


def judge(task: Task, driver: Driver, episodes: int) -> tuple[dict[str, float], EpisodeLog]:
    """What whole episodes without noise bring: `error_mm`, `success`, and means of the rest.

    error_mm: mean over steps and episodes; success: share of episodes, absent where a task has
    none. Beside it the log of the first episode.
    """
    watch = FirstEpisode(task, "learned", SEED)
    played = rollout(task, driver, episodes, SEED, watch=watch)
    answer = {}
    for name, trace in played.measures.items():
        if name == "success":
            answer[name] = played.end(name).mean().item()
        elif name.endswith("error_mm"):
            answer["error_mm"] = trace.nanmean().item()
        elif name in ("completion", "largest_gap_mm", "healthy_mm2"):
            answer[name] = played.end(name).nanmean().item()
        else:
            answer[name] = trace.nanmean().item()
    return answer, watch.log()


def better(found: dict[str, float], best: dict[str, float] | None) -> bool:
    """More success, or as much with a smaller error."""
    return best is None or _rank(found) < _rank(best)


def _rank(found: dict[str, float]) -> tuple[float, float]:
    error = found.get("error_mm", math.inf)
    return -found.get("success", 0.0), error if math.isfinite(error) else math.inf
