"""Cases in folders: robots with recordings before a change, and recordings after it.

A folder of a source holds, for each case, `after/*.parquet` and `truth.json` (robot, hidden
effects, the names that a diagnosis should give, RMS change of the key points in mm; on a real arm
`same_rows`: whether the same rows are in `before`, so that the paired difference shows the change
alone), and for each robot `before/*.parquet` and optionally `model/`, in `ROBOT` or
`robots/ROBOT`. One model is fitted for each robot to its recordings before the change, unless it is
there already; `fit` in the robot's `robot.json` may state its budget (fields of `FitConfig`). The
question is what has changed since: the recordings before the change are given to the diagnosis too.

Where the truth is all that a model lacks, each robot gives two cases more, of a model that is off:
its first unchanged recording is asked of a model that was fitted for a few epochs, and of the model
of another robot of the same build. There the recordings before the change are not given.
"""

import json
import time
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.decision.evidence_log import (
    PRIOR,
    Label,
    Labelled,
    Models,
    append,
    is_stored,
    posed_on,
    read,
    with_twins,
    without_truth,
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
FEW_EPOCHS = 10
"""Epochs of a model that is undertrained, as those of the own rig are."""
OTHER = "unknown"
"""Name in `truth` of an effect that a diagnosis has no name for."""


def robot_folder(folder: Path, robot: str) -> Path:
    """The folder of a robot."""
    for place in (folder / "robots" / robot, folder / robot):
        if (place / "before").is_dir():
            return place
    raise InputError(f"{folder}: no recordings before the change of robot '{robot}'")


def model_folder(
    folder: Path, robot: str, work: Path, undertrained: bool = False, models: Models = "default"
) -> Path:
    """The fitted model of a robot; it is fitted at the first call.

    A model that the cases were made with, a network alone, is taken where networks alone are asked.
    """
    place = robot_folder(folder, robot)
    if (place / "model" / "config.json").is_file() and not undertrained and models == "alone":
        return place / "model"
    own = work / f"{folder.name}-{robot}-{models}{'-undertrained' if undertrained else ''}"
    if not (own / "config.json").is_file():
        about = place / "robot.json"
        budget = json.loads(about.read_text()).get("fit", {}) if about.is_file() else {}
        few = {"epochs": FEW_EPOCHS} if undertrained else {}
        how = {"effects": FIT_EFFECTS} | budget | few
        result = fit(place / "before", prior=PRIOR[models], **how)
        own.parent.mkdir(parents=True, exist_ok=True)
        save_model(result.model, own, result.report(), force=True, known=result.known)
    return own


def run_case(
    source: str,
    folder: Path,
    truth_file: Path,
    work: Path,
    twin: bool = False,
    models: Models = "default",
) -> list[Labelled]:
    """The evidence of one case; twin: and of it without its truth among the candidates."""
    torch.set_num_threads(1)
    truth = json.loads(truth_file.read_text())
    model = load_model(model_folder(folder, truth["robot"], work, models=models))
    recordings = load_recordings(truth_file.parent / "after")
    before = load_recordings(robot_folder(folder, truth["robot"]) / "before")
    begin = time.process_time()
    posed = posed_on(model, recordings, before=before)
    evidence = posed.evidence()
    seconds = time.process_time() - begin
    named = tuple(truth["truth"])
    label: Label = "clean"
    if named:
        label = "unknown" if OTHER in named else "known"
    hidden = tuple(each["effect"] for each in truth["hidden"])
    moving = [r for r in recordings if r.kind == "continuous"]
    minutes = sum(float(r.t_s[run][-1] - r.t_s[run][0]) for r in moving for run in r.runs) / 60.0
    one = Labelled(
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
        models=models,
    )
    left_out = without_truth(one, posed) if twin else None
    return [one] if left_out is None else [one, left_out]


def run_off(source: str, folder: Path, clean: Labelled, asked: str | None, work: Path) -> Labelled:
    """The evidence of an unchanged recording and a model that is off.

    asked: the robot whose model is asked; None: the recorded one's, undertrained.
    """
    torch.set_num_threads(1)
    robot = asked or clean.robot
    asked_of = model_folder(folder, robot, work, undertrained=asked is None, models=clean.models)
    model = load_model(asked_of)
    recordings = load_recordings(folder / clean.case / "after")
    begin = time.process_time()
    evidence = posed_on(model, recordings).evidence()
    return replace(
        clean,
        source=source,
        case=f"{clean.case}/{'undertrained' if asked is None else f'model-{asked}'}",
        label="network" if asked is None else "other_robot",
        validated_mm=model.validation.rmse_mm,
        evidence=evidence,
        seconds=time.process_time() - begin,
    )


def models_that_are_off(folder: Path, done: list[Labelled], work: Path) -> list[tuple]:
    """(unchanged case, robot whose model is asked or None) of each robot of a source."""
    clean = [one for one in done if one.label == "clean" and one.complete]
    robots = sorted({one.robot for one in done})
    answer: list[tuple] = []
    for robot in robots:
        first = min((o for o in clean if o.robot == robot), key=lambda o: o.case, default=None)
        if first is None:
            continue
        answer.append((first, None))
        own = load_model(model_folder(folder, robot, work, models=first.models)).spec
        for other in [one for one in robots if one != robot]:
            spec = load_model(model_folder(folder, other, work, models=first.models)).spec
            if (spec.chambers, spec.key_points) == (own.chambers, own.key_points):
                answer.append((first, other))
                break
    return answer


def run(
    source: str,
    folder: Path,
    work: Path,
    log: Path,
    processes: int,
    report: Progress,
    off: bool = True,
    twins: bool = False,
    models: Models = "default",
) -> list[Labelled]:
    """Collect the evidence of all cases of a folder; those that the log has are not repeated.

    off: whether models that are off give cases too; twins: whether every case of a known effect
    gives one more, without its truth among the candidates.
    """
    done = {one.case: one for one in read(log)}
    files = sorted(folder.glob("**/truth.json"))
    names = {path: str(path.parent.relative_to(folder)) for path in files}
    robots = sorted({json.loads(path.read_text())["robot"] for path in files})
    with workers(processes) as pool:
        for job in [
            pool.submit(model_folder, folder, robot, work, models=models) for robot in robots
        ]:
            job.result()
        missing = [path for path in files if not is_stored(done, names[path], twins)]
        jobs = [
            pool.submit(run_case, source, folder, path, work, twins, models) for path in missing
        ]
        for number, job in enumerate(as_completed(jobs)):
            some = job.result()
            append(log, *some)
            done |= {one.case: one for one in some}
            report(number + 1, len(missing), f"{source}: {len(done)} cases")
    answer = with_twins(done, [names[path] for path in files], twins)
    for clean, asked in models_that_are_off(folder, answer, work) if off else []:
        name = f"{clean.case}/{'undertrained' if asked is None else f'model-{asked}'}"
        if name not in done:
            done[name] = run_off(source, folder, clean, asked, work)
            append(log, done[name])
        answer.append(done[name])
    return answer
