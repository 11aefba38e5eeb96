"""The models in examples/: closed forms, and a comparison with a recording of the rig."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import surgisoft
from surgisoft.measurement.protocols import make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.callables import named

EXAMPLES = Path(__file__).resolve().parents[1] / "examples" / "models"


def opened(name: str):
    return opened_file(EXAMPLES / f"{name}.py")


def opened_file(file: Path):
    spec = importlib.util.spec_from_file_location(f"example_{file.stem}", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def _nothing_named(monkeypatch):
    monkeypatch.setattr(named, "NAMED", {})
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.fixture(scope="module")
def bench():
    rig = VirtualRig(0, take=7)
    return rig.record(make_protocol("mixed", rig.limits, 600, seed=2))[0]


def walked(bend, length, steps=20_000):
    """Tip of an arc, mm, by walking along its tangent."""
    share = (np.arange(steps) + 0.5) / steps
    angle = np.linalg.norm(bend) * share
    plane = np.asarray(bend) / np.linalg.norm(bend)
    across = np.sin(angle).mean() * length
    return np.array([*(across * plane), np.cos(angle).mean() * length])


def test_the_arc_is_that_of_its_tangent():
    pcc = opened("pcc")
    values = json.loads((EXAMPLES / "pcc.json").read_text())
    pressure = np.array([[30.0, 5.0, 12.0]])
    arm = pcc.ConstantCurvatureArm(values)
    bend = np.array(values["bend_rad_per_kPa"]) @ pressure[0] + values["bend_at_rest_rad"]
    length = values["length_mm"] + np.array(values["stretch_mm_per_kPa"]) @ pressure[0]
    np.testing.assert_allclose(arm(np.zeros(1), pressure)[0, -1], walked(bend, length), atol=1e-5)
    straight = dict(values, bend_at_rest_rad=[0.0, 0.0])
    tip = pcc.ConstantCurvatureArm(straight)(np.zeros(1), np.zeros((1, 3)))[0, -1]
    np.testing.assert_allclose(tip, [0, 0, values["length_mm"]])


def test_a_fit_finds_the_arc_that_made_the_data():
    pcc = opened("pcc")
    values = json.loads((EXAMPLES / "pcc.json").read_text())
    pressure = np.random.default_rng(0).uniform(-10, 50, (200, 3))
    points = pcc.ConstantCurvatureArm(values)(np.zeros(200), pressure)
    found = pcc.ConstantCurvatureArm(pcc.fitted(pressure, points))(np.zeros(200), pressure)
    np.testing.assert_allclose(found, points, atol=1e-3)


def test_the_arc_is_compared_with_the_rig(bench):
    """The example's parameters are those of the rig's first robot: 1.2 mm of 70 mm are left."""
    name = f"{EXAMPLES / 'pcc.py'}:arm"
    found, table = surgisoft.compare(name, bench, part="training", error_mm=1.2)
    assert 0.6 < found.rmse_mm < 1.8
    assert table.model.network.form == "static"


def test_the_rod_bends_to_an_arc_and_sags_as_a_cantilever(bench):
    pytest.importorskip("elastica", reason="PyElastica is not installed (extra `elastica`)")
    example = opened("elastica_rod")
    free = example.ElasticaRod(weight_N=0.0, stretch_per_kPa=0.0, elements=12)
    pressure = np.array([40.0, 0.0, 10.0])
    tip = free.at_rest(pressure)[-1]
    np.testing.assert_allclose(tip, walked(free.bend @ pressure, 70.0), atol=0.02 * 70)
    # Euler-Bernoulli: w L^3 / (8 E I) for the weight w of the whole rod, across it.
    weight, stiffness = 0.01, 115e3
    across = example.ElasticaRod(
        weight_N=weight, gravity=(1.0, 0.0, 0.0), stiffness_kPa=stiffness / 1e3, elements=12
    )
    second = np.pi / 4 * 0.0075**4
    sag = 1e3 * weight * 0.07**3 / (8 * stiffness * second)
    assert across.at_rest(np.zeros(3))[-1, 0] == pytest.approx(sag, rel=0.15)
    # A coarse grid is a model as any other.
    coarse = example.ElasticaRod(levels=2, elements=6)
    found, _ = surgisoft.compare(coarse, bench, part="training", error_mm=3.0)
    assert 0.5 < found.rmse_mm < 8


def test_the_endoscope_learns_from_pictures_that_show_the_lesion(monkeypatch):
    """Its expert finds the lesion, whose place differs; the network gets pictures alone of it."""
    example = opened_file(EXAMPLES.parent / "endoscope_from_images.py")
    monkeypatch.setattr(example, "STEPS", 21)
    monkeypatch.setattr(example, "LATE_STEP", 20)
    env = surgisoft.batched_env(example.scene_task(), 2, 0)
    data, error, view = example.run(env, 0, lambda _p, _m, expert: expert, blank=False)
    pictures, measured, expert = data
    assert error < 3.0
    assert view > 0.9
    net = example.Eye(measured.shape[1], 3)
    assert net(pictures, measured).shape == expert.shape == (42, 3)
    first, second = pictures[-2:].float()
    assert (first - second).abs().mean() > 1.0, "another lesion is another picture"
