"""Fit an arm model to recordings: system identification with a grey-box model."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surgisoft.errors import InputError
from surgisoft.measurement.histories import (
    actuation_of,
    arm_spec,
    check_fits,
    history_of,
    moved_together,
)
from surgisoft.measurement.jumps import Motion, own_level_mm
from surgisoft.measurement.noise import hold_noise, stated_noise
from surgisoft.measurement.recordings import Recording, check_same_arm, load_recordings
from surgisoft.surrogate.effects import named_effects
from surgisoft.surrogate.fit import AUTO, FitConfig, FitResult, check_config
from surgisoft.surrogate.fit import fit as fit_histories
from surgisoft.surrogate.fitted_rows import FittedRows, row_hashes
from surgisoft.surrogate.model import ArmModel
from surgisoft.workers import torch_threads

Recordings = Iterable[Recording | str | Path] | Recording | str | Path
"""Recordings, their files, or folders of them."""
SAME_ROWS = 0.1
"""Least share of the rows of the shorter of two recordings that both have, from which on they are
the same measurement under two names. A row at rest before coarse sensors, which many recordings
share, is less than that."""
SHORT_FIT_S = 120.0
"""Duration of continuous recordings below which a fit notes that they are short [s]: fewer than 24
motions of five seconds, which `diagnose` calls few data, too."""


def fit(
    recordings: Recordings,
    valid: Recordings | None = None,
    config: FitConfig | None = None,
    *,
    actuation: str = "measured",
    threads: int = 1,
    progress: Callable[[str, int, int, float], None] | None = None,
    **fields: Any,
) -> FitResult:
    """Fit an arm model (HAW-NN, optionally with effects) to recordings of one arm.

    The model (Chen et al. 2025) maps actuation (T, m), in the recordings' unit, to key points
    (T, n, 3) mm in the arm base frame. Raises InputError where the recordings are of different
    arms, too short, have rows in common, or hold numbers that are not finite, and for settings that
    are out of range or that the network does not have. Ctrl-C raises `Interrupted`
    (`surgisoft.errors`), whose `result` has the best model so far, or KeyboardInterrupt before the
    first validation.

    Returns the model with the account of its fit; `save_model(result.model, folder,
    result.report())` writes both.

    valid: held-out recordings that choose the model; without them whole runs, or blocks of time,
    of the training recordings are held out.
    actuation: `measured` or `commanded`, what the model takes.
    threads: threads of torch; their number changes the last digits.
    progress: called with (stage, epoch, epochs, held-out loss in mm^2).
    fields: fields of `FitConfig`, such as `effects=["hysteresis"]`, `epochs=100`. An effect may be
    the path of a file with a user-defined one, which is run.
    """
    config = replace(config or FitConfig(), **fields)
    if isinstance(config.effects, str):
        config = replace(config, effects=(config.effects,))
    check_config(config)
    effects = config.effects
    names = iter(named_effects(name for name in effects if name != AUTO))
    chosen = tuple(name if name == AUTO else next(names) for name in effects)
    config = replace(config, effects=chosen, hidden=tuple(config.hidden))
    train = load_recordings(recordings)
    held = None if valid is None else load_recordings(valid)
    check_same_arm(train)
    spec = arm_spec(train, actuation)
    if not held:
        _refuse_repeated_rows(train, actuation)
    else:
        check_fits(spec, held)
        _refuse_training_rows(train, held, actuation)
    with torch_threads(threads):
        result = fit_histories(
            history_of(train, actuation),
            history_of(held, actuation) if held else None,
            spec,
            config,
            progress,
        )
        model = result.model
        model.validation = replace(model.validation, jump_mm=jump_level(model, train))
    result.warnings.extend(_short(train))
    if like := moved_together(np.concatenate([actuation_of(each, actuation) for each in train])):
        result.warnings.append(
            f"{like}: what each of them does alone cannot be learned from these recordings"
        )
    return result


def _short(train: list[Recording]) -> list[str]:
    """A note where the training recordings are too short to show how the arm moves."""
    if any(recording.kind != "continuous" for recording in train):
        return []
    runs = [recording.t_s[run] for recording in train for run in recording.runs]
    seconds = float(sum(t_s[-1] - t_s[0] for t_s in runs))
    if seconds >= SHORT_FIT_S:
        return []
    return [
        f"the recordings last {seconds:.0f} s in all, expected two minutes or more, better ten: "
        "the held-out rows resemble those of the training, and on other motions the error may be "
        "many times as large"
    ]


@torch.no_grad()
def jump_level(model: ArmModel, recordings: list[Recording]) -> float:
    """Level of the jumps that an arm makes by itself in recordings, mm (`jumps.own_level_mm`).

    An arm that jumps by itself, as by friction, does so before and after a change.
    """
    some = [recording for recording in recordings if recording.kind == "continuous"]
    if not some:
        return 0.0
    spec = model.spec
    history = history_of(some, spec.actuation)
    noise = stated_noise(some) or hold_noise(some) or 0.0
    measured = np.concatenate([recording.key_points_mm for recording in some])
    motion = Motion(
        t_s=history.rows(history.t_s).numpy(),
        run=history.run_of_row.numpy(),
        measured_mm=measured,
        predicted_mm=history.rows(model.predict(history)).double().numpy(),
        actuation=history.rows(history.pressure).double().numpy(),
        noise_mm=np.full(spec.key_points, math.sqrt(3.0) * noise),
    )
    return own_level_mm(motion)


def _refuse_repeated_rows(train: list[Recording], actuation: str) -> None:
    """Raise InputError where two training recordings are the same measurement.

    Rows that are held out would be among the rows of the training, too.
    """
    rows = [np.unique(row_hashes(history_of([recording], actuation))) for recording in train]
    values, counts = np.unique(np.concatenate(rows), return_counts=True)
    repeated = values[counts > 1]
    for later, found in enumerate(rows):
        own = np.intersect1d(found, repeated, assume_unique=True)
        for earlier in range(later if len(own) else 0):
            common = len(np.intersect1d(own, rows[earlier], assume_unique=True))
            if common >= max(1, SAME_ROWS * min(len(found), len(rows[earlier]))):
                raise InputError(
                    f"{train[later].label}: {100 * common / len(found):.0f} % of its rows are in "
                    f"{train[earlier].label}, expected recordings without common rows, because "
                    "rows that are held out must take no part in the training; give one of the two"
                )


def _refuse_training_rows(train: list[Recording], held: list[Recording], actuation: str) -> None:
    """Raise InputError where held-out recordings have rows of the training recordings."""
    known = FittedRows.of([history_of(train, actuation)])
    for recording in held:
        share = known.part_of(history_of([recording], actuation))
        if share:
            raise InputError(
                f"{recording.label}: {100 * share:.0f} % of its rows are in the training "
                "recordings, expected held-out recordings that take no part in the training; give "
                "another one, or none: then a part of the training recordings is held out"
            )
