"""Tasks, environments and worlds that are asked for what cannot be; one line each."""

import dataclasses
import zipfile
from statistics import NormalDist
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.tasks import registry
from surgisoft.tasks.area_ablation import AreaAblationConfig
from surgisoft.tasks.breathing_ablation import BreathingAblationConfig, success_rule
from surgisoft.tasks.describe import main as describe
from surgisoft.tasks.episodes.file import load_episode
from surgisoft.tasks.numpy_adapter import NumpyAdapter
from surgisoft.tasks.parallel import parallel_env
from surgisoft.tasks.path_following import FollowWeights
from surgisoft.tasks.registry import (
    config_of,
    make_task,
    make_with,
    with_fields,
    with_present_names,
)
from surgisoft.tasks.single import BatchedEnv, SingleEnv, one_agent
from surgisoft.tasks.world.arm import LARGEST_GAIN, Randomisation
from surgisoft.tasks.world.observer import AlphaBetaFilter
from surgisoft.tasks.world.pytree import tree_map
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.reach import blank_mounts
from surgisoft.tasks.world.respiration import Respiration
from surgisoft.tasks.world.scene import only
from tests.refusals import refusal


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Randomisation(lesions=0), "randomisation: lesions is 0, expected at least 1"),
        (lambda: Randomisation(gain=5.0), "randomisation: gain is 5, expected at most 0.3"),
        (lambda: AlphaBetaFilter(gain=2.0), "observer: gain is 2.0, expected 0 to 1"),
        (lambda: AlphaBetaFilter(drift_gain=-1.0), "observer: drift_gain is -1.0, expected 0 to 1"),
        (lambda: Respiration(irregular=0.9), "respiration: irregular is 0.9, expected 0 to 0.5"),
        (lambda: AreaAblationConfig(healthy_mm2=-1.0), "healthy_mm2 is -1.0, expected >= 0"),
        (lambda: blank_mounts([]), "no arm is given; expected at least one of"),
        (lambda: blank_mounts(["knife"]), "unknown tool 'knife'"),
        (lambda: blank_mounts(["laser"], {"knife": "default"}), "unknown arm 'knife'"),
        (lambda: only({}, "laser"), "arms with the tool 'laser': none; expected one"),
        (lambda: only({"a": 1, "b": 2}, "laser"), "with the tool 'laser': a, b; expected one"),
        (lambda: describe(["--check"]), "expected one folder of pages, such as"),
        (lambda: make_task("track_hexagon"), "unknown task 'track_hexagon'"),
        (
            lambda: SingleEnv("circle_ablation"),
            "task 'circle_ablation' has agents laser, endoscope, expected one; use surgisoft.para",
        ),
        (
            lambda: make_with("two_laser_ring", scene="phantom_liver"),
            "expected laser_1, laser_2, endoscope; make a scene with",
        ),
    ],
)
def test_what_cannot_be_meant_is_one_line(make, message):
    assert message in refusal(make)


def test_a_delay_is_shorter_than_an_episode():
    """15 steps: half a second of approach and a second of a loop, 0.1 s each."""
    plain = with_fields(config_of("track_circle"), approach_s=0.5, loop_s=1.0)
    assert make_task("track_circle", with_fields(plain, delay=14)).steps == 15
    told = refusal(lambda: make_task("track_circle", with_fields(plain, delay=15)))
    assert "track_circle: world.randomisation.delay is 15 in episodes of 15 steps; expec" in told


def test_the_largest_gain_leaves_few_chambers_that_move_the_arm_backwards():
    """Of normal numbers as the worlds draw them."""
    vary = Randomisation(gain=LARGEST_GAIN)
    _, normal = streams(0, 500_000).normal(1)
    backwards = float((1.0 + vary.gain * normal < 0.0).float().mean())
    assert backwards == pytest.approx(NormalDist().cdf(-1.0 / LARGEST_GAIN), rel=0.2)
    assert backwards < 1.0 / 2000.0


OWN_ARM = """
import numpy as np
class Arm:
    static, error_mm, low, high, length_mm = True, 0.5, (0.0, 0.0), (50.0, 50.0), {length}
    def __call__(self, time_s, actuation):
        bend = (np.asarray(actuation)[:, :1] - np.asarray(actuation)[:, 1:]) / 50.0 + 1e-9
        share, size = np.linspace(0.0, 1.0, 4)[None, {points}], {body}
        x, z = (1.0 - np.cos(bend * share)) / bend, np.sin(bend * share) / bend
        return size * np.stack((x, 0.0 * x, z - {lowered}), axis=-1)
arm = Arm()
"""
"""An arc of `body` units of length, whose model states `length` mm; lowered: 1 with the origin at
the tip at rest."""


@pytest.mark.parametrize("task", ["track_circle", "laser_plane", "circle_ablation"])
@pytest.mark.parametrize(
    ("length", "body", "points", "message"),
    [
        (70.0, 0.07, ":", "in m: along the body, base to tip, they are 0.07 long, where the arm"),
        (70.0, 7.0, ":", "in cm: along the body, base to tip, they are 7 long, where the arm is 7"),
        (None, 0.07, ":", "in m: along the body, base to tip, they are 0.07 long, where an arm is"),
        (70.0, 0.07, "3:", "in m: along the body, base to tip, they are 0.07 long, where the arm"),
    ],
)
def test_an_own_arm_in_another_unit_of_length_is_refused(
    tmp_path, task, length, body, points, message
):
    file = tmp_path / "own.py"
    file.write_text(OWN_ARM.format(length=length, body=body, points=points, lowered=0))
    told = refusal(lambda: make_with(task, arm=f"{file}:arm"))
    assert f"own.py:arm: returns key points {message}" in told
    assert f"expected mm: multiply them by {10 if body == 7.0 else 1000}" in told


def test_an_arm_in_mm_with_its_only_origin_at_the_tip_is_taken(tmp_path):
    """The distance of the tip from the origin is then no length: 0 at rest."""
    file = tmp_path / "own.py"
    file.write_text(OWN_ARM.format(length=70.0, body=70.0, points="3:", lowered=1))
    task = make_with("track_body", arm=f"{file}:arm")
    rest = task.world.arms["arm"].model.rest_mm
    np.testing.assert_allclose(rest, np.zeros((1, 3)), atol=1e-4)


def test_a_weight_that_is_no_number_is_named():
    config = config_of("track_circle")
    wrong = FollowWeights(track=float("nan"))
    with pytest.raises(InputError, match="task: weight of 'track' is nan, expected a finite"):
        dataclasses.replace(config.follow, weights=wrong)


def test_an_arm_model_without_a_length_cannot_be_mounted(tmp_path):
    arm = default_arm()
    arm.spec = dataclasses.replace(arm.spec, length_mm=None)
    save_model(arm, tmp_path / "arm")
    assert (
        "the arm model states no length; fit it to recordings whose sidecar has length"
        in refusal(lambda: blank_mounts(["laser"], {"laser": str(tmp_path / "arm")}))
    )


@pytest.fixture(scope="module")
def task():
    return make_task("track_circle")


def test_actions_and_calls_of_another_shape_are_refused(task):
    adapter = NumpyAdapter(task)
    assert "action of 'arm' has shape (2,), expected (3,)" in refusal(
        lambda: adapter.checked({"arm": np.zeros(2)})
    )
    assert adapter.checked({"arm": np.zeros(3)})["arm"].dtype == np.float32
    single, vector, several = (
        SingleEnv("track_circle"),
        BatchedEnv("track_circle", num_envs=2),
        parallel_env("track_circle"),
    )
    assert "step before reset: call reset() first" in refusal(lambda: single.step(np.zeros(3)))
    assert "step before reset: call reset() first" in refusal(lambda: vector.step(np.zeros((2, 3))))
    assert "state before reset: call reset() first" in refusal(several.state)


def test_one_agent_of_a_task_is_one_of_its_own(task):
    assert "unknown agent 'laser': known are arm" in refusal(lambda: one_agent(task, "laser"))
    alone = one_agent(task, "arm")
    assert (alone.agents, alone.name, alone.steps) == (("arm",), task.name, task.steps)
    with pytest.raises(AttributeError):
        alone.__wrapped__  # noqa: B018  (as pickle and copy ask for what is not there)


def test_a_task_of_another_package_is_what_it_says(monkeypatch):
    """Stand-ins for entry points: no task, another name, one that does not load."""

    class Entry:
        """An entry point."""

        def __init__(self, name, load):
            self.name, self.value, self.load = name, "m:x", load

    named_b = SimpleNamespace(steps=5, name="b")
    own = registry.TASKS["track_circle"]
    other = dataclasses.replace(own, build=lambda config, device: named_b)
    loads = {"number": lambda: 5, "other": lambda: other, "broken": lambda: 1 / 0}
    offered = {name: Entry(name, load) for name, load in loads.items()}
    monkeypatch.setattr(registry, "offered", lambda path: offered)
    assert "task 'number' (m:x): is a int, expected a surgisoft.tasks.spec.TaskSpec" in refusal(
        lambda: make_task("number")
    )
    assert "task 'other': its name is 'b', expected 'other'" in refusal(lambda: make_task("other"))
    said = refusal(lambda: make_task("broken"))
    assert "task 'broken' (m:x): does not load (ZeroDivisionError in test_refusals.py line " in said


def test_former_names_are_those_of_tables():
    config = config_of("track_circle").follow
    assert with_present_names(config, 5) == 5
    assert with_present_names(config, {"recall": 3}) == {"history_steps": 3}
    assert with_present_names(config, {"fine_weight": 2.0}) == {"weights": {"fine": 2.0}}


def test_random_numbers_do_not_depend_on_how_they_are_drawn():
    """Compiled code on a processor, torch elsewhere: here for a subclass of a tensor."""

    class Marked(torch.Tensor):
        """What `torch.func` puts in the place of a tensor."""

    plain = streams(3, 2)
    marked = dataclasses.replace(plain, key=plain.key.as_subclass(Marked))
    for _ in range(3):
        plain, one = plain.uniform(-1.0, 2.0, 4)
        marked, other = marked.uniform(-1.0, 2.0, 4)
        torch.testing.assert_close(one, other.as_subclass(torch.Tensor), rtol=0, atol=1e-6)


def test_trees_keep_their_tuples():
    tree = {"a": (torch.ones(2), torch.zeros(2)), "b": torch.ones(1)}
    found = tree_map(lambda x: x + 1, tree)
    assert isinstance(found["a"], tuple)
    assert [x.tolist() for x in found["a"]] == [[2.0, 2.0], [1.0, 1.0]]


def test_the_rule_of_a_gated_cut_names_its_gate():
    assert "while the organ is within 0.5 mm of the end of exhalation" in success_rule(
        BreathingAblationConfig(mode="gated", gate_mm=0.5)
    )
    assert "exhalation" not in success_rule(BreathingAblationConfig(mode="follow"))
    assert "unknown mode 'wait'" in refusal(lambda: BreathingAblationConfig(mode="wait"))


def test_episodes_go_on_without_a_seed():
    env = BatchedEnv("track_circle", num_envs=2)
    first, _ = env.reset(seed=3)
    following, _ = env.reset()
    assert first.shape == following.shape
    assert not np.array_equal(first, following)
    env.reset(seed=3)
    again, _ = env.reset()
    np.testing.assert_array_equal(following, again)


def test_an_episode_file_of_another_numpy_is_one_line(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x09\x00" + b"\0" * 20)
    assert "'a.npy' has an unknown version of .npy" in refusal(lambda: load_episode(path))
