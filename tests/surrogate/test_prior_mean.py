"""The prior mean: it recovers constant-curvature arms, and adds bends that were recorded singly."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate import prior_mean
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.compiled_step import CompiledStep
from surgisoft.surrogate.effects import make_effect
from surgisoft.surrogate.fit import FitConfig, fit
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.model import ArmModel, arm_facts
from surgisoft.surrogate.networks import ArcChain, HawEnsemble, HawNN
from surgisoft.surrogate.prior_mean import arcs_of, fit_arcs, fit_prior_mean
from surgisoft.surrogate.training import Data, JointTraining, train_jointly
from tests.surrogate.truth import SPEC, history, walk

LOW, HIGH = torch.zeros(2), torch.full((2,), 50.0)
TWO = ArmSpec(2, 3, (0.0, 0.0), (50.0, 50.0), band=(0.5, 0.5))
LENGTHS = (80.0, 60.0)
BENDS = (1.1, -0.9)


def arm(pressure: np.ndarray) -> np.ndarray:
    """(T, 3, 3) base, middle and tip, mm, of two planar arcs of angle BENDS p / 50, by hand.

    Plane geometry: an arc of length L and angle a goes L sin(a) / a along and L (1 - cos a) / a
    across the direction in which it starts.
    """
    place, heading = np.zeros((len(pressure), 2)), np.zeros(len(pressure))
    points = [place]
    for number, (length, bend) in enumerate(zip(LENGTHS, BENDS, strict=True)):
        angle = bend * pressure[:, number] / 50 + 1e-9
        along, across = length * np.sin(angle) / angle, length * (1 - np.cos(angle)) / angle
        step = np.stack(
            [
                along * np.sin(heading) + across * np.cos(heading),
                along * np.cos(heading) - across * np.sin(heading),
            ],
            axis=1,
        )
        place, heading = place + step, heading + angle
        points.append(place)
    flat = np.stack(points, axis=1)
    return np.stack([flat[..., 0], np.zeros(flat.shape[:2]), flat[..., 1]], axis=-1)


def one_by_one() -> np.ndarray:
    """Each chamber alone up and down: never both at once."""
    sweep = np.concatenate([np.linspace(0, 50, 60), np.linspace(50, 0, 60)])
    still = np.zeros_like(sweep)
    return np.concatenate([np.stack([sweep, still], 1), np.stack([still, sweep], 1)])


def recorded(pressure: np.ndarray):
    times = torch.arange(len(pressure)) * 0.1
    return pack([times], [torch.tensor(pressure)], [torch.tensor(arm(pressure))])


def test_bends_recorded_one_by_one_give_the_arm_of_both():
    seen = recorded(one_by_one())
    assert arcs_of(seen.rows(seen.key_points)) == 2, "the base does not move"
    prior = ArcChain(LOW, HIGH, 3, 2)
    fit_prior_mean(prior, seen, torch.tensor(arm(np.zeros((1, 2)))[0]).float())
    fit_arcs(prior, seen.rows(seen.pressure), seen.rows(seen.key_points), iterations=500)
    both = np.random.default_rng(0).uniform(0, 50, (200, 2))
    with torch.no_grad():
        error = prior(torch.tensor(both).float()) - torch.tensor(arm(both))
    assert float(error.norm(dim=-1).max()) < 0.6, "of a motion of 100 mm: the ridge's bias"


def test_a_long_recording_is_thinned_from_its_begin_to_its_end():
    """3200 rows: chamber 1 moves in the first half, chamber 2 in the second one."""
    steps = 25.0 * (1.0 - np.cos(np.arange(1600) / 40.0))
    pressure = np.zeros((3200, 2))
    pressure[:1600, 0], pressure[1600:, 1] = steps, steps
    prior = ArcChain(LOW, HIGH, 3, 2)
    rest = torch.tensor(arm(np.zeros((1, 2)))[0])
    fit_prior_mean(prior, recorded(pressure), rest.float())
    with torch.no_grad():
        left = prior(torch.tensor(pressure[1600:]).float()).numpy() - arm(pressure[1600:])
    assert np.linalg.norm(left, axis=-1).max() < 3.0, "of a motion of 80 mm"


def test_a_chamber_that_hardly_moved_gets_no_bend_of_its_own():
    """Chamber 2 moves by a hundredth of its range, along with noise of the markers."""
    rng = np.random.default_rng(1)
    pressure = np.stack([rng.uniform(0, 50, 300), rng.uniform(0, 0.5, 300)], 1)
    points = arm(pressure * [1, 0]) + rng.normal(0, 1.0, (300, 3, 3))
    seen = pack([torch.arange(300) * 0.1], [torch.tensor(pressure)], [torch.tensor(points)])
    prior = ArcChain(LOW, HIGH, 3, 2)
    fit_prior_mean(prior, seen, torch.tensor(arm(np.zeros((1, 2)))[0]).float())
    assert float(prior.table[:, :2, 1].detach().abs().max()) < 0.1


def test_the_fit_is_the_minimum_of_the_documented_sum(monkeypatch):
    """mean |left|^2 + v (ridge |bends|^2 + stretch_ridge |stretches|^2 + offset_ridge |offsets|^2),
    v the mean squared motion: no step of a parameter makes it less. Steady terms cost nothing.
    The ridges are large here."""
    ridge, stretch_ridge, offset_ridge = 0.3, 3.0, 0.7
    monkeypatch.setattr(prior_mean, "RIDGE", ridge)
    monkeypatch.setattr(prior_mean, "STRETCH_RIDGE", stretch_ridge)
    monkeypatch.setattr(prior_mean, "OFFSET_RIDGE", offset_ridge)
    rng = np.random.default_rng(2)
    pressure = rng.uniform(0, 50, (60, 2))
    points = 1.1 * arm(pressure) + rng.normal(0, 2.0, (60, 3, 3)) + [0.0, 3.0, 0.0]
    points[::7, 1] = np.nan
    prior = ArcChain(LOW, HIGH, 3, 2)
    prior.set_rest(torch.tensor(arm(np.zeros((1, 2)))[0]).float())
    fit_arcs(prior, torch.tensor(pressure), torch.tensor(points), iterations=100)
    seen = np.isfinite(points)
    count = seen.sum() / 3
    motion = np.nansum((points - np.nanmean(points, 0)) ** 2) / count

    def total():
        with torch.no_grad():
            left = (points - prior(torch.tensor(pressure)).numpy())[seen]
            own = prior.table[..., :-1].numpy()
        held = ridge * (own[:, :2] ** 2).sum() + stretch_ridge * (own[:, 2] ** 2).sum()
        held += offset_ridge * (prior.offset.detach().numpy() ** 2).sum()
        return (left**2).sum() / count + motion * held

    prior.double()
    least = total()
    for parameter in prior.parameters():
        flat = parameter.data.view(-1)
        for k, value in enumerate(flat.tolist()):
            for step in (-1e-3, 1e-3):
                flat[k] = value + step
                assert total() > least * (1.0 - 1e-7), (parameter.shape, k)
            flat[k] = value


def test_a_marker_off_its_arc_turns_with_the_arcs_end():
    """A quarter circle in x and z: an offset along x points down the z axis at its end."""
    prior = ArcChain(LOW, HIGH, 2, 1)
    prior.set_rest(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 100.0]]))
    with torch.no_grad():
        prior.table[0, 0, -1] = math.pi / 2.0
        prior.offset[0] = torch.tensor([0.1, 0.0, 0.0])  # in lengths of an arc
    radius = 100.0 / (math.pi / 2.0)
    expected = torch.tensor([[0.0, 0.0, 0.0], [radius, 0.0, radius - 10.0]])
    assert torch.allclose(prior(torch.full((1, 2), 25.0))[0], expected, atol=1e-3)


def test_an_arm_at_rest_along_any_axis_is_recovered():
    """The base is turned by 0.7 rad: the first arc starts along the measured first step."""
    turn = 0.7
    frame = torch.tensor(
        [
            [math.cos(turn), 0, math.sin(turn)],
            [0, 1, 0],
            [-math.sin(turn), 0, math.cos(turn)],
        ]
    )
    straight = torch.tensor(arm(np.zeros((1, 2)))[0]).float() @ frame.T + 5.0
    prior = ArcChain(LOW, HIGH, 3, 2)
    prior.set_rest(straight)
    assert torch.allclose(prior(torch.zeros(1, 2))[0], straight, atol=1e-3)


def test_without_a_fixed_base_one_arc_more_is_added():
    points = torch.randn(100, 3, 3) * 30
    assert arcs_of(points) == 3
    still = points.clone()
    still[:, 0] = 0.01 * still[:, 0]
    assert arcs_of(still) == 2
    rest = torch.tensor([[0.0, 0, 50], [0, 0, 110], [0, 0, 160]])
    prior = ArcChain(LOW, HIGH, 3, 3)
    prior.set_rest(rest)
    assert prior.base_mm.tolist() == pytest.approx([0, 0, -10])
    assert torch.allclose(prior(torch.zeros(1, 2))[0], rest, atol=1e-3)


def test_the_network_adds_to_its_prior_mean():
    torch.manual_seed(0)
    network = HawNN(LOW, HIGH, 3, (8,), arcs=2)
    network.prior.set_rest(torch.tensor([[0.0, 0, 0], [0, 0, 80], [0, 0, 140]]))
    network.prior.table.data.normal_()
    pressure, direction = torch.rand(9, 2) * 50, torch.ones(9, 2)
    plain = HawNN(LOW, HIGH, 3, (8,))
    plain.load_state_dict(network.state_dict(), strict=False)
    expected = plain(pressure, direction) + network.prior(pressure)
    assert torch.allclose(network(pressure, direction), expected, atol=1e-4)
    ensemble = HawEnsemble.of([network, network])
    assert torch.allclose(ensemble(pressure, direction), expected, atol=1e-4)
    assert torch.allclose(ensemble.each(pressure, direction)[1], expected, atol=1e-4)


def test_actuation_in_another_unit_makes_an_arm_ten_times_as_long_and_no_longer():
    """A chamber that stretches the arm by a twentieth at 50 kPa, asked with the same number of Pa:
    exp(1000 * 0.05) is no length, and its key points would be no numbers in single precision."""
    prior = ArcChain(LOW, HIGH, 3, 2)
    prior.set_rest(torch.tensor([[0.0, 0.0, 20.0 * k] for k in range(3)]))
    with torch.no_grad():
        prior.table[:, 2, 0] = 0.025
        asked = torch.tensor([[25.0, 25.0], [50.0, 25.0], [1e6, 25.0], [-1e6, 25.0]])
        tip = prior(asked)[:, -1]
    expected = 40.0 * np.array([1.0, np.exp(0.025), 10.0, 0.1])
    np.testing.assert_allclose(tip[:, 2].numpy(), expected, rtol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 15.0])
@pytest.mark.parametrize(("key_points", "arcs"), [(2, 2), (3, 2), (6, 5)])
@pytest.mark.parametrize("effects", [(), ("hysteresis",)])
def test_the_compiled_step_adds_the_same_arcs(key_points, arcs, effects, scale):
    """scale: actuation over its range; beyond it the arcs do not get longer without limit."""
    random = torch.Generator().manual_seed(arcs)
    spec = ArmSpec(2, key_points, (0.0, 0.0), (50.0, 50.0), band=(0.5, 0.5))
    rest = torch.tensor([[0.0, 0.0, 20.0 * (k + key_points - arcs)] for k in range(key_points)])
    rest = rest - rest[0] * (arcs < key_points)
    made = {name: make_effect(name, arm_facts(spec, rest)) for name in effects}
    network = HawNN(LOW, HIGH, key_points, hidden=(8,), arcs=arcs)
    network.prior.set_rest(rest)
    with torch.no_grad():
        for values in network.prior.parameters():
            values += 0.4 * torch.randn(values.shape, generator=random)
        for values in network.layers.parameters():
            values.copy_(torch.randn(values.shape, generator=random))
    model = ArmModel(spec, network, made, rest).eval().requires_grad_(False)
    compiled = CompiledStep.of(model)
    state, alone = model.initial_state(7), model.initial_state(1)
    pressure = np.zeros((1, 2), np.float32)
    lone = compiled.alone(alone, pressure)
    for _ in range(5):
        ahead = 50.0 * scale * torch.rand(7, 2, generator=random)
        found = compiled(state, ahead)[1]
        pressure[:] = ahead[:1].numpy()
        lone.step()
        state, expected = model.step(state, ahead - state.pressure, 0.05)
        assert network.prior(ahead).abs().max() > 10.0
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-4)
        torch.testing.assert_close(torch.tensor(lone.points_mm), expected[:1], rtol=1e-5, atol=1e-4)


def test_a_fit_with_prior_mean_round_trips_and_extrapolates(tmp_path):
    """On motions that only the test has, the prior mean leaves less than half the error."""
    rng = np.random.default_rng(3)
    singly = []
    for chamber in range(3):
        path = np.tile(SPEC.rest, (150, 1))
        path[:, chamber] = walk(150, rng)[:, chamber]
        singly += [path, path[::-1].copy()]
    train, test = history(singly, 0.0), history([walk(300, rng)], 0.0, seed=9)
    config = FitConfig(hidden=(32, 32), epochs=20, inputs="pressure", batch=128)
    errors = {}
    for prior in ("none", "arcs"):
        result = fit(train, None, SPEC, replace(config, prior=prior))
        error = (result.model.predict(test) - test.key_points).norm(dim=-1)
        errors[prior] = float(error.square().mean().sqrt())
    assert errors["arcs"] < 0.5 * errors["none"]
    save_model(result.model, tmp_path / "arm")
    again = load_model(tmp_path / "arm")
    assert torch.equal(again.predict(test), result.model.predict(test))


def test_a_network_has_a_prior_mean_unless_none_is_asked_for():
    train, how = recorded(one_by_one()), {"hidden": (8,), "epochs": 10, "inputs": "pressure"}
    for prior, network, arcs in (
        (None, "haw_nn", 2),
        ("arcs", "haw_nn", 2),
        ("none", "haw_nn", 0),
    ):
        result = fit(train, None, TWO, FitConfig(prior=prior, network=network, **how))
        assert result.model.network.arcs == arcs
        said = [line for line in result.lines() if line.startswith("prior mean: a chain of arcs")]
        assert len(said) == (arcs > 0)
    baseline = fit(train, None, TWO, FitConfig(network="constant_curvature", epochs=10)).model
    assert baseline.network.sections == 1


def test_key_points_that_are_no_chain_are_fitted_without_a_prior_mean():
    """Two markers in one place at rest: the default leaves the arcs out, and who asks is told."""
    seen, how = recorded(one_by_one()), {"hidden": (8,), "epochs": 10, "inputs": "pressure"}
    twice = seen.key_points.clone()
    twice[..., 2, :] = twice[..., 1, :]
    train = replace(seen, key_points=twice)
    result = fit(train, None, TWO, FitConfig(**how))
    assert result.model.network.arcs == 0
    assert any("coincide at rest" in one and "without one" in one for one in result.warnings)
    with pytest.raises(InputError, match="two key points coincide at rest"):
        fit(train, None, TWO, FitConfig(prior="arcs", **how))


def test_impossible_chains_are_refused():
    with pytest.raises(InputError, match="4 arcs for 3 key points"):
        ArcChain(LOW, HIGH, 3, 4)
    prior = ArcChain(LOW, HIGH, 3, 2)
    with pytest.raises(InputError, match="coincide"):
        prior.set_rest(torch.zeros(3, 3))


def test_models_without_a_prior_mean_are_as_before():
    assert default_arm().network.prior is None


def test_arcs_that_do_worse_on_held_out_runs_are_left_out():
    """Held-out runs of an arm that does what a network makes of chambers that were recorded one by
    one: another network is nearer to it than arcs are."""
    rng = np.random.default_rng(8)
    train, how = recorded(one_by_one()), {"hidden": (32, 32), "epochs": 40, "inputs": "pressure"}
    asked = recorded(rng.uniform(0, 50, (300, 2)))
    network = fit(train, None, TWO, FitConfig(prior="none", seed=5, **how)).model
    valid = replace(asked, key_points=network.predict(asked))
    fits = {
        prior: fit(train, valid, TWO, FitConfig(prior=prior, **how))
        for prior in (None, "arcs", "none")
    }
    error = {prior: one.model.validation.rmse_mm for prior, one in fits.items()}
    assert error["none"] < 0.9 * error["arcs"], "else arcs do no worse"
    assert fits[None].model.network.arcs == 0
    assert error[None] == error["none"]
    assert any("prior mean left out" in one for one in fits[None].warnings)


def test_training_together_with_effects_leaves_the_prior_mean_as_it_is():
    train, how = recorded(one_by_one()), {"hidden": (8,), "epochs": 10, "inputs": "pressure"}
    model = fit(train, None, TWO, FitConfig(prior="arcs", **how)).model
    arcs, layers = (copy.deepcopy(part.state_dict()) for part in model_parts(model))
    train_jointly(model, Data.split(train, None, 0), 2, JointTraining())
    now_arcs, now_layers = (part.state_dict() for part in model_parts(model))
    assert all(torch.equal(value, now_arcs[name]) for name, value in arcs.items())
    assert any(not torch.equal(value, now_layers[name]) for name, value in layers.items())


def model_parts(model):
    """Prior mean and layers of a model's network."""
    return model.network.prior, model.network.layers
