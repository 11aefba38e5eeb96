"""What is to be treated is computed once for scenes of equal content, and again for any other."""

import itertools
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.scene.folder import open_scene
from surgisoft.scene.spec import PHANTOM, ContourSpec
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.scene import NOT_RANDOMISED
from surgisoft.tasks.world.treatment import outlines, rings, treatment_of, windows

BAND_MM, POINTS = 2.0, 24
SPOT_MM = (-37.093, -23.9786, 75.7208)
"""A place on the phantom's liver."""


ASKED = []
"""Diameters of the lesions that a plan was asked about, mm."""
NUMBERS = itertools.count()
"""Numbers of plans, so that none is known from another test."""


@dataclass(frozen=True)
class Counted:
    """Rings, by a plan that notes each time that it is asked."""

    number: int

    def __call__(self, scene, vary, band_mm, view_points):
        ASKED.append(scene.spec.lesion.diameter_mm)
        return rings(scene, vary, band_mm, view_points)


@pytest.fixture
def counted():
    """A plan that nobody has asked before."""
    ASKED.clear()
    return Counted(next(NUMBERS)), ASKED


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


@dataclass
class Changing:
    """A plan whose values may change."""

    asked: int = 0

    def __call__(self, scene, vary, band_mm, view_points):
        self.asked += 1
        return rings(scene, vary, band_mm, view_points)

    __hash__ = object.__hash__


@dataclass(frozen=True)
class Unhashed(Counted):
    """A frozen plan with a value that has no hash."""

    number: list


def test_a_plan_that_may_answer_otherwise_is_asked_each_time(counted):
    changing = Changing()
    for plan in (changing, Unhashed([])):
        for _ in range(2):
            treatment_of(plan, open_scene(PHANTOM), NOT_RANDOMISED, BAND_MM, POINTS)
    assert changing.asked == 2
    assert len(ASKED) == 2


def test_the_window_around_a_point_ends_with_an_open_path_and_goes_round_a_closed_one():
    """Eleven points in steps of 1 mm, or ten around 10 mm; 2 mm on either side have to be seen."""
    for closed, count, first in ((False, 11, [0, 0, 0, 1, 2]), (True, 10, [8, 9, 0, 1, 2])):
        points = np.arange(count)[:, None] * np.ones(3)
        path = SimpleNamespace(points_mm=points, normals=-points, length_mm=10.0, closed=closed)
        seen, normals = windows(path, 2.0, 5)
        assert seen[0, :, 0].tolist() == first
        assert seen[5, :, 0].tolist() == [3, 4, 5, 6, 7]
        np.testing.assert_array_equal(normals, -seen)


def test_a_closed_path_shorter_than_the_window_is_seen_once():
    """Ten points around 10 mm, and 8 mm on either side: 5 mm are half of the way round."""
    points = np.arange(10)[:, None] * np.ones(3)
    path = SimpleNamespace(points_mm=points, normals=-points, length_mm=10.0, closed=True)
    assert windows(path, 8.0, 3)[0][0, :, 0].tolist() == [5, 0, 5]


def test_a_tasks_margin_is_added_to_that_of_each_closed_contour():
    """A circle of 5 mm with a margin of 1 mm, by 2 mm more: 11 mm across; an open line stays."""
    scene = open_scene(PHANTOM)
    circle = ContourSpec("circle", centre_mm=SPOT_MM, diameter_mm=5.0, margin_mm=1.0)
    line = ContourSpec("line", ((-51.0, -21.4, 73.7), (-48.2, -21.7, 74.2)), closed=False)
    grown, same = outlines(scene, (circle, line), 2.0, 0.25)
    assert grown.length_mm == pytest.approx(11.0 * np.pi, rel=0.03)
    at_once, plain = outlines(scene, (replace(circle, margin_mm=3.0), line), 0.0, 0.25)
    np.testing.assert_allclose(grown.points_mm, at_once.points_mm)
    np.testing.assert_array_equal(same.points_mm, plain.points_mm)
