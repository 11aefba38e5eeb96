"""Learning curves of training runs, read from their `metrics.jsonl`, several runs in one chart."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib import pyplot as plt

from surgisoft.agents.policy_names import short_names
from surgisoft.agents.run_folder import RunFolder
from surgisoft.palette import model_colour
from surgisoft.report import Picture
from surgisoft.report.charts import chart, drawing

REWARD = "reward"
"""Name of the sum of all agents' rewards of a step."""
CURVES = {
    REWARD: ("reward of a step", "Mean over the steps of an update, sum over the agents"),
    "evaluation/success": ("success in evaluations", "Share of the evaluation's episodes"),
    "evaluation/error_mm": ("error in evaluations [mm]", "Mean of the evaluation's episodes"),
}
"""Drawn number -> label of its axis, and how it is computed."""
DECADE = 10.0
"""Ratio of the largest to the smallest error from which its axis is logarithmic."""


def metrics_of(run: RunFolder) -> list[dict[str, float]]:
    """The rows of a run's `metrics.jsonl`: name -> finite number, with `REWARD`.

    Lines that hold no such row, as after a power cut, are left out; a run without the file has
    none.
    """
    file, rows = run.path / "metrics.jsonl", []
    text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    for line in text.splitlines():
        try:
            found = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(found, dict):
            continue
        row = {name: float(v) for name, v in found.items() if _is_number(v)}
        if "steps" in row:
            rewards = [value for name, value in row.items() if name.startswith(f"{REWARD}/")]
            rows.append(row | ({REWARD: sum(rewards)} if rewards else {}))
    return rows


def _is_number(value: object) -> bool:
    """Whether a value is a finite number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < sys.float_info.max


def learning_curves(runs: Sequence[str | Path]) -> list[Picture]:
    """A chart over the steps of training for each of `CURVES` that a run has; a line for each run.

    runs: folders of training runs, or names of packaged ones.
    """
    words = short_names([str(run) for run in runs])
    lines = {word: metrics_of(RunFolder(name)) for name, word in words.items()}
    drawn = []
    for name, (label, how) in CURVES.items():
        curves = {
            word: [(row["steps"], row[name]) for row in rows if name in row]
            for word, rows in lines.items()
        }
        curves = {word: points for word, points in curves.items() if points}
        if curves:
            drawn.append(_curve(name, label, how, curves))
    return drawn


def _curve(
    name: str, label: str, how: str, curves: dict[str, list[tuple[float, float]]]
) -> Picture:
    values = [value for points in curves.values() for _, value in points]
    with drawing():
        figure, axis = plt.subplots()
        for number, (word, points) in enumerate(curves.items()):
            mark = "" if name == REWARD else "o"
            colour = model_colour(number)
            axis.plot(*zip(*points, strict=True), c=colour, lw=1.2, marker=mark, ms=3, label=word)
        if name.endswith("_mm") and 0.0 < min(values) <= max(values) / DECADE:
            axis.set_yscale("log")
        elif name != REWARD:
            axis.set_ylim(0.0, 1.05 * max(max(values), 1e-9))
        axis.set_xlim(0.0, 1.03 * max(step for points in curves.values() for step, _ in points))
        axis.locator_params(axis="x", nbins=6)
        axis.ticklabel_format(axis="x", scilimits=(-3, 4), useMathText=True)
        axis.set_xlabel("steps of training")
        axis.set_ylabel(label)
        if len(curves) > 1:
            figure.legend(loc="outside lower center", ncols=2)
        return chart(figure, f"learning curve: {label}", how)
