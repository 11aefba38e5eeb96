"""Breaks and lines in what a black box leaves, against plain regressions and known amplitudes."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.beyond_history import RIDGES, beyond_history, sudden_turn
from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.change_points import coarse, finer
from surgisoft.diagnosis.cross_validation import split_of
from surgisoft.diagnosis.evidence import sudden_gain
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.diagnosis.selection import select
from surgisoft.diagnosis.statistics import BREAK_RIDGE, studentised
from surgisoft.surrogate.model import Validation
from tests.diagnosis.synthetic import NOISE_MM, PERIOD_S, recording, still_model, walk

ROWS = 1200


def posed(effect):
    """The problem of an arm whose tip moves by an effect (ROWS,) in mm, and features of it."""
    pressure = walk(ROWS)
    problem = problem_of(still_model(), [recording(effect, pressure)])
    u = problem.pressure
    features = np.concatenate([u, u**2, u[:, :1] * u[:, 1:]], axis=1)
    return problem, features / np.sqrt(np.square(features).sum(1).mean())


def plain(problem, features, ridge, behind=None):
    """(S, C) held-out remainder of a ridge regression, one fold after another."""
    ones = np.ones((len(features), 1))
    columns, penalty = np.hstack([ones, features]), [1e-3] + [ridge] * features.shape[1]
    if behind is not None:
        state = np.hstack([ones, problem.pressure]) * behind[:, None]
        columns, penalty = np.hstack([columns, state]), penalty + [BREAK_RIDGE] * state.shape[1]
    target = problem.residual.reshape(len(columns), -1)
    answer, fold = np.empty_like(target), problem.fold[problem.block]
    for number in np.unique(fold):
        out = fold == number
        normal = columns[~out].T @ columns[~out] + np.diag(penalty)
        solved = np.linalg.solve(normal, columns[~out].T @ target[~out])
        answer[out] = target[out] - columns[out] @ solved
    return answer


def test_losses_are_those_of_plain_regressions():
    """The best break is found by elimination; a regression with its columns leaves the same."""
    effect = 0.6 * (np.arange(ROWS) > 700)
    problem, features = posed(effect)
    found = beyond_history(problem, features)
    best = min((plain(problem, features, r) for r in RIDGES), key=lambda e: np.square(e).sum())
    assert found.losses.sum() == pytest.approx(np.square(best).sum(), rel=1e-3)
    rows = np.arange(len(features))
    behind = rows >= int(found.break_at * len(features))
    left = min(np.square(plain(problem, features, r, behind)).sum() for r in RIDGES)
    assert found.break_losses.sum() == pytest.approx(left, rel=0.01)


def test_the_ridge_is_the_best_on_held_out_blocks():
    """What the features explain well is not held back by the largest ridge."""
    problem, features = posed(np.zeros(ROWS))
    tip = 2.0 * features[:, 0]
    residual = problem.residual.copy()
    residual[:, -1, 0] += tip
    measured = problem.predicted + residual
    problem = replace(problem, measured=measured)
    found = beyond_history(problem, features)
    losses = [np.square(plain(problem, features, r)).sum() for r in RIDGES]
    assert found.losses.sum() == pytest.approx(min(losses), rel=1e-3)
    assert losses[-1] > 1.1 * min(losses)


def test_a_knock_is_a_break_and_a_function_of_the_actuation_is_none():
    pressure = walk(ROWS)[:, 0]
    found = beyond_history(*posed(0.6 * (np.arange(ROWS) > 700)))
    assert found.break_at == pytest.approx(700 / ROWS, abs=0.05)
    assert found.break_losses.sum() < 0.5 * found.losses.sum()
    still = beyond_history(*posed(0.02 * (pressure - 5.0) ** 2))
    assert still.break_losses.sum() > 0.95 * still.losses.sum()


def test_a_breath_is_a_line_and_a_periodic_actuation_is_none():
    """A sine holds all of the power above the noise; one that the actuation has too, none of it."""
    time = PERIOD_S * np.arange(ROWS)
    breath = 0.5 * np.sin(2 * np.pi * 0.21 * time)
    problem, features = posed(breath)
    found = beyond_history(problem, features)
    assert found.line == pytest.approx(1.0, abs=0.2)
    assert found.line_hz == pytest.approx(0.21, abs=0.01)
    wave = 5.0 + 4.0 * np.sin(2 * np.pi * 0.21 * time)
    driven = problem_of(
        still_model(), [recording(0.5 * np.cos(2 * np.pi * 0.21 * time), np.stack([wave, wave], 1))]
    )
    assert beyond_history(driven, driven.pressure).line < 0.2
    assert beyond_history(*posed(np.zeros(ROWS))).line < 0.2


def turned_body(angle):
    """The problem of an arm whose whole body is turned about y by an angle (ROWS,) in rad."""
    made = recording(np.zeros(ROWS), walk(ROWS))
    x, y, z = np.moveaxis(made.key_points_mm, -1, 0)
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    turned = np.stack([c * x + s * z, y, c * z - s * x], axis=-1)
    model = still_model()
    model.validation = Validation(1e-3, (1e-3,) * 3, ROWS)  # nothing is left to the discrepancy
    return problem_of(model, [replace(made, key_points_mm=turned)])


def noise_of(problem):
    """Squared noise of all key points and rows, mm^2."""
    return 3 * 3 * NOISE_MM**2 * len(problem.predicted)


def test_a_sudden_turn_is_found_at_its_moment_and_leaves_the_noise():
    """0.02 rad at three fifths: it moves key points at 5, 30 and 70 mm by 0.1, 0.6 and 1.4 mm."""
    problem = turned_body(0.02 * (np.arange(ROWS) >= 0.6 * ROWS))
    found = sudden_turn(split_of(problem), problem.predicted)
    assert found.at == pytest.approx(0.6, abs=1e-6)
    assert found.losses.sum() == pytest.approx(noise_of(problem), rel=0.1)
    assert np.square(problem.residual).sum() > 5 * found.losses.sum()


def test_a_sudden_shift_of_the_whole_body_is_one_too():
    """0.5 mm of all key points along y at three fifths: no turn does that."""
    made = recording(np.zeros(ROWS), walk(ROWS))
    moved = made.key_points_mm.copy()
    moved[np.arange(ROWS) >= 0.6 * ROWS, :, 1] += 0.5
    model = still_model()
    model.validation = Validation(1e-3, (1e-3,) * 3, ROWS)
    problem = problem_of(model, [replace(made, key_points_mm=moved)])
    found = sudden_turn(split_of(problem), problem.predicted)
    assert found.losses.sum() == pytest.approx(noise_of(problem), rel=0.1)
    assert np.square(problem.residual).sum() > 5 * found.losses.sum()


def test_moments_between_two_that_were_tried_come_up_to_these():
    """With eight steps between two neighbours the outermost are an eighth away from them."""
    tried = coarse()
    step = tried[1] - tried[0]
    near = finer(tried[10])
    np.testing.assert_allclose(near[[0, 7, -1]], tried[10] + step * np.array([-7, 0, 7]) / 8.0)
    np.testing.assert_allclose(np.diff(near), step / 8.0)


def test_what_grows_is_no_sudden_turn():
    """The best step for a line leaves 1/3 - (1 - m) (1 + m)^2 / 4 of 1/3: a ninth, at m = 1/3."""
    problem = turned_body(0.1 * np.arange(ROWS) / ROWS)
    found = sudden_turn(split_of(problem), problem.predicted)
    left = found.losses.sum() - noise_of(problem)
    assert left / (np.square(problem.residual).sum() - noise_of(problem)) > 0.9 / 9
    assert found.at == pytest.approx(1 / 3, abs=0.06)


def test_what_is_there_from_the_beginning_is_no_sudden_turn():
    """The first moment that is tried leaves the rows before it, a twenty-fifth of the change."""
    problem = turned_body(np.full(ROWS, 0.1))
    found = sudden_turn(split_of(problem), problem.predicted)
    left = found.losses.sum() - noise_of(problem)
    assert left / (np.square(problem.residual).sum() - noise_of(problem)) > 0.9 / 25
    assert found.at == pytest.approx(0.04, abs=1e-6)


def test_a_knock_is_better_explained_by_a_turn_at_one_moment_and_a_drift_is_not():
    """Beside misalignment and drift, which both imitate it."""
    time, margins, moments = np.arange(ROWS) / ROWS, [], []
    for shape in (time > 0.42, 1.0 - np.exp(-4.0 * time)):
        problem = turned_body(0.05 * shape)
        found = select(problem, candidates(problem, ["misalignment", "drift"]), lambda text: None)
        gain, at_s = sudden_gain(found)
        margins.append(studentised(problem.by_motion(gain[None]))[0])
        moments.append(at_s)
    assert margins[0] > 3.0
    # Between two of the moments of the first search, 0.40 and 0.44.
    assert moments[0] == pytest.approx(0.42 * ROWS * PERIOD_S, abs=0.006 * ROWS * PERIOD_S)
    assert margins[1] < -3.0


def test_an_effect_of_the_actuation_is_compared_with_no_sudden_turn():
    pressure = walk(ROWS)
    problem = problem_of(still_model(), [recording(0.1 * pressure[:, 0], pressure)])
    found = select(problem, candidates(problem, ["payload"]), lambda text: None)
    gain, at_s = sudden_gain(found)
    assert not gain.any()
    assert at_s == 0.0
