"""The pages of an amendment and of an improvement."""

from pathlib import Path

import numpy as np

from surgisoft.diagnosis.amend import Amendment, Track
from surgisoft.diagnosis.estimation.intervals import Parameter, values_text
from surgisoft.diagnosis.improve import Improvement, Round
from surgisoft.report import Facts, Page, Picture, Section, Table, Text
from surgisoft.report.charts import BLUE, GREEN, RED, chart, drawing
from surgisoft.report.style import MUTED

HOW = (
    "The parameters were fitted through the whole model to the training part of the recordings, "
    "with the model discrepancy beside them. The errors on top are those on the held-out part, "
    "the last quarter of each recording, which was evaluated once.\n\n"
    "Intervals are 95 %, from a bootstrap of blocks of time, because consecutive rows have "
    "correlated errors."
)
OUTSIDE = ": outside"
"""Mark of a value outside its plausible range."""
POINTS = 600
"""Points of a line in a chart."""


def amend_page(result: Amendment, title: str, about: str) -> Page:
    """The page of an amendment."""
    fall = result.held_out
    facts = Facts(
        [
            ("before", f"{fall.before:.3f} mm"),
            ("after", f"{fall.after:.3f} mm"),
            ("after, effects alone", f"{result.alone.after:.3f} mm"),
            ("noise floor", f"{fall.floor:.3f} mm"),
            ("fall, 95 %", f"{fall.ci95[0]:.3f} .. {fall.ci95[1]:.3f} mm"),
            ("held-out rows", f"{fall.rows}"),
        ]
    )
    training, held_out = result.tracks
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
                    track_chart(held_out, "Held-out part: not used in the fit"),
                    track_chart(training, "Training part: the parameters were fitted to it"),
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


def improve_page(result: Improvement, title: str, about: str) -> Page:
    """The page of an improvement."""
    fall = result.held_out
    facts = Facts(
        [
            ("before", f"{fall.before:.3f} mm"),
            ("after", f"{fall.after:.3f} mm"),
            ("noise floor", f"{fall.floor:.3f} mm"),
            ("fall, 95 %", f"{fall.ci95[0]:.3f} .. {fall.ci95[1]:.3f} mm"),
            ("steps", f"{len(result.steps)}"),
        ]
    )
    training, held_out = result.tracks
    parts = [facts]
    if result.steps:
        parts.append(waterfall_picture(fall.before, result.steps, fall.floor))
    parts.append(Section("Rounds", [_rounds(result.rounds)]))
    if result.parameters:
        parts.append(Section("Parameters", [parameter_table(result.parameters)]))
    charts = [
        track_chart(held_out, "Held-out part: not used in any round"),
        track_chart(training, "Training part: diagnosed and fitted on it"),
    ]
    parts += [Section("Error over time", charts), Section("How to read this", [Text(HOW)])]
    tone = "good" if result.claimed else "warn"
    return Page(title=title, verdict=result.sentence, about=about, tone=tone, parts=parts)


def _rounds(rounds: tuple[Round, ...]) -> Table:
    header = ["round", "step", "confidence", "training part", "held-out part", "verdict"]
    rows = [
        (
            f"{number}",
            (done.step or "none") + (f" (or {', '.join(done.rivals)})" if done.rivals else ""),
            "-" if done.confidence is None else f"{done.confidence:.2f}",
            f"{done.error_open_mm:.3f} mm",
            "-" if done.error_mm is None else f"{done.error_mm:.3f} mm",
            f"{done.verdict}: {done.sentence}",
        )
        for number, done in enumerate(rounds, 1)
    ]
    return Table(header, rows)


CAPTION = "Error on the held-out part after each step; dashed: noise floor of the measurement"


def waterfall(before_mm: float, steps: list[tuple[str, float]], floor_mm: float):
    """A Matplotlib figure; steps: (name, error after it in mm). Draw inside `drawing`."""
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(1.6 + 1.1 * (len(steps) + 2), 3.2))
    axis.bar(0, before_mm, color=RED, width=0.7)
    level, place, names = before_mm, 0, ["before"]
    axis.text(0, before_mm, f"{before_mm:.3f}", ha="center", va="bottom")
    for place, (name, after) in enumerate(steps, 1):
        rises = after > level
        axis.bar(place, after - level, bottom=level, color=RED if rises else GREEN, width=0.7)
        axis.plot([place - 1.35, place + 0.35], [level, level], c=MUTED, lw=0.8)
        axis.text(place, max(level, after), f"{after - level:+.3f}", ha="center", va="bottom")
        level = after
        names.append(name.replace("_", "\n"))
    axis.bar(len(steps) + 1, level, color=BLUE, width=0.7)
    axis.text(len(steps) + 1, level, f"{level:.3f}", ha="center", va="bottom")
    axis.plot([place + 0.65, len(steps) + 1.35], [level, level], c=MUTED, lw=0.8)
    axis.axhline(floor_mm, c=MUTED, ls="--", lw=1)
    axis.text(len(steps) + 1.45, floor_mm, "floor", c=MUTED, va="bottom")
    axis.set_xlim(-0.5, len(steps) + 1.9)
    axis.set_axisbelow(True)
    axis.set_xticks(range(len(names) + 1), [*names, "after"])
    axis.grid(visible=False, axis="x")
    axis.set_ylabel("error [mm]")
    axis.set_ylim(0, 1.1 * max(before_mm, *(after for _, after in steps)))
    return figure


def waterfall_picture(before_mm: float, steps: list[tuple[str, float]], floor_mm: float) -> Picture:
    """The waterfall for a page."""
    with drawing():
        return chart(waterfall(before_mm, steps, floor_mm), CAPTION, CAPTION)


def write_waterfall(
    before_mm: float, steps: list[tuple[str, float]], floor_mm: float, path: Path
) -> Path:
    """The waterfall as a PNG on white."""
    from matplotlib import pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    with drawing():
        figure = waterfall(before_mm, steps, floor_mm)
        figure.savefig(path, dpi=160, facecolor="white")
        plt.close(figure)
    return path
