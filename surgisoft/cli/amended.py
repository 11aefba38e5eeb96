"""Parts that `amend` and `improve` share: the folder of the new model and what is printed."""

from pathlib import Path

from surgisoft.errors import InputError
from surgisoft.files import resolved

NOT_CLAIMED = 1
"""Exit code where the held-out error did not fall significantly."""


def claim_other_folder(output: Path, model: Path, force: bool) -> None:
    """Raise InputError unless a new model may be written there; it must not be the one that is
    read."""
    from surgisoft.surrogate.checkpoint import claim_folder

    if resolved(output) == resolved(model):
        raise InputError(
            f"{output}: is the folder of the model to amend; choose another one for the result"
        )
    claim_folder(output, force)


def write_before_and_after(result, tables: dict, name: str, file: Path) -> Path:
    """Write the replay of the old and the new model, by their residuals on the same recordings."""
    from surgisoft.replay.model_error import write_models

    names = ", ".join(tables["before"].names)
    write_models(tables, f"{name} before and after on {names}", file, result.sentence)
    return file


def show_parameters(parameters, in_words: dict[str, str]) -> None:
    """Print the fitted parameters, one per line, what they mean, and which are implausible."""
    from surgisoft.diagnosis.estimation.intervals import values_text

    for each in parameters:
        unit = f" {each.unit}" if each.unit else ""
        interval = f" ({each.interval_text})" if each.interval_text else ""
        former = "" if each.before is None else f", before {values_text(each.before)}{unit}"
        print(f"  {each.effect}: {each.name} = {values_text(each.value)}{unit}{interval}{former}")
    for name, words in in_words.items():
        if words:
            print(f"{name}: {words}")
    for each in parameters:
        if not each.plausible:
            low, high = each.plausible_range
            unit = f" {each.unit}" if each.unit else ""
            reaches = ""
            if each.may_be_plausible:
                reaches = "; the 95 % interval reaches plausible values"
            print(
                f"implausible: {each.effect} {each.name} = {values_text(each.value)}, expected "
                f"{values_text(low)} to {values_text(high)}{unit} ({each.source}){reaches}"
            )
