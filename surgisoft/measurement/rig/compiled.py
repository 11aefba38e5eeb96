"""How the rig's inner loops are compiled: by numba, cached on disk, division as in IEEE 754."""

from numba import njit

compiled = njit(cache=True, error_model="numpy")
