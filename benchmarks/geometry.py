"""Speed of the geometry engines: rays, clearances and collisions per second.

    python benchmarks/geometry.py            a minute or so on one core
    python benchmarks/geometry.py --json F   the same numbers as JSON

Every engine gets the same mesh and the same arms. Rates are the best of several repeats on one
thread; `x FCL` and `x trimesh` say how many times as fast an engine is as those two, asked in the
plainest way for the same thing.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import fcl
import numpy as np
import torch
import trimesh

from surgisoft.scene import frames
from surgisoft.scene.batched import BatchedScene, refined
from surgisoft.scene.bvh import build_tree
from surgisoft.scene.camera import Camera
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker, surface_model
from surgisoft.scene.field import build_field
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.rays import EmbreeSurface
from surgisoft.scene.render import Renderer
from surgisoft.scene.torch_queries import TorchTree

RADIUS_MM = 7.5
LENGTH_MM = 70.0
SEGMENTS = 24
RANGE_MM = 200.0
MARGIN_MM, BAND_MM = 70.0, 20.0
SIZES = (1_000, 10_000, 100_000, 1_000_000)


def organ(faces: int) -> Mesh:
    """A closed lumpy blob of 180 x 130 x 100 mm with about so many faces."""
    rows = max(4, round((faces / 4) ** 0.5))
    u, v = np.meshgrid(np.arange(2 * rows) * np.pi / rows, np.linspace(0, np.pi, rows + 1)[1:-1])
    ring = np.stack((np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)), -1).reshape(-1, 3)
    unit = np.concatenate((ring, [[0, 0, 1.0], [0, 0, -1.0]]))
    bumps = (
        1
        + 0.06 * np.sin(4 * unit[:, 0] + 1) * np.cos(5 * unit[:, 1])
        - 0.2 * np.exp(-12 * (unit[:, 0] - 0.2) ** 2) * np.clip(unit[:, 2], 0, 1)
    )
    i, j = np.meshgrid(np.arange(rows - 2), np.arange(2 * rows), indexing="ij")
    a, b = i * 2 * rows + j, i * 2 * rows + (j + 1) % (2 * rows)
    c, d = a + 2 * rows, b + 2 * rows
    sides = np.stack((a, c, b, b, c, d), -1).reshape(-1, 3)
    j = np.arange(2 * rows)
    after, top, bottom = (j + 1) % (2 * rows), len(ring), len(ring) + 1
    low = (rows - 2) * 2 * rows
    caps = np.concatenate(
        (
            np.stack((np.full_like(j, top), j, after), 1),
            np.stack((np.full_like(j, bottom), low + after, low + j), 1),
        )
    )
    mesh = Mesh(unit * bumps[:, None] * [90, 65, 50], np.concatenate((sides, caps)))
    if not (mesh.is_watertight and mesh.volume_mm3 > 0):
        raise AssertionError("the benchmark's mesh is not closed")
    return mesh


def arms(count: int, least: float, most: float, seed: int = 0) -> np.ndarray:
    """Centrelines (count, K, 3) mm of bent arms with tips this far from the surface, about."""
    rng = np.random.default_rng(seed)
    away = frames.normalise(rng.normal(size=(count, 3)))
    surface = away / np.sqrt(((away / [90, 65, 50]) ** 2).sum(1, keepdims=True))
    base = surface + away * (LENGTH_MM + rng.uniform(least, most, (count, 1)))
    poses = frames.pose_from_z(base, -away + 0.15 * rng.normal(size=(count, 3)))
    bend, s = rng.uniform(0.1, 1.2, (count, 1)), np.linspace(0, 1, SEGMENTS + 1)
    radius = LENGTH_MM / bend
    line = (radius * (1 - np.cos(bend * s)), 0 * bend * s, radius * np.sin(bend * s))
    return frames.apply(poses, np.stack(line, -1))


def rate(function, items: int, repeats: int = 3) -> float:
    """Items a second, best of several calls after one to warm up."""
    function()
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        best = min(best, time.perf_counter() - start)
    return items / best


def seconds(function) -> float:
    """Duration of one call, s."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def fcl_capsules(line: np.ndarray) -> list[fcl.CollisionObject]:
    """FCL capsules along a centreline (K, 3) mm."""
    axes = line[1:] - line[:-1]
    turns, lengths = frames.rotation_from_z(axes), frames.norm(axes)
    middles = 0.5 * (line[1:] + line[:-1])
    return [
        fcl.CollisionObject(fcl.Capsule(RADIUS_MM, length), fcl.Transform(turn, middle))
        for length, turn, middle in zip(lengths, turns, middles, strict=True)
    ]


def ray_rates(mesh: Mesh, cache: Path) -> dict[str, float]:
    """Rays a second of every engine on one mesh."""
    rng = np.random.default_rng(1)
    origins = frames.normalise(rng.normal(size=(4096, 3))) * 130.0
    aims = frames.normalise(rng.normal(size=(4096, 3)) * 35.0 - origins)
    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    body = Body("organ", "organ", mesh)
    scene = BatchedScene([body], {"laser": RADIUS_MM, "scope": RADIUS_MM}, cache=cache)
    o, d = torch.tensor(origins).float(), torch.tensor(aims).float()
    both = {n: torch.tensor(arms(4096, 0, 40, i)).float() for i, n in enumerate(scene.radii_mm)}
    embree, checker, tree = (
        EmbreeSurface(mesh),
        CollisionChecker([body]),
        TorchTree(build_tree(mesh), "cpu"),
    )
    reach = torch.full((4096,), RANGE_MM, dtype=torch.float64)
    caster = solid.ray
    few = 64
    return {
        "trimesh, Embree, intersects_location": rate(
            lambda: caster.intersects_location(origins, aims, multiple_hits=False), 4096
        ),
        "raw FCL, sliver against mesh": rate(
            lambda: [raw_fcl_ray(checker, origins[i], aims[i]) for i in range(few)], few
        ),
        "FCL, one ray a call": rate(
            lambda: [checker.cast(origins[i], aims[i], RANGE_MM) for i in range(few)], few
        ),
        "Embree + float64, batch": rate(lambda: embree.first_hit(origins, aims, RANGE_MM), 4096),
        "batched cast, no arms": rate(lambda: scene.cast(o, d, RANGE_MM), 4096),
        "batched cast, two arms in the way": rate(
            lambda: scene.cast(o, d, RANGE_MM, both, "laser"), 4096
        ),
        "torch tree on this CPU": rate(
            lambda: tree.first_hit(o.double(), d.double(), reach), 4096, 1
        ),
    }


def picture_rate(mesh: Mesh) -> dict[str, float]:
    """Endoscope pictures a second, an arm and the beam in view."""
    renderer = Renderer([Body("organ", "organ", mesh)], Camera())
    pose = frames.look_at(np.array([0.0, 0.0, 110.0]), np.zeros(3))
    shapes = {"laser": ArmShape(arms(1, 5.0, 15.0)[0], RADIUS_MM)}
    beam = np.array([[20.0, 0.0, 70.0], [0.0, 0.0, 50.0]])
    name = f"picture of {renderer.width} x {renderer.height}"
    return {name: rate(lambda: renderer.image(pose, shapes, beam_mm=beam), 1, 8)}


def raw_fcl_ray(checker: CollisionChecker, origin, aim) -> int:
    """Names of the candidate faces of a ray, by a plain FCL call."""
    end = origin + RANGE_MM * aim
    side = frames.rotation_from_z(aim)[:, 0] * 1e-3
    model = surface_model(np.stack((origin, end, end + side)), np.array([[0, 1, 2]]))
    request = fcl.CollisionRequest(num_max_contacts=1000, enable_contact=True)
    return fcl.collide(
        checker._objects[0], fcl.CollisionObject(model), request, fcl.CollisionResult()
    )


def body_rates(mesh: Mesh, cache: Path) -> dict[str, dict[str, float]]:
    """Whole arms a second against one mesh: clearance and collision, near and far."""
    body = Body("organ", "organ", mesh)
    scene = BatchedScene([body], {"arm": RADIUS_MM}, cache=cache)
    checker = CollisionChecker([body])
    surface = scene._surfaces[0]
    turn, shift = scene._inward(body, None)
    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    target = fcl.CollisionObject(surface_model(mesh.vertices_mm, mesh.faces))
    table: dict[str, dict[str, float]] = {}
    for place, (least, most) in {"near": (-3.0, 12.0), "far": (30.0, 45.0)}.items():
        lines = arms(2048, least, most)
        batch = torch.tensor(lines).float()
        shapes = [{"arm": ArmShape(line, RADIUS_MM)} for line in lines[:48]]

        def batched(batch=batch):
            line, given = refined(batch)
            return surface.clearance(
                line, given, turn, shift, RADIUS_MM, scene.exact_within_mm, scene.horizon_mm
            )

        def trimesh_points(lines=lines):
            for line in lines[:4]:
                trimesh.proximity.closest_point(solid, line)

        def trimesh_manager(lines=lines):
            manager = trimesh.collision.CollisionManager()
            manager.add_object("organ", solid)
            for line in lines[:2]:
                for a, b in pairwise(line):
                    capsule = trimesh.creation.cylinder(RADIUS_MM, segment=(a, b), sections=16)
                    manager.in_collision_single(capsule)

        table[f"clearance, {place}"] = {
            "trimesh.proximity, centreline points": rate(trimesh_points, 4, 1),
            "raw FCL, capsule by capsule": rate(
                lambda lines=lines: [raw_fcl_distance(target, line) for line in lines[:48]], 48
            ),
            "FCL": rate(lambda shapes=shapes: [checker.clearance(shape) for shape in shapes], 48),
            "batched (the same call tells collisions)": rate(batched, 2048),
        }
        table[f"collision, {place}"] = {
            "trimesh.collision, tubes as meshes": rate(trimesh_manager, 2, 1),
            "raw FCL, capsule by capsule": rate(
                lambda lines=lines: [raw_fcl_collide(target, line) for line in lines[:48]], 48
            ),
            "FCL": rate(lambda shapes=shapes: [checker.collisions(shape) for shape in shapes], 48),
            "batched": rate(batched, 2048),
        }
    return table


def raw_fcl_distance(target, line) -> float:
    """Distance of a chain of capsules to a target, mm, by plain FCL calls."""
    return min(
        fcl.distance(c, target, fcl.DistanceRequest(), fcl.DistanceResult())
        for c in fcl_capsules(line)
    )


def raw_fcl_collide(target, line) -> bool:
    """Whether a chain of capsules collides with a target, by plain FCL calls."""
    return any(
        fcl.collide(c, target, fcl.CollisionRequest(), fcl.CollisionResult())
        for c in fcl_capsules(line)
    )


def scaling_row(faces: int) -> dict[str, float]:
    """Build times and query times against the number of faces."""
    mesh = organ(faces)
    lines = torch.tensor(arms(1024, -3.0, 12.0)).float()
    raw = arms(8, -3.0, 12.0)
    rng = np.random.default_rng(1)
    origins = frames.normalise(rng.normal(size=(4096, 3))) * 130.0
    aims = frames.normalise(rng.normal(size=(4096, 3)) * 35.0 - origins)
    tree = build_tree(mesh)
    row = {
        "faces": len(mesh.faces),
        "tree_s": seconds(lambda: build_tree(mesh)),
        "field_s": seconds(lambda: build_field(mesh, MARGIN_MM, BAND_MM, tree=tree)),
        "embree_s": seconds(lambda: EmbreeSurface(mesh).first_hit(origins[:1], aims[:1], 1.0)),
        "fcl_s": seconds(lambda: surface_model(mesh.vertices_mm, mesh.faces)),
    }
    with tempfile.TemporaryDirectory() as cache:
        scene = BatchedScene([Body("organ", "organ", mesh)], {"arm": RADIUS_MM}, cache=Path(cache))
    embree = EmbreeSurface(mesh)
    target = fcl.CollisionObject(surface_model(mesh.vertices_mm, mesh.faces))
    surface, (turn, shift) = scene._surfaces[0], scene._inward(scene.bodies[0], None)
    row["ray_us"] = 1e6 / rate(lambda: embree.first_hit(origins, aims, RANGE_MM), 4096)
    row["clearance_us"] = 1e6 / rate(
        lambda: surface.clearance(*refined(lines), turn, shift, RADIUS_MM, 5.0, 60.0), 1024
    )
    row["fcl_clearance_us"] = 1e6 / rate(
        lambda: [raw_fcl_distance(target, line) for line in raw], len(raw), 1
    )
    return row


def show(title: str, rates: dict[str, float], baselines: dict[str, str]) -> None:
    """Print one table of rates, with ratios to the baselines."""
    print(f"\n{title}")
    names = [name for name in rates if any(name.startswith(b) for b in baselines.values())]
    for name, value in rates.items():
        ratios = "".join(
            f"{value / rates[base]:>12.3g} x {short}"
            for short, prefix in baselines.items()
            for base in names
            if base.startswith(prefix)
        )
        print(f"  {name:<44}{value:>12,.0f} /s{ratios}")


def main(argv: list[str]) -> None:
    """Parse the arguments, measure and print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", type=Path, help="write the numbers here as well")
    parser.add_argument("--faces", type=int, default=20_000, help="faces of the organ")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    mesh = organ(options.faces)
    baselines = {"FCL": "raw FCL", "trimesh": "trimesh"}
    print(f"organ of {len(mesh.faces):,} faces, arms of {SEGMENTS} segments, one thread")
    with tempfile.TemporaryDirectory() as folder:
        rays = ray_rates(mesh, Path(folder))
        show("rays", rays, baselines)
        pictures = picture_rate(mesh)
        show("the endoscope", pictures, {})
        bodies = body_rates(mesh, Path(folder))
    for title, rates in bodies.items():
        show(f"whole arms: {title}", rates, baselines)
    rows = [scaling_row(faces) for faces in SIZES]
    print(
        "\nagainst the number of faces (build in s; query in us: a ray; a whole arm near contact)"
    )
    print("".join(f"{name:>18}" for name in rows[0]))
    for row in rows:
        print("".join(f"{value:>18,.4g}" for value in row.values()))
    if options.json:
        found = {"rays": rays, "endoscope": pictures, **bodies, "scaling": rows}
        options.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
