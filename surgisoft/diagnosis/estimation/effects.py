"""Put named effects into a model, or fit those anew that it has, on a problem's rows."""

import copy
import itertools
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import nn

from surgisoft.diagnosis.candidates import Candidate, copied, model_candidates, with_effect
from surgisoft.diagnosis.criteria import SEARCH
from surgisoft.diagnosis.cross_validation import cross_validation_of
from surgisoft.diagnosis.estimation.intervals import (
    Parameter,
    intervals,
    p_value,
    with_covariance,
)
from surgisoft.diagnosis.estimation.least_squares import (
    Fit,
    fit_all,
    fit_amplitudes,
    free_parameters,
    repeated_scan,
    set_vector,
)
from surgisoft.diagnosis.estimation.network_error import NetworkError
from surgisoft.diagnosis.residuals import Problem
from surgisoft.errors import InputError
from surgisoft.surrogate.effects import STAGES, Effect, free_name
from surgisoft.surrogate.model import ArmModel

LARGE = 24
"""Most free values of an effect that are all fitted; of more, the amplitudes alone are."""
STARTS = 4
"""Starts of the fit of a new effect: time constants that share a motion have several optima."""
FIRST_ITERATIONS = 4
"""Steps from each start before the best of them goes on."""
BISECTIONS = 20
"""Halvings in the search for the largest plausible amplitudes."""
ROUNDS = 2
"""Rounds in turns where effects with few and with many values are fitted together."""
REFINING_ITERATIONS = 8
"""Most steps of a fit that refines a candidate."""
MOST_VALUES = 12
"""Most values of a candidate that is refined: the rows that score it are those it is fitted to."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model with effects fitted to a problem."""

    model: ArmModel
    """A model of its own: nothing is shared with the one that it came from."""
    parameters: tuple[Parameter, ...]
    """What was fitted, in physical units with intervals."""
    refitted: tuple[str, ...]
    """Effects among them that the model had before."""
    p_value: float | None = None
    """Probability of so large amplitudes of the new effects by noise and the network's own error
    alone; None where no effect is new, or one has so many values that a ridge holds them."""
    in_words: dict[str, str] = field(default_factory=dict)
    """What the parameters mean, by effect; empty where nothing is known."""
    keys: dict[str, str] = field(default_factory=dict)
    """Names in the model of effects that were added beside one of their kind: `creep#2` of
    `creep`."""

    def key(self, name: str) -> str:
        """Name in the model of an effect that was asked for."""
        return self.keys.get(name, name)


@dataclass(frozen=True, eq=False)
class _Ended:
    """Named effects that were fitted to the end, before their intervals are computed."""

    model: ArmModel
    names: list[str]
    refitted: tuple[str, ...]
    large: list[str]
    """Effects whose amplitudes alone were fitted."""
    fits: dict[tuple[str, ...], Fit]
    """The last fit of each set of effects that were fitted together."""
    others: list[Fit]
    """Fits of the only effect from other starts, where it is new and of the same form."""
    keys: dict[str, str]
    """As `Fitted.keys`."""

    def free(self, keys: tuple[str, ...]) -> dict[str, nn.Parameter]:
        """What was fitted of effects that were fitted together."""
        if len(keys) == 1 and keys[0] in self.large:
            amplitudes = self.model.effects[keys[0]].amplitudes()
            return {f"{keys[0]}.{name}": p for name, p in amplitudes.items()}
        return free_parameters(self.model, keys)


def fit_effects(problem: Problem, names: list[str], more: Sequence[str] = ()) -> Fitted:
    """Fit the named effects in a problem's model; one that it lacks is added first.

    more: names among them of effects that the model may have. One that it has and of which it can
    have several is not fitted again where one more of its kind leaves less.
    """
    ended = _ended(problem, names, more=more)
    model, large, refitted = ended.model, ended.large, ended.refitted
    parameters, chance, network = [], None, NetworkError.of(problem)
    words: dict[str, str] = {}
    for keys, fit in ended.fits.items():
        effects = {key: model.effects[key] for key in keys}
        known, *ends = (with_covariance(each, problem, network) for each in (fit, *ended.others))
        found = intervals(effects, ended.free(keys), known, ends, problem.covered_s)
        parameters += found.parameters
        words |= found.in_words
        new = _are_new_amplitudes(model, keys, refitted)
        if not large and new.any():
            chance = p_value(known, new)
    order = {name: position for position, name in enumerate(ended.names)}
    parameters.sort(key=lambda parameter: order[parameter.effect])
    words = {name: words[name] for name in ended.names}
    model = model.eval().requires_grad_(False)
    return Fitted(model, tuple(parameters), refitted, chance, words, ended.keys)


def fitted_model(problem: Problem, names: list[str]) -> ArmModel:
    """The model of `fit_effects` alone; without intervals it takes half the time."""
    ended = _ended(problem, names, slopes_at_end=False)
    for keys, fit in ended.fits.items():
        set_vector(ended.free(keys), fit.values)
    return ended.model.eval().requires_grad_(False)


def _ended(
    problem: Problem, names: list[str], slopes_at_end: bool = True, more: Sequence[str] = ()
) -> _Ended:
    """The fits of `fit_effects`; slopes_at_end: as of `fit_all`."""
    model = copy.deepcopy(problem.model)
    if not model.takes_effects:
        raise InputError(
            "effects are for models with a static network; the recurrent baseline takes none"
        )
    names = list(dict.fromkeys(names))
    had = [name for name in names if name in model.effects]
    others: list[Fit] = []
    keys: dict[str, str] = {}
    for position, name in enumerate(names):
        if name not in model.effects:
            former = [keys.get(each, each) for each in names[:position]]
            beside = [each for each in former if not is_large(model.effects[each])]
            model, *rest = _added(problem.with_model(model), name, beside)
            if len(names) == 1 and rest:
                model, others = _best_end(problem, name, [model, *rest], slopes_at_end)
        elif name in more:
            further = _one_more(problem.with_model(model), name)
            if further is not None:
                keys[name] = free_name(name, model.effects)
                model = further
    refitted = tuple(name for name in had if name not in keys)
    names = [keys.get(name, name) for name in names]
    large = [name for name in names if is_large(model.effects[name])]
    small = [name for name in names if name not in large]
    fits: dict[tuple[str, ...], Fit] = {}
    for _ in range(ROUNDS if (small and large) or len(large) > 1 else 1):
        for name in large:
            fits[name,] = fit_amplitudes(model, problem, name)
        if small:
            fits[tuple(small)] = fit_all(model, problem, small, slopes_at_end=slopes_at_end)
    return _Ended(model, names, refitted, large, fits, others, keys)


def _one_more(problem: Problem, name: str) -> ArmModel | None:
    """The problem's model with one more effect of a kind that it has, roughly fitted; None where
    that leaves no less than the present one, fitted anew, or where there can be one only."""
    tried = model_candidates(problem, [name])
    if all(each.more for each in tried):  # no further form, or none that these recordings show
        return None
    anew = copy.deepcopy(problem.model)
    present = _rough(anew, problem, [name])
    best = _added(problem, name)[0]
    effect = best.effects[free_name(name, problem.model.effects)]
    left = _rough(best, problem, [free_name(name, problem.model.effects)])
    return best if left * _price(effect) < present else None


def _rough(model: ArmModel, problem: Problem, names: list[str]) -> float:
    """Misfit after the first steps of a fit of effects of a model, the last of which decides."""
    if is_large(model.effects[names[-1]]):
        return fit_amplitudes(model, problem, names[-1]).misfit
    return fit_all(model, problem, names, FIRST_ITERATIONS, slopes_at_end=False).misfit


def _price(effect: Effect) -> float:
    """What a misfit is multiplied by for the amplitudes of an effect."""
    values = sum(p.numel() for p in effect.amplitudes().values())
    return float((1.0 + SEARCH.amplitude_price) ** values)


def _best_end(
    problem: Problem, name: str, models: list[ArmModel], slopes_at_end: bool
) -> tuple[ArmModel, list[Fit]]:
    """The model in which a new effect fits best when fitted to the end, and the fits of the others.

    models: from several starts. Fits whose values have another meaning (another form of the effect)
    are left out of the others.
    """
    fits = [fit_all(each, problem, [name], slopes_at_end=slopes_at_end) for each in models]
    prices = [(1.0 + SEARCH.amplitude_price) ** _values(m.effects[name]) for m in models]
    best = int(np.argmin([fit.misfit * price for fit, price in zip(fits, prices, strict=True)]))
    form = models[best].effects[name].config()
    alike = [i for i, each in enumerate(models) if each.effects[name].config() == form]
    return models[best], [fits[i] for i in alike if i != best]


def _are_new_amplitudes(
    model: ArmModel, keys: tuple[str, ...], refitted: tuple[str, ...]
) -> np.ndarray:
    """(P,) bool: which free values are amplitudes of effects that the model lacked before."""
    kinds: list[bool] = []
    for key in keys:
        effect = model.effects[key]
        for new, values in (
            (key not in refitted, effect.amplitudes()),
            (False, effect.nonlinear_parameters()),
        ):
            kinds += [new] * sum(p.numel() for p in values.values())
    return np.array(kinds, bool)


def fit_plausible(problem: Problem, fitted: Fitted, names: list[str], name: str) -> Fitted | None:
    """The fit again with the amplitudes of one effect at the plausible end, all else free.

    A network that was fitted without an effect has learned some of it, and the residual may then
    ask for more of the effect than there can be. The amplitudes are shrunk by one factor, no
    further than it takes. None where that does not make the effect plausible, or where nothing
    else is free.
    """
    model = copy.deepcopy(fitted.model)
    small = [each for each in dict.fromkeys(names) if not is_large(model.effects[each])]
    if name not in small or not free_parameters(model, small, held=name):
        return None
    if not shrink(model.effects[name]):
        return None
    fit = fit_all(model, problem.with_model(model), small, held=name)
    if not model.effects[name].plausible():
        return None
    effects = {key: model.effects[key] for key in small}
    free = free_parameters(model, small, held=name)
    known = with_covariance(fit, problem, NetworkError.of(problem))
    found = intervals(effects, free, known, seconds=problem.covered_s)
    rest = [p for p in fitted.parameters if p.effect not in small]
    order = {each: position for position, each in enumerate(names)}
    parameters = sorted([*found.parameters, *rest], key=lambda parameter: order[parameter.effect])
    return replace(
        fitted,
        model=model.eval().requires_grad_(False),
        parameters=tuple(parameters),
        in_words=fitted.in_words | found.in_words,
    )


@torch.no_grad()
def shrink(effect: Effect) -> bool:
    """Scale an effect's amplitudes by the largest factor that makes it plausible, if there is one.

    By bisection between 0 and the present amplitudes; returns whether such a factor was found.
    """
    amplitudes = {name: p.detach().clone() for name, p in effect.amplitudes().items()}

    def scale(factor: float) -> bool:
        for name, parameter in effect.amplitudes().items():
            parameter.copy_(factor * amplitudes[name])
        return effect.plausible()

    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if scale(middle) else (low, middle)
    return scale(low) and low > 0


def is_large(effect: Effect) -> bool:
    """Whether an effect has so many values that its amplitudes alone are fitted."""
    return _values(effect) > LARGE


def _added(problem: Problem, name: str, beside: Sequence[str] = ()) -> list[ArmModel]:
    """The problem's model with one effect more, roughly fitted from a few starts, the best first.

    Of two that come to nearly the same, the simpler one is the best.

    beside: effects of the model that are fitted with it. Fitted alone before, they have taken over
    some of what the new one does, and a form of it that does something else would then seem best.
    """
    key, tried = free_name(name, problem.model.effects), []
    for model in starts(problem, name, STARTS, every_form=True):
        misfit = _rough(model, problem, [*beside, key])
        tried.append((misfit * _price(model.effects[key]), model))
    models = [model for _, model in sorted(tried, key=lambda one: one[0])]
    return models[:1] if is_large(models[0].effects[key]) else models


def starts(
    problem: Problem,
    name: str,
    number: int = 2,
    every_form: bool = False,
    stages: Container[str] = STAGES,
) -> list[ArmModel]:
    """Models with the named effect in its best few candidates, amplitudes fitted; parts are copies.

    Where the model has one, it is one more of its kind (`free_name`).

    The candidates are ranked by the error that each leaves on held-out blocks beside the model
    discrepancy; of two that leave nearly the same, the simpler one comes first.

    every_form: whether the best candidate of each other form (`Effect.config`) is a start, too;
    stages: those at which the effect may act: a form of the body acts behind the network.
    """
    every = [each for each in model_candidates(problem, [name]) if not each.more]
    tried = [each for each in every if each.effect.stage in stages]
    if every and not tried:
        raise InputError(
            f"on these recordings '{name}' changes something only in forms that act behind the "
            "network, and these are not trained together with it; pass --refit never"
        )
    if not tried:
        raise InputError(
            f"effect '{name}' changes nothing on these recordings, so nothing of it can be fitted; "
            "record motion that it would show in"
        )
    ends = np.cumsum([0] + [candidate.sensitivities.shape[-1] for candidate in tried])
    sensitivities = np.concatenate([candidate.sensitivities for candidate in tried], axis=-1)
    validation = cross_validation_of(problem, sensitivities)
    picks = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    before = validation.losses().sum()
    gains = [np.log(before / validation.losses(pick).sum()) for pick in picks]
    selection = SEARCH
    scores = [selection.priced(gain, len(pick)) for gain, pick in zip(gains, picks, strict=True)]
    order = [int(place) for place in np.argsort(scores)[::-1]]
    chosen, forms = order[:number], [tried[place].effect.config() for place in order]
    if every_form:
        chosen += [p for at, p in enumerate(order) if at >= number and forms[at] not in forms[:at]]
    models = []
    for best in chosen:
        effect = copy.deepcopy(tried[best].effect)
        amplitudes = torch.from_numpy(validation.amplitudes(picks[best])).float()
        begin = 0
        with torch.no_grad():
            for amplitude in effect.amplitudes().values():
                end = begin + amplitude.numel()
                amplitude.copy_(amplitudes[begin:end].view_as(amplitude))
                begin = end
        models.append(with_effect(copy.deepcopy(problem.model), name, effect))
    return models


@dataclass(frozen=True, eq=False)
class Refined(Candidate):
    """An effect whose nonlinear parameters were fitted; one column, at its fitted amplitudes."""

    @property
    def amplitudes(self) -> int:
        """Number of amplitudes that were fitted, of which the column is the sum."""
        return sum(parameter.numel() for parameter in self.effect.amplitudes().values())

    @torch.no_grad()
    def with_amplitudes(self, amplitudes: np.ndarray) -> Effect:
        """The effect at a multiple (1,) of its fitted amplitudes."""
        effect = copied(self.effect)
        for parameter in effect.amplitudes().values():
            parameter.mul_(float(amplitudes[0]))
        return effect


def refined(problem: Problem, effects: Iterable[tuple[str, Effect]]) -> list[Candidate]:
    """Named effects with nonlinear parameters that are fitted instead of taken from a grid.

    Candidates come from a coarse grid and are compared to first order in their amplitudes. Between
    effects that then explain about as much, the grid decides: a lag whose time constant lies
    between two of the grid loses to a viscosity whose values fit well. So each of the competing
    effects is fitted through the whole chain, from where it stands, and the change that it then
    makes in the prediction is one more candidate. Effects that change nothing or that
    `with_fitted` does not fit are left out.
    """
    with torch.no_grad():
        before = repeated_scan(problem.model, problem, [])().double().numpy()
    found: list[Candidate] = []
    for name, effect in effects:
        model = with_fitted(problem, name, effect)
        if model is None:
            continue
        with torch.no_grad():
            after = repeated_scan(model, problem, [name])().double().numpy()
        column = (after - before)[..., None]
        if np.isfinite(column).all() and np.abs(column).max() > 1e-6:
            fitted = model.effects[name].requires_grad_(False)
            found.append(Refined(name, fitted, column, fitted=True))
    return found


def with_fitted(problem: Problem, name: str, effect: Effect) -> ArmModel | None:
    """A problem's model with one effect more, fitted from where it stands to the problem.

    None for an effect that the model has already, for one with more than MOST_VALUES values, and
    where the fit ends at implausible values and cannot be held: half a lag twice as long is nearly
    the same lag, so amplitudes beyond their range are held at its end while the nonlinear
    parameters go on.
    """
    if name in problem.model.effects or _values(effect) > MOST_VALUES:
        return None
    model = with_effect(copy.deepcopy(problem.model), name, copy.deepcopy(effect))
    fit_all(model, problem, [name], REFINING_ITERATIONS, slopes_at_end=False)
    effect = model.effects[name]
    if not effect.plausible() and effect.nonlinear_parameters() and shrink(effect):
        fit_all(model, problem, [name], REFINING_ITERATIONS, held=name, slopes_at_end=False)
    return model if effect.plausible() else None


def _values(effect: Effect) -> int:
    """How many numbers a fit of the effect chooses."""
    free = [*effect.amplitudes().values(), *effect.nonlinear_parameters().values()]
    return sum(p.numel() for p in free)
