"""A body whose wall creeps or rubs, against arcs in closed form."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.surrogate.effects import hypothesis_of, make_effect
from surgisoft.surrogate.effects.body_plays import AXES, BodyPlays
from surgisoft.surrogate.effects.creep import TIMES
from tests.surrogate.effects.bodies import LENGTH, NODES, STRAIGHT, along, arc, body, facts

STEP = 0.01
"""Amplitude that is small, so that displacements are those to first order."""


def one_time(number: int) -> dict[str, float]:
    """A spectrum with a single retardation time, by its number."""
    return {"tau_s": float(TIMES[number]), "width": 0.05}


def near(found: torch.Tensor, expected: torch.Tensor, share: float = 0.05) -> bool:
    """Whether displacements are equal but for a share of the largest (at the clamp half bends)."""
    return float((found - expected).abs().max()) <= share * float(expected.abs().max()) + 1e-6


@given(st.floats(0.2, 1.2), st.floats(-3.0, 3.0), st.integers(2, 8))
def test_a_held_body_bends_on_by_the_exponential_of_its_retardation_time(angle, towards, number):
    """Kelvin and Voigt: 1 - exp(-t / tau) of the bending, after 12 s of a held arc."""
    creep = make_effect("creep", facts(), body=True, **one_time(number))
    creep.amount.data.fill_(STEP)
    held = arc(angle, towards)
    found = along(creep, STRAIGHT, *[held] * 12)
    assert near(found[0], STRAIGHT, 1e-7)
    share = -math.expm1(-12.0 / float(TIMES[number]))
    assert near(found[-1] - held, arc(angle * (1 + STEP * share), towards) - held)


def test_a_body_that_is_let_go_keeps_its_bend_for_a_while():
    """Back to straight, what has crept in 20 s goes with the same exponential in 5 s."""
    creep = make_effect("creep", facts(), body=True, **one_time(5))
    creep.amount.data.fill_(STEP)
    found = along(creep, STRAIGHT, *[arc(1.0)] * 20, *[STRAIGHT] * 5)
    tau = float(TIMES[5])
    left = -math.expm1(-20.0 / tau) * math.exp(-5.0 / tau)
    assert near(found[-1] - STRAIGHT, arc(STEP * left) - STRAIGHT)


def test_a_stretched_body_creeps_by_its_stretch_and_a_bent_one_by_its_bending():
    creep = make_effect("creep", facts(), body=True, **one_time(1))
    creep.stretch.data.fill_(0.1)
    long = 1.1 * STRAIGHT
    assert near(along(creep, STRAIGHT, *[long] * 30)[-1], 1.11 * STRAIGHT, 1e-4)
    # Chords of arcs are a little shorter than the arc.
    assert near(along(creep, STRAIGHT, *[arc(0.5)] * 30)[-1], arc(0.5), 1e-4)


def test_an_arm_at_rest_has_crept_under_its_weight_already():
    """Also where a model predicts another shape at rest, 3 degrees of bending off."""
    hanging, predicted = arc(0.7), arc(0.75)
    creep = make_effect("creep", facts(hanging), body=True, **one_time(1))
    creep.amount.data.fill_(0.5)
    assert near(along(creep, *[hanging] * 20)[-1], hanging, 1e-5)
    assert near(along(creep, *[predicted] * 20)[-1], predicted, 1e-9)


@given(st.floats(-math.pi, math.pi), st.floats(-1.0, 1.0))
def test_plays_along_the_axes_prefer_no_direction(towards, height):
    """The unit matrix where nothing has slipped; far beyond the radius 1.37 to 1.62 of it."""
    flat = math.sqrt(1 - height**2)
    way = torch.tensor([flat * math.cos(towards), flat * math.sin(towards), height]).double()
    seen = AXES @ way
    assert torch.allclose(0.5 * seen @ AXES, way, atol=1e-9)
    slipped = 0.5 * seen.sign() @ AXES
    assert 1.37 < float(slipped @ way) < 1.62


@pytest.mark.parametrize("towards", [0.0, 0.4, 1.9])
def test_a_body_lags_by_what_friction_holds_of_its_bending(towards):
    """Plays of 0.1 of 1 rad: stuck within 0.05 rad, then the sum of six that each lag 0.1.

    In the plane of the arc: six axes turn the lag out of it by up to 9 degrees.
    """
    rubbing = make_effect("hysteresis", facts(), radii=(0.1,), body_rad=1.0)
    rubbing.bend.data.fill_(STEP)
    stuck, slipped = arc(0.05, towards), arc(0.9, towards)
    found = along(rubbing, STRAIGHT + 1e-9, stuck, slipped)
    assert near(found[1] - stuck, arc(0.05 * (1 - STEP), towards) - stuck)
    about = torch.tensor([-math.sin(towards), math.cos(towards), 0.0]).double()
    seen = AXES @ (0.9 * about)
    lag = 0.5 * seen.clamp(-0.1, 0.1) @ AXES
    assert float((lag @ about) / lag.norm()) > math.cos(math.radians(10))
    expected = arc(0.9 - STEP * float(lag @ about), towards) - slipped
    plane = torch.tensor([[math.cos(towards), math.sin(towards), 0.0], [0.0, 0.0, 1.0]]).double()
    assert near((found[2] - slipped) @ plane.T, expected @ plane.T, 0.15)


def test_friction_of_the_stretch_holds_back_the_stretch():
    rubbing = make_effect("hysteresis", facts(), radii=(0.1,), body_rad=1.0)
    rubbing.stretch.data.fill_(0.5)
    # A stretch of a tenth counts as 1 rad of bending: a lag of 0.1 rad is one of 1 %.
    found = along(rubbing, STRAIGHT, 1.05 * STRAIGHT, 1.02 * STRAIGHT)
    assert near(found[1], 1.045 * STRAIGHT, 1e-4)
    assert near(found[2], 1.025 * STRAIGHT, 1e-4)


@pytest.mark.parametrize("radius", [0.05, 0.2, 0.3])
def test_the_loop_of_a_body_is_as_wide_as_it_says(radius):
    """Between loading and unloading, by the shapes of a body that bends about an axis."""
    rubbing = make_effect("hysteresis", facts(), radii=(radius,), body_rad=1.0)
    rubbing.bend.data.fill_(STEP)
    (reading,) = rubbing.readings()
    almost = arc(1e-3)
    there = along(rubbing, STRAIGHT, arc(-0.5), almost, arc(0.5), almost, arc(-0.5), almost)
    wide = (there[4] - there[6])[-1, 0]
    bent = (arc(0.501) - almost - arc(-0.499) + almost)[-1, 0]
    # The clamp bends half as much as a node, and lags by as much.
    assert float(wide / bent) == pytest.approx(reading.value / 100, rel=0.1, abs=1e-5)
    assert "29 degrees to either side" in reading.text


def test_inputs_of_plays_are_shares_of_the_full_bending():
    plays = BodyPlays(STRAIGHT, 2.0).double()
    seen = plays.inputs(arc(1.0))
    node = 2 * math.tan(1.0 / 40) * (NODES - 1)
    assert torch.allclose(seen[1:, :6], (0.5 * node * AXES[:, 1]).expand(NODES - 2, 6), atol=1e-6)
    bend, stretch = body().beyond_rest(arc(1.0))
    by_inputs = plays.moved(arc(1.0), seen[..., :6], seen[..., 6])
    by_strains = body().bent_further(arc(1.0), bend, stretch)
    for found, expected in zip(by_inputs, by_strains, strict=True):
        assert torch.allclose(found, expected, atol=1e-6 * LENGTH)


@pytest.mark.parametrize("name", ["creep", "hysteresis"])
def test_the_body_is_tried_where_it_moves_and_not_side_by_side(name):
    moving = torch.stack([arc(0.1 + 0.01 * k) for k in range(50)]).float()
    still = STRAIGHT.float().expand(50, -1, -1)
    hypothesis = hypothesis_of(make_effect(name, facts()))
    tried = hypothesis.candidates(facts(), moving)
    bodies = [i for i, each in enumerate(tried) if each.stage == "body"]
    assert len(bodies) >= 1
    assert all(each.stage == "material" for each in hypothesis.candidates(facts(), still))
    (together,) = hypothesis.combinations(tried)
    assert not set(bodies) & set(together)
    assert len(together) + len(bodies) == len(tried)
    if name == "hysteresis":
        (wide,) = (tried[i].body_rad for i in bodies)
        assert wide == pytest.approx(2 * 0.58, rel=0.03)
