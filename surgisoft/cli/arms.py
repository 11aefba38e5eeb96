"""The arms of a scene as reach tables: where the arm models meet the geometry."""

from pathlib import Path

import numpy as np


def reach_of(mount, folder: Path | None = None, where=None):
    """The reach table of the arm on a mount.

    `default` is a constant-curvature arm of the mount's length: bends of 0 to 90 degrees to any
    side and 0 to 15 % of extension, the range of the paper's fibre-limited actuator. Else the
    fitted model in the folder that the mount names, looked for beside the scene, then as it is.
    `where` is the field's place in the scene file (`toml_config.Where`), for the error.
    """
    from surgisoft.errors import InputError
    from surgisoft.scene.reach import ArmReach
    from surgisoft.surrogate.checkpoint import load_model
    from surgisoft.surrogate.reach_table import constant_curvature_table, model_table

    radius_mm = 0.5 * mount.diameter_mm
    if mount.arm == "default":
        axes, lines, directions = constant_curvature_table(mount.length_mm)
        return ArmReach(axes, lines, directions, np.zeros(len(axes)), radius_mm)
    places = [Path(mount.arm)] if folder is None else [folder / mount.arm, Path(mount.arm)]
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        came, expected = (
            f"there is no arm model '{mount.arm}'",
            "'default' or a fitted model's folder",
        )
        if where is None:
            raise InputError(f"mount of the {mount.tool}: {came}; expected {expected}")
        raise where.error(came, expected)
    model = load_model(found)
    axes, lines, directions = model_table(model)
    return ArmReach(axes, lines, directions, np.array(model.spec.rest), radius_mm)


def reaches_of(scene) -> dict:
    """Both arms' reach tables of an opened scene, by tool."""
    from surgisoft.scene.spec import FILE
    from surgisoft.toml_config import Where, read_toml

    path = scene.folder / FILE
    where = read_toml(path)[1] if path.is_file() else Where(path)
    return {
        mount.tool: reach_of(mount, scene.folder, where / "mounts" / i / "arm")
        for i, mount in enumerate(scene.spec.mounts)
    }
