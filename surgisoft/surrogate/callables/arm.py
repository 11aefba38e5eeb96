"""An arm model around a callable: what the callable states of its arm, and what it leaves open."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from surgisoft.errors import InputError, raised_by
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.callables.named import Named, checked_points, stated
from surgisoft.surrogate.callables.network import CallableNetwork, form_of
from surgisoft.surrogate.model import ArmModel, Validation

ACTUATIONS = ("measured", "commanded")


def _numbers(value: Any) -> tuple[float, ...]:
    array = np.asarray(value, np.float64)
    if array.ndim != 1 or not len(array) or not np.isfinite(array).all():
        raise ValueError("expected one finite number for each chamber")
    return tuple(array.tolist())


def _size(value: Any) -> float:
    if not (np.isfinite(float(value)) and float(value) > 0):
        raise ValueError("expected a number above 0")
    return float(value)


def _direction(value: Any) -> tuple[float, ...]:
    array = np.asarray(value, np.float64)
    if array.shape != (3,) or abs(np.linalg.norm(array) - 1) > 1e-3:
        raise ValueError("expected a unit vector of 3 numbers")
    return tuple((array / np.linalg.norm(array)).tolist())


def _actuation(value: Any) -> str:
    if value not in ACTUATIONS:
        raise ValueError(f"expected one of {', '.join(ACTUATIONS)}")
    return str(value)


def _errors(value: Any) -> tuple[float, ...]:
    array = np.atleast_1d(np.asarray(value, np.float64))
    if array.ndim != 1 or not len(array) or not (np.isfinite(array) & (array > 0)).all():
        raise ValueError("expected an RMS error above 0 mm, one or one for each key point")
    return tuple(array.tolist())


STATED = {
    "low": _numbers,
    "high": _numbers,
    "unit": str,
    "actuation": _actuation,
    "length_mm": _size,
    "diameter_mm": _size,
    "gravity": _direction,
    "error_mm": _errors,
}
"""Attributes by which a callable may state what it is a model of, and how each is checked."""


def statements(named: Named) -> dict[str, Any]:
    """The attributes of `STATED` that a callable has, checked."""
    found = stated(named, STATED)
    low, high = found.get("low"), found.get("high")
    if (low is None) != (high is None):
        raise InputError(f"{named.name}: states 'low' or 'high' only, expected both or none")
    if low is None or high is None:
        return found
    if len(low) != len(high) or not all(np.array(low) < np.array(high)):
        raise InputError(
            f"{named.name}: 'low' is {low} and 'high' is {high}, expected as many numbers in both, "
            "one for each chamber, each low below its high"
        )
    return found


def validation_of(error_mm: Iterable[float], key_points: int, label: str) -> Validation:
    """A validated error of one value, or of one for each key point, mm."""
    each = tuple(error_mm)
    each = each * key_points if len(each) == 1 else each
    if len(each) != key_points:
        raise InputError(
            f"{label}: {len(each)} validated errors, expected one or {key_points}, one per "
            "key point"
        )
    return Validation(float(np.sqrt(np.mean(np.square(each)))), each)


def arm_around(named: Named, spec: ArmSpec, validation: Validation | None = None) -> ArmModel:
    """The arm model of a callable without effects.

    spec: the arm as recordings or the callable state it; its number of key points is replaced by
    that of the callable.
    """
    rest = np.array(spec.rest)
    points = _at_rest(named, rest)
    spec = replace(spec, key_points=len(points))
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    network = CallableNetwork(low, high, len(points), named.name, named.sha256, named)
    rest_mm = torch.from_numpy(points).float()
    return ArmModel(spec, network, None, rest_mm, validation).eval().requires_grad_(False)


def arm_by_itself(named: Named) -> ArmModel:
    """The arm model of a callable that states its own range, without recordings."""
    known = statements(named)
    if "low" not in known:
        raise InputError(
            f"{named.name}: does not state its range of actuation, which recordings would tell; "
            "give it the attributes 'low' and 'high', one number for each chamber"
        )
    errors = known.pop("error_mm", None)
    arm = arm_around(named, ArmSpec(chambers=len(known["low"]), key_points=1, **known))
    if errors is None:
        return arm
    validation = validation_of(errors, arm.spec.key_points, named.name)
    return arm.replace(validation=validation).eval()


def _at_rest(named: Named, rest: np.ndarray) -> np.ndarray:
    """(n, 3) key points in mm of a callable at rest (m,)."""
    model, one = named.model, rest[None]
    try:
        if form_of(named) == "steps":
            result = model.step(model.initial_state(one.copy()), one.copy(), np.zeros(1))
            if not (isinstance(result, tuple | list) and len(result) == 2):
                raise InputError(
                    f"{named.name}: step returned {type(result).__name__}, expected (state, key "
                    "points)"
                )
            points = result[1]
        else:
            points = model(np.zeros(1), one.copy())
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise raised_by(named.name, error) from error
    return checked_points(named.name, points, (1,), len(rest), None)[0]
