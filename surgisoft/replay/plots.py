"""The plots of a replay and their lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import rerun.blueprint as rrb

from surgisoft.replay.colours import LIMIT_COLOUR, paler, series_colour

if TYPE_CHECKING:  # their import takes seconds, and the view of a bench has no episode
    from surgisoft.tasks.episodes.log import EpisodeLog
    from surgisoft.tasks.episodes.parts import ArmLog

SHARES = {
    "completion": "done",
    "visited": "visited",
    "view_fraction": "in sight",
    "safe": "safe",
}
"""Measures from 0 to 1, which share one plot -> their words in its title."""
SHOWN_ELSEWHERE = (
    "success",
    "collided",
    "clearance_mm",
    "phase",
    "reason",
    "reason_phase",
    "late_phase",
    "beam",
    "beam_unsafe",
)
"""Measures that events or another plot show; from `phase` on those of experiments."""


Corner = Literal["lefttop", "leftbottom", "righttop", "rightbottom"]
"""A corner of a plot."""


Kept = Literal["Average", "Max", "Min"]
"""What a plot draws of the rows in one column of pixels: peaks of errors have to stay in sight."""


@dataclass(frozen=True, eq=False)
class Line:
    """One line of a plot."""

    entity: str
    """Its entity in the recording."""
    name: str
    """Its name in the legend."""
    values: np.ndarray
    """(T,) one value for each row of the log; values that are not finite are omitted."""
    colour: tuple[int, int, int]
    """sRGB, 0..255."""
    width: float = 1.6
    """Width in points."""
    keeps: Kept = "Average"
    """What is drawn of rows that share a column of pixels."""


@dataclass(frozen=True, eq=False)
class Plot:
    """One plot."""

    title: str
    """What it shows, with the unit."""
    lines: tuple[Line, ...]
    """Its lines."""
    legend: Corner | None = None
    """Corner of the legend; None: no legend."""
    group: str = ""
    """Plots of one group share a place in the layout, as tabs."""


LEGEND_ROOM = 0.42
"""Empty room at the end of each plot, in which its legend stands, as a share of the duration."""


def last_seconds(window_s: float) -> rrb.TimeAxis:
    """The time until the cursor, and room behind it for the legend, which so hides no curve."""
    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-window_s)
    end = rrb.TimeRangeBoundary.cursor_relative(seconds=LEGEND_ROOM * window_s)
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end))


def time_axis(end_s: float) -> rrb.TimeAxis:
    """The whole time from 0 on, and room behind it for the legend, which so hides no curve."""
    end = rrb.TimeRangeBoundary.absolute(seconds=end_s * (1.0 + LEGEND_ROOM))
    start = rrb.TimeRangeBoundary.absolute(seconds=0.0)
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end))


def plots_of(log: EpisodeLog) -> tuple[Plot, ...]:
    """The plots of a log, in the order of the layout."""
    errors = {name: values for name, values in log.measures.items() if "error" in name}
    if not any(np.isfinite(values).any() for values in errors.values()):
        errors["error_mm"] = log.error_mm
    shares = {name: log.measures[name] for name in SHARES if name in log.measures}
    taken = {*errors, *shares, *SHOWN_ELSEWHERE}
    others = {name: values for name, values in log.measures.items() if name not in taken}
    lines = _lines("error", errors, "Max")
    made = [Plot("Path error (mm)", lines, _corner(errors, "righttop"))]
    for name, arm in log.arms.items():
        made.append(Plot(f"Pressure of {name} (kPa)", _pressures(name, arm), "righttop"))
    if shares:
        title = f"{', '.join(SHARES[name] for name in shares).capitalize()} (share)"
        made.append(Plot(title, _lines("share", shares), "rightbottom"))
    if log.clearance_mm is not None:
        title = "Clearance (mm), red: limit" if log.limits else "Clearance (mm)"
        made.append(Plot(title, _clearance(log)))
    for agent, terms in log.rewards.items():
        title = f"Reward: {agent}"
        made.append(Plot(title, _lines(f"reward/{agent}", terms), "rightbottom", "rewards"))
    if others:
        made.append(Plot("Other measures", _lines("measures", others), "righttop"))
    return tuple(made)


def _corner(series: Mapping[str, np.ndarray], corner: Corner) -> Corner | None:
    """The corner of the legend if there is more than one line, else None."""
    return corner if len(series) > 1 else None


def _lines(
    group: str, series: Mapping[str, np.ndarray], keeps: Kept = "Average"
) -> tuple[Line, ...]:
    return tuple(
        Line(f"/plots/{group}/{name}", name, values, series_colour(i), keeps=keeps)
        for i, (name, values) in enumerate(series.items())
    )


def _pressures(name: str, arm: ArmLog) -> tuple[Line, ...]:
    """Each chamber's pressure and, thinner and darker, its command.

    The viewer sorts a legend by entity: commands come last, since a low plot shows the first names.
    """
    lines = []
    for i in range(arm.pressure_kPa.shape[1]):
        where, colour = f"/plots/pressure/{name}", series_colour(i)
        command, pressure = arm.command_kPa[:, i], arm.pressure_kPa[:, i]
        lines.append(Line(f"{where}/p{i + 1}", f"chamber {i + 1}", pressure, colour))
        lines.append(Line(f"{where}/sent{i + 1}", f"command {i + 1}", command, paler(colour), 1.0))
    return tuple(lines)


def _clearance(log: EpisodeLog) -> tuple[Line, ...]:
    where = "/plots/clearance"
    if log.clearance_mm is None:
        return ()
    blue = series_colour(0)
    held = Line(f"{where}/clearance_mm", "clearance_mm", log.clearance_mm, blue, keeps="Min")
    if not log.limits:
        return (held,)
    limit = np.full(log.rows, log.limits["clearance_mm"])
    return held, Line(f"{where}/limit", "limit", limit, LIMIT_COLOUR, 1.0)
