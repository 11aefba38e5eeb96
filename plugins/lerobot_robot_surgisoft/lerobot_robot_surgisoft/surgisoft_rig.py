"""The robot: a `surgisoft.rig.lerobot.NamedRig` behind LeRobot's interface."""

from typing import Any

from lerobot.robots.robot import Robot

from lerobot_robot_surgisoft.config_surgisoft_rig import SurgisoftRigConfig
from surgisoft.rig.lerobot import NamedRig


class SurgisoftRig(Robot):
    """A soft arm on a rig: pressures and key points out, commanded pressures in."""

    config_class = SurgisoftRigConfig
    name = "surgisoft_rig"

    def __init__(self, config: SurgisoftRigConfig):
        """Open the rig of the configuration, without driving it yet."""
        super().__init__(config)
        self.config = config
        self.rig = NamedRig(config.rig, config.hold_missing)
        self.cameras: dict[str, Any] = {}  # `lerobot-record` counts them; no rig has images

    @property
    def observation_features(self) -> dict[str, type]:
        """Names of the measured values; all are numbers."""
        return dict.fromkeys(self.rig.state_names, float)

    @property
    def action_features(self) -> dict[str, type]:
        """Names of the commanded values; all are numbers."""
        return dict.fromkeys(self.rig.action_names, float)

    @property
    def is_connected(self) -> bool:
        """Whether the rig is being driven."""
        return self.rig.is_connected

    def connect(self, calibrate: bool = True) -> None:
        """Vent the arm, wait until it is at rest, and begin to drive it."""
        self.rig.connect()

    @property
    def is_calibrated(self) -> bool:
        """True: pressures and cameras are calibrated outside of LeRobot."""
        return True

    def calibrate(self) -> None:
        """Do nothing: pressures and cameras are calibrated outside of LeRobot."""

    def configure(self) -> None:
        """Do nothing: the options of the rig are its configuration."""

    def get_observation(self) -> dict[str, Any]:
        """One sample; waits for one period of the rig."""
        return self.rig.observe()

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Command the pressures; returns what was sent, within the rig's limits."""
        return self.rig.send(action)

    def disconnect(self) -> None:
        """Vent the arm and give the devices back."""
        self.rig.disconnect()
