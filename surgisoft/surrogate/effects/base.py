"""What every physical effect is.

The chain: line (commanded to chamber pressure) -> material (chamber pressure to effective
actuation, with memory) -> HAW-NN -> body (loads deform the shape) -> sensor (shape to what is
measured). An effect acts at one stage of it.

An effect has amplitudes (`strengths`), in which its answer is linear to first order and which do
nothing at zero, and the rest of its parameters (`shapes`): time constants, widths, places.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

Stage = Literal["line", "material", "body", "sensor"]
STAGES: tuple[Stage, ...] = ("line", "material", "body", "sensor")


@dataclass(frozen=True)
class ArmFacts:
    """What an effect may know of its arm."""

    low: Tensor
    """(m,) smallest actuation, in `unit`."""
    high: Tensor
    """(m,) largest actuation, in `unit`."""
    rest: Tensor
    """(m,) actuation of the arm at rest, in `unit`."""
    rest_mm: Tensor
    """(n, 3) key points at rest, mm, base frame; zeros where not known yet."""
    gravity: tuple[float, float, float] | None = None
    """Unit vector along the weight, base frame; None where the recordings do not say it."""
    length_mm: float | None = None
    """Length at rest, mm."""
    unit: str = "kPa"
    """Unit of the actuation."""
    temperature_C: float | None = None
    """Temperature of the room that the arm was measured in, degrees Celsius."""


@dataclass(frozen=True)
class Context:
    """What comes with the signal: time, and what else was measured.

    Leading shape (B,) of one step, (R, T) of whole runs.
    """

    dt_s: Tensor
    """(B,) or (R, T) time since the row before, s."""
    t_s: Tensor | None = None
    """Elapsed time since the start of the recording, s; None: the sum of `dt_s`."""
    temperature_C: Tensor | None = None
    """Temperature of the room, degrees Celsius, NaN where missing; None: the reference."""
    pressure: Tensor | None = None
    """(..., m) chamber pressure in the arm's unit, for the body and sensor stages."""


@dataclass(frozen=True)
class Quantity:
    """One parameter of an effect as a person reads it."""

    name: str
    """Name with its unit as suffix, such as `tau_s`."""
    value: float | list
    """Value, or nested values, one a chamber or an axis."""
    unit: str
    """Unit; empty for a share."""
    low: float
    """Least plausible value."""
    high: float
    """Largest plausible value."""
    source: str
    """Where the range comes from."""

    @property
    def plausible(self) -> bool:
        """Whether every value lies in the range."""
        return all(self.low <= value <= self.high for value in _leaves(self.value))


def _leaves(value) -> Iterator[float]:
    if isinstance(value, list | tuple):
        for item in value:
            yield from _leaves(item)
    else:
        yield float(value)


class Effect(nn.Module, ABC):
    """One physical effect: a memory that follows the signal, and what it does to the signal.

    The signal of line and material effects is the actuation (..., m); of body and sensor effects
    the key points (..., n, 3), mm, base frame. With its strengths at zero an effect returns the
    signal unchanged, bit for bit.
    """

    stage: Stage
    side_by_side = True
    """Whether several of its shapes at once make sense, as in a spectrum of times."""
    needs_reversals = False
    """Whether it can only be learned from data with inner reversals."""
    settled_form = False
    """Whether real arms have this very form, as with a turned frame or a weight, and not only one
    like it, as with what rubber does."""

    def __init__(self, facts: ArmFacts):
        super().__init__()
        self.facts = facts
        reach = torch.maximum(facts.high - facts.rest, facts.rest - facts.low)
        reach = reach.where(reach > 0, torch.ones_like(reach))
        self.register_buffer("origin", facts.rest.clone(), persistent=False)
        self.register_buffer("reach", reach, persistent=False)

    def load(self, signal: Tensor) -> Tensor:
        """Actuation (..., m) as a load: 0 at rest, 1 at the end of the range farther from rest."""
        return (signal - self.origin) / self.reach

    @abstractmethod
    def rest(self, signal: Tensor) -> Tensor:
        """Memory (B, ...) of an arm at rest at the signal (B, ...)."""

    @abstractmethod
    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """Memory (B, ...) after the signal (B, ...) has been held during `context.dt_s` (B,)."""

    @abstractmethod
    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """`advance` over whole runs: memory (R, T, ...) from the memory (R, ...) before them.

        Shapes: signal (R, T, ...), `context.dt_s` (R, T).
        """

    @abstractmethod
    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """The signal after the effect, same shape; any leading dimensions."""

    def forward(self, signal: Tensor, memory: Tensor) -> Tensor:
        """`apply`."""
        return self.apply(signal, memory)

    def step(self, memory: Tensor, signal: Tensor, context: Context) -> tuple[Tensor, Tensor]:
        """`advance`, then `apply`: (memory, signal) after one step."""
        memory = self.advance(memory, signal, context)
        return memory, self.apply(signal, memory)

    @abstractmethod
    def strengths(self) -> dict[str, nn.Parameter]:
        """The amplitudes by attribute name: all zero means no change at all."""

    def shapes(self) -> dict[str, nn.Parameter]:
        """The other parameters by attribute name, each free to take any real value."""
        mine = {id(parameter) for parameter in self.strengths().values()}
        return {name: p for name, p in self.named_parameters() if id(p) not in mine}

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(K, *signal.shape) derivative of `apply` by each of the K amplitudes, all at zero.

        The amplitudes come in the order of `strengths()`, each flattened. The memory counts as
        given.
        """
        zero = {name: torch.zeros_like(p) for name, p in self.strengths().items()}

        def answer(strengths):
            return torch.func.functional_call(self, strengths, (signal, memory))

        with torch.no_grad():
            slopes = torch.func.jacfwd(answer)(zero)
        flat = [slopes[name].flatten(signal.ndim).movedim(-1, 0) for name in zero]
        return torch.cat(flat)

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list["Effect"]:
        """Effects of zero strength over a coarse grid of the shapes, for a diagnosis to try.

        points: (S, n, 3) predicted key points of the recordings, mm, base frame.
        """
        return [cls(facts)]

    @classmethod
    def together(cls, some: list["Effect"]) -> list[list[int]]:
        """Sets of candidates, by number, that a diagnosis also tries side by side."""
        return [list(range(len(some)))] if cls.side_by_side else []

    @classmethod
    def further(cls, facts: ArmFacts, points: Tensor) -> list["Effect"]:
        """The same where the model has the effect already: shapes that add up with any other.

        Most effects have none: of them there can only be more or less.
        """
        return []

    def memory_parameters(self) -> list[nn.Parameter]:
        """Parameters that the memory depends on: they are fitted through whole runs."""
        return []

    def use_chambers(self, use: Tensor) -> None:
        """Leave out chambers (m,) with 0 that the data cannot support; most effects need not."""

    @abstractmethod
    def config(self) -> dict:
        """Arguments that build the effect again; its tensors are in the weights file."""

    @abstractmethod
    def quantities(self) -> list[Quantity]:
        """The parameters as a person reads them."""

    def implausible(self) -> list[Quantity]:
        """The parameters outside their plausible range."""
        return [quantity for quantity in self.quantities() if not quantity.plausible]

    def plausible(self) -> bool:
        """Whether every parameter lies in its plausible range."""
        return not self.implausible()


class Memoryless(Effect, ABC):
    """An effect that depends on the present signal alone."""

    def rest(self, signal: Tensor) -> Tensor:
        """(B, 0) nothing to remember."""
        return signal.new_zeros(len(signal), 0)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, 0) nothing to remember."""
        return memory

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, 0) nothing to remember."""
        return signal.new_zeros(*signal.shape[:2], 0)


def amplitude(*shape: int) -> nn.Parameter:
    """Amplitudes of zero strength."""
    return nn.Parameter(torch.zeros(shape))


def logarithm(value: float) -> nn.Parameter:
    """A positive parameter (1,), kept as its logarithm so that it stays positive."""
    return nn.Parameter(torch.tensor([float(value)]).log())


def value_of(tensor: Tensor) -> float | list:
    """A parameter for a `Quantity`: a number where there is one, else nested lists."""
    tensor = tensor.detach().cpu()
    return float(tensor) if tensor.numel() == 1 else tensor.tolist()
