"""Speed of the endoscope's images as observations, beside the replay's renderer.

    OMP_NUM_THREADS=1 python benchmarks/images.py            one thread
    OMP_NUM_THREADS=2 python benchmarks/images.py            two threads

The scripted expert drives `circle_ablation` until the beams burn, then the images of all
environments are drawn again and again. Speeds are images per second of processor time, summed over
the threads, and per second on the clock, the best of several rounds. `x` is the ratio to the
replay's renderer (`scene.render`), which draws colour alone, one picture at a time, without the
search for the dose.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
import torch

import surgisoft
from surgisoft.scene import frames
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.render import Renderer
from surgisoft.tasks.world.images import EndoscopeImages, ImageConfig

ROUNDS = 5
APPROACH_STEPS = 60
"""Steps of the scripted expert before images are drawn; the beams burn then."""
REPLAYED = 24
"""Pictures that the replay's renderer draws in a round."""
PIXELS = (64, 128, 256)
"""Widths and heights of the images, pixels."""


def best(draw, count: int) -> tuple[float, float]:
    """Images per second of processor time and on the clock, the best of the rounds."""
    draw()
    cpu = wall = np.inf
    for _ in range(ROUNDS):
        began, clock = time.process_time(), time.perf_counter()
        draw()
        cpu = min(cpu, time.process_time() - began)
        wall = min(wall, time.perf_counter() - clock)
    return count / cpu, count / wall


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one line for each kind and size of image.

    arguments: of the command line; default: those of the process.
    """
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--envs", type=int, default=256, help="environments in the batch")
    count = options.parse_args(arguments).envs
    env = surgisoft.batched_env("circle_ablation", count)
    for _ in range(APPROACH_STEPS):
        env.step(env.task.script(env.state))
    state, engine = env.state.world, env.task.world.scene
    eye = state.arms["endoscope"]
    poses = frames.pose_from_z(eye.tip_mm.double(), eye.tip_direction.double()).numpy()
    radii = engine.geometry.radii_mm
    burning = torch.stack([*state.scene.lit.values()]).double().mean()
    faces = sum(len(body.mesh.faces) for body in engine.geometry.bodies)
    print(f"{count} environments, {faces} faces, {burning:.0%} of the beams burn")
    print(f"{torch.get_num_threads()} thread(s); images/s of processor time and on the clock")
    for pixels in PIXELS:
        slow = Renderer(engine.geometry.bodies, engine.camera, pixels, pixels)

        def replayed(slow=slow):
            for b in range(min(count, REPLAYED)):
                shapes = {
                    name: ArmShape(part.line_mm[b].double().numpy(), float(radii[name]))
                    for name, part in state.arms.items()
                }
                laser = (state.arms["laser"].tip_mm[b], state.scene.hits["laser"].point_mm[b])
                slow.image(poses[b], shapes, "endoscope", torch.stack(laser).double().numpy())

        base, clock = best(replayed, min(count, REPLAYED))
        print(f"{pixels:4} pixels  {'replay: rgb':24} {base:8.0f} {clock:8.0f}   1.0 x")
        for kinds in ("rgb", "depth", "segmentation", "rgb,depth,segmentation"):
            images = EndoscopeImages(engine, ImageConfig(kinds, pixels))
            found, clock = best(lambda i=images: i.of(state.arms, state.scene), count)
            ratio = f"{found / base:5.1f} x"
            print(f"{pixels:4} pixels  {kinds:24} {found:8.0f} {clock:8.0f} {ratio}", flush=True)


if __name__ == "__main__":
    main()
