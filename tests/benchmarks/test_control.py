"""The control study: runs that are there are taken, and the tables say what was measured."""

import json
import shutil
import subprocess
import sys

import pytest

from benchmarks.control import policies, two_processes
from benchmarks.control import study as control
from benchmarks.control.policies import Cost, cost, evaluated, plan_of, trained
from benchmarks.control.study import ControlConfig, Evaluated, Results, Trained, run
from benchmarks.control.table import markdown
from benchmarks.control.two_processes import trained_by_two
from surgisoft.cli import run as surgisoft
from surgisoft.errors import InputError
from surgisoft.tasks.registry import config_of, with_fields

TINY = ControlConfig(("track_circle",), (4,), 2, 1, rate_steps=0, whole_steps=0)


def nothing(done, total, note=""):
    pass


@pytest.fixture(scope="module", autouse=True)
def brief():
    """Short episodes: circles in a fifth of their time, keyholes in a sixth."""
    short = {"track_circle": {"loop_s": 4.0}, "keyhole": {"time_s": 5.0}}

    def config(task):
        return with_fields(config_of(task), **short.get(task, {}))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policies, "config_of", config)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with one run of a few turns, trained elsewhere with its own number of steps."""
    place = tmp_path_factory.mktemp("runs")
    trained(place / "track_circle-seed-4", plan_of("track_circle", 4, 12288), nothing)
    return place


def test_a_run_that_is_there_is_taken_as_it_is(folder, monkeypatch):
    weights = (folder / "track_circle-seed-4" / "checkpoints" / "best.pt").read_bytes()
    first = run(TINY, folder, nothing)
    assert first.runs[0].cost.steps == 12288
    assert (folder / "track_circle-seed-4" / "checkpoints" / "best.pt").read_bytes() == weights
    shown = {(p.place, p.policy): p.numbers["error_mean_mm"]["mean"] for p in first.evaluated}
    assert len(shown) == 6
    assert shown["simulation", "scripted"] < 0.1 < shown["simulation", "learned, seed 4"]
    assert shown["rig", "scripted"] < 0.5 < shown["rig", "random"]
    monkeypatch.setattr(control, "evaluated", lambda *_: pytest.fail("evaluated again"))
    assert run(TINY, folder, nothing) == first


def test_a_run_of_another_task_is_refused(folder, tmp_path):
    (tmp_path / "laser_plane-seed-4").symlink_to(folder / "track_circle-seed-4")
    config = ControlConfig(("laser_plane",), (4,), 2, 1, rate_steps=0, whole_steps=0)
    with pytest.raises(InputError, match="was trained on track_circle, expected laser_plane"):
        run(config, tmp_path, nothing)


def test_another_plan_is_not_taken_for_the_wanted_one(folder):
    place = folder / "track_circle-seed-4"
    with pytest.raises(InputError, match="its seed: 4, expected 5"):
        trained(place, plan_of("track_circle", 5, 12288), nothing)
    with pytest.raises(InputError, match="its steps: 12288, expected 24576"):
        trained(place, plan_of("track_circle", 4, 24576), nothing)


def test_every_task_has_numbers_and_those_with_bodies_a_referee():
    """A task whose bodies meet no beam, and one with nothing around."""
    keyhole, circle = (evaluated(name, "scripted", 1, 0) for name in ("keyhole", "track_circle"))
    assert keyhole["collided"]["mean"] == 0.0
    assert 0.0 < keyhole["clearance_mm"]["mean"] < 20.0
    assert "collided" not in circle


def test_cost_is_that_of_the_last_turn(folder):
    run_folder = trained(folder / "track_circle-seed-4", plan_of("track_circle", 4, 12288), nothing)
    assert cost(run_folder).steps == 12288
    assert Cost(6000, 10.0, 3.0).steps_per_s == 2000.0


def _evaluated(task, place, policy, **means):
    numbers = {name: {"mean": v, "low": v, "high": v} for name, v in means.items()}
    return Evaluated(task, place, policy, numbers)


def test_goals_are_bold_where_they_are_reached_and_only_there():
    shown = (
        _evaluated("track_circle", "simulation", "learned, seed 1", error_mean_mm=0.005),
        _evaluated("track_circle", "simulation", "learned, seed 2", error_mean_mm=0.0051),
        _evaluated("track_circle", "simulation", "scripted", error_mean_mm=0.001),
        _evaluated("track_circle", "simulation", "random", error_mean_mm=30.0),
        _evaluated("circle_ablation", "simulation", "learned, seed 1", success=0.98, collided=0.0),
        _evaluated("circle_ablation", "simulation", "scripted", success=1.0, collided=0.01),
        _evaluated("circle_ablation", "simulation", "random", success=0.0, collided=1.0),
    )
    one = Trained("track_circle", 1, "fast", Cost(4_000_000, 400.0, 200.0), {"error_mm": 0.005})
    whole = Cost(20_000_000, 240.0, 230.0)
    results = Results((one,), shown, Cost(1_000_000, 2000.0, 1000.0), whole)
    text = markdown(results, ControlConfig(("track_circle", "circle_ablation")))
    assert "**0.005**, 0.0051 | **0.001** | 30 |" in text
    assert "success | >= 0.99 |  | 98.0% | **100.0%** | 0.0% |" in text
    assert "collided | <= 0 |  | **0.0%** | 1.0% | 100.0% |" in text
    # 20 M steps at 1,000 and 20,000 steps a second, and as two processes took them.
    assert "| paper | 1,000,000 steps of track_circle | 1,000 | 333.3 |" in text
    assert "| fast | 4,000,000 steps of track_circle | 20,000 | 16.7 |" in text
    assert "in 240 s of wall time, 4.0 minutes for 20,000,000" in text
    assert "5 minutes on two cores, which is reached" in text
    late = Results((one,), shown, results.paper, Cost(10_000_000, 151.0, 230.0))
    text = markdown(late, ControlConfig(("track_circle",)))
    assert "151 s of wall time, 5.0 minutes" in text
    assert "which is missed" in text


def test_two_processes_train_together_and_are_taken_once_they_are_done(tmp_path, monkeypatch):
    """In torchrun's place (tests/agents/test_train_command.py) one process trains, as its word
    is the same command; what it leaves says two."""
    place, told = tmp_path / "whole", []

    class Torchrun:
        def __init__(self, command, stdout, stderr):
            assert command[:3] == [sys.executable, "-m", "torch.distributed.run"]
            assert command[3:8] == ["--nproc-per-node", "2", "-m", "surgisoft", "train"]
            self.returncode = surgisoft(command[7:])
            about = json.loads((place / "config.json").read_text())
            (place / "config.json").write_text(json.dumps(about | {"processes": 2}))
            self.looks = 2

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def wait(self, seconds):
            self.looks, self.returncode = self.looks - 1, None if self.looks else 0
            if self.looks >= 0 and self.returncode is None:
                raise subprocess.TimeoutExpired("torchrun", seconds)

    monkeypatch.setattr(two_processes, "ENVS", 64)
    monkeypatch.setattr(two_processes.subprocess, "Popen", Torchrun)
    run_folder = trained_by_two(place, "track_circle", 2_000, lambda *seen: told.append(seen))
    assert run_folder.config["processes"] == 2
    assert [seen[:2] for seen in told] == [(2304, 2_000)] * 2  # three turns of 64 times 12
    assert cost(run_folder).steps == 2304
    monkeypatch.setattr(two_processes.subprocess, "Popen", lambda *a, **k: pytest.fail("again"))
    assert trained_by_two(place, "track_circle", 2_000, nothing).path == place
    with pytest.raises(InputError, match="track_circle by 2 processes, expected track_square by 2"):
        trained_by_two(place, "track_square", 2_000, nothing)


def test_two_processes_that_fail_say_where_to_look(tmp_path, monkeypatch):
    monkeypatch.setattr(two_processes.sys, "executable", shutil.which("false"))
    with pytest.raises(InputError, match=r"ended early, see .*whole\.log"):
        trained_by_two(tmp_path / "whole", "no_task", 100_000, nothing)
