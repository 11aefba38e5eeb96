"""The pages of an amendment and of an improvement."""

import inspect
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from surgisoft.diagnosis.amend import Amendment, Fall, Track, errs_more
from surgisoft.diagnosis.diagnose import Diagnosis
from surgisoft.diagnosis.error_axes import axis_in_words
from surgisoft.diagnosis.estimation.intervals import Parameter, values_text
from surgisoft.diagnosis.improve import NETWORK, Improvement, Round
from surgisoft.diagnosis.pages.pictures import bodies, save
from surgisoft.diagnosis.residuals import ResidualTable, floor_in_words
from surgisoft.errors import counted
from surgisoft.files import new_file
from surgisoft.report import (
    Command,
    Facts,
    Page,
    Part,
    Picture,
    Section,
    Share,
    Table,
    Text,
    write_page,
)
from surgisoft.report.charts import BLUE, BROAD, BROAD_PX, GREEN, RED, chart, drawing
from surgisoft.report.style import MUTED
from surgisoft.surrogate.effects import known_effects
from surgisoft.surrogate.effects.user_defined import kind_of
from surgisoft.time_axis import with_gaps

HOW = (
    "The parameters were fitted through the whole model to the training part of the recordings, "
    "with the model discrepancy beside them. The errors on top are those on the held-out part "
    "(the last quarter of each recording, of four runs or more the last ones), evaluated once.\n\n"
    "Intervals are 95 %, from a bootstrap of blocks of time, because consecutive rows have "
    "correlated errors.\n\n"
    "A parameter outside its plausible range, or with an interval over decades, is one that these "
    "recordings do not determine: the prediction was validated, not the number."
)
HOW_IN_FIT = (
    "The given model had been fitted to {:.0%} of the held-out rows. The effects were not fitted "
    "to these rows, but they are not unseen data: the given model's error there is smaller than on "
    "new recordings, and the intervals of the parameters do not include the part of the effects "
    "that its network has learned. `surgisoft compare MODEL NEW REC --test` compares both models "
    "on recordings that neither was fitted to."
)
POINTS = 600
"""Points of a line in a chart."""


def amend_page(result: Amendment, title: str, about: str) -> Page:
    """The page of an amendment."""
    fall, alone = result.held_out, result.alone
    of_model = ", network re-tuned" if result.retuned else ""
    facts = Facts(
        [
            ("before", f"{fall.before:.3f} mm"),
            (f"after{of_model}", f"{fall.after:.3f} mm"),
            ("after, effects alone", f"{alone.after:.3f} mm"),
            ("noise floor", floor_in_words(fall.floor, ".3f")),
            (f"reduction, 95 %{of_model}", _interval(fall)),
            *([("reduction, 95 %, effects alone", _interval(alone))] if result.retuned else []),
            ("held-out rows", f"{fall.rows}"),
            *_of_model(result.model_error),
            *_in_fit(fall),
        ]
    )
    training, held_out = result.tracks
    return Page(
        title=title,
        verdict=result.sentence,
        about=about,
        tone="good" if result.claimed and not errs_more(result.model_error) else "warn",
        parts=[
            facts,
            Section("Parameters", parameter_parts(result)),
            Section(
                "Error over time",
                track_charts(
                    {
                        f"Held-out part: {_use(fall)}": held_out,
                        "Training part: the parameters were fitted to it": training,
                    },
                    result.held_out.floor,
                ),
            ),
            Section("How to read this", how_to_read(fall)),
        ],
    )


def _interval(fall: Fall) -> str:
    """The interval of a fall as the sentence of the result has it."""
    return f"{fall.ci95[0]:.3f} to {fall.ci95[1]:.3f} mm"


def how_to_read(fall: Fall) -> list[Part]:
    """How to read the page, and what it does not claim where the model knew the held-out rows."""
    parts: list[Part] = [Text(HOW)]
    if fall.in_fit:
        parts.append(Text(HOW_IN_FIT.format(fall.in_fit)))
    return parts


def _in_fit(fall: Fall) -> list[tuple[str, str]]:
    """The share of the held-out rows in the given model's fit, where there is one."""
    return [("of them in the model's fit", f"{fall.in_fit:.0%}")] if fall.in_fit else []


def _of_model(whole: Fall | None) -> list[tuple[str, str]]:
    """The model's own error, where the others are paired differences."""
    if whole is None:
        return []
    return [("error of the model itself", f"{whole.before:.3f} to {whole.after:.3f} mm")]


def _use(fall: Fall) -> str:
    """What the held-out rows were used for, in words."""
    if fall.in_fit:
        return f"not used for the effects, {fall.in_fit:.0%} of it in the model's own fit"
    return "not used in the fit"


def parameter_parts(result: Amendment | Improvement) -> list[Part]:
    """What the fitted parameters mean, and the table of them."""
    words = [Text(f"{name}: {words}.") for name, words in result.in_words.items() if words]
    return [*words, parameter_table(result.parameters)]


def parameter_table(parameters: tuple[Parameter, ...]) -> Table:
    """Every fitted quantity with interval, former value, unit and plausible range."""
    had = any(each.before is not None for each in parameters)
    rows = [
        (
            each.effect,
            each.name,
            values_text(each.value),
            each.interval_text or "-",
            *([] if not had else ["-" if each.before is None else values_text(each.before)]),
            each.unit or "-",
            " to ".join(map(values_text, each.plausible_range))
            + ("" if each.plausible else ": outside"),
            each.source,
        )
        for each in parameters
    ]
    before = ["before"] if had else []
    header = ["effect", "parameter", "value", "95 % interval", *before, "unit", "plausible"]
    header.append("source")
    return Table(header, rows)


def track_charts(tracks: dict[str, Track], floor_mm: float) -> list[Picture]:
    """A chart of each track by its caption, all with one scale of the error.

    A track is the error of both models over time; runs and recordings stand one after another.
    """
    thinned = {caption: _thinned(track) for caption, track in tracks.items()}
    most = max(float(np.nanmax([before, after])) for _, before, after in thinned.values())
    pictures = []
    with drawing():
        for caption, (time_s, before, after) in thinned.items():
            figure, axis = plt.subplots(figsize=(BROAD, 3.0))
            for values, colour, label in ((before, RED, "before"), (after, BLUE, "after")):
                axis.plot(*with_gaps(time_s, values), c=colour, lw=1, label=label)
            axis.axhline(floor_mm, c=MUTED, lw=0.8, ls="--", label="noise floor")
            axis.set_xlabel("time [s]")
            axis.set_ylabel("error [mm]")
            axis.set_ylim(0, 1.05 * most)
            figure.legend(loc="outside lower center", ncols=3)
            pictures.append(chart(figure, caption, caption, BROAD_PX))
    return pictures


def _thinned(track: Track) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time and both errors of a track, RMS over so many rows that about POINTS are left."""
    width = max(1, len(track.time_s) // POINTS)
    count = len(track.time_s) // width * width
    means = []
    for values in (track.before_mm, track.after_mm):
        square = np.square(values[:count]).reshape(-1, width)
        seen = np.isfinite(square)
        with np.errstate(invalid="ignore"):
            means.append(np.sqrt(np.nansum(square, 1) / np.where(seen.any(1), seen.sum(1), np.nan)))
    return track.time_s[:count].reshape(-1, width)[:, 0], *means


def improve_page(
    result: Improvement,
    title: str,
    about: str,
    measured: ResidualTable | None = None,
    drawn: Path | None = None,
    command: str = "",
) -> Page:
    """The page of an improvement, which tells a colleague the whole story.

    measured: residuals of the given model, from which the page says what was measured. drawn: a
    picture of the bodies before and after. command: what to run next, with the names of the files;
    default: with words for them.
    """
    fall = result.held_out
    facts = Facts(
        [
            ("before", f"{fall.before:.3f} mm"),
            ("after", f"{fall.after:.3f} mm"),
            ("noise floor", floor_in_words(fall.floor, ".3f")),
            ("reduction, 95 %", _interval(fall)),
            ("steps", f"{len(result.steps)}"),
            *_of_model(result.model_error),
            *_in_fit(fall),
        ]
    )
    training, held_out = result.tracks
    parts: list[Part] = [facts]
    if measured is not None:
        parts.append(_measured(measured))
    failed: list[Part] = []
    if drawn is not None:
        alt = "The body before and after, measured and predicted, with one scale of the errors"
        failed.append(Picture.from_file(drawn, alt, f"{alt}; held-out part", 620))
    what = "Error" if result.model_error is None else "Change that is not explained"
    use = _use(fall) if fall.in_fit else "not used in any round"
    captions = {
        f"{what}, held-out part: {use}": held_out,
        f"{what}, training part: diagnosed and fitted on it": training,
    }
    failed += track_charts(captions, fall.floor)
    parts.append(Section("Where the model failed", failed))
    if result.diagnoses:
        parts.append(_missing(result))
    worth: list[Part] = []
    if result.steps:
        worth.append(waterfall_picture(fall.before, result.steps, fall.floor))
    parts.append(
        Section("What it is worth", [*worth, Text(_worth(result)), _rounds(result.rounds)])
    )
    if result.parameters:
        parts.append(Section("Parameters", parameter_parts(result)))
    if result.diagnoses:
        parts.append(what_is_left(result, command))
    parts.append(Section("How to read this", how_to_read(fall)))
    good = result.claimed and not errs_more(result.model_error)
    tone = "good" if good else "warn"
    return Page(title=title, verdict=result.sentence, about=about, tone=tone, parts=parts)


def write_improve_report(
    result: Improvement,
    tables: dict[str, ResidualTable],
    folder: Path,
    title: str,
    command: str = "",
) -> list[Path]:
    """Write the report of an improvement to a folder; returns its files, the page first.

    tables: residuals `before` and `after`, on the same recordings. command: as for the page.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn = []
    before = tables["before"]
    if before.spec.key_points > 1:
        # The held-out part, as in the numbers on top; without a step both bodies are the same.
        shown = {name: table.only("held_out") for name, table in tables.items()}
        where = f"held-out part of {', '.join(before.names)}"
        figure = bodies(shown if result.steps else {"before": shown["before"]}, where)
        drawn.append(save(figure, folder / "bodies.png"))
    picture = drawn[0] if drawn else None
    page = improve_page(result, title, result.model.summary(), before, picture, command)
    files = [write_page(page, folder / "report.html"), *drawn]
    if result.steps:
        fall, path = result.held_out, folder / "waterfall.png"
        files.append(write_waterfall(fall.before, result.steps, fall.floor, path))
    return files


def _measured(table: ResidualTable) -> Section:
    """What the recordings hold."""
    spec, rows = table.spec, []
    for number, name in enumerate(table.names):
        own = table.recording == number
        pressure = table.pressure[own]
        timed = bool(table.timed[own].any())
        rows.append(
            (
                name,
                f"{own.sum():,}",
                f"{table.recorded_s(number) / 60:.1f} min" if timed else "steady-state samples",
                f"{len(np.unique(table.run[own]))}",
                f"{np.nanmin(pressure):.3g} .. {np.nanmax(pressure):.3g} {spec.unit}",
                f"{100 * table.held_out[own].mean():.0f} %",
            )
        )
    header = ["recording", "rows", "duration", "runs", "actuation", "held out"]
    points = counted(spec.key_points, "key point")
    text = f"{counted(spec.chambers, 'chamber')} and {points} of one arm were recorded."
    if table.floor.rmse_mm is not None:
        text += (
            f" The noise of a key point is {table.floor.rmse_mm:.3f} mm ({table.floor.source}); no "
            "model can have a smaller error."
        )
    return Section("What was measured", [Text(text), Table(header, rows)])


MOST_WORDS = 6
"""Effects of the ranking that the page lists; the page of the diagnosis has all."""


def effect_words(name: str) -> str:
    """Description of an effect in one sentence: the first of its docstring."""
    found = known_effects().get(kind_of(name))
    return (inspect.getdoc(found) or "").split("\n")[0] if found is not None else ""


def _missing(result: Improvement) -> Section:
    """The ranking of the first diagnosis in words."""
    first = result.diagnoses[0]
    added = [name for name, _ in result.steps]
    rows = [
        (
            each.effect,
            effect_words(each.effect),
            f"{each.heldout_rmse_mm:.3f} mm",
            Share(each.gain_alone),
            "added" if each.effect in added else _why_not(each.effect, first),
        )
        for each in first.shown[:MOST_WORDS]
    ]
    sentence = first.verdict.sentence
    words = [f"{sentence[:1].upper()}{sentence[1:]}."]
    if first.ranking and rows:
        words.append(_ranking_words(first, added))
    header = ["effect", "what it is", "error left with it alone", "explains alone", "result"]
    table = [Table(header, rows)] if rows else []
    return Section("What was missing", [Text("\n\n".join(words)), *table])


def _ranking_words(first: Diagnosis, added: Sequence[str]) -> str:
    """The first few of the ranking in a sentence."""
    best, *others = first.ranking
    alone = first.error_mm.discrepancy_alone
    text = f"By itself, {best.effect} leaves {best.heldout_rmse_mm:.3f} mm on held-out blocks"
    if alone is not None:
        text += (
            f", where the model discrepancy alone, without an effect, leaves {alone:.3f} mm of the "
            f"model's {first.error_mm.before:.3f} mm; what it explains alone is the share that "
            f"goes of the squared error between {alone:.3f} mm and the noise floor of "
            f"{first.error_mm.floor:.3f} mm"
        )
    if others:
        least = min(others, key=lambda each: each.heldout_rmse_mm)
        text += f"; of the others, {least.effect} leaves least, {least.heldout_rmse_mm:.3f} mm"
    more = [name for name in added if name not in (best.effect, NETWORK)]
    if more:
        text += f". Also added, in later rounds or beside it: {', '.join(more)}"
    return text + "."


def _why_not(name: str, first: Diagnosis) -> str:
    if name in first.ambiguous_with:
        return "explains as much"
    row = next(each for each in first.ranking if each.effect == name)
    return "explains nothing" if row.gain_alone <= 0.0 else f"confidence {row.confidence:.2f}"


def _worth(result: Improvement) -> str:
    fall = result.held_out
    if not result.steps:
        return "No effect was added, so the error is unchanged."
    room = fall.before**2 - fall.floor**2
    share = (fall.before**2 - fall.after**2) / room if room > 0 else float("nan")
    times = fall.after / fall.floor if fall.floor > 0 else float("nan")
    return (
        f"The steps remove {100 * share:.0f} % of the squared error above the noise floor. What is "
        f"left is {times:.1f} times the floor."
    )


def what_is_left(result: Improvement, command: str = "") -> Section:
    """What is left after the last round, and what to record next; command: as for the page."""
    last = result.diagnoses[-1]
    parts: list[Part] = [Text(last_word(result))]
    if result.interrupted:  # the last diagnosis may be that of an earlier model
        return Section("What is left", parts)
    if last.axis:
        called = axis_in_words(last.axis, result.model.spec.unit)
        parts.append(Text(f"The remaining error depends most on {called}."))
    wrong = [each for each in result.parameters if not each.plausible]
    if wrong:
        names = ", ".join(f"{each.name} of {each.effect}" for each in wrong)
        text = (
            f"Outside its plausible range, so not known from these recordings: {names}. The error "
            "falls with it, but its value is not a measurement."
        )
        parts.append(Text(text))
    if last.next_experiment:
        plan = last.next_experiment
        text = f"Record next: {plan.name}, {plan.minutes:g} minutes; it {plan.in_words}."
        parts.append(Text(text))
    # What was added since BEFORE is no part of a model that is to describe BEFORE better.
    done = result.steps and any(word in last.next_command for word in ("amend", "{earlier}"))
    if last.next_command and not done:
        parts.append(Command(command or last.command("NEW", "REC")))
    if last.not_testable:
        rows = [(each.effect, each.reason) for each in last.not_testable]
        text = (
            "These recordings cannot show the following effects. To test one, record what it needs:"
        )
        parts += [Text(text), Table(["effect", "why it could not be tested"], rows)]
    elif not last.next_experiment and not last.next_command:
        parts.append(Text("No further recording is asked for: every effect could be tested."))
    return Section("What is left, and what to record next", parts)


def last_word(result: Improvement) -> str:
    """What is known of the error that is left: what the last diagnosis says, if none of its effects
    was added since."""
    ended = [done for done in result.rounds if done.step != NETWORK][-1]
    if ended.step is not None:
        return (
            f"No diagnosis was made after {ended.step} was added, so it is not known whether an "
            "effect is still missing."
        )
    said = f"{ended.sentence[:1].upper()}{ended.sentence[1:]}."
    tuned = result.rounds[-1].step == NETWORK
    return f"{said} That was before the network was re-tuned." if tuned else said


def _rounds(rounds: tuple[Round, ...]) -> Table:
    header = ["round", "step", "confidence", "training part", "held-out part", "verdict"]
    rows = [
        (
            f"{number}",
            (done.step or "none")
            + (f" (or {', '.join(done.competing)})" if done.competing else ""),
            "-" if done.confidence is None else f"{done.confidence:.2f}",
            f"{done.error_training_mm:.3f} mm",
            "-" if done.error_mm is None else f"{done.error_mm:.3f} mm",
            f"{done.verdict}: {done.sentence}",
        )
        for number, done in enumerate(rounds, 1)
    ]
    return Table(header, rows)


CAPTION = "Error on the held-out part after each step; dashed: noise floor of the measurement"


def waterfall(before_mm: float, steps: list[tuple[str, float]], floor_mm: float):
    """A Matplotlib figure; steps: (name, error after it in mm). Draw inside `drawing`."""
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
    with drawing(), new_file(path) as fresh:
        figure = waterfall(before_mm, steps, floor_mm)
        figure.savefig(fresh, dpi=160, facecolor="white")
        plt.close(figure)
    return path
