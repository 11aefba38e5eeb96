"""Write an .rrd file, whole or not at all, in columns of one entity each."""

from __future__ import annotations

import contextlib
import os
import textwrap
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun_bindings import flush_and_cleanup_orphaned_recordings

from surgisoft.errors import InputError
from surgisoft.files import new_file
from surgisoft.replay.contents import TIME
from surgisoft.replay.plots import Line

SUFFIX = ".rrd"
"""Suffix of a Rerun recording."""
STEP = "step"
"""Timeline of the rows of the log; that of seconds is `contents.TIME`."""
LEGEND = "/legend"
"""Entity of the text or picture that explains the colours of the 3D view."""
LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
"""An event's level in Rerun's text log."""
_IMPORTED_IN = os.getpid()
"""The process that imported this module: a fork of it cannot flush recordings of its parent."""


def event_lines(t_s: float, text: str, columns: int) -> list[str]:
    """The lines of an event at a time (s): the viewer shows one line of a text, cut at the edge."""
    wrapped = textwrap.wrap(text, columns)
    return [f"{'':10}{line}" if n else f"{t_s:6.1f} s  {line}" for n, line in enumerate(wrapped)]


@contextlib.contextmanager
def new_recording(
    path: Path, application: str, identity: str, blueprint: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """A recording to log to; the file appears when the block ends without an exception.

    It is kept in memory until then: rerun-sdk 0.41 waits for ever where its own writing fails, on a
    full disk for example.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: suffix '{path.suffix}', expected {SUFFIX}")
    if os.getpid() == _IMPORTED_IN:
        flush_and_cleanup_orphaned_recordings()  # ends threads of recordings that no one holds now
    with new_file(path) as fresh:
        recording = rr.RecordingStream(application, recording_id=identity, send_properties=False)
        content = recording.memory_recording()
        with _ended_blueprint(blueprint):
            # Active, not only the default: a browser opens the recording before it has the layout.
            recording.send_blueprint(blueprint, make_active=True)
        yield recording
        fresh.write_bytes(content.drain_as_bytes())
        recording.disconnect()


@contextlib.contextmanager
def _ended_blueprint(blueprint: rrb.Blueprint) -> Iterator[None]:
    """End the streams that rerun opens for a layout inside the block.

    rerun-sdk 0.41 keeps the stream in memory, with two threads, until the process ends: a thousand
    replays of one experiment had four thousand threads.
    """
    streams: list[rr.RecordingStream] = []
    write = blueprint._log_to_stream

    def kept(stream: rr.RecordingStream) -> None:
        streams.append(stream)
        write(stream)

    blueprint._log_to_stream = kept  # type: ignore[method-assign]
    try:
        yield
    finally:
        del blueprint._log_to_stream
        for stream in streams:
            stream.disconnect()


class Columns:
    """Logs data that change over time, all rows of an entity in one call."""

    def __init__(self, recording: rr.RecordingStream, time_s: np.ndarray):
        """time_s (T,): the time of every row of the log."""
        self.recording, self.time_s = recording, np.asarray(time_s, dtype=np.float64)

    def send(self, entity: str, rows: np.ndarray, columns: rr.ComponentColumnList) -> None:
        """Log columns with one entry for each of the log's `rows` (R,)."""
        rows = np.asarray(rows, dtype=np.int64)
        if not len(rows):
            return
        times = [
            rr.TimeColumn(TIME, duration=self.time_s[rows]),
            rr.TimeColumn(STEP, sequence=rows),
        ]
        self.recording.send_columns(entity, indexes=times, columns=columns)

    def plot(self, line: Line) -> None:
        """Log a line of a plot; rows that are not finite are omitted."""
        style = rr.SeriesLines(
            names=line.name,
            colors=line.colour,
            widths=line.width,
            aggregation_policy=line.keeps,
        )
        self.recording.log(line.entity, style, static=True)
        values = np.asarray(line.values, dtype=np.float64)
        known = np.flatnonzero(np.isfinite(values))
        self.send(line.entity, known, rr.Scalars.columns(scalars=values[known]))
