"""The inputs of every command: a model, recordings, the identification problem built from them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from surgisoft.diagnosis.other_models import notes_of
from surgisoft.diagnosis.residuals import Problem, Sealed, residual_table
from surgisoft.diagnosis.weight import under_weight
from surgisoft.measurement.histories import check_fits, history_of, outside_range
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import TrainingResiduals

LEAST_KNOWN = 0.02
"""Least share of a recording's rows in the fit of a model that is reported."""

Model = ArmModel | str | Path | Callable
"""A model, its folder, a callable, the name of one, or a file of predictions (`open_model`)."""
Recordings = Iterable[Recording | str | Path] | Recording | str | Path
"""Recordings, their files, or folders of them."""


def open_inputs(
    model: ArmModel | str | Path, recordings: Recordings, sized: bool = True
) -> tuple[ArmModel, list[Recording], tuple[str, ...]]:
    """The model and the recordings as a diagnosis takes them, with notes for its reader.

    A model whose recordings were made with another direction of gravity is given loads of any
    direction (`under_weight`); the notes say so, and say where the recordings leave the range of
    actuation that the model was fitted to. sized: whether the size of the arm has to fit, too.
    """
    arm = load_model(model)
    measured = load_recordings(recordings)
    check_fits(arm.spec, measured, sized)
    turned, notes = under_weight(arm, measured)
    taken_part = part_in_fit(arm, measured)
    beyond = outside_range(arm.spec, measured)
    return turned, measured, (*notes_of(arm), *notes, *beyond, *taken_part)


def part_in_fit(model: ArmModel, recordings: list[Recording]) -> tuple[str, ...]:
    """A note for each recording that the model was fitted to, in whole or in part.

    Errors there are errors of the fit and no test of the model.
    """
    known = model.fitted_rows
    if known is None:
        return ()
    notes = []
    for recording in recordings:
        share = known.share_of(history_of([recording], model.spec.actuation))
        if share >= LEAST_KNOWN:
            notes.append(
                f"{recording.name}: the model was fitted to {100 * share:.0f} % of its rows: the "
                "error there is no test; use recordings that took no part in the fit"
            )
    return tuple(notes)


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
