"""An experiment from its file to its report: find, extend, roll out, write."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surgisoft.agents.on_rig import rigs_by_arm
from surgisoft.agents.policies import Policy
from surgisoft.agents.report_charts import episode_charts
from surgisoft.agents.run_folder import RunFolder
from surgisoft.config import read_toml
from surgisoft.errors import InputError, unknown_name
from surgisoft.experiments.controllers import PhaseControllers
from surgisoft.experiments.page import experiment_page, markdown, shown_episodes
from surgisoft.experiments.phases import PhasedTask
from surgisoft.experiments.pictures import film, write_pictures
from surgisoft.experiments.plan import (
    Setting,
    build_task,
    in_words,
    scene_folder,
    scene_of,
    settings,
)
from surgisoft.experiments.results import Results, drop_logs, sum_up, write_tables
from surgisoft.experiments.run import DROPPED, about_policies, open_results, run_experiment
from surgisoft.experiments.spec import SCRIPTED, Experiment, load_experiment
from surgisoft.files import resolved, write_atomically
from surgisoft.progress import Progress, silent
from surgisoft.replay.episode_view import write_replay
from surgisoft.report import write_page
from surgisoft.rig.registry import check_rig, may_be_real
from surgisoft.scene.spec import FILE as SCENE_FILE
from surgisoft.scene.spec import MOST_LETTERS, PHANTOM, packaged_scene
from surgisoft.tasks.base import Task
from surgisoft.tasks.laser_dose import weak_laser
from surgisoft.tasks.world.reach import beam_beyond_limits

PACKAGED = PHANTOM / "experiments"
"""The experiments that come with the package."""
MOST_LASERS = 20
"""Most settings whose laser is compared with the dose that is needed, 0.1 to 1.5 s each."""
REPLAY_PICTURES_HZ = 1.0
"""Endoscope pictures in a second of the replays beside a report, 1/s."""


def find_experiment(name: str | Path) -> Path:
    """The file of an experiment, by its path or by the name of a packaged one (`liver`).

    A folder of that name, a scene's perhaps, is no experiment and hides none. Raises InputError for
    a word that is the name of no packaged one, and of nothing else.
    """
    path = Path(name)
    if len(path.parts) != 1 or path.is_file():
        return path
    packaged = {file.stem: file for file in PACKAGED.glob("*.toml")}
    if path.name in packaged:
        return packaged[path.name]
    if not path.suffix and not path.exists():
        unknown = unknown_name("experiment", path.name, packaged)
        raise InputError(f"{unknown}; or give the path of a TOML file")
    return path


def experiments_of(folder: str | Path | None = None) -> list[Path]:
    """The experiment files of a folder, or of a scene's `experiments`; default: the packaged."""
    folder = PACKAGED if folder is None else packaged_scene(folder)
    if (folder / SCENE_FILE).is_file():
        folder = folder / "experiments"
    files = sorted(folder.glob("*.toml"))
    if not files:
        raise InputError(f"{folder}: no experiment (*.toml) there")
    return files


def open_experiment(name: str | Path) -> Experiment:
    """Read an experiment, by its path or a packaged name, and check all its settings."""
    file = find_experiment(name)
    spec = load_experiment(file)
    settings(spec, read_toml(file)[1])
    return spec


@dataclass(frozen=True)
class ExperimentRules:
    """The phases, interlock and limits of an experiment, laid over a task that `evaluate` places.

    Satisfies `surgisoft.agents.session.Rules`: `evaluate(policies, rules=ExperimentRules.of(name))`
    takes the experiment's task, scene and seed, so that its episode k is that of the experiment.
    What the experiment varies keeps the value of its `[task]`, see `left_out`.
    """

    spec: Experiment
    """The experiment."""
    without: tuple[str, ...] = DROPPED
    """See `Rules`."""

    @classmethod
    def of(cls, name: str | Path) -> ExperimentRules:
        """The rules of an experiment, by its path or a packaged name."""
        return cls(open_experiment(name))

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.spec.name

    @property
    def task(self) -> str:
        """Name of the experiment's task."""
        return self.spec.scenario

    @property
    def config(self) -> Any:
        """The experiment's configuration of its task, with its scene."""
        place = {"scene": self.spec.scene} if self.spec.in_scene else {}
        return replace(self.spec.task, **place)

    @property
    def seed(self) -> int:
        """Seed of the experiment's episodes."""
        return self.spec.seed

    @property
    def left_out(self) -> list[str]:
        """Fields that the experiment varies, its lesions and its cases' scenes: episodes under the
        rules have one configuration, in which they are not."""
        spec = self.spec
        found = []
        for vary in spec.vary:
            plain = self._plain(vary.field)
            here = f", here {plain}" if plain else ""
            found.append(f"{vary.field} ({', '.join(map(in_words, vary.values))}{here})")
        if spec.lesions:
            found.append(f"the lesions {', '.join(each.name for each in spec.lesions)}")
        scenes = dict.fromkeys(Path(case.scene).name for case in spec.cases if case.scene)
        if scenes:
            found.append(f"the scenes {', '.join(scenes)}")
        if not found:
            return []
        return [
            f"--rules {spec.name}: the experiment varies {'; '.join(found)}, which evaluate leaves "
            "out; run them by 'surgisoft experiment run', a trained policy by its --policy"
        ]

    def _plain(self, field: str) -> str:
        """Value of a task's field in the configuration of the rules, as text; else empty."""
        top, *names = field.split(".")
        found = self.spec.task
        for name in names:
            found = getattr(found, name, None)
        return in_words(found) if top == "task" and found is not None else ""

    def over(self, task: Task) -> PhasedTask:
        """The task under the rules."""
        return PhasedTask(self.spec.of.experiment.supervise(task), self.spec)

    def policy(self, name: str, task: Task) -> Policy:
        """The controllers of the phases, the named policy among them."""
        assert isinstance(task, PhasedTask)
        return PhaseControllers(self.spec, task, name)


def with_policy(spec: Experiment, folder: str | Path) -> Experiment:
    """The experiment with one more case for each scripted one: the policy of a training run."""
    trained = RunFolder(folder).config["task"]
    if trained != spec.scenario:
        raise InputError(f"{folder}: was trained on {trained}; expected a run of {spec.scenario}")
    path = resolved(RunFolder(folder).path)
    plain = re.sub(r"[^A-Za-z0-9_-]", "_", path.name)
    twins = tuple(
        replace(case, name=f"{case.name}-{plain}"[:MOST_LETTERS], policy=str(path))
        for case in spec.cases
        if case.policy == SCRIPTED
    )
    names = [case.name for case in (*spec.cases, *twins)]
    if len(set(names)) < len(names):
        raise InputError(f"{folder}: there is a case of that name already; rename the folder")
    return replace(spec, cases=(*spec.cases, *twins))


def with_rigs(spec: Experiment, rigs: Iterable[str], preflight: bool = False) -> Experiment:
    """The experiment with other rigs in every case whose plant is `rig`.

    rigs: `NAME[:option=value,...]`, or `ARM=NAME[:...]` for single arms. A bench that may be real
    runs one episode after the other. preflight: whether real rigs have to move as predicted first.
    """
    rigs = tuple(rigs)
    if not any(case.plant == "rig" for case in spec.cases):
        raise InputError(f"--rig: {spec.name} has no case with plant = 'rig' that could use it")
    cases = tuple(
        replace(case, rigs=rigs, preflight=preflight) if case.plant == "rig" else case
        for case in spec.cases
    )
    texts = rigs_by_arm(rigs, spec.of.agents).values()
    for text in texts:
        check_rig(text)
    together = 1 if any(map(may_be_real, texts)) else spec.together
    return replace(spec, cases=cases, together=together)


def start_experiment(
    name: str | Path,
    output: str | Path | None = None,
    policies: Iterable[str | Path] = (),
    repeats: int | None = None,
    rigs: Iterable[str] = (),
    *,
    preflight: bool = False,
    resume: bool = False,
    force: bool = False,
    cluster: str | None = None,
    progress: Progress = silent,
) -> tuple[Experiment, Path]:
    """The experiment and its folder of results, new or ready to be resumed.

    output: default `results/NAME`. policies: folders of training runs, each added as a case.
    repeats: episodes of each setting. rigs: in place of those of the cases on rigs. preflight:
    whether real ones have to move as their models predict before each setting. resume:
    continue existing results; force: replace them. cluster: see `finish_experiment`; without one,
    benches that may be real are opened once and given back before anything is written. progress:
    called with the settings that were checked.
    """
    if resume and force:
        raise InputError("--resume continues results, --force replaces them: give one of the two")
    spec = open_experiment(name)
    for folder in policies:
        spec = with_policy(spec, folder)
    rigs = tuple(rigs)
    if preflight and not rigs:
        raise InputError("--preflight is for real rigs; name one with --rig")
    if rigs:
        spec = with_rigs(spec, rigs, preflight)
        settings(spec)
    spec = spec if repeats is None else replace(spec, repeats=repeats)
    place = Path(output) if output else Path("results") / spec.name
    open_results(spec, place, resume, force, cluster, progress)
    return spec, place


def finish_experiment(
    spec: Experiment,
    folder: Path,
    processes: int = 1,
    replays: bool = True,
    about: str = "",
    progress: Progress = silent,
    cluster: str | None = None,
    on_warning: Callable[[str], None] = warnings.warn,
) -> tuple[Results, list[Path]]:
    """Roll out what is not there yet and write tables, pictures, replays and the report.

    Returns the results and the files that were written. about: the command, for the report.
    cluster: address of a Dask scheduler whose workers run the episodes. on_warning: gets each
    warning of the episodes once.
    """
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        on_warning(text)

    for line in (*beams_beyond_limits(spec), *weak_lasers(spec, progress), *about_policies(spec)):
        note(line)
    rows = run_experiment(spec, folder, processes, progress, cluster, note)
    results = sum_up(spec, folder, rows)
    files = write_tables(results)
    logs = {(label, n): results.log(label, n) for label, n in shown_episodes(results)}
    films = {place: film(log) for place, log in logs.items() if log.camera is not None}
    charts = {place: episode_charts(log) for place, log in logs.items()}
    files += write_pictures(folder, charts, films)
    page = experiment_page(results, charts, films, about, notes)
    files.append(write_page(page, folder / "report.html"))
    drop_logs(results)
    if replays:
        files += _write_replays(results, progress)
    summary = folder / "summary.md"
    write_atomically(summary, markdown(results))
    return results, [*files, summary]


def beams_beyond_limits(spec: Experiment) -> list[str]:
    """See `beam_beyond_limits`: one line for each lesion where a beam passes its scene's limits, in
    each of the scenes."""
    if not spec.in_scene or getattr(spec.task, "arm", None) is not None:
        return []
    found = []
    places = {(scene_folder(spec, each.case), each.lesion): each for each in settings(spec)}
    several = len({folder for folder, _ in places}) > 1
    for (folder, lesion), setting in places.items():
        if beyond := beam_beyond_limits(scene_of(spec, setting)):
            of_scene = f"scene '{Path(folder).name}': " if several else ""
            of_lesion = f"lesion '{lesion.name}': " if lesion else ""
            found.append(f"{of_scene}{of_lesion}{beyond}")
    return found


def weak_lasers(spec: Experiment, progress: Progress = silent) -> list[str]:
    """See `weak_laser`: one line for each different task whose beam, in the phases that have one,
    is too weak to treat what a success needs.

    Of many settings `MOST_LASERS` are looked at, evenly; equal lines are one. progress: called with
    (settings looked at, settings to look at, note).
    """
    beam_s = sum(phase.timeout_s for phase in spec.phases if phase.beam)
    if not spec.in_scene or not beam_s:
        return []
    different: dict[Any, Setting] = {}
    for setting in settings(spec):
        values = tuple((name, value) for name, value in setting.values if name[:5] == "task.")
        place = scene_folder(spec, setting.case)
        different.setdefault((place, setting.lesion, values), replace(setting, values=values))
    said: dict[str, list[str]] = {}
    looked_at = list(different.values())[:: -(-len(different) // MOST_LASERS)]
    for number, setting in enumerate(looked_at):
        progress(number, len(looked_at), f"dose of the laser, {setting.words}")
        simulated = replace(setting, case=replace(setting.case, plant="simulation"))
        try:
            base = build_task(spec, simulated, on_warning=None).base
        except InputError:  # the run names the setting
            continue
        if weak := weak_laser(base, min(beam_s, spec.limits.time_s)):
            said.setdefault(weak, []).append(setting.label)
    found = []
    for weak, labels in said.items():
        more = f" and {len(labels) - 1} more" if len(labels) > 1 else ""
        found.append(f"setting '{labels[0]}'{more}: {weak}" if len(different) > 1 else weak)
    return found


def _write_replays(results: Results, progress: Progress) -> list[Path]:
    """Replays of the first and of the worst episode."""
    files = []
    worst = ("worst", *results.worst)
    for name, label, episode in (("first", results.settings[0].label, 0), worst):
        path = results.folder / "replays" / f"{name}.rrd"
        path.parent.mkdir(exist_ok=True)
        write_replay(results.log(label, episode), path, REPLAY_PICTURES_HZ, progress)
        files.append(path)
    return files
