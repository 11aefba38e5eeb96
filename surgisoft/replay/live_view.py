"""A run while it lasts: measured and predicted body, pressures, residual and alarm level.

The data go to the viewer sample by sample, to a file, or to both. Rerun sends them in threads of
its own, so that the loop that logs them does not wait.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from surgisoft.error_scale import STRETCH_OF_ERROR, bar_length, rounded_up
from surgisoft.errors import InputError
from surgisoft.files import new_file
from surgisoft.replay.colours import (
    BACKGROUND,
    ERROR_NAMES,
    LIMIT_COLOUR,
    MEASURED_COLOUR,
    PLAN_COLOUR,
    PREDICTED_COLOUR,
    REAL_COLOUR,
    error_colours,
    paler,
    series_colour,
)
from surgisoft.replay.plots import Corner, Kept, last_seconds, time_axis
from surgisoft.replay.recording import LEGEND, SUFFIX, TIME, event_lines
from surgisoft.replay.shapes import finer
from surgisoft.replay.viewer import (
    LOCAL,
    free_port,
    running,
    wait_for_port,
    web_address,
)
from surgisoft.units import actuation_word
from surgisoft.viewpoint import upright

LINE_MM = 2.0
"""Spacing of the drawn centreline's points (mm)."""
LARGE_MM = 1.0
"""Smallest residual at which the colour scale of the key points ends (mm)."""
LARGE_TIMES = 3.0
"""That residual in validated errors of the model, which is rounded up: a change that is told leaves
a few of them."""
LEGEND_SHARE = 0.04
"""Height of one entry of a legend, as a share of the column of plots in a window of 1000 px."""
MOST_LEGEND = 0.5
"""Largest share of that column that a plot takes for its legend."""
EVENT_COLUMNS = 52
"""Characters of a line of the events: the viewer shows one line of a text, cut at the edge."""
WINDOW_S = 60.0
"""Time that the plots show while the run lasts (s)."""
PAUSE_S = 2.0
"""Time between two samples beyond which the lines of the plots are broken, s."""
FLUSH_S = 30.0
"""Longest time that is waited for the view's last data to be written, s; rerun-sdk 0.41 would wait
for ever where a disk is full."""
EVENTS = "/events"
"""Entity of the text log."""
LEGEND_TEXT = """- **white**: measured body
- **red**: body that the model predicts
- **points**: measured key points, {colours} from 0 to {large:g} mm of residual, and beyond
- **arrows**: error, from the measured to the predicted point, {stretch:g} times as long

The alarm level begins when the reference of the change detector is complete.
"""


@dataclass(frozen=True)
class LiveBench:
    """Properties of a rig that the view needs."""

    chambers: int
    """Number m of chambers."""
    key_points: int
    """Number n of key points."""
    unit: str
    """Unit of the actuation."""
    length_mm: float
    """Length of the arm (mm)."""
    title: str
    """What runs on which rig."""
    tracks: bool
    """Whether a policy does a task, whose error is shown."""
    error_mm: float | None = None
    """Validated error of the model (mm); None where it is not known."""
    gravity: tuple[float, ...] | None = None
    """Direction of the weight in the arm's base frame; None: not known, z is drawn upward."""

    @property
    def large_mm(self) -> float:
        """Residual at which the colour scale of the key points ends (mm)."""
        return max(LARGE_MM, rounded_up(LARGE_TIMES * (self.error_mm or 0.0)))

    @property
    def stretch(self) -> float:
        """Factor by which the drawn residual is magnified."""
        return max(1.0, bar_length(STRETCH_OF_ERROR * self.length_mm / self.large_mm))

    @property
    def legend(self) -> str:
        """What the colours mean, as Markdown."""
        return LEGEND_TEXT.format(
            colours=" to ".join(ERROR_NAMES), large=self.large_mm, stretch=self.stretch
        )


class LiveView:
    """Logs a run to a Rerun recording, sample by sample."""

    def __init__(self, recording: rr.RecordingStream, bench: LiveBench):
        self.recording, self.bench = recording, bench
        self.end_s = 0.0
        recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for entity, colour, radius in (
            ("measured", MEASURED_COLOUR, 0.5),
            ("predicted", PREDICTED_COLOUR, 0.3),
        ):
            style = rr.LineStrips3D.from_fields(colors=colour, radii=radius)
            recording.log(f"/body/{entity}", style, static=True)
        recording.log("/body/points", rr.Points3D.from_fields(radii=1.3), static=True)
        recording.log("/body/residual", rr.Arrows3D.from_fields(radii=0.3), static=True)
        chambers, points = range(bench.chambers), range(bench.key_points)
        colours = [series_colour(i) for i in chambers]
        names = [f"command {i + 1}" for i in chambers]
        self._lines("pressure/sent", names, [paler(colour) for colour in colours], 1.0)
        self._lines("pressure/measured", [f"chamber {i + 1}" for i in chambers], colours)
        colours = [series_colour(i) for i in points]
        self._lines("residual/key_points", [f"k{i}" for i in points], colours, keeps="Max")
        self._lines("alarm/level", ["alarm level"], [REAL_COLOUR], keeps="Max")
        self._lines("alarm/threshold", ["alarm"], [LIMIT_COLOUR], 1.0)
        self._lines("tracking/error", ["error"], [PLAN_COLOUR], keeps="Max")
        text = rr.TextDocument(bench.legend, media_type="text/markdown")
        recording.log(LEGEND, text, static=True)

    def sample(
        self,
        t_s: float,
        measured_mm: np.ndarray,
        predicted_mm: np.ndarray,
        pressure: np.ndarray,
        command: np.ndarray,
        statistic: float,
    ) -> None:
        """Show a sample: key points (n, 3) in the base frame, nan where missing; pressures (m,).

        statistic: the detector's largest chart over its threshold, nan where there is none.
        """
        log = self.recording.log
        if t_s - self.end_s > PAUSE_S:
            self._break_lines(len(pressure), len(measured_mm))
        self.end_s = t_s
        self.recording.set_time(TIME, duration=t_s)
        residual = measured_mm - predicted_mm
        known = np.isfinite(residual).all(axis=1)
        size = np.linalg.norm(residual, axis=1)
        log("/body/predicted", rr.LineStrips3D([_curve(predicted_mm)]))
        if known.sum() > 1:
            log("/body/measured", rr.LineStrips3D([_curve(measured_mm[known])]))
        if known.any():
            colours = error_colours(size[known], self.bench.large_mm)
            log("/body/points", rr.Points3D(measured_mm[known], colors=colours))
            arrows = -self.bench.stretch * residual[known]
            drawn = rr.Arrows3D(origins=measured_mm[known], vectors=arrows, colors=colours)
            log("/body/residual", drawn)
        log("/plots/pressure/measured", rr.Scalars(pressure))
        log("/plots/pressure/sent", rr.Scalars(command))
        log("/plots/residual/key_points", rr.Scalars(size))
        if not math.isnan(statistic):
            log("/plots/alarm/level", rr.Scalars(statistic))
            log("/plots/alarm/threshold", rr.Scalars(1.0))

    def _break_lines(self, chambers: int, points: int) -> None:
        """End the lines of the plots behind the last sample: the arm rests between two runs."""
        self.recording.set_time(TIME, duration=self.end_s + 1e-3)
        for place, count in (
            ("pressure/measured", chambers),
            ("pressure/sent", chambers),
            ("residual/key_points", points),
            ("alarm/level", 1),
        ):
            self.recording.log(f"/plots/{place}", rr.Scalars([math.nan] * count))

    def tracking(self, t_s: float, error_mm: float) -> None:
        """Show the error of the policy's task (mm)."""
        if not math.isnan(error_mm):
            self.recording.set_time(TIME, duration=t_s)
            self.recording.log("/plots/tracking/error", rr.Scalars(error_mm))

    def event(self, t_s: float, text: str, serious: bool = False) -> None:
        """Show what happened at a time (s)."""
        self.recording.set_time(TIME, duration=t_s)
        level = "ERROR" if serious else "INFO"
        for line in event_lines(t_s, text, EVENT_COLUMNS):
            self.recording.log(EVENTS, rr.TextLog(line, level=level))

    def _lines(
        self,
        place: str,
        names: list[str],
        colours: list,
        width: float = 1.6,
        keeps: Kept = "Average",
    ) -> None:
        """Log the style of a plot's lines; keeps: what is drawn of samples in one column."""
        style = rr.SeriesLines(
            names=names,
            colors=colours,
            widths=[width] * len(names),
            aggregation_policy=keeps,
        )
        self.recording.log(f"/plots/{place}", style, static=True)


def _curve(points_mm: np.ndarray) -> np.ndarray:
    """The drawn line through key points (k, 3) (mm)."""
    apart = np.linalg.norm(np.diff(points_mm, axis=0), axis=1) > 1e-6
    kept = points_mm[np.concatenate([[True], apart])]
    return finer(kept, LINE_MM).astype(np.float32) if len(kept) > 1 else kept.astype(np.float32)


def live_blueprint(bench: LiveBench, end_s: float | None = None) -> rrb.Blueprint:
    """The layout: bodies, events and colours beside plots.

    end_s: length of a run that is over, which is shown as a whole; None: the last minute of one
    that goes on.
    """
    length = bench.length_mm
    middle = np.array([0.0, 0.0, 0.5 * length])
    side, into, up = upright(bench.gravity)
    eye = middle + 1.45 * length * (0.3 * side - 0.85 * into + 0.35 * up)
    scene = rrb.Spatial3DView(
        origin="/",
        contents=["+ /body/**"],
        name=f"{bench.title} (arrows x {bench.stretch:g})",
        background=rrb.Background(BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=True),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=middle, eye_up=up),
    )
    span = None
    if end_s is None:
        last = rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S)
        now = rrb.TimeRangeBoundary.cursor_relative()
        span = [rrb.VisibleTimeRange(TIME, start=last, end=now)]

    def plot(place: str, title: str, corner: Corner | None) -> rrb.TimeSeriesView:
        legend = rrb.PlotLegend(corner=corner) if corner else rrb.PlotLegend(visible=False)
        return rrb.TimeSeriesView(
            origin=f"/plots/{place}",
            name=title,
            plot_legend=legend,
            time_ranges=span,
            axis_x=last_seconds(WINDOW_S) if end_s is None else time_axis(end_s),
        )

    actuation = actuation_word(bench.unit).capitalize()
    plots = [
        plot("residual", "Residual of each key point (mm)", "righttop"),
        plot("alarm", "Alarm level (alarm at 1)", None),
        plot("pressure", f"{actuation} ({bench.unit}); darker: command", "righttop"),
    ]
    if bench.tracks:
        plots.append(plot("tracking", "Error of the task (mm)", None))
    shares = [3.0, 2.0, 3.0, 2.0][: len(plots)]
    # Chambers come first in the legend, so that commands alone are cut where it is still too long.
    needed = min(MOST_LEGEND, LEGEND_SHARE * 2 * bench.chambers)
    shares[2] = max(3.0, needed / (1.0 - needed) * (sum(shares) - shares[2]))
    right = rrb.Vertical(*plots, row_shares=shares)
    hidden = rrb.encodings.TimelineColumn(TIME, visible=False)
    shown = rrb.TextLogColumns(timeline_columns=[hidden], text_log_columns=["LogLevel", "Body"])
    below = rrb.Horizontal(
        rrb.TextLogView(origin=EVENTS, name="Events", columns=shown),
        rrb.TextDocumentView(origin=LEGEND, name="Colours"),
        column_shares=[3, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, below, row_shares=[4, 1]), right, column_shares=[1.1, 1.0]
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(
            state="collapsed", timeline=TIME, play_state="following" if end_s is None else "paused"
        ),
    )


@contextlib.contextmanager
def live_view(
    bench: LiveBench,
    *,
    window: bool = False,
    web: bool = False,
    file: Path | None = None,
    on_address: Callable[[str], None] = print,
    stay: Callable[[], bool] = lambda: True,
) -> Iterator[LiveView]:
    """A view of a run in the native viewer (window), in a browser (web), in an .rrd file.

    The file appears when the block ends without an exception. on_address: called with the address
    for the browser. stay: asked at the end whether the viewer stays open until it is closed.
    """
    if window and web:
        raise InputError("expected at most one of --show and --web")
    if file is not None and Path(file).suffix != SUFFIX:
        raise InputError(f"{file}: suffix '{Path(file).suffix}', expected {SUFFIX}")
    recording = rr.RecordingStream("surgisoft_run", recording_id=bench.title, send_properties=False)
    with contextlib.ExitStack() as stack:
        targets: list = []
        viewer = None
        page, data = free_port(), free_port()
        if window or web:
            arguments = ["--bind", LOCAL, "--port", str(data)]
            if web:
                arguments += ["--serve-web", "--web-viewer-port", str(page)]
            viewer = stack.enter_context(running(*arguments, quiet=web))
            for port in (page, data) if web else (data,):
                wait_for_port(viewer, port)
            targets.append(rr.GrpcSink(f"rerun+http://{LOCAL}:{data}/proxy"))
        if file is not None:
            targets.append(rr.FileSink(stack.enter_context(new_file(file))))
        with _one_line(file):
            recording.set_sinks(*targets, default_blueprint=live_blueprint(bench))
            stack.callback(recording.disconnect)
            view = LiveView(recording, bench)
        if web:
            on_address(web_address(page, data))
        yield view
        # Without a file, what failed is a viewer that was closed, which is no error.
        with contextlib.suppress(RuntimeError), _one_line(file):
            recording.send_blueprint(live_blueprint(bench, view.end_s))
            recording.flush(timeout_sec=FLUSH_S)
        if viewer is not None and stay():
            with contextlib.suppress(KeyboardInterrupt):
                viewer.wait()


@contextlib.contextmanager
def _one_line(file: Path | None) -> Iterator[None]:
    """What rerun raises where it cannot write the file, as InputError."""
    try:
        yield
    except RuntimeError as error:
        if file is None:
            raise
        reason = str(error).splitlines()[0]
        raise InputError(f"{file}: the view is not written ({reason})") from error
