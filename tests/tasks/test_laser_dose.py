"""The dose of an exact reference against closed forms; what is said of too weak a laser."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.agents.session import evaluate
from surgisoft.cli import run
from surgisoft.experiments.session import open_experiment, weak_lasers
from surgisoft.scene.ablation import AblationMap, line_dose_j_per_mm2
from surgisoft.scene.dose_patch import path_patch
from surgisoft.scene.folder import open_scene
from surgisoft.scene.spec import PHANTOM, ContourSpec
from surgisoft.tasks.area_ablation import AreaAblation, AreaAblationConfig
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblation, CircleAblationConfig
from surgisoft.tasks.laser_dose import reference_dose, weak_laser
from surgisoft.tasks.registry import TASKS, make_task
from surgisoft.tasks.world.reach import ring_dose_lacking
from surgisoft.tasks.world.world import WorldConfig
from tests.experiments.tiny import TINY, write

SCENE = open_scene(PHANTOM)
RING_MM = 20.0 * math.pi
"""Length of the phantom's ring, but for its curvature: a diameter of 20 mm."""
SPOT = (ContourSpec("spot", centre_mm=(-37.093, -23.9786, 75.7208), diameter_mm=6.0),)


def powered(power_w):
    """The phantom with another power of its laser, W."""
    return replace(
        SCENE, spec=replace(SCENE.spec, laser=replace(SCENE.spec.laser, power_w=power_w))
    )


def test_the_dose_of_a_line_is_the_closed_form():
    """On a flat side, 4 W at 5 mm/s: 2 P / (pi w^2) integrated along the line by hand."""
    from surgisoft.scene.contours import laid
    from tests.scene.shapes import box

    side = box((40.0, 40.0, 10.0))
    line = laid(side, np.array([[-8.0, 0.0, 5.0], [8.0, 0.0, 5.0]]), False, 0.5)
    ablation = AblationMap(path_patch(side, (line,), 0.1, band_mm=1.0), 0.4)
    points = torch.tensor(line.points_mm).float()
    down, on = torch.tensor([[0.0, 0.0, -1.0]]), torch.tensor([True])
    state = ablation.start(points[:1], down, on)
    for point in points[1:]:
        state = ablation.advance(state, point[None], down, on, 4.0, 0.1)
    x = np.linspace(-3.0, 3.0, 60001)
    by_hand = np.trapezoid(2 * 4.0 / (math.pi * 0.16) * np.exp(-2 * x**2 / 0.16), x) / 5.0
    assert line_dose_j_per_mm2(4.0, 0.4, 5.0) == pytest.approx(by_hand, rel=1e-6)
    assert float(state.peak.max()) == pytest.approx(by_hand, rel=0.02)


def test_the_dose_of_once_around_is_that_of_a_line():
    """60 s around about 63 mm: a line at 1.05 mm/s, on a surface that is 2 % longer at most."""
    task = CircleAblation(CircleAblationConfig(scene=powered(0.5), cut_s=60.0))
    found = reference_dose(task, 60.0)
    line = line_dose_j_per_mm2(0.5, 0.5 * SCENE.spec.laser.spot_mm, RING_MM / 60.0)
    assert found.largest_j_per_mm2 == pytest.approx(line, rel=0.05)
    assert (found.share, found.wanted, found.passes) == (0.0, 1.0, 1.0)
    assert found.needed_j_per_mm2 == task.scene.ablation.cut_dose
    twice = reference_dose(task, 120.0)
    assert twice.largest_j_per_mm2 == pytest.approx(2.0 * found.largest_j_per_mm2, rel=0.01)


def test_a_weak_laser_is_told_with_the_dose_and_the_threshold():
    task = CircleAblation(CircleAblationConfig(scene=powered(0.5)))
    largest = reference_dose(task).largest_j_per_mm2
    said = weak_laser(task)
    assert (
        f"of 0.5 W, exactly on its reference for 60 s (1.3 passes), gives at most {largest:.3g}"
        in said
    )
    assert f"counts as treated from {task.scene.ablation.cut_dose:.3g} J/mm2 on" in said
    assert ring_dose_lacking(powered(0.5)).startswith(
        "the beam of 0.5 W, once around the ring in the 60 s"
    )
    # three times the power of the least that is enough: the share cut is whole
    enough = 3.0 * 0.5 * task.scene.ablation.cut_dose / largest
    assert weak_laser(CircleAblation(CircleAblationConfig(scene=powered(enough)))) == ""
    assert ring_dose_lacking(SCENE) == ""


def test_the_share_of_an_area_is_that_of_the_expert():
    """Lines 3 mm apart with a spot of 2 mm: strips between them stay below the dose."""
    task = AreaAblation(AreaAblationConfig(outlines=SPOT, pitch_mm=3.0, time_s=9.0))
    found = reference_dose(task)
    episodes = Episodes(task)
    state = episodes.seeded(0, 2)
    with torch.inference_mode():
        for _ in range(task.steps):
            state, _ = episodes.step(state, task.script(state))
    shares = task.treated(state)[0]
    assert found.share < 0.9
    assert found.share == pytest.approx(float(shares.mean()), abs=0.08)
    said = weak_laser(task)
    assert f"to {100 * found.share:.0f} % of the area, and a success needs 98 %: " in said
    assert "pitch_mm, speed_mm_s" in said


@pytest.mark.parametrize("name", ["area_ablation", "contour_ablation", "keyhole_ablation"])
def test_the_lasers_of_the_tasks_are_strong_enough(name):
    task = make_task(name)
    found = reference_dose(task)
    assert found.share >= found.wanted
    assert weak_laser(task) == ""


def test_a_task_without_one_laser_is_not_judged():
    assert "track_body" in TASKS
    for name in ("track_body", "two_laser_ring"):
        assert (reference_dose(make_task(name)), weak_laser(make_task(name))) == (None, "")


def test_the_commands_warn_of_a_weak_laser(tmp_path, capsys):
    """0.5 W: `scene check`, `experiment check` of two speeds; `evaluate`."""
    place = tmp_path / "weak"
    shutil.copytree(PHANTOM, place)
    file = place / "scene.toml"
    file.write_text(file.read_text().replace("power_w = 20.0", "power_w = 0.5"))
    assert run(["scene", "check", str(place)]) == 0
    (said,) = capsys.readouterr().err.splitlines()[-1:]
    assert said == f"surgisoft: warning: {ring_dose_lacking(open_scene(place))}"

    text = TINY.replace("{scene}", str(place))
    vary = '[[vary]]\nfield = "task.cut_s"\nvalues = [45.0, 450.0]\n'
    experiment = write(tmp_path, text.replace("time_s = 0.5", "time_s = 500.0") + vary)
    reported = []
    assert len(weak_lasers(open_experiment(experiment), lambda *one: reported.append(one))) == 1
    assert [one[:2] for one in reported] == [(0, 2), (1, 2)]
    assert reported[1][2].startswith("dose of the laser, ")
    assert run(["experiment", "check", str(experiment)]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "J/mm2" in line]
    assert len(said) == 1, "450 s are enough"
    assert said[0].startswith(
        "surgisoft: warning: setting 'simulation_cut_s=45': the beam of 0.5 W"
    )

    cases = f'[[cases]]\nname = "strong"\n[[cases]]\nname = "weak"\nscene = "{place}"\n'
    text = TINY.replace("{scene}", str(PHANTOM)).replace("time_s = 0.5", "time_s = 60.0")
    assert run(["experiment", "check", str(write(tmp_path, text + cases))]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "J/mm2" in line]
    assert [line.split("'")[1] for line in said] == ["weak"]

    told = []
    config = CircleAblationConfig(scene=place, world=WorldConfig(dt_s=5.0))
    evaluate("random", "circle_ablation", config=config, episodes=1, exact_checks=False,
             on_warning=told.append)  # fmt: skip
    assert told == [weak_laser(CircleAblation(config))]
