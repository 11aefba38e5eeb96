"""What an exported controller computes, as NumPy code around a user's Python callable.

`surgisoft export RUN -o DIR` writes this file as DIR/controller_code.py where an arm model of the
run calls Python code; `controller.py` opens it. It needs NumPy and the callable's own module.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from surgisoft.surrogate.callables.portable import Called

ABOUT: dict[str, Any] = {}
"""Inputs, and the callables; filled in below where the file was exported."""
STEPS: dict[str, Any] = {}
"""The function `controller`; filled in below where the file was exported."""


def opened(models: Any = None):
    """The controller's function: arrays by name in, a list of arrays out.

    models: the callables in the order of `ABOUT`; None: they are imported by their names.
    """
    each = ABOUT["model_code"]
    given = [None] * len(each) if models is None else models
    called = [Called(about, model) for about, model in zip(each, given, strict=True)]

    def call(values: dict[str, np.ndarray]) -> list:
        with np.errstate(all="ignore"):
            return list(STEPS["controller"](called, *(values[name] for name in ABOUT["inputs"])))

    return call


def _described(text: str) -> None:
    ABOUT.update(json.loads(text))
