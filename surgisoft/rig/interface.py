"""What a rig is: a bench that takes pressures and gives samples. The virtual one is in virtual.py.

A real bench stands in its place by offering the same few methods; `collect` drives either.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from surgisoft.measurement.recordings import ArmInfo


@dataclass(frozen=True, eq=False)
class Sample:
    """What the bench measured at one instant."""

    t_s: float
    """Time since the bench was switched on [s]."""
    measured: np.ndarray
    """(m,) readings of the pressure sensors [the rig's unit]."""
    commanded: np.ndarray
    """(m,) pressures that the controllers were told to reach [the rig's unit]."""
    key_points_mm: np.ndarray
    """(n, 3) centres of the key planes, arm base frame [mm]; NaN where the cameras lost one."""
    temp_C: float | None = None
    """Temperature beside the arm [degrees Celsius], where there is a thermometer."""


class Rig(Protocol):
    """A bench with one arm of m chambers and n key planes."""

    chambers: int
    """m."""
    key_planes: int
    """n."""
    unit: str
    """Unit of the actuation, such as kPa."""
    limits: np.ndarray
    """(m, 2) lowest and highest actuation [unit]."""
    period_s: float
    """Time from sample to sample [s]."""
    arm: ArmInfo
    """The arm's size."""
    gravity: np.ndarray | None
    """(3,) unit vector of weight, arm base frame; None where unknown."""
    payload_g: float | None
    """Known mass attached to the arm [g]; None where none was weighed."""

    def reset(self) -> None:
        """Vent the arm and let it rest, so that it remembers nothing: the start of a run."""

    def command(self, pressures: np.ndarray) -> None:
        """Tell the controllers the pressures (m,) [unit] to reach from now on."""

    def wait(self, seconds: float) -> None:
        """Let time pass without reading."""

    def read(self) -> Sample:
        """Let one period pass and read a sample."""
