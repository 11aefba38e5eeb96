"""Exported models around callables: NumPy code that calls them, equal to the model in Python."""

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

from surgisoft.cli import run as surgisoft
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import save_recording
from surgisoft.surrogate import export as exporting
from surgisoft.surrogate.callables import named
from surgisoft.surrogate.callables.arm import arm_by_itself
from surgisoft.surrogate.callables.named import named_callable
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.effects import EFFECTS, make_effect
from surgisoft.surrogate.export import CALLABLE_FILES, differences, export_arm
from tests.surrogate.test_export import SMALL, Stuck, bench, exact, two_runs  # noqa: F401  # fixtures

ROOT = Path(__file__).resolve().parents[2]
MODELS = """
import numpy as np

TIP = np.array([[-0.1, -0.6], [0.55, 0.25], [-0.55, 0.25]])


class Arc:
    static = True
    low, high = (-15.0, -15.0, -15.0), (55.0, 55.0, 55.0)
    gravity = (0.0, 0.0, -1.0)

    def __call__(self, time_s, actuation):
        share = np.linspace(0, 1, 5)
        tip = actuation @ TIP + np.array([6.0, 0.0]) + 1e-3 * actuation[:, :2] ** 2
        across = tip[:, None, :] * share[:, None] ** 2
        along = np.broadcast_to(70.0 * share, across.shape[:2])
        return np.concatenate([across, along[..., None]], axis=-1)


class Stepped(Arc):
    static = False

    def initial_state(self, actuation):
        return np.concatenate([actuation, np.zeros((len(actuation), 1))], 1)

    def step(self, state, actuation, dt_s):
        held = actuation + (state[:, :3] - actuation) * np.exp(-dt_s / 0.4)[:, None]
        rows = state[:, 3:] + dt_s[:, None]
        points = super().__call__(dt_s, held)
        points[:, -1, 2] += 0.1 * np.sin(rows[:, 0])
        return np.concatenate([held, rows], 1), points


class Runs(Arc):
    static = False

    def __call__(self, time_s, actuation):
        held, past = actuation.copy(), actuation[0]
        for row, dt_s in enumerate(np.diff(time_s, prepend=time_s[0])):
            past = held[row] = actuation[row] + (past - actuation[row]) * np.exp(-dt_s / 0.4)
        points = super().__call__(time_s, held)
        points[:, -1, 2] += 0.1 * np.sin(time_s)
        return points


class Foreseeing(Arc):
    static = False

    def __call__(self, time_s, actuation):
        return super().__call__(time_s, actuation) + actuation[-1, 0]


class InPlace(Stepped):
    def initial_state(self, actuation):
        actuation += 1.0
        return super().initial_state(actuation)

    def step(self, state, actuation, dt_s):
        actuation += 1.0
        dt_s *= 0.5
        return super().step(state, actuation, dt_s)


static, stepped, runs, foreseeing = Arc(), Stepped(), Runs(), Foreseeing()
in_place = InPlace()
"""


@pytest.fixture(autouse=True)
def _nothing_named(monkeypatch, tmp_path):
    """No callable is named yet; the file of the models lies in the current folder."""
    monkeypatch.setattr(named, "NAMED", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    Path("arms.py").write_text(MODELS)


def wrapped(name, effects):
    """The model around a callable of the file with some effects, whose amplitudes matter."""
    arm = arm_by_itself(named_callable(f"arms.py:{name}"))
    made = {each: make_effect(each, arm.facts) for each in effects}
    if "drift" in made:
        made["drift#2"] = make_effect("drift", arm.facts, kind="temperature")
    torch.manual_seed(1)
    for each, effect in made.items():
        for value in effect.amplitudes().values():
            value.data.normal_().mul_(0.02 if each in SMALL else 0.3)
    return arm.replace(effects=made).eval()


BUILT = {
    "static": tuple(EFFECTS),
    "stepped": ("hysteresis", "creep"),
    "in_place": ("hysteresis",),
    "runs": ("hysteresis", "inertia"),
}
"""Effects around a callable in the files that several tests read."""


@pytest.fixture(scope="module")
def built(bench, tmp_path_factory):  # noqa: F811
    """Copies the files of a model, compared over the recording, to a folder and returns the model.

    They are exported once.
    """
    place = tmp_path_factory.mktemp("built")
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setattr(exporting, "CHECKED", 30)  # the recording has 80 rows more

    def copied(name, folder="arm"):
        model = wrapped(name, BUILT[name])
        if not (place / name).exists():
            files = export_arm(model, place / name, {"bench": exact(bench[1])})
            assert [file.name for file in files] == list(CALLABLE_FILES)
        shutil.copytree(place / name, folder)
        return model

    yield copied
    monkeypatch.undo()


def predicted(recording, folder, *arguments):
    """(T, n, 3) mm: what the example prints of a recording, where surgisoft and torch lack."""
    blocked = (
        "import runpy, sys; sys.modules.update(dict.fromkeys(('surgisoft', 'torch', 'onnx'))); "
        "runpy.run_path(sys.argv.pop(1), run_name='__main__')"
    )
    example = ROOT / "examples" / "exported_callable.py"
    done = subprocess.run(
        [sys.executable, "-c", blocked, example, folder, recording, *arguments],
        capture_output=True,
        text=True,
        check=True,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
    )
    rows = [line.split(",") for line in done.stdout.splitlines()]
    return np.array(rows, float).reshape(len(rows), -1, 3)


@pytest.mark.parametrize("name", BUILT)
def test_the_file_predicts_a_recording_as_the_model_does(name, built, bench):  # noqa: F811
    """To 1e-5 mm, from the callable's own file and NumPy alone."""
    model = built(name)
    about = json.loads(Path("arm/arm.json").read_text())
    assert about["model_code"]["name"] == f"arms.py:{name}"
    assert list(about["effects"]) == list(model.effects)
    assert differences("arm")["bench"]["rows"] == 80
    expected = model.double().predict(exact(bench[1]))[0].detach().numpy()
    assert np.linalg.norm(expected - expected[0], axis=2).max() > 5.0
    bare = arm_by_itself(named_callable(f"arms.py:{name}")).double().predict(exact(bench[1]))
    assert np.abs(expected - bare[0].numpy()).max() > 1.0, "the effects change nothing"
    np.testing.assert_allclose(predicted(bench[0], "arm"), expected, atol=1e-5)


def test_the_example_begins_every_run_anew(two_runs):  # noqa: F811
    model, history = wrapped("stepped", ("hysteresis", "drift")), exact(two_runs[1])
    export_arm(model, "arm", {"two_runs": history})
    expected = history.rows(model.double().predict(history)).detach().numpy()
    np.testing.assert_allclose(predicted(two_runs[0], "arm"), expected, atol=1e-5)


def test_the_command_exports_an_amended_callable(bench, capsys):  # noqa: F811
    """Two runs of different length; the callable has to be named to open the folder."""
    run_of_row = (np.arange(bench[1].samples) >= 50).astype(bench[1].run.dtype)
    save_recording(replace(bench[1], run=run_of_row), "two.csv")
    save_model(wrapped("stepped", ("payload",)), "amended")
    command = ["export", "amended", "-o", "arm", "--data", "two.csv"]
    named.NAMED.clear()
    assert surgisoft(command) == 2
    assert "name it: --model-code arms.py:stepped" in capsys.readouterr().err
    assert not Path("arm").exists()
    assert surgisoft([*command, "--model-code", "arms.py:stepped"]) == 0
    out = capsys.readouterr().out
    assert "two: over 80 rows the files differ from the model by" in out
    assert out.splitlines()[-2:] == ["wrote arm/arm.py", "wrote arm/arm.json"]
    assert surgisoft(["export", "arms.py:static", "-o", "bare"]) == 0
    assert json.loads(Path("bare/arm.json").read_text())["effects"] == []


def opened(folder="arm"):
    """The class of an exported file."""
    space = {"__name__": "arm", "__file__": f"{folder}/arm.py"}
    exec(Path(folder, "arm.py").read_text(), space)
    return space["Arm"]


def test_the_state_is_a_row_for_each_arm_and_grows_with_whole_runs_only(built):
    pressure = np.array([[30.0, 5.0, 0.0], [0.0, 0.0, 40.0]])
    for name in ("stepped", "runs"):
        built(name, name)
        arm, both = opened(name)(), []
        size = json.loads(Path(name, "arm.json").read_text())["state"]["size"]
        for rows in (slice(None), slice(1, 2)):
            state = arm.start(pressure[rows])
            assert state.shape == (len(pressure[rows]), size)
            for dt_s in (0.0, 0.3, 0.7):
                state, points = arm.step(state, pressure[rows], dt_s)
            both.append(points[-1])
            assert state.shape[1] - size == (12 if name == "runs" else 0)
        np.testing.assert_allclose(both[0], both[1], atol=1e-12)
    few = opened("runs")(keep_rows=2)
    state = few.start(pressure)
    for _ in range(4):
        state, _ = few.step(state, pressure, 0.1)
    assert state.shape[1] - size == 8
    with pytest.raises(ValueError, match="keep_rows is 0, expected 1 or more"):
        opened("runs")(keep_rows=0)


def test_the_file_says_what_is_wrong_in_one_line():
    export_arm(wrapped("static", ()), "arm")
    arm = opened()()
    state = arm.start(np.zeros((1, 3)))
    for wrong, said in [
        ((state, np.zeros(3), 0.1), r"pressure has shape \(3,\), expected \(B, 3\)"),
        ((state, np.full((1, 3), np.nan), 0.1), "expected finite numbers"),
        ((state[:, 1:], np.zeros((1, 3)), 0.1), r"state has shape \(1, 8\), expected \(1, 9\)"),
        ((state, np.zeros((1, 3)), -0.1), "dt_s is -0.1, expected 0 s or more"),
    ]:
        with pytest.raises(ValueError, match=said):
            arm.step(*wrong)
    two = np.zeros((2, 3))
    for wrong, said in [
        (np.zeros(3), r"elapsed_s has shape \(3,\), expected one number or \(2,\)"),
        (np.zeros((2, 1)), r"elapsed_s has shape \(2, 1\), expected one number or \(2,\)"),
        (None, "elapsed_s is None, expected finite numbers"),
        ([0.0, np.inf], r"elapsed_s is \[0\.0, inf\], expected finite numbers"),
    ]:
        with pytest.raises(ValueError, match=f"^{said}$"):
            arm.start(two, elapsed_s=wrong)
    np.testing.assert_array_equal(arm.start(two, [5.0, 5.0]), arm.start(two, 5.0))
    with pytest.raises(ValueError, match=r"^dt_s has shape \(3,\), expected one number or \(2,\)$"):
        arm.step(arm.start(two), two, np.zeros(3))
    with pytest.raises(ValueError, match=r"key points have shape \(1, 2\), expected \(1, 5, 3\)"):
        opened()(lambda time_s, actuation: np.zeros((1, 2))).step(state, np.zeros((1, 3)), 0.1)
    Path("arms.py").write_text(MODELS + "\n")
    with pytest.raises(ValueError, match=r"arms\.py: is not the file that was exported with"):
        opened()()
    Path("arms.py").unlink()
    with pytest.raises(ValueError, match=r"arms\.py: no such file; copy it beside arm\.py"):
        opened()()
    Path("arm/arms.py").write_text(MODELS)
    assert opened()().start(np.zeros((1, 3))).shape == (1, 9)


def test_what_the_file_could_not_do_as_the_model_does_is_refused():
    with pytest.raises(InputError, match="may not depend on its later rows"):
        export_arm(wrapped("foreseeing", ()), "arm")
    stuck = Stuck(wrapped("static", ()).facts)
    stuck.loss.data.fill_(0.3)
    with pytest.raises(InputError, match=r"effect 'stuck' does not trace; .*torch\.where") as told:
        export_arm(wrapped("static", ()).replace(effects={"stuck": stuck}), "arm")
    assert "\n" not in str(told.value)
    assert not Path("arm").exists()


class Crowd(Stuck):
    """An effect that asks how many arms there are."""

    def apply(self, signal, memory):
        if len(signal) > 5:
            return signal - self.loss * self.reach
        return signal + 0.0 * self.loss


def test_an_effect_that_depends_on_the_number_of_arms_is_refused():
    """The file is traced with two arms, and compared with the model of one."""
    crowd = Crowd(wrapped("static", ()).facts)
    crowd.loss.data.fill_(0.3)
    with pytest.raises(InputError, match=r"depends on the number of rows .*; leave out"):
        export_arm(wrapped("static", ()).replace(effects={"crowd": crowd}), "arm")
    assert not Path("arm").exists()


def test_a_reopened_model_is_exported_as_the_one_that_was_saved():
    model = wrapped("static", ("gain_mismatch",))
    save_model(model, "saved")
    export_arm(load_model("saved"), "again")
    export_arm(model, "first")
    assert Path("again/arm.py").read_text() == Path("first/arm.py").read_text()
