"""A sweep that is played again is no further evidence."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.residuals import (
    MOTION_ALIKE,
    MOTION_SHARE,
    STILL,
    folds,
    motion_states,
    motions,
    problem_of,
)
from surgisoft.diagnosis.statistics import sign_flip_p_values
from surgisoft.surrogate.history import pack
from tests.diagnosis.synthetic import PERIOD_S, recording, still_model, walk

HALF = np.array([5.0, 5.0])


def path(rows: np.ndarray, period_s: float = PERIOD_S):
    """One run along an actuation (T, 2)."""
    time = torch.arange(len(rows), dtype=torch.float64) * period_s
    return pack([time], [torch.from_numpy(rows)], [torch.full((len(rows), 1, 3), torch.nan)])


def sweep(speed: float, times: int) -> np.ndarray:
    """(T, 2) the first chamber up and down, then the second, so many times."""
    legs = []
    for chamber in (0, 1):
        for goals in ((0.0, 10.0), (10.0, 0.0)):
            leg = np.zeros((round(10.0 / speed / PERIOD_S), 2))
            leg[:, chamber] = np.linspace(*goals, len(leg), endpoint=False)
            legs.append(leg)
    return np.tile(np.concatenate(legs), (times, 1))


def test_copies_share_a_motion_and_other_paths_do_not():
    once = sweep(1.0, 1)
    block = np.repeat(np.arange(4 * 3), len(once) // 4)
    assert motions(path(np.tile(once, (3, 1))), HALF, block).tolist() == [0, 1, 2, 3] * 3
    random = walk(6000)
    found = motions(path(random), HALF, np.arange(6000) // 50)
    assert found.max() + 1 > 90


@pytest.mark.parametrize("speed", [0.3, 3.0])
def test_the_same_path_at_another_speed_is_another_motion(speed):
    slow, other = sweep(1.0, 1), sweep(speed, 1)
    block = np.concatenate([np.zeros(len(slow), int), np.ones(len(other), int)])
    assert motions(path(np.concatenate([slow, other])), HALF, block).tolist() == [0, 1]


def test_blocks_are_alike_where_a_count_of_all_pairs_of_rows_says_so():
    """Sweeps of several speeds in turns, one block each, against loops over blocks and rows."""
    parts = [sweep(speed, 1) for speed in (1.0, 1.3, 3.0, 1.0, 2.0)]
    block = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    history = path(np.concatenate(parts))
    state = motion_states(history, HALF)
    moving = np.abs(state[:, 2:]).max(1) > STILL
    share = np.zeros((len(parts), len(parts)))
    for one in range(len(parts)):
        for row in state[moving & (block == one)]:
            for other in range(len(parts)):
                apart = np.abs(state[moving & (block == other)] - row).max(1)
                share[one, other] += (apart <= MOTION_ALIKE).any()
        share[one] /= (block == one).sum()
    alike = np.minimum(share, share.T) >= MOTION_SHARE
    assert 0 < alike[np.triu_indices(len(parts), 1)].sum() < 10
    leader: list[int] = []
    for one in range(len(parts)):
        before = [each for each in sorted(set(leader)) if alike[each, one]]
        leader.append(before[0] if before else one)
    expected = [sorted(set(leader)).index(each) for each in leader]
    assert motions(history, HALF, block).tolist() == expected


def test_rows_of_no_block_count_for_nothing():
    once = sweep(1.0, 2)
    block = np.full(len(once), -1)
    block[:100], block[400:500] = 0, 1
    assert motions(path(once), HALF, block).tolist() == [0, 0]


def test_copies_are_left_out_of_a_fit_together():
    part = folds(np.array([0, 1, 2, 3, 0, 1, 2, 3]))
    assert part[:4].tolist() == part[4:].tolist()
    assert len(set(part)) >= 2
    assert len(set(folds(np.zeros(12, int)))) >= 2


def test_neighbouring_motions_are_left_out_together_where_there_are_ten_of_them():
    assert folds(np.arange(12)).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 0, 0]
    assert folds(np.arange(9)).tolist() == [0, 1, 2, 3, 4, 0, 1, 2, 3]
    assert folds(np.zeros(12, int)).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 0, 0]


def test_a_short_motion_inside_a_long_one_is_not_the_same():
    """All of the first comes again in the second, of which most is something else."""
    once = sweep(1.0, 1)
    rows = np.concatenate([once, once, walk(3 * len(once))])
    block = np.repeat([0, 1], [len(once), 4 * len(once)])
    assert motions(path(rows), HALF, block).tolist() == [0, 1]


def test_a_rest_repeats_no_motion():
    """Two rests at the same actuation; and a sweep with a rest that is longer than it."""
    rest = np.tile([3.0, 4.0], (200, 1))
    assert motions(path(np.tile(rest, (2, 1))), HALF, np.arange(400) // 200).tolist() == [0, 1]
    once = sweep(1.0, 1)
    held = np.concatenate([once, np.tile(once[:1], (3 * len(once), 1))])
    block = np.repeat([0, 1], len(held))
    assert motions(path(np.tile(held, (2, 1))), HALF, block).tolist() == [0, 1]


def test_repetitions_of_six_motions_count_as_six_independent_samples():
    """Gains of one sign in six motions: one in 2^6 by chance, not one in 2^96 for their copies."""
    rows = sweep(1.0, 16)
    problem = problem_of(still_model(), [recording(0 * rows[:, 0], rows)], part="training")
    six = replace(problem, motion=np.tile(np.arange(6), 16))
    gains = np.tile([0.5, 0.4, 0.6, 0.3, 0.5, 0.4], 16)[None]
    assert sign_flip_p_values(gains)[0] < 0.001
    assert sign_flip_p_values(six.by_motion(gains))[0] == pytest.approx(2.0**-6, abs=0.006)


def bumpy(rows: np.ndarray) -> np.ndarray:
    """(T,) an error of the surrogate that depends on the actuation alone, mm."""
    return 0.5 * np.sin(1.3 * rows[:, 0]) + 0.4 * np.cos(1.1 * rows[:, 1])


def test_an_error_of_the_surrogate_that_is_shown_again_and_again_is_no_effect():
    rows = sweep(1.0, 16)
    some = [recording(bumpy(rows), rows, seed=seed) for seed in range(2)]
    found = diagnose(still_model(), some)
    assert found.verdict.kind in ("nothing_missing", "surrogate_undertrained")
    assert any("repeat themselves" in check for check in found.checks)
    problem = problem_of(still_model(), some, part="training")
    assert problem.motion.max() + 1 < len(problem.motion) / 2
    means = problem.by_motion(problem.motion * np.array([[1.0], [2.0]]))
    np.testing.assert_allclose(means, np.outer([1.0, 2.0], np.arange(means.shape[1])))
