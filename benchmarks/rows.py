"""Cost of commands on large files: processor time and memory against rows, faces and slices.

    surgisoft benchmark rows

The files are made here: recordings of the packaged arm with a slow drift and noise, the same as a
raw file of a lab with its map, an organ of many faces, and the segmented image of an organ. Each
command runs in a process of its own; its processor time counts all its threads, its memory is the
peak of resident pages. On a machine that does other work processor time still grows with the load,
by caches that are shared. The package's bytecode is written first, as an installation does it.
"""

from __future__ import annotations

import compileall
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import surgisoft
from surgisoft.measurement.recordings import Recording, save_recording
from surgisoft.progress import Progress, silent
from surgisoft.surrogate.checkpoint import default_arm

RUN_ROWS, SIMULATED, HOLD_ROWS = 3000, 30_000, 20
"""Rows of a run, rows that are simulated, and rows between two pressures of the schedule."""
MOST_COMPARED = 100_000
"""Most rows of a recording that `compare` is measured on."""
DT_S, NOISE_MM, DRIFT_MM, DRIFT_S = 0.05, 0.05, 1.5, 90.0
"""Time between rows, s; standard deviation of the noise, mm; size of the slow drift, mm, and its
time constant, s."""
SLICE_PIXELS, IMAGE_MM = 512, (384.0, 300.0)
"""Width of a slice of a segmented image, pixels; width of a slice and height of all slices, mm."""
MAP = """[time]
column = "time"
unit = "s"

[measured]
columns = ["pA", "pB", "pC"]
unit = "kPa"

[key_points]
positions = [{names}]
unit = "mm"
"""


@dataclass(frozen=True)
class Cost:
    """What one command cost."""

    command: str
    """The command, files by their number of rows or faces."""
    size: int
    """Rows, faces or slices."""
    processor_s: float
    """Processor time of all its threads, s."""
    clock_s: float
    """Time on the clock, s."""
    memory_gb: float
    """Peak of its resident memory, GB."""
    limit: str
    """What it may cost."""
    failed: str
    """Last line of its error; empty where it ended well."""


def recording(rows: int, seed: int = 0) -> Recording:
    """A recording of the packaged arm with a drift that its model does not have.

    Motions of more than `SIMULATED` rows are repeated run by run, each with noise of its own.
    """
    arm, random = default_arm(), torch.Generator().manual_seed(seed)
    steps = min(rows, RUN_ROWS)
    runs = min(max(1, rows // steps), SIMULATED // RUN_ROWS)
    low, high = torch.tensor(arm.spec.low), torch.tensor(arm.spec.high)
    count = -(-steps // HOLD_ROWS) + 1
    knots = torch.rand(runs, count, arm.spec.chambers, generator=random) * (high - low) + low
    place = torch.arange(steps) / HOLD_ROWS
    below = place.long()
    pressure = torch.lerp(knots[:, below], knots[:, below + 1], (place - below)[None, :, None])
    state, points = arm.initial_state(runs, pressure[:, 0]), []
    lag = pressure[:, 0].clone()
    with torch.inference_mode():
        for step in range(steps):
            state, now = arm.step(state, pressure[:, step] - state.pressure, DT_S)
            lag += DT_S / DRIFT_S * (pressure[:, step] - lag)
            share = torch.linspace(0.0, 1.0, now.shape[1])[None, :, None] ** 2
            points.append(now + DRIFT_MM * share * ((lag - low) / (high - low))[:, None, :3])
    number = torch.arange(max(1, rows // steps)) % runs
    measured = torch.stack(points, 1)[number]
    measured += NOISE_MM * torch.randn(measured.shape, generator=random)
    return Recording(
        name=f"rows{rows}",
        t_s=np.tile(DT_S * np.arange(steps), len(number)),
        measured=pressure[number].flatten(0, 1).numpy(),
        key_points_mm=measured.flatten(0, 1).numpy(),
        run=np.repeat(np.arange(len(number)), steps),
    )


def write_raw(made: Recording, folder: Path) -> tuple[Path, Path]:
    """A recording's rows as a table of a lab, and its map; all rows are one run there."""
    import pyarrow as pa
    import pyarrow.csv

    columns = {"time": DT_S * np.arange(made.samples)}
    columns |= {f"p{c}": made.measured[:, i].round(4) for i, c in enumerate("ABC")}
    names = []
    for k in range(made.key_points):
        each = [f"{axis}{k}" for axis in "xyz"]
        names.append(f'["{each[0]}", "{each[1]}", "{each[2]}"]')
        columns |= {n: made.key_points_mm[:, k, i].round(4) for i, n in enumerate(each)}
    raw, map_file = folder / "raw.csv", folder / "map.toml"
    pyarrow.csv.write_csv(pa.table(columns), raw)
    map_file.write_text(MAP.format(names=", ".join(names)))
    return raw, map_file


def write_organ(faces: int, folder: Path) -> tuple[Path, int]:
    """A mesh of about so many faces with bumps, 80 mm in radius, and the number of its faces."""
    import trimesh

    side = max(8, round((faces / 4) ** 0.5))
    mesh = trimesh.creation.uv_sphere(radius=1.0, count=[side, side])
    way = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    bump = 1.0 + 0.05 * np.sin(5.0 * way[:, :1]) * np.cos(4.0 * way[:, 1:2])
    mesh.vertices = 80.0 * bump * way
    file = folder / f"organ{faces}.ply"
    mesh.export(file)
    return file, len(mesh.faces)


def write_image(slices: int, folder: Path) -> Path:
    """A segmented image of `SLICE_PIXELS` squared by so many voxels, as NIfTI.

    Label 1 is an organ of 1.6 l with bumps, 2 a lesion of 4 ml at its front, 3 a vessel through it.
    """
    import nibabel

    spacing = np.array([*[IMAGE_MM[0] / SLICE_PIXELS] * 2, IMAGE_MM[1] / slices])
    shape = (SLICE_PIXELS, SLICE_PIXELS, slices)
    axes = [
        (np.arange(n, dtype=np.float32) - 0.5 * (n - 1)) * d
        for n, d in zip(shape, spacing, strict=True)
    ]
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    bump = 1.0 + 0.04 * np.sin(x / 15.0) * np.cos(z / 12.0)
    labels = ((x / 100.0) ** 2 + (y / 62.0) ** 2 + (z / 62.0) ** 2 < bump).astype(np.uint8)
    labels[(y + 5.0) ** 2 + (z + 10.0) ** 2 < 36.0 * (labels > 0)] = 3
    labels[(x - 15.0) ** 2 + (y - 48.0) ** 2 + (z - 10.0) ** 2 < 100.0] = 2
    file = folder / f"image{slices}.nii.gz"
    image = nibabel.Nifti1Image(labels, np.diag([*spacing, 1.0]))
    image.header.set_xyzt_units("mm")
    nibabel.save(image, file)
    return file


CHILD = """
import atexit, pathlib, sys
file = pathlib.Path(sys.argv.pop(1))
status = pathlib.Path("/proc/self/status")
atexit.register(lambda: status.is_file() and file.write_text(status.read_text()))
from surgisoft.cli import main
main()
"""
"""A process that runs a command and leaves its peak of memory behind. The system's accounts of a
child begin with the memory of the process that started it."""


def cost(words: list[str], label: str, size: int, limit: str = "") -> Cost:
    """Run `surgisoft WORDS...` in a process and measure it."""
    with tempfile.TemporaryDirectory() as name:
        status, log = Path(name) / "status", Path(name) / "log"
        began = time.perf_counter()
        with log.open("w") as out:
            child = subprocess.Popen(
                [sys.executable, "-c", CHILD, str(status), *words], stdout=out, stderr=out
            )
            _, ended, used = os.wait4(child.pid, 0)
        clock_s = time.perf_counter() - began
        child.returncode = os.waitstatus_to_exitcode(ended)
        lines = log.read_text().strip().splitlines()
        peak = [line for line in status.read_text().splitlines() if line.startswith("VmHWM")]
    failed = "" if child.returncode in (0, 1) else f"exit {child.returncode}: {lines[-1:]}"
    seconds = used.ru_utime + used.ru_stime
    memory = 1024e-9 * int(peak[0].split()[1]) if peak else float("nan")
    return Cost(label, size, seconds, clock_s, memory, limit, failed)


def run(
    rows: list[int],
    faces: list[int],
    diagnosed: list[int],
    slices: list[int],
    report: Progress = silent,
) -> list[Cost]:
    """Measure the commands.

    rows: of `recording` and `import`; diagnosed: rows of `diagnose`; faces: of scenes; slices: of
    segmented images that scenes are made from.
    """
    compileall.compile_dir(Path(surgisoft.__file__).parent, quiet=2)
    found = [cost(["--help"], "--help", 0, "0.4 s")]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tasks: list[tuple[str, Callable[[], list[Cost]]]] = []

        def of_rows(count: int) -> list[Cost]:
            made, file = recording(count), folder / f"{count}.parquet"
            save_recording(made, file)
            raw, map_file = write_raw(made, folder)
            out = folder / f"imported{count}.parquet"
            words = ["import", str(raw), "--map", str(map_file), "-o", str(out)]
            return [
                cost(["recording", str(file)], "recording REC", count, "5 s for 1,000,000"),
                cost(words, "import RAW --map MAP", count, "5 s for 1,000,000"),
            ]

        def of_diagnosis(count: int) -> list[Cost]:
            file = folder / f"{count}.parquet"
            if not file.is_file():
                save_recording(recording(count), file)
            limit = "5 s for 12,000; 60 s, 4 GB for 2,000,000"
            found = [cost(["diagnose", "default", str(file)], "diagnose default REC", count, limit)]
            if count <= MOST_COMPARED:
                words = ["compare", "default", str(file)]
                found.append(cost(words, "compare default REC", count, "3 s for 12,000"))
            return found

        def of_faces(count: int) -> list[Cost]:
            file, real = write_organ(count, folder)
            words = ["scene", "new", str(file), "-o", str(folder / f"scene{count}")]
            return [cost(words, "scene new MESH", real, "30 s for 500,000")]

        def of_slices(count: int) -> list[Cost]:
            file = write_image(count, folder)
            labels = ["--label", "1:organ:liver", "2:lesion:tumour", "3:keep-out:vessel"]
            words = ["scene", "new", str(file), *labels, "-o", str(folder / f"image{count}")]
            label = f"scene new IMAGE of {SLICE_PIXELS} x {SLICE_PIXELS} x {count}"
            return [cost(words, label, count, "2 min on the clock for 200")]

        kinds = (
            (of_rows, rows),
            (of_diagnosis, diagnosed),
            (of_faces, faces),
            (of_slices, slices),
        )
        for kind, sizes in kinds:
            tasks += [(f"{kind.__name__} {n:,}", lambda k=kind, n=n: k(n)) for n in sizes]
        for number, (label, work) in enumerate(tasks):
            report(number, len(tasks), label)
            found += work()
    return found


def markdown(found: list[Cost]) -> str:
    """The table of costs."""
    lines = [
        "Processor time of all threads, and peak of resident memory, of one process each.",
        "",
        "| command | rows, faces or slices | processor time | on the clock | memory | limit |",
        "|---|---|---|---|---|---|",
    ]
    for each in found:
        size = f"{each.size:,}" if each.size else "-"
        numbers = f"{each.processor_s:.2f} s | {each.clock_s:.2f} s | {each.memory_gb:.2f} GB"
        numbers = f"{each.failed} | - | -" if each.failed else numbers
        lines.append(f"| `surgisoft {each.command}` | {size} | {numbers} | {each.limit} |")
    return "\n".join(lines) + "\n"
