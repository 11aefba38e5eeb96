"""`surgisoft collect`: a recording from the virtual rig."""

from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError


@app.command()
def collect(
    protocol: Annotated[
        str, typer.Argument(metavar="PROTOCOL", help="A protocol's name, or a schedule's CSV file.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="New recording, .parquet or .csv.")
    ],
    seed: Annotated[int, typer.Option(min=0, help="Which specimen of the arm was cast.")] = 0,
    take: Annotated[
        int, typer.Option(min=0, help="Another take: same arm, other noise and random schedule.")
    ] = 0,
    points: Annotated[
        int | None, typer.Option(help="Settled points, or frames at 20 Hz; default: protocol's.")
    ] = None,
    payload_g: Annotated[
        float, typer.Option("--payload-g", help="Known mass at the tip [g].")
    ] = 0.0,
    gravity: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Direction of weight in the arm base frame."),
    ] = None,
    roll_deg: Annotated[
        float, typer.Option("--roll-deg", help="Turn of the base about its axis [deg].")
    ] = 0.0,
    noise_scale: Annotated[
        float, typer.Option(help="Factor on all sensor and camera noise.")
    ] = 1.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing recording.")] = False,
) -> None:
    """Collect a recording on the virtual rig: the paper's arm, pumps and motion capture."""
    from surgisoft.measurement.protocols import make_protocol
    from surgisoft.measurement.recording import save_recording
    from surgisoft.measurement.rig import VirtualRig
    from surgisoft.measurement.rig.virtual import MOUNT

    _check_output(output, force)
    rig = VirtualRig(
        seed,
        gravity=gravity or MOUNT,
        roll_deg=roll_deg,
        payload_g=payload_g,
        noise=noise_scale,
        take=take,
    )
    plan = make_protocol(protocol, rig.limits, points, seed=seed + 1_000_003 * take)
    with progress(f"collect {plan.name}") as report:
        recording, _ = rig.record(plan, report)
    save_recording(recording, output, force)
    minutes = recording.t_s[-1] / 60
    print(
        f"wrote {output}: {recording.samples} {recording.kind} samples of {recording.chambers} "
        f"chambers and {recording.key_points} key points in {len(recording.runs)} runs, "
        f"{minutes:.0f} min on the bench, noise {recording.noise_mm:.3f} mm"
    )


def _check_output(path: Path, force: bool) -> None:
    """Say before the work what would stop it after."""
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{path}: suffix '{path.suffix}', expected .csv or .parquet")
    if path.exists() and not force:
        raise InputError(f"{path}: exists already; choose another name or use --force")
