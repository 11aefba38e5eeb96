"""Amendments in the diagnosis benchmark: how far the error falls beside what could be reached.

The oracle knows the effect's own form and size: the base model's error on the same robot, schedule
and noise with nothing hidden, its network re-tuned to that where `amend` would. All errors are of
the locked quarter, as `amend` judges.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.diagnosis.robots import Recorded
from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.estimation.network import retune
from surgisoft.diagnosis.residuals import EVERY_ROW, problem_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.model import ArmModel


@dataclass(frozen=True)
class Amended:
    """What amending by the diagnosed effects was worth; RMS errors on the locked quarter."""

    effects: tuple[str, ...]
    """The effects that were put in; none where the diagnosis named none."""
    before: float
    """Of the model as it was, mm."""
    after: float
    """Of the model that `amend` leaves: the old one where no fall is claimed, mm."""
    oracle: float
    """Of the model on a robot with nothing hidden, its network re-tuned where that pays, mm."""

    @property
    def share(self) -> float:
        """The fall as a share of the oracle's."""
        return (self.before - self.after) / (self.before - self.oracle)


def amended(model: ArmModel, recorded: Recorded, effects: tuple[str, ...]) -> Amended:
    """Amend a model by effects and compare with the oracle."""
    before = after = locked_error(model, recorded.recording)
    if effects:
        found = amend(model, [recorded.recording], list(effects))
        fall = found.held_out
        before, after = fall.before, fall.after if found.claimed else fall.before
    plain = recorded.plain
    oracle = retune(model, problem_of(model, [plain], part="training")).model
    return Amended(effects, before, after, locked_error(oracle, plain))


def locked_error(model: ArmModel, recording: Recording) -> float:
    """RMS distance of a key point on the locked quarter of a recording, mm."""
    problem = problem_of(model, [recording], EVERY_ROW, part="held_out")
    return float(np.sqrt(np.nanmean(np.square(problem.residual).sum(2))))
