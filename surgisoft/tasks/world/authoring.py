"""Make a scene for arms whose models the tasks bend."""

from collections.abc import Mapping, Sequence

from surgisoft.progress import Progress, silent
from surgisoft.scene.author import Authored, Request, author
from surgisoft.tasks.world.reach import blank_mounts, reach_of


def make_scene(
    request: Request,
    tools: Sequence[str] = ("laser", "endoscope"),
    models: Mapping[str, str] | None = None,
    name: str = "scene",
    progress: Progress = silent,
) -> Authored:
    """Make and check a scene from mesh files or a segmented image; nothing is written.

    The meshes are repaired, the lesion is placed, and mounts are found from which every arm does
    its work; lengths are in mm, in the world frame. `surgisoft.scene.author.write_scene` writes the
    result. Raises InputError for meshes that cannot be used, and `NoMounts` where no mounts are
    found.

    tools: the tool of each arm; models: the arm model of an arm or of all arms with a tool, as for
    `blank_mounts`. name: of the scene. progress: called with (done, total, note).
    """
    mounts = blank_mounts(tools, models)
    reaches = {arm: reach_of(mount) for arm, mount in mounts.items()}
    return author(request, reaches, mounts, name, progress)
