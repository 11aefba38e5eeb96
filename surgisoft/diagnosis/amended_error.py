"""What an amended model states of its own error: residuals of the fit, and the validated error.

Where the arm had the effect already when the model was fitted, the residuals of the fit are partly
that of the missing effect, and so is the validated error: both are too large once the effect is in
the model. The amended model's residuals on the rows of the fit follow from those of the given
model, since both predict these rows. They take the place of the given model's where they are
smaller; else the arm has changed since the fit, whose rows say nothing of the effect. The validated
error then falls in the same proportion, but not below the error on the held-out rows.
"""

from dataclasses import replace

import numpy as np
import torch

from surgisoft.diagnosis.residuals import Problem, noise_of_validation
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import Past


@torch.no_grad()
def state_residuals(model: ArmModel, given: ArmModel, retuned: bool = False) -> None:
    """Set the residuals of an amended model on the rows of the given model's fit.

    Where those of the amended model are not smaller, or are not known because the given model does
    not keep the actuation before these rows, or where its runs begin, they are those of the given
    model, or None where the network was re-tuned since.
    """
    known = given.training_residuals
    model.training_residuals = None if retuned else known
    past = None if known is None else known.past
    if known is None or past is None or past.stood is None or not len(past.row):
        return
    residual = known.residual_mm + _difference_mm(given, model, past)
    if residual.square().nansum() < known.residual_mm.square().nansum():
        model.training_residuals = replace(known, residual_mm=residual)


def state_error(model: ArmModel, given: ArmModel, held_out: Problem) -> None:
    """Lower the validated error of an amended model in proportion to its residuals of the fit.

    Nothing is changed where these are not smaller than those of the given model. held_out: rows to
    which nothing of the model was fitted; the validated error does not fall below that on them.
    """
    stated, was, now = model.validation, given.training_residuals, model.training_residuals
    if stated.rmse_mm is None or was is None or now is None or now is was:
        return
    noise = noise_of_validation(model, held_out.noise_mm)
    before, after = (
        np.maximum(_mean_square(each.residual_mm.double().numpy()) - noise**2, 0.0)
        for each in (was, now)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.clip(np.nan_to_num(after / before, nan=1.0), 0.0, 1.0)
    residual = held_out.with_model(model).residual
    measured = np.nan_to_num(_mean_square(residual)) - held_out.noise_mm**2
    points: list[float | None] = []
    for k, error in enumerate(stated.per_key_point_mm):
        if error is None:
            points.append(None)
            continue
        own = max(error**2 - noise[k] ** 2, 0.0)
        least = max(left[k] * own, measured[k])
        points.append(min(error, float(np.sqrt(least + noise[k] ** 2))))
    square = [
        (now_mm**2, was_mm**2)
        for now_mm, was_mm in zip(points, stated.per_key_point_mm, strict=True)
        if now_mm is not None and was_mm is not None
    ]
    if not square:
        return
    share = float(np.sqrt(np.divide(*np.sum(square, axis=0))))
    model.validation = replace(
        stated, rmse_mm=share * stated.rmse_mm, per_key_point_mm=tuple(points), interval=None
    )


def _difference_mm(given: ArmModel, model: ArmModel, past: Past) -> torch.Tensor:
    """(S, n, 3) how far a model predicts less than the given one on the rows of its fit, mm."""
    runs = torch.unique_consecutive(past.run, return_counts=True)[1].tolist()
    nowhere = [torch.full((count, model.spec.key_points, 3), torch.nan) for count in runs]
    t_s, actuation = list(past.t_s.split(runs)), list(past.actuation.split(runs))
    stood = None if past.stood is None else list(past.stood)
    history = pack(t_s, actuation, nowhere, stood=stood)
    was, now = (history.rows(each.predict(history))[past.row] for each in (given, model))
    return was - now


def _mean_square(residual: np.ndarray) -> np.ndarray:
    """(n,) mean squared distance of each key point, mm^2; NaN where it was never measured."""
    square = np.square(residual).sum(2)
    count = np.isfinite(square).sum(0)
    return np.where(count > 0, np.nansum(square, axis=0) / np.maximum(count, 1), np.nan)
