"""Importing column-wise files of every kind: what comes out is what was put in."""

import bz2
import gzip
import lzma

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from surgisoft.errors import InputError
from surgisoft.measurement.importing import import_files
from surgisoft.measurement.importing_map import parse_map
from surgisoft.toml_config import read_toml

NAMES = ["t", "u1", "u2", "x", "y", "z"]
BASE = """
[time]
column = "t"
[measured]
columns = ["u1", "u2"]
unit = "psi"
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
"""


def table(rows=40, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(rows, 6)) * [1, 10, 10, 30, 30, 30]
    values[:, 0] = np.cumsum(rng.uniform(0.01, 0.1, rows))
    return values


def text(values, separator=",", header=NAMES, end="\n", decimal=".", before=()):
    lines = [*before, separator.join(header)] if header else [*before]
    lines += [
        separator.join("" if np.isnan(v) else repr(v).replace(".", decimal) for v in row)
        for row in values.tolist()
    ]
    return end.join(lines) + end


def spec(tmp_path, content):
    path = tmp_path / "map.toml"
    path.write_text(content)
    return parse_map(*read_toml(path))


def imported(tmp_path, files, content=BASE, name="x"):
    files = files if isinstance(files, list) else [files]
    parts = import_files(files, spec(tmp_path, content), name)
    assert len(parts) == 1
    return parts[0].recording, parts[0].notes


def written(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def check_same(recording, values):
    np.testing.assert_array_equal(recording.t_s, values[:, 0] - values[0, 0])
    np.testing.assert_array_equal(recording.measured, values[:, 1:3])
    np.testing.assert_array_equal(recording.key_points_mm[:, 0], values[:, 3:])


FORMATS = {
    "comma": ("a.csv", lambda v: text(v), ""),
    "semicolon": ("a.csv", lambda v: text(v, ";"), 'separator = ";"'),
    "decimal comma": (
        "a.csv",
        lambda v: text(v, ";", decimal=","),
        'separator = ";"\ndecimal = ","',
    ),
    "tabs by name": ("a.tsv", lambda v: text(v, "\t"), ""),
    "white space": ("a.txt", lambda v: "  " + text(v, "   \t"), 'separator = "whitespace"'),
    "blank after comma": ("a.csv", lambda v: text(v, ",  "), ""),
    "CRLF": ("a.csv", lambda v: text(v, end="\r\n"), ""),
    "old Mac": ("a.csv", lambda v: text(v, end="\r"), ""),
    "byte order mark": ("a.csv", lambda v: "\ufeff" + text(v), ""),
    "gz": ("a.csv.gz", lambda v: gzip.compress(text(v).encode()), ""),
    "gz without its ending": ("a.csv", lambda v: gzip.compress(text(v).encode()), ""),
    "bz2": ("a.csv.bz2", lambda v: bz2.compress(text(v).encode()), ""),
    "xz": ("a.csv.xz", lambda v: lzma.compress(text(v).encode()), ""),
    "lines before": ("a.csv", lambda v: text(v, before=["made by", "a, b", ""]), "skip_rows = 3"),
    "comments": (
        "a.csv",
        lambda v: text(v, before=["% one, two"]).replace("\n", "\n% three\n", 5),
        'comment = "%"',
    ),
    "header behind a hash": ("a.csv", lambda v: "# " + text(v), ""),
    "comma at each end": ("a.csv", lambda v: text(v, end=",\n").replace("z,", "z", 1), ""),
    "quotes": ("a.csv", lambda v: text(v, header=[f'"{n}"' for n in NAMES]), ""),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_every_spelling_gives_the_same_numbers(tmp_path, kind):
    name, write, fields = FORMATS[kind]
    values = table()
    path = written(tmp_path / name, write(values))
    check_same(imported(tmp_path, path, f"[file.log]\n{fields}\n{BASE}")[0], values)


@pytest.mark.parametrize("separator", [",", ";", "whitespace"])
@given(seed=st.integers(0, 2**32))
def test_without_header_by_number(tmp_path_factory, separator, seed):
    tmp_path = tmp_path_factory.mktemp("numbers")
    values = table(5, seed)
    between = {"whitespace": "  "}.get(separator, separator)
    path = written(tmp_path / "a.txt", text(values, between, header=None))
    content = f"""
        [file.log]
        header = false
        separator = "{separator}"
        [time]
        column = 1
        [measured]
        columns = [2, 3]
        unit = "psi"
        [key_points]
        positions = [[4, 5, 6]]
        unit = "mm"
    """
    check_same(imported(tmp_path, path, content)[0], values)


def test_parquet_by_name_and_number(tmp_path):
    values = table()
    path = tmp_path / "a.parquet"
    columns = {name: values[:, i] for i, name in enumerate(NAMES)}
    columns["u1"] = columns["u1"].astype(np.float32)
    pq.write_table(pa.table(columns), path)
    values[:, 1] = values[:, 1].astype(np.float32)
    check_same(imported(tmp_path, path)[0], values)
    check_same(imported(tmp_path, path, BASE.replace('"t"', "1").replace('"x"', "4"))[0], values)


def test_recording_itself_can_be_imported(tmp_path):
    """Columns named as in a recording need no list."""
    values = table()
    path = written(tmp_path / "a.csv", text(values, header=["t", "p1_V", "p2_V", "x", "y", "z"]))
    content = BASE.replace('columns = ["u1", "u2"]\nunit = "psi"', "")
    recording, _ = imported(tmp_path, path, content)
    check_same(recording, values)
    assert recording.unit == "V"


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0)])
def test_positions_become_millimetres(tmp_path, unit, factor):
    values = table()
    path = written(tmp_path / "a.csv", text(values))
    recording, _ = imported(tmp_path, path, BASE.replace('"mm"', f'"{unit}"'))
    np.testing.assert_array_equal(recording.key_points_mm[:, 0], values[:, 3:] * factor)


def test_actuation_keeps_its_unit_unless_asked(tmp_path):
    values = table()
    path = written(tmp_path / "a.csv", text(values))
    assert imported(tmp_path, path)[0].unit == "psi"
    asked = BASE.replace('"psi"', '"psi"\nto = "kPa"')
    recording, _ = imported(tmp_path, path, asked)
    # 1 psi = 6.894757 kPa (NIST SP 811, 2008, B.8)
    np.testing.assert_allclose(recording.measured, values[:, 1:3] * 6.894757, rtol=1e-7)
    assert recording.unit == "kPa"
    scaled = BASE.replace('"psi"', '"V"\nscale = [2.0, 3.0]\noffset = 0.5')
    recording, _ = imported(tmp_path, path, scaled)
    np.testing.assert_array_equal(recording.measured, values[:, 1:3] * [2, 3] + 0.5)


@pytest.mark.parametrize(
    ("unit", "factor"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("min", 60.0)]
)
def test_time_becomes_seconds_from_the_start(tmp_path, unit, factor):
    values = table()
    path = written(tmp_path / "a.csv", text(values))
    content = BASE.replace('column = "t"', f'column = "t"\nunit = "{unit}"')
    recording, _ = imported(tmp_path, path, content)
    np.testing.assert_allclose(recording.t_s, (values[:, 0] - values[0, 0]) * factor, rtol=1e-9)
    kept, _ = imported(tmp_path, path, content.replace("unit = ", 'zero = "none"\nunit = ', 1))
    np.testing.assert_array_equal(kept.t_s, values[:, 0] * factor)


def test_dates_become_seconds(tmp_path):
    rows = "2024-02-29T23:59:59.5,1,2,3,4,5\n2024-03-01 00:00:01.25Z,1,2,3,4,5\n"
    path = written(tmp_path / "a.csv", ",".join(NAMES) + "\n" + rows)
    content = BASE.replace('column = "t"', 'column = "t"\nunit = "iso"')
    np.testing.assert_allclose(imported(tmp_path, path, content)[0].t_s, [0, 1.75], atol=1e-6)
    written(path, path.read_text().replace("2024-03-01", "1st of March"))
    with pytest.raises(InputError, match=r"a\.csv, line 3, column 't': got '1st of March"):
        imported(tmp_path, path, content)


def test_nominal_rate_where_there_are_no_time_stamps(tmp_path):
    values = table(5)
    path = written(tmp_path / "a.csv", text(values))
    recording, _ = imported(tmp_path, path, BASE.replace('column = "t"', "rate_hz = 50"))
    np.testing.assert_allclose(recording.t_s, [0, 0.02, 0.04, 0.06, 0.08])


def test_missing_cells_are_missing(tmp_path):
    values = table(4)
    values[1, 3:], values[2, 4] = np.nan, np.nan
    path = written(tmp_path / "a.csv", text(values).replace(repr(float(values[3, 5])), "lost"))
    content = f'[file.log]\nmissing = ["lost"]\n{BASE}'
    recording, _ = imported(tmp_path, path, content)
    lost = np.isnan(recording.key_points_mm[:, 0]).all(axis=1)
    np.testing.assert_array_equal(lost, [False, True, True, True])


def test_rows_without_actuation_are_left_out_and_said(tmp_path):
    values = table(4)
    values[2, 2] = np.nan
    path = written(tmp_path / "a.csv", text(values))
    recording, notes = imported(tmp_path, path)
    np.testing.assert_array_equal(recording.measured, values[[0, 1, 3], 1:3])
    assert notes[1:] == [f"{path}, line 4: actuation missing here, 1 such rows left out"]


def test_line_torn_off_at_the_end_is_left_out_and_said(tmp_path):
    values = table(6)
    path = written(tmp_path / "a.csv", text(values)[:-60])
    recording, notes = imported(tmp_path, path)
    check_same(recording, values[: recording.samples])
    assert recording.samples in (4, 5)
    assert "the last line was cut off" in notes[0]


def test_context_constant_from_a_column_or_from_the_name(tmp_path):
    values = table(3)
    path = written(tmp_path / "run_250g.csv", text(values))
    recording, _ = imported(tmp_path, path, BASE + "[context]\npayload_g = 20\n")
    np.testing.assert_array_equal(recording.payload_g, [20, 20, 20])
    assert recording.temp_C is None
    content = BASE + "[context]\npayload_g = { from_name = '_(\\d+)g' }\ntemp_C = {column = 'u2'}\n"
    recording, _ = imported(tmp_path, path, content)
    np.testing.assert_array_equal(recording.payload_g, [250] * 3)
    np.testing.assert_array_equal(recording.temp_C, values[:, 2])
    other = written(tmp_path / "plain.csv", text(values))
    with pytest.raises(InputError, match=r"plain\.csv: no number for payload_g in the file's name"):
        imported(tmp_path, other, content)
    content = content.replace("_(\\d+)g' }", "_(\\d+)g', otherwise = 0 }")
    assert imported(tmp_path, other, content)[0].payload_g[0] == 0


def test_sidecar_of_the_map_goes_into_the_recording(tmp_path):
    path = written(tmp_path / "a.csv", text(table()))
    recording, _ = imported(
        tmp_path,
        path,
        BASE + "[arm]\nlength_mm = 70\n[gravity]\ndirection = [0, 0, 1]\n"
        "[recording]\nkind = 'settled'\nnoise_mm = 0.1\nnote = 'n'\n",
    )
    assert recording.arm.length_mm == 70
    assert (recording.kind, recording.noise_mm, recording.note) == ("settled", 0.1, "n")
    np.testing.assert_array_equal(recording.gravity, [0, 0, 1])


# --- frames ------------------------------------------------------------------------------------


def arm_in_a_room(seed, rows=60):
    """Three key points of an arm (T, 3, 3) [mm] in its frame, a mount, and the same in the room."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / 20
    bend = 20 * np.sin(t)[:, None] * [0, 0.4, 1.0]
    points = np.stack([bend, 0.3 * bend, np.broadcast_to([0, 40, 80.0], bend.shape)], axis=2)
    mount = Rotation.random(random_state=seed % 2**31)
    return t, points, mount, mount.apply(points.reshape(-1, 3)).reshape(points.shape) + 500, rng


POSE = ["bx", "by", "bz", "qx", "qy", "qz", "qw"]
POSED = """
[time]
column = "t"
[measured]
columns = ["u1"]
unit = "kPa"
[key_points]
positions = [["x0", "y0", "z0"], ["x1", "y1", "z1"], ["x2", "y2", "z2"]]
unit = "mm"
[frame]
gravity = [0, -1, 0]
"""
BODY = """
[frame.base]
position = ["bx", "by", "bz"]
quaternion = ["qx", "qy", "qz", "qw"]
"""


def posed(path, t, room, pose):
    names = ["t", "u1", *(f"{a}{j}" for j in range(3) for a in "xyz"), *POSE]
    columns = [t[:, None], np.ones((len(t), 1)), room.reshape(len(t), 9), pose]
    return written(path, text(np.concatenate(columns, axis=1), header=names))


@pytest.mark.parametrize("mode", ["fixed", "rest", "moving"])
@given(seed=st.integers(0, 2**32))
def test_pose_of_a_base_body_whose_quaternion_flips(tmp_path_factory, mode, seed):
    tmp_path = tmp_path_factory.mktemp("pose")
    t, points, mount, room, rng = arm_in_a_room(seed)
    q = mount.as_quat() * rng.choice([-1, 1], (len(t), 1))
    pose = np.concatenate([np.full((len(t), 3), 500.0), q], axis=1)
    path = posed(tmp_path / "a.csv", t, room, pose)
    recording, _ = imported(tmp_path, path, f'{POSED}{BODY}mode = "{mode}"\n')
    np.testing.assert_allclose(recording.key_points_mm, points, atol=1e-9)
    np.testing.assert_allclose(recording.gravity, mount.inv().apply([0, -1, 0]), atol=1e-12)


def test_moving_base_is_taken_out_row_by_row(tmp_path):
    t, points, _, _, rng = arm_in_a_room(4)
    mounts = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.05, (len(t), 3)), axis=0))
    shifts = np.cumsum(rng.normal(0, 3, (len(t), 3)), axis=0)
    room = np.einsum("tij,tnj->tni", mounts.as_matrix(), points) + shifts[:, None]
    pose = np.concatenate([shifts, mounts.as_quat()], axis=1)
    pose[7, 3:] = 0.0  # the cameras lost the base
    path = posed(tmp_path / "a.csv", t, room, pose)
    recording, _ = imported(tmp_path, path, f'{POSED}{BODY}mode = "moving"\n')
    expected = points.copy()
    expected[7] = np.nan
    np.testing.assert_allclose(recording.key_points_mm, expected, atol=1e-9)


@given(seed=st.integers(0, 2**32))
def test_constant_rotation_and_origin(tmp_path_factory, seed):
    tmp_path = tmp_path_factory.mktemp("matrix")
    t, points, mount, room, _ = arm_in_a_room(seed)
    path = posed(tmp_path / "a.csv", t, room, np.zeros((len(t), 7)))
    rows = mount.inv().as_matrix().tolist()
    frame = f"rotation = {rows}\norigin = [500, 500, 500]\n"
    recording, notes = imported(tmp_path, path, POSED + frame)
    np.testing.assert_allclose(recording.key_points_mm, points, atol=1e-9)
    np.testing.assert_allclose(recording.gravity, mount.inv().apply([0, -1, 0]), atol=1e-12)
    assert notes == []
    quaternion = mount.inv().as_quat().tolist()
    frame = f"rotation = {quaternion}\norigin = [500, 500, 500]\n"
    np.testing.assert_allclose(
        imported(tmp_path, path, POSED + frame)[0].key_points_mm, points, atol=1e-9
    )


@given(seed=st.integers(0, 2**32))
def test_frame_from_the_arm_at_rest(tmp_path_factory, seed):
    """With origin k0 and z along the arm at rest, any mount gives the same up to heading."""
    tmp_path = tmp_path_factory.mktemp("rest")
    t, points, _, room, _ = arm_in_a_room(seed)
    path = posed(tmp_path / "a.csv", t, room, np.zeros((len(t), 7)))
    frame = 'origin = "k0"\nalign_z = "rest"\nrest_rows = 1\n'
    found = imported(tmp_path, path, POSED + frame)[0].key_points_mm
    np.testing.assert_allclose(found[0], points[0], atol=1e-9)
    np.testing.assert_allclose(found[..., 2], points[..., 2], atol=1e-9)
    distances = np.linalg.norm(found[:, None, 2] - found[None, :, 2], axis=2)
    expected = np.linalg.norm(points[:, None, 2] - points[None, :, 2], axis=2)
    np.testing.assert_allclose(distances, expected, atol=1e-9)
    assert np.linalg.det([*found[[20, 40], 2].tolist(), [0, 0, 1]]) == pytest.approx(
        np.linalg.det([*points[[20, 40], 2].tolist(), [0, 0, 1]]), abs=1e-6
    )


def test_arm_that_does_not_point_along_z_is_said(tmp_path):
    t, points, _, _, _ = arm_in_a_room(0)
    path = posed(tmp_path / "a.csv", t, points[..., [2, 0, 1]], np.zeros((len(t), 7)))
    _, notes = imported(tmp_path, path, POSED)
    chord = points[:20, 2].mean(axis=0) - points[:20, 0].mean(axis=0)
    angle = np.degrees(np.arccos(chord[1] / np.linalg.norm(chord)))
    assert f"in the first 20 rows the arm points {angle:.0f} degrees away from z" in notes[0]
    assert angle > 80


def test_point_beside_a_body_turns_with_it(tmp_path):
    """A key point 22 mm along the body's own z axis: position + R(q) offset."""
    t = np.arange(12) / 10
    turns = Rotation.from_rotvec(t[:, None] * [0, 1, 0])
    position = np.stack([t, 2 * t, 3 * t], axis=1)
    q = turns.as_quat()[:, [3, 0, 1, 2]]
    values = np.concatenate([t[:, None], np.ones((12, 1)), position, q], axis=1)
    names = ["t", "u", "x", "y", "z", "qw", "qx", "qy", "qz"]
    path = written(tmp_path / "a.csv", text(values, header=names))
    content = """
        [time]
        column = "t"
        [measured]
        columns = ["u"]
        unit = "kPa"
        [key_points]
        unit = "cm"
        quaternion_order = "wxyz"
        [[key_points.point]]
        position = ["x", "y", "z"]
        [[key_points.point]]
        position = ["x", "y", "z"]
        quaternion = ["qw", "qx", "qy", "qz"]
        offset = [0, 0, 2.2]
    """
    found = imported(tmp_path, path, content)[0].key_points_mm
    np.testing.assert_allclose(found[:, 0], 10 * position)
    along = np.stack([np.sin(t), 0 * t, np.cos(t)], axis=1)
    np.testing.assert_allclose(found[:, 1] - found[:, 0], 22 * along, atol=1e-12)
