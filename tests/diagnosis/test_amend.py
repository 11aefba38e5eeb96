"""`amend`: falls by hand, claims that hold, and every wrong turn in one line."""

import copy
import hashlib
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.cli import run
from surgisoft.diagnosis.amend import Amendment, Fall, amend, fall_of, track_of
from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.estimation.network import Retuned, best_layer, retune
from surgisoft.diagnosis.residuals import held_out_rows, problem_of, residual_table
from surgisoft.errors import InputError
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording, load_recording, save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import (
    default_arm,
    load_model,
    load_training_residuals,
    save_model,
)
from tests.diagnosis.synthetic import recording, still_model, walk
from tests.diagnosis.test_estimation import TRUTHS, bare_arm, measured_on


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A bare arm's folder, a recording of it with hidden creep, and one without."""
    folder = tmp_path_factory.mktemp("lab")
    save_model(bare_arm(), folder / "arm")
    save_recording(measured_on(TRUTHS["creep"]), folder / "creep.parquet")
    save_recording(measured_on(bare_arm()), folder / "clean.parquet")
    return folder


def hashes(folder) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_track_begins_anew_with_every_run():
    """Two recordings, the second one of two runs: three begins, the first row among them."""
    first, second = recording(np.zeros(60), walk(60)), recording(np.zeros(80), walk(80), seed=2)
    second = replace(second, run=np.repeat([4, 7], 40))
    problem = problem_of(still_model(), [first, second])
    track = track_of(problem, problem)
    row = problem.index.numpy()
    table = problem.table
    runs = np.stack([table.recording[row], table.run[row]], axis=1)
    expected = np.r_[True, (np.diff(runs, axis=0) != 0).any(axis=1)]
    np.testing.assert_array_equal(track.start, expected)
    assert (track.start[0], track.start.sum()) == (True, 3)


def test_a_fall_by_hand():
    """Twelve blocks whose error is 1 mm before and 0.6 after, but for one that was 0 and is 0.6."""
    arm = bare_arm()
    problem = problem_of(arm, [measured_on(arm, runs=1, rows=240)])
    count = int(problem.block.max()) + 1
    shift = np.zeros_like(problem.predicted)
    shift[..., 0] = np.where(problem.block == 0, 0.0, 1.0)[:, None]
    before = replace(problem, predicted=problem.measured + shift)
    after = replace(problem, predicted=problem.measured + np.array([0.6, 0.0, 0.0]))
    fall = fall_of(before, after)
    sizes = np.bincount(problem.block)
    assert fall.before == pytest.approx(np.sqrt(1 - sizes[0] / sizes.sum()))
    assert fall.after == pytest.approx(0.6)
    assert fall.fall == pytest.approx(fall.before - 0.6)
    assert fall.blocks == count
    # Drawn with replacement, the block without error comes 0 to 3 times in 95 % of the draws.
    assert fall.ci95[1] == pytest.approx(0.4, abs=1e-9)
    worst = np.sqrt(1 - 3 * sizes[0] / sizes.sum()) - 0.6
    assert fall.ci95[0] == pytest.approx(worst, abs=0.05)


@pytest.mark.parametrize(
    ("before", "after", "ci95", "claimed"),
    [
        (1.0, 0.5, (0.4, 0.6), True),
        (1.0, 0.9, (-0.01, 0.2), False),
        (1.0, 0.99, (0.005, 0.015), False),
        (0.5, 0.6, (-0.2, -0.1), False),
    ],
)
def test_what_is_claimed(before, after, ci95, claimed):
    fall = Fall(before, after, 0.1, before - after, ci95, 100, 20)
    assert fall.claimed is claimed
    assert fall.sentence.startswith("error") is claimed


def test_the_locked_rows_take_no_part():
    """Wild key points in the held-out part change its error, and no parameter."""
    recording = measured_on(TRUTHS["gain_mismatch"], rows=200)
    points = recording.key_points_mm.copy()
    points[held_out_rows([recording])] += 5.0
    wild = replace(recording, key_points_mm=points)
    one, other = (amend(bare_arm(), [each], ["gain_mismatch"]) for each in (recording, wild))
    assert one.parameters == other.parameters
    assert other.held_out.after > one.held_out.after + 5


def test_a_held_out_part_without_key_points_is_refused_before_any_fit(monkeypatch):
    rig = VirtualRig(0)
    made = rig.record(make_protocol("mixed", rig.limits, 400))[0]
    points = made.key_points_mm.copy()
    points[280:] = np.nan
    monkeypatch.setattr(
        "surgisoft.diagnosis.amend.fit_effects", lambda *_, **__: pytest.fail("fitted")
    )
    with pytest.raises(InputError, match=r"the held-out part, .* has 0 rows with key points"):
        amend("default", [replace(made, key_points_mm=points)], "creep", refit="never")


def test_an_amended_model_is_a_model(lab, capsys):
    before = hashes(lab)
    new = lab / "new"
    command = ["amend", str(lab / "arm"), "--effect", "creep", "--data", str(lab / "creep.parquet")]
    file, report = lab / "new.json", lab / "pictures"
    assert run([*command, "-o", str(new), "--json", str(file), "--report", str(report)]) == 0
    out = capsys.readouterr().out
    assert "amount_share" in out
    assert "creep: error" in out
    values = json.loads(file.read_text())
    assert values["claimed"] is True
    error = values["error_mm"]
    assert error["after"] < 1.1 * error["floor"] < 0.6 * error["before"]
    assert error["ci95"][0] < error["fall"] < error["ci95"][1]
    amount = values["parameters"][0]
    assert amount["ci95"][0] < 0.15 < amount["ci95"][1]
    assert json.loads((new / "report.json").read_text())["amended_from"] == "arm"
    page = (report / "report.html").read_text()
    assert "amount_share" in page
    assert page.count("<figure") >= 2
    after = hashes(lab)
    assert {name: after[name] for name in before} == before

    model, recording = load_model(new), load_recording(lab / "creep.parquet")
    assert list(model.effects) == ["creep"]
    history = history_of([recording]).select(torch.tensor([0]))
    predicted = model.predict(history)[0]
    state = model.first_state(model.first_pressure(history))
    for row in range(60):
        change = history.pressure[:, row] - state.pressure
        state, points = model.step(state, change, history.dt_s[:, row])
        assert torch.allclose(points[0], predicted[row], atol=1e-3)
    assert compare(model, [recording])[0].rmse_mm < 1.1 * error["floor"]
    assert run([*command, "-o", str(new)]) == 2
    assert "already exists" in capsys.readouterr().err


def test_a_clean_recording_is_refused(lab, capsys):
    before = hashes(lab)
    command = ["amend", str(lab / "arm"), "--effect", "creep", "--data", str(lab / "clean.parquet")]
    assert run([*command, "-o", str(lab / "refused")]) == 1
    assert "no reduction of the error is claimed" in capsys.readouterr().out
    assert hashes(lab) == before
    assert run([*command, "-o", str(lab / "anyway"), "--anyway"]) == 1
    assert load_model(lab / "anyway").effects["creep"].amount.abs() < 0.02


def test_an_effect_of_ones_own(lab, tmp_path, capsys):
    """A file that names no effect of the package: a shift of all key points."""
    own = tmp_path / "mean_shift.py"
    own.write_text(
        "from surgisoft.surrogate.effects.base import Memoryless, Quantity, amplitude, value_of\n"
        "class MeanShift(Memoryless):\n"
        "    stage = 'sensor'\n"
        "    def __init__(self, facts):\n"
        "        super().__init__(facts)\n"
        "        self.shift = amplitude(1)\n"
        "    def strengths(self):\n"
        "        return {'shift': self.shift}\n"
        "    def apply(self, signal, memory):\n"
        "        return signal + self.shift\n"
        "    def config(self):\n"
        "        return {}\n"
        "    def quantities(self):\n"
        "        return [Quantity('shift_mm', value_of(self.shift), 'mm', -9, 9, 'a test')]\n"
    )
    recording = load_recording(lab / "clean.parquet")
    moved = tmp_path / "moved.parquet"
    save_recording(replace(recording, key_points_mm=recording.key_points_mm + 0.7), moved)
    command = ["amend", str(lab / "arm"), "--effect", str(own), "--data", str(moved)]
    assert run([*command, "-o", str(tmp_path / "new")]) == 0
    assert load_model(tmp_path / "new").effects["mean_shift"].shift.item() == pytest.approx(
        0.7, abs=0.01
    )
    told = re.search(r"mean_shift: shift_mm = ([0-9.]+) mm \(", capsys.readouterr().out)
    assert float(told[1]) == pytest.approx(0.7, abs=0.01)


WRONG = {
    "unknown effect 'magic': known are": {"effect": "magic"},
    "zero_offset; did you mean 'gain_mismatch'?": {"effect": "gain"},
    "no arm model there": {"model": "nowhere"},
    "is the folder of the model to amend": {"output": "arm"},
    "key points: 3, but the model has 5": {"data": "other.parquet"},
    "every key point is missing in every row": {"data": "blind.parquet"},
    "0 blocks of time": {"data": "half_blind.parquet"},
}


@pytest.mark.parametrize("says", WRONG)
def test_a_bad_input_gets_one_line(lab, says, capsys):
    clean = load_recording(lab / "clean.parquet")
    unseen = clean.key_points_mm.copy()
    unseen[~held_out_rows([clean])] = np.nan
    for name, points in (
        ("other", clean.key_points_mm[:, :3]),
        ("blind", np.full_like(unseen, np.nan)),
        ("half_blind", unseen),
    ):
        save_recording(replace(clean, key_points_mm=points), lab / f"{name}.parquet", force=True)
    given = {"model": "arm", "effect": "creep", "data": "clean.parquet", "output": "out"}
    given |= WRONG[says]
    before = hashes(lab)
    code = run(
        [
            "amend", str(lab / given["model"]), "--effect", given["effect"],
            "--data", str(lab / given["data"]), "-o", str(lab / given["output"]),
        ]
    )  # fmt: skip
    captured = capsys.readouterr()
    errors = [line for line in captured.err.splitlines() if "error" in line]
    assert code == 2
    assert len(errors) == 1
    assert says in errors[0]
    assert captured.out == ""
    assert hashes(lab) == before


def test_the_error_falls_on_a_rig_whose_creep_has_another_form():
    """The rig's creep is a nonlinear ladder (Findley 1976); the tool's is a log-normal spectrum."""
    rig = VirtualRig(0, hidden=[("creep", 1.0)])
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 1200, seed=3))
    assert isinstance(recording, Recording)
    result = amend(default_arm(), [recording], ["creep"])
    assert result.held_out.claimed
    assert result.held_out.after < 0.6 * result.held_out.before
    assert list(result.model.effects) == ["hysteresis", "creep"]


def test_a_network_is_retuned_behind_an_effect_that_is_there_and_earns_it_no_claim():
    """The network is off by a constant: re-tuning mends that, beside creep and without it."""
    off = bare_arm()
    off.training_residuals = load_training_residuals("default")
    with torch.no_grad():
        off.network.layers[-1].bias += 0.02
    with_creep = measured_on(TRUTHS["creep"], rows=250)
    both, kept = (
        amend(off, [with_creep], ["creep"], tune, refit="never") for tune in (True, False)
    )
    assert both.claimed
    assert both.retuned
    assert not kept.retuned
    assert both.model.training_residuals is None, "those of another network"
    assert kept.model.training_residuals is off.training_residuals is not None
    for found, use, other in ((both, "fitted", "amended"), (kept, "amended", "fitted")):
        share = found.model.fitted_rows.uses_of(history_of([with_creep]))
        assert share[use] > 0.6
        assert share[other] == 0.0
        before = measured_on(bare_arm(), rows=250, noise_seed=1)
        with pytest.raises(InputError, match=r"fitted to 7\d % of its rows.*would be found again"):
            diagnose(found.model, [with_creep], before=[before], setup_tests=False)
    assert both.alone == kept.held_out
    assert both.held_out.after < 0.7 * kept.held_out.after
    assert both.held_out.after < 1.5 * both.held_out.floor
    without = amend(off, [measured_on(bare_arm(), rows=200)], ["creep"], refit="never")
    assert not without.claimed
    assert not without.retuned
    assert without.held_out == without.alone


def test_effects_of_channels_that_move_as_one_are_noted():
    """Channels 1 and 2 against each other; a turned frame is no effect of a channel."""
    free = measured_on(bare_arm(), runs=2, rows=200)
    actuation = free.measured.copy()
    actuation[:, 1] = actuation[:, 0].max() - actuation[:, 0]
    tied = replace(free, measured=actuation)
    said = "channels 1 and 2 move against each other (r = -1.00): what is said of one may be of"
    for given, effect, told in (
        (tied, "gain_mismatch", True),
        (tied, "misalignment", False),
        (free, "gain_mismatch", False),
    ):
        notes = amend(bare_arm(), [given], effect, retune_network=False, refit="never").notes
        assert sum(said in note for note in notes) == told
        assert sum("move against" in note for note in notes) == told


def test_a_fall_is_claimed_where_it_is_significant_and_large():
    """Above the floor stand 1.0 mm: what counts is more than a twentieth of them."""
    fall = Fall(1.2, 1.0, 0.2, fall=0.2, ci95=(0.1, 0.3), rows=9, blocks=3)
    assert fall.claimed
    assert not replace(fall, ci95=(-0.01, 0.4)).claimed
    assert not replace(fall, fall=0.04, ci95=(0.02, 0.06)).claimed
    assert replace(fall, fall=0.06, ci95=(0.02, 0.1)).claimed


def test_a_fall_that_chance_or_the_fit_explains_is_not_claimed():
    """Also not one of a twentieth of next to nothing: a tenth of the error is what it is of."""
    fall = Fall(1.2, 1.0, 0.2, fall=0.2, ci95=(0.1, 0.3), rows=9, blocks=3)
    assert replace(fall, p_value=0.04).claimed
    chance = replace(fall, p_value=0.06)
    assert not chance.significant
    assert "may be the model's own error, which the effect resembles (p 0.06)" in chance.sentence
    seen = replace(fall, in_fit=0.3)
    assert seen.significant
    assert not seen.claimed
    assert "fitted to 30% of the held-out rows" in seen.sentence
    assert seen.sentence.endswith("(reduction 0.200 mm, 95 % 0.100 to 0.300; floor 0.200 mm)")
    assert replace(fall, in_fit=None).claimed
    near = Fall(1.0, 0.996, 0.99, fall=0.004, ci95=(0.001, 0.01), rows=9, blocks=3)
    assert not near.claimed
    assert replace(near, fall=0.006).claimed


@pytest.mark.parametrize(
    ("held_out", "alone", "refit", "claimed"),
    [
        ({}, {}, False, True),
        ({}, {"ci95": (-0.1, 0.3)}, False, False),
        ({"ci95": (-0.1, 0.3)}, {}, False, False),
        ({"in_fit": 0.3}, {}, False, False),
        ({}, {"in_fit": 0.3}, False, False),
        ({"in_fit": 0.3}, {"in_fit": 0.3}, True, True),
        ({"in_fit": 0.3}, {"ci95": (-0.1, 0.3)}, True, False),
        ({"ci95": (-0.1, 0.3)}, {}, True, False),
    ],
)
def test_an_amendment_is_claimed_for_the_effects_and_for_the_model(held_out, alone, refit, claimed):
    """Where the given model knew the rows, a joint fit is compared with the network alone."""
    fall = Fall(1.2, 1.0, 0.2, fall=0.2, ci95=(0.1, 0.3), rows=9, blocks=3)
    found = Amendment(
        model=None,
        effects=("creep",),
        refitted=(),
        parameters=(),
        held_out=replace(fall, **held_out),
        alone=replace(fall, **alone),
        training=fall,
        retuned=False,
        tracks=(None, None),
        seconds=0.0,
        refit=SimpleNamespace() if refit else None,
    )
    assert found.claimed is claimed


def test_the_fall_is_that_of_the_rms_distance():
    """Errors of 3 mm that become 2 mm at one key point of two, in 12 blocks of 5 rows."""
    block = np.repeat(np.arange(12), 5)
    residual = np.zeros((60, 2, 3))
    residual[:, 0, 1] = 3.0
    before = SimpleNamespace(
        residual=residual,
        block=block,
        told_floor_mm=0.1,
        index=np.arange(60),
        in_fit=None,
    )
    after = SimpleNamespace(residual=residual * (2 / 3), block=block)
    found = fall_of(before, after)
    assert found.before == pytest.approx(3.0 / np.sqrt(2))
    assert found.after == pytest.approx(2.0 / np.sqrt(2))
    assert found.fall == pytest.approx(1.0 / np.sqrt(2))
    assert found.ci95 == pytest.approx((found.fall, found.fall))
    assert (found.rows, found.blocks) == (60, 12)


def test_the_last_layer_is_tuned_on_training_rows_alone(lab, monkeypatch):
    """What `retune` is given holds no measurement of a held-out row."""
    seen = []

    def retune(model, problem, effects):
        assert effects == ["creep"]
        seen.append(problem.table)
        return Retuned(model, False, 0.0)

    monkeypatch.setattr("surgisoft.diagnosis.amend.retune", retune)
    amend(lab / "arm", lab / "creep.parquet", "creep", refit="never")
    (table,) = seen
    assert table.held_out.sum() > 100
    assert np.isnan(table.measured_mm[table.held_out]).all()
    assert np.isfinite(table.measured_mm[~table.held_out]).any()


def test_a_layer_that_held_out_motion_does_not_reward_is_not_changed():
    """The model is the truth: what a new layer would gain is noise."""
    arm = bare_arm()
    problem = residual_table(arm, [measured_on(arm)]).training()
    for found in (retune(arm, problem), best_layer(arm, problem)):
        assert not found.kept
        assert found.model is arm
        assert found.gain < 0.05


def test_a_tuned_layer_that_makes_the_error_larger_is_not_kept(lab, monkeypatch):
    """Whatever the tuning says of itself: the network's output is moved by 1 mm here."""

    def worse(model, problem, effects):
        network = copy.deepcopy(model.network)
        with torch.no_grad():
            network.mean += 1.0
        return Retuned(model.replace(network=network).eval(), True, 0.5)

    monkeypatch.setattr("surgisoft.diagnosis.amend.retune", worse)
    found = amend(lab / "arm", lab / "creep.parquet", "creep", refit="never")
    assert not found.retuned
    assert found.alone.claimed
    assert found.held_out.after == pytest.approx(found.alone.after)
