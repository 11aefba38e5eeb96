"""Configuration of the teleoperator; LeRobot finds `SurgisoftSchedule` by its name and module."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("surgisoft_schedule")
@dataclass(kw_only=True)
class SurgisoftScheduleConfig(TeleoperatorConfig):
    """Options after `--teleop.`."""

    schedule: str
    """CSV file with the columns t_s, c1_kPa ..., as `surgisoft next-experiment -o` writes it."""
