"""`surgisoft fit`: fit an arm model to recordings."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from surgisoft.cli import INTERRUPTED, app
from surgisoft.cli.inputs import read_recordings, warn
from surgisoft.cli.options import (
    SEED_MAX,
    EffectFiles,
    Force,
    Recordings,
    Threads,
    complete_memories,
    given_options,
    typed_once,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.errors import Interrupted

if TYPE_CHECKING:
    from surgisoft.surrogate.model import Validation

ABOVE_NOISE = 2.0
"""Ratio of the held-out error to the noise from which `fit` advises to try effects with memory."""
WIDTHS = "128,128,128,128"
"""Default of --widths."""
INPUTS: Literal["pressure+direction"] = "pressure+direction"
"""Default of --inputs."""
ACTUATION: Literal["measured"] = "measured"
"""Default of --actuation."""
MEMBERS = 1
"""Default of --members: no ensemble."""
EPOCHS = 200
"""Default of --epochs."""


@app.command()
def fit(
    recordings: Recordings,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="MODEL", help="Folder of the new model.")
    ],
    valid: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="REC...",
            help="Validation recordings that select the model; default: whole runs, or blocks of "
            "time, of the training recordings are held out.",
        ),
    ] = None,
    inputs: Annotated[
        Literal["pressure", "pressure+direction"],
        typer.Option(help="Inputs of the network for each chamber."),
    ] = INPUTS,
    effects: Annotated[
        list[str] | None,
        typer.Option(
            "--effects",
            metavar="NAME|FILE.py...",
            autocompletion=complete_memories,
            help="Physical effects of the line or the material to add, such as hysteresis, or "
            "files of user-defined effects (docs/effects.md); auto: held-out data choose among "
            "those with memory.",
        ),
    ] = None,
    network: Annotated[
        Literal["haw_nn", "kernel", "auto", "constant_curvature", "recurrent"],
        typer.Option(
            help="haw_nn: HAW-NN; kernel: arcs and kernel regression on the actuation and its low "
            "passes, for small data sets; auto: haw_nn or kernel, whichever has the lower held-out "
            "error; constant_curvature and recurrent: baselines."
        ),
    ] = "haw_nn",
    prior: Annotated[
        Literal["none", "arcs"] | None,
        typer.Option(
            help="Prior mean: a chain of arcs, fitted first; the network learns the remainder. It "
            "lowers the error on motions unlike those of the recordings. Default: arcs with "
            "haw_nn, unless the network alone has less held-out error; none: the network alone.",
        ),
    ] = None,
    members: Annotated[
        int,
        typer.Option(
            min=1,
            help="Number of networks in an ensemble, whose mean is the prediction; each is trained "
            "without a different part of the data. Lower error with small data sets; slower "
            "to evaluate.",
        ),
    ] = MEMBERS,
    widths: Annotated[
        str, typer.Option(metavar="N,N...", help="Widths of HAW-NN's hidden layers.")
    ] = WIDTHS,
    actuation: Annotated[
        Literal["measured", "commanded"],
        typer.Option(help="Which actuation is the model's input."),
    ] = ACTUATION,
    epochs: Annotated[
        int,
        typer.Option(min=1, help="Largest number of epochs of a stage; fewer than 10 count as 10."),
    ] = EPOCHS,
    seed: Annotated[
        int,
        typer.Option(
            min=0, max=SEED_MAX, help="Seed of weights, order of rows and held-out blocks."
        ),
    ] = 0,
    threads: Threads = 1,
    effect_files: EffectFiles = None,
    force: Force = False,
) -> None:
    """Fit an arm model (HAW-NN, optionally with effects) to recordings.

    Forward selection from pressure to effects to direction: an addition is accepted only if it
    lowers the held-out error significantly. Inputs that the recordings cannot identify are left
    out and reported. Ctrl-C keeps the best model so far, and its report.json says where the fit was
    interrupted; before the first validation nothing is written.
    """
    train = read_recordings(recordings)
    held = read_recordings(valid) if valid else None

    from surgisoft.measurement.fitting import fit as fit_model
    from surgisoft.surrogate.checkpoint import claim_folder, save_model
    from surgisoft.surrogate.fit import rms_of_loss
    from surgisoft.surrogate.networks import parse_widths

    claim_folder(output, force)

    trainings, last = 0, ("", 0)

    def tell(stage: str, epoch: int, of: int, loss: float) -> None:
        nonlocal trainings, last
        # The same effect may be trained twice in a row, for less and for more epochs.
        trainings += stage != last[0] or epoch <= last[1]
        last = stage, epoch
        # The kernel's loss is that of the result, the others weigh key points by their motion.
        what = "held-out RMSE" if stage == "kernel" else "held-out RMS weighted by motion"
        part = f"training {trainings} ({stage}), {epoch} of {of}"
        report.step(epoch, of, f"{part}: {what} {rms_of_loss(stage, loss):.4f} mm")

    with progress("fit") as report:
        try:
            result = fit_model(
                train,
                held,
                actuation=actuation,
                threads=threads,
                progress=tell,
                network=network,
                inputs=inputs,
                effects=[name for item in effects or [] for name in item.split(",")],
                hidden=parse_widths(widths),
                prior=prior,
                members=members,
                epochs=epochs,
                seed=seed,
            )
        except Interrupted as ended:
            result = ended.result
    save_model(result.model, output, result.report(), force)
    for line in result.lines():
        print(line)
    print(f"wrote {output}: {result.model.summary()}")
    if result.interrupted is not None:
        warn(result.interrupted.sentence)
        raise typer.Exit(INTERRUPTED)
    moved = any(recording.kind == "continuous" for recording in train)
    if not effects and network == "haw_nn" and moved and above_noise(result.model.validation):
        given = {
            "--inputs": None if inputs == INPUTS else inputs,
            "--prior": prior,
            "--members": None if members == MEMBERS else members,
            "--widths": None if widths == WIDTHS else widths,
            "--actuation": None if actuation == ACTUATION else actuation,
            "--epochs": None if epochs == EPOCHS else epochs,
            "--seed": seed or None,
            "--threads": None if threads == 1 else threads,
        }
        new = typed(f"{output}_with_effects")
        files = typed_once(recordings) + (f" --valid {typed_once(valid)}" if valid else "")
        again = f"surgisoft fit {files}{given_options(given)} --effects auto -o {new}"
        again = with_effect_files(again)
        print(f"next, whether the arm has memory that this model lacks: {again}")
    following = with_effect_files(
        f"surgisoft compare {typed(output)} TEST.parquet --test --report PAGE"
    )
    print(f"next, its error on an unseen recording: {following}")


def above_noise(error: "Validation") -> bool:
    """Whether a model's held-out error is well above the noise of the cameras, or that is not
    known."""
    return error.noise_mm is None or (error.rmse_mm or 0.0) > ABOVE_NOISE * error.noise_mm
