"""The named physical effects; a file's stem is the name that is printed."""

from torch import Tensor

from surgisoft.errors import unknown_name
from surgisoft.surrogate.effects.base import STAGES, Effect, Quantity, Stage
from surgisoft.surrogate.effects.hysteresis import Hysteresis

EFFECTS: dict[str, type[Effect]] = {"hysteresis": Hysteresis}
"""Every known effect by name."""

__all__ = ["EFFECTS", "STAGES", "Effect", "Quantity", "Stage", "make_effect"]


def make_effect(name: str, low: Tensor, high: Tensor, rest: Tensor, **config) -> Effect:
    """The named effect for an arm with actuation range low, high and rest (m,) in its unit."""
    if name not in EFFECTS:
        raise unknown_name("effect", name, EFFECTS)
    return EFFECTS[name](low, high, rest, **config)
