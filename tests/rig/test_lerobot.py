"""A rig by names, and the plug-in that gives it to LeRobot."""

import importlib
import sys
import tomllib
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.rig import open_rig
from surgisoft.rig.lerobot import NamedRig, NamedSchedule

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


def test_a_rig_that_is_connected_again_knows_no_old_command():
    """It was vented meanwhile: what is not finite leaves it vented."""
    named = NamedRig("virtual:seed=3")
    named.connect()
    named.send({"c1_kPa": 20.0, "c2_kPa": 5.0, "c3_kPa": 9.0})
    named.disconnect()
    named.connect()
    sent = named.send({"c1_kPa": float("nan"), "c2_kPa": 1.0, "c3_kPa": float("inf")})
    named.disconnect()
    assert sent == {"c1_kPa": 0.0, "c2_kPa": 1.0, "c3_kPa": 0.0}


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


def test_a_rig_that_does_not_come_to_rest_is_vented_and_given_back(monkeypatch):
    class Stuck(Blinking):
        def reset(self):
            raise InputError("chamber 1 is still at 9.0 kPa")

        def close(self):
            self.log.append("closed")

    rig = Stuck()
    monkeypatch.setattr("surgisoft.rig.lerobot.open_rig", lambda _: rig)
    named = NamedRig("stuck")
    for _ in range(2):
        with pytest.raises(InputError, match="chamber 1 is still at"):
            named.connect()
        assert not named.is_connected
    assert rig.log == [0.0, "closed", 0.0, "closed"]


def test_disconnected_rig_is_not_driven():
    named = NamedRig("virtual:seed=3")
    with pytest.raises(InputError, match="not connected"):
        named.observe()


def test_a_schedule_by_names_is_linear_and_begins_again(tmp_path):
    file, now = tmp_path / "s.csv", [100.0]
    file.write_text("t_s,c1_kPa,c2_kPa\n5,0,8\n6,10,8\n7,10,0\n")
    schedule = NamedSchedule(str(file), clock=lambda: now[0])
    for passed, expected in ((0.0, [0, 8]), (0.5, [5, 8]), (1.0, [10, 4]), (1.0, [5, 8])):
        now[0] += passed  # times since the first command: 0, 0.5, 1.5 and, after 2 s, 0.5 again
        assert schedule.command() == dict(zip(["c1_kPa", "c2_kPa"], expected, strict=True))
    now[0] += 1.1
    assert schedule.command() == {"c1_kPa": 0.0, "c2_kPa": 8.0}, "a pause begins a new episode"
    file.write_text("t_s,c1_kPa,run\n0,0,0\n1,10,0\n0,5,1\n1,5,1\n")
    with pytest.raises(InputError, match="2 runs; expected one"):
        NamedSchedule(str(file))


@pytest.fixture
def lerobot(monkeypatch):
    """LeRobot's convention in a few lines: base classes, and a registry of configurations."""
    known: dict[str, type] = {}

    @dataclass(kw_only=True)
    class Config:
        id: str | None = None

        @classmethod
        def register_subclass(cls, name):
            return lambda made: known.setdefault(name, made)

    class Device:
        def __init__(self, config):
            self.id = config.id

    for folder, kind in (("robots", "Robot"), ("teleoperators", "Teleoperator")):
        modules = {
            f"lerobot.{folder}": {},
            f"lerobot.{folder}.config": {f"{kind}Config": Config},
            f"lerobot.{folder}.{kind.lower()}": {kind: Device},
        }
        for name, content in {"lerobot": {}, **modules}.items():
            module = types.ModuleType(name)
            vars(module).update(content)
            monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(PLUGIN))
    yield known
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
    assert robot.cameras == {}, "lerobot-record counts them"


def test_the_plugins_schedule_drives_its_rig(lerobot, tmp_path):
    importlib.import_module("lerobot_robot_surgisoft")
    config = lerobot["surgisoft_schedule"]
    parent = importlib.import_module(config.__module__.rpartition(".")[0])
    (tmp_path / "s.csv").write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n0,4,5,6\n9,4,5,6\n")
    made = getattr(parent, config.__name__.removesuffix("Config"))
    teleoperator = made(config(schedule=str(tmp_path / "s.csv")))
    rig = parent.SurgisoftRig(lerobot["surgisoft_rig"](rig="virtual:seed=3"))
    assert teleoperator.action_features == rig.action_features
    teleoperator.connect()
    rig.connect()
    assert rig.send_action(teleoperator.get_action()) == {"c1_kPa": 4, "c2_kPa": 5, "c3_kPa": 6}
    rig.disconnect()


def test_the_plugin_names_the_extra_where_lerobot_is_missing(monkeypatch):
    monkeypatch.syspath_prepend(str(PLUGIN))
    monkeypatch.setitem(sys.modules, "lerobot", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'surgisoft\[lerobot\]'"):
        importlib.import_module("lerobot_robot_surgisoft")
    assert tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]["dependencies"] == [
        "surgisoft[lerobot]"
    ]
