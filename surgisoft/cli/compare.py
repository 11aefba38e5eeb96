"""`surgisoft compare`: a model against recordings."""

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.files import check_folder, check_free, write_text


@app.command()
def compare(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Folder of an arm model.")],
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC", help="Recordings or folders of them.")
    ],
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write all numbers here.")
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write pictures of loops, bodies and errors here."),
    ] = None,
) -> None:
    """Compare an arm model with measurements: the error, and where it sits."""
    from surgisoft.diagnosis.compare import compare as compare_model
    from surgisoft.measurement.histories import outside_range
    from surgisoft.measurement.recording import load_recordings
    from surgisoft.surrogate.checkpoint import load_model

    check_free(json_file, "rmse_mm")
    check_folder(report)
    arm = load_model(model)
    measured = load_recordings(
        recordings, on_warning=lambda text: typer.echo(f"surgisoft: warning: {text}", err=True)
    )
    result, rest = compare_model(arm, measured)
    for note in outside_range(arm.spec, measured):
        typer.echo(f"surgisoft: warning: {note}", err=True)
    if json_file:
        write_text(json_file, json.dumps(result.to_json(), indent=2) + "\n")
    print(arm.summary())
    _show(result)
    if report:
        from surgisoft.diagnosis.pictures import draw_all

        backbone = arm.backbone() if arm.spec.key_points > 1 else None
        title = f"{model.name} on {', '.join(recording.name for recording in measured)}"
        for path in draw_all(rest, backbone, arm.spec.unit, report, title):
            print(f"wrote {path}")


def _show(result) -> None:
    floor = result.floor
    known = "unknown" if floor.rmse_mm is None else f"{floor.rmse_mm:.4f} mm (from {floor.source})"
    tip = f"tip {result.tip_rmse_mm:.4f} mm"
    if math.isnan(result.tip_rmse_mm):
        tip = "tip not measured"
    print(
        f"RMSE {result.rmse_mm:.4f} mm, {tip}, noise floor {known}, "
        f"{result.samples} samples"
        + (f", {result.missing} rows without key points" if result.missing else "")
    )
    print(f"MSE of a coordinate {result.mse_mm2:.5f} mm2")
    points = " ".join(
        "-" if math.isnan(value) else f"{value:.4f}" for value in result.per_key_point_mm
    )
    print(f"key points base to tip: {points} mm")
    axis = None
    for band in result.bands:
        name = "" if band.axis == axis else band.axis
        axis = band.axis
        print(f"  {name:12s} {band.label:28s} {band.rmse_mm:8.4f} mm {band.samples:8d} samples")
    for moment in result.worst:
        print(
            f"  worst: {moment.error_mm:.3f} mm at key point {moment.key_point}, "
            f"{moment.recording} t = {moment.t_s:.2f} s"
        )
