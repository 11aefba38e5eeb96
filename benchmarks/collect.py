"""Speed of the virtual rig, properties of its robots, and size of each hidden effect.

    python benchmarks/collect.py [--seeds 1 2 3] [--json FILE]

The first call compiles (about half a minute); the reported times exclude compilation.
"""

import argparse
import json
import os
import time

import numpy as np

from surgisoft.measurement.protocols import make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.rig.arm import ArmDesign, fabricate, plain_loads, single_chamber_gap
from surgisoft.rig.arm import tips_along as settled_tips
from surgisoft.rig.hidden import HIDDEN
from surgisoft.rig.virtual import MOUNT


def speed() -> dict:
    """Duration of the paper's collection, s, and samples per second of a closed loop."""
    rig = VirtualRig(1)
    rig.record(make_protocol("mixed", rig.limits, 100))
    grid = make_protocol("grid", rig.limits)
    start = time.perf_counter()
    recording, _ = rig.record(grid)
    seconds = time.perf_counter() - start
    rig.reset()
    start = time.perf_counter()
    for k in range(2000):
        rig.command(np.full(3, 20.0 + 10.0 * np.sin(k / 50)))
        rig.read()
    reads = 2000 / (time.perf_counter() - start)
    return {"grid_points": recording.samples, "grid_s": seconds, "reads_per_s": reads}


def arm(seed: int) -> dict:
    """Largest gap, bends of single chambers, extension and noise of one robot."""
    design = ArmDesign()
    robot = fabricate(design, seed, np.array(MOUNT))
    poses = np.array([[0.0, 0, 0], [54, 0, 0], [0, 54, 0], [0, 0, 54], [54, 54, 54]])
    tips = [settled_tips(robot, plain_loads(MOUNT), pose[None])[0] for pose in poses]
    rig = VirtualRig(seed)
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 2000))
    return {
        "seed": seed,
        "gap_mm": single_chamber_gap(robot, design, np.array(MOUNT)),
        "tip_travel_mm": [float(np.linalg.norm(tip - tips[0])) for tip in tips[1:4]],
        "extension_mm": float(tips[4][2] - tips[0][2]),
        "noise_mm": recording.noise_mm,
    }


def effect(name: str, seeds: list[int]) -> dict:
    """Shift of the measured tip by an effect of amplitude 1 over protocol `mixed`, noise off."""
    rms, largest = [], []
    for seed in seeds:
        protocol = make_protocol("mixed", VirtualRig(seed).limits, seed=seed)
        _, plain = VirtualRig(seed, noise=0.0).record(protocol)
        _, hidden = VirtualRig(seed, noise=0.0, hidden=[(name, 1.0)]).record(protocol)
        shift = np.linalg.norm((hidden.noise_free_mm - plain.noise_free_mm)[:, -1], axis=1)
        rms.append(float(np.sqrt(np.mean(shift**2))))
        largest.append(float(shift.max()))
    return {"name": name, "rms_mm": rms, "max_mm": largest}


def main() -> None:
    """Print speed, robots and effects, and write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--json", help="write the figures to this file")
    options = parser.parse_args()
    report = {"cpus": os.cpu_count(), "speed": speed(), "arms": [], "effects": []}
    fast = report["speed"]
    print(f"{fast['grid_points']} settled points in {fast['grid_s']:.1f} s, on one core")
    print(f"{fast['reads_per_s']:.0f} commands and reads a second")
    for seed in options.seeds:
        report["arms"].append(arm(seed))
        a = report["arms"][-1]
        travel = ", ".join(f"{t:.1f}" for t in a["tip_travel_mm"])
        print(
            f"arm {seed}: gap {a['gap_mm']:.3f} mm, single chambers move the tip by {travel} mm, "
            f"all extend by {a['extension_mm']:.1f} mm, noise {a['noise_mm']:.3f} mm"
        )
    for name in HIDDEN:
        report["effects"].append(effect(name, options.seeds))
        e = report["effects"][-1]
        shifts = " ".join(f"{r:.2f}/{m:.1f}" for r, m in zip(e["rms_mm"], e["max_mm"], strict=True))
        print(f"{name:18s} tip shift rms/max [mm]: {shifts}")
    if options.json:
        with open(options.json, "w") as file:
            json.dump(report, file, indent=1)


if __name__ == "__main__":
    main()
