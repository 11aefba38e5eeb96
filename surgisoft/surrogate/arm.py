"""Specification (`ArmSpec`) and state (`ArmState`) of an arm."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surgisoft.errors import InputError


@dataclass(frozen=True)
class ArmSpec:
    """One arm's inputs, outputs and proportions."""

    chambers: int
    """Number m of chambers (or tendons)."""
    key_points: int
    """Number n of key points, base to tip."""
    low: tuple[float, ...]
    """Smallest actuation seen in each chamber, in `unit`."""
    high: tuple[float, ...]
    """Largest actuation seen in each chamber, in `unit`."""
    unit: str = "kPa"
    """Unit of the actuation: kPa, psi, deg, mm, V, norm."""
    actuation: str = "measured"
    """Which actuation is the model's input: `measured` or `commanded`."""
    band: tuple[float, ...] = ()
    """Half width of the dead band of the direction of change in each chamber, in `unit`."""
    idle: tuple[float | None, ...] = ()
    """Constant actuation of a chamber that did not move in the training data, in `unit`: the model
    ignores such a chamber. None for each chamber that moved."""
    length_mm: float | None = None
    """Length at rest, mm."""
    diameter_mm: float | None = None
    """Outer diameter, mm."""
    gravity: tuple[float, float, float] | None = None
    """Unit vector along the weight, base frame; None where the recordings do not state it."""
    temperature_C: float | None = None
    """Mean temperature of the room where the recordings were made, degrees Celsius, if known."""
    speed_per_s: float | None = None
    """How fast the actuation moved in the training data, as a share of its range in a second
    (`measurement.histories.speed_of`), 1/s; 0 if it had steady states alone; None if unknown."""

    def __post_init__(self):
        for name in ("low", "high", "band", "idle"):
            value = getattr(self, name)
            if name == "band" and not value:
                value = tuple(0.0 for _ in range(self.chambers))
                object.__setattr__(self, "band", value)
            if name == "idle" and not value:
                value = (None,) * self.chambers
                object.__setattr__(self, "idle", value)
            if len(value) != self.chambers:
                raise InputError(
                    f"arm: '{name}' has {len(value)} values, expected one for each of "
                    f"{self.chambers} chambers"
                )

    @property
    def rest(self) -> tuple[float, ...]:
        """Actuation of the arm at rest: zero, or the end of the range that is nearest to it."""
        return tuple(
            min(max(0.0, low), high) for low, high in zip(self.low, self.high, strict=True)
        )

    @property
    def span(self) -> tuple[float, ...]:
        """Range of the actuation of each chamber, in `unit`; never zero."""
        return tuple(
            high - low if high > low else 1.0 for low, high in zip(self.low, self.high, strict=True)
        )


@dataclass(frozen=True)
class ArmState:
    """A batch of arms at one instant; every tensor has the batch in front."""

    pressure: Tensor
    """(B, m) actuation that was commanded to the model, in the arm's unit."""
    anchor: Tensor
    """(B, m) actuation of the last confirmed move, in the arm's unit."""
    direction: Tensor
    """(B, m) direction of change: -1 falling, +1 rising, 0 not yet moved."""
    memory: dict[str, Tensor]
    """State of each effect or network that remembers, keyed by its name; (B, ...)."""

    def where(self, mask: Tensor, other: "ArmState") -> "ArmState":
        """`other` where the (B,) mask holds, this state elsewhere; nothing is changed in place."""

        def pick(theirs: Tensor, ours: Tensor) -> Tensor:
            return torch.where(mask.view(-1, *[1] * (ours.ndim - 1)), theirs, ours)

        return replace(
            self,
            pressure=pick(other.pressure, self.pressure),
            anchor=pick(other.anchor, self.anchor),
            direction=pick(other.direction, self.direction),
            memory={name: pick(other.memory[name], value) for name, value in self.memory.items()},
        )


def centre_and_half(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Middle and half width (m,) of the range low, high (m,); half is 1 where it is empty."""
    return (high + low) / 2, ((high - low) / 2).where(high > low, torch.ones_like(low))
