"""Rigs: the interface of a test bench with a soft arm, and a simulated test bench.

`interface` defines a rig, real or virtual; `collect` drives any of them through a protocol
into a recording. `virtual` is the simulated rig: `arm` (with `rod`, `wall`, `friction`),
`pneumatics`, `motion_capture` and the hidden `effects`, stepped together in `bench`. It shares no
code with the arm models and imports neither them nor torch; some of its formulas are theirs
(`docs/results/index.md`). `elastica` is a second simulated rig, with PyElastica's mechanics.
`registry` opens a rig by its name and options, and `trial` records on it. `safety` stands between
any program and a real rig.
"""

from surgisoft.rig.collect import collect
from surgisoft.rig.interface import Rig, Sample, SimulatedRig, Truth
from surgisoft.rig.registry import open_rig
from surgisoft.rig.safety import RigStopped, SafeRig, Safety, guarded
from surgisoft.rig.virtual import VirtualRig, VirtualRigConfig

__all__ = [
    "Rig",
    "RigStopped",
    "SafeRig",
    "Safety",
    "Sample",
    "SimulatedRig",
    "Truth",
    "VirtualRig",
    "VirtualRigConfig",
    "collect",
    "guarded",
    "open_rig",
]
