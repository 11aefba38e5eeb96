"""Predict a recording with an exported model around your own Python callable.

    surgisoft amend my_arm.py:arm --effect payload --data bench.csv -o amended
    surgisoft export amended --model-code my_arm.py:arm -o arm
    python exported_callable.py arm bench.csv [rows]

It needs NumPy, arm/arm.py and my_arm.py (in the current folder, or beside arm.py); surgisoft is
not needed. rows: how many rows of its past a callable of whole runs is given; default: all.
"""

import csv
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np

folder = Path(sys.argv[1])
about = json.loads((folder / "arm.json").read_text())
spec = importlib.util.spec_from_file_location("arm", folder / "arm.py")
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
arm = module.Arm(keep_rows=int(sys.argv[3]) if sys.argv[3:] else None)

rows = list(csv.DictReader(Path(sys.argv[2]).read_text().splitlines()))
pressure = np.array([[float(row[name]) for name in about["recording_columns"]] for row in rows])
time = np.array([float(row["t_s"]) for row in rows])
warm = np.array([float(row.get("temp_C") or "nan") for row in rows])
run = np.array([int(row.get("run") or 0) for row in rows])
begins = np.diff(run, prepend=run[0] - 1) != 0  # each run starts anew, at its own first row
steps = np.where(begins, 0.0, np.diff(time, prepend=time[0]))

for now, dt, temperature, begin, since in zip(pressure, steps, warm, begins, time, strict=True):
    if begin:
        state = arm.start(now[None], elapsed_s=since)  # for a drift: the recording's own time
    state, points = arm.step(state, now[None], dt, temperature)
    print(",".join(f"{value:.9f}" for value in points.ravel()))
