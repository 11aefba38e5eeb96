"""The engines of the batched geometry side by side: time of a scene's step and differences.

    python benchmarks/accelerators.py [--device cuda] [--task circle_ablation] [--envs 256,1024]

A step of the scene is clearance, beam, view and dose of one state of each episode. On the CPU the
engine `compiled` is the one in use, and the others, which serve accelerators, run there to be
compared with it; on another device only they run. Differences are those from `compiled` in the same
states, mm; "hits" counts the beams that meet another thing. Times are the best of several rounds on
the clock, in turns.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from importlib.util import find_spec

import torch

from surgisoft.scene.ablation import AblationMap
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import seen_from
from surgisoft.tasks.batched import BatchedEnv
from surgisoft.tasks.registry import make_task

ROUNDS, WALK, POWER_W, DT_S = 5, 20, 8.0, 0.1
"""Rounds of each engine; steps to the states; power of the laser, W, and time of a step, s."""


def scene_step(env: BatchedEnv, engine: str, device: torch.device) -> Callable[[], dict]:
    """A function that makes a scene's step of an environment's present states on a device."""
    around, world = env.task.world.scene, env.state.world
    geometry = BatchedScene(around.geometry.bodies, around.geometry.radii_mm, device, engine=engine)
    own = around.ablation
    dose_map = AblationMap(own.patches, own.waist_mm, own.tissue, device=device)
    lines = {name: part.line_mm.to(device) for name, part in world.arms.items()}
    laser, eye = around.lasers[0], around.endoscopes[0]
    tip, aim = (getattr(world.arms[laser], n).to(device) for n in ("tip_mm", "tip_direction"))
    at = [getattr(world.arms[eye], n).to(device) for n in ("tip_mm", "tip_direction")]
    watched = world.scene.watched.to(device)
    looks = [t.to(device)[watched] for t in (around.looks_mm, around.look_normals)]
    hit = geometry.cast(tip, aim, around.beam_mm, lines, own=laser)
    dose = dose_map.start(hit.point_mm, aim, hit.on_organ)
    deposit = getattr(dose_map, f"deposit_{engine}")
    energy = torch.full_like(hit.distance_mm, POWER_W * DT_S)
    sums = [getattr(dose, n) for n in ("dose", "peak", "band_mm2", "zone_mm2", "zone_j")]
    moved = hit.point_mm + 0.5 * torch.nn.functional.normalize(at[0] - hit.point_mm, dim=1)

    def step() -> dict:
        clearance = geometry.clearance(lines)
        found = geometry.cast(tip, aim, around.beam_mm, lines, own=laser)
        view = seen_from(geometry, around.work_camera, *at, *looks, lines, own=eye)
        deposit(found.point_mm, moved, aim, energy * found.on_organ, dose.ring, *sums)
        if device.type == "cuda":
            torch.cuda.synchronize()
        return {
            "clearance_mm": clearance.least_mm.cpu(),
            "beam_mm": found.point_mm.cpu(),
            "struck": found.struck.cpu(),
            "visible": view.visible.cpu(),
            "dose": sums[0].cpu().clone(),
        }

    return step


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--task", default="circle_ablation")
    parser.add_argument("--envs", default="256,1024")
    chosen = parser.parse_args()
    device = torch.device(chosen.device)
    engines = ["compiled"] if device.type == "cpu" else []
    engines += ["warp"] * bool(find_spec("warp")) + ["torch"]
    print(f"{chosen.task} on {device}, {torch.get_num_threads()} thread(s)")
    print("| envs | engine | us a step | clearance off mm | beam off mm | hits | seen | dose off |")
    print("|---|---|---|---|---|---|---|---|")
    for count in (int(n) for n in chosen.envs.split(",")):
        env = BatchedEnv(make_task(chosen.task), count, 0, spread=True)
        draw = torch.Generator().manual_seed(0)
        held = {
            agent: env.action_limits_kPa[agent]
            * (2.0 * torch.rand(count, size, generator=draw) - 1.0)
            for agent, size in env.action_sizes.items()
        }
        for _ in range(WALK):
            env.step(held)
        with torch.inference_mode():
            truth = scene_step(env, "compiled", torch.device("cpu"))()
            steps = {engine: scene_step(env, engine, device) for engine in engines}
            first = {engine: step() for engine, step in steps.items()}
            best = dict.fromkeys(steps, float("inf"))
            for _ in range(ROUNDS):
                for engine, step in steps.items():
                    begin = time.perf_counter()
                    step()
                    best[engine] = min(best[engine], time.perf_counter() - begin)
        for engine, seconds in best.items():
            found = first[engine]
            off = {n: (found[n] - truth[n]).abs().max().item() for n in ("clearance_mm", "beam_mm")}
            hits = int((found["struck"] != truth["struck"]).sum())
            seen = int((found["visible"] != truth["visible"]).sum())
            dose = ((found["dose"] - truth["dose"]).abs().max() / truth["dose"].max()).item()
            cells = (f"{count:,}", engine, f"{1e6 * seconds / count:.2f}")
            errors = (f"{off['clearance_mm']:.1e}", f"{off['beam_mm']:.1e}", hits, seen)
            row = (*cells, *errors, f"{dose:.1e}")
            print("| " + " | ".join(map(str, row)) + " |", flush=True)


if __name__ == "__main__":
    main()
