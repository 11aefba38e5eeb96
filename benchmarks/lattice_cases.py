"""Cases for a diagnosis on lattices of springs: robots with recordings before and after a change.

    python -m benchmarks.lattice_cases FOLDER [--robots 700,701,...] [--count 87] [--seed 1]
        [--pairs 0] [--unknown 0] [--later 0] [--processes 1]

`benchmarks.rig_cases` describes the folder (such as runs/lattice, outside git) and the plans, and
`benchmarks.lattice` the physics. Changes are drawn in mm for each 100 mm of the arm. `robot.json`
has one field more, `fit`: the budget of the fit of the robot's model.
"""

from benchmarks.generators import generator
from benchmarks.lattice.rig import LatticeRig
from benchmarks.lattice.robot import build_of, make_robot
from benchmarks.rig_cases import main

ROBOTS = "700,701,702,703,704"
"""Seeds of the default robots: one of each build."""
UNKNOWN = (
    "breathing",
    "stick_slip",
    "clamp_slip",
    "buckling",
    "heat_step",
    "leak",
    "cable",
    "lens",
)
"""Hidden effects for which a diagnosis has no name."""

GENERATOR = generator(LatticeRig, UNKNOWN, build_of, make_robot, tries=1)
"""Lattices of springs."""

if __name__ == "__main__":
    main(GENERATOR, __doc__ or "", ROBOTS)
