"""Arguments and options that several commands take: one name, one metavar, one text for each."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from surgisoft.errors import InputError

SEED_MAX = 2**31
"""Largest seed."""

Model = Annotated[
    Path,
    Argument(metavar="MODEL", help="Folder of an arm model, or default: the arm of the package."),
]
Recordings = Annotated[
    list[Path], Argument(metavar="REC", help="Recordings (.csv, .parquet) or folders of them.")
]
NewModel = Annotated[Path, Option("-o", "--output", metavar="NEW", help="Folder of the new model.")]
NewRecording = Annotated[
    Path, Option("-o", "--output", metavar="REC", help="New recording, .parquet or .csv.")
]


def _register(paths: list[Path] | None) -> list[Path] | None:
    """Register the user-defined effects of files, before anything opens a model that holds them."""
    for path in paths or []:
        if not path.is_file():
            raise InputError(f"{path}: no such file; expected a .py file with one Effect in it")
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
        help="Files of user-defined effects (docs/effects.md) that a model holds or may lack. The "
        "files are run: name only those that you trust.",
    ),
]
"""Of every command that opens a model. The effects are registered when the command line is read."""


def with_effect_files(command: str) -> str:
    """A command to run next, with the files of user-defined effects that this one was given.

    Without them it would refuse to open the model.
    """
    from surgisoft.surrogate.effects import registered_files

    files = registered_files()
    return f"{command} --effect-file {' '.join(files)}" if files else command


Run = Annotated[Path, Argument(metavar="RUN", help="Folder of a training run.")]
ExperimentFile = Annotated[
    Path,
    Argument(
        metavar="FILE.toml",
        help="The experiment, or the name of one of the package: 'surgisoft experiment list'.",
    ),
]

JsonFile = Annotated[
    Path | None, Option("--json", metavar="FILE.json", help="Write all numbers here.")
]
Report = Annotated[
    Path | None,
    Option("--report", metavar="DIR", help="Write an HTML report with its pictures here."),
]
Replay = Annotated[
    Path | None,
    Option("--replay", metavar="FILE.rrd", help="Write what `surgisoft replay` shows here."),
]
Force = Annotated[bool, Option("--force", help="Replace what an earlier call wrote there.")]

Hidden = Annotated[
    list[str] | None,
    Option(
        "--hidden",
        metavar="NAME[:X]...",
        help="Effects that the rig has and a model lacks, each with its strength; default 1.",
    ),
]
Arm = Annotated[
    str | None,
    Option("--arm", metavar="MODEL", help="Arm model of all arms; default: the task's own."),
]
SceneFolder = Annotated[
    Path | None,
    Option(
        "--scene",
        metavar="DIR",
        help="Folder of a scene, or phantom_liver; default: the task's own.",
    ),
]
TaskConfig = Annotated[
    Path | None,
    Option("--config", metavar="FILE.toml", help="Fields of the task's configuration."),
]
Threads = Annotated[
    int,
    Option("--threads", min=1, max=256, help="Threads; more than one only pays on idle cores."),
]

Web = Annotated[bool, Option("--web", help="Serve it to a browser on this machine only.")]
Screenshot = Annotated[
    Path | None,
    Option("--screenshot", metavar="FILE.png", help="Write a picture without a display and exit."),
]
SaveReplay = Annotated[
    Path | None,
    Option("--save", metavar="FILE.rrd", help="Write what the viewer would show and exit."),
]
