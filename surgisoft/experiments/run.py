"""Runs a whole experiment into a folder: block by block, over processes, resumed after a break.

The blocks, not the processes, decide what is computed together; so one process and many, a run in
one go and one that was interrupted give the same rows.
"""

from __future__ import annotations

import os
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surgisoft.agents.evaluate import RATES, episode_table
from surgisoft.agents.exact_checks import EpisodeCheck, ExactChecks, has_obstacles
from surgisoft.agents.on_rig import at_benches, real_benches, rigs_by_arm
from surgisoft.agents.policies import POLICIES
from surgisoft.agents.rollout import EpisodeRecorders, Instant, Rollout, rollout
from surgisoft.agents.run_folder import RunFolder, versions
from surgisoft.agents.session import trained_elsewhere
from surgisoft.config import LARGEST_INTEGER, Where
from surgisoft.errors import InputError, counted, raised_by
from surgisoft.experiments.controllers import PhaseControllers
from surgisoft.experiments.phases import REASONS, PhasedTask, with_phase_events
from surgisoft.experiments.plan import (
    ROBOT_SEED,
    Setting,
    build_task,
    rig_config,
    scene_folder,
    scene_of,
    settings,
)
from surgisoft.experiments.spec import (
    FILE,
    NOMINAL,
    Case,
    Experiment,
    load_experiment,
    save_experiment,
)
from surgisoft.files import json_safe, new_folder, read_json, resolved, write_atomically, write_json
from surgisoft.progress import Progress, silent
from surgisoft.rig.registry import check_rig, may_be_real
from surgisoft.scene.folder import open_scene
from surgisoft.surrogate.checkpoint import content_hash
from surgisoft.surrogate.code import name_code, named_code
from surgisoft.tasks.base import DONE, TIME_OUT
from surgisoft.tasks.episodes.file import save_episode
from surgisoft.tasks.episodes.log import EpisodeLog
from surgisoft.tasks.supervision import Row
from surgisoft.workers import CLUSTER, check_processes, torch_threads, workers

POLICY = "policy"
"""Name of a policy's digest among those of a case; those of arm models have the arms' names."""
SCENE = "scene"
"""Name of the digest of a case's own scene among those of the case."""
WITH = " with "
"""Between an arm's name and the values of the setting, in names of such digests."""
DROPPED = ("phase", "reason", "reason_phase", "late_phase", "beam", "beam_unsafe", "safe")
"""Measures of single steps whose means mean nothing."""


@dataclass(frozen=True, eq=False)
class Block:
    """Results of episodes that ran side by side."""

    rows: list[Row]
    """Results of each episode, see `Results`."""
    logs: dict[int, EpisodeLog]
    """Episode's number -> log: number 0, and the worst of the block."""


@dataclass(frozen=True)
class Failure:
    """A block of episodes that an exception ended."""

    setting: str
    """The setting's label."""
    text: str
    """Setting, episodes, the exception, and the line that raised it, in one line."""
    file: Path
    """File with the text and the exception's traceback."""


@dataclass(frozen=True)
class Job:
    """One block of episodes of one setting."""

    setting: Setting
    """Setting of all episodes of the block."""
    first: int
    """Number of the block's first episode."""
    count: int
    """Number of episodes."""


def jobs(spec: Experiment) -> list[Job]:
    """Every block of episodes, setting by setting."""
    return [
        Job(setting, first, min(spec.together, spec.repeats - first))
        for setting in settings(spec)
        for first in range(0, spec.repeats, spec.together)
    ]


def row_file(folder: Path, setting: Setting, episode: int) -> Path:
    """Path of an episode's numbers."""
    return folder / "rows" / f"{setting.label}-{episode:04d}.json"


def log_file(folder: Path, setting: str, episode: int) -> Path:
    """Path of an episode's log, which exists for stored episodes only."""
    return folder / "logs" / f"{setting}-{episode:04d}.npz"


def failure_file(folder: Path, setting: Setting, first: int) -> Path:
    """Path of what ended a block; the file exists for blocks that failed only."""
    return folder / "failures" / f"{setting.label}-{first:04d}.txt"


def open_results(
    spec: Experiment,
    folder: Path,
    resume: bool = False,
    force: bool = False,
    cluster: str | None = None,
    progress: Progress = silent,
) -> None:
    """Make the folder of results, or check that it holds results of this experiment.

    Raises InputError, before anything is written, where a setting that has no results yet cannot
    be built, or a bench that is to be used cannot be opened. cluster: see `run_experiment`; the
    benches are then those of its workers. progress: called with the settings that were built.
    """
    remote = bool(cluster or os.environ.get(CLUSTER))
    there = (folder / FILE).is_file()
    if there and resume and not force:
        began = load_experiment(folder / FILE)
        names = [each.name for each in fields(spec)]
        differ = [name for name in names if getattr(began, name) != getattr(spec, name)]
        if differ:
            raise InputError(
                f"{folder}: holds another experiment ({folder / FILE} differs in "
                f"{', '.join(differ)}); run that file with --resume to continue it, choose another "
                "folder, or --force to start again"
            )
        _check_began_with(spec, folder)
        check_playable(spec, folder, progress)
        if not remote:
            check_benches(spec, folder)
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not there:
            raise InputError(
                f"{folder}: exists and holds no results of an experiment; choose another folder"
            )
        if not force:
            raise InputError(
                f"{folder}: results already exist; --resume continues them, --force replaces them"
            )
    check_playable(spec, progress=progress)
    if not remote:
        check_benches(spec)
    about: dict[str, object] = {"versions": versions()}
    if shared := _shared_scene(spec):
        about["scene_hash"] = shared
    about["cases"] = {case.name: _case_hashes(spec, case) for case in spec.cases}
    replaced = [path.name for path in folder.iterdir()] if folder.exists() else []
    with new_folder(folder, own=replaced) as fresh:  # old results stay until the new ones begin
        (fresh / "rows").mkdir()
        write_json(fresh / "versions.json", about)
        save_experiment(spec, fresh / FILE)


def _check_began_with(spec: Experiment, folder: Path) -> None:
    """Raise an InputError where the scene, or the policy or an arm model of a case that goes on, is
    not the one that the results began with. Results of earlier versions state the scene alone."""
    file = folder / "versions.json"
    about = read_json(file) if file.is_file() else None
    about = about if isinstance(about, dict) else {}
    began = about.get("scene_hash")
    shared = _shared_scene(spec)
    if shared and began not in (None, shared):
        raise _changed(folder, f"its scene '{spec.scene}'", "scene")
    cases = about.get("cases")
    stated = cases if isinstance(cases, dict) else {}
    left = {job.setting.case.name for job in jobs(spec) if not _is_done(folder, job)}
    for case in spec.cases:
        before = stated.get(case.name)
        if case.name not in left or not isinstance(before, dict):
            continue
        now = _case_hashes(spec, case)
        for name in (name for name in before if name in now and now[name] != before[name]):
            arm, _, varied = name.partition(WITH)
            of_arm = f"the arm model of '{arm}'{WITH * bool(varied)}{varied}"
            of_name = {
                POLICY: (f"the policy '{case.policy}'", "policy"),
                SCENE: (f"the scene '{case.scene}'", "scene"),
            }
            what, kind = of_name.get(name, (of_arm, "model"))
            raise _changed(folder, f"{what} of its case '{case.name}'", kind)


def _shared_scene(spec: Experiment) -> str:
    """Digest of the experiment's scene with its first lesion; empty where no case is in it."""
    if spec.in_scene:
        for setting in settings(spec):
            if not setting.case.scene:
                return scene_of(spec, setting).content_hash
    return ""


def _changed(folder: Path, what: str, kind: str) -> InputError:
    """What the results of a folder began with is not there any more."""
    return InputError(
        f"{folder}: {what} has changed since the results began (by {folder / 'versions.json'}); "
        f"bring that {kind} back, or --force to start again"
    )


def _case_hashes(spec: Experiment, case: Case) -> dict[str, str]:
    """Digests of what acts in a case: arm's name -> that of its model, `POLICY` -> that of the
    checkpoint of a training run, `SCENE` -> that of the case's own scene.

    Where a field with text varies, such as the arm, each further combination has names of its own:
    the arm's with `WITH`, the fields and their values.
    """
    hashes: dict[str, str] = {}
    differ: dict[tuple, Setting] = {}
    for setting in settings(spec):
        if setting.case == case:
            texts = tuple((f, value) for f, value in setting.values if isinstance(value, str))
            differ.setdefault(texts, setting)
    for texts, setting in differ.items():
        plain = replace(setting, case=Case("", arm=case.arm, scene=case.scene))
        varied = WITH + ", ".join(f"{f} = '{value}'" for f, value in texts) if hashes else ""
        arms = build_task(spec, plain, on_warning=None).world.arms
        hashes |= {name + varied: content_hash(arm.model) for name, arm in arms.items()}
    if case.scene:
        hashes[SCENE] = scene_of(spec, next(iter(differ.values()))).content_hash
    if case.policy in (*POLICIES, NOMINAL):
        return hashes
    found = RunFolder(case.policy).policy_hash
    return hashes if found is None else {**hashes, POLICY: found}


def check_playable(
    spec: Experiment, folder: Path | None = None, progress: Progress = silent
) -> float:
    """Raise an InputError unless the task and the controllers of every setting can be built.

    A case on a rig that may be real is built in simulation, where observations and actions are the
    same; `check_benches` opens the rig. folder: results that are continued; a setting whose
    episodes are all there needs not be built any more. progress: called with the settings that were
    built, of those that differ. Returns the clearance below which the beam is off, mm: the larger
    of the file's and the scene's.
    """
    found, clear_mm = settings(spec), 0.0
    if folder:
        left = {job.setting.number for job in jobs(spec) if not _is_done(folder, job)}
        found = [setting for setting in found if setting.number in left]
    different = {_as_built(spec, setting): setting for setting in found}
    for number, (built, setting) in enumerate(different.items()):
        progress(number, len(different), setting.words)
        try:
            task = build_task(spec, built, on_warning=None)  # the run warns
            PhaseControllers(spec, task, built.case.policy)
        except InputError as error:
            where = f"setting '{setting.label}': " if len(found) > 1 else ""
            raise InputError(f"{where}{error}") from None
        clear_mm = task.clear_mm
    return clear_mm


def about_policies(spec: Experiment) -> list[str]:
    """What a user has to know about the trained policies of an experiment, one line each.

    A policy that was trained in another scene, and one that was trained in shorter episodes than
    those of the experiment: what it does after the end of such an episode, it never learned.
    """
    lines = []
    learned = [case for case in spec.cases if case.policy not in (*POLICIES, NOMINAL)]
    for policy, folder in dict.fromkeys((c.policy, scene_folder(spec, c)) for c in learned):
        if spec.in_scene:
            scene, name = open_scene(folder), Path(folder).name
            lines.append(trained_elsewhere(RunFolder(policy), scene, name))
    for policy in dict.fromkeys(case.policy for case in learned):
        task = RunFolder(policy).task()
        trained_s = task.steps * task.world.config.dt_s
        if spec.limits.time_s > trained_s + 0.5 * task.world.config.dt_s:
            lines.append(
                f"{policy} was trained in episodes of {trained_s:g} s, and those of {spec.name} "
                f"last up to {spec.limits.time_s:g} s: from {trained_s:g} s on it observes the "
                "end of its episode"
            )
    return [line for line in lines if line]


def _as_built(spec: Experiment, setting: Setting) -> Setting:
    """The setting without what no task needs to be built: equal for settings that are built alike.

    Raises InputError for the text of a rig that names none, or options that it does not have.
    """
    case = replace(setting.case, name="", robot_seed=0)
    texts = rigs_by_arm(case.rigs, spec.of.agents).values()
    for text in texts:
        check_rig(text)
    if any(map(may_be_real, texts)):
        case = Case("", policy=case.policy, arm=case.arm, scene=case.scene)
    left_out = (*ROBOT_SEED, "fault.at_s")
    values = tuple((field, value) for field, value in setting.values if field not in left_out)
    return replace(setting, number=0, case=case, values=values)


def check_benches(spec: Experiment, folder: Path | None = None) -> None:
    """Raise an InputError unless every bench that may be real opens and fits its arm.

    Each is given back at once: its episodes may begin hours later. It is opened once for every
    choice of hidden effects, which a real rig refuses. folder: results that are continued; a case
    whose episodes are all there needs no bench any more.
    """
    seen = set()
    for job in jobs(spec):
        case = job.setting.case
        rig = rig_config(job.setting, Where(Path(spec.name)), spec.of.agents)
        if rig is None or (folder and _is_done(folder, job)):
            continue
        asked = (case.name, tuple(name for name, *_ in rig.hidden))
        if asked in seen:
            continue
        seen.add(asked)
        if not _may_be_real(spec, case):
            continue
        for bench in real_benches(build_task(spec, job.setting)).values():
            bench.close()


def run_experiment(
    spec: Experiment,
    folder: Path,
    processes: int = 1,
    report: Progress = silent,
    cluster: str | None = None,
    on_warning: Callable[[str], None] = warnings.warn,
) -> list[Row]:
    """Run every block that has no results yet; returns all rows, in order. See `open_results`.

    A block that an exception ends leaves its file of `failures`, and the others are run. The rows
    are then those of the settings without a failure. Raises InputError where each setting has one,
    and at once where a case is on a rig that may be real.

    cluster: address of a Dask scheduler whose workers, which see the same folder, run the blocks.
    on_warning: gets each warning of a block once, whichever process ran the block.
    """
    warned: set[str] = set()

    def warn(found: list[str]) -> None:
        for text in found:
            if text not in warned:
                warned.add(text)
                on_warning(text)

    check_processes(processes, cluster)
    every = jobs(spec)
    left = [job for job in every if not _is_done(folder, job)]
    total = float(sum(job.count for job in every))
    done = total - sum(job.count for job in left)
    report(done, total, "")
    if processes == 1 and not (cluster or os.environ.get(CLUSTER)):
        with torch_threads(1):
            for job in left:
                began = done

                def within(step, steps, note="", job=job, began=began) -> None:
                    report(began + job.count * step / steps, total, job.setting.words)

                warn(_run_block(spec, folder, job, within))
                done += job.count
                report(done, total, job.setting.words)
    else:
        for job, found in _in_processes(spec, resolved(folder), left, processes, cluster):
            warn(found)
            done += job.count
            report(done, total, job.setting.words)
    failed = failures(spec, folder)
    without = {failure.setting for failure in failed}
    whole = [job for job in every if job.setting.label not in without]
    if not whole:
        raise InputError(f"every setting failed: {failed_words(failed)}")
    return read_rows(folder, whole)


def failures(spec: Experiment, folder: Path) -> list[Failure]:
    """The blocks of an experiment that have no results because an exception ended them."""
    found = []
    for job in jobs(spec):
        file = failure_file(folder, job.setting, job.first)
        if file.is_file() and not _is_done(folder, job):
            first_line = file.read_text(encoding="utf-8").partition("\n")[0]
            found.append(Failure(job.setting.label, first_line, file))
    return found


def failed_words(failed: list[Failure]) -> str:
    """The first failure, how many more there are, and what to do, in one line."""
    more = f" (and {counted(len(failed) - 1, 'further block')})" if len(failed) > 1 else ""
    return f"{failed[0].text}{more}; the traceback is in {failed[0].file}; continue with --resume"


def read_rows(folder: Path, every: list[Job]) -> list[Row]:
    """The row of every episode, in order; raises InputError for one that was not written so."""
    rows: list[Row] = []
    for job in every:
        for episode in range(job.first, job.first + job.count):
            file = row_file(folder, job.setting, episode)
            row = read_json(file)
            place = (job.setting.label, episode)
            known = isinstance(row, dict) and (row.get("setting"), row.get("episode")) == place
            if not known or not _is_whole(row) or (rows and _kinds(row) != _kinds(rows[0])):
                raise InputError(
                    f"{file}: is not the row of episode {episode} of '{job.setting.label}'; "
                    "delete it and continue with --resume"
                )
            rows.append(row)
    return rows


def _is_whole(row: Row) -> bool:
    """Whether a row has what every row has, texts and numbers, with rates as 0 or 1."""
    rates = [row.get(name, 0) for name in RATES]
    texts = [row.get(name) for name in ("case", "outcome")]
    return (
        object not in _kinds(row).values()
        and all(type(rate) in (int, float) and rate in (0, 1) for rate in rates)
        and all(isinstance(text, str) for text in texts)
    )


def _kinds(row: Row) -> dict[str, type]:
    """Text or number, by the name of each value; what is neither is no row's."""
    kinds = {str: str, int: float, float: float, type(None): float}
    return {
        name: object if _is_too_large(value) else kinds.get(type(value), object)
        for name, value in row.items()
    }


def _is_too_large(value: object) -> bool:
    return isinstance(value, int) and abs(value) >= LARGEST_INTEGER


def _is_done(folder: Path, job: Job) -> bool:
    files = (row_file(folder, job.setting, job.first + i) for i in range(job.count))
    return all(file.is_file() for file in files)


def _run_block(spec: Experiment, folder: Path, job: Job, progress: Progress = silent) -> list[str]:
    """Run a block; its logs are written first, then each episode's row, whole or not at all.

    An exception in simulation is written, see `Failure`. Returns what it warned the user of.
    """
    failed = failure_file(folder, job.setting, job.first)
    with warnings.catch_warnings(record=True) as found:
        try:
            block = roll_out_block(spec, job.setting, job.first, job.count, progress)
        except Exception as error:
            if _may_be_real(spec, job.setting.case):
                raise
            failed.parent.mkdir(exist_ok=True)
            text = f"{_failed(job, error)}\n\n{traceback.format_exc()}"
            write_atomically(failed, text.encode())
            return []
    failed.unlink(missing_ok=True)
    for number, log in block.logs.items():
        save_episode(log, log_file(folder, job.setting.label, number))
    for row in block.rows:
        write_json(row_file(folder, job.setting, row["episode"]), row)
    for one in found:
        if one.category is not UserWarning:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return [str(one.message) for one in found if one.category is UserWarning]


def _failed(job: Job, error: Exception) -> str:
    """Setting, episodes and exception of a block that failed, in one line."""
    last = job.first + job.count - 1
    episodes = f"episode {job.first}" if job.count == 1 else f"episodes {job.first} to {last}"
    name = f"setting '{job.setting.label}', {episodes}"
    if isinstance(error, InputError):
        return f"{name}: {error}"
    return str(raised_by(name, error, "code"))


def _may_be_real(spec: Experiment, case: Case) -> bool:
    """Whether a rig of a case may be a real one."""
    if case.plant != "rig":
        return False
    texts = rigs_by_arm(case.rigs, spec.of.agents).values()
    return any(map(may_be_real, texts))


def _run_missing(spec: Experiment, folder: Path, job: Job) -> list[str]:
    """Run a block unless it is done: a cluster asks again where a worker died with its result."""
    return [] if _is_done(folder, job) else _run_block(spec, folder, job)


def _in_processes(
    spec: Experiment, folder: Path, left: list[Job], processes: int, cluster: str | None
) -> Iterator[tuple[Job, list[str]]]:
    """Run the blocks in worker processes; yields each block as it is done, and its warnings."""
    try:
        prepare = partial(name_code, named_code())
        with workers(processes, prepare, cluster) as pool:
            waiting = {pool.submit(_run_missing, spec, folder, job): job for job in left}
            for future in as_completed(waiting):
                yield waiting[future], future.result()
    except BrokenProcessPool:
        raise InputError(
            f"one of {processes} processes was killed, perhaps for lack of memory; continue with "
            "--resume and fewer --processes"
        ) from None


@lru_cache(maxsize=1)
def opened(spec: Experiment, setting: Setting) -> tuple[PhasedTask, PhaseControllers]:
    """The task of a setting and its controllers; the last one is cached."""
    task = build_task(spec, setting)
    return task, PhaseControllers(spec, task, setting.case.policy)


def roll_out_block(
    spec: Experiment,
    setting: Setting,
    first: int,
    count: int,
    progress: Progress = silent,
) -> Block:
    """Roll out episodes `first` to `first + count - 1` of a setting."""
    task, controllers = opened(spec, setting)
    checks = ExactChecks(task) if has_obstacles(task) else None
    recorders = EpisodeRecorders(task, setting.case.policy, spec.seed, setting.case.plant)

    def watch(now: Instant) -> None:
        if checks is not None:
            checks(now)
        recorders(now)

    try:
        with at_benches(task):
            result = rollout(task, controllers, count, spec.seed, count, progress, watch, first)
    finally:
        if real_benches(task):  # they are closed now: the next block opens them anew
            opened.cache_clear()
    rows = _rows(task, setting, first, result, None if checks is None else checks.checks())
    worst = max(rows, key=spec.of.experiment.badness)["episode"]
    kept = {0, worst} & {row["episode"] for row in rows}
    logs = {n: with_phase_events(task.experiment, recorders.log(n)) for n in sorted(kept)}
    return Block(rows, logs)


def _rows(
    task: PhasedTask,
    setting: Setting,
    first: int,
    result: Rollout,
    checks: list[EpisodeCheck] | None,
) -> list[Row]:
    table = episode_table(task, result, checks)
    for name in DROPPED:
        table.pop(name, None)
    table |= _timings(task, result)
    about: Row = {"setting": setting.label, "case": setting.case.name}
    about |= {"lesion": setting.lesion.name} if setting.lesion else {}
    about |= {vary.field: None for vary in task.experiment.vary} | setting.columns
    outcomes = _outcomes(task, result, checks)
    return [
        about
        | {"episode": first + i, "outcome": outcomes[i]}
        | {name: json_safe(float(values[i])) for name, values in table.items()}
        for i in range(result.episodes)
    ]


def _timings(task: PhasedTask, result: Rollout) -> dict[str, np.ndarray]:
    """How long each phase took, the beam was on, and was on at the end of an unsafe step, s."""
    after = result.measures["phase"]
    # A measure is of the state after its step, which ran in the phase before.
    before = torch.cat([torch.zeros_like(after[:, :1]), after[:, :-1]], 1)
    steps = before.masked_fill(after.isnan(), torch.nan)
    found = {
        f"{phase.name}_s": (steps == number).sum(1) * task.dt_s
        for number, phase in enumerate(task.phases)
    }
    found["beam_s"] = result.measures["beam"].nansum(1) * task.dt_s
    unsafe = result.measures["beam_unsafe"].nan_to_num(0.0) > 0.0
    found["beam_unsafe_longest_s"] = _longest(unsafe) * task.dt_s
    return {name: value.double().cpu().numpy() for name, value in found.items()}


def _longest(on: Tensor) -> Tensor:
    """(N,) int64: the most steps in a row that (N, T) bool holds."""
    best = run = on.new_zeros(len(on)).long()
    for column in on.T:
        run = (run + 1) * column
        best = best.maximum(run)
    return best


def _outcomes(task: PhasedTask, result: Rollout, checks: list[EpisodeCheck] | None) -> list[str]:
    """How each episode ended, in words."""
    reason, where = result.end("reason").tolist(), result.end("reason_phase").tolist()
    late = result.end("late_phase").tolist()
    names, found = [phase.name for phase in task.phases], []
    for i in range(result.episodes):
        contact = None if checks is None else checks[i].contact
        if contact is not None:
            found.append(f"contact of {contact.between[0]}, {contact.between[1]}")
        elif result.failed[i]:
            found.append("an arm is no longer finite")
        elif reason[i]:
            found.append(f"aborted in {names[int(where[i])]}: {REASONS[int(reason[i])]}")
        else:
            how = DONE if result.terminated[i] else TIME_OUT
            after = f"; {names[int(late[i]) - 1]} took too long" if late[i] else ""
            found.append(how + after)
    return found
