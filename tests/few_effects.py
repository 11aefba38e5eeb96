"""Fewer effects, for tests in which a few will do.

A diagnosis and a comparison try every known effect, and every pair of two: with a third of them
they take a fraction of the time.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from surgisoft.surrogate.effects import EFFECTS


@contextmanager
def few_effects(*names: str) -> Iterator[None]:
    """Inside the block the package has these effects alone, and hysteresis, which its arm has."""
    with pytest.MonkeyPatch.context() as patch:
        for name in EFFECTS.keys() - {"hysteresis", *names}:
            patch.delitem(EFFECTS, name)
        yield
