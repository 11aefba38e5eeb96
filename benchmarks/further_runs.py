"""Coverage of prediction intervals on further runs, with as many independent runs as it takes.

    python -m benchmarks.further_runs --robots 413,414,415      # virtual robots
    python -m benchmarks.further_runs --simulated                # runs of log-normal size

Public recordings of real arms hold about ten runs, which show a coverage to within some ten
percent. Virtual robots can record any number: each run moves a random set of chambers by random
steps, so that the runs are exchangeable, and some of them lie outside of what the fit has seen. A
model is fitted to the first runs as by `surgisoft fit --network kernel`, and judged on the others.
The error of the mean counts the robots as the independent samples.

`--simulated` needs no fit: errors are lengths of normal vectors, times the size of their run. Sizes
are log-normal, as the interval assumes. Beside the interval stands the quantile of all rows, which
takes the rows for independent.
"""

import argparse
import itertools
import math
import time
import warnings

import numpy as np
import torch

from benchmarks.real_models import without
from surgisoft.measurement.histories import arm_spec, history_of
from surgisoft.measurement.protocols import Protocol
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.fit import FitConfig, fit
from surgisoft.surrogate.interval import LEVEL, coverage_of, group_quantiles

RUN_S = 30.0
"""Least length of a run, s."""
RAMP_S, HOLD_S = (0.5, 3.0), (1.0, 5.0)
"""Shortest and longest ramp and hold of a step, s."""
MOVED = 0.5
"""Probability that a run moves a chamber; one is moved at least."""
FURTHER = 24
"""Runs that a model is judged on."""
RUNS, SPREADS = (4, 6, 8, 16), (0.0, 0.5, 1.0, 1.3)
"""Numbers of runs, and standard deviations of the logarithm of their sizes, that are simulated."""
TRIALS, ROWS = 200, 200
"""Simulated fits in each row of the table, and rows of a simulated run."""


def random_steps(limits: np.ndarray, runs: int, seed: int) -> Protocol:
    """Runs of random steps of random chambers between pressure limits (m, 2) in kPa."""
    rng = np.random.default_rng(seed)
    low, high = limits.T
    rows, run, t_s = [], [], []
    for number in range(runs):
        moved = rng.random(len(low)) < MOVED
        if not moved.any():
            moved[rng.integers(len(low))] = True
        now, level = 0.0, np.zeros(len(low))
        while now < RUN_S:
            target = np.where(moved, rng.uniform(low, high), 0.0)
            ramp = rng.uniform(*RAMP_S)
            rows += [level, target]
            t_s += [now, now + ramp]
            run += [number, number]
            now, level = now + ramp + rng.uniform(*HOLD_S), target
    return Protocol("random_steps", "continuous", np.array(rows), np.array(run), np.array(t_s))


def of_robot(robot: int, runs: int) -> tuple[float, np.ndarray, np.ndarray]:
    """RMS distance in mm, and (FURTHER,) coverage and (n,) mean radius in mm on further runs."""
    rig = VirtualRig(robot)
    recording = rig.record(random_steps(rig.limits, runs + FURTHER, robot))[0]
    history, spec = history_of([recording]), arm_spec([recording])
    further = (torch.arange(history.runs)[:, None] >= runs) & history.valid
    model = fit(without(history, further), None, spec, FitConfig(network="kernel")).model
    found = model.predict_interval(history)
    error = (found.key_points_mm - history.key_points).norm(dim=-1)
    covered = [
        coverage_of(error[run][further[run]], found.radius_mm[run][further[run]])
        for run in range(runs, history.runs)
    ]
    rmse = float(error[further].square().nanmean().sqrt())
    return rmse, np.array(covered), found.radius_mm[further].mean(0).numpy()


def simulated(runs: int, spread: float) -> tuple[np.ndarray, np.ndarray, float]:
    """(TRIALS,) coverage of 40 further runs by all rows' quantile and by the interval, and the
    geometric mean of the interval's radius over that quantile."""
    covered, ratio = np.empty((2, TRIALS)), 0.0
    for trial in range(TRIALS):
        rng = np.random.default_rng([trial, runs])

        def errors(count: int, rng=rng) -> torch.Tensor:
            size = np.exp(spread * rng.standard_normal(count)).repeat(ROWS)
            return torch.tensor(size * np.linalg.norm(rng.standard_normal((len(size), 3)), axis=1))

        known, fresh = errors(runs)[:, None], errors(40)[:, None]
        groups = torch.zeros(len(known)), torch.arange(runs).repeat_interleave(ROWS)
        plain, ours = (group_quantiles(known, group, LEVEL) for group in groups)
        covered[:, trial] = [coverage_of(fresh, radius) for radius in (plain, ours)]
        ratio += math.log(float(ours / plain)) / TRIALS
    return covered[0], covered[1], math.exp(ratio)


def mean_text(values: np.ndarray) -> str:
    """Mean of shares with its standard error."""
    return f"{values.mean():.1%} ± {values.std(ddof=1) / math.sqrt(len(values)):.1%}"


def main() -> None:
    """Print the coverage on virtual robots, or the table of simulated runs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", default="", help="seeds of virtual robots, with commas")
    parser.add_argument("--runs", type=int, default=8, help="runs that a model is fitted to")
    parser.add_argument("--simulated", action="store_true", help="runs of log-normal size instead")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    if options.simulated:
        print("| spread of the logarithm, runs | quantile of all rows | interval | radius |")
        print("|---|---|---|---|")
        for spread, runs in itertools.product(SPREADS, RUNS):
            plain, ours, ratio = simulated(runs, spread)
            print(
                f"| {spread:g}, {runs} runs | {mean_text(plain)} | {mean_text(ours)} "
                f"| x {ratio:.2f} |"
            )
        return
    begin, every = time.process_time(), []
    for robot in [int(x) for x in options.robots.split(",") if x]:
        rmse, covered, radius = of_robot(robot, options.runs)
        every.append(covered)
        print(
            f"robot {robot}: {rmse:.3f} mm, {covered.mean():.1%} within the {LEVEL:.0%} interval "
            f"(run of least coverage {covered.min():.0%}); radius of the tip {radius[-1]:.2f} mm",
            flush=True,
        )
    if len(every) > 1:
        runs = np.concatenate(every)
        print(
            f"coverage {mean_text(np.array([each.mean() for each in every]))} over {len(every)} "
            f"robots; standard deviation of one run's {runs.std(ddof=1):.3f}; "
            f"{time.process_time() - begin:.0f} s of processor time"
        )


if __name__ == "__main__":
    main()
