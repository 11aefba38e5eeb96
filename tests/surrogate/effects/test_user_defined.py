"""User-defined effects: the example of the documentation, by file and by package."""

import math
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.errors import InputError
from surgisoft.measurement.fitting import fit
from surgisoft.measurement.protocols import make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.effects import (
    EFFECTS,
    Context,
    check_effect,
    check_user_effects,
    hypothesis_of,
    known_effects,
    make_effect,
    named_effect,
    named_effects,
    register_effect_file,
    register_effect_files,
    user_defined,
)
from surgisoft.surrogate.model import ArmModel, Validation
from surgisoft.surrogate.networks import ConstantCurvature
from tests.surrogate.effects.arms import FACTS

DOCS = Path(__file__).resolve().parents[3] / "docs" / "effects.md"
EXAMPLE, BREATHING, SECOND = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.S)


@pytest.fixture(autouse=True)
def _no_files_but_the_tests_own(monkeypatch):
    monkeypatch.setattr(user_defined, "FILES", {})


@pytest.fixture
def slack(tmp_path) -> Path:
    path = tmp_path / "slack.py"
    path.write_text(EXAMPLE)
    return path


def arm() -> ArmModel:
    """A small arm with the documentation's effect."""
    spec = ArmSpec(3, 2, (-10.0,) * 3, (50.0,) * 3)
    effect = make_effect("slack", FACTS)
    effect.loss.data.fill_(0.3)
    network = ConstantCurvature(torch.tensor(spec.low), torch.tensor(spec.high), 2)
    network.set_rest(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 70.0]]))
    return ArmModel(spec, network, {"slack": effect}, torch.eye(3)[:2], Validation(0.1))


def test_the_documentations_effect_works(slack):
    assert register_effect_file(slack) == "slack" == named_effect(str(slack))
    assert "slack" in known_effects()
    effect = make_effect("slack", FACTS)
    x = torch.tensor([[-10.0, 0.0, 20.0]])
    memory = effect.rest(x)
    assert torch.equal(effect.apply(x, memory), x)
    assert torch.equal(effect.sensitivities(x, memory), torch.tensor([[[10.0, 0.0, 0.0]]]))
    effect.loss.data.fill_(0.5)
    assert effect.apply(x, memory).tolist() == [[-5.0, 0.0, 20.0]]
    assert effect.plausible()


def test_the_documentations_effect_with_memory_works(tmp_path):
    path = tmp_path / "breathing.py"
    path.write_text(BREATHING)
    assert register_effect_file(path) == "breathing"
    effect = make_effect("breathing", FACTS)
    points = torch.zeros(2, 40, 5, 3)
    seen = Context(torch.full((2, 40), 0.25))
    memory = effect.scan(effect.rest(points[:, 0]), points, seen)
    assert torch.equal(effect.apply(points, memory), points)
    effect.sine.data[2], effect.log_period.data[:] = 3.0, math.log(5.0)
    turns = torch.arange(1, 41) * 0.25 / 5.0
    expected = 3.0 * (2 * math.pi * turns).sin()
    moved = effect.apply(points, memory)
    torch.testing.assert_close(moved[0, :, 4, 2], expected, atol=1e-5, rtol=0)
    assert not moved[..., :2].any()
    step = effect.rest(points[:, 0])
    for t in range(40):
        now = Context(seen.dt_s[:, t])
        step, shifted = effect.step(step, points[:, t], now)
        torch.testing.assert_close(shifted, moved[:, t], atol=1e-5, rtol=0)
    assert len(hypothesis_of(known_effects()["breathing"]).candidates(FACTS, points)) == 134
    assert effect.plausible()


OLD = """
import torch
from surgisoft.surrogate.effects import Memoryless, Quantity


class Old(Memoryless):
    stage = "material"
    side_by_side = False
    needs_reversals = True
    settled_form = True

    def __init__(self, facts, bend=1.0):
        super().__init__(facts)
        self.loss = torch.nn.Parameter(torch.zeros(1))
        self.bend = torch.nn.Parameter(torch.tensor([float(bend)]))

    def strengths(self):
        return {"loss": self.loss}

    def shapes(self):
        return super().shapes()

    def columns(self, signal, memory):
        return -self.bend.detach() * signal[None]

    def apply(self, signal, memory):
        return signal - self.loss * self.bend * signal

    def config(self):
        return {}

    def quantities(self):
        return [Quantity("loss_share", float(self.loss.detach()), "", 0.0, 1.0, "")]

    @classmethod
    def candidates(cls, facts, points):
        return [cls(facts, bend) for bend in (1.0, 2.0)]
"""
"""An effect with the names of methods and the class attributes of earlier versions."""


def test_an_effect_with_the_names_of_before_still_works(tmp_path):
    (tmp_path / "old.py").write_text(OLD)
    register_effect_file(tmp_path / "old.py")
    effect = make_effect("old", FACTS)
    assert effect.amplitudes() == {"loss": effect.loss}
    assert effect.nonlinear_parameters() == {"bend": effect.bend} == effect.shapes()
    x = torch.tensor([[2.0, 3.0, 4.0]])
    assert torch.equal(effect.sensitivities(x, effect.rest(x)), -x[None])
    stated = hypothesis_of(effect)
    assert (stated.needs_reversals, stated.exact_form) == (True, True)
    tried = stated.candidates(FACTS, torch.zeros(1, 5, 3))
    assert [float(one.bend.detach()) for one in tried] == [1.0, 2.0]
    assert stated.further(FACTS, torch.zeros(1, 5, 3)) == []
    assert stated.combinations(tried) == []


def test_without_a_hypothesis_an_effect_is_tried_as_it_is(slack):
    register_effect_file(slack)
    stated = hypothesis_of(known_effects()["slack"])
    (tried,) = stated.candidates(FACTS, torch.zeros(1, 5, 3))
    assert not tried.loss.any()
    assert stated.combinations([tried, tried]) == [[0, 1]]
    assert (stated.needs_reversals, stated.exact_form) == (False, False)


def test_a_file_states_its_hypothesis_beside_the_effect(slack):
    """The documentation's second snippet behind its first."""
    slack.write_text(EXAMPLE + SECOND.replace("Slack, grid", "Slack, grid, exact_form=True"))
    register_effect_file(slack)
    stated = hypothesis_of(known_effects()["slack"])
    assert stated.exact_form
    assert len(stated.candidates(FACTS, torch.zeros(1, 5, 3))) == 1


def test_opening_a_model_runs_no_code_of_it(slack, tmp_path):
    register_effect_file(slack)
    saved, folder = arm(), tmp_path / "model"
    save_model(saved, folder)
    user_defined.FILES.clear()
    with pytest.raises(
        InputError, match=r"slack\.py, which opening a model does not run.*--effect-file .*slack"
    ):
        load_model(folder)
    assert not user_defined.FILES
    slack.write_text(EXAMPLE + "\n# changed\n")
    register_effect_file(slack)
    with pytest.raises(InputError, match=r"not the file that its effect 'slack' was made with"):
        load_model(folder)
    slack.write_text(EXAMPLE)
    register_effect_file(slack)
    dp = torch.tensor([[-5.0, 3.0, 30.0]])
    one, other = (m.step(m.initial_state(), dp, 0.1)[1] for m in (saved, load_model(folder)))
    assert torch.equal(one, other)


def test_a_model_is_saved_with_the_file_that_its_effect_came_from(slack, tmp_path):
    """Its formula is not the one of the edited file that was named since."""
    register_effect_file(slack)
    saved = arm()
    edited = EXAMPLE.replace("clamp(max=0)", "clamp(min=0)")
    assert edited != EXAMPLE
    slack.write_text(edited)
    register_effect_file(slack)
    save_model(saved, tmp_path / "model")
    with pytest.raises(InputError, match="not the file that its effect 'slack' was made with"):
        load_model(tmp_path / "model")
    slack.write_text(EXAMPLE)
    opened = load_model(tmp_path / "model", effect_files=[slack])
    pressure = torch.tensor([[-5.0, 3.0, 30.0]])
    one, other = (m.step(m.initial_state(), pressure, 0.1)[1] for m in (saved, opened))
    assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("creep.py", EXAMPLE, "an effect 'creep' exists already"),
        ("network.py", EXAMPLE, "'network' has another meaning in a model"),
        ("direction.py", EXAMPLE, "'direction' has another meaning in a model"),
        ("pressure.py", EXAMPLE, "'pressure' has another meaning in a model"),
        ("auto.py", EXAMPLE, "'auto' has another meaning in a model"),
        ("my-effect.py", EXAMPLE, "plain name"),
        ("empty.py", "x = 1", "expected one complete Effect in the file, found none"),
        ("broken.py", "1 / 0", r"does not run \(ZeroDivisionError"),
        ("exits.py", "import sys; sys.exit(3)", r"does not run \(SystemExit"),
        ("lost.py", EXAMPLE.replace('"material"', '"muscle"'), "expected a 'stage' of line"),
        (
            "half.py",
            EXAMPLE.replace("def apply", "def applied"),
            "found Slack, which lacks 'apply'$",
        ),
    ],
)
def test_a_bad_file_is_refused_in_one_line_and_leaves_nothing(tmp_path, name, text, complaint):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=complaint):
        register_effect_file(tmp_path / name)
    assert not user_defined.FILES


def test_two_files_of_one_name_are_refused(slack, tmp_path):
    """The second would take the place of the first; one file by two paths is one."""
    other = tmp_path / "other" / "slack.py"
    other.parent.mkdir()
    other.write_text(EXAMPLE)
    message = f"{other}: {slack} is an effect 'slack', too, expected files of different names"
    with pytest.raises(InputError, match=re.escape(message)):
        register_effect_files([slack, other])
    assert not user_defined.FILES
    with pytest.raises(InputError, match=re.escape(message)):
        named_effects(["creep", str(slack), str(other)])
    assert not user_defined.FILES
    register_effect_files([slack, other.parent / ".." / "slack.py"])
    assert user_defined.FILES["slack"].path == str(slack)


WRONG = [
    ("self.loss *", "self.los *", r": raised AttributeError in slack.py line \d+: .*'los'"),
    (
        "(signal - self.origin)",
        "(signal - self.origin)[..., :1].expand(9, 9, 9)",
        ": raised Runtim",
    ),
    ("return signal -", "return 0.9 * signal -", ": it changes the signal at zero amplitude"),
    ("return signal -", "return signal[..., :2] * 1 -", ": raised RuntimeError|'apply' returned"),
    (".clamp(max=0)", ".log()", r": '(apply|sensitivities)' returned values that are not finite"),
    (
        "self.loss *",
        "self.loss.detach() *",
        ": the derivative of its result by the amplitude 'loss' is zero at zero, though the result",
    ),
    ('{"loss": self.loss}', "{}", ": 'amplitudes' returned {}, expected at least one parameter"),
    ("return {}", 'return {"a": 1}', ": raised TypeError: .*'a'"),
    ("self.loss.detach()", "self.lost.detach()", r": raised AttributeError in slack.py line \d+"),
    ("torch.zeros(1)", "torch.zeros(facts.rooms)", r": raised AttributeError in slack.py line \d+"),
]
"""What replaces what in the documentation's effect, and what is said of it."""


@pytest.mark.parametrize(("old", "new", "message"), WRONG, ids=[each[1] for each in WRONG])
def test_what_an_effect_does_wrong_is_told_before_it_is_used(slack, old, new, message):
    register_effect_file(slack)
    check_user_effects(FACTS)
    check_user_effects(FACTS, ["slack"])
    assert old in EXAMPLE
    slack.write_text(EXAMPLE.replace(old, new))
    register_effect_file(slack)
    for tried in (False, True):
        with pytest.raises(InputError, match=message) as error:
            check_user_effects(FACTS, tried=tried)
        assert str(error.value).startswith(f"{slack}: ")
        assert str(error.value).endswith("; correct the effect")
    check_user_effects(FACTS, ["creep"])


def test_a_fit_and_a_diagnosis_check_an_effect_before_the_work(slack, tmp_path):
    """No epoch of the fit is done, and no output folder is made."""
    slack.write_text(EXAMPLE.replace("return signal -", "return 0.9 * signal -"))
    recording = VirtualRig(0).record(make_protocol("ramps", VirtualRig(0).limits, 90, seed=2))[0]
    stages = []
    with pytest.raises(InputError, match="it changes the signal at zero amplitude"):
        fit(recording, effects=[str(slack)], progress=lambda *told: stages.append(told))
    assert not stages
    with pytest.raises(InputError, match="it changes the signal at zero amplitude"):
        diagnose(default_arm(), recording)


def test_every_effect_of_the_package_passes_the_check_of_users_effects():
    for name, kind in EFFECTS.items():
        for tried in (False, True):
            check_effect(kind, FACTS, name, tried=tried)


def test_a_missing_file_is_refused():
    with pytest.raises(InputError, match="no such file"):
        named_effect("nowhere/slack.py")


def test_installed_packages_offer_effects_and_hide_none_of_ours(monkeypatch):
    value = "surgisoft.surrogate.effects.creep:Creep"
    entries = {name: EntryPoint(name, value, user_defined.GROUP) for name in ("seep", "hysteresis")}
    monkeypatch.setattr(user_defined, "offered", lambda: entries)
    assert known_effects()["seep"].__name__ == "Creep"
    assert known_effects()["hysteresis"].__name__ == "Hysteresis"
    assert type(make_effect("seep", FACTS)).__name__ == "Creep"
    wrong = EntryPoint("seep", "surgisoft.errors:InputError", user_defined.GROUP)
    monkeypatch.setattr(user_defined, "offered", lambda: {"seep": wrong})
    with pytest.raises(InputError, match="expected a subclass of"):
        make_effect("seep", FACTS)


@pytest.mark.parametrize("raised", ["GeneratorExit()", "type('Odd', (BaseException,), {})('no')"])
def test_a_file_that_raises_no_exception_is_one_line(tmp_path, raised):
    """What derives from BaseException alone passes `except Exception`."""
    (tmp_path / "odd.py").write_text(f"raise {raised}")
    with pytest.raises(InputError, match=r"odd.py: does not run \((GeneratorExit|Odd)"):
        register_effect_file(tmp_path / "odd.py")
    assert "odd" not in user_defined.FILES


def test_ctrl_c_in_a_file_is_ctrl_c(tmp_path):
    (tmp_path / "slow.py").write_text("raise KeyboardInterrupt")
    with pytest.raises(KeyboardInterrupt):
        register_effect_file(tmp_path / "slow.py")
