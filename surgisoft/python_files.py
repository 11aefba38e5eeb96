"""Python files that a user names on the command line: `FILE.py:object`."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from surgisoft.files import resolved


def run_file(path: Path, content: bytes, prefix: str) -> ModuleType:
    """The module of a Python file, which runs its code.

    Files of its folder can be imported by it. content: the file's bytes; prefix: begin of the
    module's name in `sys.modules`. Raises what the code raises.
    """
    module_name = f"{prefix}_{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None:
        raise ImportError("not a Python file")
    module = importlib.util.module_from_spec(spec)
    folder = str(resolved(path).parent)
    if folder not in sys.path:
        sys.path.append(folder)
    sys.modules[module_name] = module
    try:
        exec(compile(content, str(path), "exec"), module.__dict__)
    except BaseException:
        del sys.modules[module_name]
        raise
    return module
