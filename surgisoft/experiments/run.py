"""Plays a whole experiment into a folder: block by block, over processes, resumed after a break.

The blocks, not the processes, decide what is computed together; so one process and many, a run in
one go and one that was interrupted give the same rows.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from surgisoft.agents.run_folder import versions
from surgisoft.errors import InputError
from surgisoft.experiments.plan import Setting, scene_of, settings
from surgisoft.experiments.play import Row, opened, play_block
from surgisoft.experiments.spec import FILE, Experiment, load_experiment, save_experiment
from surgisoft.files import write_json
from surgisoft.surrogate.effects import register_effect_files, registered_files
from surgisoft.tasks.episodes.file import save_episode
from surgisoft.workers import workers

Report = Callable[[float, float, str], None]


@dataclass(frozen=True)
class Job:
    """One block of episodes of one setting."""

    setting: Setting
    """The setting."""
    first: int
    """Number of its first episode."""
    count: int
    """Episodes."""


def jobs(spec: Experiment) -> list[Job]:
    """Every block, those of a setting one after the other."""
    return [
        Job(setting, first, min(spec.together, spec.repeats - first))
        for setting in settings(spec)
        for first in range(0, spec.repeats, spec.together)
    ]


def row_file(folder: Path, setting: Setting, episode: int) -> Path:
    """Where an episode's numbers lie."""
    return folder / "rows" / f"{setting.label}-{episode:04d}.json"


def log_file(folder: Path, setting: str, episode: int) -> Path:
    """Where an episode's log lies, if it was kept."""
    return folder / "logs" / f"{setting}-{episode:04d}.npz"


def open_results(spec: Experiment, folder: Path, resume: bool = False, force: bool = False) -> None:
    """Make the folder of results, or check that this experiment goes on in it."""
    there = (folder / FILE).is_file()
    if there and resume and not force:
        if load_experiment(folder / FILE) != spec:
            raise InputError(
                f"{folder}: holds another experiment ({folder / FILE} differs); choose another "
                "folder, or --force to begin anew"
            )
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not there:
            raise InputError(f"{folder}: already there and no results; choose another folder")
        if not force:
            raise InputError(
                f"{folder}: results are already there; --resume goes on, --force begins anew"
            )
    check_playable(spec)
    if force and there:
        shutil.rmtree(folder)
    (folder / "rows").mkdir(parents=True, exist_ok=True)
    scene = scene_of(spec, settings(spec)[0])
    about = {"versions": versions(), "scene_hash": scene.content_hash}
    write_json(folder / "versions.json", about)
    save_experiment(spec, folder / FILE)


def check_playable(spec: Experiment) -> None:
    """Raise unless every lesion lies on the organ and every driver fits its arm.

    In simulation, whatever the case: what a driver sees and moves is the same on the rig.
    """
    found, seen = settings(spec), set()
    for setting in {setting.lesion: setting for setting in found}.values():
        scene_of(spec, setting)
    for setting in found:
        case = setting.case
        if (case.policy, case.arm) not in seen:
            plain = replace(case, plant="simulation", hidden=(), specimen=0)
            opened(spec, replace(setting, case=plain))
            seen.add((case.policy, case.arm))


def run_experiment(
    spec: Experiment, folder: Path, processes: int = 1, report: Report | None = None
) -> list[Row]:
    """Play every block that is not there yet; all rows, in order. See `open_results`."""
    every, told = jobs(spec), report or (lambda done, total, note: None)
    left = [job for job in every if not _is_done(folder, job)]
    total = float(sum(job.count for job in every))
    done = total - sum(job.count for job in left)
    told(done, total, "")
    if processes == 1:
        with _one_thread():
            for job in left:
                began = done

                def within(step, steps, job=job, began=began) -> None:
                    told(began + job.count * step / steps, total, job.setting.words)

                _play(spec, folder, job, within)
                done += job.count
                told(done, total, job.setting.words)
    else:
        for job in _in_processes(spec, folder, left, processes):
            done += job.count
            told(done, total, job.setting.words)
    return [
        json.loads(row_file(folder, job.setting, job.first + i).read_text())
        for job in every
        for i in range(job.count)
    ]


def _is_done(folder: Path, job: Job) -> bool:
    files = (row_file(folder, job.setting, job.first + i) for i in range(job.count))
    return all(file.is_file() for file in files)


def _play(spec: Experiment, folder: Path, job: Job, progress=None) -> None:
    """Play a block; its logs are written first, then each episode's row, whole or not at all."""
    block = play_block(spec, job.setting, job.first, job.count, progress)
    for number, log in block.logs.items():
        save_episode(log, log_file(folder, job.setting.label, number))
    for row in block.rows:
        write_json(row_file(folder, job.setting, row["episode"]), row)


def _in_processes(spec: Experiment, folder: Path, left: list[Job], processes: int) -> Iterator[Job]:
    """Play the blocks in processes of their own; each block as it is done."""
    from concurrent.futures import as_completed
    from concurrent.futures.process import BrokenProcessPool

    try:
        prepare = partial(register_effect_files, registered_files())
        with workers(processes, prepare) as pool:
            waiting = {pool.submit(_play, spec, folder, job): job for job in left}
            for future in as_completed(waiting):
                future.result()
                yield waiting[future]
    except BrokenProcessPool:
        raise InputError(
            f"a process of {processes} was ended from outside, memory may be short; go on with "
            "--resume and fewer --processes"
        ) from None


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """One thread, as in the processes: the order of sums decides about last digits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
