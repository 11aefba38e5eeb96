"""Held-out errors of any set of sensitivities, the model discrepancy always fitted beside them.

The residual of a model is explained by a flexible function of actuation and direction (the model
discrepancy, free in every output) and by sensitivities, each with one amplitude. Both are linear,
so everything that a set of sensitivities can do on held-out blocks follows from a few matrices
that are computed once: trying a set costs a small linear solve. Of rows that are left out of a
fold's fit, products are taken once and subtracted from those of all.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from surgisoft.compiled import compiled
from surgisoft.diagnosis.discrepancy import kernel
from surgisoft.diagnosis.residuals import Problem

RIDGES = (1e-4, 1e-2, 1e-1)
"""Ridges on amplitudes, shares of a column's own power; the best on held-out blocks is taken."""
ROUNDING = 2.0**-24
"""Relative rounding error of a number in single precision."""
INDUCING = 120
"""Features of the model discrepancy (Nystroem: Williams & Seeger 2001)."""
ROOM = 3.0
"""Factor on the validated error that the discrepancy may reach without a penalty that matters."""
PERSISTENCE = (5.0, 50.0, 500.0)
"""Rows over which the remaining error is correlated: it holds the discrepancy back so many times
more than white noise of its size. The one that does best on held-out blocks is taken."""

REFERENCE_WEIGHT = 3.0
"""Weight of a reference's rows: an error that changed since is not shared out over both."""
FITTED = -1
"""Fold of blocks that are fitted in every fold and never held out; they come last."""


def static_features(x, d, number: int = INDUCING, seed: int = 0) -> np.ndarray:
    """(S, F) features whose unit-normal mixture has the discrepancy's covariance."""
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(x))[: min(number, len(x))]
    values, vectors = linalg.eigh(kernel(x[chosen], d[chosen], x[chosen], d[chosen]))
    kept = values > 1e-8 * values.max()
    return kernel(x, d, x[chosen], d[chosen]) @ (vectors[:, kept] / np.sqrt(values[kept]))


@dataclass(frozen=True, eq=False)
class Basis:
    """The static part's fit to the rows of a fold, of key points that were measured together."""

    points: np.ndarray
    """(p,) which key points."""
    values: np.ndarray
    """(F,) eigenvalues of the features' products over the fitted rows."""
    vectors: np.ndarray
    """(F, F) their eigenvectors, in sensitivities."""


@dataclass(frozen=True, eq=False)
class Split:
    """Rows that are fitted and held out in turn, and what is the same for every effect."""

    features: np.ndarray
    """(S, F) features of the static part."""
    residual: np.ndarray
    """(S, n, 3) what is to be explained, mm; 0 where missing."""
    seen: np.ndarray
    """(S, n) which key points were measured."""
    block: np.ndarray
    """(S,) block of each row; rows that are never held out come last."""
    fold: np.ndarray
    """(B,) fold of each block that is held out, from 0."""
    held: list[np.ndarray]
    """The rows that each fold holds out."""
    ridges: np.ndarray
    """(L, n) ridge on the features of each key point, for each room and each of PERSISTENCE."""
    bases: list[list[Basis]]
    """The static fits of each fold."""
    rotated: dict = field(default_factory=dict)
    """Features of each fold's held-out rows in each basis, once they were needed."""

    @classmethod
    def of(
        cls,
        features: np.ndarray,
        residual: np.ndarray,
        block: np.ndarray,
        fold: np.ndarray,
        discrepancy_mm: np.ndarray,
        noise_mm: np.ndarray,
        rooms: tuple[float, ...] = (ROOM,),
    ) -> "Split":
        """features (S, F) and residual (S, n, 3) in mm, NaN where missing.

        block: (S,) block of each row; fold: (B,) fold of each block, blocks of the fold FITTED
        last; discrepancy_mm and noise_mm: (n,) RMS errors of each key point's distance; rooms:
        factors on discrepancy_mm that the features' fit may reach.
        """
        seen = np.isfinite(residual).all(2)
        residual = np.where(seen[..., None], residual, 0.0).astype(np.float32)
        features = features.astype(np.float32)
        mean = np.square(residual, dtype=float).sum((0, 2)) / np.maximum(seen.sum(0), 1)
        prior = np.maximum(discrepancy_mm, 0.1 * noise_mm) ** 2
        ridges = np.array(
            [
                (noise_mm**2 + rows * mean) / (prior * room**2)
                for room in rooms
                for rows in PERSISTENCE
            ]
        )
        held_out = np.unique(fold[fold != FITTED], return_inverse=True)[1]
        owner = np.append(held_out, FITTED)[np.minimum(block, len(held_out))]
        held = [np.flatnonzero(owner == number) for number in range(held_out.max() + 1)]
        groups, which = np.unique(seen, axis=1, return_inverse=True)
        alike = [np.flatnonzero(which.reshape(-1) == g) for g in range(groups.shape[1])]
        bases: list[list[Basis]] = []
        for number in range(len(held)):
            some = [features[(owner != number) & seen[:, points[0]]] for points in alike]
            found = [linalg.eigh(rows.T @ rows, check_finite=False) for rows in some]
            bases.append([Basis(p, *pair) for p, pair in zip(alike, found, strict=True)])
        return cls(features, residual, seen, block, held_out, held, ridges, bases)

    @property
    def rows(self) -> int:
        """Rows that are held out in turn."""
        return int((self.block < len(self.fold)).sum())

    def turned(self, field: np.ndarray, known: np.ndarray | None = None) -> list[np.ndarray]:
        """Products of the static part's basis and a field (rows, n, 3, C), fold by fold.

        Returns (F, n, 3, C) over the fitted rows of each fold. known: (S - rows, n, 3) the field's
        first column on the rows that are never held out.
        """
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
        """Coefficients of a fold's static part: products as of `turned` over a level's ridge."""
        answer = np.empty_like(turned)
        for basis in self.bases[number]:
            ridge = self.ridges[level, basis.points]
            weight = np.maximum(basis.values, 0.0)[:, None] + ridge
            at = _at_once(basis.points, turned.shape[1])
            answer[:, at] = turned[:, at] / weight[..., None, None]
        return answer

    def away(self, field: np.ndarray, shrunk: np.ndarray, number: int) -> np.ndarray:
        """(s, n, 3, C) what a fold's static fit leaves of a field (s, n, 3, C) on the rows that the
        fold holds out."""
        rows = self.held[number]
        answer = np.empty_like(field)
        for place, basis in enumerate(self.bases[number]):
            if (number, place) not in self.rotated:
                self.rotated[number, place] = self.features[rows] @ basis.vectors
            own = self.rotated[number, place]
            at = _at_once(basis.points, field.shape[1])
            part = own @ shrunk[:, at].reshape(len(shrunk), -1)
            part = part.reshape(len(rows), len(basis.points), *field.shape[2:])
            if len(basis.points) == field.shape[1]:
                answer = np.subtract(field, part, out=part)
            else:
                answer[:, at] = field[:, at] - part
        answer[~self.seen[rows]] = 0.0
        return answer


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Held-out errors of sets of sensitivities."""

    split: Split
    fields: tuple[np.ndarray, ...]
    """Residual and sensitivities, mm, side by side: (rows, n, 3, 1 + k) and, of sensitivities that
    were added later, (rows, n, 3, k); 0 where missing."""
    grams: np.ndarray
    """(L, folds, 1 + K, 1 + K) products of them over the fitted rows, static part out."""
    held_out: "HeldOut"
    """The same of what the static part leaves on each held-out block."""
    turned: list[np.ndarray]
    """For each fold (F, n, 3, 1 + K) products of the static part's basis and `fields`."""
    cache: dict = field(default_factory=dict)
    """Held-out sums of squares and amplitudes by sensitivities."""

    @classmethod
    def on(
        cls, split: Split, sensitivities: np.ndarray | Sequence[np.ndarray]
    ) -> "CrossValidation":
        """The cross-validation of sensitivities (rows, n, 3, K), or of several such arrays side by
        side, on a split."""
        given = [sensitivities] if isinstance(sensitivities, np.ndarray) else sensitivities
        count = sum(each.shape[3] for each in given)
        both = np.empty((*split.residual[: split.rows].shape, 1 + count), np.float32)
        both[..., 0] = split.residual[: split.rows]
        first = 1
        for each in given:
            both[..., first : first + each.shape[3]] = each
            first += each.shape[3]
        both[~split.seen[: split.rows]] = 0.0
        known = split.residual[split.rows :]
        turned = split.turned(both, known)
        grams, lines = _products(split, (both,), turned, (both,), turned)
        grams[:, :, 0, 0] += np.square(known, dtype=float).sum()
        none = np.empty((len(lines), 1 + count, 0, lines.shape[2]), np.float32)
        return cls(split, (both,), grams, HeldOut(lines, none), turned)

    def extended(self, sensitivities: np.ndarray) -> "CrossValidation":
        """This cross-validation with further sensitivities (rows, n, 3, K') after its own."""
        more = _masked(self.split, sensitivities)
        fields = (*self.fields, more)
        turned = self.split.turned(more)
        whole = [np.concatenate(pair, axis=3) for pair in zip(self.turned, turned, strict=True)]
        grams, lines = _products(self.split, fields, whole, (more,), turned)
        border = lines.reshape(len(lines), *grams.shape[2:], -1)
        grams = _bordered(self.grams, grams)
        held_out = self.held_out.extended(border)
        return CrossValidation(self.split, fields, grams, held_out, whole, dict(self.cache))

    def level_losses(self) -> np.ndarray:
        """(L, B) held-out sum of squared distances, mm^2, of the features alone at each ridge."""
        return self.held_out.first[:, 0].astype(float)

    @property
    def sensitivities(self) -> int:
        """Number of sensitivities, K."""
        return sum(each.shape[3] for each in self.fields) - 1

    @property
    def counts(self) -> np.ndarray:
        """(B,) measured key points in each block."""
        rows = self.split.rows
        weights = self.split.seen[:rows].sum(1)
        return np.bincount(self.split.block[:rows], weights, minlength=len(self.split.fold))

    def losses(self, chosen: Sequence[int] | np.ndarray = ()) -> np.ndarray:
        """(B,) held-out sum of squared distances of each block with chosen sensitivities, mm^2."""
        sensitivities = _rising(chosen)
        tried, _ = self._solved(sensitivities)
        ridges = len(RIDGES) if len(sensitivities) > 1 else 1
        tried = tried[:, :ridges].reshape(-1, tried.shape[2])
        return tried[tried.sum(axis=1).argmin()]

    def amplitudes(self, chosen: list[int] | tuple[int, ...] | np.ndarray) -> np.ndarray:
        """(k,) amplitudes of the chosen sensitivities, mean over the folds."""
        return self._fitted(np.asarray(chosen, int))[0]

    def contributions(self, groups: Sequence[tuple[int, ...]]) -> np.ndarray:
        """(B, 1 + G, 1 + G) held-out products of the residual and of what G effects explain, mm^2.

        groups: the sensitivities of each effect, all fitted together; what an effect explains is
        their sum at the fitted amplitudes. The model discrepancy is taken out of all of them.
        """
        columns = np.array([0, *(1 + one for group in groups for one in group)])
        amplitudes, level = self._fitted(columns[1:] - 1)
        mix = np.zeros((len(columns), 1 + len(groups)))
        mix[0, 0] = 1.0
        owner = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        mix[np.arange(1, len(columns)), 1 + owner] = amplitudes
        products = np.moveaxis(self.held_out.among(columns)[level], -1, 0)
        return mix.T @ products.astype(float) @ mix

    def _fitted(self, chosen: np.ndarray) -> tuple[np.ndarray, int]:
        """(k,) amplitudes of the chosen sensitivities, mean over the folds, and their level."""
        sensitivities = _rising(chosen)
        where = np.searchsorted(sensitivities, chosen)
        tried, amplitudes = self._solved(sensitivities)
        sums = tried.sum(axis=2)
        level, ridge = np.unravel_index(sums.argmin(), sums.shape)
        return amplitudes[level, ridge].mean(axis=0)[where], int(level)

    def _solved(self, sensitivities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((L, r, B) held-out sums of squares, (L, r, folds, k) amplitudes) for every ridge."""
        key = sensitivities.tobytes()
        if key not in self.cache:
            rows = np.concatenate([[0], sensitivities + 1])
            amplitudes = _amplitudes(self.grams[:, :, rows[:, None], rows])
            losses = np.empty((*amplitudes.shape[:2], len(self.split.fold)))
            products = self.held_out
            _sum_squares(
                products.first, products.further, rows, amplitudes, self.split.fold, losses
            )
            self.cache[key] = losses, amplitudes
        return self.cache[key]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Products of columns on each held-out block, mm^2, in single precision.

    They are symmetric, so each pair is kept once: a page of fresh memory costs more than the
    products that fill it. Columns that are added later have arrays of their own.
    """

    first: np.ndarray
    """(L, C (C + 1) / 2, B) of the first C columns; column i with j <= i is in line
    i (i + 1) / 2 + j."""
    further: np.ndarray
    """(L, C + A, A, B) of all columns with A columns that were added."""

    @property
    def columns(self) -> int:
        """Number of columns, C + A."""
        return self.further.shape[1]

    def extended(self, border: np.ndarray) -> "HeldOut":
        """These products with those (L, C + A + N, N, B) of all columns with N new ones."""
        size = self.columns
        known = self.columns - self.further.shape[2]
        mirrored = np.swapaxes(border[:, known:size], 1, 2)
        older = np.concatenate([self.further, mirrored], axis=1)
        return HeldOut(self.first, np.concatenate([older, border], axis=2))

    def among(self, columns: np.ndarray) -> np.ndarray:
        """(L, k, k, B) products of some columns (k,)."""
        levels, blocks, count = len(self.first), self.first.shape[2], len(columns)
        answer = np.empty((levels, count, count, blocks), np.float32)
        for level, i, j in np.ndindex(levels, count, count):
            answer[level, i, j] = _pair(self.first, self.further, level, columns[i], columns[j])
        return answer


def _rising(chosen: Sequence[int] | np.ndarray) -> np.ndarray:
    """The different numbers among some, in rising order; faster than `np.unique` for few."""
    return np.array(sorted(set(map(int, chosen))), int)


def _masked(split: Split, sensitivities: np.ndarray) -> np.ndarray:
    """Columns (rows, n, 3, K) in single precision, 0 where nothing was measured."""
    answer = sensitivities.astype(np.float32)
    answer[~split.seen[: split.rows]] = 0.0
    return answer


def _side_by_side(fields: Sequence[np.ndarray], rows: np.ndarray) -> np.ndarray:
    """(s, n, 3, C) some rows of fields (rows, n, 3, c)."""
    if len(fields) == 1:
        return fields[0][rows]
    return np.concatenate([each[rows] for each in fields], axis=3)


def _products(split: Split, a, turned_a, b, turned_b) -> tuple[np.ndarray, np.ndarray]:
    """(grams, lines) of the columns of two sets of fields (rows, n, 3, .), A and B in number.

    grams: (L, folds, A, B) as in CrossValidation. lines: (L, A B, blocks) products on each held-out
    block; where both sets are the same one, (L, A (A + 1) / 2, blocks), as in HeldOut.
    """
    levels, folds = len(split.ridges), len(split.bases)
    size = (turned_a[0].shape[3], turned_b[0].shape[3])
    same = a is b or (len(a) == len(b) and all(x is y for x, y in zip(a, b, strict=True)))
    count = size[0] * (size[0] + 1) // 2 if same else size[0] * size[1]
    parts = np.empty((folds, *size))
    grams = np.empty((levels, folds, *size))
    answer = np.empty((levels, count, len(split.fold)), np.float32)
    by_block = np.empty((len(split.fold), count), np.float32)
    for level in range(levels):
        for number, rows in enumerate(split.held):
            own_b = _side_by_side(b, rows)
            own_a = own_b if same else _side_by_side(a, rows)
            if not level:
                parts[number] = _product(own_a, own_b)
            mine = split.shrunk(turned_b[number], number, level)
            grams[level, number] = _product(turned_a[number], mine)
            right = split.away(own_b, mine, number)
            left = right
            if not same:
                left = split.away(own_a, split.shrunk(turned_a[number], number, level), number)
            block = split.block[rows]
            for one in np.unique(block):
                own = _at_once(np.flatnonzero(block == one))
                if same:
                    some = right[own]
                    _lower(_product(some, some), by_block[one])
                else:
                    by_block[one] = _product(left[own], right[own]).reshape(-1)
        # A set of columns is then looked up in lines of all blocks, which the cache holds.
        _transpose(by_block, answer[level])
    np.subtract(parts.sum(axis=0) - parts, grams, out=grams)
    return grams, answer


def _at_once(places: np.ndarray, count: int | None = None) -> np.ndarray | slice:
    """Rising places as a slice, which copies nothing, where they have no gaps.

    count: of all places; a slice then is only taken for all of them.
    """
    if len(places) != (places[-1] - places[0] + 1 if count is None else count):
        return places
    return slice(int(places[0]), int(places[-1]) + 1)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(A, B) products of the last axes of two fields of the same rows."""
    return a.reshape(-1, a.shape[-1]).T @ b.reshape(-1, b.shape[-1])


def _bordered(inner: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., C, C) from (..., A, A) and their last columns (..., C, C - A)."""
    first, size = inner.shape[-1], border.shape[-2]
    answer = np.empty((*inner.shape[:-2], size, size), inner.dtype)
    answer[..., :first, :first] = inner
    answer[..., first:] = border
    answer[..., first:, :first] = np.swapaxes(border[..., :first, :], -1, -2)
    return answer


@compiled
def _lower(matrix, out):
    """Write the lower triangle of a matrix (C, C) into out (C (C + 1) / 2), row by row."""
    place = 0
    for row in range(len(matrix)):
        for column in range(row + 1):
            out[place] = matrix[row, column]
            place += 1


@compiled
def _transpose(matrix, out):
    """Write a matrix (R, C) into out (C, R), in strips of 16 rows: a line of the cache each."""
    rows, columns = matrix.shape
    for first in range(0, rows, 16):
        last = min(first + 16, rows)
        for column in range(columns):
            for row in range(first, last):
                out[column, row] = matrix[row, column]


@compiled
def _pair(first, further, level, one, other):
    """(B,) products of two columns at a level, as they lie in HeldOut."""
    known = further.shape[1] - further.shape[2]
    if other >= known:
        return further[level, one, other - known]
    if one >= known:
        return further[level, other, one - known]
    high = max(one, other)
    return first[level, high * (high + 1) // 2 + min(one, other)]


@compiled
def _sum_squares(first, further, rows, amplitudes, fold, losses):
    """Held-out sums of squares into losses (L, r, B), mm^2: x' G x with x = (1, -amplitudes).

    first and further: products G of all columns, as in HeldOut; rows (1 + k,) those that are looked
    at; amplitudes (L, r, folds, k); fold (B,) of each block.

    G is rounded to single precision, so that a sum is not known better than ROUNDING times the
    largest products in it. Where large amplitudes of nearly collinear columns cancel, the rest
    can come out too small and even negative; it is at least its own rounding error.
    """
    levels, ridges, blocks = losses.shape
    size = len(rows)
    mix, along, least = np.ones((size, blocks)), np.empty(blocks), np.empty(blocks)
    for level in range(levels):
        for ridge in range(ridges):
            total = losses[level, ridge]
            for i in range(1, size):
                for block in range(blocks):
                    mix[i, block] = -amplitudes[level, ridge, fold[block], i - 1]
            total[:] = 0.0
            least[:] = 0.0
            for i in range(size):
                along[:] = 0.0
                for j in range(size):
                    product = _pair(first, further, level, rows[i], rows[j])
                    for block in range(blocks):
                        along[block] += product[block] * mix[j, block]
                own = _pair(first, further, level, rows[i], rows[i])
                for block in range(blocks):
                    total[block] += mix[i, block] * along[block]
                    least[block] += own[block] * mix[i, block] * mix[i, block]
            for block in range(blocks):
                total[block] = max(total[block], ROUNDING * least[block])


def _amplitudes(gram: np.ndarray) -> np.ndarray:
    """(L, r, folds, k) least-squares amplitudes with each of r RIDGES.

    gram: (L, folds, 1 + k, 1 + k) products of the residual and the sensitivities.
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


def split_of(problem: Problem) -> Split:
    """Which rows of a problem are fitted and held out in turn.

    Rows of a reference are fitted and never held out: no effect acts on them.
    """
    pressure, direction, residual = problem.pressure, problem.direction, problem.residual
    block, fold = problem.block, problem.fold
    known = problem.reference
    if known is not None:
        pressure = np.concatenate([pressure, known.pressure])
        direction = np.concatenate([direction, known.direction])
        residual = np.concatenate([residual, REFERENCE_WEIGHT * known.residual])
        block = np.concatenate([block, np.full(len(known.residual), len(fold))])
        fold = np.append(fold, FITTED)
    features = static_features(pressure, direction)
    features[len(problem.block) :] *= REFERENCE_WEIGHT
    return Split.of(features, residual, block, fold, problem.discrepancy_mm, problem.noise_mm)


def cross_validation_of(
    problem: Problem,
    sensitivities: np.ndarray | None = None,
    features: np.ndarray | None = None,
    rooms: tuple[float, ...] = (ROOM,),
) -> CrossValidation:
    """The cross-validation of a problem's own rows, without its reference.

    sensitivities: (S, n, 3, K) in mm; None: none. features: (S, F) functions of the row whose
    mixtures, free in every output, are fitted beside them; None: those of the model discrepancy.
    """
    if features is None:
        features = static_features(problem.pressure, problem.direction)
    if sensitivities is None:
        sensitivities = np.zeros((*problem.residual.shape, 0))
    split = Split.of(
        features,
        problem.residual,
        problem.block,
        problem.fold,
        problem.discrepancy_mm,
        problem.noise_mm,
        rooms,
    )
    return CrossValidation.on(split, sensitivities)
