"""Charts of an episode's log: path over target, error, progress, clearance, the dose unrolled."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import pyplot as plt

from surgisoft.report import Picture
from surgisoft.report.charts import AMBER, BLUE, CHART, GREEN, RED, chart, drawing
from surgisoft.report.style import INK, MUTED
from surgisoft.scene.dose_patch import HEALTHY, LESION
from surgisoft.tasks.episodes.consistency import LARGEST_MM
from surgisoft.tasks.episodes.log import JUMP_MM, EpisodeLog

OFFSET_MM = 2.0
"""The unrolled dose is shown so far on either side of the ring (mm)."""
CELL_MM = 0.25
"""Size of a cell of the unrolled dose along the ring, and half of it across (mm)."""
MAP_CELL_MM = 0.25
"""Least size of a cell of the dose map (mm); coarser where the samples are."""
MOST_TICKS = 6
"""Most intervals between the ticks of an axis whose labels stand side by side."""
DECADES = 100.0
"""Ratio of the largest to the smallest length of all episodes from which its axis is logarithmic.
"""
PLAIN_POWERS = (-3, 4)
"""Powers of ten whose numbers are written out at an axis; others have a common factor."""
RESTING_MM = 0.05
"""A reference that moves less than this between two jumps rests: it is drawn as a point (mm)."""
RESTING_POINTS = 7.0
"""Diameter of that point (points of the page)."""
LEAST_DOSE = 0.1
"""Doses below this share of the threshold are left blank."""


def episode_charts(log: EpisodeLog) -> list[Picture]:
    """Every chart that the episode has something for."""
    return [
        picture
        for picture in (
            path_chart(log),
            dose_chart(log) if log.one_ring else dose_map(log),
            error_chart(log),
            progress_chart(log),
            clearance_chart(log),
        )
        if picture is not None
    ]


def path_chart(log: EpisodeLog, title: str = "path over target") -> Picture:
    """Where the beam burnt (or the point went) over where it should, in the path's plane."""
    wanted = log.path_mm if len(log.path_mm) else log.target_mm
    always = np.ones(log.rows, bool)
    done = [(log.at_rest_mm(beam.end_mm), beam.on) for beam in log.beams.values()]
    done = done or [(log.actual_mm, always)]
    middle, plane = path_plane(wanted)
    flat = [(path - middle) @ plane for path in log.paths_mm or [wanted]]
    wide = 5.0 if log.one_ring else 2.5
    with drawing():
        figure, axis = plt.subplots(figsize=(CHART[0], 4.2))
        for number, path in enumerate(flat):
            label = "reference" if number == 0 else None
            axis.plot(*broken_at_jumps(path).T, c=AMBER, lw=wide, alpha=0.55, label=label)
            rests = np.zeros((0, 2)) if len(log.path_mm) else resting_places(path)
            if len(rests):
                axis.plot(*rests.T, c=AMBER, marker="o", ms=RESTING_POINTS, mew=0.0, ls="none")
        for number, (end, on) in enumerate(done):
            went = (end - middle) @ plane
            went = np.where((on & np.isfinite(went).all(1))[:, None], went, np.nan)
            word = [*log.beams][number] if len(done) > 1 else "burnt" if log.beams else "done"
            colour = (BLUE, GREEN)[number % 2]
            line = broken_at_jumps(went) if log.beams else went  # an arm passes what lies between
            axis.plot(*line.T, c=colour, lw=1.3, label=word)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel("mm")
        axis.set_ylabel("mm")
        axis.set_title(title)
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
        return chart(figure, title, "Seen at right angles to the path's plane")


def error_chart(log: EpisodeLog) -> Picture | None:
    """The distance from the reference over time; with a beam, only while it is on.

    On an organ that moves it is the distance on the tissue. Steps at which the task measures no
    error, such as those before the reference moves, are grey: no number counts them.
    """
    tissue = log.measures.get("tissue_error_mm")
    named = log.measures.get("beam_error_mm") if tissue is None else tissue
    every = _drawable(log.error_mm if named is None else named)
    if np.isnan(every).all():
        return None
    measured = log.measures.get("error_mm")
    counts = np.isfinite(every if named is not None or measured is None else measured)
    error = np.where(counts, every, np.nan)
    highest = float(np.nanmax(every))
    with drawing():
        figure, axis = plt.subplots()
        axis.plot(log.time_s, error, c=RED, lw=1.0)
        caption = f"Largest {np.nanmax(error):.3g} mm" if counts.any() else "No error is measured"
        if (left := ~counts & np.isfinite(every)).any():
            first = left | np.append(left[1:], False) | np.append(False, left[:-1])
            axis.plot(log.time_s, np.where(first, every, np.nan), c=MUTED, lw=1.0, zorder=1)
            caption += "; grey: the numbers do not count these steps"
        axis.set_ylim(0.0, 1.08 * highest if highest > 0.0 else 1.0)
        axis.set_xlim(0.0, log.time_s[-1])
        axis.set_xlabel("time [s]")
        axis.set_ylabel("error [mm]")
        title = "error over time" if tissue is None else "error on the tissue"
        axis.set_title(title + (" while the beam is on" if log.beams else ""))
        return chart(figure, "error over time", caption)


def _drawable(lengths_mm: np.ndarray) -> np.ndarray:
    """Lengths in mm, NaN where they are infinite or larger than anything in a scene."""
    return np.where(np.abs(lengths_mm) < LARGEST_MM, lengths_mm, np.nan)


def progress_chart(log: EpisodeLog) -> Picture | None:
    """Share of the ring that is cut and seen, over time, with the beam's times shaded."""
    seen = log.view_fraction
    on = log.burning
    if on is None or seen is None or "completion" not in log.measures:
        return None
    with drawing():
        figure, axis = plt.subplots()
        axis.fill_between(
            log.time_s, 0, 1.05, where=on, color=GREEN, alpha=0.15, lw=0, label="beam on"
        )
        axis.plot(log.time_s, log.measures["completion"], c=BLUE, label="done")
        axis.plot(log.time_s, seen, c=AMBER, lw=1.0, label="in sight")
        axis.axhline(log.limits["view_fraction"], c=MUTED, lw=0.8, ls="--")
        axis.set_xlim(0.0, log.time_s[-1])
        axis.set_ylim(0.0, 1.05)
        axis.set_xlabel("time [s]")
        axis.set_ylabel("share")
        axis.set_title("cut and in sight")
        axis.legend(loc="lower right")
        return chart(figure, "share cut and in sight", "Dashed: what has to be in sight")


def clearance_chart(log: EpisodeLog) -> Picture | None:
    """The least clearance over time, with its limit."""
    if log.clearance_mm is None:
        return None
    clearance = _drawable(log.clearance_mm)
    if np.isnan(clearance).all():
        return None
    least = float(np.nanmin(clearance))
    with drawing():
        figure, axis = plt.subplots()
        axis.plot(log.time_s, clearance, c=BLUE, lw=1.2)
        limit = log.limits.get("clearance_mm")
        if limit is not None:
            axis.axhline(limit, c=RED, lw=1.0, ls="--")
        axis.set_ylim(min(0.0, 1.1 * least), None)
        axis.set_xlim(0.0, log.time_s[-1])
        axis.set_xlabel("time [s]")
        axis.set_ylabel("clearance [mm]")
        axis.set_title("least clearance")
        return chart(figure, "clearance over time", f"Least {least:.1f} mm; dashed: the limit")


def dose_chart(log: EpisodeLog) -> Picture | None:
    """The dose at the end, unrolled along the ring: 1 is the threshold of ablation."""
    if log.dose is None:
        return None
    from matplotlib.colors import LogNorm

    dose = log.dose
    near = np.abs(dose.offset_mm) <= OFFSET_MM
    along = (dose.station[near] + 0.5) * dose.ring_length_mm / dose.stations
    width = max(CELL_MM, dose.ring_length_mm / dose.stations)
    edges = (
        np.linspace(0.0, dose.ring_length_mm, math.ceil(dose.ring_length_mm / width) + 1),
        np.arange(-OFFSET_MM, OFFSET_MM + 0.5 * CELL_MM, 0.5 * CELL_MM),
    )
    share = dose.at(-1)[near] / dose.threshold_j_per_mm2
    areas = dose.areas_mm2[near]
    place = (along, dose.offset_mm[near])
    total = np.histogram2d(*place, edges, weights=areas * share)[0]
    area = np.histogram2d(*place, edges, weights=areas)[0]
    mean = np.divide(total, area, out=np.full_like(total, np.nan), where=area > 0.0)
    with drawing():
        figure, axis = plt.subplots(figsize=(2.0 * CHART[0], 2.4))
        most = max(10.0, float(np.nanmax(mean)))
        mean = np.where(mean >= LEAST_DOSE, mean, np.nan)
        norm = LogNorm(LEAST_DOSE, most)
        shown = axis.pcolormesh(
            *edges, mean.T, norm=norm, cmap="YlOrBr", rasterized=True, shading="flat"
        )
        axis.grid(visible=False)
        middles = [0.5 * (edge[1:] + edge[:-1]) for edge in edges]
        if np.nanmax(mean, initial=0.0) > 1.0:
            axis.contour(*middles, np.nan_to_num(mean).T, [1.0], colors=RED, linewidths=0.9)
        axis.axhline(0.0, c=INK, lw=0.8, ls="--")
        axis.set_ylim(-OFFSET_MM, OFFSET_MM)
        axis.set_xlabel("along the ring [mm]")
        axis.set_ylabel("off the ring [mm]")
        axis.set_title("dose, unrolled")
        figure.colorbar(shown, ax=axis, label="dose / threshold", pad=0.01)
        return chart(
            figure,
            "dose unrolled along the ring",
            "Red: where the dose reaches the threshold of ablation; negative: inside the ring",
        )


def dose_map(log: EpisodeLog) -> Picture | None:
    """The dose at the end on the organ's surface, seen at right angles: 1 is the threshold."""
    if log.dose is None:
        return None
    from matplotlib.colors import LogNorm
    from scipy.spatial import cKDTree

    dose = log.dose
    middle, plane = path_plane(log.path_mm)
    flat = (dose.points_mm - middle) @ plane
    apart = float(np.sqrt(2.0 * dose.areas_mm2.mean()))
    cell = max(MAP_CELL_MM, 0.5 * apart)
    edges = tuple(np.arange(each.min(), each.max() + cell, cell) for each in flat.T)
    middles = [0.5 * (edge[1:] + edge[:-1]) for edge in edges]
    cells = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
    _, sample = cKDTree(flat).query(cells, distance_upper_bound=2.0 * apart)
    share = np.append(dose.at(-1) / dose.threshold_j_per_mm2, np.nan)
    zone = np.append(dose.zone, HEALTHY)
    mean, inside, spared = share[sample], zone[sample] == LESION, zone[sample] == HEALTHY
    least = dose.cut_j_per_mm2 / dose.threshold_j_per_mm2
    with drawing():
        figure, axis = plt.subplots(figsize=(2.0 * CHART[0], 4.2))
        norm = LogNorm(LEAST_DOSE, max(10.0, 2.0 * least, float(np.nanmax(mean))))
        shown = axis.pcolormesh(
            *edges,
            np.where(mean >= LEAST_DOSE, mean, np.nan).T,
            norm=norm,
            cmap="YlOrBr",
            rasterized=True,
            shading="flat",
        )
        axis.grid(visible=False)
        for area, colour, style in ((inside, INK, "-"), (spared, MUTED, "--")):
            known = area.astype(float)
            if known.min() < 0.5 < known.max():
                axis.contour(
                    *middles, known.T, [0.5], colors=colour, linewidths=0.9, linestyles=style
                )
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel("mm")
        axis.set_ylabel("mm")
        axis.set_title("dose on the organ")
        figure.colorbar(shown, ax=axis, label="dose / threshold of ablation", pad=0.01)
        return chart(
            figure,
            "dose on the organ",
            "Solid: the lesion. Dashed: healthy tissue begins. Treated from "
            f"{least:.3g} times the threshold of ablation on",
        )


def spread_chart(
    title: str, groups: Sequence[tuple[str, Sequence[float]]], label: str
) -> Picture | None:
    """One number of every episode, side by side for each group, with its mean."""
    known = [(name, np.array([v for v in values if v is not None])) for name, values in groups]
    known = [(name, values[np.isfinite(values)]) for name, values in known]
    if not any(len(values) for _, values in known):
        return None
    rng = np.random.default_rng(0)
    with drawing():
        figure, axis = plt.subplots(figsize=(CHART[0], max(1.6, 0.42 * len(known) + 1.0)))
        for place, (_, values) in enumerate(known):
            off = place + rng.uniform(-0.16, 0.16, len(values))
            axis.scatter(values, off, s=36, c=BLUE, alpha=0.8, lw=0, zorder=3)
            if len(values):
                axis.plot([values.mean()] * 2, [place - 0.3, place + 0.3], c=RED, lw=2)
        axis.set_yticks(range(len(known)), [name for name, _ in known])
        axis.set_ylim(len(known) - 0.5, -0.5)
        every = np.concatenate([values for _, values in known])
        if "[" not in label and every.min() >= 0.0 and every.max() <= 1.0:  # a share
            axis.set_xlim(-0.02, 1.02)
        if "[mm]" in label and 0.0 < every.min() <= every.max() / DECADES:
            axis.set_xscale("log")
        else:
            axis.locator_params(axis="x", nbins=MOST_TICKS)
            axis.ticklabel_format(
                axis="x", scilimits=PLAIN_POWERS, useOffset=False, useMathText=True
            )
        axis.set_xlabel(label)
        if title != label:
            axis.set_title(title)
        return chart(figure, title, "One dot per episode; red: the mean")


def path_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle (3,) and two directions (3, 2) of the plane that fits points (N, 3) mm best."""
    known = points[np.isfinite(points).all(1)].astype(float)
    middle = known.mean(axis=0)
    _, _, axes = np.linalg.svd(known - middle, full_matrices=False)
    plane = axes[:2].T
    # The picture's right and up are as near to the world's x and y as the plane allows.
    turn = np.linalg.svd(plane[:2])
    return middle, plane @ (turn[0] @ turn[2]).T


def broken_at_jumps(points: np.ndarray) -> np.ndarray:
    """(N, 2) mm with a gap wherever the next point is far."""
    jump = np.linalg.norm(np.diff(points, axis=0), axis=1) > JUMP_MM
    return np.insert(points, np.flatnonzero(jump) + 1, np.nan, axis=0)


def resting_places(points: np.ndarray) -> np.ndarray:
    """(K, 2) mm: places at which (N, 2) points stay between jumps, such as targets in turn."""
    known = points[np.isfinite(points).all(1)]
    jumps = np.flatnonzero(np.linalg.norm(np.diff(known, axis=0), axis=1) > JUMP_MM) + 1
    pieces = [piece for piece in np.split(known, jumps) if len(piece)]
    rests = [piece[0] for piece in pieces if np.ptp(piece, axis=0).max() < RESTING_MM]
    return np.array(rests).reshape(-1, 2)


UNORDERED = ("chamber", "robot_seed", "specimen")
"""Fields of an experiment whose numbers are names: nothing lies between two of them."""
BESIDE = 0.12
"""Distance of the marks of two lines at the same value of such a field."""


WIDE_NAMES = 40
"""Characters of the names of values side by side from which on they are drawn aslant."""
ASLANT_DEG = 30.0
"""Slope of such names (degrees)."""


def sweep_chart(
    field: str, label: str, lines: Mapping[str, Sequence[tuple]], names: Sequence[str] = ()
) -> Picture:
    """A number over what varies, with 95 % intervals; lines: name -> (value, mean, low, high).

    names: those of values that are no numbers, such as lists; a value in `lines` is then the place
    of its name. Between such values, and those of `UNORDERED` fields, no line is drawn.
    """
    colours = (BLUE, RED, GREEN, AMBER)
    name = field.split(".")[-1]
    apart, most = bool(names) or name in UNORDERED, 0.0
    known: set[float] = set()
    with drawing():
        figure, axis = plt.subplots()
        for k, ((title, points), colour) in enumerate(
            zip(lines.items(), colours * len(lines), strict=False)
        ):
            x, mean, low, high = np.array(points, dtype=float).T
            most = max(most, np.nanmax(np.append(high, mean), initial=0.0))
            known |= set(x.tolist())
            if apart:
                beside = x + BESIDE * (k - 0.5 * (len(lines) - 1))
                spread = np.abs(np.stack((low, high)) - mean)
                axis.errorbar(beside, mean, spread, c=colour, fmt="o", ms=5, lw=1.5, label=title)
                continue
            axis.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
            axis.plot(x, mean, c=colour, marker="o", ms=4, label=title)
        if names:
            axis.set_xlim(-0.5, len(names) - 0.5)
            slope = ASLANT_DEG if sum(map(len, names)) > WIDE_NAMES else 0.0
            axis.set_xticks(
                range(len(names)), names, rotation=slope, ha="right" if slope else "center"
            )
        elif apart:
            axis.set_xticks(sorted(known))
        axis.set_ylim(0.0, 1.06 * most if most > 0.0 else 1.0)
        axis.ticklabel_format(axis="y", scilimits=PLAIN_POWERS, useOffset=False, useMathText=True)
        axis.set_xlabel(name)
        axis.set_ylabel(label)
        axis.set_title(f"{label} over {name}")
        if len(lines) > 1:
            figure.legend(loc="outside lower center", ncols=3)
        band = "Lines" if apart else "Shaded"
        return chart(figure, f"{label} over {name}", f"{band}: 95 % interval of the mean")
