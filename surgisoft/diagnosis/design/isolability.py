"""Isolability: which effects can be told apart, from the schedule of actuations alone.

Each effect's change of the key points is computed on the schedule, at a plausible amplitude,
through the model in question; nothing measured is needed. What another effect, with any of its
nonlinear parameters, and the model discrepancy cannot imitate of it is the evidence that the
schedule can give.

Everything that can be said about telling effects apart follows from products of their sensitivities
under the covariance

    Sigma = noise + form + discrepancy,

where `form` is what an effect's own formula leaves of its signal: a part that changes over FORM_S,
and one that depends on the actuation alone. The latter and the discrepancy are the Gaussian process
of `discrepancy`, here through inducing points (Quinonero-Candela & Rasmussen 2005, sec. 4): it is
the same error in every experiment that visits the same actuation, so its features are kept beside
the sensitivities and taken out only at the end. Products add up over experiments.
"""

import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy import linalg
from scipy.special import ndtr
from torch import Tensor

from surgisoft.diagnosis.candidates import Signals, more_of, sensitivities_of, signals
from surgisoft.diagnosis.cross_validation import INDUCING
from surgisoft.diagnosis.design.schedules import REFERENCE, draw_run, limits_within
from surgisoft.diagnosis.discrepancy import body_covariance, kernel
from surgisoft.diagnosis.residuals import noise_of
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.arm import centre_and_half
from surgisoft.surrogate.effects import ArmFacts, Effect, hypothesis_of, known_effects, make_effect
from surgisoft.surrogate.history import History, pack
from surgisoft.surrogate.model import ArmModel

# Products of sensitivities ----------------------------------------------------------------------

FORM_SHARE = 0.1
"""Share of an effect's mean square that its own formula misses."""
FORM_S = 20.0
"""Time over which what it misses stays alike, s: the blocks of time that a diagnosis holds out."""
ROOM = 2.0
"""Factor on the validated error that is allowed for."""
UNVALIDATED_SHARE = 0.05
"""Error of a key point that takes its place where a model has none, as a share of its length."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Noise and model discrepancy from which an effect's signal must stand out."""

    noise_mm: np.ndarray
    """(n,) RMS noise of each key point's distance, mm."""
    discrepancy_mm: np.ndarray
    """(n,) RMS validated error of each key point's distance, mm."""
    signal_mm: np.ndarray
    """(n,) RMS size of the effects in question at each key point, mm."""
    dt_s: float
    """Time between two samples, s."""
    inducing: tuple[np.ndarray, np.ndarray]
    """(F, m) actuations scaled to [-1, 1] and (F, m) directions that carry the surrogate's
    error."""

    @property
    def density(self) -> np.ndarray:
        """(n,) variance of one coordinate times the time for which it is alike, mm^2 s."""
        form = FORM_SHARE * self.signal_mm**2 * max(FORM_S, self.dt_s)
        return np.maximum((self.noise_mm**2 * self.dt_s + form) / 3.0, 1e-12)

    @cached_property
    def _root(self) -> np.ndarray:
        x, d = self.inducing
        values, vectors = linalg.eigh(kernel(x, d, x, d))
        kept = values > 1e-6 * values.max()
        return vectors[:, kept] / np.sqrt(values[kept])

    def features(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        """(S, F') features of the model discrepancy at actuations and directions (S, m)."""
        return kernel(x, d, *self.inducing) @ self._root

    @cached_property
    def outputs(self) -> tuple[np.ndarray, np.ndarray]:
        """(n, n) key points to independent outputs of unit density, (n,) discrepancy's
        variances."""
        static = (ROOM * self.discrepancy_mm) ** 2 + FORM_SHARE * self.signal_mm**2
        ratio, mix = linalg.eigh(body_covariance(np.sqrt(static)), np.diag(self.density))
        return mix.T, np.maximum(ratio, 1e-9 * max(ratio.max(), 1e-12))


def inducing_points(chambers: int, number: int = INDUCING, seed: int = 0):
    """Actuations (F, m) over [-1, 1] and directions (F, m) of -1 or 1, spread evenly.

    A Kronecker sequence on the golden ratio of m dimensions (Roberts 2018).
    """
    ratio = 1.5
    for _ in range(64):
        ratio = (1.0 + ratio) ** (1.0 / (chambers + 1))
    steps = ratio ** -np.arange(1.0, chambers + 1)
    x = 2.0 * ((0.5 + np.arange(1, number + 1)[:, None] * steps) % 1.0) - 1.0
    d = np.random.default_rng(seed).choice([-1.0, 1.0], size=x.shape)
    return x, d


def sample_time(history: History) -> float:
    """Median time between samples of a history, s; settled points lie seconds apart."""
    gaps = history.dt_s[history.dt_s > 0]
    return float(gaps.median()) if len(gaps) else 1.0


@dataclass(frozen=True, eq=False)
class Moments:
    """Products of K sensitivities and F features over the rows of one or more experiments."""

    plain: np.ndarray
    """(n, K, K) products of the sensitivities, in each independent output."""
    cross: np.ndarray
    """(3, n, F, K) products of features and sensitivities, in each coordinate and output."""
    own: np.ndarray
    """(F, F) products of the features."""
    ratio: np.ndarray
    """(n,) variance of the model discrepancy in each output, in units of its density."""
    seconds: float
    """Time that the rows stand for, s."""

    @classmethod
    def of(
        cls,
        sensitivities: np.ndarray,
        x: np.ndarray,
        d: np.ndarray,
        uncertainty: Uncertainty,
        seconds: float,
    ) -> "Moments":
        """Of sensitivities (S, n, 3, K) in mm at actuations x and directions d (S, m).

        seconds: time that all the rows stand for, s.
        """
        rows, points, _, count = sensitivities.shape
        weight = np.float32(np.sqrt(seconds / rows))
        mix, ratio = uncertainty.outputs
        flat = np.ascontiguousarray(sensitivities.transpose(1, 2, 0, 3), np.float32)
        mixed = weight * (mix.astype(np.float32) @ flat.reshape(points, -1))
        mixed = mixed.reshape(points, 3, rows, count)
        features = weight * uncertainty.features(x, d).astype(np.float32)
        # In double precision, or it is not positive definite beside a large model discrepancy.
        exact = features.astype(float)
        plain = np.stack([sum(c.T @ c for c in output) for output in mixed])
        cross = np.stack([[features.T @ output[axis] for output in mixed] for axis in range(3)])
        return cls(
            plain.astype(float),
            cross.astype(float),
            exact.T @ exact,
            ratio,
            seconds,
        )

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(
            self.plain + other.plain,
            self.cross + other.cross,
            self.own + other.own,
            self.ratio,
            self.seconds + other.seconds,
        )

    def gram(self) -> np.ndarray:
        """(K, K) products of the sensitivities under Sigma: the model discrepancy is taken out."""
        # One rotation of the features serves the normal matrices of all outputs.
        values, vectors = linalg.eigh(self.own, check_finite=False)
        weight = np.sqrt(1.0 / (np.maximum(values, 0.0) + 1.0 / self.ratio[:, None]))
        turned = weight[..., None] * (vectors.T @ self.cross)
        turned = turned.reshape(-1, turned.shape[-1])
        answer = self.plain.sum(0) - turned.T @ turned
        return 0.5 * (answer + answer.T)


def unimitated(gram: np.ndarray, signals: np.ndarray, forms: list[np.ndarray]) -> np.ndarray:
    """(J, D) squared length under Sigma of what no mixture of a form's sensitivities can imitate.

    gram: (K, K); signals: (K, D) amplitudes of D signals; forms: the indices of the J forms'
    sensitivities. Half of it is the expected log likelihood ratio of two Gaussian models (Hunter &
    Reiner 1965, eq. 3).
    """
    seen = gram @ signals
    whole = np.einsum("kd,kd->d", signals, seen)
    size = np.sqrt(np.maximum(np.diag(gram), 1e-30))
    answer = np.empty((len(forms), signals.shape[1]))
    for j, form in enumerate(forms):
        scaled = gram[np.ix_(form, form)] / size[form][:, None] / size[form][None]
        values, vectors = linalg.eigh(scaled, check_finite=False)
        kept = values > 1e-5 * max(values.max(), 1e-12)
        turned = (vectors[:, kept] / np.sqrt(values[kept])).T @ (seen[form] / size[form][:, None])
        answer[j] = whole - (turned**2).sum(0)
    return np.clip(answer, 0.0, np.maximum(whole, 0.0))


# Effects on schedules ---------------------------------------------------------------------------

ROWS = 800
"""Rows of a schedule whose sensitivities are computed; memories follow every row."""
PERIOD_S = 0.1
"""Time between the rows of a planned schedule, s."""
SHAPE_STEP = 0.02
"""Step of a slope by a nonlinear parameter, in units of max(1, the value)."""


@dataclass(frozen=True, eq=False)
class Design:
    """A model on a schedule of actuations, thinned to S rows; nothing is measured."""

    model: ArmModel
    """The model in question."""
    history: History
    """All runs, every row; the key points are void."""
    index: Tensor
    """(S,) the looked-at rows among all rows of the runs one after the other."""
    pressure: np.ndarray
    """(S, m) actuation scaled to [-1, 1] over the model's range."""
    direction: np.ndarray
    """(S, m) directions of change."""
    seconds: float
    """Time that the rows stand for, s."""

    @property
    def taps(self) -> None:
        """No scan of the history was made before."""

    def rows(self, tensor: Tensor) -> Tensor:
        """The looked-at rows of a (R, T, ...) tensor."""
        return self.history.rows(tensor)[self.index]

    @cached_property
    def signals(self) -> Signals:
        """Signals at the stages of the model along the history."""
        return signals(self)


@dataclass(frozen=True, eq=False)
class Form:
    """One effect with one choice of its nonlinear parameters."""

    name: str
    """The effect's name."""
    effect: Effect
    """The effect, at zero amplitude."""
    more: bool = False
    """Whether it is the one that the model has already, stronger or weaker."""
    fitted: bool = False
    """Whether it was fitted to recordings; then its nonlinear parameters are uncertain too."""


def forms_of(
    model: ArmModel,
    reference: Design,
    names: list[str] | None = None,
    facts: ArmFacts | None = None,
) -> list[Form]:
    """Every form of the named effects (default: all known) that a diagnosis tries on a model.

    facts: those of the arm as it was recorded, where they are not the model's own.
    """
    known = known_effects()
    names = list(known) if names is None else list(names)
    facts = model.facts if facts is None else facts
    points = reference.rows(reference.signals.body)
    answer = []
    for name in names:
        kind = known[name] if name in known else type(make_effect(name, facts))
        if name in model.effects:
            answer.append(Form(name, model.effects[name], True))
        answer += [Form(name, effect) for effect in hypothesis_of(kind).candidates(facts, points)]
    return answer


@torch.no_grad()
def sensitivities_on(
    design: Design, forms: list[Form], facts: ArmFacts | None = None
) -> list[np.ndarray]:
    """(S, n, 3, K_j) change of the key points, mm, with each amplitude of each form.

    Of a fitted one with each nonlinear parameter too, at the amplitudes that it has.

    facts: those of the arm as it stands in the experiment, where they are not the model's own.
    """
    signal = design.signals
    points = design.model.spec.key_points
    answer = []
    for form in forms:
        if form.more:
            found = more_of(design, signal, form.name)
            empty = np.zeros((len(design.index), points, 3, 1), np.float32)
            answer.append(empty if found is None else found.sensitivities)
        else:
            effect = form.effect if facts is None else under(form.effect, facts)
            sensitivities = sensitivities_of(design, signal, effect)
            if form.fitted:
                moved = _slopes(design, signal, effect, sensitivities)
                sensitivities = np.concatenate([sensitivities, moved], axis=3)
            answer.append(sensitivities)
    return answer


def _slopes(
    design: Design, signal: Signals, effect: Effect, sensitivities: np.ndarray
) -> np.ndarray:
    """(S, n, 3, P) change of the key points, mm, with each value of a fitted effect's form.

    sensitivities: (S, n, 3, K) change with each of its amplitudes.
    """
    amplitudes = torch.cat([p.flatten() for p in effect.amplitudes().values()]).numpy()
    now, answer = sensitivities @ amplitudes, []
    for name, parameter in effect.nonlinear_parameters().items():
        for i, value in enumerate(parameter.flatten().tolist()):
            other = copy.deepcopy(effect)
            step = SHAPE_STEP * max(1.0, abs(value))
            other.get_parameter(name).view(-1)[i] += step
            answer.append((sensitivities_of(design, signal, other) @ amplitudes - now) / step)
    return np.stack(answer, axis=3) if answer else sensitivities[..., :0]


def under(effect: Effect, facts: ArmFacts) -> Effect:
    """An effect with equal parameters on an arm in another experimental setup."""
    answer = type(effect)(facts, **effect.config())
    answer.load_state_dict(effect.state_dict())
    return answer


def design_of(model: ArmModel, history: History, rows: int = ROWS) -> Design:
    """A model on the actuations of a history, thinned to about `rows` rows."""
    with torch.no_grad():
        direction = history.rows(model.trace(history).direction)
    total = int(history.valid.sum())
    index = torch.arange(0, total, max(1, round(total / rows)))
    centre, half = (x.numpy() for x in centre_and_half(model.facts.low, model.facts.high))
    pressure = history.rows(history.pressure).double().numpy()[index]
    return Design(
        model,
        history,
        index,
        (pressure - centre) / half,
        direction.double().numpy()[index],
        float(history.dt_s.sum()) + sample_time(history) * history.runs,
    )


def reference_design(model: ArmModel, seconds: float = 40.0, rows: int = 400) -> Design:
    """The varied schedule on which plausible sizes are stated: some of every kind of motion."""
    limits = limits_within(model.spec.low, model.spec.high)
    runs = [draw_run(name, limits, 0, seconds) for name in REFERENCE]
    return design_of(model, planned_history(model, runs), rows)


def planned_history(
    model: ArmModel, runs: list[tuple[np.ndarray, np.ndarray]], period_s: float = PERIOD_S
) -> History:
    """Runs of knot times (T,) [s] and actuations (T, m) as if they had been played exactly."""
    times, rows, start = [], [], 0.0
    for knots, commands in runs:
        t = np.arange(0.0, knots[-1] - knots[0] + 0.5 * period_s, period_s)
        sensitivities = [np.interp(t, knots - knots[0], column) for column in commands.T]
        times.append(torch.from_numpy(start + t))
        rows.append(torch.from_numpy(np.stack(sensitivities, axis=1)))
        start += t[-1] + period_s
    void = [torch.full((len(t), model.spec.key_points, 3), torch.nan) for t in times]
    return pack(times, rows, void)


def history_of_protocol(model: ArmModel, protocol: Protocol) -> History:
    """A protocol as a history: every run played exactly, from an arm at rest."""
    runs = []
    for _, rows in protocol.run_rows:
        if protocol.kind == "settled":
            step = protocol.settle_s + protocol.average_s
            runs.append((step * np.arange(len(protocol.commands[rows])), protocol.commands[rows]))
        else:
            assert protocol.t_s is not None, "continuous protocols have times"
            runs.append((protocol.t_s[rows], protocol.commands[rows]))
    period = PERIOD_S if protocol.kind == "continuous" else protocol.settle_s + protocol.average_s
    return planned_history(model, runs, period)


def length_of(model: ArmModel) -> float:
    """Length of the arm at rest, mm: stated, or from its key points."""
    if model.spec.length_mm:
        return float(model.spec.length_mm)
    rest = model.rest_mm.double().cpu().numpy()
    return max(float(np.linalg.norm(rest[-1])), 1.0)


# Isolability ------------------------------------------------------------------------------------

PLAUSIBLE_SHARE = 0.0075
"""Plausible size of an effect: RMS change of a key point on the varied reference schedule, as a
share of the arm's length."""
DRAWS = 6
"""Random amplitude vectors for each form of an effect with more than one amplitude."""
CAMERA_SHARE = 0.001
"""RMS noise of a key point where nothing was measured yet, as a share of the arm's length."""
LARGEST = 2.0
"""Factor on its plausible size to which an effect may grow on another schedule: one that goes on
growing with time or load would have been noticed."""
MISFIT = 0.02
"""Mean square of an effect's own misfit along any one direction, as a share of its signal's: more
data do not lessen it. On simulated arms whose truth has other formulas it was 0.002 over all pairs
of effects, 0.012 over those of which one can imitate half of the other or more."""
SURE = 0.95
"""Expected chance of naming the right one of two effects from which on they are told apart."""


@dataclass(frozen=True, eq=False)
class Isolability:
    """Isolability of E effects, each at a plausible amplitude, by one schedule."""

    names: tuple[str, ...]
    """The effects."""
    detectable: np.ndarray
    """(E,) expected log evidence, in nats, of each over the model discrepancy alone."""
    log_evidence: np.ndarray
    """(E, E) expected log evidence, in nats, of effect a (row), where it is true, over b (column)
    with its best form and amplitudes."""
    separability: np.ndarray
    """(E, E) share of a's signal beyond the model discrepancy that b cannot imitate, 0 to 1."""
    distance: np.ndarray
    """(E, E) half the distance of a from b in standard deviations, b's misfit included."""
    confidence: np.ndarray
    """(E, E) expected chance, 0.5 to 1, to name a where it is true and b the only competing effect;
    of those of a's forms that can be seen at all."""
    seen: np.ndarray
    """(E,) share of a's forms and amplitudes that can be seen at all."""
    minutes: float
    """Length of the schedule, minutes."""

    def pair(self, a: str, b: str) -> float:
        """Expected chance to tell two effects apart, whichever of them is true: the lesser one."""
        i, j = self.names.index(a), self.names.index(b)
        return float(min(self.confidence[i, j], self.confidence[j, i]))


def isolability(
    model: ArmModel,
    schedule: list[Recording] | Protocol | History,
    names: list[str] | None = None,
    rows: int = ROWS,
    size_mm: float | None = None,
) -> Isolability:
    """Isolability of the named effects (default: all known ones) by a schedule of actuations.

    Of recordings only the actuation and the noise are looked at. size_mm: RMS change of a key
    point by an effect on the reference schedule (default: PLAUSIBLE_SHARE of the arm's length).
    """
    history, noise = _history(model, schedule)
    reference = reference_design(model)
    forms = forms_of(model, reference, names)
    size = Sizes.of(reference, sensitivities_on(reference, forms), forms, size_mm)
    design = design_of(model, history, rows)
    uncertainty = uncertainty_of(model, noise, size.profile_mm, sample_time(history))
    sensitivities = sensitivities_on(design, size.forms)
    draws = size.limited(size.draws(), sensitivities)
    owners = [form.name for form in size.forms]
    return isolability_from(
        moments_of(design, sensitivities, uncertainty), draws, owners, size.spans
    )


def isolability_from(
    moments: Moments,
    draws: "Draws",
    owners: list[str],
    spans: list[np.ndarray],
    misfit: np.ndarray | float = MISFIT,
) -> Isolability:
    """The matrices from moments of sensitivities, amplitudes that may be true, and J forms.

    owners: the effect of each form; spans: the indices of its sensitivities; misfit: as MISFIT,
    one for all or (E, E). Between two Gaussian models at distance u the right one is the likelier
    with chance Phi(u / 2); along u lies some of the true effect's own misfit too.
    """
    gram = moments.gram()
    names = tuple(dict.fromkeys(owners))
    count = len(names)
    of_form = np.array([names.index(owner) for owner in owners])
    of_draw = of_form[draws.form]
    misfit = np.broadcast_to(np.asarray(misfit, float), (count, count))
    # A competing effect takes whichever of its forms imitates best.
    rest = unimitated(gram, draws.amplitudes, spans)
    best = np.stack([rest[of_form == b].min(axis=0) for b in range(count)])
    whole = np.maximum(np.einsum("kd,kd->d", draws.amplitudes, gram @ draws.amplitudes), 0.0)
    visible = ndtr(0.5 * np.sqrt(whole)) >= SURE
    half = 0.5 * np.sqrt(best / (1.0 + misfit[of_draw].T * whole))
    evidence, share, distance = (np.zeros((count, count)) for _ in range(3))
    chance, seen, detectable = np.full((count, count), 0.5), np.zeros(count), np.zeros(count)
    for a in range(count):
        mine = of_draw == a
        seen[a] = visible[mine].mean()
        detectable[a] = 0.5 * whole[mine].mean()
        shown = mine & visible if seen[a] > 0 else mine
        evidence[a] = 0.5 * best[:, mine].mean(1)
        share[a] = best[:, mine].sum(1) / max(whole[mine].sum(), 1e-30)
        distance[a] = half[:, shown].mean(1)
        chance[a] = ndtr(half[:, shown]).mean(1)
    for table, own in ((evidence, 0.0), (share, 0.0), (distance, 0.0), (chance, 0.5)):
        np.fill_diagonal(table, own)
    minutes = moments.seconds / 60.0
    return Isolability(names, detectable, evidence, share, distance, chance, seen, minutes)


@dataclass(frozen=True, eq=False)
class Draws:
    """Amplitudes that may be true."""

    amplitudes: np.ndarray
    """(K, D) amplitudes of all sensitivities; those of other forms are zero."""
    form: np.ndarray
    """(D,) index of the form that is true."""


@dataclass(frozen=True, eq=False)
class Sizes:
    """How large the forms' sensitivities are on the reference schedule."""

    forms: list[Form]
    """The J forms that do anything there."""
    spans: list[np.ndarray]
    """Indices of each one's sensitivities among all of them."""
    gram_mm2: list[np.ndarray]
    """(K_j, K_j) mean products of each form's sensitivities over rows and key points, mm^2."""
    profile_mm: np.ndarray
    """(n,) RMS size at each key point of plausible effects, mm."""
    plausible_mm: float
    """RMS size of a plausible effect over all key points, mm."""

    @classmethod
    def of(
        cls,
        reference: Design,
        sensitivities: list[np.ndarray],
        forms: list[Form],
        size_mm: float | None = None,
    ) -> "Sizes":
        """From the forms' sensitivities (S, n, 3, K_j) on the reference schedule, mm."""
        kept = [
            j
            for j, c in enumerate(sensitivities)
            if np.isfinite(c).all() and np.abs(c).max() > 1e-9
        ]
        points = reference.model.spec.key_points
        gram, profiles, spans, at = [], [], [], 0
        plausible = size_mm or PLAUSIBLE_SHARE * length_of(reference.model)
        for j in kept:
            c = sensitivities[j].astype(float)
            rows, count = len(c), c.shape[3]
            flat = c.reshape(-1, count)
            gram.append(flat.T @ flat / (rows * points))
            unit = np.sqrt(np.maximum(np.diag(gram[-1]), 1e-30))
            profiles.append(((c / unit) ** 2).sum(2).mean(axis=(0, 2)))
            spans.append(np.arange(at, at + count))
            at += count
        profile = plausible * np.sqrt(np.mean(profiles, axis=0)) if kept else np.zeros(points)
        return cls([forms[j] for j in kept], spans, gram, profile, plausible)

    def select(self, kept: list[int]) -> "Sizes":
        """Only some of the forms; plausible sizes stay."""
        ends = np.cumsum([len(self.spans[j]) for j in kept])
        spans = [
            np.arange(end - len(self.spans[j]), end) for j, end in zip(kept, ends, strict=True)
        ]
        forms, gram = [self.forms[j] for j in kept], [self.gram_mm2[j] for j in kept]
        return replace(self, forms=forms, spans=spans, gram_mm2=gram)

    @property
    def sensitivities(self) -> int:
        """Number of all sensitivities."""
        return int(self.spans[-1][-1]) + 1 if self.spans else 0

    def draws(self, seed: int = 0) -> "Draws":
        """Amplitudes of plausible size; random mixtures where an effect has more than one."""
        rng = np.random.default_rng(seed)
        amplitudes, owner = [], []
        for j, span in enumerate(self.spans):
            unit = np.sqrt(np.maximum(np.diag(self.gram_mm2[j]), 1e-30))
            for _ in range(1 if len(span) == 1 else DRAWS):
                mixture = np.ones(1) if len(span) == 1 else rng.normal(size=len(span))
                full = np.zeros(self.sensitivities)
                full[span] = self.plausible_mm * mixture / (unit * np.sqrt(len(span)))
                amplitudes.append(full)
                owner.append(j)
        return Draws(np.array(amplitudes).reshape(len(owner), -1).T, np.array(owner, int))

    def limited(self, draws: "Draws", sensitivities: list[np.ndarray]) -> "Draws":
        """Amplitudes limited to plausible ones on sensitivities (S, n, 3, K_j)."""
        amplitudes = draws.amplitudes.copy()
        for k, j in enumerate(draws.form):
            field = sensitivities[j] @ amplitudes[self.spans[j], k]
            rms = np.sqrt(np.mean(field**2) * 3.0)
            amplitudes[:, k] *= min(1.0, LARGEST * self.plausible_mm / max(rms, 1e-12))
        return Draws(amplitudes, draws.form)


def moments_of(
    design: Design, sensitivities: list[np.ndarray], uncertainty: Uncertainty
) -> Moments:
    """Moments of the forms' sensitivities on a design."""
    return Moments.of(
        np.concatenate(sensitivities, axis=3),
        design.pressure,
        design.direction,
        uncertainty,
        design.seconds,
    )


def uncertainty_of(
    model: ArmModel, noise_mm: np.ndarray | None, signal_mm: np.ndarray, dt_s: float
) -> Uncertainty:
    """Uncertainty from which effects of size signal_mm (n,) must stand out; noise_mm (n,) RMS."""
    points, length = model.spec.key_points, length_of(model)
    if noise_mm is None:
        noise_mm = np.full(points, CAMERA_SHARE * length)
    validated = [value or 0.0 for value in model.validation.per_key_point_mm]
    surrogate = np.array(validated or [UNVALIDATED_SHARE * length] * points)
    return Uncertainty(
        np.asarray(noise_mm, float),
        surrogate,
        np.asarray(signal_mm, float),
        dt_s,
        inducing_points(model.spec.chambers),
    )


def _history(model: ArmModel, schedule) -> tuple[History, np.ndarray | None]:
    """The actuations of a schedule, and the noise (n,) where something was measured."""
    if isinstance(schedule, History):
        return schedule, None
    if isinstance(schedule, Protocol):
        return history_of_protocol(model, schedule), None
    return history_of(schedule, model.spec.actuation), noise_of(schedule)[0]
