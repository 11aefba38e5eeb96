"""Commands in messages, read by a shell."""

import subprocess

import pytest

from surgisoft.command_line import typed

PARTS = ["my model", "it's.csv", "a$HOME.csv", 'say "x".csv', "b;c", "", "*", "~/x", "two  spaces"]


def test_a_shell_reads_the_parts_that_were_given():
    read = subprocess.run(
        ["sh", "-c", f"printf '%s\\n' {typed(*PARTS)}"], capture_output=True, text=True, check=True
    )
    assert read.stdout.split("\n")[:-1] == PARTS


@pytest.mark.parametrize(
    "part", ["runs/x", "/a/b-c_d.parquet", "FILE.py:arm", "serial:port=/dev/ttyS0,a=1", "creep:2@5"]
)
def test_what_needs_no_quotes_has_none(part):
    assert typed(part, part) == f"{part} {part}"
