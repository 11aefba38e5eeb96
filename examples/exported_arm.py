"""Predict a recording with an exported arm model; surgisoft is not needed.

surgisoft export default -o arm; python exported_arm.py arm bench.csv [onnxruntime|torch|onnx]
"""

import csv
import json
import sys
from pathlib import Path

import numpy as np


def functions(folder, about, engine):
    """(start, step): functions of float64 arrays."""
    if engine == "torch":
        import torch

        arm = torch.jit.load(folder / about["torchscript"])
        calls = (lambda pressure: (arm.start(pressure),), arm.step)
        return [lambda *x, call=call: call(*map(torch.as_tensor, x)) for call in calls]
    if engine == "onnxruntime":
        from onnxruntime import InferenceSession as Session
    else:
        from onnx.reference import ReferenceEvaluator as Session
    files = {part["onnx"]: part["inputs"] for part in (about["start"], about["step"])}
    found = [(Session(str(folder / file)), names) for file, names in files.items()]
    return [lambda *x, s=s, n=n: s.run(None, dict(zip(n, x, strict=True))) for s, n in found]


folder = Path(sys.argv[1])
about = json.loads((folder / "arm.json").read_text())
start, step = functions(folder, about, (sys.argv[3:] or ["onnxruntime"])[0])
rows = list(csv.DictReader(Path(sys.argv[2]).read_text().splitlines()))
pressure = np.array([[float(row[name]) for name in about["recording_columns"]] for row in rows])
time = np.array([float(row["t_s"]) for row in rows])
run = np.array([int(row.get("run") or 0) for row in rows])
begins = np.diff(run, prepend=run[0] - 1) != 0  # each run starts anew, at its own first row
warm = np.array([float(row.get("temp_C") or "nan") for row in rows])
steps = np.where(begins, 0.0, np.diff(time, prepend=time[0]))
for now, dt, temperature, begin, since in zip(pressure, steps, warm, begins, time, strict=True):
    if begin:
        state = np.asarray(start(now[None])[0]).copy()
        state[:, about["state"].get("elapsed", [])] = since  # for a drift: the recording's own time
    warmth = [np.array([temperature])] * ("temperature_C" in about["step"]["inputs"])
    state, points = step(state, now[None], np.array([dt]), *warmth)
    print(",".join(f"{value:.9f}" for value in np.asarray(points).ravel()))
