"""Models on another device: no operation of a step makes or leaves a tensor on the CPU.

The device is PyTorch's `meta`, whose tensors have no values: reading one fails, as in a CUDA graph.
"""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.effects import known_effects, make_effect
from surgisoft.surrogate.model import ArmModel, arm_facts
from surgisoft.surrogate.networks import HawNN

SPEC = ArmSpec(3, 4, (0.0,) * 3, (40.0,) * 3)
REST = torch.tensor([[0.0, 0.0, 20.0 * k] for k in range(4)])


class OnlyMeta(TorchDispatchMode):
    """Fails at an operation whose result is elsewhere."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Do the operation and look at its results."""
        found = func(*args, **(kwargs or {}))
        for value in tree_leaves(found):
            assert not isinstance(value, torch.Tensor) or value.is_meta, func
        return found


@pytest.mark.parametrize("arcs", [0, 3, 4])
@pytest.mark.parametrize("effect", ["", *known_effects()])
def test_a_step_stays_on_its_device(effect, arcs):
    network = HawNN(torch.tensor(SPEC.low), torch.tensor(SPEC.high), 4, (8,), arcs=arcs)
    if network.prior is not None:
        network.prior.set_rest(REST)
    effects = {effect: make_effect(effect, arm_facts(SPEC, REST))} if effect else {}
    model = ArmModel(SPEC, network, effects, REST).eval().requires_grad_(False).to("meta")
    with OnlyMeta(), torch.no_grad():
        state = model.initial_state(2)
        for dt in (0.05, torch.full((2,), 0.1, device="meta")):
            state, points = model.step(state, torch.ones(2, 3, device="meta"), dt)
    assert points.shape == (2, 4, 3)
