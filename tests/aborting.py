"""Readers that end their process in different ways, for the tests of `surgisoft.apart`."""

import os
import signal

import numpy as np

from surgisoft.apart import packed
from surgisoft.errors import InputError


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
    return packed({"path": path.name}, np.arange(3.0), np.array([[1, 2]]))
