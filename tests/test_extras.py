"""The core without its extras: what it can do, and what it says where an extra is missing."""

import json
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import surgisoft.extras as extras_
from surgisoft.extras import EXTRA_OF, EXTRA_OF_USE, missing_library

ROOT = Path(__file__).resolve().parents[1]
WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)
sys.meta_path.insert(0, Absent())
"""
"""A program's first lines: the libraries of the extras cannot be imported."""


def core(code, *arguments, without=EXTRA_OF, cwd=None):
    """What a program prints in an environment without the extras, or without some modules."""
    program = WITHOUT.format(names=sorted(without)) + code
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=cwd,
    )


def extras():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def plain(requirement):
    return requirement.partition(">")[0].strip().lower()


def test_every_library_of_an_extra_has_its_advice():
    """The table of modules against the package's own metadata."""
    tools = {"dev", "docs", "all"}
    listed = {
        plain(requirement): extra
        for extra, requirements in extras().items()
        if extra not in tools
        for requirement in requirements
        if not requirement.startswith("surgisoft")
    }
    distribution_of = {
        module: {name.lower().replace("_", "-") for name in names}
        for module, names in packages_distributions().items()
    }
    covered = set()
    for module, extra in EXTRA_OF.items():
        owners = distribution_of.get(module)
        if owners is None:
            continue  # an extra that is not installed here
        (owner,) = owners & set(listed)
        assert listed[owner] == extra
        covered.add(owner)
    installed = {name for names in distribution_of.values() for name in names}
    assert covered == set(listed) & installed
    assert set(EXTRA_OF_USE.values()) <= set(extras())


MISSING = {
    "train --task track_circle": "train",
    "scene check phantom_liver": "scene",
    "replay x.rrd": "replay",
    "evaluate scripted --task track_circle": "train",
    "evaluate scripted --task track_circle --replay x.rrd": "train,replay",
    "compare default x.parquet --replay x.rrd": "replay",
    "collect mixed --rig elastica -o x.parquet": "elastica",
}
"""Commands that need an extra, and which."""


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """What a part of the package, a function and these commands say, one after another.

    One program says it all. Before the commands it records, compares and diagnoses, as the lines
    of the README do.
    """
    done = core(
        """
import contextlib, io, json
from pathlib import Path
said = {}
try:
    import surgisoft.agents.policies
except ImportError as error:
    said["part"] = [1, str(error)]
from surgisoft.surrogate.effects import EFFECTS
for name in EFFECTS.keys() - {"hysteresis", "payload", "creep"}:
    del EFFECTS[name]  # a diagnosis of fewer candidates
import surgisoft
bench = Path(sys.argv.pop(1)) / "bench.parquet"
recording = surgisoft.collect("mixed", seed=0, points=300)
surgisoft.save_recording(recording, bench)
comparison, _ = surgisoft.compare("default", [bench])
print(comparison.rmse_mm > 0)
print(surgisoft.diagnose("default", [bench]).verdict.kind)
try:
    surgisoft.parallel_env
except ImportError as error:
    said["python"] = [1, str(error)]
from surgisoft.cli import run as command
for line in sys.argv[1:]:
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        code = command(line.split())
    said[line] = [code, errors.getvalue()]
print(json.dumps(said))
""",
        tmp_path_factory.mktemp("core"),
        *MISSING,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    *core_lines, last = done.stdout.splitlines()
    return json.loads(last) | {"core": core_lines}


def test_the_core_identifies_without_scenes_training_and_replays(said):
    """Record, compare and diagnose."""
    larger, kind = said["core"]
    assert larger == "True"
    assert kind


@pytest.mark.parametrize(("arguments", "extra"), MISSING.items())
def test_a_missing_library_names_its_extra(said, arguments, extra):
    code, errors = said[arguments]
    assert code == 2
    assert errors.count("\n") == 1
    assert f"pip install 'surgisoft[{extra}]'" in errors


def test_policies_are_evaluated_without_the_replay_extra(tmp_path):
    """`[train]` alone: no command that draws no replay imports Rerun."""
    (tmp_path / "short.toml").write_text("[follow]\nloop_s = 2.0\n")
    done = core(
        """
from surgisoft.cli import run
task = "--task track_circle --config short.toml"
print(run(f"evaluate random {task} --episodes 1 --json x.json".split()))
""",
        without={"rerun", "rerun_cli", "rerun_bindings"},
        cwd=tmp_path,
    )
    assert done.stdout.splitlines()[-1] == "0", done.stderr[-2000:]
    assert (tmp_path / "x.json").is_file()


def test_python_names_the_extra_too(said):
    assert "surgisoft.parallel_env: the package" in said["python"][1]
    assert "pip install 'surgisoft[train]'" in said["python"][1]


def test_a_part_of_the_package_names_its_extra_too(said):
    """Imported by itself, before the program has called any function of the package."""
    assert "the package 'embreex' is missing" in said["part"][1]
    assert "pip install 'surgisoft[scene]'" in said["part"][1]


def of_metadata(monkeypatch, package, installed, asked):
    """As if this version of a package were installed, and surgisoft asked for that one."""
    monkeypatch.setattr(extras_, "packages_distributions", lambda: {package: [package]})
    monkeypatch.setattr(extras_, "version", lambda name: {package: installed}[name])
    monkeypatch.setattr(extras_, "requires", lambda name: ["numpy>=2.0", asked])


def test_a_package_without_a_part_is_too_old_and_not_missing(monkeypatch):
    module = "onnxscript._framework_apis.torch_2_11"
    error = ModuleNotFoundError(f"No module named '{module}'", name=module)
    of_metadata(monkeypatch, "onnxscript", "0.5.4", 'onnxscript>=0.6; extra == "train"')
    assert missing_library(error, "export") == (
        "the package 'onnxscript' 0.5.4 is too old, expected 0.6 or later: it has no module "
        f"'{module}'; install it with: pip install --upgrade 'onnxscript>=0.6'"
    )
    of_metadata(monkeypatch, "onnxscript", "0.10.1", 'onnxscript>=0.6; extra == "train"')
    assert "0.10.1 is too old, or not whole: it has no" in missing_library(error)
    whole = ModuleNotFoundError("No module named 'onnxscript'", name="onnxscript")
    assert "'onnxscript' is missing" in missing_library(whole)


def test_the_export_asks_for_an_onnxscript_that_torch_takes():
    """0.5.4 has no part for torch 2.11 and later, which the first bound allowed."""
    (asked,) = [line for line in extras()["train"] if plain(line) == "onnxscript"]
    least = tuple(map(int, asked.partition(">=")[2].split(".")))
    pinned = (ROOT / "constraints.txt").read_text().partition("\nonnxscript==")[2].split()[0]
    assert (0, 6) <= least <= tuple(map(int, pinned.split(".")))
