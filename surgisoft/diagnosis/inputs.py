"""The inputs of every command: a model, recordings, the identification problem built from them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from surgisoft.diagnosis.other_models import notes_of
from surgisoft.diagnosis.residuals import Problem, Sealed, held_out_rows, residual_table
from surgisoft.diagnosis.weight import under_weight
from surgisoft.errors import InputError
from surgisoft.measurement.histories import (
    check_fits,
    faster_than_fit,
    history_of,
    outside_range,
)
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.measurement.recordings.quality import context_varies, moves_alone
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.effects import check_user_effects
from surgisoft.surrogate.fitted_rows import Seen
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import TrainingResiduals

Model = ArmModel | str | Path | Callable
"""A model, its folder, a callable, the name of one, or a file of predictions (`open_model`)."""
Recordings = Iterable[Recording | str | Path] | Recording | str | Path
"""Recordings, their files, or folders of them."""


def open_inputs(
    model: ArmModel | str | Path,
    recordings: Recordings,
    sized: bool = True,
    compared: bool = False,
    tried: bool = True,
) -> tuple[ArmModel, list[Recording], tuple[str, ...]]:
    """The model and the recordings as a diagnosis takes them, with notes for its reader.

    A model whose recordings were made with another direction of gravity is given loads of any
    direction (`under_weight`); the notes say so, and say where the recordings leave the range or
    the speed of the actuation that the model was fitted to. sized: whether the size of the arm has
    to fit, too; compared: whether they are compared with recordings from before a change, so that
    what the model lacked before does not count; tried: whether effects are to be tried on the arm.
    Those of named files are checked on it then, and whatever fails is an InputError.
    """
    arm = load_model(model)
    measured = load_recordings(recordings)
    check_fits(arm.spec, measured, sized)
    if (alone := moves_alone(measured)) and not any(map(context_varies, measured)):
        raise InputError(f"{measured[0].label}: {alone}, and import again")
    if tried:
        check_user_effects(arm.facts, tried=True)
    turned, notes = under_weight(arm, measured)
    taken_part = part_in_fit(arm, measured)
    beyond = outside_range(arm.spec, measured)
    if not compared:
        beyond += faster_than_fit(arm.spec, measured)
    return turned, measured, (*notes_of(arm), *notes, *beyond, *taken_part)


def part_in_fit(model: ArmModel, recordings: list[Recording]) -> tuple[str, ...]:
    """A note for each recording that the model was fitted to, in whole or in part.

    Errors there are errors of the fit and no test of the model.
    """
    return tuple(
        f"{recording.name}: {seen.words}: the error there is no test; "
        + (
            "further effects may be sought there, and only other recordings test the model"
            if seen.effects_alone
            else "use recordings that took no part in the fit"
        )
        for recording, seen in zip(recordings, seen_in_fit(model, recordings), strict=True)
        if seen
    )


def seen_in_fit(model: ArmModel, recordings: Iterable[Recording]) -> list[Seen]:
    """What the model has seen of each recording.

    Rows are recognised by their content (`FittedRows`). Nothing where the model keeps no record.
    """
    known = model.fitted_rows
    if known is None:
        return [Seen({}) for _ in recordings]
    return [
        known.seen_of(history_of([each], model.spec.actuation), held_out_rows([each]))
        for each in recordings
    ]


def refuse_amended(
    model: ArmModel, recordings: Iterable[Recording], before: Iterable[Recording]
) -> None:
    """Raise InputError where effects of the model were fitted to recordings after a change that are
    to be compared with those before it.

    Such a model predicts both sides with these effects, so all that was explained would be found
    once more.
    """
    recordings = list(recordings)
    for recording, seen in zip(recordings, seen_in_fit(model, recordings), strict=True):
        if seen.effects_in_words:
            names = " + ".join(each.name for each in before)
            raise InputError(
                f"{recording.label}: {seen.effects_in_words}, expected a model from before the "
                f"change: compared with {names}, what these effects explain would be found again; "
                "leave out --before, or run 'surgisoft improve' on the model as it was before "
                "these effects were added"
            )


def refuse_rows_of_fit(model: ArmModel, recordings: Iterable[Recording]) -> None:
    """Raise InputError unless the recordings are known to have taken no part in the model's fit."""
    recordings = list(recordings)
    for recording, seen in zip(recordings, seen_in_fit(model, recordings), strict=True):
        if seen:
            raise InputError(
                f"{recording.label}: {seen.words}, expected a recording that took no part in the "
                "fit; give another one, or leave out --test to see the error of the fit"
            )
    if model.fitted_rows is None or not model.fitted_rows.complete:
        raise InputError(
            "the model keeps no record of all rows that it was fitted to, expected one that does "
            "for a test: whether the model has seen the recordings is not known; leave out --test"
        )


def held_out_in_fit(model: ArmModel, recordings: list[Recording], held_out: np.ndarray) -> float:
    """Share 0..1 of the held-out rows (N,) bool of recordings that the model was fitted to.

    Nothing but the hash of these rows is looked at.
    """
    known = model.fitted_rows
    if known is None:
        return 0.0
    return known.part_of(history_of(recordings, model.spec.actuation), held_out)


def identification_problem(
    model: ArmModel,
    recordings: list[Recording],
    reference: Sequence[Recording] | TrainingResiduals | None = None,
) -> Problem:
    """The training rows of a model's residual table, with its residuals from before.

    reference: recordings from before something changed. Without them the residuals that the model
    keeps of its own fit (`ArmModel.training_residuals`), where it has them.
    """
    table = residual_table(model, Sealed(recordings).training)
    return with_known_residuals(table.training(), reference)


def with_known_residuals(
    problem: Problem, reference: Sequence[Recording] | TrainingResiduals | None = None
) -> Problem:
    """The problem with the residuals of a reference, or those that its model keeps of its fit."""
    known = problem.model.training_residuals if reference is None else reference
    return problem if known is None else problem.with_reference(known)
