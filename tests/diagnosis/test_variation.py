"""How much the amplitude of an effect varies between motions, against known amplitudes."""

from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.evidence import variation
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.diagnosis.selection import ModelSelection, Selected
from surgisoft.diagnosis.statistics import variance_between
from surgisoft.surrogate.model import Validation
from tests.diagnosis.synthetic import PERIOD_S, recording, still_model, walk

ROWS = 2000
BLOCK_S = 5.0


def test_variance_between_samples_by_hand():
    """Weights 1, 1 and 1/4 of 0, 2 and 1: mean 1, Q = 2, nothing beyond 2 degrees of freedom;
    of 0, 4 and 2 mean 2, Q = 8, and (8 - 2) / (2.25 - 2.0625 / 2.25) is beyond."""
    variances = np.array([1.0, 1.0, 4.0])
    assert variance_between(np.array([0.0, 2.0, 1.0]), variances) == 0.0
    found = variance_between(np.array([0.0, 4.0, 2.0]), variances)
    assert found == pytest.approx(6.0 / (2.25 - 2.0625 / 2.25))
    assert variance_between(np.array([3.0]), np.array([0.1])) == 0.0
    assert variance_between(np.array([0.0, 4.0, 2.0]), np.zeros(3)) == pytest.approx(4.0)
    assert variance_between(np.array([2.0, 2.0]), np.array([0.0, 0.1])) == 0.0


def test_variance_between_is_that_which_was_drawn():
    """10,000 samples of standard deviation 0.3 around 1, each with an error of its own size."""
    rng = np.random.default_rng(0)
    size = rng.uniform(0.05, 0.6, 10_000)
    seen = 1.0 + 0.3 * rng.normal(size=10_000) + size * rng.normal(size=10_000)
    assert variance_between(seen, size**2) == pytest.approx(0.09, rel=0.1)


def shifted(factor_of_block, size_mm):
    """Effects on an arm whose tip is shifted by a size times a factor in each block of time."""
    model = still_model()
    model.validation = Validation(0.1, (0.1, 0.1, 0.1), ROWS)
    block = (PERIOD_S * np.arange(ROWS) / BLOCK_S).astype(int)
    moved = recording(size_mm * factor_of_block[block], walk(ROWS))
    problem = problem_of(model, [moved])
    selection = ModelSelection.of(problem, candidates(problem, ["misalignment"]))
    return Selected(selection, selection.scores(), ())


@pytest.mark.parametrize(
    ("size_mm", "spread", "low", "high"), [(1.0, 0.5, 0.15, 0.4), (0.05, 0.0, 0.0, 0.003)]
)
def test_amplitudes_that_differ_between_motions_vary(size_mm, spread, low, high):
    """By the square of the spread that each block's amplitude was drawn with.

    A shift as small as the noise has another amplitude in every block by the noise alone.
    """
    factors = 1.0 + spread * np.random.default_rng(1).normal(size=ROWS)
    found = shifted(factors, size_mm)
    (value,) = variation(found, found.first[:1])
    assert low <= value <= high


def test_the_second_of_two_varies_beside_the_first():
    """Products by hand: what the two explain overlaps, and the second alone varies."""
    rng = np.random.default_rng(2)
    blocks, rows = 60, 40
    factor = 1.0 + 0.4 * rng.normal(size=blocks)
    products = np.empty((blocks, 3, 3))
    for place in range(blocks):
        first, other = rng.normal(size=(2, rows))
        second = 0.6 * first + 0.8 * other
        left = 0.05 * rng.normal(size=rows)
        columns = np.stack([first + factor[place] * second + left, first, second])
        products[place] = columns @ columns.T
    validation = SimpleNamespace(contributions=lambda groups: products)
    found = SimpleNamespace(
        selection=SimpleNamespace(validation=validation),
        problem=SimpleNamespace(motion=np.arange(blocks)),
    )
    score = SimpleNamespace(option=SimpleNamespace(chosen=(0,)))
    first, second = variation(found, [score, score])
    assert first < 0.003
    assert second == pytest.approx(np.var(factor), rel=0.05)
