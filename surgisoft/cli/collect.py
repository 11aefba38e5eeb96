"""`surgisoft collect`: record a protocol on a simulated rig."""

from pathlib import Path
from typing import Annotated, Any

import typer

from surgisoft.cli import app
from surgisoft.cli.options import SEED_MAX, Force, Hidden
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError


def _list_hidden(context: typer.Context, value: bool) -> None:
    if value:
        from surgisoft.rig.trial import hidden_of

        for name, effect in hidden_of(context.params.get("rig", "virtual")).items():
            print(f"{name:18s}{effect.place:10s}{effect.about}")
        raise typer.Exit


def _list_protocols(value: bool) -> None:
    if value:
        from surgisoft.measurement.protocols import PROTOCOLS

        for name, entry in PROTOCOLS.items():
            print(f"{name:12s}{entry.points:6d}  {entry.about}")
        print(
            "SCHEDULE.csv        columns t_s, c1_kPa ... cm_kPa, optional run; linear between rows"
        )
        raise typer.Exit


@app.command()
def collect(
    protocol: Annotated[
        str, typer.Argument(metavar="PROTOCOL", help="A protocol's name, or SCHEDULE.csv.")
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="REC", help="New recording, .parquet or .csv."),
    ],
    rig: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            is_eager=True,
            help="Simulated rig: virtual, or elastica (PyElastica's Cosserat rod; other robots, "
            "other physics).",
        ),
    ] = "virtual",
    seed: Annotated[
        int,
        typer.Option(
            "--seed",
            "--robot-seed",
            min=0,
            max=SEED_MAX,
            help="Seed of the robot; another seed is another arm of the same design (elastica: "
            "of another design).",
        ),
    ] = 0,
    trial: Annotated[
        int,
        typer.Option(
            "--trial",
            min=0,
            help="Number of the trial: same robot, other noise and random schedule.",
        ),
    ] = 0,
    points: Annotated[
        int | None,
        typer.Option(
            help="Number of steady-state points, or of frames at 20 Hz; default: by the protocol."
        ),
    ] = None,
    hidden: Hidden = None,
    strength: Annotated[
        list[float] | None,
        typer.Option(metavar="X...", help="Amplitudes of the hidden effects, in the same order."),
    ] = None,
    payload_g: Annotated[
        float, typer.Option("--payload-g", metavar="G", help="Known mass at the tip, in g.")
    ] = 0.0,
    gravity: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Direction of gravity in the arm base frame."),
    ] = None,
    roll_deg: Annotated[
        float,
        typer.Option(
            "--roll-deg",
            min=-360,
            max=360,
            metavar="DEG",
            help="Rotation of the base about its axis, degrees.",
        ),
    ] = 0.0,
    noise_scale: Annotated[
        float, typer.Option(help="Factor on all sensor and camera noise.")
    ] = 1.0,
    force: Force = False,
    list_hidden: Annotated[
        bool,
        typer.Option(
            "--list-hidden",
            callback=_list_hidden,
            is_eager=True,
            help="List the hidden effects of the rig (give --rig first).",
        ),
    ] = False,
    list_protocols: Annotated[
        bool,
        typer.Option(
            "--list-protocols", callback=_list_protocols, is_eager=True, help="List the protocols."
        ),
    ] = False,
) -> None:
    """Collect a recording on a simulated rig: the paper's arm, pumps and motion capture."""
    from surgisoft.measurement.recordings import save_recording
    from surgisoft.rig.trial import collect as collect_recording

    _check_output(output, force)
    effects = _pairs(hidden or [], strength or [])
    mount: dict[str, Any] = {
        "gravity": gravity,
        "roll_deg": roll_deg,
        "payload_g": payload_g,
        "noise": noise_scale,
    }
    with progress(f"collect {protocol}") as report:
        recording = collect_recording(
            protocol,
            rig,
            seed=seed,
            trial=trial,
            points=points,
            hidden=effects,
            progress=report,
            **{name: value for name, value in mount.items() if value is not None},
        )
    save_recording(recording, output, force)
    minutes = recording.t_s[-1] / 60
    secret = "".join(
        f", hidden {name} {size:g}" + "".join(f" from {begins_s:g} s on" for begins_s in late)
        for name, size, *late in effects
    )
    print(
        f"wrote {output}: {recording.samples} {recording.kind} samples of {recording.chambers} "
        f"chambers and {recording.key_points} key points in {len(recording.runs)} runs, "
        f"{minutes:.0f} min on the bench, noise {recording.noise_mm:.3f} mm{secret}"
    )


def _pairs(given: list[str], strengths: list[float]) -> list:
    """Hidden effects with their amplitudes, 1 where none is given, and times of beginning."""
    if len(strengths) not in (0, len(given)):
        raise InputError(
            f"{len(given)} --hidden and {len(strengths)} --strength, expected one for each"
        )
    if strengths and any(":" in text for text in given):
        raise InputError("--hidden NAME:X and --strength both give amplitudes; use one of them")
    from surgisoft.rig.trial import hidden_effects

    pairs = hidden_effects(given)
    if not strengths:
        return pairs
    return [(name, x, *late) for (name, _, *late), x in zip(pairs, strengths, strict=True)]


def _check_output(path: Path, force: bool) -> None:
    """Raise InputError before the work starts, where its result could not be written."""
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{path}: suffix '{path.suffix}', expected .csv or .parquet")
    if path.exists() and not force:
        raise InputError(f"{path}: exists already; choose another name or use --force")
