"""Prediction intervals by conformal prediction: how far measured key points lie from predicted.

Errors on rows that a network was not trained on are scored, and the quantile of the scores bounds
the error of further rows (Vovk, Gammerman & Shafer 2005, ch. 2). The rows of a recording depend on
each other, so that whole runs, or long blocks of time, are left out of the training together.

The score of key point k with the error e_k is that of locally weighted conformal prediction (Lei
et al. 2018, sec. 5.2), with the distance d to the nearest actuation of the training as the scale:

    s_k = e_k / (1 + growth_k d),    radius_k(level) = (1 + growth_k d) quantile_level(s_k).

d is the Euclidean distance in actuation, each chamber in shares of its range. Far from the training
data the interval of a key point widens with its growth > 0. Each key point has its own: the tip may
be off by more and more where one at the base is off by the noise of the cameras everywhere. The
most likely of `GROWTHS` is taken: the sizes of groups (see below) are log-normal, so it is that
with the least variance of their logarithms. The growth is 0 unless the sum of squares falls by more
than one more parameter takes away by chance (F test at 5 %, with 1 and K - 2 degrees of freedom).

The scores show the errors at the distances of the groups that were left out, and none nearer to the
training: where only 5 % of them were nearer, the radius falls no further (`nearest`).

A further run differs from all of those that were scored, so the quantile of few runs covers too
little of it. Without an assumption on runs no finite radius is certain to hold a share `level` of
the rows of a further run, on average over runs, unless level <= K / (K + 1), with K runs: 19 runs
for 95 % (hierarchical conformal prediction, Lee, Barber & Willett 2023). With fewer runs the radius
rests on an assumption: the sizes of runs, i.e. their RMS scores R_g, are log-normal. The logarithm
of the size of a further run then follows Student's t distribution (prediction interval of a normal
sample, Hahn & Meeker 1991, ch. 4), and the scores within a run, z = s / R_g, have the distribution
that they have in all runs:

    log R_new = mean(log R_g) + sd(log R_g) sqrt(1 + 1 / K) t_(K-1),
    radius(level): P(R_new z <= radius) = level,

with one degree of freedom less where a growth was fitted. Where runs are alike this is the quantile
of all rows. Of fewer than `LEAST_GROUPS` groups the spread is not known: all quantiles are
multiplied by the least factor, at least 1, with which those of the other groups cover each group
left out (the jackknife of Barber et al. 2021, by groups).
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import torch
from scipy.special import stdtrit
from torch import Tensor

LEVEL = 0.95
"""Coverage that is reported where none is asked for."""
LEVELS = (0.5, 0.6827, 0.8, 0.9, 0.95, 0.975, 0.99)
"""Coverages whose quantiles are stored."""
GROWTHS = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Growths of the score's scale by distance that are tried, per range of a chamber."""
NEAREST = 0.05
"""Share of the scored rows below whose distance the scale is not extrapolated."""
FURTHER = 0.1
"""Distance beyond the nearest scored rows of which the radii are told, too, where they grow, in
ranges of a chamber."""
LEAST_GAIN = 0.05
"""Least fall of the mean radius that a growth has to bring where groups are too few for a test, as
a share of the radius without."""
CERTAINTY = 0.975
"""Quantile of Student's t whose square is the threshold of the F test for a growth, at 5 %."""
EXACT_GROUPS = math.ceil(LEVEL / (1 - LEVEL) - 1e-9)
"""Fewest groups for `LEVEL` without an assumption on their sizes: LEVEL <= K / (K + 1)."""
LEAST_GROUPS = 4
"""Fewest groups from which the spread of the sizes of groups is estimated: the blocks of one run
that a fit holds out."""
PREDICTIVE_DRAWS = 2000
"""Quantiles of Student's t that stand for the size of a further group."""
LEAST_SIZE = 1e-3
"""Least size of a group that counts, as a share of the RMS score of all rows."""
REFERENCE_ROWS = 1500
"""Most rows of the training among which the nearest actuation is looked for."""
MOST_GROUPS = 50
"""Most groups whose spread widens the quantiles; those of more groups hardly depend on it."""
LEAST_ROWS = 100
"""Fewest rows with a measured key point from which its quantiles are taken."""


@dataclass(frozen=True)
class ErrorInterval:
    """Radii around predicted key points, by coverage and by distance to the training data."""

    levels: tuple[float, ...]
    """Coverages, rising."""
    quantiles_mm: tuple[tuple[float, ...], ...]
    """For each coverage, the quantile of each key point's score, base to tip, mm."""
    growth: tuple[float, ...]
    """Growth of each key point's radius by distance to the training data, per range of a
    chamber."""
    rows: int
    """Number of rows whose errors were scored."""
    groups: int
    """Number of runs, or of blocks of time, that these rows belong to."""
    source: str
    """`cross-validation` (each row predicted by a network whose training left its group out) or
    `held-out rows` (rows that stopped the training and selected the model)."""
    nearest: float = 0.0
    """Distance below which radii stay as they are there, in ranges of a chamber."""

    def radius_mm(self, distance: Tensor, coverage: float = LEVEL) -> Tensor:
        """(..., n) radii in mm for distances (...) in ranges of a chamber.

        Between two stored coverages the logarithm of the quantile is interpolated over that of the
        share outside; beyond them the nearest is taken.
        """
        quantile = distance.new_tensor(self._quantile(coverage))
        distance = distance.clamp(min=self.nearest)
        return (1 + distance.unsqueeze(-1) * distance.new_tensor(self.growth)) * quantile

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

    def scaled(self, factors: Sequence[float]) -> "ErrorInterval":
        """This interval with the radii of each key point times a factor of its own."""
        quantiles = tuple(
            tuple(factor * x for factor, x in zip(factors, row, strict=True))
            for row in self.quantiles_mm
        )
        return replace(self, quantiles_mm=quantiles)

    def to_json(self) -> dict:
        """Plain values, for a model's `config.json`."""
        return asdict(self)

    def sentence(self) -> str:
        """The interval on a row like those of the training, in one line.

        Where it widens with the distance, also that at `FURTHER` beyond such rows.
        """
        beyond = ""
        if any(self.growth):
            further = self.nearest + FURTHER
            beyond = (
                " where the training data have nearly the same actuation, and within "
                f"{self._radii(further)} mm where the actuation is {further:.0%} of a chamber's "
                "range away from all of them"
            )
        few = f"; fewer than {EXACT_GROUPS}, so their RMS errors are taken to be log-normal"
        if self.groups < LEAST_GROUPS:
            few = "; too few to know how much groups differ"
        few *= self.groups < EXACT_GROUPS
        return (
            f"{LEVEL:.0%} of the key points of a further run are within (base to tip) "
            f"{self._radii(self.nearest)} mm of the prediction{beyond} ({self.source}, {self.rows} "
            f"rows in {self.groups} groups{few})"
        )

    def _radii(self, distance: float) -> str:
        """Radii in mm, base to tip, at a distance in ranges of a chamber."""
        radii = self.radius_mm(torch.tensor(distance, dtype=torch.float64)).tolist()
        return " ".join(f"{value:.2f}" for value in radii)


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
    nearest = float(distance.kthvalue(math.ceil(NEAREST * len(distance))).values)
    distance = distance.clamp(min=nearest)
    growth = [_growth(column[:, None], distance, group) for column in error.unbind(1)]
    scores = error / (1 + distance[:, None] * error.new_tensor(growth))
    fitted = [1 + (each > 0) for each in growth]
    widest, quantiles = torch.zeros_like(scores[0]), []
    for level in LEVELS:
        widest = torch.maximum(widest, group_quantiles(scores, group, level, fitted))
        quantiles.append(tuple(widest.tolist()))
    return ErrorInterval(
        LEVELS,
        tuple(quantiles),
        tuple(growth),
        len(error),
        len(group.unique()),
        source,
        nearest if any(growth) else 0.0,
    )


def group_quantiles(
    scores: Tensor, group: Tensor, level: float, fitted: Sequence[int] | None = None
) -> Tensor:
    """(n,) scores that hold a share `level` of the rows of a further group.

    scores: (S, n), NaN where missing; group: (S,) number of the run or block of each row; fitted:
    for each key point the parameters that were fitted to the sizes of groups: their mean, and a
    growth; None: the mean alone. Of one group, or of more than `MOST_GROUPS`, the quantiles of all
    rows.
    """
    plain = _quantiles(scores, level)
    names, index = group.unique(return_inverse=True)
    if not 1 < len(names) <= MOST_GROUPS:
        return plain
    found = []
    for column, parameters in zip(scores.unbind(1), fitted or [1] * scores.shape[1], strict=True):
        seen = ~column.isnan()
        of_further = _of_further_group(column[seen], index[seen], level, parameters)
        if of_further is None:
            return group_factor(scores, group, level) * plain
        found.append(of_further)
    return plain.new_tensor(found)


def _of_further_group(scores: Tensor, group: Tensor, level: float, fitted: int) -> float | None:
    """Score that holds a share `level` of the rows of a further group; None for too few groups.

    scores: (S,) without missing ones; group: (S,). See the module for the formula.
    """
    names, index = group.unique(return_inverse=True)
    count = len(names)
    if count < LEAST_GROUPS:
        return None
    size = _sizes(scores, index)
    shape = (scores / size[index]).sort().values
    share = (torch.arange(PREDICTIVE_DRAWS).to(scores) + 0.5) / PREDICTIVE_DRAWS
    free = count - fitted
    variance = float((size.log() - size.log().mean()).square().sum()) / free
    spread = math.sqrt(variance * (1 + 1 / count))
    drawn = (size.log().mean() + spread * torch.from_numpy(stdtrit(free, share.numpy()))).exp()

    def held(radius: float) -> float:
        """Share of the rows of further groups within a radius."""
        below = torch.searchsorted(shape, radius / drawn, right=True)
        return float(below.double().mean()) / len(shape)

    low, high = 0.0, float(shape[-1] * drawn[-1])
    while high - low > 1e-6 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if held(middle) >= level else (middle, high)
    return high


def _growth(error: Tensor, distance: Tensor, group: Tensor) -> float:
    """Growth of the scale of scores (S,) by distance, 0 where the sizes of groups do not show any.

    Of fewer than `LEAST_GROUPS` groups: the one of least mean radius.
    """
    index = group.unique(return_inverse=True)[1]
    count = int(index.max()) + 1
    if count < LEAST_GROUPS:

        def mean_radius(growth: float) -> float:
            scale = 1 + growth * distance
            return float((scale.mean() * _quantiles(error / scale[:, None], LEVEL)).mean())

        radii = {growth: mean_radius(growth) for growth in GROWTHS}
        best = min(radii, key=lambda growth: radii[growth])
        return best if radii[best] <= (1 - LEAST_GAIN) * radii[0.0] else 0.0
    spread = {
        growth: _spread(error / (1 + growth * distance)[:, None], index) for growth in GROWTHS
    }
    best = min(spread, key=lambda growth: spread[growth])
    threshold = 1 + float(stdtrit(count - 2, CERTAINTY)) ** 2 / (count - 2)
    return best if spread[0.0] > threshold * spread[best] else 0.0


def _spread(scores: Tensor, group: Tensor) -> float:
    """Sum of squares of the logarithms of group sizes around their mean, over all key points.

    scores: (S, n), NaN where missing; group: (S,) numbers from 0.
    """
    total = 0.0
    for column in scores.unbind(1):
        seen = ~column.isnan()
        if seen.any():
            log = _sizes(column[seen], group[seen].unique(return_inverse=True)[1]).log()
            total += float((log - log.mean()).square().sum())
    return total


def _sizes(scores: Tensor, group: Tensor) -> Tensor:
    """(K,) RMS score of each group, at least `LEAST_SIZE` of that of all rows; group: from 0."""
    rows = torch.bincount(group)
    square = torch.zeros(len(rows)).to(scores).index_add(0, group, scores.square())
    least = LEAST_SIZE * scores.square().mean().sqrt()
    return (square / rows).sqrt().clamp(min=float(least.clamp(min=1e-12)))


def group_factor(scores: Tensor, group: Tensor, level: float) -> float:
    """Least factor >= 1 on quantiles by which those of all other groups cover each group left out.

    scores: (S, n), NaN where missing; group: (S,) number of the run or block of each row; level:
    share of the scores of all groups left out to cover. 1 where a group left out leaves too few.
    """
    ratios = torch.full_like(scores, torch.nan)
    for name in group.unique():
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
