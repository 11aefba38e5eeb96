"""The arm model: stepping is predicting, gradients are right, arms do not disturb each other."""

import dataclasses
import json
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.effects import make_effect
from surgisoft.surrogate.fitted_rows import FittedRows
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.interval import ErrorInterval
from surgisoft.surrogate.model import ArmModel, Validation, arm_facts
from surgisoft.surrogate.networks import ConstantCurvature, HawNN, KernelArm, RecurrentArm
from surgisoft.surrogate.training_residuals import TrainingResiduals

SPEC = ArmSpec(3, 5, (-15.0,) * 3, (54.0,) * 3, band=(0.2,) * 3)
LOW, HIGH = torch.tensor(SPEC.low), torch.tensor(SPEC.high)
FACTS = arm_facts(SPEC, torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(5)]))


def model(kind: str = "haw_nn", effects: tuple[str, ...] = ("hysteresis",)) -> ArmModel:
    """An arm with random weights, outputs of tens of millimetres."""
    torch.manual_seed(7)
    if kind == "haw_nn":
        network = HawNN(LOW, HIGH, 5, hidden=(32, 32))
    elif kind == "recurrent":
        network = RecurrentArm(LOW, HIGH, 5, width=16)
    elif kind == "kernel":
        network = KernelArm(LOW, HIGH, 5, 4, 20, (0.1, 1.0))
        network.prior.set_rest(torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(5)]))
        network.prior.table.data.normal_(0, 0.2)
        network.places.normal_()
        network.weight.data.normal_(0, 10.0)
    else:
        network = ConstantCurvature(LOW, HIGH, 5)
        network.set_rest(torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(5)]))
        network.table.data.normal_(0, 0.4)
    if hasattr(network, "scale"):
        network.scale.fill_(20.0)
    made = {name: make_effect(name, FACTS) for name in effects}
    for effect in made.values():
        for parameter in effect.parameters():
            parameter.data += 0.05 * torch.randn_like(parameter)
    rest = torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(5)])
    return ArmModel(SPEC, network, made, rest).eval().requires_grad_(False)


def walks(lengths, seed: int = 0):
    """A history of random pressure walks, one run a length."""
    generator = torch.Generator().manual_seed(seed)
    runs = [
        (20 + 4 * torch.randn(n, 3, generator=generator).cumsum(0)).clamp(-15, 54) for n in lengths
    ]
    times = [torch.arange(len(run)) * 0.05 for run in runs]
    return pack(times, runs, [torch.zeros(len(run), 5, 3) for run in runs])


@pytest.mark.parametrize("kind", ["haw_nn", "recurrent", "kernel", "constant_curvature"])
@given(seed=st.integers(0, 1000), lengths=st.lists(st.integers(1, 40), min_size=1, max_size=3))
@settings(max_examples=10)
def test_stepping_is_predicting(kind, seed, lengths):
    arm, history = model(kind), walks(lengths, seed)
    predicted = arm.predict(history)
    state = arm.initial_state(history.runs)
    for t in range(max(lengths)):
        dp = history.pressure[:, t] - state.pressure
        state, points = arm.step(state, dp, history.dt_s[:, t])
        alive = history.valid[:, t]
        assert torch.allclose(points[alive], predicted[:, t][alive], atol=2e-3)


@pytest.mark.parametrize("kind", ["haw_nn", "recurrent", "kernel", "constant_curvature"])
@pytest.mark.parametrize("effects", [(), ("line_lag", "hysteresis", "creep", "inertia")])
def test_stepping_is_predicting_where_runs_begin_away_from_rest(kind, effects):
    arm, history = model(kind, effects), walks([20, 30, 25], 5)
    stood = torch.stack([history.pressure[0, 0], torch.full((3,), 4.0), torch.full((3,), 50.0)])
    history = replace(history, stood=stood)
    first = arm.first_pressure(history)
    state, predicted = arm.first_state(first), arm.predict(history)
    assert torch.equal(state.pressure[[0, 2]], history.pressure[[0, 2], 0])
    assert torch.equal(state.pressure[1], arm.rest)  # 4 of 69 kPa away: at rest
    for t in range(30):
        dp = history.pressure[:, t] - state.pressure
        state, points = arm.step(state, dp, history.dt_s[:, t])
        alive = history.valid[:, t]
        assert torch.allclose(points[alive], predicted[:, t][alive], atol=2e-3)


@pytest.mark.parametrize(
    "effects", [("line_lag",), ("inertia",), ("line_lag", "hysteresis", "inertia")]
)
def test_a_run_cut_after_a_long_hold_goes_on_as_the_whole_one(effects):
    """Held for a day, the arm stands where a run is taken to begin that starts pressurised."""
    arm = model(effects=effects)
    hold = torch.tensor([40.0, 10.0, 25.0])
    tail = walks([40], 2).pressure[0] * 0.3 + hold
    tail[0] = hold
    dwell = torch.cat([torch.zeros(1), torch.logspace(-1, 5, 100)]).double()
    times = [torch.cat([dwell, dwell[-1] + 0.05 * torch.arange(1, 41)]), 0.05 * torch.arange(40.0)]
    pressure = [torch.cat([hold.expand(101, 3), tail]), tail]
    whole, cut = (
        pack([t], [p], [torch.zeros(len(p), 5, 3)], stood=[stood])
        for t, p, stood in zip(times, pressure, [torch.zeros(3), hold], strict=True)
    )
    went_on = arm.predict(whole)[0, 101:]
    # From row 1 on, when every chamber has moved and its direction is no longer of the way there.
    late = (arm.predict(cut)[0] - went_on)[1:].norm(dim=-1).amax()
    fresh = (arm.predict(replace(cut, stood=None))[0] - went_on)[1:].norm(dim=-1).amax()
    assert late < 0.05 * fresh


def test_a_run_begins_at_rest_or_where_its_first_row_is():
    """One chamber away from rest is enough; steady-state points do not say where they began."""
    arm, history = model(), walks([5, 5, 5, 5])
    history.pressure[:, 0] = torch.tensor([[20.0, 30.0, 40.0]])
    near, away = [0.1, 0.0, -0.1], [0.1, 20.0, 0.0]
    stood = torch.tensor([near, away, [torch.nan] * 3, near])
    begun = arm.first_pressure(replace(history, stood=stood))
    assert begun.tolist() == [[0.0] * 3, [20.0, 30.0, 40.0], [0.0] * 3, [0.0] * 3]
    assert not arm.first_pressure(replace(history, stood=None)).any()
    still = arm.replace(spec=replace(SPEC, idle=(None, 20.0, None)))
    begun = still.first_pressure(replace(history, stood=stood))
    assert (begun[1] - begun[0]).abs().max() == 0.0, "a chamber that never moves does not decide"


def test_residuals_are_measured_less_predicted_in_rows_that_were_measured():
    """Of 40 rows 30 have a key point; at most 20 are asked for, so that it is every second one."""
    arm, history = model(), walks([20, 20])
    points = arm.predict(history) + torch.tensor([1.0, 2.0, 3.0])
    points[:, ::4] = torch.nan
    points[:, :, 0] = torch.nan
    found = arm.residuals_on([replace(history, key_points=points)], rows=20)
    assert found.residual_mm.shape == (15, 5, 3)
    assert found.residual_mm[:, 0].isnan().all()
    expected = torch.tensor([1.0, 2.0, 3.0]).expand(15, 4, 3)
    torch.testing.assert_close(found.residual_mm[:, 1:], expected, atol=1e-4, rtol=0)
    seen = torch.cat([run[torch.arange(20) % 4 != 0] for run in history.pressure])
    torch.testing.assert_close(found.actuation, seen[::2])


def test_the_actuation_before_the_residuals_is_kept_and_of_many_rows_every_second(monkeypatch):
    """Two histories of 20 and 10 rows, the second with two runs of which one has 7 rows."""
    arm, first, second = model(), walks([20]), walks([10, 7])
    whole = arm.residuals_on([first, second], rows=12)
    past = whole.past
    assert past.run.tolist() == [0] * 20 + [1] * 10 + [2] * 7
    expected = torch.cat([each.rows(each.t_s) for each in (first, second)])
    assert torch.equal(past.t_s, expected)
    assert torch.equal(past.actuation[past.row], whole.actuation)
    assert past.row.tolist() == list(range(0, 37, 4))
    monkeypatch.setattr("surgisoft.surrogate.model.PAST_ROWS", 36)
    half = arm.residuals_on([first, second], rows=7)
    assert torch.equal(half.past.t_s, expected[::2]), "every sixth row is one of them"
    assert torch.equal(half.past.t_s[half.past.row], expected[::6])
    odd = {*range(0, 37, 2), *range(0, 37, 5)}
    fifth = arm.residuals_on([first, second], rows=8)
    assert torch.equal(fifth.past.t_s, expected[sorted(odd)])
    assert torch.equal(fifth.past.run, past.run[sorted(odd)])
    assert torch.equal(fifth.past.actuation[fifth.past.row], fifth.actuation)
    assert torch.equal(fifth.actuation, whole.past.actuation[::5])


def test_parts_that_belong_to_one_fit_are_dropped_with_it():
    """Training residuals are those of network and effects; the rows of the fit stay known."""
    arm, history = model(), walks([20])
    arm.training_residuals = arm.residuals_on([history])
    arm.fitted_rows = FittedRows.of([history])
    for changed in (arm.replace(effects={}), arm.replace(network=arm.network)):
        assert changed.training_residuals is None
        assert changed.fitted_rows is arm.fitted_rows
    same = arm.replace(spec=replace(SPEC, unit="psi"))
    assert same.training_residuals is arm.training_residuals
    assert same.fitted_rows is arm.fitted_rows


def test_a_radius_that_grows_with_the_distance_needs_the_rows_of_the_fit():
    """2 mm at the actuation of the fit, 6 mm a whole range of one chamber (69 kPa) away."""
    steady = ErrorInterval((0.95,), ((2.0,) * 5,), (0.0,) * 5, 500, 20, "s")
    growing = replace(steady, growth=(2.0,) * 5)
    asked = torch.tensor([[-15.0, 0.0, 0.0], [54.0, 0.0, 0.0]])
    arm = model().replace(validation=replace(Validation(), interval=steady))
    assert arm.states_interval
    assert arm.error_radius(asked).tolist() == [[2.0] * 5] * 2
    arm = model().replace(validation=replace(Validation(), interval=growing))
    assert not arm.states_interval
    with pytest.raises(InputError, match="states no prediction interval"):
        arm.error_radius(asked)
    arm.training_residuals = TrainingResiduals(asked[:1], torch.zeros(1, 3), torch.zeros(1, 5, 3))
    assert arm.states_interval
    torch.testing.assert_close(arm.error_radius(asked), torch.tensor([[2.0] * 5, [6.0] * 5]))


def test_effects_stand_in_the_order_of_their_stages():
    given = {name: make_effect(name, FACTS) for name in ("misalignment", "payload", "line_lag")}
    arm = model().replace(effects=given)
    assert list(arm.effects) == ["line_lag", "payload", "misalignment"]


def test_a_batch_is_its_arms_one_by_one():
    arm, history = model(), walks([30, 30, 30], 3)
    together = arm.predict(history)
    for run in range(3):
        assert torch.allclose(
            arm.predict(history.select(torch.tensor([run])))[0], together[run], atol=1e-3
        )


def test_a_nan_stays_in_its_arm_and_a_masked_reset_removes_it():
    arm = model()
    state, fresh = arm.initial_state(3), arm.initial_state(3)
    dp = torch.full((3, 3), 2.0)
    dp[1] = torch.nan
    state, points = arm.step(state, dp, 0.05)
    assert points[1].isnan().all()
    assert not points[[0, 2]].isnan().any()
    broken = torch.tensor([False, True, False])
    state = state.where(broken, fresh)
    state, points = arm.step(state, torch.full((3, 3), 2.0), 0.05)
    assert not points.isnan().any()
    assert torch.equal(state.pressure[:, 0], torch.tensor([4.0, 2.0, 4.0]))


def test_reset_under_inference_mode_and_use_outside_of_it():
    arm = model()
    with torch.inference_mode():
        state, _ = arm.step(arm.initial_state(2), torch.ones(2, 3), 0.05)
        state = state.where(torch.tensor([True, False]), arm.initial_state(2))
    _, points = arm.step(state, torch.ones(2, 3), 0.05)
    assert torch.isfinite(points).all()


def test_gradient_by_the_action_matches_finite_differences():
    arm = model().double()
    arm.network.double()
    state = arm.initial_state(1, torch.tensor([[20.0, 5.0, 30.0]], dtype=torch.float64))
    state, _ = arm.step(state, torch.tensor([[3.0, 2.0, -3.0]], dtype=torch.float64), 0.05)

    def tip(dp):
        return arm.step(state, dp, 0.05)[1][0, -1]

    dp = torch.tensor([[1.0, 1.5, -1.0]], dtype=torch.float64)
    exact = torch.autograd.functional.jacobian(tip, dp)[:, 0]
    h = 1e-5
    for chamber in range(3):
        step = torch.zeros_like(dp)
        step[0, chamber] = h
        slope = (tip(dp + step) - tip(dp - step)) / (2 * h)
        assert torch.allclose(slope, exact[:, chamber], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", ["haw_nn", "recurrent", "kernel", "constant_curvature"])
def test_reloaded_model_is_bit_equal(kind, tmp_path):
    arm, history = model(kind), walks([25])
    save_model(arm, tmp_path / "arm", {"note": 1})
    again = load_model(tmp_path / "arm")
    assert again.spec == arm.spec
    assert torch.equal(again.predict(history), arm.predict(history))
    assert torch.equal(again.rest_mm, arm.rest_mm)


def test_saving_never_half_writes_nor_overwrites(tmp_path):
    arm = model()
    save_model(arm, tmp_path / "arm")
    before = (tmp_path / "arm" / "weights.safetensors").read_bytes()
    with pytest.raises(InputError, match="--force"):
        save_model(arm, tmp_path / "arm")
    with pytest.raises(TypeError):
        save_model(arm, tmp_path / "arm", report={"bad": object()}, force=True)
    assert (tmp_path / "arm" / "weights.safetensors").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["arm"]
    (tmp_path / "arm" / "NOTES.md").write_text("mine")
    save_model(arm, tmp_path / "arm", force=True)
    assert (tmp_path / "arm" / "NOTES.md").read_text() == "mine"
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("keep me")
    with pytest.raises(InputError, match="not a model"):
        save_model(arm, tmp_path / "letters", force=True)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: (d / "config.json").unlink(), "config.json is missing"),
        (lambda d: (d / "config.json").write_text("{"), "not valid JSON"),
        (lambda d: (d / "weights.safetensors").write_bytes(b"123"), "damaged model"),
        (lambda d: (d / "config.json").write_text('{"format": 99}'), "format .*99"),
    ],
)
def test_a_damaged_model_is_one_line(tmp_path, damage, message):
    save_model(model(), tmp_path / "arm")
    damage(tmp_path / "arm")
    with pytest.raises(InputError, match=message) as error:
        load_model(tmp_path / "arm")
    assert "\n" not in str(error.value)


def test_spec_wants_one_value_a_chamber():
    with pytest.raises(InputError, match="'low' has 2 values"):
        dataclasses.replace(SPEC, low=(0.0, 0.0))


def test_rest_is_zero_or_the_nearest_end():
    assert ArmSpec(3, 2, (-15.0, 5.0, -9.0), (54.0, 20.0, -2.0)).rest == (0.0, 5.0, -2.0)


@pytest.mark.parametrize("name", ["rate_dependence", "softening", "stiffening"])
def test_an_effect_of_another_version_is_migrated_or_refused(tmp_path, name):
    folder = tmp_path / "arm"
    save_model(model(effects=(name,)), folder)
    config = json.loads((folder / "config.json").read_text())

    def opened(**changes):
        (folder / "config.json").write_text(json.dumps(config | changes))
        return load_model(folder).effects

    assert config.pop("effect_versions") == {name: 2}
    assert name in opened()  # written before versions were kept, but with all arguments of now
    with pytest.raises(InputError, match=f"effect '{name}' cannot be opened.*another meaning"):
        opened(effects={name: {}})
    with pytest.raises(InputError, match=f"effect '{name}' cannot be opened.*another meaning"):
        opened(effect_versions={name: 1})
    with pytest.raises(InputError, match=r"version 3 .*expected at most 2"):
        opened(effect_versions={name: 3})
