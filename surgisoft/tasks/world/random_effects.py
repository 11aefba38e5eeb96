"""Randomised effects: each episode's arm has an effect of the library that its model lacks.

Domain randomization of gains and mounts covers what is constant in an episode. Friction, creep, a
slow line or a payload depend on the past and on the pose; they come out of the effect library
(`surgisoft.surrogate.effects`). All effects are in one chain, each with the amplitude at which it
moves the tip by a millimetre (root mean square), and each arm has its own factors: 0 switches an
effect off, and with 1 the arm moves exactly as a model to which that effect alone was added.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from surgisoft.on_device import on_device
from surgisoft.surrogate.arm import ArmState
from surgisoft.surrogate.chain import Link, Signal, Stepping
from surgisoft.surrogate.effects import Context, free_name, make_effect
from surgisoft.surrogate.model import ArmModel
from surgisoft.tasks.world.random_streams import Stream

KINDS = (
    "line_lag",
    "gain_mismatch",
    "coupling",
    "dead_zone",
    "stiffening",
    "softening",
    "creep",
    "rate_dependence",
    "payload",
    "twist",
)
"""Effects that are drawn. Rigid motions are those of the mounts (`Randomisation.mount_mm`), more
friction would be a second hysteresis of 360 weights, and contact needs a place."""
BOTH_SIGNS = ("gain_mismatch", "twist", "coupling", "stiffening")
"""Effects of which either sign occurs; the others lose energy or weigh something."""
ONE_BY_ONE = ("gain_mismatch",)
"""Effects of which every amplitude is drawn separately, as each chamber has its own gain."""
PROBE = 0.02
"""Amplitude at which an effect's influence on the tip is measured, to first order."""
PROBE_STEPS, PROBE_ARMS, PROBE_S = 40, 16, 0.5
"""Length (steps), number and time of a step (s) of the random motions of that measurement."""


class ScaledStepping(Stepping):
    """Chain mode for one time step in which every arm has its own factor on each effect."""

    def __init__(self, state: ArmState, context: Context, factors: Mapping[str, Tensor]):
        """factors: name of an effect -> (B,); effects without factors act as they are."""
        super().__init__(state, context)
        self.factors = factors

    def effect(self, link: Link, signal: Signal) -> Tensor:
        """Signal behind an effect, with its change of the signal times the factors."""
        behind, factor = super().effect(link, signal), self.factors.get(link.name)
        if factor is None:
            return behind
        return torch.lerp(signal.value, behind, factor.view(-1, *[1] * (behind.ndim - 1)))


class RandomEffects:
    """An arm model with every effect of `KINDS`, which arms have to different degrees."""

    @torch.no_grad()
    def __init__(self, model: ArmModel):
        effects, own = dict(model.effects), list(model.effects)
        self.kinds: list[list[str]] = []
        for kind in KINDS:
            count = sum(p.numel() for p in make_effect(kind, model.facts).amplitudes().values())
            vector = kind in ONE_BY_ONE
            names = []
            for entry in range(count if vector else 1):
                names.append(free_name(kind, effects))
                effect = make_effect(kind, model.facts)
                for parameter in effect.amplitudes().values():
                    flat = parameter.view(-1)
                    flat[entry if vector else slice(None)] = PROBE
                effects[names[-1]] = effect.requires_grad_(False)
            self.kinds.append(names)
        self.names = [name for name in effects if name not in own]
        self.model = model.replace(effects=effects).to(model.rest_mm.device)
        for name, moved_mm in zip(self.names, self._moved_mm(), strict=True):
            for parameter in self.model.effects[name].amplitudes().values():
                parameter.mul_(1.0 / max(moved_mm, 1e-9))

    @property
    def count(self) -> int:
        """Number K of factors of an arm."""
        return len(self.names)

    def draw(self, stream: Stream, largest_mm: float) -> tuple[Stream, Tensor]:
        """Factors (B, K) of an episode: one kind, which moves the tip by 0 to largest_mm."""
        stream, kind = stream.uniform(0.0, float(len(self.kinds)))
        stream, size = stream.uniform(0.0, largest_mm)
        stream, parts = stream.normal(self.count)
        factors = torch.zeros_like(parts)
        chosen = kind.long().clamp(max=len(self.kinds) - 1)
        for number, (name, names) in enumerate(zip(KINDS, self.kinds, strict=True)):
            first = self.names.index(names[0])
            places = slice(first, first + len(names))  # no list, which a GPU would have to be sent
            part = parts[:, places]
            share = part / part.norm(dim=1, keepdim=True).clamp(min=1e-6)
            share = share if name in BOTH_SIGNS else share.abs()
            factors[:, places] = share * (size * (chosen == number))[:, None]
        return stream, factors

    def step(
        self, state: ArmState, pressure: Tensor, dt_s: Tensor | float, factors: Tensor
    ) -> tuple[ArmState, Tensor]:
        """State and key points (B, n, 3) mm, base frame, after a step to (B, m) kPa."""
        dt = on_device(dt_s, pressure)
        mode = ScaledStepping(
            state,
            Context(dt.expand(len(pressure))),
            dict(zip(self.names, factors.unbind(1), strict=True)),
        )
        signal = self.model.chain.walk(Signal(pressure), mode)
        direction = signal.behind_chambers()[1]
        return ArmState(pressure, mode.anchor, direction, mode.memory), signal.value

    def _moved_mm(self) -> list[float]:
        """RMS change of the tip, mm, by each effect along random motions over the whole range."""
        spec, count = self.model.spec, self.count
        low, high = torch.tensor(spec.low), torch.tensor(spec.high)
        random = torch.Generator().manual_seed(0)
        share = torch.rand(PROBE_STEPS // 4, PROBE_ARMS, spec.chambers, generator=random)
        targets = (low + (high - low) * share).repeat_interleave(4, 0)
        factors = torch.cat((torch.zeros(1, count), torch.eye(count)))
        each = factors.repeat_interleave(PROBE_ARMS, 0).to(self.model.rest_mm.device)
        state, changes = self.model.initial_state(len(each)), []
        for target in targets.to(each.device):
            state, points = self.step(state, target.repeat(count + 1, 1), PROBE_S, each)
            tip = points[:, -1].unflatten(0, (count + 1, PROBE_ARMS))
            changes.append((tip[1:] - tip[0]).square().sum(2).mean(1))
        return torch.stack(changes).mean(0).sqrt().tolist()
