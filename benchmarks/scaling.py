"""How cost grows with environments, faces, key points and rows: four plots and their tables.

    surgisoft benchmark scaling --images docs/images

Everything runs on one thread of this process, by processor time, the least of some repeats.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.rows import recording, write_raw
from surgisoft.measurement.importing import import_files, load_map
from surgisoft.measurement.recordings import load_recording, save_recording, summary
from surgisoft.progress import Progress, silent
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker, GuidedChecker
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.compiled_step import CompiledStep
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawNN
from surgisoft.tasks.batched import batched_env

ENVS = (1, 8, 64, 512, 4096)
LEVELS = (2, 3, 4, 5, 6)
"""Subdivisions of an icosahedron: 320 to 81,920 faces."""
KEY_POINTS = (3, 5, 9, 17, 33)
ROWS = (3_000, 30_000, 300_000)
NODES = 300_000
"""Nodes of a body's distance field."""
LEAST_S, REPEATS = 0.02, 3
"""Least processor time of a repeat, s, and their number."""


@dataclass(frozen=True)
class Curve:
    """Cost against one quantity."""

    panel: str
    """What grows, the name of the plot's horizontal axis."""
    name: str
    """What is measured."""
    sizes: tuple[int, ...]
    """Values of what grows."""
    seconds: tuple[float, ...]
    """Processor time, s."""
    per: str
    """What it is the time of, the name of the vertical axis."""


def least(work: Callable[[], object]) -> float:
    """Least processor time of one call, s, of some repeats of many calls."""
    work()
    best = np.inf
    for _ in range(REPEATS):
        begin, count = time.process_time(), 0
        while count == 0 or time.process_time() - begin < LEAST_S:
            work()
            count += 1
        best = min(best, (time.process_time() - begin) / count)
    return best


def of_environments(report: Progress) -> list[Curve]:
    """A step of one environment among more and more of them."""
    found = []
    for name in ("track_circle", "circle_ablation"):
        spent = []
        for count in ENVS:
            report(0, 4, f"{name}, {count} environments")
            env = batched_env(name, count)
            acts = {a: torch.rand(count, m) - 0.5 for a, m in env.action_sizes.items()}
            spent.append(least(lambda env=env, acts=acts: env.step(acts)) / count)
        found.append(Curve("environments", name, ENVS, tuple(spent), "a step of one environment"))
    return found


def of_faces(report: Progress) -> list[Curve]:
    """A query of one arm beside a body of more and more faces."""
    import trimesh

    names = (
        "batched, clearance",
        "FCL guided, clearance",
        "FCL, clearance",
        "batched, beam",
        "FCL, beam",
    )
    spent: dict[str, list[float]] = {name: [] for name in names}
    faces = []
    along = np.linspace(0.0, 1.0, 21)[:, None]
    line = np.array([60.0, 0.0, 0.0]) + along * np.array([-16.0, 25.0, 60.0])
    many = torch.tensor(line, dtype=torch.float32).repeat(256, 1, 1)
    arms, batch = {"arm": ArmShape(line, 7.5)}, {"arm": many}
    origin, aim = np.array([80.0, 10.0, 5.0]), np.array([-1.0, -0.1, 0.02])
    rays = (
        torch.tensor(np.tile(origin, (256, 1))).float(),
        torch.tensor(np.tile(aim, (256, 1))).float(),
    )
    for level in LEVELS:
        report(1, 4, f"icosahedron of level {level}")
        ball = trimesh.creation.icosphere(subdivisions=level, radius=40.0)
        body = Body("organ", "organ", Mesh(ball.vertices, ball.faces))
        with tempfile.TemporaryDirectory() as cache:
            scene = BatchedScene((body,), {"arm": 7.5}, most_nodes=NODES, cache=Path(cache))
        exact = CollisionChecker((body,))
        guided = GuidedChecker(exact)
        works = (
            lambda: scene.clearance(batch),  # noqa: B023
            lambda: guided.clearances(arms),  # noqa: B023
            lambda: exact.clearance(arms),  # noqa: B023
            lambda: scene.cast(*rays, 100.0),  # noqa: B023
            lambda: exact.cast(origin, aim, 100.0),  # noqa: B023
        )
        faces.append(len(ball.faces))
        for name, work in zip(names, works, strict=True):
            spent[name].append(least(work) / (256 if name.startswith("batched") else 1))
    return [
        Curve("faces", name, tuple(faces), tuple(spent[name]), "a query of one arm")
        for name in names
    ]


def of_key_points(report: Progress) -> list[Curve]:
    """A step of arm models with more and more key points, in a batch of 1,024."""
    spent: dict[str, list[float]] = {"tensor operations": [], "compiled": []}
    low, high = torch.zeros(3), torch.full((3,), 40.0)
    for count in KEY_POINTS:
        report(2, 4, f"{count} key points")
        spec = ArmSpec(3, count, (0.0,) * 3, (40.0,) * 3, band=(0.5,) * 3)
        model = ArmModel(spec, HawNN(low, high, count)).requires_grad_(False)
        state, change = model.initial_state(1024), torch.full((1024, 3), 0.5)
        step = CompiledStep.of(model)
        assert step is not None, "a HAW-NN without effects can be compiled"
        with torch.inference_mode():
            spent["tensor operations"].append(least(lambda: model.step(state, change, 0.1)) / 1024)  # noqa: B023
            spent["compiled"].append(least(lambda: step(state, state.pressure + change)) / 1024)  # noqa: B023
    return [
        Curve("key points", f"arm model, {name}", KEY_POINTS, tuple(values), "a step of one arm")
        for name, values in spent.items()
    ]


def of_rows(report: Progress) -> list[Curve]:
    """Recordings of more and more rows."""
    spent: dict[str, list[float]] = {"read and check": [], "summary": [], "import": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for count in ROWS:
            report(3, 4, f"{count:,} rows")
            made, file = recording(count), folder / f"{count}.parquet"
            save_recording(made, file)
            raw, map_file = write_raw(made, folder)
            spent["read and check"].append(least(lambda: load_recording(file, print)))  # noqa: B023
            spent["summary"].append(least(lambda: summary(made)))  # noqa: B023
            spent["import"].append(least(lambda: import_files([raw], load_map(map_file), "scaled")))  # noqa: B023
    return [Curve("rows", name, ROWS, tuple(values), "a file") for name, values in spent.items()]


def run(report: Progress = silent) -> list[Curve]:
    """All curves, on one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        parts = (of_environments, of_faces, of_key_points, of_rows)
        return [curve for part in parts for curve in part(report)]
    finally:
        torch.set_num_threads(before)


def draw(curves: list[Curve], folder: Path) -> Path:
    """One picture with a plot for each quantity, both axes logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = list(dict.fromkeys(curve.panel for curve in curves))
    figure, plots = plt.subplots(2, 2, figsize=(10.0, 7.5), layout="constrained")
    for plot, panel in zip(plots.flat, panels, strict=True):
        for curve in curves:
            if curve.panel == panel:
                plot.loglog(curve.sizes, 1e3 * np.array(curve.seconds), "o-", label=curve.name)
                plot.set_ylabel(f"ms of one processor, {curve.per}")
        sizes = next(curve.sizes for curve in curves if curve.panel == panel)
        plot.set_xticks(sizes, [f"{size:,}" for size in sizes])
        plot.minorticks_off()
        low, high = plot.get_ylim()
        if high < 10.0 * low:  # a nearly constant cost shall look like one
            plot.set_ylim(low / 3.0, high * 3.0)
        plot.set_xlabel(panel)
        plot.grid(which="both", alpha=0.3)
        plot.legend(fontsize=8)
    file = folder / "scaling.png"
    figure.savefig(file, dpi=110)
    plt.close(figure)
    return file


def markdown(curves: list[Curve]) -> str:
    """The curves as tables, with the exponent of the last two points."""
    lines = []
    for panel in dict.fromkeys(curve.panel for curve in curves):
        some = [curve for curve in curves if curve.panel == panel]
        sizes = " | ".join(f"{size:,}" for size in some[0].sizes)
        lines += [
            f"Microseconds of one processor for {some[0].per}, against {panel}:",
            "",
            f"| {panel} | {sizes} | grows with the power |",
            "|---|" + "---|" * (len(some[0].sizes) + 1),
        ]
        for curve in some:
            values = " | ".join(f"{1e6 * value:,.3g}" for value in curve.seconds)
            power = np.log(curve.seconds[-1] / curve.seconds[-2])
            power /= np.log(curve.sizes[-1] / curve.sizes[-2])
            lines.append(f"| {curve.name} | {values} | {power:.2f} |")
        lines.append("")
    return "\n".join(lines)
