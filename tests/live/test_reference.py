"""References that repeat their motions, and those that do not: told before the run."""

import numpy as np
import pytest

from surgisoft.live.change import LEAST_REPEATED, Stretch, fit_detector, repeated_share
from surgisoft.live.session import run

PERIOD_S = 0.05
LOOP_S = 36.0
SPAN = np.full(6, 40.0)


def once(seconds, seed=0, chambers=6, low=0.0, high=40.0):
    """(t_s, actuation) of legs of 2 s between random pressures, of which none comes back."""
    knots = np.arange(0.0, seconds + 2.0, 2.0)
    levels = np.random.default_rng(seed).uniform(low, high, (len(knots), chambers))
    t_s = np.arange(0.0, seconds, PERIOD_S)
    return t_s, np.column_stack([np.interp(t_s, knots, column) for column in levels.T])


@pytest.mark.parametrize("rounds", [3, 4, 6])
def test_every_round_of_a_loop_judges_the_others(rounds):
    """Rounds are runs of their own. Of three or four, the same part of each was left out at once:
    its motion was in no other fold, and the reference was refused."""
    loop = once(LOOP_S)
    assert repeated_share([loop] * rounds, SPAN) > 0.95
    rng = np.random.default_rng(1)
    found = fit_detector(
        [Stretch(loop[0], 0.1 * rng.normal(size=(len(loop[0]), 2, 3)), loop[1])] * rounds, SPAN
    )
    assert found.repeated == pytest.approx(repeated_share([loop] * rounds, SPAN))
    assert found.judges


def test_motion_that_does_not_come_back_is_not_repeated():
    assert repeated_share([once(120.0)], SPAN) < LEAST_REPEATED
    assert repeated_share([once(LOOP_S, seed) for seed in range(3)], SPAN) < LEAST_REPEATED


class Told(Exception):
    """Ends the run at its first warning."""


def told(schedule, **more):
    """The first warning of a run, before it drives the rig."""

    def end(text):
        raise Told(text)

    driven = []
    with pytest.raises(Told) as ended:
        run(
            schedule,
            "virtual:seed=1",
            "default",
            clock="simulated",
            progress=lambda *now: driven.append(now),
            on_warning=end,
            **more,
        )
    assert driven == [], ended.value
    return str(ended.value)


def test_a_reference_that_will_not_repeat_is_told_before_the_run(tmp_path):
    """A loop of 36 s in 60 s: most of it once only; in 120 s three times."""
    rows = np.column_stack(once(LOOP_S, chambers=3, low=-14.0, high=54.0))
    loop = tmp_path / "loop.csv"
    header = "t_s,c1_kPa,c2_kPa,c3_kPa"
    np.savetxt(loop, rows, delimiter=",", header=header, comments="")
    text = told(loop, minutes=3.0, reference_s=60.0)
    assert text.startswith("the first 60 s of the schedule, the reference, repeat ")
    assert "(--clean 120), or a recording of the same kind of motion (--before)" in text
    mixed = told("mixed", minutes=2.5, reference_s=120.0, seed=1)
    assert mixed.endswith("Give a recording of the same kind of motion (--before)")
