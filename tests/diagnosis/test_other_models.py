"""Callables and files of predictions in a diagnosis: they agree with the arm behind them."""

import re
import time
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.other_models import (
    callable_arm,
    notes_of,
    open_model,
    predicted_arm,
)
from surgisoft.diagnosis.residuals import residual_table
from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.diagnosis.testability import testable as split_by_testability
from surgisoft.errors import AssumptionWarning, InputError
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording, with_predictions
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.callables import network
from surgisoft.surrogate.callables.named import given_callable
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.effects import make_effect
from surgisoft.surrogate.history import pack
from tests.diagnosis.setup.recordings import NOISE_MM
from tests.diagnosis.small import measured, small_arm

ARM = default_arm()


def whole_runs(time_s, actuation):
    """The default arm as a callable of whole runs."""
    run = [torch.tensor(x) for x in (time_s, actuation, np.zeros((len(time_s), 5, 3)))]
    with torch.no_grad():
        return ARM.predict(pack(*([x] for x in run)))[0].double().numpy()


@pytest.fixture(scope="module")
def loaded():
    """Two minutes on a rig with a payload that the default arm does not know."""
    rig = VirtualRig(0, take=7, hidden=(("payload", 1.0),))
    return rig.record(make_protocol("mixed", rig.limits, 800, seed=2))[0]


@pytest.fixture(scope="module")
def with_file(loaded):
    """The recording with what the default arm predicts, as a file beside it gives it."""
    history = history_of([loaded])
    with torch.no_grad():
        points = history.rows(ARM.predict(history)).double().numpy()
    return replace(loaded, predicted_mm=points)


def by_file(recording: Recording):
    """The default arm, given by predictions alone, with the range and error that it states."""
    model = predicted_arm("arm", [recording])
    return model.replace(spec=ARM.spec, validation=ARM.validation).eval()


def table_of(path, points, **columns):
    names = [*columns, *(f"k{k}_{axis}_mm" for k in range(points.shape[1]) for axis in "xyz")]
    rows = np.column_stack([*columns.values(), points.reshape(len(points), -1)])
    np.savetxt(path, rows, delimiter=",", header=",".join(names), comments="")
    return path


def test_the_residuals_are_those_of_the_arm(loaded, with_file):
    truth = residual_table(ARM, [loaded])
    called = callable_arm(given_callable(whole_runs), [loaded])
    for model, recording in ((called, loaded), (by_file(with_file), with_file)):
        found = residual_table(model, [recording])
        np.testing.assert_allclose(found.residual_mm, truth.residual_mm, atol=1e-4)
        assert np.nanmax(np.abs(found.residual_mm)) > 1


def test_sensitivities_from_predictions_are_those_of_the_arm(loaded, with_file):
    """By correlation over all rows and key points; the arm's own come from its network."""
    effects = ["payload", "creep", "line_lag", "rate_dependence"]
    truth = candidates(residual_table(ARM, [loaded]).training(), effects)
    called = callable_arm(given_callable(whole_runs), [loaded]).replace(spec=ARM.spec).eval()
    for model, recording in ((by_file(with_file), with_file), (called, loaded)):
        found = candidates(residual_table(model, [recording]).training(), effects)
        for a, b in zip(truth, found, strict=True):
            x, y = a.sensitivities.ravel(), b.sensitivities.ravel()
            assert x @ y / np.sqrt((x @ x) * (y @ y)) > 0.9
            assert np.sqrt((y @ y) / (x @ x)) == pytest.approx(1.0, abs=0.15)


def test_an_effect_in_front_of_predictions_moves_them_as_in_front_of_the_arm(loaded, with_file):
    """A fifth more pressure in the chamber that moved most: the whole change, not its slope."""
    most = int(np.ptp(loaded.measured, axis=0).argmax())
    changes = []
    for model, recording in ((ARM, loaded), (by_file(with_file), with_file)):
        gain = make_effect("gain_mismatch", ARM.facts)
        gain.gain.data[most] = 0.2
        history = history_of([recording])
        after = model.replace(effects={**model.effects, "gain_mismatch": gain})
        with torch.no_grad():
            change = after.predict(history) - model.predict(history)
        changes.append(history.rows(change).flatten().double().numpy())
    x, y = changes
    assert np.abs(x).max() > 2
    assert x @ y / np.sqrt((x @ x) * (y @ y)) > 0.97
    assert np.sqrt((y @ y) / (x @ x)) == pytest.approx(1.0, abs=0.15)


def test_the_diagnosis_is_that_of_the_arm(loaded, with_file):
    """The same effect comes first, and the same error is left, as from the arm without the
    residuals of its fit, which no model of other origin has."""
    bare = default_arm()
    bare.training_residuals = None
    truth = diagnose(bare, loaded, setup_tests=False, refit="never")
    found = diagnose(by_file(with_file), with_file)
    assert found.setup is None
    assert found.ranking[0].effect == truth.ranking[0].effect == "payload"
    assert found.ranking[0].confidence > 0.4
    assert found.error_mm.before == pytest.approx(truth.error_mm.before, abs=1e-4)
    assert found.error_mm.best_achievable == pytest.approx(truth.error_mm.best_achievable, rel=0.15)


def test_amend_puts_an_effect_behind_a_callable(loaded):
    model = callable_arm(given_callable(whole_runs), [loaded], error_mm=0.1)
    truth = amend(ARM, loaded, "payload", retune_network=False, refit="never")
    found = amend(model, loaded, "payload", refit="never")
    assert found.claimed
    assert found.held_out.after == pytest.approx(truth.held_out.after, rel=0.15)
    assert found.model.network.named.model is whole_runs
    values = {each.name: each.value for each in truth.parameters}
    for each in found.parameters:
        assert each.value == pytest.approx(values[each.name], abs=0.3)
    with pytest.raises(InputError, match="no network that could be trained"):
        amend(model, loaded, "creep", refit="always")


def test_predictions_that_are_no_function_of_the_actuation_are_not_judged(loaded):
    """A model that wanders by itself: its slope with the actuation is unknown, and that is said."""
    rng = np.random.default_rng(0)
    wander = np.cumsum(rng.normal(size=(loaded.samples, 1, 3)), axis=0)
    lost = replace(loaded, predicted_mm=np.nanmean(loaded.key_points_mm, 0) + wander)
    model = predicted_arm("wander", [lost], error_mm=1.0)
    problem = residual_table(model, [lost]).training()
    names = ["creep", "payload", "gain_mismatch", "misalignment"]
    kept, left_out = split_by_testability(problem, candidates(problem, names), names)
    assert [each.effect for each in left_out if each.cause == "no_slope"] == ["gain_mismatch"]
    # Of the creep its forms of the body remain, which need no slope.
    assert {each.effect.stage for each in kept if each.name == "creep"} == {"body"}
    assert "payload" in {each.name for each in kept}
    assert any("cannot be judged" in note for note in notes_of(model))
    assert find_setup_faults(model, [lost]) is None


def test_the_validated_error_comes_from_before(loaded):
    """An error of known size on the recording before: 2 mm along x at every key point."""
    truth = np.nan_to_num(loaded.key_points_mm)
    before = replace(loaded, name="before", noise_mm=0.0)

    def off(time_s, actuation):
        """The measured key points of the times, 2 mm further along x."""
        return truth[np.searchsorted(loaded.t_s, time_s - 1e-6)] + [2.0, 0.0, 0.0]

    model = callable_arm(given_callable(off), [loaded], [before])
    assert model.validation.per_key_point_mm == pytest.approx((2.0,) * 5, abs=1e-4)
    assert callable_arm(given_callable(off), [loaded]).validation.rmse_mm is None
    stated = callable_arm(given_callable(off), [loaded], [before], error_mm=0.5)
    assert stated.validation.per_key_point_mm == (0.5,) * 5


@pytest.mark.parametrize("static", [False, True])
def test_a_slow_callable_is_told_once_with_what_it_will_take(static, loaded, monkeypatch):
    class Slow:
        def __call__(self, time_s, actuation):
            time.sleep(0.0 if len(actuation) == 1 else 0.1)
            return np.zeros((len(actuation), 5, 3))

    def told(model):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            residual_table(open_model(model, loaded).model, [loaded])
            residual_table(open_model(model, loaded).model, [loaded])
        return [str(each.message) for each in caught if each.category is AssumptionWarning]

    slow = Slow()
    slow.static = static
    assert told(slow) == []
    monkeypatch.setattr(network, "SLOW_S", 0.1)
    monkeypatch.setattr(network, "EVALUATIONS", 1800)
    first, second = told(slow)
    assert first.split(" took ")[0] == second.split(" took ")[0]
    assert f"for {len(loaded.t_s)} rows" in first
    # 1,800 evaluations of 0.1 s are 3 min; a busy machine may take longer.
    assert 3 <= int(re.search(r"may take (\d+) min", first)[1]) < 60


def test_rows_are_matched_by_their_times(loaded, with_file, tmp_path):
    points, time = with_file.predicted_mm, loaded.t_s
    more = np.concatenate([time[:1] - 0.05, time, time[-1:] + 0.05])
    padded = np.concatenate([points[:1], points, points[-1:]])
    for file in (
        table_of(tmp_path / "plain.csv", points),
        table_of(tmp_path / "timed.csv", points, t_s=time),
        table_of(tmp_path / "more.csv", padded, t_s=more),
    ):
        found = with_predictions([loaded], [file])[0]
        np.testing.assert_allclose(found.predicted_mm, points, atol=1e-9)
    metres = table_of(tmp_path / "metres.csv", points / 1e3)
    metres.write_text(metres.read_text().replace("_mm", "_m"))
    np.testing.assert_allclose(with_predictions([loaded], [metres])[0].predicted_mm, points)


def test_files_that_do_not_fit_are_one_line(loaded, with_file, tmp_path):
    points, time = with_file.predicted_mm, loaded.t_s
    bad = points.copy()
    bad[7, 2, 0] = np.nan
    cases = {
        "799 rows": table_of(tmp_path / "short.csv", points[1:]),
        "4 key points, expected 5": table_of(tmp_path / "few.csv", points[:, 1:]),
        "no row for run 0, 0 s": table_of(tmp_path / "late.csv", points, t_s=time + 0.3),
        "missing or not finite, in 1 of 800": table_of(tmp_path / "holes.csv", bad),
        "no column 'k0_x_mm'": table_of(tmp_path / "none.csv", points[:, :0], t_s=time),
    }
    for said, file in cases.items():
        with pytest.raises(InputError, match=said) as refused:
            with_predictions([loaded], [file])
        assert str(file) in str(refused.value)
    with pytest.raises(InputError, match="1 files of predictions for 2 recordings"):
        open_model("arm", [loaded, replace(loaded, name="b")], None, [tmp_path / "few.csv"])


def scaled(by):
    """The default arm as a callable whose key points are multiplied."""
    return lambda time_s, actuation: by * whole_runs(time_s, actuation)


def with_length(recording, length_mm):
    return replace(recording, arm=replace(recording.arm, length_mm=length_mm))


@pytest.mark.parametrize(
    ("by", "wrong", "times"),
    [
        (1e-3, "in m", "1000"),
        (0.1, "in cm", "10"),
        (1 / 25.4, "in inches", "25.4"),
        (1e3, "1000 times too large", "0.001"),
    ],
)
def test_a_callable_in_another_unit_of_length_is_refused(loaded, by, wrong, times):
    said = f"returns key points {wrong}: .*multiply them by {times}$"
    with pytest.raises(InputError, match=said):
        callable_arm(given_callable(scaled(by)), [loaded])


@pytest.mark.parametrize(("by", "wrong"), [(1e-3, "in m"), (1e3, "1000 times too large")])
def test_predictions_in_another_unit_of_length_are_refused(loaded, with_file, by, wrong):
    given = replace(with_file, predicted_mm=by * with_file.predicted_mm)
    with pytest.raises(InputError, match=f"predicted for .* are {wrong}: .*k0_x_mm or k0_x_m$"):
        predicted_arm("arm", [given])


@pytest.mark.parametrize("by", [0.5, 0.75, 1.5, 2.0, 100.0])
def test_a_model_of_another_size_is_not_refused(loaded, by):
    """A poor model, or one off by a factor that is no unit."""
    callable_arm(given_callable(scaled(by)), [loaded])


def test_the_stated_length_tells_whose_unit_is_wrong(loaded):
    """The recording is in cm or m, or no length is stated: the set-up tests look at it."""
    for by in (0.1, 1e-3):
        wrong = replace(loaded, key_points_mm=by * loaded.key_points_mm)
        callable_arm(given_callable(whole_runs), [wrong])
    callable_arm(given_callable(scaled(1e-3)), [with_length(loaded, None)])


def single_rows(time_s, actuation):
    """The network of the small arm without directions, as a callable of single rows."""
    signal = torch.from_numpy(actuation).float()
    with torch.no_grad():
        return small_arm().network(signal, torch.zeros_like(signal)).double().numpy()


single_rows.static = True


def test_the_set_up_tests_leave_open_whose_unit_is_wrong_only_where_no_length_tells():
    """The recording is in cm; without a length the model may be ten times too large."""
    made = measured(800)
    noise = np.random.default_rng(2).normal(0.0, NOISE_MM, made.key_points_mm.shape)
    made = replace(made, key_points_mm=single_rows(made.t_s, made.measured) + noise)
    right = callable_arm(given_callable(single_rows), [made], error_mm=0.1)
    in_cm = replace(made, key_points_mm=made.key_points_mm / 10)
    told = find_setup_faults(right, [in_cm])
    assert told.kinds == ("length_unit",)
    assert told.of_model == ""
    unknown = right.replace(spec=replace(right.spec, length_mm=None)).eval()
    either = find_setup_faults(unknown, [in_cm])
    assert either.of_model == "the positions of the model are 10 times too large"
    assert either.sentence.startswith(f"{told.sentence.partition(':')[0]}; or {either.of_model}:")
