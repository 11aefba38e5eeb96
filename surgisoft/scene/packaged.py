"""The scenes that come with the package, by name."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
SCENES = (_PACKAGE if (_PACKAGE / "scenes").is_dir() else _PACKAGE.parent) / "scenes"
"""Their folder: in the installed package, or beside it in a checkout."""
PHANTOM = SCENES / "phantom_liver"
"""The liver phantom."""


def packaged_scene(path: str | Path) -> Path:
    """The folder of a packaged scene for its name, where nothing of that name exists here.

    Any other path is returned as it is.
    """
    path = Path(path)
    named = len(path.parts) == 1 and not path.exists()
    return SCENES / path if named and (SCENES / path / "scene.toml").is_file() else path
