"""Inertia effect: the arm swings after its actuation changes.

The first bending mode is an under-damped oscillator that the actuation drives (Meirovitch 2001,
ch. 8):

    y'' + 2 damping w y' + w^2 y = w^2 p,      w = 2 pi frequency,
    p_eff = p + share (y - p).

The actuation is held between two rows and the oscillator integrated exactly: with the poles
l = w (-damping + i sqrt(1 - damping^2)), the complex number Q = y' - conj(l) y obeys
Q' = l Q + w^2 p, a linear recurrence.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Context,
    Effect,
    Quantity,
    amplitude,
    logarithm,
    value_of,
)
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import MOST_PERCENT, Reading
from surgisoft.surrogate.scan import linear_scan

GRID = (
    (0.5, 0.1),
    (1.0, 0.1),
    (2.0, 0.1),
    (4.0, 0.1),
    (0.5, 0.4),
    (1.0, 0.4),
    (2.0, 0.4),
    (4.0, 0.4),
)
"""(frequency in Hz, damping ratio) that identification tries."""


class Inertia(Effect):
    """An under-damped second-order response, equal for all chambers."""

    stage = "material"

    def __init__(self, facts: ArmFacts, frequency_Hz: float = 2.0, damping: float = 0.2):
        """frequency_Hz: undamped frequency; damping: damping ratio between 0 and 1."""
        super().__init__(facts)
        self.share = amplitude(1)
        self.log_frequency = logarithm(frequency_Hz)
        self.damping_logit = nn.Parameter(torch.tensor([math.log(damping / (1 - damping))]))

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`share` (1,) of the actuation that the oscillator delays; 1: all of it."""
        return {"share": self.share}

    def memory_parameters(self) -> list[nn.Parameter]:
        """Frequency and damping ratio, each (1,)."""
        return [self.log_frequency, self.damping_logit]

    def _pole(self) -> tuple[Tensor, Tensor]:
        """(1,) pole l over w, complex, and w in rad/s."""
        damping = self.damping_logit.sigmoid()
        return torch.complex(-damping, (1 - damping.square()).sqrt()), (
            2 * math.pi * self.log_frequency.exp()
        )

    def _drive(self, signal: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Factor (..., 1) and addend (..., m) of the recurrence of Q / w."""
        pole, w = self._pole()
        keep = torch.exp(pole * (w * dt).unsqueeze(-1))
        return keep, (keep - 1) * pole.conj() * signal

    def _to_mode(self, memory: Tensor) -> Tensor:
        """(..., m) Q / w from y and y' / w (..., m, 2)."""
        return memory[..., 1] - self._pole()[0].conj() * memory[..., 0]

    def _from_mode(self, mode: Tensor) -> Tensor:
        """(..., m, 2) y and y' / w from Q / w."""
        pole = self._pole()[0]
        y = mode.imag / pole.imag
        return torch.stack([y, mode.real + pole.real * y], dim=-1)

    def rest(self, signal: Tensor) -> Tensor:
        """(B, m, 2) y and y' / w of an arm that has rested at the actuation (B, m)."""
        return torch.stack([signal, torch.zeros_like(signal)], dim=-1)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, m, 2) y and y' / w after the actuation (B, m)."""
        # The recurrence of `scan` with real and imaginary parts apart, which every runtime has.
        damping = self.damping_logit.sigmoid()
        swing = (1 - damping.square()).sqrt()
        turn = 2 * math.pi * self.log_frequency.exp() * context.dt_s.unsqueeze(-1)
        decay = torch.exp(-damping * turn)
        cosine, sine = decay * torch.cos(swing * turn), decay * torch.sin(swing * turn)
        away = memory[..., 0] - signal
        speed = memory[..., 1]
        y = signal + cosine * away + sine / swing * (damping * away + speed)
        rate = cosine * speed - sine / swing * (away + damping * speed)
        return torch.stack([y, rate], dim=-1)

    def scan(
        self,
        memory: Tensor,
        signal: Tensor,
        context: Context,
        rows: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        """(R, T, m, 2) y and y' / w along the actuation (R, T, m).

        rows: picks rows (S, ...) of a (R, T, ...) tensor; the result is then (S, m, 2).
        """
        keep, addend = self._drive(signal, context.dt_s)
        mode = linear_scan(keep, addend, self._to_mode(memory))
        return self._from_mode(mode if rows is None else rows(mode))

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m) and oscillators (..., m, 2)."""
        return signal + self.share * (memory[..., 0] - signal)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(1, ..., m) oscillator minus actuation: closed form."""
        return (memory[..., 0] - signal).unsqueeze(0).detach()

    def config(self) -> dict:
        """No arguments: tensors hold everything."""
        return {}

    def quantities(self) -> list[Quantity]:
        """Share, undamped frequency (Hz) and damping ratio."""
        soft = "wide: first modes of soft arms of centimetres to a metre"
        swings = "more hardly swings: it looks like viscosity"
        damping = value_of(self.damping_logit.sigmoid())
        return [
            Quantity("share", value_of(self.share), "", 0.0, 1.2, "1: all of the arm swings"),
            Quantity("frequency_Hz", value_of(self.log_frequency.exp()), "Hz", 0.1, 50.0, soft),
            Quantity("damping_ratio", damping, "", 0.005, 0.5, swings),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Frequency (Hz), damping ratio, and the share of the arm that swings (%)."""
        damping = float(self.damping_logit.detach().sigmoid())
        share = 100 * float(self.share.detach())
        return [
            Reading("swings at {}", float(self.log_frequency.detach().exp()), "Hz"),
            Reading("damping ratio {}", damping, ""),
            Reading("{} of the actuation swings", share, "%", most=MOST_PERCENT),
        ]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    return [Inertia(facts, *mode) for mode in GRID]


HYPOTHESIS = Hypothesis(Inertia, _grid, needs_motion=True)
