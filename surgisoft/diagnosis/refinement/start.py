"""Where a fit of an effect starts: the shapes that do best on held-out blocks."""

import copy
import itertools

import numpy as np
import torch

from surgisoft.diagnosis.candidates import candidates, with_effect
from surgisoft.diagnosis.problem import Problem
from surgisoft.diagnosis.race.cross_validation import CrossValidation
from surgisoft.diagnosis.race.ranking import priced
from surgisoft.diagnosis.race.split import static_features
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
    validation = CrossValidation.of(
        static_features(problem.pressure, problem.direction),
        problem.residual,
        np.concatenate([candidate.columns for candidate in tried], axis=-1),
        problem.block,
        problem.fold,
        problem.surrogate_mm,
        problem.noise_mm,
    )
    picks = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    before = validation.losses().sum()
    gains = [np.log(before / validation.losses(pick).sum()) for pick in picks]
    scores = [priced(gain, len(pick)) for gain, pick in zip(gains, picks, strict=True)]
    answer = []
    for best in np.argsort(scores)[::-1][:number]:
        effect = copy.deepcopy(tried[best].effect)
        amplitudes = torch.from_numpy(validation.amplitudes(picks[best])).float()
        begin = 0
        with torch.no_grad():
            for strength in effect.amplitudes().values():
                end = begin + strength.numel()
                strength.copy_(amplitudes[begin:end].view_as(strength))
                begin = end
        answer.append(with_effect(copy.deepcopy(problem.model), name, effect))
    return answer
