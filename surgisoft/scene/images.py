"""Endoscope pictures of many environments at once: colour, depth and labels, compiled for the CPU.

`BatchedRenderer` draws what `render.Renderer` draws, with the same light and colours. A pixel's ray
meets the same triangles, capsules and beams; no part of the geometry is simplified. The bodies are
rasterised in homogeneous coordinates (Olano & Greer 1997), so that faces that reach behind the
camera need no clipping: boxes of the tree beside the picture are left out, and each face that is
left tests the pixels that it can cover. Arms are closed forms for each pixel, within their bounds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from surgisoft.compiled import compiled
from surgisoft.errors import InputError
from surgisoft.scene.bvh import STACK, tree_of
from surgisoft.scene.camera import Camera
from surgisoft.scene.capsules import self_contact_gap_mm
from surgisoft.scene.mesh import Body
from surgisoft.scene.moving import Placement
from surgisoft.scene.rays import Struck, capsule_entry, struck_of
from surgisoft.scene.render import (
    ARM_COLOUR,
    BACKGROUND,
    BEAM_COLOUR,
    BEAM_RADIUS_MM,
    BLANCHED_LINEAR,
    BODY_COLOURS,
    CHARRED_LINEAR,
    LAMP_HALF_MM,
    LESION_LINEAR,
    LESION_TINT,
    SAMPLE_MM,
    corner_normals,
    pixel_rays,
)
from surgisoft.threads import over_rows


class Label(IntEnum):
    """Class of a pixel: the values of `rays.Struck`, and two kinds of the organ's tissue."""

    NOTHING = int(Struck.NOTHING)
    ORGAN = int(Struck.ORGAN)
    KEEP_OUT = int(Struck.KEEP_OUT)
    SUPPORT = int(Struck.SUPPORT)
    OTHER_ARM = int(Struck.OTHER_ARM)
    OWN_ARM = int(Struck.OWN_ARM)
    LESION = 6
    ABLATED = 7


_LESION, _ABLATED = int(Label.LESION), int(Label.ABLATED)
NEAR_MM = 1e-3
"""Faces all of whose corners lie farther in front of the camera than this are bounded by the
picture of their corners; the others test every pixel (mm)."""
DARKEST_GLOW = 40.0
"""A beam's glow below exp(-this) is left out: 4e-18 of full brightness."""
GAMMA = 2.2
"""Exponent of the film, as in `render.Renderer`."""
IMAGES = 8
"""Environments that a thread draws at a time (a count): a picture takes about a millisecond."""
LEVELS = 4096
"""Entries of the table that finds the 8-bit value of a linear brightness; the table's guess is
then corrected to the exact value."""


@dataclass(frozen=True, eq=False)
class TissueMarks:
    """Where the organ's surface carries a lesion and a dose; P samples, K alternative lesions."""

    body: str
    """Name of the body."""
    points_mm: np.ndarray
    """(P, 3) float64 mm, world frame at rest, sorted by bucket."""
    origin_mm: np.ndarray
    """(3,) mm: lowest corner of the buckets' grid."""
    cell_mm: float
    """Edge of a bucket (mm)."""
    shape: tuple[int, int, int]
    """Buckets along each axis."""
    starts: np.ndarray
    """(X Y Z + 1,) int64: each bucket's first sample."""
    lesion: np.ndarray
    """(K, P) bool: inside the ring of each alternative."""
    threshold: float
    """Dose from which a place is ablated, in the unit of the dose."""


NO_MARKS = TissueMarks(
    "",
    np.zeros((0, 3)),
    np.zeros(3),
    1.0,
    (0, 0, 0),
    np.zeros(1, np.int64),
    np.zeros((1, 0), bool),
    1.0,
)
"""An organ without lesion and dose."""


@dataclass(frozen=True, eq=False)
class Images:
    """Pictures of B environments; None for a kind that was not asked for."""

    rgb: Tensor | None
    """(B, H, W, 3) uint8."""
    depth_mm: Tensor | None
    """(B, H, W, 1) float32 mm along the camera's axis; 0 where nothing is met, and outside of the
    round picture."""
    labels: Tensor | None
    """(B, H, W, 1) uint8, a `Label`; NOTHING outside of the round picture."""

    def of(self, kind: str) -> Tensor:
        """The pictures of a kind among those that were asked for."""
        found = {"rgb": self.rgb, "depth": self.depth_mm, "segmentation": self.labels}[kind]
        if found is None:
            raise InputError(f"pictures of kind '{kind}' were not drawn; name it in kinds")
        return found


KINDS = ("rgb", "depth", "segmentation")
"""The kinds of pictures."""


class BatchedRenderer:
    """Draws pictures of a fixed set of bodies from many cameras; built once, holds no state."""

    def __init__(
        self,
        bodies: Sequence[Body],
        radii_mm: Mapping[str, float],
        camera: Camera,
        width: int = 64,
        height: int = 64,
        marks: TissueMarks | None = None,
        round_view: bool = True,
    ):
        """marks: lesion and dose on one of the bodies; round_view: whether the corners are black,
        as in an endoscope's picture."""
        self._names = [body.name for body in bodies]
        self._homes = [torch.tensor(np.array(body.pose)) for body in bodies]
        self._radii = dict(radii_mm)
        self._marks = marks or NO_MARKS
        if marks and marks.body not in self._names:
            raise InputError(f"marks are on body '{marks.body}', expected one of {self._names}")
        focal = 0.5 * min(width, height) / math.tan(0.5 * camera.fov_rad)
        _, inside = pixel_rays(camera, width, height)
        self.width, self.height = width, height
        self._inside = inside.reshape(height, width) | (not round_view)
        self._lens = (focal, 4.0 * camera.range_mm[1], LAMP_HALF_MM)
        self._bodies = _joined_trees(bodies)
        self._marked = _marked_faces(self._bodies[0], self._marks.points_mm)
        self._film = film_table()

    def draw(
        self,
        poses: Tensor,
        arms: Mapping[str, Tensor] | None = None,
        own: str | None = None,
        beams_mm: Tensor | None = None,
        lit: Tensor | None = None,
        bodies: Mapping[str, Tensor] | Placement | None = None,
        dose: Tensor | None = None,
        lesion: Tensor | None = None,
        kinds: Sequence[str] = KINDS,
    ) -> Images:
        """Pictures from the cameras at poses (B, 4, 4), world frame; all tensors on the CPU.

        arms: name -> (B, K, 3) mm; `own` carries the camera. beams_mm (B, L, 2, 3) mm: ends of the
        beams, which shine where lit (B, L) bool. bodies: name -> (B, 4, 4), body to world, affine;
        a body without an entry stands where the scene puts it. dose (B, P): of the marks' samples;
        lesion (B,) int64: number of the lesion. An environment that is not finite is black.
        """
        poses = poses.detach().double()
        count = len(poses)
        inward = torch.linalg.inv(torch.where(_finite(poses)[:, None, None], poses, torch.eye(4)))
        maps = torch.stack([self._map(inward, n, bodies) for n in range(len(self._names))])
        names = list(arms or {})
        lines = [(arms or {})[name].detach().double() for name in names]
        ok = _finite(poses)
        for part in (*lines, maps.movedim(1, 0)):
            ok = ok & _finite(part)
        line = torch.cat(lines, 1) if lines else torch.zeros((count, 0, 3), dtype=torch.float64)
        chains = (
            line.contiguous().numpy(),
            np.cumsum([0, *(part.shape[1] for part in lines)]),
            np.array([self._radii[name] for name in names], float),
            np.array([self_contact_gap_mm(self._radii[n]) if n == own else -1.0 for n in names]),
            np.array([Label.OWN_ARM if n == own else Label.OTHER_ARM for n in names], np.int64),
        )
        if beams_mm is None or lit is None:
            beams_mm, lit = torch.zeros((count, 0, 2, 3)), torch.zeros((count, 0), dtype=torch.bool)
        beams = (beams_mm.detach().double().contiguous().numpy(), lit.contiguous().numpy())
        marks = self._marks
        ring = torch.zeros(count, dtype=torch.int64) if lesion is None else lesion
        if dose is None:
            dose = torch.zeros((count, len(marks.points_mm)))
        tissue = (
            self._names.index(marks.body) if marks.body else -1,
            marks.points_mm,
            marks.origin_mm,
            marks.cell_mm,
            marks.shape,
            marks.starts,
            marks.lesion,
            marks.threshold,
            ring.contiguous().numpy(),
            dose.detach().float().contiguous().numpy(),
            self._marked,
        )
        shape = (self.height, self.width)
        rgb = torch.zeros((count if "rgb" in kinds else 0, *shape, 3), dtype=torch.uint8)
        depth = torch.zeros((count if "depth" in kinds else 0, *shape, 1))
        labels = torch.zeros(
            (count if "segmentation" in kinds else 0, *shape, 1), dtype=torch.uint8
        )
        out = (rgb.numpy(), depth.numpy(), labels.numpy())
        cameras = (inward.contiguous().numpy(), maps.contiguous().numpy(), ok.numpy())
        given = (cameras, self._lens, self._inside, self._film, self._bodies, chains, beams, tissue)
        over_rows(count, lambda rows: draw_rows(rows.start, rows.stop, *given, *out), IMAGES)
        found = zip(KINDS, (rgb, depth, labels), strict=True)
        return Images(*(one if kind in kinds else None for kind, one in found))

    def _map(
        self, inward: Tensor, n: int, bodies: Mapping[str, Tensor] | Placement | None
    ) -> Tensor:
        """(B, 4, 4): a body's place at rest, world frame, to the cameras' frames."""
        now = None if bodies is None else bodies.get(self._names[n])
        if now is None:
            return inward
        return inward @ now.detach().cpu().double() @ torch.linalg.inv(self._homes[n])


def _finite(values: Tensor) -> Tensor:
    """(B,) bool: all values of an environment are finite."""
    return values.flatten(1).isfinite().all(1)


def _joined_trees(bodies: Sequence[Body]) -> tuple[np.ndarray, ...]:
    """The bodies' trees one after another, world frame at rest, with each face's shading.

    Triangles and corner normals (F, 3, 3) in tree order; starts of the leaves as places among all
    faces, boxes lower and upper; first leaf start and first node of each body (N + 1,); colours
    (N, 3) and labels (N,).
    """
    triangles, normals, starts, lower, upper = [], [], [], [], []
    first_start, first_node, faces = [0], [0], 0
    for body in bodies:
        mesh = body.world_mesh
        tree = tree_of(mesh)
        triangles.append(tree.triangles_mm)
        normals.append(corner_normals(mesh)[tree.order])
        starts.append(tree.starts + faces)
        lower.append(tree.lower)
        upper.append(tree.upper)
        faces += len(tree.order)
        first_start.append(first_start[-1] + len(tree.starts))
        first_node.append(first_node[-1] + len(tree.lower))
    return (
        np.concatenate(triangles),
        np.concatenate(normals),
        np.concatenate(starts),
        np.concatenate(lower),
        np.concatenate(upper),
        np.array(first_start),
        np.array(first_node),
        np.array([BODY_COLOURS[body.role] for body in bodies]),
        np.array([int(struck_of(body)) for body in bodies], np.int64),
    )


def _marked_faces(triangles: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """(F,) bool: faces (F, 3, 3) mm some point of which can lie within SAMPLE_MM of a sample."""
    if not len(samples):
        return np.zeros(len(triangles), bool)
    middles = triangles.mean(axis=1)
    size = np.linalg.norm(triangles - middles[:, None], axis=2).max(axis=1)
    reach = size + SAMPLE_MM
    # Most faces lie outside of the box around all samples by more than their own reach.
    outside = np.maximum(samples.min(0) - middles, middles - samples.max(0)).clip(min=0.0)
    near = np.linalg.norm(outside, axis=1) <= reach
    near[near] = cKDTree(samples).query(middles[near])[0] <= reach[near]
    return near


def film_table() -> tuple[np.ndarray, np.ndarray]:
    """Guess (LEVELS + 1,) of the 8-bit value by linear brightness, and each value's least (257,).

    A brightness x has the value floor(255 x^(1 / gamma) + 0.5), so the value v begins at
    ((v - 0.5) / 255)^gamma.
    """
    x = np.arange(LEVELS + 1) / LEVELS
    guess = (255.0 * x ** (1.0 / GAMMA) + 0.5).astype(np.int64)
    least = (np.maximum(np.arange(257) - 0.5, 0.0) / 255.0) ** GAMMA
    least[0], least[256] = -np.inf, np.inf
    return guess, least


@compiled
def draw_rows(
    first, last, cameras, lens, inside, film, bodies, chains, beams, tissue, rgb, depth, labels
):
    """Draw the pictures of environments first to last - 1; see `BatchedRenderer.draw`."""
    inward, maps, finite = cameras
    focal, farthest, _ = lens
    height, width = inside.shape
    xs, ys = np.empty(width), np.empty(height)
    for j in range(width):
        xs[j] = (j + 0.5 - 0.5 * width) / focal
    for i in range(height):
        ys[i] = (i + 0.5 - 0.5 * height) / focal
    far, z = np.empty((height, width)), np.empty((height, width))
    for i in range(height):
        for j in range(width):
            far[i, j] = farthest / math.sqrt(xs[j] * xs[j] + ys[i] * ys[i] + 1.0)
    who, place = np.empty((height, width), np.int64), np.empty((height, width), np.int64)
    share = np.empty((height, width, 2))
    stack, planes = np.empty(STACK, np.int64), np.empty((5, 4))
    count = len(bodies[7])
    for b in range(first, last):
        if not finite[b]:
            continue
        for i in range(height):
            for j in range(width):
                z[i, j] = far[i, j]
        who[:] = -1
        for n in range(count):
            _raster_body(maps[n, b], bodies, n, focal, xs, ys, z, who, place, share, stack, planes)
        for a in range(len(chains[2])):
            _raster_arm(inward[b], chains, a, b, count, focal, xs, ys, z, who, place)
        if len(depth) > 0:
            for i in range(height):
                for j in range(width):
                    if inside[i, j] and who[i, j] >= 0:
                        depth[b, i, j, 0] = z[i, j]
        _develop(
            b, cameras, lens, inside, film, bodies, chains, beams, tissue, xs, ys, z, who, place,
            share, rgb, labels
        )  # fmt: skip


@compiled(inner=True)
def _raster_body(m, bodies, number, focal, xs, ys, z, who, place, share, stack, planes):
    """Keep the faces of a body that are nearest at the pixels' centres.

    m (4, 4): the body at rest to the camera. Writes depth z (mm along the axis), who (the body's
    number), place (the face) and share (barycentric coordinates of the second and third corner).
    """
    triangles, _, all_starts, all_lower, all_upper, first_start, first_node = bodies[:7]
    starts = all_starts[first_start[number] : first_start[number + 1]]
    lower = all_lower[first_node[number] : first_node[number + 1]]
    upper = all_upper[first_node[number] : first_node[number + 1]]
    width, height, leaves = len(xs), len(ys), len(starts) - 1
    half_x, half_y = 0.5 * width / focal, 0.5 * height / focal
    for k in range(4):
        planes[0, k] = m[0, k] + half_x * m[2, k]
        planes[1, k] = -m[0, k] + half_x * m[2, k]
        planes[2, k] = m[1, k] + half_y * m[2, k]
        planes[3, k] = -m[1, k] + half_y * m[2, k]
        planes[4, k] = m[2, k]
    stack[0], size = 0, 1
    while size > 0:
        size -= 1
        node = stack[size]
        seen = True
        for p in range(5):
            highest = planes[p, 3]
            for k in range(3):
                slope = planes[p, k]
                highest += slope * (upper[node, k] if slope > 0.0 else lower[node, k])
            if not highest >= -1e-9:
                seen = False
                break
        if not seen:
            continue
        if node < leaves - 1:
            stack[size], stack[size + 1] = 2 * node + 2, 2 * node + 1
            size += 2
            continue
        leaf = node - (leaves - 1)
        for k in range(starts[leaf], starts[leaf + 1]):
            a = _moved(m, triangles[k, 0, 0], triangles[k, 0, 1], triangles[k, 0, 2])
            b = _moved(m, triangles[k, 1, 0], triangles[k, 1, 1], triangles[k, 1, 2])
            c = _moved(m, triangles[k, 2, 0], triangles[k, 2, 1], triangles[k, 2, 2])
            if max(a[2], b[2], c[2]) <= 0.0:
                continue
            left, right, top, bottom = 0, width - 1, 0, height - 1
            if min(a[2], b[2], c[2]) > NEAR_MM:
                fa, fb, fc = focal / a[2], focal / b[2], focal / c[2]
                x, y, w = a[0] * fa, b[0] * fb, c[0] * fc
                middle = 0.5 * width - 0.5
                low, high = min(x, y, w) + middle - 1e-6, max(x, y, w) + middle + 1e-6
                if low > right or high < 0.0:
                    continue
                left = max(0, math.ceil(low))
                right = min(right, math.floor(high))
                if left > right:
                    continue
                x, y, w = a[1] * fa, b[1] * fb, c[1] * fc
                middle = 0.5 * height - 0.5
                low, high = min(x, y, w) + middle - 1e-6, max(x, y, w) + middle + 1e-6
                if low > bottom or high < 0.0:
                    continue
                top = max(0, math.ceil(low))
                bottom = min(bottom, math.floor(high))
                if top > bottom:
                    continue
            u, v, w = _crossed(b, c), _crossed(c, a), _crossed(a, b)
            volume = a[0] * u[0] + a[1] * u[1] + a[2] * u[2]
            if volume == 0.0:
                continue
            sign = 1.0 if volume > 0.0 else -1.0
            volume *= sign
            for i in range(top, bottom + 1):
                u0 = u[1] * ys[i] + u[2]
                v0 = v[1] * ys[i] + v[2]
                w0 = w[1] * ys[i] + w[2]
                for j in range(left, right + 1):
                    of_a = sign * (u[0] * xs[j] + u0)
                    of_b = sign * (v[0] * xs[j] + v0)
                    of_c = sign * (w[0] * xs[j] + w0)
                    if of_a < 0.0 or of_b < 0.0 or of_c < 0.0:
                        continue
                    total = of_a + of_b + of_c
                    if volume < z[i, j] * total:
                        z[i, j] = volume / total
                        who[i, j], place[i, j] = number, k
                        share[i, j, 0], share[i, j, 1] = of_b / total, of_c / total


@compiled(inner=True)
def _raster_arm(inward, chains, number, b, bodies, focal, xs, ys, z, who, place):
    """Keep the segments of an arm that are nearest at the pixels' centres; see `rays_to_chains`."""
    lines, firsts, radii, gaps, _ = chains
    first, last, radius, gap = firsts[number], firsts[number + 1], radii[number], gaps[number]
    width, height = len(xs), len(ys)
    arc, free = 0.0, False
    o = (0.0, 0.0, 0.0)
    after = _moved(inward, lines[b, last - 1, 0], lines[b, last - 1, 1], lines[b, last - 1, 2])
    for k in range(last - 2, first - 1, -1):
        p, q = _moved(inward, lines[b, k, 0], lines[b, k, 1], lines[b, k, 2]), after
        after = p
        dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        free = free or arc >= gap
        arc += math.sqrt(dx * dx + dy * dy + dz * dz)
        if not free or _beside(p, q, radius, 0.5 * width / focal, 0.5 * height / focal):
            continue
        left, right = _span(p[0], p[2], q[0], q[2], radius, focal, width)
        top, bottom = _span(p[1], p[2], q[1], q[2], radius, focal, height)
        for i in range(top, bottom + 1):
            for j in range(left, right + 1):
                length = math.sqrt(xs[j] * xs[j] + ys[i] * ys[i] + 1.0)
                d = (xs[j] / length, ys[i] / length, 1.0 / length)
                hit = capsule_entry(o, d, p, q, radius) / length
                if hit < z[i, j]:
                    z[i, j], who[i, j], place[i, j] = hit, bodies + number, k


@compiled
def _beside(p, q, radius, half_x, half_y):
    """Whether a capsule lies wholly beside one of the planes that bound the picture, or behind."""
    if max(p[2], q[2]) <= -radius:
        return True
    away = radius * math.sqrt(1.0 + half_x * half_x)
    if min(p[0] - half_x * p[2], q[0] - half_x * q[2]) > away:
        return True
    if min(-p[0] - half_x * p[2], -q[0] - half_x * q[2]) > away:
        return True
    away = radius * math.sqrt(1.0 + half_y * half_y)
    if min(p[1] - half_y * p[2], q[1] - half_y * q[2]) > away:
        return True
    return min(-p[1] - half_y * p[2], -q[1] - half_y * q[2]) > away


@compiled
def _span(x, z, x2, z2, radius, focal, pixels):
    """First and last pixel that the balls of a radius about both ends of a capsule can cover.

    A capsule is the hull of its balls, so its picture lies within the span of theirs. The tangents
    to a circle at (x, z) have the slopes (x z -+ r sqrt(x^2 + z^2 - r^2)) / (z^2 - r^2).
    """
    if min(z, z2) <= radius + NEAR_MM:
        return 0, pixels - 1
    low, high = math.inf, -math.inf
    for end in range(2):
        u, w = (x, z) if end == 0 else (x2, z2)
        root = radius * math.sqrt(u * u + w * w - radius * radius)
        below = w * w - radius * radius
        low, high = min(low, (u * w - root) / below), max(high, (u * w + root) / below)
    middle = 0.5 * pixels - 0.5
    low, high = focal * low + middle - 1e-6, focal * high + middle + 1e-6
    if low > pixels or high < 0.0:
        return 0, -1
    return max(0, math.ceil(low)), min(pixels - 1, math.floor(high))


@compiled(inner=True)
def _develop(
    b, cameras, lens, inside, film, bodies, chains, beams, tissue, xs, ys, z, who, place, share,
    rgb, labels
):  # fmt: skip
    """Light, paint and label what the pixels of one picture show; see `render.Renderer`."""
    inward, maps, _ = cameras
    lamp_half = lens[2]
    triangles, normals = bodies[0], bodies[1]
    colours, kinds = bodies[7], bodies[8]
    lines, arm_labels = chains[0], chains[4]
    ends, lit = beams
    guess, least = film
    organ, threshold, ring, dose, marked = tissue[0], tissue[7], tissue[8], tissue[9], tissue[10]
    wants_rgb, wants_labels = len(rgb) > 0, len(labels) > 0
    if not (wants_rgb or wants_labels):
        return
    count = len(kinds)
    turns = np.empty((count, 3, 3))
    for n in range(count):
        _cofactors(maps[n, b], turns[n])
    for i in range(len(ys)):
        for j in range(len(xs)):
            if not inside[i, j]:
                continue
            n, k = who[i, j], place[i, j]
            length = math.sqrt(xs[j] * xs[j] + ys[i] * ys[i] + 1.0)
            rx, ry, rz = xs[j] / length, ys[i] / length, 1.0 / length
            distance = z[i, j] * length
            red, green, blue, facing, met = 0.0, 0.0, 0.0, 0.0, False
            if 0 <= n < count:
                sb, sc = share[i, j, 0], share[i, j, 1]
                sa = 1.0 - sb - sc
                label = kinds[n]
                red, green, blue = colours[n, 0], colours[n, 1], colours[n, 2]
                if n == organ and marked[k]:
                    x = sa * triangles[k, 0, 0] + sb * triangles[k, 1, 0] + sc * triangles[k, 2, 0]
                    y = sa * triangles[k, 0, 1] + sb * triangles[k, 1, 1] + sc * triangles[k, 2, 1]
                    w = sa * triangles[k, 0, 2] + sb * triangles[k, 1, 2] + sc * triangles[k, 2, 2]
                    sample = _sample_near(tissue, x, y, w)
                    if sample >= 0:
                        heat = min(max(dose[b, sample] / threshold, 0.0), 1.0)
                        lesion = tissue[6][ring[b], sample]
                        tint = LESION_TINT if lesion else 0.0
                        red = _stained(red, tint, heat, 0)
                        green = _stained(green, tint, heat, 1)
                        blue = _stained(blue, tint, heat, 2)
                        if heat >= 1.0:
                            label = _ABLATED
                        elif lesion:
                            label = _LESION
                if wants_labels:
                    labels[b, i, j, 0] = label
                if wants_rgb:
                    x = sa * normals[k, 0, 0] + sb * normals[k, 1, 0] + sc * normals[k, 2, 0]
                    y = sa * normals[k, 0, 1] + sb * normals[k, 1, 1] + sc * normals[k, 2, 1]
                    w = sa * normals[k, 0, 2] + sb * normals[k, 1, 2] + sc * normals[k, 2, 2]
                    t = turns[n]
                    nx = t[0, 0] * x + t[0, 1] * y + t[0, 2] * w
                    ny = t[1, 0] * x + t[1, 1] * y + t[1, 2] * w
                    nz = t[2, 0] * x + t[2, 1] * y + t[2, 2] * w
                    size = math.sqrt(nx * nx + ny * ny + nz * nz)
                    if size > 0.0:
                        facing, met = abs(nx * rx + ny * ry + nz * rz) / size, True
            elif n >= count:
                if wants_labels:
                    labels[b, i, j, 0] = arm_labels[n - count]
                if wants_rgb:
                    p = _moved(inward[b], lines[b, k, 0], lines[b, k, 1], lines[b, k, 2])
                    q = _moved(
                        inward[b], lines[b, k + 1, 0], lines[b, k + 1, 1], lines[b, k + 1, 2]
                    )
                    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
                    x, y, w = distance * rx - p[0], distance * ry - p[1], distance * rz - p[2]
                    along = (x * ux + y * uy + w * uz) / max(ux * ux + uy * uy + uz * uz, 1e-30)
                    along = min(max(along, 0.0), 1.0)
                    nx, ny, nz = x - along * ux, y - along * uy, w - along * uz
                    size = math.sqrt(nx * nx + ny * ny + nz * nz)
                    red, green, blue = ARM_COLOUR
                    if size > 0.0:
                        facing, met = abs(nx * rx + ny * ry + nz * rz) / size, True
            if not wants_rgb:
                continue
            if met:
                lamp = 1.7 / (1.0 + (distance / lamp_half) ** 2)
                f2 = facing * facing
                f4 = f2 * f2
                f8 = f4 * f4
                f16 = f8 * f8
                shine, diffuse = 0.35 * f16 * f16 * f8, 0.06 + 0.94 * facing
                red = (red * diffuse + shine) * lamp
                green = (green * diffuse + shine) * lamp
                blue = (blue * diffuse + shine) * lamp
            else:
                red, green, blue = BACKGROUND
            glow = 0.0
            for beam in range(lit.shape[1]):
                if lit[b, beam]:
                    glow = max(glow, _glow(inward[b], ends[b, beam], rx, ry, rz, distance))
            rgb[b, i, j, 0] = _exposed(red + glow * BEAM_COLOUR[0], guess, least)
            rgb[b, i, j, 1] = _exposed(green + glow * BEAM_COLOUR[1], guess, least)
            rgb[b, i, j, 2] = _exposed(blue + glow * BEAM_COLOUR[2], guess, least)


@compiled
def _moved(m, x, y, z):
    """A point under an affine map (4, 4), as a tuple."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@compiled(inner=True)
def _crossed(a, b):
    """Cross product of tuples; that of (b, a) is exactly its negative."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@compiled(inner=True)
def _cofactors(m, out):
    """The cofactors of a map's linear part, which turn normals as the map turns surfaces."""
    for i in range(3):
        for j in range(3):
            r, s, t, u = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            out[i, j] = m[r, t] * m[s, u] - m[r, u] * m[s, t]


@compiled(inner=True)
def _sample_near(tissue, x, y, z):
    """The nearest sample of the tissue's marks within SAMPLE_MM of a point; -1 for none."""
    _, samples, origin, cell, shape, starts = tissue[:6]
    if len(samples) == 0:
        return -1
    low_i = max(0, math.floor((x - SAMPLE_MM - origin[0]) / cell))
    low_j = max(0, math.floor((y - SAMPLE_MM - origin[1]) / cell))
    low_k = max(0, math.floor((z - SAMPLE_MM - origin[2]) / cell))
    high_i = min(shape[0] - 1, math.floor((x + SAMPLE_MM - origin[0]) / cell))
    high_j = min(shape[1] - 1, math.floor((y + SAMPLE_MM - origin[1]) / cell))
    high_k = min(shape[2] - 1, math.floor((z + SAMPLE_MM - origin[2]) / cell))
    best, found = SAMPLE_MM * SAMPLE_MM, -1
    if low_k > high_k:
        return found
    for i in range(low_i, high_i + 1):
        for j in range(low_j, high_j + 1):
            row = (i * shape[1] + j) * shape[2]
            for n in range(starts[row + low_k], starts[row + high_k + 1]):
                dx, dy, dz = samples[n, 0] - x, samples[n, 1] - y, samples[n, 2] - z
                d2 = dx * dx + dy * dy + dz * dz
                if d2 < best:
                    best, found = d2, n
    return found


@compiled(inner=True)
def _stained(base, tint, heat, channel):
    """A tissue's linear colour with a lesion's tint and a dose's heat; see `render.stained`."""
    base += (LESION_LINEAR[channel] - base) * tint
    if heat >= 1.0:
        return CHARRED_LINEAR[channel]
    return base + (BLANCHED_LINEAR[channel] - base) * heat


@compiled
def _glow(inward, ends, rx, ry, rz, distance):
    """How brightly a beam (2, 3) shows on a ray from the camera; see `render._glow`."""
    p = _moved(inward, ends[0, 0], ends[0, 1], ends[0, 2])
    q = _moved(inward, ends[1, 0], ends[1, 1], ends[1, 2])
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    e = dx * dx + dy * dy + dz * dz
    if e == 0.0:
        return 0.0
    f = -(dx * p[0] + dy * p[1] + dz * p[2])
    b, c = rx * dx + ry * dy + rz * dz, -(rx * p[0] + ry * p[1] + rz * p[2])
    denominator, limit = e - b * b, distance + BEAM_RADIUS_MM
    s = (b * f - c * e) / denominator if denominator > 1e-12 * e else 0.0
    s = min(max(s, 0.0), limit)
    t = min(max((b * s + f) / e, 0.0), 1.0)
    s = min(max(b * t - c, 0.0), limit)
    x, y, z = s * rx - p[0] - t * dx, s * ry - p[1] - t * dy, s * rz - p[2] - t * dz
    weight = 2.0 * (x * x + y * y + z * z) / (BEAM_RADIUS_MM * BEAM_RADIUS_MM)
    return math.exp(-weight) if weight < DARKEST_GLOW else 0.0


@compiled
def _exposed(light, guess, least):
    """The 8-bit value of a linear brightness."""
    light = min(max(light, 0.0), 1.0)
    value = guess[int(light * LEVELS)]
    while light >= least[value + 1]:
        value += 1
    while light < least[value]:
        value -= 1
    return value
