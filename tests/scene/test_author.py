"""From mesh files to scenes: new scenes pass the check by FCL, impossible ones give a reason."""

import dataclasses
import os
import re

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.replay.reach_map import REASON_COLOURS, draw_reach_map
from surgisoft.scene import frames, mounts
from surgisoft.scene.author import (
    UP,
    Request,
    check_target,
    choose_sites,
    prepare,
    rounded_mount,
    write_scene,
)
from surgisoft.scene.camera import view
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.check import (
    REASONS,
    Finding,
    SceneCheck,
    check_scene,
    mounted_arms,
    reach_patch,
    sentence,
)
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.folder import open_scene
from surgisoft.scene.lesion import nearest_on_surface
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.meshio import write_ply
from surgisoft.scene.spec import FILE, ContourSpec, LesionSpec, MountSpec, save_spec
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature
from surgisoft.tasks.world.arm import Pneumatics, Randomisation
from surgisoft.tasks.world.authoring import make_scene
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.reach import blank_mounts, reach_of, reaches_of
from surgisoft.tasks.world.world import WorldConfig, scene_world, single_arm_world
from tests.scene.shapes import ball, box, lumpy


def moved(mesh, *shift):
    return Mesh(mesh.vertices_mm + np.array(shift), mesh.faces)


def new(folder, *arguments):
    return run(["scene", "new", *map(str, arguments), "-o", str(folder)])


@pytest.fixture(scope="module", autouse=True)
def few_mounts():
    """Of each arm a quarter of the mounts are tried: tests/scene/test_arms.py tries them all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mounts, "MOST_EVALUATED", 60)
        patch.setattr(mounts, "TRIES", 15)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A lumpy organ in metres, inside out, as an STL, with a keep-out rod beside it."""
    folder = tmp_path_factory.mktemp("author")
    organ = lumpy(4)
    shape = trimesh.Trimesh(organ.vertices_mm / 1000.0, organ.faces[:, ::-1], process=False)
    shape.export(folder / "organ.stl")
    rod = trimesh.creation.cylinder(0.008, 0.2)
    rod.apply_translation([0.09, 0.0, 0.05])
    rod.export(folder / "rod.obj")
    code = new(folder / "scene", folder / "organ.stl", folder / "rod.obj", "--unit", "m")
    return code, folder / "scene"


def test_a_scene_comes_out_in_millimetres_and_outwards(made):
    code, folder = made
    assert code == 0
    scene = open_scene(folder)
    assert [(body.name, body.role) for body in scene.bodies] == [
        ("organ", "organ"),
        ("rod", "keep-out"),
    ]
    assert scene.organ.mesh.is_watertight
    assert scene.organ.mesh.volume_mm3 == pytest.approx(lumpy(4).volume_mm3, rel=1e-4)
    assert {mount.tool for mount in scene.spec.mounts} == {"laser", "endoscope"}


def test_every_ring_point_is_hit_by_an_arm_that_touches_nothing(made):
    """The same result from the scene's numbers alone, with rays by trimesh."""
    scene = open_scene(made[1])
    reaches = reaches_of(scene)
    verdict = check_scene(scene, reaches)
    assert verdict.good
    assert verdict.work.covered == 1.0
    organ = scene.organ.world_mesh
    tree = trimesh.Trimesh(organ.vertices_mm, organ.faces, process=False)
    cut, ring = verdict.work.cuts["laser"], scene.ring
    assert len(ring.points_mm) == 72
    tips = cut.lines_mm[:, -1]
    hits, ray, _ = tree.ray.intersects_location(tips, cut.directions, multiple_hits=False)
    np.testing.assert_allclose(hits[np.argsort(ray)], ring.points_mm, atol=0.05)
    length = np.linalg.norm(ring.points_mm - tips, axis=1)
    assert np.all((length >= 20.0) & (length <= 60.0))
    cosine = np.einsum("ij,ij->i", -cut.directions, ring.normals)
    assert np.degrees(np.arccos(cosine)).max() <= 60.0
    # the arm keeps its length from the mount's own base, but for what pressure makes it stretch
    base = scene.spec.mount("laser").pose()[:3, 3]
    np.testing.assert_allclose(cut.lines_mm[:, 1], np.tile(base, (72, 1)), atol=0.3)
    arc = np.linalg.norm(np.diff(cut.lines_mm[:, 1:], axis=1), axis=2).sum(axis=1)
    assert np.all((arc > 69.5) & (arc < 70.0 * 1.15 + 0.1))
    # neighbours are near enough that nothing fits in between
    assert cut.step_mm.max() < 2.0 * verdict.work.clearance_mm.min()


def test_the_same_meshes_give_the_same_scene(made, tmp_path, capsys):
    """In Python as by the command, and by the factor of the unit as by its name."""
    source = made[1].parent
    meshes = (source / "organ.stl", source / "rod.obj")
    again = make_scene(Request(meshes, ("organ", "keep-out"), scale=1e3), name="scene")
    write_scene(again.scene, tmp_path / "again")
    files = sorted(path.name for path in made[1].iterdir())
    assert files == sorted(path.name for path in (tmp_path / "again").iterdir())
    for name in files:
        assert (tmp_path / "again" / name).read_bytes() == (made[1] / name).read_bytes(), name
    capsys.readouterr()
    assert run(["scene", "check", str(made[1])]) == 0
    said = capsys.readouterr().out
    assert sentence(again.check) in said
    assert all(finding.value in said for finding in again.check.findings)


def test_both_arms_and_their_shafts_clear_each_other(made):
    scene = open_scene(made[1])
    arms = mounted_arms(scene, reaches_of(scene))
    rest = {
        tool: ArmShape(arm.lines(arm.reach.rest[None])[0][0], 7.5) for tool, arm in arms.items()
    }
    for tool, arm in arms.items():
        far = rest[tool].centreline_mm[0]
        np.testing.assert_allclose(np.linalg.norm(far - arm.pose[:3, 3]), 100.0)
    clearance = CollisionChecker(scene.bodies).clearance(rest)
    assert clearance.least_mm >= scene.spec.limits.clearance_mm


def open_tube(folder, radius=15.0, length=120.0):
    """A tube along z that is open at both ends, as a bowel or a vessel comes, as an STL."""
    tube = trimesh.creation.cylinder(radius, length, sections=96)
    tube = tube.subdivide_to_size(8.0)
    tube.update_faces(abs(tube.face_normals[:, 2]) < 0.5)
    tube.export(folder / "tube.stl")
    return Request((folder / "tube.stl",), ("organ",), diameter_mm=12.0)


def test_the_lesion_of_an_open_tube_lies_on_its_wall(tmp_path):
    """The two lids that close the tube for the simulation are no tissue."""
    request = open_tube(tmp_path)
    prepared = prepare(request)
    assert any("holes closed: 2" in note for note in prepared.notes)
    (mesh,), (hole_mm,) = prepared.meshes, prepared.holes_mm
    lids = abs(mesh.face_normals[:, 2]) > 0.5
    np.testing.assert_array_equal(hole_mm > 0.0, lids)
    np.testing.assert_allclose(hole_mm[lids], 30.0, rtol=0.01)
    for site in choose_sites(request, prepared):
        points = np.vstack((site.ring.points_mm, site.point_mm))
        # between the circle and the 96 chords' middles
        radius = np.hypot(points[:, 0], points[:, 1])
        assert np.all((radius > 15.0 * np.cos(np.pi / 96) - 1e-6) & (radius < 15.0 + 1e-6))


def test_a_point_beside_a_keep_out_body_is_a_lesion_of_the_organ(tmp_path, capsys):
    """A ball of 60 mm; the point lies 12.2 mm above it and 8.1 mm from a vessel of 8 mm."""
    write_ply(ball(60.0, 3), tmp_path / "organ.ply")
    write_ply(moved(ball(8.0, 2), 0.0, 22.0, 74.0), tmp_path / "vessel.ply")
    files, point = (tmp_path / "organ.ply", tmp_path / "vessel.ply"), (0.0, 6.0, 72.0)
    assert new(tmp_path / "scene", *files, "--lesion", *point) == 0
    scene, said = open_scene(tmp_path / "scene"), capsys.readouterr()
    assert [(b.name, b.role) for b in scene.bodies] == [("organ", "organ"), ("vessel", "keep-out")]
    assert scene.spec.lesion.body == "organ"
    on_ball = 60.0 * np.array(point) / np.linalg.norm(point)
    np.testing.assert_allclose(scene.spec.lesion.centre_mm, on_ball, atol=0.5)
    text = " ".join((said.out + said.err).split())
    found = re.search(r"nearer to 'vessel' \((.*?) mm\) than to 'organ' \((.*?) mm\)", text)
    away = np.linalg.norm(np.array(point) - [0.0, 22.0, 74.0]) - 8.0
    assert float(found[1]) == pytest.approx(away, abs=0.3)
    assert float(found[2]) == pytest.approx(np.linalg.norm(point) - 60.0, abs=0.3)


def test_a_smaller_body_of_the_organs_file_can_have_the_lesion(tmp_path):
    """Two balls in one file: the point is on the smaller one, which a lesion may lie on."""
    both = trimesh.util.concatenate(
        [trimesh.Trimesh(m.vertices_mm, m.faces) for m in (ball(40.0), moved(ball(30.0), 90, 0, 0))]
    )
    both.export(tmp_path / "two.stl")
    request = Request((tmp_path / "two.stl",), ("organ",), lesion=(90.0, 0.0, 31.0))
    (site,) = choose_sites(request, prepare(request))
    assert site.body == 1
    np.testing.assert_allclose(site.point_mm, [90.0, 0.0, 30.0], atol=0.3)


@pytest.mark.parametrize(
    "place", [{"lesion": (0.0, 0.0, 61.0)}, {"lesion_direction": (0.0, 0.0, 1.0)}]
)
def test_a_lesion_on_a_closed_opening_is_refused(tmp_path, place):
    request = dataclasses.replace(open_tube(tmp_path), **place)
    with pytest.raises(InputError, match=r"close a hole 30 mm wide; the file has no surface there"):
        choose_sites(request, prepare(request))


def scene_with(made, folder, **changes):
    """The made scene with other values, in a folder of its own."""
    scene = open_scene(made[1])
    for body in scene.bodies:
        write_ply(body.mesh, folder / f"{body.name}.ply")
    save_spec(dataclasses.replace(scene.spec, **changes), folder / FILE)
    return folder


def test_a_mount_moved_into_the_organ_is_found(made, tmp_path):
    scene = open_scene(made[1])
    laser = dataclasses.replace(scene.spec.mount("laser"), position_mm=(0.0, 0.0, 0.0))
    folder = scene_with(made, tmp_path, mounts=(laser, scene.spec.mount("endoscope")))
    verdict = check_scene(open_scene(folder), reaches_of(scene))
    assert not verdict.good
    assert "laser touches organ" in sentence(verdict)
    assert run(["scene", "check", str(folder)]) == 1


def reach_of_laser_at(made, folder, position_mm):
    """The line on the laser's reach with its base at another place."""
    scene = open_scene(made[1])
    laser = dataclasses.replace(scene.spec.mount("laser"), position_mm=tuple(position_mm))
    scene = open_scene(scene_with(made, folder, mounts=(laser, scene.spec.mount("endoscope"))))
    return finding(check_scene(scene, reaches_of(scene)), "ring in the laser's reach").value


def test_a_laser_out_of_reach_is_told_by_how_much(made, tmp_path):
    """1 m behind its mount: the arm is 70 to 85 mm long and the beam at most 60 mm."""
    scene = open_scene(made[1])
    mount = scene.spec.mount("laser")
    direction = np.array(mount.direction) / np.linalg.norm(mount.direction)
    base = np.array(mount.position_mm) - 1000.0 * direction
    value = reach_of_laser_at(made, tmp_path, base)
    told = float(re.search(r"100 % out of reach, the nearest point by (\S+) mm", value)[1])
    away = np.linalg.norm(scene.ring.points_mm - base, axis=1).min()
    assert away - 85.0 - 60.0 < told < away - 70.0 - 60.0


def test_a_base_inside_a_body_is_named(made, tmp_path):
    """In the organ's middle, with the lesion behind it."""
    value = reach_of_laser_at(made, tmp_path, (0.0, 0.0, 0.0))
    assert value.endswith("100 % out of reach: its base is inside 'organ'")


@pytest.mark.parametrize("off_mm", [2.0, 30.0])
def test_a_lesion_off_the_surface_is_told_the_point_that_lies_on_it(made, tmp_path, off_mm):
    """Above the lesion of before, along its normal: that is the nearest point, or a nearer one."""
    scene = open_scene(made[1])
    centre = np.array(scene.spec.lesion.centre_mm) + off_mm * scene.ring.normal
    folder = scene_with(made, tmp_path, lesion=LesionSpec("organ", tuple(centre.tolist())))
    value = finding(check_scene(open_scene(folder), {}), "lesion on the surface").value
    off, typed = re.fullmatch(r"(\S+) mm off, nearest is \[(.*)\]", value).groups()
    point = tuple(float(x) for x in typed.split(", "))
    assert np.linalg.norm(centre - point) == pytest.approx(float(off), abs=0.02)
    assert float(off) <= off_mm
    again = scene_with(made, tmp_path, lesion=LesionSpec("organ", point, 5.0))
    scene = open_scene(again)
    assert finding(check_scene(scene, reaches_of(scene)), "lesion on the surface").good


def test_a_lesion_out_of_reach_is_told_why(made, tmp_path):
    scene = open_scene(made[1])
    low = scene.organ.world_mesh.vertices_mm[np.argmin(scene.organ.world_mesh.vertices_mm[:, 2])]
    folder = scene_with(made, tmp_path, lesion=LesionSpec("organ", tuple(low.tolist())))
    verdict = check_scene(open_scene(folder), reaches_of(scene))
    assert not verdict.good
    assert verdict.work.covered == 0.0
    assert {REASONS[code] for code in verdict.work.reasons["laser"]} <= {
        "out of reach",
        "beam blocked",
    }


def finding(verdict, what):
    return next(each for each in verdict.findings if each.what == what)


def test_a_camera_that_is_too_near_is_told(made, tmp_path):
    """Sharp from 150 mm on, farther than the endoscope's arm stands from its lesion."""
    camera = dataclasses.replace(open_scene(made[1]).spec.camera, range_mm=(150.0, 200.0))
    scene = open_scene(scene_with(made, tmp_path, camera=camera))
    found = finding(check_scene(scene, reaches_of(scene)), "camera to lesion")
    assert float(found.value.split()[0]) < 150.0
    assert (found.wanted, found.good) == ("150 to 200 mm", False)


def test_the_worst_moment_of_the_view_counts(made, monkeypatch):
    """The lasers hide the whole ring once, and never again."""
    times = []

    def hidden_once(caster, camera, pose, points, normals, arms=None):
        seen = view(caster, camera, pose, points, normals, arms)
        if arms is not None:
            times.append(seen)
        return dataclasses.replace(seen, visible=seen.visible & (len(times) != 2))

    monkeypatch.setattr("surgisoft.scene.check.view", hidden_once)
    scene = open_scene(made[1])
    verdict = check_scene(scene, reaches_of(scene))
    assert len(times) > 2
    found = finding(verdict, "ring in view")
    assert (found.value, found.good) == ("0 %", False)


def test_a_lesion_off_the_organ_is_a_verdict(made, tmp_path, capsys):
    folder = scene_with(made, tmp_path, lesion=LesionSpec("organ", (0.0, 0.0, 300.0)))
    picture = tmp_path / "map.png"
    assert run(["scene", "check", str(folder), "--map", str(picture)]) == 1
    said = capsys.readouterr().out
    assert "BAD lesion on the surface" in said
    assert f"{picture}: not drawn, because the ring does not lie on the organ" in said
    assert not picture.exists()


def test_a_path_off_the_organ_tells_how_far(made, tmp_path, capsys):
    """Two corners of the triangle float 20 mm and more above the organ's top."""
    lesion = open_scene(made[1]).spec.lesion
    x, y, z = lesion.centre_mm
    path = (lesion.centre_mm, (x + 5.0, y, z + 40.0), (x, y + 5.0, z + 40.0))
    folder = scene_with(made, tmp_path, lesion=dataclasses.replace(lesion, path_mm=path))
    assert run(["scene", "check", str(folder)]) == 1
    said = capsys.readouterr().out
    off = float(re.search(r"its path_mm leaves the surface by (\S+) mm", said)[1])
    assert 20.0 < off < 40.5
    assert "path 2 mm" in said
    assert "extends over" not in said


def test_a_path_that_crosses_itself_is_a_verdict(made, tmp_path, capsys):
    """A bow tie of 12 mm around the lesion's centre, on the organ's surface."""
    scene = open_scene(made[1])
    lesion, ring = scene.spec.lesion, scene.ring
    points = [tuple(map(float, ring.points_mm[i])) for i in (0, 36, 18, 54)]
    folder = scene_with(made, tmp_path, lesion=dataclasses.replace(lesion, path_mm=tuple(points)))
    assert run(["scene", "check", str(folder)]) == 1
    said = capsys.readouterr().out
    found = re.search(
        r"BAD lesion on the surface +its path_mm crosses itself near \((.*)\) mm", said
    )
    assert found, said
    place = np.array([float(x) for x in found[1].split(",")])
    assert np.linalg.norm(place - ring.centre_mm) < 3.0, "where the diagonals meet"


def test_contours_are_checked_as_the_ring_is(made, tmp_path, capsys):
    """On the ring's place, on the underside, 7 mm off the organ's surface, and an eight."""
    scene = open_scene(made[1])
    ring, organ = scene.ring, scene.organ.world_mesh
    lowest = organ.vertices_mm[organ.vertices_mm[:, 2].argmin()]
    line = [lowest, nearest_on_surface(organ, lowest[None] + [3.0, 0.0, 0.0])[0][0]]
    outwards = ring.points_mm[:9] + 7.0 * ring.normal
    off = np.linalg.norm(nearest_on_surface(organ, outwards)[0] - outwards, axis=1).max()

    def points(rows):
        return tuple(tuple(map(float, row)) for row in rows)

    contours = (
        ContourSpec("top", points(ring.points_mm[::6])),
        ContourSpec("under", points(line), closed=False),
        ContourSpec("high", points(outwards)),
        ContourSpec("eight", points(ring.points_mm[[0, 36, 18, 54]]), closed=True),
        ContourSpec("open_eight", points(ring.points_mm[[0, 36, 18, 54, 0]]), closed=False),
    )
    laid = [contour for contour in contours if contour.name not in ("eight", "open_eight")]
    assert run(["scene", "check", str(scene_with(made, tmp_path, contours=tuple(laid)))]) == 1
    said = capsys.readouterr().out
    assert "The scene is not ready: contour 'high' on the surface: point" in said
    assert re.search(
        rf"BAD contour 'high' on the surface +point . of 9, .* lies {off:.3g} mm", said
    )
    assert re.search(r"ok +contour 'top' in the laser's reach +100 %", said)
    assert re.search(r"BAD contour 'under' in the laser's reach +0 %, 100 % ", said)
    assert "contour 'high' in" not in said
    # the rod is a cylinder of 8 mm radius along z through (90, 0) mm
    away = {
        "top": np.hypot(ring.points_mm[:, 0] - 90.0, ring.points_mm[:, 1]).min() - 8.0,
        "under": min(np.hypot(row[0] - 90.0, row[1]) for row in line) - 8.0,
    }
    for name, expected in away.items():
        told = re.search(rf"contour '{name}' to 'rod' +(\S+) mm", said)
        assert float(told[1]) == pytest.approx(expected, abs=0.3)

    again = dataclasses.replace(contours[4], name="again")
    crossed = check_scene(
        dataclasses.replace(
            scene, spec=dataclasses.replace(scene.spec, contours=(*contours[3:], again))
        ),
        reaches_of(scene),
    )
    assert not finding(crossed, "contour 'eight' on the surface").good
    assert "crosses itself" in finding(crossed, "contour 'eight' on the surface").value
    assert finding(crossed, "contour 'open_eight' on the surface").good
    twice = finding(crossed, "contours apart")
    length = finding(crossed, "contour 'open_eight' on the surface").value.split(" ")[0]
    assert not twice.good
    assert twice.value == f"contours 'open_eight' and 'again' coincide over {length} mm"
    assert finding(crossed, "contour 'open_eight' in the laser's reach").value == "100 %"


def test_a_lesion_as_a_mesh_is_told_by_which_option_it_is_given(tmp_path, capsys):
    """A ball of 8 mm about (20, -3, 41) mm: as a file of its own, and inside the organ's file."""
    organ = trimesh.Trimesh(lumpy(4).vertices_mm, lumpy(4).faces, process=False)
    tumour = trimesh.creation.icosphere(subdivisions=3, radius=4.0)
    tumour.apply_translation([20.0, -3.0, 41.0])
    organ.export(tmp_path / "organ.stl")
    tumour.export(tmp_path / "tumour.stl")
    target = tmp_path / "scene"
    assert new(target, tmp_path / "organ.stl", f"{tmp_path / 'tumour.stl'}:lesion") == 2
    (said,) = capsys.readouterr().err.splitlines()
    place = [float(x) for x in re.search(r"--lesion (\S+) (\S+) (\S+) \(", said).groups()]
    np.testing.assert_allclose(place, [20.0, -3.0, 41.0], atol=1e-3)
    assert "which is 8 across" in said
    assert not target.exists()
    inside = tumour.copy()
    inside.apply_translation(-inside.centroid)
    trimesh.util.concatenate(organ, inside).export(tmp_path / "both.stl")
    notes = prepare(Request((tmp_path / "both.stl",), ("organ",))).notes
    assert any("inner bodies removed: 1 (where one was a lesion, place it by --lesion" in note
               for note in notes)  # fmt: skip


def test_a_dicom_image_is_told_to_be_segmented(tmp_path, capsys):
    (tmp_path / "ct.DCM").write_bytes(b"\0" * 128 + b"DICM")
    assert new(tmp_path / "scene", tmp_path / "ct.DCM") == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "ct.DCM: a DICOM image is not read" in said
    assert "segment it" in said
    assert "NIfTI (.nii.gz) or NRRD (.nrrd)" in said


def test_an_arm_model_that_is_not_there_names_file_and_field(made, tmp_path, capsys):
    mounts = list(open_scene(made[1]).spec.mounts)
    mounts[1] = dataclasses.replace(mounts[1], arm="nosuch")
    folder = scene_with(made, tmp_path, mounts=tuple(mounts))
    lines = (folder / FILE).read_text().splitlines()
    line = 1 + lines.index('arm = "nosuch"')
    assert run(["scene", "check", str(folder)]) == 2
    error = capsys.readouterr().err
    assert f"{folder / FILE}:{line}: mounts[1].arm: there is no arm model 'nosuch'" in error
    assert error.count("\n") == 1


def test_a_mount_of_another_length_than_its_model_is_told(made, tmp_path, capsys):
    mounts = list(open_scene(made[1]).spec.mounts)
    mounts[0] = dataclasses.replace(mounts[0], length_mm=120.0)
    folder = scene_with(made, tmp_path, mounts=tuple(mounts))
    assert run(["scene", "check", str(folder)]) == 2
    error = capsys.readouterr().err
    assert "mounts[0].length_mm: got 120 mm for an arm model of 70 mm" in error


def test_the_tables_shapes_are_those_that_the_tasks_bend(made):
    """A world's arm taken from rest to some of the table's commands, to its memory's width."""
    reach = reaches_of(open_scene(made[1]))["laser"]
    free = WorldConfig(
        samples=15,
        pneumatics=Pneumatics(step_kPa=100.0, tau_s=0.0),
        randomisation=Randomisation(history=0, start_kPa=0.0),
    )
    world = single_arm_world(free)
    state = world.start(streams(0, 5))
    which = np.linspace(0, len(reach.commands) - 1, 5).astype(int)
    action = torch.tensor(reach.commands[which], dtype=torch.float32)
    part = world.step(state, {"arm": action}).arms["arm"]
    np.testing.assert_allclose(part.line_mm.numpy(), reach.centreline_mm[which], atol=1.0)
    np.testing.assert_allclose(part.tip_direction.numpy(), reach.tip_direction[which], atol=0.05)


def test_the_patch_agrees_with_the_ring(made):
    """The map's circle of the lesion's own diameter says what the checker says of the ring."""
    scene = open_scene(made[1])
    patch = reach_patch(scene, reaches_of(scene), 48)
    far = np.linalg.norm(patch.flat_mm, axis=1)
    on_ring = np.abs(far - 10.0) < 0.1
    assert on_ring.sum() == 48
    assert np.all(patch.reason[on_ring] == 0)
    assert far.max() == pytest.approx(16.0, abs=0.2)


def test_only_the_reasons_of_a_map_are_coloured(made, tmp_path):
    """A point of each reason on the outermost circle: the incidence below is drawn in grey."""
    scene = open_scene(made[1])
    reaches = reaches_of(scene)
    whole, verdict = reach_patch(scene, reaches), check_scene(scene, reaches)
    codes = np.zeros(len(whole.reason), dtype=int)
    far = np.linalg.norm(whole.flat_mm, axis=1)
    outer = np.flatnonzero(far > 0.9 * far.max())
    codes[outer[: 8 * 5]] = np.repeat([1, 2, 3, 4, 5], 8)
    patch = dataclasses.replace(whole, reason=codes)
    draw_reach_map(scene, verdict, {"laser": patch}, tmp_path / "map.png")
    picture = np.asarray(Image.open(tmp_path / "map.png").convert("RGB")).astype(int)
    left = picture[:, : int(0.52 * picture.shape[1])].reshape(-1, 3)
    coloured = left[np.ptp(left, axis=1) > 60]
    named = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in REASON_COLOURS])
    for colour in named:
        assert (coloured == colour).all(axis=1).sum() > 40
    # a pixel at a marker's edge is a mixture of its colour with white, grey or black
    hues = coloured - coloured.min(axis=1, keepdims=True)
    own = named - named.min(axis=1, keepdims=True)
    cosine = (hues @ own.T) / np.outer(frames.norm(hues), frames.norm(own))
    assert np.mean(cosine.max(axis=1) > 0.97) > 0.95


def test_a_map_is_drawn(made, tmp_path):
    assert run(["scene", "check", str(made[1]), "--map", str(tmp_path / "map.png")]) == 0
    from PIL import Image

    colours = np.asarray(Image.open(tmp_path / "map.png").convert("RGB")).reshape(-1, 3)
    green = np.abs(colours.astype(int) - [42, 157, 74]).sum(axis=1) < 30
    assert green.sum() > 500  # the ring's points that can be cut


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("map.jpg", "suffix '.jpg', expected .png"),
        ("folder.png", "is a folder, expected a file"),
        ("file/map.png", "is not a writable folder"),
    ],
)
def test_a_map_that_cannot_be_written_is_told_before_the_check(
    name, message, made, tmp_path, capsys, monkeypatch
):
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()
    checked = []
    monkeypatch.setattr("surgisoft.scene.check.check_scene", lambda *given: checked.append(given))
    assert run(["scene", "check", str(made[1]), "--map", str(tmp_path / name)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not checked


def test_a_map_without_a_laser_is_told_before_the_check(made, tmp_path, capsys, monkeypatch):
    mounts = tuple(m for m in open_scene(made[1]).spec.mounts if m.tool != "laser")
    folder, checked = scene_with(made, tmp_path, mounts=mounts), []
    monkeypatch.setattr("surgisoft.scene.check.check_scene", lambda *given: checked.append(given))
    assert run(["scene", "check", str(folder), "--map", str(tmp_path / "map.png")]) == 2
    assert "no arm of the scene carries a laser" in capsys.readouterr().err
    assert not checked


def test_a_lid_over_the_lesion_leaves_no_mount(tmp_path, capsys):
    write_ply(ball(60.0, 3), tmp_path / "ball.ply")
    write_ply(moved(box((200.0, 200.0, 10.0)), 0.0, 0.0, 72.0), tmp_path / "lid.ply")
    arguments = (tmp_path / "ball.ply", tmp_path / "lid.ply", "--unit", "mm", "--lesion", 0, 0, 60)
    assert new(tmp_path / "scene", *arguments) == 1
    said = capsys.readouterr().out
    assert "ball.ply: unit mm as given (120 mm across)\n" in said
    assert "No scene was written" in said
    assert "the best covers 0 %" in said
    assert not (tmp_path / "scene").exists()


def test_a_lesion_on_the_side_is_reached_where_the_lid_leaves_room(tmp_path, capsys):
    write_ply(ball(60.0, 3), tmp_path / "ball.ply")
    write_ply(moved(box((200.0, 200.0, 10.0)), 0.0, 0.0, 72.0), tmp_path / "lid.ply")
    arguments = (tmp_path / "ball.ply", f"{tmp_path / 'lid.ply'}:support", "--lesion", 60, 0, -20)
    assert new(tmp_path / "scene", *arguments) == 0
    # sqrt(60^2 + 20^2) - 60 = 3.246 mm outside the ball, whose facets lie up to 0.15 mm within
    said = re.search(
        r"given point was (\S+) mm off the surface and was moved", capsys.readouterr().out
    )
    assert 3.2 < float(said[1]) < 3.5
    scene = open_scene(tmp_path / "scene")
    assert scene.spec.body("lid").role == "support"
    np.testing.assert_allclose(scene.spec.lesion.centre_mm, [56.9, 0.0, -19.0], atol=0.6)


def ellipsoid(folder):
    """An organ of 120 x 100 x 70 mm."""
    sphere = ball(1.0, 3)
    write_ply(Mesh(sphere.vertices_mm * (60.0, 50.0, 35.0), sphere.faces), folder / "organ.ply")
    return folder / "organ.ply"


@pytest.mark.parametrize("arms", ["laser,tip", "tip,tip"])
def test_a_tip_finds_a_place_beside_one_other_arm(arms, tmp_path):
    assert new(tmp_path / "scene", ellipsoid(tmp_path), "--unit", "mm", "--arms", arms) == 0
    scene = open_scene(tmp_path / "scene")
    reaches = reaches_of(scene)
    verdict = check_scene(scene, reaches)  # by FCL; the search uses the batched engine
    assert verdict.good
    assert all(touch.reached for touch in verdict.work.touches.values())
    checker = CollisionChecker(scene.bodies)
    placed, radius = mounted_arms(scene, reaches), {k: r.radius_mm for k, r in reaches.items()}
    ways = {name: touch.way_mm for name, touch in verdict.work.touches.items()}
    for name, cut in verdict.work.cuts.items():
        ways[name] = placed[name].lines(placed[name].approach(cut.centre))[0]
    stands = {name: ArmShape(way[0], radius[name]) for name, way in ways.items()}
    for name, way in ways.items():  # one after another; the others are at rest
        for line in way[:: max(1, len(way) // 8)]:
            shapes = stands | {name: ArmShape(line, radius[name])}
            assert checker.clearance(shapes).least_mm >= scene.spec.limits.clearance_mm


def test_two_tips_without_room_are_told_without_a_view(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("surgisoft.scene.mounts.COMBINED", dict.fromkeys(mounts.COMBINED, 1))
    organ = ellipsoid(tmp_path)
    assert new(tmp_path / "scene", organ, "--unit", "mm", "--arms", "tip,tip") == 1
    said = capsys.readouterr().out.splitlines()[-1]
    assert "no two of them leave room for both arms (1 mm apart)." in said
    assert "view" not in said


def test_the_reason_ends_with_one_full_stop(tmp_path, capsys, monkeypatch):
    def refused(scene, reaches):
        return SceneCheck((Finding("clearance", "0 mm", "1 mm", False),), None)

    monkeypatch.setattr("surgisoft.scene.author.check_scene", refused)
    place = ("--lesion", 0, 0, 35)  # one place alone is tried
    assert new(tmp_path / "scene", ellipsoid(tmp_path), "--unit", "mm", *place) == 1
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.endswith("clearance: 0 mm (needs 1 mm).")


BAD = [
    (
        ("ball.ply", "--lesion", "0", "0", "81"),
        "--lesion 0 0 81 lies 21 mm from the organ's surface",
    ),
    (
        ("ball.ply", "--unit", "cm", "--lesion", "0", "0", "81"),
        "in the scene 0, 0, 810 mm) lies 210 mm",
    ),
    (("nowhere.stl",), "there is no such file"),
    (("ball.ply", "--unit", "yard"), "unknown unit 'yard'"),
    (("small.ply",), "14 mm across in mm (PLY stores no unit), and organs measure 20 to 600 mm"),
    (("small.ply",), "--unit cm (140 mm), --unit m (1.4e+04 mm), --unit inch (355.6 mm), or --sca"),
    (("ball.ply", "--unit", "mm", "--scale", "2"), "both --unit and --scale"),
    (("ball.ply", "--scale", "0"), "--scale is 0"),
    (("ball.ply", "--up", "w"), "unknown axis 'w'"),
    (("ball.ply", "--label", "1:organ"), "--label is given for meshes"),
    (("ball.ply", "--label", "1"), "expected LABEL:ROLE[:NAME]"),
    (("ball.ply", "--margin", "-1"), "--margin is -1"),
    (("ball.ply", "--margin", "3"), "--margin is given without a segmented lesion"),
    (("ball.ply", "--margin", "3", "--diameter", "20"), "both --diameter and --margin"),
    (("ball.ply", "--arm", "scope=default"), "unknown arm 'scope'"),
    (("ball.ply", "--arms", "laser,knife"), "unknown tool 'knife'"),
    (("ball.ply", "--arms", "laser,laser", "--arm", "laser_3=default"), "unknown arm 'laser_3'"),
    (("ball.ply", "--arm", "laser=default,laser=default"), "two arms for the laser"),
    (("ball.ply", "--arm", "nowhere"), "no arm model there"),
    (("ball.ply", "--unit", "m"), "would be 1.2e+05 mm across; organs measure 20 to 600 mm"),
    (("ball.ply:knife",), "role 'knife'"),
    (("ball.ply:support",), "expected the organ first"),
    (("ball.ply", "--diameter", "0"), "--diameter is 0"),
    (("ball.ply", "--diameter", "150"), "no ring of 150 mm"),
    (("ball.ply", "--lesion", "0", "0", "60", "--lesion-direction", "0", "0", "1"), "both"),
    (("ball.ply", "--lesion-direction", "0", "0", "0"), "not zero"),
    (("ball.ply", "--lesion", "nan", "0", "0"), "finite"),
    (("half.ply",), "too large to close"),
]


@pytest.mark.parametrize(("arguments", "says"), BAD, ids=[says for _, says in BAD])
def test_a_bad_wish_is_one_line_and_writes_nothing(arguments, says, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    organ = ball(60.0, 2)
    write_ply(organ, tmp_path / "ball.ply")
    write_ply(
        Mesh(organ.vertices_mm, organ.faces[organ.triangles_mm[:, :, 2].mean(1) < 0]),
        tmp_path / "half.ply",
    )
    write_ply(ball(7.0, 2), tmp_path / "small.ply")
    files = sorted(path.name for path in tmp_path.iterdir())
    assert new("scene", *arguments) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == files


@pytest.mark.parametrize("up", UP)
def test_the_axis_that_the_user_names_points_up(up, tmp_path):
    """A lesion given in the file's own frame lies on top of the world's organ."""
    write_ply(ball(60.0, 3), tmp_path / "ball.ply")
    sign, axis = (-1.0 if up[0] == "-" else 1.0), "xyz".index(up[-1])
    lesion = tuple(sign * 60.0 * (i == axis) for i in range(3))
    for place in ({"lesion": lesion}, {"lesion_direction": lesion}):
        request = Request((tmp_path / "ball.ply",), ("organ",), up=up, diameter_mm=20.0, **place)
        (site,) = choose_sites(request, prepare(request))
        np.testing.assert_allclose(site.point_mm, [0.0, 0.0, 60.0], atol=0.5)
        assert np.linalg.det(UP[up]) == pytest.approx(1.0)  # a mirrored organ is another patient's


def test_gltf_comes_in_metres_with_y_up(tmp_path):
    """As its standard has it (Khronos, glTF 2.0, 3.4)."""
    shape = trimesh.creation.box((0.1, 0.04, 0.06))
    shape.apply_translation((0.0, 1.0, 0.0))
    shape.export(tmp_path / "organ.glb")
    prepared = prepare(Request((tmp_path / "organ.glb",), ("organ",)))
    size = np.ptp(prepared.meshes[0].bounds_mm, axis=0)
    np.testing.assert_allclose(size, [100.0, 60.0, 40.0], rtol=1e-6)
    assert any("y points up" in note for note in prepared.notes)


def test_a_second_file_has_a_unit_and_an_up_of_its_own(tmp_path):
    """An organ in mm with z up, and a vessel from a glTF file, in metres with y up."""
    write_ply(ball(60.0, 3), tmp_path / "organ.ply")
    shape = trimesh.creation.box((0.1, 0.04, 0.06))
    shape.apply_translation((0.0, 0.2, 0.0))
    shape.export(tmp_path / "vessel.glb")
    files = tmp_path / "organ.ply", tmp_path / "vessel.glb"
    organ, vessel = prepare(Request(files, ("organ", "keep-out"))).meshes
    np.testing.assert_allclose(np.ptp(organ.bounds_mm, axis=0), 120.0, rtol=0.01)
    np.testing.assert_allclose(vessel.bounds_mm, [[-50, -30, 180], [50, 30, 220]], atol=1e-3)


@pytest.mark.parametrize(("unit", "scale", "told"), [("m", 1.0, "error"), ("mm", 1000.0, "note")])
def test_a_further_body_in_another_unit_is_told(tmp_path, unit, scale, told):
    """A vessel of 60 mm, 25 mm beside an organ of 100 mm at 900 mm from the origin: in mm beside an
    organ in metres it is 60 m long and an error; in metres beside an organ in mm it is a speck at
    the origin, 0.9 m less 50 mm away."""
    organ = trimesh.creation.box((0.1, 0.1, 0.1))
    vessel = trimesh.creation.box((0.01, 0.06, 0.01))
    vessel.apply_translation((0.08, 0.0, 0.0))
    for shape, factor in ((organ, scale), (vessel, 1000.0 / scale)):
        shape.apply_translation((0.0, 0.0, 0.9))
        shape.apply_scale(factor)
    organ.export(tmp_path / "organ.stl")
    vessel.export(tmp_path / "vessel.stl")
    files = tmp_path / "organ.stl", tmp_path / "vessel.stl"
    request = Request(files, ("organ", "keep-out"), unit=unit)
    if told == "error":
        with pytest.raises(
            InputError, match=r"60000 mm across .* in mm .* 60 mm across and about 25 mm"
        ):
            prepare(request)
    else:
        said = next(note for note in prepare(request).notes if "vessel.stl: unit" in note)
        assert "0.06 mm across and about 849 mm away from the organ, which is 100 mm across" in said
        assert "in m it would be 60 mm across and about 25 mm away" in said


def test_a_body_beside_the_organ_in_its_unit_is_not_doubted(tmp_path):
    for name, size, x in (("organ", 100.0, 0.0), ("table", 700.0, 410.0)):
        shape = trimesh.creation.box((size,) * 3)
        shape.apply_translation((x, 0.0, 0.0))
        shape.export(tmp_path / f"{name}.stl")
    files = tmp_path / "organ.stl", tmp_path / "table.stl"
    notes = prepare(Request(files, ("organ", "support"))).notes
    assert f"table.stl: unit that of {files[0].name}" in notes


def test_the_organ_is_the_largest_body_of_its_file(tmp_path):
    """A node of 20 mm comes before the organ of 80 mm."""
    scene = trimesh.Scene()
    for name, size, x in (("a", 0.02, 0.09), ("b", 0.08, 0.0)):
        shape = trimesh.creation.box((size,) * 3)
        shape.apply_translation((x, 0.0, 0.0))
        scene.add_geometry(shape, node_name=name, geom_name=name)
    scene.export(tmp_path / "two.glb")
    prepared = prepare(Request((tmp_path / "two.glb",), ("organ",)))
    assert prepared.roles == ("organ", "keep-out")
    sizes = [np.ptp(mesh.bounds_mm, axis=0)[0] for mesh in prepared.meshes]
    assert sizes == pytest.approx([80.0, 20.0])


def test_mounts_are_found_for_an_arm_of_another_length(tmp_path, monkeypatch, capsys):
    """The laser's arm is 120 mm long and bends as an arc; the endoscope's is the default one.

    A terminal is asked for the unit of the mesh, which is 12 units across.
    """
    spec = ArmSpec(3, 5, (0.0,) * 3, (40.0,) * 3, length_mm=120.0, diameter_mm=12.0)
    bends = ConstantCurvature(torch.zeros(3), torch.full((3,), 40.0), key_points=5)
    rest = torch.tensor([[0.0, 0.0, 30.0 * k] for k in range(5)])
    bends.set_rest(rest)
    around = 2.0 * torch.pi * torch.arange(3) / 3
    bends.table.data[0, :2, :3] = 0.8 * torch.stack((around.cos(), around.sin()))
    save_model(ArmModel(spec, bends, rest_mm=rest), tmp_path / "long")
    write_ply(ball(6.0, 3), tmp_path / "ball.ply")
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.prompt", lambda question: "cm")
    arm = f"laser={tmp_path / 'long'}"
    assert new(tmp_path / "scene", tmp_path / "ball.ply", "--arm", arm) == 0
    assert "PLY stores no unit" in capsys.readouterr().out
    scene = open_scene(tmp_path / "scene")
    assert np.ptp(scene.organ.mesh.bounds_mm[:, 0]) == pytest.approx(120.0, rel=0.01)
    laser, endoscope = scene.spec.mount("laser"), scene.spec.mount("endoscope")
    assert (laser.length_mm, laser.diameter_mm, endoscope.length_mm) == (120.0, 12.0, 70.0)
    assert run(["scene", "check", str(tmp_path / "scene")]) == 0
    # the long arm in place of the scene's own would begin inside the organ
    with pytest.raises(InputError, match=r"is 120 mm long, and the scene .* 70 mm as the endosco"):
        scene_world(scene, arm=tmp_path / "long")


def test_a_callable_arm_becomes_a_scenes_arm_as_a_folder(tmp_path, monkeypatch, capsys):
    """The line says how to save it; mounts are then those of the saved model."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "straight.py").write_text(
        "import numpy as np\n"
        "class Arm:\n"
        "    static, error_mm = True, 1.0\n"
        "    low, high = (0.0, 0.0), (50.0, 50.0)\n"
        "    length_mm, diameter_mm = 42.0, 9.0\n"
        "    def __call__(self, time_s, actuation):\n"
        "        line = np.linspace(0.0, 42.0, 4)[None, :, None] * np.array([0.0, 0.0, 1.0])\n"
        "        return np.tile(line, (len(actuation), 1, 1))\n"
        "arm = Arm()\n"
    )
    write_ply(ball(60.0, 2), tmp_path / "ball.ply")
    assert new("scene", "ball.ply", "--arm", "straight.py:arm") == 2
    said = capsys.readouterr().err
    assert said.startswith("surgisoft: error: straight.py:arm: is a Python callable, expected 'de")
    (call,) = re.findall(r"save_model\(.*?\), 'my_arm'\)", said)
    exec(call, {"save_model": save_model, "load_model": load_model})
    mount = blank_mounts(models={"laser": "my_arm"})["laser"]
    assert (mount.length_mm, mount.diameter_mm) == (42.0, 9.0)
    assert mount.arm == str(tmp_path / "my_arm")
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize(
    ("length_mm", "body", "told"),
    [
        (60.0, 0.06, "in m: along the body, base to tip, they are 0.06 long, where the arm is 60"),
        (60.0, 6.0, "in cm: along the body, base to tip, they are 6 long, where the arm is 60 mm"),
        (0.06, 0.06, "in m: along the body, base to tip, they are 0.06 long, where an arm is 3 mm"),
    ],
)
def test_an_arm_in_another_unit_of_length_gets_no_mount(tmp_path, length_mm, body, told):
    """As `compare` says it; also of an arm whose stated length is in that unit."""
    file = tmp_path / "straight.py"
    file.write_text(
        "import numpy as np\n"
        "class Arm:\n"
        "    static, error_mm = True, 1.0\n"
        "    low, high = (0.0, 0.0), (50.0, 50.0)\n"
        f"    length_mm = {length_mm}\n"
        "    def __call__(self, time_s, actuation):\n"
        f"        line = np.linspace(0.0, {body}, 4)[None, :, None] * np.array([0.0, 0.0, 1.0])\n"
        "        return np.tile(line, (len(actuation), 1, 1))\n"
        "arm = Arm()\n"
    )
    save_model(load_model(f"{file}:arm"), tmp_path / "arm")
    mount = blank_mounts(models={"laser": str(tmp_path / "arm")})["laser"]
    with pytest.raises(InputError, match=re.escape(f"arm: returns key points {told}")) as error:
        reach_of(mount)
    assert f"expected mm: multiply them by {10 if body == 6.0 else 1000}" in str(error.value)


def test_an_existing_folder_is_kept(made, tmp_path, capsys):
    write_ply(ball(60.0, 2), tmp_path / "ball.ply")
    assert new(made[1], tmp_path / "ball.ply") == 2
    assert "exists already" in capsys.readouterr().err
    (tmp_path / "papers").mkdir()
    (tmp_path / "papers" / "thesis.txt").write_text("years of work")
    assert new(tmp_path / "papers", tmp_path / "ball.ply", "--force") == 2
    assert "is not a scene" in capsys.readouterr().err
    assert (tmp_path / "papers" / "thesis.txt").exists()


def test_a_scene_without_its_mesh_is_one_line(made, tmp_path):
    folder = scene_with(made, tmp_path)
    (folder / "rod.ply").unlink()
    line = 1 + (folder / FILE).read_text().splitlines().index('mesh = "rod.ply"')
    place = rf"scene\.toml:{line}: bodies\[1\]\.mesh: there is no file 'rod\.ply'"
    with pytest.raises(InputError, match=place):
        open_scene(folder)


def test_the_scenes_hash_sees_values_and_meshes_but_not_comments(made, tmp_path):
    folder = scene_with(made, tmp_path)
    first = open_scene(folder).content_hash
    (folder / FILE).write_text("# a comment\n" + (folder / FILE).read_text())
    assert open_scene(folder).content_hash == first
    mesh = open_scene(folder).organ.mesh
    write_ply(moved(mesh, 1e-9, 0.0, 0.0), folder / "organ.ply")
    assert open_scene(folder).content_hash != first


def test_a_rounded_mount_stands_where_it_stood():
    mount = MountSpec("laser", (1.234567, -2.0, 3.0), (0.3, -0.4, -0.5), roll_deg=-77.123)
    pose = mount.pose()
    again = MountSpec("laser", **rounded_mount(pose[:3, 3], pose[:3, :3])).pose()
    np.testing.assert_allclose(again[:3, 3], pose[:3, 3], atol=0.005)
    np.testing.assert_allclose(again[:3, :3], pose[:3, :3], atol=2e-4)


def test_a_public_liver_becomes_a_scene(shared, tmp_path, capsys):
    for name in ("openhelp_liver", "liver_collision"):
        assert new(tmp_path / name, shared / "meshes" / f"{name}.stl") == 0
        assert "unit mm" in capsys.readouterr().out
        assert run(["scene", "check", str(tmp_path / name)]) == 0


def test_a_target_that_cannot_be_written_is_found_before_the_work(tmp_path, capsys):
    """The mesh is no mesh either: the error names the target only, so no mesh was read."""
    (tmp_path / "file").write_text("x")
    (tmp_path / "text.stl").write_text("no mesh")
    assert new(tmp_path / "file" / "deep" / "scene", tmp_path / "text.stl") == 2
    error = capsys.readouterr().err
    assert f"cannot be written, {tmp_path / 'file'} is not a writable folder" in error
    assert (tmp_path / "file").read_text() == "x"


def test_a_folder_without_write_permission_is_found(tmp_path, monkeypatch):
    """Asked of the system, as permission bits do not bind every user who runs this test."""
    asked = []
    monkeypatch.setattr(os, "access", lambda path, mode: bool(asked.append((path, mode))))
    with pytest.raises(InputError, match="is not a writable folder"):
        check_target(tmp_path / "a" / "scene", False)
    assert asked == [(tmp_path, os.W_OK | os.X_OK)]
