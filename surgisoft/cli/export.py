"""`surgisoft export`: policies and arm models as files for other programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.inputs import read_recordings
from surgisoft.cli.options import EffectFiles, Force
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError
from surgisoft.files import read_json

if TYPE_CHECKING:
    from surgisoft.agents.rig_check import RigCheck

DIFFERS = 1
"""Exit code where an exported controller does not do what its policy does."""


@app.command()
def export(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|MODEL",
            help="Folder of a training run or of an arm model; default: the arm of the package; or "
            "a Python callable that states its range: package.module:object, FILE.py:object.",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="New folder.")],
    which: Annotated[
        str | None, typer.Option(metavar="best|last", help="Checkpoint of a run; default: best.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Drive a virtual rig for one episode with the policy of a run, and print how far "
            "the exported controller differs from it, given the same measurements and in its own "
            "closed loop. Exit code 1 where that is more than rounding.",
        ),
    ] = False,
    data: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="REC...",
            help="Recordings over which the files of an arm model are compared with the model, "
            "row by row; the largest difference is printed, and one above 1e-5 mm is an error.",
        ),
    ] = None,
    effect_files: EffectFiles = None,
    force: Force = False,
) -> None:
    """Write a run's policies, or an arm model, as ONNX and TorchScript, or as NumPy code.

    A run gives, for each agent, its network, and one controller with observer, memories and
    predictions inside: measurements in, commands out. controller.py runs it without surgisoft,
    and policy.json states every name, order, unit and range. A model gives start(pressure) and
    step(state, pressure, dt) -> state, key points, and arm.json. A model that calls Python code
    of yours (--model-code) becomes NumPy code that calls it: arm.py, or controller_code.py.
    """
    from surgisoft.surrogate.callables.named import is_callable_name

    is_model = str(source) == "default" or (source / "weights.safetensors").is_file()
    is_model = is_model or is_callable_name(str(source))
    if is_model and (which is not None or check):
        raise InputError(f"{source}: is an arm model; --which and --check are for training runs")
    if data and not is_model:
        raise InputError(f"{source}: is a training run; --data is for arm models, see --check")
    passed = True
    if is_model:
        files = _model(source, output, data, force)
    else:
        files, passed = _run(source, output, which or "best", check, force)
    for file in files:
        print(f"wrote {file}")
    if not passed:
        raise typer.Exit(DIFFERS)


def _model(source: Path, output: Path, data: list[Path] | None, force: bool) -> list[Path]:
    from surgisoft.measurement.exporting import export_arm
    from surgisoft.surrogate.export import differences

    measured = read_recordings(data) if data else []
    with progress(f"export {source}"):
        files = export_arm(source, output, measured, force)
    if read_json(output / "arm.json")["state"]["elapsed"]:
        print(
            "the model drifts with the elapsed time, which counts from 'start': where a run begins "
            "later in its recording, set state.elapsed of arm.json (docs/export.md)"
        )
    for name, found in differences(output).items():
        print(
            f"{name}: over {found['rows']} rows the files differ from the model by "
            f"{found['largest_difference_mm']:.2g} mm at most"
        )
    return files


def _run(
    source: Path, output: Path, which: str, check: bool, force: bool
) -> tuple[list[Path], bool]:
    """The files, and whether the controller passed its check, where one was asked for."""
    from surgisoft.agents.controller_runner import Controller
    from surgisoft.agents.export import export as export_policy
    from surgisoft.agents.learned import LearnedPolicy
    from surgisoft.agents.rig_check import check_on_rig

    policy = LearnedPolicy(source, which=which)
    task = policy.run.task()

    lines: list[str] = []
    try:
        with progress(f"export {source}") as report:

            def checked(controller: Controller) -> None:
                report.step(1, 2, "one episode on the virtual rig")
                found = check_on_rig(controller, task, policy)
                lines.extend(_compared(found))
                if not found.passed:
                    lines.append(
                        f"no file was written to {output}; without --check the files are written "
                        "unchecked"
                    )
                    raise typer.Exit(DIFFERS)

            files = export_policy(
                policy, output, task, force=force, check=checked if check else None
            )
    finally:
        for line in lines:
            print(line)
    if not (output / "controller.py").is_file():
        note = read_json(output / "policy.json")["note"]
        print(f"controller: not exported, only the policies: {note}")
        return files, not check
    return files, True


def _compared(found: "RigCheck") -> list[str]:
    """What is printed of a comparison on the virtual rig."""
    from surgisoft.agents.rig_check import TOLERANCE_KPA, TOLERANCE_MM

    same, closed, own = found.same, found.closed, found.own
    lines = [
        f"on the virtual rig, {found.decisions} decisions: largest differences of exported "
        "controller and policy",
        f"same measurements: commands {same.commands_kPa:.2g} kPa, estimated key points "
        f"{same.points_mm:.2g} mm ({TOLERANCE_KPA:g} kPa and {TOLERANCE_MM:g} mm are accepted)",
        f"closed loop: commands {closed.commands_kPa:.2g} kPa, true key points "
        f"{closed.points_mm:.2g} mm",
    ]
    if own is not None:
        lines.append(
            "same measurements, those of the controller's closed loop: commands "
            f"{own.commands_kPa:.2g} kPa, estimated key points {own.points_mm:.2g} mm"
        )
    if not same.accepted:
        lines.append(
            "failed: given the measurements of the policy's episode, the exported controller does "
            "not compute what the policy computes"
        )
    elif found.amplified:
        lines.append(
            "passed: at every decision of both loops the exported controller computes what the "
            "policy computes; the loops differ because the robot amplifies rounding"
        )
    elif found.passed:
        lines.append("passed: the exported controller does in the loop what the policy does")
    else:
        lines.append(
            "failed: given the measurements of its own closed loop, the exported controller does "
            "not compute what the policy computes"
        )
    return lines
