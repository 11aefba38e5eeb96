"""Diagnoses among a few effects, where the others cost time and are not what is tested."""

import pytest

from surgisoft.diagnosis import compare as comparing
from surgisoft.diagnosis import diagnose as diagnosing
from surgisoft.diagnosis.candidates import candidates
from surgisoft.surrogate.effects import known_effects


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
