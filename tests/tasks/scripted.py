"""Episodes of the scripted expert, for the tests of tasks."""

from dataclasses import replace

import torch

from surgisoft.tasks.base import Episodes, Outcome, Task, TaskState


def scripted_states(
    task: Task, count: int = 2, most: int = 300
) -> tuple[list[TaskState], list[Outcome]]:
    """States and outcomes of `count` episodes, from seed 0 to the end of the longest one.

    most: steps after which they end in any case.
    """
    episodes = Episodes(task)
    states, outcomes = [episodes.seeded(0, count)], []
    with torch.inference_mode():
        over = torch.zeros(count, dtype=torch.bool)
        while not over.all() and len(outcomes) < most:
            state, outcome = episodes.step(states[-1], task.script(states[-1]))
            states.append(state)
            outcomes.append(outcome)
            over |= outcome.done
    return states, outcomes


def with_gap(state: TaskState, episode: int) -> TaskState:
    """The state with the first station of an episode's path uncut, whatever was cut of it."""
    scene = state.world.scene
    peak = scene.dose.peak.clone()
    peak[episode, 0] = 0.0
    dose = replace(scene.dose, peak=peak)
    return replace(state, world=replace(state.world, scene=replace(scene, dose=dose)))
