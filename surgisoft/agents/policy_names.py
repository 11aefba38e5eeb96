"""Names of policies: which are the same one, and short names by which people tell them apart."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path


def without_repeats(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Names of policies without those of a folder that is named before, and these repeated ones."""
    found: dict[str, str] = {}
    repeated = []
    for name in names:
        folder = os.path.realpath(name)
        if folder in found:
            repeated.append(name)
        else:
            found[folder] = name
    return list(found.values()), repeated


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Name of a policy -> the shortest end of its path that no other one of the names has.

    `a/run` and `b/run` stay as they are, `runs/a` and `scripted` are `a` and `scripted`.
    """
    parts = {name: _parts(name) for name in names}
    return {name: _shortest(name, parts) for name in names}


def _shortest(name: str, parts: dict[str, tuple[str, ...]]) -> str:
    """The shortest end of a name's parts that is the end of no other name."""
    own = parts[name]
    for count in range(1, len(own) + 1):
        end = own[-count:]
        if all(other[-count:] != end for also, other in parts.items() if also != name):
            return str(Path(*end))
    return name


def _parts(name: str) -> tuple[str, ...]:
    """The parts of a path; of one that goes upwards, or of this folder, those from the root."""
    plain = Path(os.path.normpath(name)).parts
    return Path(os.path.abspath(name)).parts if not plain or plain[0] == ".." else plain
