"""The PyElastica rig: closed forms of mechanics and flow, PyElastica's own loop, and the `Rig`."""

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

pytest.importorskip("elastica", reason="PyElastica is not installed (extra `elastica`)")

from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import load_recording
from surgisoft.rig import elastica as package
from surgisoft.rig.collect import collect
from surgisoft.rig.elastica import HIDDEN, ElasticaRig
from surgisoft.rig.elastica.gas import AMBIENT_PA, Air, Gas, fill_chambers, flow
from surgisoft.rig.elastica.hidden import Setup, switch_on
from surgisoft.rig.elastica.plant import advance, new_state
from surgisoft.rig.elastica.robot import make_robot
from surgisoft.rig.elastica.rod import (
    accelerate,
    largest_step,
    measure_strains,
    move_half,
    straight_body,
)
from surgisoft.rig.elastica.wall import Wall, new_memory, strain_wall
from surgisoft.rig.interface import Rig, SimulatedRig
from surgisoft.rig.registry import known_size
from surgisoft.tasks.track import track_circle

PLAIN = Wall(np.zeros(2), np.ones(2), np.zeros(3), 0.0, 0.0, 0.0)
"""A linear wall."""


def stepped(body, seconds, damping, gravity, tip=(0.0, 0.0, 0.0), watch=None):
    """Step a clamped rod for a time [s]; tip: force at its end [N]; watch: called every step."""
    step = largest_step(body)
    keep, zero, axes = float(np.exp(-damping * step)), np.zeros(3), np.eye(3)
    for _ in range(round(seconds / step)):
        move_half(body, step, zero, axes)
        measure_strains(body)
        body.external_forces[:, -1] += tip
        accelerate(body, step, keep, np.array(gravity), np.zeros((2, 3)), 0.0, zero)
        move_half(body, step, zero, axes)
        if watch is not None:
            watch()
    return step


def test_the_loop_gives_the_motion_of_pyelastica():
    """Sagging for 0.1 s in PyElastica's `PositionVerlet` and in the rig's loop: equal positions."""
    import elastica
    from elastica.timestepper.symplectic_steppers import PositionVerlet

    class Bench(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing,
                elastica.Damping):  # fmt: skip
        pass

    body = straight_body(8, 0.09, 0.01, 1000.0, 1e5)
    step = stepped(body, 0.1, 12.0, (3.0, -4.0, 8.0))
    bench = Bench()
    rod = elastica.CosseratRod.straight_rod(
        8, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), 0.09, 0.01, 1000.0,
        youngs_modulus=1e5, shear_modulus=1e5 / 3,
    )  # fmt: skip
    bench.append(rod)
    bench.constrain(rod).using(
        elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    bench.add_forcing_to(rod).using(elastica.GravityForces, acc_gravity=np.array([3.0, -4.0, 8.0]))
    bench.dampen(rod).using(
        elastica.AnalyticalLinearDamper, uniform_damping_constant=12.0, time_step=step
    )
    bench.finalize()
    stepper, time = PositionVerlet(), 0.0
    for _ in range(round(0.1 / step)):
        time = stepper.step(bench, time, step)
    assert abs(rod.position_collection[0, -1]) > 1e-3
    np.testing.assert_allclose(body.position, rod.position_collection, rtol=0, atol=1e-9)
    np.testing.assert_allclose(body.omega, rod.omega_collection, rtol=0, atol=1e-6)


def extrapolated(tip_of):
    """Limit of fine elements from 10 and 20: PyElastica's clamp holds the whole first element, so
    that its error is of first order in the element's length."""
    return 2 * tip_of(20) - tip_of(10)


def test_cantilever_under_a_small_tip_force():
    """Timoshenko's cantilever: P L^3 / (3 E I) + P L / (k G A)."""
    length, radius, modulus = 0.1, 0.006, 1e5
    second, force = np.pi / 4 * radius**4, 1e-4

    def tip_of(elements):
        body = straight_body(elements, length, radius, 1000.0, modulus)
        stepped(body, 1.2, 20.0, (0.0, 0.0, 0.0), (force, 0.0, 0.0))
        return body.position[0, -1]

    sag = force * length**3 / (3 * modulus * second)
    sag += force * length / (27 / 28 * modulus / 3 * np.pi * radius**2)
    assert extrapolated(tip_of) == pytest.approx(sag, rel=0.01)


def test_large_deflection_under_a_tip_force():
    """Elastica of Bisshopp & Drucker (1945), P L^2 / (E I) = 1, by its elliptic integral."""
    length, radius, modulus = 0.1, 0.004, 1e5
    stiffness = modulus * np.pi / 4 * radius**4

    def stretch(end):  # length needed for a slope `end` at the tip, in units sqrt(E I / (2 P))
        # theta = end - u^2 takes the root's singularity out of the integral.
        def over(u):
            return 2 * u / np.sqrt(np.sin(end) - np.sin(end - u * u))

        return quad(over, 0, np.sqrt(end))[0] - np.sqrt(2.0)

    end = brentq(stretch, 0.05, 1.2)
    drop = quad(
        lambda u: 2 * u * np.sin(end - u * u) / np.sqrt(np.sin(end) - np.sin(end - u * u)),
        0, np.sqrt(end),
    )[0] / np.sqrt(2.0)  # fmt: skip
    assert drop == pytest.approx(0.30172, abs=2e-4)  # their table

    def tip_of(elements):
        body = straight_body(elements, length, radius, 1000.0, modulus)
        stepped(body, 2.0, 12.0, (0.0, 0.0, 0.0), (stiffness / length**2, 0.0, 0.0))
        return body.position[0, -1] / length

    assert extrapolated(tip_of) == pytest.approx(drop, rel=0.02)


def test_first_frequency_of_a_cantilever():
    """w = 3.5160 sqrt(E I / (rho A)) / L^2 (Rayleigh); counted from zero crossings of the tip."""
    length, radius, modulus, density = 0.1, 0.004, 1e5, 1000.0

    def frequency_of(elements):
        body = straight_body(elements, length, radius, density, modulus)
        body.velocity[0] = 0.02 * np.linspace(0, 1, elements + 1) ** 2
        tips = []
        step = stepped(
            body, 3.0, 0.0, (0.0, 0.0, 0.0), watch=lambda: tips.append(body.position[0, -1])
        )
        tip = np.array(tips)
        ups = np.flatnonzero((tip[:-1] < 0) & (tip[1:] >= 0))
        return 2 * np.pi * (len(ups) - 1) / ((ups[-1] - ups[0]) * step)

    found = extrapolated(frequency_of)
    theory = 3.5160 * np.sqrt(modulus * radius**2 / 4 / density) / length**2
    assert found == pytest.approx(theory, rel=0.02)


def one_arm(**values):
    """A uniform, weightless arm of one chamber at (0, 4 mm), 12 mm^2; its plant and state."""
    plant, _ = make_robot(3, 10, np.array([0.0, 0.0, 1.0]), 0.0)
    body = straight_body(10, 0.08, 0.008, 1000.0, 1e5)
    plant = plant._replace(
        keep=float(np.exp(-15.0 * plant.step)), gravity=np.zeros(3), wall=PLAIN,
        bend=body.bend_matrix[0, 0].copy(), twist_stiffness=body.bend_matrix[2, 2].copy(),
        axial=body.shear_matrix[2, 2].copy(), bow=np.zeros((2, 9)), radius=0.008,
        areas=np.array([12e-6]), levers=np.array([[0.0, 0.004]]), taper=np.zeros(1), growth=0.0,
        volumes=np.array([1e-6]), unfold=np.zeros(1), stolen=np.zeros((1, 1)), base=np.eye(3),
    )._replace(**values)  # fmt: skip
    return plant, new_state(plant, body)


def test_a_pressure_bends_the_arm_to_a_circle_away_from_its_chamber():
    """p A extends by p A / (E A_arm) and bends by p A y / (E I), away from the chamber at +y."""
    plant, state = one_arm()
    state.air.chamber[:] = 10e3
    advance(plant, state, round(1.5 / plant.step), False)
    push, second = 10e3 * 12e-6, np.pi / 4 * 0.008**4
    strain = push / (1e5 * np.pi * 0.008**2)
    # PyElastica's stiffness in bending falls by the cube of the stretch, its rest strain does not.
    curvature = push * 0.004 / (1e5 * second)
    np.testing.assert_allclose(state.body.sigma[2], strain, rtol=0.03)
    np.testing.assert_allclose(state.body.kappa[0], curvature, rtol=0.03)
    assert np.ptp(state.body.kappa[0]) < 1e-3 * curvature
    assert state.body.position[1, -1] < -0.001
    assert abs(state.body.position[0, -1]) < 1e-6


def test_a_permanent_set_bends_the_arm_without_pressure():
    """Its curvature at rest is a twentieth of that by one full chamber, more near the base."""
    plant, state = one_arm()
    setup = switch_on(Setup(plant, state.body), [("zero_offset", 1.0)], 3)
    advance(setup.plant, state, round(1.5 / plant.step), False)
    bent = np.linalg.norm(state.body.kappa[:2], axis=0) / plant.curvature
    assert bent.mean() == pytest.approx(0.05, rel=0.01)
    assert bent[[0, -1]] == pytest.approx([0.065, 0.035], rel=0.02)
    np.testing.assert_allclose(state.body.kappa[2], 0.0, atol=1e-9)


def test_fibres_at_an_angle_twist_without_bending():
    plant, state = one_arm(levers=np.array([[0.0, 1e-9]]), fibre=0.1)
    plant = plant._replace(levers=np.array([[0.0, 0.004]]), bend=plant.bend * 1e9)
    state.air.chamber[:] = 10e3
    advance(plant, state, round(1.5 / plant.step), False)
    torque = 10e3 * 12e-6 * 0.004 * 0.1  # push times lever times tangent, before stretching
    polar = np.pi / 2 * 0.008**4
    np.testing.assert_allclose(state.body.kappa[2], torque / (1e5 / 3 * polar), rtol=0.05)
    assert abs(state.body.position[:2]).max() < 1e-6


def test_an_obstacle_keeps_the_arm_out():
    plane = np.array([[0.0, -0.013, 0.0], [0.0, 1.0, 0.0]])  # surface 5 mm beside the arm's skin
    ends = []
    for stiffness in (0.0, 100.0):
        plant, state = one_arm(plane=plane, plane_stiffness=stiffness)
        state.air.chamber[:] = 40e3
        advance(plant, state, round(2.0 / plant.step), False)
        ends.append(state.body.position[1, -1])
    assert ends[0] < -0.012
    assert -0.0065 < ends[1] < -0.004


@pytest.mark.parametrize(("high", "low"), [(300e3, 120e3), (200e3, 180e3), (400e3, 90e3)])
def test_flow_is_that_of_iso_6358(high, low):
    """Choked below the critical ratio 0.3, an ellipse above it (ISO 6358-1, formulae 4 and 5)."""
    ratio, b = low / high, 0.3
    expected = 1e-6 * high
    if ratio > b:
        expected *= np.sqrt(1 - ((ratio - b) / (1 - b)) ** 2)
    assert flow(1e-6, high, low) == pytest.approx(expected, rel=1e-12)
    assert flow(1e-6, low, high) == pytest.approx(-expected, rel=1e-12)


def test_a_narrow_tube_fills_its_chamber_in_the_time_of_the_integral():
    """t = int V dp / (C p_1 phi(p / p_1)), from the room to 40 kPa with the tube held at 50 kPa."""
    gas = Gas(
        300e3, 50e3, 1e-3, 1e2, np.array([1e-4]), np.array([3e-7]), np.zeros(1), 1e9, 0.0
    )  # a tube of a litre's tenth holds its pressure
    air = Air(np.array([50e3]), np.array([50e3]), np.zeros(1), np.array([2e-6]))
    one = AMBIENT_PA + 50e3
    time = quad(lambda p: 2e-6 / flow(3e-7, one, AMBIENT_PA + p), 0, 40e3)[0]
    passed, step = 0.0, 2e-4
    while air.chamber[0] < 40e3:
        fill_chambers(gas, air, step, np.array([2e-6]))
        passed += step
    assert passed == pytest.approx(time, rel=0.01)


def strained(wall, path, step=1e-3):
    """Added stress (T,) of a wall along strains (T,), one component at one place."""
    memory, more = new_memory(1, 1), np.zeros((1, 1))
    found = []
    for strain in path:
        strain_wall(wall, 0.0, step, np.array([[strain]]), memory, more)
        found.append(more[0, 0])
    return np.array(found)


def test_friction_slips_at_its_share_and_leaves_a_loop():
    """Bouc & Wen: one-way loading z = tanh(x / x_y) (for exponent 2 and beta = gamma)."""
    wall = PLAIN._replace(friction=np.array([0.1, 0.0]), slip=np.array([0.05, 1.0]))
    up = np.linspace(0, 1, 20_001)
    stress = strained(wall, np.concatenate([up, up[::-1]]))
    np.testing.assert_allclose(stress[:20_001], 0.1 * np.tanh(up / 0.05), atol=1e-4)
    middle = 10_000
    assert stress[middle] - stress[-1 - middle] == pytest.approx(0.2, rel=1e-3)


def test_the_viscous_part_relaxes_as_eyring_says():
    """tanh(y / 2 y_0) falls exponentially; y starts at g times the step of strain."""
    wall = PLAIN._replace(viscous=np.array([0.8, 0.1, 0.5]))
    stress = strained(wall, np.ones(1001), step=1e-3)
    start = np.arctanh(np.exp(-0.001 / 0.5) * np.tanh(0.8 / 0.2)) * 0.2
    assert stress[0] == pytest.approx(start, rel=1e-12)
    end = 0.2 * np.arctanh(np.exp(-1.001 / 0.5) * np.tanh(0.8 / 0.2))
    assert stress[-1] == pytest.approx(end, rel=1e-9)


def test_creep_relaxes_evenly_in_the_logarithm_of_time():
    """A held strain loses a fifth of the creeping share for each factor of four in time."""
    wall = PLAIN._replace(creep=0.5)
    stress = strained(wall, np.ones(12_801), step=0.01)  # 128 s
    times = 0.01 * np.arange(1, 12_802)
    kept = sum(np.exp(-times / tau) for tau in (1, 4, 16, 64, 256)) / 5
    np.testing.assert_allclose(stress, -0.5 * (1 - kept), atol=1e-9)
    falls = [stress[199] - stress[799], stress[799] - stress[3199], stress[3199] - stress[12_799]]
    np.testing.assert_allclose(falls, 0.1, rtol=0.15)


def test_softening_leaves_the_first_loading_and_weakens_what_follows():
    wall = PLAIN._replace(softening=0.4)
    up = np.linspace(0, 1, 101)
    stress = strained(wall, np.concatenate([up, up[::-1], up]))
    np.testing.assert_allclose(stress[:101], 0.0, atol=1e-12)
    damage = [0.4 * (1 - np.exp(-x / 0.5)) for x in (1.0, 0.5)]
    expected = 0.5 * ((1 - damage[0]) / (1 - damage[1]) - 1)
    np.testing.assert_allclose(stress[[151, 252]], expected, rtol=1e-9)
    assert stress[-1] == pytest.approx(0.0, abs=1e-12)


def test_stiffening_is_gents():
    wall = PLAIN._replace(locking=0.25)  # J = 4
    stress = strained(wall, np.array([0.5, 1.0, 1.5]))
    x = np.array([0.5, 1.0, 1.5])
    np.testing.assert_allclose(x + stress, x * 4 / (4 - x**2), rtol=1e-12)


@pytest.fixture(scope="module")
def rig():
    return ElasticaRig(2, elements=8)


def brief(rig, seconds=2.0):
    """A protocol: half of the time up, to the limit of the first chamber, then down to 40 %."""
    high = rig.limits[:, 1] * np.linspace(1.0, 0.0, rig.chambers)
    rows = np.array([0 * high, high, 0.4 * high])
    return Protocol("brief", "continuous", rows, np.zeros(3), seconds * np.array([0.0, 0.5, 1.0]))


def test_it_is_a_rig_that_collect_drives(rig):
    members = {name for name in dir(SimulatedRig) if not name.startswith("_")}
    assert {"command", "read", "read_beside_truth", "gravity"} <= members
    for name in members | set(Rig.__annotations__):
        assert hasattr(rig, name), name
    recording = collect(rig, brief(rig))
    assert recording.samples == round(2.0 / rig.period_s)
    assert recording.key_points == rig.key_planes
    assert recording.chambers == rig.chambers
    np.testing.assert_allclose(np.linalg.norm(rig.gravity), 1.0)
    assert np.ptp(recording.key_points_mm[:, -1], axis=0).max() > 3.0
    high = rig.limits[0, 1]
    assert np.abs(recording.measured - recording.commanded).max() < 0.1 * high
    assert (recording.measured[-1] != recording.commanded[-1]).all()  # sensors have noise
    with pytest.raises(InputError, match="leaves the rig's limits"):
        rig.command(rig.limits[:, 1] + 1.0)


def test_a_reset_takes_the_arm_back_to_where_it_was(rig):
    shapes = []
    for _ in range(2):
        rig.reset()
        rig.command(np.zeros(rig.chambers))
        shapes.append(rig.read_beside_truth()[1].noise_free_mm[0])
        rig.command(rig.limits[:, 1])
        rig.wait(1.0)
    np.testing.assert_allclose(shapes[0], shapes[1], atol=1e-3)


def test_equal_seeds_give_equal_recordings_and_other_takes_other_noise():
    made = []
    for take in (0, 0, 1):
        rig = ElasticaRig(2, elements=8, take=take, hidden=[("hysteresis", 1.0)])
        made.append(rig.record(brief(rig)))
    (one, _), (again, _), (other, truth) = made
    np.testing.assert_array_equal(one.key_points_mm, again.key_points_mm)
    np.testing.assert_array_equal(one.measured, again.measured)
    assert (one.key_points_mm != other.key_points_mm).any()
    np.testing.assert_array_equal(truth.noise_free_mm, made[0][1].noise_free_mm)


SUDDEN = {"knock", "tear", "marker_slip"}
"""Effects that set in at one moment, after these brief recordings."""


@pytest.fixture(scope="module")
def unchanged():
    """A brief protocol of a rig of eight elements, and its key points without an effect."""
    plain = ElasticaRig(2, elements=8, noise=0.0)
    protocol = brief(plain, 3.0)
    return protocol, plain.record(protocol)[1].noise_free_mm


@pytest.mark.parametrize("name", [name for name in HIDDEN if name not in SUDDEN | {"contact"}])
def test_each_hidden_effect_moves_the_key_points(name, unchanged):
    """By more than a hundredth of a millimetre within seconds, and not by more than 2 cm."""
    protocol, expected = unchanged
    changed = ElasticaRig(2, elements=8, noise=0.0, hidden=[(name, 2.0)])
    change = np.linalg.norm(changed.record(protocol)[1].noise_free_mm - expected, axis=2)
    assert 0.01 < change.max() < 20.0


def test_a_wall_is_met_by_one_chamber_at_least():
    plain = ElasticaRig(2, elements=8, noise=0.0)
    changed = ElasticaRig(2, elements=8, noise=0.0, hidden=[("contact", 2.0)])
    tips = []
    for rig in (plain, changed):
        tips.append([])
        for pressures in np.diag(rig.limits[:, 1]):
            rig.reset()
            rig.command(pressures)
            rig.wait(1.5)
            tips[-1].append(rig.read_beside_truth()[1].noise_free_mm[0, -1])
    change = np.linalg.norm(np.subtract(*tips), axis=1)
    assert change.max() > 0.5


def test_a_knock_turns_the_base_at_its_moment():
    """Before the moment nothing; after it the tip has moved by the angle times the length."""
    plain = ElasticaRig(2, elements=8, noise=0.0)
    rig = ElasticaRig(
        2, elements=8, noise=0.0, hidden=[("knock", 1.0)], event_window_s=(31.0, 31.0)
    )
    moved = []
    for each in (plain, rig):
        each.reset()
        tips = [each.read_beside_truth()[1].noise_free_mm[0, -1] for _ in range(30)]
        moved.append(np.array(tips))
    change = np.linalg.norm(moved[1] - moved[0], axis=1)
    times = rig.period_s * np.arange(1, 31)
    assert change[times < 0.95].max() < 1e-6
    assert change[-1] == pytest.approx(2.0, rel=0.5)


def moved_by(name, strength=1.0, moment=31.0, samples=30):
    """(T,) times [s], and (T, n) how far an effect moves the key points under pressure [mm]."""
    moved = []
    for hidden in ((), [(name, strength)]):
        rig = ElasticaRig(2, elements=8, noise=0.0, hidden=hidden, event_window_s=(moment, moment))
        rig.reset()
        rig.command(rig.limits[:, 1] * np.eye(rig.chambers)[0])
        moved.append([rig.read_beside_truth()[1].noise_free_mm[0] for _ in range(samples)])
    times = rig.period_s * np.arange(1, samples + 1)
    return times, np.linalg.norm(np.subtract(*moved), axis=2)


def test_a_tear_bends_the_arm_more_from_its_moment_on():
    """Before the moment nothing; after it the points above the tear move, the tip most."""
    times, change = moved_by("tear", strength=4.0)
    assert change[times < 0.95].max() < 1e-6
    assert change[-1, -1] > 0.1
    assert change[-1, -1] == change[-1].max()


def test_markers_of_one_plane_slip_at_their_moment():
    """By 3 mm at strength 1, along the arm; the body and all other planes stay where they are."""
    times, change = moved_by("marker_slip")
    assert change[times < 0.95].max() < 1e-6
    slipped = change[-1] > 1e-6
    assert slipped.sum() == 1
    assert change[-1][slipped] == pytest.approx(3.0)


def test_the_command_writes_a_recording(tmp_path, capsys):
    out = tmp_path / "r.parquet"
    args = ["collect", "mixed", "--rig", "elastica", "--seed", "2", "--points", "20"]
    assert run([*args, "--hidden", "payload:2", "-o", str(out)]) == 0
    assert "hidden payload 2" in capsys.readouterr().out
    assert load_recording(out).chambers == ElasticaRig(2).chambers
    assert run(["collect", "--rig", "elastica", "--list-hidden"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(HIDDEN)
    assert run([*args[:3], "plastic", "-o", str(tmp_path / "other.parquet")]) == 2
    assert "unknown rig 'plastic'" in capsys.readouterr().err


def test_it_imports_nothing_of_models_or_diagnosis():
    for path in Path(package.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                for side in ("surrogate", "diagnosis", "virtual", "torch"):
                    assert side not in name.split("."), f"{path.name} imports {name}"


def test_the_size_of_a_robot_is_known_before_it_is_made():
    """Also by the text of its rig, whose seed is the default where the text gives none."""
    for seed in range(30):
        plant, _ = make_robot(seed, 12, None, 1.0)
        assert package.robot_size(seed) == (len(plant.areas), len(plant.nodes))
    assert known_size("elastica:seed=101") == known_size("elastica", {"seed": 101}) == (3, 3)
    assert known_size("elastica") == package.robot_size(0)
    assert known_size("virtual") is None


def test_a_robot_of_another_size_is_refused_before_it_is_made(monkeypatch):
    def made(*_, **__):
        raise AssertionError("the robot was made")

    monkeypatch.setattr(package, "ElasticaRig", made)
    with pytest.raises(InputError, match=r"3 chambers and 5 key points; the rig's has 3 and 3"):
        on_rig(track_circle(), RigConfig(rigs=("elastica:seed=101",)))
