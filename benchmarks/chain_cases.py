"""Cases for a diagnosis on chains of rigid links: robots with recordings before and after a change.

    python -m benchmarks.chain_cases FOLDER [--robots 600,601,...] [--count 87] [--seed 1]
        [--pairs 0] [--unknown 0] [--later 0] [--processes 1]

`benchmarks.rig_cases` describes the folder (such as runs/chain, outside git) and the plans, and
`benchmarks.chain` the physics. Changes are drawn in mm for each 100 mm of the arm. `robot.json`
has one field more, `fit`: the budget of the fit of the robot's model.
"""

from benchmarks.chain.rig import ChainRig
from benchmarks.chain.robot import build_of, make_robot
from benchmarks.generators import generator
from benchmarks.rig_cases import main

ROBOTS = "600,601,602,603,604,605"
"""Seeds of the default robots: one of each build."""
UNKNOWN = (
    "breathing",
    "stick_slip",
    "knock",
    "tear",
    "marker_slip",
    "kinked_line",
    "snap_through",
    "dropout",
)
"""Hidden effects for which a diagnosis has no name."""

GENERATOR = generator(ChainRig, UNKNOWN, build_of, make_robot, tries=4)
"""Chains of rigid links."""

if __name__ == "__main__":
    main(GENERATOR, __doc__ or "", ROBOTS)
