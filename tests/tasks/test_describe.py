"""The reference of the tasks says what the environments do, and the docs hold it."""

import dataclasses
from functools import cache
from pathlib import Path

import pytest
import torch

from surgisoft.environments import ONE_AGENT
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.describe import describe, describe_agents, main, pages
from surgisoft.tasks.numpy_adapter import NumpyAdapter
from surgisoft.tasks.registry import TASKS, config_of, make_task, with_fields
from surgisoft.tasks.world.arm import Randomisation

PAGES = Path(__file__).resolve().parents[2] / "docs" / "environments"
MOVED = ("direction", "reversal", "time")
"""Blocks that go through most of their range in any episode."""
every_task = pytest.mark.parametrize("name", TASKS)
task_of, told_of = cache(make_task), cache(describe)
"""Tasks, which hold no state, and what is said of them, made once."""


@every_task
def test_blocks_cover_the_whole_observation_and_terms_the_whole_reward(name):
    task = task_of(name)
    adapter, told = NumpyAdapter(task), told_of(name)
    assert tuple(told.agents) == task.agents == TASKS[name].agents
    _, outcome = adapter.step(
        adapter.seeded([0]), {agent: torch.zeros(1, 3).numpy() for agent in task.agents}
    )
    for agent, facts in told.agents.items():
        (width,) = adapter.observation_bounds(agent)[2]
        indices = [i for block in facts.observation for i in range(block.first, block.last + 1)]
        assert indices == list(range(width))
        names = [block.name for block in facts.observation]
        assert len(set(names)) == len(names)
        assert [term.name for term in facts.rewards] == [*outcome.terms[agent]]
        for block in facts.observation:
            assert block.unit
            assert block.scale
            assert block.meaning
        assert all(term.meaning for term in facts.rewards)
    assert all(setting.meaning for setting in (*told.settings, *told.randomisation))
    assert told.measures == tuple(outcome.measures)
    assert told.measured


def test_indices_and_scales_by_hand():
    """Clearance, tip error and commands of the keyhole task where the reference says they are."""
    task = make_task("keyhole")
    state = Episodes(task).seeded(3, 1)
    seen = Episodes(task).observe(state)["arm"][0]
    places = {block.name: block for block in describe("keyhole").agents["arm"].observation}
    part = state.world.arms["arm"]
    clearance = places["clearance"]
    assert (clearance.first, clearance.unit, clearance.scale) == (clearance.last, "mm", "x / 10")
    assert seen[clearance.first] == state.world.scene.clearance.least_mm[0] / 10.0
    target = places["target"]
    missing = seen[target.first : target.last + 1].sinh()
    torch.testing.assert_close(missing + part.seen_mm[0, -1], task.route_mm(state)[0, -1])
    command = seen[places["command"].first : places["command"].last + 1]
    low, high = torch.tensor(task.arm.model.spec.low), torch.tensor(task.arm.model.spec.high)
    torch.testing.assert_close(low + (high - low) * (command + 1.0) / 2.0, part.command[0])


def test_another_config_is_described_as_it_is():
    config = with_fields(config_of("track_circle"), history_steps=0, preview=1, fine=0.5)
    told = describe("track_circle", config)
    names = [block.name for block in told.agents["arm"].observation]
    assert "pressure_history" not in names
    assert "error_1" in names
    assert "error_2" not in names
    assert [term.weight for term in told.agents["arm"].rewards] == [1.0, 0.5]


def test_every_randomised_quantity_is_listed():
    told = {entry.name: entry.value for entry in describe("track_body").randomisation}
    assert told == dataclasses.asdict(Randomisation())


@every_task
def test_summaries_and_ends_are_whole_sentences(name):
    """A docstring's first sentence may go on in its second line."""
    told = told_of(name)
    assert told.summary.endswith(".")
    assert told.ends.endswith(".")
    assert "\n" not in told.summary + told.ends


def test_the_docs_hold_the_present_pages():
    """Renew with `python -m surgisoft.tasks.describe docs/environments`."""
    written = pages()
    assert set(written) == {"index.md", *(f"{name}.md" for name in TASKS)}
    for name, text in written.items():
        assert (PAGES / name).read_text(encoding="utf-8") == text
    nav = (PAGES.parents[1] / "mkdocs.yml").read_text(encoding="utf-8")
    assert [name for name in written if f"environments/{name}" not in nav] == []


def test_the_check_names_pages_that_differ(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("surgisoft.tasks.describe.TASKS", {"track_body": TASKS["track_body"]})
    assert main([str(tmp_path)]) == 0
    assert main([str(tmp_path), "--check"]) == 0
    (tmp_path / "track_body.md").write_text("old")
    (tmp_path / "removed_task.md").write_text("old")
    assert main([str(tmp_path), "--check"]) == 1
    told = capsys.readouterr().err
    assert "removed_task.md, track_body.md: out of date" in told
    assert (tmp_path / "track_body.md").read_text() == "old"


@every_task
def test_observations_lie_in_the_stated_ranges(name):
    """Over random episodes from their start to their end, and steps of the scripted expert."""
    task = task_of(name)
    play, stated = Episodes(task), describe_agents(task)
    torch.manual_seed(0)
    seen = {agent: [] for agent in task.agents}
    state = play.seeded(7, 8)
    with torch.inference_mode():
        for step in range(40):
            for agent, value in play.observe(state).items():
                seen[agent].append(value)
            world = state.world
            if step == 20:  # the last steps of the episodes
                late = torch.full_like(world.steps, task.steps - 20)
                state = dataclasses.replace(state, world=dataclasses.replace(world, steps=late))
            if step % 8 == 0:
                actions = task.script(state)
            else:
                actions = {
                    agent: 3.0 * torch.randn(8, task.world.arms[agent].chambers)
                    for agent in task.agents
                }
            state, outcome = play.step(state, actions)
            state = play.reset(state, outcome.terminated)
    for agent, facts in stated.items():
        values = torch.cat(seen[agent])
        assert values.shape[1] == facts.width
        for block in facts.observation:
            part = values[:, block.first : block.last + 1]
            assert part.min() >= block.low - 1e-5, block.name
            assert part.max() <= block.high + 1e-5, block.name
            if block.name in MOVED:
                margin = 0.2 * (block.high - block.low)
                assert part.max() >= block.high - margin, block.name
                assert part.min() <= block.low + margin, block.name


def test_the_tasks_of_one_agent_follow_from_the_registry():
    assert set(ONE_AGENT) == {name for name, spec in TASKS.items() if len(spec.agents) == 1}
