"""The change detector: its rate of false alarms, its delay, and what it may not be misled by."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from surgisoft.errors import InputError
from surgisoft.live.change import (
    AlarmDesign,
    Charts,
    Coverage,
    Stretch,
    block_means,
    blocks_of,
)
from surgisoft.live.change import fit_detector as fit

RATE_HZ = 20.0
N = 3
"""Key points of the made-up arm."""
SPAN = np.array([50.0, 60.0])
"""Range of its two chambers, kPa."""


def waves(t_s):
    """Actuation (T, 2) along which the arm moves, kPa."""
    return 25.0 + 10.0 * np.stack([np.sin(t_s), np.cos(t_s)], axis=1)


def fit_detector(reference, design=None):
    """The detector of runs (t_s, residual) along the waves."""
    return fit([Stretch(t_s, values, waves(t_s)) for t_s, values in reference], SPAN, design)


def residual(seconds, seed, sd_mm=0.1, correlation_s=3.0, noise_mm=0.03):
    """t_s and a residual (T, N, 3): an error with a correlation time, and camera noise."""
    rng = np.random.default_rng(seed)
    count = round(seconds * RATE_HZ)
    keep = np.exp(-1.0 / (RATE_HZ * correlation_s))
    steps = sd_mm * np.sqrt(1 - keep**2) * rng.normal(size=(count, N, 3))
    steps[0] = sd_mm * rng.normal(size=(N, 3))
    slow = lfilter([1.0], [1.0, -keep], steps, axis=0)
    return np.arange(count) / RATE_HZ, slow + noise_mm * rng.normal(size=slow.shape)


def fed(detector, t_s, values):
    charts = Charts(detector)
    levels = []
    for each in zip(t_s, values, waves(t_s), strict=True):
        charts.update(*each)
        levels.append(charts.statistic)
    return charts, np.array(levels)


@pytest.fixture(scope="module")
def detector():
    return fit_detector([residual(600, 1)])


def test_the_threshold_follows_from_the_wanted_rate(detector):
    """Lorden (1971): exp(h) blocks of each of three charts for each of nine components."""
    assert detector.threshold == pytest.approx(np.log(10 * 3600 / 0.5 * 3 * 9))
    other = fit_detector([residual(600, 1)], AlarmDesign(false_alarm_h=1.0))
    assert detector.threshold - other.threshold == pytest.approx(np.log(10.0))


def test_statistics_of_the_reference_are_found(detector):
    """Block means of 0.5 s of an error with standard deviation 0.1 mm and 3 s of memory."""
    blocks = block_means(*residual(3000, 2), 0.5)
    truth = np.cov(blocks.T).diagonal().mean() ** 0.5
    estimate = np.sqrt((detector.whitening.level_mm**2).mean())
    assert truth < estimate < 1.5 * truth, "an upper bound, and not a loose one"
    memory = detector.whitening.memory
    path = np.linalg.norm(np.array([10.0, 10.0]) / (SPAN / 2)) / np.sqrt(2) * 0.5  # of the waves
    rho = (1.0 - memory.white) * memory.kept(path)
    assert np.exp(-0.5 / 3.0) == pytest.approx(rho.mean(), abs=0.1)


def test_false_alarms_come_at_most_as_often_as_designed():
    """Half an hour of clean error, designed for one false alarm in three minutes."""
    design = AlarmDesign(false_alarm_h=0.05)
    found = fit_detector([residual(300, 3)], design)
    charts, _ = fed(found, *residual(1800, 4))
    assert len(charts.alarms) <= 10


@pytest.mark.parametrize(("shift_mm", "within_s"), [(1.0, 15.0), (0.5, 25.0)])
def test_a_shift_is_found_in_seconds(detector, shift_mm, within_s):
    t_s, values = residual(240, 5)
    values[t_s >= 120.0, -1] += shift_mm / np.sqrt(3.0)
    charts, _ = fed(detector, t_s, values)
    alarm = charts.alarms[0]
    assert 120.0 < alarm.at_s <= 120.0 + within_s
    assert alarm.since_s == pytest.approx(120.0, abs=within_s)
    assert alarm.before_mm == pytest.approx(np.sqrt(3 * (0.1**2 + 0.03**2)), rel=0.15)
    assert alarm.after_mm > 1.3 * alarm.before_mm


def test_a_glitch_and_a_lost_marker_raise_no_alarm(detector):
    t_s, values = residual(120, 6)
    values[1000, -1] += 5.0
    values[1400:1440, 0] = np.nan
    charts, levels = fed(detector, t_s, values)
    assert not charts.alarms
    assert levels[1020] > 0.3, "the glitch is seen"


def test_the_alarm_ends_after_the_change_is_gone(detector):
    t_s, values = residual(300, 7)
    values[(t_s >= 60) & (t_s < 90), -1] += 1.0
    values[t_s >= 250, -1] += 1.0
    charts, levels = fed(detector, t_s, values)
    assert len(charts.alarms) == 2
    assert charts.alarms[1].at_s > 250.0
    assert levels[t_s < 240][-1] < 1.0


def test_sample_by_sample_is_the_cusum_of_the_block_means(detector):
    """The charts of Page (1954), written out."""
    t_s, values = residual(60, 8)
    _, levels = fed(detector, t_s, values)
    blocks = blocks_of(Stretch(t_s, values, waves(t_s)), SPAN / 2, 0.5)
    left, unknown = detector.static.given(blocks)
    w, design, h = detector.whitening, detector.design, detector.threshold
    assert not w.elsewhere_mm2.any()
    assert unknown[1:].max() < 0.2, "the waves return to where the reference was"
    y = left @ w.axes
    charts, expected, last = np.zeros(27), [], [np.zeros(27)]
    for now, before, step in zip(y[1:], y[:-1], np.diff(blocks.position, axis=0), strict=True):
        kept = np.exp(-np.hypot(*step) / w.memory.reach - 0.5 / w.memory.time_s)
        rho = (1 - w.memory.white) * kept
        sd = w.level_mm * detector.enlargement
        level, fast = (now / sd) ** 2, (now - rho * before) ** 2 / sd**2 / (1 - rho**2)
        squares = np.concatenate([level, fast, fast / w.fast])
        worth = (1 - kept**2) / (1 + kept**2)
        count = np.concatenate([worth, np.ones(9), worth >= 0.5])
        ratio = (0.5 * squares * (1 - design.scale**-2) - np.log(design.scale)) * count
        charts = np.maximum(0.0, charts + np.minimum(np.minimum(ratio, h / 4), count * h / 3))
        charts = np.minimum(charts, np.min(last[-6:], axis=0) + h / 2)
        last.append(charts)
        expected.append(charts.max() / h)
    np.testing.assert_allclose(levels[20::10][: len(expected)], expected[: len(levels[20::10])])


def test_a_key_point_that_is_lost_for_whole_blocks_keeps_its_last_mean(detector):
    """Four blocks of 0.5 s, ten samples each, without key point 0, which is 2 mm off all along."""
    t_s, values = residual(20, 13)
    values[:, 0] += 2.0
    lost, held = values.copy(), values.copy()
    lost[200:240, 0] = np.nan
    held[200:240, 0] = values[190:200, 0].mean(axis=0)
    _, levels = fed(detector, t_s, lost)
    _, expected = fed(detector, t_s, held)
    assert expected[250] > 0.0
    np.testing.assert_allclose(levels, expected, rtol=1e-9)


@pytest.mark.parametrize("reset", [True, False])
def test_a_reset_and_a_gap_begin_anew(detector, reset):
    """A part of a block before them, with a wrong error, leaves no trace."""
    t_s, values = residual(20, 14)
    plain, levels = fed(detector, t_s + 100.0, values)
    charts = Charts(detector)
    for at_s in (0.0, 0.1, 0.2):
        charts.update(at_s, np.full((N, 3), 7.0), waves(np.array([50.0]))[0])
    if reset:
        charts.pause()
    begin_s = 0.3 if reset else 100.0
    again = [
        (charts.update(begin_s + at_s, value, actuation), charts.statistic)[1]
        for at_s, value, actuation in zip(t_s, values, waves(t_s + 100.0), strict=True)
    ]
    np.testing.assert_allclose(again, levels, rtol=1e-9)
    assert levels.max() > 0.0
    assert charts.judged == plain.judged


def test_an_error_that_stands_while_the_arm_does_counts_once():
    """Five minutes at one place where a clean model errs by four times its usual error: one value.

    In the reference the arm goes to a new place every 20 s, and errs there by 0.1 mm.
    """
    rng = np.random.default_rng(11)
    places, errors = rng.uniform(15.0, 35.0, (31, 2)), rng.normal(0.0, 0.1, (31, N, 3))
    places[[29, 30]], errors[30] = places[[9, 10]], 0.4 * np.sign(errors[30])

    def at(t_s):
        last = np.minimum(t_s // 20.0, 29).astype(int)
        share = np.clip((t_s - 20.0 * last) / 4.0, 0.0, 1.0)
        noise = 0.02 * rng.normal(size=(len(t_s), N, 3))
        moved, turned = share[:, None], share[:, None, None]
        actuation = places[last] * (1 - moved) + places[last + 1] * moved
        return t_s, errors[last] * (1 - turned) + errors[last + 1] * turned + noise, actuation

    times = np.arange(0.0, 880.0, 1.0 / RATE_HZ)
    charts = Charts(fit([Stretch(*at(times[times < 580.0]))], SPAN))
    for each in zip(*at(times[times >= 580.0]), strict=True):
        charts.update(*each)
    assert charts.judged > 580, "nearly every block of 300 s"
    assert charts.statistic > 0.02, "the error is seen"
    assert not charts.alarms


def test_the_static_error_of_the_reference_hides_no_change():
    """A model that errs by 1 mm along with the actuation: 0.2 mm more are found in seconds."""
    t_s, values = residual(300, 13, sd_mm=0.02)
    values[..., 0] += (waves(t_s)[:, :1] - 25.0) / 10.0
    found = fit_detector([(t_s, values)])
    assert found.reference_mm > 0.7
    assert found.whitening.level_mm.max() < 0.1
    later, more = residual(120, 14, sd_mm=0.02)
    more[..., 0] += (waves(later)[:, :1] - 25.0) / 10.0
    more[later >= 60.0, -1] += 0.2 / np.sqrt(3.0)
    charts, _ = fed(found, later, more)
    assert 60.0 < charts.alarms[0].at_s <= 70.0


def test_heavy_tails_of_the_reference_enlarge_the_scale():
    t_s, values = residual(600, 9)
    jerky = values.copy()
    for begin in range(200, len(t_s), 1500):
        jerky[begin : begin + 100] *= 8.0
    assert fit_detector([(t_s, jerky)]).enlargement > fit_detector([(t_s, values)]).enlargement


def jumps(seconds, seed, factor):
    """A slow circle with a jump each 20 s, and an error with 0.4 half ranges of memory along the
    path, whose innovations are `factor` times as large in the jumps; four samples per second."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(round(4.0 * seconds)) / 4.0
    jumping = t_s % 20.0 >= 19.0
    ways = np.repeat(rng.choice([-5.0, 5.0], len(t_s) // 80 + 1), 80)[: len(t_s)]
    actuation = waves(np.cumsum(np.where(jumping, ways, 0.2) / 4.0))
    path = np.linalg.norm(np.diff(actuation / (SPAN / 2), axis=0, prepend=actuation[:1]), axis=1)
    keep = np.exp(-path / 0.4)
    size = 0.1 * np.sqrt(1.0 - keep**2) * np.where(jumping, factor, 1.0)
    steps, error = size[:, None, None] * rng.normal(size=(len(t_s), N, 3)), np.zeros((N, 3))
    errors = np.empty_like(steps)
    for j, step in enumerate(steps):
        errors[j] = error = keep[j] * error + step
    return Stretch(t_s, errors + 0.02 * rng.normal(size=errors.shape), actuation)


def test_fast_moves_have_a_variance_of_their_own():
    """A model that errs three times as much in fast moves as its memory along the path states.

    Ten minutes hold 30 of them, and twenty minutes raise no alarm; larger errors in them do, and
    so would these without a variance of their own.
    """
    found, plain = (fit([jumps(600, 20, factor)], SPAN) for factor in (3.0, 1.0))
    assert np.median(found.whitening.fast) > 3.0 * np.median(plain.whitening.fast)
    clean, changed = jumps(1200, 21, 3.0), jumps(600, 22, 12.0)
    blind = replace(found, whitening=replace(found.whitening, fast=plain.whitening.fast))
    for detector, stretch, alarms in (
        (found, clean, False),
        (found, changed, True),
        (blind, clean, True),
    ):
        charts = Charts(detector)
        for each in zip(*stretch, strict=True):
            charts.update(*each)
            if charts.alarms:
                break
        ended = np.searchsorted(stretch.t_s, each[0])
        assert charts.judged > ended // 3, "of one block for two samples"
        assert bool(charts.alarms) == alarms


def test_fast_moves_that_the_reference_lacks_raise_no_chart(detector):
    """The waves have one speed: a component for which it is slow has no fast move at all."""
    w = detector.whitening
    worth = w.memory.worth(np.linalg.norm(10.0 / (SPAN / 2)) / 2**0.5 * 0.5)
    assert (worth < 0.4).any()
    assert np.isinf(w.fast[worth < 0.4]).all()


def test_a_short_reference_is_refused():
    with pytest.raises(InputError, match=r"has 19\.5 s, expected at least 30 s"):
        fit_detector([residual(20, 1)])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"false_alarm_h": 0.0}, "time between false alarms is 0 h, expected 0.001 to 1e6 h"),
        ({"false_alarm_h": np.inf}, "time between false alarms is inf h"),
        ({"scale": 1.0}, "scale is 1, expected 1.1 to 100"),
    ],
)
def test_an_alarm_has_a_rate_and_a_scale(fields, message):
    with pytest.raises(InputError, match=message):
        AlarmDesign(**fields)


def test_motion_that_the_reference_lacks_is_not_judged(detector):
    """An error outside the reference's range of actuation says nothing about a change."""
    t_s, values = residual(120, 10)
    away = (t_s >= 40.0) & (t_s < 80.0)
    values[away, -1] += 1.0
    actuation = waves(t_s)
    actuation[away] += 0.7 * SPAN
    for here, alarms in ((actuation, 0), (waves(t_s), 1)):
        charts = Charts(detector)
        for each in zip(t_s, values, here, strict=True):
            charts.update(*each)
        assert len(charts.alarms) == alarms
        # 40 s away, and 15 s until half of the last half minute is motion of the reference again.
        assert charts.left_out in ((110, 111) if alarms == 0 else (0,))


def test_one_move_alone_raises_no_alarm_and_a_lasting_error_does(detector):
    """Two seconds of an error of 5 mm are one event; eight seconds of it are not."""
    for seconds, alarms in ((2.0, 0), (8.0, 1)):
        t_s, values = residual(120, 6)
        values[(t_s >= 60.0) & (t_s < 60.0 + seconds), -1] += 5.0
        charts, levels = fed(detector, t_s, values)
        assert len(charts.alarms) == alarms
        assert levels.max() > 0.45


def test_a_reference_that_does_not_repeat_judges_nothing():
    """Waves for a minute, then straight away for four: an error on the waves is not looked for."""
    t_s, values = residual(300, 3)
    away = SPAN * np.linspace(0.6, 3.0, len(t_s))[:, None]
    found = fit([Stretch(t_s, values, np.where(t_s[:, None] < 60.0, waves(t_s), away))], SPAN)
    assert found.repeated < 0.5
    charts, _ = fed(found, t_s, values + 1.0)
    assert not charts.judged
    assert not charts.alarms


def test_a_motion_is_covered_where_the_reference_came_to_it_twice():
    there, here = np.full((8, 2), -1.0), np.full((8, 2), 1.0)
    asked = np.array([1.0, 1.0, 0.0, 0.0])
    once = Coverage.of([np.concatenate([there, here])], 0.5)
    assert once.visits(asked) == 1
    assert not once.covers(asked)
    twice = Coverage.of([np.concatenate([there, here, there, here])], 0.5)
    assert twice.visits(asked) == 2
    assert twice.covers(asked)
    assert not twice.covers(-0.5 * asked)
    assert Coverage.of([here, here], 0.5).visits(asked) == 2, "another run is another visit"


@pytest.fixture(scope="module")
def brief():
    """The detector of an error with a correlation time of one second."""
    return fit_detector([residual(300, 1, correlation_s=1.0)])


@pytest.mark.parametrize("moves", [True, False])
def test_an_error_that_is_large_at_once_is_found_in_two_seconds(brief, moves):
    """1 mm in every coordinate, ten times the error of the reference; not while the arm stands
    still, where two seconds are one value."""
    t_s, values = residual(124, 15, correlation_s=1.0)
    values[t_s >= 120.0] += 1.0
    charts = Charts(brief)
    for each in zip(t_s, values, waves(t_s if moves else t_s.clip(max=119.0)), strict=True):
        charts.update(*each)
    found = [alarm for alarm in charts.alarms if alarm.chart == "sudden"]
    assert len(found) == moves
    for alarm in found:
        assert 122.0 <= alarm.at_s <= 122.6
        assert alarm.since_s == pytest.approx(120.0, abs=0.6)


def test_a_reference_error_that_lasts_raises_the_limit_of_sudden_ones(detector):
    """Four seconds of a large error in the reference: four times its mean square is needed."""
    t_s, values = residual(600, 9)
    values[(t_s >= 300.0) & (t_s < 304.0)] += 0.5
    found = fit_detector([(t_s, values)])
    assert detector.sudden_limit == detector.design.scale**2
    assert found.sudden_limit == pytest.approx(4.0 * found.largest)
    assert found.sudden_limit > detector.sudden_limit


@pytest.mark.parametrize(("here_s", "judged"), [(3.0, (1, 15)), (7.0, (50, 90))])
def test_motion_between_ways_outside_the_reference_is_not_judged(detector, here_s, judged):
    """3 s of every 10 s in the reference: what a chart sums over is mostly elsewhere.

    Of the 6 blocks in each of 6 rounds those at the begin count, where nothing else was before.
    """
    t_s, values = residual(60, 16)
    actuation = waves(t_s)
    actuation[t_s % 10.0 >= here_s] += 0.7 * SPAN
    charts = Charts(detector)
    for each in zip(t_s, values, actuation, strict=True):
        charts.update(*each)
    assert judged[0] <= charts.judged <= judged[1]
    assert charts.judged + charts.left_out == 118
