"""Columns that a map names: each is used once, and no name states another unit than the map."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import Column, RawTable
from surgisoft.measurement.importing.spec import ActuationMap, ImportMap
from surgisoft.measurement.tables import label
from surgisoft.measurement.units import same_unit, unit_named

IN_BRACKETS = re.compile(r"[\[(]([^\[\]()]+)[\])]\s*$")
"""A unit at the end of a column's name: `P1 [kPa]`, `time (ms)`."""


@dataclass(frozen=True)
class Use:
    """One use of a column in a map."""

    role: str
    """Role of the file."""
    column: Column
    """The column, by its name or number."""
    table: str
    """Table of the map."""
    unit: str = ""
    """Unit that the map states for it; empty where it states none, or scales the values."""
    axis: str = ""
    """Axis of a key point that it gives; empty for other uses."""

    def may_repeat(self, other: "Use") -> bool:
        """Whether one column can have both uses.

        A log without sensors has one in [measured] and [commanded], an arm that moves in a plane
        one axis for all key points.
        """
        logged = {self.table, other.table} == {"measured", "commanded"}
        return logged or (self.axis != "" and self.axis == other.axis)


def uses(spec: ImportMap, measured: ActuationMap, commanded: ActuationMap | None) -> list[Use]:
    """The uses of columns as actuation, positions and time; names of bodies and markers are none.

    measured, commanded: with the columns that the map leaves to their names.
    """
    found = []
    time, points = spec.time, spec.key_points
    for name, part in (("measured", measured), ("commanded", commanded)):
        if part is not None:
            own = part.scale is None and part.offset is None
            unit = part.unit if own else ""
            found += [Use(part.file, column, name, unit) for column in part.columns]
    unit = (points.unit or "") if points.scale == 1.0 else ""
    for position in points.positions:
        if not isinstance(position, str):
            triple = zip("xyz", position, strict=True)
            found += [Use(points.file, column, "key_points", unit, axis) for axis, column in triple]
    if time.column is not None:
        own = time.rate_hz is None and time.scale == 1.0 and time.unit != "iso"
        found.append(Use(spec.main, time.column, "time", time.unit if own else ""))
    return found


def check_columns(given: list[Use], tables: Mapping[str, RawTable]) -> list[str]:
    """Notes on names that state another unit of the same quantity than the map.

    Raises InputError where one column is used twice (`Use.may_repeat`), where two key points have
    the same columns, or where a name states a unit of another quantity.
    """
    contradictions: dict[tuple[str, str, str], list[str]] = {}
    for use, name in _named(given, tables):
        found = IN_BRACKETS.search(name)
        stated = unit_named(found[1]) if found else None
        same = same_unit(stated, use.unit) if stated and use.unit else True
        if same is None:
            raise InputError(
                f"{tables[use.role].path}: column '{name}' states {stated}, expected a column in "
                f'{use.unit} as unit = "{use.unit}" in [{use.table}] of the map says; name another '
                "column, or state scale for values that the map converts"
            )
        if not same:
            contradictions.setdefault((use.table, use.unit, stated or ""), []).append(name)
    _check_used_once(given, tables)
    return [
        f"the name of column '{names[0]}'{f' and {len(names) - 1} more' if names[1:] else ''} "
        f'states {stated}, but the map unit = "{unit}" in [{table}]: if the name is right, set '
        f'unit = "{stated}"'
        for (table, unit, stated), names in contradictions.items()
    ]


def _named(given: list[Use], tables: Mapping[str, RawTable]) -> Iterator[tuple[Use, str]]:
    """Each use with the name of its column; empty where it has none."""
    for use in given:
        table = tables[use.role]
        yield use, table.names[table.position(use.column)]


def _check_used_once(given: list[Use], tables: Mapping[str, RawTable]) -> None:
    used: dict[tuple[str, int], Use] = {}
    points: dict[tuple[int, ...], int] = {}
    places = [(use.role, tables[use.role].position(use.column)) for use in given]
    for use, place in zip(given, places, strict=True):
        table = tables[use.role]
        first = used.setdefault(place, use)
        if first is use or first.may_repeat(use):
            continue
        where = " and ".join(f"[{name}]" for name in dict.fromkeys((first.table, use.table)))
        raise InputError(
            f"{table.path}: column {label(table.names, place[1])} is used twice, in {where} of the "
            "map, expected another column for each time, channel and axis"
        )
    axes = [place for use, place in zip(given, places, strict=True) if use.axis]
    for k in range(0, len(axes), 3):
        same = points.setdefault(tuple(at for _, at in axes[k : k + 3]), k // 3)
        if same != k // 3:
            raise InputError(
                f"{tables[axes[k][0]].path}: key points {same} and {k // 3} of the map have the "
                "same three columns, expected others for each"
            )
