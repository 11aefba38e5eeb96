"""Fitting: it finds what is there, leaves out what the data cannot support, and is repeatable."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from surgisoft.errors import InputError, Interrupted
from surgisoft.surrogate import ensemble
from surgisoft.surrogate.effects import hypothesis_of
from surgisoft.surrogate.effects.twist import Twist
from surgisoft.surrogate.fit import FitConfig, excitation, fit, rms_of_loss
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.interval import ErrorInterval, calibrate, coverage_of
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawEnsemble, HawNN, range_weights, weighted_mse
from surgisoft.surrogate.training import (
    Data,
    dealt,
    hold_out,
    make_rows,
    model_rows,
    normalise,
    rest_shape,
    validated_error,
)
from surgisoft.surrogate.training import train as train_model
from tests.surrogate.truth import SPEC, history, shape, traverse, walk

NOISE = 0.05
QUICK = FitConfig(hidden=(64, 64), epochs=60, prior="none")
"""Of networks without a prior mean, which test_prior_mean.py has."""


def rmse(model, judged) -> float:
    """RMS of a coordinate, mm."""
    return float(
        (model.predict(judged) - judged.key_points)[judged.valid].square().nanmean().sqrt()
    )


def spread(judged) -> float:
    """Standard deviation of a coordinate over time, RMS over all, mm."""
    points = judged.key_points[judged.valid]
    return float((points - points.nanmean(0)).square().nanmean().sqrt())


@pytest.fixture(scope="module")
def walks():
    rng = np.random.default_rng(1)
    return [history([walk(n, rng) for _ in range(4)], noise=NOISE, seed=n) for n in (400, 150, 160)]


def test_memory_beats_direction_beats_pressure(walks):
    train, valid, test = walks
    full = fit(train, valid, SPEC, replace(QUICK, epochs=40, effects=("hysteresis",)))
    direction = fit(train, valid, SPEC, replace(QUICK, epochs=20))
    plain = fit(train, valid, SPEC, replace(QUICK, epochs=20, inputs="pressure"))
    assert list(full.model.effects) == ["hysteresis"]
    errors = [rmse(result.model, test) for result in (full, direction, plain)]
    assert errors[0] < 0.6 * errors[1]
    assert errors[1] < 0.8 * errors[2]
    removed = (errors[2] ** 2 - errors[0] ** 2) / (errors[2] ** 2 - NOISE**2)
    assert removed > 0.9
    assert full.model.validation.rmse_mm == pytest.approx(
        np.sqrt(3) * rmse(full.model, valid), rel=1e-5
    )


def test_nothing_is_added_where_there_is_no_hysteresis():
    """On an arm without memory neither direction nor plays earn a place."""
    rng = np.random.default_rng(2)
    train, valid = (history([walk(250, rng)] * 4, hysteresis=0.0, seed=s) for s in (1, 2))
    config = replace(QUICK, epochs=15, learning_rate=1e-2, effects=("hysteresis",))
    result = fit(train, valid, SPEC, config)
    assert not result.model.effects
    assert not result.model.network.directions
    assert sum("no gain beyond chance" in warning for warning in result.warnings) == 2


def test_a_plain_traverse_supports_neither_direction_nor_memory():
    """The trap: direction and memory are confounded with position; the simpler model is kept."""
    rng = np.random.default_rng(3)
    train, test = history([traverse(8)]), history([walk(400, rng)], seed=4)
    config = replace(QUICK, epochs=20, effects=("hysteresis",))
    guarded = fit(train, None, SPEC, config)
    assert not guarded.model.effects
    assert not guarded.model.network.directions
    assert any("chamber 1: it reversed only" in warning for warning in guarded.warnings)
    assert any("swept its whole range" in warning for warning in guarded.warnings)
    plain = fit(train, None, SPEC, replace(QUICK, epochs=20, inputs="pressure"))
    assert rmse(guarded.model, test) <= 1.1 * rmse(plain.model, test)


def test_excitation_distinguishes_a_random_walk_from_a_traverse():
    low, high, band = (torch.tensor(x) for x in (SPEC.low, SPEC.high, SPEC.band))
    rng = np.random.default_rng(0)
    for chamber in excitation(history([walk(1500, rng)]), low, high, band):
        assert chamber.minor_loops
        assert chamber.unsupported() == ""
    slow, middle, fast = excitation(history([traverse(12)]), low, high, band)
    assert not slow.direction
    assert slow.reversals == 1, "from rest at 0 down to the first level, then only up"
    assert middle.direction
    assert fast.direction
    assert not middle.minor_loops
    assert not fast.minor_loops
    # 12 * 12 sweeps of the fast chamber, one reversal between two, one at the start from rest.
    assert fast.reversals == 144


def test_the_shape_at_rest_is_the_mean_of_the_rows_nearest_to_no_actuation():
    """Fifty rows from -9 kPa up in steps of 1 kPa, the point at x = p mm, missing at 0 and 3 kPa:
    the twenty nearest of the others are those from -9 to 12 kPa."""
    p = torch.arange(-9.0, 41.0)
    points = torch.stack([p, 0 * p, 70 + 0 * p], 1)[:, None]
    points[[9, 12]] = torch.nan
    some = pack([torch.arange(50.0)], [p[:, None]], [points])
    nearest = [x for x in range(-9, 13) if x not in (0, 3)]
    assert len(nearest) == 20
    expected = [[sum(nearest) / 20.0, 0.0, 70.0]]
    np.testing.assert_allclose(rest_shape(some).numpy(), expected, rtol=1e-6)


def test_a_block_of_rows_ends_with_its_run():
    """Runs of 60 and 30 rows: blocks of 25, 25 and 10 rows, then of 25 and 5."""
    runs = history([walk(60, np.random.default_rng(1)), walk(30, np.random.default_rng(2))])
    low, high = torch.tensor(SPEC.low), torch.tensor(SPEC.high)
    model = ArmModel(SPEC, HawNN(low, high, SPEC.key_points, (4,), directions=False))
    block = make_rows(model, runs).block
    assert block.bincount().tolist() == [25, 25, 10, 25, 5]
    assert (block.diff() >= 0).all()


def still_runs(*lengths):
    """Runs of so many rows of an arm that rests, each two key points."""
    return pack(
        [torch.arange(float(count)) for count in lengths],
        [torch.zeros(count, 3) for count in lengths],
        [torch.zeros(count, 2, 3) for count in lengths],
    )


def test_a_fifth_of_the_runs_is_held_out_or_a_fifth_of_each_of_few():
    """Two of ten runs as a whole; four of twenty blocks of each of four runs, of 100 or 60 rows."""
    ten = still_runs(*range(20, 30))
    held = hold_out(ten, 0)
    assert not (held & ~ten.valid).any()
    whole = (held.sum(1) == ten.valid.sum(1)).tolist()
    assert sum(whole) == 2
    assert held.any(1).tolist() == whole
    assert not torch.equal(held, hold_out(ten, 1))
    assert torch.equal(held, hold_out(ten, 0))
    assert dealt(ten).tolist() == [k for k, count in enumerate(range(20, 30)) for _ in range(count)]
    few = still_runs(100, 60, 100, 100)
    held = hold_out(few, 0)
    assert held.sum(1).tolist() == [20, 12, 20, 20]
    for run, rows in enumerate((5, 3, 5, 5)):
        blocks = held[run, : 20 * rows].view(20, rows)
        assert torch.equal(blocks.all(1), blocks.any(1))
    group = dealt(few)
    assert group.tolist() == [20 * run + i // rows for run, rows in enumerate((5, 3, 5, 5))
                              for i in range(20 * rows)]  # fmt: skip


def unmeasured(history, *places):
    """The history without key points in (run, rows) places."""
    points = history.key_points.clone()
    for run, rows in places:
        points[run, rows] = torch.nan
    return replace(history, key_points=points)


def test_only_runs_and_blocks_with_key_points_are_held_out():
    """The held-out run of five without key points; four blocks of the measured rows of one."""
    ten, every = still_runs(*range(20, 30)), slice(None)
    for run in hold_out(ten, 0).any(1).nonzero()[:, 0].tolist():
        lost = unmeasured(ten, (run, every))
        held = hold_out(lost, 0)
        assert not held[run].any()
        assert held.any(1).sum() == 2
    five = still_runs(100, 100, 100, 100, 100)
    lost = unmeasured(five, (2, every))
    held = hold_out(lost, 0)
    assert held.sum(1).tolist() == [20, 20, 0, 20, 20], "blocks of the four that have key points"
    assert dealt(lost).tolist() == [i // 5 for i in range(500)]
    one = still_runs(400)
    short = unmeasured(one, (0, hold_out(one, 0)[0]), (0, slice(0, 100)))
    measured = (~short.key_points.isnan()).all(-1).any(-1)
    held = hold_out(short, 0)
    assert 0.15 < (held & measured).sum() / measured.sum() < 0.25


def test_the_validated_error_counts_every_measured_key_point_once():
    """Distances of 1, 1, 1 mm of one key point and of 3 mm of one that was seen once."""
    target = torch.zeros(3, 2, 3)
    predicted = torch.zeros(3, 2, 3)
    predicted[:, 0, 0], predicted[:, 1, 1] = 1.0, 3.0
    target[1:, 1] = torch.nan
    found = validated_error(target, predicted)
    assert found.rmse_mm == pytest.approx(np.sqrt((1 + 1 + 1 + 9) / 4))
    assert found.per_key_point_mm == pytest.approx([1.0, 3.0])


def test_same_seed_same_weights():
    rng = np.random.default_rng(1)
    train, valid = (history([walk(n, rng) for _ in range(4)], noise=NOISE) for n in (50, 50))
    config = FitConfig(hidden=(16,), epochs=3, effects=("hysteresis",))
    one, other = (fit(train, valid, SPEC, config).model.state_dict() for _ in range(2))
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_missing_key_points_neither_count_nor_spread(walks):
    train, valid, test = walks
    points = train.key_points.clone()
    lost = torch.rand(points.shape[:3], generator=torch.Generator().manual_seed(0)) < 0.3
    points[lost] = torch.nan
    gappy = pack(
        list(train.t_s), list(train.pressure), list(points)
    )  # four runs of equal length: no padding
    config = replace(QUICK, epochs=20, learning_rate=1e-2, inputs="pressure")
    result, whole = (fit(each, valid, SPEC, config) for each in (gappy, train))
    assert rmse(result.model, test) < 1.1 * rmse(whole.model, test)


def test_constant_curvature_recovers_a_constant_curvature_arm():
    """Without hysteresis the truth is one arc, linear but for its stretch: 1 % of the motion."""
    rng = np.random.default_rng(5)
    train = history([walk(400, rng)], hysteresis=0.0, noise=0.02)
    result = fit(train, None, SPEC, FitConfig(network="constant_curvature", epochs=30))
    assert rmse(result.model, train) < 0.015 * spread(train)


def test_recurrent_baseline_learns(walks):
    train, valid, test = walks
    config = FitConfig(network="recurrent", epochs=12, learning_rate=1e-2)
    result = fit(train, valid, SPEC, config)
    assert rmse(result.model, test) < 0.1 * spread(test)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": "smell"}, "unknown inputs 'smell'"),
        ({"effects": ("ghost",)}, "unknown effect 'ghost'"),
        ({"effects": None}, "'effects' of a fit is None, expected names of effects"),
        ({"effects": "creep"}, "'effects' of a fit is 'creep', expected names of effects"),
        ({"epochs": 0}, "'epochs' of a fit is 0, expected a whole number from 1"),
        ({"epochs": "20"}, "'epochs' of a fit is '20', expected a whole number from 1"),
        ({"batch": 0}, "'batch' of a fit is 0, expected a whole number from 1"),
        ({"seed": -1}, "'seed' of a fit is -1, expected a whole number from 0"),
        ({"seed": 1.5}, "'seed' of a fit is 1.5, expected a whole number from 0"),
        ({"members": 2.5}, "'members' of a fit is 2.5, expected a whole number from 1"),
        ({"sections": -1}, "'sections' of a fit is -1, expected a whole number from 0"),
        ({"learning_rate": 0}, "'learning_rate' of a fit is 0, expected a finite number"),
        ({"learning_rate": np.nan}, "'learning_rate' of a fit is nan, expected a finite"),
        ({"check_excitation": "no"}, "'check_excitation' of a fit is 'no', expected a"),
        ({"hidden": ()}, "hidden widths (): expected whole numbers"),
        ({"hidden": 8}, "hidden widths 8: expected whole numbers"),
        ({"hidden": (0,)}, "hidden widths (0,): expected whole numbers"),
        ({"hidden": (10**7, 10**7)}, "hidden widths (10000000, 10000000): expected whole"),
        ({"network": "svm"}, "unknown network 'svm'"),
    ],
)
def test_bad_configs_are_named(walks, change, message):
    with pytest.raises(InputError, match=re.escape(message)):
        fit(walks[0], walks[1], SPEC, FitConfig(**change))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"network": "kernel", "prior": "none"}, "kernel has no setting prior"),
        ({"network": "kernel", "hidden": [8]}, "kernel has no setting --widths"),
        ({"network": "kernel", "epochs": 3}, "kernel has no setting --epochs"),
        ({"network": "kernel", "inputs": "pressure"}, "kernel has no setting --inputs"),
        (
            {"network": "kernel", "epochs": 1, "inputs": "pressure", "hidden": (8,)},
            "kernel has no setting --inputs, --widths, --epochs",
        ),
        ({"network": "constant_curvature", "hidden": (8,)}, "curvature has no setting --widths"),
        ({"network": "recurrent", "hidden": (8,)}, "recurrent has no setting --widths"),
    ],
)
def test_settings_that_a_network_does_not_have_are_refused(walks, change, named):
    with pytest.raises(InputError, match=f"{named}: expected a fit without"):
        fit(walks[0], walks[1], SPEC, FitConfig(**change))


def test_too_few_rows_are_refused():
    short = history([walk(20, np.random.default_rng(0))])
    with pytest.raises(InputError, match="20 rows with key points, expected at least 30"):
        fit(short, None, SPEC, QUICK)


def test_an_arm_that_never_moves_is_refused():
    still = history([np.full((60, 3), 12.0)])
    with pytest.raises(InputError, match=r"no chamber moves in the training recordings .all stay"):
        fit(still, None, SPEC, QUICK)


@pytest.mark.parametrize(("value", "message"), [(1e30, "farther than"), (1e200, "farther than")])
def test_absurd_key_points_are_refused(walks, value, message):
    points = walks[1].key_points.double().clone()
    points[0, 3, 1, 2] = value
    broken = pack(list(walks[1].t_s), list(walks[1].pressure), list(points))
    with pytest.raises(InputError, match=message):
        fit(broken, None, SPEC, QUICK)


def test_an_absurd_actuation_is_refused(walks):
    pressure = walks[1].pressure.double().clone()
    pressure[0, 3, 1] = 1e300
    broken = pack(list(walks[1].t_s), list(pressure), list(walks[1].key_points))
    with pytest.raises(InputError, match="not a finite number"):
        fit(broken, None, SPEC, QUICK)


def test_too_little_held_out_data_decides_nothing(walks):
    """Forty rows are two blocks of time: no stage may be kept on them."""
    valid = history([walk(40, np.random.default_rng(8))])
    config = replace(QUICK, hidden=(16,), epochs=20, effects=("hysteresis",))
    result = fit(walks[0], valid, SPEC, config)
    assert not result.model.effects
    assert any("too short to decide" in warning for warning in result.warnings)


def test_recurrent_baseline_takes_runs_of_one_row():
    rng = np.random.default_rng(9)
    short = history([walk(1, rng) for _ in range(60)])
    result = fit(short, None, SPEC, FitConfig(network="recurrent", epochs=2))
    assert np.isfinite(result.model.validation.rmse_mm)


def test_effects_are_refused_where_they_would_be_ignored(walks):
    config = FitConfig(network="recurrent", effects=("hysteresis",))
    with pytest.raises(InputError, match="has none"):
        fit(walks[0], walks[1], SPEC, config)


def test_truth_is_not_made_of_plays():
    """The test's own arm: relays only, so that the model's form is not simply found again."""
    path = np.array([[0.0, 0, 0], [30, 0, 0], [0, 0, 0]])
    assert np.abs(shape(path, 5.0)[0] - shape(path, 5.0)[2]).max() > 0.1


def lagging(rows: int, seed: int, dt_s: float = 0.1):
    """A run of an arm whose line lags by 0.4 s in filling and 1.2 s in emptying, stepped in NumPy.

    The command jumps after 0.5 to 4 s: (times, command, key points with noise).
    """
    rng = np.random.default_rng(seed)
    levels = [
        np.tile(rng.uniform(SPEC.low, SPEC.high), (rng.integers(5, 40), 1)) for _ in range(99)
    ]
    command = np.concatenate(levels)[:rows]
    chamber, path = np.zeros(3), []
    for row in command:
        tau = np.where(row > chamber, 0.4, 1.2)
        chamber = row + (chamber - row) * np.exp(-dt_s / tau)
        path.append(chamber)
    points = shape(np.array(path), 0.0) + rng.normal(0, NOISE, (rows, 3, 3))
    return torch.arange(rows) * dt_s, torch.tensor(command), torch.tensor(points)


def test_a_lag_of_the_line_is_fitted_through_whole_runs():
    runs = [lagging(300, seed) for seed in range(8)]
    train, valid = (
        pack(*([run[k] for run in part] for k in range(3))) for part in (runs[:6], runs[6:])
    )
    config = replace(SMALL, hidden=(48, 48), epochs=40, learning_rate=1e-2, effects=("line_lag",))
    result = fit(train, valid, SPEC, config)
    stage = result.stages[-1]
    assert stage.kept
    assert stage.valid_rmse_mm < 0.25 * stage.simpler_rmse_mm
    found = {q.name: q.value for q in result.model.effects["line_lag"].quantities()}
    assert found["share"] == pytest.approx(1.0, abs=0.1)
    assert found["tau_up_s"] == pytest.approx(0.4, rel=0.4)
    assert found["tau_down_s"] == pytest.approx(1.2, rel=0.4)


@pytest.mark.parametrize("running", ["line_lag", "without line_lag"])
def test_ctrl_c_keeps_an_effect_that_lowers_the_held_out_error(running):
    """In its own stage, or in that of the simpler model, which was not trained as long then."""
    runs = [lagging(300, seed) for seed in range(8)]
    train, valid = (
        pack(*([run[k] for run in part] for k in range(3))) for part in (runs[:6], runs[6:])
    )
    config = replace(SMALL, hidden=(24, 24), epochs=40, learning_rate=1e-2, effects=("line_lag",))

    def press(stage, epoch, epochs, best):
        if stage == running and epoch >= 0.7 * epochs:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as ended:
        fit(train, valid, SPEC, config, press)
    result = ended.value.result
    where, (first, second) = result.interrupted, result.stages
    assert (where.stage, where.finished, where.unproved) == (running, ("pressure",), "line_lag")
    assert "pressure, with line_lag, which halves their squared held-out error" in where.sentence
    assert list(result.model.effects) == ["line_lag"]
    assert (first.reason, second.reason) == ("", "interrupted")
    assert second.valid_rmse_mm < 0.5 * first.valid_rmse_mm
    assert result.model.validation.rmse_mm == pytest.approx(second.valid_rmse_mm)


def test_effects_behind_the_network_are_left_to_amend(walks):
    with pytest.raises(InputError, match=r"payload acts on the body.*surgisoft amend --effect pay"):
        fit(walks[0], None, SPEC, FitConfig(effects=("payload",)))


def runs(seeds, length: int = 150, hysteresis: float = 0.0):
    """Runs of random walks of the arm, one a seed."""
    rng = np.random.default_rng(100 + seeds[0])
    return history([walk(length, rng) for _ in seeds], hysteresis, NOISE, seed=seeds[0])


SMALL = FitConfig(hidden=(32, 32), epochs=60, inputs="pressure", batch=128, prior="none")


def test_an_ensemble_knows_its_error_on_runs_that_took_no_part(monkeypatch):
    train, fresh = runs(range(12), length=40), runs(range(50, 62))
    given = []

    def recorded(error, distance, group, source):
        given.append(distance)
        return calibrate(error, distance, group, source)

    monkeypatch.setattr(ensemble, "calibrate", recorded)
    result = fit(train, None, SPEC, replace(SMALL, members=4, learning_rate=1e-2))
    assert isinstance(result.model.network, HawEnsemble)
    interval = result.model.validation.interval
    assert interval.source == "cross-validation"
    assert interval.groups == 10, "two of twelve runs are held out"
    assert interval.rows == 400
    (distance,) = given
    assert 0.01 < float(distance.median()) < 0.3, "in ranges of a chamber, to rows of other runs"
    found = result.model.predict_interval(fresh)
    error = (found.key_points_mm - fresh.key_points).norm(dim=-1)
    assert 0.91 <= coverage_of(error, found.radius_mm) <= 0.985
    assert result.stages[-1].valid_rmse_mm < result.stages[-1].simpler_rmse_mm
    assert any("4 members" in line for line in result.lines())


def test_an_ensemble_ends_where_it_is_best_on_runs_that_its_members_left_out():
    """Few noisy runs: the error of left-out runs falls for some epochs, and then rises."""
    rng = np.random.default_rng(5)
    train, fresh = (history([walk(n, rng) for _ in range(6)], seed=n) for n in (40, 150))
    noise = 2.0 * torch.randn(train.key_points.shape, generator=torch.Generator().manual_seed(0))
    noisy = replace(train, key_points=train.key_points + noise)
    how = {"hidden": (128, 128), "learning_rate": 3e-2, "batch": 128, "inputs": "pressure"}
    errors, held = {}, {}
    for epochs in (20, 100):
        config = FitConfig(members=3, epochs=epochs, prior="none", **how)
        result = fit(noisy, None, SPEC, config)
        held[epochs] = [row[3] for row in result.loss if row[0] == "ensemble"]
        errors[epochs] = rmse(result.model, fresh)
    assert held[100][-1] > 1.1 * min(held[100]), "else the last weights are the best ones"
    assert errors[100] < 1.1 * errors[20]


def test_a_single_network_states_an_interval_of_its_held_out_rows():
    train, fresh = runs(range(12)), runs(range(50, 62))
    result = fit(train, None, SPEC, SMALL)
    assert result.model.validation.interval.source == "held-out rows"
    found = result.model.predict_interval(fresh)
    error = (found.key_points_mm - fresh.key_points).norm(dim=-1)
    assert 0.88 <= coverage_of(error, found.radius_mm) <= 0.99
    assert result.covered is None, "those rows calibrated it"


def test_auto_finds_the_lag_of_the_line():
    some = [lagging(200, seed) for seed in range(8)]
    train, valid = (
        pack(*([run[k] for run in part] for k in range(3))) for part in (some[:6], some[6:])
    )
    config = replace(SMALL, effects=("auto",), epochs=12, learning_rate=1e-2)
    result = fit(train, valid, SPEC, config)
    assert "line_lag" in result.model.effects
    stage = next(stage for stage in result.stages if stage.name == "line_lag")
    assert stage.tried_mm["line_lag"] == min(stage.tried_mm.values())
    assert stage.tried_mm["none"] > 2 * stage.tried_mm["line_lag"]


def test_auto_adds_nothing_to_an_arm_without_memory():
    config = replace(SMALL, effects=("auto",), epochs=15, learning_rate=1e-2)
    result = fit(runs(range(10)), None, SPEC, config)
    assert not result.model.effects
    reasons = ("no effect with memory added", "no gain beyond chance")
    assert any(reason in warning for reason in reasons for warning in result.warnings)


def test_auto_tries_the_effects_that_ask_for_it(monkeypatch):
    asking = replace(hypothesis_of(Twist), memory="time")
    monkeypatch.setattr(sys.modules[Twist.__module__], "HYPOTHESIS", asking)
    timed = runs(range(5), length=60)
    of_time = {"line_lag", "rate_dependence", "creep", "twist"}
    for recorded, tried in (
        (timed, {"hysteresis"} | of_time),
        (replace(timed, t_s=torch.zeros_like(timed.t_s)), {"hysteresis"}),
    ):
        result = fit(recorded, None, SPEC, replace(SMALL, effects=("auto",), epochs=3))
        found = {name for stage in result.stages for name in stage.tried_mm or {}}
        for warning in result.warnings:
            if warning.startswith("no effect with memory added"):
                found |= set(re.findall(r"(\w+) \d+\.\d{3}", warning))
        assert found - {"none"} == tried


def prescribed(monkeypatch, aside):
    """Training that makes every network a constant, so many mm aside along x by its label."""

    def trained(model, data, label, *_):
        model.network.scale.zero_()
        offset = torch.tensor([aside.get(label, 1.0), 0.0, 0.0])
        model.network.mean.copy_(offset.repeat(SPEC.key_points))
        return 1

    monkeypatch.setattr("surgisoft.surrogate.fit.train_model", trained)


def at(aside):
    """One run of an arm whose key points are so many mm (T,) aside along x."""
    t = torch.arange(len(aside)) * 0.1
    points = torch.zeros(len(aside), SPEC.key_points, 3)
    points[..., 0] = torch.as_tensor(aside, dtype=torch.float32)[:, None]
    command = torch.tensor(walk(len(aside), np.random.default_rng(0)))
    return pack([t], [command], [points])


@pytest.mark.parametrize(
    ("blocks", "t", "kept"), [(8, 2.2, False), (8, 2.5, True), (4, 99.0, False), (5, 99.0, True)]
)
def test_a_stage_is_kept_by_a_t_test_over_blocks_of_time(monkeypatch, blocks, t, kept):
    """Of blocks of 25 rows whose squared error falls by 1 mm^2 on average, with this t of Student.

    The critical value of eight blocks is 2.36; four are too few whatever they say.
    """
    spread = np.linspace(-1.0, 1.0, blocks)
    gain = 1.0 + spread / spread.std(ddof=1) * np.sqrt(blocks) / t
    assert stats.ttest_1samp(gain, 0.0).statistic == pytest.approx(t)
    prescribed(monkeypatch, {"direction": 0.0})
    # The squared distance to 1 less that to 0 is 1 - 2 x.
    valid = at(np.repeat((1.0 - gain) / 2.0, 25))
    config = FitConfig(hidden=(4,), prior="none", check_excitation=False)
    stage = fit(at(np.zeros(100)), valid, SPEC, config).stages[-1]
    assert (stage.name, stage.kept) == ("direction", kept)


def test_the_radii_of_an_ensemble_are_those_of_its_mean(monkeypatch):
    """Members 1 and 3 mm aside: their mean is 2 mm off, a single one sqrt(5) mm, RMS."""
    prescribed(monkeypatch, {})
    apart = ErrorInterval((0.95,), ((2.0,) * 3,), (0.0,) * 3, 250, 10, "cross-validation")

    def trained(model, *_):
        made = HawEnsemble.of([model.network, model.network])
        for values in (*made.weights, *made.biases):
            values.data.zero_()
        made.scale.fill_(1.0)
        made.mean.zero_()
        for member, aside in enumerate((1.0, 3.0)):
            made.biases[-1].data[member, 0] = torch.tensor([aside, 0.0, 0.0] * SPEC.key_points)
        return model.replace(network=made), apart

    monkeypatch.setattr("surgisoft.surrogate.fit.train_ensemble", trained)
    config = FitConfig(hidden=(4,), prior="none", inputs="pressure", members=2)
    result = fit(at(np.zeros(100)), at(np.zeros(250)), SPEC, config)
    assert result.stages[-1].valid_rmse_mm == pytest.approx(2.0)
    (radii,) = result.model.validation.interval.quantiles_mm
    assert radii == pytest.approx([2.0 * np.sqrt(4.0 / 5.0)] * 3)


def test_a_fit_keeps_residuals_of_both_recordings_and_notes_what_hardly_moved(monkeypatch):
    """The validation recording is 2 mm aside; chamber 2 moves by a tenth of its range."""
    prescribed(monkeypatch, {"pressure": 0.0})
    train, valid = at(np.zeros(100)), at(np.full(100, 2.0))
    share = torch.linspace(0.0, 1.0, 100)[:, None] * torch.tensor([0.2, 0.1, 1.0])
    low, span = torch.tensor(SPEC.low), torch.tensor(SPEC.span)
    train.pressure[0] = low + share * span
    config = FitConfig(hidden=(4,), prior="none", inputs="pressure", check_excitation=False)
    result = fit(train, valid, SPEC, config)
    assert set(np.unique(np.asarray(result.known.residual_mm)[..., 0]).round(4)) == {0.0, 2.0}
    (note,) = [each for each in result.warnings if "hardly moved" in each]
    assert note.startswith(f"chamber 2 hardly moved ({0.1 * float(span[1]):.3g} kPa in all)")


def test_a_fit_that_leaves_most_of_the_motion_says_so(monkeypatch, walks):
    """A model that rests in the middle of key points that are 1 mm to either side."""
    fitted = fit(walks[0], walks[1], SPEC, replace(QUICK, epochs=10, inputs="pressure"))
    assert not [each for each in fitted.warnings if "of a motion of" in each]
    prescribed(monkeypatch, {"pressure": 0.0})
    config = FitConfig(hidden=(4,), prior="none", inputs="pressure", check_excitation=False)
    sides = at(np.repeat([-1.0, 1.0], 100))
    (note,) = [each for each in fit(sides, sides, SPEC, config).warnings if "a motion of" in each]
    assert note.startswith("the model leaves 1 mm of a motion of 1 mm")
    assert "check the clocks (delay_s in the map)" in note


def test_a_loss_of_the_progress_is_told_as_a_distance():
    """Every coordinate moves by 10 mm; all errors are (1, 2, 2) mm, 3 mm apart."""
    measured = torch.tensor([[[0.0, 0.0, 0.0]], [[10.0, 10.0, 10.0]]])
    loss = weighted_mse(measured + torch.tensor([1.0, 2.0, 2.0]), measured, range_weights(measured))
    assert rms_of_loss("pressure", float(loss)) == pytest.approx(3.0)
    assert rms_of_loss("kernel", 9.0) == 3.0


@pytest.mark.parametrize(
    ("aside", "added"),
    [
        ({"creep": 0.96, "line_lag": 0.97}, []),
        ({"creep": 0.94, "line_lag": 0.97}, ["creep"]),
        ({"creep": 0.8, "line_lag": 0.7, "hysteresis": 0.6, "rate_dependence": 0.9},
         ["hysteresis", "line_lag"]),
    ],
)  # fmt: skip
def test_auto_adds_two_effects_at_most_of_a_tenth_of_the_squared_error(monkeypatch, aside, added):
    prescribed(monkeypatch, aside)
    config = FitConfig(
        hidden=(4,), prior="none", inputs="pressure", effects=("auto",), check_excitation=False
    )
    result = fit(at(np.zeros(100)), at(np.zeros(250)), SPEC, config)
    assert [stage.name for stage in result.stages[1:]] == added
    assert sorted(result.model.effects) == sorted(added)


def test_an_effect_that_is_named_twice_is_added_twice(monkeypatch):
    """The first one stays; each halves the error."""
    prescribed(monkeypatch, {"creep": 0.5, "without creep#2": 0.5, "creep#2": 0.25})
    config = FitConfig(
        hidden=(4,), prior="none", inputs="pressure", effects=("creep", "creep"), batch=64
    )
    result = fit(
        at(np.zeros(100)), at(np.zeros(250)), SPEC, replace(config, check_excitation=False)
    )
    assert [stage.name for stage in result.stages] == ["pressure", "creep", "creep#2"]
    assert list(result.model.effects) == ["creep", "creep#2"]
    assert result.model.validation.rmse_mm == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"members": 0}, "'members' of a fit is 0, expected a whole number from 1 to 50"),
        ({"members": 3, "network": "recurrent"}, "an ensemble needs the network haw_nn"),
    ],
)
def test_impossible_ensembles_are_refused(walks, change, message):
    with pytest.raises(InputError, match=message):
        fit(walks[0], walks[1], SPEC, FitConfig(**change))


def test_training_ends_with_the_weights_that_validated_best():
    """Validation data of a mirrored arm: what is learned makes them worse and worse."""
    rng = np.random.default_rng(3)
    train, valid = (history([walk(60, rng)] * 2, seed=s) for s in (1, 2))
    mirrored = replace(valid, key_points=valid.key_points * torch.tensor([-1.0, -1.0, 1.0]))
    low, high = torch.tensor(SPEC.low), torch.tensor(SPEC.high)
    torch.manual_seed(0)
    model = ArmModel(SPEC, HawNN(low, high, SPEC.key_points, (16,), directions=False))
    normalise(model.network, train)
    data, losses = Data.split(train, mirrored, 0), []
    rows, weights = data.validation_rows(model), range_weights(data.fitted_rows(model).target)

    def loss():
        return float(weighted_mse(model_rows(model, rows), rows.target, weights))

    first = loss()
    train_model(model, data, "pressure", 40, replace(QUICK, learning_rate=3e-2), losses, None)
    validated = [row[3] for row in losses]
    assert validated[-1] > 1.05 * min(first, *validated), "else the last weights are the best ones"
    assert loss() == pytest.approx(min(first, *validated), rel=1e-5)


def test_held_out_rows_are_not_fitted():
    """Held-out and fitted rows are all measured rows, and none of them twice."""
    rng = np.random.default_rng(4)
    one = history([walk(200, rng)], seed=1)
    low, high = torch.tensor(SPEC.low), torch.tensor(SPEC.high)
    model = ArmModel(SPEC, HawNN(low, high, SPEC.key_points, (4,), directions=False))
    data = Data.split(one, None, 0)
    fitted, held = data.fitted_rows(model), data.validation_rows(model)
    assert len(fitted.target) + len(held.target) == 200
    assert 20 <= len(held.target) <= 80
    both = {tuple(row) for row in fitted.target.flatten(1).tolist()}
    assert not both & {tuple(row) for row in held.target.flatten(1).tolist()}
    assert int(data.targets[one.valid].isnan().all(-1).all(-1).sum()) == len(held.target)
