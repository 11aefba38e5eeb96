"""Parts of the validation uncertainty against hand computation and refits."""

import dataclasses

import numpy as np
import pytest
import torch

from surgisoft.credibility.context import Uncertainty
from surgisoft.credibility.uncertainty import (
    budget,
    input_uncertainty,
    parameter_spread,
    with_midpoints,
)
from surgisoft.diagnosis.residuals import residual_table
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.effects import ArmFacts, make_effect
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawEnsemble, HawNN
from surgisoft.surrogate.training_residuals import TrainingResiduals

REST = torch.tensor([[0.0, 0.0, 20.0], [0.0, 0.0, 60.0]])
NOISE_MM = 0.05


def recording(rows: int = 240, seed: int = 0, **more) -> Recording:
    """Two chambers between 1 and 9, key points at rest with white noise, as stated."""
    rng = np.random.default_rng(seed)
    pressure = 5.0 + 4.0 * np.sin(np.outer(np.arange(rows) / 15.0, [1.0, 1.7]))
    points = REST.numpy() + rng.normal(0.0, NOISE_MM, (rows, 2, 3))
    given = {"name": "rec", "noise_mm": NOISE_MM} | more
    return Recording(t_s=0.1 * np.arange(rows), measured=pressure, key_points_mm=points, **given)


def model(network) -> ArmModel:
    spec = ArmSpec(2, 2, (0.0, 0.0), (10.0, 10.0), band=(0.1, 0.1))
    return ArmModel(spec, network, rest_mm=REST).eval().requires_grad_(False)


def linear_network(slope_mm: float) -> HawNN:
    """The tip's x is slope (p_1 - 5) to first order: SiLU is x / 2 near zero."""
    torch.manual_seed(0)
    network = HawNN(torch.zeros(2), torch.full((2,), 10.0), 2, hidden=(1,), directions=False)
    with torch.no_grad():
        for layer in (network.layers[0], network.layers[2]):
            layer.weight.zero_()
            layer.bias.zero_()
        network.layers[0].weight[0, 0] = 5e-3  # of (p - 5) / 5
        network.layers[2].weight[3, 0] = slope_mm * 5.0 / (0.5 * 5e-3)
        network.mean.copy_(REST.flatten())
    return network


def test_inputs_go_through_the_slope_and_noise_has_three_coordinates():
    """The tip moves by 2 mm/kPa with chamber 1: 0.1 kPa are 0.2 mm; chamber 2 does nothing."""
    some = [recording()]
    table = residual_table(model(linear_network(2.0)), some)
    found = budget(table, some, Uncertainty(input=(0.1, 0.5), parameters_mm=0.3))
    base, tip = found.per_key_point
    assert tip.input_mm == pytest.approx(0.2, rel=1e-3)
    assert base.input_mm == 0.0
    assert tip.noise_mm == pytest.approx(np.sqrt(3.0) * NOISE_MM)
    assert tip.parameters_mm == pytest.approx(0.3)
    assert tip.numerical_mm == pytest.approx(0.0, abs=1e-9)
    whole = np.sqrt(3 * NOISE_MM**2 + 0.2**2 + 0.3**2)
    assert tip.expanded_mm == pytest.approx(1.959964 * whole, rel=1e-3)
    assert found.body.input_mm == pytest.approx(0.2 / np.sqrt(2.0), rel=1e-3)


def test_a_sensor_that_is_off_was_off_before_the_recording_too():
    """An arm that follows in an hour and has stood for long: 2 mm/kPa at once in every row."""
    rest = torch.zeros(2)
    facts = ArmFacts(rest, torch.full((2,), 10.0), rest, REST)
    lag = make_effect("line_lag", facts, up_s=3600.0, down_s=3600.0, dead_s=1e-4, turn=1e6)
    lag.amplitudes()["share"].data.fill_(1.0)
    slow = model(linear_network(2.0)).replace(effects={"line_lag": lag})
    some = [dataclasses.replace(recording(), measured=np.full((240, 2), 5.0))]
    found = budget(residual_table(slow, some), some, Uncertainty(input=(0.1,)))
    assert found.per_key_point[1].input_mm == pytest.approx(0.2, rel=1e-3)


def test_steps_of_time_are_as_uncertain_as_halving_them_says():
    """A lag of 0.5 s on a ramp of 0.5 kPa/s: held commands lag by a r h / (1 - a), a = e^(-h/tau).

    From rest the gap to the limit decays by a in each step of h, whether in one or in two.
    """
    tau_s, rate, h_s, count = 0.5, 0.5, 0.1, 200
    ramp = np.zeros((count, 2))
    ramp[:, 0] = rate * h_s * np.arange(count)
    some = [dataclasses.replace(recording(count), measured=ramp)]
    rest = torch.zeros(2)
    facts = ArmFacts(rest, torch.full((2,), 10.0), rest, REST)
    lag = make_effect("line_lag", facts, up_s=tau_s, down_s=tau_s, dead_s=1e-4, turn=1e6)
    lag.amplitudes()["share"].data.fill_(1.0)
    arm = model(linear_network(2.0)).replace(effects={"line_lag": lag.requires_grad_(False)})

    def lag_kPa(step_s):
        kept = np.exp(-step_s / tau_s)
        return kept * rate * step_s / (1.0 - kept)

    grown = 1.0 - np.exp(-h_s * np.arange(count) / tau_s)
    change_mm = 2.0 * (lag_kPa(h_s / 2.0) - lag_kPa(h_s)) * grown
    found = budget(residual_table(arm, some), some, Uncertainty(input=(0.1,)))
    base, tip = found.per_key_point
    expected = 1.5 * np.sqrt(np.mean(change_mm**2))
    assert expected == pytest.approx(1.5 * 2.0 * rate * h_s / 4.0, rel=0.1), "to first order"
    assert tip.numerical_mm == pytest.approx(expected, rel=2e-3)
    assert base.numerical_mm == pytest.approx(0.0, abs=1e-6)


def test_stated_noise_counts_and_one_input_stands_for_all():
    some = [recording()]
    table = residual_table(model(linear_network(2.0)), some)
    found = budget(table, some, Uncertainty(noise_mm=0.4, input=(0.2,)))
    assert found.per_key_point[1].noise_mm == pytest.approx(0.4 * np.sqrt(3.0))
    assert found.inputs == (0.2, 0.2)
    assert found.body.unknown == ("parameters",)
    assert found.sources["parameters"].startswith("not known")
    with pytest.raises(InputError, match="3 values, expected one for all or one for each of 2"):
        budget(table, some, Uncertainty(input=(0.1, 0.1, 0.1)))


def test_of_several_recordings_the_worst_sensors_count_and_commands_are_exact():
    """The scatter of each recording at rest; a model of commands has none."""
    some = []
    for seed, sigma in enumerate((0.02, 0.2)):
        noise = np.random.default_rng(seed).normal(0.0, sigma, (240, 2))
        held = np.repeat(np.arange(8) % 3, 30)[:, None] * [1.0, 2.0] + 2.0
        some.append(
            dataclasses.replace(recording(name=f"r{seed}"), measured=held + noise, commanded=held)
        )
    arm = model(linear_network(2.0))
    found, source = input_uncertainty(arm, some, Uncertainty())
    assert found == pytest.approx([0.2, 0.2], rel=0.2)
    assert source.startswith("scatter at rest")
    by_command = arm.replace(spec=dataclasses.replace(arm.spec, actuation="commanded"))
    found, source = input_uncertainty(by_command, some, Uncertainty())
    assert found.tolist() == [0.0, 0.0]
    assert source == "commands, taken as exact"


def test_only_rows_that_were_measured_count():
    """The tip moves by 2 mm/kPa in any row, of which it was seen in every second one."""
    some = [recording()]
    some[0].key_points_mm[::2, 1] = np.nan
    found = budget(
        residual_table(model(linear_network(2.0)), some), some, Uncertainty(input=(0.1,))
    )
    assert found.per_key_point[1].input_mm == pytest.approx(0.2, rel=1e-3)


def test_a_direction_that_the_network_does_not_use_makes_it_no_surer():
    torch.manual_seed(1)
    network = HawNN(torch.zeros(2), torch.full((2,), 10.0), 2, hidden=(6,), directions=True)
    network.use.copy_(torch.tensor([1.0, 0.0]))
    rng = np.random.default_rng(0)
    actuation = torch.from_numpy(rng.uniform(0.0, 10.0, (300, 2))).float()
    residual = torch.from_numpy(rng.normal(0.0, 0.2, (300, 2, 3)))
    signs = torch.from_numpy(rng.choice([-1.0, 1.0], (300, 2))).float()
    spreads = []
    for column in (0, 1):
        arm, direction = model(network), signs.clone()
        direction[:, column] = 1.0
        arm.training_residuals = TrainingResiduals(actuation, direction, residual)
        spreads.append(parameter_spread(residual_table(arm, [recording(40)]), Uncertainty())[0])
    arm.training_residuals = TrainingResiduals(actuation, signs, residual)
    whole = parameter_spread(residual_table(arm, [recording(40)]), Uncertainty())[0]
    assert np.allclose(spreads[1], whole, rtol=1e-6), "the second direction is not used"
    assert not np.allclose(spreads[0], whole, rtol=0.05)


def test_the_spread_of_an_ensemble_is_that_of_its_members():
    """Two members 0.6 mm apart in y have a standard deviation of 0.6 / sqrt(2)."""
    low, high = torch.zeros(2), torch.full((2,), 10.0)
    network = HawEnsemble(low, high, 2, hidden=(2,), directions=False, members=2)
    network.biases[-1].data[1, 0, 4] = 0.6
    table = residual_table(model(network), [recording()])
    spread, source = parameter_spread(table, Uncertainty())
    assert np.allclose(spread[0, :, 1, 1], 0.6 / np.sqrt(2.0))
    assert np.allclose(spread[0, :, 0], 0.0)
    assert "ensemble" in source


def test_the_last_layer_is_as_uncertain_as_refits_say():
    """Refits of the last layer to the training rows with fresh noise scatter as much."""
    torch.manual_seed(1)
    network = HawNN(torch.zeros(2), torch.full((2,), 10.0), 2, hidden=(6,), directions=False)
    network.layers[0].weight.data.mul_(3.0)
    rng = np.random.default_rng(0)
    actuation = torch.from_numpy(rng.uniform(0.0, 10.0, (300, 2))).float()
    residual = torch.from_numpy(rng.normal(0.0, 0.2, (300, 2, 3)))
    arm = model(network)
    arm.training_residuals = TrainingResiduals(actuation, torch.zeros(300, 2), residual)
    some = recording(40)
    spread, _ = parameter_spread(residual_table(arm, [some]), Uncertainty())

    def features(values):
        x = (torch.as_tensor(values).float() - 5.0) / 5.0
        hidden = network.layers[:-1](x).double().detach().numpy()
        return np.concatenate([hidden, np.ones((len(hidden), 1))], axis=1)

    base, here = features(actuation), features(some.measured)
    fits = np.linalg.lstsq(base, rng.normal(0.0, 0.2, (300, 2000)), rcond=None)[0]
    assert np.allclose(spread[0, :, 1, 0], (here @ fits).std(axis=1), rtol=0.1)


def test_midpoints_lie_between_rows_of_one_run():
    run = np.array([0, 0, 0, 1, 1])
    points = np.zeros((5, 2, 3))
    pressure = np.array([[0.0, 4.0], [1.0, 4.0], [3.0, 4.0], [9.0, 0.0], [5.0, 0.0]])
    some = Recording(
        "rec",
        np.array([0.0, 1.0, 2.0, 7.0, 9.0]),
        pressure,
        points,
        run=run,
        commanded=2 * pressure,
        temp_C=np.array([20.0, 21.0, 22.0, 30.0, 32.0]),
        payload_g=np.array([0.0, 0.0, 4.0, 5.0, 5.0]),
    )
    fine, own = with_midpoints(some)
    assert own.tolist() == [True, False, True, False, True, True, False, True]
    assert fine.t_s.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 7.0, 8.0, 9.0]
    assert fine.measured[:, 0].tolist() == [0.0, 0.5, 1.0, 2.0, 3.0, 9.0, 7.0, 5.0]
    assert fine.commanded[1].tolist() == [1.0, 8.0]
    assert fine.run.tolist() == [0, 0, 0, 0, 0, 1, 1, 1]
    assert fine.temp_C.tolist() == [20.0, 20.5, 21.0, 21.5, 22.0, 30.0, 31.0, 32.0]
    assert fine.payload_g.tolist() == [0.0, 0.0, 0.0, 2.0, 4.0, 5.0, 5.0, 5.0]
    assert np.isnan(fine.key_points_mm[~own]).all()
    settled = dataclasses.replace(some, kind="settled")
    assert with_midpoints(settled)[0] is settled
