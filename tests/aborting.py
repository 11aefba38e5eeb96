"""Readers that end their process in different ways, for the tests of `surgisoft.apart`."""

import os
import signal
import sys

import numpy as np

from surgisoft.apart import packed
from surgisoft.errors import InputError

PATIENCE_S = 0.5
"""Processor time that the reading process gives these readers, s, in place of its 4."""

if hasattr(sys.modules["__main__"], "PATIENCE_S"):  # the reading process is the main module
    sys.modules["__main__"].PATIENCE_S = PATIENCE_S


def as_bytes(path):
    match path.read_text():
        case "segmentation fault":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "abort":
            os.abort()
        case "exception":
            raise ValueError("first line\nlast line")
        case "refused":
            raise InputError(f"{path}: has no frame; expected one")
        case "endless":
            while True:
                pass
        case "memory":
            np.ones(1 << 32)
        case "more memory than a small file needs":
            np.ones(3 << 26)
    return packed({"path": path.name}, np.arange(3.0), np.array([[1, 2]]))
