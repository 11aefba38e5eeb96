"""`surgisoft next-experiment`: the schedule that best distinguishes competing effects."""

from pathlib import Path
from typing import Annotated, Any

import typer

from surgisoft.cli import app
from surgisoft.cli.collect import check_new_recording, drop_log, record_on, written_line
from surgisoft.cli.files import check_folder, check_free
from surgisoft.cli.inputs import check_model, read_before, read_recordings, warn_all
from surgisoft.cli.options import (
    AnyModel,
    Before,
    EffectFiles,
    Force,
    JsonFile,
    ModelError,
    Paired,
    Predictions,
    complete_effects,
    model_options,
    typed_once,
    with_effect_files,
)
from surgisoft.cli.options import Rig as RigOption
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.errors import InputError
from surgisoft.files import write_atomically, write_json

ON_RIG = (3, "kPa")
"""Number of chambers and unit of the arm on the virtual rig."""
VIRTUAL = "virtual"
"""The rig that is meant where none is named."""
SHOWN_PAIRS = 10
"""Pairs of effects that are always printed (a count); a chance below `SURE` is always printed."""


@app.command("next-experiment")
def next_experiment(
    model: AnyModel,
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(metavar="REC", help="Recordings made so far (optional)."),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="SCHEDULE.csv", help="New schedule file.")
    ] = Path("next_experiment.csv"),
    between: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME...",
            autocompletion=complete_effects,
            help="Competing effects, separated by spaces or commas; default: those that explain "
            "the recordings best, or all known effects if there are no recordings.",
        ),
    ] = None,
    minutes: Annotated[
        float, typer.Option(metavar="MIN", help="Longest duration of the experiment, minutes.")
    ] = 15.0,
    as_it_stands: Annotated[
        bool, typer.Option("--as-it-stands", help="Propose no change of the experimental set-up.")
    ] = False,
    before: Before = None,
    paired: Paired = "auto",
    predictions: Predictions = None,
    model_error: ModelError = None,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record",
            metavar="NEW.parquet",
            help="Run the schedule on the rig at once and write this recording.",
        ),
    ] = None,
    rig: RigOption = VIRTUAL,
    json_file: JsonFile = None,
    effect_files: EffectFiles = None,
    force: Force = False,
) -> None:
    """Find the experiment that best distinguishes competing effects, ready for the rig."""
    if output.suffix != ".csv":
        raise InputError(
            f"{output}: suffix '{output.suffix}', expected .csv, which `collect` can read"
        )
    if output.exists() and not force:
        raise InputError(f"{output}: exists already; choose another name or use --force")
    check_folder(output.absolute().parent)
    check_free(json_file, "separates")
    if record:
        from surgisoft.rig.registry import check_rig

        if record.absolute() == output.absolute():
            raise InputError(
                f"{record}: is given for the schedule (-o) and for the recording (--record); "
                "expected two files"
            )
        check_new_recording(record, force)
        check_rig(rig)
    check_model(model, predictions)
    measured = read_recordings(recordings) if recordings else []
    earlier = read_before(before, paired)

    from surgisoft.diagnosis.design.next_experiment import next_experiment as find_experiment
    from surgisoft.diagnosis.design.schedules import AS_IT_STANDS, SETUPS, schedule_text

    competing = [name for item in between or [] for name in item.split(",") if name] or None
    if between and competing is None:
        raise InputError("--between names no effect; give two or more, or leave it out")
    settings = (AS_IT_STANDS,) if as_it_stands else tuple(SETUPS)
    with progress("next-experiment") as report:
        result = find_experiment(
            model,
            measured,
            competing,
            minutes,
            settings,
            predictions=predictions,
            error_mm=model_error,
            progress=report,
            before=earlier,
            paired=paired,
        )
    warn_all(result.notes)
    write_atomically(output, schedule_text(result.protocol))
    if json_file:
        write_json(json_file, result.to_json())
    given = predictions or []
    of_recordings, of_before = given[: len(measured)], given[len(measured) :]
    # After a change that removes an effect, only the new recording counts.
    kept = [] if result.by_hand else of_recordings
    later = [*kept, Path("PREDICTIONS_OF_NEW.csv"), *of_before] if predictions else None
    compared = _compared(before, result.paired and not result.by_hand)
    of_model = compared + model_options(later, model_error)
    _show(result, model, recordings or [], output, rig, record, of_model)
    if record:
        _record(result, rig, output, record, force)


def _compared(before: list[Path] | None, paired: bool) -> str:
    """Options that compare the old and the new recording with those from before.

    paired: whether the old ones were paired with them. The new schedule has no partner there, and
    among paired differences its rows would not count.
    """
    if not before:
        return ""
    return f" --before {typed_once(before)}" + (" --paired never" if paired else "")


def _show(
    result,
    model: Path,
    recordings: list[Path],
    output: Path,
    rig: str,
    record: Path | None,
    of_model: str,
) -> None:
    from surgisoft.diagnosis.design.isolability import SURE

    print(f"next experiment: {result.name}, {result.minutes:g} min on the bench")
    print(f"why: {result.why}")
    for number, step in enumerate(result.steps, 1):
        print(f"  {number}. {step}")
    new, other = record or Path("NEW.parquet"), rig.partition(":")[0] != VIRTUAL
    named = rig != VIRTUAL or record is not None
    if not named:
        print(
            f"  on a bench of your own: play {output} run by run, the actuation linear in time "
            "between its rows"
        )
    if other and not record:
        print(f"  on the rig: surgisoft collect {typed(output)} --rig {typed(rig)} -o {typed(new)}")
    elif not other and (result.protocol.commands.shape[1], result.protocol.unit) == ON_RIG:
        options = f" {result.options}" if result.options else ""
        place = "" if rig == VIRTUAL else f" --rig {typed(rig)}"
        if result.by_hand:
            if named:
                print("  the virtual rig has no option for that change")
            print("  --as-it-stands proposes an experiment without a change of the bench")
        elif not record:
            played = f"surgisoft collect {typed(output)}{place}{options} -o {typed(new)}"
            print(f"  on the virtual rig: {played}")
    # After a change that removes an effect, only the new recording counts.
    old = "" if result.by_hand else "".join(f" {typed(path)}" for path in recordings)
    taken = f" --without {' '.join(result.removes)}" if result.by_hand else ""
    following = f"surgisoft diagnose {typed(model)}{old} {typed(new)}{taken}{of_model}"
    print(f"  then: {with_effect_files(following)}")
    pairs = sorted(result.pairs, key=lambda pair: pair.after)
    open_ = [pair for pair in pairs if pair.effects not in result.separates]
    shown = max(SHOWN_PAIRS, len(open_))
    for pair in pairs[:shown]:
        a, b = pair.effects
        print(
            f"  {a} or {b}: expected chance of the right one {pair.before:.2f} -> {pair.after:.2f}"
        )
    if len(pairs) > shown:
        print(
            f"  {len(pairs) - shown} further pairs: {pairs[shown].after:.2f} or more (see --json)"
        )
    if open_:
        print(f"{len(open_)} of {len(result.pairs)} pairs stay below {SURE:g} in this time")
    print(result.chances_in_words)
    print(f"wrote {output}: {len(result.protocol.run_rows)} runs, {result.protocol.unit}")


def _record(result, rig: str, schedule: Path, record: Path, force: bool) -> None:
    """Run the schedule on a rig, in the experimental setup that it needs, and write the recording.

    A simulated rig changes its setup itself; a real one has to be changed by a person first.
    """
    from surgisoft.rig.registry import parse_rig, rig_options

    command = f"surgisoft collect {typed(schedule)} --rig {typed(rig)} -o {typed(record)}"
    setup: dict[str, Any] = dict(result.rig_options)
    known = rig_options(parse_rig(rig).name)
    lacking = [name for name in setup if name not in known or name in parse_rig(rig).options]
    if result.by_hand or lacking:
        raise InputError(
            f"{schedule} is written, {record} is not: first {result.steps[0]}; then "
            f"'{command}' (--as-it-stands proposes no "
            "change of the experimental set-up)"
        )
    try:
        recording, log = record_on(schedule, rig, record, force, **setup)
    except InputError as error:
        raise InputError(f"{error}. {schedule} is written; to record it: '{command}'") from error
    from surgisoft.measurement.recordings import save_recording

    save_recording(recording, record, force)
    drop_log(log)
    print(written_line(record, recording))
