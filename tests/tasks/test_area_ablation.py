"""A small lesion's area: the expert treats it, and what is burnt beyond the margin counts."""

from dataclasses import replace

import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene.spec import ContourSpec
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
    with pytest.raises(InputError, match=r"treated_share is 1\.5"):
        replace(SPOT, treated_share=1.5)
