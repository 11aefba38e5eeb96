"""Residuals of known cause depend most on the axis that physics says."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis import diagnose as diagnosing
from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.diagnose import Diagnosis, ErrorLevels, Verdict
from surgisoft.diagnosis.error_axes import (
    AXES,
    AxisShare,
    bands,
    gravity_angle,
    known,
    lag,
    shares,
)
from surgisoft.diagnosis.pages.compare import compare_page
from surgisoft.diagnosis.residuals import problem_of, residual_table
from surgisoft.report.page import render
from tests.diagnosis.synthetic import (
    POINTS,
    backlash,
    recording,
    relaxation,
    resting_together,
    still_model,
    walk,
)

ROWS = 2000
SLOPE = 0.1 * np.arange(ROWS) / ROWS


def shift(u):
    """The tip is 0.3 s late: u(t) - u(t - 0.3 s), for u = chamber 1."""
    return 0.8 * (np.concatenate([np.repeat(u[:1, 0], 3), u[:-3, 0]]) - u[:, 0])


CAUSES = {
    "gain": (walk, lambda u: 0.15 * (u[:, 0] - 5), {"pressure"}),
    "lag": (walk, shift, {"rate", "lag"}),
    "creep in motion": (
        walk,
        lambda u: 0.3 * (u[:, 0] - relaxation(u[:, 0], 20.0)),
        {"past actuation"},
    ),
    "settling at rest": (
        resting_together,
        lambda u: 0.5 * -np.expm1(-0.1 * _rested(u) / 6.0),
        {"dwell", "past actuation"},
    ),
    "backlash": (
        walk,
        lambda u: 0.3 * (u[:, 0] - backlash(u[:, 0], 0.8)),
        {"direction", "since reversal"},
    ),
    "drift": (walk, lambda u: 8.0 * SLOPE * u[:, 1] / 5, {"elapsed time"}),
}


def _rested(u):
    """(T,) rows since the actuation last changed."""
    changed = (np.diff(u, axis=0, prepend=u[:1]) != 0).any(1)
    rows = np.arange(len(u))
    return rows - np.maximum.accumulate(np.where(changed, rows, 0))


@pytest.mark.parametrize("name", CAUSES)
def test_the_axis_of_the_cause_comes_first(name):
    schedule, cause, expected = CAUSES[name]
    pressure = schedule(ROWS, seed=4)
    effect = cause(pressure)
    found = shares(problem_of(still_model(), [recording(effect - effect.mean(), pressure)]))
    first = found[0] if "pressure" in expected else next(a for a in found if not a.static)
    assert first.axis in expected
    assert first.ci95[0] > 0.05


def test_a_chart_of_an_axis_shows_its_share_and_the_slope_of_its_cause():
    """A gain of chamber 1 of 0.15 mm/kPa at the tip; the bands' falls add up to the share."""
    pressure = walk(ROWS, seed=4)
    problem = problem_of(still_model(), [recording(0.15 * (pressure[:, 0] - 5), pressure)])
    found = {each.axis: each for each in shares(problem)}
    total = np.square(problem.table.error_mm).mean()
    for name in ("pressure", "lag", "past actuation"):
        for profile in found[name].profiles:
            falls = np.square(profile.without_mm) - np.square(profile.left_mm)
            fall = np.average(falls, weights=profile.rows)
            assert fall / total == pytest.approx(found[name].share, abs=0.03), profile.column
    one, other = found["pressure"].profiles[:2]
    assert (one.column, other.column) == ("p1", "p2")
    assert np.polyfit(one.middle, one.shift_mm, 1)[0] == pytest.approx(0.15, rel=0.05)
    assert np.ptp(other.shift_mm) < 0.5 * np.ptp(one.shift_mm)
    assert all(
        low <= mean <= high
        for mean, (low, high) in zip(one.shift_mm, one.shift_ci95_mm, strict=True)
    )


def test_softening_goes_with_the_largest_actuation_so_far():
    """Fifteen runs, each up to another level: the largest so far starts afresh in each."""
    run = np.repeat(np.arange(15), 150)
    reach = np.random.default_rng(2).uniform(0.3, 1.0, 15)[run]
    pressure = walk(len(run), seed=4) * reach[:, None]
    largest = [np.maximum.accumulate(pressure[run == name, 0]) for name in range(15)]
    made = recording(0.2 * (np.concatenate(largest) - 6), pressure, run=run)
    result, _ = compare(still_model(), [made])
    assert next(each for each in result.axes if not each.static).axis == "largest so far"
    assert "on largest so far" in result.sentence


def test_temperature_explains_what_goes_along_with_it():
    pressure = walk(ROWS)
    warm = 24 + 3 * np.sin(np.arange(ROWS) / 170)
    made = recording(0.2 * (warm - 24), pressure, temp_C=warm)
    first = shares(problem_of(still_model(), [made]))[0]
    assert first.axis == "temperature"
    assert first.share > 0.6


def test_noise_depends_on_nothing():
    made = recording(np.zeros(ROWS), walk(ROWS))
    result, _ = compare(still_model(), [made])
    assert all(each.share < 0.02 for each in result.axes)
    assert result.main_axes == []
    assert "is at the floor" in result.sentence


def test_axes_without_values_are_left_out():
    """A still model has no azimuth; settled points no time; nobody measured a temperature."""
    settled = recording(np.zeros(200), walk(200), kind="settled")
    names = set(known(residual_table(still_model(), [settled])))
    assert names == {"pressure", "direction", "since reversal", "elapsed time", "largest so far"}
    timed = set(known(residual_table(still_model(), [recording(np.zeros(200), walk(200))])))
    assert timed == names | {"rate", "lag", "past actuation", "dwell"}
    assert timed < set(AXES)


def test_angle_to_the_weight():
    """A body that bends to where the weight pulls is at 0 degrees, to its left at +90."""
    pressure = walk(20)
    for bend, angle in (((3.0, 0.0), 0.0), ((0.0, 3.0), 90.0), ((-3.0, 1e-9), 180.0)):
        points = POINTS.copy()
        rest = residual_table(
            still_model(), [recording(np.zeros(20), pressure, gravity=np.array([0.6, 0.0, 0.8]))]
        )
        points[-1, :2] += bend
        rest.predicted_mm[:] = points
        assert gravity_angle(rest) == pytest.approx(np.full(20, angle), abs=1e-6)


def test_a_weight_along_the_arm_has_no_side():
    """A twentieth of the weight pulls sideways: less than tells a side."""
    down = np.array([0.05, 0.0, np.sqrt(1 - 0.05**2)])
    table = residual_table(still_model(), [recording(np.zeros(20), walk(20), gravity=down)])
    table.predicted_mm[:, -1, 0] += 3.0
    assert np.isnan(gravity_angle(table)).all()


def test_the_lag_is_what_the_low_pass_has_not_reached_yet():
    """After a step of 6 from rest 6 exp(-t / 0.5 s), and as much below it after the way back."""
    pressure = np.zeros((120, 2))
    pressure[40:80, 0] = 6.0
    table = residual_table(still_model(), [recording(np.zeros(120), pressure)])
    found = lag(table)[:, 0]
    assert found[:40] == pytest.approx(0.0, abs=1e-6)
    waited = np.exp(-0.1 * np.arange(10) / 0.5)
    assert found[45:55] / found[45] == pytest.approx(waited, rel=1e-4)
    assert 6.0 * np.exp(-1.2) < found[45] < 6.0 * np.exp(-1.0)
    assert found[80:120] == pytest.approx(-found[40:80], abs=0.01)


def test_bands_of_a_direction_are_the_rows_that_rise_and_those_that_fall():
    """50 rows at rest, 100 up and 100 down, in which the tip is 2 mm aside: one point of three."""
    up = np.linspace(0.0, 10.0, 101)[1:]
    one = np.concatenate([np.zeros(50), up, up[::-1]])
    effect = np.concatenate([np.zeros(152), np.full(98, 2.0)])
    made = recording(effect, np.stack([one, one], axis=1))
    found = [b for b in bands(problem_of(still_model(), [made])) if b.axis == "direction 1"]
    assert [band.label for band in found] == ["rising", "falling"]
    rising, falling = found
    assert rising.samples == pytest.approx(101, abs=3)
    assert falling.samples == pytest.approx(98, abs=3)
    assert rising.rmse_mm < 0.2
    assert falling.rmse_mm == pytest.approx(2.0 / np.sqrt(3), rel=0.03)


def test_bands_along_the_arm_are_named_by_their_way_from_the_base():
    """The key points of a straight arm are 5, 30 and 70 mm from the base, the last one 2 mm off."""
    made = recording(np.full(200, 2.0), walk(200))
    found = [b for b in bands(problem_of(still_model(), [made])) if b.axis == "arc length"]
    assert [band.label for band in found] == ["5 mm", "30 mm", "70 mm"]
    assert [(band.low, band.high) for band in found] == [(5.0, 5.0), (30.0, 30.0), (70.0, 70.0)]
    assert [band.rmse_mm for band in found] == pytest.approx([0.09, 0.09, 2.0], rel=0.1)


def test_where_actuation_explains_nothing_memory_is_judged_by_the_error_itself():
    """Of noise a regression on the actuation leaves more than there was, held out."""
    problem = problem_of(still_model(), [recording(np.zeros(600), walk(600))])
    square = np.square(problem.table.error_mm).mean()
    profile = next(each for each in shares(problem) if each.axis == "rate").profiles[0]
    without = np.average(np.square(profile.without_mm), weights=profile.rows)
    assert without == pytest.approx(square, rel=1e-6)


@pytest.mark.parametrize(("chambers", "points"), [(1, POINTS[-1:]), (6, POINTS), (4, POINTS[1:])])
def test_any_number_of_chambers_and_key_points(chambers, points):
    pressure = walk(600, chambers)
    made = recording(0.2 * pressure[:, -1], pressure, points)
    made.key_points_mm[::7, -1] = np.nan
    result, rest = compare(still_model(chambers, points), [made])
    assert rest.body_mm.shape == (600, len(points), 3)
    assert result.axes[0].axis == "pressure"
    assert result.best_achievable.rmse_mm < 0.6 * result.rmse_mm


@pytest.mark.parametrize(
    ("share", "low", "named"), [(0.3, 0.2, True), (0.004, 0.001, False), (0.3, -0.1, False)]
)
def test_a_diagnosis_names_an_axis_that_is_clear(monkeypatch, share, low, named):
    found = [AxisShare("pressure", "", "kPa", share, (low, 2 * share), True)]
    monkeypatch.setattr(diagnosing, "shares", lambda problem: found)
    verdict = Verdict("unknown_effect", (), "the cause is unknown")
    before = Diagnosis(verdict, ErrorLevels(1.0, 0.1, 0.5), ())
    result = diagnosing.with_axis(before, None)
    assert result.axis == ("pressure" if named else None)
    more = "; the error depends most on pressure (30 %)" if named else ""
    assert result.verdict.sentence == "the cause is unknown" + more


@pytest.mark.parametrize(("unit", "word"), [("ml", "actuation"), ("bar", "pressure")])
def test_only_pressures_are_called_pressure(unit, word):
    """Volumes of syringes in ml are none: in the sentence, in the summary of the model and in all
    charts and tables of the page. Only fields for programs keep their name."""
    moved = walk(600)
    made = replace(recording(0.3 * (moved[:, 0] - 5), moved), unit=unit)
    model = still_model()
    model = model.replace(spec=replace(model.spec, unit=unit)).eval()
    result, table = compare(model, made)
    assert result.axes[0].axis == "pressure"
    assert f"it depends most on {word} (" in result.sentence
    assert f"({word})" in model.summary()
    page = compare_page(result, table, "two segments", model.summary())
    text = render(page)
    other = {"actuation": "pressure", "pressure": "actuation"}[word]
    assert f"what {word} explains of the error" in text
    assert f"{other} [{unit}]" not in text
    assert word == "pressure" or "pressure" not in text
