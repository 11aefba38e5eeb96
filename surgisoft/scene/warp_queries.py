"""The batched distance and ray queries on an accelerator, by the kernels of `warp_kernels`.

No query waits for the processor, and none makes more than one row of working memory for each arm.
Warp compiles the kernels at their first use on a machine, for a few seconds, and keeps them in its
own cache. It compiles them for the CPU too, where they are tested; the queries that numba compiles
are faster there.
"""

from __future__ import annotations

import numpy as np
import torch

from surgisoft.scene import warp_kernels as kernels
from surgisoft.scene.bvh import TriangleTree
from surgisoft.scene.capsules import LONGEST_SEGMENT_MM, MOST_PARTS
from surgisoft.scene.field import DistanceField
from surgisoft.scene.warp_kernels import wp


def launch(kernel, dim, given: list, like: torch.Tensor) -> None:
    """Start a kernel where the tensor `like` is, behind what torch does there."""
    device = wp.device_from_torch(like.device)
    stream = wp.stream_from_torch(like.device) if like.is_cuda else None
    wp.launch(kernel, dim=dim, inputs=given, device=device, stream=stream)


def held(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor in float64, contiguous and without gradient."""
    return tensor.detach().double().contiguous()


def vectors(tensor: torch.Tensor):
    """Points (..., 3) as an array of vectors for kernels; float64, contiguous."""
    return wp.from_torch(tensor, dtype=wp.vec3d)


class WarpSurface:
    """One body's surface on a device: its distance field, tree and normals."""

    divides = True

    def __init__(self, tree: TriangleTree, field: DistanceField, device: str | torch.device):
        def there(array, dtype=torch.float64) -> torch.Tensor:
            return torch.tensor(np.ascontiguousarray(array), dtype=dtype, device=device)

        self.normals = there(tree.mesh.face_normals)
        self._closed = int(tree.mesh.is_watertight)
        # Warp's arrays do not own their memory.
        self._kept = (
            there(tree.triangles_mm),
            there(tree.starts, torch.int64),
            there(tree.order, torch.int64),
            there(tree.lower),
            there(tree.upper),
            there(field.values_mm, torch.float32),
        )
        faces, starts, order, lower, upper, values = self._kept
        self._faces, self._order = vectors(faces), wp.from_torch(order)
        self._tree = (self._faces, wp.from_torch(starts), vectors(lower), vectors(upper))
        grid = (field.cell_mm, field.band_mm, field.slack_mm)
        self._field = (wp.from_torch(values), wp.vec3d(*map(float, field.origin_mm)), *grid)

    def cast(self, rays: WarpRays, turn: torch.Tensor, shift: torch.Tensor, which: int, kind: int):
        """First hits of rays on the surface, where they are nearer than what was met before.

        turn (B or 1, 3, 3) and shift (B or 1, 3): world to body; which: number of the body; kind:
        its `Struck`.
        """
        faces, starts, lower, upper = self._tree
        frame = (wp.from_torch(held(turn), dtype=wp.mat33d), vectors(held(shift)))
        mesh = (faces, starts, self._order, lower, upper, vectors(self.normals))
        given = [*rays.given, *frame, *mesh, which, kind, *rays.found]
        launch(kernels.rays_to_body, rays.count, given, rays.origins)

    def hide(self, look: WarpLook, turn: torch.Tensor, shift: torch.Tensor) -> None:
        """Clear the flags of lines of sight that meet the surface; frames as for `cast`."""
        frame = (wp.from_torch(held(turn), dtype=wp.mat33d), vectors(held(shift)))
        given = [*look.given, *frame, *self._tree, look.flags]
        launch(kernels.hide_behind_body, look.shape, given, look.ends)

    def clearance(
        self,
        lines: torch.Tensor,
        given: torch.Tensor,
        turn: torch.Tensor,
        shift: torch.Tensor,
        radius: float,
        within: float,
        horizon: float,
    ) -> torch.Tensor:
        """(B,) mm: signed clearance of arms (B, K, 3), world frame, from the surface.

        given (K,) bool: the centreline's own points, where depth inside the body counts. Long
        segments are divided.
        """
        line, turns, shifts = held(lines), held(turn), held(shift)
        out = torch.empty_like(line[:, 0, 0])
        arguments = [
            vectors(line),
            wp.from_torch(given.contiguous()),
            wp.from_torch(turns, dtype=wp.mat33d),
            vectors(shifts),
            *(float(radius), float(within), float(horizon)),
            self._closed,
            *self._field,
            *self._tree,
            float(LONGEST_SEGMENT_MM),
            MOST_PARTS,
            wp.from_torch(out),
        ]
        launch(kernels.chains_to_surface, len(line), arguments, line)
        return out.to(lines.dtype)


def chains_apart_warp(
    first: torch.Tensor, second: torch.Tensor, radii: float, horizon: float
) -> torch.Tensor:
    """(B,) clearance (mm) between arms (B, K, 3) and (B, M, 3); radii is their sum."""
    one, other = held(first), held(second)
    out = torch.empty_like(one[:, 0, 0])
    given = [vectors(one), vectors(other), float(radii), float(horizon), wp.from_torch(out)]
    launch(kernels.chains_apart, len(one), given, one)
    return out.to(first.dtype)


def chains_folded_warp(
    lines: torch.Tensor, radius: float, gap: float, horizon: float
) -> torch.Tensor:
    """(B,) clearance (mm) of arms (B, K, 3) to themselves beyond `gap` mm of arc."""
    line = held(lines)
    out = torch.empty_like(line[:, 0, 0])
    given = [vectors(line), float(radius), float(gap), float(horizon), wp.from_torch(out)]
    launch(kernels.chains_folded, len(line), given, line)
    return out.to(lines.dtype)


class WarpRays:
    """Rays that are followed to what they meet first: bodies (`WarpSurface.cast`), then arms."""

    def __init__(self, origins: torch.Tensor, directions: torch.Tensor, range_mm: float, each: int):
        """origins and directions (N, 3), world frame, mm; `each` rays for each environment."""
        self.origins, aims = held(origins), held(directions)
        self.count, place = len(origins), self.origins.device
        self._aims, self.normals = torch.empty_like(aims), torch.empty_like(aims)
        self.struck = torch.empty(self.count, dtype=torch.int8, device=place)
        """(N,) what is met, a `Struck`."""
        self.body, self.face = (
            torch.empty(self.count, dtype=torch.int32, device=place) for _ in range(2)
        )
        """(N,) body and face that are met, -1 for none."""
        self.distance_mm = torch.empty_like(aims[:, 0])
        """(N,) distance of it."""
        marks = [wp.from_torch(t) for t in (self.struck, self.body, self.face, self.distance_mm)]
        self.found = [*marks, vectors(self.normals)]
        self.given = [vectors(self.origins), vectors(self._aims), each]
        given = [vectors(aims), float(range_mm), vectors(self._aims), *self.found]
        launch(kernels.aim_rays, self.count, given, aims)

    def meet(self, lines: torch.Tensor, radius: float, gap: float, kind: int) -> None:
        """Follow them to an arm (B, K, 3), whose last `gap` mm of arc are left out."""
        given = [*self.given, vectors(held(lines)), float(radius), float(gap), kind, *self.found]
        launch(kernels.rays_to_arm, self.count, given, self.origins)

    def ends(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Where they end, (N, 3) mm, and their angles of incidence (N,) rad."""
        point, incidence = torch.empty_like(self.normals), torch.empty_like(self.distance_mm)
        origins, aims, _ = self.given
        *_, t, normals = self.found
        given = [origins, aims, t, normals, vectors(point), wp.from_torch(incidence)]
        launch(kernels.ray_ends, self.count, given, point)
        return point, incidence


class WarpLook:
    """Lines of sight of B cameras to M points each, of which bodies and arms hide some."""

    def __init__(
        self,
        eyes: torch.Tensor,
        axes: torch.Tensor,
        points: torch.Tensor,
        normals: torch.Tensor,
        picture: tuple[float, float, float, float],
        short_mm: float,
    ):
        """eyes and axes (B, 3), points and normals (B, M, 3), world frame, mm.

        picture: lift of the points, half of the field of view, nearest and farthest distance;
        short_mm: what a line meets so near to its end does not hide the point.
        """
        eye, axis, at, outward = (held(t) for t in (eyes, axes, points, normals))
        self.shape, self.ends = tuple(at.shape[:2]), torch.empty_like(at)
        distance = torch.empty_like(at[..., 0])
        self.wanted = torch.empty(self.shape, dtype=torch.bool, device=at.device)
        """(B, M): inside the cone and in range."""
        self.clear = torch.empty_like(self.wanted)
        """(B, M): and nothing in between."""
        self.middle = torch.empty((len(at), 2), dtype=at.dtype, device=at.device)
        """(B, 2): angle of the points' middle to the axis, rad, and its distance, mm."""
        self.flags, far = wp.from_torch(self.clear), wp.from_torch(distance)
        self.given = [vectors(eye), vectors(self.ends), far, float(short_mm)]
        place = [vectors(eye), vectors(axis), vectors(at)]
        found = [vectors(self.ends), wp.from_torch(self.wanted), self.flags, far]
        limits = [float(number) for number in picture]
        given = [*place, vectors(outward), *limits, *found]
        launch(kernels.points_in_picture, self.shape, given, at)
        launch(kernels.middles, len(at), [*place, wp.from_torch(self.middle)], at)
        self._kept = (eye, distance)  # Warp's arrays do not own their memory

    def hide(self, lines: torch.Tensor, radius: float, gap: float) -> None:
        """Clear the flags of lines that meet an arm (B, K, 3), but for its last `gap` mm of arc."""
        given = [*self.given, vectors(held(lines)), float(radius), float(gap), self.flags]
        launch(kernels.hide_behind_arm, self.shape, given, self.ends)
