"""The decision of a diagnosis: evidence in, kind of result and confidence out.

`evidence_of` turns what model selection found into numbers (`Evidence`). `decide` turns these
numbers alone into a `Decision`. Another decision, such as a fitted classifier, replaces `decide`
and nothing else.
"""

import math
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from surgisoft.diagnosis.criteria import CRITERIA, Calibration, Criteria, DecisionCriteria
from surgisoft.diagnosis.selection import Findings
from surgisoft.diagnosis.statistics import studentised, win_shares
from surgisoft.surrogate.effects import hypothesis_of, known_effects

Kind = Literal[
    "identified",
    "several",
    "ambiguous",
    "nothing_missing",
    "unknown_effect",
    "surrogate_undertrained",
    "setup",
]

MOST_RUNNER_UP = 1.2
"""Largest gain of the runner-up, as a share of the first's, that the calibration was fitted to."""


@dataclass(frozen=True)
class Evidence:
    """The numbers that a diagnosis is decided from.

    Gains are shares of the held-out squared error above the noise floor, log gains means over
    blocks of log(error before / after), sizes errors above the noise floor in units of the model
    discrepancy.
    """

    before_over_floor: float
    """RMS error of the model over the noise floor."""
    static_share: float
    """Share of the squared error above the floor that the model discrepancy alone explains."""
    static_size: float
    """Most likely size of a static error, without any effect."""
    static_size_after: float
    """Most likely size of a static error, with the named effects."""
    gain: float
    """Gain of the first named effect; of the best one where none is named."""
    log_gain: float
    """Log gain of that effect."""
    p_value: float
    """Family-wise p-value of that effect."""
    runner_gain: float
    """Gain alone of the best other effect."""
    margin: float
    """Studentised mean difference of the log gains of the two."""
    first_share: float
    """Share of bootstrap samples in which the first beats the other."""
    unique: float
    """Gain that comes back when the first is left out of all effects together."""
    explained_above_floor: float
    """Gain of the named effects together."""
    box_share: float
    """Gain of the black box, the model discrepancy held to its validated size."""
    box_p: float
    """p-value of the black box over the model discrepancy."""
    box_log_gain: float
    """Log gain of the black box over the named effects."""
    left_size: float
    """Size of the error that the named effects leave."""
    loose_share: float
    """Gain of the relaxed forms beyond the named effects."""
    loose_log_gain: float
    """Log gain of the relaxed forms beyond the named effects."""
    loose_p: float
    """p-value of the relaxed forms."""
    motions: int
    """Number of different motions."""
    named: int
    """Number of named effects."""
    rivals: int
    """Number of competing effects."""
    steps: tuple[tuple[str, float, float, float], ...]
    """Effect, gain, log gain and p-value of each named effect and of the two next best."""
    blocks: int
    """Number of blocks of time."""
    competing: tuple[str, ...] = ()
    """The competing effects."""
    form_wrong: bool = False
    """Whether the relaxed forms show that the named effects only mimic what is missing."""

    @property
    def effects(self) -> tuple[str, ...]:
        """The named effects, in order."""
        return tuple(step[0] for step in self.steps[: self.named])

    @property
    def further_gain(self) -> float:
        """Gain of the next best effect on top of the named ones; 0 where there is none."""
        return self.steps[self.named][1] if len(self.steps) > self.named else 0.0

    def to_json(self) -> dict:
        """Plain values."""
        return asdict(self)


@dataclass(frozen=True)
class Decision:
    """What the evidence amounts to."""

    kind: Kind
    effects: tuple[str, ...]
    """The effects that are named; the competing ones where they cannot be told apart."""
    confidence: float
    """Calibrated chance that the first effect is missing, 0 to 1."""


def evidence_of(found: Findings) -> Evidence:
    """The numbers that the findings of a diagnosis amount to."""
    selection, problem = found.selection, found.problem
    floor = selection.floor.sum()
    raw = float(np.nansum(np.square(problem.residual)))
    null = selection.losses()
    after = selection.losses(found.chosen)
    best = found.named[0] if found.named else (found.first[0] if found.first else None)
    others = [s for s in found.first if best is not None and s.effect != best.effect]
    runner = others[0] if others else None
    margin, share = 0.0, 1.0
    if best is not None and runner is not None:
        pair = problem.by_motion(np.stack([-best.log_gain, -runner.log_gain]))
        margin = float(studentised(pair[1:] - pair[:1])[0])
        share = float(win_shares(pair)[0])
    relaxed = found.relaxed
    return Evidence(
        before_over_floor=float(np.sqrt(raw / floor)),
        static_share=float((raw - null.sum()) / max(raw - floor, 1e-9 * raw)),
        static_size=found.static.before,
        static_size_after=found.static.after,
        gain=float(best.gain) if best else 0.0,
        log_gain=float(best.log_gain.mean()) if best else 0.0,
        p_value=float(best.p_value) if best else 1.0,
        runner_gain=float(runner.gain) if runner else 0.0,
        margin=margin,
        first_share=share,
        unique=float(found.unique.get(best.effect, 0.0)) if best else 0.0,
        explained_above_floor=float((null.sum() - after.sum()) / selection.excess(null)),
        box_share=float((null.sum() - found.box.losses.sum()) / selection.excess(null)),
        box_p=found.box.p_value,
        box_log_gain=float(selection.log_ratio(after, found.box.losses).mean()),
        left_size=selection.size(after),
        loose_share=relaxed.share if relaxed else 0.0,
        loose_log_gain=relaxed.log_gain if relaxed else 0.0,
        loose_p=relaxed.p_value if relaxed else 1.0,
        motions=int(problem.motion.max()) + 1,
        named=len(found.named),
        rivals=len(found.competing),
        steps=tuple(
            (s.effect, float(s.gain), float(s.log_gain.mean()), float(s.p_value))
            for s in (*found.named, *found.following[:2])
        ),
        blocks=len(selection.validation.counts),
        competing=tuple(found.competing),
        form_wrong=bool(found.named) and relaxed is not None and relaxed.wrong,
    )


def decide(evidence: Evidence, criteria: Criteria = CRITERIA) -> Decision:
    """The kind of result, the effects that it names and the confidence in the first of them."""
    asked, calibration = criteria.decision, criteria.calibration
    sure = confidence(evidence, calibration)
    kind, effects = _kind_of(evidence, asked)
    if kind == "identified" and sure < calibration.untenable:
        kind, effects = unnamed(evidence, asked), ()
    if kind == "unknown_effect":
        sure = min(sure, calibration.nearest)
    return Decision(kind, effects, sure)


def _kind_of(evidence: Evidence, asked: DecisionCriteria) -> tuple[Kind, tuple[str, ...]]:
    names = evidence.effects
    if not names:
        return unnamed(evidence, asked), ()
    beyond = evidence.left_size >= asked.least_size
    if evidence.form_wrong or (beyond and _mimicked(evidence, asked)):
        return "unknown_effect", ()
    if evidence.competing and len(names) == 1:
        return "ambiguous", (names[0], *evidence.competing)
    return ("several" if len(names) > 1 else "identified"), names


def unnamed(evidence: Evidence, asked: DecisionCriteria = CRITERIA.decision) -> Kind:
    """The kind of a result that names no effect."""
    over, left = evidence.before_over_floor, evidence.left_size
    if over >= asked.above_floor and left >= asked.far_size:
        return "unknown_effect"
    if over >= asked.undertrained_over_floor:
        box = evidence.box_share >= asked.box_share and _box_counts(evidence, asked)
        static = evidence.static_size >= asked.discrepancy_size
        if left >= asked.least_size and (box or static):
            return "unknown_effect"
        if evidence.static_share >= asked.undertrained_share:
            return "surrogate_undertrained"
    return "nothing_missing"


def _mimicked(evidence: Evidence, asked: DecisionCriteria) -> bool:
    """Whether the named effects explain too little, or a black box far more."""
    explained = evidence.explained_above_floor
    together = explained + max(evidence.further_gain, 0.0) * (1.0 - explained)
    missed = evidence.box_share - explained
    counts = _box_counts(evidence, asked)
    if evidence.left_size >= asked.far_size:
        exact = all(hypothesis_of(known_effects()[name]).exact_form for name in evidence.effects)
        if together < asked.explained or (exact and explained < asked.explained_exactly):
            return True
    if together < asked.explained_beside_box and counts and missed >= asked.missed_share:
        return True
    better = missed >= asked.box_gain and evidence.box_log_gain >= asked.box_log_gain
    return counts and better


def _box_counts(evidence: Evidence, asked: DecisionCriteria) -> bool:
    """Whether what a black box explains is more than chance and seen in enough motions."""
    return evidence.box_p <= asked.box_p_value and evidence.motions >= asked.least_motions


def confidence(evidence: Evidence, calibration: Calibration = CRITERIA.calibration) -> float:
    """Calibrated chance that the first named effect is missing, 0 to 1; 0 where none is named."""
    if not evidence.named:
        return 0.0
    runner_up = evidence.runner_gain / max(evidence.gain, 1e-6)
    relaxed = max(evidence.loose_share, 0.0) * max(evidence.loose_log_gain, 0.0)
    odds = (
        calibration.constant
        + calibration.runner_up * min(max(runner_up, 0.0), MOST_RUNNER_UP)
        + calibration.relaxed * relaxed
        + hypothesis_of(known_effects()[evidence.effects[0]]).mimic_log_odds
    )
    chance = 1.0 / (1.0 + math.exp(-odds))
    return min(chance, calibration.ambiguous) if evidence.rivals else chance
