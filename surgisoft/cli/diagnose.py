"""`surgisoft diagnose`: find the physical effect that a model lacks."""

from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.files import check_folder, check_free
from surgisoft.cli.inputs import check_model, read_recordings, warn_all
from surgisoft.cli.options import (
    EffectFiles,
    JsonFile,
    Model,
    Recordings,
    Report,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.files import write_json


@app.command()
def diagnose(
    model: Model,
    recordings: Recordings,
    json_file: JsonFile = None,
    report: Report = None,
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="REC...",
            help="Recordings from before a change. The diagnosis then separates what has changed "
            "since from errors of the model; default: the training residuals in the model's "
            "folder.",
        ),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EFFECT...",
            help="Effects to exclude, because the setup rules them out, such as contact.",
        ),
    ] = None,
    effect_files: EffectFiles = None,
) -> None:
    """Diagnose a model: name the physical effect that it lacks, or report why none can be named.

    Uses the first three quarters of each recording; the last quarter is held out for `amend`.
    """
    check_free(json_file, "verdict")
    check_folder(report)
    check_model(model)
    measured = read_recordings(recordings)
    before = read_recordings(reference) if reference else None

    from surgisoft.diagnosis.diagnose import diagnose as diagnose_model
    from surgisoft.surrogate.checkpoint import load_model

    arm = load_model(model)
    with progress("diagnose") as tell:
        stages = iter(range(1, 100))
        found = diagnose_model(
            arm, measured, lambda text: tell(next(stages), 5, text), before, without or ()
        )
    warn_all(found.notes)
    written = []
    if json_file:
        write_json(json_file, found.to_json())
        written.append(json_file)
    if report:
        from surgisoft.diagnosis.pages.diagnosis import write_report

        title = f"{model.name} on {', '.join(recording.name for recording in measured)}"
        written.append(write_report(found, report, title))
    _show(found)
    for path in written:
        print(f"wrote {path}")
    if found.next_command:
        data = " ".join(map(str, recordings))
        command = found.next_command.format(model=model, data=data)
        print(f"next: {with_effect_files(command)}")


def _show(found) -> None:
    """Print the verdict, the ranking and the proposed experiment."""
    verdict, error = found.verdict, found.error_mm
    print(f"{verdict.kind}: {verdict.sentence}")
    print(
        f"error {error.before:.4f} mm, floor {error.floor:.4f} mm, "
        f"best achievable {error.ceiling:.4f} mm (on held-out blocks)"
    )
    for check in found.checks:
        print(f"check: {check}")
    print(f"{'effect':18s} {'conf.':>6s} {'alone':>7s} {'unique':>7s} {'held-out RMSE':>24s}")
    for row in found.ranking:
        low, high = row.ci95
        print(
            f"{row.effect:18s} {row.confidence:6.2f} {100 * row.gain_alone:6.1f}% "
            f"{100 * row.gain_unique:6.1f}% {row.heldout_rmse_mm:10.4f} [{low:.4f}, {high:.4f}] mm"
        )
    for each in found.not_testable:
        print(f"not testable: {each.effect}: {each.reason}")
    if found.next_experiment:
        plan = found.next_experiment
        pairs = ", ".join(" from ".join(pair) for pair in plan.separates)
        print(f"next experiment: {plan.name}, {plan.minutes:g} minutes, tells {pairs}")
    print(f"{found.seconds:.1f} s")
