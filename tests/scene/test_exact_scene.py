"""FCL with the batched interface: the results equal those of single queries."""

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.collision import ExactScene
from surgisoft.scene.mesh import Body
from tests.scene.shapes import ball, box

RADII = {"laser": 6.0, "endoscope": 5.0}


@pytest.fixture(scope="module")
def engines():
    pose = np.eye(4)
    pose[:3, 3] = [60.0, 0.0, 0.0]
    bodies = (Body("organ", "organ", ball(30.0, 3)), Body("block", "keep-out", box(), pose))
    return ExactScene(bodies, RADII), BatchedScene(bodies, RADII)


@pytest.fixture(scope="module")
def arms():
    """Twelve pairs of straight arms about the bodies, some inside them."""
    rng = torch.Generator().manual_seed(3)
    share = torch.linspace(0.0, 1.0, 9)[:, None]
    lines = {}
    for name in RADII:
        ends = 70.0 * (torch.rand(12, 2, 3, generator=rng) - 0.5) + torch.tensor([20.0, 0.0, 20.0])
        lines[name] = ends[:, None, 0] + share * (ends[:, None, 1] - ends[:, None, 0])
    return lines


def test_clearances_are_the_batched_engines_near_contact(engines, arms):
    exact, fast = (engine.clearance(arms) for engine in engines)
    for name in ("bodies_mm", "arms_mm", "self_mm"):
        one, other = getattr(exact, name), getattr(fast, name)
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        near = one.abs() < 5.0
        torch.testing.assert_close(one[near], other[near], rtol=0, atol=0.1)
    assert torch.equal(exact.collides, fast.collides)
    assert exact.collides.any()


def test_hits_are_the_batched_engines(engines, arms):
    rng = torch.Generator().manual_seed(4)
    origins = 120.0 * (torch.rand(12, 2, 3, generator=rng) - 0.5)
    aims = torch.nn.functional.normalize(torch.tensor([10.0, 0.0, 0.0]) - origins, dim=2)
    exact, fast = (engine.cast(origins, aims, 200.0, arms, own="laser") for engine in engines)
    assert torch.equal(exact.struck, fast.struck)
    torch.testing.assert_close(exact.point_mm, fast.point_mm, rtol=0, atol=1e-3)
    for name in vars(exact):
        one, other = getattr(exact, name), getattr(fast, name)
        assert one.shape == other.shape
        assert one.dtype == other.dtype, name


def test_an_arm_that_is_not_finite_harms_nobody(engines, arms):
    bad = {name: line.clone() for name, line in arms.items()}
    bad["laser"][4, 2] = float("nan")
    exact, fine = engines[0].clearance(bad), engines[0].clearance(arms)
    assert exact.bodies_mm[4].isnan().all()
    others = torch.arange(12) != 4
    assert torch.equal(exact.bodies_mm[others], fine.bodies_mm[others])
    hit = engines[0].cast(bad["laser"][:, 2], torch.ones(12, 3), 50.0, bad, own="laser")
    assert hit.point_mm.isfinite().all()
    assert hit.struck[4] == 0


def test_an_unknown_arm_is_told(engines):
    with pytest.raises(InputError, match=r"needle.*laser"):
        engines[0].clearance({"needle": torch.zeros(1, 2, 3)})
