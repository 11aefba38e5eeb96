"""Topics of an MCAP file (ROS 2's rosbag2, Foxglove) as raw tables.

A map names the topics: `topic = "/pressures"` in a table [file.NAME]. One file serves every role
that names a topic. Each message of the topic is a row; numbers inside a message are columns, named
by their path: `pose.position.x`, `data.0`. An item of a list that has a name (`child_frame_id`,
`rigid_body_name`, `marker_name`, `name`) is called by it: `transforms.tip.transform.translation.x`.
The column `t_s` is the time of the message's header, or without one that of the log [s].

With several topics (`topics = ["/k0/pose", "/k1/pose"]`) the rows are those of the first, columns
begin with the topic (`/k0/pose.pose.position.x`), and the others are matched to the nearest time
within half the usual step.
"""

import json
import math
import os
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.parquet_pages import MOST_PACKED, MOST_UNPACKED

MAGIC = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file."""
TIME = "t_s"
"""Column of the time."""
NAMED_BY = ("child_frame_id", "rigid_body_name", "marker_name", "name")
"""Fields by which the items of a list are called, in order of preference."""
RECORD, CHUNK, CHUNK_HEAD = struct.Struct("<BQ"), 6, struct.Struct("<QQQII")
"""Begin of a record (kind, length), the kind of a chunk, and the begin of a chunk (first and last
time, unpacked size, checksum, length of the compression's name): MCAP specification,
https://mcap.dev/spec."""
LONGEST_NAME = 16
"""Most bytes of a compression's name that is looked at; `zstd` and `lz4` are the known ones."""
FRAME_HEAD = 32
"""Bytes of a chunk's packed records that hold the header of a Zstandard or LZ4 frame; the longest
has 19 (RFC 8878; LZ4 frame format 1.6)."""
MOST_CELLS = 1 << 27
"""Most cells, rows times columns, of a topic: 1 GiB. Messages whose fields have ever other names
would have as many columns as messages."""
LONGEST = 64
"""Items of a list of plain numbers that become columns; images and point clouds have more."""


class Messages:
    """Cells (T, c) of messages, one a row."""

    def __init__(self, path: Path, topic: str, values: np.ndarray) -> None:
        self.path, self.topic, self.values = path, topic, values

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        """Cells (T, len(positions)) of columns counted from 0, NaN where missing."""
        return self.values[:, list(positions)]

    def texts(self, position: int) -> list[str]:
        """Cells (T,) of one column as text."""
        return [repr(float(value)) for value in self.values[:, position]]

    def place(self, row: int) -> str:
        """Where a row, counted from 0, is in the file."""
        return f"{self.path}, topic {self.topic}, message {row + 1}"


def _is_mcap(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


@dataclass(frozen=True)
class MessageLog:
    """A kind of file that holds messages in topics."""

    about: str
    """Kind of file, for messages: "an MCAP file"."""
    topics: Callable[[Path], list[str]]
    """Names of the topics of a file."""
    messages: Callable[[Path, str], Iterator[tuple[float, Any]]]
    """Time of the log [s] and content of each message of a topic, in the order of the log."""


def _read(path: Path, role: FileRole) -> RawTable:
    return read_topics(path, role, MessageLog("an MCAP file", _topics, _messages))


def read_topics(path: Path, role: FileRole, log: MessageLog) -> RawTable:
    """The raw table of the topics that a map names."""
    topics = [*([role.topic] if role.topic else []), *role.topics]
    if not topics:
        raise InputError(
            f'{path}: {log.about}, and the map names no topic; expected topic = "/NAME" in its '
            f"[file] table, one of {', '.join(log.topics(path)) or 'none'}"
        )
    tables = [_table(path, topic, log) for topic in topics]
    first_names, first = tables[0]
    if len(tables) == 1:
        return RawTable(path, first_names, Messages(path, topics[0], first))
    names, columns = [TIME], [first[:, :1]]
    for topic, (fields, values) in zip(topics, tables, strict=True):
        names += [f"{topic}.{field}" for field in fields[1:]]
        columns.append(_matched(first[:, 0], values))
    return RawTable(path, names, Messages(path, topics[0], np.hstack(columns)))


def _matched(t_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(T, c) the row of values (R, 1 + c), time first, nearest to each time; NaN where too far."""
    step_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    order = np.argsort(values[:, 0], kind="stable")
    times, rows = values[order, 0], values[order, 1:]
    after = np.clip(np.searchsorted(times, t_s), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    nearest = np.where(t_s - times[before] <= times[after] - t_s, before, after)
    found = rows[nearest].copy()
    found[np.abs(times[nearest] - t_s) > 0.5 * step_s + 1e-9] = np.nan
    return found


def _topics(path: Path) -> list[str]:
    """Names of the topics of a file."""
    with path.open("rb") as file:
        summary = _reader(path, file).get_summary()
    return sorted({c.topic for c in summary.channels.values()}) if summary else []


class _Bounded:
    """A file whose reads ask for no more than is left of it, whatever a length in it claims."""

    def __init__(self, file: Any) -> None:
        self._file, self._size = file, os.fstat(file.fileno()).st_size

    def read(self, size: int = -1) -> bytes:
        """At most so many bytes; all that are left where the size is negative."""
        left = max(0, self._size - self._file.tell())
        return self._file.read(left if size < 0 else min(size, left))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _check_chunks(path: Path, file: Any) -> None:
    """Raise InputError for a chunk that claims to unpack to more than it can."""
    file.seek(len(MAGIC))
    while len(head := file.read(RECORD.size)) == RECORD.size:
        kind, size = RECORD.unpack(head)
        begin = file.tell()
        if kind == CHUNK and len(about := file.read(CHUNK_HEAD.size)) == CHUNK_HEAD.size:
            *_, claimed, _, length = CHUNK_HEAD.unpack(about)
            packed = file.read(length + 8 + FRAME_HEAD) if length <= LONGEST_NAME else b""
            claimed = max(claimed, _frame_claims(packed[:length], packed[length + 8 :]))
            if claimed > max(MOST_UNPACKED, MOST_PACKED * size):
                raise InputError(
                    f"{path}: a chunk of {size} bytes claims to unpack to {claimed}; expected an "
                    "MCAP file that is whole"
                )
        if size > path.stat().st_size:
            break
        file.seek(begin + size)
    file.seek(0)


def _frame_claims(compression: bytes, head: bytes) -> int:
    """Unpacked size, bytes, that the header of a compressed frame claims; 0 where it states none.

    The library that unpacks the frame takes that much memory, whatever the chunk claims.
    """
    with suppress(ImportError, ValueError, RuntimeError):  # a damaged frame does not unpack
        if compression == b"zstd":
            import zstandard

            with suppress(zstandard.ZstdError):
                return zstandard.frame_content_size(head)
        if compression == b"lz4":
            import lz4.frame

            return lz4.frame.get_frame_info(head)["content_size"]
    return 0


def _reader(path: Path, file: Any) -> Any:
    try:
        from mcap.reader import make_reader
    except ImportError:
        raise InputError(
            "an MCAP file needs the packages mcap and mcap-ros2-support, which are not installed: "
            "pip install 'surgisoft[mcap]'"
        ) from None
    _check_chunks(path, file)
    bounded: Any = _Bounded(file)
    return make_reader(bounded)


def _table(path: Path, topic: str, log: MessageLog) -> tuple[list[str], np.ndarray]:
    """Names of the columns, the time first, and cells (T, c) of the messages of a topic."""
    rows: list[dict[str, float]] = []
    for log_s, message in log.messages(path, topic):
        row = {TIME: log_s}
        stamp = _stamp(message)
        if stamp is not None:
            row[TIME] = stamp
        row.update(_flat(message, ""))
        rows.append(row)
    if not rows:
        known = ", ".join(log.topics(path)) or "none"
        raise InputError(f"{path}: no message of the topic '{topic}'; the file has {known}")
    names = list(dict.fromkeys(name for row in rows for name in row))
    if len(names) * len(rows) > MOST_CELLS:
        raise InputError(
            f"{path}: topic '{topic}' has {len(rows)} messages with {len(names)} fields of "
            "different names; expected the same fields in each"
        )
    values = np.array([[row.get(name, math.nan) for name in names] for row in rows], np.float64)
    return names, values


def _messages(path: Path, topic: str) -> Iterator[tuple[float, Any]]:
    """Time of the log [s] and content of each message of a topic, in the order of the log."""
    decoders: dict[int, Any] = {}
    with path.open("rb") as file:
        for schema, channel, message in _reader(path, file).iter_messages(topics=[topic]):
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(path, channel, schema)
            yield 1e-9 * message.log_time, decoders[channel.id](message.data)


def _decoder(path: Path, channel: Any, schema: Any) -> Any:
    if channel.message_encoding == "json":
        return json.loads
    from mcap_ros2.decoder import DecoderFactory

    found = DecoderFactory().decoder_for(channel.message_encoding, schema)
    if found is None:
        raise InputError(
            f"{path}: topic '{channel.topic}' is encoded as {channel.message_encoding}, expected "
            "ROS 2's cdr, or json"
        )
    return found


def ros2_decoder(encoding: str, kind: str, definition: str) -> Callable[[bytes], Any] | None:
    """The function that decodes messages of a type of ROS 2; None for an encoding but `cdr`.

    definition: of the type, and of those that it is made of, as `.msg` files have them.
    """
    try:
        from mcap.records import Schema
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise InputError(
            "a ROS 2 bag needs the packages mcap and mcap-ros2-support, which are not installed: "
            "pip install 'surgisoft[mcap]'"
        ) from None
    schema = Schema(id=1, data=definition.encode(), encoding="ros2msg", name=kind)
    return DecoderFactory().decoder_for(encoding, schema)


def _stamp(message: Any) -> float | None:
    """Time of a message's header [s]; None where it has none, or one that was not set."""
    header = _fields(message).get("header")
    stamp = _fields(header).get("stamp") if header is not None else None
    if stamp is None:
        return None
    parts = _fields(stamp)
    found = parts.get("sec", 0) + 1e-9 * parts.get("nanosec", parts.get("nsec", 0))
    return float(found) or None


def _fields(value: Any) -> dict[str, Any]:
    """Fields of a message by name; none for anything else."""
    if isinstance(value, dict):
        return value
    return {name: getattr(value, name) for name in getattr(value, "__slots__", ())}


def _flat(value: Any, path: str) -> Iterator[tuple[str, float]]:
    """(path, number) of every number inside a value."""
    if isinstance(value, bool | int | float | np.number):
        yield path, float(value)
    elif isinstance(value, list | tuple | np.ndarray):
        if len(value) and isinstance(value[0], int | float | np.number) and len(value) > LONGEST:
            return
        for number, item in enumerate(value):
            yield from _flat(item, _joined(path, _name_of(item) or str(number)))
    elif not (value is None or isinstance(value, str | bytes)):
        for name, inner in _fields(value).items():
            if name != "header":
                yield from _flat(inner, _joined(path, name))


def _name_of(item: Any) -> str:
    fields = _fields(item)
    names = (fields[name] for name in NAMED_BY if isinstance(fields.get(name), str))
    return next((name for name in names if name), "")


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


READER = Reader("an MCAP file (ROS 2)", _read, suffixes=(".mcap",), fits=_is_mcap)
