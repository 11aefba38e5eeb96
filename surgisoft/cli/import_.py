"""`surgisoft import`: convert other files to recordings; `surgisoft recording`: summarise them."""

import textwrap
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.inputs import IN_A_MAP, check_model, read_recordings, warn
from surgisoft.cli.options import EffectFiles, Force, Recordings
from surgisoft.command_line import typed
from surgisoft.errors import InputError, counted
from surgisoft.files import resolved

if TYPE_CHECKING:
    from surgisoft.surrogate.model import ArmModel

MEANING = {"measured": "the actuation", "key_points": "key points"}
"""What the required tables of a map hold, for messages."""


@app.command("import")
def import_(
    raw: Annotated[
        list[Path], typer.Argument(metavar="RAW", help="Raw files, or folders of them.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="REC",
            help="New recording (.csv or .parquet), or a folder with one recording per raw file.",
        ),
    ] = None,
    map_name: Annotated[
        str | None,
        typer.Option(
            "--map",
            metavar="MAP.toml",
            help="Map file; or motive or motive-bodies, the maps for files of OptiTrack Motive. "
            "The log of an interrupted recording (.jsonl), and a LeRobotDataset with the names of "
            "a recording, need no map.",
        ),
    ] = None,
    delay_s: Annotated[
        float | None,
        typer.Option(
            "--delay-s",
            metavar="S",
            help="Delay of the log of the actuation, s, in place of delay_s in the table measured "
            "(and commanded, if it is in the same file) of the map, which then serves recordings "
            "whose clocks were started by hand.",
        ),
    ] = None,
    draft: Annotated[
        Path | None,
        typer.Option(
            metavar="NEW.toml",
            help="Only write a draft of the map, from the names of the columns of one file, or of "
            "the files of one recording; check it before you use it.",
        ),
    ] = None,
    force: Force = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be written to REC; write nothing.")
    ] = False,
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="MODEL",
            help="Model of the arm: the set-up is tested against it, as `diagnose` does.",
        ),
    ] = None,
    effect_files: EffectFiles = None,
) -> None:
    """Import a laboratory's files as recordings; a map states columns, units and frames.

    Reports what looks wrong: lengths, reversed key points, clocks that differ. With a model of the
    arm, frames, units, orders, chambers and dead channels are tested, too.
    """
    from surgisoft.measurement.importing import import_recordings
    from surgisoft.measurement.recordings import (
        check_writable,
        find_warnings,
        save_recording,
        summary,
    )
    from surgisoft.memory import keep_freed_memory

    if draft is not None:
        others = {"-o": output, "--map": map_name, "--dry-run": dry_run, "--model": model}
        others["--delay-s"] = delay_s is not None
        if unused := [option for option, value in others.items() if value]:
            raise InputError(
                f"--draft with {' and '.join(unused)}: --draft only writes a draft of a map, "
                f"expected no {' or '.join(unused)}; import with the map once it is checked"
            )
        _draft(raw, draft, force)
        return
    if output is None:
        raise InputError("-o is missing: a new recording (.csv, .parquet) or a folder for them")
    keep_freed_memory()
    arm = None
    if model:
        check_model(model)
        from surgisoft.surrogate.checkpoint import load_model

        arm = load_model(model)
    to_file = bool(output.suffix[1:].isalpha() and not output.is_dir())
    if to_file and output.suffix not in (".csv", ".parquet"):
        raise InputError(f"{output}: suffix '{output.suffix}', expected .csv, .parquet or a folder")
    name = output.stem if to_file else None
    parts = import_recordings(raw, map_name, name, delay_s)
    if to_file and len(parts) > 1:
        raise InputError(f"{output}: {len(parts)} recordings, expected a folder for them")
    targets = [output if to_file else output / f"{part.recording.name}.parquet" for part in parts]
    if arm:
        from surgisoft.measurement.histories import check_fits

        check_fits(arm.spec, [part.recording for part in parts], sized=False)
    given = [Path(map_name)] if map_name else []
    _check_kept([*given, *(file for part in parts for file in part.files)], targets)
    for target in targets if not dry_run else []:
        check_writable(target, force)
    if not dry_run:
        for part, target in zip(parts, targets, strict=True):
            save_recording(part.recording, target, force)
    for part, target in zip(parts, targets, strict=True):
        for note in part.notes:
            print(f"note: {note}")
        for warning in part.warnings:
            warn(f"{target}: {warning}")
        for found in find_warnings(part.recording):
            warn(f"{target}, row {found.sample + 1}: {found.text}")
        first, *rest = summary(part.recording)
        about = first.partition(": ")[2]
        print(f"{'would write' if dry_run else 'wrote'} {target}: {about}", *rest, sep="\n")
    if arm:
        _test_setup(arm, str(model), [part.recording for part in parts], targets)


def _check_kept(read: list[Path], targets: list[Path]) -> None:
    """Raise where a recording or its sidecar would replace a file that it is made from."""
    from surgisoft.measurement.recordings.sidecar import sidecar_of

    kept = {resolved(file): file for file in read}
    for target in targets:
        for place in (target, sidecar_of(target)):
            if resolved(place) in kept:
                what = "" if place == target else f"is the sidecar of {target} and "
                raise InputError(
                    f"{place}: {what}is read by this import, expected a new file; choose another "
                    "name with -o"
                )


def _draft(raw: list[Path], place: Path, force: bool) -> None:
    """Write a draft of the map of a raw file, or of the files of one recording."""
    from surgisoft.files import write_atomically
    from surgisoft.measurement.importing import draft_of_map

    for path in raw:
        if path.is_dir():
            inside = sorted(file for file in path.iterdir() if file.is_file())
            such = f", such as {inside[0]}" if inside else ""
            raise InputError(f"--draft: {path} is a folder, expected one file of it{such}")
    if place.suffix != ".toml":
        raise InputError(f"{place}: suffix '{place.suffix}', expected .toml")
    if place.exists() and not force:
        raise InputError(f"{place}: exists already; choose another name or use --force")
    drafted = draft_of_map(raw)
    write_atomically(place, drafted.text)
    print(
        f"wrote {place}: a draft; check every line, above all the {drafted.checks} marked 'check'"
    )
    for table in drafted.lacks:
        print(
            f"lacks [{table}]: no columns of {MEANING[table]} are recognised; fill in this table "
            f"first, or add the file that has them: surgisoft import {typed(*raw)} OTHER --draft "
            f"{typed(place)} --force"
        )
    following = "then" if drafted.lacks else "next"
    print(
        f"{following}: surgisoft import {typed(*raw)} --map {typed(place)} -o REC.parquet --dry-run"
    )


def _test_setup(arm: "ArmModel", name: str, recordings: list, files: list[Path]) -> None:
    """Print what a model shows to be wrong with the set-up of recordings, which become these files;
    name: of the model."""
    from surgisoft.diagnosis.residuals import WHOSE_ARM, fit_of_model
    from surgisoft.diagnosis.setup import find_setup_faults, find_small_frame

    found = find_setup_faults(arm, recordings)
    if found is None:
        fit = fit_of_model(arm, recordings)
        if fit is None:
            print(f"set-up faults: none found by comparison with {name}")
            return
        error = f"error {fit.rmse_mm:.3g} mm, expected about {fit.expected_mm:.3g} mm"
        if fit.fits:
            print(f"set-up faults: none found by comparison with {name} ({error})")
            return
        moved = find_small_frame(arm, recordings)
        if moved is not None:
            fault, left_mm = moved
            warn(
                f"set-up: {fault.sentence} (error {fit.rmse_mm:.3g} mm as recorded, about "
                f"{left_mm:.3g} mm in that frame): a camera or a base that was moved, or another "
                f"effect; which one: surgisoft diagnose {typed(name)} {typed(*files)}"
            )
            return
        warn(
            f"set-up: {name} does not describe this arm's motion of {fit.motion_mm:.3g} mm "
            f"({error}), and no fault that is tested explains it: {WHOSE_ARM}"
        )
        return
    warn(f"set-up: {found.sentence}")
    print(f"to correct it, {IN_A_MAP}:")
    print(textwrap.indent(found.instructions, "  "))


@app.command("recording")
def recording_(
    recordings: Recordings,
    lerobot: Annotated[
        Path | None,
        typer.Option(
            "--lerobot",
            metavar="DIR",
            help="Write the recordings to a new folder as a LeRobotDataset (v3.0), one "
            "episode for each run.",
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            "--lerobot-task",
            metavar="TEXT",
            help="With --lerobot: what the robot does, in words; default: Drive the soft arm.",
        ),
    ] = None,
    fps: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="With --lerobot: frames per second; default: the recordings' own rate.",
        ),
    ] = None,
    begin: Annotated[
        float | None,
        typer.Option(
            "--from", metavar="S", help="With -o: the first rows up to this time are left out, s."
        ),
    ] = None,
    end: Annotated[
        float | None,
        typer.Option(
            "--until", metavar="S", help="With -o: the rows from this time on are left out, s."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="PART",
            help="Write the rows between --from and --until as a new recording (.csv, .parquet).",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Show what recordings hold: rows, runs, rates, ranges, missing values, warnings.

    With --from or --until, and -o, a part of one recording is written, such as the rows before a
    marker slipped. Times are seconds since its first row, as in charts and diagnoses. With
    --lerobot the recordings are also written as a LeRobotDataset, from which LeRobot trains
    policies.
    """

    from surgisoft.measurement.recordings import check_writable, part_of, save_recording, summary
    from surgisoft.measurement.recordings.lerobot import TASK, save_lerobot
    from surgisoft.memory import keep_freed_memory

    keep_freed_memory()
    others = {"--lerobot-task": task, "--fps": fps}
    if lerobot is None and (unused := [o for o, value in others.items() if value is not None]):
        raise InputError(f"{' and '.join(unused)}: for a LeRobotDataset; add --lerobot DIR")
    cut = [option for option, time in (("--from", begin), ("--until", end)) if time is not None]
    if cut and output is None:
        raise InputError(f"{' and '.join(cut)}: for a part of the recording; add -o PART.parquet")
    if output is not None and not cut:
        raise InputError("-o writes a part of the recording; add --from S, --until S or both")
    if output is not None:
        check_writable(output, force)
    opened = read_recordings(recordings)
    if output is not None:
        if len(opened) > 1:
            raise InputError(
                f"{' and '.join(cut)}: the times of one recording, got {len(opened)} recordings; "
                "cut them one by one"
            )
        if opened[0].source is not None and resolved(output) == resolved(opened[0].source):
            raise InputError(f"{output}: is the recording itself; choose another name with -o")
        opened = [replace(part_of(opened[0], begin, end), name=output.stem)]
    for recording in opened:
        print(*summary(recording), sep="\n")
    if lerobot:
        for note in save_lerobot(opened, lerobot, TASK if task is None else task, fps):
            print(f"note: {note}")
        print(f"wrote {lerobot}: a LeRobotDataset v3.0")
    if output is not None:
        save_recording(opened[0], output, force)
        print(f"wrote {output}: {counted(opened[0].samples, 'row')}")
