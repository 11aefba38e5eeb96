"""Model selection: which effects explain what the model leaves, alone and together.

Every effect is scored by the held-out error that remains with it, the model discrepancy always
fitted beside it (`cross_validation`). The best single effect and the best two of all pairs are
proposed, generously: whether any of them is missing is left to the fitted decision (`decision`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, groupby

import numpy as np

from surgisoft.diagnosis.black_box import BlackBox, black_box
from surgisoft.diagnosis.candidates import Candidate
from surgisoft.diagnosis.criteria import SEARCH
from surgisoft.diagnosis.cross_validation import CrossValidation, split_of
from surgisoft.diagnosis.estimation.effects import refined
from surgisoft.diagnosis.residuals import Problem
from surgisoft.diagnosis.statistics import (
    block_interval,
    block_sums,
    sign_flip_p_values,
)
from surgisoft.diagnosis.testability import cubics
from surgisoft.surrogate.effects import Effect, Quantity, hypothesis_of

AT_ONCE = 64
"""Rows of all sensitivities that are multiplied at once, so that they stay in the cache."""


@dataclass(frozen=True, eq=False)
class Option:
    """One form of an effect: one of its candidates, or several of them side by side."""

    effect: str
    """The effect's name."""
    chosen: tuple[int, ...]
    """Its sensitivities."""
    candidate: int | None
    """Number of the candidate; None: several of them."""
    amplitudes: int
    """Number of amplitudes that were fitted to the recordings; a refined candidate has one
    sensitivity, whose amplitudes were all fitted."""

    @property
    def alone(self) -> int:
        """Number of the candidate of a form that has one."""
        assert self.candidate is not None
        return self.candidate


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
    """Share of what can be explained of the base's squared error that goes; at most 1."""

    @property
    def score(self) -> float:
        """Mean log gain less the price of its amplitudes: what effects are ranked by."""
        return SEARCH.priced(self.log_gain.mean(), len(self.option.chosen))


def chosen_by(scores: Sequence[Score]) -> tuple[int, ...]:
    """The sensitivities of effects, one after another."""
    return sum((score.option.chosen for score in scores), ())


def _near(quantity: Quantity) -> bool:
    """Whether a first estimate may turn out plausible: right in sign, at most twice too large."""
    factor = SEARCH.plausible_factor
    low = quantity.low * (factor if quantity.low < 0 else 1 / factor) - 0.01 * abs(quantity.high)
    high = quantity.high * (factor if quantity.high > 0 else 1 / factor)
    return bool(np.all((np.ravel(quantity.value) >= low) & (np.ravel(quantity.value) <= high)))


def _all_near(effect: Effect) -> bool:
    """Whether all parameters of an effect may turn out plausible."""
    return all(_near(quantity) for quantity in effect.quantities())


def _options_of(
    candidates: Sequence[Candidate], number: int = 0, first: int = 0
) -> Iterator[Option]:
    """One option for each candidate, numbered and indexed from the given numbers on."""
    for candidate in candidates:
        end = first + candidate.sensitivities.shape[3]
        yield Option(candidate.name, tuple(range(first, end)), number, candidate.amplitudes)
        number, first = number + 1, end


@dataclass(frozen=True, eq=False)
class ModelSelection:
    """All candidates of a problem and their held-out errors."""

    problem: Problem
    candidates: list[Candidate]
    validation: CrossValidation
    options: dict[str, list[Option]]
    """Forms of each effect."""
    floor: np.ndarray
    """(B,) sum of squared noise in each block, mm^2."""
    fitted: dict = field(default_factory=dict)
    """Effects at their amplitudes by candidate and base."""

    @classmethod
    def of(cls, problem: Problem, candidates: list[Candidate]) -> "ModelSelection":
        """Prepare the selection; afterwards every set of effects is cheap to try."""
        given = [candidate.sensitivities for candidate in candidates]
        validation = CrossValidation.on(split_of(problem), given)
        options: dict[str, list[Option]] = {}
        for option in _options_of(candidates):
            options.setdefault(option.effect, []).append(option)
        for name, choices in options.items():
            # Beside more of an effect that the model has, one further candidate is enough.
            own = any(candidates[option.alone].more for option in choices)
            members = [candidates[option.alone].effect for option in choices]
            for some in [] if own else hypothesis_of(members[0]).combinations(members):
                if len(some) > 1:
                    chosen = sum((choices[i].chosen for i in some), ())
                    choices.append(Option(name, chosen, None, len(chosen)))
        noise = float(np.mean(problem.noise_mm**2))
        return cls(problem, candidates, validation, options, validation.counts * noise)

    def extended(self, more: list[Candidate]) -> "ModelSelection":
        """The selection with further candidates of its effects; known results are kept."""
        if not more:
            return self
        sensitivities = np.concatenate([c.sensitivities for c in more], axis=3)
        options = {name: list(choices) for name, choices in self.options.items()}
        for option in _options_of(more, len(self.candidates), self.validation.sensitivities):
            options.setdefault(option.effect, []).append(option)
        return replace(
            self,
            candidates=[*self.candidates, *more],
            validation=self.validation.extended(sensitivities),
            options=options,
            fitted=dict(self.fitted),
        )

    @cached_property
    def _place(self) -> list[tuple[int, int]]:
        """The candidate of each sensitivity, and its number among the candidate's own."""
        counts = [each.sensitivities.shape[3] for each in self.candidates]
        return [(number, own) for number, count in enumerate(counts) for own in range(count)]

    def parts(self, chosen: Sequence[int]) -> list[np.ndarray]:
        """(S, n, 3, k) each: some sensitivities one after another, mm; those of a candidate that
        follow each other are views of its own."""
        places, answer = [self._place[one] for one in chosen], []
        for number, group in groupby(places, key=lambda place: place[0]):
            own = [place for _, place in group]
            of = self.candidates[number].sensitivities
            together = own == list(range(own[0], own[-1] + 1))
            answer.append(of[..., own[0] : own[-1] + 1] if together else of[..., own])
        return answer

    def products(self, chosen: Sequence[int], field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((k, k), (k,)) products of some sensitivities with each other and with a field (S, n, 3),
        over what was measured, in double precision; mm^2 for a field in mm."""
        seen, count = np.isfinite(self.problem.residual), len(chosen)
        owners: dict[int, tuple[list[int], list[int]]] = {}
        for place, one in enumerate(chosen):
            number, own = self._place[one]
            places, columns = owners.setdefault(number, ([], []))
            places.append(place)
            columns.append(own)
        gram, moment = np.zeros((count, count)), np.zeros(count)
        for first in range(0, len(seen), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            some = np.empty((count, *seen[rows].shape))
            for number, (places, columns) in owners.items():
                of = self.candidates[number].sensitivities[rows]
                every = columns == list(range(of.shape[3]))
                some[places] = np.moveaxis(of if every else of[..., columns], 3, 0)
            some *= seen[rows]
            flat = some.reshape(count, -1)
            gram += flat @ flat.T
            moment += flat @ field[rows].reshape(-1)
        return gram, moment

    def explained_mm(self, chosen: Sequence[int], amplitudes: np.ndarray) -> np.ndarray:
        """(S, n, 3) what some sensitivities explain at amplitudes (k,), mm."""
        mixes: dict[int, np.ndarray] = {}
        for one, amplitude in zip(chosen, amplitudes, strict=True):
            number, own = self._place[one]
            of = self.candidates[number].sensitivities
            mixes.setdefault(number, np.zeros(of.shape[3], of.dtype))[own] = amplitude
        answer = np.zeros(self.problem.residual.shape)
        for number, mix in mixes.items():
            answer += self.candidates[number].sensitivities @ mix
        return answer

    def losses(self, chosen: tuple[int, ...] = (), common: tuple[int, ...] = ()) -> np.ndarray:
        """(B,) held-out sum of squared distances, mm^2, with the chosen sensitivities.

        common: those of them that many sets have in common (`CrossValidation.losses`).
        """
        return self.validation.losses(chosen, common)

    def losses_of(
        self,
        sets: Sequence[tuple[int, ...]],
        common: Sequence[tuple[int, ...]] | None = None,
    ) -> np.ndarray:
        """(N, B) `losses` of N sets of sensitivities (`CrossValidation.losses_of`)."""
        return self.validation.losses_of(sets, common)

    def rmse_mm(self, losses: np.ndarray) -> float:
        """RMS distance of a key point, mm."""
        return float(np.sqrt(losses.sum() / self.validation.counts.sum()))

    def excess(self, losses: np.ndarray) -> float:
        """Squared error above the noise floor, mm^2."""
        return float(max(losses.sum() - self.floor.sum(), 0.02 * losses.sum(), 1e-30))

    def explainable(self, before: np.ndarray, after: Sequence[np.ndarray]) -> float:
        """Squared error that can be explained, mm^2, from the losses (B,) before and after.

        What lies above the noise floor; where something leaves less than the floor, which may be
        stated too large, what lies above that. So no share of it is above 1.
        """
        least = min((float(losses.sum()) for losses in after), default=np.inf)
        return max(self.excess(before), float(before.sum()) - least)

    def size(self, losses: np.ndarray) -> float:
        """Error that is left above the noise floor, in units of the model discrepancy."""
        return self._over(losses, self.problem.discrepancy_mm)

    def left_size(self, losses: np.ndarray) -> float:
        """Error that effects leave above the noise floor, in units of what the right ones may leave
        (`Problem.tolerance_mm`)."""
        return self._over(losses, self.problem.tolerance_mm)

    def _over(self, losses: np.ndarray, level_mm: np.ndarray) -> float:
        seen = np.isfinite(self.problem.residual).all(2).sum(0)
        return float(np.sqrt(self.excess(losses) / (seen @ np.square(level_mm))))

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

    def every_score(self, base: tuple[int, ...] = (), without: tuple[str, ...] = ()) -> list[Score]:
        """Every form of every effect on top of a base, plausible or not, in no order."""
        before = self.losses(base)
        choices = [w for name, some in self.options.items() if name not in without for w in some]
        if not choices:
            return []
        sets = [base + option.chosen for option in choices]
        after = list(self.losses_of(sets, [base] * len(sets)))
        gains = np.array([self.log_ratio(before, losses) for losses in after])
        chances = sign_flip_p_values(
            self.problem.by_motion(gains), [option.effect for option in choices]
        )
        explainable = self.explainable(before, after)
        return [
            Score(w.effect, w, losses, gain, chance, (before.sum() - losses.sum()) / explainable)
            for w, losses, gain, chance in zip(choices, after, gains, chances, strict=True)
        ]

    def scores(self, base: tuple[int, ...] = (), without: tuple[str, ...] = ()) -> list[Score]:
        """Every effect on top of a base in its best plausible form, the best first."""
        best: dict[str, Score] = {}
        every = self.every_score(base, without)
        scores = np.array([each.score for each in every])
        for i in np.argsort(-scores, kind="stable"):
            found = every[i]
            if found.effect not in best and self.plausible(found.option, base):
                best[found.effect] = found
        return sorted(best.values(), key=lambda score: -score.score)

    def plausible(self, option: Option, base: tuple[int, ...] = ()) -> bool:
        """Whether an effect's parameters lie in their ranges as the selection leaves them.

        Several candidates side by side are as plausible as the best of them. One that only inner
        reversals show must explain more than a function of the actuation does: on ramps that all
        begin at rest, loops can be summed to any such function.
        """
        effect = self.in_place(self.single(option, base), base)
        if effect is not None and not _all_near(effect) and not self.taken_away(option, base):
            return False
        some = self.candidates[self.options[option.effect][0].alone].effect
        return (
            not hypothesis_of(some).needs_reversals
            or self._static_share(option, base) <= SEARCH.most_static
        )

    def taken_away(self, option: Option, base: tuple[int, ...] = ()) -> bool:
        """Whether an effect is plausible as one that acted before and acts no more, or less."""
        one = self.single(option, base)
        effect, candidate = self.in_place(one, base), self.candidates[one.alone]
        if effect is None or _all_near(effect) or not candidate.removable:
            return False
        mirrored = candidate.with_amplitudes(-self._amplitudes(one, base))
        return mirrored is not None and _all_near(mirrored)

    def _static_share(self, option: Option, base: tuple[int, ...]) -> float:
        """Share of what an effect explains that is a cubic of the actuation."""
        amplitudes = self._amplitudes(option, base)
        part = self.explained_mm(option.chosen, amplitudes).reshape(len(self.problem.index), -1)
        part = part - part.mean(axis=0)
        known = self._cubics.T @ part
        return float(np.square(known).sum() / max(np.square(part).sum(), 1e-30))

    @cached_property
    def _cubics(self) -> np.ndarray:
        """(S, F) orthonormal basis of the cubics of the actuation."""
        return cubics(self.problem.pressure)

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
            amplitudes = self._amplitudes(option, base)
            self.fitted[key] = self.candidates[option.alone].with_amplitudes(amplitudes)
        return self.fitted[key]

    def _amplitudes(self, option: Option, base: tuple[int, ...]) -> np.ndarray:
        """(k,) amplitudes of an option beside a base."""
        return self.validation.amplitudes(base + option.chosen)[len(base) :]

    def starts(self, scores: Sequence[Score]) -> list[tuple[str, Effect]]:
        """Effects, by name, in their best single candidate at their amplitudes: starts of a fit."""
        found = [(s.effect, self.in_place(self.single(s.option))) for s in scores]
        return [(name, effect) for name, effect in found if effect is not None]

    def unique_gains(self, scores: list[Score]) -> dict[str, float]:
        """Share of the squared error above the floor that only this effect explains.

        What comes back when it is left out of the best forms of all effects together.
        """
        together = {s.effect: s.option.chosen for s in scores}
        everything = self.losses(sum(together.values(), ()))
        total = self.explainable(self.losses(), [everything, *(s.losses for s in scores)])
        rests = self.validation.losses_without_each(list(together.values()))
        return {
            name: float((rest.sum() - everything.sum()) / total)
            for name, rest in zip(together, rests, strict=True)
        }

    def in_best_form(self, score: Score, base: tuple[int, ...] = ()) -> Effect | None:
        """An effect in its best single candidate, at its amplitudes beside a base."""
        single = [option for option in self.options[score.effect] if option.candidate is not None]
        option = max(
            single,
            key=lambda w: float(
                self.log_ratio(self.losses(base), self.losses(base + w.chosen)).mean()
            ),
        )
        return self.in_place(option, base)


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


def relaxed_fit(selection: ModelSelection, named: Sequence[Score]) -> RelaxedFit:
    """Additional gain of effects in their relaxed form: the better of two fits."""
    tried = []
    for scaled in (_by_state, _by_time):
        sensitivities = _relaxed_sensitivities(selection, named, scaled)
        validation = CrossValidation.on(selection.validation.split, sensitivities)
        tried.append(validation.losses(range(validation.sensitivities)))
    return _beyond(selection, chosen_by(named), min(tried, key=np.sum))


def _beyond(selection: ModelSelection, chosen: tuple[int, ...], after: np.ndarray) -> RelaxedFit:
    before = selection.losses(chosen)
    log_gain, chance = _fall(selection, before, after)
    start = selection.losses()
    share = (before.sum() - after.sum()) / selection.explainable(start, [before, after])
    return RelaxedFit(after, float(share), float(log_gain.mean()), chance)


def _fall(
    selection: ModelSelection, before: np.ndarray, after: np.ndarray
) -> tuple[np.ndarray, float]:
    """(B,) fall of each block's log error, and the chance of such a fall without a cause."""
    log_gain = selection.log_ratio(before, after)
    gain = selection.problem.by_motion(log_gain[None])
    return log_gain, float(sign_flip_p_values(gain)[0]) if log_gain.any() else 1.0


def beside_relaxed(selection: ModelSelection, named: Sequence[Score], further: Score) -> Score:
    """A further effect's score beside the relaxed forms of the named ones.

    The p-value counts this one effect alone.
    """
    chosen = further.option.chosen
    sensitivities = _relaxed_sensitivities(selection, named, _by_state)
    sensitivities += selection.parts(chosen)
    validation = CrossValidation.on(selection.validation.split, sensitivities)
    total = validation.sensitivities
    before, after = (validation.losses(range(n)) for n in (total - len(chosen), total))
    log_gain, chance = _fall(selection, before, after)
    gain = float((before.sum() - after.sum()) / selection.explainable(before, [after]))
    return Score(further.effect, further.option, after, log_gain, chance, gain)


def _relaxed_sensitivities(
    selection: ModelSelection, named: Sequence[Score], scaled: Scaled
) -> list[np.ndarray]:
    """(S, n, 3, k) each: the named effects' sensitivities; what each effect explains, scaled."""
    choices = [selection.freest(score) for score in named]
    base = sum(choices, ())
    amplitudes = selection.validation.amplitudes(base)
    sensitivities, first = selection.parts(base), 0
    for chosen in choices:
        part = selection.explained_mm(chosen, amplitudes[first : first + len(chosen)])
        sensitivities.append(scaled(selection, part))
        first += len(chosen)
    return sensitivities


def _by_state(selection: ModelSelection, part: np.ndarray) -> np.ndarray:
    """(S, n, 3, 2 m + 1) what an effect explains (S, n, 3), scaled."""
    points = part.shape[1]
    along = np.linspace(-1.0, 1.0, points) if points > 1 else np.zeros(1)
    rows = np.concatenate([selection.problem.pressure, selection.problem.direction], axis=1)
    scaled = part[..., None] * rows[:, None, None, :]
    return np.concatenate([scaled, (part * along[:, None])[..., None]], axis=3)


def _by_time(selection: ModelSelection, part: np.ndarray) -> np.ndarray:
    """(S, n, 3, spans - 1) what an effect explains, in each part of the time but the first."""
    spans = SEARCH.relaxed_spans
    span = spans * np.arange(len(part)) // len(part)
    return part[..., None] * (span[:, None] == np.arange(1, spans))[:, None, None, :]


# Proposals ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Proposal:
    """One effect, or two that may be missing together; its tests are made when they are read."""

    selection: ModelSelection
    """The candidates that it was selected from."""
    scores: tuple[Score, ...]
    """The effects, the one that would be missed most first, each on top of those before it."""

    @cached_property
    def relaxed(self) -> RelaxedFit:
        """The lack of fit of these effects."""
        return relaxed_fit(self.selection, self.scores)

    @cached_property
    def beside(self) -> Score | None:
        """The last effect beside the relaxed forms of those before it; None for a single effect."""
        if len(self.scores) == 1:
            return None
        return beside_relaxed(self.selection, self.scores[:-1], self.scores[-1])

    @cached_property
    def instead(self) -> tuple[Score | None, ...]:
        """For each of two effects the best other one in its place; None where there is none."""
        return _instead(self.selection, self.scores) if len(self.scores) > 1 else ()

    @property
    def effects(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(score.effect for score in self.scores)

    @property
    def chosen(self) -> tuple[int, ...]:
        """Their sensitivities."""
        return chosen_by(self.scores)


def propose(selection: ModelSelection, first: list[Score]) -> tuple[Proposal, ...]:
    """The best single effect and the best two; whether any is missing is left open.

    The two are sought among all pairs, since the best single effect need not be one of them: where
    two act, a third may explain most of both, and neither of the two need be plausible alone. None
    where all effects alone are within chance.
    """
    some = [score for score in first if not selection.in_fit(score.effect)]
    if not any(_worth_a_look(score) for score in some):
        return ()
    answer = [Proposal(selection, (some[0],))]
    pair = best_pair(selection, [name for name in selection.options if not selection.in_fit(name)])
    if pair:
        answer.append(Proposal(selection, pair))
    return tuple(answer)


def _worth_a_look(score: Score) -> bool:
    """Whether an effect can be anything but chance."""
    return score.p_value <= SEARCH.p_value or score.gain >= SEARCH.large_gain


def _instead(selection: ModelSelection, named: Sequence[Score]) -> tuple[Score | None, ...]:
    """For each effect the best other one beside those that stay."""
    answer = []
    for score in named:
        others = [other for other in named if other is not score]
        taken = tuple(other.effect for other in named)
        answer.append(next(iter(selection.scores(chosen_by(others), taken)), None))
    return tuple(answer)


def best_pair(selection: ModelSelection, effects: Sequence[str]) -> tuple[Score, ...]:
    """The best two of some effects, the one that would be missed most first; empty without any two.

    Pairs of forms are ranked by `_together`. Every form of one effect is tried beside the best form
    of the other one, and in the `SEARCH.pairs` best pairs of effects again beside what was found,
    until nothing is better. The first pair of forms is taken in which both effects are plausible
    beside each other.
    """
    null = selection.losses()
    tried: dict[tuple[Option, Option], float] = {}

    def worths(pairs: list[tuple[Option, Option]]) -> list[float]:
        new = [pair for pair in pairs if pair not in tried]
        sets = [a.chosen + b.chosen for a, b in new]
        common = [max(a.chosen, b.chosen, key=len) for a, b in new]
        tried.update(zip(new, _together(selection, null, sets, common), strict=True))
        return [tried[pair] for pair in pairs]

    def improved(a: Option, b: Option) -> tuple[Option, Option]:
        """The better of exchanging one form beside the other one."""
        pairs = [(form, b) for form in selection.options[a.effect]]
        pairs += [(a, form) for form in selection.options[b.effect]]
        return pairs[int(np.argmax(worths(pairs)))]

    best = []
    for effect in effects:
        forms = selection.options[effect]
        alone = _together(selection, null, [form.chosen for form in forms])
        best.append(forms[int(np.argmax(alone))])
    found = [improved(a, b) for a, b in combinations(best, 2)]
    for pair in sorted(found, key=lambda pair: -tried[pair])[: SEARCH.pairs]:
        while (better := improved(*pair)) != pair:
            pair = better
    for a, b in sorted(tried, key=lambda pair: -tried[pair]):
        if selection.plausible(a, b.chosen) and selection.plausible(b, a.chosen):
            return _in_order(selection, a, b)
    return ()


def _together(
    selection: ModelSelection,
    null: np.ndarray,
    sets: Sequence[tuple[int, ...]],
    common: Sequence[tuple[int, ...]] | None = None,
) -> list[float]:
    """How well each of some sets of sensitivities explains the error: mean log gain of the blocks
    plus log gain of the whole error.

    Few blocks that fall by much and many that fall by little both count. The noise is added to
    both, and amplitudes have their price. common: as of `CrossValidation.losses_of`.
    """
    losses, floor = selection.losses_of(sets, common), selection.floor.sum()
    whole = np.log((null.sum() + floor) / (losses.sum(axis=1) + floor))
    gains = selection.log_ratio(null, losses).mean(axis=1) + whole
    return [SEARCH.priced(float(gain), len(each)) for gain, each in zip(gains, sets, strict=True)]


def _in_order(selection: ModelSelection, *some: Option) -> tuple[Score, ...]:
    """Two effects in given forms, the one that would be missed most first, each on top of those
    before it."""
    one, two = sorted(some, key=lambda option: float(selection.losses(option.chosen).sum()))
    answer = []
    for option, base, without in ((one, (), ()), (two, one.chosen, (one.effect,))):
        every = selection.every_score(base, without)
        answer.append(next(score for score in every if score.option is option))
    return tuple(answer)


# Identification ------------------------------------------------------------------------------

Progress = Callable[[str], None]
"""Called with what is being done."""


@dataclass(frozen=True, eq=False)
class Selected:
    """The effects that model selection proposes on a problem."""

    selection: ModelSelection
    first: list[Score]
    """All effects on top of nothing, the best first."""
    proposals: tuple[Proposal, ...]
    """The best single effect and the best two, as far as they are worth a look."""

    @property
    def problem(self) -> Problem:
        """The identification problem."""
        return self.selection.problem

    def explained_mm(self, effects: Sequence[str]) -> np.ndarray:
        """(S, n, 3) what some effects explain of the residual together, mm; 0 for none."""
        same = [p.chosen for p in self.proposals if set(p.effects) == set(effects)]
        alone = [score.option.chosen for score in self.first if score.effect in effects[:1]]
        chosen = next(iter(same + alone), ())
        return self.selection.explained_mm(chosen, self.selection.validation.amplitudes(chosen))


@dataclass(frozen=True, eq=False)
class Findings(Selected):
    """Result of model selection on a problem, and its tests."""

    forms: dict[str, RelaxedFit]
    """Lack of fit of the best effect alone and of those that explain about as much."""
    unique: dict[str, float]
    """Gain of each effect that no other effect has."""
    box: BlackBox


@dataclass(frozen=True)
class BestAchievable:
    """The least error that anything reached on held-out blocks: no reported error is below it.

    A network that is fitted again (`refit`) is another model and does not count.
    """

    rmse_mm: float
    """RMS distance over all key points, mm."""
    ci95_mm: tuple[float, float]
    """95 % interval from a bootstrap of motions, mm."""


def select(problem: Problem, some: list[Candidate], report: Progress) -> Selected:
    """Rank and propose effects, the best and those close to it with refined nonlinear parameters.

    Where the model is off by more than it was validated to be, they are refined even if all of them
    are within chance: to first order and on a grid a large effect may explain little.
    """
    report("held-out errors")
    selection = ModelSelection.of(problem, some)
    first = selection.scores()
    close = close_to_best(first, SEARCH.refined_gain, within_chance=selection.whole_size > 1.0)
    if close:
        report(f"nonlinear parameters of {' and '.join(score.effect for score in close)}")
        selection = selection.extended(refined(problem, selection.starts(close)))
        first = selection.scores()
    return Selected(selection, first, propose(selection, first))


def find(problem: Problem, some: list[Candidate], report: Progress) -> Findings:
    """Rank and propose effects, and test them."""
    selected = select(problem, some, report)
    selection, first = selected.selection, selected.first
    report("black box")
    forms = {p.effects[0]: p.relaxed for p in selected.proposals[:1]}
    for score in close_to_best(first, SEARCH.competing_gain):
        if score.effect not in forms:
            forms[score.effect] = relaxed_fit(selection, [score])
    return Findings(
        selection=selection,
        first=first,
        proposals=selected.proposals,
        forms=forms,
        unique=selection.unique_gains(first),
        box=black_box(problem),
    )


def best_achievable(problem: Problem, box: BlackBox, selected: Selected | None) -> BestAchievable:
    """The least of the errors of the model, a black box, each effect and the proposed effects."""
    seen = np.isfinite(problem.residual).all(2)
    square = np.where(seen, np.square(problem.residual).sum(2), 0.0)
    tried = [block_sums(square.sum(1), problem.block), box.losses, box.free_losses]
    if selected is not None:
        tried += [selected.selection.losses()]
        tried += [selected.selection.losses(p.chosen) for p in selected.proposals]
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


def close_to_best(first: list[Score], share: float, within_chance: bool = False) -> list[Score]:
    """The best effect and those that explain at least a share of what it explains.

    within_chance: whether they count where all effects are within chance; otherwise none does.
    """
    if not first or not (within_chance or any(_worth_a_look(score) for score in first)):
        return []
    best = first[0]
    others = [s for s in first[1:] if s.gain >= share * best.gain]
    return [best, *others[: SEARCH.most_refined]]
