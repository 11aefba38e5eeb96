"""Clearance and ray queries for many environments at once, as training needs them.

`BatchedScene` gives the results of `collision.CollisionChecker` for batches of arms: on the CPU
with compiled queries, on an accelerator with torch. Both agree with FCL to the
tolerances that `tests/scene/test_distance.py` and `test_rays.py` state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from surgisoft.errors import InputError, unknown_name
from surgisoft.scene import frames
from surgisoft.scene.bvh import TriangleTree, tree_of
from surgisoft.scene.capsules import (
    HORIZON_MM,
    LONGEST_SEGMENT_MM,
    MOST_PARTS,
    BatchClearance,
    chain_normal,
    self_contact_gap_mm,
)
from surgisoft.scene.distance import (
    beams_beside_body,
    beams_beside_chains,
    beams_inside_faces,
    chains_apart,
    chains_folded,
    chains_to_surface,
    divide_steps,
    longest_steps,
    parts_of_steps,
)
from surgisoft.scene.field import MOST_NODES, DistanceField, cache_folder, load_field
from surgisoft.scene.mesh import Body, Mesh, kept
from surgisoft.scene.moving import Placement
from surgisoft.scene.rays import (
    RayHit,
    Struck,
    aim_rays,
    chain_hits,
    ray_ends,
    rays_to_body,
    rays_to_chains,
    struck_of,
)
from surgisoft.scene.sight import hide_behind_body, hide_behind_chain, points_in_picture
from surgisoft.scene.torch_queries import (
    TorchSurface,
    chains_apart_torch,
    chains_folded_torch,
    rays_to_chains_torch,
)
from surgisoft.threads import over_rows

ENGINES = ("compiled", "torch", "warp")
"""The batched engines: compiled queries, torch alone, or NVIDIA Warp kernels (extra `gpu`)."""
SLOPE_MM = 0.05
"""Shift of an arm by which the slope of its distance from a strained body is measured (mm)."""
BESIDE_MM = 1e-3
"""A ray that passes by at this distance misses, by any engine (mm): the width of the triangle by
which FCL represents a ray, and a million times the rounding of the others."""
EDGE_MM = 0.01
"""A ray that meets a face this far inside its edges meets that face, by any engine (mm)."""
GRAZING = 0.05
"""Cosine of the angle between ray and normal below which a hit is not beyond doubt (87 degrees)."""
EXACT_WITHIN_MM = 5.0
"""Clearances below this are exact; larger ones have the field's interpolation error (mm)."""


class BatchedScene:
    """Clearances and ray hits for a batch of arms in one scene; built once, queried every step.

    `arms` maps an arm's name to its centrelines (B, K, 3), mm, world frame; any dtype and K.
    `poses` maps a body's name to (B, 4, 4) body to world; a body without an entry stands where the
    scene puts it. An environment whose arm is not finite gets nan clearances and missed rays; the
    other environments are not affected.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        radii_mm: Mapping[str, float],
        device: str | torch.device = "cpu",
        horizon_mm: float = HORIZON_MM,
        exact_within_mm: float = EXACT_WITHIN_MM,
        most_nodes: int = MOST_NODES,
        cache: Path | None = None,
        engine: str | None = None,
        stretch: float = 1.0,
    ):
        """`engine` is `compiled` (CPU only, its default), `torch` or `warp` (any device).

        The default on an accelerator is `warp` where it is installed, else `torch`. stretch: the
        largest factor by which a length in the world is longer in the frame of a strained body
        (`Placement`): as far beyond the horizon its distances are looked up.
        """
        for name, radius in radii_mm.items():
            if not (math.isfinite(radius) and radius > 0.0):
                raise InputError(f"radius of arm '{name}' is {radius} mm: expected more than 0")
        self.bodies, self.radii_mm = tuple(bodies), dict(radii_mm)
        self.device = torch.device(device)
        self.horizon_mm, self.exact_within_mm = float(horizon_mm), float(exact_within_mm)
        thickest = max(self.radii_mm.values(), default=1.0)
        engine = engine or default_engine(self.device)
        if engine not in ENGINES:
            raise unknown_name("geometry engine", engine, ENGINES)
        if engine == "compiled" and self.device.type != "cpu":
            raise InputError(f"the compiled engine runs on the CPU, not on '{self.device}'")
        self.engine, self.compiled = engine, engine == "compiled"
        kind, *self._of_chains = _queries(engine)
        self._surfaces: list[Any] = []
        self._trees: list[TriangleTree] = []
        self._at_home = {body.name: self._inverse(_pose_of(body)) for body in self.bodies}
        self.stretch = max(1.0, float(stretch))
        margin = 5.0 * math.ceil(self.stretch * (self.horizon_mm + thickest) / 5.0)
        for body in self.bodies:
            tree = tree_of(body.mesh)
            band = 5.0 * math.ceil((thickest + self.exact_within_mm + 5.0) / 5.0)
            field = _field_of(body.mesh, margin, band, most_nodes, cache or cache_folder())
            self._surfaces.append(kind(tree, field, self.device))
            self._trees.append(tree)

    def radius_mm(self, arm: str) -> float:
        """Radius of an arm by name (mm)."""
        if arm not in self.radii_mm:
            raise unknown_name("arm", arm, self.radii_mm)
        return self.radii_mm[arm]

    def clearance(
        self,
        arms: Mapping[str, torch.Tensor],
        poses: Mapping[str, torch.Tensor] | Placement | None = None,
    ) -> BatchClearance:
        """Signed clearances of every pair; arms name -> (B, K, 3) mm, poses name -> (B, 4, 4)."""
        names = list(arms)
        lines = [_held(arms[name]) for name in names]
        radii = [self.radius_mm(name) for name in names]
        dtype, count = lines[0].dtype, len(lines[0])
        if self.engine == "warp":  # its kernels take float64; once is enough
            lines = [line.double() for line in lines]
        bodies = torch.empty((count, len(names), len(self.bodies)), dtype=dtype, device=self.device)
        fine = [self._divided(line) for line in lines]
        for n, (body, surface) in enumerate(zip(self.bodies, self._surfaces, strict=True)):
            turn, shift = self._inward(body, poses)
            for a, ((line, given), radius) in enumerate(zip(fine, radii, strict=True)):
                measure = surface.clearance
                if isinstance(poses, Placement) and body.name in poses.at_rest:
                    measure = partial(strained_clearance, surface, self.stretch)
                bodies[:, a, n] = measure(
                    line, given, turn, shift, radius, self.exact_within_mm, self.horizon_mm
                )
        pairs = [
            self._apart(lines[i], lines[j], radii[i] + radii[j])
            for i, j in combinations(range(len(names)), 2)
        ]
        nothing = torch.empty((count, 0), dtype=dtype, device=self.device)
        apart = torch.stack(pairs, 1).to(dtype) if pairs else nothing
        own = self.clearance_to_itself(dict(zip(names, lines, strict=True)))
        return BatchClearance(bodies, apart, own.to(dtype))

    def clearance_to_itself(self, arms: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """(B, A) mm: clearance of each arm (B, K, 3) mm to itself, as in `clearance`."""
        own = [self._folded(_held(line), self.radius_mm(name)) for name, line in arms.items()]
        return torch.stack(own, 1)

    def cast(
        self,
        origins_mm: torch.Tensor,
        directions: torch.Tensor,
        range_mm: float,
        arms: Mapping[str, torch.Tensor] | None = None,
        own: str | None = None,
        poses: Mapping[str, torch.Tensor] | Placement | None = None,
    ) -> RayHit:
        """First hits of rays (B, ..., 3), world frame; arms name -> (B, K, 3) stand in the way.

        `own` names the arm that carries the beam: its segments near the tip do not block it.
        """
        if self.compiled:
            return self._compiled_cast(origins_mm, directions, range_mm, arms or {}, own, poses)
        if self.engine == "warp":
            return self._warp_cast(origins_mm, directions, range_mm, arms or {}, own, poses)
        shape = origins_mm.shape[:-1]
        count = shape[0]
        origins = _held(origins_mm).double().reshape(count, -1, 3)
        aims = frames.normalise(_held(directions).double()).reshape(count, -1, 3)
        best = torch.full_like(origins[..., 0], float(range_mm))
        struck = torch.zeros_like(best, dtype=torch.int8)
        which = torch.full_like(best, -1, dtype=torch.int32)
        face = torch.full_like(best, -1, dtype=torch.int64)
        normal = -aims
        for n, (body, surface) in enumerate(zip(self.bodies, self._surfaces, strict=True)):
            turn, shift = self._inward(body, poses)
            o = origins @ turn.mT + shift[:, None]
            d = aims @ turn.mT
            t, f = surface.first_hit(o.reshape(-1, 3), d.reshape(-1, 3), float(range_mm))
            t, f = t.view_as(best), f.view_as(best)
            nearer = (f >= 0) & (t < best)
            best = torch.where(nearer, t, best)
            which = torch.where(nearer, n, which)
            face = torch.where(nearer, f, face)
            struck = torch.where(nearer, int(struck_of(body)), struck)
            outward = frames.normalise(surface.normals[f.clamp(min=0)] @ turn)
            normal = torch.where(nearer[..., None], outward, normal)
        for name, line in (arms or {}).items():
            radius, line = self.radius_mm(name), _held(line)
            gap = self_contact_gap_mm(radius) if name == own else -1.0
            t, segment = rays_to_chains_torch(origins, aims, line, radius, gap, best)
            nearer = t < best
            point = origins + t[..., None] * aims
            outward = chain_normal(point, line.double()[:, None], segment)
            kind = int(Struck.OWN_ARM if name == own else Struck.OTHER_ARM)
            best = torch.where(nearer, t, best)
            which, face = torch.where(nearer, -1, which), torch.where(nearer, -1, face)
            struck = torch.where(nearer, kind, struck)
            normal = torch.where(nearer[..., None], outward, normal)
        point = origins + best[..., None] * aims
        sine, cosine = frames.norm(frames.cross(normal, aims)), frames.dot(normal, aims).abs()
        dtype = origins_mm.dtype
        return RayHit(
            struck=struck.reshape(shape),
            body=which.reshape(shape),
            face=face.int().reshape(shape),
            distance_mm=best.to(dtype).reshape(shape),
            point_mm=point.to(dtype).reshape(*shape, 3),
            normal=normal.to(dtype).reshape(*shape, 3),
            incidence_rad=torch.atan2(sine, cosine).to(dtype).reshape(shape),
        )

    def _warp_cast(self, origins_mm, directions, range_mm, arms, own, poses) -> RayHit:
        """`cast` by a kernel for each body and each arm."""
        from surgisoft.scene.warp_queries import WarpRays

        shape, dtype = origins_mm.shape[:-1], origins_mm.dtype
        origins, aims = (t.detach().reshape(-1, 3) for t in (origins_mm, directions))
        rays = WarpRays(origins, aims, range_mm, math.prod(shape[1:]))
        for n, (body, surface) in enumerate(zip(self.bodies, self._surfaces, strict=True)):
            surface.cast(rays, *self._inward(body, poses), n, int(struck_of(body)))
        for name, line in arms.items():
            radius = self.radius_mm(name)
            gap = self_contact_gap_mm(radius) if name == own else -1.0
            kind = Struck.OWN_ARM if name == own else Struck.OTHER_ARM
            rays.meet(line, radius, gap, int(kind))
        point, incidence = rays.ends()
        return RayHit(
            struck=rays.struck.reshape(shape),
            body=rays.body.reshape(shape),
            face=rays.face.reshape(shape),
            distance_mm=rays.distance_mm.to(dtype).reshape(shape),
            point_mm=point.to(dtype).reshape(*shape, 3),
            normal=rays.normals.to(dtype).reshape(*shape, 3),
            incidence_rad=incidence.to(dtype).reshape(shape),
        )

    def _compiled_cast(self, origins_mm, directions, range_mm, arms, own, poses) -> RayHit:
        """`cast` in a few compiled loops."""
        shape, dtype = origins_mm.shape[:-1], origins_mm.dtype
        each, count = math.prod(shape[1:]), math.prod(shape)
        origins, aims, normals = (np.empty((count, 3)) for _ in range(3))
        given = [_held(t).reshape(-1, 3).numpy() for t in (origins_mm, directions)]
        struck = torch.zeros(count, dtype=torch.int8)
        body, face = torch.full((2, count), -1, dtype=torch.int32)
        t, segments = np.full(count, float(range_mm)), np.zeros(count, np.int64)
        point, normal = torch.empty((2, count, 3), dtype=dtype)
        distance, incidence = torch.empty((2, count), dtype=dtype)
        found = (struck.numpy(), body.numpy(), face.numpy(), t, normals)
        ends = [part.numpy() for part in (point, normal, distance, incidence)]
        bodies = []
        for number, (one, surface) in enumerate(zip(self.bodies, self._surfaces, strict=True)):
            turn, shift = (part.numpy() for part in self._inward(one, poses))
            tree, outward = self._trees[number], surface.normals.numpy()
            mesh = (tree.arrays, tree.order, outward, number, int(struck_of(one)))
            bodies.append((turn, shift, mesh))
        chains = []
        for name, line in arms.items():
            radius = self.radius_mm(name)
            gap = self_contact_gap_mm(radius) if name == own else -1.0
            kind = int(Struck.OWN_ARM if name == own else Struck.OTHER_ARM)
            chains.append((_held(line).numpy(), radius, gap, kind))

        def follow(part: slice) -> None:
            rays = slice(part.start * each, part.stop * each)
            o, d, n, distances = origins[rays], aims[rays], normals[rays], t[rays]
            aim_rays(*(array[rays] for array in given), o, d)
            np.negative(d, out=n)
            hits = [array[rays] for array in found]
            for turn, shift, mesh in bodies:
                rays_to_body(o, d, each, _of_rows(turn, part), _of_rows(shift, part), *mesh, *hits)
            for line, radius, gap, kind in chains:
                before, segment = distances.copy(), segments[rays]
                aimed = (array.reshape(-1, each, 3) for array in (o, d))
                met = (array.reshape(-1, each) for array in (distances, segment))
                rays_to_chains(*aimed, line[part], radius, gap, *met)
                chain_hits(o, d, each, line[part], kind, before, segment, *hits)
            ray_ends(o, d, distances, n, *(array[rays] for array in ends))

        over_rows(len(origins_mm), follow)
        return RayHit(
            struck=struck.reshape(shape),
            body=body.reshape(shape),
            face=face.reshape(shape),
            distance_mm=distance.reshape(shape),
            point_mm=point.reshape(*shape, 3),
            normal=normal.reshape(*shape, 3),
            incidence_rad=incidence.reshape(shape),
        )

    def sure_hits(
        self,
        origins_mm: np.ndarray,
        directions: np.ndarray,
        range_mm: float,
        arms: Mapping[str, np.ndarray],
        own: str | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits of rays (N, 3) on bodies at rest, where they are certain.

        Returns a `Struck` (N,) int8, the ends (N, 3) mm in double precision, and sure (N,) bool.
        Where a ray is sure, no engine that is right to `BESIDE_MM` finds anything else: it meets a
        face inside its edges by `EDGE_MM` and not at a grazing angle, every other face of every
        body, and every arm (N, K, 3) mm, stays `BESIDE_MM` away from it up to there.
        """
        count = len(origins_mm)
        origins, aims, normals = (np.empty((count, 3)) for _ in range(3))
        aim_rays(origins_mm, directions, origins, aims)
        np.negative(aims, out=normals)
        struck, t = np.zeros(count, np.int8), np.full(count, float(range_mm))
        body, face = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
        sure = np.isfinite(origins).all(1) & np.isfinite(aims).all(1)
        places = []
        for n, (one, surface, tree) in enumerate(
            zip(self.bodies, self._surfaces, self._trees, strict=True)
        ):
            turn, shift = (part.numpy() for part in self._inward(one, None))
            mesh = (tree.arrays, tree.order, surface.normals.numpy(), n, int(struck_of(one)))
            rays_to_body(origins, aims, 1, turn, shift, *mesh, struck, body, face, t, normals)
            places.append((turn[0], shift[0], tree))
        cosine = np.abs((normals * aims).sum(1))
        met = body >= 0
        sure &= ~met | (cosine >= GRAZING)
        before = np.where(met, t - 2.0 * BESIDE_MM / np.maximum(cosine, GRAZING), t)
        ends = origins + t[:, None] * aims
        for n, (turn, shift, tree) in enumerate(places):
            beams_beside_body(origins, aims, before, turn, shift, BESIDE_MM, tree.arrays, sure)
            triangles = tree.mesh.triangles_mm
            beams_inside_faces(ends, face, body, n, turn, shift, triangles, EDGE_MM, sure)
        for name, line in arms.items():
            radius = self.radius_mm(name)
            gap = self_contact_gap_mm(radius) if name == own else -1.0
            beams_beside_chains(origins, aims, t, line, radius, gap, BESIDE_MM, sure)
        return struck, ends, sure

    def alone(self, lines: Mapping[str, np.ndarray]) -> LoneScene:
        """Queries of one environment among bodies at rest, for the compiled engine."""
        return LoneScene(self, lines)

    def look(
        self,
        eyes_mm: torch.Tensor,
        axes: torch.Tensor,
        points_mm: torch.Tensor,
        normals: torch.Tensor,
        picture: tuple[float, float, float, float],
        short_mm: float,
        arms: Mapping[str, torch.Tensor] | None = None,
        own: str | None = None,
        poses: Mapping[str, torch.Tensor] | Placement | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Which points (B, M, 3) cameras at eyes (B, 3) along axes (B, 3) have in the picture
        (B, M) bool, which of them nothing hides (B, M) bool, and where the points' middle is
        (B, 2): its angle to the axis, rad, and its distance, mm. World frame, mm.

        picture: lift of the points, half of the field of view, nearest and farthest distance. What
        a line of sight meets in its last short_mm does not count. Arms, own and poses are those of
        `cast`. The engine in tensor operations has rays only (`sights`).
        """
        eyes, ahead, points, outward = (
            t.detach().contiguous() for t in (eyes_mm, axes, points_mm, normals)
        )
        chains = []
        for name, line in (arms or {}).items():
            radius = self.radius_mm(name)
            gap = self_contact_gap_mm(radius) if name == own else -1.0
            chains.append((_held(line), radius, gap))
        frames_of = [self._inward(body, poses) for body in self.bodies]
        if self.engine == "warp":
            from surgisoft.scene.warp_queries import WarpLook

            sight = WarpLook(eyes, ahead, points, outward, picture, short_mm)
            for chain in chains:
                sight.hide(*chain)
            for surface, frame in zip(self._surfaces, frames_of, strict=True):
                surface.hide(sight, *frame)
            return sight.wanted, sight.clear, sight.middle.to(eyes_mm.dtype)
        cameras = (eyes, ahead, points, outward)
        return self._compiled_look(cameras, picture, short_mm, chains, frames_of)

    def _compiled_look(self, cameras, picture, short_mm, chains, frames_of):
        """`look` in a few compiled loops."""
        count, each = cameras[2].shape[:2]
        ends = np.empty((count, each, 3))
        distance = np.empty((count, each))
        wanted, clear = (torch.empty((count, each), dtype=torch.bool) for _ in range(2))
        middle = torch.empty((count, 2), dtype=cameras[0].dtype)
        asked, flags = wanted.numpy(), clear.numpy()
        given = [t.numpy() for t in cameras]
        found = [ends, asked, distance, middle.numpy()]
        lines = [(line.numpy(), radius, gap) for line, radius, gap in chains]
        bodies = [
            (turn.numpy(), shift.numpy(), tree.arrays)
            for (turn, shift), tree in zip(frames_of, self._trees, strict=True)
        ]

        def see(part: slice) -> None:
            points_in_picture(*(a[part] for a in given), *picture, *(a[part] for a in found))
            flags[part] = asked[part]
            place = (given[0][part], ends[part], distance[part], short_mm)
            for line, radius, gap in lines:
                hide_behind_chain(*place, line[part], radius, gap, asked[part], flags[part])
            for turn, shift, tree in bodies:
                frame = (_of_rows(turn, part), _of_rows(shift, part))
                hide_behind_body(*place, *frame, tree, flags[part])

        over_rows(count, see)
        return wanted, clear, middle

    @property
    def sights(self) -> bool:
        """Whether the engine has lines of sight (`look`) beside rays."""
        return self.engine != "torch"

    def _inward(self, body: Body, poses) -> tuple[torch.Tensor, torch.Tensor]:
        """World to body: linear maps (B or 1, 3, 3) and shifts (B or 1, 3), float64."""
        pose = None if poses is None else poses.get(body.name)
        return self._at_home[body.name] if pose is None else self._inverse(pose.detach())

    def _inverse(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        # `inv` would wait for an accelerator, to check that the pose has an inverse.
        inward = torch.linalg.inv_ex(pose.to(self.device, torch.float64))[0]
        return inward[:, :3, :3].contiguous(), inward[:, :3, 3].contiguous()

    def _divided(self, line: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """An arm (B, K, 3) mm as surfaces measure it, and which points (K',) bool are its own."""
        if any(surface.divides for surface in self._surfaces):
            return line, torch.ones(line.shape[1], dtype=torch.bool, device=line.device)
        return refined(line)

    def _apart(self, first, second, radii: float) -> torch.Tensor:
        if not self.compiled:
            return self._of_chains[0](first, second, radii, self.horizon_mm)
        out = torch.empty(len(first), dtype=first.dtype)
        one, other, found = first.numpy(), second.numpy(), out.numpy()

        def measure(part: slice) -> None:
            chains_apart(one[part], other[part], radii, self.horizon_mm, found[part])

        over_rows(len(out), measure)
        return out

    def _folded(self, line, radius: float) -> torch.Tensor:
        gap = self_contact_gap_mm(radius)
        if not self.compiled:
            return self._of_chains[1](line, radius, gap, self.horizon_mm)
        out = torch.empty(len(line), dtype=line.dtype)
        lines, found = line.numpy(), out.numpy()

        def measure(part: slice) -> None:
            chains_folded(lines[part], radius, gap, self.horizon_mm, found[part])

        over_rows(len(out), measure)
        return out


def default_engine(device: str | torch.device) -> str:
    """The fastest engine that is installed for a device."""
    if torch.device(device).type == "cpu":
        return "compiled"
    return "warp" if _has_warp() else "torch"


@cache
def _has_warp() -> bool:
    """Whether the extra `gpu` is installed; asked in every step."""
    return find_spec("warp") is not None


def _queries(engine: str) -> tuple:
    """An engine's surface, and its functions: arms apart, and an arm folded."""
    if engine == "warp":
        from surgisoft.scene import warp_queries as warp

        chains = (warp.chains_apart_warp, warp.chains_folded_warp)
        return warp.WarpSurface, *chains
    kind = CompiledSurface if engine == "compiled" else TorchSurface
    return kind, chains_apart_torch, chains_folded_torch


@dataclass(frozen=True, eq=False)
class LoneView:
    """View of M points by one camera, in reused arrays with a batch of one in front."""

    wanted: np.ndarray
    """(1, M) bool: inside the cone and in range."""
    visible: np.ndarray
    """(1, M) bool: and nothing in between."""
    middle: np.ndarray
    """(1, 2) float32: angle of the points' middle to the axis, rad, and its distance, mm."""


class LoneScene:
    """Clearance, beams and views of one environment among bodies at rest, in kept arrays.

    It calls the compiled loops of a `BatchedScene`, which give what they give for a batch; what a
    batch of one saves is everything around them. `lines` name -> (1, K, 3) float32 mm are the arms'
    centrelines, which the caller overwrites between two queries. Each query overwrites its results.
    """

    def __init__(self, scene: BatchedScene, lines: Mapping[str, np.ndarray]):
        self.scene, self.lines = scene, dict(lines)
        self.radii = {name: scene.radius_mm(name) for name in lines}
        self._bodies = [
            (tuple(part.numpy() for part in scene._inward(body, None)), surface, tree)
            for body, surface, tree in zip(scene.bodies, scene._surfaces, scene._trees, strict=True)
        ]
        arms, bodies = len(lines), len(scene.bodies)
        self.bodies_mm = np.empty((1, arms, bodies), np.float32)
        """(1, A, N) mm: clearance of each arm from each body, see `BatchClearance`."""
        self.arms_mm = np.empty((1, arms * (arms - 1) // 2), np.float32)
        """(1, A (A - 1) / 2) mm: of each pair of arms."""
        self.self_mm = np.empty((1, arms), np.float32)
        """(1, A) mm: of each arm from itself."""
        self._fine: dict[tuple[str, bytes], tuple[np.ndarray, np.ndarray, list[tuple]]] = {}
        self._parts = {name: np.empty(line.shape[1] - 1, np.int64) for name, line in lines.items()}
        radius, places = self.radii, list(enumerate(lines))
        self._apart = [
            (
                lines[one],
                lines[two],
                radius[one] + radius[two],
                scene.horizon_mm,
                self.arms_mm[0, n : n + 1],
            )
            for n, ((_, one), (_, two)) in enumerate(combinations(places, 2))
        ]
        self._folded = [
            (
                lines[one],
                radius[one],
                self_contact_gap_mm(radius[one]),
                scene.horizon_mm,
                self.self_mm[0, a : a + 1],
            )
            for a, one in places
        ]
        self._looks: dict[tuple, tuple] = {}

    def clearance(self) -> None:
        """Fill `bodies_mm`, `arms_mm` and `self_mm`."""
        for arm, (name, line) in enumerate(self.lines.items()):
            parts = self._parts[name]
            total = parts_of_steps(line[0], LONGEST_SEGMENT_MM, MOST_PARTS, parts)
            key = (name, parts.tobytes())
            if key not in self._fine:
                self._fine[key] = self._divided(arm, name, total)
            fine, divided, calls = self._fine[key]
            if fine is not line:
                divide_steps(line, divided, fine)
            for call in calls:
                chains_to_surface(*call)
        for call in self._apart:
            chains_apart(*call)
        for call in self._folded:
            chains_folded(*call)

    def _divided(self, arm: int, name: str, total: int) -> tuple:
        """Array of an arm's divided centreline, its parts, and the queries of the bodies."""
        line, parts = self.lines[name], self._parts[name].copy()
        given = np.zeros(total + 1, bool)
        given[np.concatenate(([0], parts)).cumsum()] = True
        fine = line if total == len(parts) else np.empty((1, total + 1, 3), np.float32)
        scene, calls = self.scene, []
        for n, ((turn, shift), surface, tree) in enumerate(self._bodies):
            out = self.bodies_mm[0, arm, n : n + 1]
            assert isinstance(surface, CompiledSurface), "tensors have a batch of their own"
            limits = (self.radii[name], scene.exact_within_mm, scene.horizon_mm)
            calls.append((fine, given, turn, shift, *limits, *surface.constants, tree.arrays, out))
        return fine, parts, calls

    def beam(self, tip_mm: np.ndarray, aim: np.ndarray, range_mm: float, own: str) -> LoneBeam:
        """The beam of the arm `own` from its tip (1, 3) mm along aim (1, 3), kept arrays."""
        return LoneBeam(self, tip_mm, aim, range_mm, own)

    def look(
        self,
        eye_mm: np.ndarray,
        axis: np.ndarray,
        points_mm: np.ndarray,
        normals: np.ndarray,
        picture: tuple[float, float, float, float],
        short_mm: float,
        own: str,
    ) -> Callable[[], LoneView]:
        """A function that looks from the kept arrays eye_mm and axis (1, 3) at points (1, M, 3).

        picture: lift of the points, half of the field of view, nearest and farthest distance, as
        for `sight.points_in_picture`; short_mm and own as for `BatchedScene.look`.
        """
        count = points_mm.shape[1]
        ends, distance = np.empty((1, count, 3)), np.empty((1, count))
        wanted, clear = np.empty((1, count), bool), np.empty((1, count), bool)
        middle = np.empty((1, 2), np.float32)
        first: tuple = (eye_mm, axis, points_mm, normals, *picture, ends, wanted, distance, middle)
        place: tuple = (eye_mm, ends, distance, short_mm)
        chains = [
            (
                *place,
                line,
                self.radii[name],
                self_contact_gap_mm(self.radii[name]) if name == own else -1.0,
                wanted,
                clear,
            )
            for name, line in self.lines.items()
        ]
        bodies = [(*place, *inward, tree.arrays, clear) for inward, _, tree in self._bodies]
        found = LoneView(wanted, clear, middle)

        def look() -> LoneView:
            points_in_picture(*first)
            if wanted.any():
                clear[:] = wanted
                for call in chains:
                    hide_behind_chain(*call)
                for call in bodies:
                    hide_behind_body(*call)
            else:
                clear[:] = False
            return found

        return look


class LoneBeam:
    """The end of one arm's beam in kept arrays, see `RayHit`; `cast` computes it."""

    def __init__(self, scene: LoneScene, tip_mm, aim, range_mm: float, own: str):
        self._range_mm = float(range_mm)
        self.struck = np.zeros(1, np.int8)
        """(1,) what is met first, a `Struck`."""
        self.body, self.face = np.empty(1, np.int32), np.empty(1, np.int32)
        """(1,) body and face that are met, -1 for none."""
        self.point_mm, self.normal = np.empty((1, 3), np.float32), np.empty((1, 3), np.float32)
        """(1, 3) mm where the beam ends, and the outward unit normal there."""
        self.distance_mm, self.incidence_rad = np.empty(1, np.float32), np.empty(1, np.float32)
        """(1,) mm along the beam, and rad between it and the normal."""
        origins, aims, normals = (np.empty((1, 3)) for _ in range(3))
        self._aims, self._normals, self._t = aims, normals, np.empty(1)
        self._segment, self._before = np.zeros(1, np.int64), np.empty(1)
        found = (self.struck, self.body, self.face, self._t, normals)
        self._aim = (tip_mm, aim, origins, aims)
        self._bodies = [
            (
                origins,
                aims,
                1,
                *inward,
                tree.arrays,
                tree.order,
                surface.normals.numpy(),
                n,
                int(struck_of(body)),
                *found,
            )
            for n, (body, (inward, surface, tree)) in enumerate(
                zip(scene.scene.bodies, scene._bodies, strict=True)
            )
        ]
        rays = (origins.reshape(1, 1, 3), aims.reshape(1, 1, 3))
        ends = (self._t.reshape(1, 1), self._segment.reshape(1, 1))
        self._chains = []
        for name, line in scene.lines.items():
            radius = scene.radii[name]
            gap = self_contact_gap_mm(radius) if name == own else -1.0
            kind = int(Struck.OWN_ARM if name == own else Struck.OTHER_ARM)
            hit = (origins, aims, 1, line, kind, self._before, self._segment, *found)
            self._chains.append(((*rays, line, radius, gap, *ends), hit))
        numbers = (self.distance_mm, self.incidence_rad)
        self._end = (origins, aims, self._t, normals, self.point_mm, self.normal, *numbers)

    def cast(self) -> None:
        """Find what the beam meets now."""
        aim_rays(*self._aim)
        np.negative(self._aims, out=self._normals)
        self.struck[0], self.body[0], self.face[0] = 0, -1, -1
        self._t[0] = self._range_mm
        for call in self._bodies:
            rays_to_body(*call)
        for chain, hit in self._chains:
            self._before[0], self._segment[0] = self._t[0], 0
            rays_to_chains(*chain)
            chain_hits(*hit)
        ray_ends(*self._end)


def strained_clearance(
    surface: Surface,
    stretch: float,
    lines: torch.Tensor,
    given: torch.Tensor,
    turn: torch.Tensor,
    shift: torch.Tensor,
    radius: float,
    within: float,
    horizon: float,
) -> torch.Tensor:
    """(B,) mm: clearance of arms from a body whose frame is a strained one, see `clearance`.

    The surface is plane between the arm and its nearest point, so that a distance d along the
    normal n of the body's frame is d / |T^T n| in the world, T the linear map from the world. n is
    the slope of the distance as the arm is shifted (the envelope theorem), by forward differences.
    A distance beyond the horizon in the body's frame may be less in the world, by the factor
    stretch.
    """
    lines = lines.double()  # float32 would round the slope
    own_horizon = stretch * (horizon + radius) - radius + SLOPE_MM
    place = (radius, within, own_horizon)
    least = surface.clearance(lines, given, turn, shift, *place)
    slope = torch.stack(
        [
            surface.clearance(lines, given, turn, shift + step, *place) - least
            for step in SLOPE_MM * torch.eye(3, dtype=shift.dtype, device=shift.device)
        ],
        1,
    ).to(turn.dtype)
    size = slope.norm(dim=1, keepdim=True)
    normal = slope / size.clamp(min=1e-9)
    scale = (normal[:, None] @ turn)[:, 0].norm(dim=1)
    found = (least + radius) / scale.to(least.dtype) - radius
    known = (size[:, 0] > 0.5 * SLOPE_MM) & (least < own_horizon - SLOPE_MM)
    return torch.where(known, found, least).clamp(max=horizon)


class Surface(Protocol):
    """One body's surface on a device, for clearance queries."""

    normals: torch.Tensor
    """(F, 3) outward unit normals of the faces, in the body's frame."""
    divides: bool
    """Whether `clearance` divides long segments itself."""

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
        """(B,) mm: signed clearance of arms (B, K, 3), world frame; see `CompiledSurface`."""


class CompiledSurface:
    """One body's surface on the CPU, for clearance queries."""

    divides = False

    def __init__(self, tree: TriangleTree, field: DistanceField, device: str | torch.device):
        self._tree = tree
        grid = (field.values_mm, field.origin_mm, field.cell_mm, field.band_mm, field.slack_mm)
        self.constants = (tree.mesh.is_watertight, *grid)
        """What `chains_to_surface` takes of the body beside its tree."""
        self.normals = torch.tensor(np.array(tree.mesh.face_normals), device=device)

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

        given (K,) bool: the centreline's own points, where depth inside the body counts.
        """
        out = torch.empty(len(lines), dtype=lines.dtype)
        arms, points, found = lines.numpy(), given.numpy(), out.numpy()
        turns, shifts = turn.numpy(), shift.numpy()
        rest = (radius, within, horizon, *self.constants, self._tree.arrays)

        def measure(part: slice) -> None:
            frame = (_of_rows(turns, part), _of_rows(shifts, part))
            chains_to_surface(arms[part], points, *frame, *rest, found[part])

        over_rows(len(out), measure)
        return out


@kept
def _field_of(
    mesh: Mesh, margin_mm: float, band_mm: float, most_nodes: int, folder: Path
) -> DistanceField:
    """The field of a mesh, shared by the scenes that hold an equal one: 8 MB, read and checked in a
    hundredth of a second."""
    return load_field(mesh, margin_mm, band_mm, most_nodes, tree_of(mesh), folder)


def _pose_of(body: Body) -> torch.Tensor:
    """(1, 4, 4) body to world, where the scene puts the body."""
    return torch.tensor(np.array(body.pose))[None]


def refined(lines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Arms (B, K, 3) mm with long segments divided, and which points were given (K',) bool.

    The field gives tight bounds on short segments only. The new points lie on the old segments.
    """
    if lines.device.type == "cpu":
        longest = torch.zeros(lines.shape[1] - 1, dtype=lines.dtype)
        longest_steps(lines.numpy(), longest.numpy())
    else:
        steps = frames.norm(lines[:, 1:] - lines[:, :-1]).nan_to_num(0.0, 0.0, 0.0)
        longest = steps.amax(0) if len(lines) else steps.new_zeros(steps.shape[1])
    parts = (longest / LONGEST_SEGMENT_MM).ceil().clamp(1, MOST_PARTS).int().tolist()
    given = torch.zeros(sum(parts) + 1, dtype=torch.bool, device=lines.device)
    given[torch.tensor([0, *parts], device=lines.device).cumsum(0)] = True
    if max(parts) == 1:
        return lines, given
    if lines.device.type == "cpu":
        fine = torch.empty((len(lines), len(given), 3), dtype=lines.dtype)
        whole, counts, divided = lines.numpy(), np.array(parts), fine.numpy()
        over_rows(len(lines), lambda part: divide_steps(whole[part], counts, divided[part]))
        return fine, given
    pieces = [lines[:, :1]]
    for k, count in enumerate(parts):
        share = torch.arange(1, count + 1, device=lines.device, dtype=lines.dtype) / count
        pieces.append(torch.lerp(lines[:, k, None], lines[:, k + 1, None], share[:, None]))
    return torch.cat(pieces, 1), given


def _of_rows(poses: np.ndarray, part: slice) -> np.ndarray:
    """A body's poses (B or 1, ...) in the environments of a slice, or the one in all of them."""
    return poses[part] if len(poses) > 1 else poses


def _held(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor without gradient, contiguous, in single or double precision."""
    tensor = tensor.detach()
    if tensor.dtype not in (torch.float32, torch.float64):
        tensor = tensor.float()
    return tensor.contiguous()
