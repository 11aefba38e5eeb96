"""MATLAB and HDF5 files as raw tables: arrays of equally many rows, by their paths.

Arrays inside groups or structs are called by their path, `bench.pressure`. A column of an array of
several columns has its number behind, counted from 0: `bench.pressure.2`, `markers.0.1`. Fields of
compound types are columns by their names. The rows are those of the longest vector, usually the
time; arrays of which no axis is as long are left out, and said so. `topic` in the map's table
[file.NAME] names a group or struct to which the file is limited.

MATLAB files of version 7.3 are HDF5; older ones are read by SciPy.
"""

import importlib.util
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.apart import packed, read_apart, unpacked
from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.parquet_pages import MOST_PACKED, MOST_UNPACKED

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file without a user block."""
USER_BLOCK = 512
"""Bytes before them in a MATLAB file of version 7.3."""
MOST_COLUMNS = 500
"""An array of more columns is no table of measurements (an image, a mesh) and is left out."""


class Arrays:
    """Cells (T, c) of arrays side by side."""

    def __init__(self, path: Path, names: Sequence[str], values: np.ndarray) -> None:
        self.path, self.names, self.values = path, list(names), values

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        """Cells (T, len(positions)) of columns counted from 0, NaN where missing."""
        return self.values[:, list(positions)]

    def texts(self, position: int) -> list[str]:
        """Cells (T,) of one column as text."""
        return [repr(float(value)) for value in self.values[:, position]]

    def place(self, row: int) -> str:
        """Where a row, counted from 0, is in the file."""
        return f"{self.path}, row {row + 1}"


def _read_hdf5(path: Path, role: FileRole) -> RawTable:
    if importlib.util.find_spec("h5py") is None:
        raise InputError(
            f"{path}: an HDF5 file needs the package h5py, which is not installed: "
            "pip install 'surgisoft[lab]'"
        )
    return _apart(path, role, "an HDF5 file")


def _read_matlab(path: Path, role: FileRole) -> RawTable:
    return _read_hdf5(path, role) if _is_hdf5(path) else _apart(path, role, "a MATLAB file")


def _apart(path: Path, role: FileRole, what: str) -> RawTable:
    names, found = unpacked(read_apart(__name__, path, what))
    return _table(path, role, dict(zip(names, found, strict=True)))


def as_bytes(path: Path) -> bytes:
    """Paths and arrays of a file; SciPy and HDF5 may end the process on a damaged one."""
    found = dict(_hdf5(path) if _is_hdf5(path) else _matlab(path))
    size, held = path.stat().st_size, sum(array.nbytes for array in found.values())
    if held > _most(size):
        raise InputError(
            f"{path}: holds {held} bytes of numbers, packed in {size}; expected a file with "
            "measurements, which do not compress as much"
        )
    return packed(list(found), *found.values())


def _most(size: int) -> int:
    """Most bytes of numbers that are taken from a file of so many bytes."""
    return max(MOST_UNPACKED, MOST_PACKED * size)


def _matlab(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """(path, array) of every array of numbers of a MATLAB file before version 7.3."""
    from scipy.io import loadmat

    try:
        content = loadmat(path, simplify_cells=True, mat_dtype=True)
    except MemoryError:
        raise InputError(
            f"{path}: unpacks to more memory than is allowed for a file of {path.stat().st_size} "
            "bytes; expected a file with measurements, which do not compress as much"
        ) from None
    except Exception as error:  # SciPy raises what its parser meets
        raise InputError(
            f"{path}: cannot be read as a MATLAB file ({type(error).__name__}: {error})"
        ) from None
    fields = {name: value for name, value in content.items() if not name.startswith("__")}
    yield from _inside(fields, "")


def _hdf5(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """(path, array) of every numeric dataset of a file."""
    import h5py

    found: list[tuple[str, np.ndarray]] = []
    left = _most(path.stat().st_size)

    def visit(name: str, item: Any) -> None:
        nonlocal left
        if not isinstance(item, h5py.Dataset) or item.shape is None or item.dtype.hasobject:
            return
        if item.external or item.is_virtual:  # the numbers are in other files
            return
        held = max(item.nbytes, 8 * item.size)  # as they are packed, and as 64-bit numbers
        left -= held
        if left < 0:
            raise InputError(
                f"{path}: '{name}' claims {held} bytes, in a file of "
                f"{path.stat().st_size}; expected an HDF5 file with measurements"
            )
        found.extend(_inside(item[()], name.replace("/", ".")))

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
    except OSError as error:
        raise InputError(f"{path}: cannot be read as an HDF5 file ({error})") from None
    yield from found


def _inside(value: Any, path: str) -> Iterator[tuple[str, np.ndarray]]:
    """(path, array) of every array of numbers inside a value."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _inside(inner, f"{path}.{name}" if path else str(name))
        return
    array = np.asarray(value)
    if array.dtype.names:
        for name in array.dtype.names:
            yield from _inside(array[name], f"{path}.{name}")
    elif array.dtype.kind in "biuf" and array.size > 1:
        yield path, array.astype(np.float64)


def _table(path: Path, role: FileRole, arrays: dict[str, np.ndarray]) -> RawTable:
    """The arrays of a file that have one row for each sample."""
    if role.topic:
        group = role.topic.strip("/").replace("/", ".")
        chosen = {n: a for n, a in arrays.items() if n == group or n.startswith(f"{group}.")}
        if not chosen:
            known = ", ".join(sorted({name.partition(".")[0] for name in arrays})) or "none"
            raise InputError(f"{path}: no group or struct '{role.topic}', expected one of {known}")
        arrays = {name.removeprefix(f"{group}."): array for name, array in chosen.items()}
    if not arrays:
        raise InputError(f"{path}: no array of numbers in it, expected time and measurements")
    vectors = [array.size for array in arrays.values() if max(array.shape) == array.size]
    rows = max(vectors, default=max(max(array.shape) for array in arrays.values()))
    names, columns, left = [], [], []
    for name, array in arrays.items():
        if rows not in array.shape or array.size // rows > MOST_COLUMNS:
            left.append(f"{name} ({' x '.join(map(str, array.shape))})")
            continue
        turned = np.moveaxis(array, array.shape.index(rows), 0)
        shape = tuple(size for size in turned.shape[1:] if size > 1)
        flat = turned.reshape(rows, math.prod(shape))
        places = [".".join(map(str, place)) for place in np.ndindex(shape)] if shape else [""]
        names += [f"{name}.{place}" if place else name for place in places]
        columns.append(flat)
    notes: tuple[str, ...] = ()
    if left:
        shown = ", ".join(left[:5]) + (", ..." if len(left) > 5 else "")
        notes = (f"left out, no axis has the {rows} rows of the longest vector: {shown}",)
    return RawTable(path, names, Arrays(path, names, np.hstack(columns)), notes=notes)


def _is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, with the user block of MATLAB 7.3 or without."""
    with path.open("rb") as file:
        head = file.read(USER_BLOCK + len(HDF5_MAGIC))
    return HDF5_MAGIC in (head[: len(HDF5_MAGIC)], head[USER_BLOCK:])


HDF5 = Reader("an HDF5 file", _read_hdf5, suffixes=(".h5", ".hdf5"), fits=_is_hdf5)
MATLAB = Reader("a MATLAB file", _read_matlab, suffixes=(".mat",))
