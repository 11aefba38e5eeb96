"""What is to be treated is computed once for scenes of equal content, and again for any other."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.scene.folder import open_scene
from surgisoft.scene.spec import PHANTOM
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.scene import NOT_RANDOMISED
from surgisoft.tasks.world.treatment import rings, treatment_of

BAND_MM, POINTS = 2.0, 24


@pytest.fixture
def counted():
    """A plan of rings that counts how often it is asked."""
    asked = []

    def plan(scene, vary, band_mm, view_points):
        asked.append(scene.spec.lesion.diameter_mm)
        return rings(scene, vary, band_mm, view_points)

    return plan, asked


def test_a_scene_that_is_opened_again_is_not_planned_again(counted):
    plan, asked = counted
    one, other = (
        treatment_of(plan, open_scene(PHANTOM), NOT_RANDOMISED, BAND_MM, POINTS) for _ in range(2)
    )
    assert len(asked) == 1
    assert one is other
    fresh = rings(open_scene(PHANTOM), NOT_RANDOMISED, BAND_MM, POINTS)
    np.testing.assert_array_equal(one.paths_mm, fresh.paths_mm)
    np.testing.assert_array_equal(one.patches[0].points_mm, fresh.patches[0].points_mm)


def test_another_lesion_band_or_randomisation_is_planned_anew(counted):
    plan, asked = counted
    scene = open_scene(PHANTOM)
    smaller = scene.with_lesion(replace(scene.spec.lesion, diameter_mm=12.0))
    several = Randomisation(lesions=3, lesion_mm=2.0)
    plain = treatment_of(plan, scene, NOT_RANDOMISED, BAND_MM, POINTS)
    others = [
        treatment_of(plan, smaller, NOT_RANDOMISED, BAND_MM, POINTS),
        treatment_of(plan, scene, several, BAND_MM, POINTS),
        treatment_of(plan, scene, NOT_RANDOMISED, 1.5, POINTS),
        treatment_of(plan, scene, NOT_RANDOMISED, BAND_MM, 12),
    ]
    assert len(asked) == 5
    assert len(others[1].patches) == 3
    assert others[3].looks_mm.shape[1] == 12
    assert plain.looks_mm.shape[1] == POINTS
    assert np.ptp(others[0].paths_mm, axis=1).max() < 0.75 * np.ptp(plain.paths_mm, axis=1).max()


def test_a_plan_without_a_hash_is_asked_each_time():
    class Own:
        """A plan that compares by its values, and so has no hash."""

        asked = 0
        __hash__ = None

        def __call__(self, scene, vary, band_mm, view_points):
            Own.asked += 1
            return rings(scene, vary, band_mm, view_points)

    for _ in range(2):
        treatment_of(Own(), open_scene(PHANTOM), NOT_RANDOMISED, BAND_MM, POINTS)
    assert Own.asked == 2
