"""`compare`: a model's error on recordings, overall and where it sits."""

from dataclasses import asdict, dataclass

import numpy as np

from surgisoft.diagnosis.floor import Floor, noise_floor
from surgisoft.diagnosis.residuals import Residuals, residuals
from surgisoft.errors import InputError
from surgisoft.measurement.recording import Recording
from surgisoft.surrogate.model import ArmModel

BANDS = 4
"""Bands of equal count that an axis is cut into."""
WORST = 5
"""Worst moments that are listed."""


@dataclass(frozen=True)
class Band:
    """The error in one band of one axis."""

    axis: str
    """What the rows were sorted by."""
    label: str
    """The band's bounds with unit."""
    rmse_mm: float
    """RMS distance over all key points, mm."""
    samples: int
    """Number of rows."""


@dataclass(frozen=True)
class Moment:
    """One of the worst moments."""

    recording: str
    """Name of the recording."""
    t_s: float
    """Time in the recording, s."""
    error_mm: float
    """Largest distance of a key point, mm."""
    key_point: int
    """Which key point, from 0 at the base."""


@dataclass(frozen=True)
class Comparison:
    """A model against recordings."""

    rmse_mm: float
    """RMS distance between predicted and measured key points, over all of them, mm."""
    tip_rmse_mm: float
    """The same of the last key point, mm."""
    per_key_point_mm: tuple[float, ...]
    """The same of each key point, base to tip, mm."""
    mse_mm2: float
    """Mean squared error of a coordinate (the paper's MSE), mm^2."""
    floor: Floor
    """The noise floor."""
    samples: int
    """Rows with at least one measured key point."""
    missing: int
    """Rows without any."""
    bands: tuple[Band, ...]
    """The error by pressure and direction; by rate and dwell where time was recorded."""
    worst: tuple[Moment, ...]
    """The worst moments, each from another stretch of time."""

    def to_json(self) -> dict:
        """Plain values: `rmse_mm`, `per_key_point_mm`, `tip_rmse_mm`, `floor_mm`, `samples` ..."""
        values = asdict(self)
        floor = values.pop("floor")
        values |= {"floor_mm": floor["rmse_mm"], "floor_source": floor["source"]}
        for name in ("rmse_mm", "tip_rmse_mm", "mse_mm2"):
            values[name] = _known(values[name])
        values["per_key_point_mm"] = [_known(value) for value in self.per_key_point_mm]
        return values


def compare(model: ArmModel, recordings: list[Recording]) -> tuple[Comparison, Residuals]:
    """Evaluate a model on recordings."""
    rest = residuals(model, recordings)
    square = np.square(rest.error_mm)
    seen = ~np.isnan(square).all(axis=1)
    if not np.isfinite(rest.predicted_mm).all():
        raise InputError("the model predicts values that are not finite; fit it again")
    if not seen.any():
        raise InputError("no key point was measured in any row of the recordings")
    timed = any(recording.kind == "continuous" for recording in recordings)
    with np.errstate(invalid="ignore"):
        per_point = np.sqrt([_nanmean(square[:, k]) for k in range(square.shape[1])])
    return (
        Comparison(
            rmse_mm=float(np.sqrt(_nanmean(square))),
            tip_rmse_mm=float(per_point[-1]),
            per_key_point_mm=tuple(float(value) for value in per_point),
            mse_mm2=_nanmean(square) / 3,
            floor=noise_floor(recordings),
            samples=int(seen.sum()),
            missing=int((~seen).sum()),
            bands=tuple(_bands(rest, square, model.spec.unit, timed)),
            worst=tuple(_worst(rest, recordings)),
        ),
        rest,
    )


def _known(value: float) -> float | None:
    """The value; None where nothing was measured, which JSON can say and NaN it cannot."""
    return None if np.isnan(value) else value


def _nanmean(values: np.ndarray) -> float:
    seen = values[~np.isnan(values)]
    return float(seen.mean()) if len(seen) else float("nan")


def _bands(rest: Residuals, square: np.ndarray, unit: str, timed: bool):
    for chamber in range(rest.pressure.shape[1]):
        yield from _cut(f"p{chamber + 1}", unit, rest.pressure[:, chamber], square)
    for chamber in range(rest.pressure.shape[1]):
        for sign, word in ((1, "rising"), (-1, "falling")):
            rows = rest.direction[:, chamber] == sign
            if rows.any():
                yield Band(f"direction {chamber + 1}", word, *_rmse(square[rows]))
    if not timed:
        return
    rate = np.abs(rest.rate).max(axis=1)
    yield from _cut("rate", f"{unit}/s", rate, square)
    yield from _cut("dwell", "s", rest.dwell_s, square)


def _rmse(square: np.ndarray) -> tuple[float, int]:
    return float(np.sqrt(_nanmean(square))), int((~np.isnan(square).all(axis=1)).sum())


def _cut(axis: str, unit: str, values: np.ndarray, square: np.ndarray):
    edges = np.unique(np.quantile(values, np.linspace(0, 1, BANDS + 1)))
    if len(edges) < 2:
        return
    band = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    for i in range(len(edges) - 1):
        rows = band == i
        if rows.any():
            label = f"{edges[i]:.4g} .. {edges[i + 1]:.4g} {unit}"
            yield Band(axis, label, *_rmse(square[rows]))


def _worst(rest: Residuals, recordings: list[Recording]):
    """The rows with the largest errors, no two within 2 % of a run's rows of each other."""
    error = np.nan_to_num(rest.error_mm, nan=-1.0)
    peak = error.max(axis=1)
    apart = max(1, len(peak) // 50)
    free = peak >= 0
    for _ in range(WORST):
        if not free.any():
            return
        row = int(np.argmax(np.where(free, peak, -1.0)))
        yield Moment(
            recordings[rest.recording[row]].name,
            float(rest.t_s[row]),
            float(peak[row]),
            int(error[row].argmax()),
        )
        free[max(0, row - apart) : row + apart + 1] = False
