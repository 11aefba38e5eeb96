"""Repairs: each kind of damage is counted, and the body has its known volume afterwards."""

import contextlib

import numpy as np
import pytest
import trimesh
from hypothesis import example, given
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.scene.mesh import used_indices
from surgisoft.scene.meshio import read_parts
from surgisoft.scene.repair import repair
from tests.scene.shapes import ball, lumpy


def counts(repaired):
    return {fix.done: fix.count for fix in repaired.repairs}


def joined(*meshes):
    starts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in meshes[:-1])])
    return (
        np.concatenate([mesh.vertices_mm for mesh in meshes]),
        np.concatenate([mesh.faces + i for mesh, i in zip(meshes, starts, strict=True)]),
    )


BALL = ball(50.0, 3)


def test_a_sound_mesh_stays_as_it_is():
    repaired = repair(BALL.vertices_mm, BALL.faces, "ball")
    assert repaired.repairs == ()
    assert repaired.bodies[0].content_hash == BALL.content_hash


@example(seed=400, share=0.43493323626521513)  # turns 160 of the 320 faces: a tie
@given(seed=st.integers(0, 1000), share=st.floats(0.05, 0.45))
def test_random_damage_that_loses_nothing_is_undone(seed, share):
    """Turned faces, corners apart by rounding, faces in any order: the same surface comes back."""
    rng = np.random.default_rng(seed)
    mesh = lumpy(2, seed)
    faces = mesh.faces.copy()
    turned = rng.random(len(faces)) < share
    faces[turned] = faces[turned, ::-1]
    soup = mesh.vertices_mm[faces[rng.permutation(len(faces))]].reshape(-1, 3)
    soup = soup + rng.uniform(-2e-5, 2e-5, soup.shape)
    repaired = repair(soup, np.arange(len(soup)).reshape(-1, 3), "soup")
    (body,) = repaired.bodies
    assert body.is_watertight
    assert body.volume_mm3 == pytest.approx(mesh.volume_mm3, rel=1e-5)
    done = counts(repaired)
    assert done["duplicate vertices joined"] == len(soup) - len(mesh.vertices_mm)
    assert done["faces reoriented"] == min(turned.sum(), len(faces) - turned.sum())


def test_an_inside_out_body_is_turned():
    repaired = repair(BALL.vertices_mm, BALL.faces[:, ::-1], "ball")
    assert repaired.bodies[0].volume_mm3 == pytest.approx(BALL.volume_mm3)
    assert counts(repaired) == {"inside-out bodies flipped": 1}


def test_degenerate_and_double_faces_go():
    faces = np.vstack((BALL.faces, [[0, 0, 1], [5, 5, 5]], BALL.faces[:7], BALL.faces[20:23, ::-1]))
    repaired = repair(BALL.vertices_mm, faces, "ball")
    assert repaired.bodies[0].volume_mm3 == pytest.approx(BALL.volume_mm3)
    assert counts(repaired) == {"degenerate faces removed": 2, "duplicate faces removed": 10}


def test_small_holes_are_closed():
    repaired = repair(BALL.vertices_mm, np.delete(BALL.faces, [3, 100, 500], axis=0), "ball")
    assert repaired.bodies[0].is_watertight
    assert repaired.bodies[0].volume_mm3 == pytest.approx(BALL.volume_mm3)
    assert counts(repaired) == {"holes closed": 3}
    closed = repaired.holes_mm[0] > 0.0
    removed = BALL.triangles_mm[[3, 100, 500]]
    order = np.lexsort(removed.mean(axis=1).T)
    added = repaired.bodies[0].triangles_mm[closed]
    where = np.lexsort(added.mean(axis=1).T)
    np.testing.assert_allclose(added.mean(axis=1)[where], removed.mean(axis=1)[order], atol=1e-9)
    widths = np.ptp(removed, axis=1).max(axis=1)
    np.testing.assert_allclose(repaired.holes_mm[0][closed][where], widths[order])


def test_many_holes_cost_no_look_at_the_whole_body_each(monkeypatch):
    """Faces without common corners are lost; a scan has thousands of such holes."""
    lost, taken = [], np.zeros(len(BALL.vertices_mm), dtype=bool)
    for number, face in enumerate(BALL.faces):
        if not taken[face].any():
            lost.append(number)
            taken[face] = True
    assert len(lost) > 100
    looks = []

    def counted(faces):
        looks.append(len(faces))
        return used_indices(faces)

    monkeypatch.setattr("surgisoft.scene.repair.used_indices", counted)
    for some in (lost[:2], lost):
        looks.append(0)
        repaired = repair(BALL.vertices_mm, np.delete(BALL.faces, some, axis=0), "ball")
        assert repaired.bodies[0].volume_mm3 == pytest.approx(BALL.volume_mm3)
        assert counts(repaired) == {"holes closed": len(some)}
    assert len(looks) == 2 * looks.index(0, 1), "as many looks for many holes as for two"


def test_a_closed_hole_is_known_of_the_body_that_had_it():
    """Of two balls the smaller one, which comes second, lacks a face."""
    small = ball(30.0, 2)
    apart = type(small)(small.vertices_mm + np.array([120.0, 0.0, 0.0]), small.faces[1:])
    repaired = repair(*joined(BALL, apart), "two")
    assert [int((holes > 0.0).sum()) for holes in repaired.holes_mm] == [0, 1]
    assert repaired.holes_mm[1].max() == pytest.approx(np.ptp(small.triangles_mm[0], axis=0).max())


def test_a_wider_hole_is_closed_by_its_flat_lid():
    """A ball that lost its cap keeps the volume of the ball less the cap."""
    low = BALL.triangles_mm[:, :, 2].max(axis=1) < 49.0
    repaired = repair(BALL.vertices_mm, BALL.faces[low], "ball")
    rim = BALL.vertices_mm[np.unique(BALL.faces[low])][:, 2].max()
    height = 50.0 - rim
    cap = np.pi * height**2 * (3.0 * 50.0 - height) / 3.0
    lost = BALL.volume_mm3 - repaired.bodies[0].volume_mm3
    assert counts(repaired)["holes closed"] == 1
    assert lost == pytest.approx(cap, rel=0.35)  # the rim is a zigzag of 6 mm edges
    width = np.ptp(BALL.vertices_mm[np.unique(BALL.faces[~low])], axis=0).max()
    lid = np.isclose(repaired.bodies[0].triangles_mm[:, :, 2].max(axis=1), rim, atol=1.5)
    assert set(np.unique(repaired.holes_mm[0]).round(6)) == {0.0, round(float(width), 6)}
    assert lid[repaired.holes_mm[0] > 0.0].all()


def test_a_hole_of_more_than_three_tenths_of_the_body_is_refused():
    """A cap down to 47 mm above the middle is 34 mm wide or more, of a ball of 100 mm."""
    low = BALL.triangles_mm[:, :, 2].max(axis=1) < 47.0
    width = np.ptp(BALL.vertices_mm[np.unique(BALL.faces[~low])], axis=0).max()
    assert 33.0 < width < 50.0
    with pytest.raises(InputError, match=r"is too large to close \(up to 30 %\)"):
        repair(BALL.vertices_mm, BALL.faces[low], "ball")


def test_inner_bodies_go_and_separate_ones_stay():
    inner, apart = ball(20.0, 2), ball(30.0, 2)
    apart = type(apart)(apart.vertices_mm + np.array([120.0, 0.0, 0.0]), apart.faces)
    cavity = type(inner)(inner.vertices_mm, inner.faces[:, ::-1])
    repaired = repair(*joined(BALL, cavity, apart), "three")
    assert counts(repaired)["inner bodies removed"] == 1
    assert counts(repair(*joined(inner, BALL), "two")) == {"inner bodies removed": 1}
    volumes = [body.volume_mm3 for body in repaired.bodies]
    assert volumes == pytest.approx([BALL.volume_mm3, apart.volume_mm3])


def test_bodies_that_share_only_an_edge_or_a_face_come_apart():
    box = trimesh.creation.box((50.0, 50.0, 50.0))
    for shift in ([50.0, 50.0, 0.0], [50.0, 0.0, 0.0]):
        soup = np.concatenate((box.triangles, box.triangles + shift)).reshape(-1, 3)
        repaired = repair(soup, np.arange(len(soup)).reshape(-1, 3), "boxes")
        assert sum(body.volume_mm3 for body in repaired.bodies) == pytest.approx(2 * 50.0**3)
        assert all(body.is_watertight for body in repaired.bodies)


def test_loose_specks_go():
    speck = type(BALL)(BALL.vertices_mm * 1e-3 + 80.0, BALL.faces)
    repaired = repair(*joined(BALL, speck), "ball")
    assert len(repaired.bodies) == 1
    assert counts(repaired) == {"small loose pieces removed": 1}


def test_an_open_piece_of_less_than_a_tenth_goes_and_a_closed_one_stays():
    """Of 5 mm beside a ball of 100 mm: a piece of skin, and a ball."""
    small = type(BALL)(BALL.vertices_mm * 0.05 + np.array([60.0, 0.0, 0.0]), BALL.faces)
    open_one = type(BALL)(small.vertices_mm, np.delete(small.faces, slice(0, 20), axis=0))
    assert len(repair(*joined(BALL, small), "two").bodies) == 2
    repaired = repair(*joined(BALL, open_one), "two")
    assert len(repaired.bodies) == 1
    assert counts(repaired) == {"small loose pieces removed": 1}


def test_bodies_that_overlap_are_one():
    """Two balls of 50 mm whose middles are 60 mm apart, and a third one 200 mm away."""
    others = [type(BALL)(BALL.vertices_mm + np.array([x, 0.0, 0.0]), BALL.faces) for x in (60, 260)]
    repaired = repair(*joined(BALL, *others), "three")
    assert [len(body.faces) for body in repaired.bodies] == [2 * len(BALL.faces), len(BALL.faces)]


def moebius():
    turn = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    rows = [
        np.stack(
            (
                (50 + w * np.cos(turn / 2)) * np.cos(turn),
                (50 + w * np.cos(turn / 2)) * np.sin(turn),
                w * np.sin(turn / 2),
            ),
            axis=1,
        )
        for w in (-10.0, 10.0)
    ]
    faces = []
    for i in range(40):
        a, b = i, i + 40
        c, d = (i + 1, i + 41) if i < 39 else (40, 0)
        faces += [[a, c, b], [b, c, d]]
    return np.concatenate(rows), np.array(faces)


SQUARE = np.array([[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]])
REFUSED = {
    "half a ball": (BALL.vertices_mm, BALL.faces[BALL.triangles_mm[:, :, 2].mean(1) < 0], "hole"),
    "box without a side": (
        trimesh.creation.box((50, 50, 50)).vertices,
        trimesh.creation.box((50, 50, 50)).faces[2:],
        "too large to close",
    ),
    "sheet": (SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), "enclose nothing"),
    "folded sheet": (SQUARE, np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]]), "enclose"),
    "point": (np.zeros((3, 3)), np.array([[0, 1, 2]]), "one point"),
    "moebius": (*moebius(), "only one side"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_beyond_repair_is_one_line(name):
    vertices, faces, says = REFUSED[name]
    with pytest.raises(InputError) as caught:
        repair(vertices, faces, name)
    assert says in str(caught.value)
    assert str(caught.value).startswith(name)


@given(seed=st.integers(0, 10_000))
def test_any_soup_is_closed_bodies_or_an_input_error(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(30, 3)) * 50.0
    faces = rng.integers(0, 30, (rng.integers(1, 80), 3))
    bodies = ()
    with contextlib.suppress(InputError):
        bodies = repair(vertices, faces, "soup").bodies
    assert all(body.is_watertight and body.volume_mm3 > 0 for body in bodies)


def test_public_meshes_are_repaired(shared):
    whole = repair(*_part(shared / "meshes" / "openhelp_liver.stl"), "liver")
    assert [len(body.faces) for body in whole.bodies] == [30726]
    broken = repair(*_part(shared / "meshes" / "liver_collision.stl"), "liver")
    (body,) = broken.bodies
    assert body.is_watertight
    # trimesh's volume of the file as it stands, dominated by its one large body
    assert body.volume_mm3 == pytest.approx(1752086.0, rel=1e-3)


def _part(path):
    (part,) = read_parts(path)
    return part.vertices, part.faces
