"""A real cut as a replay: what is in the file is what is in the log, and it can be seen."""

import colorsys
import io
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from rerun.components import AggregationPolicy
from scipy.spatial.transform import Rotation

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.replay.arms import TIP_MM, joined, turns_from_z
from surgisoft.replay.colours import (
    BLANCHED,
    CHARRED,
    LESION_COLOUR,
    ROLE_COLOURS,
    tissue_colours,
)
from surgisoft.replay.endoscope import PIXELS, camera_entity, cone_entity
from surgisoft.replay.episode_view import (
    episode_blueprint,
    hiding_bodies,
    legend,
    viewpoint,
    write_replay,
)
from surgisoft.replay.plots import plots_of
from surgisoft.replay.surfaces import dosed_surface
from surgisoft.replay.viewer import take_screenshot
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.rays import EmbreeSurface
from surgisoft.scene.render import BODY_COLOURS, LESION_TINT
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.episodes.file import save_episode
from surgisoft.tasks.episodes.log import EpisodeRecorder
from surgisoft.tasks.registry import make_task
from tests.replay.reading import column, entities

STEPS = 46


def recorded(name: str, steps: int, seed: int = 4):
    """The first steps of a scripted episode."""
    task = make_task(name)
    with torch.inference_mode():
        play = Episodes(task, donate=True)
        state = play.seeded(seed, 1)
        recorder = EpisodeRecorder(task, state, policy="scripted", seed=seed)
        for _ in range(steps):
            actions = task.script(state)
            state, outcome = play.step(state, actions)
            recorder.step(state, outcome, actions)
    return recorder.log()


@pytest.fixture(scope="module")
def log():
    return recorded("circle_ablation", STEPS)


@pytest.fixture(scope="module")
def replay(log, tmp_path_factory):
    return write_replay(log, tmp_path_factory.mktemp("replay") / "cut.rrd")


def test_plots_hold_every_step_of_the_log(log, replay):
    for name, arm in log.arms.items():
        for i in range(3):
            held = column(replay.path, f"/plots/pressure/{name}/p{i + 1}", "Scalars:scalars")
            assert list(held) == list(range(log.rows))
            np.testing.assert_allclose(np.ravel([*held.values()]), arm.pressure_kPa[:, i])
    for entity, values in (
        ("clearance/clearance_mm", log.clearance_mm),
        ("share/completion", log.measures["completion"]),
        ("error/beam_error_mm", log.measures["beam_error_mm"]),
        ("reward/laser/aim", log.rewards["laser"]["aim"]),
        ("reward/endoscope/view", log.rewards["endoscope"]["view"]),
    ):
        held = column(replay.path, f"/plots/{entity}", "Scalars:scalars")
        known = np.flatnonzero(np.isfinite(values))
        assert list(held) == known.tolist()
        np.testing.assert_allclose(np.ravel([*held.values()]), values[known])


@pytest.mark.parametrize(
    ("entity", "kept"),
    [
        ("error/beam_error_mm", AggregationPolicy.Max),
        ("clearance/clearance_mm", AggregationPolicy.Min),
        ("pressure/laser/p1", AggregationPolicy.Average),
    ],
)
def test_peaks_of_errors_and_clearances_stay_in_sight(entity, kept, replay):
    """Where several steps share a column of pixels, the viewer would draw their mean."""
    held = column(replay.path, f"/plots/{entity}", "SeriesLines:aggregation_policy")
    assert held == {-1: [kept.value]}


def test_both_timelines_tell_the_same_moment(log, replay):
    entity = "/plots/clearance/clearance_mm"
    seconds = column(replay.path, entity, "Scalars:scalars", "time")
    np.testing.assert_allclose(np.array([*seconds]) * 1e-9, log.time_s, atol=1e-9)


def test_bodies_beam_and_camera_stand_where_the_log_says(log, replay):
    for name, arm in log.arms.items():
        centres = column(replay.path, f"/arms/{name}/body", "InstancePoses3D:translations")
        turns = column(replay.path, f"/arms/{name}/body", "InstancePoses3D:quaternions")
        scales = column(replay.path, f"/arms/{name}/body", "InstancePoses3D:scales")
        assert list(centres) == list(range(log.rows))
        row = STEPS // 2
        axis = Rotation.from_quat(turns[row][-1]).apply([0.0, 0.0, 1.0])
        end = np.array(centres[row][-1]) + (0.5 * scales[row][-1][2] + TIP_MM) * axis
        np.testing.assert_allclose(end, arm.line_mm[row, -1], atol=1e-3)
    beam = column(replay.path, "/beam", "LineStrips3D:strips")
    radii = column(replay.path, "/beam", "LineStrips3D:radii")
    for row in range(log.rows):
        np.testing.assert_allclose(beam[row][0][0], log.arms["laser"].line_mm[row, -1], atol=1e-4)
        np.testing.assert_allclose(beam[row][0][1], log.beam.end_mm[row], atol=1e-4)
        assert (radii[row][0] > 0.2) == log.beam.on[row]
    tips = log.arms["endoscope"].line_mm[:, -1]
    for entity in (camera_entity("endoscope"), cone_entity("endoscope")):
        eyes = column(replay.path, entity, "Transform3D:translation")
        found = np.array([eyes[row][0] for row in range(log.rows)])
        np.testing.assert_allclose(found, tips, atol=1e-4)
    rim = np.array(column(replay.path, cone_entity("endoscope"), "LineStrips3D:strips")[-1][0])
    slope = np.hypot(rim[:, 0], rim[:, 1]) / rim[:, 2]
    np.testing.assert_allclose(slope, np.tan(0.5 * log.camera.fov_rad), rtol=1e-5)
    events = column(replay.path, "/events", "TextLog:text", "time")
    assert len(events) == len({event.time_s for event in log.events})
    assert "lesion in sight" in str(events)


def test_the_real_path_is_drawn_where_the_beam_burnt(log, replay):
    pieces = column(replay.path, "/path/real", "LineStrips3D:strips")
    burning = np.flatnonzero(log.beam.on[1:] & log.beam.on[:-1]) + 1
    assert list(pieces) == burning.tolist()
    for row in burning:
        np.testing.assert_allclose(pieces[row][0], log.beam.end_mm[row - 1 : row + 1], atol=1e-4)


def test_the_organ_is_charred_where_it_was_burnt(log, replay):
    entity = f"/bodies/{log.dose.body}/dose"
    vertices = np.array(column(replay.path, entity, "Mesh3D:vertex_positions")[-1])
    vertices = vertices.reshape(-1, 3)
    colours = column(replay.path, entity, "Mesh3D:vertex_colors")
    rows = sorted(colours)
    assert rows[0] == 0
    assert 3 <= len(rows) <= 12  # only moments at which something changed

    def red(row):
        return np.array(colours[row], dtype=np.uint32) >> 24

    untouched, tinted = ROLE_COLOURS["organ"][0], LESION_COLOUR[0]
    assert set(red(0)) == {untouched, int(untouched + LESION_TINT * (tinted - untouched))}
    middle = log.path_mm.mean(axis=0)
    inside = np.linalg.norm(vertices - middle, axis=1) < 8.5
    assert set(red(0)[inside]) == {max(red(0))}
    assert set(red(0)[np.linalg.norm(vertices - middle, axis=1) > 12.0]) == {untouched}
    last, dose = rows[-1], log.dose
    burnt = dose.points_mm[dose.at(last) > 2.0 * dose.threshold_j_per_mm2]
    assert len(burnt) > 20
    away = np.linalg.norm(vertices[:, None] - burnt[None], axis=2).min(axis=1)
    dark = red(last) == CHARRED[0]
    assert dark[away < 0.1].mean() > 0.9
    assert not dark[away > 1.0].any()


def test_fine_triangles_are_the_faces_that_they_replace(log):
    body = next(body for body in log.bodies if body.name == log.dose.body)
    mesh = Mesh(body.vertices_mm, body.faces)
    surface = dosed_surface(mesh, log.dose)
    fine = Mesh(surface.vertices_mm, surface.faces)
    whole = mesh.face_areas_mm2[surface.replaced].sum()
    assert fine.face_areas_mm2.sum() == pytest.approx(whole, rel=1e-6)
    facing = np.einsum("fk,fk->f", fine.face_normals, surface.normals[surface.faces].mean(axis=1))
    assert np.all(facing > 0.0)
    even = surface.heat(np.full(len(log.dose.points_mm), 3.0), 1.5)
    assert set(np.round(even, 9)) == {0.0, 2.0}
    start = surface.vertices_mm[::97] + 0.5 * surface.normals[::97]
    distance, face = EmbreeSurface(mesh).first_hit(start, -surface.normals[::97], 2.0)
    assert np.all(face >= 0)
    np.testing.assert_allclose(distance, 0.5, atol=0.02)


def test_endoscope_pictures_are_few_and_show_the_organ(log, replay):
    files = column(replay.path, "/endoscope/camera/picture", "EncodedImage:blob")
    assert 2.0 <= len(files) / log.time_s[-1] <= 3.0
    picture = Image.open(io.BytesIO(bytes(files[max(files)][0])))
    assert picture.size == (PIXELS, PIXELS)
    red, green, _ = np.moveaxis(np.asarray(picture).astype(int), -1, 0)
    assert ((red > 60) & (red > 1.5 * green)).mean() > 0.2
    assert red[0, 0] < 10  # the corners of the round picture are black


def test_a_replay_is_small(replay):
    # The meshes count once; what comes on top a minute is less than 5 MB.
    assert replay.megabytes < 1.6 + 5.0 * replay.duration_s / 60.0
    assert "MB a minute" in str(replay)


def test_an_arm_alone_has_no_scene_in_its_replay(tmp_path):
    log = recorded("track_square", 36)
    replay = write_replay(log, tmp_path / "square.rrd")
    found = entities(replay.path)
    assert {"/arms/arm/body", "/path/planned", "/path/real", "/plots/reward/arm/track"} <= found
    assert not any(name.startswith(("/beam", "/bodies", "/endoscope")) for name in found)
    target = column(replay.path, "/path/target", "Points3D:positions")
    held = np.array([target[row][0] for row in range(log.rows)])
    np.testing.assert_allclose(held, log.target_mm, atol=1e-4)


def test_bent_tubes_have_no_gaps():
    """Points just inside the skin of an arc's torus lie in one of its cylinders."""
    angle, radius, bend = np.linspace(0.0, 1.2, 21), 7.5, 60.0
    zero = 0.0 * angle
    line = bend * np.stack((1.0 - np.cos(angle), zero, np.sin(angle)), axis=1)
    middles, axes, lengths = (x[0] for x in joined(line[None], radius))
    for at in np.linspace(0.05, 1.15, 301):
        out = np.array([-np.cos(at), 0.0, np.sin(at)])
        centre = bend * np.array([1.0 - np.cos(at), 0.0, np.sin(at)])
        for side in (-1.0, 1.0):
            point = centre + side * 0.985 * radius * out
            along = np.einsum("ck,ck->c", point - middles, axes)
            off = np.linalg.norm(point - middles - along[:, None] * axes, axis=1)
            assert ((np.abs(along) <= 0.5 * lengths + 1e-9) & (off <= radius)).any()
    start = middles[0] - 0.5 * lengths[0] * axes[0]
    end = middles[-1] + 0.5 * lengths[-1] * axes[-1]
    np.testing.assert_allclose((start, end), (line[0], line[-1]), atol=1e-9)


def test_turns_bring_the_z_axis_onto_each_axis():
    axes = np.random.default_rng(0).normal(size=(200, 3))
    axes = np.vstack((axes / np.linalg.norm(axes, axis=1)[:, None], [[0, 0, -1], [0, 0, 1]]))
    turned = Rotation.from_quat(turns_from_z(axes)).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(turned, axes, atol=1e-5)


def test_tissue_pales_then_chars():
    colours = tissue_colours(np.array([0.0, 0.999999, 1.0, 9.0]), (100, 50, 40))
    np.testing.assert_array_equal(colours[0], (100, 50, 40, 255))
    np.testing.assert_allclose(colours[1, :3], BLANCHED, atol=1)
    np.testing.assert_array_equal(colours[2:, :3], (CHARRED, CHARRED))


def test_the_replay_can_be_seen(log, replay, tmp_path):
    """Rendered by the native viewer; the scene shows liver, arms, ring and beam."""
    picture = tmp_path / "scene.png"
    try:
        end = ("time", float(log.time_s[-1]))
        take_screenshot(replay.path, picture, "Scene", end, wait_s=0.5)
    except InputError as error:
        if "mesa-vulkan-drivers" in str(error):
            pytest.skip(f"no driver to draw with: {error}")
        raise
    image = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    red, green, blue = np.moveaxis(image, -1, 0)
    liver = (red > 50) & (red > 1.7 * green) & (red > 1.7 * blue)
    silicone = (red > 120) & (np.abs(red - green) < 40) & (blue < green)
    endoscope = (blue > 90) & (blue > 1.25 * red) & (blue > 1.05 * green)
    beam = (green > 150) & (green > 1.5 * red) & (green > 1.3 * blue)
    assert 0.1 < liver.mean() < 0.6
    assert silicone.mean() > 0.02
    assert endoscope.mean() > 0.02
    assert beam.mean() > 1e-4
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 1000


def test_the_command_finds_the_newest_and_says_what_is_wrong(log, replay, tmp_path, capsys):
    def told(*arguments):
        assert run(["replay", *map(str, arguments)]) == 2
        return capsys.readouterr().err

    run_folder = tmp_path / "run"
    assert "no such file or folder" in told(run_folder)
    (run_folder / "replays").mkdir(parents=True)
    assert "holds no replay" in told(run_folder)
    other = tmp_path / "notes.txt"
    other.write_text("x")
    assert "expected a replay" in told(other)
    (tmp_path / "false.rrd").write_text("nothing")
    assert "is not a Rerun recording" in told(tmp_path / "false.rrd")
    assert "expected WIDTHxHEIGHT" in told(replay.path, "--size", "big")
    assert "at most one" in told(replay.path, "--web", "--screenshot", tmp_path / "a.png")
    assert "give --screenshot" in told(replay.path, "--time", "3")
    assert "give --screenshot" in told(replay.path, "--size", "800x600")
    picture = tmp_path / "a.png"
    assert "expected 0 to 4.6 s" in told(replay.path, "--screenshot", picture, "--time", "99")
    assert "replay already" in told(replay.path, "--save", tmp_path / "b.rrd")
    assert not list(tmp_path.glob("a.png"))


def test_an_unknown_view_is_refused_before_the_replay_is_made(log, replay, tmp_path, capsys):
    save_episode(log, tmp_path / "log.npz")
    for path in (replay.path, tmp_path / "log.npz"):
        began = time.perf_counter()
        wish = ["--screenshot", str(tmp_path / "a.png"), "--view", "Nope"]
        assert run(["replay", str(path), *wish]) == 2
        assert time.perf_counter() - began < 5.0
        error = capsys.readouterr().err
        assert "unknown view 'Nope'" in error
        assert all(name in error for name in ("Scene", "Endoscope", "Clearance (mm)", "Events"))


@pytest.mark.parametrize("role", ["organ", "keep-out"])
def test_a_role_has_one_hue_in_the_3d_view_and_in_the_endoscope(role):
    """The picture's colours are linear and lit by a lamp, so only the hues can agree."""
    linear = np.array(ROLE_COLOURS[role]) / 255.0
    hue_3d = colorsys.rgb_to_hsv(*linear**2.2)[0]
    hue_endoscope = colorsys.rgb_to_hsv(*BODY_COLOURS[role])[0]
    assert hue_endoscope == pytest.approx(hue_3d, abs=0.03)


def test_a_log_becomes_a_replay_by_command(tmp_path, capsys):
    path = tmp_path / "log.npz"
    log = recorded("laser_plane", 8)
    save_episode(log, path)
    began = time.perf_counter()
    assert run(["replay", str(path), "--save", str(tmp_path / "log.rrd")]) == 0
    assert time.perf_counter() - began < 20.0
    assert "MB a minute" in capsys.readouterr().out
    assert "/arms/arm/key_points" in entities(tmp_path / "log.rrd")
    beam = column(tmp_path / "log.rrd", "/beam", "LineStrips3D:strips")
    ends = np.stack((log.arms["arm"].line_mm[:, -1], log.actual_mm), axis=1)
    for row in range(log.rows):
        np.testing.assert_allclose(beam[row][0], ends[row], atol=1e-4)
    assert np.ptp(ends[:, 1, 2]) < 1e-3  # the plane is level
    assert "beam from the tip to the plane" in legend(log)
    assert "green" not in legend(recorded("track_circle", 3))


def test_a_legend_names_only_the_colours_that_are_drawn(log, replay):
    (text,) = column(replay.path, "/legend", "TextDocument:text")[-1]
    assert "beam; thick" in text
    assert "olive green" in text
    assert log.events[-1].text in text
    (scale,) = column(replay.path, "/dose_scale", "EncodedImage:blob")[-1]
    assert bytes(scale).startswith(b"\x89PNG")
    assert "white points" not in text
    lone = legend(replace(log, beams={}, cameras={}, dose=None, bodies=(), on="rig"))
    assert "green line" not in lone
    assert "white points" in lone


def test_the_plot_of_shares_is_named_by_what_is_in_it(log):
    titles = [plot.title for plot in plots_of(log)]
    assert "Done, in sight (share)" in titles
    done = {name: each for name, each in log.measures.items() if name != "view_fraction"}
    titles = [plot.title for plot in plots_of(replace(log, measures=done))]
    assert "Done (share)" in titles


def test_a_row_is_as_high_as_its_legends_need(log):
    """Six pressures and commands of an arm; the rewards of two agents fit beside each other."""
    plots = plots_of(log)
    (_, right) = episode_blueprint(log, plots).root_container.contents
    picture, pressures, shares, last = right.row_shares
    assert (picture, shares) == (1.5, 1.0)
    assert 1.2 <= pressures < 1.5
    assert last >= 1.0
    rewards = [plot.title for plot in plots if plot.group]
    assert rewards == ["Reward: laser", "Reward: endoscope"]
    chambers = replace(log.arms["laser"], pressure_kPa=np.zeros((log.rows, 6)),
                       command_kPa=np.zeros((log.rows, 6)))  # fmt: skip
    many = replace(log, arms={**log.arms, "laser": chambers})
    (_, right) = episode_blueprint(many, plots_of(many)).root_container.contents
    assert right.row_shares[1] > pressures


def test_pressure_lines_are_named(log):
    (laser,) = (plot for plot in plots_of(log) if plot.title == "Pressure of laser (kPa)")
    assert laser.legend
    by_entity = sorted(laser.lines, key=lambda line: line.entity)
    names = [line.name for line in by_entity]
    assert names == [f"{what} {i}" for what in ("chamber", "command") for i in (1, 2, 3)]


def test_a_wall_in_front_of_the_work_is_see_through(log, tmp_path):
    """A plate half-way between eye and lesion hides the work; one behind the lesion does not."""
    assert hiding_bodies(log) == []
    eye, _ = viewpoint(log)
    middle = np.concatenate(log.paths_mm).mean(axis=0)
    across = np.linalg.svd((middle - eye)[None])[2][1:]  # two directions at right angles to it
    corners = 60.0 * np.array(
        [-across[0] - across[1], across[0] - across[1], across[0] + across[1]]
    )
    faces = np.array([[0, 1, 2]])

    def plate(name, share):
        at = eye + share * (middle - eye) + corners
        return replace(log.bodies[0], name=name, role="keep-out", vertices_mm=at, faces=faces)

    walled = replace(log, bodies=(*log.bodies, plate("wall", 0.5), plate("table", 1.5)))
    assert hiding_bodies(walled) == ["wall"]
    assert "see-through**: wall" in legend(walled)
    assert "see-through" not in legend(log)
    written = write_replay(replace(walled, cameras={}), tmp_path / "walled.rrd")
    opacity = {
        name: column(written.path, f"/bodies/{name}", "Mesh3D:albedo_factor")[-1][0] & 255
        for name in ("wall", "table")
    }
    assert opacity["table"] == 255
    assert opacity["wall"] < 128
