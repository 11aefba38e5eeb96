"""The arms of a scene as reach tables: where the arm models meet the geometry."""

from pathlib import Path

import numpy as np


def reach_of(mount, folder: Path | None = None):
    """The reach table of the arm on a mount.

    `default` is a constant-curvature arm of the mount's length: bends of 0 to 90 degrees to any
    side and 0 to 15 % of extension, the range of the paper's fibre-limited actuator. Else the
    fitted model in the folder that the mount names, looked for beside the scene, then as it is.
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
        raise InputError(
            f"mount of the {mount.tool}: there is no arm model '{mount.arm}'; expected 'default' "
            "or the folder of a fitted model"
        )
    model = load_model(found)
    axes, lines, directions = model_table(model)
    return ArmReach(axes, lines, directions, np.array(model.spec.rest), radius_mm)


def reaches_of(scene) -> dict:
    """Both arms' reach tables of an opened scene, by tool."""
    return {mount.tool: reach_of(mount, scene.folder) for mount in scene.spec.mounts}
