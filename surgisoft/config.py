"""Read a TOML table into a frozen dataclass and write it back; every bad field gets its own line.

A field's type says what is expected: `float`, `int`, `str`, `bool`, a fixed tuple such as
`tuple[float, float, float]`, `tuple[X, ...]`, another frozen dataclass, or any of these as
`Annotated[type, Rule(...)]`. Unknown fields are errors that name the known ones.
"""

import dataclasses
import difflib
import math
import re
import tomllib
import types
import typing
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from surgisoft.errors import InputError
from surgisoft.files import write_atomically


@dataclass(frozen=True)
class Rule:
    """What a value must hold beyond its type; the text completes 'expected ...'."""

    expected: str
    holds: typing.Callable[[object], bool]


@dataclass(frozen=True)
class Where:
    """A place in a file, for messages."""

    path: Path
    text: str = ""
    keys: tuple[str | int, ...] = ()

    def __truediv__(self, key: str | int) -> "Where":
        return dataclasses.replace(self, keys=(*self.keys, key))

    @property
    def field(self) -> str:
        """The dotted name, `mounts[1].tool`."""
        name = ""
        for key in self.keys:
            name += f"[{key}]" if isinstance(key, int) else f".{key}" if name else key
        return name

    def error(self, came: str, expected: str) -> InputError:
        """One line: file, line, field, what came, what was expected."""
        line = line_of(self.text, self.keys)
        place = f"{self.path}:{line}" if line else str(self.path)
        return InputError(f"{place}: {self.field}: {came}; expected {expected}")


def line_of(text: str, keys: tuple[str | int, ...]) -> int:
    """1-based line on which the field (or the nearest table above it) is written; 0 if unknown."""
    counts: dict[str, int] = {}
    table: tuple[str | int, ...] = ()
    best, best_depth = 0, 0
    for number, line in enumerate(text.splitlines(), start=1):
        here = table
        if header := re.match(r"\s*(\[\[?)\s*([\w.\"' -]+?)\s*\]\]?\s*(#.*)?$", line):
            parts = [part.strip().strip("\"'") for part in header[2].split(".")]
            if header[1] == "[[":
                index = counts.get(header[2], -1) + 1
                counts[header[2]] = index
                parts = [*parts, index]
            here = table = tuple(parts)
        elif entry := re.match(r"\s*[\"']?([\w.-]+)[\"']?\s*=", line):
            here = (*table, *entry[1].split("."))
        else:
            continue
        if len(here) > best_depth and keys[: len(here)] == here:
            best, best_depth = number, len(here)
        elif not best and here[: len(keys)] == keys:
            best = number
    return best


def read_toml(path: Path) -> tuple[dict, Where]:
    """The parsed file and its place; a file that cannot be parsed is one line."""
    try:
        text = path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; expected a TOML file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; expected a TOML file") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text; expected a TOML file") from None
    try:
        return tomllib.loads(text), Where(path, text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


def from_table(kind: type, table: object, where: Where):
    """Build the frozen dataclass `kind` from a TOML table; the error names the first bad field."""
    if not isinstance(table, dict):
        raise where.error(f"got {describe(table)}", "a table")
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name in table:
        if name not in fields:
            near = difflib.get_close_matches(name, fields, n=1)
            hint = f" (did you mean '{near[0]}'?)" if near else ""
            raise (where / name).error(f"unknown field{hint}", f"one of {', '.join(fields)}")
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _value(hints[name], table[name], where / name)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise (where / name).error("missing", expectation(hints[name]))
    return kind(**values)


def to_table(config) -> dict:
    """The dataclass as nested dicts and lists, in the order of its fields."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_table(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, tuple):
        return [to_table(item) for item in config]
    return config


def write_toml(path: Path, table: dict) -> None:
    """Write the table as TOML, short rows of numbers on one line; floats keep every bit."""
    text = re.sub(
        r"\[\n((?: +[-+.\w]+,\n)+) *\]",
        lambda rows: f"[{', '.join(re.findall(r'[-+.0-9A-Za-z_]+', rows[1]))}]",
        tomli_w.dumps(table),
    )
    write_atomically(path, text)


def describe(value: object) -> str:
    """What came, short enough for one line."""
    names = {bool: "boolean", int: "integer", float: "number", str: "text", dict: "a table"}
    if isinstance(value, dict):
        return "a table"
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    text = text if len(text) <= 60 else text[:57] + "..."
    return f"{names.get(type(value), 'a list' if isinstance(value, list) else 'value')} {text}"


def expectation(hint) -> str:
    """The type and its rules in words."""
    base, rules = _split(hint)
    if rules:
        return " and ".join(rule.expected for rule in rules)
    words = {float: "a number", int: "an integer", str: "text", bool: "true or false"}
    if base in words:
        return words[base]
    if dataclasses.is_dataclass(base):
        return "a table"
    parts = typing.get_args(base)
    if isinstance(base, types.UnionType):
        known = {words.get(part, "text" if part is Path else "nothing") for part in parts}
        return " or ".join(sorted(known, reverse=True))
    if parts[-1] is Ellipsis:
        return f"a list, each {expectation(parts[0])}"
    return f"{len(parts)} numbers" if set(parts) == {float} else f"a list of {len(parts)}"


def _split(hint) -> tuple[object, tuple[Rule, ...]]:
    if typing.get_origin(hint) is typing.Annotated:
        base, *extra = typing.get_args(hint)
        return base, tuple(rule for rule in extra if isinstance(rule, Rule))
    return hint, ()


def _value(hint, value: object, where: Where):
    base, rules = _split(hint)
    bad = where.error(f"got {describe(value)}", expectation(hint))
    if dataclasses.is_dataclass(base):
        return from_table(base, value, where)
    if typing.get_origin(base) is tuple:
        converted = _tuple(typing.get_args(base), value, where, bad)
    elif base is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise bad
        try:
            converted = float(value)
        except OverflowError:
            raise bad from None
        if not math.isfinite(converted):
            raise where.error(f"got {converted}", f"a finite number ({expectation(hint)})")
    elif isinstance(value, base) and isinstance(value, bool) == (base is bool):
        converted = value
    else:
        raise bad
    if not all(rule.holds(converted) for rule in rules):
        raise bad
    return converted


def _tuple(parts: tuple, value: object, where: Where, bad: InputError) -> tuple:
    if not isinstance(value, list | tuple):
        raise bad
    if parts[-1] is Ellipsis:
        return tuple(_value(parts[0], item, where / i) for i, item in enumerate(value))
    if len(value) != len(parts):
        raise bad
    return tuple(
        _value(part, item, where / i)
        for i, (part, item) in enumerate(zip(parts, value, strict=True))
    )
