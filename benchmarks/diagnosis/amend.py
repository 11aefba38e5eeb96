"""Amendments in the diagnosis benchmark: fall of the error compared with an oracle.

The oracle knows the exact form and size of the effect: the base model's error on the same robot,
schedule and noise with nothing hidden, its network re-tuned to that where `amend` would. All errors
are of the held-out quarter, which `amend` validates on.
"""

from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.estimation.network import retune
from surgisoft.diagnosis.residuals import EVERY_ROW, problem_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.model import ArmModel


@dataclass(frozen=True)
class Amended:
    """Result of amending by the diagnosed effects; RMS errors on the held-out quarter."""

    effects: tuple[str, ...]
    """Effects that were added; none where the diagnosis named none."""
    before: float
    """Error of the original model, mm."""
    after: float
    """Error of the model after `amend`, the original one where no fall is claimed, mm."""
    oracle: float
    """Error of the model on a robot without hidden effects, its network re-tuned if useful, mm."""

    @property
    def share(self) -> float:
        """Fall of the error as a share of the oracle's; 0 where the oracle has none."""
        most = self.before - self.oracle
        return (self.before - self.after) / most if most else 0.0


def amended(
    model: ArmModel,
    recording: Recording,
    plain: Recording,
    effects: tuple[str, ...],
    earlier: list[Recording] | None = None,
) -> Amended:
    """Amend a model by effects that a recording shows, and compare with the oracle.

    plain: the same schedule and noise without hidden effects; earlier: recordings from before the
    change, as `amend --before` takes them.
    """
    before = after = locked_error(model, recording)
    if effects:
        found = amend(model, [recording], list(effects), before=earlier)
        fall = found.model_error or found.held_out
        before, after = fall.before, fall.after if found.claimed else fall.before
    oracle = retune(model, problem_of(model, [plain], part="training")).model
    return Amended(effects, before, after, locked_error(oracle, plain))


def locked_error(model: ArmModel, recording: Recording) -> float:
    """RMS distance of a key point on the held-out quarter of a recording, mm."""
    problem = problem_of(model, [recording], EVERY_ROW, part="held_out")
    return float(np.sqrt(np.nanmean(np.square(problem.residual).sum(2))))
