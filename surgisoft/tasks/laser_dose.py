"""Whether a laser is strong enough: the dose of a beam that follows its reference exactly.

It is computed with the task's own dose map, so that a laser that treats too little at the set speed
is known before an episode is played.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from surgisoft.tasks.base import Task
from surgisoft.tasks.laser_work import RingTask, RouteTask

LEAST_LACK = 0.02
"""A share of the path or area that lacks the dose is told from here on: below it, the stations of a
path and the samples of an area decide."""


@dataclass(frozen=True)
class ReferenceDose:
    """The dose of a beam that is always on and exactly on its reference, perpendicular to the
    surface."""

    largest_j_per_mm2: float
    """Largest dose of a place on the path or in the area, J/mm^2."""
    needed_j_per_mm2: float
    """Dose from which a place counts as treated, J/mm^2."""
    share: float
    """Share of the path or of the area that has this dose."""
    wanted: float
    """Share that a success needs."""
    what: str
    """`path` or `area`."""
    passes: float
    """How many times the reference is passed (a count)."""


def reference_dose(task: Task, beam_s: float | None = None) -> ReferenceDose | None:
    """The dose of the reference of a task with one laser; None for any other task.

    beam_s: time with the beam on, s; None: that of the whole episode. Where it is shorter than one
    pass, one pass counts: then the time is too short, not the laser too weak.
    """
    if not isinstance(task, RingTask | RouteTask):
        return None
    ablation, power_w = task.scene.ablation, task.spec.laser.power_w
    steps = task.steps if beam_s is None else round(beam_s / task.dt_s)
    steps = max(steps, task.pass_steps)
    points, normals, on = task.reference(steps)
    lit = torch.ones(1, dtype=torch.bool, device=points.device)
    state = ablation.start(points[:1], -normals[:1], lit)
    for step in range(1, len(points)):
        place = points[step : step + 1], -normals[step : step + 1]
        power = power_w if on[step] else 0.0
        state = ablation.advance(state, *place, lit, power, task.dt_s, in_place=True)
    largest, share = ablation.treated(state)
    what = "area" if ablation.exact_lesion else "path"
    wanted = float(getattr(task.config, "treated_share", 1.0))
    return ReferenceDose(
        float(largest), ablation.cut_dose, float(share), wanted, what, steps / task.pass_steps
    )


def weak_laser(task: Task, beam_s: float | None = None) -> str:
    """In which way the beam is too weak even exactly on its reference, in words; empty where it
    treats what a success needs, and for a task without one laser.

    beam_s: as for `reference_dose`.
    """
    found = reference_dose(task, beam_s)
    if found is None or found.share >= found.wanted - LEAST_LACK:
        return ""
    assert isinstance(task, RingTask | RouteTask)
    beam = (
        f"the beam of {task.spec.laser.power_w:g} W, exactly on its reference for "
        f"{found.passes * task.pass_steps * task.dt_s:.0f} s ({found.passes:.2g} "
        f"{'pass' if found.passes == 1.0 else 'passes'}), gives"
    )
    needed = f"{found.needed_j_per_mm2:.3g} J/mm2"
    change = f"change power_w in the scene's [laser], {task.dose_fields} or the time"
    if found.largest_j_per_mm2 < found.needed_j_per_mm2:
        return (
            f"{beam} at most {found.largest_j_per_mm2:.3g} J/mm2, and a place counts as treated "
            f"from {needed} on: {change}"
        )
    return (
        f"{beam} {needed}, from which a place counts as treated, to {100 * found.share:.0f} % of "
        f"the {found.what}, and a success needs {100 * found.wanted:g} %: {change}"
    )
