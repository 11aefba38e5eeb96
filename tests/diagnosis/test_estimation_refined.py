"""Competing effects with fitted parameters: a lag between grid points, and hysteresis."""

import itertools

import numpy as np
import pytest
import torch

from surgisoft.diagnosis import selection
from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.estimation.effects import refined
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.diagnosis.selection import ModelSelection
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.effects import EFFECTS, make_effect
from tests.diagnosis.synthetic import backlash, walk

PERIOD_S, SUBSTEPS, NOISE_MM = 0.05, 20, 0.05
RIVALS = ("line_lag", "rate_dependence", "hysteresis", "inertia", "creep", "gain_mismatch")
"""A lag of the lines, and what may be taken for it."""


def lagged(signal: np.ndarray, time_s: float) -> np.ndarray:
    """(T, m) first-order lag of a signal that goes straight from row to row, in small steps."""
    answer, y = [signal[0]], signal[0].copy()
    for before, after in itertools.pairwise(signal):
        for k in range(SUBSTEPS):
            u = before + (k + 0.5) / SUBSTEPS * (after - before)
            y = u + (y - u) * np.exp(-PERIOD_S / SUBSTEPS / time_s)
        answer.append(y.copy())
    return np.array(answer)


def made(commands: np.ndarray, pressure: np.ndarray) -> Recording:
    """What the default arm does under a pressure (T, m), recorded as if under the commands."""
    arm, time_s = default_arm(), PERIOD_S * np.arange(len(commands))
    blank = np.zeros((len(commands), arm.spec.key_points, 3))
    history = history_of([Recording("made", time_s, measured=pressure, key_points_mm=blank)])
    points = arm.predict(history)[0].numpy()
    noise = np.random.default_rng(1).normal(0, NOISE_MM, points.shape)
    return Recording(
        "made", time_s, measured=commands, key_points_mm=points + noise, noise_mm=NOISE_MM
    )


def supported(rows: int, azimuth_rad: float, rise_rad: float, offset_mm: float) -> Recording:
    """The default arm beside a plane support that its tip meets: angles of its normal, offset."""
    arm, time_s = default_arm(), PERIOD_S * np.arange(rows)
    low, high = np.array(arm.spec.low), np.array(arm.spec.high)
    commands = low + (0.1 + 0.05 * walk(rows, 3)) * (high - low)
    blank = np.zeros((rows, arm.spec.key_points, 3))
    history = history_of([Recording("made", time_s, measured=commands, key_points_mm=blank)])
    contact = make_effect(
        "contact",
        arm.facts,
        azimuth_rad=azimuth_rad,
        rise_rad=rise_rad,
        offset_mm=offset_mm,
    )
    beside = arm.replace(effects={**arm.effects, "contact": contact})
    with torch.no_grad():
        contact.share.fill_(0.9)
        points = beside.predict(history)[0].numpy()
    noise = np.random.default_rng(1).normal(0, NOISE_MM, points.shape)
    return Recording(
        "made", time_s, measured=commands, key_points_mm=points + noise, noise_mm=NOISE_MM
    )


@pytest.fixture(scope="module")
def lagging():
    """An arm whose pressure lags behind what is taken for it; the grid has 0.15, 0.4 and 1 s."""
    low, high = np.array(default_arm().spec.low), np.array(default_arm().spec.high)
    commands = low + (0.1 + 0.05 * walk(6000, 3)) * (high - low)
    return made(commands, lagged(commands, 0.24))


def test_a_backlash_beside_the_plays_of_the_model_is_hysteresis():
    """A dead travel of one kPa, in tubes or gears, is narrower than the arm's own loops."""
    low, high = np.array(default_arm().spec.low), np.array(default_arm().spec.high)
    commands = low + (0.1 + 0.05 * walk(3000, 3)) * (high - low)
    behind = np.stack([backlash(column, 1.0) for column in commands.T], axis=1)
    found = diagnose(default_arm(), [made(commands, behind)], setup_tests=False, refit="never")
    assert found.verdict.effects == ("hysteresis",)
    assert found.ranking[0].gain_alone > 0.8


def test_a_lag_before_the_plays_is_no_viscosity_behind_them(lagging, monkeypatch):
    others = [name for name in EFFECTS if name not in RIVALS]
    found = diagnose(default_arm(), [lagging], without=others, setup_tests=False, refit="never")
    assert found.ranking[0].effect == "line_lag"
    assert found.verdict.effects[:1] == ("line_lag",)
    (fine_mm,) = (row.heldout_rmse_mm for row in found.ranking if row.effect == "line_lag")
    monkeypatch.setattr(selection, "refined", lambda *_: [])
    problem = problem_of(default_arm(), [lagging])
    some = candidates(problem, ["line_lag", "hysteresis", "rate_dependence"])
    rough = selection.select(problem, some, lambda text: None)
    (losses,) = (score.losses for score in rough.first if score.effect == "line_lag")
    assert fine_mm < 0.7 * rough.selection.rmse_mm(losses)


@pytest.mark.parametrize(
    ("rows", "azimuth_rad", "rise_rad", "offset_mm", "by_chance"),
    [
        (3000, 0.6, 0.4, 44.4, False),  # one effect alone explains most, on the grid too
        (800, 0.6, 0.2, 32.8, True),  # on the grid it explains little, and is within chance
    ],
)
def test_an_effect_between_points_of_the_grid_is_refined(
    rows, azimuth_rad, rise_rad, offset_mm, by_chance, monkeypatch
):
    """A support whose direction and height lie between those of the grid, with no effect close."""
    problem = problem_of(default_arm(), [supported(rows, azimuth_rad, rise_rad, offset_mm)])
    some = candidates(problem, ["contact", "payload", "misalignment"])
    fine = selection.select(problem, some, lambda text: None)
    monkeypatch.setattr(selection, "refined", lambda *_: [])
    rough = selection.select(problem, some, lambda text: None)
    assert (rough.proposals == ()) == by_chance
    assert rough.first[0].gain < (0.3 if by_chance else 0.8)
    assert fine.proposals[0].effects == ("contact",)
    assert fine.first[0].gain > (0.95 if by_chance else 0.9)


def test_a_model_as_good_as_it_was_validated_gets_no_refined_effect(monkeypatch):
    """Nothing is missing: refined effects would only follow the noise."""
    low, high = np.array(default_arm().spec.low), np.array(default_arm().spec.high)
    commands = low + (0.1 + 0.05 * walk(1200, 3)) * (high - low)
    problem = problem_of(default_arm(), [made(commands, commands)])
    asked = []
    monkeypatch.setattr(selection, "refined", lambda *given: asked.append(given) or [])
    some = candidates(problem, ["contact", "payload", "misalignment"])
    found = selection.select(problem, some, lambda text: None)
    assert found.selection.whole_size < 1.0
    assert not asked


def test_what_is_fitted_is_plausible_small_and_new(lagging):
    problem = problem_of(default_arm(), [lagging], part="training")
    selection = ModelSelection.of(
        problem, candidates(problem, ["line_lag", "hysteresis", "rate_dependence"])
    )
    first = selection.scores()
    assert {score.effect for score in first} >= {"line_lag", "hysteresis"}
    fitted = refined(problem, selection.starts(first))
    names = [candidate.name for candidate in fitted]
    assert "line_lag" in names
    assert "hysteresis" not in names  # the model has it already
    assert all(candidate.effect.plausible() for candidate in fitted)
    assert all(candidate.sensitivities.shape[3] == 1 for candidate in fitted)
    twice = next(c for c in fitted if c.name == "line_lag")
    half = twice.with_amplitudes(np.array([0.5]))
    assert half.share.item() == pytest.approx(0.5 * twice.effect.share.item())


def test_a_fit_leaves_the_shapes_of_the_grid_as_they_are(lagging):
    problem = problem_of(default_arm(), [lagging], part="training")
    selection = ModelSelection.of(problem, candidates(problem, ["line_lag"]))
    score = selection.scores()[0]
    effect = selection.in_place(score.option)
    before = {name: p.detach().clone() for name, p in effect.named_parameters()}
    assert refined(problem, selection.starts([score]))
    after = dict(selection.in_place(score.option).named_parameters())
    assert all(after[name].equal(value) for name, value in before.items())


def ramps_from_rest(rows: int) -> np.ndarray:
    """(rows, 3) some of the chambers up to a load and back to rest, again and again, in 0 to 1."""
    rng, answer = np.random.default_rng(0), []
    while len(answer) < rows:
        top = rng.uniform(0.3, 0.9) * (rng.random(3) < 0.6)
        way = np.concatenate([np.linspace(0, 1, 60), np.linspace(1, 0, 60)])
        answer += list(way[:, None] * top)
    return np.array(answer[:rows])


def test_loops_do_not_stand_for_what_the_actuation_explains():
    """A gain, on ramps that begin at rest: loops explain it, and are refused; a backlash not."""
    low, high = np.array(default_arm().spec.low), np.array(default_arm().spec.high)
    commands = low + ramps_from_rest(2400) * (high - low)
    behind = np.stack([backlash(column, 1.0) for column in commands.T], axis=1)
    for pressure, allowed in ((0.94 * commands, False), (behind, True)):
        problem = problem_of(default_arm(), [made(commands, pressure)])
        selection = ModelSelection.of(problem, candidates(problem, ["hysteresis"]))
        best = min(
            selection.options["hysteresis"],
            key=lambda option: selection.losses(option.chosen).sum(),
        )
        assert selection.losses(best.chosen).sum() < 0.2 * selection.losses().sum()
        assert selection.plausible(best) == allowed
