"""`diagnose`: which physical effect is the model missing?

1. Pose: the model's residual on the open three quarters of the recordings, thinned, in blocks.
2. Columns: what each effect, in each of its shapes, would change to first order.
3. Race: held-out errors of every effect, the surrogate's own error always beside it.
4. Gates: beyond chance for the whole family of effects, and large enough to matter.
5. One effect after another, until the gates are silent; rivals and leftovers decide the answer.
"""

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from surgisoft.diagnosis.candidates import Candidate, candidates
from surgisoft.diagnosis.comparing.axes import shares
from surgisoft.diagnosis.confidence import confidence
from surgisoft.diagnosis.estimation.effects import refined
from surgisoft.diagnosis.inputs import (
    Model,
    Recordings,
    identification_problem,
    open_inputs,
)
from surgisoft.diagnosis.kind import kind_of, unnamed
from surgisoft.diagnosis.problem import Problem, locked_rows
from surgisoft.diagnosis.race.blackbox import BlackBox, black_box
from surgisoft.diagnosis.race.form import Loosened, loosened
from surgisoft.diagnosis.race.gates import first_shares, studentised
from surgisoft.diagnosis.race.naming import CHANCE, LEAST_GAIN, SMALL, name_effects
from surgisoft.diagnosis.race.ranking import Race, Standing, picked_by
from surgisoft.diagnosis.race.static_error import StaticError, static_error
from surgisoft.diagnosis.residuals import residuals
from surgisoft.diagnosis.verdict import (
    Diagnosis,
    ErrorLevels,
    Kind,
    Ranked,
    Verdict,
    sentence_of,
)
from surgisoft.diagnosis.weaknesses import weaknesses
from surgisoft.errors import unknown_name
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.effects import known_effects
from surgisoft.surrogate.known_error import KnownError
from surgisoft.surrogate.model import ArmModel
from surgisoft.workers import torch_threads

MOST_RIVALS = 3
"""Most rivals that an experiment is sought for."""
RIVAL_SHARE = 0.9
"""Share of bootstrap samples in which the first must beat another that explains nearly as much."""
RIVAL_GAIN = 0.8
"""Share of the first's gain from which another counts as a rival."""
NEAR = 0.1
"""Least share of the error above the floor that an effect explains that is said to come nearest."""
NEAR_TIE = (0.02, 0.3)
"""Difference of two effects' gains, as a share of the better one's and of what it leaves, below
which no form is known well enough to tell them apart, however sure the blocks are."""
CLOSE_GAIN = 0.6
"""Least gain, as a share of the best one's, of effects whose shapes are fitted before they race
again: to first order and on a grid a large effect loses some of what it explains."""
UNTENABLE = 0.25
"""Confidence in the one effect that is named below which it is not."""
NEAREST = 0.25
"""Most confidence in the effect that comes nearest to an unknown one."""

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Findings:
    """What the gates let through, and what the answer is made from."""

    problem: Problem
    race: Race
    first: list[Standing]
    """All effects on top of nothing."""
    named: list[Standing]
    """The effects that passed, in order, each on top of those before it."""
    next: list[Standing]
    """The effects that did not pass on top of those, the best first."""
    rivals: list[str]
    """Effects that explain the data about as well as the first, or as one of several."""
    unique: dict[str, float]
    box: BlackBox
    static: StaticError
    """The surrogate's own error before and after the named effects."""
    loose: Loosened | None
    """What the named effects, or the one and its rivals, do beyond that with forms let loose."""

    @property
    def picked(self) -> tuple[int, ...]:
        """Columns of the named effects."""
        return picked_by(self.named)


@torch_threads(1)
def diagnose(
    model: Model,
    recordings: Recordings,
    progress: Progress | None = None,
    reference: Sequence[Recording] | KnownError | None = None,
    without: Collection[str] = (),
) -> Diagnosis:
    """Name the effects that a model is missing on recordings of its own arm.

    Model and recordings may be given by their paths.

    without: effects that cannot be, such as a contact on a bench without anything to lean on.
    reference: recordings from before something changed; without them the residuals that the model
    keeps of its fit. Where there is one of them, the question is what has changed since.
    """
    begin = time.perf_counter()
    report = progress or (lambda text: None)
    model, recordings, notes = open_inputs(model, recordings)
    report("predicting")
    problem = identification_problem(model, recordings, reference)
    report("columns of the effects")
    names = known_effects()
    for name in without:
        if name not in names:
            raise unknown_name("effect", name, names)
    tried = candidates(problem, [name for name in names if name not in without])
    said = answer(find(problem, tried, report))
    if said.verdict.kind == "unknown_effect":
        said = with_axis(said, model, recordings)
    return replace(said, notes=notes, seconds=time.perf_counter() - begin)


def with_axis(said: Diagnosis, model: ArmModel, recordings: list[Recording]) -> Diagnosis:
    """The diagnosis with the axis that what is left depends on most, on the open part."""
    rest = residuals(model, recordings)
    hidden = locked_rows(recordings)
    measured = np.where(hidden[:, None, None], np.nan, rest.measured_mm)
    found = shares(replace(rest, measured_mm=measured))
    if not found or found[0].share <= 0:
        return said
    axis = found[0]
    text = f"{said.verdict.sentence}; it depends most on {axis.axis} ({100 * axis.share:.0f} %)"
    return replace(said, axis=axis.axis, verdict=replace(said.verdict, sentence=text))


def find(problem: Problem, some: list[Candidate], report: Progress) -> Findings:
    """Run the race and the gates."""
    report("held-out errors")
    race = Race.of(problem, some)
    first = race.standings()
    named, following = name_effects(race, first)
    close = _close(first, named)
    if close:
        report(f"shapes of {' and '.join(standing.effect for standing in close)}")
        standing = [(one.effect, race.in_place(race.single(one.option))) for one in close]
        race = race.extended(refined(problem, [one for one in standing if one[1] is not None]))
        first = race.standings()
        named, following = name_effects(race, first)
    base = picked_by(named)
    rivals = _rivals(race, first, named)
    report("black box")
    return Findings(
        problem=problem,
        race=race,
        first=first,
        named=named,
        next=following,
        rivals=rivals,
        unique=race.unique_gains(first),
        box=black_box(problem),
        static=static_error(problem, race, base),
        loose=_loose(race, first, named, rivals),
    )


def _close(first: list[Standing], named: list[Standing]) -> list[Standing]:
    """The one effect that is named and those that explain about as much; none where none does."""
    if len(named) != 1:
        return []
    best = named[0]
    others = [s for s in first if s.effect != best.effect and s.gain >= CLOSE_GAIN * best.gain]
    return [best, *others[:MOST_RIVALS]] if others else []


def _loose(
    race: Race, first: list[Standing], named: list[Standing], rivals: list[str]
) -> Loosened | None:
    """The named effects, or the one and its rivals, let loose."""
    if not named:
        return None
    others = [s for s in first if s.effect in rivals[:MOST_RIVALS]] if len(named) == 1 else []
    return loosened(race, [named, *([s] for s in others)])


def _rivals(race: Race, first: list[Standing], named: list[Standing]) -> list[str]:
    """Effects that would do about as well in the place of one that is named, beside the others."""
    if len(named) == 1:
        return _rivals_of(race, first, named[0])
    answer = []
    for one in named:
        others = [other for other in named if other is not one]
        found = race.standings(picked_by(others), tuple(other.effect for other in others))
        own = next((standing for standing in found if standing.effect == one.effect), None)
        answer += [] if own is None else _rivals_of(race, found, own)
    return list(dict.fromkeys(answer))


def _rivals_of(race: Race, found: list[Standing], best: Standing) -> list[str]:
    """Effects that explain about as much as one, all on top of the same base."""
    of_gain, of_left = NEAR_TIE
    answer = []
    for other in found:
        if other.effect == best.effect or other.gain < RIVAL_GAIN * best.gain:
            continue
        pair = race.problem.by_motion(np.stack([-best.log_gain, -other.log_gain]))
        near = best.gain - other.gain < min(of_gain * best.gain, of_left * (1.0 - best.gain))
        if near or first_shares(pair)[0] < RIVAL_SHARE:
            answer.append(other.effect)
    return answer


def answer(found: Findings) -> Diagnosis:
    """Put what was found into words."""
    race, problem = found.race, found.problem
    counts = race.validation.counts
    before = float(np.sqrt(np.nanmean(np.square(problem.residual).sum(2))))
    floor = float(np.sqrt(np.mean(problem.noise_mm**2)))
    reached = race.rmse_mm(race.losses(found.picked))
    numbers = statistics(found)
    names = tuple(standing.effect for standing in found.named)
    further = found.next[0].gain if found.next else 0.0
    wrong = bool(names) and found.loose is not None and found.loose.wrong
    kind, effects = kind_of(names, found.rivals, further, wrong, numbers)
    sure = confidence(numbers)
    if kind == "identified" and sure < UNTENABLE:
        kind, effects = unnamed(numbers), ()
    if kind == "unknown_effect":
        sure = min(sure, NEAREST)
    levels = ErrorLevels(before, floor, min(reached, found.box.rmse_mm, before))
    ranking = tuple(
        _ranked(found, standing, sure if place == 0 else min(sure, 1.0 - sure))
        for place, standing in enumerate(_order(found))
    )
    near = [s.effect for s in found.first[:1] if s.gain >= NEAR]
    sentence = sentence_of(kind, effects, levels, reached, sure, near[0] if near else None)
    if kind == "several" and found.rivals:
        sentence += f"; {' or '.join(found.rivals)} would do as well in the place of one of them"
    plan = None
    if kind == "ambiguous":
        # Imported here: it predicts every experiment of the catalogue, which takes seconds.
        from surgisoft.diagnosis.next_experiment.propose import recommend

        plan = recommend(problem, effects[:MOST_RIVALS]).experiment
    return Diagnosis(
        verdict=Verdict(kind, effects, sentence),
        error_mm=levels,
        ranking=ranking,
        ambiguous_with=tuple(found.rivals) if kind in ("ambiguous", "several") else (),
        next_experiment=plan,
        checks=(*weaknesses(problem), *within_the_fit(found, kind)),
        statistics=numbers | {"blocks": len(counts)},
    )


def within_the_fit(found: Findings, kind: Kind) -> list[str]:
    """What an effect would explain of an error that is no larger than the fit's own."""
    if kind != "nothing_missing" or not found.first or found.race.whole_size >= 1.0:
        return []
    best = found.first[0]
    if best.gain < LEAST_GAIN or best.p_value > CHANCE or found.race.in_fit(best.effect):
        return []
    text = (
        f"{best.effect} would explain {100 * best.gain:.0f} % of the error, which is within what "
        f"the model's fit validated, so that the fit may as well be what is off; at least "
        f"{100 * SMALL:.0f} % are asked for there"
    )
    if known_effects()[best.effect].stage in ("line", "material"):
        text += f"; fit the network together with it (fit --effects {best.effect}) and compare"
    return [text]


def _order(found: Findings) -> list[Standing]:
    """All effects, the named ones first.

    One that is plausible only on top of another stands as it does there.
    """
    alone = {standing.effect: standing for standing in found.first}
    named = [alone.get(standing.effect, standing) for standing in found.named]
    names = [standing.effect for standing in named]
    return named + [s for s in found.first if s.effect not in names]


def statistics(found: Findings) -> dict:
    """The numbers that the answer and its confidence are made from."""
    race, problem = found.race, found.problem
    floor = race.floor.sum()
    raw = float(np.nansum(np.square(problem.residual)))
    null = race.losses()
    after = race.losses(found.picked)
    best = found.named[0] if found.named else (found.first[0] if found.first else None)
    others = [s for s in found.first if best is not None and s.effect != best.effect]
    runner = others[0] if others else None
    margin, share = 0.0, 1.0
    if best is not None and runner is not None:
        pair = problem.by_motion(np.stack([-best.log_gain, -runner.log_gain]))
        margin = float(studentised(pair[1:] - pair[:1])[0])
        share = float(first_shares(pair)[0])
    return {
        "before_over_floor": float(np.sqrt(raw / floor)),
        "static_share": float((raw - null.sum()) / max(raw - floor, 1e-9 * raw)),
        "static_size": found.static.before,
        "static_size_after": found.static.after,
        "gain": float(best.gain) if best else 0.0,
        "log_gain": float(best.log_gain.mean()) if best else 0.0,
        "p_value": float(best.p_value) if best else 1.0,
        "runner_gain": float(runner.gain) if runner else 0.0,
        "margin": margin,
        "first_share": share,
        "unique": float(found.unique.get(best.effect, 0.0)) if best else 0.0,
        "explained_above_floor": float((null.sum() - after.sum()) / race.excess(null)),
        "box_share": float((null.sum() - found.box.losses.sum()) / race.excess(null)),
        "box_p": found.box.p_value,
        "box_log_gain": float(race.log_ratio(after, found.box.losses).mean()),
        "left_size": race.size(after),
        "loose_share": found.loose.share if found.loose else 0.0,
        "loose_log_gain": found.loose.log_gain if found.loose else 0.0,
        "loose_p": found.loose.p_value if found.loose else 1.0,
        "motions": int(problem.motion.max()) + 1,
        "named": len(found.named),
        "rivals": len(found.rivals),
        "steps": [
            [s.effect, float(s.gain), float(s.log_gain.mean()), float(s.p_value)]
            for s in (*found.named, *found.next[:2])
        ],
    }


def _ranked(found: Findings, standing: Standing, sure: float) -> Ranked:
    """One row of the ranking."""
    race = found.race
    rng = np.random.default_rng(0)
    losses, counts = race.problem.by_motion(np.stack([standing.losses, race.validation.counts]))
    weights = rng.multinomial(len(losses), np.full(len(losses), 1 / len(losses)), size=400)
    draws = np.sqrt((weights @ losses) / (weights @ counts))
    return Ranked(
        effect=standing.effect,
        confidence=round(float(sure), 4),
        gain_alone=float(standing.gain),
        gain_unique=float(found.unique.get(standing.effect, 0.0)),
        heldout_rmse_mm=race.rmse_mm(standing.losses),
        ci95=(float(np.quantile(draws, 0.025)), float(np.quantile(draws, 0.975))),
        p_value=float(standing.p_value),
        log_gain=float(standing.log_gain.mean()),
        parameters=race.parameters(standing),
    )
