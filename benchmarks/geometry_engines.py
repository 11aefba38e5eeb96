"""The project's mesh queries against NVIDIA Warp and Open3D: speed, error against FCL, cost.

    python benchmarks/geometry_engines.py                 some minutes on one core
    python benchmarks/geometry_engines.py --device cuda   Warp and the torch engine on a GPU

Warp (`pip install warp-lang`) and Open3D (`pip install open3d-cpu`) are optional: a missing one is
left out and the reason is printed. Every engine gets the same mesh, the same queries and one
thread. Times are processor times (with `--device cuda` times on the clock), the best of several
rounds in which the engines take turns. `x` says how many times as fast an engine is as the
project's own for that batch.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
import torch

from surgisoft.scene import frames
from surgisoft.scene.mesh import Body, Mesh

PHANTOM = Path(__file__).resolve().parents[1] / "scenes" / "phantom_liver"
SIZES = (1, 64, 1024, 4096)
RADIUS_MM, LENGTH_MM, SEGMENTS = 7.5, 70.0, 24
RANGE_MM, HORIZON_MM, WITHIN_MM = 200.0, 60.0, 5.0
REFEREED = {"near": 512, "far": 128}
ROUNDS = 4
LONGEST_S = 2.0
"""An engine that is slower than this for a batch is not measured with a larger one."""


@dataclass(frozen=True)
class Way:
    """One engine for a kind of query: `ask(n)` computes the first n queries."""

    name: str
    """Name of the engine."""
    ask: Callable[[int], np.ndarray]
    """Results of the first n queries."""
    most: int = SIZES[-1]
    """Largest batch that is measured."""


@dataclass(frozen=True)
class Work:
    """Queries that every engine gets; positions in mm, in the mesh's frame."""

    origins: np.ndarray
    aims: np.ndarray
    points: np.ndarray
    skin: np.ndarray
    lines: dict[str, np.ndarray]


def split_to(mesh: Mesh, faces: int) -> Mesh:
    """A mesh of the same surface with so many faces: edges are halved, the longest first."""
    vertices, triangles = mesh.vertices_mm.tolist(), mesh.faces.tolist()
    while len(triangles) < faces:
        sides: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for f, face in enumerate(triangles):
            for k in range(3):
                edge = tuple(sorted((face[k], face[(k + 1) % 3])))
                sides.setdefault(edge, []).append((f, k))
        place = np.array(vertices)
        edges = np.array(list(sides))
        lengths = frames.norm(place[edges[:, 0]] - place[edges[:, 1]])
        done: set[int] = set()
        for index in np.argsort(-lengths):
            pair = sides[tuple(edges[index])]
            if len(triangles) >= faces or any(f in done for f, _ in pair):
                continue
            middle = len(vertices)
            vertices.append(place[edges[index]].mean(axis=0).tolist())
            for f, k in pair:
                a, b, c = (triangles[f][(k + i) % 3] for i in range(3))
                triangles[f] = [a, middle, c]
                done |= {f, len(triangles)}
                triangles.append([middle, b, c])
    return Mesh(np.array(vertices), np.array(triangles))


def phantom() -> Mesh:
    """The phantom liver, its middle at the origin."""
    from surgisoft.scene.meshio import read_mesh

    mesh = read_mesh(PHANTOM / "liver.ply")
    return Mesh(mesh.vertices_mm - mesh.bounds_mm.mean(axis=0), mesh.faces)


def bent_arms(mesh: Mesh, count: int, least: float, most: float, seed: int) -> np.ndarray:
    """Centrelines (count, K, 3) float32 of bent arms that come in along the surface's normals."""
    rng = np.random.default_rng(seed)
    at = rng.integers(len(mesh.vertices_mm), size=count)
    away = mesh.vertex_normals[at]
    base = mesh.vertices_mm[at] + away * (LENGTH_MM + rng.uniform(least, most, (count, 1)))
    poses = frames.pose_from_z(base, -away + 0.15 * rng.normal(size=(count, 3)))
    bend, s = rng.uniform(0.1, 1.2, (count, 1)), np.linspace(0, 1, SEGMENTS + 1)
    radius = LENGTH_MM / bend
    line = (radius * (1 - np.cos(bend * s)), 0 * bend * s, radius * np.sin(bend * s))
    return frames.apply(poses, np.stack(line, -1)).astype(np.float32)


def work_on(mesh: Mesh, most: int = SIZES[-1]) -> Work:
    """Rays from outside, points around the surface and within 0.01 mm of it, arms near and far."""
    rng = np.random.default_rng(1)
    origins = frames.normalise(rng.normal(size=(most, 3))) * 130.0
    aims = frames.normalise(rng.normal(size=(most, 3)) * 30.0 - origins)
    face = rng.integers(len(mesh.faces), size=most)
    share = rng.dirichlet(np.ones(3), most)
    on = (mesh.triangles_mm[face] * share[..., None]).sum(axis=1)
    normals = mesh.face_normals[face]
    points = on + normals * rng.uniform(-15.0, 30.0, (most, 1))
    skin = on + normals * rng.choice([-0.01, 0.01], (most, 1))
    lines = {
        "near": bent_arms(mesh, most, 0.0, 15.0, 2),
        "far": bent_arms(mesh, most, 30.0, 45.0, 3),
    }
    return Work(origins, aims, points, skin, lines)


def own_ways(mesh: Mesh, work: Work, cache: Path, device: str) -> dict[str, list[Way]]:
    """The project's engines: compiled with Embree, and torch."""
    from surgisoft.scene.batched import BatchedScene, refined
    from surgisoft.scene.bvh import build_tree
    from surgisoft.scene.rays import EmbreeSurface
    from surgisoft.scene.torch_queries import TorchTree

    bodies = [Body("organ", "organ", mesh)]
    scene = BatchedScene(bodies, {"arm": RADIUS_MM}, cache=cache)
    in_torch = BatchedScene(bodies, {"arm": RADIUS_MM}, device, cache=cache, engine="torch")
    tree = build_tree(mesh)
    embree, torch_tree = EmbreeSurface(mesh), TorchTree(tree, device)
    surface = scene._surfaces[0]
    tensors = {k: torch.tensor(v) for k, v in work.lines.items()}
    on_device = {k: v.to(device) for k, v in tensors.items()}
    o, d = torch.tensor(work.origins, device=device), torch.tensor(work.aims, device=device)
    p = torch.tensor(work.points, device=device)

    def clearance(engine, lines, within):
        line, given = refined(lines)
        turn, shift = engine._inward(engine.bodies[0], None)
        found = engine._surfaces[0].clearance(
            line, given, turn, shift, RADIUS_MM, within, HORIZON_MM
        )
        return found.cpu().numpy()

    def is_inside(points):
        dots = torch.tensor(points)[:, None].expand(-1, 2, -1).contiguous()
        given = torch.ones(2, dtype=torch.bool)
        turn, shift = scene._inward(bodies[0], None)
        return surface.clearance(dots, given, turn, shift, 1.0, 0.0, HORIZON_MM).numpy() < -1.0

    def torch_rays(n):
        reach = torch.full((n,), RANGE_MM, dtype=torch.float64, device=device)
        return torch_tree.first_hit(o[:n], d[:n], reach)[0].cpu().numpy()

    def torch_points(n):
        far = torch.full((n,), np.inf, dtype=torch.float64, device=device)
        return torch_tree.points(p[:n], far).sqrt().cpu().numpy()

    ways = {
        "rays": [
            Way(
                "own: Embree, then float64",
                lambda n: embree.first_hit(work.origins[:n], work.aims[:n], RANGE_MM)[0],
            ),
            Way(f"own: torch on {device}", torch_rays),
        ],
        "points": [
            Way("own: compiled tree", lambda n: tree.nearest(work.points[:n])[0]),
            Way(f"own: torch on {device}", torch_points),
        ],
        "inside": [Way("own: field, then crossings", lambda n: is_inside(work.points[:n]))],
        "skin": [Way("own: field, then crossings", lambda n: is_inside(work.skin[:n]))],
    }
    for place in work.lines:
        ways[place] = [
            Way(
                "own: field, then compiled tree",
                lambda n, place=place: clearance(scene, tensors[place][:n], WITHIN_MM),
            ),
            Way(
                "own: compiled tree for every arm",
                lambda n, place=place: clearance(scene, tensors[place][:n], HORIZON_MM),
            ),
            Way(
                f"own: torch on {device}",
                lambda n, place=place: clearance(in_torch, on_device[place][:n], WITHIN_MM),
            ),
        ]
    return ways


def fcl_ways(mesh: Mesh, work: Work) -> dict[str, list[Way]]:
    """FCL, one query per call: the reference for errors."""
    from surgisoft.scene.capsules import ArmShape
    from surgisoft.scene.collision import CollisionChecker
    from surgisoft.scene.inside import points_inside

    checker = CollisionChecker([Body("organ", "organ", mesh)])

    def arms(lines):
        shapes = ({"arm": ArmShape(line, RADIUS_MM)} for line in lines)
        return np.array([checker.clearance(s).bodies_mm["arm", "organ"] for s in shapes])

    def rays(n):
        return checker.cast(work.origins[:n], work.aims[:n], RANGE_MM).distance_mm

    def points(n):
        import fcl

        found = []
        for point in work.points[:n]:
            ball = fcl.CollisionObject(fcl.Sphere(0.0), fcl.Transform(point))
            request, result = fcl.DistanceRequest(), fcl.DistanceResult()
            found.append(fcl.distance(ball, checker._objects[0], request, result))
        return np.array(found)

    return {
        "rays": [Way("FCL", rays, 1024)],
        "points": [Way("FCL", points, 1024)],
        "inside": [Way("winding number", lambda n: points_inside(mesh, work.points[:n]), 1024)],
        "skin": [Way("winding number", lambda n: points_inside(mesh, work.skin[:n]), 1024)],
    } | {
        place: [Way("FCL", lambda n, lines=lines: arms(lines[:n]), REFEREED[place])]
        for place, lines in work.lines.items()
    }


def warp_ways(mesh: Mesh, work: Work, cache: Path, device: str) -> dict[str, list[Way]]:
    """Warp's mesh: single queries, and four ways to build arms on them."""
    import geometry_warp as kernels

    from surgisoft.scene.field import load_field

    surface = kernels.WarpSurface(mesh, device, load_field(mesh, 70.0, 20.0, folder=cache))
    o, d = work.origins.astype(np.float32), work.aims.astype(np.float32)
    p, skin = work.points.astype(np.float32), work.skin.astype(np.float32)
    tests = {
        "three rays": kernels.inside_three_rays,
        "parity": kernels.inside_parity,
        "winding": kernels.inside_winding,
    }
    arms = {
        "points 1 mm apart": (kernels.chains_sampled, 1.0),
        "points 0.25 mm apart": (kernels.chains_sampled, 0.25),
        "halving to 0.01 mm": (kernels.chains_bounded, WITHIN_MM, 0.01),
        "halving to 0.001 mm": (kernels.chains_bounded, WITHIN_MM, 0.001),
        "boxes, float64 faces": (kernels.chains_boxes_float64, WITHIN_MM),
        "own field, boxes, float64": (kernels.chains_field_float64, WITHIN_MM),
    }
    ways = {
        "rays": [
            Way("Warp: float32", lambda n: surface.rays(o[:n], d[:n], RANGE_MM)[0]),
            Way(
                "Warp: then float64",
                lambda n: surface.rays_float64(work.origins[:n], work.aims[:n], RANGE_MM)[0],
            ),
        ],
        "points": [Way("Warp: float32", lambda n: surface.points(p[:n])[0])],
    }
    for question, given in (("inside", p), ("skin", skin)):
        ways[question] = [
            Way(f"Warp: {name}", lambda n, given=given, k=kernel: surface.inside(k, given[:n]))
            for name, kernel in tests.items()
        ]
    for place, lines in work.lines.items():
        ways[place] = [
            Way(
                f"Warp: {name}",
                lambda n, lines=lines, kernel=kernel, numbers=numbers: surface.chains(
                    kernel, lines[:n], RADIUS_MM, HORIZON_MM, *numbers
                ),
            )
            for name, (kernel, *numbers) in arms.items()
        ]
    return ways


def open3d_ways(mesh: Mesh, work: Work) -> dict[str, list[Way]]:
    """Open3D's RaycastingScene (CPU, or SYCL; float32), one thread."""
    import open3d

    tensor = open3d.core.Tensor.from_numpy
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        tensor(mesh.vertices_mm.astype(np.float32)), tensor(mesh.faces.astype(np.uint32))
    )
    rays = np.concatenate((work.origins, work.aims), axis=1).astype(np.float32)
    p, skin = work.points.astype(np.float32), work.skin.astype(np.float32)

    def distance(points):
        flat = tensor(np.ascontiguousarray(points.reshape(-1, 3)))
        return scene.compute_distance(flat, nthreads=1).numpy().reshape(points.shape[:-1])

    def is_inside(points, samples=3):
        flat = tensor(np.ascontiguousarray(points.reshape(-1, 3)))
        found = scene.compute_occupancy(flat, nthreads=1, nsamples=samples).numpy() > 0.5
        return found.reshape(points.shape[:-1])

    def with_depth(lines, centre, unsure):
        least = centre.copy()
        unsure = is_inside(lines[:, 0]) | (centre <= unsure)
        if unsure.any():
            points = lines[unsure]
            depth = np.where(is_inside(points), -distance(points), np.inf).min(axis=1)
            least[unsure] = np.minimum(centre[unsure], depth)
        return np.minimum(least - RADIUS_MM, HORIZON_MM)

    def sampled(lines, parts):
        share = np.arange(parts, dtype=np.float32)[:, None] / np.float32(parts)
        steps = lines[:, :-1, None] + share * (lines[:, 1:, None] - lines[:, :-1, None])
        points = np.concatenate((steps.reshape(len(lines), -1, 3), lines[:, -1:]), axis=1)
        return with_depth(lines, distance(points).min(axis=1), LENGTH_MM / SEGMENTS / parts)

    def halving(lines, tolerance):
        p, q = lines[:, :-1].reshape(-1, 3), lines[:, 1:].reshape(-1, 3)
        half = 0.5 * frames.norm(q - p)
        arm = np.repeat(np.arange(len(lines)), lines.shape[1] - 1)
        middle, reach = 0.5 * (p + q), 0.5 * (q - p)
        best = np.full(len(lines), HORIZON_MM + RADIUS_MM, np.float32)
        while len(arm):
            d = distance(middle)
            np.minimum.at(best, arm, d)
            slack = np.where(best - RADIUS_MM > WITHIN_MM + 1.0, 1.0, tolerance)[arm]
            keep = (d - half < best[arm] - slack) & (best[arm] > tolerance)
            arm, half = np.tile(arm[keep], 2), np.tile(0.5 * half[keep], 2)
            reach = 0.5 * reach[keep]
            middle = np.concatenate((middle[keep] - reach, middle[keep] + reach))
            reach = np.tile(reach, (2, 1))
        return with_depth(lines, best, 1.1 * tolerance)

    ways = {
        "rays": [
            Way(
                "Open3D: float32",
                lambda n: scene.cast_rays(tensor(rays[:n]), nthreads=1)["t_hit"].numpy(),
            )
        ],
        "points": [Way("Open3D: float32", lambda n: distance(p[:n]))],
        "inside": [Way("Open3D: three rays", lambda n: is_inside(p[:n]))],
        "skin": [Way("Open3D: three rays", lambda n: is_inside(skin[:n]))],
    }
    for place, lines in work.lines.items():
        ways[place] = [
            Way("Open3D: points 1 mm apart", lambda n, lines=lines: sampled(lines[:n], 3)),
            Way("Open3D: halving to 0.01 mm", lambda n, lines=lines: halving(lines[:n], 0.01)),
        ]
    return ways


TITLES = {
    "rays": "first hit of a ray; error of the distance",
    "points": "closest point; error of the distance",
    "inside": "inside test, points 15 mm inside to 30 mm outside",
    "skin": "inside test, points 0.01 mm from the surface",
    "near": "clearance of a whole arm, tip 0 to 15 mm above the surface at first",
    "far": "clearance of a whole arm, tip 30 to 45 mm above the surface at first",
}


def timed(ways: list[Way], clock) -> dict[str, dict[int, float]]:
    """Seconds per query by engine and batch; the best of several interleaved rounds counts."""
    table: dict[str, dict[int, float]] = {way.name: {} for way in ways}
    for size in SIZES:
        asked = []
        for way in ways:
            previous = [s * n for n, s in table[way.name].items()]
            if size <= way.most and (not previous or previous[-1] < LONGEST_S / 4):
                way.ask(size)
                asked.append(way)
        in_a_row = 5 if size <= 64 else 1
        for _ in range(ROUNDS):
            for way in (way for way in asked for _ in range(in_a_row)):
                start = clock()
                way.ask(size)
                each = (clock() - start) / size
                table[way.name][size] = min(each, table[way.name].get(size, np.inf))
    return table


def error_of(question: str, way: Way, truth: np.ndarray) -> str:
    """Error of an engine against FCL or the winding number, as text."""
    found = way.ask(len(truth))
    if question in ("inside", "skin"):
        return f"{int((found != truth).sum())} of {len(truth)} wrong"
    if question == "rays":
        hit, seen = truth < RANGE_MM, found < RANGE_MM
        both = hit & seen
        off = np.abs(found - truth)[both].max()
        return f"{off:.1e} mm, {int((hit != seen).sum())} of {len(truth)} missed"
    off = np.abs(np.asarray(found, dtype=np.float64) - truth)
    if question == "points":
        return f"{off.max():.1e} mm"
    near = truth < WITHIN_MM
    parts = []
    if near.any():
        flipped = ((found < 0) != (truth < 0)) & (np.abs(truth) > 1e-4)
        parts.append(f"{off[near].max():.1e} mm, {int(flipped.sum())} contacts wrong")
    if not near.all():
        parts.append(f"beyond 5 mm {off[~near].max():.1e} mm")
    return "; ".join(parts)


def show(question: str, ways: list[Way], clock) -> dict:
    """Print one table; the first engine is the project's, the last one the reference."""
    print(f"\n{TITLES[question]}")
    print("  " + f"{'us a query in batches of':<34}" + "".join(f"{n:>17,}" for n in SIZES))
    table = timed(ways, clock)
    first = table[ways[0].name]
    truth = ways[-1].ask(ways[-1].most)
    found = {}
    for way in ways:
        row = table[way.name]
        cells = (
            f"{1e6 * row[n]:>9.2f} {first[n] / row[n]:>5.2f} x" if n in row else f"{'-':>17}"
            for n in SIZES
        )
        error = "" if way is ways[-1] else error_of(question, way, truth)
        print(f"  {way.name:<34}" + "".join(cells) + f"  {error}", flush=True)
        found[way.name] = {"us": {n: 1e6 * s for n, s in row.items()}, "error": error}
    return found


def resident_mb() -> float:
    """Memory that this process holds, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


MODULES = {
    "own": "surgisoft.scene.batched",
    "FCL": "surgisoft.scene.collision",
    "Warp": "geometry_warp",
    "Open3D": "open3d",
}
"""What a process imports to use an engine."""


def cost(engine: str, faces: int, cache: Path) -> dict[str, float]:
    """Processor seconds and MB of one engine in a fresh process for one mesh."""
    mesh = phantom()
    if faces > len(mesh.faces):
        mesh = split_to(mesh, faces)
    work = work_on(mesh, 1024)
    start, before = time.process_time(), resident_mb()
    import_module(MODULES[engine])
    imported = time.process_time()
    if engine == "own":
        way = own_clearance(mesh, work, cache)
    elif engine == "FCL":
        (way,) = fcl_ways(mesh, work)["near"]
    elif engine == "Warp":
        way = warp_ways(mesh, work, cache, "cpu")["near"][-1]
    else:
        way = open3d_ways(mesh, work)["near"][0]
    built = time.process_time()
    way.ask(1)
    first = time.process_time()
    way.ask(64)
    return {
        "import_s": imported - start,
        "build_s": built - imported,
        "first_s": first - built,
        "memory_mb": resident_mb() - before,
    }


def own_clearance(mesh: Mesh, work: Work, cache: Path) -> Way:
    """The compiled engine alone, as training builds it."""
    from surgisoft.scene.batched import BatchedScene

    scene = BatchedScene([Body("organ", "organ", mesh)], {"arm": RADIUS_MM}, cache=cache)
    lines = torch.tensor(work.lines["near"])
    return Way("own", lambda n: scene.clearance({"arm": lines[:n]}).bodies_mm.numpy())


def costs(faces: int, engines: list[str]) -> dict[str, dict[str, float]]:
    """Print the cost of each engine in a fresh process, with empty and with filled caches."""
    print(
        f"\na fresh process, {faces:,} faces: import, build, first arm (processor s); memory (MB)"
    )
    found = {}
    for engine in engines:
        with tempfile.TemporaryDirectory() as cache:
            kept = {"NUMBA_CACHE_DIR": cache, "WARP_CACHE_PATH": cache}
            for state in ("caches empty", "caches filled"):
                command = [sys.executable, __file__, "--cost", engine, "--faces", str(faces)]
                done = subprocess.run(
                    [*command, "--cache", cache],
                    env=os.environ | kept,
                    capture_output=True,
                    text=True,
                    check=False,
                )
                if done.returncode:
                    print(f"  {engine}: failed: {done.stderr.strip().splitlines()[-1]}")
                    break
                row = json.loads(done.stdout.strip().splitlines()[-1])
                found[f"{engine}, {state}"] = row
                cells = "".join(f"{name[:-2]:>10} {row[name]:>6.2f}" for name in list(row)[:3])
                name = f"{engine}, {state}"
                print(f"  {name:<24}{cells}    memory {row['memory_mb']:>5.0f}", flush=True)
    return found


def absent(module: str) -> str | None:
    """Reason why an optional engine is left out; None if it is installed."""
    try:
        import_module(module)
    except (ImportError, OSError) as error:
        return str(error)
    return None


def main(argv: list[str]) -> None:
    """Parse the arguments, measure and print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", type=Path, help="write the numbers here as well")
    parser.add_argument("--faces", type=int, default=50_000, help="faces of the finer mesh")
    parser.add_argument("--device", default="cpu", help="where Warp and the torch engine run")
    parser.add_argument("--cost", help=argparse.SUPPRESS)
    parser.add_argument("--cache", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    if options.cost:
        print(json.dumps(cost(options.cost, options.faces, options.cache)))
        return
    clock = time.process_time if options.device == "cpu" else time.perf_counter
    extra = {"Warp": "warp", "Open3D": "open3d"}
    for name, module in list(extra.items()):
        if reason := absent(module):
            print(f"{name} is left out: {reason}")
            del extra[name]
        else:
            print(f"{name} {import_module(module).__version__}")
    print(f"one thread; torch {torch.__version__}; Warp and torch on {options.device}")
    meshes = [phantom()]
    meshes.append(split_to(meshes[0], options.faces))
    found = {}
    for mesh in meshes:
        if not mesh.is_watertight:
            raise AssertionError("the benchmark's mesh is not closed")
        print(f"\n=== liver of {len(mesh.faces):,} faces")
        work = work_on(mesh)
        with tempfile.TemporaryDirectory() as cache:
            sets = [own_ways(mesh, work, Path(cache), options.device)]
            if "Warp" in extra:
                sets.append(warp_ways(mesh, work, Path(cache), options.device))
            if "Open3D" in extra:
                sets.append(open3d_ways(mesh, work))
            sets.append(fcl_ways(mesh, work))
            found[len(mesh.faces)] = {
                question: show(question, [way for ways in sets for way in ways[question]], clock)
                for question in TITLES
            }
    found["costs"] = costs(options.faces, ["own", "FCL", *extra])
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
