"""Compiled networks: torch's layers forward and backward, by every number of threads the same."""

import copy
import math
from itertools import pairwise

import pytest
import torch
from torch import nn

from surgisoft.agents.compiled_network import BLOCK, FEW, LEAST_ROWS, CompiledNetwork
from surgisoft.threads import rows_on_threads

BATCHES = (LEAST_ROWS, BLOCK, BLOCK + 1, 3 * BLOCK + 77)
"""A part of a block, a whole one, and several of different sizes."""


def layers_of(*widths):
    """Linear layers with tanh between them, whose biases are not zero."""
    torch.manual_seed(0)
    layers = []
    for n, width in pairwise(widths):
        layers += [nn.Linear(n, width), nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def gradients(network, x, weight):
    """Outputs of rows, and gradients of all parameters by their weighted sum."""
    network.zero_grad()
    out = network(x)
    (out * weight).sum().backward()
    return [out.detach(), *(each.grad for each in network.parameters())]


@pytest.mark.parametrize("widths", [(7, 16, 3), (55, 64, 64, 1), (5, 9, 20, 33, FEW + 4)])
@pytest.mark.parametrize("count", BATCHES)
def test_outputs_and_gradients_are_those_of_the_layers_in_double_precision(widths, count):
    layers = layers_of(*widths)
    x, weight = 2.0 * torch.randn(count, widths[0]), torch.randn(count, widths[-1])
    found = gradients(CompiledNetwork(*layers), x, weight)
    exact = copy.deepcopy(layers).double()
    truth = gradients(exact, x.double(), weight.double())
    for one, other in zip(found, truth, strict=True):
        assert one.dtype == torch.float32
        torch.testing.assert_close(
            one.double(), other, rtol=1e-5, atol=2e-5 * float(other.abs().max())
        )


def test_its_tanh_is_tanh_over_the_whole_range():
    network = CompiledNetwork(nn.Linear(1, 1), nn.Tanh(), nn.Linear(1, 1))
    odd = [math.nan, math.inf, -math.inf, 0.0, 1e-30]
    x = torch.cat((torch.tensor(odd), torch.linspace(-12.0, 12.0, 1 << 14)))[:, None]
    with torch.no_grad():
        for each, value in zip(network.parameters(), (1.0, 0.0, 1.0, 0.0), strict=True):
            each.fill_(value)
        found = network(x)[:, 0]
    assert found[0].isnan()
    assert torch.allclose(found[1:5], torch.tensor(odd[1:]).tanh(), rtol=1e-6, atol=0.0)
    assert (found[5:] - x[5:, 0].double().tanh()).abs().max() < 1e-6


def test_every_number_of_threads_gives_the_same_bits():
    network, count, before = CompiledNetwork(*layers_of(9, 32, 32, 3)), BATCHES[-1], None
    x, weight = torch.randn(count, 9), torch.randn(count, 3)
    threads = torch.get_num_threads()
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            with rows_on_threads():
                found = gradients(network, x, weight)
                with torch.no_grad():
                    found.append(network(x))
                with torch.inference_mode():
                    found.append(network(x))
            found = [each.clone() for each in found]
            before = before or found
            assert all(map(torch.equal, found, before))
    finally:
        torch.set_num_threads(threads)


def test_what_loops_do_not_compute_goes_through_the_layers():
    layers = layers_of(6, 12, 2)
    network = CompiledNetwork(*layers)
    for x in (torch.randn(LEAST_ROWS - 1, 6), torch.randn(LEAST_ROWS, 6, requires_grad=True)):
        assert torch.equal(network(x), layers(x))
    x = torch.randn(LEAST_ROWS, 6, requires_grad=True)
    (slope,) = torch.autograd.grad(network(x).sum(), x)
    assert slope.abs().min() > 0.0
    assert torch.equal(network.double()(x.double()), layers.double()(x.double()))


def test_it_fits_networks_with_tanh_between_all_layers():
    assert CompiledNetwork.fits(layers_of(4, 5, 6, 2))
    assert not CompiledNetwork.fits(layers_of(4, 2))
    assert not CompiledNetwork.fits(nn.Sequential(nn.Linear(4, 5), nn.ReLU(), nn.Linear(5, 2)))
    assert not CompiledNetwork.fits(nn.Sequential(*layers_of(4, 5, 2), nn.Tanh()))
