"""Training: reproducible, resumable without loss, opened from its folder alone; and it learns."""

import json
import os
import shutil
import signal
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from rsl_rl.algorithms import PPO

from surgisoft.agents import selection, training
from surgisoft.agents.compiled_network import CompiledNetwork
from surgisoft.agents.distributed import Processes
from surgisoft.agents.learned import LearnedPolicy
from surgisoft.agents.policies import Random
from surgisoft.agents.ppo import (
    algorithm_config,
    collect_rollout,
    make_ppo,
    set_noise,
    update,
)
from surgisoft.agents.presets import PRESETS, Plan, Preset, config_for, envs_for, preset_for
from surgisoft.agents.rollout import Rollout
from surgisoft.agents.run_folder import BEST, LAST, RunFolder
from surgisoft.agents.selection import SEED, evaluate_checkpoint, is_better
from surgisoft.agents.session import EvaluationRequest
from surgisoft.agents.shared_ppo import SharedPPO
from surgisoft.agents.training import Clock, Training, resume, train_new
from surgisoft.agents.training_request import TrainingRequest
from surgisoft.agents.vec_env import STATE, JointEnv
from surgisoft.cli import run as command
from surgisoft.errors import AssumptionWarning, InputError
from surgisoft.tasks.registry import config_of, make_task, with_fields

CPU = torch.device("cpu")
TINY = Preset(envs=8, rollout=8, epochs=2, batches=2, evaluate_every=2, evaluation_episodes=2)


def short(config):
    """A configuration of a path task whose episodes end after 25 steps, within a training."""
    return with_fields(config, loop_s=2.0, approach_s=0.5)


def plan_of(task="track_circle", turns=4, preset=TINY, **changes):
    steps = turns * preset.envs * preset.rollout
    config = config_of(task)
    config = short(config) if task == "track_circle" else config
    return Plan(task, config, "fast", preset, steps, **changes)


def trained(folder, plan):
    result = train_new(folder, plan, Processes(), CPU)
    assert result.done
    return RunFolder(folder)


def weights(run, which=LAST):
    saved = run.load(which)["agents"]
    return {
        (agent, network, name): value
        for agent, networks in saved.items()
        for network in ("actor_state_dict", "critic_state_dict")
        for name, value in networks[network].items()
    }


def assert_equal(one, other):
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert torch.equal(value, other[key]), key


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs") / "one", plan_of())


def test_same_seed_same_weights_other_seed_others(run, tmp_path):
    assert_equal(weights(run), weights(trained(tmp_path / "again", plan_of())))
    other = weights(trained(tmp_path / "other", plan_of(seed=1)))
    assert not all(torch.equal(value, other[key]) for key, value in weights(run).items())


def test_resumed_is_uninterrupted(run, tmp_path):
    """Stopped in the middle, reopened, finished: weights, episodes and records are the same."""
    half, count = tmp_path / "half", 0

    def stop_after_two(progress):
        nonlocal count
        count += 1
        if count == 2:
            os.kill(os.getpid(), signal.SIGINT)

    result = train_new(half, plan_of(), Processes(), CPU, stop_after_two)
    assert not result.done
    assert RunFolder(half).load(LAST)["iteration"] == 3, "the turn in which it was asked to stop"
    torch.manual_seed(99)
    assert resume(half, Processes(), CPU).done
    assert_equal(weights(run), weights(RunFolder(half)))
    saved, again = (RunFolder(path).load(LAST) for path in (run.path, half))
    for one, other in zip(saved["processes"], again["processes"], strict=True):
        assert all(map(torch.equal, one["world"], other["world"]))
        assert torch.equal(one["random"]["cpu"], other["random"]["cpu"])
    assert saved["best"] == again["best"]
    rows = [
        [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
        for path in (run.path, half)
    ]
    assert [row["iteration"] for row in rows[1]] == [1, 2, 3, 4]
    for one, other in zip(*rows, strict=True):
        assert one["reward/arm"] == other["reward/arm"]
        assert one.get("evaluation/error_mm") == other.get("evaluation/error_mm")


@pytest.mark.parametrize(("limit", "turns"), [(1e9, 2), (1e-9, 4)])
def test_training_ends_with_the_evaluation_whose_error_is_low_enough(limit, turns, tmp_path):
    """`--target-error`; in a thread, as a notebook's, which sets no handlers of signals."""
    before = signal.getsignal(signal.SIGINT)
    found = []
    plan = plan_of(target_error=limit)
    thread = threading.Thread(
        target=lambda: found.append(train_new(tmp_path / "run", plan, Processes(), CPU))
    )
    thread.start()
    thread.join()
    assert found[0].done
    assert found[0].steps == turns * TINY.envs * TINY.rollout
    assert RunFolder(tmp_path / "run").load(LAST)["iteration"] == turns
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(("success", "turns"), [(1.0, 2), (0.9, 4)])
def test_a_low_error_ends_training_only_where_every_episode_succeeds(
    success, turns, tmp_path, monkeypatch
):
    def succeeding(*given):
        found, log = evaluate_checkpoint(*given)
        return found | {"success": success}, log

    monkeypatch.setattr("surgisoft.agents.training.evaluate_checkpoint", succeeding)
    found = train_new(tmp_path / "run", plan_of(target_error=1e9), Processes(), CPU)
    assert found.steps == turns * TINY.envs * TINY.rollout


def test_a_second_ctrl_c_ends_training_at_once(tmp_path):
    before = signal.getsignal(signal.SIGINT)

    def impatient(progress):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train_new(tmp_path / "run", plan_of(), Processes(), CPU, impatient)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_kill_between_checkpoints_loses_nothing(run, tmp_path):
    """As kill -9 leaves it: an old checkpoint, and records of turns that came after it."""
    killed, first = tmp_path / "killed", {}

    def keep_the_first(progress):
        if progress.steps == 3 * TINY.envs * TINY.rollout:
            shutil.copy2(killed / "checkpoints" / "last.pt", tmp_path / "old.pt")
            first["rows"] = (killed / "metrics.jsonl").read_text()

    train_new(killed, plan_of(), Processes(), CPU, keep_the_first)
    shutil.copy2(tmp_path / "old.pt", killed / "checkpoints" / "last.pt")
    (killed / "metrics.jsonl").write_text(first["rows"] + '{"iteration": 4, "st')
    assert len(first["rows"].splitlines()) == 3
    assert RunFolder(killed).load(LAST)["iteration"] == 2
    assert resume(killed, Processes(), CPU).done
    assert_equal(weights(run), weights(RunFolder(killed)))
    rows = [json.loads(row) for row in (killed / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]


def test_a_run_whose_checkpoint_was_lost_is_refused_and_keeps_its_records(run, tmp_path):
    """By its records: the second of four iterations was evaluated, after which it was saved."""
    lost = tmp_path / "lost"
    shutil.copytree(run.path, lost)
    for checkpoint in (lost / "checkpoints").iterdir():
        checkpoint.unlink()
    before = {path: path.read_bytes() for path in lost.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"last\.pt: there is no such checkpoint, but .* has 4 it"):
        resume(lost, Processes(), CPU)
    assert {path: path.read_bytes() for path in lost.rglob("*") if path.is_file()} == before
    row = {"iteration": 1, "wall_s": 61.0}
    (lost / "metrics.jsonl").write_text(f"{json.dumps(row)}\n{json.dumps(row)}\n")
    with pytest.raises(InputError, match="has 1 iteration; put the file back, or train again"):
        resume(lost, Processes(), CPU)


def test_a_run_killed_before_its_first_checkpoint_begins_again_and_says_so(run, tmp_path):
    """Also between the record of the first evaluation and the checkpoint after it."""
    killed = tmp_path / "killed"
    shutil.copytree(run.path, killed)
    (killed / "checkpoints" / "last.pt").unlink()
    rows = (killed / "metrics.jsonl").read_text().splitlines(keepends=True)
    (killed / "metrics.jsonl").write_text("".join(rows[:2]) + "[3]\nhalf")
    with pytest.warns(AssumptionWarning, match="there is no checkpoint yet; the training begins"):
        assert resume(killed, Processes(), CPU).done
    assert_equal(weights(run), weights(RunFolder(killed)))


def test_a_finished_run_that_is_resumed_stays_as_it_is(run, tmp_path):
    done = tmp_path / "done"
    shutil.copytree(run.path, done)
    before = {path: path.read_bytes() for path in done.rglob("*") if path.is_file()}
    assert resume(done, Processes(), CPU).updates == 0
    assert {path: path.read_bytes() for path in done.rglob("*") if path.is_file()} == before


def test_a_kill_while_a_run_is_reopened_keeps_its_records(run, tmp_path, monkeypatch):
    """Whatever writes the records ends before its last byte; the earlier ones are still there."""
    killed = tmp_path / "killed"
    shutil.copytree(run.path, killed)
    config = json.loads((killed / "config.json").read_text())
    (killed / "config.json").write_text(json.dumps(config | {"steps": 2 * config["steps"]}))
    before = (killed / "metrics.jsonl").read_bytes()
    assert len(before.splitlines()) == 4

    def cut(file, content, *given, **named):
        file.open("w").close()
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_text", cut)
    monkeypatch.setattr(Path, "write_bytes", cut)
    with pytest.raises(KeyboardInterrupt):
        resume(killed, Processes(), CPU)
    assert (killed / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize("name", [*PRESETS, "normalised"])
def test_every_preset_goes_on_as_if_uninterrupted(name, tmp_path):
    """Also what only some presets have: observers, learned noise, running normalisers."""
    small = {"envs": 4, "rollout": 4, "epochs": 1, "batches": 2, "hidden": (8,)}
    preset = PRESETS.get(name, Preset(normalise=True, last_noise=None))
    preset = replace(preset, **small, evaluate_every=1, evaluation_episodes=1)
    config = config_for(name, short(config_of("track_circle")))
    whole, cut = tmp_path / "whole", tmp_path / "cut"

    def cut_after_one(progress):
        if progress.steps == 32:  # the second of three iterations: its checkpoint comes later
            shutil.copytree(whole, cut)

    plan = Plan("track_circle", config, "fast", preset, steps=48)
    assert train_new(whole, plan, Processes(), CPU, cut_after_one).done
    assert RunFolder(cut).load(LAST)["iteration"] == 1
    torch.manual_seed(99)
    assert resume(cut, Processes(), CPU).done
    one, other = (RunFolder(path).load(LAST) for path in (whole, cut))
    assert one["iteration"] == other["iteration"] == 3
    for part in ("agents", "processes", "best"):
        assert same(one[part], other[part]), part
    if name == "normalised":
        count = [v for k, v in leaves(one["agents"]) if "count" in k and "normalizer" in k]
        assert count
        assert all(value > 0 for value in count)


def leaves(tree, path=""):
    """(path, value) of everything in nested tables and lists."""
    if isinstance(tree, dict | list | tuple):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        return [leaf for key, part in pairs for leaf in leaves(part, f"{path}/{key}")]
    return [(path, tree)]


def same(one, other):
    """Whether two trees have the same leaves, every bit."""
    pairs = list(zip(leaves(one), leaves(other), strict=True))
    return bool(pairs) and all(
        a == b and (torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y)
        for (a, x), (b, y) in pairs
    )


def test_a_finished_run_stays_as_it_is(run):
    before = weights(run)
    found = resume(run.path, Processes(), CPU)
    assert (found.done, found.updates) == (True, 0)
    assert_equal(before, weights(run))


def test_a_run_without_a_schedule_goes_on_to_more_steps_as_if_it_had_had_them(tmp_path):
    """Weights, random numbers and episodes are the same to the bit."""
    free = replace(TINY, last_noise=None)
    whole = trained(tmp_path / "whole", plan_of(preset=free))
    part = trained(tmp_path / "part", plan_of(turns=2, preset=free))
    before = (part.path / "config.json").read_bytes()
    for steps, said in ((128, "--steps is 128, and .* started with 128"), (64, "expected more")):
        with pytest.raises(InputError, match=said):
            resume(part.path, Processes(), CPU, steps=steps)
    assert (part.path / "config.json").read_bytes() == before
    found = resume(part.path, Processes(), CPU, steps=256)
    assert (found.done, found.updates, found.steps) == (True, 2, 256)
    saved, longer = (RunFolder(run.path).load(LAST) for run in (whole, part))
    for one in (saved, longer):
        del one["wall_s"], one["cpu_s"]
    assert same(saved, longer)
    assert RunFolder(part.path).plan().steps == 256


def test_a_run_with_a_schedule_of_its_noise_is_not_made_longer(run):
    before = (run.path / "config.json").read_bytes()
    said = r"cannot go on to 9,999 steps.* --task track_circle --preset fast --seed 0 --steps 9999"
    with pytest.raises(InputError, match=said):
        resume(run.path, Processes(), CPU, steps=9999)
    assert (run.path / "config.json").read_bytes() == before


@pytest.fixture(scope="module")
def ablation():
    return make_task("circle_ablation")


def test_both_agents_learn_at_once(ablation):
    training = Training(plan_of("circle_ablation"), ablation, Processes())
    before = {
        agent: [value.clone() for value in ppo.actor.parameters()]
        for agent, ppo in training.agents.items()
    }
    assert set(training.agents) == {"laser", "endoscope"}
    widths = {agent: ppo.actor.obs_dim for agent, ppo in training.agents.items()}
    for agent, ppo in training.agents.items():
        assert widths[agent] == training.seen[agent].shape[1]
        assert ppo.critic.obs_dim == sum(widths.values()), "the critic sees the joint state"
    turn = training.iterate()
    assert set(turn.gathered.rewards) == {"laser", "endoscope"}
    for agent, ppo in training.agents.items():
        pairs = zip(before[agent], ppo.actor.parameters(), strict=True)
        assert not all(torch.equal(one, other) for one, other in pairs), agent


def test_a_run_opens_from_its_folder_alone(ablation, tmp_path):
    """Moved elsewhere it finds its own scene and arm models, and does what it did."""
    preset = replace(TINY, envs=2, rollout=4, evaluate_every=100, evaluation_episodes=1)
    config = with_fields(config_of("circle_ablation"), view_points=5, dt_s=1.0)
    plan = replace(plan_of("circle_ablation", 1, preset), task_config=config)
    made = trained(tmp_path / "a", plan)
    moved = tmp_path / "elsewhere" / "b"
    shutil.move(made.path, moved)
    run = RunFolder(moved)
    again = run.task()
    assert str(again.config.scene).startswith(str(moved))
    assert again.config.world.scene_engine.view_points == 5
    assert again.scene.spec.lesion == ablation.scene.spec.lesion
    for name, arm in ablation.world.arms.items():
        own = again.world.arms[name].model.state_dict()
        for key, value in arm.model.state_dict().items():
            assert torch.equal(value, own[key])
    found, _ = evaluate_checkpoint(again, LearnedPolicy(moved, again), 1)
    assert found == pytest.approx(run.load(BEST)["evaluation"], nan_ok=True)


def test_the_best_checkpoint_is_the_best_by_evaluation(run):
    rows = [json.loads(row) for row in (run.path / "metrics.jsonl").read_text().splitlines()]
    found = {row["iteration"]: row["evaluation/error_mm"] for row in rows
             if "evaluation/error_mm" in row}  # fmt: skip
    assert list(found) == [2, 4]
    best = run.load(BEST)
    assert best["iteration"] == min(found, key=found.get)
    task = run.task()
    best, _ = evaluate_checkpoint(task, LearnedPolicy(run.path, task, "best"), 2)
    assert best["error_mm"] == min(found.values())
    assert (
        evaluate_checkpoint(task, LearnedPolicy(run.path, task, "last"), 2)[0]["error_mm"]
        == found[4]
    )


def test_success_counts_before_error():
    assert is_better({"success": 1.0, "error_mm": 0.5}, {"success": 0.9, "error_mm": 0.1})
    assert not is_better({"success": 0.9, "error_mm": 0.1}, {"success": 1.0, "error_mm": 0.5})
    assert is_better({"error_mm": 0.1}, {"error_mm": 0.2})
    assert not is_better({"error_mm": float("nan")}, {"error_mm": 0.2})
    assert is_better({"error_mm": 0.1}, None)


def test_it_learns(tmp_path):
    """A minute's share of real training: far better than random actions, and than none."""
    preset = preset_for(
        "fast",
        "track_circle",
        envs=64,
        epochs=5,
        last_noise=0.2,
        evaluate_every=1000,
        evaluation_episodes=8,
    )
    plan = Plan("track_circle", config_of("track_circle"), "fast", preset, steps=20_000)
    run = trained(tmp_path / "learns", plan)
    learned = run.load(BEST)["evaluation"]["error_mm"]
    random = evaluate_checkpoint(run.task(), Random(), 8)[0]["error_mm"]
    assert random > 10.0
    assert learned < 0.1 * random


def test_paper_preset_is_the_papers():
    """Chen et al. (2025, sec. IV-A)."""
    paper = PRESETS["paper"]
    assert paper.envs * paper.rollout == 4096
    assert (paper.gamma, paper.lam, paper.entropy, paper.clip) == (0.99, 0.95, 0.01, 0.2)
    assert paper.hidden == (64, 64)


def test_bad_folders_and_policies_are_refused(run, ablation, tmp_path):
    with pytest.raises(InputError, match="already exists"):
        train_new(run.path, plan_of(), Processes(), CPU)
    with pytest.raises(InputError, match="no training run"):
        RunFolder(tmp_path)
    with pytest.raises(InputError, match="trained on track_circle"):
        LearnedPolicy(run.path, ablation)
    with pytest.raises(InputError, match="unknown checkpoint"):
        LearnedPolicy(run.path, which="first")
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy)
    (copy / "checkpoints" / "last.pt").write_bytes(b"nothing")
    with pytest.raises(InputError, match="damaged checkpoint"):
        resume(copy, Processes(), CPU)


def test_opening_a_checkpoint_runs_no_code(run, tmp_path):
    copy, mark = tmp_path / "evil", tmp_path / "mark"
    shutil.copytree(run.path, copy)

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(mark),)

    torch.save({"iteration": 1, "agents": Evil()}, copy / "checkpoints" / "best.pt")
    with pytest.raises(InputError, match="damaged"):
        LearnedPolicy(copy)
    assert not mark.exists()


def test_damaged_folders_are_one_line(run, tmp_path):
    """Cases that `python -m benchmarks.fuzz` found; each is tried on a whole folder."""
    copy = tmp_path / "run"
    shutil.copytree(run.path, copy)
    config = json.loads((copy / "config.json").read_text())

    def refused(said, call=resume, **fields):
        (copy / "config.json").write_text(json.dumps(config | fields))
        with pytest.raises(InputError, match=said):
            call(copy, Processes(), CPU) if call is resume else call(copy)
        (copy / "config.json").write_text(json.dumps(config))

    numbers = config["hyper_parameters"]
    refused("hidden", hyper_parameters=numbers | {"hidden": [10**9]})
    refused("more than", hyper_parameters=numbers | {"rollout": 10**6})
    refused("activation", hyper_parameters=numbers | {"activation": "ta h"})
    refused("unknown field", hyper_parameters=numbers | {"new": 1})
    refused("8 episodes, expected 16", hyper_parameters=numbers | {"envs": 16})
    refused("seed: got text '1'", seed="1")
    refused("task_config", task_config=[])
    wide = {agent: size | {"observation": 10**7} for agent, size in config["agents"].items()}
    refused("expected .*10000000", call=LearnedPolicy, agents=wide)
    refused("observation", call=LearnedPolicy, agents={"arm": {"observation": "x"}})
    (copy / "config.json").write_text("[" * 10**5)
    with pytest.raises(InputError, match="nested too deeply"):
        RunFolder(copy)


@pytest.mark.parametrize(
    ("which", "path", "value", "said"),
    [
        (BEST, ("agents", "arm", "mlp.0.bias"), torch.full((64,), torch.nan), "NaN or infinite"),
        (BEST, ("agents", "arm", "mlp.0.bias"), torch.zeros(1, 64), r"\[1, 64\] numbers"),
        (BEST, ("agents", "arm"), 3, "damaged checkpoint"),
        (BEST, ("agents",), None, "damaged checkpoint"),
        (LAST, ("processes", 0, "world", 0), torch.zeros(8, 7), "a part of the world has shape"),
        (LAST, ("processes", 0, "random", "cpu"), 5, "damaged checkpoint"),
        (LAST, ("processes",), 5, "damaged checkpoint"),
        (LAST, ("best",), [1], "damaged checkpoint"),
        (LAST, ("agents", "arm", "optimizer_state_dict", "param_groups"), [], "damaged checkpoint"),
    ],
)
def test_damaged_checkpoints_are_one_line(run, tmp_path, which, path, value, said):
    copy = tmp_path / "run"
    shutil.copytree(run.path, copy, ignore=shutil.ignore_patterns("replays", "tensorboard"))
    node = saved = RunFolder(copy).load(which)
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    RunFolder(copy).save(which, saved)
    with pytest.raises(InputError, match=said):
        LearnedPolicy(copy) if which == BEST else resume(copy, Processes(), CPU)


def test_rsl_rl_learns_with_the_presets_numbers():
    """Every number differs from every default, so that none can stand in for another."""
    preset = Preset(
        envs=6, rollout=5, epochs=3, batches=2, gamma=0.81, lam=0.73, clip=0.11, entropy=0.017,
        learning_rate=2.3e-4, desired_kl=0.019, hidden=(9,), activation="elu", noise=0.37,
    )  # fmt: skip
    env = JointEnv(make_task("track_circle"), preset.envs, 0, preset.action_kPa)
    (ppo,) = make_ppo(env, preset, Processes()).values()
    assert (ppo.num_learning_epochs, ppo.num_mini_batches) == (3, 2)
    assert (ppo.gamma, ppo.lam, ppo.clip_param) == (0.81, 0.73, 0.11)
    assert (ppo.entropy_coef, ppo.learning_rate, ppo.desired_kl) == (0.017, 2.3e-4, 0.019)
    assert ppo.schedule == "adaptive"
    assert ppo.optimizer.param_groups[0]["lr"] == 2.3e-4
    assert (
        algorithm_config("a", replace(preset, desired_kl=None), Processes())["algorithm"][
            "schedule"
        ]
        == "fixed"
    )
    policy = ppo.get_policy()
    assert policy.mlp[0].out_features == 9
    torch.testing.assert_close(policy.distribution.log_std_param.exp(), torch.full((3,), 0.37))


def test_critics_see_all_agents_and_actors_their_own():
    groups = algorithm_config("laser", TINY, Processes())["obs_groups"]
    assert groups == {"actor": ["laser"], "critic": [STATE]}


def test_noise_falls_evenly_in_its_logarithm():
    preset = replace(TINY, noise=0.4, last_noise=0.004)
    env = JointEnv(make_task("track_circle"), preset.envs, 0, preset.action_kPa)
    (ppo,) = make_ppo(env, preset, Processes()).values()
    for progress, noise in ((0.0, 0.4), (0.5, 0.04), (1.0, 0.004)):
        set_noise(ppo, preset, progress)
        found = ppo.get_policy().distribution.log_std_param.exp()
        torch.testing.assert_close(found, torch.full_like(found, noise))


def test_a_time_out_is_bootstrapped_and_an_end_is_not():
    """At a time-out rsl-rl adds gamma V(s) to the reward (Pardo et al. 2018), else nothing."""
    env = JointEnv(make_task("track_circle"), TINY.envs, 0, TINY.action_kPa)
    agents = make_ppo(env, TINY, Processes())
    (ppo,) = agents.values()
    step, marks = env.step, torch.arange(TINY.envs) % 2 == 0
    rewards = []

    def stepped(actions):
        seen, reward, done, extras = step(actions)
        rewards.append(reward["arm"].clone())
        return seen, reward, torch.ones_like(done), extras | {"time_outs": marks}

    env.step = stepped
    collect_rollout(env, agents, env.get_observations(), TINY.rollout)
    added = ppo.storage.rewards[:, :, 0] - torch.stack(rewards)
    torch.testing.assert_close(added, TINY.gamma * ppo.storage.values[:, :, 0] * marks)
    assert (added[:, marks] != 0.0).all()


def test_returns_and_advantages_of_a_rollout_by_hand():
    """Generalised advantages (Schulman et al. 2016, eq. 16) backwards from the critic's value of
    the last observations, an episode's end in between; normalised over the rollout."""
    preset = replace(TINY, gamma=0.8, lam=0.7)
    env = JointEnv(make_task("track_circle"), preset.envs, 0, preset.action_kPa)
    agents = make_ppo(env, preset, Processes())
    (ppo,) = agents.values()
    step, ends = env.step, torch.zeros(preset.envs, dtype=torch.bool)
    ends[1::3] = True
    count = []

    def stepped(actions):
        seen, reward, done, extras = step(actions)
        count.append(1)
        over = ends if len(count) == 5 else torch.zeros_like(done)
        return seen, reward, over, extras | {"time_outs": torch.zeros_like(over)}

    env.step = stepped
    seen, _ = collect_rollout(env, agents, env.get_observations(), preset.rollout)
    held = ppo.storage
    value, advantage = ppo.critic(seen).detach()[:, 0], torch.zeros(preset.envs)
    expected = []
    for t in reversed(range(preset.rollout)):
        goes_on = 1.0 - held.dones[t, :, 0].float()
        change = held.rewards[t, :, 0] + 0.8 * goes_on * value - held.values[t, :, 0]
        advantage = change + 0.8 * 0.7 * goes_on * advantage
        value = held.values[t, :, 0]
        expected.append(advantage + value)
    expected = torch.stack(expected[::-1])
    assert held.dones.sum() == ends.sum() > 1
    torch.testing.assert_close(held.returns[:, :, 0], expected, rtol=1e-4, atol=1e-5)
    raw = expected - held.values[:, :, 0]
    torch.testing.assert_close(
        held.advantages[:, :, 0], (raw - raw.mean()) / raw.std(), rtol=1e-3, atol=1e-4
    )


def test_means_of_a_rollout_leave_out_what_does_not_apply():
    """Four of 64 steps end an episode; a measure applies in every other one, another never."""
    env = JointEnv(make_task("track_circle"), TINY.envs, 0, TINY.action_kPa)
    agents = make_ppo(env, TINY, Processes())
    step, count = env.step, []
    half = torch.where(torch.arange(TINY.envs) % 2 == 0, 3.0, torch.nan)

    def stepped(actions):
        seen, _, _, extras = step(actions)
        count.append(1)
        over = (torch.arange(TINY.envs) < 4) & (len(count) == 3)
        measures = {"half": half, "never": torch.full_like(half, torch.nan)}
        terms = {"arm": {"one": torch.ones(TINY.envs), "two": 2.0 * torch.ones(TINY.envs)}}
        return seen, {"arm": 3.0 + half.nan_to_num()}, over, extras | {
            "measures": measures, "terms": terms
        }  # fmt: skip

    env.step = stepped
    _, found = collect_rollout(env, agents, env.get_observations(), TINY.rollout)
    assert found.episodes == 4
    assert found.rewards == {"arm": pytest.approx(4.5)}
    assert found.terms == {"arm/one": 1.0, "arm/two": 2.0}
    assert found.measures == {"half": 3.0, "never": pytest.approx(float("nan"), nan_ok=True)}


def test_a_new_policy_asks_for_next_to_nothing():
    env = JointEnv(make_task("track_circle"), TINY.envs, 0, TINY.action_kPa)
    (ppo,) = make_ppo(env, TINY, Processes()).values()
    first = ppo.get_policy()(env.get_observations()).detach()
    assert 0.0 < first.abs().max() < 0.02


@pytest.mark.parametrize(
    ("steps", "minutes", "share"),
    [(100, 2.0, 0.75), (40, 2.0, 0.75), (20, 2.0, 1.0), (100, None, 0.3), (None, 2.0, 0.75)],
)
def test_a_training_ends_by_its_steps_or_by_its_minutes(steps, minutes, share):
    """30 steps in 90 s."""
    assert replace(plan_of(), steps=steps, minutes=minutes).share(30, 90.0) == pytest.approx(share)


def test_checkpoints_are_evaluated_as_they_act(tmp_path, monkeypatch):
    """With the preset's change of pressure for an output of 1, and the pumps' limit."""
    seen = []

    def evaluated(task, policy, episodes):
        seen.append((policy.actors["arm"].scale, policy.actors["arm"].limit, episodes))
        return {"error_mm": 1.0}, None

    monkeypatch.setattr(training, "evaluate_checkpoint", evaluated)
    monkeypatch.setattr(training, "save_episode", lambda log, path: None)
    plan = plan_of(turns=1, preset=replace(TINY, action_kPa=0.3))
    trained(tmp_path / "run", plan)
    limit = make_task(plan.task).world.arms["arm"].pneumatics.step_kPa
    assert seen == [(0.3, limit, TINY.evaluation_episodes)]


def test_the_better_checkpoint_is_kept():
    one = {"success": 0.5, "error_mm": 0.1}
    assert is_better(one, None)
    assert is_better({"success": 0.6, "error_mm": 9.0}, one), "success comes first"
    assert not is_better({"success": 0.4, "error_mm": 0.0}, one)
    assert is_better({"success": 0.5, "error_mm": 0.09}, one)
    assert not is_better(one, one)
    assert not is_better({"success": 0.5, "error_mm": float("nan")}, one)


def test_without_success_and_error_the_larger_return_is_better():
    one = {"passes": 3.0, "mean_return": -2.0}
    assert is_better({"passes": 1.0, "mean_return": -1.0}, one)
    assert not is_better({"passes": 9.0, "mean_return": -3.0}, one)
    assert not is_better({"passes": 9.0, "mean_return": float("nan")}, one)
    assert not is_better({"error_mm": 2.0, "mean_return": 9.0}, {"error_mm": 1.0})


def test_an_evaluation_is_means_over_episodes_of_the_right_steps(monkeypatch):
    """Two episodes of three and two steps: an error counts in every step, success at the end, the
    least clearance and any contact."""
    nan = float("nan")
    table = {
        "beam_error_mm": [[3.0, 4.0, nan], [nan, 1.0, nan]],
        "tissue_error_mm": [[5.0, 7.0, nan], [nan, 9.0, nan]],
        "success": [[1.0, 0.0, 1.0], [1.0, 0.0, nan]],
        "completion": [[0.2, 0.5, 0.7], [0.1, 0.3, nan]],
        "visited": [[0.0, 0.5, 1.0], [0.0, 0.5, nan]],
        "clearance_mm": [[1.0, 2.0, 3.0], [5.0, 5.0, nan]],
        "collided": [[0.0, 0.0, 0.0], [0.0, 1.0, nan]],
        "view_fraction": [[1.0, 1.0, 0.0], [0.5, 0.0, nan]],
    }
    over = torch.tensor([False, True])
    measures = {name: torch.tensor(value) for name, value in table.items()}
    played = Rollout("x", 0.1, torch.tensor([3, 2]), {}, over, ~over, measures)
    monkeypatch.setattr(selection, "rollout", lambda *given, watch: played)
    recorders = SimpleNamespace(log=lambda episode: episode)
    monkeypatch.setattr(selection, "EpisodeRecorders", lambda *given, only: recorders)
    found, first = evaluate_checkpoint(make_task("track_circle"), Random(), 2)
    assert first == 0
    assert found == pytest.approx(
        {
            "error_mm": 8.0 / 3.0,
            "tissue_error_mm": 7.0,
            "success": 0.5,
            "completion": 0.5,
            "visited": 0.75,
            "clearance_mm": 3.0,
            "collided": 0.5,
            "view_fraction": 0.5,
        }
    )


def test_a_training_that_goes_on_knows_its_time_its_best_and_its_rate():
    """A minute of two: half of it is done, and what was best stays the measure."""
    plan = replace(plan_of(), steps=None, minutes=2.0)
    task = make_task(plan.task, plan.task_config)
    one, other = (Training(plan, task, Processes()) for _ in range(2))
    one.best, one.clock = {"error_mm": 0.25, "success": 1.0}, Clock(60.0, 30.0)
    one.agents["arm"].learning_rate = 1e-4
    other.load_state(one.state())
    assert other.agents["arm"].learning_rate == 1e-4
    assert other.best == one.best
    assert (other.clock.wall_s, other.clock.cpu_s, other.share) == (60.0, 30.0, 0.5)


def test_each_process_has_episodes_and_noise_of_its_own(monkeypatch):
    """One policy for all: the leader's weights are sent, before anything is drawn."""
    sent = []
    monkeypatch.setattr(torch.distributed, "broadcast", lambda tensor, src: sent.append(src))
    plan, found = plan_of(), []
    for rank in (0, 1):
        training = Training(plan, make_task(plan.task, plan.task_config), Processes(rank, 2))
        training.iteration = 3
        assert training.steps == 2 * 3 * TINY.envs * TINY.rollout
        found.append((training.env.state.world, torch.rand(4)))
        (ppo,) = training.agents.values()
        weights = [*ppo.actor.state_dict(), *ppo.critic.state_dict()]
        assert sent == [0] * len(weights)
        sent.clear()
    (one, noise), (other, other_noise) = found
    assert not set(one.stream.key.tolist()) & set(other.stream.key.tolist())
    assert not torch.equal(one.steps, other.steps)
    assert not torch.equal(noise, other_noise)


def test_the_seed_that_selects_judges_nothing():
    """No default and no small seed, as users give them, is that of the selection."""
    used = {
        TrainingRequest("track_circle").seed,
        EvaluationRequest(("random",), "x").under_rules().seed,
    }
    assert used == {0}
    assert SEED > 10_000


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_seed_that_no_generator_takes_is_refused_before_the_folder_is_made(
    seed, tmp_path, capsys
):
    given = ["task=track_circle", f"seed={seed}", "steps=1000", "envs=64"]
    assert command(["train", *given, "-o", str(tmp_path / "run")]) == 2
    assert "seed" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_weights_of_a_new_training_follow_from_its_seed():
    """The first weights alone, before any episode of the seed is seen."""

    def first(seed):
        plan = plan_of(seed=seed)
        (ppo,) = Training(plan, make_task(plan.task, plan.task_config), Processes()).agents.values()
        return ppo.get_policy().mlp[0].weight.detach()

    assert torch.equal(first(3), first(3))
    assert not torch.equal(first(3), first(4))


def test_privileged_observations_reach_critics_and_never_actors():
    """Whatever the simulation knows besides changes the critic's value, and no action."""
    task = make_task("track_circle", config_for("robust", config_of("track_circle")))
    env = JointEnv(task, 4, 0, 1.0, privileged=True)
    (ppo,) = make_ppo(env, replace(TINY, envs=4), Processes()).values()
    seen = env.get_observations()
    wide = seen["arm"].shape[1]
    other = seen.clone()
    assert other[STATE].shape[1] > wide
    other[STATE][:, wide:] += 1.0
    assert torch.equal(ppo.actor(seen), ppo.actor(other))
    assert not torch.allclose(ppo.critic(seen), ppo.critic(other))


@pytest.mark.parametrize(
    ("steps", "envs"),
    [(8_000_000, 1024), (4_000_000, 1024), (3_999_999, 512), (1_000_000, 256), (100, 64)],
)
def test_a_short_training_keeps_its_updates_by_fewer_episodes(steps, envs):
    """The path tasks' own training is 4 M steps of 1024 episodes."""
    assert TrainingRequest("track_circle", steps=steps).plan().preset.envs == envs
    named = TrainingRequest("track_circle", steps=steps, envs=1000).plan()
    assert named.preset.envs == 1000
    assert envs_for("paper", "track_circle", steps) == PRESETS["paper"].envs


def test_a_training_by_the_clock_has_the_usual_episodes():
    assert TrainingRequest("track_circle", minutes=1.0).plan().preset.envs == 1024


@pytest.mark.parametrize("rank", [0, 1])
@pytest.mark.parametrize("desired_kl", [0.01, 1e-5, None])
def test_processes_that_talk_once_learn_as_rsl_rl_does(rank, desired_kl, monkeypatch):
    """Two processes that see the same, in place of which every sum is twice this one's part."""
    reductions = []

    def all_reduce(tensor, op):
        reductions.append(tensor.numel())
        tensor.mul_(2.0)

    monkeypatch.setattr(torch.distributed, "all_reduce", all_reduce)
    monkeypatch.setattr(torch.distributed, "broadcast", lambda tensor, src: None)
    preset = replace(TINY, desired_kl=desired_kl, last_noise=None)
    found = []
    for number, kind in ((0, PPO), (rank, SharedPPO)):
        torch.manual_seed(0)
        env = JointEnv(make_task("track_circle"), preset.envs, 0, preset.action_kPa)
        processes = Processes(number, 2)
        monkeypatch.setattr("surgisoft.agents.ppo.class_of", lambda _, kind=kind: kind)
        agents = make_ppo(env, preset, processes)
        (ppo,) = agents.values()
        assert type(ppo) is kind
        seen, rates = env.get_observations(), []
        for _ in range(3):
            seen, _ = collect_rollout(env, agents, seen, preset.rollout)
            reductions.clear()
            ppo.update()
            rates.append(ppo.learning_rate)
        weights = [
            each.detach().clone() for each in (*ppo.actor.parameters(), *ppo.critic.parameters())
        ]
        assert all(group["lr"] == rates[-1] for group in ppo.optimizer.param_groups)
        found.append((rates, weights, len(reductions)))
    (rates, weights, _), (shared_rates, shared_weights, exchanges) = found
    assert shared_rates == rates
    assert (len(set(rates)) > 1) == (desired_kl is not None)
    assert all(map(torch.equal, weights, shared_weights))
    assert exchanges == preset.epochs * preset.batches


def test_compiled_networks_learn_at_the_rates_of_plain_layers(monkeypatch):
    """A policy is at no distance from itself, although a row's sums depend on its batch."""
    preset = replace(TINY, envs=300, batches=3, desired_kl=1e-3)
    found = []
    for plain in (False, True):
        if plain:
            monkeypatch.setattr("surgisoft.agents.ppo.compile_network", lambda network: None)
        torch.manual_seed(0)
        env = JointEnv(make_task("track_circle"), preset.envs, 0, preset.action_kPa)
        agents = make_ppo(env, preset, Processes())
        (ppo,) = agents.values()
        assert isinstance(ppo.actor.mlp, CompiledNetwork) is not plain
        seen, rates = env.get_observations(), []
        for _ in range(3):
            seen, _ = collect_rollout(env, agents, seen, preset.rollout)
            update(ppo)
            rates.append(ppo.learning_rate)
        found.append((rates, [each.detach().clone() for each in ppo.actor.parameters()]))
    assert found[0][0] == found[1][0]
    assert len(set(found[0][0])) > 1
    for one, other in zip(found[0][1], found[1][1], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("last_noise", [0.005, None], ids=["scheduled noise", "learned noise"])
def test_a_training_that_diverges_ends_and_keeps_its_last_checkpoint(last_noise, tmp_path):
    """The fourth update is made with a rate by which weights are NaN after it."""
    plan = plan_of(preset=replace(TINY, desired_kl=None, last_noise=last_noise))
    folder = tmp_path / "run"

    def leap(progress):
        if progress.steps == 3 * TINY.envs * TINY.rollout:
            for ppo in learning:
                ppo.learning_rate = 1e38
                ppo.optimizer.param_groups[0]["lr"] = 1e38

    learning = []
    with pytest.MonkeyPatch.context() as patch:
        make = training.make_ppo

        def kept(*given):
            agents = make(*given)
            learning.extend(agents.values())
            return agents

        patch.setattr(training, "make_ppo", kept)
        with pytest.raises(InputError, match="diverged: after 256 steps the weights of arm"):
            train_new(folder, plan, Processes(), CPU, leap)
    assert RunFolder(folder).load(LAST)["iteration"] == 2
    assert all(value.isfinite().all() for value in weights(RunFolder(folder)).values())
    assert len((folder / "metrics.jsonl").read_text().splitlines()) == 3
