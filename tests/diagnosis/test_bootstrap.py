"""Blocks keep to runs; intervals cover as often as they say, for correlated rows too."""

import numpy as np

from surgisoft.diagnosis.bootstrap import block_bootstrap, block_sums, blocks, folds


def mean_of(values, block):
    sums = (block_sums(values, block), block_sums(np.ones(len(values)), block))
    return block_bootstrap(lambda total, count: total / count, sums)


def test_blocks_never_cross_a_run_and_are_alike_in_length():
    run = np.repeat([3, 0, 7], [400, 25, 900])
    block = blocks(run, 20)
    assert (np.diff(block) >= 0).all()
    assert sorted(set(block)) == list(range(block.max() + 1))
    for name in set(block.tolist()):
        assert len(set(run[block == name])) == 1
    lengths = np.bincount(block)
    assert lengths.max() <= 1.5 * 1325 / 20
    assert 15 <= len(lengths) <= 25


def test_folds_deal_whole_blocks_evenly():
    block = np.repeat(np.arange(24), 10)
    fold = folds(block, 6)
    assert all(len(set(fold[block == name])) == 1 for name in range(24))
    assert set(np.bincount(fold)) == {40}
    assert folds(np.zeros(5, np.int64)).tolist() == [0] * 5


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
        low, high = mean_of(values, blocks(np.zeros(rows, int)))
        inside += low <= 0 <= high
        naive += abs(values.mean()) <= 1.96 * values.std() / np.sqrt(rows)
    assert inside / tries > 0.85
    assert naive / tries < 0.7


def test_one_block_gives_no_interval():
    low, high = mean_of(np.ones(5), np.zeros(5, int))
    assert np.isnan(low)
    assert np.isnan(high)
