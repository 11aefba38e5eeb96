"""Which effects a schedule can tell apart: against dense algebra, and against what must hold."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg, stats

from surgisoft.diagnosis.design.isolability import (
    FORM_S,
    FORM_SHARE,
    ROOM,
    SURE,
    Draws,
    Form,
    Moments,
    Sizes,
    Uncertainty,
    history_of_protocol,
    inducing_points,
    isolability,
    isolability_from,
    uncertainty_of,
    unimitated,
)
from surgisoft.diagnosis.discrepancy import body_covariance, kernel
from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.model import Validation

LIMITS = np.array([[-15.0, 54.0]] * 3)
NAMES = ["hysteresis", "line_lag", "creep", "rate_dependence"]


@pytest.fixture(scope="module")
def arm():
    return default_arm()


@pytest.fixture(scope="module")
def mixed(arm):
    return isolability(arm, make_protocol("mixed", LIMITS, 6000), NAMES)


def sweeps(rate: float, count: int = 8, top: float = 50.0) -> Protocol:
    """One chamber up and down at one speed, kPa/s."""
    commands = np.zeros((2 * count + 1, 3))
    commands[1::2, 0] = top
    times = top / rate * np.arange(len(commands))
    return Protocol("sweeps", "continuous", commands, np.zeros(len(commands)), times)


def small_case(rows=40, points=3, count=4, seed=0, noise=0.1, signal=0.3):
    rng = np.random.default_rng(seed)
    x, d = rng.uniform(-1, 1, (rows, 2)), rng.choice([-1.0, 1.0], (rows, 2))
    columns = rng.normal(size=(rows, points, 3, count))
    uncertainty = Uncertainty(
        np.full(points, noise), np.linspace(0.1, 0.3, points), np.full(points, signal), 0.05, (x, d)
    )
    return columns, x, d, uncertainty


def test_moments_are_the_products_under_the_dense_covariance():
    """Inducing points at every row make the process exact: compare with its full covariance."""
    columns, x, d, uncertainty = small_case()
    rows, points, _, count = columns.shape
    seconds = 80.0
    gram = Moments.of(columns, x, d, uncertainty, seconds).gram()
    static = body_covariance(
        np.sqrt((ROOM * uncertainty.discrepancy_mm) ** 2 + FORM_SHARE * uncertainty.signal_mm**2)
    )
    density = (uncertainty.noise_mm**2 * 0.05 + FORM_SHARE * FORM_S * 0.3**2) / 3.0
    noise = np.kron(np.eye(rows), np.diag(density)) * rows / seconds
    whole = np.kron(kernel(x, d, x, d), static) + noise
    expected = np.zeros((count, count))
    for axis in range(3):
        flat = columns[:, :, axis].reshape(rows * points, count)
        expected += flat.T @ linalg.solve(whole, flat, assume_a="pos")
    np.testing.assert_allclose(gram, expected, rtol=2e-3)


def test_a_model_that_is_far_off_leaves_what_its_error_cannot_imitate():
    """One slow sweep beside a large validated error: finite, less left of every sensitivity."""
    rng = np.random.default_rng(0)
    x, d = np.linspace(-1, 1, 2000)[:, None] * np.ones(3), np.ones((2000, 3))
    columns = rng.normal(size=(2000, 3, 3, 2))
    left = []
    for off in (0.1, 100.0):
        uncertainty = Uncertainty(
            np.full(3, 0.07), np.full(3, off), np.full(3, 1e-3), 0.05, inducing_points(3)
        )
        left.append(np.diag(Moments.of(columns, x, d, uncertainty, 100.0).gram()))
    assert np.isfinite(left[1]).all()
    assert (left[1] < left[0]).all()


def test_moments_of_two_experiments_share_the_surrogates_error():
    """Rows one after another in one experiment or in two: the same, as the error is the same."""
    columns, x, d, uncertainty = small_case(rows=60)
    whole = Moments.of(columns, x, d, uncertainty, 60.0).gram()
    first = Moments.of(columns[:25], x[:25], d[:25], uncertainty, 25.0)
    second = Moments.of(columns[25:], x[25:], d[25:], uncertainty, 35.0)
    np.testing.assert_allclose((first + second).gram(), whole, rtol=1e-4, atol=1e-4)


def test_unimitated_is_the_residual_of_least_squares():
    rng = np.random.default_rng(1)
    field = rng.normal(size=(200, 7))
    signals = np.zeros((7, 2))
    signals[0, 0], signals[:3, 1] = 1.0, rng.normal(size=3)
    shapes = [np.arange(3), np.arange(3, 5), np.array([6])]
    left = unimitated(field.T @ field, signals, shapes)
    for j, shape in enumerate(shapes):
        for k in range(2):
            y = field @ signals[:, k]
            fit = field[:, shape] @ np.linalg.lstsq(field[:, shape], y, rcond=None)[0]
            assert left[j, k] == pytest.approx(((y - fit) ** 2).sum(), rel=1e-3, abs=1e-6)


def test_identical_columns_cannot_be_told_apart_and_single_ones_are_symmetric():
    columns, x, d, uncertainty = small_case(count=3)
    columns[..., 1] = 1.7 * columns[..., 0]
    moments = Moments.of(columns, x, d, uncertainty, 40.0)
    draws = Draws(np.eye(3), np.arange(3))
    result = isolability_from(moments, draws, ["a", "b", "c"], [np.array([k]) for k in range(3)])
    assert result.separability[0, 1] == pytest.approx(0.0, abs=1e-4)
    assert result.confidence[0, 1] == pytest.approx(0.5, abs=0.02)
    assert result.separability[0, 2] > 0.5
    np.testing.assert_allclose(result.separability, result.separability.T, atol=1e-4)
    assert ((result.separability >= 0.0) & (result.separability <= 1.0)).all()


def test_less_noise_and_more_columns_of_the_rival_work_in_opposite_ways():
    draws = Draws(np.eye(4)[:, :1], np.array([0]))
    evidence = []
    for noise in (3.0, 1.0, 0.3):
        columns, x, d, uncertainty = small_case(noise=noise, signal=0.01)
        gram = Moments.of(columns, x, d, uncertainty, 2.0).gram()
        left = unimitated(gram, draws.amplitudes, [np.array([1]), np.array([1, 2, 3])])[:, 0]
        assert left[1] < left[0]
        evidence.append(left[0])
    assert evidence[0] < evidence[1] < evidence[2]


def test_with_one_speed_play_imitates_lag_and_varied_motion_tells_them_apart(arm, mixed):
    poor = isolability(arm, sweeps(6.0), NAMES)
    a, b = poor.names.index("line_lag"), poor.names.index("hysteresis")
    assert poor.separability[a, b] < 0.06
    assert poor.pair("line_lag", "hysteresis") < SURE
    a, b = mixed.names.index("line_lag"), mixed.names.index("hysteresis")
    assert mixed.separability[a, b] > 0.3
    assert mixed.pair("line_lag", "hysteresis") >= SURE


def test_a_schedule_that_stays_at_rest_shows_nothing(arm):
    still = Protocol("still", "continuous", np.zeros((2, 3)), np.zeros(2), np.array([0.0, 120.0]))
    result = isolability(arm, still, ["line_lag", "creep"])
    assert result.detectable.max() < 1e-3
    assert not result.seen.any()
    assert result.pair("line_lag", "creep") == pytest.approx(0.5, abs=0.01)


def test_longer_and_larger_tells_more(arm, mixed):
    shorter = isolability(arm, make_protocol("mixed", LIMITS, 1500), NAMES)
    smaller = isolability(arm, make_protocol("mixed", LIMITS, 6000), NAMES, size_mm=0.1)
    off = ~np.eye(len(NAMES), dtype=bool)
    assert shorter.log_evidence[off].mean() < 0.6 * mixed.log_evidence[off].mean()
    # Their confidences are near one, and a larger creep is also imitated better: no more than 0.003
    # lies between their means for any size from 0.1 mm on.
    assert smaller.log_evidence[off].mean() < 0.6 * mixed.log_evidence[off].mean()
    assert mixed.minutes == pytest.approx(5.0, abs=0.1)


def test_settled_protocols_hide_what_is_over_when_the_arm_has_settled(arm):
    result = isolability(arm, make_protocol("traverse", LIMITS, 300), ["line_lag", "inertia"])
    assert result.pair("line_lag", "inertia") < 0.9


def test_a_protocol_becomes_the_history_that_is_commanded(arm):
    protocol = sweeps(10.0, 2)
    history = history_of_protocol(arm, protocol)
    assert float(history.pressure.max()) == pytest.approx(50.0, abs=1e-4)
    assert float(history.t_s.max()) == pytest.approx(20.0, abs=0.11)
    settled = make_protocol("grid", LIMITS, 64)
    rows = history_of_protocol(arm, settled)
    assert int(rows.valid.sum()) == len(settled.commands)
    kept = rows.rows(rows.pressure).numpy()
    np.testing.assert_allclose(kept, settled.commands, atol=1e-4)


def test_inducing_points_fill_the_range():
    x, d = inducing_points(3)
    assert x.min() >= -1
    assert x.max() <= 1
    assert set(np.unique(d)) == {-1.0, 1.0}
    octants = {tuple(row) for row in (x > 0)}
    assert len(octants) == 8


def test_an_arm_without_a_stated_length_still_has_plausible_sizes(arm):
    uncertainty = uncertainty_of(arm, None, np.full(5, 0.5), 0.05)
    assert (uncertainty.density > 0).all()
    assert uncertainty.discrepancy_mm.shape == (5,)


def of_gram(gram, seconds=90.0):
    """Moments whose sensitivities have the products (K, K), with no discrepancy among them."""
    gram = np.array(gram, float)
    return Moments(
        gram[None], np.zeros((3, 1, 1, len(gram))), np.zeros((1, 1)), np.ones(1), seconds
    )


def test_the_chance_to_tell_two_apart_by_hand():
    """Squared lengths 16 and 9, of which the other one imitates a quarter each, or 1 of 16 in
    another form of it; a misfit of 10 % and 30 % of the true one's square lies along the way."""
    moments = of_gram([[16.0, 6.0, 2.0], [6.0, 9.0, 0.0], [2.0, 0.0, 4.0]])
    draws = Draws(np.eye(3)[:, :2], np.array([0, 1]))
    spans = [np.array([k]) for k in range(3)]
    misfit = np.array([[0.0, 0.1], [0.3, 0.0]])
    found = isolability_from(moments, draws, ["a", "b", "b"], spans, misfit)
    assert found.names == ("a", "b")
    assert found.minutes == 1.5
    np.testing.assert_allclose(found.detectable, [8.0, 4.5])
    np.testing.assert_allclose(found.log_evidence, [[0.0, 6.0], [3.375, 0.0]], rtol=1e-4)
    np.testing.assert_allclose(found.separability, [[0.0, 0.75], [0.75, 0.0]], rtol=1e-4)
    a, b = 0.5 * np.sqrt(12.0 / (1.0 + 0.1 * 16.0)), 0.5 * np.sqrt(6.75 / (1.0 + 0.3 * 9.0))
    np.testing.assert_allclose(found.distance, [[0.0, a], [b, 0.0]], rtol=1e-4)
    chance = stats.norm.cdf([a, b])
    np.testing.assert_allclose(found.confidence, [[0.5, chance[0]], [chance[1], 0.5]], rtol=1e-4)
    assert found.pair("a", "b") == found.pair("b", "a") == pytest.approx(chance[1], rel=1e-4)
    # 4 and 3 standard deviations from nothing: seen with 97.7 % and with 93.3 %, of 95 % asked for.
    assert found.seen.tolist() == [1.0, 0.0]


def test_plausible_sizes_by_hand():
    """One amplitude that moves the second of two key points by 1 mm: 0.71 mm RMS over both."""
    reference = SimpleNamespace(model=SimpleNamespace(spec=SimpleNamespace(key_points=2)))
    one, two = np.zeros((8, 2, 3, 1)), np.zeros((8, 2, 3, 2))
    one[:, 1, 0] = 1.0
    two[:, :, 1, 0], two[:, :, 2, 1] = 2.0, 3.0
    nothing = np.zeros((8, 2, 3, 1))
    forms = [Form(name, None) for name in ("a", "none", "b")]
    sizes = Sizes.of(reference, [one, nothing, two], forms, size_mm=0.4)
    assert [form.name for form in sizes.forms] == ["a", "b"]
    np.testing.assert_allclose(sizes.gram_mm2[0], [[0.5]])
    np.testing.assert_allclose(sizes.gram_mm2[1], [[4.0, 0.0], [0.0, 9.0]])
    assert [span.tolist() for span in sizes.spans] == [[0], [1, 2]]
    # At the size of 1 each, the first form moves the second key point alone, the other one both.
    np.testing.assert_allclose((sizes.profile_mm / 0.4) ** 2, [0.5, 1.5])
    draws = sizes.draws()
    assert draws.form.tolist() == [0] + [1] * 6
    assert draws.amplitudes[0, 0] == pytest.approx(0.4 * np.sqrt(2.0))
    many = np.concatenate([sizes.draws(seed).amplitudes[1:, 1:] for seed in range(200)], axis=1)
    squares = np.sum((many * [[2.0], [3.0]]) ** 2, axis=0)
    assert np.sqrt(squares.mean()) == pytest.approx(0.4, rel=0.05), "of orthogonal columns"
    grown = sizes.limited(draws, [100.0 * one, 100.0 * two])
    for k, columns in enumerate([one] + [two] * 6):
        field = 100.0 * columns @ grown.amplitudes[sizes.spans[grown.form[k]], k]
        assert np.sqrt(np.mean(np.sum(field**2, axis=2))) == pytest.approx(2.0 * 0.4)
    same = sizes.limited(draws, [one, two])
    within = np.abs(draws.amplitudes).max(0) < 2.0 * 0.4 / 3.0
    np.testing.assert_array_equal(same.amplitudes[:, within], draws.amplitudes[:, within])
    only = sizes.select([1])
    assert [span.tolist() for span in only.spans] == [[0, 1]]
    np.testing.assert_array_equal(only.gram_mm2[0], sizes.gram_mm2[1])


def test_uncertainty_by_hand(arm):
    """Cameras see a thousandth of the length, an unknown model errs by a twentieth of it."""
    unknown = arm.replace(validation=Validation())
    length, signal = arm.spec.length_mm, np.full(5, 0.3)
    found = uncertainty_of(unknown, None, signal, 0.1)
    np.testing.assert_allclose(found.noise_mm, 0.001 * length)
    np.testing.assert_allclose(found.discrepancy_mm, 0.05 * length)
    per_s = ((0.001 * length) ** 2 * 0.1 + FORM_SHARE * 0.09 * FORM_S) / 3.0
    np.testing.assert_allclose(found.density, per_s)
    slow = uncertainty_of(unknown, np.full(5, 0.2), signal, 60.0)
    np.testing.assert_allclose(slow.density, (0.04 * 60.0 + FORM_SHARE * 0.09 * 60.0) / 3.0)
    known = uncertainty_of(arm, None, signal, 0.1)
    np.testing.assert_allclose(known.discrepancy_mm, arm.validation.per_key_point_mm)


def test_settled_points_lie_their_time_of_settling_and_of_averaging_apart(arm):
    settled = make_protocol("grid", LIMITS, 64)
    history = history_of_protocol(arm, settled)
    apart = settled.settle_s + settled.average_s
    np.testing.assert_allclose(history.dt_s[0, 1:], apart, rtol=1e-5)
    assert isolability(arm, settled, ["payload", "twist"]).minutes == pytest.approx(
        len(settled.commands) * apart / 60.0, rel=0.02
    )
