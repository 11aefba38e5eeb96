"""Faults of a set-up that were put into recordings are named, corrected, and told from physics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.setup import find_setup_faults, find_small_frame
from surgisoft.diagnosis.setup.arrangements import mistaken
from surgisoft.diagnosis.setup.sample import samples_of
from surgisoft.diagnosis.setup.search import Levels, Proof, Search
from surgisoft.surrogate.checkpoint import default_arm
from tests.diagnosis.setup import recordings
from tests.diagnosis.setup.recordings import (
    NOISE_MM,
    STEP_S,
    driven,
    in_time,
    late,
    turned,
    with_points,
)
from tests.diagnosis.small import measured, predicted, predicted_along, small_arm

PSI = 6.894757293168361  # kPa, NIST SP 811
ROWS = 1200
"""Rows of a recording: two minutes."""


def points(change):
    return lambda r: with_points(r, change(r.key_points_mm))


def actuation(change):
    return lambda r: driven(r, change)


def times(factor):
    return lambda r: in_time(r, factor)


SINGLE = {
    "turned and shifted": (
        lambda r: turned(r, [0.3, -1.4, 0.5], [100.0, 3.0, -50.0]),
        "frame",
        "and shifted by (100.0, 3.0, -50.0) mm",
    ),
    "shifted": (
        lambda r: turned(r, [0.0, 0.0, 0.0], [0.0, 35.0, 0.0]),
        "frame",
        "shifted by (0.0, 35.0, 0.0) mm",
    ),
    "mirrored": (
        points(lambda x: x * [1.0, -1.0, 1.0]),
        "frame",
        "mirrored: the sign of y is wrong",
    ),
    "swapped": (
        points(lambda x: x[..., [1, 0, 2]]),
        "frame",
        "mirrored: the axes x and y are swapped",
    ),
    "cm": (points(lambda x: x / 10), "length_unit", "in cm where mm are stated"),
    "inch": (points(lambda x: x / 25.4), "length_unit", "in inches where mm are stated"),
    "mm read as m": (points(lambda x: x * 1000), "length_unit", "mm were read as m"),
    "psi": (actuation(lambda u: u / PSI), "actuation_unit", "in psi where kPa is stated"),
    "Pa": (actuation(lambda u: u * 1000), "actuation_unit", "in Pa where kPa is stated"),
    "kPa converted from psi": (
        actuation(lambda u: u * PSI),
        "actuation_unit",
        "6.89476 times too large: kPa were read as psi",
    ),
    "psi converted from bar": (
        actuation(lambda u: u * 100 / PSI),
        "actuation_unit",
        "14.5038 times too large: psi were read as bar and converted to kPa",
    ),
    "inches converted from cm": (
        points(lambda x: x / 2.54),
        "length_unit",
        "2.54 times too small: inches were read as cm and converted to mm",
    ),
    "permuted": (
        actuation(lambda u: u[:, [1, 2, 0]]),
        "chambers",
        "chambers 1, 2, 3 are driven by channels 3, 1, 2",
    ),
    "sign": (
        actuation(lambda u: u * [1.0, 1.0, -1.0]),
        "chambers",
        "the sign of chamber 3 is flipped",
    ),
    "reversed": (points(lambda x: x[:, ::-1]), "key_points", "in reverse order, tip to base"),
    "ms": (times(1e3), "time_unit", "1,000 times too large: ms were read as s"),
    "s read as ms": (times(1e-3), "time_unit", "1,000 times too small: s were read as ms"),
    "us": (times(1e6), "time_unit", "1,000,000 times too large: us were read as s"),
    "late": (lambda r: late(r, 6), "time", "s late relative to the actuation"),
    "early": (lambda r: late(r, -4), "time", "s early relative to the actuation"),
}


@pytest.fixture(scope="module")
def model():
    return small_arm()


PAIRS = [
    ("turned and shifted", "permuted"),
    ("mirrored", "sign"),
    ("cm", "reversed"),
    ("psi", "late"),
    ("turned and shifted", "late"),
    ("permuted", "psi"),
    ("ms", "turned and shifted"),
    ("s read as ms", "reversed"),
]
ALONE = ("turned and shifted", "cm", "permuted", "reversed", "ms", "late")
"""Faults that are looked for alone, too: one of each kind. Others are parts of pairs."""


@pytest.mark.parametrize("name", [n for n in SINGLE if n in ALONE or n not in sum(PAIRS, ())])
def test_one_fault_is_named_and_mended(model, name):
    change, kind, words = SINGLE[name]
    original = measured(ROWS)
    wrong = change(original)
    found = find_setup_faults(model, [wrong])
    assert found.kinds == (kind,)
    assert words in found.sentence.replace("-0.0", "0.0")
    assert found.alternatives == ()
    corrected = found.corrected([wrong])[0]
    assert find_setup_faults(model, [corrected]) is None
    if kind != "time":
        apart = corrected.key_points_mm - original.key_points_mm
        assert np.sqrt(np.square(apart).sum(2).mean()) < 0.05
        np.testing.assert_allclose(corrected.measured, original.measured, atol=1e-9)


def test_where_channels_are_tied_only_an_exact_exchange_is_a_fault(model):
    """Channels 2 and 3 move as one, and 1 is exchanged with them: half a hundredth of the error is
    left. Where that is too much, the exchange may be one of many that lead a model back to what it
    knows; recordings that tie no channels show any exchange."""
    tied = predicted_along(lambda free: free[:, [0, 1, 1]], ROWS)
    wrong = driven(tied, lambda free: free[:, [2, 1, 0]])
    seen = replace(wrong, key_points_mm=wrong.key_points_mm + 0.05, noise_mm=NOISE_MM)
    found = find_setup_faults(model, [seen])
    assert found is not None
    assert found.kinds == ("chambers",)
    samples = samples_of(model, [seen], (400, 2500, len(seen.measured)))
    told = {}
    for orders, share in ((True, 1e-9), (False, 0.1), (False, 1e-9)):
        rest = Levels(NOISE_MM, 0.1), mistaken(model.spec, seen.measured)
        told[orders, share] = Search(*samples, *rest, proof=Proof(tied=share), orders=orders).run()
    assert told[True, 1e-9].best.hypothesis.kinds == ("chambers",)
    assert told[False, 0.1].best.hypothesis.kinds == ("chambers",)
    assert told[False, 1e-9] is None


def test_without_noise_a_rotation_is_exact(model):
    vector, shift = np.array([0.9, 0.2, -1.1]), [12.0, -70.0, 3.0]
    found = find_setup_faults(model, [turned(predicted(ROWS), vector, shift)])
    rotation = np.array(found.faults[0].numbers["rotation"])
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found.faults[0].numbers["shift_mm"], shift, atol=1e-6)
    expected = np.degrees(np.linalg.norm(vector))
    assert found.faults[0].numbers["turn_deg"] == pytest.approx(expected, abs=1e-6)


def test_an_offset_in_time_is_estimated_within_its_error(model):
    found = find_setup_faults(model, [late(measured(ROWS), 7)])
    fault = found.faults[0]
    assert fault.numbers["late_s"] == pytest.approx(0.7, abs=4 * fault.errors["late_s"] + 1e-3)
    assert fault.errors["late_s"] < 0.02


@pytest.mark.parametrize("rows", [12, -12])
def test_a_lag_within_an_offset_of_the_clocks_is_told(model, rows):
    """A line that is slower by 0.2 s delays the body as clocks that are apart by 0.2 s more do."""
    offset_s = STEP_S * rows
    slower = find_setup_faults(model, [late(lagged(predicted(ROWS), 0.2), rows)])
    unchanged = find_setup_faults(model, [late(measured(ROWS), rows)])
    assert slower.kinds == unchanged.kinds == ("time",)
    numbers = slower.faults[0].numbers
    assert 0.1 < numbers["late_s"] - offset_s < 0.25
    assert numbers["likelier_lag_s"] == pytest.approx(0.2, abs=0.05)
    assert numbers["likelier_late_s"] == pytest.approx(offset_s, abs=0.08)
    assert numbers["hidden_lag_s"] > 0.2
    assert f"a lag that has grown by {numbers['likelier_lag_s']:.2f} s" in slower.sentence
    assert f"changed by up to {numbers['hidden_lag_s']:.2f} s would look" in slower.sentence
    assert "likelier_lag_s" not in unchanged.faults[0].numbers
    assert "has grown" not in unchanged.sentence


@pytest.mark.parametrize("pair", PAIRS, ids=" + ".join)
def test_two_faults_are_both_named(model, pair):
    wrong = measured(ROWS)
    for name in pair:
        wrong = SINGLE[name][0](wrong)
    found = find_setup_faults(model, [wrong])
    assert sorted(found.kinds) == sorted(SINGLE[name][1] for name in pair)
    for name in pair:
        assert SINGLE[name][2] in found.sentence.replace("-0.0", "0.0")
    assert find_setup_faults(model, found.corrected([wrong])) is None


def lagged(recording, tau_s: float):
    """Key points behind a first-order lag, by a difference equation of its own."""
    keep = np.exp(-np.diff(recording.t_s).mean() / tau_s)
    x = recording.key_points_mm
    return with_points(recording, lfilter([1 - keep], [1, -keep], x, axis=0, zi=keep * x[:1])[0])


PHYSICS = {
    "nothing": lambda r: r,
    "a misalignment of 5 degrees": lambda r: turned(r, [0.05, 0.07, -0.02], [2.0, -1.0, 0.5]),
    "a gain of 7 %": actuation(lambda u: u * [1.07, 1.0, 1.0]),
    "a gain that is between those of two units": actuation(lambda u: u * 5.0),
    "a lag of 0.25 s": lambda r: lagged(r, 0.25),
    "a lag of 30 s": lambda r: lagged(r, 30.0),
    "a load that bends the arm aside": points(
        lambda x: x + np.array([4.0, 0.0, 0.0]) * np.linspace(0, 1, 5)[:, None] ** 2
    ),
    "a drift": lambda r: with_points(
        r, r.key_points_mm + np.linspace(0, 4, r.samples)[:, None, None] * [0.0, 1.0, 0.0]
    ),
}


CLOSE = ("a lag of 0.25 s", "a gain that is between those of two units")
"""Physics that is nearly a fault: only the default arm in four minutes shows an error of a search
that takes it for one."""


@pytest.mark.parametrize("name", PHYSICS)
def test_physics_is_no_fault_of_the_set_up(model, name):
    arm, made = (default_arm(), recordings.measured()) if name in CLOSE else (model, measured(ROWS))
    assert find_setup_faults(arm, [PHYSICS[name](made)]) is None


def test_one_of_two_recordings_with_a_turned_frame(model):
    right = measured(ROWS)
    wrong = replace(turned(measured(ROWS, seed=3), [0.0, 1.2, 0.0]), name="moved")
    found = find_setup_faults(model, [right, wrong])
    assert found.recordings == ("moved",)
    assert found.kinds == ("frame",)
    same, corrected = found.corrected([right, wrong])
    assert same is right
    assert find_setup_faults(model, [same, corrected]) is None


def test_a_diagnosis_ends_with_the_set_up(model):
    found = diagnose(model, [turned(measured(ROWS), [0.0, 0.0, 2.0])])
    assert found.verdict.kind == "setup"
    assert found.verdict.effects == ()
    assert found.error_mm.before > 10 * found.error_mm.best_achievable
    plain = found.to_json()["setup"]
    assert plain["faults"][0]["kind"] == "frame"
    assert plain["correctable"] is plain["mendable"] is True
    assert plain["mending"] == plain["instructions"] == found.setup.instructions != ""
    assert plain["alternative_mendings"] == plain["alternative_instructions"] == []
    assert "114.6 deg about z" in found.verdict.sentence  # 2 rad


@pytest.mark.parametrize(
    ("by", "said"),
    [
        (0.1, "the actuation is in cm where mm is stated"),
        (2.54, "2.54 times too large: cm were read as inches and converted to mm"),
        (1000.0, "1000 times too large: mm were read as m"),
    ],
)
def test_tendons_in_another_unit_of_length_are_found(by, said):
    """The default arm as if its actuation were displacements of tendons in mm."""
    arm = small_arm()
    tendons = arm.replace(spec=replace(arm.spec, unit="mm"))
    right = replace(measured(ROWS), unit="mm")
    wrong = replace(right, measured=by * right.measured)
    found = find_setup_faults(tendons, [wrong])
    assert found is not None
    assert found.kinds == ("actuation_unit",)
    assert said in found.sentence
    (corrected,) = found.corrected([wrong])
    np.testing.assert_allclose(corrected.measured, right.measured, rtol=1e-9)


def test_a_small_change_of_the_frame_is_told_apart_from_no_explanation(model):
    """A camera that was bumped is no set-up fault, but it explains the error; a gain does not."""
    vector, shift = np.array([0.03, -0.04, 0.02]), np.array([8.0, -5.0, 2.0])
    bumped = turned(measured(ROWS), vector, shift)
    assert find_setup_faults(model, [bumped]) is None
    fault, left_mm = find_small_frame(model, [bumped])
    expected = np.degrees(np.linalg.norm(vector))
    assert fault.numbers["turn_deg"] == pytest.approx(expected, abs=0.05)
    np.testing.assert_allclose(fault.numbers["shift_mm"], shift, atol=0.1)
    assert left_mm == pytest.approx(np.sqrt(3) * NOISE_MM, rel=0.1)
    for name in ("nothing", "a gain of 7 %", "a lag of 0.25 s"):
        assert find_small_frame(model, [PHYSICS[name](measured(ROWS))]) is None
    assert find_small_frame(model, [SINGLE["mirrored"][0](measured(ROWS))]) is None
