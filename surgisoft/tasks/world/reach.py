"""Reach tables of a scene's arms: centrelines of the arm models as plain geometry.

With them, whether beams around a scene's ring keep its limits, and are strong enough to cut it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from surgisoft.config import Where, read_toml
from surgisoft.errors import InputError, unknown_name
from surgisoft.scene.ablation import Tissue, line_dose_j_per_mm2
from surgisoft.scene.contours import arc_length_mm
from surgisoft.scene.folder import Scene
from surgisoft.scene.mounted_arm import MountedArm, solve_ring
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.spec import FILE, TOOLS, MountSpec, arm_names, arm_rank
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.callables.named import is_callable_name
from surgisoft.surrogate.callables.network import CallableNetwork
from surgisoft.surrogate.checkpoint import default_arm, load_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.reach import grid_axes, model_table, require_millimetres
from surgisoft.tasks.world.scene import SceneEngineConfig

SAME_LENGTH_MM = 1.0
"""A mount's length may differ by this from its model's (mm)."""


def reach_of(mount: MountSpec, folder: Path | None = None, where: Where | None = None) -> ArmReach:
    """The reach table of the arm on a mount, sampled from the model that the tasks bend.

    `default` is the model that ships with the package, else the fitted model in the folder that the
    mount names, looked for beside the scene, then as it is.

    where: the mount's place in the scene file, for the error.
    """
    place = _model_folder(mount, folder, where)
    table = _default_table() if place is None else _table(place, mount.arm)
    (axes, lines, directions), spec = table
    _check_length(mount, spec, where)
    return ArmReach(axes, lines, directions, np.array(spec.rest), 0.5 * mount.diameter_mm)


def actuation_grid(spec: ArmSpec) -> torch.Tensor:
    """(N, m) float32: actuations of an arm, in its unit, on a grid over its chambers' ranges.

    Raises InputError for an arm of more than six chambers.
    """
    axes = [torch.as_tensor(axis, dtype=torch.float32) for axis in grid_axes(spec)]
    return torch.cartesian_prod(*axes).reshape(-1, len(axes))


def blank_mounts(
    tools: Sequence[str] = ("laser", "endoscope"), models: Mapping[str, str] | None = None
) -> dict[str, MountSpec]:
    """Mounts without a place yet by their arms' names, with the size of each arm's model.

    tools: the tool of each arm; where several arms carry one they are `laser_1`, `laser_2`, ...
    models: the arm model, `default` or a fitted model's folder, of an arm by its name, or of all
    arms with a tool by the tool; an arm that is left out has the default one. Raises InputError
    where a folder holds no model, or one without a length, and for the name of a callable.
    """
    if not tools:
        raise InputError(f"no arm is given; expected at least one of {', '.join(TOOLS)}")
    for tool in tools:
        if tool not in TOOLS:
            raise unknown_name("tool", tool, TOOLS)
    plain = [MountSpec(tool, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) for tool in tools]
    named, models = dict(zip(arm_names(plain), plain, strict=True)), models or {}
    for key in models:
        if key not in named and key not in tools:
            raise unknown_name("arm", key, named)
    mounts = {}
    for name in sorted(named, key=lambda name: arm_rank(named[name].tool, name)):
        mount = named[name]
        mount = mount if name == mount.tool else replace(mount, name=name)
        model = models.get(name, models.get(mount.tool, "default"))
        if is_callable_name(str(model)):
            raise InputError(
                f"{model}: is a Python callable, expected 'default' or an arm model's folder, "
                "because opening a scene runs no code; save it in Python by "
                f"save_model(load_model('{model}'), 'my_arm') of surgisoft.surrogate.checkpoint, "
                f"and give --arm my_arm --model-code {model}"
            )
        if model != "default":
            opened = load_model(model)
            spec = opened.spec
            if spec.length_mm is None:
                raise InputError(
                    f"{model}: the arm model states no length; {_how_to_state(opened)}"
                )
            mount = replace(
                mount,
                arm=str(Path(model).absolute()),
                length_mm=spec.length_mm,
                diameter_mm=spec.diameter_mm or mount.diameter_mm,
            )
        mounts[name] = mount
    return mounts


def _how_to_state(model: ArmModel) -> str:
    """How an arm model gets the length that a mount needs."""
    if isinstance(model.network, CallableNetwork):
        return (
            f"give the object {model.network.named.name} the attribute length_mm (the length at "
            "rest, mm) and save it again"
        )
    return "fit it to recordings whose sidecar has length_mm in [arm]"


def reaches_of(scene: Scene) -> dict[str, ArmReach]:
    """The reach tables of all arms of a scene, by name."""
    path = scene.folder / FILE
    where = read_toml(path)[1] if path.is_file() else Where(path)
    names = arm_names(scene.spec.mounts)
    return {
        name: reach_of(mount, scene.folder, where / "mounts" / i)
        for i, (name, mount) in enumerate(zip(names, scene.spec.mounts, strict=True))
    }


def beam_beyond_limits(scene: Scene) -> str:
    """In which way the beams around a scene's ring, solved for each arm alone, are longer, shorter
    or steeper than the scene's `[laser]` states, in words; empty where none is, or where a mount
    does not fit its model. Tasks do not enforce these limits."""
    lasers, laser = scene.spec.arms_with("laser"), scene.spec.laser
    try:
        reaches = reaches_of(scene) if lasers else {}
        ring = scene.ring
    except InputError:
        return ""
    (low, high), worst = laser.standoff_mm, laser.max_incidence_deg
    found = []
    for name in lasers:
        cut = solve_ring(MountedArm.at(scene.spec.mount(name), reaches[name]), ring, laser)
        shortest, longest = float(cut.standoff_mm.min()), float(cut.standoff_mm.max())
        steepest = float(np.degrees(cut.incidence_rad.max()))
        if shortest < low or longest > high:
            found.append(
                f"the beam of '{name}' is {shortest:.0f} to {longest:.0f} mm long at the ring "
                f"(standoff_mm: {low:g} to {high:g})"
            )
        if steepest > worst:
            found.append(
                f"the beam of '{name}' is up to {steepest:.0f} degrees off the surface's normal "
                f"(max_incidence_deg: {worst:g})"
            )
    if not found:
        return ""
    return (
        f"scene '{scene.spec.name}': {'; '.join(found)}; no task enforces these limits: "
        "'surgisoft scene check' shows where they are passed"
    )


def _model_folder(mount: MountSpec, folder: Path | None, where: Where | None) -> Path | None:
    """The folder of the mount's model, None for the default one."""
    if mount.arm == "default":
        return None
    places = [Path(mount.arm)] if folder is None else [folder / mount.arm, Path(mount.arm)]
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        came = f"there is no arm model '{mount.arm}'"
        raise _error(mount, where, "arm", came, "'default' or a fitted model's folder")
    return found


def _check_length(mount: MountSpec, spec: ArmSpec, where: Where | None) -> None:
    """Raise unless the mount states the length of its model."""
    if spec.length_mm is not None and abs(spec.length_mm - mount.length_mm) > SAME_LENGTH_MM:
        came = f"got {mount.length_mm:g} mm for an arm model of {spec.length_mm:g} mm"
        raise _error(mount, where, "length_mm", came, f"{spec.length_mm:g}, or another model")


def _error(
    mount: MountSpec, where: Where | None, field: str, came: str, expected: str
) -> InputError:
    if where is None:
        return InputError(f"mount of the {mount.tool}: {field}: {came}; expected {expected}")
    return (where / field).error(came, expected)


def _table(folder: Path, name: str) -> tuple:
    """`model_table` of the model in a folder, and the model's spec; name: what the scene says."""
    model = load_model(folder)
    require_millimetres(model, name)
    return model_table(model), model.spec


@cache
def _default_table() -> tuple:
    """`_table` of the model that ships with the package, which never changes."""
    model = default_arm()
    return model_table(model), model.spec


def ring_dose_lacking(scene: Scene) -> str:
    """In which way a scene's lasers are too weak to cut its ring once around in the whole of its
    time, in words; empty where they are not, and without a laser."""
    spec, count = scene.spec, len(scene.spec.arms_with("laser"))
    if not count:
        return ""
    length_mm = arc_length_mm(np.vstack((scene.ring.points_mm, scene.ring.points_mm[:1])))
    laser, depth_mm = spec.laser, SceneEngineConfig().depth_mm
    needed = Tissue(laser.absorption_per_mm).dose_for_depth(depth_mm)
    speed_mm_s = length_mm / spec.limits.time_s
    largest = line_dose_j_per_mm2(count * laser.power_w, 0.5 * laser.spot_mm, speed_mm_s)
    if largest >= needed:
        return ""
    beams = "the beam" if count == 1 else f"the {count} beams"
    return (
        f"{beams} of {laser.power_w:g} W, once around the ring in the {spec.limits.time_s:g} s of "
        f"the scene, gives at most {largest:.3g} J/mm2, less than the {needed:.3g} J/mm2 that cut "
        f"{depth_mm:g} mm deep: more power_w or a smaller spot_mm in [laser], or a longer time_s "
        "in [limits]"
    )
