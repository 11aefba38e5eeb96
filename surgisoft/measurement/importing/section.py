"""A table of a map file that knows its place and notices fields that nobody asked for."""

import difflib
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from surgisoft.config import Where, describe
from surgisoft.errors import InputError
from surgisoft.measurement.importing.spec import Column


class Section:
    """A table of the map that knows its place and notices fields that nobody asked for."""

    def __init__(self, content: object, where: Where):
        if not isinstance(content, dict):
            raise where.error(f"got {describe(content)}", "a table")
        self.content = content
        self.where = where
        self.known: list[str] = []

    def error(self, name: str, expected: str) -> InputError:
        """What stands in a field instead of what was expected."""
        came = f"got {describe(self.content[name])}" if name in self.content else "missing"
        return (self.where / name).error(came, expected)

    def take(self, name: str, default: Any, expected: str, read: Callable[[Any], Any]) -> Any:
        """A field, or the default; `read` returns None for what is not as expected."""
        self.known.append(name)
        if name not in self.content:
            return default
        value = read(self.content[name])
        if value is None:
            raise self.error(name, expected)
        return value

    def text(self, name: str, default: str) -> str:
        return self.take(name, default, "text", lambda v: v if isinstance(v, str) else None)

    def flag(self, name: str, default: bool) -> bool:
        return self.take(
            name, default, "true or false", lambda v: v if isinstance(v, bool) else None
        )

    def choice(self, name: str, default: str, options: tuple[str, ...]) -> str:
        expected = f"one of {', '.join(options)}"
        return self.take(name, default, expected, lambda v: v if v in options else None)

    def integer(self, name: str, default: int | None, least: int | None = None) -> int | None:
        expected = "an integer" if least is None else f"an integer >= {least}"
        return self.take(
            name,
            default,
            expected,
            lambda v: v if is_integer(v) and (least is None or v >= least) else None,
        )

    def number(self, name: str, default: float | None, least: float = -np.inf) -> float | None:
        expected = "a number" if np.isneginf(least) else f"a number > {least:g}"
        return self.take(
            name, default, expected, lambda v: float(v) if is_number(v) and v > least else None
        )

    def vector(self, name: str, default: Any) -> Any:
        return self.take(name, default, "three numbers", as_vector)

    def column(self, name: str, default: Column | None) -> Column | None:
        return self.take(name, default, A_COLUMN, as_column)

    def sub(self, name: str) -> "Section | None":
        """A table inside, or None where there is none."""
        self.known.append(name)
        return Section(self.content[name], self.where / name) if name in self.content else None

    def close(self) -> None:
        """Every field has been asked for: any other one is unknown."""
        for name in self.content:
            if name not in self.known:
                near = difflib.get_close_matches(name, self.known, 1)
                hint = f" (did you mean '{near[0]}'?)" if near else ""
                raise (self.where / name).error(
                    f"unknown field{hint}", f"one of {', '.join(self.known)}"
                )


A_COLUMN = "a column's name or its number, counted from 1"


def is_integer(value: object) -> bool:
    """Whether this is an integer and no boolean."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Whether this is a finite number and no boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)


# Each reader below gives the value in its final form, or None for what is not as expected.


def as_vector(value: object) -> tuple[float, float, float] | None:
    """Three numbers."""
    good = isinstance(value, list) and len(value) == 3 and all(is_number(v) for v in value)
    return tuple(float(v) for v in value) if good else None


def as_numbers(value: object) -> tuple[float, ...] | None:
    """One number or a list of numbers."""
    items = value if isinstance(value, list) else [value]
    return tuple(float(v) for v in items) if items and all(map(is_number, items)) else None


def as_column(value: object) -> Column | None:
    """A column's name or number."""
    if isinstance(value, str) and value:
        return value
    return value if is_integer(value) and value >= 1 else None


def as_columns(value: object) -> tuple[Column, ...] | None:
    """A list of columns."""
    items = [as_column(v) for v in value] if isinstance(value, list) else []
    return tuple(items) if items and None not in items else None


def as_columns_of(count: int) -> Callable[[object], tuple[Column, ...] | str | None]:
    """Reader of a list of this many columns, or of the name of a body or marker."""

    def read(value: object) -> tuple[Column, ...] | str | None:
        if isinstance(value, str) and value:
            return value
        found = as_columns(value)
        return found if found and len(found) == count else None

    return read


def as_texts(value: object) -> tuple[str, ...] | None:
    """A list of texts."""
    good = isinstance(value, list) and all(isinstance(v, str) for v in value)
    return tuple(value) if good else None


def as_separator(value: object) -> str | None:
    """One character or the word for any white space."""
    good = isinstance(value, str) and (value == "whitespace" or len(value) == 1)
    return value if good else None


def as_expression(value: object) -> str | None:
    """A regular expression with at least one group."""
    try:
        return value if isinstance(value, str) and re.compile(value).groups >= 1 else None
    except re.error:
        return None
