"""The ceiling reaches the noise where a cause is there, and claims nothing where none is."""

import numpy as np
import pytest

from surgisoft.diagnosis.compare import black_box, compare
from surgisoft.diagnosis.residuals import residuals
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
        (lambda u: 0.3 * (u[:, 0] - backlash(u[:, 0], 0.8)), 0.9),
        (lambda u: 0.3 * (u[:, 0] - relaxation(u[:, 0], 9.0)), 0.9),
        (lambda u: 0.2 * (u[:, 0] - relaxation(u[:, 0], 0.7)) * u[:, 1], 0.7),
    ],
    ids=["static", "backlash", "creep", "gated lag"],
)
def test_a_cause_is_learned_but_not_the_noise(cause, least):
    pressure = walk(ROWS)
    rest = residuals(still_model(), [recording(cause(pressure), pressure)])
    before = float(np.sqrt(np.square(rest.error_mm).mean()))
    found = black_box(rest)
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
        assert result.ceiling.rmse_mm > 0.9 * result.rmse_mm
        assert result.ceiling.rmse_mm <= result.rmse_mm
