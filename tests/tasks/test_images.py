"""The endoscope's image as an observation, by every interface."""

from copy import copy

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test
from scipy.spatial import cKDTree

import surgisoft
from surgisoft.agents.vec_env import JointEnv
from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.dose_patch import LESION
from surgisoft.scene.images import IMAGES, Label
from surgisoft.scene.render import SAMPLE_MM, Renderer, stained
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.registry import make_with
from surgisoft.tasks.single import BatchedEnv, SingleEnv
from surgisoft.tasks.world.images import images_of

KINDS = "rgb,depth,segmentation"


@pytest.fixture(scope="module")
def task():
    return make_with("circle_ablation", images=KINDS)


@pytest.fixture(scope="module")
def burnt(task):
    """Two episodes by the scripted expert until the beam burns."""
    episodes = Episodes(task, donate=True)
    with torch.inference_mode():
        state = episodes.seeded(3, 2)
        for _ in range(150):
            state, _ = episodes.step(state, task.script(state))
            if state.goal.fired.all() and state.goal.done.amin() > 15:
                break
    assert state.goal.fired.all()
    return state


def test_the_checkers_of_pettingzoo_and_gymnasium_accept_it(tmp_path, task):
    file = tmp_path / "images.toml"
    file.write_text('[world.endoscope_images]\nimages = "depth, rgb"\nimage_pixels = 72\n')
    made = []

    def make():
        made.append(surgisoft.parallel_env("circle_ablation", str(file), geometry="batched"))
        return made[-1]

    parallel_seed_test(make, num_cycles=2)
    parallel_api_test(made[0], num_cycles=4)
    space = made[0].observation_space("laser")
    assert {name: box.shape for name, box in space.items()} == {
        "vector": (42,),
        "rgb": (72, 72, 3),
        "depth": (72, 72, 1),
    }
    assert space["rgb"].dtype == np.uint8
    assert made[0].state().shape == made[0].state_space.shape
    check_env(SingleEnv(task, agent="endoscope"), skip_render_check=True)


def test_rows_of_all_interfaces_show_the_same(task):
    """Also after the episodes end: the new ones are drawn, the old ones are final."""
    task = copy(task)
    task.steps = 64  # the second episode begins 17 steps before its end
    many = surgisoft.batched_env(task, 2, seed=5, spread=True)
    seen = many.reset(5)["endoscope"]
    alone = SingleEnv(task, agent="endoscope")
    vector = BatchedEnv(task, 2, agent="endoscope")
    stacked, _ = vector.reset(seed=5)
    for name in ("rgb", "depth", "segmentation"):
        for b in range(2):
            one, _ = alone.reset(seed=5 + b)
            np.testing.assert_array_equal(one[name], seen[name][b].numpy())
        np.testing.assert_array_equal(stacked[name], seen[name].numpy())
    push = {agent: torch.full((2, 3), 3.0) for agent in many.agents}
    for _ in range(task.steps - int(many.episode_steps[1])):
        step = many.step(push)
    assert step.truncated.tolist() == [False, True]
    last, now = step.final_observations["laser"], step.observations["laser"]
    assert torch.equal(last["rgb"][0], now["rgb"][0])
    assert not torch.equal(last["depth"][1], now["depth"][1])


def test_the_image_is_the_replays_with_beam_lesion_and_dose(task, burnt):
    engine, arms, scene = task.world.scene, burnt.world.arms, burnt.world.scene
    drawn = images_of(engine, task.world.config.endoscope_images, "ring").of(arms, scene)
    slow = Renderer(engine.geometry.bodies, engine.camera, 64, 64)
    patch, organ = engine.ablation.patch, engine.geometry.bodies[engine.organ].name
    near = cKDTree(patch.points_mm)
    for b in range(2):
        heat = np.append(scene.dose.dose[b].double().numpy() / engine.ablation.threshold, 0.0)

        def paint(_, points, colours, heat=heat):
            sample = near.query(points, distance_upper_bound=SAMPLE_MM)[1]
            return stained(colours, np.append(patch.zone == LESION, False)[sample], heat[sample])

        eye, laser = arms["endoscope"], arms["laser"]
        pose = frames.pose_from_z(eye.tip_mm[b].double(), eye.tip_direction[b].double()).numpy()
        shapes = {
            name: ArmShape(part.line_mm[b].double().numpy(), float(engine.geometry.radii_mm[name]))
            for name, part in arms.items()
        }
        beam = torch.stack((laser.tip_mm[b], scene.hits["laser"].point_mm[b])).double().numpy()
        picture = slow.image(pose, shapes, "endoscope", beam, {organ: paint})
        off = np.abs(picture.astype(int) - drawn["rgb"][b].numpy().astype(int)).max(-1)
        assert (off > 1).mean() < 1e-3
        dark = slow.image(pose, shapes, "endoscope", None, {organ: paint})
        assert (dark != picture).any()
    found = set(drawn["segmentation"].unique().tolist())
    assert found >= {Label.ORGAN, Label.LESION, Label.ABLATED}


def test_images_do_not_depend_on_the_number_of_threads(task):
    """Nine episodes: two blocks of those that a thread draws at a time."""
    count, before = IMAGES + 1, torch.get_num_threads()
    drawn, world = [], Episodes(task).seeded(3, count).world
    images = images_of(task.world.scene, task.world.config.endoscope_images, "ring")
    try:
        for n in (1, 2, 5):
            torch.set_num_threads(n)
            drawn.append(images.of(world.arms, world.scene))
    finally:
        torch.set_num_threads(before)
    for kind in KINDS.split(","):
        assert drawn[0][kind][-1].any()
        for other in drawn[1:]:
            assert torch.equal(drawn[0][kind], other[kind])


def test_without_images_nothing_changes_and_wrong_ones_are_refused(task):
    plain = surgisoft.batched_env("circle_ablation", 1, seed=5)
    shown = surgisoft.batched_env(task, 1, seed=5)
    assert torch.equal(plain.reset(5)["laser"], shown.reset(5)["laser"]["vector"])
    assert plain.image_spaces == {}
    with pytest.raises(InputError, match="unknown images 'sonar'"):
        make_with("circle_ablation", images="rgb,sonar")
    with pytest.raises(InputError, match="image_pixels is 32, expected 64 to 256"):
        make_with("circle_ablation", images="rgb", image_pixels=32)
    with pytest.raises(InputError, match="task 'keyhole' has no endoscope"):
        surgisoft.parallel_env("keyhole", images="rgb")
    with pytest.raises(InputError, match="see vectors only"):
        JointEnv(task, 1, 0, 1.0)
    with pytest.raises(InputError, match="unknown agent 'nurse'"):
        SingleEnv(task, agent="nurse")
