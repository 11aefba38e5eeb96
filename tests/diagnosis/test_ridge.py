"""Held-out predictions against refitting by hand."""

import numpy as np
import pytest

from surgisoft.diagnosis.race.ridge import cross_validate


def data(rows=240, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(rows, 6)) * [1, 10, 0.1, 1, 1, 0]
    y = x[:, :3] @ rng.normal(size=(3, 2)) + rng.normal(0, 0.1, (rows, 2)) + 4.0
    return x, y, np.arange(rows) * 4 // rows


def test_equals_least_squares_without_the_fold():
    x, y, fold = data()
    found = cross_validate(x, y, fold, penalties=(1e-12,))
    design = np.column_stack([np.ones(len(x)), x[:, :5]])
    for part in range(4):
        weights = np.linalg.lstsq(design[fold != part], y[fold != part], rcond=None)[0]
        assert found.predicted[fold == part] == pytest.approx(design[fold == part] @ weights)


def test_missing_targets_are_left_out_of_the_fit():
    """Garbage in rows whose target is missing for one column changes nothing for it."""
    x, y, fold = data()
    y[::2, 0] = np.nan
    found = cross_validate(x, y, fold, penalties=(1e-12,))
    keep = ~np.isnan(y[:, 0])
    alone = cross_validate(x[keep], y[keep, :1], fold[keep], penalties=(1e-12,))
    assert found.predicted[keep, 0] == pytest.approx(alone.predicted[:, 0], abs=1e-6)


def test_noise_is_not_predicted():
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(300, 2))
    found = cross_validate(rng.normal(size=(300, 200)), noise, np.arange(300) // 50)
    left = np.square(noise - found.predicted).mean() / np.square(noise).mean()
    assert left > 0.95
