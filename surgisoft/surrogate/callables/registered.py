"""The operators of PyTorch that stand for calls of callables; importing this registers them."""

import torch
from torch import Tensor

from surgisoft.numpy_code import FOREIGN
from surgisoft.surrogate.callables.called import CALLED


@torch.library.custom_op("surgisoft::callable_points", mutates_args=())
def callable_points(actuation: Tensor, place: int, key_points: int) -> Tensor:
    """Key points (S, n, 3) in mm of rows (S, m) of a callable that is not stepped."""
    return torch.from_numpy(CALLED[place].points_of_rows(actuation.numpy()))


@callable_points.register_fake
def _(actuation: Tensor, place: int, key_points: int) -> Tensor:
    return actuation.new_empty(actuation.shape[0], key_points, 3)


@torch.library.custom_op("surgisoft::callable_state", mutates_args=())
def callable_state(actuation: Tensor, place: int, size: int) -> Tensor:
    """State (B, k) of a callable that was held at actuation (B, m)."""
    return torch.from_numpy(CALLED[place].state_of(actuation.numpy())).clone()


@callable_state.register_fake
def _(actuation: Tensor, place: int, size: int) -> Tensor:
    return actuation.new_empty(actuation.shape[0], size)


@torch.library.custom_op("surgisoft::callable_step", mutates_args=())
def callable_step(
    state: Tensor, actuation: Tensor, dt_s: Tensor, place: int, key_points: int
) -> tuple[Tensor, Tensor]:
    """State (B, k) and key points (B, n, 3) in mm after actuation (B, m) was held dt_s (B,)."""
    found = CALLED[place].step_of(state.numpy(), actuation.numpy(), dt_s.numpy())
    return torch.from_numpy(found[0]).clone(), torch.from_numpy(found[1]).clone()


@callable_step.register_fake
def _(
    state: Tensor, actuation: Tensor, dt_s: Tensor, place: int, key_points: int
) -> tuple[Tensor, Tensor]:
    return torch.empty_like(state), state.new_empty(state.shape[0], key_points, 3)


FOREIGN[torch.ops.surgisoft.callable_points] = "models[{1}].points({0})"
FOREIGN[torch.ops.surgisoft.callable_state] = "models[{1}].initial_state({0})"
FOREIGN[torch.ops.surgisoft.callable_step] = "models[{3}].step({0}, {1}, {2})"
