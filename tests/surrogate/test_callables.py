"""Callables in the place of the network: equal to the arm models that they wrap, in every form."""

import sys

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmState
from surgisoft.surrogate.callables import named
from surgisoft.surrogate.callables.arm import arm_around, arm_by_itself
from surgisoft.surrogate.callables.named import given_callable, is_callable_name, named_callable
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.effects import Context, make_effect
from surgisoft.surrogate.history import History, pack
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature

LOW, HIGH = (-15.0, -15.0, -15.0), (55.0, 55.0, 55.0)


@pytest.fixture(autouse=True)
def _nothing_named(monkeypatch):
    monkeypatch.setattr(named, "NAMED", {})
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.fixture(scope="module")
def arc():
    """A constant-curvature arm of PyTorch with some bend of every chamber."""
    torch.manual_seed(0)
    network = ConstantCurvature(torch.tensor(LOW), torch.tensor(HIGH), 4)
    rest = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 20.0], [0.0, 0.0, 45.0], [0.0, 0.0, 70.0]])
    network.set_rest(rest)
    network.table.data.normal_(std=0.2)
    spec = arm_by_itself(given_callable(Static(None))).spec
    at_rest = network(torch.zeros(1, 3), torch.zeros(1, 3))[0].detach()
    return ArmModel(spec, network, None, at_rest).eval().requires_grad_(False)


class Static:
    """The arc as a static callable."""

    static = True
    low, high = LOW, HIGH

    def __init__(self, model):
        self.model = model

    def __call__(self, time_s, actuation):
        if self.model is None:
            return np.zeros((len(actuation), 4, 3))
        pressure = torch.tensor(actuation)
        network = self.model.network.double()
        points = network(pressure, pressure).numpy()
        network.float()
        return points


class WholeRuns:
    """The default arm, hysteresis and all, as a callable of whole runs."""

    low, high = default_arm().spec.low, default_arm().spec.high
    arm = default_arm()

    def __call__(self, time_s, actuation):
        run = [torch.tensor(x) for x in (time_s, actuation, np.zeros((len(time_s), 5, 3)))]
        with torch.no_grad():
            return self.arm.predict(pack(*([x] for x in run)))[0].double().numpy()


class Steps:
    """The default arm as an object that is stepped: pressures, directions and memory in one row."""

    low, high = WholeRuns.low, WholeRuns.high
    arm = WholeRuns.arm

    def initial_state(self, actuation):
        return self._row(self.arm.initial_state(len(actuation), torch.tensor(actuation).float()))

    def step(self, state, actuation, dt_s):
        rows, memory, at = torch.tensor(state).float(), {}, 9
        for name, value in self.arm.initial_state().memory.items():
            memory[name] = rows[:, at : at + value.numel()].view(len(rows), *value.shape[1:])
            at += value.numel()
        before = ArmState(rows[:, :3], rows[:, 3:6], rows[:, 6:9], memory)
        context = Context(torch.tensor(dt_s).float(), None, None)
        after, points = self.arm.chain.step(before, torch.tensor(actuation).float(), context)
        return self._row(after), points.detach().numpy()

    @staticmethod
    def _row(state):
        parts = [state.pressure, state.anchor, state.direction]
        parts += [value.flatten(1) for value in state.memory.values()]
        return torch.cat(parts, 1).numpy()


def runs(rows: int = 120) -> History:
    """Two runs of ramps of unequal length that begin at rest and reverse."""
    rng = np.random.default_rng(3)
    parts = []
    for length in (rows, rows - 30):
        knots = np.vstack([np.zeros(3), rng.uniform(-10, 50, (6, 3))])
        at = np.linspace(0, 6, length)
        parts.append(np.stack([np.interp(at, np.arange(7), column) for column in knots.T], 1))
    times = [torch.arange(len(p)) * 0.1 for p in parts]
    points = [torch.full((len(p), 5, 3), torch.nan) for p in parts]
    return pack(times, [torch.tensor(p) for p in parts], points)


def around(model, key_points=5):
    return arm_by_itself(given_callable(model))


def test_a_static_callable_is_the_network_that_it_wraps(arc):
    """Key points, their slope by central differences, and gradients through many steps."""
    mine = around(Static(arc))
    torch.manual_seed(1)
    pressure = torch.rand(50, 3) * 60 - 10
    direction = torch.zeros_like(pressure)
    torch.testing.assert_close(
        mine.network(pressure, direction), arc.network(pressure, direction), atol=1e-4, rtol=0
    )
    slope, truth = (m.chain.network_slope(pressure, direction) for m in (mine, arc))
    assert truth.abs().max() > 0.2
    torch.testing.assert_close(slope, truth, atol=2e-4, rtol=0)
    gradients = []
    for model in (mine, arc):
        action = (0.3 * pressure).clone().requires_grad_(True)
        state = model.initial_state(50)
        for _ in range(2):
            state, points = model.step(state, action, 0.1)
        points.square().sum().backward()
        gradients.append(action.grad)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=2e-3, atol=0.05)


def test_batched_gradients_pass_as_inverse_kinematics_takes_them(arc):
    at = torch.full((4, 3), 20.0, requires_grad=True)
    jacobians = []
    for model in (around(Static(arc)), arc):
        tip = model.step(model.initial_state(4), at, 0.1)[1][:, -1]
        each = torch.eye(3)[:, None].expand(-1, 4, -1)
        jacobians.append(torch.autograd.grad(tip, at, each, is_grads_batched=True)[0])
    torch.testing.assert_close(*jacobians, atol=2e-4, rtol=0)


@pytest.mark.parametrize("kind", [WholeRuns, Steps])
def test_a_callable_with_memory_predicts_as_the_arm_that_it_wraps(kind):
    history = runs()
    truth = history.rows(default_arm().predict(history))
    mine = history.rows(around(kind()).predict(history))
    assert truth.std(0).max() > 3
    torch.testing.assert_close(mine, truth, atol=1e-4, rtol=0)


def test_effects_in_front_of_a_callable_act_as_in_front_of_a_network():
    """A payload and a lag around the default arm, and around the callable that wraps it."""
    history, arm = runs(), default_arm()
    points = []
    for model in (arm, around(WholeRuns()), around(Steps())):
        lag = make_effect("line_lag", arm.facts)
        lag.share.data.fill_(1.0)
        load = make_effect("payload", arm.facts)
        load.tip_sag.data.fill_(2.0)
        changed = model.replace(effects={**model.effects, "line_lag": lag, "payload": load})
        with torch.no_grad():
            points.append(history.rows(changed.predict(history)))
    with torch.no_grad():
        assert (points[0] - history.rows(arm.predict(history))).norm(dim=-1).max() > 1
    torch.testing.assert_close(points[1], points[0], atol=1e-3, rtol=0)
    torch.testing.assert_close(points[2], points[0], atol=1e-3, rtol=0)


def test_a_stepped_callable_steps_as_the_arm_does():
    arm, mine = default_arm(), around(Steps())
    states = [model.initial_state(3) for model in (arm, mine)]
    torch.manual_seed(2)
    for _ in range(6):
        change = torch.randn(3, 3) * 4
        (a, first), (b, second) = (
            model.step(state, change, 0.1) for model, state in zip((arm, mine), states, strict=True)
        )
        states = [a, b]
        torch.testing.assert_close(second, first, atol=1e-4, rtol=0)


class Late:
    """A model that follows its actuation late: x by two, y by three times the pressure."""

    low, high = (0.0, 0.0), (10.0, 10.0)

    def initial_state(self, actuation):
        return actuation.copy()

    def step(self, state, actuation, dt_s):
        state = state + 0.3 * (actuation - state)
        return state, np.stack([2 * state[:, :1], 3 * state[:, 1:], 0 * state[:, :1]], -1)


def test_the_methods_of_steps_are_used_in_a_subclass_of_a_static_callable():
    """A third of the way to 10 in the first step: 2 * 3 and 3 * 3 mm."""

    class Subclass(Late):
        static = True

        def __call__(self, time_s, actuation):
            return np.zeros((len(actuation), 1, 3))

    model = around(Subclass())
    points = model.step(model.initial_state(1), torch.tensor([[10.0, 10.0]]), 0.1)[1]
    torch.testing.assert_close(points[0, 0], torch.tensor([6.0, 9.0, 0.0]))


def test_the_slope_of_a_callable_with_memory_is_that_of_an_offset():
    """An offset of the whole run moves the late model by its gain."""
    model = around(Late())
    pressure = torch.rand(200, 2) * 10
    history = pack([torch.arange(200.0)], [pressure], [torch.full((200, 1, 3), torch.nan)])
    first = model.first_pressure(history)
    taps = model.chain.scan(history, first)
    slope = model.chain.slope(history, first, taps, history.rows)[100:]
    expected = torch.tensor([[2.0, 0.0], [0.0, 3.0], [0.0, 0.0]]).expand(100, 1, 3, 2)
    torch.testing.assert_close(slope, expected, atol=1e-4, rtol=0)


def test_a_run_that_begins_away_from_rest_begins_there():
    """A hold at 8 and 4 from the first row on: nothing is left to follow."""
    pressure = torch.tensor([[8.0, 4.0]]).expand(20, 2)
    void = torch.full((20, 1, 3), torch.nan)
    history = pack([torch.arange(20.0)], [pressure], [void], stood=[pressure[0]])
    points = around(Late()).predict(history)[0]
    torch.testing.assert_close(points, torch.tensor([16.0, 12.0, 0.0]).expand(20, 1, 3))


ARM = """
import numpy as np

class Arm:
    static = True
    low, high = (0.0, 0.0), (10.0, 10.0)
    def __call__(self, time_s, actuation):
        tip = np.stack([actuation[:, 0], actuation[:, 1], 0 * actuation[:, 0] + 30.0], -1)
        return np.stack([0 * tip, tip], 1)

arm = Arm()
def broken(time_s, actuation):
    raise RuntimeError("no licence")
def flat(time_s, actuation):
    return actuation
def holes(time_s, actuation):
    return np.full((len(actuation), 2, 3), np.nan)
words = "no model"
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "lab_arm.py").write_text(ARM)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "lab_arm", raising=False)
    return tmp_path


def test_the_code_to_name_is_where_its_file_is(module, monkeypatch):
    """A model saved in `arms/`, beside its file, is opened from the folder above."""
    (module / "arms").mkdir()
    (module / "lab_arm.py").rename(module / "arms" / "lab_arm.py")
    monkeypatch.chdir(module / "arms")
    save_model(load_model("lab_arm.py:arm"), "saved")
    named.NAMED.clear()
    monkeypatch.chdir(module)
    with pytest.raises(InputError, match=r"code, lab_arm\.py:arm") as refused:
        load_model("arms/saved")
    assert "--model-code arms/lab_arm.py:arm (in" in str(refused.value)
    assert load_model("arms/saved", model_code=["arms/lab_arm.py:arm"]).spec.chambers == 2


@pytest.mark.parametrize("name", ["lab_arm:arm", "lab_arm.py:arm", "lab_arm:Arm"])
def test_a_saved_model_opens_once_its_callable_is_named(module, name):
    assert is_callable_name(name)
    model = load_model(name)
    load = make_effect("payload", model.facts)
    load.tip_sag.data.fill_(1.5)
    save_model(model.replace(effects={"payload": load}), "amended")
    named.NAMED.clear()
    with pytest.raises(InputError, match=rf"amended|{name}") as refused:
        load_model("amended")
    assert f"--model-code {name}" in str(refused.value)
    again = load_model("amended", model_code=[name])
    points = again.step(again.initial_state(1), torch.tensor([[4.0, 5.0]]), 0.1)[1]
    plain = model.step(model.initial_state(1), torch.tensor([[4.0, 5.0]]), 0.1)[1]
    torch.testing.assert_close(plain[0, 1], torch.tensor([4.0, 5.0, 30.0]))
    assert 0.5 < (points - plain)[0, 1].norm() < 5


def test_another_file_or_another_arm_is_refused(module):
    for name, said in (("lab_arm.py:arm", "not the file"), ("lab_arm:arm", "at rest 5 mm")):
        (module / "lab_arm.py").write_text(ARM)
        sys.modules.pop("lab_arm", None)
        named.NAMED.clear()
        save_model(load_model(name), "saved", force=True)
        named.NAMED.clear()
        sys.modules.pop("lab_arm", None)
        (module / "lab_arm.py").write_text(ARM.replace("30.0", "35.0   "))
        with pytest.raises(InputError, match=said):
            load_model("saved", model_code=[name])


def tip_mm(name: str) -> list[float]:
    """The tip at 4 and 5 of the arm of a name, mm."""
    model = load_model(name)
    return model.step(model.initial_state(1), torch.tensor([[4.0, 5.0]]), 0.1)[1][0, 1].tolist()


def test_a_file_is_read_again_after_it_was_edited(module, monkeypatch):
    """As in a notebook: the name stays, and the content changes, or the folder."""
    first = load_model("lab_arm.py:arm")
    assert tip_mm("lab_arm.py:arm") == [4.0, 5.0, 30.0]
    same = first.network.named.model
    assert load_model("lab_arm.py:arm").network.named.model is same, "nothing has changed"
    (module / "lab_arm.py").write_text(ARM.replace("30.0", "36.0"))
    assert tip_mm("lab_arm.py:arm") == [4.0, 5.0, 36.0]
    save_model(first, "saved")
    with pytest.raises(InputError, match="not the file that the model was made with"):
        load_model("saved", model_code=["lab_arm.py:arm"])
    (module / "other").mkdir()
    monkeypatch.chdir(module / "other")
    with pytest.raises(InputError, match="no such file"):
        load_model("lab_arm.py:arm")
    (module / "other" / "lab_arm.py").write_text(ARM.replace("30.0", "42.0"))
    assert tip_mm("lab_arm.py:arm") == [4.0, 5.0, 42.0]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("lab_nothing:arm", "cannot be imported"),
        ("lab_arm:nothing", "there is no 'nothing'"),
        ("lab_arm:words", "is a str, expected a callable"),
        ("missing.py:arm", "no such file"),
        ("lab_arm:flat", "does not state its range"),
    ],
)
def test_a_name_that_leads_to_no_model_is_one_line(module, name, said):
    with pytest.raises(InputError, match=said):
        load_model(name)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("broken", r"raised RuntimeError in lab_arm.py line \d+: no licence"),
        ("flat", r"returned shape \(1, 3\), expected \(1, n, 3\) for actuation \(1, 3\)"),
        ("holes", "row 0 are not finite"),
    ],
)
def test_what_a_callable_does_wrong_is_one_line(module, name, said):
    spec = default_arm().spec
    with pytest.raises(InputError, match=said):
        arm_around(named_callable(f"lab_arm:{name}"), spec)


class OneBuffer:
    """A callable that writes every answer of a method into the same array."""

    def __init__(self, model):
        self.model, self.low, self.high = model, model.low, model.high
        self.static = getattr(model, "static", False)
        self.kept = {}

    def _in_place(self, name, answer):
        buffer = self.kept.setdefault(name, np.zeros((1000, *answer.shape[1:])))
        buffer[: len(answer)] = answer
        return buffer[: len(answer)]

    def __call__(self, time_s, actuation):
        return self._in_place("call", self.model(time_s, actuation))


class OneBufferSteps(OneBuffer):
    def initial_state(self, actuation):
        return self._in_place("state", self.model.initial_state(actuation))

    def step(self, state, actuation, dt_s):
        fresh, points = self.model.step(state, actuation, dt_s)
        return self._in_place("state", fresh), self._in_place("points", points)


@pytest.mark.parametrize(
    ("plain", "kind"), [(WholeRuns(), OneBuffer), (Steps(), OneBufferSteps)], ids=["runs", "steps"]
)
def test_a_callable_may_use_its_arrays_again(plain, kind):
    """Two runs, and then the first ones again: no answer changes one that was given before."""
    model, one = around(kind(plain)), around(plain)
    expected = one.predict(runs())
    points = model.predict(runs())
    model.predict(runs(60))
    torch.testing.assert_close(points, expected)
    torch.testing.assert_close(model.predict(runs()), expected)
    state = model.network.state_of(np.zeros((1, 3))) if kind is OneBufferSteps else None
    if state is not None:
        before = state.copy()
        model.network.state_of(np.full((1, 3), 20.0))
        np.testing.assert_array_equal(state, before)


def test_a_callable_may_return_tensors_of_a_graph():
    """As a network that is called without `torch.no_grad`."""
    layer = torch.nn.Linear(3, 12).double()

    class Net(Static):
        def __call__(self, time_s, actuation):
            return layer(torch.tensor(actuation)).view(-1, 4, 3)

    class NetSteps(Net):
        def initial_state(self, actuation):
            return layer.weight[:1, :1] * torch.ones(len(actuation), 1)

        def step(self, state, actuation, dt_s):
            return torch.as_tensor(state) * layer.bias[0], self(dt_s, actuation)

    pressure = torch.tensor([[4.0, 5.0, 6.0]])
    expected = layer(pressure.double()).detach().view(4, 3)
    for model in (around(Net(None), 4), around(NetSteps(None), 4)):
        points = model.step(model.initial_state(1), pressure, 0.1)[1][0]
        torch.testing.assert_close(points.double(), expected, atol=1e-5, rtol=1e-6)


def test_whole_runs_are_not_stepped():
    model = around(WholeRuns())
    with pytest.raises(InputError, match="cannot be stepped"):
        model.step(model.initial_state(2), torch.zeros(2, 3), 0.1)


def test_an_object_without_a_name_cannot_be_saved(tmp_path):
    model = around(Static(None))
    with pytest.raises(InputError, match="under a name"):
        save_model(model, tmp_path / "saved")
    assert not (tmp_path / "saved").exists()


def test_a_callable_is_not_traced_into_a_graph(arc):
    """A trace would keep the numbers of the callable and not its function."""
    model = around(Static(arc))
    with pytest.raises(InputError, match="cannot be written as a graph"):
        torch.jit.trace(lambda p: model.network(p, p), torch.zeros(1, 3))


def test_an_object_that_is_stepped_need_not_be_callable():
    """Key points of an actuation alone, which opening a folder compares, are those of a hold."""
    model = around(Steps())
    pressure = torch.tensor([[20.0, 0.0, 5.0], [0.0, 30.0, 0.0]])
    held = model.network(pressure, pressure, model.network.rest(pressure))
    assert float((held[0] - held[1]).abs().max()) > 5.0
    np.testing.assert_array_equal(model.network(pressure, pressure).numpy(), held.numpy())
