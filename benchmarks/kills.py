"""`python -m benchmarks.kills`: end commands by SIGKILL at any moment, and look at what is left.

A command is run in a forked process and killed before one of its own file operations (opening for
writing, renaming, making or removing a file or folder, as Python's audit events report them) or
after a random time. Then its output must be the old one, the new one or absent, and readable. An
interrupted training is resumed and must end with the weights of an uninterrupted one, bit by bit.
"""

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.fuzz.run import in_child
from benchmarks.fuzz.targets import make_raw, recording

EVENTS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate")
"""Audit events before which a process may be killed (Python documentation, audit events table)."""


@dataclass(frozen=True)
class Command:
    """One command that writes a file or a folder."""

    run: Callable[[Path, int], object]
    """Writes the output in a working folder; the second number decides its content."""
    output: str
    """Name of what it writes in the working folder."""
    read: Callable[[Path], object]
    """Reads the output; raises where it is damaged."""
    replaces: bool = True
    """Whether the command may replace an older output."""


def _options(**fields):
    return {"hidden": (6,), "epochs": 2, **fields}


def _collect(work: Path, number: int) -> None:
    from surgisoft.measurement.recordings import save_recording
    from surgisoft.rig import VirtualRig

    rig = VirtualRig(number)
    from surgisoft.measurement.protocols import load_schedule

    found, _ = rig.record(load_schedule(work / "schedule.csv"))
    save_recording(found, work / "a.parquet", force=True)


def _recording(path: Path) -> None:
    from surgisoft.measurement.recordings import load_recordings

    load_recordings([path])


def _import(work: Path, number: int) -> None:
    from dataclasses import replace

    from surgisoft.measurement.importing import import_files, load_map
    from surgisoft.measurement.recordings import save_recording

    raw = work / "raw" / "txt"
    (part,) = import_files([raw / "bench.txt"], load_map(str(raw / "map.toml")), "a")
    save_recording(replace(part.recording, note=f"{number}"), work / "a.csv", force=True)


def _fit(work: Path, number: int) -> None:
    import surgisoft
    from surgisoft.surrogate.checkpoint import save_model

    found = surgisoft.fit([recording()], **_options(seed=number))
    save_model(found.model, work / "arm", found.report(), force=True)


def _model(path: Path) -> None:
    from surgisoft.surrogate.checkpoint import load_model

    load_model(path)


def _amend(work: Path, number: int) -> None:
    from surgisoft.diagnosis.amend import amend
    from surgisoft.measurement.recordings import load_recordings
    from surgisoft.surrogate.checkpoint import save_model

    files = load_recordings([work / "bench.parquet"])
    found = amend("default", files, "gain_mismatch" if number else "creep", refit="never")
    save_model(found.model, work / "amended", found.to_json(), force=True)


def _experiment(work: Path, number: int) -> None:
    from surgisoft.experiments.session import finish_experiment, start_experiment

    file = work / "tiny.toml"
    file.write_text(TINY.replace("SEED", str(number)))
    there = (work / "results" / "experiment.toml").is_file()
    spec, folder = start_experiment(file, work / "results", (), None, resume=False, force=there)
    finish_experiment(spec, folder, 1, False, "kills")


def _results(path: Path) -> None:
    """Every row of the results that is there, and the configuration they belong to."""
    from surgisoft.experiments.spec import load_experiment
    from surgisoft.files import read_json
    from surgisoft.tasks.episodes.file import load_episode

    if not (path / "experiment.toml").is_file():
        raise FileNotFoundError(path)
    load_experiment(path / "experiment.toml")
    for row in (path / "rows").glob("*.json"):
        read_json(row)
    for log in (path / "logs").glob("*.npz"):
        load_episode(log)


TINY = f"""
name = "tiny"
scene = "{Path(__file__).resolve().parents[1] / "scenes" / "phantom_liver"}"
seed = SEED
repeats = 1
together = 1
[limits]
time_s = 0.3
[[phases]]
name = "look"
endoscope = "policy"
timeout_s = 0.3
on_timeout = "go on"
"""


def _scene(work: Path, number: int) -> None:
    from surgisoft.cli import run

    code = run(["scene", "new", str(work / "organ.ply"), "-o", str(work / "scene")])
    if code != 0:
        raise RuntimeError(f"scene new ended with code {code}")


def _open_scene(path: Path) -> None:
    from surgisoft.scene.folder import open_scene

    open_scene(path)


COMMANDS: dict[str, Command] = {
    "collect": Command(_collect, "a.parquet", _recording),
    "import": Command(_import, "a.csv", _recording),
    "fit": Command(_fit, "arm", _model),
    "amend": Command(_amend, "amended", _model),
    "experiment": Command(_experiment, "results", _results),
    "scene new": Command(_scene, "scene", _open_scene, replaces=False),
}
"""The commands that are killed, beside `train`."""


def prepare(work: Path) -> None:
    """The inputs of all commands."""
    import trimesh

    from surgisoft.measurement.protocols import make_protocol
    from surgisoft.measurement.recordings import save_recording
    from surgisoft.rig import VirtualRig

    make_raw(work / "raw")
    rows = "".join(f"{0.5 * i},{10 + i},{i % 7},{i % 5}\n" for i in range(8))
    (work / "schedule.csv").write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n" + rows)
    rig = VirtualRig(0, hidden=[("creep", 1.0)])
    found, _ = rig.record(make_protocol("mixed", rig.limits, points=1200))
    save_recording(found, work / "bench.parquet")
    trimesh.creation.icosphere(subdivisions=3, radius=70.0).export(work / "organ.ply")


def state_of(path: Path) -> str:
    """Hash of a file or of all files of a folder; `absent` where there is none.

    `report.json` of a model states how long the fit took, so that it is only read.
    """
    if not path.exists():
        return "absent"
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        if file.name == "report.json":
            json.loads(file.read_text())
            continue
        digest.update(str(file.relative_to(path.parent)).encode() + file.read_bytes())
    return digest.hexdigest()


def run_child(call: Callable[[], object], at: int | None, after_s: float | None) -> tuple[int, int]:
    """Run a call in a forked process; (file operations seen, exit status).

    at: kill before this file operation, counted from 1. after_s: kill after this time.
    """
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        warnings.simplefilter("ignore")
        seen = 0

        def hook(event: str, given: tuple) -> None:
            nonlocal seen
            if event not in EVENTS:
                return
            if event == "open" and (given[1] is None or not set("wax+") & set(str(given[1]))):
                return
            seen += 1
            if seen == at:
                os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(hook)
        code = 1
        try:
            call()
            code = 0
        except BaseException:
            with contextlib.suppress(OSError):
                os.write(writing, traceback.format_exc().encode())
        finally:
            os.write(writing, b"\0%d" % seen)
            os._exit(code)
    os.close(writing)
    if after_s is not None:
        time.sleep(after_s)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    status = os.waitpid(pid, 0)[1]
    with os.fdopen(reading, "rb") as pipe:
        said, _, count = pipe.read().rpartition(b"\0")
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) != 0:
        raise RuntimeError(said.decode())
    return int(count or 0), status


def kill_command(name: str, folder: Path, inputs: Path, random: random.Random) -> dict:
    """Kill a command once; what was left of its output, and whether that is a finding."""
    command = COMMANDS[name]
    work = folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(inputs / name, work)
    target = work / command.output
    old = state_of(target)
    about = json.loads((inputs / f"{name}.json").read_text())
    at = random.randint(1, about["operations"]) if random.random() < 0.75 else None
    after_s = None if at else random.uniform(0.0, about["seconds"])
    _, status = run_child(lambda: command.run(work, 1), at, after_s)
    killed = os.WIFSIGNALED(status)
    now, bad = state_of(target), ""
    kind = {old: "old", about["new"]: "new", "absent": "absent"}.get(now, "other")
    if now != "absent":
        try:
            command.read(target)
        except FileNotFoundError:
            kind = "absent"
        except Exception as error:
            bad = f"{type(error).__name__}: {error}"
    if kind == "other" and not bad and name not in ("experiment",):
        kind = "mixed"
    return {"command": name, "killed": killed, "left": kind, "bad": bad, "at": at, "s": after_s}


def ready(name: str, inputs: Path) -> None:
    """Inputs of a command with an old output, the new output's hash, operations and seconds."""
    command, work = COMMANDS[name], inputs / name
    prepare_once = inputs / "_inputs"
    if not prepare_once.is_dir():
        prepare_once.mkdir(parents=True)
        in_child(lambda: prepare(prepare_once))
    shutil.copytree(prepare_once, work)
    run_child(lambda: command.run(work, 1), None, None)
    new = state_of(work / command.output)
    shutil.rmtree(work)
    shutil.copytree(prepare_once, work)
    if command.replaces:
        run_child(lambda: command.run(work, 0), None, None)
    trial = inputs / "_trial"
    shutil.copytree(work, trial)
    began = time.monotonic()
    operations, _ = run_child(lambda: command.run(trial, 1), None, None)
    seconds = time.monotonic() - began
    shutil.rmtree(trial)
    about = {"new": new, "operations": operations, "seconds": seconds}
    (inputs / f"{name}.json").write_text(json.dumps(about))


def kill_training(folder: Path, random: random.Random, whole: str, operations: int) -> dict:
    """Kill a training up to three times, resume it to its end, compare with the uninterrupted."""
    run = folder / "run"
    shutil.rmtree(run, ignore_errors=True)
    kills, bad = 0, ""
    for _ in range(random.choice((1, 1, 2, 3))):
        at = random.randint(1, operations)
        _, status = run_child(lambda: _train(run), at, None)
        kills += os.WIFSIGNALED(status)
    try:
        run_child(lambda: _train(run), None, None)
        bad = "" if _weights(run) == whole else "other weights than the uninterrupted training"
    except Exception as error:
        bad = f"{type(error).__name__}: {error}"
    return {"command": "train", "killed": kills, "left": "resumed", "bad": bad}


def _train(run: Path) -> None:
    """A new training, or the continuation of the one that is there."""
    import torch

    from surgisoft.agents import training
    from surgisoft.agents.distributed import Processes
    from surgisoft.agents.presets import Plan, Preset
    from surgisoft.tasks.registry import config_of

    training.CHECKPOINT_S = 0.0  # a checkpoint after each iteration
    device = torch.device("cpu")
    if (run / "config.json").is_file():
        training.resume(run, Processes(), device)
        return
    preset = Preset(envs=4, rollout=4, epochs=1, batches=2, hidden=(8,), evaluation_episodes=1)
    plan = Plan("track_circle", config_of("track_circle"), "fast", preset, steps=64)
    training.train_new(run, plan, Processes(), device)


def _weights(run: Path) -> str:
    """Hash of all weights and optimiser states of the last checkpoint."""
    import torch

    from surgisoft.agents.run_folder import LAST, RunFolder

    digest = hashlib.sha256()

    def add(value) -> None:
        if isinstance(value, torch.Tensor):
            digest.update(value.numpy().tobytes())
        elif isinstance(value, dict):
            for key in sorted(value, key=str):
                digest.update(str(key).encode())
                add(value[key])
        elif isinstance(value, list | tuple):
            for part in value:
                add(part)
        else:
            digest.update(repr(value).encode())

    saved = RunFolder(run).load(LAST)
    for name in ("iteration", "best", "agents", "processes"):
        digest.update(name.encode())
        add(saved[name])
    return digest.hexdigest()


def main() -> int:
    """Parse, kill, print; exit code 1 where something was left half."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=500, help="number of kills (500)")
    parser.add_argument("--seconds", type=float, default=1e9, help="end after this time, too")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[*COMMANDS, "train"])
    parser.add_argument("--log", type=Path, help="append each kill to this file")
    given = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    for module in ("surgisoft.agents.training", "surgisoft.experiments.session", "trimesh"):
        __import__(module)
    chosen, counts, bad = random.Random(given.seed), Counter(), []
    with tempfile.TemporaryDirectory() as folder:
        inputs, end = Path(folder) / "inputs", time.monotonic() + given.seconds
        for name in given.only:
            if name in COMMANDS:
                ready(name, inputs)
        if "train" in given.only:
            first = Path(folder) / "whole"
            operations, _ = run_child(lambda: _train(first), None, None)
            whole = _weights(first)
        done = 0
        while done < given.kills and time.monotonic() < end:
            name = given.only[done % len(given.only)] if done < 10**9 else ""
            if name == "train":
                found = kill_training(Path(folder), chosen, whole, operations)
            else:
                found = kill_command(name, Path(folder), inputs, chosen)
            done += max(1, int(found["killed"]))
            counts[name, found["left"]] += 1
            counts[name, "kills"] += int(found["killed"])
            if found["bad"] or found["left"] in ("mixed",):
                bad.append(found)
                print(f"{name}: {found}", flush=True)
            if given.log:
                with given.log.open("a") as file:
                    file.write(json.dumps(found) + "\n")
    print(f"{sum(n for (_, kind), n in counts.items() if kind == 'kills')} kills:")
    for name in given.only:
        kinds = {kind: n for (command, kind), n in sorted(counts.items()) if command == name}
        print(f"  {name:12} {', '.join(f'{n} {kind}' for kind, n in kinds.items())}")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
