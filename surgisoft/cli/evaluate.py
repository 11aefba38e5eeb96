"""`surgisoft evaluate`: evaluate policies on a task, in simulation or on rigs."""

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surgisoft.agents.policy_names import short_names, without_repeats
from surgisoft.cli import INTERRUPTED, app
from surgisoft.cli.files import check_folder, check_free, check_replay, show_written
from surgisoft.cli.inputs import warn
from surgisoft.cli.options import (
    SEED_MAX,
    Arm,
    EffectFiles,
    Hidden,
    JsonFile,
    ObserverGain,
    OfRunTask,
    Preflight,
    Replay,
    Report,
    RigsOfArms,
    SceneFolder,
    TaskConfig,
)
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError, Interrupted, counted, unknown_name
from surgisoft.files import write_json

if TYPE_CHECKING:
    from surgisoft.agents.session import Rules

PLACES = ("simulation", "rig")
"""Plants: simulated arm models, or rigs."""


@app.command()
def evaluate(
    policies: Annotated[
        list[str],
        typer.Argument(
            metavar="POLICY",
            help="scripted (inverse kinematics with the true state), random, or the folder "
            "of a training run, or ring (the policies of the package). Several policies are "
            "evaluated on the same episodes.",
        ),
    ],
    task: OfRunTask = None,
    episodes: Annotated[
        int, typer.Option(min=1, max=100_000, help="Episodes of each policy.")
    ] = 20,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=SEED_MAX,
            help="Seed of the episodes; default 0, with --rules the experiment's.",
        ),
    ] = None,
    on: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(PLACES),
            help="Plant: simulated arm models, or rigs (see --rig; default: the virtual one).",
        ),
    ] = None,
    rig: RigsOfArms = None,
    exact_checks: Annotated[
        bool,
        typer.Option(
            help="Check contact, clearance and beam with FCL, the exact collision checker, where "
            "there is a scene."
        ),
    ] = True,
    robot_seed: Annotated[
        int | None,
        typer.Option(min=0, max=SEED_MAX, help="On the rig: seed of the robot; default 0."),
    ] = None,
    hidden: Hidden = None,
    preflight: Preflight = False,
    cameras: Annotated[
        bool,
        typer.Option(
            help="On the rig: whether policies observe measured key points or those that the "
            "model predicts."
        ),
    ] = True,
    observer_gain: ObserverGain = None,
    arm: Arm = None,
    scene: SceneFolder = None,
    config: TaskConfig = None,
    rules: Annotated[
        Path | None,
        typer.Option(
            "--rules",
            metavar="EXPERIMENT",
            help="Rules of an experiment (FILE.toml, or a packaged name such as liver): its scene, "
            "fields of the task such as fire_mm, phases, limits and seed, so that episode k is the "
            "experiment's episode k. Default: those of the training run, or of --config.",
        ),
    ] = None,
    effect_files: EffectFiles = None,
    json_file: JsonFile = None,
    replay: Replay = None,
    report: Report = None,
) -> None:
    """Evaluate policies on the same episodes of a task, with 95 % intervals.

    Ctrl-C keeps what is finished: policies, and batches of 256 episodes (on a real rig, episodes).
    --replay FILE.rrd writes the first episode; of several policies one FILE-POLICY.rrd each.
    """
    check_free(json_file, "policies", "drivers")
    replays = replay_files(policies, replay)
    for path in replays.values():
        check_replay(path)
    check_folder(report)
    on = on or (PLACES[1] if rig else PLACES[0])
    rigs = _rig_config(on, rig, robot_seed, hidden, cameras, observer_gain, preflight)

    from surgisoft.agents.evaluate import cells_are
    from surgisoft.agents.session import evaluate as evaluate_policies

    laid: Rules | None = None
    if rules:
        from surgisoft.experiments.session import ExperimentRules

        laid = ExperimentRules.of(rules)

    with progress("evaluate") as report_progress:
        try:
            found = evaluate_policies(
                policies,
                task,
                progress=report_progress,
                on_warning=warn,
                episodes=episodes,
                seed=seed,
                rig=rigs,
                exact_checks=exact_checks,
                arm=arm,
                scene=scene,
                config=config,
                rules=laid,
                log=policies if report or replay else (),
            )
        except Interrupted as ended:
            found = ended.result
            warn(f"{found.interruption}; writing their results (Ctrl-C again ends at once)")
    about = f"{counted(episodes, 'episode')} of seed {found.request.seed}"
    if found.interrupted:
        about += f"; {found.interruption}"
    written: list[object] = []
    if json_file:
        write_json(json_file, found.to_json())
        written.append(json_file)
    for name, path in replays.items():
        if name not in found.logs:
            continue
        from surgisoft.replay.episode_view import write_replay

        with progress("replay") as report_progress:
            written.append(write_replay(found.logs[name], path, report=report_progress))
    if report:
        from surgisoft.agents.learning_curves import learning_curves
        from surgisoft.agents.policies import POLICIES
        from surgisoft.agents.report import evaluation_page
        from surgisoft.experiments.pictures import film
        from surgisoft.report import write_page

        films = {name: film(log) for name, log in found.logs.items() if log.camera is not None}
        runs = [result.policy for result in found.results if result.policy not in POLICIES]
        curves = learning_curves(runs)
        given = found.task, on, list(found.results), found.logs, about, films, curves
        page = evaluation_page(*given)
        written.append(write_page(page, report / "report.html"))
    heading = cells_are(result.overall for result in found.results)
    print(f"{found.task}, {on}: {about}; {heading}")
    _show(found.results)
    if found.success_rule:
        print(f"success: {found.success_rule}")
    if found.measured_arms:
        print(
            f"{', '.join(found.measured_arms)}: on a real bench, whose true body is not known; "
            "errors are those of the measured key points, camera noise included"
        )
    show_written(written)
    if found.interrupted:
        raise typer.Exit(INTERRUPTED)


def replay_files(policies: list[str], replay: Path | None) -> dict[str, Path]:
    """Policy -> the file of its replay: the given one, or NAME-POLICY.rrd of several policies."""
    if replay is None:
        return {}
    names, _ = without_repeats(policies)
    if len(names) == 1:
        return {names[0]: replay}
    found: dict[str, Path] = {}
    for name, short in short_names(names).items():
        word = "-".join(part for part in Path(short).parts if part != os.sep) or "run"
        path = replay.with_name(f"{replay.stem}-{word}{replay.suffix}")
        if path in found.values():  # such as a-run beside a/run
            path = path.with_stem(f"{path.stem}-{len(found) + 1}")
        found[name] = path
    return found


def _rig_config(
    on: str,
    rigs: str | None,
    robot_seed: int | None,
    hidden: list[str] | None,
    cameras: bool,
    observer_gain: float | None,
    preflight: bool,
):
    """The configuration of the rigs; None in simulation."""
    if on not in PLACES:
        raise unknown_name("place", on, PLACES)
    if on != "rig":
        if rigs:
            raise InputError("--rig names the plant, but --on is simulation; leave out --on")
        if robot_seed is not None or observer_gain is not None or hidden or not cameras:
            raise InputError(
                "--robot-seed, --hidden, --no-cameras and --observer-gain need --on rig"
            )
        if preflight:
            raise InputError("--preflight is for real rigs; name one with --rig")
        return None
    from surgisoft.agents.on_rig import RigConfig, rigs_in
    from surgisoft.rig.registry import hidden_effects

    found = RigConfig(
        seed=robot_seed or 0,
        hidden=tuple(hidden_effects(hidden)),
        cameras=cameras,
        rigs=rigs_in(rigs) if rigs else RigConfig().rigs,
        preflight=preflight,
    )
    if observer_gain is None:
        return found
    return replace(found, observer_gain=observer_gain, adapts=False)


def _show(results) -> None:
    from surgisoft.agents.evaluate import cell, differences
    from surgisoft.tasks.supervision import MEAN_MM, main_error

    names = list(dict.fromkeys(name for result in results for name in result.overall))
    words = short_names([result.policy for result in results])
    rows = [["", *words.values()]]
    for name in names:
        cells = (cell(name, result.overall.get(name)) for result in results)
        rows.append([name, *cells])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *values in rows:
        held = "".join(f"   {cell:>{w}s}" for cell, w in zip(values, widths[1:], strict=True))
        print(f"{first:{widths[0]}s}{held}")
    for result in results[1:]:
        apart = differences(results[0], result)
        name = (main_error(apart) or ("",))[0] + MEAN_MM
        if name in apart and apart[name].episodes:
            print(
                f"{words[result.policy]} minus {words[results[0].policy]}, episode by episode: "
                f"{name} {cell(name, apart[name])}"
            )
    for result in results:
        if result.checks is not None:
            facts = result.to_json()["exact_checks"]
            print(
                f"exact collision checker on {words[result.policy]}: of "
                f"{counted(facts['instants'], 'instant')} the batched geometry differs on contact "
                f"in {facts['contact_differs']} and on what the beam hits in "
                f"{facts['beam_differs']}; the hit differs by at most {facts['beam_off_mm']:.1g} "
                f"mm; FCL was asked about contact in {facts['contact_asked']} and about the beam "
                f"in {facts['beams_asked']}, in the others it cannot differ"
            )
