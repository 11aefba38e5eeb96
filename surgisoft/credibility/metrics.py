"""Numbers of a comparison: error, validation uncertainty, area metric, and what passes a limit."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, wasserstein_distance

COVERAGE_FACTOR = float(norm.ppf(0.975))
"""Factor from a standard to an expanded uncertainty at 95 % of a normal distribution (1.96; V&V
20-2009 rounds it to 2)."""


def area_metric(predicted: np.ndarray, measured: np.ndarray) -> float:
    """Area between the empirical distribution functions of two samples, in their unit.

    d = integral |F(y) - S_n(y)| dy (Ferson, Oberkampf & Ginzburg 2008; Roy & Oberkampf 2011, doi
    10.1016/j.cma.2011.03.016), which is the Wasserstein distance of order 1. NaN is left
    out of either sample; NaN where one has no values. It compares how often values come, not when:
    the comparison error looks at each instant.
    """
    ours, theirs = (np.asarray(v, float)[np.isfinite(v)] for v in (predicted, measured))
    if not len(ours) or not len(theirs):
        return float("nan")
    return float(wasserstein_distance(ours, theirs))


def area_in_space(predicted_mm: np.ndarray, measured_mm: np.ndarray) -> float:
    """Area metric of points (S, 3) in space, mm: root of the sum of squares over x, y and z.

    Only rows that were measured count in both.
    """
    seen = np.isfinite(measured_mm).all(1)
    parts = [area_metric(predicted_mm[seen, k], measured_mm[seen, k]) for k in range(3)]
    return float(np.sqrt(np.sum(np.square(parts))))


@dataclass(frozen=True)
class ValidationUncertainty:
    """Standard uncertainties of a comparison, RMS distances in mm; None where one is not known.

    u_val^2 = u_D^2 + u_input^2 + u_parameters^2 + u_num^2 for independent parts (V&V 20-2009;
    there parameters are part of the inputs).
    """

    noise_mm: float | None
    """u_D: noise of the measurement."""
    input_mm: float | None
    """u_input: what uncertain actuation does to the prediction."""
    parameters_mm: float | None
    """u_parameters: what uncertain parameters of the model do to it."""
    numerical_mm: float | None
    """u_num: what the steps of time do to it."""

    @property
    def standard_mm(self) -> float:
        """u_val, of the parts that are known, mm."""
        parts = (self.noise_mm, self.input_mm, self.parameters_mm, self.numerical_mm)
        return float(np.sqrt(sum(part**2 for part in parts if part is not None)))

    @property
    def expanded_mm(self) -> float:
        """U_val at 95 %, mm."""
        return COVERAGE_FACTOR * self.standard_mm

    @property
    def unknown(self) -> tuple[str, ...]:
        """Parts that are not known and count as zero."""
        parts = {
            "noise": self.noise_mm,
            "input": self.input_mm,
            "parameters": self.parameters_mm,
            "numerical": self.numerical_mm,
        }
        return tuple(name for name, value in parts.items() if value is None)


@dataclass(frozen=True)
class Criterion:
    """One acceptance criterion of the user and whether it is met."""

    name: str
    """What is compared with the limit, in words."""
    value: float
    """The value; not finite where it is not known."""
    limit: float
    """The user's limit."""
    unit: str
    """Unit of both; empty for a share."""
    least: bool = False
    """Whether the limit is the least value that passes, not the largest."""

    @property
    def passed(self) -> bool:
        """Whether the criterion is met; an unknown value does not meet it."""
        if not np.isfinite(self.value):
            return False
        return self.value >= self.limit if self.least else self.value <= self.limit

    def to_json(self) -> dict:
        """Plain values."""
        return {
            "name": self.name,
            "value": self.value,
            "limit": self.limit,
            "unit": self.unit,
            "kind": "least" if self.least else "largest",
            "passed": self.passed,
        }
