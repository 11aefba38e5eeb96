"""Creep effect: the wall goes on deforming under a held load, over decades of time.

Kelvin-Voigt elements with retardation times tau_k, spaced evenly in log(tau), each follow the load
with delay; their shares w_k are the log-normal spectrum that Wiechert (1893) proposed for real
solids. A narrow spectrum is a single time, a wide one the power law t^n (Findley 1976, ch. 5):

    z_k' = (g(x) - z_k) / tau_k,    g(x) = x |x|^(power - 1),
    w_k ~ exp(-(log(tau_k / tau) / width)^2 / 2),   sum_k w_k = 1,
    x_eff = x + amount sum_k w_k z_k,               x = load, 0 at rest and 1 at full actuation.

The load is held between two rows, and each element is integrated exactly.

*Of the body.* A wall creeps under all that bends it, weight included, and each part by its own
strain. So the elements follow the bending b_j and the stretch e_j beyond those at rest at each
node j of the body (`bent_body`), and the solid is linear (Boltzmann 1874):

    b_j -> b_j + amount sum_k w_k z_k(b_j),    e_j -> e_j + stretch sum_k w_k z_k(e_j).

Strains count from those that the model predicts at rest, which are a little off its shape at rest:
an arm that has hung for long enough has crept under its weight, and rests.

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
    Stage,
    amplitude,
    logarithm,
    value_of,
)
from surgisoft.surrogate.effects.bent_body import SLENDERNESS, BentBody, most_strained
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
    """Delayed loads, equal for all chambers, or strains, with a spectrum of retardation times."""

    times: Tensor
    log_power: nn.Parameter
    """Logarithm of the load's power; None of the body."""
    stretch: nn.Parameter
    bent: BentBody
    stage: Stage = "material"

    def __init__(
        self,
        facts: ArmFacts,
        tau_s: float = 10.0,
        width: float = 1.5,
        power: float = 1.0,
        body: bool = False,
    ):
        """Choose the spectrum and what creeps.

        tau_s: centre of the spectrum, s; width: its width in natural logarithms; power: that of the
        load; body: the strains of the body in place of loads, for which the power does not matter.
        """
        super().__init__(facts)
        self.body = bool(body)
        self.register_buffer("times", TIMES.float(), persistent=False)
        self.amount = amplitude(1)
        self.log_tau = logarithm(tau_s)
        self.log_width = logarithm(width)
        self.register_parameter("log_power", None if self.body else logarithm(power))
        if self.body:
            self.stage = "body"
            self.stretch = amplitude(1)
            self.bent = BentBody(facts.rest_mm)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`amount` (1,): creep after infinite time, as a share of the load at full load; of the
        body as a share of its bending, and `stretch` (1,) as a share of its stretch."""
        return {"amount": self.amount} | ({"stretch": self.stretch} if self.body else {})

    def memory_parameters(self) -> list[nn.Parameter]:
        """The load's power, if there is one; the spectrum only weighs the elements."""
        return [] if self.body else [self.log_power]

    @property
    def follows(self) -> bool:
        """True: a wall, of loads or of the body."""
        return True

    @property
    def spectrum(self) -> Tensor:
        """(K,) share of each retardation time."""
        distance = (self.times.log() - self.log_tau) / self.log_width.exp()
        return torch.softmax(-0.5 * distance.square(), dim=0)

    def pull(self, signal: Tensor) -> Tensor:
        """What the elements follow: (..., m) the load to its power, from the actuation (..., m).

        Of the body: (..., K, 4) bending of its K nodes and SLENDERNESS times their stretch beyond
        those at rest, rad, from its key points (..., n, 3), mm.
        """
        if self.body:
            bend, stretch = self.bent.beyond_rest(signal)
            return torch.cat([bend, SLENDERNESS * stretch.unsqueeze(-1)], dim=-1)
        x = self.load(signal)
        return x * (x.square() + SMALL**2).pow((self.log_power.exp() - 1) / 2)

    def rest(self, signal: Tensor) -> Tensor:
        """(B, ..., K) elements that have not crept yet, as after a long time at no load.

        Of the body (B, ..., K + 1), the last being the pull at rest, from which strains count.
        """
        pull = self.pull(signal)
        elements = pull.new_zeros(*pull.shape, len(self.times))
        return torch.cat([elements, pull.unsqueeze(-1)], dim=-1) if self.body else elements

    def _keep(self, context: Context, pull: Tensor) -> Tensor:
        """What the elements keep of their way over a row, broadcast to (..., K) of a pull
        (..., 1)."""
        dt = context.dt_s.reshape(*context.dt_s.shape, *[1] * (pull.dim() - context.dt_s.dim()))
        return torch.exp(-dt / self.times)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, ..., K) elements after the signal (B, ...)."""
        pull = self.pull(signal).unsqueeze(-1)
        keep = self._keep(context, pull)
        if not self.body:
            return keep * memory + (1 - keep) * pull
        elements, still = memory[..., :-1], memory[..., -1:]
        return torch.cat([keep * elements + (1 - keep) * (pull - still), still], dim=-1)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, ..., K) elements along the signal (R, T, ...)."""
        pull = self.pull(signal).unsqueeze(-1)
        keep = self._keep(context, pull)
        if not self.body:
            return linear_scan(keep, (1 - keep) * pull, memory)
        elements, still = memory[..., :-1], memory[..., -1:].unsqueeze(1)
        followed = linear_scan(keep, (1 - keep) * (pull - still), elements)
        return torch.cat([followed, still.expand(*followed.shape[:-1], 1)], dim=-1)

    def _crept(self, signal: Tensor, memory: Tensor) -> tuple[Tensor, ...]:
        """Changes of the signal, in its shape, at each amplitude of one."""
        retarded = memory[..., : len(self.times)] @ self.spectrum
        if self.body:
            bend, stretch = retarded[..., :3], retarded[..., 3] / SLENDERNESS
            return self.bent.bent_further(signal, bend, stretch)
        return (self.reach * retarded,)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Signal behind the effect, in its shape, from the elements (..., K)."""
        return self.with_changes(signal, self._crept(signal, memory))

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(1, ...), of the body (2, ...), change of the signal by each amplitude: closed form."""
        with torch.no_grad():
            return torch.stack(self._crept(signal, memory))

    def config(self) -> dict:
        """Whether the body creeps; tensors hold everything else."""
        return {"body": self.body}

    def quantities(self) -> list[Quantity]:
        """Amounts, centre (s) and width of the spectrum, and the power of the load."""
        low, why = 0.0, "wide: at most as much again as at once; a solid does not creep backwards"
        if is_displacement(self.facts.unit):
            low, why = -1.0, "wide: at most all of it is lost to relaxation, or as much again added"
        spectrum = [
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
        ]
        amount = Quantity("amount_share", value_of(self.amount), "", low, 1.0, why)
        if self.body:
            little = min(low, -0.1)
            stretch = Quantity("stretch_share", value_of(self.stretch), "", little, 1.0, why)
            return [amount, stretch, *spectrum]
        linear = "wide: 1 is a linear solid (Findley 1976, ch. 5)"
        power = Quantity("power", value_of(self.log_power.exp()), "", 0.3, 3.0, linear)
        return [amount, *spectrum, power]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Creep under a load that is held as long as the recordings last (%), and its half (s); of
        the body that of its bending and of its stretch."""
        held = seconds or TEN_MINUTES
        times, spectrum = self.times.double(), self.spectrum.detach().double()

        rates = times.reciprocal()

        def crept(after: float) -> float:
            return float(-spectrum @ torch.expm1(rates * -after))

        low, high, whole = 0.0, held, crept(held)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if 2 * crept(middle) > whole else (middle, high)
        grown = [100 * float(each.detach()) * whole for each in self.amplitudes().values()]
        what = ("bending", "stretch") if self.body else ("push",)
        load = "load" if self.body else "full load"
        held_for = f"under a {load} held for {duration(held)} {{+}}"
        return [
            *(
                Reading(f"{each} {held_for}", more, "%", signed=True)
                for each, more in zip(what, grown, strict=True)
            ),
            Reading("half of the creep comes within {}", high, "s"),
        ]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """Spectra of the loads, and of the strains of a body that does not rest."""
    moves = bool(most_strained(facts.rest_mm, points))
    forms = (False, True) if moves else (False,)
    return [Creep(facts, tau, width, body=body) for body in forms for tau, width in GRID]


def _together(some: list[Effect]) -> list[list[int]]:
    """All spectra of the loads side by side; one of the body stands alone."""
    return [[i for i, each in enumerate(some) if not getattr(each, "body", False)]]


HYPOTHESIS = Hypothesis(Creep, _grid, combinations=_together, memory="time")
