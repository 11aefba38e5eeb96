"""Benchmark `setup-faults`: faults of the set-up put into recordings, and recordings without any.

Every fault alone and in pairs, with random parameters, in recordings of several sources: the
virtual rig, folders of cases of other simulators, and other arms whose recordings and models lie
in folders. A fault is found if the verdict names its kinds and no other, and the correction
restores the original: key points to the error of the model, actuation to 2 % of its range. False
alarms are counted on clean recordings and on recordings with each hidden effect.
"""

import itertools
import json
import time
from collections.abc import Callable
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.decision.folders import model_folder
from benchmarks.diagnosis.robots import base_model
from surgisoft.diagnosis.setup import SetupResult, find_setup_faults
from surgisoft.errors import InputError
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording, load_recording, save_recording
from surgisoft.progress import Progress
from surgisoft.rig import VirtualRig
from surgisoft.rig.hidden import HIDDEN
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.workers import workers

CLEAN = (("mixed", 6000, 1.0), ("mixed", 6000, 3.0), ("ramps", 3000, 1.0))
"""Protocol, rows and factor of the noise of the clean recordings of each robot."""
AMPLITUDES = (1.0, 2.0)
"""Amplitudes of the hidden effects."""
HIDDEN_ROWS = 6000
"""Rows of a recording with a hidden effect."""
LEAST_MOTION = 0.2
"""Least RMS motion of a key point that is made dead, as a share of the largest: one that hardly
moves anyway is no fault that shows."""
ACTUATION_SHARE = 0.02
"""Largest RMS error of the corrected actuation, as a share of its range."""


@dataclass(frozen=True)
class Source:
    """Recordings of one arm, and its model."""

    name: str
    """Row of the table that the source counts to."""
    model: Path
    """Folder of the model."""
    clean: tuple[Path, ...]
    """Recordings without any fault."""
    hidden: tuple[Path, ...] = ()
    """Recordings with a hidden effect."""


@dataclass(frozen=True)
class Outcome:
    """One recording with its faults, and what was found."""

    source: str
    """Name of the source."""
    recording: str
    """Name of the recording."""
    clean: bool
    """Whether nothing but the faults is wrong in it."""
    truth: tuple[str, ...]
    """Faults that were put in."""
    found: tuple[str, ...]
    """Kinds that were named."""
    named: bool
    """Whether the kinds are right, of the first explanation or of one that does as well."""
    first: bool
    """Whether the first explanation is right."""
    corrected: bool
    """Whether the correction gives the original recording."""
    seconds: float
    """Processor time of the tests, s."""
    sentence: str
    """What was found, in words."""


UNITS = {
    "kPa": (6.894757293168361, 100.0, 1e-3, 1e3),
    "psi": (1 / 6.894757293168361, 100 / 6.894757293168361),
    "deg": (57.29577951308232,),
}
"""Unit of a model -> how many of it are one of another: psi, bar, Pa, MPa; kPa, bar; rad."""


# Faults ---------------------------------------------------------------------------------------


def _turn(recording: Recording, rng: np.random.Generator) -> Recording:
    """Turned by 20 to 180 degrees about any axis, and shifted by up to 100 mm."""
    axis = rng.normal(size=3)
    turn = np.radians(rng.uniform(20, 180)) * axis / np.linalg.norm(axis)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    return _with_points(recording, recording.key_points_mm @ rotation.T + rng.uniform(-100, 100, 3))


def _axes(recording: Recording, rng: np.random.Generator) -> Recording:
    """Axes mirrored or swapped: a signed permutation of determinant -1."""
    while True:
        matrix = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)
        if np.linalg.det(matrix) < 0:
            return _with_points(recording, recording.key_points_mm @ matrix.T)


def _length(recording: Recording, rng: np.random.Generator) -> Recording:
    """Positions in cm, m or inches where mm are stated."""
    return _with_points(recording, recording.key_points_mm / rng.choice([10.0, 1000.0, 25.4]))


def _pressure(recording: Recording, rng: np.random.Generator) -> Recording:
    """Actuation in another unit than the model's."""
    factor = rng.choice(UNITS[recording.unit])
    return _with_actuation(recording, lambda values: values / factor)


def _permuted(recording: Recording, rng: np.random.Generator) -> Recording:
    """Channels permuted."""
    same = np.arange(recording.chambers)
    order = same
    while (order == same).all():
        order = rng.permutation(same)
    return _with_actuation(recording, lambda values: values[:, order])


def _flipped(recording: Recording, rng: np.random.Generator) -> Recording:
    """The sign of one channel flipped."""
    sign = np.ones(recording.chambers)
    sign[rng.integers(recording.chambers)] = -1.0
    return _with_actuation(recording, lambda values: values * sign)


def _reversed(recording: Recording, rng: np.random.Generator) -> Recording:
    """Key points from tip to base."""
    return _with_points(recording, recording.key_points_mm[:, ::-1])


def _late(recording: Recording, rng: np.random.Generator) -> Recording:
    """Key points 0.25 to 1.5 s late or early, by whole rows."""
    step = float(np.median(np.diff(recording.t_s)))
    rows = max(1, round(rng.uniform(0.25, 1.5) / step))
    late = bool(rng.integers(2))
    parts = {"measured": [], "commanded": [], "key_points_mm": [], "t_s": [], "run": []}
    for run in recording.runs:
        if run.stop - run.start < 4 * rows:
            continue
        body = slice(run.start, run.stop - rows) if late else slice(run.start + rows, run.stop)
        rest = slice(run.start + rows, run.stop) if late else slice(run.start, run.stop - rows)
        for name in parts:
            values = getattr(recording, name)
            if values is not None:
                parts[name].append(values[body if name == "key_points_mm" else rest])
    fresh = {name: np.concatenate(some) for name, some in parts.items() if some}
    return replace(recording, temp_C=None, payload_g=None, **({"commanded": None} | fresh))


def _time_unit(recording: Recording, rng: np.random.Generator) -> Recording:
    """Times in ms where s are stated, or in s where ms are."""
    return replace(recording, t_s=recording.t_s * rng.choice([1e3, 1e-3]))


def _dead_chamber(recording: Recording, rng: np.random.Generator) -> Recording:
    """One channel reads one value throughout."""
    measured = recording.measured.copy()
    k = rng.integers(recording.chambers)
    measured[:, k] = rng.choice([0.0, float(measured[0, k])])
    return replace(recording, measured=measured)


def _dead_point(recording: Recording, rng: np.random.Generator) -> Recording:
    """One key point keeps one position: one that moves, whatever the order of the key points."""
    points = recording.key_points_mm.copy()
    motion = np.sqrt(np.nanvar(points, axis=0).sum(1))
    k = rng.choice(np.flatnonzero(motion >= LEAST_MOTION * motion.max()))
    points[:, k] = points[np.flatnonzero(np.isfinite(points[:, k, 0]))[0], k]
    return _with_points(recording, points)


def _with_points(recording: Recording, points: np.ndarray) -> Recording:
    return replace(recording, key_points_mm=points)


def _with_actuation(recording: Recording, change: Callable) -> Recording:
    command = recording.commanded
    return replace(
        recording,
        measured=change(recording.measured),
        commanded=None if command is None else change(command),
    )


FAULTS: dict[str, tuple[str, Callable]] = {
    "turned": ("frame", _turn),
    "mirrored": ("frame", _axes),
    "length unit": ("length_unit", _length),
    "actuation unit": ("actuation_unit", _pressure),
    "permuted": ("chambers", _permuted),
    "sign": ("chambers", _flipped),
    "reversed": ("key_points", _reversed),
    "late": ("time", _late),
    "time unit": ("time_unit", _time_unit),
    "dead key point": ("dead_key_point", _dead_point),
    "dead chamber": ("dead_chamber", _dead_chamber),
}
"""Name -> kind that a verdict has to name, and what puts the fault in. In a pair they are put in
in this order, dead channels last."""


def pairs() -> list[tuple[str, ...]]:
    """All pairs of faults of different kinds."""
    return [p for p in itertools.combinations(FAULTS, 2) if FAULTS[p[0]][0] != FAULTS[p[1]][0]]


def drawn(count: int, seed: int, without: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """`count` single faults and `count` pairs, each as often as any other."""
    single = [(name,) for name in FAULTS if name not in without]
    double = [pair for pair in pairs() if not set(pair) & set(without)]
    rng = np.random.default_rng(seed)
    start = int(rng.integers(len(double)))
    return [
        *(single[i % len(single)] for i in range(count)),
        *(double[(start + i) % len(double)] for i in range(count)),
    ]


# One case -------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def _opened(model: Path, recording: Path):
    return load_model(model), load_recording(recording, on_warning=lambda text: None)


def run_case(source: Source, path: Path, truth: tuple[str, ...], seed: int) -> Outcome:
    """Put faults into a recording and look for them."""
    import torch

    torch.set_num_threads(1)
    model, original = _opened(source.model, path)
    rng = np.random.default_rng([seed, len(truth)])
    wrong = original
    for name in truth:
        wrong = FAULTS[name][1](wrong, rng)
    begin = time.process_time()
    found = find_setup_faults(model, [wrong])
    seconds = time.process_time() - begin
    kinds = tuple(sorted(FAULTS[name][0] for name in truth))
    first = found is not None and tuple(sorted(found.kinds)) == kinds
    others = found.alternatives if found else ()
    named = first or any(tuple(sorted(f.kind for f in some)) == kinds for some in others)
    return Outcome(
        source=source.name,
        recording=_name(path),
        clean=path in source.clean,
        truth=truth,
        found=found.kinds if found else (),
        named=named if truth else found is None,
        first=first if truth else found is None,
        corrected=first and bool(truth) and _gives_back(found, wrong, original, model),
        seconds=seconds,
        sentence=found.sentence if found else "",
    )


def _name(path: Path) -> str:
    """Name of a recording: that of its file, or the number of its case."""
    return f"case {path.parents[1].name}" if path.parent.name == "after" else path.stem


def _gives_back(found: SetupResult, wrong: Recording, original: Recording, model) -> bool:
    """Whether correcting the wrong recording gives the original one."""
    if not found.correctable:
        return True
    corrected = found.corrected([wrong])[0]
    validated, noise = model.validation.rmse_mm or 0.0, original.noise_mm or 0.0
    limit = float(np.hypot(validated, np.sqrt(3.0) * noise))
    delay = corrected.t_s - _matching(corrected, original)
    if np.ptp(delay) > 1e-6:
        return False
    at = _matching(corrected, original)
    place = np.clip(np.searchsorted(original.t_s, at - 1e-6), 0, original.samples - 1)
    apart = np.square(corrected.key_points_mm - original.key_points_mm[place]).sum(2)
    moved = np.ptp(original.measured, axis=0).max()
    driven = np.sqrt(np.mean(np.square(corrected.measured - original.measured[place])))
    dead = any(fault.kind == "dead_chamber" for fault in found.faults)
    share = 3 * ACTUATION_SHARE if dead else ACTUATION_SHARE  # the command is no measurement
    return bool(np.sqrt(np.nanmean(apart)) <= limit and driven <= share * moved)


def _matching(corrected: Recording, original: Recording) -> np.ndarray:
    """(T,) time in the original of each corrected row, by its key points' nearest whole offset."""
    step = float(np.median(np.diff(original.t_s)))
    best, offset = np.inf, 0.0
    reach = round(2.0 / step)
    for rows in range(-reach, reach + 1):
        at = np.searchsorted(original.t_s, corrected.t_s + rows * step - 1e-6)
        if at.min() < 0 or at.max() >= original.samples:
            at = np.clip(at, 0, original.samples - 1)
        apart = np.square(corrected.key_points_mm - original.key_points_mm[at])
        if (error := float(np.nanmean(apart))) < best:
            best, offset = error, rows * step
    return corrected.t_s + offset


# Sources --------------------------------------------------------------------------------------


def collect(robot: int, folder: Path) -> Source:
    """Model and recordings of one robot of the virtual rig, stored between uses."""
    base_model(robot, folder)
    place = folder / f"robot-{robot}-recordings"
    clean = tuple(
        _recorded(place / f"clean-{i}.parquet", robot, 100 + i, protocol, rows, noise, ())
        for i, (protocol, rows, noise) in enumerate(CLEAN)
    )
    hidden = tuple(
        _recorded(
            place / f"{name}-{amplitude:g}.parquet",
            robot,
            200 + i,
            "mixed",
            HIDDEN_ROWS,
            1.0,
            ((name, amplitude),),
        )
        for i, name in enumerate(HIDDEN)
        for amplitude in AMPLITUDES
    )
    return Source("virtual rig", folder / f"robot-{robot}", clean, hidden)


def _recorded(path: Path, robot: int, take: int, protocol: str, rows: int, noise, hidden) -> Path:
    if not path.exists():
        rig = VirtualRig(robot, noise=noise, take=take, hidden=hidden)
        plan = make_protocol(protocol, rig.limits, rows, seed=1000 * robot + take)
        save_recording(rig.record(plan)[0], path)
    return path


def given(folder: Path) -> Source:
    """A source that lies in a folder: `model`, `clean/*.parquet` and, if any, `hidden/*.parquet`.

    So do other rigs and real robots enter, whose recordings are no part of the project.
    """
    return Source(
        folder.name,
        folder / "model",
        tuple(sorted((folder / "clean").glob("*.parquet"))),
        tuple(sorted((folder / "hidden").glob("*.parquet"))),
    )


def of_cases(folder: Path, models: Path) -> list[Source]:
    """The robots of a folder of cases, with their models; a model that is missing is fitted.

    models: folder of models, as `surgisoft benchmark decision` leaves them.
    """
    robots: dict[str, tuple[list[Path], list[Path]]] = {}
    for file in sorted(folder.glob("cases/*/truth.json")):
        truth = json.loads(file.read_text())
        clean, hidden = robots.setdefault(truth["robot"], ([], []))
        (hidden if truth["truth"] else clean).extend(sorted(file.parent.glob("after/*.parquet")))
    if not any(clean for clean, _ in robots.values()):
        raise InputError(
            f"{folder}: expected a folder of cases, with one at least in which nothing is missing"
        )
    return [
        Source(folder.name, model_folder(folder, robot, models), tuple(clean), tuple(hidden))
        for robot, (clean, hidden) in sorted(robots.items())
    ]


def run(
    robots: list[int],
    folders: list[Path],
    cases: list[tuple[Path, Path]],
    count: int,
    seed: int,
    work: Path,
    processes: int,
    report: Progress,
) -> list[Outcome]:
    """All outcomes: `count` single faults and `count` pairs for each source, and none.

    robots: seeds of the own rig; folders: of other arms (`given`); cases: folders of cases and of
    the models of their robots (`of_cases`).
    """
    with workers(processes) as pool:
        jobs = [pool.submit(collect, robot, work) for robot in robots]
        for done, future in enumerate(as_completed(jobs)):
            future.result()
            report(done + 1, len(jobs), "robots recorded")
        sources = [job.result() for job in jobs] + [given(folder) for folder in folders]
        for folder, models in cases:
            sources += of_cases(folder, models)
        tasks = []
        for name in dict.fromkeys(source.name for source in sources):
            every = [source for source in sources if source.name == name]
            same = [source for source in every if source.clean]
            unit = load_recording(same[0].clean[0], on_warning=lambda text: None).unit
            without = () if unit in UNITS else ("actuation unit",)
            for i, truth in enumerate(drawn(count, seed, without)):
                source = same[i % len(same)]
                path = source.clean[(i // len(same)) % len(source.clean)]
                tasks.append((source, path, truth, seed + i))
            for source in every:
                tasks += [(source, path, (), 0) for path in (*source.clean, *source.hidden)]
        futures = [pool.submit(run_case, *task) for task in tasks]
        for done, future in enumerate(as_completed(futures)):
            future.result()
            report(done + 1, len(futures), "recordings")
        return [future.result() for future in futures]


# Table ----------------------------------------------------------------------------------------


def markdown(outcomes: list[Outcome]) -> str:
    """The tables of the study."""
    parts = []
    for name in dict.fromkeys(o.source for o in outcomes):
        some = [o for o in outcomes if o.source == name]
        parts += [f"## {name}", "", _summary(some), "", _by_fault(some), ""]
        wrong = [o for o in some if not o.named or (o.truth and o.first and not o.corrected)]
        if wrong:
            parts += ["What went wrong:", ""]
            parts += [
                f"- {o.recording}, {' + '.join(o.truth) or 'no fault'}: "
                f"{o.sentence or 'nothing was found'}"
                + ("" if not o.named else " (not corrected to within the error of the model)")
                for o in wrong
            ]
            parts.append("")
    return "\n".join(parts)


def _summary(some: list[Outcome]) -> str:
    rows = ["| | goal | reached |", "|---|---|---|"]
    for text, count in (("one fault", 1), ("two faults", 2)):
        faulty = [o for o in some if len(o.truth) == count]
        rows.append(f"| {text}: named, alone or in a set | 99 % | {_share(faulty, 'named')} |")
        rows.append(f"| {text}: named first | | {_share(faulty, 'first')} |")
        rows.append(
            f"| {text}: named first, and corrected | 99 % | {_share(faulty, 'corrected')} |"
        )
    clean = [o for o in some if not o.truth and o.clean]
    hidden = [o for o in some if not o.truth and not o.clean]
    for text, group in (("clean", clean), ("a physical effect", hidden)):
        if group:
            false = [replace(o, named=not o.named) for o in group]
            rows.append(f"| {text}: a fault named | 0.5 % | {_share(false, 'named')} |")
    seconds = sorted(o.seconds for o in some)
    rows.append(
        f"| processor time, median and 95 % quantile | 1 s | {np.median(seconds):.2f} s, "
        f"{np.quantile(seconds, 0.95):.2f} s |"
    )
    return "\n".join(rows)


def _share(some: list[Outcome], name: str) -> str:
    count = sum(getattr(o, name) for o in some)
    return f"{100 * count / max(len(some), 1):.1f} % ({count} of {len(some)})"


def _by_fault(some: list[Outcome]) -> str:
    rows = ["| fault | alone: named, corrected | in pairs: named, corrected |", "|---|---|---|"]
    for name in FAULTS:
        cells = []
        for count in (1, 2):
            group = [o for o in some if name in o.truth and len(o.truth) == count]
            named, corrected = sum(o.named for o in group), sum(o.corrected for o in group)
            cells.append(f"{named}, {corrected} of {len(group)}")
        rows.append(f"| {name} | {cells[0]} | {cells[1]} |")
    return "\n".join(rows)
