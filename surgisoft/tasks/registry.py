"""Every task by name."""

from collections.abc import Callable

import torch

from surgisoft.errors import unknown_name
from surgisoft.tasks.base import Task
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.keyhole import Keyhole
from surgisoft.tasks.laser_plane import laser_plane
from surgisoft.tasks.track import track_circle, track_square
from surgisoft.tasks.track_body import TrackBody

TASKS: dict[str, Callable[..., Task]] = {
    "track_circle": track_circle,
    "track_square": track_square,
    "track_body": TrackBody,
    "laser_plane": laser_plane,
    "keyhole": Keyhole,
    "circle_ablation": CircleAblation,
}
"""Name -> builder(config=None, device="cpu"); without a config the task's own."""


def make_task(name: str, config=None, device: str | torch.device = "cpu") -> Task:
    """The named task; an unknown name answers with the known ones."""
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    return TASKS[name](config, device)
