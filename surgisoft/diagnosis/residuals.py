"""Where a model is wrong: measured beside predicted key points, row by row, and what goes along."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from surgisoft.diagnosis.body_frame import bending, frames
from surgisoft.diagnosis.comparing.features import Memory, features, memory_of
from surgisoft.measurement.histories import actuation_of, check_fits, history_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.model import ArmModel


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a model on recordings, all runs one after another: S rows."""

    spec: ArmSpec
    """The model's arm."""
    rest_mm: np.ndarray
    """(n, 3) key points at rest, base frame, mm."""
    predicted_mm: np.ndarray
    """(S, n, 3) predicted key points, base frame, mm."""
    measured_mm: np.ndarray
    """(S, n, 3) measured key points, base frame, mm; NaN where missing."""
    pressure: np.ndarray
    """(S, m) actuation, in the arm's unit."""
    memory: Memory
    """What the actuation's past amounts to in each row."""
    t_s: np.ndarray
    """(S,) time of the row in its recording, s."""
    run: np.ndarray
    """(S,) number of the run, counted over all recordings."""
    recording: np.ndarray
    """(S,) number of the recording."""
    timed: np.ndarray
    """(S,) whether the row is one of a continuous recording, not a settled point."""
    gravity: np.ndarray
    """(S, 3) unit vector along the weight, base frame; NaN where not known."""
    temp_C: np.ndarray
    """(S,) temperature, degrees Celsius; NaN where not known."""
    payload_g: np.ndarray
    """(S,) mass attached, g; NaN where not known."""

    @property
    def direction(self) -> np.ndarray:
        """(S, m) direction of change: -1, 0, 1."""
        return self.memory.direction

    @property
    def residual_mm(self) -> np.ndarray:
        """(S, n, 3) measured less predicted, base frame, mm; NaN where missing."""
        return self.measured_mm - self.predicted_mm

    @property
    def error_mm(self) -> np.ndarray:
        """(S, n) distance between predicted and measured key points, mm; NaN where missing."""
        return np.linalg.norm(self.residual_mm, axis=-1)

    @cached_property
    def body_mm(self) -> np.ndarray:
        """(S, n, 3) residual along the predicted body, in its bending plane and out of it, mm."""
        frame = frames(self.predicted_mm, self.rest_mm)
        return (frame @ self.residual_mm[..., None])[..., 0]

    @property
    def bending_mm(self) -> np.ndarray:
        """(S, 2) lateral displacement of the predicted tip from rest, base frame x and y, mm."""
        return bending(self.predicted_mm, self.rest_mm)

    @property
    def scaled_pressure(self) -> np.ndarray:
        """(S, m) actuation scaled to [-1, 1] over the model's range."""
        span = np.array(self.spec.span)
        return 2 * (self.pressure - np.array(self.spec.low)) / span - 1

    @cached_property
    def features(self) -> np.ndarray:
        """(S, F) all that the residual may depend on, of order 1 (see `features.features`)."""
        context = np.stack([self.temp_C, self.payload_g], axis=1)
        context = np.concatenate([context, self.gravity], axis=1)
        scale = np.array([10.0, 50.0, 1.0, 1.0, 1.0])  # C, g and unit vectors to order 1
        return features(self.memory, self.spec, context / scale, bool(self.timed.any()))


def residuals(model: ArmModel, recordings: list[Recording]) -> Residuals:
    """Evaluate a model on whole recordings."""
    check_fits(model.spec, recordings)
    history = history_of(recordings, model.spec.actuation)
    with torch.no_grad():
        predicted = history.rows(model.predict(history)).double().numpy()

    def each(pick, width: tuple[int, ...] = ()) -> np.ndarray:
        """One value a row, from what each recording has; NaN where it has nothing."""
        parts = []
        for recording in recordings:
            value = pick(recording)
            value = np.full(width, np.nan) if value is None else np.asarray(value)
            parts.append(np.broadcast_to(value, (recording.samples, *width)))
        return np.concatenate(parts)

    return Residuals(
        spec=model.spec,
        rest_mm=model.rest_mm.double().cpu().numpy(),
        predicted_mm=predicted,
        # Not through float32: the measured values are compared as they were recorded.
        measured_mm=np.concatenate([recording.key_points_mm for recording in recordings]),
        pressure=np.concatenate([actuation_of(r, model.spec.actuation) for r in recordings]),
        memory=memory_of(history, model.spec),
        t_s=history.rows(history.t_s).numpy(),
        run=history.run_of_row.numpy(),
        recording=np.concatenate([np.full(r.samples, i) for i, r in enumerate(recordings)]),
        timed=each(lambda r: r.kind == "continuous"),
        gravity=each(lambda r: r.gravity, (3,)),
        temp_C=each(lambda r: r.temp_C),
        payload_g=each(lambda r: r.payload_g),
    )
