"""Batched clearance against FCL and against closed forms."""

import math
import os

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.scene import batched, field, frames
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.bvh import build_tree, segment_triangle_d2
from surgisoft.scene.capsules import ArmShape, BatchClearance, segment_distance, self_contact_gap_mm
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.inside import winding_numbers
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.moving import Placement
from surgisoft.scene.torch_queries import (
    TorchSurface,
    chains_apart_torch,
    chains_folded_torch,
)
from surgisoft.scene.torch_queries import segment_triangle_d2 as segment_triangle_d2_torch
from tests.scene.engines import ON_ACCELERATORS
from tests.scene.shapes import ball, box, lumpy

RADIUS = 5.0


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory):
    """Fields of the tests are kept apart from the user's."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield
    os.environ.pop("XDG_CACHE_HOME")
    if before is not None:
        os.environ["XDG_CACHE_HOME"] = before


def random_arms(count, seed, points=21, length=70.0, near=45.0, far=100.0):
    """Constant-curvature arms from bases all around the origin, aimed roughly at it."""
    rng = np.random.default_rng(seed)
    away = frames.normalise(rng.normal(size=(count, 3)))
    aim = -away + 0.7 * rng.normal(size=(count, 3))
    base = away * rng.uniform(near, far, (count, 1))
    poses = frames.pose_from_z(base, aim, rng.uniform(-3, 3, count))
    s, bend = np.linspace(0, 1, points), rng.uniform(-3.5, 3.5, (count, 1))
    radius = length / bend
    line = (radius * (1 - np.cos(bend * s)), 0 * bend * s, radius * np.sin(bend * s))
    arms = frames.apply(poses, np.stack(line, axis=-1))
    return torch.tensor(arms, dtype=torch.float32)


@pytest.fixture(scope="module")
def organ_scene():
    turned = frames.pose_from_z([4.0, -9.0, 3.0], [0.2, 0.3, 0.9], 0.4)
    bodies = [Body("organ", "organ", lumpy(4), turned)]
    return bodies, BatchedScene(bodies, {"a": RADIUS}, most_nodes=300_000)


@pytest.fixture(scope="module", params=ON_ACCELERATORS)
def on_accelerator(request):
    """Makes the same scene on an engine that otherwise serves accelerators."""

    def made(bodies, **more):
        return BatchedScene(bodies, {"a": RADIUS}, most_nodes=300_000, engine=request.param, **more)

    return made


def test_four_thousand_poses_agree_with_fcl(organ_scene):
    """Within 0.1 mm near contact, and not one collision missed or made up."""
    bodies, scene = organ_scene
    checker = CollisionChecker(bodies)
    arms = random_arms(4_000, seed=1, points=13)
    found = scene.clearance({"a": arms}).bodies_mm[:, 0, 0].double().numpy()
    shapes = [{"a": ArmShape(line, RADIUS)} for line in arms.double().numpy()]
    hits = np.array([any(c.kind == "body" for c in checker.collisions(s)) for s in shapes])
    asked = np.flatnonzero((np.abs(found) < 4.0) | (np.arange(len(arms)) % 10 == 0))
    truth = {i: checker.clearance(shapes[i]).bodies_mm["a", "organ"] for i in asked}
    error = {i: abs(found[i] - value) for i, value in truth.items()}
    near = [e for i, e in error.items() if truth[i] < batched.EXACT_WITHIN_MM - 0.1]
    far = [e for i, e in error.items() if truth[i] >= batched.EXACT_WITHIN_MM - 0.1]
    assert len(near) > 600
    assert max(near) < 1e-4
    assert len(far) > 120
    assert max(far) < 1.0
    touching = np.abs(found) < 1e-4
    np.testing.assert_array_equal((found < 0)[~touching], hits[~touching])
    assert 0.2 < hits.mean() < 0.9


def test_the_engines_agree(organ_scene, on_accelerator):
    bodies, scene = organ_scene
    arms = {"a": random_arms(400, seed=2)}
    compiled, other = scene.clearance(arms), on_accelerator(bodies).clearance(arms)
    assert (compiled.bodies_mm < 0).float().mean() > 0.2
    torch.testing.assert_close(other.bodies_mm, compiled.bodies_mm, atol=1e-5, rtol=0)
    torch.testing.assert_close(other.self_mm, compiled.self_mm, atol=1e-3, rtol=0)


coordinate = st.floats(-60, 60)
point = st.tuples(coordinate, coordinate, coordinate)


@pytest.fixture(scope="module")
def box_scene():
    return BatchedScene([Body("box", "organ", box((40, 30, 20)))], {"a": RADIUS}, most_nodes=50_000)


@given(start=point, end=point)
@settings(max_examples=150, deadline=None)
def test_clearance_of_a_box_is_the_closed_form(box_scene, start, end):
    line = np.linspace(start, end, 25)
    dense = box_signed(np.linspace(start, end, 2401))
    arms = {"a": torch.tensor(line)[None]}
    found = box_scene.clearance(arms).bodies_mm.item() + RADIUS
    slack = math.dist(start, end) / 4800
    truth = dense.min() if dense.min() > slack else min(0.0, box_signed(line).min())
    if truth < RADIUS + batched.EXACT_WITHIN_MM:
        assert found == pytest.approx(truth, abs=slack + 1e-9)
    else:
        assert found == pytest.approx(min(truth, 60.0 + RADIUS), abs=1.0)


def box_signed(points, half=(20.0, 15.0, 10.0)):
    q = np.abs(points) - np.array(half)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def test_an_arm_wholly_inside_reports_its_depth(box_scene):
    line = torch.linspace(-5, 5, 9)[:, None] * torch.tensor([1.0, 0, 0])
    found = box_scene.clearance({"a": line[None]})
    assert found.bodies_mm.item() == pytest.approx(-10.0 - RADIUS, abs=1e-6)
    assert found.collides.all()


def test_long_segments_do_not_jump_over_a_thin_body():
    plate = BatchedScene([Body("plate", "keep-out", box((60, 60, 0.2)))], {"a": 0.5})
    line = torch.tensor([[[0.0, 0, 50], [0, 0, -50]], [[70.0, 0, 50], [70, 0, -50]]])
    assert plate.clearance({"a": line}).collides.tolist() == [True, False]


def test_moving_a_body_is_moving_the_arm_back(organ_scene):
    bodies, scene = organ_scene
    arms = random_arms(64, seed=4)
    rng = np.random.default_rng(0)
    moves = frames.pose_from_z(rng.normal(size=(64, 3)) * 10, rng.normal(size=(64, 3)), 1.0)
    moved = scene.clearance({"a": arms}, {"organ": torch.tensor(moves)}).bodies_mm
    back = frames.compose(bodies[0].pose, frames.invert(moves))
    carried = torch.tensor(frames.apply(back, arms.double().numpy()))
    torch.testing.assert_close(
        moved.double(), scene.clearance({"a": carried}).bodies_mm, atol=2e-4, rtol=0
    )


@pytest.mark.parametrize("away", [3.0, 20.0, 55.0, 59.0, 59.9, 61.0])
def test_a_shortened_body_is_as_near_as_its_strained_surface(on_accelerator, away):
    """A box of 30 mm that is 5 % shorter along y: its side is at 14.25 mm, up to the horizon."""
    bodies = [Body("box", "organ", box())]
    shorter = torch.diag(torch.tensor([1.0, 0.95, 1.0, 1.0], dtype=torch.float64))
    unmoved, level = torch.eye(4, dtype=torch.float64)[None], torch.zeros(1, dtype=torch.int64)
    poses = Placement({"box": unmoved[0]}, shorter[None], level, unmoved)
    across = torch.linspace(-8.0, 8.0, 9)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    line = across + torch.tensor([0.0, 0.95 * 15.0 + away + RADIUS, 0.0])
    compiled = BatchedScene(bodies, {"a": RADIUS}, most_nodes=300_000, stretch=1.0 / 0.95)
    for scene in (compiled, on_accelerator(bodies, stretch=1.0 / 0.95)):
        found = scene.clearance({"a": line[None]}, poses).bodies_mm.item()
        assert found == pytest.approx(min(away, scene.horizon_mm), abs=0.05)


def test_a_diverged_environment_stays_alone(organ_scene, on_accelerator):
    bodies, scene = organ_scene
    arms = random_arms(8, seed=5)
    clean = scene.clearance({"a": arms})
    for bad in (float("nan"), float("inf")):
        broken = arms.clone()
        broken[3, 5, 1] = bad
        for engine in (scene, on_accelerator(bodies)):
            found = engine.clearance({"a": broken})
            assert found.bodies_mm[3].isnan().all()
            assert found.self_mm[3].isnan().all()
            kept = torch.arange(8) != 3
            assert torch.equal(found.bodies_mm[kept], clean.bodies_mm[kept])


@pytest.mark.parametrize("engine", ["compiled", *ON_ACCELERATORS])
def test_arms_against_each_other_and_themselves(engine):
    scene = BatchedScene([], {"a": 3.0, "b": 4.0}, engine=engine)
    a, b = random_arms(300, seed=6, near=20, far=60), random_arms(300, seed=7, near=20, far=60)
    found = scene.clearance({"a": a, "b": b})
    ends = (a[:, :-1, None], a[:, 1:, None], b[:, None, :-1], b[:, None, 1:])
    truth = segment_distance(*(x.double() for x in ends)).flatten(1).amin(1) - 7.0
    torch.testing.assert_close(found.arms_mm[:, 0].double(), truth.clamp(max=60), atol=1e-4, rtol=0)
    checker = CollisionChecker([])
    for i in range(60):
        shapes = {"a": ArmShape(a[i].numpy(), 3.0), "b": ArmShape(b[i].numpy(), 4.0)}
        exact = checker.clearance(shapes)
        assert found.arms_mm[i, 0].item() == pytest.approx(exact.arms_mm["a", "b"], abs=1e-4)
        assert found.self_mm[i, 0].item() == pytest.approx(exact.self_mm["a"], abs=1e-4)
        named = {(c.arm, c.other) for c in checker.collisions(shapes)}
        assert (("a", "b") in named) == (found.arms_mm[i, 0].item() < 0)
    torch.testing.assert_close(
        chains_apart_torch(a, b, 7.0, 60.0), found.arms_mm[:, 0], atol=1e-3, rtol=0
    )
    folded = chains_folded_torch(a, 3.0, self_contact_gap_mm(3.0), 60.0)
    torch.testing.assert_close(folded, found.self_mm[:, 0], atol=1e-3, rtol=0)


def segment_distances(points, a, b):
    """(n,) distances of points (n, 3) from the segment a b."""
    along = b - a
    share = np.clip((points - a) @ along / max(along @ along, np.finfo(float).tiny), 0, 1)
    return np.linalg.norm(points - a - share[:, None] * along, axis=1)


TINY = 7.322554697302279e-15
"""A coordinate whose rounding turned the normal of a triangle without area, mm."""


@given(st.lists(point, min_size=5, max_size=5))
@example([(0, TINY, 0), (-7, 1, 0), (0, TINY, -7), (-7, 1, -1), (-7, 1, -1)])  # no area
@example([(0, 0, 0.1), (3, 3, 0.1), (0, 0, 0), (1, 1, 0), (3, 3, 0)])  # no area, parallel
@example([(0, 0, 0), (0, 0, 0), (1, 0, 0), (1, 0, 6.461314570663673e-300), (0, 0, 0)])  # underflow
@settings(max_examples=100, deadline=None)
def test_segment_to_triangle_is_the_least_over_dense_samples(points):
    p, q, a, b, c = (np.array(x, float) for x in points)
    exact = math.sqrt(segment_triangle_d2(tuple(p), tuple(q), tuple(a), tuple(b), tuple(c), 1e9))
    samples = np.linspace(p, q, 2001)
    with np.errstate(invalid="ignore"):
        nearest = trimesh.triangles.closest_point(np.tile([a, b, c], (len(samples), 1, 1)), samples)
    # The other library has no point of a triangle whose area underflows; its edges are all of it.
    edges = [segment_distances(samples, *edge) for edge in ((a, b), (b, c), (c, a))]
    brute = np.fmin.reduce([np.linalg.norm(nearest - samples, axis=1), *edges]).min()
    slack = math.dist(p, q) / 4000 + 1e-6
    assert brute - slack <= exact <= brute + 1e-6
    both = [torch.tensor(x)[None] for x in (p, q, np.stack((a, b, c)))]
    assert math.sqrt(segment_triangle_d2_torch(*both)) == pytest.approx(exact, abs=1e-6)


def test_tree_distances_agree_with_trimesh():
    mesh = lumpy(3)
    points = np.random.default_rng(3).normal(size=(500, 3)) * 45
    found, face = build_tree(mesh).nearest(points)
    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    nearest, truth, _ = trimesh.proximity.closest_point(solid, points)
    np.testing.assert_allclose(found, truth, atol=1e-9)
    own = trimesh.triangles.closest_point(mesh.triangles_mm[face], points)
    np.testing.assert_allclose(own, nearest, atol=1e-6)


def overlapping_balls():
    """Two closed sheets that run through each other."""
    one, two = ball(30, 3), ball(20, 3)
    faces = np.concatenate((one.faces, two.faces + len(one.vertices_mm)))
    return Mesh(np.concatenate((one.vertices_mm, np.add(two.vertices_mm, [28, 0, 0]))), faces)


@pytest.mark.parametrize("mesh", [lumpy(4), box((40, 30, 20)), overlapping_balls()])
def test_field_nodes_are_exact_in_the_band_and_rightly_signed(mesh):
    tree = build_tree(mesh)
    grid = field.build_field(mesh, 20.0, 10.0, 60_000, tree)
    index = np.stack(np.meshgrid(*map(np.arange, grid.values_mm.shape), indexing="ij"), -1)
    nodes = (grid.origin_mm + grid.cell_mm * index).reshape(-1, 3)[::7]
    values = grid.values_mm.reshape(-1)[::7].astype(float)
    distance, _ = tree.nearest(nodes)
    band = distance < grid.band_mm
    np.testing.assert_allclose(np.abs(values[band]), distance[band], atol=1e-5)
    assert (np.abs(values[~band]) >= grid.band_mm - 1e-4).all()
    assert (np.abs(values) >= distance - 1e-4).all()
    if mesh.volume_mm3 > 1e5:
        return  # solid angles over all faces are slow for the big one; two are enough
    np.testing.assert_array_equal(values < 0, winding_numbers(mesh, nodes) > 0.5)


def test_field_bounds_every_distance_by_its_slack(organ_scene):
    bodies, _ = organ_scene
    mesh = bodies[0].mesh
    tree = build_tree(mesh)
    grid = field.build_field(mesh, 15.0, 15.0, 40_000, tree)
    surface = TorchSurface(tree, grid, "cpu")
    points = np.random.default_rng(1).uniform(*mesh.bounds_mm, size=(5000, 3))
    value = surface.field_at(torch.tensor(points)).numpy()
    distance, _ = tree.nearest(points)
    close = distance < 10.0
    assert (np.abs(np.abs(value) - distance)[close] <= grid.slack_mm).all()


def test_open_meshes_have_a_field_without_inside():
    opened = Mesh(ball(20, 3).vertices_mm, ball(20, 3).faces[1:])
    assert (field.build_field(opened, 5.0, 5.0, 5000).values_mm >= 0).all()


def test_fields_are_kept_by_content_and_survive_damage(tmp_path):
    mesh = ball(20, 3)
    first = field.load_field(mesh, 5.0, 5.0, 5000, folder=tmp_path)
    (kept,) = tmp_path.iterdir()
    stamp = kept.stat().st_mtime_ns
    again = field.load_field(Mesh(mesh.vertices_mm, mesh.faces), 5.0, 5.0, 5000, folder=tmp_path)
    assert kept.stat().st_mtime_ns == stamp
    np.testing.assert_array_equal(again.values_mm, first.values_mm)
    kept.write_bytes(kept.read_bytes()[:-8] + b"\0" * 8)
    repaired = field.load_field(mesh, 5.0, 5.0, 5000, folder=tmp_path)
    np.testing.assert_array_equal(repaired.values_mm, first.values_mm)
    field.load_field(ball(21, 3), 5.0, 5.0, 5000, folder=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_cache_that_cannot_be_written_is_no_obstacle(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    found = field.load_field(ball(20, 3), 5.0, 5.0, 5000, folder=blocked / "fields")
    assert found.values_mm.min() < 0


def test_scenes_with_equal_meshes_read_one_field(tmp_path):
    """The second one reads no file; a mesh with a vertex elsewhere has another field."""
    arm = {"a": torch.tensor([[[0.0, 0.0, 30.0], [0.0, 0.0, 60.0]]], dtype=torch.float64)}

    def clearance_mm(mesh, place):
        bodies = [Body("organ", "organ", mesh)]
        engine = BatchedScene(bodies, {"a": 5.0}, most_nodes=5_000, cache=tmp_path)
        assert len(list(tmp_path.iterdir())) == place
        return float(engine.clearance(arm).least_mm)

    mesh = ball(20.0, 3)
    first = clearance_mm(mesh, 1)
    assert first == pytest.approx(5.0, abs=1e-6)
    for file in tmp_path.iterdir():
        file.unlink()
    assert clearance_mm(Mesh(mesh.vertices_mm, mesh.faces), 0) == first
    moved = np.array(mesh.vertices_mm)
    moved[np.argmax(moved[:, 2])] *= 1.1
    assert clearance_mm(Mesh(moved, mesh.faces), 1) == pytest.approx(3.0, abs=1e-6)


def test_bad_requests_are_named():
    with pytest.raises(InputError, match="radius of arm 'a' is 0"):
        BatchedScene([], {"a": 0.0})
    with pytest.raises(InputError, match="known are a"):
        BatchedScene([], {"a": 1.0}).clearance({"b": torch.zeros(1, 2, 3)})
    with pytest.raises(InputError, match="known are compiled, torch, warp"):
        BatchedScene([], {"a": 1.0}, engine="embree")
    with pytest.raises(InputError, match="runs on the CPU"):
        BatchedScene([], {"a": 1.0}, device="cuda", engine="compiled")
    with pytest.raises(InputError, match="margin"):
        field.load_field(ball(), 0.0, 1.0)


def test_a_rigid_shaft_is_as_exact_as_short_segments(organ_scene, on_accelerator):
    """A first segment of 100 mm behind the arm; sideways passes of long segments too."""
    bodies, scene = organ_scene
    checker = CollisionChecker(bodies)
    arms = random_arms(150, seed=11, near=60.0, far=110.0)
    back = frames.normalise(arms[:, 0] - arms[:, 1])
    arms = torch.cat((arms[:, :1] + 100.0 * back[:, None], arms), 1)
    arms[::2] = arms[::2].flip(0) - 60.0 * back[::2, None]
    for engine in (scene, on_accelerator(bodies)):
        found = engine.clearance({"a": arms}).bodies_mm[:, 0, 0]
        for i, line in enumerate(arms.double().numpy()):
            shapes = {"a": ArmShape(line, RADIUS)}
            truth = checker.clearance(shapes).bodies_mm["a", "organ"]
            if truth < batched.EXACT_WITHIN_MM - 0.1:
                assert found[i].item() == pytest.approx(truth, abs=1e-4)
            else:
                assert found[i].item() == pytest.approx(truth, abs=1.0)
    assert (found < 0).any()
    assert (found > 5).any()


def test_each_kind_of_overlap_is_a_collision():
    apart = torch.full((4, 2), 1.0)
    bodies, arms, own = (apart.clone() for _ in range(3))
    bodies[1, 0] = arms[2, 1] = own[3, 0] = -0.1
    found = BatchClearance(bodies[:, :, None], arms, own)
    assert found.collides.tolist() == [False, True, True, True]
    torch.testing.assert_close(found.least_mm, torch.tensor([1.0, -0.1, -0.1, 1.0]))
