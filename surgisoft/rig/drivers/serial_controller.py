"""Driver of a pressure controller on a serial line that speaks `line_protocol`."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from surgisoft.errors import InputError
from surgisoft.rig.drivers.clock import ClockMap
from surgisoft.rig.drivers.line_protocol import LONGEST, Data, Info, line, words_of

ANSWER_S = 0.5
"""Time in which a controller answers HELLO or WATCH [s]."""
TRIES = 6
"""Number of HELLOs, and of WATCHes, before the driver gives up: a board that restarts when its port
is opened needs about two seconds."""
KEPT = 256
"""Reports that are kept for interpolation."""


def open_port(port: str, baud: int) -> Any:
    """A serial port; raises InputError with the ports that are there."""
    try:
        import serial
    except ImportError:
        raise InputError(
            "a serial pressure controller needs pyserial, which is not installed: "
            "pip install 'surgisoft[serial]'"
        ) from None
    try:
        return serial.serial_for_url(port, baud, timeout=0.05, write_timeout=0.5, exclusive=True)
    except (serial.SerialException, ValueError, OSError) as error:
        from serial.tools.list_ports import comports

        there = ", ".join(sorted(p.device for p in comports())) or "none"
        reason = str(error).split("] ")[-1]
        raise InputError(
            f"serial port '{port}': cannot be opened ({reason}); ports of this computer: {there}"
        ) from None


class SerialController:
    """A pressure controller; a thread receives its reports."""

    def __init__(
        self,
        port: str,
        baud: int = 115200,
        hold_ms: float = 500.0,
        vent_ms: float = 2000.0,
        silent_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open a port and ask what is there.

        hold_ms, vent_ms: the controller's own watchdog. silent_s: longest time without a report.
        clock: seconds of the computer, for
        `clock_map`.
        """
        self.port, self.silent_s, self._clock = port, silent_s, clock
        self.clock_map = ClockMap()
        self.damaged = 0
        """Lines with a wrong CRC so far."""
        self.refused = ""
        """Reason of the last command that the controller refused."""
        self._reports: deque[tuple[float, Data]] = deque(maxlen=KEPT)
        self._heard_s = time.monotonic()
        self._lost = ""
        self._seq = 0
        self._target: np.ndarray | None = None
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._news = threading.Condition()
        self._found: Info | None = None
        self._serial = open_port(port, baud)
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()
        try:
            self.info = self._introduce(hold_ms, vent_ms)
        except InputError:
            self._end()
            raise

    def _introduce(self, hold_ms: float, vent_ms: float) -> Info:
        for _ in range(TRIES):
            self._write("HELLO")
            if self._answered():
                break
        else:
            raise InputError(
                f"serial port '{self.port}': no pressure controller answers (HELLO sent {TRIES} "
                f"times, {self.damaged} damaged lines heard); is it the right port and baud rate?"
            )
        found = None
        for _ in range(TRIES):  # a line or its answer may be damaged on the way
            self._found = None
            self._write(f"WATCH {round(hold_ms)} {round(vent_ms)}")
            found = self._answered()
            if found:
                break
        if found is None or (found.hold_ms, found.vent_ms) != (round(hold_ms), round(vent_ms)):
            got = f"{found.hold_ms} and {found.vent_ms} ms" if found else "no answer"
            raise InputError(
                f"controller on '{self.port}': its watchdog was to hold after {hold_ms:g} ms and "
                f"vent after {vent_ms:g} ms, got {got}; choose times that it allows"
            )
        return found

    def _answered(self) -> Info | None:
        with self._news:
            self._news.wait_for(lambda: self._found is not None or self._lost, ANSWER_S)
        self._check_line()
        return self._found

    def command(self, pressures: np.ndarray) -> None:
        """Send set points (m,) [kPa]; raises InputError where the controller cannot be reached."""
        self.check()
        self._target = np.array(pressures, np.float64)
        self._send_target()

    def keep_alive(self) -> None:
        """Send the last set points again, so that the controller's watchdog stays quiet."""
        self.check()
        if self._target is not None:
            self._send_target()

    def vent(self) -> None:
        """Open every valve now; any thread may call it. It needs no answer."""
        self._target = None
        self._seq += 1
        self._write(f"VENT {self._seq}")

    def arm(self) -> None:
        """Leave the state that the controller's watchdog left behind; the arm stays vented."""
        self._seq += 1
        self._write(f"ARM {self._seq}")

    def close(self) -> None:
        """Vent, wait until the controller reports it, and give the port back."""
        try:
            if not self._over.is_set():
                self.vent()
                until = time.monotonic() + 1.0
                while time.monotonic() < until and not self._is_vented():
                    time.sleep(0.005)
                if not self._is_vented():
                    raise InputError(f"controller on '{self.port}' did not confirm that it vented")
        finally:
            self._end()

    def report(self) -> Data:
        """The last report; raises InputError where the controller is silent or has tripped."""
        self.check()
        return self._reports[-1][1]

    def measured_at(self, host_s: float) -> np.ndarray:
        """(m,) measured pressures [kPa] at a time of the computer's clock [s], interpolated.

        After the last report its values hold.
        """
        self.check()
        reports = list(self._reports)
        times = np.array([1e-3 * d.ms for _, d in reports]) + self.clock_map.offset_s
        values = np.array([d.measured for _, d in reports])
        return np.array([np.interp(host_s, times, column) for column in values.T])

    def target(self) -> np.ndarray:
        """(m,) set points that the controller last reported [kPa]."""
        return np.array(self.report().target)

    def check(self) -> None:
        """Raise InputError where the controller is silent, cut off, or vented by its watchdog."""
        self._check_line()
        silent_s = time.monotonic() - self._heard_s
        if silent_s > self.silent_s:
            raise InputError(
                f"controller on '{self.port}': no report for {silent_s:.1f} s; is its cable in and "
                "its supply on?"
            )
        if not self._reports:
            raise InputError(f"controller on '{self.port}': has not reported yet")
        last = self._reports[-1][1]
        if last.state == "T" and self._target is not None:
            raise InputError(
                f"controller on '{self.port}': its watchdog vented, because no command came for "
                f"{self.info.vent_ms} ms"
            )

    def wait_for_report(self, timeout_s: float = 1.0) -> None:
        """Wait until the controller has reported; raises InputError where it does not."""
        until = time.monotonic() + timeout_s
        while not self._reports and time.monotonic() < until:
            self._check_line()
            time.sleep(0.002)
        self.check()

    def _check_line(self) -> None:
        if self._lost:
            raise InputError(f"controller on '{self.port}': cut off ({self._lost})")

    def _is_vented(self) -> bool:
        self._check_line()
        last = self._reports[-1][1] if self._reports else None
        return last is not None and last.state in ("I", "T") and not any(last.target)

    def _send_target(self) -> None:
        """Send the set points; where another thread has vented meanwhile, there are none."""
        self._seq += 1
        self._write(lambda: self._set_points(self._seq))

    def _set_points(self, seq: int) -> str | None:
        target = self._target
        return None if target is None else f"SET {seq} " + " ".join(f"{x:.3f}" for x in target)

    def _write(self, body: str | Callable[[], str | None]) -> None:
        """Write a line. body: its text, or what gives it once nobody else writes; None: no line."""
        try:
            with self._lock:
                text = body() if callable(body) else body
                if text is not None:
                    self._serial.write(line(text))
        except Exception as error:  # pyserial lets errors of the system through
            self._lost = self._lost or " ".join(str(error).split())
            self._check_line()

    def _receive(self) -> None:
        """Take in lines until the end; runs in a thread."""
        pending = b""
        while not self._over.is_set():
            try:
                pending += self._serial.read(self._serial.in_waiting or 1)
            except Exception as error:  # the cable was cut, or the port closed
                if not self._over.is_set():
                    self._lost = " ".join(str(error).split()) or type(error).__name__
                    with self._news:
                        self._news.notify_all()
                return
            *lines, pending = pending.split(b"\n")
            pending = pending[-LONGEST:]
            for raw in lines:
                self._take_in(raw)

    def _take_in(self, raw: bytes) -> None:
        now, words = self._clock(), words_of(raw, "<")
        if words is None:
            self.damaged += 1
            return
        try:
            if words[0] == "INFO":
                self._found = Info.read(words)
                with self._news:
                    self._news.notify_all()
            elif words[0] == "NAK":
                self.refused = " ".join(words[2:])
            elif self._found is not None:
                found = Data.read(words, self._found.chambers)
                self.clock_map.add(1e-3 * found.ms, now)
                self._reports.append((now, found))
        except ValueError:
            self.damaged += 1
            return
        self._heard_s = time.monotonic()

    def _end(self) -> None:
        self._over.set()
        self._thread.join(timeout=1.0)
        self._serial.close()
