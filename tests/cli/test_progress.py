"""Rate, rest and end of work: against clocks and rates given by hand."""

import io
import re
import sys
import time
from datetime import datetime

import surgisoft.cli.progress as under_test
from surgisoft.cli.progress import Pace, progress


class Clock:
    """A clock that is set by hand, s."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def noon():
    return datetime(2026, 11, 22, 12, 0, 0)


def test_rate_rest_and_end_follow_the_mean_rate():
    clock = Clock()
    pace = Pace(clock, noon)
    assert pace(0, 10) == ""
    clock.now = 6.0
    assert pace(2, 10) == "3.3 %/s, 24 s left, ends 12:00"
    clock.now = 40.0
    assert pace(4, 30) == "20 %/min, 4 min left, ends 12:04"
    assert pace(30, 30) == ""


def test_an_end_on_another_day_has_its_date():
    clock = Clock()
    pace = Pace(clock, noon)
    pace(0, 24)
    clock.now = 3600.0
    assert pace(1, 24) == "0.069 %/min, 23 h left, ends 2026-11-23 11:00"


def test_no_end_is_extrapolated_from_less_than_a_hundredth():
    clock = Clock()
    pace = Pace(clock, noon)
    pace(50, 1000)
    clock.now = 100.0
    assert pace(59.9, 1000) == ""
    assert pace(60, 1000) == "0.6 %/min, 3 h left, ends 14:36"


def test_work_that_goes_on_is_not_counted_as_done_in_no_time():
    clock = Clock()
    pace = Pace(clock, noon)
    assert pace(50, 100) == ""
    clock.now = 10.0
    assert pace(60, 100) == "1 %/s, 40 s left, ends 12:00"


def test_the_next_part_of_the_work_has_its_own_rate():
    clock = Clock()
    pace = Pace(clock, noon)
    pace(0, 10)
    clock.now = 100.0
    pace(10, 10)
    assert pace(1, 10) == ""
    clock.now = 102.0
    assert pace(2, 10) == "5 %/s, 16 s left, ends 12:00"


def test_without_a_terminal_occasional_lines_state_the_time_left(capsys, monkeypatch):
    monkeypatch.setattr(under_test, "LINE_EVERY_S", 0.0)
    with progress("evaluate scripted") as report:
        for done in range(4):
            report(done, 3, "playing")
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "surgisoft: evaluate scripted: 0%, playing"
    assert re.fullmatch(
        r"surgisoft: evaluate scripted: 67%, playing, \S+ %/s, \d+ s left, ends \d\d:\d\d", lines[2]
    )
    assert lines[3] == "surgisoft: evaluate scripted: 100%, playing"


def test_work_that_reports_nothing_is_told_again(capsys, monkeypatch):
    monkeypatch.setattr(under_test, "LINE_EVERY_S", 0.05)
    monkeypatch.setattr(under_test, "SHORTEST_WAIT_S", 0.05)
    with progress("diagnose") as report:
        report.step(4, 6, "held-out errors")
        time.sleep(0.4)
    time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert 2 <= len(lines) <= 8
    assert {line.rsplit(",", 1)[0] for line in lines} == {"surgisoft: diagnose: held-out errors"}


def test_steps_of_unlike_times_tell_no_end(capsys, monkeypatch):
    monkeypatch.setattr(under_test, "LINE_EVERY_S", 0.0)
    with progress("improve") as report:
        report.step(1, 4, "creep")
        time.sleep(0.01)
        report.step(3, 4, "payload")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"surgisoft: improve: {name}, 0 s so far" for name in ("creep", "payload")]


class Terminal(io.StringIO):
    """Keeps what is written to a terminal."""

    def isatty(self):
        return True


def test_nothing_is_drawn_without_a_terminal(capsys, monkeypatch):
    """The disabled bar of rich 13 ended with an empty line, as one that is stopped here does."""
    monkeypatch.setattr("rich.progress.Progress.stop", lambda bar: sys.stderr.write("\n"))
    with progress("fit") as report:
        report(1.0, 2.0)
    assert capsys.readouterr().err == ""


def test_a_cell_of_a_notebook_gets_no_bar(monkeypatch):
    """IPython runs `!command` in a pseudo-terminal, whose every redrawn bar stays in the output."""
    shown = {}
    for started_by in ("shell", "notebook"):
        monkeypatch.delenv("JPY_PARENT_PID", raising=False)
        if started_by == "notebook":
            monkeypatch.setenv("JPY_PARENT_PID", "1234")
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setattr(sys, "stderr", Terminal())
        with progress("fit") as report:
            report(1, 2, "half of it")
        shown[started_by] = sys.stderr.getvalue()
    assert "half of it" in shown["shell"]
    assert shown["notebook"] == ""
