"""Benchmark `intervals`: how often the 95 % intervals of `amend` hold, on known parameters.

What a parameter's true value is depends on the law of the arm:

- *own law*: the arm is the model itself with the effect in it, at values that are drawn for each
  case. The true value is the one that was put in. The model that is amended has a deformed network,
  with a smooth error of known validated size that is drawn anew for each case.
- *the rig's law*: the virtual rig has a hidden effect whose equations differ. The true value is the
  pseudo-true one (White 1982): that which the model's effect takes without noise and without an
  error of the network on many recordings like those of the cases, i.e. fitted to what the hidden
  effect changes in the rig's noise-free key points. It depends on the motion: the law that fits
  five minutes of creep best is not the one that fits an hour. The amended model is the robot's own,
  so its network's error is real, and the same in all recordings of a robot.

Falls of the error are counted on clean arms, where an effect is missing in nothing: the amended
models' networks are off, as fitted or deformed. A fall that is claimed there is a false claim.
"""

from __future__ import annotations

import hashlib
import json
import math
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.stats import beta, binomtest

import surgisoft
from benchmarks.cache import digest
from benchmarks.diagnosis.robots import base_model, bent
from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.estimation.effects import fit_effects
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.errors import InputError
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.progress import Progress
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.effects import Effect, make_effect
from surgisoft.surrogate.model import ArmModel
from surgisoft.workers import workers

NOISE_MM = 0.0224
"""Standard deviation of a coordinate, as the virtual rig's cameras have it, mm."""
CORRELATED_MM, CORRELATED_S = 0.05, 4.0
"""Standard deviation and time constant of the noise that `correlated` adds, mm and s."""
TRUTH_RECORDINGS = 8
"""Recordings that the pseudo-true values are fitted to, each as long as that of a case."""
TRUTH_TAKE = 900_000
"""Trial of the first of them; no case has it."""
CLEAN_EFFECTS = (
    "payload",
    "gain_mismatch",
    "misalignment",
    "dead_zone",
    "coupling",
    "creep",
    "line_lag",
    "drift",
)
"""Effects that clean arms are amended by."""


@dataclass(frozen=True)
class Setting:
    """Cases that differ in recording, network and noise only."""

    name: str
    """Name in the table."""
    effect: str
    """Effect that is amended; `clean`: each of `CLEAN_EFFECTS` in turn on an arm without any."""
    law: str
    """`own`, or `rig`: whose equations the arm's effect has."""
    bent_mm: float
    """Validated error to which the network is deformed, mm; 0: the network as it was fitted."""
    noise: str = "white"
    """`white`, `loud` (threefold) or `correlated`."""
    rows: int = 3000
    """Rows of a recording at 20 Hz."""


SETTINGS = (
    Setting("payload, own law, threefold noise", "payload", "own", 0.25, "loud"),
    Setting("gain, own law, correlated noise", "gain_mismatch", "own", 0.2, "correlated"),
    Setting("misalignment, own law", "misalignment", "own", 0.2),
    Setting("creep, own law", "creep", "own", 0.2),
    Setting("line lag, own law", "line_lag", "own", 0.2),
    Setting("payload, the rig's law", "payload", "rig", 0.0),
    Setting("gain, the rig's law", "gain_mismatch", "rig", 0.0),
    Setting("clean arm, network as fitted", "clean", "rig", 0.0),
    Setting("clean arm, network deformed", "clean", "rig", 0.25),
)
"""All settings of the study."""


@dataclass(frozen=True)
class Case:
    """One recording and one amendment."""

    setting: Setting
    """The setting."""
    robot: int
    """Seed of the robot."""
    take: int
    """Number of the trial: schedule, noise, network and true values follow from it."""

    @property
    def effect(self) -> str:
        """Effect that is amended."""
        if self.setting.effect != "clean":
            return self.setting.effect
        return CLEAN_EFFECTS[self.take % len(CLEAN_EFFECTS)]


@dataclass(frozen=True)
class Covered:
    """One scalar quantity of a fitted effect."""

    name: str
    """Name, with the place in a vector."""
    value: float
    """Fitted value."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end of it."""
    true: float
    """The true value."""

    @property
    def holds(self) -> bool:
        """Whether the interval holds the true value."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Outcome:
    """Result of one amendment."""

    case: Case
    """The case."""
    quantities: tuple[Covered, ...]
    """Every quantity with a known true value; none on a clean arm."""
    claimed: bool
    """Whether a fall of the error is claimed for the effect."""
    fall_mm: float
    """Fall of the held-out error, mm."""
    p_value: float | None
    """Probability of so large an amplitude by the network's own error alone, where it is known."""


def cases(
    count: int, clean: int, robots: tuple[int, ...], settings: tuple[Setting, ...] = SETTINGS
) -> list[Case]:
    """`count` cases of every setting with an effect and `clean` of every one without.

    The robots alternate.
    """
    if not robots:
        raise InputError("intervals: no robots; expected at least one")
    return [
        Case(setting, robots[i % len(robots)], 1000 * number + i)
        for i in range(max(count, clean))
        for number, setting in enumerate(settings)
        if i < (clean if setting.effect == "clean" else count)
    ]


def run_case(case: Case, folder: Path) -> Outcome:
    """Record, amend, and compare with the truth."""
    torch.set_num_threads(1)
    base, setting = base_model(case.robot, folder), case.setting
    model = base
    arm = base if setting.law == "own" else None
    if arm is not None or setting.bent_mm > base.validation.rmse_mm:
        model = bent(base, case.robot, setting.bent_mm, case.take, arm)
    true: dict[str, np.ndarray] = {}
    if setting.law == "own":
        effect = drawn_effect(case.effect, base, case.take)
        recording = own_recording(case, base, effect)
        true = {q.name: np.ravel(q.value) for q in effect.quantities()}
    else:
        recording, _ = recorded(case.robot, hidden_of(setting), setting.rows, case.take)
        recording = noisy(case, recording)
        if setting.effect != "clean":
            true = pseudo_true(case.robot, case.effect, setting.rows, folder)
    found = amend(model, [recording], case.effect, refit="never")
    quantities = []
    for parameter in found.parameters:
        low, high, value = (np.ravel(v) for v in (parameter.low, parameter.high, parameter.value))
        for i, truth in enumerate(true.get(parameter.name, ())):
            if low[i] < high[i]:
                name = f"{parameter.name}[{i}]" if len(value) > 1 else parameter.name
                numbers = (float(each[i]) for each in (value, low, high))
                quantities.append(Covered(name, *numbers, float(truth)))
    alone = found.alone
    return Outcome(case, tuple(quantities), found.claimed, alone.fall, alone.p_value)


def hidden_of(setting: Setting) -> tuple[tuple[str, float], ...]:
    """What the rig hides in a setting."""
    return () if setting.effect == "clean" else ((setting.effect, 1.0),)


def recorded(robot: int, hidden, rows: int, take: int):
    """A recording of the virtual rig with `mixed` motion, and its truth."""
    rig = VirtualRig(robot, take=take, hidden=hidden)
    return rig.record(make_protocol("mixed", rig.limits, rows, seed=take))


def noisy(case: Case, recording: Recording) -> Recording:
    """The recording with the noise that a setting adds."""
    if case.setting.noise == "white":
        return recording
    rng = np.random.default_rng([case.take, 1])
    shape = recording.key_points_mm.shape
    if case.setting.noise == "loud":
        size = NOISE_MM * math.sqrt(8.0)
        more = rng.normal(0.0, size, shape)
    else:
        size, keep = CORRELATED_MM, math.exp(-0.05 / CORRELATED_S)
        drive, more = rng.normal(0.0, size * math.sqrt(1.0 - keep**2), shape), np.zeros(shape)
        more[0] = rng.normal(0.0, size, shape[1:])
        for t in range(1, len(more)):
            more[t] = keep * more[t - 1] + drive[t]
    noise = recording.noise_mm
    return replace(
        recording,
        key_points_mm=recording.key_points_mm + more,
        noise_mm=None if noise is None else math.hypot(noise, size),
    )


@torch.no_grad()
def drawn_effect(name: str, base: ArmModel, seed: int) -> Effect:
    """The named effect at values drawn from a seed, each within its plausible range.

    Nonlinear parameters that recordings hardly show are drawn, too: a prior holds those near its
    centre, and an interval of such a one holds 95 % of the true values on average over the prior
    (Rubin 1984; Cook, Gelman & Rubin 2006), and more of those at its centre.
    """
    rng = np.random.default_rng([seed, 2])
    facts = base.facts

    def log_uniform(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    if name == "payload":
        effect = make_effect(name, facts)
        down = len(effect.tip_sag)
        effect.tip_sag.copy_(torch.tensor(rng.uniform(0.5, 3.0, down)))
        effect.body_sag.copy_(torch.tensor(rng.uniform(0.0, 1.0, down)))
    elif name == "gain_mismatch":
        effect = make_effect(name, facts)
        effect.gain.copy_(torch.tensor(rng.normal(0.0, 0.05, effect.gain.shape)))
    elif name == "misalignment":
        effect = make_effect(name, facts)
        effect.turn.copy_(torch.tensor(rng.normal(0.0, 0.01, effect.turn.shape)))
        effect.shift.copy_(torch.tensor(rng.normal(0.0, 0.4, effect.shift.shape)))
        effect.scale.copy_(torch.tensor(rng.normal(0.0, 0.01, effect.scale.shape)))
    elif name == "dead_zone":
        effect = make_effect(name, facts, width=log_uniform(0.05, 0.25))
        effect.threshold.copy_(torch.tensor(rng.uniform(0.02, 0.06, effect.threshold.shape)))
    elif name == "creep":
        effect = make_effect(
            name,
            facts,
            tau_s=log_uniform(4.0, 30.0),
            width=log_uniform(0.3, 4.5),
            power=log_uniform(0.5, 2.0),
        )
        effect.amount.copy_(torch.tensor(rng.uniform(0.04, 0.12, effect.amount.shape)))
    elif name == "line_lag":
        up = log_uniform(0.15, 0.5)
        effect = make_effect(name, facts, up_s=up, down_s=log_uniform(1.0, 2.0) * up)
        effect.share.fill_(1.0)
    else:
        raise InputError(f"intervals: no values to draw for '{name}'")
    return effect


def own_recording(case: Case, base: ArmModel, effect: Effect) -> Recording:
    """A recording of the arm that is the base model with the effect, at the rig's pressures."""
    recording, _ = recorded(case.robot, (), case.setting.rows, case.take)
    arm = base.replace(effects={**base.effects, case.effect: effect})
    history = history_of([recording], base.spec.actuation)
    with torch.no_grad():
        points = history.rows(arm.predict(history)).double().numpy()
    noise = np.random.default_rng([case.take, 3]).normal(0.0, NOISE_MM, points.shape)
    return noisy(case, replace(recording, key_points_mm=points + noise, noise_mm=NOISE_MM))


def pseudo_true(robot: int, effect: str, rows: int, folder: Path) -> dict[str, np.ndarray]:
    """Quantity -> values that the model's effect takes for the rig's, without noise or network.

    The base model's own prediction takes the place of the clean rig's key points, and what the
    hidden effect changes in the rig's noise-free ones is added to it.
    """
    about = {"robot": robot, "effect": effect, "rows": rows, "recordings": TRUTH_RECORDINGS}
    file = folder / f"pseudo-true-{digest(about)}.json"
    if file.is_file():
        return {name: np.array(value) for name, value in json.loads(file.read_text()).items()}
    base = base_model(robot, folder)
    exact = []
    for take in range(TRUTH_TAKE, TRUTH_TAKE + TRUTH_RECORDINGS):
        recording, shown = recorded(robot, ((effect, 1.0),), rows, take)
        _, plain = recorded(robot, (), rows, take)
        history = history_of([recording], base.spec.actuation)
        with torch.no_grad():
            points = history.rows(base.predict(history)).double().numpy()
        points += shown.noise_free_mm - plain.noise_free_mm
        exact.append(replace(recording, key_points_mm=points, noise_mm=1e-3))
    fitted = fit_effects(problem_of(base, exact), [effect])
    found = {p.name: np.ravel(p.value).tolist() for p in fitted.parameters}
    file.write_text(json.dumps(found))
    return {name: np.array(value) for name, value in found.items()}


def run(some: list[Case], folder: Path, processes: int, report: Progress) -> list[Outcome]:
    """All outcomes, base models and pseudo-true values first.

    Outcomes are stored in the folder, so that an interrupted study continues.
    """
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"outcomes-{fingerprint()}.jsonl"
    answer = {case: outcome for case, outcome in read_outcomes(log).items() if case in set(some)}
    robots = sorted({case.robot for case in some})
    truths = sorted(
        {
            (case.robot, case.effect, case.setting.rows)
            for case in some
            if case.setting.law == "rig" and case.setting.effect != "clean"
        }
    )
    left = [case for case in some if case not in answer]
    total, done = len(robots) + len(truths) + len(left), 0
    with workers(processes) as pool:
        for jobs, note in (
            ([(base_model, robot, folder) for robot in robots], "base models"),
            ([(pseudo_true, *truth, folder) for truth in truths], "pseudo-true values"),
            ([(run_case, case, folder) for case in left], "amendments"),
        ):
            for future in as_completed([pool.submit(*job) for job in jobs]):
                result = future.result()
                if isinstance(result, Outcome):
                    answer[result.case] = result
                    with log.open("a") as file:
                        file.write(json.dumps(asdict(result)) + "\n")
                done += 1
                report(done, total, note)
    return [answer[case] for case in some]


def fingerprint() -> str:
    """Hash of the code that the outcomes depend on."""
    package = Path(surgisoft.__file__).parent
    found = hashlib.sha256(Path(__file__).read_bytes().split(b"def coverage(")[0])
    for folder in ("diagnosis/estimation", "surrogate/effects", "rig"):
        for path in sorted((package / folder).rglob("*.py")):
            found.update(path.read_bytes())
    return found.hexdigest()[:12]


def read_outcomes(log: Path) -> dict[Case, Outcome]:
    """Stored outcomes; an incomplete last line is left out."""
    found = {}
    for line in log.read_text().splitlines() if log.is_file() else []:
        try:
            values = json.loads(line)
        except json.JSONDecodeError:
            continue
        about = values.pop("case")
        case = Case(setting=Setting(**about.pop("setting")), **about)
        quantities = tuple(Covered(**each) for each in values.pop("quantities"))
        found[case] = Outcome(case=case, quantities=quantities, **values)
    return found


def coverage(outcomes: list[Outcome]) -> tuple[int, int]:
    """(intervals that hold the true value, intervals)."""
    holds = [each.holds for outcome in outcomes for each in outcome.quantities]
    return sum(holds), len(holds)


def coverage_interval(outcomes: list[Outcome]) -> tuple[float, float]:
    """95 % interval of the share of intervals that hold (Korn & Graubard 1998).

    Quantities that err together are one cluster: those of one recording, and, where the network is
    the robot's own, those of all recordings of a robot, because its error is the same in all of
    them. The variance between clusters says how many independent values the share has, and the
    interval of a binomial share (Clopper & Pearson 1934) is taken for that number. Where every
    interval holds, or none does, the clusters show no variance, and their number is taken.
    """
    clusters: dict[object, list[Outcome]] = {}
    for number, outcome in enumerate(outcomes):
        setting = outcome.case.setting
        own_network = setting.law == "rig" and not setting.bent_mm
        key = (setting.name, outcome.case.robot) if own_network else number
        clusters.setdefault(key, []).append(outcome)
    good, count = np.array([coverage(some) for some in clusters.values()], float).T
    share, number = good.sum() / count.sum(), len(clusters)
    values = float(number)
    if 0.0 < share < 1.0 and number > 1:
        spread = number / (number - 1) * np.square(good - share * count).sum() / count.sum() ** 2
        values = float(np.clip(share * (1.0 - share) / max(spread, 1e-12), number, count.sum()))
    hold = share * values
    low = beta.ppf(0.025, hold, values - hold + 1.0) if share > 0.0 else 0.0
    high = beta.ppf(0.975, hold + 1.0, values - hold) if share < 1.0 else 1.0
    return float(low), float(high)


def markdown(outcomes: list[Outcome]) -> str:
    """The tables of the study."""
    lines = [
        "## Coverage of the 95 % intervals",
        "",
        "| setting | recordings | intervals that hold the true value | 95 % of that |",
        "|---|---|---|---|",
    ]
    by_setting: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        by_setting.setdefault(outcome.case.setting.name, []).append(outcome)
    known = {name: some for name, some in by_setting.items() if coverage(some)[1]}
    everything = [outcome for some in known.values() for outcome in some]
    for name, some in [*known.items(), ("all", everything)] if known else ():
        good, count = coverage(some)
        low, high = coverage_interval(some)
        lines.append(
            f"| {name} | {len(some)} | {good / count:.1%} ({good} of {count}) | "
            f"{low:.0%} to {high:.0%} |"
        )
    lines += [
        "",
        "## Errors beside the intervals",
        "",
        "RMS error of a quantity, and the standard deviation that its interval states (median of "
        "the half widths over 1.96). Where they are equal, the interval is as wide as it has to "
        "be.",
        "",
        "| setting | quantity | RMS error | stated | RMS error over stated |",
        "|---|---|---|---|---|",
    ]
    for name, some in known.items():
        by_name: dict[str, list[Covered]] = {}
        for outcome in some:
            for quantity in outcome.quantities:
                by_name.setdefault(quantity.name, []).append(quantity)
        for quantity_name, found in by_name.items():
            error = math.sqrt(np.mean([(each.value - each.true) ** 2 for each in found]))
            stated = np.median([each.high - each.low for each in found]) / 2.0 / 1.96
            ratio = f"{error / stated:.2f}"
            lines.append(f"| {name} | `{quantity_name}` | {error:.3g} | {stated:.3g} | {ratio} |")
    lines += [
        "",
        "## Falls that are claimed",
        "",
        "| setting | recordings | a fall is claimed for the effect |",
        "|---|---|---|",
    ]
    for name, some in by_setting.items():
        lines.append(f"| {name} | {len(some)} | {_rate([o.claimed for o in some])} |")
    return "\n".join(lines) + "\n"


def _rate(values: list[bool]) -> str:
    found = binomtest(sum(values), len(values)).proportion_ci(0.95, "wilson")
    share = sum(values) / len(values)
    return f"{share:.1%} ({sum(values)} of {len(values)}; {found.low:.0%} to {found.high:.0%})"
