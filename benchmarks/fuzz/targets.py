"""The readers that are fuzzed, each with valid files that the project makes for it.

A target makes samples, folders with the files that one call reads; `mutable` names the files of a
sample that are mutated. A new reader is fuzzed by its line in `TARGETS`.
"""

import dataclasses
import gzip
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surgisoft.scene.spec import PHANTOM

CONTOUR_STEP_MM = 2.0
"""Distance of the points of a contour that is laid on the organ, mm."""
SCENE_MESHES = ("liver.ply", "gallbladder.ply", "tray.ply")
"""Meshes of the packaged scene."""


@dataclass(frozen=True)
class Target:
    """One reader."""

    make: Callable[[Path], None]
    """Fills a folder with samples, one folder each."""
    read: Callable[[Path], object]
    """Reads a sample."""
    mutable: tuple[str, ...] = ("*",)
    """Patterns of the files of a sample that are mutated."""
    weight: float = 1.0
    """Share of the time, relative to the other targets."""
    inputs: int = 5_000
    """Inputs of a million: more where a reader is quick."""
    imports: tuple[str, ...] = ()
    """Modules that a worker imports at once, for the processes that it forks."""


def recording(rows: int = 60):
    """A made-up recording of three chambers and three key points: an arm that bends as it likes."""
    from surgisoft.measurement.recordings import Recording

    t = 0.05 * np.arange(rows)
    pressure = 10 + 8 * np.sin(t[:, None] * [1.0, 1.3, 0.7] + [0, 1, 2])
    bend = (pressure[:, :2] - pressure[:, 2:]) / 20
    heights = np.array([20.0, 45.0, 70.0])
    points = np.stack(
        [bend[:, :1] * heights, bend[:, 1:] * heights, heights + 0 * bend[:, :1]], axis=-1
    )
    points = points + np.random.default_rng(0).normal(0, 0.05, points.shape)
    run = np.repeat([0, 1], [rows // 2, rows - rows // 2])
    return Recording(
        "a", t, pressure, points, pressure + 0.1, run, temp_C=0 * t + 21, payload_g=0 * t
    )


def make_recordings(folder: Path) -> None:
    """A CSV and a Parquet recording, each with a sidecar."""
    from surgisoft.measurement.recordings.file import save_recording

    for suffix in ("csv", "parquet"):
        save_recording(recording(24), folder / suffix / f"a.{suffix}")
        side = folder / suffix / "a.toml"
        side.write_text(side.read_text() + "[arm]\nlength_mm = 70.0\n")


def read_recordings(sample: Path) -> None:
    """All recordings of the folder."""
    from surgisoft.measurement.recordings import load_recordings

    load_recordings([sample])


def make_lerobot(folder: Path) -> None:
    """A LeRobotDataset of two episodes."""
    from surgisoft.measurement.recordings.lerobot import save_lerobot

    save_lerobot([recording(24)], folder / "set")


def read_lerobot(sample: Path) -> None:
    """The recording in a LeRobotDataset."""
    from surgisoft.measurement.recordings.lerobot import load_lerobot

    load_lerobot(sample)


def make_logs(folder: Path) -> None:
    """The log of a short recording."""
    from surgisoft.measurement.recordings.log import LogHeader, recording_log

    one = recording(12)
    header = LogHeader("a", "continuous", "kPa", 3, 3, one.arm, (0.0, 0.0, 1.0), rows=12)
    with recording_log(folder / "one" / "a.jsonl", header) as log:
        for row in range(one.samples):
            parts = one.measured[row], one.key_points_mm[row], one.commanded[row]
            log.sample(row, int(one.run[row]), float(one.t_s[row]), *parts, temp_C=21.0)


def read_logged(sample: Path) -> None:
    """The recording in the log."""
    from surgisoft.measurement.recordings.log import read_log

    read_log(sample / "a.jsonl")


def make_schedule(folder: Path) -> None:
    """A user's schedule of pressures."""
    (folder / "one").mkdir(parents=True)
    rows = "".join(f"{i / 2},{i % 7}.5,{i % 5},{2 * i % 9},{i // 20}\n" for i in range(40))
    (folder / "one" / "schedule.csv").write_text("t_s,c1_kPa,c2_kPa,c3_kPa,run\n" + rows)


def read_schedule(sample: Path) -> None:
    """The schedule, as `collect` and experiments open it."""
    from surgisoft.measurement.protocols import load_schedule

    load_schedule(sample / "schedule.csv")


MAP = """
[file.bench]
match = "bench.*"
missing = ["-"]
[time]
column = "t"
unit = "ms"
[measured]
columns = ["u1", "u2"]
unit = "psi"
to = "kPa"
[key_points]
positions = [["x", "y", "z"], ["a", "b", "c"]]
unit = "m"
[frame]
gravity = [0, 0, -1]
[recording]
note = "made up"
"""
MOTIVE_MAP = """
[file.take]
format = "motive"
match = "take*"
[file.log]
match = "log*"
join = "time"
clock = "from_start"
[time]
column = "Time"
[measured]
file = "log"
[key_points]
auto = "planes"
pattern = '(.+):'
[frame]
origin = "k0"
align_z = "rest"
rest_rows = 3
"""


def make_raw(folder: Path) -> None:
    """Files of a lab with their maps: text, compressed text, Parquet, and Motive with a log."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = ["t", "u1", "u2", "x", "y", "z", "a", "b", "c"]
    wave = np.sin(np.arange(40)[:, None] * np.linspace(0.1, 0.9, 8))
    scale = [3, 3, 0.01, 0.01, 0.05, 0.02, 0.02, 0.09]
    table = np.column_stack([np.arange(40) * 50.0, np.abs(wave) * scale])
    text = ",".join(names) + "\n" + "".join(",".join(map(repr, r)) + "\n" for r in table.tolist())
    for kind in ("txt", "gz", "parquet"):
        (folder / kind).mkdir(parents=True)
        (folder / kind / "map.toml").write_text(MAP)
    (folder / "txt" / "bench.txt").write_text(text)
    (folder / "gz" / "bench.csv.gz").write_bytes(gzip.compress(text.encode()))
    content = pa.table({name: table[:, i] for i, name in enumerate(names)})
    pq.write_table(content, folder / "parquet" / "bench.parquet")
    (folder / "motive").mkdir()
    (folder / "motive" / "map.toml").write_text(MOTIVE_MAP)
    (folder / "motive" / "take.csv").write_text(_motive())
    log = "t_s,p1_kPa,p2_kPa\n" + "".join(f"{i / 20},{i % 9},{i % 4}\n" for i in range(60))
    (folder / "motive" / "log.csv").write_text(log)
    make_lerobot(folder / "lerobot")
    state = "observation.state."
    names = ["t", *(f"{state}p{i}_kPa" for i in (1, 2)), *(f"{state}k2_{a}_mm" for a in "xyz")]
    more = "[runs]\ntime_restarts = true\n"
    _write_map(folder / "lerobot", "format = 'lerobot'", ["timestamp", *names[1:]], more)


def _motive(planes: int = 3, markers: int = 3, rows: int = 40) -> str:
    """Text of a Motive export: circles of markers on planes, one above the other."""
    head = [
        "Format Version,1.23,Take Name,made up,Rotation Type,Quaternion,Length Units,Meters",
        "",
    ]
    labels = [(p, m, axis) for p in range(planes) for m in range(markers) for axis in "XYZ"]
    for label, words in (
        ("Type", ["Marker"] * len(labels)),
        ("Name", [f"Plane{p}:Marker{m}" for p, m, _ in labels]),
        ("ID", [str(i) for i in range(len(labels))]),
        ("", ["Position"] * len(labels)),
    ):
        head.append(",".join(["", label, *words]))
    head.append(",".join(["Frame", "Time (Seconds)", *(axis for *_, axis in labels)]))
    body = []
    for i in range(rows):
        bend, cells = 0.003 * np.sin(i / 5), []
        for p, m, axis in labels:
            angle = 2 * np.pi * m / markers
            place = [0.007 * np.cos(angle) + bend * p, 0.007 * np.sin(angle), 0.02 * p]
            cells.append(f"{place['XYZ'.index(axis)]:.6f}")
        body.append(f"{i},{i / 20:.4f},{','.join(cells)}")
    return "\n".join([*head, *body, ""])


def read_raw(sample: Path) -> None:
    """The conversion that `surgisoft import` does, without writing."""
    from surgisoft.measurement.importing import import_files, load_map

    files = sorted(path for path in sample.iterdir() if path.name != "map.toml")
    import_files(files, load_map(str(sample / "map.toml")), "x")


def _model(**fields):
    import surgisoft

    small = {"haw_nn": {"hidden": (6, 6), "epochs": 2}, "kernel": {}}
    own = small.get(fields.get("network", "haw_nn"), {"epochs": 2})
    return surgisoft.fit([recording()], **own, **fields).model


def make_models(folder: Path) -> None:
    """Models of the fit: every kind of network, with hysteresis, and one with all effects."""
    from surgisoft.surrogate.checkpoint import save_model

    for name, fields in {
        "plain": {},
        "hysteresis": {"effects": ["hysteresis"]},
        "recurrent": {"network": "recurrent"},
        "curvature": {"network": "constant_curvature"},
        "kernel": {"network": "kernel"},
        "arcs": {"prior": "arcs"},
        "ensemble": {"members": 3},
    }.items():
        save_model(_model(**fields), folder / name)
    save_model(with_all_effects(_model()), folder / "effects")


def with_all_effects(model):
    """The model with every effect of the package, each of which does something."""
    from surgisoft.surrogate.effects import EFFECTS, make_effect
    from surgisoft.surrogate.model import arm_facts

    spec = dataclasses.replace(model.spec, gravity=(0.0, 0.0, 1.0), length_mm=70.0)
    facts, effects = arm_facts(spec, model.rest_mm), {}
    for name in EFFECTS:
        effects[name] = make_effect(name, facts).requires_grad_(False)
        for amplitude in effects[name].amplitudes().values():
            amplitude.fill_(0.01)
    return model.replace(spec=spec, effects=effects)


def read_model(sample: Path) -> None:
    """The model, and one step of it: what opens also works."""
    import torch

    from surgisoft.surrogate.checkpoint import load_model

    model = load_model(sample)
    with torch.inference_mode():
        state = model.initial_state(batch=1)
        model.step(state, torch.zeros(1, model.spec.chambers), dt=0.05)


def make_runs(folder: Path) -> None:
    """A short training run of one arm, without its replays."""
    import torch

    from surgisoft.agents.distributed import Processes
    from surgisoft.agents.presets import Plan, Preset
    from surgisoft.agents.training import train_new
    from surgisoft.surrogate.checkpoint import save_model
    from surgisoft.tasks.registry import config_of, with_fields

    save_model(_model(), folder / "_arm")
    preset = Preset(envs=4, rollout=4, epochs=1, batches=2, hidden=(8,), evaluation_episodes=1)
    config = with_fields(config_of("track_circle"), arm=str(folder / "_arm"))
    plan = Plan("track_circle", config, "fast", preset, steps=16)
    train_new(folder / "one", plan, Processes(), torch.device("cpu"))
    for extra in ("replays", "tensorboard"):
        shutil.rmtree(folder / "one" / extra, ignore_errors=True)
    shutil.rmtree(folder / "_arm")


def read_run(sample: Path) -> None:
    """The policies of the run, as `evaluate` opens them."""
    from surgisoft.agents.learned import LearnedPolicy

    LearnedPolicy(sample)


def read_resumed(sample: Path) -> None:
    """The state of the training, as `train --resume` restores it."""
    import torch

    from surgisoft.agents.distributed import Processes
    from surgisoft.agents.training import reopened

    reopened(sample, Processes(), torch.device("cpu"))


EPISODES = (
    "circle_ablation",
    "track_circle",
    "keyhole",
    "contour_ablation",
    "area_ablation",
    "breathing_ablation",
    "two_laser_ring",
)
"""Tasks of the sampled episodes: with one, two and three arms, one and two beams, without a body,
with a plate and an organ, at rest and breathing, with one path, several paths and an area."""


def make_episodes(folder: Path) -> None:
    """Logs of `EPISODES`, scripted."""
    for name in EPISODES:
        _make_episode(folder, name)


def _make_episode(folder: Path, name: str) -> None:
    import torch

    from surgisoft.tasks.base import Episodes
    from surgisoft.tasks.episodes.file import save_episode
    from surgisoft.tasks.episodes.log import EpisodeRecorder
    from surgisoft.tasks.registry import make_task

    task = make_task(name)
    with torch.inference_mode():
        episodes = Episodes(task, donate=True)
        state = episodes.seeded(4, 1)
        recorder = EpisodeRecorder(task, state, policy="scripted", seed=4)
        for _ in range(12):
            actions = task.script(state)
            state, outcome = episodes.step(state, actions)
            recorder.step(state, outcome, actions)
    save_episode(_smaller(recorder.log()), folder / name / "episode.npz")


def _smaller(log):
    """The log with the organ alone, for small files."""
    if log.dose is None:
        return log
    (organ,) = (body for body in log.bodies if body.name == log.dose.body)
    kept, own = np.unique(log.dose.faces, return_inverse=True)
    used, faces = np.unique(organ.faces[kept], return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    organ = dataclasses.replace(organ, vertices_mm=organ.vertices_mm[used], faces=faces)
    dose = dataclasses.replace(log.dose, faces=own.astype(np.int32))
    return dataclasses.replace(log, bodies=(organ,), dose=dose)


def read_episode(sample: Path) -> None:
    """The log."""
    from surgisoft.tasks.episodes.file import load_episode

    load_episode(sample / "episode.npz")


def read_charts(sample: Path) -> None:
    """The log, and its part of a report."""
    from surgisoft.agents.report import episode_parts
    from surgisoft.tasks.episodes.file import load_episode

    episode_parts(load_episode(sample / "episode.npz"))


def read_replay(sample: Path) -> None:
    """The log, and its replay."""
    from surgisoft.replay.episode_view import write_replay
    from surgisoft.tasks.episodes.file import load_episode

    log = load_episode(sample / "episode.npz")
    try:
        write_replay(log, sample / "replay.rrd")
    finally:
        (sample / "replay.rrd").unlink(missing_ok=True)


def make_replays(folder: Path) -> None:
    """A Rerun recording of a circle."""
    _make_episode(folder, "track_circle")
    from surgisoft.replay.episode_view import write_replay
    from surgisoft.tasks.episodes.file import load_episode

    sample = folder / "track_circle"
    write_replay(load_episode(sample / "episode.npz"), sample / "replay.rrd")
    (sample / "episode.npz").unlink()


def read_rrd(sample: Path) -> None:
    """The recording's duration and views, as `replay --screenshot` needs them."""
    from surgisoft.apart import read_apart
    from surgisoft.replay import contents
    from surgisoft.replay.show import find_replay

    read_apart(contents.__name__, find_replay(sample / "replay.rrd"), "a Rerun recording")


def make_scenes(folder: Path) -> None:
    """The liver phantom with coarse meshes, as it is and with a contour of a CSV file."""
    import trimesh

    from surgisoft.config import read_toml, write_toml
    from surgisoft.scene.folder import open_scene

    table = read_toml(PHANTOM / "scene.toml")[0]
    for name in ("phantom", "contour"):
        sample = folder / name
        sample.mkdir(parents=True)
        for mesh in SCENE_MESHES:
            whole = trimesh.load_mesh(PHANTOM / mesh)
            few = whole.vertices[:: max(1, len(whole.vertices) // 300)]
            hull = trimesh.convex.convex_hull(few)
            hull.export(sample / mesh)
            if mesh == table["bodies"][0]["mesh"]:
                for part in (table["lesion"], *table["contours"]):
                    for key in ("centre_mm", "points_mm"):
                        if part.get(key):
                            near = trimesh.proximity.closest_point(hull, np.atleast_2d(part[key]))
                            part[key] = np.reshape(near[0].round(3), np.shape(part[key])).tolist()
        write_toml(sample / "scene.toml", table)
    ring = open_scene(folder / "contour").ring
    path = ring.points_mm[:: max(1, len(ring.points_mm) // 12)]
    rows = "".join(f"{x:.2f},{y:.2f},{z:.2f}\n" for x, y, z in path)
    (folder / "contour" / "line.csv").write_text("x,y,z\n" + rows)
    with (folder / "contour" / "scene.toml").open("a") as file:
        file.write("\n[[contours]]\nname = 'line'\nfile = 'line.csv'\n")


def read_scene(sample: Path) -> None:
    """The scene, its ring, and its contours on the organ."""
    from surgisoft.scene.contours import contour_path
    from surgisoft.scene.folder import open_scene

    scene = open_scene(sample)
    scene.ring  # noqa: B018
    for contour in scene.spec.contours:
        contour_path(scene.organ.world_mesh, contour, CONTOUR_STEP_MM)


def make_experiments(folder: Path) -> None:
    """The experiments of the phantom, with a controller from a schedule."""
    sample = folder / "all"
    make_schedule(folder / "_schedule")
    for file in sorted((PHANTOM / "experiments").glob("*.toml")):
        sample = folder / file.stem / "experiments"
        sample.mkdir(parents=True)
        text = file.read_text() + "\n[[drivers]]\nname = 'mine'\nschedule = 'schedule.csv'\n"
        (sample / "experiment.toml").write_text(text)
        shutil.copy2(folder / "_schedule" / "one" / "schedule.csv", sample / "schedule.csv")
        for scene in PHANTOM.glob("*.toml"):
            shutil.copy2(scene, sample.parent / scene.name)
    shutil.rmtree(folder / "_schedule")


def read_experiment(sample: Path) -> None:
    """The experiment and its settings."""
    from surgisoft.config import read_toml
    from surgisoft.experiments.plan import settings
    from surgisoft.experiments.spec import load_experiment

    file = sample / "experiments" / "experiment.toml"
    settings(load_experiment(file), read_toml(file)[1])


def make_tasks(folder: Path) -> None:
    """The configuration of every task as a file."""
    from surgisoft.config import to_table, write_toml
    from surgisoft.tasks.registry import TASKS, config_of

    for name in TASKS:
        (folder / name).mkdir(parents=True)
        write_toml(folder / name / f"{name}.toml", _without_none(to_table(config_of(name))))


def _without_none(value):
    if isinstance(value, dict):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    return value


def read_task(sample: Path) -> None:
    """The configuration, as `--config` opens it."""
    from surgisoft.tasks.registry import read_config

    (file,) = sample.glob("*.toml")
    read_config(file.stem, file)


def make_meshes(folder: Path) -> None:
    """A tetrahedron subdivided, in every format."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1, radius=60.0)
    for suffix in ("stl", "obj", "ply", "off", "glb"):
        (folder / suffix).mkdir(parents=True)
        ball.export(folder / suffix / f"ball.{suffix}")
    (folder / "text").mkdir()
    ball.export(folder / "text" / "ball.stl", file_type="stl_ascii")


def read_meshes(sample: Path) -> None:
    """The mesh."""
    from surgisoft.scene.meshio import read_mesh

    for path in sample.glob("ball.*"):
        read_mesh(path)


def make_decision(folder: Path) -> None:
    """The fitted decision of the package."""
    from surgisoft.diagnosis.decision import ASSET

    (folder / "one").mkdir(parents=True)
    shutil.copy2(ASSET, folder / "one" / "decision.json")


def read_decision(sample: Path) -> None:
    """The decision; its hash is put right, so that mutations reach what stands behind it."""
    import json

    from surgisoft.diagnosis.decision import content_hash, load_decision

    path = sample / "decision.json"
    try:
        values = json.loads(path.read_text())
        values["sha256"] = content_hash(values)
        path.write_text(json.dumps(values))
    except (ValueError, TypeError, AttributeError, RecursionError):
        pass
    load_decision(path)


LAB_COLUMNS = ["t", "u1", "u2", "x", "y", "z"]
"""Columns of the made-up files of a laboratory: time, two actuations, one key point."""


def _lab_values(rows: int = 12) -> np.ndarray:
    """(rows, 6) time in s, actuation in kPa and a key point in m."""
    t = 0.05 * np.arange(rows)
    wave = np.sin(t[:, None] * [3.0, 4.0, 1.0, 2.0, 5.0])
    return np.column_stack([t, 10 + 5 * wave[:, :2], 0.02 * wave[:, 2:]])


def _write_map(sample: Path, role: str, names: list[str], more: str = "") -> None:
    """The map of a sample: one file, columns in the order of LAB_COLUMNS."""
    sample.mkdir(parents=True, exist_ok=True)
    t, u1, u2, *xyz = names
    (sample / "map.toml").write_text(
        f"[file.log]\n{role}\n[time]\ncolumn = '{t}'\n[measured]\ncolumns = ['{u1}', '{u2}']\n"
        f"unit = 'kPa'\n[key_points]\npositions = [{xyz}]\nunit = 'm'\n{more}"
    )


def make_c3d(folder: Path) -> None:
    """A C3D file of two markers, one of them lost once, and two analog channels."""
    import ezc3d

    values, made = _lab_values(), ezc3d.c3d()
    sample = folder / "one"
    names = ["t_s", "valve1", "valve2", "tip.x", "tip.y", "tip.z"]
    _write_map(sample, "format = 'c3d'", names)
    made["parameters"]["POINT"]["RATE"]["value"] = [20]
    made["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    made["parameters"]["POINT"]["LABELS"]["value"] = ("base", "tip")
    made["parameters"]["ANALOG"]["RATE"]["value"] = [20]
    made["parameters"]["ANALOG"]["LABELS"]["value"] = ("valve1", "valve2")
    points = np.ones((4, 2, len(values)))
    points[:3, 1] = 1000.0 * values[:, 3:].T
    residuals = np.zeros((1, 2, len(values)))
    residuals[0, 0, 4] = -1.0
    made["data"]["meta_points"]["residuals"] = residuals
    made["data"]["points"], made["data"]["analogs"] = points, values[:, 1:3].T[None]
    made.write(str(sample / "raw.c3d"))


def make_matlab(folder: Path) -> None:
    """MATLAB files of version 5: plain, compressed, and with structs."""
    from scipy.io import savemat

    values = _lab_values()
    columns = dict(zip(LAB_COLUMNS, values.T, strict=True))
    for name, packed in (("plain", False), ("packed", True)):
        _write_map(folder / name, "format = 'matlab'", LAB_COLUMNS)
        savemat(folder / name / "raw.mat", columns | {"who": "me"}, do_compression=packed)
    struct = {"trial": {"t": values[:, 0], "p": values[:, 1:3], "k": values[:, None, 3:]}}
    names = ["t", "p.0", "p.1", "k.0", "k.1", "k.2"]
    _write_map(folder / "struct", "format = 'matlab'\ntopic = 'trial'", names)
    savemat(folder / "struct" / "raw.mat", struct | {"gain": np.eye(3)})


def make_hdf5(folder: Path) -> None:
    """HDF5 files: vectors, packed chunks, a compound type, and MATLAB's version 7.3."""
    import h5py

    values = _lab_values()
    for name, how in {
        "plain": {},
        "packed": {"compression": "gzip", "chunks": True, "shuffle": True},
    }.items():
        _write_map(folder / name, "format = 'hdf5'", LAB_COLUMNS)
        with h5py.File(folder / name / "raw.h5", "w") as file:
            for column, content in zip(LAB_COLUMNS, values.T, strict=True):
                file.create_dataset(column, data=content, **how)
    _write_map(folder / "compound", "format = 'hdf5'\ntopic = 'log'", LAB_COLUMNS)
    with h5py.File(folder / "compound" / "raw.h5", "w") as file:
        file["log"] = np.rec.fromarrays(values.T, names=",".join(LAB_COLUMNS))
    names = ["t", "p.0", "p.1", "k.0", "k.1", "k.2"]
    _write_map(folder / "matlab", "format = 'matlab'\ntopic = 'trial'", names)
    with h5py.File(folder / "matlab" / "raw.mat", "w", userblock_size=512) as file:
        group = file.create_group("trial")
        group["t"], group["p"], group["k"] = values[:, :1].T, values[:, 1:3].T, values[:, 3:].T


def make_mcap(folder: Path) -> None:
    """MCAP files: JSON in one topic, ROS 2 messages in two, with and without chunks."""
    from mcap.writer import CompressionType, Writer
    from mcap_ros2.writer import Writer as RosWriter

    values = _lab_values()
    fields = [f"data.{i}" for i in range(5)]
    _write_map(folder / "json", "format = 'mcap'\ntopic = '/log'", ["t_s", *fields])
    with (folder / "json" / "raw.mcap").open("wb") as file:
        bag = Writer(file, use_chunking=False)
        bag.start()
        schema = bag.register_schema("log", "jsonschema", b"{}")
        channel = bag.register_channel("/log", "json", schema)
        for t, *row in values:
            stamp = round(1e9 * (1000.0 + t))
            text = ('{"data": [' + ", ".join(map(str, row)) + "]}").encode()
            bag.add_message(channel, stamp, text, stamp)
        bag.finish()
    for packed in ("none", "lz4", "zstd"):
        names = ["t_s", *(f"{topic}.data.{i}" for topic, n in (("/p", 2), ("/k", 3))
                          for i in range(n))]  # fmt: skip
        _write_map(folder / packed, "format = 'mcap'\ntopics = ['/p', '/k']", names)
        with (folder / packed / "raw.mcap").open("wb") as file:
            bag = RosWriter(file, compression=getattr(CompressionType, packed.upper()))
            kind = bag.register_msgdef("std_msgs/Float64MultiArray", "float64[] data\n")
            for t, *row in values:
                stamp = round(1e9 * (1000.0 + t))
                for topic, part in (("/p", row[:2]), ("/k", row[2:])):
                    bag.write_message(topic, kind, {"data": part}, stamp, stamp)
            bag.finish()


def make_rosbag2(folder: Path) -> None:
    """A ROS 2 bag in SQLite with the messages of two topics."""
    import sqlite3

    topics = (("/p", 2), ("/k", 3))
    names = ["t_s", *(f"{topic}.data.{i}" for topic, n in topics for i in range(n))]
    _write_map(folder / "bag", "format = 'rosbag2'\ntopics = ['/p', '/k']", names)
    bag, kind = sqlite3.connect(folder / "bag" / "raw.db3"), "std_msgs/msg/Float64MultiArray"
    bag.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
    bag.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
    bag.execute(
        "CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)"
    )
    definition = (kind, "ros2msg", "float64[] data\n")
    bag.execute("INSERT INTO message_definitions VALUES (?, ?, ?)", definition)
    for number, (topic, _) in enumerate(topics, 1):
        bag.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", (number, topic, kind))
    for t, *row in _lab_values():
        for number, part in enumerate((row[:2], row[2:]), 1):
            # CDR, little-endian: the length, padding to the alignment of a double, the numbers.
            data = struct.pack(f"<4xI4x{len(part)}d", len(part), *part)
            data = b"\0\1\0\0" + data[4:]
            command = "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)"
            bag.execute(command, (number, round(1e9 * (1000.0 + t)), data))
    bag.commit()
    bag.close()


CONTEXT = """
question = "Is the arm's tip accurate enough to cut a ring?"
use = "The model replaces the arm in training."
title = "made up"
model = "default"
recordings = ["a.csv"]
[risk]
influence = "medium"
consequence = "low"
reason = "a phantom"
[limits]
error_mm = 2.0
tip_error_mm = 3.0
area_mm = 1.0
applicable = 0.9
[uncertainty]
noise_mm = 0.1
input = [0.2, 0.2, 0.3]
parameters_mm = 0.05
[[sources]]
name = "a"
robot = "first"
date = "2026-01-01"
[scenario]
states = ["a.csv"]
payload_g = [0.0, 5.0]
"""


def make_contexts(folder: Path) -> None:
    """A CONTEXT.toml with everything that one may state."""
    (folder / "one").mkdir(parents=True)
    (folder / "one" / "context.toml").write_text(CONTEXT)
    (folder / "one" / "a.csv").write_text("")


def read_context(sample: Path) -> None:
    """The context of use, as `compare --credibility` opens it."""
    from surgisoft.credibility.context import load_context

    load_context(sample / "context.toml")


def make_segmentations(folder: Path) -> None:
    """Segmented images: NIfTI, plain and packed, and NRRD with named segments."""
    import nibabel
    import nrrd

    voxels = np.zeros((8, 8, 8), np.uint8)
    voxels[1:7, 1:7, 1:7] = 1
    voxels[3:5, 3:5, 3:5] = 2
    for name in ("image.nii", "image.nii.gz"):
        (folder / name.replace(".", "_")).mkdir(parents=True)
        image = nibabel.Nifti1Image(voxels, np.diag([2.0, 2.0, 2.0, 1.0]))
        nibabel.save(image, folder / name.replace(".", "_") / name)
    header = {
        "space": "left-posterior-superior",
        "space directions": 2.0 * np.eye(3),
        "space origin": [0.0, 0.0, 0.0],
        "Segment0_Name": "organ",
        "Segment0_LabelValue": "1",
        "Segment0_Layer": "0",
    }
    for encoding in ("raw", "gzip"):
        (folder / encoding).mkdir()
        kept = header | {"encoding": encoding}
        nrrd.write(str(folder / encoding / "image.nrrd"), voxels, kept)


def read_segmented(sample: Path) -> None:
    """The surfaces of both labels, as `scene new` makes them."""
    from surgisoft.scene.segmentation import parse_label, read_segmentation

    (path,) = sample.iterdir()
    read_segmentation(path, (parse_label("1:organ"), parse_label("2:lesion")))


BENCH = """
points = ["base", "m1+m2+m3", "tip"]
channels = [2, 1, 3]
gravity = [0.0, 0.0, -1.0]
payload_g = 4.0
[frame]
body = "plate"
origin_mm = [1.0, 2.0, 3.0]
rotation_deg = [0.0, 90.0, 0.0]
[arm]
length_mm = 70.0
"""


def make_benches(folder: Path) -> None:
    """The map of a bench with motion capture."""
    (folder / "one").mkdir(parents=True)
    (folder / "one" / "bench.toml").write_text(BENCH)


def read_bench(sample: Path) -> None:
    """The map, and the key points of a frame by it."""
    from surgisoft.errors import InputError
    from surgisoft.rig.drivers.bench_map import KeyPoints, load_bench_map
    from surgisoft.rig.drivers.motion_capture import Body, Frame

    points = KeyPoints(load_bench_map(sample / "bench.toml"))
    plate = Body(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    seen = {name: np.arange(3.0) + i for i, name in enumerate(("base", "m1", "m2", "m3", "tip"))}
    frame = Frame(1, 0.0, seen, {"plate": plate})
    try:
        points.require(frame)
    except InputError:
        return
    points(frame)


def make_frames(folder: Path) -> None:
    """Datagrams of motion capture: JSON, and NatNet's frames, descriptions and server."""
    import json
    import struct

    def sample(name: str, content: bytes) -> None:
        (folder / name).mkdir(parents=True)
        suffix = "json" if name == "json" else "bin"
        (folder / name / f"packet.{suffix}").write_bytes(content)

    seen = {"k0": [0.0, 0.0, 0.0], "k1": None, "k2": [1.0, 2.0, 70.0]}
    body = {"position": [0.0, 1.0, 2.0], "rotation": [0.0, 0.0, 0.0, 1.0], "valid": True}
    content = {"frame": 7, "t": 0.5, "unit": "mm", "points": seen, "bodies": {"base": body}}
    sample("json", json.dumps(content).encode())
    for name, size in (("frame3", b""), ("frame4", struct.pack("<i", 0))):
        pose = struct.pack("<i7ffh", 1, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0, 0.001, 1)
        marker = struct.pack("<i4fhf", 1 << 16 | 1, 0.1, 0.2, 0.3, 0.01, 2, 0.001)
        parts = [struct.pack("<i", 42), struct.pack("<i", 1) + size]
        parts += [b"base\0" + struct.pack("<i3f", 1, 0.1, 0.2, 0.3)]
        parts += [struct.pack("<i", 1) + size + struct.pack("<3f", 0.1, 0.2, 0.3)]
        parts += [struct.pack("<i", 1) + size + pose]
        parts += [struct.pack("<i", 1) + size + struct.pack("<ii", 1, 1) + pose]
        parts += [struct.pack("<i", 0) + size] if size else []
        parts += [struct.pack("<i", 1) + size + marker]
        parts += [struct.pack("<i", 1) + size + struct.pack("<iiif", 1, 1, 1, 0.5)]
        parts += [struct.pack("<i", 0) + size, bytes(8)]
        parts += [struct.pack("<d3Q", 0.5, 10**6, 0, 0), bytes(8)]
        sample(name, b"".join(parts))
    rigid = b"base\0" + struct.pack("<ii3f", 1, -1, 0, 0, 0) + struct.pack("<i", 0)
    markers = b"all\0" + struct.pack("<i", 1) + b"m1\0"
    sized = struct.pack("<iii", 2, 0, len(markers)) + markers
    sample("bodies4", sized + struct.pack("<ii", 1, len(rigid)) + rigid)
    sample("bodies3", struct.pack("<ii", 2, 0) + markers + struct.pack("<i", 1) + rigid)
    server = b"Motive".ljust(256, b"\0") + bytes([3, 1, 0, 0, 4, 1, 0, 0])
    sample("server", server + struct.pack("<QH?4B", 10**7, 1511, True, 239, 255, 42, 99))


def read_packet(sample: Path) -> None:
    """The frame, description or server in a datagram; receivers pass over what is none."""
    from surgisoft.rig.drivers import natnet
    from surgisoft.rig.drivers.motion_capture import DAMAGED, decode_json

    (path,) = sample.iterdir()
    packet, version = path.read_bytes()[:65536], (4, 1) if "4" in sample.name else (3, 0)
    try:
        match sample.name.rstrip("34"):
            case "json":
                decode_json(packet)
            case "frame":
                natnet.read_frame(packet, version, {1: "base"}, 1e7)
            case "bodies":
                natnet.read_bodies(packet, version)
            case _:
                natnet.read_server(packet)
    except DAMAGED:
        pass


def make_lines(folder: Path) -> None:
    """Lines of a pressure controller without their checksums."""
    (folder / "one").mkdir(parents=True)
    lines = "INFO 1 3 0.000 40.000 500 1000 emulator\n"
    lines += "".join(f"DATA {20 * i} {i} R 1.5 2.5 nan 1.0 2.0 3.0\n" for i in range(5))
    (folder / "one" / "lines.txt").write_text(lines + "NAK 7 beyond the limits\n")


def read_lines(sample: Path) -> None:
    """What the controller's lines say; each gets the checksum that belongs to it."""
    from surgisoft.rig.drivers.line_protocol import LONGEST, Data, Info, line, words_of

    found = None
    for raw in (sample / "lines.txt").read_bytes().split(b"\n"):
        raw = raw[-LONGEST:]
        try:
            words = words_of(line(raw.decode("ascii", "ignore"), "<"), "<")
            if words is None:
                continue
            if words[0] == "INFO":
                found = Info.read(words)
            elif words[0] != "NAK" and found is not None:
                Data.read(words, found.chambers)
        except ValueError:  # the driver counts it as a damaged line
            continue


def make_assignments(folder: Path) -> None:
    """Assignments of fields as they follow a command."""
    for name, lines in {
        "circle_ablation": ["fire_mm=0.8", "weights.laser.fine=2", "world.observer.gain=0.3"],
        "track_circle": ["follow.size_mm=12.5", "world.randomisation.noise_mm=0.1"],
    }.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "words.txt").write_text("\n".join(lines))


def read_assignments(sample: Path) -> None:
    """The configuration of a task with the assignments, as `train` and `evaluate` make it."""
    from surgisoft.config import COMMAND_LINE, assignments
    from surgisoft.tasks.registry import changed_config, config_of

    text = (sample / "words.txt").read_text("utf-8", "replace")
    changed_config(config_of(sample.name), assignments(text.split("\n")), COMMAND_LINE)


TINY_EXPERIMENT = f"""
name = "tiny"
scene = "{PHANTOM}"
repeats = 2
together = 2
[limits]
time_s = 0.3
[[phases]]
name = "look"
endoscope = "policy"
timeout_s = 0.3
on_timeout = "go on"
"""


def make_results(folder: Path) -> None:
    """The results of a tiny experiment."""
    from surgisoft.experiments.run import run_experiment
    from surgisoft.experiments.session import start_experiment

    folder.mkdir(parents=True)
    file = folder / "tiny.toml"
    file.write_text(TINY_EXPERIMENT)
    spec, place = start_experiment(file, folder / "one")
    run_experiment(spec, place)
    file.unlink()
    shutil.rmtree(place / "logs", ignore_errors=True)
    lines = (place / "experiment.toml").read_text().splitlines()
    lines = [f'scene = "{PHANTOM}"' if line.startswith("scene") else line for line in lines]
    (place / "experiment.toml").write_text("\n".join(lines) + "\n")


def read_results(sample: Path) -> None:
    """The experiment and its rows, as `experiment run --resume` and reports open them."""
    from surgisoft.experiments.results import sum_up
    from surgisoft.experiments.run import jobs, read_rows
    from surgisoft.experiments.spec import load_experiment

    spec = load_experiment(sample / "experiment.toml")
    sum_up(spec, sample, read_rows(sample, jobs(spec)))


TARGETS: dict[str, Target] = {
    "recording": Target(make_recordings, read_recordings, weight=3, inputs=30_000),
    "lerobot": Target(
        make_lerobot,
        read_lerobot,
        ("meta/info.json", "meta/*.toml", "data/*/*.parquet"),
        inputs=10_000,
    ),
    "log": Target(make_logs, read_logged, weight=2, inputs=120_000),
    "schedule": Target(make_schedule, read_schedule, weight=2, inputs=100_000),
    "import": Target(make_raw, read_raw, weight=3, inputs=10_000),
    "c3d": Target(make_c3d, read_raw, ("*.c3d",), imports=("ezc3d",)),
    "matlab": Target(make_matlab, read_raw, ("*.mat",), imports=("scipy.io",)),
    "hdf5": Target(make_hdf5, read_raw, ("*.h5", "*.mat"), imports=("h5py",)),
    "mcap": Target(make_mcap, read_raw, ("*.mcap",), inputs=10_000),
    "rosbag2": Target(make_rosbag2, read_raw, ("*.db3",), inputs=10_000),
    "model": Target(
        make_models, read_model, ("config.json", "*.safetensors"), weight=2, inputs=30_000
    ),
    "run": Target(make_runs, read_run, ("config.json", "*.pt"), weight=2, inputs=5_000),
    "resume": Target(make_runs, read_resumed, ("config.json", "last.pt"), weight=2),
    "episode": Target(make_episodes, read_episode, weight=3, inputs=6_000),
    "charts": Target(make_episodes, read_charts),
    "replay": Target(make_episodes, read_replay),
    "rrd": Target(make_replays, read_rrd, weight=0.5, imports=("rerun.chunk", "pyarrow.compute")),
    "scene": Target(make_scenes, read_scene, ("scene.toml", "*.csv"), inputs=5_000),
    "segmentation": Target(make_segmentations, read_segmented, inputs=20_000),
    "experiment": Target(
        make_experiments, read_experiment, ("experiment.toml",), weight=2, inputs=6_000
    ),
    "results": Target(make_results, read_results, ("experiment.toml", "*.json"), inputs=6_000),
    "context": Target(make_contexts, read_context, ("context.toml",), inputs=80_000),
    "task": Target(make_tasks, read_task, weight=2, inputs=60_000),
    "assignments": Target(make_assignments, read_assignments, inputs=80_000),
    "mesh": Target(make_meshes, read_meshes, weight=2, inputs=100_000),
    "decision": Target(make_decision, read_decision, inputs=130_000),
    "bench": Target(make_benches, read_bench, inputs=90_000),
    "packet": Target(make_frames, read_packet, inputs=130_000),
    "lines": Target(make_lines, read_lines, inputs=30_000),
}
"""Every reader by name."""
