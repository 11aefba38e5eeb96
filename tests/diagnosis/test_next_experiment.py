"""The recommended experiment: runs on the rig, stays in range, and tells rivals apart."""

import json
from dataclasses import asdict, replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.diagnosis.design import next_experiment as designing
from surgisoft.diagnosis.design.isolability import Isolability, isolability
from surgisoft.diagnosis.design.next_experiment import (
    Experiment,
    Pair,
    Plan,
    Recommendation,
    likely_competing,
    make_plans,
    pose_question,
    propose,
    recommend,
)
from surgisoft.diagnosis.design.schedules import (
    AS_IT_STANDS,
    RUN_S,
    SETUPS,
    bench_minutes,
    draw_run,
    limits_within,
    on_the_rig,
    schedule,
    schedule_text,
    words_for,
)
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.errors import InputError
from surgisoft.measurement.protocols import SIGNALS, Protocol, load_schedule, make_protocol
from surgisoft.measurement.recordings import save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm
from tests.diagnosis.setup.recordings import measured


@pytest.fixture(scope="module")
def arm():
    return default_arm()


@pytest.fixture(scope="module")
def lagging():
    """Two minutes of an arm with a hidden line lag."""
    rig = VirtualRig(0, take=3, hidden=[("line_lag", 1.0)])
    return rig.record(make_protocol("mixed", rig.limits, 900, seed=1))[0]


@pytest.fixture(scope="module")
def problem(arm, lagging):
    return problem_of(arm, [lagging])


@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize(
    "limits", [[[-15.0, 54.0]] * 3, [[0.0, 1.0]], [[-90.0, 90.0]] * 6, [[2.0, 9.0], [0.0, 30.0]]]
)
def test_every_figure_stays_in_range_and_lasts_its_time(name, limits):
    limits = np.array(limits)
    times, rows = draw_run(name, limits, seed=4)
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(RUN_S)
    assert (np.diff(times) > 0).all()
    assert (rows >= limits[:, 0] - 1e-12).all()
    assert (rows <= limits[:, 1] + 1e-12).all()
    assert np.ptp(rows, axis=0).max() > 0.15 * np.ptp(limits, axis=1).max()
    again = draw_run(name, limits, seed=4)
    np.testing.assert_array_equal(rows, again[1])


def test_every_run_has_its_rest():
    """Runs of two minutes, half a minute of rest before each."""
    assert [bench_minutes(runs) for runs in (1, 2, 4)] == [2.5, 5.0, 10.0]


def test_commands_keep_clear_of_the_ends_of_the_arms_range(arm):
    limits = limits_within(arm.spec.low, arm.spec.high)
    assert (limits[:, 0] > np.array(arm.spec.low)).all()
    assert (limits[:, 1] < np.array(arm.spec.high)).all()
    assert (limits_within([0.0], [10.0]) == [[0.0, 9.8]]).all()  # rest stays inside


def test_a_schedule_is_read_back_as_it_was_written(tmp_path):
    protocol = schedule("x", [("steps", 0), ("steps", 1)], np.array([[-15.0, 54.0]] * 3), "kPa")
    path = tmp_path / "x.csv"
    path.write_text(schedule_text(protocol))
    back = load_schedule(path)
    np.testing.assert_allclose(back.commands, protocol.commands, atol=1e-4)
    np.testing.assert_allclose(back.t_s, protocol.t_s, atol=1e-3)
    assert (back.run == protocol.run).all()
    assert back.unit == "kPa"
    assert not np.array_equal(back.commands[back.run == 0], back.commands[back.run == 1])


def test_turned_benches_have_the_rigs_own_gravity():
    weight = np.array([0.42, 0.1, 0.9])
    weight /= np.linalg.norm(weight)
    for name, setting in SETUPS.items():
        if setting.roll_deg:
            truth = VirtualRig(0, gravity=weight, roll_deg=setting.roll_deg).gravity
            np.testing.assert_allclose(setting.gravity(weight), truth, atol=1e-12)
            assert setting.rig_options(weight) == {"roll_deg": setting.roll_deg}, name
    np.testing.assert_allclose(SETUPS["upside_down"].gravity(weight), -weight)
    asked = SETUPS["upside_down"].rig_options(weight)["gravity"]
    np.testing.assert_allclose(asked, -weight, atol=1e-4)


def test_the_recommended_schedule_runs_on_the_rig(arm):
    answer = propose(arm, ["creep", "line_lag"], minutes=5.0)
    rig = VirtualRig(0)
    recording, _ = rig.record(answer.protocol)
    assert recording.t_s[-1] / 60 <= answer.minutes <= 5.0
    assert len(recording.runs) == len(answer.protocol.run_rows)
    assert answer.separates == (("creep", "line_lag"),)
    assert answer.experiment.minutes == answer.minutes


def test_the_plan_tells_more_than_any_one_of_other_schedules(arm):
    """Against the isolability of schedules that were not chosen, as long as the plan."""
    limits = limits_within(arm.spec.low, arm.spec.high)
    names = ["hysteresis", "line_lag"]
    plan = make_plans(pose_question(arm, None, names), limits, 5.0, (AS_IT_STANDS,))[0]
    for figure in ("ramps", "wander", "reversals"):
        if set(plan.figures) != {figure}:
            twice = schedule("x", [(figure, 0), (figure, 1)], limits, "kPa")
            assert plan.worst >= isolability(arm, twice, names, rows=300).pair(*names) - 0.02


def test_rivals_of_a_lag_are_found_and_a_change_of_the_bench_settles_them(problem):
    rivals = likely_competing(problem)
    assert rivals[0] in ("line_lag", "rate_dependence")
    assert len(rivals) >= 2
    answer = recommend(problem, ["line_lag", "rate_dependence"], 8.0)
    pair = answer.pairs[0]
    assert pair.before < 0.95 < pair.after
    assert answer.setting == "short_tube"
    assert answer.by_hand
    assert not recommend(problem, ["line_lag", "rate_dependence"], 5.0, on_the_rig()).by_hand
    assert answer.minutes <= 8.0
    assert any("tube" in step for step in answer.steps)
    left = recommend(problem, ["line_lag", "rate_dependence"], 8.0, (AS_IT_STANDS,))
    assert left.setting == AS_IT_STANDS
    assert left.pairs[0].after < pair.after


@pytest.fixture(scope="module")
def whole_share(problem):
    """Share of the lag where every key point was measured."""
    return lag_share(problem)


def lag_share(problem) -> float:
    """Share of a line lag that recordings show, beside creep."""
    question = pose_question(problem.model, problem, ["line_lag", "creep"])
    (place,) = (k for k, j in enumerate(question.draws.form) if question.owners[j] == "line_lag")
    return float(np.abs(question.draws.amplitudes[:, place]).max())


def test_a_key_point_that_was_never_measured_says_nothing(arm, lagging, whole_share):
    """Not that it stood where the model predicts it: the lag is as strong as without that point."""
    points = lagging.key_points_mm.copy()
    points[:, -1] = np.nan
    shown = lag_share(problem_of(arm, [replace(lagging, key_points_mm=points)]))
    assert shown == pytest.approx(whole_share, rel=0.07)


def test_cameras_may_see_one_key_point_in_one_row_and_another_in_the_next(
    arm, lagging, whole_share
):
    """No row has all key points: each counts where it was measured."""
    points = lagging.key_points_mm.copy()
    points[::2, ::2] = points[1::2, 1::2] = np.nan
    shown = lag_share(problem_of(arm, [replace(lagging, key_points_mm=points)]))
    assert shown == pytest.approx(whole_share, rel=0.1)


def test_a_recording_that_shows_no_effect_speaks_against_each_of_them(arm):
    """Its evidence is below 0, and amplitudes are then not taken from it: several may be true."""
    question = pose_question(arm, problem_of(arm, [measured(1200)]), ["line_lag", "creep"])
    assert (question.gains < 0).all()
    assert len(question.draws.form) > 4


def test_an_experiment_has_two_runs_however_sure_one_is(arm):
    limits = limits_within(arm.spec.low, arm.spec.high)
    question = pose_question(arm, None, ["misalignment", "line_lag"])
    (plan,) = make_plans(question, limits, 15.0, (AS_IT_STANDS,))
    assert len(plan.figures) == 2
    assert plan.minutes == bench_minutes(2)


def lead(problem, true: str, rival: str) -> float:
    """Log evidence of one effect over another in recordings, each in its best shape, nats."""
    question = pose_question(problem.model, problem, [true, rival])
    gain = dict.fromkeys((true, rival), -np.inf)
    for owner, value in zip(question.owners, question.gains, strict=True):
        gain[owner] = max(gain[owner], value)
    return gain[true] - gain[rival]


def test_the_recommended_schedule_settles_on_the_rig_what_one_speed_leaves_open(arm):
    """The rig's friction and lag are written with other formulas than the models' effects."""
    commands = np.zeros((9, 3))
    commands[1::2, 0] = 50.0
    poor = Protocol("sweeps", "continuous", commands, np.zeros(9), 8.0 * np.arange(9.0))
    for true, rival in (("hysteresis", "line_lag"), ("line_lag", "hysteresis")):
        first, _ = VirtualRig(0, take=1, hidden=[(true, 1.0)]).record(poor)
        problem = problem_of(arm, [first])
        answer = recommend(problem, [true, rival], 5.0, (AS_IT_STANDS,))
        assert answer.pairs[0].before < 0.95
        second, _ = VirtualRig(0, take=2, hidden=[(true, 1.0)]).record(answer.protocol)
        assert lead(problem_of(arm, [first, second]), true, rival) > 30.0 + abs(
            lead(problem, true, rival)
        )


def test_more_time_never_tells_less(arm):
    rivals = ["line_lag", "rate_dependence"]
    chances = [
        propose(arm, rivals, minutes, (AS_IT_STANDS,)).pairs[0].after for minutes in (5.0, 10.0)
    ]
    assert chances[0] <= chances[1] + 0.02


def test_where_gravity_is_not_known_no_bench_is_turned(arm):

    spec = replace(arm.spec, gravity=None)
    free = arm.replace(spec=spec)
    limits = limits_within(spec.low, spec.high)
    question = pose_question(free, None, ["payload", "gain_mismatch"])
    plans = make_plans(question, limits, 8.0, tuple(SETUPS))
    assert {plan.setting for plan in plans} == {AS_IT_STANDS, "bare_tip"}


def test_no_chamber_leaves_what_was_recorded_of_it(arm, lagging):
    """Chamber 2 stood at 3 kPa and chamber 3 moved by 2 kPa, whatever the model's scale is."""

    spec = replace(arm.spec, idle=(None, 3.0, None))
    shy = arm.replace(spec=spec)
    measured = lagging.measured.copy()
    measured[:, 2] = 5.0 + 2.0 * (measured[:, 2] - measured[:, 2].min()) / np.ptp(measured[:, 2])
    still = replace(lagging, measured=measured)
    answer = recommend(problem_of(shy, [still]), ["creep", "line_lag"], minutes=5.0)
    rows = answer.protocol.commands
    assert np.ptp(rows[:, 0]) > 10.0
    np.testing.assert_allclose(rows[:, 1], 3.0)
    assert rows[:, 2].min() >= 5.0 - 1e-5
    assert rows[:, 2].max() <= 7.0 + 1e-5


@pytest.mark.parametrize(
    ("rivals", "minutes", "said"),
    [
        (["creep"], 15.0, "at least two different effects"),
        (["creep", "creep"], 15.0, "at least two different effects"),
        (["creep", "drft"], 15.0, "unknown effect 'drft'"),
        (["creep", "drift"], 4.0, f"at least {bench_minutes(2):g}"),
        (["creep", "drift"], float("nan"), "too short"),
    ],
)
def test_bad_questions_are_told_in_one_line(arm, rivals, minutes, said):
    with pytest.raises(InputError, match=said) as caught:
        propose(arm, rivals, minutes)
    assert "\n" not in str(caught.value)


def test_of_many_pairs_the_least_certain_are_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    effects = ["creep", "line_lag", "payload", "twist", "misalignment", "gain_mismatch"]
    command = ["next-experiment", "default", "--minutes", "6", "--json", "s.json"]
    assert run([*command, "--between", *effects]) == 0
    lines = capsys.readouterr().out.splitlines()
    chances = sorted(pair["after"] for pair in json.loads(Path("s.json").read_text())["pairs"])
    assert len(chances) == 15
    printed = [float(line.split()[-1]) for line in lines if "expected chance" in line]
    assert len(printed) >= 10
    np.testing.assert_allclose(printed, chances[: len(printed)], atol=0.005)
    assert all(chance >= 0.95 for chance in chances[len(printed) :])
    rest = [line for line in lines if "further pairs" in line]
    assert len(rest) == (len(printed) < 15)
    if rest:
        assert rest[0].startswith(f"  {15 - len(printed)} further pairs: ")


def test_the_command_writes_a_schedule_or_nothing(tmp_path, lagging, capsys):
    model = str(files("surgisoft") / "assets" / "default_arm")
    data, out, numbers = (tmp_path / name for name in ("r.parquet", "s.csv", "s.json"))
    save_recording(lagging, data)
    between = ["--between", "line_lag", "hysteresis"]
    bad = [
        ([model, "-o", str(tmp_path / "s.txt")], "expected .csv"),
        ([str(tmp_path / "none"), "-o", str(out)], "no arm model there"),
        ([model, "-o", str(out), "--between", "creep"], "at least two"),
        ([model, "-o", str(out), "--between", "creep,play"], "unknown effect 'play'"),
        ([model, "-o", str(out), "--minutes", "0.5"], "--minutes 0.5: too short"),
        ([model, str(tmp_path / "x.csv"), "-o", str(out)], "x.csv"),
    ]
    for arguments, said in bad:
        assert run(["next-experiment", *arguments]) == 2
        message = capsys.readouterr().err
        assert said in message
        assert message.count("\n") == 1
        assert not out.exists()
    arguments = ["next-experiment", model, str(data), "-o", str(out), "--json", str(numbers)]
    arguments += ["--minutes", "6"]
    assert run([*arguments, *between]) == 0
    printed = capsys.readouterr().out
    assert f"surgisoft collect {out}" in printed
    content = json.loads(numbers.read_text())
    assert content["minutes"] <= 6
    assert content["pairs"][0]["effects"] == ["line_lag", "hysteresis"]
    assert load_schedule(out).chambers == 3
    commas = [*arguments, "--force", "--between", "line_lag,hysteresis"]
    assert run(commas) == 0
    assert capsys.readouterr().out == printed
    assert run([*arguments, *between]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("unit", "said"),
    [("psi", "vented arm"), ("deg", "slack arm"), ("V", "relaxed arm")],
)
def test_a_bench_is_spoken_of_in_its_own_words(arm, unit, said):
    spec = replace(arm.spec, unit=unit)
    other = arm.replace(spec=spec)
    answer = propose(other, ["line_lag", "creep"], minutes=6.0, settings=(AS_IT_STANDS,))
    assert f"each from a {said}" in answer.steps[-1]
    assert answer.protocol.unit == unit


def test_every_word_of_the_catalogue_is_filled_in():
    for unit in ("kPa", "deg", "V"):
        words = asdict(words_for(unit))
        for thing in (*SETUPS.values(), *SIGNALS.values()):
            assert "{" not in thing.about.format(**words)
        if unit != "kPa":
            texts = " ".join(thing.about.format(**words) for thing in SETUPS.values())
            assert not {"valve", "valves", "vented", "chamber", "tubes"} & set(texts.split())


def test_after_a_change_by_hand_the_new_recording_is_diagnosed_alone(tmp_path, lagging, capsys):
    model = str(files("surgisoft") / "assets" / "default_arm")
    data, out = tmp_path / "r.parquet", tmp_path / "s.csv"
    save_recording(lagging, data)
    numbers = tmp_path / "s.json"
    arguments = ["next-experiment", model, str(data), "-o", str(out), "--json", str(numbers)]
    arguments += ["--minutes", "6"]
    assert run([*arguments, "--between", "line_lag", "rate_dependence"]) == 0
    printed = capsys.readouterr().out
    alone = f"then: surgisoft diagnose {model} NEW.parquet" in printed
    together = f"then: surgisoft diagnose {model} {data} NEW.parquet" in printed
    by_hand = json.loads(numbers.read_text())["by_hand"]
    assert (alone, together) == (by_hand, not by_hand)


@pytest.mark.parametrize(("before", "told"), [(0.6, False), (0.99, True)])
def test_an_experiment_that_is_not_needed_says_what_else_may_be_the_matter(before, told):
    pair = Pair(("payload", "line_lag"), before, 0.99)
    found = Recommendation(
        "steps", Protocol("p", "settled", [[0.0]], [0]), "bench", 5.0, (pair,), ()
    )
    assert f"goes from {before:.2f} to 0.99" in found.why
    assert ("both may be missing" in found.why) == told


@pytest.mark.parametrize(
    ("validated_mm", "said"),
    [
        (
            0.0523,
            "the noise of the cameras, 2 times the validated error of the model (0.052 mm)",
        ),
        (
            None,
            "2 times an error of the model of 5 % of its length and the misfit of the effects",
        ),
    ],
)
def test_a_chance_says_what_it_counts(validated_mm, said):
    found = Recommendation(
        "steps",
        Protocol("p", "settled", [[0.0]], [0]),
        AS_IT_STANDS,
        5.0,
        (Pair(("payload", "line_lag"), 0.6, 0.99),),
        (),
        validated_mm=validated_mm,
    )
    assert said in found.chances_in_words
    assert "but not for other causes: 'surgisoft diagnose' weighs those too" in (
        found.chances_in_words
    )
    assert found.to_json()["chances_in_words"] == found.chances_in_words


def test_the_chance_falls_with_the_validated_error_that_is_stated(arm):
    """And the recommendation states the error of the model, by which it was computed."""
    rough = arm.replace(
        validation=replace(
            arm.validation,
            rmse_mm=10.0 * arm.validation.rmse_mm,
            per_key_point_mm=tuple(10.0 * mm for mm in arm.validation.per_key_point_mm),
        )
    )
    fine, crude = (
        propose(each, ["twist", "coupling"], 5.5, (AS_IT_STANDS,)) for each in (arm, rough)
    )
    assert crude.validated_mm == pytest.approx(10.0 * fine.validated_mm)
    assert crude.pairs[0].after < fine.pairs[0].after


def planned(setting, minutes, chances):
    """A plan with the chance of each of the three pairs of creep, line_lag and drift."""
    names = ("creep", "line_lag", "drift")
    confidence = np.full((3, 3), 0.5)
    for (a, b), chance in zip(((0, 1), (0, 2), (1, 2)), chances, strict=True):
        confidence[a, b], confidence[b, a] = chance, 0.999
    zero = np.zeros((3, 3))
    found = Isolability(names, np.zeros(3), zero, zero, zero, confidence, np.ones(3), minutes)
    return Plan(setting, ("ramps", "wander"), minutes, 0.0, found)


@pytest.mark.parametrize(
    ("plans", "chosen"),
    [
        ([(10.0, 0.992), (6.0, 0.991), (12.0, 0.994)], 1),
        ([(10.0, 0.97), (6.0, 0.95), (12.0, 0.96)], 0),
        ([(10.0, 0.97), (6.0, 0.95), (14.0, 0.991)], 2),
    ],
)
def test_the_shortest_of_sure_plans_is_recommended_or_else_the_surest(
    arm, monkeypatch, plans, chosen
):
    """Sure is a plan with 0.99 for its least certain pair."""
    settings = [AS_IT_STANDS, "short_tube", "bare_tip"]
    made = [
        planned(setting, minutes, (0.995, worst, 0.999))
        for setting, (minutes, worst) in zip(settings, plans, strict=True)
    ]
    assert [plan.worst for plan in made] == pytest.approx([worst for _, worst in plans])
    monkeypatch.setattr(
        designing, "pose_question", lambda *given: SimpleNamespace(model=arm, known=None)
    )
    monkeypatch.setattr(designing, "make_plans", lambda *given: made)
    found = propose(arm, ["creep", "line_lag", "drift"])
    assert (found.setting, found.minutes) == (settings[chosen], plans[chosen][0])
    told = {pair.effects: pair.after for pair in found.pairs}
    assert told[("creep", "drift")] == pytest.approx(plans[chosen][1])
    assert {pair.before for pair in found.pairs} == {0.5}


def test_an_experiment_separates_pairs_that_it_makes_sure():
    pairs = (Pair(("a", "b"), 0.6, 0.951), Pair(("a", "c"), 0.6, 0.949), Pair(("b", "c"), 0.7, 0.7))
    found = Recommendation("x", Protocol("p", "settled", [[0.0]], [0]), "bench", 5.0, pairs, ())
    assert found.separates == (("a", "b"),)
    assert found.experiment.separates == (("a", "b"),)
    assert "the chance to tell a from b goes from 0.60 to 0.95; 1 of 3 pairs" in found.why


@pytest.mark.parametrize(
    ("gains", "rivals"),
    [
        ({"a": 10.0, "b": 4.9, "c": 5.1, "d": 6.0}, ["a", "d", "c"]),
        ({"a": 10.0, "b": 4.0, "c": 2.0}, ["a", "b"]),
        ({"a": 6.0, "b": 7.0, "c": 8.0, "d": 9.0, "e": 10.0}, ["e", "d", "c", "b"]),
    ],
)
def test_effects_compete_from_half_of_the_evidence_of_the_best_on(monkeypatch, gains, rivals):
    """Each by its best form; at least two, at most four."""
    owners = [name for name in gains for _ in range(2)]
    values = [value - less for value in gains.values() for less in (0.0, 3.0)]
    posed = SimpleNamespace(owners=owners, gains=np.array(values))
    monkeypatch.setattr(designing, "pose_question", lambda *given, **more: posed)
    assert likely_competing(SimpleNamespace(model=None)) == rivals


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        (
            (("creep", "leak"), ("creep", "drift")),
            "distinguishes creep from leak, creep from drift",
        ),
        ((), "is not sure to distinguish any two of the competing effects"),
    ],
)
def test_an_experiment_says_what_it_distinguishes(pairs, said):
    assert said in Experiment("ramps", 5.0, pairs).in_words
