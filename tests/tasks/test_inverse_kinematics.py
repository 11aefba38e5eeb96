"""Inverse kinematics: what it returns where a step or a second start makes things worse."""

from dataclasses import dataclass

import pytest
import torch

from surgisoft.tasks.inverse_kinematics import action_towards, least_squares


def test_a_step_that_overshoots_is_not_taken():
    """Newton's step for atan from 3 leads to -9.5, where atan is larger."""
    start, far = torch.tensor([[3.0]]), torch.full((1, 1), 100.0)
    best = least_squares(torch.atan, start, -far, far, damping=1e-6, iterations=1)
    assert best.item() == 3.0
    found = least_squares(torch.atan, start, -far, far, damping=1e-6, iterations=20)
    assert found.item() == pytest.approx(0.0, abs=1e-4)


@dataclass(frozen=True)
class Part:
    """An arm at a pressure."""

    pressure: torch.Tensor


class Jumping:
    """An arm of one chamber whose tip jumps and turns back where its pressure falls below 0."""

    def predict(self, part, pressure, dt_s):
        x = torch.where(pressure < 0.0, -pressure - 4.0, pressure - 2.0)
        return torch.nn.functional.pad(x, (0, 2))[:, None]

    def within_reach(self, part, dt_s):
        one = torch.ones_like(part.pressure)
        return -one, one

    def action_for(self, part, pressure, dt_s):
        return pressure


def test_of_several_starts_the_best_result_is_taken():
    """The target is out of reach: 4 mm are left at 1 kPa, and 6 from the start that falls."""

    def error(points, target):
        return points[:, 0, :1] - target

    for start, expected in ((0.0, 1.0), (-0.5, 1.0)):
        part, target = Part(torch.tensor([[start]])), torch.tensor([[3.0]])
        found = action_towards(Jumping(), part, target, error, 0.1)
        assert found.item() == pytest.approx(expected)


def test_a_row_that_is_solved_does_not_hold_the_others():
    """Roots of 4, 9, 2 and 3; the first row begins at its own, so that no step helps it."""
    target = torch.tensor([[4.0, 9.0], [2.0, 3.0]])
    start = torch.tensor([[2.0, 3.0], [1.0, 1.0]])
    low, high = torch.zeros_like(start), torch.full_like(start, 10.0)
    found = least_squares(lambda x: x.square() - target, start, low, high, iterations=8)
    torch.testing.assert_close(found, target.sqrt(), rtol=0.0, atol=1e-5)


def test_a_search_along_a_limit_ends_at_the_minimum_there():
    """The minimum of |A x - b| over x >= 0 lies on the limit x_0 = 0, where a line of one unknown
    has its own. Steps for both unknowns that are clipped to the limit end beside it."""
    matrix = torch.tensor([[1.0, 1.0], [0.0, 0.1]])
    wanted = matrix @ torch.tensor([-30.0, 33.5])
    start, low, high = torch.tensor([[0.0, 2.0]]), torch.zeros(1, 2), torch.full((1, 2), 100.0)

    def residual(x):
        return x @ matrix.mT - wanted

    by_hand = (matrix[:, 1] @ wanted) / matrix[:, 1].square().sum()
    found = least_squares(residual, start, low, high, iterations=20, hold_at_limits=True)
    assert found[0, 0] == 0.0
    assert found[0, 1].item() == pytest.approx(by_hand.item(), abs=1e-3)
    clipped = least_squares(residual, start, low, high, iterations=20)
    assert abs(clipped[0, 1].item() - by_hand.item()) > 0.1
