"""Fit of a `KernelArm`: arcs first, then kernel regression of what they leave, by cross-validation.

The weights W of the landmarks are those of kernel ridge regression (Williams & Seeger 2001, eq. 9),

    (K' K + ridge K_l + jitter rows I) W = K' (measured - arcs),

with K the kernels of rows and landmarks, K_l those of the landmarks. Width of the kernel, share of
the lags in the inputs and ridge are those of least error when whole runs, or long blocks of time,
are left out. The same errors validate the model and calibrate its interval: each row is predicted
by weights that its run took no part in. The arcs, which have few parameters, are fitted once.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.history import History
from surgisoft.surrogate.interval import ErrorInterval, calibrate, distance_across
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import KernelArm, gaussian_kernel
from surgisoft.surrogate.prior_mean import arcs_of, fit_prior_mean
from surgisoft.surrogate.training import Data, dealt, measured_rows, rest_shape

TIMES_S = (0.1, 0.3, 1.0, 4.0)
"""Time constants of the low passes, s: about half a decade apart, from the lag of a short line to
the relaxation of a silicone wall. The error hardly depends on them."""
LANDMARKS = 400
"""Most landmarks. On two real arms 800 lowered the error by less than a hundredth."""
LAG_FIRMNESS = 10.0
"""Factor on the ridges of the arcs' bends and stretches by the lags: what a wall's lag adds is
about a third of what the actuation itself does."""
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


@dataclass(frozen=True, eq=False)
class KernelFit:
    """A fitted model and its errors on rows that were left out."""

    model: ArmModel
    """The model, fitted to all rows."""
    held: Tensor
    """(S,) which of the rows below the other networks of a fit hold out."""
    predicted_mm: Tensor
    """(S, n, 3) key points of rows, each by weights that its group took no part in, mm."""
    measured_mm: Tensor
    """(S, n, 3) measured key points of these rows, mm; NaN where missing."""
    interval: ErrorInterval | None
    """Interval that these errors calibrate."""
    settings: str
    """Width, share of the lags and ridge that were chosen, for a person."""


@torch.no_grad()
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
    model, network = _before(data, spec, TIMES_S if clock else ())
    seen = measured_rows(history)
    step = max(1, -(-int(seen.sum()) // MOST_ROWS))
    picked = seen.nonzero()[:, 0][::step]
    rows = _Rows.of(model, network, history, picked)
    held = torch.zeros(len(picked), dtype=torch.bool)
    if data.held is not None:
        held = history.rows(data.held)[picked]
    generator = torch.Generator().manual_seed(seed)
    group = dealt(history)[picked]
    fold = _folds(group, held, generator)
    marks = torch.randperm(len(picked), generator=generator)[: network.landmarks]
    best: tuple[float, Tensor, float, str] | None = None
    best_left = rows.target
    shares = LAG_SHARES if clock else LAG_SHARES[-1:]
    trials = list(itertools.product(WIDTHS, shares))
    for number, (width, share) in enumerate(trials, 1):
        weight = torch.full_like(rows.inputs[0], share / width)
        weight[: spec.chambers] = 1.0 / width
        system = _System.of(rows.inputs * weight, marks, rows.target, fold)
        for ridge in RIDGES:
            left = system.left_out(ridge)
            loss = float((left - rows.target).square().nansum(-1).mean())
            if best is None or loss < best[0]:
                text = f"width {width:g}, lags x {share:g}, ridge {ridge:g}"
                best, best_left = (loss, weight, ridge, text), left
        assert best is not None
        progress(number, len(trials), best[0] / spec.key_points)
    assert best is not None
    _, weight, ridge, settings = best
    final = _System.of(rows.inputs * weight, marks, rows.target, fold)
    network.input_weight.copy_(weight)
    network.places.copy_(final.places)
    network.weight.copy_(final.weights(ridge))
    left = (best_left - rows.target).unflatten(1, (spec.key_points, 3)).float()
    distance = distance_across(rows.pressure, fold, torch.tensor(spec.span))
    interval = calibrate(left.norm(dim=-1), distance, group, "cross-validation")
    measured = history.rows(history.key_points)[picked]
    return KernelFit(model, held, measured + left, measured, interval, settings)


def _before(data: Data, spec: ArmSpec, times_s: tuple[float, ...]) -> tuple[ArmModel, KernelArm]:
    """A model whose arcs are fitted and whose weights are zero, and its network."""
    history = data.train
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    arcs = arcs_of(history.rows(history.key_points))
    landmarks = min(LANDMARKS, int(measured_rows(history).sum()))
    network = KernelArm(low, high, spec.key_points, arcs, landmarks, times_s)
    rest = rest_shape(history)
    model = ArmModel(spec, network, rest_mm=rest)
    wide = replace(history, pressure=_inputs(model, network, history))
    firmness = torch.full((wide.chambers,), LAG_FIRMNESS)
    firmness[: spec.chambers] = 1.0
    with torch.enable_grad():
        fit_prior_mean(network.prior, wide, rest, firmness)
    return model, network


def _inputs(model: ArmModel, network: KernelArm, history: History) -> Tensor:
    """(R, T, F) inputs of arcs and kernel along a history, before weights, in the arm's unit."""
    actuation = model.chain.chambers(history.pressure)
    if not network.remembers:
        return actuation
    start = model.chain.standing(model.first_pressure(history), signals=False)[0].memory
    return network.inputs(actuation, network.lows(actuation, history, next(iter(start.values()))))


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows to fit to, in double precision."""

    pressure: Tensor
    """(S, m) actuation, in the arm's unit."""
    inputs: Tensor
    """(S, F) inputs of the kernel in half ranges, before their weights."""
    target: Tensor
    """(S, 3n) measured key points less those of the arcs, mm; NaN where missing."""

    @classmethod
    def of(cls, model: ArmModel, network: KernelArm, history: History, picked: Tensor) -> "_Rows":
        """The rows of a history with an index (S,) among those without padding."""
        inputs = history.rows(_inputs(model, network, history))[picked]
        pressure = inputs[:, : history.chambers]
        target = history.rows(history.key_points)[picked] - network.prior(inputs)
        return cls(pressure, network.scaled(inputs).double(), target.flatten(1).double())


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of each fold, for each set of outputs that are measured in the same rows."""

    kernel: Tensor
    """(S, L) kernels of rows and landmarks."""
    places: Tensor
    """(L, F) landmarks."""
    fold: Tensor
    """(S,) fold of each row."""
    parts: list[tuple[Tensor, Tensor, Tensor]]
    """Outputs (O,), K' K of each fold (G, L, L), and K' y of each fold (G, L, O)."""

    @classmethod
    def of(cls, x: Tensor, marks: Tensor, target: Tensor, fold: Tensor) -> "_System":
        """The system of inputs x (S, F), landmarks at rows (L,), targets (S, 3n), folds (S,)."""
        places = x[marks]
        kernel = gaussian_kernel(x, places)
        alike: dict[bytes, list[int]] = {}
        for output, missing in enumerate(target.isnan().unbind(1)):
            alike.setdefault(missing.numpy().tobytes(), []).append(output)
        parts = []
        for outputs in alike.values():
            known = ~target[:, outputs[0]].isnan()
            some = [known & (fold == number) for number in range(int(fold.max()) + 1)]
            grams = torch.stack([kernel[rows].T @ kernel[rows] for rows in some])
            sides = torch.stack([kernel[rows].T @ target[rows][:, outputs] for rows in some])
            parts.append((torch.tensor(outputs), grams, sides))
        return cls(kernel, places, fold, parts)

    def _held(self, ridge: float) -> Tensor:
        """(L, L) what the ridge and the jitter add."""
        between = gaussian_kernel(self.places, self.places)
        jitter = JITTER * len(self.kernel) * torch.eye(len(between), dtype=between.dtype)
        return ridge * between + jitter

    def left_out(self, ridge: float) -> Tensor:
        """(S, 3n) prediction of each row by weights that its fold took no part in."""
        held, found = self._held(ridge), self.kernel.new_zeros(len(self.fold), self._outputs)
        for outputs, grams, sides in self.parts:
            others = grams.sum(0) - grams + held
            weights = torch.linalg.solve(others, sides.sum(0) - sides)
            for number, weight in enumerate(weights):
                rows = (self.fold == number).nonzero()[:, 0]
                found[rows[:, None], outputs] = self.kernel[rows] @ weight
        return found

    def weights(self, ridge: float) -> Tensor:
        """(L, 3n) weights of all rows."""
        found = self.kernel.new_zeros(len(self.places), self._outputs)
        for outputs, grams, sides in self.parts:
            solved = torch.linalg.solve(grams.sum(0) + self._held(ridge), sides.sum(0))
            found[:, outputs] = solved
        return found

    @property
    def _outputs(self) -> int:
        return sum(len(outputs) for outputs, _, _ in self.parts)


def _folds(group: Tensor, held: Tensor, generator: torch.Generator) -> Tensor:
    """(S,) fold of each row: the held-out rows are one, the other groups (S,) are dealt whole."""
    fold = torch.zeros_like(group)
    names, index = group[~held].unique(return_inverse=True)
    place = torch.empty_like(names)
    place[torch.randperm(len(names), generator=generator)] = torch.arange(len(names)) % FOLDS
    fold[~held] = place[index] + int(held.any())
    return fold
