"""Episodes whose state stays in the same tensors, as CUDA graphs need it, against plain ones."""

import pytest
import torch

from surgisoft.errors import AssumptionWarning
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.graphed import GraphedEpisodes, Packed, overwrite
from surgisoft.tasks.registry import TASKS, make_task
from surgisoft.tasks.world.pytree import leaves
from tests.graph_replays import replays

COUNT = 70
"""Episodes: more than the fewest that a graph begins anew, so that there are two lengths."""


def assert_same(one, other):
    """Starts in batches of another size are rounded differently, and motion carries that on."""
    for a, b in zip(leaves(one), leaves(other), strict=True):
        torch.testing.assert_close(a.double(), b.double(), rtol=1e-4, atol=1e-3, equal_nan=True)


@pytest.mark.parametrize("name", TASKS)
def test_recorded_episodes_are_those_of_the_plain_loop(name):
    task, random = make_task(name), torch.Generator().manual_seed(0)
    recorded, plain = GraphedEpisodes(task, COUNT, replays), Episodes(task, donate=True)
    with torch.inference_mode():
        state, expected = recorded.seeded(1, COUNT), plain.seeded(1, COUNT)
        for step in range(3):
            actions = {
                agent: torch.randn(COUNT, task.world.arms[agent].chambers, generator=random)
                for agent in task.agents
            }
            state, outcome = recorded.step(state, actions)
            expected, truth = plain.step(expected, actions)
            assert_same(outcome, truth)
            seen = recorded.observe(state)
            assert_same(seen, plain.observe(expected))
            over = torch.rand(COUNT, generator=random) < (0.1, 1.0, 0.0)[step]
            state, expected = recorded.reset(state, over), plain.reset(expected, over)
            assert_same(state, expected)
            index = over.nonzero()[:, 0]
            again = recorded.observe_anew(state, index, seen)
            assert_same(again, plain.observe(expected))
            if over.any():
                assert not all(torch.equal(again[agent], seen[agent]) for agent in seen)


def test_what_a_step_returns_outlives_the_next_one():
    task = make_task("track_circle")
    recorded = GraphedEpisodes(task, 3, replays)
    actions = {"arm": torch.ones(3, task.world.arms["arm"].chambers)}
    with torch.inference_mode():
        state = recorded.seeded(0, 3)
        state, outcome = recorded.step(state, actions)
        seen = recorded.observe(state)
        kept = [value.clone() for value in (*leaves(outcome), *seen.values())]
        for _ in range(3):
            state, _ = recorded.step(state, actions)
            recorded.observe(state)
        for value, old in zip((*leaves(outcome), *seen.values()), kept, strict=True):
            torch.testing.assert_close(value, old, rtol=0.0, atol=0.0, equal_nan=True)


def test_another_state_takes_the_place_of_the_present_one():
    task = make_task("track_circle")
    recorded, plain = GraphedEpisodes(task, 4, replays), Episodes(task)
    actions = {"arm": torch.ones(4, task.world.arms["arm"].chambers)}
    with torch.inference_mode():
        recorded.step(recorded.seeded(0, 4), actions)
        other = plain.seeded(9, 4)
        assert_same(recorded.step(other, actions)[1], plain.step(other, actions)[1])


def test_places_that_change_among_each_other_are_all_read_before_any_is_written():
    held = {"now": torch.tensor([1.0]), "before": torch.tensor([2.0]), "same": torch.tensor([3.0])}
    overwrite(held, {"now": held["before"], "before": held["now"], "same": held["same"]})
    assert [value.item() for value in held.values()] == [2.0, 1.0, 3.0]


def test_a_packed_tree_keeps_types_and_order():
    tree = {"a": torch.arange(3), "b": (torch.zeros(3), torch.ones(3)), "c": torch.ones(2, 2)}
    packed = Packed.of(tree)
    assert len(packed.parts) == 3
    copied = packed.copied()
    for value, old in zip(leaves(copied), leaves(tree), strict=True):
        assert value.dtype == old.dtype
        assert torch.equal(value, old)
    packed.parts[torch.float32, (3,)].fill_(7.0)
    assert copied["b"][0].tolist() == [0.0, 0.0, 0.0]
    assert packed.views()["b"][0].tolist() == [7.0, 7.0, 7.0]


def test_what_cannot_be_recorded_is_done_step_by_step_with_a_warning():
    def fails(work):
        raise RuntimeError("operation not permitted when stream is capturing")

    task = make_task("track_circle")
    recorded, plain = GraphedEpisodes(task, 3, fails), Episodes(task)
    actions = {"arm": torch.ones(3, task.world.arms["arm"].chambers)}
    with torch.inference_mode():
        state, expected = recorded.seeded(0, 3), plain.seeded(0, 3)
        with pytest.warns(AssumptionWarning, match="made of the step of track_circle.*permitted"):
            state, _ = recorded.step(state, actions)
        expected, _ = plain.step(expected, actions)
        state, _ = recorded.step(state, actions)
        expected, _ = plain.step(expected, actions)
        assert_same(state, expected)
