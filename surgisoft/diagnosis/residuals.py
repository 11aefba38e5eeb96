"""Where a model is wrong: predicted beside measured key points, row by row, and what goes along."""

from dataclasses import dataclass

import numpy as np
import torch

from surgisoft.measurement.histories import actuation_of, check_fits, history_of
from surgisoft.measurement.recording import Recording
from surgisoft.surrogate import direction as directions
from surgisoft.surrogate.model import ArmModel


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a model on recordings, all runs one after another: S rows."""

    predicted_mm: np.ndarray
    """(S, n, 3) predicted key points, base frame, mm."""
    measured_mm: np.ndarray
    """(S, n, 3) measured key points, base frame, mm; NaN where missing."""
    pressure: np.ndarray
    """(S, m) actuation, in the arm's unit."""
    direction: np.ndarray
    """(S, m) direction of change: -1, 0, 1."""
    rate: np.ndarray
    """(S, m) rate of change of the actuation, arm's unit a second; 0 in the first row of a run."""
    dwell_s: np.ndarray
    """(S,) time since any chamber last moved out of its dead band, s."""
    t_s: np.ndarray
    """(S,) time of the row in its recording, s."""
    run: np.ndarray
    """(S,) number of the run, counted over all recordings."""
    recording: np.ndarray
    """(S,) number of the recording."""

    @property
    def error_mm(self) -> np.ndarray:
        """(S, n) distance between predicted and measured key points, mm; NaN where missing."""
        return np.linalg.norm(self.predicted_mm - self.measured_mm, axis=-1)


def residuals(model: ArmModel, recordings: list[Recording]) -> Residuals:
    """Evaluate a model on whole recordings."""
    check_fits(model.spec, recordings)
    history = history_of(recordings, model.spec.actuation)
    with torch.no_grad():
        predicted = model.predict(history)
        anchor, direction = directions.trace(history.pressure, model.band, model.rest)
        moved = (anchor.diff(dim=1, prepend=anchor[:, :1]) != 0).any(-1)
        steps = history.pressure.diff(dim=1, prepend=history.pressure[:, :1])
        rate = steps / history.dt_s.clamp(min=1e-6)[..., None]
    last = torch.where(moved, history.t_s, history.t_s[:, :1]).cummax(dim=1).values

    def rows(tensor: torch.Tensor) -> np.ndarray:
        return history.rows(tensor).double().numpy()

    owner = np.concatenate(
        [np.full(recording.samples, i) for i, recording in enumerate(recordings)]
    )
    return Residuals(
        predicted_mm=rows(predicted),
        # Not through float32: the measured values are compared as they were recorded.
        measured_mm=np.concatenate([recording.key_points_mm for recording in recordings]),
        pressure=np.concatenate([actuation_of(r, model.spec.actuation) for r in recordings]),
        direction=rows(direction),
        rate=rows(rate),
        dwell_s=rows(history.t_s - last),
        t_s=rows(history.t_s),
        run=history.run_of_row.numpy(),
        recording=owner,
    )
