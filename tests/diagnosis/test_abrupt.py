"""A key point that shifts against the others, and jumps beside those of the arm before."""

import re
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.abrupt import body_jumps, jumps_in, key_point_shift
from surgisoft.diagnosis.decision import decide
from surgisoft.diagnosis.diagnose import diagnose, jumping, slipped
from surgisoft.diagnosis.evidence import abrupt_changes
from surgisoft.diagnosis.pairs import before_and_after
from surgisoft.diagnosis.residuals import problem_of, residual_table
from surgisoft.measurement.fitting import fit, jump_level
from surgisoft.measurement.recordings import part_of
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.model import Validation
from tests.diagnosis.synthetic import PERIOD_S, recording, still_model, walk

ROWS = 1600
SHARES = np.array([0.1, 0.5, 1.0])
"""How far each key point moves, relative to the tip."""


def bending(seed=0):
    """(ROWS, 3, 3) mm: a body that bends with its actuation, which the still model does not."""
    u = (walk(ROWS, seed=seed) - 5.0) / 5.0
    tip = np.stack([1.2 * u[:, 0] + 0.4 * u[:, 0] * u[:, 1], 0.8 * u[:, 1], -0.1 * u[:, 0]], axis=1)
    return SHARES[:, None] * tip[:, None, :]


def moved_by(change, seed=1):
    """A recording of the arm whose key points are moved by (ROWS, 3, 3) mm."""
    made = recording(np.zeros(ROWS), walk(ROWS), seed=seed)
    return replace(made, key_points_mm=made.key_points_mm + change)


def posed(change):
    return problem_of(still_model(), [moved_by(change)])


def shifted(point, row, by):
    """(ROWS, 3, 3) mm: one key point that is elsewhere from a row on."""
    change = np.zeros((ROWS, 3, 3))
    change[row:, point] = by
    return change


def test_a_marker_that_slips_is_found_where_and_when_it_does():
    by = np.array([0.3, 0.0, 0.4])
    found = key_point_shift(posed(bending() + shifted(1, 900, by)))
    assert found.key_point == 1
    assert found.shift_mm == pytest.approx(0.5, rel=0.1)
    assert found.at_s == pytest.approx(900 * PERIOD_S, abs=0.015 * ROWS * PERIOD_S)
    # Of the mean square: 0.5^2 times the shares of the rows before and behind it.
    whole = np.square(bending() + shifted(1, 900, by)).sum((1, 2)).mean()
    expected = 0.25 * (900 / ROWS) * (700 / ROWS) / whole
    assert found.share == pytest.approx(expected, rel=0.25)
    assert found.log_gain > 0.5
    assert found.others < 0.2
    assert found.clarity == pytest.approx(np.sqrt(found.share) * found.log_gain)


def sliding(point, by, from_row, until_row):
    """(ROWS, 3, 3) mm: one key point that moves evenly against the others between two rows."""
    change = np.zeros((ROWS, 3, 3))
    part = (np.arange(ROWS) - from_row) / (until_row - from_row)
    change[:, point] = np.clip(part, 0.0, 1.0)[:, None] * np.asarray(by)
    return change


@pytest.mark.parametrize(("from_row", "until_row"), [(0, 800), (160, 1120)])
def test_a_marker_that_slides_is_told_from_one_that_slips(from_row, until_row):
    """Half a millimetre in half of the recording and longer, and not at once."""
    change = bending() + sliding(1, [0.6, 0.0, 0.8], from_row, until_row)
    found = key_point_shift(posed(change))
    assert found.key_point == 1
    step = 0.1 * ROWS * PERIOD_S
    assert found.slide.from_s == pytest.approx(from_row * PERIOD_S, abs=step)
    assert found.slide.until_s == pytest.approx(until_row * PERIOD_S, abs=step)
    assert found.slide.shift_mm == pytest.approx(1.0, rel=0.1)
    for row in (300, 900):
        assert key_point_shift(posed(bending() + shifted(1, row, [0.3, 0.0, 0.4]))).slide is None


def test_after_a_slide_no_rows_are_recommended():
    slide = moved_by(bending() + sliding(1, [0.6, 0.0, 0.8], 160, 1120))
    found = diagnose(still_model(), [slide], setup_tests=False, refit="never")
    assert found.verdict.kind == "unknown_effect"
    told = re.search(
        "key point k1 slides gradually, by about ([0-9.]+) mm against the others from about "
        "([0-9]+) s to ([0-9]+) s ",
        found.verdict.sentence,
    )
    assert float(told[1]) == pytest.approx(1.0, rel=0.15)
    # In steps of a tenth of the three quarters that are looked at.
    assert [float(told[2]), float(told[3])] == pytest.approx([16.0, 112.0], abs=12.0)
    assert "fix it and record again, or leave this key point out" in found.verdict.sentence
    assert "use the rows before" not in found.verdict.sentence
    assert "depends most on" not in found.verdict.sentence
    assert found.next_command == ""


def test_the_share_of_a_slip_is_one_of_what_is_above_the_noise():
    """Noise of 0.15 mm in each of nine coordinates beside a slip of half a millimetre."""
    noise = np.random.default_rng(5).normal(0.0, 0.15, (ROWS, 3, 3))
    made = moved_by(shifted(1, 800, np.array([0.3, 0.0, 0.4])) + noise)
    found = key_point_shift(problem_of(still_model(), [replace(made, noise_mm=0.15)]))
    whole = 0.25 / 2.0  # half of the rows are moved by 0.5 mm
    assert found.share == pytest.approx(0.25 / 4.0 / whole, rel=0.2)


def test_a_slip_is_seen_beside_motion_that_no_actuation_explains():
    """The body wanders by more than the marker slips; its neighbours say so."""
    time = PERIOD_S * np.arange(ROWS)
    wander = np.stack([np.sin(0.13 * time), 0.7 * np.cos(0.21 * time), 0.0 * time], axis=1)
    body = 1.5 * SHARES[:, None] * wander[:, None, :]
    found = key_point_shift(posed(body + shifted(1, 900, np.array([0.0, 0.3, 0.2]))))
    assert (found.key_point, found.log_gain > 0.3) == (1, True)
    assert found.shift_mm == pytest.approx(np.sqrt(0.13), rel=0.3)


def test_the_moment_of_a_slip_is_the_one_that_leaves_least():
    """At 50 s, where what remains without a step is explained best by one at 59 s."""
    found = key_point_shift(posed(bending() + shifted(1, 500, np.array([1.6, 0.0, 0.0]))))
    assert found.at_s == pytest.approx(500 * PERIOD_S, abs=0.005 * ROWS * PERIOD_S)
    assert found.shift_mm == pytest.approx(1.6, rel=0.05)


@pytest.mark.parametrize("case", ["bent", "knocked", "drifting"])
def test_what_moves_the_body_is_no_slip_of_a_marker(case):
    change = bending()
    if case == "knocked":
        # A turn of the whole body about its base at one moment, to first order.
        change[900:] += SHARES[:, None] * np.array([0.5, 0.0, 0.0])
    if case == "drifting":
        change *= 1.0 + np.linspace(0.0, 1.0, ROWS)[:, None, None]
    found = key_point_shift(posed(change))
    assert found.clarity < 0.03
    # The tip steps with the others, twice as far as the middle: noisy neighbours give less of that.
    assert case != "knocked" or (found.log_gain > 0.3 and found.others == pytest.approx(0.5, 0.1))


def test_a_single_key_point_has_no_others():
    problem = posed(bending())
    hidden = problem.measured.copy()
    hidden[:, :2] = np.nan
    assert key_point_shift(replace(problem, measured=hidden)) is None
    assert abrupt_changes(replace(problem, measured=hidden))["shift"] == 0.0


def stuck(seed=0):
    """(ROWS, 3, 3) mm: the body follows its actuation by slips of a millimetre."""
    place, answer = 0.0, np.zeros(ROWS)
    for row, pulled in enumerate(3.0 * (walk(ROWS, seed=seed)[:, 0] - 5.0) / 5.0):
        place = pulled if abs(pulled - place) > 1.0 else place
        answer[row] = place
    change = np.zeros((ROWS, 3, 3))
    change[:, :, 0] = SHARES * answer[:, None]
    return change


def test_jumps_are_those_of_the_training_rows():
    """A jump in the last quarter, which is held out, is not seen."""
    change = np.zeros((ROWS, 3, 3))
    change[600:] += 1.0
    change[1400:] += 1.0
    table = residual_table(still_model(), [moved_by(change)])
    assert jumps_in(table).rows.tolist() == [600, 1400]
    assert body_jumps(table).jumps.rows.tolist() == [600]


def test_an_arm_that_jumps_by_itself_has_no_new_jumps():
    arm = still_model()
    before, after = moved_by(stuck()), moved_by(stuck(seed=4) + 0.5, seed=2)
    alone = body_jumps(residual_table(arm, [after]))
    assert alone.share > 0.2
    assert jumping(evidence(arm, [after]))
    both = before_and_after(residual_table(arm, [after]), [before])
    assert both.training().table.jumps.share < 0.2
    # The same where the model knows it from the recordings of its fit.
    level = jump_level(arm, [before])
    assert level >= 0.7 * alone.jumps.level_mm
    arm.validation = Validation(0.5, (0.5,) * 3, ROWS, jump_mm=level)
    assert body_jumps(residual_table(arm, [after])).share < 0.2


class Numbers(dict):
    """Numbers of an `Evidence` by their names."""

    __getattr__ = dict.__getitem__


def evidence(arm, recordings):
    return Numbers(abrupt_changes(residual_table(arm, recordings).training()))


def test_the_words_say_what_was_put_in():
    slip = evidence(still_model(), [moved_by(bending() + shifted(2, 500, [0.0, 0.6, 0.0]))])
    (told,) = slipped(slip)
    assert told.startswith("key point k2 is shifted by 0.")
    assert "from 5" in told or "from 4" in told
    assert "in turn" not in told
    assert "s on, all recordings in turn: " in slipped(slip, 2)[0]
    assert jumping(evidence(still_model(), [moved_by(bending())])) == []
    assert slipped(evidence(still_model(), [moved_by(bending())])) == []
    (told,) = jumping(evidence(still_model(), [moved_by(stuck())]))
    assert told.startswith("the body jumps ")
    assert "times, by up to" in told


def test_the_largest_jump_has_its_moment():
    """Two jumps of the whole body, in a second recording; its rows follow those of the first."""
    change = np.zeros((ROWS, 3, 3))
    change[400:] += 2.0
    change[1000:] += 5.0
    first, second = moved_by(np.zeros((ROWS, 3, 3))), moved_by(change)
    found = abrupt_changes(residual_table(still_model(), [second]).training())
    assert found["jump_largest_s"] == pytest.approx(1000 * PERIOD_S)
    (told,) = jumping(Numbers(found))
    assert "(at 100.00 s), while neither" in told
    table = residual_table(still_model(), [first, second])
    found = abrupt_changes(table.training())
    assert found["jump_largest_s"] == pytest.approx(float(table.along_s[ROWS + 1000]))
    (told,) = jumping(Numbers(found), 2)
    assert " s, all recordings in turn), while neither" in told


def test_the_result_says_it_once(monkeypatch):
    """A slip is a jump, too, but is told as a slip; beside a named effect both are checks."""
    told = diagnose(still_model(), [moved_by(bending() + shifted(2, 500, [0.0, 1.6, 0.0]))])
    words = (told.verdict.sentence, *told.checks)
    assert sum("is shifted by" in each for each in words) == 1
    assert told.verdict.kind == "unknown_effect"
    assert "is shifted by" in told.verdict.sentence
    assert not any("the body jumps" in each for each in words)
    many = diagnose(still_model(), [moved_by(stuck())])
    words = (many.verdict.sentence, *many.checks)
    assert sum("the body jumps" in each for each in words) == 1
    assert many.verdict.kind == "unknown_effect"
    assert "the body jumps" in many.verdict.sentence
    monkeypatch.setattr(
        "surgisoft.diagnosis.diagnose.decide",
        lambda evidence: replace(decide(evidence), kind="cannot_tell", reason="schedule"),
    )
    other = diagnose(still_model(), [moved_by(stuck())])
    assert "the body jumps" not in other.verdict.sentence
    assert sum("the body jumps" in each for each in other.checks) == 1


def test_a_stored_model_keeps_its_jumps(tmp_path):
    arm = still_model()
    arm.validation = Validation(0.5, (0.5,) * 3, ROWS, jump_mm=0.37)
    save_model(arm, tmp_path / "arm")
    assert load_model(tmp_path / "arm").validation.jump_mm == pytest.approx(0.37)
    arm.validation = Validation(0.5, (0.5,) * 3, ROWS)
    save_model(arm, tmp_path / "old")
    assert load_model(tmp_path / "old").validation.jump_mm is None


def test_a_fit_states_the_jumps_of_its_recordings():
    recordings = [moved_by(stuck(seed), seed=seed) for seed in (1, 2)]
    model = fit(recordings, epochs=2, hidden=(8,), prior="none").model
    assert model.validation.jump_mm == pytest.approx(jump_level(model, recordings))
    assert model.validation.jump_mm > 0.3


def test_noise_makes_no_level():
    assert jump_level(still_model(), [moved_by(np.zeros((ROWS, 3, 3)))]) == 0.0
    settled = replace(moved_by(stuck()), kind="settled")
    assert jump_level(still_model(), [settled]) == 0.0
    assert not len(jumps_in(residual_table(still_model(), [settled])).rows)


def test_after_a_slip_the_next_step_is_a_diagnosis_of_the_rows_before_it():
    slip = moved_by(bending() + shifted(1, 500, [0.0, 0.6, 0.0]))
    found = diagnose(still_model(), [slip], setup_tests=False, refit="never")
    assert found.verdict.kind == "unknown_effect"
    assert "its marker has probably slipped, so use the rows before" in found.verdict.sentence
    # The command cuts them: those before the slip, but not many fewer.
    command = found.command("ARM", "REC")
    until = float(command.split("--until ")[1].split()[0])
    assert slip.t_s[500] - 0.04 * slip.t_s[-1] - 1.0 <= until <= slip.t_s[500]
    rest = f"surgisoft recording REC --until {until:.0f} -o REC_BEFORE_THE_SLIP.parquet"
    assert command == rest
    # Of several recordings it is not said which one it is in.
    halves = [part_of(slip, None, 20.0), part_of(slip, 20.0)]
    two = diagnose(still_model(), halves, setup_tests=False, refit="never")
    assert two.command("ARM", "REC") == "surgisoft diagnose ARM REC_BEFORE_THE_SLIP"
