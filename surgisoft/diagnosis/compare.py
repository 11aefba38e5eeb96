"""`compare`: a model's error on recordings, where it sits, and how much of it is explainable."""

from dataclasses import asdict, dataclass

import numpy as np

from surgisoft.diagnosis.body_frame import COMPONENTS
from surgisoft.diagnosis.bootstrap import block_bootstrap, block_sums, blocks
from surgisoft.diagnosis.comparing.axes import AxisShare, shares
from surgisoft.diagnosis.comparing.bands import Band, bands
from surgisoft.diagnosis.comparing.ceiling import Ceiling, ceiling
from surgisoft.diagnosis.comparing.floor import Floor, hold_floor, noise_floor, repeat_floor
from surgisoft.diagnosis.inputs import Model, Recordings, open_inputs
from surgisoft.diagnosis.residuals import Residuals, residuals
from surgisoft.errors import InputError
from surgisoft.files import json_safe
from surgisoft.measurement.recordings import Recording

WORST = 5
"""Worst moments that are listed."""
LEAST_ROWS = 60
"""Fewest measured rows from which shares and a ceiling are computed."""
AT_FLOOR = 1.05
"""An error below this multiple of the floor stands at it."""
LEAST_SHARE = 0.05
"""Smallest share of the error for which an axis is named."""


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
class TimeShift:
    """By how much time the arm trails the model, as far as that fits the residual."""

    seconds: float
    """Positive: the arm trails, s."""
    ci95_s: tuple[float, float]
    """95 % interval from a bootstrap of blocks, s."""


@dataclass(frozen=True)
class Comparison:
    """A model against recordings."""

    rmse_mm: float
    """RMS distance between predicted and measured key points, over all of them, mm."""
    rmse_ci95_mm: tuple[float, float]
    """95 % interval of it from a bootstrap of blocks of time, mm."""
    tip_rmse_mm: float
    """The same of the last key point, mm."""
    per_key_point_mm: tuple[float, ...]
    """The same of each key point, base to tip, mm."""
    components_mm: dict[str, float]
    """RMS of the residual along the body, in its bending plane and out of it, mm."""
    mse_mm2: float
    """Mean squared error of a coordinate (the paper's MSE), mm^2."""
    floor: Floor
    """The noise floor: what the lab states, else from holds, else from repeats."""
    floors: tuple[Floor, ...]
    """Every estimate of the floor that the recordings allow."""
    ceiling: Ceiling | None
    """What a black box with memory reaches; None for too few rows."""
    axes: tuple[AxisShare, ...]
    """How much of the error each axis explains, most first."""
    time_shift: TimeShift | None
    """The arm's delay behind the model; None without time."""
    samples: int
    """Rows with at least one measured key point."""
    missing: int
    """Rows without any."""
    bands: tuple[Band, ...]
    """Error and bias in bands of every axis."""
    worst: tuple[Moment, ...]
    """The worst moments, each from another stretch of time."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""

    @property
    def explainable(self) -> float | None:
        """Share (0..1) of the squared error above the floor that the black box removes.

        None without a ceiling, or where the error stands at the floor. An unknown floor counts as
        zero.
        """
        noise = self.floor.rmse_mm or 0.0
        excess = self.rmse_mm**2 - noise**2
        if self.ceiling is None or self.rmse_mm <= AT_FLOOR * noise or excess <= 0:
            return None
        return float(np.clip((self.rmse_mm**2 - self.ceiling.rmse_mm**2) / excess, 0, 1))

    @property
    def main_axes(self) -> list[AxisShare]:
        """The best axis, and the best of the other kind (static or memory), where they matter."""
        found = [a for a in self.axes if a.share >= LEAST_SHARE and a.ci95[0] > 0]
        other = [a for a in found[1:] if a.static != found[0].static]
        return found[:1] + other[:1]

    @property
    def sentence(self) -> str:
        """The verdict: error, floor, ceiling, and what the error depends on."""
        noise = self.floor.rmse_mm
        text = f"error {_mm(self.rmse_mm)}, floor {'unknown' if noise is None else _mm(noise)}"
        if noise is not None and self.rmse_mm <= AT_FLOOR * noise:
            return f"{text}: the error stands at the floor"
        if self.ceiling is None:
            return f"{text}; too few rows to say what it depends on"
        text += f", a black box would reach {_mm(self.ceiling.rmse_mm)}"
        what = "error" if noise is None else "excess"
        text += f": {100 * (self.explainable or 0):.0f} % of the {what} is explainable"
        return f"{text}; {self._depends()}"

    def _depends(self) -> str:
        main = [f"{a.axis} ({100 * a.share:.0f} %)" for a in self.main_axes]
        if not main:
            return "it depends clearly on no single axis"
        text = f"it depends most on {main[0]}"
        if len(main) > 1:
            text += f", {'beyond that' if self.main_axes[0].static else 'then'} on {main[1]}"
        return text

    def to_json(self) -> dict:
        """Plain values: `rmse_mm`, `per_key_point_mm`, `tip_rmse_mm`, `floor_mm` and the rest."""
        values = asdict(self)
        floor, top = values.pop("floor"), values.pop("ceiling")
        values |= {
            "sentence": self.sentence,
            "floor_mm": floor["rmse_mm"],
            "floor_source": floor["source"],
            "floors": {each.source: each.rmse_mm for each in self.floors},
            "ceiling_mm": top and top["rmse_mm"],
            "ceiling_ci95_mm": top and top["ci95_mm"],
            "explainable": self.explainable,
        }
        return json_safe(values)


def compare(model: Model, recordings: Recordings) -> tuple[Comparison, Residuals]:
    """Evaluate a model on recordings; both may be given by their paths."""
    model, recordings, notes = open_inputs(model, recordings)
    rest = residuals(model, recordings)
    square = np.square(rest.error_mm)
    seen = ~np.isnan(square).all(axis=1)
    if not np.isfinite(rest.predicted_mm).all():
        raise InputError("the model predicts values that are not finite; fit it again")
    if not seen.any():
        raise InputError("no key point was measured in any row of the recordings")
    block = blocks(rest.run)
    per_point = np.sqrt([_nanmean(square[:, k]) for k in range(square.shape[1])])
    floors = _floors(rest, recordings)
    enough = int(seen.sum()) >= LEAST_ROWS
    return (
        Comparison(
            rmse_mm=float(np.sqrt(_nanmean(square))),
            rmse_ci95_mm=_root_interval(square, block),
            tip_rmse_mm=float(per_point[-1]),
            per_key_point_mm=tuple(float(value) for value in per_point),
            components_mm={
                name: float(np.sqrt(_nanmean(np.square(rest.body_mm[..., k]))))
                for k, name in enumerate(COMPONENTS)
            },
            mse_mm2=_nanmean(square) / 3,
            floor=floors[0] if floors else Floor(None, "unknown"),
            floors=floors,
            ceiling=black_box(rest) if enough else None,
            axes=tuple(shares(rest)) if enough else (),
            time_shift=time_shift(rest, block),
            samples=int(seen.sum()),
            missing=int((~seen).sum()),
            bands=tuple(bands(rest)),
            worst=tuple(_worst(rest, recordings)),
            notes=notes,
        ),
        rest,
    )


def black_box(rest: Residuals, seed: int = 0) -> Ceiling:
    """The explainable ceiling of residuals."""
    gates = np.concatenate([rest.scaled_pressure, rest.direction], axis=1)
    return ceiling(rest.residual_mm, rest.features, gates, blocks(rest.run), seed)


def time_shift(rest: Residuals, block: np.ndarray) -> TimeShift | None:
    """The delay tau for which residual = -tau x predicted velocity fits best, in least squares.

    The velocity is the predicted motion over the row before and the row after.
    """
    inside = np.zeros(len(rest.run), bool)
    inside[1:-1] = (rest.run[2:] == rest.run[:-2]) & rest.timed[1:-1]
    rows = np.flatnonzero(inside)
    if not len(rows):
        return None
    motion = np.zeros_like(rest.predicted_mm)
    dt = rest.t_s[rows + 1] - rest.t_s[rows - 1]
    step = rest.predicted_mm[rows + 1] - rest.predicted_mm[rows - 1]
    motion[rows] = step / dt[:, None, None]
    motion = np.where(np.isnan(rest.residual_mm), 0.0, motion)
    won = block_sums(-(np.nan_to_num(rest.residual_mm) * motion).sum((1, 2)), block)
    power = block_sums(np.square(motion).sum((1, 2)), block)
    if power.sum() <= 0:
        return None
    low, high = block_bootstrap(lambda a, b: a / b, (won, power))
    return TimeShift(float(won.sum() / power.sum()), (float(low), float(high)))


def _floors(rest: Residuals, recordings: list[Recording]) -> tuple[Floor, ...]:
    known = [noise_floor(recordings)]
    if known[0].source == "sidecar":
        known.append(hold_floor(recordings))
    known.append(repeat_floor(rest))
    return tuple(floor for floor in known if floor.rmse_mm is not None)


def _root_interval(square: np.ndarray, block: np.ndarray) -> tuple[float, float]:
    sums = (block_sums(square, block), block_sums(~np.isnan(square), block))
    low, high = block_bootstrap(lambda a, b: np.sqrt(a.sum(1) / b.sum(1)), sums)
    return float(low), float(high)


def _mm(value: float) -> str:
    return f"{value:.2f} mm" if value >= 0.095 else f"{value:.3f} mm"


def _nanmean(values: np.ndarray) -> float:
    seen = values[~np.isnan(values)]
    return float(seen.mean()) if len(seen) else float("nan")


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
