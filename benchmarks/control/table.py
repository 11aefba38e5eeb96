"""Tables of the benchmark `control` as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.control.study import PLACES, RATE_TASK, ControlConfig, Evaluated, Results
from benchmarks.control.two_processes import arguments
from surgisoft.agents.evaluate import RATES
from surgisoft.agents.presets import PAPER_STEPS, steps_for

NUMBERS = (
    "error_mean_mm",
    "error_rms_mm",
    "error_p95_mm",
    "error_max_mm",
    "beam_error_mean_mm",
    "beam_error_p95_mm",
    "success",
    "completion",
    "largest_gap_mm",
    "healthy_mm2",
    "in_view",
    "clearance_mm",
    "collided",
    "time_s",
    "failed",
)
"""Measures in the tables, where they apply, in this order."""


@dataclass(frozen=True)
class Goal:
    """One goal of the project for a measure."""

    task: str
    """Name of the task."""
    place: str
    """Plant: `simulation` or `rig`."""
    number: str
    """Name of the measure."""
    limit: float
    """Largest value, or least where the number is a share of success."""
    at_least: bool = False
    """Whether the limit is the least value."""
    paper: str = ""
    """Value in the paper (Chen et al. 2025, sec. V)."""


GOALS = (
    Goal("track_circle", "simulation", "error_mean_mm", 0.005, paper="0.0438"),
    Goal("track_square", "simulation", "error_mean_mm", 0.005, paper="0.0104"),
    Goal("laser_plane", "simulation", "error_mean_mm", 0.01, paper="0.0419"),
    Goal("track_circle", "rig", "error_mean_mm", 0.12, paper="0.250 (its real robot)"),
    Goal("track_square", "rig", "error_mean_mm", 0.06, paper="0.126 (its real robot)"),
    Goal("circle_ablation", "simulation", "success", 0.99, at_least=True),
    Goal("circle_ablation", "simulation", "collided", 0.0),
    Goal("circle_ablation", "simulation", "in_view", 0.95, at_least=True),
    Goal("circle_ablation", "simulation", "beam_error_mean_mm", 0.1),
)
"""Goals of the project, with the values of the paper."""


def markdown(results: Results, config: ControlConfig) -> str:
    """All tables of the benchmark."""
    parts = [_setting(config), "## Goals", _goals(results), "## Training", _training(results)]
    if results.paper:
        parts += [f"### {PAPER_STEPS:,} steps", _paper(results, config)]
    for place in PLACES:
        parts.append(f"## {'In simulation' if place == 'simulation' else 'On the virtual rig'}")
        for task in config.tasks:
            some = [p for p in results.evaluated if (p.task, p.place) == (task, place)]
            parts += [f"### {task}", _numbers(some)]
    return "\n\n".join(parts) + "\n"


def _setting(config: ControlConfig) -> str:
    return (
        f"{config.episodes} episodes in simulation and {config.rig_episodes} on the rig for each "
        f"policy, seed {config.episode_seed}, which no training saw. Mean over the episodes with "
        "its 95 % interval; in a scene FCL checks for contact. The rig is robot 0, on which the "
        "default arm was fitted; policies and scripts have never seen its pumps and cameras. The "
        "scripted experts know the true state in simulation, and what is measured on the rig."
    )


def _goals(results: Results) -> str:
    """Table of goals with the worst seed and the scripted expert."""
    lines = [
        "| what | goal | paper | learned, each seed | scripted | random |",
        "|---|---|---|---|---|---|",
    ]
    for goal in GOALS:
        some = [p for p in results.evaluated if (p.task, p.place) == (goal.task, goal.place)]
        if not some:
            continue
        seeds = [_met(p, goal) for p in some if p.policy.startswith("learned, seed")]
        script, chance = (
            ", ".join(_met(p, goal) for p in some if p.policy == name)
            for name in ("scripted", "random")
        )
        sign = ">=" if goal.at_least else "<="
        lines.append(
            f"| {goal.task}, {goal.place}: {goal.number} | {sign} {goal.limit:g} | {goal.paper} | "
            f"{', '.join(seeds) or '-'} | {script} | {chance} |"
        )
    return "\n".join(lines) + "\n\nBold: reached."


def _met(evaluated: Evaluated, goal: Goal) -> str:
    """A number, bold where it reaches the goal."""
    value = (evaluated.numbers.get(goal.number) or {}).get("mean")
    if value is None:
        return "-"
    text = f"{value:.1%}" if goal.number in RATES else f"{value:.3g}"
    good = value >= goal.limit if goal.at_least else value <= goal.limit
    return f"**{text}**" if good else text


def _training(results: Results) -> str:
    lines = [
        "| run | preset | steps | wall s | processor s | steps/s of processor | steps/s of wall "
        "| own evaluation |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for run in results.runs:
        cost = run.cost
        best = ", ".join(f"{name} {value:.4g}" for name, value in run.best.items())
        lines.append(
            f"| {run.task}, seed {run.seed} | {run.preset} | {cost.steps:,} | {cost.wall_s:.0f} | "
            f"{cost.cpu_s:.0f} | {cost.steps_per_s:,.0f} | {cost.steps / cost.wall_s:,.0f} | "
            f"{best} |"
        )
    short = [
        f"{run.task} ({run.cost.steps:,} of {steps_for(run.preset, run.task):,})"
        for run in results.runs
        if run.cost.steps < steps_for(run.preset, run.task)
    ]
    less = f" Trained for fewer steps than the preset's own: {', '.join(short)}." if short else ""
    return (
        "\n".join(lines)
        + f"\n\nRuns as they lay in the folder.{less} One process, one thread. Wall time is "
        "that of a machine which did other work besides; processor time is what the training "
        "itself took, slower where others use the same caches."
    )


def _paper(results: Results, config: ControlConfig) -> str:
    """Duration of the paper's number of steps, from measured rates."""
    rows = [("paper", results.paper)]
    fast = [run.cost for run in results.runs if (run.task, run.preset) == (RATE_TASK, "fast")]
    if fast:
        rows.append(("fast", max(fast, key=lambda cost: cost.steps)))
    lines = [
        "| preset | measured over | steps/s of processor | 20 M steps, minutes of one processor |",
        "|---|---|---|---|",
    ]
    for name, cost in rows:
        minutes = PAPER_STEPS / cost.steps_per_s / 60
        lines.append(
            f"| {name} | {cost.steps:,} steps of {RATE_TASK} | {cost.steps_per_s:,.0f} | "
            f"{minutes:.1f} |"
        )
    text = "\n".join(lines)
    if results.whole:
        whole = results.whole
        options = " ".join(arguments(RATE_TASK, config.whole_steps, Path("RUN")))
        minutes = whole.wall_s * PAPER_STEPS / whole.steps / 60
        text += (
            f"\n\nTwo processes (`torchrun {options}`) trained {whole.steps:,} steps in "
            f"{whole.wall_s:.0f} s of wall time, {minutes:.1f} minutes for {PAPER_STEPS:,}, "
            "updates and evaluations included: measured, not computed from a rate. The goal is 5 "
            f"minutes on two cores, which is {'reached' if minutes <= 5 else 'missed'}. Below, "
            "this policy stands beside those of the seeds."
        )
    return text


def _numbers(some: list[Evaluated]) -> str:
    """All measures of one task on one plant, one column per policy."""
    names = [n for n in NUMBERS if any(_applies(p.numbers.get(n)) for p in some)]
    lines = [
        "| | " + " | ".join(p.policy for p in some) + " |",
        "|---|" + "---|" * len(some),
    ]
    for name in names:
        cells = [_cell(p.numbers.get(name), name in RATES) for p in some]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _applies(found: dict | None) -> bool:
    return bool(found) and found["mean"] is not None and math.isfinite(found["mean"])


def _cell(found: dict | None, rate: bool) -> str:
    if not _applies(found):
        return "-"
    word: Callable[[float], str] = (lambda v: f"{v:.1%}") if rate else (lambda v: f"{v:.4g}")
    return f"{word(found['mean'])} ({word(found['low'])} to {word(found['high'])})"
