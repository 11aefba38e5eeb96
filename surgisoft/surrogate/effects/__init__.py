"""The named physical effects; a file's stem is the name that is printed."""

from surgisoft.errors import unknown_name
from surgisoft.surrogate.effects.base import (
    STAGES,
    ArmFacts,
    Context,
    Effect,
    Memoryless,
    Quantity,
    Stage,
)
from surgisoft.surrogate.effects.creep import Creep
from surgisoft.surrogate.effects.gain_mismatch import GainMismatch
from surgisoft.surrogate.effects.hysteresis import Hysteresis
from surgisoft.surrogate.effects.line_lag import LineLag
from surgisoft.surrogate.effects.misalignment import Misalignment

EFFECTS: dict[str, type[Effect]] = {
    "line_lag": LineLag,
    "hysteresis": Hysteresis,
    "creep": Creep,
    "gain_mismatch": GainMismatch,
    "misalignment": Misalignment,
}
"""Every effect of the package by name; `known_effects` adds the users' own."""

__all__ = [
    "EFFECTS",
    "STAGES",
    "ArmFacts",
    "Context",
    "Effect",
    "Memoryless",
    "Quantity",
    "Stage",
    "known_effects",
    "make_effect",
]


def known_effects() -> dict[str, type[Effect]]:
    """Every known effect by name."""
    return dict(EFFECTS)


def make_effect(name: str, facts: ArmFacts, **config) -> Effect:
    """The named effect for an arm."""
    known = known_effects()
    if name not in known:
        raise unknown_name("effect", name, known)
    return known[name](facts, **config)
