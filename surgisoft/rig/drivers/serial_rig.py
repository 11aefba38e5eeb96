"""The rig of a serial pressure controller and a motion capture system."""

import math
import time
from pathlib import Path
from typing import Annotated

import numpy as np

from surgisoft.errors import InputError
from surgisoft.numbers_in_text import whole_number
from surgisoft.rig.drivers.bench_map import KeyPoints, load_bench_map, map_of
from surgisoft.rig.drivers.motion_capture import FrameReceiver, decode_json, listen
from surgisoft.rig.drivers.natnet import NatNetClient
from surgisoft.rig.drivers.serial_controller import SerialController
from surgisoft.rig.interface import Sample

FIRST_FRAME_S = 3.0
"""Longest time to wait for the first frame [s]."""
LATE = 0.5
"""Share of a period by which a frame may come late before its sample has no key points."""
BEHIND = 2.0
"""Periods that a program may fall behind before samples are skipped."""
KEEP_ALIVE = 0.2
"""Time between two set points that keep the controller's watchdog quiet, as a share of its time to
hold."""
STILL_HIGH_kPa = 3.0
"""Pressure that no chamber may have left after venting and resting [kPa]."""


class SerialRig:
    """A bench with a serial pressure controller and motion capture over the network.

    Time is the clock of the motion capture: a sample is the first frame of its period, with the
    measured pressures of the instant of its exposure, interpolated from the controller's reports.
    Both clocks are mapped to the computer's by their fastest messages.
    """

    unit = "kPa"

    def __init__(
        self,
        port: Annotated[str, "serial port, such as /dev/ttyACM0"],
        mocap: Annotated[
            str, "udp:PORT for the JSON stream, natnet:SERVER[:PORT] for OptiTrack"
        ] = "udp:9763",
        map: Annotated[Path | None, "map file: key points, channels and frame"] = None,  # noqa: A002
        chambers: Annotated[int, "number of chambers; 0: as the controller states"] = 0,
        rate_Hz: Annotated[float, "samples per second; the cameras may be faster"] = 20.0,
        rest_s: Annotated[float, "time to vent and rest before a run [s]"] = 30.0,
        watchdog_ms: Annotated[float, "the controller vents by itself after [ms]"] = 2000.0,
        silent_ms: Annotated[float, "silence of a device that ends the run [ms]"] = 1000.0,
        baud: Annotated[int, "baud rate of the serial port"] = 115200,
        host: Annotated[str, "address of this computer that receives frames"] = "127.0.0.1",
        payload_g: Annotated[float | None, "known mass at the tip [g]"] = None,
        speed: Annotated[float, "speed of the emulator's clock; a real bench has 1"] = 1.0,
    ) -> None:
        if not (0.0 < rate_Hz <= 1000.0 and speed > 0.0 and rest_s >= 0.0 and silent_ms > 0.0):
            raise InputError(
                f"rig 'serial': rate_Hz {rate_Hz:g}, speed {speed:g}, rest_s {rest_s:g} and "
                f"silent_ms {silent_ms:g}, expected positive numbers, rate_Hz at most 1000"
            )
        bench = load_bench_map(map) if map else None
        self._speed, self._rest_s, self._silent_s = speed, rest_s, 1e-3 * silent_ms
        self.period_s = 1.0 / rate_Hz
        self.overruns = 0
        """Samples that were skipped because the program was too late for them."""
        self.lost_frames = 0
        """Samples without a frame of the cameras."""
        self._controller = SerialController(
            port, baud, watchdog_ms / 4.0, watchdog_ms, self._silent_s, self._clock
        )
        try:
            info = self._controller.info
            self._controller.wait_for_report()
            if chambers not in (0, info.chambers):
                raise InputError(
                    f"rig 'serial': the controller on '{port}' has {info.chambers} chambers, "
                    f"expected {chambers}"
                )
            self._frames = open_motion_capture(mocap, host, self._clock)
        except InputError:
            self._controller.close()
            raise
        try:
            first = self._frames.first(FIRST_FRAME_S)
            self._points = KeyPoints(bench or map_of(first))
            self._points.require(first)
            bench = self._points.bench
            self._channels = _channels(bench.channels, info.chambers)
        except InputError:
            self.close()
            raise
        self.chambers = len(self._channels)
        self.key_planes = len(bench.points)
        self.limits = np.tile([info.low_kPa, info.high_kPa], (self.chambers, 1))
        self.arm = bench.arm
        self.payload_g = payload_g if payload_g is not None else bench.payload_g
        self.gravity = None if bench.gravity is None else _unit(np.array(bench.gravity))
        self._began_s = self._due_s = first.t_s
        self._kept_alive_s = 0.0
        self._every_s = 1e-3 * KEEP_ALIVE * info.hold_ms / speed

    def reset(self) -> None:
        """Vent, rest, and check that the pressures are gone."""
        self._controller.vent()
        self.wait(self._rest_s)
        left = self._measured(self._clock())
        high = np.flatnonzero(np.abs(left) > STILL_HIGH_kPa)
        if self._rest_s and len(high):
            raise InputError(
                f"rig 'serial': chamber {high[0] + 1} is still at {left[high[0]]:.1f} kPa after "
                f"venting for {self._rest_s:g} s; is a valve stuck, or rest_s too short?"
            )
        self._skip_to_now()

    def command(self, pressures: np.ndarray) -> None:
        """Set the pressures (m,) [kPa]; each goes to the channel of its chamber."""
        target = np.zeros(self._controller.info.chambers)
        target[self._channels] = pressures
        self._controller.command(target)
        self._kept_alive_s = time.monotonic()

    def wait(self, seconds: float) -> None:
        """Let time [s] of the cameras' clock pass; set points are sent again for the watchdog."""
        until = self._frames.newest_s + seconds
        while (left := until - self._frames.newest_s) > 0.0:
            self._stay_alive()
            self._check_frames()
            time.sleep(min(max(left / self._speed, 1e-3), 0.02, self._every_s))
        self._skip_to_now()

    def read(self) -> Sample:
        """Wait for the frame of the next period, and give it with the pressures of its instant."""
        if self._frames.newest_s > self._due_s + BEHIND * self.period_s:
            self.overruns += int((self._frames.newest_s - self._due_s) / self.period_s)
            self._due_s = self._frames.newest_s
        due = self._due_s
        waited = time.monotonic()
        longest_s = (1.0 + LATE) * self.period_s / self._speed + 0.1
        frame = None
        while frame is None and time.monotonic() - waited < longest_s:
            self._stay_alive()
            frame = self._frames.next_from(due - 0.25 * self.period_s, min(0.02, self._every_s))
        self._check_frames()
        self._controller.check()
        if frame is not None and frame.t_s - due >= self.period_s:  # the frame that is due was lost
            self._frames.put_back(frame)
            frame = None
        if frame is None:
            self.lost_frames += 1
            points, at = np.full((self.key_planes, 3), np.nan), due
        else:
            points, at = self._points(frame), frame.t_s
        self._due_s = due + self.period_s * max(1, round((at - due) / self.period_s) + 1)
        host_s = at + self._frames.clock_map.offset_s
        return Sample(
            t_s=at - self._began_s,
            measured=self._measured(host_s),
            commanded=self._controller.target()[self._channels],
            key_points_mm=points,
        )

    def vent(self) -> None:
        """Open every valve now; any thread may call it."""
        self._controller.vent()

    def close(self) -> None:
        """Vent, wait for the controller's word that it did, and give port and socket back."""
        try:
            self._controller.close()
        finally:
            self._frames.close()

    @property
    def counts(self) -> dict[str, int]:
        """Counts of communication errors so far: name -> number."""
        return {
            "damaged lines": self._controller.damaged,
            "damaged datagrams": self._frames.damaged,
            "dropped frames": self._frames.dropped,
            "samples without a frame": self.lost_frames,
            "late samples skipped": self.overruns,
            "swapped labels": self._points.swaps,
        }

    def _clock(self) -> float:
        return self._speed * time.monotonic()

    def _measured(self, host_s: float) -> np.ndarray:
        return self._controller.measured_at(host_s)[self._channels]

    def _stay_alive(self) -> None:
        self._controller.check()
        if time.monotonic() - self._kept_alive_s > self._every_s:
            self._controller.keep_alive()
            self._kept_alive_s = time.monotonic()

    def _check_frames(self) -> None:
        silent_s = time.monotonic() - self._frames.heard_s
        if silent_s > self._silent_s:
            raise InputError(
                f"{self._frames.about}: no frame for {silent_s:.1f} s; are the cameras running?"
            )

    def _skip_to_now(self) -> None:
        self._due_s = max(self._due_s, self._frames.newest_s + self.period_s)


def open_motion_capture(text: str, host: str, clock) -> FrameReceiver:
    """The motion capture of a text `udp:PORT` or `natnet:SERVER[:PORT]`."""
    kind, _, rest = text.partition(":")
    if kind == "udp" and 0 < (port := whole_number(rest) or 0) < 65536:
        about = f"motion capture on udp:{port}"
        return FrameReceiver(listen(host, port), decode_json, about, clock)
    if kind == "natnet" and rest:
        server, _, given = rest.partition(":")
        port = whole_number(given) or 0
        if not given or 0 < port < 65536:
            return NatNetClient(server, port, host, clock=clock)
    raise InputError(
        f"rig 'serial': option 'mocap' is '{text}', expected udp:PORT or natnet:SERVER[:PORT]"
    )


def _channels(channels: tuple[int, ...], count: int) -> np.ndarray:
    """(m,) channels of the controller from 0, for each chamber."""
    chosen = channels or tuple(range(1, count + 1))
    if len(set(chosen)) != len(chosen) or not all(1 <= c <= count for c in chosen):
        raise InputError(
            f"rig 'serial': the map's channels are {list(chosen)}, expected different numbers from "
            f"1 to {count}, those of the controller"
        )
    return np.array(chosen) - 1


def _unit(direction: np.ndarray) -> np.ndarray:
    return direction / math.sqrt(float(direction @ direction))
