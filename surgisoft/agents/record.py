"""The log of a rollout's first episode."""

from __future__ import annotations

from surgisoft.agents.rollout import Instant
from surgisoft.tasks.base import Task
from surgisoft.tasks.episode import EpisodeLog, EpisodeRecorder


class FirstEpisode:
    """Watches a rollout, see `rollout(watch=...)`, and records its episode 0."""

    def __init__(self, task: Task, driver: str, seed: int, on: str = "simulation"):
        """driver, seed, on: what the log shall say of where it comes from."""
        self.task, self._about = task, {"driver": driver, "seed": seed, "on": on}
        self._recorder: EpisodeRecorder | None = None

    def __call__(self, now: Instant) -> None:
        """Keep what an instant holds of episode 0."""
        row = (now.live & (now.episodes == 0)).nonzero()[:, 0].tolist()
        if not row:
            return
        if now.outcome is None:
            self._recorder = EpisodeRecorder(self.task, now.state, row[0], episode=0, **self._about)
        else:
            self._recorder.step(now.state, now.outcome, now.actions, row[0])

    def log(self) -> EpisodeLog:
        """The episode, after the rollout."""
        return self._recorder.log()
