"""Contours one after another: their order by hand, the expert's cut, a camera that is held."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene.spec import ContourSpec
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.contour_ablation import ContourAblation, ContourAblationConfig
from surgisoft.tasks.laser_work import RELEASED
from surgisoft.tasks.trajectories.routes import draw_route
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.treatment import Stretch
from tests.tasks.scripted import with_gap

LINES = (
    ContourSpec("left", ((-51.0, -21.4, 73.7), (-48.2, -21.7, 74.2)), closed=False),
    ContourSpec("right", ((-27.19, -21.81, 76.90), (-24.70, -21.95, 76.38)), closed=False),
)


def test_a_route_by_hand():
    """Five points round, with two of them again; then three points to and fro."""
    stretches = (Stretch(0, 5, True), Stretch(5, 3, False))
    _, goal = draw_route(streams(0, 200), stretches, overlap=2)
    rounds = {tuple((k + way * i) % 5 for i in range(7)) for k in range(5) for way in (1, -1)}
    assert {tuple(row[:7]) for row in goal.route.tolist()} == rounds
    assert {tuple(row[7:]) for row in goal.route.tolist()} == {(5, 6, 7), (7, 6, 5)}
    assert (goal.steps, goal.share.max()) == (10, 0.0)
    on, off = torch.ones(200, dtype=torch.bool), torch.zeros(200, dtype=torch.bool)
    later = goal.after(on, on).after(off, on)
    assert torch.equal(later.point(), goal.route[:, 2])
    assert torch.equal(later.point(9), goal.route[:, 1]), "begins again after its end"
    assert torch.equal(later.after(on, off).point(), goal.route[:, 2])
    assert (later.fired.any(), later.share[0].item()) == (False, pytest.approx(0.2))


@pytest.fixture(scope="module")
def task():
    """Two lines of 3 mm, 24 mm apart."""
    return ContourAblation(ContourAblationConfig(contours=LINES, speed_mm_s=4.0, window_mm=3.0))


@pytest.fixture(scope="module")
def cut(task):
    """States and outcomes of two scripted episodes, to the end of both."""
    episodes = Episodes(task)
    states, outcomes = [episodes.seeded(0, 2)], []
    with torch.inference_mode():
        while len(outcomes) < 150 and not (outcomes and outcomes[-1].terminated.all()):
            state, outcome = episodes.step(states[-1], task.script(states[-1]))
            states.append(state)
            outcomes.append(outcome)
    return states, outcomes


def test_the_expert_cuts_every_contour_and_nothing_between(task, cut):
    states, outcomes = cut
    assert outcomes[-1].measures["success"].tolist() == [1.0, 1.0]
    patch, dose = task.scene.ablation.patch, states[-1].world.scene.dose.dose
    burnt = (dose > 0.1 * task.scene.ablation.threshold).any(0).numpy()
    assert np.abs(patch.offset_mm[burnt]).max() < 0.7, "the beam is off on the way"
    order = torch.stack([state.goal.point() for state in states])
    first = task.scene.stretches[0].count
    for column in order.T:
        on_second = column >= first
        assert on_second.int().diff().ge(0).all(), "the second after the first"


def test_contours_with_a_gap_are_no_success(task, cut):
    """A station of the first contour uncut in one of two episodes; the first contour alone cut."""
    state = cut[0][-1]
    assert task.measures(with_gap(state, 1))["success"].tolist() == [1.0, 0.0]
    half = next(
        outcome.measures for outcome in cut[1] if (outcome.measures["completion"] >= 0.5).any()
    )
    assert (half["completion"] < 1.0).all()
    assert half["success"].tolist() == [0.0, 0.0]


def test_the_endoscope_has_to_move_along(task, cut):
    """Held where it saw the first contour, it does not see the second: the beam stays off."""
    states, _ = cut
    at = next(k for k, state in enumerate(states) if state.goal.fired.all())
    with torch.inference_mode():
        state, fired = states[at], []
        for _ in range(60):
            action = task.script(state)
            state = task.advance(state, {**action, "endoscope": torch.zeros(2, 3)})
            fired.append(state.goal.fired & (state.goal.point() >= task.scene.stretches[0].count))
    assert (state.world.scene.views["endoscope"].fraction < 0.5).all()
    assert not torch.stack(fired).any()
    assert (state.goal.point() >= task.scene.stretches[0].count).all(), "it waits there"


def test_the_seam_of_a_closed_contour_is_cut_over_2_mm():
    """A circle of 5 mm with a margin of 1 mm, in steps of 0.25 mm: eight points come again."""
    circle = ContourSpec("circle", centre_mm=(-37.093, -23.9786, 75.7208), diameter_mm=5.0)
    task = ContourAblation(ContourAblationConfig(contours=(circle,), margin_mm=1.0))
    route = Episodes(task).seeded(0, 3).goal.route
    (stretch,) = task.scene.stretches
    assert stretch.count == pytest.approx(7.0 * np.pi / 0.25, rel=0.03)
    assert route.shape == (3, stretch.count + 8)
    assert torch.equal(route[:, :8], route[:, -8:])
    assert all(len(set(row[8:])) == stretch.count for row in route.tolist())


def test_between_two_contours_the_reference_leaps_and_the_beam_is_off(task, monkeypatch):
    """24 mm apart, and once more where the route begins again; a step along a contour is 0.4 mm."""
    monkeypatch.setattr(task, "released", lambda state: torch.ones_like(state.goal.fired))
    steps = sum(stretch.count for stretch in task.scene.stretches)
    state = Episodes(task).seeded(0, steps)
    state = replace(state, goal=replace(state.goal, done=torch.arange(steps)))
    ends = torch.zeros(steps, dtype=torch.bool)
    ends[task.scene.stretches[0].count - 1] = ends[-1] = True
    assert torch.equal(task.leaps(state), ends)
    assert torch.equal(task.fires(state), ~ends)
    still = {name: torch.zeros(steps, 3) for name in task.agents}
    after = task.advance(state, still)
    assert torch.equal(after.goal.fired, ~ends)
    assert torch.equal(after.goal.done, state.goal.done + 1), "it moves on without the beam"
    one = Episodes(task).seeded(0, 1)
    for done, on in ((0, True), (task.scene.stretches[0].count - 1, False)):
        for released in (1.0, 0.0):
            placed = replace(one, goal=replace(one.goal, done=torch.tensor([done])))
            then = task.advance_measured(placed, {RELEASED.name: torch.tensor([released])}).goal
            assert then.fired.tolist() == [bool(released) and on]
            assert then.done.tolist() == [done + round(released)]


def test_burnt_areas_are_told_by_their_zones(task):
    """1 mm^2 burnt inside, 2 mm^2 beside the path, 3 mm^2 beyond."""
    state = Episodes(task).seeded(0, 1)
    dose = replace(state.world.scene.dose, zone_mm2=torch.tensor([[1.0, 2.0, 3.0]]))
    scene = replace(state.world.scene, dose=dose)
    found = task.measures(replace(state, world=replace(state.world, scene=scene)))
    assert (found["inside_mm2"].item(), found["healthy_mm2"].item()) == (1.0, 3.0)


def test_the_reference_of_two_lines_is_dark_between_them(task):
    """Two lines of 3 mm, 0.4 mm a step: dark in the steps that lead to the first point of one."""
    first, second = (stretch.count for stretch in task.scene.stretches)
    steps = first + second
    assert task.pass_steps == steps
    points, normals, on = task.reference(2 * steps)
    assert points.shape == normals.shape == (2 * steps + 1, 3)
    dark = [k for k in range(1, 2 * steps + 1) if not on[k]]
    assert dark == [first, steps, steps + first, 2 * steps]
    leaps = (points[1:] - points[:-1]).norm(dim=1)
    assert leaps[on[1:]].max() < 0.45
    assert leaps[~on[1:]].min() > 20.0
    torch.testing.assert_close(points[:steps], points[steps : 2 * steps])


def test_what_does_not_fit_is_one_line():
    with pytest.raises(InputError, match="take 2 s at 4 mm/s, and time_s is 1 s"):
        ContourAblation(ContourAblationConfig(contours=LINES, speed_mm_s=4.0, time_s=1.0))
    with pytest.raises(InputError, match="margin_mm is -1"):
        ContourAblationConfig(margin_mm=-1.0)
    with pytest.raises(InputError, match="contours: a second contour 'left'; expected names that"):
        ContourAblationConfig(contours=(*LINES, LINES[0]))
    varied = ContourAblationConfig(contours=LINES)
    vary = replace(varied.world.randomisation, lesion_mm=2.0)
    with pytest.raises(InputError, match="leave both at 0 for contours"):
        ContourAblation(replace(varied, world=replace(varied.world, randomisation=vary)))
