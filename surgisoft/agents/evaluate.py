"""Evaluation of policies on a task: numbers of each episode, and means with 95 % intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
import torch
from scipy.special import ndtri, stdtrit
from torch import Tensor

from surgisoft.agents.exact_checks import EpisodeCheck, ExactChecks, contacts_in, has_obstacles
from surgisoft.agents.policies import Policy
from surgisoft.agents.rollout import BATCH, Instant, Rollout, rollout
from surgisoft.files import json_safe, with_former_keys
from surgisoft.progress import Progress, silent
from surgisoft.tasks.base import Task
from surgisoft.tasks.world.scene import SceneEngine

CONFIDENCE = 0.95
"""Confidence level of the intervals."""
FEW = 5
"""Tables have intervals of means from so many episodes on (a count)."""
WHAT_CELLS_ARE = (
    "Means are over episodes, with 95 % intervals in square brackets: Wilson's for rates, "
    f"Student's for all else. Of fewer than {FEW} episodes the least and the greatest number are "
    "in round brackets, in place of Student's interval. "
)
"""How to read a table of means, for reports."""

SUMMARIES: dict[str, Callable[[Rollout, str], Tensor]] = {
    "completion": Rollout.end,
    "largest_gap_mm": Rollout.end,
    "healthy_mm2": Rollout.end,
    "inside_mm2": Rollout.end,
    "passes": Rollout.end,
    "visited": Rollout.end,
    "at_rim_s": Rollout.end,
    "success": Rollout.end,
    "collided": Rollout.largest,
    "clearance_mm": Rollout.smallest,
    "beam_clearance_mm": Rollout.smallest,
    "rim_mm": Rollout.smallest,
}
"""Measure -> how an episode is summarised; errors have four summaries, others the mean."""
RATES = ("success", "collided", "failed")
"""Numbers of an episode that are 0 or 1: their mean is a rate."""
SHARES = ("completion", "view_fraction", "in_view", "visited")
"""Numbers of an episode from 0 to 1: an interval of their mean ends there."""
SIZES = ("_gap_mm", "_mm2", "_s", "passes")
"""Ends of the names of numbers that are never negative, besides errors: gaps, areas, times, counts.
"""


@dataclass(frozen=True)
class Summary:
    """One number over all episodes."""

    mean: float
    """Mean over the episodes where it applies; nan where it applies to none."""
    low: float
    """Lower end of the 95 % interval of the mean; nan where one episode has none."""
    high: float
    """Upper end of the 95 % interval of the mean; nan where one episode has none."""
    least: float
    """Smallest of all episodes."""
    most: float
    """Largest of all episodes."""
    episodes: int
    """Episodes to which it applies."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Results of N episodes of one policy."""

    policy: str
    """Name of the policy, or its run's folder."""
    per_episode: dict[str, np.ndarray]
    """name with unit -> (N,); nan where it does not apply."""
    overall: dict[str, Summary]
    """name with unit -> summary over the N episodes."""
    checks: list[EpisodeCheck] | None
    """Exact collision checks of each episode; None where there were none."""

    @property
    def episodes(self) -> int:
        """Number N of episodes."""
        return len(next(iter(self.per_episode.values())))

    def to_json(self) -> dict:
        """Numbers and lists for JSON; what does not apply is null."""
        document = {
            "overall": {name: json_safe(asdict(value)) for name, value in self.overall.items()},
            "per_episode": {
                name: json_safe(value.tolist()) for name, value in self.per_episode.items()
            },
        }
        if self.checks is not None:
            document["exact_checks"] = {
                "instants": sum(v.steps for v in self.checks),
                "contact_differs": sum(v.contact_differs for v in self.checks),
                "beam_differs": sum(v.beam_differs for v in self.checks),
                "beam_off_mm": max(v.beam_off_mm for v in self.checks),
                "clearance_off_mm": json_safe(max(v.clearance_off_mm for v in self.checks)),
                "contact_asked": sum(v.asked for v in self.checks),
                "contact_audited": sum(v.audited for v in self.checks),
                "beams_asked": sum(v.beams_asked for v in self.checks),
                "contacts": [_contact(v) for v in self.checks],
            }
            return with_former_keys(document, {"referee": "exact_checks"})
        return document


def evaluate(
    task: Task,
    name: str,
    policy: Policy,
    episodes: int,
    seed: int,
    exact: bool = True,
    batch: int = BATCH,
    progress: Progress = silent,
    watch: Callable[[Instant], None] | None = None,
    without: Collection[str] = (),
) -> Evaluation:
    """Roll out episodes 0 to `episodes - 1` of a seed and summarise them.

    name: how the result names the policy. exact: contact, clearance and success are those of the
    exact collision checker (FCL) where the task has obstacles. batch, progress, watch: as for
    `rollout`. without: measures that are left out of the numbers.
    """
    exactly = exact_checks_of(task, exact)
    watcher = watched_by(exactly, watch)
    result = rollout(task, policy, episodes, seed, batch, progress, watcher)
    return summarised(task, name, result, exactly, without)


def exact_checks_of(task: Task, exact: bool) -> ExactChecks | None:
    """The exact checks of a rollout, if they are asked for and the task has obstacles."""
    return ExactChecks(task) if exact and has_obstacles(task) else None


def watched_by(*watchers: Callable[[Instant], None] | None) -> Callable[[Instant], None] | None:
    """One function for `rollout(watch=...)` that calls those that are not None."""
    given = [each for each in watchers if each is not None]

    def see(now: Instant) -> None:
        for each in given:
            each(now)

    return see if given else None


def summarised(
    task: Task,
    name: str,
    result: Rollout,
    exactly: ExactChecks | None,
    without: Collection[str] = (),
) -> Evaluation:
    """The numbers of a rollout that begins with episode 0; exactly: what watched it."""
    checks = exactly.checks(result.episodes) if exactly else None
    table = episode_table(task, result, checks)
    table = {key: values for key, values in table.items() if key not in without}
    overall = {key: summary(key, values) for key, values in table.items()}
    return Evaluation(name, table, overall, checks)


def episode_table(
    task: Task, result: Rollout, checks: list[EpisodeCheck] | None = None
) -> dict[str, np.ndarray]:
    """name with unit -> (N,) numbers of each episode."""
    columns: dict[str, Tensor] = {}
    for name in result.measures:
        if name in SUMMARIES:
            columns[name] = SUMMARIES[name](result, name)
        elif name.endswith("error_mm"):
            stem = name.removesuffix("_mm")
            columns[f"{stem}_mean_mm"] = result.mean(name)
            columns[f"{stem}_rms_mm"] = result.rms(name)
            columns[f"{stem}_p95_mm"] = result.quantile(name, 0.95)
            columns[f"{stem}_max_mm"] = result.largest(name)
        else:
            columns[name] = result.mean(name)
        if name == "view_fraction" and has_obstacles(task):
            columns["in_view"] = _in_view(task, result)
    columns["time_s"] = result.time_s
    columns["failed"] = result.failed.float()
    if checks is not None:
        hit = contacts_in(checks).to(result.failed.device)
        columns["collided"] = hit.float()
        if "success" in columns:
            columns["success"] = columns["success"].masked_fill(hit, 0.0)
        clearance = [check.clearance_mm for check in checks]
        columns["clearance_mm"] = torch.tensor(clearance, dtype=torch.float64)
    return {name: value.double().cpu().numpy() for name, value in columns.items()}


def _in_view(task: Task, result: Rollout) -> Tensor:
    """(N,) share of the steps at which the endoscope sees as much as the scene requires."""
    seen, scene = result.measures["view_fraction"], task.world.scene
    assert isinstance(scene, SceneEngine), "only a whole scene has a view"
    enough = (seen >= scene.spec.limits.view_fraction).float()
    return enough.where(seen.isfinite(), seen).nanmean(1)


def summary(name: str, values: np.ndarray) -> Summary:
    """Mean of (N,) numbers of that name with its interval.

    Wilson's (1927) for a rate, else Student's (1908), within the values that the number can have.
    """
    known = values[np.isfinite(values)]
    if not len(known):
        return Summary(*(math.nan,) * 5, 0)
    if name in RATES:
        low, high = wilson(round(known.sum()), len(known))
    else:
        low, high = np.clip(student(known), *_range(name))
    ends = (float(known.min()), float(known.max()))
    return Summary(float(known.mean()), float(low), float(high), *ends, len(known))


def differences(first: Evaluation, other: Evaluation) -> dict[str, Summary]:
    """Numbers of another policy minus those of the first, over the episodes that both have.

    name with unit -> mean of the N differences, one for each episode, with Student's (1908)
    interval of paired samples: what episodes have in common, such as their goals, is not in it.
    Rates are left out.
    """
    count = min(first.episodes, other.episodes)
    found = {}
    for name, values in first.per_episode.items():
        if name in other.per_episode and name not in RATES:
            apart = other.per_episode[name][:count] - values[:count]
            found[name] = _plain_summary(apart[np.isfinite(apart)])
    return found


def _plain_summary(known: np.ndarray) -> Summary:
    """Mean of (N,) finite numbers of any sign, with Student's interval."""
    if not len(known):
        return Summary(*(math.nan,) * 5, 0)
    return Summary(
        float(known.mean()), *student(known), float(known.min()), float(known.max()), len(known)
    )


def _range(name: str) -> tuple[float, float]:
    """Least and largest value that a number of that name can have."""
    if name in SHARES:
        return 0.0, 1.0
    return 0.0 if "error" in name or name.endswith(SIZES) else -math.inf, math.inf


def wilson(hits: int, count: int) -> tuple[float, float]:
    """Ends of the 95 % interval of a rate, of which `count` trials gave a number of hits.

    Wilson 1927, the score interval without correction for continuity. Its two ends are written
    here because the import of `scipy.stats`, which has them, takes half a second.
    """
    z, rate = float(ndtri((1.0 + CONFIDENCE) / 2.0)), hits / count
    middle = (2.0 * hits + z**2) / (2.0 * (count + z**2))
    half = z / (2.0 * (count + z**2)) * math.sqrt(4.0 * count * rate * (1.0 - rate) + z**2)
    return 0.0 if not hits else middle - half, 1.0 if hits == count else middle + half


def student(values: np.ndarray) -> tuple[float, float]:
    """Ends of the 95 % interval of the mean of (N,) numbers; nan for one number, which has none.

    Student 1908: the mean and N - 1 degrees of freedom. It is as wide as few episodes require;
    percentiles of a bootstrap (Efron 1979) hold the mean of two numbers half the time.
    """
    if len(values) < 2:
        return math.nan, math.nan
    mean, error = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(len(values))
    half = float(stdtrit(len(values) - 1, (1.0 + CONFIDENCE) / 2.0)) * error
    return mean - half, mean + half


def cells_are(summaries: Iterable[Mapping[str, Summary]]) -> str:
    """What `cell` writes of these numbers of the policies or settings, for the head of a table."""
    few = any(_is_few(n, value) for overall in summaries for n, value in overall.items())
    return "mean [95 % interval]" + " or (least to greatest)" * few


def _is_few(name: str, value: Summary) -> bool:
    """Whether a number that differs is of so few episodes that its interval says nothing of it."""
    return name not in RATES and 1 < value.episodes < FEW and value.least < value.most


def cell(name: str, value: Summary | None) -> str:
    """A mean with its interval in brackets; without one where all episodes have the same number.

    Of fewer than `FEW` episodes least and greatest number: Student's interval of two is 25 times as
    wide as what lies between them, which looks like contact where a clearance is ample.
    """
    if value is None or not value.episodes:
        return "-"
    if name in RATES:
        return f"{value.mean:.1%} [{value.low:.1%}, {value.high:.1%}]"
    if value.least == value.most:
        return f"{value.mean:.4g}"
    if _is_few(name, value):
        return f"{value.mean:.4g} ({value.least:.4g} to {value.most:.4g})"
    return f"{value.mean:.4g} [{value.low:.4g}, {value.high:.4g}]"


def _contact(check: EpisodeCheck) -> dict | None:
    found = check.contact
    return None if found is None else {"time_s": found.time_s, "between": list(found.between)}
