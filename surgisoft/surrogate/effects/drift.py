"""Drift effect: a slow change with elapsed time or with the temperature of the room.

`base`: the arm's holder yields, a rotation and shift of the whole body that grows towards a limit
like a Kelvin-Voigt element under a constant load (Findley 1976, ch. 5),

    g(t) = (1 - exp(-t / tau)) / (1 - exp(-600 s / tau)),      q = R(g turn) p + g shift,

or, where many such elements yield one after the other, with (t / tau)^power for t / tau (Kohlrausch
1854). `turn` and `shift` are the values after ten minutes; a tau of hours is a steady drift.

`actuation`: sensors and regulators of the chambers, or their walls, change with the same g(t),

    x_eff_i = x_i + g(t) (gain_i x_i + offset_i),      x = load.

`temperature`: actuation and wall change with the room's temperature, to first order

    x_eff_i = x_i + (T - T_0) / 10 K (gain x_i + offset_i).

Elapsed time comes from the recording where it is stated, and is the sum of the steps in a
simulated world; a temperature that is not known counts as T_0.
"""

import math

import torch
from torch import Tensor, nn

from surgisoft.errors import unknown_name
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
from surgisoft.surrogate.effects.hypothesis import Hypothesis, no_combinations
from surgisoft.surrogate.effects.readings import Reading, duration, each_axis, each_chamber
from surgisoft.surrogate.effects.rotation import rotate

KINDS = ("base", "actuation", "temperature")
ROOM_C = 22.0
"""T_0 where the recordings do not state it, degrees Celsius."""
TEN_KELVIN = 10.0
"""Change of temperature at which the amplitudes are given, K."""
TINY = 1e-9
"""Growth below which an exponential is its first term."""
MOST_LOG = 10.0
"""Logarithm of a time over tau from which the drift has ended."""
GRID = (200.0, 1000.0, 20000.0)
"""Times tau of the base that identification tries, s."""
FEW = (1000.0, 20000.0)
"""Times tau of the actuation, and of a base that yields with a power of the time, s."""
POWER = 0.5
"""Power of the time of a base that identification tries."""


class Drift(Effect):
    """A yielding holder, or gains and offsets that follow the time or the temperature."""

    stage: Stage = "body"

    def __init__(
        self,
        facts: ArmFacts,
        kind: str = "base",
        tau_s: float = 1000.0,
        reference_C: float | None = None,
        power: float | None = None,
    ):
        """Choose the kind of drift.

        kind: one of KINDS; tau_s: time constant of `base` and `actuation`; reference_C: T_0 in
        degrees Celsius (default: that of the room in which the arm was measured); power: of the
        time, 1 if None.
        """
        super().__init__(facts)
        if kind not in KINDS:
            raise unknown_name("kind of drift", kind, KINDS)
        if reference_C is None:
            reference_C = ROOM_C if facts.temperature_C is None else facts.temperature_C
        self.kind, self.reference_C = kind, float(reference_C)
        if kind == "base":
            self.turn = amplitude(3)
            self.shift = amplitude(3)
        else:
            self.stage = "material"
            chambers = len(facts.low)
            self.gain = amplitude(1 if kind == "temperature" else chambers)
            self.offset = amplitude(chambers)
        if kind != "temperature":
            self.log_tau = logarithm(tau_s)
            self.log_power = None if power is None else logarithm(power)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`turn` (3,) rad and `shift` (3,) mm, or `gain` and `offset` by chamber."""
        if self.kind == "base":
            return {"turn": self.turn, "shift": self.shift}
        return {"gain": self.gain, "offset": self.offset}

    @property
    def keeps_time(self) -> bool:
        """Whether the memory is the elapsed time, and not a warming."""
        return self.kind != "temperature"

    def rest(self, signal: Tensor) -> Tensor:
        """(B, 1) elapsed time, s, or warming over T_0, K: none."""
        return signal.new_zeros(len(signal), 1)

    def _warming(self, context: Context) -> Tensor:
        """(...) warming over T_0, K; 0 where the temperature is not known."""
        if context.temperature_C is None:
            return torch.zeros_like(context.dt_s)
        return (context.temperature_C - self.reference_C).nan_to_num(0.0)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, 1) elapsed time, s, or warming, K."""
        if self.kind == "temperature":
            return self._warming(context).unsqueeze(-1)
        if context.t_s is None:
            return memory + context.dt_s.unsqueeze(-1)
        return context.t_s.unsqueeze(-1)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, 1) elapsed time, s, or warming, K."""
        if self.kind == "temperature":
            return self._warming(context).unsqueeze(-1)
        if context.t_s is None:
            return memory.unsqueeze(1) + context.dt_s.cumsum(1).unsqueeze(-1)
        return context.t_s.unsqueeze(-1)

    def grown(self, elapsed_s: Tensor) -> Tensor:
        """Share of the drift after ten minutes that has come about after a time, s."""
        tau = self.log_tau.exp()
        if self.log_power is None:
            return torch.expm1(-elapsed_s / tau) / torch.expm1(-TEN_MINUTES / tau)
        power = self.log_power.exp()
        grown = torch.expm1(-((elapsed_s / tau).clamp(min=1e-9) ** power))
        return grown.where(elapsed_s > 0, 0 * grown) / torch.expm1(-((TEN_MINUTES / tau) ** power))

    def _share(self, memory: Tensor) -> Tensor:
        """(..., 1) share of the change of the actuation after ten minutes, or in 10 K."""
        return memory / TEN_KELVIN if self.kind == "temperature" else self.grown(memory)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Drifted key points (..., n, 3), mm, or effective actuation (..., m)."""
        if self.kind == "base":
            grown = self.grown(memory).unsqueeze(-2)
            return rotate(signal, grown * self.turn) + grown * self.shift
        share = self._share(memory)
        moved = self.gain * (signal - self.origin) + self.reach * self.offset
        return signal + share * moved

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(K, ..., n, 3) or (K, ..., m) change by each amplitude: closed form."""
        with torch.no_grad():
            if self.kind == "base":
                grown = self.grown(memory).unsqueeze(-2)
                axes = torch.eye(3, dtype=signal.dtype, device=signal.device)
                axes = axes.view(3, *[1] * (signal.ndim - 1), 3).expand(3, *signal.shape)
                turned = torch.linalg.cross(axes, signal.expand(axes.shape))
                return grown * torch.cat([turned, axes])
            share = self._share(memory)
            offsets = torch.diag_embed((share * self.reach).expand(signal.shape)).movedim(-1, 0)
            gain = share * (signal - self.origin)
            if self.kind == "temperature":
                return torch.cat([gain.unsqueeze(0), offsets])
            return torch.cat([torch.diag_embed(gain).movedim(-1, 0), offsets])

    def config(self) -> dict:
        """Kind, reference temperature and power of the time."""
        power = None
        if self.kind != "temperature" and self.log_power is not None:
            power = float(self.log_power.detach().exp())
        return {"kind": self.kind, "reference_C": self.reference_C, "power": power}

    def quantities(self) -> list[Quantity]:
        """Change after ten minutes or by 10 K, and the time constant (s)."""
        if self.kind == "base":
            held = "a holder that yields a little, not one that has come loose"
            tau = value_of(self.log_tau.exp())
            power = 1.0 if self.log_power is None else value_of(self.log_power.exp())
            return [
                Quantity("turn_in_10_min_rad", value_of(self.turn), "rad", -0.2, 0.2, held),
                Quantity("shift_in_10_min_mm", value_of(self.shift), "mm", -10.0, 10.0, held),
                Quantity("tau_s", tau, "s", 30.0, 1e6, "quicker is a misalignment"),
                Quantity("power", power, "", 0.3, 1.2, "Findley 1976, ch. 5: creep of plastics"),
            ]
        if self.kind == "actuation":
            part = "a regulator or wall that changes a little, not one that fails"
            tau = value_of(self.log_tau.exp())
            return [
                Quantity("gain_in_10_min_share", value_of(self.gain), "", -0.4, 0.4, part),
                Quantity("offset_in_10_min_share", value_of(self.offset), "", -0.3, 0.3, part),
                Quantity("tau_s", tau, "s", 30.0, 1e6, "quicker is another gain from the start"),
            ]
        rubber = "wide: an ideal rubber has 3 % in 10 K (modulus ~ T, Treloar 1975)"
        return [
            Quantity("gain_in_10_K_share", value_of(self.gain), "", -0.4, 0.4, rubber),
            Quantity("offset_in_10_K_share", value_of(self.offset), "", -0.3, 0.3, rubber),
        ]

    def _grown_in(self, seconds: float) -> float:
        """`grown` in double precision, also where tau is beyond all bounds."""
        power = 1.0 if self.log_power is None else float(self.log_power.detach().exp())
        tau = float(self.log_tau.detach())
        now, later = (
            math.exp(min(power * (math.log(t) - tau), MOST_LOG)) for t in (seconds, TEN_MINUTES)
        )
        if later < TINY:
            return (seconds / TEN_MINUTES) ** power
        return math.expm1(-now) / math.expm1(-later)

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Change over the recordings' time, or in 10 K: of the base (degrees, mm), or of gain (%)
        and offset (in the arm's unit) of each chamber."""
        span = seconds or TEN_MINUTES
        if self.kind == "temperature":
            grown, when = 1.0, f"in {TEN_KELVIN:.0f} K"
        else:
            grown = self._grown_in(span)
            when = f"in {duration(span)}"
        if self.kind == "base":
            turn, shift = grown * self.turn.detach(), (grown * self.shift.detach()).tolist()
            length = self.facts.length_mm or float(self.facts.rest_mm.norm(dim=-1).max()) or 1.0
            angles, moved = torch.rad2deg(turn).tolist(), (length * turn).tolist()
            return [
                *each_axis(f"base turned by {{+}} about {{axis}} {when}", angles, "degrees", moved),
                *each_axis(f"base shifted by {{+}} along {{axis}} {when}", shift, "mm", shift),
            ]
        gain, offset = grown * self.gain.detach(), grown * self.offset.detach()
        percent = (100 * gain).tolist()
        text = f"gain of chamber {{chamber}} {{+}} {when}"
        if self.kind == "temperature":
            gains = [Reading(f"gain {{+}} {when}", percent[0], "%", float(gain), signed=True)]
        else:
            gains = each_chamber(text, percent, "%", gain.tolist())
        offsets, unit = (self.reach * offset).tolist(), self.facts.unit
        text = f"offset of chamber {{chamber}} {{+}} {when}"
        return [*gains, *each_chamber(text, offsets, unit, offset.tolist())]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    timed = [("base", tau) for tau in GRID] + [("actuation", tau) for tau in FEW]
    slow = [Drift(facts, "base", tau, power=POWER) for tau in FEW]
    return [*(Drift(facts, *each) for each in timed), *slow, Drift(facts, "temperature")]


# A quick drift less a slow one would be none: an error from the start.
HYPOTHESIS = Hypothesis(Drift, _grid, combinations=no_combinations, moves_base=True)
