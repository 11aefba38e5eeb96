"""`compare`: a model's error on recordings, what it depends on, and the best achievable error."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from surgisoft.diagnosis.black_box import black_box
from surgisoft.diagnosis.body_frame import COMPONENTS
from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.error_axes import AxisShare, Band, bands, shares
from surgisoft.diagnosis.inputs import (
    Model,
    Recordings,
    open_inputs,
    refuse_rows_of_fit,
    with_known_residuals,
)
from surgisoft.diagnosis.other_models import name_of, open_model, takes_error
from surgisoft.diagnosis.pairs import Change, Paired, before_and_after
from surgisoft.diagnosis.residuals import (
    LEAST_BLOCKS,
    WHOSE_ARM,
    Floor,
    ModelFit,
    Part,
    Problem,
    ResidualTable,
    model_fit,
    repeat_floor,
    residual_table,
    with_training_noise,
)
from surgisoft.diagnosis.selection import BestAchievable, best_achievable, select
from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.diagnosis.statistics import block_interval, block_sums
from surgisoft.diagnosis.testability import testable
from surgisoft.errors import InputError
from surgisoft.files import json_safe, with_former_keys
from surgisoft.measurement.histories import check_fits
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.progress import Progress, silent
from surgisoft.surrogate.effects import known_effects
from surgisoft.surrogate.interval import coverage_of
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import TrainingResiduals
from surgisoft.workers import torch_threads

WORST = 5
"""Worst moments that are listed."""
LEAST_ROWS = 60
"""Fewest measured rows from which shares and a best achievable error are computed."""
AT_FLOOR = 1.05
"""An error below this multiple of the noise floor is at the floor."""
FORMER_KEYS = {
    "ceiling_mm": "best_achievable_mm",
    "ceiling_ci95_mm": "best_achievable_ci95_mm",
    "took_no_part": "held_out",
}
"""Deprecated keys of the JSON, each with its present name."""


@dataclass(frozen=True)
class Moment:
    """One of the worst moments."""

    recording: str
    """Name of the recording."""
    t_s: float
    """Time in the recording, s."""
    along_s: float
    """Time on the axis of the charts and of the replay, s: all recordings in turn."""
    error_mm: float
    """Largest distance of a key point, mm."""
    key_point: int
    """Which key point, from 0 at the base."""


@dataclass(frozen=True)
class TimeShift:
    """Delay of the arm behind the model that fits the residual best."""

    seconds: float
    """Delay, s; positive: the arm is behind the model."""
    ci95_s: tuple[float, float]
    """95 % interval from a bootstrap of blocks, s."""


@dataclass(frozen=True)
class Comparison:
    """A model's error on recordings."""

    rmse_mm: float
    """RMS distance between predicted and measured key points, over all of them, mm."""
    rmse_ci95_mm: tuple[float, float]
    """95 % interval of it from a bootstrap of blocks of time, mm."""
    tip_rmse_mm: float
    """RMS error of the last key point, mm."""
    per_key_point_mm: tuple[float, ...]
    """RMS error of each key point, base to tip, mm."""
    components_mm: dict[str, float]
    """RMS of the residual along the body, in its bending plane and out of it, mm."""
    mse_mm2: float
    """Mean squared error of a coordinate (the paper's MSE), mm^2."""
    floor: Floor
    """The noise floor that `diagnose` states, too: what the lab states, else from holds, else from
    second differences, of the rows that `diagnose` looks at."""
    floors: tuple[Floor, ...]
    """Every estimate of the floor that the recordings allow."""
    best_achievable: BestAchievable | None
    """Best achievable error on the rows that `diagnose` looks at, the same that it reports: the
    least that the model, a black box, any effect or the selected effects leave on held-out blocks.
    None for too few rows."""
    axes: tuple[AxisShare, ...]
    """How much of the error each axis explains, most first."""
    time_shift: TimeShift | None
    """The arm's delay behind the model; None without time."""
    samples: int
    """Rows with at least one measured key point."""
    missing: int
    """Rows without any."""
    bands: tuple[Band, ...]
    """Error and bias in bands of every axis."""
    worst: tuple[Moment, ...]
    """The worst moments, each from another stretch of time."""
    coverage: float | None = None
    """Share (0..1) of measured key points within the model's 95 % prediction interval; None for a
    model that states none."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""
    setup: str | None = None
    """What is wrong with the set-up of the recordings, in words; None where no fault is proved."""
    change: Change | None = None
    """How far the recordings differ from those before a change; None where none were given."""
    change_axes: tuple[AxisShare, ...] = ()
    """How much of the paired difference each axis explains, most first."""
    in_fit: float | None = None
    """Share 0..1 of the rows that the model was fitted to, where its error is no test of it; None
    where the model does not say."""
    open_rmse_mm: float | None = None
    """RMS error on the rows of `best_achievable`, mm, which is never below that; None without it.
    It is the error that `diagnose` states."""
    part: Part = "all"
    """The rows that were looked at."""
    of_arm: ModelFit | None = None
    """How well the model describes the arm: its error beside the motion of the key points."""

    @property
    def of_another_arm(self) -> bool:
        """Whether the model leaves so much of the motion that it does not describe this arm, and no
        fault of the set-up is proved. What the error depends on then says nothing. With recordings
        from before the arm is known to be the model's, and has changed."""
        if self.of_arm is None or self.change is not None or self.setup is not None:
            return False
        return not self.of_arm.fits

    @property
    def explainable(self) -> float | None:
        """Share (0..1) of the squared error above the floor that is achievable.

        All three numbers are of the rows of `best_achievable`. None without a best achievable
        error, or where the error is at the floor. An unknown floor counts as zero.
        """
        if self.best_achievable is None or self.open_rmse_mm is None or self.at_floor:
            return None
        noise = self.floor.rmse_mm or 0.0
        excess = self.open_rmse_mm**2 - noise**2
        if self.open_rmse_mm <= AT_FLOOR * noise or excess <= 0:
            return None
        fall = self.open_rmse_mm**2 - self.best_achievable.rmse_mm**2
        return float(np.clip(fall / excess, 0, 1))

    @property
    def at_floor(self) -> bool:
        """Whether the error over all rows that were looked at is at the noise floor."""
        noise = self.floor.rmse_mm
        return noise is not None and self.rmse_mm <= AT_FLOOR * noise

    @property
    def main_axes(self) -> list[AxisShare]:
        """The best axis, and the best of the other kind (static or memory), where they matter."""
        found = [a for a in self.axes if a.clear]
        other = [a for a in found[1:] if a.static != found[0].static]
        return found[:1] + other[:1]

    @property
    def sentence(self) -> str:
        """Error, noise floor, best achievable error, and what the error depends on."""
        noise = self.floor.rmse_mm
        text = f"error {_mm(self.rmse_mm)}, floor {'unknown' if noise is None else _mm(noise)}"
        if self.in_fit:
            text = f"{self.rows_of_fit}; {text}"
        if self.change is not None:
            text = f"{self.change.sentence}; {text}"
        if self.at_floor:
            return f"{text}: the error is at the floor"
        if self.of_another_arm and self.of_arm is not None:
            return (
                f"{text}: the model does not describe this arm's motion of "
                f"{_mm(self.of_arm.motion_mm)}: {WHOSE_ARM}; or one effect changes most of the "
                "motion, which diagnose tells"
            )
        if self.best_achievable is None or self.open_rmse_mm is None:
            return f"{text}; too few rows to say what it depends on"
        if self.part == "all":
            text += f"; on the rows that diagnose uses error {_mm(self.open_rmse_mm)}"
        text += f", best achievable {_mm(self.best_achievable.rmse_mm)}"
        what = "error" if noise is None else "excess"
        text += f": {100 * (self.explainable or 0):.0f} % of the {what} is explainable"
        return f"{text}; {self._depends()}"

    @property
    def rows_of_fit(self) -> str:
        """Statement that the error is no test, as the model was fitted to these rows, or empty."""
        if not self.in_fit:
            return ""
        seen = f"which was fitted to or chosen by {self.in_fit:.0%} of these rows"
        return f"no test of the model, {seen}"

    def _depends(self) -> str:
        main = [f"{a.in_words} ({100 * a.share:.0f} %)" for a in self.main_axes]
        if not main:
            return "it depends clearly on no single axis"
        text = f"it depends most on {main[0]}"
        if len(main) > 1:
            text += f", {'beyond that' if self.main_axes[0].static else 'then'} on {main[1]}"
        return text

    def to_json(self) -> dict:
        """Plain values, as `compare --json` writes them; see `FORMER_KEYS` for deprecated names."""
        values = asdict(self) | {"change": self.change and self.change.to_json()}
        floor, top = values.pop("floor"), values.pop("best_achievable")
        values |= {
            "sentence": self.sentence,
            "floor_mm": floor["rmse_mm"],
            "floor_source": floor["source"],
            "floors": {each.source: each.rmse_mm for each in self.floors},
            "best_achievable_mm": top and top["rmse_mm"],
            "best_achievable_ci95_mm": top and top["ci95_mm"],
            "explainable": self.explainable,
            "held_out": None if self.in_fit is None else not self.in_fit,
        }
        return json_safe(with_former_keys(values, FORMER_KEYS))


@torch_threads(1)
def compare(
    model: Model,
    recordings: Recordings,
    part: Part = "all",
    reference: Sequence[Recording] | TrainingResiduals | None = None,
    before: Recordings | None = None,
    paired: Paired = "auto",
    predictions: Iterable[str | Path] | None = None,
    error_mm: float | None = None,
    test: bool = False,
) -> tuple[Comparison, ResidualTable]:
    """Evaluate a model on recordings; both may be given by their paths.

    Returns the error with its intervals and what it depends on, and the table of residuals
    (measured minus predicted key points, mm, arm base frame). Errors are root mean squares of a key
    point's distance over all rows and key points, mm. Raises InputError where the recordings hold
    no key point, or are of another arm than the model.

    A model of other origin is a callable, its name, or a name with its predictions in files, one
    for each recording and of `before`; error_mm: its validated error, mm (docs/your_model.md).

    part: which rows of them are looked at. The noise floor is that of the training rows, which
    `diagnose` looks at, and so is the best achievable error if all rows are looked at: both
    commands state the same numbers. reference: as for `diagnose`, which takes it into account for
    the best achievable error. before: recordings from before a change; the comparison then also
    says how far the two sets differ (`pairs`), by the paired difference where both have the same
    actuation; paired: as for `diagnose`.
    test: raise InputError where the model was fitted to some of the recordings, or keeps no record
    of its fit, so that the error is a test error.
    """
    model, recordings, before = open_model(model, recordings, before, predictions, error_mm)
    model, recordings, notes = open_inputs(model, recordings, sized=False, tried=False)
    if test:
        refuse_rows_of_fit(model, recordings)
    wrong = find_setup_faults(model, recordings) if part == "all" else None
    if wrong is None:
        check_fits(model.spec, recordings)
    whole = with_training_noise(residual_table(model, recordings), recordings)
    if np.isnan(whole.only(part).measured_mm).all():
        raise InputError(
            "no key point was measured in any row of the recordings, expected at least one; check "
            "their columns k0_x_mm ..."
        )
    both = None
    changed: tuple[AxisShare, ...] = ()
    if before is not None:
        earlier = load_recordings(before)
        both = before_and_after(whole, earlier, paired)
        notes, reference = (*notes, *both.notes), earlier
        if both.used:
            changed = tuple(shares(both.table.view(part)))
    problem = with_known_residuals(whole.view(part, least_blocks=1), reference)
    table, block = problem.table, problem.block_of_row
    square = np.square(table.error_mm)
    seen = ~np.isnan(square).all(axis=1)
    looked_at = np.full(len(seen), True)
    if part != "all":
        looked_at = table.held_out == (part == "held_out")
    per_point = np.sqrt([_nanmean(square[:, k]) for k in range(square.shape[1])])
    enough = int(seen.sum()) >= LEAST_ROWS
    posed = problem
    if part == "all" and enough:
        posed = with_known_residuals(whole.view("training", least_blocks=1), reference)
    best = achievable(posed) if enough else None
    return (
        Comparison(
            rmse_mm=float(np.sqrt(_nanmean(square))),
            rmse_ci95_mm=_root_interval(square, block),
            tip_rmse_mm=float(per_point[-1]),
            per_key_point_mm=tuple(float(value) for value in per_point),
            components_mm={
                name: float(np.sqrt(_nanmean(np.square(table.body_mm[..., k]))))
                for k, name in enumerate(COMPONENTS)
            },
            mse_mm2=_nanmean(square) / 3,
            floor=table.floor,
            floors=_floors(problem),
            best_achievable=best,
            axes=tuple(shares(problem)) if enough else (),
            time_shift=time_shift(table, block),
            samples=int(seen.sum()),
            missing=int((looked_at & ~seen).sum()),
            bands=tuple(bands(problem)),
            worst=tuple(_worst(table)),
            coverage=_coverage(table),
            notes=notes,
            setup=None if wrong is None else wrong.sentence,
            change=None if both is None else both.change,
            change_axes=changed,
            in_fit=problem.in_fit,
            open_rmse_mm=None if best is None else posed.rmse_mm,
            part=part,
            of_arm=model_fit(table),
        ),
        table,
    )


@dataclass(frozen=True, eq=False)
class Compared:
    """One of the models that were compared with the same recordings."""

    name: str
    """Name of the model."""
    result: Comparison
    """Its error."""
    table: ResidualTable
    """Its residuals on every row."""

    @property
    def summary(self) -> str:
        """Description of the model in one line."""
        return self.table.model.summary()

    @property
    def sentence(self) -> str:
        """Name and result in words."""
        return f"{self.name}: {self.result.sentence}"


def compare_all(
    models: Sequence[Model],
    recordings: Recordings,
    names: Sequence[str] | None = None,
    progress: Progress = silent,
    error_mm: float | None = None,
    **options,
) -> list[Compared]:
    """Compare several models with the same recordings; `options` are those of `compare`.

    names: names of the models, which default to those of their folders. progress: called with the
    number of models that are done. error_mm: validated error, mm, of the one model of several that
    is no arm model; raises InputError where more than one is none.
    """
    if names is None:
        names = [name_of(model) or f"model {i}" for i, model in enumerate(models, 1)]
    its = models[0] if len(models) == 1 else None
    if error_mm is not None and len(models) > 1:
        foreign = [model for model in models if takes_error(model)]
        if len(foreign) != 1:
            raise InputError(
                f"--model-error {error_mm:g} is the error of one callable, got {len(foreign)} "
                f"among {len(models)} models; compare them one at a time, or state the error of "
                "each callable by its attribute error_mm"
            )
        its = foreign[0]
    measured = load_recordings(recordings)
    results = []
    for done, (model, name) in enumerate(zip(models, names, strict=True)):
        progress(done, len(models), name)
        own_mm = error_mm if model is its else None
        results.append(compare(model, measured, error_mm=own_mm, **options))
    sizes = {table.measured_mm.shape for _, table in results}
    if len(sizes) > 1:
        listed = ", ".join(
            f"{name} {table.measured_mm.shape[1]}"
            for name, (_, table) in zip(names, results, strict=True)
        )
        raise InputError(
            f"the models predict different numbers of key points ({listed}); "
            "compare them one at a time"
        )
    return [
        Compared(name, result, table)
        for name, (result, table) in zip(distinct(names), results, strict=True)
    ]


def tables_of(
    models: Mapping[str, Model], recordings: Recordings, error_mm: float | None = None
) -> dict[str, ResidualTable]:
    """The residuals of several models on every row of the same recordings, by the models' names.

    error_mm: validated error of those that are callables, mm.
    """
    found = {}
    for name, model in models.items():
        own = None if isinstance(model, ArmModel) else error_mm
        opened, given, _ = open_model(model, recordings, None, None, own)
        opened, given, _ = open_inputs(opened, given, sized=False, tried=False)
        found[name] = residual_table(opened, given)
    return found


def distinct(names: Sequence[str]) -> list[str]:
    """The names, with a number behind those that occur before."""
    found: list[str] = []
    for name in names:
        count = sum(1 for each in found if each == name or each.startswith(f"{name} ("))
        found.append(f"{name} ({count + 1})" if count else name)
    return found


def achievable(problem: Problem) -> BestAchievable | None:
    """The best achievable error of a problem; None where it has too few blocks of time.

    Effects count where the model's network is static: a recurrent one takes none.
    """
    if len(problem.motion) < LEAST_BLOCKS:
        return None
    selected = None
    if problem.model.takes_effects:
        some, _ = testable(problem, candidates(problem), list(known_effects()))
        selected = select(problem, some, lambda text: None)
    return best_achievable(problem, black_box(problem), selected)


def time_shift(table: ResidualTable, block: np.ndarray) -> TimeShift | None:
    """The delay tau for which residual = -tau x predicted velocity fits best, in least squares.

    The velocity is the predicted motion over the row before and the row after.
    """
    inside = np.zeros(len(table.run), bool)
    inside[1:-1] = (table.run[2:] == table.run[:-2]) & table.timed[1:-1] & (block[1:-1] >= 0)
    rows = np.flatnonzero(inside)
    if not len(rows):
        return None
    motion = np.zeros_like(table.predicted_mm)
    dt = table.t_s[rows + 1] - table.t_s[rows - 1]
    step = table.predicted_mm[rows + 1] - table.predicted_mm[rows - 1]
    motion[rows] = step / dt[:, None, None]
    motion = np.where(np.isnan(table.residual_mm), 0.0, motion)
    won = block_sums(-(np.nan_to_num(table.residual_mm) * motion).sum((1, 2)), block)
    power = block_sums(np.square(motion).sum((1, 2)), block)
    if power.sum() <= 0:
        return None
    low, high = block_interval(lambda a, b: a / b, (won, power))
    return TimeShift(float(won.sum() / power.sum()), (float(low), float(high)))


def _floors(problem: Problem) -> tuple[Floor, ...]:
    """Every estimate of the noise floor, the one in force first."""
    table = problem.table
    found = {floor.source: floor for floor in (table.floor, table.holds)}
    found["repeats"] = repeat_floor(table, problem.block_of_row)
    return tuple(floor for floor in found.values() if floor.rmse_mm is not None)


def _coverage(table: ResidualTable) -> float | None:
    """Share of measured key points within the model's 95 % interval; None without an interval."""
    if not table.model.states_interval:
        return None
    radius = table.model.error_radius(torch.from_numpy(table.pressure))
    return coverage_of(torch.from_numpy(table.error_mm), radius)


def _root_interval(square: np.ndarray, block: np.ndarray) -> tuple[float, float]:
    sums = (block_sums(square, block), block_sums(~np.isnan(square), block))
    low, high = block_interval(lambda a, b: np.sqrt(a.sum(1) / b.sum(1)), sums)
    return float(low), float(high)


def _mm(value: float) -> str:
    return f"{value:.2f} mm" if value >= 0.095 else f"{value:.3f} mm"


def _nanmean(values: np.ndarray) -> float:
    seen = values[~np.isnan(values)]
    return float(seen.mean()) if len(seen) else float("nan")


def _worst(table: ResidualTable):
    """The rows with the largest errors, no two within 2 % of a run's rows of each other."""
    error = np.nan_to_num(table.error_mm, nan=-1.0)
    peak = error.max(axis=1)
    apart = max(1, len(peak) // 50)
    free = peak >= 0
    for _ in range(WORST):
        if not free.any():
            return
        row = int(np.argmax(np.where(free, peak, -1.0)))
        yield Moment(
            table.names[table.recording[row]],
            float(table.t_s[row]),
            float(table.along_s[row]),
            float(peak[row]),
            int(error[row].argmax()),
        )
        free[max(0, row - apart) : row + apart + 1] = False
