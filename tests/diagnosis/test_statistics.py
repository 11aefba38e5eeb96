"""Intervals cover as often as they say, sign flips equal their enumeration, ridges a refit."""

import itertools

import numpy as np
import pytest

from surgisoft.diagnosis.statistics import (
    block_interval,
    block_sums,
    cross_validated_ridge,
    sign_flip_p_values,
    studentised,
    variance_between,
    win_shares,
)


def mean_of(values, block):
    sums = (block_sums(values, block), block_sums(np.ones(len(values)), block))
    return block_interval(lambda total, count: total / count, sums)


def test_sums_leave_missing_values_out():
    sums = block_sums(np.array([1.0, np.nan, 3.0, 4.0]), np.array([0, 0, 1, 1]))
    assert sums.tolist() == [1.0, 7.0]


def test_intervals_cover_as_often_as_they_say():
    """Autoregressive rows whose mean is 0: an interval of single rows would cover half as often."""
    rng = np.random.default_rng(0)
    inside, naive, tries, rows = 0, 0, 150, 960
    for _ in range(tries):
        noise = rng.normal(size=rows)
        values = np.empty(rows)
        values[0] = noise[0] / np.sqrt(1 - 0.8**2)
        for i in range(1, rows):
            values[i] = 0.8 * values[i - 1] + noise[i]
        low, high = mean_of(values, np.arange(rows) // 32)
        inside += low <= 0 <= high
        naive += abs(values.mean()) <= 1.96 * values.std() / np.sqrt(rows)
    assert inside / tries > 0.85
    assert naive / tries < 0.7


def test_one_block_gives_no_interval():
    low, high = mean_of(np.ones(5), np.zeros(5, int))
    assert np.isnan(low)
    assert np.isnan(high)


def test_draws_without_a_value_are_left_out_unless_they_are_most():
    """Of two blocks the one with a value comes in 3 of 4 draws, twice in one of these."""
    sums = (np.array([1.0, 0.0]),)
    at_least_once = block_interval(lambda total: np.where(total > 0, total, np.nan), sums)
    assert at_least_once == (1.0, 2.0)
    twice = block_interval(lambda total: np.where(total > 1, total, np.nan), sums)
    assert np.isnan(twice).all()


def test_the_variance_between_samples_by_hand():
    """1, 3 and 5 with a variance of 1 each: Q = 8 exceeds 2 by 6, over 3 - 1: 3, not 4.

    With variances of 1, 1 and 4: weights 1, 1 and 1/4, mean 7/3 and Q = 4, exceeding 2 by 2, over
    9/4 - (33/16) / (9/4) = 4/3.
    """
    values = np.array([1.0, 3.0, 5.0])
    assert variance_between(values, np.ones(3)) == pytest.approx(3.0)
    assert variance_between(values, np.array([1.0, 1.0, 4.0])) == pytest.approx(1.5)
    assert variance_between(values, np.zeros(3)) == pytest.approx(4.0)
    assert variance_between(values, np.full(3, 9.0)) == 0.0
    assert variance_between(values[:1], np.ones(1)) == 0.0


def test_rows_of_no_block_are_left_out():
    sums = block_sums(np.array([[1.0], [2.0], [4.0]]), np.array([1, -1, 0]))
    assert sums.tolist() == [[4.0], [1.0]]


def exact_chances(gains: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The corrected chances by every combination of signs."""
    signs = itertools.product((-1.0, 1.0), repeat=gains.shape[1])
    all_t = np.array([studentised(gains * np.array(s)) for s in signs])
    seen = studentised(gains)
    names = np.unique(group)
    largest = np.stack([all_t[:, group == name].max(axis=1) for name in names], axis=1)
    own = np.array(
        [
            (largest[:, names == g][:, 0] >= t - 1e-9).mean()
            for t, g in zip(seen, group, strict=True)
        ]
    )
    each = (largest[None] >= largest[:, None] - 1e-9).mean(axis=1)
    return np.array([(each.min(axis=1) <= p + 1e-9).mean() for p in own])


@pytest.mark.parametrize("group", [[0, 1, 2], [0, 0, 1]])
def test_chances_are_those_of_all_signs(group):
    """With few blocks every sign can be tried: the drawn chance comes to the exact one."""
    gains = np.random.default_rng(3).normal(0.4, 1.0, (3, 8))
    exact = exact_chances(gains, np.array(group))
    found = sign_flip_p_values(gains, group, draws=20000)
    assert found == pytest.approx(exact, abs=0.02)


def test_no_cause_no_name():
    """Without any cause the least of twenty chances is below 5 % about 5 % of the time."""
    rng = np.random.default_rng(0)
    least = [sign_flip_p_values(rng.standard_t(4, size=(20, 25)), seed=i).min() for i in range(100)]
    assert 0.0 < np.mean(np.array(least) < 0.05) < 0.12


def test_a_steady_gain_is_beyond_chance():
    gains = np.random.default_rng(1).normal(0.0, 1.0, (10, 25))
    gains[4] += 1.5
    chances = sign_flip_p_values(gains)
    assert chances[4] < 0.01
    assert np.delete(chances, 4).min() > 0.05


def test_shares_of_winners():
    losses = np.array([np.full(12, 1.0), np.full(12, 2.0)])
    assert win_shares(losses).tolist() == [1.0, 0.0]
    even = np.array([[1.0, 0.0] * 10, [0.0, 1.0] * 10])
    assert win_shares(even)[0] == pytest.approx(0.5, abs=0.15)


def regression(rows=240, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(rows, 6)) * [1, 10, 0.1, 1, 1, 0]
    y = x[:, :3] @ rng.normal(size=(3, 2)) + rng.normal(0, 0.1, (rows, 2)) + 4.0
    return x, y, np.arange(rows) * 4 // rows


def test_equals_least_squares_without_the_fold():
    x, y, fold = regression()
    found = cross_validated_ridge(x, y, fold, penalties=(1e-12,))
    design = np.column_stack([np.ones(len(x)), x[:, :5]])
    for part in range(4):
        weights = np.linalg.lstsq(design[fold != part], y[fold != part], rcond=None)[0]
        assert found.predicted[fold == part] == pytest.approx(design[fold == part] @ weights)


def test_missing_targets_are_left_out_of_the_fit():
    """Garbage in rows whose target is missing for one column changes nothing for it."""
    x, y, fold = regression()
    y[::2, 0] = np.nan
    found = cross_validated_ridge(x, y, fold, penalties=(1e-12,))
    keep = ~np.isnan(y[:, 0])
    alone = cross_validated_ridge(x[keep], y[keep, :1], fold[keep], penalties=(1e-12,))
    assert found.predicted[keep, 0] == pytest.approx(alone.predicted[:, 0], abs=1e-6)


def test_a_penalty_is_a_share_of_the_rows_and_not_on_the_mean():
    """Normal equations of centred rows, with 0.1 of the 40 rows that are left as the penalty."""
    rng = np.random.default_rng(3)
    x, fold = rng.normal(2.0, 3.0, (60, 4)), np.arange(60) % 3
    y = 500.0 + x @ rng.normal(size=(4, 2)) + rng.normal(size=(60, 2))
    found = cross_validated_ridge(x, y, fold, penalties=(0.1,)).predicted
    z = (x - x.mean(0)) / x.std(0)
    for number in range(3):
        kept, out = fold != number, fold == number
        middle, mean = z[kept].mean(0), y[kept].mean(0)
        gram = (z[kept] - middle).T @ (z[kept] - middle) + 0.1 * 40 * np.eye(4)
        slopes = np.linalg.solve(gram, (z[kept] - middle).T @ (y[kept] - mean))
        np.testing.assert_allclose(found[out], mean + (z[out] - middle) @ slopes, rtol=1e-7)


def test_a_target_that_is_often_missing_does_not_shrink_the_fit_of_another():
    rng = np.random.default_rng(4)
    x, fold = rng.normal(size=(60, 4)), np.arange(60) % 3
    y = x @ rng.normal(size=(4, 2)) + rng.normal(size=(60, 2))
    y[20:, 0] = np.nan
    found = cross_validated_ridge(x, y, fold, penalties=(0.1,)).predicted
    alone = cross_validated_ridge(x, y[:, 1:], fold, penalties=(0.1,)).predicted
    np.testing.assert_allclose(found[:, 1:], alone)


def test_noise_is_not_predicted():
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(300, 2))
    found = cross_validated_ridge(rng.normal(size=(300, 200)), noise, np.arange(300) // 50)
    left = np.square(noise - found.predicted).mean() / np.square(noise).mean()
    assert left > 0.95
