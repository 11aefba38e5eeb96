"""The arms of a scene as reach tables: where the arm models meet the geometry."""

from functools import cache
from pathlib import Path

import numpy as np

SAME_LENGTH_MM = 1.0
"""A mount's length may differ by this from its model's (mm)."""


def reach_of(mount, folder: Path | None = None, where=None):
    """The reach table of the arm on a mount, sampled from the model that the tasks bend.

    `default` is the model that ships with the package, else the fitted model in the folder that the
    mount names, looked for beside the scene, then as it is. `where` is the mount's place in the
    scene file (`toml_config.Where`), for the error.
    """
    from surgisoft.scene.reach import ArmReach

    (axes, lines, directions), spec = _table(_model_folder(mount, folder, where))
    _check_length(mount, spec, where)
    return ArmReach(axes, lines, directions, np.array(spec.rest), 0.5 * mount.diameter_mm)


def reaches_of(scene) -> dict:
    """Both arms' reach tables of an opened scene, by tool."""
    from surgisoft.config import Where, read_toml
    from surgisoft.scene.spec import FILE

    path = scene.folder / FILE
    where = read_toml(path)[1] if path.is_file() else Where(path)
    return {
        mount.tool: reach_of(mount, scene.folder, where / "mounts" / i)
        for i, mount in enumerate(scene.spec.mounts)
    }


def _model_folder(mount, folder: Path | None, where) -> Path | None:
    """The folder of the mount's model, None for the default one."""
    if mount.arm == "default":
        return None
    places = [Path(mount.arm)] if folder is None else [folder / mount.arm, Path(mount.arm)]
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        came = f"there is no arm model '{mount.arm}'"
        raise _error(mount, where, "arm", came, "'default' or a fitted model's folder")
    return found


def _check_length(mount, spec, where) -> None:
    """The mount and its model must speak of the same arm."""
    if spec.length_mm is not None and abs(spec.length_mm - mount.length_mm) > SAME_LENGTH_MM:
        came = f"got {mount.length_mm:g} mm for an arm model of {spec.length_mm:g} mm"
        raise _error(mount, where, "length_mm", came, f"{spec.length_mm:g}, or another model")


def _error(mount, where, field: str, came: str, expected: str):
    from surgisoft.errors import InputError

    if where is None:
        return InputError(f"mount of the {mount.tool}: {field}: {came}; expected {expected}")
    return (where / field).error(came, expected)


@cache
def _table(folder: Path | None) -> tuple:
    """`model_table` of a model, and the model's spec; None: the default model."""
    from surgisoft.surrogate.checkpoint import default_arm, load_model
    from surgisoft.surrogate.reach import model_table

    model = default_arm() if folder is None else load_model(folder)
    return model_table(model), model.spec
