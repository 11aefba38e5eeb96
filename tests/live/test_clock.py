"""The clock of a loop, with a made-up time."""

import pytest

from surgisoft.live.clock import Clock


class Time:
    """A time that passes only where somebody works or sleeps."""

    def __init__(self):
        self.s = 100.0

    def now(self):
        self.s += 1e-6
        return self.s

    def sleep(self, seconds):
        self.s += seconds


def loop(pace, work_s, period_s=0.05, waited_s=0.0):
    """A loop that computes and, in periods that are longer than one, waits for a part of it [s]."""
    time = Time()
    computed = [0.0]
    clock = Clock(period_s, pace, time.now, time.sleep, lambda: computed[0])
    clock.tick()
    ticks = [time.s]
    for each in work_s:
        time.s += each
        computed[0] += each - (waited_s if each > period_s else 0.0)
        clock.tick()
        ticks.append(time.s)
    return clock.timing(), ticks


def test_the_period_is_kept_whatever_the_work_takes():
    timing, ticks = loop("real", [0.01, 0.03, 0.049, 0.0] * 50)
    assert ticks[-1] - ticks[0] == pytest.approx(200 * 0.05, abs=1e-4)
    assert timing.overruns == 0
    assert timing.jitter_s < 1e-5
    assert timing.busy_s == pytest.approx(0.02225, abs=1e-4)
    assert timing.busy_worst_s == pytest.approx(0.049, abs=1e-4)


def test_an_overrun_is_counted_and_made_up_for():
    timing, ticks = loop("real", [0.01, 0.07, 0.01, 0.01])
    assert timing.overruns == 1
    assert ticks[-1] - ticks[0] == pytest.approx(0.2, abs=1e-4)
    assert timing.interval_worst_s == pytest.approx(0.02, abs=1e-3)


def test_after_a_long_break_the_grid_begins_anew():
    timing, ticks = loop("real", [1.0, 0.01, 0.01])
    assert timing.overruns <= 2
    assert ticks[-1] - ticks[1] == pytest.approx(0.05, abs=1e-3)


def test_a_simulated_clock_never_waits_and_measures_the_work():
    timing, ticks = loop("simulated", [0.001] * 100)
    assert ticks[-1] - ticks[0] == pytest.approx(0.1, abs=1e-3)
    assert timing.ticks == 100
    assert "simulated clock" in timing.sentence


def test_a_late_sample_of_a_rig_is_an_overrun():
    timing, _ = loop("rig", [0.05, 0.05, 0.11, 0.05])
    assert timing.overruns == 1


def test_a_rig_that_keeps_another_time_has_no_overruns():
    """A simulation that is not declared as one; samples in bursts keep the period on average."""
    fast, _ = loop("rig", [0.002, 0.002, 0.09, 0.002] * 10, period_s=0.05)
    assert fast.overruns == 0
    assert "which the rig completed in 24.00 ms each" in fast.sentence
    assert "overruns" not in fast.sentence
    bursts, _ = loop("rig", [0.001, 0.001, 0.148] * 10, period_s=0.05)
    assert bursts.overruns == 10
    assert "10 overruns" in bursts.sentence


def test_an_overrun_names_its_time_and_whether_the_loop_computed_or_waited():
    work = [0.01, 0.01, 0.07, 0.01, 0.01]
    own, _ = loop("real", work)
    assert (own.overruns, own.overruns_waiting) == (1, 0)
    assert own.overruns_s == pytest.approx([0.1], abs=1e-3)
    assert "at 0.1 s; in 1 the loop's own work took longer" in own.sentence
    waited, _ = loop("real", work, waited_s=0.05)
    assert (waited.overruns, waited.overruns_waiting) == (1, 1)
    assert "in 1 the loop waited" in waited.sentence
