"""What the rows of an experiment know about columns: small matrices that add up over experiments.

Columns are what effects change in the key points to first order. Everything that can be said about
telling them apart follows from their products under the covariance

    Sigma = noise + form + surrogate,

where `form` is what an effect's own formula leaves of its signal: a part that changes over FORM_S,
and one that depends on the actuation alone. The latter and the surrogate's error are the Gaussian
process of discrepancy.py, here through inducing points (Quinonero-Candela & Rasmussen 2005, sec.
4): it is the same error in every experiment that visits the same actuation, so its features are
kept beside the columns and taken out only at the end.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from surgisoft.diagnosis.race.discrepancy import body_covariance, kernel
from surgisoft.surrogate.history import History

FORM_SHARE = 0.1
"""Share of an effect's mean square that its own formula misses."""
FORM_S = 20.0
"""Time over which what it misses stays alike, s: the blocks of time that a diagnosis judges on."""
ROOM = 2.0
"""Factor on the surrogate's validated error that is allowed for."""
INDUCING = 120
"""Inducing points of the surrogate's error."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What an effect's signal must stand out from."""

    noise_mm: np.ndarray
    """(n,) RMS noise of each key point's distance, mm."""
    surrogate_mm: np.ndarray
    """(n,) RMS validated error of each key point's distance, mm."""
    signal_mm: np.ndarray
    """(n,) RMS size of the effects in question at each key point, mm."""
    dt_s: float
    """Time between two samples, s."""
    inducing: tuple[np.ndarray, np.ndarray]
    """(F, m) actuations scaled to [-1, 1] and (F, m) directions that carry the surrogate's
    error."""

    @property
    def density(self) -> np.ndarray:
        """(n,) variance of one coordinate times the time for which it is alike, mm^2 s."""
        form = FORM_SHARE * self.signal_mm**2 * max(FORM_S, self.dt_s)
        return np.maximum((self.noise_mm**2 * self.dt_s + form) / 3.0, 1e-12)

    @cached_property
    def _root(self) -> np.ndarray:
        x, d = self.inducing
        values, vectors = linalg.eigh(kernel(x, d, x, d))
        kept = values > 1e-6 * values.max()
        return vectors[:, kept] / np.sqrt(values[kept])

    def features(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        """(S, F') features of the surrogate's error at actuations and directions (S, m)."""
        return kernel(x, d, *self.inducing) @ self._root

    @cached_property
    def outputs(self) -> tuple[np.ndarray, np.ndarray]:
        """(n, n) key points to independent outputs of unit density, (n,) surrogate's variances."""
        static = (ROOM * self.surrogate_mm) ** 2 + FORM_SHARE * self.signal_mm**2
        ratio, mix = linalg.eigh(body_covariance(np.sqrt(static)), np.diag(self.density))
        return mix.T, np.maximum(ratio, 1e-9 * max(ratio.max(), 1e-12))


def inducing_points(chambers: int, number: int = INDUCING, seed: int = 0):
    """Actuations (F, m) over [-1, 1] and directions (F, m) of -1 or 1, spread evenly.

    A Kronecker sequence on the golden ratio of m dimensions (Roberts 2018).
    """
    ratio = 1.5
    for _ in range(64):
        ratio = (1.0 + ratio) ** (1.0 / (chambers + 1))
    steps = ratio ** -np.arange(1.0, chambers + 1)
    x = 2.0 * ((0.5 + np.arange(1, number + 1)[:, None] * steps) % 1.0) - 1.0
    d = np.random.default_rng(seed).choice([-1.0, 1.0], size=x.shape)
    return x, d


def sample_time(history: History) -> float:
    """Median time between samples of a history, s; settled points lie seconds apart."""
    gaps = history.dt_s[history.dt_s > 0]
    return float(gaps.median()) if len(gaps) else 1.0


@dataclass(frozen=True, eq=False)
class Moments:
    """Products of K columns and F features over the rows of one or more experiments."""

    plain: np.ndarray
    """(n, K, K) products of the columns, in each independent output."""
    cross: np.ndarray
    """(3, n, F, K) products of features and columns, in each coordinate and output."""
    own: np.ndarray
    """(F, F) products of the features."""
    ratio: np.ndarray
    """(n,) variance of the surrogate's error in each output, in units of its density."""
    seconds: float
    """Time that the rows stand for, s."""

    @classmethod
    def of(
        cls,
        columns: np.ndarray,
        x: np.ndarray,
        d: np.ndarray,
        uncertainty: Uncertainty,
        seconds: float,
    ) -> "Moments":
        """Of columns (S, n, 3, K) in mm at actuations x and directions d (S, m).

        seconds: time that all the rows stand for, s.
        """
        rows, points, _, count = columns.shape
        weight = np.float32(np.sqrt(seconds / rows))
        mix, ratio = uncertainty.outputs
        flat = np.ascontiguousarray(columns.transpose(1, 2, 0, 3), np.float32)
        mixed = weight * (mix.astype(np.float32) @ flat.reshape(points, -1))
        mixed = mixed.reshape(points, 3, rows, count)
        features = weight * uncertainty.features(x, d).astype(np.float32)
        plain = np.stack([sum(c.T @ c for c in output) for output in mixed])
        cross = np.stack([[features.T @ output[axis] for output in mixed] for axis in range(3)])
        return cls(
            plain.astype(float),
            cross.astype(float),
            (features.T @ features).astype(float),
            ratio,
            seconds,
        )

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(
            self.plain + other.plain,
            self.cross + other.cross,
            self.own + other.own,
            self.ratio,
            self.seconds + other.seconds,
        )

    def gram(self) -> np.ndarray:
        """(K, K) products of the columns under Sigma: the surrogate's error is taken out."""
        answer = self.plain.sum(0)
        for output, ratio in enumerate(self.ratio):
            normal = self.own + np.eye(len(self.own)) / ratio
            half = linalg.solve_triangular(
                linalg.cholesky(normal, lower=True),
                np.concatenate(list(self.cross[:, output]), axis=1),
                lower=True,
                check_finite=False,
            )
            for part in np.split(half, 3, axis=1):
                answer = answer - part.T @ part
        return 0.5 * (answer + answer.T)


def unimitated(gram: np.ndarray, signals: np.ndarray, shapes: list[np.ndarray]) -> np.ndarray:
    """(J, D) squared length under Sigma of what no mixture of a shape's columns can imitate.

    gram: (K, K); signals: (K, D) amplitudes of D signals; shapes: the indices of the J shapes'
    columns. Half of it is the expected log likelihood ratio of two Gaussian models (Hunter &
    Reiner 1965, eq. 3).
    """
    seen = gram @ signals
    whole = np.einsum("kd,kd->d", signals, seen)
    size = np.sqrt(np.maximum(np.diag(gram), 1e-30))
    answer = np.empty((len(shapes), signals.shape[1]))
    for j, shape in enumerate(shapes):
        scaled = gram[np.ix_(shape, shape)] / size[shape][:, None] / size[shape][None]
        values, vectors = linalg.eigh(scaled, check_finite=False)
        kept = values > 1e-5 * max(values.max(), 1e-12)
        turned = (vectors[:, kept] / np.sqrt(values[kept])).T @ (seen[shape] / size[shape][:, None])
        answer[j] = whole - (turned**2).sum(0)
    return np.clip(answer, 0.0, np.maximum(whole, 0.0))
