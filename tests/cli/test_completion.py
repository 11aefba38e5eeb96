"""Shell completion: what the shell asks the installed command for."""

import contextlib
import os
import subprocess
import sys

import pytest

from surgisoft.cli import run


def asked(words):
    """What the shell states in the environment when it asks for the last of some words."""
    return {
        "_SURGISOFT_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("surgisoft scene n", ["new"]),
        ("surgisoft diagnose --bef", ["--before"]),
        ("surgisoft diagnose default rec.csv --without pay", ["payload"]),
        ("surgisoft next-experiment default --between creep,line_l", ["creep,line_lag"]),
        ("surgisoft fit rec.csv --effects a", ["auto"]),
        ("surgisoft fit rec.csv --effects pay", []),  # a payload is no effect of a fit
        ("surgisoft collect walk --hidden kn", ["knock"]),
    ],
)
def test_the_shell_completes_commands_options_and_effects(words, expected, monkeypatch, capsys):
    for name, value in asked(words).items():
        monkeypatch.setenv(name, value)
    with contextlib.suppress(SystemExit):
        run([])
    assert capsys.readouterr().out.split() == expected


def test_the_command_answers_the_shell():
    """In a process of its own, as the shell starts it."""
    done = subprocess.run(
        [sys.executable, "-m", "surgisoft"],
        env=os.environ | asked("surgisoft amend default --effect cr"),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == ["creep"]
