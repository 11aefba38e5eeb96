"""Bands, components and delays against numbers by hand; the page and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.diagnosis.compare import compare, time_shift
from surgisoft.diagnosis.error_axes import bands
from surgisoft.diagnosis.pages.compare import DRAWN_SHARE
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.measurement.recordings import save_recording
from surgisoft.surrogate.checkpoint import save_model
from tests.diagnosis.synthetic import NOISE_MM, POINTS, recording, still_model, walk
from tests.report.browser import chromium, look


def test_bias_is_measured_less_predicted_in_the_bodys_frame():
    """A straight arm along z: along is z, in plane x and out of plane y by convention."""
    made = recording(np.zeros(400), walk(400))
    made.key_points_mm[:] += [0.3, -0.2, 0.5]
    found = [band for band in bands(problem_of(still_model(), [made])) if band.axis == "p1"]
    for band in found:
        assert band.bias_mm == pytest.approx((0.5, 0.3, -0.2), abs=0.03)
        for value, (low, high) in zip(band.bias_mm, band.bias_ci95_mm, strict=True):
            assert low <= value <= high
        assert band.rmse_mm == pytest.approx(np.sqrt(0.38 + 3 * NOISE_MM**2), rel=0.05)
    result, _ = compare(still_model(), [made])
    expected = np.sqrt(np.square([0.5, 0.3, 0.2]) + NOISE_MM**2)
    assert list(result.components_mm.values()) == pytest.approx(expected, rel=0.03)


def test_every_row_falls_into_one_band_of_each_axis():
    found = bands(problem_of(still_model(), [recording(np.zeros(500), walk(500))]))
    totals = {}
    for band in found:
        totals[band.axis] = totals.get(band.axis, 0) + band.samples
    assert {"p1", "p2", "rate 2", "dwell", "since reversal 1", "elapsed time"} <= set(totals)
    for axis in ("p1", "rate 1", "dwell", "elapsed time", "past actuation 2"):
        assert totals[axis] == 500, axis
    assert totals["arc length"] == 3 * 500


def test_rows_that_share_the_least_dwell_keep_the_rest_apart():
    dwell = [b for b in bands(problem_of(still_model(), [recording(np.zeros(800), walk(800))]))
             if b.axis == "dwell"]  # fmt: skip
    assert len(dwell) > 4
    assert dwell[0].low == 0


def test_a_late_arm_is_told_its_delay():
    """The model follows a circle, the arm the same 0.25 s later."""
    problem = problem_of(still_model(), [recording(np.zeros(1000), walk(1000))])
    rest = problem.table

    def circle(t):
        side = 10 * np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
        return POINTS + side[:, None]

    rest = replace(rest, predicted_mm=circle(rest.t_s), measured_mm=circle(rest.t_s - 0.25).copy())
    shift = time_shift(rest, problem.block_of_row)
    # Least squares on the tangent of a circle: sin(delay).
    assert shift.seconds == pytest.approx(np.sin(0.25), rel=0.01)
    assert shift.ci95_s == pytest.approx((shift.seconds, shift.seconds))


def test_a_delay_is_that_within_runs():
    """Runs of 25 rows that each begin elsewhere: what lies between two of them is no motion.

    Along x at 10 mm/s, the arm 0.1 s late; from run to run the prediction jumps by 500 mm.
    """
    runs = [recording(np.zeros(25), walk(25), seed=k) for k in range(20)]
    problem = problem_of(still_model(), runs)
    table = problem.table
    along = table.t_s + 50.0 * (table.recording % 2)
    predicted = POINTS + 10.0 * along[:, None, None] * np.array([1.0, 0.0, 0.0])
    late = replace(table, predicted_mm=predicted, measured_mm=predicted - [1.0, 0.0, 0.0])
    shift = time_shift(late, problem.block_of_row)
    assert shift.seconds == pytest.approx(0.1, rel=1e-6)


def test_command_says_the_verdict_first_and_writes_all(tmp_path, capsys):
    pressure = walk(300)
    save_model(still_model(), tmp_path / "model")
    save_recording(recording(0.2 * pressure[:, 0], pressure), tmp_path / "made.parquet")
    arguments = ["compare", str(tmp_path / "model"), str(tmp_path / "made.parquet")]
    out = [tmp_path / "all.json", tmp_path / "report", tmp_path / "both.rrd"]
    options = ["--json", str(out[0]), "--report", str(out[1]), "--replay", str(out[2])]
    assert run([*arguments, *options]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("error 0.")
    assert "it depends most on pressure" in lines[0]
    assert len(lines) < 25
    values = json.loads(out[0].read_text())
    assert values["sentence"] == lines[0]
    assert values["axes"][0]["axis"] == "pressure"
    assert values["best_achievable_mm"] < values["rmse_mm"]
    assert values["floor_mm"] == pytest.approx(np.sqrt(3) * NOISE_MM)
    assert out[2].read_bytes()[:4] == b"RRF2"
    text = (out[1] / "report.html").read_text()
    assert text.index("depends most on pressure") < text.index("<section")
    assert text.count("data:image/png") == 3
    telling = [axis for axis in values["axes"] if axis["share"] >= DRAWN_SHARE]
    assert text.count("data:image/svg+xml") == len(telling) + 1  # and one along the arm
    with chromium() as browser:
        for width in (1280, 400):
            overflow, asked, broken, _ = look(browser, out[1] / "report.html", width)
            assert overflow <= 0
            assert asked == []
            assert broken == 0


def test_command_refuses_a_wrong_replay_before_the_work(tmp_path, capsys):
    code = run(["compare", "no_model", "no_recording", "--replay", str(tmp_path / "both.mp4")])
    assert code == 2
    assert "suffix '.mp4', expected .rrd" in capsys.readouterr().err
