"""User-defined effects: by entry point of an installed package, or by file.

A package offers effects in the entry point group `surgisoft.effects`; the name of the entry is the
name of the effect. A file holds one `Effect`, and its stem is the name of the effect. A file is
code and is run only if the user named it.
"""

import functools
import hashlib
import sys
from collections.abc import Container, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from surgisoft.errors import InputError, path_of, raised_at
from surgisoft.python_files import run_file
from surgisoft.surrogate.effects.base import STAGES, Effect

GROUP = "surgisoft.effects"
"""Entry point group of effects in other packages."""
RESERVED = ("network", "none", "pressure", "direction", "constant curvature", "kernel", "auto")
"""Names with another meaning in a model or its fit (`surgisoft.surrogate.fit`), which no effect may
have."""


@dataclass(frozen=True)
class EffectFile:
    """An effect that came from a file."""

    kind: type[Effect]
    """Class of the effect."""
    path: str
    """The file as it was named."""
    sha256: str
    """Hash of the file's bytes."""


FILES: dict[str, EffectFile] = {}
"""Registered effects from files, by name: the file that was named last."""
FILE_OF: dict[type[Effect], EffectFile] = {}
"""The file that each class came from, also after another file of its name was registered."""


def register_effect_file(path: str | Path, taken: Container[str] = ()) -> str:
    """Run a user's effect file and register its one `Effect`; returns its name, the file's stem.

    taken: names of the package's effects. Raises InputError where the file is missing, does not
    run, does not hold exactly one complete `Effect`, or has a name that is in use.
    """
    path = path_of("the file of an effect", path)
    name = path.stem
    if not path.is_file():
        raise InputError(f"{path}: no such file; name a .py file that defines one Effect")
    if path.suffix != ".py" or not name.isidentifier():
        raise InputError(f"{path}: expected a .py file whose stem is a plain name (my_effect.py)")
    if name in RESERVED:
        raise InputError(
            f"{path}: '{name}' has another meaning in a model, and no effect can have this name; "
            "rename the file"
        )
    if name in taken or name in offered():
        raise InputError(f"{path}: an effect '{name}' exists already; rename the file")
    content = path.read_bytes()
    try:
        module = run_file(path, content, "surgisoft_effect")
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise InputError(
            f"{path}: does not run ({raised_at(error, str(path))}); correct it"
        ) from error
    own = [
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, Effect)
        and value.__module__ == module.__name__
    ]
    made = [kind for kind in own if not kind.__abstractmethods__]
    if len(made) != 1:
        names = ", ".join(kind.__name__ for kind in made)
        names = names or "; ".join(map(_lacking, own)) or "none"
        raise InputError(f"{path}: expected one complete Effect in the file, found {names}")
    _check(made[0], str(path))
    FILES[name] = EffectFile(made[0], str(path), hashlib.sha256(content).hexdigest())
    FILE_OF[made[0]] = FILES[name]
    return name


def _lacking(kind: type[Effect]) -> str:
    """Which methods an incomplete effect does not define, in words."""
    missing = ", ".join(f"'{name}'" for name in sorted(kind.__abstractmethods__))
    return f"{kind.__name__}, which lacks {missing}"


def kind_of(name: str) -> str:
    """The kind of a model's effect: a second one of a kind is named `kind#2`."""
    return name.split("#")[0]


def offered() -> dict[str, EntryPoint]:
    """Entry points of effects in installed packages by name; none is loaded."""
    return _offered(tuple(sys.path))


@functools.cache
def _offered(path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Entry points of effects while the search path is this one: reading them takes 6 ms."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def load_offered(name: str) -> type[Effect]:
    """The effect of an installed package."""
    entry = offered()[name]
    try:
        kind = entry.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise InputError(
            f"effect '{name}' ({entry.value}): does not load ({raised_at(error)}); "
            "correct or remove that package"
        ) from error
    _check(kind, f"effect '{name}' ({entry.value})")
    return kind


def _check(kind, label: str) -> None:
    if not (isinstance(kind, type) and issubclass(kind, Effect)):
        raise InputError(f"{label}: expected a subclass of surgisoft.surrogate.effects.Effect")
    if getattr(kind, "stage", None) not in STAGES:
        raise InputError(f"{label}: expected a 'stage' of {', '.join(STAGES)}")


def files_of(effects: Mapping[str, Effect]) -> dict[str, dict]:
    """Path and hash, by name, of those effects that came from files, for a checkpoint.

    They are those of the file as it was when the effect was made.
    """
    found = {kind_of(name): FILE_OF.get(type(effect)) for name, effect in effects.items()}
    return {
        name: {"path": file.path, "sha256": file.sha256}
        for name, file in found.items()
        if file is not None
    }


def check_files(wanted: dict[str, dict], label: str) -> None:
    """Raise InputError unless each effect file of a checkpoint has been named and is unchanged."""
    for name, file in wanted.items():
        if name not in FILES:
            raise InputError(
                f"{label}: its effect '{name}' is code in {file['path']}, which opening a model "
                f"does not run; if you trust the file, name it: --effect-file {file['path']} "
                f"(in Python: load_model(folder, effect_files=['{file['path']}']))"
            )
        if FILES[name].sha256 != file["sha256"]:
            raise InputError(
                f"{label}: {FILES[name].path} is not the file that its effect '{name}' was made "
                f"with (sha256 {FILES[name].sha256[:12]}, expected {file['sha256'][:12]}); "
                "name the same file, or amend the model again"
            )
