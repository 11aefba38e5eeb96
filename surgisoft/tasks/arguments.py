"""Arguments of environments, checked: each wrong one is an InputError of one line."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError


def device_of(device: str | torch.device, label: str = "device") -> torch.device:
    """The device by its name, `cpu` or `cuda`; raises InputError where this machine has none such.

    label: the argument or option, for the message.
    """
    given = str(device)
    if given.split(":")[0] not in ("cpu", "cuda"):
        raise InputError(f"{label} '{given}': expected cpu or cuda")
    try:
        kind = torch.device(given)
    except RuntimeError:
        raise InputError(f"{label} '{given}': expected cpu, cuda or cuda:NUMBER") from None
    if kind.type == "cuda":
        if not torch.cuda.is_available():
            raise InputError(f"{label} '{given}': PyTorch finds no GPU; use {label} cpu")
        if kind.index is not None and kind.index >= torch.cuda.device_count():
            most = torch.cuda.device_count() - 1
            raise InputError(
                f"{label} '{given}': PyTorch finds no such GPU; the last is cuda:{most}"
            )
    return kind


def whole(name: str, value: Any, least: int | None = None) -> int:
    """A whole number, Python's or NumPy's, that is not below `least`."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    try:
        number = operator.index(value)
    except TypeError:
        shown = repr(value)[:60]
        above = "" if least is None else f", {least} or more"
        raise InputError(f"{name} is {shown}, expected a whole number{above}") from None
    if least is not None and number < least:
        raise InputError(f"{name} is {number}, expected {least} or more")
    return number


def check_path(name: str, value: Any, what: str) -> None:
    """Raise InputError unless the value is a string or a path; what: what it names."""
    if not isinstance(value, str | Path):
        raise InputError(f"{name} is of type {type(value).__name__}, expected {what}")


def actions_of(
    actions: Mapping[str, Any],
    shapes: Mapping[str, tuple[int, int]],
    device: torch.device,
) -> dict[str, Tensor]:
    """Agent -> (B, m) float32 on the device, from tensors or arrays; shapes: agent -> (B, m)."""
    agents = ", ".join(shapes)
    if not isinstance(actions, Mapping):
        raise InputError(
            f"actions are of type {type(actions).__name__}, expected a dict of {agents}"
        )
    held = {}
    for agent, expected in shapes.items():
        if agent not in actions:
            raise InputError(f"no action for '{agent}', expected one for each of {agents}")
        try:
            given = actions[agent]
            if not isinstance(given, Tensor):
                given = np.asarray(given, np.float32)
            action = torch.as_tensor(given)
        except (TypeError, ValueError, RuntimeError):
            kind = type(actions[agent]).__name__
            raise InputError(
                f"action of '{agent}' is of type {kind}, expected a tensor or an array of numbers"
            ) from None
        if tuple(action.shape) != expected:
            raise InputError(
                f"action of '{agent}' has shape {tuple(action.shape)}, expected {expected}"
            )
        held[agent] = action.to(device, torch.float32)
    return held
