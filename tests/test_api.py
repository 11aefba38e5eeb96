"""`import surgisoft` is the public API: light, complete, and the same as the commands."""

import inspect
import json
import subprocess
import sys

import numpy as np
import pytest

import surgisoft
from surgisoft.cli import run
from surgisoft.environments import ONE_AGENT
from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import default_arm
from tests.diagnosis.test_estimation import bare_arm, measured_on


def python(code: str) -> str:
    """What a fresh Python prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


def test_the_import_is_light():
    code = (
        "import sys, surgisoft; dir(surgisoft); surgisoft.__version__;"
        "print([m for m in ('torch', 'numpy', 'scipy', 'gymnasium', 'rerun') if m in sys.modules])"
    )
    assert python(code) == "[]"


@pytest.mark.parametrize("name", [n for n in surgisoft.__all__ if n != "__version__"])
def test_every_name_is_a_documented_function(name):
    function = getattr(surgisoft, name)
    assert callable(function)
    assert inspect.getdoc(function)
    assert name in dir(surgisoft)


def test_editors_see_what_the_lazy_import_gives():
    """The names under TYPE_CHECKING, `__all__` and the table of modules agree."""
    import ast

    tree = ast.parse(inspect.getsource(surgisoft))
    (checked,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {}
    for node in checked.body:
        for alias in node.names:
            seen[alias.asname or alias.name] = (node.module, alias.name)
    assert set(seen) == set(surgisoft.__all__) - {"__version__"}
    for name, (module, own) in seen.items():
        assert getattr(surgisoft, name) is getattr(sys.modules[module], own)


SWAPPED = [
    ("amend", lambda arm, rec: (arm, ["creep"], [rec]), "one of the effects is of type Recording"),
    ("amend", lambda arm, rec: (arm, rec, None), "effects is of type NoneType"),
    ("diagnose", lambda arm, rec: (rec, arm), "recordings is of type ArmModel"),
    ("compare", lambda arm, rec: ([rec], arm), "recordings is of type ArmModel"),
    ("improve", lambda arm, rec: (rec, arm), "recordings is of type ArmModel"),
    ("improve", lambda arm, rec: (arm, rec, ["creep"]), "number of effects is of type list"),
    ("next_experiment", lambda arm, rec: (rec, arm), "recordings is of type ArmModel"),
    ("fit", lambda arm, rec: (arm, rec), "recordings is of type ArmModel"),
    ("save_model", lambda arm, rec: ("arm", arm), "the model to save is of type str"),
    ("save_recording", lambda arm, rec: ("rec.csv", rec), "recording to save is of type str"),
    ("load_model", lambda arm, rec: (rec,), "the model is of type Recording"),
    ("load_recording", lambda arm, rec: (arm,), "the recording is of type ArmModel"),
    ("load_recordings", lambda arm, rec: ([rec, arm],), "of the recordings is of type ArmModel"),
    ("collect", lambda arm, rec: (arm,), "the protocol is of type ArmModel"),
    ("import_recordings", lambda arm, rec: (rec,), "a raw file is of type Recording"),
    ("make", lambda arm, rec: (arm,), "task is of type ArmModel"),
    ("parallel_env", lambda arm, rec: (5,), "task is of type int"),
    ("train", lambda arm, rec: (arm,), "task is of type ArmModel"),
    ("evaluate", lambda arm, rec: (arm,), "policies is of type ArmModel"),
    ("run", lambda arm, rec: (arm,), "the policy is of type ArmModel"),
    ("open_scene", lambda arm, rec: (arm,), "the scene is of type ArmModel"),
    ("open_replay", lambda arm, rec: (rec,), "the replay is of type Recording"),
    ("register_effect_file", lambda arm, rec: (arm,), "the file of an effect is of type ArmModel"),
    ("demo", lambda arm, rec: (5,), "the folder is of type int"),
]


@pytest.mark.parametrize(("name", "given", "told"), SWAPPED)
def test_arguments_in_another_order_are_bad_input(name, given, told):
    with pytest.raises(InputError, match=rf"{told}, expected .*; check the order of the argumen"):
        getattr(surgisoft, name)(*given(default_arm(), measured_on(bare_arm(), rows=50)))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'cure'"):
        _ = surgisoft.cure


@pytest.mark.parametrize("order", ["surgisoft, gymnasium", "gymnasium, surgisoft"])
def test_gymnasium_knows_the_tasks_in_either_order_of_import(order):
    """After both the same class makes them; after one of them it does."""
    code = (
        f"import {order}; print(gymnasium.spec('surgisoft/track_circle-v0').entry_point);"
        "print(sum(id.startswith('surgisoft/') for id in gymnasium.registry))"
    )
    made = (
        "; env = gymnasium.make('surgisoft/track_circle-v0');"
        "env.reset(seed=1); print(env.observation_space.shape[0] > 3)"
    )
    first = order.startswith("surgisoft")
    found = python(code + first * made).split()
    assert found == ["surgisoft.tasks.single:SingleEnv", str(len(ONE_AGENT)), *["True"] * first]


def test_make_gives_one_agent_to_gymnasium_and_several_to_pettingzoo():
    import gymnasium
    from pettingzoo import ParallelEnv

    one = surgisoft.make("track_circle")
    assert isinstance(one, gymnasium.Env)
    several = surgisoft.make("circle_ablation", scene="phantom_liver", geometry="batched")
    assert isinstance(several, ParallelEnv)
    observed, _ = one.reset(seed=3)
    other, _ = gymnasium.make("surgisoft/track_circle-v0").reset(seed=3)
    np.testing.assert_array_equal(observed, other)


def test_every_registered_task_has_one_agent():
    from surgisoft.tasks.registry import TASKS, make_task

    alone = {name for name in TASKS if len(make_task(name).agents) == 1}
    assert alone == set(ONE_AGENT)


def test_collect_and_fit_give_what_the_commands_write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = "collect walk -o a.parquet --points 300 --seed 4 --hidden creep:0.5"
    assert run(command.split()) == 0
    mine = surgisoft.collect("walk", seed=4, points=300, hidden=["creep:0.5"])
    theirs = surgisoft.load_recording("a.parquet")
    np.testing.assert_array_equal(mine.key_points_mm, theirs.key_points_mm)
    fields = {"inputs": "pressure", "effects": ["hysteresis"], "epochs": 3, "prior": "none"}
    fields["hidden"] = (8, 8)
    result = surgisoft.fit("a.parquet", **fields)
    rest = "--inputs pressure --effects hysteresis --epochs 3 --widths 8,8 --prior none"
    assert run(f"fit a.parquet -o arm {rest}".split()) == 0
    fitted = surgisoft.load("arm")
    for name, value in result.model.state_dict().items():
        assert value.equal(fitted.state_dict()[name]), name
    kept = result.model.training_residuals.residual_mm
    assert kept.equal(fitted.training_residuals.residual_mm)


def test_a_user_defined_rig_is_recorded_by_the_same_function():
    from surgisoft.errors import InputError
    from surgisoft.rig import VirtualRig

    recording = surgisoft.collect("walk", VirtualRig(2), points=12)
    assert recording.samples == 12
    with pytest.raises(InputError, match="payload_g: options of the virtual rig"):
        surgisoft.collect("walk", VirtualRig(2), points=12, payload_g=1.0)


def test_train_and_evaluate_give_what_the_commands_write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.toml").write_text("[follow]\nloop_s = 4.0\n")
    run_ = surgisoft.train("track_circle", "mine", steps=64, envs=8, seed=5, config="short.toml")
    assert run_.result.done
    again = "train --task track_circle -o theirs --steps 64 --envs 8 --seed 5 --config short.toml"
    assert run(again.split()) == 0
    found = surgisoft.evaluate(["mine", "theirs", "random"], episodes=2, seed=1)
    mine, theirs, random = found.to_json()["policies"].values()
    assert mine["overall"] == theirs["overall"] != random["overall"]
    command = "evaluate mine theirs random --episodes 2 --seed 1 --json out.json"
    assert run(command.split()) == 0
    written = json.loads((tmp_path / "out.json").read_text())
    assert written == json.loads(json.dumps(found.to_json()))


def test_a_packaged_scene_opens_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = surgisoft.open_scene("phantom_liver")
    assert scene.spec.name == "phantom_liver"
    assert {body.name for body in scene.bodies} == {"liver", "gallbladder", "tray"}
