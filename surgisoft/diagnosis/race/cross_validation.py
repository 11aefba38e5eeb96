"""Held-out error of any set of effects, the surrogate's own error always beside them.

The residual of a model is explained by a flexible function of actuation and direction (the
surrogate's own error, free in every output) and by columns, each with one amplitude. Both are
linear, so everything that a set of columns can do on held-out blocks follows from a few matrices
that are computed once: trying a set costs a small linear solve.
"""

from dataclasses import dataclass, field

import numpy as np

from surgisoft.diagnosis.race.split import Split

RIDGES = (1e-4, 1e-2, 1e-1)
"""Ridges on amplitudes, shares of a column's own power; the best on held-out blocks is taken."""


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Held-out errors of sets of columns."""

    split: Split
    fields: np.ndarray
    """(rows, n, 3, 1 + K) residual and columns, mm; 0 where missing."""
    grams: np.ndarray
    """(L, folds, 1 + K, 1 + K) products of them over the fitted rows, static part out."""
    judged: np.ndarray
    """(L, B, 1 + K, 1 + K) the same of what the static part leaves on each judged block."""
    cache: dict = field(default_factory=dict)
    """Held-out sums of squares and amplitudes by columns."""

    @classmethod
    def of(
        cls,
        features: np.ndarray,
        residual: np.ndarray,
        columns: np.ndarray,
        block: np.ndarray,
        fold: np.ndarray,
        surrogate_mm: np.ndarray,
        noise_mm: np.ndarray,
    ) -> "CrossValidation":
        """features (S, F), residual (S, n, 3) in mm, NaN where missing, and columns (rows, n, 3, K)
        of the rows that are judged.

        block: (S,) block of each row; fold: (B,) fold of each block, blocks of the fold FITTED
        last, on which no column does anything; surrogate_mm and noise_mm: (n,) RMS errors of each
        key point's distance.
        """
        split = Split.of(features, residual, block, fold, surrogate_mm, noise_mm)
        return cls.on(split, columns)

    @classmethod
    def on(cls, split: Split, columns: np.ndarray) -> "CrossValidation":
        """The same with columns (rows, n, 3, K) on a split."""
        first = split.residual[: split.rows, ..., None]
        both = np.concatenate([first, _masked(split, columns)], axis=3)
        known = split.residual[split.rows :]
        turned = split.turned(both, known)
        grams, judged = _products(split, both, turned, both, turned)
        grams[:, :, 0, 0] += np.square(known, dtype=float).sum()
        return cls(split, both, grams, judged)

    def extended(self, columns: np.ndarray) -> "CrossValidation":
        """The same with further columns (rows, n, 3, K') behind those that it has."""
        more = _masked(self.split, columns)
        both = np.concatenate([self.fields, more], axis=3)
        turned = self.split.turned(more)
        known = self.split.residual[self.split.rows :]
        old = self.split.turned(self.fields, known)
        whole = [np.concatenate(pair, axis=3) for pair in zip(old, turned, strict=True)]
        beside = _products(self.split, both, whole, more, turned)
        grams, judged = (
            _bordered(*pair) for pair in zip((self.grams, self.judged), beside, strict=True)
        )
        return CrossValidation(self.split, both, grams, judged, dict(self.cache))

    @property
    def columns(self) -> int:
        """Number of columns, K."""
        return self.fields.shape[3] - 1

    @property
    def counts(self) -> np.ndarray:
        """(B,) measured key points in each block."""
        rows = self.split.rows
        weights = self.split.seen[:rows].sum(1)
        return np.bincount(self.split.block[:rows], weights, minlength=len(self.split.fold))

    def losses(self, picked: list[int] | tuple[int, ...] | np.ndarray = ()) -> np.ndarray:
        """(B,) held-out sum of squared distances of each block, mm^2, with the picked columns."""
        columns = np.unique(np.asarray(picked, int))
        tried, _ = self._solved(columns)
        ridges = len(RIDGES) if len(columns) > 1 else 1
        tried = tried[:, :ridges].reshape(-1, tried.shape[2])
        return tried[tried.sum(axis=1).argmin()]

    def amplitudes(self, picked: list[int] | tuple[int, ...] | np.ndarray) -> np.ndarray:
        """(k,) amplitudes of the picked columns, mean over the folds."""
        columns, where = np.unique(np.asarray(picked, int), return_inverse=True)
        tried, amplitudes = self._solved(columns)
        sums = tried.sum(axis=2)
        level, ridge = np.unravel_index(sums.argmin(), sums.shape)
        return amplitudes[level, ridge].mean(axis=0)[where]

    def _solved(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((L, r, B) held-out sums of squares, (L, r, folds, k) amplitudes) for every ridge."""
        key = columns.tobytes()
        if key not in self.cache:
            rows = np.concatenate([[0], columns + 1])
            amplitudes = _amplitudes(self.grams[:, :, rows[:, None], rows])
            mix = np.insert(-amplitudes, 0, 1.0, axis=-1)[:, :, self.split.fold]
            part = self.judged[:, :, rows[:, None], rows].astype(float)
            losses = (mix * (part[:, None] @ mix[..., None])[..., 0]).sum(axis=-1)
            self.cache[key] = losses, amplitudes
        return self.cache[key]


def _masked(split: Split, columns: np.ndarray) -> np.ndarray:
    """Columns (rows, n, 3, K) in single precision, 0 where nothing was measured."""
    return np.where(split.seen[: split.rows, :, None, None], columns, 0.0).astype(np.float32)


def _products(split: Split, a, turned_a, b, turned_b) -> tuple[np.ndarray, np.ndarray]:
    """(grams, judged) of the columns of two fields (rows, n, 3, A or B), as in CrossValidation."""
    levels, folds, size = len(split.ridges), len(split.bases), (a.shape[3], b.shape[3])
    parts = np.array([_product(a[rows], b[rows]) for rows in split.held], float)
    grams = np.broadcast_to(parts.sum(axis=0) - parts, (levels, folds, *size)).copy()
    judged = np.empty((levels, len(split.fold), *size), np.float32)
    for number, rows in enumerate(split.held):
        for level in range(levels):
            mine = split.shrunk(turned_b[number], number, level)
            grams[level, number] -= _product(turned_a[number], mine)
            right = split.away(b, mine, number)
            left = right
            if a is not b:
                left = split.away(a, split.shrunk(turned_a[number], number, level), number)
            for one in np.unique(split.block[rows]):
                own = split.block[rows] == one
                judged[level, one] = _product(left[own], right[own])
    return grams, judged


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(A, B) products of the last axes of two fields of the same rows."""
    return a.reshape(-1, a.shape[-1]).T @ b.reshape(-1, b.shape[-1])


def _bordered(inner: np.ndarray, border: np.ndarray) -> np.ndarray:
    """(..., C, C) symmetric matrices from (..., A, A) and their last columns (..., C, C - A)."""
    first, size = inner.shape[-1], border.shape[-2]
    answer = np.empty((*inner.shape[:-2], size, size), inner.dtype)
    answer[..., :first, :first] = inner
    answer[..., first:] = border
    answer[..., first:, :first] = np.swapaxes(border[..., :first, :], -1, -2)
    return answer


def _amplitudes(gram: np.ndarray) -> np.ndarray:
    """(L, r, folds, k) least-squares amplitudes with each of r RIDGES.

    gram: (L, folds, 1 + k, 1 + k) products of the residual and the columns.
    """
    normal, right = gram[..., 1:, 1:], gram[..., 1:, 0]
    normal = 0.5 * (normal + np.swapaxes(normal, -1, -2))
    power = np.diagonal(normal, axis1=-2, axis2=-1)
    least = np.maximum(power.max(axis=-1, initial=0.0, keepdims=True), 1e-30)
    size = np.sqrt(np.maximum(power, 1e-12 * least))
    scaled = normal / size[..., :, None] / size[..., None, :]
    ridge = np.array(RIDGES)[:, None, None, None] * np.eye(normal.shape[-1])
    answer = np.linalg.solve(scaled[:, None] + ridge, (right / size)[:, None, ..., None])
    return answer[..., 0] / size[:, None]
