"""Progress of long work on standard error: a bar in a terminal, now and then a line elsewhere."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

LINE_EVERY_S = 30.0
"""Time between two lines where there is no terminal, s."""


@contextlib.contextmanager
def progress(title: str) -> Iterator[Callable[[float, float, str], None]]:
    """A bar with the time left; the answer is called with (done, total, note)."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as TimeLeft

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeLeft(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(title, total=None, note="")
        last = time.monotonic()

        def report(done: float, total: float, note: str = "") -> None:
            nonlocal last
            bar.update(task, completed=done, total=total, note=note)
            if not console.is_terminal and time.monotonic() - last > LINE_EVERY_S:
                last = time.monotonic()
                share = f"{done / total:.0%}" if total else ""
                print(f"surgisoft: {title} {share} {note}", file=sys.stderr, flush=True)

        yield report
