"""Cache of benchmark results: files in a folder, named by a digest of what they depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from surgisoft.files import write_atomically


def digest(about: Any) -> str:
    """Twelve letters that differ where plain values (dicts, lists, numbers, text) do."""
    text = json.dumps(about, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def model_digest(folder: Path) -> str:
    """Digest of an arm model's folder: its configuration and its weights."""
    found = hashlib.sha256()
    for name in ("config.json", "weights.safetensors"):
        found.update((folder / name).read_bytes())
    return found.hexdigest()[:12]


class Cache:
    """A folder of results.

    A result's name ends in the digest of its inputs: other settings or another model give another
    name. The program is no part of the digest: after a change of the code, use an empty folder.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)

    def place(self, name: str, about: Any) -> Path:
        """Path of the named result of these inputs, which may not exist yet."""
        path = self.folder / f"{name}-{digest(about)}"
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def values(self, name: str, about: Any, make: Callable[[], Any]) -> Any:
        """Values for JSON: read from the cache, or made and written to it."""
        file = self.place(name, about).with_suffix(".json")
        if not file.is_file():
            values = {"from": about, "values": make()}
            write_atomically(file, (json.dumps(values, indent=1) + "\n").encode())
        return json.loads(file.read_text())["values"]
