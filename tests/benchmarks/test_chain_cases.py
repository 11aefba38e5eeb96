"""The chain of rigid links against closed forms, and what its generator of cases writes."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks import rig_cases
from benchmarks.chain.gas import AMBIENT_PA, CHOKED, Gas, discharge, fill, flow
from benchmarks.chain.hidden import HIDDEN
from benchmarks.chain.plant import move, new_state, place_links
from benchmarks.chain.rig import ChainRig
from benchmarks.chain.robot import BUILDS, make_robot
from benchmarks.chain.wall import (
    DAMAGE_ENERGY,
    RELAXATION_POWER,
    RELAXED_STRESS,
    Wall,
    new_memory,
    rate_of,
    relaxed,
    remember,
    wall_stress,
)
from benchmarks.chain_cases import GENERATOR, UNKNOWN
from benchmarks.decision import folders
from benchmarks.rig_cases import (
    KNOWN,
    LATER_KNOWN,
    Case,
    cases,
    later,
    load_case,
    make_case,
)
from benchmarks.rig_cases import (
    make_robot as record_robot,
)
from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol as Schedule

PLAIN = Wall(0.05, np.zeros(2), np.zeros(2), 0.0, 0.0, np.array([0.0, 0.5]))
"""A linear wall."""


def even_arm(**fields):
    """An arm of robot 600 with equal links, straight and without friction; SI units."""
    plant = make_robot(600).plant
    count = len(plant.mass)
    equal = {
        name: np.full(count, getattr(plant, name).mean()) for name in ("bend", "axial", "mass")
    }
    angle = plant.high * plant.areas[0].max() * np.hypot(*plant.levers[0]) / equal["bend"]
    plant = plant._replace(
        **equal, angle=angle, bow=np.zeros((count, 2)), tip=0.0, growth=0.0, wall=PLAIN
    )
    return plant._replace(**fields)


def test_a_cantilever_sags_under_its_own_weight():
    """w L^4 / (8 B) of a clamped beam under an even weight w, for small sag."""
    light = np.array([0.02, 0.0, 0.0])
    plant = even_arm(gravity=light)
    count = len(plant.mass)
    length, beam = count * plant.link, plant.bend[0] * plant.link
    sag = plant.mass.sum() / length * light[0] * length**4 / (8.0 * beam)
    assert 1e-5 < sag / length < 1e-2
    assert new_state(plant).nodes[-1, 0] == pytest.approx(sag, rel=5e-3)


def test_pressure_bends_a_weightless_arm_to_an_arc():
    """A constant couple p A d on a beam B: the arc of angle p A d L / B on the stretched length."""
    plant = even_arm(gravity=np.zeros(3))
    count, (x, y) = len(plant.mass), plant.levers[0]
    force = plant.high * plant.areas[0, 0]
    turn = force * math.hypot(x, y) * count / plant.bend[0]
    length = count * plant.link * (1.0 + force / plant.axial[0])
    state = new_state(plant)
    state.air[1, 0] = plant.high
    for _ in range(600):
        move(plant, state, 0.01)
    place_links(plant, state)
    aside, along = length / turn * (1.0 - math.cos(turn)), length / turn * math.sin(turn)
    towards = -np.array([x, y]) / math.hypot(x, y)  # a chamber bends the arm away from its side
    assert turn > 0.7
    np.testing.assert_allclose(state.nodes[-1], [*(aside * towards), along], atol=2e-3 * length)


def test_friction_encloses_the_area_of_berg():
    """Berg (1998), eq. for the loss of a cycle of amplitude x_0 about zero."""
    limit, half, reach = 0.1, 0.2, 0.5
    wall = PLAIN._replace(friction=np.array([limit, half]))
    memory, carried = new_memory(1), np.zeros(3)
    path = reach * np.sin(np.linspace(0.0, 6 * np.pi, 6001))
    stresses = []
    for before, now in itertools.pairwise(path):
        one, two = np.array([before, 0.0, 0.0]), np.array([now, 0.0, 0.0])
        remember(wall, memory, 0, one, two, 0.01)
        wall_stress(wall, memory, 0, two, 0.0, carried)
        stresses.append(carried[0])
    last = slice(4000, 6000)
    loss = np.trapezoid(np.array(stresses)[last], path[1:][last])
    held = (math.sqrt(half**2 + reach**2 + 6 * half * reach) - half - reach) / (2 * half)
    wide = half * (1 + held)
    closed = 2 * limit * (2 * reach - wide * (1 + held) * math.log((wide + 2 * reach) / wide))
    assert loss == pytest.approx(closed, rel=3e-3)


def test_a_network_relaxes_by_a_power_of_its_stress():
    """The exact step against the differential equation of Bergstrom & Boyce, integrated."""
    tau, n = 3.0, RELAXATION_POWER
    found = solve_ivp(
        lambda t, s: -s / tau * (s / RELAXED_STRESS) ** (n - 1),
        (0, 20),
        [0.2],
        rtol=1e-9,
        atol=1e-12,
    )
    stress = 0.2
    for _ in range(200):
        stress = relaxed(stress, tau, 0.1)
    assert stress == pytest.approx(found.y[0, -1], rel=1e-5)
    assert stress < 0.1


def test_damage_keeps_first_loading_and_softens_the_way_back():
    wall = PLAIN._replace(damage=0.5)
    memory, carried, zero = new_memory(1), np.zeros(3), np.zeros(3)
    top, back = np.array([0.8, 0.0, 0.0]), np.array([0.4, 0.0, 0.0])
    wall_stress(wall, memory, 0, top, 0.0, carried)
    assert carried[0] == pytest.approx(0.8)
    remember(wall, memory, 0, zero, top, 0.01)
    wall_stress(wall, memory, 0, back, 0.0, carried)
    most, now = (0.5 * w / (w + DAMAGE_ENERGY) for w in (0.32, 0.08))
    assert carried[0] == pytest.approx(0.4 * (1 - most) / (1 - now))


@pytest.mark.parametrize("power", [0.4, 0.8])
def test_dashpots_in_parallel_carry_the_stress(power):
    """Linear, power-law and the implicit spring together carry what is lacking."""
    wall = PLAIN._replace(fluid=np.array([0.2, power]))
    for lack in (1e-3, -0.05, 0.7):
        rate = rate_of(wall, lack, 1.3, 0.01)
        carried = (0.05 + 1.3 * 0.01) * rate + math.copysign(0.2 * abs(rate) ** power, rate)
        assert carried == pytest.approx(lack, rel=1e-6)


def test_flow_is_choked_below_the_critical_ratio():
    """Saint-Venant & Wantzel: below r* = 0.528 the flow depends on the pressure in front alone; in
    between as psi(r) times Perry's coefficient, 0.84 choked and 0.60 of slow flow."""
    assert pytest.approx(0.5283, abs=1e-4) == CHOKED
    assert discharge(1.0) == pytest.approx(0.60, abs=1e-3)
    assert flow(4e5, 1e5) == flow(4e5, 2e5) == pytest.approx(4e5)
    assert flow(1e5, 4e5) == -flow(4e5, 1e5)
    most = (2 / 2.4) ** (1 / 0.4) * math.sqrt(0.4 / 2.4)  # of psi, at r*
    share = math.sqrt(0.8 ** (2 / 1.4) - 0.8 ** (2.4 / 1.4)) / most
    assert flow(4e5, 3.2e5) == pytest.approx(4e5 * share * discharge(0.8) / discharge(CHOKED))


def test_a_chamber_fills_at_a_constant_rate_while_the_flow_is_choked():
    gas = Gas(line=np.array([0.5]), rate=1e9)
    front = 3.0 * AMBIENT_PA
    air = np.array([[front], [0.0]])
    pressures = []
    for _ in range(20):
        fill(gas, np.ones(1), np.array([front]), air, 0.01)
        pressures.append(air[1, 0])
    rates = np.diff(pressures) / 0.01
    np.testing.assert_allclose(rates, 0.5 * (front + AMBIENT_PA), rtol=1e-9)


def test_noise_and_dropped_frames_are_those_of_the_cameras():
    cameras = make_robot(601).cameras
    rng = np.random.default_rng(1)
    noise = cameras.noise(20_000, 3, rng)
    assert np.std(noise) == pytest.approx(math.hypot(cameras.white_mm, cameras.slow_mm), rel=0.03)
    lag = np.mean(noise[1:] * noise[:-1])
    keep = math.exp(-cameras.period_s / cameras.slow_s)
    assert lag == pytest.approx(keep * cameras.slow_mm**2, rel=0.2)
    assert cameras.dropped > 0.0
    cameras.drop_frames(noise, rng)
    lost = np.isnan(noise).any(axis=2).all(axis=1).mean()
    assert lost == pytest.approx(cameras.dropped, rel=0.4)


def test_the_generator_has_every_known_effect_and_no_name_for_the_others():
    assert set(HIDDEN) == {*KNOWN, *LATER_KNOWN, *UNKNOWN}
    planned = cases(GENERATOR, [600, 601], 29, seed=1)
    assert {case.names[0] for case in planned if len(case.names) == 1} == {*HIDDEN} - {*LATER_KNOWN}
    assert {make_robot(seed).plant.areas.shape[0] for seed in range(600, 606)} == {3, 4, 6}


def test_every_effect_changes_the_motion_and_nothing_else_does():
    """Without any the motion is equal to the last bit."""
    rig = ChainRig(600, noise=0.0)
    protocol = rig_cases.excitation(rig, "tried", ("steps", "wander"), 100.0, 600)
    plain = rig.record(protocol)[1].noise_free_mm
    again = ChainRig(600, noise=0.0).record(protocol)[1].noise_free_mm
    np.testing.assert_array_equal(again, plain)
    for name in HIDDEN:
        moved = ChainRig(600, noise=0.0, hidden=[(name, 2.0)]).record(protocol)[1]
        share = rig_cases.change_mm(moved.noise_free_mm, plain) / rig.arm.length_mm
        assert 5e-4 < share < 0.3, name


def test_an_arm_whose_sensors_have_shifted_zeros_does_what_it_would_at_other_pressures():
    """Readings follow the commands. Where the zero reads too much, the chamber has less air."""
    rig = ChainRig(600, noise=0.0)
    commands = 0.5 * rig.limits[:, 1] + np.array([[0.0, 5.0, -5.0], [5.0, -5.0, 0.0]])
    held = Schedule("held", "continuous", commands, [0, 0], [0.0, 8.0], unit="kPa")
    seen, moved = ChainRig(600, noise=0.0, hidden=[("zero_offset", 1.5)]).record(held)
    plain = rig.record(held)[0]
    np.testing.assert_allclose(seen.measured[-1], plain.measured[-1], atol=0.02)
    shift = moved.pressures_kPa[-1] - seen.measured[-1]
    least, second, most = np.sort(np.abs(shift) / rig.limits[0, 1])
    assert (least, most) == pytest.approx((0.0, 0.06), abs=1e-3)
    assert 0.017 < second < 0.061
    other = Schedule("other", "continuous", commands + shift, [0, 0], [0.0, 8.0], unit="kPa")
    there = ChainRig(600, noise=0.0).record(other)[1]
    np.testing.assert_allclose(moved.noise_free_mm[-1], there.noise_free_mm[-1], atol=0.01)
    lowest = rig.limits[:, 0] + 0 * commands
    vented = Schedule("vented", "continuous", lowest, [0, 0], [0.0, 8.0], unit="kPa")
    seen, moved = ChainRig(600, noise=0.0, hidden=[("zero_offset", 1.5)]).record(vented)
    more, less = np.maximum(shift, 0.0), np.maximum(-shift, 0.0)
    np.testing.assert_allclose(moved.pressures_kPa[-1], rig.limits[:, 0] + more, atol=0.02)
    np.testing.assert_allclose(seen.measured[-1], rig.limits[:, 0] + less, atol=0.02)


def test_effects_that_joined_later_have_a_plan_of_their_own():
    found = later([600, 601], 5, seed=3)
    assert [case.names for case in found] == [("zero_offset",)] * 5
    assert {case.robot for case in found} == {600, 601}
    assert found[0].truth == ["zero_offset"]
    assert found[4].name == "later-004"


def test_a_case_changes_as_much_as_is_drawn(tmp_path):
    """A mm on each 100 mm of an arm, of an effect that grows with time: on the case's schedule."""
    record_robot(GENERATOR, tmp_path, 601)
    make_case(GENERATOR, tmp_path, Case(0, 601, ("drift",), 1.0, "same"))
    truth, before, after = load_case(tmp_path, "000")
    np.testing.assert_array_equal(before[0].commanded, after[0].commanded)
    assert truth["truth"] == ["drift"]
    assert truth["change_rms_mm"] == pytest.approx(after[0].arm.length_mm / 100, rel=0.02)
    change = np.linalg.norm(after[0].key_points_mm - before[0].key_points_mm, axis=2)
    noise = math.sqrt(6.0) * truth["noise_mm"]
    found = math.sqrt(np.nanmean(change**2) - noise**2)
    assert found == pytest.approx(truth["change_rms_mm"], rel=0.1)


def test_recordings_are_longer_by_the_factor_and_of_one_factor_in_a_folder(tmp_path):
    """A quarter of the durations: 150 s after a change, and those of the build before it."""
    short = replace(GENERATOR, longer=0.25)
    record_robot(short, tmp_path, 601)
    make_case(short, tmp_path, Case(0, 601, (), 1.0, "brisk"))
    _, before, after = load_case(tmp_path, "000")
    lasts = [each.samples * np.median(np.diff(each.t_s)) for each in (*after, *before)]
    whole = [150.0, *GENERATOR.before_s(601).values()]
    assert sorted(lasts) == pytest.approx(sorted(0.25 * each for each in whole), rel=0.03)
    with pytest.raises(InputError, match=r"made with --longer 0\.25, expected 1"):
        record_robot(GENERATOR, tmp_path, 601)


def test_a_robot_states_the_budget_of_its_fit(tmp_path, monkeypatch):
    """What `robot.json` states goes to the fit, and an undertrained model has fewer epochs."""
    asked = []
    (tmp_path / "robots" / "601" / "before").mkdir(parents=True)
    about = GENERATOR.about(601)
    (tmp_path / "robots" / "601" / "robot.json").write_text(json.dumps(about))

    def no_fit(recordings, **fields):
        asked.append(fields["epochs"])
        raise InterruptedError

    monkeypatch.setattr(folders, "fit", no_fit)
    for few in (False, True):
        with pytest.raises(InterruptedError):
            folders.model_folder(tmp_path, "601", tmp_path / "work", few)
    assert asked == [BUILDS[601 % len(BUILDS)].epochs, folders.FEW_EPOCHS]


def test_a_model_is_that_of_the_defaults_or_a_network_alone(tmp_path, monkeypatch):
    """The model that the cases were made with is a network alone, and asked as such."""
    asked, place = [], tmp_path / "robots" / "1"
    (place / "before").mkdir(parents=True)
    (place / "robot.json").write_text('{"fit": {"effects": []}}')

    def no_fit(recordings, **fields):
        asked.append((fields["prior"], fields["effects"]))
        raise InterruptedError

    monkeypatch.setattr(folders, "fit", no_fit)
    for models in ("default", "alone"):
        with pytest.raises(InterruptedError):
            folders.model_folder(tmp_path, "1", tmp_path / "work", models=models)
    (place / "model").mkdir()
    (place / "model" / "config.json").write_text("{}")
    with pytest.raises(InterruptedError):
        folders.model_folder(tmp_path, "1", tmp_path / "work")
    assert folders.model_folder(tmp_path, "1", tmp_path, models="alone") == place / "model"
    assert asked == [(None, []), ("none", []), (None, [])]
