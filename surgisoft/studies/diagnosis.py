"""The benchmark of the diagnosis: many virtual robots, each with a truth that is known.

Robots are specimens of the virtual rig; their hidden effects have other forms than the model's.
Every robot draws: the hidden effect (or none, one outside the list, or two), its strength, noise,
excitation and the surrogate's own error. Base models are fitted once for a specimen and then bent
on purpose, by a smooth change of their weights, to a wanted validated error.
"""

import copy
import hashlib
import json
import math
import multiprocessing
import zlib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.errors import InputError
from surgisoft.measurement.histories import arm_spec, history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recording import Recording
from surgisoft.measurement.rig import VirtualRig
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.fit import FitConfig, fit
from surgisoft.surrogate.history import History
from surgisoft.surrogate.known_error import KnownError
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.rows import Data, model_rows, validated_error

KNOWN = {
    "hysteresis": "hysteresis",
    "rate_dependence": "rate_dependence",
    "line_lag": "line_lag",
    "creep": "creep",
    "softening": "softening",
    "stiffening": "stiffening",
    "dead_zone": "dead_zone",
    "gain_mismatch": "gain_mismatch",
    "coupling": "coupling",
    "payload": "payload",
    "contact": "contact",
    "misalignment": "misalignment",
    "drift": "drift",
    "thermal_drift": "drift",
    "twist": "twist",
}
"""The rig's hidden effects and the effects of the model's list that they are."""
MEMORY = {"hysteresis", "rate_dependence", "line_lag", "creep", "softening", "drift"}
"""Effects that a static surrogate cannot imitate."""
UNKNOWN = ("stick_slip", "leak", "sensor_crosstalk", "marker_slip")
"""Hidden effects that are not in the model's list."""
PAIRS = (
    ("creep", "payload"),
    ("line_lag", "misalignment"),
    ("hysteresis", "creep"),
    ("softening", "gain_mismatch"),
    ("drift", "dead_zone"),
    ("rate_dependence", "payload"),
    ("line_lag", "creep"),
    ("misalignment", "gain_mismatch"),
)
"""Pairs that are hidden at once."""
EXCITATIONS = {"poor": ("ramps", 3000), "medium": ("mixed", 6000), "rich": ("mixed", 12000)}
"""Name -> protocol and samples at 20 Hz."""
GRID_POINTS = 4096
"""Settled points that a base model is fitted to."""


@dataclass(frozen=True)
class Case:
    """One robot and what is hidden in it."""

    robot: int
    """Seed of the specimen."""
    hidden: tuple[tuple[str, float], ...]
    """Hidden effects and strengths."""
    surrogate_mm: float
    """Validated error that the surrogate is bent to, mm; 0: as it was fitted."""
    noise: str
    """`white`, `loud` or `correlated`."""
    excitation: str
    """A name of EXCITATIONS."""
    take: int
    """Draws schedule and noise."""
    undertrained: bool = False
    """Whether the surrogate was fitted for a few epochs only."""

    @property
    def truth(self) -> tuple[str, ...]:
        """The effects that should be named; `unknown` for those outside the list."""
        return tuple(KNOWN.get(name, "unknown") for name, _ in self.hidden)


@dataclass(frozen=True)
class Outcome:
    """What the diagnosis said of a case."""

    case: Case
    kind: str
    effects: tuple[str, ...]
    ranking: tuple[str, ...]
    confidence: float
    effect_mm: float
    """RMS change of the key points by what is hidden, mm."""
    surrogate_mm: float
    """Validated error of the surrogate, mm."""
    seconds: float
    statistics: dict


def cases(robots: list[int], count: int, seed: int) -> list[Case]:
    """About `count` robots: half with one hidden effect, and clean, unknown, two, undertrained."""
    rng = np.random.default_rng(seed)
    single = [((name, float(strength)),) for strength in (1.0, 2.0, 0.6) for name in KNOWN]
    plan: list[tuple[tuple, bool]] = []
    shares = {"single": 0.5, "clean": 0.25, "unknown": 0.1, "pair": 0.1, "undertrained": 0.05}
    for i in range(round(shares["single"] * count)):
        plan.append((single[i % len(single)], False))
    plan += [((), False)] * round(shares["clean"] * count)
    for i in range(round(shares["unknown"] * count)):
        plan.append((((UNKNOWN[i % len(UNKNOWN)], float(rng.choice([1.0, 2.0]))),), False))
    for i in range(round(shares["pair"] * count)):
        pair = PAIRS[i % len(PAIRS)]
        plan.append((tuple((name, 1.2) for name in pair), False))
    plan += [((), True)] * round(shares["undertrained"] * count)
    answer = []
    for take, (hidden, undertrained) in enumerate(plan):
        answer.append(
            Case(
                robot=int(rng.choice(robots)),
                hidden=hidden,
                surrogate_mm=float(rng.choice([0.0, 0.0, 0.25])),
                noise=str(rng.choice(["white", "white", "loud", "correlated"])),
                excitation=str(rng.choice(["poor", "medium", "rich", "rich"])),
                take=1000 * seed + take,
                undertrained=undertrained,
            )
        )
    return answer


def base_model(robot: int, folder: Path, undertrained: bool = False) -> ArmModel:
    """The fitted model of a specimen, kept in a folder between uses."""
    place = folder / f"robot-{robot}{'-undertrained' if undertrained else ''}"
    if (place / "config.json").is_file():
        return load_model(place)
    rig = VirtualRig(robot)
    train, _ = rig.record(make_protocol("grid", rig.limits, GRID_POINTS, seed=robot))
    valid, _ = rig.record(make_protocol("validation", rig.limits, None, seed=robot))
    config = FitConfig(effects=("hysteresis",), seed=robot)
    if undertrained:
        config = replace(config, epochs=10)
    result = fit(history_of([train]), history_of([valid]), arm_spec([train]), config)
    folder.mkdir(parents=True, exist_ok=True)
    save_model(result.model, place, result.report(), force=True, known=result.known)
    return load_model(place)


def validation_of(robot: int) -> History:
    """The settled points that a specimen's models are validated on."""
    rig = VirtualRig(robot)
    valid, _ = rig.record(make_protocol("validation", rig.limits, None, seed=robot))
    return history_of([valid])


def bent(model: ArmModel, robot: int, wanted_mm: float, seed: int) -> ArmModel:
    """The model with a smooth static error, so that its validated error is `wanted_mm`."""
    history = validation_of(robot)
    generator = torch.Generator().manual_seed(seed)
    noise = {
        name: torch.randn(value.shape, generator=generator) * value.std()
        for name, value in model.network.layers.state_dict().items()
        if name.endswith("weight")
    }
    low, high, answer = 0.0, 0.5, model
    for _ in range(12):
        middle = 0.5 * (low + high)
        answer = copy.deepcopy(model)
        with torch.no_grad():
            for name, value in answer.network.layers.named_parameters():
                if name in noise:
                    value.add_(middle * noise[name])
        rows = Data(history, history, None).judging_rows(answer)
        answer.validation = validated_error(rows.target, model_rows(answer, rows))
        if answer.validation["rmse_mm"] < wanted_mm:
            low = middle
        else:
            high = middle
    return answer


def record(case: Case) -> tuple[Recording, float]:
    """The recording of a case, and the RMS change that the hidden effects make, mm."""
    protocol, points = EXCITATIONS[case.excitation]
    scale = 3.0 if case.noise == "loud" else 1.0
    shapes = []
    for hidden in (case.hidden, ()):
        rig = VirtualRig(case.robot, noise=scale, take=case.take, hidden=hidden)
        plan = make_protocol(protocol, rig.limits, points, seed=case.take)
        recording, truth = rig.record(plan)
        shapes.append((recording, truth))
        if not case.hidden:
            break
    recording, truth = shapes[0]
    change = truth.noise_free_mm - shapes[-1][1].noise_free_mm
    if case.noise == "correlated":
        recording = _with_correlated_noise(recording, case.take)
    return recording, float(np.sqrt(np.nanmean(np.square(change).sum(2))))


def _with_correlated_noise(recording: Recording, seed: int) -> Recording:
    """0.05 mm more in each coordinate, as an autoregressive process of 4 s."""
    rng = np.random.default_rng([seed, zlib.crc32(b"correlated")])
    points = recording.key_points_mm.copy()
    keep = math.exp(-0.05 / 4.0)
    drive = rng.normal(0.0, 0.05 * math.sqrt(1 - keep**2), points.shape)
    walk = np.zeros_like(points)
    for t in range(1, len(points)):
        walk[t] = keep * walk[t - 1] + drive[t]
    noise = recording.noise_mm
    return replace(
        recording,
        key_points_mm=points + walk,
        noise_mm=None if noise is None else math.hypot(noise, 0.05),
    )


def run_case(case: Case, folder: Path) -> Outcome:
    """Record, bend the surrogate, diagnose."""
    torch.set_num_threads(1)
    model = base_model(case.robot, folder, case.undertrained)
    if case.surrogate_mm > model.validation["rmse_mm"]:
        model = bent(model, case.robot, case.surrogate_mm, case.take)
    known = KnownError.of(model, [validation_of(case.robot)])
    recording, size = record(case)
    found = diagnose(model, [recording], reference=known)
    return Outcome(
        case=case,
        kind=found.verdict.kind,
        effects=found.verdict.effects,
        ranking=tuple(row.effect for row in found.ranking),
        confidence=found.ranking[0].confidence if found.ranking else 0.0,
        effect_mm=size,
        surrogate_mm=model.validation["rmse_mm"],
        seconds=found.seconds,
        statistics=found.statistics,
    )


def run(
    some: list[Case],
    folder: Path,
    processes: int,
    report: Callable[[float, float, str], None],
) -> list[Outcome]:
    """All outcomes; base models first, then the cases, over processes.

    What was said of a case is kept in the folder, so that a run that was cut off goes on.
    """
    robots = sorted({(case.robot, case.undertrained) for case in some})
    if not robots:
        raise InputError("no cases: ask for at least one robot")
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"outcomes-{_fingerprint()}.jsonl"
    known = _read(log)
    total, done = len(robots) + len(some), 0
    answer = {case: known[case] for case in some if case in known}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        for future in as_completed([pool.submit(base_model, r, folder, u) for r, u in robots]):
            future.result()
            done += 1
            report(done, total, "base models")
        done += len(answer)
        jobs = [pool.submit(run_case, case, folder) for case in some if case not in answer]
        for future in as_completed(jobs):
            outcome = future.result()
            answer[outcome.case] = outcome
            done += 1
            report(done, total, f"{len(answer)} of {len(some)} robots")
            with log.open("a") as file:
                file.write(json.dumps(asdict(outcome)) + "\n")
    return [answer[case] for case in some]


def _fingerprint() -> str:
    """What the outcomes depend on: the code of the diagnosis, the effects and the rig."""
    package = Path(__file__).parents[1]
    parts = ("diagnosis", "surrogate", "measurement/rig", "measurement/protocols", "studies")
    digest = hashlib.sha256()
    for part in parts:
        for path in sorted((package / part).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _read(log: Path) -> dict[Case, Outcome]:
    """Outcomes that were kept; a line that was cut off is left out."""
    answer = {}
    for line in log.read_text().splitlines() if log.is_file() else []:
        try:
            values = json.loads(line)
        except json.JSONDecodeError:
            continue
        case = values.pop("case")
        hidden = tuple((name, strength) for name, strength in case.pop("hidden"))
        outcome = Outcome(
            case=Case(hidden=hidden, **case),
            effects=tuple(values.pop("effects")),
            ranking=tuple(values.pop("ranking")),
            **values,
        )
        answer[outcome.case] = outcome
    return answer
