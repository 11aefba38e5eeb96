"""The best achievable error reaches the noise where there is a cause, and nothing beats it."""

import re
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.black_box import black_box
from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.residuals import held_out_rows, problem_of
from surgisoft.diagnosis.selection import best_achievable
from surgisoft.measurement.protocols import make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import load_model
from tests.diagnosis.synthetic import (
    NOISE_MM,
    backlash,
    recording,
    relaxation,
    resting_together,
    still_model,
    walk,
)
from tests.few_effects import choose_among

ROWS = 2000
FLOOR = np.sqrt(3) * NOISE_MM


@pytest.mark.parametrize(
    ("cause", "least"),
    [
        (lambda u: 0.8 * np.sin(u[:, 0] / 2) + 0.05 * u[:, 0] * u[:, 1], 0.97),
        (lambda u: 0.3 * (u[:, 0] - backlash(u[:, 0], 0.8)), 0.8),
        (lambda u: 0.3 * (u[:, 0] - relaxation(u[:, 0], 9.0)), 0.9),
        (lambda u: 0.2 * (u[:, 0] - relaxation(u[:, 0], 0.7)) * u[:, 1], 0.7),
    ],
    ids=["static", "backlash", "creep", "gated lag"],
)
def test_a_cause_is_learned_but_not_the_noise(cause, least):
    pressure = walk(ROWS)
    problem = problem_of(still_model(), [recording(cause(pressure), pressure)])
    before = problem.rmse_mm
    found = best_achievable(problem, black_box(problem), None)
    assert before > 1.6 * FLOOR
    assert found.rmse_mm > 0.98 * FLOOR
    explained = (before**2 - found.rmse_mm**2) / (before**2 - FLOOR**2)
    assert explained > least
    assert found.ci95_mm[0] < found.rmse_mm < found.ci95_mm[1]


def test_noise_is_not_explained():
    """White noise, and noise that neighbouring rows share over two seconds."""
    pressure = walk(ROWS)
    rng = np.random.default_rng(5)
    slow = np.convolve(rng.normal(size=ROWS + 20), np.ones(20) / 20, mode="valid")[:ROWS]
    for effect in (np.zeros(ROWS), slow):
        result, _ = compare(still_model(), [recording(effect, pressure, noise_mm=None)])
        assert result.best_achievable.rmse_mm > 0.9 * result.open_rmse_mm
        assert result.best_achievable.rmse_mm <= result.open_rmse_mm


def bench(hidden: str, seed: int, points: int = 1500):
    """A recording of the virtual rig with one hidden effect."""
    rig = VirtualRig(0, take=seed, hidden=((hidden, 1.5),))
    made, _ = rig.record(make_protocol("mixed", rig.limits, points, seed=seed))
    return made


def gated(rows: int):
    """A recording in one run, without holds, that states no noise."""
    pressure = walk(rows)
    effect = 0.3 * (pressure[:, 0] - relaxation(pressure[:, 0], 9.0))
    return recording(effect, pressure, noise_mm=None)


def resting(rows: int):
    """A recording with holds, that states no noise."""
    pressure = resting_together(rows)
    effect = 0.3 * (pressure[:, 0] - backlash(pressure[:, 0], 0.8))
    return recording(effect, pressure, noise_mm=None)


@pytest.mark.parametrize(
    ("model", "recorded", "source"),
    [
        ("default", lambda: [bench("leak", 5, 500), bench("leak", 6, 400)], "sidecar"),
        (None, lambda: [resting(3000)], "holds"),
        (None, lambda: [gated(1000)], "second differences"),
    ],
    ids=["two recordings of a leak", "noise from holds", "second differences"],
)
def test_compare_and_diagnose_give_one_floor_and_one_best_achievable_error(
    model, recorded, source, monkeypatch
):
    """As both commands are called; nothing that is reported is below it, and the share fits it."""
    choose_among(monkeypatch, "gain_mismatch", "hysteresis", "creep", "payload")
    model, made = still_model() if model is None else load_model(model), recorded()
    found = diagnose(model, made)
    result, table = compare(model, made)
    best = found.error_mm.best_achievable
    assert found.error_mm.before / found.error_mm.validated == pytest.approx(
        found.statistics.error_over_validated
    )
    assert best <= found.error_mm.discrepancy_alone <= 1.01 * found.error_mm.before
    assert result.best_achievable.rmse_mm == best
    assert result.floor.rmse_mm == pytest.approx(found.error_mm.floor, rel=1e-12)
    assert result.floor.source == source
    assert result.open_rmse_mm == found.error_mm.before
    assert table.floor == result.floor
    floor, before = found.error_mm.floor, found.error_mm.before
    assert best <= before
    share = (before**2 - best**2) / (before**2 - floor**2)
    assert result.explainable == pytest.approx(min(share, 1.0))
    assert all(row.heldout_rmse_mm >= best for row in found.ranking)
    remains = re.search(r"([0-9.]+) mm remain|leave about ([0-9.]+) mm", found.verdict.sentence)
    if remains:
        assert float(next(filter(None, remains.groups()))) >= float(f"{best:.3g}")
    # The error itself is that over all rows.
    assert result.samples == sum(each.samples for each in made)
    assert result.rmse_mm == pytest.approx(np.sqrt(np.nanmean(np.square(table.error_mm))))
    assert f"error {result.open_rmse_mm:.2f} mm, best achievable" in result.sentence


def test_rows_that_diagnose_does_not_see_do_not_change_the_best_achievable_error():
    """Held-out rows are off by 5 mm: the error says so; floor, best error and share stay."""
    made = gated(1000)
    points = made.key_points_mm.copy()
    points[held_out_rows([made])] += 5.0
    model = still_model()
    plain, _ = compare(model, [made])
    off, _ = compare(model, [replace(made, key_points_mm=points)])
    assert off.rmse_mm > 3 * plain.rmse_mm
    assert off.open_rmse_mm == plain.open_rmse_mm
    assert off.best_achievable == plain.best_achievable
    assert off.explainable == plain.explainable
    assert off.floor == plain.floor


def test_one_part_is_judged_on_its_own_rows():
    """The held-out rows alone have their own best achievable error, below their own error."""
    result, _ = compare(load_model("default"), [bench("creep", 3)], part="held_out")
    assert result.open_rmse_mm == pytest.approx(result.rmse_mm, rel=0.02)
    assert result.best_achievable.rmse_mm < result.open_rmse_mm
    assert "rows that diagnose uses" not in result.sentence
