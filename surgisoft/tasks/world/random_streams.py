"""Counter-based random number streams: one for each environment, independent of the batch.

A stream is a key and a count; its numbers are a hash of both (SplitMix64, Steele, Lea & Flood
2014). No generator is shared, so a batch of N equals N batches of one, on any device, and a saved
state includes its random numbers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surgisoft.compiled import compiled
from surgisoft.tasks.arguments import whole

_GAMMA = -0x61C8864680B583EB
_MIX_1 = -0x40A7B892E31B1A47
_MIX_2 = -0x6B2FB644ECCEEE15
"""The constants of SplitMix64 as signed integers (Steele, Lea & Flood 2014, fig. 17)."""


@dataclass(frozen=True, eq=False)
class Stream:
    """A batch of random number streams."""

    key: Tensor
    """(B,) int64: key of each stream."""
    count: Tensor
    """(B,) int64: numbers drawn so far."""

    def uniform(self, low: float, high: float, *shape: int) -> "tuple[Stream, Tensor]":
        """The advanced streams, and (B, *shape) float32 numbers uniform in [low, high)."""
        size = math.prod(shape)
        if self.key.device.type == "cpu" and type(self.key) is Tensor:
            share = torch.empty(len(self.key), size)
            _draw(self.key.numpy(), self.count.numpy(), share.numpy())
        else:
            place = self.count[:, None] + torch.arange(1, size + 1, device=self.key.device)
            bits = _mix(self.key[:, None] + _GAMMA * place)
            share = _shifted(bits, 40).to(torch.float32) * 2.0**-24
        values = low + (high - low) * share.reshape(len(self.key), *shape)
        return Stream(self.key, self.count + size), values

    def normal(self, *shape: int) -> "tuple[Stream, Tensor]":
        """The advanced streams, and (B, *shape) float32 standard normals (Box & Muller 1958)."""
        after, draws = self.uniform(0.0, 1.0, 2, *shape)
        radius = (-2.0 * (1.0 - draws[:, 0]).log()).sqrt()
        return after, radius * (2.0 * math.pi * draws[:, 1]).cos()


def streams(seed: int, count: int, first: int = 0, device: str | torch.device = "cpu") -> Stream:
    """Random number streams `first` to `first + count - 1` of a seed, a whole number from 0 on.

    Raises InputError for another seed.
    """
    seed = whole("seed", seed, 0)
    place = torch.arange(first, first + count, dtype=torch.int64, device=device)
    root = _mix(torch.tensor([_wrapped(seed)], dtype=torch.int64, device=device))
    return Stream(_mix(root + _GAMMA * (place + 1)), torch.zeros_like(place))


def episode_streams(seed: int, count: int, device: str | torch.device = "cpu") -> Stream:
    """The first stream of each of the seeds `seed` to `seed + count - 1`, from 0 on.

    Raises InputError for another seed.
    """
    seed = whole("seed", seed, 0)
    seeds = torch.arange(count, dtype=torch.int64, device=device) + _wrapped(seed)
    return Stream(_mix(_mix(seeds) + _GAMMA), torch.zeros_like(seeds))


def joined(parts: Sequence[Stream]) -> Stream:
    """Concatenate batches of random number streams."""
    key, count = torch.cat([p.key for p in parts]), torch.cat([p.count for p in parts])
    return Stream(key, count)


def _wrapped(seed: int) -> int:
    """A whole number of any size as a signed one of 64 bits."""
    return (seed + 2**63) % 2**64 - 2**63


def _mix(z: Tensor) -> Tensor:
    """The finaliser of SplitMix64 (Steele, Lea & Flood 2014, fig. 17) on int64 that wrap."""
    z = (z ^ _shifted(z, 30)) * _MIX_1
    z = (z ^ _shifted(z, 27)) * _MIX_2
    return z ^ _shifted(z, 31)


def _shifted(z: Tensor, bits: int) -> Tensor:
    """Shift to the right that fills with zeros."""
    return (z >> bits) & ((1 << (64 - bits)) - 1)


@compiled
def _draw(key, count, share):
    """Numbers (B, N) in [0, 1) of streams at counts (B,), into share; see `_mix`."""
    for b in range(len(key)):
        for n in range(share.shape[1]):
            z = key[b] + _GAMMA * (count[b] + n + 1)
            z = (z ^ ((z >> 30) & ((1 << 34) - 1))) * _MIX_1
            z = (z ^ ((z >> 27) & ((1 << 37) - 1))) * _MIX_2
            z = z ^ ((z >> 31) & ((1 << 33) - 1))
            share[b, n] = np.float32((z >> 40) & ((1 << 24) - 1)) * np.float32(2.0**-24)
