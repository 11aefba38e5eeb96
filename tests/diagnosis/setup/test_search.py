"""What the search for set-up faults asks of an explanation before it is a fault."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.diagnosis.setup.alignment import Frame, block_moments, fitted
from surgisoft.diagnosis.setup.sample import Arrangement, samples_of
from surgisoft.diagnosis.setup.search import Border, Fitted, Hypothesis, Levels, Search
from surgisoft.surrogate.checkpoint import default_arm
from tests.diagnosis.setup.recordings import driven, late, measured, predicted, with_points


@pytest.fixture(scope="module")
def model():
    return default_arm()


@pytest.mark.parametrize(("noise_mm", "kinds"), [(0.05, ("time",)), (0.85, None)])
def test_an_error_within_the_noise_is_not_looked_into(model, noise_mm, kinds):
    """Clocks that differ by 0.3 s explain the same 1.34 mm in both; with a noise of 1.47 mm in a
    distance (0.85 mm in a coordinate) the error is 1.35 times the noise, which is not noticed."""
    found = find_setup_faults(model, [late(measured(noise_mm=noise_mm), 3)])
    assert (None if found is None else found.kinds) == kinds


def test_a_correction_is_judged_on_blocks_that_took_no_part_in_its_fit(model):
    """A camera that is moved every 24 s by 3 mm: the frame of the other blocks of time fits worse
    than the frame of all of them, which a fit to all rows would be judged with."""
    original = predicted()
    moves = np.random.default_rng(0).normal(0.0, 3.0, (10, 1, 1, 3)).repeat(240, 1)
    moved = with_points(original, original.key_points_mm + moves.reshape(2400, 1, 3))
    coarse, fine, full = samples_of(model, [moved], (200, 2400, 2400))
    search = Search(coarse, fine, full, Levels(0.05, 0.3), {})
    points = tuple(range(5))
    found = search.fit(Hypothesis(Arrangement.as_recorded(3), points, frame="proper"))
    of_all = float(found.blocks.summed().mean_square(found.frame))
    assert found.rmse_mm**2 > 1.02 * of_all
    assert of_all > 1.0


def test_the_errors_of_a_frame_are_those_of_means_over_blocks():
    """Twelve blocks of time with a turn about z and a shift of their own, about the origin: the
    standard error of a mean is the deviation over the root of 12."""
    rng = np.random.default_rng(0)
    true = rng.normal(size=(12, 40, 4, 3)) * 30.0
    true -= true.mean((1, 2), keepdims=True)
    turns, shifts = 0.01 * rng.normal(size=12), rng.normal(size=(12, 3))
    rotation = Rotation.from_rotvec(turns[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    seen = np.einsum("bij,brkj->brki", rotation, true) + shifts[:, None, None]
    scale = 0.1  # recorded in cm
    block = np.repeat(np.arange(12), 40)
    blocks = block_moments(scale * seen.reshape(-1, 4, 3), true.reshape(-1, 4, 3), block, 12)
    frame = fitted(blocks.summed(), 1.0, np.asarray(scale))
    hypothesis = Hypothesis(Arrangement.as_recorded(3), tuple(range(4)), frame="proper")
    found = Fitted(hypothesis, frame, blocks, np.zeros(12), 0.0)
    turn, shift = found.turn_and_shift_errors()
    np.testing.assert_allclose(shift, shifts.std(0, ddof=1) / np.sqrt(12.0), rtol=1e-6)
    assert turn == pytest.approx(turns.std(ddof=1) / np.sqrt(12.0), rel=0.1)


def test_a_misalignment_ends_at_its_turn_and_at_its_shift_in_millimetres():
    """A shift of 0.5 and 1.5 in a recording in cm, with a limit of 10 mm; a turn of 0.1 rad."""
    border = Border(0.1, 10.0)
    for turn, shift_cm, holds in ((0.09, 0.5, True), (0.11, 0.5, False), (0.09, 1.5, False)):
        rotation = Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix()
        frame = Frame(rotation, np.array([0.0, 0.0, -shift_cm]), 0.1)
        assert border.holds(frame) == holds


def test_an_error_is_explained_by_what_falls_above_the_validated_one(model):
    """A validated error of 0.4 mm and a noise of 0.3 mm make 0.5 mm: of 2 mm nine tenths of the
    squared error above that are explained down to 0.79 mm, and what is not noticed is not."""
    coarse, fine, full = samples_of(model, [predicted()], (200, 400, 400))
    search = Search(coarse, fine, full, Levels(0.3, 0.4), {})
    assert search.levels.reference == pytest.approx(0.5)
    assert search.limit_mm == pytest.approx(0.5 * search.proof.noticed)
    for before, after, explained in ((2.0, 0.78, True), (2.0, 0.80, False), (2.0, 0.1, True)):
        assert search.explains(before, after) is explained
    assert not search.explains(0.99 * search.limit_mm, 0.1)
    assert search.explains(1.01 * search.limit_mm, 0.5)


def test_the_error_of_an_offset_is_the_spread_of_offsets_that_are_found(model):
    """Eight recordings that are 0.3 s late, with a noise of 1 mm in every coordinate."""
    found, rng = [], np.random.default_rng(0)
    original, as_it_is = predicted(1200), Arrangement.as_recorded(3)
    given = Hypothesis(as_it_is, tuple(range(5)), frame="none", later_s=0.3)
    for _ in range(8):
        noise = rng.normal(0.0, 1.0, original.key_points_mm.shape)
        noisy = late(with_points(original, original.key_points_mm + noise), 3)
        samples = samples_of(model, [noisy], (100, 600, 1200))
        fit = Search(*samples, Levels(1.0, 0.3), {}).fit(given)
        found.append((fit.hypothesis.later_s, fit.later_sd_s))
    later, errors = np.array(found).T
    assert 0.5 < errors.mean() / later.std(ddof=1) < 2.5
    assert abs(later.mean() - 0.3) < 2.0 * errors.mean()


def test_a_wrong_sign_is_proved_although_the_channel_rests_where_another_error_is(model):
    """The first channel rests at 0 in half of the time, where its sign changes nothing, and
    the body wanders by half a millimetre all the time, which is noticed there."""
    rested = predicted(rests=1200)
    rows = np.arange(rested.samples)
    wander = 0.6 * np.sin(rows / 60.0)[:, None, None] * np.array([0.0, 1.0, 0.0])
    wrong = driven(
        with_points(rested, rested.key_points_mm + wander), lambda p: p * [-1.0, 1.0, 1.0]
    )
    found = find_setup_faults(model, [replace(wrong, noise_mm=0.05)])
    assert found is not None
    assert found.kinds == ("chambers",)
    assert "the sign of chamber 1 is flipped" in found.sentence
