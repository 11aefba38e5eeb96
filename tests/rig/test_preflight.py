"""The pre-flight check finds swapped tubes, still chambers and turned frames; real arms pass."""

import re
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.rig import VirtualRig
from surgisoft.rig.preflight import PreflightPlan, judge, preflight
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.reach import steady_key_points
from tests.rig.own_rig import OwnRig


@pytest.fixture(scope="module")
def predict():
    model = load_model("default")
    return lambda pressures: steady_key_points(model, pressures)


class Faulty(OwnRig):
    """A bench with swapped tubes, dead chambers or a turned frame."""

    def __init__(self, robot=0, tubes=(0, 1, 2), dead=(), turn=None):
        super().__init__("x", robot)
        self.tubes, self.dead, self.turn = list(tubes), list(dead), turn

    def command(self, pressures):
        reached = np.zeros(3)
        reached[self.tubes] = pressures
        reached[self.dead] = 0.0
        super().command(reached)

    def read(self):
        sample = super().read()
        if self.turn is None:
            return sample
        return replace(sample, key_points_mm=sample.key_points_mm @ self.turn.T)


def about(axis, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    turn = np.eye(3)
    turn[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return turn


@pytest.mark.parametrize("robot", [0, 3, 7])
def test_robots_of_the_design_pass(predict, robot):
    found = preflight(OwnRig("x", robot), predict)
    assert found.faults == ()
    assert (found.moved_mm > 1.0).all()
    found.require()


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ({"tubes": (1, 0, 2)}, ["chamber 1 moves the arm as 2", "2 moves the arm as 1"]),
        ({"tubes": (0, 2, 1)}, ["chamber 2 moves the arm as 3", "3 moves the arm as 2"]),
        ({"dead": (2,)}, [r"chamber 3 moves the tip by 0\.\d\d mm", "is its tube off"]),
        ({"turn": about(2, 90.0)}, [r"^the cameras' frame is turned by (89|90|91) degrees"]),
        ({"turn": about(0, 90.0)}, [r"^the cameras' frame is turned by (89|90|91) degrees"]),
        # Three chambers 120 degrees apart: the two cannot be told apart by motion.
        (
            {"turn": about(2, 120.0)},
            ["tubes are swapped", "or the cameras' frame is turned by 1(19|20|21)"],
        ),
    ],
)
def test_faults_are_named(predict, fault, expected):
    found = preflight(Faulty(**fault), predict)
    text = "; ".join(found.faults)
    for words in expected:
        assert re.search(words, text), text
    with pytest.raises(InputError, match="pre-flight check: "):
        found.require()


def test_a_mirrored_frame_is_no_rotation(predict):
    found = preflight(Faulty(turn=np.diag([1.0, -1.0, 1.0])), predict)
    assert found.faults
    assert "frame is turned" not in "; ".join(found.faults)


def test_it_moves_one_chamber_at_a_time_and_ends_vented(predict):
    rig = OwnRig("x")
    preflight(rig, predict)
    moved = np.array(rig.commands)
    assert (moved > 0.0).sum(axis=1).max() == 1
    assert moved.max() == pytest.approx(4.0), "a tenth of 40 kPa"
    assert (moved > 0.0).any(axis=0).all()
    assert rig.vents == 1


class Limited(OwnRig):
    """A bench whose chambers have other ranges."""

    def __init__(self, limits):
        super().__init__("x")
        self.limits = np.array(limits)


@pytest.mark.parametrize(
    ("limits", "tried"),
    [
        ([[-15.0, 0.0]] * 3, [-3.0] * 3),
        ([[-15.0, 5.0], [-5.0, 40.0], [10.0, 50.0]], [-3.0, 8.0, 8.0]),
    ],
)
def test_a_chamber_is_tried_towards_the_farther_end_of_its_range(predict, limits, tried):
    """Of vacuum, of both with either the larger, and of pressure that never ends."""
    rig = Limited(limits)
    found = preflight(rig, predict, PreflightPlan(share=0.2))
    assert found.faults == ()
    moved = np.array(rig.commands) - np.clip(0.0, *rig.limits.T)
    farthest = moved[np.abs(moved).argmax(axis=0), range(3)]
    np.testing.assert_allclose(farthest, tried)


@pytest.mark.parametrize(("noise_mm", "still"), [(0.79, 0), (0.81, 3)])
def test_a_motion_that_noise_alone_may_make_is_none(noise_mm, still):
    """4 mm as predicted; five standard errors are 3.95 mm, or 4.05 mm."""
    at = np.zeros((4, 2, 3))
    at[:, 1, 2] = 70.0
    at[1:, 1] += 4.0 * np.array([[1, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]])
    faults = judge(at, at, noise_mm).faults
    assert len(faults) == still
    assert all(f"chamber {i} moves the tip by 4.00 mm" in text for i, text in enumerate(faults, 1))


def test_a_tip_that_is_not_seen_is_said():
    seen = np.ones((4, 5, 3))
    seen[:, -1] = np.nan
    assert judge(seen, np.ones((4, 5, 3)), 0.0).faults == ("the key point of the tip is not seen",)


def test_another_number_of_chambers_is_one_line(predict):
    with pytest.raises(InputError, match=r"gives key points of shape \(4, 4, 3\), expected"):
        preflight(VirtualRig(0), lambda pressures: predict(pressures)[:, :4])


def test_collect_goes_on_only_if_the_check_passes(tmp_path, capsys, monkeypatch):
    out = tmp_path / "r.parquet"
    command = [
        "collect",
        "walk",
        "--points",
        "24",
        "-o",
        str(out),
        "--preflight",
        "--arm",
        "default",
    ]
    swapped = "tests.rig.test_preflight:Faulty:tubes=1/0/2"
    monkeypatch.setattr(Faulty.__init__, "__annotations__", {"tubes": tuple[int, ...]})
    assert run([*command, "--rig", swapped]) == 2
    assert "tubes are swapped" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert run([*command, "--rig", "virtual"]) == 2
    assert "--preflight is for real rigs" in capsys.readouterr().err
    assert run(["rig", "check", "virtual:seed=2"]) == 0
    assert "the arm moves as predicted" in capsys.readouterr().out
