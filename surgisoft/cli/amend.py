"""`surgisoft amend`: add physical effects to a model and validate the result."""

from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.amended import (
    NOT_CLAIMED,
    claim_other_folder,
    show_parameters,
    write_before_and_after,
)
from surgisoft.cli.files import check_folder, check_free, check_replay, show_written
from surgisoft.cli.inputs import check_model, read_before, read_recordings, warn_all
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
    Refit,
    Replay,
    Report,
    before_options,
    complete_effects,
    given_options,
    model_options,
    typed_once,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.files import write_json


@app.command()
def amend(
    model: Model,
    effects: Annotated[
        list[str],
        typer.Option(
            "--effect",
            metavar="NAME|FILE.py...",
            autocompletion=complete_effects,
            help="Effects to add, separated by spaces or commas. An effect that the model has "
            "already is fitted again.",
        ),
    ],
    data: Annotated[
        list[Path],
        typer.Option(metavar="REC...", help="Recordings (.csv, .parquet) or folders of them."),
    ],
    output: NewModel,
    before: Before = None,
    paired: Paired = "auto",
    json_file: JsonFile = None,
    report: Report = None,
    replay: Replay = None,
    effect_files: EffectFiles = None,
    force: Force = False,
    anyway: Annotated[
        bool,
        typer.Option(
            "--anyway",
            help="Write NEW even if no reduction of the held-out error is claimed.",
        ),
    ] = False,
    keep_network: Annotated[
        bool,
        typer.Option(
            "--keep-network",
            help="Do not change the network. By default its last layer is fitted again with the "
            "effects if that lowers the error of the quarters of the training part that are left "
            "out of both fits in turn.",
        ),
    ] = False,
    refit: Refit = "auto",
    model_error: ModelError = None,
) -> None:
    """Amend a model: add a physical effect and validate it on held-out data.

    The parameters are fitted to the first three quarters of each recording and validated on the
    last quarter. If the error does not fall significantly, or if the model was already fitted to
    these rows, nothing is claimed or written (exit code 1).
    """
    check_free(json_file, "error_mm")
    check_folder(report)
    check_replay(replay)
    check_model(model)
    measured = read_recordings(data)
    earlier = read_before(before, paired)
    claim_other_folder(output, model, force)

    from surgisoft.diagnosis.amend import amend as amend_model
    from surgisoft.surrogate.checkpoint import save_model
    from surgisoft.surrogate.effects import named_effects

    # Files of effects first: the model may hold one of them.
    names = named_effects(name for given in effects for name in given.split(",") if name)
    with progress("amend") as tell:
        stages = iter(range(100))
        result = amend_model(
            model,
            measured,
            names,
            not keep_network,
            lambda text: tell.step(next(stages), 4, text),
            before=earlier,
            paired=paired,
            refit=refit,
            refit_progress=tell,
            processes=REFIT_PROCESSES,
            error_mm=model_error,
        )
    warn_all(result.notes)
    saved = result.claimed or anyway
    written = []
    if saved:
        save_model(result.model, output, result.to_json(), force)
    if json_file:
        write_json(json_file, result.to_json())
        written.append(json_file)
    if report:
        from surgisoft.diagnosis.pages.amendment import amend_page
        from surgisoft.report import write_page

        title = f"{model.name} with {' + '.join(result.effects)}"
        page = amend_page(result, title, result.model.summary())
        written.append(write_page(page, report / "report.html"))
    if replay:
        from surgisoft.diagnosis.compare import tables_of

        tables = tables_of({"before": model, "after": result.model}, measured, model_error)
        written.append(write_before_and_after(result, tables, model.name, replay))
    for name in result.refitted:
        print(f"{name}: the model had this effect already; its parameters were fitted again")
    for name in result.effects:
        if "#" in name:
            print(
                f"{name}: added beside the one of the model, because fitting that one again leaves "
                "a larger error"
            )
    show_parameters(result.parameters, result.in_words)
    if result.retuned:
        print(
            "the network's last layer was fitted again, which lowers the error of the quarters of "
            "the training part that were left out of both fits in turn"
        )
    if result.refit is not None:
        print(f"{result.refit.sentence}, with parts of the training data left out")
    show_written(written)
    print(result.sentence)
    if saved:
        print(f"wrote {output}: {result.model.summary()}")
        files = typed_once(data)
        same = given_options({"--refit": None if refit == "auto" else refit})
        following = f"surgisoft diagnose {typed(output)} {files}{same}"
        if before:
            same = before_options(before, paired) + model_options(None, model_error) + same
            following = f"surgisoft improve {typed(model)} {files}{same} -o OTHER"
        print(f"next, find further effects: {with_effect_files(following)}")
    else:
        print(f"{output} was not written; --anyway writes it nevertheless", flush=True)
    if not result.claimed:
        raise typer.Exit(NOT_CLAIMED)
