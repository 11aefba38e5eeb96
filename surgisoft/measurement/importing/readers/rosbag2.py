"""Topics of a ROS 2 bag in SQLite (rosbag2, `.db3`) as raw tables.

A map names the topics, and columns are called as for an MCAP file (`mcap`): the messages are
decoded in the same way. Their definitions are in the bag itself, in the table
`message_definitions`, since ROS 2 Iron; a bag without them is refused with what to do.

The file is opened read-only and as one that does not change, so that nothing is written beside it.
"""

import sqlite3
from array import array
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.importing.readers.mcap import MessageLog, read_topics, ros2_decoder

MAGIC = b"SQLite format 3\0"
"""First bytes of a database (https://www.sqlite.org/fileformat.html)."""
UNFINISHED = ("-wal", "-journal")
"""Endings of the files beside a database that was not closed: they hold a part of its content."""
MOST_BYTES = 1 << 28
"""Largest message, definition or other value of a row, bytes: a damaged file may claim any."""
DEFINITION = "ros2msg"
"""The kind of definition that is decoded; the other one is IDL."""


def _is_bag(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def _read(path: Path, role: FileRole) -> RawTable:
    if not _is_bag(path):
        raise InputError(f"{path}: does not begin as a SQLite database, expected a ROS 2 bag")
    for ending in UNFINISHED:
        beside = path.with_name(path.name + ending)
        if beside.exists() and beside.stat().st_size:
            raise InputError(
                f"{path}: was not closed, {beside.name} holds a part of it; expected a bag whose "
                f"recording has ended (sqlite3 {path.name} 'PRAGMA wal_checkpoint' ends it)"
            )
    return read_topics(path, role, MessageLog("a ROS 2 bag", _topics, _messages))


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """A bag, opened read-only; what SQLite cannot read of it is an InputError."""
    place = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(place, uri=True)) as bag:
            bag.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_BYTES)
            for setting in ("query_only = ON", "trusted_schema = OFF", "cell_size_check = ON"):
                bag.execute(f"PRAGMA {setting}")
            missing = {"topics", "messages"} - _tables(bag)
            if missing:
                raise InputError(
                    f"{path}: no table '{min(missing)}', expected a ROS 2 bag in SQLite"
                )
            yield bag
    except (sqlite3.Error, MemoryError, OverflowError) as error:
        reason = str(error) or type(error).__name__
        raise InputError(f"{path}: cannot be read as a ROS 2 bag in SQLite ({reason})") from error


def _tables(bag: sqlite3.Connection) -> set[str]:
    """Names of the plain tables: a view could compute anything."""
    asked = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql LIKE 'CREATE TABLE%'"
    return {name for (name,) in bag.execute(asked)}


def _topics(path: Path) -> list[str]:
    """Names of the topics of a bag."""
    with _opened(path) as bag:
        return sorted({str(name) for (name,) in bag.execute("SELECT name FROM topics")})


def _messages(path: Path, topic: str) -> Iterator[tuple[float, Any]]:
    """Time of the log [s] and content of each message of a topic, in the order of the log."""
    with _opened(path) as bag:
        asked = "SELECT id, type, serialization_format FROM topics WHERE name = ?"
        for number, kind, encoding in bag.execute(asked, [topic]).fetchall():
            decode = _decoder(path, topic, str(kind), str(encoding), bag)
            # Only the numbers of the messages are sorted, which all fit into memory.
            asked = "SELECT id FROM messages WHERE topic_id = ? ORDER BY timestamp, id"
            order = array("q", (row for (row,) in bag.execute(asked, [number])))
            for place, row in enumerate(order, 1):
                asked = "SELECT timestamp, data FROM messages WHERE id = ?"
                stamp, data = bag.execute(asked, [row]).fetchone()
                if not isinstance(stamp, int) or not isinstance(data, bytes):
                    raise InputError(
                        f"{path}, topic {topic}, message {place}: got {type(stamp).__name__} and "
                        f"{type(data).__name__}, expected a time in ns and bytes"
                    )
                yield 1e-9 * stamp, decode(data)


def _decoder(
    path: Path, topic: str, kind: str, encoding: str, bag: sqlite3.Connection
) -> Callable[[bytes], Any]:
    """The function that decodes the messages of a type."""
    found = ros2_decoder(encoding, kind, _definition(path, topic, kind, bag))
    if found is None:
        raise InputError(f"{path}: topic '{topic}' is encoded as {encoding}, expected ROS 2's cdr")
    return found


def _definition(path: Path, topic: str, kind: str, bag: sqlite3.Connection) -> str:
    """The definition of a type of message, with those that it is made of."""
    advice = "'ros2 bag convert' makes an MCAP file of it, which holds them"
    found: list[tuple] = []
    if "message_definitions" in _tables(bag):
        asked = "SELECT encoding, encoded_message_definition FROM message_definitions"
        found = bag.execute(f"{asked} WHERE topic_type = ?", [kind]).fetchall()
    for encoding, text in found:
        if encoding == DEFINITION and isinstance(text, str) and text:
            return text
    if found:
        raise InputError(
            f"{path}: topic '{topic}' has a definition in {found[0][0]}, expected {DEFINITION}; "
            f"{advice}"
        )
    raise InputError(
        f"{path}: topic '{topic}': no definition of {kind} in the bag, as ROS 2 wrote before Iron; "
        f"{advice}"
    )


READER = Reader("a ROS 2 bag in SQLite", _read, suffixes=(".db3",), fits=_is_bag)
