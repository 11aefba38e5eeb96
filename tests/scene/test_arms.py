"""Scenes with any number of arms: names, distances of every pair, beams, and mounts for all."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.scene.ablation import AblationMap
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.check import check_scene
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.dose_patch import cut_patch
from surgisoft.scene.folder import open_scene
from surgisoft.scene.meshio import write_ply
from surgisoft.scene.spec import SCENES, MountSpec, arm_names, save_spec
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.reach import blank_mounts
from surgisoft.tasks.world.world import WorldConfig, scene_world
from tests.scene.shapes import ball, box

TWO_LASERS = SCENES / "phantom_liver" / "two_lasers.toml"


@pytest.fixture(scope="module")
def scene():
    return open_scene(TWO_LASERS)


@pytest.fixture(scope="module")
def world(scene):
    return scene_world(scene)


def test_arms_have_their_tools_names_or_their_own():
    def mount(tool, name=""):
        return MountSpec(tool, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), name=name)

    assert arm_names((mount("laser"), mount("endoscope"))) == ("laser", "endoscope")
    three = (mount("laser"), mount("endoscope"), mount("laser", "left"), mount("laser"))
    assert arm_names(three) == ("laser_1", "endoscope", "left", "laser_3")
    tools = ["endoscope", *10 * ["laser"], "tip"]
    lasers = [f"laser_{k}" for k in range(1, 11)]
    assert list(blank_mounts(tools)) == [*lasers, "endoscope", "tip"]


def test_three_arms_are_as_far_apart_as_their_capsules():
    """Straight arms along x, y and z: the distance of two skew lines, less both radii, by hand."""
    lines = {
        "a": np.array([[-50.0, 0, 0], [50, 0, 0]]),  # along x
        "b": np.array([[10.0, -40, 30], [10, 40, 30]]),  # along y, 30 mm above
        "c": np.array([[0.0, 45, -20], [0, 45, 80]]),  # along z, 45 mm from a
    }
    radii = {"a": 5.0, "b": 4.0, "c": 3.0}
    by_hand = {
        ("a", "b"): 30.0 - 5.0 - 4.0,
        ("a", "c"): 45.0 - 5.0 - 3.0,
        ("b", "c"): np.hypot(10.0, 5.0) - 4.0 - 3.0,  # from b's end (10, 40, 30) to (0, 45, 30)
    }
    shapes = {name: ArmShape(line, radii[name]) for name, line in lines.items()}
    exact = CollisionChecker([]).clearance(shapes)
    assert exact.arms_mm == pytest.approx(by_hand, abs=1e-6)
    held = {name: torch.tensor(line)[None] for name, line in lines.items()}
    batched = BatchedScene([], radii).clearance(held).arms_mm[0]
    assert batched.tolist() == pytest.approx([*by_hand.values()], abs=1e-6)
    assert not CollisionChecker([]).collisions(shapes)
    lower = shapes | {"b": ArmShape(lines["b"] - [0.0, 0.0, 21.5], 4.0)}
    touching = CollisionChecker([]).collisions(lower)
    assert [(found.arm, found.other) for found in touching] == [("a", "b")]


def test_the_order_of_the_arms_in_the_file_changes_nothing(scene, world, tmp_path):
    for body in scene.spec.bodies:
        (tmp_path / body.mesh).write_bytes((scene.folder / body.mesh).read_bytes())
    mounts = scene.spec.mounts
    save_spec(
        replace(scene.spec, mounts=(mounts[2], mounts[1], mounts[0])), tmp_path / "scene.toml"
    )
    other = scene_world(tmp_path)
    assert list(other.arms) == list(world.arms) == ["laser_1", "laser_2", "endoscope"]
    one, two = world.start(streams(3, 2)), other.start(streams(3, 2))
    action = {name: torch.full((2, 3), 1.0) for name in world.arms}
    for _ in range(3):
        one, two = world.step(one, action, 20.0), other.step(two, action, 20.0)
    for name in world.arms:
        assert torch.equal(one.arms[name].points_mm, two.arms[name].points_mm)
    assert torch.equal(one.scene.clearance.arms_mm, two.scene.clearance.arms_mm)
    assert torch.equal(one.scene.dose.dose, two.scene.dose.dose)


@pytest.mark.parametrize("geometry", ["batched", "fcl"])
def test_the_body_of_one_laser_stops_the_beam_of_the_other(scene, world, geometry):
    config = WorldConfig(scene_engine=replace(world.config.scene_engine, geometry=geometry))
    engine = scene_world(scene, config).scene
    state = world.start(streams(0, 1))
    tip, target = state.arms["laser_1"].tip_mm, engine.centre_mm[None]
    aim = torch.nn.functional.normalize(target - tip, dim=1)
    first = replace(state.arms["laser_1"], tip_direction=aim)
    across = torch.nn.functional.normalize(torch.linalg.cross(aim, torch.eye(3)[:1]), dim=1)
    steps = torch.linspace(-60.0, 60.0, state.arms["laser_2"].line_mm.shape[1])[None, :, None]
    middle = 0.5 * (tip + target)
    second = replace(state.arms["laser_2"], line_mm=middle[:, None] + steps * across[:, None])
    free = engine.aimed(state.arms | {"laser_1": first}, "laser_1")
    assert free.on_organ.all()
    stopped = engine.aimed(state.arms | {"laser_1": first, "laser_2": second}, "laser_1")
    assert not stopped.on_organ.any()
    assert stopped.blocked.all()
    # the beam meets the skin of the other arm, 7.5 mm before its axis
    assert stopped.distance_mm.item() == pytest.approx((middle - tip).norm().item() - 7.5, abs=1e-3)


def test_doses_of_two_beams_add_up():
    """At one spot, at once or one after the other, two beams give the sum of what each gives."""
    turn = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    ring = np.stack((10 * np.cos(turn), 10 * np.sin(turn), 0 * turn + 5.0), axis=1)
    patch = cut_patch(
        box((60, 60, 10)), ring, np.tile([0, 0, 1.0], (240, 1)), np.array([0, 0, 5.0]), 0.25
    )
    ablation = AblationMap(patch, 0.4)
    here, there = torch.tensor([[10.0, 0.0, 5.0]]), torch.tensor([[10.0, 0.5, 5.0]])
    down, on = torch.tensor([[0.0, 0.0, -1.0]]), torch.ones(1, dtype=torch.bool)

    def alone(place, power):
        return ablation.advance(ablation.start(place, down, on), place, down, on, power, 0.1)

    def both(places, powers):
        at, aim, lit = (
            torch.stack(places, 1),
            torch.stack([down, down], 1),
            torch.stack([on, on], 1),
        )
        start = ablation.start(at, aim, lit)
        return ablation.advance(start, at, aim, lit, torch.tensor([powers]), 0.1)

    for places in ((here, here), (here, there)):
        together = both(places, [2.0, 3.0])
        apart = [alone(place, power) for place, power in zip(places, (2.0, 3.0), strict=True)]
        torch.testing.assert_close(together.dose, apart[0].dose + apart[1].dose)
        torch.testing.assert_close(together.zone_j, apart[0].zone_j + apart[1].zone_j)
        torch.testing.assert_close(together.delivered_j, torch.tensor([[0.2, 0.3]]))
        assert ablation.report(together).delivered_j.item() == pytest.approx(0.5)
    one = alone(here, 5.0)
    same = both((here, here), [2.0, 3.0])
    torch.testing.assert_close(same.dose, one.dose)
    torch.testing.assert_close(same.peak, one.peak)
    torch.testing.assert_close(same.band_mm2, one.band_mm2)


def test_each_laser_has_its_own_power_and_an_arm_without_agent_holds_still(scene):
    world = scene_world(scene, agents=("laser_1", "endoscope"))
    state = world.start(streams(1, 1))
    ends = {name: hit.point_mm for name, hit in state.scene.hits.items()}
    on = [bool(hit.on_organ) for hit in state.scene.hits.values()]
    held = state.arms["laser_2"].command
    actions = {name: torch.full((1, 3), 2.0) for name in ("laser_1", "endoscope")}
    after = world.step(state, actions, {"laser_1": 7.0})
    assert torch.equal(after.arms["laser_2"].command, held)
    assert not torch.equal(after.arms["laser_1"].command, state.arms["laser_1"].command)
    joules = after.scene.dose.delivered_j[0]
    now = bool(after.scene.hits["laser_1"].on_organ)
    assert joules.tolist() == pytest.approx([0.7 * 0.5 * (on[0] + now), 0.0])
    assert not torch.equal(after.scene.hits["laser_1"].point_mm, ends["laser_1"])
    with pytest.raises(InputError, match="no action for 'endoscope'"):
        world.step(state, {"laser_1": actions["laser_1"]})
    with pytest.raises(
        InputError, match="has the arms laser_1, laser_2, endoscope, expected laser,"
    ):
        scene_world(scene, agents=("laser", "endoscope"))


def test_a_scene_is_made_for_two_lasers_an_endoscope_and_a_tip(tmp_path, capsys):
    write_ply(ball(60.0, 3), tmp_path / "ball.ply")
    given = ("--unit", "mm", "--arms", "laser,endoscope,laser,tip")
    assert run(["scene", "new", str(tmp_path / "ball.ply"), "-o", str(tmp_path / "s"), *given]) == 0
    made = open_scene(tmp_path / "s")
    assert list(made.spec.arms) == ["laser_1", "laser_2", "endoscope", "tip"]
    verdicts, picture = [], tmp_path / "map.png"
    with pytest.MonkeyPatch.context() as patch:  # the command's own verdict

        def kept(*given):
            verdicts.append(check_scene(*given))
            return verdicts[-1]

        patch.setattr("surgisoft.scene.check.check_scene", kept)
        assert run(["scene", "check", str(tmp_path / "s"), "--map", str(picture)]) == 0
    assert picture.stat().st_size > 10_000
    (verdict,) = verdicts
    assert verdict.good
    assert verdict.work.covered == 1.0
    what = [finding.what for finding in verdict.findings]
    assert "ring in reach of laser_2" in what
    assert "tip at the lesion" in what
    # exactly, at the moments of the check: lasers on opposite points, tip at rest
    cuts, count = verdict.work.cuts, len(made.ring.points_mm)
    checker, worst = CollisionChecker(made.bodies), np.inf
    lines = {"endoscope": verdict.work.looks["endoscope"].line_mm}
    lines["tip"] = verdict.work.touches["tip"].way_mm[0]
    for k in range(0, count, 12):
        lines["laser_1"] = cuts["laser_1"].lines_mm[k]
        lines["laser_2"] = cuts["laser_2"].lines_mm[(k + count // 2) % count]
        shapes = {name: ArmShape(line, 7.5) for name, line in lines.items()}
        exact = checker.clearance(shapes)
        assert len(exact.arms_mm) == 6
        assert exact.least_mm == pytest.approx(verdict.work.clearance_mm[k], abs=1e-9)
        worst = min(worst, exact.least_mm)
    assert worst >= made.spec.limits.clearance_mm
    touch = verdict.work.touches["tip"].way_mm[-1, -1]
    assert np.linalg.norm(touch) == pytest.approx(60.0 + 7.5 + 1.5, abs=0.6)
    capsys.readouterr()
    assert run(["scene", "show", str(tmp_path / "s"), "--save", str(tmp_path / "s.rrd")]) == 0
