"""The allocator's treatment of freed memory.

glibc returns large freed blocks to the operating system and asks for them again in the next call.
The kernel then clears every page anew: at 4096 parallel episodes a quarter of a step's time.
"""

from __future__ import annotations

import ctypes
import functools
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt (man 3 mallopt)."""
LARGEST_KEPT = 1 << 30
"""Blocks up to this size come from memory that stays with the process, bytes."""


@functools.cache
def keep_freed_memory(most: int = LARGEST_KEPT) -> bool:
    """Let this process keep memory that it frees, for its next allocations; whether it does.

    For loops that allocate the same large arrays again and again. most: size of the largest blocks
    that are kept, bytes. Only with glibc; elsewhere the call has no effect.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    mallopt.argtypes, mallopt.restype = (ctypes.c_int, ctypes.c_int), ctypes.c_int
    kept = min(4 * most, (1 << 31) - 1)
    return bool(mallopt(_MMAP_THRESHOLD, most) and mallopt(_TRIM_THRESHOLD, kept))
