"""What a plain install finds: the scene that comes with the project, whatever the directory."""

import re
import runpy
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from surgisoft.scene.spec import PHANTOM

ROOT = Path(__file__).resolve().parents[1]
SETUP = runpy.run_path(str(ROOT / "setup.py"), run_name="setup")
RELATIVE = re.compile(r"\]\((?!https?:|mailto:|#)")
"""The target of a link that leads nowhere on a package index."""
WANTED = {
    f"surgisoft/scenes/phantom_liver/{name}"
    for name in ("scene.toml", "liver.ply", "gallbladder.ply", "tray.ply", "SOURCE.md")
} | {
    "surgisoft/assets/default_arm/weights.safetensors",
    "surgisoft/assets/default_arm/config.json",
    "surgisoft/assets/default_arm/MODEL_CARD.md",
    "surgisoft/assets/policies/ring/config.json",
    "surgisoft/assets/policies/ring/checkpoints/best.pt",
    "surgisoft/assets/policies/ring/arms/laser/weights.safetensors",
    "surgisoft/assets/policies/ring/scene/scene.toml",
    "surgisoft/assets/policies/ring/scene/liver.ply",
}


def test_the_phantom_is_found():
    assert (PHANTOM / "scene.toml").is_file()


def test_links_of_the_readme_are_absolute_on_a_package_index():
    text = "![Two arms](docs/images/replay.png) [a\nb](docs/a.md#b) [own](#own) [x](https://x.org/)"
    address = "https://example.org/surgisoft"
    assert SETUP["description"](text, f"{address}/") == (
        f"![Two arms]({address}/raw/HEAD/docs/images/replay.png) "
        f"[a\nb]({address}/blob/HEAD/docs/a.md#b) [own](#own) [x](https://x.org/)"
    )
    assert SETUP["description"](text) == " a\nb [own](#own) [x](https://x.org/)"
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(RELATIVE.findall(readme)) > 20
    for whole in (SETUP["description"](readme), SETUP["description"](readme, address)):
        assert not RELATIVE.search(whole)
        assert len(whole.splitlines()) == len(readme.splitlines())


def test_a_wheel_holds_scene_arm_and_every_module(tmp_path):
    """Built as `pip install .` builds it, without the network."""
    setuptools = pytest.importorskip("setuptools", minversion="77", reason="builds the wheel")
    code = (
        "import os, sys; from setuptools import build_meta; os.chdir(sys.argv[1]);"
        "print(build_meta.build_wheel(sys.argv[2]))"
    )
    source = tmp_path / "source"
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    for name in filter(None, listed.stdout.split("\0")):
        if name.startswith(("surgisoft/", "scenes/")) or "/" not in name:
            place = source / name
            place.parent.mkdir(parents=True, exist_ok=True)
            if (ROOT / name).is_file():
                place.write_bytes((ROOT / name).read_bytes())
    built = subprocess.run(
        [sys.executable, "-c", code, source, tmp_path], capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    inside = set(zipfile.ZipFile(wheel).namelist())
    assert inside >= WANTED
    (about,) = (name for name in inside if name.endswith(".dist-info/METADATA"))
    metadata = zipfile.ZipFile(wheel).read(about).decode()
    assert "Description-Content-Type: text/markdown" in metadata
    assert "surgisoft demo" in metadata
    assert not RELATIVE.search(metadata)
    modules = {str(path.relative_to(source)) for path in (source / "surgisoft").rglob("*.py")}
    assert inside >= modules
    assert setuptools
