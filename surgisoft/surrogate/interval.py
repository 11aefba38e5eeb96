"""Prediction intervals by conformal prediction: how far measured key points lie from predicted.

Errors on rows that a network was not trained on are scored, and the quantile of the scores bounds
the error of further rows (Vovk, Gammerman & Shafer 2005, ch. 2). The rows of a recording depend on
each other, so that whole runs, or long blocks of time, are left out of the training together.

The score of key point k with the error e_k is that of locally weighted conformal prediction (Lei
et al. 2018, sec. 5.2), with the distance d to the nearest actuation of the training as the scale:

    s_k = e_k / (1 + growth d),    radius_k(level) = (1 + growth d) quantile_level(s_k).

d is the Euclidean distance in actuation, each chamber in shares of its range. Far from the training
data the interval widens; how much, is chosen among `GROWTHS` so that the mean radius at `LEVEL` is
least. That growth is 0 where distance does not matter.

A further run differs from all of those that were scored, so the quantile of few runs covers too
little of it. Each group of rows is therefore left out of the scores in turn, and all quantiles are
multiplied by the least factor, at least 1, with which the quantiles of the others cover the groups
left out (the jackknife of Barber et al. 2021, by groups). Where groups are alike it is near 1.
"""

import math
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor

LEVEL = 0.95
"""Coverage that is reported where none is asked for."""
LEVELS = (0.5, 0.6827, 0.8, 0.9, 0.95, 0.975, 0.99)
"""Coverages whose quantiles are stored."""
GROWTHS = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Growths of the score's scale by distance that are tried, per range of a chamber."""
LEAST_GAIN = 0.05
"""Least fall of the mean radius that a growth has to bring, as a share of the radius without."""
REFERENCE_ROWS = 1500
"""Most rows of the training among which the nearest actuation is looked for."""
MOST_GROUPS = 50
"""Most groups that are left out one by one; of more groups the quantiles hardly depend on one."""
LEAST_ROWS = 100
"""Fewest rows with a measured key point from which its quantiles are taken."""


@dataclass(frozen=True)
class ErrorInterval:
    """Radii around predicted key points, by coverage and by distance to the training data."""

    levels: tuple[float, ...]
    """Coverages, rising."""
    quantiles_mm: tuple[tuple[float, ...], ...]
    """For each coverage, the quantile of each key point's score, base to tip, mm."""
    growth: float
    """Growth of the radius by distance to the training data, per range of a chamber."""
    rows: int
    """Number of rows whose errors were scored."""
    groups: int
    """Number of runs, or of blocks of time, that these rows belong to."""
    source: str
    """`cross-validation` (each row predicted by a network whose training left its group out) or
    `held-out rows` (rows that stopped the training and selected the model)."""

    def radius_mm(self, distance: Tensor, coverage: float = LEVEL) -> Tensor:
        """(..., n) radii in mm for distances (...) in ranges of a chamber.

        Between two stored coverages the logarithm of the quantile is interpolated over that of the
        share outside; beyond them the nearest is taken.
        """
        quantile = distance.new_tensor(self._quantile(coverage))
        return (1 + self.growth * distance).unsqueeze(-1) * quantile

    def _quantile(self, coverage: float) -> list[float]:
        if coverage in self.levels:  # exactly, so that the rows that calibrated it are covered
            return list(self.quantiles_mm[self.levels.index(coverage)])
        place = [-math.log(1 - level) for level in self.levels]
        x = min(max(-math.log(max(1 - coverage, 1e-12)), place[0]), place[-1])
        above = next(i for i, at in enumerate(place) if at >= x)
        if above == 0:
            return list(self.quantiles_mm[0])
        share = (x - place[above - 1]) / (place[above] - place[above - 1])
        return [
            math.exp((1 - share) * math.log(max(a, 1e-9)) + share * math.log(max(b, 1e-9)))
            for a, b in zip(self.quantiles_mm[above - 1], self.quantiles_mm[above], strict=True)
        ]

    def scaled(self, factor: float) -> "ErrorInterval":
        """This interval with all radii times a factor."""
        quantiles = tuple(tuple(factor * x for x in row) for row in self.quantiles_mm)
        return replace(self, quantiles_mm=quantiles)

    def to_json(self) -> dict:
        """Plain values, for a model's `config.json`."""
        return asdict(self)

    def sentence(self) -> str:
        """What it says on a row like those of the training, in one line."""
        radii = " ".join(f"{value:.2f}" for value in self._quantile(LEVEL))
        beyond = f"; wider by {self.growth:g} x distance to the training data" * (self.growth > 0)
        return (
            f"{LEVEL:.0%} of held-out key points lie within (base to tip) {radii} mm of the "
            f"prediction ({self.source}, {self.rows} rows in {self.groups} groups{beyond})"
        )


def distance_to(actuation: Tensor, reference: Tensor, span: Tensor) -> Tensor:
    """(S,) distance of actuation (S, m) to the nearest row of reference (Q, m), in ranges (m,)."""
    at, there = actuation / span, reference / span
    return torch.cat([torch.cdist(part, there).amin(1) for part in at.split(4096)])


def distance_across(actuation: Tensor, fold: Tensor, span: Tensor) -> Tensor:
    """(S,) distance of each row's actuation (S, m) to the nearest of other folds, in ranges (m,).

    Of the other folds' rows REFERENCE_ROWS are taken, evenly thinned.
    """
    thin = torch.arange(0, len(fold), max(1, -(-len(fold) // REFERENCE_ROWS)))
    apart = torch.zeros(len(fold))
    for number in fold.unique():
        mine, others = fold == number, thin[fold[thin] != number]
        if len(others):
            apart[mine] = distance_to(actuation[mine], actuation[others], span)
    return apart


def calibrate(error: Tensor, distance: Tensor, group: Tensor, source: str) -> ErrorInterval | None:
    """The interval of errors on rows that the training left out; None for too few rows.

    error: (S, n) distance of measured from predicted key points, mm, NaN where missing; distance:
    (S,) to the nearest actuation of the training; group: (S,) number of the run or block of each
    row.
    """
    if int((~error.isnan()).sum(0).min()) < LEAST_ROWS:
        return None
    error, distance = error.double(), distance.double()

    def mean_radius(growth: float) -> float:
        scale = 1 + growth * distance
        return float((scale.mean() * _quantiles(error / scale[:, None], LEVEL)).mean())

    radii = {growth: mean_radius(growth) for growth in GROWTHS}
    growth = min(radii, key=lambda growth: radii[growth])
    if radii[growth] > (1 - LEAST_GAIN) * radii[0.0]:
        growth = 0.0
    scores = error / (1 + growth * distance)[:, None]
    widest, quantiles = torch.zeros_like(scores[0]), []
    for level in LEVELS:
        wide = group_factor(scores, group, level) * _quantiles(scores, level)
        widest = torch.maximum(widest, wide)
        quantiles.append(tuple(widest.tolist()))
    return ErrorInterval(
        LEVELS,
        tuple(quantiles),
        growth,
        len(error),
        len(group.unique()),
        source,
    )


def group_factor(scores: Tensor, group: Tensor, level: float) -> float:
    """Least factor >= 1 on quantiles by which those of all other groups cover each group left out.

    scores: (S, n), NaN where missing; group: (S,) number of the run or block of each row; level:
    share of the scores of all groups left out to cover. 1 for a single group, or more than
    `MOST_GROUPS`.
    """
    names = group.unique()
    if not 1 < len(names) <= MOST_GROUPS:
        return 1.0
    ratios = torch.full_like(scores, torch.nan)
    for name in names:
        mine = group == name
        others = scores[~mine]
        if int((~others.isnan()).sum(0).min()) < LEAST_ROWS:
            return 1.0
        ratios[mine] = scores[mine] / _quantiles(others, level).clamp(min=1e-12)
    return max(1.0, float(_quantiles(ratios.flatten()[:, None], level)[0]))


def _quantiles(scores: Tensor, level: float) -> Tensor:
    """(n,) smallest score that a share of at least `level` of S + 1 rows does not exceed.

    (S, n) scores, NaN where missing. One row more is counted, the next one (Vovk et al. 2005).
    """
    found = []
    for column in scores.unbind(1):
        ordered = column[~column.isnan()].sort().values
        found.append(ordered[min(math.ceil(level * (len(ordered) + 1)), len(ordered)) - 1])
    return torch.stack(found)


def coverage_of(error: Tensor, radius: Tensor) -> float:
    """Share of measured key points whose error (..., n) is within radius (..., n), both mm."""
    seen = ~error.isnan()
    return int(((error <= radius) & seen).sum()) / max(int(seen.sum()), 1)
