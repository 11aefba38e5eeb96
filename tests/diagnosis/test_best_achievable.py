"""The best achievable error reaches the noise where there is a cause, and nothing beats it."""

import numpy as np
import pytest

from surgisoft.diagnosis.black_box import black_box
from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.diagnosis.selection import best_achievable
from surgisoft.measurement.protocols import make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import load_model
from tests.diagnosis.synthetic import (
    NOISE_MM,
    backlash,
    recording,
    relaxation,
    still_model,
    walk,
)

ROWS = 2000
FLOOR = np.sqrt(3) * NOISE_MM


@pytest.mark.parametrize(
    ("cause", "least"),
    [
        (lambda u: 0.8 * np.sin(u[:, 0] / 2) + 0.05 * u[:, 0] * u[:, 1], 0.97),
        (lambda u: 0.3 * (u[:, 0] - backlash(u[:, 0], 0.8)), 0.8),
        (lambda u: 0.3 * (u[:, 0] - relaxation(u[:, 0], 9.0)), 0.9),
        (lambda u: 0.2 * (u[:, 0] - relaxation(u[:, 0], 0.7)) * u[:, 1], 0.7),
    ],
    ids=["static", "backlash", "creep", "gated lag"],
)
def test_a_cause_is_learned_but_not_the_noise(cause, least):
    pressure = walk(ROWS)
    problem = problem_of(still_model(), [recording(cause(pressure), pressure)])
    before = problem.rmse_mm
    found = best_achievable(problem, black_box(problem), None)
    assert before > 1.6 * FLOOR
    assert found.rmse_mm > 0.98 * FLOOR
    explained = (before**2 - found.rmse_mm**2) / (before**2 - FLOOR**2)
    assert explained > least
    assert found.ci95_mm[0] < found.rmse_mm < found.ci95_mm[1]


def test_noise_is_not_explained():
    """White noise, and noise that neighbouring rows share over two seconds."""
    pressure = walk(ROWS)
    rng = np.random.default_rng(5)
    slow = np.convolve(rng.normal(size=ROWS + 20), np.ones(20) / 20, mode="valid")[:ROWS]
    for effect in (np.zeros(ROWS), slow):
        result, _ = compare(still_model(), [recording(effect, pressure, noise_mm=None)])
        assert result.best_achievable.rmse_mm > 0.9 * result.rmse_mm
        assert result.best_achievable.rmse_mm <= result.rmse_mm


@pytest.mark.parametrize("hidden", ["creep", "leak"])
def test_compare_and_diagnose_give_one_floor_and_one_best_achievable_error(hidden):
    """On the same rows; no error of the ranking, and none with the named effects, is below it."""
    rig = VirtualRig(0, take=3, hidden=((hidden, 1.5),))
    made, _ = rig.record(make_protocol("mixed", rig.limits, 6000, seed=3))
    model = load_model("default")
    found = diagnose(model, [made])
    result, _ = compare(model, [made], part="training")
    assert result.floor.rmse_mm == found.error_mm.floor
    assert result.best_achievable.rmse_mm == found.error_mm.best_achievable
    assert result.rmse_mm == pytest.approx(found.error_mm.before, rel=0.01)
    assert all(row.heldout_rmse_mm >= found.error_mm.best_achievable for row in found.ranking)
    assert found.error_mm.best_achievable <= found.error_mm.before
