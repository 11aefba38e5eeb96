"""The spline against polynomials that it must reproduce and arcs with known tangents."""

import math

import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.backbone import ArcBackbone, Backbone, require_body

REST = torch.tensor([[0.0, 0.0, z] for z in (0.0, 17.5, 35.0, 52.5, 70.0)])


def arc(angle: float, share: torch.Tensor, length: float = 70.0) -> torch.Tensor:
    """(K, 3) points of a planar circular arc at shares of its length."""
    radius = length / angle
    turned = angle * share
    return torch.stack(
        [radius * (1 - turned.cos()), torch.zeros_like(share), radius * turned.sin()], -1
    )


def test_straight_arm_stays_straight_and_reaches_both_ends():
    backbone = Backbone.through(REST, samples=11)
    line = backbone.centreline(REST)
    assert torch.allclose(line[:, 2], torch.linspace(0, 70, 11), atol=1e-4)
    assert torch.allclose(backbone.tip_direction(REST), torch.tensor([0.0, 0.0, 1.0]), atol=1e-6)


def test_cubics_are_reproduced_exactly():
    """An interpolating cubic spline with not-a-knot ends contains every cubic."""
    backbone = Backbone.through(REST, samples=33)
    u = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0], dtype=torch.float64)
    dense = torch.linspace(0, 1, 33, dtype=torch.float64)

    def cubic(x):
        return torch.stack([30 * x**3 - 9 * x, 12 * x**2 + x**3, 70 * x], -1)

    line = backbone.centreline(cubic(u).float())
    assert torch.allclose(line.double(), cubic(dense), atol=1e-4)
    slope = torch.stack([90 * dense**2 - 9, 24 * dense + 3 * dense**2, 0 * dense + 70], -1)
    tangent = torch.nn.functional.normalize(slope, dim=-1)
    assert torch.allclose(backbone.tangents(cubic(u).float()).double(), tangent, atol=1e-5)


def test_error_on_an_arc_falls_with_the_fourth_power_of_the_spacing():
    angle, errors = math.pi / 2, []
    for points in (5, 9, 17):
        share = torch.linspace(0, 1, points)
        rest = torch.stack([0 * share, 0 * share, 70 * share], -1)
        backbone = Backbone.through(rest, samples=201)
        dense = torch.linspace(0, 1, 201, dtype=torch.float64)
        line = backbone.position.double() @ arc(angle, share.double())
        errors.append(float((line - arc(angle, dense)).norm(dim=-1).max()))
    assert errors[0] < 0.15
    # Spacing halves: the error of a cubic spline falls 16 times.
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.5)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.5)


def test_batches_are_rows_of_the_same_matrix():
    backbone = Backbone.through(REST)
    batch = torch.randn(4, 6, 5, 3)
    line = backbone.centreline(batch)
    assert line.shape == (4, 6, 21, 3)
    assert torch.allclose(line[2, 3], backbone.centreline(batch[2, 3]), atol=1e-5)


def test_two_key_points_make_a_line_and_one_is_refused():
    backbone = Backbone.through(REST[:2], samples=3)
    assert torch.allclose(backbone.centreline(REST[:2])[1], torch.tensor([0.0, 0.0, 8.75]))
    with pytest.raises(InputError, match="at least 2"):
        Backbone.through(REST[:1])
    with pytest.raises(InputError, match="coincide"):
        Backbone.through(torch.zeros(3, 3))


def test_at_the_key_points_it_passes_through_them_and_along_the_arc():
    """Uneven spacing; the tangents of an arc of 0.5 rad, within 2e-3."""
    share = torch.tensor([0.0, 0.2, 0.45, 0.7, 1.0], dtype=torch.float64)
    rest = torch.stack([0 * share, 0 * share, 70 * share], -1)
    backbone = Backbone.at_key_points(rest)
    torch.testing.assert_close(backbone.position, torch.eye(5), atol=1e-6, rtol=0.0)
    angle = 0.5 * share
    expected = torch.stack([angle.sin(), 0 * angle, angle.cos()], -1).float()
    found = backbone.tangents(arc(0.5, share).float())
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0.0)


def turned(axis: list[float], angle: float) -> torch.Tensor:
    """(3, 3) rotation about an axis by Rodrigues' formula."""
    x, y, z = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.eye(3).double() + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


@pytest.mark.parametrize("angle", [1e-5, 1e-3, 0.3, math.pi / 2, 2.5, 5.0])
def test_the_tip_alone_gives_back_the_arc_it_is_the_end_of(angle):
    """Arcs of a known angle, turned about the base's axis, on a base somewhere in the world."""
    share = torch.linspace(0.0, 1.0, 13, dtype=torch.float64)
    base = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    lines, aims = [], []
    for row, (azimuth, length) in enumerate([(0.0, 70.0), (2.0, 35.0), (-1.1, 140.0)]):
        base[row, :3, :3] = turned([1.0, 2.0, -0.5], 0.7 * row)
        base[row, :3, 3] = torch.tensor([10.0, -20.0, 30.0]) * row
        place = base[row, :3, :3] @ turned([0.0, 0.0, 1.0], azimuth)
        lines.append(arc(angle, share, length) @ place.T + base[row, :3, 3])
        aims.append(place @ torch.tensor([math.sin(angle), 0.0, math.cos(angle)]).double())
    line, aim = torch.stack(lines), torch.stack(aims)
    found = ArcBackbone.of(13)
    given = line[:, -1:].float(), base.float()
    torch.testing.assert_close(found.centreline(*given).double(), line, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.tip_direction(*given).double(), aim, rtol=0, atol=2e-6)
    alone = found.centreline(arc(angle, share)[-1:].float()).double()
    torch.testing.assert_close(alone, arc(angle, share), rtol=0, atol=1e-4)


def test_a_tip_behind_its_base_has_a_finite_body():
    tip = torch.tensor([[[0.0, 0.0, -70.0]], [[0.0, 0.0, 0.0]]])
    assert ArcBackbone.of(5).centreline(tip).isfinite().all()
    assert ArcBackbone.of(5).tip_direction(tip).isfinite().all()


def tip_at(bend: float, azimuth: float = 0.4) -> torch.Tensor:
    """(1, 3) mm: end of an arc of 70 mm that turns by `bend`, rad."""
    x, _, z = arc(bend, torch.ones(1, dtype=torch.float64))[0].tolist()
    return torch.tensor([[x * math.cos(azimuth), x * math.sin(azimuth), z]])


@pytest.mark.parametrize(
    ("chambers", "length_mm", "bend", "message"),
    [
        (4, 70.0, 1.0, None),
        (3, None, 1.0, None),
        (3, 84.0, 1.0, None),
        (3, 59.0, 1.0, None),
        (5, 70.0, 1.0, "has 5 chambers, several segments with one key point"),
        (3, 90.0, 1.0, "states a length of 90 mm, and the arc from the origin .* has 70 mm"),
        (3, None, 1.2, "has its only key point 34 degrees from the z axis at rest, expected at"),
        (3, None, 6.0, "has its only key point 172 degrees"),
    ],
)
def test_an_arc_is_refused_where_it_is_not_the_body(chambers, length_mm, bend, message):
    spec = ArmSpec(chambers, 1, (0.0,) * chambers, (1.0,) * chambers, length_mm=length_mm)
    if message is None:
        require_body(spec, tip_at(bend), "arm 'a'")
        return
    with pytest.raises(
        InputError, match=f"^arm 'a' {message}.* does not follow from its tip; .*or track_body$"
    ):
        require_body(spec, tip_at(bend), "arm 'a'")
    many = ArmSpec(chambers, 2, spec.low, spec.high, length_mm=length_mm)
    require_body(many, torch.cat((torch.zeros(1, 3), tip_at(bend))), "arm 'a'")
