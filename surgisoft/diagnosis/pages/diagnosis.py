"""The page of a diagnosis."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from surgisoft.diagnosis.decision import Probabilities
from surgisoft.diagnosis.diagnose import LOCAL, Diagnosis
from surgisoft.diagnosis.pairs import ChangeTrack
from surgisoft.diagnosis.refit import Refit
from surgisoft.diagnosis.residuals import floor_in_words
from surgisoft.diagnosis.setup import SetupFault, SetupResult
from surgisoft.report import Command, Facts, Page, Part, Section, Share, Table, Text, write_page
from surgisoft.report.charts import AMBER, BLUE, BROAD, BROAD_PX, GREEN, RED, chart, drawing
from surgisoft.report.style import MUTED

HOW = (
    "Every effect is added to the model with each choice of its nonlinear parameters, to first "
    "order in its amplitudes, beside a flexible function of actuation and direction that stands "
    "for the model discrepancy and has the size of the model's validated error. Effects are "
    "compared by the error on held-out blocks of time.\n\n"
    "Alone: the share of what can be explained of the held-out squared error (what lies above the "
    "noise floor and below the dash-dotted line of the chart, the error that the model discrepancy "
    "leaves alone) that this effect removes by itself. Unique: the share that returns when it is "
    "left out of all effects together. Of collinear effects, which predict nearly the same change, "
    "the first is large and the second small.\n\n"
    "P-value: how often random signs of the blocks' gains give so large a gain in any of the "
    "effects (family-wise). Confidence: the calibrated probability that the effect is missing, "
    "fitted to robots whose missing effect was known; see the benchmark.\n\n"
    "Best achievable error: the least error on held-out blocks that the model, a black box or any "
    "effect reached.\n\n"
    "The diagnosis did not see the last quarter of each recording: `surgisoft amend` validates its "
    "model on it."
)
HOW_IN_FIT = (
    "The model was fitted to {:.0%} of the rows of this diagnosis. Blocks of time are left out of "
    "the fit of the effects only, so no error on this page is an error on data that the model has "
    "not seen."
)
HOW_SETUP = (
    "Frames, units, orders, chambers, clocks and dead channels are tested before any effect. A "
    "fault is named where the model, with the fault corrected, predicts held-out blocks of time "
    "about as well as a right set-up would. No effect was sought: correct the recordings first, "
    "with the lines in the map of `surgisoft import` or with `surgisoft diagnose ... --apply DIR`."
)
TONES = {"identified": "good", "several": "good", "nothing_missing": "good"}
"""Tone of a verdict; the others are warnings."""
LEAST_SURE = 0.5
"""Confidence below which a named effect is a warning, too."""


HOW_CHANGE = (
    "Change: measured after minus measured before at the instant with the same actuation, a small "
    "difference of the actuation corrected by the model. The model's own error is in neither "
    "curve. What an effect explains is to first order; `surgisoft amend --before` fits it."
)
HOW_SINCE_FIT = (
    "The arm moves faster than in the recordings of the fit, so the model may have lacked effects "
    "of speed from the start. What the model got wrong in the rows that it keeps of its fit was "
    "learned as a function of the actuation and its past, and subtracted. What is left has changed "
    "since the fit."
)
STRETCHES_SHOWN = 8
"""Pairs of runs that the page lists."""
STRETCH_S = 20.0
"""Length of the stretch of the chart, s."""
LEAST_POINTS = 10
"""Fewest rows of a stretch."""


def diagnosis_page(found: Diagnosis, title: str, command: str = "") -> Page:
    """The page of a diagnosis.

    command: what to do, with the names of the files; default: with words for them.
    """
    error, verdict = found.error_mm, found.verdict
    facts = [
        ("error" if found.track is None else "change", f"{error.before:.3f} mm"),
        ("noise floor", floor_in_words(error.floor, ".3f")),
        ("best achievable error", f"{error.best_achievable:.3f} mm"),
        ("time", f"{found.seconds:.1f} s"),
    ]
    if found.in_fit:
        facts.append(("rows in the model's fit", f"{found.in_fit:.0%}"))
    parts: list[Part] = [Facts(facts)]
    if found.checks:
        parts.append(
            Section("Checks of the data", [Text("\n\n".join(map(_sentence, found.checks)))])
        )
    if found.setup:
        parts.append(_setup(found.setup))
    else:
        if found.ranking:
            parts.append(Section("Effects", [effects_chart(found), _ranking(found)]))
        if found.along is not None:
            parts.append(Section("Along the recordings", [along_chart(found)]))
        if found.not_testable:
            rows = [(each.effect, each.reason) for each in found.not_testable]
            note = Text("These recordings cannot show these effects, so they are not ranked.")
            parts.append(Section("Not testable", [note, Table(["effect", "reason"], rows)]))
        if found.probabilities:
            parts.append(_probabilities(found.probabilities))
        if found.next_command:
            parts.append(Section("What to do", [Command(command or found.command())]))
    if found.since_fit:
        said = f"{_sentence(found.since_fit.sentence)}\n\n{HOW_SINCE_FIT}"
        parts.append(Section("Since the fit", [Text(said)]))
    if found.change:
        parts.append(_change(found))
    if found.refit is not None:
        parts.append(_refit(found.refit))
    if found.next_experiment:
        plan = found.next_experiment
        parts.append(
            Section(
                "Next experiment",
                [Text(f"{plan.name}: {plan.minutes:g} minutes on the bench; {plan.in_words}.")],
            )
        )
    if verdict.effects:
        parts.append(_parameters(found))
    how = [Text(HOW_SETUP if found.setup else HOW)]
    if found.in_fit:
        how.append(Text(HOW_IN_FIT.format(found.in_fit)))
    parts.append(Section("How to read this", how))
    unsure = bool(verdict.effects) and verdict.confidence < LEAST_SURE
    return Page(
        title=f"Diagnosis of {title}",
        verdict=verdict.sentence,
        about=f"verdict: {verdict.kind.replace('_', ' ')}",
        tone="warn" if unsure else TONES.get(verdict.kind, "warn"),
        parts=parts,
    )


def _sentence(text: str) -> str:
    """A finding as a sentence of its own."""
    return f"{text[:1].upper()}{text[1:]}."


def _change(found: Diagnosis) -> Section:
    """How far AFTER differs from BEFORE, and what the named effects explain of it."""
    change = found.change
    assert change is not None
    parts: list = [Text(_sentence(change.sentence))]
    rows = [
        (
            f"{each.after}, run {each.after_run}",
            f"{each.before}, run {each.before_run}",
            f"{each.delay_s:.3f}",
            f"{each.rows}",
            f"{100 * each.mismatch:.2f} %",
        )
        for each in change.stretches[:STRETCHES_SHOWN]
    ]
    if rows:
        header = ["after", "before", "delay [s]", "rows", "difference of the actuation"]
        parts.append(Table(header, rows))
    if found.track is not None:
        parts += [change_chart(found.track, explained_by(found)), Text(HOW_CHANGE)]
    return Section("Before and after", parts)


def explained_by(found: Diagnosis) -> str:
    """What the explained change of a diagnosis is explained by, in words."""
    effects = found.verdict.effects
    if found.verdict.kind == "ambiguous":
        return f"{effects[0]} alone (or else by {' or '.join(effects[1:])})"
    return " + ".join(effects) if effects else "the named effects (none)"


def change_chart(track: ChangeTrack, name: str):
    """The tip before and after, and its change, along the stretch in which it changes most.

    name: what the explained change is explained by.
    """
    rows = worst_stretch(track)
    change = track.change_mm[rows, -1]
    along = np.linalg.svd(np.nan_to_num(change), full_matrices=False)[2][0]
    time = track.t_s[rows]
    with drawing():
        figure, (top, below) = plt.subplots(2, 1, figsize=(BROAD, 5.0), sharex=True)
        rest = np.nanmean(track.before_mm[:, -1], axis=0)
        for points, colour, label in (
            (track.before_mm, BLUE, "before"),
            (track.after_mm, AMBER, "after"),
        ):
            top.plot(time, (points[rows, -1] - rest) @ along, c=colour, lw=1, label=label)
        below.plot(time, change @ along, c=RED, lw=1, label="change measured")
        below.plot(
            time,
            track.explained_mm[rows, -1] @ along,
            c=GREEN,
            lw=1.4,
            label=f"change explained by {name}",
        )
        top.set_ylabel("tip [mm]")
        below.set_ylabel("change of the tip [mm]")
        below.set_xlabel("time [s]")
        top.legend(fontsize=8)
        below.legend(fontsize=8)
        caption = "Tip before and after where it changes most, along the main direction of change"
        return chart(figure, caption, caption, BROAD_PX)


def worst_stretch(track: ChangeTrack) -> np.ndarray:
    """Rows of the STRETCH_S seconds of one run in which the key points change most (RMS)."""
    square = np.nanmean(np.square(track.change_mm).sum(2), axis=1)
    best, most = np.arange(len(track.t_s)), -np.inf
    for run in np.unique(track.run):
        rows = np.flatnonzero(track.run == run)
        begins = np.arange(track.t_s[rows[0]], track.t_s[rows[-1]] + 1e-9, STRETCH_S / 2)
        for begin in begins:
            inside = (track.t_s[rows] >= begin) & (track.t_s[rows] <= begin + STRETCH_S)
            some = rows[inside]
            if len(some) >= LEAST_POINTS and (level := np.nanmean(square[some])) > most:
                best, most = some, level
    return best


def _setup(setup: SetupResult) -> Section:
    """What is wrong with the set-up, and its correction."""
    rows = [
        (fault.kind.replace("_", " "), fault.sentence, _numbers(fault)) for fault in setup.faults
    ]
    parts: list[Part] = [
        Table(["fault", "what was found", "numbers"], rows),
        Text(f"Recordings: {', '.join(setup.recordings)}."),
        Text("Correction:"),
        Command(setup.instructions),
    ]
    for other, instructions in zip(setup.alternatives, setup.alternative_instructions, strict=True):
        what = "; ".join(fault.sentence for fault in other)
        parts += [Text(f"Equally likely: {what}. Correction:"), Command(instructions)]
    if setup.how_to_tell:
        parts.append(Text(setup.how_to_tell[:1].upper() + setup.how_to_tell[1:] + "."))
    return Section("Set-up of the recordings", parts)


def _numbers(fault: SetupFault) -> str:
    """Numbers of a fault with their standard errors."""
    texts = []
    for name, value in fault.numbers.items():
        error = fault.errors.get(name)
        known = error is not None
        texts.append(f"{name} {_number(value)}" + (f" +- {_number(error)}" if known else ""))
    return ", ".join(texts)


def _ranking(found: Diagnosis) -> Table:
    rows = [
        (
            row.effect,
            f"{row.confidence:.2f}",
            Share(row.gain_alone),
            Share(row.gain_unique),
            f"{row.heldout_rmse_mm:.3f}",
            f"{row.ci95[0]:.3f} .. {row.ci95[1]:.3f}",
            f"{row.p_value:.4f}",
        )
        for row in found.shown
    ]
    left = "left-out [mm]" if found.in_fit else "held-out [mm]"
    header = ["effect", "confidence", "alone", "unique", left, "95 %", "p-value"]
    return Table(header, rows)


def _probabilities(chances: Probabilities) -> Section:
    """What may be true, with the calibrated probabilities."""
    rows = [
        ("nothing is missing", f"{chances.nothing:.2f}"),
        ("only the model itself is off", f"{chances.network:.2f}"),
        ("a known effect is missing", f"{chances.known:.2f}"),
        ("an unknown effect is missing", f"{chances.unknown:.2f}"),
    ]
    if chances.two:
        rows.append((f"both {' and '.join(chances.two)}", f"{chances.pair:.2f}"))
    return Section("Probabilities", [Table(["what may be true", "probability"], rows)])


def _refit(refit: Refit) -> Section:
    """The candidates that were fitted together with the network."""
    rows = [
        (
            row.effect,
            f"{row.heldout_rmse_mm:.3f}",
            f"{row.rival_mm:.3f}",
            f"{row.difference_mm:.3f} ({row.ci95_mm[0]:.3f} .. {row.ci95_mm[1]:.3f})",
            f"{row.spread_mm:.3f}",
            f"{row.p_value:.4f}",
            str(row.epochs),
            "yes" if row.plausible else "no",
        )
        for row in refit.candidates
    ]
    header = [
        "effect",
        "held-out [mm]",
        "network alone [mm]",
        "difference, 95 % [mm]",
        "spread over seeds [mm]",
        "p-value",
        "epochs",
        "plausible",
    ]
    left = "; ".join(f"{name}: {why}" for name, why in refit.not_tried)
    text = (
        f"{refit.sentence[:1].upper()}{refit.sentence[1:]}. Done because {refit.reason}. "
        f"{refit.trainings} trainings on {refit.rows} rows; {refit.unit} were left out in turn, "
        "and the network alone was trained for as many epochs."
    )
    return Section(
        "Fitted together", [Text(text), Table(header, rows), Text(f"Not tried: {left}.")]
    )


def _parameters(found: Diagnosis) -> Section:
    rows = [
        (row.effect, name, _number(value))
        for row in found.ranking
        if row.effect in found.verdict.effects
        for name, value in row.parameters.items()
    ]
    note = Text("First estimates; `surgisoft amend` fits them through the whole model.")
    words = [Text(f"{name}: {words}.") for name, words in found.in_words]
    return Section("Parameters", [*words, Table(["effect", "parameter", "value"], rows), note])


def _number(value) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_number(item) for item in value) + "]"
    return f"{value:.4g}"


def effects_chart(found: Diagnosis):
    """Held-out error with each effect, between the noise floor and what is left without any."""
    rows = found.shown[::-1]
    error, paired = found.error_mm, found.track is not None
    what, blocks = "change" if paired else "error", "left-out" if found.in_fit else "held-out"
    with drawing():
        figure, axis = plt.subplots(figsize=(BROAD, 0.8 + 0.26 * max(len(rows), 3)))
        for place, row in enumerate(rows):
            named = row.effect in found.verdict.effects
            low, high = row.ci95
            axis.plot([low, high], [place, place], c=RED if named else BLUE, lw=1.2, alpha=0.6)
            axis.plot(row.heldout_rmse_mm, place, "o", c=RED if named else BLUE, ms=5)
        axis.axvline(error.floor, c=GREEN, lw=1, label="noise floor")
        if error.discrepancy_alone is not None:
            label = "no effect (discrepancy alone)"
            axis.axvline(error.discrepancy_alone, c=MUTED, lw=1, ls="-.", label=label)
        label = "size of the change" if paired else "error of the model"
        axis.axvline(error.before, c=AMBER, lw=1, ls="--", label=label)
        axis.set_yticks(range(len(rows)), [row.effect for row in rows])
        left = "change left" if paired else "error"
        axis.set_xlabel(f"{blocks} {left} with this effect added [mm]")
        axis.set_xlim(left=0)
        figure.legend(fontsize=8, loc="outside upper center", ncols=3)
        return chart(figure, f"{blocks.capitalize()} {what} with each effect", "", BROAD_PX)


def along_chart(found: Diagnosis):
    """Error, or change, of each block of time; the worst one marked where the error is local."""
    along, paired = found.along, found.track is not None
    assert along is not None
    what = "change" if paired else "error"
    with drawing():
        figure, axis = plt.subplots(figsize=(BROAD, 2.6))
        for begin, end, value, far in zip(
            along.from_s, along.to_s, along.rmse_mm, along.local, strict=True
        ):
            axis.plot([begin, end], [value, value], c=RED if far else BLUE, lw=2.5)
        axis.axhline(found.error_mm.floor, c=GREEN, lw=1, label="noise floor")
        label = f"median of the blocks: {along.typical_mm:.3g} mm"
        axis.axhline(along.typical_mm, c=AMBER, lw=1, ls="--", label=label)
        axis.set_ylim(bottom=0)
        axis.set_xlabel("time [s]")
        axis.set_ylabel(f"RMS {what} [mm]")
        axis.legend(fontsize=8)
        caption = f"RMS {what} of each block of time"
        if any(along.local):
            caption += f"; red: more than {LOCAL:g} times the median"
        return chart(figure, caption, caption, BROAD_PX)


def write_report(found: Diagnosis, folder: Path, title: str, command: str = "") -> Path:
    """Write `diagnosis.html` into a folder; returns its path. command: as for the page."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "diagnosis.html"
    write_page(diagnosis_page(found, title, command), path)
    return path
