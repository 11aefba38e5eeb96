"""`surgisoft diagnose`: find the physical effect that a model lacks."""

import textwrap
from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import INTERRUPTED, app
from surgisoft.cli.files import (
    check_folder,
    check_free,
    check_new_folder,
    check_replay,
    show_written,
)
from surgisoft.cli.inputs import (
    IN_A_MAP,
    check_model,
    read_before,
    read_recordings,
    warn,
    warn_all,
)
from surgisoft.cli.options import (
    REFIT_PROCESSES,
    AnyModel,
    Before,
    EffectFiles,
    JsonFile,
    ModelError,
    Paired,
    Predictions,
    Recordings,
    Refit,
    Report,
    before_files,
    complete_effects,
    model_options,
    typed_once,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.errors import InputError, Interrupted
from surgisoft.files import write_json
from surgisoft.progress import Progress

MOST_KEPT = 1 << 25
"""Size of the largest blocks of freed memory that stay with the process, bytes: the temporaries of
a diagnosis, and not the columns of a long recording."""
ReplayOfChange = Annotated[
    Path | None,
    typer.Option(
        "--replay",
        metavar="FILE.rrd",
        help="Write a replay of the change since --before, for `surgisoft replay`.",
    ),
]


@app.command()
def diagnose(
    model: AnyModel,
    recordings: Recordings,
    json_file: JsonFile = None,
    report: Report = None,
    replay: ReplayOfChange = None,
    before: Before = None,
    paired: Paired = "auto",
    predictions: Predictions = None,
    model_error: ModelError = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EFFECT...",
            autocompletion=complete_effects,
            help="Effects to exclude because the set-up rules them out, such as contact.",
        ),
    ] = None,
    refit: Refit = "auto",
    apply: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Correct the set-up fault in the recordings and write them to this new folder.",
        ),
    ] = None,
    setup_tests: Annotated[
        bool,
        typer.Option(
            "--setup-tests/--no-setup-tests",
            help="Whether to test frames, units, orders, chambers and clocks before effects.",
        ),
    ] = True,
    effect_files: EffectFiles = None,
) -> None:
    """Diagnose a model: name the physical effect that it lacks, or report why none can be named.

    The set-up of the recordings is tested first: a rotated or mirrored frame, wrong units, swapped
    chambers or key points, a clock offset, dead channels. If a fault is found, the verdict is
    'setup', with its correction, and no effect is sought.

    Uses the first three quarters of each recording; the last quarter is held out for `amend`.
    """
    check_free(json_file, "verdict")
    check_folder(report)
    check_replay(replay)
    if replay and not before:
        raise InputError("--replay shows a change; add --before REC, or use 'surgisoft compare'")
    if apply and not setup_tests:
        raise InputError("--apply corrects what the set-up tests find: leave --no-setup-tests out")
    check_new_folder(apply)
    check_model(model, predictions)
    measured = read_recordings(recordings)
    earlier = read_before(before, paired)
    if apply:
        from surgisoft.measurement.recordings import check_names_differ

        check_names_differ(measured)

    from surgisoft.diagnosis.diagnose import diagnose as diagnose_model
    from surgisoft.measurement.recordings import save_recordings
    from surgisoft.memory import keep_freed_memory

    keep_freed_memory(MOST_KEPT)
    with progress("diagnose") as tell:
        stages = iter(range(1, 100))
        try:
            found = diagnose_model(
                model,
                measured,
                lambda text: tell.step(next(stages), 6, text),
                without=without or (),
                setup_tests=setup_tests,
                before=earlier,
                paired=paired,
                refit=refit,
                refit_progress=announced(tell),
                processes=REFIT_PROCESSES,
                predictions=predictions,
                error_mm=model_error,
            )
        except Interrupted as ended:
            found = ended.result
            warn("interrupted; the verdict is that of the residuals (Ctrl-C again ends at once)")
    warn_all(found.notes)
    data = typed_once(recordings)
    # Predictions of `--before` come last.
    of_model = model_options((predictions or [])[: len(measured)], model_error)
    following = ""
    if found.next_command:
        pairing, earlier_files = before_files(before, paired), typed_once(before or [])
        command = found.command(typed(model), data, pairing, earlier_files)
        predicted = bool(predictions) or model.suffix in (".csv", ".parquet")
        of_all = model_options(predictions, model_error) if "--before" in command else of_model
        following = _following(command, predicted, of_all)
    written = []
    if json_file:
        write_json(json_file, found.to_json())
        written.append(json_file)
    if report:
        from surgisoft.diagnosis.pages.diagnosis import write_report

        title = f"{model.name} on {', '.join(recording.name for recording in measured)}"
        written.append(write_report(found, report, title, following))
    if replay and found.track is not None:
        from surgisoft.replay.comparison import write_change

        track, names = found.track, ", ".join(recording.name for recording in measured)
        points = (track.before_mm, track.after_mm, track.explained_mm)
        known = (each.gravity for each in measured if each.gravity is not None)
        gravity = next(known, None)
        write_change(track.t_s, *points, f"{model.name} on {names}", replay, gravity)
        written.append(replay)
    elif replay:
        warn(f"{replay} was not written: no rows of the same actuation before and after")
    corrected = typed(apply)
    if apply and found.setup and found.setup.correctable:
        files = save_recordings(found.setup.corrected(measured), apply)
        written.append(apply)
        # Files of predictions belong to recordings by their order, which a folder does not keep.
        corrected = typed(*files) if predictions and len(files) > 1 else corrected
    _show(found)
    show_written(written)
    if found.setup:
        _next_after_setup(found.setup, model, data, of_model, corrected if apply else None)
    elif apply:
        print(f"nothing to correct: {apply} was not written")
    if following:
        print(f"next: {following}")
    if found.interrupted:
        raise typer.Exit(INTERRUPTED)


def announced(tell: Progress) -> Progress:
    """Progress of a fit with the network, which says first that it takes minutes."""
    begun = False

    def report(done: float, total: float, note: str = "") -> None:
        nonlocal begun
        if not begun:
            begun = True
            note_line = "candidates are fitted together with the network, which takes minutes"
            typer.echo(f"surgisoft: diagnose: {note_line}; --refit never skips it", err=True)
        tell(done, total, note)

    return report


def _following(command: str, predicted: bool, of_model: str) -> str:
    """The command to run next, with the options that say what MODEL is.

    predicted: whether the model is given by predictions, which cannot be amended.
    """
    name = command.split()[1]
    if name in ("amend", "improve") and predicted:
        return (
            "give the model as a callable (docs/your_model.md) to amend it: predictions of "
            "recorded rows cannot be amended"
        )
    return with_effect_files(command if name == "fit" else command + of_model)


def _next_after_setup(setup, model: Path, data: str, of_model: str, apply: str | None) -> None:
    """Print what to do about a fault of the set-up."""
    if not setup.correctable:
        if apply:
            print(f"{apply} was not written: this fault cannot be corrected in the recordings")
        print(f"next: {setup.instructions.splitlines()[0]}")
    elif apply:
        print(f"next: {with_effect_files(f'surgisoft diagnose {typed(model)} {apply}{of_model}')}")
    else:
        again = f"surgisoft diagnose {typed(model)} {data} --apply CORRECTED{of_model}"
        doubt = ", if the recordings are wrong" if setup.of_model else ""
        print(f"next{doubt}: {with_effect_files(again)}")


def _show_setup(setup) -> None:
    """Print how to correct the faults of a set-up."""
    print(f"recordings with this fault: {', '.join(setup.recordings)}")
    where = f" (--apply does it), {IN_A_MAP}" if setup.correctable else ""
    print(f"to correct it{where}:")
    print(textwrap.indent(setup.instructions, "  "))
    for other in setup.alternative_instructions:
        print("or, for the other explanation:")
        print(textwrap.indent(other, "  "))
    if setup.how_to_tell:
        print(setup.how_to_tell)


def _show(found) -> None:
    """Print the verdict, the ranking and the proposed experiment."""
    from surgisoft.diagnosis.residuals import floor_in_words

    verdict, error = found.verdict, found.error_mm
    print(f"{verdict.kind}: {verdict.sentence}")
    for name, words in found.in_words:
        print(f"{name}, first estimate: {words}")
    if found.since_fit:
        print(found.since_fit.sentence)
    if found.setup:
        _show_setup(found.setup)
        print(f"{found.seconds:.1f} s")
        return
    print(
        f"error {error.before:.4f} mm, floor {floor_in_words(error.floor, '.4f')}, "
        f"best achievable {error.best_achievable:.4f} mm (on {found.left_out})"
    )
    for check in found.checks:
        print(f"check: {check}")
    rows = "left-out RMSE" if found.in_fit else "held-out RMSE"
    if found.shown:
        print(f"{'effect':18s} {'conf.':>6s} {'alone':>7s} {'unique':>7s} {rows:>24s}")
    for row in found.shown:
        low, high = row.ci95
        print(
            f"{row.effect:18s} {row.confidence:6.2f} {100 * row.gain_alone:6.1f}% "
            f"{100 * row.gain_unique:6.1f}% {row.heldout_rmse_mm:10.4f} [{low:.4f}, {high:.4f}] mm"
        )
    if found.shown and error.discrepancy_alone is not None:
        print(f"{'no effect':41s}{error.discrepancy_alone:11.4f} mm (model discrepancy alone)")
    for each in found.not_testable:
        print(f"not testable: {each.effect}: {each.reason}")
    if found.implausible:
        names = ", ".join(found.implausible)
        print(f"not ranked, because of implausible parameters: {names}")
    if found.refit is not None:
        _show_refit(found.refit)
    if found.next_experiment:
        plan = found.next_experiment
        print(f"next experiment: {plan.name}, {plan.minutes:g} minutes, {plan.in_words}")
    print(f"{found.seconds:.1f} s")


def _show_refit(refit) -> None:
    """Print the candidates that were fitted together with the network."""
    print(f"fitted together with the network, because {refit.reason}:")
    print(f"{'effect':18s} {'RMSE, of network alone':>28s} {'difference, 95 %':>28s} {'p':>7s}")
    for row in refit.candidates:
        low, high = row.ci95_mm
        note = "" if row.plausible else "  implausible parameters"
        print(
            f"{row.effect:18s} {row.heldout_rmse_mm:10.4f} of {row.rival_mm:8.4f} mm "
            f"{row.difference_mm:12.4f} [{low:.4f}, {high:.4f}] mm {row.p_value:7.4f}{note}"
        )
    rates = [name for name, why in refit.not_tried if why.startswith("steady-state")]
    if rates:
        print(f"not tried, because steady-state samples cannot show them: {', '.join(rates)}")
