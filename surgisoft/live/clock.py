"""The clock of a closed loop: it keeps a fixed period, and measures how well it was kept."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

Pace = Literal["real", "simulated", "rig"]
"""Who keeps the time: this computer's clock; nobody, as fast as possible; or the rig, whose `read`
returns with the next sample."""
SPIN_S = 5e-4
"""Last part of a wait that is spent looking at the clock instead of sleeping [s]."""
MISSED = 1.5
"""An interval of more periods than this counts as an overrun where the rig keeps the time."""
FASTER = 0.5
"""Mean interval between samples, in periods. If it is shorter, the rig that sets the pace does not
run on this computer's clock, as a simulation does not, and its overruns say nothing."""
NAMED = 5
"""Number of overruns whose time is printed."""


@dataclass(frozen=True)
class Timing:
    """How a loop kept its period."""

    pace: Pace
    """Who kept the time."""
    period_s: float
    """The wanted period [s]."""
    ticks: int
    """Number of periods."""
    jitter_s: float
    """Standard deviation of the interval from sample to sample [s]; nan where nobody kept time."""
    interval_99_s: float
    """99 % quantile of the interval's distance from the period [s]."""
    interval_worst_s: float
    """Largest distance of an interval from the period [s]."""
    busy_s: float
    """Mean time in a period that the loop worked [s]: policy, model, log, view, simulated rig."""
    busy_99_s: float
    """99 % quantile of that time [s]."""
    busy_worst_s: float
    """Largest time that the loop worked in a period [s]."""
    overruns: int
    """Periods whose work was not done in time; where the rig keeps the time, samples that came
    more than half a period late."""
    overruns_waiting: int = 0
    """Overruns in which the loop computed for less than a period: it waited for the processor, for
    memory or for the rig."""
    overruns_s: tuple[float, ...] = ()
    """When the overruns were, from the first period on [s]."""
    interval_s: float = float("nan")
    """Mean interval from sample to sample [s]; nan where nobody kept time."""

    @property
    def in_another_time(self) -> bool:
        """Whether the rig keeps the time, and its samples come much faster than it states."""
        return self.pace == "rig" and self.interval_s < FASTER * self.period_s

    @property
    def sentence(self) -> str:
        """The timing in words."""
        work = (
            f"work in a period {1e3 * self.busy_s:.2f} ms (99 %: {1e3 * self.busy_99_s:.2f} ms, "
            f"worst {1e3 * self.busy_worst_s:.2f} ms)"
        )
        if self.pace == "simulated":
            return f"{self.ticks:,} periods of {1e3 * self.period_s:g} ms, simulated clock; {work}"
        if self.in_another_time:
            return (
                f"{self.ticks:,} periods of {1e3 * self.period_s:g} ms, which the rig completed in "
                f"{1e3 * self.interval_s:.2f} ms each: it runs on a clock of its own, as a "
                f"simulation does (docs/rigs.md#a-simulation-of-your-own); {work}"
            )
        return (
            f"{self.ticks:,} periods of {1e3 * self.period_s:g} ms; jitter "
            f"{1e3 * self.jitter_s:.3f} ms (99 %: {1e3 * self.interval_99_s:.3f} ms, worst "
            f"{1e3 * self.interval_worst_s:.3f} ms); {work}; {self.overruns} overruns{self._causes}"
        )

    @property
    def _causes(self) -> str:
        """When and why the period was not kept, in words."""
        if not self.overruns:
            return ""
        when = ", ".join(f"{at:.1f}" for at in self.overruns_s[:NAMED])
        more = ", ..." if self.overruns > NAMED else ""
        own = self.overruns - self.overruns_waiting
        return (
            f" (at {when}{more} s; in {own} the loop's own work took longer than the period, in "
            f"{self.overruns_waiting} the loop waited: for the processor, memory or the rig)"
        )


@dataclass(eq=False)
class Clock:
    """Keeps the period of a loop that calls `tick` once a period, after the sample has come."""

    period_s: float
    """The wanted period [s]."""
    pace: Pace = "real"
    """Who keeps the time."""
    now: Callable[[], float] = time.perf_counter
    """Reads the time [s]."""
    sleep: Callable[[float], None] = time.sleep
    """Waits for a time [s]."""
    computed: Callable[[], float] = time.thread_time
    """Reads the processor time of the thread that calls `tick` [s]."""
    overruns: int = 0
    """Periods that were not kept so far."""
    _waiting: int = 0
    _overruns_s: list[float] = field(default_factory=list)
    _began: float | None = None
    _due: float | None = None
    _last: float | None = None
    _computed: float = 0.0
    _intervals: list[float] = field(default_factory=list)
    _busy: list[float] = field(default_factory=list)

    def pause(self) -> None:
        """The loop rests: the next tick begins a new grid of periods."""
        self._due = self._last = None

    def tick(self) -> None:
        """Wait until the period is over; the work of the period is done."""
        came = self.now()
        if self._due is None or self._last is None:
            self._due = self._last = came
            self._began = came if self._began is None else self._began
            self._computed = self.computed()
            return
        computed = self.computed() - self._computed
        self._busy.append(came - self._last)
        self._due += self.period_s
        if self.pace == "real":
            if came > self._due:
                self._overrun(computed)
                # Later periods keep their grid where this one can be made up for.
                self._due = max(self._due, came - self.period_s)
            self._wait(self._due)
        there = self.now()
        interval = there - self._last
        if self.pace == "rig" and interval > MISSED * self.period_s:
            self._overrun(computed)
        self._intervals.append(interval)
        self._last, self._computed = there, self.computed()

    def _overrun(self, computed_s: float) -> None:
        """Count a period that was not kept, and note when it began."""
        assert self._last is not None
        assert self._began is not None
        self.overruns += 1
        self._waiting += computed_s < self.period_s
        self._overruns_s.append(self._last - self._began)

    def _wait(self, due: float) -> None:
        left = due - self.now()
        if left > SPIN_S:
            self.sleep(left - SPIN_S)
        while self.now() < due:
            pass

    def timing(self) -> Timing:
        """The statistics so far."""
        kept = self.pace != "simulated" and len(self._intervals) > 0
        off = np.abs(np.array(self._intervals) - self.period_s) if kept else np.full(1, np.nan)
        busy = np.array(self._busy) if self._busy else np.full(1, np.nan)
        found = Timing(
            self.pace,
            self.period_s,
            len(self._busy),
            float(np.std(self._intervals)) if kept else float("nan"),
            float(np.quantile(off, 0.99)),
            float(off.max()),
            float(busy.mean()),
            float(np.quantile(busy, 0.99)),
            float(busy.max()),
            self.overruns,
            self._waiting,
            tuple(self._overruns_s),
            float(np.mean(self._intervals)) if kept else float("nan"),
        )
        if found.in_another_time:
            return replace(found, overruns=0, overruns_waiting=0, overruns_s=())
        return found
