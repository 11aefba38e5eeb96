"""Runs of the fuzzer: worker processes with limits, the record of what they find.

The parent forks a worker for each batch of inputs, so that a crash, a hang or an allocation ends a
worker and not the run. Input number i of a target is the same for the same
seed and the same corpus.
"""

import contextlib
import json
import mmap
import os
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.fuzz.mutations import mutated
from benchmarks.fuzz.targets import TARGETS, Target
from surgisoft import apart
from surgisoft.errors import InputError


@dataclass(frozen=True)
class Limits:
    """What reading one file may take."""

    hang_s: float = 5.0
    """Processor time of one input, s."""
    wall_s: float = 120.0
    """Wall time of one input, s: for a reader that waits; a loaded machine has to stay below."""
    memory_bytes: int = 1 << 30
    """Address space beyond that of a worker which has read the valid files."""
    batch_s: float = 60.0
    """Processor time for which one worker reads, s: on a busy machine it would spend most of a wall
    time on importing what it needs."""
    message: int = 1000
    """Longest message, characters."""


def fuzz(
    names: Sequence[str],
    seconds: float,
    workers: int,
    seed: int,
    limits: Limits,
    note: Callable[[dict], None],
    planned: Mapping[str, int] | None = None,
    done: Mapping[str, int] | None = None,
    kept: Path | None = None,
) -> None:
    """Fuzz the named targets for some time; `note` is given the record of each batch.

    planned: inputs of each target after which it is done, so that the run may end early. done:
    inputs of each target that an earlier run has read; this one goes on behind them. kept: folder
    for the valid files, which are made where it lacks them; None: in memory, made anew.
    """
    os.environ.update(OMP_NUM_THREADS="1", MALLOC_ARENA_MAX="1")
    with scratch() as folder:
        corpus = kept or folder / "corpus"
        makers: dict[Callable, str] = {}
        for name in names:
            same = makers.setdefault(TARGETS[name].make, name)
            if same != name and not (corpus / name).is_dir():
                shutil.copytree(corpus / same, corpus / name)
            elif not (corpus / name).is_dir():
                in_child(lambda name=name: make_corpus(corpus, name))
        apart.started = forked
        end = time.monotonic() + seconds
        position = {name: (done or {}).get(name, 0) for name in names}
        turns, spent = turns_of(names), Counter(dict.fromkeys(names, 0.0))
        running: dict[int, Batch] = {}
        while True:
            left = [n for n in names if planned is None or position[n] < planned[n]]
            if not running and (not left or time.monotonic() >= end):
                return
            busy = {batch.target for batch in running.values()}
            free = [n for n in left if n not in busy or (planned is None and len(left) < workers)]
            if len(running) < workers and time.monotonic() < end and free:
                if planned is None:
                    name, last = next(n for n in turns if n in free), None
                else:  # quick readers are done first, slow ones share the rest of the time
                    name = min(free, key=lambda n: spent[n])
                    last = planned[name]
                batch = Batch(name, seed, position[name], corpus / name, folder, limits, end, last)
                running[batch.start()] = batch
                # Numbers of another worker of the same target must not overlap.
                position[name] += 1_000_000 if planned is None and len(names) < workers else 0
                continue
            for pid in list(running):
                record = running[pid].finished()
                if record is not None:
                    batch = running.pop(pid)
                    position[batch.target] = max(position[batch.target], record.pop("next"))
                    spent[batch.target] += record["seconds"]
                    note(record)
            time.sleep(0.02)


def turns_of(names: Sequence[str]) -> Iterator[str]:
    """The targets in turn for ever, each as often as its weight says."""
    due = dict.fromkeys(names, 0.0)
    while True:
        name = min(due, key=due.__getitem__)
        due[name] += 1.0 / TARGETS[name].weight
        yield name


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """A folder in memory where there is one, deleted at the end."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)


def in_child(call: Callable[[], None]) -> None:
    """Run a call in a forked process, so that the parent starts no threads."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            call()
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    if os.waitpid(pid, 0)[1] != 0:
        raise RuntimeError("the corpus could not be made")


def make_corpus(corpus: Path, name: str) -> None:
    """The valid files of a target; they must be readable."""
    target = TARGETS[name]
    with contextlib.redirect_stdout(sys.stderr), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        target.make(corpus / name)
        for sample in samples_of(corpus / name):
            target.read(sample)


def samples_of(folder: Path) -> list[Path]:
    """The samples of a corpus."""
    return sorted(path for path in folder.iterdir() if path.is_dir())


class Inputs:
    """The inputs of a target by number, put into a folder one after another."""

    def __init__(self, target: Target, corpus: Path, work: Path, seed: int):
        self.seed, self.samples = seed, []
        for sample in samples_of(corpus):
            copy = work / sample.name
            shutil.copytree(sample, copy)
            files = sorted({f for p in target.mutable for f in copy.rglob(p) if f.is_file()})
            self.samples.append((copy, {file: file.read_bytes() for file in files}))

    @contextlib.contextmanager
    def put(self, number: int) -> Iterator[Path]:
        """The sample with the mutated files of input `number`; whole again afterwards."""
        own = random.Random(f"{self.seed} {number}")
        sample, files = own.choice(self.samples)
        chosen = own.sample(list(files), min(len(files), own.choice((1, 1, 1, 1, 2))))
        for file in chosen:
            file.write_bytes(mutated(own, file.name, files[file]))
        try:
            yield sample
        finally:
            for file in chosen:
                file.write_bytes(files[file])


@dataclass
class Batch:
    """One worker and its inputs."""

    target: str
    seed: int
    first: int
    corpus: Path
    folder: Path
    limits: Limits
    end: float
    last: int | None = None
    """Number behind that of the last input; None: until the time of a worker is over."""

    def start(self) -> int:
        """Fork the worker; returns its process id."""
        self.now = mmap.mmap(-1, 16)
        self.now[:16] = struct.pack("<qd", self.first, time.monotonic())
        self.out, self.began = Path(tempfile.mkdtemp(dir=self.folder)), time.monotonic()
        sys.stdout.flush()
        parent = os.getpid()
        self.pid = os.fork()
        if self.pid == 0:
            try:
                self._work(parent)
                os._exit(0)
            except BaseException:
                traceback.print_exc()
                os._exit(70)
        return self.pid

    def finished(self) -> dict | None:
        """The record of the worker when it has ended; None while it runs."""
        number, since = struct.unpack("<qd", self.now[:16])
        stuck = time.monotonic() - since > self.limits.wall_s
        if stuck:
            os.kill(self.pid, signal.SIGKILL)
        pid, status = os.waitpid(self.pid, 0 if stuck else os.WNOHANG)
        if pid == 0:
            return None
        findings = [json.loads(line) for line in self._lines()]
        code = os.waitstatus_to_exitcode(status)
        if code != 0:
            kind = "hang" if stuck or -code in (signal.SIGPROF, signal.SIGXCPU) else "crash"
            name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            findings.append(_finding(self.target, number, kind, name, "", name))
            number += 1
        shutil.rmtree(self.out, ignore_errors=True)
        return {
            "target": self.target,
            "first": self.first,
            "inputs": number - self.first,
            "seconds": round(time.monotonic() - self.began, 2),
            "next": number,
            "findings": findings,
        }

    def _goes_on(self, began: float) -> bool:
        """Whether this worker reads another input; began: processor time before its first one."""
        return time.monotonic() < self.end and _used_s() - began < self.limits.batch_s

    def _lines(self) -> list[str]:
        file = self.out / "findings.jsonl"
        return file.read_text().splitlines() if file.is_file() else []

    def _work(self, parent: int) -> None:
        """Read inputs until the time is over, or the parent has gone."""
        target = TARGETS[self.target]
        for name in target.imports:
            __import__(name)
        warnings.simplefilter("ignore")
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        inputs = Inputs(target, self.corpus, self.out / "work", self.seed)
        for sample, _ in inputs.samples:
            target.read(sample)
        with (self.out / "findings.jsonl").open("w") as file:
            _limit(self.limits)
            number, began = self.first, _used_s()
            while self._goes_on(began) and number != self.last and os.getppid() == parent:
                self.now[:16] = struct.pack("<qd", number, time.monotonic())
                with inputs.put(number) as sample:
                    signal.setitimer(signal.ITIMER_PROF, self.limits.hang_s)
                    found = examine(self.target, number, sample, self.limits)
                    signal.setitimer(signal.ITIMER_PROF, 0.0)
                if found is not None:
                    file.write(json.dumps(found) + "\n")
                    file.flush()
                number += 1
            self.now[:16] = struct.pack("<qd", number, time.monotonic())


def _used_s() -> float:
    """Processor time of this process and of its children that have ended, s."""
    return sum(os.times()[:4])


def _limit(limits: Limits) -> None:
    """Limit the address space, and let the timer of processor time end the process."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + limits.memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)


def forked(module: str, path: Path) -> apart.Ended:
    """`surgisoft.apart.started` where the process that reads is forked from this one.

    It has imported the library already, so that an input takes the time of reading it.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                signal.setitimer(signal.ITIMER_PROF, 0.0)
                os.dup2(out.fileno(), 1)
                os.dup2(errors.fileno(), 2)
                sys.stdout, sys.stderr = (os.fdopen(n, "w", closefd=False) for n in (1, 2))
                code = apart.answer(module, path)
                sys.stderr.flush()
            except BaseException as error:
                os.write(2, f"{type(error).__name__}: {error}".encode("utf-8", "replace"))
            finally:
                os._exit(code)
        _, status, used = os.wait4(pid, 0)
        if used.ru_utime + used.ru_stime > Limits.hang_s:
            raise RuntimeError(f"the reading process computed for {used.ru_utime:.0f} s")
        out.seek(0)
        errors.seek(0)
        return apart.Ended(os.waitstatus_to_exitcode(status), out.read(), errors.read())


def examine(name: str, number: int, sample: Path, limits: Limits) -> dict | None:
    """Read one sample; None where it ends in a value or in one line."""
    try:
        TARGETS[name].read(sample)
    except InputError as error:
        if _out_of_memory(error):
            return _finding(name, number, "memory", "InputError", _place(error), str(error))
        bad = "\n" in str(error) or len(str(error)) > limits.message or not str(error).isprintable()
        if bad:
            return _finding(name, number, "message", "InputError", _place(error), repr(str(error)))
    except OSError:
        pass  # the command line prints these in one line, with the file
    except MemoryError as error:
        return _finding(name, number, "memory", "MemoryError", _place(error), str(error))
    except BaseException as error:
        kind = type(error).__name__
        return _finding(name, number, "traceback", kind, _place(error), str(error))
    return None


def _out_of_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def _place(error: BaseException) -> str:
    """The innermost line of the project, and the innermost line at all."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/surgisoft/" in frame.filename]
    last = [own[-1]] if own else []
    if frames and frames[-1] not in last:
        last.append(frames[-1])
    return " < ".join(
        f"{'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno}" for frame in reversed(last)
    )


def _finding(target: str, number: int, kind: str, error: str, place: str, message: str) -> dict:
    text = message[:300].encode("utf-8", "replace").decode()
    about = {"target": target, "input": number, "kind": kind}
    return about | {"type": error, "place": place, "message": text}


def again(name: str, seed: int, number: int, keep: Path | None) -> None:
    """Read one input in this process, without limits, so that its traceback is shown."""
    with scratch() as folder:
        make_corpus(folder / "corpus", name)
        inputs = Inputs(TARGETS[name], folder / "corpus" / name, folder / "work", seed)
        with inputs.put(number) as sample:
            if keep is not None:
                shutil.copytree(sample, keep)
            try:
                TARGETS[name].read(sample)
            except InputError as error:
                print(f"one line: {error}")
            else:
                print("it is read")
