"""Rivals on a model, and what the recordings so far say about them."""

import copy
import itertools
from dataclasses import dataclass, replace

import numpy as np
import torch

from surgisoft.diagnosis.candidates import facts_of
from surgisoft.diagnosis.estimation.effects import with_fitted
from surgisoft.diagnosis.isolability.designs import (
    PERIOD_S,
    Design,
    Shape,
    columns_on,
    reference_design,
    shapes_of,
)
from surgisoft.diagnosis.isolability.matrix import (
    MISFIT,
    Draws,
    Isolability,
    Sizes,
    judge,
    moments_of,
    uncertainty_of,
)
from surgisoft.diagnosis.isolability.moments import Moments, Uncertainty, sample_time, unimitated
from surgisoft.diagnosis.problem import Problem
from surgisoft.errors import InputError
from surgisoft.surrogate.model import ArmModel

CLEAR = 3.0
"""Log evidence in the recordings, nats, from which on an effect's strengths are taken from them."""
KNOWN_ROWS = 800
"""Rows of the recordings so far whose columns are computed."""
MOST_SHAPES = 10
"""Shapes of an effect that are looked at: those that fit best, or some of every kind."""
WEAKEST = 0.2
"""Least size of the rivals, as a share of the plausible one, that an experiment is planned for."""


@dataclass(frozen=True, eq=False)
class Question:
    """Rivals on a model, and what the recordings so far say about them."""

    model: ArmModel
    """The model in question."""
    shapes: list[Shape]
    """The rivals' shapes."""
    owners: list[str]
    """The rival of each shape."""
    spans: list[np.ndarray]
    """Indices of the columns of each shape, with that of the own weight, which is open to all."""
    draws: Draws
    """Strengths that may be true."""
    uncertainty: Uncertainty
    """What signals must stand out from."""
    known: Moments | None
    """Moments of the recordings so far; the last column is the own weight."""
    gains: np.ndarray | None
    """(J,) log evidence of each shape in the recordings, nats."""
    misfit: np.ndarray | float
    """(E, E) misfit of the rivals; larger where the recordings contradict the prediction."""

    def judged(self, moments: Moments) -> Isolability:
        """What moments of columns and own weight say about the rivals."""
        return judge(moments, self.draws, self.owners, self.spans, self.misfit)


def pose_question(
    model: ArmModel, problem: Problem | None, rivals: list[str] | None = None
) -> Question:
    """The rivals, with strengths from the recordings where those show them.

    Default: every known effect that changes anything on this arm.
    """
    reference = reference_design(model)
    facts = None if problem is None else facts_of(problem)
    shapes = shapes_of(model, reference, rivals, facts)
    if problem is None:
        shapes = _some_of_each(shapes)
    sizes = Sizes.of(reference, columns_on(reference, shapes), shapes)
    missing = [name for name in rivals or [] if name not in {shape.name for shape in sizes.shapes}]
    if missing:
        raise InputError(
            f"effect '{missing[0]}' changes nothing on this arm: it has no rival; leave it out"
        )
    known = gains = noise = None
    misfit, dt = MISFIT, PERIOD_S / 2
    draws = sizes.draws()
    if problem is None:
        uncertainty = uncertainty_of(model, noise, sizes.profile_mm, dt)
    else:
        dt, noise = sample_time(problem.history), problem.noise_mm
        design, residual = _thinned(problem)
        columns = columns_on(design, sizes.shapes)
        uncertainty = uncertainty_of(model, noise, sizes.profile_mm, dt)
        gram = _with(residual, design, columns, uncertainty).gram()
        fitted, gains = _fitted(gram, sizes)
        sharp = _sharp(problem, sizes, fitted, gains) if rivals else []
        if sharp:
            sizes = Sizes.of(reference, columns_on(reference, shapes + sharp), shapes + sharp)
            columns += columns_on(design, sizes.shapes[len(columns) :])
            gram = _with(residual, design, columns, uncertainty).gram()
            fitted, gains = _fitted(gram, sizes)
        best = int(np.argmax(gains))
        rms = float(np.sqrt(3.0 * np.mean((columns[best] @ fitted[best]) ** 2)))
        # Once more with the size that was found, and the shapes that matter.
        kept = _best_of_each(sizes, gains)
        sizes, columns = sizes.select(kept), [columns[j] for j in kept]
        scale = max(WEAKEST, rms / sizes.plausible_mm)
        uncertainty = uncertainty_of(model, noise, scale * sizes.profile_mm, dt)
        known = _with(residual, design, columns, uncertainty)
        gram = known.gram()
        fitted, gains = _fitted(gram, sizes)
        misfit = _misfit(gram, sizes, fitted, gains)
        draws = _likely(sizes.limited(sizes.draws(), columns), sizes, fitted, gains)
        known = _without_last(known)
    draws = Draws(np.pad(draws.strengths, ((0, 1), (0, 0))), draws.shape)
    weight = np.array([sizes.columns])
    return Question(
        model,
        sizes.shapes,
        owners_of(sizes),
        [np.concatenate([span, weight]) for span in sizes.spans],
        draws,
        uncertainty,
        known,
        gains,
        misfit,
    )


def owners_of(sizes: Sizes) -> list[str]:
    """The effect of each shape."""
    return [shape.name for shape in sizes.shapes]


def _some_of_each(shapes: list[Shape]) -> list[Shape]:
    """At most MOST_SHAPES of each effect, evenly from first to last."""
    answer = []
    for name in dict.fromkeys(shape.name for shape in shapes):
        mine = [shape for shape in shapes if shape.name == name]
        places = np.linspace(0, len(mine) - 1, min(len(mine), MOST_SHAPES))
        answer += [mine[k] for k in np.unique(places.round().astype(int))]
    return answer


def _best_of_each(sizes: Sizes, gains: np.ndarray) -> list[int]:
    """Indices of the MOST_SHAPES shapes of each effect that fit best, in order."""
    owners = owners_of(sizes)
    kept: list[int] = []
    for name in dict.fromkeys(owners):
        mine = [j for j, owner in enumerate(owners) if owner == name]
        kept += sorted(mine, key=lambda j: -gains[j])[:MOST_SHAPES]
    return sorted(kept)


def _with(residual, design: Design, columns, uncertainty: Uncertainty) -> Moments:
    """Moments of the columns, with the residual (S, n, 3) as the last one."""
    return moments_of(design, [*columns, residual[..., None]], uncertainty)


def _thinned(problem: Problem) -> tuple[Design, np.ndarray]:
    """A problem's rows as a design, and their residual (S, n, 3) in mm, all key points seen."""
    residual = problem.residual
    known = np.isfinite(residual).all(2)
    often = known.mean(0) >= 0.5
    residual = np.where(often[None, :, None], residual, 0.0)
    whole = np.flatnonzero((known | ~often).all(1))
    rows = whole[:: max(1, round(len(whole) / KNOWN_ROWS))]
    history = problem.history
    seconds = float(history.dt_s.sum()) + sample_time(history) * history.runs
    design = Design(
        problem.model,
        history,
        problem.index[torch.from_numpy(rows)],
        problem.pressure[rows],
        problem.direction[rows],
        seconds,
    )
    return design, residual[rows]


def _sharp(problem: Problem, sizes: Sizes, fitted: list[np.ndarray], gains) -> list[Shape]:
    """Each rival's best shape fitted through the whole chain to the recordings, where it can be."""
    owners, answer = owners_of(sizes), []
    for name in dict.fromkeys(owners):
        mine = [j for j, owner in enumerate(owners) if owner == name and not sizes.shapes[j].more]
        best = max(mine, key=lambda j: gains[j], default=None)
        if best is None or gains[best] < CLEAR:
            continue
        effect, first = copy.deepcopy(sizes.shapes[best].effect), 0
        for parameter in effect.amplitudes().values():
            part = torch.from_numpy(fitted[best][first : first + parameter.numel()])
            parameter.data.copy_(part.view_as(parameter))
            first += parameter.numel()
        model = with_fitted(problem, name, effect)
        if model is not None:
            found = model.effects[name].requires_grad_(False)
            answer.append(Shape(name, found, fitted=True))
    return answer


def _spread(sizes: Sizes) -> np.ndarray:
    """(K,) plausible spread of each strength."""
    answer = np.empty(sizes.columns)
    for span, gram in zip(sizes.spans, sizes.gram_mm2, strict=True):
        unit = np.sqrt(np.maximum(np.diag(gram), 1e-30))
        answer[span] = 2.0 * sizes.plausible_mm / unit
    return answer


def _fitted(gram: np.ndarray, sizes: Sizes) -> tuple[list[np.ndarray], np.ndarray]:
    """Strengths of each shape that explain the last column best, and their log evidence (J,)."""
    strengths, gains, spread = [], [], _spread(sizes)
    for span in sizes.spans:
        scaled = gram[np.ix_(span, span)] * spread[span][:, None] * spread[span][None]
        pull = gram[span, -1] * spread[span]
        inner = np.eye(len(span)) + scaled
        amplitude = np.linalg.solve(inner, pull)
        strengths.append(amplitude * spread[span])
        gains.append(0.5 * pull @ amplitude - 0.5 * np.linalg.slogdet(inner)[1])
    return strengths, np.array(gains)


def _likely(draws: Draws, sizes: Sizes, fitted, gains) -> Draws:
    """Each rival's best-fitting shape with its strengths where it is clear, else plausible ones."""
    strengths, shape, owners = [], [], owners_of(sizes)
    for name in dict.fromkeys(owners):
        mine = [j for j, owner in enumerate(owners) if owner == name]
        best = max(mine, key=lambda j: gains[j])
        if gains[best] >= CLEAR:
            full = np.zeros(len(draws.strengths))
            full[sizes.spans[best]] = fitted[best]
            strengths.append(full[:, None])
            shape.append([best])
        else:
            picked = np.isin(draws.shape, mine)
            strengths.append(draws.strengths[:, picked])
            shape.append(draws.shape[picked])
    return Draws(np.concatenate(strengths, axis=1), np.concatenate(shape).astype(int))


def _misfit(gram: np.ndarray, sizes: Sizes, fitted, gains) -> np.ndarray:
    """(E, E) misfit that the recordings show: how far two rivals' fits differ from the prediction.

    With the better fitting rival true, its signal s and what the other cannot imitate u of it, the
    other should leave |u|^2 + 2 u e more, with e the misfit of the better one.
    """
    owner = np.array(owners_of(sizes))
    names = list(dict.fromkeys(owner))
    best = [max(np.flatnonzero(owner == n), key=lambda j: gains[j]) for n in names]
    signals = np.zeros((len(gram), len(names) + 1))
    signals[-1, -1] = 1.0
    for k, j in enumerate(best):
        signals[sizes.spans[j], k] = fitted[j]
    left = unimitated(gram, signals, sizes.spans)
    least = np.stack([left[owner == n].min(axis=0) for n in names])
    answer = np.full((len(names), len(names)), MISFIT)
    for a, b in itertools.permutations(range(len(names)), 2):
        if gains[best[a]] >= max(gains[best[b]], CLEAR) and least[b, a] > 0:
            whole = signals[:, a] @ gram @ signals[:, a]
            gap = least[b, -1] - least[a, -1] - least[b, a]
            error = min(gap, 0.0) ** 2 / (4.0 * least[b, a] * whole)
            answer[a, b] = answer[b, a] = max(MISFIT, error)
    return answer


def _without_last(moments: Moments) -> Moments:
    """The last column made that of the own weight, which does nothing on this bench."""
    plain, cross = moments.plain.copy(), moments.cross.copy()
    plain[:, -1], plain[:, :, -1], cross[..., -1] = 0.0, 0.0, 0.0
    return replace(moments, plain=plain, cross=cross)
