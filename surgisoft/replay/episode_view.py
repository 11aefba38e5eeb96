"""An episode's log as a Rerun recording: scene in 3D, plots, endoscope pictures, events, layout."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from surgisoft.progress import Progress, silent
from surgisoft.replay.arms import log_arm
from surgisoft.replay.colours import (
    BACKGROUND,
    BEAM_COLOUR,
    LESION_COLOUR,
    PLAN_COLOUR,
    REAL_COLOUR,
    ROLE_COLOURS,
    ROLE_NAMES,
    paler,
    tissue_colours,
)
from surgisoft.replay.contents import TIME
from surgisoft.replay.endoscope import PICTURES_HZ, camera_entity, log_camera
from surgisoft.replay.legends import dose_picture
from surgisoft.replay.plots import Plot, plots_of, time_axis
from surgisoft.replay.recording import (
    LEGEND,
    LEVELS,
    STEP,
    Columns,
    event_lines,
    new_recording,
)
from surgisoft.replay.shapes import creased, widest_apart
from surgisoft.replay.surfaces import DosedSurface, dosed_surface
from surgisoft.scene import frames
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.rays import EmbreeSurface
from surgisoft.scene.render import LESION_TINT
from surgisoft.tasks.episodes.log import JUMP_MM, DoseLog, EpisodeLog

PICTURE_HEIGHT = 1.5
"""Height of the row with the endoscope's picture, in those of a row of plots."""
FITTING_LINES = 5
"""Lines of a legend that a row of plots has room for; the viewer cuts off further ones."""
LINE_HEIGHT = 0.25
"""Height that each further line takes, in rows of plots; where other rows are taller too."""
EVENT_COLUMNS = (52, 34)
"""Characters of a line of the events, which the viewer cuts at the edge; beside a dose scale."""
SCENE = "Scene"
"""Name of the 3D view."""
TRAIL = "/path/real"
"""Entity that is shown from the start of the episode up to the current time."""


DOSE = "/dose_scale"
"""Picture of the tissue's colours over its dose."""


def episode_blueprint(log: EpisodeLog, plots: tuple[Plot, ...]) -> rrb.Blueprint:
    """The layout for a log and its plots."""
    cells = [*_pictures(log), *_cells(plots, float(log.time_s[-1]))]
    pairs = [cells[i : i + 2] for i in range(0, len(cells), 2)]
    rows = [pair[0] if len(pair) == 1 else rrb.Horizontal(*pair) for pair in pairs]
    named = {plot.title: len(plot.lines) for plot in plots if plot.legend}
    shares = [_height(row, named) for row in rows]
    if log.cameras:
        shares[0] = max(PICTURE_HEIGHT, shares[0])
    legend = rrb.TextDocumentView(origin=LEGEND, name="Colours")
    below = rrb.Horizontal(_events(), legend, column_shares=[3, 2])
    if log.dose is not None:
        dose = rrb.Spatial2DView(origin=DOSE, name="Dose", background=BACKGROUND)
        below = rrb.Horizontal(_events(), legend, dose, column_shares=[3, 3, 2])
    left = rrb.Vertical(_scene(log), below, row_shares=[3.2, 1])
    right = rrb.Vertical(*rows, row_shares=shares)
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1.15, 1.0]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="playing", loop_mode="all"),
    )


def _height(row: rrb.Container | rrb.View, named: dict[str, int]) -> float:
    """Height of a row of views, in those of a row of plots: room for the longest legend in it.

    named: title of a plot -> lines in its legend.
    """
    most = max((named.get(name, 0) for name in _view_names(row)), default=0)
    return 1.0 + LINE_HEIGHT * max(0, most - FITTING_LINES)


def _pictures(log: EpisodeLog) -> list:
    """A view of the endoscope's pictures; those of several endoscopes become tabs."""
    alone = len(log.cameras) == 1
    views = [
        rrb.Spatial2DView(
            origin=camera_entity(name), name="Endoscope" if alone else f"Picture of {name}"
        )
        for name in log.cameras
    ]
    return [rrb.Tabs(*views)] if len(views) > 1 else views


def layout_names(log: EpisodeLog) -> tuple[str, ...]:
    """Names of the views in the replay of a log."""
    return tuple(_view_names(episode_blueprint(log, plots_of(log)).root_container))


def _view_names(part: rrb.Container | rrb.View) -> Iterator[str]:
    if isinstance(part, rrb.View):
        yield str(part.name)
        return
    for inner in part.contents:
        yield from _view_names(inner)


def _cells(plots: tuple[Plot, ...], end_s: float) -> list:
    """One view for each plot; the plots of a group become tabs."""
    cells: list[rrb.TimeSeriesView | list[rrb.TimeSeriesView]] = []
    groups: dict[str, list[rrb.TimeSeriesView]] = {}
    for plot in plots:
        legend = rrb.PlotLegend(visible=False)
        if plot.legend:
            legend = rrb.PlotLegend(corner=plot.legend)
        view = rrb.TimeSeriesView(
            origin="/",
            contents=[line.entity for line in plot.lines],
            name=plot.title,
            plot_legend=legend,
            axis_x=time_axis(end_s),
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
        contents=[
            "+ /**",
            *(f"- {camera_entity(name)}/**" for name in log.cameras),
            "- /plots/**",
            *(f"- {flat}" for flat in FLAT),
        ],
        name=SCENE,
        background=rrb.Background(BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=not log.bodies),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0.0, 0.0, 1.0)),
        overrides={entity: rrb.VisibleTimeRanges(so_far) for entity, _, _ in _trails(log)},
    )


def viewpoint(log: EpisodeLog) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target (3,) mm of the 3D view, with the arms and the path in the picture.

    Arms in a scene are seen side by side, from the side that the lesion faces. A single arm is seen
    from the front, a little from above.
    """
    alone = len(log.arms) == 1
    lines = [arm.line_mm for arm in log.arms.values()]
    lines = [line[:, 0 if alone else line.shape[1] // 3 :] for line in lines]
    bodies = [line[np.isfinite(line).all((1, 2))].reshape(-1, 3) for line in lines]
    work = log.path_mm if len(log.path_mm) else log.target_mm
    points = np.concatenate((*bodies, work[np.isfinite(work).all(1)]))
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    towards, above, distance = np.array([0.3, -1.0, 0.0]), 1.0, 1.2
    if len(log.arms) > 1:
        bases = np.array([arm.mount[:3, 3] for arm in log.arms.values()])
        towards, above, distance = _across(log, widest_apart(bases)), 0.5, 0.8
    direction = frames.normalise(frames.normalise(towards) + np.array([0.0, 0.0, above]))
    return middle + distance * size * direction, middle


def _across(log: EpisodeLog, apart: np.ndarray) -> np.ndarray:
    """(3,) horizontal direction from which the arms lie side by side and the lesion is seen."""
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


MOTION_HZ = 10.0
"""Rate at which bodies are drawn (1/s); plots have every step."""
FLAT = ("/events", LEGEND, DOSE)
"""Entities that views other than the 3D view show."""
PLAN_MM, REAL_MM = 0.28, 0.36
"""Radii of the reference path and, thicker so that it covers it, of the actual path (mm)."""
RING_CORNERS, RING_WIDER = 24, 1.15
"""Corners of the rings around a target body, and their radius in radii of the arm."""
DOSE_HZ = 2.5
"""Rate at which the organ's colours are updated (1/s)."""


@dataclass(frozen=True)
class Replay:
    """A replay that was written to a file."""

    path: Path
    """The .rrd file."""
    megabytes: float
    """Its size, 10^6 bytes."""
    duration_s: float
    """Duration of the episode, s."""
    cost_s: float
    """Time that writing took, s."""

    def __str__(self) -> str:
        rate = self.megabytes / max(self.duration_s, 1e-9) * 60.0
        return (
            f"{self.path}: {self.megabytes:.2f} MB for {self.duration_s:.1f} s "
            f"({rate:.1f} MB a minute), written in {self.cost_s:.1f} s"
        )


def write_replay(
    log: EpisodeLog,
    path: str | Path,
    pictures_hz: float = PICTURES_HZ,
    report: Progress = silent,
) -> Replay:
    """Write an episode's log as an .rrd file that includes its layout.

    pictures_hz: endoscope pictures per second of the episode; they take nearly all of the time.
    report: receives the number of pictures drawn, and of all pictures.
    """
    began, path = time.perf_counter(), Path(path)
    plots = plots_of(log)
    identity = f"{log.task}-{log.policy}-{log.on}-{log.seed}-{log.episode}"
    blueprint = episode_blueprint(log, plots)
    with new_recording(path, "surgisoft_episode", identity, blueprint) as recording:
        columns = Columns(recording, log.time_s)
        recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        moments = finite_rows(log, MOTION_HZ)
        _log_bodies(columns, log, moments)
        for name, arm in log.arms.items():
            log_arm(columns, name, arm, moments)
        _log_paths(columns, log, moments)
        for name in log.beams:
            _log_beam(columns, log, name, moments)
        if points_beyond_the_tip(log):
            _log_pointing_line(columns, log, moments)
        for name in log.cameras:
            log_camera(columns, log, name, moments, finite_rows(log, pictures_hz), report)
        for line in (line for plot in plots for line in plot.lines):
            columns.plot(line)
        _log_events(recording, log)
        text = rr.TextDocument(legend(log), media_type="text/markdown")
        recording.log(LEGEND, text, static=True)
        if log.dose is not None:
            _log_dose_scale(recording, log, log.dose)
    cost = time.perf_counter() - began
    return Replay(path, path.stat().st_size / 1e6, float(log.time_s[-1]), cost)


def _log_dose_scale(recording, log: EpisodeLog, dose: DoseLog) -> None:
    """Log the picture of the tissue's colours over its dose, with unit and thresholds."""
    role = next(body.role for body in log.bodies if body.name == dose.body)
    picture = dose_picture(dose.threshold_j_per_mm2, dose.cut_j_per_mm2, ROLE_COLOURS[role])
    recording.log(DOSE, rr.EncodedImage(contents=picture, media_type="image/png"), static=True)


def finite_rows(log: EpisodeLog, rate_hz: float) -> np.ndarray:
    """(R,) rows about 1 / rate_hz apart, with the last one, in which every arm is finite."""
    stride = max(1, round(1.0 / (rate_hz * log.dt_s)))
    rows = np.unique(np.append(np.arange(0, log.rows, stride), log.rows - 1))
    finite = [np.isfinite(arm.line_mm[rows]).all((1, 2)) for arm in log.arms.values()]
    return rows[np.all(finite, axis=0)]


LOOKS = 40
"""Points of the work to which lines of sight are drawn (a count)."""
MOST_HIDDEN = 0.25
"""Share of those lines that a body may cut before it is drawn see-through."""
SEE_THROUGH = 50
"""Opacity of a body in front of the work, 0..255."""


def hiding_bodies(log: EpisodeLog) -> list[str]:
    """Names of bodies between the eye of the 3D view and the work, such as a wall with ports."""
    eye, _ = viewpoint(log)
    work = np.concatenate(log.paths_mm) if log.paths_mm else log.target_mm
    work = work[np.isfinite(work).all(axis=1)]
    aims = work[:: max(1, len(work) // LOOKS)].astype(float) - eye
    away = np.linalg.norm(aims, axis=1)
    if not len(away) or away.min() <= 0.0:
        return []
    eyes, hidden = np.tile(np.asarray(eye, float), (len(aims), 1)), []
    for body in log.bodies:
        if log.dose is not None and body.name == log.dose.body:
            continue  # the tissue itself
        surface = EmbreeSurface(Mesh(body.vertices_mm, body.faces))
        met, _ = surface.first_hit(eyes, aims / away[:, None], float(away.max()) + 1.0)
        if float((met < away - 1.0).mean()) > MOST_HIDDEN:
            hidden.append(body.name)
    return hidden


def _log_bodies(columns: Columns, log: EpisodeLog, rows: np.ndarray) -> None:
    """Log every body once, and its motion in the log's `rows`; the organ's faces around the lesion
    separately, coloured by dose."""
    hiding = hiding_bodies(log)
    for body in log.bodies:
        mesh, entity = Mesh(body.vertices_mm, body.faces), f"/bodies/{body.name}"
        kept = np.ones(len(mesh.faces), dtype=bool)
        if log.dose is not None and log.dose.body == body.name:
            surface = dosed_surface(mesh, log.dose)
            kept[surface.replaced] = False
            _log_dosed(columns, log, log.dose, surface, f"{entity}/dose", ROLE_COLOURS[body.role])
        vertices, faces, normals = creased(mesh)
        plain = rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=faces[kept],
            vertex_normals=normals,
            albedo_factor=(
                *ROLE_COLOURS[body.role],
                SEE_THROUGH if body.name in hiding else 255,
            ),
        )
        columns.recording.log(entity, plain, static=True)
        if body.motion is not None:
            _log_motion(columns, entity, body.motion, rows)


def _log_motion(columns: Columns, entity: str, motion: np.ndarray, rows: np.ndarray) -> None:
    """Log how an entity and what is below it moves: affine maps (T, 4, 4), mm."""
    maps = motion[rows].astype(np.float32)
    moving = rr.Transform3D.columns(translation=maps[:, :3, 3], mat3x3=maps[:, :3, :3])
    columns.send(entity, rows, moving)


def _log_dosed(
    columns: Columns, log: EpisodeLog, dose: DoseLog, surface: DosedSurface, entity: str, base
) -> None:
    still = rr.Mesh3D(
        vertex_positions=surface.vertices_mm,
        triangle_indices=surface.faces,
        vertex_normals=surface.normals,
    )
    columns.recording.log(entity, still, static=True)
    moments = np.union1d(finite_rows(log, DOSE_HZ), [0])
    before = np.searchsorted(dose.rows, moments, side="right")
    rows = moments[np.diff(before, prepend=-1) > 0]
    tint = LESION_TINT * surface.inside[:, None]
    untouched = (1.0 - tint) * np.array(base) + tint * np.array(LESION_COLOUR)
    colours = [
        tissue_colours(surface.heat(dose.at(int(row)), dose.threshold_j_per_mm2), untouched)
        for row in rows
    ]
    count = len(surface.vertices_mm)
    changing = rr.Mesh3D.columns(vertex_colors=np.concatenate(colours))
    columns.send(entity, rows, changing.partition([count] * len(rows)))


def _log_paths(columns: Columns, log: EpisodeLog, rows: np.ndarray) -> None:
    """Log the reference path once, and over time the actual path and the target."""
    planned = log.paths_mm or _unbroken(log.target_mm)
    if planned:
        plan = rr.LineStrips3D(planned, colors=[PLAN_COLOUR], radii=[PLAN_MM])
        columns.recording.log("/path/planned", plan, static=True)
        if log.organ_motion is not None and log.paths_mm:
            _log_motion(columns, "/path/planned", log.organ_motion, rows)
    for entity, went, on in _trails(log):
        shown = np.isfinite(went).all(1) & on
        ends = np.flatnonzero(shown[1:] & shown[:-1]) + 1
        pieces = np.stack((went[ends - 1], went[ends]), axis=1)
        if len(ends):
            line = rr.LineStrips3D.from_fields(colors=REAL_COLOUR, radii=REAL_MM)
            columns.recording.log(entity, line, static=True)
            columns.send(entity, ends, rr.LineStrips3D.columns(strips=list(pieces)))
            if log.organ_motion is not None:
                _log_motion(columns, entity, log.organ_motion, rows)
    count = log.targets_mm.shape[1]
    style = rr.Points3D.from_fields(colors=PLAN_COLOUR, radii=0.55)
    columns.recording.log("/path/target", style, static=True)
    moving = rr.Points3D.columns(positions=log.targets_mm[rows].reshape(-1, 3))
    columns.send("/path/target", rows, moving.partition([count] * len(rows)))
    if count > 1 and not log.beams:
        _log_target_body(columns, log.targets_mm[rows], rows, log.arms[log.agents[0]].radius_mm)


def _trails(log: EpisodeLog) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Entity, place (T, 3) mm and shown (T,) bool of the actual path, of each beam's where several.

    With a beam the path is shown while the beam is on; on an organ that moves in its frame at rest.
    """
    if len(log.beams) > 1:
        return [
            (f"{TRAIL}/{name}", log.at_rest_mm(beam.end_mm), beam.on)
            for name, beam in log.beams.items()
        ]
    always = np.ones(log.rows, dtype=bool)
    place = log.at_rest_mm(log.actual_mm) if log.beams else log.actual_mm
    return [(TRAIL, place, always if log.burning is None else log.burning)]


def _unbroken(points_mm: np.ndarray) -> list[np.ndarray]:
    """The pieces of a path (T, 3) mm between jumps; pieces without motion are omitted."""
    steps = np.linalg.norm(np.diff(points_mm, axis=0), axis=1)
    pieces = np.split(points_mm, np.flatnonzero(~(steps <= JUMP_MM)) + 1)
    return [piece for piece in pieces if len(piece) > 1 and np.ptp(piece, axis=0).max() > 0.0]


def _log_target_body(columns: Columns, targets: np.ndarray, rows, radius_mm: float) -> None:
    """Log rings around the reference points (R, k, 3) of a whole body, slightly wider than it."""
    count = targets.shape[1]
    turn = 2.0 * np.pi * np.arange(RING_CORNERS + 1) / RING_CORNERS
    flat = np.stack((np.cos(turn), np.sin(turn), 0.0 * turn), axis=1)
    axes = frames.normalise(np.gradient(targets.astype(float), axis=1)).reshape(-1, 3)
    rings = RING_WIDER * radius_mm * flat @ frames.rotation_from_z(axes).swapaxes(1, 2)
    rings = rings + targets.reshape(-1, 1, 3)
    style = rr.LineStrips3D.from_fields(colors=PLAN_COLOUR, radii=0.25)
    columns.recording.log("/path/target_body", style, static=True)
    strips = rr.LineStrips3D.columns(strips=list(rings.astype(np.float32)))
    columns.send("/path/target_body", rows, strips.partition([count] * len(rows)))


def _log_beam(columns: Columns, log: EpisodeLog, name: str, rows: np.ndarray) -> None:
    """Log a beam from the tip to its end: thick while the laser is on, thin while it aims."""
    beam, entity = log.beams[name], "/beam" if len(log.beams) == 1 else f"/beams/{name}"
    ends = np.stack((log.arms[name].line_mm[:, -1], beam.end_mm), axis=1)[rows]
    on = beam.on[rows]
    strips = rr.LineStrips3D.columns(
        strips=list(ends),
        radii=np.where(on, 0.4, 0.08),
        colors=np.where(on[:, None], BEAM_COLOUR, paler(BEAM_COLOUR, 0.7)).astype(np.uint8),
    )
    columns.send(entity, rows, strips)
    spots = rr.Points3D.columns(positions=ends[:, 1], radii=np.where(on, 0.8, 0.3))
    style = rr.Points3D.from_fields(colors=BEAM_COLOUR)
    columns.recording.log(f"{entity}/hit", style, static=True)
    columns.send(f"{entity}/hit", rows, spots)


def points_beyond_the_tip(log: EpisodeLog) -> bool:
    """Whether the task's point is where the tip of the only arm points, as in `laser_plane`."""
    if log.beams or len(log.arms) != 1:
        return False
    (arm,) = log.arms.values()
    beyond_mm = np.linalg.norm(log.actual_mm - arm.line_mm[:, -1], axis=1)
    return bool(np.nanmin(beyond_mm) > arm.radius_mm)


def _log_pointing_line(columns: Columns, log: EpisodeLog, rows: np.ndarray) -> None:
    """Log the line from the tip to the task's point, in the colour of a beam."""
    (arm,) = log.arms.values()
    ends = np.stack((arm.line_mm[:, -1], log.actual_mm), axis=1)[rows]
    style = rr.LineStrips3D.from_fields(colors=BEAM_COLOUR, radii=0.2)
    columns.recording.log("/beam", style, static=True)
    columns.send("/beam", rows, rr.LineStrips3D.columns(strips=list(ends)))


def legend(log: EpisodeLog) -> str:
    """Markdown that explains those colours of the 3D view that occur in the log."""
    rows = [
        ("yellow", "reference path and target", True),
        ("cyan", "actual path, beam on" if log.beams else "actual path", True),
        ("green line", "beam; thick while on", bool(log.beams)),
        ("green line", "beam from the tip to the plane", points_beyond_the_tip(log)),
        ("blue lines", "the endoscope's field of view", bool(log.cameras)),
        ("pale, black", "tissue below, above ablation", log.dose is not None),
        ("white points", "key points as measured by the cameras", log.on == "rig"),
    ]
    lines = [f"- **{colour}**: {meaning}" for colour, meaning, shown in rows if shown]
    roles = {body.role for body in log.bodies}
    lines += [f"- **see-through**: {name}, in front of the work" for name in hiding_bodies(log)]
    lines += [f"- **{c}**: {role}" for role, c in ROLE_NAMES.items() if role in roles]
    what = f"**{log.task}** by {log.policy} in {log.on}"
    last = f": {log.events[-1].text} at {log.events[-1].time_s:.1f} s" if log.events else ""
    return f"{what}{last}.\n\n" + "\n".join(lines) + "\n"


def _log_events(recording, log: EpisodeLog) -> None:
    for event in log.events:
        recording.set_time("time", duration=event.time_s)
        recording.set_time("step", sequence=round(event.time_s / log.dt_s))
        for line in event_lines(event.time_s, event.text, EVENT_COLUMNS[log.dose is not None]):
            recording.log("/events", rr.TextLog(line, level=LEVELS[event.level]))
    recording.reset_time()
