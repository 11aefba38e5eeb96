"""Progress of long work on standard error: a bar in a terminal, occasional lines elsewhere."""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta

NOTEBOOK = "JPY_PARENT_PID"
"""Environment variable of what a cell of a notebook starts: Jupyter sets it for its kernels."""
LINE_EVERY_S = 30.0
"""Time between two lines where there is no terminal, s."""
SHORTEST_WAIT_S = 1.0
"""Shortest time between two looks at whether a line is due, s."""
LEAST_SHARE = 0.01
"""Share of the work from which its rate is extrapolated. The first steps of a first run are mostly
compilation: at 0.04 % of the demonstration, the estimate was four days for work of five minutes."""
HOURS_FROM_S = 7200.0
"""Remaining time from which it is given in hours, s."""


class Report:
    """Function of (done, total, note) that shows how far work is: a `surgisoft.progress.Progress`.

    Work that reports nothing for long is told again, so that it is seen to go on.
    """

    def __init__(self, title: str, draw: Callable[[float, float, str, str], None] | None):
        """draw: shows done, total, note and pace in a terminal; None: lines on standard error."""
        self._title, self._draw, self._pace = title, draw, Pace()
        self._begin = self._told = time.monotonic()
        self._present: tuple[float, float, str, bool] | None = None
        self._lock = threading.Lock()

    def __call__(self, done: float, total: float, note: str = "") -> None:
        """Report `done` of `total`, from which the end of the work is extrapolated."""
        self._report(done, total, note, True)

    def step(self, done: float, total: float, note: str = "") -> None:
        """Report the present one of steps that take unlike times, which tell no end."""
        self._report(done, total, note, False)

    def _report(self, done: float, total: float, note: str, even: bool) -> None:
        with self._lock:
            self._present = (done, total, note, even)
            pace = self._pace(done, total) if even else ""
            if self._draw is not None:
                self._draw(done, total, note, pace)
            elif time.monotonic() - self._told > LINE_EVERY_S:
                self._told = time.monotonic()
                self._tell(pace if even else self._passed)

    @property
    def _passed(self) -> str:
        return f"{self._told - self._begin:.0f} s so far"

    def _tell(self, time_told: str) -> None:
        assert self._present is not None
        done, total, note, even = self._present
        share = f"{done / total:.0%}" if total and even else ""
        parts = ", ".join(part for part in (share, note, time_told) if part)
        print(f"surgisoft: {self._title}: {parts}", file=sys.stderr, flush=True)

    def repeat(self, ended: threading.Event) -> None:
        """Tell the present state every `LINE_EVERY_S` in which nothing was reported, to the end."""
        while not ended.wait(max(SHORTEST_WAIT_S, LINE_EVERY_S + self._told - time.monotonic())):
            with self._lock:
                if time.monotonic() - self._told >= LINE_EVERY_S:
                    self._present = self._present or (0.0, 0.0, "", False)
                    done, total, _, even = self._present
                    self._told = time.monotonic()
                    self._tell((even and self._pace(done, total)) or self._passed)


@contextlib.contextmanager
def progress(title: str) -> Iterator[Report]:
    """Show a bar with the rate, the time left and the end; yields the function that reports."""
    from surgisoft.cli import work_begins

    work_begins()
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress

    console = Console(stderr=True)
    # Notebooks force colours into a pipe, and run `!command` in a pseudo-terminal.
    terminal = console.is_terminal and sys.stderr.isatty() and NOTEBOOK not in os.environ
    # Where there is no terminal, a disabled bar of rich 13 still ends with an empty line.
    if not terminal:
        report, ended = Report(title, None), threading.Event()
        teller = threading.Thread(target=report.repeat, args=(ended,), daemon=True)
        teller.start()
        try:
            yield report
        finally:
            ended.set()
            teller.join()
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[pace]}"),
        TextColumn("{task.fields[note]}"),
    )
    with RichProgress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None, note="", pace="")

        def draw(done: float, total: float, note: str, pace: str) -> None:
            bar.update(task, completed=done, total=total, note=note, pace=pace)

        yield Report(title, draw)


class Pace:
    """Rate, remaining time and end of work, from its mean rate so far.

    Starts again where less is done than before, because another part of the work has begun.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        now: Callable[[], datetime] = datetime.now,
    ):
        self._clock, self._now = clock, now
        self._began, self._first, self._last = 0.0, 0.0, float("inf")

    def __call__(self, done: float, total: float) -> str:
        """Text such as `12 %/min, 3 min left, ends 14:32`; empty before an estimate is possible."""
        if done < self._last:
            self._began, self._first = self._clock(), done
        self._last = done
        passed = self._clock() - self._began
        if not self._first + LEAST_SHARE * total <= done < total or passed <= 0.0:
            return ""
        rate = (done - self._first) / passed  # of the work, per second
        seconds = (total - done) / rate
        per_minute = 6000.0 * rate / total
        pace = f"{per_minute / 60.0:.2g} %/s" if per_minute >= 60.0 else f"{per_minute:.2g} %/min"
        left = f"{seconds:.0f} s left"
        if seconds > 90.0:
            left = f"{seconds / 60.0:.0f} min left"
        if seconds >= HOURS_FROM_S:
            left = f"{seconds / 3600.0:.0f} h left"
        end = self._now() + timedelta(seconds=seconds)
        day = f"{end:%Y-%m-%d} " if end.date() != self._now().date() else ""
        return f"{pace}, {left}, ends {day}{end:%H:%M}"
