"""How well a model predicts recordings as they are, against errors that were put in."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.improve import next_effects
from surgisoft.diagnosis.residuals import ModelFit, fit_of_model
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import save_recording
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.model import Validation
from tests.diagnosis.setup.recordings import NOISE_MM, measured, predicted, with_points
from tests.diagnosis.synthetic import recording, still_model, walk
from tests.diagnosis.test_estimation import bare_arm, measured_on
from tests.few_effects import choose_among


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


def test_compare_says_that_a_model_does_not_describe_an_arm(model, tmp_path, capsys, monkeypatch):
    """What an error depends on says nothing where the model leaves most of the motion."""
    choose_among(monkeypatch, "gain_mismatch", "creep", "payload")
    whole = predicted(800)
    motion = fit_of_model(model, [whole]).motion_mm
    (own, _), (away, _) = (
        compare(model, [with_points(whole, whole.key_points_mm + shift)])
        for shift in (np.zeros(3), np.array([0.4 * motion, 0.0, 0.0]))
    )
    assert not own.of_another_arm
    assert "does not describe" not in own.sentence
    assert away.of_another_arm
    assert away.of_arm.motion_mm == pytest.approx(motion, rel=1e-3)
    assert f": the model does not describe this arm's motion of {motion:.2f} mm: check" in (
        away.sentence
    )
    assert "explainable" not in away.sentence
    assert "depends" not in away.sentence
    assert "or one effect changes most of the motion" in away.sentence
    assert not replace(away, setup="a wrong unit").of_another_arm
    shifted = with_points(whole, whole.key_points_mm + np.array([0.4 * motion, 0.0, 0.0]))
    since, _ = compare(model, [shifted], before=[whole])
    assert not since.of_another_arm, "it is the arm of the model, and has changed"
    save_recording(shifted, tmp_path / "away.parquet")
    assert run(["compare", "default", str(tmp_path / "away.parquet")]) == 0
    assert "next, whether one effect explains most of it: surgisoft diagnose" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("rmse_mm", "motion_mm", "fits"),
    [
        (1.4, 3.0, True),
        (1.6, 3.0, False),
        (3.4, 10.0, True),
        (3.6, 10.0, False),
        (9.0, 1.4, True),
        (9.0, 1.6, False),
    ],
)
def test_a_model_fits_with_35_percent_of_the_motion_or_with_half_more_than_its_error(
    rmse_mm, motion_mm, fits
):
    """An error of 1 mm is expected; below 1.5 mm of motion nothing shows."""
    assert ModelFit(rmse_mm, 1.0, motion_mm).fits is fits


def test_no_effect_is_named_that_leaves_most_of_the_motion():
    """Actuation that is eight times too large, which is no ratio of units: an effect explains most
    of an error of four times the motion, and the rest is still more than a third of the motion."""
    arm = bare_arm()
    right = measured_on(arm)
    wrong = replace(right, measured=8 * right.measured)
    motion_mm = fit_of_model(arm, [wrong]).motion_mm
    found = diagnose(arm, [wrong], setup_tests=False, refit="never")
    assert (found.verdict.kind, found.verdict.reason, found.verdict.effects) == (
        "cannot_tell",
        "arm",
        (),
    )
    assert max(found.probabilities.effects.values()) > 0.5, "one would have been named"
    best_mm = min(row.heldout_rmse_mm for row in found.ranking)
    assert 0.35 * motion_mm < best_mm < found.error_mm.before / 4
    assert "so the model does not describe this arm: check that MODEL" in found.verdict.sentence
    assert found.next_command == "surgisoft fit {data} -o NEW"
    assert next_effects(found) == (), "improve tries none either"


def test_the_expected_error_is_that_of_the_model_and_the_noise_together():
    model = still_model()
    model.validation = Validation(5.0, (3.0, 4.0, 5.0), 100, noise_mm=0.0)
    found = fit_of_model(model, [recording(np.zeros(400), walk(400), noise_mm=2.0)])
    assert found.expected_mm == pytest.approx(np.sqrt(3 * 2.0**2 + (9 + 16 + 25) / 3))


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
