"""Arm evaluations per second, compared with this machine's peak of matrix products.

    python benchmarks/arm.py [THREADS]

A step of the arm is bound by the network's matrix products: 2 (6 x 128 + 3 x 128 x 128 + 128 x 15)
= 103,680 operations for 3 chambers and 5 key points. The peak is that of a large float32 product.
"""

import os
import sys
import time
from functools import partial

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.backbone import Backbone
from surgisoft.surrogate.compiled_step import CompiledStep
from surgisoft.surrogate.effects import make_effect
from surgisoft.surrogate.model import ArmModel, arm_facts
from surgisoft.surrogate.networks import HawNN

OPERATIONS = 2 * (6 * 128 + 3 * 128 * 128 + 128 * 15)
SPEC = ArmSpec(3, 5, (-15.0,) * 3, (54.0,) * 3, band=(0.2,) * 3)


def best_seconds(work, repeats: int = 5, least: float = 0.4) -> float:
    """Duration of one call, s: the best of several rounds of at least `least` seconds."""
    work()
    best = float("inf")
    for _ in range(repeats):
        calls, begin = 0, time.perf_counter()
        while (spent := time.perf_counter() - begin) < least:
            work()
            calls += 1
        best = min(best, spent / calls)
    return best


def peak() -> float:
    """Operations per second of a 2048 x 2048 x 2048 float32 product."""
    a = torch.randn(2048, 2048)
    return 2 * 2048**3 / best_seconds(lambda: a @ a, repeats=2, least=0.25)


def arm(effects: tuple[str, ...], arcs: int = 0) -> ArmModel:
    """An arm of the paper's size; arcs: those of its prior mean."""
    low, high = torch.tensor(SPEC.low), torch.tensor(SPEC.high)
    rest = torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(SPEC.key_points)])
    facts = arm_facts(SPEC, rest)
    made = {name: make_effect(name, facts) for name in effects}
    network = HawNN(low, high, 5, arcs=arcs)
    if network.prior is not None:
        network.prior.set_rest(rest)
    return ArmModel(SPEC, network, made, rest).eval().requires_grad_(False)


def stepper(effects: tuple[str, ...], dp: torch.Tensor):
    """A function that steps a batch once by dp (B, 3)."""
    model = arm(effects)
    state = model.initial_state(len(dp))
    return lambda: model.step(state, dp, 0.05)


def compiled_stepper(effects: tuple[str, ...], pressure: torch.Tensor, arcs: int = 0):
    """A function that steps a batch once to a pressure (B, 3) by compiled loops."""
    model = arm(effects, arcs)
    step, state = CompiledStep.of(model), model.initial_state(len(pressure))
    assert step is not None
    return lambda: step(state, pressure)


def network(x: torch.Tensor):
    """A function that evaluates the network alone."""
    model = arm(())
    return lambda: model.network(x, x)


def whole_body(spline: Backbone, points: torch.Tensor):
    """Centreline and tip direction of a batch."""
    return spline.centreline(points), spline.tip_direction(points)


def main() -> None:
    """Print the table."""
    torch.set_num_threads(int(sys.argv[1]) if len(sys.argv) > 1 else os.cpu_count())
    most = peak()
    print(f"{torch.get_num_threads()} threads, matrix-product peak {most / 1e9:.0f} GFLOP/s")
    print(f"limit by operations {most / OPERATIONS / 1e6:.2f} M evaluations/s at that peak")
    print("each share is of the peak measured just before its row")
    spline = Backbone.through(torch.arange(5.0)[:, None] * torch.tensor([0.0, 0.0, 17.5]))
    print(f"{'batch':>6s} {'what':30s} {'M/s':>6s} {'of limit':>9s}")
    for batch in (1, 64, 1024, 4096, 16384):
        dp, points = torch.randn(batch, 3), torch.randn(batch, 5, 3)
        plain, deep = stepper((), dp), stepper(("hysteresis",), dp)
        rows = {
            "network alone": network(dp),
            "step": plain,
            "step with hysteresis": deep,
            "the same, compiled": compiled_stepper(("hysteresis",), dp),
            "and with arcs": compiled_stepper(("hysteresis",), dp, arcs=4),
            "backbone, 21 points + tip": partial(whole_body, spline, points),
        }
        for name, work in rows.items():
            most = peak()
            with torch.inference_mode():
                rate = batch / best_seconds(work, repeats=3, least=0.2)
            share = "" if name.startswith("backbone") else f"{rate * OPERATIONS / most:9.0%}"
            print(f"{batch:6d} {name:30s} {rate / 1e6:6.3f} {share}")


if __name__ == "__main__":
    main()
