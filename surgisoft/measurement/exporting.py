"""Export an arm model for other programs, compared with the model on recordings."""

from pathlib import Path

from surgisoft.measurement.fitting import Recordings
from surgisoft.measurement.histories import check_fits, history_of
from surgisoft.measurement.recordings import load_recordings
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.effects import free_name
from surgisoft.surrogate.export import export_arm as export_histories
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel


def export_arm(
    model: ArmModel | str | Path,
    folder: str | Path,
    recordings: Recordings = (),
    force: bool = False,
) -> list[Path]:
    """Write an arm model as ONNX and TorchScript into a new folder; returns the files.

    A model around a Python callable is written as one file of NumPy code that calls it, `arm.py`.

    The files map actuation in the model's unit to key points in mm in the arm base frame;
    `arm.json` states every name, order, unit and range. Raises InputError where the folder is in
    use, where the model cannot be written, for recordings of another arm, and where a file differs
    from the model by more than `surgisoft.surrogate.export.TOLERANCE_MM`.

    model: a model, its folder, or the name of a callable that states its range. recordings: over
    whose rows files and model are compared too (`surgisoft.surrogate.export.differences`). force:
    replace an earlier export of an arm model.
    """
    none = isinstance(recordings, list | tuple) and not recordings
    arm, measured = load_model(model), [] if none else load_recordings(recordings)
    check_fits(arm.spec, measured)
    names, histories = [each.name for each in measured], dict[str, History]()
    for each in measured:
        called = each.name if names.count(each.name) == 1 else each.label
        histories[free_name(called, histories)] = history_of([each], arm.spec.actuation)
    return export_histories(arm, folder, histories, force)
