"""Pictures of a comparison: hysteresis loops, the body in space, the error over time."""

import itertools
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch

from surgisoft.diagnosis.residuals import ResidualTable
from surgisoft.error_scale import error_scale
from surgisoft.files import new_file
from surgisoft.palette import MEASURED_ON_LIGHT, RED, model_colour
from surgisoft.time_axis import with_gaps
from surgisoft.viewpoint import upright_axes

mpl.use("Agg")
from matplotlib import pyplot as plt

MEASURED, PREDICTED = MEASURED_ON_LIGHT, RED
LOOP_ROWS = 160
"""Most rows that one picture of loops shows; more would hide each other."""
LADDER_ROWS = 400
"""Rows of the ladder's picture, in which one chamber moves alone."""
ALONE = 0.2
"""Motion of the other chambers, as a share of the chamber's own, both in shares of their ranges, up
to which it counts as moving alone."""
LOOPS_ABREAST = 3
"""Most chambers whose loops stand side by side: with more, a page shows their text too small."""
LOOPS_IN, LOOPS_HIGH_IN = 3.2, 2.5
"""Width and height of the loops of one chamber, inches."""
POSTURES = 7
"""Bodies that the picture in space shows."""
MOST_TICKS = 5
"""Intervals between the marks on the horizontal axes in space, whose labels else overlap."""
ERROR_COLOURS = "viridis"
"""Matplotlib's colour map of errors; the replay's is after it."""


def draw_all(table: ResidualTable, unit: str, folder: Path, title: str = "") -> list[Path]:
    """Write loops.png, body.png and error.png into a folder; returns their paths.

    An arm of one key point has no body to draw.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn = []
    radius = None
    if table.model.states_interval:
        radius = table.model.error_radius(torch.from_numpy(table.pressure))[:, -1].numpy()
    error = error_over_time(table, title, radius)
    figures = [("loops", loops(table, unit, title)), ("error", error)]
    if table.spec.key_points > 1:
        figures.insert(1, ("body", bodies({"predicted": table}, title)))
    for name, figure in figures:
        drawn.append(save(figure, folder / f"{name}.png"))
    return drawn


def save(figure, path: Path) -> Path:
    """Write a figure, whole or not at all, and let go of it."""
    with new_file(path) as fresh:
        figure.savefig(fresh, dpi=130)
    plt.close(figure)
    return path


def ladder_loops(tables: dict[str, ResidualTable], unit: str):
    """Nested loops of one recording, measured beside several models, one column a model.

    Below, a cubic through the measured values is taken out of both, which leaves the loops.
    """
    figure, axes = plt.subplots(
        2, len(tables), figsize=(4.2 * len(tables), 6.6), layout="constrained", squeeze=False
    )
    for column, (label, table) in enumerate(tables.items()):
        chamber = int(np.argmax(_lone_motion(table)))
        rows = _stretch(table, chamber, LADDER_ROWS)
        along = _main_direction(table.measured_mm[rows, -1])
        measured, predicted = (
            points[rows, -1] @ along for points in (table.measured_mm, table.predicted_mm)
        )
        pressure = table.pressure[rows, chamber]
        cubic = np.polyval(np.polyfit(pressure, measured, 3), pressure)
        error = np.sqrt(np.nanmean(np.square(table.error_mm[:, -1])))
        for row, offset in enumerate((0, cubic)):
            axis = axes[row, column]
            axis.plot(pressure, measured - offset, c=MEASURED, lw=1.6, label="measured")
            axis.plot(pressure, predicted - offset, c=PREDICTED, lw=1.0, label="model")
            axis.grid(alpha=0.25)
        axes[0, column].set_title(f"{label}: tip RMSE {error:.2f} mm")
        axes[1, column].set_xlabel(f"chamber {chamber + 1} [{unit}]")
    axes[0, 0].set_ylabel("tip, main direction [mm]")
    axes[1, 0].set_ylabel("tip minus a cubic [mm]")
    axes[0, 0].legend(frameon=False)
    return figure


def _lone_motion(table: ResidualTable) -> np.ndarray:
    """(m,) share of its range that each chamber moves in its best stretch, less the others'."""
    span = np.ptp(table.pressure, axis=0)
    span = np.where(span > 0, span, 1)
    scores = []
    for chamber in range(table.pressure.shape[1]):
        moves = np.ptp(table.pressure[_stretch(table, chamber, LADDER_ROWS)], axis=0) / span
        scores.append(2 * moves[chamber] - moves.sum())
    return np.array(scores)


def loops(table: ResidualTable, unit: str, title: str = ""):
    """Tip against the actuation of each chamber, measured and predicted.

    For each chamber the stretch of rows in which it moves most and the others least; where they
    move, too, a line above the chart says by how much. Below, the best polynomial in all pressures
    is taken out of both: what is left has memory, or noise.
    """
    chambers = table.pressure.shape[1]
    bands = -(-chambers // LOOPS_ABREAST)
    abreast = -(-chambers // bands)
    size = (LOOPS_IN * max(abreast, 2), 2 * bands * LOOPS_HIGH_IN)
    figure, axes = plt.subplots(
        2 * bands, abreast, figsize=size, layout="constrained", squeeze=False
    )
    figure.suptitle(_titled("Tip against actuation", title))
    for place in range(chambers, bands * abreast):
        for row in range(2):
            axes[2 * (place // abreast) + row, place % abreast].set_axis_off()
    for chamber in range(chambers):
        band, column = divmod(chamber, abreast)
        rows = _stretch(table, chamber)
        along = _main_direction(table.measured_mm[rows, -1])
        measured, predicted = table.measured_mm[:, -1] @ along, table.predicted_mm[:, -1] @ along
        static = _static(table.pressure, measured)
        pressure = table.pressure[rows, chamber]
        axes[2 * band, column].set_title(_beside(table.pressure, rows, chamber), fontsize="small")
        for row, (offset, what) in enumerate(
            (
                (0 * static, "tip, main\ndirection [mm]"),
                (static, "less what actuation\nexplains [mm]"),
            )
        ):
            axis = axes[2 * band + row, column]
            shown = (measured - offset)[rows]
            axis.plot(pressure, shown, ".-", c=MEASURED, lw=0.7, ms=3, label="measured")
            shown = (predicted - offset)[rows]
            axis.plot(pressure, shown, "-", c=PREDICTED, lw=1.0, label="predicted")
            axis.set_xlabel(f"chamber {chamber + 1} [{unit}]")
            axis.grid(alpha=0.25)
            if column == 0:
                axis.set_ylabel(what)
    axes[0, 0].legend(frameon=False)
    return figure


def _beside(pressure: np.ndarray, rows: np.ndarray, chamber: int) -> str:
    """What one cannot see of a chamber's chart: that the others move in these rows, too, so that
    the tip does not follow this chamber alone; empty where they hardly do."""
    span = np.ptp(pressure, axis=0)
    moves = np.ptp(pressure[rows], axis=0) / np.where(span > 0, span, 1)
    most = np.delete(moves, chamber).max(initial=0.0)
    if moves[chamber] == 0.0:
        return "does not move"
    if most <= ALONE * moves[chamber]:
        return ""
    return f"others move too: {100 * most:.0f} % of their range"


def _stretch(table: ResidualTable, chamber: int, longest: int = LOOP_ROWS) -> np.ndarray:
    """Rows of one run, at most `longest`, in which one chamber moves most and others least."""
    best, score = None, -np.inf
    span = np.ptp(table.pressure, axis=0)
    span = np.where(span > 0, span, 1)
    for run in np.unique(table.run):
        rows = np.flatnonzero((table.run == run) & ~np.isnan(table.measured_mm[:, -1, 0]))
        for start in range(0, max(1, len(rows) - longest // 2), longest // 2):
            part = rows[start : start + longest]
            if len(part) < 4:
                continue
            moves = np.ptp(table.pressure[part], axis=0) / span
            now = 2 * moves[chamber] - moves.sum()
            if now > score + 1e-9:
                best, score = part, now
    return best if best is not None else np.arange(min(longest, len(table.run)))


def _static(pressure: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(S,) least-squares polynomial in the actuation (S, m), as high as the rows allow."""
    middle, half = pressure.mean(axis=0), np.ptp(pressure, axis=0) / 2
    x = (pressure - middle) / np.where(half > 0, half, 1)
    terms = [np.ones(len(x))]
    for degree in (1, 2, 3):
        more = [
            np.prod(x[:, list(chosen)], axis=1)
            for chosen in itertools.combinations_with_replacement(range(x.shape[1]), degree)
        ]
        if 10 * (len(terms) + len(more)) > len(x):
            break
        terms += more
    design, seen = np.stack(terms, 1), ~np.isnan(values)
    return design @ np.linalg.lstsq(design[seen], values[seen], rcond=None)[0]


def _main_direction(points: np.ndarray) -> np.ndarray:
    """(3,) unit vector along which points (S, 3) spread most."""
    seen = ~np.isnan(points)
    mean = np.nansum(points, axis=0) / np.maximum(seen.sum(axis=0), 1)
    centred = np.nan_to_num(points - mean)
    return np.linalg.svd(centred, full_matrices=False)[2][0]


def bodies(tables: dict[str, ResidualTable], title: str = ""):
    """Postures in space, measured and as each model predicts them, with magnified errors.

    One column for each model, the same postures and one scale of the errors in all of them. Each
    error is an arrow from the measured key point towards the predicted one. The postures are far
    apart and among those of larger error. The weight of the first recording that states it is drawn
    downward, so that a hanging arm hangs.
    """
    first = next(iter(tables.values()))
    scale = error_scale(first.measured_mm, [table.error_mm for table in tables.values()])
    rows = _worse_rows(tables)
    count = len(tables)
    figure = plt.figure(figsize=(5.8 * count + 1.2, 6.6), layout="constrained")
    figure.suptitle(_titled("Postures, measured and predicted", title))
    colours = plt.get_cmap(ERROR_COLOURS)
    panels = []
    for number, (name, table) in enumerate(tables.items()):
        axis: Any = figure.add_subplot(1, count, number + 1, projection="3d")
        seen_from = upright_axes(first.drawn_gravity)
        axis.view_init(**seen_from)
        panels.append(axis)
        line = table.model.backbone() if table.spec.key_points > 1 else None
        for place, row in enumerate(rows):
            label = name if place == 0 else None
            measured, predicted = table.measured_mm[row], table.predicted_mm[row]
            for points, colour, wide, what in (
                (measured, MEASURED, 2.6, "measured" if place == 0 else None),
                (predicted, model_colour(number), 1.4, label),
            ):
                drawn = points
                if line is not None:
                    drawn = line.centreline(torch.tensor(points, dtype=torch.float32)).numpy()
                axis.plot(*drawn.T, c=colour, lw=wide, label=what)
            error = table.error_mm[row]
            shade = colours(np.clip(error / scale.large_mm, 0.0, 1.0))
            axis.scatter(*measured.T, c=shade, s=22, depthshade=False)
            for start, move, tint in zip(measured, predicted - measured, shade, strict=True):
                end = start + scale.stretch * move
                axis.plot(*np.stack((start, end)).T, c=tint, lw=2.2)
        axis.set_xlabel("x [mm]")
        axis.set_ylabel("y [mm]")
        axis.set_zlabel("z [mm]")
        if seen_from["roll"]:  # else this label stands on its head
            upward = getattr(axis, f"{seen_from['vertical_axis']}axis")
            upward.set_rotate_label(False)
            upward.label.set_rotation(90.0)
        axis.locator_params(axis="x", nbins=MOST_TICKS)
        axis.locator_params(axis="y", nbins=MOST_TICKS)
        known = table.error_mm[~np.isnan(table.error_mm)]
        rms = np.sqrt(np.square(known).mean())
        axis.set_title(f"{name}: error {rms:.3g} mm")
        if len(rows):
            axis.legend(frameon=False, loc="upper left")
    _same_box(panels)
    norm = mpl.colors.Normalize(0.0, scale.large_mm)
    bar = figure.colorbar(
        mpl.cm.ScalarMappable(norm, colours), ax=panels, shrink=0.6, location="bottom", aspect=40
    )
    bar.set_label(f"error of a key point [mm]; lines of errors are {scale.stretch:g} times as long")
    # The label of z stands outside the axes' own box.
    layout: Any = figure.get_layout_engine()
    layout.set(rect=(0.0, 0.0, 0.97, 1.0))
    return figure


def _titled(what: str, of: str) -> str:
    """Title of a figure: what it shows, then the model and the recordings."""
    return f"{what}: {of}" if of else what


def _worse_rows(tables: dict[str, ResidualTable]) -> np.ndarray:
    """Rows of complete postures that are far apart, of the half with the larger error."""
    measured = next(iter(tables.values())).measured_mm
    whole = np.flatnonzero(~np.isnan(measured).any(axis=(1, 2)))
    if not len(whole):
        return whole
    error = np.max([table.error_mm[whole].max(axis=1) for table in tables.values()], axis=0)
    worse = whole[error >= np.median(error)]
    return worse[_spread(measured[worse, -1])]


def _same_box(panels) -> None:
    """Give all panels in space the same limits, with equal axes."""
    limits = [np.array([getattr(panel, f"get_{axis}lim")() for panel in panels]) for axis in "xyz"]
    for panel in panels:
        for axis, values in zip("xyz", limits, strict=True):
            getattr(panel, f"set_{axis}lim")(values[:, 0].min(), values[:, 1].max())
        panel.set_aspect("equal")


def _spread(tips: np.ndarray) -> list[int]:
    """Indices of postures whose tips (S, 3) lie far apart (farthest-point sampling)."""
    if not len(tips):
        return []
    chosen = [int(np.linalg.norm(tips - tips.mean(0), axis=1).argmax())]
    distance = np.full(len(tips), np.inf)
    while len(chosen) < min(POSTURES, len(tips)):
        distance = np.minimum(distance, np.linalg.norm(tips - tips[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return chosen


def error_over_time(table: ResidualTable, title: str = "", radius: np.ndarray | None = None):
    """Tip and mean error over time, pauses left blank, and the distribution per key point.

    Time is that of `ResidualTable.along_s`, as in the table of worst moments and in the replay.
    radius: (N,) of the tip's 95 % prediction interval, mm, drawn as a band; None: not known.
    """
    error = table.error_mm
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(11, 3.8), layout="constrained", width_ratios=(3, 1)
    )
    # Rows that lack a key point are left out: a mean over the others jumps to the base's error.
    whole = np.flatnonzero(~np.isnan(error).any(axis=1))
    time_s = table.along_s[whole]
    left.plot(*with_gaps(time_s, error[whole, -1]), c=PREDICTED, lw=0.6, label="tip")
    if radius is not None:
        band = {"color": PREDICTED, "alpha": 0.15, "lw": 0}
        edge = with_gaps(time_s, radius[whole])
        left.fill_between(edge[0], 0, edge[1], label="tip, 95 % interval", **band)
    mean = error[whole].mean(axis=1)
    left.plot(*with_gaps(time_s, mean), c=MEASURED, lw=0.6, label="mean of the key points")
    mark_recordings(left, table)
    left.set_xlabel("time [s]" + (", recordings one after another" if len(table.names) > 1 else ""))
    left.set_ylabel("error [mm]")
    left.set_ylim(bottom=0)
    left.set_title(_titled("Error over time", title))
    columns = [column[~np.isnan(column)] for column in error.T]
    right.boxplot(columns, showfliers=False, tick_labels=[f"k{k}" for k in range(len(columns))])
    right.set_ylabel("error [mm]")
    right.set_title("by key point")
    figure.legend(frameon=False, loc="outside lower left", ncols=3)
    return figure


def mark_recordings(axis, table: ResidualTable) -> None:
    """Lines where the next recording begins, with its name, and a shade over the held-out part."""
    for edge in np.flatnonzero(np.diff(table.recording)) + 1:
        time_s = table.along_s[edge]
        axis.axvline(time_s, c="#888888", lw=0.8, ls=":")
        name = table.names[table.recording[edge]]
        axis.annotate(
            name,
            (time_s, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, -3),
            textcoords="offset points",
            va="top",
            fontsize=7,
            color="#888888",
        )
