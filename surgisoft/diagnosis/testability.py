"""Which effects some recordings can show at all.

An effect that cannot show is no candidate: ranked, it could only fit noise. A diagnosis lists it
with the reason.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from surgisoft.diagnosis.candidates import Candidate
from surgisoft.diagnosis.criteria import SEARCH
from surgisoft.diagnosis.other_models import has_slope
from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.effects import FRONT, Effect, hypothesis_of, known_effects

Cause = Literal["no_motion", "no_reversals", "no_change", "below_noise", "no_slope"]
"""Steady-state samples only; no inner reversals of the actuation; no change of the prediction at
all; at the plausible end of its amplitudes less than what stands out from the noise; not known how
the model's predictions change with the actuation."""

REASONS = {
    "no_motion": "steady-state samples cannot show what ends when the arm stops; record "
    "it in motion",
    "no_reversals": "without inner reversals of the actuation its loops are a function of the "
    "actuation; record ramps that turn back at different levels",
    "no_change": "it changes nothing along this actuation, or needs a quantity that was not "
    "recorded",
    "no_slope": "it acts on the actuation, and the model's predictions are not a function of the "
    "actuation and its past that could be fitted to them; give the model as a callable",
    "below_noise": "even at the end of its plausible range it changes less than the noise shows",
}
"""The causes in words, with what to do."""
DETECTED = 3.0
"""Change, in standard errors of the mean noise of independent blocks, from which an effect stands
out from the noise."""
LARGER = tuple(2.0**power for power in range(11))
"""Multiples of the least amplitude that stands out at which plausibility is asked. The least one
may be below the plausible range, as a support that yields more than any real one; with a factor of
two between them no plausible range is skipped."""


@dataclass(frozen=True)
class NotTestable:
    """An effect that the recordings cannot show."""

    effect: str
    """Its name."""
    cause: Cause
    """Why."""
    reason: str
    """The cause in words."""


def testable(
    problem: Problem, some: Sequence[Candidate], names: Sequence[str]
) -> tuple[list[Candidate], tuple[NotTestable, ...]]:
    """(candidates that the recordings can show, effects among `names` that they cannot show)."""
    kept: list[Candidate] = []
    left_out = []
    kinds, static = known_effects(), _Static(problem)
    slope = has_slope(problem.model)
    for name in names:
        own = [one for one in some if one.name == name]
        own = [one for one in own if slope or one.effect.stage not in FRONT]
        cause = _cause(problem, kinds[name], own, static)
        if cause is None:
            kept += own
        else:
            left_out.append(NotTestable(name, cause, REASONS[cause]))
    return kept, tuple(left_out)


class _Static:
    """Cubics of a problem's actuation, made when they are first asked for."""

    def __init__(self, problem: Problem):
        self._problem = problem

    @cached_property
    def basis(self) -> np.ndarray:
        """(S, F), see `cubics`."""
        return cubics(self._problem.pressure)


def _cause(
    problem: Problem, kind: type[Effect], own: list[Candidate], static: _Static
) -> Cause | None:
    """Why an effect cannot show; None where it can."""
    hypothesis = hypothesis_of(kind)
    if not own and kind.stage in FRONT and not has_slope(problem.model):
        return "no_slope"
    if hypothesis.needs_motion and not problem.table.timed[problem.index.numpy()].any():
        return "no_motion"
    if not own:
        return "no_change"
    if hypothesis.needs_reversals and not any(_beyond_cubics(static.basis, each) for each in own):
        return "no_reversals"
    if not any(_stands_out(problem, each) for each in own):
        return "below_noise"
    return None


def _beyond_cubics(basis: np.ndarray, candidate: Candidate) -> bool:
    """Whether some sensitivity is more than a cubic of the actuation, basis as of `cubics`."""
    for column in np.moveaxis(candidate.sensitivities, 3, 0):
        part = column.reshape(len(column), -1)
        part = part - part.mean(axis=0)
        power = np.square(part).sum()
        if power > 0 and np.square(basis.T @ part).sum() < SEARCH.most_static * power:
            return True
    return False


def cubics(pressure: np.ndarray) -> np.ndarray:
    """(S, F) orthonormal basis of functions of the actuation (S, m), scaled to [-1, 1]: constant,
    linear, products of two chambers and third powers of each."""
    pairs = (pressure[:, :, None] * pressure[:, None, :])[:, *np.triu_indices(pressure.shape[1])]
    ones = np.ones((len(pressure), 1))
    return np.linalg.qr(np.hstack([ones, pressure, pairs, pressure**3]))[0]


def _stands_out(problem: Problem, candidate: Candidate) -> bool:
    """Whether a plausible amplitude gives a change that stands out from the noise."""
    if candidate.more:
        return True
    columns = np.square(candidate.sensitivities).sum(2).mean((0, 1))
    best = int(np.argmax(columns))
    least = DETECTED * problem.floor_mm / np.sqrt(max(len(problem.motion), 1))
    amplitudes = np.zeros(len(columns))
    for factor, sign in itertools.product(LARGER, (1.0, -1.0)):
        amplitudes[best] = sign * factor * least / np.sqrt(columns[best])
        effect = candidate.with_amplitudes(amplitudes)
        if effect is None or all(quantity.plausible for quantity in effect.quantities()):
            return True
    return False
