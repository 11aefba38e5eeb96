"""Promises over every hidden effect, and what each of them is about."""

import numpy as np
import pytest

from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.rig.effects import (
    add_effect_forces,
    follow_lines,
    new_history,
    no_effects,
)
from surgisoft.rig.hidden import HIDDEN, Setup, switch_on


def truth_of(protocol, seed=1, **options):
    return VirtualRig(seed, noise=0.0, **options).record(protocol)[1]


@pytest.fixture(scope="module")
def mixed():
    """A short mixed schedule that reaches the support, and the plain arm's answer to it."""
    protocol = make_protocol("mixed", VirtualRig(1).limits, 2000, seed=6)
    return protocol, truth_of(protocol)


@pytest.fixture(scope="module")
def short():
    """A mixed schedule of 15 s, and the plain arm's answer to it."""
    protocol = make_protocol("mixed", VirtualRig(1).limits, 300, seed=1)
    return protocol, truth_of(protocol)


@pytest.mark.parametrize("name", HIDDEN)
def test_amplitude_zero_changes_nothing(name, short):
    protocol, none = short
    off = truth_of(protocol, hidden=[(name, 0.0)])
    np.testing.assert_array_equal(off.noise_free_mm, none.noise_free_mm)
    np.testing.assert_array_equal(off.pressures_kPa, none.pressures_kPa)


@pytest.mark.parametrize("name", HIDDEN)
def test_amplitude_one_is_visible_but_smaller_than_another_robot(name, mixed):
    """The tip moves by 0.25 to 2 mm (root mean square), half the strength by less."""
    protocol, none = mixed
    shifts = []
    for strength in (0.5, 1.0):
        changed = truth_of(protocol, hidden=[(name, strength)]).noise_free_mm[:, -1]
        shifts.append(np.sqrt(((changed - none.noise_free_mm[:, -1]) ** 2).sum(axis=1).mean()))
    assert 0.25 < shifts[1] < 2.0
    assert shifts[0] < shifts[1]


@pytest.mark.parametrize("name", HIDDEN)
def test_effects_differ_from_seed_to_seed_only_by_the_arm(name):
    """The same seed hides the same thing; hiding it does not change which arm was cast."""
    protocol = Protocol("p", "settled", [[0.0, 0, 0], [30, 10, 0]], [0, 0])
    one, again = (truth_of(protocol, seed=7, hidden=[(name, 1.0)]) for _ in range(2))
    np.testing.assert_array_equal(one.noise_free_mm, again.noise_free_mm)


def tips(path, name, strength=1.0, settle_s=3.0, **options):
    """Noise-free tips (T, 3) [mm] at settled points, plain and with the effect, and the truths."""
    protocol = Protocol("p", "settled", path, np.zeros(len(path)), settle_s=settle_s)
    plain = truth_of(protocol, **options)
    hidden = truth_of(protocol, hidden=[(name, strength)], **options)
    return plain.noise_free_mm[:, -1], hidden.noise_free_mm[:, -1]


def test_hysteresis_widens_the_loop():
    path = [[0, 0, 0], [54, 0, 0], [24, 0, 0], [0, 0, 0], [24, 0, 0]]
    gaps = [np.linalg.norm(t[2] - t[4]) for t in tips(path, "hysteresis")]
    assert gaps[1] == pytest.approx(2 * gaps[0], rel=0.15)


def test_creep_goes_on_for_minutes_and_slows_down():
    """As t^0.2 from 2 to 64 s each doubling of the time adds more than the doubling before."""
    hold = np.tile([40.0, 0, 0], (30, 1))
    plain, crept = tips(hold, "creep", settle_s=3.0)
    t = 4.0 * (np.arange(30) + 1) - 0.5
    added = np.linalg.norm((crept - plain), axis=1)
    at = np.interp([4, 8, 16, 32, 64], t, added)
    assert (np.diff(at) > 0.05 * at[0]).all()
    rate = np.diff(added) / np.diff(t)
    assert rate[0] > 5 * rate[-1] > 0


def test_softening_depends_on_the_largest_load_so_far():
    """The virgin curve is shared, below the largest load the arm is softer (Mullins 1948)."""
    path = [[30, 0, 0], [54, 0, 0], [30, 0, 0], [15, 0, 0], [30, 0, 0], [54, 0, 0]]
    plain, soft = tips(path, "softening")
    change = np.linalg.norm(soft - plain, axis=1)
    assert change[0] < 0.2
    assert change[2] > 0.5
    assert change[4] == pytest.approx(change[2], rel=0.15)
    assert change[5] < 0.3


def test_rate_dependence_is_a_wall_beside_a_shear_thinning_fluid():
    """E d = c sqrt(y' / 0.1): its lack on a ramp, and how that goes when the ramp ends."""
    wanted, step, modulus, c = 0.05, 1e-4, 3.0, 0.09
    effects = no_effects(1, modulus)._replace(rate=c)
    history, strain, forces = new_history(1, 1), 0.0, np.zeros(1)
    for _ in range(20000):
        strain += wanted * step
        follow_lines(effects, step, np.array([strain]), history)
    add_effect_forces(effects, np.array([strain]), history, forces)
    lack = forces[0] / modulus
    assert lack == pytest.approx(c / modulus * np.sqrt(wanted / 0.1), rel=0.01)
    for _ in range(5000):
        follow_lines(effects, step, np.array([strain]), history)
    quick = 0.1 * (modulus / c) ** 2
    left = strain - history.followed[0]
    assert left == pytest.approx(1 / (1 / lack + quick * 0.5), rel=1e-6)


def test_rate_dependence_and_lag_vanish_at_rest():
    path = [[40, 0, 0], [40, 0, 0]]
    for name in ("rate_dependence", "line_lag"):
        plain, changed = tips(path, name, settle_s=20.0)
        assert np.linalg.norm(changed[1] - plain[1]) < 0.12


def test_contact_is_one_sided():
    """Bending around the compass, some tips are held by millimetres, the others hardly touched."""
    angles = np.radians(np.arange(0, 360, 30))
    push = np.clip(np.cos(angles[:, None] - np.radians([90, 210, 330])), 0, None)
    plain, held = tips(40 * push, "contact")
    shift = np.linalg.norm(held - plain, axis=1)
    assert (shift < 0.05).sum() >= 4
    assert shift.max() > 1.0


def test_payload_acts_with_gravity():
    """Turning the base by 180 degrees turns the sideways shift of a hidden mass around."""
    shifts = []
    for roll in (0.0, 180.0):
        plain, loaded = tips([[0, 0, 0.0]], "payload", gravity=[1, 0, 0], roll_deg=roll)
        shifts.append((loaded - plain)[0])
    assert shifts[0][0] > 0.8
    assert shifts[1][0] < -0.8


def test_misalignment_moves_what_is_seen_and_nothing_else():
    protocol = Protocol("p", "settled", [[0.0, 0, 0], [40, 0, 0]], [0, 0])
    plain, off = truth_of(protocol), truth_of(protocol, hidden=[("misalignment", 1.0)])
    np.testing.assert_array_equal(plain.centres_mm, off.centres_mm)
    assert np.linalg.norm(off.noise_free_mm - plain.noise_free_mm, axis=-1).min() > 0.1


def test_drift_and_warmth_need_time():
    rest = np.zeros((40, 3))
    for name in ("drift", "thermal_drift"):
        path = rest + np.array([30.0, 0, 0])
        plain, moved = tips(path, name, settle_s=30.0)
        shift = np.linalg.norm(moved - plain, axis=1)
        assert shift[0] < 0.35 * shift[19]
    rig = VirtualRig(1, hidden=[("thermal_drift", 1.0)])
    recording, _ = rig.record(make_protocol("holds", rig.limits, 4000))
    assert recording.temp_C[-1] - recording.temp_C[0] > 1.0


def test_twist_turns_the_markers_but_not_the_straight_centreline():
    """Common pressure twists: the tip plane's markers turn, its centre stays within the bends."""
    rig, twisted = (VirtualRig(1, noise=0.0, hidden=h) for h in ([], [("twist", 1.0)]))
    turns = []
    for r in (rig, twisted):
        r.reset()
        r.command([40.0, 40, 40])
        r.wait(4.0)
        r.read()
        frame = r.plane_frames[-1]
        turns.append(np.degrees(np.arctan2(frame[1, 0], frame[0, 0])))
    assert 3 < abs(turns[1] - turns[0]) < 40


def test_sensor_channels_mix():
    """The controller trusts its sensor, so the true pressures are off."""
    protocol = Protocol("p", "settled", [[50.0, 0, 0]], [0])
    recording, truth = VirtualRig(1, hidden=[("sensor_crosstalk", 1.0)]).record(protocol)
    np.testing.assert_allclose(recording.measured[0], [50, 0, 0], atol=0.3)
    assert truth.pressures_kPa[0, 1] < -1.0


def test_a_shifted_zero_pushes_like_other_pressures():
    """At half of 54 kPa an arm whose zeros have shifted is where 0.85 of the shift takes it."""
    setup = Setup(no_effects(3, 1.0), None, None)
    zero = switch_on(setup, [("zero_offset", 1.0)], 1).effects.zero
    assert np.sqrt(np.mean(zero**2)) == pytest.approx(1.2)
    plain, shifted = tips([np.full(3, 27.0)], "zero_offset", 1.0)
    there, _ = tips([27.0 + 0.85 * zero], "zero_offset", 0.0)
    assert np.linalg.norm(there - plain) > 1.0
    np.testing.assert_allclose(shifted, there, atol=0.1)


def test_two_effects_at_once():
    """Effects from both ends of the chain act together, to first order as their sum."""
    path = [[40, 0, 0], [0, 30, 0], [20, 20, 0]]
    plain, one = tips(path, "drift", 0.3)
    _, other = tips(path, "gain_mismatch", 0.3)
    protocol = Protocol("p", "settled", path, np.zeros(3))
    both = truth_of(protocol, hidden=[("drift", 0.3), ("gain_mismatch", 0.3)]).noise_free_mm[:, -1]
    np.testing.assert_allclose(both - plain, (one - plain) + (other - plain), atol=0.05)
    assert np.linalg.norm(both - plain, axis=1).max() > 0.1


def test_a_breathing_mount_shifts_the_whole_arm_as_one_and_comes_back():
    """No command explains it; a breath lasts 3.5 to 4.5 s and mostly rests (Lujan et al. 1999)."""
    still = Protocol("p", "continuous", [[20.0, 0, 0]] * 2, [0, 0], [0.0, 40.0])
    plain, moved = truth_of(still), truth_of(still, hidden=[("breathing", 1.0)])
    shift = moved.noise_free_mm - plain.noise_free_mm
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=1e-9)
    np.testing.assert_allclose(moved.centres_mm - plain.centres_mm, shift, atol=1e-9)
    np.testing.assert_array_equal(moved.pressures_kPa, plain.pressures_kPa)
    size = np.linalg.norm(shift[:, 0], axis=1)
    assert size.max() == pytest.approx(2.0, abs=0.02)
    assert np.mean(size) == pytest.approx(2.0 * 5 / 16, rel=0.1)  # the mean of cos^6
    spectrum = np.abs(np.fft.rfft(size - size.mean()))
    assert 1 / 4.6 < np.fft.rfftfreq(len(size), 0.05)[spectrum.argmax()] < 1 / 3.4


def test_a_jammed_valve_keeps_the_air_of_its_chamber_and_lets_it_go_again():
    times = np.arange(0.0, 121.0, 3.0)
    commands = np.zeros((len(times), 3)) + np.where(np.arange(len(times)) % 2, 45.0, 5.0)[:, None]
    sweeps = Protocol("p", "continuous", commands, np.zeros(len(times)), times)
    plain, jammed = truth_of(sweeps), truth_of(sweeps, hidden=[("valve_jam", 1.0)])
    off = np.abs(jammed.pressures_kPa - plain.pressures_kPa)
    assert (off.max(axis=0) > 5.0).sum() == 1
    bad = off[:, off.max(axis=0).argmax()]
    assert 0.05 < np.mean(bad > 1.0) < 0.5
    assert np.mean(bad < 0.3) > 0.3  # open again, the chamber is at its pressure


def test_a_knock_turns_the_base_once_and_for_all():
    path = np.tile([10.0, 20, 30], (25, 1))
    plain, knocked = tips(path, "knock", settle_s=5.0)
    shift = np.linalg.norm(knocked - plain, axis=1)
    late = int(np.argmax(shift > 0.1))
    assert (shift[:late] == 0).all()
    assert 30.0 < 6.0 * late + 30.0 < 115.0
    np.testing.assert_allclose(shift[late:], shift[-1], rtol=0.05)
    assert shift[-1] == pytest.approx(np.radians(1.2) * 60, rel=0.4)


def test_an_event_that_occurs_once_falls_into_the_window_of_the_configuration():
    """Times since switching on; the recording begins after a reset of 30 s."""
    still = Protocol("p", "continuous", [[20.0, 20, 40]] * 2, [0, 0], [0.0, 25.0])
    plain = truth_of(still).noise_free_mm
    for window in ((32.0, 36.0), (44.0, 48.0)):
        moved = truth_of(still, hidden=[("knock", 1.0)], event_window_s=window).noise_free_mm
        shift = np.linalg.norm(moved[:, -1] - plain[:, -1], axis=1)
        moment = 30.0 + 0.05 * np.argmax(shift > 0.1)
        assert window[0] - 0.1 <= moment <= window[1] + 0.1


def test_a_fibre_breaks_once_and_no_rest_mends_it():
    path = np.tile([[50.0, 50, 50], [10.0, 10, 10]], (30, 1))
    plain, broken = tips(path, "fibre_break", settle_s=5.0)
    shift = np.linalg.norm(broken - plain, axis=1)[::2]
    late = int(np.argmax(shift > 0.1))
    assert (shift[:late] == 0).all()
    assert 40.0 < 30.0 + 12.0 * late < 115.0
    np.testing.assert_allclose(shift[late + 1 :], shift[-1], rtol=0.1)
    assert shift[-1] > 1.0


@pytest.mark.parametrize("hidden", [(), (("creep", 1.0),), (("thermal_drift", 1.0),)])
def test_the_temperature_is_written_whatever_is_hidden(hidden):
    """A column that only one hidden effect writes would give it away."""
    rig = VirtualRig(0, hidden=hidden)
    made, _ = rig.record(make_protocol("mixed", rig.limits, 600, seed=1))
    plain = VirtualRig(0)
    same, _ = plain.record(make_protocol("mixed", plain.limits, 600, seed=1))
    np.testing.assert_array_equal(made.temp_C, same.temp_C)
    assert np.ptp(made.temp_C) > 0.0


@pytest.mark.parametrize("name", ["creep", "softening"])
def test_venting_and_resting_undo_what_the_last_run_left(name):
    """After a reset the arm is where a robot is that never moved."""
    used, fresh = (VirtualRig(0, hidden=[(name, 1.0)], noise=0.0) for _ in range(2))
    used.reset()
    used.command(np.array([50.0, 0.0, 0.0]))
    used.wait(60.0)
    tips = []
    for rig in (used, fresh):
        rig.reset()
        rig.command(np.array([20.0, 0.0, 0.0]))
        rig.wait(5.0)
        tips.append(rig.read_beside_truth()[1].noise_free_mm[0, -1])
    np.testing.assert_allclose(*tips, atol=1e-6)
