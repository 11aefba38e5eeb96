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
