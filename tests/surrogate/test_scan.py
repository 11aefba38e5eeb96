"""Prefix scans against the plain loop that they replace."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.surrogate.scan import (
    clamp_scan,
    direction_scan,
    direction_step,
    last_nonzero,
    linear_scan,
    play_scan,
)


def walk(steps: int, seed: int, chambers: int = 2, runs: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(runs, steps, chambers, generator=generator).cumsum(1)


@given(st.integers(1, 70), st.integers(0, 10_000), st.floats(0.0, 3.0))
def test_clamp_scan_is_the_loop_to_the_bit(steps, seed, radius):
    x = walk(steps, seed)
    y, expected = x[:, 0], []
    for t in range(steps):
        y = torch.minimum(torch.maximum(y, x[:, t] - radius), x[:, t] + radius)
        expected.append(y)
    assert torch.equal(clamp_scan(x - radius, x + radius, x[:, 0]), torch.stack(expected, 1))


@given(st.integers(2, 50), st.integers(0, 10_000))
def test_gradient_of_play_operators_is_that_of_the_loop(steps, seed):
    radius = torch.tensor([0.1, 0.7, 2.0], dtype=torch.float64)
    signal = walk(steps, seed).double().unsqueeze(-1).expand(-1, -1, -1, 3)
    weight = torch.randn(signal.shape, generator=torch.Generator().manual_seed(1))
    gradients = []
    for scanned in (True, False):
        u = signal.clone().requires_grad_()
        start = signal[:, 0].clone().requires_grad_()
        if scanned:
            plays = play_scan(u, radius, start)
        else:
            y, every = start, []
            for t in range(steps):
                y = torch.minimum(torch.maximum(y, u[:, t] - radius), u[:, t] + radius)
                every.append(y)
            plays = torch.stack(every, 1)
        (plays * weight).sum().backward()
        gradients.append((plays.detach(), u.grad, start.grad))
    for one, other in zip(*gradients, strict=True):
        assert torch.allclose(one, other, atol=1e-12)


def test_last_nonzero_by_hand():
    values = torch.tensor([0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 1.0]).view(1, -1, 1)
    expected = torch.tensor([0.0, 0.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0]).view(1, -1, 1)
    assert torch.equal(last_nonzero(values), expected)


def test_direction_keeps_its_value_while_the_pressure_rests():
    pressure = torch.tensor([0.0, 0.0, 3.0, 3.0, 3.05, 2.95, 3.0, 1.0, 1.0]).view(1, -1, 1)
    _, direction = direction_scan(pressure, torch.tensor([0.2]), torch.zeros(1))
    assert direction.flatten().tolist() == [0, 0, 1, 1, 1, 1, 1, -1, -1]


@given(st.integers(1, 60), st.integers(0, 10_000))
def test_direction_steps_as_it_traces(steps, seed):
    pressure, band = walk(steps, seed), torch.tensor([0.3, 0.6])
    rest = torch.tensor([0.5, -1.0])
    anchors, directions = direction_scan(pressure, band, rest)
    anchor, direction = rest.expand(2, 2), torch.zeros(2, 2)
    for t in range(steps):
        anchor, direction = direction_step(anchor, direction, pressure[:, t], band)
        assert torch.equal(anchor, anchors[:, t])
        assert torch.equal(direction, directions[:, t])


@given(st.integers(1, 70), st.integers(0, 10_000), st.sampled_from([torch.float64, torch.cdouble]))
def test_linear_scan_is_the_loop(steps, seed, dtype):
    """With factors of their own a step, shared by the channels, zeros and ones among them."""
    generator = torch.Generator().manual_seed(seed)
    factor = torch.rand(2, steps, 1, generator=generator).mul(1.4).sub(0.2).clamp(0, 1).to(dtype)
    if dtype == torch.cdouble:
        factor = factor * torch.exp(1j * torch.rand(2, steps, 1, generator=generator))
    addend, start = walk(steps, seed, 3).to(dtype), walk(1, seed + 1, 3)[:, 0].to(dtype)
    y, expected = start, []
    for t in range(steps):
        y = factor[:, t] * y + addend[:, t]
        expected.append(y)
    assert torch.allclose(linear_scan(factor, addend, start), torch.stack(expected, 1), atol=1e-12)


def test_linear_scan_has_the_loops_gradient():
    generator = torch.Generator().manual_seed(0)
    inputs = (
        torch.rand(2, 11, 1, dtype=torch.float64, generator=generator).requires_grad_(),
        torch.randn(2, 11, 3, dtype=torch.float64, generator=generator).requires_grad_(),
        torch.randn(2, 3, dtype=torch.float64, generator=generator).requires_grad_(),
    )
    assert torch.autograd.gradcheck(linear_scan, inputs)
