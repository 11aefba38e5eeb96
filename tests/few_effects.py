"""Fewer effects, for tests in which a few will do.

A diagnosis tries every known effect and every pair of effects, a comparison every effect: with a
third of the effects they take a fraction of the time.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from surgisoft.diagnosis import compare as comparing
from surgisoft.diagnosis import diagnose as diagnosing
from surgisoft.diagnosis.candidates import candidates
from surgisoft.surrogate.effects import EFFECTS, known_effects


def all_but(*effects: str) -> list[str]:
    """What `without` leaves out, so that these effects alone are tried."""
    return [name for name in known_effects() if name not in effects]


def choose_among(patch: pytest.MonkeyPatch, *effects: str) -> None:
    """Let every diagnosis choose among these effects, and `compare` as well.

    For what takes no `without`: `improve`, `amend` with recordings from before, `compare`. Fits of
    effects that are named to them know all others, too.
    """
    some = {name: known_effects()[name] for name in effects}
    for module in (diagnosing, comparing):
        patch.setattr(module, "known_effects", lambda: some)
    patch.setattr(comparing, "candidates", lambda problem: candidates(problem, list(effects)))


@contextmanager
def few_effects(*names: str) -> Iterator[None]:
    """Inside the block, the package has these effects and hysteresis, which the default arm has.

    For whole commands, and programs that start them in this process.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in EFFECTS.keys() - {"hysteresis", *names}:
            patch.delitem(EFFECTS, name)
        yield
