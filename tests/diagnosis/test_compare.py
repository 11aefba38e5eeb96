"""Errors by hand, floors of known noise, and the same numbers from the command line."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.design.next_experiment import next_experiment
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.improve import improve
from surgisoft.diagnosis.inputs import open_inputs
from surgisoft.diagnosis.pages.pictures import draw_all
from surgisoft.diagnosis.residuals import noise_of, residual_table
from surgisoft.errors import InputError
from surgisoft.measurement.histories import actuation_noise, arm_spec, history_of, outside_range
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.interval import ErrorInterval
from surgisoft.surrogate.model import ArmModel, Validation
from surgisoft.surrogate.networks import HawNN

POINTS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 30.0], [0.0, 0.0, 70.0]])


def still_model() -> ArmModel:
    """A model that predicts POINTS whatever the pressure."""
    low, high = torch.zeros(2), torch.full((2,), 10.0)
    network = HawNN(low, high, 3, hidden=(4,), directions=False)
    network.scale.zero_()
    network.mean.copy_(torch.tensor(POINTS).flatten())
    spec = ArmSpec(2, 3, (0.0, 0.0), (10.0, 10.0), band=(0.1, 0.1))
    return ArmModel(spec, network, rest_mm=torch.tensor(POINTS)).eval().requires_grad_(False)


def recording(points: np.ndarray, pressure: np.ndarray | None = None, **more) -> Recording:
    rows = len(points)
    if pressure is None:
        pressure = np.stack([np.linspace(0, 10, rows), np.full(rows, 5.0)], 1)
    return Recording(
        name="rec", t_s=0.1 * np.arange(rows), measured=pressure, key_points_mm=points, **more
    )


def test_errors_by_hand():
    """k0 exact, k1 off by a 3-4-5 triangle, the tip off by 12 along z in half of the rows."""
    points = np.tile(POINTS, (4, 1, 1))
    points[:, 1] += [3.0, 4.0, 0.0]
    points[:2, 2, 2] += 12.0
    result, _ = compare(still_model(), [recording(points)])
    assert result.per_key_point_mm == pytest.approx((0.0, 5.0, np.sqrt(72.0)))
    assert result.tip_rmse_mm == pytest.approx(np.sqrt(72.0))
    assert result.rmse_mm == pytest.approx(np.sqrt((0 + 25 + 72) / 3))
    assert result.mse_mm2 == pytest.approx((25 + 72) / 9)
    assert result.samples == 4
    assert result.worst[0].error_mm == pytest.approx(12.0)
    assert result.worst[0].key_point == 2


def test_the_worst_moments_are_apart():
    """Three peaks over several rows each: no two moments of one, within a fiftieth of the rows."""
    rows = np.arange(500)
    points = np.tile(POINTS, (500, 1, 1))
    for peak, size in ((100, 9.0), (250, 7.0), (400, 8.0)):
        points[:, 2, 2] += size * np.clip(1.0 - np.abs(rows - peak) / 8.0, 0.0, None)
    result, _ = compare(still_model(), [recording(points)])
    first = result.worst[:3]
    assert [round(10 * moment.t_s) for moment in first] == [100, 400, 250]
    assert [moment.error_mm for moment in first] == pytest.approx([9.0, 8.0, 7.0])


def test_the_coverage_of_the_models_interval_is_stated():
    """Radii 1, 6 and 10 mm: k0 exact, k1 off by 5, the tip off by 12 in two of four rows."""
    points = np.tile(POINTS, (4, 1, 1))
    points[:, 1] += [3.0, 4.0, 0.0]
    points[:2, 2, 2] += 12.0
    interval = ErrorInterval(
        (0.5, 0.95), ((0.1,) * 3, (1.0, 6.0, 10.0)), (0.0,) * 3, 9, 3, "held-out rows"
    )
    model = still_model().replace(validation=Validation(1.0, interval=interval))
    result, _ = compare(model, [recording(points)])
    assert result.coverage == pytest.approx(10 / 12)
    assert result.to_json()["coverage"] == pytest.approx(10 / 12)
    assert compare(still_model(), [recording(points)])[0].coverage is None


def test_missing_key_points_are_left_out_and_counted():
    points = np.tile(POINTS, (4, 1, 1))
    points[0, 2] = np.nan
    points[1] = np.nan
    points[2, 2, 0] += 2.0
    result, _ = compare(still_model(), [recording(points)])
    assert result.tip_rmse_mm == pytest.approx(np.sqrt((4 + 0) / 2))
    assert (result.samples, result.missing) == (3, 1)
    with pytest.raises(InputError, match="no key point was measured"):
        compare(still_model(), [recording(np.full((3, 3, 3), np.nan))])


def test_bands_split_direction_and_pressure():
    """Error only while chamber 1 falls: its two direction bands must say so."""
    up, down = np.linspace(0, 10, 50), np.linspace(10, 0, 50)
    pressure = np.stack([np.concatenate([up, down]), np.full(100, 5.0)], 1)
    points = np.tile(POINTS, (100, 1, 1))
    points[52:, 2, 0] += 1.5
    result, _ = compare(still_model(), [recording(points, pressure)])
    bands = {(band.axis, band.label): band for band in result.bands}
    assert bands["direction 1", "rising"].rmse_mm < 0.2
    assert bands["direction 1", "falling"].rmse_mm == pytest.approx(1.5 / np.sqrt(3), rel=0.05)
    halves = [band for band in result.bands if band.axis == "p1"]
    assert sum(band.samples for band in halves) == 100


def test_another_arm_is_refused():
    points = np.tile(POINTS, (3, 1, 1))
    with pytest.raises(InputError, match="chambers: 1, but the model has 2"):
        compare(still_model(), [recording(points, np.zeros((3, 1)))])
    with pytest.raises(InputError, match="unit: psi, but the model has kPa"):
        compare(still_model(), [recording(points, unit="psi")])


def test_floor_is_what_the_lab_states_as_a_distance():
    floor = residual_table(
        still_model(), [recording(np.tile(POINTS, (4, 1, 1)), noise_mm=0.1)]
    ).floor
    assert floor.source == "sidecar"
    assert floor.rmse_mm == pytest.approx(np.sqrt(3) * 0.1)


def test_floor_from_holds_finds_the_noise_under_a_drift():
    rng = np.random.default_rng(0)
    rows, levels = 40 * 100, np.repeat(rng.uniform(0, 10, (40, 2)), 100, axis=0)
    drift = 0.01 * (np.arange(rows) % 100)[:, None, None]
    points = POINTS + drift + rng.normal(0, 0.08, (rows, 3, 3))
    measured = levels + rng.normal(0, 0.01, levels.shape)
    floor = residual_table(still_model(), [recording(points, measured, commanded=levels)]).floor
    assert floor.source == "holds"
    assert floor.rmse_mm == pytest.approx(np.sqrt(3) * 0.08, rel=0.1)


def test_floor_is_unknown_rather_than_invented():
    points = np.tile(POINTS, (50, 1, 1))
    assert noise_of([recording(points)])[1] == "unknown"
    assert compare(still_model(), [recording(points)])[0].to_json()["floor_mm"] is None


def test_pressure_noise_from_rests_of_the_command():
    rng = np.random.default_rng(1)
    command = np.repeat(rng.uniform(0, 50, (60, 2)), 20, axis=0)
    measured = command + rng.normal(0, [0.05, 0.2], command.shape)
    noisy = recording(np.tile(POINTS, (1200, 1, 1)), measured, commanded=command)
    assert actuation_noise(noisy) == pytest.approx([0.05, 0.2], rel=0.15)
    spec = arm_spec([noisy])
    assert spec.band[1] == pytest.approx(0.8, rel=0.15)
    assert history_of([noisy]).pressure.shape == (1, 1200, 2)


def test_a_chamber_that_only_shows_noise_is_not_blown_up():
    rng = np.random.default_rng(3)
    measured = np.stack([np.linspace(0, 50, 200), 2 + rng.normal(0, 0.1, 200)], 1)
    spec = arm_spec([recording(np.tile(POINTS, (200, 1, 1)), measured)])
    assert (spec.low[0], spec.high[0]) == (0.0, 50.0)
    assert spec.high[1] - spec.low[1] == pytest.approx(50.0)
    assert (spec.high[1] + spec.low[1]) / 2 == pytest.approx(2.0, abs=0.2)


def test_a_still_chamber_is_ignored_and_its_motion_noted():
    """An input without motion has no learned effect: the model must not make one up."""
    rng = np.random.default_rng(4)
    measured = np.stack([np.linspace(0, 50, 200), 3 + rng.normal(0, 0.02, 200)], 1)
    still = recording(np.tile(POINTS, (200, 1, 1)), measured)
    spec = arm_spec([still])
    assert spec.idle[0] is None
    assert spec.idle[1] == pytest.approx(3.0, abs=0.01)
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    model = ArmModel(spec, HawNN(low, high, 3, hidden=(8,)), rest_mm=torch.tensor(POINTS))
    moved = measured + np.array([0.0, 20.0])
    one, other = (
        model.predict(history_of([recording(still.key_points_mm, values)]))
        for values in (measured, moved)
    )
    assert torch.equal(one, other)
    assert outside_range(spec, [still]) == []
    notes = outside_range(spec, [recording(still.key_points_mm, moved)])
    assert len(notes) == 1
    assert "chamber 2 goes from 22.9" in notes[0]


def test_fast_motion_is_noted_unless_a_change_is_asked_about(monkeypatch):
    """Chamber 1 moves through its range in 2 s, in the fit in 20 s."""
    slow = replace(still_model().spec, speed_per_s=0.05)
    model = ArmModel(slow, still_model().network, rest_mm=torch.tensor(POINTS)).eval()
    fast = recording(np.random.default_rng(0).normal(POINTS, 0.1, (21, 3, 3)))
    before = replace(fast, name="before", key_points_mm=fast.key_points_mm + 1.0)
    (note,) = (text for text in open_inputs(model, [fast])[2] if "as fast as in" in text)
    assert note.startswith("the actuation moves by 50 % of its range in a second, 10 times as fast")
    assert not any("as fast" in text for text in open_inputs(model, [fast], compared=True)[2])

    def told(*_, compared=False, **__):
        raise InputError(f"compared: {compared}")

    for module, asked in (
        ("diagnose", diagnose),
        ("improve", improve),
        ("design.next_experiment", next_experiment),
    ):
        monkeypatch.setattr(f"surgisoft.diagnosis.{module}.open_inputs", told)
        with pytest.raises(InputError, match="compared: False"):
            asked(model, [fast])
        with pytest.raises(InputError, match="compared: True"):
            asked(model, [fast], before=[before])


def test_a_tip_that_was_never_seen_is_null_not_nan():
    points = np.tile(POINTS, (40, 1, 1))
    points[:, 2] = np.nan
    values = compare(still_model(), [recording(points)])[0].to_json()
    assert values["tip_rmse_mm"] is None
    assert values["per_key_point_mm"] == [pytest.approx(0), pytest.approx(0), None]
    json.dumps(values, allow_nan=False)


def test_commanded_actuation_must_be_there():
    with pytest.raises(
        InputError, match="add these columns, or fit a model with --actuation measured"
    ):
        arm_spec([recording(np.tile(POINTS, (3, 1, 1)))], "commanded")


def test_json_is_plain_and_pictures_are_pictures(tmp_path):
    rng = np.random.default_rng(2)
    result, rest = compare(
        still_model(), [recording(POINTS + rng.normal(0, 0.1, (60, 3, 3)), noise_mm=0.1)]
    )
    values = json.loads(json.dumps(result.to_json()))
    assert {"rmse_mm", "per_key_point_mm", "tip_rmse_mm", "floor_mm", "samples"} <= set(values)
    assert values["rmse_mm"] == pytest.approx(values["floor_mm"], rel=0.1)
    for path in draw_all(rest, "kPa", tmp_path / "pictures"):
        assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        assert path.stat().st_size > 10_000
