"""Layout of a replay: the scene large, the endoscope's picture and the plots beside it."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb

from surgisoft.replay.colours import BACKGROUND
from surgisoft.replay.endoscope import CAMERA
from surgisoft.replay.plots import Plot
from surgisoft.replay.recording import STEP, TIME
from surgisoft.scene import frames
from surgisoft.tasks.episodes.log import EpisodeLog
from surgisoft.tasks.world.scene import ENDOSCOPE

SCENE = "Scene"
"""Name of the 3D view."""
TRAIL = "/path/real"
"""Entity that is shown from the start up to the present, not only as it is now."""
LEGEND = "/legend"
"""Text that explains the colours of the 3D view."""


def episode_blueprint(log: EpisodeLog, plots: tuple[Plot, ...]) -> rrb.Blueprint:
    """The layout for a log and its plots."""
    cells = _cells(plots)
    if log.camera is not None:
        cells.insert(0, rrb.Spatial2DView(origin=CAMERA, name="Endoscope"))
    pairs = [cells[i : i + 2] for i in range(0, len(cells), 2)]
    rows = [pair[0] if len(pair) == 1 else rrb.Horizontal(*pair) for pair in pairs]
    shares = [1.5 if log.camera is not None and i == 0 else 1.0 for i in range(len(rows))]
    legend = rrb.TextDocumentView(origin=LEGEND, name="Colours")
    below = rrb.Horizontal(_events(), legend, column_shares=[3, 2])
    left = rrb.Vertical(_scene(log), below, row_shares=[4.0, 1])
    right = rrb.Vertical(*rows, row_shares=shares)
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1.15, 1.0]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="playing", loop_mode="all"),
    )


def _cells(plots: tuple[Plot, ...]) -> list:
    """One view a plot, those of a group as tabs."""
    cells, groups = [], {}
    for plot in plots:
        legend = rrb.PlotLegend(visible=False)
        if plot.legend:
            legend = rrb.PlotLegend(corner=plot.legend)
        view = rrb.TimeSeriesView(
            origin="/",
            contents=[line.entity for line in plot.lines],
            name=plot.title,
            plot_legend=legend,
            axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        )
        if not plot.group:
            cells.append(view)
        elif plot.group in groups:
            groups[plot.group].append(view)
        else:
            groups[plot.group] = [view]
            cells.append(groups[plot.group])
    return [
        cell if not isinstance(cell, list) else cell[0] if len(cell) == 1 else rrb.Tabs(*cell)
        for cell in cells
    ]


def _events() -> rrb.TextLogView:
    hidden = rrb.encodings.TimelineColumn(TIME, visible=False)
    shown = rrb.TextLogColumns(timeline_columns=[hidden], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin="/events", name="Events", columns=shown)


def _scene(log: EpisodeLog) -> rrb.Spatial3DView:
    eye, target = viewpoint(log)
    so_far = [
        rrb.VisibleTimeRange(
            name,
            start=rrb.TimeRangeBoundary.infinite(),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )
        for name in (TIME, STEP)
    ]
    return rrb.Spatial3DView(
        origin="/",
        contents=["+ /**", f"- {CAMERA}/picture", "- /plots/**", "- /events", f"- {LEGEND}"],
        name=SCENE,
        background=rrb.Background(BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=not log.bodies),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0.0, 0.0, 1.0)),
        overrides={TRAIL: rrb.VisibleTimeRanges(so_far)},
    )


def viewpoint(log: EpisodeLog) -> tuple[np.ndarray, np.ndarray]:
    """Where the 3D view looks from and to (3,) mm: the arms and the work in it.

    With two arms it looks across both, from the side that the lesion faces; a lone arm is seen
    from the front, a little from above.
    """
    alone = len(log.arms) == 1
    lines = [arm.line_mm for arm in log.arms.values()]
    lines = [line[:, 0 if alone else line.shape[1] // 3 :] for line in lines]
    points = [line[np.isfinite(line).all((1, 2))].reshape(-1, 3) for line in lines]
    work = log.path_mm if len(log.path_mm) else log.target_mm
    points = np.concatenate((*points, work[np.isfinite(work).all(1)]))
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    towards, above, distance = np.array([0.3, -1.0, 0.0]), 1.0, 1.2
    if ENDOSCOPE in log.arms and len(log.arms) == 2:
        first, second = (arm.mount[:3, 3] for arm in log.arms.values())
        towards, above, distance = _across(log, first - second), 0.5, 0.8
    direction = frames.normalise(frames.normalise(towards) + np.array([0.0, 0.0, above]))
    return middle + distance * size * direction, middle


def _across(log: EpisodeLog, apart: np.ndarray) -> np.ndarray:
    """(3,) level direction from which both arms lie side by side and the lesion is seen."""
    facing = np.array([0.0, -1.0, 0.0])
    if log.dose is not None:
        normal = log.dose.normals.mean(axis=0) * [1.0, 1.0, 0.0]
        facing = frames.normalise(normal) if np.linalg.norm(normal) > 0.1 else facing
    across = np.cross([0.0, 0.0, 1.0], apart * [1.0, 1.0, 0.0])
    if np.linalg.norm(across) < 1e-6:
        return facing
    across = frames.normalise(across)
    across = across if across @ facing >= 0.0 else -across
    return across + facing
