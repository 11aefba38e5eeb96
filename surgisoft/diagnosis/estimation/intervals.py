"""Intervals of an effect's quantities in physical units.

Rows of one block of time err together, so blocks are the samples: draws of the fit's values are
v + H^-1 sum_b xi_b g_b with g_b the slope of block b's misfit, H the curvature and xi standard
normal, whose covariance is the sandwich of Liang & Zeger (1986, eq. 7). Every draw goes through
`Effect.quantities`. With B blocks the draws are widened from normal to Student's t with B - 1
degrees of freedom.
"""

from dataclasses import asdict, dataclass

import numpy as np
from scipy import stats
from torch import Tensor

from surgisoft.diagnosis.estimation.least_squares import Fit, block_slopes, set_vector
from surgisoft.surrogate.effects import Effect

DRAWS = 400
"""Draws of the values."""
MOST_VALUES = 9
"""Most values of one quantity that are written out."""


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
    """Upper end of it."""
    unit: str
    """Unit; empty for a share."""
    plausible: bool
    """Whether the value lies in its plausible range."""
    plausible_range: tuple[float, float]
    """That range."""
    source: str
    """Where the range comes from."""

    @property
    def interval_text(self) -> str:
        """The interval in short; empty where the value was given or there are too many."""
        if np.size(self.value) > MOST_VALUES or self.low == self.high:
            return ""
        return f"{values_text(self.low)} to {values_text(self.high)}"

    def to_json(self) -> dict:
        """Plain values, the interval as `ci95`."""
        values = asdict(self)
        low, high = values.pop("low"), values.pop("high")
        return values | {"ci95": [low, high], "plausible_range": list(self.plausible_range)}


def values_text(value: float | list) -> str:
    """A value or nested values in short."""
    flat = np.asarray(value, float).ravel()
    if flat.size > MOST_VALUES:
        return f"{flat.size} values, least {flat.min():.3g}, largest {flat.max():.3g}"
    text = ", ".join(f"{number:.4g}" for number in flat)
    return text if flat.size == 1 else f"[{text}]"


def draws_of(fit: Fit, block: np.ndarray, number: int = DRAWS, seed: int = 0) -> np.ndarray:
    """(number, P) draws of the fit's values; block (S,): block of time of each row."""
    grams, slopes = block_slopes(fit, block)
    blocks = len(grams)
    centred = slopes - slopes.mean(0)
    curvature = grams.sum(0) + fit.hold
    curvature += 1e-9 * np.diag(curvature).max() * np.eye(len(curvature))
    moves = np.linalg.solve(curvature, centred.T)
    wider = stats.t.ppf(0.975, blocks - 1) / stats.norm.ppf(0.975)
    wider *= np.sqrt(blocks / (blocks - 1))
    signs = np.random.default_rng(seed).standard_normal((number, blocks))
    return fit.values + wider * signs @ moves.T


def intervals(
    effects: dict[str, Effect],
    parameters: dict[str, Tensor],
    fit: Fit,
    block: np.ndarray,
) -> list[Parameter]:
    """Every quantity of the fitted effects with its 95 % interval.

    effects: by name; parameters: those that the fit's values were written to, in order.
    """
    seen = []
    for values in draws_of(fit, block):
        set_vector(parameters, values)
        seen.append([quantity.value for e in effects.values() for quantity in e.quantities()])
    set_vector(parameters, fit.values)
    answer = []
    for name, effect in effects.items():
        for quantity in effect.quantities():
            drawn = np.array([row[len(answer)] for row in seen], float)
            low, high = np.quantile(drawn, [0.025, 0.975], axis=0).tolist()
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
                )
            )
    return answer
