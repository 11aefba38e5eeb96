"""The floor from inputs that came twice, and what must not be taken for it."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.amend import fall_of
from surgisoft.diagnosis.data_quality import data_quality_warnings
from surgisoft.diagnosis.residuals import (
    Floor,
    floor_in_words,
    floor_to_tell,
    held_out_rows,
    noise_of,
    problem_of,
    repeat_floor,
    residual_table,
    with_training_noise,
)
from tests.diagnosis.synthetic import NOISE_MM, recording, resting_together, still_model, walk

FLOOR = np.sqrt(3) * NOISE_MM
CYCLE = walk(300, seed=3)


def repeats(model, recordings):
    """The floor from the repeats among all rows of some recordings."""
    problem = problem_of(model, recordings)
    return repeat_floor(problem.table, problem.block_of_row)


def test_repeats_find_the_noise_below_a_large_error():
    """The same cycle in six runs; a model that is 2 mm off everywhere changes nothing."""
    run = np.repeat(np.arange(6), 300)
    made = recording(2.0 + np.zeros(1800), np.tile(CYCLE, (6, 1)), run=run, noise_mm=None)
    floor = repeats(still_model(), [made])
    assert floor.source == "repeats"
    assert floor.rmse_mm == pytest.approx(FLOOR, rel=0.05)


def test_what_differs_from_one_repeat_to_the_next_is_noise():
    """Each cycle is off by another amount: a floor that holds alone would miss."""
    run = np.repeat(np.arange(6), 300)
    offset = np.random.default_rng(1).normal(0, 0.5, 6)
    made = recording(offset[run], np.tile(CYCLE, (6, 1)), run=run, noise_mm=None)
    pairs = np.square(offset[:, None] - offset[None])[~np.eye(6, dtype=bool)].mean() / 2
    floor = repeats(still_model(), [made])
    assert floor.rmse_mm == pytest.approx(np.sqrt(FLOOR**2 + pairs / 3), rel=0.25)


def test_nothing_that_came_once_is_a_repeat():
    """A walk that never comes back, and rows beside each other in one slow ramp."""
    ramp = np.linspace(0, 10, 600)[:, None] * [1.0, 0.5]
    for pressure in (walk(600, 6), ramp):
        made = recording(np.zeros(600), pressure, noise_mm=None)
        assert repeats(still_model(pressure.shape[1]), [made]).rmse_mm is None


def test_a_repeat_in_another_run_counts_whatever_its_clock_shows():
    """Six runs whose clocks all begin at 0: a row repeats one of the same time in another run."""
    run = np.repeat(np.arange(6), 300)
    made = recording(np.zeros(1800), np.tile(CYCLE, (6, 1)), run=run, noise_mm=None)
    made = replace(made, t_s=np.tile(made.t_s[:300], 6))
    assert repeats(still_model(), [made]).rmse_mm == pytest.approx(FLOOR, rel=0.05)


@pytest.mark.parametrize(("blocks", "source"), [(4, "unknown"), (6, "repeats")])
def test_repeats_have_to_lie_in_five_blocks_of_time(blocks, source):
    made = recording(np.zeros(1800), np.tile(CYCLE, (6, 1)), noise_mm=None)
    table = residual_table(still_model(), [made])
    assert repeat_floor(table, np.arange(1800) * blocks // 1800).source == source


def test_a_statement_of_the_lab_comes_first():
    made = recording(np.zeros(600), walk(600), noise_mm=0.2)
    floor = residual_table(still_model(), [made]).floor
    assert (floor.source, floor.rmse_mm) == ("sidecar", pytest.approx(0.2 * np.sqrt(3)))


def test_held_out_rows_take_no_part_in_a_floor_from_second_differences():
    """Wild key points there change the floor of all rows and not that of either part."""
    ramp = 5 + 5 * np.sin(np.arange(1500) / 60)[:, None] * [1.0, 0.5]
    made = recording(0.3 * ramp[:, 0], ramp, noise_mm=None)
    points = made.key_points_mm.copy()
    held = held_out_rows([made])
    points[held] += np.random.default_rng(7).normal(0, 40 * NOISE_MM, points[held].shape)
    wild = residual_table(still_model(), [replace(made, key_points_mm=points)])
    for part in ("training", "held_out"):
        assert wild.only(part).floor.rmse_mm == pytest.approx(FLOOR, rel=0.05)
        assert wild.view(part).noise_mm == pytest.approx(NOISE_MM * np.sqrt(3), rel=0.1)
    assert wild.only("all").floor.rmse_mm > 1.2 * FLOOR


def test_the_noise_of_a_comparison_is_that_of_the_training_rows():
    """Of holds; where no key point of a training row was measured it stays that of all rows."""
    made = recording(np.zeros(2400), resting_together(2400), noise_mm=None)
    held = held_out_rows([made])
    points = made.key_points_mm.copy()
    points[held] += np.random.default_rng(7).normal(0, 40 * NOISE_MM, points[held].shape)
    plain, wild = (
        with_training_noise(residual_table(still_model(), [each]), [each])
        for each in (made, replace(made, key_points_mm=points))
    )
    assert wild.floor == plain.floor != residual_table(still_model(), [made]).floor
    assert wild.holds == plain.holds
    np.testing.assert_array_equal(wild.noise_mm, plain.noise_mm)
    assert wild.floor.source == "holds"
    alone = replace(made, key_points_mm=np.where(held[:, None, None], points, np.nan))
    table = residual_table(still_model(), [alone])
    assert with_training_noise(table, [alone]).floor == table.floor


def test_second_differences_are_those_within_a_run():
    """Runs of four rows, each with its tip somewhere else: half of all differences cross runs."""
    ramp = np.arange(1200)[:, None] % 97 / 10 * [1.0, 0.5]
    run = np.repeat(np.arange(300), 4)
    places = np.random.default_rng(5).normal(0.0, 5.0, 300)
    noise, source = noise_of([recording(places[run], ramp, run=run, noise_mm=None)])
    assert source == "second differences"
    assert noise == pytest.approx(np.full(3, FLOOR), rel=0.1)


def test_the_scatter_in_holds_is_that_of_three_coordinates():
    made = recording(np.zeros(2400), resting_together(2400), noise_mm=None)
    floor = residual_table(still_model(), [made]).floor
    assert (floor.source, floor.rmse_mm) == ("holds", pytest.approx(FLOOR, rel=0.15))


def test_second_differences_find_the_noise_of_a_smooth_motion():
    """Neither a statement nor a hold: a ramp to and fro, the arm moving along with it."""
    ramp = 5 + 5 * np.sin(np.arange(1500) / 60)[:, None] * [1.0, 0.5]
    made = recording(0.3 * ramp[:, 0], ramp, noise_mm=None)
    floor = residual_table(still_model(), [made]).floor
    assert floor.source == "second differences"
    assert floor.rmse_mm == pytest.approx(FLOOR, rel=0.05)


def test_settled_samples_have_no_second_differences():
    """The motion from one steady-state sample to the next is no noise."""
    made = recording(0.3 * CYCLE[:, 0], CYCLE, noise_mm=None, kind="settled")
    table = residual_table(still_model(), [made])
    for floor in (table.floor, table.only("training").floor):
        assert (floor.source, floor.rmse_mm) == ("unknown", None)
    said = [each for each in data_quality_warnings(table.training()) if "noise" in each]
    assert len(said) == 1
    assert "the noise floor is not known; state noise_mm" in said[0]


@pytest.mark.parametrize("every", [2, 7])
def test_cameras_slower_than_the_log_show_their_noise(every):
    ramp = 5 + 5 * np.sin(np.arange(4500) / 300)[:, None] * [1.0, 0.5]
    made = recording(0.3 * ramp[:, 0], ramp, noise_mm=None)
    points = np.where((np.arange(4500) % every == 0)[:, None, None], made.key_points_mm, np.nan)
    table = residual_table(still_model(), [replace(made, key_points_mm=points)])
    assert table.floor.source == "second differences"
    assert table.floor.rmse_mm == pytest.approx(FLOOR, rel=0.1)


@pytest.mark.parametrize(("amplitude_mm", "expected"), [(0.0, FLOOR), (4.0, FLOOR), (10.0, 0.135)])
def test_a_motion_of_few_rows_is_not_taken_for_noise(amplitude_mm, expected):
    """20 rows in a period: second differences have an amplitude of 4 sin^2(pi / 20) = 0.0979. At
    10 mm they pass for (1.4826 / sqrt(6)) sin(45 degrees) 0.979 = 0.419 mm of noise in x, and with
    that of three coordinates a tenth of the variance stays: sqrt(0.1 (0.419^2 + FLOOR^2))."""
    wave = np.sin(2 * np.pi * np.arange(3000) / 20)
    made = recording(amplitude_mm * wave, 5 + wave[:, None] * [1.0, 0.5], noise_mm=None)
    noise, source = noise_of([made])
    assert source == "second differences"
    assert noise[-1] == pytest.approx(expected, rel=0.4)


def test_a_motion_without_noise_keeps_a_tenth_of_it():
    """Every second difference of a parabola is the same, and four times as large at twice the lag;
    a tenth of its variance stays, because a motion tells no smaller noise."""
    made = recording(np.zeros(600), walk(600), noise_mm=None)
    parabola = np.square(np.arange(600) / 8.0)  # exact in binary
    points = np.broadcast_to(parabola[:, None, None], made.key_points_mm.shape)
    noise, source = noise_of([replace(made, key_points_mm=points)])
    assert source == "second differences"
    size = 1.4826 * (2 / 8.0**2) / np.sqrt(6)  # of a coordinate, were all of it noise
    assert noise == pytest.approx(np.full(3, np.sqrt(0.1 * 3) * size))


def test_a_floor_in_words():
    assert floor_in_words(1e-4, ".3f") == "unknown"
    assert floor_in_words(0.25, ".3f") == "0.250 mm"
    assert floor_in_words(0.0, ".3f") == "0.000 mm"


@pytest.mark.parametrize("kind", ["continuous", "settled"])
def test_stated_noise_of_zero_is_none(kind):
    """It is told as 0 and reckoned with as the least noise; without a statement it is unknown."""
    made = replace(recording(np.zeros(600), walk(600), noise_mm=0.0), kind=kind)
    problem = residual_table(still_model(), [made]).view("training")
    assert problem.table.floor == Floor(0.0, "sidecar")
    assert problem.told_floor_mm == 0.0
    assert problem.floor_mm == pytest.approx(1e-4)
    assert fall_of(problem, problem).floor == 0.0
    same = np.broadcast_to(made.key_points_mm[:1], made.key_points_mm.shape)
    noise, source = noise_of([replace(made, noise_mm=None, key_points_mm=same)])
    assert source == "unknown"
    assert floor_in_words(floor_to_tell(noise, source), ".3f") == "unknown"
