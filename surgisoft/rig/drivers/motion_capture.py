"""Frames of a motion capture system over UDP: OptiTrack's NatNet, and JSON of any other system.

The vendor-neutral stream is one datagram a frame, a JSON object:

    {"frame": 1042, "t": 5.21, "unit": "mm",
     "points": {"tip": [x, y, z], "k3": null},
     "bodies": {"base": {"position": [x, y, z], "rotation": [qx, qy, qz, qw], "valid": true}}}

`frame` counts frames, `t` is the time of exposure on the sender's clock [s], `unit` one of mm, cm
and m (default mm). A point that is not seen is null or left out; a body that is not tracked has
`valid: false`, or is null; a position or an orientation that is not known is null.
"""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from surgisoft.errors import InputError
from surgisoft.rig.drivers.clock import ClockMap

MM_PER = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
"""Millimetres in each unit of length."""
KEPT = 4096
"""Frames that wait to be read."""
STILL = (0.0, 0.0, 0.0, 1.0)
"""Quaternion of a body whose axes are those of the cameras' frame."""
PACKET = 65536
"""Largest datagram [bytes]."""
DAMAGED = (ValueError, IndexError, OverflowError, RecursionError)
"""What decoders raise for a datagram that is no whole message; receivers pass over it."""


@dataclass(frozen=True, eq=False)
class Body:
    """Pose of a rigid body."""

    position_mm: np.ndarray
    """(3,) position, frame of the cameras [mm]; NaN where it is not tracked."""
    rotation: np.ndarray
    """(4,) unit quaternion x, y, z, w from the body's axes to the cameras' frame; NaN where it is
    not known."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of the cameras."""

    number: int
    """Its number, as the sender counts."""
    t_s: float
    """Time of exposure on the sender's clock [s]."""
    points: dict[str, np.ndarray]
    """Name of a marker -> (3,) position, frame of the cameras [mm]."""
    bodies: dict[str, Body]
    """Name of a rigid body -> its pose."""


class Decoder(Protocol):
    """Makes frames of datagrams."""

    def __call__(self, packet: bytes) -> Frame | None:
        """The frame of a datagram; None for another message. Raises ValueError for a bad one."""


def decode_json(packet: bytes) -> Frame | None:
    """The frame of a datagram of the JSON stream; raises ValueError for what is none."""
    content = json.loads(packet)
    if not isinstance(content, dict):
        raise ValueError("no JSON object")
    try:
        scale = MM_PER[content.get("unit", "mm")]
        points = {
            str(name): scale * _numbers(at, 3) for name, at in content.get("points", {}).items()
        }
        bodies = {str(name): _body(b, scale) for name, b in content.get("bodies", {}).items()}
        frame = Frame(int(content["frame"]), float(content["t"]), points, bodies)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"not a whole frame ({error})") from error
    if any(p.shape != (3,) for p in points.values()) or not math.isfinite(frame.t_s):
        raise ValueError("a point has not three coordinates, or the time is not finite")
    if any(b.position_mm.shape != (3,) or b.rotation.shape != (4,) for b in bodies.values()):
        raise ValueError("a body has not three coordinates and four of a quaternion")
    return frame


def _body(content: dict | None, scale: float) -> Body:
    """The pose in a body's object; scale: mm in its unit of length. None: it is not tracked."""
    if content is None or not content.get("valid", True):
        return Body(_numbers(None, 3), _numbers(None, 4))
    return Body(
        scale * _numbers(content["position"], 3), _numbers(content.get("rotation", STILL), 4)
    )


def _numbers(values: list | None, count: int) -> np.ndarray:
    """Values as float64; None: (count,) NaN."""
    return np.full(count, math.nan) if values is None else np.array(values, np.float64)


def encode_json(frame: Frame) -> bytes:
    """A datagram of the JSON stream, in mm."""

    def plain(values: np.ndarray) -> list[float] | None:
        return [round(float(x), 5) for x in values] if np.isfinite(values).all() else None

    content = {
        "frame": frame.number,
        "t": round(frame.t_s, 6),
        "unit": "mm",
        "points": {name: plain(at) for name, at in frame.points.items()},
        "bodies": {
            name: {
                "position": plain(body.position_mm) or [0.0, 0.0, 0.0],
                "rotation": plain(body.rotation),
                "valid": bool(np.isfinite(body.position_mm).all()),
            }
            for name, body in frame.bodies.items()
        },
    }
    return json.dumps(content, separators=(",", ":")).encode()


class FrameReceiver:
    """Receives frames on a UDP socket in a thread."""

    def __init__(
        self,
        listening: socket.socket,
        decode: Decoder,
        about: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """about: what messages call the stream. clock: seconds of the computer, for `clock_map`."""
        self.about, self._socket, self._decode, self._clock = about, listening, decode, clock
        self.clock_map = ClockMap()
        self.damaged = 0
        """Datagrams that were no frame so far."""
        self.dropped = 0
        """Frames that are missing between those that came, by their numbers."""
        self.heard_s = time.monotonic()
        """When the last frame came, by `time.monotonic` [s]."""
        self.why_damaged = ""
        self._frames: deque[Frame] = deque(maxlen=KEPT)
        self._last: Frame | None = None
        self._news = threading.Condition()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def first(self, timeout_s: float) -> Frame:
        """Wait for a frame; raises InputError where none comes."""
        with self._news:
            self._news.wait_for(lambda: self._last is not None, timeout_s)
        if self._last is None:
            damaged = f"; {self.damaged} other datagrams came" if self.damaged else ""
            raise InputError(
                f"{self.about}: no frame came in {timeout_s:g} s{damaged}; is the motion capture "
                "system streaming to this computer and this port?"
            )
        return self._last

    def next_from(self, t_s: float, timeout_s: float) -> Frame | None:
        """The first frame not before a time of the sender's clock [s]; None where none comes.

        Earlier frames are dropped. timeout_s: computer's time to wait for it.
        """
        with self._news:
            self._news.wait_for(lambda: self._has(t_s), timeout_s)
            while self._frames and self._frames[0].t_s < t_s:
                self._frames.popleft()
            return self._frames.popleft() if self._frames else None

    def put_back(self, frame: Frame) -> None:
        """Let `next_from` give a frame once more."""
        with self._news:
            self._frames.appendleft(frame)

    @property
    def newest_s(self) -> float:
        """Time of the newest frame on the sender's clock [s]; nan before the first."""
        return self._last.t_s if self._last else math.nan

    def close(self) -> None:
        """Stop receiving."""
        self._over.set()
        self._thread.join(timeout=1.0)
        self._socket.close()

    def _has(self, t_s: float) -> bool:
        return bool(self._frames) and self._frames[-1].t_s >= t_s

    def _receive(self) -> None:
        self._socket.settimeout(0.1)
        while not self._over.is_set():
            try:
                packet = self._socket.recv(PACKET)
            except TimeoutError:
                continue
            except OSError:
                return
            now = self._clock()
            try:
                frame = self._decode(packet)
            except DAMAGED as error:
                self.damaged += 1
                self.why_damaged = str(error)
                continue
            if frame is not None:
                self._take_in(frame, now)

    def _take_in(self, frame: Frame, now: float) -> None:
        with self._news:
            last = self._last
            if last is not None and frame.number <= last.number and frame.t_s <= last.t_s:
                return  # late or twice
            if last is not None and frame.number > last.number + 1:
                self.dropped += frame.number - last.number - 1
            self.clock_map.add(frame.t_s, now)
            self.heard_s, self._last = time.monotonic(), frame
            self._frames.append(frame)
            self._news.notify_all()


def listen(host: str, port: int, group: str = "") -> socket.socket:
    """A UDP socket; group: multicast group to join, empty for unicast. Raises InputError."""
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        if group:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            found.bind(("", port))
            member = socket.inet_aton(group) + socket.inet_aton(host)
            found.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        else:
            found.bind((host, port))
    except (OSError, OverflowError) as error:
        found.close()
        raise InputError(
            f"motion capture: cannot listen on {host}:{port} ({getattr(error, 'strerror', error)})"
        ) from None
    return found
