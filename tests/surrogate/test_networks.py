"""HAW-NN's formulas by hand, and the constant-curvature arc in closed form."""

import math

import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.networks import (
    ConstantCurvature,
    HawEnsemble,
    HawNN,
    KernelArm,
    arc_point,
    arc_rotation,
    parse_widths,
    range_weights,
    weighted_mse,
)

LOW, HIGH = torch.tensor([-15.0, -15.0, -15.0]), torch.tensor([54.0, 54.0, 54.0])


def test_the_papers_layout():
    network = HawNN(LOW, HIGH, key_points=5)
    linear = [layer for layer in network.layers if isinstance(layer, torch.nn.Linear)]
    widths = [(layer.in_features, layer.out_features) for layer in linear]
    assert widths == [(6, 128), (128, 128), (128, 128), (128, 128), (128, 15)]
    assert HawNN(LOW, HIGH, 5, directions=False).layers[0].in_features == 3


def test_range_weights_by_hand():
    """Ranges 0, 1 | 3, 0 | 0, 4 over 6 coordinates: w = 1 + 6 r / 8."""
    points = torch.tensor([[[0.0, 1.0, 0.0], [5.0, 0.0, 2.0]], [[0.0, 2.0, 3.0], [5.0, 0.0, 6.0]]])
    expected = 1 + 6 * torch.tensor([[0.0, 1.0, 3.0], [0.0, 0.0, 4.0]]) / 8
    assert torch.allclose(range_weights(points), expected)
    points = torch.cat([points, torch.full((1, 2, 3), torch.nan)])
    assert torch.allclose(range_weights(points), expected)


def test_weighted_mse_by_hand_without_missing_values():
    predicted = torch.zeros(2, 1, 3)
    measured = torch.tensor([[[1.0, 2.0, torch.nan]], [[0.0, 1.0, 3.0]]])
    weights = torch.tensor([[1.0, 2.0, 3.0]])
    # (1*1 + 2*4 + 1*0 + 2*1 + 3*9) / 5 measured values
    assert float(weighted_mse(predicted, measured, weights)) == pytest.approx(38 / 5)


def test_added_directions_change_nothing_at_first():
    torch.manual_seed(0)
    plain = HawNN(LOW, HIGH, 5, directions=False)
    plain.mean.normal_()
    grown = plain.with_directions(torch.tensor([1.0, 0.0, 1.0]))
    pressure, direction = torch.rand(20, 3) * 60 - 10, torch.randn(20, 3).sign()
    assert torch.allclose(grown(pressure, direction), plain(pressure, direction), atol=1e-6)
    with torch.no_grad():
        grown.layers[0].weight[:, 3:] = 0.3
    moved = grown(pressure, direction)
    flipped = grown(pressure, direction * torch.tensor([1.0, -1.0, 1.0]))
    assert torch.equal(moved, flipped), "chamber 2 has no direction input"
    assert not torch.allclose(moved, plain(pressure, direction))


def test_widths_are_read_or_refused():
    assert parse_widths("64x32") == (64, 32)
    for wrong in ("64,many", "8,,8", "0", "-8", "4097", "9999999,9999999", ",".join(["8"] * 33)):
        with pytest.raises(InputError, match=rf"hidden widths '{wrong}': expected whole numbers"):
            parse_widths(wrong)
    assert parse_widths("4096," * 31 + "1") == (4096,) * 31 + (1,)


def test_arc_point_in_closed_form():
    quarter = arc_point(torch.tensor([math.pi / 2, 0.0]), torch.tensor(70.0))
    radius = 70 / (math.pi / 2)
    assert torch.allclose(quarter, torch.tensor([radius, 0.0, radius]), atol=1e-4)
    straight = arc_point(torch.zeros(2), torch.tensor(70.0))
    assert torch.allclose(straight, torch.tensor([0.0, 0.0, 70.0]), atol=1e-4)


def test_arc_rotation_turns_the_tangent():
    bend = torch.tensor([0.6, -0.8]) * 1.1
    tangent = arc_rotation(bend) @ torch.tensor([0.0, 0.0, 1.0])
    expected = torch.tensor([0.6 * math.sin(1.1), -0.8 * math.sin(1.1), math.cos(1.1)])
    assert torch.allclose(tangent, expected, atol=1e-5)


@pytest.mark.parametrize("sections", [1, 2, 4])
def test_equal_sections_make_one_arc(sections):
    """A chain of equal arcs is one longer arc, whatever the number of pieces."""
    model = ConstantCurvature(LOW, HIGH, 5, sections)
    model.set_rest(torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(5)]))
    with torch.no_grad():
        model.table[:, 0, -1] = 1.2 / sections
    points = model(torch.zeros(1, 3), torch.zeros(1, 3))[0]
    share = torch.linspace(0, 1, 5)[:, None]
    expected = arc_point(torch.tensor([1.2, 0.0]) * share, 70 * share[:, 0])
    assert torch.allclose(points, expected, atol=1e-3)


def made(seed: int) -> HawNN:
    """A network with random weights and an output scale."""
    torch.manual_seed(seed)
    network = HawNN(LOW, HIGH, 5, hidden=(16, 16))
    network.mean.copy_(torch.arange(15.0))
    network.scale.fill_(7.0)
    return network


def test_an_ensemble_of_identical_members_is_one_of_them():
    one = made(0)
    ensemble = HawEnsemble.of([one] * 4)
    pressure, direction = torch.rand(2, 20, 3) * 60 - 10, torch.randn(2, 20, 3).sign()
    assert torch.allclose(ensemble(pressure, direction), one(pressure, direction), atol=1e-5)


def test_an_ensemble_is_the_mean_of_its_members():
    networks = [made(seed) for seed in range(3)]
    ensemble = HawEnsemble.of(networks)
    pressure, direction = torch.rand(20, 3) * 60 - 10, torch.randn(20, 3).sign()
    each = torch.stack([network(pressure, direction) for network in networks])
    assert torch.allclose(ensemble.each(pressure, direction), each, atol=1e-5)
    assert torch.allclose(ensemble(pressure, direction), each.mean(0), atol=1e-5)
    other = torch.rand(3, 7, 3) * 60 - 10, torch.randn(3, 7, 3).sign()
    apart = torch.stack([network(*(x[k] for x in other)) for k, network in enumerate(networks)])
    assert torch.allclose(ensemble.members_at(*other), apart, atol=1e-5)


def test_an_ensemble_has_no_direction_of_a_chamber_that_its_members_have_none_of():
    networks = [made(seed) for seed in range(3)]
    for network in networks:
        network.use.copy_(torch.tensor([1.0, 0.0, 1.0]))
    ensemble = HawEnsemble.of(networks)
    pressure, direction = torch.rand(20, 3) * 60 - 10, torch.randn(20, 3).sign()
    expected = torch.stack([network(pressure, direction) for network in networks])
    assert torch.allclose(ensemble.each(pressure, direction), expected, atol=1e-5)
    flipped = direction * torch.tensor([1.0, -1.0, 1.0])
    assert torch.equal(ensemble(pressure, direction), ensemble(pressure, flipped))
    three = [torch.stack([x] * 3) for x in (pressure, flipped)]
    assert torch.allclose(ensemble.members_at(*three), expected, atol=1e-5)


def test_a_section_stretches_by_its_exponential_and_bends_by_its_pressures():
    """A factor of 1.2 in all at no pressure; at full pressure of chamber 2 by 1.5 more."""
    model = ConstantCurvature(LOW, HIGH, 3, 1)
    model.set_rest(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 35.0], [0.0, 0.0, 70.0]]))
    with torch.no_grad():
        model.table[0, 2, -1], model.table[0, 2, 1] = math.log(1.2), math.log(1.5)
        model.table[0, 1, 0] = 0.4
    middle = (LOW + HIGH) / 2.0
    stretched, bent = middle.clone(), middle.clone()
    stretched[1], bent[0] = HIGH[1], LOW[0]
    points = model(torch.stack((middle, stretched, bent)), torch.zeros(3, 3))
    assert torch.allclose(points[0, :, 2], 1.2 * torch.tensor([0.0, 35.0, 70.0]), atol=1e-3)
    assert torch.allclose(points[1, :, 2], 1.8 * torch.tensor([0.0, 35.0, 70.0]), atol=1e-3)
    expected = arc_point(torch.tensor([0.0, -0.4]), torch.tensor(84.0))
    assert torch.allclose(points[2, -1], expected, atol=1e-3)


def test_inputs_of_kernel_regression_by_hand():
    """Pressures in half ranges from the middle, and how far they are ahead of their low passes:
    fitted models hold places of these."""
    kernel = KernelArm(torch.zeros(2), torch.tensor([20.0, 40.0]), 3, 2, 4, times_s=(0.5, 2.0))
    pressure = torch.tensor([[15.0, 10.0]])
    memory = torch.tensor([[[10.0, 5.0], [10.0, 30.0]]])
    found = kernel.inputs(pressure, memory)[0].tolist()
    assert found == pytest.approx([0.5, -0.5, 0.5, 1.0, 0.0, -1.0])
    assert kernel.inputs(pressure)[0].tolist() == pytest.approx([0.5, -0.5, 0.0, 0.0, 0.0, 0.0])
    held = kernel.advance(memory, pressure, pressure, torch.tensor([0.5]))
    keep = torch.tensor([math.exp(-1.0), math.exp(-0.25)])
    assert torch.allclose(held, pressure[..., None] + keep * (memory - pressure[..., None]))


def test_what_was_not_measured_does_not_count():
    """Two key points, of which the second was lost in the second row; the first is off by 1 mm."""
    measured = torch.zeros(2, 2, 3)
    predicted = measured + torch.tensor([1.0, 0.0, 0.0])
    predicted[1, 1] = 50.0
    measured[1, 1] = torch.nan
    weights = torch.ones(2, 3)
    assert float(weighted_mse(predicted, measured, weights)) == pytest.approx(3.0 / 9.0)
    predicted.requires_grad_(True)
    weighted_mse(predicted, measured, weights).backward()
    assert predicted.grad.isfinite().all()
    assert not predicted.grad[1, 1].any()
