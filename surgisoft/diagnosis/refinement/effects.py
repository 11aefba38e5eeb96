"""Put named effects into a model, or fit those anew that it has, on a problem's rows."""

import copy
from dataclasses import dataclass

import torch

from surgisoft.diagnosis.criteria import CRITERIA
from surgisoft.diagnosis.refinement.intervals import Parameter, intervals
from surgisoft.diagnosis.refinement.large import refine_large
from surgisoft.diagnosis.refinement.refine import Fit, free_parameters, refine
from surgisoft.diagnosis.refinement.start import starts
from surgisoft.diagnosis.residuals import Problem
from surgisoft.errors import InputError
from surgisoft.surrogate.effects import Effect
from surgisoft.surrogate.model import ArmModel

LARGE = 24
"""Most free values of an effect that are all fitted; of more, the strengths are."""
FIRST_ITERATIONS = 4
"""Steps from each start before the best of them goes on."""
BISECTIONS = 20
"""Halvings in the search for the largest plausible strengths."""
ROUNDS = 2
"""Rounds in turns where effects with few and with many values are fitted together."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model with effects fitted to a problem."""

    model: ArmModel
    """A model of its own: nothing is shared with the one that it came from."""
    parameters: tuple[Parameter, ...]
    """What was fitted, in physical units with intervals."""
    refitted: tuple[str, ...]
    """Effects among them that the model had before."""


def fit_effects(problem: Problem, names: list[str]) -> Fitted:
    """Fit the named effects in a problem's model; one that it lacks is added first."""
    model = copy.deepcopy(problem.model)
    if model.remembers:
        raise InputError(
            "effects are for models with a static network; the recurrent baseline takes none"
        )
    names = list(dict.fromkeys(names))
    refitted = tuple(name for name in names if name in model.effects)
    for name in names:
        if name not in model.effects:
            model = _added(problem.with_model(model), name)
    large = [name for name in names if is_large(model.effects[name])]
    small = [name for name in names if name not in large]
    fits: dict[tuple[str, ...], Fit] = {}
    for _ in range(ROUNDS if (small and large) or len(large) > 1 else 1):
        for name in large:
            fits[name,] = refine_large(model, problem, name)
        if small:
            fits[tuple(small)] = refine(model, problem, small)
    parameters = []
    for keys, fit in fits.items():
        effects = {key: model.effects[key] for key in keys}
        free = free_parameters(model, keys)
        if len(keys) == 1 and keys[0] in large:
            free = {f"{keys[0]}.{k}": p for k, p in effects[keys[0]].strengths().items()}
        parameters += intervals(effects, free, fit, problem.block)
    order = {name: position for position, name in enumerate(names)}
    parameters.sort(key=lambda parameter: order[parameter.effect])
    return Fitted(model.eval().requires_grad_(False), tuple(parameters), refitted)


def fit_plausible(problem: Problem, fitted: Fitted, names: list[str], name: str) -> Fitted | None:
    """The fit again with the strengths of one effect at the plausible end, all else free.

    A network that was fitted without an effect has learned some of it, and what is left may then
    ask for more of the effect than there can be. Strengths are shrunk all together, no further
    than it takes. None where that does not make it plausible, or where nothing else is free.
    """
    model = copy.deepcopy(fitted.model)
    small = [each for each in dict.fromkeys(names) if not is_large(model.effects[each])]
    if name not in small or not free_parameters(model, small, held=name):
        return None
    if not shrink(model.effects[name]):
        return None
    fit = refine(model, problem.with_model(model), small, held=name)
    if not model.effects[name].plausible():
        return None
    effects = {key: model.effects[key] for key in small}
    free = free_parameters(model, small, held=name)
    found = intervals(effects, free, fit, problem.block)
    rest = [p for p in fitted.parameters if p.effect not in small]
    order = {each: position for position, each in enumerate(names)}
    parameters = sorted([*found, *rest], key=lambda parameter: order[parameter.effect])
    return Fitted(model.eval().requires_grad_(False), tuple(parameters), fitted.refitted)


@torch.no_grad()
def shrink(effect: Effect) -> bool:
    """Scale an effect's strengths by the largest factor that makes it plausible, if there is one.

    By bisection between nothing, of which a share must be plausible, and the present strengths.
    """
    strengths = {name: p.detach().clone() for name, p in effect.strengths().items()}

    def scale(factor: float) -> bool:
        for name, parameter in effect.strengths().items():
            parameter.copy_(factor * strengths[name])
        return effect.plausible()

    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if scale(middle) else (low, middle)
    return scale(low) and low > 0


def is_large(effect: Effect) -> bool:
    """Whether an effect has so many values that its strengths alone are fitted."""
    values = [*effect.strengths().values(), *effect.shapes().values()]
    return sum(p.numel() for p in values) > LARGE


def _added(problem: Problem, name: str) -> ArmModel:
    """The problem's model with one effect more, roughly fitted, from the best of a few starts.

    Of two that come to nearly the same, the simpler one is the best.
    """
    tried = []
    for model in starts(problem, name):
        effect = model.effects[name]
        if is_large(effect):
            misfit = refine_large(model, problem, name).misfit
        else:
            misfit = refine(model, problem, [name], FIRST_ITERATIONS).misfit
        values = sum(p.numel() for p in effect.strengths().values())
        tried.append((misfit * (1.0 + CRITERIA.selection.amplitude_price) ** values, model))
    return min(tried, key=lambda one: one[0])[1]
