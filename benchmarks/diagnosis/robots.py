"""The robots of the diagnosis benchmark: their base models, and what is recorded of them.

Base models are fitted once for a specimen and then bent on purpose, by a smooth change of their
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
"""Settled points that a base model is fitted to."""


def base_model(robot: int, folder: Path, undertrained: bool = False) -> ArmModel:
    """The fitted model of a specimen, kept in a folder between uses."""
    place = folder / f"robot-{robot}{'-undertrained' if undertrained else ''}"
    if (place / "config.json").is_file():
        return load_model(place)
    rig = VirtualRig(robot)
    train, _ = rig.record(make_protocol("grid", rig.limits, GRID_POINTS, seed=robot))
    valid, _ = rig.record(make_protocol("validation", rig.limits, None, seed=robot))
    config = FitConfig(effects=("hysteresis",), seed=robot)
    if undertrained:
        config = replace(config, epochs=10)
    result = fit(history_of([train]), history_of([valid]), arm_spec([train]), config)
    folder.mkdir(parents=True, exist_ok=True)
    save_model(result.model, place, result.report(), force=True, known=result.known)
    return load_model(place)


@lru_cache(maxsize=16)
def validation_of(robot: int) -> History:
    """The settled points that a specimen's models are validated on."""
    rig = VirtualRig(robot)
    valid, _ = rig.record(make_protocol("validation", rig.limits, None, seed=robot))
    return history_of([valid])


def bent(model: ArmModel, robot: int, wanted_mm: float, seed: int) -> ArmModel:
    """The model with a smooth static error, so that its validated error is `wanted_mm`."""
    history = validation_of(robot)
    generator = torch.Generator().manual_seed(seed)
    noise = {
        name: torch.randn(value.shape, generator=generator) * value.std()
        for name, value in model.network.layers.state_dict().items()
        if name.endswith("weight")
    }
    low, high, answer = 0.0, 0.5, model
    for _ in range(12):
        middle = 0.5 * (low + high)
        answer = copy.deepcopy(model)
        with torch.no_grad():
            for name, value in answer.network.layers.named_parameters():
                if name in noise:
                    value.add_(middle * noise[name])
        rows = Data(history, history, None).validation_rows(answer)
        found = validated_error(rows.target, model_rows(answer, rows))
        answer.validation = replace(found, noise_mm=model.validation.noise_mm)
        if found.rmse_mm < wanted_mm:
            low = middle
        else:
            high = middle
    return answer


@dataclass(frozen=True, eq=False)
class Recorded:
    """What was recorded of a case."""

    recording: Recording
    """With what is hidden."""
    plain: Recording
    """The same arm, schedule and noise with nothing hidden: what no bench could record."""
    effect_mm: float
    """RMS change of the key points by what is hidden, mm."""


def record(case: Case) -> Recorded:
    """Play a case's schedule on its robot, with and without what is hidden."""
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
"""Added to a case's take: the noise of a later recording is another."""


def record_experiment(case: Case, setting: Setup, protocol: Protocol) -> Recording:
    """A schedule played on a case's robot after a change of the bench.

    Where that takes something away, the hidden effect that it takes away is switched off.
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
    """The recording with what a case adds to the rig's own noise."""
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
