"""From diagnosis to policy, small: what is kept and recorded, and what the page states."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from benchmarks.cache import Cache, digest, model_digest
from benchmarks.control import policies as control_policies
from benchmarks.hidden_effect import policies as hidden_effect_policies
from benchmarks.hidden_effect import study as hidden_effect
from benchmarks.hidden_effect.rates import trails_s
from benchmarks.hidden_effect.rigs import Bench, circles
from benchmarks.hidden_effect.study import MODELS, Outcome, StudyConfig, run, worse
from benchmarks.hidden_effect.table import draw, markdown
from surgisoft.agents.on_rig import RigConfig
from surgisoft.cli import run as run_command
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import load_recording
from surgisoft.progress import Stages
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.tasks.registry import config_of, with_fields
from tests.few_effects import few_effects

SMALL = StudyConfig(steps=3072, episodes=2, samples=1600)


def nothing(done, total, note=""):
    pass


def test_a_result_is_made_once_for_each_origin(tmp_path):
    made = []

    def make(value):
        made.append(value)
        return {"value": value}

    kept = Cache(tmp_path)
    for _ in range(2):
        assert kept.values("a/b", {"x": 1}, lambda: make(1)) == {"value": 1}
        assert Cache(tmp_path).values("a/b", {"x": 2}, lambda: make(2)) == {"value": 2}
    assert made == [1, 2]


def test_a_result_that_fails_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError):
        Cache(tmp_path).values("a/b", {}, lambda: 1 / 0)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_digests_know_order_free_content_and_weights(tmp_path):
    assert digest({"a": 1, "b": [2]}) == digest({"b": [2], "a": 1}) != digest({"a": 1, "b": [3]})
    model = default_arm()
    save_model(model, tmp_path / "one", {"note": "a report is not the model"})
    save_model(model, tmp_path / "two")
    with torch.no_grad():
        next(model.network.parameters()).add_(1e-6)
    save_model(model, tmp_path / "three")
    one, two, three = (model_digest(tmp_path / name) for name in ("one", "two", "three"))
    assert one == two != three


def test_the_bar_runs_through_stages_without_going_back():
    seen = []
    meter = Stages(lambda done, total, note: seen.append((done, total, note)), 30.0)
    first = meter.stage(10, "a")
    first(1, 2, "half")
    second = meter.stage(20, "b")
    second(3, 4)
    assert [done for done, _, _ in seen] == [0.0, 5.0, 10.0, 25.0]
    assert seen[1][2] == "a: half"
    assert seen[-1][1:] == (30.0, "b")


def test_a_changed_bench_is_the_rig_with_that_change(tmp_path):
    bench = Bench(Cache(tmp_path), 3, (("creep", 1.0),), 400)
    protocol = make_protocol("mixed", VirtualRig(3).limits, 400, seed=5)
    came = bench.record(protocol, 7, "known_mass")
    expected, _ = VirtualRig(3, payload_g=2.0, take=7, hidden=[("creep", 1.0)]).record(protocol)
    np.testing.assert_allclose(came.key_points_mm, expected.key_points_mm, atol=1e-6)
    assert len(list(tmp_path.rglob("*.parquet"))) == 1
    again = bench.record(protocol, 7, "known_mass")
    np.testing.assert_array_equal(again.key_points_mm, came.key_points_mm)
    free = replace(bench, hidden=()).record(protocol, 7, "known_mass")
    assert len(list(tmp_path.rglob("*.parquet"))) == 2
    assert np.nanmax(np.abs(free.key_points_mm - came.key_points_mm)) > 0.1


def brief(patch):
    """Let a study look without cameras, in one recording, and in circles of a fifth of the time,
    and let rigs stand for an eighth of the time at each pressure before an episode."""
    patch.setattr(hidden_effect_policies, "SIGHTS", ("blind",))
    patch.setattr(hidden_effect_policies, "RigConfig", partial(RigConfig, settle_s=0.5))
    patch.setattr(hidden_effect, "ORACLE_TAKES", 1)
    patch.setattr(
        control_policies, "config_of", lambda task: with_fields(config_of(task), loop_s=4.0)
    )


@pytest.fixture(scope="module")
def payload(tmp_path_factory):
    """The outcome of a payload with policies that hardly learned anything, and its folder."""
    folder = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as patch, few_effects("payload", "creep", "misalignment"):
        brief(patch)
        yield run(["payload"], SMALL, folder, nothing)[0], folder


def test_the_model_with_the_named_effect_is_better_where_nothing_was_fitted(payload):
    outcome, folder = payload
    assert "payload" in outcome.amended
    error = outcome.model_mm
    assert error["floor"] < error["after"] < 0.6 * error["before"]
    assert error["oracle"] < 0.6 * error["before"]
    # The judging recording against the rig's own truth without noise: an independent floor.
    judged = list((folder / "recordings").glob("*.parquet"))
    assert len(judged) == 2
    noise = load_recording(judged[0]).noise_mm
    assert error["floor"] == pytest.approx(noise * 3**0.5, rel=0.3)


def test_the_script_tracks_the_hidden_payload_better_with_the_amended_model(payload):
    driven = payload[0].driven
    before, after = (driven[f"{key}/scripted/blind"]["mean"] for key in ("before", "after"))
    assert after < 0.6 * before
    assert driven["before/random/blind"]["mean"] > 3.0
    assert set(payload[0].training) == set(MODELS)


def test_a_study_that_was_done_is_not_done_again(payload, monkeypatch):
    outcome, folder = payload
    brief(monkeypatch)
    for name in ("diagnose", "amend", "fit", "fall_of"):
        monkeypatch.setattr(hidden_effect, name, lambda *_, name=name: pytest.fail(name))
    monkeypatch.setattr(hidden_effect_policies, "evaluated", lambda *_: pytest.fail("evaluated"))
    assert run(["payload"], SMALL, folder, nothing) == [outcome]


def test_circles_go_round_at_the_pace_of_the_task():
    limits = VirtualRig(0).limits
    protocol = circles(7200, limits, 1)
    t, p = protocol.t_s.reshape(3, -1), protocol.commands.reshape(3, 240, 3)
    assert t[0, -1] == pytest.approx(120.0, abs=1.0)
    late = t[0] >= 20.0
    np.testing.assert_allclose(p[:, late][:, 40:], p[:, late][:, :-40], atol=1e-9)  # 20 s
    mean = p[:, late].mean(2)
    np.testing.assert_allclose(mean, mean[:, :1].repeat(mean.shape[1], 1), atol=1e-9)
    assert (p >= limits[:, 0]).all()
    assert (p <= limits[:, 1]).all()
    assert np.abs(np.diff(p[:, late], axis=1)).max() / 0.5 < 6.0  # kPa/s: slow motion


def test_a_trailing_arm_is_distinguished_from_one_that_runs_ahead():
    t = np.linspace(0.0, 6.0, 600)
    points = np.stack([np.sin(t), np.cos(t), 0 * t], 1)[:, None]
    velocity = np.stack([np.cos(t), -np.sin(t), 0 * t], 1)[:, None]
    for shift in (0.05, -0.02):
        later = np.stack([np.sin(t - shift), np.cos(t - shift), 0 * t], 1)[:, None]
        residual = later - points
        residual[5] = np.nan
        assert trails_s(residual, velocity) == pytest.approx(shift, rel=1e-3)


def _summary(mean, half):
    return {"mean": mean, "low": mean - half, "high": mean + half}


def _outcome(name: str, after: float, kind: str = "identified") -> Outcome:
    """A made-up outcome: the policy before is at 1.0 +- 0.1 mm."""
    policy = {"before": 1.0, "after": after, "oracle": 0.2}
    driven = {
        f"{key}/{policy}/{sight}": _summary(value, 0.1)
        for key, value in policy.items()
        for policy in ("learned", "scripted", "random")
        for sight in ("blind", "cameras")
    }
    verdict = {"kind": kind, "effects": [name], "sentence": f"{name} is missing"}
    said = {"verdict": verdict, "ranking": [{"confidence": 0.97}]}
    plan = {"name": "steps", "minutes": 5, "separates": [["creep", "drift"]]}
    known = {"effect": name, "name": "tau_s", "value": 0.156, "unit": "s", "ci95": [0.14, 0.173]}
    band = {"low": 1, "high": 3, "rows": 9}
    band |= {key: {"trails_s": 0.1, "rmse_mm": 0.2} for key in MODELS}
    paced = {"claim": "a fall", "parameters": [known], "mixed_mm": 0.31}
    paced["driven"] = {f"{who}/blind": _summary(0.12, 0.01) for who in ("learned", "scripted")}
    fall = {"fall": 0.3, "ci95": [0.2, 0.4]}
    return Outcome(
        name, (said, said), plan, (name,), (known,), "error 0.5 to 0.2 mm",
        {"before": 0.5, "after": 0.2, "oracle": 0.1, "floor": 0.07},
        {"after": fall, "oracle": fall}, (band,), paced if worse(driven) else None, driven,
        {key: {"steps": 10, "wall_s": 4.0, "cpu_s": 2.0} for key in MODELS},
    )  # fmt: skip


def test_the_tables_tell_help_from_chance_and_harm():
    some = [_outcome("creep", 0.5), _outcome("payload", 0.95), _outcome("line_lag", 1.5)]
    text = markdown(some, StudyConfig())
    assert "| creep | identified: creep (0.97) -> identified: creep (0.97) | creep |" in text
    assert "| 0.300 (0.200 to 0.400) | 75 % |" in text  # (0.5 - 0.2) / (0.5 - 0.1)
    assert "creep, no cameras: retraining on the amended model reduces the error by 50 %" in text
    assert (
        "payload, cameras: retraining on the amended model changes the error by -5 %, whi" in text
    )
    assert "line_lag, cameras: retraining on the amended model increases the error by 50 %" in text
    assert "took 2 s of processor time (4 s of wall time" in text
    assert "**Why the error increases with line_lag.**" in text
    assert "with payload.**" not in text
    assert "the error of this model is 0.310 mm" in text
    assert "scripted 0.120 (0.110 to 0.130) mm without cameras." in text
    assert "| 1 to 3 | 9 | +0.100 s, 0.200 mm |" in text
    assert "- creep tau_s: 0.156 s (0.14 to 0.173)" in text
    assert "still ambiguous" not in text
    assert "still ambiguous" in markdown([_outcome("creep", 0.5, "ambiguous")], StudyConfig())


def test_pictures_are_drawn(tmp_path):
    paths = draw([_outcome("creep", 0.5), _outcome("payload", 0.95)], tmp_path)
    assert [path.name for path in paths] == ["hidden_model.png", "hidden_tracking.png"]
    from matplotlib import pyplot as plt

    for path in paths:
        assert plt.imread(path)[..., :3].std() > 0.05


@pytest.mark.parametrize(
    ("arguments", "came"),
    [
        (["hidden-effect", "--effects", "crep"], "crep"),
        (["hidden-effect", "--strength", "0"], "strength is 0"),
        (["control", "--seeds", "one"], "one"),
        (["control", "--tasks", "juggling"], "juggling"),
    ],
)
def test_bad_questions_get_one_line(arguments, came, tmp_path, capsys):
    work = tmp_path / "work"
    place = ["--work" if arguments[0] == "hidden-effect" else "--runs", str(work)]
    assert run_command(["benchmark", *arguments, *place]) == 2
    told = capsys.readouterr().err.strip()
    assert came in told
    assert "\n" not in told
    assert not work.exists()
