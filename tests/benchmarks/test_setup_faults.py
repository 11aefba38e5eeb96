"""Set-up faults are put into cases in which nothing is missing, and into key points that move."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.setup_faults import FAULTS, of_cases
from surgisoft.errors import InputError
from tests.diagnosis.setup.recordings import predicted


def with_cases(folder, **truths):
    """A folder of cases NAME=(robot, truth), and one of the fitted models of their robots."""
    for name, (robot, truth) in truths.items():
        (folder / "lab" / "cases" / name / "after").mkdir(parents=True)
        (folder / "lab" / "cases" / name / "after" / "same.parquet").touch()
        about = {"robot": robot, "truth": truth}
        (folder / "lab" / "cases" / name / "truth.json").write_text(json.dumps(about))
        (folder / "lab" / "robots" / robot / "before").mkdir(parents=True, exist_ok=True)
        model = folder / "models" / f"lab-{robot}-default"
        model.mkdir(parents=True, exist_ok=True)
        (model / "config.json").touch()
    return folder / "lab", folder / "models"


def test_faults_are_put_into_cases_in_which_nothing_is_missing(tmp_path):
    lab, models = with_cases(
        tmp_path, a=("7", []), b=("7", ["creep"]), c=("8", ["unknown"]), d=("7", [])
    )
    seven, eight = of_cases(lab, models)
    assert (seven.name, eight.name) == ("lab", "lab")
    assert [p.parents[1].name for p in seven.clean] == ["a", "d"]
    assert [p.parents[1].name for p in seven.hidden] == ["b"]
    assert (eight.clean, [p.parents[1].name for p in eight.hidden]) == ((), ["c"])
    assert eight.model == models / "lab-8-default"


def test_a_folder_without_an_unchanged_case_is_refused(tmp_path):
    lab, models = with_cases(tmp_path, a=("7", ["creep"]))
    with pytest.raises(InputError, match="one at least in which nothing is missing"):
        of_cases(lab, models)


def test_a_key_point_that_is_made_dead_moves_in_either_order():
    plain = predicted()
    turned = replace(plain, key_points_mm=plain.key_points_mm[:, ::-1])
    for recording in (plain, turned):
        motion = np.sqrt(recording.key_points_mm.var(0).sum(1))
        made = [
            FAULTS["dead key point"][1](recording, np.random.default_rng(seed)).key_points_mm
            for seed in range(30)
        ]
        dead = {int(np.flatnonzero((points == points[0]).all((0, 2)))[0]) for points in made}
        assert len(dead) > 1
        assert all(motion[k] >= 0.2 * motion.max() for k in dead)
