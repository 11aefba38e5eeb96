"""LeRobotDataset folders: written, read, and refused where they are damaged."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.importing import import_files, load_map
from surgisoft.measurement.recordings import ArmInfo, Recording, load_recording, save_recording
from surgisoft.measurement.recordings.lerobot import load_lerobot, save_lerobot

pytestmark = pytest.mark.fast


def recording(samples: int = 40, step_s: float = 0.05, seed: int = 0) -> Recording:
    """Two runs of two chambers and two key points; the second run begins 10 s after the first."""
    rng = np.random.default_rng(seed)
    half = samples // 2
    t_s = np.arange(samples) * step_s + np.where(np.arange(samples) < half, 0.0, 10.0)
    points = rng.normal(0, 20, (samples, 2, 3))
    points[3, 1] = np.nan
    return Recording(
        "two_runs",
        t_s,
        rng.uniform(0, 40, (samples, 2)),
        points,
        commanded=rng.uniform(0, 40, (samples, 2)),
        run=(np.arange(samples) >= half).astype(int),
        temp_C=np.linspace(20, 22, samples),
        arm=ArmInfo(length_mm=80.0),
        gravity=np.array([0.0, 0.0, 1.0]),
        noise_mm=0.05,
    )


def test_recording_returns_as_it_was(tmp_path):
    made = recording()
    notes = save_lerobot([made], tmp_path / "set")
    read = load_lerobot(tmp_path / "set")
    assert notes == ["1 of 40 frames lack a key point (NaN); a policy cannot take them"]
    np.testing.assert_allclose(read.t_s, made.t_s, atol=1e-12)
    np.testing.assert_array_equal(read.run, made.run)
    for name in ("measured", "commanded", "key_points_mm", "temp_C"):
        np.testing.assert_allclose(getattr(read, name), getattr(made, name), atol=1e-5)
    assert (read.arm, read.noise_mm, read.unit) == (made.arm, 0.05, "kPa")
    np.testing.assert_array_equal(read.gravity, [0, 0, 1])


def test_context_that_a_dataset_does_not_hold_is_told(tmp_path):
    made = replace(recording(), payload_g=np.full(40, 5.0))
    made.temp_C[0] = np.nan
    notes = save_lerobot([made], tmp_path / "set")
    read = load_lerobot(tmp_path / "set")
    assert (read.temp_C, read.payload_g) == (None, None)
    assert "temp_C of two_runs has gaps and is left out" in notes
    assert "payload_g of two_runs is no value of a dataset and is left out" in notes


def test_action_is_the_command_after_the_observation(tmp_path):
    made = recording()
    save_lerobot([made], tmp_path / "set", task="Bend.")
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    action = np.array(table["action"].to_pylist())
    np.testing.assert_allclose(action[:19], made.commanded[1:20], rtol=1e-6)
    np.testing.assert_allclose(action[19], made.commanded[19], rtol=1e-6)
    assert table["frame_index"].to_pylist() == [*range(20), *range(20)]
    assert table["episode_index"].to_pylist() == [0] * 20 + [1] * 20
    np.testing.assert_allclose(table["timestamp"].to_numpy(), np.tile(np.arange(20) / 20, 2))
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (20, 2, 40)
    assert info["features"]["action"] == {
        "dtype": "float32",
        "shape": [2],
        "names": ["c1_kPa", "c2_kPa"],
    }
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [
        (0, 20),
        (20, 40),
    ]
    assert episodes[1]["tasks"] == ["Bend."]
    statistics = json.loads((tmp_path / "set/meta/stats.json").read_text())
    np.testing.assert_allclose(
        statistics["observation.state"]["mean"][:2], made.measured.mean(0), rtol=1e-5
    )
    np.testing.assert_allclose(
        statistics["observation.state"]["max"][7], np.nanmax(made.key_points_mm[:, 1, 2]), rtol=1e-5
    )


def foreign(folder, names=("p1_kPa", "k0_x_mm", "k0_y_mm", "k0_z_mm"), action="c1_kPa", **info):
    """A dataset as LeRobot itself writes one: two episodes of three frames, no set points."""
    state = np.arange(24.0).reshape(6, 4)
    columns = {
        "observation.state": pa.array(state.tolist(), pa.list_(pa.float32())),
        "action": pa.array([[100.0 + i] for i in range(6)], pa.list_(pa.float32())),
        "timestamp": pa.array(np.tile(np.arange(3) / 10, 2).astype(np.float32)),
        "frame_index": [0, 1, 2] * 2,
        "episode_index": [0] * 3 + [1] * 3,
        "index": list(range(6)),
        "task_index": [0] * 6,
    }
    plain = {"dtype": "int64", "shape": [1], "names": None}
    content = {
        "codebase_version": "v3.0",
        "fps": 10,
        "features": {
            "observation.state": {"dtype": "float32", "shape": [len(names)], "names": list(names)},
            "action": {"dtype": "float32", "shape": [1], "names": [action]},
            "observation.images.top": {"dtype": "video", "shape": [480, 640, 3], "names": None},
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        }
        | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), plain),
    } | info
    (folder / "meta").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(content))
    table = pa.table(columns)
    pq.write_table(table.slice(3), folder / "data/chunk-000/file-000.parquet")
    pq.write_table(table.slice(0, 3), folder / "data/chunk-000/file-001.parquet")


def test_commands_of_a_foreign_dataset_are_one_frame_late(tmp_path):
    foreign(tmp_path / "set")
    read = load_lerobot(tmp_path / "set")
    np.testing.assert_array_equal(read.commanded[:, 0], [100, 101, 103, 104])
    np.testing.assert_array_equal(read.measured[:, 0], [4, 8, 16, 20])
    np.testing.assert_array_equal(read.key_points_mm[0, 0], [5, 6, 7])
    np.testing.assert_array_equal(read.run, [0, 0, 1, 1])
    np.testing.assert_allclose(read.t_s, [0.1, 0.2, 0.1, 0.2], atol=1e-12)


def test_metres_become_millimetres(tmp_path):
    foreign(tmp_path / "set", names=("p1_bar", "k0_x_m", "k0_y_m", "k0_z_m"), action="c1_bar")
    read = load_lerobot(tmp_path / "set")
    np.testing.assert_array_equal(read.key_points_mm[0, 0], [5000, 6000, 7000])
    assert read.unit == "bar"


MAP = """
[file.main]
format = "lerobot"
[time]
column = "timestamp"
[measured]
columns = ["observation.state.pressure"]
unit = "bar"
[key_points]
positions = [["observation.state.x", "observation.state.y", "observation.state.z"]]
unit = "cm"
[runs]
column = "episode_index"
"""


def test_map_reads_a_dataset_with_other_names(tmp_path):
    foreign(tmp_path / "set", names=("pressure", "x", "y", "z"))
    (tmp_path / "map.toml").write_text(MAP)
    (part,) = import_files([tmp_path / "set"], load_map(str(tmp_path / "map.toml")), "rec")
    np.testing.assert_allclose(part.recording.measured[:, 0], np.arange(0, 24, 4))
    np.testing.assert_allclose(part.recording.key_points_mm[1, 0], [50, 60, 70])
    assert (part.recording.unit, len(part.recording.runs)) == ("bar", 2)


def test_commands_write_and_import_a_dataset(tmp_path, capsys):
    rec, dataset, back = (str(tmp_path / name) for name in ("rec.parquet", "set", "back.parquet"))
    save_recording(recording(), rec)
    assert run(["recording", rec, "--lerobot", dataset]) == 0
    assert "a LeRobotDataset v3.0" in capsys.readouterr().out
    assert run(["import", dataset, "-o", back]) == 0
    np.testing.assert_allclose(load_recording(back).measured, recording().measured, atol=1e-5)


def test_a_gap_is_measured_in_the_longer_one_of_both_steps(tmp_path):
    """100 samples per second, 0.1 s of them lost: at 10 frames per second none is missing."""
    t_s = np.delete(np.arange(101) / 100, slice(40, 50))
    points = np.stack([t_s, 0 * t_s, 0 * t_s], axis=1)[:, None]
    made = Recording("fast", t_s, t_s[:, None], points)
    notes = save_lerobot([made], tmp_path / "set", fps=10)
    read = load_lerobot(tmp_path / "set")
    assert not any("gaps" in note for note in notes)
    np.testing.assert_array_equal(read.run, np.zeros(11))
    np.testing.assert_allclose(read.measured[:, 0], np.arange(11) / 10, atol=1e-6)


def test_uneven_times_are_put_on_the_grid(tmp_path):
    t_s = np.array([0.0, 0.04, 0.11, 0.15, 0.2, 1.2, 1.25, 1.3])
    points = np.zeros((8, 1, 3))
    points[:, 0, 0] = 100 * t_s
    made = Recording("uneven", t_s, 10 * t_s[:, None], points, commanded=np.arange(8.0)[:, None])
    notes = save_lerobot([made], tmp_path / "set", fps=20)
    read = load_lerobot(tmp_path / "set")
    assert notes[0].endswith("1 gaps in the times, where episodes end")
    np.testing.assert_allclose(read.t_s, [0, 0.05, 0.1, 0.15, 0.2, 1.2, 1.25, 1.3], atol=1e-9)
    np.testing.assert_allclose(read.measured[:, 0], 10 * read.t_s, atol=1e-5)
    np.testing.assert_array_equal(read.commanded[:, 0], [0, 1, 1, 3, 4, 5, 6, 7])
    np.testing.assert_array_equal(read.run, [0] * 5 + [1] * 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: replace(r, t_s=r.t_s * 0.7), "28.57 samples per second"),
        (lambda r: replace(r, kind="settled"), "steady-state samples"),
    ],
)
def test_recordings_without_a_whole_rate_are_refused(tmp_path, change, words):
    with pytest.raises(InputError, match=words):
        save_lerobot([change(recording())], tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_folder_with_content_is_refused(tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        save_lerobot([recording()], tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


@pytest.mark.parametrize(
    ("info", "words"),
    [
        ({"codebase_version": "v2.1"}, "codebase_version is 'v2.1', expected 'v3.0'"),
        ({"fps": 0}, "fps is '0'"),
        ({"features": []}, "no table of features"),
        ({"features": {"timestamp": {"dtype": "float32", "shape": [1]}}}, "no feature 'episode_"),
        (
            {"features": {"timestamp": {"dtype": "float32", "shape": [1], "names": ["s"]}}},
            "no feature 'timestamp' of one value",
        ),
    ],
)
def test_damaged_descriptions_are_one_line(tmp_path, info, words):
    foreign(tmp_path / "set", **info)
    with pytest.raises(InputError, match=words) as error:
        load_lerobot(tmp_path / "set")
    assert "\n" not in str(error.value)


def test_other_names_ask_for_a_map(tmp_path):
    foreign(tmp_path / "set", names=("a", "b", "c", "d"))
    with pytest.raises(InputError, match='needs a map with format = "lerobot"'):
        load_lerobot(tmp_path / "set")


def test_values_of_another_number_than_described_are_one_line(tmp_path):
    names = ("p1_kPa", "p2_kPa", "k0_x_mm", "k0_y_mm", "k0_z_mm")
    foreign(tmp_path / "set", names=names)
    with pytest.raises(InputError, match="lists of 4 values, expected 5"):
        load_lerobot(tmp_path / "set")


def test_cut_data_file_is_one_line(tmp_path):
    foreign(tmp_path / "set")
    file = tmp_path / "set/data/chunk-000/file-000.parquet"
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"not the frames that info\.json describes") as error:
        load_lerobot(tmp_path / "set")
    assert "\n" not in str(error.value)
