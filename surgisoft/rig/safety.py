"""Safety between a program and real valves: limits, watchdog, emergency stop, venting at the end.

Every real rig runs inside `SafeRig`, whatever drives it: a protocol, a policy, a user's script.

- Limits of pressure and of its rate hold for whatever is commanded: values beyond a limit are
  clipped, a command that is not finite is refused and the last one holds, a jump becomes a ramp.
- A watchdog: where no key point is seen, a pressure sensor is silent, or no valid command comes for
  `hold_ms`, the pressures are held; after `vent_ms` the arm is vented and the run stops. A thread
  vents if the program itself hangs between two calls.
- The emergency stop: the space bar or Esc in the terminal, Ctrl-C, and the signals TERM and HUP.
- However the block `with SafeRig(...)` ends, the rig is vented and its devices are given back.

What no program can do after `kill -9`, a crash of the computer or a cut cable, the device does: a
pressure controller has to vent by itself where no command comes (the line protocol of
`surgisoft.rig.serial_controller` requires it).
"""

from __future__ import annotations

import _thread
import contextlib
import math
import os
import select
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType, TracebackType
from typing import Annotated

import numpy as np

from surgisoft.errors import InputError, Terminated
from surgisoft.rig.interface import Rig, Sample, close, is_simulated, vent, vented
from surgisoft.units import actuation_word

STOP_KEYS = (b" ", b"\x1b")
"""Keys of the emergency stop: the space bar and Esc."""
STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a run vented: Ctrl-C, `kill`, and a closed terminal (Windows has none such)."""
LOCK_S = 0.2
"""Longest time that venting waits for a command that is being sent [s]."""


class RigStopped(InputError):
    """A run on a real rig was stopped by the safety wrapper, and the rig is vented."""


@dataclass(frozen=True)
class Safety:
    """Limits on the way to real valves; each is an option of every real rig."""

    lowest: Annotated[float, "lowest pressure that is sent [unit of the rig]"] = -math.inf
    """Lowest actuation that is sent, beside the rig's own limit [unit]."""
    highest: Annotated[float, "highest pressure that is sent [unit of the rig]"] = math.inf
    """Highest actuation that is sent, beside the rig's own limit [unit]."""
    rate: Annotated[float, "fastest change [unit/s]; 0: the rig's range in a second"] = 0.0
    """Fastest change of a set point [unit/s]; 0: the whole range of the rig in a second."""
    hold_ms: Annotated[float, "hold after so long without key point, pressure or command [ms]"] = (
        500.0
    )
    """Time without key points, pressures or valid commands after which pressures are held [ms]."""
    vent_ms: Annotated[float, "vent after so long without key point, pressure or command [ms]"] = (
        2000.0
    )
    """Time after which the arm is vented and the run stops [ms]."""

    def __post_init__(self):
        if not (math.isfinite(self.rate) and self.rate >= 0.0):
            raise InputError(f"rate is {self.rate}, expected 0 or a number above 0")
        if not 0.0 < self.hold_ms <= self.vent_ms < math.inf:
            raise InputError(
                f"hold_ms is {self.hold_ms:g} and vent_ms is {self.vent_ms:g}, expected "
                "0 < hold_ms <= vent_ms"
            )
        if not self.lowest < self.highest:
            raise InputError(
                f"lowest is {self.lowest:g} and highest is {self.highest:g}, expected "
                "lowest < highest"
            )


class SafeRig:
    """A real rig inside its safety limits; itself a `Rig`, to be used in a `with` block."""

    def __init__(
        self,
        rig: Rig,
        safety: Safety | None = None,
        show: Callable[[str], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Wrap a real rig.

        show: for a dry run; is called with each command that would be sent, and nothing is sent.
        clock: seconds of the computer, for the watchdog.
        """
        self.rig, self.safety, self.show, self._clock = rig, safety or Safety(), show, clock
        self.chambers, self.key_planes, self.unit = rig.chambers, rig.key_planes, rig.unit
        self.period_s, self.arm, self.payload_g = rig.period_s, rig.arm, rig.payload_g
        own = np.asarray(rig.limits, np.float64)
        if own.shape != (rig.chambers, 2) or not np.isfinite(own).all():
            raise InputError(
                f"the rig's limits are {own.tolist()}, expected {rig.chambers} finite pairs of the "
                f"lowest and the highest {actuation_word(self.unit)}"
            )
        self.limits = np.clip(own, self.safety.lowest, self.safety.highest)
        if not (self.limits[:, 0] < self.limits[:, 1]).all():
            raise InputError(
                f"lowest {self.safety.lowest:g} and highest {self.safety.highest:g} {rig.unit} "
                f"leave nothing of the rig's limits {own.min():g} to {own.max():g} {rig.unit}"
            )
        self.rate = self.safety.rate or float(np.ptp(self.limits, axis=1).max())
        self.counts: Counter[str] = Counter()
        """How often a command was clipped, refused (not finite), slowed to a ramp, or held."""
        self._target = self._sent = vented(self.limits)
        self._room = self.rate * self.period_s
        self._stopped = ""
        self._armed = self._waiting = self._signalled = False
        self._lock = threading.Lock()
        self._called = self._clock()
        self._time_s: float | None = None
        self._seen_s = self._commanded_s = 0.0
        self._blind = ""
        self._threads: list[threading.Thread] = []
        self._over = threading.Event()
        self._handlers: dict[int, object] = {}
        self._terminal: list | None = None

    @property
    def gravity(self) -> np.ndarray | None:
        """(3,) unit vector of weight, arm base frame; None where it is unknown."""
        return self.rig.gravity

    @property
    def dry(self) -> bool:
        """Whether commands are shown and not sent."""
        return self.show is not None

    def reset(self) -> None:
        """Vent and rest, see `Rig.reset`; there is no watchdog until the next command."""
        self._check()
        self._armed = False
        self._target = self._sent = vented(self.limits)
        if self.show:
            self.show("vent and rest")
            return
        with self._in_call():
            self.rig.reset()
        self._time_s = None

    def command(self, pressures: np.ndarray) -> None:
        """Set the pressures (m,) [unit] to reach for, within the limits and at most at the rate.

        Values beyond the limits are clipped. Where one is not finite, the last command holds.
        """
        self._check()
        given = np.asarray(pressures, np.float64)
        if given.shape != (self.chambers,):
            raise InputError(
                f"command has shape {given.shape}, expected {self.chambers} "
                f"{actuation_word(self.unit)}s in {self.unit}"
            )
        self._armed = True
        self._called = self._clock()
        now = self._time_s or 0.0
        if not np.isfinite(given).all():
            self.counts["refused"] += 1
            if now - self._commanded_s > 1e-3 * self.safety.vent_ms:
                self._stop(
                    f"no valid command for {now - self._commanded_s:.1f} s, the last was "
                    f"{given.tolist()} {self.unit}"
                )
        elif self._is_blind(self.safety.hold_ms):
            self._commanded_s = now
            self.counts["held"] += 1
        else:
            self._commanded_s = now
            wanted = np.clip(given, *self.limits.T)
            self.counts["clipped"] += bool((wanted != given).any())
            self._target = wanted
            self.counts["ramped"] += bool((np.abs(wanted - self._sent) > self._room + 1e-9).any())
        self._send()

    def wait(self, seconds: float) -> None:
        """Let time [s] pass without a sample; a ramp goes on meanwhile."""
        self._check()
        while seconds > 1e-9 and (self._target != self._sent).any():
            part = min(seconds, self.period_s)
            self._pass(part)
            self._send()
            seconds -= part
        if seconds > 1e-9:
            self._pass(seconds)

    def read(self) -> Sample:
        """Wait for one period, then return a sample, see `Rig.read`; a ramp goes on."""
        self._check()
        with self._in_call():
            sample = self.rig.read()
        self._room = self.rate * self.period_s
        self._judge(sample)
        if (self._target != self._sent).any():
            self._send()
        return sample

    def vent(self) -> None:
        """Vent at once; may be called from another thread where the rig's own `vent` may."""
        self._armed = False
        self._target = self._sent = vented(self.limits)
        if not self.dry:
            vent(self.rig)

    def close(self) -> None:
        """Vent, and give the devices back."""
        self._over.set()
        self._armed = False
        self._target = self._sent = vented(self.limits)
        if self.dry:
            own = getattr(self.rig, "close", None)
            if callable(own):
                own()
        else:
            close(self.rig)

    def stop(self, reason: str) -> None:
        """The emergency stop: vent now, and let the run end with this reason. Any thread."""
        if self._over.is_set() or self._stopped:
            return
        self._stopped = reason
        if not self.dry and callable(getattr(self.rig, "vent", None)):
            ours = self._lock.acquire(timeout=LOCK_S)  # a command that hangs must not hold it up
            with contextlib.suppress(Exception):  # the end of the run tries again, and reports
                self.rig.vent()  # type: ignore[attr-defined]  # asked above
            if ours:
                self._lock.release()
        if self._handlers and threading.current_thread() is not threading.main_thread():
            if sys.platform == "win32":
                _thread.interrupt_main()
            else:  # a signal also ends a sleep of the program
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    def __enter__(self) -> SafeRig:
        # a rig may be driven in one block after another
        self._over.clear()
        self._signalled, self._called = False, self._clock()
        if threading.current_thread() is threading.main_thread():
            for number in STOP_SIGNALS:
                self._handlers[number] = signal.signal(number, self._on_signal)
            self._listen()
        self._start(self._watch)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        failed = ""
        try:
            for number in self._handlers:  # a second Ctrl-C must not end the venting
                signal.signal(number, signal.SIG_IGN)
        finally:
            try:
                self.close()
            except Exception as unreached:  # whatever a driver raises, the first error counts
                failed = " ".join(str(unreached).split())
        self._unlisten()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # as Python gave it
        self._handlers = {}
        for thread in self._threads:
            thread.join(timeout=1.0)
        how = "nothing was sent (dry run)" if self.dry else "the rig is vented"
        if failed:
            how = f"the rig could not be vented from here ({failed}): its own watchdog has to"
        if self._stopped:
            raise RigStopped(f"{self._stopped}; {how}") from None
        if failed and (error is None or isinstance(error, InputError)):
            first = f"{error}; " if error else ""
            raise RigStopped(first + how) from None

    def _start(self, task: Callable[[], None]) -> None:
        thread = threading.Thread(target=task, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._signalled:  # the first one ends the run
            return
        self._signalled = True
        if self._stopped:
            raise RigStopped(self._stopped)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise Terminated(number)

    def _listen(self) -> None:
        """Let the stop keys work, where the program has a terminal."""
        try:
            import termios
            import tty
        except ImportError:  # Windows: Ctrl-C stops, single keys do not
            return
        try:
            if not sys.stdin.isatty() or os.tcgetpgrp(0) != os.getpgrp():
                return
            self._terminal = termios.tcgetattr(0)
            tty.setcbreak(0, termios.TCSANOW)
        except (OSError, ValueError, termios.error):  # no terminal, or in the background
            return
        self._start(self._hear)

    def _unlisten(self) -> None:
        if self._terminal is not None:
            import termios

            termios.tcsetattr(0, termios.TCSANOW, self._terminal)
            self._terminal = None

    def _hear(self) -> None:
        while not self._over.is_set():
            if select.select([0], [], [], 0.05)[0]:
                key = os.read(0, 1)
                if not key:
                    return
                if key in STOP_KEYS:
                    self.stop("emergency stop by a key")
                    return

    def _watch(self) -> None:
        """Vent where the program hangs between two calls."""
        while not self._over.wait(5e-5 * self.safety.vent_ms):
            silent_s = self._clock() - self._called
            if self._armed and not self._waiting and silent_s > 1e-3 * self.safety.vent_ms:
                self.stop(f"no command for {silent_s:.1f} s")
                return

    @contextlib.contextmanager
    def _in_call(self) -> Iterator[None]:
        self._waiting = True
        try:
            yield
        finally:
            self._called = self._clock()
            self._waiting = False
        self._check()

    def _check(self) -> None:
        if self._stopped:
            raise RigStopped(self._stopped)

    def _stop(self, reason: str) -> None:
        self.stop(reason)
        raise RigStopped(reason)

    def _pass(self, seconds: float) -> None:
        """Let a time [s] pass, in which set points may change by as much as the rate allows."""
        if not self.dry:
            with self._in_call():
                self.rig.wait(seconds)
        if self._time_s is not None:
            self._time_s += seconds
            self._seen_s += seconds  # nobody looked
            self._commanded_s += seconds
        self._room = self.rate * min(seconds, self.period_s)

    def _send(self) -> None:
        step = np.clip(self._target - self._sent, -self._room, self._room)
        self._room = max(0.0, self._room - float(np.abs(step).max()))
        self._sent = np.clip(self._sent + step, *self.limits.T)
        if np.abs(self._target - self._sent).max() < 1e-9:
            self._sent = self._target.copy()
        if self.show:
            self.show("send " + " ".join(f"{x:8.3f}" for x in self._sent) + f" {self.unit}")
            return
        with self._lock:
            self._check()
            self.rig.command(self._sent.copy())

    def _judge(self, sample: Sample) -> None:
        """Count the time without key points or pressures; stop where it is too long."""
        now = float(sample.t_s)
        if not math.isfinite(now) or (self._time_s is not None and now <= self._time_s - 1e-9):
            self._stop(f"the clock of the samples went from {self._time_s} s to {now} s")
        if self._time_s is None:
            self._seen_s = self._commanded_s = now
        self._time_s = now
        silent = ~np.isfinite(np.asarray(sample.measured, np.float64))
        what = actuation_word(self.unit)
        if np.shape(sample.measured) != (self.chambers,):
            self._stop(f"a sample has {np.size(sample.measured)} {what}s, expected {self.chambers}")
        if np.shape(sample.key_points_mm) != (self.key_planes, 3):
            self._stop(
                f"a sample has key points of shape {np.shape(sample.key_points_mm)}, expected "
                f"{(self.key_planes, 3)}"
            )
        if not np.isfinite(sample.key_points_mm).any():
            self._blind = "no key point was seen"
        elif silent.any():
            self._blind = f"the {what} sensor of chamber {int(silent.argmax()) + 1} was silent"
        else:
            self._seen_s = now
        if self._is_blind(self.safety.vent_ms):
            self._stop(f"{self._blind} for {now - self._seen_s:.1f} s")

    def _is_blind(self, limit_ms: float) -> bool:
        return self._time_s is not None and self._time_s - self._seen_s > 1e-3 * limit_ms


@contextlib.contextmanager
def guarded(rig: Rig) -> Iterator[Rig]:
    """A block in which a rig is driven: a real one is inside `SafeRig`, and vented at the end."""
    if is_simulated(rig):
        yield rig
        return
    with rig if isinstance(rig, SafeRig) else SafeRig(rig) as safe:
        yield safe
