"""Cases for a diagnosis on rods of polynomial strains: recordings before and after a change.

    python -m benchmarks.strain_rod_cases FOLDER [--robots 900,901,...] [--count 87] [--seed 1]
        [--pairs 0] [--unknown 0] [--later 0] [--processes 1]

`benchmarks.rig_cases` describes the folder (such as runs/strain_rod, outside git) and the plans,
and `benchmarks.strain_rod` the physics. Changes are drawn in mm for each 100 mm of the arm.
`robot.json` has one field more, `fit`: the budget of the fit of the robot's model.
"""

from benchmarks.generators import generator
from benchmarks.rig_cases import main
from benchmarks.strain_rod.rig import StrainRodRig
from benchmarks.strain_rod.robot import build_of, make_robot

ROBOTS = "900,901,902,903,904"
"""Seeds of the default robots: one of each build."""
UNKNOWN = (
    "breathing",
    "stick_slip",
    "relief",
    "crossflow",
    "footsteps",
    "fibre_break",
    "winding_hose",
    "sunbeam",
)
"""Hidden effects for which a diagnosis has no name."""

GENERATOR = generator(StrainRodRig, UNKNOWN, build_of, make_robot, tries=4)
"""Rods of polynomial strains."""

if __name__ == "__main__":
    main(GENERATOR, __doc__ or "", ROBOTS)
