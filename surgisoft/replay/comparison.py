"""Replays of models beside a recording, and of a recording before and after a change."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from surgisoft.error_scale import Scale, bar_length, body_size, error_scale, quantile, stretch_of
from surgisoft.errors import InputError
from surgisoft.palette import model_colour, rgb
from surgisoft.replay.colours import (
    BACKGROUND,
    ERROR_STOPS,
    MEASURED_COLOUR,
    PLAN_COLOUR,
    REAL_COLOUR,
    error_colours,
)
from surgisoft.replay.contents import TIME
from surgisoft.replay.episode_view import Replay
from surgisoft.replay.legends import legend_picture
from surgisoft.replay.plots import Line, series_colour, time_axis
from surgisoft.replay.recording import LEGEND, LEVELS, Columns, new_recording
from surgisoft.replay.shapes import finer
from surgisoft.tasks.episodes.parts import Event
from surgisoft.time_axis import continued, pauses
from surgisoft.units import actuation_word
from surgisoft.viewpoint import upright

MOST_ROWS = 6000
"""Of longer comparisons so many rows are shown, one in each of as many equal parts (`_thinned`)."""
LINE_MM = 2.0
"""Spacing of the drawn centreline's points (mm)."""
MEASURED_WIDE, PREDICTED_WIDE, POINT_WIDE, ARROW_WIDE, BAR_WIDE = 0.008, 0.012, 0.014, 0.006, 0.005
"""Radii of what is drawn, as shares of the body's length: a short and a long arm look alike. The
second body is dashed and thicker, so that both are seen where one lies in the other."""
DASHES, DASH_SHARE, DASH_POINTS = 12, 0.4, 4
"""Dashes along a body, how much of their spacing they fill, and the points of each."""
BARS_SHARE = 0.25
"""Room for the scale bars below the workspace, as a share of the body's length."""
AWAY = 1.1
"""Distance of the eye, in units of the workspace's diagonal: all of it is in view (a sphere around
it would need 1.08 at the viewer's opening of 55 degrees)."""
SEEN, EVENTS = "/seen", "/events"
"""Entities of the text panel and of the events."""


class View:
    """From where bodies are seen: their workspace in axes of which the third is up on the bench."""

    def __init__(
        self,
        points_mm: np.ndarray,
        gravity: Sequence[float] | np.ndarray | None = None,
        below_mm: float = 0.0,
    ):
        """points_mm: (S, n, 3) key points, base frame; gravity: direction of the weight (3,), or
        None; below_mm: room below them, mm."""
        self.axes = np.stack(upright(gravity))
        """(3, 3) unit vectors to the right, away from the eye and up, base frame."""
        points = points_mm[np.isfinite(points_mm).all(-1)] @ self.axes.T
        self.low_mm, self.high_mm = points.min(axis=0), points.max(axis=0)
        """(3,) corners of the workspace in these axes, mm."""
        self.below_mm = below_mm


def write_comparison(
    t_s: np.ndarray,
    measured_mm: np.ndarray,
    predicted_mm: np.ndarray | Mapping[str, np.ndarray],
    name: str,
    path: str | Path,
    pressure: np.ndarray | None = None,
    unit: str = "kPa",
    *,
    seen: str = "",
    events: Sequence[Event] = (),
    large_mm: float | None = None,
    gravity: Sequence[float] | np.ndarray | None = None,
) -> Replay:
    """Write measured against predicted key points as an .rrd file.

    t_s (S,) s; a new run begins where it decreases. measured_mm (S, n, 3) and predicted_mm
    (S, n, 3) are in the base frame, nan where missing; predicted_mm of several models by their
    names are shown side by side, with one scale of their errors. pressure (S, m) in `unit` is
    plotted if given. `name` describes the comparison, `seen` is Markdown that says what is seen,
    and the times of `events` are on the axis of `continued`. The bodies nearly coincide, so the
    predicted one is dashed, and each error is also drawn as an arrow from measured to predicted,
    magnified, and coloured from none to `large_mm` (default: the 95 % quantile of the worst model,
    rounded up). gravity: direction of the weight (3,), base frame, which is drawn downward; None:
    not known, z is drawn upward.
    """
    began, path = time.perf_counter(), Path(path)
    models = predicted_mm if isinstance(predicted_mm, Mapping) else {"model": predicted_mm}
    t_s, measured = np.asarray(t_s, float), np.asarray(measured_mm, float)
    models = {label: np.asarray(points, float) for label, points in models.items()}
    for points in models.values():
        _check(t_s, measured, points)
    whole = {label: np.linalg.norm(points - measured, axis=-1) for label, points in models.items()}
    scale = error_scale(measured, list(whole.values()), large_mm)
    keep = _thinned(*whole.values())
    time_s = continued(t_s)[keep]
    measured = measured[keep]
    models = {label: points[keep] for label, points in models.items()}
    errors = {label: error[keep] for label, error in whole.items()}
    pressure = None if pressure is None else np.asarray(pressure, float)[keep]
    lines = _lines(errors, pressure, unit)
    view = View(measured, gravity, BARS_SHARE * scale.body_mm)
    blueprint = _layout(view, whole, lines, scale, float(time_s[-1]), bool(seen), bool(events))
    with new_recording(path, "surgisoft_comparison", name, blueprint) as recording:
        columns = Columns(recording, time_s)
        recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        body = scale.body_mm
        _log_body(columns, "/measured", measured, MEASURED_COLOUR, MEASURED_WIDE * body)
        _log_bars(recording, view, scale)
        for number, (label, points) in enumerate(models.items(), 1):
            where, colour = f"/model{number}", rgb(model_colour(number - 1))
            _log_body(columns, where, points, colour, PREDICTED_WIDE * body, dashed=True)
            _log_errors(columns, where, measured, points, errors[label], scale)
        for line in (line for group in lines.values() for line in group):
            columns.plot(line)
            _break_at_pauses(columns, line.entity)
        _log_legend(recording, list(models), scale)
        if seen:
            words = rr.TextDocument(seen, media_type="text/markdown")
            recording.log(SEEN, words, static=True)
        for event in events:
            recording.set_time(TIME, duration=event.time_s)
            text = f"{event.time_s:7.2f} s  {event.text}"
            recording.log(EVENTS, rr.TextLog(text, level=LEVELS[event.level]))
        recording.reset_time()
    cost = time.perf_counter() - began
    return Replay(path, path.stat().st_size / 1e6, float(time_s[-1] - time_s[0]), cost)


def write_change(
    t_s: np.ndarray,
    before_mm: np.ndarray,
    after_mm: np.ndarray,
    explained_mm: np.ndarray,
    name: str,
    path: str | Path,
    gravity: Sequence[float] | np.ndarray | None = None,
) -> Replay:
    """Write key points before and after a change, and what effects explain of it, as an .rrd file.

    t_s (S,) s; a new run begins where it decreases. before_mm, after_mm (S, n, 3) key points in the
    base frame, nan where missing; explained_mm (S, n, 3) the explained change. The body after is
    dashed. Both changes are drawn as arrows from the body before, magnified by the factor in the
    view's title: the measured one in the colour of the body after, the explained one in that of a
    plan. gravity: as for `write_comparison`.
    """
    began, path = time.perf_counter(), Path(path)
    given = (t_s, before_mm, after_mm, explained_mm)
    t_s, before, after, explained = (np.asarray(x, float) for x in given)
    _check(t_s, before, after)
    _check(t_s, before, before + explained)
    size = np.linalg.norm(after - before, axis=-1)
    large = quantile(size)
    keep = _thinned(size)
    time_s = continued(t_s)[keep]
    before, after, explained, size = before[keep], after[keep], explained[keep], size[keep]
    change = after - before
    stretch, body = stretch_of(before, large), body_size(before)
    along = _main_direction(change[:, -1])
    lines = {
        "Change of the tip along its main direction (mm)": [
            Line("/plots/change/measured", "measured", change[:, -1] @ along, REAL_COLOUR),
            Line("/plots/change/explained", "explained", explained[:, -1] @ along, PLAN_COLOUR),
        ],
        "Change of each key point (mm)": [
            Line(f"/plots/size/k{i}", f"k{i}", size[:, i], series_colour(i), keeps="Max")
            for i in range(size.shape[1])
        ],
    }
    title = f"{name}: changes x {stretch:g}"
    view = View(before, gravity)
    blueprint = _beside(title, view, ("/before", "/after", "/change"), lines, time_s[-1])
    with new_recording(path, "surgisoft_change", name, blueprint) as recording:
        columns = Columns(recording, time_s)
        recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _log_body(columns, "/before", before, MEASURED_COLOUR, MEASURED_WIDE * body)
        _log_body(columns, "/after", after, REAL_COLOUR, PREDICTED_WIDE * body, dashed=True)
        _log_arrows(columns, "/change/measured", before, stretch * change, REAL_COLOUR, body)
        _log_arrows(columns, "/change/explained", before, stretch * explained, PLAN_COLOUR, body)
        for line in (line for group in lines.values() for line in group):
            columns.plot(line)
            _break_at_pauses(columns, line.entity)
    cost = time.perf_counter() - began
    return Replay(path, path.stat().st_size / 1e6, float(time_s[-1] - time_s[0]), cost)


def _main_direction(change: np.ndarray) -> np.ndarray:
    """(3,) unit vector along which changes (S, 3) are largest."""
    return np.linalg.svd(np.nan_to_num(change), full_matrices=False)[2][0]


def _log_arrows(columns: Columns, entity: str, origins, vectors, colour, body_mm) -> None:
    """Log one arrow from each key point; missing values are omitted."""
    known = np.isfinite(origins + vectors).all(-1)
    rows, counts = np.flatnonzero(known.any(1)), known.sum(1)
    style = rr.Arrows3D.from_fields(colors=colour, radii=ARROW_WIDE * body_mm)
    columns.recording.log(entity, style, static=True)
    arrows = rr.Arrows3D.columns(origins=origins[known], vectors=vectors[known])
    columns.send(entity, rows, arrows.partition(counts[rows]))


def _thinned(*errors_mm: np.ndarray) -> np.ndarray:
    """(K,) rows to show, at most `MOST_ROWS`, in order.

    errors_mm: (T, n) each, NaN where nothing was measured. Between the first and the last row, of
    each of as many equal parts the row with the largest error is kept: a peak of one row is seen.
    """
    rows = len(errors_mm[0])
    if rows <= MOST_ROWS:
        return np.arange(rows)
    seen = [np.where(np.isfinite(each), each, -1.0).max(axis=1) for each in errors_mm]
    largest = np.max(seen, axis=0)
    edges = np.linspace(1, rows - 1, MOST_ROWS - 1).round().astype(int)
    inner = [a + largest[a:b].argmax() for a, b in itertools.pairwise(edges)]
    return np.array([0, *inner, rows - 1])


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


def _lines(errors: Mapping[str, np.ndarray], pressure, unit: str) -> dict[str, list[Line]]:
    """Lines of each plot by its title."""
    groups = {}
    if len(errors) > 1:
        groups["Error of the tip (mm)"] = [
            Line(f"/plots/tip/model{i}", label, error[:, -1], rgb(model_colour(i - 1)), keeps="Max")
            for i, (label, error) in enumerate(errors.items(), 1)
        ]
    for number, (label, error) in enumerate(errors.items(), 1):
        of = f", {label}" if len(errors) > 1 else ""
        where = f"/plots/error/model{number}"
        groups[f"Error of each key point (mm){of}"] = [
            Line(f"{where}/k{i}", name, values, series_colour(i), keeps="Max")
            for i, (name, values) in enumerate(zip(_names(error.shape[1]), error.T, strict=True))
        ]
    if pressure is not None:
        what = actuation_word(unit)
        one = "chamber" if what == "pressure" else "channel"
        groups[f"{what.capitalize()} ({unit})"] = [
            Line(f"/plots/pressure/p{i + 1}", f"{one} {i + 1}", pressure[:, i], series_colour(i))
            for i in range(pressure.shape[1])
        ]
    return groups


def _names(count: int) -> list[str]:
    """Names of `count` key points; of several, the ends of the arm are told."""
    ends = {0: " (base)", count - 1: " (tip)"} if count > 1 else {}
    return [f"k{i}{ends.get(i, '')}" for i in range(count)]


def _break_at_pauses(columns: Columns, entity: str) -> None:
    """End a plot's line before each pause, so that none is drawn across it."""
    time_s = columns.time_s
    last = pauses(time_s)
    ends = 0.9 * time_s[last] + 0.1 * time_s[last + 1]
    if len(ends):
        nothing = rr.Scalars.columns(scalars=np.full(len(ends), np.nan))
        times = [rr.TimeColumn(TIME, duration=ends)]
        columns.recording.send_columns(entity, indexes=times, columns=nothing)


def _log_body(
    columns: Columns, entity: str, points, colour, radius: float, *, dashed: bool = False
) -> None:
    """Log a spline through the key points of each row in which all are known and distinct."""
    apart = (np.linalg.norm(np.diff(points, axis=1), axis=-1) > 1e-6).all(1)
    rows = np.flatnonzero(np.isfinite(points).all((1, 2)) & apart)
    if points.shape[1] < 2 or not len(rows):
        return
    style = rr.LineStrips3D.from_fields(colors=colour, radii=radius)
    columns.recording.log(f"{entity}/body", style, static=True)
    lines = [finer(points[row], LINE_MM).astype(np.float32) for row in rows]
    strips = [dash for line in lines for dash in dashes(line)] if dashed else lines
    counts = np.full(len(rows), DASHES if dashed else 1)
    columns.send(f"{entity}/body", rows, rr.LineStrips3D.columns(strips=strips).partition(counts))


def dashes(line_mm: np.ndarray) -> np.ndarray:
    """Dashes (DASHES, DASH_POINTS, 3) along a line (K, 3), the first from its begin, the last to
    its end."""
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line_mm, axis=0), axis=1))]
    begin = np.arange(DASHES)[:, None] + DASH_SHARE * np.linspace(0.0, 1.0, DASH_POINTS)
    places = begin * along[-1] / (DASHES - 1 + DASH_SHARE)
    found = [np.interp(places, along, values) for values in line_mm.T]
    return np.stack(found, axis=-1).astype(np.float32)


def _log_errors(columns: Columns, where: str, measured, predicted, error, scale: Scale) -> None:
    """Log key points coloured by error, and an arrow for each; missing values are omitted."""
    known = np.isfinite(error)
    rows, counts = np.flatnonzero(known.any(1)), known.sum(1)
    counts = counts[rows]
    colours = error_colours(error[known], scale.large_mm)
    points = rr.Points3D.columns(positions=measured[known], colors=colours)
    style = rr.Points3D.from_fields(radii=POINT_WIDE * scale.body_mm)
    columns.recording.log(f"{where}/errors/points", style, static=True)
    columns.send(f"{where}/errors/points", rows, points.partition(counts))
    vectors = scale.stretch * (predicted - measured)[known]
    arrows = rr.Arrows3D.columns(origins=measured[known], vectors=vectors, colors=colours)
    thick = rr.Arrows3D.from_fields(radii=ARROW_WIDE * scale.body_mm)
    columns.recording.log(f"{where}/errors/arrows", thick, static=True)
    columns.send(f"{where}/errors/arrows", rows, arrows.partition(counts))


def _log_bars(recording, view: View, scale: Scale) -> None:
    """Log two bars below the workspace: one of lengths, one of the magnified errors."""
    length = scale.bar_mm
    error = bar_length(length / scale.stretch)
    low, high = view.low_mm, view.high_mm
    corner = np.array([0.5 * (low[0] + high[0] - length), low[1], low[2] - 0.12 * scale.body_mm])
    strips, labels = [], []
    for row, (drawn, text) in enumerate(
        ((length, f"{length:g} mm"), (scale.stretch * error, f"error of {error:g} mm"))
    ):
        start = corner - np.array([0.0, 0.0, 0.10 * row * scale.body_mm])
        strips.append(np.stack((start, start + np.array([drawn, 0.0, 0.0]))) @ view.axes)
        labels.append(text)
    bars = rr.LineStrips3D(
        strips,
        colors=[MEASURED_COLOUR, ERROR_STOPS[-1]],
        radii=BAR_WIDE * scale.body_mm,
        labels=labels,
        show_labels=True,
    )
    recording.log("/bars", bars, static=True)


def _log_legend(recording, names: Sequence[str], scale: Scale) -> None:
    picture = rr.EncodedImage(contents=legend_picture(names, scale), media_type="image/png")
    recording.log(LEGEND, picture, static=True)


def _layout(view: View, errors, lines, scale: Scale, end_s: float, seen: bool, events: bool):
    """Models side by side over legend and text; plots and events to the right."""
    views = []
    for number, (label, error) in enumerate(errors.items(), 1):
        known = error[np.isfinite(error)]
        rms = float(np.sqrt(np.square(known).mean()))
        title = f"{label}: error {rms:.3g} mm (arrows x {scale.stretch:g})"
        shown = ("/measured", "/bars", f"/model{number}")
        views.append(_space(title, view, shown))
    bodies = views[0] if len(views) == 1 else rrb.Horizontal(*views)
    below: list = [rrb.Spatial2DView(origin=LEGEND, name="Legend", background=BACKGROUND)]
    if seen:
        below.append(rrb.TextDocumentView(origin=SEEN, name="What is seen"))
    left = rrb.Vertical(bodies, rrb.Horizontal(*below), row_shares=[2.6, 1.0])
    plots = [_plot(title, group, end_s) for title, group in lines.items()]
    tabs = [plot for plot in plots if "each key point" in str(plot.name)]
    cells: list = [plot for plot in plots if plot not in tabs]
    cells.insert(min(1, len(errors) - 1), tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs))
    if events:
        hidden = rrb.encodings.TimelineColumn(TIME, visible=False)
        log = rrb.TextLogColumns(timeline_columns=[hidden], text_log_columns=["LogLevel", "Body"])
        cells.append(rrb.TextLogView(origin=EVENTS, name="Events", columns=log))
    right = rrb.Vertical(*cells)
    return _window(rrb.Horizontal(left, right, column_shares=[1.1, 1.0]))


def _plot(title: str, group: Sequence[Line], end_s: float) -> rrb.TimeSeriesView:
    """A plot of the whole time, with room for its legend at the end: it hides no curve."""
    return rrb.TimeSeriesView(
        origin="/",
        contents=[line.entity for line in group],
        name=title,
        plot_legend=rrb.PlotLegend(corner="righttop", visible=len(group) > 1),
        axis_x=time_axis(end_s),
    )


def _space(title: str, view: View, entities: Sequence[str]) -> rrb.Spatial3DView:
    """A view of some entities in space."""
    low, high = view.low_mm - [0.0, 0.0, view.below_mm], view.high_mm
    middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    eye = middle + AWAY * size * np.array([0.35, -0.9, 0.3])
    return rrb.Spatial3DView(
        origin="/",
        contents=[f"+ {entity}/**" for entity in entities],
        name=title,
        background=rrb.Background(BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            position=eye @ view.axes, look_target=middle @ view.axes, eye_up=view.axes[2]
        ),
    )


def _window(content) -> rrb.Blueprint:
    return rrb.Blueprint(
        content,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="paused"),
    )


def _beside(title: str, view: View, entities, lines, end_s: float) -> rrb.Blueprint:
    """A view of some entities in space, beside the plots."""
    plots = [_plot(title, group, end_s) for title, group in lines.items()]
    return _window(rrb.Horizontal(_space(title, view, entities), rrb.Vertical(*plots)))
