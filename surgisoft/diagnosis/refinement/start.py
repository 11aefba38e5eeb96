"""Where a fit of an effect starts: the shapes that do best on held-out blocks."""

import copy
import itertools

import numpy as np
import torch

from surgisoft.diagnosis.candidates import candidates, with_effect
from surgisoft.diagnosis.criteria import CRITERIA
from surgisoft.diagnosis.cross_validation import cross_validation_of
from surgisoft.diagnosis.residuals import Problem
from surgisoft.errors import InputError
from surgisoft.surrogate.model import ArmModel


def starts(problem: Problem, name: str, number: int = 2) -> list[ArmModel]:
    """Models with the named effect in its best few shapes, amplitudes fitted; parts are copies.

    The shapes are ranked by the error that each leaves on held-out blocks beside the surrogate's
    own error; of two that leave nearly the same, the simpler one comes first.
    """
    tried = candidates(problem, [name])
    if not tried:
        raise InputError(
            f"effect '{name}' changes nothing on these recordings, so nothing of it can be fitted; "
            "record motion that it would show in"
        )
    ends = np.cumsum([0] + [candidate.columns.shape[-1] for candidate in tried])
    sensitivities = np.concatenate([candidate.columns for candidate in tried], axis=-1)
    validation = cross_validation_of(problem, sensitivities)
    picks = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    before = validation.losses().sum()
    gains = [np.log(before / validation.losses(pick).sum()) for pick in picks]
    scores = [
        CRITERIA.selection.priced(gain, len(pick)) for gain, pick in zip(gains, picks, strict=True)
    ]
    answer = []
    for best in np.argsort(scores)[::-1][:number]:
        effect = copy.deepcopy(tried[best].effect)
        amplitudes = torch.from_numpy(validation.amplitudes(picks[best])).float()
        begin = 0
        with torch.no_grad():
            for strength in effect.strengths().values():
                end = begin + strength.numel()
                strength.copy_(amplitudes[begin:end].view_as(strength))
                begin = end
        answer.append(with_effect(copy.deepcopy(problem.model), name, effect))
    return answer
