"""`surgisoft improve`: repeat diagnose and amend until no further effect is significant."""

from typing import Annotated

import typer

from surgisoft.cli import INTERRUPTED, app
from surgisoft.cli.amended import (
    NOT_CLAIMED,
    claim_other_folder,
    show_parameters,
    write_before_and_after,
)
from surgisoft.cli.files import check_folder, check_free, check_replay, show_written
from surgisoft.cli.inputs import check_model, read_before, read_recordings, warn, warn_all
from surgisoft.cli.options import (
    REFIT_PROCESSES,
    Before,
    EffectFiles,
    Force,
    JsonFile,
    Model,
    ModelError,
    NewModel,
    Paired,
    Recordings,
    Refit,
    Replay,
    Report,
    before_files,
    before_options,
    given_options,
    model_options,
    typed_once,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.errors import Interrupted
from surgisoft.files import write_json

MOST = 6
"""Default of --max-effects."""


@app.command()
def improve(
    model: Model,
    recordings: Recordings,
    output: NewModel,
    most: Annotated[
        int, typer.Option("--max-effects", min=1, help="Largest number of effects to add.")
    ] = MOST,
    before: Before = None,
    paired: Paired = "auto",
    json_file: JsonFile = None,
    report: Report = None,
    replay: Replay = None,
    refit: Refit = "auto",
    model_error: ModelError = None,
    effect_files: EffectFiles = None,
    force: Force = False,
) -> None:
    """Improve a model: repeat diagnosis and amendment until no further effect is significant.

    The result is validated on the last quarter of each recording. If no effect was added, or the
    error did not fall significantly, nothing is written (exit code 1). With --before, the change
    since those recordings is named and added, and the network stays as it is. Ctrl-C keeps the
    finished rounds: their model, report and errors.
    """
    check_free(json_file, "rounds")
    check_folder(report)
    check_replay(replay)
    check_model(model)
    measured = read_recordings(recordings)
    earlier = read_before(before, paired)
    claim_other_folder(output, model, force)

    from surgisoft.diagnosis.improve import improve as improve_model
    from surgisoft.surrogate.checkpoint import save_model

    with progress("improve") as tell:
        done, furthest = [], 0.0

        def after(each) -> None:
            done.append(each)
            tell.step(len(done), most + 2, each.step or each.verdict)

        def within(share: float, total: float, note: str = "") -> None:
            """Progress of a fit together with the network, which is part of a round."""
            nonlocal furthest
            furthest = max(furthest, len(done) + (share / total if total else 0.0))
            tell.step(furthest, most + 2, note)

        try:
            result = improve_model(
                model,
                measured,
                most,
                after,
                refit=refit,
                refit_progress=within,
                processes=REFIT_PROCESSES,
                error_mm=model_error,
                before=earlier,
                paired=paired,
            )
        except Interrupted as ended:
            result = ended.result
            warn("interrupted; writing the rounds that are finished (Ctrl-C again ends at once)")
    warn_all(result.notes)
    written = []
    if result.claimed:
        save_model(result.model, output, result.to_json(), force)
    if json_file:
        write_json(json_file, result.to_json())
        written.append(json_file)
    if report or replay:
        from surgisoft.diagnosis.compare import tables_of

        tables = tables_of({"before": model, "after": result.model}, measured, model_error)
    if report:
        from surgisoft.diagnosis.pages.amendment import write_improve_report

        names = ", ".join(recording.name for recording in measured)
        title = f"What {model.name} lacks on {names}"
        # The model that the last diagnosis is of, if it is written.
        last = output if result.claimed else model
        # What was amended to a change is not compared with the recordings from before it again.
        earlier_files = None if result.claimed else before
        pairing, alone = before_files(earlier_files, paired), typed_once(before or [])
        given = (typed_once(recordings), pairing, alone)
        of_last = "" if result.claimed else model_options(None, model_error)
        command = _command(result.diagnoses[-1], typed(last), given, of_last)
        written += write_improve_report(result, tables, report, title, command)
    if replay:
        written.append(write_before_and_after(result, tables, model.name, replay))
    _show(result)
    show_written(written)
    # The last round has told why.
    told = f": {result.rounds[-1].sentence}" if result.rounds else ""
    print(result.sentence.removesuffix(told))
    if not result.claimed:
        print(f"{output} was not written")
        if result.interrupted:
            raise typer.Exit(INTERRUPTED)
        read = typed_once(recordings), before_files(before, paired), typed_once(before or [])
        if again := _following(result, typed(model), read, model_options(None, model_error)):
            print(f"next: {again}")
        raise typer.Exit(NOT_CLAIMED)
    print(f"wrote {output}: {result.model.summary()}")
    if result.interrupted:
        files = typed_once(recordings)
        start = typed(model if before else output)
        same = {
            "--max-effects": None if most == MOST else most,
            "--refit": None if refit == "auto" else refit,
        }
        options = ""
        if before:
            options = before_options(before, paired) + model_options(None, model_error)
        options += given_options(same)
        again = f"surgisoft improve {start} {files}{options} -o OTHER"
        following = with_effect_files(again)
        print(f"next, to seek further effects: {following}")
        raise typer.Exit(INTERRUPTED)
    known = result.model.fitted_rows
    test = "TEST.parquet --test" if known is not None and known.complete else "TEST.parquet"
    both = f"{typed(model, output)} {test}{model_options(None, model_error)}"
    following = with_effect_files(f"surgisoft compare {both} --report PAGE")
    print(f"next, both models on an unseen recording: {following}")


def _following(result, model: str, files: tuple[str, str, str], of_model: str) -> str:
    """The command to run next where nothing was added: what `diagnose` recommends; empty where that
    is to add the effect that did not lower the error.

    model, files: the model, the recordings, those of `--before` with how to pair them, and those
    alone, as they are typed.
    """
    from surgisoft.diagnosis.decision import NAMING

    if result.steps or not result.diagnoses:
        return ""
    found = result.diagnoses[-1]
    if found.setup is not None and found.setup.correctable:
        again = f"surgisoft diagnose {model} {files[0]} --apply CORRECTED{of_model}"
        return with_effect_files(again)
    return "" if found.verdict.kind in NAMING else _command(found, model, files, of_model)


def _command(found, model: str, files: tuple[str, str, str], of_model: str) -> str:
    """What a diagnosis recommends, as a command with the options of its model; empty without."""
    if not found.next_command:
        return ""
    command = found.command(model, *files)
    return with_effect_files(command if command.split()[1] == "fit" else command + of_model)


def _show(result) -> None:
    """Print each round, then the parameters and the errors on the held-out part."""
    from surgisoft.diagnosis.residuals import floor_in_words

    for number, done in enumerate(result.rounds, 1):
        what = f"+ {done.step}" if done.step else "no further effect"
        what = "interrupted" if done.verdict == "interrupted" else what
        what += ", fitted anew in its best form" if done.anew else ""
        what += ", fitted together with the network" if done.together else ""
        competing = f" (or {', '.join(done.competing)})" if done.competing else ""
        print(f"round {number}: {done.verdict}: {done.sentence}")
        print(f"  {what}{competing}: error on the training part {done.error_training_mm:.4f} mm")
    if result.steps:
        show_parameters(result.parameters, result.in_words)
        fall = result.held_out
        width = max(len(name) for name, _ in result.steps) + 2
        part = "the held-out part"
        if result.model_error is not None:
            part = "the held-out part, of the change that is not explained"
        if fall.in_fit:
            part = f"the last part, of which the model had been fitted to {fall.in_fit:.0%}"
        print(f"{'before':{width}s} {fall.before:8.4f} mm on {part}")
        for name, error in result.steps:
            print(f"{'+ ' + name:{width}s} {error:8.4f} mm")
        print(f"{'floor':{width}s} {floor_in_words(fall.floor, '8.4f')}")
