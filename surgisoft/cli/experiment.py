"""`surgisoft experiment`: scripted experiments on a scene, from a TOML file to a report."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.files import check_folder
from surgisoft.cli.options import EffectFiles, ExperimentFile
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError
from surgisoft.files import write_atomically

commands = typer.Typer(
    no_args_is_help=True, help="Scripted experiments on a scene: run, check, list."
)
app.add_typer(commands, name="experiment")


@commands.command("run")
def run(
    file: ExperimentFile,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Results; default: results/NAME."),
    ] = None,
    processes: Annotated[
        int, typer.Option(min=1, max=1024, help="Processes; the results do not depend on it.")
    ] = 1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with results that are there.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Begin anew, older results go.")] = False,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RUN...", help="Training runs' folders: play every scripted case as well."
        ),
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, max=100_000, help="Episodes of each setting.")
    ] = None,
    replays: Annotated[
        bool, typer.Option(help="Write .rrd files of the first and the worst episode.")
    ] = True,
    effect_files: EffectFiles = None,
) -> None:
    """Play an experiment; write tables, logs, pictures, replays and one HTML report."""
    from surgisoft.experiments.plan import settings
    from surgisoft.experiments.run import open_results, run_experiment
    from surgisoft.experiments.spec import load_experiment

    if resume and force:
        raise InputError("--resume goes on, --force begins anew: give one of them")
    spec = load_experiment(file)
    settings(spec, _where(file))
    for folder in policy or []:
        spec = _with_policy(spec, folder)
    spec = spec if repeats is None else replace(spec, repeats=repeats)
    output = output or Path("results") / spec.name
    check_folder(output)
    open_results(spec, output, resume, force)
    with progress(f"experiment {spec.name}") as report:
        rows = run_experiment(spec, output, processes, report)
    for path in _written(spec, output, rows, replays, f"surgisoft experiment run {file.name}"):
        print(f"wrote {path}")


@commands.command("check")
def check(
    file: ExperimentFile,
    effect_files: EffectFiles = None,
) -> None:
    """Say what an experiment would play; a bad file is one line with its line and field."""
    from surgisoft.experiments.plan import settings
    from surgisoft.experiments.run import check_playable
    from surgisoft.experiments.spec import load_experiment

    spec = load_experiment(file)
    found = settings(spec, _where(file))
    check_playable(spec)
    episodes = len(found) * spec.repeats
    print(
        f"{spec.name}: {len(found)} settings, {episodes} episodes of at most "
        f"{spec.limits.time_s:g} s"
    )
    for phase in spec.phases:
        beam = ", beam" if phase.beam else ""
        print(
            f"  phase {phase.name}: laser {phase.laser}, endoscope {phase.endoscope}{beam}; "
            f"until {phase.until}, at most {phase.timeout_s:g} s, then {phase.on_timeout}"
        )
    for setting in found:
        print(f"  setting {setting.label}")


@commands.command("list")
def list_(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="DIR", help="Where to look; default: the liver phantom's."),
    ] = None,
) -> None:
    """List the experiments of a folder."""
    from surgisoft.experiments.plan import settings
    from surgisoft.experiments.spec import load_experiment
    from surgisoft.tasks.world.scene import PHANTOM

    folder = folder or PHANTOM / "experiments"
    files = sorted(folder.glob("*.toml"))
    if not files:
        raise InputError(f"{folder}: no experiment (*.toml) there")
    for path in files:
        spec = load_experiment(path)
        count = len(settings(spec, _where(path)))
        print(f"{path}: {count} settings x {spec.repeats} episodes. {spec.note}")


def _where(file: Path):
    from surgisoft.config import read_toml

    return read_toml(file)[1]


def _with_policy(spec, folder: str):
    """The experiment with a learned twin of every scripted case."""
    from surgisoft.agents.run_folder import RunFolder
    from surgisoft.experiments.spec import SCRIPTED

    trained = RunFolder(folder).config["task"]
    if trained != "circle_ablation":
        raise InputError(f"{folder}: was trained on {trained}; expected a run of circle_ablation")
    path = Path(folder).resolve()
    twins = tuple(
        replace(case, name=f"{case.name}-{path.name}", policy=str(path))
        for case in spec.cases
        if case.policy == SCRIPTED
    )
    names = [case.name for case in (*spec.cases, *twins)]
    if len(set(names)) < len(names):
        raise InputError(f"{folder}: a case of that name is there already; rename the folder")
    return replace(spec, cases=(*spec.cases, *twins))


def _written(spec, output: Path, rows, replays: bool, about: str) -> list[Path]:
    """Write everything that follows from the rows, and say what came out."""
    from surgisoft.experiments.page import experiment_page, markdown, shown_episodes
    from surgisoft.experiments.pictures import film, write_pictures
    from surgisoft.experiments.results import drop_logs, sum_up, write_tables
    from surgisoft.report import write_page

    results = sum_up(spec, output, rows)
    files = write_tables(results)
    shown = shown_episodes(results)
    with progress("pictures") as report:
        films = {}
        for number, (label, episode) in enumerate(shown):
            report(number, len(shown), label)
            films[label, episode] = film(results.log(label, episode))
    files += write_pictures(results, films)
    files.append(write_page(experiment_page(results, films, about), output / "report.html"))
    drop_logs(results)
    if replays:
        files += _replays(results)
    text = markdown(results)
    write_atomically(output / "summary.md", text)
    print(text)
    return [*files, output / "summary.md"]


def _replays(results) -> list[Path]:
    from surgisoft.replay.episode_view import write_replay

    files = []
    worst = ("worst", *results.worst)
    for name, label, episode in (("first", results.settings[0].label, 0), worst):
        path = results.folder / "replays" / f"{name}.rrd"
        path.parent.mkdir(exist_ok=True)
        with progress(f"replay of {label}, episode {episode}") as report:
            write_replay(results.log(label, episode), path, 1.0, report)
        files.append(path)
    return files
