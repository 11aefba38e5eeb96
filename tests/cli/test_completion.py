"""Shell completion: what the shell asks the installed command for."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("surgisoft scene n", ["new"]),
        ("surgisoft diagnose --bef", ["--before"]),
        ("surgisoft amend default --effect cr", ["creep"]),
        ("surgisoft diagnose default rec.csv --without pay", ["payload"]),
        ("surgisoft next-experiment default --between creep,line_l", ["creep,line_lag"]),
        ("surgisoft fit rec.csv --effects a", ["auto"]),
        ("surgisoft fit rec.csv --effects pay", []),  # a payload is no effect of a fit
        ("surgisoft collect walk --hidden kn", ["knock"]),
    ],
)
def test_the_shell_completes_commands_options_and_effects(words, expected):
    asked = {
        "_SURGISOFT_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-m", "surgisoft"],
        env=os.environ | asked,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == expected
