"""Mutation testing: meaningful changes of the source, each with the tests that should notice it.

`mutants.toml` is the list. `python -m benchmarks.mutants` copies the tree, applies one mutant after
the other, runs its tests and lists the survivors.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

LIST = Path(__file__).with_name("mutants.toml")
"""The list of mutants."""


@dataclass(frozen=True)
class Mutant:
    """One change of the source."""

    name: str
    """What is wrong with the changed program, in words."""
    area: str
    """What it decides."""
    file: str
    """Path in the repository."""
    old: str
    """Text that occurs once in the file."""
    new: str
    """Text in its place."""
    tests: tuple[str, ...]
    """Tests that should notice, files or single ones (`FILE::TEST`), the most likely first."""
    issue: bool = False
    """Whether no test noticed it in the trial of 2026-11-22."""


def mutants(path: Path = LIST) -> list[Mutant]:
    """All mutants of the list."""
    with path.open("rb") as file:
        return [
            Mutant(**row | {"tests": tuple(row["tests"])}) for row in tomllib.load(file)["mutant"]
        ]


def mutated(mutant: Mutant, text: str) -> str:
    """The text of the mutant's file after the change; raises ValueError where it does not apply."""
    if text.count(mutant.old) != 1:
        raise ValueError(
            f"mutant '{mutant.name}': its old text occurs {text.count(mutant.old)} times in "
            f"{mutant.file}, expected once"
        )
    return text.replace(mutant.old, mutant.new)
