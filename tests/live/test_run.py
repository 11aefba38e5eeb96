"""Runs on the virtual rig and on one that knows no truth: what is recorded, found, and vented."""

import gc
import json
import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

import surgisoft
from surgisoft.cli import run as command
from surgisoft.diagnosis.data_quality import alarm_hints
from surgisoft.diagnosis.residuals import Sealed
from surgisoft.errors import InputError
from surgisoft.live import session
from surgisoft.live.change import Charts
from surgisoft.live.session import LEAD_IN_S, elsewhere, run
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.recordings import load_recording
from surgisoft.rig import VirtualRig
from surgisoft.rig.safety import RigStopped
from surgisoft.surrogate.checkpoint import default_arm, load_model
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.track import TrackConfig
from tests.replay.reading import column

SIMULATED = {"clock": "simulated", "on_warning": pytest.fail}


class Kept(VirtualRig):
    """A virtual rig that keeps its last command and whether it was closed."""

    last = None

    def command(self, pressures):
        super().command(pressures)
        self.last = np.array(pressures)


class Real:
    """The virtual rig without its truth, as a real rig is."""

    def __init__(self, seed=0, fails_at=None, error=None):
        self._rig = Kept(seed)
        self.fails_at, self.error, self.reads, self.closed = fails_at, error, 0, False

    def __getattr__(self, name):
        if name in ("read_beside_truth", "vent", "record"):
            raise AttributeError(name)
        return getattr(self._rig, name)

    def read(self):
        self.reads += 1
        if self.reads == self.fails_at:
            raise self.error
        return self._rig.read()

    def close(self):
        self.closed = True


@pytest.fixture(scope="module")
def schedule(tmp_path_factory):
    """Sinusoids of three chambers, 70 s long."""
    path = tmp_path_factory.mktemp("schedule") / "waves.csv"
    t_s = np.arange(0.0, 70.5, 0.5)
    waves = 20 + 15 * np.sin(2 * np.pi * t_s[:, None] / 12 + np.arange(3) * 2.1)
    waves *= np.minimum(1.0, t_s / 5.0)[:, None]
    rows = [f"{t},{a},{b},{c}" for t, (a, b, c) in zip(t_s, waves, strict=True)]
    path.write_text("\n".join(["t_s,c1_kPa,c2_kPa,c3_kPa", *rows]) + "\n")
    return str(path)


@pytest.fixture(scope="module")
def changed(schedule, tmp_path_factory):
    """A run with a payload from 50 s on: result and the lines that it reported."""
    lines = []
    folder = tmp_path_factory.mktemp("changed")
    found = run(
        schedule,
        "virtual:hidden=payload@50",
        reference_s=35.0,
        output=folder / "run.parquet",
        replay=folder / "run.rrd",
        on_event=lines.append,
        **SIMULATED,
    )
    return found, lines


def test_a_run_records_what_collect_records(schedule, changed):
    """The same protocol on the same rig, and the model's prediction of the whole recording."""
    found, _ = changed
    other = surgisoft.collect(schedule, VirtualRig(0, hidden=[("payload", 1.0, 50.0)]))
    saved = load_recording(found.written[0])
    for recording in (found.recording, saved):
        np.testing.assert_array_equal(recording.key_points_mm, other.key_points_mm)
        np.testing.assert_array_equal(recording.measured, other.measured)
        np.testing.assert_array_equal(recording.commanded, other.commanded)
    history = history_of([saved])
    with torch.inference_mode():
        whole = history.rows(load_model("default").predict(history)).numpy()
    np.testing.assert_allclose(found.predicted_mm, whole, atol=1e-4)
    assert not found.written[0].with_name("run.log.jsonl").exists()


def test_the_payload_is_found_in_seconds(changed):
    found, lines = changed
    (alarm,) = found.alarms
    assert 50.0 < alarm.at_s < 60.0
    assert alarm.since_s == pytest.approx(50.0, abs=6.0)
    assert found.rms_mm(end_s=50.0) < 0.15 < 0.3 < found.rms_mm(begin_s=50.0)
    assert lines[-1] == alarm.sentence
    assert "reference: 34 s" in lines[0]
    assert np.isnan(found.statistic[found.recording.t_s < 34.0]).all()
    assert np.nanmax(found.statistic[found.recording.t_s < 49.5]) < 1.0


def test_what_came_after_the_change_is_a_recording_of_its_own(changed):
    found, _ = changed
    after = load_recording(found.written[1], on_warning=lambda text: None)
    begin_s = found.alarms[0].since_s
    seen = np.isfinite(after.key_points_mm).any((1, 2))
    assert after.t_s[seen].min() == pytest.approx(begin_s, abs=0.06)
    assert after.t_s[0] == pytest.approx(max(0.0, begin_s - LEAD_IN_S), abs=0.06)
    rows = found.recording.t_s >= begin_s
    np.testing.assert_array_equal(after.key_points_mm[seen], found.recording.key_points_mm[rows])


def test_a_diagnosis_of_the_whole_run_names_its_alarm(changed, tmp_path):
    """The recording keeps the alarm, what came after it has none, and no alarm gives no hint."""
    found, _ = changed
    whole, after = (load_recording(path, on_warning=lambda _: None) for path in found.written)
    assert whole.alarm == found.recording.alarm
    assert (whole.alarm.raised_s, whole.alarm.since_s) == (
        found.alarms[0].at_s,
        found.alarms[0].since_s,
    )
    assert after.alarm is None
    result = surgisoft.diagnose("default", whole, setup_tests=False, refit="never")
    first, *rest = result.checks
    assert f"run: an alarm was raised at {whole.alarm.raised_s:.1f} s of the run" in first
    assert f"not been valid since {whole.alarm.since_s:.1f} s; this diagnosis looked at" in first
    assert first.endswith(f"diagnose {found.written[1]}, which begins there")
    assert not [text for text in rest if "alarm" in text]
    late = replace(whole, alarm=replace(whole.alarm, since_s=60.0))
    parts = Sealed([late, after]).training
    (hint,) = alarm_hints([late, after], parts)
    assert "at no sample after it, because the last quarter is held out; diagnose /" in hint
    assert "samples of before and after it together" in alarm_hints([late], [late])[0]
    moved = replace(late, source=tmp_path / "run.parquet")
    (hint,) = alarm_hints([moved], [moved])
    assert hint.endswith("; diagnose the samples from 60.0 s on alone")
    assert alarm_hints([after], [after]) == ()


def test_the_view_holds_every_sample(changed, tmp_path):
    found, _ = changed
    file = found.written[0].with_suffix(".rrd")
    drawn = column(file, "/plots/pressure/measured", "Scalars:scalars", "time")
    values = [value for place, value in sorted(drawn.items()) if not np.isnan(value).all()]
    np.testing.assert_allclose(values, found.recording.measured)
    level = column(file, "/plots/alarm/level", "Scalars:scalars", "time")
    shown = [value for value in level.values() if not np.isnan(value).all()]
    assert len(shown) == np.isfinite(found.statistic).sum()
    texts = column(file, "/events", "TextLog:text", "time").values()
    # Long events are shown in lines, of which `column` has the last.
    end = " ".join(found.alarms[0].sentence.split()[-2:])
    assert any(text[0].endswith(end) for text in texts)


def test_a_recording_of_the_morning_is_the_reference(schedule, monkeypatch):
    """A run begins with a reset and ends with one, at which the charts begin anew."""
    paused = []

    class Watched(Charts):
        def pause(self):
            paused.append(self)
            super().pause()

    monkeypatch.setattr(session, "Charts", Watched)
    morning = surgisoft.collect(schedule, VirtualRig(0, take=5))
    found = run(
        schedule, "virtual:hidden=payload@20", before=morning, stop_on_alarm=True, **SIMULATED
    )
    assert found.detector.reference_s == pytest.approx(69.5)
    assert 20.0 < found.alarms[0].at_s < 30.0
    assert found.recording.t_s[-1] == pytest.approx(found.alarms[0].at_s, abs=0.11)
    clean = run(schedule, "virtual:noise_seed=6", before=morning, minutes=0.5, **SIMULATED)
    assert not clean.alarms
    assert len(paused) == 2 * (len(found.recording.runs) + len(clean.recording.runs))


def test_a_policy_goes_on_to_new_goals(tmp_path):
    short = TrackConfig(FollowConfig(loop_s=5.0, approach_s=2.0, size_mm=5.0))
    fields = {"task": "track_circle", "config": short, "rate_hz": 10.0}
    found = run("scripted", minutes=0.3, **fields, **SIMULATED)
    assert found.recording.t_s[-1] == pytest.approx(18.0, abs=0.11)
    assert found.recording.run.max() == 0, "the rig is not reset between goals"
    t_s, error = found.tracking.T
    assert np.isnan(error[(t_s > 11.2) & (t_s < 12.8)]).all(), "the second goal's approach"
    assert np.nanmean(error[t_s > 13.2]) < 0.12
    assert found.detector is None


def test_the_rate_of_the_loop_may_differ_from_that_of_the_samples(schedule):
    found = run(schedule, rate_hz=50.0, minutes=0.05, **SIMULATED)
    assert np.diff(found.recording.t_s) == pytest.approx(0.02)
    assert found.timing.period_s == pytest.approx(0.02)
    slow = run("random", task="track_circle", rate_hz=10.0, minutes=0.12, **SIMULATED)
    moves = np.diff(slow.recording.commanded, axis=0).any(axis=1)
    assert not moves[82:-1:2].any() or not moves[83:-1:2].any(), "one command in two samples"


def test_objects_that_the_caller_left_alone_are_left_alone_afterwards(schedule, monkeypatch):
    """Those that Python does not search for cycles; where there were none, there are none."""
    monkeypatch.setattr(gc, "collect", lambda *_: 0)  # half a second, for all that pytest holds
    gc.freeze()
    before = gc.get_freeze_count()
    run(schedule, minutes=0.05, **SIMULATED)
    kept = gc.get_freeze_count()
    gc.unfreeze()
    run(schedule, minutes=0.05, **SIMULATED)
    free = gc.get_freeze_count()
    gc.freeze()
    assert 0.9 * before < kept <= before
    assert free == 0


def test_a_run_that_is_stopped_is_complete_and_vented(schedule, tmp_path):
    rig, count = Kept(0), iter(range(10**6))
    output = tmp_path / "stopped.parquet"
    found = run(schedule, rig, output=output, stopped=lambda: next(count) > 100, **SIMULATED)
    assert found.interrupted
    assert 90 < load_recording(output).samples <= 102
    np.testing.assert_array_equal(rig.last, 0.0)


@pytest.mark.parametrize(
    ("error", "ended"), [(KeyboardInterrupt(), True), (InputError("the cable is cut"), False)]
)
def test_a_real_rig_is_vented_and_its_samples_are_kept(schedule, tmp_path, error, ended):
    rig, output = Real(0, 200, error), tmp_path / "real.parquet"
    warnings = []
    if ended:
        found = run(schedule, rig, output=output, on_warning=warnings.append)
        assert found.ended_by is error
        assert found.timing.pace == "rig"
    else:
        with pytest.raises(InputError, match="the cable is cut"):
            run(schedule, rig, output=output, on_warning=warnings.append)
        assert "199 samples" in warnings[0]
    assert load_recording(output).samples in (198, 199)
    np.testing.assert_array_equal(rig.last, 0.0)
    assert rig.closed


class Silent(Real):
    """A real rig whose second pressure sensor is silent in some reads, counted from 1."""

    def __init__(self, first, last=10**9):
        super().__init__()
        self.silent = range(first, last + 1)

    def read(self):
        found = super().read()
        if self.reads in self.silent:
            found = replace(found, measured=np.where(np.arange(3) == 1, np.nan, found.measured))
        return found


def test_a_silent_sensor_ends_the_run_as_other_stops_do(schedule, tmp_path):
    """At 20 Hz silence from the 201st read on is longer than two seconds at the 241st."""
    output, warnings = tmp_path / "silent.parquet", []
    stopped = r"^the pressure sensor of chamber 2 was silent for 2\.\d s; the rig is vented$"
    with pytest.raises(RigStopped, match=stopped):
        run(schedule, Silent(201), output=output, on_warning=warnings.append)
    assert load_recording(output).samples == 200
    assert "40 samples left out: without a pressure" in warnings[0]
    assert warnings[1] == f"the 200 samples until then were written: {output}"
    assert not (tmp_path / "silent.log.jsonl").exists()


@pytest.fixture(scope="module")
def undisturbed(schedule):
    """A run on a real rig whose sensors and clock are right."""
    return run(schedule, Real(), minutes=0.6, reference_s=32.0, on_warning=lambda text: None)


def test_a_sensor_that_is_silent_for_a_moment_costs_its_samples(schedule, undisturbed):
    """The model goes on from the last pressure, so that its error is as before."""
    warnings = []
    found = run(schedule, Silent(201, 204), minutes=0.5, on_warning=warnings.append)
    assert warnings == ["4 samples left out: without a pressure, or with a time that is not later "
                        "than the one before"]  # fmt: skip
    end_s = found.recording.t_s[-1] + 1e-6
    rows = (undisturbed.recording.t_s <= end_s).sum()
    assert found.recording.samples == len(found.predicted_mm) == rows - 4
    expected = undisturbed.rms_mm(begin_s=12.0, end_s=end_s)
    assert found.rms_mm(begin_s=12.0) == pytest.approx(expected, rel=0.02)


class Repeating(Real):
    """A real rig whose clock stands still in reads 200 to 219."""

    def read(self):
        found = super().read()
        if 200 <= self.reads < 220:
            return replace(found, t_s=self.last_s)
        self.last_s = found.t_s
        return found


def test_a_clock_that_repeats_a_time_costs_the_samples_and_their_predictions(schedule, undisturbed):
    """Predictions and alarm levels stay beside their rows, and the model's error is as before.

    The first alarm level is that of the end of the reference.
    """
    warnings, whole = [], undisturbed
    given = {"minutes": 0.6, "reference_s": 32.0, "on_warning": warnings.append}
    found = run(schedule, Repeating(), **given)
    assert [line for line in warnings if "left out" in line] == [
        "20 samples left out: without a pressure, or with a time that is not later than the one "
        "before"
    ]
    recording = found.recording
    assert recording.samples == whole.recording.samples - 20
    assert len(found.predicted_mm) == len(found.statistic) == recording.samples
    rows = np.isin(whole.recording.t_s.round(6), recording.t_s.round(6))
    assert rows.sum() == recording.samples
    np.testing.assert_array_equal(np.isfinite(found.statistic), recording.t_s >= 32.0)
    apart = np.linalg.norm(found.predicted_mm - whole.predicted_mm[rows], axis=-1)
    assert apart.max() < 0.05
    assert found.rms_mm(begin_s=12.0) == pytest.approx(whole.rms_mm(begin_s=12.0), rel=0.02)


def test_a_policy_goes_on_where_a_sensor_is_silent_for_a_moment():
    config = TrackConfig(follow=FollowConfig(loop_s=4.0))
    warnings = []
    found = run(
        "scripted", Silent(60, 63), task="track_circle", config=config, minutes=0.15,
        on_warning=warnings.append,
    )  # fmt: skip
    assert len(warnings) == 1
    assert np.isfinite(found.recording.commanded).all()
    assert np.isfinite(found.predicted_mm).all()


def test_the_log_of_a_run_that_never_ends_is_a_recording(schedule, tmp_path):
    """What a power cut leaves: the growing file."""
    output, seen = tmp_path / "cut.parquet", []

    def cut():
        file = tmp_path / "cut.log.jsonl"
        if file.exists() and not seen and file.stat().st_size > 40_000:
            seen.append(load_recording(file, on_warning=pytest.fail))
        return bool(seen)

    found = run(schedule, output=output, stopped=cut, **SIMULATED)
    rows = seen[0].samples
    assert rows > 50
    np.testing.assert_array_equal(seen[0].key_points_mm, found.recording.key_points_mm[:rows])


def test_the_log_of_an_interrupted_run_is_not_overwritten(schedule, tmp_path):
    left = tmp_path / "run.log.jsonl"
    left.write_text("what is left of an earlier run")
    with pytest.raises(InputError, match="the log of an interrupted recording is there"):
        run(schedule, output=tmp_path / "run.parquet", **SIMULATED)
    assert left.read_text() == "what is left of an earlier run"


def test_what_came_after_an_earlier_alarm_is_not_in_the_way_at_the_end(schedule, tmp_path):
    """Refused before the rig moves; with `force` it goes with the run that it belonged to."""
    output, after = tmp_path / "run.parquet", tmp_path / "run-after.parquet"
    for place in (after, after.with_suffix(".toml")):
        place.write_text("of an earlier run")
    rig = Real()
    with pytest.raises(InputError, match=r"run-after\.parquet: exists already"):
        run(schedule, rig, output=output, on_warning=pytest.fail)
    assert (rig.reads, sorted(tmp_path.iterdir())) == (0, [after, after.with_suffix(".toml")])
    run(schedule, output=output, minutes=0.05, force=True, **SIMULATED)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["run.parquet", "run.toml"]


def test_samples_are_kept_where_the_last_one_ends_the_run(schedule, tmp_path, monkeypatch):
    """What is judged after the loop may refuse as well as what is judged in it."""
    asked, flush = [], session.WatchedSimulation.flush

    def stopped():
        asked.append(0)
        return len(asked) > 100

    def refuse(watched):
        flush(watched)
        if len(asked) > 100:
            raise InputError("it is the model of another arm")

    monkeypatch.setattr(session.WatchedSimulation, "flush", refuse)
    output, warnings = tmp_path / "run.parquet", []
    given = {"output": output, "clock": "simulated", "on_warning": warnings.append}
    with pytest.raises(InputError, match="the model of another arm"):
        run(schedule, stopped=stopped, **given)
    assert load_recording(output).samples > 50
    assert str(output) in warnings[-1]
    assert not output.with_name("run.log.jsonl").exists()


def test_the_model_of_another_arm_is_refused(schedule, tmp_path):
    with pytest.raises(InputError, match="it is the model of another arm"):
        run(schedule, "virtual:seed=2", clock="simulated", on_warning=lambda text: None)
    found = run(schedule, "virtual:seed=2", any_model=True, minutes=0.25, **SIMULATED)
    assert found.rms_mm() > 1.0


BAD = {
    "rate": (["scripted", "--task", "track_circle", "--rate", "5"], "expected 10 to 50 Hz"),
    "samples": (["mixed", "--rate", "15"], "expected a whole number of samples"),
    "policy": (["nobody"], "unknown policy 'nobody'"),
    "folder": (["runs/absent"], "runs/absent: no such"),
    "task": (["scripted"], "--task is missing"),
    "arms": (["scripted", "--task", "circle_ablation"], "expected a task of one arm"),
    "kind": (["grid"], "expected a continuous one"),
    "model": (["mixed", "--model", "absent"], "no arm model there"),
    "minutes": (["mixed", "--minutes", "0"], "minutes is 0"),
    "clean": (["mixed", "--clean", "3"], "expected at least 32 s"),
    "rig": (["mixed", "--rig", "nowhere"], "unknown rig 'nowhere'"),
    "before": (["mixed", "--before", "absent.parquet"], "no such file"),
    "window": (["mixed", "--show", "--web"], "at most one"),
    "schedule": (["mixed", "--task", "track_circle"], "a schedule has no task"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_nothing_is_written(
    arguments, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert command(["run", *arguments, "-o", "run.parquet"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"clock": "fast"}, "unknown clock 'fast'"),
        ({"rig": Real, "clock": "simulated"}, "is not a simulated rig, which has the method"),
        (
            {"policy": "scripted", "task": "track_circle", "model": default_arm()},
            "a policy takes its arm model from a folder; save the model",
        ),
        ({"stopped": lambda: True}, "ended before its first sample; nothing was recorded"),
    ],
)
def test_calls_that_make_no_run_write_nothing(schedule, tmp_path, given, message):
    request = {"policy": schedule, "clock": "simulated", "output": tmp_path / "run.csv"} | given
    if "rig" in request:
        request["rig"] = request["rig"]()  # made here, so that collecting the tests makes no robot
    with pytest.raises(InputError, match=message):
        run(**request)
    assert not list(tmp_path.iterdir())


def test_a_trained_policy_brings_its_task_and_rate(tmp_path):
    """A training of one turn: its task and configuration need no naming, another rate is none."""
    trained = tmp_path / "trained"
    surgisoft.train("track_circle", trained, envs=8, steps=64)
    with pytest.raises(InputError, match="the policy was trained for 10 Hz; leave --rate out"):
        run(trained, clock="simulated", rate_hz=11.0)
    with pytest.raises(InputError, match="a task of one arm"):
        run(trained, task="circle_ablation", clock="simulated")
    found = run(trained, clock="simulated", minutes=0.2, rate_hz=10.0, observer_gain=0.4)
    t_s, error = found.tracking.T
    assert t_s[0] == pytest.approx(4.0, abs=0.11), "the arm rests before the first step"
    np.testing.assert_allclose(np.diff(t_s), 0.1, atol=1e-9)
    assert t_s[-1] == pytest.approx(12.0, abs=0.11)
    assert error[-1] > 1.0, "one turn of training teaches nothing"


def test_a_run_in_a_thread_sets_no_handlers(schedule):
    before, found = signal.getsignal(signal.SIGINT), []
    run_it = threading.Thread(target=lambda: found.append(run(schedule, minutes=0.05, **SIMULATED)))
    run_it.start()
    run_it.join()
    assert found[0].recording.samples == 60
    assert signal.getsignal(signal.SIGINT) is before


def test_the_known_error_of_a_model_is_its_covariance():
    """Against the sum of squares by hand; rows with a missing key point count in none."""
    model = default_arm()
    known = model.training_residuals
    rows = [row for row in known.residual_mm.double().numpy().reshape(-1, 15) if (row == row).all()]
    by_hand = sum(np.outer(row, row) for row in rows) / len(rows)
    np.testing.assert_allclose(elsewhere(model), by_hand, rtol=1e-9, atol=1e-12)
    model.training_residuals = None
    assert elsewhere(model) is None


def test_a_rig_with_other_chambers_is_refused(schedule, tmp_path):
    class Two(VirtualRig):
        def __init__(self):
            super().__init__(0)
            self.chambers = 2

    with pytest.raises(InputError, match="chambers: 2, but the model has 3"):
        run(schedule, Two(), output=tmp_path / "two.parquet", **SIMULATED)
    assert not list(tmp_path.iterdir())


def test_command_and_function_give_the_same(schedule, changed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = ["--rig", "virtual:hidden=payload@50", "--clock", "simulated", "--clean", "35"]
    assert command(["run", schedule, *given, "-o", "run.parquet", "--json", "run.json"]) == 0
    found, lines = changed
    printed = capsys.readouterr().out
    assert all(line in printed for line in lines)
    assert "next: surgisoft diagnose default run-after.parquet" in printed
    numbers, expected = json.loads((tmp_path / "run.json").read_text()), found.to_json()
    for name in ("alarms", "error_mm", "reference_mm", "threshold", "seconds"):
        assert numbers[name] == json.loads(json.dumps(expected[name])), name


def test_ctrl_c_leaves_a_complete_recording(schedule, tmp_path, capsys):
    output, log = tmp_path / "run.parquet", tmp_path / "run.log.jsonl"

    def end():
        """Ctrl-C once the log on the disk has some samples, however busy the computer is."""
        while not (log.exists() and log.read_text().count("\n") > 12):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    ends = threading.Thread(target=end, daemon=True)
    ends.start()
    assert command(["run", schedule, "-o", str(output)]) == 130
    ends.join()
    assert load_recording(output).samples > 5
    shown = capsys.readouterr()
    assert f"wrote {output}" in shown.out
    assert "interrupted" in shown.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.parquet", "run.toml"]


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no real-time priorities here")
@pytest.mark.parametrize("clock", ["real", "simulated"])
def test_only_a_loop_in_real_time_has_real_time_priority(schedule, clock):
    kept = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        os.sched_setscheduler(0, kept, os.sched_param(0))
    except OSError:
        pytest.skip("this user may not set real-time priorities")
    during = set()

    class Looks(VirtualRig):
        def read_beside_truth(self):
            during.add(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
            return super().read_beside_truth()

        def read(self):
            during.add(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
            return super().read()

    run(schedule, Looks(0), minutes=0.5 / 60, clock=clock)
    assert during == {os.SCHED_RR if clock == "real" else kept}
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == kept
