"""Exported arm models: the same key points as in Python, read by programs without surgisoft."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx.reference import ReferenceEvaluator
from onnxruntime import InferenceSession

from surgisoft.cli import run as surgisoft
from surgisoft.errors import InputError
from surgisoft.measurement.exporting import export_arm as export_recordings
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate import export as exporting
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.surrogate.effects import EFFECTS, Memoryless, make_effect
from surgisoft.surrogate.effects.base import amplitude
from surgisoft.surrogate.export import FILES, ArmGraph, differences, export_arm
from surgisoft.surrogate.networks import ConstantCurvature, HawNN, KernelArm, RecurrentArm

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("drift", "hysteresis", "misalignment", "stiffening#2", "softening#2", "softening#3")
"""Effects whose amplitudes are angles of the whole body, or many, or that act on the body."""


def small_arm(effects=None):
    """The default arm with a network of 16 neurons, whose key points still move by centimetres."""
    arm = default_arm()
    low, high = torch.tensor(arm.spec.low), torch.tensor(arm.spec.high)
    torch.manual_seed(0)
    network = HawNN(low, high, arm.spec.key_points, (16,))
    network.mean.copy_(arm.rest_mm.flatten())
    network.scale.fill_(30.0)
    return arm.replace(network=network, effects=effects)


def every_effect():
    """Each effect of the package once, and some in other forms; amplitudes that matter."""
    arm = default_arm()
    made = {name: make_effect(name, arm.facts) for name in EFFECTS}
    made["drift#2"] = make_effect("drift", arm.facts, kind="temperature")
    weighs = {"body": "whole", "weight": arm.facts.gravity is not None}
    made["stiffening#2"] = make_effect("stiffening", arm.facts, full=4.0, **weighs)
    made["softening#2"] = make_effect("softening", arm.facts, width=1.0, damage=True, **weighs)
    made["softening#3"] = make_effect("softening", arm.facts, width=1.0, body="apart")
    made["creep#2"] = make_effect("creep", arm.facts, body=True)
    made["hysteresis#2"] = make_effect("hysteresis", arm.facts, radii=(0.1, 0.3), body_rad=2.0)
    made["coupling#2"] = make_effect("coupling", arm.facts, who="beside", power=0.5)
    torch.manual_seed(1)
    for name, effect in made.items():
        for value in effect.amplitudes().values():
            value.data.normal_().mul_(0.02 if name in SMALL else 0.3)
    return made


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A recording of four seconds of a virtual rig, as CSV and in memory."""
    folder = tmp_path_factory.mktemp("bench")
    rig = VirtualRig(0, take=3)
    recording = rig.record(make_protocol("ramps", rig.limits, 80, seed=2))[0]
    save_recording(recording, folder / "bench.csv")
    return folder / "bench.csv", recording


ROWS = ("t_s", "measured", "commanded", "key_points_mm", "run", "temp_C")
"""Fields of a recording with a value for each row."""


def first_rows(recording, count):
    part = {n: getattr(recording, n) for n in ROWS if getattr(recording, n) is not None}
    return replace(recording, **{name: values[:count] for name, values in part.items()})


@pytest.fixture(scope="module")
def two_runs(bench, tmp_path_factory):
    """Its first 30 rows as two runs: the second one begins at another place, without a past.

    The clock goes on for ten minutes between them, and with it a drift.
    """
    begun = first_rows(bench[1], 30)
    run = (np.arange(begun.samples) >= 17).astype(int)
    recording = replace(begun, name="two_runs", run=run, t_s=begun.t_s + 600.0 * run)
    file = tmp_path_factory.mktemp("runs") / "two_runs.csv"
    save_recording(recording, file)
    return file, recording


def _tuple_of(found):
    return found if isinstance(found, tuple) else (found,)


def exact(recording):
    """The history of a recording in double precision."""
    history = history_of([recording])
    return replace(history, pressure=history.pressure.double())


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A model with every effect, and the folder of its files."""
    model = small_arm(every_effect())
    folder = tmp_path_factory.mktemp("exported") / "arm"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "CHECKED", 30)  # the tests step the files through a recording
        assert [file.name for file in export_arm(model, folder)] == list(FILES)
    return model, folder


def test_every_effect_of_the_library_is_exported(exported, bench):
    """Over a whole recording: 1e-5 mm from the model in double precision."""
    model, folder = exported
    about = json.loads((folder / "arm.json").read_text())
    assert set(EFFECTS) < set(about["effects"])
    assert about["step"]["inputs"] == ["state", "pressure", "dt_s", "temperature_C"]
    history = exact(bench[1])
    warm = 20.0 + torch.linspace(0.0, 8.0, history.pressure.shape[1])[None]
    history = replace(history, temperature_C=warm.double())
    expected = model.double().predict(history)[0].detach()
    moved = (expected - expected[0]).norm(dim=2).amax()
    assert moved > 5.0, "an arm that does not move proves nothing"
    script = torch.jit.load(folder / "arm.pt")
    step, start = (InferenceSession(folder / f"arm_{name}.onnx") for name in ("step", "start"))
    state = script.start(history.pressure[0, :1])
    (other,) = start.run(None, {"pressure": history.pressure[0, :1].numpy()})
    dt_s, worst = history.dt_s.double(), 0.0
    for row in range(history.pressure.shape[1]):
        given = [history.pressure[:, row], dt_s[:, row], history.temperature_C[:, row]]
        state, points = script.step(state, *given)
        named = dict(zip(about["step"]["inputs"][1:], (x.numpy() for x in given), strict=True))
        other, again = step.run(None, {"state": other, **named})
        worst = max(worst, float((points[0] - expected[row]).abs().max()))
        worst = max(worst, float(np.abs(again[0] - expected[row].numpy()).max()))
    assert worst < 1e-5


def test_files_are_compared_over_whole_recordings(bench, tmp_path, capsys, monkeypatch):
    """Two runs of different length; steps of another arm would be noticed.

    TorchScript alone: the other file answers as its module does.
    """

    def written(module, example, file, *names, **options):
        file.write_bytes(b"")
        return lambda *given: _tuple_of(module(*given))

    monkeypatch.setattr(exporting, "write_onnx", written)
    recording = bench[1]
    run_of_row = (np.arange(recording.samples) >= 50).astype(recording.run.dtype)
    save_recording(replace(recording, run=run_of_row), tmp_path / "two.csv")
    save_model(small_arm({"hysteresis": every_effect()["hysteresis"]}), tmp_path / "small")
    command = ["export", str(tmp_path / "small"), "--data", str(tmp_path / "two.csv")]
    assert surgisoft([*command, "-o", str(tmp_path / "arm")]) == 0
    assert "two: over 80 rows the files differ from the model by" in capsys.readouterr().out
    found = differences(tmp_path / "arm")["two"]
    assert found["rows"] == 80
    assert 0.0 < found["largest_difference_mm"] < 1e-5
    for place, rows in (("before", 30), ("after", 20)):
        (tmp_path / place).mkdir()
        save_recording(first_rows(recording, rows), tmp_path / place / "bench.csv")
    again = [tmp_path / "before", tmp_path / "after", tmp_path / "two.csv"]
    export_recordings(tmp_path / "small", tmp_path / "again", again)
    rows = {name: found["rows"] for name, found in differences(tmp_path / "again").items()}
    files = [str(tmp_path / place / "bench.csv") for place in ("before", "after")]
    assert rows == {files[0]: 30, files[1]: 20, "two": 80}, "recordings of one name go by path"
    save_recording(replace(recording, unit="psi"), tmp_path / "psi.csv")
    with pytest.raises(InputError, match="psi, but the model has kPa"):
        export_recordings(tmp_path / "small", tmp_path / "new", tmp_path / "psi.csv")


def test_the_step_takes_any_batch_and_the_state_is_what_arm_json_says(exported):
    _, folder = exported
    about = json.loads((folder / "arm.json").read_text())
    rest, parts = np.array(about["rest"]["state"]), about["state"]["parts"]
    assert [part["first"] for part in parts] == [0, *(part["last"] for part in parts[:-1])]
    assert parts[-1]["last"] == about["state"]["size"] == len(rest)
    step = ReferenceEvaluator(str(folder / "arm_step.onnx"))
    pressure = np.array([[30.0, 5.0, 0.0], [0.0, 0.0, 40.0], [10.0, 10.0, 10.0]])
    given = {"dt_s": np.full(3, 0.1), "temperature_C": np.full(3, 25.0)}
    state, points = step.run(None, {"state": np.tile(rest, (3, 1)), "pressure": pressure, **given})
    np.testing.assert_array_equal(state[:, : parts[0]["last"]], pressure)
    for row in range(3):
        single = {name: value[row : row + 1] for name, value in given.items()}
        one = {"state": rest[None], "pressure": pressure[row : row + 1], **single}
        np.testing.assert_allclose(step.run(None, one)[1][0], points[row], atol=1e-9)


def example_of(folder, recording, engine, at) -> subprocess.CompletedProcess:
    """What the example prints without surgisoft and the other engine, run in folder `at`."""
    other = "onnx" if engine == "torch" else "torch"
    blocked = (
        f"import runpy, sys; sys.modules['surgisoft'] = sys.modules['{other}'] = None; "
        "runpy.run_path(sys.argv.pop(1), run_name='__main__')"
    )
    example = ROOT / "examples" / "exported_arm.py"
    return subprocess.run(
        [sys.executable, "-c", blocked, example, folder, recording, engine],
        capture_output=True,
        text=True,
        check=True,
        cwd=at,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
    )


def printed(done) -> np.ndarray:
    """(T, 3 n) mm: the rows that the example printed."""
    return np.array([line.split(",") for line in done.stdout.splitlines()], float)


def predicted(model, recording) -> np.ndarray:
    """(T, 3 n) mm: the model's key points in each row of a recording, in double precision."""
    history = exact(recording)
    return history.rows(model.double().predict(history)).detach().flatten(1).numpy()


@pytest.mark.parametrize("engine", ["torch", "onnx"])
def test_the_example_predicts_a_recording_without_surgisoft(engine, exported, two_runs, tmp_path):
    model, folder = exported
    done = example_of(folder, two_runs[0], engine, tmp_path)
    np.testing.assert_allclose(printed(done), predicted(model, two_runs[1]), atol=1e-5)
    assert "exported_arm.py" not in done.stderr, "a warning of the example"


def test_the_example_predicts_with_a_folder_that_does_not_list_elapsed_time(
    exported, bench, tmp_path
):
    """As earlier versions exported it; a recording that begins at 0 s does not need it."""
    model, folder = exported[0], tmp_path / "earlier"
    shutil.copytree(exported[1], folder)
    about = json.loads((folder / "arm.json").read_text())
    assert about["state"].pop("elapsed")
    (folder / "arm.json").write_text(json.dumps(about))
    few = first_rows(bench[1], 12)
    assert few.t_s[0] == 0.0
    save_recording(few, tmp_path / "few.csv")
    done = example_of(folder, tmp_path / "few.csv", "onnx", tmp_path)
    np.testing.assert_allclose(printed(done), predicted(model, few), atol=1e-5)


def test_networks_whose_program_depends_on_their_parameters_are_graphs(tmp_path):
    model = default_arm()
    low, high = torch.tensor(model.spec.low), torch.tensor(model.spec.high)
    curved = ConstantCurvature(low, high, model.spec.key_points)
    curved.set_rest(model.rest_mm)
    torch.nn.init.normal_(curved.table, std=0.3, generator=torch.Generator().manual_seed(2))
    kernel = KernelArm(low, high, model.spec.key_points, 4, 20, (0.1, 1.0))
    kernel.prior.set_rest(model.rest_mm)
    kernel.places.normal_()
    kernel.weight.data.normal_(0, 10.0)
    for network in (curved, kernel, RecurrentArm(low, high, model.spec.key_points, 8)):
        graph = ArmGraph(model.replace(network=network, effects={}))
        example = tuple(graph.example())
        program = torch.export.export(graph, example, strict=False).module()
        given = (example[0], example[1] + torch.tensor([20.0, 0.0, 5.0]), example[2])
        for mine, theirs in zip(graph(*given), program(*given), strict=True):
            torch.testing.assert_close(mine, theirs, atol=1e-9, rtol=0.0)


class Stuck(Memoryless):
    """An effect that branches on values, which a graph freezes."""

    stage = "material"

    def __init__(self, facts):
        super().__init__(facts)
        self.loss = amplitude(1)

    def amplitudes(self):
        return {"loss": self.loss}

    def apply(self, signal, memory):
        if float(self.load(signal).sum()) > 1.0:
            return signal - self.loss * self.reach
        return signal + 0.0 * self.loss

    def config(self):
        return {}

    def quantities(self):
        return []


def test_a_user_defined_effect_that_does_not_trace_is_refused_by_name(tmp_path):
    arm = default_arm()
    effect = Stuck(arm.facts)
    effect.loss.data.fill_(0.3)
    with pytest.raises(InputError, match=r"effect 'stuck' does not trace; .*torch\.where") as told:
        export_arm(small_arm({"stuck": effect}), tmp_path / "arm")
    assert "\n" not in str(told.value)
    assert not (tmp_path / "arm").exists()


def test_the_command_refuses_what_belongs_to_runs(tmp_path, capsys):
    assert surgisoft(["export", "default", "-o", str(tmp_path / "x"), "--check"]) == 2
    assert "is an arm model" in capsys.readouterr().err
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "mine.txt").write_text("mine")
    assert surgisoft(["export", "default", "-o", str(tmp_path / "x")]) == 2
    assert "already exists" in capsys.readouterr().err
    assert [file.name for file in (tmp_path / "x").iterdir()] == ["mine.txt"]
