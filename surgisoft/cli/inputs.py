"""Inputs of commands, with warnings on standard error."""

from collections.abc import Iterable
from pathlib import Path

import typer

from surgisoft.errors import InputError, unknown_name


def warn(text: str) -> None:
    """Print one line of warning on standard error."""
    typer.echo(f"surgisoft: warning: {text}", err=True)


def check_model(folder: Path) -> None:
    """Raise InputError where there is no model, before anything is loaded that takes seconds."""
    if str(folder) != "default" and not (folder / "config.json").is_file():
        raise InputError(
            f"{folder}: no arm model there (config.json is missing); expected 'default' or a "
            "folder that 'surgisoft fit' made"
        )


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


def counted(number: int, thing: str) -> str:
    """Number and noun: `1 episode`, `2,000 episodes`."""
    return f"{number:,} {thing}" if number == 1 else f"{number:,} {thing}s"


def warn_all(notes: Iterable[str]) -> None:
    """Print each note of a result as a line of warning."""
    for note in notes:
        warn(note)
