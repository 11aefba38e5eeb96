"""Cases for a diagnosis on arms in MuJoCo: robots with recordings before and after a change.

    python -m benchmarks.mujoco_cases FOLDER [--robots 800,801,...] [--count 87] [--seed 1]
        [--pairs 0] [--unknown 0] [--later 0] [--processes 1]

`benchmarks.rig_cases` describes the folder (such as runs/mujoco, outside git) and the plans, and
`benchmarks.mujoco_arm` the physics. Changes are drawn in mm for each 100 mm of the arm.
`robot.json` has one field more, `fit`: the budget of the fit of the robot's model. MuJoCo is no
dependency: `pip install 'mujoco>=3.9,<4'`.
"""

from benchmarks.generators import generator
from benchmarks.mujoco_arm.rig import MujocoRig
from benchmarks.mujoco_arm.robot import build_of, make_robot
from benchmarks.rig_cases import main

ROBOTS = "800,801,802,803,804"
"""Seeds of the default robots: one of each build."""
UNKNOWN = (
    "breathing",
    "stick_slip",
    "cable",
    "leak",
    "loose_mount",
    "wind",
    "snag",
    "delamination",
)
"""Hidden effects for which a diagnosis has no name."""

GENERATOR = generator(MujocoRig, UNKNOWN, build_of, make_robot, tries=1)
"""Arms in MuJoCo."""

if __name__ == "__main__":
    main(GENERATOR, __doc__ or "", ROBOTS)
