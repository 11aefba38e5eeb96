"""The teleoperator: a `surgisoft.rig.lerobot.NamedSchedule` behind LeRobot's interface."""

from typing import Any

from lerobot.teleoperators.teleoperator import Teleoperator

from lerobot_robot_surgisoft.config_surgisoft_schedule import SurgisoftScheduleConfig
from surgisoft.rig.lerobot import NamedSchedule


class SurgisoftSchedule(Teleoperator):
    """A schedule of commanded pressures in the place of a person's hand."""

    config_class = SurgisoftScheduleConfig
    name = "surgisoft_schedule"

    def __init__(self, config: SurgisoftScheduleConfig):
        """Read the schedule of the configuration."""
        super().__init__(config)
        self.config = config
        self.schedule = NamedSchedule(config.schedule)
        self._connected = False

    @property
    def action_features(self) -> dict[str, type]:
        """Names of the commanded values; all are numbers."""
        return dict.fromkeys(self.schedule.names, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Empty: a schedule feels nothing."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called."""
        return self._connected

    def connect(self, calibrate: bool = True) -> None:
        """Be ready; the schedule begins with the first action."""
        self._connected = True

    @property
    def is_calibrated(self) -> bool:
        """True: there is nothing to calibrate."""
        return True

    def calibrate(self) -> None:
        """Do nothing: there is nothing to calibrate."""

    def configure(self) -> None:
        """Do nothing: the file is the configuration."""

    def get_action(self) -> dict[str, Any]:
        """The commands at this time."""
        return self.schedule.command()

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing: a schedule feels nothing."""

    def disconnect(self) -> None:
        """End."""
        self._connected = False
