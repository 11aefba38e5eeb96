"""TOML files as frozen dataclasses, read and written; a bad field gives a message of one line.

A field's type says what is expected: `float`, `int`, `str`, `bool`, a `Literal` of texts, a fixed
tuple such as `tuple[float, float, float]`, `tuple[X, ...]`, `dict[str, X]` (tables whose names are
free), another frozen dataclass, a union of these, `Any`, or any of them as
`Annotated[type, Rule(...)]`. Unknown fields are errors that name the known ones. A dataclass that
has a method `checked(where)` checks there what concerns several fields; it returns the value to
use, normally itself.

Reading is bounded: a file of any content ends in a value or in one line, never in a traceback.
"""

import dataclasses
import difflib
import functools
import math
import re
import reprlib
import tomllib
import types
import typing
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from surgisoft.errors import InputError
from surgisoft.files import resolved, write_atomically

LARGEST_BYTES = 1_000_000
"""A larger file is no configuration and is not parsed."""
DEEPEST_KEY = 100
"""A dotted key of more parts is refused."""
LARGEST_INTEGER = 2**63
"""Integers of TOML are smaller in size (TOML 1.0.0: 64-bit)."""


@dataclass(frozen=True)
class Rule:
    """A condition on a value beyond its type."""

    expected: str
    """Text that completes 'expected ...' in messages."""
    holds: typing.Callable[[typing.Any], bool]
    """Whether a value satisfies the rule."""


def one_of(names: typing.Iterable[str]) -> Rule:
    """Rule for one text of a list."""
    known = tuple(names)
    return Rule(f"one of {', '.join(known)}", lambda value: value in known)


def at_least(least: int) -> Rule:
    """Rule for an integer of at least this size."""
    return Rule(f"an integer >= {least}", lambda value: value >= least)


POSITIVE = Rule("a number > 0", lambda value: value > 0)
"""For lengths, times, rates."""


@dataclass(frozen=True)
class Where:
    """A field of a file, to name it in messages."""

    path: Path
    """Path of the file."""
    text: str = ""
    """Content of the file, to find the line; empty: without line."""
    keys: tuple[str | int, ...] = ()
    """Names and indices that lead to the field."""

    def __truediv__(self, key: str | int) -> "Where":
        return dataclasses.replace(self, keys=(*self.keys, key))

    @property
    def field(self) -> str:
        """Dotted name of the field, such as `mounts[1].tool`."""
        name = ""
        for key in self.keys:
            name += f"[{key}]" if isinstance(key, int) else f".{key}" if name else key
        return name

    def error(self, came: str, expected: str) -> InputError:
        """InputError in one line: file, line, field, what came and what was expected."""
        line = line_of(self.text, self.keys)
        place = f"{self.path}:{line}" if line else str(self.path)
        field = f"{_short(self.field)}: " if self.keys else ""
        return InputError(f"{place}: {field}{came}; expected {expected}")


def path_beside(where: Where, text: str, what: str) -> Path:
    """The file or folder that a field names, relative to its file; an InputError where none is."""
    try:
        found = resolved(resolved(where.path).parent / text)
        there = found.exists()
    except (OSError, ValueError):  # too long a name, a zero byte
        there = False
    if not there:
        raise where.error(f"there is no '{_short(text)}' beside this file", what)
    return found


def line_of(text: str, keys: tuple[str | int, ...]) -> int:
    """1-based line on which the field (or the nearest table above it) is written; 0 if unknown."""
    counts: dict[str, int] = {}
    table: tuple[str | int, ...] = ()
    best, best_depth = 0, 0
    for number, line in enumerate(text.splitlines(), start=1):
        here = table
        if header := re.match(r"\s*(\[\[?)([^\[\]#]+)\]\]?\s*(#.*)?$", line):
            name = header[2].strip()
            parts = [part.strip().strip("\"'") for part in name.split(".")]
            if header[1] == "[[":
                index = counts.get(name, -1) + 1
                counts[name] = index
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
        with path.open("rb") as file:
            content = file.read(LARGEST_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; expected a TOML file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; expected a TOML file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if len(content) > LARGEST_BYTES:
        raise InputError(f"{path}: larger than {LARGEST_BYTES} bytes; expected a TOML file")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text; expected a TOML file") from None
    return parse_toml(text, path), Where(path, text)


def parse_toml(text: str, path: Path) -> dict:
    """The tables of a TOML text; `path` is for the message about a text that is no TOML."""
    depth = 0
    for piece in text.split("."):  # tomllib takes quadratic time in the parts of a dotted key
        depth = depth + 1 if re.fullmatch(r"[^\n=,#\[\]{}]+", piece) else 0
        if depth > DEEPEST_KEY:
            raise InputError(f"{path}: not valid TOML: a key of more than {DEEPEST_KEY} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{path}: not valid TOML: nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, and integers of too many digits
        if found := re.search(r"immutable namespace \((.*)\) \(at line (\d+)", str(error)):
            names = re.findall(r"'([^']+)'", found[1])
            raise InputError(
                f"{path}:{found[2]}: not valid TOML: the table '{'.'.join(names)}' after a line "
                f"'{names[-1]} = ...'; expected one of the two: delete that line"
            ) from None
        raise InputError(f"{path}: not valid TOML: {_short(str(error), 200)}") from None


def from_table(kind: type, table: object, where: Where):
    """Build the frozen dataclass `kind` from a TOML table; the error names the first bad field."""
    if not isinstance(table, dict):
        raise where.error(f"got {describe(table)}", f"a table [{where.field}]")
    hints = _hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name in table:
        if name not in fields:
            near = difflib.get_close_matches(name[:100], fields, n=1)
            hint = f" (did you mean '{near[0]}'?)" if near else ""
            raise (where / name).error(f"unknown field{hint}", f"one of {', '.join(fields)}")
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _value(hints[name], table[name], where / name)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            table_of = f"a table [{(where / name).field}]"
            is_table = dataclasses.is_dataclass(_split(hints[name])[0])
            raise (where / name).error(
                "missing", table_of if is_table else expectation(hints[name])
            )
    built = kind(**values)
    return built.checked(where) if hasattr(built, "checked") else built


@functools.cache
def _hints(kind: type) -> dict[str, typing.Any]:
    """Types of the fields of a dataclass; to find them takes longer than to read a table."""
    return typing.get_type_hints(kind, include_extras=True)


def to_table(config: typing.Any) -> typing.Any:
    """The dataclass as dicts and lists, in the order of its fields; a path becomes text."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_table(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, dict):
        return {name: to_table(part) for name, part in config.items()}
    if isinstance(config, tuple | list):
        return [to_table(item) for item in config]
    return str(config) if isinstance(config, Path) else config


def without_empty_tables(kind: type, table: dict) -> dict:
    """The table of a dataclass `kind` without its lists of tables that are empty by default.

    A line `contours = []` would forbid to append `[[contours]]` to the file that is written.
    """
    kept = {}
    for field in dataclasses.fields(kind):
        if field.name not in table:
            continue
        value, base = table[field.name], _split(_hints(kind)[field.name])[0]
        parts = typing.get_args(base)
        if dataclasses.is_dataclass(base) and isinstance(value, dict):
            value = without_empty_tables(typing.cast(type, base), value)
        tables = typing.get_origin(base) is tuple and dataclasses.is_dataclass(_split(parts[0])[0])
        if not (tables and not value and field.default == ()):
            kept[field.name] = value
    return kept


def merged(base: typing.Any, changes: typing.Any) -> typing.Any:
    """A table with the fields of another one changed, at whatever depth they are."""
    if not (isinstance(base, dict) and isinstance(changes, dict)):
        return changes
    return base | {key: merged(base.get(key), value) for key, value in changes.items()}


COMMAND_LINE = Path("command line")
"""Place of assignments in messages."""


def assignments(given: typing.Iterable[str]) -> dict:
    """The tables of texts such as `follow.size_mm=12`; a value is TOML, or else plain text.

    A later assignment of a field replaces an earlier one.
    """
    table: dict = {}
    for text in given:
        name, equals, value = text.partition("=")
        keys = name.strip().split(".")
        if not equals or not all(re.fullmatch(r"[\w-]+", key) for key in keys):
            raise InputError(f"'{_short(text)}': expected FIELD=VALUE, such as world.dt_s=0.05")
        if len(keys) > DEEPEST_KEY:
            raise InputError(f"'{_short(text)}': a field of more than {DEEPEST_KEY} parts")
        try:
            found: typing.Any = tomllib.loads(f"value = {value}")["value"]
        except (ValueError, RecursionError):
            found = value.strip()
        for key in reversed(keys):
            found = {key: found}
        table = merged(table, found)
    return table


def differences(before: typing.Any, after: typing.Any) -> list[str]:
    """Lines `field: before -> after` for all fields of two dataclasses that differ."""
    return _differences(to_table(before), to_table(after), "")


def _differences(before: typing.Any, after: typing.Any, name: str) -> list[str]:
    if isinstance(before, dict) and isinstance(after, dict):
        keys = [*before, *(key for key in after if key not in before)]
        return [
            line
            for key in keys
            for line in _differences(before.get(key), after.get(key), f"{name}.{key}".lstrip("."))
        ]
    return [] if before == after else [f"{name}: {_shown(before)} -> {_shown(after)}"]


def _shown(value: typing.Any) -> str:
    return "none" if value is None else _short(_REPR.repr(value))


def field_names(config: typing.Any) -> list[str]:
    """Dotted names of all fields of a dataclass that hold a value, not a table."""
    return list(_field_names(to_table(config), ""))


def _field_names(table: dict, name: str) -> typing.Iterator[str]:
    for key, value in table.items():
        full = f"{name}.{key}".lstrip(".")
        if isinstance(value, dict) and value:
            yield from _field_names(value, full)
        else:
            yield full


def write_toml(path: Path, table: dict) -> None:
    """Write the table as TOML, short rows of numbers on one line; floats keep every bit."""
    text = re.sub(
        r"\[\n((?: +[-+.\w]+,\n)+) *\]",
        lambda rows: f"[{', '.join(re.findall(r'[-+.0-9A-Za-z_]+', rows[1]))}]",
        tomli_w.dumps(table),
    )
    write_atomically(path, text)


class _Repr(reprlib.Repr):
    """`repr` of values of any size and depth in a bounded number of characters."""

    def repr_int(self, value: int, level: int) -> str:
        if abs(value) >= LARGEST_INTEGER:
            return f"of {value.bit_length()} bits"
        return repr(value)


_REPR = _Repr()
_REPR.maxlist = _REPR.maxdict = 20
_REPR.maxstring = _REPR.maxother = 80


def _short(text: str, most: int = 100) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def describe(value: object) -> str:
    """A value with its type as text, short enough for one line of a message."""
    names = {bool: "boolean", int: "integer", float: "number", str: "text"}
    if isinstance(value, dict):
        return value_text(value)
    kind = names.get(type(value), "a list" if isinstance(value, list) else "value")
    return f"{kind} {value_text(value)}"


def value_text(value: object) -> str:
    """A value as text, short enough for one line of a message: 0, 'kPa', true, [1, 2]."""
    if isinstance(value, dict):
        return "a table"
    text = _REPR.repr(value) if not isinstance(value, bool) else str(value).lower()
    return _short(text, 60)


def expectation(hint: typing.Any) -> str:
    """The type and its rules in words."""
    base, rules = _split(hint)
    if rules:
        return " and ".join(rule.expected for rule in rules)
    words = {float: "a number", int: "an integer", str: "text", bool: "true or false"}
    words |= {Path: "text", typing.Any: "a value"}
    parts = typing.get_args(base)
    if base in words:
        return words[base]
    if dataclasses.is_dataclass(base):
        return "a table"
    if _is_union(base):
        known = [expectation(part) for part in parts if part is not types.NoneType]
        return " or ".join(dict.fromkeys(known))
    origin = typing.get_origin(base)
    if origin is typing.Literal:
        return f"one of {', '.join(parts)}" if len(parts) > 1 else f'"{parts[0]}"'
    if origin is dict:
        return f"a table, each entry {expectation(parts[1])}"
    if parts[-1] is Ellipsis:
        return f"a list, each {expectation(parts[0])}"
    return f"{len(parts)} numbers" if set(parts) == {float} else f"a list of {len(parts)}"


def _split(hint: typing.Any) -> tuple[typing.Any, tuple[Rule, ...]]:
    if typing.get_origin(hint) is typing.Annotated:
        base, *extra = typing.get_args(hint)
        return base, tuple(rule for rule in extra if isinstance(rule, Rule))
    return hint, ()


def _is_union(base: typing.Any) -> bool:
    return typing.get_origin(base) in (typing.Union, types.UnionType)


def _value(hint: typing.Any, value: object, where: Where, stated: typing.Any = None):
    """The value as `hint` asks for; messages state what `stated` (default: the hint) asks for."""
    base, rules = _split(hint)
    stated = hint if stated is None else stated

    def bad() -> InputError:
        return where.error(f"got {describe(value)}", expectation(stated))

    if base is typing.Any:
        converted = value
    elif dataclasses.is_dataclass(base):
        converted = from_table(typing.cast(type, base), value, where)
    elif _is_union(base):
        part = next((part for part in typing.get_args(base) if _admits(part, value)), None)
        if part is None:
            raise bad()
        converted = None if part is types.NoneType else _value(part, value, where, stated)
    elif typing.get_origin(base) is dict:
        if not isinstance(value, dict):
            raise bad()
        kind = typing.get_args(base)[1]
        converted = {name: _value(kind, part, where / name) for name, part in value.items()}
    elif typing.get_origin(base) is tuple:
        converted = _tuple(typing.get_args(base), value, where, bad)
    elif not _admits(base, value):
        raise bad()
    elif base is float:
        converted = _float(value, bad)
        if not math.isfinite(converted):
            raise where.error(f"got {converted}", f"a finite number ({expectation(stated)})")
    else:
        converted = value
    if not all(rule.holds(converted) for rule in rules):
        raise bad()
    return converted


def _admits(hint: typing.Any, value: object) -> bool:
    """Whether a value is of the kind that a type asks for: text, number, list, table."""
    base, _ = _split(hint)
    origin = typing.get_origin(base)
    if base is typing.Any:
        return True
    if _is_union(base):
        return any(_admits(part, value) for part in typing.get_args(base))
    if origin is typing.Literal:
        return isinstance(value, str) and value in typing.get_args(base)
    if origin is tuple:
        return isinstance(value, list | tuple)
    if origin is dict or dataclasses.is_dataclass(base):
        return isinstance(value, dict)
    if isinstance(value, bool):
        return base is bool
    if base is int:
        return isinstance(value, int) and abs(value) < LARGEST_INTEGER
    return isinstance(value, int | float) if base is float else isinstance(value, base)


def _float(value: typing.Any, bad: typing.Callable[[], InputError]) -> float:
    try:
        return float(value)
    except OverflowError:
        raise bad() from None


def _tuple(
    parts: tuple, value: object, where: Where, bad: typing.Callable[[], InputError]
) -> tuple:
    if not isinstance(value, list | tuple):
        raise bad()
    if parts[-1] is Ellipsis:
        return tuple(_value(parts[0], item, where / i) for i, item in enumerate(value))
    if len(value) != len(parts):
        raise bad()
    return tuple(
        _value(part, item, where / i)
        for i, (part, item) in enumerate(zip(parts, value, strict=True))
    )
