"""Benchmark `hidden-effect`: diagnosis, amended model and retrained policy on a rig.

For every effect: (1) a policy is trained on the model without it and evaluated on the rig with it;
(2) the model is compared with recordings of that rig and diagnosed, with a further experiment where
two effects cannot be distinguished, and amended by the named effects, right or wrong; (3) a policy
is trained on the amended model and evaluated on the same rig. The comparison includes an oracle
that is given the effect's name. A separate recording validates all models.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.cache import Cache, model_digest
from benchmarks.hidden_effect.policies import PLAY, TRAIN, PolicyEvaluation
from benchmarks.hidden_effect.rates import by_rate
from benchmarks.hidden_effect.rigs import Bench
from surgisoft.diagnosis.amend import amend, fall_of
from surgisoft.diagnosis.design.next_experiment import recommend
from surgisoft.diagnosis.design.schedules import on_the_rig
from surgisoft.diagnosis.diagnose import MOST_RIVALS, diagnose
from surgisoft.diagnosis.improve import next_effects
from surgisoft.diagnosis.residuals import EVERY_ROW, problem_of
from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.histories import arm_spec, history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.progress import Progress, Stages
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.fit import FitConfig, fit

DEFAULT_ROBOT = 0
"""Seed of the robot that the default arm model was fitted to."""
ORACLE_TAKES = 3
"""Number of recordings for the oracle; the diagnosis has one."""
TAKE, JUDGING_TAKE, FURTHER_TAKE, PACED_TAKE = 1, 9, 20, 33
"""Trial numbers of the recordings: diagnosis, validation, next experiment, circles."""
MODELS = ("before", "after", "oracle")
"""The model without the effect, the one amended by the diagnosis, and the oracle."""
LASTING = ("learned", "scripted")
"""Policies that are trained on, or use, an arm model."""
STAGES = 3 * 15 + 3 * TRAIN + 14 * PLAY
"""Weight of one effect in the progress."""


@dataclass(frozen=True)
class Case:
    """One effect that a model lacks."""

    effect: str
    """Name of the effect in the model's list."""
    hidden: bool
    """Whether it is switched on in the rig after the model was fitted; else the arm has it anyway
    and the model is one that leaves it out."""


CASES: dict[str, Case] = {
    "creep": Case("creep", True),
    "line_lag": Case("line_lag", True),
    "payload": Case("payload", True),
    "hysteresis": Case("hysteresis", False),
}
"""Every effect of the study. Hysteresis is the friction that every arm of the rig has: the model
without it is HAW-NN that sees pressure alone, and its oracle is fitted with the effect from the
start."""


@dataclass(frozen=True)
class StudyConfig:
    """Size of the study."""

    robot_seed: int = DEFAULT_ROBOT
    """Seed of the robot."""
    strength: float = 1.0
    """Amplitude of the hidden effects; 1 moves the tip by about 1 mm."""
    steps: int = 1_000_000
    """Training steps of each policy."""
    seed: int = 0
    """Seed of the training and of the episodes."""
    episodes: int = 10
    """Episodes of each policy on the rig."""
    samples: int = 12000
    """Samples of a recording, at 20 Hz."""
    grid_points: int = 13824
    """Number of steady-state samples for fitting a model, where that is needed."""

    def __post_init__(self):
        if not 0.0 < self.strength <= 10.0:
            raise InputError(f"strength is {self.strength}, expected more than 0, at most 10")
        if self.episodes < 2:
            raise InputError(f"episodes is {self.episodes}, expected 2 or more for their interval")


@dataclass(frozen=True)
class Outcome:
    """Results for one effect; errors in mm."""

    case: str
    """Name of the effect."""
    verdicts: tuple[dict, ...]
    """Output of `diagnose --json`; a second one after a further experiment."""
    experiment: dict | None
    """Output of `next-experiment --json` for the further experiment."""
    amended: tuple[str, ...]
    """Effects that were added; none where no fall was claimed."""
    parameters: tuple[dict, ...]
    """Parameters of those effects."""
    claim: str
    """Sentence of `amend`."""
    model_mm: dict[str, float]
    """RMS distance of a key point on the validation recording: before, after, oracle, floor."""
    falls: dict[str, dict]
    """after, oracle -> `Fall` from before."""
    rates: tuple[dict, ...]
    """The models by the rate of the actuation, see `by_rate`."""
    paced: dict | None
    """Where policies got worse: the results of amending on circles at the task's pace instead."""
    driven: dict[str, dict]
    """MODEL/POLICY/SIGHT -> fields of `Summary` of the episodes' mean errors, mm."""
    training: dict[str, dict]
    """MODEL -> `Cost` of its policy."""


class Study:
    """The study of one robot; a folder stores models, recordings, policies and results."""

    def __init__(self, config: StudyConfig, folder: Path):
        self.config, self.kept = config, Cache(folder)

    def run(self, name: str, meter: Stages) -> Outcome:
        """Results of one effect; computes what the folder lacks."""
        case, config = CASES[name], self.config
        hidden = ((case.effect, config.strength),) if case.hidden else ()
        before = self.base(case.hidden, meter.stage(15, f"{name}: base model"))
        bench = Bench(self.kept, config.robot_seed, hidden, config.samples)
        tell = meter.stage(15, f"{name}: recording and diagnosis")
        seen = bench.mixed(TAKE, tell)
        found = self._diagnosed(name, before, bench, seen)
        after = self._amended(name, before, found, bench, seen)
        tell = meter.stage(15, f"{name}: oracle")
        oracle = self._oracle(case, before, bench, tell)
        models = {"before": before, "after": after["model"] or before, "oracle": oracle}
        judged = self._judged(name, models, bench)
        about = {key: model_digest(folder) for key, folder in models.items()} | bench.about
        rates = self.kept.values(
            f"rates/{name}", about, lambda: by_rate(models, bench.mixed(JUDGING_TAKE))
        )
        policies = PolicyEvaluation(
            self.kept, config.robot_seed, hidden, config.steps, config.seed, config.episodes
        )
        driven, training = self._driven(name, models, policies, meter)
        paced = None
        if worse(driven):
            paced = self._paced(name, before, found["effects"], bench, policies, meter)
        return Outcome(
            case=name,
            verdicts=tuple(found["verdicts"]),
            experiment=found["experiment"],
            amended=tuple(found["effects"] if after["model"] else ()),
            parameters=tuple(after["parameters"]),
            claim=after["claim"],
            rates=tuple(rates),
            paced=paced,
            driven=driven,
            training=training,
            **judged,
        )

    def base(self, memory: bool, report: Progress) -> Path:
        """A model of the robot without hidden effects: with hysteresis, or from pressure alone."""
        config = self.config
        about = {"robot_seed": config.robot_seed, "memory": memory, "points": config.grid_points}
        name = "models/base" if memory else "models/pressure-only"
        if memory and config.robot_seed == DEFAULT_ROBOT:
            return self._model("models/default", {}, lambda: (default_arm(), None))

        def make():
            rig = VirtualRig(config.robot_seed)
            seed, wanted = config.robot_seed, {"grid": config.grid_points, "validation": None}
            train, valid = (
                rig.record(make_protocol(key, rig.limits, points, seed=seed))[0]
                for key, points in wanted.items()
            )
            how = FitConfig(
                inputs="pressure+direction" if memory else "pressure",
                effects=("hysteresis",) if memory else (),
                prior="none",  # the paper's network
            )
            result = fit(
                history_of([train]),
                history_of([valid]),
                arm_spec([train]),
                how,
                lambda stage, epoch, of, loss: report(epoch, of, stage),
            )
            return result.model, result.report()

        return self._model(name, about, make)

    def _model(self, name: str, about: dict, make: Callable) -> Path:
        """The folder of a model, made unless it is there; `make`: (model, its report)."""
        folder = self.kept.place(name, about)
        if not (folder / "config.json").is_file():
            model, report = make()
            save_model(model, folder, report)
        return folder

    def _diagnosed(self, name: str, before: Path, bench: Bench, seen: Recording) -> dict:
        """Verdicts, the experiment between them, and the effects that are named in the end."""
        about = {"model": model_digest(before), **bench.about}

        def make() -> dict:
            model = load_model(before)
            found = [diagnose(model, [seen])]
            plan = None
            if found[0].verdict.kind == "ambiguous":
                rivals = found[0].verdict.effects[:MOST_RIVALS]
                asked = recommend(problem_of(model, [seen]), rivals, settings=on_the_rig())
                more = bench.record(asked.protocol, FURTHER_TAKE, asked.setting)
                found.append(diagnose(model, [seen, more]))
                plan = asked.to_json()
            return {
                "verdicts": [each.to_json() for each in found],
                "experiment": plan,
                "effects": list(next_effects(found[-1])),
            }

        return self.kept.values(f"diagnoses/{name}", about, make)

    def _amended(self, name: str, before: Path, found: dict, bench: Bench, seen) -> dict:
        """The amended model's folder (None: nothing is claimed), its parameters, the claim."""
        effects = found["effects"]
        if not effects:
            return {"model": None, "parameters": [], "claim": "no effect was named"}
        about = {"model": model_digest(before), "effects": effects, **bench.about}
        folder = self.kept.place(f"models/{name}-amended", about)

        def make() -> dict:
            result = amend(load_model(before), [seen], effects)
            if result.held_out.claimed:
                save_model(result.model, folder, result.to_json(), force=True)
            return result.to_json()

        amended = self.kept.values(f"amendments/{name}", about, make)
        return {
            "model": folder if amended["claimed"] else None,
            "parameters": amended["parameters"],
            "claim": amended["sentence"],
        }

    def _oracle(self, case: Case, before: Path, bench: Bench, report: Progress) -> Path:
        """A model that is given the effect's name: amended on more data, or fitted with it."""
        if not case.hidden:
            return self.base(True, report)
        about = {"model": model_digest(before), "told": case.effect, **bench.about}
        about["takes"] = ORACLE_TAKES

        def make():
            some = [bench.mixed(TAKE + k, report) for k in range(ORACLE_TAKES)]
            result = amend(load_model(before), some, [case.effect])
            return result.model, result.to_json()

        return self._model(f"models/{case.effect}-oracle", about, make)

    def _judged(self, name: str, models: dict[str, Path], bench: Bench) -> dict:
        """The models' errors on a recording that none of them was fitted to."""
        about = {key: model_digest(folder) for key, folder in models.items()}
        about |= bench.about

        def make() -> dict:
            test = bench.mixed(JUDGING_TAKE)
            first = problem_of(load_model(models["before"]), [test], EVERY_ROW, part="all")
            falls = {
                key: fall_of(first, first.with_model(load_model(models[key])))
                for key in ("after", "oracle")
            }
            return {
                "model_mm": {
                    "before": falls["oracle"].before,
                    "after": falls["after"].after,
                    "oracle": falls["oracle"].after,
                    "floor": falls["oracle"].floor,
                },
                "falls": {key: asdict(fall) for key, fall in falls.items()},
            }

        return self.kept.values(f"errors/{name}", about, make)

    def _driven(
        self, name: str, models: dict[str, Path], policies: PolicyEvaluation, meter: Stages
    ):
        """MODEL/POLICY/SIGHT -> summary, MODEL -> cost of its policy."""
        driven, training = {}, {}
        for key, arm in models.items():
            names = ("learned", "scripted", "random") if key == "before" else LASTING
            found, training[key] = policies.on_model(f"{name}, model {key}", arm, meter, names)
            driven |= {f"{key}/{which}": summary for which, summary in found.items()}
        return driven, training

    def _paced(
        self, name: str, before: Path, effects, bench: Bench, policies: PolicyEvaluation, meter
    ):
        """Results of amending by the same effects on circles at the task's pace, where needed."""
        about = {"model": model_digest(before), "effects": effects, **bench.about, "paced": True}
        folder = self.kept.place(f"models/{name}-paced", about)
        seen = bench.circles(PACED_TAKE)

        def make() -> dict:
            result = amend(load_model(before), [seen], effects)
            save_model(result.model, folder, result.to_json(), force=True)
            first = problem_of(
                load_model(before), [bench.mixed(JUDGING_TAKE)], EVERY_ROW, part="all"
            )
            return result.to_json() | {
                "mixed_mm": fall_of(first, first.with_model(result.model)).after
            }

        amended = self.kept.values(f"amendments/{name}-paced", about, make)
        beside = Stages(lambda done, total, note: meter.stage(0, note), 1.0)
        found, _ = policies.on_model(f"{name}, model paced", folder, beside, LASTING)
        return {
            "claim": amended["sentence"],
            "parameters": amended["parameters"],
            "mixed_mm": amended["mixed_mm"],
            "driven": found,
        }


def worse(driven: dict[str, dict]) -> bool:
    """Whether the scripted expert is significantly worse on the amended model, cameras off."""
    before, after = (driven[f"{key}/scripted/blind"] for key in ("before", "after"))
    return after["low"] > before["high"]


def run(names: list[str], config: StudyConfig, folder: Path, report: Progress) -> list[Outcome]:
    """Run the named effects one after the other; existing results in the folder are reused."""
    for name in names:
        if name not in CASES:
            raise unknown_name("effect of this study", name, CASES)
    study, meter = Study(config, folder), Stages(report, STAGES * max(len(names), 1))
    return [study.run(name, meter) for name in names]
