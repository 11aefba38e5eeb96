"""What a plain install finds: the scene that comes with the project, whatever the directory."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from surgisoft.scene.spec import PHANTOM

ROOT = Path(__file__).resolve().parents[1]
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
    modules = {str(path.relative_to(source)) for path in (source / "surgisoft").rglob("*.py")}
    assert inside >= modules
    assert setuptools
