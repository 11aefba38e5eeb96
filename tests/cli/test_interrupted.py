"""Ctrl-C leaves what is finished, says what that is, and gives exit code 130."""

import io
import json
import os
import re
import signal
import subprocess
import sys

import pytest
import torch
import trimesh

import surgisoft.cli.diagnose
import surgisoft.cli.progress
import surgisoft.diagnosis.diagnose
from surgisoft.cli import run
from surgisoft.files import noted_writes, write_atomically
from surgisoft.surrogate.checkpoint import load_model
from tests.few_effects import few_effects


@pytest.fixture(scope="module", autouse=True)
def _few_effects():
    with few_effects("creep", "line_lag", "payload"):
        yield


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A short recording, a raw file with its map, and a mesh."""
    folder = tmp_path_factory.mktemp("bench")
    recording = folder / "rec.csv"
    assert run(["collect", "walk", "--points", "300", "-o", str(recording)]) == 0
    (folder / "raw.txt").write_text(recording.read_text())
    points = [[f"k{k}_{axis}_mm" for axis in "xyz"] for k in range(5)]
    (folder / "map.toml").write_text(
        '[time]\ncolumn = "t_s"\nunit = "s"\n[measured]\nunit = "kPa"\n'
        f'[key_points]\nunit = "mm"\npositions = {points}\n'
    )
    trimesh.creation.icosphere(3, 40.0).export(folder / "organ.stl")
    return folder


COMMANDS = {
    "fit --network kernel": "fit rec.csv --network kernel -o NEW",
    "compare": "compare default rec.csv --json j.json --report NEW --replay r.rrd",
    "diagnose": "diagnose default rec.csv --json j.json --report NEW",
    "amend": "amend default --effect creep --data rec.csv -o NEW --anyway --report page",
    "improve": "improve default rec.csv -o NEW --report page",
    "next-experiment": "next-experiment default --between creep line_lag -o NEW.csv",
    "scene new": "scene new organ.stl --unit mm -o NEW",
    "collect": "collect walk --points 300 -o NEW.parquet",
    "evaluate": "evaluate scripted --task track_circle --episodes 1 --json j.json --report NEW",
    "demo": "demo -o NEW",
}


def interrupt(*_, **__):
    raise KeyboardInterrupt


CHILD = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "import surgisoft.cli.progress as progress; progress.LINE_EVERY_S = 0.0; "
    "from surgisoft.cli import main; main()"
)
"""A command that reports every progress on standard error. A test that a shell started in the
background has SIGINT ignored, and so would have the command."""


def interrupted_process(command, pattern, folder):
    """Run a command in a process and send it a SIGINT when its progress matches a pattern.

    Returns its standard output and error; the exit code has to be 130.
    """
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, *command.split()],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    seen = []
    for line in child.stderr:
        seen.append(line)
        if re.search(pattern, line):
            child.send_signal(signal.SIGINT)
            break
    out, error = child.communicate()
    assert child.returncode == 130, "".join(seen) + error
    return out, error


class InterruptedAt(io.StringIO):
    """Standard error that sends this process a SIGINT once it has a text that matches a pattern."""

    def __init__(self, pattern):
        super().__init__()
        self.pattern, self.sent = pattern, False

    def write(self, text):
        count = super().write(text)
        if not self.sent and re.search(self.pattern, self.getvalue()):
            self.sent = True
            signal.raise_signal(signal.SIGINT)
        return count


def interrupted(command, pattern, folder, monkeypatch, capsys):
    """The same in this process, which has imported what a command needs."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(surgisoft.cli.progress, "LINE_EVERY_S", 0.0)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    error = InterruptedAt(pattern)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", error)
            assert run(command.split()) == 130, error.getvalue()
    finally:
        signal.signal(signal.SIGINT, before)
    return capsys.readouterr().out, error.getvalue()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("command", COMMANDS)
def test_ctrl_c_during_the_work_leaves_nothing(command, bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)
    before = names(bench)
    for told in ("__call__", "step"):
        monkeypatch.setattr(surgisoft.cli.progress.Report, told, interrupt)
    assert run(COMMANDS[command].split()) == 130
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == "surgisoft: interrupted; no output was written"
    assert names(bench) == before


def test_ctrl_c_before_the_first_validation_of_a_fit_leaves_nothing(bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)
    before = names(bench)
    monkeypatch.setattr(torch.optim.Adam, "step", interrupt)
    assert run(["fit", "rec.csv", "--epochs", "10", "--widths", "8", "-o", "NEW"]) == 130
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == "surgisoft: interrupted; no output was written"
    assert names(bench) == before


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no SIGINT to one process")
@pytest.mark.parametrize("network", ["haw_nn", "recurrent"])
def test_ctrl_c_in_the_first_stage_of_a_fit_keeps_its_best_model(
    network, bench, tmp_path, monkeypatch, capsys
):
    """One network in a process of its own, which gets the signal from outside."""
    command = f"fit {bench / 'rec.csv'} --network {network} --epochs 100000 -o NEW"
    if network == "haw_nn":
        out, error = interrupted_process(f"{command} --widths 8", "fit: .*held-out", tmp_path)
    else:
        out, error = interrupted(command, "fit: .*held-out", tmp_path, monkeypatch, capsys)
    report = json.loads((tmp_path / "NEW" / "report.json").read_text())
    where = report["interrupted"]
    stage = {"haw_nn": "pressure"}.get(network, network)
    first = {"used": True, "finished": [], "unproved": ""}
    assert where == {"stage": stage, "epoch": where["epoch"]} | first
    losses = [row["held_out_mm2"] for row in report["loss"]]
    assert [row["epoch"] for row in report["loss"]][-1] == where["epoch"] >= 10
    model = load_model(tmp_path / "NEW")
    assert report["stages"][0]["valid_rmse_mm"] == model.validation.rmse_mm
    assert model.validation.rmse_mm < 15.0  # the recording's tip moves by far more
    assert model.fitted_rows is not None
    assert len(losses) == where["epoch"] // 10
    assert f"the fit was interrupted in '{stage}', validated last after epoch" in error
    assert error.splitlines()[-1].endswith("written before and complete: NEW; nothing else")
    assert "next," not in out


def test_ctrl_c_in_a_later_stage_of_a_fit_keeps_the_finished_stages(
    bench, tmp_path, monkeypatch, capsys
):
    command = f"fit {bench / 'rec.csv'} --effects hysteresis --epochs 40 --widths 8 -o NEW"
    _, error = interrupted(
        command, r"\(hysteresis\), \d+ of \d+: held-out", tmp_path, monkeypatch, capsys
    )
    report = json.loads((tmp_path / "NEW" / "report.json").read_text())
    assert report["interrupted"]["stage"] == "hysteresis"
    assert report["interrupted"]["finished"] == ["pressure"]
    assert not report["interrupted"]["used"]
    assert [stage["name"] for stage in report["stages"]] == ["pressure"]
    model = load_model(tmp_path / "NEW")
    assert not model.effects
    assert model.validation.rmse_mm == pytest.approx(report["stages"][0]["valid_rmse_mm"])
    assert "the model is that of the finished stages: pressure" in error


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """A recording in motion, on which candidates can be fitted together with the network."""
    recording = tmp_path_factory.mktemp("moving") / "rec.parquet"
    assert run(["collect", "mixed", "--points", "1000", "-o", str(recording)]) == 0
    return recording


def test_ctrl_c_in_a_refit_keeps_the_verdict_of_the_residuals(
    moving, tmp_path, monkeypatch, capsys
):
    """In this process: `tests/test_workers.py` has pools that end."""
    monkeypatch.setattr(surgisoft.cli.diagnose, "REFIT_PROCESSES", 1)
    command = f"diagnose default {moving} --refit"
    assert run([*command.split(), "never", "--json", str(tmp_path / "never.json")]) == 0
    alone = json.loads((tmp_path / "never.json").read_text())
    sentence = alone["verdict"]["sentence"]
    assert sentence in capsys.readouterr().out
    out, error = interrupted(
        f"{command} always --json j.json --report page",
        r"diagnose: .*fitted together: ",
        tmp_path,
        monkeypatch,
        capsys,
    )
    found = json.loads((tmp_path / "j.json").read_text())
    assert (found["interrupted"], alone["interrupted"]) == (True, False)
    assert found["verdict"] == alone["verdict"]
    assert found["ranking"] == alone["ranking"]
    assert found["refit"] is None
    says = "interrupted while candidates were fitted together with the network: the verdict is that"
    assert out.startswith(f"{found['verdict']['kind']}: {sentence}\n")
    assert f"check: {says}" in out
    assert says[1:] in (tmp_path / "page" / "diagnosis.html").read_text(encoding="utf-8")
    assert error.splitlines()[-1].startswith(
        "surgisoft: interrupted; written before and complete: j.json, page"
    )


def test_ctrl_c_in_the_refit_of_the_first_round_of_improve_leaves_nothing(
    moving, tmp_path, monkeypatch, capsys
):
    """A diagnosis without its fits is no finished round."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(surgisoft.diagnosis.diagnose, "fit_candidates_together", interrupt)
    assert run(f"improve default {moving} -o NEW --refit always".split()) == 130
    assert capsys.readouterr().err.splitlines()[-1].endswith("interrupted; no output was written")
    assert names(tmp_path) == []


def test_ctrl_c_in_improve_keeps_the_finished_rounds(tmp_path, monkeypatch, capsys):
    collect = f"collect mixed --points 1000 --hidden creep payload -o {tmp_path / 'rec.parquet'}"
    assert run(collect.split()) == 0
    command = "improve default rec.parquet -o NEW --json j.json --report page"
    out, error = interrupted(command, "improve: .*payload", tmp_path, monkeypatch, capsys)
    found = json.loads((tmp_path / "j.json").read_text())
    assert found["interrupted"]
    assert found["effects"] == ["payload"]
    assert [done["step"] for done in found["rounds"]] == ["payload", None]
    assert found["rounds"][-1]["verdict"] == "interrupted"
    assert (
        found["rounds"][0]["error_mm"] == found["error_mm"]["after"] < found["error_mm"]["before"]
    )
    assert list(load_model(tmp_path / "NEW").effects) == ["hysteresis", "payload"]
    assert json.loads((tmp_path / "NEW" / "report.json").read_text()) == found
    assert "whether an effect is still missing was not decided" in (
        tmp_path / "page" / "report.html"
    ).read_text(encoding="utf-8")
    assert "surgisoft improve NEW rec.parquet -o OTHER" in out
    assert "NEW, j.json, page" in error.splitlines()[-1]


def test_ctrl_c_in_evaluate_keeps_the_finished_policies(tmp_path, monkeypatch, capsys):
    """The same numbers as without an interruption, and none of the policy that was interrupted."""
    (tmp_path / "short.toml").write_text("[follow]\nloop_s = 4.0\n")
    task = "evaluate scripted random --task track_circle --config short.toml --episodes 2"
    command = f"{task} --json j.json --report page --replay r.rrd"
    out, error = interrupted(command, "evaluate: .*random", tmp_path, monkeypatch, capsys)
    found = json.loads((tmp_path / "j.json").read_text())
    assert found["interrupted"]
    assert list(found["policies"]) == ["scripted"]
    assert run([*task.replace(" random", "").split(), "--json", str(tmp_path / "whole.json")]) == 0
    whole = json.loads((tmp_path / "whole.json").read_text())
    assert not whole["interrupted"]
    assert found["policies"] == whole["policies"]
    words = "interrupted; finished of 2 episodes each: scripted 2, random 0"
    assert words in error
    assert words in out
    assert words in (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    assert [path.name for path in tmp_path.glob("*.rrd")] == ["r-scripted.rrd"]


@pytest.mark.parametrize(
    "arguments",
    [
        "fit rec.csv --epochs 10 --widths 8 -o NEW",
        COMMANDS["collect"],
        "import raw.txt --map map.toml -o NEW.csv",
        "next-experiment default --between creep line_lag --minutes 5 --as-it-stands -o NEW.csv",
    ],
)
def test_ctrl_c_while_the_output_is_written_leaves_nothing(arguments, bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)
    before = names(bench)
    monkeypatch.setattr(os, "replace", interrupt)
    assert run(arguments.split()) == 130
    assert capsys.readouterr().err.splitlines()[-1].endswith("; no output was written")
    assert names(bench) == before


def test_ctrl_c_names_what_is_complete(bench, tmp_path, monkeypatch, capsys):
    """The second file of `compare` is interrupted: the first one stays and is named."""
    replace, done = os.replace, []

    def second(*paths):
        if done:
            raise KeyboardInterrupt
        done.append(replace(*paths))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "replace", second)
    command = f"compare default {bench / 'rec.csv'} --json j.json --report page"
    assert run(command.split()) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == "surgisoft: interrupted; written before and complete: j.json; nothing else"
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["j.json"]


def test_an_interrupted_study_says_what_it_uses_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("benchmarks.setup_faults.run", interrupt)
    assert run(["benchmark", "setup-faults", "--work", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert f"the same command uses again what is complete in {tmp_path}" in said


def test_caches_are_not_noted(tmp_path):
    with noted_writes() as written:
        write_atomically(tmp_path / "a.field", b"1", noted=False)
        write_atomically(tmp_path / "b.csv", b"2")
    write_atomically(tmp_path / "c.csv", b"3")
    assert written == [tmp_path / "b.csv"]
