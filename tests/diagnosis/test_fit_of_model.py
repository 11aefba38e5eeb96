"""How well a model predicts recordings as they are, against errors that were put in."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.residuals import fit_of_model
from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import default_arm
from tests.diagnosis.setup.recordings import NOISE_MM, measured, predicted, with_points


@pytest.fixture(scope="module")
def model():
    return default_arm()


def test_the_error_of_its_own_arm_is_the_noise(model):
    found = fit_of_model(model, [measured()])
    assert found.rmse_mm == pytest.approx(np.sqrt(3) * NOISE_MM, rel=0.02)
    assert found.expected_mm >= found.rmse_mm
    assert found.fits
    points = predicted().key_points_mm
    spread = np.sqrt(np.square(points - points.mean(0)).sum(2).mean())
    assert found.motion_mm == pytest.approx(spread, rel=0.02)


@pytest.mark.parametrize(("share", "fits"), [(0.3, True), (0.4, False), (3.0, False)])
def test_a_model_of_this_arm_predicts_most_of_its_motion(model, share, fits):
    whole = predicted()
    motion = fit_of_model(model, [whole]).motion_mm
    away = with_points(whole, whole.key_points_mm + np.array([share * motion, 0.0, 0.0]))
    found = fit_of_model(model, [away])
    assert found.rmse_mm == pytest.approx(share * motion, rel=1e-3)
    assert found.fits is fits


def test_an_arm_that_does_not_move_shows_nothing(model):
    resting = measured()
    still = replace(
        resting,
        measured=np.zeros_like(resting.measured),
        commanded=None,
        key_points_mm=np.broadcast_to(predicted().key_points_mm[:1], resting.key_points_mm.shape),
    )
    assert fit_of_model(model, [still]).fits


def test_nothing_measured_and_another_arm(model):
    lost = with_points(measured(), np.full_like(measured().key_points_mm, np.nan))
    assert fit_of_model(model, [lost]) is None
    other = replace(measured(), measured=measured().measured[:, :2], commanded=None)
    with pytest.raises(InputError, match="chambers: 2, but the model has 3"):
        fit_of_model(model, [other])
