"""`export` into a folder that is in use."""

import numpy as np
import pytest

from surgisoft.cli import run

MODEL = """
import numpy as np

class Arm:
    static = True
    low, high = (0.0, 0.0), (10.0, 10.0)

    def __call__(self, time_s, actuation):
        tip = {gain} * actuation[:, :1]
        zero = np.zeros_like(tip)
        points = [np.stack([zero, zero, zero], -1), np.stack([tip, zero, zero + 50.0], -1)]
        return np.concatenate(points, 1)

arm = Arm()
"""


@pytest.fixture
def model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "bends.py"
    file.write_text(MODEL.format(gain=1.0))
    return file


def test_force_replaces_an_earlier_export_and_keeps_what_is_the_users(model, capsys):
    assert run(["export", "bends.py:arm", "-o", "out"]) == 0
    out = model.parent / "out"
    (out / "arm.pt").write_text("of a version that was a graph")
    (out / "notes.txt").write_text("mine")
    before = (out / "arm.json").read_bytes()
    model.write_text(MODEL.format(gain=2.0))
    assert run(["export", "bends.py:arm", "-o", "out"]) == 2
    assert capsys.readouterr().err == (
        "surgisoft: error: out: already exists; choose another name or pass --force "
        "(in Python force=True)\n"
    )
    assert (out / "arm.json").read_bytes() == before
    assert run(["export", "bends.py:arm", "-o", "out", "--force"]) == 0
    assert (out / "arm.json").read_bytes() != before, "the hash of the callable's file is another"
    assert {file.name for file in out.iterdir()} == {"arm.py", "arm.json", "notes.txt"}


def test_force_replaces_nothing_but_an_export(model, capsys):
    other = model.parent / "data"
    other.mkdir()
    np.savetxt(other / "measured.csv", [1.0])
    assert run(["export", "bends.py:arm", "-o", "data", "--force"]) == 2
    said = "surgisoft: error: data: already exists, without arm.json; choose another name\n"
    assert capsys.readouterr().err == said
    assert [file.name for file in other.iterdir()] == ["measured.csv"]
