"""Make a task's environment by its name: Gymnasium for one agent, PettingZoo for several."""

from __future__ import annotations

from typing import Any

from surgisoft.tasks.parallel import SurgicalEnv, parallel_env
from surgisoft.tasks.single import SingleEnv


def make(task: str, **options: Any) -> SingleEnv | SurgicalEnv:
    """The named task as an environment.

    A task of one agent becomes a `gymnasium.Env`, a task of several a PettingZoo `ParallelEnv`.
    Actions (m,) are changes of the commanded pressure, kPa; observations (D,) are scaled to the
    order of 1. Raises InputError for an unknown task or option.

    options: those of `parallel_env`: `config`, `device`, `scene`, `arm`, `geometry`,
    `render_mode`.
    """
    env = parallel_env(task, **options)
    return (
        SingleEnv(env.task, render_mode=env.render_mode) if len(env.possible_agents) == 1 else env
    )
