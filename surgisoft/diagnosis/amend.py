"""`amend`: put a named effect into a model and say what it is worth on data that took no part.

Fitted is on the open three quarters of the recordings; the locked quarter is looked at once, for
the error before and after. A fall is claimed only where its interval, from a bootstrap of blocks
of time, leaves out zero and where it is worth having.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

import numpy as np

from surgisoft.diagnosis.estimation.effects import fit_effects
from surgisoft.diagnosis.estimation.intervals import Parameter
from surgisoft.diagnosis.estimation.network import retune
from surgisoft.diagnosis.inputs import Model, Recordings, open_inputs
from surgisoft.diagnosis.problem import Problem, pose
from surgisoft.surrogate.effects import named_effect
from surgisoft.surrogate.model import ArmModel
from surgisoft.workers import torch_threads

LEAST_FALL = 0.05
"""Least fall of the error that is claimed, as a share of what stands above the noise floor."""
DRAWS = 2000
"""Draws of the bootstrap."""
EVERY_ROW = 10**9
"""More rows than any recording has: the final check leaves none out."""

Progress = Callable[[str], None]
"""Called with what is being done."""


@dataclass(frozen=True)
class Fall:
    """The error of two models on the same rows, which took no part in their fits."""

    before: float
    """RMS distance of a key point by the old model, mm."""
    after: float
    """The same by the new model, mm."""
    floor: float
    """RMS measurement noise, mm."""
    fall: float
    """Before less after, mm."""
    ci95: tuple[float, float]
    """95 % interval of the fall by blocks of time, mm."""
    rows: int
    """Rows that judged."""
    blocks: int
    """Blocks of time that they make."""

    @property
    def claimed(self) -> bool:
        """Whether the fall is beyond chance and worth having."""
        room = max(self.before - self.floor, 0.1 * self.before)
        return self.ci95[0] > 0 and self.fall >= LEAST_FALL * room

    @property
    def sentence(self) -> str:
        """The fall in words."""
        low, high = self.ci95
        numbers = (
            f"{self.before:.3f} to {self.after:.3f} mm on data that took no part "
            f"(fall {self.fall:.3f} mm, 95 % {low:.3f} to {high:.3f}; floor {self.floor:.3f} mm)"
        )
        if self.claimed:
            return f"error {numbers}"
        why = "is too little" if low > 0 else "is not beyond chance"
        return f"no fall of the error is claimed: {numbers} {why}"


@dataclass(frozen=True, eq=False)
class Track:
    """The error along the recordings, for pictures."""

    time_s: np.ndarray
    """(S,) time in the recording, s."""
    before_mm: np.ndarray
    """(S,) RMS distance over the key points by the old model, mm; NaN where not measured."""
    after_mm: np.ndarray
    """(S,) the same by the new one."""
    start: np.ndarray
    """(S,) bool: first row of a run."""


@dataclass(frozen=True, eq=False)
class Amendment:
    """An amended model and what it is worth."""

    model: ArmModel
    """The new model, which shares nothing with the old one."""
    effects: tuple[str, ...]
    """The effects asked for."""
    refitted: tuple[str, ...]
    """Those that the model had before: their parameters were fitted anew."""
    parameters: tuple[Parameter, ...]
    """The fitted parameters in physical units."""
    locked: Fall
    """The error on the locked quarter."""
    alone: Fall
    """The same by the effects alone, the network left as it was."""
    opened: Fall
    """The error on the open part, to which the parameters were fitted."""
    retuned: bool
    """Whether the network's last layer was re-tuned too."""
    tracks: tuple[Track, Track]
    """The error along the open and along the locked part."""
    seconds: float
    """Time that it took, s."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""

    @property
    def claimed(self) -> bool:
        """Whether a fall of the error is claimed for the effects, and for the new model."""
        return self.alone.claimed and self.locked.claimed

    @property
    def sentence(self) -> str:
        """The outcome in words."""
        said = f"{' + '.join(self.effects)}: {self.alone.sentence}"
        if not self.retuned:
            return said
        return f"{said}; {self.locked.after:.3f} mm with the network's last layer re-tuned behind"

    def to_json(self) -> dict:
        """Plain values, as `amend --json` writes them and as the new model's folder keeps them."""
        locked, opened = self.locked, self.opened
        return {
            "effects": list(self.effects),
            "refitted": list(self.refitted),
            "claimed": self.claimed,
            "sentence": self.sentence,
            "error_mm": asdict(locked) | {"ci95": list(locked.ci95)},
            "error_effects_alone_mm": asdict(self.alone) | {"ci95": list(self.alone.ci95)},
            "error_open_mm": asdict(opened) | {"ci95": list(opened.ci95)},
            "parameters": [parameter.to_json() for parameter in self.parameters],
            "network_retuned": self.retuned,
            "notes": list(self.notes),
            "seconds": self.seconds,
        }


@torch_threads(1)
def amend(
    model: Model,
    recordings: Recordings,
    effects: str | Iterable[str],
    retune_network: bool = True,
    progress: Progress | None = None,
) -> Amendment:
    """The model with the named effects fitted to the recordings; the given model stays as it is.

    Model and recordings may be given by their paths.

    effects: names, or files of user-defined effects (`my_effect.py`), which are run.
    retune_network: also re-tune the network's last layer, where held-out motion rewards it and the
    effects alone make the error fall.
    """
    begin = time.perf_counter()
    tell = progress or (lambda text: None)
    names = [named_effect(given) for given in ([effects] if isinstance(effects, str) else effects)]
    model, recordings, notes = open_inputs(model, recordings)
    tell("predicting")
    problem = pose(model, recordings, part="open")
    tell(f"fitting {' + '.join(names)}")
    fitted = fit_effects(problem, names)
    better, retuned = fitted.model, False
    if retune_network:
        tell("re-tuning the network")
        tried = retune(better, problem)
        better, retuned = tried.model, tried.kept
    tell("judging on the locked part")
    locked = pose(model, recordings, EVERY_ROW, part="locked")
    alone = fall_of(locked, locked.with_model(fitted.model))
    if retuned and not (alone.claimed and fall_of(locked, locked.with_model(better)).claimed):
        better, retuned = fitted.model, False
    # The residuals of the fit say nothing of a network that was re-tuned since.
    better.training_residuals = None if retuned else model.training_residuals
    pairs = [(part, part.with_model(better)) for part in (problem, locked)]
    return Amendment(
        model=better,
        effects=tuple(dict.fromkeys(names)),
        refitted=fitted.refitted,
        parameters=fitted.parameters,
        locked=fall_of(*pairs[1]),
        alone=alone,
        opened=fall_of(*pairs[0]),
        retuned=retuned,
        tracks=(track_of(*pairs[0]), track_of(*pairs[1])),
        seconds=time.perf_counter() - begin,
        notes=notes,
    )


def fall_of(before: Problem, after: Problem, seed: int = 0) -> Fall:
    """The fall of the error between two models on the same rows, with its interval."""
    count = np.bincount(before.block, weights=np.isfinite(before.residual).all(2).sum(1))
    sums = [
        np.bincount(before.block, weights=np.nansum(np.square(problem.residual), axis=(1, 2)))
        for problem in (before, after)
    ]
    rng = np.random.default_rng(seed)
    blocks = len(count)
    drawn = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=DRAWS)
    levels = [np.sqrt(drawn @ each / np.maximum(drawn @ count, 1)) for each in sums]
    low, high = np.quantile(levels[0] - levels[1], [0.025, 0.975])
    rmse = [float(np.sqrt(each.sum() / count.sum())) for each in sums]
    return Fall(
        before=rmse[0],
        after=rmse[1],
        floor=float(np.sqrt(np.mean(before.noise_mm**2))),
        fall=rmse[0] - rmse[1],
        ci95=(float(low), float(high)),
        rows=len(before.index),
        blocks=blocks,
    )


def track_of(before: Problem, after: Problem) -> Track:
    """The error of two models along the same rows."""
    seen = np.isfinite(before.residual).all(2)
    count = np.where(seen.any(1), seen.sum(1), np.nan)
    levels = [
        np.sqrt(np.nansum(np.square(problem.residual), axis=(1, 2)) / count)
        for problem in (before, after)
    ]
    run = before.history.run_of_row[before.index].numpy()
    return Track(before.time_s, *levels, np.diff(run, prepend=-1) != 0)
