"""The experiment that best tells competing effects apart: model discrimination design.

Every excitation signal of the catalogue is predicted through the model with each competing effect
at the amplitudes that the recordings so far suggest. Excitation signals are added one by one, each
time the one that raises most the expected log probability of naming the right competing effect,
over all pairs, whichever is true (Hunter & Reiner 1965; Box & Hill 1967). The same is done for
every experimental setup that touches a competing effect.
"""

import copy
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from scipy.special import log_ndtr

from surgisoft.diagnosis.candidates import facts_of
from surgisoft.diagnosis.design.isolability import (
    FORM_S,
    MISFIT,
    PERIOD_S,
    ROOM,
    SURE,
    UNVALIDATED_SHARE,
    Design,
    Draws,
    Form,
    Isolability,
    Moments,
    Sizes,
    Uncertainty,
    design_of,
    forms_of,
    isolability_from,
    length_of,
    moments_of,
    planned_history,
    reference_design,
    sample_time,
    sensitivities_on,
    uncertainty_of,
    under,
    unimitated,
)
from surgisoft.diagnosis.design.schedules import (
    AS_IT_STANDS,
    RUN_S,
    SETUPS,
    Setup,
    bench_minutes,
    draw_run,
    limits_within,
    schedule,
    words_for,
)
from surgisoft.diagnosis.estimation.effects import with_fitted
from surgisoft.diagnosis.inputs import (
    Model,
    Recordings,
    identification_problem,
    open_inputs,
    refuse_amended,
)
from surgisoft.diagnosis.other_models import is_predictions_file, open_model
from surgisoft.diagnosis.pairs import BeforeAfter, Paired, before_and_after
from surgisoft.diagnosis.residuals import Problem, Sealed, residual_table
from surgisoft.diagnosis.weight import gravity_load
from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.histories import STILL_SHARE
from surgisoft.measurement.protocols import SIGNALS, Protocol
from surgisoft.measurement.recordings import Recording, given_recordings, load_recordings
from surgisoft.progress import Progress, Stages, silent
from surgisoft.surrogate.callables.arm import arm_by_itself
from surgisoft.surrogate.callables.named import given_callable
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.effects import Effect, hypothesis_of, known_effects, make_effect
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import TrainingResiduals
from surgisoft.workers import torch_threads

# Competing effects and what is known of them -----------------------------------------------------

QUESTION_STEPS = 4
"""Steps that `pose_question` reports (a count)."""
CLEAR = 3.0
"""Log evidence in the recordings, nats, from which on an effect's amplitudes are taken from
them."""
KNOWN_ROWS = 800
"""Rows of the recordings so far whose sensitivities are computed."""
MOST_FORMS = 10
"""Shapes of an effect that are looked at: those that fit best, or some of every kind."""
WEAKEST = 0.2
"""Least size of the competing effects, as a share of the plausible one, that an experiment is
planned for."""


@dataclass(frozen=True, eq=False)
class Question:
    """Competing effects on a model, and what the recordings so far say about them."""

    model: ArmModel
    """The model in question."""
    forms: list[Form]
    """The competing effects' forms."""
    owners: list[str]
    """The competing effect of each form."""
    spans: list[np.ndarray]
    """Indices of each form's sensitivities and of the arm's own weight, which is open to all."""
    draws: Draws
    """Amplitudes that may be true."""
    uncertainty: Uncertainty
    """What signals must stand out from."""
    known: Moments | None
    """Moments of the recordings so far; the last column is the own weight."""
    gains: np.ndarray | None
    """(J,) log evidence of each form in the recordings, nats."""
    misfit: np.ndarray | float
    """(E, E) misfit of the competing effects; larger where the recordings contradict the
    prediction."""

    def isolability(self, moments: Moments) -> Isolability:
        """Isolability of the competing effects from moments of sensitivities and own weight."""
        return isolability_from(moments, self.draws, self.owners, self.spans, self.misfit)


def pose_question(
    model: ArmModel,
    problem: Problem | None,
    competing: list[str] | None = None,
    progress: Progress = silent,
) -> Question:
    """The competing effects, with amplitudes from the recordings where those show them.

    Default: every known effect that changes anything on this arm. progress: called with (steps
    done, steps, note).
    """
    progress(0, QUESTION_STEPS, "sensitivities of the effects")
    reference = reference_design(model)
    facts = None if problem is None else facts_of(problem)
    forms = forms_of(model, reference, competing, facts)
    if problem is None:
        forms = _some_of_each(forms)
    sizes = Sizes.of(reference, sensitivities_on(reference, forms), forms)
    missing = [name for name in competing or [] if name not in {form.name for form in sizes.forms}]
    if missing:
        raise InputError(
            f"effect '{missing[0]}' changes nothing on this arm, so it competes with no other; "
            "leave it out"
        )
    known = gains = noise = None
    misfit: float | np.ndarray = MISFIT
    dt = PERIOD_S / 2
    draws = sizes.draws()
    if problem is None:
        uncertainty = uncertainty_of(model, noise, sizes.profile_mm, dt)
    else:
        progress(1, QUESTION_STEPS, "sensitivities on the recordings")
        dt, noise = sample_time(problem.history), problem.noise_mm
        design, residual, seen = _thinned(problem)
        sensitivities = sensitivities_on(design, sizes.forms)
        uncertainty = uncertainty_of(model, noise, sizes.profile_mm, dt)
        gram = _with(residual, seen, design, sensitivities, uncertainty).gram()
        fitted, gains = _fitted(gram, sizes)
        progress(2, QUESTION_STEPS, "fits of the effects")
        sharp = _sharp(problem, sizes, fitted, gains) if competing else []
        progress(3, QUESTION_STEPS, "what the recordings say")
        if sharp:
            sizes = Sizes.of(reference, sensitivities_on(reference, forms + sharp), forms + sharp)
            sensitivities += sensitivities_on(design, sizes.forms[len(sensitivities) :])
            gram = _with(residual, seen, design, sensitivities, uncertainty).gram()
            fitted, gains = _fitted(gram, sizes)
        best = int(np.argmax(gains))
        rms = float(np.sqrt(3.0 * np.mean((sensitivities[best] @ fitted[best]) ** 2)))
        # Once more with the size that was found, and the forms that matter.
        kept = _best_of_each(sizes, gains)
        sizes, sensitivities = sizes.select(kept), [sensitivities[j] for j in kept]
        scale = max(WEAKEST, rms / sizes.plausible_mm)
        uncertainty = uncertainty_of(model, noise, scale * sizes.profile_mm, dt)
        known = _with(residual, seen, design, sensitivities, uncertainty)
        gram = known.gram()
        fitted, gains = _fitted(gram, sizes)
        misfit = _misfit(gram, sizes, fitted, gains)
        draws = _likely(sizes.limited(sizes.draws(), sensitivities), sizes, fitted, gains)
        known = _without_last(known)
    draws = Draws(np.pad(draws.amplitudes, ((0, 1), (0, 0))), draws.form)
    weight = np.array([sizes.sensitivities])
    return Question(
        model,
        sizes.forms,
        owners_of(sizes),
        [np.concatenate([span, weight]) for span in sizes.spans],
        draws,
        uncertainty,
        known,
        gains,
        misfit,
    )


def owners_of(sizes: Sizes) -> list[str]:
    """The effect of each form."""
    return [form.name for form in sizes.forms]


def _some_of_each(forms: list[Form]) -> list[Form]:
    """At most MOST_FORMS of each effect, evenly from first to last."""
    answer = []
    for name in dict.fromkeys(form.name for form in forms):
        mine = [form for form in forms if form.name == name]
        places = np.linspace(0, len(mine) - 1, min(len(mine), MOST_FORMS))
        answer += [mine[k] for k in np.unique(places.round().astype(int))]
    return answer


def _best_of_each(sizes: Sizes, gains: np.ndarray) -> list[int]:
    """Indices of the MOST_FORMS forms of each effect that fit best, in order."""
    owners = owners_of(sizes)
    kept: list[int] = []
    for name in dict.fromkeys(owners):
        mine = [j for j, owner in enumerate(owners) if owner == name]
        kept += sorted(mine, key=lambda j: -gains[j])[:MOST_FORMS]
    return sorted(kept)


def _with(residual, seen, design: Design, sensitivities, uncertainty: Uncertainty) -> Moments:
    """Moments of the sensitivities, with the residual (S, n, 3) as the last one.

    seen: (S, n) bool, the key points that were measured; the others say nothing.
    """
    columns = [each * seen[..., None, None] for each in (*sensitivities, residual[..., None])]
    return moments_of(design, columns, uncertainty)


def _thinned(problem: Problem) -> tuple[Design, np.ndarray, np.ndarray]:
    """A problem's rows as a design, their residual (S, n, 3) in mm, and which key points (S, n)
    were measured: the residual of the others is 0.

    Rows without one of the key points that most rows have are left out, unless they are most rows:
    cameras may see one key point in one row and another in the next.
    """
    known = np.isfinite(problem.residual).all(2)
    often = known.mean(0) >= 0.5
    whole = np.flatnonzero((known | ~often).all(1))
    if len(whole) < len(known) / 2:
        seen, whole = known, np.arange(len(known))
    else:
        seen = np.broadcast_to(often, known.shape)
    residual = np.where(seen[..., None], problem.residual, 0.0)
    rows = whole[:: max(1, round(len(whole) / KNOWN_ROWS))]
    history = problem.history
    seconds = float(history.dt_s.sum()) + sample_time(history) * history.runs
    design = Design(
        problem.model,
        history,
        problem.index[torch.from_numpy(rows)],
        problem.pressure[rows],
        problem.direction[rows],
        seconds,
    )
    return design, residual[rows], seen[rows]


def _sharp(problem: Problem, sizes: Sizes, fitted: list[np.ndarray], gains) -> list[Form]:
    """Each competing effect's best form fitted through the whole chain to the recordings, where it
    can be."""
    owners, answer = owners_of(sizes), []
    for name in dict.fromkeys(owners):
        mine = [j for j, owner in enumerate(owners) if owner == name and not sizes.forms[j].more]
        best = max(mine, key=lambda j: gains[j], default=None)
        if best is None or gains[best] < CLEAR:
            continue
        effect, first = copy.deepcopy(sizes.forms[best].effect), 0
        for parameter in effect.amplitudes().values():
            part = torch.from_numpy(fitted[best][first : first + parameter.numel()])
            parameter.data.copy_(part.view_as(parameter))
            first += parameter.numel()
        model = with_fitted(problem, name, effect)
        if model is not None:
            found = model.effects[name].requires_grad_(False)
            answer.append(Form(name, found, fitted=True))
    return answer


def _spread(sizes: Sizes) -> np.ndarray:
    """(K,) plausible spread of each amplitude."""
    answer = np.empty(sizes.sensitivities)
    for span, gram in zip(sizes.spans, sizes.gram_mm2, strict=True):
        unit = np.sqrt(np.maximum(np.diag(gram), 1e-30))
        answer[span] = 2.0 * sizes.plausible_mm / unit
    return answer


def _fitted(gram: np.ndarray, sizes: Sizes) -> tuple[list[np.ndarray], np.ndarray]:
    """Amplitudes of each form that explain the last column best, and their log evidence (J,)."""
    amplitudes, gains, spread = [], [], _spread(sizes)
    for span in sizes.spans:
        scaled = gram[np.ix_(span, span)] * spread[span][:, None] * spread[span][None]
        pull = gram[span, -1] * spread[span]
        inner = np.eye(len(span)) + scaled
        amplitude = np.linalg.solve(inner, pull)
        amplitudes.append(amplitude * spread[span])
        gains.append(0.5 * pull @ amplitude - 0.5 * np.linalg.slogdet(inner)[1])
    return amplitudes, np.array(gains)


def _likely(draws: Draws, sizes: Sizes, fitted, gains) -> Draws:
    """Each competing effect's best-fitting form with its amplitudes where it is clear, else
    plausible ones."""
    owners = owners_of(sizes)
    amplitudes: list[np.ndarray] = []
    form: list[np.ndarray] = []
    for name in dict.fromkeys(owners):
        mine = [j for j, owner in enumerate(owners) if owner == name]
        best = max(mine, key=lambda j: gains[j])
        if gains[best] >= CLEAR:
            full = np.zeros(len(draws.amplitudes))
            full[sizes.spans[best]] = fitted[best]
            amplitudes.append(full[:, None])
            form.append(np.array([best]))
        else:
            chosen = np.isin(draws.form, mine)
            amplitudes.append(draws.amplitudes[:, chosen])
            form.append(draws.form[chosen])
    return Draws(np.concatenate(amplitudes, axis=1), np.concatenate(form).astype(int))


def _misfit(gram: np.ndarray, sizes: Sizes, fitted, gains) -> np.ndarray:
    """(E, E) misfit that the recordings show: how far two competing effects' fits differ from the
    prediction.

    With the better fitting competing effect true, its signal s and what the other cannot imitate u
    of it, the other should leave |u|^2 + 2 u e more, with e the misfit of the better one.
    """
    owner = np.array(owners_of(sizes))
    names = list(dict.fromkeys(owner))
    best = [max(np.flatnonzero(owner == n), key=lambda j: gains[j]) for n in names]
    signals = np.zeros((len(gram), len(names) + 1))
    signals[-1, -1] = 1.0
    for k, j in enumerate(best):
        signals[sizes.spans[j], k] = fitted[j]
    left = unimitated(gram, signals, sizes.spans)
    least = np.stack([left[owner == n].min(axis=0) for n in names])
    answer = np.full((len(names), len(names)), MISFIT)
    for a, b in itertools.permutations(range(len(names)), 2):
        if gains[best[a]] >= max(gains[best[b]], CLEAR) and least[b, a] > 0:
            whole = signals[:, a] @ gram @ signals[:, a]
            gap = least[b, -1] - least[a, -1] - least[b, a]
            error = min(gap, 0.0) ** 2 / (4.0 * least[b, a] * whole)
            answer[a, b] = answer[b, a] = max(MISFIT, error)
    return answer


def _without_last(moments: Moments) -> Moments:
    """The last column made that of the own weight, which does nothing on this bench."""
    plain, cross = moments.plain.copy(), moments.cross.copy()
    plain[:, -1], plain[:, :, -1], cross[..., -1] = 0.0, 0.0, 0.0
    return replace(moments, plain=plain, cross=cross)


# Plans --------------------------------------------------------------------------------------------

LEAST_RUNS = 2
"""Fewest runs of an experiment: one more than a single mishap spoils."""
TARGET = 0.99
"""Expected chance for every pair at which no further run is added."""
RUN_ROWS = 160
"""Rows of a planned run whose sensitivities are computed."""
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
    question: Question,
    limits: np.ndarray,
    minutes: float,
    settings: tuple[str, ...],
    progress: Progress = silent,
) -> list[Plan]:
    """The best runs on the bench as it stands and in every setting that touches a competing
    effect.

    progress: called with (settings done, settings, note).
    """
    progress(0, 1, "predicted experiments")
    model = question.model
    runs = [draw_run(name, limits, 0) for name in SIGNALS]
    design = design_of(model, planned_history(model, runs), RUN_ROWS * len(runs))
    run = design.history.run_of_row[design.index].numpy()
    own = sensitivities_on(design, question.forms)
    answer = []
    names = list(dict.fromkeys([AS_IT_STANDS, *settings]))
    for done, name in enumerate(names, 1):
        progress(done, len(names) + 1, f"experiments: {name}")
        setting = SETUPS[name]
        if bench_minutes(LEAST_RUNS) > minutes - setting.minutes + 1e-9:
            continue
        sensitivities = own if name == AS_IT_STANDS else _changed(question, design, own, setting)
        if sensitivities is None:
            continue
        weight, worth = _own_weight(question, design, setting)
        stacked = np.concatenate([*sensitivities, weight], axis=3)
        parts = {
            figure: Moments.of(
                stacked[run == k],
                design.pressure[run == k],
                design.direction[run == k],
                question.uncertainty,
                worth * RUN_S,
            )
            for k, figure in enumerate(SIGNALS)
        }
        answer.append(_greedy(question, name, parts, minutes - setting.minutes))
    return answer


def _changed(question: Question, design: Design, own, setting: Setup):
    """The sensitivities in another setting; None where no competing effect changes or it cannot be
    computed."""
    gravity = question.model.facts.gravity
    if setting.moves_weight and gravity is None:
        return None
    facts = replace(question.model.facts, gravity=setting.gravity(gravity))
    removed = setting.removes
    absent = [j for j, form in enumerate(question.forms) if form.name in removed]
    other = [
        j
        for j, form in enumerate(question.forms)
        if setting.moves_weight
        and not form.more
        and _differs(form.effect, under(form.effect, facts))
    ]
    if not absent and not other:
        return None
    answer = list(own)
    fresh = sensitivities_on(design, [question.forms[j] for j in other], facts) if other else []
    for j, sensitivities in zip(other, fresh, strict=True):
        answer[j] = sensitivities
    for j in absent:
        answer[j] = np.zeros_like(own[j])
    return answer


def _differs(effect: Effect, other: Effect) -> bool:
    """Whether anything that an effect was given by its arm is another."""
    theirs = dict(other.named_buffers())
    return any(not torch.equal(value, theirs[name]) for name, value in effect.named_buffers())


def _own_weight(question: Question, design: Design, setting: Setup) -> tuple[np.ndarray, float]:
    """(S, n, 3, 1) how the arm moves, mm, because its own weight or a known mass pulls otherwise.

    How far nobody knows, so every competing effect may use it. And what a row is then worth, 0 to
    1: what the beam's formula misses of that motion hides the competing effects.
    """
    model = question.model
    was = model.facts.gravity
    if was is None or not setting.moves_weight:
        return np.zeros((len(design.index), model.spec.key_points, 3, 1), np.float32), 1.0
    turned = np.asarray(setting.gravity(was))
    pull = np.asarray(was) if setting.payload_g else turned - was
    name = gravity_load()
    x, y, z = pull.tolist()
    load = make_effect(name, replace(model.facts, gravity=(x, y, z)))
    known = hypothesis_of(load)
    amplitude = known.tip_mass if setting.payload_g else known.own_weight
    column = list(load.amplitudes()).index(amplitude)
    motion = sensitivities_on(design, [Form(name, load)])[0][..., column : column + 1]
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
    base = SETUPS[setting].minutes
    chosen: list[str] = []
    new: Moments | None = None
    plan: Plan | None = None
    while bench_minutes(len(chosen) + 1) <= minutes + 1e-9:
        best: tuple[float, str, Moments, Isolability] | None = None
        for figure, part in parts.items():
            alone = part if new is None else new + part
            total = alone if question.known is None else question.known + alone
            result = question.isolability(total)
            score = _score(result)
            if question.known is not None:
                score += _score(question.isolability(alone))
            if best is None or score > best[0]:
                best = (score, figure, alone, result)
        assert best is not None, "there is a schedule to choose"
        score, figure, new, result = best
        chosen.append(figure)
        spent = base + bench_minutes(len(chosen))
        plan = Plan(setting, tuple(chosen), spent, score, result)
        if len(chosen) >= LEAST_RUNS and plan.worst >= TARGET:
            break
    assert plan is not None, "the time suffices for one run"
    return plan


def _score(result: Isolability) -> float:
    """Expected log probability of the truth, over all ordered pairs."""
    off = ~np.eye(len(result.names), dtype=bool)
    return float(log_ndtr(result.distance[off]).sum())


# Recommendation ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Experiment:
    """The recommended experiment in short."""

    name: str
    """Its name."""
    minutes: float
    """Time on the bench, minutes."""
    separates: tuple[tuple[str, str], ...]
    """Pairs of effects that it tells apart."""

    @property
    def in_words(self) -> str:
        """What it distinguishes."""
        if not self.separates:
            return (
                "is the best of those that were tried, but is not sure to distinguish any two of "
                "the competing effects"
            )
        return "distinguishes " + ", ".join(" from ".join(pair) for pair in self.separates)


MINUTES = 15.0
"""Longest time on the bench where none is asked for, minutes."""


@dataclass(frozen=True)
class Pair:
    """Two competing effects and the expected chance to name the right one, whichever it is."""

    effects: tuple[str, str]
    """Their names."""
    before: float
    """With the recordings so far, 0.5 to 1."""
    after: float
    """With the experiment too."""


TOLD_APART = (
    "what is recorded should tell them apart already: where 'surgisoft diagnose' cannot, both may "
    "be missing, or another effect, and 'surgisoft improve' adds what lowers the error"
)
"""What is said where no experiment is needed to tell two effects apart."""


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The recommended experiment, and how well it distinguishes the competing effects."""

    name: str
    """Its name: the excitation signals and the experimental setup."""
    protocol: Protocol
    """The schedule, ready for the rig."""
    setting: str
    """Name of the experimental setup."""
    minutes: float
    """Time on the bench, rests and changes included, minutes."""
    pairs: tuple[Pair, ...]
    """Every pair of competing effects."""
    steps: tuple[str, ...]
    """What to do, in words."""
    rig_options: Mapping[str, float | tuple[float, float, float]] = field(default_factory=dict)
    """Options of `surgisoft.collect` for the experimental setup on the virtual rig: `collect(file,
    **found.rig_options)` with the file of the schedule, or `protocol`, does what `next-experiment
    --record` does. Empty where nothing is to be changed, and where the rig has no such option."""
    isolability: Isolability | None = field(default=None, repr=False)
    """What the recordings and the experiment together say about the competing effects."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit; how
    recordings from before were compared."""
    validated_mm: float | None = None
    """Validated error of the model, of which the chances allow for `ROOM` times, mm; None where it
    has none, and `UNVALIDATED_SHARE` of the arm's length takes its place."""
    paired: bool = False
    """Whether the recordings so far count as paired differences to those from before."""

    @property
    def separates(self) -> tuple[tuple[str, str], ...]:
        """The pairs that it is expected to tell apart."""
        return tuple(pair.effects for pair in self.pairs if pair.after >= SURE)

    @property
    def options(self) -> str:
        """The options of `surgisoft collect` for the experimental setup on the virtual rig."""
        return " ".join(
            f"--{name.replace('_', '-')} "
            + (f"{value:g}" if isinstance(value, float) else " ".join(f"{v:.4f}" for v in value))
            for name, value in self.rig_options.items()
        )

    @property
    def by_hand(self) -> bool:
        """Whether it takes an experimental setup that the virtual rig has no option for."""
        return bool(self.removes)

    @property
    def removes(self) -> tuple[str, ...]:
        """Effects that cannot be there any more once the bench is changed."""
        return SETUPS[self.setting].removes

    @property
    def experiment(self) -> Experiment:
        """In short, as a diagnosis names it."""
        return Experiment(self.name, self.minutes, self.separates)

    @property
    def why(self) -> str:
        """One sentence."""
        worst = min(self.pairs, key=lambda pair: pair.before)
        a, b = worst.effects
        many = f"; {len(self.separates)} of {len(self.pairs)} pairs are distinguished by it"
        return (
            f"the chance to tell {a} from {b} goes from {worst.before:.2f} to {worst.after:.2f}"
            + (many if len(self.pairs) > 1 else "")
            + (f"; {TOLD_APART}" if worst.before >= SURE else "")
        )

    @property
    def chances_in_words(self) -> str:
        """What the chances of the pairs stand for."""
        error = f"{ROOM:g} times the validated error of the model"
        if self.validated_mm is None:
            share = 100.0 * UNVALIDATED_SHARE
            error = f"{ROOM:g} times an error of the model of {share:g} % of its length"
        else:
            error += f" ({self.validated_mm:.2g} mm)"
        return (
            "a chance is the probability of naming the right one of the two if only that one is "
            "missing and is as large as expected; it allows for the noise of the cameras, "
            f"{error} and the misfit of the effects themselves, but not for other causes: "
            "'surgisoft diagnose' weighs those too, so it may answer cannot_tell or name a set "
            "even where the chance is near 1"
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
            "chances_in_words": self.chances_in_words,
            "notes": list(self.notes),
        }


@torch_threads(1)
def next_experiment(
    model: Model,
    recordings: Recordings = (),
    between: Sequence[str] | None = None,
    minutes: float = MINUTES,
    settings: tuple[str, ...] = tuple(SETUPS),
    reference: Sequence[Recording] | TrainingResiduals | None = None,
    predictions: Iterable[str | Path] | None = None,
    error_mm: float | None = None,
    progress: Progress = silent,
    before: Recordings | None = None,
    paired: Paired = "auto",
) -> Recommendation:
    """The experiment that best distinguishes competing effects (Box & Hill 1967).

    Returns a schedule for the rig (times in s, pressures in the model's unit), the changes of the
    experimental setup that go before it, and the probability with which it tells each pair of
    effects apart. Raises InputError where fewer than two effects compete, or the time is too short.

    Model and recordings may be given by their paths; a model of other origin as for `compare`.
    The recordings are looked at as `diagnose` does: the training part, the
    direction of gravity, the residuals of the model's fit.

    between: the competing effects; without them those that explain the recordings best, and
    without recordings all known ones.
    settings: names of the experimental setups that may be asked for.
    reference: as for `diagnose`. progress: called with (done, total, note). before: recordings
    from before a change: what the arm did there as well is no part of the question; paired: as for
    `diagnose`. Raises InputError where the model does not describe BEFORE.
    """
    given = given_recordings(recordings)
    if not given:
        if is_predictions_file(model) or predictions is not None:
            raise InputError(
                "predictions are given without recordings; expected the recordings that they were "
                "made for"
            )
        if before is not None:
            raise InputError(
                "recordings from before a change are given without those after it; expected both"
            )
        if callable(model) and not isinstance(model, ArmModel):
            model = arm_by_itself(given_callable(model))
        return propose(load_model(model), between, minutes, settings, progress)
    arm, measured, earlier = open_model(model, given, before, predictions, error_mm)
    arm, measured, notes = open_inputs(arm, measured, compared=earlier is not None)
    both = None
    if earlier is None:
        problem = identification_problem(arm, measured, reference)
    else:
        both = since_before(arm, measured, earlier, paired)
        problem, notes = both.training(), (*notes, *both.notes)
    stages = Stages(progress, 1.0)
    if not between:
        between = likely_competing(problem, progress=stages.stage(1 / 3, "likely effects"))
    rest = stages.stage(1.0 - stages.done, "experiments")
    found = recommend(problem, between, minutes, settings, rest)
    return replace(found, notes=notes, paired=both is not None and both.used)


def since_before(
    model: ArmModel, after: list[Recording], before: Recordings, paired: Paired
) -> BeforeAfter:
    """Training rows of recordings after a change, compared with those from before as `diagnose`
    does. Raises InputError where the model does not describe BEFORE."""
    earlier = load_recordings(before)
    refuse_amended(model, after, earlier)
    table = residual_table(model, Sealed(after).training)
    both = before_and_after(table, earlier, paired)
    if both.strange is not None:
        raise InputError(both.strange_in_words)
    return both


def recommend(
    problem: Problem,
    competing: Sequence[str],
    minutes: float = MINUTES,
    settings: tuple[str, ...] = tuple(SETUPS),
    progress: Progress = silent,
) -> Recommendation:
    """The experiment that best tells the competing effects apart, given a problem's recordings.

    settings: names of the experimental setups that may be asked for. progress: called with (done,
    total, note).
    """
    return _recommend(problem.model, problem, list(competing), minutes, settings, progress)


def propose(
    model: ArmModel,
    competing: Sequence[str] | None = None,
    minutes: float = MINUTES,
    settings: tuple[str, ...] = tuple(SETUPS),
    progress: Progress = silent,
) -> Recommendation:
    """The experiment that best tells the competing effects (default: all known effects) apart,
    before anything was recorded. progress: called with (done, total, note)."""
    names = None if competing is None else list(competing)
    return _recommend(model, None, names, minutes, settings, progress)


def likely_competing(problem: Problem, most: int = 4, progress: Progress = silent) -> list[str]:
    """The effects that explain the residual of a problem best: those that one could confuse.

    The best one, and up to `most` in all whose log evidence is at least half of its own; the two
    best where that is one alone.
    """
    question = pose_question(problem.model, problem, progress=progress)
    gains = question.gains
    assert gains is not None, "a question about recordings has gains"
    best: dict[str, float] = {}
    for owner, gain in zip(question.owners, gains, strict=True):
        best[owner] = max(best.get(owner, -np.inf), gain)
    order = sorted(best, key=lambda name: -best[name])
    near = [name for name in order if best[name] >= 0.5 * best[order[0]]]
    return order[:2] if len(near) < 2 else near[:most]


def _recommend(model, problem, competing, minutes, settings, progress) -> Recommendation:
    competing = None if competing is None else list(dict.fromkeys(competing))
    _check(model, competing, minutes)
    stages = Stages(progress, 2.0)
    question = pose_question(model, problem, competing, stages.stage(1.0, "effects"))
    limits = _limits(model, problem)
    for name in settings:
        if name not in SETUPS:
            raise unknown_name("experimental setup", name, SETUPS)
    plans = make_plans(question, limits, minutes, settings, stages.stage(1.0, "plans"))
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


def _check(model: ArmModel, competing: list[str] | None, minutes: float) -> None:
    for name in competing or []:
        if name not in known_effects():
            make_effect(name, model.facts)
    if competing is not None and len(competing) < 2:
        raise InputError(
            f"effects {', '.join(competing) or 'none'}: expected at least two different effects; "
            "name them with --between A B"
        )
    if not minutes >= bench_minutes(LEAST_RUNS):
        raise InputError(
            f"--minutes {minutes:g}: too short for {LEAST_RUNS} runs with their rests, expected at "
            f"least {bench_minutes(LEAST_RUNS):g}"
        )


def _worded(question: Question, plan: Plan, limits: np.ndarray) -> Recommendation:
    """A plan as something that a person can do."""
    setting = SETUPS[plan.setting]
    seeds = [plan.figures[:k].count(figure) for k, figure in enumerate(plan.figures)]
    figures = list(zip(plan.figures, seeds, strict=True))
    names = "+".join(dict.fromkeys(plan.figures))
    name = names if plan.setting == AS_IT_STANDS else f"{plan.setting}: {names}"
    protocol = schedule("next_experiment", figures, limits, question.model.spec.unit)
    before = None if question.known is None else question.isolability(question.known)
    pairs = tuple(
        Pair((a, b), 0.5 if before is None else before.pair(a, b), plan.result.pair(a, b))
        for a, b in pairs_of(plan.result.names)
    )
    options = setting.rig_options(question.model.facts.gravity)
    words = asdict(words_for(question.model.spec.unit))
    what = "; ".join(
        f"{plan.figures.count(f)} x {SIGNALS[f].about.format(**words)}"
        for f in dict.fromkeys(plan.figures)
    )
    about = setting.about.format(**words)
    validation = question.model.validation
    steps = [f"{about} (about {setting.minutes:g} min)"] if about else []
    steps += [
        f"if the error is gone then, the missing effect is {name}; if it stays, it is not"
        for name in setting.removes
    ]
    steps.append(
        f"run the schedule: {len(figures)} runs of {RUN_S / 60:g} min ({what}), each from a "
        f"{words['resting']} that has rested half a minute"
    )
    return Recommendation(
        name,
        protocol,
        plan.setting,
        plan.minutes,
        pairs,
        tuple(steps),
        options,
        plan.result,
        validated_mm=validation.rmse_mm if validation.per_key_point_mm else None,
    )
