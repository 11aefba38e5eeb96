"""Inputs of commands, with warnings on standard error."""

from collections.abc import Iterable
from pathlib import Path

import typer

from surgisoft.errors import InputError, unknown_name

IN_A_MAP = "as lines of a map that reads the recording, not its raw files"
"""Where the lines of a map belong that correct a set-up."""


def warn(text: str) -> None:
    """Print one line of warning on standard error."""
    typer.echo(f"surgisoft: warning: {text}", err=True)


def check_model(folder: Path, predictions: list[Path] | None = None) -> None:
    """Raise InputError where there is no model, before anything is loaded that takes seconds.

    predictions: files of predictions, for which the model is but a name.
    """
    text = str(folder)
    if predictions:
        if text == "default" or (folder / "config.json").is_file():
            raise InputError(
                f"{folder}: is a model, and --predictions takes the place of one; expected a name "
                "for the model that made them, or no --predictions"
            )
        return
    if text == "default" or (folder / "config.json").is_file():
        return
    if folder.suffix in (".csv", ".parquet") and folder.is_file():
        return
    if ":" in text and not folder.exists():
        return
    if not folder.exists():
        from surgisoft.surrogate.callables.named import offered

        if text in offered():
            return
    raise InputError(
        f"{folder}: no arm model there (config.json is missing); expected 'default', a folder "
        "that 'surgisoft fit' made, package.module:object or FILE.py:object of a callable, or a "
        "file of predictions (docs/your_model.md)"
    )


def leading_models(given: list[Path]) -> tuple[list[Path], list[Path]]:
    """Models and recordings of a list of both, models first.

    A model is a folder with a config.json, `default`, or the name of a callable. Raises InputError
    for a model behind a recording, and where no recording is left.
    """
    count = 0
    while count < len(given) and _is_model(given[count]):
        count += 1
    models, recordings = given[:count], given[count:]
    for path in recordings:
        if _is_model(path):
            raise InputError(f"{path}: a model after a recording; give all models first")
    if not recordings:
        raise InputError(
            f"{' '.join(map(str, given))}: models only; expected recordings (.csv, .parquet) or "
            "folders of them after the models"
        )
    return models, recordings


def _is_model(path: Path) -> bool:
    if ":" in str(path) or str(path) == "default":
        return not path.exists()
    return (path / "config.json").is_file()


def read_recordings(paths: Iterable[Path]) -> list:
    """The recordings in files and folders; prints data-quality warnings."""
    from surgisoft.measurement.recordings import load_recordings

    return load_recordings(paths, on_warning=warn)


def read_before(paths: list[Path] | None, paired: str) -> list | None:
    """The recordings of `--before`; None without them. paired: value of `--paired`."""
    from surgisoft.diagnosis.pairs import PAIRED

    if paired not in PAIRED:
        raise unknown_name("value of --paired", paired, PAIRED)
    if not paths and paired != "auto":
        raise InputError(f"--paired {paired}: nothing to pair with; add --before REC")
    return read_recordings(paths) if paths else None


def read_context(path: Path | None):
    """The context of a credibility report; None where no file is given."""
    if path is None:
        return None
    from surgisoft.credibility.context import load_context

    return load_context(path)


def warn_all(notes: Iterable[str]) -> None:
    """Print each note of a result as a line of warning."""
    for note in notes:
        warn(note)
