"""`surgisoft collect`: record a protocol on a rig."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surgisoft.cli import app
from surgisoft.cli.files import check_folder
from surgisoft.cli.inputs import check_model, warn
from surgisoft.cli.options import (
    SEED_MAX,
    EffectFiles,
    Force,
    Hidden,
    NewRecording,
    Preflight,
)
from surgisoft.cli.options import Rig as RigOption
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError, counted

if TYPE_CHECKING:
    from surgisoft.measurement.recordings import Recording
    from surgisoft.rig import Rig

STOP_NOTE = "space bar, Esc or Ctrl-C: emergency stop; the rig is vented at the end"
"""What a command says before it drives a real rig."""


def _list_hidden(context: typer.Context, value: bool) -> None:
    if value:
        from surgisoft.rig.registry import hidden_of

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
    output: NewRecording,
    rig: RigOption = "virtual",
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed",
            "--robot-seed",
            min=0,
            max=SEED_MAX,
            help="Seed of the random schedule, and of the robot on a simulated rig; another seed "
            "is another arm of the same design (elastica: of another design). Default 0.",
        ),
    ] = None,
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
        float | None, typer.Option("--payload-g", metavar="G", help="Known mass at the tip, in g.")
    ] = None,
    gravity: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Direction of gravity in the arm base frame."),
    ] = None,
    roll_deg: Annotated[
        float | None,
        typer.Option(
            "--roll-deg",
            min=-360,
            max=360,
            metavar="DEG",
            help="Rotation of the base about its axis, degrees.",
        ),
    ] = None,
    noise_scale: Annotated[
        float | None,
        typer.Option(help="Factor on all sensor and camera noise of a simulated rig."),
    ] = None,
    preflight: Preflight = False,
    arm: Annotated[
        Path | None,
        typer.Option(metavar="MODEL", help="With --preflight: the model of this arm."),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="On a real rig: show what would be sent, send and write nothing."
        ),
    ] = False,
    effect_files: EffectFiles = None,
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
    """Collect a recording on a rig, by default the virtual one."""
    from surgisoft.measurement.recordings import save_recording

    if not dry_run:
        check_new_recording(output, force)
    if preflight and arm is None:
        raise InputError("--preflight: expected the model of this arm too; add --arm MODEL")
    if arm is not None and not preflight:
        raise InputError("--arm names the model of the pre-flight check; add --preflight")
    if dry_run and preflight:
        raise InputError(
            "--dry-run sends nothing, and --preflight moves the arm; expected one of them"
        )
    effects = _pairs(hidden or [], strength or [])
    mount = {
        "gravity": gravity,
        "roll_deg": roll_deg,
        "payload_g": payload_g,
        "noise": noise_scale,
    }
    given = {name: value for name, value in mount.items() if value is not None}
    fields: dict[str, Any] = {"seed": seed, "trial": trial, "points": points, **given}
    if dry_run:
        from surgisoft.rig.trial import dry_run as show_commands

        show_commands(protocol, rig, print, hidden=effects, **fields)
        return
    recording, log = record_on(
        protocol, rig, output, force, preflight=arm, hidden=effects, **fields
    )
    save_recording(recording, output, force)
    drop_log(log)
    print(written_line(output, recording, effects))


def drop_log(log: Path | None) -> None:
    """Remove the log of a recording that is complete; a simulated rig has written none."""
    if log is not None:
        log.unlink(missing_ok=True)


def log_of(output: Path) -> Path:
    """The log beside a recording, to which samples of a real rig are appended."""
    return output.with_name(f"{output.stem}.log.jsonl")


def record_on(
    protocol: str | Path,
    rig: str,
    output: Path,
    force: bool = False,
    preflight: Path | None = None,
    **fields: Any,
) -> tuple[Recording, Path | None]:
    """Record a protocol on a rig with a progress bar; fields: as for `surgisoft.collect`.

    Returns the recording, and its log where the rig is a real one. What a real rig measures goes to
    this log beside `output` at once, and stays there where the run is interrupted. preflight: an
    arm model whose motions a real rig has to show first.
    """
    from surgisoft.measurement.recordings.log import check_log_free
    from surgisoft.rig.interface import is_simulated
    from surgisoft.rig.registry import may_be_real
    from surgisoft.rig.trial import collect as collect_recording

    may_move = may_be_real(rig)
    no_preflight = InputError("--preflight is for real rigs, and this one is simulated")
    if preflight and not may_move:
        raise no_preflight
    log = log_of(output)
    if may_move:
        check_log_free(log, force)
    former = _state(log)
    check = checked_by(preflight) if preflight else None

    def before(rig: Rig) -> None:
        if is_simulated(rig):
            if check:
                raise no_preflight
            return
        warn(STOP_NOTE)
        if check:
            check(rig)

    try:
        with progress(f"collect {protocol}") as report:
            recording = collect_recording(
                protocol,
                rig,
                progress=report,
                log=log,
                force=force,
                before=before if may_move else None,
                **fields,
            )
            return recording, log if _state(log) not in (None, former) else None
    except BaseException:
        if _state(log) not in (None, former):
            warn(f"what was measured so far is in {log}, which every command opens as a recording")
        raise


def _state(file: Path) -> tuple[int, int, int] | None:
    """What differs once a file is written anew or replaced; None where there is none."""
    if not file.exists():
        return None
    found = file.stat()
    return found.st_ino, found.st_mtime_ns, found.st_size


def checked_by(model: Path) -> Callable[[Rig], None]:
    """The pre-flight check of a rig against a model; it raises InputError where it fails."""
    check_model(model)
    from surgisoft.rig.preflight import preflight
    from surgisoft.surrogate.checkpoint import load_model
    from surgisoft.surrogate.reach import steady_key_points

    arm = load_model(model)

    def check(rig: Rig) -> None:
        preflight(rig, lambda pressures: steady_key_points(arm, pressures)).require()

    return check


LONG_S = 120.0
"""Time on the bench from which it is stated in minutes, s."""


def written_line(path: Path, recording: Recording, hidden: Sequence[Sequence] = ()) -> str:
    """One line about a recording that was written."""
    # the clock of a rig may begin anew with each run
    times_s = recording.t_s.tolist()
    bench_s = times_s[0] + sum(max(b - a, 0.0) for a, b in pairwise(times_s))
    time = f"{bench_s / 60:.0f} min" if bench_s >= LONG_S else f"{bench_s:.0f} s"
    noise = "" if recording.noise_mm is None else f", noise {recording.noise_mm:.3f} mm"
    secret = "".join(
        f", hidden {name} {size:g}" + "".join(f" from {begins_s:g} s on" for begins_s in late)
        for name, size, *late in hidden
    )
    return (
        f"wrote {path}: {recording.samples} {recording.kind} samples of "
        f"{counted(recording.chambers, 'chamber')} and "
        f"{counted(recording.key_points, 'key point')} in {counted(len(recording.runs), 'run')}, "
        f"{time} on the bench{noise}{secret}"
    )


def _pairs(given: list[str], strengths: list[float]) -> list:
    """Hidden effects with their amplitudes, 1 where none is given, and times of beginning."""
    if len(strengths) not in (0, len(given)):
        raise InputError(
            f"{len(given)} --hidden and {len(strengths)} --strength, expected one for each"
        )
    if strengths and any(":" in text for text in given):
        raise InputError("--hidden NAME:X and --strength both give amplitudes; use one of them")
    from surgisoft.rig.registry import hidden_effects

    pairs = hidden_effects(given)
    if not strengths:
        return pairs
    return [(name, x, *late) for (name, _, *late), x in zip(pairs, strengths, strict=True)]


def check_new_recording(path: Path, force: bool) -> None:
    """Raise InputError before the work starts, where its result could not be written."""
    from surgisoft.measurement.recordings import check_writable

    check_writable(path, force)
    check_folder(path.absolute().parent)
