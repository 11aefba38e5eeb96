"""`surgisoft benchmark`: the studies of the repository's `benchmarks` folder.

They are not part of an installed package: from a wheel the command prints where they are.
"""

import sys
from pathlib import Path

import typer

from surgisoft.cli import app
from surgisoft.errors import InputError

REPOSITORY = Path(__file__).resolve().parents[2]


def _studies() -> typer.Typer:
    """The sub-commands, from the checkout that this package runs in."""
    if (REPOSITORY / "benchmarks" / "commands.py").is_file():
        if str(REPOSITORY) not in sys.path:
            sys.path.append(str(REPOSITORY))
        from benchmarks.commands import app as studies

        return studies
    absent = typer.Typer(
        help="Studies that compute the tables of docs/results; they need a checkout."
    )

    @absent.callback(
        invoke_without_command=True,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def explain() -> None:
        raise InputError(
            "benchmark: the studies are not part of the installed package, expected a checkout "
            "of the repository; clone it and install it with 'pip install -e .'"
        )

    return absent


app.add_typer(_studies(), name="benchmark")
