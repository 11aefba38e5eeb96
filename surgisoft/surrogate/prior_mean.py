"""Fit of the prior mean: a chain of arcs by regularised least squares, before any training.

Minimised over the bends, stretches and base are

    mean |measured - arcs|^2 + v (ridge |bends|^2 + stretch_ridge |stretches|^2
                                  + offset_ridge |offsets|^2),

with v the mean squared motion of a key point, by L-BFGS (Liu & Nocedal 1989) in double precision.
Bends and stretches are those of half a chamber's range. A ridge is the prior of a Gaussian
variable, s^2 / (N w^2): what the arcs leave is about s = 15 % of the motion, of which a short
recording has about N = 20 independent samples, and the variable is of the size w. Without it, a
chamber that hardly moved gets a large bend that fits the others' residuals.
"""

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.surrogate.history import History
from surgisoft.surrogate.networks import ArcChain

RIDGE = 1e-3
"""Weight of the squared bends (rad), in mean squared motions: bends of the size of 1 rad."""
STRETCH_RIDGE = 1e-1
"""Weight of the squared relative stretches, in mean squared motions: stretches of 0.1."""
OFFSET_RIDGE = 1e-3
"""Weight of the squared offsets of markers from the arcs' ends, in mean lengths of an arc."""
MOST_ROWS = 1500
"""Largest number of rows that are fitted to, evenly thinned."""
ITERATIONS = 150
"""Most iterations."""
STILL = 0.02
"""A first key point that moves less than this share of the last one's motion is the fixed base."""


def arcs_of(points: Tensor) -> int:
    """Number of arcs of a prior mean for measured key points (S, n, 3) in mm, NaN where missing."""
    motion = (points - points.nanmean(0)).square().sum(-1).nanmean(0).sqrt()
    return points.shape[1] - int(motion[0] < STILL * motion[-1])


def fit_prior_mean(prior: ArcChain, history: History, rest: Tensor) -> None:
    """Fit a prior mean to the measured rows of a history; rest: (n, 3) key points at rest, mm.

    Raises InputError where the key points are no chain at rest, or the arcs do not follow them.
    """
    prior.set_rest(rest)
    points = history.rows(history.key_points)
    seen = (~points.isnan()).all(-1).any(-1)
    pressure, points = history.rows(history.pressure)[seen], points[seen]
    fit_arcs(prior, pressure, points)
    with torch.no_grad():
        left = (points - prior(pressure)).square().nanmean()
    if not left < (points - points.nanmean(0)).square().nanmean():
        raise InputError("prior mean: the arcs do not follow the key points, expected a chain")


def fit_arcs(
    prior: ArcChain, pressure: Tensor, points: Tensor, iterations: int = ITERATIONS
) -> None:
    """Fit a chain of arcs, from its present parameters, to measured rows, evenly thinned.

    pressure: (S, m) in the arm's unit; points: (S, n, 3) measured key points, mm, NaN where
    missing; iterations: most of them.
    """
    step = max(1, -(-len(points) // MOST_ROWS))
    pressure, points = pressure[::step].double(), points[::step].double()
    known, points = ~points.isnan(), points.nan_to_num()
    count = known.sum().clamp(min=1) / 3
    mean = points.sum(0) / known.sum(0).clamp(min=1)
    motion = float(((points - mean) * known).square().sum() / count)
    prior.double()
    parameters = list(prior.parameters())
    optimiser = torch.optim.LBFGS(
        parameters, max_iter=iterations, history_size=30, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        optimiser.zero_grad()
        left = ((prior(pressure) - points) * known).square().sum() / count
        held = RIDGE * prior.table[:, :2, :-1].square().sum()
        held = held + STRETCH_RIDGE * prior.table[:, 2, :-1].square().sum()
        held = held + OFFSET_RIDGE * prior.offset.square().sum()
        total = left / motion + held
        total.backward()
        return total

    optimiser.step(loss)
    prior.float()
