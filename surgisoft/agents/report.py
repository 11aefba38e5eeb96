"""The HTML page of an evaluation: summary, table, charts of each policy's first episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from surgisoft.agents.evaluate import (
    FEW,
    RATES,
    WHAT_CELLS_ARE,
    Evaluation,
    cell,
    cells_are,
    differences,
)
from surgisoft.agents.policy_names import short_names
from surgisoft.agents.report_charts import episode_charts, spread_chart
from surgisoft.errors import counted
from surgisoft.report import Facts, Gallery, Page, Picture, Section, Table, Text
from surgisoft.tasks.episodes.log import EpisodeLog
from surgisoft.tasks.supervision import MEAN_MM, main_error

WORDS = {
    "success": "success",
    "completion": "share done",
    "beam_error_mean_mm": "mean beam error [mm]",
    "tissue_error_mean_mm": "mean error on the tissue [mm]",
    "clearance_mm": "least clearance [mm]",
}
"""Numbers that are drawn for every episode, in words."""
UNITS = {"_mm": "mm", "_mm2": "mm²", "_s": "s"}
"""Unit of a number by the end of its name."""
PAIRED = (
    "All policies have the same episodes, so that each number is subtracted episode by episode; "
    "the mean of the differences has Student's 95 % interval of paired samples. Where it does not "
    f"contain 0, the policies differ. Of fewer than {FEW} episodes the least and the greatest "
    "difference are in round brackets instead. Rates are left out."
)
"""How to read the table of differences."""
HOW = WHAT_CELLS_ARE + (
    "Errors are over the steps at which the task measures one: not over the time at the beginning "
    "in which the reference waits for the arm (`approach_s` of the task, grey in the charts of "
    "the error over time). "
    "The beam's error is the distance of its axis from its target while it is on. "
    "Clearance, contact and success come from exact collision checks (FCL) where there is a scene."
)


def evaluation_page(
    task: str,
    on: str,
    results: Sequence[Evaluation],
    logs: Mapping[str, EpisodeLog],
    about: str,
    films: Mapping[str, Picture] | None = None,
    curves: Sequence[Picture] = (),
) -> Page:
    """HTML page of an evaluation; logs: policy -> its first episode, films: its endoscope's.

    curves: learning curves of the policies that were trained, see `learning_curves`.
    """
    films, words = films or {}, short_names([result.policy for result in results])
    names = list(dict.fromkeys(name for result in results for name in result.overall))
    rows = [
        (in_words(name), *(cell(name, result.overall.get(name)) for result in results))
        for name in names
    ]
    header = [
        cells_are(result.overall for result in results),
        *words.values(),
    ]
    best = next(iter(results))
    several = len(results) > 1 or any(len(rows) > 1 for rows in best.per_episode.values())
    return Page(
        title=f"Evaluation of {task}, {on}",
        verdict=verdict(task, results),
        about=about,
        tone=_tone(results),
        parts=[
            Facts(_facts(best) if len(results) == 1 else _facts_of_each(results, words)),
            Section("All numbers", [Table(header, rows)]),
            *_paired(results, words),
            *([Section("Every episode", [Gallery(_spreads(results))])] if several else []),
            *([Section("Learning curves", [Gallery(curves)])] if curves else []),
            *(
                Section(
                    f"First episode of {words.get(name, name)}",
                    [*([films[name]] if name in films else []), *episode_parts(log)],
                )
                for name, log in logs.items()
            ),
            Section("How to read this", [Text(HOW)]),
        ],
    )


def _paired(results: Sequence[Evaluation], words: Mapping[str, str]) -> list[Section]:
    """How the policies differ from the first one in the same episodes; nothing for one policy."""
    if len(results) < 2:
        return []
    found = {words[other.policy]: differences(results[0], other) for other in results[1:]}
    names = [name for name in results[0].overall if any(name in each for each in found.values())]
    rows = [
        (in_words(name), *(cell(name, each.get(name)) for each in found.values())) for name in names
    ]
    first = words[results[0].policy]
    header = ["", *(f"{word} minus {first}" for word in found)]
    return [Section(f"Differences from {first}", [Text(PAIRED), Table(header, rows)])]


def episode_parts(log: EpisodeLog, charts: Sequence[Picture] | None = None) -> list:
    """Charts and events of an episode; charts: what `episode_charts` drew of it, if it did."""
    charts = episode_charts(log) if charts is None else charts
    wide = [picture for picture in charts if picture.alt.startswith("dose")]
    events = [(f"{e.time_s:.1f} s", e.level, e.text) for e in log.events]
    return [
        Gallery([picture for picture in charts if picture not in wide]),
        *(_scrolling(picture) for picture in wide),
        Table(["time", "level", "event"], shortened(events), "Events"),
    ]


def shortened(events: list, most: int = 24) -> list:
    """The events, those in the middle left out where there are many."""
    if len(events) <= most:
        return events
    left = len(events) - most
    return [*events[: most // 2], ("...", "", f"{left} more"), *events[-(most // 2) :]]


def _scrolling(picture: Picture) -> Picture:
    return Picture(picture.data, picture.alt, picture.caption, picture.kind, 620)


def in_words(name: str) -> str:
    """A number's name as people read it: `beam_error_max_mm` is `beam error max [mm]`."""
    if name in WORDS:
        return WORDS[name]
    end = next((end for end in UNITS if name.endswith(end)), "")
    unit = f" [{UNITS[end]}]" if end else ""
    return name.removesuffix(end).replace("_", " ") + unit


def verdict(task: str, results: Sequence[Evaluation]) -> str:
    """One sentence with each policy's success and error."""
    parts, short = [], short_names([result.policy for result in results])
    for result in results:
        success = result.overall.get("success")
        words = [] if success is None else [f"{success.mean:.0%} success"]
        words += [" ".join(stated) for stated in _error(result)]
        parts.append(f"{short[result.policy]}: {', '.join(words) or 'see the table'}")
    counts = [result.episodes for result in results]
    episodes = f"{counted(counts[0], 'episode')} each"
    if len(set(counts)) > 1:
        episodes = f"{' and '.join(map(str, counts))} episodes"
    return f"Task {task}, {episodes}. {'; '.join(parts)}."


def _error(result: Evaluation) -> list[tuple[str, str]]:
    """Title and text of the mean error that sums the episodes up, where one applies."""
    name, title = main_error(result.overall) or ("", "")
    error = result.overall.get(name + MEAN_MM)
    return [(f"mean {title}", f"{error.mean:.3g} mm")] if error and error.episodes else []


def _tone(results: Sequence[Evaluation]) -> str:
    shares = [r.overall["success"].mean for r in results if "success" in r.overall]
    if not shares:
        return "plain"
    return "good" if min(shares) >= 0.95 else "warn" if max(shares) >= 0.5 else "bad"


def _facts(result: Evaluation) -> list[tuple[str, str]]:
    items = [("policy", short_names([result.policy])[result.policy])]
    for name in ("success", "completion", "collided", "clearance_mm", "time_s"):
        value = result.overall.get(name)
        if value is not None and value.episodes:
            text = f"{value.mean:.0%}" if name in (*RATES, "completion") else f"{value.mean:.3g}"
            items.append((in_words(name), text))
    return [*items, *_error(result)]


def _facts_of_each(
    results: Sequence[Evaluation], words: Mapping[str, str]
) -> list[tuple[str, str]]:
    """Success and error of several policies: a policy may be behind another one in either."""
    items = []
    for result in results:
        success = result.overall.get("success")
        if success is not None and success.episodes:
            items.append((f"{words[result.policy]}: success", f"{success.mean:.0%}"))
        items += [(f"{words[result.policy]}: {title}", text) for title, text in _error(result)]
    return items


def _spreads(results: Sequence[Evaluation]) -> list[Picture]:
    names = [n for n in results[0].per_episode if n in WORDS or n.endswith("error_mean_mm")]
    drawn, short = [], short_names([result.policy for result in results])
    for name in names:
        groups = [
            (short[result.policy], result.per_episode[name].tolist())
            for result in results
            if name in result.per_episode
        ]
        words = in_words(name)
        picture = spread_chart(words, groups, words)
        drawn += [] if picture is None else [picture]
    return drawn
