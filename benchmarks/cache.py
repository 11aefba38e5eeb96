"""Results of long studies, kept in a folder and found again by what they depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from surgisoft.files import write_atomically

Report = Callable[[float, float, str], None]
"""Called with what is done, what there is to do, and a note."""


def digest(about: Any) -> str:
    """Twelve letters that differ where plain values (dicts, lists, numbers, text) do."""
    text = json.dumps(about, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def model_digest(folder: Path) -> str:
    """The same for an arm model's folder: its configuration and its weights."""
    found = hashlib.sha256()
    for name in ("config.json", "weights.safetensors"):
        found.update((folder / name).read_bytes())
    return found.hexdigest()[:12]


class Kept:
    """A folder of results.

    A result's name ends in the digest of what it was made from: other settings or another model
    give another name. Results of older code stay: a changed program wants an empty folder.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)

    def place(self, name: str, about: Any) -> Path:
        """Where the named result of such an origin is, or will be."""
        path = self.folder / f"{name}-{digest(about)}"
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def values(self, name: str, about: Any, make: Callable[[], Any]) -> Any:
        """Plain values: read, or made and written."""
        file = self.place(name, about).with_suffix(".json")
        if not file.is_file():
            values = {"from": about, "values": make()}
            write_atomically(file, (json.dumps(values, indent=1) + "\n").encode())
        return json.loads(file.read_text())["values"]


class Meter:
    """One bar over stages of unlike length."""

    def __init__(self, report: Report, total: float):
        self._report, self.total, self.done = report, total, 0.0

    def stage(self, weight: float, note: str) -> Report:
        """The next stage: a report of its own, from 0 to all of it."""
        before, self.done = self.done, self.done + weight
        self._report(before, self.total, note)

        def inner(done: float, total: float, more: str = "") -> None:
            share = done / total if total else 0.0
            text = f"{note}: {more}" if more else note
            self._report(before + weight * share, self.total, text)

        return inner
