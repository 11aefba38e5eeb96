"""What is drawn of a scene: tubes of the right size, the recording's content, a picture of it."""

import contextlib
import html
import re
import socket
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.replay.reach_map import check_map
from surgisoft.replay.shapes import carried_frames, finer, polar_patch, tube, view_cone
from surgisoft.replay.show import open_replay
from surgisoft.replay.viewer import (
    check_picture,
    free_port,
    serve_viewer,
    take_screenshot,
    web_address,
)
from surgisoft.scene.folder import open_scene
from surgisoft.scene.mesh import Mesh
from tests.replay.reading import column

PHANTOM = Path(__file__).resolve().parents[2] / "scenes" / "phantom_liver"


def arc(bend, count=40, length=70.0):
    s = np.linspace(0.0, 1.0, count)
    radius = length / bend
    return np.stack((radius * (1 - np.cos(bend * s)), 0 * s, radius * np.sin(bend * s)), axis=1)


@given(bend=st.floats(0.05, 1.5), radius=st.floats(2.0, 8.0))
def test_a_tube_has_the_volume_that_pappus_gives(bend, radius):
    vertices, faces, normals = tube(arc(bend), radius, sides=80)
    body = 2.0 * np.pi / 80
    area = 0.5 * 80 * radius**2 * np.sin(body)  # of the polygon
    bevel = np.pi * radius * (0.12 * radius) ** 2  # a triangle's section once around the tip
    mesh = Mesh(vertices, faces)
    # the holes at the two tips of its caps are points: the divergence theorem holds
    assert mesh.volume_mm3 == pytest.approx(area * 70.0 - bevel, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    facing = np.einsum("fk,fk->f", mesh.face_normals, normals[faces].mean(axis=1))
    assert np.all(facing[mesh.face_areas_mm2 > 1e-3] > 0.0)


@given(bend=st.floats(0.05, 3.0), turn=st.floats(0.0, 6.0))
def test_frames_are_carried_without_twist(bend, turn):
    """Along a plane arc the frame turns about the plane's normal only."""
    spin = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    frames = carried_frames(arc(bend, 200) @ spin.T)
    normal = spin @ [0.0, 1.0, 0.0]
    shares = frames.swapaxes(1, 2) @ normal
    np.testing.assert_allclose(shares, np.tile(shares[0], (200, 1)), atol=2e-3)
    np.testing.assert_allclose(
        frames @ frames.swapaxes(1, 2), np.tile(np.eye(3), (200, 1, 1)), atol=1e-9
    )


def test_a_polar_patch_covers_the_disc():
    around = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = np.stack((np.cos(around), np.sin(around), 0 * around), axis=1)
    vertices, faces = polar_patch([3.0 * circle, 7.0 * circle, 10.0 * circle], np.zeros(3))
    mesh = Mesh(vertices, faces)
    assert mesh.face_areas_mm2.sum() == pytest.approx(0.5 * 60 * 100.0 * np.sin(2 * np.pi / 60))
    np.testing.assert_allclose(mesh.face_normals, [[0, 0, 1.0]] * len(faces), atol=1e-12)


def test_a_view_cone_opens_by_the_field_of_view():
    rim, *edges = view_cone(np.array([1.0, 2.0, 3.0]), np.array([0.0, 3.0, 0.0]), 0.6, 40.0)
    away = rim - [1.0, 2.0, 3.0]
    np.testing.assert_allclose(away[:, 1], 40.0)
    np.testing.assert_allclose(np.hypot(away[:, 0], away[:, 2]), 40.0 * np.tan(0.6))
    assert len(edges) == 8
    assert finer(rim, 1.0).shape[0] > len(rim)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "scene.rrd"
    assert run(["scene", "show", str(PHANTOM), "--save", str(path)]) == 0
    return path


def test_the_legend_names_what_is_there_and_the_bar_has_its_length(recording):
    (text,) = column(recording, "/legend", "TextDocument:text")[-1]
    for words in ("phantom_liver", "red-brown**: organ: liver", "yellow**: the ring of 20 mm"):
        assert words in text
    assert "tip" not in text, "no arm has none of the other tools"
    (label,) = column(recording, "/scale_bar", "LineStrips3D:labels")[-1]
    ((start, end),) = column(recording, "/scale_bar", "LineStrips3D:strips")[-1]
    assert label == f"{np.linalg.norm(np.subtract(end, start)):g} mm"


def test_each_arm_carries_its_name_on_the_shaft_near_its_base(recording):
    for mount in open_scene(PHANTOM).spec.mounts:
        (label,) = column(recording, f"/arms/{mount.tool}/name", "Points3D:labels")[-1]
        assert label == mount.tool
        (place,) = column(recording, f"/arms/{mount.tool}/name", "Points3D:positions")[-1]
        back = np.subtract(mount.position_mm, place)  # mm, along the axis of the shaft
        assert 0.5 * mount.diameter_mm < back @ mount.direction < 0.5 * mount.shaft_mm
        np.testing.assert_allclose(np.cross(back, mount.direction), 0.0, atol=1e-3)


def test_the_recording_holds_the_whole_scene(recording):
    rows: dict[str, int] = {}
    for chunk in RrdReader(recording).stream():
        path = str(chunk.entity_path)
        rows[path] = rows.get(path, 0) + chunk.num_rows
    scene = open_scene(PHANTOM)
    for name in (body.name for body in scene.bodies):
        assert rows[f"/bodies/{name}"] == 1
    for name in ("/lesion/ring", "/lesion/tissue", "/arms/endoscope/body", "/arms/laser/shaft"):
        assert rows[name] == 1
    assert rows["/arms/laser/body"] == rows["/beam"] == rows["/beam/hit"] == 72
    assert recording.stat().st_size < 6e6


def test_the_beam_goes_from_the_tip_round_the_ring(recording):
    ends = [
        np.array(point[0])
        for chunk in RrdReader(recording).stream().filter(content="/beam/hit")
        for point in chunk.to_record_batch().column("Points3D:positions").to_pylist()
    ]
    np.testing.assert_allclose(np.array(ends), open_scene(PHANTOM).ring.points_mm, atol=0.05)


def _processes_that_name(path):
    """Command lines of running processes that name the file; none where there is no /proc."""
    lines = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            lines.append(process.read_bytes())
    return [line for line in lines if str(path).encode() in line]


def test_a_picture_without_a_display_shows_the_liver(recording, tmp_path):
    picture = tmp_path / "scene.png"
    try:
        take_screenshot(recording, picture, "Scene", ("ring_point", 0))
    except InputError as error:
        if "mesa-vulkan-drivers" in str(error):
            pytest.skip(f"no driver to draw with: {error}")
        raise
    from PIL import Image

    image = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    red, green, blue = np.moveaxis(image, -1, 0)
    liver = (red > 60) & (red > 1.7 * green) & (red > 1.7 * blue)
    yellow = (red > 200) & (green > 160) & (blue < 120)
    assert 0.04 < liver.mean() < 0.5
    assert yellow.mean() > 2e-4  # the ring
    assert image.shape[1] >= 1000
    assert not _processes_that_name(recording)


def test_what_cannot_be_drawn_to_is_one_line(recording, tmp_path):
    with pytest.raises(InputError, match=r"expected \.png"):
        take_screenshot(recording, tmp_path / "scene.jpg")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is not a writable folder"):
        take_screenshot(recording, tmp_path / "file" / "scene.png")
    assert run(["scene", "show", str(PHANTOM), "--save", str(tmp_path / "scene.txt")]) == 2


def test_the_folder_of_a_picture_is_made(tmp_path):
    """As that of every other file that is written."""
    check_picture(tmp_path / "new" / "scene.png")
    check_map(open_scene(PHANTOM), tmp_path / "new" / "map.png")
    for check in (check_picture, lambda path: check_map(open_scene(PHANTOM), path)):
        with pytest.raises(InputError, match="is not a writable folder"):
            check(Path("/dev/null/scene.png"))


def test_only_this_machine_is_served():
    assert web_address(9090, 9876).startswith(
        "http://127.0.0.1:9090/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1"
    )


def test_the_page_is_served_on_the_given_port(recording):
    """The page answers on the port and the data on the next one, until the command ends."""
    port = free_port()
    told, answers = [], []

    def look(url):
        told.append(url)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20) as page:
            answers.append(page.status)
        with socket.create_connection(("127.0.0.1", port + 1), 5.0):
            answers.append("data")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        serve_viewer(recording, look, port)
    assert told == [web_address(port, port + 1)]
    assert answers == [200, "data"]


def test_a_notebook_shows_the_viewer_in_a_frame_until_it_is_closed(recording):
    port = free_port()
    frame = open_replay(recording, notebook=True, port=port, size="900x500")
    try:
        shown = html.unescape(re.search(r'<iframe src="([^"]+)"', frame._repr_html_())[1])
        assert shown == web_address(port, port + 1)
        assert "height: 500px" in frame._repr_html_()
        with urllib.request.urlopen(shown, timeout=20) as page:
            assert page.status == 200
    finally:
        frame.close()
    with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port), 1.0):
        pass


def test_a_port_in_use_is_one_line(recording):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port}: cannot be used"):
            serve_viewer(recording, print, port)
    with pytest.raises(InputError, match="give --web too"):
        open_replay(recording, port=9000)
