"""An arm for tests of effects, with signals and stirred parameters."""

import torch

from surgisoft.surrogate.effects import (
    ArmFacts,
    Context,
    Effect,
    hypothesis_of,
    known_effects,
    make_effect,
)

REST_MM = torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(5)])


def facts(chambers: int = 3) -> ArmFacts:
    """A straight upright arm of 70 mm; every other chamber can be evacuated."""
    low = torch.tensor([-10.0, 0.0, -10.0, 0.0][:chambers])
    high = torch.tensor([50.0, 40.0, 50.0, 45.0][:chambers])
    return ArmFacts(low, high, torch.zeros(chambers), REST_MM, (0.6, 0.0, -0.8), 70.0, "kPa")


FACTS = facts()


def on_points(effect: Effect) -> bool:
    """Whether the effect acts on key points."""
    return effect.stage in ("body", "sensor")


def signal(effect: Effect, runs: int, steps: int, seed: int) -> torch.Tensor:
    """Random walks of what the effect acts on: actuation (R, T, 3) or key points (R, T, 5, 3)."""
    generator = torch.Generator().manual_seed(seed)
    walk = torch.randn(runs, steps, 3, generator=generator).cumsum(1)
    if not on_points(effect):
        return (20 + 6 * walk).clamp(-10, 50)
    share = REST_MM[:, 2:] / 70
    bend = torch.cat([walk[..., :2], torch.zeros_like(walk[..., :1])], -1).unsqueeze(-2)
    return REST_MM + 3 * bend * share**2


def context(runs: int, steps: int, seed: int = 0, chambers: int = 3) -> Context:
    """Uneven times, warming rooms and pressures."""
    generator = torch.Generator().manual_seed(seed + 99)
    dt = 0.02 + 0.3 * torch.rand(runs, steps, generator=generator)
    dt[:, 0] = 0
    pressure = 50 * torch.rand(runs, steps, chambers, generator=generator)
    room = 21 + 4 * torch.rand(runs, steps, generator=generator)
    return Context(dt, dt.cumsum(1), room, pressure)


def at(whole: Context, t: int, elapsed: bool = True) -> Context:
    """The context of step t; without the elapsed time, as a world steps."""
    return Context(
        whole.dt_s[:, t],
        whole.t_s[:, t] if elapsed else None,
        whole.temperature_C[:, t],
        whole.pressure[:, t],
    )


def stir(effect: Effect, seed: int = 3, size: float = 0.1) -> Effect:
    """The effect with every parameter moved off its first value."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in effect.parameters():
            parameter += size * torch.randn(parameter.shape, generator=generator)
    return effect


def variants() -> dict[str, Effect]:
    """Every effect as it is made by name, and every candidate of it, of zero strength."""
    points = signal(make_effect("misalignment", FACTS), 1, 400, 0)[0]
    answer = {}
    for name, kind in known_effects().items():
        answer[name] = make_effect(name, FACTS)
        made = hypothesis_of(kind).candidates(FACTS, points)
        kinds = {}
        for number, effect in enumerate(made):
            kinds[effect.stage, *(tuple(p.shape) for p in effect.parameters())] = number
        for number in {len(made) // 2, *kinds.values()}:
            answer[f"{name}-{number}"] = made[number]
    # A candidate of arms with five chambers and more.
    answer["hysteresis-chamber"] = make_effect("hysteresis", FACTS, radii=(0.05, 0.3), chamber=1)
    return answer
