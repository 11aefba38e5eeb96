"""Configuration of the robot; LeRobot finds `SurgisoftRig` by this class's name and module."""

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig


@RobotConfig.register_subclass("surgisoft_rig")
@dataclass(kw_only=True)
class SurgisoftRigConfig(RobotConfig):
    """Options after `--robot.`."""

    rig: str = "virtual"
    """Name and options of the rig, as of surgisoft's `--rig`."""
    hold_missing: bool = False
    """Whether a key point that the cameras lost keeps its last position instead of NaN."""
