"""What commands read, with the warnings about it on standard error."""

from collections.abc import Iterable
from pathlib import Path

import typer

from surgisoft.errors import InputError


def warn(text: str) -> None:
    """One line of warning on standard error."""
    typer.echo(f"surgisoft: warning: {text}", err=True)


def read_recordings(paths: Iterable[Path]) -> list:
    """The recordings in files and folders; what is odd but usable is warned of."""
    from surgisoft.measurement.recordings.recording import load_recordings

    return load_recordings(paths, on_warning=warn)


def hidden_effects(given: Iterable[str] | None) -> list[tuple[str, float]]:
    """`creep:0.5` as name and strength; without a number 1."""
    answer = []
    for text in given or ():
        name, colon, strength = text.partition(":")
        try:
            answer.append((name, float(strength) if colon else 1.0))
        except ValueError:
            raise InputError(f"--hidden {text}: expected NAME or NAME:STRENGTH") from None
    return answer


def warn_all(notes: Iterable[str]) -> None:
    """Each note of a result as a line of warning."""
    for note in notes:
        warn(note)
