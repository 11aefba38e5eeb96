"""Sign flips against their enumeration; shares of bootstraps that are known."""

import itertools

import numpy as np
import pytest

from surgisoft.diagnosis import gates


def test_chances_are_those_of_all_signs(monkeypatch):
    """With few blocks every sign can be tried: the drawn chance comes to the exact one."""
    monkeypatch.setattr(gates, "FLIPS", 20000)
    gains = np.random.default_rng(3).normal(0.4, 1.0, (3, 7))
    seen = gates.studentised(gains)
    largest = np.array(
        [
            gates.studentised(gains * np.array(signs)).max()
            for signs in itertools.product((-1.0, 1.0), repeat=7)
        ]
    )
    exact = (largest[None] >= seen[:, None] - 1e-12).mean(axis=1)
    assert gates.family_p_values(gains) == pytest.approx(exact, abs=0.015)


def test_no_cause_no_name():
    """Without any cause the least chance of twenty candidates is below 5 % about 5 % of the time."""
    rng = np.random.default_rng(0)
    least = [
        gates.family_p_values(rng.standard_t(4, size=(20, 25)), seed=i).min() for i in range(150)
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
