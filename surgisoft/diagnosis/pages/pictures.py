"""Pictures of a comparison: hysteresis loops, the body in space, the error over time."""

import itertools
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch

from surgisoft.diagnosis.residuals import ResidualTable
from surgisoft.surrogate.backbone import Backbone

mpl.use("Agg")
from matplotlib import pyplot as plt

MEASURED, PREDICTED = "#222222", "#d1495b"
LOOP_ROWS = 160
"""Most rows that one picture of loops shows; more would hide each other."""
LADDER_ROWS = 400
"""Rows of the ladder's picture, in which one chamber moves alone."""
POSTURES = 7
"""Bodies that the picture in space shows."""


def draw_all(
    table: ResidualTable, backbone: Backbone | None, unit: str, folder: Path, title: str = ""
) -> list[Path]:
    """Write loops.png, body.png and error.png into a folder; returns their paths.

    Without a backbone (an arm of one key point) there is no body to draw.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn = []
    radius = None
    if table.model.states_interval:
        radius = table.model.error_radius(torch.from_numpy(table.pressure))[:, -1].numpy()
    error = error_over_time(table, title, radius)
    figures = [("loops", loops(table, unit, title)), ("error", error)]
    if backbone is not None:
        figures.insert(1, ("body", body(table, backbone, title)))
    for name, figure in figures:
        drawn.append(save(figure, folder / f"{name}.png"))
    return drawn


def save(figure, path: Path) -> Path:
    """Write a figure and let go of it."""
    figure.savefig(path, dpi=130)
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
    axes[1, 0].set_ylabel("tip less a cubic [mm]")
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

    For each chamber the stretch of rows in which it moves most and the others least. Below, the
    best polynomial in all pressures is taken out of both: what is left has memory, or noise.
    """
    chambers = table.pressure.shape[1]
    figure, axes = plt.subplots(
        2, chambers, figsize=(4.2 * chambers, 6.2), layout="constrained", squeeze=False
    )
    figure.suptitle(title or "Tip against actuation")
    for chamber in range(chambers):
        rows = _stretch(table, chamber)
        along = _main_direction(table.measured_mm[rows, -1])
        measured, predicted = table.measured_mm[:, -1] @ along, table.predicted_mm[:, -1] @ along
        static = _static(table.pressure, measured)
        pressure = table.pressure[rows, chamber]
        for row, (offset, what) in enumerate(
            ((0 * static, "tip, main direction [mm]"), (static, "less what pressure explains [mm]"))
        ):
            axis = axes[row, chamber]
            shown = (measured - offset)[rows]
            axis.plot(pressure, shown, ".-", c=MEASURED, lw=0.7, ms=3, label="measured")
            shown = (predicted - offset)[rows]
            axis.plot(pressure, shown, "-", c=PREDICTED, lw=1.0, label="predicted")
            axis.set_xlabel(f"chamber {chamber + 1} [{unit}]")
            axis.grid(alpha=0.25)
            if chamber == 0:
                axis.set_ylabel(what)
    axes[0, 0].legend(frameon=False)
    return figure


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


def body(table: ResidualTable, backbone: Backbone, title: str = ""):
    """A few postures in space: measured key points, predicted ones and their backbone."""
    whole = np.flatnonzero(~np.isnan(table.measured_mm).any(axis=(1, 2)))
    figure = plt.figure(figsize=(6.5, 6.2), layout="constrained")
    axis = figure.add_subplot(projection="3d")
    for number, row in enumerate(_spread(table.measured_mm[whole, -1])):
        row = whole[row]
        points = torch.tensor(table.predicted_mm[row], dtype=torch.float32)
        line = backbone.centreline(points).numpy()
        first = number == 0
        axis.plot(*line.T, c=PREDICTED, lw=2, label="predicted backbone" if first else None)
        axis.scatter(*points.numpy().T, c=PREDICTED, s=14)
        axis.scatter(
            *table.measured_mm[row].T,
            facecolors="none",
            edgecolors=MEASURED,
            s=55,
            label="measured key points" if first else None,
        )
    axis.set_xlabel("x [mm]")
    axis.set_ylabel("y [mm]")
    axis.set_zlabel("z [mm]")
    axis.set_aspect("equal")
    # The label of z stands outside the axes' own box.
    figure.get_layout_engine().set(rect=(0.0, 0.0, 0.94, 1.0))
    if len(whole):
        axis.legend(frameon=False, loc="upper left")
    axis.set_title(title or "Body, measured and predicted")
    return figure


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
    """Tip and mean error over the rows, runs marked, and the distribution per key point.

    radius: (N,) of the tip's 95 % prediction interval, mm, drawn as a band; None: not known.
    """
    error = table.error_mm
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(11, 3.8), layout="constrained", width_ratios=(3, 1)
    )
    # Rows that lack a key point are left out: a mean over the others jumps to the base's error.
    whole = np.flatnonzero(~np.isnan(error).any(axis=1))
    left.plot(whole, error[whole, -1], c=PREDICTED, lw=0.6, label="tip")
    if radius is not None:
        band = {"color": PREDICTED, "alpha": 0.15, "lw": 0}
        left.fill_between(whole, 0, radius[whole], label="tip, 95 % interval", **band)
    mean = error[whole].mean(axis=1)
    left.plot(whole, mean, c=MEASURED, lw=0.6, label="mean of the key points")
    for edge in np.flatnonzero(np.diff(table.run)):
        left.axvline(edge + 0.5, c="#bbbbbb", lw=0.6)
    left.set_xlabel("row (runs are divided by lines)")
    left.set_ylabel("error [mm]")
    left.set_ylim(bottom=0)
    left.legend(frameon=False)
    left.set_title(title or "Error over the recording")
    columns = [column[~np.isnan(column)] for column in error.T]
    right.boxplot(columns, showfliers=False, tick_labels=[f"k{k}" for k in range(len(columns))])
    right.set_ylabel("error [mm]")
    right.set_title("by key point")
    return figure
