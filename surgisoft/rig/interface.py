"""What a rig offers: a bench with one soft arm that takes pressures and gives samples.

`Rig` is a real bench: four methods and eight attributes. Any object that has them can be driven; it
needs to inherit from nothing. It may also have `vent()` and `close()`, see `vent` and `close`.
`SimulatedRig` adds the truth that only a simulation knows.
"""

from dataclasses import dataclass
from typing import Protocol, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from surgisoft.errors import InputError
from surgisoft.measurement.recordings import ArmInfo
from surgisoft.units import actuation_word


@dataclass(frozen=True, eq=False)
class Sample:
    """Measurements of a rig at one instant."""

    t_s: float
    """Time since the rig was switched on [s]."""
    measured: np.ndarray
    """(m,) readings of the pressure sensors [the rig's unit]."""
    commanded: np.ndarray
    """(m,) set points of the pressure controllers [the rig's unit]."""
    key_points_mm: np.ndarray
    """(n, 3) centres of the key planes, arm base frame [mm]; NaN where the cameras lost one."""
    temp_C: float | None = None
    """Temperature near the arm [degrees Celsius], where there is a thermometer."""


@dataclass(frozen=True, eq=False)
class Truth:
    """State of T samples that only a simulation knows and no sensor measures."""

    centres_mm: np.ndarray
    """(T, n, 3) centres of the key planes, arm base frame [mm]."""
    noise_free_mm: np.ndarray
    """(T, n, 3) what the cameras would measure without noise, arm base frame [mm]."""
    pressures_kPa: np.ndarray
    """(T, m) pressures in the chambers [kPa]."""


class Rig(Protocol):
    """Interface of a test bench with one arm of m chambers whose cameras track n key planes."""

    chambers: int
    """Number m of chambers, or of other actuators."""
    key_planes: int
    """Number n of tracked planes, from the base to the tip."""
    unit: str
    """Unit of the actuation, such as kPa."""
    limits: np.ndarray
    """(m, 2) lowest and highest actuation that `command` accepts [unit]."""
    period_s: float
    """Time from sample to sample [s]."""
    arm: ArmInfo
    """Length and diameter of the arm, where they are known [mm]."""

    payload_g: float | None
    """Known mass attached to the arm [g]; None where none was weighed."""

    @property
    def gravity(self) -> np.ndarray | None:
        """(3,) unit vector of weight, arm base frame; None where it is unknown."""

    def reset(self) -> None:
        """Vent the arm and wait until it has no memory of earlier pressures: the start of a run."""

    def command(self, pressures: np.ndarray) -> None:
        """Set the pressures (m,) [unit] that the controllers reach for from now on.

        Raises InputError for a wrong shape, for values that are not finite or beyond `limits`.
        """

    def wait(self, seconds: float) -> None:
        """Let time [s] pass without a sample; the last command holds."""

    def read(self) -> Sample:
        """Wait for one period, then return what sensors and cameras measure."""


class SimulatedRig(Rig, Protocol):
    """A rig that also gives the true state, so that errors are scored without sensor noise."""

    def read_beside_truth(self) -> tuple[Sample, Truth]:
        """Do what `read` does, and return the true state of the same instant (T = 1) with it."""


def is_simulated(rig: Rig) -> TypeGuard[SimulatedRig]:
    """Whether a rig knows its true state."""
    return hasattr(rig, "read_beside_truth")


def vented(limits: np.ndarray) -> np.ndarray:
    """(m,) the actuation within limits (m, 2) that is nearest to zero [unit of the limits]."""
    low, high = np.asarray(limits, np.float64).T
    return np.clip(0.0, low, high)


def vent(rig: Rig) -> None:
    """Let the air out of every chamber at once, without waiting for it.

    A rig with a method `vent()` does it itself, and that method may be called from another thread
    at any time; any other rig is commanded the pressures nearest to zero.
    """
    own = getattr(rig, "vent", None)
    if callable(own):
        own()
    else:
        rig.command(vented(rig.limits))


def close(rig: Rig) -> None:
    """Vent a rig and give its devices back; a rig without a method `close()` is only vented."""
    try:
        vent(rig)
    finally:
        own = getattr(rig, "close", None)
        if callable(own):
            own()


def checked_command(pressures: np.ndarray, limits: np.ndarray, unit: str) -> np.ndarray:
    """The pressures (m,) of a command as float64 [unit].

    limits: (m, 2) lowest and highest [unit]. Raises InputError for a wrong shape, and for values
    that are not finite or beyond the limits.
    """
    pressures = np.asarray(pressures, np.float64)
    if pressures.shape != (len(limits),) or not np.isfinite(pressures).all():
        raise InputError(
            f"command has shape {pressures.shape} with values {pressures.tolist()}, "
            f"expected {len(limits)} finite {actuation_word(unit)}s in {unit}"
        )
    low, high = limits.T
    if (pressures < low - 1e-9).any() or (pressures > high + 1e-9).any():
        raise InputError(
            f"command {pressures.tolist()} {unit} leaves the rig's limits "
            f"{low.min():g} to {high.max():g} {unit}"
        )
    return pressures


def check_simulated(
    seed: int, gravity: ArrayLike | None, payload_g: float, most_g: float, noise: float
) -> None:
    """Raise an InputError for a robot, mounting or noise that no simulated rig can have.

    seed: of the robot; gravity: (3,) direction of weight of any length but zero, None where the
    robot's seed draws it; payload_g, most_g: mass at the tip and the largest that is accepted [g];
    noise: factor on all noise.
    """
    if seed < 0:
        raise InputError(f"seed is {seed}, expected a whole number >= 0")
    if gravity is not None:
        direction = np.asarray(gravity, np.float64)
        if direction.shape != (3,) or not np.isfinite(direction).all() or not direction.any():
            raise InputError(
                f"gravity is {direction.tolist()}, expected a direction of three numbers"
            )
    if not 0.0 <= payload_g <= most_g:
        raise InputError(f"payload is {payload_g} g, expected 0 to {most_g:g} g")
    if not (np.isfinite(noise) and noise >= 0.0):
        raise InputError(f"noise scale is {noise}, expected a number >= 0")
