"""A refit names a lag that the network has learned to imitate, and leaves a clean arm alone."""

import copy
import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from surgisoft.cli import diagnose as diagnose_command
from surgisoft.cli import run
from surgisoft.diagnosis import amend as amending
from surgisoft.diagnosis import diagnose as diagnosing
from surgisoft.diagnosis import improve as improving
from surgisoft.diagnosis import refit as refitting
from surgisoft.diagnosis.candidates import with_effect
from surgisoft.diagnosis.decision import Decision, Probabilities
from surgisoft.diagnosis.diagnose import (
    Diagnosis,
    ErrorLevels,
    Ranked,
    Verdict,
    second_too,
    with_refit,
)
from surgisoft.diagnosis.estimation.effects import starts
from surgisoft.diagnosis.estimation.intervals import Parameter
from surgisoft.diagnosis.inputs import identification_problem
from surgisoft.diagnosis.refit import (
    ASKED,
    Job,
    JointFit,
    Outcome,
    RefitConfig,
    Split,
    apart_mm,
    fit_together,
    in_front,
    least_units,
    reason_to_refit,
    refit,
    run_job,
    starting_model,
)
from surgisoft.diagnosis.residuals import TOGETHER
from surgisoft.errors import InputError
from surgisoft.measurement.fitting import fit
from surgisoft.measurement.recordings import Recording, save_recording
from surgisoft.surrogate.checkpoint import save_model
from surgisoft.surrogate.effects import Memoryless, known_effects, make_effect
from surgisoft.surrogate.model import ArmModel, Validation
from tests.few_effects import all_but, choose_among

PERIOD_S, LAG_S, NOISE_MM = 0.1, 0.4, 0.1
SHORT = RefitConfig(rows=800, seeds=2, early_epochs=1, first_epochs=2, epochs=3, finalists=2)
"""A budget of seconds."""


def command(rows: int, seed: int = 0) -> np.ndarray:
    """(rows, 2) pressures of 0 to 60 kPa: ramps at three rates and rests, by a loop of its own."""
    rng = np.random.default_rng(seed)
    columns = []
    for _ in range(2):
        values = [0.0]
        while len(values) < rows:
            goal = rng.uniform(0.0, 60.0)
            count = max(1, int(abs(goal - values[-1]) / rng.choice([1.5, 4.0, 10.0])))
            values += list(np.linspace(values[-1], goal, count + 1)[1:])
            values += [goal] * int(rng.integers(0, 25))
        columns.append(values[:rows])
    return np.array(columns).T


def arm_by_hand(lag_s: float = LAG_S, rows: int = 1200) -> Recording:
    """An arm of constant curvature behind a first-order lag, from formulas written here."""
    asked = command(rows)
    chamber, now = np.empty_like(asked), np.zeros(2)
    for row, value in enumerate(asked):
        now = value + (now - value) * (np.exp(-PERIOD_S / lag_s) if lag_s else 0.0)
        chamber[row] = now
    bend = 0.02 * chamber
    angle = np.maximum(np.hypot(*bend.T), 1e-9)
    length = 80.0 + 0.05 * chamber.sum(1)
    points = []
    for share in (0.5, 1.0):
        turned = share * angle
        across = share * length * (1.0 - np.cos(turned)) / turned
        along = share * length * np.sin(turned) / turned
        points.append(np.stack([*(across * bend.T / angle), along], axis=1))
    noise = np.random.default_rng(1).normal(0.0, NOISE_MM, (rows, 2, 3))
    return Recording(
        name="hand",
        t_s=PERIOD_S * np.arange(rows),
        measured=asked,
        commanded=asked,
        key_points_mm=np.stack(points, axis=1) + noise,
        noise_mm=NOISE_MM,
    )


def fitted_to(recording: Recording, **more) -> ArmModel:
    given = {"actuation": "commanded", "hidden": (24, 24), "epochs": 40, "inputs": "pressure"}
    given["prior"] = "none"
    return fit([recording], **(given | more)).model


@pytest.fixture(scope="module")
def lagging():
    """A recording of the lagging arm, and a network that was fitted to it without the lag."""
    recording = arm_by_hand()
    return recording, fitted_to(recording)


@pytest.fixture(scope="module")
def problem(lagging):
    return identification_problem(lagging[1], [lagging[0]])


@pytest.fixture(scope="module")
def found(problem):
    """A refit with three of the candidates, to save time."""
    return refit(problem, without=["hysteresis", "inertia", "softening"], config=SHORT)


@pytest.fixture(scope="module")
def unasked(lagging):
    """A diagnosis of the lagging arm among three effects, which may not refit."""
    recording, model = lagging
    without = all_but("line_lag", "creep", "payload")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnosing, "fit_candidates_together", None)
        return diagnosing.diagnose(model, [recording], refit="never", without=without)


@pytest.fixture
def short(monkeypatch):
    """The commands with a budget of seconds and one candidate, in this process; residuals are
    explained by one of three effects."""
    monkeypatch.setattr(refitting, "hideable", lambda *given: (["line_lag"], {}))
    choose_among(monkeypatch, "line_lag", "creep", "payload")
    made = []

    def once(problem, *given, **more):
        """The same refit for the same problem; that it is the same, another test shows."""
        asked = problem.residual.tobytes(), problem.predicted.tobytes(), given
        for before, found in made:
            if before == asked:
                return found
        made.append((asked, refit(problem, *given, **more, config=SHORT)))
        return made[-1][1]

    monkeypatch.setattr(diagnosing, "fit_candidates_together", once)
    monkeypatch.setattr(diagnose_command, "REFIT_PROCESSES", 1)


def test_a_lag_that_the_network_imitates_is_named(problem, found):
    """Its error is that of its validation, so the residuals alone say nothing."""
    assert "may imitate" in reason_to_refit(problem)
    assert found.winner == "line_lag"
    best = found.of("line_lag")
    assert best.plausible
    assert best.p_value <= 0.02
    assert best.ci95_mm[0] > 0
    assert best.heldout_rmse_mm < 0.5 * best.rival_mm
    assert found.confidence > 0.5
    time = best.parameters["tau_up_s"] + best.parameters["dead_s"]
    assert time == pytest.approx(LAG_S, rel=0.35)


@pytest.mark.parametrize(
    ("share", "words"),
    [(1.0, "no larger than"), (0.999, "as large as"), (0.9, "1.11 times")],
)
def test_the_reason_compares_the_numbers_that_it_prints(problem, share, words):
    """Validated errors that are a share of the error, both without noise."""
    excess = np.sqrt(problem.rmse_mm**2 - problem.floor_mm**2)
    alike = np.full_like(problem.discrepancy_mm, share * excess)
    text = f"at {excess:.3g} mm, {words} the model's validated error ({share * excess:.3g} mm "
    assert text in reason_to_refit(replace(problem, discrepancy_mm=alike))


def test_a_larger_error_is_no_change_on_the_rows_of_the_fit(problem):
    """Five times the validated error: on the rows of the fit the network may still imitate a lag;
    on other rows the arm may have changed."""
    known = problem.model.fitted_rows
    larger = replace(problem, discrepancy_mm=problem.discrepancy_mm / 5.0)
    assert larger.in_fit == 1.0
    assert "the model was fitted to 100% of these rows" in reason_to_refit(larger)
    problem.model.fitted_rows = replace(known, hashes=())
    try:
        assert larger.in_fit == 0.0
        assert reason_to_refit(larger) == ""
        assert "validated error" in reason_to_refit(problem)
    finally:
        problem.model.fitted_rows = known


def test_a_training_that_came_out_badly_names_no_effect(monkeypatch):
    """The network alone ends off in the first of two trainings, as it may by chance: half of all
    blocks then show a gain of every effect, though none is missing."""
    recording = arm_by_hand(lag_s=0.0)
    model = fitted_to(recording)
    train, alone = refitting.run_job, {id(model.network): model.network}

    def unlucky(split, job):
        outcome = train(split, job)
        if id(job.model.network) in alone:
            alone[id(outcome.model.network)] = outcome.model.network
            if job.part == 0:
                with torch.no_grad():
                    for weight in outcome.model.network.parameters():
                        weight.mul_(1.03)
                outcome = replace(outcome, losses=split.losses(outcome.model))
        return outcome

    monkeypatch.setattr(refitting, "run_job", unlucky)
    clean = identification_problem(model, [recording])
    found = refit(clean, without=all_but("softening", "rate_dependence", "inertia"), config=SHORT)
    candidates, finalists, checked = 3, 2, 1
    assert found.trainings == SHORT.seeds * (candidates + 1 + finalists + 1 + checked)
    assert found.winner is None
    assert found.alone_mm < 0.4  # the network alone as the check has it, not 0.97 mm


def test_the_error_of_the_candidate_is_that_of_left_out_blocks(found):
    """By hand: mean square over seeds of parts of nearly equal size."""
    for row in found.candidates:
        assert len(row.seeds_mm) == SHORT.seeds
        together = np.sqrt(np.mean(np.square(row.seeds_mm)))
        assert row.heldout_rmse_mm == pytest.approx(together, rel=0.1)
        assert row.difference_mm == pytest.approx(row.rival_mm - row.heldout_rmse_mm)
        assert row.ci95_mm[0] <= row.difference_mm <= row.ci95_mm[1]


def with_errors(monkeypatch, given, implausible=()):
    """Let trainings end with errors (B,) mm of each key point in the blocks of their left-out part,
    by effect (None: the network alone), and with none in the others; returns the jobs.

    implausible: (effect, part) of trainings that end with an implausible effect.
    """
    jobs = []

    def run(split, job):
        jobs.append(job)
        label = job.effects[0] if job.effects else None
        error = given[label] * np.ones(len(split.part))
        error = np.where(split.part == job.part, error, 0.0)
        rows = np.bincount(split.problem.block)
        model = job.model
        if (label, job.part) in implausible:
            model = copy.deepcopy(model)
            with torch.no_grad():
                for amplitude in model.effects[label].amplitudes().values():
                    amplitude.fill_(50.0)
        losses = (rows * error**2)[:, None] * np.ones((1, 2))
        return Outcome(model, losses, (*job.before, job.epochs))

    monkeypatch.setattr(refitting, "run_job", run)
    return jobs


def test_the_score_of_a_candidate_by_hand(problem, monkeypatch):
    """2 mm of the network alone and 1 mm with creep in every one of 20 blocks, of which half were
    left out by each of two trainings; the noise counts beside both."""
    jobs = with_errors(monkeypatch, {None: 2.0, "creep": 1.0})
    found = refit(problem, without=all_but("creep"), config=SHORT)
    (row,) = found.candidates
    noise = problem.floor_mm**2
    assert (found.unit, found.units) == ("blocks of time", 20)
    assert (row.rival_mm, row.heldout_rmse_mm, row.difference_mm) == pytest.approx((2.0, 1.0, 1.0))
    assert row.ci95_mm == pytest.approx((1.0, 1.0))
    assert row.per_key_point_mm == pytest.approx((1.0, 1.0))
    assert row.seeds_mm == pytest.approx((1.0, 1.0))
    assert row.spread_mm == pytest.approx(0.0)
    assert row.gain == pytest.approx(3.0 / (4.0 - noise))
    assert row.log_gain == pytest.approx(np.log((4.0 + noise) / (1.0 + noise)))
    assert 0.0 < row.p_value < 0.01
    assert (row.stages, row.epochs) == ((SHORT.early_epochs,), SHORT.early_epochs)
    assert (found.winner, found.competing, found.alone_mm) == ("creep", (), pytest.approx(2.0))
    assert found.confidence == pytest.approx(1.0 - row.p_value)
    assert {(job.part, job.seed) for job in jobs} == {(0, SHORT.seed), (1, SHORT.seed + 1)}


def test_an_interval_and_a_spread_come_from_blocks_and_from_seeds(problem, monkeypatch):
    """Creep leaves 1 mm in one part and half a millimetre in the other."""
    part = Split.of(problem, SHORT).part
    with_errors(monkeypatch, {None: 2.0, "creep": np.where(part == 0, 1.0, 0.5)})
    (row,) = refit(problem, without=all_but("creep"), config=SHORT).candidates
    assert row.seeds_mm == pytest.approx((1.0, 0.5))
    assert row.spread_mm == pytest.approx(0.5 / np.sqrt(2.0))
    low, high = row.ci95_mm
    assert 1.0 < low < row.difference_mm < high < 1.5


@pytest.mark.parametrize("motions", [1, 2, 3, 4, 7, 20])
def test_no_part_is_left_without_blocks(problem, motions):
    """Blocks of few different motions; with enough of them neighbouring motions stay together."""
    config = replace(SHORT, seeds=3)
    few = replace(problem, motion=np.sort(np.arange(20) % motions))
    part = Split.of(few, config).part
    assert set(part.tolist()) == {0, 1, 2}
    if motions >= 3:
        assert all(len(set(part[few.motion == each])) == 1 for each in range(motions))


HALF = np.arange(20) % 2 == 0
"""Every other one of 20 blocks."""
FEW = np.isin(np.arange(20), (3, 8, 13))
"""Three of them."""


@pytest.mark.parametrize(
    ("errors", "winner", "competing", "of_line"),
    [
        ({"creep": 0.5, "softening": 1.5}, "creep", (), False),
        ({"creep": 0.5, "softening": 0.8}, "creep", (), False),
        ({"creep": 0.5, "softening": 0.505}, "creep", ("softening",), False),
        ({"creep": 0.5, "softening": np.where(HALF, 0.13, 1.3)}, "creep", ("softening",), False),
        ({"creep": 0.5, "softening": np.where(HALF, 0.05, 2.0)}, "creep", (), False),
        ({"creep": 0.5, "line_lag": 0.505}, "line_lag", ("creep",), True),
        ({"creep": 0.5, "line_lag": 1.5}, "creep", (), False),
        ({"creep": 1.8, "softening": 1.9}, None, (), False),
        ({None: np.where(FEW, 5.0, 1.0), "creep": np.where(FEW, 0.5, 1.0)}, None, (), False),
    ],
    ids=["alone", "worse", "alike", "unsure", "less", "line", "wall", "small", "chance"],
)
def test_who_wins_and_who_competes(problem, monkeypatch, errors, winner, competing, of_line):
    """Of 2 mm. Alike: within 2 % of the gain. Unsure: more in some blocks and less in others, with
    four fifths of the gain or more. A line's lag is that of a command. A gain has to be large and
    in more blocks than chance gives."""
    with_errors(monkeypatch, {None: 2.0, **errors})
    found = refit(problem, without=all_but(*errors), config=SHORT)
    assert (found.winner, found.competing, found.of_line) == (winner, competing, of_line)
    assert found.ambiguous is bool(competing and not of_line)
    assert (found.confidence > 0.0) == (winner is not None)
    if competing:
        assert found.confidence == pytest.approx(0.81), "other effects do about as well"


def test_an_effect_beyond_plausibility_in_one_training_is_not_named(problem, monkeypatch):
    """Neither is it trained on in the place of another one: two of three are, for longer."""
    errors = {None: 2.0, "creep": 0.4, "softening": 0.7, "inertia": 1.0}
    jobs = with_errors(monkeypatch, errors, implausible=[("creep", 1)])
    found = refit(problem, without=all_but("creep", "softening", "inertia"), config=SHORT)
    assert not found.of("creep").plausible
    assert not found.of("creep").named
    assert found.winner == "softening"
    last = {job.effects for job in jobs if job.epochs == SHORT.epochs}
    assert last == {(), ("softening",), ("inertia",)}
    jobs = with_errors(monkeypatch, errors)
    refit(problem, without=all_but("creep", "softening", "inertia"), config=SHORT)
    last = {job.effects for job in jobs if job.epochs == SHORT.epochs}
    assert last == {(), ("creep",), ("softening",)}, "the best ones"


def test_what_is_left_out_at_once(problem, lagging):
    """Blocks beside each other; of runs those of one kind; blocks where a run is far from all."""
    recording, model = lagging
    one = Split.of(problem, SHORT)
    changes = np.flatnonzero(np.diff(one.part))
    assert len(changes) > 2
    assert (np.diff(changes) == TOGETHER).all()
    again = replace(recording, name="again")
    other = arm_by_hand(rows=1200)
    moved = command(1200, seed=5)
    other = replace(other, name="other", measured=moved, commanded=moved)
    runs = [recording, again, other, replace(other, name="once more")]
    split = Split.of(identification_problem(model, runs), SHORT)
    assert split.unit_name == "runs"
    run = split.problem.history.run_of_row[split.problem.index].numpy()
    parts = [set(split.part[split.problem.block[run == number]].tolist()) for number in range(4)]
    assert parts[0] == parts[1]
    assert parts[2] == parts[3]
    assert parts[0] | parts[2] == {0, 1}
    assert len(split.unit) > 4
    low, high = (
        replace(recording, name=name, measured=x, commanded=x)
        for name, x in (("low", recording.measured / 4), ("high", 45 + recording.measured / 4))
    )
    far = Split.of(identification_problem(model, [low, high]), SHORT)
    assert far.unit_name == "blocks of time"


def test_units_are_enough_for_a_p_value_of_every_effect():
    """Of K units no p-value is below 2^-K; a family of effects shares the asked one."""
    family = sum(not issubclass(kind, Memoryless) for kind in known_effects().values())
    assert 2.0 ** -least_units() * family <= ASKED.p_value < 2.0 ** -(least_units() - 1) * family


def test_effects_apart_are_fitted_without_the_part_that_judges_them(problem, monkeypatch):
    seen = []

    def fitted(posed, names):
        seen.append(set(posed.index.tolist()))
        return posed.model

    monkeypatch.setattr(refitting, "fitted_model", fitted)
    unknown = replace(problem, model=problem.model.replace())
    unknown.model.fitted_rows = None
    found = apart_mm(unknown, ["line_lag"], SHORT)
    assert found == pytest.approx(problem.rmse_mm), "nothing was fitted"
    part = Split.of(unknown, SHORT).part[unknown.block]
    for number, rows in enumerate(seen):
        assert rows == set(unknown.index[torch.from_numpy(part != number)].tolist())


def test_a_joint_fit_sees_every_row_and_states_the_refits_error(problem, found, monkeypatch):
    jobs, rows = [], []

    def run(split, job):
        jobs.append(job)
        rows.append(split.rows)
        return Outcome(job.model, np.zeros((20, 2)), (*job.before, job.epochs))

    monkeypatch.setattr(refitting, "run_job", run)
    best = replace(found.of("line_lag"), stages=(2,), heldout_rmse_mm=0.3, rival_mm=0.9)
    few = replace(SHORT, rows=100)
    joint = fit_together(problem, ["line_lag"], best, few)
    assert rows == [len(problem.index)] * 2
    assert [job.part for job in jobs] == [None, None]
    assert [job.effects for job in jobs] == [("line_lag",), ()]
    assert joint.model.validation.rmse_mm == 0.3
    assert joint.model.validation.per_key_point_mm == best.per_key_point_mm
    assert joint.model.validation.rows == len(problem.index)


def test_the_rival_trains_on_the_same_rows_for_as_many_epochs(problem, monkeypatch):
    done = []
    train = refitting.train_jointly

    def counted(model, data, epochs, config, hold=None):
        done.append((tuple(model.effects), epochs, config.seed, data.held.sum().item()))
        train(model, data, 1, config, hold)

    monkeypatch.setattr(refitting, "train_jointly", counted)
    refit(problem, together=["line_lag"], config=SHORT)
    with_it = [rest for effects, *rest in done if effects]
    alone = [rest for effects, *rest in done if not effects]
    assert len(with_it) == 3 * SHORT.seeds
    assert sorted(with_it) == sorted(alone[: len(with_it)])
    check = alone[len(with_it) :]  # the lag is named, so its network is trained on without it
    assert len(check) == SHORT.seeds
    assert all(any(each == other for other in with_it) for each in check)
    stages = {SHORT.early_epochs, SHORT.first_epochs, SHORT.epochs}
    assert {epochs for epochs, *_ in with_it} == stages
    assert all(held > 0 for *_, held in with_it)


def test_the_stage_with_the_least_held_out_error_counts_and_is_what_is_trained(
    problem, monkeypatch
):
    """Training on makes every network worse here, from the second stage on."""
    train, done = refitting.train_jointly, []

    def spoiled(model, data, epochs, config, hold=None):
        done.append(epochs)
        if epochs == SHORT.early_epochs:
            train(model, data, epochs, config, hold)
        else:
            model.network.mean.add_(5.0)

    monkeypatch.setattr(refitting, "train_jointly", spoiled)
    (lag,) = refit(problem, together=["line_lag"], config=SHORT).candidates
    assert lag.stages == (SHORT.early_epochs,)
    assert lag.epochs == SHORT.early_epochs
    done.clear()
    fit_together(problem, ["line_lag"], lag, SHORT)
    fit_together(problem, ["line_lag"], replace(lag, stages=(1, 2)), SHORT)
    assert done == [1, 1, 1, 2, 1, 2]  # with the lag, and the network alone


def test_left_out_rows_are_no_part_of_a_training(problem, monkeypatch):
    """Training targets and held-out rows have no row in common, and all rows are left out once."""
    seen = []

    def look(model, data, epochs, config, hold=None):
        target = ~data.targets.isnan().all(-1).all(-1)
        assert not (target & data.held).any()
        assert target.any()
        seen.append(data.held & data.train.valid)

    monkeypatch.setattr(refitting, "train_jointly", look)
    refit(problem, together=["line_lag"], config=SHORT)
    parts = torch.stack(seen[: 2 * SHORT.seeds : 2]).int().sum(0).flatten()
    inside = torch.from_numpy(problem.block_of_row >= 0)
    assert (parts[inside] == 1).all()
    assert (parts[~inside] == 0).all()


def test_the_same_seed_gives_the_same_result_and_another_seed_another(lagging, monkeypatch):
    problem = identification_problem(lagging[1], [arm_by_hand(rows=500)])
    brief = replace(SHORT, early_epochs=1, first_epochs=1, epochs=1)
    first, other = (
        refit(problem, together=["line_lag"], config=replace(brief, seed=seed)) for seed in (0, 1)
    )
    asked, pool = [], refitting.workers

    def one_worker(count, begin):
        asked.append(count)
        return pool(1, begin)

    monkeypatch.setattr(refitting, "workers", one_worker)
    both = refit(problem, together=["line_lag"], config=brief, processes=2)
    assert asked == [2]
    assert replace(both, seconds=0.0) == replace(first, seconds=0.0), "again, in another process"
    assert first.candidates[0].heldout_rmse_mm != other.candidates[0].heldout_rmse_mm


def test_a_clean_model_at_its_floor_costs_nothing(monkeypatch):
    """A network that fits an arm without a lag: auto does not start a refit; never and always."""
    recording = arm_by_hand(lag_s=0.0)
    model = fitted_to(recording, epochs=40, learning_rate=2e-2)
    clean = identification_problem(model, [recording])
    assert clean.rmse_mm < 2.0 * clean.floor_mm
    assert reason_to_refit(clean) == ""
    assert refitting.refit_reason(clean, "never") == ""
    assert refitting.refit_reason(clean, "always")
    with pytest.raises(InputError, match="auto"):
        refitting.refit_reason(clean, "sometimes")

    def refuse(*given, **more):
        raise AssertionError("a refit was started")

    monkeypatch.setattr(diagnosing, "fit_candidates_together", refuse)
    without = all_but("line_lag", "hysteresis", "creep", "rate_dependence")
    assert diagnosing.diagnose(model, [recording], without=without).refit is None


def test_never_does_not_refit_where_auto_would(problem, unasked):
    assert reason_to_refit(problem)
    assert unasked.refit is None
    assert unasked.to_json()["refit"] is None


@pytest.mark.parametrize(
    ("why", "mode", "effects"),
    [
        ("learned", "auto", ("line_lag",)),
        ("learned", "never", ()),
        ("schedule", "auto", ()),
    ],
)
def test_what_the_network_has_learned_leads_to_a_refit(
    lagging, found, monkeypatch, why, mode, effects
):
    """Where the error is larger than auto asks for, but residuals cannot tell for this reason."""
    recording, model = lagging
    off = model.replace(validation=Validation(0.1, (0.1,) * model.spec.key_points, 300))
    off.fitted_rows = None
    none = replace(named(None, found), verdict=Verdict("cannot_tell", (), "why", 0.5, why))
    monkeypatch.setattr(diagnosing, "result_of", lambda findings: none)
    monkeypatch.setattr(diagnosing, "fit_candidates_together", lambda *given, **more: found)
    given = {"setup_tests": False, "without": all_but("line_lag")}
    result = diagnosing.diagnose(off, [recording], refit=mode, **given)
    assert result.verdict.effects[:1] == effects
    assert (result.refit is found) == bool(effects)


def test_half_a_minute_of_motion_is_no_case_for_a_refit(lagging, found, monkeypatch):
    """Unless it is asked for; and few motions are the reason why nothing can be told."""
    recording, model = lagging
    off = model.replace(validation=Validation(0.1, (0.1,) * model.spec.key_points, 300))
    off.fitted_rows = None
    part = {
        name: getattr(recording, name)[:400]
        for name in ("t_s", "measured", "commanded", "key_points_mm", "run")
    }
    none = replace(
        named(None, found),
        verdict=Verdict("cannot_tell", (), "why", 0.5, "learned"),
        probabilities=Probabilities(0.4, 0.2, 0.0, {"line_lag": 0.4}, 0.0, ()),
    )
    monkeypatch.setattr(diagnosing, "result_of", lambda findings: none)
    monkeypatch.setattr(diagnosing, "fit_candidates_together", lambda *given, **more: found)
    given = {"setup_tests": False, "without": all_but("line_lag")}
    auto, always = (
        diagnosing.diagnose(off, [replace(recording, **part)], refit=mode, **given)
        for mode in ("auto", "always")
    )
    assert auto.refit is None
    assert (auto.verdict.kind, auto.verdict.reason) == ("cannot_tell", "few_data")
    assert "anything: the recordings contain too few different motions" in auto.verdict.sentence
    assert "looked at 28 s of motion, expected 60 s or more" in auto.checks[-1]
    assert auto.next_command.startswith("surgisoft next-experiment")
    assert always.refit is found


def test_an_error_beyond_the_validated_one_is_left_to_the_residuals(problem):
    """Something has changed since the fit: the network cannot have learned it."""
    model = problem.model.replace(
        validation=Validation(0.4 * problem.rmse_mm, (0.4 * problem.rmse_mm,) * 2, 300)
    )
    model.fitted_rows = None  # other rows than those of the fit
    small = 0.4 * np.sqrt(np.nanmean(np.square(problem.residual).sum(2), axis=0))
    assert reason_to_refit(replace(problem, model=model, discrepancy_mm=small)) == ""


def test_effects_that_a_refit_cannot_decide_are_not_tried(problem, found):
    why = dict(found.not_tried)
    assert "function of the actuation" in why["gain_mismatch"]
    assert "behind the network" in why["payload"]
    model = problem.model.replace(spec=replace(problem.model.spec, actuation="measured"))
    names, left = refitting.hideable(replace(problem, model=model))
    assert "line_lag" not in names
    assert "measured" in left["line_lag"]
    assert "line_lag" in refitting.hideable(problem)[0]
    still = replace(problem, table=replace(problem.table, timed=np.zeros_like(problem.table.timed)))
    names, left = refitting.hideable(still)
    assert names == []
    assert "steady-state" in left["creep"]
    assert "steady-state" in left["line_lag"]


def test_a_lag_of_the_wall_is_said_to_be_possibly_one_of_the_line(problem, found):
    """Where the line was not tried, since the actuation counts as measured."""
    wall = replace(found.of("line_lag"), effect="rate_dependence")
    alone = replace(found, candidates=(wall,), winner="rate_dependence", competing=())
    model = problem.model.replace(spec=replace(problem.model.spec, actuation="measured"))
    told = [
        with_refit(named("creep", alone), alone, posed).checks
        for posed in (replace(problem, model=model), problem)
    ]
    assert any("--actuation commanded" in check for check in told[0])
    assert told[1] == ()


def named(effect: str | None, found) -> Diagnosis:
    """A diagnosis of the residuals that names an effect."""
    row = Ranked("creep", 0.9, 0.5, 0.5, 1.0, (0.9, 1.1), 0.01, 0.3, {})
    verdict = (
        Verdict("identified", (effect,), "so") if effect else Verdict("nothing_missing", (), "")
    )
    return Diagnosis(verdict, ErrorLevels(2.0, 0.1, 1.0), (row, replace(row, effect="line_lag")))


def test_without_a_winner_an_effect_that_was_tried_is_not_named_any_more(problem, found, unasked):
    """The residuals name creep, but the network alone does as well; or a payload, which stays."""
    none = replace(found, winner=None, competing=(), of_line=False, confidence=0.0)
    given = {"statistics": unasked.statistics, "probabilities": unasked.probabilities}
    result = with_refit(replace(named("creep", none), **given), none, problem)
    assert result.verdict.effects == ()
    assert result.verdict.kind not in ("identified", "several", "ambiguous")
    assert none.sentence in result.checks
    load = replace(named("payload", none), **given)
    assert with_refit(load, none, problem).verdict == load.verdict


def test_the_refit_decides_over_the_residuals(problem, found, unasked):
    chances = replace(unasked.probabilities, pair=0.4, two=("creep", "payload"))
    residuals = replace(named("creep", found), probabilities=chances)
    beside = second_too(Decision("identified", ("creep",), 0.0, chances))
    assert beside, "a payload may be missing beside the creep"
    residuals = replace(residuals, checks=("of the data", *beside))
    result = with_refit(residuals, found, problem)
    assert result.verdict.effects[0] == "line_lag"
    assert result.verdict.kind == "identified"
    assert result.checks == ("of the data",), "beside a creep that is not named any more"
    assert found.sentence in result.verdict.sentence
    assert result.ranking[0].effect == "line_lag"
    assert result.ranking[0].confidence == pytest.approx(found.confidence, abs=1e-4)
    assert result.ranking[1].confidence <= 1.0 - found.confidence + 1e-4
    fitted = found.of("line_lag")
    assert result.ranking[0].parameters == fitted.parameters
    assert result.in_words == (("line_lag", fitted.in_words),)
    assert "time constant of a rise" in fitted.in_words


def test_command_and_python_say_the_same_and_amend_makes_the_error_fall(
    lagging, tmp_path, capsys, short, monkeypatch
):
    """`amend` and `improve` are given the refit of `diagnose`: theirs is of the same rows."""
    recording, model = lagging
    save_model(model, tmp_path / "arm")
    save_recording(recording, tmp_path / "hand.parquet")
    arm, data = str(tmp_path / "arm"), str(tmp_path / "hand.parquet")
    assert (
        run(["diagnose", arm, data, "--json", f"{tmp_path}/x.json", "--report", f"{tmp_path}/r"])
        == 0
    )
    out = capsys.readouterr().out
    assert "identified: line_lag is missing" in out
    assert "fitted together with the network, line_lag leaves" in out
    assert "--refit always" in out
    written = json.loads((tmp_path / "x.json").read_text())
    called = diagnosing.diagnose(arm, data)
    assert written["verdict"]["effects"] == list(called.verdict.effects) == ["line_lag"]
    rows = [asdict(row) for row in called.refit.candidates]
    assert written["refit"]["candidates"] == json.loads(json.dumps(rows))
    assert written["refit"]["winner"] == "line_lag"
    assert "Fitted together" in (tmp_path / "r" / "diagnosis.html").read_text()
    joint = []

    def found_before(posed, *given, **options):
        assert posed.rmse_mm == called.error_mm.before
        return called.refit

    def fitted_once(posed, names, judged, **options):
        assert list(names) == ["line_lag"]
        assert judged == called.refit.of("line_lag")
        if not joint:
            joint.append(fit_together(posed, names, judged, SHORT))
        return joint[0]

    monkeypatch.setattr(amending, "refit_effects", found_before)
    monkeypatch.setattr(diagnosing, "fit_candidates_together", found_before)
    for module in (amending, improving):
        monkeypatch.setattr(module, "fit_together", fitted_once)
    amended = amending.amend(arm, data, "line_lag")
    assert amended.claimed
    assert amended.held_out.after < 0.5 * amended.held_out.before
    assert amended.alone.before > amended.held_out.after
    assert amended.refit.winner == "line_lag"
    assert amended.model.validation.rmse_mm < 0.5 * model.validation.rmse_mm
    assert "fitted together with the network" in amended.sentence
    # A model that knows the held-out rows from its fit is no rival of one that does not.
    known = replace(amended.held_out, before=0.01, fall=-1.0, ci95=(-2.0, -0.5), in_fit=0.4)
    seen = replace(amended, held_out=known)
    assert seen.claimed
    assert f"{seen.alone.before:.3f} to {seen.alone.after:.3f} mm" in seen.sentence
    assert "had been fitted to 40% of these rows" in seen.sentence
    assert not replace(amended, held_out=replace(known, in_fit=0.0)).claimed
    better = improving.improve(arm, data, most_effects=1)
    assert better.steps[0][0] == "line_lag"
    assert better.rounds[0].together
    assert better.claimed


def test_what_effects_behind_the_network_do_is_not_learned_by_it(lagging):
    """A frame that is 5 mm off belongs to its effect, and training leaves it there."""
    recording, arm = lagging
    turned = make_effect("misalignment", arm.facts)
    turned.shift.data.copy_(torch.tensor([5.0, 0.0, 0.0]))
    model = with_effect(copy.deepcopy(arm), "misalignment", turned).eval().requires_grad_(False)
    moved = replace(recording, key_points_mm=recording.key_points_mm + np.array([5.0, 0.0, 0.0]))
    split = Split.of(identification_problem(model, [moved]), SHORT)
    trained = run_job(split, Job(model, (), None, 3, 0)).model
    before, after = (split.losses(each).sum() for each in (model, trained))
    assert after < 1.2 * before, "5 mm twice are 100 times the squared error"
    assert in_front(["misalignment", "line_lag", "creep"]) == ["line_lag", "creep"]
    assert in_front(["hysteresis#2", "misalignment#2"]) == ["hysteresis#2"]


def test_a_joint_fit_keeps_the_parameters_of_effects_that_it_did_not_train(found):
    def parameter(effect):
        return Parameter(effect, "x", 1.0, 1.0, 1.0, "", True, (0.0, 2.0), "")

    joint = JointFit(None, None, (parameter("line_lag"),), {"line_lag": "a lag"})
    given = [parameter("payload"), parameter("line_lag")]
    whole = joint.beside(given, {"payload": "a load", "line_lag": "another"})
    assert [each.effect for each in whole.parameters] == ["payload", "line_lag"]
    assert whole.in_words == {"payload": "a load", "line_lag": "a lag"}


def test_a_network_that_needs_no_training_stays_as_it_is(problem, lagging, found, monkeypatch):
    """The network of the arm without its lag needs the lag beside it, and no training."""
    clean = fitted_to(arm_by_hand(0.0, rows=900), epochs=60)
    rows = identification_problem(clean, [lagging[0]])
    assert apart_mm(problem, ["line_lag"], SHORT) is None, "fitted to these rows"
    unknown = replace(problem, model=problem.model.replace())
    unknown.model.fitted_rows = None
    apart, imitated = (apart_mm(each, ["line_lag"], SHORT) for each in (rows, unknown))
    assert NOISE_MM < apart < 0.4 * rows.rmse_mm
    assert imitated > 2 * found.of("line_lag").heldout_rmse_mm, "there only a joint fit helps"

    def judged(heldout_mm):
        best = replace(found.of("line_lag"), heldout_rmse_mm=heldout_mm)
        return lambda *given, **options: replace(found, candidates=(best,))

    def joint(*given, **options):
        raise AssertionError("fitted together")

    def known(posed, effects, *given):
        assert posed.model is clean
        assert list(effects) == ["line_lag"]
        return apart

    monkeypatch.setattr(amending, "refit_reason", lambda *given: "the network may imitate it")
    monkeypatch.setattr(amending, "fit_together", joint)
    monkeypatch.setattr(amending, "refit_effects", judged(1.1 * apart))
    monkeypatch.setattr(amending, "apart_mm", known)
    amended = amending.amend(clean, [lagging[0]], "line_lag")
    assert amended.refit is None
    assert amended.claimed
    assert any("it stays as it is" in note for note in amended.notes)
    monkeypatch.setattr(amending, "refit_effects", judged(0.5 * apart))
    with pytest.raises(AssertionError, match="fitted together"):
        amending.amend(clean, [lagging[0]], "line_lag")


@pytest.mark.parametrize("name", ["diagnose", "amend", "improve"])
def test_a_bad_mode_is_one_line_and_code_2(name, tmp_path, capsys):
    more = [] if name == "diagnose" else ["-o", str(tmp_path / "new")]
    more += ["--effect", "creep", "--data", "x.csv"] if name == "amend" else []
    given = ["default"] if name == "amend" else ["default", "x.csv"]
    assert run([name, *given, *more, "--refit", "sometimes"]) == 2
    assert "sometimes" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_what_is_trained_with_a_network_begins_in_front_of_it(problem):
    """Of a creep of the body its form of the body explains most, and only that of loads is trained:
    the other one changes what the network predicts."""
    creep = make_effect("creep", problem.model.facts, body=True)
    with torch.no_grad():
        for amplitude, size in zip(creep.amplitudes().values(), (0.4, 0.2), strict=True):
            amplitude.fill_(size)
    truth = with_effect(problem.model, "creep", creep.requires_grad_(False))
    with torch.no_grad():
        crept = problem.rows(truth.predict(problem.history)).double().numpy()
    posed = replace(problem, measured=crept)
    assert starts(posed, "creep", 1)[0].effects["creep"].stage == "body"
    assert starting_model(posed, ["creep"]).effects["creep"].stage == "material"


def test_what_cannot_be_fitted_together_is_refused(problem, tmp_path, capsys):
    with pytest.raises(InputError, match="behind the network"):
        refit(problem, together=["payload"], config=SHORT)
    save_recording(arm_by_hand(rows=600), tmp_path / "hand.parquet")
    save_model(problem.model, tmp_path / "arm")
    command = ["amend", str(tmp_path / "arm"), "--effect", "line_lag", "--data"]
    command += [str(tmp_path / "hand.parquet"), "-o", str(tmp_path / "new")]
    assert run([*command, "--refit", "always", "--keep-network"]) == 2
    assert "--keep-network" in capsys.readouterr().err
