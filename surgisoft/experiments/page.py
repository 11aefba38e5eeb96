"""The HTML report of an experiment: summary, table, sweeps, first and worst episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from surgisoft.agents.evaluate import WHAT_CELLS_ARE, cell, cells_are
from surgisoft.agents.report import episode_parts
from surgisoft.agents.report_charts import path_chart, spread_chart, sweep_chart
from surgisoft.errors import counted
from surgisoft.experiments.plan import configured, in_words
from surgisoft.experiments.results import Results, SettingResult
from surgisoft.experiments.spec import Experiment
from surgisoft.report import Facts, Gallery, Page, Picture, Section, Share, Table, Text
from surgisoft.tasks.supervision import MEAN_MM, Row, ended_well, main_error

SHOWN = 4
"""Most settings of which the first episode is shown."""
HOW = WHAT_CELLS_ARE + (
    "Clearance, contact and success come from exact collision checks (FCL) of the true bodies."
)


def experiment_page(
    results: Results,
    charts: Mapping[tuple[str, int], Sequence[Picture]],
    films: dict[tuple[str, int], Picture],
    about: str,
    notes: Sequence[str] = (),
) -> Page:
    """HTML report of an experiment.

    charts, films: (setting's label, episode) -> charts and film strip to show, in this order.
    notes: what the user was warned of.
    """
    how = results.experiment.of.experiment.how
    warned = [Section("Warnings", _lines_of("warning", notes))] if notes else []
    sections = [*_failed(results), *warned, _table(results), _outcomes(results)]
    if len(results.settings) > 1 or results.experiment.repeats > 1:
        sections.append(Section("Every episode", [Gallery(_spreads(results))]))
    sections += _sweeps(results)
    if 1 < len(results.settings) <= SHOWN:
        sections.append(_side_by_side(results))
    for (label, episode), drawn in charts.items():
        worst = (label, episode) == results.worst and len(results.rows) > 1
        title = f"{'Worst of all: ' if worst else ''}{label}, episode {episode}"
        film = films.get((label, episode))
        parts = episode_parts(results.log(label, episode), drawn)
        sections.append(Section(title, [*([film] if film else []), *parts]))
    return Page(
        title=f"Experiment {results.experiment.name}",
        verdict=verdict(results),
        about=about,
        tone=_tone(results),
        parts=[
            *([Text(results.experiment.note)] if results.experiment.note else []),
            Facts(_facts(results)),
            *sections,
            _design(results),
            Section("How to read this", [Text(f"{rules(results)}\n\n{HOW} {how}".rstrip())]),
        ],
    )


def shown_episodes(results: Results) -> list[tuple[str, int]]:
    """(label, episode): the first of each setting, of the very first where many, and the worst."""
    settings = results.settings if len(results.settings) <= SHOWN else results.settings[:1]
    first = [(setting.label, 0) for setting in settings]
    return list(dict.fromkeys([*first, results.worst]))


def verdict(results: Results) -> str:
    """One or two sentences that state the main result."""
    settings, faults = results.settings, results.experiment.faults
    unsafe = max(row["beam_unsafe_longest_s"] for row in results.rows)
    hits = sum(row.get("collided", 0.0) > 0.0 for row in results.rows)
    each = "; ".join(f"'{s.label}': {_one(s)}" for s in settings)
    if faults and not any(_fault_came(results, row) for row in results.rows):
        first = f"No episode lasted until the fault at {min(f.at_s for f in faults):g} s"
        first += f"; {each}" if len(settings) <= SHOWN else ""
    elif faults:
        ended = sum(row["outcome"].startswith("aborted") for row in results.rows)
        first = f"After the fault {ended} of {len(results.rows)} episodes were aborted"
        if _beams(results):
            cut = sum(row.get("success", 0.0) for row in results.rows)
            nevertheless = f", {cut:.0f} were cut nevertheless" * _rated(results)
            first += (
                f"{nevertheless}; the beam was on for at most {unsafe:.2g} s while it was unsafe"
            )
        elif len(settings) <= SHOWN:
            first += f"; {each}"
    elif len(settings) <= SHOWN:
        first = each
    elif not _rated(results):
        first = _range_of_errors(settings)
    else:
        shares = [s.overall["success"].mean for s in settings]
        low, high = min(shares), max(shares)
        best, least = settings[shares.index(high)].label, settings[shares.index(low)].label
        first = f"Success from {low:.0%} ('{least}') to {high:.0%} ('{best}')"
        if low == high:
            first = f"Success {low:.0%} in each of {len(settings)} settings"
    last = f"{hits} of {len(results.rows)} episodes had contact."
    safe = f"was on for at most {unsafe:.2g} s" if unsafe else "was never on"
    safe = "" if faults or not _beams(results) else f" The beam {safe} while it was unsafe."
    last = f" {last}" if "collided" in results.rows[0] else ""
    without = len({failure.setting for failure in results.failed})
    every = counted(len(settings) + without, "setting")
    lost = f" Failed and left out: {without} of {every}." if without else ""
    return f"{first}.{last}{safe}{lost}"


def _failed(results: Results) -> list[Section]:
    """What ended the blocks that failed, where some did."""
    rows = [(failure.text, failure.file.name) for failure in results.failed]
    table = Table(["what happened", "traceback, in the folder failures"], rows)
    return [Section("Failed", [table])] if rows else []


def _fault_came(results: Results, row: Row) -> bool:
    """Whether a fault came before the end of an episode."""
    return row["time_s"] > min(fault.at_s for fault in results.experiment.faults)


def _beams(results: Results) -> bool:
    """Whether a phase of the experiment permits a beam."""
    return any(phase.beam for phase in results.experiment.phases)


def _rated(results: Results) -> bool:
    """Whether the task has a measure of success."""
    return all("success" in setting.overall for setting in results.settings)


def _one(setting: SettingResult) -> str:
    """Success of a setting, without such a measure the episodes that went to their end; its mean
    error."""
    ended = sum(map(ended_well, setting.rows))
    text = f"{ended} of {len(setting.rows)} episodes went to their end"
    if (success := setting.overall.get("success")) is not None:
        text = f"success {round(success.mean * success.episodes)} of {success.episodes}"
    name, title = main_error(setting.overall) or ("", "")
    error = setting.overall.get(name + MEAN_MM)
    if error is not None and error.episodes:
        return f"{text}, mean {title} {error.mean:.2g} mm"
    return text


def _range_of_errors(settings: Sequence[SettingResult]) -> str:
    """Least and largest mean error of many settings of a task without a measure of success."""
    name, title = main_error(settings[0].overall) or ("", "")
    known = [s for s in settings if (e := s.overall.get(name + MEAN_MM)) and e.episodes]
    rows = [row for setting in settings for row in setting.rows]
    ended = f"{sum(map(ended_well, rows))} of {len(rows)} episodes went to their end"
    if not known:
        return ended
    rising = sorted(known, key=lambda setting: setting.overall[name + MEAN_MM].mean)
    low, high = (
        f"{each.overall[name + MEAN_MM].mean:.2g} mm ('{each.label}')"
        for each in (rising[0], rising[-1])
    )
    return f"{ended}, mean {title} from {low} to {high}"


def _tone(results: Results) -> str:
    if results.failed or any(row.get("collided", 0.0) > 0.0 for row in results.rows):
        return "bad"
    if results.experiment.faults:
        return "good" if max(row["beam_unsafe_longest_s"] for row in results.rows) < 0.15 else "bad"
    if not _rated(results):
        return "plain" if all(map(ended_well, results.rows)) else "warn"
    shares = [setting.overall["success"].mean for setting in results.settings]
    return "good" if min(shares) >= 0.95 else "warn"


def _facts(results: Results) -> list[tuple[str, str]]:
    spec, rows = results.experiment, results.rows
    successes = sum(row.get("success", 0.0) for row in rows)
    return [
        ("episodes", f"{len(rows)}"),
        ("settings", f"{len(results.settings)}"),
        *([("success", f"{successes:.0f} of {len(rows)}")] if _rated(results) else []),
        *_safety(rows),
        ("seed", f"{spec.seed}"),
    ]


def _safety(rows: list[Row]) -> list[tuple[str, str]]:
    """Contact and least clearance, where there is something to touch."""
    if "collided" not in rows[0] or "clearance_mm" not in rows[0]:
        return []
    return [
        ("contact", f"{sum(row['collided'] for row in rows):.0f} of {len(rows)}"),
        ("least clearance", f"{min(row['clearance_mm'] for row in rows):.1f} mm"),
    ]


def _known(results: Results) -> dict[str, str]:
    """The task's numbers that these results have -> their titles."""
    numbers, found = results.experiment.of.experiment.numbers, results.settings[0].overall
    return {name: title for name, title in numbers.items() if name in found}


def _table(results: Results) -> Section:
    if len(results.settings) <= SHOWN:
        return Section("Results", [Table(*turned_table(results))])
    known = _known(results)
    header = ["setting", "episodes", *known.values()]
    rows = [
        (
            setting.label,
            f"{len(setting.rows)}",
            *(cell(name, setting.overall[name]) for name in known),
        )
        for setting in results.settings
    ]
    return Section("Results", [Table(header, rows)])


def turned_table(results: Results) -> tuple[list[str], list[tuple[str, ...]]]:
    """Header and rows of the main table, a column for each setting."""
    known = _known(results)
    rows = [
        (title, *(cell(name, s.overall[name]) for s in results.settings))
        for name, title in known.items()
    ]
    shown = [{name: s.overall[name] for name in known} for s in results.settings]
    return [cells_are(shown), *(setting.label for setting in results.settings)], rows


def markdown(results: Results) -> str:
    """Verdict and main table for a text file."""
    header, rows = turned_table(results)
    lines = [header, ["---"] * len(header), *rows]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{verdict(results)}\n\n{table}\n\n{rules(results)}\n"


def rules(results: Results) -> str:
    """Definition of success in one sentence: the rule of the task, and no abort."""
    spec = results.experiment
    if spec.of.success_rule is None:
        if not _rated(results):
            return f"{spec.scenario} has no measure of success, so no rate of it is stated."
        return f"Success: by the measure of {spec.scenario}; nothing is aborted."
    return f"Success: {_rule_of_all(spec, spec.of.success_rule)}; nothing is aborted."


def _rule_of_all(spec: Experiment, rule: Callable[[Any], str]) -> str:
    """The rule of success with the values of all settings, such as "in 30 or 50 s (cut_s)".

    Fields that change more than single words of it are named behind it.
    """
    words = rule(spec.task).split(" ")
    unplaced = []
    for vary in spec.vary:
        top, _, field = vary.field.partition(".")
        if top != "task":
            continue
        of_values = [rule(configured(spec, ((vary.field, v),))).split(" ") for v in vary.values]
        if any(len(each) != len(words) for each in of_values):
            unplaced.append(field)
            continue
        plain = rule(spec.task).split(" ")
        for place, column in enumerate(zip(*of_values, strict=True)):
            if set(column) != {plain[place]}:
                words[place] = _either(list(dict.fromkeys(column)))
    of_setting = f" ({', '.join(unplaced)}: the setting's value)" if unplaced else ""
    return " ".join(words) + of_setting


def _either(values: list[str]) -> str:
    """Values as "1, 2 or 3"; of many the first and the last."""
    if len(values) > SHOWN:
        return f"{values[0]} to {values[-1]}"
    first = ", ".join(values[:-1])
    return f"{first} or {values[-1]}" if first else values[-1]


def _outcomes(results: Results) -> Section:
    rows = [
        (setting.label, outcome, f"{count}", Share(count / len(setting.rows)))
        for setting in results.settings
        for outcome, count in setting.outcomes.items()
    ]
    return Section("How episodes ended", [Table(["setting", "outcome", "episodes", "share"], rows)])


def _side_by_side(results: Results) -> Section:
    """The paths of each setting's first episode."""
    logs = {setting.label: results.log(setting.label, 0) for setting in results.settings}
    paths = [path_chart(log, label) for label, log in logs.items()]
    return Section("First episodes side by side", [Gallery(paths)])


def _spreads(results: Results) -> list[Picture]:
    drawn = []
    known = _known(results)
    for name in results.experiment.of.experiment.per_episode:
        if name not in known:
            continue
        groups = [
            (setting.label, [row[name] for row in setting.rows])
            for setting in results.settings
            if name in setting.overall
        ]
        picture = spread_chart(known[name], groups, known[name])
        drawn += [] if picture is None else [picture]
    return drawn


def _sweeps(results: Results) -> list[Section]:
    """A section for each field that varies: success and error over its values."""
    sections, known = [], _known(results)
    for vary in results.experiment.vary:
        if len(vary.values) < 2:
            continue
        numbers = all(isinstance(each, int | float) for each in vary.values)
        names = [] if numbers else [in_words(each) for each in vary.values]
        charts = [
            sweep_chart(vary.field, known[name], _lines(results, vary.field, name, names), names)
            for name in results.experiment.of.experiment.swept
            if name in known
        ]
        sections.append(Section(f"Over {vary.field}", [Gallery(charts)]))
    return sections


def _lines(results: Results, field: str, name: str, names: Sequence[str]) -> dict[str, list[tuple]]:
    """Case and the other values -> (value, mean, low, high) of a number, rising.

    names: the values in words where they are no numbers; the place in them is then the value.
    """
    lines: dict[str, list[tuple]] = {}
    for setting in results.settings:
        value = setting.values[field]
        if value is None:
            continue
        others = [
            f"{k.split('.')[-1]} {v}"
            for k, v in setting.values.items()
            if k != field and v is not None
        ]
        found = setting.overall[name]
        place = names.index(in_words(value)) if names else value
        point = (place, found.mean, found.low, found.high)
        lines.setdefault(", ".join([setting.case, *others]), []).append(point)
    return {key: sorted(points) for key, points in lines.items()}


def _design(results: Results) -> Section:
    spec = results.experiment
    beams, conditions = _beams(results), spec.of.experiment.conditions
    rows = [
        (
            phase.name,
            *(phase.controller(arm) for arm in spec.of.agents),
            *(["may be on" if phase.beam else "off"] if beams else []),
            conditions[phase.until].about if phase.until != "never" else "its time has elapsed",
            f"{phase.timeout_s:g} s, then {phase.on_timeout}",
        )
        for phase in spec.phases
    ]
    arms = [name if name == "arm" else f"{name} arm" for name in spec.of.agents]
    header = ["phase", *arms, *(["beam"] if beams else []), "next phase when", "longest"]
    faults = [
        f"{fault.arm}: chamber {fault.chamber} goes to 0 kPa from {fault.at_s:g} s on"
        for fault in spec.faults
    ]
    cases = [
        f"{case.name}: {case.plant}, policy {Path(case.policy).name}"
        + (f", hidden {', '.join(case.hidden)}" if case.hidden else "")
        + (f", scene {Path(case.scene).name}" if case.scene else "")
        for case in spec.cases
    ]
    return Section(
        "Design", [Table(header, rows), *_lines_of("Cases", cases), *_lines_of("Faults", faults)]
    )


def _lines_of(title: str, lines: Sequence[str]) -> list:
    return [Table([title], [(line,) for line in lines])] if lines else []
