"""docs/your_model.md: its Python blocks run, one after another, on a recording of the rig."""

import re
import sys
from pathlib import Path

import pytest

from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.callables import named
from tests.few_effects import few_effects

PAGE = Path(__file__).resolve().parents[1] / "docs" / "your_model.md"


def blocks() -> dict[str, str]:
    """The page's Python: files by name, and all other blocks joined under the name ''."""
    found = {"": ""}
    for block in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.S | re.M):
        name = re.match(r"# (\w+\.py):", block)
        if name:
            found[name[1]] = block
        else:
            found[""] += block
    return found


def test_the_snippets_run_as_they_stand(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(named, "NAMED", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    rig = VirtualRig(0, take=7, hidden=(("payload", 1.0),))
    save_recording(rig.record(make_protocol("mixed", rig.limits, 400, seed=2))[0], "bench.parquet")
    parts = blocks()
    assert {"my_arm.py", "lagging.py"} <= set(parts)
    for name, text in parts.items():
        if name:
            Path(name).write_text(text)
    result: dict = {}
    with few_effects("payload", "creep", "misalignment"):
        exec(parts[""], result)
    monkeypatch.delitem(sys.modules, "my_arm", raising=False)
    assert "payload" in result["amended"].model.effects
    assert result["key_points"].shape == (64, 5, 3)
    assert result["found"].ranking
    sentences = capsys.readouterr().out.splitlines()
    assert sentences == [result["comparison"].sentence, result["found"].verdict.sentence]


@pytest.mark.parametrize("rate", [0.05, 0.4])
def test_the_lag_of_the_page_is_a_lag(rate, tmp_path, monkeypatch):
    """After 0.4 s, its time constant, 1 - 1/e of a jump is done, whatever the steps."""
    import numpy as np

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    for name, text in blocks().items():
        if name:
            Path(name).write_text(text)
    space: dict = {}
    exec(Path("lagging.py").read_text(), space)
    monkeypatch.delitem(sys.modules, "my_arm", raising=False)
    arm, rest, goal = space["arm"], np.zeros((2, 3)), np.full((2, 3), 20.0)
    state = arm.initial_state(rest)
    for _ in range(round(0.4 / rate)):
        state, points = arm.step(state, goal, np.full(2, rate))
    tip = points[0, -1] - space["still"](None, rest)[0, -1]
    whole = (space["still"](None, goal) - space["still"](None, rest))[0, -1]
    np.testing.assert_allclose(tip, (1 - np.exp(-1)) * whole, rtol=1e-9)
