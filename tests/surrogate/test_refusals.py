"""Models, callables and fits that cannot be meant: one line each."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.other_models import predicted_arm
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.callables import named
from surgisoft.surrogate.callables.arm import arm_around, arm_by_itself, statements, validation_of
from surgisoft.surrogate.callables.named import given_callable, named_callable
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.compiled_step import CompiledStep
from surgisoft.surrogate.effects import make_effect
from surgisoft.surrogate.fit import (
    ChamberExcitation,
    FitConfig,
    FitResult,
    StageReport,
    excitation,
    fit,
)
from surgisoft.surrogate.fitted_rows import FittedRows
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature, HawNN
from surgisoft.surrogate.reach import model_table, steady_key_points
from surgisoft.surrogate.training import rest_shape
from surgisoft.surrogate.training_residuals import FILE, TrainingResiduals
from tests.surrogate.truth import SPEC, history, walk


@pytest.fixture(autouse=True)
def _nothing_named(monkeypatch):
    monkeypatch.setattr(named, "NAMED", {})


class Arm:
    """A callable of two chambers and two key points that states what it is given."""

    def __init__(self, **stated):
        for name, value in stated.items():
            setattr(self, name, value)

    def __call__(self, time_s, actuation):
        return np.tile([[0.0, 0.0, 0.0], [0.0, 0.0, 50.0]], (len(actuation), 1, 1))


RANGE = {"low": [0.0, 0.0], "high": [9.0, 9.0]}


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"low": 3.0}, "expected one finite number for each chamber"),
        ({"low": [0.0, np.nan]}, "expected one finite number for each chamber"),
        ({"length_mm": 0.0}, "expected a number above 0"),
        ({"gravity": (0.0, 0.0, 2.0)}, "expected a unit vector of 3 numbers"),
        ({"actuation": "guessed"}, "expected one of measured, commanded"),
        ({"error_mm": [0.1, -0.1]}, "expected an RMS error above 0 mm, one or one for each key"),
        ({"error_mm": []}, "expected an RMS error above 0 mm, one or one for each key"),
        ({"low": [0.0, 0.0]}, "states 'low' or 'high' only, expected both or none"),
        ({"low": [0.0, 0.0], "high": [9.0]}, "expected as many numbers in both, one for each"),
        ({"low": [0.0, 9.0], "high": [9.0, 9.0]}, "each low below its high"),
    ],
)
def test_what_a_callable_states_is_checked(stated, message):
    with pytest.raises(InputError) as error:
        statements(given_callable(Arm(**stated)))
    assert message in str(error.value)


class Unmeasured(Arm):
    @property
    def length_mm(self):
        raise RuntimeError("not measured yet")


class Unsure(Arm):
    @property
    def static(self):
        raise RuntimeError("not decided yet")


class Leaving(Arm):
    def __call__(self, time_s, actuation):
        sys.exit(0)


class LeavingLater(Arm):
    def __call__(self, time_s, actuation):
        return sys.exit(0) if actuation.any() else super().__call__(time_s, actuation)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Unmeasured, r", attribute 'length_mm': raised RuntimeError in .* not measured yet"),
        (Unsure, r", attribute 'static': raised RuntimeError in .* not decided yet"),
        (Leaving, r": raised SystemExit in test_refusals.py line \d+: 0"),
        (LeavingLater, r": raised SystemExit in test_refusals.py line \d+: 0"),
    ],
)
def test_what_a_callable_raises_is_one_line(kind, message):
    def asked():
        return arm_by_itself(given_callable(kind(**RANGE))).network(*torch.ones(2, 1, 2))

    with pytest.raises(InputError, match=rf"{kind.__qualname__}{message}; correct the model$"):
        asked()


def test_what_a_callable_states_becomes_the_model():
    given = Arm(
        **RANGE,
        unit="psi",
        actuation="commanded",
        length_mm=50.0,
        gravity=(0.0, 0.0, 1.0),
        error_mm=0.5,
    )
    arm = arm_by_itself(given_callable(given))
    assert (arm.spec.unit, arm.spec.actuation, arm.spec.length_mm) == ("psi", "commanded", 50.0)
    assert arm.spec.gravity == (0.0, 0.0, 1.0)
    assert arm.validation.per_key_point_mm == (0.5, 0.5)
    assert arm.validation.rmse_mm == pytest.approx(0.5)
    assert arm_by_itself(given_callable(Arm(**RANGE))).validation.rmse_mm is None
    with pytest.raises(InputError, match="does not state its range of actuation, which recordings"):
        arm_by_itself(given_callable(Arm()))
    with pytest.raises(InputError, match="lab: 3 validated errors, expected one or 2, one per key"):
        validation_of([0.1, 0.2, 0.3], 2, "lab")


class Stepped(Arm):
    """A callable that is stepped, with a state that is wrong in one way."""

    def __init__(self, state=None, result=None):
        super().__init__(**RANGE)
        self.state, self.result = state, result

    def initial_state(self, actuation):
        return np.zeros((len(actuation), 1)) if self.state is None else self.state

    def step(self, state, actuation, dt_s):
        points = self(dt_s, actuation)
        return (state, points) if self.result is None else self.result


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (Stepped(result=3), "step returned int, expected (state, key points)"),
        (Stepped(state="rest"), "its state is a str, expected an array (B, k)"),
        (Stepped(state=np.zeros(4)), "its state has shape (4,), expected finite"),
        (Stepped(state=np.full((1, 2), np.nan)), "its state has values that are not finite"),
    ],
)
def test_a_stepped_callable_that_goes_wrong_is_one_line(model, message):
    with pytest.raises(InputError) as error:
        arm_around(given_callable(model), ArmSpec(2, 2, (0.0, 0.0), (9.0, 9.0))).initial_state(1)
    assert message in str(error.value)


def test_names_of_other_packages_models(monkeypatch, tmp_path):
    """An entry point without a colon; a file that is no module; an object without a name."""
    entry = SimpleNamespace(load=lambda: Arm(**RANGE))
    monkeypatch.setattr(named, "offered", lambda: {"bench_arm": entry})
    found = named_callable("bench_arm")
    assert found.name == "bench_arm"
    assert named_callable("bench_arm") is found, "asked for once"
    assert given_callable(found.model) is found
    with pytest.raises(InputError, match=r"other: no callable model of that name; .*known: bench"):
        named_callable("other")
    assert not given_callable(Arm(**RANGE)).found
    arm = arm_by_itself(found)
    save_model(arm, tmp_path / "arm")
    monkeypatch.setattr(named, "NAMED", {})
    assert load_model(tmp_path / "arm").spec == arm.spec, "found by its entry point"


def predictions() -> ArmModel:
    """The model that stands for the predictions of a recording."""
    rng = np.random.default_rng(0)
    points = rng.normal(0, 5, (60, 2, 3))
    some = Recording(
        "r", 0.1 * np.arange(60), rng.uniform(0, 9, (60, 2)), points, predicted_mm=points
    )
    return predicted_arm("lab", [some])


def test_predictions_are_not_a_model_that_could_be_saved(tmp_path):
    arm = predictions()
    assert arm.summary().startswith("predictions of lab (pressure), 2 chambers in kPa")
    with pytest.raises(InputError, match="lab: predictions of recorded rows are not a model that"):
        save_model(arm, tmp_path / "arm")
    assert not (tmp_path / "arm").exists()
    planned = pack([torch.arange(3.0)], [torch.ones(3, 2)], [torch.zeros(3, 2, 3)])
    assert arm.predict(planned).isfinite().all(), "a planned experiment has none: the polynomial's"


def test_a_network_of_another_kind_is_not_written(tmp_path):
    class Own(HawNN):
        """A user's own network."""

    network = Own(torch.zeros(2), torch.ones(2), 2, hidden=(2,), directions=False)
    arm = ArmModel(ArmSpec(2, 2, (0.0, 0.0), (1.0, 1.0)), network, rest_mm=torch.zeros(2, 3))
    with pytest.raises(TypeError, match="no checkpoint format for Own"):
        save_model(arm, tmp_path / "arm")
    save_model(default_arm(), tmp_path / "default")
    config = json.loads((tmp_path / "default" / "config.json").read_text())
    config["network"]["kind"] = "oracle"
    (tmp_path / "default" / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match="unknown network 'oracle'"):
        load_model(tmp_path / "default")


def test_only_plain_models_are_stepped_by_compiled_code():
    arm = default_arm()
    assert CompiledStep.of(arm) is not None
    assert CompiledStep.of(default_arm().double()) is None
    curved = ConstantCurvature(torch.zeros(3), torch.ones(3), 5)
    other = ArmModel(arm.spec, curved, rest_mm=arm.rest_mm)
    assert CompiledStep.of(other) is None
    rubbing = {"hysteresis": make_effect("hysteresis", arm.facts, body_rad=1.0)}
    assert CompiledStep.of(arm.replace(effects=rubbing)) is None


def test_chains_that_cannot_bend():
    with pytest.raises(InputError, match="constant curvature needs at least 2 key points; this"):
        ConstantCurvature(torch.zeros(3), torch.ones(3), 1)
    network = ConstantCurvature(torch.zeros(3), torch.ones(3), 2)
    with pytest.raises(InputError, match="all key points coincide, expected a chain"):
        network.set_rest(torch.ones(2, 3))


def test_what_a_model_is_asked_for_must_fit_its_chambers():
    arm = default_arm()
    with pytest.raises(InputError, match="the model has 3 chambers, got 2"):
        steady_key_points(arm, np.zeros((4, 2)))
    spec = SimpleNamespace(chambers=7, key_points=5)
    seven = SimpleNamespace(spec=spec, require_body=lambda _: None)
    with pytest.raises(InputError, match="an arm of 7 chambers needs too large a table; expected"):
        model_table(seven)


def test_training_residuals_that_are_not_finite_are_refused(tmp_path):
    from safetensors.torch import save_file

    good = {
        "actuation": torch.zeros(3, 2),
        "direction": torch.zeros(3, 2),
        "residual_mm": torch.zeros(3, 1, 3),
    }
    for name, value, message in (
        ("actuation", torch.full((3, 2), torch.nan), "its actuation is NaN or infinite"),
        ("residual_mm", torch.full((3, 1, 3), torch.inf), "its residuals are infinite"),
        ("direction", torch.zeros(2, 2), "its arrays do not have the same rows"),
    ):
        save_file(good | {name: value}, tmp_path / FILE)
        with pytest.raises(ValueError, match=message):
            TrainingResiduals.load(tmp_path)
    save_file(good, tmp_path / FILE)
    assert TrainingResiduals.load(tmp_path).residual_mm.shape == (3, 1, 3)


def test_rows_of_nothing_were_never_fitted():
    some = pack([torch.arange(3.0)], [torch.ones(3, 2)], [torch.zeros(3, 2, 3)])
    lost = pack([torch.arange(3.0)], [torch.ones(3, 2)], [torch.full((3, 2, 3), torch.nan)])
    known = FittedRows.of([some])
    assert known.share_of(some) == 1.0
    assert known.share_of(lost) == 0.0
    assert FittedRows(0, ()).share_of(some) == 0.0
    assert known.joined(None) == replace(known, complete=False)
    assert not known.joined(FittedRows(0, (), complete=False)).complete
    with pytest.raises(InputError, match="no run: expected at least one with one row"):
        pack([], [], [])


def test_rest_is_the_mean_where_no_row_is_whole():
    """Each row lacks one of two key points: the mean of each over the rows that have it."""
    points = torch.tensor([[[1.0] * 3, [torch.nan] * 3], [[torch.nan] * 3, [5.0] * 3]])
    some = pack([torch.arange(2.0)], [torch.ones(2, 2)], [points])
    assert rest_shape(some).tolist() == [[1.0] * 3, [5.0] * 3]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("coupling", {"who": "nobody"}, "unknown kind of chambers 'nobody'"),
        ("drift", {"kind": "sideways"}, "unknown kind of drift 'sideways'"),
    ],
)
def test_options_of_effects_are_known_names(name, options, message):
    with pytest.raises(InputError, match=message):
        make_effect(name, default_arm().facts, **options)


@pytest.fixture(scope="module")
def short():
    """Runs of the true arm, enough to be checked."""
    rng = np.random.default_rng(1)
    return history([walk(80, rng)], noise=0.05, seed=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prior": "guess"}, "unknown prior mean 'guess'"),
        ({"prior": "arcs", "network": "recurrent"}, "a prior mean needs the network"),
    ],
)
def test_a_prior_mean_that_cannot_be_is_one_line(short, change, message):
    with pytest.raises(InputError, match=message):
        fit(short, None, SPEC, FitConfig(epochs=1, **change))


def test_recordings_that_cannot_be_fitted_are_one_line(short):
    points = short.key_points[0].clone()
    points[:, 0] = torch.nan
    lost = pack([short.t_s[0]], [short.pressure[0]], [points])
    with pytest.raises(InputError, match="key point k0 is missing in every row of the training"):
        fit(lost, None, SPEC, FitConfig(hidden=(2,), epochs=1))
    other = ArmSpec(SPEC.chambers + 1, SPEC.key_points, (0.0,) * 4, (1.0,) * 4)
    with pytest.raises(InputError, match="3 chambers recorded, expected 4"):
        fit(short, None, other, FitConfig(hidden=(2,), epochs=1))


def test_the_record_of_a_fit_names_what_was_tried():
    arm = default_arm()
    stage = StageReport("memory", 0.1, 5, 1.0, True, tried_mm={"creep": 0.25, "none": 0.5})
    lines = FitResult(arm, [stage], [], ["be careful"], 1.0).lines()
    assert "tried for memory, held-out RMSE in mm: creep 0.250, none 0.500" in lines
    assert "note: be careful" in lines


def test_why_a_chamber_supports_no_memory():
    few, same, ends, good = (
        ChamberExcitation(1, 0.9, 1, 0.9),
        ChamberExcitation(1, 0.0, 99, 0.9),
        ChamberExcitation(1, 0.9, 99, 0.0),
        ChamberExcitation(1, 0.9, 99, 0.9),
    )
    assert few.unsupported() == "chamber 1: it reversed only 1 time"
    assert replace(few, reversals=0).unsupported() == "chamber 1: it never reversed"
    assert "its direction follows from the actuation itself (contrast 0.00" in same.unsupported()
    assert ends.unsupported() not in ("", few.unsupported())
    assert good.unsupported() == ""
    two = pack([torch.arange(2.0)], [torch.tensor([[0.0], [5.0]])], [torch.zeros(2, 1, 3)])
    (found,) = excitation(two, torch.zeros(1), torch.full((1,), 9.0), torch.full((1,), 0.1))
    assert found.contrast == 0.0, "two rows have no neighbours"
