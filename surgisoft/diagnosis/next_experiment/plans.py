"""Runs on a bench that tell rivals apart, added one by one, in every setting of the bench."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import log_ndtr

from surgisoft.diagnosis.isolability.designs import (
    Design,
    Shape,
    columns_on,
    design_of,
    length_of,
    planned_history,
    under,
)
from surgisoft.diagnosis.isolability.matrix import Isolability
from surgisoft.diagnosis.isolability.moments import FORM_S, Moments
from surgisoft.diagnosis.next_experiment.catalogue import (
    AS_IT_STANDS,
    FIGURES,
    RUN_S,
    SETTINGS,
    Setting,
    bench_minutes,
    draw_run,
)
from surgisoft.diagnosis.next_experiment.question import Question
from surgisoft.surrogate.effects import Effect, make_effect

LEAST_RUNS = 2
"""Fewest runs of an experiment: one more than a single mishap spoils."""
TARGET = 0.99
"""Expected chance for every pair at which no further run is added."""
RUN_ROWS = 160
"""Rows of a planned run whose columns are computed."""
OWN_WEIGHT_MISFIT = 0.02
"""Mean square that is left, as a share, where the arm's own weight pulls otherwise and the beam's
formula follows it: 0.65 of 4.5 mm on a simulated arm whose base was rolled by 90 degrees."""
OWN_SAG_SHARE = 0.105
"""RMS change of a key point for a unit change of the weight's unit vector, as a share of the arm's
length: 4.5 and 6.2 of 70 mm on the same arm, rolled by 90 and 180 degrees at a tilt of 25."""
OWN_WEIGHT_G = 10.0
"""Mass of an arm against which a known one at its tip is set, g."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Runs on a bench in one setting."""

    setting: str
    """Its name."""
    figures: tuple[str, ...]
    """The runs."""
    minutes: float
    """Time on the bench, minutes."""
    score: float
    """Expected log probability of naming the right one, summed over pairs."""
    result: Isolability
    """With the recordings so far."""

    @property
    def worst(self) -> float:
        """Least chance of any pair."""
        return min(self.result.pair(a, b) for a, b in pairs_of(self.result.names))


def pairs_of(names) -> list[tuple[str, str]]:
    """Every pair of names, in order."""
    return [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]


def make_plans(
    question: Question, limits: np.ndarray, minutes: float, settings: tuple[str, ...]
) -> list[Plan]:
    """The best runs on the bench as it stands and in every setting that touches a rival."""
    model = question.model
    runs = [draw_run(name, limits, 0) for name in FIGURES]
    design = design_of(model, planned_history(model, runs), RUN_ROWS * len(runs))
    run = design.history.run_of_row[design.index].numpy()
    own = columns_on(design, question.shapes)
    answer = []
    for name in dict.fromkeys([AS_IT_STANDS, *settings]):
        setting = SETTINGS[name]
        if bench_minutes(LEAST_RUNS) > minutes - setting.minutes + 1e-9:
            continue
        columns = own if name == AS_IT_STANDS else _changed(question, design, own, setting)
        if columns is None:
            continue
        weight, worth = _own_weight(question, design, setting)
        stacked = np.concatenate([*columns, weight], axis=3)
        parts = {
            figure: Moments.of(
                stacked[run == k],
                design.pressure[run == k],
                design.direction[run == k],
                question.uncertainty,
                worth * RUN_S,
            )
            for k, figure in enumerate(FIGURES)
        }
        answer.append(_greedy(question, name, parts, minutes - setting.minutes))
    return answer


def _changed(question: Question, design: Design, own, setting: Setting):
    """The columns in another setting; None where no rival changes or it cannot be computed."""
    gravity = question.model.facts.gravity
    if setting.moves_weight and gravity is None:
        return None
    facts = replace(question.model.facts, gravity=setting.gravity(gravity))
    absent = [j for j, shape in enumerate(question.shapes) if shape.name in setting.removes]
    other = [
        j
        for j, shape in enumerate(question.shapes)
        if setting.moves_weight
        and not shape.more
        and _differs(shape.effect, under(shape.effect, facts))
    ]
    if not absent and not other:
        return None
    answer = list(own)
    fresh = columns_on(design, [question.shapes[j] for j in other], facts) if other else []
    for j, columns in zip(other, fresh, strict=True):
        answer[j] = columns
    for j in absent:
        answer[j] = np.zeros_like(own[j])
    return answer


def _differs(effect: Effect, other: Effect) -> bool:
    """Whether anything that an effect was given by its arm is another."""
    theirs = dict(other.named_buffers())
    return any(not torch.equal(value, theirs[name]) for name, value in effect.named_buffers())


def _own_weight(question: Question, design: Design, setting: Setting) -> tuple[np.ndarray, float]:
    """(S, n, 3, 1) how the arm moves, mm, because its own weight or a known mass pulls otherwise.

    How far nobody knows, so every rival may use it. And what a row is then worth, 0 to 1: what
    the beam's formula misses of that motion hides the rivals.
    """
    model = question.model
    was = model.facts.gravity
    if was is None or not setting.moves_weight:
        return np.zeros((len(design.index), model.spec.key_points, 3, 1), np.float32), 1.0
    pull = np.asarray(was) if setting.payload_g else np.subtract(setting.gravity(was), was)
    load = make_effect("payload", replace(model.facts, gravity=tuple(float(v) for v in pull)))
    column = list(load.amplitudes()).index("tip_sag" if setting.payload_g else "body_sag")
    motion = columns_on(design, [Shape("payload", load)])[0][..., column : column + 1]
    uncertainty = question.uncertainty
    change = float(np.linalg.norm(pull))
    if setting.payload_g:
        change *= setting.payload_g / OWN_WEIGHT_G
    profile = np.sqrt(np.mean(motion**2, axis=(0, 2, 3)) / max(np.mean(motion**2), 1e-30))
    size = profile * change * OWN_SAG_SHARE * length_of(model)
    hidden = OWN_WEIGHT_MISFIT * size**2 * FORM_S / 3.0
    return motion, float(np.mean(uncertainty.density / (uncertainty.density + hidden)))


def _greedy(question: Question, setting: str, parts: dict[str, Moments], minutes: float) -> Plan:
    """Runs added one by one, each the one that tells most, until the pairs or the time are done."""
    base = SETTINGS[setting].minutes
    chosen: list[str] = []
    new: Moments | None = None
    plan = None
    while bench_minutes(len(chosen) + 1) <= minutes + 1e-9:
        best = None
        for figure, part in parts.items():
            alone = part if new is None else new + part
            total = alone if question.known is None else question.known + alone
            result = question.judged(total)
            score = _score(result)
            if question.known is not None:
                score += _score(question.judged(alone))
            if best is None or score > best[0]:
                best = (score, figure, alone, result)
        score, figure, new, result = best
        chosen.append(figure)
        spent = base + bench_minutes(len(chosen))
        plan = Plan(setting, tuple(chosen), spent, score, result)
        if len(chosen) >= LEAST_RUNS and plan.worst >= TARGET:
            break
    return plan


def _score(result: Isolability) -> float:
    """Expected log probability of the truth, over all ordered pairs."""
    off = ~np.eye(len(result.names), dtype=bool)
    return float(log_ndtr(result.distance[off]).sum())
