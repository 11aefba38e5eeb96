"""Recordings whose weight pulls along another direction than where a model was fitted."""

import itertools
from dataclasses import replace

import numpy as np

from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.effects import hypothesis_of, known_effects
from surgisoft.surrogate.model import ArmModel

SAME_DEG = 5.0
"""Directions of weight that differ by less are one [degrees]."""


def angle_deg(a, b) -> float:
    """Angle between two unit vectors (3,), degrees."""
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1.0, 1.0))))


def gravity_load() -> str:
    """Name of the known effect that stands for loads along gravity."""
    return next(name for name, kind in known_effects().items() if hypothesis_of(kind).own_weight)


def under_weight(model: ArmModel, recordings: list[Recording]) -> tuple[ArmModel, list[str]]:
    """The model as the recordings' direction of weight lets it be diagnosed, and what to know.

    The network holds how the arm bends under its own weight w where it was fitted, along g. On a
    bench that was turned, so that the weight pulls along g', the arm's own weight adds w (g' - g)
    and a payload F adds F g': loads in directions of which only their sum's is known. So a load
    there is a vector, as where no direction is known (`ArmSpec.gravity` None), and holds for that
    bench alone. With several directions among the recordings no single load can be right.
    """
    fitted = model.spec.gravity
    known = [r for r in recordings if r.gravity is not None]
    if fitted is None or not known:
        return model, []
    off = [r for r in known if angle_deg(fitted, r.gravity) > SAME_DEG]
    if not off:
        return model, []
    notes = [
        f"{r.label}: the weight pulls along {_shown(r.gravity)}, "
        f"{angle_deg(fitted, r.gravity):.0f} degrees from {_shown(fitted)} where the model was "
        "fitted: its own weight bends the arm otherwise there"
        for r in off
    ]
    apart = [
        (a, b)
        for a, b in itertools.combinations(known, 2)
        if angle_deg(a.gravity, b.gravity) > SAME_DEG
    ]
    if apart or len(known) < len(recordings):
        notes.append(
            "recordings with several or unknown directions of weight: what their own weight does "
            "differently can be taken for another effect; give those of one direction at a time"
        )
        return model, notes
    loads = [name for name, effect in model.effects.items() if hypothesis_of(effect).own_weight]
    if loads:
        notes.append(
            f"the model's {loads[0]} pulls along the old direction; amend the model from before it"
        )
        return model, notes
    notes.append(
        f"{gravity_load()} stands for the arm's own weight as well there: a load of any direction, "
        "which holds for this direction of weight alone"
    )
    return _without_direction(model), notes


def _without_direction(model: ArmModel) -> ArmModel:
    """A copy of the model whose loads may have any direction."""
    spec = replace(model.spec, gravity=None)
    return model.replace(spec=spec)


def _shown(direction) -> str:
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in direction) + ")"
