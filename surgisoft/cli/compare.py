"""`surgisoft compare`: compare a model with recordings."""

import math

from surgisoft.cli import app
from surgisoft.cli.files import check_folder, check_free, check_replay
from surgisoft.cli.inputs import (
    check_model,
    read_before,
    read_context,
    read_recordings,
    warn_all,
)
from surgisoft.cli.options import (
    AnyModel,
    Before,
    Credibility,
    EffectFiles,
    JsonFile,
    ModelError,
    Paired,
    Predictions,
    Recordings,
    Replay,
    Report,
    model_options,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError
from surgisoft.files import write_json
from surgisoft.progress import text_only

AXES_SHOWN = 5
"""Axes that the terminal lists; the page and the JSON file have all of them."""
LEAST_SHOWN = 0.02
"""Smallest share of the error for which the terminal lists an axis."""


@app.command()
def compare(
    model: AnyModel,
    recordings: Recordings,
    before: Before = None,
    paired: Paired = "auto",
    predictions: Predictions = None,
    model_error: ModelError = None,
    json_file: JsonFile = None,
    report: Report = None,
    replay: Replay = None,
    credibility: Credibility = None,
    effect_files: EffectFiles = None,
) -> None:
    """Compare an arm model with measurements: the error, and what it depends on."""
    check_free(json_file, "rmse_mm")
    check_folder(report)
    check_replay(replay)
    if credibility and not report:
        raise InputError("--credibility: writes into the folder of the report; add --report DIR")
    context = read_context(credibility)

    check_model(model, predictions)
    measured = read_recordings(recordings)
    earlier = read_before(before, paired)

    from surgisoft.diagnosis.compare import compare as compare_model

    result, rest = compare_model(
        model,
        measured,
        before=earlier,
        paired=paired,
        predictions=predictions,
        error_mm=model_error,
    )
    arm = rest.model
    warn_all(result.notes)
    title = f"{model.name} on {', '.join(recording.name for recording in measured)}"
    written = []
    if json_file:
        write_json(json_file, result.to_json())
        written.append(json_file)
    if report:
        from surgisoft.diagnosis.pages.compare import compare_page
        from surgisoft.diagnosis.pages.pictures import draw_all
        from surgisoft.report import write_page

        backbone = arm.backbone() if arm.spec.key_points > 1 else None
        drawn = draw_all(rest, backbone, arm.spec.unit, report, title)
        page = compare_page(result, rest, title, arm.summary(), drawn)
        written += [write_page(page, report / "report.html"), *drawn]
    if context and report:
        from surgisoft.credibility.assessment import assess
        from surgisoft.credibility.page import write_report

        with progress("credibility") as tell:
            assessed = assess(context, result, rest, measured, progress=text_only(tell))
        written += write_report(assessed, report)
    if replay:
        from surgisoft.replay.comparison import write_comparison

        points = (rest.measured_mm, rest.predicted_mm)
        write_comparison(rest.t_s, *points, title, replay, rest.pressure, arm.spec.unit)
        written.append(replay)
    print(result.sentence)
    if result.setup:
        print(f"set-up: {result.setup}; `surgisoft diagnose` shows what mends it")
    print(arm.summary())
    _show(result)
    if context:
        print(f"credibility: {assessed.sentence}")
    for path in written:
        print(f"wrote {path}")
    if result.explainable:
        names = " ".join(map(str, recordings))
        since = f" --before {' '.join(map(str, before))}" if before else ""
        since += model_options(predictions, model_error)
        following = with_effect_files(f"surgisoft diagnose {model} {names}{since}")
        print(f"next, which effect is missing: {following}")


def _show(result) -> None:
    tip = f"tip {result.tip_rmse_mm:.4f} mm"
    if math.isnan(result.tip_rmse_mm):
        tip = "tip not measured"
    print(
        f"RMSE {result.rmse_mm:.4f} mm, {tip}, {_floor(result)}, {result.samples} samples"
        + (f", {result.missing} rows without key points" if result.missing else "")
    )
    parts = ", ".join(f"{name} {value:.4f}" for name, value in result.components_mm.items())
    print(f"MSE of a coordinate {result.mse_mm2:.5f} mm2; RMS {parts} mm")
    points = " ".join(
        "-" if math.isnan(value) else f"{value:.4f}" for value in result.per_key_point_mm
    )
    print(f"key points base to tip: {points} mm")
    if result.coverage is None:
        print("the model states no prediction interval")
    else:
        print(f"{result.coverage:.1%} of key points within the model's 95 % prediction interval")
    if result.time_shift is not None:
        low, high = result.time_shift.ci95_s
        shift = result.time_shift.seconds
        print(f"the arm trails the model by {shift:.3f} s ({low:.3f} .. {high:.3f})")
    for each in result.axes[:AXES_SHOWN]:
        if each.share >= LEAST_SHOWN:
            counted = "alone" if each.static else "beyond actuation"
            low, high = (f"{100 * value:.0f}" for value in each.ci95)
            share = f"{100 * each.share:3.0f} % ({low} .. {high})"
            print(f"  {each.axis:16s} explains {share:16s} {counted}")
    for each in result.change_axes[:AXES_SHOWN]:
        if each.share >= LEAST_SHOWN:
            print(f"  {each.axis:16s} explains {100 * each.share:3.0f} % of the change")
    for moment in result.worst:
        print(
            f"  worst: {moment.error_mm:.3f} mm at key point {moment.key_point}, "
            f"{moment.recording} t = {moment.t_s:.2f} s"
        )


def _floor(result) -> str:
    if result.floor.rmse_mm is None:
        return "noise floor unknown"
    return f"noise floor {result.floor.rmse_mm:.4f} mm (from {result.floor.source})"
