"""Motive exports with a known truth: centres by circle fit, frames, logs matched by time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.measurement.importing import READY_MAPS, import_files, load_map

from .motive import MOUNT, arm, export, markers_on, to_room

T = np.arange(400) / 100.0
PLANES = 4


def room_markers(t=T, planes=PLANES, count=3):
    centres, normals = arm(t, planes)
    return to_room(markers_on(centres, normals, count), MOUNT)


def pressures(t):
    return np.stack([20 + 5 * t, 40 - 3 * t], axis=1)  # linear, so interpolation is exact


def write_log(path, t, command=True, start=0.0):
    p = pressures(t)
    columns = {"t_s": t + start, "p1_kPa": p[:, 0], "p2_kPa": p[:, 1]}
    if command:
        columns |= {"c1_kPa": np.floor(p[:, 0]), "c2_kPa": np.floor(p[:, 1])}
    rows = np.column_stack(list(columns.values()))
    path.write_text(
        "\n".join([",".join(columns), *(",".join(map(repr, row.tolist())) for row in rows)])
    )
    return path


def take(path, **options):
    markers = options.pop("markers", None)
    path.write_text(export(T, room_markers() if markers is None else markers, **options))
    return path


def imported(files, name="motive"):
    (part,) = import_files(files, load_map(name), "x")
    return part.recording, part.notes


@pytest.mark.parametrize("version", ["1.1", "1.21", "1.23", "1.25"])
@pytest.mark.parametrize("unit", ["Meters", "Centimeters", "Millimeters"])
def test_ready_map_gives_the_true_centres(tmp_path, version, unit):
    files = [
        take(tmp_path / "take.csv", version=version, unit=unit),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    recording, notes = imported(files)
    truth, _ = arm(T, PLANES)
    rest = truth[:20].mean(axis=0)
    chord = rest[-1] - rest[0]
    # the frame of the import: origin at k0, z along the chord at rest; compare without its heading
    found = recording.key_points_mm
    np.testing.assert_allclose(found[..., 2], truth @ chord / np.linalg.norm(chord), atol=1e-5)
    np.testing.assert_allclose(
        np.linalg.norm(found, axis=2), np.linalg.norm(truth, axis=2), atol=1e-5
    )
    distances = np.linalg.norm(found[:, :, None] - found[:, None], axis=3)
    expected = np.linalg.norm(truth[:, :, None] - truth[:, None], axis=3)
    np.testing.assert_allclose(distances, expected, atol=1e-5)
    assert any("radius 7.500 mm" in note for note in notes)


def test_a_unit_in_the_map_counts_and_not_that_of_the_file(tmp_path):
    """A take that calls its centimetres metres is a hundred times too large without it."""
    files = [
        take(tmp_path / "take.csv", unit="Meters"),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    spec = load_map("motive")
    stated, _ = imported(files)
    known = replace(spec, key_points=replace(spec.key_points, unit="cm"))
    (part,) = import_files(files, known, "x")
    found = 100.0 * part.recording.key_points_mm
    np.testing.assert_allclose(found, stated.key_points_mm, atol=1e-9)
    said = 'states that its positions are in m, but the map unit = "cm" in [key_points]'
    assert any(said in note for note in part.notes)


def test_bend_is_not_mirrored(tmp_path):
    """The signed volume of the frame (rest, bent tip, normal) keeps its sign only by a rotation."""
    centres, normals = arm(T, PLANES)
    centres[..., 1] += 0.2 * centres[..., 2] * np.sin(1.3 * T)[:, None]
    room = to_room(markers_on(centres, normals), MOUNT)
    files = [
        take(tmp_path / "take.csv", markers=room),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    found = imported(files)[0].key_points_mm[:, -1]
    truth = centres[:, -1]
    rows = [30, 150, 290]
    assert np.linalg.det(found[rows]) == pytest.approx(np.linalg.det(truth[rows]), rel=1e-4)
    assert abs(np.linalg.det(truth[rows])) > 1e4


def test_gravity_is_motives_down_in_the_arms_frame(tmp_path):
    files = [take(tmp_path / "t.csv"), write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05))]
    recording, _ = imported(files)
    truth, _ = arm(T, PLANES)
    chord = truth[:20].mean(axis=0)[-1] - truth[:20].mean(axis=0)[0]
    along = MOUNT[0] @ chord / np.linalg.norm(chord)  # the arm's z axis in the room
    assert recording.gravity[2] == pytest.approx(along @ [0, -1, 0], abs=1e-6)
    assert np.linalg.norm(recording.gravity) == pytest.approx(1)


def test_log_is_interpolated_and_its_command_is_held(tmp_path):
    log_t = np.arange(0, 4.2, 0.07)
    files = [take(tmp_path / "t.csv"), write_log(tmp_path / "log.csv", log_t, start=1234.5)]
    recording, notes = imported(files)
    np.testing.assert_allclose(recording.measured, pressures(recording.t_s), atol=1e-9)
    before = log_t[np.searchsorted(log_t, recording.t_s + 1e-6) - 1]
    np.testing.assert_array_equal(recording.commanded, np.floor(pressures(before)))
    assert any("interpolated linearly in time" in note for note in notes)
    assert recording.unit == "kPa"


def test_rows_outside_of_the_log_or_in_its_gaps_are_left_out(tmp_path):
    log_t = np.concatenate([np.arange(0, 1, 0.05), np.arange(2.5, 3.0, 0.05)])
    log_t -= log_t[0]
    files = [take(tmp_path / "t.csv"), write_log(tmp_path / "log.csv", log_t)]
    recording, notes = imported(files)
    inside = (T <= 0.95 + 1e-9) | ((T >= 2.5 - 1e-9) & (log_t[-1] + 1e-9 >= T))
    np.testing.assert_allclose(recording.t_s, T[inside], atol=1e-9)
    assert any(
        f"{int((~inside).sum())} rows" in note and "longer than 1 s" in note for note in notes
    )


def test_a_log_of_other_names_is_told_to_be_drafted(tmp_path):
    files = [take(tmp_path / "take.csv"), tmp_path / "log.csv"]
    files[1].write_text("t_s,act A [bar]\n0,1\n1,2\n")
    with pytest.raises(InputError, match="no column 'p1_kPa'") as error:
        imported(files)
    told = f"surgisoft import {files[0]} {files[1]} --draft map.toml"
    assert str(error.value).endswith(told)


def test_log_without_command_gives_none(tmp_path):
    log = write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05), command=False)
    recording, _ = imported([take(tmp_path / "t.csv"), log])
    assert recording.commanded is None


def test_lost_markers_lose_the_plane_only_where_two_are_left(tmp_path):
    markers = room_markers(count=4)
    lost = [(10, 2, 0), (11, 2, 0), (11, 2, 1), (12, 3, 1), (12, 3, 2), (12, 3, 3)]
    files = [
        take(tmp_path / "t.csv", markers=markers, lost=lost),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    recording, notes = imported(files)
    missing = np.argwhere(np.isnan(recording.key_points_mm[..., 0])).tolist()
    assert missing == [[11, 2], [12, 3]]
    truth, _ = arm(T, PLANES)
    length = np.linalg.norm(recording.key_points_mm[10, 2])
    assert length == pytest.approx(np.linalg.norm(truth[10, 2]), abs=1e-5)
    assert any("k2: circle through 4 markers" in n and "1 rows with fewer" in n for n in notes)


def test_solved_markers_serve_where_measured_ones_are_not_exported(tmp_path):
    path = tmp_path / "t.csv"
    text = export(T, room_markers(), solved=True)
    lines = text.split("\n")
    keep = [i for i, kind in enumerate(lines[2].split(",")) if kind != "Marker" or i < 2]
    lines = [
        ",".join(line.split(",")[i] for i in keep) if n >= 2 and line else line
        for n, line in enumerate(lines)
    ]
    path.write_text("\n".join(lines))
    log = write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05))
    recording, _ = imported([path, log])
    truth, _ = arm(T, PLANES)
    # the solved markers are moved by 5 mm along every axis as a whole: distances stay
    np.testing.assert_allclose(
        np.linalg.norm(recording.key_points_mm, axis=2), np.linalg.norm(truth, axis=2), atol=1e-5
    )


def test_bodies_instead_of_circles(tmp_path):
    markers = room_markers(count=4)  # evenly on the circle: the mean is the centre
    files = [
        take(tmp_path / "t.csv", markers=markers),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    circles, _ = imported(files)
    bodies, _ = imported(files, "motive-bodies")
    np.testing.assert_allclose(bodies.key_points_mm, circles.key_points_mm, atol=1e-5)


def test_planes_stand_in_natural_order(tmp_path):
    """Plane2 comes before Plane10: eleven planes, farther from the base with their number."""
    markers = room_markers(planes=11)
    files = [
        take(tmp_path / "t.csv", markers=markers),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    recording, _ = imported(files)
    assert recording.key_points == 11
    assert (np.diff(recording.key_points_mm[0, :, 2]) > 0).all()


def test_bodies_may_have_numbers_of_any_length(tmp_path):
    """More digits than `int` reads: an order all the same, after the bodies with fewer digits."""
    path = take(tmp_path / "t.csv", markers=room_markers(count=4))
    path.write_text(path.read_text().replace("Plane1", "Plane" + "1" * 5000))
    log = write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05))
    recording, _ = imported([path, log], "motive-bodies")
    height_mm = recording.key_points_mm[0, :, 2]
    assert (np.diff(height_mm[:-1]) > 0).all()
    assert height_mm[0] < height_mm[-1] < height_mm[1], "the second of them comes last"


MAP = """
[file.take]
format = "motive"
[file.log]
join = "time"
clock = "from_start"
[time]
column = "Time"
[measured]
file = "log"
columns = ["p1_kPa"]
unit = "kPa"
"""


def by_map(tmp_path, text, files):
    path = tmp_path / "map.toml"
    path.write_text(MAP + text)
    (part,) = import_files(files, load_map(str(path)), "x")
    return part.recording


def test_named_markers_and_a_moving_base_body(tmp_path):
    """Markers by name, positions relative to the pose of a body: the mount cancels out."""
    centres, normals = arm(T, PLANES)
    room = to_room(markers_on(centres, normals, 4), MOUNT)
    files = [
        take(tmp_path / "t.csv", markers=room),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    planes = ", ".join(
        "[" + ", ".join(f'"Plane{p}:Marker{m}"' for m in (1, 2, 3)) + "]" for p in range(PLANES)
    )
    recording = by_map(
        tmp_path,
        f"[key_points]\nmarkers = [{planes}]\n"
        '[frame.base]\nposition = "Plane0"\nquaternion = "Plane0"\nmode = "moving"\n',
        files,
    )
    # the exported body 0 stands in the centre of plane 0 with one constant orientation
    found = np.linalg.norm(recording.key_points_mm, axis=2)
    np.testing.assert_allclose(found, np.linalg.norm(centres, axis=2), atol=1e-5)


def test_euler_angles_are_no_orientation(tmp_path):
    files = [
        take(tmp_path / "t.csv", euler=True),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    with pytest.raises(InputError, match=r"no column 'Plane0\.qx'"):
        by_map(
            tmp_path,
            '[key_points]\nauto = "planes"\n'
            '[frame.base]\nposition = "Plane0"\nquaternion = "Plane0"\n',
            files,
        )


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda text: text.replace("Meters", "Inches"), "line 1: length unit 'Inches', expected"),
        (lambda text: text.replace("Frame,Time", "Bild,Zeit"), "no line that starts with 'Frame'"),
        (lambda text: text.replace("Plane1:", "Plane1_"), ""),
        (lambda text: text.replace('"Plane2:Marker3"', '"Plane2_Marker3"'), "has 2 markers"),
        (lambda text: text.split("Frame,Time")[0] + "Frame,Time\n", "no rows of numbers"),
    ],
)
def test_bad_export(tmp_path, change, expected):
    path = tmp_path / "t.csv"
    path.write_text(change(export(T, room_markers(), bodies=False, solved=False)))
    log = write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05))
    if not expected:  # a plane whose markers do not fit the pattern is no key point
        assert imported([path, log])[0].key_points == PLANES - 1
        return
    with pytest.raises(InputError) as error:
        imported([path, log])
    assert str(error.value).startswith(str(path))
    assert expected in str(error.value)


def test_markers_on_a_line_are_an_error_that_names_the_plane(tmp_path):
    markers = room_markers()
    markers[:, 2, 2] = 2 * markers[:, 2, 1] - markers[:, 2, 0]
    files = [
        take(tmp_path / "t.csv", markers=markers),
        write_log(tmp_path / "log.csv", np.arange(0, 4.2, 0.05)),
    ]
    with pytest.raises(InputError, match="markers of key point k2 stand on one line"):
        imported(files)


def test_take_and_log_are_distinguished_by_content(tmp_path):
    log = write_log(tmp_path / "a_log.csv", np.arange(0, 4.2, 0.05))
    assert imported([log, take(tmp_path / "z_take.csv")])[0].key_points == PLANES
    with pytest.raises(InputError, match=r"no file for \[file.log\]"):
        imported([tmp_path / "z_take.csv"])
    with pytest.raises(InputError, match=r"no file for \[file.take\].*is a Motive CSV export"):
        imported([log])


@pytest.mark.parametrize("name", READY_MAPS)
def test_ready_maps_are_the_shipped_examples(name):
    """The maps in the documentation say exactly what the ready ones do."""
    folder = Path(__file__).resolve().parents[2] / "docs" / "examples" / "maps"
    assert (folder / f"{name.replace('-', '_')}.toml").read_text() == READY_MAPS[name]
