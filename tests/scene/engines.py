"""The batched engines for accelerators, which run on the CPU in tests."""

from importlib.util import find_spec

import pytest

ON_ACCELERATORS = (
    "torch",
    pytest.param(
        "warp",
        marks=pytest.mark.skipif(
            find_spec("warp") is None, reason="warp-lang is not installed (extra gpu)"
        ),
    ),
)
"""Names of the engines, as parameters of a test."""
