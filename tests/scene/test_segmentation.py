"""Segmented images: surfaces of their labels in the patient's frame, whatever order voxels have."""

import gzip
import itertools
import struct
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.author import (
    Request,
    choose_sites,
    enclosing_circle,
    prepare,
    ring_diameter,
    seen_lesion,
)
from surgisoft.scene.folder import open_scene
from surgisoft.scene.inside import winding_numbers
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.segmentation import parse_label, read_image, read_segmentation

nibabel = pytest.importorskip("nibabel", reason="the extra 'segmentation' is not installed")
nrrd = pytest.importorskip("nrrd", reason="the extra 'segmentation' is not installed")

SPACING = np.array([1.5, 1.5, 2.5])
"""Distance of the voxels along right, anterior and superior, mm."""
ORIGIN = np.array([-70.0, -55.0, 240.0])
"""Middle of the first voxel, RAS, mm."""
LESION = np.array([8.0, 38.0, 300.0])
"""Middle of the lesion, a ball with a radius of 8 mm, RAS, mm."""
LABELS = tuple(map(parse_label, ("1:organ:liver", "2:lesion:tumour", "3:keep-out:portal")))


def patient():
    """(I, J, K) labels along R, A, S: an ellipsoid with a ball near its front and a tube inside."""
    grid = np.meshgrid(*(np.arange(n) for n in (92, 76, 50)), indexing="ij")
    x, y, z = (ORIGIN[i] + SPACING[i] * grid[i] for i in range(3))
    labels = ((x / 60) ** 2 + (y / 50) ** 2 + ((z - 300) / 50) ** 2 < 1).astype(np.uint8)
    labels[(x - LESION[0]) ** 2 + (y - LESION[1]) ** 2 + (z - LESION[2]) ** 2 < 64.0] = 2
    labels[(y**2 + (z - 290.0) ** 2 < 25.0) & (np.abs(x) < 65.0)] = 3
    labels[:1, :1, :1] = 3  # a stray voxel
    return labels


def to_ras():
    matrix = np.diag([*SPACING, 1.0])
    matrix[:3, 3] = ORIGIN
    return matrix


def reordered(labels, matrix, order, flips):
    """Equal labels with the voxel axes in another order and direction."""
    change = np.zeros((4, 4))
    change[3, 3] = 1.0
    for new, old in enumerate(order):
        change[old, new] = -1.0 if flips[old] else 1.0
        if flips[old]:
            change[old, 3] = labels.shape[old] - 1
    flipped = labels[tuple(slice(None, None, -1) if f else slice(None) for f in flips)]
    return np.ascontiguousarray(flipped.transpose(order)), matrix @ change


def write_nifti(path, labels, matrix, unit="mm"):
    image = nibabel.Nifti1Image(labels, matrix)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return path


def write_nrrd(path, labels, matrix, **more):
    """In the frame LPS of DICOM, as 3D Slicer writes it."""
    to_lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ matrix
    header = {
        "space": "left-posterior-superior",
        "space directions": to_lps[:3, :3].T,
        "space origin": to_lps[:3, 3],
    }
    nrrd.write(str(path), labels, header | more)
    return path


@pytest.fixture(scope="module")
def nifti(tmp_path_factory):
    return write_nifti(tmp_path_factory.mktemp("seg") / "ct.nii.gz", patient(), to_ras())


@pytest.fixture(scope="module")
def read(nifti):
    return read_segmentation(nifti, LABELS)


def test_surfaces_have_the_size_and_place_of_the_bodies(read):
    """Closed forms: an ellipsoid, whole although a ball and a tube were cut out of it, and both."""
    organ, vessel = (Mesh(part.vertices, part.faces) for part in read.parts)
    assert read.roles == ("organ", "keep-out")
    assert [part.name for part in read.parts] == ["liver", "portal"]
    assert organ.is_watertight
    assert vessel.is_watertight
    # the tube leaves the ellipsoid at both ends by up to 5 mm
    ellipsoid = 4.0 / 3.0 * np.pi * 60.0 * 50.0 * 50.0
    assert organ.volume_mm3 == pytest.approx(ellipsoid, rel=0.005)
    voxels = (patient() == 3).sum() * np.prod(SPACING)  # seven voxels across: smoothing shrinks it
    assert vessel.volume_mm3 == pytest.approx(voxels, rel=0.1)
    middle = organ.vertices_mm.mean(axis=0)
    np.testing.assert_allclose(middle, [0.0, 0.0, 300.0], atol=1.0)
    np.testing.assert_allclose(read.lesion.surface_mm.mean(axis=0), LESION, atol=0.3)
    radius = np.linalg.norm(read.lesion.surface_mm - LESION, axis=1)
    assert abs(radius.mean() - 8.0) < 0.3
    # the voxels of lesion and vessel belong to the solid organ
    inside = winding_numbers(organ, np.array([LESION, [0.0, 0.0, 290.0], [20.0, 0.0, 290.0]]))
    np.testing.assert_allclose(inside, 1.0, atol=1e-6)
    assert any("1 pieces below 0.05 ml left out" in note for note in read.notes)


@pytest.mark.parametrize(
    ("order", "flips"),
    list(zip(itertools.permutations(range(3)), itertools.product((0, 1), repeat=3), strict=False)),
)
def test_the_order_of_voxels_does_not_matter(order, flips, read, tmp_path):
    labels, matrix = reordered(patient(), to_ras(), order, flips)
    for path in (
        write_nifti(tmp_path / "ct.nii", labels, matrix),
        write_nrrd(tmp_path / "ct.nrrd", labels, matrix),
    ):
        again = read_segmentation(path, LABELS)
        for part, other in zip(again.parts, read.parts, strict=True):
            np.testing.assert_allclose(
                [part.vertices.min(0), part.vertices.max(0)],
                [other.vertices.min(0), other.vertices.max(0)],
                atol=0.02,
            )
            mesh = Mesh(part.vertices, part.faces)
            assert mesh.volume_mm3 == pytest.approx(
                Mesh(other.vertices, other.faces).volume_mm3, rel=1e-4
            )


def test_an_image_without_orientation_is_not_mirrored(read, tmp_path):
    """Its axes are taken as right, anterior, superior, as the note says, from the first voxel."""
    file = tmp_path / "none.nii"
    image = nibabel.Nifti1Image(patient(), None)
    image.header.set_zooms(SPACING)
    nibabel.save(image, file)
    found = read_segmentation(file, LABELS)
    assert any("right, anterior, superior" in note for note in found.notes)
    place = np.array(LESION) - ORIGIN
    np.testing.assert_allclose(found.lesion.surface_mm.mean(axis=0), place, atol=0.3)


def test_the_headers_unit_counts(read, tmp_path):
    matrix = to_ras()
    matrix[:3] /= 1000.0
    again = read_segmentation(write_nifti(tmp_path / "m.nii", patient(), matrix, "meter"), LABELS)
    np.testing.assert_allclose(
        again.parts[0].vertices.max(0), read.parts[0].vertices.max(0), atol=0.02
    )


def test_a_vessel_beside_the_organ_does_not_fill_its_notch(tmp_path):
    """An L of 1 mm voxels with a block in its notch, which touches the walls of the L."""
    labels = np.zeros((40, 40, 20), np.uint8)
    labels[4:36, 4:36, 4:16] = 1
    labels[20:36, 20:36] = 0
    labels[20:32, 20:32, 4:16] = 2
    path = write_nifti(tmp_path / "ct.nii", labels, np.eye(4))
    found = read_segmentation(path, tuple(map(parse_label, ("1:organ:liver", "2:keep-out:vein"))))
    organ = Mesh(found.parts[0].vertices, found.parts[0].faces)
    assert organ.volume_mm3 == pytest.approx((labels == 1).sum(), rel=0.02)
    inside = winding_numbers(organ, np.array([[12.0, 12.0, 10.0], [26.0, 26.0, 10.0]]))
    np.testing.assert_allclose(inside, [1.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(("unit", "mm"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0)])
@pytest.mark.parametrize(
    ("space", "to_right_anterior"),
    [
        ("left-posterior-superior", (-1.0, -1.0)),
        ("LPS", (-1.0, -1.0)),
        ("left-anterior-superior", (-1.0, 1.0)),
        ("LAS", (-1.0, 1.0)),
        ("right-anterior-superior", (1.0, 1.0)),
        ("RAS", (1.0, 1.0)),
    ],
)
def test_every_frame_and_unit_of_a_nrrd_becomes_mm_right_anterior_superior(
    space, to_right_anterior, unit, mm, tmp_path
):
    """The middle of the voxel (2, 0, 1), written by hand in the file's frame and unit."""
    header = {
        "space": space,
        "space directions": [[1.5, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.25, 3.0]],
        "space origin": [10.0, -20.0, 30.0],
        "space units": [unit] * 3,
    }
    path = tmp_path / "ct.nrrd"
    nrrd.write(str(path), np.ones((3, 3, 3), np.uint8), header)
    image = read_image(path)
    right, anterior, superior, _ = image.to_ras @ [2.0, 0.0, 1.0, 1.0]
    expected = (to_right_anterior[0] * 13.0 * mm, to_right_anterior[1] * -19.75 * mm, 33.0 * mm)
    assert (right, anterior, superior) == pytest.approx(expected)
    assert image.oriented


def test_slicers_segments_have_names_and_may_overlap(tmp_path):
    """Two layers: the lesion's voxels are the liver's too."""
    labels = patient()
    layers = np.stack([(labels > 0).astype(np.uint8), (labels == 2).astype(np.uint8)])
    to_lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ to_ras()
    header = {
        "space": "left-posterior-superior",
        "kinds": ["list", "domain", "domain", "domain"],
        "space directions": np.vstack([[np.nan] * 3, to_lps[:3, :3].T]),
        "space origin": to_lps[:3, 3],
        "Segment0_Name": "liver",
        "Segment0_LabelValue": "1",
        "Segment0_Layer": "0",
        "Segment1_Name": "tumour",
        "Segment1_LabelValue": "1",
        "Segment1_Layer": "1",
    }
    path = tmp_path / "ct.seg.nrrd"
    nrrd.write(str(path), layers, header)
    read = read_segmentation(path, (parse_label("liver:organ"), parse_label("tumour:lesion")))
    np.testing.assert_allclose(read.lesion.surface_mm.mean(axis=0), LESION, atol=0.3)
    assert [part.name for part in read.parts] == ["liver"]
    assert not any("left out: " in note for note in read.notes)
    by_value = read_segmentation(path, (parse_label("1:organ"), parse_label("tumour:lesion")))
    assert not any("left out: " in note for note in by_value.notes)
    (note,) = (text for text in read_segmentation(path, (parse_label("1:organ"),)).notes
               if "left out: " in text)  # fmt: skip
    assert "left out: tumour; name" in note
    with pytest.raises(InputError, match=r"no label 'kidney'; its labels are liver \(.*\), tumour"):
        read_segmentation(path, (parse_label("kidney:organ"),))


def test_the_ring_lies_above_the_lesion_with_its_margin(nifti):
    """The patient lies on the back: anterior is up, and the ball lies 12 mm below the surface."""
    request = Request((nifti,), ("organ",), labels=LABELS, margin_mm=4.0)
    prepared = prepare(request)
    assert ring_diameter(request, prepared) == pytest.approx(2.0 * (8.0 + 4.0), abs=0.7)
    (site,) = choose_sites(request, prepared)
    middle = prepared.lesion.surface_mm.mean(axis=0)
    # world x right, z anterior, so y to the feet; the origin is the middle of the organ
    np.testing.assert_allclose(middle, [8.0, 0.0, 38.0], atol=1.5)
    assert site.point_mm[2] > middle[2]
    assert across_mm(site, middle) < 0.4


def across_mm(site, points_mm):
    """Distance of points (..., 3) mm from the axis of a site's ring, mm."""
    away = np.asarray(points_mm) - site.point_mm
    along = away @ site.ring.normal
    return np.linalg.norm(away - along[..., None] * site.ring.normal, axis=-1)


@pytest.mark.parametrize(
    ("voxel_mm", "radius_mm"), [(0.75, 4.0), (1.0, 8.0), (1.5, 8.0), (2.0, 8.0)]
)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_ball_off_the_grid_has_its_size_and_the_ring_its_margin(
    voxel_mm, radius_mm, seed, tmp_path
):
    """A ball 2 mm below the surface of an ellipsoid of 60 x 48 x 44 mm, both at random places.

    The size is that between the voxels' centres: at most a voxel smaller than the ball, and never
    larger. The margin holds all around to half a voxel."""
    rng, semi = np.random.default_rng(seed), np.array([30.0, 24.0, 22.0])
    counts = np.ceil(2.0 * semi / voxel_mm + 6.0).astype(int)
    grid = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1) * voxel_mm
    middle = 0.5 * voxel_mm * (counts - 1) + rng.uniform(-0.5, 0.5, 3) * voxel_mm
    side = frames.normalise(rng.normal(size=3) * [0.5, 0.0, 0.5] + [0.0, 1.0, 0.0])
    ball = middle + side * (1.0 / np.linalg.norm(side / semi) - radius_mm - 2.0)
    labels = (np.linalg.norm((grid - middle) / semi, axis=-1) < 1.0).astype(np.uint8)
    labels[np.linalg.norm(grid - ball, axis=-1) < radius_mm] = 2
    image = write_nifti(tmp_path / "ball.nii.gz", labels, np.diag([*[voxel_mm] * 3, 1.0]))
    request = Request((image,), ("organ",), labels=LABELS[:2], margin_mm=5.0)
    prepared = prepare(request)
    seen = seen_lesion(request, prepared)
    assert -voxel_mm <= 2.0 * (seen.radius_mm - radius_mm) <= 1e-6
    assert seen.depth_mm == pytest.approx(2.0, abs=0.5 * voxel_mm + 0.3)
    (site,) = choose_sites(request, prepared)
    true = prepared.to_world @ ball + prepared.shift_mm
    margin = across_mm(replace(site, point_mm=true), site.ring.points_mm) - radius_mm
    assert np.abs(margin - 5.0).max() <= 0.5 * voxel_mm
    assert across_mm(site, true) <= 0.2 * voxel_mm + 0.05


def test_the_smallest_circle_around_points():
    """Two points, a triangle with an obtuse angle, one on a circle with points inside."""
    cases = (
        ([[0.0, 0.0], [6.0, 8.0]], [3.0, 4.0], 5.0),
        ([[0.0, 0.0], [10.0, 0.0], [5.0, 1.0]], [5.0, 0.0], 5.0),
        ([[3.0, 0.0], [0.0, 3.0], [-3.0, 0.0], [1.0, 1.0], [0.0, -2.0]], [0.0, 0.0], 3.0),
        ([[2.0, 1.0]] * 4, [2.0, 1.0], 0.0),
        ([[0.0, 0.0], [1.0, 1.0], [4.0, 4.0]], [2.0, 2.0], 8.0**0.5),
    )
    for points, centre, radius in cases:
        found, size = enclosing_circle(np.array(points))
        np.testing.assert_allclose(found, centre, atol=1e-9)
        assert size == pytest.approx(radius, abs=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--unit", "cm"), "--unit is given for {image}, a segmented image, whose header"),
        (("--scale", "10"), "--scale is given for {image}, a segmented image, whose header"),
        (("--margin", "3", "--diameter", "20"), "both --diameter and --margin are given"),
        (("--margin", "3", "--lesion", "0", "0", "0"), "--margin is given beside --lesion"),
        (("--margin", "3", "--lesion-direction", "0", "0", "1"), "beside --lesion-direction"),
    ],
)
def test_an_option_without_effect_on_an_image_is_refused(options, message, nifti, tmp_path, capsys):
    words = [word for one in LABELS for word in ("--label", f"{one.key}:{one.role}:{one.name}")]
    target = tmp_path / "scene"
    assert run(["scene", "new", str(nifti), *words, *options, "-o", str(target)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message.format(image=nifti) in line
    assert not target.exists()


def test_a_margin_needs_a_lesion_among_the_labels(nifti, tmp_path):
    organ = tuple(one for one in LABELS if one.role != "lesion")
    with pytest.raises(InputError, match="--margin is given without a segmented lesion"):
        Request((nifti,), ("organ",), labels=organ, margin_mm=4.0)
    meshes = (nifti, tmp_path / "bone.stl")
    assert Request(meshes, ("organ", "support"), labels=organ, unit="cm").unit == "cm", "the mesh's"


def test_a_segmented_patient_becomes_a_scene(nifti, tmp_path, capsys):
    labels = [f"{one.key}:{one.role}:{one.name}" for one in LABELS]
    options = [word for label in labels for word in ("--label", label)]
    options += ["--margin", "4.5"]
    assert run(["scene", "new", str(nifti), *options, "-o", str(tmp_path / "scene")]) == 0
    said = capsys.readouterr().out
    assert "segmented lesion: 1" in said
    scene = open_scene(tmp_path / "scene")
    assert [(body.name, body.role) for body in scene.bodies] == [
        ("liver", "organ"),
        ("portal", "keep-out"),
    ]
    distance = float(said.split("ring to 'portal'")[1].split("mm")[0])
    # from the ring on the front of the organ to the tube, whose axis lies at y = 0, z = 290
    world = scene.ring.points_mm
    vessel = scene.spec.body("portal")
    points = next(body for body in scene.bodies if body.name == vessel.name).world_mesh.vertices_mm
    nearest = np.linalg.norm(world[:, None] - points[None], axis=2).min()
    assert distance == pytest.approx(nearest, abs=0.2)


BAD = [
    ((), r"say what its labels are .* its labels are 1 \([\d.]+ ml\), 2 \(2"),
    (("2:lesion",), "0 labels with the role organ"),
    (("1:organ", "2:organ"), "2 labels with the role organ"),
    (("1:organ", "7:lesion"), r"there is no label '7'; its labels are 1"),
    (("1:organ", "²:lesion"), r"there is no label '²'"),
    (("1:organ", "+-2:lesion"), r"there is no label '\+-2'"),
]


@pytest.mark.parametrize(("labels", "says"), BAD, ids=[says for _, says in BAD])
def test_bad_labels_list_those_of_the_file(labels, says, nifti):
    with pytest.raises(InputError, match=says):
        read_segmentation(nifti, tuple(map(parse_label, labels)))


def test_images_that_are_no_segmentation_are_one_line(tmp_path):
    grey = write_nifti(tmp_path / "grey.nii", patient() * np.float32(0.3), to_ras())
    flat = write_nifti(tmp_path / "flat.nii", patient()[:, :, :1], to_ras())
    noise = tmp_path / "noise.nrrd"
    noise.write_bytes(b"NRRD0004\ntype: short\nsizes: x y\n\n")
    cut = tmp_path / "cut.nii.gz"
    cut.write_bytes(write_nifti(tmp_path / "w.nii.gz", patient(), to_ras()).read_bytes()[:900])
    huge = tmp_path / "huge.nrrd"
    huge.write_text(
        "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 9000 9000 9000\nencoding: raw\n\nx"
    )
    for path, says in (
        (grey, "holds grey values"),
        (flat, "expected a volume"),
        (noise, "cannot be read as a segmented image"),
        (cut, "cannot be read as a segmented image"),
        (huge, "9000 x 9000 x 9000 voxels"),
        (tmp_path / "absent.nii", "there is no such file"),
    ):
        with pytest.raises(InputError, match=says) as stopped:
            read_segmentation(path, LABELS)
        assert "\n" not in str(stopped.value)


@pytest.mark.parametrize("name", ["image.nii", "image.nii.gz", "image.nrrd"])
def test_a_header_that_claims_more_than_the_file_is_refused_at_once(tmp_path, name):
    """1024 x 1024 x 1000 voxels in a file of a few hundred bytes."""
    path, labels = tmp_path / name, np.ones((4, 4, 4), np.uint8)
    if name.endswith("nrrd"):
        nrrd.write(str(path), labels, {"encoding": "raw"})
        path.write_bytes(path.read_bytes().replace(b"sizes: 4 4 4", b"sizes: 1024 1024 1000"))
    else:
        image = nibabel.Nifti1Image(labels, np.eye(4))
        content = image.to_bytes().replace(
            struct.pack("<4h", 3, 4, 4, 4), struct.pack("<4h", 3, 1024, 1024, 1000), 1
        )
        path.write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    with pytest.raises(InputError, match=r"its header claims 10485760+ bytes"):
        read_segmentation(path, LABELS)
