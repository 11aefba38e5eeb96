"""Every mode of the chain's walk agrees with every other, for every registered effect."""

from dataclasses import replace

import pytest
import torch

from surgisoft.surrogate import chain
from surgisoft.surrogate.chain import Holding, RepeatedScan, Signal, context_of, memory_at
from surgisoft.surrogate.effects import (
    STAGES,
    Memoryless,
    effect_class,
    hypothesis_of,
    make_effect,
)
from surgisoft.surrogate.effects.drift import Drift
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature
from tests.surrogate.effects.test_in_models import ALL, history, model

SETS = pytest.mark.parametrize("names", [(), *((name,) for name in ALL), ALL], ids="+".join)
EACH = pytest.mark.parametrize("name", ALL)


@pytest.fixture(scope="module")
def away():
    """Runs of which the first begins away from rest."""
    stood = torch.tensor([[30.0, 25.0, 20.0], [0.0, 0.0, 0.0]])
    return replace(history(2, 40), stood=stood)


def stepped(arm: ArmModel, seen) -> list:
    """(state, key points (R, n, 3)) after each row, one step a row."""
    state = arm.first_state(arm.first_pressure(seen))
    rows = []
    for t in range(seen.pressure.shape[1]):
        dp = seen.pressure[:, t] - state.pressure
        state, points = arm.step(state, dp, seen.dt_s[:, t], seen.temperature_C[:, t])
        rows.append((state, points))
    return rows


@SETS
def test_steps_end_where_a_scan_does(names, away):
    """Key points, directions and memories row by row, also of runs that begin away from rest."""
    arm = model(names)
    assert arm.first_pressure(away)[0].all()
    taps = arm.chain.scan(away, arm.first_pressure(away))
    predicted = arm.predict(away)
    assert torch.equal(taps.behind["sensor"], predicted)
    for t, (state, points) in enumerate(stepped(arm, away)):
        assert torch.allclose(points, predicted[:, t], atol=2e-3)
        assert torch.equal(state.direction, taps.direction[:, t])
        assert state.memory.keys() == taps.memory.keys() == set(names)
        for name, memory in state.memory.items():
            # A drift's elapsed time is that of the recording, and the sum of steps in a world.
            assert torch.allclose(memory, taps.memory[name][:, t], rtol=1e-4, atol=2e-3), name


@SETS
def test_taps_are_what_each_stage_sees(names, away):
    """The signal behind each stage, from its effects one by one as their files give them."""
    arm = model(names)
    taps = arm.chain.scan(away, arm.first_pressure(away))
    start = arm.first_state(arm.first_pressure(away)).memory
    signal, context = away.pressure, context_of(away)
    for stage in ("line", "material", "body", "sensor"):
        if stage == "body":
            signal = arm.network(signal, taps.direction)
        for name, effect in arm.stage(stage):
            memory = effect.scan(start[name], signal, context)
            assert torch.equal(memory, taps.memory[name])
            signal = effect.apply(signal, memory)
        if stage == "line":
            context = replace(context, pressure=signal)
            assert torch.equal(signal, taps.pressure)
        assert torch.equal(signal, taps.behind[stage])
    trace = arm.trace(away)
    assert torch.equal(trace.behind["material"], taps.behind["material"])
    held = arm.shape(trace.pressure, trace.direction, trace.memory)
    assert torch.equal(held, arm.network(taps.behind["material"], taps.direction))
    for name, _ in arm.stage("material"):
        before, after = arm.chain.around(name, taps)
        assert torch.equal(arm.effects[name].apply(before, taps.memory[name]), after)


@SETS
def test_the_state_before_the_first_row_is_the_one_that_its_taps_belong_to(names, away):
    """An arm that stands still for no time, from that state, sees what the taps say."""
    arm = model(names)
    chain, first = arm.chain, arm.first_pressure(away)
    state, seen = chain.standing(first)
    assert torch.equal(state.pressure, first)
    start = Signal(first)
    held = chain.walk(
        start, _Held(state), chain.links[: len(chain.inner) - len(arm.stage("material"))]
    )
    assert torch.equal(held.value, seen.held["line"])
    points = chain.walk(start, _Held(state), chain.links).value
    assert torch.allclose(points, seen.held["sensor"], atol=1e-4)


def test_a_wall_of_the_body_has_followed_where_a_run_begins_away_from_rest(away):
    """Creep for ten seconds of holding, and the lag of friction; one that is added too."""
    plain = model(())
    first = plain.first_pressure(away)
    before = plain.chain.standing(first)[1]
    resting, held = before.resting["body"], before.held["body"]
    creep = make_effect("creep", plain.facts, body=True)
    followed = plain.replace(effects={"creep": creep}).first_state(first).memory["creep"]
    strain = creep.pull(held) - creep.pull(resting)
    assert float(strain[0].abs().max()) > 0.1
    expected = strain.unsqueeze(-1) * -torch.expm1(-10.0 / creep.times)
    assert torch.allclose(followed[..., :-1], expected, atol=1e-6)
    assert torch.equal(plain.chain.first_memory(creep, before, held, first), followed)
    rubbing = make_effect("hysteresis", plain.facts, radii=(0.01,), body_rad=1.0)
    plays = plain.replace(effects={"hysteresis": rubbing}).first_state(first).memory["hysteresis"]
    inputs = rubbing.inputs(held), rubbing.inputs(resting)
    lagging = torch.maximum(inputs[0] - 0.01, torch.minimum(inputs[0] + 0.01, inputs[1]))
    assert torch.allclose(plays[..., 0], lagging, atol=1e-6)


class _Held(Holding):
    """Memories and directions of a state."""

    def __init__(self, state):
        super().__init__(state.memory)
        self.state = state

    def direction(self, chain, chamber):
        return self.state.direction


@SETS
@pytest.mark.parametrize("begin", ["start", "last"])
def test_a_repeated_scan_is_the_prediction_on_its_rows(names, begin, away):
    """From the first link, and from the last effect on; after its parameters have changed, too."""
    arm = model(names)
    keys = set(names) if begin == "start" else set(list(arm.effects)[-1:])

    def rows(tensor):
        return away.rows(tensor)[::7]

    repeated = RepeatedScan(arm.chain, away, arm.first_pressure(away), keys, rows)
    assert torch.allclose(repeated(), rows(arm.predict(away)), atol=1e-4)
    for name in keys:
        for parameter in arm.effects[name].amplitudes().values():
            parameter.mul_(1.3)
    assert torch.allclose(repeated(), rows(arm.predict(away)), atol=1e-4)


@EACH
def test_sensitivities_are_finite_differences_of_the_prediction(name, away):
    """Of an effect added behind the others of its stage and of the stages before, in float64."""
    points = away.rows(model(()).predict(away))
    kind = effect_class(name)
    tried = hypothesis_of(kind).candidates(model(()).facts, points)
    effect = tried[len(tried) // 2].double()
    others = {"line_lag": 0, "creep": 1, "payload": 2, "misalignment": 3}
    arm = model(
        [other for other, at in others.items() if at <= STAGES.index(effect.stage)]
    ).double()
    seen = replace(away, pressure=away.pressure.double(), stood=away.stood.double())
    first = arm.first_pressure(seen)
    taps, at_rest = arm.chain.scan(seen, first), arm.chain.standing(first)[1]
    at = taps.behind[effect.stage]
    before = arm.chain.first_memory(effect, at_rest, at[:, 0], first)
    context = replace(context_of(seen), pressure=taps.pressure)
    memory = seen.rows(effect.scan(before, at, context))
    material = seen.rows(taps.behind["material"]), seen.rows(taps.direction).double()
    slope = arm.chain.network_slope(*material)
    found = arm.chain.sensitivities(effect, seen.rows(at), memory, slope)
    place, size = 0, 1e-4
    for parameter in effect.amplitudes().values():
        for number in range(min(parameter.numel(), 3)):
            sides = []
            for step in (size, -size):
                parameter.data.view(-1)[number] = step
                more = arm.replace(effects={**arm.effects, "added": effect})
                sides.append(seen.rows(more.predict(seen)))
                parameter.data.view(-1)[number] = 0.0
            measured = (sides[0] - sides[1]) / (2 * size)
            expected = found[place + number]
            assert measured.abs().max() > 0
            assert (measured - expected).norm() <= 1e-4 * measured.norm()
        place += parameter.numel()
    assert place == len(found)


def test_the_networks_slope_is_the_jacobian_of_each_row():
    """Against `torch.autograd.functional.jacobian` of one row at a time, for static networks."""
    arm = model(())
    curved = ConstantCurvature(*(torch.tensor(x) for x in (arm.spec.low, arm.spec.high)), 5)
    curved.set_rest(arm.rest_mm)
    torch.nn.init.normal_(curved.table, std=0.3)
    generator = torch.Generator().manual_seed(2)
    at = 40 * torch.rand(6, 3, generator=generator)
    direction = torch.ones(6, 3)
    for network in (arm.network, curved):
        chain = arm.replace(network=network).chain
        rows = [
            torch.autograd.functional.jacobian(lambda x, d=d, of=network: of(x, d), x)
            for x, d in zip(at, direction, strict=True)
        ]
        assert torch.allclose(chain.network_slope(at, direction), torch.stack(rows), atol=1e-6)


def test_a_replaced_part_is_new_and_all_others_are_shared():
    arm = model(("creep", "payload"))
    spec = replace(arm.spec, gravity=None)
    other = arm.replace(spec=spec, effects={"creep": arm.effects["creep"]})
    assert other.spec is spec
    assert list(other.effects) == ["creep"]
    assert other.effects["creep"] is arm.effects["creep"]
    assert other.network is arm.network
    assert other.validation is arm.validation
    assert torch.equal(other.rest_mm, arm.rest_mm)
    assert not other.training
    assert list(arm.effects) == ["creep", "payload"]


def test_an_arm_that_begins_away_from_rest_has_stood_for_ten_seconds():
    """Creep has followed for that time; a lag of the line has died away, however slow it is."""
    arm = model(("line_lag", "creep"))
    arm.effects["line_lag"].log_up.data.fill_(2.0)
    arm.effects["line_lag"].log_down.data.fill_(2.0)
    first = torch.tensor([[30.0, 25.0, 20.0]])
    stood = arm.first_state(first).memory
    assert torch.equal(stood["line_lag"], arm.effects["line_lag"].rest(first))
    plain = arm.replace(effects={"creep": arm.effects["creep"]})
    for seconds, same in ((10.0, True), (30.0, False)):
        rested = plain.initial_state(1)
        time = torch.tensor([seconds])
        state, _ = plain.step(rested, first - rested.pressure, time, torch.tensor([20.0]))
        assert torch.allclose(stood["creep"], state.memory["creep"], rtol=1e-4) is same


def test_a_chamber_that_never_moved_in_the_data_stays_where_it_was(away):
    """A model that knows the second chamber at 20 alone ignores what it is told of it."""
    arm = model(("line_lag", "hysteresis", "creep"))
    still = arm.replace(spec=replace(arm.spec, idle=(None, 20.0, None)))
    plain = replace(away, stood=None)
    pressure = plain.pressure.clone()
    pressure[..., 1] += 15.0 * torch.rand(pressure.shape[:2], generator=torch.manual_seed(0))
    moved = replace(plain, pressure=pressure)
    assert torch.equal(still.predict(moved), still.predict(plain))
    taps = still.chain.scan(moved, still.first_pressure(moved))
    assert (taps.pressure[..., 1] == 20.0).all()
    assert (arm.predict(moved) - arm.predict(plain)).abs().max() > 0.1


def test_a_drift_of_the_actuation_begins_with_the_recording(away):
    """The time for which an arm is assumed to have been held before is no time of the recording."""
    plain = model(())
    drift = Drift(plain.facts, kind="actuation", tau_s=20.0)
    drift.gain.data.fill_(0.3)
    arm = plain.replace(effects={"drift": drift})
    seen = replace(away, t_s=away.t_s - away.t_s[:, :1])
    with torch.no_grad():
        expected = arm.predict(seen)
        for t, (_, points) in enumerate(stepped(arm, seen)):
            torch.testing.assert_close(points, expected[:, t], atol=1e-3, rtol=0.0)
        assert (expected - plain.predict(seen)).abs().max() > 0.1


@pytest.mark.parametrize("rows", [7, 100], ids=["parts of runs", "whole runs"])
@SETS
def test_long_recordings_are_followed_in_blocks_with_the_same_result(
    names, rows, away, monkeypatch
):
    """Every row, a scan that is repeated, and the memory on some rows alone."""
    arm, asked = model(names), torch.tensor([3, 17, 44, 79])
    first = arm.first_pressure(away)
    wide = replace(away, **{k: v.repeat(3, *[1] * (v.ndim - 1)) for k, v in _tensors(away).items()})
    long = first.repeat(3, 1)

    def some(tensor):
        return wide.rows(tensor)[asked]

    def followed():
        with torch.no_grad():
            taps = arm.chain.scan(wide, long)
            again = RepeatedScan(arm.chain, wide, long, set(names), some)()
            bare = arm.chain.scan(wide, long, memories=False)
            inputs = arm.chain.inputs(wide, long)
            kept.append(set(bare.memory))
            for n in (n for n, e in arm.effects.items() if e.stage == "material"):
                pairs = arm.chain.around(n, taps), arm.chain.followed_around(n, wide, long)
                for told, followed in zip(*pairs, strict=True):
                    assert torch.allclose(told, followed, atol=2e-5), n
                assert not torch.equal(*pairs[1])
            seen = {n: taps.behind[e.stage] for n, e in arm.effects.items()}
            context = replace(context_of(wide), pressure=taps.pressure)
            there = {
                n: memory_at(e, taps.memory[n][:, 0], seen[n], context, some)
                for n, e in arm.effects.items()
            }
        found = {"points": taps.behind["sensor"], "again": again, **taps.memory}
        found |= {"bare": bare.behind["sensor"], "actuation": inputs[0], "direction": inputs[1]}
        assert torch.allclose(bare.behind["sensor"], taps.behind["sensor"], atol=2e-4)
        assert torch.allclose(inputs[0], taps.behind["material"], atol=2e-5)
        return found, there

    kept: list[set[str]] = []
    whole, at_once = followed()
    monkeypatch.setattr(chain, "BLOCK_ROWS", rows)
    blocks, in_turn = followed()
    assert kept == [set(names), set()]
    for one, other in ((whole, blocks), (at_once, in_turn)):
        assert one.keys() == other.keys()
        for name, values in one.items():
            assert torch.allclose(values, other[name], rtol=1e-5, atol=2e-4), name


@SETS
def test_one_long_run_beside_short_ones_is_followed_as_each_alone(names, away, monkeypatch):
    """Runs are followed in groups of similar length, without the padding behind a group."""
    arm = model(names)
    lengths = torch.tensor([4, 40, 1, 5, 9, 17, 3, 2])
    which = torch.arange(len(lengths)) % away.runs
    mixed = away.select(which)
    last = (lengths - 1)[:, None, None]
    rows = torch.arange(40).expand(len(lengths), 40)
    valid = rows < lengths[:, None]
    pressure = mixed.pressure.where(
        valid[..., None], mixed.pressure.gather(1, last.expand(-1, 1, mixed.chambers))
    )
    points = mixed.key_points.where(valid[..., None, None], torch.nan)
    mixed = replace(mixed, valid=valid, pressure=pressure, key_points=points)
    assert [(sorted(lengths[runs].tolist()), steps) for runs, steps in mixed.groups] == [
        ([40], 40), ([9, 17], 17), ([3, 4, 5], 5), ([1, 2], 2),
    ]  # fmt: skip
    first = arm.first_pressure(mixed)
    monkeypatch.setattr(chain, "BLOCK_ROWS", 50)
    with torch.no_grad():
        taps = arm.chain.scan(mixed, first)
        bare = arm.chain.scan(mixed, first, memories=False)
        again = RepeatedScan(arm.chain, mixed, first, set(names), mixed.rows)()
        inputs = arm.chain.inputs(mixed, first)
        context = replace(context_of(mixed), pressure=taps.pressure)
        there = {
            n: memory_at(e, taps.memory[n][:, 0], taps.behind[e.stage], context, mixed.rows, mixed)
            for n, e in arm.effects.items()
        }
        plain = {
            n: memory_at(e, taps.memory[n][:, 0], taps.behind[e.stage], context, mixed.rows)
            for n, e in arm.effects.items()
        }
        monkeypatch.setattr(chain, "BLOCK_ROWS", 10**6)
        for run, length in enumerate(lengths.tolist()):
            own = mixed.select(torch.tensor([run]))
            alone = arm.chain.scan(own, first[run : run + 1])
            pairs = {
                "points": (taps.behind["sensor"], alone.behind["sensor"]),
                "bare": (bare.behind["sensor"], alone.behind["sensor"]),
                "actuation": (inputs[0], alone.behind["material"]),
                "direction": (inputs[1], alone.direction),
                **{n: (taps.memory[n], alone.memory[n]) for n in names},
            }
            for name, (together, expected) in pairs.items():
                torch.testing.assert_close(
                    together[run, :length], expected[0], rtol=1e-5, atol=2e-4, msg=name
                )
    torch.testing.assert_close(again, mixed.rows(taps.behind["sensor"]), rtol=1e-5, atol=2e-4)
    for name in names:
        torch.testing.assert_close(there[name], plain[name], rtol=1e-5, atol=2e-4)


def _tensors(seen) -> dict:
    """The fields of a history that hold tensors."""
    return {k: v for k, v in vars(seen).items() if isinstance(v, torch.Tensor)}


def forms(name: str, arm: ArmModel, seen) -> list:
    """One effect of each stage at which identification tries an effect, at amplitudes of 0.1."""
    tried = hypothesis_of(effect_class(name)).candidates(arm.facts, seen.rows(arm.predict(seen)))
    answer = list({effect.stage: effect for effect in tried}.values())
    for effect in answer:
        for parameter in effect.amplitudes().values():
            parameter.data.fill_(0.1)
        effect.requires_grad_(False)
    return answer


@EACH
def test_a_repeated_scan_follows_again_what_its_memory_depends_on(name, away, monkeypatch):
    """Not what a changed amplitude leaves as it was; the prediction is that of a fresh scan."""
    for effect in forms(name, model(()), away):
        effects = {**model(["hysteresis"]).effects, "own": effect}
        arm = model(()).replace(effects=effects)
        first = arm.first_pressure(away)
        followed = []
        plain = type(effect).scan

        def scan(self, *given, plain=plain, own=effect, followed=followed):
            followed.extend([1] * (self is own))
            return plain(self, *given)

        monkeypatch.setattr(type(effect), "scan", scan)
        repeated = RepeatedScan(arm.chain, away, first, {"own"}, away.rows)
        with torch.no_grad():
            repeated()
            once = len(followed)
            for parameter in effect.amplitudes().values():
                parameter.mul_(1.5)
            now = repeated()
            assert len(followed) == once or isinstance(effect, Memoryless)
            assert torch.equal(now, RepeatedScan(arm.chain, away, first, {"own"}, away.rows)())
            for parameter in effect.memory_parameters():
                followed.clear()
                parameter.add_(0.1)
                now = repeated()
                assert followed or once == 0
                again = RepeatedScan(arm.chain, away, first, {"own"}, away.rows)()
                assert torch.equal(now, again)
        monkeypatch.undo()


def test_gradients_reach_what_a_memory_depends_on_in_every_call(away):
    """A memory that was kept without gradients does not stand in the way of them."""
    arm = model(["line_lag"])
    repeated = RepeatedScan(arm.chain, away, arm.first_pressure(away), {"line_lag"}, away.rows)
    with torch.no_grad():
        repeated()
    lag = arm.effects["line_lag"].requires_grad_(True)
    for _ in range(2):
        lag.zero_grad()
        repeated().square().sum().backward()
        assert float(lag.log_up.grad.abs()) > 0.0


def test_a_held_arm_is_twisted_by_the_load_that_it_is_held_at():
    """Mean load of 30, 25 and 20 in a range whose larger end is 50: 0.5."""
    arm = model(["twist"])
    state, _ = arm.chain.standing(torch.tensor([[30.0, 25.0, 20.0]]))
    reach = torch.maximum(arm.facts.high - arm.facts.rest, arm.facts.rest - arm.facts.low)
    load = ((torch.tensor([30.0, 25.0, 20.0]) - arm.facts.rest) / reach).mean()
    assert float(state.memory["twist"]) == pytest.approx(float(load), rel=1e-6)
    assert float(load) > 0.3
