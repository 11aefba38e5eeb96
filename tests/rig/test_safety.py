"""The safety wrapper: limits, watchdog, emergency stop, and venting however a run ends."""

import os
import select
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.errors import InputError, Terminated
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import ArmInfo
from surgisoft.rig import RigStopped, SafeRig, Safety, VirtualRig, collect, guarded
from surgisoft.rig.interface import Sample


class Valves:
    """A bench that writes down what reaches its valves, with time that passes at once."""

    def __init__(self, chambers: int = 2):
        self.chambers, self.key_planes, self.unit, self.period_s = chambers, 1, "kPa", 0.05
        self.limits = np.tile([-10.0, 50.0], (chambers, 1))
        self.arm, self.payload_g, self.gravity = ArmInfo(), None, None
        self.sent: list[tuple[float, np.ndarray]] = []
        self.t_s, self.at = 0.0, np.zeros(chambers)
        self.vents = self.closes = 0
        self.points = np.zeros((1, 3))
        self.measured = np.zeros(chambers)

    def reset(self):
        self.at = np.zeros(self.chambers)

    def command(self, pressures):
        self.at = np.array(pressures)
        self.sent.append((self.t_s, self.at))

    def wait(self, seconds):
        self.t_s += seconds

    def read(self):
        self.t_s += self.period_s
        return Sample(self.t_s, self.measured, self.at, self.points)

    def vent(self):
        self.vents += 1
        self.at = np.zeros(self.chambers)

    def close(self):
        self.closes += 1


def drive(rig, commands):
    """Command and read, once for each command."""
    for pressures in commands:
        rig.command(pressures)
        rig.read()


def run(bench, program, safety=None):
    """Run a program on a bench inside the safety wrapper."""
    with SafeRig(bench, safety) as rig:
        program(rig)


NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0, 50.0, -10.0]),
    st.floats(-60.0, 60.0),
)
STEPS = st.lists(
    st.tuples(st.lists(NUMBERS, min_size=2, max_size=2), st.sampled_from(["read", "wait", ""])),
    max_size=30,
)


@given(STEPS)
def test_limits_of_pressure_and_rate_hold_whatever_is_commanded(steps):
    bench = Valves()
    safety = Safety(lowest=-5.0, highest=40.0, rate=100.0)
    rig = SafeRig(bench, safety)
    try:
        for pressures, then in steps:
            rig.command(pressures)
            if then == "read":
                rig.read()
            elif then == "wait":
                rig.wait(0.12)
    except RigStopped:
        assert not np.isfinite(steps[len(steps) - 1][0]).all() or bench.vents
    times = np.array([0.0, *(t for t, _ in bench.sent)])
    values = np.array([np.zeros(2), *(p for _, p in bench.sent)])
    assert np.isfinite(values).all()
    assert values.min() >= -5.0
    assert values.max() <= 40.0
    # The rate of 100 kPa/s, over any two commands: at most 5 kPa for each period that passed, and
    # 5 kPa at the first.
    passed = np.maximum(times[1:] - times[:-1], 0.0)
    steps_kPa = np.abs(np.diff(values, axis=0)).max(axis=1, initial=0.0)
    assert (steps_kPa <= 5.0 + 1e-9).all()
    total = np.abs(values - values[0]).max(axis=1)
    assert (total <= 100.0 * np.cumsum([0.0, *passed]) + 5.0 + 1e-6).all()


def test_a_jump_becomes_a_ramp_that_arrives():
    bench = Valves()
    rig = SafeRig(bench, Safety(rate=100.0))
    rig.command([20.0, -10.0])
    for _ in range(4):
        rig.read()
    assert [p.tolist() for _, p in bench.sent] == [
        [5.0, -5.0],
        [10.0, -10.0],
        [15.0, -10.0],
        [20.0, -10.0],
    ]
    assert rig.counts["clipped"] == 0
    rig.command([0.0, -60.0])
    rig.wait(1.0)
    assert bench.at.tolist() == [0.0, -10.0]
    assert rig.counts["clipped"] == 1
    assert bench.t_s == pytest.approx(0.2 + 1.0)


def test_a_command_that_is_not_finite_is_refused_and_stops_the_run_if_it_goes_on():
    bench = Valves()
    rig = SafeRig(bench, Safety(rate=1e4, hold_ms=200.0, vent_ms=1000.0))
    rig.command([7.0, 8.0])
    rig.read()
    for _ in range(18):
        rig.command([np.nan, 9.0])
        rig.read()
    assert bench.at.tolist() == [7.0, 8.0]
    assert rig.counts["refused"] == 18
    with pytest.raises(RigStopped, match=r"no valid command for 1\.\d s, the last was \[nan, 9"):
        drive(rig, [[np.nan, 9.0]] * 9)
    assert bench.vents == 1
    with pytest.raises(RigStopped):
        rig.command([1.0, 1.0])
    assert bench.at.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ({"points": np.full((1, 3), np.nan)}, "no key point was seen for 1.0"),
        ({"measured": np.array([1.0, np.nan])}, "pressure sensor of chamber 2 was silent for 1.0"),
    ],
)
def test_without_sight_the_pressures_are_held_and_then_vented(lost, message):
    bench = Valves()

    def blinded(rig):
        drive(rig, [[10.0, 10.0]])
        for name, value in lost.items():
            setattr(bench, name, value)
        drive(rig, [[10.0 + k, 10.0] for k in range(40)])

    with pytest.raises(RigStopped, match=message):
        run(bench, blinded, Safety(rate=1e4, hold_ms=200.0, vent_ms=1000.0))
    blind = [(t, p[0]) for t, p in bench.sent if t > 0.06]
    assert max(p for t, p in blind) == pytest.approx(14.0), "held 0.2 s after the last key point"
    assert max(t for t, _ in blind) < 0.05 + 1.06
    assert (bench.vents >= 1, bench.closes) == (True, 1)


def test_a_lost_sight_that_comes_back_goes_on():
    bench = Valves()
    rig = SafeRig(bench, Safety(rate=1e4, hold_ms=100.0, vent_ms=1000.0))
    for k in range(30):
        bench.points = np.full((1, 3), np.nan if k % 10 else 0.0)
        rig.command([float(k), 0.0])
        rig.read()
    assert rig.counts["held"] > 10
    assert bench.vents == 0


def test_a_command_that_is_held_is_a_valid_one():
    """0.9 s without sight, then 0.5 s without a finite command: neither lasts for a second."""
    bench = Valves()
    rig = SafeRig(bench, Safety(rate=1e4, hold_ms=200.0, vent_ms=1000.0))
    drive(rig, [[5.0, 5.0]])
    bench.points = np.full((1, 3), np.nan)
    drive(rig, [[6.0, 6.0]] * 18)
    bench.points = np.zeros((1, 3))
    drive(rig, [[np.nan, 7.0]] * 10)
    assert rig.counts["held"] >= 13
    assert (bench.vents, bench.at.tolist()) == (0, [6.0, 6.0])


def test_a_ramp_ends_with_a_reset():
    bench = Valves()
    rig = SafeRig(bench, Safety(rate=10.0))
    drive(rig, [[40.0, 40.0]] * 3)
    assert 0.0 < bench.at[0] < 40.0
    rig.reset()
    sent = len(bench.sent)
    for _ in range(5):
        rig.read()
    rig.wait(1.0)
    assert (bench.at.tolist(), len(bench.sent)) == ([0.0, 0.0], sent)


def test_time_in_a_wait_is_no_time_without_sight_or_command():
    """Nobody looks and nobody commands while a program waits, three times as long as it may."""
    bench = Valves()
    rig = SafeRig(bench, Safety(rate=1e4, hold_ms=200.0, vent_ms=1000.0))
    drive(rig, [[5.0, 5.0]])
    rig.wait(3.0)
    rig.command([9.0, 8.0])
    assert (rig.counts["held"], bench.at.tolist()) == (0, [9.0, 8.0])
    rig.wait(3.0)
    rig.command([np.nan, 8.0])
    assert (rig.counts["refused"], bench.at.tolist(), bench.vents) == (1, [9.0, 8.0], 0)


def test_a_program_that_hangs_is_vented_by_the_watchdog():
    bench = Valves()

    def hang(rig):
        rig.command([10.0, 10.0])
        time.sleep(30.0)

    with pytest.raises(RigStopped, match=r"no command for 0\.\d s; the rig is vented"):
        run(bench, hang, Safety(hold_ms=50.0, vent_ms=100.0))
    assert bench.at.tolist() == [0.0, 0.0]


def test_the_watchdog_and_the_emergency_stop_work_in_every_block():
    """A rig without devices to give back can be driven again."""
    bench = Valves()
    rig = SafeRig(bench, Safety(hold_ms=50.0, vent_ms=100.0))
    with rig:
        rig.command([1.0, 1.0])
    with pytest.raises(KeyboardInterrupt), rig:
        signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), rig:
        signal.raise_signal(signal.SIGINT)

    def hang():
        with rig:
            rig.command([10.0, 10.0])
            time.sleep(5.0)

    with pytest.raises(RigStopped, match=r"no command for 0\.\d s; the rig is vented"):
        hang()
    assert bench.at.tolist() == [0.0, 0.0]


def test_after_a_reset_there_is_no_watchdog():
    bench = Valves()
    with SafeRig(bench, Safety(hold_ms=20.0, vent_ms=40.0)) as rig:
        rig.command([10.0, 10.0])
        rig.reset()
        time.sleep(0.1)
    assert bench.closes == 1


@pytest.mark.parametrize(
    ("name", "error"),
    [("SIGINT", KeyboardInterrupt), ("SIGTERM", Terminated), ("SIGHUP", Terminated)],
)
def test_signals_end_vented_and_handlers_come_back(name, error):
    if not hasattr(signal, name):
        pytest.skip(f"this system has no {name}")
    number, bench = getattr(signal, name), Valves()
    before = signal.getsignal(number)

    def signalled(rig):
        rig.command([10.0, 10.0])
        os.kill(os.getpid(), number)
        time.sleep(30.0)

    with pytest.raises(error):
        run(bench, signalled)
    assert (bench.vents, bench.closes, bench.at.tolist()) == (1, 1, [0.0, 0.0])
    assert signal.getsignal(number) is before


def test_a_stop_from_another_thread_vents_before_the_program_notices():
    bench = Valves()

    def opened(rig):
        rig.command([10.0, 10.0])
        thread = threading.Thread(target=rig.stop, args=("a door was opened",))
        thread.start()
        thread.join()
        drive(rig, [[10.0, 10.0]] * 100)

    with pytest.raises(RigStopped, match="a door was opened; the rig is vented"):
        run(bench, opened)
    assert len(bench.sent) == 1


def test_a_command_that_hangs_does_not_hold_up_the_emergency_stop():
    """The driver is inside `command` and never comes back; the stop vents all the same."""
    inside, released = threading.Event(), threading.Event()

    class Hanging(Valves):
        def command(self, pressures):
            inside.set()
            released.wait(30.0)

    bench = Hanging()
    rig = SafeRig(bench)
    hanging = threading.Thread(target=rig.command, args=([10.0, 10.0],))
    hanging.start()
    assert inside.wait(30.0)
    began = time.monotonic()
    rig.stop("a door was opened")
    assert time.monotonic() - began < 10.0
    assert bench.vents == 1
    released.set()
    hanging.join()
    with pytest.raises(RigStopped, match="a door was opened"):
        rig.read()


def test_the_first_reason_of_a_stop_counts_and_nothing_is_commanded_after_it():
    bench = Valves()
    rig = SafeRig(bench)
    rig.stop("first")
    rig.stop("second")
    for call in (rig.read, rig.reset, lambda: rig.command([1.0, 1.0]), lambda: rig.wait(1.0)):
        with pytest.raises(RigStopped, match="first"):
            call()
    assert (bench.vents, bench.sent) == (1, [])


def test_a_stop_between_a_command_and_its_sending_sends_nothing():
    """As by another thread: the clock is read after the command was accepted."""
    bench, stops = Valves(), []

    def clock():
        for stop in stops:
            stop("emergency stop by a key")
        return 0.0

    rig = SafeRig(bench, Safety(rate=1e4), clock=clock)
    stops.append(rig.stop)
    with pytest.raises(RigStopped, match="by a key"):
        rig.command([20.0, 30.0])
    assert (bench.vents, bench.sent, bench.at.tolist()) == (1, [], [0.0, 0.0])


def test_a_stop_in_a_dry_run_touches_no_valve():
    bench, shown = Valves(), []
    rig = SafeRig(bench, show=shown.append)
    rig.command([1.0, 1.0])
    rig.stop("enough")
    with pytest.raises(RigStopped, match="enough"):
        rig.command([2.0, 2.0])
    assert (bench.vents, bench.sent, len(shown)) == (0, [], 1)


def test_a_signal_does_not_break_off_the_venting():
    """A second one after the one that ended the run, and one at the end of a whole run."""

    class Slow(Valves):
        def vent(self):
            os.kill(os.getpid(), signal.SIGINT)
            super().vent()

    def signalled(rig):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(30.0)

    bench = Slow()
    with pytest.raises(Terminated):
        run(bench, signalled)
    assert (bench.vents, bench.closes) == (1, 1)
    bench = Slow()
    with SafeRig(bench):
        pass
    assert (bench.vents, bench.closes) == (1, 1)


def test_an_error_of_the_program_stays_that_error_where_venting_fails():
    class Cut(Valves):
        def vent(self):
            raise OSError("port is gone")

    for error, raised, message in (
        (ZeroDivisionError("own"), ZeroDivisionError, "own"),
        (InputError("no such point"), RigStopped, r"no such point; the rig could not be vented"),
    ):
        with pytest.raises(raised, match=message), SafeRig(Cut()):
            raise error


def test_a_driver_that_cannot_be_reached_says_that_its_watchdog_has_to_vent():
    class Cut(Valves):
        def vent(self):
            raise OSError("port is gone")

    with (
        pytest.raises(
            RigStopped,
            match=r"could not be vented from here \(port is gone\): its own watchdog has to",
        ),
        SafeRig(Cut()) as rig,
    ):
        rig.command([1.0, 1.0])


def test_a_clock_that_goes_back_stops_the_run():
    bench = Valves()
    rig = SafeRig(bench)
    rig.read()
    bench.t_s = -5.0
    with pytest.raises(RigStopped, match="the clock of the samples went from"):
        rig.read()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"lowest": 5.0, "highest": 5.0}, "lowest is 5 and highest is 5"),
        ({"rate": -1.0}, "rate is -1.0, expected 0 or a number above 0"),
        ({"rate": np.nan}, "rate is nan"),
        ({"hold_ms": 0.0}, "hold_ms is 0 and vent_ms is 2000"),
        ({"hold_ms": 300.0, "vent_ms": 200.0}, "expected 0 < hold_ms <= vent_ms"),
        ({"vent_ms": np.inf}, "vent_ms is inf"),
    ],
)
def test_safety_that_makes_no_sense_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        Safety(**given)


def test_limits_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match=r"lowest 60 and highest inf kPa leave nothing of .* 50 k"):
        SafeRig(Valves(), Safety(lowest=60.0))
    valves = Valves()
    for limits in ([[0.0, np.nan], [0.0, 1.0]], [[0.0, 1.0]]):
        valves.limits = np.array(limits)
        with pytest.raises(InputError, match="the rig's limits are"):
            SafeRig(valves)


def test_commands_and_samples_of_another_number_of_chambers_do_not_pass():
    valves = Valves()
    rig = SafeRig(valves)
    with pytest.raises(InputError, match=r"command has shape \(3,\), expected 2 pressures"):
        rig.command(np.zeros(3))
    assert not valves.sent
    valves.measured = np.zeros(3)
    with pytest.raises(RigStopped, match="a sample has 3 pressures, expected 2"):
        rig.read()
    assert valves.vents >= 1


def test_a_sample_with_another_number_of_key_points_stops_at_once():
    """And not when the recording of the whole run is put together."""
    valves = Valves()
    rig = SafeRig(valves)
    valves.points = np.zeros((2, 3))
    with pytest.raises(RigStopped, match=r"key points of shape \(2, 3\), expected \(1, 3\)"):
        rig.read()
    assert valves.vents >= 1


def test_a_dry_run_shows_and_sends_nothing():
    bench, shown = Valves(), []
    with SafeRig(bench, Safety(rate=100.0), shown.append) as rig:
        rig.reset()
        rig.command([8.0, np.inf])
        rig.command([8.0, -3.0])
        rig.wait(2.0)
    assert (bench.sent, bench.vents, bench.t_s) == ([], 0, 0.0)
    assert shown == [
        "vent and rest",
        "send    0.000    0.000 kPa",
        "send    5.000   -3.000 kPa",
        "send    8.000   -3.000 kPa",
    ]


def test_a_simulated_rig_is_driven_as_it_is_and_collect_guards_a_real_one():
    with guarded(VirtualRig(0)) as rig:
        assert isinstance(rig, VirtualRig)
    bench = Valves()
    protocol = Protocol("p", "settled", [[50.0, 0.0], [50.0, 50.0]], [0, 0], settle_s=1.0)
    with guarded(bench) as rig:
        recording = collect(rig, protocol)
    assert (bench.vents, bench.closes) == (1, 1)
    np.testing.assert_array_equal(recording.commanded, protocol.commands)
    assert max(np.abs(np.diff([p for _, p in bench.sent], axis=0)).max(axis=1)) <= 3.0 + 1e-9


PROGRAM = """
import sys, time
sys.path.insert(0, {root!r})
from tests.rig.test_safety import Valves
from surgisoft.rig import SafeRig, RigStopped

class Shown(Valves):
    def vent(self):
        super().vent()
        print("vented", flush=True)

try:
    with SafeRig(Shown()) as rig:
        rig.command([5.0, 5.0])
        print("ready", flush=True)
        while True:
            rig.command([5.0, 5.0])
            time.sleep(0.02)
except RigStopped as error:
    print(error, flush=True)
"""


def test_the_space_bar_is_an_emergency_stop_and_the_terminal_is_left_as_it_was():
    pty = pytest.importorskip("pty", reason="Windows has no pseudo-terminals")
    import termios

    root = os.getcwd()
    main, end = pty.openpty()
    before = termios.tcgetattr(end)
    child = subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(root=root)],
        stdin=end,
        stdout=end,
        stderr=end,
        start_new_session=True,
        preexec_fn=lambda: __import__("fcntl").ioctl(0, termios.TIOCSCTTY, 0),
    )

    def until(word):
        text = ""
        while word not in text:
            assert select.select([main], [], [], 120.0)[0], text  # a busy machine starts late
            text += os.read(main, 1000).decode()
        return text

    until("ready")
    os.write(main, b"x")
    os.write(main, b" ")
    text = until("emergency stop by a key; the rig is vented")
    assert "vented" in text.split("emergency")[0], "vented before the program ends"
    assert child.wait(10.0) == 0
    assert termios.tcgetattr(end) == before
    os.close(main)
    os.close(end)
