"""Scenes, meshes and segmented images that cannot be meant, and rare shapes that can."""

import json
import re
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from surgisoft.errors import InputError
from surgisoft.scene.ablation import AblationMap
from surgisoft.scene.author import Request, check_target, prepare
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import Camera
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.contours import Plane, contour_path, grown, raster
from surgisoft.scene.dose_patch import cut_patch, path_patch
from surgisoft.scene.folder import open_scene
from surgisoft.scene.images import BatchedRenderer
from surgisoft.scene.inside import winding_numbers
from surgisoft.scene.lesion import OrganSurface, good_sites, lesions_like, pointed_site
from surgisoft.scene.mesh import Body
from surgisoft.scene.meshio import read_parts
from surgisoft.scene.mounted_arm import placed
from surgisoft.scene.repair import repair
from surgisoft.scene.segmentation import parse_label, read_image, read_segmentation
from surgisoft.scene.spec import PHANTOM, LesionSpec, load_spec
from tests.refusals import refusal
from tests.scene.shapes import ball, box
from tests.scene.test_contours import disc, spec


@pytest.fixture(scope="module")
def plane():
    """The upper side of a box, at z = 5 mm."""
    return box((80.0, 80.0, 10.0))


def test_paths_that_cannot_be_cut_are_one_line(plane):
    wide = box((250.0, 250.0, 10.0))
    point, two = spec(points_mm=[[0.0, 0.0, 5.0]] * 3), disc(5.0)[:2]
    for call, message in (
        (
            lambda: contour_path(plane, point, 0.25),
            "contour 'c' has no length: its points",
        ),
        (lambda: Plane.of(plane, disc(10.0)).on(plane, disc(90.0)[:, :2], "it"), "it extends over"),
        (lambda: grown(wide, disc(105.0), 5.0), "mm wide, expected at most 200 mm"),
        (lambda: raster(plane, disc(5.0), 1.0, 9.0, 0.5), "no line fits 9 mm inside the outline"),
        (lambda: path_patch(plane, [], 0.2), "0 paths, spacing 0.2 mm"),
        (lambda: cut_patch(plane, two, two, np.zeros(3), 0.2), "ring has shape (2, 3): expected"),
        (lambda: cut_patch(plane, disc(5.0), disc(5.0), np.zeros(3), -0.2), "spacing -0.2 mm"),
    ):
        assert message in refusal(call)


def test_lesions_that_cannot_vary_are_one_line():
    mesh = ball(50.0, 3)
    lesion = LesionSpec("organ", (0.0, 0.0, 50.0), 20.0)
    assert lesions_like(mesh, lesion, 5, 0.0, 0.0) == (lesion,)
    own = replace(lesion, path_mm=((0.0, 0.0, 50.0),) * 3)
    block = box((30.0, 30.0, 30.0))
    wide = LesionSpec("organ", (0.0, 0.0, 15.0), 29.0)
    assert (
        "lesions up to 14 mm aside and 0 % larger fit on 'organ'; use a smaller spread"
        in refusal(lambda: lesions_like(block, wide, 3, 14.0, 0.0))
    )
    for given, shift_mm, size, message in (
        (own, 1.0, 0.0, "a lesion with its own path_mm cannot be moved or scaled; leave both at 0"),
        (lesion, 0.0, 1.0, "lesions differ in size by a share of 1.0; expected 0 to below 1"),
        (lesion, 30.0, 0.0, "lesions move by up to 30 mm; expected at most the scene's own diame"),
    ):
        assert message in refusal(
            lambda a=given, b=shift_mm, c=size: lesions_like(mesh, a, 3, b, c)
        )
    found = lesions_like(mesh, lesion, 4, 5.0, 0.2)
    assert len(found) == 4
    assert all(16.0 <= each.diameter_mm <= 24.0 for each in found)


def test_where_no_ring_fits_the_line_says_so():
    """A needle of 2 mm: a ring of 20 mm fits nowhere, and no smaller one."""
    needle = OrganSurface.whole(box((2.0, 2.0, 60.0)))
    message = refusal(lambda: pointed_site([needle], np.array([0.0, 0.0, 30.0]), 20.0))
    assert "a ring of 20 mm does not fit on the surface at" in message
    assert refusal(lambda: good_sites([needle], 20.0))


def test_damaged_surfaces_beyond_repair_are_one_line():
    flat = box((40.0, 30.0, 1e-9))
    many = [ball(2.0, 1) for _ in range(40)]
    vertices = np.concatenate(
        [m.vertices_mm + np.array([10.0 * i, 0, 0]) for i, m in enumerate(many)]
    )
    faces = np.concatenate([m.faces + i * len(m.vertices_mm) for i, m in enumerate(many)])
    for points, triangles, message in (
        (flat.vertices_mm, flat.faces, "the surface is flat and encloses no volume; expected a b"),
        (vertices, faces, "separate bodies; expected at most"),
        (np.zeros((3, 3)), np.array([[0, 1, 2]]), "all vertices are one point; expected a surface"),
        (np.eye(3), np.array([[0, 0, 1]] * 5), "0 faces enclose nothing; expected a closed body"),
    ):
        assert message in refusal(lambda p=points, t=triangles: repair(p, t, "organ"))


def test_two_holes_that_share_a_corner_are_both_closed():
    """The boundary is a figure of eight; each loop gets a lid of its own."""
    mesh = ball(50.0, 2)
    corner = 0
    touching = np.flatnonzero((mesh.faces == corner).any(1))
    kept = np.setdiff1d(np.arange(len(mesh.faces)), touching[[0, 3]])
    repaired = repair(mesh.vertices_mm, mesh.faces[kept], "ball")
    (body,) = repaired.bodies
    assert body.is_watertight
    assert body.volume_mm3 == pytest.approx(mesh.volume_mm3, rel=0.01)


def test_numbers_that_place_nothing_are_one_line(plane):
    with pytest.raises(InputError, match=r"arm centreline has shape \(1, 3\): expected \(K, 3\)"):
        ArmShape(np.zeros((1, 3)), 5.0)
    with pytest.raises(InputError, match=r"body 'b' has a pose of shape \(3, 3\): expected 4x4"):
        Body("b", "organ", plane, np.eye(3))
    patch = path_patch(plane, [contour_path(plane, spec(points_mm=disc(8.0).tolist()), 0.5)], 0.2)
    for waist, depth, message in (
        (0.0, 0.1, "laser waist is 0.0 mm: expected more than 0"),
        (1.0, -0.1, "ablation depth is -0.1 mm: expected 0 or more"),
        (0.05, 0.1, "is too coarse for a waist of 0.05 mm: cut it with a spacing of"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            AblationMap(patch, waist, depth_mm=depth)


def test_an_arm_without_a_shaft_begins_at_its_base():
    lines = np.zeros((1, 2, 3))
    lines[0, 1, 2] = 50.0
    poses = np.eye(4)[None]
    assert placed(lines, poses, 0.0).shape == (1, 2, 3)
    longer = placed(lines, poses, 30.0)
    assert longer[0, :, 2].tolist() == [-30.0, 0.0, 50.0]


def test_pictures_that_were_not_drawn_are_named(plane):
    camera = Camera(1.2, (1.0, 100.0))
    body = Body("organ", "organ", plane)
    wrong = SimpleNamespace(body="liver")
    with pytest.raises(InputError, match=r"marks are on body 'liver', expected one of \['organ'\]"):
        BatchedRenderer([body], {}, camera, 16, 16, wrong)


def test_no_ray_meets_nothing():
    scene = BatchedScene([Body("organ", "organ", ball(20.0, 2))], {"arm": 5.0})
    lines = torch.zeros(1, 2, 3, dtype=torch.float16)
    lines[0, :, 2] = torch.tensor([40.0, 60.0])
    found = scene.clearance({"arm": lines})
    assert found.least_mm.item() == pytest.approx(40.0 - 20.0 - 5.0, abs=0.3)
    assert winding_numbers(ball(20.0, 2), np.zeros((0, 3))).shape == (0,)


SPEC = (PHANTOM / "scene.toml").read_text()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('role = "organ"', 'role = "support"', "bodies: no body has the role 'organ'; expected at"),
        ("[[mounts]]", "[[muonts]]", "muonts: unknown field (did you mean 'mounts'?)"),
    ],
)
def test_a_scene_without_its_parts_is_one_line(old, new, message, tmp_path):
    (tmp_path / "scene.toml").write_text(SPEC.replace(old, new))
    assert message in refusal(lambda: load_spec(tmp_path / "scene.toml"))


def test_arms_of_a_scene_go_by_their_names():
    found = open_scene(PHANTOM).spec
    assert found.mount("laser").tool == "laser"
    assert refusal(lambda: found.mount("knife")).startswith("unknown arm 'knife': known are")


def test_targets_that_are_no_scene_are_kept(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "note.txt").write_text("x")
    (tmp_path / "empty").mkdir()
    for place, message in (
        (tmp_path / "file", "is not a scene; --force replaces only a scene's folder"),
        (tmp_path / "folder", "is not a scene; --force replaces only a scene's folder"),
        (tmp_path / "file" / "new", "cannot be written"),
    ):
        assert message in refusal(lambda p=place: check_target(p, force=True))
    check_target(tmp_path / "empty", force=True)
    assert "exists already; choose another" in refusal(
        lambda: check_target(tmp_path / "empty", False)
    )


def test_requests_that_contradict_each_other(tmp_path):
    stl = tmp_path / "a.stl"
    trimesh.creation.icosphere(radius=50.0).export(stl)
    (tmp_path / "b.nii").write_bytes(b"x")
    point = tmp_path / "point.obj"
    point.write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    for request, message in (
        (
            Request(meshes=(stl, tmp_path / "b.nii"), roles=("organ", "organ")),
            "a segmented image; expected",
        ),
        (
            Request(meshes=(stl,), roles=("organ",), labels=(parse_label("1:organ"),)),
            "--label is given",
        ),
        (Request(meshes=(stl,), roles=("organ",), up="w"), "unknown axis 'w'"),
        (
            Request(meshes=(point,), roles=("organ",)),
            "all vertices are one point; expected a surface",
        ),
    ):
        assert message in refusal(lambda r=request: prepare(r))


def glb(table: dict, tail: bytes = b"") -> bytes:
    """A GLB file with one chunk of JSON."""
    content = json.dumps(table).encode()
    content += b" " * (-len(content) % 4)
    chunk = struct.pack("<II", len(content), 0x4E4F534A) + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunk) + len(tail)) + chunk + tail


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.glb", b"glTF", "cannot be read as GLB (its length is wrong)"),
        ("a.glb", glb({}, b"\1\2\3"), "cannot be read as GLB (a chunk is cut off)"),
        ("a.glb", glb({"accessors": [{"count": 10**9}]}), "claims 1000000000 numbers in"),
        ("a.gltf", b'{"accessors": [3]}', "cannot be read as glTF ("),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "1 of 3 vertices are NaN or infinite"),
        ("a.stl", b"solid a\nfacet normal 0 0 1\n", "expected 'endsolid' at its end: it is cut"),
    ],
)
def test_mesh_files_that_claim_too_much_are_one_line(name, content, message, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert message in refusal(lambda: read_parts(tmp_path / name))


nrrd = pytest.importorskip("nrrd", reason="the extra 'segmentation' is not installed")
nibabel = pytest.importorskip("nibabel", reason="the extra 'segmentation' is not installed")


def cube(size: int = 12, value: int = 1) -> np.ndarray:
    """A cube of one label in the middle of an image."""
    found = np.zeros((size, size, size), np.uint8)
    found[3:-3, 3:-3, 3:-3] = value
    return found


def test_headers_of_images_are_read_as_far_as_they_go(tmp_path):
    """NRRD with spacings alone, a NIfTI of four axes, one with no orientation."""
    nrrd.write(str(tmp_path / "a.nrrd"), cube(), {"spacings": [2.0, 2.0, 3.0]})
    found = read_image(tmp_path / "a.nrrd")
    assert np.abs(np.diag(found.to_ras)[:3]).tolist() == [2.0, 2.0, 3.0]
    image = nibabel.Nifti1Image(cube()[..., None], np.eye(4))
    nibabel.save(image, tmp_path / "b.nii")
    assert read_image(tmp_path / "b.nii").volumes_ml == {"1": pytest.approx(0.216)}
    plain = nibabel.Nifti1Image(cube().astype(np.float32), None)
    plain.header.set_xyzt_units("mm")
    nibabel.save(plain, tmp_path / "c.nii")
    assert not read_image(tmp_path / "c.nii").oriented
    notes = read_segmentation(tmp_path / "c.nii", [parse_label("1:organ")]).notes
    assert any("the header gives no orientation" in note for note in notes)


def test_images_that_are_no_volume_are_one_line(tmp_path):
    for name, data, affine, message in (
        ("flat", np.zeros((4, 4, 1, 3), np.uint8), np.eye(4), "expected a volume"),
        ("four", np.zeros((4, 4, 4, 3), np.uint8), np.eye(4), "an image of shape (4, 4, 4, 3)"),
        (
            "grey",
            np.full((4, 4, 4), 0.5, np.float32),
            np.eye(4),
            "holds grey values; expected",
        ),
        (
            "plane",
            cube(),
            np.diag([1.0, 1.0, 0.0, 1.0]),
            "all voxels on a plane; expected",
        ),
    ):
        path = tmp_path / f"{name}.nii"
        image = nibabel.Nifti1Image(data, np.eye(4))
        if name == "plane":
            image.set_sform(affine, 1)
        nibabel.save(image, path)
        assert message in refusal(lambda p=path: read_image(p)), name
    nrrd.write(str(tmp_path / "five.nrrd"), np.zeros((2, 2, 4, 4, 4), np.uint8))
    assert "an image of shape" in refusal(lambda: read_image(tmp_path / "five.nrrd"))


def test_labels_that_make_no_body_are_one_line(tmp_path):
    labels = cube(24)
    labels[0, 0, 0] = 2
    labels[4, 4, 4] = 3
    path = tmp_path / "a.nii"
    nibabel.save(nibabel.Nifti1Image(labels, np.diag([2.0, 2.0, 2.0, 1.0])), path)
    one = [parse_label("1:organ")]
    assert any(
        "left out: 2, 3; name them with --label" in n for n in read_segmentation(path, one).notes
    )
    tiny = [*one, parse_label("2:support")]
    assert "label '2' has" in refusal(lambda: read_segmentation(path, tiny))
    assert "unknown role 'ghost'" in refusal(lambda: parse_label("1:ghost"))
    two = [parse_label("1:organ"), parse_label("2:organ")]
    assert "2 labels with the role organ and 0" in refusal(lambda: read_segmentation(path, two))


def test_files_after_the_first_have_its_unit_unless_their_format_has_one(tmp_path):
    ball_of = trimesh.creation.icosphere(subdivisions=2, radius=50.0)
    for name in ("a.stl", "b.stl"):
        ball_of.export(tmp_path / name)
    ball_of.apply_scale(1e-3).export(tmp_path / "c.glb")
    found = prepare(
        Request(
            meshes=tuple(tmp_path / name for name in ("a.stl", "b.stl", "c.glb")),
            roles=("organ", "keep-out", "support"),
        )
    )
    units = [note for note in found.notes if ": unit " in note]
    assert units[1] == "b.stl: unit that of a.stl"
    assert units[2].startswith("c.glb: unit m")
    assert "c.glb: y points up; another axis needs --up" in found.notes
    assert "3 bodies: a (organ), b (keep-out), " in found.notes[-1]
    given = Request(meshes=(tmp_path / "c.glb",), roles=("organ",), unit="inch", up="z")
    assert any(note.startswith("c.glb: unit inch") for note in prepare(given).notes)
    wrong = Request(meshes=(tmp_path / "a.stl",), roles=("organ", "ghost"))
    assert "unknown role 'ghost'" in refusal(lambda: prepare(wrong))


def test_parts_that_only_together_enclose_a_body_are_one_surface(tmp_path):
    """Two halves of a ball as two objects of one file."""
    whole = trimesh.creation.icosphere(subdivisions=2, radius=50.0)
    upper = whole.triangles_center[:, 2] > 0.0
    lines = [f"v {x} {y} {z}" for x, y, z in whole.vertices]
    for name, faces in (("up", whole.faces[upper]), ("down", whole.faces[~upper])):
        lines += [f"o {name}", *(f"f {a} {b} {c}" for a, b, c in faces + 1)]
    (tmp_path / "halves.obj").write_text("\n".join(lines) + "\n")
    found = prepare(Request(meshes=(tmp_path / "halves.obj",), roles=("organ",)))
    assert all(mesh.is_watertight for mesh in found.meshes)


def test_a_mirrored_node_of_a_file_keeps_its_surface_outwards(tmp_path):
    mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.icosphere(radius=5.0), transform=mirrored)
    scene.export(tmp_path / "a.glb")
    (part,) = read_parts(tmp_path / "a.glb")
    assert trimesh.Trimesh(part.vertices, part.faces, process=False).volume > 0.0


def test_names_of_bodies_are_unique_and_plain(tmp_path):
    for folder in ("x", "y", "z"):
        (tmp_path / folder).mkdir()
        trimesh.creation.icosphere(radius=50.0).export(tmp_path / folder / "le foie (1).stl")
    files = tuple(tmp_path / folder / "le foie (1).stl" for folder in ("x", "y", "z"))
    found = prepare(Request(meshes=files, roles=("organ", "keep-out", "support")))
    assert found.names == ("le_foie__1", "le_foie__1_2", "le_foie__1_3")


def test_paths_far_from_the_organ_have_no_patch(plane):
    away = contour_path(plane, spec(points_mm=disc(5.0).tolist()), 0.25)
    moved = replace(away, points_mm=away.points_mm + np.array([500.0, 0.0, 0.0]))
    assert "the paths lie nowhere near the organ's surface" in refusal(
        lambda: path_patch(plane, [moved], 0.5, 2.0)
    )
