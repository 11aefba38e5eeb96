"""An arm with a small network, and recordings of it: a search predicts some hundred arrangements,
for which the default network would take most of the time."""

from functools import lru_cache, partial

import torch

from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawNN
from tests.diagnosis.setup import recordings

HIDDEN = 32
"""Neurons of the only hidden layer; the key points are then some 2 mm off those of the default arm,
whose tip moves by 25 mm (RMS)."""
ROWS = 2000
"""Random actuations and directions to which the small network is fitted."""


@lru_cache(maxsize=1)
def small_arm() -> ArmModel:
    """The default arm with a network of HIDDEN random neurons, whose output layer is fitted to the
    default network by least squares. Range, hysteresis and validated error are those of the
    default arm."""
    model = default_arm()
    network, rng = model.network, torch.Generator().manual_seed(0)
    low, high = torch.tensor(model.spec.low), torch.tensor(model.spec.high)
    chambers = model.spec.chambers
    small = HawNN(low, high, model.spec.key_points, hidden=(HIDDEN,))
    first, activation, last = small.layers
    actuation = low + torch.rand(ROWS, chambers, generator=rng) * (high - low)
    direction = torch.randint(-1, 2, (ROWS, chambers), generator=rng).float()
    with torch.no_grad():
        for name in ("use", "mean", "scale"):
            getattr(small, name).copy_(getattr(network, name))
        first.weight.copy_(torch.randn(HIDDEN, 2 * chambers, generator=rng) / chambers**0.5)
        first.bias.copy_(torch.randn(HIDDEN, generator=rng))
        inputs = torch.cat([(actuation - small.centre) / small.half_range, direction], 1)
        hidden = torch.cat([activation(first(inputs)), torch.ones(ROWS, 1)], 1).double()
        wanted = (network(actuation, direction).flatten(1) - small.mean) / small.scale
        weights = torch.linalg.lstsq(hidden, wanted.double()).solution
        last.weight.copy_(weights[:-1].T)
        last.bias.copy_(weights[-1])
    return model.replace(network=small).eval().requires_grad_(False)


predicted = partial(recordings.predicted, arm=small_arm)
predicted_along = partial(recordings.predicted_along, arm=small_arm)
measured = partial(recordings.measured, arm=small_arm)
