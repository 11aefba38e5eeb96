"""A small lesion's area: the expert treats it, and what is burnt beyond the margin counts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.contours import Plane, resampled, signed_distance_mm
from surgisoft.scene.folder import open_scene
from surgisoft.scene.lesion import nearest_on_surface
from surgisoft.scene.spec import PHANTOM, ContourSpec
from surgisoft.tasks.area_ablation import AreaAblation, AreaAblationConfig
from surgisoft.tasks.base import Episodes

SPOT = AreaAblationConfig(
    outlines=(ContourSpec("spot", centre_mm=(-37.093, -23.9786, 75.7208), diameter_mm=5.0),)
)


def played(task):
    """Last state and outcome of two scripted episodes."""
    episodes = Episodes(task)
    state = episodes.seeded(0, 2)
    with torch.inference_mode():
        for _ in range(150):
            state, outcome = episodes.step(state, task.script(state))
            if outcome.terminated.all():
                break
    return state, outcome


def test_the_expert_gives_the_dose_and_spares_the_rest():
    task = AreaAblation(SPOT)
    state, outcome = played(task)
    assert outcome.measures["success"].tolist() == [1.0, 1.0]
    patch, dose = task.scene.ablation.patch, state.world.scene.dose.dose.numpy()
    assert task.scene.ablation.cut_dose == pytest.approx(2.0)
    for row, share, healthy in zip(
        dose, outcome.measures["completion"], outcome.measures["healthy_mm2"], strict=True
    ):
        inside = patch.zone == 0
        treated = patch.areas_mm2[inside & (row >= 2.0)].sum() / patch.areas_mm2[inside].sum()
        assert share.item() == pytest.approx(treated, abs=1e-4)
        assert treated >= 0.98
        burnt = (patch.zone == 2) & (row >= task.scene.ablation.threshold)
        assert healthy.item() == pytest.approx(patch.areas_mm2[burnt].sum(), abs=1e-3)


def test_a_raster_with_gaps_is_followed_again_and_its_passes_are_counted():
    """Against the changes of the reference point, of which a pass has as many as the raster."""
    task = AreaAblation(replace(SPOT, pitch_mm=3.0, time_s=12.0))
    episodes = Episodes(task)
    state = episodes.seeded(0, 1)
    points, moved = len(task.scene.path_mm), 0
    with torch.inference_mode():
        for _ in range(task.steps):
            before = task.target_mm(state)
            state, outcome = episodes.step(state, task.script(state))
            moved += int((task.target_mm(state) != before).any())
            if outcome.terminated.all():
                break
    assert moved > 1.5 * points, "more than one pass"
    assert outcome.measures["passes"].item() == pytest.approx(moved / points, rel=1e-6)
    assert outcome.measures["completion"].item() < 0.98


def test_healthy_tissue_beyond_the_margin_counts_against_it():
    """A raster that runs 3 mm over an outline with a margin of half a millimetre."""
    task = AreaAblation(replace(SPOT, overrun_mm=3.0, spared_mm=0.5, time_s=30.0))
    state, outcome = played(task)
    assert (outcome.measures["completion"] >= 0.98).all()
    assert (outcome.measures["healthy_mm2"] > 5.0).all()
    assert outcome.measures["success"].tolist() == [0.0, 0.0]
    terms = task.rewards(state)["laser"]
    torch.testing.assert_close(terms["healthy"], -0.1 * outcome.measures["healthy_mm2"])
    torch.testing.assert_close(terms["treated"], outcome.measures["completion"])


def test_no_beam_crosses_the_notch_of_a_concave_outline():
    """A U of 20 x 10 mm with a notch of 5 x 6 mm, on the phantom about its lesion.

    Where the reference moves with the beam on it stays within the outline, the overrun of 0.5 mm
    and the allowance of half a pitch between lines; over the notch it leaps."""
    scene = open_scene(PHANTOM)
    axes, centre = frames.rotation_from_z(scene.ring.normal), scene.ring.centre_mm
    corners = [(-10, -5), (10, -5), (10, 5), (2.5, 5), (2.5, -1), (-2.5, -1), (-2.5, 5), (-10, 5)]
    fine = resampled(np.array([*corners, corners[0]], float), 0.5)[:-1]
    on, _ = nearest_on_surface(scene.organ.world_mesh, centre + fine @ axes[:, :2].T)
    outline = ContourSpec("u", tuple(map(tuple, on.tolist())))
    task = AreaAblation(AreaAblationConfig(outlines=(outline,), time_s=120.0))
    assert [each.closed for each in task.scene.stretches] == [False] * 3
    state = Episodes(task).seeded(0, 1)
    plane, leaps = Plane.of(scene.organ.world_mesh, on), 0
    for done in range(state.goal.steps - 1):
        here = replace(state, goal=replace(state.goal, done=torch.tensor([done])))
        if task.leaps(here).item():
            leaps += 1
            continue
        both = [task.target_mm(here, ahead)[0].double().numpy() for ahead in (0, 1)]
        way = plane.flat(np.linspace(*both, 5))
        assert signed_distance_mm(way, plane.flat(on)).max() <= 0.5 + 0.6 + 0.05
    assert 1 <= leaps <= 2


def test_success_by_hand():
    """98 % of the area and at most 5 mm^2 of healthy tissue; the margin between counts for
    neither."""
    task = AreaAblation(SPOT)
    state = Episodes(task).seeded(0, 4)
    zone_mm2 = torch.tensor([[0.981, 9.0, 4.9], [0.979, 9.0, 0.0], [0.981, 0.0, 5.1], [1.0, 0, 0]])
    zone_mm2[:, 0] *= task.area_mm2
    scene = state.world.scene
    low = scene.clearance.bodies_mm.clone()
    low[3] = -0.1
    scene = replace(
        scene,
        dose=replace(scene.dose, zone_mm2=zone_mm2),
        clearance=replace(scene.clearance, bodies_mm=low),
    )
    state = replace(state, world=replace(state.world, scene=scene))
    found = task.measures(state)
    assert found["success"].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert task.ended(state).tolist() == [True, False, True, True]
    torch.testing.assert_close(found["completion"], torch.tensor([0.981, 0.979, 0.981, 1.0]))
    torch.testing.assert_close(found["healthy_mm2"], torch.tensor([4.9, 0.0, 5.1, 0.0]))
    terms = task.rewards(state)["laser"]
    torch.testing.assert_close(terms["healthy"], torch.tensor([-0.49, 0.0, -0.51, 0.0]))
    torch.testing.assert_close(terms["treated"], found["completion"])


def test_what_does_not_fit_is_one_line():
    with pytest.raises(InputError, match=r"a dose of 0\.1 J/mm2 ablates nothing"):
        AreaAblation(replace(SPOT, dose_j_per_mm2=0.1))
    with pytest.raises(InputError, match=r"raster takes .* and time_s is 1 s"):
        AreaAblation(replace(SPOT, time_s=1.0))
    with pytest.raises(InputError, match="outlines: a second contour 'spot'"):
        AreaAblationConfig(outlines=SPOT.outlines * 2)
    with pytest.raises(InputError, match=r"treated_share is 1\.5"):
        replace(SPOT, treated_share=1.5)
