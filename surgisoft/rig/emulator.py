"""An emulator of a bench: a pressure controller on a pseudo-terminal, motion capture on UDP.

It speaks the real protocols over real transports of this computer; a simulated rig is behind them:

    python -m surgisoft.rig.emulator --rig virtual:seed=0

prints the options that open it as a rig (`--rig serial:port=/dev/pts/3,mocap=udp:9763`). Nothing
but pseudo-terminals and the loopback interface is used. The simulated rig stands still until a
client first sets pressures, so that the time of a change (`hidden=payload@60`) counts from there.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np

from surgisoft.errors import InputError
from surgisoft.rig.drivers import natnet
from surgisoft.rig.drivers.line_protocol import Data, Info, line, words_of
from surgisoft.rig.drivers.motion_capture import Body, Frame, encode_json
from surgisoft.rig.interface import Rig, Sample, is_simulated, vented
from surgisoft.rig.registry import open_rig

LOOPBACK = "127.0.0.1"
LONGEST_WATCHDOG_MS = 60_000
"""Longest time that the emulated controller accepts for its watchdog [ms of its clock]."""


class Emulator:
    """A bench that is emulated in a thread, real time times `speed`."""

    def __init__(
        self,
        rig: Rig | str = "virtual",
        mocap_port: int = 0,
        speed: float = 1.0,
        natnet_version: tuple[int, int] | None = None,
        multicast: str = "",
    ) -> None:
        """Begin to emulate.

        rig: simulated rig behind the devices, or its text. mocap_port: port to which frames are
        sent as JSON, or (natnet_version given) the command port of a NatNet server; 0: a free one.
        multicast: group to which the NatNet server streams; empty: unicast.
        """
        self.rig = open_rig(rig) if isinstance(rig, str) else rig
        if not is_simulated(self.rig):
            raise InputError("the emulator needs a simulated rig, such as virtual:seed=0")
        try:
            import pty
            import tty
        except ImportError:
            raise InputError(
                "the emulator needs pseudo-terminals, which Windows lacks; run it in WSL"
            ) from None
        self.speed = speed
        low, high = self.rig.limits.T
        self.info = Info(
            self.rig.chambers, float(low.min()), float(high.max()), 300, 1000, "emulator"
        )
        self.state, self.log = "I", list[tuple[float, str, np.ndarray]]()
        """State of the controller; and each change: (its clock [s], state, set points)."""
        self.silent = False
        """The controller sends nothing, as with a broken transmit line."""
        self.blind = False
        """The cameras send nothing."""
        self.occluded: set[int] = set()
        """Key points that are not seen."""
        self.exchanged: tuple[int, int] | None = None
        """Two key points whose labels are swapped."""
        self.skipped: set[int] = set()
        """Numbers of frames that are lost on the way."""
        self.damage_every = 0
        """Every so many lines of the controller have a wrong character; 0: none."""
        self.clock_ahead_s = 1234.5
        """Clock of the cameras ahead of the controller's [s]."""
        self.vents = 0
        """Times that the valves were opened, by request or by the watchdog."""
        self.number = 0
        """Number of the last frame."""
        self._target = vented(self.rig.limits)
        self._seq, self._heard_ms, self._lines = 0, 0.0, 0
        self._names = {k + 1: f"k{k}" for k in range(self.rig.key_planes)}
        self._natnet = natnet_version
        self._group = multicast
        self._clients: set[tuple[str, int]] = set()
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if natnet_version:
            self._sender.bind((LOOPBACK, mocap_port))
            self._sender.setblocking(False)
            mocap_port = self._sender.getsockname()[1]
            if multicast:
                interface = socket.inet_aton(LOOPBACK)
                self._sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
        elif not mocap_port:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((LOOPBACK, 0))
                mocap_port = probe.getsockname()[1]
        self.mocap_port = mocap_port
        self.data_port = mocap_port + 1
        self._main, self._end = pty.openpty()
        tty.setraw(self._main)
        tty.setraw(self._end)
        self.port = os.ttyname(self._end)
        self._cut = False
        self._driven = False
        """A client has set pressures: the simulated rig's time runs."""
        self._over = threading.Event()
        self.rig.reset()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def options(self) -> str:
        """Text that opens it as a rig."""
        mocap = f"natnet:{LOOPBACK}:{self.mocap_port}" if self._natnet else f"udp:{self.mocap_port}"
        speed = f",speed={self.speed:g}" if self.speed != 1.0 else ""
        return f"serial:port={self.port},mocap={mocap}{speed}"

    @property
    def target(self) -> np.ndarray:
        """(m,) present set points [kPa]."""
        return self._target.copy()

    def cut_cable(self) -> None:
        """Cut the serial line: the computer's end sees an error, the controller hears nothing."""
        self._cut = True
        os.close(self._end)
        os.close(self._main)

    def close(self) -> None:
        """End the emulation."""
        self._over.set()
        self._thread.join(timeout=5.0)
        self._sender.close()
        if not self._cut:
            os.close(self._main)
            os.close(self._end)

    def _run(self) -> None:
        begun, step, pending = time.monotonic(), 0, b""
        sample = self.rig.read()
        while not self._over.is_set():
            step += 1
            due = begun + step * self.rig.period_s / self.speed
            while (left := due - time.monotonic()) > 0.0:
                pending = self._listen(pending, left)
            pending = self._listen(pending, 0.0)
            now_s = step * self.rig.period_s
            self._watch(now_s)
            low, high = self.rig.limits.T
            if self._driven:
                self.rig.command(np.clip(self._target, low, high))
                sample = self.rig.read()
            self._report(now_s, sample)
            self._show(now_s, sample)
            if time.monotonic() > due + 1.0:  # the computer was busy: time goes on from here
                begun = time.monotonic() - step * self.rig.period_s / self.speed

    def _listen(self, pending: bytes, seconds: float) -> bytes:
        """Take in commands and requests for a while; returns what is no whole line yet."""
        sources: list[int | socket.socket] = [] if self._cut else [self._main]
        sources += [self._sender] if self._natnet else []
        with contextlib.suppress(OSError, ValueError):
            ready, _, _ = select.select(sources, [], [], max(0.0, min(seconds, 0.05)))
            if self._sender in ready:
                self._answer(*self._sender.recvfrom(65536))
            if self._main in ready:
                *lines, pending = (pending + os.read(self._main, 4096)).split(b"\n")
                for raw in lines:
                    words = words_of(raw, ">")
                    if words:
                        self._obey(words)
        return pending

    def _obey(self, words: list[str]) -> None:
        """Do what a message asks for."""
        kind, *rest = words
        try:
            if kind == "HELLO":
                self._send(self.info.words())
            elif kind == "WATCH":
                hold, vent = map(int, rest)
                if 0 < hold <= vent <= LONGEST_WATCHDOG_MS:
                    self.info = Info(
                        self.info.chambers,
                        self.info.low_kPa,
                        self.info.high_kPa,
                        hold,
                        vent,
                        self.info.name,
                    )
                self._send(self.info.words())
            elif kind == "VENT":
                self._seq = int(rest[0])
                self.vents += 1
                self._change("I" if self.state != "T" else "T", vented(self.rig.limits))
            elif kind == "ARM":
                self._seq = int(rest[0])
                self._change("I", vented(self.rig.limits))
            elif kind == "SET":
                self._set(int(rest[0]), [float(x) for x in rest[1:]])
        except (ValueError, IndexError):
            self._send("NAK 0 malformed")

    def _set(self, seq: int, values: list[float]) -> None:
        if len(values) != self.info.chambers or not np.isfinite(values).all():
            self._send(f"NAK {seq} expected {self.info.chambers} pressures")
        elif self.state == "T":
            self._send(f"NAK {seq} tripped")
        else:
            self._seq, self._heard_ms, self._driven = seq, -1.0, True
            self._change("R", np.clip(values, self.info.low_kPa, self.info.high_kPa))

    def _change(self, state: str, target: np.ndarray) -> None:
        self.state, self._target = state, np.asarray(target, np.float64)
        self.log.append((self._lines * self.rig.period_s, state, self._target))

    def _watch(self, now_s: float) -> None:
        """The controller's own watchdog."""
        now_ms = 1e3 * now_s
        if self._heard_ms < 0.0:
            self._heard_ms = now_ms
        silent_ms = now_ms - self._heard_ms
        if self.state in ("R", "H") and silent_ms > self.info.vent_ms:
            self.vents += 1
            self._change("T", vented(self.rig.limits))
        elif self.state == "R" and silent_ms > self.info.hold_ms:
            self._change("H", self._target)

    def _report(self, now_s: float, sample: Sample) -> None:
        measured = tuple(map(float, sample.measured))
        data = Data(round(1e3 * now_s), self._seq, self.state, measured, tuple(self._target))
        self._lines += 1
        if not self.silent:
            self._send(data.words())

    def _send(self, body: str) -> None:
        raw = line(body, "<")
        if self.damage_every and self._lines % self.damage_every == 0:
            raw = raw.replace(b" ", b"!", 1)
        with contextlib.suppress(OSError):  # the cable is cut, or nobody reads
            if not self._cut and select.select([], [self._main], [], 0.0)[1]:
                os.write(self._main, raw)

    def _show(self, now_s: float, sample: Sample) -> None:
        """Send a frame of the cameras."""
        self.number += 1
        names = list(range(self.rig.key_planes))
        if self.exchanged:
            i, j = self.exchanged
            names[i], names[j] = names[j], names[i]
        points = {
            f"k{name}": np.full(3, np.nan) if k in self.occluded else sample.key_points_mm[k]
            for k, name in enumerate(names)
        }
        if self.blind or self.number in self.skipped:
            return
        t_s = now_s + self.clock_ahead_s
        if not self._natnet:
            frame = Frame(self.number, t_s, dict(sorted(points.items())), {})
            self._sender.sendto(encode_json(frame), (LOOPBACK, self.mocap_port))
            return
        still = np.array([0.0, 0.0, 0.0, 1.0])
        bodies = {name: Body(at, still) for name, at in sorted(points.items())}
        packet = encode_frame(Frame(self.number, t_s, {}, bodies), self._natnet, self._names)
        for client in self._clients if not self._group else {(self._group, self.data_port)}:
            with contextlib.suppress(OSError):
                self._sender.sendto(packet, client)

    def _answer(self, packet: bytes, client: tuple[str, int]) -> None:
        """Answer a request to the NatNet server."""
        assert self._natnet is not None
        kind = struct.unpack_from("<H", packet)[0]
        if kind == natnet.CONNECT:
            self._clients.add(client)
            body = b"Emulator".ljust(natnet.NAME_BYTES, b"\0") + bytes([1, 0, 0, 0])
            body += bytes([*self._natnet, 0, 0])
            group = socket.inet_aton(self._group or "0.0.0.0")
            body += struct.pack("<QH?", CLOCK_HZ, self.data_port, bool(self._group)) + group
            self._sender.sendto(message(natnet.SERVERINFO, body), client)
        elif kind == natnet.REQUEST_MODELDEF:
            body = encode_bodies(self._names, self._natnet)
            self._sender.sendto(message(natnet.MODELDEF, body), client)


CLOCK_HZ = 10_000_000
"""Ticks a second of the emulated NatNet server's clock."""


def message(kind: int, body: bytes) -> bytes:
    """A NatNet message."""
    return struct.pack("<HH", kind, len(body)) + body


def _block(count: int, body: bytes, version: tuple[int, int]) -> bytes:
    """Items of a message: their number, from version 4.1 on their size, and they themselves."""
    size = struct.pack("<i", len(body)) if version >= (4, 1) else b""
    return struct.pack("<i", count) + size + body


def encode_bodies(names: dict[int, str], version: tuple[int, int]) -> bytes:
    """MODELDEF of rigid bodies, number -> name, without its header."""
    body = struct.pack("<i", len(names))
    for identity, name in names.items():
        one = name.encode() + b"\0" + struct.pack("<ii3fi", identity, -1, 0.0, 0.0, 0.0, 0)
        size = struct.pack("<i", len(one)) if version >= (4, 1) else b""
        body += struct.pack("<i", 1) + size + one
    return body


def encode_frame(frame: Frame, version: tuple[int, int], names: dict[int, str]) -> bytes:
    """FRAMEOFDATA of the rigid bodies of a frame, header included."""
    identities = {name: identity for identity, name in names.items()}
    bodies = b""
    for name, body in frame.bodies.items():
        tracked = bool(np.isfinite(body.position_mm).all())
        at = body.position_mm / natnet.MM_PER_M if tracked else np.zeros(3)
        flags = natnet.TRACKED if tracked else 0
        bodies += struct.pack("<i7ffh", identities[name], *at, *body.rotation, 0.0, flags)
    content = struct.pack("<i", frame.number)
    content += _block(0, b"", version) + _block(0, b"", version)
    content += _block(len(frame.bodies), bodies, version)
    content += _block(0, b"", version)  # skeletons
    if version >= (4, 1):
        content += _block(0, b"", version)  # assets
    content += 3 * _block(0, b"", version)  # labelled markers, force plates, devices
    ticks = round(frame.t_s * CLOCK_HZ)
    content += struct.pack("<II d 3Q", 0, 0, frame.t_s, ticks, ticks, ticks)
    if version >= (4, 1):
        content += struct.pack("<II", 0, 0)
    content += struct.pack("<hi", 0, 0)
    return message(natnet.FRAMEOFDATA, content)


@contextlib.contextmanager
def emulated(*arguments, **options) -> Iterator[Emulator]:
    """An emulator for the time of a block; arguments as for `Emulator`."""
    found = Emulator(*arguments, **options)
    try:
        yield found
    finally:
        found.close()


def main(arguments: list[str] | None = None) -> int:
    """The command: emulate until it is stopped."""
    parser = argparse.ArgumentParser(
        prog="python -m surgisoft.rig.emulator",
        description="Emulate a serial pressure controller and motion capture on this computer, "
        "with a simulated rig behind them.",
    )
    parser.add_argument(
        "--rig", default="virtual", metavar="NAME[:option=value,...]", help="the simulated rig"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, help="how many times faster than real time"
    )
    parser.add_argument(
        "--mocap",
        choices=("json", "natnet3", "natnet4"),
        default="json",
        help="format of the motion capture stream",
    )
    parser.add_argument(
        "--mocap-port",
        type=int,
        default=0,
        metavar="PORT",
        help="UDP port of the stream (0: a free one)",
    )
    parser.add_argument("--link", metavar="PATH", help="symbolic link to make to the serial port")
    given = parser.parse_args(arguments)
    version = {"json": None, "natnet3": (3, 1), "natnet4": (4, 1)}[given.mocap]
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    try:
        if not given.speed > 0.0:
            raise InputError(f"--speed is {given.speed:g}, expected more than 0")
        with emulated(given.rig, given.mocap_port, given.speed, version) as bench:
            options = bench.options
            if given.link:
                if os.path.islink(given.link):
                    os.unlink(given.link)
                os.symlink(bench.port, given.link)
                options = options.replace(bench.port, given.link)
            sys.stdout.write(f"--rig {options}\n")
            sys.stdout.flush()
            over.wait()
        if given.link:
            os.unlink(given.link)
    except (InputError, OSError) as error:
        sys.stderr.write(f"surgisoft: error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
