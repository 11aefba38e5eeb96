"""The page of an improvement."""

from surgisoft.diagnosis.improve import Improvement, Round
from surgisoft.diagnosis.pages.amend import HOW, parameter_table, track_chart
from surgisoft.diagnosis.pages.waterfall import waterfall_picture
from surgisoft.report import Facts, Page, Section, Table, Text


def improve_page(result: Improvement, title: str, about: str) -> Page:
    """The page of an improvement."""
    fall = result.locked
    facts = Facts(
        [
            ("before", f"{fall.before:.3f} mm"),
            ("after", f"{fall.after:.3f} mm"),
            ("noise floor", f"{fall.floor:.3f} mm"),
            ("fall, 95 %", f"{fall.ci95[0]:.3f} .. {fall.ci95[1]:.3f} mm"),
            ("steps", f"{len(result.steps)}"),
        ]
    )
    opened, locked = result.tracks
    parts = [facts]
    if result.steps:
        parts.append(waterfall_picture(fall.before, result.steps, fall.floor))
    parts.append(Section("Rounds", [_rounds(result.rounds)]))
    if result.parameters:
        parts.append(Section("Parameters", [parameter_table(result.parameters)]))
    charts = [
        track_chart(locked, "Locked part: took no part in any round"),
        track_chart(opened, "Open part: diagnosed and fitted on it"),
    ]
    parts += [Section("Error over time", charts), Section("How to read this", [Text(HOW)])]
    tone = "good" if result.claimed else "warn"
    return Page(title=title, verdict=result.sentence, about=about, tone=tone, parts=parts)


def _rounds(rounds: tuple[Round, ...]) -> Table:
    header = ["round", "step", "confidence", "open part", "locked part", "verdict"]
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
