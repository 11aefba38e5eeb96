"""Import, fit, diagnose and amend on real robots, against what their makers say of them."""

import json
from functools import partial

from surgisoft.cli import diagnose, run
from surgisoft.diagnosis import diagnose as diagnosing
from surgisoft.diagnosis.refit import RefitConfig
from surgisoft.diagnosis.refit import refit as fitted_together

SMALL = ["--widths", "32,32", "--inputs", "pressure", "--epochs", "30"]
BRIEF = RefitConfig(rows=2000, seeds=2, early_epochs=1, first_epochs=2, epochs=6, finalists=2)
"""The budget of a refit: about a fifteenth of that of the commands."""


def diagnosis(monkeypatch, recording, tmp_path, *options, of=None, refit="auto"):
    """A small model of a recording, and what is missing in it on the same or another one."""
    monkeypatch.setattr(diagnose, "REFIT_PROCESSES", 1)  # two give the same: test_refit.py
    brief = partial(fitted_together, config=BRIEF)
    monkeypatch.setattr(diagnosing, "fit_candidates_together", brief)
    model, out = tmp_path / "-".join(["arm", *options]), tmp_path / "found.json"
    assert run(["fit", str(recording), "-o", str(model), *SMALL, *options]) == 0
    asked = ["diagnose", str(model), str(of or recording), "--refit", refit, "--json", str(out)]
    assert run(asked) == 0
    return model, json.loads(out.read_text())


def test_lag_of_the_line_is_in_the_command_more_than_in_the_measurement(
    two_segments, tmp_path, monkeypatch
):
    """SOURCE.md: pressure follows its command within 0.5 s up and 2 s down.

    The arm trails its measured pressure too (tip 0.9 and 3.2 s), so some lag is left there.
    """
    shares = {}
    for actuation in ("commanded", "measured"):
        refit = "auto" if actuation == "commanded" else "never"  # the share is that of the residual
        _, found = diagnosis(
            monkeypatch, two_segments, tmp_path, "--actuation", actuation, refit=refit
        )
        gain = {row["effect"]: row["gain_alone"] for row in found["ranking"]}
        shares[actuation] = gain["line_lag"]
        if actuation == "commanded":
            assert found["ranking"][0]["effect"] == "line_lag"
            assert "line_lag" in found["verdict"]["effects"]
    assert shares["commanded"] > 0.5
    assert shares["measured"] < 0.7 * shares["commanded"]


def test_payload_of_the_trunk(trunk, tmp_path, monkeypatch):
    """100 g at the tip: ranked first, and with it the error falls on data that took no part.

    Hysteresis explains nearly as much of this motion, so that it need not be named. A payload
    acts behind the network, which cannot imitate it: a refit would not try it.
    """
    model, found = diagnosis(monkeypatch, trunk[0], tmp_path, of=trunk[100], refit="never")
    assert found["ranking"][0]["effect"] == "payload"
    out = tmp_path / "amended.json"
    data = ["--data", str(trunk[100]), "-o", str(tmp_path / "amended"), "--json", str(out)]
    assert run(["amend", str(model), "--effect", "payload", *data]) == 0
    error = json.loads(out.read_text())["error_mm"]
    assert error["after"] < 0.9 * error["before"]
    assert error["ci95"][0] > 0
