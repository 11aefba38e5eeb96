"""The readers that are fuzzed, each with valid files that the project makes for it.

A target makes samples, folders with the files that one call reads; `mutable` names the files of a
sample that are mutated. A new reader is fuzzed by its line in `TARGETS`.
"""

import gzip
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surgisoft.scene.spec import PHANTOM

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
        save_recording(recording(), folder / suffix / f"a.{suffix}")
        side = folder / suffix / "a.toml"
        side.write_text(side.read_text() + "[arm]\nlength_mm = 70.0\n")


def read_recordings(sample: Path) -> None:
    """All recordings of the folder."""
    from surgisoft.measurement.recordings import load_recordings

    load_recordings([sample])


def make_lerobot(folder: Path) -> None:
    """A LeRobotDataset of two episodes."""
    from surgisoft.measurement.recordings.lerobot import save_lerobot

    save_lerobot([recording()], folder / "set")


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

    return surgisoft.fit([recording()], hidden=(6, 6), epochs=2, **fields).model


def make_models(folder: Path) -> None:
    """Models of the fit: pressure only, with hysteresis, and a recurrent network."""
    from surgisoft.surrogate.checkpoint import save_model

    for name, fields in {
        "plain": {},
        "hysteresis": {"effects": ["hysteresis"]},
        "recurrent": {"network": "recurrent"},
        "curvature": {"network": "constant_curvature"},
    }.items():
        save_model(_model(**fields), folder / name)


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


def make_episodes(folder: Path) -> None:
    """Logs of a cut and of a circle, scripted."""
    import torch

    from surgisoft.tasks.base import Episodes
    from surgisoft.tasks.episodes.file import save_episode
    from surgisoft.tasks.episodes.log import EpisodeRecorder
    from surgisoft.tasks.registry import make_task

    for name in ("circle_ablation", "track_circle"):
        task = make_task(name)
        with torch.inference_mode():
            episodes = Episodes(task, donate=True)
            state = episodes.seeded(4, 1)
            recorder = EpisodeRecorder(task, state, driver="scripted", seed=4)
            for _ in range(12):
                actions = task.script(state)
                state, outcome = episodes.step(state, actions)
                recorder.step(state, outcome, actions)
        log = recorder.log()
        save_episode(_smaller(log), folder / name / "episode.npz")


def _smaller(log):
    """The log with the organ alone, for small files."""
    from dataclasses import replace

    if log.dose is None:
        return log
    (organ,) = (body for body in log.bodies if body.name == log.dose.body)
    kept, own = np.unique(log.dose.faces, return_inverse=True)
    used, faces = np.unique(organ.faces[kept], return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    organ = replace(organ, vertices_mm=organ.vertices_mm[used], faces=faces)
    return replace(log, bodies=(organ,), dose=replace(log.dose, faces=own.astype(np.int32)))


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
    make_episodes(folder)
    shutil.rmtree(folder / "circle_ablation")
    from surgisoft.replay.episode_view import write_replay
    from surgisoft.tasks.episodes.file import load_episode

    sample = folder / "track_circle"
    write_replay(load_episode(sample / "episode.npz"), sample / "replay.rrd")
    (sample / "episode.npz").unlink()


def read_rrd(sample: Path) -> None:
    """The recording's duration and views, as `replay --screenshot` needs them."""
    from surgisoft.replay.contents import contents
    from surgisoft.replay.show import find_replay

    contents(find_replay(sample / "replay.rrd"))


def make_scenes(folder: Path) -> None:
    """The liver phantom."""
    sample = folder / "phantom"
    sample.mkdir(parents=True)
    for name in ("scene.toml", *SCENE_MESHES):
        shutil.copy2(PHANTOM / name, sample / name)


def read_scene(sample: Path) -> None:
    """The scene and its ring."""
    from surgisoft.scene.folder import open_scene

    open_scene(sample).ring  # noqa: B018


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


TARGETS: dict[str, Target] = {
    "recording": Target(make_recordings, read_recordings, weight=3),
    "lerobot": Target(
        make_lerobot, read_lerobot, ("meta/info.json", "meta/*.toml", "data/*/*.parquet")
    ),
    "log": Target(make_logs, read_logged, weight=2),
    "schedule": Target(make_schedule, read_schedule, weight=2),
    "import": Target(make_raw, read_raw, weight=3),
    "model": Target(make_models, read_model, ("config.json", "*.safetensors"), weight=2),
    "run": Target(make_runs, read_run, ("config.json", "*.pt"), weight=2),
    "resume": Target(make_runs, read_resumed, ("config.json", "last.pt"), weight=2),
    "episode": Target(make_episodes, read_episode, weight=3),
    "charts": Target(make_episodes, read_charts),
    "replay": Target(make_episodes, read_replay),
    "rrd": Target(make_replays, read_rrd, weight=0.5),
    "scene": Target(make_scenes, read_scene, ("scene.toml",)),
    "experiment": Target(make_experiments, read_experiment, ("*.toml",), weight=2),
    "task": Target(make_tasks, read_task, weight=2),
    "mesh": Target(make_meshes, read_meshes, weight=2),
    "decision": Target(make_decision, read_decision),
}
"""Every reader by name."""
