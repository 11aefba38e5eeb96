"""Which effects could be told apart, from the schedule of actuations alone.

Each effect's change of the key points is computed on the schedule, at a plausible strength, through
the model in question; nothing measured is needed. What another effect, in any of its shapes, and
the surrogate's own error cannot imitate of it is the evidence that the schedule can give.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from surgisoft.diagnosis.isolability.designs import (
    ROWS,
    Design,
    Shape,
    columns_on,
    design_of,
    history_of_protocol,
    length_of,
    reference_design,
    shapes_of,
)
from surgisoft.diagnosis.isolability.moments import (
    Moments,
    Uncertainty,
    inducing_points,
    sample_time,
    unimitated,
)
from surgisoft.diagnosis.problem import noise_of
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel

PLAUSIBLE_SHARE = 0.0075
"""Plausible size of an effect: RMS change of a key point on the varied reference schedule, as a
share of the arm's length."""
DRAWS = 6
"""Random strength vectors for each shape of an effect with more than one strength."""
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
    """What a schedule can say about E effects, each at a plausible strength."""

    names: tuple[str, ...]
    """The effects."""
    detectable: np.ndarray
    """(E,) expected log evidence, in nats, of each over the surrogate's own error alone."""
    log_evidence: np.ndarray
    """(E, E) expected log evidence, in nats, of effect a (row), where it is true, over b (column)
    with its best shape and strengths."""
    separability: np.ndarray
    """(E, E) share of a's signal beyond the surrogate's error that b cannot imitate, 0 to 1."""
    distance: np.ndarray
    """(E, E) half the distance of a from b in standard deviations, b's misfit included."""
    confidence: np.ndarray
    """(E, E) expected chance, 0.5 to 1, to name a where it is true and b the only rival; of those
    of a's shapes that can be seen at all."""
    seen: np.ndarray
    """(E,) share of a's shapes and strengths that can be seen at all."""
    minutes: float
    """Length of the schedule, minutes."""

    @property
    def log_evidence_per_minute(self) -> np.ndarray:
        """(E, E) nats a minute of the schedule."""
        return self.log_evidence / max(self.minutes, 1e-9)

    def pair(self, a: str, b: str) -> float:
        """Expected chance to tell two effects apart, whichever of them is true: the lesser one."""
        i, j = self.names.index(a), self.names.index(b)
        return float(min(self.confidence[i, j], self.confidence[j, i]))


def ambiguous_sets(result: Isolability, sure: float = SURE) -> list[tuple[str, ...]]:
    """The sets of effects that a schedule cannot tell apart: each effect with all its rivals.

    Two effects are rivals where the chance to tell them apart stays below `sure`; a set is the
    largest one in which each two are.
    """
    near = np.minimum(result.confidence, result.confidence.T) < sure
    np.fill_diagonal(near, False)
    cliques: list[set[int]] = []
    _cliques(near, set(), set(range(len(near))), set(), cliques)
    answer = [tuple(result.names[k] for k in sorted(each)) for each in cliques if len(each) > 1]
    return sorted(answer, key=lambda names: (-len(names), names))


def _cliques(near, chosen: set, open_: set, done: set, answer: list) -> None:
    """Largest sets in which all are near each other (Bron & Kerbosch 1973, with a pivot)."""
    if not open_ and not done:
        answer.append(set(chosen))
        return
    pivot = max(open_ | done, key=lambda k: int(near[k, list(open_)].sum()) if open_ else 0)
    for k in [k for k in open_ if not near[pivot, k]]:
        neighbours = set(np.flatnonzero(near[k]).tolist())
        _cliques(near, chosen | {k}, open_ & neighbours, done & neighbours, answer)
        open_ = open_ - {k}
        done = done | {k}


def isolability(
    model: ArmModel,
    schedule: list[Recording] | Protocol | History,
    names: list[str] | None = None,
    rows: int = ROWS,
    size_mm: float | None = None,
) -> Isolability:
    """What a schedule of actuations can say about the named effects (default: all known ones).

    Of recordings only the actuation and the noise are looked at. size_mm: RMS change of a key
    point by an effect on the reference schedule (default: PLAUSIBLE_SHARE of the arm's length).
    """
    history, noise = _history(model, schedule)
    reference = reference_design(model)
    shapes = shapes_of(model, reference, names)
    size = Sizes.of(reference, columns_on(reference, shapes), shapes, size_mm)
    design = design_of(model, history, rows)
    uncertainty = uncertainty_of(model, noise, size.profile_mm, sample_time(history))
    columns = columns_on(design, size.shapes)
    draws = size.limited(size.draws(), columns)
    owners = [shape.name for shape in size.shapes]
    return judge(moments_of(design, columns, uncertainty), draws, owners, size.spans)


def judge(
    moments: Moments,
    draws: "Draws",
    owners: list[str],
    spans: list[np.ndarray],
    misfit: np.ndarray | float = MISFIT,
) -> Isolability:
    """The matrices from moments of columns, strengths that may be true, and J shapes.

    owners: the effect of each shape; spans: the indices of each shape's columns; misfit: as MISFIT,
    one for all or (E, E). Between two Gaussian models at distance u the right one is the likelier
    with chance Phi(u / 2); along u lies some of the true effect's own misfit too.
    """
    gram = moments.gram()
    names = tuple(dict.fromkeys(owners))
    count = len(names)
    of_shape = np.array([names.index(owner) for owner in owners])
    of_draw = of_shape[draws.shape]
    misfit = np.broadcast_to(np.asarray(misfit, float), (count, count))
    # A rival takes whichever of its shapes imitates best.
    rest = unimitated(gram, draws.strengths, spans)
    best = np.stack([rest[of_shape == b].min(axis=0) for b in range(count)])
    whole = np.maximum(np.einsum("kd,kd->d", draws.strengths, gram @ draws.strengths), 0.0)
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
    """Strengths that may be true."""

    strengths: np.ndarray
    """(K, D) amplitudes of all columns; those of other shapes are zero."""
    shape: np.ndarray
    """(D,) index of the shape that is true."""


@dataclass(frozen=True, eq=False)
class Sizes:
    """How large the shapes' columns are on the reference schedule."""

    shapes: list[Shape]
    """The J shapes that do anything there."""
    spans: list[np.ndarray]
    """Indices of each one's columns among all of them."""
    gram_mm2: list[np.ndarray]
    """(K_j, K_j) mean products of each shape's columns over rows and key points, mm^2."""
    profile_mm: np.ndarray
    """(n,) RMS size at each key point of plausible effects, mm."""
    plausible_mm: float
    """RMS size of a plausible effect over all key points, mm."""

    @classmethod
    def of(
        cls,
        reference: Design,
        columns: list[np.ndarray],
        shapes: list[Shape],
        size_mm: float | None = None,
    ) -> "Sizes":
        """From the shapes' columns (S, n, 3, K_j) on the reference schedule, mm."""
        kept = [j for j, c in enumerate(columns) if np.isfinite(c).all() and np.abs(c).max() > 1e-9]
        points = reference.model.spec.key_points
        gram, profiles, spans, at = [], [], [], 0
        plausible = size_mm or PLAUSIBLE_SHARE * length_of(reference.model)
        for j in kept:
            c = columns[j].astype(float)
            rows, count = len(c), c.shape[3]
            flat = c.reshape(-1, count)
            gram.append(flat.T @ flat / (rows * points))
            unit = np.sqrt(np.maximum(np.diag(gram[-1]), 1e-30))
            profiles.append(((c / unit) ** 2).sum(2).mean(axis=(0, 2)))
            spans.append(np.arange(at, at + count))
            at += count
        profile = plausible * np.sqrt(np.mean(profiles, axis=0)) if kept else np.zeros(points)
        return cls([shapes[j] for j in kept], spans, gram, profile, plausible)

    def select(self, kept: list[int]) -> "Sizes":
        """Only some of the shapes; plausible sizes stay."""
        ends = np.cumsum([len(self.spans[j]) for j in kept])
        spans = [
            np.arange(end - len(self.spans[j]), end) for j, end in zip(kept, ends, strict=True)
        ]
        shapes, gram = [self.shapes[j] for j in kept], [self.gram_mm2[j] for j in kept]
        return replace(self, shapes=shapes, spans=spans, gram_mm2=gram)

    @property
    def columns(self) -> int:
        """Number of all columns."""
        return int(self.spans[-1][-1]) + 1 if self.spans else 0

    def draws(self, seed: int = 0) -> "Draws":
        """Strengths of plausible size; random mixtures where an effect has more than one."""
        rng = np.random.default_rng(seed)
        strengths, owner = [], []
        for j, span in enumerate(self.spans):
            unit = np.sqrt(np.maximum(np.diag(self.gram_mm2[j]), 1e-30))
            for _ in range(1 if len(span) == 1 else DRAWS):
                mixture = np.ones(1) if len(span) == 1 else rng.normal(size=len(span))
                full = np.zeros(self.columns)
                full[span] = self.plausible_mm * mixture / (unit * np.sqrt(len(span)))
                strengths.append(full)
                owner.append(j)
        return Draws(np.array(strengths).reshape(len(owner), -1).T, np.array(owner, int))

    def limited(self, draws: "Draws", columns: list[np.ndarray]) -> "Draws":
        """Strengths made smaller where they would be implausible on columns (S, n, 3, K_j)."""
        strengths = draws.strengths.copy()
        for k, j in enumerate(draws.shape):
            field = columns[j] @ strengths[self.spans[j], k]
            rms = np.sqrt(np.mean(field**2) * 3.0)
            strengths[:, k] *= min(1.0, LARGEST * self.plausible_mm / max(rms, 1e-12))
        return Draws(strengths, draws.shape)


def moments_of(design: Design, columns: list[np.ndarray], uncertainty: Uncertainty) -> Moments:
    """Moments of the shapes' columns on a design."""
    return Moments.of(
        np.concatenate(columns, axis=3),
        design.pressure,
        design.direction,
        uncertainty,
        design.seconds,
    )


def uncertainty_of(
    model: ArmModel, noise_mm: np.ndarray | None, signal_mm: np.ndarray, dt_s: float
) -> Uncertainty:
    """What effects of size signal_mm (n,) must stand out from on a model; noise_mm (n,) RMS."""
    points, length = model.spec.key_points, length_of(model)
    if noise_mm is None:
        noise_mm = np.full(points, CAMERA_SHARE * length)
    validated = [value or 0.0 for value in model.validation.per_key_point_mm]
    surrogate = np.array(validated or [0.05 * length] * points)
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
    measured = np.concatenate([recording.key_points_mm for recording in schedule])
    return history_of(schedule, model.spec.actuation), noise_of(schedule, measured)[0]
