"""`surgisoft compare`: compare models with recordings."""

import math
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from surgisoft.cli import app
from surgisoft.cli.files import check_folder, check_free, check_replay, show_written
from surgisoft.cli.inputs import (
    check_model,
    leading_models,
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
    Replay,
    Report,
    before_options,
    model_options,
    typed_once,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
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
    recordings: Annotated[
        list[Path],
        Argument(
            metavar="[MODEL...] REC...",
            help="Further models to show on the same recordings (folders of models, default, or "
            "callables), then the recordings (.csv, .parquet) or folders of them.",
        ),
    ],
    before: Before = None,
    paired: Paired = "auto",
    predictions: Predictions = None,
    model_error: ModelError = None,
    json_file: JsonFile = None,
    report: Report = None,
    replay: Replay = None,
    scale: Annotated[
        float | None,
        Option(
            "--error-scale",
            metavar="MM",
            min=1e-6,
            help="Error at the end of the replay's colour scale, mm; default: from the errors of "
            "the worst model. Give the same value for replays that are to be compared.",
        ),
    ] = None,
    credibility: Credibility = None,
    test: Annotated[
        bool,
        Option(
            "--test",
            help="Refuse recordings that a model was fitted to, in whole or in part, so that the "
            "error is a test error.",
        ),
    ] = False,
    effect_files: EffectFiles = None,
) -> None:
    """Compare arm models with measurements: the error, and what it depends on.

    The error is that over all rows. The noise floor, the best achievable error and the explainable
    share are computed on the rows that diagnose uses, the first three quarters of each recording,
    so both commands state the same numbers. If several models are given, before the recordings,
    they are shown together on one error scale.
    """
    check_free(json_file, "rmse_mm")
    check_folder(report)
    check_replay(replay)
    if credibility and not report:
        raise InputError("--credibility: writes into the folder of the report; add --report DIR")
    context = read_context(credibility)

    if scale is not None and not replay:
        raise InputError("--error-scale scales the colours of a replay; add --replay FILE.rrd")
    check_model(model, predictions)
    others, recordings = leading_models(recordings)
    if others and predictions:
        raise InputError("--predictions is for one model; leave the other models out")
    measured = read_recordings(recordings)
    earlier = read_before(before, paired)

    from surgisoft.diagnosis.compare import compare_all
    from surgisoft.diagnosis.other_models import takes_error

    models = [model, *others]
    with progress("compare") as tell:
        compared = compare_all(
            models,
            measured,
            progress=tell.step,
            before=earlier,
            paired=paired,
            predictions=predictions,
            error_mm=model_error,
            test=test,
        )
    result, rest = compared[0].result, compared[0].table
    arm = rest.model
    for one in compared:
        warn_all(one.result.notes)
    names = " and ".join(one.name for one in compared)
    title = f"{names} on {', '.join(recording.name for recording in measured)}"
    written = []
    if json_file:
        write_json(json_file, _values(compared))
        written.append(json_file)
    if report:
        from surgisoft.diagnosis.pages.compare import write_report

        written += write_report(compared, report, title)
    if context and report:
        from surgisoft.credibility.assessment import assess
        from surgisoft.credibility.page import write_report as write_credibility

        with progress("credibility") as tell:
            assessed = assess(context, result, rest, measured, progress=text_only(tell))
        written += write_credibility(assessed, report)
    if replay:
        from surgisoft.replay.model_error import write_compared

        write_compared(compared, title, replay, scale)
        written.append(replay)
    print(result.sentence)
    if result.setup:
        print(f"set-up: {result.setup}; `surgisoft diagnose` shows the correction")
    print(arm.summary())
    _show(result)
    for one in compared[1:]:
        print(f"\n{one.sentence}")
        print(one.summary)
        _show(one.result)
    if others:
        print()
        _table(compared)
    if context:
        print(f"credibility: {assessed.sentence}")
    show_written(written)
    best = min(range(len(compared)), key=lambda i: compared[i].result.rmse_mm)
    if compared[best].result.explainable:
        names = typed_once(recordings)
        since = before_options(before, paired)
        its_error = model_error if not others or takes_error(models[best]) else None
        since += model_options(predictions, its_error)
        following = with_effect_files(f"surgisoft diagnose {typed(models[best])} {names}{since}")
        closest = " from the model of the smallest error" if others else ""
        asked = "which effect is missing"
        if compared[best].result.of_another_arm:
            asked = "whether one effect explains most of it"
        print(f"next, {asked}{closest}: {following}")


def _values(compared) -> dict:
    """Numbers of the first model; of several, those of all by their names in `models` too."""
    values = compared[0].result.to_json()
    if len(compared) > 1:
        values["models"] = [{"model": one.name} | one.result.to_json() for one in compared]
    return values


def _table(compared) -> None:
    """One line for each model, on the same recordings."""
    width = max(len(one.name) for one in compared)
    print(f"{'model':{width}s}  error [mm]  95 % interval      tip [mm]  explainable")
    for one in compared:
        low, high = one.result.rmse_ci95_mm
        part = one.result.explainable
        share = "-" if part is None else f"{100 * part:.0f} %"
        print(
            f"{one.name:{width}s}  {one.result.rmse_mm:10.4f}  {low:.4f} .. {high:.4f}  "
            f"{one.result.tip_rmse_mm:8.4f}  {share:>11s}"
        )


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
        fit = f" ({result.rows_of_fit})" if result.in_fit else ""
        print(
            f"{result.coverage:.1%} of key points within the model's 95 % prediction interval{fit}"
        )
    if result.time_shift is not None:
        low, high = result.time_shift.ci95_s
        shift = result.time_shift.seconds
        print(f"the arm trails the model by {shift:.3f} s ({low:.3f} .. {high:.3f})")
    for each in result.axes[:AXES_SHOWN]:
        if each.share >= LEAST_SHOWN:
            counted = "alone" if each.static else "beyond actuation"
            low, high = (f"{100 * value:.0f}" for value in each.ci95)
            share = f"{100 * each.share:3.0f} % ({low} .. {high})"
            print(f"  {each.in_words:16s} explains {share:16s} {counted}")
    for each in result.change_axes[:AXES_SHOWN]:
        if each.share >= LEAST_SHOWN:
            print(f"  {each.in_words:16s} explains {100 * each.share:3.0f} % of the change")
    for moment in result.worst:
        print(
            f"  worst: {moment.error_mm:.3f} mm at key point k{moment.key_point}, "
            f"{moment.recording} t = {moment.t_s:.2f} s"
            + ("" if moment.t_s == moment.along_s else f" ({moment.along_s:.2f} s in the report)")
        )


def _floor(result) -> str:
    if result.floor.rmse_mm is None:
        return "noise floor unknown"
    return f"noise floor {result.floor.rmse_mm:.4f} mm (from {result.floor.source})"
