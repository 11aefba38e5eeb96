"""Held-out errors of any set of sensitivities, the model discrepancy always fitted beside them.

The residual of a model is explained by a flexible function of actuation and direction (the model
discrepancy, free in every output) and by sensitivities, each with one amplitude. Both are linear,
so everything that a set of sensitivities can do on held-out blocks follows from a few matrices
that are computed once: trying a set costs a small linear solve. Of rows that are left out of a
fold's fit, products are taken once and subtracted from those of all.
"""

from collections.abc import Iterator, Sequence
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

LARGE = 48
"""Number of sensitivities from which what many sets have in common is factorised once for all. It
decides on processor time alone: results are equal but for rounding."""
FAINT = 1e-12
"""Least power of a sensitivity, as a share of the largest one of a set, that it is scaled by."""
FAINTEST = 1e-30
"""Least power that counts as the largest one of a set, mm^2."""
STRIP = 1 << 20
"""Numbers of a field that are worked through at once: 4 MB, of which the cache holds a few."""
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

    order: np.ndarray
    """(rows,) the rows that are held out in turn, fold by fold and block by block: everything here
    lies in this order, so that the rows of a fold and of a block are slices. Rows that are never
    held out come behind them."""
    features: np.ndarray
    """(S, F) features of the static part."""
    residual: np.ndarray
    """(S, n, 3) what is to be explained, mm; 0 where missing."""
    seen: np.ndarray
    """(S, n) which key points were measured."""
    block: np.ndarray
    """(S,) block of each row."""
    fold: np.ndarray
    """(B,) fold of each block that is held out, from 0."""
    held: list[slice]
    """The rows that each fold holds out."""
    blocks: list[list[tuple[int, slice]]]
    """The blocks that each fold holds out, and their rows."""
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
        rows = int((owner != FITTED).sum())
        order = np.lexsort((block[:rows], owner[:rows]))
        everything = np.concatenate([order, np.arange(rows, len(block))])
        features, residual, seen = features[everything], residual[everything], seen[everything]
        block, owner = block[everything], owner[everything]
        held, blocks = [], []
        for number in range(held_out.max() + 1):
            held.append(_where(owner[:rows] == number))
            own = np.unique(block[held[-1]])
            blocks.append([(int(one), _where(block[:rows] == one)) for one in own])
        bases = _bases(features, seen, held)
        return cls(order, features, residual, seen, block, held_out, held, blocks, ridges, bases)

    @property
    def rows(self) -> int:
        """Number of rows that are held out in turn."""
        return len(self.order)

    def by_fold(self, products: np.ndarray) -> np.ndarray:
        """(..., folds) sums of products (..., B) of the blocks that are held out."""
        owner = self.fold[:, None] == np.arange(len(self.held))
        return products @ owner.astype(products.dtype)

    def laid_out(self, given: Sequence[np.ndarray], room: int = 0) -> np.ndarray:
        """(rows, n, 3, room + K) fields (rows, n, 3, k) side by side, in this order.

        0 where nothing was measured; the first `room` columns are left to be filled.
        """
        count = room + sum(each.shape[3] for each in given)
        answer = np.empty((self.rows, *self.residual.shape[1:], count), np.float32)
        # Block by block: a block of rows stays in the cache while its columns are interleaved.
        for _, rows in (one for blocks in self.blocks for one in blocks):
            some, first = _at_once(self.order[rows]), room
            for each in given:
                answer[rows, ..., first : first + each.shape[3]] = each[some]
                first += each.shape[3]
        if not self.seen[: self.rows].all():
            answer[..., room:][~self.seen[: self.rows]] = 0.0
        return answer

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

    def weight(self, number: int, level: int) -> np.ndarray:
        """(F, n) what divides the products of `turned` in a fold's fit at a level's ridge."""
        answer = np.empty((self.features.shape[1], self.seen.shape[1]), np.float32)
        for basis in self.bases[number]:
            values = np.maximum(basis.values, 0.0)[:, None]
            answer[:, basis.points] = values + self.ridges[level, basis.points]
        return answer

    def _own(self, number: int, rows: slice) -> list[np.ndarray]:
        """(s, F) features of some rows of a fold, rotated, for each of the fold's bases."""
        held, answer = self.held[number], []
        for place, basis in enumerate(self.bases[number]):
            if (number, place) not in self.rotated:
                self.rotated[number, place] = self.features[held] @ basis.vectors
            own = self.rotated[number, place]
            answer.append(own[rows.start - held.start : rows.stop - held.start])
        return answer

    def by_basis(self, coefficients: np.ndarray, number: int) -> list[np.ndarray]:
        """(F, p 3 C) coefficients (F, n, 3, C) of a fold's static fit, for each of its bases."""
        size = len(coefficients)
        return [coefficients[:, _at_once(b.points)].reshape(size, -1) for b in self.bases[number]]

    def away(
        self, field: np.ndarray, coefficients: list[np.ndarray], number: int, rows: slice
    ) -> np.ndarray:
        """(s, n, 3, C) what a fold's static fit leaves of a field (s, n, 3, C) on some of the rows
        that the fold holds out.

        coefficients: those of the fit by basis.
        """
        answer = np.empty_like(field)
        own = self._own(number, rows)
        for basis, features, each in zip(self.bases[number], own, coefficients, strict=True):
            at = _at_once(basis.points)
            some = field[:, at]
            part = (features @ each).reshape(some.shape)
            if some.shape == field.shape:
                answer = np.subtract(some, part, out=part)
            else:
                np.subtract(some, part, out=part)
                answer[:, at] = part
        if not self.seen[rows].all():
            answer[~self.seen[rows]] = 0.0
        return answer

    def projected(self, field: np.ndarray, number: int, rows: slice) -> np.ndarray:
        """(F, n, 3, C) products of a fold's rotated features and a field (s, n, 3, C) on some of
        the rows that the fold holds out."""
        answer = np.empty((self.features.shape[1], *field.shape[1:]), np.float32)
        for basis, own in zip(self.bases[number], self._own(number, rows), strict=True):
            at = _at_once(basis.points)
            some = field[:, at]
            answer[:, at] = (own.T @ some.reshape(len(some), -1)).reshape(-1, *some.shape[1:])
        return answer


def _bases(features: np.ndarray, seen: np.ndarray, held: list[slice]) -> list[list[Basis]]:
    """The static fits to all rows (S, F) but those that each fold holds out, which come first.

    seen: (S, n) which key points were measured; those that were measured together share a fit.
    """
    groups, which = np.unique(seen, axis=1, return_inverse=True)
    bases: list[list[Basis]] = [[] for _ in held]
    parts = [*held, slice(held[-1].stop, None)]
    for g, measured in enumerate(groups.T):
        points = np.flatnonzero(which.reshape(-1) == g)
        grams = []
        for rows in parts:
            some = features[rows] if measured[rows].all() else features[rows][measured[rows]]
            grams.append(some.T @ some)
        whole = np.sum(grams, axis=0)
        for number in range(len(held)):
            found = linalg.eigh(whole - grams[number], check_finite=False)
            bases[number].append(Basis(points, *found))
    return bases


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
    by_fold: "HeldOut"
    """Sums of `held_out` over the blocks of each fold. Levels lie one after another among the
    blocks, (1, ..., L folds): all are looked at together, and a line of the cache holds them."""
    turned: list[np.ndarray]
    """For each fold (F, n, 3, 1 + K) products of the static part's basis and `fields`."""
    solved: dict = field(default_factory=dict)
    """Held-out sums of squares and amplitudes with every ridge, by sensitivities."""
    best: dict = field(default_factory=dict)
    """Held-out sums of squares of each block with the best ridges, by sensitivities."""
    factors: dict = field(default_factory=dict)
    """Factors of the normal matrices of what many sets have in common (`_solve`)."""

    @classmethod
    def on(
        cls, split: Split, sensitivities: np.ndarray | Sequence[np.ndarray]
    ) -> "CrossValidation":
        """The cross-validation of sensitivities (rows, n, 3, K), or of several such arrays side by
        side, on a split."""
        given = [sensitivities] if isinstance(sensitivities, np.ndarray) else sensitivities
        both = split.laid_out(given, room=1)
        both[..., 0] = split.residual[: split.rows]
        known = split.residual[split.rows :]
        turned = split.turned(both, known)
        grams, lines = _products(split, both, turned)
        grams[:, :, 0, 0] += np.square(known, dtype=float).sum()
        held_out = HeldOut.of(lines, both.shape[3])
        by_fold = HeldOut.of(_side_by_side(split.by_fold(lines)), both.shape[3])
        return cls(split, (both,), grams, held_out, by_fold, turned)

    def extended(self, sensitivities: np.ndarray) -> "CrossValidation":
        """This cross-validation with further sensitivities (rows, n, 3, K') after its own."""
        more = self.split.laid_out([sensitivities])
        fields = (*self.fields, more)
        turned = self.split.turned(more)
        whole = [np.concatenate(pair, axis=3) for pair in zip(self.turned, turned, strict=True)]
        grams, border = _products_with(self.split, fields, whole, more, turned)
        grams = _bordered(self.grams, grams)
        return CrossValidation(
            self.split,
            fields,
            grams,
            self.held_out.extended(border),
            self.by_fold.extended(_side_by_side(self.split.by_fold(border))),
            whole,
            dict(self.solved),
            dict(self.best),
            dict(self.factors),
        )

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

    def losses(
        self, chosen: Sequence[int] | np.ndarray = (), common: Sequence[int] = ()
    ) -> np.ndarray:
        """(B,) held-out sum of squared distances of each block with chosen sensitivities, mm^2.

        common: those of them that other sets have, too. Where they are many (LARGE), the fit to
        them is kept, and a set that adds few takes a small part of the time.
        """
        sensitivities = _rising(chosen)
        key = sensitivities.tobytes()
        if key not in self.best:
            sums, amplitudes = self._solved(sensitivities, common)
            ridges = len(RIDGES) if len(sensitivities) > 1 else 1
            level, ridge = np.unravel_index(sums[:, :ridges].argmin(), (len(sums), ridges))
            some = amplitudes[level, ridge][None, None]
            losses = self._sums(self.held_out, sensitivities, some, self.split.fold, int(level))
            self.best[key] = losses[0, 0]
        return self.best[key]

    def losses_of(
        self, sets: Sequence[Sequence[int]], common: Sequence[Sequence[int]] | None = None
    ) -> np.ndarray:
        """(N, B) `losses` of each of N sets of sensitivities.

        Solving a set of few sensitivities takes less time than a call from Python. So all sets that
        were not tried yet are solved in one call. common: for each set, the sensitivities that it
        shares with other sets; None: none.
        """
        found = [_rising(each) for each in sets]
        shared = [()] * len(sets) if common is None else common
        new = {
            key: each
            for each, known in zip(found, shared, strict=True)
            if (key := each.tobytes()) not in self.best
            and key not in self.solved
            and len(known) < LARGE
        }
        if new:
            rows = np.concatenate([np.append(0, each + 1) for each in new.values()])
            ends = np.cumsum([1 + len(each) for each in new.values()])
            losses = np.empty((len(new), len(self.split.fold)))
            held_out, by_fold, fold = self.held_out, self.by_fold, self.split.fold
            products = (held_out.first, held_out.further, by_fold.first, by_fold.further)
            _losses_of(self.grams, *products, rows, ends, np.array(RIDGES), fold, losses)
            self.best.update(zip(new, losses, strict=True))
        answer = [self.losses(each, known) for each, known in zip(found, shared, strict=True)]
        return np.array(answer).reshape(len(sets), len(self.split.fold))

    def losses_without_each(self, groups: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
        """(B,) `losses` with the sensitivities of all groups but one, for each group in turn.

        groups: sensitivities, each in one group. The normal matrices of all are inverted once; what
        leaving out a group changes follows from its own part of the inverse (elimination by
        blocks, Golub & Van Loan 2013, section 3.2), a small part of a new solution.
        """
        everything = _rising([one for group in groups for one in group])
        rests = [np.setdiff1d(everything, group) for group in groups]
        for rest, found in zip(rests, self._without_each(everything, groups), strict=False):
            if rest.tobytes() not in self.solved:
                self._keep(rest, found)
        return [self.losses(rest) for rest in rests]

    def _without_each(
        self, everything: np.ndarray, groups: Sequence[tuple[int, ...]]
    ) -> list[np.ndarray]:
        """(L, r, folds, k) amplitudes of the sensitivities that each group leaves of everything.

        Empty where a sensitivity is next to nothing beside another one, as `_solve` then scales it
        by what else is fitted, or where rounding makes a normal matrix indefinite.
        """
        levels, folds = self.grams.shape[:2]
        columns, one = 1 + everything, np.eye(len(everything))
        out = [np.isin(everything, group) for group in groups]
        answer = [np.empty((levels, len(RIDGES), folds, int((~some).sum()))) for some in out]
        for level, number in np.ndindex(levels, folds):
            gram = self.grams[level, number]
            own, right = gram[np.ix_(columns, columns)], gram[columns, 0]
            square = np.diag(own)
            if not square.size or square.min() <= FAINT * max(square.max(), FAINTEST):
                return []
            size = np.sqrt(square)
            scaled = 0.5 * (own + own.T) / (size[:, None] * size)
            for place, ridge in enumerate(RIDGES):
                try:
                    root = linalg.cholesky(scaled + ridge * one, check_finite=False)
                except linalg.LinAlgError:
                    return []
                half = linalg.lapack.dpotri(root, overwrite_c=True)[0]
                inverse = np.triu(half) + np.triu(half, 1).T
                whole = inverse @ (right / size)
                for found, some in zip(answer, out, strict=True):
                    change = np.linalg.solve(inverse[np.ix_(some, some)], whole[some])
                    left = whole[~some] - inverse[np.ix_(~some, some)] @ change
                    found[level, place, number] = left / size[~some]
        return answer

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
        products = np.moveaxis(self.held_out.among(columns, level), -1, 0)
        return mix.T @ products.astype(float) @ mix

    def _fitted(self, chosen: np.ndarray) -> tuple[np.ndarray, int]:
        """(k,) amplitudes of the chosen sensitivities, mean over the folds, and their level."""
        sensitivities = _rising(chosen)
        where = np.searchsorted(sensitivities, chosen)
        sums, amplitudes = self._solved(sensitivities)
        level, ridge = np.unravel_index(sums.argmin(), sums.shape)
        return amplitudes[level, ridge].mean(axis=0)[where], int(level)

    def _solved(
        self, sensitivities: np.ndarray, common: Sequence[int] = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """((L, r) held-out sums of squares, (L, r, folds, k) amplitudes) for every ridge.

        Amplitudes are the same in all blocks of a fold, so that its products are added up first:
        the blocks are looked at for the best ridges alone.
        """
        key = sensitivities.tobytes()
        if key not in self.solved:
            known = _rising(common if len(common) >= LARGE else ())
            order = sensitivities
            if len(known):
                order = np.concatenate([known, np.setdiff1d(sensitivities, known)])
            none = np.empty((*self.grams.shape[:2], len(RIDGES), 0, 0))
            found = self._amplitudes(order, self._factors(known), none)
            if len(known):
                found = np.ascontiguousarray(found[..., np.argsort(order)])
            self._keep(sensitivities, found)
        return self.solved[key]

    def _keep(self, sensitivities: np.ndarray, amplitudes: np.ndarray) -> None:
        """Keep amplitudes (L, r, folds, k) of sensitivities and what they leave."""
        levels, ridges, folds, count = amplitudes.shape
        together = amplitudes.swapaxes(0, 1).reshape(1, ridges, levels * folds, count)
        each = np.arange(levels * folds)
        sums = self._sums(self.by_fold, sensitivities, together, each)
        sums = sums.reshape(ridges, levels, folds).swapaxes(0, 1)
        self.solved[sensitivities.tobytes()] = sums.sum(axis=2), amplitudes

    def _factors(self, common: np.ndarray) -> np.ndarray:
        """(L, folds, r, c, c + 1) factors of the normal matrices of c sensitivities."""
        key, count = common.tobytes(), len(common)
        if key not in self.factors:
            levels, folds = self.grams.shape[:2]
            none = np.empty((levels, folds, len(RIDGES), 0, 1))
            kept = np.empty((levels, folds, len(RIDGES), count, count + 1))
            self._amplitudes(common, none, kept)
            self.factors[key] = kept
        return self.factors[key]

    def _amplitudes(self, order: np.ndarray, known: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """(L, r, folds, k) amplitudes of sensitivities in an order; see `_solve`."""
        levels, folds = self.grams.shape[:2]
        amplitudes = np.empty((levels, len(RIDGES), folds, len(order)))
        _solve(self.grams, np.append(0, order + 1), np.array(RIDGES), known, kept, amplitudes)
        return amplitudes

    def _sums(
        self,
        products: "HeldOut",
        sensitivities: np.ndarray,
        amplitudes: np.ndarray,
        fold: np.ndarray,
        level: int = 0,
    ) -> np.ndarray:
        """(L, r, B) held-out sums of squares at amplitudes (L, r, folds, k) from a level on.

        products: of B blocks, fold (B,) their folds; or of the folds.
        """
        losses = np.empty((*amplitudes.shape[:2], len(fold)))
        rows = np.append(0, sensitivities + 1)
        some = slice(level, level + len(amplitudes))
        _sum_squares(products.first[some], products.further[some], rows, amplitudes, fold, losses)
        return losses


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

    @classmethod
    def of(cls, lines: np.ndarray, columns: int) -> "HeldOut":
        """The products (L, C (C + 1) / 2, B) of C columns."""
        return cls(lines, np.empty((len(lines), columns, 0, lines.shape[2]), np.float32))

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

    def among(self, columns: np.ndarray, level: int) -> np.ndarray:
        """(k, k, B) products of some columns (k,) at a level."""
        count = len(columns)
        answer = np.empty((count, count, self.first.shape[2]), np.float32)
        for i in range(count):
            for j in range(i + 1):
                pair = _pair(self.first, self.further, level, columns[i], columns[j])
                answer[i, j] = answer[j, i] = pair
        return answer


def _side_by_side(products: np.ndarray) -> np.ndarray:
    """(1, ..., L F) products (L, ..., F) of L levels and F folds, level by level."""
    moved = np.moveaxis(products, 0, -2)
    return moved.reshape(1, *moved.shape[:-2], -1)


def _rising(chosen: Sequence[int] | np.ndarray) -> np.ndarray:
    """The different numbers among some, in rising order; faster than `np.unique` for few."""
    return np.array(sorted(set(map(int, chosen))), int)


def _products(
    split: Split, field: np.ndarray, turned: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """(grams, lines) of the C columns of a field (rows, n, 3, C) with `turned` products.

    grams: (L, folds, C, C) as in CrossValidation. lines: (L, C (C + 1) / 2, blocks) as in HeldOut.
    """
    levels, folds, size = len(split.ridges), len(split.held), field.shape[3]
    parts = np.empty((folds, size, size))
    for number, held in enumerate(split.held):
        parts[number] = _product(field[held], field[held])
    grams = np.empty((levels, folds, size, size))
    lines = np.empty((levels, size * (size + 1) // 2, len(split.fold)), np.float32)
    by_block = np.empty((len(split.fold), lines.shape[1]), np.float32)
    for level in range(levels):
        for number in range(folds):
            root = np.sqrt(split.weight(number, level))[..., None, None]
            shrunk = turned[number] / root
            grams[level, number] = _product(shrunk, shrunk)
            shrunk /= root
            coefficients = split.by_basis(shrunk, number)
            for strip, blocks in _strips(split.blocks[number], field[0].size):
                left = split.away(field[strip], coefficients, number, strip)
                for one, rows in blocks:
                    own = left[rows.start - strip.start : rows.stop - strip.start]
                    _lower(_product(own, own), by_block[one])
        # A set of columns is then looked up in lines of all blocks, which the cache holds.
        _transpose(by_block, lines[level])
    np.subtract(parts.sum(axis=0) - parts, grams, out=grams)
    return grams, lines


def _products_with(
    split: Split,
    fields: Sequence[np.ndarray],
    whole: list[np.ndarray],
    more: np.ndarray,
    turned: list[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """(grams, border) of the columns of all fields with A columns of one more, itself among them.

    fields: (rows, n, 3, c), C columns in all, the A of `more` last; whole and turned: products of
    all of them and of `more` as of `Split.turned`. grams: (L, folds, C, A) as in CrossValidation;
    border: (L, C, A, blocks) products on each held-out block, as `HeldOut.extended` takes them. The
    static part is taken from the A columns alone: what it leaves of two columns has the product

        (x - P x)' (y - P y) = x' (y - P y) - x' P' (y - P y)

    and P y on the rows of a block follows from the few products `turned`.
    """
    levels, folds = len(split.ridges), len(split.held)
    count, size = whole[0].shape[3], more.shape[3]
    parts = np.empty((folds, count, size))
    grams = np.empty((levels, folds, count, size))
    border = np.empty((levels, count, size, len(split.fold)), np.float32)
    for number, held in enumerate(split.held):
        parts[number] = np.concatenate([_product(each[held], more[held]) for each in fields])
        weights = [split.weight(number, level)[..., None, None] for level in range(levels)]
        coefficients = []
        for level, weight in enumerate(weights):
            shrunk = turned[number] / weight
            grams[level, number] = _product(whole[number], shrunk)
            coefficients.append(split.by_basis(shrunk, number))
        for one, rows in split.blocks[number]:
            left = [split.away(more[rows], each, number, rows) for each in coefficients]
            pulled = [
                split.projected(each, number, rows) / weight
                for each, weight in zip(left, weights, strict=True)
            ]
            right = np.concatenate(left, axis=3)
            direct = np.concatenate([_product(each[rows], right) for each in fields])
            direct -= _product(whole[number], np.concatenate(pulled, axis=3))
            border[..., one] = np.moveaxis(direct.reshape(count, levels, size), 1, 0)
    np.subtract(parts.sum(axis=0) - parts, grams, out=grams)
    return grams, border


def _strips(
    blocks: Sequence[tuple[int, slice]], width: int
) -> Iterator[tuple[slice, list[tuple[int, slice]]]]:
    """Rows of a fold that are worked through at once, and their blocks; width: numbers in a row."""
    strip: list[tuple[int, slice]] = []
    for one, rows in blocks:
        if strip and (rows.stop - strip[0][1].start) * width > STRIP:
            yield slice(strip[0][1].start, strip[-1][1].stop), strip
            strip = []
        strip.append((one, rows))
    if strip:
        yield slice(strip[0][1].start, strip[-1][1].stop), strip


def _where(chosen: np.ndarray) -> slice:
    """The rows (S,) bool that are set, which lie together; an empty slice for none."""
    places = np.flatnonzero(chosen)
    return slice(int(places[0]), int(places[-1]) + 1) if len(places) else slice(0, 0)


def _at_once(places: np.ndarray) -> np.ndarray | slice:
    """Rising places as a slice, which copies nothing, where they have no gaps."""
    if len(places) != places[-1] - places[0] + 1:
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
    mix, along = np.ones((size, ridges, blocks)), np.empty((ridges, blocks))
    least = np.empty((ridges, blocks))
    for level in range(levels):
        total = losses[level]
        for i in range(1, size):
            for ridge in range(ridges):
                for block in range(blocks):
                    mix[i, ridge, block] = -amplitudes[level, ridge, fold[block], i - 1]
        total[:] = 0.0
        least[:] = 0.0
        for i in range(size):
            along[:] = 0.0
            for j in range(i):
                product = _pair(first, further, level, rows[i], rows[j])
                for ridge in range(ridges):
                    for block in range(blocks):
                        along[ridge, block] += product[block] * mix[j, ridge, block]
            own = _pair(first, further, level, rows[i], rows[i])
            for ridge in range(ridges):
                for block in range(blocks):
                    square = own[block] * mix[i, ridge, block] * mix[i, ridge, block]
                    total[ridge, block] += 2.0 * mix[i, ridge, block] * along[ridge, block] + square
                    least[ridge, block] += square
        for ridge in range(ridges):
            for block in range(blocks):
                total[ridge, block] = max(total[ridge, block], ROUNDING * least[ridge, block])


@compiled(reorder=True)
def _solve(grams, rows, ridges, known, kept, amplitudes):
    """Write least-squares amplitudes with each of r ridges into amplitudes (L, r, folds, k).

    grams (L, folds, C, C): products of the residual, row 0, and the sensitivities; rows (1 + k,)
    those that are looked at, 0 first. Normal matrices are scaled to a diagonal of 1 and factorised
    as L D L' (Golub & Van Loan 2013, section 4.1) without pivoting: the ridge is a thousand times
    the rounding of the products, so that no pivot is near zero.

    known (L, folds, r, c, c + 1): the factors of the first c sensitivities, L below the diagonal,
    D on it, and the right side after the elimination in the last column. kept: where those of all k
    are written to, alike; without room (0 rows) they are not.
    """
    levels, folds = grams.shape[:2]
    count, common = len(rows) - 1, known.shape[3]
    scaled, lower, size = np.empty((count, count)), np.empty((count, count)), np.empty(count)
    row, pivot, found = np.empty(count), np.empty(count), np.empty(count)
    for level in range(levels):
        for number in range(folds):
            gram = grams[level, number]
            most = FAINTEST
            for i in range(count):
                most = max(most, gram[rows[i + 1], rows[i + 1]])
            for i in range(count):
                size[i] = np.sqrt(max(gram[rows[i + 1], rows[i + 1]], FAINT * most))
            for i in range(common, count):
                for j in range(i + 1):
                    one, other = rows[i + 1], rows[j + 1]
                    both = 0.5 * (gram[one, other] + gram[other, one])
                    scaled[i, j] = both / (size[i] * size[j])
            for ridge in range(len(ridges)):
                before = known[level, number, ridge]
                for i in range(common):
                    pivot[i], found[i] = before[i, i], before[i, common]
                for i in range(common, count):
                    for j in range(i):
                        rest = scaled[i, j]
                        if j < common:
                            for p in range(j):
                                rest -= row[p] * before[j, p]
                        else:
                            for p in range(j):
                                rest -= row[p] * lower[j, p]
                        row[j] = rest
                    rest = scaled[i, i] + ridges[ridge]
                    value = gram[rows[i + 1], 0] / size[i]
                    for j in range(i):
                        lower[i, j] = row[j] / pivot[j]
                        rest -= row[j] * lower[i, j]
                        value -= lower[i, j] * found[j]
                    pivot[i] = rest
                    found[i] = value
                for i in range(kept.shape[3]):
                    after = kept[level, number, ridge, i]
                    for j in range(i):
                        after[j] = lower[i, j]
                    after[i], after[count] = pivot[i], found[i]
                for i in range(count):
                    found[i] /= pivot[i]
                for i in range(count - 1, -1, -1):
                    for j in range(i):
                        if i < common:
                            found[j] -= before[i, j] * found[i]
                        else:
                            found[j] -= lower[i, j] * found[i]
                    amplitudes[level, ridge, number, i] = found[i] / size[i]


@compiled
def _losses_of(grams, first, further, fold_first, fold_further, rows, ends, ridges, fold, losses):
    """Write held-out sums of squares of sets of sensitivities into losses (N, B), mm^2.

    grams: as in CrossValidation; first and further: products on each block, fold_first and
    fold_further on each fold, as in HeldOut; rows: those of each set, 0 first, one set after
    another; ends (N,): where each ends; fold (B,) of each block. The level and the ridge of a set
    are those that leave least in all; a single sensitivity has the least ridge.
    """
    levels, folds = grams.shape[:2]
    known = np.empty((levels, folds, len(ridges), 0, 1))
    kept = np.empty((levels, folds, len(ridges), 0, 0))
    each, begin = np.arange(levels * folds), 0
    for number in range(len(ends)):
        own = rows[begin : ends[number]]
        begin = ends[number]
        count = len(own) - 1
        amplitudes = np.empty((levels, len(ridges), folds, count))
        _solve(grams, own, ridges, known, kept, amplitudes)
        together = np.empty((1, len(ridges), levels * folds, count))
        for level in range(levels):
            for ridge in range(len(ridges)):
                for one in range(folds):
                    for i in range(count):
                        value = amplitudes[level, ridge, one, i]
                        together[0, ridge, level * folds + one, i] = value
        sums = np.empty((1, len(ridges), levels * folds))
        _sum_squares(fold_first, fold_further, own, together, each, sums)
        least, best_level, best_ridge = np.inf, 0, 0
        for level in range(levels):
            for ridge in range(len(ridges) if count > 1 else 1):
                total = 0.0
                for one in range(folds):
                    total += sums[0, ridge, level * folds + one]
                if total < least:
                    least, best_level, best_ridge = total, level, ridge
        some = amplitudes[best_level : best_level + 1, best_ridge : best_ridge + 1]
        place = losses[number : number + 1].reshape(1, 1, losses.shape[1])
        level = best_level
        _sum_squares(first[level : level + 1], further[level : level + 1], own, some, fold, place)


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
