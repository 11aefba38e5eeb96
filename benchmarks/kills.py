"""`python -m benchmarks.kills`: end commands by SIGKILL at any moment, and look at what is left.

Each command is run in a process that is forked from one which has imported and tried everything, so
that a kill takes as long as the command's own work. It is killed before a chosen call of the C
library that changes a file (a write, opening a new file, renaming, making, removing: kill_at_call.c
counts them, whichever language calls), in the middle of a chosen write, or after a random time.
Then its output must be the old one, the new one or absent, and readable. An interrupted training is
resumed and must end with the weights of an uninterrupted one, bit by bit; an interrupted experiment
is resumed and must end with the rows of an uninterrupted one.

With `--fail` nothing is killed: from a chosen call on, calls that change files fail, as where the
quota is used up (EDQUOT: what takes room fails) or the file system becomes read-only (EROFS: all
fails). The command must then end in one line, with its output as above and, under the quota, with
nothing left over; where it ends well, its output must be the new one.
"""

import argparse
import contextlib
import ctypes
import errno
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from benchmarks.fuzz.run import scratch
from benchmarks.fuzz.targets import make_raw, recording
from surgisoft.cli import run as command_line
from surgisoft.errors import InputError

COUNTER = Path(__file__).with_name("kill_at_call.c")
"""Source of the library that counts calls and ends the process."""
LEFTOVER = re.compile(r"(^|/)\.[^/]*[0-9a-f]{12}[^/]*(/|$)")
"""Hidden files of a kill, which no reader takes for an output (surgisoft.files)."""
BAD_INPUT = 2
"""Exit code of a command that says in one line why it does nothing."""
FAILING = {"quota": (errno.EDQUOT, False), "read-only": (errno.EROFS, True)}
"""How calls fail: the error number, and whether those that take no room fail too."""
TORN, RANDOM = 0.25, 0.2
"""Shares of the kills in the middle of a write, and after a random time."""


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
    beside: Callable[[Path], object] | None = None
    """Looks at what else a kill may leave in the working folder; raises where it is damaged."""
    finish: Callable[[Path, int], object] | None = None
    """Continues what was killed; the output must then be the new one."""
    varies: tuple[str, ...] = ()
    """Files of the output whose content differs from run to run and that are only looked at."""
    share: float = 1.0
    """Share of the kills, relative to the other commands."""


def ended_with(code: int) -> None:
    """Raise where a command line ended badly; InputError where it did so in one line."""
    if code != 0:
        kind = InputError if code == BAD_INPUT else RuntimeError
        raise kind(f"the command ended with code {code}")


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
    moved = replace(part.recording, key_points_mm=part.recording.key_points_mm + number)
    save_recording(moved, work / "a.csv", force=True)


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


def _improve(work: Path, number: int) -> None:
    from surgisoft.diagnosis.improve import improve
    from surgisoft.measurement.recordings import load_recordings
    from surgisoft.surrogate.checkpoint import save_model

    files = load_recordings([work / ("other.parquet" if number else "bench.parquet")])
    found = improve("default", files, most_effects=1, refit="never")
    save_model(found.model, work / "improved", found.to_json(), force=True)


def _run(work: Path, number: int) -> None:
    from surgisoft.live.session import run

    run(
        work / "schedule.csv",
        f"virtual:seed={number}",
        "default",
        clock="simulated",
        any_model=True,
        reference_s=REFERENCE_S,
        on_warning=lambda _: None,
        output=work / "live.csv",
        force=True,
    )


def _run_log(work: Path) -> None:
    """The growing log of a run is absent, without a sample, or readable."""
    from surgisoft.errors import InputError
    from surgisoft.measurement.recordings.log import read_log

    log = work / "live.log.jsonl"
    if log.exists():
        try:
            read_log(log)
        except InputError as error:
            if "no sample yet" not in str(error) and "is empty" not in str(error):
                raise


REFERENCE_S = 40.0
"""Clean time of a live run, s; no run here is as long."""


def _lerobot(work: Path, _: int) -> None:
    from surgisoft.measurement.recordings import load_recordings
    from surgisoft.measurement.recordings.lerobot import save_lerobot

    save_lerobot(load_recordings([work / "bench.parquet"]), work / "set", fps=20)


def _open_lerobot(path: Path) -> None:
    from surgisoft.measurement.recordings.lerobot import load_lerobot

    load_lerobot(path)


def _import_lerobot(work: Path, number: int) -> None:
    code = command_line(
        ["import", str(work / f"set{number}"), "-o", str(work / "b.csv"), "--force"]
    )
    ended_with(code)


def _export(work: Path, _: int) -> None:
    from surgisoft.surrogate.checkpoint import load_model
    from surgisoft.surrogate.export import export_arm

    export_arm(load_model("default"), work / "exported")


def _open_exported(path: Path) -> None:
    """Both graphs and the description of an exported arm."""
    import onnx
    import torch

    about = json.loads((path / "arm.json").read_text())
    for file in path.iterdir():
        if file.suffix == ".onnx":
            onnx.checker.check_model(onnx.load(file))
        elif file.suffix == ".pt":
            torch.jit.load(file)
    if not about:
        raise ValueError("arm.json is empty")


def _experiment(work: Path, number: int) -> None:
    from surgisoft.experiments.session import finish_experiment, start_experiment

    file = work / "tiny.toml"
    file.write_text(TINY.replace("SEED", str(number)))
    there = (work / "results" / "experiment.toml").is_file()
    spec, folder = start_experiment(file, work / "results", (), None, resume=False, force=there)
    finish_experiment(spec, folder, 1, False, "kills")


def _resume_experiment(work: Path, number: int) -> None:
    """Continue results of the new experiment, begin anew where the old or no results are there."""
    from surgisoft.experiments.session import finish_experiment, start_experiment
    from surgisoft.experiments.spec import load_experiment

    file = work / "tiny.toml"
    file.write_text(TINY.replace("SEED", str(number)))
    there = work / "results" / "experiment.toml"
    new = there.is_file() and load_experiment(there).seed == number
    old = there.is_file() and not new
    spec, folder = start_experiment(file, work / "results", (), None, resume=new, force=old)
    finish_experiment(spec, folder, 1, False, "kills")


def _results(path: Path) -> None:
    """Every row of the results that is there, and the configuration they belong to."""
    from surgisoft.experiments.spec import load_experiment
    from surgisoft.files import read_json
    from surgisoft.tasks.episodes.file import load_episode

    if not (path / "experiment.toml").is_file():
        raise FileNotFoundError(path)
    load_experiment(path / "experiment.toml")
    for row in (path / "rows").glob("[!.]*.json"):
        read_json(row)
    for log in (path / "logs").glob("[!.]*.npz"):
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
    code = command_line(["scene", "new", str(work / "organ.ply"), "-o", str(work / "scene")])
    ended_with(code)


def _open_scene(path: Path) -> None:
    from surgisoft.scene.folder import open_scene

    open_scene(path)


COMMANDS: dict[str, Command] = {
    "collect": Command(_collect, "a.parquet", _recording),
    "import": Command(_import, "a.csv", _recording),
    "import a dataset": Command(_import_lerobot, "b.csv", _recording),
    "recording --lerobot": Command(_lerobot, "set", _open_lerobot, replaces=False),
    "fit": Command(_fit, "arm", _model, varies=("report.json",)),
    "amend": Command(_amend, "amended", _model, varies=("report.json",)),
    "improve": Command(_improve, "improved", _model, varies=("report.json",), share=0.25),
    "run": Command(_run, "live.csv", _recording, beside=_run_log),
    "experiment": Command(
        _experiment,
        "results",
        _results,
        finish=_resume_experiment,
        varies=("report.html", "versions.json"),
        share=0.5,
    ),
    "scene new": Command(_scene, "scene", _open_scene, replaces=False, share=0.4),
    "export": Command(
        _export,
        "exported",
        _open_exported,
        replaces=False,
        varies=("arm.pt",),  # holds the lines of this program that led to it; is opened instead
        share=0.4,
    ),
}
"""The commands that are killed, beside `train`."""

TRAIN = "train"
"""The command that is killed up to three times and resumed."""


def prepare(work: Path) -> None:
    """The inputs of all commands."""
    import trimesh

    from surgisoft.measurement.protocols import make_protocol
    from surgisoft.measurement.recordings import save_recording
    from surgisoft.measurement.recordings.lerobot import save_lerobot
    from surgisoft.rig import VirtualRig

    make_raw(work / "raw")
    for number in (0, 1):
        save_lerobot([recording(24 + 8 * number)], work / f"set{number}")
    rows = "".join(f"{0.5 * i},{10 + i},{i % 7},{i % 5}\n" for i in range(8))
    (work / "schedule.csv").write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n" + rows)
    for name, hidden in (("bench", "creep"), ("other", "gain_mismatch")):
        rig = VirtualRig(0, hidden=[(hidden, 1.0)])
        found, _ = rig.record(make_protocol("mixed", rig.limits, points=600))
        save_recording(found, work / f"{name}.parquet")
    trimesh.creation.icosphere(subdivisions=2, radius=70.0).export(work / "organ.ply")


def state_of(path: Path, varies: tuple[str, ...] = ()) -> str:
    """Hash of a file or of all files of a folder; `absent` where there is none.

    varies: files whose content is left out, which have to be there all the same.
    """
    if not path.exists():
        return "absent"
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        if LEFTOVER.search(str(file.relative_to(path.parent))):
            continue
        digest.update(str(file.relative_to(path.parent)).encode())
        if file.name in varies:
            if file.suffix == ".json":
                json.loads(file.read_text())
            continue
        digest.update(file.read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Moment:
    """When a process is killed."""

    call: int = 0
    """Before this call that changes a file, counted from 1; 0: not at a call."""
    torn: bool = False
    """Whether a write is done by half first."""
    after_s: float | None = None
    """After this time, s."""
    failing: str = ""
    """Instead of a kill: how calls fail from `call` on, a key of FAILING."""


AT_NO_TIME = Moment()


def run_child(call: Callable[[], object], moment: Moment = AT_NO_TIME) -> tuple[int, int]:
    """Run a call in a forked process; (calls that changed a file, exit status)."""
    reading, writing = os.pipe()
    counter = ctypes.CDLL(os.environ["LD_PRELOAD"])
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        code = 1
        if moment.failing:
            number, all_calls = FAILING[moment.failing]
            counter.fail_arm(moment.call, number, int(all_calls))
        else:
            counter.kill_arm(moment.call, int(moment.torn))
        try:
            call()
            code = 0
        except BaseException as error:
            one_line = isinstance(error, InputError | OSError) and moment.failing
            code = BAD_INPUT if one_line else 1
            with contextlib.suppress(OSError):
                os.write(writing, traceback.format_exc().encode())
        finally:
            os.write(writing, b"\0%d" % counter.kill_seen())
            os._exit(code)
    os.close(writing)
    if moment.after_s is not None:
        time.sleep(moment.after_s)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    with os.fdopen(reading, "rb") as pipe:
        said, _, count = pipe.read().rpartition(b"\0")
    status = os.waitpid(pid, 0)[1]
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) not in (0, BAD_INPUT):
        raise RuntimeError(said.decode())
    return int(count or 0), status


def moments(count: int, calls: int, seconds: float, random: random.Random) -> list[Moment]:
    """So many moments: every call once before any of them twice, torn writes, random times."""
    late = round(RANDOM * count)
    torn = round(TORN * count)
    found = [Moment(after_s=random.uniform(0.0, seconds)) for _ in range(late)]
    found += [Moment(random.randint(1, calls), torn=True) for _ in range(torn)]
    at: list[int] = []
    while len(at) < count - len(found):
        at += random.sample(range(1, calls + 1), calls)
    found += [Moment(call) for call in at[: count - len(found)]]
    random.shuffle(found)
    return found


def kill_command(
    name: str, folder: Path, count: int, seed: int, note: Callable, fail: bool = False
) -> None:
    """Kill a command so many times; `note` is given what was left of its output each time.

    fail: let calls fail instead.
    """
    command, inputs, old, work = COMMANDS[name], folder / "in", folder / "old", folder / "work"
    inputs.mkdir(parents=True)
    prepare(inputs)
    shutil.copytree(inputs, old)
    command.run(old, 0)  # warms up this process: everything is imported, compiled and cached
    if not command.replaces:
        shutil.rmtree(old)
        shutil.copytree(inputs, old)

    def whole() -> str:
        return state_of(work / command.output, command.varies)

    shutil.copytree(old, work)
    before = whole()
    began = time.monotonic()
    calls, _ = run_child(lambda: command.run(work, 1))
    seconds, new = time.monotonic() - began, whole()
    if new in (before, "absent"):
        raise RuntimeError(f"{name}: the new output is not told from the old one")
    own = random.Random(f"{seed} {name}")
    chosen = failures(count, calls, own) if fail else moments(count, calls, seconds, own)
    for moment in chosen:
        shutil.rmtree(work)
        shutil.copytree(old, work)
        status, bad = 0, ""
        try:
            _, status = run_child(lambda: command.run(work, 1), moment)
        except RuntimeError as error:
            if not fail:
                raise
            bad = f"a traceback: {str(error).strip().splitlines()[-1]}"
        killed = os.WIFSIGNALED(status) or (fail and status != 0)
        now = whole()
        kind = {before: "old", new: "new", "absent": "absent"}.get(now, "between")
        try:
            if now != "absent":
                with contextlib.suppress(FileNotFoundError):
                    command.read(work / command.output)
            if command.beside:
                command.beside(work)
            if command.finish:
                run_child(lambda: command.finish(work, 1))
                if whole() != new:
                    bad = "continued, it is not what an uninterrupted one gives"
            elif kind == "between":
                bad = "neither the old nor the new output"
        except Exception as error:
            bad = f"{type(error).__name__}: {error}"
        if fail and not bad:
            bad = _wrong_end(status, moment, kind, work)
        note(_row(name, moment, int(killed), kind, bad))


def _wrong_end(status: int, moment: Moment, left: str, work: Path) -> str:
    """What is wrong with the end of a command whose calls failed; empty where nothing is."""
    if not os.WIFEXITED(status):
        return f"it was ended by signal {os.WTERMSIG(status)}"
    if os.WEXITSTATUS(status) == 0 and left != "new":
        return f"it ended well, with its output {left}"
    if moment.failing == "quota":
        for path in work.rglob("*"):
            if LEFTOVER.search(str(path.relative_to(work))):
                return f"{path.name} is left over"
    return ""


def failures(count: int, calls: int, random: random.Random) -> list[Moment]:
    """So many moments from which on calls fail: every call once before any of them twice."""
    found = []
    for failing in FAILING:
        at: list[int] = []
        while len(at) < -(-count // len(FAILING)):
            at += random.sample(range(1, calls + 1), calls)
        found += [Moment(call, failing=failing) for call in at[: -(-count // len(FAILING))]]
    return found


def _row(name: str, moment: Moment, kills: int, left: str, bad: str) -> dict:
    when = "time" if moment.after_s is not None else "in a write" if moment.torn else "call"
    when = moment.failing or when
    about = {"command": name, "killed": kills, "when": when, "left": left, "bad": bad}
    return about | {"call": moment.call, "s": moment.after_s}


TRAININGS = ("fast", "randomised", "paper", "fast normalised")
"""Presets that are trained; `normalised`: with running normalisers of the observations."""


def kill_training(folder: Path, count: int, seed: int, note: Callable) -> None:
    """Kill trainings up to three times, resume to the end, compare with uninterrupted ones."""
    own, done, number = random.Random(f"{seed} train"), 0, 0
    whole, calls = {}, {}
    for preset in TRAININGS:
        first = folder / preset
        _train(folder / f"{preset} warm", preset)
        calls[preset], _ = run_child(partial(_train, first, preset))
        whole[preset] = _weights(first)
    while done < count:
        preset, run = TRAININGS[number % len(TRAININGS)], folder / "run"
        number += 1
        shutil.rmtree(run, ignore_errors=True)
        kills, bad = 0, ""
        moment = Moment()
        for _ in range(own.choice((1, 1, 2, 3))):
            moment = Moment(own.randint(1, calls[preset]), torn=own.random() < TORN)
            try:
                _, status = run_child(partial(_train, run, preset), moment)
                kills += os.WIFSIGNALED(status)
            except Exception as error:
                bad = f"{type(error).__name__}: {error}"
        try:
            run_child(partial(_train, run, preset))
            if _weights(run) != whole[preset]:
                bad = "other weights than the uninterrupted training"
        except Exception as error:
            bad = f"{type(error).__name__}: {error}"
        done += max(1, kills)
        note(_row(TRAIN, moment, kills, f"resumed, {preset}", bad))


def _train(run: Path, name: str) -> None:
    """A new training, or the continuation of the one that is there."""
    import torch

    from surgisoft.agents import training
    from surgisoft.agents.distributed import Processes
    from surgisoft.agents.presets import PRESETS, Plan, config_for
    from surgisoft.tasks.registry import config_of

    training.CHECKPOINT_S = 0.0  # a checkpoint after each iteration
    device = torch.device("cpu")
    if (run / "config.json").is_file():
        training.resume(run, Processes(), device)
        return
    base, _, normalised = name.partition(" ")
    small = {"envs": 4, "rollout": 4, "epochs": 1, "batches": 2, "hidden": (8,)}
    preset = replace(
        PRESETS[base], **small, evaluation_episodes=1, normalise=bool(normalised), evaluate_every=2
    )
    plan = Plan("track_circle", config_for(base, config_of("track_circle")), base, preset, steps=64)
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


def preloaded() -> None:
    """Start this program again with the library that counts calls, where it is not loaded."""
    if "kill_at_call" in os.environ.get("LD_PRELOAD", ""):
        return
    library = Path(tempfile.mkdtemp()) / "kill_at_call.so"
    build = ["cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(COUNTER), "-ldl"]
    subprocess.run(build, check=True)
    os.environ.update(LD_PRELOAD=str(library), OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")
    os.execv(sys.executable, [sys.executable, "-m", "benchmarks.kills", *sys.argv[1:]])


def served(name: str, count: int, seed: int, note: Callable[[dict], None], fail: bool) -> int:
    """Kill one command in a process of its own; its exit code, 0 where all kills were made."""
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        code = 1
        warnings.simplefilter("ignore")
        try:
            with scratch() as folder:
                os.chdir(folder)
                kill = kill_training if name == TRAIN else None
                if kill is None:
                    kill_command(name, folder, count, seed, note, fail)
                else:
                    kill(folder, count, seed, note)
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def report(rows: list[dict], names: list[str]) -> str:
    """The table of all kills."""
    kills, left, bad = Counter(), {name: Counter() for name in names}, Counter()
    for row in rows:
        name = row["command"]
        kills[name] += row["killed"]
        left.setdefault(name, Counter())[row["left"]] += 1
        bad[name] += bool(row["bad"])
    lines = ["| command | kills | what was left | damaged |", "|---|---|---|---|"]
    for name in left:
        words = ", ".join(f"{n} {kind}" for kind, n in sorted(left[name].items()))
        lines.append(f"| {name} | {kills[name]} | {words} | {bad[name]} |")
    when = Counter()
    for row in rows:
        when[row["when"]] += row["killed"]
    lines.append(f"| all | {sum(kills.values())} | | {sum(bad.values())} |")
    said = ", ".join(f"{n} {kind}" for kind, n in when.items())
    return "\n".join([*lines, "", f"moments: {said}"])


def main() -> int:
    """Parse, kill, print; exit code 1 where something was left half."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=600, help="number of kills (600)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[*COMMANDS, TRAIN])
    parser.add_argument("--fail", action="store_true", help="let calls that change files fail "
                        "instead of killing")  # fmt: skip
    parser.add_argument("--log", type=Path, help="append each kill; commands that are complete in "
                        "it are not killed again")  # fmt: skip
    given = parser.parse_args()
    preloaded()
    for module in ("surgisoft.agents.training", "surgisoft.experiments.session", "trimesh",
                   "surgisoft.live.session", "surgisoft.surrogate.export"):  # fmt: skip
        __import__(module)
    log = (given.log or Path(tempfile.mkdtemp()) / "kills.jsonl").absolute()
    if given.fail:
        given.only = [name for name in given.only if name != TRAIN]
    shares = {name: COMMANDS[name].share if name in COMMANDS else 1.5 for name in given.only}

    def note(row: dict) -> None:
        with log.open("a") as file:
            file.write(json.dumps(row | {"seed": given.seed}) + "\n")
        if row["bad"]:
            print(f"{row['command']}: {row}", flush=True)

    failed = False
    for name in given.only:
        count = -(-given.kills * shares[name] // sum(shares.values()))
        earlier = [
            row for row in _rows(log) if row["command"] == name and row["seed"] == given.seed
        ]
        count = int(count) - sum(max(1, row["killed"]) for row in earlier)
        if count > 0:
            began = time.monotonic()
            failed |= served(name, count, given.seed + len(earlier), note, given.fail) != 0
            print(f"{name}: {count} kills in {time.monotonic() - began:.0f} s", flush=True)
    rows = _rows(log)
    print(report(rows, given.only))
    return int(failed or any(row["bad"] for row in rows))


def _rows(log: Path) -> list[dict]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []


if __name__ == "__main__":
    sys.exit(main())
