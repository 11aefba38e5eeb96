"""Cases for a diagnosis on arms that tendons bend: recordings before and after a change.

    python -m benchmarks.tendon_cases FOLDER [--robots 1000,1001,...] [--count 93] [--seed 1]
        [--pairs 0] [--unknown 0] [--later 0] [--processes 1]

`benchmarks.rig_cases` describes the folder (such as runs/tendon, outside git) and the plans, and
`benchmarks.tendon_arm` the physics. The actuation is the pull of each tendon in mm. Changes are
drawn in mm for each 100 mm of the arm. A round has two known effects more than those of the other
generators: `backlash` and `inertia`. `robot.json` has one field more, `fit`: the budget of the fit
of the robot's model. MuJoCo is no dependency: `pip install 'mujoco>=3.9,<4'`.
"""

from dataclasses import replace

from benchmarks.generators import generator
from benchmarks.rig_cases import FURTHER_KNOWN, main
from benchmarks.tendon_arm.rig import TendonRig
from benchmarks.tendon_arm.robot import build_of, make_robot

ROBOTS = "1000,1001,1002,1003,1004"
"""Seeds of the default robots: one of each build."""
UNKNOWN = (
    "draught",
    "marker_slip",
    "loose_disk",
    "jumped_tendon",
    "kinked_sheath",
    "snag",
    "loose_screw",
    "lost_steps",
)
"""Hidden effects for which a diagnosis has no name."""

GENERATOR = replace(
    generator(TendonRig, UNKNOWN, build_of, make_robot, tries=1), further=tuple(FURTHER_KNOWN)
)
"""Arms that tendons bend."""

if __name__ == "__main__":
    main(GENERATOR, __doc__ or "", ROBOTS)
