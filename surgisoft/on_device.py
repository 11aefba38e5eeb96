"""Numbers as tensors where other tensors are."""

from __future__ import annotations

import torch
from torch import Tensor


def on_device(value: Tensor | float | bool, like: Tensor) -> Tensor:
    """A tensor of the type of `like`, on its device; (), or the shape of a tensor that is given.

    A number is filled in on the device. `torch.as_tensor` would copy it there from the memory of
    the processor, which waits for the device, and which no CUDA graph can hold.
    """
    if isinstance(value, Tensor):
        return value.to(like.device, like.dtype)
    return torch.full((), value, dtype=like.dtype, device=like.device)
