"""Logs of episodes: what was recorded is what happened, and a file gives it back."""

import dataclasses
import zipfile

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene import mesh
from surgisoft.scene import spec as scene_spec
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblationConfig
from surgisoft.tasks.episodes import parts
from surgisoft.tasks.episodes.file import load_episode, save_episode
from surgisoft.tasks.episodes.log import EpisodeLog, EpisodeRecorder, find_events
from surgisoft.tasks.episodes.parts import ArmLog, BeamLog, DoseLog
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.pytree import rows
from surgisoft.tasks.world.world import WorldConfig

STEPS = 22


@pytest.fixture(scope="module")
def cut():
    """A batch of two cuts of which the second is recorded, and copies of all that it went by."""
    task = make_task("circle_ablation")
    with torch.inference_mode():
        play = Episodes(task, donate=True)
        state = play.seeded(5, 2)
        recorder = EpisodeRecorder(task, state, 1, policy="scripted", seed=5)
        kept = [(state.world.arms["laser"].tip_mm[1].clone(), None, None)]
        for _ in range(STEPS):
            actions = task.script(state)
            state, outcome = play.step(state, actions)
            recorder.step(state, outcome, actions)
            dose = state.world.scene.dose.dose[1].clone()
            kept.append((state.world.arms["laser"].tip_mm[1].clone(), dose, outcome))
    return recorder.log(), kept


def test_the_log_holds_what_the_batch_went_through(cut):
    log, kept = cut
    assert log.rows == STEPS + 1
    assert log.time_s[-1] == pytest.approx(STEPS * log.dt_s)
    tips = torch.stack([tip for tip, _, _ in kept]).numpy()
    np.testing.assert_array_equal(log.arms["laser"].points_mm[:, -1], tips)
    for row, (_, _, outcome) in enumerate(kept[1:], 1):
        for name, value in outcome.measures.items():
            np.testing.assert_array_equal(log.measures[name][row], value[1].numpy())
        for term, value in outcome.terms["laser"].items():
            assert log.rewards["laser"][term][row] == value[1]
    assert np.isnan(log.rewards["laser"]["aim"][0])
    assert np.isfinite(log.measures["clearance_mm"]).all()


def test_the_dose_of_every_row_comes_back(cut):
    log, kept = cut
    assert not log.dose.at(0).any()
    for row in range(1, log.rows):
        np.testing.assert_array_equal(log.dose.at(row), kept[row][1].numpy())
    np.testing.assert_array_equal(log.dose.at(-1), log.dose.at(STEPS))
    assert log.dose.at(-1).max() > log.dose.cut_j_per_mm2
    # Of the whole map only what changed is kept.
    assert len(log.dose.sample) < 0.01 * STEPS * len(log.dose.points_mm)


def test_the_beam_burns_with_the_lasers_power(cut):
    log, _ = cut
    on = log.beam.on
    assert 3 < on.sum() < STEPS
    whole = on[1:] & on[:-1]
    np.testing.assert_allclose(log.beam.power_w[1:][whole][1:], 20.0, rtol=1e-3)
    np.testing.assert_allclose(log.beam.end_mm[on], log.actual_mm[on])
    assert np.linalg.norm(log.actual_mm - log.target_mm, axis=1)[on].max() < 0.5
    assert [event.text for event in log.events][1:] == ["lesion in sight", "beam on"]


def test_a_file_gives_the_log_back(cut, tmp_path):
    log, _ = cut
    path = tmp_path / "logs" / "one.npz"
    save_episode(log, path)
    _same(load_episode(path), log)
    assert path.stat().st_size < 1.5e6


def _same(one, other):
    assert type(one) is type(other)
    if dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            _same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, dict):
        assert list(one) == list(other)
        for name in one:
            _same(one[name], other[name])
    elif isinstance(one, tuple):
        assert len(one) == len(other)
        for mine, theirs in zip(one, other, strict=True):
            _same(mine, theirs)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


def test_the_recorder_follows_its_episode_in_a_batch_that_shrinks():
    """Episode 2 of three that leave the batch one by one, against the same episode alone."""
    task = make_task("track_circle")
    with torch.inference_mode():
        play = Episodes(task)
        three, alone = play.seeded(7, 3), play.seeded(7, 1, 2)
        about = {"policy": "still", "seed": 7, "episode": 2}
        first = EpisodeRecorder(task, three, 2, **about)
        second = EpisodeRecorder(task, alone, 0, **about)
        for count in (3, 2, 1):
            present = len(three.world.steps)
            three = rows(three, torch.arange(present - count, present))
            actions = {"arm": torch.full((count, 3), 1.0)}
            three, outcome = play.step(three, actions)
            first.step(three, outcome, actions, count - 1)
            actions = {"arm": torch.full((1, 3), 1.0)}
            alone, outcome = play.step(alone, actions)
            second.step(alone, outcome, actions)
    one, other = first.log(), second.log()
    points = one.arms["arm"].points_mm
    np.testing.assert_allclose(points, other.arms["arm"].points_mm, atol=2e-5)
    assert np.abs(np.diff(points[:, -1], axis=0)).max() > 1e-3
    np.testing.assert_array_equal(one.arms["arm"].action_kPa[1:], 1.0)
    assert one.beam is None
    assert one.dose is None
    assert one.arms["arm"].radius_mm == 7.5


def test_each_episode_has_the_ring_of_its_own_lesion():
    vary = Randomisation(lesion_mm=4.0, lesions=3)
    task = make_task("circle_ablation", CircleAblationConfig(world=WorldConfig(randomisation=vary)))
    with torch.inference_mode():
        state = Episodes(task).seeded(1, 8)
        logs = [EpisodeRecorder(task, state, i, policy="none", seed=1).log() for i in range(8)]
    starts = {tuple(log.path_mm[0].round(3)) for log in logs}
    assert len(starts) == 3
    for log in logs:
        # The target lies on the path, and so does the band that counts as the ring.
        near = np.linalg.norm(log.path_mm - log.target_mm, axis=1).min()
        assert near < 0.2
        band = log.dose.points_mm[log.dose.zone == 1]
        away = np.linalg.norm(band[::50, None] - log.path_mm, axis=2).min(axis=1)
        assert away.max() < 1.1


def test_steps_after_the_end_are_left_out():
    task = make_task("track_circle")
    with torch.inference_mode():
        play = Episodes(task)
        state = play.seeded(0, 1)
        recorder = EpisodeRecorder(task, state, policy="still", seed=0)
        for _ in range(task.steps + 3):
            actions = {"arm": torch.zeros(1, 3)}
            state, outcome = play.step(state, actions)
            recorder.step(state, outcome, actions)
    log = recorder.log()
    assert recorder.done
    assert log.rows == task.steps + 1
    assert log.events[-1].text == "done"
    assert log.events[-1].time_s == pytest.approx(23.0)


def made_up(**series) -> EpisodeLog:
    """A log of six rows, 1 s apart, of one arm that stands still in a scene."""
    count = 6
    point = np.zeros((count, 2, 3))
    arm = ArmLog(
        *(np.zeros((count, 3)) for _ in range(3)),
        point,
        point,
        point,
        np.zeros((count, 3)),
        np.eye(4),
        7.5,
        0.0,
    )
    log = EpisodeLog(
        task="t",
        agents=("arm",),
        policy="d",
        on="rig",
        seed=1,
        episode=0,
        scene=None,
        dt_s=1.0,
        time_s=np.arange(6.0),
        arms={"arm": arm},
        targets_mm=np.zeros((count, 1, 3)),
        actuals_mm=np.zeros((count, 1, 3)),
        path_mm=np.zeros((0, 3)),
        measures={},
        rewards={},
        limits={"clearance_mm": 1.0, "view_fraction": 0.9, "time_s": 6.0},
    )
    return dataclasses.replace(log, **series)


def test_events_by_hand():
    log = made_up(
        beams={
            "laser": BeamLog(np.array([0, 0, 20, 20, 0, 0.0]), np.zeros((6, 3)), np.ones(6, bool))
        },
        views={"endoscope": np.array([0.0, 1.0, 1.0, 0.5, 0.5, 1.0])},
        clearance_mm=np.array([5.0, 5.0, 0.5, -0.1, 0.5, 2.0]),
        measures={"completion": np.array([0, 0, 0.5, 1, 1, 1]), "success": np.zeros(6)},
    )
    told = [(event.time_s, event.level, event.text) for event in find_events(log, "ended")]
    assert told == [
        (0.0, "info", "t by d in rig, seed 1"),
        (1.0, "info", "lesion in sight"),
        (2.0, "info", "beam on"),
        (2.0, "warning", "closer than 1 mm"),
        (3.0, "warning", "lesion lost"),
        (3.0, "error", "contact"),
        (3.0, "info", "ring cut all around"),
        (4.0, "info", "beam off"),
        (4.0, "info", "contact ended"),
        (5.0, "info", "lesion in sight"),
        (5.0, "info", "1 mm clear again"),
        (5.0, "error", "ended early"),
    ]
    assert find_events(log, "time out")[-1].text == "the time has elapsed"
    assert find_events(log, "failed")[-1].level == "error"


def test_later_changes_of_the_dose_win():
    none = np.zeros((3, 3))
    dose = DoseLog(
        "liver", none, none, *(np.zeros(3) for _ in range(5)), 1, 1.0, 1.0, 1.0,
        rows=np.array([2, 4]), starts=np.array([0, 2, 3]),
        sample=np.array([0, 1, 1]), dose_j_per_mm2=np.array([1.0, 2.0, 3.0]),
    )  # fmt: skip
    np.testing.assert_array_equal(dose.at(1), [0, 0, 0])
    np.testing.assert_array_equal(dose.at(3), [1, 2, 0])
    np.testing.assert_array_equal(dose.at(4), [1, 3, 0])


def test_what_is_no_episode_is_one_line(tmp_path):
    log = made_up()
    with pytest.raises(InputError, match=r"expected \.npz"):
        save_episode(log, tmp_path / "log.parquet")
    path = tmp_path / "log.npz"
    with pytest.raises(InputError, match="no such file"):
        load_episode(path)
    path.write_text("nothing")
    with pytest.raises(InputError, match="expected an episode"):
        load_episode(path)
    np.savez(path, a=np.arange(3))
    with pytest.raises(InputError, match="not a complete episode"):
        load_episode(path)
    np.savez(path, table=np.array([{"format": 1}], dtype=object))
    with pytest.raises(InputError, match="holds Python objects"):  # nothing is unpickled
        load_episode(path)
    save_episode(log, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError):
        load_episode(path)
    save_episode(log, path)
    with zipfile.ZipFile(path) as file, zipfile.ZipFile(tmp_path / "less.npz", "w") as less:
        for name in file.namelist()[1:]:
            less.writestr(name, file.read(name))
    with pytest.raises(InputError, match="not a complete episode"):
        load_episode(tmp_path / "less.npz")


def test_a_body_without_a_scene_is_in_the_log():
    """The slotted plate of the keyhole task: no organ, no beam, but clearance and a mesh."""
    task = make_task("keyhole")
    with torch.inference_mode():
        play = Episodes(task)
        state = play.seeded(0, 1)
        recorder = EpisodeRecorder(task, state, policy="still", seed=0)
        for _ in range(2):
            actions = {"arm": torch.zeros(1, 3)}
            state, outcome = play.step(state, actions)
            recorder.step(state, outcome, actions)
    log = recorder.log()
    assert [body.role for body in log.bodies] == ["keep-out"]
    assert log.beam is None
    np.testing.assert_array_equal(log.clearance_mm, log.measures["clearance_mm"])
    surface = log.bodies[0].vertices_mm
    line = log.arms["arm"].line_mm[-1]
    apart = np.linalg.norm(surface[:, None] - line, axis=2).min() - log.arms["arm"].radius_mm
    assert 0.0 < log.clearance_mm[-1] < apart + 0.5


def test_logs_know_the_roles_and_tools_of_scenes():
    assert parts.ROLES == mesh.ROLES
    assert parts.TOOLS == scene_spec.TOOLS
