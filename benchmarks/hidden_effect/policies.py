"""Policies trained on a model and evaluated on the rig with a hidden effect."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.cache import Cache, model_digest
from benchmarks.control.policies import cost, evaluated, plan_of, trained
from surgisoft.agents.on_rig import RigConfig
from surgisoft.config import to_table
from surgisoft.progress import Stages
from surgisoft.tasks.registry import with_fields

TASK = "track_circle"
"""Task of the policies."""
SIGHTS = ("blind", "cameras")
"""Without the cameras' key points, where the model alone estimates the body, and with them."""
TRAIN, PLAY = 100, 8
"""Weights of a training and of a policy's episodes in the progress."""


@dataclass(frozen=True)
class PolicyEvaluation:
    """How policies are trained, and the rig on which they are evaluated."""

    kept: Cache
    """Folder of policies and results."""
    robot_seed: int
    """Seed of the virtual robot."""
    hidden: tuple[tuple[str, float], ...]
    """Hidden effects of the rig and their amplitudes."""
    steps: int
    """Training steps of each policy."""
    seed: int
    """Seed of the training and of the episodes."""
    episodes: int
    """Episodes of each policy."""

    def on_model(
        self, title: str, arm: Path, meter: Stages, names: tuple[str, ...]
    ) -> tuple[dict[str, dict], dict]:
        """Policies that know the arm by the model in a folder: NAME/SIGHT -> fields of `Summary` of
        the episodes' mean errors [mm], and the `Cost` of the policy.

        names: of `learned`, `scripted`, `random`.
        """
        plan = plan_of(TASK, self.seed, self.steps, arm)
        inputs = _inputs(plan, arm)
        tell = meter.stage(TRAIN, f"{title}: policy")
        run = trained(self.kept.place(f"policies/{TASK}", inputs), plan, tell)
        found = {}
        for sight in SIGHTS:
            rig = RigConfig(self.robot_seed, self.hidden, cameras=sight == "cameras")
            for name in names:
                policy = str(run.path) if name == "learned" else name
                tell = meter.stage(PLAY, f"{title}: {name} on the rig, {sight}")
                found[f"{name}/{sight}"] = self._evaluated(
                    f"{title.split(',')[0]}-{name}", policy, inputs, arm, rig, tell
                )
        return found, asdict(cost(run))

    def _evaluated(
        self, name: str, policy: str, inputs: dict, arm: Path, rig: RigConfig, tell
    ) -> dict:
        """Summary of the mean error of each episode on the rig, mm."""
        about = {
            "plan": inputs,
            "learned": policy not in ("scripted", "random"),
            "rig": to_table(rig),
            "episodes": self.episodes,
            "seed": self.seed,
        }
        return self.kept.values(
            f"driven/{name}",
            about,
            lambda: evaluated(TASK, policy, self.episodes, self.seed, rig, arm, tell)[
                "error_mean_mm"
            ],
        )


def _inputs(plan, arm: Path) -> dict:
    """The inputs of a policy, for the cache; the arm by its content, not by its path."""
    return {
        "task": plan.task,
        "config": to_table(with_fields(plan.task_config, arm=model_digest(arm))),
        "hyper_parameters": asdict(plan.preset),
        "steps": plan.steps,
        "seed": plan.seed,
    }
