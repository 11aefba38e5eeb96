"""Sign flips against their enumeration; shares of bootstraps that are known."""

import itertools

import numpy as np
import pytest

from surgisoft.diagnosis.race import gates


def exact_chances(gains: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The corrected chances by every combination of signs."""
    signs = itertools.product((-1.0, 1.0), repeat=gains.shape[1])
    all_t = np.array([gates.studentised(gains * np.array(s)) for s in signs])
    seen = gates.studentised(gains)
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
def test_chances_are_those_of_all_signs(monkeypatch, group):
    """With few blocks every sign can be tried: the drawn chance comes to the exact one."""
    monkeypatch.setattr(gates, "FLIPS", 20000)
    gains = np.random.default_rng(3).normal(0.4, 1.0, (3, 8))
    exact = exact_chances(gains, np.array(group))
    assert gates.family_p_values(gains, group) == pytest.approx(exact, abs=0.02)


def test_no_cause_no_name():
    """Without any cause the least of twenty chances is below 5 % about 5 % of the time."""
    rng = np.random.default_rng(0)
    least = [
        gates.family_p_values(rng.standard_t(4, size=(20, 25)), seed=i).min() for i in range(100)
    ]
    assert 0.0 < np.mean(np.array(least) < 0.05) < 0.12


def test_a_steady_gain_is_beyond_chance():
    gains = np.random.default_rng(1).normal(0.0, 1.0, (10, 25))
    gains[4] += 1.5
    chances = gates.family_p_values(gains)
    assert chances[4] < 0.01
    assert np.delete(chances, 4).min() > 0.05


def test_shares_of_winners():
    losses = np.array([np.full(12, 1.0), np.full(12, 2.0)])
    assert gates.first_shares(losses).tolist() == [1.0, 0.0]
    even = np.array([[1.0, 0.0] * 10, [0.0, 1.0] * 10])
    assert gates.first_shares(even)[0] == pytest.approx(0.5, abs=0.15)
