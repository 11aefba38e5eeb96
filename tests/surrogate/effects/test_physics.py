"""Each effect against a closed form that it was not written with."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from surgisoft.surrogate.effects import (
    ArmFacts,
    Context,
    hypothesis_of,
    known_effects,
    make_effect,
)
from surgisoft.surrogate.effects.coupling import beside

RANGE = ArmFacts(torch.zeros(3), torch.full((3,), 50.0), torch.zeros(3), torch.zeros(5, 3))
STRAIGHT = torch.tensor([[0.0, 0.0, 10.0 * k] for k in range(9)])
LENGTH, RADIUS = 80.0, 50.0
TURN = torch.linspace(0, math.pi / 2, 13)
QUARTER = RADIUS * torch.stack([1 - TURN.cos(), 0 * TURN, TURN.sin()], -1)
"""Key points on a quarter circle from the base, up and over to +x."""


def arm(rest_mm: torch.Tensor, gravity=None) -> ArmFacts:
    """An arm with these key points at rest, (n, 3) mm."""
    return ArmFacts(torch.zeros(3), torch.ones(3), torch.zeros(3), rest_mm, gravity)


def with_strength(effect, **values):
    """The effect with strengths set by name."""
    for name, value in values.items():
        effect.amplitudes()[name].data.copy_(
            torch.as_tensor(value).expand_as(getattr(effect, name))
        )
    return effect


def run(effect, loads, dt_s=0.01):
    """(T, m) answers in loads to loads (T,) of chamber 1 or (T, 3), from rest."""
    loads = torch.as_tensor(loads, dtype=torch.float32)
    if loads.ndim == 1:
        loads = torch.stack([loads, 0 * loads, 0 * loads], -1)
    x = (50 * loads).unsqueeze(0)
    dt = torch.full(x.shape[:2], dt_s)
    memory = effect.scan(effect.rest(torch.zeros(1, 3)), x, Context(dt))
    return (effect.apply(x, memory) / 50)[0].detach()


def pose(effect, points, memory=None):
    """(n, 3) key points after a body or sensor effect."""
    memory = points.new_zeros(1, 0) if memory is None else memory
    return effect.apply(points.unsqueeze(0), memory)[0].detach()


def test_line_lag_reaches_63_percent_after_its_time_constant():
    lag = with_strength(make_effect("line_lag", RANGE, up_s=0.5, down_s=2.0, dead_s=1e-4), share=1)
    answer = run(lag, torch.cat([torch.ones(1000), torch.zeros(400)]))[:, 0]
    assert answer[49] == pytest.approx(1 - math.exp(-1), abs=1e-3)
    assert answer[1000 + 199] == pytest.approx(math.exp(-1), abs=1e-3)


def test_line_lag_delays_by_dead_time_and_time_constant():
    """The area over a step response is the sum of all delays."""
    lag = with_strength(make_effect("line_lag", RANGE, up_s=0.5, down_s=0.5, dead_s=0.3), share=1)
    answer = run(lag, torch.ones(8000), dt_s=0.001)[:, 0]
    assert float((1 - answer).sum() * 0.001) == pytest.approx(0.8, abs=2e-3)
    assert float(answer[100]) < 0.03


def test_turbulent_line_empties_in_finite_time():
    """Flow with the root of the difference: the root falls evenly, by root(1/10) / (2 tau)."""
    lag = make_effect("line_lag", RANGE, up_s=0.4, down_s=0.4, dead_s=1e-4, turn=1e-6)
    answer = run(with_strength(lag, share=1), torch.ones(4000), dt_s=0.001)[:, 0]
    t = 0.001 * np.arange(1, 4001)
    wanted = 1 - np.clip(1 - t * math.sqrt(0.1) / 0.8, 0, None) ** 2
    assert np.allclose(answer, wanted, atol=1e-3)


@pytest.mark.parametrize("turn", [0.01, 0.3, 1e4])
def test_line_between_laminar_and_turbulent_against_a_solver(turn):
    lag = make_effect("line_lag", RANGE, up_s=0.3, down_s=0.9, dead_s=1e-4, turn=turn)
    command = torch.cat([torch.full((50,), 0.8), torch.full((50,), 0.1), torch.full((50,), 0.5)])
    answer = run(with_strength(lag, share=1), command, dt_s=0.02)[:, 0]

    def slope(t, y):
        gap = float(command[min(int(t / 0.02), 149)]) - y[0]
        slower = math.sqrt((turn + abs(gap)) / (turn + 0.1))
        return [gap / ((0.3 if gap > 0 else 0.9) * slower)]

    t = 0.02 * np.arange(1, 151)
    truth = solve_ivp(slope, (0, 3), [0.0], t_eval=t, max_step=0.005, rtol=1e-6).y[0]
    assert np.abs(answer.numpy() - truth).max() < 3e-3


def test_creep_after_a_step_is_its_spectrum_in_closed_form():
    creep = with_strength(make_effect("creep", RANGE, tau_s=5.0, width=1.5), amount=0.2)
    t = 0.5 * np.arange(1, 401)
    tau = 10 ** np.linspace(-0.45, 2.55, 11)
    share = np.exp(-0.5 * (np.log(tau / 5.0) / 1.5) ** 2)
    wanted = 1 + 0.2 * (share / share.sum() * (1 - np.exp(-t[:, None] / tau))).sum(1)
    answer = run(creep, torch.ones(400), dt_s=0.5)[:, 0]
    assert np.allclose(answer, wanted, atol=1e-5)


def test_rate_dependence_holds_back_a_ramp_by_its_rate():
    viscous = with_strength(make_effect("rate_dependence", RANGE, tau_s=0.1), share=0.5)
    ramp = 0.25 * 0.001 * torch.arange(3000)
    assert float((ramp - run(viscous, ramp, 0.001)[:, 0])[-1]) == pytest.approx(0.0125, rel=0.01)
    assert float(run(viscous, torch.ones(3000))[-1, 0]) == pytest.approx(1.0, abs=1e-6)


def test_rate_dependence_of_a_thinning_fluid_keeps_back_the_root_of_the_rate():
    shape = {"tau_s": 0.1, "turn": 1e-3}
    thin = with_strength(make_effect("rate_dependence", RANGE, **shape), share=1.0)
    # stress^2 / (tau USUAL) = rate where nearly all of the flow is beyond the turn
    for rate in (0.25, 1.0):
        ramp = rate * 0.001 * torch.arange(800)
        behind = float((ramp - run(thin, ramp, 0.001)[:, 0])[-1])
        assert behind == pytest.approx(math.sqrt(rate * 0.1 * 0.1), rel=0.02)


def test_rate_dependence_is_the_integral_of_its_equation():
    """Against another solver, in steps from row to row."""
    turn, command = 0.05, [0.9] * 50 + [0.2] * 50
    wall = with_strength(make_effect("rate_dependence", RANGE, tau_s=0.3, turn=turn), share=1.0)
    answer = run(wall, torch.tensor(command), 0.02)[:, 0]

    def slope(t, y):
        stress = command[min(int(t / 0.02), 99)] - y[0]
        return [stress / 0.3 * (1 + abs(stress) / turn) / (1 + 0.1 / turn)]

    t = 0.02 * np.arange(1, 101)
    truth = solve_ivp(slope, (0, 2), [0.0], t_eval=t, max_step=0.002, rtol=1e-8).y[0]
    assert np.abs(answer.numpy() - truth).max() < 1e-3


def test_softening_leaves_the_first_loading_and_softens_the_second():
    soft = with_strength(make_effect("softening", RANGE, width=0.2, growth=0.1), own=0.2)
    sweep = torch.cat(
        [torch.linspace(0, 1, 11), torch.linspace(1, 0, 11), torch.linspace(0, 1, 11)]
    )
    answer = run(soft, sweep)[:, 0]
    assert torch.equal(answer[:11], sweep[:11])
    assert float(answer[-6]) == pytest.approx(0.5 * (1 + 0.2 * (1 - math.exp(-0.75 / 0.3))), 1e-4)
    assert float(answer[-1]) == pytest.approx(1.0, abs=1e-6)


def test_softening_of_wall_fibres_that_the_other_chambers_shorten():
    soft = make_effect("softening", RANGE, width=0.2, growth=0.1, others=-0.5)
    answer = run(with_strength(soft, own=0.2), [[1.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    # Lines see (2, -1, -1) / 3, then half of that.
    near = 1 - math.exp(-(1 / 3) / (0.2 + 0.4 / 9))
    far = 1 - math.exp(-(1 / 12) / (0.2 + 0.1 / 9))
    assert torch.allclose(answer[0], torch.tensor([1.0, 0.0, 0.0]), atol=1e-6)
    pushed = torch.tensor([near / 3 + far / 6, *2 * [-near / 6 - far / 12]]) / 1.5
    assert torch.allclose(answer[1], torch.tensor([0.5, 0.0, 0.0]) + 0.2 * pushed, atol=1e-5)


def test_stiffening_of_wall_fibres_that_the_other_chambers_shorten():
    stiff = make_effect("stiffening", RANGE, steepness=0.001, others=-0.5)
    answer = run(with_strength(stiff, own=0.1), [[1.0, 1.0, 0.0]])
    # Lines see (1, 1, -2) / 3 and resist by their cubes.
    assert torch.allclose(answer[0], torch.tensor([1 - 0.1 / 9, 1 - 0.1 / 9, 0.2 / 9]), atol=1e-3)


@pytest.mark.parametrize("name", ["rate_dependence", "softening", "stiffening"])
def test_a_ring_of_lines_responds_equally_to_each_chamber(name):
    ring = make_effect(name, RANGE, others=-0.2, ring=True)
    ring = with_strength(ring, **dict.fromkeys(ring.amplitudes(), 0.3))
    loads = torch.tensor([[1.0, 0.3, 0.0], [0.4, 0.9, 0.1], [0.2, 0.1, 0.0]])
    answer = run(ring, loads)
    for turn in (1, 2):
        turned = run(ring, loads.roll(turn, dims=1))
        assert torch.allclose(turned, answer.roll(turn, dims=1), atol=1e-6)
    assert (answer[2] - loads[2]).abs().max() > 1e-3


def test_stiffening_takes_its_share_at_full_load_and_starts_as_a_cubic():
    stiff = with_strength(make_effect("stiffening", RANGE, steepness=0.01), own=0.2, bend=0.1)
    answer = run(stiff, [1.0, 0.5])[:, 0]
    assert float(answer[0]) == pytest.approx(0.7, abs=1e-5)
    assert float(answer[1]) == pytest.approx(0.5 * (1 - 0.3 * 0.25), abs=1e-3)
    alike = run(with_strength(make_effect("stiffening", RANGE), bend=0.1), torch.ones(1, 3))
    assert torch.allclose(alike, torch.ones(1, 3))


def test_a_section_stiffens_in_bending_and_in_stretch_apart():
    """Cubic laws by hand: the mean load e loses own e^3, what is beyond it bend b B^2."""
    stiff = make_effect("stiffening", RANGE, steepness=0.001, section=True)
    stiff = with_strength(stiff, own=0.2, bend=0.1)
    alone, alike = run(stiff, [[1.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    stretch = (1 - 0.2 / 9) / 3
    assert torch.allclose(alone, stretch + 0.9 * torch.tensor([2.0, -1.0, -1.0]) / 3, atol=1e-4)
    assert torch.allclose(alike, torch.full((3,), 0.8), atol=1e-4)


def test_a_section_softens_in_bending_below_its_largest_bending_only():
    soft = make_effect("softening", RANGE, width=0.2, growth=0.1, section=True)
    soft = with_strength(soft, own=0.2)
    first, alike, again = run(soft, [[1.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.0, 0.5, 0.0]])
    assert first.tolist() == [1.0, 0.0, 0.0]
    assert torch.allclose(alike, torch.full((3,), 0.5))
    # Bending of one half: the energy is 1 / 4 and was 1.
    more = 0.2 * (1 - math.exp(-0.75 / (0.2 + 0.1)))
    bend = torch.tensor([-1.0, 2.0, -1.0]) / 6
    assert torch.allclose(again, torch.tensor([0.0, 0.5, 0.0]) + more * bend, atol=1e-5)


def test_chambers_across_in_a_section_of_four_bend_by_their_difference():
    four = ArmFacts(torch.zeros(4), torch.full((4,), 50.0), torch.zeros(4), torch.zeros(1, 3))
    stiff = make_effect("stiffening", four, steepness=0.001, section=True)
    x = torch.tensor([[[50.0, 0.0, 50.0, 0.0], [50.0, 25.0, 0.0, 0.0]]])
    lost = (x - with_strength(stiff, bend=0.1).apply(x, x.new_zeros(1, 2, 0)))[0] / 50
    assert lost[0].tolist() == pytest.approx([0.0, 0.0, 0.0, 0.0])
    # Half the differences across, 0.5 and 0.25, whose square counts 1.25 in all.
    assert lost[1].tolist() == pytest.approx([0.0625, 0.03125, -0.0625, -0.03125], abs=1e-4)


def test_opposed_chambers_of_four_bend_nothing_and_neighbours_add_up():
    """Losses of a nearly cubic spring: 0.1 x B^2 with B^2 = 0, and 1.25 for loads of 1 and 0.5."""
    four = ArmFacts(torch.zeros(4), torch.full((4,), 50.0), torch.zeros(4), torch.zeros(1, 3))
    stiff = with_strength(make_effect("stiffening", four, steepness=0.001), bend=0.1)
    x = torch.tensor([[[50.0, 0.0, 50.0, 0.0], [50.0, 25.0, 0.0, 0.0]]])
    answer = stiff.apply(x, stiff.scan(stiff.rest(x[:, 0]), x, Context(torch.zeros(1, 2))))[0] / 50
    assert answer[0].tolist() == pytest.approx([1.0, 0.0, 1.0, 0.0])
    assert answer[1].tolist() == pytest.approx([1 - 0.125, 0.5 - 0.0625, 0.0, 0.0], abs=1e-3)


def test_a_dead_zone_of_one_chamber_leaves_the_others():
    zone = make_effect("dead_zone", RANGE, width=0.02, each=True)
    answer = run(with_strength(zone, threshold=[0.0, 0.1, 0.0]), [[0.5, 0.5, 0.5]])[0].tolist()
    assert answer == pytest.approx([0.5, 0.4, 0.5], abs=1e-3)


def test_a_room_that_is_as_warm_as_in_the_fit_changes_nothing():
    warm = with_strength(
        make_effect("drift", replace(RANGE, temperature_C=25.0), kind="temperature"), gain=0.1
    )
    assert warm.reference_C == 25.0
    x, room = torch.full((1, 2, 3), 25.0), torch.tensor([[25.0, 35.0]])
    seen = Context(torch.ones(1, 2), None, room)
    answer = warm.apply(x, warm.scan(warm.rest(x[:, 0]), x, seen))[0, :, 0]
    assert answer.tolist() == pytest.approx([25.0, 27.5])


def test_dead_zone_is_flat_at_rest_and_short_by_the_threshold_beyond():
    dead = with_strength(make_effect("dead_zone", RANGE, width=0.05), threshold=0.05)
    answer = run(dead, [0.001, 1.0, -1.0])[:, 0]
    assert abs(float(answer[0])) < 1e-5
    assert answer[1:].tolist() == pytest.approx([0.95, -0.95], abs=1e-4)


def test_gains_and_coupling_by_hand():
    gain = with_strength(make_effect("gain_mismatch", RANGE), gain=[0.1, 0.0, -0.2])
    assert run(gain, [[0.5, 0.5, 0.5]])[0].tolist() == pytest.approx([0.55, 0.5, 0.4])
    coupled = with_strength(make_effect("coupling", RANGE), linear=0.1, quadratic=0.2)
    assert run(coupled, [[0.5, 1.0, 0.0]])[0].tolist() == pytest.approx(
        [0.5 - 0.1 - 0.2, 1.0 - 0.05 - 0.05, -0.15 - 0.25]
    )


def test_a_shifted_zero_adds_the_same_at_rest_and_under_load():
    """An arm from 10 to 50 kPa that rests at 20: a tenth of the 30 kPa up to the end is 3 kPa."""
    resting = replace(RANGE, low=torch.full((3,), 10.0), high=torch.full((3,), 50.0))
    resting = replace(resting, rest=torch.full((3,), 20.0))
    shifted = with_strength(make_effect("zero_offset", resting), offset=[0.1, 0.0, -0.2])
    for kPa in (10.0, 20.0, 47.0):
        answer = shifted.apply(torch.full((1, 3), kPa), torch.zeros(1, 0))
        assert answer[0].tolist() == pytest.approx([kPa + 3.0, kPa, kPa - 6.0])


@pytest.mark.parametrize(
    ("name", "options", "memory"),
    [
        ("gain_mismatch", {}, ()),
        ("drift", {"kind": "actuation"}, (600.0,)),
        ("drift", {"kind": "temperature"}, (10.0,)),
    ],
)
def test_gains_leave_the_actuation_at_rest_as_it_is(name, options, memory):
    """An arm that rests at 20 kPa of 10 to 50, 20 % more gain: 20 stays, 30 becomes 32, 10 is 8."""
    resting = replace(RANGE, low=torch.full((3,), 10.0), rest=torch.full((3,), 20.0))
    effect = with_strength(make_effect(name, resting, **options), gain=0.2)
    answer = effect.apply(torch.tensor([[20.0, 30.0, 10.0]]), torch.tensor([memory]))
    assert answer[0].tolist() == pytest.approx([20.0, 32.0, 8.0])


def test_pairs_couple_one_way_each():
    """The quadratic losses come row by row: chamber 1 by 2, 1 by 3, 2 by 1, ..."""
    losses = [0.1, 0.0, 0.3, 0.0, 0.0, 0.5]
    paired = with_strength(make_effect("coupling", RANGE, pairs=True), quadratic=losses)
    answer = run(paired, [[0.5, 1.0, 0.0]])[0].tolist()
    assert answer == pytest.approx([0.5 - 0.1, 1.0 - 0.3 * 0.25, -0.5])


def test_a_neighbour_takes_a_share_of_what_a_chamber_pushes():
    """A fifth of its own times the load of the next chamber, of the previous one, or of both."""
    lost = {"next": [0.1, 0.08, 0.04], "previous": [0.04, 0.1, 0.08], "all": [0.14, 0.18, 0.12]}
    for who, expected in lost.items():
        coupled = with_strength(make_effect("coupling", RANGE, who=who), product=0.2)
        answer = run(coupled, [[0.5, 1.0, 0.4]])[0].tolist()
        assert answer == pytest.approx([0.5 - expected[0], 1.0 - expected[1], 0.4 - expected[2]])


def test_walls_between_chambers_yield_to_the_difference_of_loads():
    """A fifth of the own load times the differences to its neighbours, or their roots."""
    plate = with_strength(make_effect("coupling", RANGE, who="beside"), yielded=0.2)
    lost = [0.2 * 0.5 * (0.5 - 0.5), 0.2 * 1.0 * (-0.5 - 1.0), 0.0]
    answer = run(plate, [[0.5, 1.0, 0.0]])[0].tolist()
    assert answer == pytest.approx([0.5 - lost[0], 1.0 - lost[1], 0.0], abs=1e-6)
    slack = with_strength(make_effect("coupling", RANGE, who="beside", power=0.5), yielded=0.2)
    root, unit = 0.5 / (0.25 + 0.05**2) ** 0.25, 1.0 / (1.0 + 0.05**2) ** 0.25
    answer = run(slack, [[0.5, 1.0, 0.0]])[0].tolist()
    assert answer == pytest.approx([0.5, 1.0 + 0.2 * (root + unit), 0.0], abs=1e-5)


def test_chambers_beside_each_other_are_neighbours_in_the_ring_of_a_segment():
    three, four, six = (beside(m).int().tolist() for m in (3, 4, 6))
    assert three == [[0, 1, 1], [1, 0, 1], [1, 1, 0]]
    assert four == [[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1], [1, 0, 1, 0]]
    nothing = [0, 0, 0]
    assert six == [*(row + nothing for row in three), *(nothing + row for row in three)]
    assert beside(2).tolist() == [[0, 1], [1, 0]]


@pytest.mark.parametrize(
    ("who", "lost"), [("next", [1, 2, 0, 4, 5, 3]), ("previous", [2, 0, 1, 5, 3, 4])]
)
def test_the_next_chamber_is_that_of_the_ring_of_its_segment(who, lost):
    """Of six chambers in two segments each loses to one of its own segment alone."""
    six = ArmFacts(torch.zeros(6), torch.full((6,), 50.0), torch.zeros(6), torch.zeros(5, 3))
    coupled = with_strength(make_effect("coupling", six, who=who), product=0.2)
    loads = torch.arange(1.0, 7.0)[None] / 10
    assert torch.allclose(run(coupled, loads), loads - 0.2 * loads * loads[:, lost])


def test_loops_of_one_chamber_have_no_mixture_to_fit():
    """Its line is its own actuation; what is fitted are the weights of its play operators."""
    play = make_effect("hysteresis", RANGE, radii=(0.1, 0.3), chamber=1)
    assert play.nonlinear_parameters() == {}
    assert {name: len(p) for name, p in play.amplitudes().items()} == {"own": 2}
    assert torch.equal(play.linear[1], torch.tensor([0.0, 1.0, 0.0]))


def test_damage_is_there_at_the_largest_load_too():
    """Half of the loss at an energy of three widths: 1 - (1 + 3)^(-1/2)."""
    soft = make_effect("softening", RANGE, width=1 / 3, damage=True)
    soft = with_strength(soft, own=0.2)
    answer = run(soft, [0.0, 1.0, 0.5])[:, 0].tolist()
    assert answer == pytest.approx([0.0, 1.1, 0.55])


def test_play_loop_has_its_area():
    """Sweeping by +-A opens a play of radius r by 2 r over a height of 2 (A - r)."""
    play = make_effect("hysteresis", RANGE, radii=(0.3,), ring=True, pairs=False)
    with torch.no_grad():
        play.turned[0, 0] = 0.5
    cycle = 0.5 + 0.4 * torch.sin(torch.linspace(0, 4 * math.pi, 8001))
    answer = run(play, cycle)[:, 0].numpy()[4000:]
    x = cycle.numpy()[4000:]
    area = abs(np.sum((answer[1:] + answer[:-1]) / 2 * np.diff(x)))
    # In loads the half range is 1/2, so the radius is 0.15 and the amplitude 0.4.
    assert area == pytest.approx(0.5 * 4 * 0.15 * (0.4 - 0.15), rel=1e-3)


def test_inertia_overshoots_and_swings_as_an_oscillator_does():
    frequency, damping = 2.0, 0.2
    mode = make_effect("inertia", RANGE, frequency_Hz=frequency, damping=damping)
    t = 0.01 * np.arange(1, 301)
    w, root = 2 * np.pi * frequency, np.sqrt(1 - damping**2)
    swing = np.cos(w * root * t) + damping / root * np.sin(w * root * t)
    wanted = 1 - np.exp(-damping * w * t) * swing
    answer = run(with_strength(mode, share=1), torch.ones(300))[:, 0].numpy()
    assert np.allclose(answer, wanted, atol=1e-4)
    assert answer.max() == pytest.approx(1 + np.exp(-np.pi * damping / root), abs=1e-3)


@pytest.mark.parametrize("rest_mm", [STRAIGHT, STRAIGHT[1:]])
def test_payload_bends_a_level_arm_as_a_cantilever(rest_mm):
    """F s^2 (3L - s) / 6EI and w s^2 (6L^2 - 4Ls + s^2) / 24EI; the base may lack a marker."""
    s = rest_mm[:, 2] / LENGTH
    payload = make_effect("payload", arm(rest_mm, (-1.0, 0.0, 0.0)))
    tip = pose(with_strength(payload, tip_sag=2.0, body_sag=0.0), rest_mm)
    body = pose(with_strength(payload, tip_sag=0.0, body_sag=2.0), rest_mm)
    assert torch.allclose(tip[:, 0], -2.0 * s**2 * (3 - s) / 2, atol=0.01)
    assert torch.allclose(body[:, 0], -2.0 * s**2 * (6 - 4 * s + s**2) / 3, atol=0.01)
    assert torch.equal(tip[:, 1:], rest_mm[:, 1:])


def test_payload_leaves_a_hanging_arm():
    payload = make_effect("payload", arm(STRAIGHT, (0.0, 0.0, 1.0)))
    assert torch.allclose(
        pose(with_strength(payload, tip_sag=5.0, body_sag=5.0), STRAIGHT), STRAIGHT
    )


def test_payload_bends_a_quarter_circle_by_castiglianos_theorem():
    """Against the clamp's tangent by pi / 4 P R^3 / EI, across it by 1 / 2 P R^3 / EI.

    The tip load's moment about the slice at the angle a from the clamp is P R cos a.
    """
    payload = make_effect("payload", arm(QUARTER, (0.0, 0.0, -1.0)))
    length = payload.length_mm
    bent = pose(with_strength(payload, tip_sag=1.0), QUARTER)
    unit = 3 * RADIUS**3 / length**3
    down = QUARTER[-1, 2] - bent[-1, 2]
    across = bent[-1, 0] - QUARTER[-1, 0]
    assert float(down) == pytest.approx(unit * math.pi / 4, rel=0.01)
    assert float(across) == pytest.approx(unit * 0.5, rel=0.01)


def test_an_arm_that_stands_on_a_support_is_not_thrown_aside():
    """Straight, or bent by half a millimetre, under a ceiling 10 mm below its tip: the beam hardly
    yields along the normal, and the tip moves by at most 10 mm / 0.2, as if at that slope."""
    facts = arm(STRAIGHT)
    ceiling = make_effect("contact", facts, point=8, rise_rad=math.pi / 2, offset_mm=70.0)
    bent = STRAIGHT.clone()
    bent[:, 0] = 0.5 * (STRAIGHT[:, 2] / 80.0) ** 2
    for points in (STRAIGHT, bent):
        moved = pose(with_strength(ceiling, share=1.0), points) - points
        assert moved.isfinite().all()
        assert moved.norm(dim=-1).max() <= 10.0 / 0.2 + 1e-3
    assert moved[8, 0] > 40.0


def test_contact_holds_the_point_at_a_rigid_support_and_bends_the_rest():
    facts = arm(STRAIGHT)
    tilted = STRAIGHT + 0.1 * torch.outer(STRAIGHT[:, 2], torch.tensor([1.0, 0.0, 0.0]))
    hold = with_strength(make_effect("contact", facts, point=5, offset_mm=3.0), share=1.0)
    held = pose(hold, tilted)
    moved = (tilted - held)[:, 0]
    assert float(held[5, 0]) == pytest.approx(3.0, abs=1e-3)
    # A cantilever under a force at c: s^2 (3 c - s) up to it, c^2 (3 s - c) beyond.
    s, c = STRAIGHT[:, 2], 50.0
    wanted = torch.where(s < c, s**2 * (3 * c - s), c**2 * (3 * s - c)) / (2 * c**3)
    assert torch.allclose(moved, 2.0 * wanted, atol=0.03)
    free = with_strength(make_effect("contact", facts, point=5, offset_mm=6.0), share=1.0)
    assert torch.equal(pose(free, tilted), tilted)


def test_supports_that_are_tried_together_stand_on_one_side():
    """Supports on opposite sides would be a stiffer wall: all within 45 degrees of each other."""
    sway = torch.linspace(0, 2 * math.pi, 60)
    lean = torch.stack([sway.cos(), sway.sin(), 0 * sway], -1)
    points = STRAIGHT + 0.1 * STRAIGHT[:, 2:] * lean[:, None]
    tried = hypothesis_of(known_effects()["contact"]).candidates(arm(STRAIGHT), points)
    together = hypothesis_of(tried[0]).combinations(tried)
    assert len(together) == 16
    for some in together:
        normals = torch.cat([tried[i].normal.detach()[None] for i in some])
        assert float((normals @ normals.T).min()) == pytest.approx(math.cos(math.pi / 4), abs=1e-5)
        assert len(some) == 3 * 4  # three directions, each at every depth
    assert {i for some in together for i in some} == set(range(len(tried)))


def test_misalignment_is_a_similarity():
    off = make_effect("misalignment", arm(STRAIGHT))
    with_strength(off, turn=[0.1, -0.2, 0.05], shift=[1.0, 2.0, 3.0], scale=0.02)
    turned = Rotation.from_rotvec([0.1, -0.2, 0.05]).apply(QUARTER.numpy())
    assert np.allclose(pose(off, QUARTER), 1.02 * turned + [1, 2, 3], atol=1e-4)


def test_drift_after_ten_minutes_is_its_amplitude_and_saturates():
    drift = make_effect("drift", arm(STRAIGHT), tau_s=300.0)
    with_strength(drift, turn=[0.02, 0.0, 0.01], shift=[0.5, 0.0, 0.0])
    context = Context(torch.tensor([[0.0, 600.0, 1e6]]))
    points = QUARTER.expand(1, 3, -1, -1)
    memory = drift.scan(drift.rest(points[:, 0]), points, context)
    answer = drift.apply(points, memory)[0].detach().numpy()
    assert np.allclose(answer[0], QUARTER, atol=1e-6)
    turned = Rotation.from_rotvec([0.02, 0, 0.01]).apply(QUARTER.numpy()) + np.array([0.5, 0, 0])
    assert np.allclose(answer[1], turned, atol=1e-3)
    assert float(drift.grown(torch.tensor(1e6)).detach()) == pytest.approx(1 / (1 - math.exp(-2)))


def test_drift_goes_on_where_a_new_run_begins():
    drift = make_effect("drift", arm(STRAIGHT))
    points = QUARTER.expand(2, 3, -1, -1)
    t = torch.tensor([[0.0, 1.0, 2.0], [500.0, 501.0, 502.0]])
    dt = torch.tensor([[0.0, 1.0, 1.0]] * 2)
    assert torch.equal(drift.scan(drift.rest(points[:, 0]), points, Context(dt, t))[..., 0], t)


def test_a_regulator_that_drifts_is_off_by_its_amplitudes_after_ten_minutes():
    """Chamber 1 gains a tenth of its 25 kPa and 2 % of the range of 50 kPa, chamber 2 nothing."""
    drift = make_effect("drift", RANGE, kind="actuation", tau_s=600.0)
    with_strength(drift, gain=[0.1, 0.0, 0.0], offset=[0.02, 0.0, 0.0])
    x = torch.full((1, 3, 3), 25.0)
    seen = Context(torch.zeros(1, 3), torch.tensor([[0.0, 300.0, 600.0]]))
    answer = drift.apply(x, drift.scan(drift.rest(x[:, 0]), x, seen))[0]
    half = (1 - math.exp(-0.5)) / (1 - math.exp(-1))
    assert answer[:, 0].tolist() == pytest.approx([25.0, 25.0 + half * 3.5, 28.5])
    assert answer[:, 1].tolist() == [25.0] * 3
    assert drift.stage == "material"


def test_warm_rooms_change_the_gain_and_unknown_ones_nothing():
    warm = with_strength(make_effect("drift", RANGE, kind="temperature"), gain=0.1, offset=0.02)
    x = torch.full((1, 3, 3), 25.0)
    room = torch.tensor([[22.0, 27.0, torch.nan]])
    memory = warm.scan(warm.rest(x[:, 0]), x, Context(torch.ones(1, 3), None, room))
    answer = warm.apply(x, memory)[0, :, 0] / 50
    assert answer.tolist() == pytest.approx([0.5, 0.5 + 0.5 * (0.05 + 0.02), 0.5])
    assert warm.stage == "material"


def test_twist_moves_a_bent_arm_out_of_its_plane_by_the_area_under_it():
    """1 / L int (r - r(0)) x dr is twice the area between arc and chord, over the length."""
    twist = with_strength(make_effect("twist", arm(QUARTER)), linear=0.1)
    answer = pose(twist, QUARTER, torch.ones(1, 1)) - QUARTER
    area = RADIUS**2 * (math.pi / 4 - 0.5)
    assert abs(float(answer[-1, 1])) == pytest.approx(0.1 * 2 * area / twist_length(), rel=0.01)
    assert float(answer[:, [0, 2]].abs().max()) < 1e-4
    assert torch.allclose(pose(twist, STRAIGHT_13, torch.ones(1, 1)), STRAIGHT_13)


def test_twist_by_a_suction_is_the_opposite_of_that_by_a_pressure():
    """Of both parts, the one that grows with the square of the load too."""
    for part in ("linear", "quadratic"):
        twist = with_strength(make_effect("twist", arm(QUARTER)), **{part: 0.1})
        pushed, drawn = (pose(twist, QUARTER, torch.tensor([[x]])) - QUARTER for x in (0.5, -0.5))
        assert torch.allclose(drawn, -pushed, atol=1e-4)
        assert float(pushed.abs().max()) > 0.1


def test_what_weight_bends_keeps_its_plane_when_the_body_is_twisted():
    """At rest a hanging share of 1 leaves the arm where it is; a straightened arm goes beyond."""
    twist = with_strength(make_effect("twist", arm(QUARTER), hanging=1.0), linear=0.1)
    assert torch.allclose(pose(twist, QUARTER, torch.ones(1, 1)), QUARTER, atol=1e-4)
    cast = with_strength(make_effect("twist", arm(QUARTER)), linear=0.1)
    moved = pose(cast, QUARTER, torch.ones(1, 1)) - QUARTER
    answer = pose(twist, STRAIGHT_13, torch.ones(1, 1))
    assert torch.allclose(answer, STRAIGHT_13 - moved, atol=1e-4)
    tried = hypothesis_of(known_effects()["twist"]).candidates
    assert [e.config()["hanging"] for e in tried(arm(QUARTER), QUARTER[None])] == [None, 1.0]
    assert len(tried(arm(STRAIGHT_13), QUARTER[None])) == 1


STRAIGHT_13 = torch.outer(torch.linspace(0, 60, 13), torch.tensor([0.0, 0.0, 1.0]))


def twist_length() -> float:
    """Sum of the quarter circle's chords, mm."""
    return float(QUARTER.diff(dim=0).norm(dim=-1).sum())


def test_a_twist_that_saturates_is_plausible_and_one_by_more_than_a_radian_at_half_load_is_not():
    """Parts of opposite signs: 0.75 rad at half load; one part alone: 1.5 rad."""
    saturating = with_strength(make_effect("twist", RANGE), linear=3.3, quadratic=-3.6)
    large = with_strength(make_effect("twist", RANGE), linear=3.0, quadratic=0.0)
    assert saturating.plausible()
    assert not large.plausible()
    (half,) = [q.value for q in saturating.quantities() if q.name == "half_load_rad"]
    assert half == pytest.approx(0.75)
