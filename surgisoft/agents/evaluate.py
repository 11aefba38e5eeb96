"""How well drivers do a task: numbers of each episode, and of all with intervals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import torch
from scipy.stats import binomtest
from torch import Tensor

from surgisoft.agents.policies import Driver
from surgisoft.agents.referee import EpisodeReferee, Verdict, contacts_of, has_referee
from surgisoft.agents.rollout import BATCH, Instant, Rollout, rollout
from surgisoft.files import json_safe
from surgisoft.tasks.base import Task

RESAMPLES = 2000
"""Times that the episodes are drawn anew for an interval."""
CONFIDENCE = 0.95
"""Share of intervals that hold the true mean."""

SUMMARIES: dict[str, Callable[[Rollout, str], Tensor]] = {
    "completion": Rollout.end,
    "largest_gap_mm": Rollout.end,
    "healthy_mm2": Rollout.end,
    "success": Rollout.end,
    "collided": Rollout.largest,
    "clearance_mm": Rollout.smallest,
}
"""What stands for an episode: of measures named here this, of errors four, else the mean."""
RATES = ("success", "collided", "failed")
"""Numbers of an episode that are 0 or 1: their mean is a rate."""


@dataclass(frozen=True)
class Summary:
    """One number over all episodes."""

    mean: float
    """Mean over the episodes where it applies; nan where it applies to none."""
    low: float
    """Lower end of the 95 % interval of the mean."""
    high: float
    """Upper end."""
    least: float
    """Smallest of all episodes."""
    most: float
    """Largest of all episodes."""
    episodes: int
    """Episodes to which it applies."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What N episodes of one driver brought."""

    driver: str
    """Name or folder of the driver."""
    per_episode: dict[str, np.ndarray]
    """name with unit -> (N,); nan where it does not apply."""
    overall: dict[str, Summary]
    """The same names."""
    verdicts: list[Verdict] | None
    """The referee's, for each episode; None where none was asked."""

    def to_json(self) -> dict:
        """Plain numbers and lists; what does not apply is null."""
        answer = {
            "overall": {name: json_safe(asdict(value)) for name, value in self.overall.items()},
            "per_episode": {
                name: json_safe(value.tolist()) for name, value in self.per_episode.items()
            },
        }
        if self.verdicts is not None:
            answer["referee"] = {
                "instants": sum(v.steps for v in self.verdicts),
                "contact_differs": sum(v.contact_differs for v in self.verdicts),
                "beam_differs": sum(v.beam_differs for v in self.verdicts),
                "beam_off_mm": max(v.beam_off_mm for v in self.verdicts),
                "clearance_off_mm": json_safe(max(v.clearance_off_mm for v in self.verdicts)),
                "contacts": [_contact(v) for v in self.verdicts],
            }
        return answer


def evaluate(
    task: Task,
    name: str,
    driver: Driver,
    episodes: int,
    seed: int,
    referee: bool = True,
    batch: int = BATCH,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[Instant], None] | None = None,
) -> Evaluation:
    """Play episodes 0 to `episodes - 1` of a seed; `watch` as for `rollout`.

    With a referee, contact, clearance and success are its own wherever the task has surroundings.
    """
    judge = EpisodeReferee(task) if referee and has_referee(task) else None
    watchers = [each for each in (judge, watch) if each is not None]

    def see(now: Instant) -> None:
        for each in watchers:
            each(now)

    played = rollout(task, driver, episodes, seed, batch, progress, see if watchers else None)
    verdicts = judge.verdicts() if judge else None
    table = episode_table(task, played, verdicts)
    overall = {key: summary(values, key in RATES) for key, values in table.items()}
    return Evaluation(name, table, overall, verdicts)


def episode_table(
    task: Task, played: Rollout, verdicts: list[Verdict] | None = None
) -> dict[str, np.ndarray]:
    """name with unit -> (N,) numbers of each episode."""
    columns: dict[str, Tensor] = {}
    for name in played.measures:
        if name in SUMMARIES:
            columns[name] = SUMMARIES[name](played, name)
        elif name.endswith("error_mm"):
            stem = name.removesuffix("_mm")
            columns[f"{stem}_mean_mm"] = played.mean(name)
            columns[f"{stem}_rms_mm"] = played.rms(name)
            columns[f"{stem}_p95_mm"] = played.quantile(name, 0.95)
            columns[f"{stem}_max_mm"] = played.largest(name)
        else:
            columns[name] = played.mean(name)
        if name == "view_fraction" and has_referee(task):
            columns["in_view"] = _in_view(task, played)
    columns["time_s"] = played.time_s
    columns["failed"] = played.failed.float()
    if verdicts is not None:
        hit = contacts_of(verdicts).to(played.failed.device)
        columns["collided"] = hit.float()
        if "success" in columns:
            columns["success"] = columns["success"].masked_fill(hit, 0.0)
        clearance = [verdict.clearance_mm for verdict in verdicts]
        columns["clearance_mm"] = torch.tensor(clearance, dtype=torch.float64)
    return {name: value.double().cpu().numpy() for name, value in columns.items()}


def _in_view(task: Task, played: Rollout) -> Tensor:
    """(N,) share of the steps at which the endoscope sees as much as the scene asks for."""
    seen = played.measures["view_fraction"]
    enough = (seen >= task.world.scene.spec.limits.view_fraction).float()
    return enough.where(seen.isfinite(), seen).nanmean(1)


def summary(values: np.ndarray, rate: bool = False) -> Summary:
    """Mean of (N,) numbers with its interval: Wilson's (1927) for a rate, else by bootstrap."""
    known = values[np.isfinite(values)]
    if not len(known):
        return Summary(*(math.nan,) * 5, 0)
    if rate:
        low, high = binomtest(round(known.sum()), len(known)).proportion_ci(CONFIDENCE, "wilson")
    else:
        low, high = bootstrap(known)
    ends = (float(known.min()), float(known.max()))
    return Summary(float(known.mean()), float(low), float(high), *ends, len(known))


def bootstrap(values: np.ndarray) -> tuple[float, float]:
    """Ends of the 95 % interval of the mean of (N,) numbers: percentiles (Efron 1979)."""
    draw = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    means = values[draw].mean(axis=1)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(means, [tail, 100.0 - tail])
    return float(low), float(high)


def _contact(verdict: Verdict) -> dict | None:
    found = verdict.contact
    return found and {"time_s": found.time_s, "between": list(found.between)}
