"""Set-up before physics: frames, units, orders, chambers, clocks and dead channels, tested exactly.

A camera frame turned by 90 degrees, swapped tubes or metres for millimetres make an error that no
effect of the catalogue describes to first order. `find_setup_faults` tests what goes wrong before
any physics, alone and together, and names what the error on held-out blocks proves.
"""

from surgisoft.diagnosis.setup.result import SetupResult, find_setup_faults, find_small_frame
from surgisoft.diagnosis.setup.words import SetupFault

__all__ = ["SetupFault", "SetupResult", "find_setup_faults", "find_small_frame"]
