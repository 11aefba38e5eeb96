"""Replays of what models get wrong on recordings: bodies, errors, worst moments, words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from surgisoft.diagnosis.compare import Compared
from surgisoft.diagnosis.residuals import ResidualTable
from surgisoft.replay.comparison import write_comparison
from surgisoft.replay.episode_view import Replay
from surgisoft.tasks.episodes.parts import Event

WORST = 5
"""Worst moments among the events of a replay without a comparison."""
APART_S = 5.0
"""Least time between two of them, s."""


def write_compared(
    compared: Sequence[Compared], title: str, path: str | Path, large_mm: float | None = None
) -> Replay:
    """Write the replay of a comparison of one or several models as an .rrd file.

    large_mm: error at which the colours end, mm; None: from the worst model's errors.
    """
    first = compared[0]
    seen = "\n\n".join(f"**{one.name}**: {one.result.sentence}." for one in compared)
    worst = [
        Event(
            moment.along_s,
            "warning",
            f"worst of {first.name}: {moment.error_mm:.2f} mm at k{moment.key_point}",
        )
        for moment in first.result.worst
    ]
    return _write({one.name: one.table for one in compared}, title, path, seen, worst, large_mm)


def write_models(
    tables: Mapping[str, ResidualTable], title: str, path: str | Path, sentence: str = ""
) -> Replay:
    """Write models beside the same recordings, as before and after an amendment, as an .rrd file.

    tables: residuals of each model on the same rows, by its name (`diagnosis.compare.tables_of`).
    sentence: what the models are to show.
    """
    seen = f"**{sentence}.**" if sentence else ""
    first, table = next(iter(tables.items()))
    worst = [
        Event(float(table.along_s[row]), "warning", f"worst of {first}: {error:.2f} mm")
        for row, error in _worst(table)
    ]
    return _write(tables, title, path, seen, worst, None)


def _worst(table: ResidualTable):
    """Rows with the largest errors, and these errors in mm, `APART_S` from each other."""
    peak = np.nan_to_num(table.error_mm, nan=-1.0).max(axis=1)
    for _ in range(WORST):
        row = int(peak.argmax())
        if peak[row] < 0.0:
            return
        yield row, float(peak[row])
        peak = np.where(np.abs(table.along_s - table.along_s[row]) < APART_S, -1.0, peak)


def _write(tables, title: str, path, seen: str, worst: list[Event], large_mm) -> Replay:
    table = next(iter(tables.values()))
    many = len(tables) > 1
    words = [
        f"**{title}**",
        seen,
        "The white body was measured. "
        + ("Each view shows it with one model's body" if many else "The red body is predicted")
        + ". Both nearly coincide, so the error of each key point is also an arrow from measured "
        "to predicted, longer than it is by the factor in the title, and coloured by its size"
        + (", by one scale for all models." if many else "."),
        "Times are those of the report: seconds from the start of the first recording.",
    ]
    events = sorted([*worst, *_recordings(table), *_held_out(table)], key=lambda e: e.time_s)
    return write_comparison(
        table.t_s,
        table.measured_mm,
        {name: each.predicted_mm for name, each in tables.items()},
        title,
        path,
        table.pressure,
        table.spec.unit,
        seen="\n\n".join(filter(None, words)),
        events=events,
        large_mm=large_mm,
        gravity=table.drawn_gravity,
    )


def _recordings(table: ResidualTable) -> list[Event]:
    """Where each recording and each run begins."""
    found = []
    for row in np.flatnonzero(np.diff(table.run, prepend=-1) != 0):
        number = int(table.run[row])
        name = table.names[table.recording[row]]
        found.append(Event(float(table.along_s[row]), "info", f"{name}: run {number + 1} begins"))
    return found if len(found) <= MOST_RUNS else []


MOST_RUNS = 30
"""Most runs whose beginnings are listed: steady-state samples have hundreds."""


def _held_out(table: ResidualTable) -> list[Event]:
    """Where the part begins that is held out of fits."""
    held = table.held_out
    begins = np.flatnonzero(held & ~np.concatenate(([False], held[:-1])))
    text = "held-out part begins: not used in any fit"
    return [Event(float(table.along_s[row]), "info", text) for row in begins[:MOST_RUNS]]
