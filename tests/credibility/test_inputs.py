"""Inputs of an assessment: equivalence, what is not known, and what the report then says."""

import dataclasses
import hashlib
from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.credibility.assessment import (
    Assessment,
    PointError,
    assess,
    criteria_of,
    fingerprint,
    inputs_of,
    point_errors,
)
from surgisoft.credibility.context import (
    Context,
    Limits,
    Risk,
    Scenario,
    Source,
    Uncertainty,
    load_context,
)
from surgisoft.credibility.domain import States, applicability, rates, states_of
from surgisoft.credibility.metrics import Criterion, ValidationUncertainty
from surgisoft.credibility.of_experiment import arm_of, check_context
from surgisoft.credibility.retest import Estimate, Repeated, Retest, Told
from surgisoft.credibility.scenario import (
    agreement,
    outcomes,
    scenario_states,
    states_of_episode,
    stored_episodes,
)
from surgisoft.credibility.uncertainty import Budget, budget
from surgisoft.diagnosis.other_models import predicted_arm
from surgisoft.diagnosis.residuals import UNKNOWN, residual_table
from surgisoft.errors import InputError
from surgisoft.experiments.spec import Case, load_experiment
from surgisoft.measurement.recordings import Recording, save_recording
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.effects import EFFECTS
from surgisoft.tasks.episodes.file import save_episode
from tests.experiments import tiny
from tests.tasks.test_episode import made_up

REST = np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 60.0]])
DOWN = np.array([0.0, 0.0, 1.0])
SPEC = ArmSpec(2, 2, (0.0, 0.0), (10.0, 10.0), band=(0.1, 0.1))


def recording(rows: int = 60, name: str = "rec", **more) -> Recording:
    """Two chambers between 1 and 9 kPa; the tip moves 1 mm/kPa in x with the first."""
    pressure = 5.0 + 4.0 * np.sin(np.outer(np.arange(rows) / 9.0, [1.0, 1.7]))
    points = np.tile(REST, (rows, 1, 1))
    points[:, 1, 0] += pressure[:, 0] - 5.0
    given = {"measured": pressure, "key_points_mm": points, "noise_mm": 0.05} | more
    return Recording(name, 0.1 * np.arange(rows), **given)


def context(**more) -> Context:
    return Context("May it be sent there?", "planning", Risk("low", "low"), **more)


def model_of(spec: ArmSpec, *effects: str):
    return SimpleNamespace(spec=spec, effects={name: EFFECTS[name] for name in effects})


LOADED = {"payload_g": np.full(60, 20.0)}
UNLOADED = {"payload_g": np.zeros(60)}
WARM = {"temp_C": np.full(60, 25.0)}


@pytest.mark.parametrize(
    ("spec", "effects", "measured", "place", "expected"),
    [
        ({}, (), {}, 2, ("not stated", "not stated", None)),
        ({}, (), {"gravity": DOWN}, 2, ("(0.000, 0.000, 1.000)", "not stated", None)),
        ({"gravity": (0, 0, 1)}, (), {"gravity": DOWN}, 2, (*["(0.000, 0.000, 1.000)"] * 2, True)),
        ({"gravity": (0, 1, 0)}, (), {"gravity": DOWN}, 2,
         ("(0.000, 0.000, 1.000)", "(0.000, 1.000, 0.000)", False)),
        ({}, (), {}, 3, ("not stated", "none", None)),
        ({}, (), UNLOADED, 3, ("0 to 0", "none", True)),
        ({}, (), LOADED, 3, ("20 to 20", "none", False)),
        ({}, ("payload",), LOADED, 3, ("20 to 20", "payload, as fitted", None)),
        ({}, (), {}, 4, ("not stated", "not stated", None)),
        ({}, (), WARM, 4, ("25.0 to 25.0", "not stated", None)),
        ({"temperature_C": 24.0}, (), WARM, 4, ("25.0 to 25.0", "24.0", True)),
        ({"temperature_C": 20.0}, (), WARM, 4, ("25.0 to 25.0", "20.0", False)),
    ],
)  # fmt: skip
def test_inputs_are_equivalent_as_far_as_both_sides_state_them(
    spec, effects, measured, place, expected
):
    arm = model_of(dataclasses.replace(SPEC, **spec), *effects)
    found = inputs_of(arm, [recording(**measured)])
    assert (found[place].measured, found[place].simulated, found[place].equivalent) == expected


def test_inputs_of_several_recordings_are_equivalent_where_those_of_each_are():
    """Weight, load and room of the second differ, or are not stated of it."""
    spec = dataclasses.replace(SPEC, gravity=(0.0, 0.0, 1.0), temperature_C=25.0)
    cold = np.full(60, 25.0)
    cold[30] = 20.0
    good = {"gravity": DOWN, "payload_g": np.zeros(60), "temp_C": np.full(60, 25.0)}
    turned = {"gravity": np.array([0.0, 1.0, 0.0]), "payload_g": np.full(60, -3.0), "temp_C": cold}
    part = np.zeros(60)
    part[5] = np.nan
    for more, equivalent in (
        (good, (True, True, True)),
        (turned, (False, False, False)),
        ({}, (None, None, True)),
        ({"payload_g": part}, (None, None, True)),
    ):
        some = [recording(**good), recording(name="second", **more)]
        found = inputs_of(model_of(spec), some)[2:]
        assert tuple(each.equivalent for each in found) == equivalent


def test_errors_of_points_by_hand():
    """The base is predicted 1 mm too far in x, the tip 2 mm too far back in y; of the tip a row is
    missing."""
    measured = np.zeros((4, 2, 3))
    predicted = measured + np.array([[1.0, 0.0, 0.0], [0.0, -2.0, 0.0]])
    measured[2, 1] = np.nan
    table = SimpleNamespace(
        residual_mm=measured - predicted, predicted_mm=predicted, measured_mm=measured
    )
    compared = SimpleNamespace(per_key_point_mm=(1.0, 2.0), rmse_mm=1.5)
    each = tuple(ValidationUncertainty(noise, None, None, None) for noise in (0.1, 0.2))
    parts = Budget(each, ValidationUncertainty(0.15, None, None, None), {}, ())
    base, tip, body = point_errors(table, compared, parts)
    assert (base.label, tip.label, body.label) == ("k0", "k1", "body")
    assert (base.error_mm, tip.error_mm, body.error_mm) == (1.0, 2.0, 1.5)
    assert base.bias_mm == pytest.approx((1.0, 0.0, 0.0))
    assert tip.bias_mm == pytest.approx((0.0, -2.0, 0.0))
    assert body.bias_mm is None
    found = [point.uncertainty_mm / 1.959964 for point in (base, tip, body)]
    assert found == pytest.approx([0.1, 0.2, 0.15])
    areas = [point.area_mm for point in (base, tip, body)]
    assert areas == pytest.approx([1.0, 2.0, np.sqrt((1.0 + 4.0) / 2)])


def test_nothing_is_met_by_errors_on_rows_of_the_fit():
    points = [PointError(n, 0.1, None, 0.1, 0.1) for n in ("k0", "k1", "body")]
    limits = Limits(error_mm=9.0, tip_error_mm=9.0, area_mm=9.0)
    for fitted in (True, False):
        found = criteria_of(context(limits=limits), points, None, fitted)
        assert [each.passed for each in found] == [not fitted] * 3


def test_a_key_point_that_was_never_measured_has_no_limit_to_keep():
    unknown = PointError("k0", float("nan"), None, float("nan"), float("nan"))
    points = [unknown, PointError("k1", 1.0, None, 0.5, 0.4), PointError("body", 1.0, None, 0.5, 0)]
    found = criteria_of(context(limits=Limits(error_mm=1.6, area_mm=0.5)), points, None)
    assert [(each.value, each.passed) for each in found] == [(1.5, True), (0.4, True)]


def test_key_points_of_an_episode_are_in_the_frame_of_the_arms_base():
    """The base stands at x = 10 mm and is turned by 90 degrees about z: its x is the world's y."""
    log = episode()
    mount = np.eye(4)
    mount[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    mount[0, 3] = 10.0
    points = np.tile([10.0, 3.0, 20.0], (*log.arms["arm"].points_mm.shape[:2], 1))
    arm = dataclasses.replace(log.arms["arm"], mount=mount, points_mm=points)
    (found,) = states_of_episode(dataclasses.replace(log, arms={"arm": arm}), "e")
    assert found.points_mm.reshape(-1, 3) == pytest.approx(
        np.tile([3.0, 0.0, 20.0], (len(points) * points.shape[1], 1))
    )


def test_a_channel_beyond_the_models_range_is_not_equivalent():
    narrow = dataclasses.replace(SPEC, high=(8.0, 10.0))
    first, second, *_ = inputs_of(model_of(narrow), [recording()])
    assert (first.equivalent, second.equivalent) == (False, True)


def test_the_sentence_follows_from_error_uncertainty_and_criteria():
    def said(error, uncertainty, *criteria) -> str:
        body = PointError("body", error, None, uncertainty, 0.1)
        names = {field.name: None for field in dataclasses.fields(Assessment)}
        known = {"points": (body,), "criteria": criteria, "comparators": ()}
        return Assessment(**names | known).sentence

    kept, broken = Criterion("a", 1.0, 2.0, "mm"), Criterion("b", 3.0, 2.0, "mm")
    assert said(1.0, 0.4).endswith("0.6 and 1.4 mm; area metric 0.1 mm; no limits are given")
    assert "this comparison cannot resolve the model's error" in said(0.3, 0.4)
    assert said(1.0, 0.4, kept, kept).endswith("; all 2 criteria are met")
    assert said(1.0, 0.4, kept, broken).endswith("; 1 of 2 criteria is not met: b")
    assert said(1.0, 0.4, broken, broken).endswith("; 2 of 2 criteria are not met: b; b")


def test_the_tip_has_a_limit_of_its_own():
    points = [PointError(n, e, None, 0.1, 0.0) for n, e in (("k0", 9.0), ("k1", 1.0), ("body", 5))]
    for limit, passed in ((1.11, True), (1.09, False)):
        (found,) = criteria_of(context(limits=Limits(tip_error_mm=limit)), points, None)
        assert (found.name, found.passed) == ("E + U_val of the tip", passed)


def test_what_a_context_says_of_no_recording_is_refused():
    stated = context(sources=(Source("other"),))
    with pytest.raises(InputError, match=r"'other' is not a recording of this comparison, .* rec"):
        assess(stated, None, SimpleNamespace(model=None), [recording()])


def test_a_recording_without_a_file_has_the_hash_of_its_arrays():
    some = recording()
    arrays = (some.t_s, some.measured, some.key_points_mm)
    digest = hashlib.sha256(b"".join(each.astype("<f8").tobytes() for each in arrays))
    assert fingerprint(some) == digest.hexdigest()
    assert fingerprint(recording(61)) != digest.hexdigest()


def test_predictions_of_a_file_have_neither_inputs_nor_steps():
    """And noise that nobody knows counts as zero, and is named as not known."""
    plain = recording()
    some = dataclasses.replace(plain, predicted_mm=plain.key_points_mm + 0.3)
    table = residual_table(predicted_arm("lab", [some]), [some])
    found = budget(dataclasses.replace(table, floor=UNKNOWN), [some], Uncertainty())
    assert found.body.unknown == ("noise", "input", "parameters", "numerical")
    assert found.body.expanded_mm == 0.0
    assert found.sources["input"].startswith("not known: predictions from a file cannot be comp")
    assert found.sources["numerical"] == "not known: predictions from a file have no steps"
    known = budget(table, [some], Uncertainty(parameters_mm=0.2, noise_mm=0.1))
    assert known.body.standard_mm == pytest.approx(np.sqrt(3 * 0.1**2 + 0.2**2))


def repeated(*spans: tuple[float, float]) -> Repeated:
    return Repeated("creep", "share", tuple(Estimate("r", (a + b) / 2, a, b) for a, b in spans))


def test_estimates_without_an_interval_are_not_compared():
    assert repeated((1.0, 1.0), (0.5, 1.5)).p_value is None
    assert repeated((1.0, np.inf), (0.5, 1.5)).p_value is None
    told = (
        Told("a", "identified", ("creep",), 0.9, ""),
        Told("b", "identified", ("creep",), 1, ""),
    )
    assert Retest(told, ()).sentence == "the diagnoses agree"
    words = Retest(told, (repeated((1.0, 1.0)),)).sentence
    assert words == "the diagnoses agree; 1 of 1 parameters are identifiable"
    assert Retest(told[:1], ()).sentence.startswith("one recording: nothing says how well")


def test_steady_state_samples_have_no_rates_and_one_row_does_not_move():
    assert np.isnan(states_of(recording(kind="settled")).rate).all()
    assert np.isfinite(states_of(recording()).rate).all()
    assert rates(np.array([3.0]), np.array([[4.0, 5.0]])).tolist() == [[0.0, 0.0]]


def test_poses_and_loads_that_no_row_has_are_not_known():
    pressure, points = np.array([[0.0], [1.0]]), np.full((2, 2, 3), np.nan)
    blind = States("s", pressure, np.zeros_like(pressure), points, np.full(2, np.nan))
    found = applicability([blind], [blind], 50.0)
    assert (found.poses, found.loads, found.rates) == (None, None, 1.0)
    assert found.whole == 1.0


def episode():
    """An episode of an arm with two key points, near nothing."""
    log = made_up(measures={"error_mm": np.arange(6.0)}, clearance_mm=np.full(6, 4.0))
    mount = np.eye(4)
    mount[2, 3] = 10.0
    arm = dataclasses.replace(log.arms["arm"], line_mm=np.zeros((6, 4, 3)), mount=mount)
    return dataclasses.replace(log, arms={"arm": arm})


def test_states_come_from_episodes_recordings_and_results(tmp_path):
    """Pressures of every arm of an episode, and key points in its base frame."""
    save_episode(episode(), tmp_path / "one.npz")
    (tmp_path / "results" / "logs").mkdir(parents=True)
    save_episode(episode(), tmp_path / "results" / "logs" / "rig-0000.npz")
    save_recording(recording(), tmp_path / "rec.parquet")
    texts = [str(tmp_path / name) for name in ("one.npz", "results", "rec.parquet")]
    scenario = Scenario(tuple(texts))
    episodes = stored_episodes(scenario)
    assert list(episodes) == ["one", "results/rig-0000"]
    chambers = episodes["one"].arms["arm"].pressure_kPa.shape[1]
    fits = SimpleNamespace(chambers=chambers, actuation="measured")
    found = scenario_states(Scenario(tuple(texts[:2])), fits, episodes)
    assert [states.label for states in found] == ["one arm", "results/rig-0000 arm"]
    seen = episodes["one"].arms["arm"].points_mm
    np.testing.assert_allclose(found[0].points_mm, seen - [0.0, 0.0, 10.0])
    (plain,) = scenario_states(Scenario(tuple(texts[2:])), SPEC, {})
    np.testing.assert_allclose(plain.pressure, recording().measured)
    assert agreement(episodes.values()) is None, "nothing is there that could be touched"


def test_simulation_is_compared_with_the_rig_where_nothing_else_differs():
    """E is the difference of the means; U_val follows from the scatter of both."""
    cases = (Case("s"), Case("r", plant="rig"), Case("other", plant="rig", policy="x"))
    titles = {"time_s": "time [s]", "none": "nothing"}
    of = SimpleNamespace(experiment=SimpleNamespace(numbers=titles))

    def setting(case, *times, values=None):
        rows = [{"time_s": value} for value in times]
        return SimpleNamespace(case=case, label=case, values=values or {}, rows=rows)

    settings = [
        setting("s", 1.0, 3.0),
        setting("r", 4.0, 8.0, float("nan")),
        setting("other", 4.0),
        setting("r", 4.0, values={"size": 2}),
    ]
    results = SimpleNamespace(experiment=SimpleNamespace(cases=cases, of=of), settings=settings)
    (found,) = outcomes(results)
    assert (found.name, found.simulated, found.rig) == ("time [s]", "s", "r")
    assert (found.error, found.episodes) == (-4.0, (2, 2))
    assert found.uncertainty == pytest.approx(1.959964 * np.sqrt(2.0 / 2 + 8.0 / 2))
    assert found.area == pytest.approx(4.0)
    settings[1].rows[1:] = []
    assert outcomes(results)[0].uncertainty is None


def test_the_arm_of_an_experiment_is_that_of_its_cases(tmp_path):
    """Or that of its task; without either, the mounts' of its scene."""
    spec = load_experiment(tiny.write(tmp_path))
    assert arm_of(spec) == "default"
    two = dataclasses.replace(spec, cases=(Case("a"), Case("b", arm="mine")))
    with pytest.raises(InputError, match="has the arm models default, mine; expected model = NAME"):
        arm_of(two)
    assert arm_of(dataclasses.replace(spec, cases=(Case("b", arm="mine"),))) == "mine"
    with pytest.raises(InputError, match="the context names no recordings of the arm"):
        check_context(context(), spec)


def test_the_model_of_a_context_lies_beside_it(tmp_path):
    text = 'question = "a"\nuse = "b"\nmodel = "{}"\n[risk]\ninfluence = "low"\n'
    text += 'consequence = "low"\n'
    path = tmp_path / "context.toml"
    path.write_text(text.format("arm"))
    with pytest.raises(InputError, match=r"context\.toml:3: model: there is no 'arm' beside"):
        load_context(path)
    (tmp_path / "arm").mkdir()
    assert load_context(path).model == str(tmp_path / "arm")
    path.write_text(text.format("default"))
    assert load_context(path).model == "default"
