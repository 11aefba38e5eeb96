"""The exact collision checker (FCL): whole-body collision, clearance and first hits of rays.

No other module imports FCL. `CollisionChecker` takes one pose of the arms per call; `ExactScene`
gives it the interface of `batched.BatchedScene`. FCL works in millimetres, because its iterations
stop at an absolute tolerance. FCL knows surfaces only, so the winding number decides whether a
point is inside a closed body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
import torch

from surgisoft.errors import InputError, unknown_name
from surgisoft.extras import with_advice
from surgisoft.scene import frames
from surgisoft.scene.bvh import STACK, TriangleTree, tree_of
from surgisoft.scene.capsules import (
    HORIZON_MM,
    ArmShape,
    BatchClearance,
    chain_normal,
    folding_pairs,
    ray_chain,
    ray_free_segments,
    segment_distance,
    self_contact_gap_mm,
)
from surgisoft.scene.distance import (
    beam_near_chain,
    beam_near_surface,
    nearest_fold,
    nearest_of_chains,
    nearest_to_surface,
)
from surgisoft.scene.inside import points_inside
from surgisoft.scene.mesh import Body, Mesh, kept
from surgisoft.scene.moving import Placement
from surgisoft.scene.rays import RayHit, Struck, struck_of

with with_advice():
    import fcl

PROBE_WIDTH_MM = 1e-3
"""Width of the triangle that represents a ray; without it FCL misses one hit in six (mm)."""
MOST_CONTACTS = 100_000
"""Upper limit of contacts that one FCL query returns; no ray or capsule reaches it."""
ROUNDING_MM = 1e-6
"""Distances below this count as 0: FCL returns a few 1e-15 for some intersecting surfaces (mm)."""

_HIT_COLUMNS = (
    (np.int8, ()),
    (np.int32, ()),
    (np.int32, ()),
    (np.float64, ()),
    (np.float64, (3,)),
    (np.float64, (3,)),
    (np.float64, ()),
)
"""Data type and shape of a `RayHit`'s fields for one ray, in order."""


@dataclass(frozen=True)
class Collision:
    """One pair of things that overlap."""

    arm: str
    """Name of the arm."""
    other: str
    """Name of the body or of the other arm; the arm's own name for contact with itself."""
    kind: str
    """body, arm or self."""
    inside: bool
    """True when the arm lies wholly inside the body and touches its surface nowhere."""
    segment: int
    """Index of the arm's first colliding segment, base to tip."""


@dataclass(frozen=True)
class Clearance:
    """Signed distances between surfaces (mm), saturating at the horizon; negative means overlap.

    Against a body it is the smaller of two values minus the radius: the distance from the
    centreline to the surface, and the signed distance of the centreline's points (negative inside
    a closed body).
    """

    bodies_mm: Mapping[tuple[str, str], float]
    """(arm, body): mm."""
    arms_mm: Mapping[tuple[str, str], float]
    """(arm, other arm), each pair once: mm."""
    self_mm: Mapping[str, float]
    """Arm against itself, between parts that are far enough apart along it to touch: mm.

    A straight arm reports the distance to the nearest such part, (pi - 2) radii or more."""

    @property
    def least_mm(self) -> float:
        """The smallest against bodies and other arms (mm), inf when there are none."""
        values = [*self.bodies_mm.values(), *self.arms_mm.values()]
        return min(values, default=float("inf"))


def collect_all(
    first: fcl.CollisionObject, second: fcl.CollisionObject, pairs: list[tuple[int, int]]
) -> bool:
    """FCL broad-phase callback that tests every candidate pair and collects those that collide.

    FCL's default callback stops once `num_max_contacts` is reached over all pairs together and so
    misses pairs that collide. `pairs` receives ids of geometries, because the objects that FCL
    passes to a callback are copies.
    """
    result = fcl.CollisionResult()
    if fcl.collide(first, second, fcl.CollisionRequest(), result):
        contact = result.contacts[0]
        pairs.append((id(contact.o1), id(contact.o2)))
    return False


def surface_model(vertices_mm: np.ndarray, faces: np.ndarray) -> fcl.BVHModel:
    """FCL's tree over triangles: vertices (V, 3) mm, faces (F, 3)."""
    model = fcl.BVHModel()
    model.beginModel(len(vertices_mm), len(faces))
    model.addSubModel(np.asarray(vertices_mm), np.asarray(faces))
    model.endModel()
    return model


@kept
def _model_of(mesh: Mesh) -> fcl.BVHModel:
    """FCL's tree of a mesh, shared by the checkers that hold an equal one."""
    return surface_model(mesh.vertices_mm, mesh.faces)


def _placed(geometry, pose: np.ndarray) -> fcl.CollisionObject:
    return fcl.CollisionObject(geometry, fcl.Transform(pose[:3, :3], pose[:3, 3]))


class _Chain:
    """One arm as FCL objects: capsules for overlap, its bare centreline for distances."""

    def __init__(self, name: str, shape: ArmShape):
        self.name, self.shape = name, shape

    @cached_property
    def capsules(self) -> list[fcl.Capsule]:
        """The segments as FCL capsules, base to tip."""
        points = self.shape.centreline_mm
        return [
            fcl.Capsule(self.shape.radius_mm, one) for one in frames.norm(np.diff(points, axis=0))
        ]

    @cached_property
    def segment_of(self) -> dict[int, int]:
        """Id of each capsule -> its segment."""
        return {id(capsule): i for i, capsule in enumerate(self.capsules)}

    @cached_property
    def manager(self) -> fcl.DynamicAABBTreeCollisionManager:
        """The capsules where they are, in FCL's broad phase."""
        points = self.shape.centreline_mm
        axes = points[1:] - points[:-1]
        turns = frames.rotation_from_z(axes + (frames.norm(axes) == 0)[:, None])
        middles = 0.5 * (points[1:] + points[:-1])
        objects = [
            fcl.CollisionObject(capsule, fcl.Transform(turn, middle))
            for capsule, turn, middle in zip(self.capsules, turns, middles, strict=True)
        ]
        manager = fcl.DynamicAABBTreeCollisionManager()
        manager.registerObjects(objects)
        manager.setup()
        return manager

    @cached_property
    def whole(self) -> fcl.CollisionObject:
        """The whole centreline, see `line`."""
        return self.line()

    def line(self, start: int = 0, stop: int | None = None) -> fcl.CollisionObject:
        """Segments start..stop as FCL triangles without width, which give exact distances."""
        points = self.shape.centreline_mm
        index = np.arange(len(points) - 1)[start:stop]
        faces = np.stack((index, index + 1, index + 1), axis=1)
        return fcl.CollisionObject(surface_model(points, faces))

    def part(self, start: int, stop: int) -> fcl.CollisionObject:
        """Segments start..stop alone, which is cheaper to build than `line` with all points."""
        points = self.shape.centreline_mm[start : stop + 1]
        index = np.arange(stop - start)
        return fcl.CollisionObject(
            surface_model(points, np.stack((index, index + 1, index + 1), 1))
        )

    def touches(self, other: fcl.CollisionObject) -> list[int]:
        """Segments that overlap the surface of another object."""
        pairs: list[tuple[int, int]] = []
        self.manager.collide(other, pairs, collect_all)
        return self._segments(pairs)

    def touches_chain(self, other: _Chain) -> list[int]:
        """Segments that overlap any segment of another arm."""
        pairs: list[tuple[int, int]] = []
        self.manager.collide(other.manager, pairs, collect_all)
        return self._segments(pairs)

    def _segments(self, pairs: list[tuple[int, int]]) -> list[int]:
        """This arm's segments among pairs of geometries, base to tip."""
        return sorted({self.segment_of[key] for pair in pairs for key in pair if self.owns(key)})

    def owns(self, geometry: int) -> bool:
        """Whether a geometry's id is one of this arm's capsules."""
        return geometry in self.segment_of

    def folds(self) -> list[int]:
        """Segments that overlap another part of the arm, far enough away along it to touch."""
        least = self.fold_bounds()
        allowed = np.isfinite(least)
        if least.min() > 2.0 * self.shape.radius_mm:
            return []
        pairs: list[tuple[int, int]] = []
        self.manager.collide(pairs, collect_all)
        found = [sorted((self.segment_of[a], self.segment_of[b])) for a, b in pairs]
        return sorted(i for i, j in found if allowed[i, j])

    def fold_bounds(self) -> np.ndarray:
        """(K-1, K-1) mm no segment pair is nearer than, inf where the two cannot touch."""
        line = self.shape.centreline_mm
        middles, halves = 0.5 * (line[1:] + line[:-1]), 0.5 * frames.norm(line[1:] - line[:-1])
        apart = frames.norm(middles[:, None] - middles[None])
        allowed = folding_pairs(line, self.shape.radius_mm)
        return np.where(allowed, apart - halves[:, None] - halves, np.inf)


def _distance(first: fcl.CollisionObject, second: fcl.CollisionObject) -> float:
    """Distance in mm between two trees, 0 when they cross."""
    return max(0.0, fcl.distance(first, second, fcl.DistanceRequest(), fcl.DistanceResult()))


class CollisionChecker:
    """Exact collision, clearance and ray queries of a scene (FCL), one pose of the arms per call.

    Build it once for a set of bodies. `arms` maps an arm's name to its `ArmShape`.
    """

    def __init__(self, bodies: Sequence[Body], horizon_mm: float = HORIZON_MM):
        names = [body.name for body in bodies]
        if len(set(names)) != len(names):
            raise InputError(f"body names repeat: {', '.join(sorted(names))}; rename one")
        self.bodies = tuple(bodies)
        self.horizon_mm = float(horizon_mm)
        self._inward = [frames.invert(body.pose) for body in bodies]
        self._levels: dict[tuple[int, int], tuple[Mesh, fcl.BVHModel]] = {}
        self._objects = [_placed(_model_of(body.mesh), body.pose) for body in bodies]

    def __reduce__(self):
        """Pickle the bodies: FCL's objects cannot be pickled, so a copy builds its own."""
        return type(self), (self.bodies, self.horizon_mm)

    def moved(self, placement: Placement, environment: int) -> CollisionChecker:
        """The checker with the bodies where a placement puts them in one environment.

        The strained surface of each level is built once and kept.
        """
        checker = object.__new__(type(self))  # `copy.copy` would build every surface anew
        checker.__dict__.update(self.__dict__)
        level = int(placement.level[environment])
        rigid = placement.rigid[environment].detach().cpu().double().numpy()
        strain = placement.strains[level].detach().cpu().double().numpy()
        bodies, inward, objects = list(self.bodies), list(self._inward), list(self._objects)
        for index, body in enumerate(self.bodies):
            if body.name in placement.at_rest:
                mesh, model = self._strained(index, level, strain)
                bodies[index] = Body(body.name, body.role, mesh, rigid)
                inward[index], objects[index] = frames.invert(rigid), _placed(model, rigid)
        checker.bodies, checker._inward, checker._objects = tuple(bodies), inward, objects
        return checker

    def _strained(self, index: int, level: int, strain: np.ndarray) -> tuple[Mesh, fcl.BVHModel]:
        """Mesh in the world frame at rest, strained (4, 4), and FCL's tree over it."""
        known = self._levels.get((index, level))
        if known is None:
            mesh = self.bodies[index].world_mesh
            mesh = Mesh(frames.apply(strain, mesh.vertices_mm), mesh.faces)
            known = mesh, surface_model(mesh.vertices_mm, mesh.faces)
            self._levels[index, level] = known
        return known

    def inside(self, body: int, points_mm: np.ndarray) -> np.ndarray:
        """(N,) bool: world points (N, 3) mm inside body number `body`; never in an open mesh."""
        mesh = self.bodies[body].mesh
        points = frames.apply(self._inward[body], points_mm)
        return points_inside(mesh, points)

    def collisions(self, arms: Mapping[str, ArmShape]) -> tuple[Collision, ...]:
        """Every overlapping pair: arm and body, arm and arm, arm and itself."""
        chains = [_Chain(name, shape) for name, shape in arms.items()]
        found: list[Collision] = []
        for chain in chains:
            for index, body in enumerate(self.bodies):
                found += self._body_collision(chain, index, body.name)
            if folded := chain.folds():
                found.append(Collision(chain.name, chain.name, "self", False, folded[0]))
        for first, second in combinations(chains, 2):
            if touching := first.touches_chain(second):
                found.append(Collision(first.name, second.name, "arm", False, touching[0]))
        return tuple(found)

    def _body_collision(self, chain: _Chain, index: int, name: str) -> list[Collision]:
        if touching := chain.touches(self._objects[index]):
            return [Collision(chain.name, name, "body", False, touching[0])]
        if self.inside(index, chain.shape.centreline_mm[:1])[0]:
            return [Collision(chain.name, name, "body", True, 0)]
        return []

    def clearance(self, arms: Mapping[str, ArmShape]) -> Clearance:
        """Signed distances of every pair (mm), see `Clearance`."""
        chains = [_Chain(name, shape) for name, shape in arms.items()]
        bodies = {
            (chain.name, body.name): self._body_clearance(chain, index)
            for chain in chains
            for index, body in enumerate(self.bodies)
        }
        pairs = {
            (a.name, b.name): self._saturated(
                _distance(a.whole, b.whole) - a.shape.radius_mm - b.shape.radius_mm
            )
            for a, b in combinations(chains, 2)
        }
        return Clearance(bodies, pairs, {c.name: self._self_clearance(c) for c in chains})

    def _saturated(self, clearance_mm: float) -> float:
        return min(clearance_mm, self.horizon_mm)

    def _body_clearance(self, chain: _Chain, index: int) -> float:
        centre = _distance(chain.whole, self._objects[index])
        for point in self._points_within(chain.shape.centreline_mm, index, centre > ROUNDING_MM):
            ball = fcl.CollisionObject(fcl.Sphere(0.0), fcl.Transform(point))
            centre = min(centre, -_distance(ball, self._objects[index]))
        return self._saturated(centre - chain.shape.radius_mm)

    def _points_within(self, points: np.ndarray, index: int, uncut: bool) -> np.ndarray:
        """The centreline points inside a body; `uncut`: the line does not cross its surface."""
        if uncut:
            return points if self.inside(index, points[:1])[0] else points[:0]
        return points[self.inside(index, points)]

    def _self_clearance(self, chain: _Chain) -> float:
        """FCL's distance of the segments that the closed form finds nearest, minus two radii.

        What FCL finds for a segment rules out those that the closed form puts farther away.
        """
        line, least = chain.shape.centreline_mm, np.inf
        allowed = folding_pairs(line, chain.shape.radius_mm)
        if allowed.any():
            a, b = line[:-1, None], line[1:, None]
            apart = segment_distance(a, b, line[None, :-1], line[None, 1:])
            bounds = np.where(allowed, apart, np.inf)
            nearest = bounds.min(axis=1)
            for i in np.argsort(nearest):
                if nearest[i] < least - ROUNDING_MM:
                    first = int(np.argmax(allowed[i]))
                    found = _distance(chain.line(i, i + 1), chain.line(first))
                    least = min(least, found)
        return self._saturated(least - 2.0 * chain.shape.radius_mm)

    def cast_each(
        self,
        origins_mm: np.ndarray,
        directions: np.ndarray,
        range_mm: float,
        lines_mm: Mapping[str, np.ndarray],
        radii_mm: Mapping[str, float],
        own: str | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """First hit of each of B rays: a `Struck` (B,) int8, and its end (B, 3) mm.

        As `cast`, each ray (B, 3) among arms of its own: name -> (B, K, 3) mm. Closed forms are
        evaluated for all rays at once; FCL finds the faces, of bodies whose box the ray enters
        before it meets an arm.
        """
        origins = np.asarray(origins_mm, dtype=np.float64)
        aims = frames.normalise(np.asarray(directions, dtype=np.float64))
        t, struck = np.full(len(origins), range_mm), np.zeros(len(origins), np.int8)
        for name, line in lines_mm.items():
            free = ray_free_segments(line, radii_mm[name]) if name == own else None
            found, _ = ray_chain(origins, aims, line, radii_mm[name], free)
            nearer = found < t
            t = np.where(nearer, found, t)
            struck[nearer] = Struck.OWN_ARM if name == own else Struck.OTHER_ARM
        request = fcl.CollisionRequest(num_max_contacts=MOST_CONTACTS, enable_contact=True)
        for index, body in enumerate(self.bodies):
            inward = self._inward[index]
            o, d = frames.apply(inward, origins), frames.rotate(inward, aims)
            rows, faces = [], []
            for row in np.flatnonzero(_enter_box(o, d, t, body.mesh.bounds_mm)):
                result = fcl.CollisionResult()
                probe = _probe(origins[row], aims[row], t[row])
                if fcl.collide(self._objects[index], probe, request, result):
                    faces += [contact.b1 for contact in result.contacts]
                    rows += [row] * len(result.contacts)
            if rows:
                each = np.array(rows)
                hits = ray_triangles(o[each], d[each], body.mesh.triangles_mm[np.array(faces)])
                nearest = np.full(len(t), np.inf)
                np.minimum.at(nearest, each, hits)
                nearer = nearest < t
                t = np.where(nearer, nearest, t)
                struck[nearer] = struck_of(body)
        return struck, origins + t[:, None] * aims

    def cast(
        self,
        origins_mm: np.ndarray,
        directions: np.ndarray,
        range_mm: float,
        arms: Mapping[str, ArmShape] | None = None,
        own: str | None = None,
    ) -> RayHit:
        """First hits of rays: origins (..., 3) mm and directions (..., 3), world frame.

        `own` names the arm that carries the beam: its segments near the tip do not block it.
        """
        origins = np.asarray(origins_mm, dtype=np.float64)
        directions = frames.normalise(np.asarray(directions, dtype=np.float64))
        batch = origins.shape[:-1]
        columns = [np.empty(batch + tail, kind) for kind, tail in _HIT_COLUMNS]
        met = [
            _arm_met(origins, directions, shape, name == own)
            for name, shape in (arms or {}).items()
        ]
        rays = origins.reshape(-1, 3), directions.reshape(-1, 3)
        enters = [
            _enter_box(
                frames.apply(inward, rays[0]),
                frames.rotate(inward, rays[1]),
                range_mm,
                body.mesh.bounds_mm,
            ).reshape(batch)
            for inward, body in zip(self._inward, self.bodies, strict=True)
        ]
        for index in np.ndindex(batch):
            among = [number for number, enter in enumerate(enters) if enter[index]]
            hit = self._cast_one(origins[index], directions[index], range_mm, met, among, index)
            for column, value in zip(columns, hit, strict=True):
                column[index] = value
        return RayHit(*columns)

    def _cast_one(self, origin, direction, range_mm, met, among, index=()) -> tuple:
        """Fields of the `RayHit` of one ray.

        met: of each arm what `_arm_met` found for all rays, of which this is number `index`; among:
        numbers of the bodies to ask FCL about.
        """
        best = (Struck.NOTHING, -1, -1, range_mm, origin + range_mm * direction, -direction)
        probe = _probe(origin, direction, range_mm) if among else None
        for number in among:
            body = self.bodies[number]
            face, t = self._first_face(number, probe, origin, direction, best[3])
            if face >= 0:
                normal = body.pose[:3, :3] @ body.mesh.face_normals[face]
                best = (struck_of(body), number, face, t, origin + t * direction, normal)
        for kind, line, distance, segment in met:
            t = distance[index]
            if t < best[3]:
                point = origin + t * direction
                best = (kind, -1, -1, t, point, chain_normal(point, line, segment[index]))
        cosine = abs(frames.dot(best[5], direction))
        sine = frames.norm(frames.cross(best[5], direction))
        return (*best, float(np.arctan2(sine, cosine)))

    def _first_face(self, index: int, probe, origin, direction, range_mm) -> tuple[int, float]:
        """Nearest face of a body on a ray and its distance, (-1, range) for none."""
        request = fcl.CollisionRequest(num_max_contacts=MOST_CONTACTS, enable_contact=True)
        result = fcl.CollisionResult()
        if not fcl.collide(self._objects[index], probe, request, result):
            return -1, range_mm
        faces = np.array([contact.b1 for contact in result.contacts])
        inward = self._inward[index]
        o = inward[:3, :3] @ origin + inward[:3, 3]
        d = inward[:3, :3] @ direction
        t = ray_triangles(o, d, self.bodies[index].mesh.triangles_mm[faces])
        nearest = int(np.argmin(t))
        return (
            (int(faces[nearest]), float(t[nearest])) if t[nearest] <= range_mm else (-1, range_mm)
        )


def _arm_met(origins, directions, shape: ArmShape, own: bool) -> tuple:
    """Where rays (..., 3) meet an arm: what it is to them, its centreline, distance and segment.

    own: whether the arm carries the beams.
    """
    line = shape.centreline_mm
    free = ray_free_segments(line, shape.radius_mm) if own else None
    t, segment = ray_chain(origins, directions, line, shape.radius_mm, free)
    return Struck.OWN_ARM if own else Struck.OTHER_ARM, line, t, segment


def _probe(origin, direction, range_mm: float) -> fcl.CollisionObject:
    """A ray as one long triangle, a micrometre wide."""
    across = np.zeros(3)
    across[np.argmin(np.abs(direction))] = 1.0
    side = frames.normalise(frames.cross(direction, across)) * PROBE_WIDTH_MM
    end = origin + range_mm * direction
    corners = np.stack((origin, end, end + side))
    return fcl.CollisionObject(surface_model(corners, np.array([[0, 1, 2]])))


def _enter_box(origins, directions, range_mm, bounds_mm) -> np.ndarray:
    """(N,) bool: the ray (N, 3) enters the box (2, 3) mm before its range, with room for rounding.

    By slabs (Kay & Kajiya 1986).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        low = (bounds_mm[0] - ROUNDING_MM - origins) / directions
        high = (bounds_mm[1] + ROUNDING_MM - origins) / directions
    # 0 / 0: the ray runs along the slab's face, which counts as inside.
    first = np.nan_to_num(np.minimum(low, high), nan=-np.inf, neginf=-np.inf, posinf=np.inf)
    last = np.nan_to_num(np.maximum(low, high), nan=np.inf, neginf=-np.inf, posinf=np.inf)
    first, last = first.max(axis=1), last.min(axis=1)
    return (first <= last) & (last >= 0.0) & (first <= range_mm)


def ray_triangles(
    origin: np.ndarray, direction: np.ndarray, triangles_mm: np.ndarray
) -> np.ndarray:
    """(N,) distances along a ray to triangles (N, 3, 3), inf for a miss; from either side.

    Moeller & Trumbore 1997; a hit on an edge belongs to the triangle within rounding.
    """
    slack = 1e-12
    a = triangles_mm[:, 0]
    e1, e2 = triangles_mm[:, 1] - a, triangles_mm[:, 2] - a
    p = frames.cross(direction, e2)
    determinant = frames.dot(e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - a
        u = frames.dot(s, p) / determinant
        q = frames.cross(s, e1)
        v = frames.dot(direction, q) / determinant
        t = frames.dot(e2, q) / determinant
        hit = (u >= -slack) & (v >= -slack) & (u + v <= 1 + slack) & (t >= 0)
    return np.where(hit, t, np.inf)


class ExactScene:
    """Clearances and ray hits by FCL with the interface of `batched.BatchedScene`.

    FCL evaluates one environment after the other. Bodies stand where the scene puts them, but for
    those that `poses` move. `arms` maps a name to centrelines (B, K, 3) mm, world frame. An
    environment whose arm or ray is not finite gets nan clearances and missed rays.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        radii_mm: Mapping[str, float],
        device: str | torch.device = "cpu",
    ):
        self.bodies, self.radii_mm = tuple(bodies), dict(radii_mm)
        self.device = torch.device(device)
        self.checker = CollisionChecker(self.bodies)
        self._trees: dict[int, tuple[Mesh, TriangleTree]] = {}
        self._guided = GuidedChecker(self.checker, self._trees)

    def radius_mm(self, arm: str) -> float:
        """Radius of an arm by name (mm)."""
        if arm not in self.radii_mm:
            raise unknown_name("arm", arm, self.radii_mm)
        return self.radii_mm[arm]

    def clearance(
        self, arms: Mapping[str, torch.Tensor], poses: Placement | None = None
    ) -> BatchClearance:
        """Signed clearances of every pair; arms name -> (B, K, 3) mm."""
        names, first = list(arms), next(iter(arms.values()))
        pairs = list(combinations(names, 2))
        found = np.full((len(first), len(names) * (len(self.bodies) + 1) + len(pairs)), np.nan)
        for i, (row, shapes) in enumerate(zip(found, self._shapes(arms), strict=True)):
            if shapes is not None:
                to_bodies, apart, own = self.guided(poses, i).clearances(shapes)
                row[:] = [*to_bodies, *apart, *own]
        values = torch.as_tensor(found, dtype=first.dtype, device=self.device)
        sizes = (len(names) * len(self.bodies), len(pairs), len(names))
        bodies, apart, own = values.split(sizes, 1)
        return BatchClearance(bodies.unflatten(1, (len(names), len(self.bodies))), apart, own)

    def cast(
        self,
        origins_mm: torch.Tensor,
        directions: torch.Tensor,
        range_mm: float,
        arms: Mapping[str, torch.Tensor] | None = None,
        own: str | None = None,
        poses: Placement | None = None,
    ) -> RayHit:
        """First hits of rays (B, ..., 3), world frame, as a `RayHit` of (B, ...) tensors."""
        origins, aims = _numpy(origins_mm), _numpy(directions)
        shapes = self._shapes(arms or {}) if arms else [{}] * len(origins)
        hits = [
            _missed(o, d, range_mm)
            if near is None or not (np.isfinite(o).all() and np.isfinite(d).all())
            else self.guided(poses, i).cast_all(o, d, range_mm, near, own)
            for i, (o, d, near) in enumerate(zip(origins, aims, shapes, strict=True))
        ]
        parts = {name: np.stack([getattr(hit, name) for hit in hits]) for name in vars(hits[0])}
        held = {name: torch.as_tensor(part, device=self.device) for name, part in parts.items()}
        kind = origins_mm.dtype
        return RayHit(
            **{
                name: part.to(kind) if part.is_floating_point() else part
                for name, part in held.items()
            }
        )

    def alone(self, lines: Mapping[str, np.ndarray]) -> LoneExact:
        """Queries of one environment among bodies at rest."""
        return LoneExact(self, lines)

    def guided(self, poses: Placement | None = None, environment: int = 0) -> GuidedChecker:
        """FCL with the bodies of one environment."""
        if poses is None:
            return self._guided
        return GuidedChecker(self.checker.moved(poses, environment), self._trees)

    def _shapes(self, arms: Mapping[str, torch.Tensor]) -> list[dict[str, ArmShape] | None]:
        """Each environment's arms; None where one of them is not finite."""
        lines = {name: _numpy(line) for name, line in arms.items()}
        count = len(next(iter(lines.values())))
        return [
            {name: ArmShape(line[i], self.radius_mm(name)) for name, line in lines.items()}
            if all(np.isfinite(line[i]).all() for line in lines.values())
            else None
            for i in range(count)
        ]


GUIDE_SLACK_MM = 1e-6
"""Rounding that the compiled search for the nearest segments may have (mm); of the segments within
it of the nearest all are given to FCL."""
GUIDED_FACES = 5_000
"""Faces of a body up to which FCL is guided (a count): beside larger ones the search may cost more
than FCL's distance of the whole arm (`surgisoft benchmark scaling`)."""
BEAM_SLACK_MM = 0.01
"""FCL and the closed forms are asked about everything that comes within this of a beam (mm): ten
times the width of the triangle that represents the beam."""
_REQUEST = fcl.DistanceRequest()
_WITHOUT_POINTS = fcl.DistanceResult(min_distance_=-np.inf)
"""A result that FCL leaves alone; it saves the conversion of the nearest points."""


class GuidedChecker:
    """FCL's clearances and beams of one pose of the arms, cheaper than by `CollisionChecker`.

    FCL decides: each distance is FCL's, and each face that a beam meets is one that FCL found. A
    compiled search first finds the segments that come nearest, so that FCL is asked about these and
    not about whole arms; it is not asked about what lies beyond the horizon, nor about bodies that
    a beam does not come near. Where FCL's distance differs from that of the search by more than
    `GUIDE_SLACK_MM` FCL measures whole arms. The exact checks of evaluations are not guided.
    """

    def __init__(
        self, checker: CollisionChecker, trees: dict[int, tuple[Mesh, TriangleTree]] | None = None
    ):
        """trees: those of meshes seen before, by the id of the mesh; new ones are added."""
        self.checker = checker
        self.asked_whole = 0
        """How often FCL had to measure whole arms."""
        known = {} if trees is None else trees
        self._trees = []
        for body in checker.bodies:
            mesh = body.mesh
            held = known.get(id(mesh))
            if held is None or held[0] is not mesh:  # a copy of the dict has ids of other meshes
                held = known[id(mesh)] = mesh, tree_of(mesh)
            self._trees.append(held[1].arrays)
        self._frames = [(inward[:3, :3].copy(), inward[:3, 3].copy()) for inward in checker._inward]
        self._work = (np.empty(STACK, np.int64), np.empty(STACK))

    def clearances(self, arms: Mapping[str, ArmShape]) -> tuple[list[float], ...]:
        """Clearances (mm) of all arms: from each body, arm by arm; of each pair; of each itself."""
        chains = [_Chain(name, shape) for name, shape in arms.items()]
        bodies = [self._to_body(chain, n) for chain in chains for n in range(len(self._trees))]
        pairs = [self._between(one, other) for one, other in combinations(chains, 2)]
        return bodies, pairs, [self._to_itself(chain) for chain in chains]

    def _to_body(self, chain: _Chain, index: int) -> float:
        checker, line = self.checker, chain.shape.centreline_mm
        bound, found = checker.horizon_mm + chain.shape.radius_mm, np.empty(2, np.int64)
        guide = (bound, GUIDE_SLACK_MM, self._trees[index], found, *self._work)
        least = None
        if len(checker.bodies[index].mesh.faces) <= GUIDED_FACES:
            least = nearest_to_surface(line, *self._frames[index], *guide)
        body = checker._objects[index]
        if least is None:
            centre = min(_least(chain.whole, body), bound)
        elif least >= bound:  # the clearance saturates
            centre = least
        else:
            centre = _least(chain.part(found[0], found[1] + 1), body)
            if abs(centre - least) > GUIDE_SLACK_MM:
                self.asked_whole += 1
                centre = _least(chain.whole, body)
        uncut = centre > ROUNDING_MM
        low, high = checker.bodies[index].mesh.bounds_mm
        if uncut:
            turn, shift = self._frames[index]
            first = turn @ line[0] + shift
            if (first < low).any() or (first > high).any():
                return checker._saturated(centre - chain.shape.radius_mm)
        for point in checker._points_within(line, index, uncut):
            ball = fcl.CollisionObject(fcl.Sphere(0.0), fcl.Transform(point))
            centre = min(centre, -_distance(ball, body))
        return checker._saturated(centre - chain.shape.radius_mm)

    def _between(self, one: _Chain, other: _Chain) -> float:
        radii = one.shape.radius_mm + other.shape.radius_mm
        bound, found = self.checker.horizon_mm + radii, np.empty(4, np.int64)
        lines = (one.shape.centreline_mm, other.shape.centreline_mm)
        least = nearest_of_chains(*lines, bound, GUIDE_SLACK_MM, found)
        if least < bound:
            parts = one.part(found[0], found[1] + 1), other.part(found[2], found[3] + 1)
            asked = _least(*parts)
            if abs(asked - least) > GUIDE_SLACK_MM:
                self.asked_whole += 1
                asked = _least(one.whole, other.whole)
            least = asked
        return self.checker._saturated(least - radii)

    def _to_itself(self, chain: _Chain) -> float:
        radius, line = chain.shape.radius_mm, chain.shape.centreline_mm
        bound, found = self.checker.horizon_mm + 2.0 * radius, np.empty(2, np.int64)
        least = nearest_fold(line, self_contact_gap_mm(radius), bound, found)
        if least >= bound:
            return self.checker.horizon_mm
        first, second = map(int, found)
        asked = _least(chain.part(first, first + 1), chain.part(second, second + 1))
        if abs(asked - least) <= GUIDE_SLACK_MM:
            return self.checker._saturated(asked - 2.0 * radius)
        self.asked_whole += 1
        return self.checker._self_clearance(chain)

    def cast(
        self,
        origin_mm: np.ndarray,
        direction: np.ndarray,
        range_mm: float,
        arms: Mapping[str, ArmShape],
        own: str | None = None,
    ) -> tuple:
        """Fields of the `RayHit` of one ray (3,) mm along (3,); see `CollisionChecker.cast`."""
        direction = frames.normalise(direction)
        ray = (origin_mm, direction, float(range_mm))
        bodies = [
            index
            for index, tree in enumerate(self._trees)
            if beam_near_surface(*ray, *self._frames[index], BEAM_SLACK_MM, tree, *self._work)
        ]
        near = []
        for name, shape in arms.items():
            gap = self_contact_gap_mm(shape.radius_mm) if name == own else -1.0
            if beam_near_chain(*ray, shape.centreline_mm, shape.radius_mm, gap, BEAM_SLACK_MM):
                near.append(_arm_met(origin_mm, direction, shape, name == own))
        return self.checker._cast_one(*ray, near, bodies)

    def cast_all(
        self,
        origins_mm: np.ndarray,
        directions: np.ndarray,
        range_mm: float,
        arms: Mapping[str, ArmShape],
        own: str | None = None,
    ) -> RayHit:
        """First hits of rays (..., 3) mm along (..., 3); see `CollisionChecker.cast`."""
        shape = origins_mm.shape[:-1]
        columns = [np.empty(shape + tail, kind) for kind, tail in _HIT_COLUMNS]
        for index in np.ndindex(shape):
            hit = self.cast(origins_mm[index], directions[index], range_mm, arms, own)
            for column, value in zip(columns, hit, strict=True):
                column[index] = value
        return RayHit(*columns)


class LoneExact:
    """Clearance and beams by FCL of one environment among bodies at rest, in kept arrays.

    `lines` name -> (1, K, 3) float32 mm are the arms' centrelines, which the caller overwrites
    between two queries. It has the interface of `batched.LoneScene`.
    """

    def __init__(self, scene: ExactScene, lines: Mapping[str, np.ndarray]):
        self.guided, self.lines = scene.guided(), dict(lines)
        self.radii = {name: scene.radius_mm(name) for name in lines}
        arms, bodies = len(lines), len(scene.bodies)
        self.bodies_mm = np.empty((1, arms, bodies), np.float32)
        """(1, A, N) mm: clearance of each arm from each body, see `BatchClearance`."""
        self.arms_mm = np.empty((1, arms * (arms - 1) // 2), np.float32)
        """(1, A (A - 1) / 2) mm: of each pair of arms."""
        self.self_mm = np.empty((1, arms), np.float32)
        """(1, A) mm: of each arm from itself."""

    def shapes(self) -> dict[str, ArmShape] | None:
        """The arms as they are; None where one is not finite."""
        if not all(np.isfinite(line).all() for line in self.lines.values()):
            return None
        return {name: ArmShape(line[0], self.radii[name]) for name, line in self.lines.items()}

    def clearance(self) -> None:
        """Fill `bodies_mm`, `arms_mm` and `self_mm`."""
        shapes = self.shapes()
        if shapes is None:
            for array in (self.bodies_mm, self.arms_mm, self.self_mm):
                array[:] = np.nan
            return
        bodies, self.arms_mm[0], self.self_mm[0] = self.guided.clearances(shapes)
        self.bodies_mm.reshape(-1)[:] = bodies

    def beam(self, tip_mm: np.ndarray, aim: np.ndarray, range_mm: float, own: str) -> LoneExactBeam:
        """The beam of the arm `own` from its tip (1, 3) mm along aim (1, 3), kept arrays."""
        return LoneExactBeam(self, tip_mm, aim, range_mm, own)


class LoneExactBeam:
    """The end of one arm's beam by FCL in kept arrays, see `RayHit`; `cast` computes it."""

    def __init__(self, scene: LoneExact, tip_mm, aim, range_mm: float, own: str):
        self._scene, self._tip_mm, self._aim = scene, tip_mm, aim
        self._range_mm, self._own = range_mm, own
        self.struck = np.zeros(1, np.int8)
        """(1,) what is met first, a `Struck`."""
        self.body, self.face = np.empty(1, np.int32), np.empty(1, np.int32)
        """(1,) body and face that are met, -1 for none."""
        self.point_mm, self.normal = np.empty((1, 3), np.float32), np.empty((1, 3), np.float32)
        """(1, 3) mm where the beam ends, and the outward unit normal there."""
        self.distance_mm, self.incidence_rad = np.empty(1, np.float32), np.empty(1, np.float32)
        """(1,) mm along the beam, and rad between it and the normal."""

    def cast(self) -> None:
        """Find what the beam meets now."""
        origin, aim = self._tip_mm[0].astype(np.float64), self._aim[0].astype(np.float64)
        shapes = self._scene.shapes()
        if shapes is None or not (np.isfinite(origin).all() and np.isfinite(aim).all()):
            fields = tuple(vars(_missed(origin, aim, self._range_mm)).values())
        else:
            fields = self._scene.guided.cast(origin, aim, self._range_mm, shapes, self._own)
        names = ("struck", "body", "face", "distance_mm", "point_mm", "normal", "incidence_rad")
        for name, value in zip(names, fields, strict=True):
            getattr(self, name)[0] = value


def _least(first: fcl.CollisionObject, second: fcl.CollisionObject) -> float:
    """`_distance` without its nearest points, which cost more than a short arm's distance."""
    return max(0.0, fcl.distance(first, second, _REQUEST, _WITHOUT_POINTS))


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()


def _missed(origins: np.ndarray, aims: np.ndarray, range_mm: float) -> RayHit:
    """Missed rays (..., 3) with finite fields, also where origin or direction is not finite."""
    shape, none = origins.shape[:-1], np.full(origins.shape[:-1], -1, np.int32)
    zero = np.zeros(shape)
    end = np.nan_to_num(origins + range_mm * aims, nan=0.0, posinf=0.0, neginf=0.0)
    return RayHit(
        np.full(shape, int(Struck.NOTHING), np.int8),
        none,
        none,
        zero + range_mm,
        end,
        np.nan_to_num(-aims),
        zero,
    )
