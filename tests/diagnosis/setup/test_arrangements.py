"""Arrangements of more than three chambers, of which not every one can be tried."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from surgisoft.diagnosis.setup.arrangements import idle, improved, neighbours, proposed
from surgisoft.diagnosis.setup.sample import Arrangement, Sample
from surgisoft.surrogate.history import pack
from tests.diagnosis.synthetic import walk

CHAMBERS, STEP_S = 6, 0.1
PSI = 6.894757
"""kPa in one psi."""
TRUTH = Arrangement((1, 0, 2, 5, 4, 3), (1.0, 1.0, -1.0, 1.0, 1.0, 1.0))
"""Channels 1 and 2 swapped, 4 and 6 too, and the sign of channel 3."""


@dataclass(frozen=True)
class Spec:
    """As much of a model's specification as the search looks at."""

    chambers: int = CHAMBERS
    key_points: int = 2
    low: tuple[float, ...] = (0.0,) * CHAMBERS
    high: tuple[float, ...] = (60.0,) * CHAMBERS


class LinearArm:
    """Two segments of three chambers each: every chamber bends all that is above it."""

    spec = Spec()
    rest_mm = torch.tensor([[0.0, 0.0, 40.0], [0.0, 0.0, 80.0]])

    def __init__(self):
        gain = np.zeros((CHAMBERS, 2, 3))
        for chamber in range(CHAMBERS):
            segment, angle = divmod(chamber, 3)
            across = np.array([np.cos(2.1 * angle + segment), np.sin(2.1 * angle + segment), 0.1])
            for point in range(segment, 2):
                gain[chamber, point] = (0.1 + 0.15 * point + 0.02 * chamber) * across
        self.gain = gain

    def moved(self, actuation: np.ndarray) -> np.ndarray:
        """(S, 2, 3) key points, mm, for actuation (S, 6), kPa."""
        return self.rest_mm.numpy() + np.einsum("sm,mnj->snj", actuation, self.gain)

    def predict(self, history) -> torch.Tensor:
        points = np.stack([self.moved(run) for run in history.pressure.double().numpy()])
        return torch.from_numpy(points).float()


class TipOnly(LinearArm):
    """The same arm, of which only the tip is seen."""

    spec = Spec(key_points=1)
    rest_mm = LinearArm.rest_mm[1:]

    def __init__(self):
        super().__init__()
        self.gain = self.gain[:, 1:]


def sample(
    turned=None,
    unit_kPa: float = 1.0,
    rows: int = 500,
    model=None,
    size=6.0,
    unit_mm: float = 1.0,
    unseen: int | None = None,
) -> Sample:
    """A recording of the arm whose channels are wired as TRUTH says, in a turned frame.

    size: scale of the motion of all chambers, or of each, kPa. unseen: a key point without
    positions.
    """
    model, chambers = model or LinearArm(), size * walk(rows, CHAMBERS, 3)
    recorded = np.empty_like(chambers)
    for chamber, (channel, sign) in enumerate(zip(TRUTH.order, TRUTH.sign, strict=True)):
        recorded[:, channel] = sign * chambers[:, chamber] / unit_kPa
    points = model.moved(chambers)
    points = (points + np.random.default_rng(0).normal(0.0, 0.05, points.shape)) / unit_mm
    points = points if turned is None else points @ turned.T
    if unseen is not None:
        points[:, unseen] = np.nan
    t_s = STEP_S * np.arange(rows)
    history = pack(
        [torch.from_numpy(t_s)], [torch.from_numpy(recorded)], [torch.from_numpy(points)]
    )
    return Sample(model, history, (t_s,), (points,), (t_s,), np.arange(rows) // 50, True)


def error_of(given: Sample):
    """RMS distance of the key points for each arrangement, mm, in the frame of the model."""
    return lambda some: np.sqrt(
        np.square(given.predicted(some) - given.measured()[0]).mean((1, 2, 3))
    )


@pytest.mark.parametrize(
    ("turned", "unit_kPa"),
    [
        (None, 1.0),
        (Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix(), 1.0),
        (Rotation.from_rotvec([0.0, np.pi / 2, 0.0]).as_matrix(), PSI),
        (np.diag([1.0, -1.0, 1.0]), 1.0),
    ],
)
def test_the_wiring_of_six_chambers_is_among_the_proposals(turned, unit_kPa):
    """46,080 signed permutations of six; the linear response finds the true one, in any frame."""
    found = proposed(sample(turned, unit_kPa), [(0, 1)], [1.0, PSI])
    assert Arrangement(TRUTH.order, TRUTH.sign, unit_kPa) in found
    assert Arrangement.as_recorded(CHAMBERS) in found
    assert len(found) == len(set(found)) < 200
    one_flipped = [each for each in found if each.factor == 1.0 and each.changes == 1]
    assert {each.sign for each in idle(CHAMBERS)} <= {each.sign for each in one_flipped}


@pytest.mark.parametrize("model", [LinearArm(), TipOnly()])
def test_positions_in_metres_are_compared_in_millimetres(model):
    """The scale follows from the links between key points; of one, from how far it moves."""
    given = sample(model=model, unit_mm=1000.0)
    assert TRUTH in proposed(given, [tuple(range(model.spec.key_points))], [1.0])


def test_a_key_point_that_is_never_seen_says_nothing():
    given = sample(unseen=0, unit_mm=1000.0)
    assert TRUTH in proposed(given, [(0, 1)], [1.0])


def test_a_channel_that_hardly_moves_does_not_decide_where_the_others_belong():
    """Its response is noise; unweighted, the noise is as large as a response."""
    size = np.array([6.0, 6.0, 6.0, 6.0, 6.0, 0.003])
    found = proposed(sample(size=size, rows=300), [(0, 1)], [1.0])
    known = range(CHAMBERS - 1)

    def right(each: Arrangement) -> bool:
        return all((each.order[k], each.sign[k]) == (TRUTH.order[k], TRUTH.sign[k]) for k in known)

    assert any(map(right, found))


def test_a_descent_ends_at_the_true_wiring_and_no_sooner():
    given = sample()
    start = Arrangement((0, 1, 2, 5, 4, 3), (1.0,) * CHAMBERS)  # one swap and one flip are left
    path = improved(start, error_of(given))
    assert path[0] == start
    assert path[-1] == TRUTH
    errors = error_of(given)(path)
    assert (np.diff(errors) < 0.0).all()
    assert errors[-1] == pytest.approx(0.05, rel=0.1), "the noise is left"
    assert improved(TRUTH, error_of(given)) == [TRUTH]


def test_neighbours_are_one_swap_or_one_flip_away():
    around = neighbours(TRUTH)
    assert len(around) == len(set(around))
    for each in around:
        swapped = sum(a != b for a, b in zip(each.order, TRUTH.order, strict=True))
        flipped = sum(a != b for a, b in zip(each.sign, TRUTH.sign, strict=True))
        assert (swapped, flipped) in ((2, 0), (2, 2), (0, 1))
    assert sum(each.order != TRUTH.order for each in around) == 15 + 5  # the sign may move along


def test_a_single_chamber_is_never_idle():
    assert idle(1) == []
    assert [each.sign for each in idle(2)] == [(0.0, 1.0), (1.0, 0.0)]
