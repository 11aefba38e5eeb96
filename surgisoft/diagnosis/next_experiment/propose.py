"""The experiment that best tells rival effects apart: model discrimination design.

Every figure of the catalogue is predicted through the model with each rival at the strengths that
the recordings so far suggest. Figures are added one by one, each time the one that raises most the
expected log probability of naming the right rival, over all pairs, whichever is true (Hunter &
Reiner 1965; Box & Hill 1967). The same is done for every change of the bench that touches a rival.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from surgisoft.diagnosis.inputs import (
    Model,
    Recordings,
    identification_problem,
    open_inputs,
)
from surgisoft.diagnosis.isolability.matrix import SURE, Isolability
from surgisoft.diagnosis.next_experiment.catalogue import (
    AS_IT_STANDS,
    FIGURES,
    RUN_S,
    SETTINGS,
    bench_minutes,
    limits_within,
    schedule,
)
from surgisoft.diagnosis.next_experiment.plans import (
    LEAST_RUNS,
    TARGET,
    Plan,
    make_plans,
    pairs_of,
)
from surgisoft.diagnosis.next_experiment.question import Question, pose_question
from surgisoft.diagnosis.next_experiment.words import words_for
from surgisoft.diagnosis.problem import Problem
from surgisoft.diagnosis.verdict import Experiment
from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.histories import STILL_SHARE
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.effects import known_effects, make_effect
from surgisoft.surrogate.known_error import KnownError
from surgisoft.surrogate.model import ArmModel
from surgisoft.workers import torch_threads

MINUTES = 15.0
"""Longest time on the bench where none is asked for, minutes."""


@dataclass(frozen=True)
class Pair:
    """Two rivals and the expected chance to name the right one, whichever it is."""

    effects: tuple[str, str]
    """Their names."""
    before: float
    """With the recordings so far, 0.5 to 1."""
    after: float
    """With the experiment too."""


@dataclass(frozen=True, eq=False)
class Recommendation:
    """What to do on the bench next, and what it is worth."""

    name: str
    """Its name: the figures and the change of the bench."""
    protocol: Protocol
    """The schedule, ready for the rig."""
    setting: str
    """Name of the change of the bench."""
    minutes: float
    """Time on the bench, rests and changes included, minutes."""
    pairs: tuple[Pair, ...]
    """Every pair of rivals."""
    steps: tuple[str, ...]
    """What to do, in words."""
    options: str = ""
    """Options of `surgisoft collect` for the change of the bench on the virtual rig."""
    isolability: Isolability | None = field(default=None, repr=False)
    """What the recordings and the experiment together say about the rivals."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""

    @property
    def separates(self) -> tuple[tuple[str, str], ...]:
        """The pairs that it is expected to tell apart."""
        return tuple(pair.effects for pair in self.pairs if pair.after >= SURE)

    @property
    def by_hand(self) -> bool:
        """Whether it takes a change of the bench that the virtual rig has no option for."""
        return bool(self.removes)

    @property
    def removes(self) -> tuple[str, ...]:
        """Effects that cannot be there any more once the bench is changed."""
        return SETTINGS[self.setting].removes

    @property
    def experiment(self) -> Experiment:
        """In short, as a diagnosis names it."""
        return Experiment(self.name, self.minutes, self.separates)

    @property
    def why(self) -> str:
        """One sentence."""
        worst = min(self.pairs, key=lambda pair: pair.before)
        a, b = worst.effects
        many = f"; {len(self.separates)} of {len(self.pairs)} pairs are told apart by it"
        return (
            f"the chance to tell {a} from {b} goes from {worst.before:.2f} to {worst.after:.2f}"
            + (many if len(self.pairs) > 1 else "")
            + ("; what is recorded should tell them apart already" if worst.before >= SURE else "")
        )

    def to_json(self) -> dict:
        """Plain values, as `next-experiment --json` writes them."""
        return {
            "name": self.name,
            "minutes": self.minutes,
            "setting": self.setting,
            "collect_options": self.options,
            "by_hand": self.by_hand,
            "steps": list(self.steps),
            "why": self.why,
            "separates": [list(pair) for pair in self.separates],
            "pairs": [
                {"effects": list(p.effects), "before": p.before, "after": p.after}
                for p in self.pairs
            ],
            "notes": list(self.notes),
        }


@torch_threads(1)
def next_experiment(
    model: Model,
    recordings: Recordings = (),
    between: Sequence[str] | None = None,
    minutes: float = MINUTES,
    settings: tuple[str, ...] = tuple(SETTINGS),
    reference: Sequence[Recording] | KnownError | None = None,
) -> Recommendation:
    """The experiment that best distinguishes competing effects.

    Model and recordings may be given by their paths. The recordings are looked at as `diagnose`
    does: the training part, the direction of gravity, the residuals of the model's fit.

    between: the competing effects; without them those that explain the recordings best, and
    without recordings all known ones.
    settings: names of the changes of the bench that may be asked for.
    reference: as for `diagnose`.
    """
    given = [recordings] if isinstance(recordings, Recording | str | Path) else list(recordings)
    if not given:
        return propose(load_model(model), between, minutes, settings)
    arm, measured, notes = open_inputs(model, given)
    problem = identification_problem(arm, measured, reference)
    found = recommend(problem, between or likely_rivals(problem), minutes, settings)
    return replace(found, notes=notes)


def recommend(
    problem: Problem,
    rivals: list[str] | tuple[str, ...],
    minutes: float = MINUTES,
    settings: tuple[str, ...] = tuple(SETTINGS),
) -> Recommendation:
    """The experiment that best tells the rivals apart, given a problem's recordings.

    settings: names of the changes of the bench that may be asked for.
    """
    return _recommend(problem.model, problem, list(rivals), minutes, settings)


def propose(
    model: ArmModel,
    rivals: list[str] | tuple[str, ...] | None = None,
    minutes: float = MINUTES,
    settings: tuple[str, ...] = tuple(SETTINGS),
) -> Recommendation:
    """The experiment that best tells the rivals (default: all known effects) apart, before
    anything was recorded."""
    return _recommend(model, None, None if rivals is None else list(rivals), minutes, settings)


def likely_rivals(problem: Problem, most: int = 4) -> list[str]:
    """The effects that explain the residual of a problem best: those that one could confuse.

    The best one, and up to `most` in all whose log evidence is at least half of its own; the two
    best where that is one alone.
    """
    question = pose_question(problem.model, problem)
    gains = question.gains
    best: dict[str, float] = {}
    for owner, gain in zip(question.owners, gains, strict=True):
        best[owner] = max(best.get(owner, -np.inf), gain)
    order = sorted(best, key=lambda name: -best[name])
    near = [name for name in order if best[name] >= 0.5 * best[order[0]]]
    return order[:2] if len(near) < 2 else near[:most]


def _recommend(model, problem, rivals, minutes, settings) -> Recommendation:
    rivals = None if rivals is None else list(dict.fromkeys(rivals))
    _check(model, rivals, minutes)
    question = pose_question(model, problem, rivals)
    limits = _limits(model, problem)
    for name in settings:
        if name not in SETTINGS:
            raise unknown_name("change of the bench", name, SETTINGS)
    plans = make_plans(question, limits, minutes, settings)
    good = [plan for plan in plans if plan.worst >= TARGET]
    plan = min(good, key=lambda p: p.minutes) if good else max(plans, key=lambda p: p.worst)
    return _worded(question, plan, limits)


def _limits(model: ArmModel, problem: Problem | None) -> np.ndarray:
    """(m, 2) range of commands: no chamber leaves what was recorded of the arm.

    A chamber that stood still stays where it was. The range of one that hardly moved is widened
    in the model's scale only: it keeps to what the recordings show.
    """
    spec = model.spec
    limits = limits_within(spec.low, spec.high)
    widest = max(spec.span)
    for chamber, idle in enumerate(spec.idle):
        if idle is not None:
            limits[chamber] = idle
        elif problem is not None:
            history = problem.history
            seen = history.rows(history.pressure)[:, chamber]
            low, high = float(seen.min()), float(seen.max())
            if high - low < STILL_SHARE * widest:
                limits[chamber] = np.clip(limits[chamber], low, high)
    return limits


def _check(model: ArmModel, rivals: list[str] | None, minutes: float) -> None:
    for name in rivals or []:
        if name not in known_effects():
            make_effect(name, model.facts)
    if rivals is not None and len(rivals) < 2:
        raise InputError(
            f"rivals {', '.join(rivals) or 'none'}: expected at least two different effects; "
            "name them with --between A B"
        )
    if not minutes >= bench_minutes(LEAST_RUNS):
        raise InputError(
            f"--minutes {minutes:g}: too short for {LEAST_RUNS} runs with their rests, expected at "
            f"least {bench_minutes(LEAST_RUNS):g}"
        )


def _worded(question: Question, plan: Plan, limits: np.ndarray) -> Recommendation:
    """A plan as something that a person can do."""
    setting = SETTINGS[plan.setting]
    seeds = [plan.figures[:k].count(figure) for k, figure in enumerate(plan.figures)]
    figures = list(zip(plan.figures, seeds, strict=True))
    names = "+".join(dict.fromkeys(plan.figures))
    name = names if plan.setting == AS_IT_STANDS else f"{plan.setting}: {names}"
    protocol = schedule("next_experiment", figures, limits, question.model.spec.unit)
    before = None if question.known is None else question.judged(question.known)
    pairs = tuple(
        Pair((a, b), 0.5 if before is None else before.pair(a, b), plan.result.pair(a, b))
        for a, b in pairs_of(plan.result.names)
    )
    options = setting.options
    gravity = setting.gravity(question.model.facts.gravity)
    if gravity is not None:
        options = options.format(gravity=" ".join(f"{v:.4f}" for v in gravity))
    words = asdict(words_for(question.model.spec.unit))
    what = "; ".join(
        f"{plan.figures.count(f)} x {FIGURES[f].about.format(**words)}"
        for f in dict.fromkeys(plan.figures)
    )
    about = setting.about.format(**words)
    steps = [f"{about} (about {setting.minutes:g} min)"] if about else []
    steps += [
        f"if the error is gone then, the missing effect is {name}; if it stays, it is not"
        for name in setting.removes
    ]
    steps.append(
        f"play the schedule: {len(figures)} runs of {RUN_S / 60:g} min ({what}), each from a "
        f"{words['resting']} that has rested half a minute"
    )
    return Recommendation(
        name, protocol, plan.setting, plan.minutes, pairs, tuple(steps), options, plan.result
    )
