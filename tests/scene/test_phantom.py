"""The phantom liver: a liver's size, sound meshes, made by its own script, ready for every task."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from surgisoft.scene.bvh import build_tree
from surgisoft.scene.camera import view
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.check import VIEW_EVERY, check_scene
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.folder import open_scene
from surgisoft.tasks.world.reach import reaches_of

FOLDER = Path(__file__).resolve().parents[2] / "scenes" / "phantom_liver"


@pytest.fixture(scope="module")
def scene():
    return open_scene(FOLDER)


@pytest.fixture(scope="module")
def build():
    spec = importlib.util.spec_from_file_location("build_phantom", FOLDER / "build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_liver_has_a_livers_proportions(scene):
    mesh = scene.organ.mesh
    width, depth, height = np.ptp(mesh.bounds_mm, axis=0)
    assert width == pytest.approx(180.0, abs=15.0)
    assert 110.0 < depth < 150.0
    assert 70.0 < height < 110.0
    assert 0.6e6 < mesh.volume_mm3 < 1.2e6
    # the right lobe is the larger: more than half of the volume on its side of the fissure
    corners = mesh.triangles_mm
    parts = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    middle = corners.sum(axis=1) / 4.0
    assert (parts @ middle[:, 0]) / parts.sum() < np.mean(mesh.bounds_mm[:, 0])


def test_the_meshes_are_closed_and_their_faces_well_shaped(scene):
    for body in scene.bodies:
        assert body.mesh.is_watertight
        assert body.mesh.volume_mm3 > 0.0
    organ = scene.organ.mesh
    assert 10_000 <= len(organ.faces) <= 30_000
    smallest = np.degrees(organ.corner_angles_rad.min(axis=1))
    assert np.percentile(smallest, 1) > 30.0
    cosine = np.einsum("fk,fck->fc", organ.face_normals, organ.vertex_normals[organ.faces])
    assert np.mean(cosine > np.cos(np.radians(15.0))) > 0.97  # smooth


def test_the_meshes_lie_on_the_scripts_own_formulas(scene, build):
    """Every committed vertex, taken back to the anatomical frame, is on the implicit surface.

    How high the organs were lifted onto the tray is not asked of the script but found: it is the
    one number that brings the liver's vertices onto the liver.
    """
    turn = build.resting(np.eye(3)) - build.resting(np.zeros((1, 3)))

    def off(mesh, field, lift_mm, every=1):
        back = (mesh.vertices_mm[::every] - [0.0, 0.0, lift_mm]) @ turn.T + build.VISCERAL_POINT
        return np.abs(field(back))

    meshes = {body.name: body.mesh for body in scene.bodies}
    lift = minimize_scalar(
        lambda h: off(meshes["liver"], build.liver, h, 50).mean(), bounds=(0.0, 30.0)
    ).x
    assert off(meshes["liver"], build.liver, lift).max() < 0.02
    assert off(meshes["gallbladder"], build.gallbladder, lift).max() < 0.02
    lowest = min(meshes[name].vertices_mm[:, 2].min() for name in ("liver", "gallbladder"))
    assert lowest == pytest.approx(0.0, abs=1e-12)


def test_the_script_builds_them_again(scene, build):
    pytest.importorskip("skimage", reason="scikit-image meshes the formulas")
    coarse = build.bodies(fineness=1.8)
    for body in scene.bodies:
        mesh = coarse[body.name]
        assert mesh.is_watertight
        assert mesh.volume_mm3 == pytest.approx(body.mesh.volume_mm3, rel=0.05)
        np.testing.assert_allclose(mesh.bounds_mm, body.mesh.bounds_mm, atol=2.5)
    for name in ("liver", "gallbladder"):
        smallest = np.degrees(coarse[name].corner_angles_rad.min(axis=1))
        assert np.percentile(smallest, 1) > 30.0
    liver = build_tree(scene.organ.mesh)
    off, _ = liver.nearest(coarse["liver"].vertices_mm)
    assert np.sqrt(np.mean(off**2)) < 0.3


def test_the_scene_is_ready(scene):
    verdict = check_scene(scene, reaches_of(scene))
    assert verdict.good
    assert verdict.work.covered == 1.0
    assert verdict.work.viewed == 1.0
    assert scene.spec.lesion.diameter_mm == 20.0
    assert [(m.length_mm, m.diameter_mm) for m in scene.spec.mounts] == [(70.0, 15.0)] * 2


@pytest.mark.parametrize(
    ("place", "hides"), [((-73.0, -79.0, 185.0), "laser"), ((-108.0, 38.0, 86.0), "organ")]
)
def test_the_check_sees_the_ring_between_all_arms_and_bodies(scene, place, hides):
    """An endoscope behind the laser, and one behind the organ: the view of each moment alone."""
    spec, ring = scene.spec, scene.ring
    laser, endoscope = spec.mount("laser"), spec.mount("endoscope")
    way = np.array(spec.lesion.centre_mm) - place if hides == "organ" else laser.direction
    moved = replace(endoscope, position_mm=place, direction=tuple(way))
    scene = replace(scene, spec=replace(spec, mounts=(laser, moved)))
    reaches = reaches_of(scene)
    work = check_scene(scene, reaches).work
    checker, given = CollisionChecker(scene.bodies), (ring.points_mm, ring.normals)
    found, pose = work.views["endoscope"], work.looks["endoscope"].pose
    free = view(checker, spec.camera.camera(), pose, *given)
    assert free.hidden.any() == (hides == "organ")
    assert (found < free.fraction).any() == (hides == "laser")
    lines = work.cuts["laser"].lines_mm[:: 3 * VIEW_EVERY]
    for fraction, line in zip(found[::3], lines, strict=True):
        arms = {"laser": ArmShape(line, reaches["laser"].radius_mm)}
        seen = view(checker, spec.camera.camera(), pose, *given, arms)
        assert fraction == seen.fraction
