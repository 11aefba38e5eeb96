"""Fit a model by forward selection: pressure, then effects with memory, then directions.

First the excitation of the recordings decides which inputs they can identify. A network cannot
separate an input from the pressure where the input is a function of the pressure. After a plain
traverse of the pressure cube the slow chamber has only ever risen: its direction is a constant, its
memory a function of its pressure. And where a chamber has only ever swept its whole range, the data
does not show what a small reversal does.
"""

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.special import stdtrit
from torch import Tensor

from surgisoft.config import value_text
from surgisoft.errors import InputError, Interrupted, unknown_name
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.chain import Taps
from surgisoft.surrogate.effects import (
    FRONT,
    check_user_effects,
    free_name,
    hypothesis_of,
    known_effects,
    make_effect,
)
from surgisoft.surrogate.ensemble import train_ensemble
from surgisoft.surrogate.fitted_rows import FittedRows
from surgisoft.surrogate.history import History
from surgisoft.surrogate.interval import ErrorInterval, calibrate, coverage_of, distance_to
from surgisoft.surrogate.kernel_fit import KernelFit, fit_kernel
from surgisoft.surrogate.model import LEFT_OF_MOTION, ArmModel, Validation, arm_facts
from surgisoft.surrogate.networks import (
    HIDDEN,
    ConstantCurvature,
    HawEnsemble,
    HawNN,
    KernelArm,
    RecurrentArm,
    check_widths,
)
from surgisoft.surrogate.prior_mean import arcs_of, fit_prior_mean
from surgisoft.surrogate.scan import direction_scan
from surgisoft.surrogate.training import (
    CHECK_EVERY,
    Data,
    Rows,
    dealt,
    held_rows,
    measured_rows,
    model_rows,
    new_recurrent,
    normalise,
    rest_shape,
    train_recurrent,
    validated_error,
)
from surgisoft.surrogate.training import train as train_model
from surgisoft.surrogate.training_residuals import ROWS, TrainingResiduals

UNPROVED = 0.5
"""Share of the squared held-out error of the finished stages below which the model of a stage that
was interrupted is kept."""
NEIGHBOURS = 24
"""Rows of nearby pressure that are compared with each row."""
LEAST_CONTRAST = 0.15
"""Least share of a direction's variance that pressure must leave unexplained."""
LEAST_REVERSALS = 8
"""Least number of reversals of a chamber."""
INNER = (0.03, 0.8)
"""Sweeps of these shares of the range are inner (minor) loops."""
LEAST_INNER = 0.1
"""Least share of inner sweeps among all, so that partial reversals are represented."""
MOST_ROWS = 4000
"""Rows that are compared with their neighbours; more are thinned evenly."""


@dataclass(frozen=True)
class ChamberExcitation:
    """How one chamber was moved in the recordings."""

    chamber: int
    """Number of the chamber, from 1."""
    contrast: float
    """Share (0..1) of the direction's variance that nearby pressures leave unexplained."""
    reversals: int
    """Number of changes of direction."""
    inner: float
    """Share of the sweeps between reversals that are inner loops."""

    @property
    def direction(self) -> bool:
        """Whether both directions were seen at like pressures."""
        return self.contrast >= LEAST_CONTRAST and self.reversals >= LEAST_REVERSALS

    @property
    def minor_loops(self) -> bool:
        """Whether the chamber reversed inside its range, and not only at the ends."""
        return self.direction and self.inner >= LEAST_INNER

    def unsupported(self) -> str:
        """Why the data does not support direction or memory of the chamber; empty if it does."""
        if self.minor_loops:
            return ""
        if self.reversals < LEAST_REVERSALS:
            often = "never reversed"
            if self.reversals:
                often = f"reversed only {self.reversals} time{'s' * (self.reversals > 1)}"
            why = f"it {often}"
        elif self.contrast < LEAST_CONTRAST:
            why = (
                "its direction follows from the actuation itself "
                f"(contrast {self.contrast:.2f}, at least {LEAST_CONTRAST} needed)"
            )
        else:
            why = (
                f"it swept its whole range ({self.inner:.0%} inner reversals, at least "
                f"{LEAST_INNER:.0%} needed)"
            )
        return f"chamber {self.chamber}: {why}"


def excitation(
    history: History, low: Tensor, high: Tensor, band: Tensor
) -> list[ChamberExcitation]:
    """Excitation of each chamber in a history; low, high, band (m,) in the arm's unit."""
    rest = torch.zeros_like(low).clamp(low, high)
    _, direction = direction_scan(history.pressure, band, rest)
    pressure = history.rows(history.pressure)
    span = (high - low).where(high > low, torch.ones_like(low))
    scaled = ((pressure - low) / span).double().numpy()
    sign = history.rows(direction).numpy()
    contrast = _contrast(scaled, sign)
    chambers = []
    for chamber in range(history.chambers):
        sweeps = [
            _sweeps(
                history.pressure[run, history.valid[run], chamber].numpy(),
                direction[run, history.valid[run], chamber].numpy(),
            )
            for run in range(history.runs)
        ]
        shares = np.concatenate(sweeps) / float(span[chamber])
        inner = (shares > INNER[0]) & (shares < INNER[1])
        chambers.append(
            ChamberExcitation(
                chamber=chamber + 1,
                contrast=float(contrast[chamber]),
                reversals=int(sum(max(len(run) - 1, 0) for run in sweeps)),
                inner=float(inner.mean()) if len(shares) else 0.0,
            )
        )
    return chambers


def _contrast(scaled: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """(m,) mean over rows of 1 - (mean direction of the neighbours)^2; rows (S, m)."""
    neighbours = min(NEIGHBOURS, len(scaled) - 1)
    if neighbours < 2:
        return np.zeros(scaled.shape[1])
    picked = np.linspace(0, len(scaled) - 1, min(len(scaled), MOST_ROWS)).astype(int)
    _, index = cKDTree(scaled).query(scaled[picked], k=neighbours + 1)
    mean = sign[index].mean(1)
    power = np.square(sign[index]).mean(1)
    return (power - np.square(mean)).mean(0)


def _sweeps(pressure: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Heights of the monotone sweeps of one chamber in one run, in its unit."""
    turns = np.flatnonzero(np.diff(direction) != 0) + 1
    pieces = np.split(pressure, turns)
    corners = [piece.max() if d >= 0 else piece.min() for piece, d in _signed(pieces, direction)]
    return np.abs(np.diff([pressure[0], *corners]))


def _signed(pieces: list[np.ndarray], direction: np.ndarray):
    start = 0
    for piece in pieces:
        yield piece, direction[start]
        start += len(piece)


NETWORKS = ("haw_nn", "constant_curvature", "recurrent", "kernel", "auto")
GREY_BOXES = ("haw_nn", "auto")
"""Networks that a prior mean, members and effects are options of."""
PRIORS = ("none", "arcs")
INPUTS = ("pressure", "pressure+direction")
IGNORED = {
    "kernel": ("inputs", "hidden", "sections", "epochs", "batch", "learning_rate"),
    "constant_curvature": ("hidden",),
    "recurrent": ("hidden", "sections", "batch"),
}
"""Settings of a fit (`FitConfig`) that a network does not have."""
OPTIONS = {"inputs": "--inputs", "hidden": "--widths", "epochs": "--epochs"}
"""Options of `surgisoft fit` for those settings, where their name is another."""
SIMPLE_SHARE = 0.2
"""Share of the epochs for a stage that precedes others, or comes after an effect."""
EFFECT_SHARE = 0.5
"""Share of the epochs for an effect's stage, whose epochs are longer and fewer needed."""
AUTO = "auto"
"""In the place of an effect's name: effects with memory (`Hypothesis.memory`) are tried, and the
best are added."""
TRIAL_SHARE = 0.25
"""Share of the epochs for which `auto` trains each candidate before it compares them."""
MEMBER_SHARE = 1.0
"""Share of the epochs for which the members of an ensemble are trained, all at once."""
MOST_MEMBERS = 50
"""Most members of an ensemble."""
WHOLE_NUMBERS = {
    "members": (1, MOST_MEMBERS),
    "sections": (0, 100),
    "epochs": (1, 10**9),
    "batch": (1, 10**9),
    "seed": (0, 2**63 - 1),
}
"""Least and largest value of those settings of a fit that are whole numbers; a random number
generator of torch takes no larger seed, and no arm has more sections."""
MOST_AUTO = 2
"""Most effects that `auto` adds."""
AUTO_GAIN = 0.1
"""Least fall of the held-out squared error, as a share of it, for which `auto` adds an effect: its
memory makes each later step of the model slower."""
STILL_SHARE = 0.15
"""Share of its range that a chamber has to move; below it the fit adds a note."""
LEAST_BLOCKS = 5
"""Fewest blocks of held-out time for a significance test of a stage."""
LARGEST_MM = 1e5
"""Largest coordinate that is accepted as a measurement, mm."""
LEAST_ROWS = 30
"""Fewest rows with key points that a fit accepts."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit."""

    network: str = "haw_nn"
    """`haw_nn`, `constant_curvature`, `recurrent`, `kernel` (arcs, and kernel regression with
    memory of what they leave) or `auto` (`haw_nn` and `kernel`, of which held-out data choose)."""
    inputs: str = "pressure+direction"
    """`pressure` or `pressure+direction`."""
    effects: tuple[str, ...] = ()
    """Names of effects to add, in order; `auto` at the end lets held-out data choose more."""
    members: int = 1
    """Networks whose mean is the prediction; above 1 an ensemble is trained behind the selection
    of inputs and effects, each member without another share of the training data."""
    prior: str | None = None
    """`arcs`: a chain of arcs is fitted first, and the network to what is left; `none`: the network
    alone; None: arcs with HAW-NN, unless the key points are no chain or the network alone has less
    held-out error."""
    hidden: tuple[int, ...] = HIDDEN
    """Widths of the hidden layers of HAW-NN."""
    sections: int = 0
    """Constant-curvature sections; 0: one for every 3 chambers."""
    epochs: int = 200
    """Most epochs of a stage without memory; stages that others follow, or with memory, have a
    share of them."""
    batch: int = 512
    """Rows per step."""
    learning_rate: float = 3e-3
    """Adam's largest learning rate; it falls along a cosine."""
    seed: int = 0
    """Seed of weights, order of rows and held-out blocks."""
    check_excitation: bool = True
    """Whether inputs that the data cannot support are left out."""


@dataclass
class StageReport:
    """Result of one stage of the forward selection."""

    name: str
    """`pressure`, `direction`, the name of an effect, or that of a baseline."""
    valid_rmse_mm: float
    """Held-out RMSE with the stage, mm."""
    epochs: int
    """Number of epochs trained."""
    seconds: float
    """Duration, s."""
    kept: bool
    """Whether the stage was accepted."""
    reason: str = ""
    """Why the stage was rejected, or `interrupted`; empty if it was accepted."""
    simpler_rmse_mm: float | None = None
    """Held-out RMSE of the simpler model trained just as long, mm."""
    settings: str = ""
    """What cross-validation chose for the stage; empty where it chose nothing."""
    tried_mm: dict[str, float] = field(default_factory=dict)
    """Held-out RMSE of each effect with which `auto` compared the stage's, after a short training,
    mm; `none`: without any."""


@dataclass(frozen=True)
class Interruption:
    """Where Ctrl-C ended a fit."""

    stage: str
    """Name of the training that was interrupted; `validation` where all stages were finished."""
    epoch: int
    """Epoch of that training after which it was validated last; 0: not yet."""
    used: bool
    """Whether the model is the best one of that training; else it is that of `finished`."""
    finished: tuple[str, ...]
    """Stages that were finished and accepted before."""
    unproved: str = ""
    """Stage whose model is kept because it errs less, though it was not compared with the simpler
    model trained for as long; empty: none."""

    @property
    def sentence(self) -> str:
        """The interruption in words."""
        after = f", validated last after epoch {self.epoch}" if self.epoch else ""
        model = "the best one so far"
        if not self.used:
            model = f"that of the finished stages: {', '.join(self.finished)}"
            if self.unproved:
                model += (
                    f", with {self.unproved}, which halves their squared held-out error but was "
                    "not compared with equally long training without it"
                )
        return f"the fit was interrupted in '{self.stage}'{after}; the model is {model}"


@dataclass
class FitResult:
    """A fitted model and the record of its fit."""

    model: ArmModel
    """The fitted model."""
    stages: list[StageReport]
    """Stages of the forward selection, in order."""
    excitation: list[ChamberExcitation]
    """Excitation of each chamber in the training data."""
    warnings: list[str]
    """Notes to the user: unsupported inputs, chambers that did not move."""
    seconds: float
    """Duration of the fit, s."""
    loss: list[tuple[str, int, float, float]] = field(default_factory=list)
    """(stage, epoch, training loss, validation loss), losses in mm^2."""
    covered: float | None = None
    """Share of the held-out key points within the model's 95 % interval; None where these rows
    calibrated the interval themselves, or without one."""
    known: TrainingResiduals | None = None
    """Residuals on the rows that the model was fitted to and validated on."""
    interrupted: Interruption | None = None
    """Where Ctrl-C ended the fit; None for a complete one."""
    running: tuple[str, int] = ("", 0)
    """Name of the training that began last, and the number of losses before it."""

    def report(self) -> dict:
        """Record of the fit, for a JSON file beside the model."""
        return {
            "stages": [asdict(stage) for stage in self.stages],
            "excitation": [asdict(chamber) for chamber in self.excitation],
            "warnings": self.warnings,
            "seconds": self.seconds,
            "coverage_held_out": self.covered,
            "interrupted": self.interrupted and asdict(self.interrupted),
            "loss": [
                dict(zip(("stage", "epoch", "training_mm2", "held_out_mm2"), row, strict=True))
                for row in self.loss
            ],
        }

    def lines(self) -> list[str]:
        """Record of the fit as lines of text for a person."""
        lines = [
            f"{stage.name:20s} held-out RMSE {stage.valid_rmse_mm:8.4f} mm  "
            f"{stage.epochs:4d} epochs {stage.seconds:6.1f} s  "
            f"{'kept' if stage.kept else 'left out'}"
            + (f" (without it {stage.simpler_rmse_mm:.4f} mm)" if stage.simpler_rmse_mm else "")
            + (f" ({stage.settings})" if stage.settings else "")
            for stage in self.stages
        ]
        for stage in self.stages:
            if stage.tried_mm:
                tried = ", ".join(f"{name} {rmse:.3f}" for name, rmse in stage.tried_mm.items())
                lines.append(f"tried for {stage.name}, held-out RMSE in mm: {tried}")
        if isinstance(self.model.network, HawNN) and self.model.network.prior is not None:
            lines.append("prior mean: a chain of arcs, to which the network adds what they leave")
        lines += [f"note: {warning}" for warning in self.warnings]
        error = self.model.validation
        points = " ".join(
            "-" if value is None else f"{value:.4f}" for value in error.per_key_point_mm
        )
        lines.append(
            f"held-out RMSE {error.rmse_mm:.4f} mm over {error.rows} rows; "
            f"key points base to tip: {points} mm"
        )
        if error.interval is not None:
            lines.append(error.interval.sentence())
        if self.covered is not None:
            lines.append(
                f"coverage of that interval on held-out rows, which gave it only one factor: "
                f"{self.covered:.1%}"
            )
        return lines


Progress = Callable[[str, int, int, float], None]
"""Called with (stage, epoch, epochs, validation loss in mm^2)."""


def rms_of_loss(stage: str, loss: float) -> float:
    """RMS distance of a key point that a loss of `Progress` [mm^2] stands for, mm.

    The kernel's is the mean squared distance. The others are means over three coordinates, whose
    weights by their range of motion have mean 2 (`range_weights`).
    """
    return math.sqrt(loss if stage == "kernel" else 3.0 / 2.0 * loss)


def fit(
    train: History,
    valid: History | None,
    spec: ArmSpec,
    config: FitConfig,
    progress: Progress | None = None,
) -> FitResult:
    """Fit a model to `train`; select stages by `valid`, or by held-out rows of `train` without it.

    progress: called as `Progress` describes. Raises InputError where the recordings cannot be
    fitted (too few rows, missing key points, values out of range) or the configuration names
    something unknown. Ctrl-C raises `Interrupted` with the best model so far, or KeyboardInterrupt
    before the first validation.
    """
    _check(train, valid, spec, config)
    start = time.perf_counter()
    torch.manual_seed(config.seed)
    used = [name for name in config.effects if name != AUTO]
    if AUTO in config.effects:
        used += [name for name, kind in known_effects().items() if hypothesis_of(kind).memory]
    check_user_effects(arm_facts(spec, rest_shape(train)), used)
    data = Data.split(train, valid, config.seed)
    low, high, band = (torch.tensor(x) for x in (spec.low, spec.high, spec.band))
    # Each stage puts its model here.
    nothing: Any = None
    result = FitResult(nothing, [], excitation(train, low, high, band), [], 0.0)
    result.warnings.extend(_still_chambers(train, spec))
    try:
        if config.network == "recurrent":
            _fit_recurrent(data, spec, config, result, progress)
        elif config.network == "kernel":
            _fit_kernel(data, spec, config, result, progress)
        else:
            validated = excitation(data.validation, low, high, band)
            support = _Support(result.excitation, all(each.minor_loops for each in validated))
            _fit_stages(data, spec, config, support, result, progress)
    except KeyboardInterrupt:
        if result.model is None:
            raise
        _take_interrupted(data, result, time.perf_counter() - start)
    try:
        _finish(data, result)
    except KeyboardInterrupt:
        if result.interrupted is not None:  # the second Ctrl-C
            raise
        names = tuple(stage.name for stage in result.stages if stage.kept)
        result.interrupted = Interruption("validation", 0, False, names)
        _finish(data, result)
    result.seconds = time.perf_counter() - start
    if result.interrupted is not None:
        raise Interrupted(result)
    return result


def _fit_stages(data: Data, spec, config, support, result: FitResult, progress) -> None:
    """Forward selection of a network's stages; the result has the model and its validation."""
    names = _stages(config)
    grown = [name for name in names if _supported(result, name, config, support)]
    for name in grown:
        if name == AUTO:
            _add_memory(data, spec, config, support, result, progress)
            continue
        epochs = _stage_epochs(name, grown, config)
        if result.model is None:
            candidate = _first(name, spec, config, data, result)
        else:
            name = free_name(name, result.model.effects)  # a second creep is `creep#2`
            candidate = _grow(result.model, name, spec, config, support, data)
        _stage(candidate, name, epochs, config, data, result, progress)
        if name == "pressure" and config.prior is None:
            _compare_alone(spec, epochs, config, data, result, progress)
    interval = None
    if config.members > 1:
        interval = _ensemble(data, config, result, progress)
    rows = data.validation_rows(result.model)
    validation = validated_error(rows.target, model_rows(result.model, rows))
    result.model.validation = replace(validation, interval=interval)
    if config.network == AUTO:
        _compare_kernel(data, spec, config, result, progress)


def _begin(result: FitResult, name: str) -> None:
    """Note the training that begins, for an interruption."""
    result.running = name, len(result.loss)


def _validated_epoch(result: FitResult) -> int:
    """Epoch after which the running training was validated last; 0: not yet."""
    name, before = result.running
    losses = result.loss[before:]
    return losses[-1][1] if losses and name != "kernel" else 0  # the kernel's are trials


def _take_interrupted(data: Data, result: FitResult, seconds: float) -> None:
    """Validate the model of an interrupted fit, and note where it was interrupted."""
    model, stage = result.model, result.running[0]
    finished = tuple(each.name for each in result.stages if each.kept and not each.reason)
    unproved = "".join(each.name for each in result.stages if each.reason == "interrupted")
    used, epoch = not finished, _validated_epoch(result)
    result.interrupted = Interruption(stage, epoch, used, finished, unproved)
    if isinstance(model.network, KernelArm):  # validated by its own cross-validation
        return
    model.rest_mm.copy_(rest_shape(data.train))
    if isinstance(model.network, RecurrentArm):
        predicted, measured = held_rows(model, data)
    else:
        rows = data.validation_rows(model)
        predicted, measured = model_rows(model, rows), rows.target
    error = validated_error(measured, predicted)
    model.validation = replace(error, interval=model.validation.interval)
    if used and error.rmse_mm is not None:
        report = StageReport(stage, error.rmse_mm, epoch, seconds, True, "interrupted")
        result.stages.append(report)


def _finish(data: Data, result: FitResult) -> None:
    """State a model's interval, noise and residuals, from its validation error on."""
    train, valid = data.train, data.valid
    _state_interval(data, result)
    validation = replace(result.model.validation, noise_mm=data.validation.noise_mm)
    result.model.validation = validation
    if validation.rmse_mm is None or not math.isfinite(validation.rmse_mm):
        raise InputError("the fit did not reach a finite error; check the recordings' key points")
    for number, value in enumerate(validation.per_key_point_mm):
        if value is None:
            result.warnings.append(f"key point k{number} is missing in all held-out rows")
    result.warnings += _left_unexplained(validation, [train] if valid is None else [train, valid])
    result.model.eval().requires_grad_(False)
    result.known = result.model.residuals_on([train] if valid is None else [train, valid])
    result.model.training_residuals = result.known
    known = FittedRows.of([train])
    if valid is not None:
        known = known.joined(FittedRows.of([valid], "chosen"))
    result.model.fitted_rows = known


def _left_unexplained(validation: Validation, seen: Sequence[History]) -> list[str]:
    """A note where a model leaves more of the motion than any model of the arm should.

    Its error, less the noise of the key points, is compared with their motion where it is largest:
    held-out rows may be near one posture.
    """
    points = [history.rows(history.key_points) for history in seen]
    motion = max(_rmse((each - each.nanmean(0)).square()) for each in points)
    error, noise = validation.rmse_mm or 0.0, math.sqrt(3.0) * (validation.noise_mm or 0.0)
    if math.sqrt(max(error**2 - noise**2, 0.0)) <= LEFT_OF_MOTION * motion:
        return []
    return [
        f"the model leaves {error:.3g} mm of a motion of {motion:.3g} mm, so the key points hardly "
        "follow the actuation in these recordings: check the clocks (delay_s in the map), that the "
        "files are of the same recording, and the columns; a long memory of the arm may be learned "
        "with --effects auto"
    ]


def _still_chambers(train: History, spec: ArmSpec) -> list[str]:
    """A note for each chamber that hardly moved in the training recordings.

    Raises InputError where none moved at all.
    """
    pressure = train.rows(train.pressure)
    moved = (pressure.amax(0) - pressure.amin(0)).tolist()
    if not max(moved):
        raise InputError(
            f"no chamber moves in the training recordings (all stay at {pressure[0].tolist()} "
            f"{spec.unit}), expected recordings of a moving arm; record a schedule such as that of "
            "'surgisoft collect'"
        )
    return [
        f"chamber {number} hardly moved ({moved_by:.3g} {spec.unit} in all): "
        "its influence cannot be learned from these recordings"
        for number, (moved_by, span) in enumerate(zip(moved, spec.span, strict=True), 1)
        if moved_by < STILL_SHARE * span
    ]


def _fit_recurrent(data: Data, spec, config, result: FitResult, progress) -> None:
    model = new_recurrent(spec)
    normalise(model.network, data.train)
    model.rest_mm.copy_(rest_shape(data.train))
    _begin(result, "recurrent")
    rate, seed = config.learning_rate, config.seed
    try:
        epochs = train_recurrent(model, data, config.epochs, rate, seed, result.loss, progress)
    except KeyboardInterrupt:
        if _validated_epoch(result):
            result.model = model
        raise
    predicted, measured = held_rows(model, data)
    model.validation = validated_error(measured, predicted)
    result.model = model
    error_mm = model.validation.rmse_mm
    assert error_mm is not None
    result.stages.append(StageReport("recurrent", error_mm, epochs, 0.0, True))


def check_config(config: FitConfig) -> None:
    """Raise InputError where settings of a fit are of a wrong type, out of range or of no effect.

    Names of effects are checked when the arm is known.
    """
    for name, (least, most) in WHOLE_NUMBERS.items():
        value = getattr(config, name)
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not whole or not least <= value <= most:
            raise InputError(
                f"'{name}' of a fit is {value_text(value)}, expected a whole number from {least} "
                f"to {most}"
            )
    rate = config.learning_rate
    if not (isinstance(rate, Real) and 0 < rate < math.inf) or isinstance(rate, bool):
        raise InputError(
            f"'learning_rate' of a fit is {value_text(rate)}, expected a finite number above 0"
        )
    if not isinstance(config.check_excitation, bool):
        raise InputError(
            f"'check_excitation' of a fit is {value_text(config.check_excitation)}, expected a "
            "boolean"
        )
    check_widths(config.hidden)
    effects = config.effects
    if not isinstance(effects, tuple | list) or not all(isinstance(x, str) for x in effects):
        raise InputError(
            f"'effects' of a fit is {value_text(effects)}, expected names of effects, such as "
            "['hysteresis']"
        )
    _check_network(config)


def _plain(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _check_network(config: FitConfig) -> None:
    """Raise InputError for an unknown network, or settings that the network does not have."""
    if config.network not in NETWORKS:
        raise unknown_name("network", str(config.network), NETWORKS)
    standard = FitConfig()
    set_by_user = [
        name
        for name in IGNORED.get(config.network, ())
        if _plain(getattr(config, name)) != getattr(standard, name)
    ]
    if config.network == "kernel" and config.prior == "none":
        set_by_user.append("prior")
    if set_by_user:
        names = ", ".join(OPTIONS.get(name, name) for name in set_by_user)
        raise InputError(
            f"the network {config.network} has no setting {names}: expected a fit without it; "
            "leave it out, or fit the network haw_nn"
        )


def _check(train: History, valid: History | None, spec: ArmSpec, config: FitConfig) -> None:
    check_config(config)
    if config.prior not in (None, *PRIORS):
        raise unknown_name("prior mean", str(config.prior), PRIORS)
    if config.prior == "arcs" and config.network not in (*GREY_BOXES, "kernel"):
        raise InputError(
            f"a prior mean needs the network haw_nn, not {config.network}; change one of the two"
        )
    if config.inputs not in INPUTS:
        raise unknown_name("inputs", config.inputs, INPUTS)
    known = known_effects()
    if config.members > 1 and config.network not in GREY_BOXES:
        raise InputError(
            f"an ensemble needs the network haw_nn, not {config.network}; change one of the two"
        )
    for name in config.effects:
        if name == AUTO:
            continue
        if name not in known:
            raise unknown_name("effect", name, known)
        if known[name].stage not in FRONT:
            raise InputError(
                f"{name} acts on the {known[name].stage}, behind the network: "
                f"fit without it, then 'surgisoft amend --effect {name}' adds it"
            )
    if config.effects and config.network not in GREY_BOXES:
        raise InputError(
            f"effects need the network haw_nn; {config.network} is fitted without any, and 'amend' "
            "or 'improve' adds them to it"
            if config.network == "kernel"
            else f"effects need the network haw_nn; the {config.network} baseline has none"
        )
    for history in (train, valid):
        if history is None:
            continue
        if not torch.isfinite(history.pressure).all():
            raise InputError("an actuation is not a finite number; check the recordings")
        if float(history.key_points.nan_to_num().abs().max()) > LARGEST_MM:
            raise InputError(
                f"a key point lies farther than {LARGEST_MM:g} mm from the base; check the "
                "recordings' units and outliers"
            )
        seen = int((~history.key_points.isnan()).all(-1).any(-1).sum())
        if seen < LEAST_ROWS:
            raise InputError(
                f"{seen} rows with key points, expected at least {LEAST_ROWS}; record more"
            )
    lost = train.key_points.isnan().any(-1).flatten(0, 1).all(0).nonzero().flatten().tolist()
    if lost:
        raise InputError(
            f"key point k{lost[0]} is missing in every row of the training recordings, expected "
            "measurements of it; give recordings that show it, or leave its columns out of them"
        )
    if train.chambers != spec.chambers:
        raise InputError(f"{train.chambers} chambers recorded, expected {spec.chambers}")


def _stages(config: FitConfig) -> list[str]:
    """Names of the stages in order; the direction comes last, after the effects with memory."""
    if config.network == "constant_curvature":
        return ["constant curvature"]
    names = ["pressure", *config.effects]
    if config.inputs == "pressure+direction":
        names.append("direction")
    return names


def _stage_epochs(name: str, stages: list[str], config: FitConfig) -> int:
    """Epochs of a stage: most for the last stage, few for those before it."""
    share = 1.0
    if name in config.effects:
        share = EFFECT_SHARE
    elif len(stages) > 1 and (name == "pressure" or any(x in config.effects for x in stages)):
        share = SIMPLE_SHARE
    return max(CHECK_EVERY, round(share * config.epochs))


@dataclass(frozen=True)
class _Support:
    """Which inputs the recordings support."""

    chambers: list[ChamberExcitation]
    minor_loops_validated: bool
    """Whether the validation data reverses inside the range in every chamber."""

    def use(self, name: str) -> Tensor:
        """(m,) 1 for each chamber whose direction or memory may be used, else 0.

        A memory needs inner reversals to be learned. A direction that was only seen in full
        sweeps may still be right: validation data with inner reversals decides.
        """
        lenient = name == "direction" and self.minor_loops_validated
        return torch.tensor(
            [float(x.direction if lenient else x.minor_loops) for x in self.chambers]
        )


def _supported(result: FitResult, name: str, config: FitConfig, support: _Support) -> bool:
    """Whether the recordings support a stage in any chamber; notes the unsupported chambers."""
    if name in ("pressure", "constant curvature", AUTO) or not config.check_excitation:
        return True
    if name != "direction" and not hypothesis_of(known_effects()[name]).needs_reversals:
        return True
    use = support.use(name)
    for chamber, used in zip(support.chambers, use, strict=True):
        if not used:
            result.warnings.append(f"{name} left out for {chamber.unsupported()}")
    return bool(use.any())


def _first(name: str, spec, config, data: Data, result: FitResult) -> ArmModel:
    """The untrained model of the first stage; notes why it has no prior mean where none was
    possible."""
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    if name == "constant curvature":
        sections = ConstantCurvature(low, high, spec.key_points, config.sections)
        sections.set_rest(rest_shape(data.train))
        return ArmModel(spec, sections)
    arcs = 0 if config.prior == "none" else arcs_of(data.train.rows(data.train.key_points))
    network = HawNN(low, high, spec.key_points, config.hidden, directions=False, arcs=arcs)
    if network.prior is not None:
        try:
            fit_prior_mean(network.prior, data.fitted, rest_shape(data.train))
        except InputError as why:
            if config.prior == "arcs":
                raise
            result.warnings.append(f"{why}; fitted without one")
            network = HawNN(low, high, spec.key_points, config.hidden, directions=False)
    normalise(network, data.train)
    return ArmModel(spec, network)


def _compare_alone(spec, epochs: int, config, data: Data, result: FitResult, progress) -> None:
    """Put the network alone in the place of the one with a prior mean where it does better.

    Beyond chance on the held-out rows, after the same training: arcs whose bends the recordings do
    not determine are off by more than a network.
    """
    model = result.model
    if model.network.prior is None:
        return
    begin, name = time.perf_counter(), "without prior mean"
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)  # the network of `prior="none"`
        network = HawNN(low, high, spec.key_points, config.hidden, directions=False)
    normalise(network, data.train)
    alone = ArmModel(spec, network)
    _begin(result, name)
    done = train_model(alone, data, name, epochs, config, result.loss, progress)
    before, after = _square(model, data), _square(alone, data)
    if not _better(before, after, data.validation_rows(alone).block)[0]:
        return
    alone.rest_mm.copy_(model.rest_mm)
    result.model = alone
    seconds = time.perf_counter() - begin
    result.stages.append(StageReport(name, _rmse(after), done, seconds, True, "", _rmse(before)))
    result.warnings.append(
        f"prior mean left out: held-out RMSE {_rmse(before):.4f} mm with it, {_rmse(after):.4f} mm "
        "without"
    )


def _grow(model: ArmModel, name: str, spec, config, support: _Support, data: Data) -> ArmModel:
    """The model with one stage more and an unchanged prediction."""
    use = support.use(name) if config.check_excitation else torch.ones(spec.chambers)
    grown = copy.deepcopy(model)
    if name == "direction":
        assert isinstance(grown.network, HawNN)
        return grown.replace(network=grown.network.with_directions(use))
    effect = make_effect(name, model.facts)
    effect.use_chambers(use)
    return grown.replace(effects={**grown.effects, name: effect})


def _stage(
    candidate, name: str, epochs: int, config, data: Data, result: FitResult, progress
) -> None:
    """Train one stage and accept it if it lowers the held-out error significantly.

    The comparison is with the simpler model trained for as many epochs, so that a gain must
    come from the addition and not from the training.
    """
    begin = time.perf_counter()
    _begin(result, name)
    try:
        done = train_model(candidate, data, name, epochs, config, result.loss, progress)
    except KeyboardInterrupt:
        if result.model is None and _validated_epoch(result):
            result.model = candidate
        elif result.model is not None:
            _keep_better(candidate, name, _validated_epoch(result), begin, data, result)
        raise
    after = _square(candidate, data)
    kept, reason, simpler_rmse = True, "", None
    if result.model is not None:
        simpler = copy.deepcopy(result.model)
        _begin(result, f"without {name}")
        try:
            train_model(simpler, data, f"without {name}", epochs, config, result.loss, progress)
        except KeyboardInterrupt:
            _keep_better(candidate, name, done, begin, data, result)
            raise
        before = _square(simpler, data)
        simpler_rmse = _rmse(before)
        kept, reason = _better(before, after, data.validation_rows(simpler).block)
        if not kept:
            result.warnings.append(f"{name} left out: {reason}")
        result.model = simpler
    if kept:
        result.model = candidate
    result.model.rest_mm.copy_(rest_shape(data.train))
    rmse = _rmse(after)
    seconds = time.perf_counter() - begin
    result.stages.append(StageReport(name, rmse, done, seconds, kept, reason, simpler_rmse))


def _keep_better(
    candidate, name: str, epochs: int, begin: float, data: Data, result: FitResult
) -> None:
    """Keep the model of an interrupted stage where it errs significantly less than that of the
    finished stages, by more than `UNPROVED`: it was not compared with the simpler model trained for
    as long."""
    before, after = _square(result.model, data), _square(candidate, data)
    better, _ = _better(UNPROVED * before, after, data.validation_rows(candidate).block)
    if epochs and better:
        result.model = candidate
        seconds = time.perf_counter() - begin
        report = StageReport(name, _rmse(after), epochs, seconds, True, "interrupted")
        result.stages.append(report)


def _add_memory(data: Data, spec, config, support: _Support, result: FitResult, progress) -> None:
    """Add the effects with memory that held-out data rewards most, one after another.

    Each candidate is trained together with the network for a share of the epochs, and so is the
    model without any. The best one then goes through a stage of its own, as if it had been named.
    """
    timed, known = _timed(data.train), known_effects()
    memory = {name: hypothesis_of(kind).memory for name, kind in known.items()}
    names = [name for name, of in memory.items() if of == "path" or (of and timed)]
    if not timed:
        result.warnings.append(
            "the rows have no clock, so that lags, rates and creep cannot show: not tried"
        )
    taken = set(result.model.effects)
    names = [
        name
        for name in names
        if name not in taken
        and (not hypothesis_of(known[name]).needs_reversals or support.use(name).any())
    ]
    epochs = max(CHECK_EVERY, round(TRIAL_SHARE * config.epochs))
    for _ in range(MOST_AUTO):
        if not names:
            return
        tried = {}
        for name in ("none", *names):
            candidate = copy.deepcopy(result.model)
            if name != "none":
                candidate = _grow(result.model, name, spec, config, support, data)
            label = name if name != "none" else "without effects"
            _begin(result, label)
            train_model(candidate, data, label, epochs, config, result.loss, progress)
            tried[name] = _rmse(_square(candidate, data))
        best = min(names, key=lambda name: tried[name])
        if tried[best] ** 2 > (1 - AUTO_GAIN) * tried["none"] ** 2:
            text = ", ".join(f"{name} {rmse:.3f}" for name, rmse in tried.items())
            result.warnings.append(f"no effect with memory added; held-out RMSE in mm: {text}")
            return
        candidate = _grow(result.model, best, spec, config, support, data)
        stage_epochs = max(CHECK_EVERY, round(EFFECT_SHARE * config.epochs))
        _stage(candidate, best, stage_epochs, config, data, result, progress)
        result.stages[-1].tried_mm = tried
        if not result.stages[-1].kept:
            return
        names.remove(best)


def _timed(history: History) -> bool:
    """Whether the rows have a clock: a recording of steady-state samples has none."""
    stood = history.stood
    return bool((history.dt_s > 0).any()) and (stood is None or bool(stood.isfinite().any()))


def _fit_kernel(data: Data, spec, config, result: FitResult, progress) -> None:
    """Fit kernel regression with memory and make it the result."""
    begin = time.perf_counter()
    found = _kernel(data, spec, config, result, progress)
    _take_kernel(found, data, result)
    error_mm = result.model.validation.rmse_mm
    assert error_mm is not None
    seconds = time.perf_counter() - begin
    result.stages.append(StageReport("kernel", error_mm, 0, seconds, True, settings=found.settings))


def _kernel(data: Data, spec, config, result: FitResult, progress) -> KernelFit:
    """Kernel regression with memory; adds its losses to the result."""
    _begin(result, "kernel")

    def report(trial: int, trials: int, loss: float) -> None:
        result.loss.append(("kernel", trial, loss, loss))
        if progress is not None:
            progress("kernel", trial, trials, loss)

    return fit_kernel(data, spec, _timed(data.train), config.seed, report)


def _take_kernel(found: KernelFit, data: Data, result: FitResult) -> None:
    """Make kernel regression the result, validated by cross-validation or validation recordings."""
    measured, predicted = found.measured_mm, found.predicted_mm
    if data.valid is not None:
        measured, predicted = _on_validation(found.model, data.valid)
    error = validated_error(measured, predicted)
    found.model.validation = replace(error, interval=found.interval)
    result.model = found.model


@torch.no_grad()
def _on_validation(model: ArmModel, valid: History) -> tuple[Tensor, Tensor]:
    """(S, n, 3) measured and predicted key points in mm of validation recordings."""
    seen = measured_rows(valid)
    return valid.rows(valid.key_points)[seen], valid.rows(model.predict(valid))[seen]


def _compare_kernel(data: Data, spec, config, result: FitResult, progress) -> None:
    """Put kernel regression in the place of the network if the held-out error is less with it."""
    begin = time.perf_counter()
    try:
        found = _kernel(data, spec, config, result, progress)
    except InputError as error:
        result.warnings.append(f"kernel regression not tried: {error}")
        return
    if data.valid is None:
        pair = found.measured_mm[found.held], found.predicted_mm[found.held]
    else:
        pair = _on_validation(found.model, data.valid)
    before, after = result.model.validation.rmse_mm, validated_error(*pair).rmse_mm
    assert before is not None
    assert after is not None
    kept = after < before
    reason = "" if kept else "the network has less held-out error"
    seconds = time.perf_counter() - begin
    result.stages.append(
        StageReport("kernel", after, 0, seconds, kept, reason, before, found.settings)
    )
    if kept:
        _take_kernel(found, data, result)


def _ensemble(data: Data, config, result: FitResult, progress) -> ErrorInterval | None:
    """Put an ensemble in the place of the network; returns the interval of its errors.

    The held-out rows do not choose between the two: they stopped the training of the single
    network, which may suit an unusual run that was held out and little else.

    The interval is calibrated with errors of single members, which are larger than those of their
    mean. The ratio of both errors on the held-out rows corrects it, key point by key point: noise
    is the same in both.
    """
    begin = time.perf_counter()
    epochs = max(CHECK_EVERY, round(MEMBER_SHARE * config.epochs))
    before = _rmse(_square(result.model, data))
    _begin(result, "ensemble")
    model, interval = train_ensemble(
        result.model, data, config.members, epochs, config, result.loss, progress
    )
    square = _square(model, data)
    after = _rmse(square)
    rows = data.validation_rows(model)
    with torch.no_grad():
        inputs = _network_inputs(model, rows)
        assert isinstance(model.network, HawEnsemble)
        single = (model.network.each(*inputs) - rows.target).square().flatten(0, 1)
    model.rest_mm.copy_(result.model.rest_mm)
    result.model = model
    name, seconds = f"{config.members} members", time.perf_counter() - begin
    result.stages.append(StageReport(name, after, epochs, seconds, True, "", before))
    if interval is None:
        return None
    ratio = square.sum(-1).nanmean(0) / single.sum(-1).nanmean(0)
    return interval.scaled(ratio.sqrt().nan_to_num(1.0, posinf=1.0).tolist())


def _network_inputs(model: ArmModel, rows: Rows) -> tuple[Tensor, Tensor]:
    """(S, m) actuation and direction in front of the network in rows."""
    taps = Taps(rows.pressure, rows.direction, rows.memory, {})
    effects = model.stage("material")
    return (
        model.chain.around(effects[-1][0], taps)[1] if effects else rows.pressure
    ), rows.direction


def _state_interval(data: Data, result: FitResult) -> None:
    """Calibrate the interval on the held-out rows, or measure its coverage there.

    The coverage is measured where other rows calibrated the interval: those that members of an
    ensemble left out, or all rows of the training where there are validation recordings. Kernel
    regression takes part in all rows of the training, so nothing is measured without these.
    """
    model = result.model
    interval = model.validation.interval
    if interval is not None and isinstance(model.network, KernelArm) and data.valid is None:
        return
    history, span = data.validation, torch.tensor(model.spec.span)
    with torch.no_grad():
        error = (model.predict(history) - history.key_points).norm(dim=-1)
    held = history.valid if data.held is None else data.held
    held = held & ~history.key_points.isnan().any(-1).all(-1)
    fitted = data.train.pressure[data.train.valid if data.held is None else ~data.held]
    thin = fitted[:: max(1, -(-len(fitted) // ROWS))]
    distance = distance_to(history.pressure[held], thin, span)
    if interval is not None:
        result.covered = coverage_of(error[held], interval.radius_mm(distance))
        return
    group = dealt(history)[held[history.valid]]
    interval = calibrate(error[held], distance, group, "held-out rows")
    model.validation = replace(model.validation, interval=interval)


def _rmse(square: Tensor) -> float:
    """RMS distance in mm, from squared errors (S, n, 3) in mm^2, NaN where missing."""
    return math.sqrt(float(square.sum(-1).nanmean()))


def _square(model: ArmModel, data: Data) -> Tensor:
    """(S, n, 3) squared error in mm^2 on the validation rows; NaN where missing."""
    rows = data.validation_rows(model)
    return (model_rows(model, rows) - rows.target).square()


def _better(before: Tensor, after: Tensor, block: Tensor) -> tuple[bool, str]:
    """Whether the squared error (S, n, 3) fell beyond chance, with its blocks as the samples.

    One-sided test at 2.5 % by Student's t over the blocks: with few blocks the threshold is high.
    """
    gain = (before - after).nanmean(dim=(1, 2)).nan_to_num()
    blocks = int(block.max()) + 1
    total = torch.zeros(blocks).index_add(0, block, gain)
    mean = float(gain.mean())
    if blocks < LEAST_BLOCKS:
        return False, (
            f"the held-out data is too short to decide ({len(gain)} rows, {blocks} blocks of time, "
            f"at least {LEAST_BLOCKS} needed); give more with --valid"
        )
    error = float((total - total.mean()).square().sum().sqrt()) / len(gain)
    error *= math.sqrt(blocks / (blocks - 1))
    if mean > float(stdtrit(blocks - 1, 0.975)) * error:
        return True, ""
    scale = max(float(before.nanmean()), 1e-12)
    advice = "; more held-out data (--valid) may decide it" if mean > error else ""
    return False, (
        f"the held-out squared error changes by {-mean / scale:+.1%} (standard error "
        f"{error / scale:.1%}), which is no gain beyond chance{advice}"
    )
