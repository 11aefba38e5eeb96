"""The rig that docs/rigs.md writes runs as it stands there."""

import re
import sys
from pathlib import Path

import numpy as np

from surgisoft.cli import run
from surgisoft.measurement.recordings import load_recording
from surgisoft.rig import open_rig
from surgisoft.rig.interface import is_simulated

DEVICES = """
import time
import numpy as np
REST_S = 0.0
set_points = []
def set_regulators(values):
    set_points.append(np.array(values, float))
def read_sensors():
    return set_points[-1] + 0.25
def wait_for_picture(seconds):
    time.sleep(0.001)
    x, y = set_points[-1]
    return np.array([[0, 0, 0], [x / 4, y / 4, 45], [x, y, 90.0]])
"""


def test_the_simulator_of_the_documentation_is_a_simulated_rig(tmp_path):
    """Behind a step of 10 ml its volume is 10 (1 - e^(-t / 0.2 s)), and its tip 3 mm per ml."""
    text = Path("docs/rigs.md").read_text()
    (source,) = re.findall(r"```python\n(\"\"\"A simulated arm of our own.*?)```", text, re.DOTALL)
    (tmp_path / "our_arm.py").write_text(source)
    rig = open_rig(f"{tmp_path / 'our_arm.py'}:Simulator:noise_mm=0.02")
    assert is_simulated(rig)
    rig.reset()
    rig.command(np.array([10.0, 0.0]))
    found = [rig.read_beside_truth() for _ in range(40)]
    volume = 10 * (1 - np.exp(-0.05 * np.arange(1, 41) / 0.2))
    tip = np.array([truth.centres_mm[0, -1, 0] for _, truth in found])
    np.testing.assert_allclose([sample.measured[0] for sample, _ in found], volume, atol=1e-9)
    np.testing.assert_allclose(tip, 3 * volume, atol=1e-9)
    seen = np.array([sample.key_points_mm[-1, 0] for sample, _ in found])
    assert 0.01 < np.std(seen - tip) < 0.04


def test_the_rig_of_the_documentation_runs(tmp_path, monkeypatch):
    text = Path("docs/rigs.md").read_text()
    (source,) = re.findall(r"```python\n(\"\"\"A bench of our lab.*?)```", text, re.DOTALL)
    assert source.count("\n") < 55
    (tmp_path / "my_lab_bench.py").write_text(source)
    (tmp_path / "lab_devices.py").write_text(DEVICES)
    (tmp_path / "steps.csv").write_text("t_s,c1_kPa,c2_kPa\n0,0,0\n1,20,8\n2,20,8\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    rig = "my_lab_bench:Bench:rate_Hz=50,rate=400,highest=15"
    assert run(["collect", "steps.csv", "--rig", rig, "-o", "r.parquet"]) == 2, "limit of 15 kPa"
    assert run(["collect", "steps.csv", "--rig", rig.replace("15", "30"), "-o", "r.parquet"]) == 0
    recording = load_recording("r.parquet")
    assert (recording.chambers, recording.key_points, recording.unit) == (2, 3, "kPa")
    np.testing.assert_allclose(recording.measured - recording.commanded, 0.25, atol=1e-9)
    tip = recording.key_points_mm[:, -1]
    np.testing.assert_allclose(tip[:, :2], recording.commanded, atol=1e-9)
    assert tip[-1].tolist() == [20.0, 8.0, 90.0]
    assert sys.modules["lab_devices"].set_points[-1].tolist() == [0.0, 0.0], "left vented"
