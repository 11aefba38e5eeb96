"""Compiled functions on disk: an index that an older version of the code left does no harm."""

import pickle
import subprocess
import sys

import numba

CODE = """from surgisoft.compiled import compiled

@compiled
def double(x):
    return x + x

print(double(21))
"""


def run(script):
    return subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300)


def test_an_index_that_names_a_class_of_before_is_written_anew(tmp_path):
    """Its types are unpickled; one that is gone since would end in an AttributeError."""
    script = tmp_path / "kernels.py"
    script.write_text(CODE)
    assert run(script).stdout == "42\n"
    (index,) = (tmp_path / "__pycache__").glob("*.nbi")
    gone = b"csurgisoft.errors\nGoneClass\n."  # pickle of a class that does not exist
    index.write_bytes(pickle.dumps(numba.__version__) + gone)
    again = run(script)
    assert (again.stdout, again.returncode) == ("42\n", 0), again.stderr


INNER = """from surgisoft.compiled import compiled

@compiled(inner=True)
def double(x):
    return x + x

@compiled
def quadruple(x):
    return double(double(x))

print(quadruple(5), quadruple(0.5))
for given in (5, "text"):
    try:
        double(given)
    except TypeError as error:
        print(error)
"""


def test_a_function_without_an_entry_from_python_says_so(tmp_path):
    """Compiled in this run, and loaded from disk in the next; it would end the process."""
    script = tmp_path / "kernels.py"
    script.write_text(INNER)
    for _ in range(2):
        done = run(script)
        first, *errors = done.stdout.splitlines()
        assert (first, done.returncode) == ("20 2.0", 0), done.stderr
        assert errors == ["double is called by compiled functions only (inner=True)"] * 2


LEVELS = """import os
import numba
from numba.core import event
from surgisoft.compiled import compiled

class Levels(event.Listener):
    def on_start(self, happened):
        print(happened.data["dispatcher"].__name__, int(numba.config.OPT))
    def on_end(self, happened):
        pass

event.register("numba:compile", Levels())
numba.njit(lambda x: x)(1)
@compiled(inner=True)
def double(x):
    return x + x
@compiled
def quadruple(x):
    return double(double(x))
quadruple(1)
print(int(numba.config.OPT))
os.environ["NUMBA_OPT"] = "1"
numba.config.reload_config()
@compiled
def triple(x):
    return x + x + x
triple(1)
"""


def test_only_the_projects_own_functions_are_compiled_at_its_level(tmp_path, monkeypatch):
    """A level of the environment stands for all."""
    monkeypatch.delenv("NUMBA_OPT", raising=False)
    script = tmp_path / "kernels.py"
    script.write_text(LEVELS)
    told = run(script).stdout.splitlines()
    assert told == ["<lambda> 3", "quadruple 2", "double 2", "3", "triple 1"]
