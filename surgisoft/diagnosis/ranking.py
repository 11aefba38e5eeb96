"""Which effects explain what is left, alone and beside others, on held-out blocks."""

from dataclasses import dataclass, field

import numpy as np

from surgisoft.diagnosis.candidates import Candidate
from surgisoft.diagnosis.cross_validation import CrossValidation, static_features
from surgisoft.diagnosis.gates import family_p_values
from surgisoft.diagnosis.problem import Problem
from surgisoft.surrogate.effects import Effect


@dataclass(frozen=True, eq=False)
class Option:
    """One way to add an effect: one of its shapes, or all of them side by side."""

    effect: str
    """The effect's name."""
    picked: tuple[int, ...]
    """Its columns."""
    shape: int | None
    """Number of the candidate; None: all shapes."""


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
    cache: dict = field(default_factory=dict)
    """Losses by columns."""
    fitted: dict = field(default_factory=dict)
    """Effects at their strengths by shape and base."""

    @classmethod
    def of(cls, problem: Problem, candidates: list[Candidate]) -> "Race":
        """Prepare the race; afterwards every set of effects is cheap to try."""
        columns = [c.columns for c in candidates]
        residual = problem.residual
        columns = np.concatenate([np.zeros((*residual.shape, 0)), *columns], axis=3)
        features = static_features(problem.pressure, problem.direction)
        validation = CrossValidation.of(
            features,
            residual,
            columns,
            problem.block,
            problem.fold,
            problem.surrogate_mm,
            problem.noise_mm,
        )
        options: dict[str, list[Option]] = {}
        first = 0
        for number, candidate in enumerate(candidates):
            count = candidate.columns.shape[3]
            picked = tuple(range(first, first + count))
            options.setdefault(candidate.name, []).append(Option(candidate.name, picked, number))
            first += count
        for name, ways in options.items():
            if len(ways) > 1:
                ways.append(Option(name, sum((way.picked for way in ways), ()), None))
        noise = float(np.mean(problem.noise_mm**2))
        return cls(problem, candidates, validation, options, columns, validation.counts * noise)

    def losses(self, picked: tuple[int, ...] = ()) -> np.ndarray:
        """(B,) held-out sum of squared distances, mm^2, with the picked columns."""
        key = tuple(sorted(set(picked)))
        if key not in self.cache:
            self.cache[key] = self.validation.losses(key)
        return self.cache[key]

    def rmse_mm(self, losses: np.ndarray) -> float:
        """RMS distance of a key point, mm."""
        return float(np.sqrt(losses.sum() / self.validation.counts.sum()))

    def excess(self, losses: np.ndarray) -> float:
        """Squared error above the noise floor, mm^2."""
        return float(max(losses.sum() - self.floor.sum(), 0.02 * losses.sum(), 1e-30))

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
        chances = family_p_values(gains, [way.effect for way in ways])
        best: dict[str, Standing] = {}
        for i in np.argsort(-gains.mean(axis=1), kind="stable"):
            way, losses = ways[i], after[i]
            if way.effect not in best and self.plausible(way, base):
                gain = (before.sum() - losses.sum()) / self.excess(before)
                best[way.effect] = Standing(way.effect, way, losses, gains[i], chances[i], gain)
        return sorted(best.values(), key=lambda standing: -standing.log_gain.mean())

    def plausible(self, way: Option, base: tuple[int, ...] = ()) -> bool:
        """Whether an effect's parameters lie in their ranges as the race leaves them.

        All shapes side by side are as plausible as the best of them.
        """
        if way.shape is None:
            singles = [w for w in self.options[way.effect] if w.shape is not None]
            way = min(singles, key=lambda w: float(self.losses(base + w.picked).sum()))
        effect = self.in_place(way, base)
        return effect is None or effect.plausible()

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
