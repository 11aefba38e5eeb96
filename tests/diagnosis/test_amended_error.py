"""What an amended model states of its own error, against predictions of the model itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.amend import Amendment, amend
from surgisoft.diagnosis.improve import improve
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training import validated_error
from tests.diagnosis.test_estimation import NOISE_MM, TRUTHS, bare_arm, measured_on
from tests.few_effects import choose_among

FLOOR_MM = np.sqrt(3.0) * NOISE_MM


def fitted_to(truth: ArmModel, arm: ArmModel | None = None, kind: str = "continuous") -> ArmModel:
    """The bare arm as if `truth`, which has an effect more, had been recorded for its fit."""
    arm = arm or bare_arm()
    of_fit, validation = (
        history_of([of(truth, seed, kind)], arm.spec.actuation) for seed in (7, 8)
    )
    arm.training_residuals = arm.residuals_on([of_fit])
    pair = (validation.rows(x) for x in (validation.key_points, arm.predict(validation)))
    arm.validation = replace(validated_error(*pair), noise_mm=NOISE_MM)
    return arm


def of(truth: ArmModel, seed: int, kind: str) -> Recording:
    """A recording of an arm whose runs begin away from rest; the commands are the pressures."""
    plain = replace(measured_on(truth, seed=seed), kind=kind)
    plain = replace(plain, commanded=plain.measured.copy())
    history = history_of([plain], truth.spec.actuation)
    with torch.no_grad():
        points = history.rows(truth.predict(history)).double().numpy()
    noise = np.random.default_rng(seed).normal(0.0, NOISE_MM, points.shape)
    return replace(plain, key_points_mm=points + noise)


@pytest.fixture(scope="module")
def amended() -> tuple[ArmModel, Amendment]:
    """An arm that was fitted to one that creeps, and its amendment."""
    arm = fitted_to(TRUTHS["creep"])
    recorded = measured_on(TRUTHS["creep"], seed=1)
    return arm, amend(arm, [recorded], "creep", refit="never")


@pytest.mark.parametrize("step", ["amend", "improve"])
def test_an_effect_that_the_fit_lacked_takes_its_part_of_the_stated_error_away(
    step, amended, monkeypatch
):
    truth = TRUTHS["creep"]
    arm, found = amended
    if step == "improve":
        choose_among(monkeypatch, "gain_mismatch", "creep", "payload")
        arm = fitted_to(truth)
    stated = arm.validation
    assert stated.rmse_mm > 3 * FLOOR_MM
    if step == "improve":
        found = improve(arm, [measured_on(truth, seed=1)], refit="never")
    error = found.model.validation
    # On the held-out rows the noise is left, and the model states no less.
    assert found.held_out.after == pytest.approx(FLOOR_MM, rel=0.03)
    assert found.held_out.after * 0.99 <= error.rmse_mm <= 1.1 * FLOOR_MM
    pairs = zip(error.per_key_point_mm, stated.per_key_point_mm, strict=True)
    assert all(now <= was for now, was in pairs)
    # Its residuals of the fit are those that it would have had there.
    direct = found.model.residuals_on([history_of([of(truth, 7, "continuous")])])
    kept = found.model.training_residuals
    assert torch.allclose(kept.residual_mm, direct.residual_mm, atol=2e-4)
    assert kept.actuation.equal(arm.training_residuals.actuation)
    # The given model stays as it is.
    assert arm.validation == stated
    assert arm.training_residuals.residual_mm.square().mean() > 2 * kept.residual_mm.square().mean()


@pytest.mark.parametrize(
    ("actuation", "kind"), [("commanded", "continuous"), ("measured", "settled")]
)
def test_runs_of_the_fit_begin_where_they_began(actuation, kind):
    """By commands as by measured pressures; steady-state points begin at rest."""
    arm, truth = bare_arm(), TRUTHS["creep"]
    spec = replace(arm.spec, actuation=actuation)
    arm, truth = arm.replace(spec=spec), truth.replace(spec=spec)
    arm = fitted_to(truth, arm, kind)
    found = amend(arm, [of(truth, 1, "continuous")], "creep", refit="never", retune_network=False)
    assert found.claimed
    direct = found.model.residuals_on([history_of([of(truth, 7, kind)], actuation)])
    kept = found.model.training_residuals
    assert torch.allclose(kept.residual_mm, direct.residual_mm, atol=2e-4)


def test_an_arm_that_changed_since_the_fit_leaves_the_stated_error_as_it_is():
    arm = fitted_to(bare_arm())
    changed = measured_on(TRUTHS["gain_mismatch"], seed=1)
    found = amend(arm, [changed], "gain_mismatch", refit="never")
    assert found.claimed
    assert found.model.validation == arm.validation
    assert found.model.training_residuals is arm.training_residuals


def test_no_key_point_states_less_than_its_error_on_the_held_out_rows():
    """The tip's marker sits 1 mm aside in the recording: the error of the tip stays that large."""
    truth = TRUTHS["creep"]
    arm = fitted_to(truth)
    recorded = measured_on(truth, seed=1)
    points = recorded.key_points_mm.copy()
    points[:, -1, 0] += 1.0
    moved = replace(recorded, key_points_mm=points)
    found = amend(arm, [moved], "creep", retune_network=False, refit="never")
    assert found.alone.claimed
    held = found.held_out.after
    tip = found.model.validation.per_key_point_mm[-1]
    assert tip == pytest.approx(1.0, rel=0.05)
    others = found.model.validation.per_key_point_mm[:-1]
    assert max(others) < 1.3 * FLOOR_MM
    assert held < tip


def test_without_the_actuation_before_its_rows_nothing_is_restated():
    arm, truth = fitted_to(TRUTHS["gain_mismatch"]), TRUTHS["gain_mismatch"]
    known = arm.training_residuals
    for past in (None, replace(known.past, stood=None)):
        arm.training_residuals = replace(known, past=past)
        found = amend(arm, [measured_on(truth, seed=1)], "gain_mismatch", refit="never")
        assert found.claimed
        assert found.model.validation.rmse_mm == arm.validation.rmse_mm


def test_what_is_restated_is_kept_in_the_folder(tmp_path, amended):
    found = amended[1]
    save_model(found.model, tmp_path / "arm", found.to_json())
    back = load_model(tmp_path / "arm")
    assert back.validation.rmse_mm == pytest.approx(found.model.validation.rmse_mm)
    assert back.training_residuals.residual_mm.equal(found.model.training_residuals.residual_mm)
