"""Progress of long work on standard error: a bar in a terminal, occasional lines elsewhere."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta

from surgisoft.progress import Progress

NOTEBOOK = "JPY_PARENT_PID"
"""Environment variable of what a cell of a notebook starts: Jupyter sets it for its kernels."""
LINE_EVERY_S = 30.0
"""Time between two lines where there is no terminal, s."""
LEAST_SHARE = 0.01
"""Share of the work from which its rate is extrapolated. The first steps of a first run are mostly
compilation: at 0.04 % of the demonstration, the estimate was four days for work of five minutes."""
HOURS_FROM_S = 7200.0
"""Remaining time from which it is given in hours, s."""


@contextlib.contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Show a bar with the rate, the time left and the end; yields a function of
    (done, total, note)."""
    from surgisoft.cli import work_begins

    work_begins()
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress

    console = Console(stderr=True)
    # Notebooks force colours into a pipe, and run `!command` in a pseudo-terminal.
    terminal = console.is_terminal and sys.stderr.isatty() and NOTEBOOK not in os.environ
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[pace]}"),
        TextColumn("{task.fields[note]}"),
    )
    # Where there is no terminal, a disabled bar of rich 13 still ends with an empty line.
    bar = RichProgress(*columns, console=console, transient=True) if terminal else None
    with bar or contextlib.nullcontext():
        task = bar.add_task(title, total=None, note="", pace="") if bar is not None else None
        last, paced = time.monotonic(), Pace()

        def report(done: float, total: float, note: str = "") -> None:
            nonlocal last
            pace = paced(done, total)
            if bar is not None and task is not None:
                bar.update(task, completed=done, total=total, note=note, pace=pace)
            elif time.monotonic() - last > LINE_EVERY_S:
                last = time.monotonic()
                share = f"{done / total:.0%}" if total else ""
                parts = ", ".join(part for part in (share, note, pace) if part)
                print(f"surgisoft: {title}: {parts}", file=sys.stderr, flush=True)

        yield report


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
