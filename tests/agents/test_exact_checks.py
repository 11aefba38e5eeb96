"""Exact checks of contacts that are provoked, and of bodies whose distances are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.agents.evaluate import evaluate
from surgisoft.agents.exact_checks import (
    Contact,
    ExactChecks,
    LastClearance,
    has_obstacles,
    out_of_contact,
)
from surgisoft.agents.policies import Random
from surgisoft.agents.rollout import Instant
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import Collision, CollisionChecker
from surgisoft.scene.folder import open_scene
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblation, CircleAblationConfig
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.world.scene import PHANTOM


@pytest.fixture(scope="module")
def task():
    return CircleAblation()


@pytest.fixture(scope="module")
def checker(task):
    return CollisionChecker(task.world.scene.geometry.bodies)


def at(state, line_mm):
    """The state with the laser's body along a line (K, 3) mm, everything else as it was."""
    laser = state.world.arms["laser"]
    arms = {**state.world.arms, "laser": replace(laser, line_mm=line_mm[None])}
    return replace(state, world=replace(state.world, arms=arms))


def looked_at(task, *states):
    watch = ExactChecks(task)
    live = torch.ones(1, dtype=torch.bool)
    for state in states:
        watch(Instant(torch.tensor([7]), state, None, None, live))
    (check,) = watch.checks()
    return check


def test_an_arm_driven_into_the_organ_is_found_with_time_and_place(task):
    state = Episodes(task).seeded(0, 1)
    organ = open_scene(PHANTOM).organ
    inside = torch.tensor(organ.world_mesh.vertices_mm.mean(0), dtype=torch.float32)
    line = state.world.arms["laser"].line_mm[0]
    into = line[0] + torch.linspace(0.0, 1.0, 21)[:, None] * (inside - line[0])
    later = at(replace(state, world=replace(state.world, steps=state.world.steps + 4)), into)
    check = looked_at(task, state, later)
    assert check.contact.between == ("laser", organ.name)
    assert check.contact.time_s == pytest.approx(0.4)
    assert check.steps == 2
    # The batched path still holds the clearances of the body that was not moved.
    assert check.contact_differs == 1
    assert check.clearance_off_mm > 1.0


def test_contact_is_found_at_its_first_step_however_slowly_an_arm_comes(task):
    """Steps that a clearance proves free are those at which FCL finds nothing, and no other."""
    state = Episodes(task).seeded(0, 1)
    scene, line = task.world.scene, state.world.arms["laser"].line_mm[0]
    towards = scene.centre_mm - line[-1]
    towards = towards / towards.norm() * 0.4 * (line[-1] - scene.centre_mm).norm() / 20.0
    steps, states = 55, []
    for step in range(steps):
        world = replace(state.world, steps=state.world.steps + step)
        states.append(at(replace(state, world=world), line + step * towards))
    checker, radii = CollisionChecker(scene.geometry.bodies), scene.geometry.radii_mm
    touching = [
        bool(
            checker.collisions(
                {n: ArmShape(p.line_mm[0].numpy(), radii[n]) for n, p in one.world.arms.items()}
            )
        )
        for one in states
    ]
    assert 5 < touching.index(True) < steps - 5
    check = looked_at(task, *states)
    assert round(check.contact.time_s / 0.1) == touching.index(True)
    assert check.contact_differs == sum(touching)  # the batched path saw the arm at its start


def test_two_straight_arms_are_as_far_apart_as_their_axes_less_radii(task):
    state = Episodes(task).seeded(0, 1)
    radii = task.world.scene.geometry.radii_mm
    far = torch.tensor([0.0, 0.0, 400.0])
    along = torch.linspace(0.0, 50.0, 21)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    apart = torch.tensor([0.0, 20.0, 0.0])
    arms = {
        name: replace(part, line_mm=(far + along + shift)[None])
        for (name, part), shift in zip(state.world.arms.items(), (0.0 * apart, apart), strict=True)
    }
    check = looked_at(task, replace(state, world=replace(state.world, arms=arms)))
    assert check.contact is None
    assert check.clearance_mm == pytest.approx(20.0 - sum(radii.values()), abs=1e-4)


def test_on_real_episodes_the_batched_path_agrees(task):
    short = CircleAblation(CircleAblationConfig())
    short.steps = 40
    found = evaluate(short, "random", Random(2), 2, seed=1)
    assert [check.steps for check in found.checks] == [41, 41]
    for check in found.checks:
        assert check.contact_differs == check.beam_differs == 0
        assert check.beam_off_mm < 1e-3
        assert check.clearance_off_mm < 0.05
    assert found.per_episode["clearance_mm"].tolist() == [v.clearance_mm for v in found.checks]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 25.0), st.floats(0.0, 0.6))
def test_where_fcl_is_not_asked_it_does_not_differ(task, checker, seed, spread_mm, towards):
    """Random poses between the arms' own and one inside the organ, with beams at random."""
    around, rng = task.world.scene, np.random.default_rng(seed)
    scene, count, lines = around.geometry, 12, {}
    for name, part in Episodes(task).seeded(seed, count).world.arms.items():
        line = part.line_mm.numpy()
        step = towards * (around.centre_mm.numpy() - line[:, -1:])
        moved = line + step + spread_mm * rng.normal(size=(count, 1, 3))
        lines[name] = (moved + 0.1 * rng.normal(size=line.shape)).astype(np.float32)
    clear = out_of_contact(scene, {name: torch.from_numpy(line) for name, line in lines.items()})
    radii, asked = scene.radii_mm, {name: line.astype(float) for name, line in lines.items()}
    for n in np.flatnonzero(clear):
        assert not checker.collisions({a: ArmShape(line[n], radii[a]) for a, line in lines.items()})
    tips = lines["laser"][:, -1]
    aims = (around.centre_mm.numpy() + 15.0 * rng.normal(size=(count, 3)) - tips).astype("f4")
    kind, end, sure = scene.sure_hits(tips, aims, around.beam_mm, lines, "laser")
    exact = checker.cast_each(
        tips.astype(float), aims.astype(float), around.beam_mm, asked, radii, "laser"
    )
    assert np.array_equal(kind[sure], exact[0][sure])
    np.testing.assert_allclose(end[sure], exact[1][sure], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("folds", [False, True])
def test_what_a_clearance_bounds_is_not_measured_again(task, monkeypatch, folds):
    """Every step has the answer of a measurement, of arms that go into the organ, or fold up."""
    around, count, steps = task.world.scene, 3, 60
    scene, rng = around.geometry, np.random.default_rng(0)
    start = {
        name: part.line_mm.clone()
        for name, part in Episodes(task).seeded(0, count).world.arms.items()
    }
    towards = around.centre_mm - start["laser"][:, -1:]
    along = torch.linspace(0.0, 150.0, start["laser"].shape[1])
    last, measured, expected = LastClearance(scene), [], []
    whole = type(scene).clearance
    for step in range(steps):
        share = step / steps * (0.8 + 0.2 * torch.arange(count)[:, None, None] / count)
        lines = {name: line.clone() for name, line in start.items()}
        lines["laser"] += share * towards
        if folds:  # to a ring, away from everything
            angle = (1e-3 + 2 * torch.pi / 150.0 * share[..., 0]) * along
            ring = torch.stack((angle.sin(), 1.0 - angle.cos(), 0.0 * angle), -1)
            lines["laser"] = 400.0 + ring * (along[-1] / angle[:, -1:, None])
        lines["endoscope"] += 0.01 * torch.from_numpy(rng.normal(size=(count, 1, 3))).float()
        rows = torch.tensor([0, 1, 2] if step % 7 else [2, 0])
        given = {name: line[rows].contiguous() for name, line in lines.items()}
        calls = []
        monkeypatch.setattr(
            type(scene), "clearance", lambda self, *a, c=calls: c.append(1) or whole(self, *a)
        )
        found = last.out_of_contact(5 + rows.numpy(), given)
        monkeypatch.undo()
        measured.append(bool(calls))
        expected.append(out_of_contact(scene, given))
        assert np.array_equal(found, expected[-1])
    clear = np.concatenate(expected)
    assert clear.any()
    assert not clear.all()
    assert 1 <= sum(measured) < steps / 2


def test_a_beam_that_grazes_an_edge_or_an_arm_is_left_to_fcl(task, checker):
    """Aimed at vertices and edges of the organ, and along the skin of the other arm."""
    scene, mesh = task.world.scene.geometry, open_scene(PHANTOM).organ.world_mesh
    rng = np.random.default_rng(0)
    faces = mesh.faces[rng.integers(len(mesh.faces), size=60)]
    corners = mesh.vertices_mm[faces]
    share = rng.uniform(size=(60, 1)) * (np.arange(60) % 2)[:, None]
    ends = corners[:, 0] + share * (corners[:, 1] - corners[:, 0])
    origins = ends + 50.0 * np.array([0.1, 0.2, 1.0])
    lines = {"endoscope": np.full((60, 2, 3), 900.0) + np.array([[0.0, 0, 0], [0, 0, 9]])}
    _, found, sure = scene.sure_hits(origins, ends - origins, 110.0, lines)
    upon = np.linalg.norm(found - ends, axis=1) < 1e-6
    assert upon.sum() > 20  # the others meet something before
    assert not sure[upon].any()
    middles = corners.mean(1)
    origins = middles + 50.0 * np.array([0.1, 0.2, 1.0])
    _, found, sure = scene.sure_hits(origins, middles - origins, 110.0, lines)
    upon = np.linalg.norm(found - middles, axis=1) < 1e-6
    assert sure[upon].mean() > 0.9
    n = np.flatnonzero(upon & sure)[0]
    radius = scene.radii_mm["endoscope"]
    for beside, expected in ((radius + 1e-4, False), (radius + 0.01, True)):
        across = np.cross(middles[n] - origins[n], [1.0, 0.0, 0.0])
        across *= beside / np.linalg.norm(across)
        foot = 0.5 * (middles[n] + origins[n]) + across
        arm = {"endoscope": foot + np.array([[[-40.0, 0, 0], [40.0, 0, 0]]])}
        aim = (middles[n] - origins[n])[None]
        *_, sure_now = scene.sure_hits(origins[n][None], aim, 110.0, arm)
        assert sure_now.tolist() == [expected]


def test_fcl_audits_what_it_need_not_see(task, monkeypatch):
    """A batched clearance that is wrong everywhere is found out by the audit."""
    short = CircleAblation(CircleAblationConfig())
    short.steps = 130
    seen = []
    whole = CollisionChecker.collisions
    monkeypatch.setattr(
        CollisionChecker, "collisions", lambda self, arms: seen.append(1) or whole(self, arms)
    )
    (check,) = evaluate(short, "random", Random(2), 1, seed=1).checks
    assert check.steps == 131
    assert len(seen) == check.asked >= check.audited == 3
    touching = lambda self, arms: (Collision("laser", "liver", "body", False, 0),)  # noqa: E731
    monkeypatch.setattr(CollisionChecker, "collisions", touching)
    (check,) = evaluate(short, "random", Random(2), 1, seed=1).checks
    assert check.contact == Contact(0.0, ("laser", "liver"))
    assert check.contact_differs >= 3


def test_nothing_around_needs_no_exact_checks():
    assert not has_obstacles(make_task("track_circle"))


def with_hit(state, **fields):
    scene = state.world.scene
    scene = replace(scene, hits={"laser": replace(scene.hit, **fields)})
    return replace(state, world=replace(state.world, scene=scene))


def test_a_beam_that_ends_elsewhere_or_on_something_else_is_found(task):
    """The batched geometry's hit is moved by 3 mm, and then said to be on something else."""
    state = Episodes(task).seeded(0, 1)
    hit = state.world.scene.hit
    whole = looked_at(task, state)
    assert (whole.beam_differs, whole.beam_off_mm < 1e-3) == (0, True)
    moved = with_hit(state, point_mm=hit.point_mm + torch.tensor([0.0, 3.0, 0.0]))
    assert looked_at(task, state, moved).beam_off_mm == pytest.approx(3.0, abs=1e-3)
    assert looked_at(task, moved, state).beam_off_mm == pytest.approx(3.0, abs=1e-3)
    other = with_hit(state, struck=(hit.struck + 1) % 3)
    assert looked_at(task, state, other).beam_differs == 1


def test_the_first_contact_is_the_one_that_is_reported(task):
    state = Episodes(task).seeded(0, 1)
    organ = open_scene(PHANTOM).organ
    inside = torch.tensor(organ.world_mesh.vertices_mm.mean(0), dtype=torch.float32)
    line = state.world.arms["laser"].line_mm[0]
    into = line[0] + torch.linspace(0.0, 1.0, 21)[:, None] * (inside - line[0])
    seen = [
        at(replace(state, world=replace(state.world, steps=state.world.steps + k)), into)
        for k in (2, 5)
    ]
    assert looked_at(task, *seen).contact.time_s == pytest.approx(0.2)


def test_an_exact_contact_is_no_success(task, monkeypatch):
    short = CircleAblation(CircleAblationConfig())
    short.steps = 3
    kept = short.measures

    def cut(state):
        return kept(state) | {"success": torch.ones_like(state.world.steps, dtype=torch.float32)}

    short.measures = cut
    free = evaluate(short, "random", Random(2), 1, seed=1)
    assert free.per_episode["success"].tolist() == [1.0]
    touched = Contact(0.1, ("laser", "liver"))
    whole = ExactChecks.checks

    def with_contact(self, episodes):
        return [replace(one, contact=touched) for one in whole(self, episodes)]

    monkeypatch.setattr(ExactChecks, "checks", with_contact)
    found = evaluate(short, "random", Random(2), 1, seed=1)
    assert found.per_episode["success"].tolist() == [0.0]
    assert found.per_episode["collided"].tolist() == [1.0]


def far_apart(task, apart_mm, count=1):
    """(R, K, 3) lines of two parallel arms, far from all bodies, their axes so far apart."""
    along = torch.linspace(0.0, 50.0, 21)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    first = (torch.tensor([0.0, 0.0, 400.0]) + along)[None].repeat(count, 1, 1)
    shift = torch.tensor([0.0, 1.0, 0.0]) * apart_mm
    names = list(task.world.scene.geometry.radii_mm)
    return {names[0]: first, names[1]: first + shift}


def seen_at(task, state, step, apart_mm, said_mm):
    """The state at a step with its arms so far apart, whose batched clearance says something."""
    lines = far_apart(task, apart_mm)
    arms = {name: replace(part, line_mm=lines[name]) for name, part in state.world.arms.items()}
    clearance = task.world.scene.geometry.clearance(lines)
    clearance = replace(clearance, arms_mm=torch.full_like(clearance.arms_mm, said_mm))
    scene = replace(state.world.scene, clearance=clearance)
    steps = torch.full_like(state.world.steps, step)
    return replace(state, world=replace(state.world, arms=arms, scene=scene, steps=steps))


def test_the_least_clearances_of_an_episode_are_checked(task):
    """Of five steps the three nearest ones by the batched geometry are computed exactly; it is off
    by 0.5 mm in the nearest of them, by 0.2 mm elsewhere, and by 5 mm where it is far."""
    state = Episodes(task).seeded(0, 1)
    radii = sum(task.world.scene.geometry.radii_mm.values())
    steps = [(50.0, 5.0), (40.0, 0.2), (10.0, 0.5), (30.0, 0.2), (20.0, 0.2)]
    states = [
        seen_at(task, state, step, radii + mm, mm + off) for step, (mm, off) in enumerate(steps)
    ]
    for order in (states, states[::-1]):
        check = looked_at(task, *order)
        assert check.steps == 5
        assert check.clearance_mm == pytest.approx(10.0, abs=1e-4)
        assert check.clearance_off_mm == pytest.approx(0.5, abs=1e-3)
        assert (check.contact, check.contact_differs) == (None, 0)


def test_a_contact_that_cannot_be_is_counted_without_fcl(task):
    """The batched geometry says that arms 30 mm apart overlap; FCL is not asked, nor audited."""
    state = Episodes(task).seeded(0, 1)
    radii = sum(task.world.scene.geometry.radii_mm.values())
    check = looked_at(task, seen_at(task, state, 3, radii + 30.0, -0.1))
    assert (check.contact_differs, check.asked, check.audited) == (1, 0, 0)
    assert check.contact is None


def test_episodes_that_are_over_are_not_looked_at(task):
    state = Episodes(task).seeded(0, 3)
    watch = ExactChecks(task)
    failed = replace(state, world=replace(state.world, failed=torch.tensor([False, False, True])))
    live = torch.tensor([True, False, True])
    watch(Instant(torch.tensor([4, 5, 6]), failed, None, None, live))
    assert [check.steps for check in watch.checks()] == [1, 0], "4 and the failed 6"
    assert [check.steps for check in watch.checks(1)] == [1]
    watch(Instant(torch.tensor([4, 5, 6]), state, None, None, ~live))
    assert [check.steps for check in watch.checks()] == [1, 1, 0]


@pytest.mark.parametrize(
    ("moved_mm", "turned_mm", "again"),
    [(4.4, 0.0, False), (4.5, 0.0, True), (0.0, 4.5, True), (0.0, 4.4, False)],
)
def test_two_arms_may_both_have_come_nearer(task, monkeypatch, moved_mm, turned_mm, again):
    """10 mm apart, a margin of 1.1 mm: 4.45 mm of both, of all of an arm or of its tip alone."""
    scene = task.world.scene.geometry
    radii = sum(scene.radii_mm.values())
    start, calls, whole = far_apart(task, radii + 10.0, 2), [], type(scene).clearance
    monkeypatch.setattr(
        type(scene), "clearance", lambda self, *a: calls.append(1) or whole(self, *a)
    )
    last, episodes = LastClearance(scene), np.array([3, 8])
    assert last.out_of_contact(episodes, start).all()
    assert len(calls) == 1
    assert last.out_of_contact(episodes, start).all()
    assert len(calls) == 1
    one, other = start
    share = torch.linspace(0.0, 1.0, 21)[:, None]
    step = (moved_mm + turned_mm * share) * torch.tensor([0.0, 1.0, 0.0])
    moved = {one: start[one].clone(), other: start[other].clone()}
    moved[one][1] += step  # of the second episode alone
    moved[other][1] -= step
    assert last.out_of_contact(episodes, moved).all()
    assert len(calls) == 1 + again


def test_a_beam_that_waits_for_fcl_is_followed_in_the_end(task):
    """An audited instant: 7 and 57 are 64. The batched end is off by 3 mm, or on something else."""
    state = Episodes(task).seeded(0, 1)
    state = replace(state, world=replace(state.world, steps=torch.full_like(state.world.steps, 57)))
    hit = state.world.scene.hit
    moved = looked_at(task, with_hit(state, point_mm=hit.point_mm + torch.tensor([0.0, 3.0, 0.0])))
    assert (moved.beams_asked, moved.beam_differs) == (1, 0)
    assert moved.beam_off_mm == pytest.approx(3.0, abs=1e-3)
    assert looked_at(task, with_hit(state, struck=(hit.struck + 1) % 3)).beam_differs == 1


def test_an_organ_that_breathes_is_checked_where_it_is():
    """In the middle of a breath it is millimetres from where it is at rest."""
    task, live = make_task("breathing_ablation"), torch.ones(1, dtype=torch.bool)
    state, watch = Episodes(task).seeded(0, 1), ExactChecks(task)
    still = {name: torch.zeros(1, arm.chambers) for name, arm in task.world.arms.items()}
    with torch.inference_mode():
        for number in range(24):
            if number % 8 == 0:
                watch(Instant(torch.tensor([number]), state, None, None, live))
            state = task.advance(state, still)
    found = watch.checks()
    assert np.ptp([check.clearance_mm for check in found]) > 1.0
    assert max(check.clearance_off_mm for check in found) < 0.1
