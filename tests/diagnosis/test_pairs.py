"""Before and after: pairs of rows with the same actuation, and what their difference says."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.cli import run
from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.design.next_experiment import likely_competing, next_experiment
from surgisoft.diagnosis.diagnose import (
    Diagnosis,
    ErrorLevels,
    Verdict,
    changed_since_fit,
    diagnose,
    lacking_before,
    since,
)
from surgisoft.diagnosis.known_error import known_error, rows_before, rows_of_fit
from surgisoft.diagnosis.pages import diagnosis as page
from surgisoft.diagnosis.pairs import (
    LEAST_ROWS,
    RepeatedShare,
    RunSignal,
    before_and_after,
    free_motion,
    matches,
    paired_discrepancy,
    repeated_share,
    rms_by_point,
    slope_error,
    without_noise,
)
from surgisoft.diagnosis.residuals import (
    LEAST_DISCREPANCY,
    Sealed,
    model_discrepancy,
    residual_table,
)
from surgisoft.errors import InputError
from surgisoft.measurement.histories import history_of, speed_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording, load_recording, save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.surrogate.model import Validation
from surgisoft.surrogate.training_residuals import Past
from tests.diagnosis.synthetic import NOISE_MM, PERIOD_S, POINTS, recording, still_model, walk
from tests.few_effects import choose_among

ROWS = 2400
SMOOTHNESS = 25
"""Rows over which the actuation of these tests is averaged: it has a slope everywhere."""


@pytest.fixture(autouse=True)
def few_effects(monkeypatch):
    """Diagnoses choose among six effects, to save time."""
    some = ("gain_mismatch", "line_lag", "creep", "rate_dependence", "payload", "misalignment")
    choose_among(monkeypatch, *some)


@pytest.fixture(scope="module")
def model():
    model = still_model()
    model.validation = Validation(1.5, (0.5, 1.0, 2.0), ROWS)
    return model


def smooth_walk(seed):
    """Function of time (T,) s -> (T, 2) actuation in 0 to 10 without corners."""
    knots = walk(ROWS + 200, seed=seed)
    kernel = np.ones(SMOOTHNESS) / SMOOTHNESS
    smooth = np.stack([np.convolve(column, kernel, "same") for column in knots.T], 1)
    time = PERIOD_S * np.arange(len(smooth))
    return lambda t: np.stack([np.interp(t, time, column) for column in smooth.T], 1)


def unlearned(pressure):
    """(T,) mm: what the network never learned, ten times the size of what changes."""
    a, b = pressure.T / 10
    return 8.0 * np.sin(2.5 * a) + 6.0 * np.cos(3.0 * b) * a


def walk_of_time(t_s):
    """A motion of its own, as a function of time (T,) s."""
    return smooth_walk(20)(t_s)


def made(motion, start_s, rows=ROWS, seed=1, actuation_noise=0.0, change=None, name="made"):
    """A recording of a motion from some time on, its clock beginning at 0."""
    pressure = motion(start_s + PERIOD_S * np.arange(rows))
    effect = unlearned(pressure) + (0.0 if change is None else change(pressure))
    noisy = pressure + np.random.default_rng(seed).normal(0, actuation_noise, pressure.shape)
    return replace(recording(effect, noisy, seed=seed), name=name)


def paired(model, after, before, how="auto"):
    return before_and_after(residual_table(model, [after]), [before], how)


# Alignment -----------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize(("after_s", "before_s"), [(6.0, 2.53), (1.0, 8.37)])
def test_delay_is_found_to_a_fraction_of_a_sample(model, after_s, before_s, noise):
    """The two clocks begin at different times of one motion, apart by no multiple of a sample."""
    motion = smooth_walk(3)
    both = paired(
        model, made(motion, after_s, actuation_noise=noise),
        made(motion, before_s, seed=2, rows=ROWS - 300, actuation_noise=noise),
    )  # fmt: skip
    (stretch,) = both.pairs.stretches
    assert stretch.delay_s == pytest.approx(after_s - before_s, abs=0.05 * PERIOD_S)
    overlap = min(ROWS, ROWS - 300 + (before_s - after_s) / PERIOD_S)
    overlap -= max(0.0, (before_s - after_s) / PERIOD_S)
    assert stretch.rows == pytest.approx(overlap, abs=30)


def test_partner_is_the_measurement_at_the_matching_instant(model):
    """Without noise and network, the partner of a row is BEFORE between its two nearest rows."""
    motion = smooth_walk(4)
    still = np.zeros((ROWS, 3, 3))
    after, before = (replace(made(motion, s), key_points_mm=still.copy()) for s in (3, 1.03))
    before.key_points_mm[:, -1, 0] = before.t_s
    pairs = paired(model, after, before).pairs
    there = pairs.paired
    assert there.sum() > ROWS - 100
    expected = after.t_s[there] + 1.97
    np.testing.assert_allclose(pairs.partner_t_s[there], expected, atol=0.01)
    np.testing.assert_allclose(pairs.before_mm[there][:, -1, 0], expected, atol=0.01)


@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_the_noise_of_a_pair_is_that_of_the_measured_difference(model, apart):
    """A partner between two samples is a mean of both, with half of the variance in the middle."""
    motion = smooth_walk(3)
    pairs = paired(model, made(motion, 2.0), made(motion, 1.0 - apart * PERIOD_S, seed=2)).pairs
    change = pairs.change_mm[pairs.paired]
    measured = np.sqrt(np.mean(np.square(change - change.mean(0)).sum(2), axis=0))
    np.testing.assert_allclose(pairs.noise_mm, measured, rtol=0.05)


def test_only_the_common_part_is_paired(model):
    """AFTER follows the motion of BEFORE for its second half only."""
    one, other = smooth_walk(5), smooth_walk(6)
    begin, rest = other(PERIOD_S * np.arange(ROWS // 2)), one(PERIOD_S * np.arange(ROWS // 2))
    mixed = np.concatenate([begin, rest])
    after = recording(unlearned(mixed), mixed)
    pairs = paired(model, after, made(one, 0.0, seed=2), "auto").pairs
    assert pairs.paired[: ROWS // 2].mean() < 0.05
    # The past has to agree too, for 2 s.
    assert not pairs.paired[ROWS // 2 : ROWS // 2 + 10].any()
    assert pairs.paired[ROWS // 2 + 30 :].mean() > 0.95
    assert pairs.stretches[0].delay_s == pytest.approx(-PERIOD_S * (ROWS // 2), abs=0.1)


def test_rows_are_paired_where_the_actuation_agrees_now_and_over_the_past():
    """One row off by three times what counts as the same, later thirty rows by one and a half.

    The one row is too few for the past of 2 s, 41 rows, and too far off itself. The thirty rows are
    near enough each, and the mean square of the past exceeds 1 from 19 of them on until fewer than
    19 are in it.
    """
    alike, t_s = np.array([0.02]), 0.05 * np.arange(1200)
    wave = 0.3 * np.sin(0.7 * t_s) + 0.1 * np.sin(2.3 * t_s + 1.0)
    off = np.zeros(1200)
    off[600] = 3.0 * alike[0]
    off[800:830] = 1.5 * alike[0]
    rows = np.arange(1200)
    before, after = (
        RunSignal(0, name, rows, t_s, values[:, None])
        for name, values in (("before", wave), ("after", wave + off))
    )
    (match,) = matches(after, before, alike)
    assert match.delay_s == pytest.approx(0.0, abs=0.02)
    inner = np.arange(5, 1195)  # the delay is known to a fraction of a sample
    left_out = inner[~match.inside[inner]]
    assert left_out[0] == 600
    assert left_out[1] == pytest.approx(818, abs=3)
    assert left_out[-1] == pytest.approx(851, abs=3)
    assert len(left_out) == pytest.approx(35, abs=5)


@pytest.mark.parametrize("differs", ["measured", "commanded"])
def test_rows_are_paired_by_the_commands_or_by_what_was_measured(model, differs):
    """Sensors that read a fifth more, or commands of another motion, do not part recordings."""
    motion = smooth_walk(3)
    after, before = (
        replace(each, commanded=each.measured.copy())
        for each in (made(motion, 1.0), made(motion, 0.0, seed=2))
    )
    other = {"measured": 1.2 * after.measured, "commanded": smooth_walk(7)(after.t_s)}
    after = replace(after, **{differs: other[differs]})
    assert paired(model, after, before).pairs.paired.mean() > 0.9


def test_the_share_that_is_paired_is_that_of_the_training_rows(model):
    """BEFORE ends where the held-out rows of AFTER begin."""
    motion = smooth_walk(3)
    change = paired(model, made(motion, 0.0), made(motion, 0.0, rows=3 * ROWS // 4, seed=2)).change
    assert change.paired_share > 0.97


def test_the_error_of_slopes_by_hand(model):
    """For three chambers 2.055 times the error over the motion; all of it where nothing moves."""
    arm, rig = default_arm(), VirtualRig(0)
    table = residual_table(arm, [rig.record(make_protocol("mixed", rig.limits, 600, seed=1))[0]])
    motion = table.predicted_mm - table.predicted_mm.mean(axis=0)
    error, moved = (
        np.sqrt(np.mean(each))
        for each in (model_discrepancy(arm, table.noise_mm) ** 2, np.square(motion).sum(2))
    )
    assert slope_error(table) == pytest.approx(2.0554 * error / moved, rel=1e-3)
    assert slope_error(table) < 0.5
    still = residual_table(model, [made(smooth_walk(3), 0.0, rows=600)])
    assert slope_error(still) == 1.0


def test_a_noise_that_is_stated_too_large_does_not_make_repeats_perfect(model):
    """Repeats that differ by a tenth of the stated noise: half of it is what is taken."""
    once = smooth_walk(3)(PERIOD_S * np.arange(ROWS // 2))
    twice = np.concatenate([once, once])
    before = replace(recording(unlearned(twice), twice, seed=2), noise_mm=10.0 * NOISE_MM)
    pairs = paired(model, made(smooth_walk(3), 0.0, rows=ROWS // 2), before).pairs
    assert pairs.source == "repeats"
    np.testing.assert_allclose(pairs.repeatability_mm, 0.5 * pairs.earlier.noise_mm)


def test_what_was_wrong_before_is_not_extrapolated(model):
    """BEFORE covers the lower half of the range, where the error is up to so large."""
    half = made(lambda t_s: 0.5 * smooth_walk(3)(t_s), 0.0)
    whole = made(smooth_walk(8), 0.0, seed=2)
    before = residual_table(model, [half])
    found = known_error(residual_table(model, [whole]), rows_before(before))
    assert found.ratio < 0.5
    left, error = (np.sqrt(np.mean(x**2)) for x in (found.reference.residual, before.residual_mm))
    assert found.ratio == pytest.approx(left / error, rel=0.05), "of what fits without the row left"
    assert np.abs(found.correction_mm).max() < 1.08 * np.abs(before.residual_mm).max()


def test_a_row_has_one_partner_in_a_run():
    """A motion that repeats itself every 10 s, in a part of BEFORE at another delay only."""
    t_s, rows = 0.05 * np.arange(1600), np.arange(1600)
    wave = 0.3 * np.sin(2.0 * np.pi * t_s / 10.0)[:, None]
    other = wave.copy()
    other[600:1000] = 0.3 * np.sin(2.0 * np.pi * t_s[600:1000, None] / 3.0)
    before, after = (
        RunSignal(0, name, rows, t_s, values)
        for name, values in (("before", other), ("after", wave))
    )
    found = matches(after, before, np.array([0.02]))
    assert len(found) > 1
    assert np.sum([match.inside for match in found], axis=0).max() == 1


def test_repeated_runs_of_before_are_averaged_and_show_its_repeatability(model):
    """Each recording has a shift of its own, of 0.3 mm RMS in each coordinate of the tip."""
    motion, rng = smooth_walk(7), np.random.default_rng(0)
    shifts = rng.normal(0, 0.3, (5, 3))
    takes = []
    for seed, shift in enumerate(shifts):
        take = made(motion, 0.0, seed=seed, name=f"take{seed}")
        take.key_points_mm[:, -1] += shift
        takes.append(take)
    table = residual_table(model, takes[:1])
    alone = before_and_after(table, takes[1:2]).pairs
    several = before_and_after(table, takes[1:]).pairs
    assert (alone.source, several.source) == ("noise", "repeats")
    assert set(several.partners) == {4}
    pooled = np.sqrt(np.square(shifts[1:] - shifts[1:].mean(0)).sum() / 3 + 3 * NOISE_MM**2)
    assert several.repeatability_mm[-1] == pytest.approx(pooled, rel=0.1)
    assert several.repeatability_mm[0] == pytest.approx(np.sqrt(3) * NOISE_MM, rel=0.1)
    # One recording less the mean of four: 5 / 4 of its variance.
    every = np.ones(len(several.partners), bool)
    unchanged = several.unchanged_mm(every)
    assert unchanged == pytest.approx(np.sqrt(1.25) * several.repeatability_mm)


@pytest.mark.parametrize(("repeat", "apart"), [(0.5, 0.0), (0.0, 0.5), (0.5, 0.5)])
def test_an_unchanged_arm_whose_samples_lie_between_those_before_is_unchanged(model, repeat, apart):
    """White noise alone, whatever part of a sample repeats of BEFORE and AFTER are shifted by."""
    motion = smooth_walk(7)
    before = [
        made(motion, 1.0 - shift * PERIOD_S, seed=k, name=f"take{k}")
        for k, shift in ((2, 0.0), (3, repeat))
    ]
    after = made(motion, 2.0 - apart * PERIOD_S)
    both = before_and_after(residual_table(model, [after]), before)
    assert both.change.repeatability_source == "repeats"
    assert both.pairs.repeatability_mm == pytest.approx(np.sqrt(3) * NOISE_MM, rel=0.05)
    assert both.change.change_mm == pytest.approx(both.change.unchanged_mm, rel=0.06)
    assert both.pairs.discrepancy_mm.max() < 0.5 * both.pairs.noise_mm.min()


def test_the_change_of_an_unchanged_arm_is_the_one_that_is_printed_beside_it(model):
    """A second recording of the same motion with the same noise, and nothing else."""
    motion = smooth_walk(7)
    before, after = (made(motion, 0.0, seed=seed, name=f"take{seed}") for seed in (0, 1))
    change = before_and_after(residual_table(model, [after]), [before]).change
    assert change.repeatability_source == "noise"
    assert change.unchanged_mm == pytest.approx(np.sqrt(2) * change.repeatability_mm)
    assert change.change_mm == pytest.approx(change.unchanged_mm, rel=0.05)
    printed = f"change {change.change_mm:.3g} mm, expected of an unchanged arm "
    assert f"{printed}{change.unchanged_mm:.3g} mm (from noise)" in change.sentence
    assert change.to_json()["unchanged_mm"] == change.unchanged_mm


def test_more_noise_after_is_told_beside_what_an_unchanged_arm_would_show(model):
    """BEFORE is repeated, and cameras scatter four times as much after it."""
    motion = smooth_walk(7)
    *before, after = (made(motion, 0.0, seed=seed, name=f"take{seed}") for seed in (0, 1, 2))
    noise = np.random.default_rng(9).normal(0.0, NOISE_MM, after.key_points_mm.shape)
    louder = replace(
        after,
        key_points_mm=after.key_points_mm + np.sqrt(15) * noise,
        noise_mm=4 * NOISE_MM,
    )
    change, same = (
        before_and_after(residual_table(model, [each]), before).change for each in (louder, after)
    )
    one_mm = np.sqrt(3) * NOISE_MM
    assert change.unchanged_mm == pytest.approx(np.sqrt(16 + 1 / 2) * one_mm, rel=0.05)
    said = f"(from repeats and noise, which is {4 * one_mm:.3g} mm in these recordings and "
    assert f"{said}{one_mm:.3g} mm in those before)" in change.sentence
    assert "(from repeats)" in same.sentence


def test_noise_of_a_measured_actuation_is_no_change(model):
    """A network with a slope turns the sensor's noise into motion that no arm made."""
    steep = copy.deepcopy(default_arm())
    rng = np.random.default_rng(0)
    low, high = np.array(steep.spec.low), np.array(steep.spec.high)
    signal = low + (high - low) * smooth_walk(8)(PERIOD_S * np.arange(ROWS))[:, [0, 1, 0]] / 10
    points = np.tile(steep.rest_mm.numpy(), (ROWS, 1, 1))

    def take():
        return Recording(
            "take", PERIOD_S * np.arange(ROWS), signal + rng.normal(0, 0.5, signal.shape), points
        )

    pairs = paired(steep, take(), take()).pairs
    fast = np.diff(pairs.change_mm[pairs.paired], axis=0)
    table = residual_table(steep, [take()])
    raw = np.diff(table.predicted_mm, axis=0)
    assert np.nanstd(fast) < 0.35 * raw.std()


def test_a_difference_of_the_actuation_is_corrected_by_the_model():
    """Both recordings are the model's own motion; one chamber has 0.3 kPa more in AFTER.

    Half of what the sensors show besides, from sample to sample, is real.
    """
    arm, rig = default_arm(), VirtualRig(0)
    base = rig.record(make_protocol("mixed", rig.limits, 1200, seed=1))[0]
    t_s = PERIOD_S * np.arange(1200)
    pace = np.array([0.7, 1.1, 1.9])
    waves = 20.0 + 15.0 * np.sin(pace * t_s[:, None]) * np.cos(0.31 * pace * t_s[:, None])

    noise = np.random.default_rng(0).normal(0.0, 0.02, waves.shape)

    def own(more_kPa, real, name):
        asked = waves + np.array([more_kPa, 0.0, 0.0])
        moved = replace(
            base, name=name, t_s=t_s, run=np.zeros(1200, int), measured=asked, commanded=asked
        )
        history = history_of([replace(moved, measured=asked + real * noise)])
        with torch.inference_mode():
            points = history.rows(arm.predict(history)).double().numpy()
        return replace(moved, measured=asked + (real > 0.0) * noise, key_points_mm=points)

    before, after = own(0.0, 0.0, "before"), own(0.3, 0.5, "after")
    pairs = before_and_after(residual_table(arm, [after]), [before]).pairs
    there = pairs.paired
    assert there.mean() > 0.9
    moved = rms_by_point(after.key_points_mm[there] - before.key_points_mm[there])[-1]
    assert moved > 0.1
    assert rms_by_point(pairs.correction_mm[there])[-1] == pytest.approx(moved, rel=0.05)
    assert rms_by_point(pairs.change_mm[there])[-1] < 0.1 * moved

    # Nothing that is estimated for the training rows follows from the held-out ones.
    held = pairs.after.held_out
    shaken = after.key_points_mm.copy()
    shaken[held] += 3.0 * np.sin(2.1 * np.arange(held.sum()))[:, None, None]
    table = residual_table(arm, [replace(after, key_points_mm=shaken)])
    other = before_and_after(table, [before]).pairs
    np.testing.assert_array_equal(other.correction_mm[~held], pairs.correction_mm[~held])
    for name in ("free_mm", "noise_mm", "discrepancy_mm", "tolerance_mm"):
        np.testing.assert_array_equal(getattr(other, name), getattr(pairs, name), err_msg=name)


def test_the_systematic_error_of_a_pair_by_hand():
    """Twice the slow variance of one recording, and a tenth of the correction."""
    correction = np.zeros((10, 2, 3))
    correction[:, 1, 0] = 2.0
    found = paired_discrepancy(np.array([0.3, 0.4]), correction, np.zeros(2), 0.1)
    np.testing.assert_allclose(found, [np.sqrt(0.18), np.sqrt(0.32 + 0.04)])
    quiet = paired_discrepancy(np.zeros(2), correction, np.array([1.0, 2.0]), 0.0)
    np.testing.assert_allclose(quiet, LEAST_DISCREPANCY * np.array([1.0, 2.0]))


def white(rows, *seeds):
    """(rows, n, 3) sums of white noise by seed, about the key points at rest."""
    shape = rows, *POINTS.shape
    return POINTS + sum(np.random.default_rng(seed).normal(0, 1.0, shape) for seed in seeds)


def table_of(model, key_points_mm):
    rows = len(key_points_mm)
    still = recording(np.zeros(rows), walk(rows))
    return residual_table(model, [replace(still, key_points_mm=key_points_mm)])


def test_motion_is_repeated_by_the_root_of_its_coherence(model):
    """Half of the power of both is common: share 0.5 (coherence 1/4). A filtered motion: 1."""
    rows = 6000
    after = table_of(model, white(rows, 1, 2))
    fast = slice(2, None)
    half = repeated_share(after, white(rows, 1, 3))
    assert half.share[fast].mean() == pytest.approx(0.5, abs=0.03)
    np.testing.assert_array_equal(half.share[:2], 1.0)
    np.testing.assert_allclose(half.frequency_Hz[:3], [0.0, 0.3125, 0.625])
    assert repeated_share(after, 0.5 * white(rows, 1, 2)).share.min() > 1.0 - 1e-6
    np.testing.assert_allclose(half.at(np.array([0.0, 0.3])), 1.0)


def test_few_stretches_of_what_is_not_repeated_show_no_coherence_by_chance(model):
    """Of 8 stretches of noise the plain estimate finds a squared coherence of 1/8 or more.

    The held-out quarter, which is large and the same in both here, is not looked at. Of 3 stretches
    none of the fast motion counts.
    """
    rows = 200
    after, before = white(rows, 1), white(rows, 2)
    before[150:] = after[150:] = POINTS + 10.0 * (after[150:] - POINTS)
    found = repeated_share(table_of(model, after), before)
    assert len(found.frequency_Hz) == 17
    assert np.mean(found.share[2:] ** 2) < 0.06
    few = repeated_share(table_of(model, white(80, 1)), white(80, 1))
    np.testing.assert_array_equal(few.at(np.array([0.0, 0.2, 0.4])), 1.0)
    np.testing.assert_array_equal(few.at(np.array([0.41, 1.0, 5.0])), 0.0)


def test_a_motion_is_taken_as_far_as_it_is_repeated(model):
    """Two cosines with a whole number of half waves in the run: one stays, one is halved."""
    half = RepeatedShare(np.array([0.0, 1.0, 2.0]), np.array([[1.0], [1.0], [0.5]]))
    t = (np.arange(200) + 0.5) * 0.05
    slow, fast = np.cos(2 * np.pi * 0.5 * t), np.cos(2 * np.pi * 3.0 * t)
    motion = (2.0 + slow + fast)[:, None, None] * np.ones((1, 1, 3))
    expected = (2.0 + slow + 0.5 * fast)[:, None, None] * np.ones((1, 1, 3))
    np.testing.assert_allclose(half.of(motion, 0.05), expected, atol=1e-9)
    # A ramp ends where it ends, and not where it began.
    ramp = np.linspace(0.0, 10.0, 200)[:, None, None] * np.ones((1, 1, 3))
    assert abs(half.of(ramp, 0.05)[-1] - 10.0).max() < 0.2


def test_motion_is_free_where_either_recording_has_more_than_the_model_predicts(model):
    """A swing of 1 mm at 2 Hz in one of both, of which nothing comes again, over the model's own.

    Its power is 100 times the predicted one, or 3 times, which a change of the arm may make of it.
    """
    rows, t_s = 1600, 0.1 * np.arange(1600)
    swing = np.zeros((rows, 3, 3))
    swing[:, -1, 0] = np.sin(2.0 * np.pi * 2.0 * t_s)
    apart = RepeatedShare(np.array([0.0, 5.0]), np.zeros((2, 3)))
    for of_predicted, free in ((0.1, np.sqrt(0.5)), (1.0 / np.sqrt(3.0), 0.0)):
        predicted = POINTS + of_predicted * swing
        table = replace(table_of(model, POINTS + swing), predicted_mm=predicted)
        before = table_of(model, predicted)
        found = free_motion(table, before.measured_mm, predicted, swing, apart)
        assert found == pytest.approx([0.0, 0.0, free], abs=0.02)
        quiet = replace(table_of(model, predicted), predicted_mm=predicted)
        found = free_motion(quiet, POINTS + swing, predicted, swing, apart)
        assert found == pytest.approx([0.0, 0.0, free], abs=0.02)
        again = replace(apart, share=np.ones((2, 3)))
        assert free_motion(quiet, POINTS + swing, predicted, swing, again) == pytest.approx(0.0)


def test_the_fast_part_of_a_correction_counts_as_far_as_the_arm_followed_it(model):
    """Half of it: then half of what differs from the mean over 2 s is taken off."""
    rows, rng = 1200, np.random.default_rng(0)
    table = table_of(model, white(rows, 1))
    slow = np.sin(2.0 * np.pi * np.arange(rows) / 1200.0)[:, None, None] * np.ones((1, 3, 3))
    fast = rng.normal(0, 1.0, (rows, 3, 3))
    followed = slow + 0.5 * fast + rng.normal(0, 0.2, fast.shape)
    found = without_noise(table, followed, slow + fast)
    mean = np.stack([np.convolve(x, np.ones(21) / 21, "same") for x in fast.reshape(rows, -1).T], 1)
    inner = slice(20, -20)
    expected = (slow + 0.5 * (fast + mean.reshape(fast.shape)))[inner]
    assert np.sqrt(np.mean((found[inner] - expected) ** 2)) < 0.05
    still = without_noise(table, slow, slow + fast)
    assert np.std((still - slow)[inner]) < 0.25, "noise of the sensors moves no arm"


def test_a_final_check_needs_partners_of_half_of_the_held_out_rows(model):
    """40 % of them, 240 rows, have one; where pairs are asked for, as many as a fit takes do."""
    motion, other, end = smooth_walk(3), smooth_walk(11), 0.85 * ROWS * PERIOD_S

    def turning_off(t_s):
        return np.where((t_s < end)[:, None], motion(t_s), other(t_s))

    table = residual_table(model, [made(turning_off, 0.0)])
    before = [made(motion, 0.0, seed=2, name="earlier")]
    both = before_and_after(table, before)
    assert both.used
    assert 0.35 < both.pairs.paired[table.held_out].mean() < 0.45
    checked = both.with_final_check()
    assert (checked.used, checked.unchecked) == (False, True)
    assert before_and_after(table, before, "always").with_final_check().used


def test_held_out_rows_do_not_make_pairs_enough(model):
    """40 % of the training rows have a partner, and all of the held-out ones: 55 % of all rows."""
    motion, other, begin = smooth_walk(3), smooth_walk(11), 0.45 * ROWS * PERIOD_S

    def turning_on(t_s):
        return np.where((t_s < begin)[:, None], other(t_s), motion(t_s))

    table = residual_table(model, [made(turning_on, 0.0)])
    both = before_and_after(table, [made(motion, 0.0, seed=2, name="earlier")])
    assert both.pairs.paired.mean() > 0.5
    assert 0.3 < both.pairs.paired[~table.held_out].mean() < 0.45
    assert not both.used


def test_a_minute_of_pairs_is_a_minute_and_not_sixty_rows(model):
    """Half a minute of one of three recordings repeats BEFORE: 300 rows, of which 225 train."""
    motion, rows = smooth_walk(3), round(30.0 / PERIOD_S)
    before = made(motion, 0.0, rows=rows, seed=9, name="earlier")
    after = [made(smooth_walk(10 + k), 0.0, rows=rows, seed=k, name=f"new{k}") for k in (1, 2)]
    table = residual_table(model, [made(motion, 0.0, rows=rows), *after])
    paired_rows = before_and_after(table, [before]).pairs.paired[~table.held_out].sum()
    assert 160 <= paired_rows <= 225
    with pytest.raises(InputError, match="expected half of them, or 60 s"):
        before_and_after(table, [before], "always")


def test_the_mismatch_of_a_change_is_a_mean_over_rows(model):
    """A long recording repeats BEFORE exactly, a short one with another sensor's noise."""
    motion = smooth_walk(3)
    noisy = made(motion, 0.0, rows=400, seed=4, actuation_noise=0.05, name="noisy")
    table = residual_table(model, [made(motion, 0.0), noisy])
    change = before_and_after(table, [made(motion, 0.0, seed=2, name="earlier")]).change
    rows, mismatch = np.array([(each.rows, each.mismatch) for each in change.stretches]).T
    assert len(rows) == 2
    assert change.mismatch == pytest.approx(np.sqrt((rows @ mismatch**2) / rows.sum()))
    assert change.mismatch < 0.7 * np.sqrt(np.mean(mismatch**2))


def test_a_run_at_rest_is_paired_beside_those_that_move(model):
    """It fits at every delay; the other runs of the two recordings say at which."""
    motion = smooth_walk(15)

    def take(start_s, seed):
        moving, still = made(motion, start_s, seed=seed), made(lambda t: motion(0 * t), 0.0, 300)
        run = np.repeat([0, 1], [ROWS, 300])
        both = {n: np.concatenate([getattr(moving, n), getattr(still, n)])
                for n in ("measured", "key_points_mm")}  # fmt: skip
        return replace(moving, t_s=PERIOD_S * np.arange(ROWS + 300), run=run, **both)

    pairs = paired(model, take(0.0, 1), take(1.5, 2)).pairs
    # Of 30 s, 1.5 s have no counterpart, and of the next 2 s the past is not known.
    assert pairs.paired[ROWS:].mean() == pytest.approx(1 - 3.5 / 30, abs=0.02)
    delay = np.diff([pairs.partner_t_s, PERIOD_S * np.arange(ROWS + 300)], axis=0)[0]
    np.testing.assert_allclose(delay[pairs.paired], 1.5, atol=0.01)


# Diagnosis -----------------------------------------------------------------------------------


def test_the_same_again_has_nothing_missing(model):
    motion = smooth_walk(9)
    found = diagnose(model, [made(motion, 2.0)], before=[made(motion, 0.37, seed=2)])
    assert found.verdict.kind == "nothing_missing"
    assert found.error_mm.before == pytest.approx(np.sqrt(3 * (1 + 2 / 3)) * NOISE_MM, rel=0.25)
    assert found.change.paired_share > 0.95
    assert "since made" in found.verdict.sentence


def bent_arm():
    """The package's arm with a network that is off by several times what a payload changes."""
    model = copy.deepcopy(default_arm())
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, value in model.network.layers.named_parameters():
            if name.endswith("weight"):
                value.add_(0.35 * value.std() * torch.randn(value.shape, generator=generator))
    model.training_residuals = None
    return model


@pytest.fixture(scope="module")
def rig_takes():
    """(before, after): the same protocol without and with a payload, other noise, later start."""
    takes = []
    for take, hidden in ((1, ()), (2, (("payload", 1.5),))):
        rig = VirtualRig(0, take=take, hidden=hidden)
        takes.append(rig.record(make_protocol("mixed", rig.limits, 1000, seed=5))[0])
    before, after = takes
    columns = ("measured", "key_points_mm", "commanded", "run", "temp_C")
    cut = {name: getattr(after, name)[50:] for name in columns}
    later = replace(after, name="after", t_s=after.t_s[50:] - after.t_s[50], **cut)
    return replace(before, name="before"), later


def test_payload_is_named_behind_a_wrong_network(rig_takes):
    before, after = rig_takes
    model = bent_arm()
    table = residual_table(model, [before])
    wrong = float(np.sqrt(np.nanmean(np.square(table.error_mm))))
    model.validation = Validation(wrong, (wrong,) * model.spec.key_points, 100)
    found = diagnose(model, [after], before=[before], setup_tests=False)
    assert wrong > 2 * found.change.change_mm
    assert found.verdict.effects[0] == "payload"
    assert found.verdict.kind in ("identified", "ambiguous")
    assert found.change.paired_share > 0.9
    assert found.track.explained_mm.shape == found.track.change_mm.shape
    left = found.track.change_mm - found.track.explained_mm
    assert np.nanstd(left) < 0.6 * np.nanstd(found.track.change_mm)
    alone = replace(found, verdict=replace(found.verdict, kind="identified", effects=("payload",)))
    assert drawn(alone) == (
        ["noise floor", "no effect (discrepancy alone)", "size of the change"],
        "change explained by payload",
    )
    either = replace(found.verdict, kind="ambiguous", effects=("payload", "misalignment"))
    label = "change explained by payload alone (or else by misalignment)"
    assert drawn(replace(found, verdict=either))[1] == label
    plain = replace(found, track=None)
    assert drawn(plain)[0][-1] == "error of the model"
    result = amend(model, [after], "payload", before=[before], retune_network=False)
    assert result.claimed
    assert result.held_out.after < 0.6 * result.held_out.before
    assert result.model_error.before > 1.5 * result.held_out.before


def test_the_next_experiment_is_about_what_has_changed(rig_takes, tmp_path, capsys):
    """Behind a wrong network the change alone says which effects compete."""
    before, after = rig_takes
    model = bent_arm()
    both = before_and_after(residual_table(model, [after]), [before])
    changed = likely_competing(both.training())
    assert "payload" in changed
    save_model(model, tmp_path / "arm")
    for each in rig_takes:
        save_recording(each, tmp_path / f"{each.name}.parquet")
    arm, data, earlier = (str(tmp_path / n) for n in ("arm", "after.parquet", "before.parquet"))
    plan = ["next-experiment", arm, data, "--before", earlier, "--minutes", "6", "--as-it-stands"]
    out, numbers = tmp_path / "plan.csv", tmp_path / "plan.json"
    assert run([*plan, "-o", str(out), "--json", str(numbers)]) == 0
    then = f"then: surgisoft diagnose {arm} {data} NEW.parquet --before {earlier}"
    assert f"{then} --paired never\n" in capsys.readouterr().out
    pairs = json.loads(numbers.read_text())["pairs"]
    assert {name for pair in pairs for name in pair["effects"]} == set(changed)
    between = ["--between", "payload", "misalignment", "-o", str(out), "--force"]
    assert run([*plan, "--paired", "never", *between]) == 0
    assert f"{then}\n" in capsys.readouterr().out
    alone = ["next-experiment", arm, "--before", earlier, "-o", str(out), "--force"]
    assert run(alone) == 2
    assert "without those after it" in capsys.readouterr().err


def drawn(found) -> tuple[list[str], str]:
    """Labels of the lines in the chart of the effects, and of what is explained of the change."""
    figures = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "chart", lambda figure, *_: figures.append(figure))
        page.effects_chart(found)
        if found.track is not None:
            page.change_chart(found.track, page.explained_by(found))
    marks = {
        line.get_label(): line.get_xdata()[0]
        for line in figures[0].axes[0].lines
        if not line.get_label().startswith("_")
    }
    assert list(marks.values()) == [
        found.error_mm.floor, found.error_mm.discrepancy_alone, found.error_mm.before,
    ]  # fmt: skip
    return list(marks), figures[-1].axes[-1].lines[-1].get_label()


def test_alternatives_are_not_drawn_as_if_they_acted_at_once():
    """The explained change of an ambiguous result is that of its first effect alone."""
    asked = []
    both = SimpleNamespace(
        names="before", used=True, change=SimpleNamespace(sentence="it changed"),
        track=lambda problem, explained: explained,
    )  # fmt: skip
    found = SimpleNamespace(problem=None, explained_mm=lambda effects: asked.append(effects))
    for kind in ("ambiguous", "several"):
        verdict = Verdict(kind, ("payload", "misalignment"), "")
        since(Diagnosis(verdict, ErrorLevels(1.0, 0.1, 0.2), ()), both, found)
    assert asked == [("payload",), ("payload", "misalignment")]


# Inputs --------------------------------------------------------------------------------------


def test_no_common_motion_is_a_note_and_an_error_if_pairs_are_asked_for(model):
    after, before = made(smooth_walk(10), 0.0), made(smooth_walk(11), 0.0, seed=2, name="other")
    found = diagnose(model, [after], before=[before])
    assert found.change.change_mm is None
    assert any("residuals before and after are compared" in note for note in found.notes)
    with pytest.raises(InputError, match="same actuation as other"):
        diagnose(model, [after], before=[before], paired="always")
    with pytest.raises(InputError, match="pairing"):
        diagnose(model, [after], before=[before], paired="perhaps")


def test_a_minute_of_pairs_is_explained_only_where_pairs_are_asked_for(model):
    """Of three recordings of 100 s one repeats BEFORE: what changed may show in the two others."""
    motion, rows = smooth_walk(3), round(100.0 / PERIOD_S)
    before = made(motion, 0.0, rows=rows, seed=9, name="earlier")
    after = [made(smooth_walk(10 + k), 0.0, rows=rows, seed=k, name=f"new{k}") for k in (1, 2)]
    table = residual_table(model, [made(motion, 0.0, rows=rows), *after])
    found = before_and_after(table, [before])
    assert not found.used
    assert found.change.sentence.startswith("only 33 % of the rows have the same actuation as ear")
    assert "by --paired always" in found.notes[0]
    assert before_and_after(table, [before], "always").used
    short = before_and_after(residual_table(model, after), [before])
    assert "--paired always" not in short.notes[0]


def test_a_short_recording_of_the_same_motion_is_called_short(model):
    """Not one with another actuation; and a key point that nobody saw is no warning of NumPy."""
    before, after = made(smooth_walk(10), 0.0), made(smooth_walk(10), 0.0, rows=80, seed=7)
    both = before_and_after(residual_table(model, [after]), [replace(before, name="early")])
    (note,) = both.notes
    assert note.startswith("100 % of the rows were recorded with the same actuation as early, but")
    assert f"fewer than the {LEAST_ROWS} that a paired difference needs" in note
    assert note.endswith("record for longer")
    said = "rows are not paired with early, though 100 % have the same actuation: the model's"
    assert both.change.sentence.startswith(said)
    again = made(smooth_walk(10), 0.0, seed=7, name="unseen")
    blind = again.key_points_mm.copy()
    blind[:, 1] = np.nan
    unseen = replace(again, key_points_mm=blind)
    change = before_and_after(residual_table(model, [unseen]), [before]).change
    assert change.per_key_point_mm[1] == 0.0
    assert change.per_key_point_mm[0] > 0.0


def test_nothing_is_paired_where_pairs_are_not_wanted(model):
    table = residual_table(model, [made(smooth_walk(3), 0.0)])
    both = before_and_after(table, [made(smooth_walk(3), 0.0, seed=2, name="earlier")], "never")
    assert not both.pairs.paired.any()
    assert both.change.paired_share == 0.0
    assert both.change.sentence.startswith("no rows are paired with earlier: the model's residuals")
    (note,) = both.notes
    assert "because --paired never was given" in note
    assert "record" not in note


def test_motion_faster_than_before_is_noted_where_rows_are_not_paired(model):
    """What the model lacks at this speed cannot be learned from slower motion."""
    walk = smooth_walk(3)
    slow = made(lambda t_s: walk(0.25 * t_s), 0.0, seed=2, name="earlier")
    fast = made(walk, 0.0, name="later")
    change = before_and_after(residual_table(model, [fast]), [slow])
    span = model.spec.span
    ratio = speed_of([fast], span) / speed_of([slow], span)
    assert ratio > 2.0
    _, note = change.notes
    assert f"% of its range in a second, {ratio:.2g} times as fast as in earlier: " in note
    assert "counts as a change" in note
    assert note in change.notes_of_fit
    assert len(before_and_after(residual_table(model, [slow]), [fast]).notes) == 1
    assert not before_and_after(residual_table(model, [fast]), [replace(fast)]).notes


def test_an_amendment_of_few_pairs_is_checked_where_they_are_asked_for(model):
    """One of three recordings repeats BEFORE: a third of the held-out rows has a partner."""
    motion, rows = smooth_walk(3), round(120.0 / PERIOD_S)
    before = made(motion, 0.0, rows=rows, seed=9, name="earlier")
    turned = [
        made(each, 0.0, rows=rows, seed=k, name=f"new{k}", change=lambda p: 0.5 + 0.0 * p[:, 0])
        for k, each in enumerate((motion, smooth_walk(11), smooth_walk(12)))
    ]
    settings = {"before": [before], "retune_network": False, "refit": "never"}
    asked = amend(model, turned, "misalignment", paired="always", **settings)
    assert asked.model_error is not None
    assert asked.claimed
    note = "67 % of the rows have no partner in earlier, and what changed there is"
    assert sum(each.startswith(note) for each in asked.notes) == 1
    plain = amend(model, turned, "misalignment", **settings)
    assert plain.model_error is None


def test_held_out_rows_without_partners_are_the_reason_that_is_given(model):
    """The first three quarters repeat BEFORE, the held-out quarter does not."""
    motion, other, part = smooth_walk(3), smooth_walk(11), 0.75 * ROWS * PERIOD_S

    def turning_off(t_s):
        return np.where((t_s < part)[:, None], motion(t_s), other(t_s))

    table = residual_table(model, [made(turning_off, 0.0)])
    both = before_and_after(table, [made(motion, 0.0, seed=2, name="earlier")])
    assert both.used
    checked = both.with_final_check()
    assert not checked.used
    (note,) = checked.notes_of_fit
    assert note.startswith("0 % of the held-out rows were recorded with the same actuation as ear")
    assert "--paired always" not in note


def test_an_effect_that_is_fitted_without_pairs_is_said_to_be_fitted_as_without_before(model):
    after, before = made(smooth_walk(10), 1.0), made(smooth_walk(11), 0.0, seed=2, name="other")
    settings = {"retune_network": False, "refit": "never"}
    with_it = amend(model, [after], "payload", before=[before], **settings)
    without = amend(model, [after], "payload", **settings)
    assert with_it.parameters == without.parameters
    assert with_it.held_out == without.held_out
    (note,) = with_it.notes
    assert "as other: effects are fitted to the model's residuals there and not to the" in note
    assert "compared" not in note


def lagging(pressure):
    """(T,) mm: what the network never learned of the past: a first-order lag of 2 s."""
    low = np.empty(len(pressure))
    low[0] = pressure[0, 0]
    for i in range(1, len(low)):
        low[i] = low[i - 1] + PERIOD_S / 2.0 * (pressure[i - 1, 0] - low[i - 1])
    return 0.6 * (low - pressure[:, 0])


@pytest.mark.parametrize("changed", [False, True])
def test_what_was_wrong_before_is_no_change_without_pairs(model, changed):
    """A lag of the arm that the model lacks is in both, with other motion; a gain is new."""
    before, after = smooth_walk(15), smooth_walk(16)
    time = PERIOD_S * np.arange(ROWS)
    old = recording(lagging(before(time)), before(time), seed=2)
    gain = 0.15 * after(time)[:, 1] * changed
    new = recording(lagging(after(time)) + gain, after(time), seed=3)
    both = before_and_after(residual_table(model, [new]), [old])
    assert not both.used
    problem = both.training()
    rows = problem.index.numpy()
    plain = np.sqrt(np.mean(np.square(both.plain.residual_mm[rows]).sum(2)))
    # What is left beside the noise is the gain, of which the fit to BEFORE knows nothing.
    left = np.sqrt(np.mean(np.square(gain[rows])) / 3 + 3 * NOISE_MM**2)
    assert plain > 3.0 * NOISE_MM * np.sqrt(3)
    assert problem.rmse_mm == pytest.approx(left, rel=0.3)
    assert np.all(problem.discrepancy_mm < 0.5 * np.array(model.validation.per_key_point_mm))


def test_rows_of_a_fit_teach_what_its_recordings_teach(model):
    """All 1,200 rows of a lag of 2 s are kept, of two runs of which each begins settled."""
    signals = [
        smooth_walk(seed)(PERIOD_S * np.arange(rows)) for seed, rows in ((15, 700), (9, 500))
    ]
    old = [recording(lagging(signal), signal, seed=2) for signal in signals]
    motion = smooth_walk(16)(PERIOD_S * np.arange(ROWS))
    new = residual_table(model, [recording(lagging(motion), motion, seed=3)])
    expected = known_error(new, rows_before(residual_table(model, old)))
    assert expected.ratio < 0.6
    kept = model.residuals_on([history_of(old)])
    found = known_error(new, rows_of_fit(kept, model.spec))
    assert found.ratio == pytest.approx(expected.ratio, rel=1e-3)
    np.testing.assert_allclose(found.correction_mm, expected.correction_mm, atol=2e-3)
    np.testing.assert_allclose(found.reference.residual, expected.reference.residual, atol=2e-3)
    assert rows_of_fit(replace(kept, past=None), model.spec) is None


def test_half_of_the_actuation_is_past_enough(model):
    """Residuals of every second row; before them all rows of the actuation or every second one."""
    pressure = smooth_walk(15)(PERIOD_S * np.arange(1200))
    kept = model.residuals_on([history_of([recording(lagging(pressure), pressure, seed=2)])])
    names = ("actuation", "direction", "residual_mm")
    some = replace(kept, **{name: getattr(kept, name)[::2] for name in names})
    row, past = kept.past.row[::2], kept.past
    every = rows_of_fit(replace(some, past=replace(past, row=row)), model.spec)
    thin = Past(past.t_s[::2], past.actuation[::2], past.run[::2], row // 2)
    half = rows_of_fit(replace(some, past=thin), model.spec)
    assert np.sqrt(np.mean((half.inputs - every.inputs) ** 2)) < 0.1 * every.inputs.std()
    assert np.array_equal(half.residual_mm, every.residual_mm)


@pytest.mark.parametrize("changed", [False, True])
def test_faster_motion_than_in_the_fit_tells_what_has_changed_since(model, changed):
    """A lag that the model lacks from the start is no change; a curve of the second chamber is."""
    slow = smooth_walk(15)(PERIOD_S * np.arange(ROWS))
    old = recording(lagging(slow), slow, seed=2)
    fast = smooth_walk(16)(2.0 * PERIOD_S * np.arange(ROWS // 2))
    gain = 0.3 * fast[:, 1] * changed
    new = recording(lagging(fast) + gain, fast, seed=3)
    arm = copy.copy(model)
    arm.spec = replace(model.spec, speed_per_s=speed_of([old], model.spec.span))
    arm.training_residuals = arm.residuals_on([history_of([old])])
    found = diagnose(arm, [new], refit="never")
    since = found.since_fit
    assert since.sentence.startswith("since the fit of the model: ")
    assert found.verdict.kind != "nothing_missing"
    assert (since.kind == "nothing_missing") != changed
    # The candidates are those of the diagnosis before: alone, it gives the same.
    assert changed_since_fit(residual_table(arm, Sealed([new]).training)) == since
    assert diagnose(arm, [old], refit="never").since_fit is None, "as fast as in the fit"
    assert not any("--before" in note for note in found.notes)
    arm.training_residuals = replace(arm.training_residuals, past=None)
    without = diagnose(arm, [new], refit="never")
    assert without.since_fit is None
    assert without.verdict == found.verdict
    assert without.notes[-1].endswith("give the recordings of the fit by --before")


def test_what_has_changed_since_the_fit_is_printed(model, tmp_path, monkeypatch, capsys):
    sentence = "since the fit of the model: a spring is missing"
    levels = ErrorLevels(1.0, 0.1, 0.2)
    verdict = Verdict("cannot_tell", (), "cannot tell")
    found = Diagnosis(verdict, levels, (), since_fit=Verdict("identified", ("spring",), sentence))
    monkeypatch.setattr("surgisoft.diagnosis.diagnose.diagnose", lambda *_, **__: found)
    monkeypatch.chdir(tmp_path)
    save_model(model, "arm")
    save_recording(made(smooth_walk(3), 0.0, rows=200), tmp_path / "new.parquet")
    assert run(["diagnose", "arm", "new.parquet", "--report", "page", "--json", "found.json"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == sentence
    (written,) = Path("page").glob("*.html")
    assert "Since the fit of the model: a spring is missing." in written.read_text()
    said = json.loads(Path("found.json").read_text())["since_fit"]
    assert (said["kind"], said["effects"], said["sentence"]) == ("identified", ["spring"], sentence)


def test_rows_seconds_apart_have_no_spectrum_and_are_compared_all_the_same(model):
    """Of 10 s there are five rows: too few for a band of frequencies."""
    slow = smooth_walk(3)(PERIOD_S * np.arange(ROWS))[::6]
    t_s = 2.0 * np.arange(len(slow))
    rest = unlearned(slow)
    before, after = (
        replace(recording(rest + shift, slow, seed=seed), t_s=t_s)
        for seed, shift in ((1, 0.0), (2, 0.5))
    )
    both = paired(model, after, before)
    assert both.used
    assert np.isfinite(both.change.change_mm)
    assert both.training().rmse_mm > 0.0


def test_before_without_any_key_point_is_refused(model):
    after = made(smooth_walk(16), 0.0, rows=400)
    nothing = replace(
        after, name="morning", key_points_mm=np.full_like(after.key_points_mm, np.nan)
    )
    with pytest.raises(InputError, match="morning: every key point is missing in every row"):
        diagnose(model, [after], before=[nothing], setup_tests=False, paired="never")


def test_repeats_of_one_motion_teach_nothing_of_another(model):
    """What is wrong at each instant of a motion comes again with its repeats, and not elsewhere."""
    cycle, repeats = 600, 4
    once = smooth_walk(18)(PERIOD_S * np.arange(cycle))
    wrong = smooth_walk(20)(PERIOD_S * np.arange(cycle))[:, 0]
    old = recording(np.tile(wrong - wrong.mean(), repeats), np.tile(once, (repeats, 1)), seed=2)
    pressure = smooth_walk(16)(PERIOD_S * np.arange(ROWS))
    new = recording(np.zeros(ROWS), pressure, seed=3)
    found = known_error(residual_table(model, [new]), rows_before(residual_table(model, [old])))
    assert found.ratio == 1.0
    assert not found.correction_mm.any()


def test_a_nearly_idle_chamber_is_no_common_range(model):
    """A chamber that hardly moves, at another pressure before and after, refuses nothing."""
    motion = smooth_walk(17)(PERIOD_S * np.arange(ROWS))
    idle = np.random.default_rng(0).uniform(0, 0.1, ROWS)
    before, after = (np.stack([motion[:, 0], at + idle], axis=1) for at in (1.0, 2.0))
    some = [recording(np.zeros(ROWS), pressure, seed=3) for pressure in (after, before)]
    both = before_and_after(residual_table(model, some[:1]), some[1:])
    assert both.training().rmse_mm < 2.0 * np.sqrt(3) * NOISE_MM


def test_recordings_and_reference_are_before(model):
    """`reference` with recordings, the older name of the argument, gives the same."""
    motion = smooth_walk(12)
    after, before = made(motion, 2.0), made(motion, 0.0, seed=2)
    one, other = (diagnose(model, [after], **{n: [before]}) for n in ("before", "reference"))
    assert one.verdict == other.verdict
    assert one.change.to_json() == other.change.to_json()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"measured": np.linspace(0.0, 20.0, 3 * ROWS).reshape(ROWS, 3)}, "chambers: 3"),
        ({"key_points_mm": made(walk_of_time, 0.0).key_points_mm[:, 1:]}, "key points: 2"),
        ({"unit": "psi"}, "unit: psi"),
        ({"measured": 20.0 + walk(ROWS)}, "no common actuation"),
    ],
)
def test_before_of_another_robot_is_one_line(model, change, words, tmp_path, capsys):
    motion = smooth_walk(13)
    save_model(model, tmp_path / "arm")
    save_recording(made(motion, 0.0), tmp_path / "after.parquet")
    save_recording(replace(made(motion, 0.0), **change), tmp_path / "before.parquet")
    arm, after, before = (str(tmp_path / n) for n in ("arm", "after.parquet", "before.parquet"))
    for command in (["diagnose", arm, after], ["compare", arm, after]):
        assert run([*command, "--before", before]) == 2
        error = capsys.readouterr().err.strip().splitlines()
        assert len(error) == 1
        assert words in error[0]


def strange_before(model, motion):
    """A recording that the model describes, and one from before of an arm that moves otherwise."""
    after = made(motion, 0.0)
    other = made(smooth_walk(22), 0.0, seed=2, name="other")
    swing = 40.0 * (other.measured - other.measured.mean(0)) @ np.array([1.0, -1.0])
    points = other.key_points_mm + swing[:, None, None] * np.array([1.0, 0.0, 0.0])
    return after, replace(other, key_points_mm=points)


def test_a_model_that_does_not_describe_before_does_not_blame_after(model, tmp_path, capsys):
    after, before = strange_before(model, smooth_walk(10))
    found = diagnose(model, [after], before=[before])
    error = float(np.sqrt(np.nanmean(np.square(residual_table(model, [before]).error_mm))))
    assert (found.verdict.kind, found.verdict.reason) == ("cannot_tell", "before")
    assert f"the model does not describe other (error {error:.3g} mm" in found.verdict.sentence
    assert "give recordings of this arm from before the change" in found.verdict.sentence
    assert "fit a model" not in found.verdict.sentence
    command = found.command("arm", "after.csv", "other.csv")
    assert command == "surgisoft diagnose arm after.csv"
    assert found.error_mm.before < 0.1 * error
    assert (found.ranking, found.checks, found.notes) == ((), (), ())
    json.dumps(found.to_json())
    save_model(model, tmp_path / "arm")
    for each, name in ((after, "after"), (before, "other")):
        save_recording(each, tmp_path / f"{name}.parquet")
    command = [str(tmp_path / name) for name in ("arm", "after.parquet", "other.parquet")]
    report = ["--report", str(tmp_path / "page")]
    assert run(["diagnose", *command[:2], "--before", command[2], *report]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"next: surgisoft diagnose {command[0]} {command[1]}"
    assert not any(line.startswith("effect ") for line in lines)
    assert "<h2>Effects" not in (tmp_path / "page" / "diagnosis.html").read_text()


def test_a_model_that_does_not_describe_before_is_no_reference_for_pairs_either(model):
    """The same motion before, of another arm: the difference is no change of this one."""
    after = made(smooth_walk(10), 0.0)
    swing = 40.0 * (after.measured - after.measured.mean(0)) @ np.array([1.0, -1.0])
    points = after.key_points_mm + swing[:, None, None] * np.array([1.0, 0.0, 0.0])
    before = replace(after, key_points_mm=points, name="other")
    found = diagnose(model, [after], before=[before])
    assert found.change is not None
    assert found.change.paired_share > 0.9
    assert (found.verdict.kind, found.verdict.reason) == ("cannot_tell", "before")
    with pytest.raises(InputError, match="the model does not describe other"):
        amend(model, [after], ["misalignment"], before=[before])
    with pytest.raises(InputError, match="the model does not describe other"):
        next_experiment(model, [after], before=[before])


def test_what_was_amended_is_not_sought_again_since_before(model, tmp_path, capsys):
    """A model that has the change would predict it before the change, too."""
    before = made(smooth_walk(10), 0.0)
    after = made(smooth_walk(10), 2.0, seed=7, name="later")
    amended = amend(model, [after], ["misalignment"], before=[before]).model
    save_model(amended, tmp_path / "new")
    for each in (before, after):
        save_recording(each, tmp_path / f"{each.name}.parquet")
    new, later, earlier = (
        str(tmp_path / name) for name in ("new", "later.parquet", f"{before.name}.parquet")
    )
    for command in (
        ["diagnose", new, later],
        ["amend", new, "--effect", "payload", "--data", later, "-o", str(tmp_path / "other")],
        ["improve", new, later, "-o", str(tmp_path / "other")],
        ["next-experiment", new, later, "-o", str(tmp_path / "other.csv")],
    ):
        assert run([*command, "--before", earlier]) == 2
        error = capsys.readouterr().err
        assert "effects of the model were fitted to " in error
        assert "from before the change" in error
        assert error.count("\n") == 1
    assert not (tmp_path / "other").exists()
    assert not (tmp_path / "other.csv").exists()
    assert run(["diagnose", new, later]) == 0


def test_the_amendment_of_such_a_change_is_warned_of(model):
    after, before = strange_before(model, smooth_walk(10))
    both = before_and_after(residual_table(model, [after]), [before])
    (note,) = both.notes
    assert note.startswith("the model does not describe other (error ")
    right = before_and_after(residual_table(model, [after]), [made(smooth_walk(22), 0.0, seed=2)])
    assert right.strange is None
    of_neither = before_and_after(residual_table(model, [before]), [replace(before, name="again")])
    assert of_neither.strange is None
    assert right.strange_in_words == ""


def test_recordings_too_short_for_a_diagnosis_say_nothing_of_what_the_model_lacked(model):
    short, after = made(smooth_walk(10), 0.0, rows=40), made(smooth_walk(12), 0.0, seed=7)
    both = before_and_after(residual_table(model, [after]), [short])
    assert lacking_before(both, lambda text: None) == ()


@pytest.mark.parametrize("own", [(), (("creep", 1.5),)])
def test_what_the_model_lacked_before_the_change_is_said(own):
    """An own creep is no change, but what changes acts through it."""
    takes = []
    for take, hidden in ((1, ()), (2, (("payload", 1.5),))):
        rig = VirtualRig(0, take=take, hidden=(*own, *hidden))
        takes.append(rig.record(make_protocol("mixed", rig.limits, 1000, seed=5))[0])
    before, after = takes
    notes = amend(default_arm(), [after], "payload", before=[before], retune_network=False).notes
    if not own:
        assert notes == ()
        return
    (note,) = notes
    assert note.startswith("the model already lacks creep on the recordings from before the change")
    assert f"first run 'surgisoft improve' on the model and {before.name}, then" in note


def test_one_recording_before_and_after_is_refused(model, tmp_path, capsys):
    save_model(model, tmp_path / "arm")
    (tmp_path / "x").mkdir()
    save_recording(made(smooth_walk(14), 0.0), tmp_path / "rec.parquet")
    arm, rec, same = (str(tmp_path / name) for name in ("arm", "rec.parquet", "x/../rec.parquet"))
    new = ["-o", str(tmp_path / "new")]
    for command in (["diagnose", arm, rec], ["compare", arm, rec], ["improve", arm, rec, *new]):
        assert run([*command, "--before", same]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"surgisoft: error: {rec}: is given both before and after the cha")
        assert error.count("\n") == 1
    assert not (tmp_path / "new").exists()
    one = made(smooth_walk(14), 0.0)
    with pytest.raises(InputError, match="both before and after"):
        diagnose(model, [one], before=[one])


def test_pairing_without_before_is_refused(model, tmp_path, capsys):
    save_model(model, tmp_path / "arm")
    save_recording(made(smooth_walk(14), 0.0), tmp_path / "after.parquet")
    arm, after = str(tmp_path / "arm"), str(tmp_path / "after.parquet")
    assert run(["diagnose", arm, after, "--paired", "always"]) == 2
    assert "--before" in capsys.readouterr().err
    assert run(["diagnose", arm, after, "--replay", str(tmp_path / "x.rrd")]) == 2
    assert "--before" in capsys.readouterr().err


def test_command_and_function_give_the_same(model, tmp_path):
    save_model(model, tmp_path / "arm")
    motion = smooth_walk(10)
    before = made(motion, 0.0, seed=2, name="before")
    after = made(motion, 2.0, name="after", change=lambda p: 0.5 + 0.0 * p[:, 0])
    for each in (before, after):
        save_recording(each, tmp_path / f"{each.name}.parquet")
    arm, after, before = (str(tmp_path / n) for n in ("arm", "after.parquet", "before.parquet"))
    out, page, replay = (tmp_path / n for n in ("out.json", "page", "change.rrd"))
    command = ["diagnose", arm, after, "--before", before, "--json", str(out)]
    assert run([*command, "--report", str(page), "--replay", str(replay)]) == 0
    written = json.loads(out.read_text())
    found = diagnose(arm, load_recording(after), before=before)
    expected = json.loads(json.dumps(found.to_json()))
    for values in (written, expected):
        del values["seconds"]
    assert written == expected
    assert written["verdict"]["effects"] == ["payload"]
    assert written["change"]["paired_share"] > 0.9
    text = (page / "diagnosis.html").read_text()
    assert "Before and after" in text
    assert replay.stat().st_size > 10_000
