"""Breaks and lines in what a black box leaves, against plain regressions and known amplitudes."""

import numpy as np
import pytest

from surgisoft.diagnosis.beyond_history import BREAK_RIDGE, RIDGES, beyond_history
from surgisoft.diagnosis.residuals import problem_of
from tests.diagnosis.synthetic import PERIOD_S, recording, still_model, walk

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
    assert beyond_history(problem, features).line == pytest.approx(1.0, abs=0.2)
    wave = 5.0 + 4.0 * np.sin(2 * np.pi * 0.21 * time)
    driven = problem_of(
        still_model(), [recording(0.5 * np.cos(2 * np.pi * 0.21 * time), np.stack([wave, wave], 1))]
    )
    assert beyond_history(driven, driven.pressure).line < 0.2
    assert beyond_history(*posed(np.zeros(ROWS))).line < 0.2
