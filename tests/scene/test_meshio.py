"""Mesh files: one mesh from every format, no guess of the unit, one line for broken files."""

import json
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.meshio import (
    LengthUnit,
    UnknownUnit,
    given_unit,
    read_mesh,
    read_parts,
    stored_unit,
    write_ply,
)
from tests.scene.shapes import lumpy


def write(path, shape):
    if path.name == "text.stl":
        path.write_text(trimesh.exchange.stl.export_stl_ascii(shape))
    else:
        shape.export(path)
    return path


@pytest.mark.parametrize("name", ["a.stl", "text.stl", "a.obj", "a.ply", "a.off", "a.glb", "A.STL"])
def test_every_format_gives_the_same_triangles(name, tmp_path):
    shape = trimesh.creation.icosphere(subdivisions=2, radius=40.0)
    shape.apply_translation([5.0, -7.0, 11.0])
    (part,) = read_parts(write(tmp_path / name, shape))
    found = part.vertices[part.faces]
    np.testing.assert_allclose(
        found.mean(axis=(0, 1)), shape.triangles.mean(axis=(0, 1)), atol=1e-4
    )
    mesh = Mesh(part.vertices, part.faces)
    assert mesh.volume_mm3 == pytest.approx(shape.volume, rel=1e-5)
    assert len(part.faces) == len(shape.faces)


@pytest.mark.parametrize("name", ["two.glb", "two.obj"])
def test_named_parts_come_apart_in_their_places(name, tmp_path):
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(subdivisions=1, radius=10.0)
    moved = trimesh.transformations.translation_matrix([100.0, 0.0, 0.0])
    scene.add_geometry(ball, geom_name="near", node_name="near")
    scene.add_geometry(trimesh.creation.box((4, 4, 4)), "far", "far", transform=moved)
    parts = read_parts(write(tmp_path / name, scene))
    centres = sorted(part.vertices[part.faces].mean(axis=(0, 1))[0] for part in parts)
    np.testing.assert_allclose(centres, [0.0, 100.0], atol=1e-6)
    assert sorted(len(part.faces) for part in parts) == [12, 80]


def test_a_part_that_its_file_mirrors_is_wound_outwards_still(tmp_path):
    """A box 2 wide whose node mirrors x and moves it by 5: from 3 to 5 of 5 - x."""
    box = trimesh.creation.box((2.0, 4.0, 6.0))
    box.apply_translation((1.0, 0.0, 0.0))
    mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirrored[0, 3] = 5.0
    scene = trimesh.Scene()
    scene.add_geometry(box, node_name="mirrored", transform=mirrored)
    scene.export(tmp_path / "a.glb")
    (part,) = read_parts(tmp_path / "a.glb")
    mesh = Mesh(part.vertices, part.faces)
    assert mesh.volume_mm3 == pytest.approx(48.0, rel=1e-5)
    np.testing.assert_allclose(mesh.bounds_mm, [[3, -2, -3], [5, 2, 3]], atol=1e-5)


def test_ply_keeps_every_bit(tmp_path):
    rng = np.random.default_rng(1)
    mesh = lumpy(3)
    mesh = Mesh(mesh.vertices_mm * rng.uniform(0.9, 1.1, mesh.vertices_mm.shape), mesh.faces)
    write_ply(mesh, tmp_path / "m.ply")
    assert read_mesh(tmp_path / "m.ply").content_hash == mesh.content_hash


def test_a_ply_of_this_package_is_read_as_trimesh_reads_it(tmp_path, monkeypatch):
    write_ply(lumpy(3), tmp_path / "m.ply")
    (own,) = read_parts(tmp_path / "m.ply")
    content = (tmp_path / "m.ply").read_bytes()
    (tmp_path / "m.ply").write_bytes(content.replace(b"surgisoft", b"something"))
    (theirs,) = read_parts(tmp_path / "m.ply")
    assert own.name == theirs.name == "m.ply"
    for one, other in ((own.vertices, theirs.vertices), (own.faces, theirs.faces)):
        assert one.dtype == other.dtype
        assert np.array_equal(one, other)
    (tmp_path / "m.ply").write_bytes(content)
    monkeypatch.setattr(trimesh, "load_scene", None)  # which is not asked
    assert np.array_equal(read_parts(tmp_path / "m.ply")[0].faces, own.faces)


@pytest.mark.parametrize("damage", ["cut", "longer", "count", "corner"])
def test_a_damaged_ply_of_this_package_is_refused(damage, tmp_path):
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    write_ply(mesh, tmp_path / "m.ply")
    content = (tmp_path / "m.ply").read_bytes()
    broken = {
        "cut": content[:-1],
        "longer": content + b"x",
        "count": content[:-13] + b"\x04" + content[-12:],
        "corner": content[:-4] + b"\x09\0\0\0",
    }[damage]
    (tmp_path / "m.ply").write_bytes(broken)
    with pytest.raises(InputError, match=r"m\.ply"):
        read_parts(tmp_path / "m.ply")


@given(size=st.floats(1e-3, 1e4), suffix=st.sampled_from([".stl", ".ply", ".obj", ".glb"]))
def test_no_size_is_scaled_by_a_guess(size, suffix):
    """A file's own unit is mm, metres for glTF; where that is no organ's size, the user decides."""
    own = 1000.0 if suffix == ".glb" else 1.0
    file = Path(f"organ{suffix}")
    if 20.0 <= size * own <= 600.0:
        assert stored_unit(file, size).mm == own
        return
    with pytest.raises(UnknownUnit) as stopped:
        stored_unit(file, size)
    assert f"--unit cm ({size * 10.0:.4g} mm)" in str(stopped.value)


def test_a_given_unit_that_makes_no_organ_is_warned_of():
    file = Path("organ.stl")
    assert given_unit(file, 180.0, "mm", None) == LengthUnit(1.0, "mm as given (180 mm across)")
    assert given_unit(file, 7.0, "inch", None).mm == 25.4
    assert given_unit(file, 50.0, None, 2.5).sentence == "2.5 mm as given (125 mm across)"
    said = given_unit(file, 180.0, "cm", None).sentence
    assert "the mesh would be 1800 mm across; organs measure 20 to 600 mm" in said
    assert said.endswith("--unit mm would give 180 mm")
    assert "would be 15 mm" in given_unit(file, 15.0, "mm", None).sentence
    with pytest.raises(InputError, match=r"1.8e\+05 mm across"):
        given_unit(file, 180.0, "m", None)


POINTS = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n" + (
    "property float z\nend_header\n0 0 0\n1 1 1\n"
)
BROKEN = {
    "empty.stl": (b"", "the file is empty"),
    "cut.stl": (b"x" * 80 + (640).to_bytes(4, "little") + b"y" * 500, "cut off"),
    "half.stl": (b"solid a\n facet normal 0 0 1\n  outer loop\n   vertex 0 0", "with 'vertex 0 0'"),
    "word.stl": (b"hello\n", "neither a text nor a binary STL"),
    "points.ply": (POINTS.encode(), "2 points or lines but no faces"),
    "lines.obj": (b"v 0 0 0\nv 1 0 0\nl 1 2\n", "no faces"),
    "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", "NaN or infinite"),
    "far.obj": (b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 9\n", "damaged"),
    "noise.glb": (b"123" * 40, "cannot be read as GLB"),
    "text.off": (b"no mesh at all", "OFF"),
    "blank.obj": (b"# nothing\n", "no triangle"),
    "shape.step": (b"x", "file type '.step' is not read"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_mesh_gets_its_line(name, tmp_path):
    content, says = BROKEN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_parts(tmp_path / name)
    assert says in str(caught.value)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_and_a_folder(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_parts(tmp_path / "a.stl")
    with pytest.raises(InputError, match="is a folder"):
        read_parts(tmp_path)


@pytest.mark.parametrize("damage", ["chunk", "accessor", "json"])
def test_a_glb_that_claims_more_than_it_holds_takes_no_memory(tmp_path, damage):
    write(tmp_path / "a.glb", trimesh.creation.box())
    content = bytearray((tmp_path / "a.glb").read_bytes())
    length = struct.unpack("<I", content[12:16])[0]
    table, rest = json.loads(content[20 : 20 + length]), content[20 + length :]
    if damage == "accessor":
        table["accessors"][0] = {"count": 10**9, "componentType": 5126, "type": "VEC3"}
    text = b"[" * 10**5 if damage == "json" else json.dumps(table).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    body = bytearray(struct.pack("<I4s", len(text), b"JSON") + text + rest)
    if damage == "chunk":
        body[:4] = struct.pack("<I", 2**31)
    head = struct.pack("<4sII", b"glTF", 2, 12 + len(body))
    (tmp_path / "a.glb").write_bytes(head + body)
    tracemalloc.start()
    with pytest.raises(InputError, match=r"claims 1000000000|chunk is cut off|read as glTF"):
        read_mesh(tmp_path / "a.glb")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
