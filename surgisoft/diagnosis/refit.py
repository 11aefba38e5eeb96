"""Fitted together: effects are trained jointly with the network, and held-out data decide.

A network that was fitted to recordings without an effect has learned to imitate some of it: from a
lag it takes directions of change and motions that are too small. What it cannot imitate counts as
its validated error, and the residuals then say "no more than the model's own error". The question
that residuals cannot answer is whether network and effect *together* would have been better. Here
it is tried: from the weights of the model (a warm start), the network is trained on with each
effect that a network can hide, and as long without any effect (the rival). Whole runs, or blocks of
time where runs are few, are left out in turn, each by a training with another seed, and the errors
there are compared.

A training may come out badly by chance, and all blocks that it left out then show a gain of every
effect. Which part of a gain is the effect's is therefore tried before it is named: the network is
trained on alone from where the training with the effect ended, and the better of the two trainings
of the network alone counts.

The effort is fixed in epochs and rows, not in seconds, so that the result does not depend on the
machine. All effects get few epochs; those that come out first get more (successive halving:
Jamieson & Talwalkar 2016, "Non-stochastic best arm identification").
"""

import copy
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surgisoft.diagnosis.data_quality import FAR_ROWS, far_share
from surgisoft.diagnosis.estimation.effects import fitted_model, shrink, starts
from surgisoft.diagnosis.estimation.intervals import Parameter
from surgisoft.diagnosis.estimation.nuisance import kinds
from surgisoft.diagnosis.residuals import TOGETHER, Problem
from surgisoft.diagnosis.statistics import (
    block_interval,
    block_sums,
    sign_flip_p_values,
    win_shares,
)
from surgisoft.errors import InputError, unknown_name
from surgisoft.progress import Progress, silent
from surgisoft.surrogate.effects import (
    FRONT,
    Memoryless,
    Stage,
    effect_class,
    in_words,
    known_effects,
)
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel, Validation
from surgisoft.surrogate.training import Data, JointTraining, train_jointly
from surgisoft.workers import torch_threads, workers

Mode = Literal["auto", "never", "always"]
"""When candidates are fitted together with the network: `auto` where `reason_to_refit` gives a
reason."""
MODES: tuple[Mode, ...] = ("auto", "never", "always")


@dataclass(frozen=True)
class RefitConfig:
    """Effort of a refit and what decides in it."""

    rows: int = 4000
    """Most rows that networks are trained on; memories follow every row."""
    seeds: int = 3
    """Trainings of each candidate, each with another part of the recordings left out, another order
    of the rows and other windows."""
    early_epochs: int = 2
    """Epochs of the first stage of the first rung, whose result is scored, too: where rows are few,
    more training improves a network on them and makes it worse on other motions."""
    first_epochs: int = 8
    """Epochs of the second stage of the first rung, for all candidates and the rival."""
    epochs: int = 30
    """Epochs of the second rung, for the best candidates and the rival."""
    finalists: int = 3
    """Most candidates of the second rung."""
    seed: int = 0
    """Seed of all trainings."""


REFIT = RefitConfig()
"""The effort of the commands."""


@dataclass(frozen=True)
class RefitCriteria:
    """Thresholds that start a refit and decide in it.

    The values were set by hand on virtual robots, for residuals and before there was a refit; none
    was set by looking at one.
    """

    over_floor: float = 2.0
    """Factor on the noise floor from which an error is far above it."""
    within: float = 1.2
    """Most error above the floor, in units of the model discrepancy, that the fit validated."""
    of_fit: float = 0.5
    """Share of the rows that are rows of the model's fit, from which a larger error counts, too."""
    p_value: float = 0.02
    """Largest family-wise p-value of an effect that is named."""
    gain: float = 0.25
    """Least share of the rival's squared error above the noise floor that has to go."""
    log_gain: float = 0.08
    """Least mean of log(error of the rival / error with the effect)."""
    competing_gain: float = 0.8
    """Gain, as a share of the winner's, from which another effect can compete with it."""
    win_share: float = 0.9
    """Share of bootstrap samples in which the winner must beat a competing effect."""
    tie_of_gain: float = 0.02
    """Difference of two gains, as a share of the better one, up to which they are alike."""
    tie_of_left: float = 0.3
    """Difference of two gains, as a share of what the better one leaves, up to which they are
    alike; the smaller of both limits counts."""
    most_confidence: float = 0.81
    """Most confidence where others do about as well: of 21 ambiguous statements on virtual robots
    17 were right about the first effect."""


ASKED = RefitCriteria()
"""The criteria in force."""


@dataclass(frozen=True)
class RefitCandidate:
    """One effect, fitted together with the network."""

    effect: str
    """Its name; names joined by ` + ` where several were fitted at once."""
    heldout_rmse_mm: float
    """Error on the rows that were left out, over all seeds, mm."""
    per_key_point_mm: tuple[float | None, ...]
    """Error of each key point on those rows, base to tip, mm; None where it was never measured."""
    seeds_mm: tuple[float, ...]
    """Error of each seed on the part that it left out, mm."""
    rival_mm: float
    """Error of the rival (the network alone) at its own best stage, on the same rows, mm."""
    difference_mm: float
    """Rival less candidate, mm."""
    ci95_mm: tuple[float, float]
    """95 % interval of the difference from a bootstrap of runs or motions, mm."""
    spread_mm: float
    """Standard deviation over the seeds of the difference, mm."""
    gain: float
    """Share of the rival's squared error above the noise floor that goes."""
    log_gain: float
    """Mean over runs or motions of log(error of the rival / error of the candidate)."""
    p_value: float
    """Family-wise p-value: chance of so large a gain in any of the effects if none were missing."""
    epochs: int
    """Epochs of each training, up to the stage with the least held-out error."""
    stages: tuple[int, ...]
    """Epochs of each of these stages."""
    plausible: bool
    """Whether the effect's parameters lay in their ranges after every training."""
    parameters: dict
    """Its parameters after the training of the first seed, with units in their names."""
    in_words: str = ""
    """What these parameters mean, in words."""

    @property
    def named(self) -> bool:
        """Whether the effect meets the acceptance criteria of significance and size."""
        large = self.gain >= ASKED.gain and self.log_gain >= ASKED.log_gain
        return self.plausible and large and self.p_value <= ASKED.p_value


@dataclass(frozen=True)
class Refit:
    """Result of a refit."""

    reason: str
    """Why it was done."""
    alone_mm: float
    """Held-out error of the network without an effect, at its best stage, mm."""
    candidates: tuple[RefitCandidate, ...]
    """All effects that were tried, the best first."""
    winner: str | None
    """The effect that is missing; None where none meets the criteria."""
    competing: tuple[str, ...]
    """Effects that do about as well as the winner."""
    of_line: bool
    """Whether a tie was settled for the lag of the line, because the model's input is a command."""
    confidence: float
    """Share of bootstrap samples in which the winner, or what does about as well, leaves the least
    error of all candidates, less its p-value; 0 without a winner."""
    not_tried: tuple[tuple[str, str], ...]
    """(effect, why it was not tried)."""
    unit: str
    """What was left out and drawn: `runs` or `blocks of time`."""
    units: int
    """How many independent ones of them there are."""
    rows: int
    """Rows that were trained on, the part left out included."""
    trainings: int
    """Number of trainings."""
    seconds: float
    """Time that it took, s."""

    @property
    def names(self) -> tuple[str, ...]:
        """The winner and what competes with it; empty without a winner."""
        return () if self.winner is None else (self.winner, *self.competing)

    @property
    def ambiguous(self) -> bool:
        """Whether the winner cannot be told from others; a lag of a line (LINE) is named alone."""
        return bool(self.competing) and not self.of_line

    @property
    def sentence(self) -> str:
        """The result in words."""
        if self.winner is None:
            return (
                "fitted together with the network, no effect leaves significantly less than the "
                f"network alone ({self.alone_mm:.3g} mm on held-out {self.unit})"
            )
        best = self.of(self.winner)
        text = (
            f"fitted together with the network, {self.winner} leaves {best.heldout_rmse_mm:.3g} mm "
            f"of {best.rival_mm:.3g} mm on held-out {self.unit}"
        )
        if not self.competing:
            return text
        others = " and ".join(self.competing)
        if not self.of_line:
            return f"{text}; {others} would fit about as well"
        return (
            f"{text}; {others} would fit about as well, but the model's input is a command, which "
            "has to pass the line: measure the actuation to tell them apart"
        )

    def of(self, effect: str) -> RefitCandidate:
        """The result of one effect."""
        return next(one for one in self.candidates if one.effect == effect)

    def to_json(self) -> dict:
        """Plain values, as `diagnose --json` writes them."""
        return asdict(self) | {
            "sentence": self.sentence,
            "not_tried": [{"effect": name, "why": why} for name, why in self.not_tried],
        }


# When, and which effects ----------------------------------------------------------------------


def refit_reason(problem: Problem, mode: str) -> str:
    """Why candidates are fitted together with the network; empty where they are not.

    Raises InputError unless the mode is one of `MODES`.
    """
    if mode not in MODES:
        raise unknown_name("refit", mode, MODES)
    if mode == "auto":
        return reason_to_refit(problem)
    return "it was asked for" if mode == "always" else ""


def reason_to_refit(problem: Problem) -> str:
    """Why the residuals of a model cannot decide and a refit can; empty where they can.

    The error is far above the noise floor, and without noise at most 1.2 times (`ASKED.within`) the
    validated one, or most rows are those that the model was fitted to, where a larger error is no
    change of the arm: an effect that the network has learned to imitate would look like this.
    """
    error, floor = problem.rmse_mm, problem.floor_mm
    seen = np.isfinite(problem.residual).all(2).sum(0)
    validated = float(np.sqrt(seen @ np.square(problem.discrepancy_mm) / seen.sum()))
    excess = float(np.sqrt(max(error**2 - floor**2, 0.0)))
    if error < ASKED.over_floor * floor:
        return ""
    of_fit = (problem.in_fit or 0.0) >= ASKED.of_fit
    if (excess > ASKED.within * validated and not of_fit) or not problem.model.trainable:
        return ""
    size = (
        f"without noise, at {excess:.3g} mm, {beside(excess, validated)} the model's validated "
        f"error ({validated:.3g} mm without its noise)"
    )
    if excess > ASKED.within * validated:
        size = f"the model was fitted to {problem.in_fit:.0%} of these rows"
    return (
        f"the error ({error:.3g} mm) is far above the noise floor ({floor:.3g} mm) and {size}, so "
        "the network may imitate what is missing"
    )


def beside(value: float, reference: float) -> str:
    """A size beside a reference in words, to stand before the reference: as the numbers are."""
    if value <= reference:
        return "no larger than"
    ratio = value / reference if reference > 0.0 else np.inf
    return f"{ratio:.3g} times" if ratio >= 1.005 else "as large as"


LINE: Stage = "line"
"""Stage between a command and the pressure of a chamber. A first-order lag of the pressure and one
of the wall are the same operator on the actuation: where both fit as well and the model's input is
a command, which has passed a line in any case, the lag is that of the line."""
LINE_OR_WALL = (
    "the model's input counts as measured actuation, which has already passed the line, so a lag "
    "of the line, which would do the same, was not tried; if these columns are commands or set "
    "points, name them c1_kPa ... and fit with --actuation commanded"
)
"""What is said where a lag of the wall is named for measured actuation."""


def _of_line(effect: str) -> bool:
    """Whether an effect acts between the command and the pressure."""
    kind = known_effects().get(effect)
    return kind is not None and kind.stage == LINE


def can_hide(name: str) -> bool:
    """Whether a network can hide an effect by imitation: one with memory that acts in front."""
    kind = known_effects()[name]
    return kind.stage in FRONT and not issubclass(kind, Memoryless)


def in_front(names: Iterable[str]) -> list[str]:
    """The effects among them that act in front of the network and can be trained with it."""
    return [name for name in names if effect_class(name).stage in FRONT]


def hideable(problem: Problem, without: Iterable[str] = ()) -> tuple[list[str], dict[str, str]]:
    """The effects that a refit can decide about, and why it cannot about the others.

    A network of actuation and direction learns every static function by itself, so a static effect
    leaves no trace in a joint fit. Effects behind the network act on the shape; the network does
    not see what they need. Effects that the model has already were fitted with it. A lag of the
    line lies between the command and the measured actuation, so it is tried for commands alone.
    """
    tried, left = [], {}
    timed = bool(problem.table.timed[problem.index.numpy()].any())
    for name, kind in known_effects().items():
        if name in without:
            continue
        if name in problem.model.effects:
            left[name] = "the model has it already, and it was fitted with the network"
        elif kind.stage not in FRONT:
            left[name] = f"acts on the {kind.stage}, behind the network: the residuals decide"
        elif kind.stage == LINE and problem.model.spec.actuation == "measured":
            left[name] = (
                "the model's input is the measured actuation, in which the line's lag is already: "
                "a lag behind it is one of the wall; the residuals decide about a longer line"
            )
        elif issubclass(kind, Memoryless):
            left[name] = "is a function of the actuation, which a network learns by itself"
        elif not timed:
            left[name] = "steady-state samples cannot show it: they have no rates and no past"
        else:
            tried.append(name)
    return tried, left


# One training ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """One training of the network with an effect, or without."""

    model: ArmModel
    """The model to start from, the effect in place."""
    effects: tuple[str, ...]
    """Effects whose parameters are held in their plausible ranges."""
    part: int | None
    """The part that is left out; None: none is."""
    epochs: int
    """Epochs."""
    seed: int
    """Seed of the training."""
    before: tuple[int, ...] = ()
    """Epochs of the stages of training that led to the model."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of one training."""

    model: ArmModel
    """The trained model."""
    losses: np.ndarray
    """(B, n) sum of squared distances of each block and key point, mm^2."""
    stages: tuple[int, ...]
    """Epochs of each stage of training so far."""


Rung = dict[str | None, list[Outcome]]
"""The outcome of each seed, of each effect and of the rival (None)."""


@dataclass(frozen=True, eq=False)
class Split:
    """A problem's training rows, dealt to parts that are left out in turn."""

    problem: Problem
    """The problem."""
    data: Data
    """Its thinned rows, as the network has to reach them (`behind_network_mm`); none held out."""
    part: np.ndarray
    """(B,) the part of each block."""
    unit: np.ndarray
    """(B,) independent unit of each block: its run or its motion."""
    unit_name: str
    """`runs` or `blocks of time`."""
    rows: int
    """Rows that are trained on."""

    @classmethod
    def of(cls, problem: Problem, config: RefitConfig) -> "Split":
        """Deal the blocks of a problem to as many parts as there are seeds."""
        history = problem.history
        seen = np.flatnonzero(problem.block_of_row >= 0)
        kept = np.zeros(len(problem.block_of_row), bool)
        kept[seen[:: max(1, -(-len(seen) // config.rows))]] = True
        points = history.key_points - behind_network_mm(problem.model, history)
        points[history.valid] = points[history.valid].masked_fill(
            ~torch.from_numpy(kept)[:, None, None], torch.nan
        )
        by_run = _parts_of_runs(problem, config.seeds)
        part = _parts_of_blocks(problem.motion, config.seeds)
        run_of_block = _run_of_block(problem)
        enough = by_run is not None and int(run_of_block.max()) + 1 >= least_units()
        return cls(
            problem=problem,
            data=Data(replace(history, key_points=points), None, None),
            part=part if by_run is None else by_run,
            unit=run_of_block if enough else problem.motion,
            unit_name="blocks of time" if by_run is None else "runs",
            rows=int(kept.sum()),
        )

    def held(self, part: int | None) -> Data:
        """The data with one part held out."""
        history = self.problem.history
        out = np.zeros(len(self.problem.block_of_row), bool)
        if part is not None:
            inside = self.problem.block_of_row >= 0
            out[inside] = self.part[self.problem.block_of_row[inside]] == part
        mask = torch.zeros_like(history.valid)
        mask[history.valid] = torch.from_numpy(out)
        return replace(self.data, held=mask)

    def losses(self, model: ArmModel) -> np.ndarray:
        """(B, n) sum of squared distances of a model in each block and key point, mm^2."""
        square = np.square(self.problem.with_model(model).residual).sum(2)
        return block_sums(square, self.problem.block)

    def by_unit(self, values: np.ndarray) -> np.ndarray:
        """(..., U) sums of values (..., B) of the blocks over units."""
        names, place = np.unique(self.unit, return_inverse=True)
        sums = np.zeros((len(names), *values.shape[:-1]))
        np.add.at(sums, place, np.moveaxis(values, -1, 0))
        return np.moveaxis(sums, 0, -1)


@torch.no_grad()
def behind_network_mm(model: ArmModel, history: History) -> Tensor | float:
    """(R, T, n, 3) what a model's effects on body and sensors move its key points by, mm.

    The network is trained to reach the measured key points less this, because these effects act
    behind it. 0 where the model has none.
    """
    front = {name: each for name, each in model.effects.items() if each.stage in FRONT}
    if len(front) == len(model.effects):
        return 0.0
    return model.predict(history) - model.replace(effects=front).predict(history)


def _run_of_block(problem: Problem) -> np.ndarray:
    """(B,) run of each block, from 0."""
    run = problem.history.run_of_row[problem.index].numpy()
    answer = np.zeros(int(problem.block.max()) + 1, int)
    answer[problem.block] = np.unique(run, return_inverse=True)[1]
    return answer


def _parts_of_blocks(motion: np.ndarray, parts: int) -> np.ndarray:
    """(B,) part of each block, none of them empty: neighbouring motions together where there are
    enough, blocks where there are fewer motions than parts."""
    count = int(motion.max()) + 1
    if count < parts:
        return np.arange(len(motion)) // TOGETHER % parts
    return motion // (TOGETHER if count > TOGETHER * (parts - 1) else 1) % parts


def _parts_of_runs(problem: Problem, parts: int) -> np.ndarray | None:
    """(B,) part of each block where whole runs can be left out; None where blocks have to be.

    Kinds of runs where there are enough, else runs. Runs cannot be left out where they are few, or
    where a part's actuation lies far from that of all others: the error there is that of the
    network beyond its data, which no effect changes.
    """
    run_of_block = _run_of_block(problem)
    runs = int(run_of_block.max()) + 1
    if runs < parts:
        return None
    kind = kinds(problem.pressure, run_of_block[problem.block])
    part = (kind if kind.max() + 1 >= parts else np.arange(runs))[run_of_block] % parts
    row_part = part[problem.block]
    for number in range(parts):
        out = row_part == number
        if far_share(problem.pressure[~out], problem.pressure[out]) > FAR_ROWS:
            return None
    return part


def least_units() -> int:
    """Fewest units of which a sign-flip test can reach the asked p-value for every effect.

    K units have 2^K patterns of signs, so no p-value is below 2^-K, and a family of effects needs
    its share of the asked one (Bonferroni's bound).
    """
    family = sum(not issubclass(kind, Memoryless) for kind in known_effects().values())
    return int(np.ceil(np.log2(family / ASKED.p_value)))


@torch_threads(1)
def run_job(split: Split, job: Job) -> Outcome:
    """Train a copy of the job's model."""
    model = copy.deepcopy(job.model)
    hold = partial(_hold_plausible, effects=job.effects) if job.effects else None
    train_jointly(model, split.held(job.part), job.epochs, JointTraining(seed=job.seed), hold)
    return Outcome(model, split.losses(model), (*job.before, job.epochs))


def _hold_plausible(model: ArmModel, effects: Iterable[str]) -> None:
    """Shrink the amplitudes of effects to the plausible range, where that makes them plausible."""
    for name in effects:
        added = model.effects[name]
        if not added.plausible():
            before = copy.deepcopy(added.state_dict())
            if not shrink(added):
                added.load_state_dict(before)


_SPLIT: list[Split] = []


def _prepare(split: Split) -> None:
    _SPLIT[:] = [split]


def _run_prepared(job: Job) -> Outcome:
    return run_job(_SPLIT[0], job)


# The refit ------------------------------------------------------------------------------------


@torch_threads(1)
def refit(
    problem: Problem,
    reason: str = "it was asked for",
    without: Iterable[str] = (),
    together: Iterable[str] = (),
    config: RefitConfig = REFIT,
    progress: Progress = silent,
    processes: int = 1,
) -> Refit:
    """Fit candidate effects together with the network, and compare them on held-out data.

    problem: training rows of a residual table. without: effects that cannot act. together: effects
    to fit at once, as the one candidate; without them each effect that a network can hide is one.
    processes: how many trainings run at once; the result is the same. Raises InputError where the
    model's network is a recurrent one, which takes no effects.
    """
    begin = time.perf_counter()
    check_trainable(problem.model, together)
    together = tuple(dict.fromkeys(together))
    names, left = ([], {}) if together else hideable(problem, without)
    sets = {name: (name,) for name in names} | ({JOIN.join(together): together} if together else {})
    split = Split.of(problem, config)
    models: dict[str | None, ArmModel] = {None: problem.model}
    for number, (label, effects) in enumerate(sets.items()):
        progress(0.0, 1.0, f"start of {label} ({number + 1} of {len(sets)})")
        try:
            models[label] = starting_model(problem, effects)
        except InputError as error:
            if together:
                raise
            left[label] = str(error)
    tried = [label for label in sets if label in models]
    finalists = min(config.finalists, len(tried))
    first_epochs = config.early_epochs + config.first_epochs
    rungs = [(first_epochs, 1 + len(tried)), (config.epochs, 1 + finalists)]
    work, done = config.seeds * sum(epochs * count for epochs, count in rungs), 0
    first: Rung = {}
    second: Rung = {}
    best: list[str] = []
    with ExitStack() as stack:
        pool: Executor | None = None
        if processes > 1 and tried:
            pool = stack.enter_context(workers(processes, partial(_prepare, split)))

        def rung(labels: list[str], epochs: int, before: Rung) -> Rung:
            """Trainings of the rival and of some candidates, one a seed, from those before."""
            nonlocal done
            keys = [(label, part) for part in range(config.seeds) for label in (None, *labels)]
            jobs = [
                Job(
                    before[label][part].model if before else models[label],
                    sets[label] if label else (),
                    part,
                    epochs,
                    config.seed + part,
                    before[label][part].stages if before else (),
                )
                for label, part in keys
            ]
            found: Rung = {label: [] for label in (None, *labels)}
            outcomes = pool.map(_run_prepared, jobs) if pool else map(partial(run_job, split), jobs)
            for (label, _), outcome in zip(keys, outcomes, strict=True):
                found[label].append(outcome)
                done += epochs
                progress(done, work, f"fitted together: {label or 'the network alone'}")
            return found

        if tried:
            early = rung(tried, config.early_epochs, {})
            late = rung(tried, config.first_epochs, early)
            first = {label: _better(split, early[label], late[label]) for label in late}
            scores = _scores(split, dict.fromkeys(tried, first), sets)
            order = sorted(tried, key=lambda label: -scores[label].log_gain)
            best = [label for label in order if scores[label].plausible][:finalists]
        if best:
            second = rung(best, config.epochs, late)
            second = {label: _better(split, first[label], second[label]) for label in second}
        last = {label: second if label in best else first for label in tried}
        scores = _scores(split, last, sets) if tried else {}
        winner, competing, of_line, sure = _decided(split, _ahead(scores, best), last)
        checked: set[str] = set()
        while winner is not None and winner not in checked:
            checked.add(winner)
            progress(done, work, f"the network of {winner} alone")
            again = [
                Job(
                    _without(outcome.model, problem.model, sets[winner]),
                    (),
                    part,
                    outcome.stages[-1],
                    config.seed + part,
                )
                for part, outcome in enumerate(second[winner])
            ]
            outcomes = (
                pool.map(_run_prepared, again) if pool else map(partial(run_job, split), again)
            )
            second[None] = _better_parts(split, second[None], list(outcomes))
            scores = _scores(split, last, sets)
            winner, competing, of_line, sure = _decided(split, _ahead(scores, best), last)
    shown = sorted(tried, key=lambda label: (label not in best, -scores[label].log_gain))
    final = second or first
    return Refit(
        reason=reason,
        alone_mm=_rmse(split, _held_losses(split, final[None])) if final else problem.rmse_mm,
        candidates=tuple(scores[label] for label in shown),
        winner=winner,
        competing=competing,
        of_line=of_line,
        confidence=sure,
        not_tried=tuple(left.items()),
        unit=split.unit_name,
        units=len(np.unique(split.unit)),
        rows=split.rows,
        trainings=sum(len(some) for found in (first, second) for some in found.values())
        + config.seeds * len(checked),
        seconds=time.perf_counter() - begin,
    )


def _better(split: Split, *rungs: list[Outcome]) -> list[Outcome]:
    """The rung with the least held-out error: training on may overfit (early stopping)."""
    return min(rungs, key=lambda outcomes: float(_held_losses(split, outcomes).sum()))


def _better_parts(split: Split, one: list[Outcome], other: list[Outcome]) -> list[Outcome]:
    """Of two trainings for each part, the one with the least error on the part it left out."""

    def error(outcome: Outcome, part: int) -> float:
        return float(outcome.losses[split.part == part].sum())

    pairs = enumerate(zip(one, other, strict=True))
    return [min(pair, key=partial(error, part=part)) for part, pair in pairs]


def _without(trained: ArmModel, given: ArmModel, effects: Iterable[str]) -> ArmModel:
    """A trained model without the effects that the given one lacked."""
    added = set(effects) - set(given.effects)
    kept = {name: effect for name, effect in trained.effects.items() if name not in added}
    return trained.replace(effects=kept)


def _ahead(scores: dict[str, RefitCandidate], best: list[str]) -> list[RefitCandidate]:
    """The candidates of the second rung, the best first."""
    return sorted((scores[label] for label in best), key=lambda score: -score.log_gain)


JOIN = " + "
"""What joins the names of effects that are fitted at once."""


def check_trainable(model: ArmModel, effects: Iterable[str] = ()) -> None:
    """Raise InputError unless a model's network can be trained together with the effects."""
    if not model.takes_effects:
        raise InputError(
            "the recurrent baseline takes no effects, so nothing can be fitted together with it: "
            "pass --refit never, or fit a model with --network haw_nn"
        )
    if not model.trainable:
        kind = model.summary().partition(" (")[0]
        raise InputError(
            f"{kind} has no network that could be trained together with effects: expected a model "
            "of 'surgisoft fit' with --network haw_nn; or pass --refit never"
        )
    for name in effects:
        stage = effect_class(name).stage
        if stage not in FRONT:
            raise InputError(
                f"{name} acts on the {stage}, behind the network, and is not fitted together with "
                "it: expected effects of line or material; pass --refit never"
            )


def starting_model(problem: Problem, effects: Iterable[str]) -> ArmModel:
    """The problem's model with effects at their first-order estimates, as far as plausible.

    Effects that the model has already stay as they are. Only forms that act in front of the network
    are trained together with it; those of the body change its key points.
    """
    model = problem.model
    for name in effects:
        if name not in model.effects:
            model = starts(problem.with_model(model), name, 1, stages=FRONT)[0]
            _hold_plausible(model, [name])
    return model


def _held_losses(split: Split, outcomes: list[Outcome]) -> np.ndarray:
    """(B, n) sum of squared distances, by the seed that left a block's part out, mm^2."""
    losses = np.stack([outcome.losses for outcome in outcomes])
    return losses[split.part, np.arange(losses.shape[1])]


def _counts(split: Split) -> np.ndarray:
    """(B, n) measured rows of each block and key point."""
    seen = np.isfinite(split.problem.residual).all(2)
    return block_sums(seen.astype(float), split.problem.block)


def _rmse(split: Split, losses: np.ndarray) -> float:
    return float(np.sqrt(losses.sum() / _counts(split).sum()))


def _log_gain(split: Split, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(U,) log of errors before over after, by unit, the noise added to both."""
    floor = _counts(split).sum(1) * split.problem.floor_mm**2
    before, after, floor = (split.by_unit(x) for x in (before.sum(1), after.sum(1), floor))
    return np.log((before + floor) / (after + floor))


def _gains_of(split: Split, rung: Rung, label: str) -> np.ndarray:
    """(U,) log gain of one candidate over the rival of its rung, by unit."""
    return _log_gain(split, _held_losses(split, rung[None]), _held_losses(split, rung[label]))


def _scores(
    split: Split, rungs: dict[str, Rung], sets: dict[str, tuple[str, ...]]
) -> dict[str, RefitCandidate]:
    """The result of each candidate in the last rung that it was in, against the rival there."""
    gains = np.stack([_gains_of(split, rung, label) for label, rung in rungs.items()])
    chances = sign_flip_p_values(gains, np.arange(len(gains)))
    return {
        label: _score(split, rung, label, sets[label], gain, float(chance))
        for (label, rung), gain, chance in zip(rungs.items(), gains, chances, strict=True)
    }


def _score(
    split: Split, rung: Rung, label: str, effects: tuple[str, ...], gain: np.ndarray, chance: float
) -> RefitCandidate:
    """The result of one candidate."""
    counts = _counts(split)
    before, after = (_held_losses(split, rung[key]) for key in (None, label))
    sums = tuple(split.by_unit(each.sum(1)) for each in (before, after, counts))
    low, high = block_interval(_difference, sums)
    seeds = range(len(rung[label]))
    by_seed = np.sqrt(
        [
            [each[split.part == part].sum() / counts[split.part == part].sum() for part in seeds]
            for each in (before, after)
        ]
    )
    difference = by_seed[0] - by_seed[1]
    floor = float(counts.sum()) * split.problem.floor_mm**2
    excess = max(before.sum() - floor, 0.02 * before.sum(), 1e-30)
    fitted = [[outcome.model.effects[name] for name in effects] for outcome in rung[label]]
    points = [
        float(np.sqrt(square / count)) if count else None
        for square, count in zip(after.sum(0), counts.sum(0), strict=True)
    ]
    return RefitCandidate(
        effect=label,
        heldout_rmse_mm=_rmse(split, after),
        per_key_point_mm=tuple(points),
        seeds_mm=tuple(by_seed[1].tolist()),
        rival_mm=_rmse(split, before),
        difference_mm=_rmse(split, before) - _rmse(split, after),
        ci95_mm=(float(low), float(high)),
        spread_mm=float(difference.std(ddof=1)) if len(difference) > 1 else 0.0,
        gain=float((before.sum() - after.sum()) / excess),
        log_gain=float(gain.mean()),
        p_value=chance,
        epochs=sum(rung[label][0].stages),
        stages=rung[label][0].stages,
        plausible=all(effect.plausible() for some in fitted for effect in some),
        parameters={q.name: q.value for effect in fitted[0] for q in effect.quantities()},
        in_words="; ".join(
            in_words(effect.readings(split.problem.covered_s)) for effect in fitted[0]
        ),
    )


def _difference(before: np.ndarray, after: np.ndarray, count: np.ndarray) -> np.ndarray:
    """(...) difference of two RMS errors from sums of squares and counts (...)."""
    count = np.maximum(count, 1)
    return np.sqrt(before / count) - np.sqrt(after / count)


def _decided(
    split: Split, ahead: list[RefitCandidate], rungs: dict[str, Rung]
) -> tuple[str | None, tuple[str, ...], bool, float]:
    """The winner, what competes with it, whether LINE settled a tie, and the confidence in it.

    ahead: candidates of the last rung, the best first.
    """
    ahead = [score for score in ahead if score.plausible]
    named = [score for score in ahead if score.named]
    if not named:
        return None, (), False, 0.0
    best = named[0]
    gains = {score.effect: _gains_of(split, rungs[score.effect], score.effect) for score in ahead}
    tie = min(ASKED.tie_of_gain * best.gain, ASKED.tie_of_left * (1.0 - best.gain))
    competing = []
    for other in ahead:
        if other is best or other.gain < ASKED.competing_gain * best.gain:
            continue
        shares = win_shares(-np.stack([gains[best.effect], gains[other.effect]]))
        if best.gain - other.gain < tie or shares[0] < ASKED.win_share:
            competing.append(other)
    line = [score for score in (best, *competing) if score.named and _of_line(score.effect)]
    of_line = bool(line and competing and split.problem.model.spec.actuation == "commanded")
    if of_line:
        competing = [score for score in (best, *competing) if score is not line[0]]
        best = line[0]
    alike = {score.effect for score in (best, *competing)}
    every = dict(zip(gains, win_shares(-np.stack(list(gains.values()))), strict=True))
    sure = max(float(sum(every[name] for name in alike)) - best.p_value, 0.0)
    if competing:
        sure = min(sure, ASKED.most_confidence)
    return best.effect, tuple(score.effect for score in competing), of_line, sure


def apart_mm(problem: Problem, effects: Iterable[str], config: RefitConfig = REFIT) -> float | None:
    """Error of effects that are fitted to the network as it is, on the parts that a refit leaves
    out in turn, mm: what a joint fit has to beat.

    A network that is trained on with few motions may get worse elsewhere, more than the effects
    make it better. None where the network was fitted to some of the rows, so that its error there
    is no test, and where a part alone cannot be fitted.
    """
    if problem.in_fit:
        return None
    names, split = list(dict.fromkeys(effects)), Split.of(problem, config)
    square = 0.0
    for part in range(config.seeds):
        out = split.part == part
        try:
            fitted = fitted_model(problem.without_blocks(out), names)
        except InputError:
            return None
        square += float(split.losses(fitted)[out].sum())
    return float(np.sqrt(square / _counts(split).sum()))


# The model that results -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class JointFit:
    """Network and effects, fitted together to all training rows."""

    model: ArmModel
    """The model with the effects; its validated error is that of the refit."""
    alone: ArmModel
    """The given model, its network trained for as many epochs without the effects it lacked."""
    parameters: tuple[Parameter, ...]
    """The effects' parameters; intervals are not known, so their ends are the values."""
    in_words: dict[str, str]
    """What the parameters mean, by effect."""

    def beside(self, parameters: Iterable[Parameter], in_words: dict[str, str]) -> "JointFit":
        """The same with the parameters of effects that the model had and that were not trained."""
        mine = {parameter.effect for parameter in self.parameters}
        kept = [each for each in parameters if each.effect not in mine]
        words = {name: text for name, text in in_words.items() if name not in mine}
        return replace(self, parameters=(*kept, *self.parameters), in_words=words | self.in_words)


ALL_ROWS = 10**9
"""More rows than any recording has: no row is left out of the last fit."""


@torch_threads(1)
def fit_together(
    problem: Problem,
    effects: Iterable[str],
    validated: RefitCandidate,
    config: RefitConfig = REFIT,
    progress: Progress = silent,
) -> JointFit:
    """Fit effects together with the network to all rows of a problem, and the network alone.

    Both are trained in the stages after which a refit found the least held-out error. validated:
    the result of these effects in that refit; its held-out error becomes the new model's validated
    one. Effects that the model has already are trained on in both.
    """
    effects = tuple(dict.fromkeys(effects))
    check_trainable(problem.model, effects)
    split = Split.of(problem, replace(config, rows=ALL_ROWS))
    starts_of = {
        f"network and {JOIN.join(effects)}": starting_model(problem, effects),
        "the network alone": problem.model,
    }
    trained = []
    for number, (note, start) in enumerate(starts_of.items()):
        held = tuple(name for name in effects if name in start.effects)
        progress(number, len(starts_of), f"fitted to all rows: {note}")
        for epochs in validated.stages:
            start = run_job(split, Job(start, held, None, epochs, config.seed)).model
        trained.append(start)
    validation = Validation(
        rmse_mm=validated.heldout_rmse_mm,
        per_key_point_mm=validated.per_key_point_mm,
        rows=int(np.isfinite(problem.residual).all(2).any(1).sum()),
        noise_mm=problem.model.validation.noise_mm,
        jump_mm=problem.model.validation.jump_mm,
    )
    model = trained[0].replace(validation=validation).eval().requires_grad_(False)
    model.training_residuals = model.residuals_on([problem.history])
    seconds = problem.covered_s
    words = {name: in_words(model.effects[name].readings(seconds)) for name in effects}
    return JointFit(model, trained[1], tuple(_parameters(model, effects)), words)


def _parameters(model: ArmModel, effects: Iterable[str]) -> Iterator[Parameter]:
    """The quantities of effects without intervals."""
    for name in effects:
        for quantity in model.effects[name].quantities():
            yield Parameter(
                effect=name,
                name=quantity.name,
                value=quantity.value,
                low=quantity.value,
                high=quantity.value,
                unit=quantity.unit,
                plausible=quantity.plausible,
                plausible_range=(quantity.low, quantity.high),
                source=quantity.source,
            )
