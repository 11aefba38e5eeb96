"""Check of what a Parquet file claims, before pyarrow takes memory for it.

A column of a row group (a column chunk) is a row of pages, each behind a header in Thrift's compact
protocol that states the page's size, packed and unpacked, and its number of values. pyarrow takes
memory for these numbers before it reads the page: a damaged header of a small file makes it ask for
gigabytes. The headers are read here first (Apache Parquet format 2.11, `PageHeader`).
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from surgisoft.errors import InputError

MOST_UNPACKED = 1 << 28
"""Largest content of a packed file, bytes, whatever the file's size: a small file can claim a
thousand times its own."""
MOST_PACKED = 100
"""Most bytes of numbers in each byte of a Parquet file, where they are more than `MOST_UNPACKED`:
measured positions have noise and do not compress."""
LONGEST_HEADER = 1 << 24
"""Longest header of a page, bytes, as pyarrow has it."""
OLD_MARGIN = 100
"""Bytes by which old writers state a column chunk too short (Arrow's issue PARQUET-816)."""
DEEPEST = 16
"""Most levels of structures in a header; a page's has three."""


def open_metadata(path: Path) -> pq.FileMetaData:
    """What a Parquet file states of its content, once all its pages keep to the limits.

    Raises InputError where the file is no Parquet file, where its pages do not lie in it, and where
    they claim more than `MOST_PACKED` bytes for each byte of it.
    """
    try:
        content = pq.read_metadata(path)
        rows, columns = content.num_rows, content.num_columns
        check_claim(path, 8 * rows * columns, f"{rows} rows of {columns} columns")
        if rows:
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ) as data:
                _check(path, content, data)
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable Parquet file") from error
    return content


def check_claim(path: Path, claimed: int, what: str) -> None:
    """Raise InputError where a file claims more bytes than files of its size hold."""
    size = path.stat().st_size
    if claimed > max(MOST_PACKED * size, MOST_UNPACKED):
        raise InputError(
            f"{path}: claims {what} in {size} bytes; expected a Parquet file with measurements"
        )


def _check(path: Path, content: pq.FileMetaData, data: mmap.mmap) -> None:
    """Raise InputError or ValueError where the pages claim too much or lie outside of the file."""
    unpacked = values = 0
    for group in range(content.num_row_groups):
        for column in range(content.num_columns):
            chunk = content.row_group(group).column(column)
            values += max(chunk.num_values, 0)
            check_claim(path, 8 * values, f"{values} values")
            for size in _page_sizes(chunk, data):
                unpacked += size
                check_claim(path, unpacked, f"pages of {unpacked} bytes")


def _page_sizes(chunk: pq.ColumnChunkMetaData, data: mmap.mmap) -> Iterator[int]:
    """Unpacked size of each page of a column chunk, bytes."""
    at = chunk.data_page_offset
    if chunk.has_dictionary_page and 0 < chunk.dictionary_page_offset < at:
        at = chunk.dictionary_page_offset
    end = at + chunk.total_compressed_size
    if not 0 < at <= end <= len(data):
        raise ValueError("a column chunk outside of the file")
    end, left = min(end + OLD_MARGIN, len(data)), chunk.num_values
    while left > 0 and at < end:
        header = _Thrift(data, at)
        fields = header.structure()
        unpacked, packed = fields.get(2), fields.get(3)
        if not isinstance(unpacked, int) or not isinstance(packed, int):
            raise ValueError("a page without its size")
        at = header.at + packed
        if unpacked < 0 or packed < 0 or at > end:
            raise ValueError("a page outside of its column chunk")
        for kind in (5, 7, 8):  # data page, dictionary, data page of version 2
            about = fields.get(kind)
            if about is None:
                continue
            count = about.get(1) if isinstance(about, dict) else None
            if not isinstance(count, int) or not 0 <= count <= (
                8 * unpacked if kind == 7 else left
            ):
                raise ValueError("a page of more values than its column chunk")
            left -= count if kind != 7 else 0
        yield unpacked


class _Thrift:
    """Reads integers and structures of Thrift's compact protocol, and passes over the rest."""

    def __init__(self, data: mmap.mmap, at: int):
        self.data, self.at, self.end = data, at, min(len(data), at + LONGEST_HEADER)

    def structure(self, depth: int = 0) -> dict[int, int | dict | None]:
        """Fields by their number: integers, structures, and None for what is passed over."""
        if depth > DEEPEST:
            raise ValueError("structures nested too deeply")
        fields: dict[int, int | dict | None] = {}
        number = 0
        while (head := self._byte()) != 0:
            number = number + (head >> 4) if head >> 4 else self._integer()
            fields[number] = self._value(head & 15, depth, alone=True)
        return fields

    def _value(self, kind: int, depth: int, alone: bool = False) -> int | dict | None:
        match kind:
            case 1 | 2:  # a field's truth value is its type; an element's is a byte
                self._skip(0 if alone else 1)
            case 3:
                self._skip(1)
            case 4 | 5 | 6:
                return self._integer()
            case 7:
                self._skip(8)
            case 8:
                self._skip(self._unsigned())
            case 9 | 10:
                head = self._byte()
                for _ in range(head >> 4 if head >> 4 != 15 else self._unsigned()):
                    self._value(head & 15, depth + 1)
            case 12:
                return self.structure(depth + 1)
            case _:
                raise ValueError("a field of an unknown type")
        return None

    def _byte(self) -> int:
        if self.at >= self.end:
            raise ValueError("a header without an end")
        self.at += 1
        return self.data[self.at - 1]

    def _skip(self, count: int) -> None:
        if count > self.end - self.at:
            raise ValueError("a header without an end")
        self.at += count

    def _unsigned(self) -> int:
        found = shift = 0
        while (byte := self._byte()) & 128:
            found |= (byte & 127) << shift
            shift += 7
            if shift > 63:
                raise ValueError("a number of more than 64 bits")
        return found | byte << shift

    def _integer(self) -> int:
        found = self._unsigned()
        return found >> 1 ^ -(found & 1)
