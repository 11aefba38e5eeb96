"""Held-out error of any set of effects, the surrogate's own error always beside them.

The residual of a model is explained by a flexible function of actuation and direction (the
surrogate's own error, free in every output) and by columns, each with one amplitude. Both are
linear, so everything that a set of columns can do on held-out blocks follows from a few matrices
that are computed once: trying a set costs a small linear solve.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from surgisoft.diagnosis.discrepancy import kernel

INDUCING = 150
"""Features of the surrogate's error (Nystroem: Williams & Seeger 2001)."""
ROOM = 3.0
"""Factor on the validated error that the flexible function may reach at ease."""
RIDGE = 1e-4
"""Ridge on amplitudes, as a share of a column's own power."""


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

    folds: list[Fold]
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

        block: (S,) block of each row; fold: (B,) fold of each block; surrogate_mm and noise_mm:
        (n,) RMS errors of each key point's distance.
        """
        field = np.concatenate([residual[..., None], columns], axis=3).astype(np.float32)
        seen = np.isfinite(residual).all(2)
        count = field.shape[3]
        blocks = int(fold.shape[0])
        features = features.astype(np.float32)
        folds = []
        for number in np.unique(fold):
            held = fold[block] == number
            gram = np.zeros((count, count))
            where = np.flatnonzero(fold == number)
            judged = np.zeros((len(where), count, count))
            for k in range(field.shape[1]):
                fit, test = ~held & seen[:, k], held & seen[:, k]
                if not fit.any():
                    continue
                ridge = (noise_mm[k] / (ROOM * max(surrogate_mm[k], 0.1 * noise_mm[k]))) ** 2
                inside, outside = features[fit], features[test]
                normal = inside.T @ inside + ridge * np.eye(inside.shape[1], dtype=np.float32)
                factor = linalg.cho_factor(normal, lower=True, check_finite=False)
                flat = field[fit, k].reshape(int(fit.sum()), -1)
                static = linalg.cho_solve(factor, inside.T @ flat, check_finite=False)
                rest = (flat - inside @ static).reshape(-1, count)
                gram += flat.reshape(-1, count).T.astype(np.float64) @ rest
                away = field[test, k].reshape(int(test.sum()), -1) - outside @ static
                away = away.reshape(len(away), 3, count)
                for i, b in enumerate(where):
                    part = away[block[test] == b].reshape(-1, count)
                    judged[i] += part.T @ part
            folds.append(Fold(gram, judged, where))
        counts = np.bincount(block, weights=seen.sum(1), minlength=blocks)
        return cls(folds, counts, count - 1)

    def losses(self, picked: list[int] | np.ndarray = ()) -> np.ndarray:
        """(B,) held-out sum of squared distances of each block, mm^2, with the picked columns."""
        index = np.asarray(picked, int) + 1
        answer = np.zeros(len(self.counts))
        for fold in self.folds:
            amplitude = self._amplitudes(fold.gram, index)
            mix = np.concatenate([[1.0], -amplitude])
            rows = np.concatenate([[0], index])
            part = fold.judged[:, rows[:, None], rows[None]]
            answer[fold.blocks] = np.einsum("bij,i,j->b", part, mix, mix)
        return answer

    def amplitudes(self, picked: list[int] | np.ndarray) -> np.ndarray:
        """(k,) amplitudes of the picked columns, mean over the folds."""
        index = np.asarray(picked, int) + 1
        return np.mean([self._amplitudes(fold.gram, index) for fold in self.folds], axis=0)

    @staticmethod
    def _amplitudes(gram: np.ndarray, index: np.ndarray) -> np.ndarray:
        if not len(index):
            return np.zeros(0)
        normal = gram[index[:, None], index[None]]
        normal = 0.5 * (normal + normal.T)
        size = np.sqrt(np.maximum(np.diag(normal), 1e-12 * max(np.diag(normal).max(), 1e-30)))
        scaled = normal / size[:, None] / size[None] + RIDGE * np.eye(len(index))
        return linalg.solve(scaled, gram[index, 0] / size, assume_a="pos") / size
