"""Progress of long work on standard error: a bar in a terminal, occasional lines elsewhere."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

from surgisoft.progress import Progress

LINE_EVERY_S = 30.0
"""Time between two lines where there is no terminal, s."""


@contextlib.contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Show a progress bar with the time left; yields a function of (done, total, note)."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as RichProgress

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with RichProgress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(title, total=None, note="")
        last, left = time.monotonic(), TimeLeft()

        def report(done: float, total: float, note: str = "") -> None:
            nonlocal last
            bar.update(task, completed=done, total=total, note=note)
            remaining = left(done, total)
            if not console.is_terminal and time.monotonic() - last > LINE_EVERY_S:
                last = time.monotonic()
                share = f"{done / total:.0%}" if total else ""
                parts = ", ".join(part for part in (share, note, remaining) if part)
                print(f"surgisoft: {title}: {parts}", file=sys.stderr, flush=True)

        yield report


class TimeLeft:
    """Estimate of the remaining time of work, from its mean pace so far.

    Starts again where less is done than before, because another part of the work has begun.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._began, self._first, self._last = 0.0, 0.0, float("inf")

    def __call__(self, done: float, total: float) -> str:
        """Text such as `3 min left`; empty where no estimate is possible yet."""
        if done < self._last:
            self._began, self._first = self._clock(), done
        self._last = done
        if not self._first < done < total:
            return ""
        seconds = (self._clock() - self._began) / (done - self._first) * (total - done)
        return f"{seconds / 60.0:.0f} min left" if seconds > 90.0 else f"{seconds:.0f} s left"
