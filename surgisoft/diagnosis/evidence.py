"""The evidence of a diagnosis: everything that is decided from, as dimensionless numbers.

`evidence_of` turns what model selection found into an `Evidence`. The fitted decision
(`decision`) sees nothing else, so it can be fitted again to stored evidence in seconds.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from scipy.special import ndtri

from surgisoft.diagnosis.abrupt import body_jumps, key_point_shift
from surgisoft.diagnosis.beyond_history import beyond_history, sudden_turn
from surgisoft.diagnosis.residuals import Problem
from surgisoft.diagnosis.selection import Findings, ModelSelection, Score, Selected
from surgisoft.diagnosis.statistics import block_sums, studentised, variance_between
from surgisoft.surrogate.effects import hypothesis_of, known_effects

VERSION = 6
"""Version of the evidence, raised when a number gets another meaning: stored evidence of another
version is collected again."""
INDEPENDENT = 6.0
"""Independent values in the error that is left in one block of time: a body errs in two directions
of bending, and over the shortest correlation that the cross-validation tries (`PERSISTENCE`, 5
rows) a block of about 17 rows has three."""
COLLINEAR_RIDGE = 1e-6
"""Ridge, as a share of the mean power of the sensitivities, of the regression for collinearity."""
TINY = 1e-9
"""Share of an effect's power in all motions that counts as none in one of them: its amplitude there
is as good as unknown, and has next to no weight."""


@dataclass(frozen=True)
class EffectEvidence:
    """One effect alone, and compared with the best one."""

    effect: str
    """Its name."""
    gain: float
    """Share of what can be explained that it explains, at most 1."""
    log_gain: float
    """Mean over blocks of log(error before / after), the noise added to both."""
    z: float
    """Normal quantile of its family-wise p-value: 0 at 0.5, 2.3 at 0.01."""
    left: float
    """Log of what it leaves over what the best effect leaves, the noise added to both."""
    margin: float
    """Studentised mean over motions of the best effect's log gain less this one's; 0 for the best
    one itself."""
    unique: float
    """Gain that comes back when it is left out of all effects together."""
    collinear: float
    """Share of the change that the best effect explains which this effect's sensitivities can
    imitate, 0 to 1; 1 for the best one itself."""
    amplitudes: int
    """Number of its sensitivities; a refined candidate has one."""
    exact_form: bool
    """Whether real arms have exactly its formula (a rotated frame)."""
    form_gain: float | None = None
    """Additional gain of its relaxed form; None where it was not tested."""
    form_log_gain: float | None = None
    """Log gain of its relaxed form."""
    form_z: float | None = None
    """Normal quantile of the p-value of its relaxed form."""
    by_definition: bool = False
    """Whether the effect is its formula by definition (a constant factor, a rotated frame)."""
    free_amplitudes: int | None = None
    """Number of amplitudes that its fit chose, those of a refined candidate too; None in stored
    evidence that does not have it."""

    variation: float | None = None
    """Variance of its amplitude between motions, in units of its square, beyond what the error that
    it leaves makes of it (`variation`); None in stored evidence that does not have it."""

    @property
    def size(self) -> int:
        """Number of amplitudes that its fit chose, as far as it is known."""
        return self.amplitudes if self.free_amplitudes is None else self.free_amplitudes


@dataclass(frozen=True)
class ProposalEvidence:
    """One effect, or two that are proposed together."""

    effects: tuple[str, ...]
    """Their names, the one that would be missed most first."""
    gain: float
    """Share of what can be explained that they explain together."""
    left_size: float
    """Error that they leave above the floor, in units of the model discrepancy, in a paired
    difference of what the right effect may leave."""
    left_log_box: float
    """Mean over blocks of log(error with them / error of the black box), the noise in both."""
    form_gain: float
    """Additional gain of their relaxed forms."""
    form_log_gain: float
    """Log gain of their relaxed forms."""
    form_z: float
    """Normal quantile of the p-value of their relaxed forms."""
    last_gain: float
    """Share of what those before the last one left that the last one explains."""
    last_log_gain: float
    """Log gain of the last one on top of those before it."""
    last_z: float
    """Normal quantile of the last one's family-wise p-value on top of those before it."""
    last_alone: float
    """Gain of the last one alone over that of the first alone."""
    own_gain: float = 0.0
    """Gain of the last one beside the relaxed forms of those before it."""
    own_log_gain: float = 0.0
    """Log gain of the last one beside the relaxed forms of those before it."""
    own_z: float = 0.0
    """Normal quantile of its p-value there."""
    better: float = 0.0
    """Log of what the proposal with one effect less leaves over what this one leaves, the noise
    added to both."""
    instead: tuple[str, ...] = ()
    """The best substitutes for the first and for the second of two effects."""
    instead_left: tuple[float, ...] = ()
    """Log of what is left with it over what the two leave, the noise added to both."""
    instead_margin: tuple[float, ...] = ()
    """Studentised mean over motions of the log of block errors with it over those with the two."""
    left_log_free: float = 0.0
    """Mean over blocks of log(error with them / error of the free black box), the noise in both:
    of an effect's own form a learner without physics leaves no less."""
    variation: tuple[float, ...] = ()
    """For each of them the variance of its amplitude between motions beside the others, in units of
    its square (`variation`); empty in stored evidence that does not have it."""


@dataclass(frozen=True)
class Evidence:
    """The numbers that a diagnosis is decided from."""

    error_over_floor: float
    """RMS error of the model over the noise floor."""
    error_over_validated: float
    """RMS error of the model over its validated error, both with their noise."""
    size: float
    """Error above the noise floor, in units of the model discrepancy."""
    size_beside_discrepancy: float
    """Error above the floor that the model discrepancy leaves on held-out blocks, in its units."""
    held_static: float
    """Share of the error above the floor that the model discrepancy of its validated size
    explains."""
    free_static: float
    """Share of what can be explained that any function of actuation and direction explains."""
    free_box: float
    """Share of what can be explained that a black box with memory explains, held to no size."""
    error_over_box: float
    """RMS error of the model over that of the free black box with memory, at least 1."""
    box_gain: float
    """Gain of the black box over the model discrepancy of its validated size."""
    box_log_gain: float
    """Log gain of it."""
    box_z: float
    """Normal quantile of its p-value."""
    blocks: int
    """Number of blocks of time."""
    motions: int
    """Number of different motions."""
    effects: tuple[EffectEvidence, ...]
    """All effects alone, the best first."""
    proposals: tuple[ProposalEvidence, ...]
    """The best effect and the best two, as far as they are worth a look."""
    paired: bool = False
    """Whether the paired difference of two sets of recordings is explained."""
    free_log_gain: float = 0.0
    """Log gain of the free black box over the model discrepancy of its validated size."""
    break_log_gain: float = 0.0
    """Log gain of one break over the free black box (`beyond_history`)."""
    line: float = 0.0
    """Share of what the free black box leaves above the noise in one line of its spectrum that is
    none of the actuation or the predicted motion."""
    line_hz: float = 0.0
    """Frequency of that line, Hz; 0 where there is none."""
    sudden_log_gain: float = 0.0
    """Log gain of a sudden turn of the whole body (`beyond_history`) over the best single proposal,
    where that is an effect that moves the base; 0 elsewhere."""
    sudden_margin: float = 0.0
    """Studentised mean over motions of that log gain."""
    sudden_at_s: float = 0.0
    """Moment of that turn, s, all recordings in turn; 0 where none was sought, and in stored
    evidence that does not have it."""
    jumps: float = 0.0
    """RMS size of the ten largest jumps of the body that neither the actuation nor the predicted
    motion has, beyond those before the change, over the RMS error above the noise (`abrupt`)."""
    jump_count: int = 0
    """Number of these jumps."""
    jump_largest_mm: float = 0.0
    """RMS displacement of the key points in the largest of them, mm."""
    jump_largest_s: float = 0.0
    """Moment of that one, s, all recordings in turn; 0 in stored evidence that does not have it."""
    shift: float = 0.0
    """Root of the share of the error above the noise that the shift of one key point against the
    others makes, times the log gain of the shift in the error of that key point; 0 where others
    step with it (`abrupt.KeyPointShift.clarity`)."""
    shift_mm: float = 0.0
    """How far that key point is shifted, mm."""
    shift_key_point: int = -1
    """Number of that key point, from 0 at the base; -1 where the shift was not sought."""
    shift_at_s: float = 0.0
    """Time from which on it is shifted, s, all recordings in turn."""
    slide_from_s: float = 0.0
    """Begin of the gradual motion of that key point, s, all recordings in turn; 0 where a step
    explains as much (`abrupt.Slide`), and in stored evidence that does not have it."""
    slide_until_s: float = 0.0
    """End of it, s; 0 where a step explains as much."""
    slide_mm: float = 0.0
    """How far the key point is shifted at the end of it, mm."""

    def to_json(self) -> dict:
        """Plain values; no frequency of a line, no moment of a jump and no slide where there is
        none, as in evidence of before."""
        plain = asdict(self)
        slide = ("slide_from_s", "slide_until_s", "slide_mm")
        for name in ("line_hz", "jump_largest_s", *slide):
            if not plain[name]:
                del plain[name]
        return plain

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Evidence":
        """The evidence that `to_json` wrote."""
        names = {field.name for field in fields(cls)}
        plain = {name: value for name, value in values.items() if name in names}
        plain["effects"] = tuple(EffectEvidence(**each) for each in plain["effects"])
        plain["proposals"] = tuple(
            ProposalEvidence(**_with_tuples(each)) for each in plain["proposals"]
        )
        return cls(**plain)


def _with_tuples(values: dict[str, Any]) -> dict[str, Any]:
    """The values with tuples instead of JSON's lists."""
    return {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}


def normal_quantile(p_value: float) -> float:
    """Standard normal quantile of 1 - p, finite for every p-value from random draws."""
    return -float(ndtri(min(max(p_value, 1e-6), 1.0 - 1e-6)))


def evidence_of(found: Findings) -> Evidence:
    """The numbers that the findings of a diagnosis amount to."""
    selection, problem, box = found.selection, found.problem, found.box
    floor, null = float(selection.floor.sum()), selection.losses()
    seen = np.isfinite(problem.residual).all(2)
    square = np.where(seen, np.nansum(np.square(problem.residual), axis=2), 0.0)
    raw = block_sums(square.sum(1), problem.block)
    free = min(box.free_losses, raw, null, key=np.sum)
    above = selection.explainable(raw, [free])
    beside = selection.explainable(null, [box.losses, *(s.losses for s in found.first)])
    beyond = beyond_history(problem, box.features)
    sudden, sudden_at_s = sudden_gain(found)
    stated = problem.discrepancy_mm**2 + problem.noise_mm**2
    validated = float((seen.sum(0) * stated).sum())
    return Evidence(
        error_over_floor=math.sqrt(raw.sum() / floor),
        error_over_validated=math.sqrt(raw.sum() / validated),
        size=selection.size(raw),
        size_beside_discrepancy=selection.size(null),
        held_static=_share(raw.sum() - null.sum(), above),
        free_static=_share(raw.sum() - box.static_losses.sum(), above),
        free_box=_share(raw.sum() - free.sum(), above),
        error_over_box=math.sqrt(max(raw.sum() / max(free.sum(), 1e-30), 1.0)),
        box_gain=_share(null.sum() - box.losses.sum(), beside),
        box_log_gain=float(selection.log_ratio(null, box.losses).mean()),
        box_z=normal_quantile(box.p_value),
        blocks=len(selection.validation.counts),
        motions=int(problem.motion.max()) + 1,
        effects=tuple(_effect(found, found.first[0], score) for score in found.first),
        proposals=tuple(_proposal(found, each, free) for each in range(len(found.proposals))),
        paired=problem.table.paired_discrepancy_mm is not None,
        free_log_gain=float(selection.log_ratio(null, free).mean()),
        break_log_gain=float(selection.log_ratio(beyond.losses, beyond.break_losses).mean()),
        line=beyond.line,
        line_hz=beyond.line_hz,
        sudden_log_gain=float(sudden.mean()),
        sudden_margin=_margin(found, sudden),
        sudden_at_s=sudden_at_s,
        **abrupt_changes(problem),
    )


def abrupt_changes(problem: Problem) -> dict[str, Any]:
    """The numbers of `Evidence` on jumps of the body and on a key point that shifts."""
    table = problem.table
    body, shift = table.jumps or body_jumps(table), key_point_shift(problem)
    slide = shift.slide if shift else None
    sizes, along_s = body.jumps.sizes_mm, table.along_s[table.timed]
    return {
        "jumps": body.share,
        "jump_count": len(sizes),
        "jump_largest_mm": float(sizes.max(initial=0.0)),
        "jump_largest_s": float(along_s[body.jumps.rows[0]]) if len(sizes) else 0.0,
        "shift": shift.clarity if shift else 0.0,
        "shift_mm": shift.shift_mm if shift else 0.0,
        "shift_key_point": shift.key_point if shift else -1,
        "shift_at_s": shift.at_s if shift else 0.0,
        "slide_from_s": slide.from_s if slide else 0.0,
        "slide_until_s": slide.until_s if slide else 0.0,
        "slide_mm": slide.shift_mm if slide else 0.0,
    }


def sudden_gain(found: Selected) -> tuple[np.ndarray, float]:
    """(B,) log gain of a sudden turn of the body over the best single proposal; its moment, s.

    Both are 0 where that is no effect that moves the base. Neither contains the other, so the
    studentised mean of the log gain decides between the two (Vuong 1989, "Likelihood ratio tests
    for model selection and non-nested hypotheses").
    """
    selection, best = found.selection, found.proposals[:1]
    known = known_effects()
    if not any(hypothesis_of(known[name]).moves_base for one in best for name in one.effects):
        return np.zeros(len(selection.floor)), 0.0
    sudden = sudden_turn(selection.validation.split, selection.problem.predicted)
    rows = found.problem.index.numpy()
    at_s = float(found.problem.table.along_s[rows[int(sudden.at * len(rows))]])
    return selection.log_ratio(selection.losses(best[0].chosen), sudden.losses), at_s


def _share(part: float, whole: float) -> float:
    return float(min(max(part / whole, 0.0), 1.0))


def _margin(found: Selected, gap: np.ndarray) -> float:
    """Studentised mean over motions of differences (B,) by block; 0 where there are none."""
    by_motion = found.problem.by_motion(gap[None])
    return float(studentised(by_motion)[0]) if by_motion.any() else 0.0


def variation(found: Selected, scores: Sequence[Score]) -> tuple[float, ...]:
    """Variance between motions of each effect's amplitude, all of them fitted together.

    An effect that is there has one amplitude, whatever the motion; what stands in for another one
    has another in every motion. In units of the square of the fitted amplitude: 0.04 where
    amplitudes differ by 20 %. Each motion has amplitudes of its own (least squares on its held-out
    rows, what the effect explains scaled by one factor). Their variance beyond that of the
    estimates is that of random effects (`variance_between`); an estimate has that of what is left
    in the motion, as INDEPENDENT values for each of its blocks. It asks for constant parameters
    (Chow 1960) over motions in no order, where a relaxed form asks for trends in time and state.
    """
    selection, motion = found.selection, found.problem.motion
    products = selection.validation.contributions([score.option.chosen for score in scores])
    by_motion = np.zeros((int(motion.max()) + 1, *products.shape[1:]))
    np.add.at(by_motion, motion, products)
    own, right = by_motion[:, 1:, 1:], by_motion[:, 1:, 0]
    most = np.einsum("mee->e", own)
    spread = np.diag(TINY * np.maximum(most, TINY))
    inverse = np.linalg.inv(own + spread)
    factors = np.einsum("mef,mf->me", inverse, right)
    total = by_motion[:, 0, 0]
    left = np.maximum(total - np.einsum("me,me->m", factors, right), TINY * total.sum())
    error = left / (INDEPENDENT * np.bincount(motion))
    return tuple(
        variance_between(factors[:, place], error * inverse[:, place, place])
        for place in range(len(scores))
    )


def _effect(found: Findings, best: Score, score: Score) -> EffectEvidence:
    """One effect alone against the best one."""
    selection, floor = found.selection, float(found.selection.floor.sum())
    margin = 0.0
    form = found.forms.get(score.effect)
    hypothesis = hypothesis_of(known_effects()[score.effect])
    if score is not best:
        margin = _margin(found, best.log_gain - score.log_gain)
    return EffectEvidence(
        effect=score.effect,
        gain=float(score.gain),
        log_gain=float(score.log_gain.mean()),
        z=normal_quantile(score.p_value),
        left=math.log((score.losses.sum() + floor) / (best.losses.sum() + floor)),
        margin=margin,
        unique=float(found.unique.get(score.effect, 0.0)),
        collinear=1.0 if score is best else collinearity(selection, best, score),
        amplitudes=len(score.option.chosen),
        free_amplitudes=score.option.amplitudes,
        exact_form=hypothesis.exact_form,
        by_definition=hypothesis.by_definition,
        form_gain=None if form is None else form.share,
        form_log_gain=None if form is None else form.log_gain,
        form_z=None if form is None else normal_quantile(form.p_value),
        variation=variation(found, [score])[0],
    )


def collinearity(selection: ModelSelection, best: Score, other: Score) -> float:
    """Share of the change by one effect that another one's sensitivities can imitate, 0 to 1.

    R^2 of the regression of the best effect's change at its fitted amplitudes, over all rows and
    key points, on the other effect's sensitivities. What the model discrepancy could imitate of
    both counts too: a large value means that the two are hard to tell apart, no more.
    """
    own = list(best.option.chosen)
    change = selection.explained_mm(own, selection.validation.amplitudes(own))
    target = change[np.isfinite(selection.problem.residual)]
    gram, moment = selection.products(other.option.chosen, change)
    ridge = COLLINEAR_RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    explained = float(moment @ np.linalg.solve(gram + ridge, moment))
    return _share(explained, max(float(target @ target), 1e-30))


def _proposal(found: Findings, place: int, free: np.ndarray) -> ProposalEvidence:
    """One proposal against those with fewer effects, and against the black boxes.

    free: (B,) held-out squared error of the free black box, mm^2.
    """
    selection, proposal = found.selection, found.proposals[place]
    null, after = selection.losses(), selection.losses(proposal.chosen)
    floor, last, form = float(selection.floor.sum()), proposal.scores[-1], proposal.relaxed
    fewer = selection.losses(found.proposals[place - 1].chosen) if place else null
    tried = [after, found.box.losses, *(score.losses for score in found.first)]
    alone = {score.effect: float(score.gain) for score in found.first}
    first = max(alone.get(proposal.effects[0], 0.0), 1e-3)
    own = proposal.beside
    others = [score for score in proposal.instead if score is not None]
    gaps = [selection.log_ratio(score.losses, after) for score in others]
    return ProposalEvidence(
        effects=proposal.effects,
        gain=_share(null.sum() - after.sum(), selection.explainable(null, tried)),
        left_size=selection.left_size(after),
        left_log_box=float(selection.log_ratio(after, found.box.losses).mean()),
        form_gain=form.share,
        form_log_gain=form.log_gain,
        form_z=normal_quantile(form.p_value),
        last_gain=float(last.gain),
        last_log_gain=float(last.log_gain.mean()),
        last_z=normal_quantile(last.p_value),
        last_alone=min(max(alone.get(last.effect, 0.0) / first, 0.0), 2.0),
        own_gain=float(own.gain) if own else 0.0,
        own_log_gain=float(own.log_gain.mean()) if own else 0.0,
        own_z=normal_quantile(own.p_value) if own else 0.0,
        better=math.log((fewer.sum() + floor) / (after.sum() + floor)),
        instead=tuple(score.effect for score in others),
        instead_left=tuple(
            math.log((score.losses.sum() + floor) / (after.sum() + floor)) for score in others
        ),
        instead_margin=tuple(_margin(found, gap) for gap in gaps),
        left_log_free=float(selection.log_ratio(after, free).mean()),
        variation=variation(found, proposal.scores),
    )
