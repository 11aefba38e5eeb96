"""Which rows are fitted and judged in turn, and the surrogate's own error on them.

The surrogate's own error is a flexible function of actuation and direction, fitted beside whatever
else explains a residual. Of rows that are left out of a fold's fit, products are taken once and
subtracted from those of all.
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
class Basis:
    """The static part's fit to the rows of a fold, of key points that were measured together."""

    points: np.ndarray
    """(p,) which key points."""
    values: np.ndarray
    """(F,) eigenvalues of the features' products over the fitted rows."""
    vectors: np.ndarray
    """(F, F) their eigenvectors, in columns."""


@dataclass(frozen=True, eq=False)
class Split:
    """Rows that are fitted and judged in turn, and what no column changes about it."""

    features: np.ndarray
    """(S, F) features of the static part."""
    residual: np.ndarray
    """(S, n, 3) what is to be explained, mm; 0 where missing."""
    seen: np.ndarray
    """(S, n) which key points were measured."""
    block: np.ndarray
    """(S,) block of each row; rows that are never judged come last."""
    fold: np.ndarray
    """(B,) fold of each judged block, from 0."""
    held: list[np.ndarray]
    """The rows that each fold judges."""
    ridges: np.ndarray
    """(L, n) ridge on the static part of each key point, for each of PERSISTENCE."""
    bases: list[list[Basis]]
    """The static fits of each fold."""

    @classmethod
    def of(cls, features, residual, block, fold, surrogate_mm, noise_mm) -> "Split":
        """As `CrossValidation.of`."""
        seen = np.isfinite(residual).all(2)
        residual = np.where(seen[..., None], residual, 0.0).astype(np.float32)
        features = features.astype(np.float32)
        mean = np.square(residual, dtype=float).sum((0, 2)) / np.maximum(seen.sum(0), 1)
        prior = np.maximum(surrogate_mm, 0.1 * noise_mm) ** 2 * ROOM**2
        ridges = np.array([(noise_mm**2 + rows * mean) / prior for rows in PERSISTENCE])
        judged = np.unique(fold[fold != FITTED], return_inverse=True)[1]
        owner = np.append(judged, FITTED)[np.minimum(block, len(judged))]
        held = [np.flatnonzero(owner == number) for number in range(judged.max() + 1)]
        groups, which = np.unique(seen, axis=1, return_inverse=True)
        alike = [np.flatnonzero(which.reshape(-1) == g) for g in range(groups.shape[1])]
        bases: list[list[Basis]] = []
        for number in range(len(held)):
            some = [features[(owner != number) & seen[:, points[0]]] for points in alike]
            found = [linalg.eigh(rows.T @ rows, check_finite=False) for rows in some]
            bases.append([Basis(p, *pair) for p, pair in zip(alike, found, strict=True)])
        return cls(features, residual, seen, block, judged, held, ridges, bases)

    @property
    def rows(self) -> int:
        """Rows that are judged."""
        return int((self.block < len(self.fold)).sum())

    def turned(self, field: np.ndarray, known: np.ndarray | None = None) -> list[np.ndarray]:
        """For each fold (F, n, 3, C) products of the static part's basis and a field (rows, n, 3,
        C), over the fitted rows; known: (S - rows, n, 3) its first column on the other ones."""
        flat = field.reshape(self.rows, -1)
        parts = [self.features[rows].T @ flat[rows] for rows in self.held]
        parts = [part.reshape(-1, *field.shape[1:]) for part in parts]
        whole = np.sum(parts, axis=0)
        if known is not None:
            whole[..., 0] += np.tensordot(self.features[self.rows :], known, (0, 0))
        answer = []
        for part, bases in zip(parts, self.bases, strict=True):
            left = whole - part
            for basis in bases:
                some = left[:, basis.points]
                turned = basis.vectors.T @ some.reshape(len(some), -1)
                left[:, basis.points] = turned.reshape(some.shape)
            answer.append(left)
        return answer

    def shrunk(self, turned: np.ndarray, number: int, level: int) -> np.ndarray:
        """The same of a fold over the ridge of a level: the static part's coefficients."""
        answer = np.empty_like(turned)
        for basis in self.bases[number]:
            ridge = self.ridges[level, basis.points]
            weight = np.maximum(basis.values, 0.0)[:, None] + ridge
            answer[:, basis.points] = turned[:, basis.points] / weight[..., None, None]
        return answer

    def away(self, field: np.ndarray, shrunk: np.ndarray, number: int) -> np.ndarray:
        """(s, n, 3, C) what a fold's static fit leaves of a field on the rows that it judges."""
        rows = self.held[number]
        answer = field[rows].copy()
        for basis in self.bases[number]:
            own = self.features[rows] @ basis.vectors
            part = own @ shrunk[:, basis.points].reshape(len(shrunk), -1)
            answer[:, basis.points] -= part.reshape(len(rows), len(basis.points), *field.shape[2:])
        answer[~self.seen[rows]] = 0.0
        return answer
