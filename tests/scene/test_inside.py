"""Self-intersecting surfaces: the part inside is known in closed form and receives no dose."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.scene import frames, inside
from surgisoft.scene.ablation import AblationMap
from surgisoft.scene.author import CROSSING, Request, prepare
from surgisoft.scene.check import check_scene
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.dose_patch import cut_patch
from surgisoft.scene.folder import Scene
from surgisoft.scene.inside import buried, buried_faces, winding_numbers
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.meshio import write_ply
from surgisoft.scene.rays import EmbreeSurface
from surgisoft.scene.spec import BodySpec, LesionSpec, MountSpec, SceneSpec
from tests.scene.shapes import lumpy

AXES = np.array([40.0, 30.0, 30.0])
AWAY = np.array([25.0, 0.0, 0.0])


def crossing(subdivisions=5) -> Mesh:
    """Two ellipsoids of half axes 40, 30, 30 mm, their middles at x = -25 and 25 mm."""
    one = trimesh.creation.icosphere(subdivisions=subdivisions)
    corners = one.vertices * AXES
    return Mesh(
        np.concatenate((corners - AWAY, corners + AWAY)),
        np.concatenate((one.faces, one.faces + len(corners))),
    )


def test_points_of_many_are_enclosed_by_rays(monkeypatch):
    """As the ellipsoids say; solid angles are summed for points on the surface alone."""
    mesh, summed = crossing(5), []
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.2, 1.2, (400, 3)) * (AXES + AWAY)
    sizes = np.stack([frames.norm((points - side * AWAY) / AXES) for side in (1.0, -1.0)])
    points = points[(abs(sizes - 1.0) > 0.01).all(axis=0)]
    expected = (sizes.min(axis=0) < 1.0)[(abs(sizes - 1.0) > 0.01).all(axis=0)]
    assert 0.2 < expected.mean() < 0.8
    monkeypatch.setattr(
        inside, "winding_numbers", lambda *given: summed.extend(given[1]) or winding_numbers(*given)
    )
    surface = EmbreeSurface(mesh)
    np.testing.assert_array_equal(inside.enclosed(mesh, points, lambda: surface), expected)
    assert len(summed) < 0.02 * len(points)
    on = mesh.vertices_mm[::500]
    inside.enclosed(mesh, on, lambda: surface)
    buried_in_other = frames.norm((on + np.where(on[:, :1] > 0, 1.0, -1.0) * AWAY) / AXES) < 0.99
    assert len(summed) >= (~buried_in_other).sum() - 2
    few = points[:10]
    np.testing.assert_array_equal(inside.enclosed(mesh, few, lambda: surface), expected[:10])


def test_the_sheets_inside_the_other_ellipsoid_are_buried():
    mesh = crossing(4)
    middles = mesh.triangles_mm.mean(axis=1)
    other = np.where(np.arange(len(middles)) < len(middles) // 2, 1.0, -1.0)[:, None] * AWAY
    inside = frames.norm((middles - other) / AXES)
    clear = abs(inside - 1.0) > 0.01
    answer = buried(mesh, middles, mesh.face_normals)
    np.testing.assert_array_equal(answer[clear], inside[clear] < 1.0)
    assert buried_faces(mesh) == answer.sum() > 500


@given(seed=st.integers(0, 1000))
@settings(max_examples=8, deadline=None)
def test_nothing_of_a_surface_that_does_not_cross_itself_is_buried(seed):
    assert buried_faces(lumpy(3, seed)) == 0


@given(seed=st.integers(0, 1000))
@settings(max_examples=8, deadline=None)
def test_the_rays_count_what_the_solid_angles_say(seed):
    """Three lumps that overlap at random, against the winding number by solid angles."""
    rng = np.random.default_rng(seed)
    lumps = [lumpy(2, int(s)) for s in rng.integers(0, 1000, 3)]
    count = len(lumps[0].vertices_mm)
    mesh = Mesh(
        np.concatenate([lump.vertices_mm + rng.normal(0, 25, 3) for lump in lumps]),
        np.concatenate([lump.faces + i * count for i, lump in enumerate(lumps)]),
    )
    middles = mesh.triangles_mm.mean(axis=1)
    truth = winding_numbers(mesh, middles + 1e-3 * mesh.face_normals) > 0.5
    assert np.mean(buried(mesh, middles, mesh.face_normals) != truth) < 0.005


def test_the_author_says_that_surfaces_cross(tmp_path):
    mesh = crossing(3)
    write_ply(mesh, tmp_path / "two.ply")
    prepared = prepare(Request((tmp_path / "two.ply",), ("organ",)))
    assert len(prepared.meshes) == 1
    said = f"two.ply: {CROSSING}: {buried_faces(mesh)}"
    assert said in prepared.notes
    write_ply(lumpy(3), tmp_path / "one.ply")
    assert not any(
        CROSSING in x for x in prepare(Request((tmp_path / "one.ply",), ("organ",))).notes
    )


def test_no_volume_is_told_of_a_body_that_overlaps_itself():
    """One ellipsoid has 4/3 pi 40 30 30 mm3; of two the integral over the surface is twice that,
    although they share a part."""
    solid, ellipsoids = trimesh.creation.icosphere(subdivisions=5), crossing(5)
    one = Mesh(solid.vertices * AXES, solid.faces)
    lesion = LesionSpec("one", (0.0, 0.0, 999.0))
    names = [BodySpec(name, f"{name}.ply", "organ") for name in ("one", "two")]
    mount = MountSpec("laser", (0.0, 0.0, 100.0), (0.0, 0.0, -1.0))
    bodies = tuple(Body(*each) for each in (("one", "organ", one), ("two", "organ", ellipsoids)))
    scene = Scene(SceneSpec("two", tuple(names), lesion, (mount,)), Path(), bodies)
    found = {finding.what: finding for finding in check_scene(scene, {}).findings}
    volume_ml = float(found["organ 'one'"].value.removesuffix(" ml").split()[-1])
    assert volume_ml == pytest.approx(4e-3 / 3 * np.pi * 40 * 30 * 30, rel=2e-3)
    assert found["organ 'two'"].value.endswith("closed, overlaps itself, volume unknown")
    assert found["organ 'two'"].good


@pytest.mark.parametrize("aside", [0.0, 0.15, 0.4])
def test_the_seam_makes_no_energy(aside):
    """A beam from above goes along the seam of both ellipsoids, and across it."""
    mesh = crossing()
    top = 30.0 * np.sqrt(1.0 - (25.0 / 40.0) ** 2)
    turn = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
    x, y = 8.0 * np.cos(turn), 8.0 * np.sin(turn)
    level = 30.0 * np.sqrt(1.0 - ((abs(x) - 25.0) / 40.0) ** 2 - (y / 30.0) ** 2)
    ring = np.stack((x, y, level), axis=1)
    normals = frames.normalise((ring - np.sign(x)[:, None] * AWAY) / AXES**2)
    patch = cut_patch(mesh, ring, normals, np.array([0.0, 0.0, top]), 0.3)
    assert not buried(mesh, patch.points_mm, patch.normals).any()
    checker = CollisionChecker([Body("organ", "organ", mesh)])
    for start, stop in (([aside, -5.0], [aside, 5.0]), ([aside - 3.0, 1.0], [aside + 3.0, 1.0])):
        eyes = np.c_[np.linspace(start, stop, 41), np.full(41, 80.0)]
        aims = np.tile([0.0, 0.0, -1.0], (41, 1))
        hits = torch.tensor(checker.cast(eyes, aims, 200.0).point_mm).float()
        down, on = torch.tensor([[0.0, 0.0, -1.0]]), torch.ones(1, dtype=torch.bool)
        ablation = AblationMap(patch, 0.4)
        state = ablation.start(hits[:1], down, on)
        for point in hits[1:]:
            state = ablation.advance(state, point[None], down, on, 5.0, 0.05)
        assert state.delivered_j.item() == pytest.approx(10.0)
        assert 9.9 <= state.zone_j.sum().item() <= 10.1
