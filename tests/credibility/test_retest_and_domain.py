"""Agreement of recordings and shares of a scenario, both by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.credibility import retest as retesting
from surgisoft.credibility.context import Scenario
from surgisoft.credibility.domain import States, applicability, percent, rates, states_of
from surgisoft.credibility.retest import Estimate, Repeated, Retest, Told, numbers
from surgisoft.credibility.scenario import scenario_states, stored_episodes
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.checkpoint import default_arm


def repeated(*values: float, half: float = 0.1959964) -> Repeated:
    """Estimates with a standard uncertainty of 0.1."""
    estimates = [Estimate(f"r{i}", v, v - half, v + half) for i, v in enumerate(values)]
    return Repeated("creep", "share", tuple(estimates))


def test_estimates_agree_as_far_as_their_intervals_say():
    """Q = (0.3 / 2)^2 * 2 / 0.1^2 = 4.5 on one degree of freedom; of 0.1 it is 0.5."""
    assert repeated(1.0, 1.3).p_value == pytest.approx(0.033895, rel=1e-3)
    assert repeated(1.0, 1.3).agree is False
    assert repeated(1.0, 1.1).p_value == pytest.approx(0.479500, rel=1e-3)
    assert repeated(1.0, 1.1).agree is True
    assert repeated(1.0).agree is None


def test_a_parameter_is_identifiable_where_its_interval_is_narrow_beside_it():
    assert repeated(0.4, 0.5).identifiable
    assert not repeated(0.5, 0.3).identifiable


def test_diagnoses_agree_by_kind_and_effects():
    def told(kind, *effects):
        return Told("rec", kind, effects, 0.9, "")

    def agree(*diagnoses):
        return Retest(diagnoses, ()).diagnoses_agree

    assert agree(told("several", "creep", "leak"), told("several", "leak", "creep")) is True
    assert agree(told("identified", "creep"), told("identified", "leak")) is False
    assert agree(told("identified", "creep"), told("nothing_missing")) is False
    assert agree(told("identified", "creep"), told("-")) is None
    words = Retest((told("identified", "creep"), told("-")), (repeated(1.0, 1.3),)).sentence
    assert words == (
        "fewer than two recordings allow a diagnosis; 0 of 1 parameters agree within their "
        "intervals; 1 of 1 parameters are identifiable"
    )


def test_numbers_of_nested_lists_have_their_places():
    found = list(numbers([[1.0, 2.0]], [[0.0, 1.0]], [[2.0, 3.0]]))
    assert found == [("[1,1]", 1.0, 0.0, 2.0), ("[1,2]", 2.0, 1.0, 3.0)]
    assert list(numbers(1.0, 0.0, 2.0)) == [("", 1.0, 0.0, 2.0)]


def states(pressure, rate=None, points=None, load=None) -> States:
    pressure = np.array(pressure, float)
    rate = np.full_like(pressure, np.nan) if rate is None else np.array(rate, float)
    return States("s", pressure, rate, points, load)


def test_pressures_are_inside_up_to_a_tenth_of_the_range():
    known = states([[0.0, 0.0], [10.0, 20.0]])
    asked = states([[0.9, 1.9], [1.1, 0.0], [0.0, 2.1], [10.0, 20.0]])
    found = applicability([known], [asked], 70.0)
    assert found.inside.tolist() == [True, False, False, True]
    assert (found.whole, found.rates, found.poses, found.loads) == (0.5, None, None, None)
    assert "rates and poses and loads of the scenario are not known" in found.sentence


def test_each_quantity_can_take_a_state_out():
    rest = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 100.0]])
    known = states([[0.0], [10.0]], [[-1.0], [2.0]], np.stack([rest, rest]), np.array([0.0, 5.0]))
    near, far = rest + np.array([0.0, 4.9, 0.0]), rest.copy()
    far[0, 0] = 5.1
    asked = states(
        [[0.0]] * 5,
        [[2.0], [2.2], [0.0], [0.0], [-2.0]],
        np.stack([near, rest, far, rest, rest]),
        np.array([0.0, 5.0, 1.0, 5.6, 2.0]),
    )
    found = applicability([known], [asked], 100.0)
    assert found.inside.tolist() == [True, False, False, False, True]
    assert (found.pressures, found.rates, found.poses, found.loads) == (1.0, 0.8, 0.8, 0.8)
    assert found.whole == pytest.approx(0.4)


def test_a_rate_counts_whichever_way_it_goes():
    """Fastest in emptying: 8 units a second; filling may be as fast, but for a twentieth."""
    known = states([[0.0], [10.0]], [[2.0], [-8.0]])
    found = applicability([known], [states([[0.0]] * 3, [[8.3], [8.5], [-8.3]])], 70.0)
    assert found.inside.tolist() == [True, False, True]


def test_each_channel_has_a_range_and_a_fastest_rate_of_its_own():
    """The ranges are those that were measured, however small or wide those asked about are."""
    known = states([[0.0, 0.0], [10.0, 100.0]], [[1.0, 10.0], [-1.0, 10.0]])
    asked = states([[0.9, 9.0], [1.1, 0.0]], [[1.0, 10.0], [0.0, 0.0]])
    assert applicability([known], [asked], 70.0).inside.tolist() == [True, False]
    wide = states([[1.1, 0.0], [500.0, 0.0]], [[0.0, 0.0]] * 2)
    assert not applicability([known], [wide], 70.0).inside.any()
    fast = states([[0.0, 0.0]] * 2, [[2.0, 0.0], [0.0, 9.0]])
    assert applicability([known], [fast], 70.0).inside.tolist() == [False, True]


def test_what_is_not_known_of_a_state_does_not_count():
    """Shares are of the states of which a quantity is known; the others are not outside by it."""
    rest = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 100.0]])
    loads = np.array([0.0, np.nan])
    known = states([[0.0], [10.0]], [[2.0], [np.nan]], np.stack([rest, rest + np.nan]), loads)
    points = np.stack([rest, rest + 50.0, rest + np.nan, rest])
    points[3, 0] = np.nan
    load = np.array([np.nan, 0.0, 9.0, np.nan])
    asked = states([[0.0]] * 4, [[np.nan], [2.0], [9.0], [np.nan]], points, load)
    found = applicability([known], [asked], 100.0)
    assert (found.pressures, found.rates, found.poses, found.loads) == (1.0, 0.5, 0.5, 0.5)
    assert found.inside.tolist() == [True, False, False, True]


def test_a_pose_is_that_of_one_row():
    """Each key point was where it is, but never both of them at once."""
    one = np.array([[0.0, 0.0, 50.0], [0.0, 0.0, 100.0]])
    other = one + np.array([30.0, 0.0, 0.0])
    known = states([[0.0], [10.0]], None, np.stack([one, other]))
    mixed = np.stack([np.stack([one[0], other[1]]), other])
    found = applicability([known], [states([[0.0]] * 2, None, mixed)], 100.0)
    assert found.inside.tolist() == [False, True]


def test_the_jump_from_one_run_to_the_next_is_no_rate():
    """Each run rises by 1 kPa/s; the second begins 40 kPa higher."""
    t_s = 0.1 * np.arange(40)
    run = np.repeat([0, 1], 20)
    pressure = (t_s + 40.0 * run)[:, None]
    found = states_of(Recording("r", t_s, pressure, np.zeros((40, 1, 3)), run=run))
    np.testing.assert_allclose(found.rate, 1.0)


@pytest.mark.parametrize(
    ("kind", "fitted"),
    [
        ("identified", ["hysteresis", "creep"]),
        ("several", ["hysteresis", "creep"]),
        ("ambiguous", ["hysteresis"]),
        ("nothing_missing", ["hysteresis"]),
    ],
)
def test_the_effects_of_the_model_and_those_named_are_fitted_to_each(monkeypatch, kind, fitted):
    """One of those that an ambiguous verdict names is not there: it is not fitted."""
    asked = []
    verdict = SimpleNamespace(kind=kind, effects=("creep",), confidence=0.9, sentence="")
    whole = SimpleNamespace(verdict=verdict)
    monkeypatch.setattr(retesting, "diagnose", lambda *given, **more: whole)
    monkeypatch.setattr(retesting, "identification_problem", lambda model, some: some)
    monkeypatch.setattr(
        retesting,
        "fit_effects",
        lambda some, effects: (
            asked.append((some[0].name, effects)) or SimpleNamespace(parameters=())
        ),
    )
    model = SimpleNamespace(effects={"hysteresis": None}, takes_effects=True)
    found = retesting.retest(model, [SimpleNamespace(name=name) for name in "ab"], whole)
    assert asked == [("a", fitted), ("b", fitted)]
    assert [each.recording for each in found.diagnoses] == ["a", "b"]


def test_rates_are_taken_over_half_a_second():
    t_s = 0.1 * np.arange(21)
    assert np.allclose(rates(t_s, 3.0 * t_s[:, None]), 3.0)
    step = np.where(t_s < 0.95, 0.0, 1.0)[:, None]
    assert rates(t_s, step).max() == pytest.approx(1.0 / 0.5, rel=0.01)


def test_only_what_is_whole_is_100_percent():
    assert [percent(v) for v in (0.0, 1.0, 0.9999, 0.00001, 0.173)] == [
        "0 %",
        "100 %",
        "99.9 %",
        "0.1 %",
        "17.3 %",
    ]


def schedule(folder, chambers: int):
    """A ramp of every chamber from 0 to 10 kPa within 2 s, and a rest of 1 s."""
    names = ",".join(f"c{k + 1}_kPa" for k in range(chambers))
    rows = [f"{t}," + ",".join([str(p)] * chambers) for t, p in ((0, 0), (1, 5), (2, 10), (3, 10))]
    path = folder / f"ramp{chambers}.csv"
    path.write_text("\n".join([f"t_s,{names}", *rows]) + "\n")
    return str(path)


def test_a_schedule_is_states_with_rates_and_the_loads_in_turn(tmp_path):
    spec = default_arm().spec
    (found,) = scenario_states(Scenario((schedule(tmp_path, 3),), (0.0, 50.0)), spec, {})
    assert found.label == "ramp3"
    np.testing.assert_allclose(found.pressure[:, 0], [0.0, 5.0, 10.0, 10.0])
    assert np.abs(found.rate).max() == pytest.approx(5.0)
    assert found.load_g.tolist() == [0.0, 50.0, 0.0, 50.0]
    (plain,) = scenario_states(Scenario((schedule(tmp_path, 3),)), spec, {})
    assert plain.load_g is None
    with pytest.raises(InputError, match="ramp2 has 2 channels, expected 3 as the model has"):
        scenario_states(Scenario((schedule(tmp_path, 2),)), spec, {})


def test_what_a_killed_experiment_left_behind_is_no_episode(tmp_path):
    """A file whose writing was killed is hidden; alone it is none, and the message says so."""
    logs = tmp_path / "results" / "logs"
    logs.mkdir(parents=True)
    (logs / ".simulation-0000.0123456789ab.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="the results hold no stored episode"):
        stored_episodes(Scenario((str(tmp_path / "results"),)))
