"""Arguments of environments, checked: each wrong one is an InputError of one line."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError, unknown_name

REAL_KINDS = "biuf"
"""Kinds of NumPy's types whose values are real numbers."""


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


def action_of(agent: str, given: Any, expected: tuple[int, ...]) -> np.ndarray:
    """One agent's action as a float32 array of the expected shape, kPa; NaN is passed on.

    given: an array, a list, or a tensor on any device. Raises InputError for what holds something
    else than real numbers, such as text or None, and for another shape.
    """
    found = given.detach().cpu().numpy() if isinstance(given, Tensor) else given
    try:
        found = np.asarray(found)
    except ValueError:  # rows of several lengths
        found = np.asarray(None)
    if found.dtype.kind not in REAL_KINDS:
        raise _no_numbers(agent, given)
    if found.shape != expected:
        raise _other_shape(agent, found.shape, expected)
    return found.astype(np.float32, copy=False)


def _no_numbers(agent: str, given: Any) -> InputError:
    """The InputError for an action that holds something else than real numbers."""
    return InputError(
        f"action of '{agent}' is of type {type(given).__name__} and holds something else than "
        "real numbers; expected a tensor, an array or a list of numbers"
    )


def _other_shape(agent: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> InputError:
    """The InputError for an action of another shape."""
    return InputError(f"action of '{agent}' has shape {tuple(shape)}, expected {expected}")


def _no_action(agent: str, agents: Iterable[str]) -> InputError:
    """The InputError for an agent without an action."""
    return InputError(f"no action for '{agent}', expected one for each of {', '.join(agents)}")


def check_agents(given: Any, agents: Iterable[str]) -> None:
    """Raise InputError unless actions are a mapping from each of the agents, and from no other."""
    known = tuple(agents)
    if not isinstance(given, Mapping):
        raise InputError(
            f"actions are of type {type(given).__name__}, expected a dict of {', '.join(known)}"
        )
    absent = [agent for agent in known if agent not in given]
    if absent:
        raise _no_action(absent[0], known)
    unknown = [name for name in given if name not in known]
    if unknown:
        raise unknown_name("agent", str(unknown[0]), known)


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
            raise _no_action(agent, shapes)
        action = actions[agent]
        if not isinstance(action, Tensor):
            action = torch.as_tensor(action_of(agent, action, expected))
        if action.is_complex():
            raise _no_numbers(agent, action)
        if tuple(action.shape) != expected:
            raise _other_shape(agent, action.shape, expected)
        held[agent] = action.to(device, torch.float32)
    return held
