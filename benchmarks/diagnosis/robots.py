"""Robots of the diagnosis benchmark: base models and recordings.

Base models are fitted once for a robot and then deformed on purpose, by a smooth change of their
weights, to a wanted validated error.
"""

import copy
import math
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from benchmarks.diagnosis.cases import EXCITATIONS, KNOWN, Case
from surgisoft.diagnosis.design.schedules import Setup
from surgisoft.measurement.histories import arm_spec, history_of
from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.rig import VirtualRig
from surgisoft.rig.virtual import MOUNT
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.fit import FitConfig, fit
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training import Data, model_rows, validated_error

GRID_POINTS = 4096
"""Number of steady-state samples to which a base model is fitted."""


def base_model(
    robot: int, folder: Path, undertrained: bool = False, prior: str | None = "none"
) -> ArmModel:
    """Fitted model of a robot, stored in a folder between uses.

    prior: its prior mean, as `FitConfig` takes it; None: that of `fit` by default.
    """
    kind = "-default" * (prior is None) + "-undertrained" * undertrained
    place = folder / f"robot-{robot}{kind}"
    if (place / "config.json").is_file():
        return load_model(place)
    rig = VirtualRig(robot)
    train, _ = rig.record(make_protocol("grid", rig.limits, GRID_POINTS, seed=robot))
    valid, _ = rig.record(make_protocol("validation", rig.limits, None, seed=robot))
    config = FitConfig(effects=("hysteresis",), prior=prior, seed=robot)
    if undertrained:
        config = replace(config, epochs=10)
    result = fit(history_of([train]), history_of([valid]), arm_spec([train]), config)
    folder.mkdir(parents=True, exist_ok=True)
    save_model(result.model, place, result.report(), force=True, known=result.known)
    return load_model(place)


@lru_cache(maxsize=16)
def validation_of(robot: int) -> History:
    """Steady-state samples on which the models of a robot are validated."""
    rig = VirtualRig(robot)
    valid, _ = rig.record(make_protocol("validation", rig.limits, None, seed=robot))
    return history_of([valid])


@torch.no_grad()
def measured_on(arm: ArmModel, history: History, seed: int) -> History:
    """The same actuation with the key points that an arm model predicts, and cameras' noise."""
    points = arm.predict(history)
    generator = torch.Generator().manual_seed(seed)
    size = history.noise_mm or 0.0
    noise = size * torch.randn(points.shape, generator=generator)
    seen = torch.isfinite(history.key_points)
    return replace(history, key_points=torch.where(seen, points + noise, history.key_points))


def bent(
    model: ArmModel, robot: int, wanted_mm: float, seed: int, arm: ArmModel | None = None
) -> ArmModel:
    """Copy of the model with a smooth static error, so that its validated error is `wanted_mm`.

    arm: the model that is the arm itself; default: the arm is that of the virtual rig.
    """
    history = validation_of(robot)
    if arm is not None:
        history = measured_on(arm, history, robot)
    generator = torch.Generator().manual_seed(seed)
    noise = {
        name: torch.randn(value.shape, generator=generator) * value.std()
        for name, value in model.network.layers.state_dict().items()
        if name.endswith("weight")
    }
    low, high, deformed = 0.0, 0.5, model
    for _ in range(12):
        middle = 0.5 * (low + high)
        deformed = copy.deepcopy(model)
        with torch.no_grad():
            for name, value in deformed.network.layers.named_parameters():
                if name in noise:
                    value.add_(middle * noise[name])
        rows = Data(history, history, None).validation_rows(deformed)
        found = validated_error(rows.target, model_rows(deformed, rows))
        deformed.validation = replace(found, noise_mm=model.validation.noise_mm)
        if found.rmse_mm < wanted_mm:
            low = middle
        else:
            high = middle
    return deformed


@dataclass(frozen=True, eq=False)
class Recorded:
    """Recordings of a case."""

    recording: Recording
    """Recording with the hidden effects."""
    plain: Recording
    """Recording of the same arm, schedule and noise without hidden effects."""
    effect_mm: float
    """RMS change of the key points by the hidden effects, mm."""


def record(case: Case) -> Recorded:
    """Record a case's schedule on its robot, with and without the hidden effects."""
    protocol, points = EXCITATIONS[case.excitation]
    both = []
    for hidden in dict.fromkeys([case.hidden, ()]):
        rig = VirtualRig(case.robot, noise=_noise(case), take=case.take, hidden=hidden)
        plan = make_protocol(protocol, rig.limits, points, seed=case.take)
        recording, truth = rig.record(plan)
        both.append((_as_noisy(case, recording), truth.noise_free_mm))
    (recording, shape), (plain, before) = both[0], both[-1]
    change = np.square(shape - before).sum(2)
    return Recorded(recording, plain, float(np.sqrt(np.nanmean(change))))


EXPERIMENT_TAKE = 500_000
"""Added to a case's trial number, so that a later recording has other noise."""


def record_experiment(case: Case, setting: Setup, protocol: Protocol) -> Recording:
    """Record a schedule on a case's robot after a change of the experimental setup.

    Where the change removes a hidden effect, that effect is switched off.
    """
    stays = [each for each in case.hidden if KNOWN.get(each[0]) not in setting.removes]
    rig = VirtualRig(
        case.robot,
        noise=_noise(case),
        take=case.take + EXPERIMENT_TAKE,
        hidden=stays,
        gravity=setting.gravity(MOUNT),
        payload_g=setting.payload_g,
    )
    return _as_noisy(case, rig.record(protocol)[0])


def _noise(case: Case) -> float:
    return 3.0 if case.noise == "loud" else 1.0


def _as_noisy(case: Case, recording: Recording) -> Recording:
    """The recording with the noise that a case adds to that of the rig."""
    if case.noise != "correlated":
        return recording
    return _with_correlated_noise(recording, case.take)


def _with_correlated_noise(recording: Recording, seed: int) -> Recording:
    """0.05 mm more in each coordinate, as an autoregressive process of 4 s."""
    rng = np.random.default_rng([seed, zlib.crc32(b"correlated")])
    points = recording.key_points_mm.copy()
    keep = math.exp(-0.05 / 4.0)
    drive = rng.normal(0.0, 0.05 * math.sqrt(1 - keep**2), points.shape)
    walk = np.zeros_like(points)
    for t in range(1, len(points)):
        walk[t] = keep * walk[t - 1] + drive[t]
    noise = recording.noise_mm
    return replace(
        recording,
        key_points_mm=points + walk,
        noise_mm=None if noise is None else math.hypot(noise, 0.05),
    )
