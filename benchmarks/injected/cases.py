"""Cases with injected effects: which, how large, on which recordings; and the folders they fill.

    FOLDER/robots/ROBOT/before/*.parquet  recordings without injection, for the fit
    FOLDER/robots/ROBOT/model/            the arm model that was fitted to them
    FOLDER/robots/ROBOT/robot.json        the rod's error, the model's validated error, the noise
    FOLDER/cases/CASE/after/*.parquet     other rows of the robot's recordings, with injection
    FOLDER/cases/CASE/truth.json          what was injected

A case is drawn from its seed, its robot and its number only; no diagnosis is looked at.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.cache import Cache
from benchmarks.injected.laws import LAWS, UNKNOWN, Arm, Drawn, Law, points_of
from benchmarks.injected.rod import Rod, fit_rod
from benchmarks.real.entries import FOLDER, FitOptions, Source, part_of, recordings_of
from benchmarks.real.study import fitted
from surgisoft.errors import InputError, unknown_name
from surgisoft.files import write_json
from surgisoft.measurement.noise import known_noise
from surgisoft.measurement.recordings import Recording, save_recording
from surgisoft.progress import Progress, Stages
from surgisoft.surrogate.checkpoint import save_model

MODEL = FitOptions(prior="none")
"""Options of the fit of the model whose validated error is the unit of the changes: a network
alone."""
SIZES = (0.6, 1.0, 2.0)
"""RMS changes of the key points by single effects, as multiples of the model's validated error."""
PAIR_SIZE = 1.2
"""RMS change by each of two effects, as a multiple of it."""
RATE_HZ = 25.0
"""Rows per second on which the rod is evaluated; the change is interpolated between them. The
arms move below 2 Hz."""
PAUSE_S = 60.0
"""Time between two runs, which the files do not state, s: drift and breathing go on meanwhile."""
SCALE_TOLERANCE = 0.02
"""Relative difference from the wanted RMS change at which the search for a strength ends."""
SCALE_STEPS = 16
"""Most steps of that search."""
LEAST_SHARE = 0.7
"""Share of the wanted RMS change that the largest plausible strength has to reach; below it the
robot's motion does not show the effect, and the case is left out."""
WINDOWS = ((0.0, 1.0), (0.0, 0.6), (0.4, 1.0))
"""Parts of the rows after, for cases where nothing changed."""
PAIRS = (
    ("creep", "payload"),
    ("line_lag", "misalignment"),
    ("hysteresis", "gain_mismatch"),
    ("rate_dependence", "payload"),
    ("softening", "misalignment"),
    ("dead_zone", "creep"),
)
"""Pairs that are injected at once; the changes by each alone are added."""

MAPS = FOLDER.parents[1] / "docs" / "examples" / "maps"
_TRUNK = (
    "asl_trunk_payload/control_inputs_controlled_1.csv",
    "asl_trunk_payload/observations_controlled_1.csv",
)
_LOADED = (_TRUNK[0], "asl_trunk_payload/observations_controlled_1_200g.csv")


def _asu(*names: str) -> Source:
    files = tuple(f"asu_two_segment/{name}.txt.gz" for name in names)
    return Source(files, str(MAPS / "asu_two_segment.toml"))


@dataclass(frozen=True)
class Robot:
    """A real robot with recordings of it in which nothing was changed."""

    before: tuple[Source, ...]
    """Recordings for the fit."""
    after: tuple[Source, ...]
    """Recordings that receive the injection."""
    effects: tuple[str, ...]
    """Known effects to inject."""
    repeats: int = 1
    """Cases of each effect."""
    same_rows: tuple[str, ...] = ()
    """Effects that are also injected into the rows of the fit."""


LATER = ("zero_offset",)
"""Effects that were added when many cases existed: theirs come after all others."""
ALL = tuple(name for name, law in LAWS.items() if law.truth != UNKNOWN and name not in LATER)
STRANGE = tuple(name for name, law in LAWS.items() if law.truth == UNKNOWN)
NO_TENDON = ("twist",)
"""Effects of pneumatic arms only."""

ROBOTS = {
    "trunk": Robot(
        (Source(_TRUNK, str(MAPS / "asl_trunk.toml"), (0.0, 0.6)),),
        (Source(_TRUNK, str(MAPS / "asl_trunk.toml"), (0.6, 1.0)),),
        tuple(name for name in ALL if name not in NO_TENDON),
        repeats=2,
        same_rows=("payload", "gain_mismatch", "line_lag", "creep"),
    ),
    "asu_january": Robot(
        (_asu("Jan_10-4_data_collect_*"),), (_asu("Jan_10-5_data_collect_*"),), ALL
    ),
    "asu_april": Robot((_asu("apr_4_data_collect_[1-7]"),), (_asu("apr_5_data_collect_1"),), ALL),
    "trunk_200g": Robot(
        (Source(_LOADED, str(MAPS / "asl_trunk.toml"), (0.0, 0.6)),),
        (Source(_LOADED, str(MAPS / "asl_trunk.toml"), (0.6, 1.0)),),
        tuple(name for name in ALL if name not in NO_TENDON),
    ),
}
"""Robots by name."""


@dataclass(frozen=True)
class Case:
    """What is injected into one robot's recordings."""

    robot: str
    """Name of the robot."""
    number: int
    """Number of the case on its robot."""
    effects: tuple[str, ...]
    """Effects to inject; none: nothing changed."""
    size: float
    """Wanted RMS change by each effect, as a multiple of the model's validated error."""
    same_rows: bool = False
    """Whether the rows of the fit receive the injection, in place of other rows."""
    window: tuple[float, float] = (0.0, 1.0)
    """Part of the rows that the case has."""

    @property
    def name(self) -> str:
        """Name of the case's folder."""
        what = "-".join(self.effects) or "clean"
        return f"{self.robot}-{self.number:03d}-{what}" + ("-same" if self.same_rows else "")


def cases_of(name: str, seed: int) -> list[Case]:
    """The cases of one robot: single effects of drawn sizes, unknown ones, pairs, clean ones."""
    if name not in ROBOTS:
        raise unknown_name("robot", name, ROBOTS)
    robot = ROBOTS[name]
    rng = np.random.default_rng([seed, *name.encode()])
    plan: list[tuple[tuple[str, ...], float, bool, tuple[float, float]]] = []
    for effect in robot.effects:
        sizes = rng.permutation(SIZES)[: robot.repeats]
        plan += [((effect,), float(size), False, WINDOWS[0]) for size in sizes]
    plan += [((effect,), float(rng.choice(SIZES[1:])), False, WINDOWS[0]) for effect in STRANGE]
    pairs = rng.permutation(len(PAIRS))[: 1 + robot.repeats]
    plan += [(PAIRS[pair], PAIR_SIZE, False, WINDOWS[0]) for pair in pairs]
    plan += [((effect,), float(rng.choice(SIZES)), True, WINDOWS[0]) for effect in robot.same_rows]
    plan += [((), 0.0, False, window) for window in WINDOWS]
    plan += [((effect,), size, False, WINDOWS[0]) for effect in LATER for size in SIZES]
    return [Case(name, number, *values) for number, values in enumerate(plan)]


# Injection -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Bench:
    """A robot's recordings before and after, its rod, and what a model of it reaches."""

    before: list[Recording]
    """Recordings for the fit."""
    after: list[Recording]
    """Recordings that receive the injection."""
    rod: Rod
    """The rod that was fitted to the recordings before."""
    rod_mm: float
    """RMS error of the rod, mm."""
    rest: np.ndarray
    """(m,) actuation at rest."""
    span: float
    """Largest range of a chamber's actuation."""


def bench_of(before: list[Recording], after: list[Recording]) -> Bench:
    """The recordings with a rod fitted to those before."""
    signal = np.concatenate([recording.measured for recording in before])
    starts = [recording.measured[run.start] for recording in before for run in recording.runs]
    low, high = signal.min(0), signal.max(0)
    span = float((high - low).max())
    # Chambers under pressure rest at their lowest, motors that pull both ways where they started.
    both_ways = low < -0.1 * high
    rest = np.where(both_ways, np.median(starts, axis=0), low)
    points = np.concatenate([recording.key_points_mm for recording in before])
    rod, error = fit_rod((signal - rest) / span, points)
    return Bench(before, after, rod, error, rest, span)


def running_time(recording: Recording) -> np.ndarray:
    """(T,) time since the start, s, that goes on through all runs with a pause between two."""
    time = np.empty(recording.samples)
    end = -PAUSE_S
    for run in recording.runs:
        own = recording.t_s[run]
        time[run] = own - own[0] + end + PAUSE_S
        end = time[run][-1]
    return time


def thinned(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Rows about RATE_HZ apart, with the first and the last of each run, and where runs start."""
    rows, starts = [], [0]
    for run in recording.runs:
        time = recording.t_s[run]
        rate = (len(time) - 1) / max(time[-1] - time[0], 1e-9)
        own = np.arange(run.start, run.stop, max(1, round(rate / RATE_HZ)))
        own = own if own[-1] == run.stop - 1 else np.append(own, run.stop - 1)
        rows.append(own)
        starts.append(starts[-1] + len(own))
    return np.concatenate(rows), np.array(starts)


def arm_along(bench: Bench, recording: Recording, rows: np.ndarray, starts: np.ndarray) -> Arm:
    """The rod along some rows of a recording."""
    gravity = recording.gravity
    return Arm(
        rod=bench.rod,
        t_s=running_time(recording)[rows],
        starts=starts,
        loads=(recording.measured[rows] - bench.rest) / bench.span,
        unit=recording.unit,
        span=bench.span,
        gravity=np.array([0.0, 0.0, 1.0]) if gravity is None else gravity,
    )


def rms_mm(change: np.ndarray, seen: np.ndarray) -> float:
    """RMS length of changes (T, n, 3) where key points were seen (T, n), mm."""
    squares = np.sum(change**2, axis=2)[seen]
    return float(np.sqrt(squares.mean())) if len(squares) else 0.0


@dataclass(frozen=True, eq=False)
class Injection:
    """The change of the key points by one effect."""

    change_mm: list[np.ndarray]
    """One (T, n, 3) for each recording, mm."""
    strength: float
    """Strength of the law."""
    drawn: Drawn
    """Its drawn constants."""
    rms_mm: float
    """RMS change, mm."""


def inject(
    law: Law,
    bench: Bench,
    recordings: Sequence[Recording],
    wanted_mm: float,
    rng: np.random.Generator,
) -> Injection:
    """The change by an effect, of the strength that moves the key points by a wanted RMS.

    The strength is found by secant steps in its logarithm, and by bisection where they leave the
    bracket; the search ends at the law's largest plausible strength.
    """
    arms, drawn = [], {}
    for number, recording in enumerate(recordings):
        rows, starts = thinned(recording)
        arms.append((arm_along(bench, recording, rows, starts), rows))
        if number == 0:
            drawn = law.draw(arms[0][0], rng)
    seen = [np.isfinite(recording.key_points_mm).all(2) for recording in recordings]
    plain = [points_of(law, arm, drawn, 0.0) for arm, _ in arms]

    def changes(strength: float) -> list[np.ndarray]:
        found = []
        for (arm, rows), without, recording in zip(arms, plain, recordings, strict=True):
            change = points_of(law, arm, drawn, strength) - without
            found.append(_between(change, rows, recording, arm.starts))
        return found

    def size(change: list[np.ndarray]) -> float:
        return rms_mm(np.concatenate(change), np.concatenate(seen))

    if wanted_mm == 0:
        return Injection(changes(0.0), 0.0, drawn, 0.0)
    low, high, strength, power = 0.0, math.inf, 0.1 * law.most, 1.0
    best: Injection | None = None
    for _ in range(SCALE_STEPS):
        change = changes(strength)
        found = Injection(change, strength, drawn, size(change))
        if best and strength != best.strength and min(best.rms_mm, found.rms_mm) > 0:
            power = math.log(found.rms_mm / best.rms_mm) / math.log(strength / best.strength)
            power = min(max(power, 0.3), 4.0)
        if best is None or abs(found.rms_mm - wanted_mm) < abs(best.rms_mm - wanted_mm):
            best = found
        small = found.rms_mm < wanted_mm
        if abs(found.rms_mm / wanted_mm - 1) < SCALE_TOLERANCE or (small and strength >= law.most):
            break
        low, high = (strength, high) if small else (low, strength)
        share = wanted_mm / max(found.rms_mm, 1e-3 * wanted_mm)
        guess = min(strength * share ** (1 / power), law.most)
        strength = guess if low < guess < high else math.sqrt(max(low, 1e-3 * high) * high)
    assert best is not None
    return best


def _between(
    change: np.ndarray, rows: np.ndarray, recording: Recording, starts: np.ndarray
) -> np.ndarray:
    """The change (T, n, 3) at every row from that at some rows, linear in time within runs."""
    found = np.zeros(recording.key_points_mm.shape)
    for number, run in enumerate(recording.runs):
        own = slice(starts[number], starts[number + 1])
        at = recording.t_s[rows[own]]
        flat = change[own].reshape(own.stop - own.start, -1)
        columns = [np.interp(recording.t_s[run], at, column) for column in flat.T]
        found[run] = np.stack(columns, axis=1).reshape(-1, *change.shape[1:])
    return found


# Folders ---------------------------------------------------------------------------------------


def make_cases(
    names: Sequence[str], data: Path, folder: Path, seed: int, report: Progress
) -> list[str]:
    """Write the folders of all cases of some robots; returns a line for each robot."""
    stages, lines = Stages(report, len(names)), []
    for name in names:
        lines.append(make_robot(name, data, folder, seed, stages.stage(1.0, name)))
    return lines


def make_robot(name: str, data: Path, folder: Path, seed: int, tell: Progress) -> str:
    """Write one robot's folder and those of its cases; returns a summary in one line."""
    plan, robot = cases_of(name, seed), ROBOTS[name]
    before = _recordings(robot.before, data, "before")
    after = [_clocked(recording) for recording in _recordings(robot.after, data, "after")]
    place = folder / "robots" / name
    model = fitted(before, MODEL, "measured", Cache(folder / "fits"), tell)
    save_model(model, place / "model", {}, force=True)
    bench = bench_of(before, after)
    for number, recording in enumerate(before):
        save_recording(recording, place / "before" / f"before{number or ''}.parquet", True)
    validated, noise = model.validation.rmse_mm, known_noise([*before, *after])
    source = ", ".join(file for each in (*robot.before, *robot.after) for file in each.files)
    write_json(
        place / "robot.json",
        {
            "robot": name,
            "rod_rmse_mm": bench.rod_mm,
            "validated_rmse_mm": validated,
            "noise_mm": noise,
            "source": source,
            "seed": seed,
            "fit": {"effects": [], "actuation": "measured"},
        },
    )
    made, left_out = 0, []
    for done, case in enumerate(plan):
        tell(done, len(plan), case.name)
        if make_case(case, bench, validated, noise, folder / "cases" / case.name, seed):
            made += 1
        else:
            left_out.append(case.name)
    text = f"{name}: {made} cases; rod {bench.rod_mm:.2f} mm, model {validated:.2f} mm (validated)"
    return text + (f"; left out, too small: {', '.join(left_out)}" if left_out else "")


def make_case(
    case: Case, bench: Bench, validated_mm: float, noise_mm: float | None, place: Path, seed: int
) -> bool:
    """Write one case's folder; False where its robot's motion cannot show the effect."""
    rng = np.random.default_rng([seed, case.number, *case.robot.encode()])
    source = bench.before if case.same_rows else bench.after
    recordings = [part_of(recording, *case.window) for recording in source]
    changes = [np.zeros(recording.key_points_mm.shape) for recording in recordings]
    hidden = []
    for name in case.effects:
        wanted = case.size * validated_mm
        found = inject(LAWS[name], bench, recordings, wanted, rng)
        if found.rms_mm < LEAST_SHARE * wanted:
            return False
        changes = [a + b for a, b in zip(changes, found.change_mm, strict=True)]
        hidden.append(
            {
                "effect": name,
                "strength": found.strength,
                "rms_mm": found.rms_mm,
                "drawn": found.drawn,
            }
        )
    for number, (recording, change) in enumerate(zip(recordings, changes, strict=True)):
        moved = replace(
            recording, name="after", key_points_mm=recording.key_points_mm + change, source=None
        )
        save_recording(moved, place / "after" / f"after{number or ''}.parquet", True)
    seen = np.concatenate([np.isfinite(each.key_points_mm).all(2) for each in recordings])
    write_json(
        place / "truth.json",
        {
            "robot": case.robot,
            "hidden": hidden,
            "truth": [LAWS[name].truth for name in case.effects],
            "change_rms_mm": rms_mm(np.concatenate(changes), seen),
            "size": case.size,
            "validated_rmse_mm": validated_mm,
            "noise_mm": noise_mm,
            "source": f"injected into the real recordings of {case.robot}",
            "same_rows": case.same_rows,
            "seed": seed,
        },
    )
    return True


def _recordings(sources: Sequence[Source], data: Path, name: str) -> list[Recording]:
    found = [recording for source in sources for recording in recordings_of(source, data, name)]
    for recording in found:
        if recording.kind != "continuous":
            raise InputError(f"{recording.label}: steady-state samples, expected a continuous one")
    return found


def _clocked(recording: Recording) -> Recording:
    """The recording with one clock through all runs."""
    return replace(recording, t_s=running_time(recording))
