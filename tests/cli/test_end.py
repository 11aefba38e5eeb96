"""The end of the program: the process ends at once, and loses nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from surgisoft.cli import NEW_OBJECTS

BEGIN = """
import atexit, sys, threading, time
from surgisoft.cli import end_process

class Kept:
    def __del__(self):
        print("freed")

kept = Kept()
"""


def ended(code, begin=BEGIN, **options):
    program = [sys.executable, "-c", begin + code]
    return subprocess.run(program, capture_output=True, text=True, check=False, **options)


def test_output_is_complete_and_what_was_registered_runs():
    done = ended(
        """
atexit.register(print, "registered before")
print("x" * 200_000)
print("told", file=sys.stderr, end="")
atexit.register(print, "registered later")
end_process(3)
"""
    )
    lines = done.stdout.splitlines()
    assert done.returncode == 3
    assert lines == ["x" * 200_000, "registered later", "registered before"], "nothing is freed"
    assert done.stderr == "told"


def test_what_is_registered_before_the_import_runs_too():
    """As coverage does it, which writes what it has measured."""
    early = "import atexit; atexit.register(print, 'measured')\n"
    assert ended("end_process(0)", early + BEGIN).stdout == "measured\n"


def test_a_thread_that_works_is_waited_for():
    done = ended(
        """
def work():
    time.sleep(0.5)
    print("done")

threading.Thread(target=work).start()
end_process(4)
"""
    )
    assert done.returncode == 4
    assert done.stdout.splitlines() == ["done", "freed"]


def test_a_daemon_does_not_hold_the_end_up():
    done = ended(
        "threading.Thread(target=time.sleep, args=(60.0,), daemon=True).start(); end_process(5)",
        timeout=20,
    )
    assert (done.returncode, done.stdout) == (5, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_output_that_cannot_be_written_is_reported_as_python_does():
    code = "from surgisoft.cli import end_process; print('lost'); end_process(0)"
    settings = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env=settings,
        )
    assert done.returncode == 120
    assert "No space left on device" in done.stderr


LOOKS = """
import gc, sys
from surgisoft import cli

def run():
    made = [[] for _ in range(100_000)]
    given, kept = gc.get_threshold()[0], gc.get_freeze_count()
    if sys.argv[1] == "work":
        from surgisoft.cli.progress import progress
        with progress("test"):
            pass
    else:
        made += [[] for _ in range(800_000)]
    now = gc.get_threshold()[0]
    print(given > 2 * now, now, kept, gc.get_freeze_count() > 1000)
    return 0

cli.run = run
cli.main()
"""


@pytest.mark.parametrize("begun", ["work", "many objects"])
def test_cycles_of_objects_are_looked_for_once_work_begins(begun):
    """Not while commands import; from the first progress on, or where many objects were made."""
    done = subprocess.run([sys.executable, "-c", LOOKS, begun], capture_output=True, text=True)
    assert done.stdout == f"True {NEW_OBJECTS} 0 True\n", done.stderr
