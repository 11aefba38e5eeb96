"""Logs of recordings: what was measured survives a crash, and opens as a recording."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.errors import AssumptionWarning, InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import load_recording
from surgisoft.measurement.recordings.log import LogHeader, read_log, recording_log
from surgisoft.measurement.recordings.recording import ArmInfo
from surgisoft.rig import VirtualRig, collect
from surgisoft.rig.trial import collect as collect_on
from tests.rig.test_safety import Valves

SETTLED = Protocol("p", "settled", [[5.0, 0, 0], [9.0, 0, 3], [0, 0, 7]], [0, 0, 1], None, 0.2, 0.2)
MOVING = Protocol("w", "continuous", [[0, 0, 0], [8.0, 2, 0]], [3, 3], [0.0, 0.5])


def same(a, b):
    for name in ("t_s", "measured", "key_points_mm", "commanded", "run", "temp_C", "payload_g"):
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            np.testing.assert_allclose(one, other, atol=1e-12, err_msg=name)
    assert (a.kind, a.unit, a.arm, a.note, a.name) == (b.kind, b.unit, b.arm, b.note, b.name)
    np.testing.assert_allclose(a.gravity, b.gravity)


@pytest.mark.parametrize("protocol", [SETTLED, MOVING], ids=["settled", "continuous"])
def test_a_log_is_the_recording(protocol, tmp_path):
    log = tmp_path / "r.log.jsonl"
    rig = VirtualRig(1, payload_g=1.0, hidden=[("thermal_drift", 1.0)])
    recording = collect(rig, protocol, log=log)
    read, lacking = read_log(log)
    assert lacking == ""
    same(read, recording)


def test_a_temperature_that_a_frame_lacks_is_none_of_the_recording(tmp_path):
    """Several frames of one steady-state point, the second without it."""
    log = tmp_path / "r.log.jsonl"
    collect(VirtualRig(1), SETTLED, log=log)
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert lines[1]["row"] == lines[2]["row"]
    del lines[2]["temp_C"]
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert read_log(log)[0].temp_C is None


class Flickering(Valves):
    """Of 20 samples the sensors are silent in two, and the clock stands still in one."""

    def read(self):
        sample = super().read()
        k = round(self.t_s / self.period_s)
        if k in (5, 6):
            return replace(sample, measured=np.array([1.0, np.nan]))
        return replace(sample, t_s=sample.t_s - (self.period_s if k == 12 else 0.0))


def test_samples_without_a_pressure_or_a_later_time_are_left_out(tmp_path):
    """The others are kept, by the recording and by its log alike; times are of 20 Hz."""
    log = tmp_path / "w.log.jsonl"
    plan = Protocol("w", "continuous", [[0.0, 0.0], [8.0, 2.0]], [3, 3], [0.0, 1.0])
    with pytest.warns(AssumptionWarning, match="3 samples left out: without a pressure, or"):
        recording = collect_on(plan, Flickering(), log=log)
    kept = [k for k in range(20) if k not in (4, 5, 11)]
    np.testing.assert_allclose(recording.t_s, 0.05 * np.array(kept), atol=1e-12)
    assert np.isfinite(recording.measured).all()
    with pytest.warns(UserWarning, match="3 samples left out: without a pressure, or"):
        read = load_recording(log)
    for name in ("t_s", "measured", "key_points_mm", "commanded", "run"):
        np.testing.assert_allclose(getattr(read, name), getattr(recording, name), atol=1e-12)


def test_a_log_without_any_pressure_is_one_line(tmp_path):
    log = tmp_path / "w.log.jsonl"
    with recording_log(log, LogHeader("w", "continuous", "kPa", 1, 1, ArmInfo())) as writer:
        writer.sample(0, 0, 0.0, np.array([np.nan]), np.zeros((1, 3)))
    with pytest.raises(InputError, match="has no sample with every pressure"):
        read_log(log)


def test_a_run_that_ends_before_its_first_sample_leaves_no_log(tmp_path):
    """A valve that is stuck at the start would be in the way of the next try."""
    log = tmp_path / "w.log.jsonl"

    class Stuck(Valves):
        def reset(self):
            raise InputError("chamber 1 is still at 9.0 kPa")

    for _ in range(2):
        with pytest.raises(InputError, match="chamber 1 is still at"):
            collect_on(Protocol("p", "settled", [[1.0, 2.0]], [0]), Stuck(), log=log)
        assert list(tmp_path.iterdir()) == []


def test_a_torn_log_opens_and_says_what_is_missing(tmp_path, capsys):
    log = tmp_path / "r.log.jsonl"
    whole = collect(VirtualRig(1), SETTLED, log=log)
    text = log.read_bytes()
    lines = text.splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:10]) + lines[10][:25])
    read, lacking = read_log(log)
    assert lacking == "its last line is incomplete and was left out"
    assert read.samples == 3
    np.testing.assert_allclose(read.measured[:2], whole.measured[:2])
    log.write_bytes(b"".join(lines[:6]) + b'{"row":1,"p":[\n')
    assert "its last line is incomplete and was left out" in read_log(log)[1]
    log.write_bytes(b"".join(lines[:6]) + b"\0" * 40)
    assert read_log(log)[1] == (
        "it was interrupted after 2 of 3 samples; its last line is incomplete and was left out"
    )
    out = tmp_path / "r.parquet"
    assert run(["import", str(log), "-o", str(out)]) == 0
    assert "note: it was interrupted after 2 of 3 samples" in capsys.readouterr().out
    assert load_recording(out).samples == 2
    with pytest.warns(UserWarning, match="interrupted after 2 of 3"):
        assert load_recording(log).samples == 2


def _log(path, commands=((1.0,), (2.0,)), rows=(0, 1)):
    """A log of samples of one chamber, one by one."""
    header = LogHeader("n", "settled", "kPa", 1, 1, ArmInfo(), rows=rows[-1] + 1)
    with recording_log(path, header) as log:
        for number, (row, command) in enumerate(zip(rows, commands, strict=True)):
            log.sample(row, 0, 0.1 * number, np.ones(1), np.ones((1, 3)), np.array(command))
    return path


def test_a_last_line_that_lacks_its_end_alone_counts(tmp_path):
    path = _log(tmp_path / "r.log.jsonl")
    path.write_bytes(path.read_bytes().rstrip(b"\n"))
    read, lacking = read_log(path)
    assert (read.commanded[:, 0].tolist(), lacking) == ([1.0, 2.0], "")


@pytest.mark.parametrize("reserved", [b"\n\n", b"\0\0\n\0\0\n"])
def test_lines_without_content_at_the_end_are_none(reserved, tmp_path):
    path = _log(tmp_path / "r.log.jsonl")
    path.write_bytes(path.read_bytes() + reserved)
    read, lacking = read_log(path)
    assert (read.samples, lacking) == (2, "")


def test_the_command_of_an_averaged_sample_is_its_last_one(tmp_path):
    """As in the recording: a rig that ramps a set point has it at the end."""
    read, _ = read_log(_log(tmp_path / "r.log.jsonl", ((1.0,), (3.0,), (5.0,)), (0, 0, 1)))
    np.testing.assert_array_equal(read.commanded[:, 0], [3.0, 5.0])
    np.testing.assert_allclose(read.t_s, [0.0, 0.15])


def test_logs_of_one_name_are_two_recordings_that_nobody_can_tell_apart(tmp_path, capsys):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    logs = [str(_log(tmp_path / name / "r.log.jsonl")) for name in ("one", "two")]
    assert run(["import", *logs, "-o", str(tmp_path / "new"), "--force"]) == 2
    assert "2 files would become the recording 'r.log'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


SAMPLE = '{head}\n{"row":0,"run":RUN,"t_s":0,"p":[1],"k":[[0,0,0]]}\n{}\n'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty, expected a surgisoft recording log"),
        ('{"a": 1}\n', "line 1: no surgisoft recording log"),
        ('{"format": "surgisoft recording log", "version": 9}\n', "line 1: version 9, expected 1"),
        ('{"format": "surgisoft recording log", "version": 1}\n', "name: missing; expected text"),
        (
            '{head}\n{"row":0,"run":1e400,"t_s":0,"p":[1],"k":[[0,0,0]]}\n{}\n',
            "'run' is inf",
        ),
        (
            '{head}\n{"row":0,"run":0,"t_s":0,"p":[9' + "9" * 400 + '],"k":[[0,0,0]]}\n{}\n',
            "'p' is",
        ),
        ('{"a":' * 100_000 + "\n{}\n", "line 1: not a line of"),
        ("{head}" + "\n" + "[" * 100_000 + "\n{}\n", "line 2: not a line of"),
        ("{head}\n", "the log has no sample yet"),
        ('{head}\n{"row": 0}\n{"row": 1}\n', "line 2: 'run' is None, expected"),
        (
            '{head}\n{"row":0,"run":0,"t_s":0,"p":[1,2],"k":[[0,0,0]]}\n{}\n',
            r"line 2: 'p' is \[1, 2\], expected numbers of shape \(1,\)",
        ),
        ("{head}\nx\n{}\n", "line 2: not a line of a surgisoft recording log"),
    ],
)
def test_a_file_that_is_no_whole_log_is_one_line(content, message, tmp_path):
    path = tmp_path / "x.jsonl"
    with recording_log(path, LogHeader("n", "settled", "kPa", 1, 1, ArmInfo())):
        pass
    path.write_text(content.replace("{head}", path.read_text().strip()))
    with pytest.raises(InputError, match=message):
        read_log(path)


def test_a_log_that_is_there_is_not_overwritten(tmp_path):
    log = tmp_path / "r.log.jsonl"
    collect(VirtualRig(1), SETTLED, log=log)
    before = log.read_text()
    with pytest.raises(InputError, match="the log of an interrupted recording is there"):
        collect(VirtualRig(2), SETTLED, log=log)
    assert log.read_text() == before
    collect(VirtualRig(2), SETTLED, log=log, force=True)
    assert log.read_text() != before


PROGRAM = """
import sys, time
sys.path.insert(0, {root!r})
from surgisoft.rig.virtual import VirtualRig
from surgisoft.rig.collect import collect
from surgisoft.measurement.protocols import Protocol

class Slow(VirtualRig):
    def read(self):
        time.sleep(0.02)
        sample = super().read()
        print("sample", flush=True)
        return sample

collect(Slow(1), Protocol("w", "continuous", [[0, 0, 0], [8.0, 2, 0]], [0, 0], [0.0, 500.0]),
        log={log!r})
"""


def test_after_kill_9_every_sample_is_there(tmp_path):
    log = tmp_path / "r.log.jsonl"
    program = PROGRAM.format(root=os.getcwd(), log=str(log))
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    for _ in range(6):
        assert child.stdout.readline() == "sample\n"
    child.kill()
    taken = 6 + len(child.stdout.read().splitlines())
    child.wait()
    recording, lacking = read_log(log)
    assert taken - 1 <= recording.samples <= taken, "all but the one that was being written"
    assert f"interrupted after {recording.samples} of 10000 samples" in lacking
    np.testing.assert_allclose(np.diff(recording.t_s), 0.05, atol=1e-9)


def test_the_disk_is_told_to_write_while_the_recording_runs(tmp_path, monkeypatch):
    told = []
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (told.append(time.monotonic()), real(number)))
    header = LogHeader("n", "continuous", "kPa", 1, 1, ArmInfo())
    with recording_log(tmp_path / "x.jsonl", header) as log:
        log.sample(0, 0, 0.0, np.zeros(1), np.zeros((1, 3)))
        time.sleep(1.3)
        during = len(told)
    assert during >= 2
    assert json.loads((tmp_path / "x.jsonl").read_text().splitlines()[1])["p"] == [0.0]


def test_a_disk_that_is_busy_does_not_hold_up_the_loop_that_measures(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda number: time.sleep(0.4))
    monkeypatch.setattr("surgisoft.measurement.recordings.log.SYNC_S", 0.01)
    header = LogHeader("n", "continuous", "kPa", 1, 1, ArmInfo())
    took = []
    with recording_log(tmp_path / "x.jsonl", header) as log:
        for row in range(40):
            began = time.perf_counter()
            log.sample(row, 0, 0.02 * row, np.zeros(1), np.zeros((1, 3)))
            took.append(time.perf_counter() - began)
            time.sleep(0.02)
    assert np.median(took) < 0.01
    assert max(took) < 0.2
    assert len(read_log(tmp_path / "x.jsonl")[0].t_s) == 40


def test_a_full_disk_is_reported_to_the_loop():
    header = LogHeader("n", "continuous", "kPa", 1, 1, ArmInfo())
    taken = []

    def measure():
        with recording_log(Path("/dev/full"), header, True) as log:
            for row in range(100):
                log.sample(row, 0, 0.02 * row, np.zeros(1), np.zeros((1, 3)))
                taken.append(row)
                time.sleep(0.01)

    with pytest.raises(OSError, match="No space left"):
        measure()
    assert len(taken) < 100
