"""Phases, interlock, faults and controllers, against hand-made states and the energy delivered."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.agents.rollout import rollout
from surgisoft.errors import InputError
from surgisoft.experiments.controllers import (
    Nominal,
    Schedule,
    Waypoints,
    interpolated,
)
from surgisoft.experiments.phases import CLOSE, LATE, LOST, PhasedTask
from surgisoft.experiments.plan import settings
from surgisoft.experiments.run import roll_out_block
from surgisoft.experiments.spec import Fault, load_experiment
from surgisoft.replay.plots import plots_of
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.episodes.log import EpisodeRecorder
from surgisoft.tasks.laser_supervision import LASER_EXPERIMENT, LaserSupervision
from surgisoft.tasks.registry import make_task
from tests.experiments.tiny import FAULT, TINY, write


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    text = TINY.replace("time_s = 0.5", "time_s = 3.0\nview_lost_s = 0.4")
    return load_experiment(write(tmp_path_factory.mktemp("spec"), text))


@pytest.fixture(scope="module")
def base(spec):
    return CircleAblation(replace(spec.task, scene=spec.scene))


@pytest.fixture(scope="module")
def cutting(spec, base):
    """The phased task, and two of its episodes in the phase with the beam, all well."""
    task = PhasedTask(LaserSupervision(base), spec)
    state = Episodes(task).seeded(0, 2)
    state = replace(state, goal=replace(state.goal, phase=state.goal.phase + 1))
    return task, _with(state, fraction=1.0, clearance=20.0)


def _with(state, fraction=None, clearance=None):
    """The state with what is seen (0..1) and the clearance (mm) of both episodes."""
    scene = state.world.scene
    ones = torch.ones_like(scene.view.fraction)
    if fraction is not None:
        scene = replace(scene, views={"endoscope": replace(scene.view, fraction=fraction * ones)})
    if clearance is not None:
        room = SimpleNamespace(least_mm=clearance * ones, collides=clearance * ones < 0.0)
        scene = replace(scene, clearance=room)
    return replace(state, world=replace(state.world, scene=scene))


def test_the_interlock_lets_the_beam_on_only_when_all_is_well(cutting):
    task, state = cutting
    assert task.released(state).all()
    limits = task.base.spec.limits
    assert not task.released(_with(state, fraction=limits.view_fraction - 0.01)).any()
    assert not task.released(_with(state, clearance=limits.clearance_mm - 0.01)).any()
    assert task.released(_with(state, clearance=limits.clearance_mm + 0.01)).all()
    for change in ({"phase": state.goal.phase - 1}, {"reason": state.goal.reason + LATE}):
        assert not task.released(replace(state, goal=replace(state.goal, **change))).any()


def test_the_beam_is_aimed_in_phases_that_permit_it(cutting):
    """On the way to rest the distance of its axis from a target is no error of aiming."""
    task, state = cutting
    late = replace(state, world=replace(state.world, steps=state.world.steps + 100))
    true_mm = task.base.measures(task.plain(late))["pointing_error_mm"]
    assert true_mm.isfinite().all()
    assert torch.equal(task.measures(late)["pointing_error_mm"], true_mm)
    idle = replace(late, goal=replace(late.goal, phase=late.goal.phase - 1))
    assert task.measures(idle)["pointing_error_mm"].isnan().all()


def test_an_experiment_cannot_loosen_the_scene_s_clearance(cutting, spec, base):
    loose = replace(spec, limits=replace(spec.limits, clearance_mm=-5.0))
    assert PhasedTask(LaserSupervision(base), loose).clear_mm == base.spec.limits.clearance_mm
    strict = replace(spec, limits=replace(spec.limits, clearance_mm=7.0))
    _, state = cutting
    assert (
        not PhasedTask(LaserSupervision(base), strict).released(_with(state, clearance=6.9)).any()
    )


def test_the_log_and_its_charts_have_the_limit_that_holds(spec, base):
    """The stricter of the file's and the scene's, which the log alone would state as 1 mm."""
    assert base.spec.limits.clearance_mm == 1.0
    for given, holds in ((100.0, 100.0), (0.5, 1.0)):
        phased = replace(spec, limits=replace(spec.limits, clearance_mm=given))
        task = PhasedTask(LaserSupervision(base), phased)
        state = Episodes(task).seeded(0, 1)
        log = EpisodeRecorder(task, state, policy="scripted", seed=0).log()
        assert log.limits["clearance_mm"] == holds
        (drawn,) = (line for plot in plots_of(log) for line in plot.lines if line.name == "limit")
        assert set(drawn.values.tolist()) == {holds}
        told = [event.text for event in log.events if event.text.startswith("closer")]
        assert told == (["closer than 100 mm"] if holds > 1.0 else [])


def _walk(task, state, steps, **world):
    """The progress after so many steps in which the world stays as it is told."""
    for _ in range(steps):
        after = _with(replace(state, goal=state.goal.goal), **world)
        state = replace(state, goal=task.progressed(state.goal, after))
    return state.goal


def test_phases_go_on_by_their_time_and_view_lost_aborts(cutting):
    task, state = cutting
    first = replace(state, goal=replace(state.goal, phase=state.goal.phase * 0))
    well = {"fraction": 0.9, "clearance": 20.0}
    assert _walk(task, first, 2, **well).phase.tolist() == [0, 0]
    goal = _walk(task, first, 3, **well)
    assert goal.phase.tolist() == [1, 1]
    assert goal.since.tolist() == [0, 0]
    lost = {"fraction": 0.0, "clearance": 20.0}
    assert _walk(task, state, 4, **lost).reason.tolist() == [0, 0]
    goal = _walk(task, state, 5, **lost)
    assert goal.reason.tolist() == [LOST, LOST]
    assert goal.where.tolist() == [1, 1]
    assert goal.phase.tolist() == [2, 2]
    assert _walk(task, state, 1, fraction=1.0, clearance=-0.1).reason.tolist() == [CLOSE, CLOSE]


def test_an_abort_retreats_and_then_ends(cutting, base, spec):
    third = replace(spec.phases[0], name="out", until="never", timeout_s=0.2)
    limits = replace(spec.limits, retreat="out")
    task = PhasedTask(
        LaserSupervision(base), replace(spec, phases=(*spec.phases, third), limits=limits)
    )
    goal = _walk(task, cutting[1], 5, fraction=0.0, clearance=20.0)
    assert goal.phase.tolist() == [2, 2]
    state = replace(cutting[1], goal=goal)
    assert not task.released(_with(state, fraction=1.0)).any()
    goal = _walk(task, state, 1, fraction=1.0, clearance=20.0)
    assert (goal.reason.tolist(), goal.where.tolist()) == ([LOST] * 2, [1, 1]), "it stays aborted"
    goal = _walk(task, state, 2, fraction=1.0, clearance=20.0)
    assert goal.phase.tolist() == [3, 3]
    assert task.ended(replace(state, goal=goal)).all()


def test_a_condition_has_to_hold_without_a_break(cutting, base, spec):
    look = replace(spec.phases[0], until="centred", within=1000.0, hold_s=0.2, timeout_s=9.0)
    task = PhasedTask(LaserSupervision(base), replace(spec, phases=(look, spec.phases[1])))
    state = replace(cutting[1], goal=replace(cutting[1].goal, phase=cutting[1].goal.phase * 0))
    good, bad = {"fraction": 1.0, "clearance": 20.0}, {"fraction": 0.5, "clearance": 20.0}
    goal = _walk(task, state, 1, **good)
    goal = _walk(task, replace(state, goal=goal), 1, **bad)
    goal = _walk(task, replace(state, goal=goal), 1, **good)
    assert goal.phase.tolist() == [0, 0]
    assert _walk(task, replace(state, goal=goal), 1, **good).phase.tolist() == [1, 1]


@pytest.mark.parametrize(("seen", "reason", "phase"), [(1.0, 0, 1), (0.5, LATE, 2)])
def test_a_condition_that_is_met_at_the_last_moment_is_in_time(
    seen, reason, phase, cutting, base, spec
):
    """Two steps to hold it, and two steps of time."""
    look = replace(spec.phases[0], until="centred", within=1000.0, hold_s=0.2, timeout_s=0.2)
    look = replace(look, on_timeout="abort")
    task = PhasedTask(LaserSupervision(base), replace(spec, phases=(look, spec.phases[1])))
    state = replace(cutting[1], goal=replace(cutting[1].goal, phase=cutting[1].goal.phase * 0))
    goal = _walk(task, state, 2, fraction=seen, clearance=20.0)
    assert (goal.reason.tolist(), goal.phase.tolist()) == ([reason] * 2, [phase] * 2)
    assert goal.late.tolist() == [0, 0], "an abort has its reason"
    look = replace(look, on_timeout="go on")
    task = PhasedTask(LaserSupervision(base), replace(spec, phases=(look, spec.phases[1])))
    goal = _walk(task, state, 2, fraction=seen, clearance=20.0)
    assert (goal.phase.tolist(), goal.late.tolist()) == ([1, 1], [int(reason == LATE)] * 2)


def test_a_phase_that_goes_on_after_its_time_is_told(tmp_path):
    """Both phases run out of their time, 0.3 and 0.2 s, and a third has no condition to miss."""
    text = TINY.replace("timeout_s = 30.0", 'timeout_s = 0.2\non_timeout = "go on"')
    text = text.replace("time_s = 0.5", "time_s = 2.0").replace("repeats = 3", "repeats = 1")
    text += '[[phases]]\nname = "rest"\nlaser = "rest"\ntimeout_s = 0.1\non_timeout = "go on"\n'
    spec = load_experiment(write(tmp_path, text))
    block = roll_out_block(spec, settings(spec)[0], 0, 1)
    assert block.rows[0]["outcome"] == "done; cut took too long"
    told = [(round(e.time_s, 3), e.level, e.text) for e in block.logs[0].events]
    late = [each for each in told if "time out" in each[2]]
    assert late == [
        (0.3, "warning", "time out in phase look: 'centred' not met in 0.3 s"),
        (0.5, "warning", "time out in phase cut: 'cut' not met in 0.2 s"),
    ]
    assert told[-2:] == [
        (0.6, "info", "all phases done"),
        (0.6, "warning", "ended without success"),
    ]
    assert not any(level == "error" for _, level, _ in told)


def test_every_laser_has_to_be_out_and_the_endoscope_need_not():
    """Both lasers within 0.9 kPa of their start; the first, then the second one 1.1 kPa away; the
    endoscope 30 kPa away."""
    first = torch.tensor([1.0, 2.0, 3.0])
    off = {
        "laser_1": torch.tensor([[0.9, 0.0, 0.0], [0.0, -1.1, 0.0], [0.0, 0.0, 0.0]]),
        "laser_2": torch.tensor([[0.0, 0.0, -0.9], [0.0, 0.0, 0.0], [1.1, 0.0, 0.0]]),
        "endoscope": torch.full((3, 3), 30.0),
    }
    arms = {name: SimpleNamespace(seen_kPa=first + away) for name, away in off.items()}
    state = SimpleNamespace(world=SimpleNamespace(arms=arms))
    mounted = {name: SimpleNamespace(first=first) for name in arms}
    task = SimpleNamespace(world=SimpleNamespace(arms=mounted))
    retracted = LASER_EXPERIMENT.conditions["retracted"]
    assert retracted.within == 1.0
    assert retracted.holds(task, state, 1.0).tolist() == [True, False, False]
    assert retracted.holds(task, state, 0.5).tolist() == [False, False, False]


def test_a_lost_chamber_stops_the_beam_within_one_step(tmp_path):
    """No energy reaches the organ in a step that begins with the lesion out of sight."""
    text = TINY.replace("time_s = 0.5", "time_s = 3.4\nview_lost_s = 0.3") + FAULT
    text = text.replace("timeout_s = 0.3", "timeout_s = 1.5")
    spec = load_experiment(write(tmp_path, text))
    block = roll_out_block(spec, settings(spec)[0], 0, 1)
    log, row = block.logs[0], block.rows[0]
    seen = log.view_fraction >= log.limits["view_fraction"]
    lost = int(np.flatnonzero(seen)[-1]) + 1
    assert seen[lost - 5 : lost].all()
    assert log.beam.on[lost - 5 : lost].all()
    unsafe_before = np.flatnonzero(~seen[:-1] | (log.clearance_mm[:-1] < 1.0)) + 1
    assert (log.beam.power_w[unsafe_before] == 0.0).all()
    assert not log.beam.on[lost + 1 :].any()
    assert log.arms["endoscope"].pressure_kPa[-1, 2] == pytest.approx(0.0, abs=4.0)
    assert row["outcome"] == "aborted in cut: lesion out of sight"
    events = [(event.time_s, event.text) for event in log.events]
    assert (1.7, "fault: chamber 3 of endoscope goes to 0 kPa") in events
    texts = [text for _, text in events]
    assert [text for text in texts if text.startswith("phase ")] == ["phase look", "phase cut"]
    (aborted,) = [at for at, text in events if text == "aborted: lesion out of sight"]
    assert aborted == pytest.approx(0.1 * lost + 0.3, abs=0.11)
    assert row["beam_unsafe_longest_s"] <= 0.1 + 1e-6
    assert row["beam_s"] == pytest.approx(0.1 * log.beam.on.sum(), abs=1e-3)


def test_the_longest_unsafe_time_is_one_without_a_break(tmp_path, monkeypatch):
    """Five steps of 0.1 s: unsafe, unsafe, safe, unsafe, safe."""

    def with_beam(*given):
        found = rollout(*given)
        found.measures["beam_unsafe"] = torch.tensor([[1.0, 1.0, 0.0, 1.0, 0.0]])
        return found

    monkeypatch.setattr("surgisoft.experiments.run.rollout", with_beam)
    spec = load_experiment(write(tmp_path))
    (row,) = roll_out_block(spec, settings(spec)[0], 0, 1).rows
    assert row["beam_unsafe_longest_s"] == pytest.approx(0.2)


@pytest.mark.parametrize(("steps", "vents"), [(16, False), (17, True)])
def test_a_fault_comes_with_the_step_that_begins_at_its_time(steps, vents, cutting, base, spec):
    """At 1.7 s, steps of 0.1 s: the step after the 17th is the first one without the valve."""
    fault = Fault("endoscope", at_s=1.7, chamber=3)
    task = PhasedTask(LaserSupervision(base), replace(spec, faults=(fault,)))
    world = cutting[1].world
    arm = world.arms["endoscope"]
    arms = world.arms | {"endoscope": replace(arm, command=torch.full_like(arm.command, 5.0))}
    world = replace(world, arms=arms, steps=torch.full_like(world.steps, steps))
    still = {name: torch.zeros_like(each.command) for name, each in arms.items()}
    after = task.advance(replace(cutting[1], world=world), still).world.arms["endoscope"].command
    assert after[:, :2].tolist() == [[5.0, 5.0]] * 2
    assert ((after[:, 2] < 5.0) == vents).all()


def test_a_fault_needs_a_chamber_that_is_there(spec, base):
    wrong = replace(spec, faults=(Fault("laser", 1.0, 4),))
    with pytest.raises(InputError, match="chamber 4 of arm 'laser', expected 1 to 3"):
        PhasedTask(LaserSupervision(base), wrong)


def test_values_between_rows_are_linear():
    times = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    values = torch.tensor([[0.0], [10.0], [0.0]])
    at = torch.tensor([0.0, 1.5, 2.0, 3.0, 9.0])
    assert interpolated(times, values, at)[:, 0].tolist() == [0.0, 5.0, 10.0, 5.0, 0.0]
    assert interpolated(times[:1], values[1:2], at)[:, 0].tolist() == [10.0] * 5


def test_a_schedule_is_followed_and_waypoints_are_aimed_at(cutting, base, spec, tmp_path):
    long = replace(spec.phases[0], until="never", timeout_s=9.0)
    task, state = PhasedTask(LaserSupervision(base), replace(spec, phases=(long,))), cutting[1]
    state = replace(state, goal=replace(state.goal, phase=state.goal.phase * 0))
    file = tmp_path / "press.csv"
    file.write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n0,0,0,0\n1.0,5,0,0\n")
    hand, play = Schedule(file, 3), Episodes(task)
    point = task.base.watched_mm(state)[0]
    way = Waypoints([(0.0, *point.tolist())])
    for _ in range(12):
        actions = {
            "laser": way(task, "laser", state),
            "endoscope": hand(task, "endoscope", state),
        }
        state, _ = play.step(state, actions)
    command = state.world.arms["endoscope"].command
    assert torch.allclose(command, torch.tensor([5.0, 0.0, 0.0]).expand(2, 3), atol=1e-4)
    miss = task.base.pointing["laser"].offset_mm(
        state.world.arms["laser"].points_mm, point.expand(2, 3)
    )
    assert (miss.norm(dim=1) < 8.0).all()
    with pytest.raises(InputError, match="expected 2 in kPa"):
        Schedule(file, 2)


def test_the_nominal_expert_knows_the_feed():
    """Ports without errors of the mounts: what it does is what the expert does, bases still out.

    Arms are bent at first, so that the place of a base matters for where its axis points."""
    task = make_task("keyhole_ablation")
    episodes = Episodes(task)
    state = episodes.seeded(0, 2)
    bent = {agent: torch.tensor([[2.0, -1.0, 0.0], [0.0, 2.0, -2.0]]) for agent in task.agents}
    with torch.inference_mode():
        for _ in range(4):
            state, _ = episodes.step(state, bent)
        assert state.world.out_mm.min() > 50.0
        expected, found = task.script(state), Nominal().act(task, state, {})
    for agent, action in expected.items():
        assert action.abs().max() > 0.1
        torch.testing.assert_close(found[agent], action, atol=1e-3, rtol=0.0)
