"""Arguments and options that several commands share: one name, metavar and help text for each."""

import os
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from surgisoft.errors import InputError

SEED_MAX = 2**31
"""Largest seed that commands accept."""

Model = Annotated[
    Path,
    Argument(metavar="MODEL", help="Folder of an arm model, or default: the arm of the package."),
]
Recordings = Annotated[
    list[Path], Argument(metavar="REC", help="Recordings (.csv, .parquet) or folders of them.")
]
Before = Annotated[
    list[Path] | None,
    Option(
        "--before",
        metavar="REC...",
        help="Recordings from before a change. Where they were made with the same actuation, the "
        "difference between the measurements is explained, in which the model's error cancels; "
        "otherwise the model's residuals before and after are compared.",
    ),
]
Paired = Annotated[
    str,
    Option(
        metavar="auto|always|never",
        help="Whether rows of the same actuation before and after are paired; 'always' makes it an "
        "error if too few can be.",
    ),
]
NewModel = Annotated[Path, Option("-o", "--output", metavar="NEW", help="Folder of the new model.")]
NewRecording = Annotated[
    Path, Option("-o", "--output", metavar="REC", help="New recording, .parquet or .csv.")
]


def _register(paths: list[Path] | None) -> list[Path] | None:
    """Register the user-defined effects of files, before anything opens a model that holds them."""
    for path in paths or []:
        if not path.is_file():
            raise InputError(f"{path}: no such file; name a .py file that defines one Effect")
    if paths:
        from surgisoft.surrogate.effects import register_effect_files

        register_effect_files(paths)
    return paths


EffectFiles = Annotated[
    list[Path] | None,
    Option(
        "--effect-file",
        metavar="FILE.py...",
        callback=_register,
        help="Files of user-defined effects (docs/effects.md): those in the model, and further "
        "candidates. The files are run, so name only those that you trust.",
    ),
]
"""Option of every command that opens a model. Reading the command line registers the effects."""


def with_effect_files(command: str) -> str:
    """A command to run next, with `--effect-file` and the files that this call was given.

    Without them the command would refuse to open the model.
    """
    from surgisoft.surrogate.effects import registered_files

    files = registered_files()
    return f"{command} --effect-file {' '.join(files)}" if files else command


Run = Annotated[Path, Argument(metavar="RUN", help="Folder of a training run.")]
ExperimentFile = Annotated[
    Path,
    Argument(
        metavar="FILE.toml",
        help="Experiment's file, or the name of one in the package ('surgisoft experiment list').",
    ),
]

JsonFile = Annotated[
    Path | None, Option("--json", metavar="FILE.json", help="Write all numbers to this file.")
]
Report = Annotated[
    Path | None,
    Option(
        "--report", metavar="DIR", help="Write an HTML report with its pictures to this folder."
    ),
]
Replay = Annotated[
    Path | None,
    Option("--replay", metavar="FILE.rrd", help="Write a replay for `surgisoft replay`."),
]
Force = Annotated[bool, Option("--force", help="Replace the output of an earlier call.")]

_RIG = (
    "Rig: a name with its options (virtual, elastica, those of other packages; 'surgisoft rig "
    "list' shows them), or package.module:object."
)
Rig = Annotated[str, Option("--rig", metavar="NAME[:option=value,...]", is_eager=True, help=_RIG)]
RigsOfArms = Annotated[
    str | None,
    Option(
        "--rig",
        metavar="NAME[:option=value,...]",
        help=_RIG + " One for all arms of the task, or ARM=NAME for single arms ('laser=NAME "
        "endoscope=NAME'), the others then being virtual.",
    ),
]

Hidden = Annotated[
    list[str] | None,
    Option(
        "--hidden",
        metavar="NAME[:X]...",
        help="Hidden effects of the rig, which the model lacks, with their amplitudes; default 1.",
    ),
]
Arm = Annotated[
    str | None,
    Option("--arm", metavar="MODEL", help="Arm model of all arms; default: by the task."),
]
SceneFolder = Annotated[
    Path | None,
    Option(
        "--scene",
        metavar="DIR",
        help="Folder of a scene, or phantom_liver; default: by the task.",
    ),
]
TaskConfig = Annotated[
    Path | None,
    Option("--config", metavar="FILE.toml", help="File with fields of the task's configuration."),
]
Threads = Annotated[
    int,
    Option(
        "--threads", min=1, max=256, help="Threads; more than one is faster on idle cores only."
    ),
]

Refit = Annotated[
    Literal["auto", "never", "always"],
    Option(
        "--refit",
        help="Fit candidate effects together with the network and let held-out runs decide: auto "
        "where the error is far above the noise floor and no larger than the model's validated "
        "error, as when a network imitates a lag. Takes minutes.",
    ),
]
REFIT_PROCESSES = min(2, os.cpu_count() or 1)
"""Processes that a refit trains in; the result does not depend on them."""

Web = Annotated[bool, Option("--web", help="Show it in a browser; served to this machine only.")]
Screenshot = Annotated[
    Path | None,
    Option(
        "--screenshot", metavar="FILE.png", help="Write a picture, without a display, and exit."
    ),
]
SaveReplay = Annotated[
    Path | None,
    Option("--save", metavar="FILE.rrd", help="Write the replay to a file and exit."),
]
