"""Hysteresis by hand, and the laws of plays."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.surrogate.effects import ArmFacts, Context, make_effect
from surgisoft.surrogate.effects.hysteresis import HYPOTHESIS
from surgisoft.surrogate.effects.readings import in_words
from tests.surrogate.effects.arms import REST_MM, stir

LOW, HIGH = torch.tensor([-10.0, -10.0, -10.0]), torch.tensor([50.0, 50.0, 50.0])
FACTS = ArmFacts(LOW, HIGH, torch.zeros(3), REST_MM)


def still(steps: int) -> Context:
    """Time that does not matter."""
    return Context(torch.zeros(1, steps))


def lag(pressures: list[float]) -> torch.Tensor:
    """Play of chamber 1 less its pressure, in kPa: radius 0.2 of the half range 30 is 6 kPa."""
    effect = make_effect("hysteresis", FACTS, radii=(0.2,))
    x = torch.zeros(1, len(pressures), 3)
    x[0, :, 0] = torch.tensor(pressures)
    plays = effect.scan(effect.rest(x[:, 0]), x, still(len(pressures)))
    return 30 * (plays[..., 0] - effect.lines(x))[0, :, 0]


def test_play_by_hand():
    expected = [0, -3, -6, -6, -1, 6, 6, 4]
    assert lag([0.0, 3.0, 6.0, 20.0, 15.0, 8.0, 0.0, 2.0]).tolist() == pytest.approx(
        expected, abs=1e-4
    )


def test_amplitude_acts_by_the_formula():
    """x_eff = x + w (y - u) + v (u - u_rest)(y - u) on one line, by hand."""
    effect = make_effect("hysteresis", FACTS, radii=(0.2,))
    with torch.no_grad():
        effect.weight[1, 0, 0] = 0.5
        effect.slope[1, 0, 0] = 2.0
    x = torch.tensor([[[0.0, 7.0, 0.0], [20.0, 7.0, 0.0]]])
    plays = effect.scan(effect.rest(x[:, 0]), x, still(2))
    # Line 1 is chamber 1: u goes from -2/3 to 0, y follows 0.2 behind; u - u_rest is 2/3.
    moved = 30 * (0.5 + 2.0 * 2 / 3) * -0.2
    expected = torch.tensor([20.0, 7.0 + moved, 0.0])
    assert torch.allclose(effect.apply(x, plays)[0, 1], expected, atol=1e-4)


def plays_after(history: list[float], chamber: int) -> torch.Tensor:
    """(T, L, J) plays while one chamber moves, along lines that rise or fall with it throughout."""
    effect = stir(make_effect("hysteresis", FACTS), size=0.05)
    effect.bent.data.zero_()
    x = torch.zeros(1, len(history), 3)
    x[0, :, chamber] = torch.tensor(history)
    return effect.scan(effect.rest(x[:, 0]), x, still(len(history)))[0]


@given(st.floats(15, 45), st.floats(-5, 12))
def test_return_point_memory(high, low):
    """A closed inner loop leaves no trace (Mayergoyz 2003: return-point memory)."""
    memory = plays_after([-10.0, high, low, high], 1)
    assert torch.allclose(memory[1], memory[3], atol=1e-5)


@given(st.lists(st.floats(0, 20), min_size=1, max_size=12))
def test_a_larger_sweep_wipes_out_smaller_ones(inner):
    """After a sweep beyond every earlier extremum, what came before is forgotten."""
    tail = [-10.0, 50.0, 30.0]
    one, other = plays_after([10.0, *inner, *tail], 2), plays_after([10.0, *tail], 2)
    assert torch.allclose(one[-1], other[-1], atol=1e-5)


@pytest.mark.parametrize("section", [False, True])
def test_a_ring_of_chambers_has_no_first(section):
    """Turning the pressures by a chamber turns the answer, bit for bit but for rounding."""
    shape = {"radii": (0.1, 0.4), "ring": True, "others": -0.2, "section": section}
    effect = stir(make_effect("hysteresis", FACTS, **shape), size=0.05)
    lines = make_effect("hysteresis", FACTS, **shape)
    effect.linear.data.copy_(lines.linear)
    effect.bent.data.zero_()
    x = 20 + 5 * torch.randn(1, 50, 3, generator=torch.Generator().manual_seed(1)).cumsum(1)

    def answer(signal):
        return effect.apply(signal, effect.scan(effect.rest(signal[:, 0]), signal, still(50)))

    assert torch.allclose(answer(x.roll(1, -1)), answer(x).roll(1, -1), atol=1e-4)
    assert not torch.allclose(answer(x), x, atol=0.1)


def test_lines_of_a_plane_section_stand_along_and_between_chambers():
    """At a neighbour's share of -0.2 a fifth of a strain is common: by hand, |values| sum to 1."""
    lines = make_effect("hysteresis", FACTS, others=-0.2, section=True).linear
    assert torch.allclose(lines[0], torch.tensor([1.0, -0.2, -0.2]) / 1.4, atol=1e-6)
    assert torch.allclose(lines[4], torch.tensor([1.0, 1.0, -1.0]) / 3, atol=1e-6)


def test_backlash_of_one_chamber_by_hand():
    """The middle chamber follows through a gap of 2 x 6 kPa, its neighbours at once."""
    effect = make_effect("hysteresis", FACTS, radii=(0.2, 0.5), chamber=1)
    with torch.no_grad():
        effect.own[0] = 1.0
    steps = [(10.0, 20.0, 5.0), (12.0, 30.0, 5.0), (14.0, 27.0, 5.0), (9.0, 10.0, 5.0)]
    x = torch.tensor([steps])
    found = effect.apply(x, effect.scan(effect.rest(x[:, 0]), x, still(len(steps))))[0]
    assert torch.allclose(found[:, [0, 2]], x[0][:, [0, 2]], atol=1e-5)
    said = in_words(effect.readings())
    assert said == "loop of 12 kPa between loading and unloading of chamber 2, at half load"
    assert torch.allclose(found[:, 1], torch.tensor([20.0, 24.0, 24.0, 16.0]), atol=1e-4)


@pytest.mark.parametrize("chambers", [1, 2, 3, 4, 6])
def test_each_chamber_is_tried_alone_but_of_three_in_a_ring(chambers):
    """One of four tendons, or one chamber of two sections, may have all of the play."""
    ones = torch.ones(chambers)
    arm = ArmFacts(-10.0 * ones, 50.0 * ones, 0.0 * ones, REST_MM)
    for tried in (HYPOTHESIS.candidates, HYPOTHESIS.further):
        made = tried(arm, REST_MM[None])
        alone = [i for i, effect in enumerate(made) if effect.chamber is not None]
        assert [made[i].chamber for i in alone] == list(range(chambers * (chambers in (2, 4, 6))))
        (together,) = HYPOTHESIS.combinations(made)
        assert sorted(together + alone) == list(range(len(made)))
