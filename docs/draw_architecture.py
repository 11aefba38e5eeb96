"""Draw docs/images/architecture.svg: the parts of the package and who imports whom.

    python docs/draw_architecture.py            write the picture
    python docs/draw_architecture.py --check    exit code 1 if the picture is out of date

The imports are read from the source. A part stands one floor above the highest part that it
imports. An arrow that follows from two others is left out (transitive reduction).
"""

import ast
import sys
from itertools import combinations, pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "surgisoft"
PICTURE = ROOT / "docs" / "images" / "architecture.svg"

ABOUT = {
    "cli": "commands",
    "experiments": "scripted experiments",
    "credibility": "comparison for a stated use",
    "live": "closed loop, change detector",
    "agents": "PPO, policies, evaluation",
    "diagnosis": "system identification",
    "rig": "virtual rig",
    "replay": "Rerun views",
    "tasks": "tasks, adapters, world",
    "measurement": "recordings, importing",
    "surrogate": "arm model, effects",
    "scene": "geometry, laser dose",
    "report": "HTML pages",
}
"""One line for each part; a part without one is drawn with its name alone."""

BEND = 12
"""Width that an arrow takes on a floor that it passes, px."""
BOX = (168, 46)
"""Width and height of a box, px."""
GAP = (26, 54)
"""Space between boxes, horizontally and vertically, px."""
MARGIN = 20
"""Space around the drawing, px."""


def imports_of_parts() -> dict[str, set[str]]:
    """Part (a folder of the package) -> the parts that it imports."""
    parts = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
    found: dict[str, set[str]] = {part: set() for part in parts}
    for part in parts:
        for path in (PACKAGE / part).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                names = []
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and node.module:
                    names = [f"{node.module}.{alias.name}" for alias in node.names]
                for name in names:
                    words = name.split(".")
                    if words[0] == "surgisoft" and len(words) > 1 and words[1] in found:
                        found[part].add(words[1])
        found[part].discard(part)
    return found


def floors(imports: dict[str, set[str]]) -> dict[str, int]:
    """Part -> its floor, from 0 at the ground. A circle of imports raises ValueError."""
    known: dict[str, int] = {}

    def floor(part: str, above: tuple[str, ...]) -> int:
        if part in above:
            raise ValueError(f"imports in a circle: {' -> '.join((*above, part))}")
        if part not in known:
            below = [floor(other, (*above, part)) for other in sorted(imports[part])]
            known[part] = 1 + max(below, default=-1)
        return known[part]

    for part in imports:
        floor(part, ())
    return known


def reduced(imports: dict[str, set[str]]) -> dict[str, set[str]]:
    """The imports without those that follow from two others."""

    def reach(part: str) -> set[str]:
        seen = set(imports[part])
        for other in imports[part]:
            seen |= reach(other)
        return seen

    return {
        part: {a for a in below if not any(a in reach(b) for b in below - {a})}
        for part, below in imports.items()
    }


Chain = list[tuple[int, str]]
"""An arrow as the places (floor, name) that it passes, from the top; `>` marks a bend."""


def chains(below: dict[str, set[str]], level: dict[str, int]) -> list[Chain]:
    """Every arrow, with a place of its own on each floor that it passes between two parts."""
    return [
        [(level[part], part)]
        + [(k, f"{part}>{other}") for k in range(level[part] - 1, level[other], -1)]
        + [(level[other], other)]
        for part in sorted(below)
        for other in sorted(below[part])
    ]


def order(rows: list[list[str]], arrows: list[Chain]) -> list[list[str]]:
    """Rows in an order with few crossings: each place near the mean of its neighbours.

    Sweeps up and down (Sugiyama, Tagawa & Toda 1981, barycentre method); the best is kept.
    """
    pairs = [pair for arrow in arrows for pair in pairwise(arrow)]

    def crossings(rows: list[list[str]]) -> int:
        at = {(k, name): i for k, row in enumerate(rows) for i, name in enumerate(row)}
        return sum(
            a[0] == c[0] and (at[a] - at[c]) * (at[b] - at[d]) < 0
            for (a, b), (c, d) in combinations(pairs, 2)
        )

    best = rows
    for sweep in range(12):
        up = sweep % 2 == 0
        for k in range(1, len(rows)) if up else range(len(rows) - 2, -1, -1):
            near = k - 1 if up else k + 1
            at = {name: i / len(rows[near]) for i, name in enumerate(rows[near])}
            means = {}
            for name in rows[k]:
                ends = [pair[::-1] if up else pair for pair in pairs]
                beside = [at[b[1]] for b, a in ends if a == (k, name) and b[0] == near]
                means[name] = sum(beside) / len(beside) if beside else 0.5
            rows = [*rows[:k], sorted(rows[k], key=means.__getitem__), *rows[k + 1 :]]
        if crossings(rows) < crossings(best):
            best = rows
    return best


def drawing() -> str:
    """The picture as SVG text."""
    imports = imports_of_parts()
    level = floors(imports)
    top = max(level.values())
    arrows = chains(reduced(imports), level)
    places = {place for arrow in arrows for place in arrow} | {(level[p], p) for p in imports}
    rows = order([sorted(n for f, n in places if f == k) for k in range(top + 1)], arrows)
    wide = [sum((BEND if ">" in name else BOX[0]) + GAP[0] for name in row) for row in rows]
    width = max(wide) - GAP[0] + 2 * MARGIN
    middle: dict[tuple[int, str], tuple[float, float]] = {}
    for k, row in enumerate(rows):
        left = (width - wide[k] + GAP[0]) / 2
        for name in row:
            own = BEND if ">" in name else BOX[0]
            middle[k, name] = (left + own / 2, MARGIN + (top - k) * (BOX[1] + GAP[1]))
            left += own + GAP[0]
    ground = MARGIN + (top + 1) * (BOX[1] + GAP[1])
    height = ground + BOX[1] + MARGIN
    modules = sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem[0] != "_")
    line = 'fill="none" stroke="#56697d" stroke-width="1.3"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="sans-serif">',
        "<title>Parts of surgisoft and the direction of imports</title>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto">',
        '<path d="M0 0 L8 4 L0 8 z" fill="#56697d"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for arrow in arrows:
        path = ""
        for upper, lower in pairwise(arrow):
            (x, y), (u, v) = middle[upper], middle[lower]
            y += BOX[1]
            bend = GAP[1] * 0.55
            path += f"M{x:g} {y - BOX[1] if '>' in upper[1] else y:g} L{x:g} {y:g} "
            path += f"C{x:g} {y + bend:g} {u:g} {v - bend:g} {u:g} {v:g} "
        lines.append(f'<path d="{path.strip()}" {line} marker-end="url(#tip)"/>')
    for (_, name), (x, y) in sorted(middle.items(), key=lambda item: item[0][1]):
        if ">" not in name:
            lines += _box(x - BOX[0] / 2, y, BOX[0], name, ABOUT.get(name, ""), "#e8f0f7")
    about = ", ".join(modules)
    lines += _box(MARGIN, ground, width - 2 * MARGIN, "ground: every part may import it", about)
    return "\n".join([*lines, "</svg>", ""])


def _box(x: float, y: float, width: float, name: str, about: str, fill: str = "#f4f4ef"):
    middle = x + width / 2
    return [
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{BOX[1]}" rx="5" fill="{fill}" '
        'stroke="#56697d"/>',
        f'<text x="{middle:g}" y="{y + 19:g}" text-anchor="middle" font-size="14" '
        f'font-weight="bold" fill="#1b2733">{name}</text>',
        f'<text x="{middle:g}" y="{y + 36:g}" text-anchor="middle" font-size="11.5" '
        f'fill="#44525f">{about}</text>',
    ]


if __name__ == "__main__":
    picture = drawing()
    if "--check" in sys.argv[1:]:
        if not PICTURE.is_file() or PICTURE.read_text() != picture:
            sys.exit(
                "docs/images/architecture.svg is out of date: python docs/draw_architecture.py"
            )
    else:
        PICTURE.write_text(picture)
