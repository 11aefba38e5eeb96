"""The runner of an exported controller: what it gives to the graph, and what it keeps."""

import math

import numpy as np
import pytest

from surgisoft.agents.controller_runner import Controller

LEAVES = {"steps": (), "goal.start": (), "arms.arm.plant.lowest_kPa": (2,)}
LEAVES |= {"arms.arm.plant.highest_kPa": (2,)}


class Graph:
    """Stands in for the graph of an arm with two chambers: a sample later, a command per call."""

    def __init__(self):
        self.given = []

    def __call__(self, given):
        self.given.append({name: value.copy() for name, value in given.items()})
        state = given["state"].copy()
        state[0, 0] += 1.0
        number = float(len(self.given))
        return [state, np.array([[number, 10.0 + number]]), np.zeros((1, 1, 3))]


@pytest.fixture
def driven():
    """A controller whose episodes have three decisions, and the graph that it calls."""
    leaves, first = [], 0
    for name, shape in LEAVES.items():
        last = first + math.prod(shape)
        leaves.append({"name": name, "shape": list(shape), "first": first, "last": last})
        first = last
    arm = {"name": "arm", "chambers": 2, "key_points": 1}
    arm |= {"lowest_kPa": [0.0, 5.0], "highest_kPa": [60.0, 50.0]}
    about = {
        "episode_steps": 3,
        "controller": {
            "arms": [arm],
            "control_period_s": 0.1,
            "state": {"leaves": leaves, "initial": [0.0, 0.25, 0.0, 5.0, 60.0, 50.0]},
            "signals": [],
            "goal": [{**leaves[1], "default": 0.25}],
            "outputs": ["next_state", "arm_command_kPa", "arm_estimate_mm"],
        },
    }
    graph = Graph()
    return Controller.of(about, graph), graph


REST, POINTS = [1.0, 2.0], np.zeros((1, 3))


def test_other_limits_are_never_beyond_those_of_the_training(driven):
    controller, _ = driven
    controller.limit([-10.0, 20.0], [70.0, 30.0])
    assert controller.state("arms.arm.plant.lowest_kPa").tolist() == [0.0, 20.0]
    assert controller.state("arms.arm.plant.highest_kPa").tolist() == [60.0, 30.0]
    controller.reset()
    assert controller.state("arms.arm.plant.lowest_kPa").tolist() == [0.0, 5.0]
    assert controller.state("arms.arm.plant.highest_kPa").tolist() == [60.0, 50.0]


def test_an_episode_begins_with_its_own_goal_and_ends_after_its_decisions(driven):
    controller, graph = driven
    assert controller.begin(REST, POINTS, REST, 0.1, goal={"start": 0.5}).tolist() == [1.0, 11.0]
    assert graph.given[-1]["state"][0, 1] == 0.5
    assert graph.given[-1]["begin"] == [1.0]
    assert (controller.steps, controller.done) == (1, False)
    controller.step(REST, POINTS, 0.1)
    assert graph.given[-1]["begin"] == [0.0]
    assert (controller.steps, controller.done) == (2, False)
    controller.step(REST, POINTS, 0.1)
    assert (controller.steps, controller.done) == (3, True)
    controller.begin(REST, POINTS, REST, 0.1)
    assert graph.given[-1]["state"][0, 1] == 0.25, "not the goal of the episode before"


def test_the_set_points_in_force_are_those_returned_last_or_those_that_are_given(driven):
    controller, graph = driven
    controller.begin(REST, POINTS, [3.0, 4.0], 0.1)
    assert graph.given[-1]["arm_commanded_kPa"].tolist() == [[3.0, 4.0]]
    controller.step(REST, POINTS, 0.05)
    assert graph.given[-1]["arm_commanded_kPa"].tolist() == [[1.0, 11.0]]
    controller.step(REST, POINTS, 0.05, commanded_kPa=[0.5, 6.0])
    assert graph.given[-1]["arm_commanded_kPa"].tolist() == [[0.5, 6.0]]
    assert graph.given[-1]["arm_pressure_kPa"].tolist() == [REST]
    assert graph.given[-1]["dt_s"] == pytest.approx([0.05])


def test_after_a_reset_an_episode_has_to_begin(driven):
    controller, _ = driven
    controller.begin(REST, POINTS, REST, 0.1)
    controller.reset()
    assert (controller.steps, controller.outputs) == (0, {})
    with pytest.raises(ValueError, match="step before begin"):
        controller.step(REST, POINTS, 0.1)


@pytest.mark.parametrize(
    ("pressure", "dt_s", "message"),
    [
        (REST, -0.1, "dt_s is -0.1, expected 0 s or more"),
        (REST, math.inf, "dt_s is inf"),
        ([1.0, math.nan], 0.1, "expected finite numbers"),
    ],
)
def test_a_sample_that_cannot_be_is_refused(driven, pressure, dt_s, message):
    controller, graph = driven
    with pytest.raises(ValueError, match=message):
        controller.observe(pressure, POINTS, REST, dt_s)
    assert not graph.given


@pytest.fixture
def signalled():
    """A controller of two arms with a signal that has to be given and one that need not be."""
    arms = [
        {"name": name, "chambers": 2, "key_points": 1, "lowest_kPa": [0, 0], "highest_kPa": [9, 9]}
        for name in ("one", "two")
    ]
    signals = [
        {
            "name": "view",
            "unit": "-",
            "low": 0.0,
            "high": 1.0,
            "meaning": "share seen",
            "default": None,
            "optional": False,
        },
        {
            "name": "at_target",
            "unit": "-",
            "low": 0.0,
            "high": 1.0,
            "meaning": "1 at the target",
            "default": None,
            "optional": True,
        },
        {
            "name": "out_mm",
            "unit": "mm",
            "low": -9.0,
            "high": 9.0,
            "meaning": "the feed",
            "default": 2.5,
            "optional": False,
        },
    ]
    about = {
        "episode_steps": 3,
        "controller": {
            "arms": arms,
            "control_period_s": 0.1,
            "state": {"leaves": [], "initial": [0.0]},
            "signals": signals,
            "goal": [],
            "outputs": ["next_state", "one_command_kPa", "two_command_kPa"],
        },
    }
    given = []

    def graph(values):
        given.append(values)
        return [values["state"], np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]])]

    return Controller.of(about, graph), given


def test_signals_that_have_to_be_given_are_asked_for(signalled):
    controller, given = signalled
    each = {"one": REST, "two": REST}
    points = {"one": POINTS, "two": POINTS}
    command = controller.begin(each, points, each, 0.1, view=0.75)
    assert {name: value.tolist() for name, value in command.items()} == {
        "one": [1.0, 2.0],
        "two": [3.0, 4.0],
    }
    assert given[0]["view"].tolist() == [0.75]
    assert np.isnan(given[0]["at_target"]).all(), "left to the model"
    assert given[0]["out_mm"].tolist() == [2.5], "its default"
    controller.step(each, points, 0.1, view=0.5, at_target=1.0)
    assert given[1]["at_target"].tolist() == [1.0]
    assert given[1]["two_commanded_kPa"].tolist() == [[3.0, 4.0]]
    for signals in ({}, {"view": math.nan}):
        with pytest.raises(ValueError, match="signal 'view' is missing: share seen"):
            controller.step(each, points, 0.1, **signals)
    with pytest.raises(ValueError, match="signal 'sight' is not known, expected view, at_target"):
        controller.step(each, points, 0.1, view=1.0, sight=1.0)
    assert len(given) == 2


def test_measurements_of_other_arms_or_shapes_are_refused(signalled, driven):
    controller, given = signalled
    each, points = {"one": REST, "two": REST}, {"one": POINTS, "two": POINTS}
    with pytest.raises(ValueError, match="arm 'two' is missing, got one"):
        controller.observe({"one": REST}, points, each, 0.1, view=1.0)
    with pytest.raises(ValueError, match="expected a dict with the arms one, two"):
        controller.observe(REST, points, each, 0.1, view=1.0)
    assert not given
    alone, graph = driven
    with pytest.raises(ValueError, match=r"shape \(3,\), expected \(2,\)"):
        alone.observe([1.0, 2.0, 3.0], POINTS, REST, 0.1)
    with pytest.raises(ValueError, match="goal 'end' is not known, expected start"):
        alone.begin(REST, POINTS, REST, 0.1, goal={"end": 0.5})
    with pytest.raises(ValueError, match="has shape"):
        alone.set(arms__arm__plant__lowest_kPa=[1.0])
    with pytest.raises(ValueError, match="'mount' is not in the state"):
        alone.set(mount=1.0)
    assert not graph.given


def test_an_episode_that_has_not_begun_is_not_over(driven):
    controller, _ = driven
    for _ in range(4):
        controller.observe(REST, POINTS, REST, 0.1)
    assert controller.steps == 4
    assert not controller.done
    controller.begin(REST, POINTS, REST, 0.1)
    assert controller.done
