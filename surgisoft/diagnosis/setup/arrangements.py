"""Arrangements of the actuation that are tried: permuted and flipped channels, and other units.

Up to three chambers every signed permutation is tried (48 of three). For more, the linear response
of the body to each channel is matched with the model's by assignment (Kuhn 1955, as scipy's
`linear_sum_assignment`), under frames that are turned and mirrored in steps; `improved` then swaps
and flips pairs of channels as long as that helps.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from surgisoft.diagnosis.setup.sample import Arrangement, Sample
from surgisoft.measurement.units import unit_mistakes
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.model import ArmModel

EXHAUSTIVE = 3
"""Most chambers of which every signed permutation is tried."""
BEYOND_RANGE = 1.6
"""An actuation in a wrong unit is looked for up to this multiple of the model's largest one."""
LEAST_SPAN = 0.03
"""Least range of an actuation in a wrong unit, once converted, as a share of the model's."""
PROBE_ROWS = 400
"""Rows of the made-up actuation that shows the model's linear response."""
MATCHED = 12
"""Arrangements that the assignment proposes for each unit, the best first."""
TURNS = 24
"""Steps of a turn about z in which frames are tried for the assignment."""


def mistaken(spec: ArmSpec, actuation: np.ndarray) -> dict[tuple[str, str], float]:
    """The `unit_mistakes` that may have been made with recorded actuation (N, m), by its range."""
    largest = max(np.abs(spec.low).max(), np.abs(spec.high).max())
    reach, span = np.abs(actuation).max(), np.ptp(actuation, axis=0).max()
    found = {}
    for mistake, factor in unit_mistakes(spec.unit).items():
        within = factor * reach <= BEYOND_RANGE * largest
        if within and factor * span >= LEAST_SPAN * max(spec.span):
            found[mistake] = factor
    return found


def every(chambers: int, factor: float = 1.0) -> list[Arrangement]:
    """Every signed permutation, the recorded one first, and each chamber that does not act."""
    return [
        Arrangement(order, sign, factor)
        for order in itertools.permutations(range(chambers))
        for sign in itertools.product((1.0, -1.0), repeat=chambers)
    ] + idle(chambers, factor)


def idle(chambers: int, factor: float = 1.0) -> list[Arrangement]:
    """For each chamber the arrangement in which it does not act; none for a single chamber."""
    if chambers == 1:
        return []
    order = tuple(range(chambers))
    return [
        Arrangement(order, tuple(0.0 if k == lost else 1.0 for k in order), factor)
        for lost in order
    ]


def proposed(
    sample: Sample, points: Sequence[tuple[int, ...]], factors: Sequence[float]
) -> list[Arrangement]:
    """The arrangements to begin with; points: orders of the key points to reckon with."""
    chambers = sample.history.chambers
    if chambers <= EXHAUSTIVE:
        return [a for factor in factors for a in every(chambers, factor)]
    order = tuple(range(chambers))
    found = []
    for factor in factors:
        found += [Arrangement(order, (1.0,) * chambers, factor), *idle(chambers, factor)]
        found += [
            Arrangement(order, tuple(-1.0 if k == at else 1.0 for k in order), factor)
            for at in order
        ]
    (measured, spread), predicted = _body_response(sample), _model_response(sample.model)
    scale = _scale(sample)
    for factor in factors:
        for way in points:
            likely = measured[:, list(way)] / (factor * scale)
            found += _matched(likely, spread * factor, predicted, factor)
    return list(dict.fromkeys(found))


def neighbours(arrangement: Arrangement) -> list[Arrangement]:
    """Arrangements that differ by one swap of two channels or the sign of one."""
    order, sign, found = arrangement.order, arrangement.sign, []
    for a, b in itertools.combinations(range(len(order)), 2):
        swapped, signs = list(order), list(sign)
        swapped[a], swapped[b] = order[b], order[a]
        found.append(Arrangement(tuple(swapped), sign, arrangement.factor))
        signs[a], signs[b] = sign[b], sign[a]
        if signs != list(sign):
            found.append(Arrangement(tuple(swapped), tuple(signs), arrangement.factor))
    for at in range(len(order)):
        flipped = tuple(-s if k == at else s for k, s in enumerate(sign))
        found.append(Arrangement(order, flipped, arrangement.factor))
    return found


def improved(
    start: Arrangement, error: Callable[[Sequence[Arrangement]], np.ndarray], steps: int = 4
) -> list[Arrangement]:
    """Steepest descent over swaps and flips from a start; every arrangement that was best once."""
    best, least, path = start, float(error([start])[0]), [start]
    for _ in range(steps):
        others = neighbours(best)
        errors = error(others)
        if errors.min() >= 0.98 * least:
            break
        best, least = others[int(errors.argmin())], float(errors.min())
        path.append(best)
    return path


def _body_response(sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """(m, n, 3) linear response of the recorded key points to each recorded channel, and the
    standard deviation (m,) of each channel."""
    actuation = sample.history.rows(sample.history.pressure).double().numpy()
    points = sample.measured()[0]
    response = np.zeros((actuation.shape[1], *points.shape[1:]))
    for k in range(points.shape[1]):
        seen = np.isfinite(points[:, k]).all(1)
        if seen.sum() > 3 * actuation.shape[1]:
            response[:, k] = _slope(actuation[seen], points[seen, k])
    return response, actuation.std(0)


def _scale(sample: Sample) -> float:
    """Recorded units in one mm, from the distances between neighbouring key points, or motion."""
    recorded, rest = sample.measured()[0], sample.model.rest_mm.double().cpu().numpy()
    links = np.linalg.norm(np.diff(recorded, axis=1), axis=2)
    seen = np.isfinite(links).any(axis=0)
    if seen.any():
        true = float(np.linalg.norm(np.diff(rest, axis=0), axis=1)[seen].sum())
        found = float(np.nanmedian(links[:, seen], axis=0).sum()) / max(true, 1e-12)
    else:
        plain = Arrangement.as_recorded(sample.history.chambers)
        found = float(np.nanstd(recorded) / max(sample.predicted([plain])[0].std(), 1e-12))
    return found if np.isfinite(found) and found > 0 else 1.0


def _model_response(model: ArmModel) -> np.ndarray:
    """(m, n, 3) linear response of the model to each chamber, on a slow random walk, mm a unit."""
    spec, rng = model.spec, np.random.default_rng(0)
    walk = rng.normal(size=(PROBE_ROWS + 40, spec.chambers))
    smooth = np.stack([np.convolve(c, np.hanning(24), "valid") for c in walk.T], 1)[:PROBE_ROWS]
    share = np.argsort(np.argsort(smooth, axis=0), axis=0) / max(len(smooth) - 1, 1)
    actuation = np.array(spec.low) + share * (np.array(spec.high) - np.array(spec.low))
    given = torch.from_numpy(actuation)
    points = torch.full((len(given), spec.key_points, 3), torch.nan)
    history = pack([torch.arange(len(given)).double()], [given], [points])
    with torch.no_grad():
        predicted = model.predict(history)[0].double().numpy()
    return _slope(actuation, predicted.reshape(len(actuation), -1)).reshape(
        spec.chambers, spec.key_points, 3
    )


def _slope(actuation: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(m, ...) slopes of the linear regression of points (S, ...) on actuation (S, m)."""
    centred = actuation - actuation.mean(0)
    spread = centred.std(0)
    scaled = centred / np.where(spread > 0, spread, 1.0)
    gram = scaled.T @ scaled + 1e-3 * len(scaled) * np.eye(scaled.shape[1])
    slope = np.linalg.solve(gram, scaled.T @ (points - points.mean(0)))
    return slope / np.where(spread > 0, spread, 1.0)[:, None]


def _matched(
    measured: np.ndarray, spread: np.ndarray, predicted: np.ndarray, factor: float
) -> list[Arrangement]:
    """The best assignments of responses (m, n, 3), mm a unit, under turned and mirrored frames.

    spread: (m,) standard deviation of each channel: what a channel hardly shows counts little.
    """
    turns = Rotation.from_euler("z", np.arange(TURNS)[:, None] * 2 * np.pi / TURNS).as_matrix()
    frames = np.concatenate([turns, Rotation.create_group("O").as_matrix()])
    frames = np.concatenate([frames, frames * np.array([1.0, -1.0, 1.0])])
    chambers = len(measured)
    flat, weight = measured.reshape(chambers, -1), spread**2
    size = np.square(predicted).sum((1, 2))
    found = []
    # Opposite chambers pull alike, to first order, once a sign is flipped: permutations without a
    # flip have a list of their own.
    for flips in (False, True):
        drawn: dict[Arrangement, float] = {}
        for frame in frames:
            likely = np.einsum("ij,mnj->mni", frame, predicted).reshape(chambers, -1)
            inner = likely @ flat.T
            cost = weight * (size[:, None] - 2 * (np.abs(inner) if flips else inner))
            rows, columns = linear_sum_assignment(cost)
            sign = np.where(flips & (inner[rows, columns] < 0), -1.0, 1.0)
            each = Arrangement(tuple(columns.tolist()), tuple(sign.tolist()), factor)
            drawn[each] = min(drawn.get(each, np.inf), float(cost[rows, columns].sum()))
        found += sorted(drawn, key=drawn.__getitem__)[:MATCHED]
    return found
