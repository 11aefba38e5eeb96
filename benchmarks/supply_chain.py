"""Licences and hashes of all packages that the project installs.

    python -m benchmarks.supply_chain licences    # prints docs/licences.md
    python -m benchmarks.supply_chain lock        # prints requirements.lock

`licences` reads the metadata of the installed packages. `lock` asks pip which files it would
install for the versions of constraints.txt, without installing them, and prints their SHA-256.
"""

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = ("dev", "docs")
"""Extras that `make` installs beside the package."""
UNHASHED = "torch"
"""The package whose build the user chooses (`make TORCH=...`): CPU and CUDA builds of one version
are different files, so no hash in this repository can hold for all of them."""

COMPATIBLE = frozenset(
    [
        *("0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "HPND"),
        *("ISC", "LLVM-exception", "MIT", "MIT-0", "MIT-CMU", "MPL-2.0", "PSF-2.0", "Python-2.0"),
        *("Unicode-3.0", "Unlicense", "Zlib", "bzip2-1.0.6"),
    ]
)
"""SPDX identifiers of licences under which a package may be used by one under MIT: permissive ones,
and MPL-2.0, whose copyleft ends at its own files. None of the packages is copied into this one."""

IN_WORDS = {
    "apache 2.0": "Apache-2.0",
    "apache license 2.0": "Apache-2.0",
    "apache license, version 2.0": "Apache-2.0",
    "apache software license": "Apache-2.0",
    "apache-2.0 license": "Apache-2.0",
    "3-clause bsd license": "BSD-3-Clause",
    "bsd": "BSD-3-Clause",
    "bsd 3-clause license": "BSD-3-Clause",
    "bsd license": "BSD-3-Clause",
    "bsd-3-clause license": "BSD-3-Clause",
    "isc license": "ISC",
    "isc license (iscl)": "ISC",
    "mit license": "MIT",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "python software foundation license": "PSF-2.0",
    "the unlicense (unlicense)": "Unlicense",
}
"""SPDX identifiers of what packages state in other words."""


IN_TEXT = {
    "Redistribution and use in source and binary forms, with or without modification, are "
    "permitted provided that the following conditions are met: * Redistributions of source "
    "code must retain "
    "the above copyright notice, this list of conditions and the following disclaimer. * "
    "Redistributions in binary form must reproduce the above copyright notice, this list of "
    "conditions and the following disclaimer in the documentation and/or other materials provided "
    "with the distribution. THIS SOFTWARE": "BSD-2-Clause",
}
"""SPDX identifiers of licences that packages give in full, by their words."""


@dataclass(frozen=True)
class Package:
    """An installed package and its licence."""

    name: str
    """Canonical name."""
    version: str
    """Installed version."""
    licence: str
    """SPDX expression; `unknown: ...` where the metadata cannot be read as one."""

    @property
    def compatible(self) -> bool:
        """Whether some choice that the expression offers is compatible with MIT."""
        return any(
            all(name in COMPATIBLE for name in re.split(r" and | with ", choice, flags=re.I))
            for choice in re.split(r" or ", re.sub(r"[()]", "", self.licence), flags=re.I)
        )


def licence_of(metadata, file: str = "") -> str:
    """SPDX expression of a package's metadata: License-Expression, classifiers, or License.

    file: text of its licence file, whose first line counts where the metadata state none.
    """
    if metadata.get("License-Expression"):
        return metadata["License-Expression"]
    prefix = "License :: "
    stated = [c.split(" :: ")[-1] for c in metadata.get_all("Classifier", []) if prefix in c]
    stated = [one for one in stated if one != "OSI Approved"]
    text = metadata.get("License") or ("" if stated else file)
    for one in [*stated, text.strip().splitlines()[0] if text.strip() else ""]:
        known = IN_WORDS.get(one.lower(), one)
        if Package("", "", known).compatible:
            return known
    for beginning, known in IN_TEXT.items():
        if beginning in " ".join(text.split()):
            return known
    return f"unknown: {'; '.join(stated) or text[:60] or 'none stated'}"


def project_requirements() -> list[Requirement]:
    """Direct requirements of the package and of the extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    found = {text: Requirement(text) for text in project["dependencies"]}
    waiting = list(EXTRAS)
    while waiting:
        for text in project["optional-dependencies"][waiting.pop()]:
            one = Requirement(text)
            if one.name == project["name"]:
                waiting += sorted(one.extras)
            else:
                found[text] = one
    return [found[text] for text in sorted(found)]


def installed() -> dict[str, Distribution]:
    """Every installed package that the project needs, directly or through another one."""
    found: dict[str, Distribution] = {}
    waiting = [(one, frozenset(one.extras)) for one in project_requirements()]
    seen = set()
    while waiting:
        needed, extras = waiting.pop()
        name = canonicalize_name(needed.name)
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            continue  # an extra that is not installed here
        for text in found[name].requires or []:
            further = Requirement(text)
            for extra in extras or {""}:
                if further.marker is None or further.marker.evaluate({"extra": extra}):
                    waiting.append((further, frozenset(further.extras)))
    return dict(sorted(found.items()))


def packages() -> list[Package]:
    """The installed packages with their licences."""
    return [
        Package(name, one.version, licence_of(one.metadata, _licence_file(one)))
        for name, one in installed().items()
    ]


def _licence_file(package: Distribution) -> str:
    """Text of a package's first licence file; empty where its metadata name none."""
    names = package.metadata.get_all("License-File", [])
    return (package.read_text(f"licenses/{names[0]}") or "") if names else ""


def licences_page(some: list[Package]) -> str:
    """The page of licences."""
    lines = [
        "# Licences of dependencies",
        "",
        "Printed by `python -m benchmarks.supply_chain licences` from the metadata of the",
        "packages that `make` installs. surgisoft is under MIT. A test holds that each of them is",
        "compatible with that: permissive, or MPL-2.0, whose copyleft ends at its own files. No",
        "package is copied into this repository.",
        "",
        "| package | version | licence (SPDX) |",
        "|---|---|---|",
    ]
    lines += [f"| {one.name} | {one.version} | {one.licence} |" for one in some]
    return "\n".join(lines) + "\n"


def lock() -> str:
    """Versions with the SHA-256 of the files that pip chooses on this machine."""
    wanted = [str(one) for one in project_requirements()]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed"]
        command += ["--quiet", "--report", str(report), "-c", str(ROOT / "constraints.txt")]
        subprocess.run([*command, *wanted], check=True, stderr=subprocess.DEVNULL)
        chosen = json.loads(report.read_text())["install"]
    rows = {
        canonicalize_name(one["metadata"]["name"]): (
            one["metadata"]["version"],
            one["download_info"]["archive_info"]["hashes"]["sha256"],
        )
        for one in chosen
    }
    head = [
        "# Files of Linux x86-64 and Python 3.11 by their SHA-256, for the versions of",
        "# constraints.txt. Printed by `python -m benchmarks.supply_chain lock`. Use:",
        "#",
        '#   pip install --no-deps "torch==2.13.0+cpu"    # or another build; no hash is here',
        "#   pip install --require-hashes --no-deps -r requirements.lock",
        "#   pip install --no-deps --no-build-isolation -e .",
    ]
    body = [
        f"{name}=={version} --hash=sha256:{digest}"
        for name, (version, digest) in sorted(rows.items())
        if name != UNHASHED
    ]
    return "\n".join([*head, *body]) + "\n"


if __name__ == "__main__":
    sys.stdout.write(lock() if sys.argv[1:] == ["lock"] else licences_page(packages()))
