"""Replays of a model beside a recording, and of a recording before and after a change."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from surgisoft.errors import InputError
from surgisoft.replay.colours import (
    BACKGROUND,
    PLAN_COLOUR,
    REAL_COLOUR,
    SHAFT_COLOUR,
    error_colours,
)
from surgisoft.replay.contents import TIME
from surgisoft.replay.episode_view import Replay
from surgisoft.replay.plots import Line, series_colour
from surgisoft.replay.recording import Columns, new_recording
from surgisoft.replay.shapes import finer

MOST_ROWS = 6000
"""Longer comparisons are thinned evenly to so many rows."""
STRETCH_OF_ERROR = 0.15
"""Length of the drawn error at the 95 % quantile, as a share of the body's size."""
LARGE = 0.95
"""Quantile of the errors at which the colour scale ends."""
LINE_MM = 2.0
"""Spacing of the drawn centreline's points (mm)."""


def write_comparison(
    t_s: np.ndarray,
    measured_mm: np.ndarray,
    predicted_mm: np.ndarray,
    name: str,
    path: str | Path,
    pressure: np.ndarray | None = None,
    unit: str = "kPa",
) -> Replay:
    """Write measured against predicted key points as an .rrd file.

    t_s (S,) s; a new run begins where it decreases. measured_mm (S, n, 3) and predicted_mm
    (S, n, 3) are in the base frame, nan where missing. pressure (S, m) in `unit` is plotted if
    given. `name` describes the comparison. The two bodies nearly coincide, so each error is also
    drawn as an arrow from measured to predicted, magnified by the factor in the view's title.
    """
    began, path = time.perf_counter(), Path(path)
    t_s, measured, predicted = (np.asarray(x, float) for x in (t_s, measured_mm, predicted_mm))
    _check(t_s, measured, predicted)
    keep = np.unique(np.linspace(0, len(t_s) - 1, min(len(t_s), MOST_ROWS)).round().astype(int))
    time_s = continued(t_s)[keep]
    measured, predicted = measured[keep], predicted[keep]
    error = np.linalg.norm(predicted - measured, axis=-1)
    large = _quantile(error, LARGE)
    stretch = _stretch(measured, large)
    lines = _lines(error, None if pressure is None else np.asarray(pressure, float)[keep], unit)
    title = f"{name}: errors x {stretch:g}, red from {large:.2g} mm"
    blueprint = _blueprint(title, measured, ("/measured", "/predicted", "/errors"), lines)
    with new_recording(path, "surgisoft_comparison", name, blueprint) as recording:
        columns = Columns(recording, time_s)
        recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _log_body(columns, "/measured", measured, SHAFT_COLOUR, 0.5)
        _log_body(columns, "/predicted", predicted, PLAN_COLOUR, 0.3)
        _log_errors(columns, measured, predicted, error, stretch, large)
        for line in (line for group in lines.values() for line in group):
            columns.plot(line)
    cost = time.perf_counter() - began
    return Replay(path, path.stat().st_size / 1e6, float(time_s[-1] - time_s[0]), cost)


def write_change(
    t_s: np.ndarray,
    before_mm: np.ndarray,
    after_mm: np.ndarray,
    explained_mm: np.ndarray,
    name: str,
    path: str | Path,
) -> Replay:
    """Write key points before and after a change, and what effects explain of it, as an .rrd file.

    t_s (S,) s; a new run begins where it decreases. before_mm, after_mm (S, n, 3) key points in the
    base frame, nan where missing; explained_mm (S, n, 3) the explained change. Both changes are
    drawn as arrows from the body before, magnified by the factor in the view's title: the measured
    one in the colour of the body after, the explained one in that of a plan.
    """
    began, path = time.perf_counter(), Path(path)
    given = (t_s, before_mm, after_mm, explained_mm)
    t_s, before, after, explained = (np.asarray(x, float) for x in given)
    _check(t_s, before, after)
    _check(t_s, before, before + explained)
    keep = np.unique(np.linspace(0, len(t_s) - 1, min(len(t_s), MOST_ROWS)).round().astype(int))
    time_s = continued(t_s)[keep]
    before, after, explained = before[keep], after[keep], explained[keep]
    change = after - before
    size = np.linalg.norm(change, axis=-1)
    large = _quantile(size, LARGE)
    stretch = _stretch(before, large)
    along = _main_direction(change[:, -1])
    lines = {
        "Change of the tip along its main direction (mm)": [
            Line("/plots/change/measured", "measured", change[:, -1] @ along, REAL_COLOUR),
            Line("/plots/change/explained", "explained", explained[:, -1] @ along, PLAN_COLOUR),
        ],
        "Change of each key point (mm)": [
            Line(f"/plots/size/k{i}", f"k{i}", size[:, i], series_colour(i))
            for i in range(size.shape[1])
        ],
    }
    title = f"{name}: changes x {stretch:g}"
    blueprint = _blueprint(title, before, ("/before", "/after", "/change"), lines)
    with new_recording(path, "surgisoft_change", name, blueprint) as recording:
        columns = Columns(recording, time_s)
        recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _log_body(columns, "/before", before, SHAFT_COLOUR, 0.5)
        _log_body(columns, "/after", after, REAL_COLOUR, 0.3)
        _log_arrows(columns, "/change/measured", before, stretch * change, REAL_COLOUR)
        _log_arrows(columns, "/change/explained", before, stretch * explained, PLAN_COLOUR)
        for line in (line for group in lines.values() for line in group):
            columns.plot(line)
    cost = time.perf_counter() - began
    return Replay(path, path.stat().st_size / 1e6, float(time_s[-1] - time_s[0]), cost)


def _main_direction(change: np.ndarray) -> np.ndarray:
    """(3,) unit vector along which changes (S, 3) are largest."""
    return np.linalg.svd(np.nan_to_num(change), full_matrices=False)[2][0]


def _log_arrows(columns: Columns, entity: str, origins, vectors, colour) -> None:
    """Log one arrow from each key point; missing values are omitted."""
    known = np.isfinite(origins + vectors).all(-1)
    rows, counts = np.flatnonzero(known.any(1)), known.sum(1)
    style = rr.Arrows3D.from_fields(colors=colour, radii=0.35)
    columns.recording.log(entity, style, static=True)
    arrows = rr.Arrows3D.columns(origins=origins[known], vectors=vectors[known])
    columns.send(entity, rows, arrows.partition(counts[rows]))


def continued(t_s: np.ndarray) -> np.ndarray:
    """(S,) s that never decrease: a run whose time starts again continues after the one before."""
    steps = np.diff(t_s)
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    steps = np.where(steps < 0.0, usual, steps)
    return np.concatenate(([0.0], np.cumsum(steps)))


def _check(t_s, measured, predicted) -> None:
    shape = measured.shape
    if measured.ndim != 3 or shape[-1] != 3 or not len(t_s):
        raise InputError(f"comparison: measured has shape {shape}, expected (S, n, 3), S > 0")
    if predicted.shape != shape or t_s.shape != shape[:1]:
        raise InputError(
            f"comparison: measured {shape}, predicted {predicted.shape} and times {t_s.shape} do "
            "not fit each other"
        )
    if not np.isfinite(predicted - measured).all(-1).any():
        raise InputError("comparison: no key point is both measured and predicted, nothing to draw")


def _quantile(error: np.ndarray, share: float) -> float:
    known = error[np.isfinite(error)]
    return float(np.quantile(known, share)) if len(known) else 0.0


def _stretch(measured: np.ndarray, large: float) -> float:
    """The round factor by which the drawn errors are magnified."""
    points = measured[np.isfinite(measured).all(-1)]
    size = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 1.0
    factor = STRETCH_OF_ERROR * size / max(large, 1e-9)
    rounds = [k * 10.0**p for p in range(4) for k in (1.0, 2.0, 5.0)]
    return max((r for r in rounds if r <= factor), default=1.0)


def _lines(error, pressure, unit: str) -> dict[str, list[Line]]:
    """Lines of each plot by its title."""
    count = error.shape[1]
    groups = {
        "Error of each key point (mm)": [
            Line(f"/plots/error/k{i}", f"k{i}", error[:, i], series_colour(i)) for i in range(count)
        ]
    }
    if pressure is not None:
        groups[f"Pressure ({unit})"] = [
            Line(f"/plots/pressure/p{i + 1}", f"p{i + 1}", pressure[:, i], series_colour(i))
            for i in range(pressure.shape[1])
        ]
    return groups


def _log_body(columns: Columns, entity: str, points, colour, radius: float) -> None:
    """Log a spline through the key points of each row in which all are known and distinct."""
    apart = (np.linalg.norm(np.diff(points, axis=1), axis=-1) > 1e-6).all(1)
    rows = np.flatnonzero(np.isfinite(points).all((1, 2)) & apart)
    if points.shape[1] < 2 or not len(rows):
        return
    style = rr.LineStrips3D.from_fields(colors=colour, radii=radius)
    columns.recording.log(f"{entity}/body", style, static=True)
    strips = [finer(points[row], LINE_MM).astype(np.float32) for row in rows]
    columns.send(f"{entity}/body", rows, rr.LineStrips3D.columns(strips=strips))


def _log_errors(columns: Columns, measured, predicted, error, stretch: float, large: float) -> None:
    """Log key points coloured by error, and an arrow for each; missing values are omitted."""
    known = np.isfinite(error)
    rows, counts = np.flatnonzero(known.any(1)), known.sum(1)
    counts = counts[rows]
    colours = error_colours(error[known], large)
    points = rr.Points3D.columns(positions=measured[known], colors=colours)
    columns.recording.log("/errors/points", rr.Points3D.from_fields(radii=1.3), static=True)
    columns.send("/errors/points", rows, points.partition(counts))
    arrows = rr.Arrows3D.columns(
        origins=measured[known], vectors=stretch * (predicted - measured)[known], colors=colours
    )
    columns.recording.log("/errors/arrows", rr.Arrows3D.from_fields(radii=0.35), static=True)
    columns.send("/errors/arrows", rows, arrows.partition(counts))


def _blueprint(title: str, measured, entities, lines) -> rrb.Blueprint:
    """A view of some entities in space, beside the plots."""
    points = measured[np.isfinite(measured).all(-1)]
    low, high = points.min(axis=0), points.max(axis=0)
    middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    eye = middle + 1.3 * size * np.array([0.35, -0.9, 0.3])
    scene = rrb.Spatial3DView(
        origin="/",
        contents=[f"+ {entity}/**" for entity in entities],
        name=title,
        background=rrb.Background(BACKGROUND),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=middle, eye_up=(0.0, 0.0, 1.0)),
    )
    plots = [
        rrb.TimeSeriesView(origin="/", contents=[line.entity for line in group], name=title)
        for title, group in lines.items()
    ]
    return rrb.Blueprint(
        rrb.Horizontal(scene, rrb.Vertical(*plots)),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="paused"),
    )
