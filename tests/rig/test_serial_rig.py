"""The serial rig against an emulator: real protocols over a pseudo-terminal and the loopback."""

import os
import select
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from surgisoft.agents.on_rig import RigConfig
from surgisoft.agents.session import evaluate
from surgisoft.cli import run
from surgisoft.errors import InputError, Terminated
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import load_recording
from surgisoft.rig import RigStopped, VirtualRig, guarded, open_rig
from surgisoft.rig.drivers.line_protocol import Info, line, words_of
from surgisoft.rig.drivers.serial_controller import SerialController
from surgisoft.rig.emulator import emulated
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.track import TrackConfig

FAST = ",rest_s=4,watchdog_ms=60000,vent_ms=60000,hold_ms=20000"
"""Options for an emulator ten times as fast as time, on a computer that may be busy."""


@pytest.fixture
def bench():
    """A bench ten times as fast as time."""
    with emulated("virtual:seed=0", speed=10.0) as found:
        yield found


def drive(rig, pressures, count):
    """Command and read."""
    samples = []
    for _ in range(count):
        rig.command(pressures)
        samples.append(rig.read())
    return samples


@pytest.mark.parametrize(
    "version", [None, (3, 1), (4, 1)], ids=["json", "natnet 3.1", "natnet 4.1"]
)
def test_samples_are_those_of_the_rig_behind_the_devices(version):
    with emulated("virtual:seed=0", speed=10.0, natnet_version=version) as bench:
        with guarded(open_rig(bench.options + FAST)) as rig:
            assert (rig.chambers, rig.key_planes, rig.unit) == (3, 5, "kPa")
            rig.reset()
            samples = drive(rig, [20.0, 0.0, 5.0], 60)
        assert (bench.state, bench.target.tolist()) == ("I", [0.0, 0.0, 0.0]), "left vented"
    last = samples[-1]
    np.testing.assert_allclose(last.measured, [20.0, 0.0, 5.0], atol=0.3)
    np.testing.assert_allclose(last.commanded, [20.0, 0.0, 5.0], atol=1e-3)
    plain = VirtualRig(0)
    plain.command([20.0, 0.0, 5.0])
    plain.wait(3.0)
    off = np.linalg.norm(last.key_points_mm - plain.read().key_points_mm, axis=1)
    assert off.max() < 0.5
    times = np.array([s.t_s for s in samples])
    assert (np.diff(times) > 0.049).all(), "the clock of the cameras"
    assert np.median(np.diff(times)) == pytest.approx(0.05, abs=1e-6)


def test_a_change_counts_from_the_first_pressures_and_not_from_the_start_of_the_emulator():
    """A mass is hung on after 3 s; the first pressures are set after 20 s of the bench's time."""
    with emulated("virtual:seed=0,noise=0,hidden=payload:2@3", speed=10.0) as bench:
        while bench.number < 200:
            time.sleep(0.01)
        assert bench.rig.time_s < 31.0, "the reset and nothing more"
        with guarded(open_rig(f"{bench.options},rest_s=0.2")) as rig:
            rig.wait(10.0)
            samples = drive(rig, [0.0, 0.0, 0.0], 120)
    at = np.array([s.t_s for s in samples]) - samples[0].t_s
    tips = np.array([s.key_points_mm[-1] for s in samples])
    off = np.linalg.norm(tips - tips[at < 1.0].mean(0), axis=1)
    assert off[at < 1.0].max() < 0.01, "as it was"
    assert off[at > 4.5].min() > 0.3, "the mass hangs on it"


def test_multicast_on_the_loopback_interface():
    options = {"speed": 10.0, "natnet_version": (4, 1), "multicast": "239.255.42.98"}
    with (
        emulated("virtual:seed=0", **options) as bench,
        guarded(open_rig(bench.options + FAST)) as rig,
    ):
        assert np.isfinite(rig.read().key_points_mm).all()


def test_collect_check_and_evaluate_run_on_it(bench, tmp_path, capsys):
    out = tmp_path / "r.parquet"
    rig = bench.options + FAST
    protocol = make_protocol("mixed", VirtualRig(0).limits, 120, seed=0)
    assert run(["collect", "mixed", "--points", "120", "--rig", rig, "-o", str(out)]) == 0
    recording = load_recording(out)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r.parquet", "r.toml"], "the log is gone"
    plain, _ = VirtualRig(0).record(protocol)
    assert recording.samples == plain.samples
    off = np.linalg.norm(recording.key_points_mm - plain.key_points_mm, axis=2)
    assert np.nanmedian(off) < 0.5
    assert run(["rig", "check", rig]) == 0
    assert "the arm moves as predicted" in capsys.readouterr().out
    found = evaluate(
        "scripted",
        "track_circle",
        episodes=1,
        rig=RigConfig(rigs=(rig,), settle_s=0.5),
        config=TrackConfig(FollowConfig(loop_s=4.0, approach_s=1.0, size_mm=5.0)),
    )
    assert found.measured_arms == ("arm",)
    # A busy computer skips samples at ten times the speed of time: no close bound holds here.
    assert found.results[0].overall["error_mean_mm"].mean < 5.0
    assert bench.state == "I"


def test_a_cut_cable_ends_in_one_line_and_the_controller_vents_itself(bench):
    def cut():
        with guarded(open_rig(f"{bench.options},rest_s=1,watchdog_ms=2000")) as rig:
            drive(rig, [20.0, 20.0, 20.0], 10)
            bench.cut_cable()
            drive(rig, [20.0, 20.0, 20.0], 400)

    with pytest.raises(RigStopped, match=r"cut off \(.*not be vented from here.*watchdog has"):
        cut()
    until = time.monotonic() + 10.0
    while bench.state != "T" and time.monotonic() < until:
        time.sleep(0.01)
    assert (bench.state, bench.target.tolist()) == ("T", [0.0, 0.0, 0.0])


PROGRAM = """
import sys
sys.path.insert(0, {root!r})
from surgisoft.rig import open_rig, guarded
with guarded(open_rig({rig!r})) as rig:
    while True:
        rig.command([20.0, 20.0, 20.0])
        rig.read()
"""


def test_a_killed_program_leaves_the_arm_vented():
    """`kill -9`: no program can do anything then, and the controller's watchdog does it."""
    with emulated("virtual:seed=0") as bench:
        rig = bench.options + ",rest_s=1,watchdog_ms=1000"
        program = PROGRAM.format(root=os.getcwd(), rig=rig)
        child = subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL)
        until = time.monotonic() + 60.0
        while bench.target.max() < 19.0 and time.monotonic() < until:
            time.sleep(0.02)
        assert bench.target.max() > 19.0
        child.kill()
        child.wait(20.0)
        while bench.target.any() and time.monotonic() < until:
            time.sleep(0.02)
        assert (bench.state, bench.target.tolist()) == ("T", [0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_ctrl_c_and_kill_leave_the_arm_vented(bench, number, error):
    def interrupted():
        with guarded(open_rig(bench.options + FAST)) as rig:
            drive(rig, [20.0, 20.0, 20.0], 30)
            assert bench.target.max() == 20.0
            threading.Timer(0.05, os.kill, (os.getpid(), number)).start()
            drive(rig, [20.0, 20.0, 20.0], 3000)

    with pytest.raises(error):
        interrupted()
    assert (bench.state, bench.target.tolist()) == ("I", [0.0, 0.0, 0.0])


def test_a_silent_controller_and_silent_cameras_end_the_run_vented(bench):
    for fault, message in (("silent", "no report for"), ("blind", "no frame for")):
        with guarded(open_rig(bench.options + FAST)) as rig:
            drive(rig, [10.0, 10.0, 10.0], 5)
            setattr(bench, fault, True)
            with pytest.raises(InputError, match=message):
                drive(rig, [10.0, 10.0, 10.0], 3000)
            setattr(bench, fault, False)
        assert bench.state == "I"


def test_cameras_without_key_points_hold_and_then_vent(bench):
    def blinded():
        with guarded(open_rig(f"{bench.options},rest_s=1,watchdog_ms=20000,vent_ms=1500")) as rig:
            drive(rig, [10.0, 10.0, 10.0], 20)
            bench.occluded = set(range(5))
            for k in range(200):
                drive(rig, [10.0 + 0.1 * k, 10.0, 10.0], 1)

    message = r"no key point was seen for [12]\.\d s; the rig is vented"
    with pytest.raises(RigStopped, match=message):
        blinded()
    highest = max(target[0] for _, _, target in bench.log)
    assert highest < 13.0, "held half a second after the last key point"


def test_what_is_lost_on_the_way_is_counted_and_does_not_stop_the_run(bench):
    bench.damage_every = 7
    with guarded(open_rig(bench.options + FAST)) as rig:
        drive(rig, [5.0, 5.0, 5.0], 10)
        bench.skipped = set(range(bench.number + 10, bench.number + 80, 10))
        bench.exchanged = (1, 3)
        samples = drive(rig, [5.0, 5.0, 5.0], 60)
        counts = rig.rig.counts
    points = np.array([s.key_points_mm for s in samples])
    seen = np.isfinite(points).all(axis=(1, 2))
    assert counts["damaged lines"] > 2
    assert counts["swapped labels"] == 1
    assert counts["dropped frames"] >= 3
    if not counts["late samples skipped"]:  # a busy computer skips them in one go
        assert 2 <= (~seen).sum() <= 12, "a lost frame is a sample without key points"
    assert np.ptp(points[seen][:, 1], axis=0).max() < 2.0, "labels were put right"


def test_a_lost_answer_about_the_watchdog_is_asked_for_again():
    tty = pytest.importorskip("tty", reason="Windows has no pseudo-terminals")
    main, end = os.openpty()
    tty.setraw(end)
    over, asked = threading.Event(), []

    def controller():
        pending = b""
        while not over.is_set():
            if not select.select([main], [], [], 0.05)[0]:
                continue
            *lines, pending = (pending + os.read(main, 4096)).split(b"\n")
            for kind, *rest in map(words_of, lines, ">" * len(lines)):
                asked.append(kind)
                if asked.count("WATCH") == 1:
                    continue  # the answer is lost
                hold, vent = map(int, rest) if kind == "WATCH" else (100, 400)
                info = Info(3, -20.0, 60.0, hold, vent, "bench")
                os.write(main, line(info.words(), "<"))

    thread = threading.Thread(target=controller)
    thread.start()
    try:
        found = SerialController(os.ttyname(end), hold_ms=700.0, vent_ms=900.0)
        assert (found.info.hold_ms, found.info.vent_ms) == (700, 900)
        assert asked.count("WATCH") >= 2
        with pytest.raises(InputError, match="did not confirm that it vented"):
            found.close()
    finally:
        over.set()
        thread.join()
        os.close(main)
        os.close(end)


def test_set_points_are_not_sent_again_after_another_thread_vented(monkeypatch):
    """The other thread gets in just before the line is free for the set points."""
    first = []

    class Contended:
        """A lock that others may take first."""

        def __init__(self):
            self._lock = real()

        def __enter__(self):
            if first:
                first.pop()()
            return self._lock.__enter__()

        def __exit__(self, *error):
            return self._lock.__exit__(*error)

        def __getattr__(self, name):
            return getattr(self._lock, name)

    real = threading.Lock
    with emulated("virtual:seed=0") as bench:
        monkeypatch.setattr("surgisoft.rig.drivers.serial_controller.threading.Lock", Contended)
        controller = SerialController(bench.port)
        monkeypatch.undo()
        try:
            controller.wait_for_report()
            controller.command([10.0, 0.0, 0.0])
            first.append(controller.vent)
            controller.keep_alive()
            until = time.monotonic() + 5.0
            while bench.state != "I" and time.monotonic() < until:
                time.sleep(0.01)
            time.sleep(0.2)
            assert (bench.state, bench.target.tolist()) == ("I", [0.0, 0.0, 0.0])
        finally:
            controller.close()


def test_a_map_file_names_points_channels_and_the_frame(bench, tmp_path):
    (tmp_path / "bench.toml").write_text(
        'points = ["k0", "k2", "k4"]\nchannels = [3, 1]\ngravity = [0.0, 0.0, 1.0]\n'
        "[frame]\nrotation_deg = [0.0, 0.0, 90.0]\n[arm]\nlength_mm = 70.0\n"
    )
    with guarded(open_rig(f"{bench.options}{FAST},map={tmp_path / 'bench.toml'}")) as rig:
        assert (rig.chambers, rig.key_planes, rig.arm.length_mm) == (2, 3, 70.0)
        sample = drive(rig, [12.0, 4.0], 30)[-1]
        assert bench.target.tolist() == pytest.approx([4.0, 0.0, 12.0])
    np.testing.assert_allclose(sample.commanded, [12.0, 4.0], atol=1e-3)
    plain = VirtualRig(0)
    plain.command([4.0, 0.0, 12.0])
    plain.wait(3.0)
    tip = plain.read().key_points_mm[-1]
    turned = np.array([tip[1], -tip[0], tip[2]])  # the base frame's x axis is the cameras' y axis
    np.testing.assert_allclose(sample.key_points_mm[-1], turned, atol=0.6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("serial:port=/dev/ttyNONE", r"port '/dev/ttyNONE': cannot be opened \(.*ports of this"),
        ("serial", "option 'port' is missing"),
        ("{o},chambers=4", "has 3 chambers, expected 4"),
        ("{o},watchdog_ms=999999", "its watchdog was to hold after .* choose times that it allows"),
        ("{p},mocap=tcp:1", "option 'mocap' is 'tcp:1', expected udp:PORT or natnet:SERVER"),
        ("{p},mocap=udp:99999", "option 'mocap' is 'udp:99999'"),
        ("{o},rate_Hz=0", "rate_Hz 0, .*expected positive numbers"),
        ("{o},map=none.toml", "none.toml: no such file"),
        ("{o},port=x", "option 'port' is given twice"),
    ],
)
def test_a_bench_that_does_not_fit_is_one_line_and_vented(bench, options, message):
    port = bench.options.partition(",")[0]
    with pytest.raises(InputError, match=message):
        open_rig(options.replace("{o}", bench.options).replace("{p}", port))
    assert bench.state == "I"


def test_nobody_at_the_other_end_is_one_line(bench, monkeypatch):
    from surgisoft.rig.drivers import natnet, serial_controller, serial_rig

    monkeypatch.setattr(serial_rig, "FIRST_FRAME_S", 0.1)
    monkeypatch.setattr(serial_controller, "ANSWER_S", 0.02)
    monkeypatch.setattr(natnet, "ANSWER_S", 0.02)
    port = bench.options.partition(",")[0]
    with pytest.raises(InputError, match=r"no frame came in 0\.1 s; is the motion capture"):
        open_rig(f"{port},mocap=udp:47931,speed=10")
    with pytest.raises(InputError, match=r"NatNet server 127\.0\.0\.1:47932: does not answer"):
        open_rig(f"{port},mocap=natnet:127.0.0.1:47932,speed=10")
    main, end = os.openpty()
    with pytest.raises(InputError, match="no pressure controller answers"):
        open_rig(f"serial:port={os.ttyname(end)}")
    os.close(main)
    os.close(end)


def test_the_emulator_is_a_command(tmp_path):
    link = tmp_path / "bench"
    child = subprocess.Popen(
        [sys.executable, "-m", "surgisoft.rig.emulator", "--link", str(link), "--speed", "5"],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert select.select([child.stdout], [], [], 60.0)[0]
    said = child.stdout.readline().strip()
    assert said.startswith(f"--rig serial:port={link},mocap=udp:")
    with guarded(open_rig(said.removeprefix("--rig ") + FAST)) as rig:
        assert np.isfinite(drive(rig, [5.0, 5.0, 5.0], 3)[-1].key_points_mm).all()
    child.send_signal(signal.SIGTERM)
    assert child.wait(10.0) == 0
    assert not link.is_symlink()
