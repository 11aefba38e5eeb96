"""What a CUDA graph records of a world may not send a GPU anything, nor read a value back."""

import inspect
import linecache

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from surgisoft.agents.presets import ROBUST, config_for
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.registry import TASKS, config_of, make_task

MAKES = {
    torch.arange, torch.as_tensor, torch.empty, torch.eye, torch.from_numpy, torch.full,
    torch.linspace, torch.ones, torch.scalar_tensor, torch.tensor, torch.zeros,
}  # fmt: skip
"""What makes a tensor on the CPU, unless it is told a device."""
READS = {
    Tensor.__bool__, Tensor.__float__, Tensor.__int__, Tensor.cpu, Tensor.item, Tensor.nonzero,
    Tensor.numpy, Tensor.tolist, torch.nonzero,
}  # fmt: skip
OTHERWISE = ("surgisoft/scene/", "random_streams.py")
"""Where a GPU has kernels of its own."""


class Recordable(TorchFunctionMode):
    """Notes the lines of the package that a graph could not hold."""

    def __init__(self):
        super().__init__()
        self.found: set[str] = set()

    def __torch_function__(self, func, types, args=(), kwargs=None):
        """Look at a call, and do it."""
        kwargs = kwargs or {}
        sent = func in MAKES and kwargs.get("device") is None
        if func in (Tensor.__getitem__, Tensor.__setitem__):
            keys = args[1] if isinstance(args[1], tuple) else (args[1],)
            sent = any(isinstance(key, list) for key in keys)
        if sent or func in READS:
            frame = inspect.currentframe()
            while "surgisoft/" not in frame.f_code.co_filename:
                frame = frame.f_back
            file = frame.f_code.co_filename
            if not any(where in file for where in OTHERWISE):
                self.found.add(f"{file}:{frame.f_lineno} {linecache.getline(file, frame.f_lineno)}")
        return func(*args, **kwargs)


@pytest.mark.parametrize("preset", ["fast", ROBUST])
@pytest.mark.parametrize("name", TASKS)
def test_a_step_a_start_and_an_observation_are_operations_of_tensors(name, preset):
    task = make_task(name, config_for(preset, config_of(name)))
    for arm, body in task.world.arms.items():
        task.world.arms[arm] = body.reference()
    episodes = Episodes(task, donate=True)
    with torch.inference_mode():
        state = episodes.seeded(1, 3)
        actions = {agent: torch.zeros(3, task.world.arms[agent].chambers) for agent in task.agents}
        state, _ = episodes.step(state, actions)  # constants are made in the first call
        episodes.observe(state)
        with Recordable() as mode:
            state, _ = episodes.step(state, actions)
            episodes.observe(state)
            episodes.start(state.world.stream)
    assert not mode.found
