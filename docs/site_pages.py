"""Pages of the documentation site that are made while it is built (a hook of mkdocs).

`index.md`, `contributing.md`, `changelog.md` and `security.md` are README.md, CONTRIBUTING.md,
CHANGELOG.md and SECURITY.md of the repository's root with their links changed. `api/` has one page
for each part of the package.
"""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "surgisoft"
FROM_ROOT = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
}
"""File of the repository's root -> page of the site."""
TITLES = {
    "": "surgisoft",
    "agents": "agents: training, policies, evaluation",
    "cli": "cli: commands",
    "diagnosis": "diagnosis: system identification",
    "experiments": "experiments",
    "live": "live: closed loop on a rig with a model beside it",
    "measurement": "measurement: recordings, importing, protocols",
    "replay": "replay: Rerun views",
    "report": "report: HTML pages",
    "rig": "rig: the virtual rig",
    "scene": "scene: geometry",
    "surrogate": "surrogate: the arm model and its effects",
    "tasks": "tasks: world, tasks, adapters",
}
"""Part of the package -> title of its page; the part "" are the modules of the ground."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put a page for each part into the navigation."""
    pages = [{TITLES.get(part, part): _page(part)} for part in _parts()]
    config.nav.insert(2, {"API": pages})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that no file under docs/ holds."""
    for source, page in FROM_ROOT.items():
        text = _relinked((ROOT / source).read_text())
        files.append(File.generated(config, page, content=text))
    for part in _parts():
        files.append(File.generated(config, _page(part), content=_api(part)))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Take off the fences what only docs/run_tutorials.py reads; else a block shows as prose."""
    return re.sub(r'^( *```\w+) needs="[^"]*"$', r"\1", markdown, flags=re.M)


def _parts() -> list[str]:
    """The modules of the ground, then each part, by name."""
    return ["", *sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))]


def _page(part: str) -> str:
    return f"api/{part or 'surgisoft'}.md"


def _api(part: str) -> str:
    """The page of a part: every module, in the order of their names."""
    folder = PACKAGE / part
    found = folder.rglob("*.py") if part else folder.glob("*.py")
    names = sorted(
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in found
        if path.stem != "__main__"
    )
    return "\n\n".join([f"# {TITLES.get(part, part)}", *(f"::: {name}" for name in names)]) + "\n"


def _relinked(text: str) -> str:
    """Links of a file of the root as they are from docs/."""
    text = re.sub(r"\]\(docs/", "](", text)
    for source, page in FROM_ROOT.items():
        text = text.replace(f"]({source}", f"]({page}")
    return text
