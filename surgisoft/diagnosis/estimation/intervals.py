"""Intervals of an effect's quantities in physical units, and a test of its amplitudes.

The values v of a fit err by H^-1 (e_1 + e_2 + e_3), with H the curvature of the misfit and

- e_1 the noise, and all else that neighbouring rows share: rows of one block of time err together,
  so blocks are the samples (Liang & Zeger 1986, eq. 7). A block's residual is taken less the model
  discrepancy that the *other* blocks give (cluster jackknife: MacKinnon & White 1985; Bell &
  McCaffrey 2002). Less its own fit it would be too small, and with the discrepancy left in it the
  network's error would count here and again in e_2;
- e_2 the network's own error (model discrepancy, Kennedy & O'Hagan 2001), which resembles the
  effect a little. A recording shows one such error, however long it is, so its blocks do not tell
  by how much it moves the values. Its covariance is that of `network_error`, at the validated size
  or, where it is larger, at that of what the fit leaves. For a model without a network it is that
  of the random function of `discrepancy`, J' W K W J with K = F F' times the covariance along the
  body;
- e_3 what holds values near their start where the rows say little: the spread of that prior.

Draws from that covariance go through `Effect.quantities`; their quantiles are at p (N + 1) of N
draws, between which a further draw lies with the stated probability (Weibull 1939; Hyndman & Fan
1996, type 6). With B blocks the first part is widened
from normal to Student's t with B - 1 degrees of freedom. Fits from other starts that end elsewhere
at about the same misfit take their share of the draws.

`surgisoft benchmark intervals` measures how often the intervals hold.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtrc, ndtri, stdtrit
from torch import Tensor

from surgisoft.diagnosis.discrepancy import body_covariance
from surgisoft.diagnosis.estimation.least_squares import Fit, set_vector
from surgisoft.diagnosis.estimation.network_error import NetworkError
from surgisoft.diagnosis.residuals import Problem
from surgisoft.diagnosis.statistics import block_sums
from surgisoft.surrogate.effects import Effect, in_words
from surgisoft.surrogate.model import ArmModel

DRAWS = 400
"""Draws of the values."""
NEGLIGIBLE = 1e-6
"""Share of the largest plausible value that counts as zero: a value that is fitted by its logarithm
reaches no zero, where its plausible range may begin."""
NEARLY_ALL = 0.95
"""Share of the plausible range from which on an interval covers nearly all of it [-]."""
RELATIVELY = 0.1
"""Width of the interval of a difference, as a share of those of both values, up to which the values
are said to be known relative to each other only [-]."""
MOST_VALUES = 9
"""Most values of one quantity that are written out."""


@dataclass(frozen=True)
class Relative:
    """Values of one quantity whose differences are known, unlike the values: their common part has
    no effect on the arm, as that of the zeros of all channels of an arm that does not stretch."""

    numbers: tuple[int, ...]
    """Numbers of the values, from 1 on, as chambers are counted."""
    value: tuple[float, ...]
    """Each value less the mean of these."""
    low: tuple[float, ...]
    """Lower ends of the 95 % intervals of these."""
    high: tuple[float, ...]
    """Upper ends."""

    @property
    def text(self) -> str:
        """What is known, in words."""
        names = f"{', '.join(map(str, self.numbers[:-1]))} and {self.numbers[-1]}"
        low, high = values_text(list(self.low)), values_text(list(self.high))
        return (
            f"the values {names} are known relative to each other: less their mean "
            f"{values_text(list(self.value))} ({low} to {high})"
        )


@dataclass(frozen=True)
class Parameter:
    """One quantity of an effect with its interval, as a person reads it."""

    effect: str
    """Name of the effect."""
    name: str
    """Name of the quantity, with its unit as suffix."""
    value: float | list
    """Value, or nested values, one a chamber or an axis."""
    low: float | list
    """Lower end of the 95 % interval, shaped as the value."""
    high: float | list
    """Upper end of the 95 % interval, shaped as the value."""
    unit: str
    """Unit; empty for a share."""
    plausible: bool
    """Whether the value lies in its plausible range."""
    plausible_range: tuple[float, float]
    """Lowest and highest plausible value."""
    source: str
    """Where the range comes from."""
    before: float | list | None = None
    """Value that the model had before; None where it lacked the effect."""
    relative: tuple[Relative, ...] = ()
    """Groups of its values whose differences are known far better than the values."""

    @property
    def may_be_plausible(self) -> bool:
        """Whether every value may lie in the plausible range, as far as its interval tells.

        A recording of minutes leaves a time constant of hours undetermined: the estimate may then
        lie beyond the range while the interval reaches far into it.
        """
        least, most = self.plausible_range
        low, high = np.asarray(self.low, float), np.asarray(self.high, float)
        return self.plausible or bool(np.all((low <= most) & (high >= least)))

    @property
    def identifiable(self) -> bool:
        """Whether the recordings tell more of the value than its plausible range does.

        They do not where the 95 % interval covers NEARLY_ALL of that range for every value and no
        differences of values are known either (`relative`): practical non-identifiability (Raue et
        al. 2009), such as of a time constant of hours in a recording of minutes.
        """
        return bool(self.relative) or not bool(np.all(self._covered >= NEARLY_ALL))

    @property
    def _covered(self) -> np.ndarray:
        """Share of the plausible range that the interval of each value covers.

        By the logarithm where the range has no negative values, because it spans decades; one that
        begins at zero is taken from NEGLIGIBLE of its end on. Nothing is covered of a range without
        a finite width.
        """
        least, most = self.plausible_range
        least = NEGLIGIBLE * most if least == 0.0 else least
        if not 0.0 < most - least < np.inf:
            return np.zeros(np.shape(self.low))
        inside = np.clip([self.low, self.high], least, most)
        ends = np.array([least, most])
        if least > 0.0:
            inside, ends = np.log(inside), np.log(ends)
        return (inside[1] - inside[0]) / (ends[1] - ends[0])

    @property
    def interval_text(self) -> str:
        """The interval in short; empty where the value was given or there are too many."""
        if np.size(self.value) > MOST_VALUES or self.low == self.high:
            return ""
        text = f"{values_text(self.low)} to {values_text(self.high)}"
        if self.identifiable:
            return "; ".join([text, *(each.text for each in self.relative)])
        least, most = self.plausible_range
        part = "all" if np.all(self._covered >= 1.0) else "nearly all"
        return (
            f"not identifiable from these recordings: the 95 % interval covers {part} plausible "
            f"values, {values_text(least)} to {values_text(most)}"
        )

    def to_json(self) -> dict:
        """Plain values, the interval as `ci95`."""
        values = asdict(self)
        low, high = values.pop("low"), values.pop("high")
        return values | {
            "ci95": [low, high],
            "identifiable": self.identifiable,
            "plausible_range": list(self.plausible_range),
        }


def values_text(value: float | list) -> str:
    """A value or nested values in short."""
    flat = np.asarray(value, float).ravel()
    if flat.size > MOST_VALUES:
        return f"{flat.size} values, least {flat.min():.3g}, largest {flat.max():.3g}"
    text = ", ".join(f"{number:.4g}" for number in flat)
    return text if flat.size == 1 else f"[{text}]"


class Estimates(NamedTuple):
    """What a fit tells of its effects."""

    parameters: list[Parameter]
    """Every quantity with its interval."""
    in_words: dict[str, str]
    """What the quantities mean, by effect (`Effect.readings`); empty where nothing is known."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fit with the covariance of its values."""

    fit: Fit
    """The fit."""
    curvature: np.ndarray
    """(P, P) H, half the second derivative of the misfit and of what holds the values, mm^2."""
    meat: np.ndarray
    """(P, P) covariance of e_1 + e_2 + e_3, mm^4."""

    @property
    def covariance(self) -> np.ndarray:
        """(P, P) of the values."""
        inverse = np.linalg.inv(self.curvature)
        return inverse @ self.meat @ inverse.T

    def draws(self, number: int, rng: np.random.Generator) -> np.ndarray:
        """(number, P) draws of the values."""
        values, vectors = np.linalg.eigh(self.covariance)
        spread = vectors * np.sqrt(np.maximum(values, 0.0))
        return self.fit.values + rng.standard_normal((number, len(values))) @ spread.T


def with_covariance(fit: Fit, problem: Problem, network: NetworkError | None) -> Fitted:
    """A fit to a problem's rows with the covariance of its values.

    network: prior of the error of the model's network, None where it has none.
    """
    weighted = fit.nuisance.weighted(fit.jacobian)
    count = weighted.shape[-1]
    held_out = fit.nuisance.held_out(fit.residual, problem.block)
    slopes = block_sums((weighted * held_out[..., None]).sum((1, 2)), problem.block)
    blocks = len(slopes)
    centred = slopes - slopes.mean(0)
    wider = stdtrit(blocks - 1, 0.975) / ndtri(0.975)
    meat = centred.T @ centred * wider**2 * blocks / (blocks - 1)
    larger = _beyond_tolerance(fit, problem)
    if network is not None:
        pulls = network.pulls(weighted)
        meat += larger * (pulls @ pulls.T)
    else:
        # (n, 3, F, P) how each feature of the discrepancy pulls at the values.
        pull = np.einsum("sf,sncp->ncfp", fit.nuisance.features, weighted, optimize=True)
        body = body_covariance(problem.discrepancy_mm)
        meat += larger * np.einsum("kcfp,kl,lcfq->pq", pull, body, pull, optimize=True)
    meat += fit.hold @ (fit.prior_variance[:, None] * fit.hold)
    curvature = weighted.reshape(-1, count).T @ fit.jacobian.reshape(-1, count)
    curvature = (curvature + curvature.T) / 2 + fit.hold
    curvature += 1e-9 * np.diag(curvature).max() * np.eye(count)
    return Fitted(fit, curvature, meat)


def _beyond_tolerance(fit: Fit, problem: Problem) -> float:
    """Mean square that a fit leaves, noise taken off, over that which the right effect may leave.

    At least 1. A network that is off by more than it was validated to be errs by as much in the
    direction of the effect, too.
    """
    left = np.nanmean(np.square(fit.residual).sum(-1)) - np.mean(problem.noise_mm**2)
    return max(1.0, float(left / np.mean(problem.tolerance_mm**2)))


def p_value(fitted: Fitted, amplitudes: np.ndarray) -> float:
    """Probability of so large amplitudes if there were no effect (Wald 1943).

    amplitudes: (P,) bool. Without an effect its nonlinear parameters mean nothing, and a fit
    chooses those with which the amplitudes are largest (Davies 1977). So they are tested at the
    fitted nonlinear parameters, and all free values count as degrees of freedom.
    """
    among = np.ix_(amplitudes, amplitudes)
    pull = fitted.curvature[among] @ fitted.fit.values[amplitudes]
    meat = fitted.meat[among]
    meat = meat + 1e-12 * np.trace(meat) * np.eye(len(meat))
    return float(chdtrc(len(amplitudes), float(pull @ np.linalg.solve(meat, pull))))


def intervals(
    effects: dict[str, Effect],
    parameters: Mapping[str, Tensor],
    fit: Fitted,
    others: Sequence[Fitted] = (),
    seconds: float | None = None,
) -> Estimates:
    """Every quantity of the fitted effects with its 95 % interval, and what they mean in words.

    effects: by name; parameters: those that the fit's values were written to, in order. others:
    fits of the same values that ended elsewhere; each has the share of the draws that its
    likelihood gives it. seconds: time that the recordings cover, s.
    """
    rng = np.random.default_rng(0)
    weights = np.array([each.fit.likelihood(fit.fit.misfit) for each in (fit, *others)])
    counts = np.round(DRAWS * weights / weights.sum()).astype(int)
    seen: list[list] = []
    read: list[list[float]] = []
    for each, count in zip((fit, *others), counts, strict=True):
        for values in each.draws(count, rng):
            set_vector(parameters, values)
            seen.append([quantity.value for e in effects.values() for quantity in e.quantities()])
            read.append([r.value for e in effects.values() for r in e.readings(seconds)])
    set_vector(parameters, fit.fit.values)
    answer: list[Parameter] = []
    for name, effect in effects.items():
        for quantity in effect.quantities():
            drawn = [row[len(answer)] for row in seen]
            low, high = _ends(drawn)
            answer.append(
                Parameter(
                    effect=name,
                    name=quantity.name,
                    value=quantity.value,
                    low=low,
                    high=high,
                    unit=quantity.unit,
                    plausible=quantity.plausible,
                    plausible_range=(quantity.low, quantity.high),
                    source=quantity.source,
                    relative=tuple(_relative(quantity.value, drawn)),
                )
            )
    ends, words = iter(zip(*_ends(read), strict=True)), {}
    for name, effect in effects.items():
        readings = effect.readings(seconds)
        words[name] = in_words(readings, [next(ends) for _ in readings])
    return Estimates(answer, words)


def _ends(drawn: list) -> list:
    """Ends of the 95 % interval of drawn values, each shaped as one of them."""
    values = np.array(drawn, dtype=np.float64)
    return np.quantile(values, [0.025, 0.975], axis=0, method="weibull").tolist()


def _relative(value: float | list, drawn: list) -> Iterator[Relative]:
    """Groups of a quantity's values that are known relative to each other only.

    drawn: draws of the value, each shaped as it is.
    """
    values, draws = np.asarray(value, float), np.array(drawn, np.float64)
    if values.ndim != 1 or len(values) < 2:
        return
    wide = np.ptp(_ends(drawn), axis=0)
    apart = np.ptp(_ends((draws[:, :, None] - draws[:, None]).tolist()), axis=0)
    near = (apart <= RELATIVELY * np.minimum.outer(wide, wide)) & (wide > 0.0)
    count, group = connected_components(near | near.T, directed=False)
    for number in range(count):
        mine = np.flatnonzero(group == number)
        if len(mine) < 2:
            continue
        low, high = _ends((draws[:, mine] - draws[:, mine].mean(axis=1, keepdims=True)).tolist())
        shown = values[mine] - values[mine].mean()
        numbers = tuple((mine + 1).tolist())
        yield Relative(numbers, tuple(shown.tolist()), tuple(low), tuple(high))


def beside_former(
    found: Estimates, model: ArmModel, seconds: float | None
) -> tuple[tuple[Parameter, ...], dict[str, str]]:
    """Parameters and words of effects, with those that a model had before, where it has them.

    seconds: time that the recordings cover, s.
    """
    had = {name: model.effects[name] for name in found.in_words if name in model.effects}
    former = {(name, q.name): q.value for name, effect in had.items() for q in effect.quantities()}
    parameters = (
        replace(each, before=former.get((each.effect, each.name))) for each in found.parameters
    )
    words = dict(found.in_words)
    for name, effect in had.items():
        then = in_words(effect.readings(seconds))
        words[name] = f"{words[name]}; before: {then}" if words[name] and then else words[name]
    return tuple(parameters), words
