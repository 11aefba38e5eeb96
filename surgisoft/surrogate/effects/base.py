"""What every physical effect is.

The chain: line (commanded to chamber pressure) -> material (chamber pressure to effective
actuation, with memory) -> HAW-NN -> body (loads deform the shape) -> sensor (shape to what is
measured). An effect acts at one stage of it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn

Stage = Literal["line", "material", "body", "sensor"]
STAGES: tuple[Stage, ...] = ("line", "material", "body", "sensor")


@dataclass(frozen=True)
class Quantity:
    """One parameter of an effect as a person reads it."""

    name: str
    """Name with its unit as suffix."""
    value: float | list
    """Value, or nested values one a chamber."""
    unit: str
    """Unit; empty for a share."""


class Effect(nn.Module, ABC):
    """One physical effect: a memory that follows the signal, and what it does to the signal.

    The signal of line and material effects is the actuation (..., m); of body and sensor effects
    the key points (..., n, 3). With its strength at zero an effect returns the signal unchanged.
    """

    stage: Stage

    @abstractmethod
    def rest(self, signal: Tensor) -> Tensor:
        """Memory (B, ...) of an arm at rest at the signal (B, ...)."""

    @abstractmethod
    def advance(self, memory: Tensor, signal: Tensor, dt: Tensor) -> Tensor:
        """Memory (B, ...) after the signal (B, ...) has come to pass during dt (B,) seconds."""

    @abstractmethod
    def scan(self, memory: Tensor, signal: Tensor, dt: Tensor) -> Tensor:
        """`advance` over whole runs: memory (R, T, ...) from the memory (R, ...) before them.

        Shapes: signal (R, T, ...), dt (R, T) in seconds.
        """

    @abstractmethod
    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """The signal after the effect, same shape; any leading dimensions."""

    def step(self, memory: Tensor, signal: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """`advance`, then `apply`: (memory, signal) after one step."""
        memory = self.advance(memory, signal, dt)
        return memory, self.apply(signal, memory)

    def memory_parameters(self) -> list[nn.Parameter]:
        """Parameters that the memory depends on: they are fitted through whole runs."""
        return []

    @abstractmethod
    def config(self) -> dict:
        """Arguments that build the effect again; its tensors are in the weights file."""

    @abstractmethod
    def quantities(self) -> list[Quantity]:
        """The parameters as a person reads them."""
