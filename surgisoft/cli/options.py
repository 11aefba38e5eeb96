"""Arguments and options that several commands share: one name, metavar and help text for each."""

import os
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

from surgisoft.command_line import typed
from surgisoft.errors import InputError
from surgisoft.files import resolved

SEED_MAX = 2**31
"""Largest seed that commands accept."""

Model = Annotated[
    Path,
    Argument(
        metavar="MODEL",
        help="Folder of an arm model, or default: the arm of the package. Or a model of your own "
        "(docs/your_model.md): package.module:object or FILE.py:object, a Python callable, which "
        "is imported and run, so name only what you trust.",
    ),
]
AnyModel = Annotated[
    Path,
    Argument(
        metavar="MODEL",
        help="Folder of an arm model, or default: the arm of the package. Or a model of your own "
        "(docs/your_model.md): package.module:object or FILE.py:object, a Python callable, which "
        "is imported and run, so name only what you trust; or a file with its predictions for the "
        "recording (.csv, .parquet); with --predictions any name.",
    ),
]
Predictions = Annotated[
    list[Path] | None,
    Option(
        "--predictions",
        metavar="FILE...",
        help="Predictions of a model in any language: one file for each REC, in order, then one "
        "for each --before, with the columns k0_x_mm ... and the rows of that recording. MODEL is "
        "then only a name.",
    ),
]
ModelError = Annotated[
    float | None,
    Option(
        "--model-error",
        metavar="MM",
        help="Validated RMS error of a key point, mm, of a callable model or of predictions. "
        "Of several models in `compare`, it is that of the one callable among them. Default: the "
        "error that the callable states, else its error on --before, else 5 % of the arm's length.",
    ),
]
Recordings = Annotated[
    list[Path], Argument(metavar="REC", help="Recordings (.csv, .parquet) or folders of them.")
]
Before = Annotated[
    list[Path] | None,
    Option(
        "--before",
        metavar="REC...",
        help="Recordings from before a change. If they were made with the same actuation, the "
        "effects have to explain the difference between the measurements, in which the model's "
        "error cancels. Otherwise what the model got wrong on these recordings is learned and "
        "subtracted; `amend` then fits effects as without this option.",
    ),
]
Paired = Annotated[
    str,
    Option(
        metavar="auto|always|never",
        help="When to pair rows that have the same actuation before and after. auto: if at least "
        "half of the rows have a partner; always: also if fewer have one, but at least a minute in "
        "all, and an error otherwise; never: not at all.",
    ),
]
NewModel = Annotated[Path, Option("-o", "--output", metavar="NEW", help="Folder of the new model.")]
NewRecording = Annotated[
    Path, Option("-o", "--output", metavar="REC", help="New recording, .parquet or .csv.")
]


def complete_effects(incomplete: str) -> list[str]:
    """Known effects that begin so, after the last comma, for the shell; no user's code is run."""
    from surgisoft.surrogate.effects import EFFECTS
    from surgisoft.surrogate.effects.user_defined import offered

    return _begin_so([*EFFECTS, *offered()], incomplete)


def complete_memories(incomplete: str) -> list[str]:
    """Effects that a fit adds (those of the line and the material), and `auto`, as above."""
    from surgisoft.surrogate.effects import EFFECTS, FRONT
    from surgisoft.surrogate.effects.user_defined import offered

    mine = [name for name, kind in EFFECTS.items() if kind.stage in FRONT]
    return _begin_so([*mine, *offered(), "auto"], incomplete)


def complete_hidden(incomplete: str) -> list[str]:
    """Hidden effects of the virtual rig that begin so, for the shell."""
    from surgisoft.rig.hidden import HIDDEN

    return _begin_so(HIDDEN, incomplete)


def _begin_so(names: Iterable[str], incomplete: str) -> list[str]:
    """Names that begin like the part behind the last comma, with what stands before it."""
    before, comma, begun = incomplete.rpartition(",")
    return [f"{before}{comma}{name}" for name in sorted(set(names)) if name.startswith(begun)]


def _register(given: list[Path] | None) -> list[Path] | None:
    """Run the code that models may hold, before anything opens a model that holds it."""
    for path in given or []:
        if ":" not in str(path) and path.suffix == ".py" and not path.is_file():
            raise InputError(f"{path}: no such file; name a .py file that defines one Effect")
    if given:
        from surgisoft.surrogate.code import name_code

        name_code(given)
    return given


EffectFiles = Annotated[
    list[Path] | None,
    Option(
        "--effect-file",
        "--model-code",
        metavar="FILE.py|PACKAGE.MODULE:OBJECT...",
        callback=_register,
        help="Files of user-defined effects (docs/effects.md), those in the model and further "
        "candidates; or the callable that the model was made from (docs/your_model.md). "
        "--model-code is another name of this option. The files are executed, so name only files "
        "that you trust.",
    ),
]
"""Option of every command that opens a model. Reading the command line runs the code."""


def with_effect_files(command: str) -> str:
    """A command to run next, with the options that name the code that this call was given.

    Without them the command would refuse to open the model. A callable that the command names as
    its model is not named twice.
    """
    from surgisoft.surrogate.callables.named import named_callables
    from surgisoft.surrogate.effects import registered_files

    files = registered_files()
    named = [name for name in named_callables() if name not in shlex.split(command)]
    effects = f" --effect-file {typed(*files)}" if files else ""
    return command + effects + (f" --model-code {typed(*named)}" if named else "")


def typed_once(files: Iterable[Path]) -> str:
    """Recordings and folders in a command to run next: one that is given twice is read once."""
    once: dict[Path, Path] = {}
    for file in files:
        once.setdefault(resolved(file), file)
    return typed(*once.values())


def before_files(before: list[Path] | None, paired: str) -> str:
    """What follows `--before` in a command to run next: the recordings, and how to pair them, as
    this call was given them; empty without recordings."""
    if not before:
        return ""
    return typed_once(before) + ("" if paired == "auto" else f" --paired {paired}")


def before_options(before: list[Path] | None, paired: str) -> str:
    """The options of a command to run next about recordings from before a change, as this call was
    given them."""
    return f" --before {before_files(before, paired)}" if before else ""


def model_options(predictions: list[Path] | None, error_mm: float | None) -> str:
    """The options of a command to run next that say what MODEL is, as this call was given them."""
    text = f" --predictions {typed(*predictions)}" if predictions else ""
    return text if error_mm is None else f"{text} --model-error {error_mm:g}"


def given_options(given: Mapping[str, Any]) -> str:
    """Options of a command to run next, by their names, as this call was given them.

    given: value of each option; those with None or False are left out, those with True have no
    value, and a list or tuple gives several.
    """
    text = ""
    for name, value in given.items():
        if value is None or value is False:
            continue
        values = () if value is True else value if isinstance(value, list | tuple) else (value,)
        text += f" {typed(name, *values)}"
    return text


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
Credibility = Annotated[
    Path | None,
    Option(
        "--credibility",
        metavar="CONTEXT.toml",
        help="Also write a credibility report (HTML and JSON) in the terms of ASME V&V 40 and V&V "
        "20. The file states the question of interest, context of use, model risk and limits "
        "(docs/credibility.md).",
    ),
]
Replay = Annotated[
    Path | None,
    Option("--replay", metavar="FILE.rrd", help="Write a replay for `surgisoft replay`."),
]
Force = Annotated[bool, Option("--force", help="Replace the output of an earlier call.")]

_RIG = (
    "Rig: a name with its options, such as virtual, elastica or serial ('surgisoft rig list' shows "
    "all), package.module:object or FILE.py:object."
)
Rig = Annotated[str, Option("--rig", metavar="NAME[:option=value,...]", is_eager=True, help=_RIG)]
RigsOfArms = Annotated[
    str | None,
    Option(
        "--rig",
        metavar="NAME[:option=value,...]",
        help=_RIG + " One for all arms of the task, or ARM=NAME for single arms ('laser=NAME "
        "endoscope=NAME'); the other arms then run on the virtual rig.",
    ),
]

Cluster = Annotated[
    str | None,
    Option(
        metavar="ADDRESS",
        help="Dask scheduler (tcp://host:8786) whose workers do the work instead of processes on "
        "this machine. Default: the environment variable SURGISOFT_CLUSTER.",
    ),
]

Preflight = Annotated[
    bool,
    Option(
        "--preflight",
        help="On a real rig: try each chamber alone first, and stop if the arm does not move as "
        "its model predicts.",
    ),
]

Hidden = Annotated[
    list[str] | None,
    Option(
        "--hidden",
        metavar="NAME[:X][@S]...",
        autocompletion=complete_hidden,
        help="Hidden effects of the rig, which the model lacks. X is the amplitude, default 1. On "
        "the virtual rig @S starts the effect S seconds after the first reset.",
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
OfRunTask = Annotated[
    str | None,
    Option("--task", metavar="TASK", help="Task; default: that of the training run."),
]
ObserverGain = Annotated[
    float | None,
    Option(
        "--observer-gain",
        min=0.0,
        max=1.0,
        help="On a rig: an alpha-beta filter with this gain, the share of the difference between "
        "cameras and model that the policy's estimate adopts per step, 0 to 1. Default: an "
        "observer that learns online what the model gets wrong.",
    ),
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
        help="Fit candidate effects together with the network; held-out data decide. auto: only if "
        "the network may have learned to imitate an effect, such as a lag: the error is far above "
        "the noise floor, but about as large as the model's validated error. Takes minutes.",
    ),
]
REFIT_PROCESSES = min(2, os.cpu_count() or 1)
"""Processes that a refit trains in; the result does not depend on them."""

Web = Annotated[bool, Option("--web", help="Show it in a browser; served to this machine only.")]
Port = Annotated[
    int | None,
    Option(
        "--port",
        metavar="N",
        min=1,
        max=65534,
        help="With --web: port of the page; the data take the next one. To look from another "
        "machine: ssh -L N:localhost:N -L N+1:localhost:N+1.",
    ),
]
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
