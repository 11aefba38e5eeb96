"""Parts of the validation uncertainty: what noise, inputs, parameters and time steps may do.

Each is a standard uncertainty, as RMS distance of each key point over the rows that were measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from surgisoft.credibility.context import Uncertainty
from surgisoft.credibility.metrics import ValidationUncertainty
from surgisoft.diagnosis.residuals import ResidualTable
from surgisoft.errors import InputError
from surgisoft.measurement.histories import actuation_noise, history_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.callables.predicted import PredictedNetwork
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawEnsemble, HawNN

TWO_GRIDS = 3.0
"""Factor of safety on the difference of two grids, which is then an expanded uncertainty (grid
convergence index of order 1 at a refinement of 2: Roache 1994)."""
RIDGE = 1e-6
"""Share of the mean power of a feature that is added to each in the covariance of the last layer,
so that features that the training rows never used do not divide by zero."""


@dataclass(frozen=True)
class Budget:
    """Validation uncertainty of every key point, and where each part is known from."""

    per_key_point: tuple[ValidationUncertainty, ...]
    """Base to tip."""
    body: ValidationUncertainty
    """Over all key points: root of the mean square."""
    sources: dict[str, str]
    """Part -> where it is known from, in words."""
    inputs: tuple[float, ...]
    """Standard uncertainty of each actuation channel, in its unit."""


def budget(table: ResidualTable, recordings: Sequence[Recording], stated: Uncertainty) -> Budget:
    """The validation uncertainty of a comparison; stated: what the user knows, which counts."""
    model, count = table.model, table.measured_mm.shape[1]
    seen = np.isfinite(table.measured_mm).all(2)
    sources: dict[str, str] = {}
    noise: np.ndarray | None
    if stated.noise_mm is not None:
        noise, sources["noise"] = np.full(count, np.sqrt(3.0) * stated.noise_mm), "stated"
    else:
        noise, sources["noise"] = table.noise_mm, table.floor.source
        if table.floor.rmse_mm is None:
            noise = None
    inputs, sources["input"] = input_uncertainty(model, recordings, stated)
    shifted = shifts(model, recordings, inputs)
    moved = None if shifted is None else _rms(shifted, seen)
    if moved is None:
        sources["input"] = "not known: predictions from a file cannot be computed at other inputs"
    spread, sources["parameters"] = parameter_spread(table, stated)
    spread = None if spread is None else _rms(spread, seen)
    steps = refined_difference(model, recordings, table)
    sources["numerical"] = "steps of time halved"
    if steps is None:
        sources["numerical"] = "not known: predictions from a file have no steps"
    fine = None if steps is None else TWO_GRIDS / 2.0 * _rms(steps, seen)

    def of(values: np.ndarray | None, k: int) -> float | None:
        return None if values is None or not np.isfinite(values[k]) else float(values[k])

    parts = (noise, moved, spread, fine)
    return Budget(
        per_key_point=tuple(
            ValidationUncertainty(*(of(part, k) for part in parts)) for k in range(count)
        ),
        body=ValidationUncertainty(*(_over_body(part) for part in parts)),
        sources=sources,
        inputs=tuple(float(value) for value in inputs),
    )


def _over_body(values: np.ndarray | None) -> float | None:
    if values is None or not np.isfinite(values).any():
        return None
    return float(np.sqrt(np.nanmean(np.square(values))))


def _rms(change_mm: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(n,) RMS distance of changes (..., N, n, 3) over seen rows (N, n); leading axes are added."""
    square = np.square(change_mm).sum(-1).reshape(-1, *seen.shape).sum(0)
    counts = seen.sum(0)
    with np.errstate(invalid="ignore"):
        return np.where(counts > 0, np.sqrt((square * seen).sum(0) / counts), np.nan)


def input_uncertainty(
    model: ArmModel, recordings: Sequence[Recording], stated: Uncertainty
) -> tuple[np.ndarray, str]:
    """(m,) standard uncertainty of each channel in its unit, and where it is known from."""
    chambers = model.spec.chambers
    if stated.input:
        if len(stated.input) not in (1, chambers):
            raise InputError(
                f"uncertainty.input has {len(stated.input)} values, expected one for all or one "
                f"for each of {chambers} channels"
            )
        return np.broadcast_to(np.array(stated.input, float), (chambers,)).copy(), "stated"
    noise = [actuation_noise(recording, model.spec.actuation) for recording in recordings]
    if model.spec.actuation == "commanded":
        return np.zeros(chambers), "commands, taken as exact"
    return np.max(noise, axis=0), "scatter at rest; an offset of the sensors is not in it"


@torch.no_grad()
def shifts(
    model: ArmModel, recordings: Sequence[Recording], inputs: np.ndarray
) -> np.ndarray | None:
    """(m, N, n, 3) mm: half the change of the prediction between each input raised and lowered.

    Each channel in turn is off by its standard uncertainty in all rows alike (sensitivity
    coefficients by central differences, V&V 20-2009). None for predictions from a file.
    """
    if isinstance(model.network, PredictedNetwork):
        return None
    history = history_of(list(recordings), model.spec.actuation)
    found = []
    for channel, size in enumerate(inputs):
        ends = []
        for sign in (1.0, -1.0):
            step = torch.zeros(model.spec.chambers)
            step[channel] = sign * float(size)
            stood = None if history.stood is None else history.stood + step
            moved = replace(history, pressure=history.pressure + step, stood=stood)
            ends.append(history.rows(model.predict(moved)).double().numpy())
        found.append((ends[0] - ends[1]) / 2.0)
    return np.stack(found)


@torch.no_grad()
def parameter_spread(table: ResidualTable, stated: Uncertainty) -> tuple[np.ndarray | None, str]:
    """(1, N, n, 3) mm standard uncertainty by the model's parameters, and its source.

    Of an ensemble the standard deviation of its members (Lakshminarayanan et al. 2017). Of a single
    network, to first order in its last layer: with features h and training residuals of variance
    s^2, s^2 h' (H'H)^-1 h (linear regression). What is not known is None.
    """
    model, shape = table.model, table.predicted_mm.shape
    if stated.parameters_mm is not None:
        each = stated.parameters_mm / np.sqrt(3.0)
        return np.full((1, *shape), each), "stated"
    network = model.network
    trace = model.trace(table.history)
    inputs = [table.history.rows(x) for x in (trace.behind["material"], trace.direction)]
    if isinstance(network, HawEnsemble):
        spread = network.each(*inputs).double().std(0).numpy()
        return spread[None], f"spread of {network.members} networks of the ensemble"
    known = model.training_residuals
    if isinstance(network, HawNN) and known is not None:
        base, here = (_features(network, *each) for each in (_training(known), inputs))
        gram = base.T @ base
        gram += RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
        leverage = np.einsum("sf,fs->s", here, np.linalg.solve(gram, here.T))
        variance = np.nanvar(known.residual_mm.double().numpy(), axis=0)
        spread = np.sqrt(np.maximum(leverage, 0.0))[:, None, None] * np.sqrt(variance)
        return spread[None], "last layer of the network, from its training residuals"
    return None, "not known: the model does not say how well its parameters are known"


def _training(known) -> tuple[torch.Tensor, torch.Tensor]:
    return known.actuation.float(), known.direction.float()


def _features(network: HawNN, actuation: torch.Tensor, direction: torch.Tensor) -> np.ndarray:
    """(S, H + 1) activations before the last layer, and 1."""
    x = (actuation - network.get_buffer("centre")) / network.get_buffer("half_range")
    if network.directions:
        x = torch.cat([x, direction * network.get_buffer("use")], dim=-1)
    hidden = network.layers[:-1](x).double().numpy()
    return np.concatenate([hidden, np.ones((len(hidden), 1))], axis=1)


@torch.no_grad()
def refined_difference(
    model: ArmModel, recordings: Sequence[Recording], table: ResidualTable
) -> np.ndarray | None:
    """(1, N, n, 3) mm: change of the prediction where all steps of time are halved.

    The actuation is linear between two rows. Steady-state samples have no steps and change nothing.
    None for predictions from a file.
    """
    if isinstance(model.network, PredictedNetwork):
        return None
    finer, kept = [], []
    for recording in recordings:
        fine, own = with_midpoints(recording)
        finer.append(fine)
        kept.append(own)
    history = history_of(finer, model.spec.actuation)
    points = history.rows(model.predict(history)).double().numpy()[np.concatenate(kept)]
    return (points - table.predicted_mm)[None]


def with_midpoints(recording: Recording) -> tuple[Recording, np.ndarray]:
    """A continuous recording with a row between each two of a run, and which rows are its own."""
    if recording.kind != "continuous":
        return recording, np.full(recording.samples, True)
    place = np.zeros(recording.samples)
    begin = 0.0
    for run in recording.runs:
        count = run.stop - run.start
        place[run] = begin + 2.0 * np.arange(count)
        begin += 2.0 * count - 1.0
    every = np.arange(int(begin))
    own = np.isin(every, place.astype(int))
    before = np.searchsorted(place, every, side="right") - 1

    def between(values: np.ndarray | None) -> np.ndarray | None:
        if values is None:
            return None
        after = np.minimum(before + 1, len(values) - 1)
        middle = (values[before] + values[after]) / 2.0
        mask = own.reshape(-1, *[1] * (values.ndim - 1))
        return np.where(mask, values[before], middle)

    measured, t_s = between(recording.measured), between(recording.t_s)
    assert measured is not None
    assert t_s is not None
    points = np.full((len(every), *recording.key_points_mm.shape[1:]), np.nan)
    points[own] = recording.key_points_mm
    assert recording.run is not None
    fine = replace(
        recording,
        t_s=t_s,
        measured=measured,
        commanded=between(recording.commanded),
        run=recording.run[before],
        temp_C=between(recording.temp_C),
        payload_g=between(recording.payload_g),
        key_points_mm=points,
    )
    return fine, own
