"""Fit of a `KernelArm`: arcs first, then kernel regression of what they leave, by cross-validation.

The weights W of the landmarks are those of kernel ridge regression (Williams & Seeger 2001, eq. 9),

    (K' K + ridge K_l + jitter rows I) W = K' (measured - arcs),

with K the kernels of rows and landmarks, K_l those of the landmarks. Width of the kernel, share of
the lags in its inputs and ridge are those of least error when whole runs, or long blocks of time,
are left out. The same errors validate the model and calibrate its interval:
each row is predicted by arcs and weights that its run took no part in.
"""

import copy
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.history import History
from surgisoft.surrogate.interval import ErrorInterval, calibrate, distance_across
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ArcChain, KernelArm, gaussian_kernel
from surgisoft.surrogate.prior_mean import arcs_of, fit_arcs
from surgisoft.surrogate.training import Data, dealt, measured_rows, rest_shape

TIMES_S = (0.1, 0.3, 1.0, 4.0)
"""Time constants of the low passes, s: about half a decade apart, from the lag of a short line to
the relaxation of a silicone wall. The error hardly depends on them."""
LANDMARKS = 400
"""Most landmarks. On two real arms 800 lowered the error by a few hundredths."""
WIDTHS = (0.5, 1.0, 2.0, 4.0)
"""Widths of the kernel that are tried, in half ranges of a chamber."""
LAG_SHARES = (0.5, 1.0)
"""Factors of the lags beside the actuation that are tried."""
RIDGES = (0.01, 0.1, 1.0, 10.0)
"""Ridges that are tried: variance of the noise over that of the function."""
JITTER = 1e-6
"""Ridge on each weight, as a share of the rows: landmarks may nearly coincide."""
MOST_ROWS = 6000
"""Largest number of rows that are fitted to, evenly thinned."""
FOLDS = 8
"""Most folds of groups; held-out rows are one fold more."""
FOLD_ITERATIONS = 40
"""Most iterations of the arcs without a fold, which start from those of all rows."""


@dataclass(frozen=True, eq=False)
class KernelFit:
    """A fitted model and its errors on rows that were left out."""

    model: ArmModel
    """The model, fitted to all rows."""
    held: Tensor
    """(S,) which of the rows below the other networks of a fit hold out."""
    predicted_mm: Tensor
    """(S, n, 3) key points of rows, each by a model that its group took no part in, mm."""
    measured_mm: Tensor
    """(S, n, 3) measured key points of these rows, mm; NaN where missing."""
    interval: ErrorInterval | None
    """Interval that these errors calibrate."""
    settings: str
    """Width, share of the lags and ridge that were chosen, for a person."""


def fit_kernel(
    data: Data,
    spec: ArmSpec,
    clock: bool,
    seed: int,
    progress: Callable[[int, int, float], None],
) -> KernelFit:
    """Fit arcs and kernel regression to the training rows of a fit, held-out ones included.

    clock: whether rows have times, without which there are no low passes; progress: called with
    trial, trials and least cross-validated loss in mm^2.
    """
    history = data.train
    seen = measured_rows(history)
    picked = seen.nonzero()[:, 0][:: max(1, -(-int(seen.sum()) // MOST_ROWS))]
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    points = history.rows(history.key_points)[picked]
    landmarks, times_s = min(LANDMARKS, len(picked)), TIMES_S if clock else ()
    network = KernelArm(low, high, spec.key_points, arcs_of(points), landmarks, times_s)
    model = ArmModel(spec, network, rest_mm=rest_shape(history))
    pressure, inputs = (x[picked] for x in _inputs(model, network, history))
    held = torch.zeros(len(picked), dtype=torch.bool)
    if data.held is not None:
        held = history.rows(data.held)[picked]
    generator = torch.Generator().manual_seed(seed)
    group = dealt(history)[picked]
    fold = _folds(group, held, generator)
    if len(fold.unique()) < 2:
        raise InputError(
            "key points in one run, or one block of time, only: kernel regression chooses its "
            "width by runs that are left out; record more, or fit --network haw_nn"
        )
    marks = torch.randperm(len(picked), generator=generator)[:landmarks]
    shares = LAG_SHARES if clock else LAG_SHARES[-1:]
    trials = list(itertools.product(WIDTHS, shares))
    network.prior.set_rest(model.rest_mm)
    fit_arcs(network.prior, pressure, points)
    without = _arcs_without(network.prior, pressure, points, fold)
    best: _Trial | None = None
    with torch.no_grad():
        for number, (width, share) in enumerate(trials, 1):
            weight = torch.full_like(inputs[0], share / width)
            weight[: spec.chambers] = 1.0 / width
            system = _System(inputs * weight, marks, fold, points, without)
            for ridge in RIDGES:
                left = system.left_out(ridge)
                loss = float((left - points).square().sum(-1).nanmean())
                if best is None or loss < best.loss:
                    text = f"width {width:g}, lags x {share:g}, ridge {ridge:g}"
                    best = _Trial(loss, weight, ridge, left, text)
            assert best is not None
            progress(number, len(trials), best.loss)
        assert best is not None
        x = inputs * best.weight
        network.input_weight.copy_(best.weight)
        network.places.copy_(x[marks])
        network.weight.copy_(_weights(x, marks, points - network.prior(pressure), best.ridge))
        left = (best.left_out_mm - points).norm(dim=-1)
        distance = distance_across(pressure, fold, torch.tensor(spec.span))
    interval = calibrate(left, distance, group, "cross-validation")
    return KernelFit(model, held, best.left_out_mm, points, interval, best.text)


@dataclass(frozen=True, eq=False)
class _Trial:
    """Settings and their cross-validated error."""

    loss: float
    """Mean squared distance over all rows, mm^2."""
    weight: Tensor
    """(F,) weights of the kernel's inputs."""
    ridge: float
    """Ridge."""
    left_out_mm: Tensor
    """(S, n, 3) prediction of each row by a model that its fold took no part in, mm."""
    text: str
    """The settings for a person."""


@torch.no_grad()
def _inputs(model: ArmModel, network: KernelArm, history: History) -> tuple[Tensor, Tensor]:
    """(S, m) chamber pressures, in the arm's unit, and (S, F) inputs of the kernel, unweighted."""
    pressure = model.chain.chambers(history.pressure)
    if not network.remembers:
        return history.rows(pressure), history.rows(network.inputs(pressure))
    start = model.chain.standing(model.first_pressure(history), signals=False)[0].memory
    lows = network.lows(pressure, history, next(iter(start.values())))
    return history.rows(pressure), history.rows(network.inputs(pressure, lows))


def _arcs_without(whole: ArcChain, pressure: Tensor, points: Tensor, fold: Tensor) -> list[Tensor]:
    """For each fold (S, n, 3) mm: key points in all rows by arcs that are fitted without it."""
    found = []
    for number in range(int(fold.max()) + 1):
        others, arcs = fold != number, copy.deepcopy(whole)
        fit_arcs(arcs, pressure[others], points[others], FOLD_ITERATIONS)
        with torch.no_grad():
            found.append(arcs(pressure))
    return found


class _System:
    """Normal equations without each fold, for each set of outputs measured in the same rows."""

    def __init__(
        self, x: Tensor, marks: Tensor, fold: Tensor, points: Tensor, without: list[Tensor]
    ):
        """Inputs x (S, F), landmarks at rows (L,), folds (S,), key points (S, n, 3) mm, and for
        each fold (S, n, 3) mm those of arcs without it."""
        self.kernel = gaussian_kernel(x, x[marks]).double()
        self.between, self.jitter = _held(x, marks, len(x))
        self.rows = [fold == number for number in range(len(without))]
        self.without = without
        self.parts = []
        for outputs, known in _alike(points):
            grams, sides = [], []
            for mine, arcs in zip(self.rows, without, strict=True):
                own, others = known & mine, known & ~mine
                target = (points - arcs).flatten(1)[others][:, outputs].double()
                grams.append(self.kernel[own].T @ self.kernel[own])
                sides.append(self.kernel[others].T @ target)
            self.parts.append((outputs, torch.stack(grams), torch.stack(sides)))

    def left_out(self, ridge: float) -> Tensor:
        """(S, n, 3) mm: key points of each row by arcs and weights without its fold."""
        found = self.without[0].clone()
        for mine, arcs in zip(self.rows, self.without, strict=True):
            found[mine] = arcs[mine]
        flat = found.flatten(1)
        for outputs, grams, sides in self.parts:
            others = grams.sum(0) - grams + ridge * self.between + self.jitter
            weights = torch.linalg.solve(others, sides)
            for mine, weight in zip(self.rows, weights, strict=True):
                rows = mine.nonzero()[:, 0]
                flat[rows[:, None], outputs] += (self.kernel[mine] @ weight).to(flat.dtype)
        return flat.view_as(found)


def _alike(points: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Outputs (O,) of key points (S, n, 3) that are measured in the same rows, and these (S,)."""
    found: dict[bytes, list[int]] = {}
    for output, missing in enumerate(points.flatten(1).isnan().unbind(1)):
        found.setdefault(missing.numpy().tobytes(), []).append(output)
    flat = points.flatten(1)
    return [(torch.tensor(some), ~flat[:, some[0]].isnan()) for some in found.values()]


def _held(x: Tensor, marks: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """(L, L) each: kernels of the landmarks, which the ridge is a factor of, and the jitter."""
    between = gaussian_kernel(x[marks], x[marks]).double()
    return between, JITTER * rows * torch.eye(len(marks), dtype=between.dtype)


def _weights(x: Tensor, marks: Tensor, target: Tensor, ridge: float) -> Tensor:
    """(L, 3n) weights for inputs x (S, F) and targets (S, n, 3) in mm of all rows."""
    kernel = gaussian_kernel(x, x[marks]).double()
    between, jitter = _held(x, marks, len(x))
    found = kernel.new_zeros(len(marks), target.flatten(1).shape[1])
    for outputs, known in _alike(target):
        some = kernel[known]
        side = some.T @ target.flatten(1)[known][:, outputs].double()
        found[:, outputs] = torch.linalg.solve(some.T @ some + ridge * between + jitter, side)
    return found


def _folds(group: Tensor, held: Tensor, generator: torch.Generator) -> Tensor:
    """(S,) fold of each row: the held-out rows are one, the other groups (S,) are dealt whole."""
    fold = torch.zeros_like(group)
    names, index = group[~held].unique(return_inverse=True)
    place = torch.empty_like(names)
    place[torch.randperm(len(names), generator=generator)] = torch.arange(len(names)) % FOLDS
    fold[~held] = place[index] + int(held.any())
    return fold
