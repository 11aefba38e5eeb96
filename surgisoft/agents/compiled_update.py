"""PPO's update through `torch.compile`: the loss of a minibatch, forward and backward, as kernels.

Inductor writes C++ for it. On a GPU the update is one CUDA graph (`graphed_update`), and the step
of the arms is what is compiled.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from torch import Tensor, nn

from surgisoft.agents.ppo_loss import PPOLoss
from surgisoft.agents.shared_ppo import SharedPPO, adapt_rate, adapts_rate
from surgisoft.errors import InputError
from surgisoft.graphs import reason_of
from surgisoft.tasks.world.world import World


class CompileFailed(InputError):
    """`torch.compile` did not build the first minibatch or step; nothing was learned before."""


COMPILERS = ("g++", "clang++", "c++")
"""C++ compilers by which a machine can build what inductor writes for a CPU."""


def check_compiler(device: torch.device) -> None:
    """Raise InputError where this machine has not what `torch.compile` needs for a device."""
    if device.type == "cuda":
        if find_spec("triton") is None:
            raise InputError("--compile: needs Triton on CUDA; pip install triton, or leave it out")
        return
    named = os.environ.get("CXX")
    if not any(map(shutil.which, (named,) if named else COMPILERS)):
        raise InputError(
            f"--compile: no C++ compiler is found (looked for {named or ', '.join(COMPILERS)}); "
            "install g++, or leave the option out"
        )


def compiled_update(ppo: PPO) -> Callable[[], dict[str, float]]:
    """A function that updates an agent as `PPO.update` does, with a compiled loss.

    The order of minibatches, the draws of random numbers and the rule of the learning rate are
    rsl-rl's; the sums of the kernels are added in another order, so that weights agree to rounding.
    """
    check_compiler(torch.device(ppo.device))
    compiled = _told(torch.compile(PPOLoss(ppo), fullgraph=True, dynamic=False))

    def losses(batch: Any) -> tuple[Tensor, ...]:
        mean, deviation = batch.old_distribution_params
        given = (batch.actions, batch.values, batch.advantages, batch.returns)
        seen = [
            torch.cat([batch.observations[group] for group in network.obs_groups], dim=-1)
            for network in (ppo.actor, ppo.critic)
        ]
        return compiled(*seen, *given, batch.old_actions_log_prob, mean, deviation)

    return lambda: _update(ppo, losses)


def _told(compiled: Callable[..., Any]) -> Callable[..., Any]:
    """A function of `torch.compile` whose first call raises `CompileFailed` where it cannot be
    built. An InputError of what it computes is raised as it is."""
    built = False

    def call(*given: Any) -> Any:
        nonlocal built
        try:
            found = compiled(*given)
        except InputError:
            raise
        except Exception as error:
            if built:
                raise
            cause = getattr(error, "inner_exception", error)
            raise CompileFailed(
                f"--compile: torch.compile fails here: {reason_of(cause)}; leave the option out"
            ) from error
        built = True
        return found

    return call


def compile_arms(world: World, count: int) -> None:
    """Let the arms of a world step batches of `count` rows by compiled tensor operations.

    For devices where an arm is tensor operations: on a CPU its loops are compiled already. Other
    batches, such as those of an evaluation, are stepped as before. No CUDA graph is made of it,
    because the next replay would write over the state that it returned. The first such step raises
    `CompileFailed` where it cannot be compiled.
    """
    for arm in world.arms.values():
        arm.step = _by_rows(arm.step, count)  # type: ignore[method-assign]  # of this arm alone


def _by_rows(plain: Callable[..., Any], count: int) -> Callable[..., Any]:
    fast = _told(torch.compile(plain, dynamic=False))

    def step(stream: Any, part: Any, action: Tensor, dt_s: float) -> Any:
        work = fast if len(action) == count else plain
        return work(stream, part, action, dt_s)

    return step


def _update(ppo: PPO, losses: Callable[[Any], tuple[Tensor, ...]]) -> dict[str, float]:
    sums = torch.zeros(3, device=ppo.device)
    storage, batches, epochs = ppo.storage, ppo.num_mini_batches, ppo.num_learning_epochs
    for batch in storage.mini_batch_generator(batches, epochs):
        # rsl-rl draws actions here and leaves them: the stream of random numbers stays the same.
        torch.empty_like(batch.actions).normal_()
        ppo.optimizer.zero_grad()
        loss, value, surrogate, chaos, apart = losses(batch)
        loss.backward()
        if isinstance(ppo, SharedPPO):
            ppo.exchange(apart if ppo.adapts else None)
        elif adapts_rate(ppo):
            adapt_rate(ppo, apart.item())
        for network in (ppo.actor, ppo.critic):
            nn.utils.clip_grad_norm_(network.parameters(), ppo.max_grad_norm)
        ppo.optimizer.step()
        sums += torch.stack((value, surrogate, chaos))
    seen = storage.observations.flatten(0, 1)
    for network in (ppo.actor, ppo.critic):
        network.update_normalization(seen)
    storage.clear()
    means = (sums / (batches * epochs)).tolist()
    return dict(zip(("value", "surrogate", "entropy"), means, strict=True))
