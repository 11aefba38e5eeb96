"""The page of an amendment."""

import numpy as np

from surgisoft.diagnosis.amend import Amendment, Track
from surgisoft.diagnosis.estimation.intervals import Parameter, values_text
from surgisoft.report import Facts, Page, Picture, Section, Table, Text
from surgisoft.report.charts import BLUE, RED, chart, drawing

HOW = (
    "Parameters were fitted through the whole model to the open part of the recordings, the "
    "network's own error beside them. The errors on top are those on the locked part, the last "
    "quarter of each recording, which was looked at once.\n\n"
    "Intervals are 95 %, from blocks of time: rows that follow each other err alike."
)
OUTSIDE = ": outside"
"""Mark of a value outside its plausible range."""
POINTS = 600
"""Points of a line in a chart."""


def amend_page(result: Amendment, title: str, about: str) -> Page:
    """The page of an amendment."""
    fall = result.locked
    facts = Facts(
        [
            ("before", f"{fall.before:.3f} mm"),
            ("after", f"{fall.after:.3f} mm"),
            ("after, effects alone", f"{result.alone.after:.3f} mm"),
            ("noise floor", f"{fall.floor:.3f} mm"),
            ("fall, 95 %", f"{fall.ci95[0]:.3f} .. {fall.ci95[1]:.3f} mm"),
            ("rows that judged", f"{fall.rows}"),
        ]
    )
    opened, locked = result.tracks
    return Page(
        title=title,
        verdict=result.sentence,
        about=about,
        tone="good" if result.claimed else "warn",
        parts=[
            facts,
            Section("Parameters", [parameter_table(result.parameters)]),
            Section(
                "Error over time",
                [
                    track_chart(locked, "Locked part: took no part in the fit"),
                    track_chart(opened, "Open part: the parameters were fitted to it"),
                ],
            ),
            Section("How to read this", [Text(HOW)]),
        ],
    )


def parameter_table(parameters: tuple[Parameter, ...]) -> Table:
    """Every fitted quantity with interval, unit and plausible range."""
    rows = [
        (
            each.effect,
            each.name,
            values_text(each.value),
            each.interval_text or "-",
            each.unit or "-",
            "{:.3g} .. {:.3g}".format(*each.plausible_range)
            + ("" if each.plausible else ": outside"),
            each.source,
        )
        for each in parameters
    ]
    header = ["effect", "parameter", "value", "95 % interval", "unit", "plausible", "source"]
    return Table(header, rows)


def track_chart(track: Track, caption: str) -> Picture:
    """The error of both models over time; runs and recordings stand one after another."""
    from matplotlib import pyplot as plt

    steps = np.diff(track.time_s, prepend=track.time_s[:1])
    usual = float(np.median(steps[~track.start])) if (~track.start).any() else 1.0
    along = np.cumsum(np.where(track.start, usual, np.maximum(steps, 0.0)))
    width = max(1, len(along) // POINTS)
    count = len(along) // width * width
    with drawing():
        figure, axis = plt.subplots(figsize=(7.2, 2.6))
        for values, colour, label in (
            (track.before_mm, RED, "before"),
            (track.after_mm, BLUE, "after"),
        ):
            square = np.square(values[:count]).reshape(-1, width)
            seen = np.isfinite(square)
            with np.errstate(invalid="ignore"):
                mean = np.sqrt(np.nansum(square, 1) / np.where(seen.any(1), seen.sum(1), np.nan))
            axis.plot(along[:count].reshape(-1, width).mean(1), mean, c=colour, lw=1, label=label)
        axis.set_xlabel("time [s]")
        axis.set_ylabel("error [mm]")
        axis.set_ylim(bottom=0)
        axis.legend()
        return chart(figure, caption, caption)
