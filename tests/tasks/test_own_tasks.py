"""A task in another package: the one of docs/tasks.md, installed as its entry point is."""

import importlib
import json
import math
import re
import sys
import warnings
from pathlib import Path

import pytest
import torch

import surgisoft
from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.episodes.log import EpisodeRecorder
from surgisoft.tasks.path_following import Follow
from surgisoft.tasks.registry import TASKS, make_task, spec_of, task_names
from surgisoft.tasks.single import BatchedEnv

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tasks.md"


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The package of the page, with its own line of entry points and others that are wrong."""
    page = PAGE.read_text()
    source = re.search(r'```python title="my_tasks/smooth.py"\n(.*?)```', page, re.S)[1]
    entry = re.search(r"entry-points.\"surgisoft.tasks\"\]\n(.*?)```", page, re.S)[1].replace(
        '"', ""
    )
    (tmp_path / "my_tasks").mkdir()
    (tmp_path / "my_tasks" / "__init__.py").touch()
    (tmp_path / "my_tasks" / "smooth.py").write_text(source)
    info = tmp_path / "my_tasks-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Name: my_tasks\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[surgisoft.tasks]\n{entry}absent = my_tasks.absent:X\n"
        "function = my_tasks.smooth:smooth_circle\nrenamed = my_tasks.smooth:SMOOTH_CIRCLE\n"
        "track_circle = my_tasks.smooth:SMOOTH_CIRCLE\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    yield tmp_path
    for name in ("my_tasks", "my_tasks.smooth"):
        sys.modules.pop(name, None)


def test_its_reward_is_the_packages_and_its_own_term(installed):
    """Against `track_circle` at the same seed and actions: equal but for the price."""
    own = surgisoft.batched_env("smooth_circle", num_envs=2, seed=5)
    plain = surgisoft.batched_env("track_circle", num_envs=2, seed=5)
    change = torch.tensor([[1.0, -2.0, 0.5]]).repeat(2, 1)
    before = own.state.world.arms["arm"].seen_kPa
    now, usual = own.step({"arm": change}), plain.step({"arm": change})
    moved = own.state.world.arms["arm"].seen_kPa - before  # the pumps follow the command slowly
    assert torch.equal(now.terms["arm"]["track"], usual.terms["arm"]["track"])
    price = now.terms["arm"]["smooth"]
    assert torch.allclose(price, -0.01 * moved.square().sum(1))
    assert (price < 0.0).all()
    assert torch.allclose(now.rewards["arm"], usual.rewards["arm"] + price)


def test_it_is_trained_and_evaluated_by_its_name(installed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = "--task smooth_circle --steps 512 --envs 32 ppo.evaluation_episodes=2 -o own"
    assert run(["train", *options.split()]) == 0
    last = json.loads((tmp_path / "own" / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["term/arm/smooth"] < 0.0
    assert run(["evaluate", "own", "--episodes", "1"]) == 0
    assert "smooth_circle, simulation: 1 episode" in capsys.readouterr().out
    config = json.loads((tmp_path / "own" / "config.json").read_text())
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each != str(installed)])
    assert run(["evaluate", "own", "--episodes", "1"]) == 2
    told = capsys.readouterr().err
    assert "own: was trained on the task 'smooth_circle', which is not installed here" in told
    assert f"install {config['task_package']} first" in told


def test_the_laser_task_of_the_page_waits_at_its_places_in_their_order(tmp_path, monkeypatch):
    """Opposite places after each other, each until the beam was on for 1.5 s, and then the end."""
    source = re.search(r'```python title="my_tasks/spots.py"\n(.*?)```', PAGE.read_text(), re.S)[1]
    (tmp_path / "spots_of_the_page.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    spec = importlib.import_module("spots_of_the_page").FOUR_SPOTS
    task = spec.build(None, "cpu")
    episodes, targets, on, errors = Episodes(task), [], [], []
    state, ended = episodes.seeded(0, 1), False
    while not ended and len(on) < task.steps:
        targets.append(task.target_mm(state)[0])
        state, outcome = episodes.step(state, task.script(state))
        on.append(bool(state.goal.fired))
        errors.append(float(outcome.measures["beam_error_mm"]))
        ended = bool(outcome.terminated)
    assert ended
    assert float(outcome.measures["success"]) == 1.0
    ring = task.scene.paths_mm[0]
    count = len(ring)
    turns = [int((ring - target).norm(dim=1).argmin()) for target in targets]
    order = [round(4.0 * place / count) for place, lit in zip(turns, on, strict=True) if lit]
    assert order == [0] * 15 + [2] * 15 + [1] * 15 + [3] * 15
    known = [error for error in errors if not math.isnan(error)]
    assert len(known) == 4 * 14, "without the steps after which the next place is the target"
    assert max(known) < 1.0
    said = spec.success_rule(task.config)
    assert said.startswith("the beam was on for 1.5 s at each of 4 places")


def of_rewards(rewards):
    """`track_circle` whose rewards are those of a function of the state."""
    task = make_task("track_circle")
    task.rewards = rewards
    return task


WRONG_REWARDS = [
    (lambda state: {"arm": {"x": 1.0}}, "term 'x' of 'arm' is of type float, expected a tensor of"),
    (
        lambda state: {"arm": {"x": torch.ones(3)}},
        r"'x' of 'arm' is of shape \(3,\), .* \(2,\), one",
    ),
    (lambda state: {"arm": torch.ones(2)}, "for 'arm' are of type Tensor, expected a dict of at l"),
    (lambda state: {"arm": {}}, "for 'arm' are an empty dict, expected a dict of at least one"),
    (lambda state: {}, "are an empty dict, expected a dict of arm"),
    (lambda state: {"bob": {"x": torch.ones(2)}}, "are of bob, expected a dict of arm"),
    (lambda state: torch.ones(2), "are of type Tensor, expected a dict of arm"),
    (
        lambda state: {"arm": {"x": torch.ones(2), "y": torch.tensor([0.0, torch.nan])}},
        "term 'y' of 'arm' is NaN or infinite in 1 of 2 environments",
    ),
]


@pytest.mark.parametrize(("rewards", "says"), WRONG_REWARDS, ids=[s[:24] for _, s in WRONG_REWARDS])
def test_wrong_rewards_are_one_line_that_names_the_term(rewards, says):
    for env, still in (
        (surgisoft.batched_env(of_rewards(rewards), 2), {"arm": torch.zeros(2, 3)}),
        (BatchedEnv(of_rewards(rewards), 2), torch.zeros(2, 3)),
    ):
        env.reset(seed=0)
        with pytest.raises(InputError, match=f"rewards of the task 'track_circle'.*{says}"):
            env.step(still)


WRONG_RETURNS = [
    (
        "goal",
        lambda stream: None,
        "goal of the task 'track_circle' is of type NoneType, expected a",
    ),
    ("goal", lambda stream: (1, 2), "is of type tuple, expected a pair: the . random number str"),
    ("advance", lambda state, actions: None, "advance .* is of type NoneType, expected a TaskSta"),
    ("ended", lambda state: None, "ended of the task 'track_circle' is of type NoneType, expected"),
    (
        "ended",
        lambda state: torch.zeros(3, dtype=torch.bool),
        r"is of shape \(3,\), .* \(2,\), one",
    ),
    ("ended", lambda state: torch.zeros(2), "ended .* is of type torch.float32, expected torch.bo"),
    ("measures", lambda state: None, "measures .* are of type NoneType, expected a dict of tenso"),
    ("measures", lambda state: {"error_mm": torch.ones(2, 2)}, r"'error_mm' is of shape \(2, 2\)"),
    ("measures", lambda state: {"error_mm": 0.5}, "'error_mm' is of type float, expected a tens"),
    ("observe", lambda state: torch.ones(2, 5), "observe .* is of type Tensor, expected a dict of"),
    (
        "observe",
        lambda state: {"bob": torch.ones(2, 5)},
        "observe .* is of bob, expected a dict of",
    ),
    ("observe", lambda state: {"arm": torch.ones(5)}, r"of 'arm' is of shape \(5,\), .*\(\d, D\)"),
    (
        "observe",
        lambda state: {"arm": torch.ones(9, 5)},
        r"is of shape \(9, 5\), expected a tensor",
    ),
    (
        "observe",
        lambda state: {"arm": torch.ones(len(state.world.steps), 5).double()},
        "is of type torch.float64, expected torch.float32",
    ),
    (
        "observe",
        lambda state: {"arm": torch.tensor([[1.0, torch.nan]]).repeat(len(state.world.steps), 1)},
        r"observe .*the observation of 'arm' is NaN in (\d) of \1 environments; correct this",
    ),
]


def first_step(environments, task, still):
    env = environments(task, 2)
    env.reset(seed=0)
    env.step(still)


@pytest.mark.parametrize(("method", "function", "says"), WRONG_RETURNS)
def test_what_another_method_returns_is_told_with_its_shape(method, function, says):
    """By the first step, in tensors and in arrays."""
    for environments, still in (
        (surgisoft.batched_env, {"arm": torch.zeros(2, 3)}),
        (BatchedEnv, torch.zeros(2, 3)),
    ):
        task = make_task("track_circle")
        setattr(task, method, function)
        with pytest.raises(InputError, match=says):
            first_step(environments, task, still)


def test_what_differs_with_the_number_of_episodes_is_told():
    """A rollout goes on with fewer episodes when half of them are over."""
    task = make_task("track_circle")
    task.ended = lambda state: torch.zeros(4, dtype=torch.bool)
    episodes = Episodes(task)
    step = {"arm": torch.zeros(4, 3)}
    episodes.step(episodes.seeded(0, 4), step)
    with pytest.raises(
        InputError, match=r"is of shape \(4,\), expected a bool tensor of shape \(2,"
    ):
        episodes.step(episodes.seeded(0, 2), {"arm": step["arm"][:2]})


@pytest.mark.parametrize(
    "trace", [lambda state: None, lambda state: (torch.ones(1, 3), torch.ones(1, 3))]
)
def test_a_trace_of_another_form_is_one_line(trace):
    task = make_task("track_circle")
    task.trace = trace
    says = r"trace of the task 'track_circle' is of .*, expected two tensors .*\(1, k, 3\)"
    with pytest.raises(InputError, match=says):
        EpisodeRecorder(task, Episodes(task).seeded(0, 1), policy="scripted", seed=0)


class Narrow(Follow):
    def observe(self, state):
        return {"arm": super().observe(state)["arm"][:, :3]}


class NarrowBlocks(Follow):
    def blocks(self, state):
        return {"arm": dict(list(super().blocks(state)["arm"].items())[:1])}


@pytest.mark.parametrize("kind", [Narrow, NarrowBlocks, Follow])
def test_observations_apart_from_their_blocks_are_told(kind):
    plain = make_task("track_circle")
    own = kind("own", plain.world, plain.follow, plain.marker, plain.centre, 3)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        env = surgisoft.batched_env(own, num_envs=2)
    width = surgisoft.batched_env(plain, num_envs=2).observation_sizes["arm"]
    told = [str(each.message) for each in seen]
    if kind is Narrow:
        assert env.observation_sizes == {"arm": 3}
        assert len(told) == 1
        assert f"the observation of 'arm' has 3 columns, its blocks have {width};" in told[0]
    else:
        assert not told


def test_rewards_of_an_arm_that_failed_may_be_nan():
    """They are 0: the arm is no longer finite, and so is what is computed of it."""
    env = surgisoft.batched_env("track_circle", 2)
    step = env.step({"arm": torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0.0, 0.0]])})
    assert step.rewards["arm"][1] == 0.0


def test_a_training_names_the_reward_term_that_is_nan(installed, tmp_path, monkeypatch, capsys):
    """Not its learning rate, which is as it should be."""
    monkeypatch.chdir(tmp_path)
    own = type(make_task("smooth_circle"))
    plain = own.rewards

    def spoilt(task, state):
        return {"arm": {**plain(task, state)["arm"], "smooth": torch.nan * state.world.steps}}

    monkeypatch.setattr(own, "rewards", spoilt)
    options = "--task smooth_circle --steps 512 --envs 32 ppo.evaluation_episodes=2 -o own"
    assert run(["train", *options.split()]) == 2
    told = capsys.readouterr().err
    assert "reward term 'smooth' of 'arm' is NaN or infinite within the first 384 steps" in told
    assert "correct the rewards of the task 'smooth_circle'" in told
    assert not Path("own").exists(), "nothing was learned"


def test_a_training_names_observations_that_are_nan(installed, tmp_path, monkeypatch, capsys):
    """Neither its learning rate nor its rewards."""
    monkeypatch.chdir(tmp_path)
    own = type(make_task("smooth_circle"))
    plain = own.observe

    def spoilt(task, state):
        seen = plain(task, state)["arm"]
        return {"arm": seen.masked_fill((state.world.steps == 7)[:, None], torch.nan)}

    monkeypatch.setattr(own, "observe", spoilt)
    options = "--task smooth_circle --steps 512 --envs 32 ppo.evaluation_episodes=2 -o own"
    assert run(["train", *options.split()]) == 2
    told = capsys.readouterr().err
    assert "the training diverged within the first 384 steps: the observation of 'arm'" in told
    # Episodes begin at steps 7919 i modulo 230; an action of NaN in step 7 ends one.
    spoilt_rows = 0
    for step in (7919 * i % 230 for i in range(32)):
        for _ in range(12):
            spoilt_rows += step == 7
            step = 0 if step in (7, 229) else step + 1
    assert f"is NaN in {spoilt_rows} of the last 384; correct observe of the task" in told
    assert "learning_rate" not in told
    assert not Path("own").exists(), "nothing was learned"


def test_a_task_without_success_and_error_keeps_the_largest_return(
    installed, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    own = type(make_task("smooth_circle"))
    monkeypatch.setattr(
        own, "measures", lambda task, state: {"five": 5.0 + 0.0 * state.world.steps}
    )
    options = "--task smooth_circle --steps 1536 --envs 32 ppo.evaluation_episodes=2 -o own"
    assert run(["train", *options.split(), "ppo.evaluate_every=1"]) == 0
    printed = capsys.readouterr()
    rows = [json.loads(line) for line in Path("own/metrics.jsonl").read_text().splitlines()]
    returns = [row["evaluation/mean_return"] for row in rows]
    best = torch.load("own/checkpoints/best.pt", weights_only=True)
    assert best["iteration"] == 1 + returns.index(max(returns))
    assert f"best evaluation: return {max(returns):.4g}" in printed.out
    assert "whether the training converged is not known: measures of the task 'smo" in printed.err
    assert "did not converge" not in printed.err


def test_what_a_package_offers_is_checked(installed):
    assert task_names()[: len(TASKS)] == list(TASKS)
    assert {"smooth_circle", "absent", "function", "renamed"} <= set(task_names())
    assert spec_of("track_circle") is TASKS["track_circle"], "the package's own names stay"
    with pytest.raises(InputError, match=r"'absent' .*does not load .*remove that package"):
        make_task("absent")
    with pytest.raises(InputError, match=r"'function' .*is a function, expected a .*TaskSpec"):
        make_task("function")
    with pytest.raises(InputError, match="'renamed': its name is 'smooth_circle'"):
        make_task("renamed")
    with pytest.raises(InputError, match=r"unknown task 'smoth_circle'.*smooth_circle"):
        make_task("smoth_circle")


@pytest.fixture
def faulty(installed):
    """The same package with tasks whose code raises, by names of their own."""
    (installed / "my_tasks" / "faulty.py").write_text(
        "from dataclasses import dataclass, replace\n"
        "from surgisoft.tasks.registry import spec_of\n"
        "from surgisoft.tasks.track import TrackConfig\n"
        "CIRCLE = spec_of('track_circle')\n"
        "def build(config, device):\n"
        "    return {}['gain']\n"
        "def late(config, device):\n"
        "    task = CIRCLE.build(config, device)\n"
        "    task.name = 'late'\n"
        "    def rewards(state):\n"
        "        raise RuntimeError('no such sensor')\n"
        "    task.rewards = rewards\n"
        "    return task\n"
        "@dataclass(frozen=True)\n"
        "class Own(TrackConfig):\n"
        "    price: float = 1.0\n"
        "    def __post_init__(self):\n"
        "        assert self.price > 0, 'a price of 0'\n"
        "BUILD = replace(CIRCLE, build=build)\n"
        "NONE = replace(CIRCLE, build=lambda config, device: None)\n"
        "LATE = replace(CIRCLE, build=late)\n"
        "OWN = replace(CIRCLE, config=Own())\n"
    )
    (installed / "my_tasks" / "raising.py").write_text("X = 1\nY = X / 0\n")
    (installed / "my_tasks" / "unfinished.py").write_text("X = 1\n\ndef f(:\n")
    (installed / "my_tasks-1.0.dist-info" / "entry_points.txt").write_text(
        "[surgisoft.tasks]\n"
        + "".join(f"{n} = my_tasks.faulty:{n.upper()}\n" for n in ("build", "none", "late", "own"))
        + "raising = my_tasks.raising:X\nunfinished = my_tasks.unfinished:X\n"
    )
    importlib.invalidate_caches()
    yield installed
    for name in ("faulty", "raising", "unfinished"):
        sys.modules.pop(f"my_tasks.{name}", None)


FAULTY = {
    "train --task build -o x": "task 'build': raised KeyError in faulty.py line 6: 'gain'; correct",
    "evaluate scripted --task build": "task 'build': raised KeyError in faulty.py line 6: 'gain'",
    "run scripted --task build -o x": "task 'build': raised KeyError in faulty.py line 6: 'gain'",
    "evaluate scripted --task none": "task 'none': what builds it returns a NoneType, expected a",
    "evaluate scripted --task late --episodes 1": "raised RuntimeError in faulty.py line 11: no su",
    "train --task late --steps 512 --envs 32 -o x": "raised RuntimeError in faulty.py line 11: no",
    "train --task own price=-1.0 -o x": "raised AssertionError in faulty.py line 18: a price of 0",
    "train --task raising -o x": "does not load (ZeroDivisionError in raising.py line 2: division",
    "train --task unfinished -o x": "does not load (SyntaxError in unfinished.py line 3: invalid",
}
"""Commands on tasks whose code raises -> what they print."""


@pytest.mark.parametrize("command", FAULTY)
def test_a_task_that_raises_is_one_line_with_its_file(
    command, faulty, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert run(command.split()) == 2
    told = capsys.readouterr().err
    assert FAULTY[command] in told
    assert told.count("\n") == 1
    assert not Path("x").exists()


def test_an_exception_of_this_package_keeps_its_traceback(monkeypatch):
    """No code of the user's takes part in it: here a limit that is no number."""
    monkeypatch.setattr("surgisoft.tasks.registry.MOST_STEPS", None)
    with pytest.raises(TypeError):
        run(["evaluate", "scripted", "--task", "track_circle"])


def test_an_exception_of_a_study_of_the_project_keeps_its_traceback(monkeypatch, tmp_path):
    """A study lies beside the package."""
    monkeypatch.setattr("benchmarks.setup_faults.workers", None)
    with pytest.raises(TypeError):
        run(["benchmark", "setup-faults", "--work", str(tmp_path)])
