"""Libraries of the optional parts, and what to install where one is missing.

`pip install surgisoft` brings the core: arm models, recordings, the rig, diagnosis. Scenes,
training and replays need more libraries, which the extras of the package install.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import (
    PackageNotFoundError,
    entry_points,
    packages_distributions,
    requires,
    version,
)

EXTRA_OF = {
    "embreex": "scene",
    "fcl": "scene",
    "rtree": "scene",
    "trimesh": "scene",
    "gymnasium": "train",
    "onnx": "train",
    "onnxscript": "train",
    "pettingzoo": "train",
    "rsl_rl": "train",
    "tensorboard": "train",
    "tensordict": "train",
    "rerun": "replay",
    "rerun_cli": "replay",
    "elastica": "elastica",
    "serial": "serial",
    "distributed": "cluster",
    "ezc3d": "lab",
    "h5py": "lab",
    "lerobot": "lerobot",
    "mcap": "mcap",
    "mcap_ros2": "mcap",
    "nibabel": "segmentation",
    "nrrd": "segmentation",
    "skimage": "segmentation",
    "warp": "gpu",
}
"""The extra that installs a module, by the module's name."""


EXTRA_OF_USE = {
    "train": "train",
    "evaluate": "train",
    "export": "train",
    "make": "train",
    "batched_env": "scene",
    "parallel_env": "train",
    "experiment": "all",
    "demo": "all",
}
"""The extra that a command or function needs in whole, by its name."""
WITH_SCENE = ("train", "replay", "segmentation")
"""Extras that install the extra `scene`, too."""


@contextmanager
def with_advice() -> Iterator[None]:
    """Imports of an extra's library: where it is missing, the error says what to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        advice = missing_library(error)
        if advice is None:
            raise
        raise ModuleNotFoundError(advice, name=error.name, path=error.path) from None


def offering_packages() -> set[str]:
    """Installed packages that offer rigs, tasks or anything else, by the names of their modules."""
    found = entry_points()
    groups = [group for group in found.groups if group.startswith("surgisoft.")]
    return {entry.module.split(".")[0] for group in groups for entry in found.select(group=group)}


def missing_library(error: ModuleNotFoundError, use: str = "") -> str | None:
    """Advice what to install for a missing module, in one line; None where no extra has it.

    Where only a part of an installed package is missing, its version does not fit.
    use: the command or function that needs it.
    """
    name, _, part = (error.name or "").partition(".")
    if name not in EXTRA_OF:
        return None
    if part and (installed := _installed(name)):
        return _without_part(str(error.name), *installed)
    own = EXTRA_OF[name]
    extra = EXTRA_OF_USE.get(use, own)
    if extra not in ("all", own) and not (own == "scene" and extra in WITH_SCENE):
        extra = f"{extra},{own}"
    return f"the package '{name}' is missing; install it with: pip install 'surgisoft[{extra}]'"


def _installed(name: str) -> tuple[str, str] | None:
    """Package and version that a module comes from; None where it is not installed."""
    for package in packages_distributions().get(name, ()):
        with suppress(PackageNotFoundError):
            return package, version(package)
    return None


def _without_part(module: str, package: str, present: str) -> str:
    """Advice where an installed package lacks a module that was asked for."""
    least = _least_version(package)
    old = bool(least) and _numbers(present) < _numbers(least)
    why = f"is too old, expected {least} or later" if old else "is too old, or not whole"
    spelled = f"'{package}>={least}'" if least else package
    how = "--upgrade" if old or not least else "--upgrade --force-reinstall --no-deps"
    return (
        f"the package '{package}' {present} {why}: it has no module '{module}'; "
        f"install it with: pip install {how} {spelled}"
    )


def _least_version(package: str) -> str:
    """Oldest version of a package that this one asks for; empty where that is not known."""
    with suppress(PackageNotFoundError):
        for requirement in requires("surgisoft") or ():
            found = re.match(r"([\w.-]+)[^;]*?>=\s*([\d.]+)", requirement)
            if found and _plain(found[1]) == _plain(package):
                return found[2]
    return ""


def _plain(package: str) -> str:
    return re.sub(r"[-_.]+", "-", package).lower()


def _numbers(text: str) -> list[int]:
    """The numbers of a version, in order."""
    return [int(number) for number in re.findall(r"\d+", text)]
