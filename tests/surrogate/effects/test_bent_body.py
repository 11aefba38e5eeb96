"""Bending and stretch of a body, and a wall that softens by them, against arcs in closed form."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.surrogate.effects import make_effect
from surgisoft.surrogate.effects.bent_body import (
    ENERGIES,
    LEAST_ENERGY,
    SLENDERNESS,
    hardest_strained,
    most_strained,
)
from tests.surrogate.effects.bodies import LENGTH, NODES, STRAIGHT, along, arc, body, facts


@given(st.floats(0.1, 2.0), st.floats(-3.0, 3.0), st.floats(0.9, 1.2))
def test_an_arc_bends_by_its_angle_everywhere_and_stretches_by_its_length(angle, towards, longer):
    """Each node turns by the angle of a step, half of it at the clamp: twice tan of the half."""
    bend, stretch = body().strains(arc(angle, towards, longer * LENGTH))
    across = torch.tensor([-math.sin(towards), math.cos(towards), 0.0]).double()
    node, clamp = (2 * math.tan(angle / part) for part in (40, 80))
    assert torch.allclose(bend[0], clamp * across, atol=1e-9)
    assert torch.allclose(bend[1:], (node * across).expand(NODES - 2, 3), atol=1e-9)
    chord = longer * math.sin(angle / 40) / (angle / 40) - 1
    assert torch.allclose(stretch, torch.full_like(stretch, chord), atol=1e-6)
    energy = body().energies(arc(angle, towards, longer * LENGTH))
    assert torch.allclose(
        energy[1:, 0], torch.full((NODES - 2,), (20 * node) ** 2).double(), rtol=1e-5
    )
    square = torch.full((NODES - 1,), (SLENDERNESS * chord) ** 2).double()
    assert torch.allclose(energy[:, 1], square, rtol=1e-4, atol=1e-6)


@given(st.floats(0.2, 1.5), st.floats(-3.0, 3.0))
def test_more_bending_and_more_stretch_lead_to_the_next_arc(angle, towards):
    """To first order, by the difference of two arcs."""
    step = 1e-5
    more = torch.full((NODES - 1, 2), step).double()
    by_bend, by_stretch = body().moved(arc(angle, towards), more)
    bent = arc(angle * (1 + step), towards) - arc(angle, towards)
    # Chords of the next arc are shorter by (angle / 20)^2 / 12 of the step.
    assert torch.allclose(by_bend, bent, atol=LENGTH * step * 1e-3)
    assert not by_stretch.abs().max() > LENGTH * step * 1e-3
    longer = arc(angle, towards, 1.1 * LENGTH)
    by_stretch = body().moved(longer, more)[1]
    strain = 1.1 * math.sin(angle / 40) / (angle / 40) - 1
    assert torch.allclose(by_stretch, longer * strain / (1 + strain) * step, atol=1e-8)


def test_only_what_is_beyond_the_shape_at_rest_bends_more():
    rest = arc(0.8)
    assert float(body(rest).energies(rest).abs().max()) < 1e-9
    by_bend, by_stretch = body(rest).moved(rest, torch.ones(NODES - 1, 2).double())
    assert float(by_bend.abs().max()) < 1e-4
    assert float(by_stretch.abs().max()) < 1e-4


def test_a_first_key_point_above_the_base_hangs_on_a_line_from_the_origin():
    raised = STRAIGHT[2:]
    bend, stretch = body(raised).strains(raised)
    assert bend.shape == (NODES - 2, 3)
    assert stretch.shape == (NODES - 2,)
    assert body(raised).moved(raised, torch.ones(NODES - 2, 2).double())[0].shape == raised.shape


@pytest.mark.parametrize("energy", ["apart", "whole"])
def test_damage_stays_at_the_largest_strain_and_below_it_in_the_other_form(energy):
    """Arcs of 1 rad and then of half of it: r = 1 - (1 + 1 / 0.5)^(-1/2), less that of 1 / 4."""
    at_one, at_half = (1 - (1 + square / 0.5) ** -0.5 for square in (1.0, 0.25))
    first, again = arc(1.0), arc(0.5)
    lost = {True: (at_one, at_one), False: (0.0, at_one - at_half)}
    for damage, shares in lost.items():
        soft = make_effect("softening", facts(), width=0.5, damage=damage, body=energy)
        soft.own.data.fill_(0.01)
        found = along(soft, STRAIGHT + 1e-9, first, again)
        for shape, angle, share, points in zip(
            (first, again), (1.0, 0.5), shares, found[1:], strict=True
        ):
            expected = arc(angle * (1 + 0.01 * share)) - shape
            # At the clamp half as much bends, so the damage there is less.
            assert torch.allclose(points - shape, expected, atol=0.05 * 0.01 * LENGTH * angle)
            assert float((points - shape).abs().max()) >= 0.9 * float(expected.abs().max()) - 1e-6


def test_a_stretched_wall_is_also_softer_in_bending_where_its_energy_is_the_sum():
    long, bent = 1.1 * STRAIGHT, arc(0.3)
    for energy, softer in (("whole", True), ("apart", False)):
        soft = make_effect("softening", facts(), width=0.1, damage=True, body=energy)
        soft.own.data.fill_(0.1)
        before = along(soft, STRAIGHT, bent)[-1]
        after = along(soft, STRAIGHT, long, bent)[-1]
        assert bool((after - before).abs().max() > 0.1) == softer


def test_a_softer_body_sags_as_one_with_more_weight_does():
    """At rest after a large bend, by the payload of the body alone."""
    level = (1.0, 0.0, 0.0)
    soft = make_effect(
        "softening", facts(gravity=level), width=0.5, body="whole", weight=True, damage=True
    )
    soft.sag.data.fill_(2.0)
    found = along(soft, STRAIGHT, arc(1.0), STRAIGHT)[-1]
    damage = 1 - (1 + body().energies(arc(1.0)).sum(-1) / 0.5).rsqrt()
    load = make_effect("payload", facts(gravity=level))
    load.body_sag.data.fill_(2.0 * float(damage.mean()))
    sagged = load.double().apply(STRAIGHT, STRAIGHT.new_zeros(0)).detach()
    assert torch.allclose(found, sagged, atol=1e-4)
    assert float(found[-1, 0]) == pytest.approx(2.0 * float(damage.mean()), rel=1e-2)


@pytest.mark.parametrize("energy", ["apart", "whole"])
def test_a_body_bends_less_the_more_it_is_bent(energy):
    """Fung's exponential of 1 / 4 and of 1 of the energy at which the share is lost."""
    stiff = make_effect("stiffening", facts(), steepness=2.0, body=energy, full=1.0)
    stiff.bend.data.fill_(0.01)
    half, full = along(stiff, arc(0.5), arc(1.0))
    for points, angle in ((half, 0.5), (full, 1.0)):
        share = math.expm1(2.0 * angle**2) / math.expm1(2.0)
        expected = arc(angle * (1 - 0.01 * share)) - arc(angle)
        assert torch.allclose(points - arc(angle), expected, atol=0.06 * 0.01 * LENGTH * angle)
        assert float((points - arc(angle)).abs().max()) >= 0.9 * float(expected.abs().max())


def test_a_stiffer_body_sags_less_and_a_stretched_one_stretches_less():
    long, level = 1.05 * STRAIGHT, (1.0, 0.0, 0.0)
    stiff = make_effect(
        "stiffening", facts(gravity=level), steepness=1e-3, body="whole", full=0.5, weight=True
    )
    stiff.sag.data.fill_(2.0)
    share = (0.05 * SLENDERNESS) ** 2 / 0.5
    sagged = make_effect("payload", facts(gravity=level))
    sagged.body_sag.data.fill_(-2.0 * share)
    expected = sagged.double().apply(long, long.new_zeros(0)).detach()
    assert torch.allclose(along(stiff, long)[0], expected, atol=1e-3)
    stiff.sag.data.fill_(0.0)
    stiff.own.data.fill_(0.1)
    assert torch.allclose(along(stiff, long)[0], STRAIGHT * (1.05 - 0.05 * 0.1 * share), atol=1e-3)


def test_energies_of_a_much_strained_body_are_those_of_its_hardest_postures():
    shapes = torch.stack([arc(1e-3 + angle) for angle in torch.linspace(0.0, 1.0, 101).tolist()])
    shapes[7, 3] = torch.nan
    found = dict(most_strained(STRAIGHT.float(), shapes.float()))
    # The node at the clamp bends half as much.
    mean = (NODES - 2 + 0.25) / (NODES - 1)
    assert found == {each: pytest.approx(0.98**2 * mean, rel=0.01) for each in ENERGIES}
    assert most_strained(STRAIGHT.float(), STRAIGHT.float().expand(5, -1, -1)) == []
    assert most_strained(STRAIGHT.float(), shapes[:1].float()) == []


def test_a_stiffening_body_is_scaled_by_the_node_that_each_strain_is_largest_at():
    """Arcs bend every node but that at the clamp alike; a body that is stretched by a tenth, too,
    has an energy of 1 rad^2 of it."""
    angles = torch.linspace(0.0, 1.0, 101).tolist()
    bent = torch.stack([arc(1e-3 + angle) for angle in angles]).float()
    (_, (bend, stretch)), (_, whole) = hardest_strained(STRAIGHT.float(), bent)
    assert bend == pytest.approx(0.98**2, rel=0.01)
    assert stretch == pytest.approx(LEAST_ENERGY * bend, rel=0.05)
    assert whole == pytest.approx((bend, bend), rel=1e-3)
    longer = torch.stack([arc(1e-3 + a, 0.0, (1 + 0.1 * a) * LENGTH) for a in angles]).float()
    (_, (_, stretch)), _ = hardest_strained(STRAIGHT.float(), longer)
    assert stretch == pytest.approx((SLENDERNESS * 0.1 * 0.98) ** 2, rel=0.02)
    assert hardest_strained(STRAIGHT.float(), bent[:1]) == []


@pytest.mark.parametrize("steepness", [0.01, 3.0, 12.0])
def test_beyond_the_range_a_body_stiffens_along_the_tangent(steepness):
    """Four times the energy at which the share is lost: one and three slopes of the exponential at
    that energy. Going on exponentially it would be exp(3 x 12) times as much."""
    stiff = make_effect("stiffening", facts(), steepness=steepness, body="apart", full=0.25)
    slope = steepness / -math.expm1(-steepness)
    share = 1 + 3 * slope
    stiff.bend.data.fill_(0.01 / share)
    (points,) = along(stiff, arc(1.0))
    expected = arc(0.99) - arc(1.0)
    assert torch.allclose(points - arc(1.0), expected, atol=0.06 * 0.01 * LENGTH)
    assert float((points - arc(1.0)).abs().max()) >= 0.9 * float(expected.abs().max())


@pytest.mark.parametrize("name", ["stiffening", "softening"])
def test_shares_of_two_strains_are_plausible_each_for_itself(name):
    """Half of the bending and half of the stretch may be lost, half and half of one push not."""
    for form, plausible in (({"section": True}, True), ({"body": "apart"}, True), ({}, False)):
        effect = make_effect(name, facts(), **form)
        for amplitude in effect.amplitudes().values():
            amplitude.data.fill_(0.6)
        assert effect.plausible() is plausible, form


@pytest.mark.parametrize("name", ["stiffening", "softening"])
def test_energies_of_a_body_are_named(name):
    with pytest.raises(InputError, match="unknown energy of the body 'some'"):
        make_effect(name, facts(), body="some")


@pytest.mark.parametrize("name", ["stiffening", "softening"])
def test_a_weight_needs_a_body_and_the_direction_of_gravity(name):
    with pytest.raises(InputError, match="weight is true without a body; expected one"):
        make_effect(name, facts(gravity=(1.0, 0.0, 0.0)), weight=True)
    with pytest.raises(InputError, match="weight is true without a direction of gravity"):
        make_effect(name, facts(), body="whole", weight=True)
