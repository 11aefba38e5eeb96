"""Text files of columns as raw tables: separators, decimal commas, headers, comments, torn ends."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.tables import MISSING, DelimitedText, read_text

OTHER_SEPARATORS = (";", "\t", ",")
"""Separators that are looked for where a file has not the columns that the map names."""


def _read(path: Path, role: FileRole) -> RawTable:
    """A text file of columns as a raw table; a .tsv file is separated by tabs."""
    if path.suffix == ".tsv" and role.separator == ",":
        role = replace(role, separator="\t")
    data = read_text(path)
    offset = _offset_of_line(data, role.skip_rows)
    if offset is None:
        raise InputError(f"{path}: fewer than the {role.skip_rows} lines that the map skips")
    head, body, first_line = b"", data[offset:], role.skip_rows + 1
    if role.header:
        while True:  # the first line that is neither blank nor a comment
            head, _, body = body.partition(b"\n")
            first_line += 1
            if not body or (head.strip() and not _is_comment(head, role)):
                break
    names = _header(path, head, role)
    return table_of_body(path, role, names, body, first_line, head)


def table_of_body(
    path: Path,
    role: FileRole,
    names: list[str],
    body: bytes,
    first_line: int,
    header: bytes = b"",
) -> RawTable:
    """The raw table of the lines below a header; no names: as many as the first line has cells.

    header: the line of names as it is written; empty where there is none.
    """
    plain = body
    body = _cleaned(body, role)
    first = next((line for line in body.split(b"\n", 1000) if line), b"")
    if not first:
        raise InputError(
            f"{path}: no rows of numbers, expected at least one: it was read as text; "
            "docs/recordings.md lists the other formats that are read"
        )
    separator = "\t" if role.separator == "whitespace" else role.separator
    count = len(_split(first, separator, path))
    advice = _other_separator(path, role, header, plain)
    names = names or [""] * count
    if count == len(names) + 1 and first.rstrip().endswith(separator.encode()):
        names = [*names, ""]  # each line ends with a separator
    if count == 1 and len(names) == 1:
        advice = advice or "check the separator in the map"
        raise InputError(f"{path}: one column only when separated by {role.separator!r}; {advice}")
    body, notes = _without_torn_end(path, body, separator, len(names))
    missing = (*MISSING, *role.missing)
    cells = DelimitedText(path, body, first_line, names, separator, role.decimal, missing)
    return RawTable(path, names, cells, notes=notes, advice=advice)


def _offset_of_line(data: bytes, lines: int) -> int | None:
    """Where the line after this many lines begins; None where there are not so many."""
    offset = 0
    for _ in range(lines):
        end = data.find(b"\n", offset)
        if end < 0:
            return None
        offset = end + 1
    return offset


def _is_comment(line: bytes, role: FileRole) -> bool:
    return bool(role.comment) and line.lstrip().startswith(role.comment.encode())


def _header(path: Path, line: bytes, role: FileRole) -> list[str]:
    text = line.decode("utf-8", errors="replace").strip().removeprefix("#").strip(" ")
    if not text:
        return []
    if role.separator == "whitespace":
        return text.split()
    return [name.strip() for name in _split(text.encode(), role.separator, path)]


def _cleaned(body: bytes, role: FileRole) -> bytes:
    """The body with blanks instead of comments (lines keep their numbers), tabs as white space."""
    if role.comment:
        pattern = rb"(?m)^[ \t]*" + re.escape(role.comment.encode()) + rb".*$"
        body = re.sub(pattern, b"", body)
    if role.separator == "whitespace":
        body = re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", body)
        return re.sub(rb"[ \t]+", b"\t", body)
    # A search for lines of blanks alone goes through every line, which few files need.
    blank = any(
        mark in body and (body.startswith(mark) or b"\n" + mark in body) for mark in (b" ", b"\t")
    )
    if role.separator == "\t" or not blank:
        return body
    return re.sub(rb"(?m)^[ \t]+$", b"", body)


def _other_separator(path: Path, role: FileRole, header: bytes, body: bytes) -> str:
    """What to set in the map where another separator divides header and first row into more
    columns, as many in both; empty where none does."""
    first = next((line for line in body.split(b"\n", 1000) if line.strip()), b"")
    own = "\t" if role.separator == "whitespace" else role.separator
    least = len(header.split()) if role.separator == "whitespace" else len(_cells(header, own))
    for separator in OTHER_SEPARATORS:
        names, cells = _cells(header, separator), _cells(first, separator)
        if separator != own and len(names) == len(cells) > max(least, 1):
            decimal = any(re.search(r"\d,\d", cell) for cell in cells)
            also = ' and decimal = ","' if decimal and role.decimal != "," else ""
            shown = json.dumps(separator)
            return f"set separator = {shown}{also} in [file.NAME] of the map, as --draft writes it"
    return ""


def _cells(line: bytes, separator: str) -> list[str]:
    """The cells of one line, by its separator alone; an end with a separator is no cell."""
    text = line.decode("utf-8", "replace").strip("\r\n").removesuffix(separator)
    return text.split(separator)


def _without_torn_end(
    path: Path, body: bytes, separator: str, count: int
) -> tuple[bytes, tuple[str, ...]]:
    """The body without a last line that was cut off while it was written."""
    kept = body.rstrip(b"\n")
    start = kept.rfind(b"\n") + 1
    last = kept[start:]
    cells = len(_split(last, separator, path))
    if start == 0 or cells >= count or body.endswith(b"\n"):
        return body, ()
    return body[:start], (f"the last line was cut off ({cells} of {count} cells) and left out",)


def _split(line: bytes, separator: str, path: Path) -> list[str]:
    """The cells of one line."""
    try:
        return next(csv.reader([line.decode("utf-8", "replace")], delimiter=separator), [])
    except csv.Error as error:
        raise InputError(f"{path}: {error}, expected cells separated by {separator!r}") from error


READER = Reader("a text file of columns", _read)
