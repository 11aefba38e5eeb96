"""Claims on data that took no part in a fit are refused where the data took part."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.diagnose import amend_command, diagnose
from surgisoft.diagnosis.improve import Improvement, Round
from surgisoft.diagnosis.pages.amendment import amend_page
from surgisoft.diagnosis.pages.compare import compare_page
from surgisoft.diagnosis.pages.diagnosis import diagnosis_page
from surgisoft.errors import InputError
from surgisoft.measurement.fitting import fit
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording, load_recording, save_recording
from surgisoft.report import write_page
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.fitted_rows import FittedRows
from tests.few_effects import choose_among


@pytest.fixture(autouse=True)
def few_effects(monkeypatch):
    """Diagnoses choose among three effects, to save time."""
    choose_among(monkeypatch, "gain_mismatch", "creep", "payload")


def recorded(take: int, rows: int = 600) -> Recording:
    rig = VirtualRig(0, take=take)
    return rig.record(make_protocol("mixed", rig.limits, rows, seed=take))[0]


def part_of(recording: Recording, rows: np.ndarray) -> Recording:
    """Some rows under another name."""
    arrays = ("t_s", "measured", "commanded", "key_points_mm", "run")
    cut = {name: getattr(recording, name)[rows] for name in arrays}
    return replace(recording, name="another", temp_C=None, payload_g=None, **cut)


@pytest.fixture(scope="module")
def known() -> Recording:
    return recorded(1)


@pytest.fixture(scope="module")
def other() -> Recording:
    return recorded(2)


@pytest.fixture(scope="module")
def model(known):
    return fit(known, effects=[], hidden=(8,), epochs=1, prior="none").model


@pytest.fixture(scope="module")
def arm(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm") / "arm"
    save_model(model, folder)
    return folder


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("rows", [slice(150, 350), slice(0, None, 5)])
def test_a_test_on_rows_of_the_fit_is_refused(model, known, other, suffix, rows, tmp_path):
    """Under another name, cut, thinned, in either format, and beside a recording that is new."""
    file = tmp_path / f"renamed{suffix}"
    save_recording(part_of(known, np.arange(known.samples)[rows]), file)
    with pytest.raises(InputError, match=r"renamed.*the model was fitted to 100 % of its rows"):
        compare(model, [other, load_recording(file)], test=True)


def test_a_test_needs_a_record_of_the_fit(model, known, other):
    """Of a model without a record, amending it makes none that is complete."""
    forgetful = model.replace()
    forgetful.fitted_rows = None
    with pytest.raises(InputError, match="keeps no record of all rows"):
        compare(forgetful, [other], test=True)
    amended = amend(forgetful, [known], "gain_mismatch", False, refit="never").model
    with pytest.raises(InputError, match="keeps no record of all rows"):
        compare(amended, [other], test=True)
    assert compare(amended, [other])[0].to_json()["held_out"] is None
    with pytest.raises(InputError, match="effects of the model were fitted to"):
        compare(amended, [known], test=True)
    text = amended.fitted_rows.to_json()
    assert FittedRows.from_json(text) == amended.fitted_rows


def test_compare_says_what_the_error_is_no_test_of(model, known, other, tmp_path):
    seen, table = compare(model, [known])
    new, _ = compare(model, [other], test=True)
    assert seen.in_fit == 1.0
    assert new.in_fit == 0.0
    assert "which was fitted to or chosen by 100% of these rows" in seen.sentence
    assert "no test" not in new.sentence
    assert seen.to_json()["held_out"] is False
    assert new.to_json()["held_out"] is True
    page = write_page(compare_page(seen, table, "t", "a"), tmp_path / "page.html").read_text()
    assert "of them in the model" in page


def test_commands_refuse_in_one_line(arm, known, other, tmp_path, capsys):
    files = {"known": known, "other": other, "part": part_of(known, np.arange(50, 250))}
    for name, recording in files.items():
        save_recording(recording, tmp_path / f"{name}.csv")
    given = [str(arm), str(tmp_path / "part.csv"), "--test", "--json", str(tmp_path / "x.json")]
    assert run(["compare", *given]) == 2
    error = capsys.readouterr().err
    assert "expected a recording that took no part in the fit" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "x.json").exists()
    assert run(["compare", str(arm), str(tmp_path / "other.csv"), "--test"]) == 0
    capsys.readouterr()
    train = ["fit", str(tmp_path / "known.csv"), "-o", str(tmp_path / "new")]
    assert run([*train, "--valid", str(tmp_path / "part.csv")]) == 2
    error = capsys.readouterr().err
    assert "100 % of its rows are in the training recordings" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "new").exists()


@pytest.fixture(scope="module")
def seen(model, known):
    """An amendment on the rows of the fit."""
    return amend(model, [known], "gain_mismatch", False, refit="never")


@pytest.fixture(scope="module")
def sure(seen):
    """Its fall, as if it were large and significant."""
    return replace(seen.held_out, p_value=None, fall=2.0, ci95=(1.0, 3.0))


def test_amend_claims_no_fall_on_rows_of_the_fit(model, seen, sure, other, tmp_path):
    assert seen.held_out.in_fit == 1.0
    assert not seen.claimed
    assert sure.significant
    assert not sure.claimed
    assert replace(sure, in_fit=0.0).claimed
    assert sure.sentence.startswith(
        "no reduction on unseen data is claimed, because the model had been fitted to 100%"
    )
    assert seen.to_json()["error_mm"]["held_out"] is False
    page = write_page(amend_page(seen, "t", "a"), tmp_path / "page.html").read_text()
    assert "they are not unseen data" in page
    new = amend(model, [other], "gain_mismatch", False, refit="never")
    assert new.to_json()["error_mm"]["held_out"] is True
    assert replace(sure, in_fit=new.alone.in_fit).sentence.startswith("error ")


def test_improve_claims_it_where_the_network_was_trained_together(model, sure):
    step = Round("identified", "", "creep", (), 0.9, 1.0, 1.0)
    found = Improvement(model, (step,), (), sure, (None, None), 0.0)
    assert not found.claimed
    assert "no reduction on unseen data is claimed" in found.sentence
    together = replace(found, rounds=(replace(step, together=True),))
    assert together.claimed
    assert "none of these errors is on unseen data" in together.sentence
    assert "held-out" not in together.sentence


def test_diagnose_calls_no_row_of_the_fit_held_out(arm, known, other, tmp_path, capsys):
    save_recording(known, tmp_path / "known.parquet")
    opened = load_model(arm)
    seen = diagnose(opened, [known], refit="never", setup_tests=False)
    new = diagnose(opened, [other], refit="never", setup_tests=False)
    assert seen.in_fit == 1.0
    assert new.in_fit == 0.0
    assert "held-out" in new.left_out
    assert "held-out" not in seen.verdict.sentence + seen.left_out
    page = write_page(diagnosis_page(seen, "t"), tmp_path / "page.html").read_text()
    assert "no error on this page is an error on data" in page
    assert run(["diagnose", str(arm), str(tmp_path / "known.parquet"), "--refit", "never"]) == 0
    shown = capsys.readouterr().out
    assert "held-out" not in shown
    assert "left-out RMSE" in shown


@pytest.mark.parametrize(
    ("effect", "unknown", "expected"),
    [
        ("payload", True, "surgisoft amend {model} --effect payload --data {data}"),
        ("payload", False, "surgisoft amend {model} --effect payload --data OTHER_REC"),
        ("creep", False, "surgisoft amend {model} --effect creep --data {data} --refit always"),
    ],
)
def test_the_next_command_is_one_that_may_claim(effect, unknown, expected):
    found = SimpleNamespace(
        next_command=f"surgisoft amend {{model}} --effect {effect} --data {{data}}",
        verdict=SimpleNamespace(effects=(effect,)),
    )
    assert amend_command(found, unknown) == expected
