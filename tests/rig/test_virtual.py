"""The virtual rig as a whole: the same data however it is driven, independent of the models."""

import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.measurement.recordings import ArmInfo, load_recordings, save_recording
from surgisoft.rig import Sample, VirtualRig, VirtualRigConfig, collect
from surgisoft.rig.hidden import HIDDEN
from surgisoft.rig.motion_capture import CameraDesign

EVERYTHING = [(name, 0.5) for name in HIDDEN]
COLUMNS = ("t_s", "measured", "commanded", "key_points_mm", "run", "temp_C", "payload_g")


def assert_same(one, other):
    for name in COLUMNS:
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        if a is not None:
            np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.mark.parametrize("hidden", [[], EVERYTHING], ids=["plain", "everything hidden"])
@pytest.mark.parametrize(("name", "points"), [("grid", 80), ("mixed", 900)])
def test_fast_path_equals_commanding_and_reading(name, points, hidden):
    """Sample by sample and bit by bit."""
    rigs = [VirtualRig(5, hidden=hidden, payload_g=1.0) for _ in range(2)]
    protocol = make_protocol(name, rigs[0].limits, points, seed=2)
    fast, _ = rigs[0].record(protocol)
    slow = collect(rigs[1], protocol)
    assert fast.samples == points
    assert_same(fast, slow)


LATER = [("payload", 1.0, 8.0), ("creep", 0.5), ("hysteresis", 0.5, 9.0), ("valve_jam", 1.0, 3.02)]


@pytest.mark.parametrize(("name", "points"), [("validation", 12), ("mixed", 400)])
def test_an_effect_that_begins_later_is_there_from_then_on(name, points):
    """Before it the data are those without it, however the rig is driven."""
    rigs = [VirtualRig(5, hidden=LATER) for _ in range(2)]
    protocol = make_protocol(name, rigs[0].limits, points, seed=2)
    fast, _ = rigs[0].record(protocol)
    assert_same(fast, collect(rigs[1], protocol))
    without, _ = VirtualRig(5, hidden=[("creep", 0.5)]).record(protocol)
    change = np.linalg.norm(fast.key_points_mm - without.key_points_mm, axis=-1)[:, -1]
    begins_s = 3.0 if name == "validation" else 3.1
    assert not np.nan_to_num(change[fast.t_s + 4.0 < begins_s]).any()
    assert np.nanmean(change[fast.t_s > 40.0]) > 0.3


def test_effects_that_begin_later_are_checked():
    with pytest.raises(InputError, match=r"hidden effect 'payload' begins at -1\.0 s"):
        VirtualRig(0, hidden=[("payload", 1.0, -1.0)])
    with pytest.raises(InputError, match="given twice"):
        VirtualRig(0, hidden=[("payload", 1.0), ("payload", 1.0, 5.0)])
    with pytest.raises(InputError, match="15 frames per second, expected a period that is a"):
        VirtualRig(0, cameras=CameraDesign(rate_Hz=15.0))


def test_same_seed_same_data_other_trial_other_noise():
    protocol = make_protocol("validation", VirtualRig(1).limits, 40)
    one, again, take, other = (
        VirtualRig(seed, take=take).record(protocol)
        for seed, take in [(1, 0), (1, 0), (1, 1), (2, 0)]
    )
    assert_same(one[0], again[0])
    assert (one[0].key_points_mm != take[0].key_points_mm).all()
    # The sensors' noise runs through the controller, so pressures differ by hundredths of kPa.
    np.testing.assert_allclose(one[1].centres_mm, take[1].centres_mm, atol=0.3)
    assert np.abs(one[1].centres_mm - other[1].centres_mm).max() > 1.0


def test_recording_is_complete(tmp_path):
    rig = VirtualRig(3, payload_g=2.5, gravity=[0.0, 1.0, 1.0], hidden=[("thermal_drift", 1.0)])
    protocol = make_protocol("mixed", rig.limits, 1000)
    recording, truth = rig.record(protocol)
    assert recording.kind == "continuous"
    assert recording.unit == "kPa"
    assert recording.arm == ArmInfo(70.0, 15.0)
    np.testing.assert_allclose(recording.gravity, np.sqrt([0, 0.5, 0.5]))
    assert (recording.payload_g == 2.5).all()
    assert len(recording.runs) == 5
    assert recording.t_s[0] == 0
    for rows in recording.runs:
        np.testing.assert_allclose(np.diff(recording.t_s[rows]), 0.05, atol=1e-9)
    assert 22.0 <= recording.temp_C.min() < recording.temp_C.max() < 28.0
    error = recording.key_points_mm - truth.noise_free_mm
    assert recording.noise_mm == pytest.approx(np.sqrt(np.nanmean(error**2)))
    assert 0.03 < recording.noise_mm < 0.06
    save_recording(recording, tmp_path / "r.parquet")
    assert_same(load_recordings([tmp_path / "r.parquet"])[0], recording)


def test_truth_stays_out_of_the_measurement():
    """Camera noise is about the true centres plus constant errors of hand-glued markers."""
    rig = VirtualRig(4)
    recording, truth = rig.record(make_protocol("walk", rig.limits, 60))
    error = recording.key_points_mm - truth.centres_mm
    assert np.nanstd(recording.key_points_mm - truth.noise_free_mm, axis=0).max() < 0.05
    assert np.abs(np.nanmean(error, axis=0)).max() < 0.5
    np.testing.assert_allclose(truth.centres_mm[:, 0], 0.0, atol=1e-12)  # the bracket
    assert np.abs(truth.pressures_kPa - recording.measured).max() < 0.03


def test_steady_state_samples_are_at_rest():
    """After 3 s the averaged reading is the command, within the pumps' reach."""
    rig = VirtualRig(2)
    recording, _ = rig.record(make_protocol("grid", rig.limits, 343))
    error = np.abs(recording.measured - recording.commanded)
    assert np.median(error) < 0.05
    assert error.max() < 0.6


def test_every_run_starts_rested():
    """Two equal runs, the second after others, give equal shapes (drift and noise off)."""
    commands = np.array([[10.0, 0, 0], [50, 0, 0], [10, 0, 0], [54, 54, 0], [10, 0, 0], [10, 0, 0],
                         [50, 0, 0], [10, 0, 0]])  # fmt: skip
    run = np.array([0, 0, 0, 1, 1, 2, 2, 2])
    _, truth = VirtualRig(1, noise=0.0).record(Protocol("p", "settled", commands, run))
    np.testing.assert_allclose(truth.centres_mm[5:], truth.centres_mm[:3], atol=1e-6)
    assert np.linalg.norm(truth.centres_mm[4, -1] - truth.centres_mm[0, -1]) > 0.1
    assert np.linalg.norm(truth.centres_mm[2, -1] - truth.centres_mm[0, -1]) > 0.5


def test_roll_turns_gravity_in_the_base_frame():
    """A base turned by 90 degrees about z sees weight along -y where it saw it along x."""
    rig = VirtualRig(1, gravity=[1.0, 0.0, 1.0], roll_deg=90.0)
    np.testing.assert_allclose(rig.gravity, np.sqrt([0, 0.5, 0.5]) * [0, -1, 1], atol=1e-12)
    full = VirtualRig(1, gravity=[1.0, 0.0, 1.0], roll_deg=360.0)
    np.testing.assert_allclose(full.gravity, np.sqrt([0.5, 0, 0.5]), atol=1e-12)


def test_payload_pulls_along_gravity():
    shapes = []
    for grams in (0.0, 2.0):
        rig = VirtualRig(1, gravity=[1.0, 0.0, 0.0], payload_g=grams, noise=0.0)
        rig.reset()
        shapes.append(rig.read().key_points_mm)
    sag = shapes[1] - shapes[0]
    assert 4 < sag[-1, 0] < 10
    assert (np.diff(sag[:, 0]) > 0).all()


def test_closed_loop_is_fast_enough():
    """At least 500 commands and reads a second."""
    rig = VirtualRig(1)
    rig.reset()
    rig.read()
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        for k in range(200):
            rig.command(np.full(3, 10.0 + 0.02 * k))
            rig.read()
        best = min(best, time.perf_counter() - start)
    assert 200 / best > 500


class Bellows:
    """A rig that inherits from nothing: two motors in degrees, three key points, no gravity."""

    chambers, key_planes, unit, period_s = 2, 3, "deg", 0.1
    limits = np.array([[0.0, 90.0], [0.0, 90.0]])
    arm, gravity, payload_g = ArmInfo(100.0, None), None, None

    def __init__(self):
        self.clock, self.at, self.calls = 7.0, np.zeros(2), []

    def reset(self):
        self.at = np.zeros(2)
        self.calls.append("reset")

    def command(self, pressures):
        self.at = np.array(pressures)

    def wait(self, seconds):
        self.clock += seconds
        self.calls.append(seconds)

    def read(self):
        self.clock += self.period_s
        points = np.array([[0, 0, 0], [*self.at, 50], [*(2 * self.at), 100]], float)
        points[1] = np.nan if round(10 * self.clock) % 2 else points[1]
        return Sample(self.clock, self.at + 0.5, self.at, points)


def test_configuration_and_fields_make_the_same_rig():
    config = VirtualRigConfig(seed=2, payload_g=1.0, hidden=[("creep", 1.0)])
    protocol = make_protocol("walk", VirtualRig(2).limits, 20)
    one, _ = VirtualRig(config).record(protocol)
    other, _ = VirtualRig(2, payload_g=1.0, hidden=[("creep", 1.0)]).record(protocol)
    assert_same(one, other)
    assert VirtualRig(config, payload_g=0.0).payload_g is None
    assert config.payload_g == 1.0


def test_any_rig_can_be_driven():
    bench = Bellows()
    commands = np.array([[10.0, 20], [30, 40], [50, 60]])
    plan = Protocol(
        "steps", "settled", commands, [0, 0, 1], settle_s=2.0, average_s=0.5, unit="deg"
    )
    recording = collect(bench, plan)
    assert bench.calls == ["reset", 2.0, 2.0, "reset", 2.0]
    np.testing.assert_allclose(recording.measured, commands + 0.5)
    np.testing.assert_allclose(recording.key_points_mm[:, 1, :2], commands)
    np.testing.assert_allclose(recording.t_s, [0, 2.5, 5.0])
    assert recording.unit == "deg"
    assert recording.noise_mm is None


class Ramping(Bellows):
    """Its controllers move the set point on from frame to frame: 0.1, 0.2, ... degrees."""

    frames = 0

    def read(self):
        self.frames += 1
        return replace(super().read(), commanded=np.full(2, 0.1 * self.frames))


def test_the_command_of_a_steady_state_is_that_of_its_last_frame():
    plan = Protocol("steps", "settled", [[10.0, 20], [30, 40]], [0, 0], average_s=0.5, unit="deg")
    bench = Ramping()
    recording = collect(bench, plan)
    half = bench.frames // 2
    assert half > 1
    np.testing.assert_allclose(recording.commanded[:, 0], [0.1 * half, 0.2 * half])


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: VirtualRig(-1), "seed is -1"),
        (lambda: VirtualRig(1, gravity=[0, 0, 0]), "gravity is"),
        (lambda: VirtualRig(1, payload_g=500), "payload is 500 g, expected 0 to 20 g"),
        (lambda: VirtualRig(1, noise=-1), "noise scale is -1"),
        (lambda: VirtualRig(1, event_window_s=(9.0, 3.0)), "event_window_s is (9.0, 3.0)"),
        (
            lambda: VirtualRig(1, hidden=[("crep", 1)]),
            "unknown hidden effect 'crep': known are breathing, co",
        ),
        (lambda: VirtualRig(1, hidden=[("creep", -1)]), "strength of 'creep' is -1"),
        (lambda: VirtualRig(1, hidden=[("creep", 1), ("creep", 2)]), "'creep' is given twice"),
        (lambda: VirtualRig(1).command([1.0, 2.0]), "expected 3 finite pressures"),
        (lambda: VirtualRig(1).command([1.0, 2.0, 80.0]), "leaves the rig's limits -15 to 54 kPa"),
        (
            lambda: collect(VirtualRig(1), Protocol("x", "settled", [[1.0, 2.0]], [0])),
            "protocol 'x' commands 2 chambers, the rig has 3",
        ),
        (
            lambda: collect(VirtualRig(1), Protocol("x", "settled", [[1.0, 2, 99]], [0])),
            "row 1 commands",
        ),
        (
            lambda: collect(VirtualRig(1), Protocol("x", "settled", [[1, 2, 3]], [0], unit="psi")),
            "is in psi, the rig works in kPa",
        ),
    ],
)
def test_bad_input_gets_one_line(build, says):
    with pytest.raises(InputError) as caught:
        build()
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_importing_the_rig_loads_no_model_and_no_torch():
    script = (
        "import sys, surgisoft.rig; "
        "print([m for m in sys.modules if m == 'torch' or m.startswith('surgisoft.surrogate')])"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert loaded.stdout.strip() == "[]"
