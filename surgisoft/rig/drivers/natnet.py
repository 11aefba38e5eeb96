"""OptiTrack's NatNet protocol, versions 3 and 4: what Motive streams, by unicast or multicast.

A datagram is a message: two little-endian unsigned 16-bit numbers, its kind and the size of what
follows (NatNet SDK 4.1, `NatNetTypes.h` and the direct depacketisation sample). A client asks the
server's command port (1510) who it is (`CONNECT`, answered by `SERVERINFO` with the version of
NatNet and the frequency of its clock) and for the names of rigid bodies (`REQUEST_MODELDEF`,
answered by `MODELDEF`). Frames (`FRAMEOFDATA`) come to the socket that asked where the server
streams by unicast, else to the multicast group that the server names.

Positions come in metres. A rigid body that is not tracked keeps its last pose with a flag that says
so: here its position is NaN. Labelled markers are named BODY.NUMBER. A frame's time is that of
mid-exposure where the server gives it, else the software's time stamp.
"""

from __future__ import annotations

import math
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from surgisoft.errors import InputError
from surgisoft.rig.drivers.motion_capture import (
    DAMAGED,
    PACKET,
    Body,
    Frame,
    FrameReceiver,
    listen,
)

COMMAND_PORT = 1510
"""Port on which a server takes requests."""
CONNECT, SERVERINFO, REQUEST_MODELDEF, MODELDEF, FRAMEOFDATA, KEEPALIVE = 0, 1, 4, 5, 7, 10
"""Kinds of messages."""
NAME_BYTES = 256
"""Length of names in SERVERINFO [bytes]."""
TRACKED = 0x01
"""Bit of a rigid body's flags: it is tracked in this frame."""
OCCLUDED = 0x01
"""Bit of a marker's flags: it is not seen in this frame."""
MM_PER_M = 1000.0
ANSWER_S, TRIES = 0.5, 4
"""Time for an answer [s], and requests before the client gives up."""
KEEP_ALIVE_S = 1.0
"""Time between two messages that keep a unicast stream running [s]."""


class Cursor:
    """Reads numbers and names of a message, one after the other."""

    def __init__(self, data: bytes, at: int = 0) -> None:
        self.data, self.at = data, at

    def take(self, layout: str) -> tuple:
        """Numbers by `struct`'s letters, little-endian; raises ValueError at the message's end."""
        size = struct.calcsize("<" + layout)
        if self.at + size > len(self.data):
            raise ValueError(f"message ends after {len(self.data)} bytes, inside a value")
        found = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += size
        return found

    def number(self, layout: str = "i") -> int:
        """One number."""
        return self.take(layout)[0]

    def count(self, least_bytes: int) -> int:
        """A number of items, each of at least so many bytes, that fit into the rest."""
        found = self.number()
        if found < 0 or found * least_bytes > len(self.data) - self.at:
            raise ValueError(f"{found} items do not fit into the message")
        return found

    def text(self) -> str:
        """A name that ends with a zero byte."""
        end = self.data.index(b"\0", self.at)
        found = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return found

    def skip(self, size: int) -> None:
        """Pass over bytes."""
        if size < 0 or self.at + size > len(self.data):
            raise ValueError(f"message ends after {len(self.data)} bytes, inside a block")
        self.at += size


@dataclass(frozen=True)
class Server:
    """Properties that a server states about itself."""

    name: str
    """Name of the program, such as Motive."""
    version: tuple[int, int]
    """Version of NatNet, major and minor."""
    clock_Hz: float
    """Ticks a second of the clock of mid-exposure times; 0 where it gives none."""
    data_port: int
    """Port of the multicast stream."""
    group: str
    """Multicast group of the stream; empty: unicast."""


def read_server(payload: bytes) -> Server:
    """The server of a SERVERINFO message without its header."""
    name = payload[:NAME_BYTES].split(b"\0")[0].decode("utf-8", "replace")
    cursor = Cursor(payload, NAME_BYTES + 4)
    major, minor, *_ = cursor.take("4B")
    clock_Hz, port, multicast, group = 0, 1511, False, b""
    if len(payload) >= cursor.at + 15:
        clock_Hz, port, multicast = cursor.take("QH?")
        group = bytes(cursor.take("4B"))
    address = socket.inet_ntoa(group) if multicast and group else ""
    return Server(name, (major, minor), float(clock_Hz), port, address)


def read_bodies(payload: bytes, version: tuple[int, int]) -> dict[int, str]:
    """Number -> name of each rigid body of a MODELDEF message without its header.

    Before NatNet 4.1 a description has no size, so that nothing is read behind the first one that
    is neither a marker set nor a rigid body; Motive sends those first.
    """
    cursor, found = Cursor(payload), {}
    sized = version >= (4, 1)
    for _ in range(cursor.count(4)):
        kind = cursor.number()
        end = cursor.number() + cursor.at if sized else 0
        if kind == 0:
            cursor.text()
            for _ in range(cursor.count(1)):
                cursor.text()
        elif kind == 1:
            name = cursor.text()
            found[cursor.number()] = name
            cursor.skip(4 + 12)
            markers = cursor.count(16)
            cursor.skip(16 * markers)
            if version >= (4, 0):
                for _ in range(markers):
                    cursor.text()
        elif not sized:
            break
        if sized:
            cursor.skip(end - cursor.at)
    return found


def read_frame(
    payload: bytes, version: tuple[int, int], names: dict[int, str], clock_Hz: float = 0.0
) -> Frame:
    """The frame of a FRAMEOFDATA message without its header; raises ValueError for a bad one."""
    cursor = Cursor(payload)
    sized = version >= (4, 1)

    def items(least_bytes: int) -> int:
        found = cursor.count(least_bytes)
        if sized:
            cursor.number()
        return found

    number = cursor.number()
    for _ in range(items(5)):  # marker sets
        cursor.text()
        cursor.skip(12 * cursor.count(12))
    cursor.skip(12 * items(12))  # markers without a label, as old clients read them
    bodies = {}
    for _ in range(items(38)):
        identity, body = _body(cursor)
        bodies[names.get(identity, f"body{identity}")] = body
    for _ in range(items(8)):  # skeletons
        cursor.number()
        for _ in range(cursor.count(38)):
            _body(cursor)
    if sized:  # assets
        cursor.number()
        cursor.skip(cursor.number())
    points = {}
    for _ in range(items(26)):
        identity, x, y, z, _, flags, _ = cursor.take("i4fhf")
        model, marker = identity >> 16, identity & 0xFFFF
        at = np.array([x, y, z]) * MM_PER_M
        points[f"{names.get(model, model)}.{marker}"] = (
            np.full(3, math.nan) if flags & OCCLUDED else at
        )
    for _ in range(2):  # force plates, other devices
        for _ in range(items(8)):
            cursor.number()
            for _ in range(cursor.count(4)):
                cursor.skip(4 * cursor.count(4))
    cursor.skip(8)  # time code
    t_s, exposed, _, _ = cursor.take("d3Q")
    if exposed and clock_Hz:
        t_s = exposed / clock_Hz
    if not math.isfinite(t_s):
        raise ValueError("the time of the frame is not finite")
    return Frame(number, t_s, points, bodies)


def _body(cursor: Cursor) -> tuple[int, Body]:
    """Number and pose of a rigid body, version 3 and later."""
    identity, *numbers, _, flags = cursor.take("i7ffh")
    position = MM_PER_M * np.array(numbers[:3])
    if not flags & TRACKED:
        position = np.full(3, math.nan)
    return identity, Body(position, np.array(numbers[3:]))


class NatNetClient(FrameReceiver):
    """Receives the frames of a NatNet server."""

    def __init__(
        self,
        server: str,
        port: int = 0,
        host: str = "127.0.0.1",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """server: its address; port: its command port (0: 1510); host: that of this computer."""
        self._address = (server, port or COMMAND_PORT)
        about = f"NatNet server {server}:{self._address[1]}"
        self._command = listen(host, 0)
        try:
            self.server = read_server(self._ask(CONNECT, SERVERINFO, about))
            if not 3 <= self.server.version[0] <= 4:
                raise InputError(
                    f"{about}: speaks NatNet {self.server.version[0]}.{self.server.version[1]}, "
                    "expected version 3 or 4"
                )
            self._names = read_bodies(
                self._ask(REQUEST_MODELDEF, MODELDEF, about), self.server.version
            )
            data = self._command
            if self.server.group:
                data = listen(host, self.server.data_port, self.server.group)
        except DAMAGED as error:
            self._command.close()
            if isinstance(error, InputError):
                raise
            raise InputError(f"{about}: answer cannot be read ({error})") from error
        super().__init__(data, self._decode_message, about, clock)
        self._keeper = threading.Thread(target=self._keep_alive, daemon=True)
        self._keeper.start()

    def _ask(self, request: int, answer: int, about: str) -> bytes:
        """The payload of the answer to a request."""
        body = b"" if request != CONNECT else b"Ping".ljust(NAME_BYTES, b"\0") + bytes(8)
        self._command.settimeout(ANSWER_S)
        for _ in range(TRIES):
            try:
                self._command.sendto(struct.pack("<HH", request, len(body)) + body, self._address)
                until = time.monotonic() + ANSWER_S
                while time.monotonic() < until:
                    packet = self._command.recv(PACKET)
                    kind, size = struct.unpack_from("<HH", packet)
                    if kind == answer:
                        return packet[4 : 4 + size]
            except (TimeoutError, ConnectionRefusedError, struct.error):
                continue
            except OSError as error:
                raise InputError(f"{about}: {error.strerror or error}") from None
        raise InputError(
            f"{about}: does not answer; is Motive running there, streaming, and not blocked?"
        )

    def _decode_message(self, packet: bytes) -> Frame | None:
        kind, size = Cursor(packet).take("HH")
        payload = packet[4 : 4 + size]
        if kind == MODELDEF:
            self._names = read_bodies(payload, self.server.version)
        if kind != FRAMEOFDATA:
            return None
        return read_frame(payload, self.server.version, self._names, self.server.clock_Hz)

    def _keep_alive(self) -> None:
        while not self._over.wait(KEEP_ALIVE_S):
            try:
                self._command.sendto(struct.pack("<HH", KEEPALIVE, 0), self._address)
            except OSError:
                return

    def close(self) -> None:
        """Stop receiving."""
        super().close()
        self._command.close()
