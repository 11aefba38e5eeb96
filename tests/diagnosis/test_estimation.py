"""Effects whose truth is known come back through the whole model, with honest intervals."""

import copy
import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats

from surgisoft.diagnosis.candidates import with_effect
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.estimation import network_error
from surgisoft.diagnosis.estimation.effects import fit_effects, fitted_model
from surgisoft.diagnosis.estimation.intervals import (
    DRAWS,
    Estimates,
    Fitted,
    Parameter,
    beside_former,
    intervals,
    p_value,
    with_covariance,
)
from surgisoft.diagnosis.estimation.least_squares import (
    AMPLITUDES,
    Fit,
    Prediction,
    amplitude_sensitivities,
    block_slopes,
    fit_all,
    fit_amplitudes,
    free_parameters,
    repeated_scan,
    vector,
)
from surgisoft.diagnosis.estimation.network import best_layer, retune
from surgisoft.diagnosis.estimation.network_error import NetworkError
from surgisoft.diagnosis.estimation.nuisance import Nuisance, held_out_parts, kinds
from surgisoft.diagnosis.pages.amendment import parameter_parts
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.errors import InputError
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.recordings import Recording
from surgisoft.report import Text
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.effects import Memoryless, make_effect
from surgisoft.surrogate.effects.hysteresis import FEW_RADII
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import RecurrentArm
from tests.diagnosis.synthetic import walk

NOISE_MM = 0.05
"""Standard deviation of a coordinate."""


def bare_arm() -> ArmModel:
    """The network of the default arm without its memory."""
    arm = default_arm()
    arm.network.requires_grad_(False)
    return arm.replace(effects={}).eval()


def measured_on(
    truth: ArmModel, runs: int = 4, rows: int = 250, seed: int = 0, noise_seed: int | None = None
) -> Recording:
    """What cameras with white noise would record of a model that is the truth, at 10 Hz.

    noise_seed: seed of the noise alone; default: the one of the schedule.
    """
    rng = np.random.default_rng(seed if noise_seed is None else noise_seed)
    low, high = np.array(truth.spec.low), np.array(truth.spec.high)
    pressure = np.concatenate([walk(rows, 3, seed * 100 + run) for run in range(runs)])
    pressure = low + (high - low) * pressure / 10
    plain = Recording(
        name="made",
        t_s=0.1 * np.arange(runs * rows),
        measured=pressure,
        key_points_mm=np.zeros((runs * rows, truth.spec.key_points, 3)),
        run=np.repeat(np.arange(runs), rows),
        noise_mm=NOISE_MM,
    )
    history = history_of([plain])
    with torch.no_grad():
        points = history.rows(truth.predict(history)).double().numpy()
    points += rng.normal(0, NOISE_MM, points.shape)
    return replace(plain, key_points_mm=points)


def with_truth(name: str, strengths: dict, arm: ArmModel | None = None, **config) -> ArmModel:
    """An arm with an effect whose strengths and shapes are set."""
    arm = arm or bare_arm()
    effect = make_effect(name, arm.facts, **config)
    for key, value in strengths.items():
        getattr(effect, key).data.copy_(torch.as_tensor(value, dtype=torch.float32))
    return with_effect(copy.deepcopy(arm), name, effect).eval().requires_grad_(False)


TRUTHS = {
    "creep": with_truth("creep", {"amount": [0.15], "log_tau": [2.0], "log_width": [0.3]}),
    "line_lag": with_truth("line_lag", {"share": [1.0], "log_up": [-0.7], "log_down": [0.1]}),
    "gain_mismatch": with_truth("gain_mismatch", {"gain": [0.06, -0.02, -0.05]}),
    "misalignment": with_truth("misalignment", {"turn": [0.02, 0.0, -0.01], "shift": [0.3, 0, 1]}),
}
"""An arm for each effect that is tried: one a stage and kind of memory."""


@pytest.mark.parametrize(("unit", "named"), [("mm", True), ("kPa", False)])
def test_what_is_held_in_place_relaxes_and_a_chamber_does_not_creep_backwards(unit, named):
    """A tendon of constant pull loses a share of its push with time (a standard linear solid)."""
    arm = bare_arm()
    arm = arm.replace(spec=replace(arm.spec, unit=unit))
    truth = with_truth("creep", {"amount": [-0.15], "log_tau": [2.0], "log_width": [0.3]})
    recorded = replace(measured_on(truth), unit=unit)
    found = diagnose(arm, [recorded], setup_tests=False, refit="never")
    assert (found.verdict.effects == ("creep",)) == named
    row = next((each for each in found.ranking if each.effect == "creep"), None)
    if named:
        assert row.parameters["amount_share"] == pytest.approx(-0.15, rel=0.2)
        assert "-" in row.in_words
    else:
        assert row is None or row.confidence < 0.1


def rms(residual: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(residual).sum(-1))))


@pytest.mark.parametrize("name", TRUTHS)
def test_parameters_come_back_and_the_error_falls_to_the_noise(name):
    truth = TRUTHS[name]
    recording = measured_on(truth)
    problem = problem_of(bare_arm(), [recording], part="training")
    fitted = fit_effects(problem, [name])
    floor = np.sqrt(3) * NOISE_MM
    assert rms(problem.residual) > 2 * floor
    assert rms(problem.with_model(fitted.model).residual) < 1.03 * floor
    expected = {q.name: q.value for q in truth.effects[name].quantities()}
    inside, wide = [], []
    for parameter in fitted.parameters:
        low, high = np.ravel(parameter.low), np.ravel(parameter.high)
        true = np.ravel(expected[parameter.name])
        inside += list((low <= true) & (true <= high))
        wide += list(high - low)
    # 95 % intervals: of up to nine values one may lie outside.
    assert sum(inside) >= len(inside) - 1
    assert np.isfinite(wide).all()
    assert max(wide) > 0


def test_an_interval_holds_a_further_draw_with_its_probability():
    """Between the order statistics at p (N + 1) of N draws: of 400 the 10.025th and 390.975th."""
    effect = make_effect("payload", replace(default_arm().facts, gravity=(0.0, 0.0, -1.0)))
    around, spread = np.array([2.0]), 0.1
    fit = Fit(
        values=around,
        jacobian=np.zeros((10, 1, 3, 1)),
        residual=np.zeros((10, 1, 3)),
        nuisance=None,
        hold=np.zeros((1, 1)),
        misfit=1.0,
        prior_variance=np.zeros(1),
    )
    known = Fitted(fit, np.eye(1), np.array([[spread**2]]))
    found = intervals({"payload": effect}, {"payload.tip_sag": effect.tip_sag}, known)
    sag = next(each for each in found.parameters if each.name == "tip_sag_mm")
    drawn = np.sort(around + spread * np.random.default_rng(0).standard_normal(DRAWS))
    assert DRAWS == 400
    assert np.ravel(sag.value) == pytest.approx([2.0])
    low = drawn[9] + 0.025 * (drawn[10] - drawn[9])
    high = drawn[389] + 0.975 * (drawn[390] - drawn[389])
    assert np.ravel(sag.low) == pytest.approx([low], abs=1e-6)
    assert np.ravel(sag.high) == pytest.approx([high], abs=1e-6)
    said = f"arm sag by 2 mm (95 %: {low:.3g} to {high:.3g}) at the tip"
    assert said in found.in_words["payload"]


@pytest.mark.parametrize("common", [0.5, 0.02])
def test_zeros_of_which_only_differences_are_known_are_told_by_these(common):
    """As on an arm that does not stretch, whose zeros have one part in common that moves nothing:
    with independent shares of 0.01, values less their mean spread by 0.01 sqrt(2/3)."""
    facts = default_arm().facts
    effect = make_effect("zero_offset", facts)
    values, small = np.array([0.05, -0.04, 0.02]), 0.01
    spread = common**2 * np.ones((3, 3)) + small**2 * np.eye(3)
    fit = Fit(
        values=values,
        jacobian=np.zeros((10, 1, 3, 3)),
        residual=np.zeros((10, 1, 3)),
        nuisance=None,
        hold=np.zeros((3, 3)),
        misfit=1.0,
        prior_variance=np.zeros(3),
    )
    known = Fitted(fit, np.eye(3), spread)
    names = {"zero_offset.offset": effect.offset}
    (offset,) = intervals({"zero_offset": effect}, names, known).parameters
    if common == 0.02:  # the values are known about as well as their differences
        assert offset.relative == ()
        assert "relative" not in offset.interval_text
        return
    (group,) = offset.relative
    assert group.numbers == (1, 2, 3)
    reach = (effect.reach * torch.ones(3)).numpy()
    kPa = values * reach
    np.testing.assert_allclose(group.value, kPa - kPa.mean(), rtol=1e-5)
    half = np.subtract(group.high, group.low) / 2.0
    np.testing.assert_allclose(half, 1.96 * small * np.sqrt(2.0 / 3.0) * reach, rtol=0.15)
    assert "the values 1, 2 and 3 are known relative to each other: less their mean [" in (
        offset.interval_text
    )
    assert offset.identifiable
    assert offset.to_json()["identifiable"]


def test_intervals_shrink_with_the_data():
    """Four times the rows, half the width (within sampling error), where the network is exact."""
    truth, widths = TRUTHS["gain_mismatch"], []
    for rows in (150, 600):
        problem = problem_of(bare_arm(), [measured_on(truth, rows=rows)], part="training")
        problem = replace(problem, discrepancy_mm=np.full(5, 1e-3))
        (parameter,) = fit_effects(problem, ["gain_mismatch"]).parameters
        widths.append(np.mean(np.subtract(parameter.high, parameter.low)))
    assert 0.25 < widths[1] / widths[0] < 0.9


def test_the_static_error_of_a_network_is_not_taken_for_memory():
    """A smooth static error of 0.3 mm beside a known creep: its amount still comes back."""
    truth = copy.deepcopy(TRUTHS["creep"])
    generator = torch.Generator().manual_seed(3)
    last = truth.network.layers[-1]
    last.weight += 0.004 * torch.randn(last.weight.shape, generator=generator)
    problem = problem_of(bare_arm(), [measured_on(truth)], part="training")
    amount = fit_effects(problem, ["creep"]).parameters[0]
    assert amount.name == "amount_share"
    assert amount.value == pytest.approx(0.15, abs=0.03)


def test_forward_is_the_model_and_its_slopes_are_those_of_autograd():
    arm = with_truth("creep", {"amount": [0.1]}, with_truth("misalignment", {"scale": [0.02]}))
    problem = problem_of(arm, [measured_on(arm, rows=100)], part="training")
    parameters = free_parameters(arm, ["creep", "misalignment"])
    forward = repeated_scan(arm, problem, list(arm.effects))
    predict = Prediction(forward, parameters)
    values = vector(parameters)
    predicted = predict(values)
    assert np.allclose(predicted, problem.predicted, atol=1e-4)
    slopes = predict.sensitivities(values, predicted)
    for place, (name, parameter) in enumerate(parameters.items()):
        if name not in ("creep.amount", "creep.log_tau"):
            continue
        parameter.requires_grad_(True)
        total = forward()[..., 0].sum()
        (exact,) = torch.autograd.grad(total, parameter)
        parameter.requires_grad_(False)
        assert slopes[..., 0, place].sum() == pytest.approx(float(exact), rel=0.02)


def test_a_slope_is_by_the_step_that_a_parameter_in_single_precision_takes():
    """At 20 m of motion per unit a step of a millionth is taken: 8 units of the last place of 1."""
    parameter = torch.ones(1)
    predict = Prediction(lambda: 2e4 * (parameter.double() - 1.0).view(1, 1, 1), {"x": parameter})
    slopes = predict.sensitivities(np.ones(1), predict(np.ones(1)))
    assert predict.steps.item() == pytest.approx(1e-6)
    assert slopes.item() == pytest.approx(2e4, rel=1e-6)
    assert parameter.item() == 1.0


def test_a_slope_is_found_again_after_a_prediction_that_was_not_finite():
    """Steps of a hundredth from 1 lead beyond 1.005, where nothing finite is predicted."""
    parameter = torch.ones(1)

    def forward():
        value = parameter.double().view(1, 1, 1)
        return torch.where(value > 1.005, torch.nan, value)

    predict = Prediction(forward, {"x": parameter})
    predict.steps[:] = 0.01
    for start in (1.0, 0.5):
        values = np.array([start])
        slopes = predict.sensitivities(values, predict(values))
        assert slopes.item() == pytest.approx(1.0, rel=1e-3)
        assert np.isfinite(predict.steps).all()


def test_many_amplitudes_of_an_effect_of_the_body_without_memory_are_fitted(monkeypatch):
    """Thirty shifts of the key points along x, half of them of the upper and half of the lower
    ones, whose sums are 0.6 and -0.3 mm."""

    class Shifts(Memoryless):
        stage = "body"

        def __init__(self, facts):
            super().__init__(facts)
            self.size = torch.nn.Parameter(torch.zeros(30))

        def amplitudes(self):
            return {"size": self.size}

        def apply(self, signal, memory):
            upper = torch.arange(signal.shape[-2]) > 1
            moved = torch.where(upper, self.size[:15].sum(), self.size[15:].sum())
            return signal + moved[:, None] * signal.new_tensor([1.0, 0.0, 0.0])

        def config(self):
            return {}

        def quantities(self):
            return []

    arm = bare_arm()
    truth = with_effect(arm, "shifts", Shifts(arm.facts))
    with torch.no_grad():
        truth.effects["shifts"].size[:15] = 0.04
        truth.effects["shifts"].size[15:] = -0.02
    problem = problem_of(arm, [measured_on(truth, rows=80)], part="all")
    model = with_effect(arm, "shifts", Shifts(arm.facts))
    fit_amplitudes(model, problem, "shifts")
    found = model.effects["shifts"].size.detach()
    assert float(found[:15].sum() - found[15:].sum()) == pytest.approx(0.9, abs=0.15)


def test_the_likelihood_of_a_fit_by_hand():
    """Fifty rows count as one: of 200 with a misfit of 10 mm^2 each has 2.5 mm^2."""
    fit = replace(fit_of([1.0], np.zeros((200, 1, 3, 1)), np.zeros((200, 1, 3))), misfit=12.0)
    assert fit.likelihood(10.0) == pytest.approx(np.exp(-2.0 / (2.0 * 2.5)))
    assert fit.likelihood(12.0) == fit.likelihood(13.0) == 1.0


def test_a_fit_ends_where_the_slope_of_the_misfit_is_that_of_the_hold():
    """Few rows of a small creep say little of its times, which a spread of 1.5 holds at their
    start; a unit of it costs as much as one sample of 50 rows."""
    small = with_truth("creep", {"amount": [0.02], "log_tau": [2.0], "log_width": [0.3]})
    problem = problem_of(bare_arm(), [measured_on(small, runs=2, rows=60)], part="all")
    model = with_truth("creep", {"amount": [0.02], "log_tau": [2.6], "log_width": [0.5]})
    start = vector(free_parameters(model, ["creep"]))
    first = problem.with_model(model).residual
    fit = fit_all(model, problem, ["creep"])
    nonlinear = np.arange(len(start)) >= len(vector(model.effects["creep"].amplitudes()))
    spread = 1.5 * np.maximum(1.0, np.abs(start))
    assert fit.prior_variance == pytest.approx(np.where(nonlinear, spread**2, 0.0))
    sample = 50.0 * fit.nuisance.misfit(first) / len(first)
    expected = np.diag(np.where(nonlinear, sample / spread**2, 0.0))
    np.testing.assert_allclose(fit.hold, expected, rtol=1e-3)
    away = fit.values - start
    assert np.abs(away).max() > 0.02
    left = fit.nuisance.misfit(fit.residual)
    assert fit.misfit == pytest.approx(left + away @ fit.hold @ away, rel=1e-9)
    grams, slopes = block_slopes(fit, np.zeros(len(first)))
    step = np.linalg.solve(grams[0] + fit.hold, slopes[0] - fit.hold @ away)
    assert np.abs(step).max() < 0.1 * np.abs(away).max()


def test_the_ridge_of_amplitudes_is_the_one_that_does_best_on_runs_left_out():
    """Where the static error counts for nothing: plain least squares of the other runs."""
    truth = default_arm()
    weaker = copy.deepcopy(truth)
    for strength in weaker.effects["hysteresis"].amplitudes().values():
        strength.mul_(0.5)
    problem = problem_of(weaker, [measured_on(truth, rows=80)], part="all")
    problem = replace(problem, discrepancy_mm=np.full(5, 1e-3))
    forward = repeated_scan(weaker, problem, ["hysteresis"])
    jacobian = amplitude_sensitivities(weaker, forward, "hysteresis")
    start, count = vector(weaker.effects["hysteresis"].amplitudes()), jacobian.shape[-1]
    part, residual = held_out_parts(problem), problem.residual
    assert len(np.unique(part)) >= 3
    along = start / np.linalg.norm(start)
    penalty = np.eye(count) - (1 - AMPLITUDES.along_present) * np.outer(along, along)
    penalty *= np.square(jacobian).sum() / count
    errors = np.zeros(len(AMPLITUDES.ridges))
    for left_out in np.unique(part):
        others, own = part != left_out, part == left_out
        a, b = jacobian[others].reshape(-1, count), jacobian[own].reshape(-1, count)
        for i, ridge in enumerate(AMPLITUDES.ridges):
            change = np.linalg.solve(a.T @ a + ridge * penalty, a.T @ residual[others].ravel())
            errors[i] += np.square(residual[own].ravel() - b @ change).sum()
    fit = fit_amplitudes(weaker, problem, "hysteresis")
    chosen = np.trace(fit.hold) / np.trace(penalty)
    assert chosen == pytest.approx(AMPLITUDES.ridges[errors.argmin()], rel=0.1)


def test_hysteresis_that_the_model_has_is_fitted_anew_not_doubled():
    """Half of the default arm's friction is missing: its weights come back, in one instance."""
    truth = default_arm()
    weaker = copy.deepcopy(truth)
    for strength in weaker.effects["hysteresis"].amplitudes().values():
        strength.mul_(0.5)
    recording = measured_on(truth, rows=300)
    problem = problem_of(weaker, [recording], part="training")
    fitted = fit_effects(problem, ["hysteresis"])
    assert list(fitted.model.effects) == ["hysteresis"]
    assert fitted.refitted == ("hysteresis",)
    found = Estimates(list(fitted.parameters), fitted.in_words)
    parameters, words = beside_former(found, weaker, problem.covered_s)
    for now, quantity in zip(parameters, weaker.effects["hysteresis"].quantities(), strict=True):
        assert (now.name, now.before) == (quantity.name, quantity.value)
    now, then = (
        float(text.split("loop of ")[1].split()[0]) for text in words["hysteresis"].split(";")
    )
    assert then / now == pytest.approx(0.5, abs=0.1)
    assert beside_former(found, problem.model.replace(effects={}), None)[0] == fitted.parameters
    held_out = problem_of(weaker, [recording], part="held_out")
    before, after = rms(held_out.residual), rms(held_out.with_model(fitted.model).residual)
    assert before > 2 * np.sqrt(3) * NOISE_MM
    assert after < 1.1 * np.sqrt(3) * NOISE_MM
    assert torch.equal(
        weaker.effects["hysteresis"].weight, 0.5 * truth.effects["hysteresis"].weight
    )


def test_two_effects_are_fitted_together():
    truth = with_truth("gain_mismatch", {"gain": [0.06, -0.02, -0.05]}, TRUTHS["creep"])
    problem = problem_of(bare_arm(), [measured_on(truth)], part="training")
    fitted = fit_effects(problem, ["creep", "gain_mismatch", "creep"])
    assert list(fitted.model.effects) == ["creep", "gain_mismatch"]
    assert rms(problem.with_model(fitted.model).residual) < 1.05 * np.sqrt(3) * NOISE_MM
    gain = next(p for p in fitted.parameters if p.name == "gain_share")
    assert gain.value == pytest.approx([0.06, -0.02, -0.05], abs=0.01)


def test_missing_key_points_do_no_harm():
    recording = measured_on(TRUTHS["gain_mismatch"])
    points = recording.key_points_mm.copy()
    points[::3, 2] = np.nan
    points[:, 1] = np.nan
    problem = problem_of(bare_arm(), [replace(recording, key_points_mm=points)], part="training")
    gain = fit_effects(problem, ["gain_mismatch"]).parameters[0]
    assert gain.value == pytest.approx([0.06, -0.02, -0.05], abs=0.01)


def test_a_network_is_retuned_only_where_held_out_motion_rewards_it():
    arm = bare_arm()
    recording = measured_on(arm)
    problem = problem_of(arm, [recording], part="training")
    untouched = retune(arm, problem)
    assert not untouched.kept
    assert untouched.model is arm
    off = copy.deepcopy(arm)
    off.network.layers[-1].bias += 0.02
    found = retune(off, problem_of(off, [recording], part="training"))
    assert found.kept
    held_out = problem_of(off, [recording], part="held_out")
    after = held_out.with_model(found.model)
    assert rms(after.residual) < 1.1 * np.sqrt(3) * NOISE_MM < 0.7 * rms(held_out.residual)


def test_a_network_is_retuned_where_one_key_point_is_never_seen():
    """The key points that are seen become right; the layer of the other one stays as it is."""
    arm = bare_arm()
    whole = measured_on(arm)
    lost = replace(whole, key_points_mm=whole.key_points_mm.copy())
    lost.key_points_mm[:, -1] = np.nan
    off = copy.deepcopy(arm)
    off.network.layers[-1].bias += 0.02
    found = retune(off, problem_of(off, [lost], part="training"))
    assert found.kept
    before = problem_of(off, [whole], part="held_out")
    after = before.with_model(found.model)
    np.testing.assert_allclose(after.residual[:, -1], before.residual[:, -1], atol=1e-5)
    after_mm, before_mm = rms(after.residual[:, :-1]), rms(before.residual[:, :-1])
    assert after_mm < 1.1 * np.sqrt(3) * NOISE_MM < 0.8 * before_mm


def test_a_layer_that_makes_left_out_quarters_worse_is_not_kept():
    """An arm whose base stands 1 mm aside for the first three fifths of the training rows.

    A layer in between lowers the error of motion held out in turn, and raises it from then on.
    """
    arm = bare_arm()
    recording = measured_on(arm, runs=1, rows=1600)
    points = recording.key_points_mm.copy()
    points[: int(0.45 * len(points)), 1:, 0] += 1.0
    moved = problem_of(arm, [replace(recording, key_points_mm=points)], part="training")
    assert best_layer(arm, moved).kept
    found = retune(arm, moved)
    assert not found.kept
    assert found.model is arm
    points[:, 1:, 0] = recording.key_points_mm[:, 1:, 0] + 1.0
    throughout = problem_of(arm, [replace(recording, key_points_mm=points)], part="training")
    assert retune(arm, throughout).kept


def test_one_left_out_quarter_in_which_nothing_changed_does_not_forbid_a_layer():
    """The base stands 1 mm aside for the last three quarters of the training rows; three of the
    four fits see some rows of both, and over all quarters the layer lowers the error."""
    arm = bare_arm()
    recording = measured_on(arm, runs=1, rows=1600)
    points = recording.key_points_mm.copy()
    points[300:, 1:, 0] += 1.0
    moved = problem_of(arm, [replace(recording, key_points_mm=points)], part="training")
    assert retune(arm, moved).kept


def test_effects_are_fitted_again_without_the_quarter_that_judges_the_layer(monkeypatch):
    """Every row of the problem is left out of one fit, in stretches of time of about a quarter."""
    off = copy.deepcopy(bare_arm())
    off.network.layers[-1].bias += 0.02
    problem = problem_of(off, [measured_on(TRUTHS["gain_mismatch"])], part="training")
    fitted = fit_effects(problem, ["gain_mismatch"])
    seen = []

    def recorded(inside, names):
        seen.append((inside.time_s, names))
        return fitted_model(inside, names)

    monkeypatch.setattr("surgisoft.diagnosis.estimation.network.fitted_model", recorded)
    assert retune(fitted.model, problem, ["gain_mismatch"]).kept
    assert [names for _, names in seen] == [["gain_mismatch"]] * 4
    left = [np.setdiff1d(problem.time_s, time_s) for time_s, _ in seen]
    assert np.array_equal(np.sort(np.concatenate(left)), np.unique(problem.time_s))
    shares = [len(each) / len(problem.time_s) for each in left]
    assert shares == pytest.approx([0.25] * 4, abs=0.06)
    assert all(a.max() < b.min() for a, b in itertools.pairwise(left))


def test_the_model_alone_is_that_of_the_fit_with_intervals():
    """Bit for bit, of two new effects."""
    truth = measured_on(TRUTHS["gain_mismatch"], runs=2, rows=60)
    problem = problem_of(bare_arm(), [truth], part="all")
    names = ["gain_mismatch", "misalignment"]
    alone, whole = fitted_model(problem, names), fit_effects(problem, names).model
    mine, theirs = alone.state_dict(), whole.state_dict()
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)
    assert not any(p.requires_grad for p in alone.parameters())


def test_a_recurrent_baseline_takes_no_effects():
    arm = bare_arm()
    low, high = torch.tensor(arm.spec.low), torch.tensor(arm.spec.high)
    recurrent = ArmModel(arm.spec, RecurrentArm(low, high, 5, 8), {}, arm.rest_mm).eval()
    problem = problem_of(recurrent, [measured_on(arm, rows=100)], part="training")
    with pytest.raises(InputError, match="recurrent baseline takes none"):
        fit_effects(problem, ["creep"])


def test_runs_that_repeat_each_other_are_left_out_together():
    """Three runs of one schedule with noise, then one at other chambers, one at half the height."""
    rng = np.random.default_rng(0)
    saw = np.abs(np.linspace(-1, 1, 50))[:, None]
    shapes = [saw * [1, 0, 0]] * 3 + [saw * [0, 1, 0], saw * [0.5, 0, 0]]
    pressure = np.concatenate([s + rng.normal(0, 0.01, s.shape) for s in shapes])
    assert kinds(pressure, np.repeat(np.arange(5), 50)).tolist() == [0, 0, 0, 1, 2]


def test_an_interval_contains_the_error_of_the_network():
    """A network that is off by more makes the interval wider, on the same recording."""
    truth, widths, sizes = TRUTHS["gain_mismatch"], [], (0.01, 0.4)
    made = measured_on(truth)
    for size in sizes:
        problem = problem_of(bare_arm(), [made], part="training")
        problem = replace(problem, discrepancy_mm=np.full(5, size))
        (parameter,) = fit_effects(problem, ["gain_mismatch"]).parameters
        widths.append(np.mean(np.subtract(parameter.high, parameter.low)))
    assert widths[1] > 3 * widths[0]


def short_problem():
    """An arm of two hundred rows in ten blocks of time."""
    problem = problem_of(bare_arm(), [measured_on(bare_arm(), runs=2, rows=100)], part="all")
    return replace(problem, discrepancy_mm=np.full(5, 0.2))


def test_a_network_errs_as_with_other_weights_at_its_validated_size(monkeypatch):
    """Networks whose weights are moved at random pull as much at two fields as the prior says."""
    problem, rng = short_problem(), np.random.default_rng(0)
    prior, network = NetworkError.of(problem), problem.model.network
    fields = np.ones((200, 5, 3, 2))
    fields[..., 1] = problem.pressure[:, :1, None]
    span, drawn, squares = np.array(problem.model.spec.span), [], []
    for _ in range(80):
        other = copy.deepcopy(network)
        for layer in other.layers[::2]:
            size = 1e-3 * float(layer.weight.std())
            for each in (layer.weight, layer.bias):
                each.data += size * torch.from_numpy(rng.normal(size=each.shape)).float()
        away = rng.uniform(0, 1, (100, 3)) * span, rng.choice([-1.0, 1.0], (100, 3))
        at = problem.table.pressure, problem.direction
        errors = []
        for each in (at, away):
            inputs = [torch.from_numpy(values).float() for values in each]
            errors.append((other(*inputs) - network(*inputs)).detach().double().numpy() / 1e-3)
        drawn.append(np.einsum("sncp,snc->p", fields, errors[0]))
        squares.append(np.square(errors[1]).sum(-1).mean())
    expected = np.cov(np.array(drawn).T) * 0.2**2 / np.mean(squares)
    for most in (2, 1):
        monkeypatch.setattr(network_error, "MOST_BACKWARD", most)
        pulls = prior.pulls(fields)
        found = pulls @ pulls.T
        np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=0.5)
        one, two = (each[0, 1] / np.sqrt(np.diag(each).prod()) for each in (found, expected))
        assert one == pytest.approx(two, abs=0.25)


def test_a_block_is_judged_by_the_static_error_of_the_others():
    """The short cut equals a fit without the block's rows, for key points that are missing, too."""
    problem, rng = short_problem(), np.random.default_rng(1)
    residual = rng.normal(size=problem.residual.shape)
    residual[::7, 2] = np.nan
    nuisance = Nuisance.of(problem, residual)
    found = nuisance.held_out(residual, problem.block)
    features = nuisance.features
    for block, point in ((0, 0), (3, 2)):
        seen = nuisance.seen[:, point]
        others, own = seen & (problem.block != block), seen & (problem.block == block)
        factor = np.triu(nuisance.factors[point][0])
        ridge = factor.T @ factor - features[seen].T @ features[seen]
        normal = features[others].T @ features[others] + ridge
        weights = np.linalg.solve(normal, features[others].T @ residual[others, point])
        expected = residual[own, point] - features[own] @ weights
        np.testing.assert_allclose(found[own, point], expected, rtol=1e-6, atol=1e-8)
    assert not found[::7, 2].any()


def test_amplitudes_of_an_effect_that_is_not_there_are_no_surprise():
    """The test's null: a network that is off, no effect. And its power: an effect that is there."""
    there = problem_of(bare_arm(), [measured_on(TRUTHS["gain_mismatch"])], part="training")
    assert fit_effects(there, ["gain_mismatch"]).p_value < 1e-3
    off, generator = bare_arm(), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for layer in off.network.layers[::2]:
            change = torch.randn(layer.weight.shape, generator=generator)
            layer.weight.add_(0.01 * layer.weight.std() * change)
    absent = problem_of(off, [measured_on(bare_arm())], part="training")
    assert fit_effects(absent, ["gain_mismatch"]).p_value > 0.05


def fit_of(values, jacobian, residual, hold=0.0, prior=0.0):
    """A fit of P values whose discrepancy takes nothing off and explains nothing."""
    count = len(values)
    nothing = SimpleNamespace(weighted=lambda slopes: slopes, held_out=lambda left, block: left)
    return Fit(
        values=np.array(values, float),
        jacobian=np.array(jacobian, float),
        residual=np.array(residual, float),
        nuisance=nothing,
        hold=hold * np.eye(count),
        misfit=1.0,
        prior_variance=np.full(count, prior),
    )


def test_the_covariance_of_values_by_hand():
    """Four blocks of two rows pull by 1, -1, 3 and 1; a network's error by 2, twice as large as it
    was validated; what holds the value by 0.5 with a variance of 9."""
    jacobian, residual = np.zeros((8, 1, 3, 1)), np.zeros((8, 1, 3))
    jacobian[:, 0, 0] = 1.0
    residual[::2, 0, 0] = [1.0, -1.0, 3.0, 1.0]
    block = np.repeat(np.arange(4), 2)
    size = np.mean(np.square(residual).sum(2))
    problem = SimpleNamespace(
        block=block, noise_mm=np.array([0.5]), tolerance_mm=np.array([np.sqrt((size - 0.25) / 2)])
    )
    network = SimpleNamespace(pulls=lambda weighted: np.array([[2.0]]))
    found = with_covariance(fit_of([1.0], jacobian, residual, 0.5, 9.0), problem, network)
    wider = stats.t(3).ppf(0.975) / stats.norm.ppf(0.975)
    noise = 8.0 * wider**2 * 4.0 / 3.0  # squares about the mean of 1: 0, 4, 4 and 0
    assert found.meat.item() == pytest.approx(noise + 2.0 * 4.0 + 0.5 * 9.0 * 0.5)
    assert found.curvature.item() == pytest.approx(8.0 + 0.5)
    assert found.covariance.item() == pytest.approx(found.meat.item() / 8.5**2)
    fine = SimpleNamespace(block=block, noise_mm=np.array([0.5]), tolerance_mm=np.array([9.0]))
    least = with_covariance(fit_of([1.0], jacobian, residual), fine, network)
    assert least.meat.item() == pytest.approx(noise + 4.0), "not less than as it was validated"


def test_the_chance_of_amplitudes_by_hand():
    """Wald's statistic of both values, and of the first alone, whose curvature is its own."""
    fit = fit_of([3.0, 1.0], np.zeros((1, 1, 3, 2)), np.zeros((1, 1, 3)))
    curvature, meat = np.array([[2.0, 1.0], [1.0, 2.0]]), np.diag([1.0, 4.0])
    known = Fitted(fit, curvature, meat)
    both = 49.0 / 1.0 + 25.0 / 4.0
    assert p_value(known, np.array([True, True])) == pytest.approx(stats.chi2(2).sf(both), rel=1e-6)
    small = Fitted(fit, curvature / 6.0, meat)
    # All free values are degrees of freedom: the second one was chosen for the first.
    assert p_value(small, np.array([True, False])) == pytest.approx(stats.chi2(2).sf(1.0), rel=1e-6)
    inverse = np.array([[2.0, -1.0], [-1.0, 2.0]]) / 3.0
    np.testing.assert_allclose(known.covariance, inverse @ meat @ inverse)
    drawn = known.draws(20000, np.random.default_rng(0))
    np.testing.assert_allclose(drawn.mean(0), [3.0, 1.0], atol=0.05)
    np.testing.assert_allclose(np.cov(drawn.T), known.covariance, atol=0.05)


@pytest.mark.parametrize(
    ("value", "low", "high", "may"),
    [
        (3000.0, 1500.0, 1e6, True),
        (3000.0, 2100.0, 1e6, False),
        (0.05, 0.01, 0.2, True),
        (0.05, 0.01, 0.09, False),
        ([90.0, 3000.0], [80.0, 2100.0], [95.0, 1e6], False),
    ],
)
def test_a_value_beyond_its_range_may_be_plausible_by_its_interval(value, low, high, may):
    tau = Parameter("creep", "tau_s", value, low, high, "s", False, (0.1, 2000.0), "the library's")
    assert tau.may_be_plausible is may
    assert replace(tau, plausible=True).may_be_plausible


@pytest.mark.parametrize(
    ("low", "high", "known"),
    [
        (0.02, 6.6e6, False),
        (0.02, 1500.0, False),  # ln(15000) / ln(20000) = 0.97 of the range
        (0.02, 600.0, True),  # 0.88
        (300.0, 6.6e6, True),
        (80.0, 95.0, True),
    ],
)
def test_a_value_of_which_nothing_is_learned_is_said_to_be_not_identifiable(low, high, known):
    """A recording of minutes says nothing of a time constant whose interval covers its range."""
    tau = Parameter("creep", "tau_s", 90.0, low, high, "s", True, (0.1, 2000.0), "the library's")
    assert tau.identifiable is known is tau.to_json()["identifiable"]
    assert tau.interval_text.startswith("not identifiable from these recordings") is not known
    chambers = replace(tau, value=[90.0, 90.0], low=[low, 80.0], high=[high, 95.0])
    assert chambers.identifiable


@pytest.mark.parametrize(
    ("low", "high", "known"),
    [(3.6e-5, 3.3e7, False), (0.009, 1e4, False), (0.09, 9.6e3, True), (3.6e-5, 1e3, True)],
)
def test_a_range_from_zero_is_covered_by_an_interval_of_a_logarithm(low, high, known):
    """The stress above which a fluid is shear-thinning is positive, as small as it may be."""
    turn = Parameter("rate_dependence", "turn", 226.7, low, high, "", True, (0.0, 1e4), "wide")
    assert turn.identifiable is known


def test_an_interval_of_nearly_all_plausible_values_is_not_printed_as_numbers():
    """A dead time between microseconds and minutes, beside one that a recording determines; of a
    range with negative values the share counts, and a range that is covered is covered by all."""
    dead = Parameter(
        "line_lag", "dead_s", 0.05, 2.635e-6, 1211.0, "s", True, (0.0, 2.0), "wide: tubes"
    )
    assert dead.interval_text.endswith("covers nearly all plausible values, 0 to 2")
    assert replace(dead, low=1e-7).interval_text.endswith("covers all plausible values, 0 to 2")
    assert replace(dead, low=0.04, high=0.06).interval_text == "0.04 to 0.06"
    share = replace(dead, value=0.1, plausible_range=(-0.5, 0.5))
    assert replace(share, low=-0.49, high=0.9).identifiable is False
    assert replace(share, low=-0.4, high=0.9).identifiable is True
    both = replace(share, value=[0.1, 0.1], low=[-0.49, -0.4], high=[0.9, 0.9])
    assert both.identifiable is True
    for endless in ((0.0, np.inf), (-np.inf, np.inf), (1.0, 1.0)):
        assert replace(share, low=-0.4, high=0.9, plausible_range=endless).identifiable is True


def test_a_page_has_words_and_former_values_of_parameters():
    """The column of former values is there where the model had an effect of them."""
    fresh = Parameter("creep", "tau_s", 90.0, 80.0, 95.0, "s", True, (0.1, 2000.0), "the library's")
    had = replace(fresh, before=120.0)
    result = SimpleNamespace(parameters=(fresh,), in_words={"creep": "half of it in 60 s"})
    words, table = parameter_parts(result)
    assert words == Text("creep: half of it in 60 s.")
    assert "before" not in table.header
    result = SimpleNamespace(parameters=(fresh, had), in_words={"creep": ""})
    (table,) = parameter_parts(result)
    place = table.header.index("before")
    assert [row[place] for row in table.rows] == ["-", "120"]
    assert {len(row) for row in table.rows} == {len(table.header)}


@pytest.mark.parametrize("more", [True, False])
def test_a_second_effect_of_a_kind_is_added_where_the_present_one_fitted_anew_leaves_more(more):
    """Loops of plays at other radii and lines beside those of the arm's own wall."""
    arm = default_arm()
    arm.network.requires_grad_(False)
    form = {"radii": FEW_RADII, "ring": True, "pairs": False}
    weights = 0.05 * torch.eye(3, len(FEW_RADII)).flip(1)
    truth = with_truth("hysteresis", {"turned": weights}, arm, **form)
    problem = problem_of(arm, [measured_on(truth, rows=300)])
    fitted = fit_effects(problem, ["hysteresis"], more=["hysteresis"] if more else [])
    left = rms(problem.with_model(fitted.model).residual)
    if more:
        assert fitted.keys == {"hysteresis": "hysteresis#2"}
        assert fitted.refitted == ()
        assert set(fitted.in_words) == {"hysteresis#2"}
        assert left == pytest.approx(np.sqrt(3) * NOISE_MM, rel=0.1)
    else:
        assert (fitted.keys, fitted.refitted) == ({}, ("hysteresis",))
        assert left > 1.4 * np.sqrt(3) * NOISE_MM


def test_the_present_effect_is_fitted_anew_where_one_more_does_no_better():
    arm = default_arm()
    arm.network.requires_grad_(False)
    truth = copy.deepcopy(arm)
    truth.effects["hysteresis"].weight.data.mul_(1.5)
    problem = problem_of(arm, [measured_on(truth, rows=150)])
    fitted = fit_effects(problem, ["hysteresis"], more=["hysteresis"])
    assert (fitted.keys, fitted.refitted) == ({}, ("hysteresis",))
    assert list(fitted.model.effects) == ["hysteresis"]
    left = rms(problem.with_model(fitted.model).residual)
    assert left == pytest.approx(np.sqrt(3) * NOISE_MM, rel=0.15)
