"""The scripted solver: damped least squares on the differentiable arm model."""

from collections.abc import Callable

import torch
from torch import Tensor


def least_squares(
    residual: Callable[[Tensor], Tensor],
    start: Tensor,
    low: Tensor,
    high: Tensor,
    damping: float = 1e-3,
    iterations: int = 5,
) -> Tensor:
    """(B, m) within low, high (B, m) that make the residuals (B, r) small; the best one tried.

    Steps (J^T J + lambda D)^-1 J^T r with D the mean of J^T J's diagonal (Levenberg 1944; Wampler
    1986 for arms), held to the box. Where a step does not help, its environment's damping grows
    tenfold, else it falls tenfold. `residual` maps (B, m) to (B, r), row by row.
    """
    best = torch.minimum(torch.maximum(start, low), high)
    factor = best.new_full((len(best), 1, 1), damping)
    error, jacobian = _linearised(residual, best)
    eye = torch.eye(best.shape[1], dtype=best.dtype, device=best.device)
    for _ in range(iterations):
        normal = jacobian.mT @ jacobian
        size = normal.diagonal(dim1=1, dim2=2).mean(1)[:, None, None].clamp(min=1e-12)
        pull = (jacobian.mT @ error[..., None])[..., 0]
        move = torch.linalg.solve_ex(normal + factor * size * eye, pull)[0]
        tried = torch.minimum(torch.maximum(best - move, low), high)
        new_error, new_jacobian = _linearised(residual, tried)
        better = new_error.square().sum(1) < error.square().sum(1)
        best = torch.where(better[:, None], tried, best)
        error = torch.where(better[:, None], new_error, error)
        jacobian = torch.where(better[:, None, None], new_jacobian, jacobian)
        factor = torch.where(better[:, None, None], 0.1 * factor, 10.0 * factor).clamp(1e-6, 1e6)
    return best


def _linearised(residual: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals (B, r) and their Jacobians (B, r, m) at (B, m); works under inference_mode."""
    with torch.inference_mode(False), torch.enable_grad():
        place = at.clone().requires_grad_(True)
        value = residual(place)
        one = torch.eye(value.shape[1], dtype=value.dtype, device=value.device)
        each = one[:, None].expand(-1, len(value), -1)
        slopes = torch.autograd.grad(value, place, each, is_grads_batched=True)[0]
    return value.detach(), slopes.movedim(0, 1)
