"""How long work still takes: against clocks and paces given by hand."""

import re

import surgisoft.cli.progress as under_test
from surgisoft.cli.progress import TimeLeft, progress


class Clock:
    """A clock that is set by hand, s."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_time_left_is_the_rest_at_the_mean_pace():
    clock = Clock()
    left = TimeLeft(clock)
    assert left(0, 10) == ""
    clock.now = 6.0
    assert left(2, 10) == "24 s left"
    clock.now = 40.0
    assert left(4, 30) == "4 min left"
    assert left(30, 30) == ""


def test_work_that_goes_on_is_not_counted_as_done_in_no_time():
    clock = Clock()
    left = TimeLeft(clock)
    assert left(50, 100) == ""
    clock.now = 10.0
    assert left(60, 100) == "40 s left"


def test_the_next_part_of_the_work_has_its_own_pace():
    clock = Clock()
    left = TimeLeft(clock)
    left(0, 10)
    clock.now = 100.0
    left(10, 10)
    assert left(1, 10) == ""
    clock.now = 102.0
    assert left(2, 10) == "16 s left"


def test_without_a_terminal_occasional_lines_state_the_time_left(capsys, monkeypatch):
    monkeypatch.setattr(under_test, "LINE_EVERY_S", 0.0)
    with progress("evaluate scripted") as report:
        for done in range(4):
            report(done, 3, "playing")
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "surgisoft: evaluate scripted: 0%, playing"
    assert re.fullmatch(r"surgisoft: evaluate scripted: 67%, playing, \d+ s left", lines[2])
    assert lines[3] == "surgisoft: evaluate scripted: 100%, playing"
