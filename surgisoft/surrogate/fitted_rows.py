"""Which measured rows a model was fitted to: a sketch that is stored with the model.

Every row has a hash of its actuation and key points, rounded to float32; the sketch holds the least
of all hashes (bottom-k sketch: Broder 1997). Of other recordings those rows count as known whose
hash is in the sketch, among all with a hash that is small enough to be in it. So a recording is
recognised under another name, and when it was cut or joined with others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from surgisoft.surrogate.history import History

SIZE = 512
"""Most hashes of a sketch. Of 10,000 fitted rows 5 % of the hashes are in it, so that 3,000 other
rows are judged by some 150 of them."""
LEAST_KNOWN = 0.02
"""Least share of some rows in the fit of a model from which on they took part in it."""


@dataclass(frozen=True)
class FittedRows:
    """A sketch of the rows that a model was fitted to."""

    count: int
    """Number of rows; of two sketches that were joined, of both."""
    hashes: tuple[int, ...]
    """The least hashes, ascending, at most SIZE; 64 bits each."""
    complete: bool = True
    """Whether these are all rows; not where a model that keeps no record was amended."""

    @classmethod
    def of(cls, histories: Iterable[History]) -> FittedRows:
        """The sketch of all rows of histories with a measured key point."""
        found = np.concatenate([row_hashes(history) for history in histories])
        return cls(len(found), tuple(np.unique(found)[:SIZE].tolist()))

    def joined(self, other: FittedRows | None) -> FittedRows:
        """The sketch of the rows of both; other: None where its rows are not known."""
        if other is None:
            return replace(self, complete=False)
        whole = sorted({*self.hashes, *other.hashes})[:SIZE]
        both = self.complete and other.complete
        return FittedRows(self.count + other.count, tuple(whole), both)

    def share_of(self, history: History, rows: np.ndarray | None = None) -> float:
        """Estimated share 0..1 of the measured rows of a history that the model was fitted to.

        Equal rows count once: an arm at rest before coarse sensors gives the same row again and
        again, in any recording. rows: (N,) bool, which rows of all runs one after another are asked
        about.
        """
        found = np.unique(row_hashes(history, rows))
        if not self.hashes or not len(found):
            return 0.0
        if len(self.hashes) == SIZE:
            found = found[found <= self.hashes[-1]]
        known = np.isin(found, np.array(self.hashes, np.uint64))
        return float(known.mean()) if len(found) else 0.0

    def part_of(self, history: History, rows: np.ndarray | None = None) -> float:
        """`share_of`, or 0 where it is less than `LEAST_KNOWN`: the rows took no part."""
        share = self.share_of(history, rows)
        return share if share >= LEAST_KNOWN else 0.0

    def certain_part_of(self, history: History) -> float | None:
        """`part_of`, or None where none of the rows is known but the record is not complete."""
        share = self.part_of(history)
        return share if share or self.complete else None

    def to_json(self) -> dict:
        """Plain values for a model's `config.json`."""
        return {
            "rows": self.count,
            "complete": self.complete,
            "hashes": [f"{value:016x}" for value in self.hashes],
        }

    @classmethod
    def from_json(cls, values: dict) -> FittedRows:
        """The sketch of a model's `config.json`."""
        hashes = tuple(int(text, 16) for text in values["hashes"])
        return cls(int(values["rows"]), hashes, bool(values.get("complete", True)))


def row_hashes(history: History, rows: np.ndarray | None = None) -> np.ndarray:
    """(K,) uint64 hash of each row of which some key point was measured.

    rows: (N,) bool, which rows of all runs one after another are asked about.
    """
    pressure, points = (_plain(history.rows(t)) for t in (history.pressure, history.key_points))
    seen = np.isfinite(points).any(1)
    if rows is not None:
        seen &= rows
    values = np.concatenate([pressure, points], 1)[seen]
    digests = [hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in values]
    return np.frombuffer(b"".join(digests), np.uint64)


def _plain(values: Tensor) -> np.ndarray:
    """(N, F) float32 with one zero and one NaN, so that equal numbers are equal bytes."""
    flat = values.float().flatten(1).cpu().numpy() + np.float32(0.0)
    return np.where(np.isnan(flat), np.float32(np.nan), flat)
