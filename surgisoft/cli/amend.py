"""`surgisoft amend`: a model with one physical effect more."""

import json
from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.files import check_folder, check_free, write_text
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError

NOT_CLAIMED = 1
"""Exit code where the error did not fall beyond chance."""


@app.command()
def amend(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Folder of an arm model.")],
    effects: Annotated[
        list[str],
        typer.Option("--effect", metavar="NAME|FILE.py", help="Effect to add, or to fit anew."),
    ],
    data: Annotated[list[Path], typer.Option(metavar="REC", help="Recordings or folders of them.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="NEW", help="Folder of the new model.")
    ],
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write all numbers here.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write report.html here.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an older NEW.")] = False,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Write NEW even where no fall can be claimed.")
    ] = False,
    retune: Annotated[
        bool,
        typer.Option(
            "--retune-network", help="Also re-tune the network, where held-out data rewards it."
        ),
    ] = False,
) -> None:
    """Amend a model: put a physical effect into it and say what that is worth.

    The parameters are fitted to the first three quarters of each recording; the last quarter,
    locked until then, judges. Without a fall beyond chance nothing is written (exit code 1).
    """
    import torch

    from surgisoft.diagnosis.amend import amend as amend_model
    from surgisoft.measurement.histories import outside_range
    from surgisoft.measurement.recording import load_recordings
    from surgisoft.surrogate.checkpoint import load_known_error, load_model, save_model
    from surgisoft.surrogate.effects import named_effect

    claim_other_folder(output, model, force)
    check_free(json_file, "error_mm")
    check_folder(report)
    arm, known = load_model(model), load_known_error(model)
    names = [named_effect(given) for given in effects]
    measured = load_recordings(data, on_warning=_warn)
    torch.set_num_threads(1)
    with progress("amend") as tell:
        stages = iter(range(100))
        result = amend_model(arm, measured, names, retune, lambda text: tell(next(stages), 4, text))
    for note in outside_range(arm.spec, measured):
        _warn(note)
    for name in result.refitted:
        print(f"{name}: the model has it; its parameters were fitted anew")
    show_parameters(result.parameters)
    if result.retuned:
        print("the network's last layer was re-tuned: held-out motion rewards it")
    claimed = result.locked.claimed
    if claimed or anyway:
        account = result.to_json() | {
            "amended_from": model.name,
            "recordings": [recording.name for recording in measured],
        }
        # A network that was re-tuned is off elsewhere.
        kept = None if account["network_retuned"] else known
        save_model(result.model, output, account, force, kept)
    if json_file:
        write_text(json_file, json.dumps(result.to_json(), indent=2) + "\n")
    if report:
        from surgisoft.diagnosis.pages.amend import amend_page
        from surgisoft.report import write_page

        title = f"{model.name} with {' + '.join(result.effects)}"
        page = amend_page(result, title, result.model.summary())
        print(f"wrote {write_page(page, report / 'report.html')}")
    print(result.sentence)
    if claimed or anyway:
        print(f"wrote {output}: {result.model.summary()}")
    else:
        print(f"{output} was not written; --anyway writes it", flush=True)
    if not claimed:
        raise typer.Exit(NOT_CLAIMED)


def claim_other_folder(output: Path, model: Path, force: bool) -> None:
    """Raise unless a new model may be written there, which must not be the one that is read."""
    from surgisoft.surrogate.checkpoint import claim_folder

    if output.resolve() == model.resolve():
        raise InputError(f"{output}: is the model that is read; choose another folder")
    claim_folder(output, force)


def show_parameters(parameters) -> None:
    """The fitted parameters, one a line, and which of them are implausible."""
    from surgisoft.diagnosis.refinement.intervals import values_text

    for each in parameters:
        unit = f" {each.unit}" if each.unit else ""
        interval = f" ({each.interval_text})" if each.interval_text else ""
        print(f"  {each.effect}: {each.name} = {values_text(each.value)}{unit}{interval}")
    for each in parameters:
        if not each.plausible:
            low, high = each.plausible_range
            unit = f" {each.unit}" if each.unit else ""
            print(
                f"implausible: {each.effect} {each.name} = {values_text(each.value)}, expected "
                f"{low:.3g} to {high:.3g}{unit} ({each.source})"
            )


def _warn(message: str) -> None:
    typer.echo(f"surgisoft: warning: {message}", err=True)
