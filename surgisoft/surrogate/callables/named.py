"""Callable models by name: `package.module:object`, `FILE.py:object`, or an entry point.

A callable is code. It is imported only if the user named it, or if an installed package offers it
in the entry point group `surgisoft.models`. A model folder that holds one states its name and is
refused until the user has named it, too.
"""

import functools
import hashlib
import importlib
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from surgisoft.errors import InputError, raised_at, raised_by
from surgisoft.files import resolved
from surgisoft.python_files import run_file

GROUP = "surgisoft.models"
"""Entry point group of callable models in installed packages."""


@dataclass(frozen=True, eq=False)
class Named:
    """A callable model and where it comes from."""

    name: str
    """`package.module:object`, `FILE.py:object`, or the name of an entry point; for an object that
    was given in Python and that no name leads to: its class."""
    model: Any
    """The object: it is called with times (T,) in s and actuation (T, m)."""
    sha256: str | None = None
    """Hash of the file's bytes, for `FILE.py:object`."""
    found: bool = True
    """Whether the name leads to the object, so that a saved model can be opened again."""
    file: Path | None = None
    """The file itself, for `FILE.py:object`: another folder may hold another of that name."""


NAMED: dict[str, Named] = {}
"""Callables that the user has named, by name."""


def offered() -> dict[str, EntryPoint]:
    """Entry points of callable models in installed packages by name; none is loaded."""
    return _offered(tuple(sys.path))


@functools.cache
def _offered(path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Those while the search path is this one: reading them takes 5 ms."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def is_callable_name(text: str) -> bool:
    """Whether a text names a callable: `package.module:object`, `FILE.py:object`, entry point."""
    if Path(text).exists():
        return False
    head, colon, attribute = text.rpartition(":")
    dotted = all(part.isidentifier() for part in head.split("."))
    if colon and attribute.replace(".", "").isidentifier() and (dotted or head.endswith(".py")):
        return True
    return text in offered()


def no_graph(name: str) -> InputError:
    """The InputError for an export of the callable of a name."""
    return InputError(
        f"{name} is a Python callable, which cannot be written as a graph (ONNX, TorchScript): "
        "expected a model that 'surgisoft fit' made; fit one to recordings of the arm "
        "('surgisoft fit REC -o MODEL') and export that, or call the callable itself from Python"
    )


def named_callable(name: str) -> Named:
    """Import the callable of a name, which runs its code, and remember it as named by the user.

    A file is run again if its content has changed since. Raises InputError where the callable
    cannot be imported, is not there or is no callable.
    """
    head, colon, attribute = name.rpartition(":")
    known, sha256, file = NAMED.get(name), None, None
    if known is not None and known.file is None:
        return known
    if not colon:
        entry = offered().get(name)
        if entry is None:
            every = ", ".join(sorted(offered())) or "none"
            raise InputError(
                f"{name}: no callable model of that name; expected package.module:object, "
                f"FILE.py:object or an entry point of the group {GROUP} (known: {every})"
            )
        value = _guarded(name, entry.load)
    elif head.endswith(".py"):
        path = Path(head)
        if not path.is_file():
            raise InputError(f"{head}: no such file; name a .py file and an object: FILE.py:object")
        content, file = path.read_bytes(), resolved(path)
        sha256 = hashlib.sha256(content).hexdigest()
        if known is not None and (known.file, known.sha256) == (file, sha256):
            return known
        module = _guarded(name, lambda: run_file(path, content, "surgisoft_model"))
        value = _attribute(name, module, attribute)
    else:
        here = str(Path.cwd())
        if here not in sys.path:
            sys.path.append(here)
        value = _attribute(name, _guarded(name, lambda: importlib.import_module(head)), attribute)
    if isinstance(value, type):
        kind = value
        value = _guarded(name, lambda: kind())
    _check(name, value)
    NAMED[name] = Named(name, value, sha256, file=file)
    return NAMED[name]


def given_callable(model: Any) -> Named:
    """A callable that Python code gives as an object, with the name that leads to it, if any."""
    kind = model if hasattr(model, "__qualname__") else type(model)
    _check(kind.__qualname__, model)
    for named in NAMED.values():
        if named.model is model:
            return named
    module = sys.modules.get(kind.__module__)
    if module is not None and kind.__module__ != "__main__":
        for attribute, value in vars(module).items():
            if value is model:
                named = Named(f"{kind.__module__}:{attribute}", model)
                NAMED[named.name] = named
                return named
    return Named(f"{kind.__module__}:{kind.__qualname__}", model, None, found=False)


def stored_callable(name: str, sha256: str | None, label: str) -> Named:
    """The callable of a model folder, which the user must have named, or a package offers.

    label: what a message calls the folder.
    """
    alike = [
        named
        for named in NAMED.values()
        if named.name == name or (sha256 is not None and named.sha256 == sha256)
    ]
    wanted = name.rpartition(":")[2]
    alike = [named for named in alike if named.name.rpartition(":")[2] == wanted]
    if not alike and ":" not in name and name in offered():
        alike = [named_callable(name)]
    if not alike:
        place = _placed(name, label)
        raise InputError(
            f"{label}: its model is code, {name}, which opening a folder does not import; if you "
            f"trust it, name it: --model-code {place} (in Python: "
            f"load_model(folder, model_code=['{place}']))"
        )
    found = alike[0]
    if sha256 is not None and found.sha256 != sha256:
        raise InputError(
            f"{label}: {found.name} is not the file that the model was made with (sha256 "
            f"{(found.sha256 or 'unknown')[:12]}, expected {sha256[:12]}); name the same file, or "
            "amend the model again"
        )
    return found


def _placed(name: str, folder: str) -> str:
    """The name of a callable with the path of its file where that is beside or in the model's
    folder and not where the name has it; else the name as it is."""
    head, colon, attribute = name.rpartition(":")
    places = [Path(folder).parent / head, Path(folder) / head]
    if head.endswith(".py") and not Path(head).is_file():
        name = next((f"{each}{colon}{attribute}" for each in places if each.is_file()), name)
    return name


def name_callables(names: Iterable[str]) -> None:
    """Import callables of these names, as `named_callable` imports one."""
    for name in names:
        named_callable(str(name))


def named_callables() -> list[str]:
    """Names of the callables that were imported by name: a new process has to do the same."""
    return list(NAMED)


def as_numbers(value: Any) -> np.ndarray:
    """What a callable returned, as an array of float64 of its own: a callable may use its array
    again for the next answer. A tensor of PyTorch loses its graph.

    Raises TypeError, ValueError or RuntimeError where it is no array of numbers.
    """
    if callable(getattr(value, "detach", None)):
        value = value.detach().cpu().numpy()
    return np.array(value, np.float64)


def checked_points(
    name: str, points: Any, rows: tuple[int, ...], chambers: int, key_points: int | None
) -> np.ndarray:
    """Key points (*rows, n, 3) in mm that a callable returned, or InputError.

    rows: leading shape; chambers: m of the actuation that it was given; key_points: n, if known.
    """
    try:
        points = as_numbers(points)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(
            f"{name}: returned {type(points).__name__}, expected key points as an array of numbers"
        ) from None
    wide = len(rows) + 2
    fits = points.ndim == wide and points.shape[: len(rows)] == rows and points.shape[-1] == 3
    fits = fits and points.shape[-2] > 0 and key_points in (None, points.shape[-2])
    if not fits:
        expected = (*rows, "n" if key_points is None else key_points, 3)
        shown = ", ".join(map(str, expected))
        raise InputError(
            f"{name}: returned shape {points.shape}, expected ({shown}) for actuation "
            f"{(*rows, chambers)}: rows, key points base to tip, x y z in mm"
        )
    bad = ~np.isfinite(points).reshape(*rows, -1).all(-1)
    if bad.any():
        row = np.argwhere(bad)[0].tolist()
        raise InputError(
            f"{name}: key points of row {row[-1]} are not finite, {int(bad.sum())} such rows of "
            f"{bad.size}; correct the model"
        )
    return points


def read_attribute(name: str, model: Any, attribute: str) -> Any:
    """The attribute of a callable, None without it; a property that raises is an InputError."""
    try:
        return getattr(model, attribute, None)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise raised_by(f"{name}, attribute '{attribute}'", error) from error


def stated(named: Named, known: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes of a callable that say what it is a model of.

    known: attribute -> function that checks and converts its value. Raises InputError for a value
    that it refuses, and for a property that raises.
    """
    found = {}
    for attribute, convert in known.items():
        value = read_attribute(named.name, named.model, attribute)
        if value is None:
            continue
        try:
            found[attribute] = convert(value)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{named.name}: its attribute '{attribute}' is {value!r}: {error}; correct it"
            ) from error
    return found


def _check(name: str, value: Any) -> None:
    parts = (read_attribute(name, value, part) for part in ("initial_state", "step"))
    if not (callable(value) or all(map(callable, parts))):
        raise InputError(
            f"{name}: is a {type(value).__name__}, expected a callable (time_s, actuation) -> key "
            "points, or an object with 'initial_state' and 'step' (docs/your_model.md)"
        )


def _attribute(name: str, module: ModuleType, attribute: str) -> Any:
    value: Any = module
    for part in attribute.split("."):
        if not hasattr(value, part):
            raise InputError(f"{name}: imported, but there is no '{attribute}'; correct the name")
        value = getattr(value, part)
    return value


def _guarded(name: str, load: Any) -> Any:
    try:
        return load()
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(
            f"{name}: cannot be imported ({raised_at(error)}); expected package.module:object or "
            "FILE.py:object, importable from here"
        ) from error
