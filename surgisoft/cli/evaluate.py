"""`surgisoft evaluate`: how well drivers do a task, in simulation or on the virtual rig."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.files import check_folder, check_free, check_replay
from surgisoft.cli.inputs import hidden_effects, warn
from surgisoft.cli.options import (
    SEED_MAX,
    Arm,
    EffectFiles,
    Hidden,
    JsonFile,
    Replay,
    Report,
    SceneFolder,
    TaskConfig,
)
from surgisoft.cli.progress import progress
from surgisoft.errors import InputError, unknown_name
from surgisoft.files import write_json

PLACES = ("simulation", "rig")
"""Where episodes are played."""


@app.command()
def evaluate(
    drivers: Annotated[
        list[str],
        typer.Argument(
            metavar="DRIVER", help="scripted, random, or a training run's folder; side by side."
        ),
    ],
    task: Annotated[
        str | None, typer.Option(metavar="TASK", help="Task; default: the run's own.")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, max=100_000, help="Episodes to play.")] = 20,
    seed: Annotated[
        int, typer.Option(min=0, max=SEED_MAX, help="Seed of the episodes, the same for each.")
    ] = 0,
    on: Annotated[
        str, typer.Option(metavar="|".join(PLACES), help="rig: the arms are on the virtual rig.")
    ] = PLACES[0],
    referee: Annotated[
        bool, typer.Option(help="Contact, clearance and beam by FCL, where there is a scene.")
    ] = True,
    specimen: Annotated[
        int | None, typer.Option(min=0, max=SEED_MAX, help="On the rig: which arm was cast; 0.")
    ] = None,
    hidden: Hidden = None,
    cameras: Annotated[
        bool, typer.Option(help="On the rig: key points are measured; else foreseen by the model.")
    ] = True,
    trust: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="On the rig: share of what the cameras show beyond the model that is believed at "
            "once; 1: they are believed as they are. Default 0.3.",
        ),
    ] = None,
    arm: Arm = None,
    scene: SceneFolder = None,
    config: TaskConfig = None,
    effect_files: EffectFiles = None,
    json_file: JsonFile = None,
    replay: Replay = None,
    report: Report = None,
) -> None:
    """Play episodes with each driver and say how well they went, with 95 % intervals."""
    check_free(json_file, "drivers")
    check_replay(replay)
    check_folder(report)
    rig = _rig_config(on, specimen, hidden, cameras, trust)
    own, table = _task(drivers, task, config, arm, scene)
    place = own
    if rig is not None:
        from surgisoft.agents.on_rig import on_rig

        place = on_rig(own, rig)
    logged = drivers if report else drivers[:1] if replay else []
    results, logs = _evaluated(place, drivers, episodes, seed, referee, on, logged)
    print(f"{own.name}, {on}: {episodes} episodes of seed {seed}; mean [95 % interval]")
    _show(results)
    if json_file:
        from surgisoft.tasks.registry import config_table

        about = {
            "task": own.name,
            "task_config": table,
            "on": on,
            "rig": rig and config_table(rig),
            "seed": seed,
            "episodes": episodes,
            "dt_s": own.world.config.dt_s,
            "confidence": 0.95,
        }
        about["drivers"] = {result.driver: result.to_json() for result in results}
        write_json(json_file, about)
        print(f"wrote {json_file}")
    if replay:
        from surgisoft.replay.episode_view import write_replay

        with progress("replay") as told:
            written = write_replay(logs[drivers[0]], replay, report=told)
        print(f"wrote {written}")
    if report:
        from surgisoft.agents.report import evaluation_page
        from surgisoft.report import write_page

        about = f"{episodes} episodes of seed {seed}"
        page = evaluation_page(own.name, on, results, logs, about)
        print(f"wrote {write_page(page, report / 'report.html')}")


def _rig_config(
    on: str,
    specimen: int | None,
    hidden: list[str] | None,
    cameras: bool,
    trust: float | None,
):
    """The bench that is asked for, None in simulation."""
    if on not in PLACES:
        raise unknown_name("place", on, PLACES)
    if on != "rig":
        if specimen is not None or trust is not None or hidden or not cameras:
            raise InputError("--specimen, --hidden, --no-cameras, --trust are for --on rig")
        return None
    from surgisoft.agents.on_rig import RigConfig

    own = RigConfig(seed=specimen or 0, hidden=tuple(hidden_effects(hidden)), cameras=cameras)
    return own if trust is None else replace(own, observer_gain=trust)


def _task(drivers: list[str], task: str | None, config: Path | None, arm: str | None, scene):
    """The task to play and its configuration as a table; a run brings its own."""
    from surgisoft.agents.policies import DRIVERS, check_driver
    from surgisoft.agents.run_folder import RunFolder
    from surgisoft.tasks.registry import (
        TASKS,
        config_of,
        config_table,
        make_task,
        read_config,
        with_fields,
    )

    for name in drivers:
        check_driver(name)
    runs = [RunFolder(name) for name in drivers if name not in DRIVERS]
    if task is None and not runs:
        raise InputError(f"--task is missing: one of {', '.join(sorted(TASKS))}")
    task = task or runs[0].config["task"]
    brought = [run for run in runs if run.config["task"] == task]
    for run in runs:
        if run not in brought:
            trained = run.config["task"]
            warn(f"{run.path} was trained on {trained}")
    if config is not None:
        own = read_config(task, config)
    else:
        own = brought[0].plan().task_config if brought else config_of(task)
    given = {"arm": arm, "scene": None if scene is None else str(scene)}
    own = with_fields(own, **{name: value for name, value in given.items() if value is not None})
    return make_task(task, own), config_table(own)


def _evaluated(task, drivers: list[str], episodes: int, seed: int, referee: bool, on: str, logged):
    """Each driver's evaluation, and the first episode's log of those that are to be logged."""
    from surgisoft.agents.evaluate import evaluate as evaluate_driver
    from surgisoft.agents.policies import open_driver
    from surgisoft.agents.selection import FirstEpisode

    opened = {name: open_driver(name, task) for name in drivers}
    first = {name: FirstEpisode(task, name, seed, on) for name in logged}
    results = []
    for name, driver in opened.items():
        watch = first.get(name)
        with progress(f"evaluate {name}") as report:
            results.append(
                evaluate_driver(
                    task, name, driver, episodes, seed, referee, progress=report, watch=watch
                )
            )
    return results, {name: each.log() for name, each in first.items()}


def _show(results) -> None:
    from surgisoft.agents.evaluate import RATES

    names = list(dict.fromkeys(name for result in results for name in result.overall))
    rows = [["", *(Path(result.driver).name for result in results)]]
    for name in names:
        cells = (_cell(result.overall.get(name), name in RATES) for result in results)
        rows.append([name, *cells])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *cells in rows:
        held = "".join(f"   {cell:>{w}s}" for cell, w in zip(cells, widths[1:], strict=True))
        print(f"{first:{widths[0]}s}{held}")
    for result in results:
        if result.verdicts is not None:
            facts = result.to_json()["referee"]
            print(
                f"referee on {Path(result.driver).name}: {facts['instants']:,} instants; the "
                f"batched path differs on contact at {facts['contact_differs']}, on what the beam "
                f"meets at {facts['beam_differs']}, on where within {facts['beam_off_mm']:.1g} mm"
            )


def _cell(value, rate: bool) -> str:
    if value is None or not value.episodes:
        return "-"
    if rate:
        return f"{value.mean:.1%} [{value.low:.1%}, {value.high:.1%}]"
    return f"{value.mean:.4g} [{value.low:.4g}, {value.high:.4g}]"
