"""Every rig of surgisoft as a LeRobot robot of the type `surgisoft_rig`."""

from lerobot_robot_surgisoft.config_surgisoft_rig import SurgisoftRigConfig
from lerobot_robot_surgisoft.surgisoft_rig import SurgisoftRig

__all__ = ["SurgisoftRig", "SurgisoftRigConfig"]
