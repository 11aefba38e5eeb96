"""Which measured rows a model was fitted to: a sketch that is stored with the model.

Every row has a hash of its actuation and key points, rounded to float32; the sketch holds the least
of all hashes (bottom-k sketch: Broder 1997). Of other recordings those rows count as known whose
hash is in the sketch, among all with a hash that is small enough to be in it. So a recording is
recognised under another name, and when it was cut or joined with others.

Not all rows are used alike: some trained the network, some only chose among its epochs and effects
and made its interval, and some only fitted effects that were added later. The sketch says which.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from torch import Tensor

from surgisoft.surrogate.history import History

Use = Literal["fitted", "chosen", "amended"]
"""What rows were used for: training; only choosing the model; only fitting effects to it."""
IN_WORDS: dict[Use, str] = {
    "fitted": "the model was fitted to {} of its rows",
    "chosen": "the model was chosen, not trained, by {} of its rows",
    "amended": "effects of the model were fitted to {} of its rows",
}
"""What a model has seen of a recording; {}: share of its rows."""
TUNED_IN_WORDS = "effects and the network of the model were fitted to {} of its rows"
"""The same of rows that trained the network further when effects were fitted to them."""
SIZE = 512
"""Most hashes of a sketch. Of 10,000 fitted rows 5 % of the hashes are in it, so that 3,000 other
rows are judged by some 150 of them."""
LEAST_KNOWN = 0.02
"""Least share of some rows in the fit of a model from which on they took part in it."""


@dataclass(frozen=True)
class Seen:
    """What a model has seen of some rows."""

    shares: dict[Use, float]
    """Share 0..1 of the rows in each use that counts; empty where the model has seen none."""
    tuned: float = 0.0
    """Share 0..1 of the rows that trained the network further when effects were fitted to them;
    0 where it is less than `LEAST_KNOWN`. They are among the fitted ones."""

    def __bool__(self) -> bool:
        return bool(self.shares)

    @property
    def effects_alone(self) -> bool:
        """Whether nothing but effects was fitted to rows that the model has seen."""
        return set(self.shares) == {"amended"}

    @property
    def effects_in_words(self) -> str:
        """What was fitted to the rows that effects were added for; empty where there are none."""
        found = [(IN_WORDS["amended"], self.shares.get("amended", 0.0))]
        found.append((TUNED_IN_WORDS, self.tuned))
        return " and ".join(text.format(f"{100 * share:.0f} %") for text, share in found if share)

    @property
    def words(self) -> str:
        """The same in words, with the shares; empty for nothing."""
        return " and ".join(
            IN_WORDS[use].format(f"{100 * share:.0f} %") for use, share in self.shares.items()
        )


@dataclass(frozen=True)
class FittedRows:
    """A sketch of the rows that a model was fitted to."""

    count: int
    """Number of rows; of two sketches that were joined, of both."""
    hashes: tuple[int, ...]
    """The least hashes, ascending, at most SIZE; 64 bits each."""
    complete: bool = True
    """Whether these are all rows; not where a model that keeps no record was amended."""
    chosen: frozenset[int] = frozenset()
    """Those of the hashes whose rows only chose the model."""
    amended: frozenset[int] = frozenset()
    """Those of the hashes to whose rows only effects were fitted, in a model that was amended."""
    tuned: frozenset[int] = frozenset()
    """Those of the hashes whose rows trained the network further when effects were fitted to them,
    in a model that was amended."""

    @classmethod
    def of(
        cls, histories: Iterable[History], use: Use = "fitted", tuned: bool = False
    ) -> FittedRows:
        """The sketch of all rows of histories with a measured key point, used for one thing.

        tuned: whether effects were fitted to these rows, too, which trained the network further.
        """
        found = np.concatenate([row_hashes(history) for history in histories])
        hashes = tuple(np.unique(found)[:SIZE].tolist())
        known = cls(len(found), hashes).used(use)
        return replace(known, tuned=frozenset(hashes)) if tuned else known

    @classmethod
    def of_amending(cls, history: History, trained: bool) -> FittedRows:
        """The sketch of the rows of a history that effects were fitted to.

        trained: whether they trained the network, too.
        """
        return cls.of([history], "fitted" if trained else "amended", tuned=trained)

    def used(self, use: Use) -> FittedRows:
        """The same rows, all in one use."""
        every, none = frozenset(self.hashes), frozenset[int]()
        return replace(
            self,
            chosen=every if use == "chosen" else none,
            amended=every if use == "amended" else none,
            tuned=none,
        )

    def joined(self, other: FittedRows | None) -> FittedRows:
        """The sketch of the rows of both; other: None where its rows are not known."""
        if other is None:
            return replace(self, complete=False)
        whole = sorted({*self.hashes, *other.hashes})[:SIZE]
        both = self.complete and other.complete
        # Rows with several uses count for the one that makes their error smallest.
        fitted = self._fitted | other._fitted
        chosen = (self.chosen | other.chosen) - fitted
        amended = (self.amended | other.amended) - fitted - chosen
        return FittedRows(
            self.count + other.count,
            tuple(whole),
            both,
            chosen.intersection(whole),
            amended.intersection(whole),
            (self.tuned | other.tuned).intersection(whole),
        )

    @property
    def _fitted(self) -> frozenset[int]:
        """The hashes of rows that trained the network."""
        return frozenset(self.hashes) - self.chosen - self.amended

    def uses_of(
        self, history: History, rows: np.ndarray | None = None, parts: np.ndarray | None = None
    ) -> dict[Use, float]:
        """Estimated share 0..1 of the measured rows of a history in each use.

        Equal rows count once: an arm at rest before coarse sensors gives the same row again and
        again, in any recording. rows: (N,) bool, which rows of all runs one after another are asked
        about. parts: (N,) labels of parts that are estimated apart and weighed by their rows, which
        is exact where the model was fitted to all or none of a part, as by `amend`.
        """
        known: dict[Use, frozenset[int]] = {
            "fitted": self._fitted,
            "chosen": self.chosen,
            "amended": self.amended,
        }
        shares = self._shares(list(known.values()), history, rows, parts)
        return dict(zip(known, shares, strict=True))

    def _shares(
        self,
        known: list[frozenset[int]],
        history: History,
        rows: np.ndarray | None,
        parts: np.ndarray | None,
    ) -> list[float]:
        """Estimated share of a history's rows whose hash is in each of some sets; rows, parts: as
        for `uses_of`."""
        if parts is None:
            hashes = [np.unique(row_hashes(history, rows))]
        else:
            asked = np.ones(len(parts), bool) if rows is None else rows
            labels = np.unique(parts)
            hashes = [np.unique(row_hashes(history, asked & (parts == part))) for part in labels]
        total = max(sum(map(len, hashes)), 1)
        shares = [0.0] * len(known)
        for found in hashes:
            judged = found[found <= self.hashes[-1]] if len(self.hashes) == SIZE else found
            own, count = set(judged.tolist()), max(len(judged), 1)
            for place, some in enumerate(known):
                shares[place] += len(own & some) / count * len(found) / total
        return shares

    def share_of(
        self, history: History, rows: np.ndarray | None = None, parts: np.ndarray | None = None
    ) -> float:
        """Estimated share 0..1 of the measured rows of a history that the model was fitted to, in
        any use; rows, parts: as for `uses_of`."""
        return min(sum(self.uses_of(history, rows, parts).values()), 1.0)

    def part_of(
        self, history: History, rows: np.ndarray | None = None, parts: np.ndarray | None = None
    ) -> float:
        """`share_of`, or 0 where it is less than `LEAST_KNOWN`: the rows took no part."""
        share = self.share_of(history, rows, parts)
        return share if share >= LEAST_KNOWN else 0.0

    def certain_part_of(self, history: History, parts: np.ndarray | None = None) -> float | None:
        """`part_of`, or None where none of the rows is known but the record is not complete."""
        share = self.part_of(history, parts=parts)
        return share if share or self.complete else None

    def seen_of(self, history: History, parts: np.ndarray | None = None) -> Seen:
        """What the model has seen of a history; parts: as for `uses_of`."""
        shares = self.uses_of(history, parts=parts)
        if sum(shares.values()) < LEAST_KNOWN:
            return Seen({})
        least = min(LEAST_KNOWN, max(shares.values()))
        (tuned,) = self._shares([self.tuned], history, None, parts)
        return Seen(
            {use: shares[use] for use in IN_WORDS if shares[use] >= least},
            tuned if tuned >= LEAST_KNOWN else 0.0,
        )

    def to_json(self) -> dict:
        """Plain values for a model's `config.json`."""
        values = {
            "rows": self.count,
            "complete": self.complete,
            "hashes": [f"{value:016x}" for value in self.hashes],
            "chosen": [f"{value:016x}" for value in sorted(self.chosen)],
            "amended": [f"{value:016x}" for value in sorted(self.amended)],
        }
        if self.tuned:
            values["tuned"] = [f"{value:016x}" for value in sorted(self.tuned)]
        return values

    @classmethod
    def from_json(cls, values: dict) -> FittedRows:
        """The sketch of a model's `config.json`."""
        hashes, *uses = (
            [int(text, 16) for text in values.get(kind, ())]
            for kind in ("hashes", "chosen", "amended", "tuned")
        )
        complete = bool(values.get("complete", True))
        rows = int(values["rows"])
        return cls(rows, tuple(hashes), complete, *map(frozenset, uses))


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
