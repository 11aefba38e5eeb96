"""The batched pictures against closed forms and against the replay's renderer."""

import math

import numpy as np
import pytest
import torch

from surgisoft.scene import frames
from surgisoft.scene.camera import Camera
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.images import BatchedRenderer, Label, TissueMarks
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.render import SAMPLE_MM, Renderer
from tests.scene.shapes import arc_points, box, lumpy

PIXELS = 64
CAMERA = Camera(math.radians(70.0), (10.0, 100.0))
FOCAL = 0.5 * PIXELS / math.tan(math.radians(35.0))


def rays():
    """(H, W, 3) of the pixels' centres, 1 along the axis."""
    x = (np.arange(PIXELS) + 0.5 - 0.5 * PIXELS) / FOCAL
    return np.stack((*np.meshgrid(x, x), np.ones((PIXELS, PIXELS))), -1)


def in_circle():
    x = np.arange(PIXELS) + 0.5 - 0.5 * PIXELS
    return np.hypot(*np.meshgrid(x, x)) <= 0.5 * PIXELS


def floor(height_mm=0.0):
    """A square of 400 mm at a height."""
    corners = np.array([[-200.0, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]])
    mesh = Mesh(corners + np.array([0.0, 0.0, height_mm]), np.array([[0, 1, 2], [0, 2, 3]]))
    return Body("floor", "organ", mesh)


def seen_from(*eyes, at=(0.0, 0.0, 0.0)):
    return torch.tensor(np.stack([frames.look_at(np.array(eye), np.array(at)) for eye in eyes]))


def test_depth_of_a_plane():
    """From above, and from close to it, where the plane reaches behind the camera."""
    above = seen_from((20.0, -10.0, 60.0), (30.0, 5.0, 80.0))
    low = seen_from((-100.0, 0.0, 20.0), at=(-40.0, 3.0, 0.0))
    poses = torch.cat((above, low))
    depth = BatchedRenderer([floor()], {}, CAMERA).draw(poses).depth_mm[..., 0].numpy()
    for pose, found in zip(poses.numpy(), depth, strict=True):
        aims = rays() @ pose[:3, :3].T
        expected = np.where(aims[..., 2] < 0.0, -pose[2, 3] / aims[..., 2], 0.0)
        met = pose[:3, 3] + expected[..., None] * aims
        expected *= in_circle() & (np.abs(met[..., :2]) <= 200.0).all(-1)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_depth_of_a_ball_and_nothing_around_it():
    """An arm of no length is a ball: its depth is the smaller root of a quadratic equation."""
    centre, radius = np.array([3.0, -2.0, 10.0]), 9.0
    poses = seen_from((25.0, 15.0, 70.0))
    line = torch.tensor(np.stack((centre, centre + 1e-9)))[None]
    drawn = BatchedRenderer([floor(-400.0)], {"ball": radius}, CAMERA).draw(poses, {"ball": line})
    inward = np.linalg.inv(poses[0].numpy())
    c, d = inward[:3, :3] @ centre + inward[:3, 3], rays()
    a, b = (d * d).sum(-1), d @ c
    root = b * b - a * (c @ c - radius**2)
    expected = np.where(root >= 0.0, (b - np.sqrt(root.clip(0.0))) / a, 0.0)
    assert 100 < (root >= 0.0).sum() < 1500
    np.testing.assert_allclose(drawn.depth_mm[0, ..., 0].numpy(), expected * in_circle(), rtol=1e-6)
    labels = np.where(root >= 0.0, Label.OTHER_ARM, Label.NOTHING) * in_circle()
    np.testing.assert_array_equal(drawn.labels[0, ..., 0].numpy(), labels)


def test_labels_of_a_capsule_before_a_plane():
    """A pixel shows the arm where its ray comes nearer to the arm's axis than the radius."""
    ends, radius = np.array([[-15.0, 4.0, 20.0], [25.0, -8.0, 12.0]]), 5.0
    poses = seen_from((5.0, -30.0, 70.0))
    drawn = BatchedRenderer([floor()], {"arm": radius}, CAMERA).draw(
        poses, {"arm": torch.tensor(ends)[None]}, kinds=("segmentation",)
    )
    assert drawn.rgb is None
    assert drawn.depth_mm is None
    aims = frames.normalise(rays() @ poses[0, :3, :3].numpy().T).reshape(-1, 3)
    axis = ends[0] + np.linspace(0.0, 1.0, 4001)[:, None] * (ends[1] - ends[0])
    off = axis - poses[0, :3, 3].numpy()
    near = np.array([np.sqrt((off**2).sum(1) - (off @ aim) ** 2).min() for aim in aims])
    sure = (np.abs(near - radius) > 1e-3) & in_circle().ravel()
    expected = np.where(near < radius, Label.OTHER_ARM, Label.ORGAN)
    found = drawn.labels[0, ..., 0].numpy().ravel()
    assert 200 < (found == Label.OTHER_ARM).sum() < 2000
    np.testing.assert_array_equal(found[sure], expected[sure])


@pytest.fixture(scope="module")
def theatre():
    """An organ, a box beside it, two arms and a beam; cameras far, near and inside the organ."""
    aside = frames.pose_from_z([40.0, -60.0, 50.0], [0.3, 0.1, 1.0])
    bodies = [Body("organ", "organ", lumpy()), Body("box", "keep-out", box(), aside)]
    eyes = [(30.0, -90.0, 90.0), (70.0, 20.0, 40.0), (0.0, 0.0, 5.0), (-20.0, -40.0, 70.0)]
    poses = seen_from(*eyes, at=(5.0, -10.0, 20.0))
    home = frames.pose_from_z([20.0, -70.0, 40.0], [-0.2, 0.5, 0.6])
    tool = [arc_points(60.0, 0.2 + 0.3 * k, 12, home) for k in range(4)]
    behind = [arc_points(70.0, 0.8, 12, np.diag([1.0, 1, -1, 1])) for _ in range(4)]
    own = [
        (line - line[-1]) @ p[:3, :3].T + p[:3, 3]
        for line, p in zip(behind, poses.numpy(), strict=True)
    ]
    arms = {"tool": torch.tensor(np.stack(tool)), "own": torch.tensor(np.stack(own))}
    beams = torch.stack((arms["tool"][:, -1], torch.tensor([[5.0, -10.0, 25.0]]).expand(4, 3)), 1)
    return bodies, poses, arms, beams[:, None], {"tool": 4.0, "own": 6.0}


def test_pixels_are_those_of_the_replay(theatre):
    bodies, poses, arms, beams, radii = theatre
    lit = torch.tensor([[True], [False], [True], [True]])
    drawn = BatchedRenderer(bodies, radii, CAMERA).draw(poses, arms, "own", beams, lit)
    slow = Renderer(bodies, CAMERA, PIXELS, PIXELS)
    for b in range(4):
        shapes = {name: ArmShape(line[b].numpy(), radii[name]) for name, line in arms.items()}
        ends = beams[b].numpy() if lit[b] else None
        picture = slow.image(poses[b].numpy(), shapes, "own", ends)
        off = np.abs(picture.astype(int) - drawn.rgb[b].numpy().astype(int)).max(-1)
        assert (off > 1).mean() < 1e-3
    kinds = set(drawn.labels.unique().tolist())
    assert kinds >= {Label.NOTHING, Label.ORGAN, Label.KEEP_OUT, Label.OTHER_ARM}


def test_each_row_alone_gives_the_same_picture(theatre):
    """And rows in two threads; a camera that is not finite is black and disturbs none."""
    bodies, poses, arms, beams, radii = theatre
    renderer, lit = BatchedRenderer(bodies, radii, CAMERA), torch.ones(4, 1, dtype=torch.bool)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        poses = poses.clone()
        poses[2, 0, 0] = torch.nan
        whole = renderer.draw(poses, arms, "own", beams, lit)
    finally:
        torch.set_num_threads(before)
    for b in (0, 1, 3):
        row = slice(b, b + 1)
        one = {name: line[row] for name, line in arms.items()}
        alone = renderer.draw(poses[row], one, "own", beams[row], lit[row])
        for kind in ("rgb", "depth", "segmentation"):
            torch.testing.assert_close(whole.of(kind)[row], alone.of(kind), rtol=0, atol=0)
    assert whole.rgb[2].max() == 0
    assert whole.depth_mm[2].max() == 0.0


def test_a_moved_and_strained_organ_is_drawn_where_it_is(theatre):
    """Each row has its own map; the truth is a scene with the organ's mesh mapped by hand."""
    bodies, poses, arms, _, radii = theatre
    turn = frames.rotation_from_axis_angle(np.array([0.3, 1.0, 0.2]), 0.2)
    strain = turn @ np.diag([1.1, 1.0, 0.9])
    maps = np.stack(
        [frames.pose_from(m, [4.0, 2.0, -3.0 * k]) for k, m in enumerate((turn, strain))]
    )
    pair = {name: line[:2] for name, line in arms.items()}
    renderer = BatchedRenderer(bodies, radii, CAMERA)
    moved = renderer.draw(poses[:2], pair, "own", bodies={"organ": torch.tensor(maps)})
    still = renderer.draw(poses[:2], pair, "own")
    assert (moved.depth_mm - still.depth_mm).abs().max() > 1.0
    for k in range(2):
        mesh = bodies[0].mesh
        mapped = Mesh(frames.apply(maps[k], mesh.vertices_mm), mesh.faces)
        truth = BatchedRenderer([Body("organ", "organ", mapped), bodies[1]], radii, CAMERA)
        row = slice(k, k + 1)
        by_hand = truth.draw(poses[row], {n: line[row] for n, line in pair.items()}, "own")
        torch.testing.assert_close(moved.depth_mm[row], by_hand.depth_mm, rtol=1e-5, atol=1e-4)
        off = (moved.rgb[row].int() - by_hand.rgb.int()).abs().amax(-1)
        assert (off > (1, 12)[k]).double().mean() < 2e-3


def test_depth_of_a_plane_in_a_wide_picture():
    """The shorter side has the camera's field of view; pixels are square; corners are black."""
    poses = seen_from((20.0, -10.0, 60.0))
    for width, height in ((96, 64), (64, 96)):
        x, y = (np.arange(n) + 0.5 - 0.5 * n for n in (width, height))
        aims = np.stack((*np.meshgrid(x / FOCAL, y / FOCAL), np.ones((height, width))), -1)
        aims = aims @ poses[0, :3, :3].numpy().T
        expected = np.where(aims[..., 2] < 0.0, -60.0 / aims[..., 2], 0.0)
        met = poses[0, :3, 3].numpy() + expected[..., None] * aims
        expected *= (np.abs(met[..., :2]) <= 200.0).all(-1)
        for round_view in (True, False):
            renderer = BatchedRenderer([floor()], {}, CAMERA, width, height, round_view=round_view)
            inside = np.hypot(*np.meshgrid(x, y)) <= 32.0
            found = renderer.draw(poses).depth_mm[0, ..., 0].numpy()
            np.testing.assert_allclose(found, expected * (inside | (not round_view)), rtol=1e-6)


def test_labels_of_a_lesion_and_of_what_is_ablated():
    """A pixel has the mark of the nearest sample within reach: 0.5 mm apart, two alternatives."""
    grid = np.arange(-8.0, 8.25, 0.5)
    points = np.stack((*np.meshgrid(grid, grid), np.zeros((33, 33))), -1).reshape(-1, 3)
    lesion = np.stack((points[:, 0] < 0.0, points[:, 1] < 0.0))
    marks = TissueMarks(
        "floor", points, np.full(3, -20.0), 40.0, (1, 1, 1), np.array([0, len(points)]), lesion, 2.0
    )
    poses = seen_from((3.0, -4.0, 40.0), (3.0, -4.0, 40.0))
    dose = torch.tensor(np.stack((2.0 - 0.2 * points[:, 1], 2.0 + 0.2 * points[:, 0])))
    drawn = BatchedRenderer([floor()], {}, CAMERA, marks=marks).draw(
        poses, dose=dose, lesion=torch.tensor([0, 1]), kinds=("segmentation", "depth")
    )
    aims = rays() @ poses[0, :3, :3].numpy().T
    met = poses[0, :3, 3].numpy() - 40.0 / aims[..., 2:] * aims
    away = np.linalg.norm(met[:, :, None, :2] - points[:, :2], axis=-1)
    nearest, within = away.argmin(-1), away.min(-1) < SAMPLE_MM
    sure = np.diff(np.sort(away, -1)[..., :2])[..., 0] > 1e-6
    for b in range(2):
        expected = np.where(within & lesion[b][nearest], Label.LESION, Label.ORGAN)
        expected = np.where(within & (dose[b].numpy()[nearest] >= 2.0), Label.ABLATED, expected)
        expected = np.where(in_circle(), expected, Label.NOTHING)
        found = drawn.labels[b, ..., 0].numpy()
        assert {Label.LESION, Label.ABLATED, Label.ORGAN} <= set(found.ravel().tolist())
        np.testing.assert_array_equal(found[sure], expected[sure])


def test_the_arm_that_carries_the_camera_is_labelled_as_its_own():
    """Two bends behind its tip it comes into view again; next to the tip it is not drawn."""
    line = torch.tensor(
        [[-15.0, 4.0, 20.0], [25.0, -8.0, 12.0], [5.0, 40.0, 90.0], [5.0, -30.0, 70.0]]
    )
    renderer = BatchedRenderer([floor()], {"arm": 5.0}, CAMERA)
    poses, arms = seen_from((5.0, -30.0, 70.0)), {"arm": line[None].double()}
    own, other = (
        renderer.draw(poses, arms, name, kinds=("segmentation",)).labels[0, ..., 0]
        for name in ("arm", None)
    )
    assert 200 < (own == Label.OWN_ARM).sum() < 2000
    assert not (own == Label.OTHER_ARM).any()
    assert not (other == Label.OWN_ARM).any()
    assert (other == Label.OTHER_ARM).sum() > (own == Label.OWN_ARM).sum()
