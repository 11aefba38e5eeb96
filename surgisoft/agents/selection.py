"""Checkpoint selection: which of the evaluated policies of a training is saved as `best`."""

from __future__ import annotations

import math

from surgisoft.agents.evaluate import SUMMARIES
from surgisoft.agents.policies import Policy
from surgisoft.agents.rollout import EpisodeRecorders, rollout
from surgisoft.tasks.base import Task
from surgisoft.tasks.episodes.log import EpisodeLog

MEAN_RETURN = "mean_return"
"""Number of an evaluation that selects where a task measures neither success nor an error: the
mean over episodes of the rewards' sum over steps and agents."""
SEED = 0x5EED
"""Seed of the validation episodes that select the checkpoint; no other evaluation may use it."""


def evaluate_checkpoint(
    task: Task, policy: Policy, episodes: int
) -> tuple[dict[str, float], EpisodeLog]:
    """Means over validation episodes without exploration noise, and the first episode's log.

    error_mm: mean over steps and episodes of the task's first error; success: share of episodes,
    absent where a task has none; the other measures by their names, each summarised in an episode
    as `evaluate.SUMMARIES` says, or the mean over steps and episodes where it does not. Without
    success and error there is `MEAN_RETURN` too.
    """
    watch = EpisodeRecorders(task, "learned", SEED, only=0)
    result = rollout(task, policy, episodes, SEED, watch=watch)
    means = {}
    for name, trace in result.measures.items():
        if name in SUMMARIES:
            means[name] = SUMMARIES[name](result, name).nanmean().item()
        elif name.endswith("error_mm") and "error_mm" not in means:
            means["error_mm"] = trace.nanmean().item()
        else:
            means[name] = trace.nanmean().item()
    if not has_goal(means):
        means[MEAN_RETURN] = sum(value.mean().item() for value in result.returns.values())
    return means, watch.log(0)


def has_goal(found: dict[str, float]) -> bool:
    """Whether an evaluation has a number that tells how good a policy is: success or an error."""
    return "success" in found or "error_mm" in found


def is_better(found: dict[str, float], best: dict[str, float] | None) -> bool:
    """Whether success is higher, or equal with a smaller error; without both, the return."""
    return best is None or _rank(found) < _rank(best)


def _rank(found: dict[str, float]) -> tuple[float, float]:
    if not has_goal(found):
        gained = found.get(MEAN_RETURN, -math.inf)
        return 0.0, -gained if math.isfinite(gained) else math.inf
    error = found.get("error_mm", math.inf)
    return -found.get("success", 0.0), error if math.isfinite(error) else math.inf
