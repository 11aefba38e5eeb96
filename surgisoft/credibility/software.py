"""What computed a report: versions, the commit of the source code, and where its tests stand."""

import json
import platform
import re
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from pathlib import Path

import surgisoft
from surgisoft import __version__

LIBRARIES = ("torch", "numpy", "scipy", "python-fcl")
"""Libraries whose versions are stated, beside the package and Python."""
PACKAGE = Path(surgisoft.__file__).resolve().parent
"""Folder of the package that runs."""
COMMIT = "commit"
"""Key of the commit among the versions."""
TESTS = (
    "The source code comes with its tests. `make test` runs them, `make coverage` states the "
    "branches that they take (docs/results/coverage.md), and `make mutants` the wrong versions of "
    "the source that they notice (docs/results/mutants.md)."
)
"""Where the record of the tests stands; their numbers belong to a commit and are not stated."""
_HASH = re.compile(r"[0-9a-f]{40}(?:[0-9a-f]{24})?")


def software() -> dict[str, str]:
    """Versions of the package, of Python and of the libraries that compute, and the commit."""
    found = {"surgisoft": __version__}
    commit = commit_of()
    if commit is not None:
        found[COMMIT] = commit
    found["python"] = platform.python_version()
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def commit_of(package: Path = PACKAGE) -> str | None:
    """The commit of a package's source code; None where it is not known.

    It is that of the git checkout that holds the package's folder, else that which pip wrote down
    when it installed the package from a repository (PEP 610). Changes of the source after the
    commit are not seen.
    """
    try:
        return _checked_out(package.parent / ".git") or _installed(package)
    except (OSError, ValueError):  # not readable, or no text
        return None


def _checked_out(git: Path) -> str | None:
    """The commit of a checkout by its `.git`, a folder or the file of a linked working tree."""
    if git.is_file():
        git = git.parent / git.read_text().removeprefix("gitdir:").strip()
    if not (git / "HEAD").is_file():
        return None
    head = (git / "HEAD").read_text().strip()
    if not head.startswith("ref:"):
        return _hash(head)
    name = head.removeprefix("ref:").strip()
    common = git / "commondir"
    shared = git / common.read_text().strip() if common.is_file() else git
    for place in (git, shared):
        if (place / name).is_file():
            return _hash((place / name).read_text().strip())
    packed = shared / "packed-refs"
    for line in packed.read_text().splitlines() if packed.is_file() else ():
        commit, _, ref = line.partition(" ")
        if ref == name:
            return _hash(commit)
    return None


def _installed(package: Path) -> str | None:
    """The commit in pip's record of where it installed the package from."""
    try:
        found: Distribution = distribution(package.name)
    except PackageNotFoundError:
        return None
    if Path(str(found.locate_file(package.name))).resolve() != package:
        return None  # the record is that of another copy
    origin = json.loads(found.read_text("direct_url.json") or "{}")
    info = origin.get("vcs_info") if isinstance(origin, dict) else None
    return _hash(str(info.get("commit_id"))) if isinstance(info, dict) else None


def _hash(text: str) -> str | None:
    return text if _HASH.fullmatch(text) else None
