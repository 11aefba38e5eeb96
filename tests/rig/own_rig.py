"""A rig as a lab would write it, without truth; the virtual rig stands in for its devices."""

import numpy as np

from surgisoft.rig import VirtualRig


class OwnRig:
    """A bench of three chambers."""

    def __init__(self, port: str, robot: int = 0, rate_hz: float = 20.0, chambers: int = 3):
        self.port, self._bench = port, VirtualRig(robot)
        self.chambers, self.key_planes, self.unit = chambers, 5, "kPa"
        self.limits, self.period_s = np.tile([0.0, 40.0], (chambers, 1)), 1.0 / rate_hz
        self.arm, self.gravity, self.payload_g = self._bench.arm, None, None
        self.commands: list[np.ndarray] = []
        self.vents = self.closes = 0

    def reset(self):
        """Vent and rest."""
        self._bench.reset()

    def command(self, pressures):
        """Send set points."""
        self.commands.append(np.array(pressures))
        self._bench.command(pressures)

    def wait(self, seconds):
        """Let time pass."""
        self._bench.wait(seconds)

    def read(self):
        """Wait for a sample."""
        return self._bench.read()

    def vent(self):
        """Open every valve."""
        self.vents += 1
        self._bench.command(np.zeros(3))

    def close(self):
        """Give the port back."""
        self.closes += 1
