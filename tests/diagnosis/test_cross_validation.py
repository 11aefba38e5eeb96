"""Held-out errors of sets of columns, against fitting each fold anew."""

import itertools

import numpy as np
import pytest

from surgisoft.diagnosis import cross_validation
from surgisoft.diagnosis.cross_validation import (
    PERSISTENCE,
    RIDGES,
    ROOM,
    CrossValidation,
    Split,
    static_features,
)
from surgisoft.diagnosis.discrepancy import kernel

ROWS, POINTS, COLUMNS, BLOCKS = 120, 2, 3, 10


@pytest.fixture
def data():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(ROWS, 6))
    columns = rng.normal(size=(ROWS, POINTS, 3, COLUMNS))
    residual = 0.3 * rng.normal(size=(ROWS, POINTS, 3)) + 0.8 * columns[..., 1]
    residual += np.einsum("sf,fpc->spc", features, 0.1 * rng.normal(size=(6, POINTS, 3)))
    residual[5, 1] = np.nan
    residual[40:44, 0] = np.nan
    block = np.arange(ROWS) * BLOCKS // ROWS
    return features, residual, columns, block, np.arange(BLOCKS) % 5


def cross_validated(features, residual, columns, block, fold, discrepancy, noise):
    """The cross-validation of columns (S, n, 3, K) on a split of the rows."""
    split = Split.of(features, residual, block, fold, discrepancy, noise)
    return CrossValidation.on(split, columns)


def brute(data, picked, rows, share, surrogate, noise):
    """(B,) held-out sums of squares by joint ridge regression, fold by fold."""
    features, residual, columns, block, fold = data
    seen = np.isfinite(residual).all(2)
    answer = np.zeros(BLOCKS)
    mean = [np.square(residual[seen[:, k], k]).sum(1).mean() for k in range(POINTS)]
    for number in range(5):
        held = fold[block] == number
        size = features.shape[1]
        unknowns = POINTS * 3 * size + len(picked)
        normal, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        parts = []
        for k in range(POINTS):
            ridge = (noise[k] ** 2 + rows * mean[k]) / (ROOM * surrogate[k]) ** 2
            for c in range(3):
                design = np.zeros((ROWS, unknowns))
                first = (3 * k + c) * size
                design[:, first : first + size] = features
                design[:, POINTS * 3 * size :] = columns[:, k, c, picked]
                fit = ~held & seen[:, k]
                normal += design[fit].T @ design[fit]
                normal[range(first, first + size), range(first, first + size)] += ridge
                right += design[fit].T @ residual[fit, k, c]
                parts.append((k, c, design))
        # The ridge on amplitudes is a share of what the static part leaves of each column.
        static, own = slice(0, POINTS * 3 * size), slice(POINTS * 3 * size, unknowns)
        left = normal[own, own] - normal[own, static] @ np.linalg.solve(
            normal[static, static], normal[static, own]
        )
        normal[own, own] += share * np.diag(np.diag(left))
        solution = np.linalg.solve(normal, right)
        for k, c, design in parts:
            test = held & seen[:, k]
            error = residual[test, k, c] - design[test] @ solution
            answer += np.bincount(block[test], weights=error**2, minlength=BLOCKS)
    return answer


@pytest.mark.parametrize("picked", [[], [1], [0, 1, 2]])
def test_losses_are_those_of_joint_fits(data, picked):
    surrogate, noise = np.array([0.3, 0.5]), np.array([0.1, 0.1])
    found = cross_validated(*data, surrogate, noise)
    shares = RIDGES if len(picked) > 1 else RIDGES[:1]
    tried = [
        brute(data, picked, rows, share, surrogate, noise)
        for rows in PERSISTENCE
        for share in shares
    ]
    assert found.losses(picked) == pytest.approx(min(tried, key=np.sum), rel=2e-4)


@pytest.mark.parametrize("common", [[1], [0, 2], [0, 1, 2]])
def test_what_sets_have_in_common_is_factorised_once(monkeypatch, data, common):
    """The set of all columns, after the fit to some of them was kept."""
    monkeypatch.setattr(cross_validation, "LARGE", 1)
    surrogate, noise = np.array([0.3, 0.5]), np.array([0.1, 0.1])
    found = cross_validated(*data, surrogate, noise)
    shares = itertools.product(PERSISTENCE, RIDGES)
    tried = [brute(data, [0, 1, 2], *each, surrogate, noise) for each in shares]
    assert found.losses([0, 1, 2], common) == pytest.approx(min(tried, key=np.sum), rel=2e-4)
    plain = cross_validated(*data, surrogate, noise).amplitudes([2, 0, 1])
    assert found.amplitudes([2, 0, 1]) == pytest.approx(plain, rel=1e-9)


@pytest.mark.parametrize("common", [None, [(), (1,), (0, 2), (0, 2), ()]])
@pytest.mark.parametrize("seed", range(3))
def test_losses_of_many_sets_are_those_of_each(monkeypatch, data, seed, common):
    """Sets of other sizes, one of them twice; the last of three columns was added later."""
    if common:
        monkeypatch.setattr(cross_validation, "LARGE", 2)
    features, _, columns, *rest = data
    rng = np.random.default_rng(seed)
    residual = rng.normal(size=columns.shape[:3]) + 0.3 * columns @ rng.normal(size=COLUMNS)
    sets = [(), (1,), (2, 0), (0, 1, 2), (1,)]
    limits = np.array([0.3, 0.5]), np.array([0.1, 0.1])
    given = features, residual, columns[..., :2], *rest
    one, many = (
        cross_validated(*given, *limits).extended(columns[..., 2:].astype(np.float32))
        for _ in range(2)
    )
    found = many.losses_of(sets, common)
    for each, losses in zip(sets, found, strict=True):
        np.testing.assert_allclose(losses, one.losses(each), rtol=1e-12)
    np.testing.assert_array_equal(many.losses_of(sets), found)
    assert many.losses_of([]).shape == (0, BLOCKS)


@pytest.mark.parametrize("faint", [False, True])
def test_losses_without_each_group_are_those_of_joint_fits(data, faint):
    """Each of two groups left out; with a column next to nothing, too, which no ridge scales."""
    features, residual, columns, *rest = data
    columns = columns * np.array([1.0, 1.0, 1e-9 if faint else 1.0])
    some = features, residual, columns, *rest
    surrogate, noise = np.array([0.3, 0.5]), np.array([0.1, 0.1])
    found = cross_validated(*some, surrogate, noise).losses_without_each([(2, 0), (1,)])
    for left, picked, shares in zip(found, [[1], [0, 2]], [RIDGES[:1], RIDGES], strict=True):
        if faint and 2 in picked:
            picked = [0]  # the other one explains nothing
        tried = [
            brute(some, picked, rows, share, surrogate, noise)
            for rows in PERSISTENCE
            for share in shares
        ]
        assert left == pytest.approx(min(tried, key=np.sum), rel=2e-4)


def test_leaving_out_the_only_group_leaves_nothing(data):
    found = cross_validated(*data, np.array([0.3, 0.5]), np.array([0.1, 0.1]))
    assert found.losses_without_each([(0, 1)])[0] == pytest.approx(found.losses([]), rel=1e-12)


def test_losses_of_collinear_columns_are_those_of_joint_fits(data):
    """Columns that share most of their power, and the last one of which is weak."""
    features, residual, columns, *rest = data
    mix = np.array([[1.0, 0.9, 0.02], [0.0, 0.4, 0.03], [0.0, 0.0, 0.01]])
    mixed = features, residual, columns @ mix, *rest
    surrogate, noise = np.array([0.3, 0.5]), np.array([0.1, 0.1])
    found = cross_validated(*mixed, surrogate, noise)
    tried = [
        brute(mixed, [0, 1, 2], rows, share, surrogate, noise)
        for rows in PERSISTENCE
        for share in RIDGES
    ]
    assert found.losses([0, 1, 2]) == pytest.approx(min(tried, key=np.sum), rel=2e-4)


def test_the_right_column_has_its_amplitude(data):
    found = cross_validated(*data, np.array([0.3, 0.5]), np.array([0.1, 0.1]))
    assert found.amplitudes([1])[0] == pytest.approx(0.8, abs=0.1)
    assert found.losses([1]).sum() < 0.3 * found.losses([]).sum()
    assert found.losses([0]).sum() > 0.95 * found.losses([]).sum()


def test_features_have_the_discrepancys_covariance():
    rng = np.random.default_rng(1)
    x, d = rng.uniform(-1, 1, (60, 3)), rng.choice([-1.0, 1.0], (60, 3))
    features = static_features(x, d, number=60)
    assert features @ features.T == pytest.approx(kernel(x, d, x, d), abs=1e-4)


@pytest.mark.parametrize("cuts", [[1], [1, 2]])
def test_further_columns_are_as_if_they_had_been_there(data, cuts):
    """Columns that are added in one go, and one after the other."""
    features, residual, columns, *rest = data
    size = np.array([0.3, 0.5]), np.array([0.1, 0.1])
    whole = cross_validated(*data, *size)
    found = cross_validated(features, residual, columns[..., :1], *rest, *size)
    first = found.losses([0])
    for low, high in itertools.pairwise([*cuts, COLUMNS]):
        found = found.extended(columns[..., low:high])
    assert found.sensitivities == COLUMNS
    for known in (found.solved, found.best):  # else it would be compared with itself
        known.clear()
    assert found.losses([0]) == pytest.approx(first, rel=1e-6)
    rounding = 2e-7 * np.abs(whole.grams).max()  # of products in single precision
    np.testing.assert_allclose(found.grams, whole.grams, rtol=1e-5, atol=rounding)
    every = np.arange(1 + COLUMNS)
    for level in range(len(whole.grams)):
        products = [each.held_out.among(every, level) for each in (found, whole)]
        np.testing.assert_allclose(*products, rtol=1e-4, atol=1e-4)
    assert found.losses([0, 1, 2]) == pytest.approx(whole.losses([2, 1, 0]), rel=1e-4)
    assert found.amplitudes([2, 0]) == pytest.approx(whole.amplitudes([0, 2])[::-1], rel=1e-3)


def test_losses_do_not_depend_on_where_a_blocks_rows_lie(data):
    """Rows of a fold are brought together: given blockwise or shuffled, they are the same rows."""
    features, residual, columns, block, fold = data
    size = np.array([0.3, 0.5]), np.array([0.1, 0.1])
    ordered = cross_validated(*data, *size)
    some = np.random.default_rng(3).permutation(ROWS)
    given = features[some], residual[some], columns[some], block[some], fold
    shuffled = cross_validated(*given, *size)
    for picked in ([], [1], [0, 1, 2]):
        assert shuffled.losses(picked) == pytest.approx(ordered.losses(picked), rel=1e-4)
    np.testing.assert_array_equal(shuffled.counts, ordered.counts)


def test_contributions_are_products_of_what_effects_explain(data):
    """Two groups of columns: their sums at the fitted amplitudes leave the held-out losses."""
    features, residual, columns, block, fold = data
    noise, surrogate = np.full(POINTS, 0.05), np.full(POINTS, 0.2)
    found = cross_validated(features, residual, columns, block, fold, surrogate, noise)
    products = found.contributions([(1, 2), (0,)])
    assert products.shape == (BLOCKS, 3, 3)
    alone = found.contributions([(0, 1, 2)])
    both = products[:, 1:, 1:].sum((1, 2))
    assert alone[:, 1, 1] == pytest.approx(both, rel=1e-5)
    mix = np.array([1.0, -1.0, -1.0])
    left = np.einsum("i,bij,j->b", mix, products, mix)
    assert left == pytest.approx(found.losses((0, 1, 2)), rel=0.05)


def test_a_held_out_error_is_no_less_than_its_rounding_error():
    """Two columns that are large and equal where the rows are held out, and are subtracted there.

    The residual is their difference, so that what is left after the fit is the difference of
    products as large as 1e10 mm^2 in single precision: without a bound it comes out negative.
    """
    worst = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        block = np.arange(ROWS) * BLOCKS // ROWS
        common, apart = rng.normal(size=(2, ROWS, POINTS, 3))
        common[block == 3] *= 1e4
        apart[block == 3] *= 1e-3
        columns = np.stack([common + apart, common - apart], axis=3)
        validation = cross_validated(
            np.zeros((ROWS, 1)), 2.0 * apart, columns, block, np.arange(BLOCKS),
            np.full(POINTS, 0.01), np.full(POINTS, 0.01),
        )  # fmt: skip
        worst.append(validation.losses((0, 1))[3])
    assert min(worst) >= 0.5e8 * 2.0**-24
