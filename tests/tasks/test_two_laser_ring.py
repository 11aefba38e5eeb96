"""Two lasers and an endoscope: the scripted expert, the interlock of each beam, the shared ring."""

from dataclasses import replace

import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene.spec import PHANTOM
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.two_laser_ring import LASERS, TwoLaserRing, TwoLaserRingConfig
from tests.tasks.scripted import scripted_states, with_gap


@pytest.fixture(scope="module")
def quick():
    """The same ring in a third of the time."""
    return TwoLaserRing(TwoLaserRingConfig(cut_s=15.0))


@pytest.fixture(scope="module")
def cut(quick):
    """States and outcomes of two scripted episodes to the end of both."""
    return scripted_states(quick, most=200)


def with_arm(state, name, **fields):
    arms = {**state.world.arms, name: replace(state.world.arms[name], **fields)}
    return replace(state, world=replace(state.world, arms=arms))


def with_scene(state, **fields):
    scene = replace(state.world.scene, **fields)
    return replace(state, world=replace(state.world, scene=scene))


def with_endoscope_across(state, beside_mm):
    """The endoscope straight across the first laser, 20 mm from its tip, so far beside the beam."""
    arm = state.world.arms["laser_1"]
    middle = arm.tip_mm + 20.0 * arm.tip_direction
    across = torch.linalg.cross(arm.tip_direction, torch.eye(3)[2:].expand(2, 3))
    across = torch.nn.functional.normalize(across, dim=1)
    beside = torch.linalg.cross(arm.tip_direction, across)
    count = state.world.arms["endoscope"].line_mm.shape[1]
    along = torch.linspace(-40.0, 40.0, count)[None, :, None] * across[:, None]
    line = (middle + beside_mm * beside)[:, None] + along
    return with_arm(state, "endoscope", line_mm=line)


def test_the_script_cuts_the_ring_with_both_beams_in_half_the_time(quick, cut):
    states, outcomes = cut
    for i in range(2):
        ends = [k for k, outcome in enumerate(outcomes) if outcome.terminated[i]]
        assert ends, "ends by itself"
        last = outcomes[ends[0]].measures
        assert last["success"][i] == 1.0
        assert min(o.measures["clearance_mm"][i] for o in outcomes[: ends[0] + 1]) > 1.0
        done = states[ends[0] + 1].goal.done[i]
        assert done.min() > 0.4 * quick.round, "each cuts about its half"
        assert done.max() < 0.6 * quick.round
    delivered = states[-1].world.scene.dose.delivered_j
    fired = torch.stack([state.goal.fired for state in states[1:]]).sum(0)
    assert (delivered <= 20.0 * 0.1 * fired + 1e-3).all()
    assert (delivered >= 20.0 * 0.1 * (fired - 1)).all()


def test_the_lasers_work_on_opposite_points(quick, cut):
    state = cut[0][40]
    share = [state.goal.share(k, quick.round) for k in (0, 1)]
    moved = [state.goal.direction * state.goal.done[:, k] / quick.round for k in (0, 1)]
    torch.testing.assert_close(share[1] - share[0], 0.5 + moved[1] - moved[0])
    first, second = quick.targets_mm(state)
    assert ((first - second).norm(dim=1) > 17.0).all(), "20 mm apart while both are as far"


def test_each_beam_has_its_own_interlock(quick, cut):
    """What stops one laser leaves the other on; what hides the lesion stops both."""
    state = cut[0][40]
    assert quick.released(state).all()
    scene, goal = state.world.scene, state.goal
    view = scene.views["endoscope"]
    blind = with_scene(state, views={"endoscope": replace(view, fraction=0.0 * view.fraction)})
    assert not quick.released(blind).any()
    spot = (goal.share(1, quick.round) * view.visible.shape[1]).floor().long()
    hidden = view.visible.clone()
    hidden[torch.arange(2), spot % view.visible.shape[1]] = False
    lost = with_scene(state, views={"endoscope": replace(view, visible=hidden)})
    assert quick.released(lost).tolist() == [[True, False]] * 2
    hits = scene.hits
    struck = replace(hits["laser_1"], struck=torch.full((2,), 4, dtype=torch.int8))
    blocked = with_scene(state, hits={**hits, "laser_1": struck})
    assert quick.released(blocked).tolist() == [[False, True]] * 2
    shifted = with_arm(
        state, "laser_2",
        seen_mm=state.world.arms["laser_2"].points_mm + torch.tensor([1.0, 1.0, 0.0]),
    )  # fmt: skip
    assert quick.released(shifted).tolist() == [[True, False]] * 2
    still = {name: torch.zeros(2, 3) for name in quick.agents}
    joules = state.world.scene.dose.delivered_j
    after = quick.advance(blocked, still)
    assert after.goal.fired.tolist() == [[False, True]] * 2
    assert torch.equal(after.goal.done - goal.done, after.goal.fired.long())
    spent = after.world.scene.dose.delivered_j - joules
    torch.testing.assert_close(spent, torch.tensor([[0.0, 2.0]] * 2), rtol=1e-4, atol=1e-4)


def test_no_beam_passes_near_another_arm(quick, cut):
    """The endoscope lies across the path of the first laser, 9.5 mm off: 2 mm from skin to path."""
    state = cut[0][40]
    free = quick.beam_clearance_mm(state)
    assert (free > quick.config.beam_mm).all()
    near = with_endoscope_across(state, 9.5)
    clear = quick.beam_clearance_mm(near)
    torch.testing.assert_close(clear[:, 0], torch.full((2,), 2.0), rtol=0, atol=1e-3)
    assert quick.released(near).tolist() == [[False, bool(c >= 3.0)] for c in clear[:, 1]]
    for laser in LASERS:
        assert quick.rewards(near)[laser]["crossed"].tolist() == [-1.0, -1.0]
        assert quick.rewards(state)[laser]["crossed"].tolist() == [0.0, 0.0]


def test_one_beam_near_an_arm_is_crossed_for_both(quick, cut):
    """The endoscope on the other side of the first beam: 2 mm from it, over 10 mm from the second;
    both lasers pay."""
    state = cut[0][40]
    near = with_endoscope_across(state, -9.5)
    clear = quick.beam_clearance_mm(near)
    torch.testing.assert_close(clear[:, 0], torch.full((2,), 2.0), rtol=0, atol=1e-3)
    assert (clear[:, 1] > 10.0).all()
    for laser in LASERS:
        assert quick.rewards(near)[laser]["crossed"].tolist() == [-1.0, -1.0]


def test_each_laser_is_paid_for_its_own_beam(quick, cut):
    """In one episode the first beam is on, in the other none; the endoscope has half of one."""
    state = cut[0][40]
    fired = torch.tensor([[True, False], [False, False]])
    found = quick.rewards(replace(state, goal=replace(state.goal, fired=fired)))
    assert found["laser_1"]["cut"].tolist() == [1.0, 0.0]
    assert found["laser_2"]["cut"].tolist() == [0.0, 0.0]
    assert found["endoscope"]["cut"].tolist() == [0.5, 0.0]


def test_the_endoscope_is_paid_for_the_targets_it_sees(quick, cut):
    """Both targets in one episode, none in the other; then the first one alone in both."""
    state = cut[0][40]
    view, goal = state.world.scene.views["endoscope"], state.goal
    visible = torch.ones_like(view.visible)
    visible[1] = False
    some = with_scene(state, views={"endoscope": replace(view, visible=visible)})
    assert quick.rewards(some)["endoscope"]["spots"].tolist() == [1.0, 0.0]
    count = visible.shape[1]
    spot = (goal.share(1, quick.round) * count).floor().long() % count
    visible = torch.ones_like(view.visible)
    visible[torch.arange(2), spot] = False
    one = with_scene(state, views={"endoscope": replace(view, visible=visible)})
    assert quick.rewards(one)["endoscope"]["spots"].tolist() == [0.5, 0.5]


def test_a_whole_ring_is_no_success_with_contact_or_a_gap(quick, cut):
    """Of two cut rings: one with an arm 0.1 mm inside the organ, then one with a station uncut."""
    state = cut[0][-1]
    assert quick.measures(state)["success"].tolist() == [1.0, 1.0]
    clearance = state.world.scene.clearance
    bodies = clearance.bodies_mm.clone()
    bodies[1, 0, 0] = -0.1
    touching = with_scene(state, clearance=replace(clearance, bodies_mm=bodies))
    assert quick.measures(touching)["collided"].tolist() == [0.0, 1.0]
    assert quick.measures(touching)["success"].tolist() == [1.0, 0.0]
    assert quick.measures(with_gap(state, 0))["success"].tolist() == [0.0, 1.0]


def test_other_scenes_are_one_line(tmp_path):
    with pytest.raises(
        InputError, match="has the arms laser, endoscope, expected laser_"
    ) as caught:
        make_task("two_laser_ring", TwoLaserRingConfig(scene=PHANTOM))
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="beam_mm is 0"):
        TwoLaserRingConfig(beam_mm=0.0)
