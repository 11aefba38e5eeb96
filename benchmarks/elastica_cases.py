"""Cases for a diagnosis on the PyElastica rig: robots with recordings before and after a change.

    python -m benchmarks.elastica_cases FOLDER [--robots 101,102,...] [--count 100] [--seed 1]
        [--pairs 0] [--unknown 0] [--later 0] [--processes 1]

`benchmarks.rig_cases` describes the folder (such as runs/elastica, outside git) and the plans.
"""

from benchmarks.rig_cases import Generator, main
from surgisoft.rig.elastica import ElasticaRig

ROBOTS = "101,102,103,104,105"
"""Seeds of the default robots."""
ELEMENTS = 8
"""Elements of each rod: a rod of 12 takes twice the time, and each is a robot of its own anyway."""
UNKNOWN = ("breathing", "stick_slip", "leak", "knock")
"""Hidden effects of the rounds for which a diagnosis has no name."""
BEFORE_S = {"mixed": 180.0, "other": 150.0}
"""Durations of the recordings before a change [s]."""


def arm(robot: int, **fields) -> ElasticaRig:
    """The rig with a robot; fields: of `ElasticaRigConfig`."""
    return ElasticaRig(robot, elements=ELEMENTS, **fields)


def before_s(robot: int) -> dict[str, float]:
    """Durations of the recordings before a change [s]: those of every robot."""
    return BEFORE_S


GENERATOR = Generator(arm, UNKNOWN, (*UNKNOWN, "tear", "marker_slip"), before_s)
"""Robots of the PyElastica rig."""

if __name__ == "__main__":
    main(GENERATOR, __doc__ or "", ROBOTS)
