"""Blocks of an observation that several tasks share, by hand."""

from dataclasses import replace

import pytest
import torch

from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.tasks.observations import body_blocks
from surgisoft.tasks.world.observer import Belief
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.world import Mounted, World


@pytest.fixture(scope="module")
def mounted():
    """An arm away from the world's origin at the begin of an episode."""
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([100.0, -50.0, 25.0])
    arm = World({"arm": Mounted(default_arm(), pose)}).arms["arm"]
    return arm, arm.start(streams(0, 1))[1]


def seen(arm, part):
    return {block.name: value[0] for block, value in body_blocks(arm, part).items()}


def test_a_body_is_seen_as_measured_from_its_base(mounted):
    arm, part = mounted
    measured = part.points_mm + 2.0
    blocks = seen(arm, replace(part, seen_mm=measured))
    from_base = measured[0, 1:] - torch.tensor([100.0, -50.0, 25.0])
    torch.testing.assert_close(blocks["shape"], (from_base / 50.0).flatten())


def test_pressures_are_seen_as_measured_in_their_range(mounted):
    arm, part = mounted
    middle = 0.5 * (arm.low + arm.high)
    blocks = seen(arm, replace(part, command=arm.high[None], seen_kPa=middle[None]))
    torch.testing.assert_close(blocks["command"], torch.ones(arm.chambers))
    torch.testing.assert_close(blocks["pressure"], torch.zeros(arm.chambers))


def test_the_model_beside_the_arm_tells_direction_and_reversal(mounted):
    """That of the observer where there is one, which does not know the arm's true memory."""
    arm, part = mounted
    band = arm.model.band
    falling = replace(
        part.arm, anchor=part.arm.pressure + 0.5 * band, direction=-torch.ones_like(part.command)
    )
    rising = replace(
        part.arm, anchor=part.arm.pressure - 0.25 * band, direction=torch.ones_like(part.command)
    )
    zero = torch.zeros_like(part.points_mm)
    for belief, direction, reversal in (
        (None, -1.0, -0.5),
        (Belief(rising, zero, zero, zero[:, :1]), 1.0, 0.25),
    ):
        blocks = seen(arm, replace(part, arm=falling, belief=belief))
        assert blocks["direction"].tolist() == [direction] * arm.chambers
        assert blocks["reversal"].tolist() == pytest.approx([reversal] * arm.chambers, abs=1e-4)
