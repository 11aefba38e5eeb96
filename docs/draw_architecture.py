"""Draw docs/images/architecture.svg: the parts of the package and who imports whom.

    python docs/draw_architecture.py            write the picture
    python docs/draw_architecture.py --check    exit code 1 if the picture is out of date
    python docs/draw_architecture.py --root CHECKOUT --inside diagnosis -o before.svg

The imports are read from the source. A part stands one floor above the highest part that it
imports. An arrow that follows from two others is left out (transitive reduction). `--root` draws
another checkout, and `--inside PART` the folders and modules of one part. Parts that import each
other, directly or through others, share a box with a red frame.
"""

import argparse
import ast
import sys
import textwrap
from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
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
LETTER = (9, 6)
"""Width of a letter of a part's name and of the line below it, px."""
LINE = 15
"""Height of each further line in a box, px."""
MARGIN = 20
"""Space around the drawing, px."""


def files_of_parts(folder: Path, modules: bool = False) -> dict[str, list[Path]]:
    """Part (a folder of `folder`; with `modules` a module of it, too) -> its source files."""
    files = {path.parent.name: list(path.parent.rglob("*.py")) for path in folder.glob("*/*.py")}
    if modules:
        files |= {path.stem: [path] for path in folder.glob("*.py") if path.stem != "__init__"}
    return files


def imports_of_parts(folder: Path, modules: bool = False) -> dict[str, set[str]]:
    """Part -> the parts that it imports; the parts are those of `files_of_parts`."""
    files = files_of_parts(folder, modules)
    prefix = ["surgisoft", *folder.relative_to(_package(folder)).parts]
    found: dict[str, set[str]] = {part: set() for part in sorted(files)}
    for part, paths in files.items():
        for path in paths:
            for node in ast.walk(ast.parse(path.read_text())):
                names = []
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and node.module:
                    names = [f"{node.module}.{alias.name}" for alias in node.names]
                for name in names:
                    words = name.split(".")
                    if words[: len(prefix)] == prefix and len(words) > len(prefix):
                        found[part] |= {words[len(prefix)]} & found.keys()
        found[part].discard(part)
    return found


def _package(folder: Path) -> Path:
    return next(place for place in (folder, *folder.parents) if place.name == "surgisoft")


def without_circles(imports: dict[str, set[str]]) -> dict[str, set[str]]:
    """The imports with the parts of each circle joined into one part, `a, b, c`."""
    reach = {part: {part} for part in imports}
    for _ in imports:
        reach = {part: reach[part].union(*(reach[b] for b in imports[part])) for part in imports}
    name = {a: ", ".join(sorted(b for b in reach[a] if a in reach[b])) for a in imports}
    joined: dict[str, set[str]] = {name[part]: set() for part in imports}
    for part, below in imports.items():
        joined[name[part]] |= {name[other] for other in below} - {name[part]}
    return joined


def floors(imports: dict[str, set[str]]) -> dict[str, int]:
    """Part -> its floor, from 0 at the ground."""
    known: dict[str, int] = {}

    def floor(part: str) -> int:
        if part not in known:
            known[part] = 1 + max((floor(other) for other in imports[part]), default=-1)
        return known[part]

    for part in imports:
        floor(part)
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


def drawing(folder: Path, modules: bool = False) -> str:
    """The picture as SVG text."""
    imports = without_circles(imports_of_parts(folder, modules))
    level = floors(imports)
    top = max(level.values())
    arrows = chains(reduced(imports), level)
    places = {place for arrow in arrows for place in arrow} | {(level[p], p) for p in imports}
    rows = order([sorted(n for f, n in places if f == k) for k in range(top + 1)], arrows)
    sources = files_of_parts(folder, modules)

    def about_part(name: str) -> str:
        if not modules:
            return ABOUT.get(name, "")
        paths = [path for part in name.split(", ") for path in sources[part]]
        lines = sum(len(path.read_text().splitlines()) for path in paths)
        circle = "; import each other in a circle" if "," in name else ""
        return f"{len(paths)} {'file' if len(paths) == 1 else 'files'}, {lines:,} lines{circle}"

    def own_width(name: str) -> float:
        if ">" in name:
            return BEND
        return max(BOX[0], LETTER[0] * len(name), LETTER[1] * len(about_part(name)))

    wide = [sum(own_width(name) + GAP[0] for name in row) for row in rows]
    width = max(wide) - GAP[0] + 2 * MARGIN
    middle: dict[tuple[int, str], tuple[float, float]] = {}
    for k, row in enumerate(rows):
        left = (width - wide[k] + GAP[0]) / 2
        for name in row:
            own = own_width(name)
            middle[k, name] = (left + own / 2, MARGIN + (top - k) * (BOX[1] + GAP[1]))
            left += own + GAP[0]
    ground = MARGIN + (top + 1) * (BOX[1] + GAP[1])
    ground_modules = ", ".join(sorted(p.stem for p in folder.glob("*.py") if p.stem[0] != "_"))
    about_ground = textwrap.wrap(ground_modules, int((width - 4 * MARGIN) / LETTER[1]))
    height = ground if modules else ground + _tall(about_ground) + MARGIN
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
            own = own_width(name)
            frame = "#c0392b" if "," in name else "#56697d"
            about = about_part(name)
            lines += _box(x - own / 2, y, own, name, about, fill="#e8f0f7", frame=frame)
    if not modules:
        title, wide_box = "ground: every part may import it", width - 2 * MARGIN
        lines += _box(MARGIN, ground, wide_box, title, *about_ground)
    return "\n".join([*lines, "</svg>", ""])


def _box(
    x: float,
    y: float,
    width: float,
    name: str,
    *about: str,
    fill: str = "#f4f4ef",
    frame: str = "#56697d",
) -> list[str]:
    """A box with a name and lines below it."""
    middle = x + width / 2
    return [
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{_tall(about):g}" rx="5" '
        f'fill="{fill}" stroke="{frame}"/>',
        f'<text x="{middle:g}" y="{y + 19:g}" text-anchor="middle" font-size="14" '
        f'font-weight="bold" fill="#1b2733">{name}</text>',
        *(
            f'<text x="{middle:g}" y="{y + 36 + LINE * k:g}" text-anchor="middle" '
            f'font-size="11.5" fill="#44525f">{text}</text>'
            for k, text in enumerate(about)
        ),
    ]


def _tall(about: Sequence[str]) -> float:
    """Height of a box with these lines."""
    return BOX[1] + LINE * max(0, len(about) - 1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare with the stored picture")
    parser.add_argument("--root", type=Path, default=ROOT, help="a checkout")
    parser.add_argument("--inside", metavar="PART", help="draw the modules of this part")
    parser.add_argument("-o", "--output", type=Path, default=PICTURE, help="SVG file")
    options = parser.parse_args()
    folder = options.root.resolve() / "surgisoft"
    if options.inside:
        folder /= options.inside
    picture = drawing(folder, modules=bool(options.inside))
    if not options.check:
        options.output.write_text(picture)
    elif not options.output.is_file() or options.output.read_text() != picture:
        sys.exit("docs/images/architecture.svg is out of date: python docs/draw_architecture.py")
