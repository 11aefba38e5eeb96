"""`surgisoft experiment`: run scripted experiments on a scene, from a TOML file to a report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surgisoft.cli import app, stopped
from surgisoft.cli.files import check_folder, show_written
from surgisoft.cli.inputs import read_context, warn
from surgisoft.cli.options import (
    Cluster,
    Credibility,
    EffectFiles,
    ExperimentFile,
    Preflight,
    RigsOfArms,
    given_options,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.errors import InputError, counted

if TYPE_CHECKING:
    from surgisoft.experiments.spec import Limits

commands = typer.Typer(
    no_args_is_help=True, help="Scripted experiments on a scene: run, check, list."
)
app.add_typer(commands, name="experiment")


@commands.command("run")
def run(
    file: ExperimentFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="DIR", help="Folder of the results; default: results/NAME."
        ),
    ] = None,
    processes: Annotated[
        int,
        typer.Option(min=1, max=1024, help="Number of processes; the results do not depend on it."),
    ] = 1,
    cluster: Cluster = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run of the experiment.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace older results.")] = False,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RUN...",
            help="Folders of training runs: each also runs every case of the scripted expert.",
        ),
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, max=100_000, help="Episodes of each setting.")
    ] = None,
    rig: RigsOfArms = None,
    preflight: Preflight = False,
    replays: Annotated[
        bool, typer.Option(help="Write .rrd files of the first and the worst episode.")
    ] = True,
    credibility: Credibility = None,
    effect_files: EffectFiles = None,
) -> None:
    """Run an experiment; write tables, logs, pictures, replays and one HTML report.

    A setting whose code raises an exception is left out of the report, and the command ends with
    exit code 2.
    """
    from surgisoft.agents.on_rig import rigs_in
    from surgisoft.experiments.page import markdown
    from surgisoft.experiments.run import failed_words
    from surgisoft.experiments.session import finish_experiment, start_experiment
    from surgisoft.workers import check_processes

    check_folder(output)
    check_processes(processes, cluster)
    context = read_context(credibility)
    if context is not None:
        from surgisoft.credibility.of_experiment import check_context
        from surgisoft.experiments.session import open_experiment

        check_context(context, open_experiment(file))
    with progress("experiment check") as report:
        spec, folder = start_experiment(
            file,
            output,
            policy or (),
            repeats,
            rigs_in(rig or ""),
            preflight=preflight,
            resume=resume,
            force=force,
            cluster=cluster,
            progress=report,
        )
    with progress(f"experiment {spec.name}") as report:
        about = f"surgisoft experiment run {typed(file.name)}"
        try:
            results, files = finish_experiment(
                spec, folder, processes, replays, about, report, cluster, warn
            )
        except KeyboardInterrupt:
            given = {
                "--policy": policy, "--repeats": repeats, "--rig": rig, "--preflight": preflight,
                "--processes": None if processes == 1 else processes, "--cluster": cluster,
                "--no-replays": not replays, "--credibility": credibility,
            }  # fmt: skip
            again = f"surgisoft experiment run {typed(file)} -o {typed(folder)} --resume"
            again = with_effect_files(again + given_options(given))
            stopped(f"stopped; {folder} keeps the finished blocks; continue with: {again}")
    if context is not None:
        from surgisoft.credibility.of_experiment import assess_experiment
        from surgisoft.credibility.page import write_report
        from surgisoft.progress import text_only

        with progress("credibility") as report:
            assessed = assess_experiment(context, results, text_only(report))
        files = [*files, *write_report(assessed, folder)]
    print(markdown(results))
    if context is not None:
        print(f"credibility: {assessed.sentence}")
    show_written(files)
    if results.failed:
        raise InputError(failed_words(results.failed))


@commands.command("check")
def check(
    file: ExperimentFile,
    effect_files: EffectFiles = None,
) -> None:
    """Check an experiment's file and list its phases and settings, without running it."""
    from surgisoft.experiments.plan import settings
    from surgisoft.experiments.run import about_policies, check_playable
    from surgisoft.experiments.session import beams_beyond_limits, open_experiment, weak_lasers

    spec = open_experiment(file)
    found = settings(spec)
    with progress("experiment check") as report:
        clear_mm = check_playable(spec, progress=report)
        lasers = weak_lasers(spec, report)
    for line in (*beams_beyond_limits(spec), *lasers, *about_policies(spec)):
        warn(line)
    episodes = counted(len(found) * spec.repeats, "episode")
    print(
        f"{spec.name} ({spec.scenario}): {counted(len(found), 'setting')}, {episodes} of at most "
        f"{spec.limits.time_s:g} s"
    )
    for phase in spec.phases:
        beam = ", beam" if phase.beam else ""
        condition = spec.of.experiment.conditions[phase.until]
        within = condition.within if phase.within < 0.0 else phase.within
        threshold = condition.scenes if within == 0.0 and condition.scenes else f"{within:g}"
        until = "never" if phase.until == "never" else f"{phase.until} ({threshold})"
        print(
            f"  phase {phase.name}: {', '.join(map(' '.join, phase.arms))}{beam}; "
            f"until {until}, at most {phase.timeout_s:g} s, then {phase.on_timeout}"
        )
    if any(phase.beam for phase in spec.phases):
        print(
            f"  beam off below {clear_mm:g} mm of clearance{_of_the_scene(spec.limits, clear_mm)}"
        )
    for setting in found:
        print(f"  setting {setting.label}")


def _of_the_scene(limits: Limits, clear_mm: float) -> str:
    """Whose limit of clearance it is, where it is not that of the experiment's file."""
    if limits.clearance_mm == clear_mm:
        return ""
    unused = f"; limits.clearance_mm = {limits.clearance_mm:g} is below it and has no effect"
    return f", the scene's limit{unused if limits.clearance_mm > 0.0 else ''}"


@commands.command("list")
def list_(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="DIR", help="A folder of experiments, or a scene; default: the liver phantom."
        ),
    ] = None,
) -> None:
    """List the experiments of a folder or a scene, packaged ones by their names."""
    from surgisoft.experiments.plan import settings
    from surgisoft.experiments.session import experiments_of, find_experiment, open_experiment

    for path in experiments_of(folder):
        spec = open_experiment(path)
        settings_ = counted(len(settings(spec)), "setting")
        name = path.stem if find_experiment(path.stem) == path else path
        print(f"{name}: {settings_} x {counted(spec.repeats, 'episode')}. {spec.note}")
