"""Trained policies, opened from a run's folder or taken from a running training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surgisoft.agents.actor import Actor, ScaledActor
from surgisoft.agents.presets import Preset
from surgisoft.agents.run_folder import BEST, LAST, RunFolder, damaged
from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.base import Episodes, Task, TaskState


class ActorPolicy:
    """A `Policy` of one trained actor for each agent, without exploration noise."""

    def __init__(self, actors: Mapping[str, ScaledActor]):
        self.actors = dict(actors)

    @torch.inference_mode()
    def act(
        self, task: Task, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Each actor's action from its agent's observation alone; not privileged."""
        return {agent: self.actors[agent](observations[agent]) for agent in task.agents}


class LearnedPolicy(ActorPolicy):
    """The policies in a training run's folder."""

    def __init__(self, folder: str | Path, task: Task | None = None, which: str | None = None):
        """Open a checkpoint: which is `best` (by evaluation) or `last`; None: `best` if there is
        one.

        task: where the policies will act; it must have the agents, observations and actions of the
        task that they were trained on.
        """
        if which not in (None, BEST, LAST):
            raise unknown_name("checkpoint", which, (BEST, LAST))
        self.run = RunFolder(folder)
        which = self.run.chosen if which is None else which
        device = task.world.device if task else "cpu"
        saved, plan = self.run.load(which, device), self.run.plan()
        file, actors = self.run.checkpoint(which), {}
        with damaged(file):
            self.which, self.iteration = which, int(saved["iteration"])
            for agent, size in self.run.agents.items():
                weights = saved["agents"][agent]
                weights = weights if which == BEST else weights["actor_state_dict"]
                sizes = size["observation"], size["chambers"]
                check_weights(file, agent, weights, *sizes, plan.preset)
                actor = Actor(*sizes, plan.preset)
                actor.load_state_dict(weights)
                scaled = ScaledActor(actor, plan.preset.action_kPa, size["step_kPa"])
                actors[agent] = scaled.to(device).eval().requires_grad_(False)
        super().__init__(actors)
        if task is not None:
            check_fits(self.run, task)

    @torch.inference_mode()
    def actions(self, observations: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Actions for the observations of environments: agent -> (m,) or (B, m) float32, kPa.

        observations: agent -> (D,) or (B, D), as `parallel_env` gives them. Raises InputError for
        an agent that was not trained, and for another width.
        """
        found = {}
        for agent, given in observations.items():
            if agent not in self.actors:
                raise unknown_name("agent", agent, self.actors)
            actor, seen = self.actors[agent], np.asarray(given, np.float32)
            width = self.run.agents[agent]["observation"]
            if seen.shape[-1:] != (width,):
                raise InputError(
                    f"observation of '{agent}' has shape {seen.shape}, expected ({width},) or "
                    f"(B, {width})"
                )
            device = next(actor.parameters()).device
            rows = torch.from_numpy(seen.reshape(-1, width)).to(device)
            found[agent] = actor(rows).cpu().numpy().reshape(*seen.shape[:-1], -1)
        return found


def check_weights(
    file: Path, agent: str, weights: Mapping[str, Tensor], width: int, chambers: int, preset: Preset
) -> None:
    """Raise InputError unless an actor's weights are finite and of the shapes that the run states.

    The actor is laid out without memory for its numbers, so that a false size costs nothing.
    """
    with torch.device("meta"):
        expected = Actor(width, chambers, preset).state_dict()
    for name, value in expected.items():
        shape = list(weights[name].shape) if name in weights else "no"
        if shape != list(value.shape):
            raise InputError(
                f"{file}: '{name}' of '{agent}' has {shape} numbers, expected {list(value.shape)} "
                "by config.json; train it again"
            )
        if not weights[name].isfinite().all():
            raise InputError(
                f"{file}: '{name}' of '{agent}' has numbers that are NaN or infinite; train it "
                "again, or use another checkpoint"
            )


def agent_sizes(task: Task) -> dict[str, dict]:
    """agent -> `observation` (its width), `chambers` and `step_kPa` of a task."""
    with torch.inference_mode():
        play = Episodes(task)
        seen = play.observe(play.seeded(0, 1))
    return {
        agent: {
            "observation": seen[agent].shape[1],
            "chambers": task.world.arms[agent].chambers,
            "step_kPa": task.world.arms[agent].pneumatics.step_kPa,
        }
        for agent in task.agents
    }


def check_fits(run: RunFolder, task: Task) -> None:
    """Raise an InputError unless agents, observations and actions are those of the run."""
    sizes, place = agent_sizes(task), f"{run.path} was trained on {run.config['task']}"
    if list(sizes) != list(run.agents):
        raise InputError(
            f"{place} with agents {', '.join(run.agents)}; task '{task.name}' has "
            f"{', '.join(sizes)}"
        )
    for agent, size in sizes.items():
        if size != run.agents[agent]:
            raise InputError(
                f"{place}, where '{agent}' has {_words(run.agents[agent])}; in task "
                f"'{task.name}' as given here it has {_words(size)}"
            )


def _words(size: dict) -> str:
    return (
        f"{size['observation']} observations, {size['chambers']} chambers and steps of "
        f"{size['step_kPa']} kPa"
    )
