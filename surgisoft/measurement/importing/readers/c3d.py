"""C3D files of motion capture (c3d.org) as raw tables.

Markers are called by their labels, with columns `NAME.x` .. `NAME.z` in the unit of the file;
those that a frame lost (residual -1) are missing. Analog channels are columns by their labels, one
value for each frame: the mean of the samples in it. The column `t_s` counts from the first frame.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.apart import packed, read_apart, unpacked
from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.importing.readers.arrays import Arrays

TIME = "t_s"
"""Column of the time, s."""
PARAMETERS = 0x50
"""Second byte of a C3D file."""


def _is_c3d(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(2)
    return len(head) == 2 and head[1] == PARAMETERS


def _read(path: Path, _: FileRole) -> RawTable:
    if find_spec("ezc3d") is None:
        raise InputError(
            f"{path}: a C3D file needs the package ezc3d, which is not installed: "
            "pip install 'surgisoft[lab]'"
        )
    if not _is_c3d(path):
        raise InputError(f"{path}: its first bytes are not those of a C3D file; export it again")
    facts, (values,) = unpacked(read_apart(__name__, path, "a C3D file"))
    cells = Arrays(path, facts["names"], values)
    return RawTable(
        path, facts["names"], cells, unit=facts["unit"], markers=tuple(facts["markers"])
    )


def as_bytes(path: Path) -> bytes:
    """Names, unit, markers and cells of a file; the library may end the process on a bad one."""
    import ezc3d

    try:
        content = ezc3d.c3d(str(path))
    except Exception as error:  # the library raises what its parser meets
        raise InputError(f"{path}: cannot be read as a C3D file ({error})") from None
    point, analog = content["parameters"]["POINT"], content["parameters"].get("ANALOG", {})
    points = np.asarray(content["data"]["points"], np.float64)  # (4, n, T)
    frames = points.shape[2]
    if not frames:
        raise InputError(f"{path}: holds no frame, expected at least one; export it again")
    rate = float(content["header"]["points"]["frame_rate"])
    if not rate > 0.0:
        raise InputError(f"{path}: frame rate {rate:g} Hz, expected more than 0")
    markers = _labels(point, points.shape[1], "marker")
    positions = points[:3]  # NaN where the residual is negative, by ezc3d
    names, columns = [TIME], [np.arange(frames)[:, None] / rate]
    for number, marker in enumerate(markers):
        names += [f"{marker}.{axis}" for axis in "xyz"]
        columns.append(positions[:, number].T)
    voltages = np.asarray(content["data"]["analogs"], np.float64)[0]  # (channels, k T)
    if voltages.size:
        names += _labels(analog, len(voltages), "analog")
        columns.append(voltages.reshape(len(voltages), frames, -1).mean(axis=2).T)
    units = [text.strip() for text in point.get("UNITS", {}).get("value", [])]
    facts = {"names": names, "markers": markers, "unit": units[0] if units else "mm"}
    return packed(facts, np.hstack(columns))


def _labels(group: Any, count: int, other: str) -> list[str]:
    """Labels of so many channels; a missing one is called by its number, from 1."""
    given = [text.strip() for text in group.get("LABELS", {}).get("value", [])]
    given += [text.strip() for text in group.get("LABELS2", {}).get("value", [])]
    given += [""] * (count - len(given))
    return [text or f"{other}{i}" for i, text in enumerate(given[:count], 1)]


READER = Reader(
    "a C3D file (motion capture)", _read, suffixes=(".c3d",), fits=_is_c3d, states_unit=True
)
