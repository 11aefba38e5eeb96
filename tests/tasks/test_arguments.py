"""Wrong arguments of environments are refused in one line; arrays are as good as tensors."""

import numpy as np
import pytest
import torch

import surgisoft
from surgisoft.errors import InputError
from surgisoft.tasks.arguments import device_of
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.single import BatchedEnv, SingleEnv
from surgisoft.tasks.track import TrackConfig

WRONG = [
    ({"device": "tpu"}, "device 'tpu': expected cpu or cuda"),
    ({"device": "cpu:x"}, "device 'cpu:x': expected cpu, cuda or cuda:NUMBER"),
    ({"num_envs": 1.5}, "num_envs is 1.5, expected a whole number, 1 or more"),
    ({"num_envs": "4"}, "num_envs is '4', expected a whole number, 1 or more"),
    ({"num_envs": 0}, "num_envs is 0, expected 1 or more"),
    ({"seed": "a"}, "seed is 'a', expected a whole number"),
    ({"arm": {"laser": "default"}}, "arm is of type dict, expected the folder of an arm model"),
    ({"arm": 5}, "arm is of type int, expected the folder of an arm model, or 'default'"),
    ({"scene": 5}, "scene is of type int, expected the folder of a scene"),
    ({"images": 5}, "images is 5, expected kinds of image with commas in between"),
    ({"images": "rgb", "image_pixels": "a"}, "image_pixels is 'a', expected a whole number"),
    ({"task": 5}, "task is of type int, expected the name of a task or a task"),
]


@pytest.mark.parametrize(("wrong", "says"), WRONG, ids=[says for _, says in WRONG])
def test_a_wrong_argument_of_a_batch_is_one_line(wrong, says):
    with pytest.raises(InputError) as error:
        surgisoft.batched_env(**{"task": "circle_ablation", "num_envs": 2} | wrong)
    assert str(error.value).startswith(says)
    assert "\n" not in str(error.value)


MAKES = [
    surgisoft.parallel_env,
    lambda task, **given: surgisoft.batched_env(task, 1, **given),
    SingleEnv,
    lambda task, **given: BatchedEnv(task, 1, **given),
]


@pytest.mark.parametrize("make", MAKES, ids=["parallel", "batched", "single", "vector"])
def test_every_environment_is_made_of_a_task_too(make):
    task = make_task("track_circle", TrackConfig(FollowConfig(loop_s=1.0, approach_s=0.5)))
    env = make(task)
    assert getattr(env, "task", None) is task or env.adapter.task is task
    with pytest.raises(InputError, match="task is of type object, expected the name of a task or"):
        make(object())
    for field in ("config", "arm", "images"):
        with pytest.raises(InputError, match=f"{field} is given beside the task 'track_circle'"):
            make(task, **{field: "default"})
    assert task.world.config.scene_engine.geometry == "batched"
    make(task, geometry="batched", device="cpu")
    with pytest.raises(InputError, match="geometry is given beside the task 'track_circle'"):
        make(task, geometry="fcl")


@pytest.mark.parametrize("make", MAKES, ids=["parallel", "batched", "single", "vector"])
def test_another_device_beside_a_task_is_refused(make, monkeypatch):
    """The task stays where it was built; which GPU is asked for is not looked at."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    with pytest.raises(InputError, match="device is given beside the task 'track_circle'"):
        make(make_task("track_circle"), device="cuda")


def test_the_exact_geometry_is_the_default_of_a_named_task():
    task = surgisoft.parallel_env("track_circle").task
    assert task.world.config.scene_engine.geometry == "fcl"


def test_a_gpu_that_is_not_there_is_one_line(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    says = "device 'cuda': PyTorch finds no GPU; use device cpu"
    for make in (surgisoft.parallel_env, lambda *a, **k: surgisoft.batched_env(*a, 2, **k)):
        with pytest.raises(InputError, match=says):
            make("track_circle", device="cuda")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    assert device_of("cuda:1") == torch.device("cuda", 1)
    with pytest.raises(InputError, match="no such GPU; the last is cuda:1"):
        device_of("cuda:2")


def test_a_count_of_a_vector_environment_is_whole():
    with pytest.raises(InputError, match=r"num_envs is 2\.5, expected a whole number"):
        BatchedEnv("track_circle", num_envs=2.5)
    assert BatchedEnv("track_circle", num_envs=np.int64(2)).num_envs == 2


def test_arrays_and_tensors_are_the_same_actions():
    pressures = np.random.default_rng(0).uniform(-3.0, 3.0, (5, 3, 3)).astype(np.float32)
    kinds = (np.array, torch.tensor, lambda kPa: kPa.astype(">f8"), lambda kPa: kPa.tolist())
    points = []
    for kind in kinds:
        env = surgisoft.batched_env("track_circle", num_envs=3, seed=4)
        for kPa in pressures:
            step = env.step({"arm": kind(kPa)})
        points.append(step.observations["arm"])
    for other in points[1:]:
        assert torch.equal(other, points[0])


@pytest.mark.parametrize(
    ("actions", "says"),
    [
        (np.zeros((2, 3)), "actions are of type ndarray, expected a dict of arm"),
        ({}, "no action for 'arm', expected one for each of arm"),
        ({"arm": "open"}, "action of 'arm' is of type str and holds something else than real"),
        ({"arm": torch.zeros(2, 3, dtype=torch.complex64)}, "holds something else than real num"),
        ({"arm": np.zeros((2, 3)), "bob": 1}, "unknown agent 'bob': known are arm"),
        ({"arm": np.zeros((2, 4))}, r"action of 'arm' has shape \(2, 4\), expected \(2, 3\)"),
    ],
)
def test_a_wrong_action_is_one_line(actions, says):
    env = surgisoft.batched_env("track_circle", num_envs=2)
    with pytest.raises(InputError, match=says):
        env.step(actions)
