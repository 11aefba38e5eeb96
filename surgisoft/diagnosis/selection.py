"""Model selection: which effects explain what the model leaves, alone and together.

Every effect is scored by the held-out error that remains with it, the model discrepancy always
fitted beside it (`cross_validation`). Forward selection then names effects one by one: an effect
must be beyond chance for the whole family of effects and large enough (`SelectionCriteria`), give
way to one that does better beside the others, and still explain its share beside the relaxed forms
of those before it.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from surgisoft.diagnosis.black_box import BlackBox, black_box
from surgisoft.diagnosis.candidates import Candidate
from surgisoft.diagnosis.criteria import CRITERIA
from surgisoft.diagnosis.cross_validation import CrossValidation, split_of
from surgisoft.diagnosis.discrepancy import SIZES, Prior
from surgisoft.diagnosis.estimation.effects import refined
from surgisoft.diagnosis.residuals import Problem
from surgisoft.diagnosis.statistics import (
    block_interval,
    block_sums,
    sign_flip_p_values,
    win_shares,
)
from surgisoft.surrogate.effects import Effect, Quantity, hypothesis_of

ASKED = CRITERIA.selection


@dataclass(frozen=True, eq=False)
class Option:
    """One form of an effect: one of its candidates, or several of them side by side."""

    effect: str
    """The effect's name."""
    chosen: tuple[int, ...]
    """Its sensitivities."""
    candidate: int | None
    """Number of the candidate; None: several of them."""


@dataclass(frozen=True, eq=False)
class Score:
    """How one effect does on top of a base."""

    effect: str
    """Its name."""
    option: Option
    """Its form that explains most."""
    losses: np.ndarray
    """(B,) held-out sum of squared distances by block, mm^2."""
    log_gain: np.ndarray
    """(B,) log of the base's error over this one's, by block, the noise added to both."""
    p_value: float
    """Family-wise p-value: chance of so large a gain in any of the effects without a cause."""
    gain: float
    """Share of the base's squared error above the floor that goes."""

    @property
    def score(self) -> float:
        """Mean log gain less the price of its amplitudes: what effects are ranked by."""
        return ASKED.priced(self.log_gain.mean(), len(self.option.chosen))


def chosen_by(scores: Sequence[Score]) -> tuple[int, ...]:
    """The sensitivities of effects, one after another."""
    return sum((score.option.chosen for score in scores), ())


def _near(quantity: Quantity) -> bool:
    """Whether a first estimate may turn out plausible: right in sign, at most twice too large."""
    factor = ASKED.plausible_factor
    low = quantity.low * (factor if quantity.low < 0 else 1 / factor) - 0.01 * abs(quantity.high)
    high = quantity.high * (factor if quantity.high > 0 else 1 / factor)
    return bool(np.all((np.ravel(quantity.value) >= low) & (np.ravel(quantity.value) <= high)))


def _options_of(
    candidates: Sequence[Candidate], number: int = 0, first: int = 0
) -> Iterator[Option]:
    """One option for each candidate, numbered and indexed from the given numbers on."""
    for candidate in candidates:
        end = first + candidate.sensitivities.shape[3]
        yield Option(candidate.name, tuple(range(first, end)), number)
        number, first = number + 1, end


@dataclass(frozen=True, eq=False)
class ModelSelection:
    """All candidates of a problem and their held-out errors."""

    problem: Problem
    candidates: list[Candidate]
    validation: CrossValidation
    options: dict[str, list[Option]]
    """Forms of each effect."""
    sensitivities: np.ndarray
    """(S, n, 3, K) all sensitivities, mm."""
    floor: np.ndarray
    """(B,) sum of squared noise in each block, mm^2."""
    fitted: dict = field(default_factory=dict)
    """Effects at their amplitudes by candidate and base."""

    @classmethod
    def of(cls, problem: Problem, candidates: list[Candidate]) -> "ModelSelection":
        """Prepare the selection; afterwards every set of effects is cheap to try."""
        sensitivities = np.concatenate(
            [np.zeros((*problem.residual.shape, 0)), *(c.sensitivities for c in candidates)], axis=3
        )
        validation = CrossValidation.on(split_of(problem), sensitivities)
        options: dict[str, list[Option]] = {}
        for option in _options_of(candidates):
            options.setdefault(option.effect, []).append(option)
        for name, choices in options.items():
            # Beside more of an effect that the model has, one further candidate is enough.
            own = any(candidates[option.candidate].more for option in choices)
            members = [candidates[option.candidate].effect for option in choices]
            for some in [] if own else hypothesis_of(members[0]).combinations(members):
                if len(some) > 1:
                    choices.append(Option(name, sum((choices[i].chosen for i in some), ()), None))
        noise = float(np.mean(problem.noise_mm**2))
        return cls(
            problem, candidates, validation, options, sensitivities, validation.counts * noise
        )

    def extended(self, more: list[Candidate]) -> "ModelSelection":
        """The selection with further candidates of its effects; known results are kept."""
        if not more:
            return self
        sensitivities = np.concatenate([c.sensitivities for c in more], axis=3)
        options = {name: list(choices) for name, choices in self.options.items()}
        for option in _options_of(more, len(self.candidates), self.sensitivities.shape[3]):
            options.setdefault(option.effect, []).append(option)
        return replace(
            self,
            candidates=[*self.candidates, *more],
            validation=self.validation.extended(sensitivities),
            options=options,
            sensitivities=np.concatenate([self.sensitivities, sensitivities], axis=3),
            fitted=dict(self.fitted),
        )

    def losses(self, chosen: tuple[int, ...] = ()) -> np.ndarray:
        """(B,) held-out sum of squared distances, mm^2, with the chosen sensitivities."""
        return self.validation.losses(chosen)

    def rmse_mm(self, losses: np.ndarray) -> float:
        """RMS distance of a key point, mm."""
        return float(np.sqrt(losses.sum() / self.validation.counts.sum()))

    def excess(self, losses: np.ndarray) -> float:
        """Squared error above the noise floor, mm^2."""
        return float(max(losses.sum() - self.floor.sum(), 0.02 * losses.sum(), 1e-30))

    def size(self, losses: np.ndarray) -> float:
        """Error that is left above the noise floor, in units of the model discrepancy (of what the
        right effect may leave, `Problem.tolerance_mm`)."""
        seen = np.isfinite(self.problem.residual).all(2).sum(0)
        return float(np.sqrt(self.excess(losses) / (seen @ np.square(self.problem.tolerance_mm))))

    @property
    def whole_size(self) -> float:
        """Size of the model's error as it is; below 1 the model is as good as its validation."""
        return self.size(np.nansum(np.square(self.problem.residual), axis=(1, 2)))

    def in_fit(self, effect: str) -> bool:
        """Whether the model was fitted with an effect and is off by no more than it was then.

        The validated error holds what was wrong with the effect's parameters from the beginning.
        """
        return effect in self.problem.model.effects and self.whole_size < 1.0

    def log_ratio(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(B,) log of errors before over after; the floor keeps blocks without motion from
        outweighing the others."""
        return np.log((before + self.floor) / (after + self.floor))

    def scores(self, base: tuple[int, ...] = (), without: tuple[str, ...] = ()):
        """Every effect on top of a base, the best first."""
        before = self.losses(base)
        choices = [w for name, some in self.options.items() if name not in without for w in some]
        after = [self.losses(base + option.chosen) for option in choices]
        if not choices:
            return []
        gains = np.array([self.log_ratio(before, losses) for losses in after])
        chances = sign_flip_p_values(
            self.problem.by_motion(gains), [option.effect for option in choices]
        )
        best: dict[str, Score] = {}
        scores = [
            ASKED.priced(g.mean(), len(w.chosen)) for g, w in zip(gains, choices, strict=True)
        ]
        for i in np.argsort(-np.array(scores), kind="stable"):
            option, losses = choices[i], after[i]
            if option.effect not in best and self.plausible(option, base):
                gain = (before.sum() - losses.sum()) / self.excess(before)
                best[option.effect] = Score(
                    option.effect, option, losses, gains[i], chances[i], gain
                )
        return sorted(best.values(), key=lambda score: -score.score)

    def plausible(self, option: Option, base: tuple[int, ...] = ()) -> bool:
        """Whether an effect's parameters lie in their ranges as the selection leaves them.

        Several candidates side by side are as plausible as the best of them. One that only inner
        reversals show must explain more than a function of the actuation does: on ramps that all
        begin at rest, loops can be summed to any such function.
        """
        effect = self.in_place(self.single(option, base), base)
        if effect is not None and not all(_near(quantity) for quantity in effect.quantities()):
            return False
        some = self.candidates[self.options[option.effect][0].candidate].effect
        return (
            not hypothesis_of(some).needs_reversals
            or self._static_share(option, base) <= ASKED.most_static
        )

    def _static_share(self, option: Option, base: tuple[int, ...]) -> float:
        """Share of what an effect explains that is a cubic of the actuation."""
        amplitudes = self.validation.amplitudes(base + option.chosen)[len(base) :]
        part = (self.sensitivities[..., list(option.chosen)] @ amplitudes).reshape(
            len(self.sensitivities), -1
        )
        part = part - part.mean(axis=0)
        known = self._cubics.T @ part
        return float(np.square(known).sum() / max(np.square(part).sum(), 1e-30))

    @cached_property
    def _cubics(self) -> np.ndarray:
        """(S, F) orthonormal basis of the cubics of the actuation."""
        x = self.problem.pressure
        pairs = (x[:, :, None] * x[:, None, :])[:, *np.triu_indices(x.shape[1])]
        return np.linalg.qr(np.hstack([np.ones((len(x), 1)), x, pairs, x**3]))[0]

    def freest(self, score: Score) -> tuple[int, ...]:
        """An effect's sensitivities; beside a fitted one those of the grid that do best with it."""
        own = score.option.chosen
        one = score.option.candidate
        if one is None or not self.candidates[one].fitted:
            return own
        choices = [w for w in self.options[score.effect] if w.candidate != one]
        return min((own + w.chosen for w in choices), key=lambda p: float(self.losses(p).sum()))

    def single(self, option: Option, base: tuple[int, ...] = ()) -> Option:
        """The option itself, or the best of the candidates that stand side by side in it."""
        if option.candidate is not None:
            return option
        own = set(option.chosen)
        choices = self.options[option.effect]
        singles = [w for w in choices if w.candidate is not None and own.issuperset(w.chosen)]
        return min(singles, key=lambda w: float(self.losses(base + w.chosen).sum()))

    def in_place(self, option: Option, base: tuple[int, ...] = ()) -> Effect | None:
        """A single candidate's effect at the amplitudes that it is given beside a base."""
        key = (option.candidate, base)
        if key not in self.fitted:
            amplitudes = self.validation.amplitudes(base + option.chosen)[len(base) :]
            self.fitted[key] = self.candidates[option.candidate].with_amplitudes(amplitudes)
        return self.fitted[key]

    def starts(self, scores: Sequence[Score]) -> list[tuple[str, Effect]]:
        """Effects, by name, in their best single candidate at their amplitudes: starts of a fit."""
        found = [(s.effect, self.in_place(self.single(s.option))) for s in scores]
        return [(name, effect) for name, effect in found if effect is not None]

    def unique_gains(self, scores: list[Score]) -> dict[str, float]:
        """Share of the squared error above the floor that only this effect explains.

        What comes back when it is left out of the best forms of all effects together.
        """
        together = {s.effect: s.option.chosen for s in scores}
        total = self.excess(self.losses())
        everything = self.losses(sum(together.values(), ()))
        answer = {}
        for name in together:
            rest = sum((chosen for other, chosen in together.items() if other != name), ())
            answer[name] = float((self.losses(rest).sum() - everything.sum()) / total)
        return answer

    def parameters(self, score: Score) -> dict:
        """Name with unit -> value, of an effect in its best single candidate."""
        single = [option for option in self.options[score.effect] if option.candidate is not None]
        option = max(
            single,
            key=lambda w: float(self.log_ratio(self.losses(), self.losses(w.chosen)).mean()),
        )
        effect = self.in_place(option)
        return {} if effect is None else {q.name: q.value for q in effect.quantities()}


# Relaxed forms ------------------------------------------------------------------------------

Scaled = Callable[[ModelSelection, np.ndarray], np.ndarray]
"""(S, n, 3, K) sensitivities of what an effect explains (S, n, 3), each scaled by something."""


@dataclass(frozen=True, eq=False)
class RelaxedFit:
    """How much more the named effects explain with relaxed forms: a lack-of-fit test.

    No effect of a real arm has exactly its model's form, and what that leaves looks like a further,
    smaller effect. In the relaxed form, what an effect explains may be scaled by any first-order
    function of the chambers' pressures, of their directions and of the place along the body, or by
    another amplitude in every part of the time. Where the relaxed forms explain much more, the
    named effects only mimic what is missing. (The discrepancy term of Kennedy & O'Hagan 2001, here
    for the form of an effect.)
    """

    losses: np.ndarray
    """(B,) held-out sum of squared distances by block, mm^2."""
    share: float
    """Share of the error above the floor that goes besides."""
    log_gain: float
    """Mean fall of a block's log error."""
    p_value: float
    """Chance of such a fall without a cause."""

    @property
    def worth(self) -> float:
        """Share that goes times the mean fall of the log error; 0 where either rises."""
        return max(self.share, 0.0) * max(self.log_gain, 0.0)

    @property
    def wrong(self) -> bool:
        """Whether the forms are not those of what is missing."""
        return (self.worth >= ASKED.relaxed_worth or self.share >= ASKED.relaxed_share) and (
            self.p_value <= ASKED.relaxed_p_value
        )


def relaxed_fit(selection: ModelSelection, choices: Sequence[Sequence[Score]]) -> RelaxedFit:
    """What the best of several sets of effects explains more in its relaxed form.

    choices: sets of effects that explain the error about as well; one set where nothing competes.
    """
    tried = []
    for named, scaled in itertools.product(choices, (_by_state, _by_time)):
        sensitivities = _relaxed_sensitivities(selection, named, scaled)
        validation = CrossValidation.on(selection.validation.split, sensitivities)
        tried.append(validation.losses(range(sensitivities.shape[3])))
    best = min(tried, key=np.sum)
    beyond = [_beyond(selection, chosen_by(named), best) for named in choices]
    return min(beyond, key=lambda one: one.worth)


def _beyond(selection: ModelSelection, chosen: tuple[int, ...], after: np.ndarray) -> RelaxedFit:
    before = selection.losses(chosen)
    log_gain, chance = _fall(selection, before, after)
    share = (before.sum() - after.sum()) / selection.excess(selection.losses())
    return RelaxedFit(after, float(share), float(log_gain.mean()), chance)


def _fall(
    selection: ModelSelection, before: np.ndarray, after: np.ndarray
) -> tuple[np.ndarray, float]:
    """(B,) fall of each block's log error, and the chance of such a fall without a cause."""
    log_gain = selection.log_ratio(before, after)
    gain = selection.problem.by_motion(log_gain[None])
    return log_gain, float(sign_flip_p_values(gain)[0]) if log_gain.any() else 1.0


def beside_relaxed(
    selection: ModelSelection, named: list[Score], further: Score
) -> tuple[float, Score]:
    """(loss of the named effects' relaxed forms in mm^2, a further effect's score beside them).

    The chance counts this one effect alone: the others have been corrected for before.
    """
    chosen = further.option.chosen
    sensitivities = [
        _relaxed_sensitivities(selection, named, _by_state),
        selection.sensitivities[..., list(chosen)],
    ]
    together = np.concatenate(sensitivities, axis=3)
    validation, total = CrossValidation.on(selection.validation.split, together), together.shape[3]
    before, after = (validation.losses(range(n)) for n in (total - len(chosen), total))
    log_gain, chance = _fall(selection, before, after)
    gain = float((before.sum() - after.sum()) / selection.excess(before))
    answer = Score(further.effect, further.option, after, log_gain, chance, gain)
    return float(before.sum()), answer


def _relaxed_sensitivities(
    selection: ModelSelection, named: Sequence[Score], scaled: Scaled
) -> np.ndarray:
    """(S, n, 3, K) the named effects' sensitivities, and what each of them explains, scaled."""
    choices = [selection.freest(score) for score in named]
    base = sum(choices, ())
    amplitudes = selection.validation.amplitudes(base)
    sensitivities, first = [selection.sensitivities[..., list(base)]], 0
    for chosen in choices:
        part = selection.sensitivities[..., list(chosen)] @ amplitudes[first : first + len(chosen)]
        sensitivities.append(scaled(selection, part))
        first += len(chosen)
    return np.concatenate(sensitivities, axis=3)


def _by_state(selection: ModelSelection, part: np.ndarray) -> np.ndarray:
    """(S, n, 3, 2 m + 1) what an effect explains (S, n, 3), scaled."""
    points = part.shape[1]
    along = np.linspace(-1.0, 1.0, points) if points > 1 else np.zeros(1)
    rows = np.concatenate([selection.problem.pressure, selection.problem.direction], axis=1)
    scaled = part[..., None] * rows[:, None, None, :]
    return np.concatenate([scaled, (part * along[:, None])[..., None]], axis=3)


def _by_time(selection: ModelSelection, part: np.ndarray) -> np.ndarray:
    """(S, n, 3, spans - 1) what an effect explains, in each part of the time but the first."""
    spans = ASKED.relaxed_spans
    span = spans * np.arange(len(part)) // len(part)
    return part[..., None] * (span[:, None] == np.arange(1, spans))[:, None, None, :]


# Forward selection --------------------------------------------------------------------------


def select_effects(
    selection: ModelSelection, first: list[Score]
) -> tuple[list[Score], list[Score]]:
    """(the effects that passed, in order, each on top of those before; the others beside them).

    Forward selection takes the single effect that explains most, which beside a second one may be
    the wrong one: after every step each named effect gives way to the one that does best beside the
    others (stepwise exchange: Miller 2002, "Subset selection in regression", sec. 3.5), and to
    nothing where the others explain its share.
    """
    named: list[Score] = []
    following = first
    seen: dict[frozenset[str], list[Score]] = {}
    while following and len(named) < ASKED.most_effects:
        passed = next((s for s in following if _joins(selection, first, named, s)), None)
        if passed is None:
            break
        named = _without_idle(selection, first, exchanged(selection, [*named, passed]))
        names = frozenset(s.effect for s in named)
        # Exchanges may lead back to where they came from: of such a circle the best is taken.
        again = names in seen
        if again:
            circle = list(seen.values())[list(seen).index(names) :]
            named = min(circle, key=lambda some: float(selection.losses(chosen_by(some)).sum()))
        seen[names] = named
        following = selection.scores(chosen_by(named), tuple(s.effect for s in named))
        if again:
            break
    return named, following


def _joins(selection: ModelSelection, first: list[Score], named: list[Score], s: Score) -> bool:
    """Whether one effect on top of the named ones is beyond chance, large enough, and its own."""
    start = selection.excess(selection.losses())
    if not passes(selection, first, named, s):
        return False
    if not named:
        return True
    left, own = beside_relaxed(selection, named, s)
    share = (left - own.losses.sum()) / start
    large = share >= ASKED.own_share and own.gain >= ASKED.own_gain
    sure = own.p_value <= ASKED.p_value and own.log_gain.mean() >= ASKED.own_log_gain
    if large and sure:
        return True
    still = ASKED.left_beside_relaxed * (left - selection.floor.sum())
    return bool(selection.excess(s.losses) <= still)


def passes(selection: ModelSelection, first: list[Score], named: list[Score], s: Score) -> bool:
    """Whether one effect on top of the named ones is beyond chance and large enough."""
    start = selection.excess(selection.losses())
    share = (selection.losses(chosen_by(named)).sum() - s.losses.sum()) / start
    log_gain = s.log_gain.mean()
    if not named:
        if selection.in_fit(s.effect):
            return False
        within = selection.whole_size < 1.0
        enough = ASKED.first_gain_within_discrepancy if within else ASKED.first_gain
        if s.p_value <= ASKED.p_value and share >= enough and log_gain >= ASKED.log_gain:
            return True
        far = selection.size(selection.losses()) >= ASKED.far_size and share >= ASKED.far_gain
        sure = far or s.p_value <= ASKED.large_p_value
        return bool(sure and share >= ASKED.large_gain and log_gain >= ASKED.large_log_gain)
    if s.p_value > ASKED.p_value or log_gain < ASKED.log_gain:
        return False
    alone = next((other.gain for other in first if other.effect == s.effect), 0.0)
    beside = s.gain >= ASKED.beside_gain and log_gain >= ASKED.beside_log_gain
    beside = beside and alone < ASKED.beside_overlap * named[0].gain
    distinct = s.gain >= ASKED.distinct_gain and log_gain >= ASKED.distinct_log_gain
    large = share >= ASKED.next_share or s.gain >= ASKED.nearly_all_gain
    return bool(large or beside or distinct)


def exchanged(selection: ModelSelection, named: list[Score]) -> list[Score]:
    """The named effects after exchanges, the one that would be missed most first."""
    for _ in range(ASKED.exchanges):
        changed = False
        for place in range(len(named)):
            others = named[:place] + named[place + 1 :]
            if not others:
                break
            best = selection.scores(chosen_by(others), tuple(s.effect for s in others))[0]
            changed = changed or best.effect != named[place].effect
            named = [*named[:place], best, *named[place + 1 :]]
        if not changed:
            break
    return _in_order(selection, named)


def _in_order(selection: ModelSelection, named: list[Score]) -> list[Score]:
    """The same effects, the one that would be missed most first, each on top of those before."""

    def missed(score: Score) -> float:
        rest = [other for other in named if other is not score]
        return -float(selection.losses(chosen_by(rest)).sum())

    answer: list[Score] = []
    for score in sorted(named, key=missed):
        found = selection.scores(chosen_by(answer), tuple(s.effect for s in answer))
        again = next((s for s in found if s.effect == score.effect), score)
        answer.append(again)
    return answer


def _without_idle(selection: ModelSelection, first: list[Score], named: list[Score]) -> list[Score]:
    """The named effects without those whose share the others explain."""
    while len(named) > 1:
        for score in reversed(named):
            others = [other for other in named if other is not score]
            found = selection.scores(chosen_by(others), tuple(s.effect for s in others))
            again = next((s for s in found if s.effect == score.effect), None)
            if again is None or not passes(selection, first, others, again):
                named = _in_order(selection, others)
                break
        else:
            break
    return named


# Size of the discrepancy --------------------------------------------------------------------

STATIC_ROWS = 500
"""Most rows of the Gaussian process."""


@dataclass(frozen=True)
class StaticError:
    """The most likely factor on the validated error, see `discrepancy`."""

    before: float
    """Without any effect."""
    after: float
    """With the named effects."""


def static_error(
    problem: Problem, selection: ModelSelection, chosen: tuple[int, ...]
) -> StaticError:
    """The factor before and after the effects whose sensitivities are chosen."""
    whole = np.flatnonzero(np.isfinite(problem.residual).all((1, 2)))
    if len(whole) < 50:
        return StaticError(1.0, 1.0)
    rows = whole[:: max(1, round(len(whole) / STATIC_ROWS))]
    losses = selection.losses(chosen)
    left = float(losses.sum() / selection.validation.counts.sum())
    noise = np.sqrt(np.maximum(problem.noise_mm**2, left))
    prior = Prior.of(problem.pressure[rows], problem.direction[rows], problem.discrepancy_mm, noise)
    residual = problem.residual[rows]
    sensitivities = selection.sensitivities[rows][..., list(chosen)]
    amplitude = selection.validation.amplitudes(chosen)
    return StaticError(_size(prior, residual), _size(prior, residual - sensitivities @ amplitude))


def _size(prior: Prior, residual: np.ndarray) -> float:
    field = prior.turned(residual)
    return float(max(SIZES, key=lambda size: prior.log_evidence(field, size)))


# Identification ------------------------------------------------------------------------------

Progress = Callable[[str], None]
"""Called with what is being done."""


@dataclass(frozen=True, eq=False)
class Selected:
    """The effects that model selection names on a problem."""

    selection: ModelSelection
    first: list[Score]
    """All effects on top of nothing, the best first."""
    named: list[Score]
    """The effects that passed, in order, each on top of those before it."""
    following: list[Score]
    """The effects that did not pass on top of those, the best first."""

    @property
    def problem(self) -> Problem:
        """The identification problem."""
        return self.selection.problem

    @property
    def chosen(self) -> tuple[int, ...]:
        """Sensitivities of the named effects."""
        return chosen_by(self.named)

    @property
    def explained_mm(self) -> np.ndarray:
        """(S, n, 3) what the named effects explain of the residual, mm; 0 where none is named."""
        amplitudes = self.selection.validation.amplitudes(self.chosen)
        return self.selection.sensitivities[..., list(self.chosen)] @ amplitudes


@dataclass(frozen=True, eq=False)
class Findings(Selected):
    """What model selection found on a problem, and the tests of it."""

    competing: list[str]
    """Effects that explain the data about as well as the first, or as one of several."""
    unique: dict[str, float]
    """Gain of each effect that no other effect has."""
    box: BlackBox
    static: StaticError
    """The most likely size of a static error before and after the named effects."""
    relaxed: RelaxedFit | None
    """The lack of fit of the named effects, or of the one and those that compete with it."""


@dataclass(frozen=True)
class BestAchievable:
    """The least error that anything reached on held-out blocks: no reported error is below it."""

    rmse_mm: float
    """RMS distance over all key points, mm."""
    ci95_mm: tuple[float, float]
    """95 % interval from a bootstrap of motions, mm."""


def select(problem: Problem, some: list[Candidate], report: Progress) -> Selected:
    """Name effects by forward selection; close ones compete with refined nonlinear parameters."""
    report("held-out errors")
    selection = ModelSelection.of(problem, some)
    first = selection.scores()
    named, following = select_effects(selection, first)
    close = _close(first, named)
    if close:
        report(f"nonlinear parameters of {' and '.join(score.effect for score in close)}")
        selection = selection.extended(refined(problem, selection.starts(close)))
        first = selection.scores()
        named, following = select_effects(selection, first)
    return Selected(selection, first, named, following)


def find(problem: Problem, some: list[Candidate], report: Progress) -> Findings:
    """Select effects and test them."""
    selected = select(problem, some, report)
    selection, first, named = selected.selection, selected.first, selected.named
    rivals = competing(selection, first, named)
    report("black box")
    return Findings(
        selection=selection,
        first=first,
        named=named,
        following=selected.following,
        competing=rivals,
        unique=selection.unique_gains(first),
        box=black_box(problem),
        static=static_error(problem, selection, selected.chosen),
        relaxed=_lack_of_fit(selection, first, named, rivals),
    )


def best_achievable(problem: Problem, box: BlackBox, selected: Selected | None) -> BestAchievable:
    """The least of the errors of the model, a black box, each effect and the named effects."""
    seen = np.isfinite(problem.residual).all(2)
    square = np.where(seen, np.square(problem.residual).sum(2), 0.0)
    tried = [block_sums(square.sum(1), problem.block), box.losses, box.free_losses]
    if selected is not None:
        tried += [selected.selection.losses(selected.chosen)]
        tried += [score.losses for score in selected.first]
    losses = min(tried, key=np.sum)
    counts = block_sums(seen.sum(1).astype(float), problem.block)
    rmse = float(np.sqrt(losses.sum() / counts.sum()))
    return BestAchievable(rmse, rmse_interval(problem, losses, counts))


def rmse_interval(problem: Problem, losses: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """95 % interval of an RMS distance, mm, from sums of squares and counts (B,) of the blocks."""
    by_motion = problem.by_motion(np.stack([losses, counts]))
    low, high = block_interval(lambda loss, count: np.sqrt(loss / count), tuple(by_motion))
    return float(low), float(high)


def _close(first: list[Score], named: list[Score]) -> list[Score]:
    """The one effect that is named and those that explain about as much; none where none does."""
    if len(named) != 1:
        return []
    best = named[0]
    least = ASKED.refined_gain * best.gain
    others = [s for s in first if s.effect != best.effect and s.gain >= least]
    return [best, *others[: ASKED.most_competing]] if others else []


def _lack_of_fit(
    selection: ModelSelection, first: list[Score], named: list[Score], rivals: list[str]
) -> RelaxedFit | None:
    """The relaxed fit of the named effects, or of the one and those that compete with it."""
    if not named:
        return None
    some = rivals[: ASKED.most_competing] if len(named) == 1 else []
    others = [s for s in first if s.effect in some]
    return relaxed_fit(selection, [named, *([s] for s in others)])


def competing(selection: ModelSelection, first: list[Score], named: list[Score]) -> list[str]:
    """Effects that would do about as well in the place of one that is named, beside the others."""
    if len(named) == 1:
        return _competing_with(selection, first, named[0])
    answer = []
    for one in named:
        others = [other for other in named if other is not one]
        found = selection.scores(chosen_by(others), tuple(other.effect for other in others))
        own = next((score for score in found if score.effect == one.effect), None)
        answer += [] if own is None else _competing_with(selection, found, own)
    return list(dict.fromkeys(answer))


def _competing_with(selection: ModelSelection, found: list[Score], best: Score) -> list[str]:
    """Effects that explain about as much as one, all on top of the same base."""
    tie = min(ASKED.tie_of_gain * best.gain, ASKED.tie_of_left * (1.0 - best.gain))
    answer = []
    for other in found:
        if other.effect == best.effect or other.gain < ASKED.competing_gain * best.gain:
            continue
        pair = selection.problem.by_motion(np.stack([-best.log_gain, -other.log_gain]))
        if best.gain - other.gain < tie or win_shares(pair)[0] < ASKED.win_share:
            answer.append(other.effect)
    return answer
