"""The model's own error is the validated one without the noise of its validation."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis import data_quality
from surgisoft.diagnosis.data_quality import thinning_notes
from surgisoft.diagnosis.residuals import (
    blocks,
    held_out_rows,
    model_discrepancy,
    problem_of,
    residual_table,
)
from surgisoft.errors import InputError
from surgisoft.measurement.histories import arm_spec, history_of
from surgisoft.measurement.noise import known_noise
from surgisoft.surrogate.fit import FitConfig, fit
from surgisoft.surrogate.model import Validation
from tests.diagnosis.synthetic import NOISE_MM, recording, resting_together, still_model, walk

VALIDATED = [0.5, 1.0, 2.0]


def validated_model(**more):
    model = still_model()
    model.validation = Validation(1.3, tuple(VALIDATED), 100, **more)
    return model


def test_noise_of_the_validation_is_taken_out_whatever_the_noise_is_now():
    now = np.full(3, 0.45)
    expected = np.sqrt(np.square(VALIDATED) - 3 * 0.2**2)
    found = model_discrepancy(validated_model(noise_mm=0.2), now)
    assert found == pytest.approx(expected)
    assert model_discrepancy(validated_model(), now) == pytest.approx(
        np.sqrt(np.square(VALIDATED) - 0.45**2)
    )


def test_some_of_the_validated_error_is_the_models_own():
    """Noise that is said to be all of the error or more leaves three tenths."""
    assert model_discrepancy(validated_model(noise_mm=3.0), np.zeros(3)) == pytest.approx(
        0.3 * np.array(VALIDATED)
    )


def test_a_louder_recording_does_not_make_the_model_better():
    pressure = walk(600)
    quiet, loud = (
        problem_of(
            validated_model(noise_mm=0.05),
            [recording(np.zeros(600), pressure, seed=seed, noise_mm=noise)],
        )
        for seed, noise in ((1, 0.05), (2, 0.5))
    )
    np.testing.assert_array_equal(quiet.discrepancy_mm, loud.discrepancy_mm)


def test_a_fit_keeps_the_noise_that_its_recordings_state_or_show_in_holds():
    pressure = resting_together(1200)
    stated, held = (
        recording(0.3 * pressure[:, 0], pressure, noise_mm=noise) for noise in (0.07, None)
    )
    assert known_noise([stated]) == pytest.approx(0.07)
    assert known_noise([held]) == pytest.approx(NOISE_MM, rel=0.15)
    quick = FitConfig(hidden=(8,), epochs=10, inputs="pressure")
    for one in (stated, held):
        found = fit(history_of([one]), None, arm_spec([one]), quick).model
        assert found.validation.noise_mm == pytest.approx(known_noise([one]))
    assert known_noise([recording(np.zeros(300), walk(300, seed=1)[:, :1], noise_mm=None)]) is None


def test_a_long_recording_is_cut_into_blocks_of_enough_fitted_rows():
    """An hour at 10 Hz, every 18th row fitted: blocks of 14.4 s with 8 of them, not of 5 s."""
    pressure = walk(36_000)
    problem = problem_of(validated_model(), [recording(np.zeros(36_000), pressure)])
    assert len(problem.block) == 2000
    assert np.bincount(problem.block).min() >= 7
    assert 240 <= problem.block.max() + 1 <= 250


def test_a_block_lies_in_one_run_and_runs_of_some_seconds_are_cut():
    """One run of 20 s and nine of 2 s at 10 Hz: stretches of 38 s / 20, none across two runs."""
    run = np.concatenate([np.zeros(200, int), np.repeat(np.arange(1, 10), 20)])
    history = history_of([recording(np.zeros(380), walk(380), run=run)])
    seen = np.ones(380, bool)
    seen[5] = False
    found = blocks(history, seen)
    assert found[5] == -1
    owners = [set(run[found == number]) for number in range(found.max() + 1)]
    assert all(len(owner) == 1 for owner in owners)
    assert owners[-9:] == [{number} for number in range(1, 10)], "short runs are whole"
    assert len(owners) == 9 + 11, "20 s in stretches of about 1.8 s"
    with pytest.raises(InputError, match="expected at least 30 of 8 rows: record more"):
        blocks(history, seen, least_blocks=30)


def test_a_paired_difference_has_a_discrepancy_and_a_tolerance_of_its_own():
    table = residual_table(validated_model(), [recording(np.zeros(600), walk(600))])
    plain = table.view()
    np.testing.assert_array_equal(plain.discrepancy_mm, plain.tolerance_mm)
    own, allowed = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.5, 0.6])
    paired = replace(table, paired_discrepancy_mm=own, paired_tolerance_mm=allowed).view()
    np.testing.assert_array_equal(paired.discrepancy_mm, own)
    np.testing.assert_array_equal(paired.tolerance_mm, allowed)


def test_the_last_quarter_is_held_out():
    """The last rows of a recording of few runs, the last runs of one of many; as a whole number."""
    few = recording(np.zeros(400), walk(400))
    expected = np.arange(400) >= 300
    assert held_out_rows([few]).tolist() == expected.tolist()
    many = replace(few, run=np.repeat(np.arange(40), 10))
    assert held_out_rows([many]).tolist() == expected.tolist()
    assert held_out_rows([few, many]).tolist() == [*expected, *expected]


def test_a_view_shows_the_rows_of_its_part_alone():
    """In the table, in its history and in the problem; missing key points stay missing."""
    pressure = walk(1200)
    made = recording(np.zeros(len(pressure)), pressure)
    table, held = residual_table(still_model(), [made]), held_out_rows([made])
    for part, shown in (("training", ~held), ("held_out", held)):
        only = table.only(part)
        seen = np.isfinite(only.measured_mm).all((1, 2))
        assert (seen == shown).all()
        inside = only.history.rows(only.history.key_points).isfinite().numpy().all((1, 2))
        assert (inside == shown).all()
        assert shown[table.view(part).index.numpy()].all()
    assert not held[table.training().index.numpy()].any()


def test_a_long_recording_is_thinned_and_the_note_says_so(monkeypatch):
    """8,000 rows, of which three quarters are training rows."""
    problem = problem_of(still_model(), [recording(np.zeros(8000), walk(8000))], part="training")
    assert thinning_notes(problem) == ()
    monkeypatch.setattr(data_quality, "LONG_ROWS", 6000)
    (note,) = thinning_notes(problem)
    assert note.startswith("6,000 rows are thinned: effects are fitted to 2,000 of them")


def test_predictions_that_are_no_numbers_are_refused_with_the_range_of_the_actuation():
    model = still_model()
    with torch.no_grad():
        next(model.network.parameters()).fill_(torch.nan)
    pressure = 1000.0 * walk(50)
    low, high = f"{pressure.min():.4g}", f"{pressure.max():.4g}"
    fitted = f"{min(model.spec.low):.4g} to {max(model.spec.high):.4g}"
    expected = f"from {low} to {high} {model.spec.unit}; it was fitted to {fitted}. Check the unit"
    with pytest.raises(InputError, match=re.escape(expected)):
        residual_table(model, [recording(np.zeros(50), pressure)])
