"""Rigs and benches that cannot be meant, and a controller that is asked for the impossible."""

import os
import select
import signal
import threading
import time

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.rig import SafeRig, Safety, VirtualRig, open_rig
from surgisoft.rig.drivers.line_protocol import Data, Info, line, words_of
from surgisoft.rig.drivers.motion_capture import decode_json
from surgisoft.rig.drivers.serial_rig import open_motion_capture
from surgisoft.rig.emulator import emulated, main
from surgisoft.rig.lerobot import NamedRig
from surgisoft.rig.registry import hidden_of, rig_options
from surgisoft.rig.trial import collect, dry_run
from tests.rig.own_rig import OwnRig
from tests.rig.test_safety import Valves

HERE = "tests.rig.test_refusals"


class Nameless(OwnRig):
    """A parameter without a name for its caller."""

    def __init__(self, port, /):
        super().__init__(port)


class Quiet(OwnRig):
    """An option that is true or false, one of two types, and others that are passed on."""

    def __init__(self, *rest, port: str = "x", quiet: bool = False, at: int | str = 3, **more):
        super().__init__(port)
        self.quiet, self.place = quiet, at


def simulated(port: str = "x") -> VirtualRig:
    """A user's function that opens a simulated rig."""
    return VirtualRig(3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{HERE}:Nameless:port=x", "parameter 'port' has no name for a caller; expected keyword"),
        (f"{HERE}:Quiet:quiet=maybe", "option 'quiet' is 'maybe', expected"),
        (f"{HERE}:simulated:lowest=3", "'lowest' is a safety limit of real rigs, and this one is"),
        (f"{HERE}:Quiet.Missing", f"'{HERE}' has no 'Quiet.Missing'; correct the name"),
        ("elastica:hidden=creep:1@360", "the rig 'elastica' has all its effects from the start"),
        ("elastica:seed=-1", "seed is -1, expected a whole number >= 0"),
        ("elastica:gravity=0/0/0", "gravity is [0.0, 0.0, 0.0], expected a direction of three num"),
        ("elastica:payload_g=1000", "payload is 1000.0 g, expected 0 to"),
        ("elastica:noise=-1", "noise scale is -1.0, expected a number >= 0"),
        ("elastica:elements=3", "elements is 3, expected at least 6"),
        ("elastica:hidden=haunting", "unknown hidden effect 'haunting'"),
        ("elastica:hidden=creep/creep", "hidden effect 'creep' is given twice, expected once"),
        ("elastica:hidden=creep:11", "strength of 'creep' is 11.0, expected 0 to 10"),
    ],
)
def test_a_rig_that_cannot_be_opened_is_one_line(text, message):
    with pytest.raises(InputError) as error:
        open_rig(text)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_options_of_a_users_rig_have_their_types():
    rig = open_rig(f"{HERE}:Quiet:quiet=yes,at=7").rig
    assert (rig.quiet, rig.place) == (True, "7")
    assert open_rig(f"{HERE}:Quiet:quiet=no").rig.quiet is False
    assert set(rig_options(f"{HERE}:Quiet")) >= {"port", "quiet", "at"}
    assert isinstance(open_rig(f"{HERE}:simulated"), VirtualRig)


def test_hidden_effects_are_those_of_simulated_rigs():
    assert {"creep", "leak"} <= set(hidden_of("virtual")) & set(hidden_of("elastica"))
    with pytest.raises(InputError, match="unknown rig 'nowhere'"):
        hidden_of("nowhere")
    with pytest.raises(InputError, match="rig 'serial' has no hidden effects; virtual and"):
        hidden_of("serial")


def test_a_dry_run_is_for_real_rigs():
    shown: list[str] = []
    plan = Protocol("p", "continuous", np.ones((3, 2)), np.zeros(3), 0.05 * np.arange(3.0))
    bench = Valves()
    dry_run(plan, bench, shown.append)
    assert bench.sent == []
    assert shown[0] == "vent and rest"
    assert shown[-1] == "send    1.000    1.000 kPa"
    settled = Protocol("p", "settled", [[2.0, 0.0]], [0], settle_s=1.0)
    dry_run(settled, bench, shown.append)
    assert shown[-1] == "send    2.000    0.000 kPa"
    with pytest.raises(InputError, match="a dry run is for real rigs, and this one is simulated"):
        dry_run("walk", "virtual", shown.append)


def test_a_rig_without_valves_of_its_own_is_stopped_and_closed():
    """Neither `vent` nor `close`: nothing is asked of it that it does not have."""

    class Plain(Valves):
        vent = close = None

    rig = SafeRig(Plain(), Safety(rate=1e4))
    rig.command([20.0, 0.0])
    rig.stop("enough")
    rig.stop("a second reason")
    with pytest.raises(InputError, match="enough"):
        rig.command([20.0, 0.0])
    dry = SafeRig(Plain(), show=lambda text: None)
    dry.vent()
    dry.close()
    assert dry.rig.sent == []


def test_options_beside_an_open_rig_are_refused():
    plan = Protocol("p", "settled", [[2.0, 0.0]], [0])
    with pytest.raises(InputError, match="noise, hidden: options of the virtual rig"):
        collect(plan, Valves(), hidden=["creep"], noise=0.0)
    with pytest.raises(InputError, match="nowhere"):
        collect("nowhere", f"{HERE}:Quiet", seed=3)


def test_a_rig_by_names_is_connected_once():
    named = NamedRig("virtual:seed=3")
    named.connect()
    assert named.is_connected
    assert named.rate_Hz == pytest.approx(20.0)
    with pytest.raises(InputError, match="rig 'virtual:seed=3': connected already"):
        named.connect()
    named.disconnect()
    assert not named.is_connected


def test_words_that_are_no_message():
    known = Info(2, -10.0, 60.0, 300, 1000, "bench")
    assert Info.read(known.words().split(" ")) == known
    with pytest.raises(ValueError, match="got version 9 of INFO, expected version 1 of INFO"):
        Info.read(known.words().replace("INFO 1", "INFO 9").split(" "))
    report = Data(5, 1, "R", (1.0, 2.0), (3.0, 4.0))
    assert Data.read(report.words().split(" "), 2) == report
    for words in (report.words().replace(" R ", " X "), "DATA 5 1 R 1.0 2.0 3.0"):
        with pytest.raises(ValueError, match="no report of 2 chambers: DATA 5 1"):
            Data.read(words.split(" "), 2)
    with pytest.raises(ValueError, match="a body has not three coordinates and four of a quat"):
        decode_json(b'{"frame":1,"t":0,"bodies":{"a":{"position":[0,0],"rotation":[0,0,0,1]}}}')


def answer(port: int, kinds: tuple[str, ...]) -> list[str]:
    """The words of the controller's next message of one of these kinds."""
    pending, until = b"", time.monotonic() + 20.0
    while time.monotonic() < until:
        if select.select([port], [], [], 0.1)[0]:
            pending += os.read(port, 4096)
        *lines, pending = pending.split(b"\n")
        for raw in lines:
            words = words_of(raw, "<")
            if words and words[0] in kinds:
                return words
    raise AssertionError(f"no {kinds} came")


def test_the_emulated_controller_keeps_to_its_limits_and_holds_where_nothing_is_heard():
    """-15 to 54 kPa; after 40 ms without a message the last set points are held, not vented."""
    rig = VirtualRig(0)
    rig.read()  # which compiles it
    with emulated(rig, speed=20.0) as bench:
        port = os.open(bench.port, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(port, line("WATCH 40 60000"))
            assert answer(port, ("INFO",))[5:7] == ["40", "60000"]
            os.write(port, line("SET 6 99 -99 3"))
            until = time.monotonic() + 20.0
            while bench.state != "H" and time.monotonic() < until:
                answer(port, ("DATA",))
            assert (bench.state, bench.target.tolist()) == ("H", [54.0, -15.0, 3.0])
        finally:
            os.close(port)


def test_the_emulated_controller_refuses_what_makes_no_sense():
    rig = VirtualRig(0)
    rig.read()  # which compiles it
    with emulated(rig, speed=20.0) as bench:
        port = os.open(bench.port, os.O_RDWR | os.O_NOCTTY)
        try:

            def asked(body: str, *kinds: str) -> list[str]:
                os.write(port, line(body))
                return answer(port, kinds or ("NAK",))

            assert asked("HELLO", "INFO")[:3] == ["INFO", "1", "3"]
            assert asked("SET 4 1.0 2.0") == ["NAK", "4", "expected", "3", "pressures"]
            assert asked("SET 5 1.0 2.0 nan") == ["NAK", "5", "expected", "3", "pressures"]
            assert asked("SET x 1 2 3") == ["NAK", "0", "malformed"]
            assert asked("ARM") == ["NAK", "0", "malformed"]
            assert asked("WATCH 500 400", "INFO")[5:7] == ["300", "1000"], "hold before vent"
            assert asked("WATCH 20 40", "INFO")[5:7] == ["20", "40"]
            os.write(port, line("SET 6 1 2 3") + b"damaged\n" + line("DANCE 7"))
            until = time.monotonic() + 20.0
            while bench.state != "T" and time.monotonic() < until:
                answer(port, ("DATA",))
            assert bench.state == "T", "no SET for 40 ms: tripped, by the watchdog"
            assert asked("SET 8 1 2 3") == ["NAK", "8", "tripped"]
            os.write(port, line("VENT 9"))
            while (words := answer(port, ("DATA",)))[2] != "9":
                pass
            assert words[3] == "T", "venting does not arm it"
            os.write(port, line("ARM 10"))
            while (words := answer(port, ("DATA",)))[2] != "10":
                pass
            assert words[3] == "I"
        finally:
            os.close(port)


def test_the_emulator_says_what_it_needs(tmp_path, capsys):
    with (
        pytest.raises(InputError, match="the emulator needs a simulated rig"),
        emulated(OwnRig("x")),
    ):
        pytest.fail("it does not begin")
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        assert main(["--speed", "0"]) == 2
        assert capsys.readouterr().err == "surgisoft: error: --speed is 0, expected more than 0\n"
        (tmp_path / "port").symlink_to("nowhere")
        for options in ([], ["--link", str(tmp_path / "port")]):
            timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM))
            timer.start()
            assert main([*options, "--mocap", "natnet4"]) == 0
            timer.join()
            said = capsys.readouterr().out
            assert said.startswith("--rig serial:")
            assert (f"port={tmp_path / 'port'}" in said) == bool(options)
        assert not (tmp_path / "port").is_symlink()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize(
    "text",
    [
        "udp:0",
        "udp:x",
        "udp:²",
        "udp:70000",
        "natnet:",
        "natnet:here:0",
        "natnet:here:x",
        "natnet:here:²",
        "vicon:1",
    ],
)
def test_motion_capture_comes_by_udp_or_from_a_natnet_server(text):
    with pytest.raises(InputError, match="expected udp:PORT or natnet:SERVER"):
        open_motion_capture(text, "127.0.0.1", time.monotonic)
