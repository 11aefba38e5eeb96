"""A simulated rig whose arm is a Cosserat rod of PyElastica; needs the extra `elastica`.

`robot` draws a robot; `plant` steps `rod` (PyElastica's mechanics), `wall` (material), `gas`
(pneumatics) and the project's motion capture together; `hidden` has the effects; `rig` offers it
all as a `Rig`.
"""

from surgisoft.rig.elastica.hidden import HIDDEN
from surgisoft.rig.elastica.rig import ElasticaRig, ElasticaRigConfig
from surgisoft.rig.elastica.robot import robot_size

__all__ = ["HIDDEN", "ElasticaRig", "ElasticaRigConfig", "robot_size"]
