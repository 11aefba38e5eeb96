"""A recording's log: samples are appended to a file as they are measured, and survive a power cut.

The log is text, one JSON object a line. The first line describes the recording, each further line
is one sample of sensors and cameras. A thread hands every line to the system as it comes and has
the disk write them out every `SYNC_S`, so that a crash of the program loses the lines of a few
milliseconds and a power cut less than a second. The loop that measures never waits for the disk,
which can be busy for tenths of a second. A last line that is torn is left out when the log is read.
"""

import contextlib
import json
import os
import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TextIO

import numpy as np

from surgisoft.command_line import typed
from surgisoft.config import Where, at_least, from_table, value_text
from surgisoft.errors import InputError
from surgisoft.files import json_safe
from surgisoft.measurement.recordings.recording import (
    ArmInfo,
    Recording,
    left_out,
    usable_samples,
)

SUFFIX = ".jsonl"
"""Suffix of a log's file."""
FORMAT = "surgisoft recording log"
"""Name of the format in the first line."""
VERSION = 1
"""Version of the format."""
SYNC_S = 0.5
"""Time between two calls that have the disk write the log out [s]."""


WAITING_LINES = 10_000
"""Number of lines that may wait for the disk; a program that is faster than the disk for longer
waits then. At 50 Hz this is more than three minutes."""


@dataclass(frozen=True)
class LogHeader:
    """Contents of the first line of a log."""

    name: str
    """Name of the recording."""
    kind: str
    """"continuous", or "settled" where the samples of a row are averaged."""
    unit: str
    """Unit of the actuation."""
    chambers: Annotated[int, at_least(1)]
    """Number m of actuation channels."""
    key_points: Annotated[int, at_least(1)]
    """Number n of key points."""
    arm: ArmInfo
    """Size of the arm."""
    gravity: tuple[float, float, float] | None = None
    """Unit vector along the weight, arm base frame."""
    payload_g: float | None = None
    """Known mass at the arm [g]."""
    note: str = ""
    """Free text, for people."""
    rows: int | None = None
    """Number of rows that the whole recording will have; None where it is open."""


class RecordingLog:
    """A log that is being written."""

    def __init__(self, file: TextIO, header: LogHeader) -> None:
        self.samples = 0
        """Samples that were appended so far."""
        self._file = file
        self._lines: queue.Queue[str | None] = queue.Queue(WAITING_LINES)
        self._failed: OSError | None = None
        self._full = False
        self._thread = threading.Thread(target=self._write_lines, daemon=True)
        self._line({"format": FORMAT, "version": VERSION, **asdict(header)})
        self._thread.start()

    def sample(
        self,
        row: int,
        run: int,
        t_s: float,
        measured: np.ndarray,
        key_points_mm: np.ndarray,
        commanded: np.ndarray | None = None,
        temp_C: float | None = None,
    ) -> None:
        """Append one sample; several of one row are one averaged sample of the recording.

        run: id of its run. measured, commanded: (m,). key_points_mm: (n, 3), NaN where missing.
        Raises OSError where an earlier line could not be written.
        """
        found: dict[str, Any] = {"row": row, "run": run, "t_s": t_s, "p": measured}
        if commanded is not None:
            found["c"] = commanded
        found["k"] = key_points_mm
        if temp_C is not None:
            found["temp_C"] = temp_C
        self._line(found)
        self.samples += 1

    def close(self) -> None:
        """Write the log out; it stays where it is. Raises OSError where a line could not be."""
        if self._thread.is_alive():
            self._lines.put(None)
            self._thread.join()
        if not self._file.closed:
            self._sync()
            self._file.close()
        self._raise()

    def _raise(self) -> None:
        failed, self._failed = self._failed, None
        if failed is not None:
            raise failed

    def _line(self, content: dict[str, Any]) -> None:
        self._raise()
        self._lines.put(json.dumps(json_safe(content), separators=(",", ":")) + "\n")

    def _write_lines(self) -> None:
        """Write lines until None comes; after an error lines are dropped, so that nobody waits."""
        line: str | None = ""
        due = time.monotonic() + SYNC_S
        while line is not None:
            try:
                line = self._lines.get(timeout=max(0.0, due - time.monotonic()))
            except queue.Empty:
                line = ""
            if line and not self._full:
                self._write(line)
            if time.monotonic() >= due:
                self._sync()
                due = time.monotonic() + SYNC_S

    def _write(self, line: str) -> None:
        try:
            self._file.write(line)
            if self._lines.empty():
                self._file.flush()
        except OSError as error:
            self._failed, self._full = error, True

    def _sync(self) -> None:
        with contextlib.suppress(OSError, ValueError):  # a device that cannot, or closed meanwhile
            os.fsync(self._file.fileno())


def check_log_free(path: Path, force: bool = False) -> None:
    """Raise InputError where `recording_log` would refuse this path."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected the name of a new log; move it away")
    if path.exists() and not force:
        raise InputError(
            f"{path}: the log of an interrupted recording is there; use it ('surgisoft recording "
            f"{typed(path)}' reads it), remove it, or use --force (in Python force=True)"
        )


@contextlib.contextmanager
def recording_log(
    path: str | Path, header: LogHeader, force: bool = False
) -> Iterator[RecordingLog]:
    """Begin a log; the file stays when the block ends, however it ends.

    A block that an exception ends before the first sample leaves none: nobody could open it.
    """
    path = Path(path)
    check_log_free(path, force)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        log = RecordingLog(file, header)
        try:
            yield log
        except BaseException:
            if not log.samples and path.is_file():  # no device or pipe
                path.unlink(missing_ok=True)
            raise
        finally:
            log.close()


def average(frames: np.ndarray) -> np.ndarray:
    """Mean of (P, F, ...) over F, frame by frame; missing values are left out."""
    total = np.zeros_like(frames[:, 0])
    count = np.zeros(total.shape, np.int64)
    for k in range(frames.shape[1]):
        known = np.isfinite(frames[:, k])
        total += np.where(known, frames[:, k], 0.0)
        count += known
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def read_log(path: str | Path) -> tuple[Recording, str]:
    """The recording in a log, and what is missing of it in words (empty: nothing).

    Raises InputError for a file that is no log, or holds no sample.
    """
    path = Path(path)
    lines, torn = _lines(path)
    header = _header(path, lines[0])
    rows: dict[int, list[dict]] = {}
    for number, line in enumerate(lines[1:], 2):
        _check_sample(path, number, line, header)
        rows.setdefault(line["row"], []).append(line)
    if not rows:
        raise InputError(f"{path}: the log has no sample yet; expected at least one")
    ordered = list(rows.values())

    def column(name: str, *shape: int) -> np.ndarray:
        return np.array([average(_floats(group, name, shape))[0] for group in ordered])

    t_s, measured = column("t_s"), column("p", header.chambers)
    run = np.array([group[-1]["run"] for group in ordered], np.int64)
    usable = usable_samples(t_s, run, measured, _last(ordered, "c", header.chambers))
    lacking = []
    if not usable.all():
        lacking.append(left_out(int((~usable).sum())))
        ordered = [group for group, good in zip(ordered, usable, strict=True) if good]
        if not ordered:
            raise InputError(f"{path}: the log has no sample with every pressure; expected one")
    recording = Recording(
        name=header.name,
        t_s=(t_s - t_s[0])[usable],
        measured=measured[usable],
        key_points_mm=column("k", header.key_points, 3),
        commanded=_last(ordered, "c", header.chambers),
        run=run[usable],
        unit=header.unit,
        temp_C=column("temp_C") if all("temp_C" in line for line in lines[1:]) else None,
        payload_g=None if header.payload_g is None else np.full(len(ordered), header.payload_g),
        arm=header.arm,
        gravity=None if header.gravity is None else np.array(header.gravity),
        kind=header.kind,
        note=header.note,
        source=path,
    )
    if header.rows is not None and len(rows) < header.rows:
        lacking.append(f"it was interrupted after {len(rows)} of {header.rows} samples")
    if torn:
        lacking.append("its last line is incomplete and was left out")
    return recording, "; ".join(lacking)


def _lines(path: Path) -> tuple[list[dict], bool]:
    """The JSON objects of the file's lines, and whether the last one was torn and left out."""
    found: list[dict] = []
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    raw = text.split(b"\n")
    torn = raw[-1] != b""
    raw.pop()
    if torn:  # whole but for the line's end, or torn inside
        with contextlib.suppress(ValueError, RecursionError):
            json.loads(text.rpartition(b"\n")[2])
            raw.append(text.rpartition(b"\n")[2])
            torn = False
    while raw and not raw[-1].strip(b"\0 "):  # blocks that the disk had reserved, not written
        raw.pop()
    for number, line in enumerate(raw, 1):
        try:
            found.append(json.loads(line))
        except (ValueError, RecursionError) as error:
            if number == len(raw) and found:
                return found, True
            raise InputError(
                f"{path}, line {number}: not a line of a {FORMAT}, expected a JSON object"
            ) from error
        if not isinstance(found[-1], dict):
            raise InputError(f"{path}, line {number}: expected a JSON object, not a value")
    if not found:
        raise InputError(f"{path}: is empty, expected a {FORMAT}")
    return found, torn


def _header(path: Path, first: dict) -> LogHeader:
    if first.get("format") != FORMAT:
        raise InputError(f"{path}, line 1: no {FORMAT}; 'surgisoft import' reads other files")
    if first.get("version") != VERSION:
        raise InputError(
            f"{path}, line 1: version {first.get('version')}, expected {VERSION}; use the "
            "surgisoft that wrote it"
        )
    fields = {name: value for name, value in first.items() if name not in ("format", "version")}
    return from_table(LogHeader, fields, Where(path))


def _check_sample(path: Path, number: int, line: dict, header: LogHeader) -> None:
    shapes = {"row": (), "run": (), "t_s": (), "p": (header.chambers,)}
    shapes["k"] = (header.key_points, 3)
    if "c" in line:
        shapes["c"] = (header.chambers,)
    if "temp_C" in line:
        shapes["temp_C"] = ()
    for name, shape in shapes.items():
        try:
            good = np.shape(np.array(line[name], np.float64)) == shape
        except (KeyError, TypeError, ValueError, OverflowError):
            good = False
        if name in ("row", "run"):
            good = good and type(line[name]) is int and abs(line[name]) < 2**53
        if not good:
            raise InputError(
                f"{path}, line {number}: '{name}' is {value_text(line.get(name))}, expected "
                f"numbers of shape {shape}"
            )


def _floats(group: list[dict], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """(1, F, *shape) values of the F samples of one row; null is NaN."""
    return np.array([line[name] for line in group], np.float64).reshape(1, len(group), *shape)


def _last(rows: list[list[dict]], name: str, size: int) -> np.ndarray | None:
    if any(name not in group[-1] for group in rows):
        return None
    return np.array([group[-1][name] for group in rows], np.float64).reshape(len(rows), size)
