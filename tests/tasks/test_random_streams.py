"""Random streams: the published generator, and independence of what stands beside them."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from surgisoft.errors import InputError
from surgisoft.tasks.world.pytree import rows
from surgisoft.tasks.world.random_streams import Stream, episode_streams, streams

LARGE = 2**64


class OtherTensor(torch.Tensor):
    """Tensors that the compiled loop does not take, as those of a GPU."""


def splitmix64(seed: int, count: int) -> list[int]:
    """The reference algorithm in whole numbers (Steele, Lea & Flood 2014, fig. 17)."""
    state, answer = seed % LARGE, []
    for _ in range(count):
        state = (state + 0x9E3779B97F4A7C15) % LARGE
        z = state
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % LARGE
        z = (z ^ (z >> 27)) * 0x94D049BB133111EB % LARGE
        answer.append(z ^ (z >> 31))
    return answer


def test_reference_gives_the_published_numbers():
    """First outputs for seed 1234567, as published with the algorithm's test vectors."""
    assert splitmix64(1234567, 2) == [6457827717110365317, 3203168211198807973]


@given(st.integers(-(2**63), 2**63 - 1), st.integers(1, 20))
def test_numbers_are_those_of_splitmix64(seed, count):
    stream = Stream(torch.tensor([seed]), torch.tensor([0]))
    after, values = stream.uniform(0.0, 1.0, count)
    expected = [(z >> 40) / 2**24 for z in splitmix64(seed, count)]
    assert values[0].tolist() == expected
    plain = Stream(stream.key.as_subclass(OtherTensor), stream.count)
    assert plain.uniform(0.0, 1.0, count)[1][0].tolist() == expected
    assert after.count.item() == count


def test_draws_in_parts_are_the_draws_at_once():
    whole = streams(5, 4).uniform(0.0, 1.0, 6)[1]
    stream, first = streams(5, 4).uniform(0.0, 1.0, 2)
    assert torch.equal(torch.cat((first, stream.uniform(0.0, 1.0, 4)[1]), 1), whole)


@pytest.mark.parametrize("seed", [-1, 0.5, "0"])
def test_a_seed_is_a_whole_number_from_0_on(seed):
    with pytest.raises(InputError, match=r"seed is .*expected"):
        streams(seed, 1)
    with pytest.raises(InputError, match=r"seed is .*expected"):
        episode_streams(seed, 1)


def test_a_stream_does_not_depend_on_its_neighbours():
    batch = streams(9, 7)
    values = batch.normal(5, 2)[1]
    for i in range(7):
        assert torch.equal(streams(9, 1, first=i).normal(5, 2)[1][0], values[i])
        assert torch.equal(rows(batch, torch.tensor([i])).normal(5, 2)[1][0], values[i])


def test_distributions():
    stream, even = streams(3, 200).uniform(-2.0, 3.0, 500)
    _, normal = stream.normal(500)
    assert stats.kstest(even.flatten().numpy(), stats.uniform(-2.0, 5.0).cdf).pvalue > 1e-3
    assert stats.kstest(normal.flatten().numpy(), stats.norm.cdf).pvalue > 1e-3
    table = np.corrcoef(normal.numpy()[:40])
    assert np.abs(table - np.eye(40)).max() < 5.0 / np.sqrt(500)


def test_seeds_give_other_streams():
    keys = torch.cat([streams(seed, 1000).key for seed in range(20)])
    assert len(keys.unique()) == len(keys)
