"""Count what the structure of the package can be judged by: modules, importers, import circles.

    python benchmarks/structure.py [ROOT]

ROOT is the root of a checkout, this one by default; only its source text is read. A module has a
single importer where exactly one other module of the package imports it. Modules that a registry
lists (one effect, task or reader a file) have one by design and are counted apart. A circle is a
set of modules that import each other, directly or through others, wherever the import stands (in
a function or under TYPE_CHECKING too); `surgisoft` itself, which hands names on lazily and holds
`__version__`, is no part of it.
"""

import ast
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

import networkx

PACKAGE = "surgisoft"
REGISTRIES = ("surrogate.effects", "tasks.registry", "measurement.importing.readers")
"""Modules that list one file for each thing that they know."""


def modules(root: Path) -> dict[str, Path]:
    """Dotted name -> file of every module of the package."""
    found = {}
    for path in sorted((root / PACKAGE).rglob("*.py")):
        name = ".".join(path.relative_to(root).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = path
    return found


@cache
def imports(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """The imports of a file, in functions too; no expression holds one, so none is searched."""
    found: list[ast.Import | ast.ImportFrom] = []
    waiting: list[ast.AST] = [ast.parse(path.read_text())]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.append(node)
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            waiting += getattr(node, field, ())
    return found


def importers(known: dict[str, Path]) -> dict[str, set[str]]:
    """Name of each module -> names of the modules of the package that import it."""
    result: dict[str, set[str]] = defaultdict(set)
    for name, path in known.items():
        for node in imports(path):
            targets = []
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    targets.append(whole if whole in known else node.module)
            elif isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            for target in targets:
                if target in known and target != name:
                    result[target].add(name)
    return result


def circles(users: dict[str, set[str]]) -> list[list[str]]:
    """Sets of modules that import each other, from `importers`; each sorted by name."""
    graph = networkx.DiGraph((user, name) for name, found in users.items() for user in found)
    graph.remove_nodes_from([PACKAGE])
    return [sorted(c) for c in networkx.strongly_connected_components(graph) if len(c) > 1]


def main(root: Path) -> None:
    """Print one line for each count."""
    known = modules(root)
    users = importers(known)
    lines = {name: len(path.read_text().splitlines()) for name, path in known.items()}
    single = {
        name: next(iter(users[name]))
        for name, path in known.items()
        if len(users[name]) == 1 and path.name != "__init__.py"
    }
    listed = [n for n, user in single.items() if user.removeprefix(f"{PACKAGE}.") in REGISTRIES]
    found = circles(users)
    print(f"modules: {len(known)}, lines: {sum(lines.values())}, longest: {max(lines.values())}")
    print(f"modules below 60 lines: {sum(count < 60 for count in lines.values())}")
    print(
        f"modules with a single importer: {len(single)} ({sum(lines[n] for n in single)} lines), "
        f"{len(listed)} of them listed by a registry"
    )
    print(f"import circles: {len(found)}")
    for circle in found:
        print("  " + ", ".join(circle))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1])
