"""Batched rays against FCL, closed forms, and each engine against the other."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.scene import frames
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.bvh import build_tree
from surgisoft.scene.capsules import ArmShape, ray_capsule
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.mesh import Body
from surgisoft.scene.rays import EmbreeSurface, Struck, rays_to_chains
from surgisoft.scene.torch_queries import TorchTree, rays_to_chains_torch
from tests.scene.engines import ON_ACCELERATORS
from tests.scene.shapes import arc_points, ball, box, lumpy

RANGE = 250.0


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    turned = frames.pose_from_z([4.0, -9.0, 3.0], [0.2, 0.3, 0.9], 0.4)
    beside = frames.pose_from_z([30.0, 40.0, 50.0], [1.0, 0.3, 0.9])
    bodies = [
        Body("organ", "organ", lumpy(4), turned),
        Body("vessel", "keep-out", box((12, 12, 40)), beside),
    ]
    radii, cache = {"laser": 4.0, "scope": 5.0}, tmp_path_factory.mktemp("fields")
    return bodies, BatchedScene(bodies, radii, most_nodes=50_000, cache=cache)


def random_rays(count, seed):
    rng = np.random.default_rng(seed)
    away = frames.normalise(rng.normal(size=(count, 3)))
    origins = away * rng.uniform(60, 120, (count, 1))
    aims = frames.normalise(rng.normal(size=(count, 3)) * 45 - origins)
    return torch.tensor(origins, dtype=torch.float32), torch.tensor(aims, dtype=torch.float32)


def near_silhouette(checker, origins, aims, truth):
    """Rays whose neighbours 0.02 mm beside them end on something else or far away."""
    unsure = truth.incidence_rad > math.radians(85)
    for axis in range(2):
        side = frames.rotation_from_z(aims)[..., axis] * 0.02
        for shift in (side, -side):
            beside = checker.cast(origins + shift, aims, RANGE)
            unsure |= np.abs(beside.distance_mm - truth.distance_mm) > 0.5
            unsure |= beside.struck != truth.struck
    return unsure


@pytest.mark.parametrize(
    ("x", "degrees", "hit", "certain"),
    [
        (10.0, 90.0, True, True),
        (10.0, 3.0, True, True),
        (10.0, 2.8, True, False),
        (39.98, 90.0, True, True),
        (39.995, 90.0, True, False),
        (40.0005, 90.0, False, False),
        (40.005, 90.0, False, True),
    ],
)
def test_a_hit_is_certain_off_the_edges_and_at_no_grazing_angle(x, degrees, hit, certain):
    """On the upper side of a cube of 80 mm, at an angle to it; the limits are cos 87 degrees,
    0.01 mm inside an edge and 0.001 mm outside of it."""
    cube = BatchedScene([Body("cube", "organ", box((80.0, 80.0, 80.0)))], {}, most_nodes=50_000)
    angle, place = np.radians(degrees), np.array([x, 3.0, 40.0])
    aim = np.array([[0.0, np.cos(angle), -np.sin(angle)]])
    struck, end, sure = cube.sure_hits(place - 20.0 * aim, aim, 60.0, {})
    assert bool(sure[0]) is certain
    assert (struck[0] != 0) == hit
    if hit:
        np.testing.assert_allclose(end[0], place, atol=1e-9)


def test_ten_thousand_rays_agree_with_fcl(scene):
    bodies, engine = scene
    origins, aims = random_rays(10_000, seed=1)
    found = engine.cast(origins, aims, RANGE)
    checker = CollisionChecker(bodies)
    o, d = origins.double().numpy(), aims.double().numpy()
    truth = checker.cast(o, d, RANGE)
    gap = np.linalg.norm(found.point_mm.double().numpy() - truth.point_mm, axis=1)
    apart = np.flatnonzero((gap > 0.001) | (found.struck.numpy() != truth.struck))
    assert len(apart) < 20
    subset = type(truth)(*(getattr(truth, f)[apart] for f in truth.__dataclass_fields__))
    silhouette = near_silhouette(checker, o[apart], d[apart], subset)
    assert (gap[apart][~silhouette] < 0.02).all()
    assert (found.struck.numpy()[apart] == truth.struck[apart])[~silhouette].all()
    agree = np.setdiff1d(np.arange(len(o)), apart)
    cosine = frames.dot(found.normal.double().numpy(), truth.normal)[agree]
    assert (cosine > 1 - 1e-6).mean() > 0.999
    steep = np.abs(found.incidence_rad.double().numpy() - truth.incidence_rad)[agree]
    assert (steep < 1e-4).mean() > 0.999
    kinds = set(truth.struck.tolist())
    assert {Struck.NOTHING, Struck.ORGAN, Struck.KEEP_OUT} == kinds


def hook():
    """A centreline that turns by 270 degrees and looks at its own stem."""
    turn = np.linspace(math.pi, -math.pi / 2, 40)
    bow = np.stack((14 + 14 * np.cos(turn), 0 * turn, 40 + 14 * np.sin(turn)), axis=1)
    return np.concatenate((arc_points(40.0, 0.0, 20), bow[1:]))


def lasers(count, rng):
    away = frames.normalise(rng.normal(size=(count, 3)))
    return frames.pose_from_z(away * 150, -away + 0.4 * rng.normal(size=(count, 3)))


@pytest.mark.parametrize("name", ["compiled", *ON_ACCELERATORS])
def test_arms_in_the_way_agree_with_fcl(scene, name, tmp_path):
    bodies, _ = scene
    radii = {"laser": 4.0, "scope": 5.0}
    engine = BatchedScene(bodies, radii, most_nodes=5_000, cache=tmp_path, engine=name)
    rng = np.random.default_rng(3)
    count = 400
    origins, aims = random_rays(count, seed=4)
    across = (
        aims.double().numpy() * rng.uniform(5, 80, (count, 1)) + rng.normal(size=(count, 3)) * 4
    )
    scopes = frames.pose_from_z(origins.double().numpy() + across, rng.normal(size=(count, 3)))
    middle = arc_points(70.0, 1.2, 15) - arc_points(70.0, 1.2, 15)[7]
    lines = {
        "scope": torch.tensor(frames.apply(scopes, np.tile(middle, (count, 1, 1)))),
        "laser": torch.tensor(frames.apply(lasers(count, rng), np.tile(hook(), (count, 1, 1)))),
    }
    tip, tangent = lines["laser"][:, -1], lines["laser"][:, -1] - lines["laser"][:, -2]
    half = torch.arange(count)[:, None] % 2 == 0
    origins = torch.where(half, tip, origins.double())
    aims = torch.where(half, tangent, aims.double())
    found = engine.cast(origins, aims, RANGE, lines, own="laser")
    checker = CollisionChecker(bodies)
    for i in range(count):
        arms = {n: ArmShape(v[i].numpy(), engine.radii_mm[n]) for n, v in lines.items()}
        truth = checker.cast(origins[i].numpy(), aims[i].numpy(), RANGE, arms, "laser")
        assert found.struck[i].item() == truth.struck
        assert found.distance_mm[i].item() == pytest.approx(float(truth.distance_mm), abs=1e-3)
        np.testing.assert_allclose(found.normal[i], truth.normal, atol=1e-3)
    assert (found.struck == Struck.OTHER_ARM).sum() > 50
    assert (found.struck == Struck.OWN_ARM).sum() > 50


def test_embree_and_torch_name_the_same_hits():
    mesh = lumpy(4)
    tree = build_tree(mesh)
    origins, aims = (x.double() for x in random_rays(3000, seed=5))
    t_embree, f_embree = EmbreeSurface(mesh).first_hit(origins.numpy(), aims.numpy(), RANGE)
    t, f = TorchTree(tree, "cpu").first_hit(origins, aims, torch.full((3000,), RANGE).double())
    same = f.numpy() == f_embree
    assert same.mean() > 0.999
    np.testing.assert_allclose(t.numpy()[same], t_embree[same], atol=1e-9)


def test_rays_of_any_leading_shape_keep_it(scene):
    _, engine = scene
    origins, aims = random_rays(24, seed=6)
    flat = engine.cast(origins, aims, RANGE)
    folded = engine.cast(origins.view(2, 3, 4, 3), aims.view(2, 3, 4, 3), RANGE)
    assert folded.point_mm.shape == (2, 3, 4, 3)
    assert folded.point_mm.dtype == torch.float32
    assert torch.equal(folded.distance_mm.flatten(), flat.distance_mm)


def test_misses_are_finite_and_broken_rays_stay_alone(scene):
    _, engine = scene
    origins, aims = random_rays(6, seed=7)
    clean = engine.cast(origins, aims, RANGE)
    away = engine.cast(origins, origins, RANGE)
    assert away.missed.all()
    assert (away.distance_mm == RANGE).all()
    assert away.point_mm.isfinite().all()
    assert (away.face == -1).all()
    broken = aims.clone()
    broken[2] = float("nan")
    found = engine.cast(origins, broken, RANGE)
    assert found.missed[2]
    kept = torch.arange(6) != 2
    assert torch.equal(found.distance_mm[kept], clean.distance_mm[kept])


def test_a_moved_body_is_hit_where_it_went(scene):
    bodies, engine = scene
    origins, aims = random_rays(50, seed=8)
    lift = frames.pose_from(np.eye(3), [0.0, 0.0, 7.0])
    moves = torch.tensor(np.stack([frames.compose(lift, b.pose) for b in bodies]))
    poses = {b.name: moves[i].expand(50, 4, 4) for i, b in enumerate(bodies)}
    moved = engine.cast(origins + torch.tensor([0, 0, 7.0]), aims, RANGE, poses=poses)
    still = engine.cast(origins, aims, RANGE)
    torch.testing.assert_close(moved.distance_mm, still.distance_mm, atol=1e-3, rtol=0)


number = st.floats(-20, 20)
point = st.tuples(number, number, number)


@given(point, point, point, point, st.floats(0.5, 6))
@settings(max_examples=150, deadline=None)
def test_capsule_entry_is_where_the_distance_to_its_axis_is_the_radius(o, aim, a, b, radius):
    o, aim, a, b = (np.array(x, dtype=float) for x in (o, aim, a, b))
    if np.linalg.norm(aim - o) < 1e-3:
        return
    direction = frames.normalise(aim - o)
    t = float(ray_capsule(o, direction, a, b, radius))
    steps = np.linspace(0, 80, 4001)
    gaps = axis_distance(o + steps[:, None] * direction, a, b) - radius
    if gaps[0] <= 0:
        assert t == 0.0
    elif math.isinf(t):
        assert gaps.min() > -1e-4
    else:
        assert axis_distance(o + t * direction, a, b) == pytest.approx(radius, abs=1e-6)
        assert (gaps[steps < t - 1e-6] > 0).all()
    compiled, segment = np.full((1, 1), np.inf), np.zeros((1, 1), np.int64)
    rays_to_chains(
        o[None, None],
        direction[None, None],
        np.stack((a, b))[None],
        radius,
        -1.0,
        compiled,
        segment,
    )
    assert compiled.item() == pytest.approx(t, abs=1e-6) or abs(gaps.min()) < 1e-4


def axis_distance(points, a, b):
    share = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0, 1)
    return np.linalg.norm(points - a - share[..., None] * (b - a), axis=-1)


def test_torch_and_compiled_rays_meet_the_same_capsules():
    lines = torch.tensor(np.stack([arc_points(70, bend, 20) for bend in np.linspace(-5, 5, 40)]))
    rng = np.random.default_rng(0)
    origins = torch.tensor(rng.normal(size=(40, 50, 3)) * 50)
    aims = frames.normalise(torch.tensor(rng.normal(size=(40, 50, 3)) * 20) - origins)
    best = torch.full((40, 50), 100.0, dtype=torch.float64)
    for gap in (-1.0, 15.0):
        t, segment = rays_to_chains_torch(origins, aims, lines, 4.0, gap, best)
        distance, place = best.numpy().copy(), np.zeros((40, 50), np.int64)
        rays_to_chains(origins.numpy(), aims.numpy(), lines.numpy(), 4.0, gap, distance, place)
        np.testing.assert_allclose(t.numpy(), distance, atol=1e-6)
        hit = (distance < 100.0) & (distance > 0.0)
        assert hit.sum() > 100
        assert (segment.numpy() == place)[hit].mean() > 0.99


def test_ball_hits_follow_the_sphere():
    engine = BatchedScene([Body("ball", "organ", ball(50.0, 5))], {}, most_nodes=20_000)
    origins, aims = random_rays(2000, seed=9)
    found = engine.cast(origins.double(), aims.double(), RANGE)
    o, d = origins.double(), frames.normalise(aims.double())
    half, beyond = frames.dot(o, d), frames.dot(o, o) - 2500.0
    square = half**2 - beyond
    truth = -half - square.clamp(min=0).sqrt()
    direct = (square > 100.0) & (truth > 0.0)
    assert direct.sum() > 500
    assert found.on_organ[direct].all()
    assert (found.distance_mm - truth)[direct].abs().max() < 0.1
    assert (found.distance_mm - truth)[direct].min() > -1e-6
