"""A few robots of the diagnosis benchmark, and its table counted by hand."""

import shutil
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.studies.diagnosis import Case, Outcome, bent, cases, record, run_case
from surgisoft.studies.diagnosis_table import calibration_error, markdown
from surgisoft.surrogate.checkpoint import DEFAULT_FOLDER
from surgisoft.surrogate.default import default_arm

CLEAN = Case(0, (), 0.0, "white", "medium", take=5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Base models: that of specimen 0 is the arm of the package."""
    place = tmp_path_factory.mktemp("base")
    shutil.copytree(DEFAULT_FOLDER, place / "robot-0")
    return place


@pytest.mark.parametrize(
    ("case", "kind", "effects"),
    [
        (CLEAN, "nothing_missing", ()),
        (replace(CLEAN, hidden=(("softening", 2.0),)), "identified", ("softening",)),
        (
            replace(CLEAN, hidden=(("gain_mismatch", 1.0),), surrogate_mm=0.25),
            "identified",
            ("gain_mismatch",),
        ),
    ],
)
def test_robots_of_known_truth(folder, case, kind, effects):
    said = run_case(case, folder)
    assert said.kind == kind
    assert said.effects == effects
    assert (said.effect_mm > 0.2) == bool(case.hidden)
    assert said.surrogate_mm >= case.surrogate_mm - 0.02


def test_a_bent_surrogate_has_the_wanted_error():
    model = default_arm()
    worse = bent(model, 0, 0.3, seed=4)
    assert worse.validation["rmse_mm"] == pytest.approx(0.3, rel=0.05)
    assert model.validation["rmse_mm"] < 0.15


def test_correlated_noise_is_stated():
    plain, size = record(replace(CLEAN, excitation="poor"))
    noisy, _ = record(replace(CLEAN, excitation="poor", noise="correlated"))
    assert size == 0.0
    added = noisy.key_points_mm - plain.key_points_mm
    assert np.nanstd(added[:, -1]) == pytest.approx(0.05, rel=0.4)
    assert noisy.noise_mm == pytest.approx((plain.noise_mm**2 + 0.05**2) ** 0.5)


def test_cases_are_those_of_their_seed():
    some = cases([1, 2], 80, seed=3)
    assert some == cases([1, 2], 80, seed=3)
    assert some != cases([1, 2], 80, seed=4)
    kinds = Counter(len(case.hidden) for case in some)
    assert kinds[2] == 8
    assert sum(not case.hidden and not case.undertrained for case in some) == 20


def said(case: Case, kind: str, ranking: tuple[str, ...], confidence: float, named=True):
    effects = ranking[:1] if named else ()
    return Outcome(case, kind, effects, ranking, confidence, 0.5, 0.1, 2.0, {})


def test_table_counts():
    creep = replace(CLEAN, hidden=(("creep", 1.0),))
    lag = replace(CLEAN, hidden=(("line_lag", 1.0),))
    leak = replace(CLEAN, hidden=(("leak", 1.0),))
    outcomes = [
        said(creep, "identified", ("creep", "drift"), 0.99),
        said(lag, "identified", ("creep", "line_lag"), 0.6),
        said(CLEAN, "nothing_missing", ("creep",), 0.0, named=False),
        said(leak, "unknown_effect", ("coupling",), 0.0, named=False),
    ]
    text = markdown(outcomes)
    assert "| right effect first, memory effects | 97 % | 50.0 % (1 of 2;" in text
    assert "| right among the first two, as before | 97 % | 100.0 % (2 of 2;" in text
    assert "| an effect named on a clean robot | 2 % | 0.0 % (0 of 1;" in text
    assert "| outside the list: `unknown_effect` | 80 % | 100.0 % (1 of 1;" in text
    assert "| statements with confidence >= 0.95 right | 97 % | 100.0 % (1 of 1;" in text
    # Two statements: 0.99 that is right, 0.6 that is wrong.
    assert calibration_error(outcomes[:2]) == pytest.approx((0.01 + 0.6) / 2)
