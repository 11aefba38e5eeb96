"""`surgisoft run`: a closed loop on a rig, with a model beside it that tells when it fails."""

import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from surgisoft.cli import app
from surgisoft.cli.files import check_free, check_replay, show_written
from surgisoft.cli.inputs import check_model, warn
from surgisoft.cli.options import (
    SEED_MAX,
    EffectFiles,
    Force,
    JsonFile,
    NewRecording,
    ObserverGain,
    OfRunTask,
    Replay,
    Rig,
    TaskConfig,
    Web,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.errors import InputError
from surgisoft.files import write_json


@app.command()
def run(
    policy: Annotated[
        str,
        typer.Argument(
            metavar="POLICY",
            help="Folder of a training run, ring (the policies of the package), scripted or random "
            "(with --task); or without a policy "
            "SCHEDULE.csv or a continuous protocol ('surgisoft collect --list-protocols').",
        ),
    ],
    output: NewRecording,
    rig: Rig = "virtual",
    model: Annotated[
        Path | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="Arm model that predicts every sample, and that the policy uses; default: that of "
            "the training run, else the arm of the package.",
        ),
    ] = None,
    task: OfRunTask = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            metavar="MIN", help="Length of the run; default: 10, or a schedule's own length."
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            help="Rate of the loop, 10 to 50 Hz; default: 20, or that of the trained policy.",
        ),
    ] = None,
    clock: Annotated[
        Literal["real", "simulated"],
        typer.Option(help="Real time, or as fast as possible (simulated rigs only)."),
    ] = "real",
    before: Annotated[
        list[Path] | None,
        typer.Option(
            "--before",
            metavar="REC...",
            help="Recordings of the unchanged arm in the same kind of motion: what the model's "
            "residual is compared with. Default: the first --clean seconds of the run.",
        ),
    ] = None,
    reference: Annotated[
        float,
        typer.Option(
            "--clean",
            metavar="S",
            help="Without --before: time at the start of the run in which the arm is unchanged.",
        ),
    ] = 120.0,
    false_alarm: Annotated[
        float,
        typer.Option(
            metavar="H", help="Mean time between false alarms for which the detector is set, h."
        ),
    ] = 10.0,
    stop_on_alarm: Annotated[
        bool, typer.Option("--stop-on-alarm", help="End the run with the first alarm.")
    ] = False,
    cameras: Annotated[
        bool,
        typer.Option(
            help="Whether the policy observes measured key points or those that the model predicts."
        ),
    ] = True,
    observer_gain: ObserverGain = None,
    any_model: Annotated[
        bool,
        typer.Option(
            "--any-model", help="Continue even if the model seems to belong to another arm."
        ),
    ] = False,
    seed: Annotated[
        int, typer.Option(min=0, max=SEED_MAX, help="Seed of the goals and of random schedules.")
    ] = 0,
    config: TaskConfig = None,
    show: Annotated[bool, typer.Option("--show", help="Show the run in the Rerun viewer.")] = False,
    web: Web = False,
    replay: Replay = None,
    json_file: JsonFile = None,
    effect_files: EffectFiles = None,
    force: Force = False,
) -> None:
    """Run a policy or a schedule on a rig at a fixed rate, and warn when the model no longer fits.

    Every sample is predicted by the model, recorded as it comes, and shown with --show or --web.
    Ctrl-C ends the run: the arm is vented and the recording is complete.
    """
    check_free(json_file, "alarms")
    check_replay(replay)
    if show and web:
        raise InputError("--show and --web: expected at most one of them")
    if model is not None:
        check_model(model)

    from surgisoft.live.change import AlarmDesign
    from surgisoft.live.session import run as run_policy

    with progress(f"run {Path(policy).name}") as report:
        found = run_policy(
            policy,
            rig,
            model,
            before=before or (),
            show=show,
            web=web,
            replay=replay,
            on_address=lambda url: print(f"open {url} (stop with Ctrl-C)", flush=True),
            on_event=lambda text: print(text, flush=True),
            on_warning=warn,
            progress=report,
            task=task,
            minutes=minutes,
            rate_hz=rate,
            clock=clock,
            reference_s=reference,
            alarm=AlarmDesign(false_alarm_h=false_alarm),
            stop_on_alarm=stop_on_alarm,
            cameras=cameras,
            observer_gain=observer_gain,
            any_model=any_model,
            seed=seed,
            config=config,
            output=output,
            force=force,
        )
    if json_file:
        write_json(json_file, found.to_json())
    _show(found)
    show_written(path for path in (*found.written, replay, json_file) if path is not None)
    if found.alarms:
        name = model or "default"
        past = f" --before {typed(*before)}" if before else ""
        following = f"surgisoft diagnose {typed(name, found.written[-1])}{past}"
        print(f"next: {with_effect_files(following)}")
    if found.ended_by is not None:
        raise found.ended_by


def _show(found) -> None:
    """Print clock, errors and alarms."""
    print(found.timing.sentence)
    change = found.alarms[0].since_s if found.alarms else math.inf
    stretches = [("", -math.inf, math.inf)]
    if found.alarms:
        stretches = [("before the change ", -math.inf, change), ("after it ", change, math.inf)]
    model = ", ".join(f"{name}{found.rms_mm(a, b):.3f} mm" for name, a, b in stretches)
    print(f"error of the model: {model}")
    if len(found.tracking) and not math.isnan(found.tracking_mm()):
        task = ", ".join(f"{name}{found.tracking_mm(a, b):.3f} mm" for name, a, b in stretches)
        print(f"error of the task: {task}")
    taken = found.detector is not None and found.detector.judges
    if taken and found.judged < 0.995:
        print(
            f"judged: {found.judged:.0%} of the time after the reference; the rest is motion that "
            "the reference does not cover"
        )
    if found.detector is None:
        print("no change detector: the run was shorter than its clean reference")
    elif not taken:
        print("no change detector: its clean reference does not repeat its motions")
    elif not found.alarms:
        level = max((x for x in found.statistic if not math.isnan(x)), default=0.0)
        print(f"no alarm; highest alarm level {level:.2f} of 1")
