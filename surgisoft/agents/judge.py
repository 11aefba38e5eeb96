"""How good policies are, in two numbers by which the best checkpoint is chosen."""

from __future__ import annotations

import math

from surgisoft.agents.policies import Driver
from surgisoft.agents.record import FirstEpisode
from surgisoft.agents.rollout import rollout
from surgisoft.tasks.base import Task
from surgisoft.tasks.episode import EpisodeLog

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
