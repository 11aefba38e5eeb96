"""The rows of a fit are recognised in other recordings, and others are not."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.inputs import open_inputs
from surgisoft.diagnosis.residuals import held_out_rows
from surgisoft.errors import InputError
from surgisoft.measurement.fitting import fit
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.fitted_rows import SIZE, FittedRows


def recorded(take: int, rows: int = 1500) -> Recording:
    rig = VirtualRig(0, take=take)
    return rig.record(make_protocol("mixed", rig.limits, rows, seed=take))[0]


@pytest.fixture(scope="module")
def pair() -> tuple[Recording, Recording]:
    return recorded(1), recorded(2)


@pytest.fixture(scope="module")
def model(pair):
    return fit(pair[0], effects=[], hidden=(8,), epochs=1, prior="none").model


def test_a_part_of_a_recording_is_recognised_under_any_name(pair, model):
    known = model.fitted_rows
    first, other = (history_of([each]) for each in pair)
    assert known.share_of(first) == 1.0
    assert known.share_of(other) == 0.0
    half = np.arange(pair[0].samples) < 700
    part = pair[0].key_points_mm.copy()
    part[half] += 0.01
    mixed = history_of([replace(pair[0], name="another", key_points_mm=part)])
    assert known.share_of(mixed) == pytest.approx(1 - half.mean(), abs=0.08)
    assert known.share_of(mixed, half) == 0.0
    assert known.share_of(mixed, ~half) == 1.0


def test_a_sketch_is_small_and_joins_as_the_rows_do(pair):
    both, first, other = (
        FittedRows.of([history_of([each]) for each in some]) for some in (pair, pair[:1], pair[1:])
    )
    assert len(first.hashes) == SIZE < first.count
    assert first.joined(other) == other.joined(first) == both
    assert FittedRows.from_json(both.to_json()) == both


def test_rows_that_only_chose_the_model_are_not_called_fitted(pair):
    """Training rows in the one, held-out ones in the other, some in both."""
    known = fit(pair[0], valid=pair[1], effects=[], hidden=(8,), epochs=1, prior="none").model
    notes = " ".join(open_inputs(known, list(pair))[2])
    assert "the model was fitted to 100 % of its rows: the error there is no test; use" in notes
    assert "the model was chosen, not trained, by 100 % of its rows: the error there is n" in notes
    first, other = (history_of([each]) for each in pair)
    trained, chose = FittedRows.of([first]), FittedRows.of([first, other], "chosen")
    assert chose.uses_of(other) == {"fitted": 0.0, "chosen": 1.0, "amended": 0.0}
    for both in (trained.joined(chose), chose.joined(trained)):
        assert both.uses_of(first) == {"fitted": 1.0, "chosen": 0.0, "amended": 0.0}
        assert both.uses_of(other)["chosen"] == 1.0
        assert FittedRows.from_json(both.to_json()) == both
    values = trained.to_json()
    del values["chosen"], values["amended"]
    assert FittedRows.from_json(values) == trained


def test_rows_with_several_uses_count_once(pair):
    """For the network before the choice of the model, and for that before the effects."""
    first, other = (history_of([each]) for each in pair)
    trained, chose = FittedRows.of([first]), FittedRows.of([other], "chosen")
    amended = FittedRows.of([first, other], "amended")
    for both in (trained.joined(amended).joined(chose), chose.joined(trained).joined(amended)):
        assert both.uses_of(first) == {"fitted": 1.0, "chosen": 0.0, "amended": 0.0}
        assert both.uses_of(other) == {"fitted": 0.0, "chosen": 1.0, "amended": 0.0}


def test_rows_that_effects_and_network_were_fitted_to_are_kept_as_both(pair):
    """They count as fitted, and the effects are known after a save and beside the first fit."""
    first, other = (history_of([each]) for each in pair)
    trained = FittedRows.of([first])
    for own, words in (
        (FittedRows.of_amending(other, trained=True), "effects and the network of the model were"),
        (FittedRows.of_amending(other, trained=False), "effects of the model were"),
    ):
        for both in (trained.joined(own), own.joined(trained)):
            again = FittedRows.from_json(both.to_json())
            assert again == both
            assert again.seen_of(other).effects_in_words == f"{words} fitted to 100 % of its rows"
            assert again.seen_of(first).effects_in_words == ""
    assert FittedRows.of_amending(other, trained=True).uses_of(other)["fitted"] == 1.0
    assert "tuned" not in trained.to_json()


def test_a_record_without_the_rows_of_the_first_fit_stays_incomplete(pair):
    first, other = (history_of([each]) for each in pair)
    part, whole = FittedRows.of([first]).joined(None), FittedRows.of([first])
    assert not part.complete
    assert not part.joined(whole).complete
    assert not whole.joined(part).complete
    assert part.certain_part_of(other) is None, "they may have been among those not recorded"
    assert whole.certain_part_of(other) == 0.0


def test_the_same_shape_under_another_actuation_is_another_row(pair):
    """A row is what was actuated and what was measured."""
    first = history_of([pair[0]])
    other = replace(first, pressure=first.pressure + 0.01)
    assert FittedRows.of([first]).share_of(other) == 0.0


def test_the_rows_that_effects_were_fitted_to_are_counted_as_they_are(pair, model):
    """`amend` fits to the rows that are not held out, and to all of them: no estimate is needed."""
    fresh = amend(model, [pair[1]], "gain_mismatch", False, refit="never").model
    share = 1.0 - held_out_rows([pair[1]]).mean()
    (note,) = (text for text in open_inputs(fresh, [pair[1]])[2] if "of its rows" in text)
    assert f"effects of the model were fitted to {100 * share:.0f} % of its rows: the err" in note
    assert note.endswith(
        "further effects may be sought there, and only other recordings test the model"
    )
    history, parts = history_of([pair[1]]), held_out_rows([pair[1]])
    exact = fresh.fitted_rows.uses_of(history, parts=parts)
    assert exact == pytest.approx({"fitted": 0.0, "chosen": 0.0, "amended": share}, abs=1e-12)
    assert fresh.fitted_rows.share_of(history) != pytest.approx(share, abs=1e-6)


def test_a_model_keeps_what_it_was_fitted_to_and_notes_report_it(pair, model, tmp_path):
    save_model(model, tmp_path / "arm")
    opened = load_model(tmp_path / "arm")
    assert opened.fitted_rows == model.fitted_rows
    assert "the model was fitted to 100 %" in " ".join(open_inputs(opened, [pair[0]])[2])
    assert "fitted to" not in " ".join(open_inputs(opened, [pair[1]])[2])


def test_amend_states_where_held_out_rows_were_in_the_fit(pair, model):
    """The rows that `amend` itself holds out are none of those of the amended model."""
    found = amend(model, [pair[0]], "gain_mismatch", False, refit="never")
    assert found.held_out.in_fit == 1.0
    assert "of which the model had been fitted to 100%" in found.held_out.sentence
    fresh = amend(model, [pair[1]], "gain_mismatch", False, refit="never")
    assert fresh.held_out.in_fit == 0.0
    again = amend(fresh.model, [pair[1]], "gain_mismatch", False, refit="never")
    assert again.held_out.in_fit == 0.0
    assert again.training.in_fit > 0.9


def test_the_default_arm_knows_its_rows(pair):
    """13,824 rows of the grid and 1,000 of the validation of `SOURCE.md`, none of other motion."""
    known = load_model("default").fitted_rows
    assert known.complete
    assert (known.count, len(known.hashes)) == (14_824, SIZE)
    assert known.share_of(history_of([pair[0]])) == 0.0


def test_a_recording_under_two_names_is_not_fitted_twice(pair):
    """Rows that are held out of the one would be fitted in the other."""
    first, other = pair
    cut = {
        name: getattr(first, name)[300:600]
        for name in ("t_s", "measured", "commanded", "key_points_mm", "run", "temp_C")
    }
    part = replace(first, name="cut", **cut)
    moved = replace(first, name="moved", key_points_mm=first.key_points_mm + 0.01)
    quick = {"effects": [], "hidden": (8,), "epochs": 1, "prior": "none"}
    for given, share in (([first, other, replace(first, name="copy")], 100), ([first, part], 100)):
        message = rf"^{given[-1].label}: {share} % of its rows are in {first.label}, expected"
        with pytest.raises(InputError, match=message):
            fit(given, **quick)
    with pytest.raises(
        InputError, match=rf"^{first.label}: 20 % of its rows are in recording .cut."
    ):
        fit([part, first], **quick)
    assert fit([first, other, moved], **quick).model.fitted_rows.count == 4500


def test_a_fit_notes_recordings_of_less_than_two_minutes(pair):
    quick = {"effects": [], "hidden": (8,), "epochs": 1, "prior": "none"}
    some = recorded(1, rows=400)
    seconds = sum(float(np.ptp(some.t_s[run])) for run in some.runs)
    short, long = (
        [note for note in fit(each, **quick).warnings if "two minutes or more" in note]
        for each in (some, pair)
    )
    assert seconds < 60
    (note,) = short
    assert note.startswith(f"the recordings last {seconds:.0f} s in all, expected")
    assert long == []


def test_a_fit_notes_channels_that_move_as_one():
    some = recorded(1, rows=400)
    actuation = some.measured.copy()
    actuation[:, 1] = actuation[:, 0].max() - actuation[:, 0]
    quick = {"effects": [], "hidden": (8,), "epochs": 1, "prior": "none"}
    said = "channels 1 and 2 move against each other (r = -1.00): what each of them does alone"
    for given, told in ((replace(some, measured=actuation), 1), (some, 0)):
        assert sum(said in note for note in fit(given, **quick).warnings) == told
