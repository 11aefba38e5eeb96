"""A rig by names, and the plug-in that gives it to LeRobot."""

import importlib
import sys
import tomllib
import types
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.rig import open_rig
from surgisoft.rig.lerobot import NamedRig

PLUGIN = Path(__file__).parents[2] / "plugins" / "lerobot_robot_surgisoft"


def test_rig_by_names_gives_what_the_rig_gives():
    named, rig = NamedRig("virtual:seed=3"), open_rig("virtual:seed=3")
    named.connect()
    rig.reset()
    for pressures in ([20.0, 5.0, 0.0], [25.0, 10.0, 3.0]):
        sent = named.send(dict(zip(named.action_names, pressures, strict=True)))
        rig.command(np.array(pressures))
        sample, observed = rig.read(), named.observe()
        assert sent == dict(zip(["c1_kPa", "c2_kPa", "c3_kPa"], pressures, strict=True))
        assert observed["p2_kPa"] == sample.measured[1]
        assert observed["k4_x_mm"] == sample.key_points_mm[4, 0]
        assert list(observed) == named.state_names
    named.disconnect()
    assert not named.is_connected


def test_actions_beyond_the_limits_are_clipped_and_reported():
    named = NamedRig("virtual:seed=3")
    named.connect()
    named.send({"c1_kPa": 7.0, "c2_kPa": 8.0, "c3_kPa": 9.0})
    sent = named.send({"c1_kPa": 1e30, "c2_kPa": float("nan"), "c3_kPa": -1e30})
    low, high = open_rig("virtual:seed=3").limits.T
    assert sent == {"c1_kPa": high[0], "c2_kPa": 8.0, "c3_kPa": low[2]}
    with pytest.raises(InputError, match="lacks c3_kPa"):
        named.send({"c1_kPa": 1.0, "c2_kPa": 1.0})


class Blinking:
    """A rig whose camera sees one point in every other sample."""

    unit, chambers, key_planes, period_s = "kPa", 1, 1, 0.1
    limits, arm, payload_g, gravity = np.array([[0.0, 10.0]]), None, None, None

    def __init__(self):
        self.count, self.log = 0, []

    def reset(self):
        self.log.append("reset")

    def command(self, pressures):
        self.log.append(float(pressures[0]))

    def wait(self, seconds):
        pass

    def read(self):
        from surgisoft.rig import Sample

        self.count += 1
        point = np.full((1, 3), np.nan if self.count % 2 == 0 else float(self.count))
        return Sample(0.1 * self.count, np.zeros(1), np.zeros(1), point)


def test_lost_key_point_is_nan_or_held(monkeypatch):
    for hold, expected in ((False, [1.0, np.nan, 3.0]), (True, [1.0, 1.0, 3.0])):
        rig = Blinking()
        monkeypatch.setattr("surgisoft.rig.lerobot.open_rig", lambda _, rig=rig: rig)
        named = NamedRig("blinking", hold_missing=hold)
        named.connect()
        seen = [named.observe()["k0_z_mm"] for _ in range(3)]
        named.disconnect()
        np.testing.assert_array_equal(seen, expected)
        assert (rig.log[0], rig.log[-1]) == ("reset", 0.0)  # at rest before, vented after


def test_disconnected_rig_is_not_driven():
    named = NamedRig("virtual:seed=3")
    with pytest.raises(InputError, match="not connected"):
        named.observe()


@pytest.fixture
def lerobot(monkeypatch):
    """LeRobot's convention in a few lines: base classes, and a registry of configurations."""
    config = types.ModuleType("lerobot.robots.config")

    @dataclass(kw_only=True)
    class RobotConfig:
        id: str | None = None
        known: ClassVar[dict] = {}

        @classmethod
        def register_subclass(cls, name):
            return lambda made: cls.known.setdefault(name, made)

    config.RobotConfig = RobotConfig
    robot = types.ModuleType("lerobot.robots.robot")

    class Robot:
        def __init__(self, config):
            self.id = config.id

    robot.Robot = Robot
    for name in ("lerobot", "lerobot.robots"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, "lerobot.robots.config", config)
    monkeypatch.setitem(sys.modules, "lerobot.robots.robot", robot)
    monkeypatch.syspath_prepend(str(PLUGIN))
    yield RobotConfig.known
    for name in [name for name in sys.modules if name.startswith("lerobot_robot_surgisoft")]:
        del sys.modules[name]


def test_plugin_is_found_by_the_convention(lerobot):
    # LeRobot imports distributions called lerobot_robot_*, and takes the class that is called like
    # the configuration without "Config" from the configuration's parent module.
    name = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]["name"]
    assert name.startswith("lerobot_robot_")
    importlib.import_module(name)
    config = lerobot["surgisoft_rig"]
    parent = importlib.import_module(config.__module__.rpartition(".")[0])
    robot = getattr(parent, config.__name__.removesuffix("Config"))(config(rig="virtual:seed=3"))
    assert robot.action_features == {"c1_kPa": float, "c2_kPa": float, "c3_kPa": float}
    robot.connect()
    sent = robot.send_action({"c1_kPa": 10.0, "c2_kPa": 0.0, "c3_kPa": 0.0})
    assert sent["c1_kPa"] == 10.0
    assert set(robot.get_observation()) == set(robot.observation_features)
    robot.disconnect()
    assert not robot.is_connected
