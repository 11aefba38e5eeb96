"""Which effects explain what is left, alone and beside others, on held-out blocks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from surgisoft.diagnosis.candidates import Candidate
from surgisoft.diagnosis.problem import Problem
from surgisoft.diagnosis.race.cross_validation import CrossValidation
from surgisoft.diagnosis.race.gates import family_p_values
from surgisoft.diagnosis.race.split import FITTED, Split, static_features
from surgisoft.surrogate.effects import Effect, Quantity, hypothesis_of

KNOWN_WEIGHT = 3.0
"""Weight of a reference's rows: an error that changed since is not shared out over both."""

PRICE = 0.003
"""Share of a gain that each amplitude costs: of two ways that explain alike, the simpler one."""
MOST_PRICED = 12
"""Most amplitudes that cost something: many share a ridge, and few of them are free."""

MOST_STATIC = 0.95
"""Most of what loops explain that a function of the actuation may hold. On simulated arms it was
0.1 to 0.8 where friction was hidden, 0.997 and more where sensors saw each other's pressures."""

WIDER = 2.0
"""Factor by which a first, linear estimate may leave the plausible range of a parameter."""


@dataclass(frozen=True, eq=False)
class Option:
    """One way to add an effect: one of its shapes, or several of them side by side."""

    effect: str
    """The effect's name."""
    picked: tuple[int, ...]
    """Its columns."""
    shape: int | None
    """Number of the candidate; None: several shapes."""


@dataclass(frozen=True, eq=False)
class Standing:
    """How one effect does on top of a base."""

    effect: str
    """Its name."""
    option: Option
    """Its best way."""
    losses: np.ndarray
    """(B,) held-out sum of squared distances by block, mm^2."""
    log_gain: np.ndarray
    """(B,) log of the base's error over this one's, by block, noise taken out softly."""
    p_value: float
    """Chance of so large a gain in any of the effects without a cause."""
    gain: float
    """Share of the base's squared error above the floor that goes."""

    @property
    def score(self) -> float:
        """What effects are ranked by."""
        return priced(self.log_gain.mean(), len(self.option.picked))


def picked_by(standings: Sequence[Standing]) -> tuple[int, ...]:
    """The columns of effects, one after another."""
    return sum((standing.option.picked for standing in standings), ())


def _near(quantity: Quantity) -> bool:
    """Whether a first estimate may turn out plausible: right in sign, at most WIDER too large."""
    low = quantity.low * (WIDER if quantity.low < 0 else 1 / WIDER) - 0.01 * abs(quantity.high)
    high = quantity.high * (WIDER if quantity.high > 0 else 1 / WIDER)
    return bool(np.all((np.ravel(quantity.value) >= low) & (np.ravel(quantity.value) <= high)))


def priced(log_gain: float, amplitudes: int) -> float:
    """A log gain, the less of it counted the more amplitudes it took."""
    return float(log_gain) * (1.0 - PRICE * min(amplitudes, MOST_PRICED))


def _ways(candidates: Sequence[Candidate], number: int = 0, first: int = 0) -> Iterator[Option]:
    """One option for each candidate, these being numbered and having columns from those given."""
    for candidate in candidates:
        end = first + candidate.columns.shape[3]
        yield Option(candidate.name, tuple(range(first, end)), number)
        number, first = number + 1, end


@dataclass(frozen=True, eq=False)
class Race:
    """All candidates of a problem and their held-out errors."""

    problem: Problem
    candidates: list[Candidate]
    validation: CrossValidation
    options: dict[str, list[Option]]
    """Ways to add each effect."""
    columns: np.ndarray
    """(S, n, 3, K) all columns, mm."""
    floor: np.ndarray
    """(B,) sum of squared noise in each block, mm^2."""
    fitted: dict = field(default_factory=dict)
    """Effects at their strengths by shape and base."""

    @classmethod
    def of(cls, problem: Problem, candidates: list[Candidate]) -> "Race":
        """Prepare the race; afterwards every set of effects is cheap to try."""
        columns = np.concatenate(
            [np.zeros((*problem.residual.shape, 0)), *(c.columns for c in candidates)], axis=3
        )
        validation = CrossValidation.on(split_of(problem), columns)
        options: dict[str, list[Option]] = {}
        for way in _ways(candidates):
            options.setdefault(way.effect, []).append(way)
        for name, ways in options.items():
            # Beside more of an effect that the model has, one further shape of it is enough.
            own = any(candidates[way.shape].more for way in ways)
            shapes = [candidates[way.shape].effect for way in ways]
            for some in [] if own else hypothesis_of(shapes[0]).combinations(shapes):
                if len(some) > 1:
                    ways.append(Option(name, sum((ways[i].picked for i in some), ()), None))
        noise = float(np.mean(problem.noise_mm**2))
        return cls(problem, candidates, validation, options, columns, validation.counts * noise)

    def extended(self, more: list[Candidate]) -> "Race":
        """The race with further shapes of its effects; what is known of the others is kept."""
        if not more:
            return self
        columns = np.concatenate([c.columns for c in more], axis=3)
        options = {name: list(ways) for name, ways in self.options.items()}
        for way in _ways(more, len(self.candidates), self.columns.shape[3]):
            options.setdefault(way.effect, []).append(way)
        return replace(
            self,
            candidates=[*self.candidates, *more],
            validation=self.validation.extended(columns),
            options=options,
            columns=np.concatenate([self.columns, columns], axis=3),
            fitted=dict(self.fitted),
        )

    def losses(self, picked: tuple[int, ...] = ()) -> np.ndarray:
        """(B,) held-out sum of squared distances, mm^2, with the picked columns."""
        return self.validation.losses(picked)

    def rmse_mm(self, losses: np.ndarray) -> float:
        """RMS distance of a key point, mm."""
        return float(np.sqrt(losses.sum() / self.validation.counts.sum()))

    def excess(self, losses: np.ndarray) -> float:
        """Squared error above the noise floor, mm^2."""
        return float(max(losses.sum() - self.floor.sum(), 0.02 * losses.sum(), 1e-30))

    def size(self, losses: np.ndarray) -> float:
        """Error that is left above the noise floor, in units of the surrogate's validated error."""
        seen = np.isfinite(self.problem.residual).all(2).sum(0)
        return float(np.sqrt(self.excess(losses) / (seen @ np.square(self.problem.surrogate_mm))))

    @property
    def whole_size(self) -> float:
        """The same of the model's error as it is: below 1 it is off by no more than it was then."""
        return self.size(np.nansum(np.square(self.problem.residual), axis=(1, 2)))

    def in_fit(self, effect: str) -> bool:
        """Whether the model was fitted with an effect and is off by no more than it was then.

        The validated error holds what was wrong with the effect's parameters from the beginning.
        """
        return effect in self.problem.model.effects and self.whole_size < 1.0

    def log_ratio(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(B,) log of errors before over after; the floor keeps quiet blocks from shouting."""
        return np.log((before + self.floor) / (after + self.floor))

    def standings(self, base: tuple[int, ...] = (), without: tuple[str, ...] = ()):
        """Every effect on top of a base, the best first."""
        before = self.losses(base)
        ways = [w for name, some in self.options.items() if name not in without for w in some]
        after = [self.losses(base + way.picked) for way in ways]
        if not ways:
            return []
        gains = np.array([self.log_ratio(before, losses) for losses in after])
        chances = family_p_values(self.problem.by_motion(gains), [way.effect for way in ways])
        best: dict[str, Standing] = {}
        scores = [priced(g.mean(), len(w.picked)) for g, w in zip(gains, ways, strict=True)]
        for i in np.argsort(-np.array(scores), kind="stable"):
            way, losses = ways[i], after[i]
            if way.effect not in best and self.plausible(way, base):
                gain = (before.sum() - losses.sum()) / self.excess(before)
                best[way.effect] = Standing(way.effect, way, losses, gains[i], chances[i], gain)
        return sorted(best.values(), key=lambda standing: -standing.score)

    def plausible(self, way: Option, base: tuple[int, ...] = ()) -> bool:
        """Whether an effect's parameters lie in their ranges as the race leaves them.

        Several shapes side by side are as plausible as the best of them. One that only inner
        reversals show must explain more than a function of the actuation does: on ramps that all
        begin at rest, loops can be summed to any such function.
        """
        effect = self.in_place(self.single(way, base), base)
        if effect is not None and not all(_near(quantity) for quantity in effect.quantities()):
            return False
        some = self.candidates[self.options[way.effect][0].shape].effect
        return (
            not hypothesis_of(some).needs_reversals or self._static_share(way, base) <= MOST_STATIC
        )

    def _static_share(self, way: Option, base: tuple[int, ...]) -> float:
        """Share of what an effect explains that is a cubic of the actuation."""
        amplitudes = self.validation.amplitudes(base + way.picked)[len(base) :]
        part = (self.columns[..., list(way.picked)] @ amplitudes).reshape(len(self.columns), -1)
        part = part - part.mean(axis=0)
        known = self._cubics.T @ part
        return float(np.square(known).sum() / max(np.square(part).sum(), 1e-30))

    @cached_property
    def _cubics(self) -> np.ndarray:
        """(S, F) orthonormal basis of the cubics of the actuation."""
        x = self.problem.pressure
        pairs = (x[:, :, None] * x[:, None, :])[:, *np.triu_indices(x.shape[1])]
        return np.linalg.qr(np.hstack([np.ones((len(x), 1)), x, pairs, x**3]))[0]

    def freest(self, standing: Standing) -> tuple[int, ...]:
        """An effect's columns; beside a fitted one those of the grid that do best with it."""
        own = standing.option.picked
        shape = standing.option.shape
        if shape is None or not self.candidates[shape].fitted:
            return own
        ways = [w for w in self.options[standing.effect] if w.shape != shape]
        return min((own + w.picked for w in ways), key=lambda p: float(self.losses(p).sum()))

    def single(self, way: Option, base: tuple[int, ...] = ()) -> Option:
        """The way itself, or the best single shape of those that stand side by side in it."""
        if way.shape is not None:
            return way
        own = set(way.picked)
        ways = self.options[way.effect]
        singles = [w for w in ways if w.shape is not None and own.issuperset(w.picked)]
        return min(singles, key=lambda w: float(self.losses(base + w.picked).sum()))

    def in_place(self, way: Option, base: tuple[int, ...] = ()) -> Effect | None:
        """The effect of a single shape at the strengths that the race gives it beside a base."""
        key = (way.shape, base)
        if key not in self.fitted:
            amplitudes = self.validation.amplitudes(base + way.picked)[len(base) :]
            self.fitted[key] = self.candidates[way.shape].with_amplitudes(amplitudes)
        return self.fitted[key]

    def unique_gains(self, standings: list[Standing]) -> dict[str, float]:
        """Share of the squared error above the floor that only this effect explains.

        What comes back when it is left out of the best ways of all effects together.
        """
        together = {s.effect: s.option.picked for s in standings}
        total = self.excess(self.losses())
        everything = self.losses(sum(together.values(), ()))
        answer = {}
        for name in together:
            rest = sum((picked for other, picked in together.items() if other != name), ())
            answer[name] = float((self.losses(rest).sum() - everything.sum()) / total)
        return answer

    def parameters(self, standing: Standing) -> dict:
        """Name with unit -> value, of an effect in its best single shape as the race left it."""
        single = [way for way in self.options[standing.effect] if way.shape is not None]
        way = max(
            single,
            key=lambda w: float(self.log_ratio(self.losses(), self.losses(w.picked)).mean()),
        )
        effect = self.in_place(way)
        return {} if effect is None else {q.name: q.value for q in effect.quantities()}


def split_of(problem: Problem) -> Split:
    """Which rows are fitted and judged in turn; those of a reference are fitted and never judged.

    No effect acts on the latter.
    """
    pressure, direction, residual = problem.pressure, problem.direction, problem.residual
    block, fold = problem.block, problem.fold
    known = problem.reference
    if known is not None:
        pressure = np.concatenate([pressure, known.pressure])
        direction = np.concatenate([direction, known.direction])
        residual = np.concatenate([residual, KNOWN_WEIGHT * known.residual])
        block = np.concatenate([block, np.full(len(known.residual), len(fold))])
        fold = np.append(fold, FITTED)
    features = static_features(pressure, direction)
    features[len(problem.block) :] *= KNOWN_WEIGHT
    return Split.of(features, residual, block, fold, problem.surrogate_mm, problem.noise_mm)
