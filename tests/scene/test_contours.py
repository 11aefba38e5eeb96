"""Contours on a plane against lengths and areas by hand; what does not fit is one line."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from surgisoft.config import Where, from_table
from surgisoft.errors import InputError
from surgisoft.scene.ablation import AblationMap
from surgisoft.scene.contours import contour_path, grown, laid, raster, signed_distance_mm
from surgisoft.scene.dose_patch import HEALTHY, LESION, RING, area_patch, path_patch
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.spec import ContourSpec

LOOP = 2.0 * math.pi * np.arange(720) / 720


@pytest.fixture(scope="module")
def plane():
    """The upper side of a box, at z = 5 mm."""
    box = trimesh.creation.box((80.0, 80.0, 10.0))
    return Mesh(np.array(box.vertices), np.array(box.faces))


def disc(radius):
    """A circle of points on the plane."""
    return np.stack((radius * np.cos(LOOP), radius * np.sin(LOOP), 0.0 * LOOP + 5.0), axis=1)


def spec(**fields):
    """A contour as a file has it."""
    return from_table(ContourSpec, {"name": "c", **fields}, Where(Path("c.toml")))


def test_the_arc_length_of_a_polyline_by_hand(plane):
    """3 mm and 4 mm at a right angle: 7 mm open, 12 mm closed (the hypotenuse has 5 mm)."""
    corners = [[0.0, 0.0, 5.0], [3.0, 0.0, 5.0], [3.0, 4.0, 5.0]]
    there = contour_path(plane, spec(points_mm=corners, closed=False), 0.25)
    assert there.length_mm == pytest.approx(7.0, abs=1e-9)
    assert len(there.points_mm) == 29
    np.testing.assert_allclose(there.points_mm[[0, 12, 28]], corners, atol=1e-9)
    back = contour_path(plane, spec(points_mm=corners), 0.25)
    assert back.length_mm == pytest.approx(12.0, abs=1e-9)
    assert len(back.points_mm) == 48
    steps = np.linalg.norm(np.roll(back.points_mm, -1, axis=0) - back.points_mm, axis=1)
    np.testing.assert_allclose(steps, 0.25, atol=1e-9)
    np.testing.assert_allclose(back.normals, [[0.0, 0.0, 1.0]] * 48, atol=1e-12)


def test_a_margin_grows_a_square_by_hand(plane):
    """10 mm grown by 2 mm: quarter circles at the corners; 40 + 4 pi mm around."""
    square = [[-5.0, -5.0, 5.0], [5.0, -5.0, 5.0], [5.0, 5.0, 5.0], [-5.0, 5.0, 5.0]]
    path = contour_path(plane, spec(points_mm=square, margin_mm=2.0), 0.1)
    assert path.length_mm == pytest.approx(40.0 + 4.0 * math.pi, rel=2e-3)
    off = signed_distance_mm(path.points_mm[:, :2], np.array(square)[:, :2])
    np.testing.assert_allclose(off, 2.0, atol=0.01)
    back = grown(plane, np.array(square)[::-1], 2.0)
    assert len(back) > 100, "either direction of travel"
    np.testing.assert_allclose(back[:, 2], 5.0, atol=1e-6, err_msg="on the same side of the box")


def test_a_margin_that_closes_a_gap_leaves_the_outer_line(plane):
    """A wall of 5 mm around a yard of 10 mm with a gate of 1 mm, grown by 1 mm."""
    corners = [(-10, -10), (10, -10), (10, 10), (0.5, 10), (0.5, 5), (5, 5), (5, -5), (-5, -5)]
    corners += [(-5, 5), (-0.5, 5), (-0.5, 10), (-10, 10)]
    for turned in ((x, y) for x in (1.0, -1.0) for y in (1.0, -1.0)):
        outline = np.array([(turned[0] * x, turned[1] * y, 5.0) for x, y in corners])
        line = grown(plane, outline, 1.0)
        length = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1).sum()
        assert length == pytest.approx(80.0 + 2.0 * math.pi, rel=5e-3)


def test_a_raster_covers_a_disc_by_hand(plane):
    """Rows 1.25 mm apart within 9 mm of the middle: chords, joined by straight lines."""
    (path,) = raster(plane, disc(10.0), 1.25, 1.0, 0.2)
    rows = 1.25 * (np.arange(15) - 7.0)
    half = np.sqrt(81.0 - rows**2)
    across = np.hypot(1.25, np.diff(half))
    assert path.length_mm == pytest.approx(2.0 * half.sum() + across.sum(), abs=15 * 0.4)
    assert (path.length_mm - across.sum()) * 1.25 == pytest.approx(math.pi * 81.0, rel=0.04)
    assert np.linalg.norm(path.points_mm[:, :2], axis=1).max() <= 9.0 + 1e-6
    assert not path.closed
    assert len(np.unique(path.points_mm[:, 1].round(1))) >= 15


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_a_raster_leaves_the_notch_of_a_concave_outline_alone(plane, turned):
    """A U, 20 x 10 mm, with a notch of 5 x 6 mm: a base of 4 mm, and two arms of 7.5 x 6 mm.

    No point is farther outside than the overrun and the allowance of the ways between lines, all
    of the U is within half a pitch of a line, and the paths are three."""
    corners = [(-10, -5), (10, -5), (10, 5), (2.5, 5), (2.5, -1), (-2.5, -1), (-2.5, 5), (-10, 5)]
    outline = np.array([(x, turned * y, 5.0) for x, y in corners])
    paths = raster(plane, outline, 1.25, -0.5, 0.25)
    assert len(paths) == 3
    every = np.concatenate([path.points_mm for path in paths])
    away = signed_distance_mm(every[:, :2], outline[:, :2])
    assert away.max() <= 0.5 + 0.5 * 1.25 + 1e-6
    for path in paths:
        steps = np.linalg.norm(np.diff(path.points_mm, axis=0), axis=1)
        assert steps.max() <= 0.25 + 1e-6
    grid = np.stack(np.meshgrid(np.linspace(-10, 10, 81), np.linspace(-5, 5, 41)), -1).reshape(
        -1, 2
    )
    within = grid[signed_distance_mm(grid, outline[:, :2]) < 0.0]
    gaps = np.linalg.norm(within[:, None] - every[None, :, :2], axis=2).min(axis=1)
    assert gaps.max() <= 0.5 * 1.25 + 0.25


def test_the_zones_of_paths_have_the_areas_by_hand(plane):
    """A circle of 6 mm and, 20 mm aside, a line of 8 mm with its round ends; bands of 2 mm."""
    circle = laid(plane, disc(6.0), True, 0.1)
    line = laid(plane, np.array([[20.0, -4.0, 5.0], [20.0, 4.0, 5.0]]), False, 0.1)
    patch = path_patch(plane, (circle, line), 0.2, band_mm=2.0, margin_mm=3.0)
    area = [patch.areas_mm2[patch.zone == zone].sum() for zone in (LESION, RING, HEALTHY)]
    assert area[LESION] == pytest.approx(25.0 * math.pi, rel=0.01)
    assert area[RING] == pytest.approx(24.0 * math.pi + 16.0 + math.pi, rel=0.01)
    # From 1 to 3 mm outside of the circle; on either side of the line, and around its ends.
    assert area[HEALTHY] == pytest.approx((81.0 - 49.0 + 8.0) * math.pi + 32.0, rel=0.01)
    assert patch.stations == 75 + 16, "of half a millimetre"
    assert patch.station[patch.points_mm[:, 0] > 15.0].min() == 75
    assert patch.offset_mm[patch.zone == LESION].max() < -1.0 + 1e-6


def test_an_area_and_its_dose_by_hand(plane):
    """A raster over a disc: the area with the dose, and healthy tissue that was burnt."""
    outline = laid(plane, disc(5.0), True, 0.1)
    patch = area_patch(plane, (outline,), 0.3, spared_mm=1.0, margin_mm=2.0)
    area = [patch.areas_mm2[patch.zone == zone].sum() for zone in (LESION, RING, HEALTHY)]
    assert area == pytest.approx(
        [25.0 * math.pi, (36.0 - 25.0) * math.pi, (64.0 - 36.0) * math.pi], rel=0.02
    )
    ablation = AblationMap(patch, 0.5, depth_mm=0.1, exact_lesion=True)
    (path,) = raster(plane, outline.points_mm, 0.6, 0.3, 0.5)
    points = torch.tensor(path.points_mm).float()
    down, on = torch.tensor([[0.0, 0.0, -1.0]]), torch.tensor([True])
    state = ablation.start(points[:1], down, on)
    for point in points[1:]:
        state = ablation.advance(state, point[None], down, on, 4.0, 0.1)
    dose = state.dose[0].double()
    # The dose of an endless raster is even: power / (speed x pitch).
    middle = torch.tensor(np.linalg.norm(patch.points_mm[:, :2], axis=1) < 2.0)
    assert dose[middle].mean().item() == pytest.approx(4.0 / (5.0 * 0.6), rel=0.03)
    treated = (dose >= ablation.cut_dose).numpy() & (patch.zone == LESION)
    assert state.zone_mm2[0, LESION].item() == pytest.approx(patch.areas_mm2[treated].sum(), 1e-4)
    assert 0.9 < patch.areas_mm2[treated].sum() / area[LESION] <= 1.0
    burnt = (dose >= ablation.threshold).numpy() & (patch.zone == HEALTHY)
    assert state.zone_mm2[0, HEALTHY].item() == pytest.approx(patch.areas_mm2[burnt].sum(), 1e-4)
    plain = AblationMap(patch, 0.5, depth_mm=0.1)
    after = plain.advance(plain.start(points[:1], down, on), points[20:21], down, on, 4.0, 0.1)
    both = ablation.advance(ablation.start(points[:1], down, on), points[20:21], down, on, 4.0, 0.1)
    assert after.zone_mm2[0, LESION] > both.zone_mm2[0, LESION], "from a lower dose on"


def test_points_come_from_a_table_beside_the_file(plane, tmp_path):
    (tmp_path / "line.csv").write_text("x,y,z\n0,0,5\n3,4,5\n")
    where = Where(tmp_path / "c.toml")
    read = from_table(ContourSpec, {"name": "c", "file": "line.csv", "closed": False}, where)
    assert read.points_mm == ((0.0, 0.0, 5.0), (3.0, 4.0, 5.0))
    assert contour_path(plane, read, 0.5).length_mm == pytest.approx(5.0)
    (tmp_path / "line.csv").write_text(" z, y ,x,note\n5,4,3,end\n\n5,0,0,\n")
    read = from_table(ContourSpec, {"name": "c", "file": "line.csv", "closed": False}, where)
    assert read.points_mm == ((3.0, 4.0, 5.0), (0.0, 0.0, 5.0))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            b"x,y\n1,2\n",
            r"line\.csv has no column z; its first line is: x, y; expected a first line",
        ),
        (b"1,2,3\n4,5,6\n", r"has no column x, y, z; its first line is: 1, 2, 3; expected"),
        (b"x;y;z\n1;2;3\n", r"has no column x, y, z; its first line is: x;y;z; .* commas"),
        (b"", "has no column x, y, z; its first line is: nothing"),
        (b"x,y,z\n1,2,3\n1,2,?\n", r"line 3 of .*line\.csv is: 1,2,\?; expected numbers for x, y"),
        (b"x,y,z\n1,2\n", r"line 2 of .*line\.csv is: 1,2; expected numbers"),
        (b"x,y,z\n1,2,nan\n3,4,5\n", r"line 2 of .*line\.csv has a number that is not finite"),
        (b"x,y,z\n\xff\xfe\n", r"line\.csv is no text of comma-separated values"),
        (None, r"line\.csv cannot be read \(No such file or directory\)"),
    ],
)
def test_a_table_that_holds_no_points_says_what_it_holds(content, said, tmp_path):
    if content is not None:
        (tmp_path / "line.csv").write_bytes(content)
    where = Where(tmp_path / "c.toml")
    with pytest.raises(InputError, match=r"c\.toml: file: .*" + said) as raised:
        from_table(ContourSpec, {"name": "c", "file": "line.csv", "closed": False}, where)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, "0 of points_mm, file and centre_mm are given"),
        ({"points_mm": [[0.0, 0.0, 5.0]] * 2}, "points_mm: got 2 points; expected at least 3"),
        ({"centre_mm": [0.0, 0.0]}, "centre_mm: got 2 numbers"),
        (
            {"points_mm": [[0.0, 0.0, 5.0], [1.0, 0.0, 5.0]], "closed": False, "margin_mm": 1.0},
            "margin_mm: got it for an open contour",
        ),
    ],
)
def test_a_bad_contour_is_one_line(fields, said):
    with pytest.raises(InputError, match=said):
        spec(**fields)


def test_a_contour_off_the_organ_is_named(plane):
    high = spec(points_mm=[[0.0, 0.0, 5.0], [3.0, 0.0, 5.0], [3.0, 4.0, 7.0]])
    with pytest.raises(InputError, match=r"point 3 of 3, .* lies 2 mm off"):
        contour_path(plane, high, 0.2)
    with pytest.raises(InputError, match="lies 3 mm off"):
        contour_path(plane, spec(centre_mm=[0.0, 0.0, 8.0]), 0.2)
    with pytest.raises(InputError, match="extends over an edge"):
        contour_path(plane, spec(centre_mm=[37.0, 0.0, 5.0]), 0.2)
    with pytest.raises(InputError, match="open; an area needs a closed"):
        area_patch(plane, (laid(plane, disc(5.0), False, 0.1),), 0.3, 1.0)


def test_an_outline_that_crosses_itself_has_no_inside(plane):
    """An eight about (3, -2): every use of its inside is refused, following it as open is not."""
    eight = np.stack((3 + 6 * np.sin(LOOP), 5 * np.sin(LOOP) * np.cos(LOOP) - 2, 5 + 0 * LOOP), 1)
    place = r"crosses itself near \(3\.0, -2\.0, 5\.0\) mm"
    closed, points = laid(plane, eight, True, 0.2, "e"), eight[::9].tolist()
    refused = (
        lambda: contour_path(plane, spec(points_mm=points, margin_mm=1.0), 0.2),
        lambda: path_patch(plane, (closed,), 0.3),
        lambda: area_patch(plane, (closed,), 0.3, 1.0),
        lambda: raster(plane, closed.points_mm, 1.0, 0.0, 0.2),
    )
    for use in refused:
        with pytest.raises(InputError, match=place):
            use()
    with pytest.raises(InputError, match="contour 'e' crosses itself"):
        path_patch(plane, (closed,), 0.3)
    followed = contour_path(plane, spec(points_mm=[*points, points[0]], closed=False), 0.2)
    assert not (path_patch(plane, (followed,), 0.3).zone == LESION).any()


def test_contours_that_coincide_are_named_with_the_length(plane):
    """A circle of 6 mm twice: 37.7 mm; half of it again: 18.8 mm; a line through it crosses it."""
    one, other = (laid(plane, disc(6.0), True, 0.2, name) for name in ("a", "b"))
    line = laid(plane, np.array([[-9.0, 0.0, 5.0], [9.0, 0.0, 5.0]]), False, 0.2, "line")
    with pytest.raises(InputError, match="contours 'a' and 'b' coincide over") as raised:
        path_patch(plane, (one, other), 0.3, band_mm=2.0)
    length = float(str(raised.value).split(" over ")[1].split(" mm")[0])
    assert length == pytest.approx(12.0 * math.pi, abs=0.3)
    half = laid(plane, disc(6.0)[:360], False, 0.2, "half")
    with pytest.raises(InputError, match=r"contours 'a' and 'half' .* over 18\.[5-9]"):
        path_patch(plane, (one, half), 0.3, band_mm=2.0)
    patch = path_patch(plane, (one, line), 0.3, band_mm=2.0)
    assert patch.ring_length_mm == pytest.approx(12.0 * math.pi + 18.0, rel=1e-3)
