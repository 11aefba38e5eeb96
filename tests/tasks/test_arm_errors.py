"""Model errors of an arm: displacements of its key points, against closed forms."""

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature
from surgisoft.surrogate.reach import steady_key_points
from surgisoft.tasks.world.arm_errors import ArmErrors, ErrorPrior

LENGTH_MM = 100.0
POINTS = 9
PUSHES, MOUNT = 12, 6
"""Parameters of the pushes of three chambers, and of the mount."""
OWN = 2
"""Parameters of a segment that are a share of its own bending and stretch; 12 others follow."""


def arc(curvature, length_mm=LENGTH_MM):
    """(n, 3) mm: an arc in the plane of x and z whose base points along z; curvature in 1/mm."""
    s = np.linspace(0.0, length_mm, POINTS)
    x, z = (1.0 - np.cos(curvature * s)) / curvature, np.sin(curvature * s) / curvature
    return np.column_stack((x, np.zeros_like(s), z))


@pytest.fixture(scope="module")
def arm():
    low, high = torch.zeros(3), torch.full((3,), 40.0)
    spec = ArmSpec(3, POINTS, (0.0,) * 3, (40.0,) * 3, length_mm=LENGTH_MM)
    network = ConstantCurvature(low, high, key_points=POINTS)
    network.set_rest(torch.tensor(arc(1e-9), dtype=torch.float32))
    return ArmModel(spec, network)


def straight(arm):
    """(n, 3) mm: the body at rest."""
    return steady_key_points(arm, np.zeros((1, 3)))[0]


def rows(arm, body, pressure=20.0, prior=None):
    """(n, 3, F) mm: displacements of one body (n, 3) mm."""
    errors = ArmErrors(arm, prior or ErrorPrior())
    points = torch.tensor(body, dtype=torch.float32)[None]
    found = errors.displacements(torch.full((1, 3), pressure), points)[0]
    return found.double().numpy().reshape(len(body), 3, -1)


def of_segments(found):
    """(n, 3, n - 1, 14): the part of the segments."""
    size = (POINTS - 1) * (OWN + 12)
    some = found[:, :, PUSHES + MOUNT : PUSHES + MOUNT + size]
    return some.reshape(*found.shape[:2], POINTS - 1, OWN + 12)


def test_a_chamber_that_pushes_more_moves_the_body_as_more_pressure_does():
    """Against differences of the default arm's own steady states, within 2 % of the largest."""
    model, prior = default_arm(), ErrorPrior()
    errors = ArmErrors(model, prior)
    at = np.array([[10.0, 25.0, 5.0], [0.0, 40.0, 30.0]])
    body = torch.tensor(steady_key_points(model, at), dtype=torch.float32)
    found = errors.displacements(torch.tensor(at, dtype=torch.float32), body)
    found = found.double().numpy().reshape(2, -1, 3, errors.count)
    reach = errors.reach.numpy()
    for chamber in range(3):
        probe = 0.2 * np.eye(3)[chamber]
        ends = [steady_key_points(model, at + sign * probe) for sign in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / 0.4
        close = {"atol": 0.03 * np.abs(slope).max() * prior.push_kPa}
        np.testing.assert_allclose(found[..., chamber], prior.push_kPa * slope, rtol=0.0, **close)
        for other in range(3):
            load = (at[:, other] - model.spec.rest[other]) / reach[other]
            push = prior.push_share * reach[chamber] * load[:, None, None] * slope
            close = {"atol": 0.03 * np.abs(push).max() + 1e-9}
            column = found[..., 3 + 3 * chamber + other]
            np.testing.assert_allclose(column, push, rtol=0.0, **close)


def test_the_mount_shifts_and_turns_the_body_rigidly(arm):
    body, prior = arc(0.01), ErrorPrior()
    found = rows(arm, body)[:, :, PUSHES : PUSHES + MOUNT]
    for axis in range(3):
        np.testing.assert_allclose(found[:, :, axis], np.tile(0.5 * np.eye(3)[axis], (POINTS, 1)))
        turned = prior.turn_rad * np.cross(np.eye(3)[axis], body)
        np.testing.assert_allclose(found[:, :, 3 + axis], turned, atol=1e-5)


def test_segments_that_all_bend_more_make_an_arc_of_larger_curvature(arm):
    """The derivative of the arc by its curvature, in closed form, within 2 % at the tip."""
    curvature, prior = 0.012, ErrorPrior()
    found = of_segments(rows(arm, arc(curvature)))[..., 0].sum(2)
    step = 1e-6
    slope = (arc(curvature * (1.0 + step)) - arc(curvature * (1.0 - step))) / (2.0 * step)
    np.testing.assert_allclose(found, prior.bend_share * slope, atol=0.02 * prior.bend_share * 60.0)
    assert np.linalg.norm(slope[-1]) > 40.0


def test_segments_that_stretch_more_make_a_longer_arm(arm):
    """A straight arm that is 10 % longer than at rest, and whose stretch is 5 % larger."""
    longer = 1.1 * straight(arm)
    prior = ErrorPrior()
    segments = of_segments(rows(arm, longer))
    expected = prior.bend_share * (longer - straight(arm))
    np.testing.assert_allclose(segments[..., 1].sum(2), expected, atol=1e-4)
    constant = prior.stretch_share * longer
    np.testing.assert_allclose(segments[..., OWN + 8].sum(2), constant, atol=1e-4)
    np.testing.assert_allclose(segments[..., OWN + 9].sum(2), 0.5 * constant, atol=1e-4)


def test_one_segment_bends_all_that_is_beyond_it_about_its_middle(arm):
    """Across the plane of the arc, by the angle of the prior; nothing before it moves."""
    body, segment = arc(0.01), 3
    found = of_segments(rows(arm, body))[:, :, segment, OWN : OWN + 8 : 4]
    assert np.abs(found[: segment + 1]).max() == 0.0
    middle = 0.5 * (body[segment] + body[segment + 1])
    across = np.linalg.norm(found[-1], axis=0)
    lever = body[-1] - middle
    angles = np.arctan2(lever[0], lever[2])
    tangent = 0.01 * LENGTH_MM * segment / (POINTS - 1)
    in_plane, out_of_it = across[1], across[0]
    assert in_plane == pytest.approx(0.0075 * np.linalg.norm(lever), rel=1e-3)
    off_axis = np.linalg.norm(lever) * abs(np.cos(angles - tangent))
    assert out_of_it == pytest.approx(0.0075 * off_axis, rel=1e-2)


def test_key_planes_shift_along_the_axes_of_their_own_frames(arm):
    body = arc(0.01)
    found = rows(arm, body)[:, :, -3 * POINTS :].reshape(POINTS, 3, POINTS, 3)
    for point in range(POINTS):
        own = found[point, :, point] / 0.15
        np.testing.assert_allclose(own.T @ own, np.eye(3), atol=1e-5)
        angle = 0.01 * LENGTH_MM * point / (POINTS - 1)
        np.testing.assert_allclose(own[:, 2], [np.sin(angle), 0.0, np.cos(angle)], atol=5e-3)
        others = np.delete(found[point], point, axis=1)
        assert np.abs(others).max() == 0.0


def test_the_prior_says_what_is_wrong_with_it():
    with pytest.raises(InputError, match=r"bend_rad is -1.0, expected more than 0"):
        ErrorPrior(bend_rad=-1.0)
