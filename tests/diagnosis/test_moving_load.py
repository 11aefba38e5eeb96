"""A load on an arm that swings: against a simulated arm of one mode."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.signal import lsim, lti

from surgisoft.diagnosis.candidates import Mode, candidates, measured_candidates, with_effect
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.pairs import before_and_after
from surgisoft.diagnosis.residuals import residual_table
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.effects import make_effect
from surgisoft.surrogate.model import Validation
from tests.diagnosis.synthetic import POINTS, still_model

PERIOD_S = 0.05
ROWS = 1600
NOISE_MM = 0.02
FINER = 4
"""Steps of the simulation for each row."""
LENGTH_MM = 70.0
GRAVITY_MM_S2 = 9810.0
LOADED_HZ, LOADED_DAMPING = 2.0, 0.2
"""Poles of the arm with its load."""
MASS = 0.8
"""Mass of the load over the modal mass of the arm."""


def bending(s):
    """(...) deflection of a clamped beam by a force at its tip, 1 there (Euler-Bernoulli)."""
    z = np.asarray(s) / LENGTH_MM
    return (3 * z**2 - z**3) / 2


def shortening(s):
    """(...) how far a body that keeps its length draws back where its tip bends by 1 mm, mm."""
    z = np.asarray(s) / LENGTH_MM
    return (3 * z**3 - 9 / 4 * z**4 + 9 / 20 * z**5) / (2 * LENGTH_MM)


def pull_back():
    """Deflection of the tip by a weight at the tip of a beam that is bent by 1 mm, over C F, mm^3.

    The moment is F (x_tip - x(s)); its angle and its deflection are summed along the body.
    """
    s = np.linspace(0.0, LENGTH_MM, 4001)
    angle = np.concatenate([[0.0], np.cumsum((1 - bending(s))[1:] * np.diff(s))])
    return float((angle[1:] * np.diff(s)).sum())


def stiffness_of_unloaded():
    """(w0^2, damping0, k): the unloaded mode's, from the loaded one's."""
    w = 2 * np.pi * LOADED_HZ
    k = 3 * MASS * GRAVITY_MM_S2 * pull_back() / LENGTH_MM**3
    square = w**2 * (1 + MASS) - k
    return square, LOADED_DAMPING * (1 + MASS) * w / np.sqrt(square), k


def force(t):
    """(T, 2) force on the arm, mm of deflection at rest: slow motion, and gusts that shake it."""
    rng = np.random.default_rng(3)
    parts = [(4.0, f, rng.uniform(0, 6)) for f in (0.1, 0.23, 0.41, 0.7)]
    parts += [(0.8, f, rng.uniform(0, 6)) for f in np.arange(1.0, 4.0, 0.07)]
    size, frequency, phase = np.array(parts).T
    turn = 2 * np.pi * frequency * np.asarray(t)[..., None] + phase
    return np.stack([(size * np.sin(turn + late)).sum(-1) for late in (0.0, 1.3)], -1)


def swing(mass, stiffness):
    """(ROWS, 2) deflection of the tip, mm, of an arm of unit modal mass with a load."""
    square, damping, _ = stiffness_of_unloaded()
    arm = lti([square], [1 + mass, 2 * damping * np.sqrt(square), square + stiffness])
    t = PERIOD_S / FINER * np.arange(FINER * ROWS)
    return np.stack([lsim(arm, push, t)[1][::FINER] for push in force(t).T], 1)


def take(tip_mm, name, seed, vibration_mm=0.0):
    """A recording of an arm that hangs, its three key points on the bent body."""
    rng = np.random.default_rng(seed)
    t = PERIOD_S * np.arange(ROWS)
    shaken = vibration_mm * np.sin(
        2 * np.pi * 3.0 * t[:, None] + np.cumsum(rng.normal(0, 0.25, (ROWS, 2)), 0)
    )
    points = np.repeat(POINTS[None], ROWS, 0) + rng.normal(0, NOISE_MM, (ROWS, *POINTS.shape))
    tip = tip_mm + shaken
    points[..., :2] += bending(POINTS[:, 2])[None, :, None] * tip[:, None, :]
    points[..., 2] -= shortening(POINTS[:, 2]) * np.square(tip).sum(1, keepdims=True)
    slow = 5.0 + 0.5 * np.stack([force(t)[:, 0], force(t)[:, 1]], -1).clip(-9, 9)
    return Recording(
        name=name,
        t_s=t,
        measured=slow,
        key_points_mm=points,
        noise_mm=NOISE_MM,
        gravity=np.array([0.0, 0.0, 1.0]),
    )


@pytest.fixture(scope="module")
def model():
    model = still_model()
    model.validation = Validation(1.5, (0.5, 1.0, 2.0), ROWS)
    return model.replace(spec=replace(model.spec, gravity=(0.0, 0.0, 1.0)))


@pytest.fixture(scope="module")
def unloaded():
    return swing(0.0, 0.0)


@pytest.fixture(scope="module")
def loaded():
    return swing(MASS, stiffness_of_unloaded()[2])


def left_by(problem, candidate):
    """Share of the tip's motion to the side that the best amplitudes leave, root mean square."""
    change = problem.residual[:, -1, :2].reshape(-1)
    sensitivities = candidate.sensitivities[:, -1, :2, :1].reshape(len(change), -1)
    amplitudes = np.linalg.lstsq(sensitivities, change, rcond=None)[0]
    return np.std(change - sensitivities @ amplitudes) / np.std(change), amplitudes[0]


def test_a_mode_follows_a_sine_by_its_transfer_function(model):
    """w^2 / (w^2 - v^2 + 2 i damping w v) for a sine of v; its acceleration is -v^2 of it."""
    w, v, damping, dt = 2 * np.pi * 2.0, 2 * np.pi * 1.5, 0.2, 0.01
    t = dt * np.arange(2000)
    push = np.stack([np.sin(v * t), np.cos(v * t)], -1)
    given = torch.from_numpy(push[None]).float(), torch.full((1, len(t)), dt)
    with torch.no_grad():
        at, acceleration = Mode(2.0, damping).follow(model.facts, *given, lambda rows: rows[0])
    wave = w**2 / (w**2 - v**2 + 2j * damping * w * v) * np.exp(1j * v * t)
    expected = np.stack([wave.imag, wave.real], -1)
    late = t > 10.0
    np.testing.assert_allclose(at[late], expected[late], atol=0.01 * abs(wave[0]))
    size = v**2 * abs(wave[0])
    np.testing.assert_allclose(acceleration[late], -(v**2) * expected[late], atol=0.02 * size)


def test_a_load_in_motion_explains_a_swing_that_no_model_predicts(model, unloaded, loaded):
    """Mass and weight of one load, on an arm whose model knows nothing of its motion."""
    before, after = take(unloaded, "before", 1), take(loaded, "after", 2)
    problem = before_and_after(residual_table(model, [after]), [before]).training()
    left = [left_by(problem, each) for each in candidates(problem, ["payload"])]
    best, sag = min(left)
    assert best < 0.08
    square, _, k = stiffness_of_unloaded()
    expected = MASS * GRAVITY_MM_S2 / (square + k)
    assert sag == pytest.approx(expected, rel=0.1), "sag at rest of a mass, C m g L^3 / 3"
    (gain,) = [c for c in candidates(problem, ["gain_mismatch"]) if c.spread is not None]
    assert left_by(problem, gain)[0] > 4 * best


def test_candidates_on_the_measured_body_by_count_and_by_hand(model, unloaded, loaded):
    """Rows of 0.05 s show four samples in a period up to 5 Hz: 6 of the frequencies, 4 dampings."""
    before, after = take(unloaded, "before", 1), take(loaded, "after", 2)
    problem = before_and_after(residual_table(model, [after]), [before]).training()
    loads = measured_candidates(problem, ["payload"])
    assert len(loads) == 1 + 6 * 4
    assert all(load.removable for load in loads)
    (gain,) = measured_candidates(problem, ["gain_mismatch"])
    assert not gain.removable
    motion = problem.table.body_before_mm[problem.index.numpy()] - POINTS
    np.testing.assert_allclose(gain.sensitivities[..., 0], motion, atol=1e-5)
    np.testing.assert_allclose(gain.with_amplitudes(np.array([0.1])).gain.detach(), [0.1, 0.1])
    had = with_effect(model, "payload", make_effect("payload", model.facts))
    assert measured_candidates(problem.with_model(had), ["payload"]) == []


def test_a_load_along_the_body_weighs_by_its_acceleration_as_one_at_the_tip(model):
    """A bent body that moves up and down as a whole: both loads weigh as much more or less."""
    t = PERIOD_S * np.arange(ROWS)
    still = take(np.full((ROWS, 2), 15.0), "before", 1)
    rise = 0.5 * np.sin(2 * np.pi * 4.0 * t)[:, None] * np.ones(len(POINTS))
    points = np.repeat(still.key_points_mm.mean(0)[None], ROWS, 0)
    points[..., 2] += rise
    before, after = (replace(still, name=name, key_points_mm=points) for name in ("a", "b"))
    problem = before_and_after(residual_table(model, [after]), [before]).training()
    rest, *moving = (
        each.sensitivities[:, -1, 0] for each in measured_candidates(problem, ["payload"])
    )
    mode = max(moving, key=lambda each: each[..., 0].std())
    tip, body = (mode / rest - 1.0).T
    assert tip.std() > 0.05
    np.testing.assert_allclose(body.std(), tip.std(), rtol=0.1)
    assert np.corrcoef(tip, body)[0, 1] > 0.99


def test_payload_is_found_when_it_comes_and_when_it_goes(model, unloaded, loaded):
    for first, second, sign in ((unloaded, loaded, 1), (loaded, unloaded, -1)):
        found = diagnose(
            model, [take(second, "after", 2)], before=[take(first, "before", 1)], setup_tests=False
        )
        assert found.verdict.effects == ("payload",)
        assert sign * found.ranking[0].parameters["sag_mm"] > 1.0
        assert ("less payload than before" in found.verdict.sentence) == (sign < 0)
        assert found.ranking[0].heldout_rmse_mm < 0.5 * found.ranking[1].heldout_rmse_mm


def test_another_vibration_is_no_load(model, unloaded):
    """The vibration of BEFORE with the other sign is half of the difference of two vibrations."""
    before, after = take(unloaded, "before", 1, 1.0), take(unloaded, "after", 2, 1.0)
    both = before_and_after(residual_table(model, [after]), [before])
    problem = both.training()
    left = [left_by(problem, each)[0] for each in candidates(problem, ["payload"])]
    assert min(left) > 0.97
    # Two sines, of amplitude 1 mm along x and y, in either recording.
    assert both.pairs.free_mm[-1] == pytest.approx(np.sqrt(2), rel=0.15)
    assert both.pairs.noise_mm[-1] == pytest.approx(both.pairs.free_mm[-1]), "more than the noise"


def test_a_load_acts_on_the_motion_that_both_recordings_share(model):
    """Slow motion comes again, a vibration of 1 mm does not: it is taken off the body of BEFORE."""
    t = PERIOD_S * np.arange(ROWS)
    slow = np.stack([4 * np.sin(2 * np.pi * 0.1 * t), 4 * np.cos(2 * np.pi * 0.23 * t)], -1)
    before, after = take(slow, "before", 1, 1.0), take(slow, "after", 2, 1.0)
    body = before_and_after(residual_table(model, [after]), [before]).pairs.body_mm[:, -1, :2]
    shaken = before.key_points_mm[:, -1, :2] - slow
    assert np.std(body - slow) < 0.4 * np.std(shaken)
