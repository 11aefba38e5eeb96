"""Respiration by hand, both engines on a moving organ, and a cut that follows or waits."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene.collision import ExactScene
from surgisoft.scene.folder import open_scene
from surgisoft.scene.spec import PHANTOM
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.breathing_ablation import (
    BreathingAblation,
    BreathingAblationConfig,
    success_rule,
)
from surgisoft.tasks.episodes.file import load_episode, save_episode
from surgisoft.tasks.episodes.log import EpisodeRecorder
from surgisoft.tasks.world.pytree import rows
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.respiration import OrganMotion, Respiration, lujan
from tests.tasks.scripted import with_gap

PLACE = open_scene(PHANTOM)
QUICK = BreathingAblationConfig(
    scene=PLACE.with_lesion(replace(PLACE.spec.lesion, diameter_mm=7.0)),
    respiration=Respiration(amplitude_mm=(10.0, 12.0), rate_per_min=(20.0, 20.0)),
    cut_s=6.0,
    time_s=25.0,
)
"""A ring of 7 mm on the phantom, in a twentieth of the time."""


def test_the_phase_of_lujans_law():
    """b cos^2n(pi t / tau - phi): 0 at the end of exhalation, b half a period later."""
    at = torch.tensor([0.0, 1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    b, tau = torch.full_like(at, 12.0), torch.full_like(at, 4.0)
    for n, quarter in ((1, 6.0), (2, 3.0), (3, 1.5)):
        value, rate = lujan(at, b, tau, n)
        np.testing.assert_allclose(value, [0.0, quarter, 12.0, quarter, 0.0], atol=1e-12)
        np.testing.assert_allclose(rate[[0, 2, 4]], 0.0, atol=1e-12)
        step = 1e-6
        slope = (lujan(at + step, b, tau, n)[0] - lujan(at - step, b, tau, n)[0]) / (2.0 * step)
        np.testing.assert_allclose(rate, slope, atol=1e-6)
        phi = 0.5 * math.pi
        by_law = 12.0 * (math.pi * at / 4.0 - phi).cos() ** (2 * n)
        np.testing.assert_allclose(value, by_law, atol=1e-12)


@pytest.fixture(scope="module")
def task():
    return BreathingAblation(QUICK)


def test_breaths_are_irregular_and_continuous(task):
    """Amplitude and rate of many episodes; no jump at 10,000 instants of one of them."""
    wide = Respiration(amplitude_mm=(5.0, 20.0), rate_per_min=(10.0, 20.0), irregular=0.2)
    motion = type(task.motion)(
        wide, task.scene.geometry.bodies, np.zeros(3), 60.0, torch.device("cpu")
    )
    _, breaths = motion.start(streams(0, 2000))
    assert (breaths.begins_s[:, 0] <= 0.0).all()
    assert (breaths.begins_s[:, -1] > 60.0).all(), "enough breaths for the episode"
    mean = breaths.amplitude_mm.mean(1)
    assert (mean.min().item(), mean.max().item()) == pytest.approx((5.0, 20.0), abs=1.5)
    assert mean.mean().item() == pytest.approx(12.5, abs=0.3)
    spread = (breaths.amplitude_mm / mean[:, None]).std()
    assert spread.item() == pytest.approx(0.2, rel=0.1)
    rate = 60.0 / breaths.period_s.mean(1)
    assert rate.mean().item() == pytest.approx(15.0, abs=0.3)
    first = (breaths.amplitude_mm[:, 0], breaths.period_s[:, 0], breaths.period_s.mean(1), mean)
    own = torch.stack((first[0] / mean, first[1] / first[2], mean, rate))
    apart = torch.corrcoef(own)
    assert apart[0, 1].abs() < 0.1, "amplitude and period of a breath"
    assert apart[2, 3].abs() < 0.1, "mean amplitude and rate of an episode"
    phase = -breaths.begins_s[:, 0] / breaths.period_s[:, 0]
    counts = torch.histc(phase, 4, 0.0, 1.0) / len(phase)
    torch.testing.assert_close(counts, torch.full((4,), 0.25), rtol=0, atol=0.04)
    one = rows(breaths, torch.tensor([0]))
    moments = torch.linspace(0.0, 60.0, 10001).tolist()
    moved = torch.cat([motion.displacement_mm(one, at)[0] for at in moments])
    steepest = 1.3 * math.pi * float(one.amplitude_mm.max() / one.period_s.min()) * 0.006
    assert moved.diff().abs().max() < 2.0 * steepest
    assert moved.min() < 0.01


def test_the_motion_at_the_lesion_is_the_displacement(task):
    """Towards the feet (+y) by s, a quarter of it forwards (+z), whatever the strain's level."""
    centre = torch.tensor(task.motion.centre_mm, dtype=torch.float32)
    s = torch.tensor([0.0, 3.0, 10.0, 17.0])
    placement = task.motion.placement(s)
    moved = placement.points(centre.expand(4, 3)) - centre
    expected = torch.stack((0.0 * s, s, 0.25 * s), 1)
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-3)
    far = centre + torch.tensor([0.0, 40.0, 0.0])
    pulled = placement.points(far.expand(4, 3)) - far - expected
    # 40 mm towards the feet of it: 0.15 % shorter and 0.1 degrees of turn for each mm.
    level = (s / task.motion.largest_mm * 12).round() * task.motion.largest_mm / 12
    turn = torch.deg2rad(0.1 * s)
    along = 40.0 * (1.0 - 0.0015 * level)
    torch.testing.assert_close(pulled[:, 1], along * turn.cos() - 40.0, rtol=0, atol=1e-3)
    torch.testing.assert_close(pulled[:, 2].abs(), along * turn.sin(), rtol=0, atol=1e-3)
    back = placement.at_rest_of(placement.points(far.expand(4, 3)))
    torch.testing.assert_close(back, far.expand(4, 3), rtol=0, atol=1e-3)


@pytest.fixture(scope="module")
def cut(task):
    """States and outcomes of two scripted episodes that follow the organ, to the end of both."""
    episodes = Episodes(task)
    states, outcomes = [episodes.seeded(0, 2)], []
    with torch.inference_mode():
        while not (outcomes and outcomes[-1].terminated.all()) and len(outcomes) < 150:
            state, outcome = episodes.step(states[-1], task.script(states[-1]))
            states.append(state)
            outcomes.append(outcome)
    return states, outcomes


def test_the_expert_cuts_the_ring_while_it_moves(task, cut):
    states, outcomes = cut
    assert outcomes[-1].measures["success"].tolist() == [1.0, 1.0]
    moved = torch.stack([outcome.measures["breath_mm"] for outcome in outcomes])
    assert (moved.amax(0) > 8.0).all()
    patch, dose = task.scene.ablation.patch, states[-1].world.scene.dose.dose
    burnt = (dose >= task.scene.ablation.cut_dose).any(0).numpy()
    assert np.quantile(np.abs(patch.offset_mm[burnt]), 0.99) < 0.6, "on the tissue, not in space"
    errors = torch.stack([outcome.measures["tissue_error_mm"] for outcome in outcomes])
    assert errors.nanmean() < 0.1


def test_a_ring_with_a_gap_is_no_success(task, cut):
    """Two cut rings, one with a station uncut; untouched tissue at the start."""
    states, outcomes = cut
    assert task.measures(with_gap(states[-1], 0))["success"].tolist() == [0.0, 1.0]
    assert outcomes[0].measures["completion"].tolist() == [0.0, 0.0]
    assert outcomes[0].measures["success"].tolist() == [0.0, 0.0]


def test_a_log_holds_the_motion_and_shows_the_cut_on_the_organ(task, cut, tmp_path):
    """Ends of the beam lie on the ring of the organ at rest; in space they do not."""
    states, outcomes = cut
    recorder = EpisodeRecorder(task, states[0], policy="scripted", seed=0)
    for state, outcome in zip(states[1:], outcomes, strict=True):
        recorder.step(state, outcome, {})
    save_episode(recorder.log(), tmp_path / "episode.npz")
    log = load_episode(tmp_path / "episode.npz")
    beam = log.beams["laser"]

    def off_ring_mm(ends):
        away = ends[beam.on][:, None] - log.path_mm
        return np.linalg.norm(away, axis=2).min(axis=1)

    assert off_ring_mm(log.at_rest_mm(beam.end_mm)).max() < 0.6
    assert off_ring_mm(beam.end_mm).max() > 5.0
    support, organ = log.body("tray"), log.body(log.dose.body)
    assert support.motion is None
    moved = organ.moved_mm(20) - organ.vertices_mm
    assert abs(moved[:, 1].mean() - log.measures["breath_mm"][20]) < 1.0


def test_both_engines_agree_over_whole_episodes(task, cut):
    """Clearance, the beam's end and its normal, at every seventh step; also of a closer arm."""
    scene = task.scene
    exact = ExactScene(scene.geometry.bodies, scene.geometry.radii_mm)
    near, all_of_them = [], []
    for state in cut[0][::7]:
        world = rows(state.world, torch.tensor([0]))
        poses = scene.placement(world.scene.breaths)
        lines = {name: part.line_mm for name, part in world.arms.items()}
        beam = world.arms["laser"]
        hit = exact.cast(beam.tip_mm, beam.tip_direction, scene.beam_mm, lines, "laser", poses)
        found = world.scene.hits["laser"]
        assert torch.equal(hit.struck.int(), found.struck.int())
        torch.testing.assert_close(hit.point_mm, found.point_mm, rtol=0, atol=1e-3)
        torch.testing.assert_close(hit.normal, found.normal, rtol=0, atol=1e-3)
        # The laser arm, pushed along its beam until it nearly touches the organ.
        away = (found.distance_mm - 8.0)[:, None, None] * beam.tip_direction[:, None]
        for arms in (lines, {**lines, "laser": lines["laser"] + away}):
            one = exact.clearance(arms, poses).bodies_mm
            other = scene.collision.clearance(arms, poses).bodies_mm
            all_of_them.append((one - other).abs().max())
            near.append((one - other).abs()[one < 4.0])
    near = torch.cat(near)
    assert len(near) > 10
    assert near.max() < 0.1, "what the docs promise near contact"
    assert torch.stack(all_of_them).max() < 0.5


def test_the_gated_beam_waits_for_the_end_of_exhalation(task):
    """The beam is on only within the gate, and its target stands still."""
    gated = BreathingAblation(replace(QUICK, mode="gated", gate_mm=1.5))
    episodes = Episodes(gated)
    state, seen = episodes.seeded(1, 2), []
    with torch.inference_mode():
        for _ in range(90):
            before = gated.displacement_mm(state)[0]
            resting = gated.resting_mm(state)
            torch.testing.assert_close(gated.target_mm(state), resting)
            state, _ = episodes.step(state, gated.script(state))
            assert not (state.goal.fired & (before > 1.5)).any()
            seen.append(state.goal.fired)
    fired = torch.stack(seen).float().mean(0)
    assert (fired > 0.15).all()
    assert (fired < 0.8).all()
    assert "while the organ is within 1.5 mm" in success_rule(gated.config)


def test_bad_respiration_is_one_line():
    with pytest.raises(InputError, match="amplitude_mm is 5 to 2, expected two rising"):
        Respiration(amplitude_mm=(5.0, 2.0))
    with pytest.raises(InputError, match="asymmetry is 4, expected 1, 2 or 3"):
        Respiration(asymmetry=4)
    with pytest.raises(InputError, match="feet and front lie along each other"):
        Respiration(feet=(0.0, 0.0, 2.0))
    with pytest.raises(InputError, match="gate"):
        BreathingAblationConfig(mode="gate")


def test_the_organ_turns_about_the_lesion_as_it_moves():
    """10 mm towards the feet (y) and 2.5 mm forwards (z), turned by 1 degree from z towards -y."""
    plain = Respiration(shorten_per_mm=0.0, deepen_per_mm=0.0, shear_per_mm=0.0)
    motion = OrganMotion(plain, [], np.zeros(3), 60.0, torch.device("cpu"))
    found = motion.placement(torch.tensor([10.0])).points(torch.tensor([[0.0, 0.0, 10.0]]))
    angle = math.radians(1.0)
    expected = [0.0, 10.0 - 10.0 * math.sin(angle), 2.5 + 10.0 * math.cos(angle)]
    np.testing.assert_allclose(found[0], expected, atol=1e-4)


def test_targets_ahead_follow_the_present_rate(task):
    state = Episodes(task).seeded(3, 16)
    now, rate = task.displacement_mm(state)
    assert rate.abs().max() > 5.0
    for ahead in (0, 2):
        later = (now + 0.1 * ahead * rate).clamp(min=0.0)
        expected = task.motion.placement(later).points(task.resting_mm(state, ahead))
        torch.testing.assert_close(task.target_mm(state, ahead), expected)


def test_a_gated_camera_stays_and_only_a_beam_that_burns_has_an_error_on_tissue():
    gated = BreathingAblation(replace(QUICK, mode="gated"))
    state = Episodes(gated).seeded(3, 8)
    assert gated.displacement_mm(state)[0].max() > 1.0
    assert torch.equal(gated.watched_mm(state), gated.centre_mm(state))
    assert not state.goal.fired.any()
    assert gated.measures(state)["tissue_error_mm"].isnan().all()
