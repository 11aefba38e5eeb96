"""Models of other origin on the command line: callables and files of predictions."""

import json
import sys

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.diagnosis.other_models import open_model
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import load_recording, save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.callables import named
from tests.replay.reading import entities
from tests.test_your_model import blocks


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """The documentation's callables, a recording with a payload, and predictions beside it."""
    folder = tmp_path_factory.mktemp("bench")
    for name, text in blocks().items():
        if name:
            (folder / name).write_text(text)
    rig = VirtualRig(0, take=7, hidden=(("payload", 1.0),))
    save_recording(
        rig.record(make_protocol("mixed", rig.limits, 400, seed=2))[0], folder / "bench.parquet"
    )
    recording = load_recording(folder / "bench.parquet")
    spec: dict = {}
    exec((folder / "my_arm.py").read_text(), spec)
    points = spec["arm"](recording.t_s, recording.measured)
    header = ",".join(f"k{k}_{axis}_mm" for k in range(5) for axis in "xyz")
    for file, rows in (("lab.csv", points), ("short.csv", points[5:]), ("few.csv", points[:, 1:])):
        some = ",".join(header.split(",")[: rows.shape[1] * 3])
        flat = rows.reshape(len(rows), -1)
        np.savetxt(folder / file, flat, delimiter=",", header=some, comments="")
    (folder / "bad.py").write_text(
        "import numpy as np\n"
        "def raises(t, u):\n    raise ValueError('mesh is missing')\n"
        "def flat(t, u):\n    return np.zeros((len(u), 3))\n"
        "def nan(t, u):\n    return np.full((len(u), 5, 3), np.nan)\n"
        "def four(t, u):\n    return np.zeros((len(u), 4, 3))\n"
    )
    return folder


@pytest.fixture(autouse=True)
def _on_the_bench(bench, monkeypatch):
    monkeypatch.setattr(named, "NAMED", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(bench)


BAD = {
    "compare bad.py:raises bench.parquet": "raised ValueError in bad.py line 3: mesh is missing",
    "diagnose bad.py:flat bench.parquet": "returned shape (1, 3), expected (1, n, 3)",
    "compare bad.py:nan bench.parquet": "are not finite",
    "compare bad.py:four bench.parquet": "key points: 5, but the model has 4",
    "compare bad.py:none bench.parquet": "there is no 'none'",
    "diagnose nowhere.model:arm bench.parquet": "cannot be imported",
    "compare nowhere bench.parquet": "no arm model there",
    "compare lab bench.parquet --predictions short.csv": "395 rows",
    "compare lab bench.parquet --predictions few.csv": "4 key points, expected 5",
    "compare lab bench.parquet --predictions lab.csv lab.csv": "2 files of predictions for 1",
    "compare lab bench.parquet --predictions no.csv": "no such file",
    "compare default bench.parquet --predictions lab.csv": "takes the place of one",
    "compare default bench.parquet --model-error 0.5": "only with a callable",
    "compare my_arm.py:arm bench.parquet --model-error -1": "more than 0 mm",
    "amend lab.csv --effect creep --data bench.parquet -o new": "cannot be amended",
    "next-experiment lab.csv -o new.csv": "predictions are given without recordings",
    "amend my_arm.py:arm --effect creep --data bench.parquet -o new --refit always": "no network",
    "train --task track_circle --arm bad.py:flat -o new": "does not state its range",
}
"""Bad input, and what the one line says."""


@pytest.mark.parametrize("command", BAD)
def test_bad_input_is_one_line(command, bench, capsys):
    before = {path.name for path in bench.iterdir()}
    assert run(command.split()) == 2
    error = capsys.readouterr().err
    assert BAD[command] in error
    assert len([line for line in error.splitlines() if "error:" in line]) == 1
    assert {path.name for path in bench.iterdir()} - {"__pycache__"} == before - {"__pycache__"}


def test_a_callable_and_its_predictions_give_one_comparison(capsys, tmp_path):
    """RMSE as NumPy computes it; the predictions as a name with a file, or as the model itself."""
    recording = load_recording("bench.parquet")
    points = np.loadtxt("lab.csv", delimiter=",", skiprows=1).reshape(recording.samples, 5, 3)
    square = np.square(recording.key_points_mm - points).sum(-1)
    truth = float(np.sqrt(np.nanmean(square)))
    told = []
    for model, more in (
        ("my_arm.py:arm", ""),
        ("lab", "--predictions lab.csv --model-error 1.5"),
    ):
        file = tmp_path / f"{len(told)}.json"
        view = tmp_path / "view.rrd"
        command = f"compare {model} bench.parquet --json {file} --replay {view} {more}"
        assert run(command.split()) == 0
        assert view.stat().st_size > 10_000
        found = json.loads(file.read_text())
        assert found["rmse_mm"] == pytest.approx(truth, abs=1e-5)
        told.append(found["axes"][0]["axis"])
        printed = capsys.readouterr().out
        assert f"surgisoft diagnose {model} bench.parquet {more}".strip() in printed
    assert told[0] == told[1]
    short = open_model("lab.csv", "bench.parquet")
    np.testing.assert_array_equal(short.recordings[0].predicted_mm, points)
    assert short.model.network.name == "lab"


def test_an_amended_callable_is_a_model_folder(capsys, tmp_path):
    """Written, refused without the callable's name, then compared and trained on."""
    new = tmp_path / "amended"
    amend = f"amend my_arm.py:arm --effect payload --data bench.parquet -o {new} --anyway"
    assert run([*amend.split(), "--replay", str(tmp_path / "both.rrd")]) in (0, 1)
    assert {"/model1", "/model2"} <= {
        "/" + name.split("/")[1] for name in entities(tmp_path / "both.rrd")
    }
    assert "--model-code my_arm.py:arm" in capsys.readouterr().out
    named.NAMED.clear()
    train = f"train --task track_circle --arm {new} --envs 8 --steps 64 -o {tmp_path / 'run'}"
    assert run(train.split()) == 2
    assert "its model is code, my_arm.py:arm" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    code = ["--model-code", "my_arm.py:arm"]
    assert run([*train.split(), *code]) == 0
    evaluate = f"evaluate {tmp_path / 'run'} --episodes 1".split()
    named.NAMED.clear()
    assert run(evaluate) == 2
    assert run([*evaluate, *code]) == 0
    assert run([*f"compare {new} bench.parquet".split(), *code]) == 0
