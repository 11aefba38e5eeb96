"""Creep effect: the wall goes on deforming under a held load, over decades of time.

Kelvin-Voigt elements with retardation times tau_k, spaced evenly in log(tau), each follow the load
with delay; their shares w_k are the log-normal spectrum that Wiechert (1893) proposed for real
solids. A narrow spectrum is a single time, a wide one the power law t^n (Findley 1976, ch. 5):

    z_k' = (g(x) - z_k) / tau_k,    g(x) = x |x|^(power - 1),
    w_k ~ exp(-(log(tau_k / tau) / width)^2 / 2),   sum_k w_k = 1,
    x_eff = x + amount sum_k w_k z_k,               x = load, 0 at rest and 1 at full actuation.

The load is held between two rows, and each element is integrated exactly.

Under a constant pressure or force the wall gives way further: the amount is positive. Under a
constant displacement, such as the pull of a tendon in mm, the wall and the tendon relax and the arm
goes back (Findley 1976, ch. 5): the amount is negative. There both signs are plausible, because the
body beside the tendons may creep, too.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    TEN_MINUTES,
    ArmFacts,
    Context,
    Effect,
    Quantity,
    amplitude,
    logarithm,
    value_of,
)
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import Reading, duration
from surgisoft.surrogate.scan import linear_scan
from surgisoft.units import is_displacement

TIMES = torch.logspace(-0.45, 2.55, 11, dtype=torch.float64)
"""(K,) retardation times, 0.35 to 350 s, a factor of 2 apart."""
HALVINGS = 30
"""Halvings in the search for the time after which half of the creep has come."""
SMALL = 1e-3
"""Load below which the power law is smoothed to a straight line."""
GRID = (
    (0.8, 0.5),
    (2.5, 0.5),
    (8.0, 0.5),
    (25.0, 0.5),
    (80.0, 0.5),
    (4.0, 1.6),
    (20.0, 2.0),
    (90.0, 2.5),
)
"""(tau in s, width in natural logarithms) that identification tries."""


class Creep(Effect):
    """Delayed loads with a spectrum of retardation times, equal for all chambers."""

    times: Tensor

    stage = "material"

    def __init__(
        self, facts: ArmFacts, tau_s: float = 10.0, width: float = 1.5, power: float = 1.0
    ):
        """Centre of the spectrum, s, its width in natural logarithms, and the load's power."""
        super().__init__(facts)
        self.register_buffer("times", TIMES.float(), persistent=False)
        self.amount = amplitude(1)
        self.log_tau = logarithm(tau_s)
        self.log_width = logarithm(width)
        self.log_power = logarithm(power)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`amount` (1,): creep under full load after infinite time, as a share of the load."""
        return {"amount": self.amount}

    def memory_parameters(self) -> list[nn.Parameter]:
        """The load's power; the spectrum only weighs the elements and is no part of it."""
        return [self.log_power]

    @property
    def spectrum(self) -> Tensor:
        """(K,) share of each retardation time."""
        distance = (self.times.log() - self.log_tau) / self.log_width.exp()
        return torch.softmax(-0.5 * distance.square(), dim=0)

    def pull(self, signal: Tensor) -> Tensor:
        """(..., m) the load to its power, from the actuation (..., m)."""
        x = self.load(signal)
        return x * (x.square() + SMALL**2).pow((self.log_power.exp() - 1) / 2)

    def rest(self, signal: Tensor) -> Tensor:
        """(B, m, K) elements that have not crept yet, as after a long time at no load."""
        return signal.new_zeros(*signal.shape, len(self.times))

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, m, K) retarded loads after the actuation (B, m)."""
        keep = torch.exp(-context.dt_s[..., None, None] / self.times)
        return keep * memory + (1 - keep) * self.pull(signal).unsqueeze(-1)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, m, K) retarded loads along the actuation (R, T, m)."""
        keep = torch.exp(-context.dt_s[..., None, None] / self.times)
        return linear_scan(keep, (1 - keep) * self.pull(signal).unsqueeze(-1), memory)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m) and retarded loads (..., m, K)."""
        return signal + self.amount * self.reach * (memory @ self.spectrum)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(1, ..., m) delayed actuation: closed form."""
        return (self.reach * (memory @ self.spectrum)).unsqueeze(0).detach()

    def config(self) -> dict:
        """No arguments: tensors hold everything."""
        return {}

    def quantities(self) -> list[Quantity]:
        """Amount, centre (s) and width of the spectrum, and the power of the load."""
        low, why = 0.0, "wide: at most as much again as at once; a solid does not creep backwards"
        if is_displacement(self.facts.unit):
            low, why = -1.0, "wide: at most all of it is lost to relaxation, or as much again added"
        return [
            Quantity("amount_share", value_of(self.amount), "", low, 1.0, why),
            Quantity(
                "tau_s",
                value_of(self.log_tau.exp()),
                "s",
                0.1,
                2000.0,
                "around the times of the elements",
            ),
            Quantity(
                "width_log",
                value_of(self.log_width.exp()),
                "",
                0.1,
                6.0,
                "one time alone, to evenly over all decades",
            ),
            Quantity(
                "power",
                value_of(self.log_power.exp()),
                "",
                0.3,
                3.0,
                "wide: 1 is a linear solid (Findley 1976, ch. 5)",
            ),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Creep under a load that is held as long as the recordings last (%), and its half (s)."""
        held = seconds or TEN_MINUTES
        times, spectrum = self.times.double(), self.spectrum.detach().double()

        rates = times.reciprocal()

        def crept(after: float) -> float:
            return float(-spectrum @ torch.expm1(rates * -after))

        low, high, whole = 0.0, held, crept(held)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if 2 * crept(middle) > whole else (middle, high)
        grown = 100 * float(self.amount.detach()) * whole
        text = f"push under a full load held for {duration(held)} {{+}}"
        return [
            Reading(text, grown, "%", signed=True),
            Reading("half of the creep comes within {}", high, "s"),
        ]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    return [Creep(facts, tau, width) for tau, width in GRID]


HYPOTHESIS = Hypothesis(Creep, _grid, memory="time")
