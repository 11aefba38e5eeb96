"""The sub-commands of `surgisoft benchmark`: long studies whose results are committed."""

import contextlib
import datetime
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import typer

from surgisoft.cli.files import check_folder, check_free
from surgisoft.cli.inputs import warn
from surgisoft.cli.options import JsonFile
from surgisoft.cli.progress import progress
from surgisoft.files import write_atomically, write_json
from surgisoft.progress import Progress

app = typer.Typer(help="Studies that compute the tables of docs/results.", no_args_is_help=True)

Images = Annotated[Path | None, typer.Option(metavar="DIR", help="Write pictures to this folder.")]
"""Option of the studies with pictures."""
Output = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="FILE", help="Write the results to this file."),
]
"""Option of all studies."""
Processes = Annotated[
    int, typer.Option(min=1, help="Number of processes that work at the same time.")
]
"""Option of the studies with independent cases."""
Work = Annotated[
    Path,
    typer.Option(
        metavar="DIR",
        help="Folder of intermediate recordings, models and results; existing ones are reused.",
    ),
]
"""Option of the studies that can be interrupted."""
Robots = Annotated[str, typer.Option(help="Seeds of the virtual robots, with commas.")]
"""Option of the studies on virtual robots."""
RealData = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="Folder of your copy of the recordings; default: SURGISOFT_REAL_DATA.",
    ),
]
"""Option of the studies on recordings of real robots."""


@contextlib.contextmanager
def _kept(title: str, work: Path) -> Iterator[Progress]:
    """Progress of a study that keeps what is complete in a folder, and says so after Ctrl-C."""
    try:
        with progress(title) as report:
            yield report
    except KeyboardInterrupt:
        warn(f"the same command uses again what is complete in {work}")
        raise


def _numbers(option: str, text: str) -> list[int]:
    """Whole numbers separated by commas; raises InputError for other text."""
    from surgisoft.errors import InputError

    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"{option} '{text}': expected whole numbers such as 1,2,3") from None


def _show(title: str, command: str, body: str, output: Path | None) -> None:
    """Print a study's results with the command and the date, and write them to `output`."""
    today = datetime.date.today().isoformat()
    text = f"# {title}\n\nPrinted by `{command}` on {today}.\n\n{body}"
    if output:
        write_atomically(output, text)
    print(text)


@app.command()
def modelling(
    seeds: Annotated[str, typer.Option(help="Seeds of the robots, with commas.")] = "1,2,3",
    points: Annotated[
        int | None,
        typer.Option(min=64, help="Number of training points; default 13,824, as in the paper."),
    ] = None,
    processes: Processes = 2,
    work: Work = Path("runs/benchmark-modelling"),
    images: Images = None,
    output: Output = None,
) -> None:
    """The paper's modelling results: architectures, inputs, baselines and memory."""
    from benchmarks.modelling import run

    numbers = _numbers("--seeds", seeds)
    with progress("modelling") as report:
        table = run(numbers, points, processes, report, work, images)
    command = f"surgisoft benchmark modelling --seeds {seeds}"
    if points:
        command += f" --points {points}"
    _show("Modelling results", command, table, output)


@app.command()
def diagnosis(
    robots: Annotated[
        str,
        typer.Option(help="Seeds of the robots, with commas; 101 to 127 served for calibration."),
    ] = "128,129,130,131",
    count: Annotated[
        int, typer.Option(min=8, help="Number of cases, each a robot with a recording.")
    ] = 400,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the cases; 1 to 10 served for calibration.")
    ] = 11,
    processes: Processes = 2,
    work: Work = Path("runs/benchmark-diagnosis"),
    amend: Annotated[
        int,
        typer.Option(
            min=0, help="Number of cases with one known effect whose model is amended, too."
        ),
    ] = 45,
    only: Annotated[
        str,
        typer.Option(
            metavar="KIND,...",
            help="Kinds of cases, with commas: single (one effect of the list is hidden), clean, "
            "unknown, pair, undertrained. Default: all.",
        ),
    ] = "",
    images: Images = None,
    output: Output = None,
) -> None:
    """Benchmark of `diagnose` on virtual robots: hidden effects, none, or unknown ones."""
    from benchmarks.diagnosis.cases import SHARES, cases
    from benchmarks.diagnosis.study import run
    from benchmarks.diagnosis.table import draw, markdown

    numbers = _numbers("--robots", robots)
    kinds = tuple(word.strip() for word in only.split(",")) if only else tuple(SHARES)
    some = cases(numbers, count, seed, kinds)
    with _kept("diagnosis", work) as report:
        outcomes = run(some, work, processes, report, amend)
    command = f"surgisoft benchmark diagnosis --robots {robots} --count {count} --seed {seed}"
    command += f" --amend {amend}" + (f" --only {only}" if only else "")
    if images:
        print(f"wrote {draw(outcomes, images)}")
    _show("Diagnosis results", command, markdown(outcomes), output)


@app.command()
def intervals(
    robots: Annotated[
        str,
        typer.Option(help="Seeds of the robots, with commas; 201 to 204 served for calibration."),
    ] = "205,206,207,208",
    count: Annotated[
        int, typer.Option(min=1, help="Number of recordings of each setting with an effect.")
    ] = 30,
    clean: Annotated[
        int, typer.Option(min=0, help="Number of recordings of each setting without an effect.")
    ] = 32,
    only: Annotated[
        str, typer.Option(help="Words, with commas: settings with one in their name. Default: all.")
    ] = "",
    processes: Processes = 2,
    work: Work = Path("runs/benchmark-intervals"),
    output: Output = None,
) -> None:
    """Coverage of the intervals of `amend`, and falls that it claims on clean arms."""
    from benchmarks.intervals import SETTINGS, cases, markdown, run
    from surgisoft.errors import InputError

    words = [word.strip() for word in only.split(",") if word.strip()]
    named = {
        each.name for each in SETTINGS if not words or any(word in each.name for word in words)
    }
    for word in words:
        if not any(word in name for name in named):
            known = "; ".join(each.name for each in SETTINGS)
            raise InputError(f"--only {word}: no setting has this in its name, expected {known}")
    some = cases(count, clean, tuple(_numbers("--robots", robots)))
    some = [case for case in some if case.setting.name in named]
    with _kept("intervals", work) as report:
        outcomes = run(some, work, processes, report)
    command = f"surgisoft benchmark intervals --robots {robots} --count {count} --clean {clean}"
    command += f' --only "{only}"' if words else ""
    _show("Intervals of amend", command, markdown(outcomes), output)


@app.command()
def decision(
    cases: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SOURCE=FOLDER...",
            help="Sources of cases that are collected anew: folders with recordings before and "
            "after a change. All others are those that are stored.",
        ),
    ] = None,
    judge: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FOLDER...",
            help="The same, of cases that no fit uses: the fit to all others is tested on them.",
        ),
    ] = None,
    include: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Stored sources that no fit uses otherwise, to be fitted to as well.",
        ),
    ] = None,
    models: Annotated[
        Literal["default", "alone"],
        typer.Option(
            help="Models that the collected cases are diagnosed with: default, as fit makes them; "
            "alone, networks without a prior mean."
        ),
    ] = "default",
    robots: Robots = "200,201,202,203,204,205",
    undertrained: Annotated[
        str, typer.Option(help="Robots among them that also get an undertrained model.")
    ] = "200,201,203",
    count: Annotated[
        int, typer.Option(min=0, help="Number of cases of the own rig that are collected anew.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the own rig's cases.")] = 1,
    each_robot: Annotated[
        bool,
        typer.Option("--each-robot", help="Leave each robot out as well: one more fit for each."),
    ] = False,
    processes: Processes = 2,
    work: Work = Path("runs/benchmark-decision"),
    keep: Annotated[
        bool,
        typer.Option(
            "--keep", help="Store what was collected in benchmarks/decision/evidence, with --asset."
        ),
    ] = False,
    asset: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the decision fitted to all cases to this file."),
    ] = None,
    output: Output = None,
) -> None:
    """Fit the decision of `diagnose` to cases of several sources; test it on each, left out.

    Without options it uses the stored evidence of all sources. --count, --cases and --judge collect
    the evidence of a source anew.
    """
    from benchmarks.decision import own_rig
    from benchmarks.decision.study import Collected, run
    from benchmarks.decision.table import markdown
    from surgisoft.errors import InputError

    check_folder(work)
    if include and (keep or asset):
        raise InputError(
            "--include: not with --keep or --asset, which are of the decision in force"
        )
    plan = own_rig.Plan(_numbers("--robots", robots), _numbers("--undertrained", undertrained))
    with _kept("decision", work) as report:
        new = Collected(plan, count, seed, cases or [], judge or [], include or [], models)
        some, aside, values = run(new, work, processes, report, keeps=keep)
    if asset:
        write_atomically(asset, json.dumps(values, indent=1) + "\n")
        print(f"wrote {asset}")
    table = markdown(some, values, aside, each_robot)
    command = values["command"] + (" --each-robot" if each_robot else "")
    _show("Decision results", command, table, output)


@app.command("setup-faults")
def setup_faults(
    robots: Robots = "142,143",
    folders: Annotated[
        list[Path] | None,
        typer.Option(
            "--source",
            metavar="DIR",
            help="Folder with model/, clean/*.parquet and hidden/*.parquet of another arm.",
        ),
    ] = None,
    cases: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="Folder of cases of another simulator, as python -m benchmarks.chain_cases makes "
            "them. Faults are put into its cases in which nothing is missing.",
        ),
    ] = None,
    models: Annotated[
        Path,
        typer.Option(
            metavar="DIR", help="Folder of the models of their robots; missing ones are fitted."
        ),
    ] = Path("runs/benchmark-decision/models"),
    count: Annotated[
        int, typer.Option(min=1, help="Number of single faults, and of pairs, of each source.")
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the faults.")] = 1,
    processes: Processes = 2,
    work: Work = Path("runs/benchmark-setup-faults"),
    output: Output = None,
) -> None:
    """Benchmark of the set-up tests: wrong frames, units, orders, chambers and clocks."""
    from benchmarks.setup_faults import markdown, run
    from surgisoft.errors import InputError

    numbers = _numbers("--robots", robots) if robots else []
    some = [(folder, models) for folder in cases or []]
    if not (numbers or folders or some):
        raise InputError("--robots '': expected seeds such as 142,143, or --source or --cases")
    with _kept("setup-faults", work) as report:
        outcomes = run(numbers, folders or [], some, count, seed, work, processes, report)
    command = f"surgisoft benchmark setup-faults --robots '{robots}' --count {count} --seed {seed}"
    command += "".join(f" --source {folder.name}" for folder in folders or [])
    command += "".join(f" --cases {folder.name}" for folder in cases or [])
    _show("Set-up faults", command, markdown(outcomes), output)


@app.command("hidden-effect")
def hidden_effect(
    effects: Annotated[
        str, typer.Option(help="Effects that the model lacks, with commas; one study each.")
    ] = "creep,line_lag,payload,hysteresis",
    robot_seed: Annotated[int, typer.Option(min=0, help="Seed of the robot.")] = 0,
    strength: Annotated[float, typer.Option(help="Amplitude of the hidden effects.")] = 1.0,
    steps: Annotated[int, typer.Option(min=1, help="Training steps of each policy.")] = 2_000_000,
    episodes: Annotated[int, typer.Option(min=2, help="Episodes of each policy.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of training and of episodes.")] = 0,
    work: Work = Path("runs/benchmark-hidden-effect"),
    images: Images = None,
    output: Output = None,
) -> None:
    """Train a policy, diagnose the model on a rig with a hidden effect, amend it, and retrain."""
    import torch

    from benchmarks.hidden_effect.study import StudyConfig, run
    from benchmarks.hidden_effect.table import draw, markdown

    check_folder(work)
    check_folder(images)
    config = StudyConfig(robot_seed, strength, steps, seed, episodes)
    torch.set_num_threads(1)
    with _kept("hidden-effect", work) as report:
        outcomes = run(effects.split(","), config, work, report)
    command = (
        f"surgisoft benchmark hidden-effect --effects {effects} --robot-seed {robot_seed} "
        f"--strength {strength:g} --steps {steps} --episodes {episodes} --seed {seed}"
    )
    shown = ""
    if images:
        paths = draw(outcomes, images)
        shown = "".join(f"\n![{path.stem}](../images/{path.name})\n" for path in paths)
    _show("From diagnosis to policy", command, markdown(outcomes, config) + shown, output)


@app.command()
def control(
    runs: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder of training runs named TASK-seed-N; missing ones are trained.",
        ),
    ] = Path("runs/benchmark-control"),
    tasks: Annotated[
        str | None, typer.Option(help="Tasks, such as track_circle,keyhole; default: all.")
    ] = None,
    seeds: Annotated[str, typer.Option(help="Seeds of the training runs.")] = "1,2,3",
    episodes: Annotated[int, typer.Option(min=2, help="Episodes in simulation.")] = 100,
    rig_episodes: Annotated[int, typer.Option(min=2, help="Episodes on the rig.")] = 20,
    output: Output = None,
) -> None:
    """Learned, scripted and random policies on every task, in simulation and on the rig."""
    import torch

    from benchmarks.control.study import TASKS, ControlConfig, run
    from benchmarks.control.table import markdown

    check_folder(runs)
    numbers = tuple(_numbers("--seeds", seeds))
    chosen = tuple(tasks.split(",")) if tasks else TASKS
    config = ControlConfig(chosen, numbers, episodes, rig_episodes)
    torch.set_num_threads(1)
    with _kept("control", runs) as report:
        results = run(config, runs, report)
    command = f"surgisoft benchmark control --seeds {seeds}"
    command += f" --tasks {tasks}" if tasks else ""
    command += f" --episodes {episodes} --rig-episodes {rig_episodes}"
    _show("Control results", command, markdown(results, config), output)


@app.command()
def robust(
    policies: Annotated[
        str,
        typer.Option(
            help="Policies, with commas: runs' folders, names of packaged ones, or scripted; the "
            "first is evaluated with hidden effects, too."
        ),
    ] = "ring,scripted",
    robots: Annotated[
        str, typer.Option(help="Seeds of the robots, with commas; 0 to 20 served for development.")
    ] = "21,22,23,24,25,26,27,28,29,30",
    own: Annotated[
        str,
        typer.Option(
            help="Robots that also get a model fitted to them, with commas; may be empty."
        ),
    ] = "21,22,23,24,25,26,27,28,29,30",
    improved: Annotated[
        str,
        typer.Option(
            help="Robots for which the package's model is improved (surgisoft improve), too, with "
            "commas; may be empty."
        ),
    ] = "",
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of each robot.")] = 10,
    hidden_robots: Annotated[
        str, typer.Option(help="Robots with hidden effects, with commas; may be empty.")
    ] = "21,26",
    hidden_episodes: Annotated[
        int, typer.Option(min=1, help="Episodes of each hidden effect and robot.")
    ] = 2,
    hidden: Annotated[
        str, typer.Option(help="Hidden effects, with commas; empty: all of them.")
    ] = "",
    observers: Annotated[
        str, typer.Option(help="Observers, with commas: filter, learns.")
    ] = "filter,learns",
    exact: Annotated[
        bool,
        typer.Option(
            "--exact/--batched",
            help="Contact by FCL, or by the engine of training, which is faster.",
        ),
    ] = True,
    poses: Annotated[
        int,
        typer.Option(
            min=1,
            help="Random pressures, 4 s each, before an episode: the observer learns from them.",
        ),
    ] = 3,
    work: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder of models and of each case's result.")
    ] = Path("runs/benchmark-robust"),
    images: Images = None,
    output: Output = None,
    json_file: JsonFile = None,
) -> None:
    """Rings cut on robots that no model was fitted to: each policy with each observer."""
    from dataclasses import asdict

    import torch

    from benchmarks.robust import FILTER, LEARNS, Method, Study, draw, markdown, run
    from surgisoft.errors import unknown_name
    from surgisoft.rig.hidden import HIDDEN

    check_free(json_file, "cases")
    check_folder(work)
    check_folder(images)
    for observer in observers.split(","):
        if observer not in (FILTER, LEARNS):
            raise unknown_name("observer", observer, (FILTER, LEARNS))
    names = {policy: Path(policy).name for policy in policies.split(",")}
    methods = tuple(
        Method(f"{name}, {observer}", policy, observer)
        for policy, name in names.items()
        for observer in observers.split(",")
    )
    first = policies.split(",")[0]
    best = tuple(m.name for m in methods if m.policy == first and m.observer == LEARNS)

    def seeds(option: str, text: str) -> tuple[int, ...]:
        return tuple(_numbers(option, text)) if text else ()

    study = Study(
        methods,
        seeds("--robots", robots),
        seeds("--own", own),
        seeds("--improved", improved),
        episodes,
        best,
        seeds("--hidden-robots", hidden_robots),
        hidden_episodes,
        tuple(hidden.split(",")) if hidden else tuple(HIDDEN),
        exact,
        poses,
    )
    torch.set_num_threads(1)
    with progress("robust") as report:
        rows, floors = run(study, work, report)
    if json_file:
        write_json(json_file, {"cases": [asdict(r) for r in rows]})
    command = f"surgisoft benchmark robust --policies {','.join(names.values())}"
    command += f" --robots {robots} --own '{own}'"
    command += f" --improved {improved}" if improved else ""
    command += f" --episodes {episodes}"
    command += f" --hidden-robots '{hidden_robots}' --hidden-episodes {hidden_episodes}"
    command += f" --hidden {hidden}" if hidden else ""
    command += "" if observers == "filter,learns" else f" --observers {observers}"
    command += "" if exact else " --batched"
    command += "" if poses == 3 else f" --poses {poses}"
    shown = ""
    if images:
        shown = f"\n![robust](../images/{draw(rows, floors, study, images).name})\n"
    _show("Rings on unseen robots", command, markdown(rows, floors, study) + shown, output)


@app.command()
def live(
    robots: Robots = "204,205,206,207",
    hours: Annotated[
        float, typer.Option(min=0.2, help="Hours of clean rig for each robot and motion.")
    ] = 5.0,
    changed: Annotated[
        str, typer.Option(help="Seeds of the robots on which effects begin; default: all.")
    ] = "",
    models: Work = Path("runs/benchmark-live"),
    processes: Processes = 2,
    output: Output = None,
    json_file: JsonFile = None,
) -> None:
    """False alarms of the change detector on a clean rig, and its delay after a change."""
    from dataclasses import asdict

    from benchmarks.live import markdown, run

    check_free(json_file, "clean")
    check_folder(models)
    numbers = _numbers("--robots", robots)
    with _kept("live", models) as report:
        some = _numbers("--changed", changed) if changed else numbers
        clean, changes = run(numbers, some, hours, models, processes, report)
    if json_file:
        both = {"clean": [asdict(c) for c in clean], "changes": [asdict(c) for c in changes]}
        write_json(json_file, both)
    command = f"surgisoft benchmark live --robots {robots} --hours {hours:g}"
    command += f" --changed {changed}" if changed else ""
    _show("Live: false alarms and delays", command, markdown(clean, changes), output)


@app.command()
def real(
    entries: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[ENTRY.toml...]",
            help="Entries, or folders of them; default: those of the project.",
        ),
    ] = None,
    data: RealData = None,
    only: Annotated[
        str | None, typer.Option(metavar="NAME", help="Run this one entry of them.")
    ] = None,
    work: Work = Path("runs/benchmark-real"),
    output: Output = None,
    json_file: JsonFile = None,
) -> None:
    """Known changes of real robots: diagnose a model that was fitted before the change."""
    from benchmarks.real.entries import data_folder, load_entries
    from benchmarks.real.study import run, to_json
    from benchmarks.real.table import markdown

    check_free(json_file, "entries")
    check_folder(work)
    some = load_entries(entries or [], only)
    folder = data_folder(data)
    with _kept("real", work) as report:
        outcomes = run(some, folder, work, report)
    command = " ".join(
        ["surgisoft benchmark real", *map(str, entries or []), "--data FOLDER"]
        + (["--only", only] if only else [])
    )
    if json_file:
        write_json(json_file, to_json(outcomes))
    _show("Real robots: known changes", command, markdown(outcomes), output)


@app.command()
def inject(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the cases.")
    ],
    data: RealData = None,
    robots: Annotated[
        str | None, typer.Option(help="Robots, with commas; default: all of them.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the cases.")] = 1,
) -> None:
    """Inject effects into real recordings: cases with a known truth and real noise."""
    from benchmarks.injected.cases import ROBOTS, make_cases
    from benchmarks.real.entries import data_folder

    check_folder(output)
    names = robots.split(",") if robots else list(ROBOTS)
    folder = data_folder(data)
    with progress("inject") as report:
        lines = make_cases(names, folder, output, seed, report)
    print(*lines, sep="\n")


@app.command()
def cases(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of cases, as `inject` writes it.")
    ],
    only: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Only cases whose path has this text.")
    ] = None,
    without_truth: Annotated[
        bool,
        typer.Option(
            "--without-truth",
            help="Every case of a known effect once more, without that effect among the "
            "candidates: the right answer is `unknown_effect` then.",
        ),
    ] = False,
    processes: Processes = 2,
    output: Output = None,
    json_file: JsonFile = None,
) -> None:
    """Diagnose a folder of cases with a known truth; one model is fitted for each robot."""
    from benchmarks.injected.study import find_cases, markdown, run, to_json
    from surgisoft.errors import InputError

    check_free(json_file, "cases")
    found = find_cases(folder)
    some = [case for case in found if only is None or only in str(case.place)]
    if not some:
        raise InputError(f"--only '{only}': none of {len(found)} cases has it in its path")
    if without_truth:
        some += [twin for case in some if (twin := case.without_truth)]
    with _kept("cases", folder) as report:
        judged = run(some, processes, report)
    if json_file:
        write_json(json_file, to_json(judged))
    command = "surgisoft benchmark cases DIR" + (f" --only {only}" if only else "")
    command += " --without-truth" if without_truth else ""
    _show("Cases with a known truth", command, markdown(judged), output)


@app.command()
def budget(
    tasks: Annotated[
        str, typer.Option(help="Names of tasks, with commas.")
    ] = "track_circle,circle_ablation",
    envs: Annotated[
        str, typer.Option(help="Numbers of parallel episodes, with commas.")
    ] = "1,64,1024,4096,16384",
    output: Output = None,
) -> None:
    """Least possible and measured cost of each part of a training step on this machine."""
    from benchmarks.budget import against_fcl, markdown, run
    from surgisoft.tasks.registry import spec_of

    names, counts = tasks.split(","), _numbers("--envs", envs)
    for name in names:
        spec_of(name)
    with progress("budget") as report:
        rows, rates = run(names, counts, report)
    command = f"surgisoft benchmark budget --tasks {tasks} --envs {envs}"
    exact = {name: against_fcl(name) for name in names}
    _show("Budget of a training step", command, markdown(rows, rates, exact), output)


@app.command()
def guard(
    against: Annotated[
        str, typer.Argument(help="Commit or tag to compare with; default: the last tag, if any.")
    ] = "",
    repeats: Annotated[int, typer.Option(min=3, help="Interleaved repeats of each side.")] = 7,
) -> None:
    """Compare the speed of the main operations with an earlier commit, side by side."""
    from benchmarks.guard import run

    if not run(against, repeats):
        raise typer.Exit(1)


@app.command()
def rows(
    sizes: Annotated[
        str, typer.Option("--rows", help="Rows of recordings, with commas.")
    ] = "10000,100000,1000000",
    diagnosed: Annotated[
        str, typer.Option(help="Rows of recordings that are diagnosed, with commas.")
    ] = "12000,200000,2000000",
    faces: Annotated[str, typer.Option(help="Faces of organs, with commas.")] = "80000,500000",
    slices: Annotated[
        str, typer.Option(help="Slices of 512 x 512 of segmented images, with commas.")
    ] = "200",
    output: Output = None,
) -> None:
    """Processor time and memory of commands on large files; '' leaves a kind out."""
    from benchmarks.rows import markdown, run

    given = {"--rows": sizes, "--faces": faces, "--diagnosed": diagnosed, "--slices": slices}
    numbers = [_numbers(option, text) if text else [] for option, text in given.items()]
    with progress("rows") as report:
        found = run(*numbers, report)
    words = [f"{option} {text or repr(text)}" for option, text in given.items()]
    command = " ".join(["surgisoft benchmark rows", *words])
    _show("Cost of commands on large files", command, markdown(found), output)


@app.command()
def peers(
    turns: Annotated[int, typer.Option(min=2, help="Turns of each environment.")] = 5,
    output: Output = None,
) -> None:
    """Speed of other projects' environments and of this one's, in one run."""
    from benchmarks.peers import markdown, run

    with progress("peers") as report:
        found = run(turns, report)
    command = f"surgisoft benchmark peers --turns {turns}"
    _show("Environments of other projects", command, markdown(found), output)


@app.command()
def scaling(images: Images = None, output: Output = None) -> None:
    """How cost grows with environments, faces, key points and rows."""
    from benchmarks.scaling import draw, markdown, run

    check_folder(images)
    with progress("scaling") as report:
        curves = run(report)
    body = markdown(curves)
    if images:
        images.mkdir(parents=True, exist_ok=True)
        body += f"\n![Cost against size](../images/{draw(curves, images).name})\n"
    _show("How cost grows", "surgisoft benchmark scaling", body, output)
