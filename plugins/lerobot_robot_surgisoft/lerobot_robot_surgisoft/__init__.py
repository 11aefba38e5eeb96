"""Every rig of surgisoft as a LeRobot robot of the type `surgisoft_rig`, and a schedule file as the
teleoperator `surgisoft_schedule`."""

from surgisoft.extras import with_advice

with with_advice():  # LeRobot is an extra of surgisoft
    from lerobot_robot_surgisoft.config_surgisoft_rig import SurgisoftRigConfig
    from lerobot_robot_surgisoft.config_surgisoft_schedule import SurgisoftScheduleConfig
    from lerobot_robot_surgisoft.surgisoft_rig import SurgisoftRig
    from lerobot_robot_surgisoft.surgisoft_schedule import SurgisoftSchedule

__all__ = ["SurgisoftRig", "SurgisoftRigConfig", "SurgisoftSchedule", "SurgisoftScheduleConfig"]
