"""The laser's dose against closed forms of Gaussian beams and hand-computed rings."""

import math
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.ablation import (
    AblationMap,
    Tissue,
    cut_compiled,
    longest_run,
    sweep_fluence,
    vaporisation_j_per_mm3,
)
from surgisoft.scene.camera import Camera
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.dose_patch import HEALTHY, LESION, RING, cut_patch, cut_patches, samples_at
from surgisoft.scene.mesh import Body
from surgisoft.scene.render import Renderer
from tests.scene.engines import ON_ACCELERATORS
from tests.scene.shapes import ball, box

WAIST = 0.4
DOWN = torch.tensor([0.0, 0.0, -1.0])


def circle(radius, height, count=240):
    turn = np.arange(count) * 2 * math.pi / count
    ring = np.stack((radius * np.cos(turn), radius * np.sin(turn), 0 * turn + height), axis=1)
    return ring, np.tile([0, 0, 1.0], (count, 1))


@pytest.fixture(scope="module")
def slab():
    """A ring of 10 mm radius on the flat top of a box; 2 mm band."""
    ring, normals = circle(10.0, 5.0)
    mesh = box((60, 60, 10))
    return cut_patch(mesh, ring, normals, np.array([0, 0, 5.0]), spacing_mm=0.25)


def swept(ablation, points, dt, power=2.0, directions=None):
    """The state after the beam has gone through points (T, 3), one a step."""
    directions = DOWN.expand(len(points), 3) if directions is None else directions
    on = torch.ones(1, dtype=torch.bool)
    state = ablation.start(points[:1], directions[:1], on)
    for point, direction in zip(points[1:], directions[1:], strict=True):
        state = ablation.advance(state, point[None], direction[None], on, power, dt)
    return state


def ring_points(steps, share=1.0, radius=10.0):
    turn = torch.linspace(0, 2 * math.pi * share, steps + 1, dtype=torch.float64)
    return torch.stack((radius * turn.cos(), radius * turn.sin(), 0 * turn + 5.0), 1).float()


def test_a_resting_beam_leaves_a_gaussian(slab):
    ablation = AblationMap(slab, WAIST)
    place = torch.tensor([[9.7, 1.3, 5.0]])
    state = swept(ablation, place.repeat(6, 1), dt=0.1, power=3.0)
    energy = 3.0 * 0.5
    gap = np.linalg.norm(slab.points_mm - place.numpy(), axis=1)
    top = slab.normals[:, 2] > 0.5
    truth = 2 * energy / (math.pi * WAIST**2) * np.exp(-2 * gap**2 / WAIST**2) * top
    near = gap < 2.0 * WAIST
    np.testing.assert_allclose(state.dose[0].numpy()[near], truth[near], rtol=1e-4)
    deposited = (state.dose[0].double().numpy() * slab.areas_mm2).sum()
    assert deposited == pytest.approx(energy, rel=0.01)
    assert state.zone_j.sum().item() == pytest.approx(energy, rel=0.01)
    assert state.delivered_j.item() == pytest.approx(energy, rel=1e-6)


@pytest.mark.parametrize("degrees", [0, 30, 60, 75])
@pytest.mark.parametrize("turn", [0.3, 2.0])
def test_energy_is_kept_at_any_incidence(slab, degrees, turn):
    tilt = math.radians(degrees)
    side = [math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), -math.cos(tilt)]
    ablation = AblationMap(slab, WAIST)
    points = torch.tensor([[8.0, 0.0, 5.0], [8.5, 2.0, 5.0], [6.0, 4.0, 5.0]])
    state = swept(ablation, points, 0.2, 5.0, torch.tensor(side).expand(3, 3))
    assert state.zone_j.sum().item() == pytest.approx(2.0, rel=0.01)
    assert state.zone_j.sum() == pytest.approx(
        (state.dose[0].double().numpy() * slab.areas_mm2).sum(), rel=1e-4
    )


def test_energy_is_kept_on_a_curved_organ_with_coarse_faces():
    mesh = ball(40.0, 3)
    ring, _ = circle(8.0, 0.0)
    ring[:, 2] = np.sqrt(40.0**2 - 64)
    normals = frames.normalise(ring)
    patch = cut_patch(mesh, ring, normals, np.array([0, 0, 40.0]), spacing_mm=0.2)
    checker = CollisionChecker([Body("organ", "organ", mesh)])
    eye = np.array([5.0, -12.0, 80.0])
    for waist in (0.3, 0.5):
        ablation = AblationMap(patch, waist)
        aims = frames.normalise(ring[::8] - eye)
        hits = checker.cast(np.tile(eye, (len(aims), 1)), aims, 200.0)
        state = swept(
            ablation, torch.tensor(hits.point_mm).float(), 0.1, 1.0, torch.tensor(aims).float()
        )
        assert state.zone_j.sum().item() == pytest.approx(0.1 * (len(aims) - 1), rel=0.01)


@given(
    length=st.floats(1e-4, 8.0),
    along=st.floats(-3.0, 10.0),
    across=st.floats(0.0, 1.0),
    waist=st.floats(0.2, 1.0),
)
@settings(max_examples=80, deadline=None)
def test_a_sweep_is_the_integral_of_resting_beams(length, along, across, waist):
    energy = 1.7

    def resting(share):
        r2 = (along - share * length) ** 2 + across**2
        return 2 * energy / (math.pi * waist**2) * math.exp(-2 * r2 / waist**2)

    nearest = min(max(along / length, 0.0), 1.0)
    truth = quad(resting, 0, nearest, limit=200)[0] + quad(resting, nearest, 1, limit=200)[0]
    began, ended = torch.zeros(1, 3).double(), torch.tensor([[length, 0, 4.0]]).double()
    point = torch.tensor([[along, across, -2.0]]).double()
    found = sweep_fluence(
        began,
        ended,
        torch.tensor([[0, 0, -1.0]]).double(),
        torch.tensor([energy]).double(),
        waist,
        point,
    )
    assert found.item() == pytest.approx(truth, rel=1e-4, abs=1e-9)


def test_steps_of_any_length_give_the_same_dose(slab):
    """0.02 s against 0.2 s over a whole ring in 20 s: 2 % of the peak, anywhere."""
    ablation = AblationMap(slab, WAIST, Tissue(absorption_per_mm=2.0))
    fine = swept(ablation, ring_points(1000), 0.02)
    one, other = fine.dose.numpy()[0], None
    for dt, steps in ((0.05, 400), (0.1, 200), (0.2, 100)):
        coarse = swept(ablation, ring_points(steps), dt)
        other = coarse.dose.numpy()[0]
        assert np.abs(one - other).max() < 0.02 * one.max()
        assert coarse.zone_j.sum().item() == pytest.approx(fine.zone_j.sum().item(), rel=1e-3)
        here, there = ablation.report(fine), ablation.report(coarse)
        assert here.completion.item() == pytest.approx(there.completion.item(), abs=0.02)
        assert here.width_mm.item() == pytest.approx(there.width_mm.item(), rel=0.02)


def test_a_cut_is_as_wide_as_the_threshold_says(slab):
    """Line fluence H0 = sqrt(2 / pi) P / (w v); cut where H0 exp(-2 r^2 / w^2) > H_th."""
    tissue = Tissue(absorption_per_mm=2.0)
    ablation = AblationMap(slab, WAIST, tissue)
    speed, power = 2 * math.pi * 10 / 20.0, 6.0
    state = swept(ablation, ring_points(400), 0.05, power)
    peak = math.sqrt(2 / math.pi) * power / (WAIST * speed)
    width = WAIST * math.sqrt(2 * math.log(peak / tissue.threshold_j_per_mm2))
    report = ablation.report(state)
    assert report.completion.item() == 1.0
    assert report.largest_gap_mm.item() == 0.0
    assert report.width_mm.item() == pytest.approx(width, rel=0.03)
    assert state.peak.median().item() == pytest.approx(peak, rel=0.02)
    assert tissue.depth_mm(torch.tensor(peak)).item() == pytest.approx(
        math.log(peak / tissue.threshold_j_per_mm2) / 2.0
    )


@pytest.mark.parametrize("share", [0.25, 0.5, 0.9])
def test_an_open_ring_reports_its_gap(slab, share):
    ablation = AblationMap(slab, WAIST, Tissue(absorption_per_mm=5.0))
    report = ablation.report(swept(ablation, ring_points(200, share), 0.05, 5.0))
    assert report.completion.item() == pytest.approx(share, abs=0.02)
    assert report.largest_gap_deg.item() == pytest.approx(360 * (1 - share), abs=9)
    assert report.largest_gap_mm.item() == pytest.approx(62.8 * (1 - share), abs=1.6)
    line = math.sqrt(2 / math.pi) * 5.0 * 10.0 / (WAIST * 2 * math.pi * 10.0 * share)
    width = WAIST * math.sqrt(2 * math.log(line / ablation.threshold))
    assert report.width_mm.item() == pytest.approx(width, rel=0.06), "where the ring is cut"


def test_each_environment_cuts_the_ring_that_it_was_given_and_beams_add_up():
    """Rings of 10 and 8 mm radius; uncut, the gap is all of the ring's own length."""
    rings = [(*circle(radius, 5.0), np.array([0, 0, 5.0])) for radius in (10.0, 8.0)]
    ablation = AblationMap(cut_patches(box((60, 60, 10)), rings, 0.36, 1.0, 1.0), WAIST)
    points = torch.tensor([[[10.0, 0.0, 5.0], [0.0, 8.0, 5.0]]] * 2)
    aim, on = DOWN.expand(2, 2, 3), torch.ones(2, 2, dtype=torch.bool)
    state = ablation.start(points, aim, on, ring=torch.tensor([0, 1]))
    gaps = 2.0 * math.pi * torch.tensor([10.0, 8.0])
    torch.testing.assert_close(ablation.report(state).largest_gap_mm, gaps, rtol=1e-3, atol=0)
    power = torch.tensor([[2.0, 3.0], [4.0, 0.0]])
    state = ablation.advance(state, points, aim, on, power, 0.1)
    torch.testing.assert_close(ablation.report(state).delivered_j, torch.tensor([0.5, 0.4]))
    one = ablation.start(points[:1, 0], aim[:1, 0], on[:1, 0], ring=torch.tensor([1]))
    assert ablation.alone(one).progress() == pytest.approx((0.0, gaps[1].item(), 0.0), rel=1e-3)
    first = torch.tensor([True, False])
    state = ablation.reset(state, first, points, aim, on, ring=torch.tensor([1, 0]))
    assert state.ring.tolist() == [1, 1], "only the first was begun anew"


def test_a_cut_beside_the_band_is_no_ring_but_healthy_tissue(slab):
    ablation = AblationMap(slab, WAIST)
    outside = ablation.report(swept(ablation, ring_points(200, radius=12.0), 0.05))
    assert outside.completion.item() == 0.0
    assert outside.largest_gap_deg.item() == 360.0
    assert outside.width_mm.item() == 0.0
    assert outside.healthy_j.item() == pytest.approx(20.0, rel=0.01)
    line = math.sqrt(2 / math.pi) * 2.0 * 10.0 / (WAIST * 2 * math.pi * 12.0)
    width = WAIST * math.sqrt(2 * math.log(line / ablation.threshold))
    assert outside.healthy_mm2.item() == pytest.approx(width * 2 * math.pi * 12.0, rel=0.03)
    inside = ablation.report(swept(ablation, ring_points(200, radius=8.0), 0.05))
    assert inside.healthy_j.item() == pytest.approx(0.0, abs=0.05)
    assert inside.lesion_mm2.item() > 30.0
    far = ablation.report(swept(ablation, ring_points(200, radius=25.0), 0.05))
    assert far.healthy_j.item() == pytest.approx(20.0, rel=1e-3)


def test_depth_asks_for_more_than_the_surface(slab):
    points = ring_points(200)
    shallow = AblationMap(slab, WAIST, Tissue(2.0))
    deep = AblationMap(slab, WAIST, Tissue(2.0), depth_mm=0.5)
    assert deep.cut_dose == pytest.approx(shallow.threshold * math.e)
    power = 1.5 * shallow.threshold / (math.sqrt(2 / math.pi) / (WAIST * 2 * math.pi))
    assert shallow.report(swept(shallow, points, 0.05, power)).completion.item() == 1.0
    assert deep.report(swept(deep, points, 0.05, power)).completion.item() == 0.0
    assert deep.report(swept(deep, points, 0.05, 2 * power)).completion.item() == 1.0


@pytest.mark.parametrize("tilt", [0.0, 5.0])
@pytest.mark.parametrize("engine", ON_ACCELERATORS)
def test_deposits_of_the_engines_agree(slab, engine, tilt):
    ablation = AblationMap(slab, WAIST)
    rng = np.random.default_rng(0)
    count = 12
    place = lambda: torch.tensor(rng.uniform([-13, -13, 4.9], [13, 13, 5.1], (count, 3))).float()  # noqa: E731
    began, ended = place(), place()
    aim = frames.normalise(torch.tensor(rng.normal([tilt, 0, -2.0], 0.5, (count, 3))).float())
    aim[0] = -aim[0]  # from below: the surface faces away
    energy = torch.tensor(rng.uniform(0.1, 1.0, count)).float()
    state = ablation.start(began, aim, torch.ones(count, dtype=torch.bool))
    names = ("dose", "peak", "band_mm2", "zone_mm2", "zone_j")
    beam = (began, ended, aim, energy, state.ring)
    one = ablation.deposit_compiled(*beam, *(getattr(state, n).clone() for n in names))
    deposit = getattr(ablation, f"deposit_{engine}")
    two = deposit(*beam, *(getattr(state, n).clone() for n in names))
    for _ in range(2):  # sums of one sweep are not those of the next
        one, two = ablation.deposit_compiled(*beam, *one), deposit(*beam, *two)
    assert not one[0][0].any()
    assert not two[0][0].any()
    peak = one[0].max().item()
    torch.testing.assert_close(one[0], two[0], atol=1e-4 * peak, rtol=1e-3)
    torch.testing.assert_close(one[1], two[1], atol=1e-4 * peak, rtol=1e-3)
    assert one[2].any()
    torch.testing.assert_close(one[2], two[2], atol=0.05, rtol=0.01)
    torch.testing.assert_close(one[3], two[3], atol=0.05, rtol=0.01)
    torch.testing.assert_close(one[4], two[4], atol=1e-4, rtol=1e-3)


def test_environments_are_apart_and_resets_are_by_mask(slab):
    ablation = AblationMap(slab, WAIST)
    points = torch.stack([ring_points(40)[i : i + 3] for i in (0, 10, 20, 30)], 1)
    on, aim = torch.ones(4, dtype=torch.bool), DOWN.expand(4, 3)
    state = ablation.start(points[0], aim, on)
    state = ablation.advance(state, points[1], aim, on, torch.tensor([1.0, 2.0, 0.0, 4.0]), 0.1)
    single = swept(ablation, points[:2, 1], 0.1, 2.0)
    torch.testing.assert_close(state.dose[1], single.dose[0])
    assert not state.dose[2].any()
    torch.testing.assert_close(state.delivered_j, torch.tensor([0.1, 0.2, 0.0, 0.4]))
    mask = torch.tensor([True, False, False, True])
    later = ablation.reset(state, mask, points[2], aim, on)
    assert not later.dose[mask].any()
    assert torch.equal(later.dose[1], state.dose[1])
    assert torch.equal(later.last_point_mm[0], points[2, 0])
    assert state.dose[0].any(), "reset is out of place"
    same = ablation.reset(state, mask, points[2], aim, on, in_place=True)
    assert same.dose.data_ptr() == state.dose.data_ptr()
    for name in ("dose", "peak", "zone_j", "delivered_j", "last_point_mm", "last_on"):
        assert torch.equal(getattr(same, name), getattr(later, name))
    out = ablation.advance(later, points[0], aim, on, 3.0, 0.1)
    inside = ablation.advance(same, points[0], aim, on, 3.0, 0.1, in_place=True)
    assert torch.equal(out.dose, inside.dose)


def test_beams_off_the_organ_and_broken_ones_do_nothing(slab):
    ablation = AblationMap(slab, WAIST)
    points = ring_points(40)[:3]
    aim = DOWN.expand(3, 3)
    state = ablation.start(points, aim, torch.zeros(3, dtype=torch.bool))
    off = ablation.advance(state, points, aim, torch.zeros(3, dtype=torch.bool), 5.0, 0.1)
    assert not off.dose.any()
    broken = points.clone()
    broken[1] = float("nan")
    on = torch.tensor([True, True, False])
    half = ablation.advance(off, broken, aim, on, 5.0, 0.1)
    torch.testing.assert_close(half.delivered_j, torch.tensor([0.25, 0.0, 0.0]))
    again = ablation.advance(half, points, aim, torch.ones(3, dtype=torch.bool), 5.0, 0.1)
    torch.testing.assert_close(again.delivered_j, torch.tensor([0.75, 0.25, 0.25]))
    assert all(getattr(again, n).isfinite().all() for n in ("dose", "peak", "zone_j"))


def test_the_patch_covers_its_area_and_knows_its_zones(slab):
    inside = slab.zone == LESION
    assert slab.areas_mm2[inside].sum() == pytest.approx(math.pi * 9**2, rel=0.01)
    assert slab.areas_mm2[slab.zone == RING].sum() == pytest.approx(math.pi * (121 - 81), rel=0.01)
    healthy = slab.areas_mm2[(slab.zone == HEALTHY) & (slab.normals[:, 2] > 0.5)].sum()
    assert healthy == pytest.approx(math.pi * (14**2 - 11**2), rel=0.02)
    radius = np.linalg.norm(slab.points_mm[:, :2], axis=1)
    top = slab.normals[:, 2] > 0.5
    np.testing.assert_allclose(slab.offset_mm[top], radius[top] - 10.0, atol=0.01)
    turn = np.arctan2(slab.points_mm[:, 1], slab.points_mm[:, 0]) % (2 * math.pi)
    station = (turn / (2 * math.pi) * slab.stations).astype(int)
    wrong = (station != slab.station) & (slab.zone == RING)
    assert wrong.mean() < 0.01
    found = samples_at(slab, slab.points_mm[::97])
    np.testing.assert_array_equal(found, np.arange(len(slab.faces))[::97])
    assert (samples_at(slab, np.array([[0, 0, 9.0], [1e9, 0, 0]])) == -1).all()


def test_rings_run_either_way_round():
    ring, normals = circle(10.0, 5.0)
    mesh = box((60, 60, 10))
    centre = np.array([0, 0, 5.0])
    one = cut_patch(mesh, ring, normals, centre, 0.5)
    two = cut_patch(mesh, ring[::-1], normals, centre, 0.5)
    np.testing.assert_allclose(one.offset_mm, two.offset_mm, atol=1e-9)


def cuts_of_the_engines():
    if find_spec("warp") is None:
        return [cut_compiled]
    from surgisoft.scene.warp_dose import cut_warp

    return [cut_compiled, cut_warp]


@given(st.lists(st.booleans(), min_size=1, max_size=30))
@settings(max_examples=200, deadline=None)
def test_longest_run_goes_round_the_ring(flags):
    best = 0
    for start in range(len(flags)):
        run = 0
        while run < len(flags) and flags[(start + run) % len(flags)]:
            run += 1
        best = max(best, run)
    assert longest_run(torch.tensor([flags])).item() == best
    peak, band = (~torch.tensor([flags])).float(), torch.rand(1, len(flags))
    for cuts in cuts_of_the_engines():
        cut, gap, burnt = cuts(peak, band, 1.0)
        assert gap.item() == best
        assert cut.item() == len(flags) - sum(flags)
        assert burnt.item() == pytest.approx((band * peak).sum().item(), rel=1e-6)


def test_tissue_numbers_are_the_sources():
    assert vaporisation_j_per_mm3() == pytest.approx(0.745 * 1.06e-3 * (4.18 * 63 + 2257))
    water_2010_nm = 4e6 * math.pi * 9.904e-4 / 2009.0  # 1/mm, k of Segelstein 1981
    tissue = Tissue(0.745 * water_2010_nm)
    assert tissue.threshold_j_per_mm2 * 100 == pytest.approx(43, abs=1)
    assert 0.5 < 29.0 / (tissue.threshold_j_per_mm2 * 100) < 1.5
    assert tissue.depth_mm(torch.tensor([0.0, tissue.threshold_j_per_mm2])).tolist() == [0, 0]


def test_burnt_tissue_is_dark_in_the_picture(slab):
    mesh = box((60, 60, 10))
    renderer = Renderer([Body("liver", "organ", mesh)], Camera(), 120, 120)
    pose = frames.look_at(np.array([0, 0, 45.0]), np.array([0, 0, 5.0]))
    ablation = AblationMap(slab, WAIST)
    state = swept(ablation, ring_points(200, 0.5), 0.05)
    before = renderer.image(pose).astype(int).sum(axis=2)
    after = renderer.image(pose, paint={"liver": ablation.paint(state)}).astype(int).sum(axis=2)
    darker = before - after > 60
    rows, columns = np.nonzero(darker)
    scale = 60 / math.tan(math.radians(35)) / 40.0
    radius = np.hypot(rows - 59.5, columns - 59.5) / scale
    assert darker.sum() > 40
    assert radius.mean() == pytest.approx(10.0, abs=0.3)


def test_bad_requests_are_named(slab):
    ring, normals = circle(10.0, 5.0)
    mesh, centre = box((60, 60, 10)), np.array([0, 0, 5.0])
    with pytest.raises(InputError, match="waist is 0"):
        AblationMap(slab, 0.0)
    with pytest.raises(InputError, match="too coarse for a waist"):
        AblationMap(slab, 0.1)
    with pytest.raises(InputError, match="absorption_per_mm is -1"):
        Tissue(-1.0)
    with pytest.raises(InputError, match="nowhere near"):
        cut_patch(mesh, ring + 200.0, normals, centre + 200.0, 0.3)
    aside = np.array([25.0, 0, 0])
    with pytest.raises(InputError, match="no surface below"):
        cut_patch(mesh, np.add(ring, aside), normals, centre + aside, 0.3)
    with pytest.raises(InputError, match="at most 400000"):
        cut_patch(mesh, ring, normals, centre, 0.01)
    with pytest.raises(InputError, match="band"):
        cut_patch(mesh, ring, normals, centre, 0.3, band_mm=20.0)
