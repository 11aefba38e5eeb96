"""Models of other origin on the command line: callables and files of predictions."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from surgisoft.cli import run
from surgisoft.diagnosis.other_models import open_model
from surgisoft.errors import InputError
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import load_recording, save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.callables import named
from surgisoft.surrogate.checkpoint import load_model, save_model
from tests.cli.test_printed import diagnosis, result
from tests.few_effects import few_effects
from tests.replay.reading import entities
from tests.test_your_model import blocks


@pytest.fixture(scope="module", autouse=True)
def _few_effects():
    with few_effects("creep", "line_lag", "payload"):
        yield


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
    "compare my_arm.py:arm bad.py:flat bench.parquet --model-error 1": "got 2 among 2 models",
    "compare default default bench.parquet --model-error 1": "got 0 among 2 models",
    "amend lab.csv --effect creep --data bench.parquet -o new": "cannot be amended",
    "amend default --effect , --data bench.parquet -o new": "no effect is named to amend the mod",
    "next-experiment default --between , -o new.csv": "--between names no effect",
    "next-experiment lab.csv -o new.csv": "predictions are given without recordings",
    "amend my_arm.py:arm --effect creep --data bench.parquet -o new --refit always": "no network",
    "export my_arm.py:arm -o new --check": "is an arm model; --which and --check are for training",
    "export bad.py:flat -o new": "does not state its range",
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


def test_the_model_error_is_of_the_callable_among_several_models(capsys):
    """It is one model's; a folder has its own, in the next command too."""
    both = ["compare", "default", "my_arm.py:arm", "bench.parquet", "--model-error", "1.25"]
    assert run([*both, "--json", "both.json"]) == 0
    printed = capsys.readouterr().out
    assert run([both[0], *both[2:], "--json", "one.json"]) == 0
    alone = json.loads(Path("one.json").read_text())
    of_default, of_callable = json.loads(Path("both.json").read_text())["models"]
    assert {name: of_callable[name] for name in alone} == alone
    assert of_default["rmse_mm"] < of_callable["rmse_mm"]
    following = printed.splitlines()[-1]
    assert "surgisoft diagnose default bench.parquet" in following
    assert "--model-error" not in following


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


def test_a_callable_arm_of_a_scene_states_its_length(capsys, tmp_path):
    """Without it the message names the attribute; with it the printed next command opens."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    ball.export(tmp_path / "organ.stl")
    text = Path("my_arm.py").read_text()
    assert "length_mm" not in text
    Path("sized.py").write_text(
        text.replace(
            "    static = True", "    length_mm, diameter_mm = 70.0, 15.0\n    static = True"
        )
    )
    for name, code in (("plain", "my_arm.py:arm"), ("arm", "sized.py:arm")):
        named.NAMED.clear()
        save_model(load_model(code), tmp_path / name)
        make = f"scene new {tmp_path}/organ.stl --arms endoscope --arm {tmp_path / name}"
        done = run([*make.split(), "--model-code", code, "-o", str(tmp_path / f"s_{name}")])
        said = capsys.readouterr()
        if name == "plain":
            assert done == 2
            assert "give the object my_arm.py:arm the attribute length_mm (the length" in said.err
            continue
        assert done == 0, said.err
        line = said.out.splitlines()[-1]
        show = line.partition("'surgisoft ")[2].removesuffix("'")
        assert show.endswith(" --model-code sized.py:arm")
        named.NAMED.clear()
        assert run([*show.split(), "--save", str(tmp_path / "view.rrd")]) == 0


def test_what_follows_an_amended_callable_runs_as_it_is_printed(capsys, tmp_path, monkeypatch):
    """The new folder states its validated error, which then is no option of the command."""
    new, other, rec = tmp_path / "amended", tmp_path / "improved", "bench.parquet"
    given = f"--model-error 1.25 --refit never -o {new}"
    amend = f"amend my_arm.py:arm --effect payload --data {rec} --anyway {given}"
    assert run(amend.split()) in (0, 1)
    line = capsys.readouterr().out.splitlines()[-1]
    code = "--model-code my_arm.py:arm"
    assert line.endswith(f": surgisoft diagnose {new} {rec} --refit never {code}")
    named.NAMED.clear()
    assert run(line.partition(": surgisoft ")[2].split()) == 0
    ended = result(
        claimed=True, interrupted=True, rounds=[], steps=[], diagnoses=[], sentence="less",
        model=load_model(new, model_code=["my_arm.py:arm"]),
    )  # fmt: skip
    monkeypatch.setattr("surgisoft.diagnosis.improve.improve", lambda *_, **__: ended)
    improve = f"improve my_arm.py:arm {rec} --model-error 1.25 --refit never -o {other}"
    capsys.readouterr()
    for more, start in (("", other), (f" --before {rec} --force", "my_arm.py:arm")):
        assert run((improve + more).split()) == 130
        line = capsys.readouterr().out.splitlines()[-1]
        words = line.partition(": surgisoft ")[2].split()
        assert words[:3] == ["improve", str(start), rec]
        opened = []

        def keep(model, measured, *_, error_mm=None, kept=opened, **__):
            kept.append(open_model(model, measured, None, None, error_mm))
            raise InputError("opened")

        with monkeypatch.context() as patch:
            patch.setattr("surgisoft.diagnosis.improve.improve", keep)
            assert run(words) == 2
        assert capsys.readouterr().err == "surgisoft: error: opened\n"
        assert opened[0].model.validation.rmse_mm == 1.25, "the folder states it, or the option"


def test_the_comparison_after_an_improvement_keeps_the_error_of_a_callable(
    capsys, tmp_path, monkeypatch
):
    """It opens both models: the callable, whose error is an option, and the folder."""
    rec, other = "bench.parquet", tmp_path / "improved"
    improve = f"improve my_arm.py:arm {rec} --refit never -o {other}"
    ended = result(
        claimed=True, interrupted=False, rounds=[], steps=[], diagnoses=[], sentence="less",
        model=load_model("default"),
    )  # fmt: skip
    monkeypatch.setattr("surgisoft.diagnosis.improve.improve", lambda *_, **__: ended)
    for more, kept in ((" --model-error 1.25", " --model-error 1.25"), (" --force", "")):
        assert run((improve + more).split()) == 0
        line = capsys.readouterr().out.splitlines()[-1]
        test = r"TEST\.parquet( --test)?"
        expected = rf"surgisoft compare my_arm\.py:arm {other} {test}{kept} --report PAGE"
        assert re.search(f": {expected}$", line)


def test_the_page_of_an_improvement_has_the_command_that_is_printed(capsys, tmp_path, monkeypatch):
    """With the error of a callable, which `fit` does not take."""
    nothing = result(
        claimed=False, rounds=[], steps=[], diagnoses=[diagnosis()], sentence="none", model=None
    )  # fmt: skip
    monkeypatch.setattr("surgisoft.diagnosis.improve.improve", lambda *_, **__: nothing)
    monkeypatch.setattr("surgisoft.diagnosis.compare.tables_of", lambda *_: {})
    page = "surgisoft.diagnosis.pages.amendment.write_improve_report"
    monkeypatch.setattr(page, lambda *given: [f"page: {given[-1]}"])
    command = "improve my_arm.py:arm bench.parquet --model-error 1.25"
    for template, expected in (
        ("diagnose {model} {data}", "diagnose my_arm.py:arm bench.parquet --model-error 1.25"),
        ("fit {data} -o NEW", "fit bench.parquet -o NEW"),
    ):
        nothing.diagnoses[0].next_command = f"surgisoft {template}"
        files = f" -o {tmp_path / 'new'} --report {tmp_path / 'page'}"
        assert run((command + files).split()) == 1
        out = capsys.readouterr().out
        assert f"page: surgisoft {expected}\n" in out
        assert out.endswith(f"next: surgisoft {expected}\n")


PLAN, AMEND = "next-experiment MODEL REC --between creep payload", "amend MODEL --data REC"
NEXT = [
    ("lab", "REC --predictions lab.csv --model-error 1.24", PLAN),
    ("lab", "REC --before REC --predictions lab.csv lab.csv --model-error 1.24", PLAN),
    ("lab.csv", "REC", PLAN),
    ("my_arm.py:arm", "REC --model-error 1.24", PLAN),
    ("my_arm.py:arm", "REC --model-error 1.24", AMEND + " --effect payload"),
]
"""Model and options of a diagnosis, and the command that is to be run next."""


@pytest.mark.parametrize(("model", "options", "following"), NEXT)
def test_a_printed_command_opens_the_model_again(model, options, following, capsys, monkeypatch):
    """The command that `diagnose` prints, as it stands, opens the same model and recordings."""
    template = following.replace("MODEL", "{model}").replace("REC", "{data}") + " -o NEW.csv"
    found = diagnosis(next_command=f"surgisoft {template}")
    monkeypatch.setattr("surgisoft.diagnosis.diagnose.diagnose", lambda *_, **__: found)
    rec = "bench.parquet"
    assert run(["diagnose", model, *options.replace("REC", rec).split()]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    made = following.replace("MODEL", model).replace("REC", rec)
    assert line.startswith(f"next: surgisoft {made}")
    opened = []

    def keep(*given, predictions=None, error_mm=None, **_):
        opened.append(open_model(given[0], given[1], None, predictions, error_mm))
        raise InputError("opened")

    monkeypatch.setattr("surgisoft.diagnosis.design.next_experiment.next_experiment", keep)
    monkeypatch.setattr("surgisoft.diagnosis.amend.amend", keep)
    assert run(line.split()[2:]) == 2
    assert capsys.readouterr().err == "surgisoft: error: opened\n"
    (one,) = opened
    assert (one.recordings[0].predicted_mm is not None) == (model in ("lab", "lab.csv"))
    assert one.model.validation.rmse_mm == (1.24 if "--model-error" in options else None)


@pytest.mark.parametrize("model", ["lab.csv", "lab --predictions lab.csv"])
def test_no_command_amends_predictions(model, capsys, monkeypatch):
    """`amend` would refuse them; what to do instead is said. A fit takes no options of a model."""
    name, *rest = model.split()
    found = diagnosis(next_command="surgisoft amend {model} --effect creep --data {data} -o NEW")
    monkeypatch.setattr("surgisoft.diagnosis.diagnose.diagnose", lambda *_, **__: found)
    command = ["diagnose", name, "bench.parquet", *rest, "--model-error", "1.24"]
    assert run(command) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("next: give the model as a callable (docs/your_model.md)")
    assert "surgisoft amend" not in line
    found.next_command = "surgisoft fit {data} -o NEW"
    assert run(command) == 0
    assert capsys.readouterr().out.endswith("next: surgisoft fit bench.parquet -o NEW\n")


def test_after_a_correction_predictions_keep_their_order(capsys, monkeypatch, tmp_path):
    """Files of predictions belong to recordings by order, which is not that of a folder's names."""
    recording = load_recording("bench.parquet")
    two = [replace(recording, name=name) for name in ("second", "first")]
    setup = SimpleNamespace(
        correctable=True, recordings=["second", "first"], instructions="turn it",
        alternative_instructions=(), how_to_tell="", of_model="", corrected=lambda _: two,
    )  # fmt: skip
    found = diagnosis(setup=setup)
    monkeypatch.setattr("surgisoft.diagnosis.diagnose.diagnose", lambda *_, **__: found)
    new, options = tmp_path / "new", "--predictions lab.csv lab.csv"
    for one in two:
        save_recording(one, tmp_path / f"{one.name}.parquet")
    given = " ".join(str(tmp_path / f"{one.name}.parquet") for one in two)
    command = f"diagnose lab {given} {options}".split()
    assert run(command) == 0
    again = f"surgisoft diagnose lab {given} --apply CORRECTED"
    assert capsys.readouterr().out.endswith(f"next: {again} {options}\n")
    assert run([*command, "--apply", str(new)]) == 0
    files = f"{new / 'second.parquet'} {new / 'first.parquet'}"
    assert capsys.readouterr().out.endswith(f"next: surgisoft diagnose lab {files} {options}\n")
