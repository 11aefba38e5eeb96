"""Error of fitted models on motions that are unlike those of their fit.

    python -m benchmarks.new_motions lattice=FOLDER mujoco=FOLDER ... [--robots 800,801]
        [--kinds none,arcs,memory,kernel] [--log FILE]

FOLDER holds the cases of a generator, `benchmarks.NAME_cases`. A model is fitted to the recordings
of each robot before any change, as by `surgisoft fit` with the robot's budget of epochs:

    none      --prior none
    arcs      the default
    memory    --effects hysteresis,line_lag
    kernel    --network kernel

The same robot is then recorded without noise and without any change in the schedules that the cases
after a change have, with draws of their own: `mixed` has the excitation signals of one recording of
the fit, `brisk` has steps, ramps and random walks. The table has RMS distances of predicted from
true key points, mm, beside the error that the fit states (`validated`), and at its end each kind's
error in units of that of `none`, as geometric means over robots. `--log` keeps fits that are done.
"""

import argparse
import importlib
import json
import math
import os
from pathlib import Path

import numpy as np
import torch

from benchmarks.decision.folders import robot_folder
from benchmarks.rig_cases import Generator, after_protocol
from surgisoft.measurement.fitting import fit
from surgisoft.measurement.histories import history_of
from surgisoft.surrogate.model import ArmModel

KINDS: dict[str, dict] = {
    "none": {"prior": "none"},
    "arcs": {},
    "memory": {"effects": ("hysteresis", "line_lag")},
    "kernel": {"network": "kernel"},
}
"""Options of the fits."""
AFTER = ("mixed", "brisk")
"""Schedules that are judged."""


def error_mm(model: ArmModel, generator: Generator, robot: int, after: str) -> float:
    """RMS distance (mm) of predicted from true key points of an unchanged robot."""
    rig = generator.rig(robot, noise=0.0)
    recording, truth = rig.record(after_protocol(generator, rig, robot, after))
    history = history_of([recording], model.spec.actuation)
    with torch.no_grad():
        predicted = history.rows(model.predict(history)).double().numpy()
    return float(np.sqrt(np.nanmean(np.square(predicted - truth.noise_free_mm).sum(axis=2))))


def judged(generator: Generator, folder: Path, robot: int, kind: str) -> dict[str, float]:
    """Errors (mm) of one fit: `validated`, and that on each schedule of AFTER."""
    place = robot_folder(folder, str(robot))
    budget = json.loads((place / "robot.json").read_text()).get("fit", {})
    if kind == "kernel":  # which has no options of its own
        budget = {}
    model = fit(place / "before", **budget | KINDS[kind]).model
    found = {after: error_mm(model, generator, robot, after) for after in AFTER}
    return {"validated": model.validation.rmse_mm or math.nan} | found


def main() -> None:
    """Parse the command line, and print the table."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="+", metavar="NAME=FOLDER")
    parser.add_argument("--robots", help="seeds, with commas; default: all robots of the folder")
    parser.add_argument("--kinds", default=",".join(KINDS), help="fits, with commas")
    parser.add_argument("--log", type=Path, help="JSON of the fits that are done")
    given = parser.parse_args()
    log: dict[str, dict[str, float]] = {}
    if given.log is not None and given.log.is_file():
        log = json.loads(given.log.read_text())
    kinds, columns = given.kinds.split(","), ("validated", *AFTER)
    print("| source | robot |", " | ".join(f"{k}: {c}" for k in kinds for c in columns), "|")
    print("|---|---|" + "---|" * (len(kinds) * len(columns)))
    rows = []
    for source in given.sources:
        name, _, where = source.partition("=")
        generator = importlib.import_module(f"benchmarks.{name}_cases").GENERATOR
        folder = Path(where)
        own = sorted(int(place.name) for place in (folder / "robots").iterdir())
        for robot in map(int, given.robots.split(",")) if given.robots else own:
            found = []
            for kind in kinds:
                key = f"{name}/{robot}/{kind}"
                log[key] = log.get(key) or judged(generator, folder, robot, kind)
                found.append([log[key][column] for column in columns])
                if given.log is not None:
                    given.log.write_text(json.dumps(log, indent=1))
            rows.append(found)
            cells = " | ".join(f"{value:.2f}" for each in found for value in each)
            print(f"| {name} | {robot} | {cells} |", flush=True)
    errors = np.log(np.array(rows))  # (robots, kinds, columns)
    ratios = np.exp((errors - errors[:, :1]).mean(axis=0))
    cells = " | ".join(f"{value:.2f}" for each in ratios for value in each)
    print(f"| in units of {kinds[0]} | {len(rows)} robots | {cells} |")


if __name__ == "__main__":
    main()
