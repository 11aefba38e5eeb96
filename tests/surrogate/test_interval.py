"""Prediction intervals: coverage on synthetic errors, growth with distance, round trips."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import stats

from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.interval import (
    LEVEL,
    ErrorInterval,
    calibrate,
    coverage_of,
    distance_across,
    distance_to,
    group_factor,
    group_quantiles,
)
from surgisoft.surrogate.model import Validation
from surgisoft.surrogate.networks import HawEnsemble
from tests.surrogate.test_model import HIGH, LOW


def gaussian(rows: int, seed: int, scale: torch.Tensor | float = 1.0) -> torch.Tensor:
    """(S, 2) norms of Gaussian errors in space, the second key point three times as far off."""
    generator = torch.Generator().manual_seed(seed)
    error = torch.randn(rows, 2, 3, generator=generator, dtype=torch.float64).norm(dim=-1)
    return (
        error * torch.tensor([1.0, 3.0]) * (scale if isinstance(scale, float) else scale[:, None])
    )


def test_the_quantiles_of_gaussian_errors_are_those_of_the_chi_distribution():
    found = calibrate(gaussian(20000, 0), torch.zeros(20000), torch.arange(20000) // 100, "s")
    radius = found.radius_mm(torch.zeros(1, dtype=torch.float64))[0]
    assert radius.tolist() == pytest.approx([stats.chi(3).ppf(0.95) * k for k in (1, 3)], rel=0.02)
    assert found.growth == (0.0, 0.0), "distance explains nothing"
    assert (found.rows, found.groups) == (20000, 200)


@pytest.mark.parametrize("level", [0.5, 0.7, 0.9, 0.95, 0.985])
def test_fresh_errors_are_covered_within_binomial_bounds(level):
    """Levels between the stored ones are interpolated."""
    found = calibrate(gaussian(4000, 1), torch.zeros(4000), torch.zeros(4000), "s")
    fresh = gaussian(4000, 2)
    covered = coverage_of(fresh, found.radius_mm(torch.zeros(4000, dtype=torch.float64), level))
    # Calibration and test are both samples: their variances add.
    spread = math.sqrt(2 * level * (1 - level) / 4000)
    assert abs(covered - level) < 4 * spread + 0.004


def test_the_interval_widens_where_errors_grow_with_distance():
    """Errors ten times as large at distance 1 than at 0: coverage holds at both ends."""
    far = torch.rand(8000, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found = calibrate(gaussian(8000, 4, 1 + 10 * far), far, torch.zeros(8000), "s")
    assert min(found.growth) >= 3.0
    assert found.growth[1] == 10.0
    for at in (0.05, 0.95):
        fresh = gaussian(3000, 5, torch.full((3000,), 1 + 10 * at, dtype=torch.float64))
        radius = found.radius_mm(torch.full((3000,), at, dtype=torch.float64))
        assert coverage_of(fresh, radius) == pytest.approx(LEVEL, abs=0.03)


@given(
    rows=st.integers(100, 400),
    seed=st.integers(0, 2**16),
    missing=st.floats(0.0, 0.3),
    level=st.floats(0.05, 0.985),
)
@example(rows=304, seed=20973, missing=0.22364193257491147, level=0.5)
@settings(max_examples=30, deadline=None)
def test_calibration_rows_are_covered_and_levels_are_nested(rows, seed, missing, level):
    error = gaussian(3 * rows, seed)
    rng = torch.Generator().manual_seed(seed)
    error[torch.rand(error.shape, generator=rng) < missing] = torch.nan
    distance = torch.rand(3 * rows, generator=rng, dtype=torch.float64)
    found = calibrate(error, distance, torch.zeros(3 * rows), "s")
    radius = found.radius_mm(distance)
    assert coverage_of(error, radius) >= LEVEL
    assert (found.radius_mm(distance, level) <= found.radius_mm(distance, level + 0.01)).all()


def runs_of_other_sizes(runs: int, seed: int, spread: float = 0.5):
    """Errors (S, 2) of runs of 200 rows, each of a size of its own (log-normal), and their runs."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.exp(spread * torch.randn(runs, generator=generator, dtype=torch.float64))
    return gaussian(200 * runs, seed + 1, size.repeat_interleave(200)), torch.arange(
        runs
    ).repeat_interleave(200)


@pytest.mark.parametrize(("runs", "spread"), [(4, 0.5), (8, 1.0)])
def test_few_runs_that_differ_still_cover_further_ones(runs, spread):
    """The quantile of all rows of few runs covers less than 95 % of another one."""
    found, plain = [], []
    for seed in range(60):
        error, group = runs_of_other_sizes(runs, 100 * seed, spread)
        fresh = runs_of_other_sizes(40, 100 * seed + 50, spread)[0]
        for covered, groups in ((found, group), (plain, torch.zeros(len(group)))):
            covered.append(coverage_of(fresh, group_quantiles(error, groups, LEVEL)))
    assert np.mean(plain) < 0.925
    assert 0.935 <= np.mean(found) <= 0.975


@pytest.mark.parametrize("level", [0.9, 0.95])
@pytest.mark.parametrize("fitted", [1, 2])
def test_the_size_of_a_further_run_follows_students_t(level, fitted):
    """Runs of constant errors: the predictive quantile of a normal sample in closed form."""
    size = torch.tensor([1.0, 2.0, 0.5, 3.0, 1.2], dtype=torch.float64)
    rows = size.repeat_interleave(50)[:, None]
    found = group_quantiles(rows, torch.arange(250) // 50, level, [fitted])
    log = size.log().numpy()
    wide = log.std(ddof=fitted) * math.sqrt(1 + 1 / 5)
    assert float(found) == pytest.approx(
        math.exp(log.mean() + wide * stats.t(5 - fitted).ppf(level)), rel=0.01
    )


def distances_of_runs(runs: int, seed: int, growth: float):
    """Errors (S, 2), distances and runs: each run at a distance and of a size of its own."""
    rng = np.random.default_rng(seed)
    far = torch.tensor(rng.uniform(0.0, 1.0, runs)).repeat_interleave(100)
    error, group = gaussian(100 * runs, seed), torch.arange(runs).repeat_interleave(100)
    size = torch.tensor(np.exp(0.3 * rng.standard_normal(runs))).repeat_interleave(100)
    return error * ((1 + growth * far) * size)[:, None], far, group


def test_few_runs_show_no_growth_by_chance():
    """The errors have nothing to do with the distance, but six runs look as if they had."""
    found = [calibrate(*distances_of_runs(6, seed, 0.0), "s").growth for seed in range(40)]
    for grown in zip(*found, strict=True):
        assert sum(growth > 0 for growth in grown) <= 5


def test_a_growth_that_runs_agree_on_is_found():
    found = [calibrate(*distances_of_runs(16, seed, 10.0), "s").growth for seed in range(10)]
    for grown in zip(*found, strict=True):
        assert sum(growth >= 3 for growth in grown) >= 9


def test_a_key_point_with_noise_alone_does_not_grow_with_the_others():
    """The base is off by the noise of the cameras at any distance, the tip by more far away."""
    error, far, group = distances_of_runs(16, 5, 30.0)
    error[:, 0] = gaussian(len(error), 6)[:, 0]
    found = calibrate(error, far, group, "s")
    assert found.growth[0] == 0.0
    assert found.growth[1] >= 10.0
    fresh = gaussian(len(error), 7)[:, 0]
    for at in (0.0, 1.0):
        radius = found.radius_mm(torch.full((len(fresh),), at, dtype=torch.float64))[:, 0]
        assert coverage_of(fresh, radius) == pytest.approx(LEVEL, abs=0.02)


def test_radii_do_not_fall_nearer_to_the_training_than_the_scored_rows():
    """Groups that were left out are all at a distance: nothing is known of smaller ones."""
    error, far, group = distances_of_runs(16, 5, 30.0)
    far = 0.3 + 0.7 * far
    found = calibrate(error, far, group, "s")
    assert min(found.growth) > 0
    ordered = far.sort().values
    assert ordered[79] <= found.nearest <= ordered[81], "5 % of 1,600 rows are nearer"
    places = torch.tensor([0.0, found.nearest, 0.9], dtype=torch.float64)
    near, at, beyond = found.radius_mm(places)
    assert torch.equal(near, at)
    assert (beyond > at).all()
    assert f"{float(near[0]):.2f} {float(near[1]):.2f} mm" in found.sentence()


def test_a_fitted_growth_takes_a_degree_of_freedom():
    error, far, group = distances_of_runs(8, 3, 30.0)
    found = calibrate(error, far, group, "s")
    assert min(found.growth) > 0
    scores = error / (1 + far[:, None] * torch.tensor(found.growth))
    expected = group_quantiles(scores, group, LEVEL, (2, 2))
    assert found.quantiles_mm[found.levels.index(LEVEL)] == pytest.approx(expected.tolist())


def test_runs_that_are_alike_leave_the_interval_as_it_is():
    error = gaussian(4000, 8)
    alike, all_rows = (
        group_quantiles(error, group, LEVEL)
        for group in (torch.arange(4000) // 250, torch.zeros(4000))
    )
    assert (alike / all_rows).tolist() == pytest.approx([1.0, 1.0], abs=0.02)
    assert group_factor(error, torch.arange(4000) // 250, LEVEL) == pytest.approx(1.0, abs=0.02)
    assert group_factor(error, torch.zeros(4000), LEVEL) == 1.0


def test_a_wider_coverage_never_has_the_smaller_radius():
    """Of two runs the medians differ tenfold and the highest errors do not: the median of all, 10,
    counts ten times, the 95 % quantile of all, 10 as well, once."""
    alike, mixed = torch.full((200, 1), 10.0), torch.ones(200, 1)
    mixed[120:] = 10.0
    error, run = torch.cat([alike, mixed]).double(), torch.arange(400) // 200
    assert group_factor(error, run, 0.5) == pytest.approx(10.0)
    assert group_factor(error, run, 0.95) == pytest.approx(1.0)
    found = calibrate(error, torch.zeros(400), run, "s")
    for level in (0.5, 0.95):
        radius = found.radius_mm(torch.zeros(1, dtype=torch.float64), level)
        assert float(radius) == pytest.approx(100.0)


def test_too_few_rows_calibrate_nothing():
    assert calibrate(gaussian(99, 0), torch.zeros(99), torch.zeros(99), "s") is None
    hidden = gaussian(300, 0)
    hidden[:250, 1] = torch.nan
    assert calibrate(hidden, torch.zeros(300), torch.zeros(300), "s") is None


def test_between_stored_coverages_by_hand():
    """Logarithms of quantiles over those of the share outside; beyond the stored ones the nearest,
    and near the training the radius of the nearest scored row."""
    known = ErrorInterval((0.5, 0.95), ((0.1, 0.2), (0.4, 0.6)), (2.0, 0.0), 500, 7, "s", 0.3)
    share = (math.log(0.5) - math.log(0.2)) / (math.log(0.5) - math.log(0.05))
    middle = [0.1 ** (1 - share) * 0.4**share, 0.2 ** (1 - share) * 0.6**share]
    for coverage, quantiles in ((0.8, middle), (0.95, [0.4, 0.6]), (0.2, [0.1, 0.2])):
        for distance, factor in ((0.3, 1.6), (0.1, 1.6), (1.0, 3.0)):
            found = known.radius_mm(torch.tensor([distance], dtype=torch.float64), coverage)[0]
            assert found.tolist() == pytest.approx([factor * quantiles[0], quantiles[1]])
    assert known.radius_mm(torch.zeros(1, dtype=torch.float64), 0.999)[0, 1] == pytest.approx(0.6)
    wider = known.scaled([2.0, 0.5])
    assert wider.quantiles_mm == (
        (pytest.approx(0.2), pytest.approx(0.1)),
        (pytest.approx(0.8), pytest.approx(0.3)),
    )


def test_a_quantile_counts_the_row_that_comes_next():
    """Of 100 scores 0.95 (100 + 1) are below the 96th; missing ones are no scores."""
    scores = torch.cat((torch.arange(100.0) + 1.0, torch.full((50,), torch.nan)))[:, None]
    assert group_quantiles(scores, torch.zeros(150), 0.95).tolist() == [96.0]
    assert group_quantiles(scores, torch.zeros(150), 0.999).tolist() == [100.0]
    error, radius = torch.tensor([0.5, 1.0, 2.0, torch.nan]), torch.ones(4)
    assert coverage_of(error, radius) == pytest.approx(2.0 / 3.0)


def test_the_distance_of_a_left_out_row_is_that_to_other_folds():
    """In ranges of 10; the rows of a row's own fold are nearer."""
    actuation = torch.tensor([[0.0], [1.0], [5.0], [6.0]])
    found = distance_across(actuation, torch.tensor([0, 0, 1, 1]), torch.tensor([10.0]))
    assert found.tolist() == pytest.approx([0.5, 0.4, 0.4, 0.5])
    alone = distance_across(actuation, torch.zeros(4), torch.tensor([10.0]))
    assert alone.tolist() == [0.0] * 4


def test_distance_is_in_ranges_of_the_chambers():
    reference = torch.tensor([[0.0, 0.0], [10.0, 0.0]])
    at = torch.tensor([[0.0, 0.0], [7.0, 20.0]])
    found = distance_to(at, reference, torch.tensor([10.0, 20.0]))
    assert found.tolist() == pytest.approx([0.0, math.hypot(0.3, 1.0)], abs=1e-6)


INTERVAL = ErrorInterval(
    (0.5, 0.95), ((0.1,) * 5, (0.4,) * 5), (2.0,) * 5, 500, 7, "cross-validation"
)


@pytest.mark.parametrize(
    ("groups", "said"),
    [
        (3, "3 groups; too few to know how much groups differ)"),
        (18, "18 groups; fewer than 19, so their RMS errors are taken to be log-normal)"),
        (19, "19 groups)"),
    ],
)
def test_the_interval_says_what_few_groups_leave_open(groups, said):
    """Of K exchangeable groups and one further one, that one is the worst with 1 / (K + 1)."""
    assert said in replace(INTERVAL, groups=groups).sentence()


def test_the_sentence_says_in_millimetres_how_much_wider_the_interval_gets():
    """Scored rows were 2 % of a range away from the training; the second radius of 1 mm there grows
    by 100 for each range: (1 + 100 x 0.12) / (1 + 100 x 0.02) = 4.33 mm at 12 %."""
    quantile = 1.0 / 3.0
    found = ErrorInterval((LEVEL,), ((0.25, quantile),), (0.0, 100.0), 900, 30, "s", nearest=0.02)
    said = found.sentence()
    near = "0.25 1.00 mm of the prediction where the training data have nearly the same actuation"
    assert f"within (base to tip) {near}, and within 0.25 4.33 mm where" in said
    assert "is 12% of a chamber's range away from all of them (s, 900 rows" in said
    assert "away" not in replace(found, growth=(0.0, 0.0), nearest=0.0).sentence()


def test_a_model_keeps_its_interval_in_its_folder(tmp_path):
    arm = default_arm()
    stated = Validation(1.0, (1.0,) * 5, 500, interval=INTERVAL)
    kept = arm.replace(validation=stated)
    save_model(kept, tmp_path / "arm")
    again = load_model(tmp_path / "arm")
    assert again.validation == stated
    config = json.loads((tmp_path / "arm" / "config.json").read_text())
    assert "interval" not in config["validation"], "earlier versions read that part whole"
    config["interval"]["growth"] = 2.0
    (tmp_path / "arm" / "config.json").write_text(json.dumps(config))
    assert load_model(tmp_path / "arm").validation == stated, "one growth, of an earlier version"


def test_models_of_earlier_versions_open_and_say_that_they_have_no_interval(tmp_path):
    arm = default_arm()
    save_model(arm.replace(validation=Validation(1.0, (1.0,) * 5, 9)), tmp_path / "old")
    config = json.loads((tmp_path / "old" / "config.json").read_text())
    assert "interval" not in config
    old = load_model(tmp_path / "old")
    assert old.validation.interval is None
    with pytest.raises(InputError, match=r"states no prediction interval.*fit it again"):
        old.predict_interval(walk(old))


def walk(arm):
    """A history of 50 rows inside an arm's range."""
    rng = np.random.default_rng(0)
    pressure = torch.tensor(rng.uniform(arm.spec.low, arm.spec.high, (50, arm.spec.chambers)))
    points = torch.zeros(50, arm.spec.key_points, 3)
    return pack([torch.arange(50) * 0.1], [pressure], [points])


def test_predict_interval_surrounds_the_prediction():
    arm = default_arm()
    kept = arm.replace(validation=Validation(1.0, interval=INTERVAL))
    history = walk(arm)
    found = kept.predict_interval(history)
    assert torch.equal(found.key_points_mm, arm.predict(history))
    apart = torch.cdist(
        history.pressure[0] / torch.tensor(arm.spec.span),
        arm.training_residuals.actuation / torch.tensor(arm.spec.span),
    )
    expected = 0.4 * (1 + 2 * apart.amin(1))[:, None].expand(50, 5)
    assert torch.allclose(found.radius_mm[0], expected.to(found.radius_mm), rtol=1e-4)
    with pytest.raises(InputError, match="expected a share between 0 and 1"):
        kept.predict_interval(history, coverage=95)


def test_an_added_effect_voids_the_interval():
    arm = default_arm().replace(validation=Validation(1.0, interval=INTERVAL))
    assert arm.replace().validation.interval is INTERVAL
    assert arm.replace(effects={}).validation.interval is None


def test_ensembles_share_the_format(tmp_path):
    torch.manual_seed(0)
    arm = default_arm()
    network = HawEnsemble(LOW, HIGH, 5, (8, 8), members=3)
    for value in network.parameters():
        torch.nn.init.normal_(value)
    model = arm.replace(network=network, effects={})
    save_model(model, tmp_path / "ensemble")
    again = load_model(tmp_path / "ensemble")
    history = walk(arm)
    assert torch.equal(again.predict(history), model.predict(history))
    assert "3 x HawNN" in again.summary()
