"""Questions that cannot be asked of recordings, and sentences of results made by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.compare import Comparison, compare, compare_all
from surgisoft.diagnosis.design.next_experiment import propose
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.estimation.intervals import Parameter, values_text
from surgisoft.diagnosis.other_models import predicted_arm
from surgisoft.diagnosis.pairs import before_and_after
from surgisoft.diagnosis.refit import Refit, RefitCandidate, refit_reason
from surgisoft.diagnosis.residuals import Floor, Sealed, residual_table
from surgisoft.diagnosis.setup.alignment import Frame
from surgisoft.diagnosis.setup.correction import Correction
from surgisoft.diagnosis.setup.sample import Arrangement
from surgisoft.diagnosis.setup.words import faults_of, joined
from tests.diagnosis.synthetic import POINTS, recording, still_model, walk
from tests.refusals import refusal

ROWS = 240


def some(**more):
    """A recording of the still arm that nothing is wrong with."""
    return recording(np.zeros(ROWS), walk(ROWS), **more)


def never_finite():
    """A model that predicts NaN."""
    model = still_model()
    model.network.mean[0] = torch.nan
    return model


def test_questions_that_cannot_be_asked_are_one_line():
    plain, unseen = some(), replace(some(), key_points_mm=np.full((ROWS, 3, 3), np.nan))
    model, fewer = still_model(), still_model(points=POINTS[:2])
    table = residual_table(model, [plain])
    for call, message in (
        (lambda: diagnose(model, [plain], without=["ghost"]), "unknown effect 'ghost'"),
        (
            lambda: diagnose(model, [plain], before=[replace(plain)], refit="always"),
            "leave out one of the",
        ),
        (lambda: diagnose(model, [plain], refit="perhaps"), "unknown refit 'perhaps'"),
        (lambda: compare(model, [unseen]), "no key point was measured in any row of the record"),
        (lambda: compare_all([model, fewer], [plain]), "key points"),
        (lambda: residual_table(never_finite(), [plain]), "predicts values that are not finite"),
        (lambda: before_and_after(table, [], "auto"), "no recording from before the change; exp"),
        (lambda: before_and_after(table, [plain], "maybe"), "unknown choice of pairing 'maybe'"),
        (lambda: propose(model, ["creep", "drift"]), "effect 'creep' changes nothing on this arm"),
        (lambda: predicted_arm("lab", [plain]), "lab: the recordings have no predicted key point"),
    ):
        assert message in refusal(call)


def test_a_body_that_moves_without_actuation_is_refused():
    """A log that kept its first row, of an arm whose tip goes over twice its length."""
    points = POINTS + 10.0 * np.sin(np.arange(ROWS) / 9.0)[:, None, None] * [1.0, 0.0, 0.0]
    dead = replace(some(), key_points_mm=points, measured=np.full((ROWS, 2), 2.0), commanded=None)
    for asked in (diagnose, compare):
        text = refusal(lambda asked=asked: asked(still_model(), [dead]))
        assert "no channel of the actuation moves (2, 2 kPa in every row)" in text
        assert "and import again" in text
    hung = replace(dead, payload_g=np.where(np.arange(ROWS) < ROWS // 2, 0.0, 50.0))
    assert np.isfinite(compare(still_model(), [hung])[0].rmse_mm), "a load moves it"
    plain = replace(some(), measured=dead.measured, commanded=None)
    at_rest = [plain, replace(plain, name="turned", key_points_mm=plain.key_points_mm + 50.0)]
    assert np.isfinite(compare(still_model(), at_rest)[0].rmse_mm), "no body moves in any of them"


def test_held_out_rows_are_opened_once():
    sealed = Sealed([some()])
    table = residual_table(still_model(), sealed.training)
    opened = sealed.opened(table)
    assert np.isfinite(opened.measured_mm).sum() > np.isfinite(table.measured_mm).sum()
    with pytest.raises(ValueError, match="they allow one evaluation only"):
        sealed.opened(table)


def comparison(**fields) -> Comparison:
    found, _ = compare(still_model(), [recording(np.zeros(40), walk(40))])
    return replace(found, **({"rmse_mm": 1.0, "floor": Floor(0.1, "sidecar")} | fields))


def test_the_sentence_of_a_comparison_says_as_much_as_is_known():
    plain = comparison()
    assert plain.sentence == "error 1.00 mm, floor 0.10 mm; too few rows to say what it depends on"
    near = replace(plain, rmse_mm=0.1)
    assert near.sentence == "error 0.10 mm, floor 0.10 mm: the error is at the floor"
    unknown = replace(plain, floor=Floor(None, "unknown"))
    assert unknown.sentence.startswith("error 1.00 mm, floor unknown; too few rows")


def candidate(name: str, **fields) -> RefitCandidate:
    values = {
        "effect": name, "heldout_rmse_mm": 0.2, "per_key_point_mm": (0.2,), "seeds_mm": (0.2,),
        "rival_mm": 0.5, "difference_mm": 0.3, "ci95_mm": (0.2, 0.4), "spread_mm": 0.1,
        "gain": 0.9, "log_gain": 0.9, "p_value": 0.001, "epochs": 5,
        "stages": (5,), "plausible": True,
        "parameters": {},
    }  # fmt: skip
    return RefitCandidate(**(values | fields))


def refit(winner, competing=(), of_line=False) -> Refit:
    tried = (candidate("line_lag"), candidate("creep"))
    return Refit(
        "it was asked for", 0.5, tried, winner, competing, of_line, 0.8, (("drift", "static"),),
        "runs", 8, 400, 10, 3.0,
    )  # fmt: skip


def test_the_sentence_of_a_refit_names_what_would_do_as_well():
    none = refit(None)
    assert none.names == ()
    assert none.sentence.endswith("network alone (0.5 mm on held-out runs)")
    alone = refit("line_lag")
    assert alone.sentence.endswith("line_lag leaves 0.2 mm of 0.5 mm on held-out runs")
    assert not alone.ambiguous
    both = refit("line_lag", ("creep",))
    assert both.sentence.endswith("; creep would fit about as well")
    assert (both.ambiguous, both.names) == (True, ("line_lag", "creep"))
    line = refit("line_lag", ("creep",), of_line=True)
    assert line.sentence.endswith("has to pass the line: measure the actuation to tell them apart")
    assert not line.ambiguous
    assert none.to_json()["not_tried"] == [{"effect": "drift", "why": "static"}]
    weak = (("plausible", False), ("p_value", 0.5), ("gain", 0.0), ("log_gain", 0.0))
    assert candidate("creep").named
    assert not any(candidate("creep", **{name: value}).named for name, value in weak)


def test_modes_of_a_refit():
    assert refit_reason(None, "never") == ""
    assert refit_reason(None, "always") == "it was asked for"
    assert "unknown refit 'perhaps'" in refusal(lambda: refit_reason(None, "perhaps"))


def test_many_values_are_summed_up():
    assert values_text(2.0) == "2"
    assert values_text([1.0, 2.5]) == "[1, 2.5]"
    many = np.arange(12.0).reshape(4, 3).tolist()
    assert values_text(many) == "12 values, least 0, largest 11"

    def parameter(value, low, high) -> Parameter:
        return Parameter("creep", "tau", value, low, high, "s", False, (3.0, 9.0), "Smith 2001")

    assert parameter(2.0, 1.0, 4.0).interval_text == "1 to 4"
    assert parameter(2.0, 2.0, 2.0).interval_text == ""
    assert parameter(many, many, many).interval_text == ""
    assert parameter(2.0, 1.0, 4.0).may_be_plausible, "its interval reaches into the range"
    assert not parameter(2.0, 1.0, 2.5).may_be_plausible
    assert parameter(2.0, 1.0, 4.0).to_json()["ci95"] == [1.0, 4.0]


PLAIN = Arrangement.as_recorded(2)


def test_a_correction_needs_what_it_takes():
    """The command in the place of a dead channel, and runs that are longer than the offset."""
    base = {"arrangement": PLAIN, "points": (0, 1, 2), "unit": "kPa", "recorded_unit": "kPa"}
    given = some()
    assert "no commanded actuation (columns c1_kPa ...), expected one to replace a d" in refusal(
        lambda: Correction(**base, from_command=(1,)).applied(given)
    )
    driven = replace(given, commanded=given.measured + 1.0)
    corrected = Correction(**base, from_command=(1,)).applied(driven)
    np.testing.assert_allclose(corrected.measured[:, 1], driven.commanded[:, 1])
    np.testing.assert_allclose(corrected.measured[:, 0], driven.measured[:, 0])
    assert "every run is shorter than the offset of the clocks, 1e+03 s; record longer" in refusal(
        lambda: Correction(**base, delay_s=1000.0).applied(given)
    )
    late = Correction(**base, delay_s=0.2).applied(driven)
    assert late.samples == ROWS - 2
    np.testing.assert_allclose(late.measured, driven.measured[2:], atol=1e-9)
    np.testing.assert_allclose(late.commanded, driven.commanded[2:])
    moved = Correction(**base, mm_per_unit=10.0, origin_mm=np.array([0.0, 0.0, 5.0]), lost=(1,))
    points = moved.applied(given).key_points_mm
    np.testing.assert_allclose(points[:, 0], 10 * given.key_points_mm[:, 0] - [0, 0, 5])
    assert np.isnan(points[:, 1]).all()


class Explained:
    """As much of an explanation as its words need."""

    def __init__(self, kinds, arrangement=PLAIN, points=(0, 1, 2), mm_per_unit=1.0):
        self.hypothesis = self
        self.kinds, self.arrangement, self.points = kinds, arrangement, points
        self.mm_per_unit = mm_per_unit

    def turn_and_shift_errors(self):
        return 1e-3, np.full(3, 0.01)


FLIPPED = Arrangement((0, 1), (-1.0, -1.0), 1.0)
IDLE = Arrangement((0, 1), (1.0, 0.0), 1.0)
STILL = Frame(np.eye(3), np.zeros(3), np.array(1.0))


@pytest.mark.parametrize(
    ("given", "frame", "text"),
    [
        (Explained(("key_points",), points=(2, 1, 0)), STILL, "are in reverse order, tip to base"),
        (Explained(("key_points",), points=(1, 0, 2)), STILL, "base to tip they are k1, k0, k2"),
        (Explained(("length_unit",), mm_per_unit=10.0), STILL, "are in cm where mm are stated"),
        (Explained(("length_unit",), mm_per_unit=0.001), STILL, "1000 times too large: mm were re"),
        (Explained(("length_unit",), mm_per_unit=0.3), STILL, "positions are 3.33333 times too la"),
        (Explained(("length_unit",), mm_per_unit=3.0), STILL, "positions are 3 times too small"),
        (Explained(("actuation_unit",)), STILL, "the actuation is in psi where kPa is stated"),
        (
            Explained(("chambers",), Arrangement((1, 0), (-1.0, 1.0), 1.0)),
            STILL,
            "chambers 1, 2 are driven by channels 2, 1; the sign of chamber 1 is flipped",
        ),
        (Explained(("chambers",), FLIPPED), STILL, "the signs of chambers 1, 2 are flipped"),
        (Explained(("chambers",), IDLE), STILL, "chamber 2 does not act: the body moves as if it"),
        (
            Explained(("frame",)),
            Frame(np.diag([1.0, -1.0, 1.0]), np.zeros(3), np.array(1.0)),
            "mirrored: the sign of y is wrong",
        ),
        (
            Explained(("frame",)),
            Frame(np.eye(3)[[1, 0, 2]], np.zeros(3), np.array(1.0)),
            "mirrored: the axes x and y are swapped",
        ),
        (
            Explained(("frame",)),
            Frame(np.eye(3)[[1, 0, 2]] * [1.0, 1.0, -1.0] * [[-1.0], [1.0], [-1.0]], np.zeros(3),
                  np.array(1.0)),
            "x y z are",
        ),
        (
            Explained(("frame",)),
            Frame(np.eye(3), np.array([0.0, 9.0, 0.0]), np.array(1.0)),
            "shifted by (0.0, 9.0, 0.0) mm",
        ),
        (
            Explained(("frame",)),
            Frame(np.eye(3)[[0, 2, 1]] * [[1], [1], [-1]], np.array([5.0, 0, 0]), np.array(1.0)),
            "about",
        ),
    ],
)  # fmt: skip
def test_faults_of_a_set_up_are_named(given, frame, text):
    faults = faults_of(given, frame, "kPa", ("psi", "kPa"))
    assert text in joined(faults)
    assert [fault.kind for fault in faults] == list(given.kinds)
