"""Train the endoscope of `circle_ablation` to find the lesion in its own picture.

    python examples/endoscope_from_images.py              a few minutes on one core
    python examples/endoscope_from_images.py --blank      the same with black pictures, to compare

A small convolutional network gets the picture (64 x 64, colour) and what the arm itself measures:
key points, commanded and measured pressures. Nothing says where the lesion is. It imitates the
scripted expert, which knows; the network's own actions make the states (DAgger: Ross, Gordon &
Bagnell 2011). The lesion's place and the mounts differ between episodes. Episodes of other seeds
judge the result.
"""

from __future__ import annotations

import argparse
import time

import torch
from torch import Tensor, nn

import surgisoft
from surgisoft.tasks.observations import COMMAND, PRESSURE, SHAPE
from surgisoft.tasks.registry import config_of, make_task, with_fields

ENVS, STEPS, ROUNDS, EPOCHS = 32, 40, 6, 4
TEST_SEED, TEST_ENVS = 100_000, 64
LATE_STEP = 30
"""Steps after which the picture is judged; the expert needs about 20."""


class Eye(nn.Module):
    """Picture and measurements of the arm -> share of the largest pressure change, -1..1."""

    def __init__(self, measured: int, chambers: int):
        super().__init__()
        self.seen = nn.Sequential(
            nn.Conv2d(3, 16, 5, 2), nn.ReLU(),
            nn.Conv2d(16, 32, 3, 2), nn.ReLU(),
            nn.Conv2d(32, 32, 3, 2), nn.ReLU(),
            nn.Flatten(), nn.LazyLinear(128), nn.ReLU(),
        )  # fmt: skip
        self.head = nn.Sequential(
            nn.Linear(128 + measured, 128), nn.ReLU(), nn.Linear(128, chambers), nn.Tanh()
        )

    def forward(self, picture: Tensor, measured: Tensor) -> Tensor:
        """(B, m) from pictures (B, 64, 64, 3) uint8 and measurements (B, k)."""
        seen = self.seen(picture.permute(0, 3, 1, 2).float() / 255.0 - 0.3)
        return self.head(torch.cat((seen, measured), 1))


def scene_task():
    """`circle_ablation` with pictures, and with another lesion and other mounts each episode."""
    config = with_fields(
        config_of("circle_ablation"),
        images="rgb",
        lesions=16,
        lesion_mm=8.0,
        mount_mm=2.0,
        mount_rad=0.05,
    )
    return make_task("circle_ablation", config)


def measured_of(task, state) -> Tensor:
    """(B, k): the endoscope's own key points and pressures, nothing of the lesion."""
    blocks = task.blocks(state)["endoscope"]
    return torch.cat([blocks[block] for block in (SHAPE, COMMAND, PRESSURE)], 1)


def run(env, seed: int, policy, blank: bool):
    """An episode's beginning: pictures, measurements, the expert's actions; errors at its end.

    policy(picture, measured, expert's action) -> actions as shares, of the endoscope. The laser
    rests, so that it hides nothing.
    """
    task, seen, rows = env.task, env.reset(seed), []
    limit, zero = env.action_limits_kPa["endoscope"], torch.zeros(env.num_envs, 3)
    errors, views = [], []
    for step in range(STEPS):
        state = env.state
        picture = seen["endoscope"]["rgb"].clone() * (not blank)
        expert = (task.script(state)["endoscope"] / limit).clamp(-1.0, 1.0)
        rows.append((picture, measured_of(task, state), expert))
        action = policy(*rows[-1])
        seen = env.step({"endoscope": limit * action, "laser": zero}).observations
        if step >= LATE_STEP:
            view = env.state.world.scene.view
            errors.append(view.axis_error_mm)
            views.append(view.fraction)
    data = [torch.cat(part) for part in zip(*rows, strict=True)]
    return data, torch.stack(errors).mean().item(), torch.stack(views).mean().item()


def main() -> None:
    """Train, and print the result of the network, the expert and an arm at rest."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--blank", action="store_true", help="train with black pictures")
    options.add_argument("--rounds", type=int, default=ROUNDS, help="rounds of imitation")
    options.add_argument("--seed", type=int, default=0, help="seed of network and episodes")
    given = options.parse_args()
    torch.manual_seed(given.seed)
    began, task = time.process_time(), scene_task()
    env = surgisoft.batched_env(task, ENVS, given.seed)
    chambers = env.action_sizes["endoscope"]
    net = Eye(measured_of(task, env.state).shape[1], chambers)
    net(env.reset(given.seed)["endoscope"]["rgb"].clone(), measured_of(task, env.state).clone())
    learner = torch.optim.Adam(net.parameters(), 1e-3)
    held: list[list[Tensor]] = []

    @torch.inference_mode()
    def act(picture, measured, _):
        return net(picture, measured)

    for k in range(given.rounds):
        policy = (lambda _p, _m, expert: expert) if k == 0 else act
        data, error, view = run(env, given.seed + 1 + ENVS * k, policy, given.blank)
        print(f"round {k}: axis {error:5.1f} mm off the lesion, {view:4.0%} of the ring in view")
        held.append([part.clone() for part in data])
        pictures, measured, expert = (torch.cat(part) for part in zip(*held, strict=True))
        for _ in range(EPOCHS):
            for index in torch.randperm(len(pictures)).split(128):
                loss = (net(pictures[index], measured[index]) - expert[index]).square().mean()
                learner.zero_grad()
                loss.backward()
                learner.step()
    print(f"trained in {time.process_time() - began:.0f} s of processor time")
    test = surgisoft.batched_env(task, TEST_ENVS, TEST_SEED)
    policies = {
        "network": act,
        "expert": lambda _p, _m, expert: expert,
        "at rest": lambda _p, _m, expert: torch.zeros_like(expert),
    }
    for name, policy in policies.items():
        _, error, view = run(test, TEST_SEED, policy, given.blank)
        print(f"{name:8} axis {error:5.1f} mm off the lesion, {view:4.0%} of the ring in view")


if __name__ == "__main__":
    main()
