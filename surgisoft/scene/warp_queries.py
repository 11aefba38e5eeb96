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

    def first_hit(
        self, origins: torch.Tensor, directions: torch.Tensor, range_mm: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance (N,) mm and face (N,) of rays (N, 3) in the body's frame; -1 for none."""
        o, d = held(origins), held(directions)
        distance = torch.empty_like(o[:, 0])
        face = torch.empty(len(o), dtype=torch.int64, device=o.device)
        faces, starts, lower, upper = self._tree
        tree = (faces, starts, self._order, lower, upper)
        found = (wp.from_torch(distance), wp.from_torch(face))
        given = [vectors(o), vectors(d), float(range_mm), *tree, *found]
        launch(kernels.rays_to_surface, len(o), given, o)
        return distance, face

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


def rays_to_chains_warp(
    origins: torch.Tensor,
    directions: torch.Tensor,
    lines: torch.Tensor,
    radius: float,
    gap: float,
    best: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """First hits of rays (B, R, 3) on arms (B, K, 3) below `best` (B, R): distance, segment."""
    o, d, line = held(origins), held(directions), held(lines)
    distance, segment = best.clone(), torch.zeros_like(best, dtype=torch.int64)
    rays = [vectors(o), vectors(d), vectors(line), float(radius), float(gap)]
    found = [wp.from_torch(distance), wp.from_torch(segment)]
    launch(kernels.rays_to_chains, tuple(best.shape), rays + found, o)
    return distance, segment
