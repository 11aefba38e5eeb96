"""The folder of a run holds all that it needs, and nothing of it lies elsewhere."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from surgisoft.agents.learned import agent_sizes
from surgisoft.agents.presets import Plan, Preset
from surgisoft.agents.run_folder import RunFolder, create_run, run_path
from surgisoft.config import to_table, write_toml
from surgisoft.scene.folder import open_scene
from surgisoft.scene.spec import FILE
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.tasks.registry import config_of, make_task, with_fields
from surgisoft.tasks.world.world import Mounted, World, named_arm

PHANTOM = Path(__file__).resolve().parents[2] / "scenes" / "phantom_liver"


@pytest.fixture
def stiffer(tmp_path):
    """Folder of an arm model that is not the package's: its rest pose is 1 mm longer."""
    model = default_arm()
    model.rest_mm = model.rest_mm + torch.tensor([0.0, 0.0, 1.0])
    save_model(model, tmp_path / "mine" / "arm")
    return tmp_path / "mine" / "arm"


def test_a_run_opens_with_its_own_copy_of_the_arm(stiffer, tmp_path):
    """The arm model that the training was given is gone when the run is opened."""
    config = with_fields(config_of("track_circle"), arm=str(stiffer))
    task = make_task("track_circle", config)
    plan = Plan("track_circle", config, "fast", Preset(), steps=100)
    run = create_run(tmp_path / "run", plan, task, agent_sizes(task), 1)
    shutil.rmtree(stiffer)
    again = RunFolder(run.path).task()
    rests = [each.world.arms["arm"].model.rest_mm for each in (task, again)]
    assert torch.equal(*rests)


def test_the_scene_of_a_run_mounts_the_arms_of_the_run(stiffer, tmp_path):
    """A scene names its arm models by paths, which lead elsewhere from the copy of the scene."""
    scene = tmp_path / "mine" / "scene"
    shutil.copytree(PHANTOM, scene)
    spec = open_scene(scene).spec
    mounts = tuple(replace(mount, arm="../arm") for mount in spec.mounts)
    write_toml(scene / FILE, to_table(replace(spec, mounts=mounts)))
    config = with_fields(config_of("circle_ablation"), scene=str(scene))
    plan = Plan("circle_ablation", config, "fast", Preset(), steps=100)
    given = load_model(stiffer)
    world = World({name: Mounted(given, torch.eye(4)) for name in spec.arms})
    run = create_run(tmp_path / "runs" / "run", plan, SimpleNamespace(world=world), {}, 1)
    shutil.rmtree(tmp_path / "mine")
    own = open_scene(run.path / "scene")
    assert list(own.spec.arms) == ["laser", "endoscope"]
    for mount in own.spec.mounts:
        model = named_arm(mount.arm, "cpu", own.folder)
        assert torch.equal(model.rest_mm, given.rest_mm)


def test_a_folder_of_that_name_comes_before_a_run_of_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (run_path("ring") / "config.json").is_file(), "of the package"
    (tmp_path / "ring").mkdir()
    assert run_path("ring") == Path("ring")
    assert run_path("runs/ring") == Path("runs/ring")
