"""The rig that docs/rigs.md writes runs as it stands there."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from surgisoft import collect
from surgisoft.cli import run
from surgisoft.measurement.recordings import load_recording
from surgisoft.rig import open_rig
from surgisoft.rig.interface import is_simulated

PAGE = Path(__file__).resolve().parents[2] / "docs" / "rigs.md"
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
    (tmp_path / "our_arm.py").write_text(simulator())
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


def simulator():
    """The source of the simulator of the documentation."""
    text = PAGE.read_text()
    (source,) = re.findall(r"```python\n(\"\"\"A simulated arm of our own.*?)```", text, re.DOTALL)
    return source


@pytest.mark.parametrize("name", ["Simulator", "opened"])
def test_collect_treats_the_simulator_as_a_simulated_rig(name, tmp_path, monkeypatch, capsys):
    """A class, or a function of which that is known only once it is open."""
    source = simulator() + "\n\ndef opened(seed: int = 0):\n    return Simulator(seed)\n"
    monkeypatch.chdir(tmp_path)
    Path("our_arm.py").write_text(source)
    rig = f"our_arm.py:{name}"
    collect = ["collect", "walk", "--points", "20", "--rig", rig, "-o", "r.csv"]
    assert run([*collect, "--preflight", "--arm", "default"]) == 2
    assert capsys.readouterr().err.endswith("real rigs, and this one is simulated\n")
    Path("steps.csv").write_text("t_s,c1_ml,c2_ml\n0,0,0\n1,2,8\n2,2,8\n")
    assert run(["collect", "steps.csv", "--rig", rig, "-o", "r.csv"]) == 0
    printed = capsys.readouterr()
    assert "emergency stop" not in printed.err
    assert printed.out.startswith("wrote r.csv: ")
    assert not Path("r.log.jsonl").exists()
    assert run(["collect", "steps.csv", "--rig", rig, "-o", "x.csv", "--dry-run"]) == 2
    assert capsys.readouterr().err.endswith("is for real rigs, and this one is simulated\n")


def test_a_recording_of_the_simulator_leaves_the_log_of_a_real_rig(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("our_arm.py").write_text(simulator())
    Path("steps.csv").write_text("t_s,c1_ml,c2_ml\n0,0,0\n1,2,8\n2,2,8\n")
    Path("r.log.jsonl").write_text("what was measured until then")
    assert run(["collect", "steps.csv", "--rig", "our_arm.py:Simulator", "-o", "r.csv"]) == 0
    assert Path("r.log.jsonl").read_text() == "what was measured until then"


def test_the_seed_in_the_text_of_an_own_rig_is_that_of_the_random_schedule(tmp_path):
    (tmp_path / "our_arm.py").write_text(simulator().replace('"ml"', '"kPa"'))
    rig = f"{tmp_path / 'our_arm.py'}:Simulator"
    beside = collect("walk", rig, seed=3, points=40)
    inside = collect("walk", f"{rig}:seed=3", points=40)
    other = collect("walk", rig, points=40)
    np.testing.assert_array_equal(inside.commanded, beside.commanded)
    assert not np.array_equal(other.commanded, beside.commanded)


def test_the_rig_of_the_documentation_runs(tmp_path, monkeypatch):
    text = PAGE.read_text()
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
