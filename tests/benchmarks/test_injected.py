"""Injected effects: the rod and the laws against closed forms, the cases against their truth."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.cache import Cache
from benchmarks.injected import study
from benchmarks.injected.cases import (
    ROBOTS,
    SCALE_TOLERANCE,
    Case,
    bench_of,
    cases_of,
    inject,
    make_case,
    rms_mm,
    running_time,
)
from benchmarks.injected.laws import LAWS, UNKNOWN, Arm, points_of
from benchmarks.injected.rod import (
    PIECES,
    Rod,
    Support,
    Weight,
    balanced,
    fit_rod,
    key_points,
    turned,
)
from benchmarks.injected.study import CaseFolder, Judged, find_cases, judge, model_of
from benchmarks.injected.study import markdown as cases_table
from benchmarks.real.entries import FitOptions
from benchmarks.real.study import Answer, fitted
from surgisoft.cli import run
from surgisoft.measurement.recordings import Recording, load_recording, save_recording
from surgisoft.progress import silent
from surgisoft.surrogate.checkpoint import save_model
from surgisoft.surrogate.effects import EFFECTS

LENGTH = 200.0
STRAIGHT = Rod(
    lengths_mm=np.array([120.0, 80.0]),
    base=np.zeros(3),
    bend=np.zeros((2, 2, 3)),
    rest=np.zeros((2, 2)),
    stretch=np.zeros((2, 3)),
    based=True,
)
ROUND = replace(
    STRAIGHT,
    bend=np.array([[[0.004, -0.002, -0.002], [0.0, 0.0035, -0.0035]]] * 2),
    stretch=np.full((2, 3), 0.03),
    rest=np.array([[1e-4, 0.0], [0.0, 1e-4]]),
)
"""Three chambers in a ring."""


def along(rod: Rod, loads: np.ndarray, unit: str = "kPa") -> Arm:
    """A rod along loads at 25 Hz, one run."""
    time = 0.04 * np.arange(len(loads))
    down = np.array([0.0, 0.0, 1.0])
    return Arm(rod, time, np.array([0, len(loads)]), loads, unit, 50.0, down)


@pytest.fixture(scope="module")
def arm() -> Arm:
    """The round rod along 24 s of loads between 0 and 1."""
    time = 0.04 * np.arange(600)
    periods, phases = (4.0, 6.3, 9.1), (0.0, 1.0, 2.5)
    waves = [np.sin(2 * np.pi * time / p + f) for p, f in zip(periods, phases, strict=True)]
    return along(ROUND, 0.5 + 0.45 * np.stack(waves, axis=1))


# Rod -------------------------------------------------------------------------------------------


def test_a_bent_rod_is_an_arc_of_a_circle():
    curvature = 0.006
    strains = np.zeros((1, 2, 4))
    strains[..., 1] = curvature  # about y: towards x
    points = key_points(STRAIGHT, balanced(STRAIGHT, strains))[0]
    angle = curvature * np.array([0.0, 120.0, 200.0])
    arc = np.stack([1 - np.cos(angle), 0 * angle, np.sin(angle)], axis=1) / curvature
    assert points == pytest.approx(arc, abs=1e-9)


def test_a_cantilever_under_a_small_load():
    """Euler and Bernoulli: w(s) = F s^2 (3 L - s) / (6 B)."""
    force = 0.03 / LENGTH**2
    push = Weight(np.array([force, 0.0, 0.0]), 2 * PIECES)
    shape = balanced(STRAIGHT, np.zeros((1, 2, 4)), push)
    place = np.array([0.0, 120.0, 200.0])
    wanted = force * place**2 * (3 * LENGTH - place) / 6
    assert key_points(STRAIGHT, shape)[0, :, 0] == pytest.approx(wanted, rel=0.01, abs=1e-6)


def test_a_support_yields_as_its_spring():
    """A tip pushed d deep into a spring of k = share / compliance: share d / (1 + share) back."""
    strains = np.zeros((1, 2, 4))
    strains[..., 1] = 1e-3
    free = balanced(STRAIGHT, strains).nodes[0, -1, 0]
    support = Support(np.array([1.0, 0, 0]), free - 4.0, 2 * PIECES, share=3.0)
    held = balanced(STRAIGHT, strains, support).nodes[0, -1, 0]
    assert free - held == pytest.approx(3.0, rel=0.05)
    away = replace(support, plane_mm=free + 4.0)
    assert balanced(STRAIGHT, strains, away).nodes[0, -1, 0] == free


def test_a_weight_draws_a_hanging_arm_down(arm):
    heavy = points_of(LAWS["payload"], arm, {}, 0.5)
    assert (heavy[:, -1, 2] >= arm.points()[:, -1, 2] - 1e-3).all()
    assert (heavy[:, -1, 2] - arm.points()[:, -1, 2]).max() > 1.0


def test_a_rod_is_found_again(arm):
    rng = np.random.default_rng(0)
    rod, error = fit_rod(arm.loads, arm.points() + rng.normal(0, 0.05, (600, 3, 3)))
    assert rod.based
    assert error < 0.25
    assert rod.lengths_mm == pytest.approx(ROUND.lengths_mm, rel=0.02)


def test_rotations_are_those_of_rodrigues():
    vector = np.array([0.3, -0.2, 0.5])
    found = turned(vector)
    assert found @ found.T == pytest.approx(np.eye(3))
    assert found @ vector == pytest.approx(vector)
    assert np.trace(found) == pytest.approx(1 + 2 * np.cos(np.linalg.norm(vector)))
    assert turned(np.zeros(3)) == pytest.approx(np.eye(3))


# Laws ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LAWS)
def test_no_strength_is_no_effect(arm, name):
    law = LAWS[name]
    drawn = law.draw(arm, np.random.default_rng(3))
    plain = arm.points()
    assert np.array_equal(points_of(law, arm, drawn, 0.0), plain)
    little = points_of(law, arm, drawn, 0.01 * law.most) - plain
    much = points_of(law, arm, drawn, 0.5 * law.most) - plain
    assert np.sqrt(np.mean(little**2)) < 0.3 * np.sqrt(np.mean(much**2))
    assert np.sqrt(np.mean(much**2)) > 0.3


def test_truths_are_effects_of_the_catalogue():
    assert {law.truth for law in LAWS.values()} <= {*EFFECTS, UNKNOWN}
    assert all(law.truth in (name, UNKNOWN) for name, law in LAWS.items())


def step(rows: int) -> np.ndarray:
    """Loads (rows, 3) of the first chamber that are 0 in the first row and 1 from then on."""
    loads = np.zeros((rows, 3))
    loads[1:, 0] = 1.0
    return loads


ONE = replace(ROUND, bend=ROUND.bend * [1, 0, 0], rest=np.zeros((2, 2)), stretch=np.zeros((2, 3)))
"""Only the first chamber moves it."""


def bending(arm: Arm, points: np.ndarray) -> np.ndarray:
    """(T,) angle of the tip, rad, from the key points of a rod that is bent to an arc."""
    return 2 * np.arctan2(np.linalg.norm(points[:, -1, :2], axis=1), points[:, -1, 2])


def test_creep_after_a_step_is_a_power_of_time():
    arm = along(ONE, step(500))
    points = points_of(LAWS["creep"], arm, {"power": 0.4}, 0.1)
    since = arm.t_s[100:] - 0.5 * (arm.t_s[0] + arm.t_s[1])
    found = bending(arm, points)[100:] / bending(arm, arm.points())[100:]
    assert found == pytest.approx(1 + 0.1 * (since / 10) ** 0.4, rel=2e-3)


def test_a_dashpot_of_eyring_against_an_integrator():
    arm = along(ONE, step(100))
    points = points_of(LAWS["rate_dependence"], arm, {"share": 0.6, "stress": 0.1}, 0.5)
    found = 1 - bending(arm, points)[1:] / bending(arm, arm.points())[1:]
    lack = solve_ivp(
        lambda t, d: -0.1 / 0.5 * np.sinh(d / 0.1),
        (0.0, 4.0),
        [1.0],
        t_eval=arm.t_s[1:],
        method="Radau",
        rtol=1e-8,
    )
    assert found[10:] == pytest.approx(0.6 * lack.y[0][10:], abs=0.02)


def test_a_servo_of_limited_speed_in_closed_form():
    """d' = -v tanh(d / (v tau)) has sinh(d / (v tau)) = sinh(d_0 / (v tau)) exp(-t / tau)."""
    arm = along(ONE, step(100), unit="deg")
    points = points_of(LAWS["line_lag"], arm, {}, 0.3)
    gap = 1 - bending(arm, points) / bending(arm, arm.points())[-1]
    wanted = 0.5 * np.arcsinh(np.sinh(1 / 0.5) * np.exp(-arm.t_s / 0.3))
    assert gap[1:] == pytest.approx(wanted[1:], abs=0.03)


def test_choked_flow_is_in_proportion_to_time():
    """Emptying from a high pressure: p' = -p / (2 tau), as long as the flow is choked."""
    loads = np.zeros((50, 3))
    loads[0, 0] = 1.0
    arm = replace(along(ONE, loads), span=1000.0)
    points = points_of(LAWS["line_lag"], arm, {}, 2.0)
    high = bending(arm, arm.points())[0]
    pressure = 1000.0 * bending(arm, points) / high + 101.3
    wanted = 1101.3 * np.exp(-arm.t_s / 4.0)
    choked = 101.3 / wanted < 0.3
    assert choked.sum() > 20
    assert pressure[choked] == pytest.approx(wanted[choked], rel=0.01)


def test_hysteresis_does_not_depend_on_speed_and_takes_work(arm):
    drawn = {"yield": 0.2, "beta": 0.5}
    slow = replace(arm, t_s=10 * arm.t_s)
    law = LAWS["hysteresis"]
    fast_points = points_of(law, arm, drawn, 0.5)
    assert points_of(law, slow, drawn, 0.5) == pytest.approx(fast_points)
    time = np.linspace(0, 4 * np.pi, 800)
    loads = np.zeros((800, 3))
    loads[:, 0] = 0.5 - 0.5 * np.cos(time)
    cycle = along(ONE, loads)
    angle = bending(cycle, points_of(law, cycle, drawn, 0.5))[400:]
    area = np.sum(0.5 * (angle[1:] + angle[:-1]) * np.diff(loads[400:, 0]))
    assert area < -0.01  # the bending lags behind the load


def test_limited_chains_solve_their_equation():
    loads = np.zeros((11, 3))
    loads[:, 0] = np.linspace(0, 1, 11)
    arm = along(ONE, loads)
    found = (
        bending(arm, points_of(LAWS["stiffening"], arm, {}, 0.8)) / (bending(arm, arm.points())[-1])
    )
    assert found / (1 - 0.8**2 * found**2) == pytest.approx(loads[:, 0], abs=1e-6)


def test_softening_acts_below_the_largest_load_only():
    loads = np.zeros((60, 3))
    loads[:, 0] = np.concatenate([np.linspace(0, 1, 30), np.linspace(1, 0.2, 30)])
    arm = along(ONE, loads)
    found = bending(arm, points_of(LAWS["softening"], arm, {}, 0.3))
    free = bending(arm, arm.points())
    assert found[:30] == pytest.approx(free[:30])
    assert found[30:] / free[30:] == pytest.approx(np.exp(0.3 * np.sqrt(1 - loads[30:, 0])))


def test_a_frame_that_is_turned_keeps_all_distances(arm):
    drawn = LAWS["misalignment"].draw(arm, np.random.default_rng(0))
    points = points_of(LAWS["misalignment"], arm, drawn, 0.1)
    plain = arm.points()
    apart = [np.linalg.norm(p[:, 2] - p[:, 1], axis=1) for p in (points, plain)]
    assert apart[0] == pytest.approx(apart[1])


# Cases -----------------------------------------------------------------------------------------


def recorded(arm: Arm, seed: int) -> Recording:
    """A recording of the arm in two runs, with noise of 0.1 mm and a key point missing at times."""
    rng = np.random.default_rng(seed)
    points = arm.points() + rng.normal(0, 0.1, (len(arm.t_s), 3, 3))
    points[::7, 1] = np.nan
    run = (np.arange(len(arm.t_s)) >= 300).astype(int)
    measured = 50.0 * arm.loads
    gravity = np.array([0.0, 0.0, 1.0])
    return Recording("made up", arm.t_s, measured, points, run=run, gravity=gravity)


@pytest.fixture(scope="module")
def bench(arm):
    """Two recordings of the round rod."""
    later = replace(arm, loads=arm.loads[::-1].copy())
    return bench_of([recorded(arm, 1)], [recorded(later, 2)])


@pytest.mark.parametrize("name", LAWS)
def test_an_injection_has_the_wanted_size(bench, name):
    rng = np.random.default_rng(5)
    found = inject(LAWS[name], bench, bench.after, 1.5, rng)
    again = inject(LAWS[name], bench, bench.after, 1.5, np.random.default_rng(5))
    seen = np.isfinite(bench.after[0].key_points_mm).all(2)
    tolerance = 0.3 if name == "stick_slip" else 2 * SCALE_TOLERANCE
    assert rms_mm(found.change_mm[0], seen) == pytest.approx(1.5, rel=tolerance)
    assert np.array_equal(found.change_mm[0], again.change_mm[0])
    none = inject(LAWS[name], bench, bench.after, 0.0, rng)
    assert not none.change_mm[0].any()


def test_a_written_case(bench, tmp_path):
    case = Case("trunk", 4, ("creep", "payload"), 0.5)
    assert make_case(case, bench, 2.0, 0.1, tmp_path / "a", seed=1)
    assert make_case(case, bench, 2.0, 0.1, tmp_path / "b", seed=1)
    truth = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert truth["truth"] == ["creep", "payload"]
    assert [each["rms_mm"] for each in truth["hidden"]] == pytest.approx([1.0, 1.0], rel=0.03)
    made, same = (load_recording(tmp_path / x / "after" / "after.parquet") for x in "ab")
    assert np.array_equal(made.key_points_mm, same.key_points_mm, equal_nan=True)
    before = bench.after[0]
    change = made.key_points_mm - before.key_points_mm
    seen = np.isfinite(before.key_points_mm).all(2)
    assert np.array_equal(seen, np.isfinite(made.key_points_mm).all(2))
    assert rms_mm(change, seen) == pytest.approx(truth["change_rms_mm"])
    assert np.array_equal(made.measured, before.measured)


def test_a_clean_case_is_the_recording_itself(bench, tmp_path):
    case = Case("trunk", 1, (), 0.0, window=(0.0, 0.5))
    assert make_case(case, bench, 2.0, 0.1, tmp_path, seed=1)
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert (truth["truth"], truth["hidden"], truth["change_rms_mm"]) == ([], [], 0.0)
    made = load_recording(tmp_path / "after" / "after.parquet")
    assert np.array_equal(made.key_points_mm, bench.after[0].key_points_mm[:300], equal_nan=True)


def test_an_effect_that_the_motion_cannot_show_is_left_out(bench, tmp_path):
    case = Case("trunk", 1, ("gain_mismatch",), 1.0)
    assert not make_case(case, bench, 500.0, 0.1, tmp_path / "case", seed=1)
    assert not (tmp_path / "case").exists()


def test_the_plan_follows_its_seed():
    for name in ROBOTS:
        assert cases_of(name, 1) == cases_of(name, 1)
        assert cases_of(name, 1) != cases_of(name, 2)
        assert len({case.name for case in cases_of(name, 1)}) == len(cases_of(name, 1))
    every = [case for name in ROBOTS for case in cases_of(name, 1)]
    assert 60 <= len(every) <= 120
    assert {name for case in every for name in case.effects} == set(LAWS)


def test_the_clock_goes_on_through_runs(arm):
    recording = recorded(arm, 1)
    again = replace(recording, t_s=np.concatenate([arm.t_s[:300], arm.t_s[:300]]))
    assert running_time(again)[[0, 299, 300]] == pytest.approx([0.0, 11.96, 71.96])


# Diagnoses of case folders ---------------------------------------------------------------------


def written_cases(bench, folder) -> None:
    """A robot of name `trunk` with two cases of a turned frame and one without a change."""
    save_recording(bench.before[0], folder / "robots" / "trunk" / "before" / "before.parquet")
    for number, effects in enumerate([("misalignment",), ("misalignment",), ()]):
        case = Case("trunk", number, effects, 3.0)
        assert make_case(case, bench, 1.0, 0.1, folder / "cases" / case.name, seed=1)


def test_cases_are_found_with_their_robot_and_truth(bench, tmp_path):
    written_cases(bench, tmp_path)
    found = find_cases(tmp_path)
    assert [case.truth for case in found] == [("misalignment",), ("misalignment",), ()]
    assert {case.robot for case in found} == {tmp_path / "robots" / "trunk"}
    assert [case.size for case in found] == [3.0, 3.0, 3.0]


def test_bad_folders_of_cases_are_one_line(bench, tmp_path, capsys):
    assert run(["benchmark", "cases", str(tmp_path)]) == 2
    assert "no cases/*/truth.json in this folder" in capsys.readouterr().err
    written_cases(bench, tmp_path)
    assert run(["benchmark", "cases", str(tmp_path), "--only", "creep"]) == 2
    assert "none of 3 cases has it" in capsys.readouterr().err
    (tmp_path / "cases" / "trunk-002-clean" / "truth.json").write_text('{"robot": "other"}')
    assert run(["benchmark", "cases", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "not the truth of a case" in error
    assert error.count("\n") == 1


def test_a_case_is_judged_by_its_robots_model(bench, tmp_path, monkeypatch):
    written_cases(bench, tmp_path)
    quick = FitOptions(inputs="pressure", widths=(16, 16), epochs=20, prior="none")
    model = fitted(bench.before, quick, "measured", Cache(tmp_path / "fits"), silent)
    robot = tmp_path / "robots" / "trunk"
    save_model(model, robot / "model", {})
    assert model_of(robot) == robot / "model"
    turned = judge(find_cases(tmp_path)[0])
    assert turned.answer.validated_mm == pytest.approx(model.validation.rmse_mm)
    assert turned.answer.before_mm > 2.5  # 3 mm were injected, and the training rows hold them
    assert turned.answer.ranking[0] == "misalignment"
    twin, seen = find_cases(tmp_path)[0].without_truth, []
    assert (twin.truth, twin.left_out) == (("unknown",), ("misalignment",))
    monkeypatch.setattr(study, "asked", lambda *given: seen.append(given[3]))
    judge(twin)
    assert seen == [("misalignment",)]
    assert find_cases(tmp_path)[2].without_truth is None


def test_counts_of_judged_cases():
    def judged(truth, kind, names, confidence, left_out=()):
        answer = Answer(kind, names, confidence, names, "", 2.0, 0.1, 1.0, 1.0, 0.1)
        return Judged(CaseFolder(Path("c"), Path("r"), truth, truth, 1.0, left_out), answer)

    table = cases_table(
        [
            judged(("creep",), "identified", ("creep",), 0.99),
            judged(("creep",), "identified", ("drift",), 0.96),
            judged(("creep", "payload"), "several", ("payload", "creep"), 0.9),
            judged(("unknown",), "unknown_effect", ("unknown",), 0.0),
            judged((), "identified", ("drift",), 0.5),
            judged((), "nothing_missing", (), 0.0),
            judged(("unknown",), "unknown_effect", ("unknown",), 0.4, ("creep",)),
            judged(("unknown",), "identified", ("drift",), 0.99, ("creep",)),
        ]
    )
    assert "| a known effect that is no candidate: called unknown | 1 of 2 |  |" in table
    assert "| a known effect that is no candidate: another one named | 1 of 2 |  |" in table
    assert "| right effect first in the ranking | 1 of 2 | .95 |" in table
    assert "| two effects, both named | 1 of 1 | .85 |" in table
    assert "| unknown called unknown | 1 of 1 | .80 |" in table
    assert "| named where nothing changed | 1 of 2 | .02 |" in table
    assert "| confidence >= 0.95 and right | 1 of 2 | .97 |" in table
    assert "| wrong name with confidence >= 0.8 | 1 of 6 | 0 |" in table
