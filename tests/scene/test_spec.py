"""The scene file: exact round trips, and a one-line error for every bad field."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.scene.mesh import ROLES
from surgisoft.scene.spec import (
    FILE,
    TOOLS,
    BodySpec,
    CameraSpec,
    LaserSpec,
    LesionSpec,
    LimitsSpec,
    MountSpec,
    SceneSpec,
    load_spec,
    save_spec,
)

NAMES = st.from_regex(r"[A-Za-z0-9_-]{1,12}", fullmatch=True)
TEXT = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=40)


def numbers(low, high, **more):
    return st.floats(low, high, allow_nan=False, allow_infinity=False, **more)


def threes(of):
    return st.tuples(of, of, of)


LENGTHS = numbers(0.0, 1e4, exclude_min=True)
POINTS = threes(numbers(-1e6, 1e6))
ANGLES = numbers(-360.0, 360.0)
RANGES = st.tuples(numbers(0, 5e3), numbers(5.001e3, 1e4))
DIRECTIONS = threes(numbers(-1e3, 1e3)).filter(lambda d: np.linalg.norm(d) > 1e-5)


@st.composite
def specs(draw):
    names = draw(st.lists(NAMES, min_size=1, max_size=4, unique=True))
    roles = ["organ", *(draw(st.sampled_from(ROLES)) for _ in names[1:])]
    bodies = tuple(
        BodySpec(name, f"meshes/{name}.ply", role, draw(POINTS), draw(threes(ANGLES)))
        for name, role in zip(names, roles, strict=True)
    )
    path = draw(st.lists(POINTS, min_size=3, max_size=5) | st.just([]))
    mounts = tuple(
        MountSpec(
            tool,
            draw(POINTS),
            draw(DIRECTIONS),
            draw(ANGLES),
            draw(st.sampled_from(["default", "models/arm"])),
            draw(LENGTHS),
            draw(LENGTHS),
            draw(numbers(0, 1e4)),
            draw(st.sampled_from(["", f"arm-{i}"])),
        )
        for i, tool in enumerate(draw(st.lists(st.sampled_from(TOOLS), min_size=1, max_size=4)))
    )
    return SceneSpec(
        draw(NAMES),
        bodies,
        LesionSpec(names[0], draw(POINTS), draw(LENGTHS), tuple(path)),
        mounts,
        LaserSpec(
            draw(numbers(0, 1e4)),
            draw(LENGTHS),
            draw(numbers(100, 20000)),
            draw(numbers(0, 1e5, exclude_min=True)),
            draw(RANGES),
            draw(numbers(0, 89)),
        ),
        CameraSpec(draw(numbers(1, 179)), draw(RANGES)),
        LimitsSpec(
            draw(numbers(0, 1e4)), draw(numbers(0, 1e6, exclude_min=True)), draw(numbers(0, 1))
        ),
        draw(TEXT),
    )


def plain() -> SceneSpec:
    return SceneSpec(
        "plain",
        (BodySpec("liver", "liver.ply", "organ"), BodySpec("bone", "bone.ply", "keep-out")),
        LesionSpec("liver", (1.0, 2.0, 3.0)),
        (
            MountSpec("laser", (0.0, 0.0, 100.0), (0.0, 0.0, -1.0)),
            MountSpec("endoscope", (50.0, 0.0, 100.0), (0.0, 0.0, -1.0)),
        ),
    )


@given(spec=specs())
def test_load_save_load_is_exact(spec, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    save_spec(spec, folder / FILE)
    assert load_spec(folder) == spec
    first = (folder / FILE).read_bytes()
    save_spec(load_spec(folder / FILE), folder / FILE)
    assert (folder / FILE).read_bytes() == first
    assert [path.name for path in folder.iterdir()] == [FILE]


BAD = [
    # field, what stands there, replaced by, what the line says
    ("bodies[0].role", 'role = "organ"', 'role = "liver"', "one of organ, keep-out, support"),
    ("bodies[0].mesh", '"liver.ply"', '"../liver.ply"', "inside the scene's folder"),
    ("bodies[0].mesh", '"liver.ply"', '"/tmp/liver.ply"', "inside the scene's folder"),
    ("bodies[0].name", 'name = "liver"', 'name = "my liver"', "letters, digits"),
    ("bodies[1].name", 'name = "bone"', 'name = "liver"', "names that differ"),
    ("bodies[0].position_mm", "position_mm = [0.0, 0.0, 0.0]", "position_mm = [0.0, 0.0]", "[x, y"),
    ("bodies[0].rotation_deg[1]", "[0.0, 0.0, 0.0]\n\n", "[0.0, 999.0, 0.0]\n\n", "-360 to 360"),
    ("lesion.body", 'body = "liver"', 'body = "bone"', "one of the organs: liver"),
    ("lesion.centre_mm[2]", "[1.0, 2.0, 3.0]", '[1.0, 2.0, "top"]', "mm"),
    ("lesion.diameter_mm", "diameter_mm = 20.0", "diameter_mm = -20", "above 0 mm"),
    ("lesion.diameter_mm", "diameter_mm = 20.0", "diameter_mm = nan", "finite number"),
    ("lesion.path_mm", "path_mm = []", "path_mm = [[0, 0, 0]]", "at least 3"),
    ("mounts[1].name", 'name = ""\n\n[laser]', 'name = "laser"\n\n[laser]', "names that differ"),
    ("mounts[1].name", 'name = ""\n\n[laser]', 'name = "a b"\n\n[laser]', "letters, digits"),
    ("mounts[1].tool", 'tool = "endoscope"', 'tool = "knife"', "one of laser, endoscope, tip"),
    ("mounts[0].direction", "[0.0, 0.0, -1.0]", "[0.0, 0.0, 0.0]", "not all zero"),
    ("mounts[0].length_mm", "length_mm = 70.0", "length_mm = true", "above 0 mm"),
    ("mounts[0].arm", 'arm = "default"', 'arm = ""', "arm model"),
    ("laser.power_w", "power_w = 20.0", 'power_w = "20 W"', "0 to 10000 W"),
    ("laser.powr_w", "power_w", "powr_w", "did you mean 'power_w'"),
    ("laser.standoff_mm", "[20.0, 60.0]", "[60.0, 20.0]", "rising"),
    ("laser.absorption_per_mm", "absorption_per_mm = 9.0", "absorption_per_mm = 0", "above 0 1/mm"),
    ("camera.fov_deg", "fov_deg = 70.0", "fov_deg = 180.0", "1 to 179 degrees"),
    ("limits.view_fraction", "view_fraction = 0.95", "view_fraction = 95", "0 to 1"),
    ("limits.time_s", "time_s = 60.0", "time_s = inf", "finite"),
    ("laser", "[laser]", "[lasser]", "one of name, bodies"),
    ("format", "format = 1", "format = 7", "expected 1"),
    ("lesion.centre_mm", "centre_mm = [1.0, 2.0, 3.0]\n", "", "missing"),
]


@pytest.mark.parametrize(("field", "there", "put", "says"), BAD)
def test_a_bad_field_is_one_line(field, there, put, says, tmp_path):
    save_spec(plain(), tmp_path / FILE)
    text = (tmp_path / FILE).read_text()
    assert there in text
    (tmp_path / FILE).write_text(text.replace(there, put, 1))
    with pytest.raises(InputError) as caught:
        load_spec(tmp_path)
    message = str(caught.value)
    assert "\n" not in message
    assert says in message
    assert str(tmp_path / FILE) in message
    assert field.split("[")[0].split(".")[0] in message
    if field != "laser":
        assert f": {field}: " in message


def test_contours_can_be_appended_to_a_written_file(tmp_path):
    file = tmp_path / FILE
    save_spec(plain(), file)
    assert "contours" not in file.read_text()
    with file.open("a") as text:
        text.write('\n[[contours]]\nname = "c"\ncentre_mm = [1.0, 2.0, 3.0]\n')
    (contour,) = load_spec(file).contours
    assert (contour.name, contour.centre_mm) == ("c", (1.0, 2.0, 3.0))
    save_spec(load_spec(file), file)
    assert load_spec(file).contours == (contour,)


def test_a_table_after_an_empty_list_of_that_name_says_which_line_to_delete(tmp_path):
    """Files of earlier versions have the line."""
    file = tmp_path / FILE
    file.write_text('name = "s"\ncontours = []\n\n[[contours]]\nname = "c"\n')
    with pytest.raises(InputError, match=r"toml:4: .*'contours' after a line 'contours = \.\.\.'"):
        load_spec(file)


def test_the_line_number_is_the_fields_own(tmp_path):
    save_spec(plain(), tmp_path / FILE)
    lines = (tmp_path / FILE).read_text().splitlines()
    number = max(i for i, line in enumerate(lines, 1) if line.startswith("roll_deg"))
    lines[number - 1] = 'roll_deg = "left"'
    (tmp_path / FILE).write_text("\n".join(lines))
    with pytest.raises(InputError, match=rf"{FILE}:{number}: mounts\[1\].roll_deg: "):
        load_spec(tmp_path)


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"name = ", "not valid TOML"), (b"\xff\xfe", "UTF-8"), (b"", "name: missing")],
)
def test_a_broken_file_is_one_line(content, says, tmp_path):
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(InputError, match=says):
        load_spec(tmp_path)


def test_what_is_not_there_is_said(tmp_path):
    with pytest.raises(InputError, match=r"holds no scene\.toml"):
        load_spec(tmp_path)
    with pytest.raises(InputError, match="no such scene"):
        load_spec(tmp_path / "nowhere")


def test_a_spec_that_would_not_load_is_not_written(tmp_path):
    bad = dataclasses.replace(plain(), lesion=LesionSpec("bone", (0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match=r"lesion\.body"):
        save_spec(bad, tmp_path / FILE)
    assert list(tmp_path.iterdir()) == []


def test_mount_points_along_its_direction_and_rolls_about_it():
    mount = MountSpec("laser", (1.0, 2.0, 3.0), (0.0, 0.0, -2.0), roll_deg=90.0)
    pose = mount.pose()
    np.testing.assert_allclose(pose[:3, 2], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3])
    # unrolled, x lies along the world's x; a quarter turn about -z takes it to -y
    np.testing.assert_allclose(pose[:3, 0], [0, -1, 0], atol=1e-15)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


def test_body_turns_about_x_then_y_then_z():
    body = BodySpec("a", "a.ply", "organ", (10.0, 0.0, 0.0), (90.0, 0.0, 90.0))
    # about x: y goes to z; about z after that: z stays, x goes to y
    np.testing.assert_allclose(body.pose() @ [0, 1, 0, 1], [10, 0, 1, 1], atol=1e-12)
    np.testing.assert_allclose(body.pose() @ [1, 0, 0, 1], [10, 1, 0, 1], atol=1e-12)


def test_camera_is_handed_on_in_radians():
    assert CameraSpec(fov_deg=60.0).camera().fov_rad == pytest.approx(math.pi / 3)


def test_the_manual_names_every_field_with_its_default():
    manual = (Path(__file__).resolve().parents[2] / "docs" / "scenes.md").read_text()
    for kind in (BodySpec, LesionSpec, MountSpec, LaserSpec, CameraSpec, LimitsSpec):
        for field in dataclasses.fields(kind):
            default = field.default
            if default is dataclasses.MISSING:
                assert f"| `{field.name}` | | " in manual
            else:
                written = json.dumps(list(default) if isinstance(default, tuple) else default)
                assert f"| `{field.name}` | `{written}` | " in manual
