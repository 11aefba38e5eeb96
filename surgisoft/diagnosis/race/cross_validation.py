"""Held-out error of any set of effects, the surrogate's own error always beside them.

The residual of a model is explained by a flexible function of actuation and direction (the
surrogate's own error, free in every output) and by columns, each with one amplitude. Both are
linear, so everything that a set of columns can do on held-out blocks follows from a few matrices
that are computed once: trying a set costs a small linear solve.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from surgisoft.diagnosis.race.discrepancy import kernel

INDUCING = 120
"""Features of the surrogate's error (Nystroem: Williams & Seeger 2001)."""
ROOM = 3.0
"""Factor on the validated error that the flexible function may reach at ease."""
PERSISTENCE = (5.0, 50.0, 500.0)
"""Rows over which what is left may hang together: so many times more than as white noise does it
hold the flexible function back. Of several the one is taken that does best on held-out blocks."""
RIDGES = (1e-4, 1e-2, 1e-1)
"""Ridges on amplitudes, shares of a column's own power; the best on held-out blocks is taken."""

FITTED = -1
"""Fold of blocks that are fitted in every fold and never judged; they come last."""


def static_features(x, d, number: int = INDUCING, seed: int = 0) -> np.ndarray:
    """(S, F) features whose unit-normal mixture has the discrepancy's covariance."""
    rng = np.random.default_rng(seed)
    picked = rng.permutation(len(x))[: min(number, len(x))]
    values, vectors = linalg.eigh(kernel(x[picked], d[picked], x[picked], d[picked]))
    kept = values > 1e-8 * values.max()
    return kernel(x, d, x[picked], d[picked]) @ (vectors[:, kept] / np.sqrt(values[kept]))


@dataclass(frozen=True, eq=False)
class Fold:
    """One split into rows to fit and blocks to judge."""

    gram: np.ndarray
    """(1 + K, 1 + K) products of residual and columns over the fitted rows, static part out."""
    judged: np.ndarray
    """(b, 1 + K, 1 + K) the same of what the static part leaves on each judged block."""
    blocks: np.ndarray
    """(b,) which blocks those are."""


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Held-out errors of sets of columns."""

    levels: list[list[Fold]]
    """The folds for each of PERSISTENCE."""
    counts: np.ndarray
    """(B,) measured key points in each block."""
    columns: int
    """K."""

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
        """features (S, F), residual (S, n, 3) and columns (S, n, 3, K) in mm, NaN where missing.

        block: (S,) block of each row; fold: (B,) fold of each block, blocks of the fold FITTED
        last; surrogate_mm and noise_mm: (n,) RMS errors of each key point's distance.
        """
        seen = np.isfinite(residual).all(2)
        field = np.concatenate([residual[..., None], columns], axis=3).astype(np.float32)
        square = np.where(seen, np.square(residual).sum(2), 0.0)
        mean = square.sum(0) / np.maximum(seen.sum(0), 1)
        prior = np.maximum(surrogate_mm, 0.1 * noise_mm) ** 2 * ROOM**2
        ridges = [(noise_mm**2 + rows * mean) / prior for rows in PERSISTENCE]
        levels: list[list[Fold]] = [[] for _ in ridges]
        judged = int((fold != FITTED).sum())
        for number in np.unique(fold[:judged]):
            where = np.flatnonzero(fold == number)
            parts = _split(features.astype(np.float32), field, seen, fold[block] == number, block)
            for level, ridge in zip(levels, ridges, strict=True):
                level.append(_fold(parts, ridge, where, field.shape[3]))
        counts = np.bincount(block, weights=seen.sum(1), minlength=len(fold))[:judged]
        return cls(levels, counts, field.shape[3] - 1)

    def losses(self, picked: list[int] | np.ndarray = ()) -> np.ndarray:
        """(B,) held-out sum of squared distances of each block, mm^2, with the picked columns."""
        index = np.asarray(picked, int) + 1
        ridges = RIDGES if len(index) > 1 else RIDGES[:1]
        tried = np.concatenate([self._losses(folds, index, ridges) for folds in self.levels])
        return tried[tried.sum(axis=1).argmin()]

    def _losses(self, folds: list[Fold], index: np.ndarray, ridges: tuple[float, ...]):
        """(r, B) held-out sums of squares with each of r ridges."""
        answer = np.zeros((len(ridges), len(self.counts)))
        rows = np.concatenate([[0], index])
        for fold in folds:
            part = fold.judged[:, rows[:, None], rows[None]]
            for number, ridge in enumerate(ridges):
                mix = np.concatenate([[1.0], -_amplitudes(fold.gram, index, ridge)])
                answer[number, fold.blocks] = part @ mix @ mix
        return answer

    def amplitudes(self, picked: list[int] | np.ndarray) -> np.ndarray:
        """(k,) amplitudes of the picked columns, mean over the folds."""
        index = np.asarray(picked, int) + 1
        tried = np.array([self._losses(f, index, RIDGES).sum(axis=1) for f in self.levels])
        level, ridge = np.unravel_index(tried.argmin(), tried.shape)
        some = [_amplitudes(fold.gram, index, RIDGES[ridge]) for fold in self.levels[level]]
        return np.mean(some, axis=0)


def _split(features, field, seen, held, block) -> list[tuple]:
    """What the static fit of each key point needs, for any ridge."""
    answer, known = [], {}
    for k in range(field.shape[1]):
        fit, test = ~held & seen[:, k], held & seen[:, k]
        if not fit.any():
            continue
        key = fit.tobytes()
        if key not in known:
            known[key] = linalg.eigh(features[fit].T @ features[fit], check_finite=False)
        values, vectors = known[key]
        flat = field[fit, k].reshape(int(fit.sum()), -1)
        turned = vectors.T @ (features[fit].T @ flat)
        own = flat.reshape(-1, field.shape[3])
        gram = (own.T @ own).astype(np.float64)
        tested = field[test, k].reshape(int(test.sum()), 3 * field.shape[3])
        answer.append((k, values, turned, gram, features[test] @ vectors, tested, block[test]))
    return answer


def _fold(parts: list[tuple], ridge: np.ndarray, where: np.ndarray, count: int) -> Fold:
    """One fold with a ridge (n,) on the static part of each key point."""
    gram, judged = np.zeros((count, count)), np.zeros((len(where), count, count))
    for k, values, turned, own, outside, tested, block in parts:
        shrunk = (turned / (np.maximum(values, 0.0) + ridge[k])[:, None]).astype(np.float32)
        left = turned.reshape(-1, count).T @ shrunk.reshape(-1, count)
        gram += own - left
        away = (tested - outside @ shrunk).reshape(len(tested), 3, count)
        for i, b in enumerate(where):
            part = away[block == b].reshape(-1, count)
            judged[i] += part.T @ part
    return Fold(gram, judged, where)


def _amplitudes(gram: np.ndarray, index: np.ndarray, ridge: float) -> np.ndarray:
    """(k,) least-squares amplitudes of the columns at an index."""
    if not len(index):
        return np.zeros(0)
    normal = gram[index[:, None], index[None]]
    normal = 0.5 * (normal + normal.T)
    size = np.sqrt(np.maximum(np.diag(normal), 1e-12 * max(np.diag(normal).max(), 1e-30)))
    scaled = normal / size[:, None] / size[None] + ridge * np.eye(len(index))
    return np.linalg.solve(scaled, gram[index, 0] / size) / size
