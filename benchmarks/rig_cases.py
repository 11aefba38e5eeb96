"""Cases for a diagnosis on a generator of robots: recordings before and after a change.

A folder of cases, outside git, gets

    robots/ROBOT/before/*.parquet   recordings of the unchanged robot, for the fit
    robots/ROBOT/robot.json         seed, chambers, key points, noise
    cases/CASE/after/*.parquet      recording of the same robot with what is hidden
    cases/CASE/truth.json           robot, hidden effects with their strengths, the names that a
                                    diagnosis should give, RMS change of the key points in mm,
                                    noise in mm, whether a recording before has the same actuation

Everything follows from the seeds, and what exists already is kept: a second call continues. The
cases come in rounds that hold every known effect, unknown ones, pairs and clean robots, so that any
first part of them is balanced. `--pairs` and `--unknown` add cases of two effects, any two of the
list that recordings can tell apart, and of unknown effects of more kinds; they have plans of their
own, so that the rounds stay what they are; so have those of `--later`, effects that were added to
the list when many cases existed. `--longer` is a factor on the durations of all
recordings. Strengths are chosen so that the RMS change is about the
one drawn. Nothing here knows a model or a diagnosis. `benchmarks.elastica_cases` and
`benchmarks.chain_cases` are two generators.
"""

import argparse
import functools
import itertools
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from benchmarks.diagnosis.cases import PAIRS
from surgisoft.errors import InputError
from surgisoft.files import write_atomically
from surgisoft.measurement.protocols import Protocol as Schedule
from surgisoft.measurement.protocols.continuous import schedule
from surgisoft.measurement.recordings import ArmInfo, Recording, load_recording, save_recording
from surgisoft.rig.interface import Truth
from surgisoft.workers import workers

KNOWN = {
    "payload": "payload",
    "hysteresis": "hysteresis",
    "gain_mismatch": "gain_mismatch",
    "line_lag": "line_lag",
    "creep": "creep",
    "misalignment": "misalignment",
    "rate_dependence": "rate_dependence",
    "contact": "contact",
    "softening": "softening",
    "coupling": "coupling",
    "dead_zone": "dead_zone",
    "drift": "drift",
    "stiffening": "stiffening",
    "twist": "twist",
    "thermal_drift": "drift",
}
"""Hidden effect of every generator -> the name that a diagnosis should give."""
FURTHER_KNOWN = {"backlash": "hysteresis", "inertia": "inertia"}
"""The same of effects that only some generators have (`Generator.further`)."""
LATER_KNOWN = {"zero_offset": "zero_offset"}
"""The same of effects that joined later, which `--later` adds in a plan of their own."""
ALIKE = (
    {"line_lag", "rate_dependence"},
    {"drift", "thermal_drift"},
    {"drift", "misalignment"},
    {"stiffening", "coupling"},
)
"""Pairs that `--pairs` leaves out: one recording does not show which of the two it is, or that
there are two. Both are first-order lags, both have the same name, both turn the base, both take
push away as pressure rises."""
CLEAN_A_ROUND, PAIRS_A_ROUND = 4, 2
"""Cases without any change, and with two effects, in a round."""
CHANGE_MM = (0.4, 3.0)
"""Range of the RMS change of the key points that is drawn, log-uniformly [mm], in units of the
generator's `scale`."""
PAIR_CHANGE_MM = (0.8, 3.0)
"""The same of each effect of `--pairs` [mm]: its least is several times the validated error of the
arm models that are fitted to these robots, so that both effects can be seen."""
BEFORE = {
    "mixed": ("ramps", "holds", "reversals", "ladder", "wander"),
    "other": ("steps", "sets", "two_speeds", "wander"),
}
"""Recordings before the change: name -> excitation signals, one run each."""
AFTER = {
    "same": ("ramps", "holds", "reversals", "ladder", "wander"),
    "mixed": ("ramps", "holds", "reversals", "ladder", "wander"),
    "brisk": ("steps", "ramps", "wander"),
}
"""Recordings after it. `same` has the actuation of `mixed` before; the others are drawn anew for
each robot."""
AFTER_S = {"mixed": 150.0, "brisk": 150.0}
"""Their durations [s]; `same` takes as long as `mixed` before."""
TRIED = ("sets", "wander")
"""Excitation signals on which a strength is tried."""
TRIED_S = 40.0
"""Duration of a try [s]."""


TAKES = {"round": 1_000, "pair": 10_000, "unknown": 20_000, "later": 30_000}
"""Number of the first trial of each plan: every case has noise of its own."""


class CaseRig(Protocol):
    """A robot of a generator, on its bench."""

    chambers: int
    """Number m of chambers."""
    key_planes: int
    """Number n of key points."""
    unit: str
    """Unit of the actuation, such as kPa."""
    limits: np.ndarray
    """(m, 2) lowest and highest actuation [unit]."""
    period_s: float
    """Time from sample to sample [s]."""
    arm: ArmInfo
    """Size of the arm."""

    def record(self, protocol: Schedule) -> tuple[Recording, Truth]:
        """The recording of a protocol, and the true state of its samples."""


@dataclass(frozen=True)
class Generator:
    """A generator of robots."""

    rig: Callable[..., CaseRig]
    """A robot by its seed; fields: take, noise and hidden, as of `ElasticaRigConfig`."""
    unknown: tuple[str, ...]
    """Hidden effects of the rounds for which a diagnosis has no name."""
    more_unknown: tuple[str, ...]
    """Those of `--unknown`."""
    before_s: Callable[[int], dict[str, float]]
    """Durations of the recordings before a change of a robot [s], by names of BEFORE."""
    scale: Callable[[int], float] = lambda robot: 1.0
    """Factor on the changes that are drawn for a robot [-]."""
    about: Callable[[int], dict] = lambda robot: {}
    """More values of `robot.json`."""
    tries: int = 0
    """Strengths that are tried for an effect on the schedule of its case; 0: one, on a short
    schedule, for a generator that is slow."""
    longer: float = 1.0
    """Factor on the durations of all recordings, before and after a change [-]."""
    further: tuple[str, ...] = ()
    """Hidden effects of the rounds that are of FURTHER_KNOWN."""

    def duration_s(self, robot: int, name: str) -> float:
        """Duration of a recording before the change [s]; name: of BEFORE."""
        return self.longer * self.before_s(robot)[name]


@dataclass(frozen=True)
class Case:
    """One case."""

    number: int
    """Position in its plan."""
    robot: int
    """Seed of the robot."""
    names: tuple[str, ...]
    """Hidden effects."""
    change_mm: float
    """RMS change of the key points that each of them should make [mm]."""
    after: str
    """A name of AFTER."""
    plan: str = "round"
    """A name of TAKES."""

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.number:03d}" if self.plan == "round" else f"{self.plan}-{self.number:03d}"

    @property
    def truth(self) -> list[str]:
        """The names that a diagnosis should give; `unknown` for effects that it does not have."""
        return [(KNOWN | FURTHER_KNOWN | LATER_KNOWN).get(name, "unknown") for name in self.names]


def cases(generator: Generator, robots: list[int], count: int, seed: int) -> list[Case]:
    """The first `count` cases of rounds in which each robot gets other effects every time."""
    rng = np.random.default_rng(seed)
    found: list[Case] = []
    turn = 0
    while len(found) < count:
        pairs = [PAIRS[(PAIRS_A_ROUND * turn + k) % len(PAIRS)] for k in range(PAIRS_A_ROUND)]
        alone = (*KNOWN, *generator.further, *generator.unknown)
        plan = [*((name,) for name in alone), *pairs, *[()] * CLEAN_A_ROUND]
        for k in rng.permutation(len(plan)):
            change = np.exp(rng.uniform(*np.log(CHANGE_MM)))
            robot = robots[(int(k) + turn) % len(robots)]
            after = str(rng.choice(list(AFTER)))
            found.append(Case(len(found), robot, plan[k], float(change), after))
        turn += 1
    return found[:count]


def pairs(robots: list[int], count: int, seed: int) -> list[Case]:
    """So many cases of two effects: every two of the list in turn, but for those that are ALIKE."""
    every = [two for two in itertools.combinations(KNOWN, 2) if set(two) not in ALIKE]
    return _drawn("pair", every, PAIR_CHANGE_MM, robots, count, seed)


def unknowns(generator: Generator, robots: list[int], count: int, seed: int) -> list[Case]:
    """So many cases of an unknown effect, every kind in turn."""
    every = [(name,) for name in generator.more_unknown]
    return _drawn("unknown", every, CHANGE_MM, robots, count, seed)


def later(robots: list[int], count: int, seed: int) -> list[Case]:
    """So many cases of one effect of LATER_KNOWN, every one in turn."""
    return _drawn("later", [(name,) for name in LATER_KNOWN], CHANGE_MM, robots, count, seed)


def _drawn(
    plan: str,
    every: list[tuple[str, ...]],
    range_mm: tuple[float, float],
    robots: list[int],
    count: int,
    seed: int,
) -> list[Case]:
    """The first `count` cases of rounds of a plan, each round in a random order."""
    rng = np.random.default_rng([seed, *plan.encode()])
    found: list[Case] = []
    while len(found) < count:
        for place in rng.permutation(len(every)):
            change = np.exp(rng.uniform(*np.log(range_mm)))
            robot, after = robots[len(found) % len(robots)], str(rng.choice(list(AFTER)))
            found.append(Case(len(found), robot, every[place], float(change), after, plan))
    return found[:count]


def excitation(
    rig: CaseRig, name: str, signals: tuple[str, ...], seconds: float, seed: int
) -> Schedule:
    """A continuous protocol of excitation signals, one run each."""
    rng = np.random.default_rng([seed, len(name), *name.encode()])
    count = round(seconds / rig.period_s)
    rows = _ordered(schedule(signals, count, rig.period_s, rig.limits, rng))
    return Schedule(name, "continuous", *rows, unit=rig.unit)


def _ordered(parts: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple:
    """Commands, runs and times in the order of `Schedule`."""
    times, rows, runs = parts
    return rows, runs, times


def after_protocol(generator: Generator, rig: CaseRig, robot: int, after: str) -> Schedule:
    """The protocol of a recording after the change."""
    if after == "same":
        seconds = generator.duration_s(robot, "mixed")
        return excitation(rig, "mixed", AFTER[after], seconds, robot)
    seconds = generator.longer * AFTER_S[after]
    return excitation(rig, f"after_{after}", AFTER[after], seconds, robot)


def record(rig: CaseRig, protocol: Schedule) -> tuple[Recording, np.ndarray]:
    """A recording, and the key points (T, n, 3) [mm] of its samples without noise."""
    recording, truth = rig.record(protocol)
    return recording, truth.noise_free_mm


def make_robot(generator: Generator, folder: Path, robot: int) -> None:
    """Record a robot before any change, and what it would do in the protocols after it."""
    place = folder / "robots" / str(robot)
    if (place / "robot.json").is_file():
        known = json.loads((place / "robot.json").read_text()).get("longer", 1.0)
        if known != generator.longer:
            raise InputError(
                f"{place}: its recordings were made with --longer {known:g}, expected "
                f"{generator.longer:g}; take another folder, or the same factor"
            )
        return
    (place / "before").mkdir(parents=True, exist_ok=True)
    plain = {}
    noise: list[float | None] = []
    for take, (name, signals) in enumerate(BEFORE.items()):
        rig = generator.rig(robot, take=take)
        protocol = excitation(rig, name, signals, generator.duration_s(robot, name), robot)
        recording, points = record(rig, protocol)
        save_recording(recording, place / "before" / f"{name}.parquet", force=True)
        noise.append(recording.noise_mm)
        if name == "mixed":
            plain["same"] = points
    for after in AFTER:
        if after != "same":
            rig = generator.rig(robot, noise=0.0)
            plain[after] = record(rig, after_protocol(generator, rig, robot, after))[1]
    if not generator.tries:
        rig = generator.rig(robot, noise=0.0)
        plain["tried"] = record(rig, excitation(rig, "tried", TRIED, TRIED_S, robot))[1]
    np.savez_compressed(place / "unchanged.npz", **plain)
    about = {
        "seed": robot,
        "chambers": rig.chambers,
        "key_points": rig.key_planes,
        "length_mm": rig.arm.length_mm,
        f"high_{rig.unit}": float(rig.limits[0, 1]),
        "period_s": rig.period_s,
        "noise_mm": noise,
    }
    _write(place / "robot.json", about | _lengthened(generator) | generator.about(robot))


def _lengthened(generator: Generator) -> dict[str, float]:
    """The factor on the durations for `robot.json`; nothing where it is 1."""
    return {} if generator.longer == 1.0 else {"longer": generator.longer}


def change_mm(points: np.ndarray, plain: np.ndarray) -> float:
    """RMS distance [mm] between key points (T, n, 3) with and without the hidden effects."""
    return float(np.sqrt(np.nanmean(np.square(points - plain).sum(axis=2))))


def strength_for(
    generator: Generator, case: Case, name: str, plain: Mapping[str, np.ndarray]
) -> float:
    """Strength at which an effect changes the key points by about what the case wants.

    In proportion to what the strength that was tried last changes (1 at first): on a short schedule
    for a slow generator, on the schedule of the case with as many tries as a fast one has.
    """
    wanted_mm, strength = case.change_mm * generator.scale(case.robot), 1.0
    for _ in range(max(generator.tries, 1)):
        rig = generator.rig(case.robot, noise=0.0, hidden=[(name, strength)])
        if generator.tries:
            protocol, unchanged = after_protocol(generator, rig, case.robot, case.after), case.after
        else:
            protocol, unchanged = excitation(rig, "tried", TRIED, TRIED_S, case.robot), "tried"
        points = record(rig, protocol)[1]
        factor = wanted_mm / max(change_mm(points, plain[unchanged]), 0.05)
        strength = round(float(np.clip(strength * factor, 0.1, 8.0)), 4)
    return strength


def make_case(generator: Generator, folder: Path, case: Case) -> None:
    """Record one case."""
    place = folder / "cases" / case.name
    if (place / "truth.json").is_file():
        return
    robot = folder / "robots" / str(case.robot)
    plain = np.load(robot / "unchanged.npz")
    hidden = [(name, strength_for(generator, case, name, plain)) for name in case.names]
    rig = generator.rig(case.robot, take=TAKES[case.plan] + case.number, hidden=hidden)
    recording, points = record(rig, after_protocol(generator, rig, case.robot, case.after))
    (place / "after").mkdir(parents=True, exist_ok=True)
    save_recording(recording, place / "after" / f"{case.after}.parquet", force=True)
    about_hidden: list[dict] = [{"effect": name, "strength": given} for name, given in hidden]
    if case.plan == "pair":
        for each, own in zip(about_hidden, hidden, strict=True):
            alone = generator.rig(case.robot, noise=0.0, hidden=[own])
            moved = record(alone, after_protocol(generator, alone, case.robot, case.after))[1]
            each["change_rms_mm"] = change_mm(moved, plain[case.after])
    about = {
        "robot": str(case.robot),
        "hidden": about_hidden,
        "truth": case.truth,
        "change_rms_mm": change_mm(points, plain[case.after]),
        "noise_mm": recording.noise_mm,
        "after": case.after,
        "same_actuation": case.after == "same",
    }
    _write(place / "truth.json", about)


def made(generator: Generator, folder: Path, case: Case) -> str:
    """Record one case; says so where it is left out, because the arm is unstable with it."""
    try:
        make_case(generator, folder, case)
    except InputError as reason:
        return f": {case.name} left out, {reason}"
    return ""


def run(
    generator: Generator,
    folder: Path,
    robots: list[int],
    drawn: list[Case],
    processes: int,
    report: Callable[[str], None],
) -> None:
    """Make the robots that the cases need, each before its first case, and the cases in order."""
    folder.mkdir(parents=True, exist_ok=True)
    count = len(drawn)
    if processes == 1:
        for number, case in enumerate(drawn):
            make_robot(generator, folder, case.robot)
            report(f"{number + 1} of {count}{made(generator, folder, case)}")
        return
    with workers(processes) as pool:
        every = [generator] * max(len(robots), count)
        for robot in pool.map(make_robot, every, [folder] * len(robots), robots):
            report(f"robots {robot or ''}")
        for number, text in enumerate(pool.map(made, every, [folder] * count, drawn)):
            report(f"{number + 1} of {count}{text}")


def _write(path: Path, about: dict) -> None:
    write_atomically(path, (json.dumps(about, indent=1) + "\n").encode())


def load_case(folder: Path, name: str) -> tuple[dict, list[Recording], list[Recording]]:
    """A case's truth, and its recordings before and after."""
    place = folder / "cases" / name
    truth = json.loads((place / "truth.json").read_text())
    before = folder / "robots" / truth["robot"] / "before"
    both = [
        [load_recording(path) for path in sorted(where.glob("*.parquet"))]
        for where in (before, place / "after")
    ]
    return truth, both[0], both[1]


def main(generator: Generator, about: str, robots: str) -> None:
    """Parse the command line of a generator's module, and make the cases.

    about: its description; robots: seeds of its default robots, with commas.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robots", default=robots, help="seeds, with commas")
    parser.add_argument("--count", type=int, default=100, help="cases of the rounds")
    parser.add_argument("--pairs", type=int, default=0, help="further cases of two effects")
    parser.add_argument("--unknown", type=int, default=0, help="further cases of unknown effects")
    parser.add_argument("--later", type=int, default=0, help="further cases of a shifted zero")
    longer = "factor on the durations of the recordings"
    parser.add_argument("--longer", type=float, default=1.0, help=longer)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args()
    if not given.longer > 0.0:
        parser.error(f"--longer {given.longer:g}: expected a factor above 0")
    generator = replace(generator, longer=given.longer)
    seeds = [int(word) for word in given.robots.split(",")]
    drawn = [
        *cases(generator, seeds, given.count, given.seed),
        *pairs(seeds, given.pairs, given.seed),
        *unknowns(generator, seeds, given.unknown, given.seed),
        *later(seeds, given.later, given.seed),
    ]
    report = functools.partial(print, flush=True)
    try:
        run(generator, given.folder, seeds, drawn, given.processes, report)
    except InputError as error:
        parser.error(str(error))
