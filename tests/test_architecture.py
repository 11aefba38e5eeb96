"""Imports run one way, and each outside library is spoken to in one place."""

import ast
import re
from collections.abc import Collection
from functools import cache
from pathlib import Path

import pytest

from benchmarks.structure import circles, importers, imports, modules
from surgisoft.surrogate.effects import EFFECTS
from surgisoft.tasks.world.random_effects import KINDS as RANDOM_EFFECTS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "surgisoft"

MAY_IMPORT = {
    "scene": set(),
    "surrogate": set(),
    "measurement": {"surrogate"},
    "rig": {"measurement"},
    "diagnosis": {"surrogate", "measurement", "report"},
    "tasks": set(),
    "tasks/world": {"scene", "surrogate"},
    "agents": {"scene", "surrogate", "measurement", "rig", "tasks", "report"},
    "experiments": {
        "agents",
        "scene",
        "surrogate",
        "measurement",
        "rig",
        "tasks",
        "replay",
        "report",
    },
    "live": {"agents", "surrogate", "measurement", "rig", "tasks", "replay", "diagnosis"},
    "replay": {"scene", "tasks", "diagnosis"},
    "report": set(),
    "credibility": {
        "diagnosis",
        "experiments",
        "measurement",
        "report",
        "scene",
        "surrogate",
        "tasks",
    },
    "demonstration": {"agents", "diagnosis", "measurement", "replay", "report", "rig", "surrogate"},
    "cli": {
        "agents",
        "credibility",
        "demonstration",
        "experiments",
        "live",
        "tasks",
        "scene",
        "surrogate",
        "measurement",
        "diagnosis",
        "rig",
        "replay",
        "report",
    },
}
"""What each part may import beside itself and the ground; the nearest folder's row counts."""

GROUND = {"__version__"} | {path.stem for path in PACKAGE.glob("*.py")}
"""Modules that every part may use; they import no part."""

FLOORS = {
    "diagnosis": (
        ("body_frame", "change_points", "criteria", "history_features", "statistics", "weight"),
        ("residuals",),
        ("other_models",),
        (
            "abrupt",
            "amended_error",
            "discrepancy",
            "data_quality",
            "error_axes",
            "inputs",
            "known_error",
        ),
        ("pairs",),
        ("cross_validation",),
        ("black_box", "beyond_history", "candidates", "setup"),
        ("testability", "estimation"),
        ("selection", "refit"),
        ("evidence",),
        ("decision",),
        ("design",),
        ("diagnose",),
        ("compare", "amend"),
        ("improve",),
        ("pages",),
    ),
    "credibility": (
        ("context", "metrics", "software"),
        ("uncertainty", "retest", "domain"),
        ("scenario",),
        ("assessment",),
        ("factors",),
        ("of_experiment", "page"),
    ),
    "scene": (
        ("frames",),
        ("mesh", "capsules", "crossings", "moving"),
        ("meshio", "bvh", "plate"),
        ("warp_kernels",),
        ("rays",),
        ("field", "inside", "segmentation", "sight"),
        ("distance", "torch_queries", "warp_queries", "camera"),
        ("batched", "collision", "render"),
        ("reach", "spec", "images"),
        ("lesion", "repair"),
        ("contours",),
        ("dose_patch",),
        ("warp_dose",),
        ("folder", "mounted_arm", "ablation"),
        ("mounts", "check"),
        ("author",),
    ),
    "replay": (
        ("colours", "contents", "shapes", "surfaces"),
        ("plots", "legends"),
        ("recording",),
        ("arms", "endoscope"),
        ("episode_view", "scene_view", "reach_map"),
        ("comparison", "viewer"),
        ("live_view", "model_error"),
        ("show",),
    ),
    "report": (("parts", "style"), ("charts", "page")),
}
"""Floors of a part, from the ground up: its modules and folders import from floors below only."""

ROOMS = {
    "diagnosis/design": ("schedules", "isolability", "next_experiment"),
    "diagnosis/setup": (
        "alignment",
        "channels",
        "sample",
        "arrangements",
        "search",
        "words",
        "mixed_units",
        "blind",
        "correction",
        "result",
    ),
}
"""Modules of a folder in order: each imports from those before it only."""

ONLY_IN = {
    "rerun": "replay",
    "pettingzoo": "tasks/parallel",
    "gymnasium": "tasks/",
    "rsl_rl": "agents",
    "fcl": "scene/collision",
    "elastica": "rig/elastica",
    "serial": "rig/drivers/serial_controller",
    "ezc3d": "measurement/importing/readers/c3d",
    "h5py": "measurement/importing/readers/arrays",
    "mcap": "measurement/importing/readers/mcap",
    "mcap_ros2": "measurement/importing/readers/mcap",
    "distributed": "workers",
}


@cache
def _imports(path: Path) -> set[str]:
    names = set()
    for node in imports(path):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        else:
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _part(relative: str) -> str:
    known = [part for part in MAY_IMPORT if relative.removesuffix(".py").startswith(part)]
    return max(known, key=len) if known else ""


FILES = sorted(path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_one_way(path):
    relative = str(path.relative_to(PACKAGE))
    part = _part(relative)
    assert part, f"{relative} belongs to no known part"
    top = part.split("/")[0]
    for name in _imports(path):
        if name.startswith("surgisoft."):
            other = name.split(".")[1]
            if other == top or other in GROUND:
                continue
            assert other in MAY_IMPORT[part], f"{relative} imports {name}"
        library = name.split(".")[0]
        if library in ONLY_IN:
            assert relative.startswith(ONLY_IN[library]), f"{relative} imports {library}"


def _floor_breaks(folder: Path, floors: tuple[tuple[str, ...], ...]) -> list[str]:
    """Imports that do not run down the floors of a folder, and modules that stand on none."""
    prefix = "surgisoft." + ".".join(folder.relative_to(PACKAGE).parts)
    level = {name: number for number, floor in enumerate(floors) for name in floor}
    broken = []
    for path in sorted(folder.rglob("*.py")):
        own = path.relative_to(folder).parts[0].removesuffix(".py")
        if own == "__init__":
            continue
        if own not in level:
            broken.append(f"{path.relative_to(PACKAGE)} stands on no floor")
            continue
        for name in sorted(_imports(path)):
            other = name.removeprefix(f"{prefix}.").split(".")[0]
            inside = name.startswith(f"{prefix}.") and other in level and other != own
            if inside and level[other] >= level[own]:
                broken.append(f"{path.relative_to(PACKAGE)} imports {name}")
    return broken


@pytest.mark.parametrize("part", FLOORS)
def test_imports_inside_a_part_run_down(part):
    assert _floor_breaks(PACKAGE / part, FLOORS[part]) == []


@pytest.mark.parametrize("folder", ROOMS)
def test_imports_inside_a_folder_run_down(folder):
    floors = tuple((name,) for name in ROOMS[folder])
    assert _floor_breaks(PACKAGE / folder, floors) == []


def test_an_import_that_runs_up_is_found(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "PACKAGE", tmp_path)
    (tmp_path / "part").mkdir()
    (tmp_path / "part/low.py").write_text("from surgisoft.part.high import x\n")
    (tmp_path / "part/high.py").write_text("from surgisoft.part import beside\n")
    (tmp_path / "part/beside.py").write_text("import numpy\n")
    broken = _floor_breaks(tmp_path / "part", (("low",), ("high", "beside")))
    assert broken == [
        "part/high.py imports surgisoft.part.beside",
        "part/low.py imports surgisoft.part.high",
        "part/low.py imports surgisoft.part.high.x",
    ]


def test_no_modules_import_each_other():
    """Circles by imports in functions, or for types only, count as well."""
    assert circles(importers(modules(ROOT))) == []


def test_a_circle_for_types_is_found(tmp_path):
    folder = tmp_path / "surgisoft"
    folder.mkdir()
    (folder / "a.py").write_text("def f():\n    from surgisoft.b import g\n")
    late = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from surgisoft.a import f\n"
    (folder / "b.py").write_text(late)
    (folder / "c.py").write_text("import surgisoft.a\n")
    found = circles(importers(modules(tmp_path)))
    assert found == [["surgisoft.a", "surgisoft.b"]]


@pytest.mark.parametrize("path", sorted(PACKAGE.glob("*.py")), ids=lambda path: path.name)
def test_the_base_modules_import_no_part(path):
    if path.name not in ("__init__.py", "__main__.py"):
        parts = {name.split(".")[1] for name in _imports(path) if name.startswith("surgisoft.")}
        assert parts <= GROUND


def test_rig_shares_nothing_with_the_models():
    """The virtual rig is the independent truth: no model code, not even torch, reaches it."""
    for path in (PACKAGE / "rig").glob("*.py"):
        for name in _imports(path):
            assert not name.startswith(("surgisoft.surrogate", "surgisoft.diagnosis", "torch"))
            assert name != "surgisoft.measurement.histories"


UNIX_ONLY = {"fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "termios", "tty"}
"""Modules of Python's library that Windows lacks."""
UNIX_NAMES = {
    "SIGHUP",
    "SIGKILL",
    "SIGALRM",
    "SIGUSR1",
    "pthread_kill",
    "fork",
    "killpg",
    "geteuid",
    "getpgrp",
    "pthread_sigmask",
    "sched_setscheduler",
    "tcgetpgrp",
    "MAP_SHARED",
    "PROT_READ",
}
"""Names of `mmap`, `os` and `signal` that Windows lacks."""


def words_of(source: str, words: Collection[str]) -> bool:
    """Whether a source has one of these words at all: most have none, and need no parsing."""
    return re.search(rf"\b(?:{'|'.join(words)})\b", source) is not None


def on_import(node: ast.AST):
    """Nodes of a module that run when it is imported: all but the bodies of its functions."""
    for child in ast.iter_child_nodes(node):
        parts = [child]
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            parts = [child.args, *getattr(child, "decorator_list", ())]
        for part in parts:
            yield part
            yield from on_import(part)


def unix_only(source: str) -> list[str]:
    """What a module needs on its import that Windows lacks."""
    if not words_of(source, UNIX_ONLY | UNIX_NAMES):
        return []
    found = []
    for node in on_import(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += UNIX_ONLY & {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            found += UNIX_ONLY & {node.module}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            found += {node.attr} & UNIX_NAMES if node.value.id in ("os", "signal") else ()
    return found


GUARDS = ("sys.platform", "os.name", "hasattr(", "ImportError", "AttributeError")
"""How a module asks whether the system has a name."""


def unguarded(source: str) -> list[str]:
    """Names that Windows lacks, anywhere in a module that does not ask for the system."""
    if any(guard in source for guard in GUARDS) or not words_of(source, UNIX_NAMES):
        return []
    return [
        f"{node.value.id}.{node.attr}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in ("mmap", "os", "signal")
        and node.attr in UNIX_NAMES
    ]


def test_windows_can_import_every_module_and_collect_the_tests():
    assert unix_only("import pty\nS = (signal.SIGHUP,)\ndef f():\n    import tty") == [
        "pty",
        "SIGHUP",
    ]
    assert unix_only("@mark(signal.SIGHUP)\ndef f(number):\n    os.fork()") == ["SIGHUP"]
    paths = [*PACKAGE.rglob("*.py"), *Path(__file__).parent.rglob("*.py")]
    needs = {str(path): unix_only(path.read_text()) for path in paths}
    assert {path: found for path, found in needs.items() if found} == {}


def test_what_windows_lacks_is_asked_for():
    assert unguarded("def f():\n    return mmap.PROT_READ") == ["mmap.PROT_READ"]
    assert unguarded("def f():\n    if sys.platform == 'linux':\n        os.fork()") == []
    needs = {str(path): unguarded(path.read_text()) for path in PACKAGE.rglob("*.py")}
    assert {path: found for path, found in needs.items() if found} == {}


BY_NAME = ("setattr", "delattr", "getattr", "hasattr")
"""Functions that take the name of an attribute as text, also those of pytest's `monkeypatch`."""
OF_LIBRARIES = ("_replace", "_repr_html_", "_exit", "_protected_args")
"""Names with an underscore that are not the project's: named tuples, IPython, `os`, Click."""


def private_names(source: str) -> list[str]:
    """Names that begin with an underscore, are of something imported, and occur in a test."""
    if not re.search(r"\b_[^\W_]", source):
        return []
    found = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Attribute(value=ast.Name(id="self" | "cls")):
                continue  # of a class that the test itself makes
            case ast.Attribute(attr=name):
                found.append(name)
            case ast.ImportFrom(names=names):
                found += [each.name for each in names]
            case ast.Call(func=of) if ast.unparse(of).rpartition(".")[2] in BY_NAME:
                texts = [each.value for each in node.args if isinstance(each, ast.Constant)]
                found += [str(text).rpartition(".")[2] for text in texts]
    own = [name for name in found if name.isidentifier() and name not in OF_LIBRARIES]
    return [name for name in own if name.startswith("_") and not name.startswith("__")]


EFFECT_NAMES = {
    "demonstration/story.py": {"creep"},  # hidden in the recording of the demonstration
    "diagnosis/candidates.py": {"inertia"},  # its equation of motion, for every load that swings
    "diagnosis/error_axes.py": {"payload"},  # the axis of a recorded load, not the effect
    "diagnosis/setup/search.py": {"misalignment"},  # its limits: a larger turn is a wrong frame
    "surrogate/compiled_step.py": {"hysteresis"},  # its step, compiled
    "tasks/world/random_effects.py": set(RANDOM_EFFECTS),  # those that domain randomization draws
}
"""Modules that name an effect, and which; everything else asks an effect's `Hypothesis`."""
OTHER_MEANING = {"tasks": {"contact"}, "experiments": {"contact"}}
"""Part -> effect names that are words of its own there: contact of an arm with a body."""


def effects_named_in(path: Path, text: str) -> set[str]:
    """Effects whose names stand in a module as texts, or whose modules it imports."""
    if not words_of(text, EFFECTS):
        return set()
    found = set()
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Constant(value=str(word)):
                found.add(word)
            case ast.ImportFrom(module=str(module)) if ".effects." in module:
                found.add(module.rpartition(".")[2])
    part = path.relative_to(PACKAGE).parts[0]
    return (found & set(EFFECTS)) - OTHER_MEANING.get(part, set())


def test_only_stated_modules_name_effects():
    """A new effect is tried, shown and reported without a change of any other module."""
    beside = {PACKAGE / "surrogate" / "effects", PACKAGE / "rig"}
    named = {
        str(path.relative_to(PACKAGE)): effects_named_in(path, path.read_text())
        for path in FILES
        if beside.isdisjoint(path.parents)
    }
    assert {name: some for name, some in named.items() if some} == EFFECT_NAMES
    for line in ("a == 'creep'", "from surgisoft.surrogate.effects.creep import Creep"):
        assert effects_named_in(PACKAGE / "diagnosis" / "a.py", line) == {"creep"}
    assert not effects_named_in(PACKAGE / "tasks" / "a.py", "{'contact': 1}")


def test_no_test_uses_a_private_name():
    for path in sorted((ROOT / "tests").rglob("*.py")):
        assert private_names(path.read_text()) == [], path
    for line in (
        "a._b()",
        "from a import _b",
        "patch.setattr(a, '_b', 1)",
        "patch.setattr('a._b')",
    ):
        assert private_names(line) == ["_b"]
    assert private_names("self._b = __name__") == []
