"""Check of what a Parquet file claims, before pyarrow takes memory for it.

A column of a row group (a column chunk) is a row of pages, each behind a header in Thrift's compact
protocol that states the page's size, packed and unpacked, and its number of values. pyarrow takes
memory for these numbers before it reads the page: a damaged header of a small file makes it ask for
gigabytes. The headers are read here first (Apache Parquet format 2.11, `PageHeader`), and so are
the places of the column chunks in the file's footer (`FileMetaData`): pyarrow 26 aborts the process
where it is asked for the place of a column chunk with damaged statistics of sizes.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from dataclasses import dataclass
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
FOOTER_END = 8
"""Bytes behind the footer: its length, and the letters `PAR1`."""
STRUCTURE = 12
"""Type of a structure in Thrift's compact protocol; that of a list is 9."""
ROW_GROUPS, COLUMNS = (4, 9), (1, 9)
"""Number and type of the field of `FileMetaData` that lists row groups, and of the field of
`RowGroup` that lists column chunks."""


def open_metadata(path: Path) -> pq.FileMetaData:
    """Metadata of a Parquet file, after all its pages were found to keep to the limits.

    Raises InputError where the file is no Parquet file, where its pages do not lie in it, and where
    they claim more than `MOST_PACKED` bytes for each byte of it.
    """
    try:
        content = pq.read_metadata(path)
        rows, columns = content.num_rows, content.num_columns
        check_claim(path, 8 * rows * columns, f"{rows} rows of {columns} columns")
        if rows:
            read = mmap.ACCESS_READ
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=read) as data:
                _check(path, data)
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


def _check(path: Path, data: mmap.mmap) -> None:
    """Raise InputError or ValueError where the pages claim too much or lie outside of the file."""
    unpacked = values = covered = 0
    for chunk in _chunks(data):
        covered += chunk.end - chunk.begin
        if covered > len(data):  # each byte would be read once for each chunk that claims it
            raise ValueError("column chunks that overlap")
        values += max(chunk.values, 0)
        check_claim(path, 8 * values, f"{values} values")
        for size in _page_sizes(chunk, data):
            unpacked += size
            check_claim(path, unpacked, f"pages of {unpacked} bytes")


@dataclass(frozen=True)
class _Chunk:
    """Where a column chunk is in the file, as the footer states it."""

    values: int
    """Number of values."""
    begin: int
    """Its first page, bytes from the begin of the file."""
    end: int
    """Its end, bytes from the begin of the file."""


def _chunks(data: mmap.mmap) -> Iterator[_Chunk]:
    """The column chunks of all row groups, from the footer."""
    end = len(data) - FOOTER_END
    begin = end - int.from_bytes(data[end : end + 4], "little")
    if begin < 0:
        raise ValueError("a footer longer than the file")
    footer = _Thrift(data, begin, end)
    for number, kind in footer.heads():
        if (number, kind) != ROW_GROUPS:
            footer.value(kind, alone=True)
            continue
        for _ in footer.structures():
            for inner, of in footer.heads():
                if (inner, of) != COLUMNS:
                    footer.value(of, alone=True)
                    continue
                for _ in footer.structures():
                    yield _chunk(footer.structure().get(3))


def _chunk(about: int | dict | None) -> _Chunk:
    """A column chunk from the fields of its `ColumnMetaData`."""
    fields = about if isinstance(about, dict) else {}
    values, size, begin, dictionary = (fields.get(number) for number in (5, 7, 9, 11))
    if not (isinstance(values, int) and isinstance(size, int) and isinstance(begin, int)):
        raise ValueError("a column chunk without its place")
    if isinstance(dictionary, int) and 0 < dictionary < begin:
        begin = dictionary
    return _Chunk(values, begin, begin + size)


def _page_sizes(chunk: _Chunk, data: mmap.mmap) -> Iterator[int]:
    """Unpacked size of each page of a column chunk, bytes."""
    at, end = chunk.begin, chunk.end
    if not 0 < at <= end <= len(data):
        raise ValueError("a column chunk outside of the file")
    end, left = min(end + OLD_MARGIN, len(data)), chunk.values
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

    def __init__(self, data: mmap.mmap, at: int, end: int | None = None):
        """Read from byte `at` to `end` (default: the longest header, or the end of the file)."""
        self.data, self.at = data, at
        self.end = min(len(data), at + LONGEST_HEADER) if end is None else end

    def structure(self, depth: int = 0) -> dict[int, int | dict | None]:
        """Fields by their number: integers, structures, and None for what is passed over."""
        if depth > DEEPEST:
            raise ValueError("structures nested too deeply")
        return {number: self.value(kind, depth, alone=True) for number, kind in self.heads()}

    def heads(self) -> Iterator[tuple[int, int]]:
        """Number and type of each field of a structure; the caller reads its value."""
        number = 0
        while (head := self._byte()) != 0:
            number = number + (head >> 4) if head >> 4 else self._integer()
            yield number, head & 15

    def elements(self) -> Iterator[int]:
        """Type of each element of a list; the caller reads its value."""
        head = self._byte()
        for _ in range(head >> 4 if head >> 4 != 15 else self._unsigned()):
            yield head & 15

    def structures(self) -> Iterator[None]:
        """Once for each element of a list of structures; the caller reads its fields."""
        for kind in self.elements():
            if kind != STRUCTURE:
                raise ValueError("a list of something else than structures")
            yield

    def value(self, kind: int, depth: int = 0, alone: bool = False) -> int | dict | None:
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
                if depth > DEEPEST:
                    raise ValueError("lists nested too deeply")
                for inner in self.elements():
                    self.value(inner, depth + 1)
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
