"""OptiTrack Motive's CSV export as a raw table.

The header is a line of keys and values, then lines that say for each column the type of the asset,
its name, its id (and parent), what is measured, and the axis; the numbers follow the line of axes.
Format versions 1.1 to 1.25 differ in which of these lines they have and how they label them:
Motive documentation, Data Export: CSV, https://docs.optitrack.com/motive/data-export.
"""

import csv
from dataclasses import replace
from pathlib import Path

from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.importing.readers.text import table_of_body
from surgisoft.measurement.tables import read_text

_UNITS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}
_HEADER_LINES = 30
_AXES = {"Position": "", "Rotation": "q"}
_PREFERRED = ("Marker", "Rigid Body", "Bone", "Rigid Body Marker", "Bone Marker")
"""Where a name comes twice: markers as measured go before markers as solved for."""


def _fits(path: Path) -> bool:
    """Whether the file begins as Motive's export does."""
    try:
        with path.open("rb") as file:
            if file.read(2) == b"\x1f\x8b":
                return read_text(path).startswith(b"Format Version,")
            file.seek(0)
            return file.read(64).removeprefix(b"\xef\xbb\xbf").startswith(b"Format Version,")
    except OSError:
        return False


def _read(path: Path, role: FileRole) -> RawTable:
    """Columns are called Frame, Time, NAME.x, NAME.y, NAME.z, and NAME.qx .. NAME.qw of a body."""
    data = read_text(path)
    if not data.startswith(b"Format Version,"):
        raise InputError(f"{path}: no 'Format Version' at the start, expected a Motive CSV export")
    lines = data.split(b"\n", _HEADER_LINES)
    rows = [next(csv.reader([line.decode("utf-8", "replace")]), []) for line in lines[:-1]]
    axes = next((i for i, row in enumerate(rows) if row and row[0].strip() == "Frame"), None)
    if axes is None:
        raise InputError(
            f"{path}: no line that starts with 'Frame' in the header, "
            "expected a Motive CSV export with its header information"
        )
    head = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    names, kinds = _columns(rows, axes, head.get("Rotation Type", "Quaternion") == "Quaternion")
    body = b"\n".join(lines[axes + 1 :])
    raw = table_of_body(path, role, names, body, axes + 2)
    return replace(
        raw,
        names=[*names, *raw.names[len(names) :]],
        unit=_unit(path, head),
        bodies=tuple(name for name, kind in kinds.items() if kind in ("Rigid Body", "Bone")),
        markers=tuple(name for name, kind in kinds.items() if "Marker" in kind),
    )


def _unit(path: Path, head: dict[str, str]) -> str:
    stated = head.get("Length Units", "Meters")
    if stated not in _UNITS:
        raise InputError(
            f"{path}, line 1: length unit '{stated}', expected one of {', '.join(_UNITS)}; "
            "export the take again"
        )
    return _UNITS[stated]


def _columns(
    rows: list[list[str]], axes: int, quaternions: bool
) -> tuple[list[str], dict[str, str]]:
    """Names of the columns, and the type of each asset by its name."""
    count = len(rows[axes])
    padded = [row + [""] * (count - len(row)) for row in rows[1:axes] if any(row)]
    if len(padded) < 3:
        padded = [[""] * count] * 3
    types, assets, measured = padded[0], padded[1], padded[-1]
    kinds = _kinds(types, assets)
    names = [rows[axes][0].strip(), _time_name(rows[axes])]
    for i in range(2, count):
        asset, axis = assets[i].strip().strip('"'), rows[axes][i].strip().lower()
        part = _AXES.get(measured[i].strip())
        usable = part is not None and kinds.get(asset) == types[i].strip()
        if part == "q" and not quaternions:
            part = "euler_"
        names.append(f"{asset}.{part}{axis}" if usable and asset else "")
    return names, kinds


def _time_name(axes: list[str]) -> str:
    return "Time" if len(axes) > 1 and axes[1].strip().lower().startswith("time") else ""


def _kinds(types: list[str], assets: list[str]) -> dict[str, str]:
    """The type that is used of each name: the first of the preferred ones that it has."""
    found: dict[str, set[str]] = {}
    for kind, asset in zip(types[2:], assets[2:], strict=True):
        if asset.strip():
            found.setdefault(asset.strip().strip('"'), set()).add(kind.strip())
    order = {kind: i for i, kind in enumerate(_PREFERRED)}
    return {
        asset: min(kinds, key=lambda kind: (order.get(kind, len(order)), kind))
        for asset, kinds in found.items()
    }


READER = Reader("a Motive CSV export", _read, fits=_fits, states_unit=True)
