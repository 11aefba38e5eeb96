"""How sure the study of intervals is of a coverage that it counted."""

import pytest

import surgisoft.cli
from benchmarks import intervals
from benchmarks.intervals import SETTINGS, Case, Covered, Outcome, cases, coverage_interval

OWN = next(each for each in SETTINGS if each.law == "own")
RIG = next(each for each in SETTINGS if each.law == "rig" and each.effect != "clean")


def outcomes(setting, robots, holding):
    """One recording each: of how many of its three quantities the intervals hold."""
    return [
        Outcome(
            Case(setting, robot, take),
            tuple(Covered(str(k), 0.0, -1.0, 1.0, 0.0 if k < hold else 2.0) for k in range(3)),
            True,
            0.1,
            None,
        )
        for take, (robot, hold) in enumerate(zip(robots, holding, strict=True))
    ]


def test_recordings_that_err_as_one_are_one_value_each():
    """23 of 24 recordings: Clopper and Pearson's interval of 23 of 24, not of 69 of 72."""
    some = outcomes(OWN, [1, 2, 3, 4] * 6, [3] * 23 + [0])
    low, high = coverage_interval(some)
    assert low == pytest.approx(0.7888, abs=2e-4)
    assert high == pytest.approx(0.9989, abs=2e-4)


def test_quantities_that_err_on_their_own_count_each():
    """Four of 72 that miss, each in another recording: the interval of 68 of 72."""
    low, high = coverage_interval(outcomes(OWN, [1, 2, 3, 4] * 6, [2] * 4 + [3] * 20))
    assert low == pytest.approx(0.8638, abs=2e-4)
    assert high == pytest.approx(0.9847, abs=2e-4)


def test_the_network_of_a_robot_is_one_value_however_often_it_is_recorded():
    """All hold on four networks: 0.025 ** (1 / 4). With a network for each recording, of 24."""
    assert coverage_interval(outcomes(RIG, [1, 2, 3, 4] * 6, [3] * 24)) == pytest.approx(
        (0.025**0.25, 1.0)
    )
    assert coverage_interval(outcomes(OWN, [1, 2, 3, 4] * 6, [3] * 24)) == pytest.approx(
        (0.025 ** (1 / 24), 1.0)
    )
    assert coverage_interval(outcomes(RIG, [1, 2], [0, 0])) == pytest.approx((0.0, 1 - 0.025**0.5))


def test_only_leaves_out_settings_without_a_word_in_their_name(monkeypatch, tmp_path):
    """The cases left are those of the whole study: their takes do not change."""
    asked = []
    monkeypatch.setattr(intervals, "run", lambda some, *rest: asked.extend(some) or [])
    arguments = ["benchmark", "intervals", "--robots", "7", "--count", "2", "--clean", "1"]
    folder = ["--work", str(tmp_path), "-o", str(tmp_path / "page.md")]
    assert surgisoft.cli.run([*arguments, "--only", "creep, threefold", *folder]) == 0
    expected = [case for case in cases(2, 1, (7,)) if case.setting.effect in ("creep", "payload")]
    assert asked == [case for case in expected if case.setting.law == "own"]
    assert '--only "creep, threefold"' in (tmp_path / "page.md").read_text()


def test_only_knows_the_settings(capsys):
    assert surgisoft.cli.run(["benchmark", "intervals", "--only", "creeep"]) == 2
    assert "--only creeep: no setting has this in its name" in capsys.readouterr().err
