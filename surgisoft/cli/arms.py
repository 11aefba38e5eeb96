"""The arms of a scene as reach tables: where the arm models meet the geometry."""

import numpy as np


def reach_of(mount):
    """The reach table of the arm on a mount: a constant-curvature arm of the mount's length.

    Bends of 0 to 90 degrees to any side and 0 to 15 % of extension, the range of the paper's
    fibre-limited actuator.
    """
    from surgisoft.errors import InputError
    from surgisoft.scene.reach import ArmReach
    from surgisoft.surrogate.reach_table import constant_curvature_table

    if mount.arm != "default":
        raise InputError(
            f"mount of the {mount.tool}: arm '{mount.arm}' has no reach table; known is 'default'"
        )
    axes, lines, directions = constant_curvature_table(mount.length_mm)
    return ArmReach(axes, lines, directions, np.zeros(len(axes)), 0.5 * mount.diameter_mm)


def reaches_of(spec) -> dict:
    """Both arms' reach tables, by tool."""
    return {mount.tool: reach_of(mount) for mount in spec.mounts}
