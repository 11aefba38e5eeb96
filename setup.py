"""What pyproject.toml cannot say: the scenes, which are beside the package, and the description.

The description is README.md for a package index, where relative links lead nowhere.
"""

import re
import tomllib
from pathlib import Path

from setuptools import find_namespace_packages, setup

SCENES = ["surgisoft.scenes.phantom_liver", "surgisoft.scenes.phantom_liver.experiments"]
RELATIVE = re.compile(r"(!?)\[([^\]]*)\]\((?![a-z]+:|#)([^)]+)\)")
"""A link or picture of Markdown to a file of the repository: mark, text, target."""


def description(readme: str, repository: str = "") -> str:
    """README.md with absolute links: below the repository's address, laid out as on GitHub.

    Without an address, links become their text, and pictures are left out.
    """
    address = repository.rstrip("/")

    def absolute(link: re.Match[str]) -> str:
        mark, text, target = link.groups()
        if not address:
            return "" if mark else text
        return f"{mark}[{text}]({address}/{'raw' if mark else 'blob'}/HEAD/{target})"

    return RELATIVE.sub(absolute, readme)


if __name__ == "__main__":
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    setup(
        packages=[*find_namespace_packages(include=["surgisoft", "surgisoft.*"]), *SCENES],
        package_dir={"surgisoft.scenes": "scenes"},
        long_description=description(
            Path("README.md").read_text(encoding="utf-8"),
            project.get("urls", {}).get("Repository", ""),
        ),
        long_description_content_type="text/markdown",
    )
