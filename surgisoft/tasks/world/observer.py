"""The state observer of an arm: key points estimated from cameras and the arm's model.

The nominal model runs beside the arm, driven by the measured pressures, and its output is corrected
by a filtered output disturbance, as in offset-free model predictive control (Pannocchia & Rawlings
2003). The disturbance is estimated by an alpha-beta filter (Kalata 1984), which follows a steady
drift without lag, or learned while the arm moves (`adaptation`). Simulated arms use it here, rigs
and exported controllers in `agents.observer`.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmState
from surgisoft.tasks.world.adaptation import Adaptation


@dataclass(frozen=True)
class AlphaBetaFilter:
    """Gains of an arm's state observer; a gain of 1 without drift gain is the raw measurement."""

    gain: float = 1.0
    """Share of the innovation (cameras minus estimate) that the estimate adopts in a step, 0..1:
    the filter's alpha. With 1 the estimate is the raw measurement."""
    drift_gain: float = 0.0
    """Share of the innovation that is added to the disturbance's rate, 0..1: the filter's beta."""
    adapts: bool = False
    """Whether the disturbance is learned as a function of the pressures instead, see `adaptation`;
    the two gains then have no effect."""

    def __post_init__(self):
        for name in ("gain", "drift_gain"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise InputError(f"observer: {name} is {value}, expected 0 to 1")

    @property
    def raw(self) -> bool:
        """Whether the estimate is the raw measurement."""
        return self.gain == 1.0 and self.drift_gain == 0.0 and not self.adapts

    def adopted(
        self, surprise: Tensor, offset: Tensor, drift: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Disturbance now, the one expected in the next step, and its rate; all (B, n, 3) mm.

        surprise: innovation, 0 where a key point was not seen; offset, drift: disturbance that was
        expected now, and its rate.
        """
        drift = drift + self.drift_gain * surprise
        now = offset + self.gain * surprise
        return now, now + drift, drift


@dataclass(frozen=True, eq=False)
class Belief:
    """Memory of the observer of B simulated arms."""

    arm: ArmState
    """State of the nominal model, driven by the measured pressures."""
    offset_mm: Tensor
    """(B, n, 3) mm, world frame: expected disturbance of the model's key points."""
    drift_mm: Tensor
    """(B, n, 3) mm, world frame: by how much the disturbance grows in a step."""
    fed_mm: Tensor
    """(B, 1, 3) mm, world frame: by how much the base is known to have been fed in."""
    adaptation: Adaptation | None = None
    """What was learned of the disturbance, base frame; None for the alpha-beta filter."""
