"""What has changed since a reference, beside an error of the network that was there before."""

import numpy as np
import pytest
import torch

from surgisoft.cli import run
from surgisoft.diagnosis.cross_validation import FITTED
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.measurement.recordings import save_recording
from surgisoft.surrogate.checkpoint import save_model
from surgisoft.surrogate.model import Validation
from tests.diagnosis.synthetic import POINTS, recording, still_model, walk
from tests.diagnosis.test_cross_validation import cross_validated

ROWS = 3000


def unlearned(pressure):
    """(T,) mm: what the network never learned of the arm, a smooth function of the actuation."""
    a, b = pressure.T / 10
    return 2.0 * np.sin(2.5 * a) + 1.5 * np.cos(3.0 * b) * a


def measured(seed, shifted_mm=0.0, rows=ROWS):
    """The arm's recording; the whole of it moved sideways since, as a turned camera sees it."""
    pressure = walk(rows, seed=seed)
    points = POINTS + np.array([0.0, shifted_mm, 0.0])
    return recording(unlearned(pressure), pressure, points, seed=seed)


@pytest.fixture(scope="module")
def model():
    model = still_model()
    model.validation = Validation(1.5, (0.5, 1.0, 2.0), ROWS)
    return model


def test_what_was_there_before_is_not_named(model):
    found = diagnose(model, [measured(1)], reference=[measured(2)], setup_tests=False)
    assert found.verdict.effects == ()


def test_what_has_changed_is_named(model):
    """A shift of the size of the network's error, which may be its own without a reference."""
    now = measured(1, shifted_mm=1.0)
    alone = diagnose(model, [now], setup_tests=False)
    since = diagnose(model, [now], reference=[measured(2)], setup_tests=False)
    assert since.verdict.effects[0] == "misalignment"
    assert since.verdict.confidence > alone.probabilities.effects["misalignment"] + 0.1
    gain = {row.effect: row.gain_alone for row in since.ranking}["misalignment"]
    assert gain > 0.8


def test_a_reference_is_scaled_as_the_rows_in_question_are(model):
    """From -1 to 1 over the range of the actuation, 0 to 10; residuals in mm as measured."""
    before = recording(np.zeros(500), walk(500, seed=2), POINTS + 3.0, seed=2)
    problem = problem_of(model, [measured(1)]).with_reference([before])
    np.testing.assert_allclose(problem.reference.pressure, before.measured / 5 - 1, atol=1e-6)
    np.testing.assert_allclose(problem.reference.residual, before.key_points_mm - POINTS, atol=1e-4)
    np.testing.assert_array_equal(np.unique(problem.reference.direction), [-1, 1])


def test_rows_of_a_reference_are_fitted_and_not_judged():
    """Against the same rows put into every fold by hand."""
    rng = np.random.default_rng(0)
    features, columns = rng.normal(size=(90, 4)), rng.normal(size=(90, 1, 3, 2))
    residual = 0.5 * columns[..., 0] + rng.normal(size=(90, 1, 3))
    columns[60:] = 0.0
    block, size, noise = np.arange(90) // 6, np.ones(1), np.full(1, 0.1)
    fold = np.concatenate([np.arange(10) % 5, np.full(5, FITTED)])
    found = cross_validated(features, residual, columns[:60], block, fold, size, noise)
    assert found.losses((0,)).shape == (10,)
    np.testing.assert_array_equal(found.counts, np.full(10, 6))
    for number in range(5):
        # One split into two: the judged fold, and the rest with the reference.
        two = np.where(fold == number, 0, 1)
        one = cross_validated(features, residual, columns, block, two, size, noise)
        judged = fold == number
        np.testing.assert_allclose(found.grams[:, number], one.grams[:, 0], rtol=1e-5, atol=1e-4)
        for level in range(len(found.grams)):
            products = [each.held_out.among(np.arange(3), level) for each in (found, one)]
            np.testing.assert_allclose(
                products[0][..., judged[:10]], products[1][..., judged], rtol=1e-4, atol=1e-4
            )


def test_command_takes_a_reference(model, tmp_path, capsys):
    save_model(model, tmp_path / "arm")
    save_recording(measured(1, shifted_mm=1.0), tmp_path / "now.parquet")
    save_recording(measured(2), tmp_path / "before.parquet")
    now, before = str(tmp_path / "now.parquet"), str(tmp_path / "before.parquet")
    assert run(["diagnose", str(tmp_path / "arm"), now, "--reference", before]) == 0
    assert "misalignment is missing" in capsys.readouterr().out
    assert run(["diagnose", str(tmp_path / "arm"), now, "--reference", str(tmp_path / "no")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_fitted_model_keeps_where_it_is_off(tmp_path):
    """The rows kept are the fit's own: measured less what the loaded model predicts there."""
    from surgisoft.measurement.histories import arm_spec, history_of
    from surgisoft.surrogate.checkpoint import load_model, load_training_residuals
    from surgisoft.surrogate.fit import FitConfig, fit

    before = measured(2, rows=1000)
    result = fit(
        history_of([before]),
        None,
        arm_spec([before]),
        FitConfig(hidden=(8,), epochs=10, prior="none"),
    )
    save_model(result.model, tmp_path / "arm", known=result.known)
    known, model = load_training_residuals(tmp_path / "arm"), load_model(tmp_path / "arm")
    history = history_of([before])
    step = before.samples // len(known.residual_mm)
    np.testing.assert_array_equal(known.actuation, history.pressure[0, ::step])
    off = before.key_points_mm - model.predict(history)[0].numpy()
    np.testing.assert_allclose(known.residual_mm, off[::step], atol=1e-4)
    assert torch.equal(model.training_residuals.residual_mm, known.residual_mm)
    save_model(model, tmp_path / "again")
    assert torch.equal(load_training_residuals(tmp_path / "again").residual_mm, known.residual_mm)
    model.training_residuals = None
    save_model(model, tmp_path / "arm", force=True)
    assert load_training_residuals(tmp_path / "arm") is None


def test_damaged_training_residuals_are_reported(model, tmp_path, capsys):
    save_model(model, tmp_path / "arm")
    (tmp_path / "arm" / "known_error.safetensors").write_bytes(b"not this")
    save_recording(measured(1), tmp_path / "now.parquet")
    assert run(["diagnose", str(tmp_path / "arm"), str(tmp_path / "now.parquet")]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert "known_error" in error[0]
