"""Late logs and held readings: what comes out is the signal that was put in."""

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.importing import import_files, import_recordings
from surgisoft.measurement.recordings import load_recordings

from .test_importing import spec, text, written

MAP = """
[time]
column = "t"
[measured]
columns = ["p", "q"]
unit = "kPa"
MEASURED
[commanded]
columns = ["c", "d"]
unit = "kPa"
COMMANDED
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
REST
"""
HEADER = ["t", "p", "q", "c", "d", "x", "y", "z"]


def truth(t_s):
    """(T, 2) an actuation and (T, 3) the body that follows it at once, in closed form."""
    p = np.stack([20 + 20 * np.sin(1.3 * t_s), 20 + 15 * np.cos(2.1 * t_s)], axis=1)
    return p, np.stack([0.5 * p[:, 0], p[:, 1] - p[:, 0], 70 - 0.01 * p[:, 0] ** 2], axis=1)


def late(t_s, by_s):
    """A raw table: the body at t_s, the actuation and its command as they were by_s earlier."""
    actuation, _ = truth(t_s - by_s)
    _, body = truth(t_s)
    return np.column_stack([t_s, actuation, actuation, body])


def imported(tmp_path, table, measured="", commanded="", rest=""):
    content = MAP.replace("MEASURED", measured).replace("COMMANDED", commanded)
    file = written(tmp_path / "a.csv", text(table, header=HEADER))
    (part,) = import_files([file], spec(tmp_path, content.replace("REST", rest)), "x")
    return part.recording, part.notes


@pytest.mark.parametrize("rows", [-7, -1, 2, 5])
def test_a_log_late_by_whole_rows_comes_back_exactly(tmp_path, rows):
    t_s = np.arange(400) / 100
    delay = f"delay_s = {rows / 100}"
    recording, notes = imported(tmp_path, late(t_s, rows / 100), delay, delay)
    assert recording.samples == 400 - abs(rows)
    kept = t_s[: 400 - rows] if rows > 0 else t_s[-rows:]
    actuation, body = truth(kept)
    np.testing.assert_allclose(recording.measured, actuation, atol=1e-9)
    np.testing.assert_allclose(recording.commanded, actuation, atol=1e-9)
    np.testing.assert_allclose(recording.key_points_mm[:, 0], body, atol=1e-9)
    assert f"{abs(rows)} rows that the late log does not reach left out" in notes[-1]


def test_a_log_late_by_parts_of_irregular_rows_comes_back(tmp_path):
    rng = np.random.default_rng(0)
    t_s = np.cumsum(rng.uniform(0.005, 0.015, 2000))
    recording, _ = imported(
        tmp_path, late(t_s, 0.0234), "delay_s = 0.0234", "delay_s = 0.0234", "[rows]\nevery = 3"
    )
    actuation, _ = truth(recording.t_s + t_s[0])
    # Between rows 15 ms apart a line misses at most a''/8 dt^2 = 66 * 0.015^2 / 8.
    assert np.abs(recording.measured - actuation).max() < 66 * 0.015**2 / 8
    assert np.abs(recording.commanded - actuation).max() < 32 * 0.015
    assert np.isfinite(recording.measured).all()


def test_runs_are_shifted_each_on_its_own(tmp_path):
    t_s = np.arange(50) / 100
    table = np.concatenate([late(t_s, 0.03), late(t_s + 10, 0.03), late(t_s + 20, 0.03)])
    recording, _ = imported(tmp_path, table, "delay_s = 0.03", rest="[runs]\ngap_s = 1")
    assert [run.stop - run.start for run in recording.runs] == [47, 47, 47]
    np.testing.assert_allclose(recording.measured, truth(recording.t_s)[0], atol=1e-9)
    with pytest.raises(InputError, match=r"delay_s 0.6 .*longer than every run"):
        imported(tmp_path, table, "delay_s = 0.6", rest="[runs]\ngap_s = 1")


def test_rows_whose_reading_lies_in_a_gap_of_the_log_are_left_out(tmp_path):
    t_s = np.concatenate([np.arange(100) / 100, 5 + np.arange(100) / 100])
    recording, _ = imported(tmp_path, late(t_s, 0.03), "delay_s = 0.03")
    assert recording.samples == 194
    np.testing.assert_allclose(recording.measured, truth(recording.t_s)[0], atol=1e-9)


@pytest.mark.parametrize("jitter", [False, True])
def test_readings_held_by_a_slow_sensor_come_back(tmp_path, jitter):
    t_s = np.arange(2000) / 100
    rng = np.random.default_rng(1)
    every = rng.integers(3, 8, 500) if jitter else np.full(500, 5)
    read = np.cumsum(every) - every[0]
    read = read[read < 2000]
    table = late(t_s, 0.0)
    table[:, 1:3] = table[read[np.searchsorted(read, np.arange(2000), side="right") - 1], 1:3]
    recording, notes = imported(tmp_path, table, 'repeated = "interpolate"')
    actuation, _ = truth(t_s)
    held = np.abs(table[:, 1:3] - actuation)[: read[-1]].max()
    left = np.abs(recording.measured - actuation)[: read[-1]].max()
    assert held > 1.2
    assert left < 66 * (np.max(every) / 100) ** 2 / 8
    assert f"renewed every 0.05 s and held in between: {2000 - len(read)} of 2000" in notes[0]


def test_a_long_rest_stays_a_rest_until_the_last_reading_before_the_step(tmp_path):
    t_s = np.arange(1000) / 100
    table = late(t_s, 0.0)
    reading = np.where(np.arange(0, 1000, 5) < 600, 3.0, 8.0) + 0 * t_s[::5]
    reading[:40] = np.arange(40)  # alive at first, so that the period shows
    table[:, 1] = np.repeat(reading, 5)
    table[:, 2] = 1.0
    recording, _ = imported(tmp_path, table, 'repeated = "interpolate"')
    np.testing.assert_allclose(recording.measured[205:596, 0], 3.0)
    np.testing.assert_allclose(recording.measured[596:600, 0], [4, 5, 6, 7])
    np.testing.assert_allclose(recording.measured[600:, 0], 8.0)


def test_a_command_is_never_interpolated(tmp_path):
    with pytest.raises(InputError, match="repeated"):
        imported(tmp_path, late(np.arange(9) / 10, 0), commanded='repeated = "interpolate"')


def wandering(t_s, seed):
    """(T, 2) smooth random actuation at any time, the sum of 40 sines below 0.8 Hz."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.05, 0.8, 40), rng.uniform(0, 6.28, (2, 40))
    waves = np.sin(2 * np.pi * rate * t_s[:, None, None] + phase)
    return 30 + 3 * waves.sum(axis=2)


def test_the_number_in_the_note_puts_the_log_right(tmp_path):
    t_s = np.arange(6000) / 100
    table = late(t_s, 0.0)
    now, before = wandering(t_s, 0), wandering(t_s - 0.04, 0)
    noise = np.random.default_rng(0).normal(size=(6000, 3))
    table[:, 1:3] = table[:, 3:5] = before
    table[:, 5:] = np.stack([now[:, 0], now[:, 1], 70 - 0.01 * now[:, 0] ** 2], axis=1) + noise / 20
    _, notes = imported(tmp_path, table)
    (note,) = [note for note in notes if "delay_s" in note]
    assert note.endswith("in [measured] and [commanded] of the map"), "columns of one file"
    value = float(note.split("delay_s = ")[1].split()[0])
    assert value == pytest.approx(0.04, abs=0.002)
    _, notes = imported(tmp_path, table, "delay_s = 0.02")
    (note,) = [note for note in notes if "delay_s" in note and "before its measured" in note]
    whole = float(note.split("delay_s = ")[1].split()[0])
    assert whole == pytest.approx(0.04, abs=0.002), "what is left is added to the map's own"
    recording, notes = imported(tmp_path, table, f"delay_s = {value}")
    assert not any("before its measured" in note for note in notes)
    kept = t_s[: recording.samples]
    np.testing.assert_allclose(recording.measured, wandering(kept, 0), atol=0.4)


def test_held_readings_are_noted_until_the_map_interpolates_them(tmp_path):
    t_s = np.arange(6000) / 100
    table = late(t_s, 0.0)
    now = wandering(t_s, 1)
    table[:, 1:3] = np.repeat(now[::5], 5, axis=0)
    table[:, 3:5] = now
    table[:, 5:] = np.stack([now[:, 0], now[:, 1], 70 - 0.01 * now[:, 0] ** 2], axis=1)
    _, notes = imported(tmp_path, table)
    assert sum("renewed every 0.05 s only" in note for note in notes) == 1
    assert not any("delay_s" in note for note in notes)
    recording, notes = imported(tmp_path, table, 'repeated = "interpolate"')
    assert any("held in between: 4800 of 6000 rows interpolated" in note for note in notes)
    assert not any("[measured]" in note for note in notes)
    np.testing.assert_allclose(recording.measured[:5990], now[:5990], atol=0.2)


def test_a_delay_in_place_of_the_maps(tmp_path, capsys):
    """One map serves files whose clocks are apart by different times."""
    t_s = np.arange(400) / 100
    file = written(tmp_path / "a.csv", text(late(t_s, 0.05), header=HEADER))
    content = MAP.replace("MEASURED", "delay_s = 0.31").replace("COMMANDED", "delay_s = 0.2")
    (tmp_path / "map.toml").write_text(content.replace("REST", ""))
    (part,) = import_recordings(file, tmp_path / "map.toml", "a", delay_s=0.05)
    actuation, _ = truth(part.recording.t_s)
    np.testing.assert_allclose(part.recording.measured, actuation, atol=1e-9)
    np.testing.assert_allclose(part.recording.commanded, actuation, atol=1e-9)
    given = ["import", str(file), "--map", str(tmp_path / "map.toml"), "--delay-s", "0.05"]
    assert run([*given, "-o", str(tmp_path / "a.parquet")]) == 0
    (same,) = load_recordings(tmp_path / "a.parquet")
    np.testing.assert_array_equal(same.measured, part.recording.measured)
    assert "measured actuation read +0.05 s from each row" in capsys.readouterr().out
    for delay_s, message in ((float("nan"), "expected a finite number"), (0.1, "without a map")):
        with pytest.raises(InputError, match=message):
            import_recordings(
                file, None if delay_s == 0.1 else tmp_path / "map.toml", None, delay_s
            )


def test_the_command_of_another_file_keeps_its_delay(tmp_path):
    t_s = np.arange(400) / 100
    table = late(t_s, 0.05)
    written(
        tmp_path / "a_cam.csv", text(table[:, [0, 1, 2, 5, 6, 7]], header=HEADER[:3] + HEADER[5:])
    )
    written(tmp_path / "a_set.csv", text(table[:, [0, 3, 4]], header=["t", "c", "d"]))
    content = MAP.replace("MEASURED", "").replace("REST", "")
    content = content.replace("COMMANDED", 'delay_s = 0.05\nfile = "set"')
    roles = '[file.cam]\nmatch = "*_cam.csv"\n[file.set]\nmatch = "*_set.csv"\n'
    (tmp_path / "map.toml").write_text(roles + content)
    files = [tmp_path / "a_cam.csv", tmp_path / "a_set.csv"]
    (part,) = import_recordings(files, tmp_path / "map.toml", "a", delay_s=0.0)
    kept = part.recording.t_s
    np.testing.assert_allclose(part.recording.measured, truth(kept - 0.05)[0], atol=1e-9)
    np.testing.assert_allclose(part.recording.commanded, truth(kept)[0], atol=1e-9)
