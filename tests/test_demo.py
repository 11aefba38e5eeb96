"""The demonstration: five steps, each with its result on the page and its files."""

import base64
import re
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from PIL import Image

from surgisoft.agents.run_folder import RunFolder
from surgisoft.agents.session import evaluate
from surgisoft.cli import run
from surgisoft.cli.evaluate import replay_files
from surgisoft.demonstration import story
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.errors import InputError
from surgisoft.files import write_atomically
from surgisoft.measurement.recordings import load_recordings
from surgisoft.replay import comparison
from surgisoft.replay.episode_view import write_replay
from surgisoft.report import Text
from surgisoft.surrogate.checkpoint import load_model
from tests.few_effects import few_effects


def test_five_steps_with_their_pictures(tmp_path, monkeypatch, capsys):
    """On a shorter recording; the packaged policies cut, the hidden effect is found and added.

    It is found among four candidates. The policies go around in a third of the time that they
    were trained for, which is harder. The picture of the replay is a small one, and replays have a
    tenth of the endoscope's pictures and of the bodies: `tests/replay` has those of the viewer, and
    whole replays.
    """
    monkeypatch.setattr(comparison, "MOST_ROWS", 80)
    monkeypatch.setattr(story, "POINTS", 800)
    quick = replace(RunFolder(story.POLICY).plan().task_config, cut_s=15.0)
    monkeypatch.setattr(story, "evaluate", partial(evaluate, config=quick))
    few = few_effects("creep", "drift", "payload", "line_lag")
    monkeypatch.setattr(story, "diagnose", few(diagnose))
    monkeypatch.setattr(story, "write_replay", partial(write_replay, pictures_hz=0.25))
    shown = []

    def picture(replay, screenshot):
        assert replay.stat().st_size > 10_000
        Image.new("RGB", (64, 40), "teal").save(screenshot)
        shown.append(screenshot.read_bytes())

    monkeypatch.setattr(story, "open_replay", picture)
    folder = tmp_path / "story"
    assert run(["demo", "-o", str(folder)]) == 0
    said = capsys.readouterr().out
    steps = [line for line in said.splitlines() if line[:1].isdigit()]
    assert [line[:2] for line in steps] == ["1.", "2.", "3.", "4.", "5."]
    assert "1. cut: the whole ring was cut in" in said
    assert f"wrote {folder / 'index.html'}" in said
    (recording,) = load_recordings(folder / "bench.parquet")
    assert sum(len(run.t_s) for run in [recording]) == 800
    assert list(load_model(folder / "amended").effects)[-1] == "creep"
    page = (folder / "index.html").read_text()
    assert page.count("<section") == 5
    assert "surgisoft diagnose default bench.parquet" in page
    for name in ("cut.rrd", "compare/report.html", "diagnosis.html", "amendment.html"):
        assert (folder / name).stat().st_size > 10_000
    # pictures: dose and paths of the cut, bodies, loops and error, ranking, the fall
    assert page.count("<img") >= 10
    measured = page.rpartition("2. A robot is measured")[2].partition("<section")[0]
    assert measured.count("<img") == 1, "what was recorded, over time"
    assert "how far the tip moved" in measured
    assert base64.b64encode(shown[0]).decode() in page
    # a second call keeps the first one's files
    assert run(["demo", "-o", str(folder)]) == 2
    assert "already exists" in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="cannot be written"):
        story.demo(tmp_path / "file" / "inside")


@pytest.mark.parametrize("failing", ["replay", "recording"])
def test_what_ends_early_leaves_whole_steps_or_nothing(tmp_path, monkeypatch, failing):
    """The page shows the steps so far: none where the cut fails, one where the recording does."""
    folder, steps = tmp_path / "story", []

    def none(*_, **__):
        raise InputError("no replay")

    log, parts = object(), [Text("the cut"), Text("left out")]
    cut = SimpleNamespace(logs={"ring": log})
    monkeypatch.setattr(story, "evaluate", lambda *_, **__: cut)
    monkeypatch.setattr(story, "cut_sentence", lambda cut: "the whole ring was cut")
    monkeypatch.setattr(story, "episode_parts", lambda log: parts)
    monkeypatch.setattr(story, "open_replay", none)
    monkeypatch.setattr(story, "write_replay", none if failing == "replay" else lambda *_: None)
    monkeypatch.setattr(story, "HIDDEN", "nonsense")
    with pytest.raises(InputError, match="no replay" if failing == "replay" else "nonsense"):
        story.demo(folder, on_step=lambda name, text: steps.append(name))
    if failing == "replay":
        assert not folder.exists()
        assert not steps
        return
    assert steps == ["cut"]
    assert [path.name for path in folder.iterdir()] == ["index.html"]
    page = (folder / "index.html").read_text()
    assert page.count("<section") == 1
    assert "ended before the next step (4 of 5 are left)" in page
    assert "the cut" in page


def test_ctrl_c_names_what_is_complete_and_leaves_its_page(tmp_path, monkeypatch, capsys):
    """Interrupted at the picture of the cut, while the other process has recorded the robot."""
    folder, parts = tmp_path / "story", [Text("the cut"), Text("left out")]
    cut = SimpleNamespace(logs={"ring": object()})

    def interrupted(*_, **__):
        until = time.monotonic() + 300.0
        while not (folder / "bench.toml").exists() and time.monotonic() < until:
            time.sleep(0.05)
        raise KeyboardInterrupt

    def replay(log, path):
        write_atomically(path, b"the replay")

    monkeypatch.setattr(story, "POINTS", 200)
    monkeypatch.setattr(story, "evaluate", lambda *_, **__: cut)
    monkeypatch.setattr(story, "cut_sentence", lambda cut: "the whole ring was cut")
    monkeypatch.setattr(story, "episode_parts", lambda log: parts)
    monkeypatch.setattr(story, "write_replay", replay)
    monkeypatch.setattr(story, "open_replay", interrupted)
    assert run(["demo", "-o", str(folder)]) == 130
    said = capsys.readouterr()
    assert "1. cut: the whole ring was cut" in said.out
    files = {path.name for path in folder.iterdir()}
    assert files == {"cut.rrd", "index.html", "bench.parquet", "bench.toml"}
    last = said.err.splitlines()[-1]
    assert all(str(folder / name) in last for name in files)
    assert last.endswith("; nothing else")
    assert len(load_recordings(folder / "bench.parquet")[0].t_s) == 200
    page = (folder / "index.html").read_text()
    assert page.count("<section") == 1
    assert "ended before the next step (4 of 5 are left)" in page


def test_the_replay_that_make_demo_names_is_one_that_it_writes():
    """Its `evaluate --replay` has three policies, each with its own file."""
    makefile = (Path(__file__).resolve().parents[1] / "Makefile").read_text()
    given, file = re.findall(r"surgisoft evaluate (.*?) --.* --replay (\S+)", makefile)[0]
    named = re.findall(r"surgisoft replay (\S+)", makefile)
    assert given.split() == ["demo/ring", "scripted", "random"]
    assert [Path(name) for name in named] == [replay_files(given.split(), Path(file))["demo/ring"]]
