"""The wall's memory against a Preisach plane of relays that are really switched one by one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.rig.friction import DEPTH, everett, lag, move, rested, virgin

SLIP, SLOPE, BOW = 0.03, 2.5, 4.0
strains = st.floats(-0.15, 0.3)


class Line:
    """One wall fibre through its strains."""

    def __init__(self):
        self.last, self.depth, self.stack = rested(1)

    def to(self, strain):
        move(0, float(strain), self.last, self.depth, self.stack)
        return lag(0, self.last, self.depth, self.stack, SLIP, SLOPE, BOW)


class Relays:
    """A fine mesh of relays with the density q(h) r(c), each switched by hand."""

    def __init__(self, reach=0.35, widths=700, centres=1400):
        h = (np.arange(widths) + 0.5) * 0.4 / widths
        c = -reach + (np.arange(centres) + 0.5) * 2 * reach / centres
        self.h, self.c = h[:, None], c[None, :]
        cell = 0.4 / widths * 2 * reach / centres
        density = np.exp(-self.h / SLIP) / SLIP * (1 + SLOPE * self.c + BOW * self.c**2)
        # In the (a, b) plane an area element is 2 dh dc; the Everett integral carries this factor.
        self.weight = 2 * density * cell
        self.on = np.where(self.c < 0, 1.0, -1.0) * np.ones_like(density)
        self.rest = (self.weight * self.on).sum()

    def to(self, strain):
        self.on = np.where(self.c + self.h <= strain, 1.0, self.on)
        self.on = np.where(self.c - self.h >= strain, -1.0, self.on)
        return (self.weight * self.on).sum() - self.rest


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_relays(seed):
    """Random reversals of all sizes; the lag is the frictionless output less the relays' output."""
    rng = np.random.default_rng(seed)
    line, relays = Line(), Relays()
    largest = 0.0
    for strain in rng.uniform(-0.12, 0.28, 25):
        free = 4 * (strain + SLOPE / 2 * strain**2 + BOW / 3 * strain**3)
        mine, theirs = line.to(strain), free - relays.to(strain)
        largest = max(largest, abs(theirs))
        assert mine == pytest.approx(theirs, abs=3e-3)
    assert largest > 0.05


def test_everett_of_relays_of_no_width_is_frictionless():
    """With s -> 0 the Everett integral is 2 (R(a) - R(b)), R the antiderivative of r."""

    def area(x):
        return x + SLOPE / 2 * x**2 + BOW / 3 * x**3

    assert everett(0.2, -0.1, 1e-9, SLOPE, BOW) == pytest.approx(2 * (area(0.2) - area(-0.1)))


@given(u=st.floats(0.001, 0.3))
def test_virgin_curve_joins_the_outer_loop(u):
    """Down from u to -u after first loading ends on the first loading to -u."""
    down = virgin(u, SLIP, SLOPE, BOW) - 2 * everett(u, -u, SLIP, SLOPE, BOW)
    assert down == pytest.approx(virgin(-u, SLIP, SLOPE, BOW), abs=1e-12)


@settings(max_examples=200)
@given(past=st.lists(strains, min_size=1, max_size=8), start=strains, share=st.floats(0.0, 1.0))
def test_return_point_memory(past, start, share):
    """An excursion from a reversal point part of the way back, and again to it, leaves no trace."""
    line = Line()
    for strain in past:
        line.to(strain)
    before = line.to(start)
    there = start + share * (past[-1] - start)
    rng = np.random.default_rng(0)
    low, high = min(start, there), max(start, there)
    for strain in [there, *rng.uniform(low, high, 6), there]:
        line.to(strain)
    assert line.to(start) == pytest.approx(before, abs=1e-12)


@settings(max_examples=100)
@given(past=st.lists(strains, max_size=10), other=st.lists(strains, max_size=10), now=strains)
def test_wiping_out(past, other, now):
    """A larger load than any before wipes out the past."""
    outputs = []
    for history in (past, other):
        line = Line()
        for strain in [*history, 0.35, -0.3, now]:
            output = line.to(strain)
        outputs.append(output)
    assert outputs[0] == pytest.approx(outputs[1], abs=1e-12)
    assert line.depth[0] <= 2


@given(a=strains, b=strains, c=strains)
def test_steps_on_the_way_change_nothing(a, b, c):
    """Rate independence: monotone movements may be cut into steps at will."""
    coarse, fine = Line(), Line()
    for strain in (a, b, c):
        end = coarse.to(strain)
        for part in np.linspace(fine.last[0], strain, 7)[1:]:
            finely = fine.to(part)
    assert finely == pytest.approx(end, abs=1e-12)


def test_density_is_not_that_of_play_operators():
    """Loops of equal width at different mean strains differ: play operators' would be congruent."""
    heights = []
    for mean in (-0.1, 0.2):
        line = Line()
        line.to(mean + 0.03)
        line.to(mean - 0.03)
        up = line.to(mean)
        line.to(mean + 0.03)
        heights.append(up - line.to(mean))
    assert heights[1] > 1.4 * heights[0] > 0


def test_friction_dissipates():
    """Work over a closed loop is positive at every amplitude."""
    for reach in (0.005, 0.02, 0.1):
        line, path = Line(), 0.1 + reach * np.sin(np.linspace(0, 6 * np.pi, 600))
        force = np.array([line.to(strain) for strain in path])
        loop = slice(400, 600)
        work = np.trapezoid(force[loop], path[loop])
        assert work > 0


def test_deep_memory_loses_only_its_smallest_loop():
    """More nested reversals than there is room for: the outer ones stay."""
    line = Line()
    reaches = 0.2 * 0.9 ** np.arange(2 * DEPTH)
    for k, reach in enumerate(reaches):
        line.to(0.05 + (-1) ** k * reach)
    assert 2 <= line.depth[0] <= DEPTH
    np.testing.assert_allclose(line.stack[0, :4], 0.05 + reaches[:4] * [1, -1, 1, -1])
