"""What the search for set-up faults asks of an explanation before it is a fault."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.diagnosis.setup.sample import Arrangement, samples_of
from surgisoft.diagnosis.setup.search import Hypothesis, Levels, Search
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
