"""The interface of a physical effect.

An effect acts at one stage of the arm model's chain: line (commanded to chamber pressure),
material (chamber pressure to effective actuation, with memory), body (loads displace the key
points) or sensor (true to measured key points); the network stands between material and body.

An effect has amplitudes, in which its result is linear to first order and which change nothing at
zero, and nonlinear parameters: time constants, widths, places. How identification tries an effect
is its `Hypothesis` (`surgisoft.surrogate.effects.hypothesis`).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from surgisoft.errors import InputError
from surgisoft.surrogate.effects.readings import Reading, each_axis, each_chamber

Stage = Literal["line", "material", "body", "sensor"]
STAGES: tuple[Stage, ...] = ("line", "material", "body", "sensor")
FRONT: tuple[Stage, ...] = ("line", "material")
"""Those in front of the network; it is fitted together with effects there."""


@dataclass(frozen=True)
class ArmFacts:
    """The properties of an arm that its effects may use."""

    low: Tensor
    """(m,) smallest actuation, in `unit`."""
    high: Tensor
    """(m,) largest actuation, in `unit`."""
    rest: Tensor
    """(m,) actuation of the arm at rest, in `unit`."""
    rest_mm: Tensor
    """(n, 3) key points at rest, mm, base frame; zeros where not known yet."""
    gravity: tuple[float, float, float] | None = None
    """Unit vector along the weight, base frame; None where the recordings do not state it."""
    length_mm: float | None = None
    """Length at rest, mm."""
    unit: str = "kPa"
    """Unit of the actuation."""
    temperature_C: float | None = None
    """Temperature of the room that the arm was measured in, degrees Celsius."""


@dataclass(frozen=True)
class Context:
    """Time, temperature and pressure that come with a signal.

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
    """One parameter of an effect in a unit that a person reads, with its plausible range."""

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


def _without_unit(quantity: Quantity) -> str:
    """Name of a quantity in words, without its unit."""
    return quantity.name.removesuffix(f"_{quantity.unit}").replace("_", " ")


def _leaves(value) -> Iterator[float]:
    if isinstance(value, list | tuple):
        for item in value:
            yield from _leaves(item)
    else:
        yield float(value)


TEN_MINUTES = 600.0
"""Time for which slow effects are stated where the recordings' own is not known, s."""
OLD_NAMES = {
    "strengths": "amplitudes",
    "shapes": "nonlinear_parameters",
    "columns": "sensitivities",
}
"""Present names of methods of `Effect`, by the old names that user-defined effects may have."""


class Effect(nn.Module, ABC):
    """One physical effect: a memory that follows a signal, and a change of the signal.

    The signal of line and material effects is the actuation (..., m); of body and sensor effects
    the key points (..., n, 3), mm, base frame. With its amplitudes at zero an effect returns the
    signal unchanged, bit for bit.

    Older user-defined effects may name their methods `strengths` (now `amplitudes`), `shapes`
    (now `nonlinear_parameters`) and `columns` (now `sensitivities`); either name works.
    """

    origin: Tensor
    reach: Tensor

    stage: Stage
    """Place in the chain at which the effect acts."""
    version: int = 1
    """Version of `config` and of the parameters' meaning, stored in a model's file."""

    def with_changes(self, signal: Tensor, changes: Iterable[Tensor]) -> Tensor:
        """The signal with the change at an amplitude of one for each of `amplitudes`, all (1,)."""
        for size, change in zip(self.amplitudes().values(), changes, strict=True):
            signal = signal + size * change
        return signal

    @property
    def follows(self) -> bool:
        """Whether the memory of an arm that stands away from rest has followed from rest.

        A run may begin away from rest, where the arm has been held for a while. A wall has then
        followed its load for that time. Any other effect, such as a lag of the line or an
        oscillation of the body, has reached steady state.
        """
        return self.stage == "material"

    def __init_subclass__(cls, **more):
        super().__init_subclass__(**more)
        for old, new in OLD_NAMES.items():
            if old in vars(cls) and new not in vars(cls):
                setattr(cls, new, vars(cls)[old])

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

    @property
    def keeps_time(self) -> bool:
        """Whether the memory is the time since the recording began, s, where it is stated."""
        return False

    @abstractmethod
    def rest(self, signal: Tensor) -> Tensor:
        """Memory (B, ...) of an arm at rest at the signal (B, ...)."""

    @abstractmethod
    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """Memory (B, ...) after the signal (B, ...) has been held during `context.dt_s` (B,)."""

    @abstractmethod
    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """Memory (R, T, ...) along whole runs, from the memory (R, ...) before them.

        Equals `advance` row by row. signal: (R, T, ...); `context.dt_s`: (R, T).
        """

    @abstractmethod
    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """The signal after the effect, in the same array shape; any leading dimensions."""

    def forward(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Call `apply`, as torch modules do."""
        return self.apply(signal, memory)

    def step(self, memory: Tensor, signal: Tensor, context: Context) -> tuple[Tensor, Tensor]:
        """`advance`, then `apply`: (memory, signal) after one step."""
        memory = self.advance(memory, signal, context)
        return memory, self.apply(signal, memory)

    @abstractmethod
    def amplitudes(self) -> dict[str, nn.Parameter]:
        """The amplitudes by attribute name: all zero means no change at all."""

    def nonlinear_parameters(self) -> dict[str, nn.Parameter]:
        """The parameters other than amplitudes, by attribute name; each may have any real value."""
        mine = {id(parameter) for parameter in self.amplitudes().values()}
        return {name: p for name, p in self.named_parameters() if id(p) not in mine}

    def strengths(self) -> dict[str, nn.Parameter]:
        """Old name of `amplitudes`."""
        return self.amplitudes()

    def shapes(self) -> dict[str, nn.Parameter]:
        """Old name of `nonlinear_parameters`."""
        return Effect.nonlinear_parameters(self)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(K, *signal.shape) derivative of `apply` by each of the K amplitudes, all at zero.

        The amplitudes come in the order of `amplitudes`, each flattened. The memory counts as
        given. Computed by forward differentiation; an effect may override it with the closed form,
        which is several times as fast.
        """
        zero = {name: torch.zeros_like(p) for name, p in self.amplitudes().items()}

        def result(amplitudes):
            return torch.func.functional_call(self, amplitudes, (signal, memory))

        with torch.no_grad():
            slopes = torch.func.jacfwd(result)(zero)
        flat = [slopes[name].flatten(signal.ndim).movedim(-1, 0) for name in zero]
        return torch.cat(flat)

    def memory_parameters(self) -> list[nn.Parameter]:
        """Parameters that the memory depends on: they are fitted through whole runs."""
        return []

    def use_chambers(self, use: Tensor) -> None:
        """Exclude chambers (m,) with 0, which the data cannot support; most effects ignore it."""

    @abstractmethod
    def config(self) -> dict:
        """Arguments that build the effect again; its tensors are in the weights file."""

    @classmethod
    def migrated(cls, config: dict, version: int | None) -> dict:
        """The `config` of this version from one that another version wrote.

        version: version of the class that wrote it; None in models older than versions. Raises
        InputError where the parameters have another meaning now.
        """
        if version is not None and version > cls.version:
            raise InputError(
                f"version {version} of the effect wrote it, expected at most {cls.version}: "
                "use the surgisoft that wrote the model"
            )
        return config

    @abstractmethod
    def quantities(self) -> list[Quantity]:
        """The parameters in units that a person reads, with their plausible ranges."""

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """What the parameters mean, in words; as many readings whatever the parameters are.

        seconds: time that recordings cover, s; None where it is not known. By default every
        quantity that is a single number, and every list of one number for each chamber (in front
        of the network) or each axis of the base frame (behind it).
        """
        return [reading for each in self.quantities() for reading in self._readings_of(each)]

    def _readings_of(self, quantity: Quantity) -> list[Reading]:
        """The readings of one quantity; none of an array of another shape, or of one whose range
        lacks zero, such as times of a spectrum."""
        name, value = _without_unit(quantity), quantity.value
        if not isinstance(value, list | tuple):
            return [Reading(f"{name} {{}}", float(value), quantity.unit)]
        in_front = self.stage in FRONT
        if not quantity.low <= 0.0 <= quantity.high:
            return []
        if len(value) != (len(self.origin) if in_front else 3) or any(
            isinstance(each, list | tuple) for each in value
        ):
            return []
        values = [float(each) for each in value]
        largest = max(abs(quantity.low), abs(quantity.high))
        sizes = [each / largest for each in values] if 0 < largest < math.inf else values
        if in_front:
            return each_chamber(
                f"{name} of chamber {{chamber}} {{+}}", values, quantity.unit, sizes
            )
        return each_axis(f"{name} along {{axis}} {{+}}", values, quantity.unit, sizes)

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
    """Amplitudes of an array shape, all zero."""
    return nn.Parameter(torch.zeros(shape))


def logarithm(value: float) -> nn.Parameter:
    """A positive parameter (1,), stored as its logarithm so that it stays positive."""
    return nn.Parameter(torch.tensor([float(value)]).log())


def value_of(tensor: Tensor) -> float | list:
    """A parameter for a `Quantity`: a number where there is one, else nested lists."""
    tensor = tensor.detach().cpu()
    return float(tensor) if tensor.numel() == 1 else tensor.tolist()
