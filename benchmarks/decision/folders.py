"""Cases in folders: robots with recordings before a change, and recordings after it.

A folder of a source holds, for each case, `after/*.parquet` and `truth.json` (robot, hidden
effects, the names that a diagnosis should give, RMS change of the key points in mm; on a real arm
`same_rows`: whether the same rows are in `before`, so that the paired difference shows the change
alone), and for each robot `before/*.parquet` and optionally `model/`, in `ROBOT` or
`robots/ROBOT`. One model is fitted for each robot to its recordings before the change, unless it is
there already. The question is what has changed since: the recordings before the change are given to
the diagnosis too.
"""

import json
import time
from concurrent.futures import as_completed
from pathlib import Path

import torch

from benchmarks.decision.evidence_log import (
    Label,
    Labelled,
    append,
    evidence_on,
    read,
)
from benchmarks.diagnosis.cases import MEMORY
from surgisoft.errors import InputError
from surgisoft.measurement.fitting import fit
from surgisoft.measurement.recordings import load_recordings
from surgisoft.progress import Progress
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.workers import workers

FIT_EFFECTS = ("hysteresis",)
"""Effects that a model of a source without models of its own is fitted with, as the robots of the
benchmark `diagnosis` are."""
OTHER = "unknown"
"""Name in `truth` of an effect that a diagnosis has no name for."""


def robot_folder(folder: Path, robot: str) -> Path:
    """The folder of a robot."""
    for place in (folder / "robots" / robot, folder / robot):
        if (place / "before").is_dir():
            return place
    raise InputError(f"{folder}: no recordings before the change of robot '{robot}'")


def model_folder(folder: Path, robot: str, work: Path) -> Path:
    """The fitted model of a robot; it is fitted at the first call."""
    place = robot_folder(folder, robot)
    if (place / "model" / "config.json").is_file():
        return place / "model"
    own = work / f"{folder.name}-{robot}"
    if not (own / "config.json").is_file():
        result = fit(place / "before", effects=FIT_EFFECTS)
        own.parent.mkdir(parents=True, exist_ok=True)
        save_model(result.model, own, result.report(), force=True, known=result.known)
    return own


def run_case(source: str, folder: Path, truth_file: Path, work: Path) -> Labelled:
    """The evidence of one case."""
    torch.set_num_threads(1)
    truth = json.loads(truth_file.read_text())
    model = load_model(model_folder(folder, truth["robot"], work))
    recordings = load_recordings(truth_file.parent / "after")
    before = load_recordings(robot_folder(folder, truth["robot"]) / "before")
    begin = time.process_time()
    evidence = evidence_on(model, recordings, before=before)
    seconds = time.process_time() - begin
    named = tuple(truth["truth"])
    label: Label = "clean"
    if named:
        label = "unknown" if OTHER in named else "known"
    hidden = tuple(each["effect"] for each in truth["hidden"])
    moving = [r for r in recordings if r.kind == "continuous"]
    minutes = sum(float(r.t_s[run][-1] - r.t_s[run][0]) for r in moving for run in r.runs) / 60.0
    return Labelled(
        source=source,
        robot=truth["robot"],
        case=str(truth_file.parent.relative_to(folder)),
        label=label,
        truth=hidden if label == "unknown" else named,
        memory=bool(named) and all(name in MEMORY for name in named),
        effect_mm=truth["change_rms_mm"],
        validated_mm=model.validation.rmse_mm,
        minutes=minutes,
        evidence=evidence,
        seconds=seconds,
        complete=bool(truth.get("same_rows", True)),
    )


def run(
    source: str, folder: Path, work: Path, log: Path, processes: int, report: Progress
) -> list[Labelled]:
    """Collect the evidence of all cases of a folder; those that the log has are not repeated."""
    done = {one.case: one for one in read(log)}
    files = sorted(folder.glob("**/truth.json"))
    names = {path: str(path.parent.relative_to(folder)) for path in files}
    robots = sorted({json.loads(path.read_text())["robot"] for path in files})
    with workers(processes) as pool:
        for job in [pool.submit(model_folder, folder, robot, work) for robot in robots]:
            job.result()
        missing = [path for path in files if names[path] not in done]
        jobs = [pool.submit(run_case, source, folder, path, work) for path in missing]
        for number, job in enumerate(as_completed(jobs)):
            one = job.result()
            append(log, one)
            done[one.case] = one
            report(number + 1, len(missing), f"{source}: {len(done)} cases")
    return [done[names[path]] for path in files]
