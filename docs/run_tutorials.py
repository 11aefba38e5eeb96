"""Run the code of the documentation: tutorials with all their blocks, guides with their Python.

    python docs/run_tutorials.py [NAME...]           run pages; stop at the first block that fails
    python docs/run_tutorials.py --write [NAME...]   also renew their outputs, pictures, notebooks
    python docs/run_tutorials.py --notebooks         write the notebooks of the pages as they are

A tutorial (docs/tutorials) runs in an empty folder of its own. What a block is, its fence says:

- `bash`: lines for the shell, in which `surgisoft` is the one of this Python;
- `python`: Python; all blocks of a page share their names;
- any language with `title="FILE"`: the content of a file;
- `text` behind a block that runs: what it printed, which --write renews;
- `python needs="MODULE,..."`: is left out where a module is not installed, and said so.

A picture of a page, `![...](images/NAME.png)`, is the file NAME.png that its blocks left in the
folder; --write copies it, at most `MOST_PIXELS` wide.

Each tutorial is a Jupyter notebook too, NAME.ipynb beside it, made of the page with the outputs and
pictures that its run left: `bash` is a cell with `%%bash`, a file one with `%%writefile`.

The gallery (docs/gallery) is run and renewed in the same way, but only when it is named, because it
takes long. Its pictures of pages need Chromium, its pictures of replays a Vulkan driver.

A guide (README.md and docs) runs in a folder with a recording, a model, a trained policy and the
scenes; a block that begins with `# NAME.py` is also that file. Its lines for the shell are parsed
by tests/test_docs.py: commands and options exist.
"""

import base64
import contextlib
import importlib.util
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PAGES = Path(__file__).resolve().parent / "tutorials"
GALLERY = PAGES.parent / "gallery" / "index.md"
"""Pictures of tasks, replays and pages, each with the commands that made it."""
MOST_PIXELS = 1000
"""Widest picture that is kept; all pictures together stay below 2 MB."""
COLOURS = 256
"""Colours of a picture that is kept, as many as one byte of a pixel tells apart."""
ROOT = PAGES.parents[1]
NOT_RUN = {
    "docs/rigs.md": "drives the devices of a laboratory; a rig of four methods is run by own_rig",
    "docs/export.md": "reads a bench's samples; tests/agents/test_export.py runs it",
}
"""Guides whose Python cannot run without a robot, and what runs in their place."""
PICTURE = re.compile(r"\]\(images/([\w-]+\.png)\)")
SHOWN = re.compile(r"^!\[(?P<what>[^\]]*)\]\(images/(?P<name>[\w-]+\.png)\)\n", re.M)
LINK = "[This page as a Jupyter notebook](NAME.ipynb), with the same outputs.\n\n"
"""Line of a tutorial that its notebook leaves out; NAME is the page's."""
FIRST_CELL = """# Files go into a new folder; commands are those of this notebook's Python.
import os
import sys
import tempfile
from pathlib import Path

os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
%cd -q {tempfile.mkdtemp(prefix="surgisoft-")}"""
"""First cell of code of a notebook."""
PYTHON = re.compile(r"^(?P<indent> *)```python\n(?P<body>.*?)^ *```", re.S | re.M)
BLOCK = re.compile(r"^```(?P<info>[^\n]*)\n(?P<body>.*?)^```\n", re.S | re.M)


def main(arguments: list[str]) -> int:
    """Run the pages that are named, or all of them."""
    known = ("--write", "--notebooks")
    unknown = [one for one in arguments if one.startswith("-") and one not in known]
    if unknown:
        print(__doc__)
        return 0 if unknown[0] in ("-h", "--help") else 2
    if "--notebooks" in arguments:
        for page in tutorials():
            write_notebook(page)
        return 0
    write = "--write" in arguments
    names = [name.removesuffix(".md") for name in arguments if not name.startswith("-")]
    for guide in guides():
        name = guide.relative_to(ROOT).with_suffix("").as_posix()
        if not names or name in names:
            began = time.perf_counter()
            with tempfile.TemporaryDirectory(prefix="guide-") as folder:
                prepare(Path(folder))
                run_guide(guide.read_text(), Path(folder), guide.name)
            print(f"{name}: {time.perf_counter() - began:.0f} s")
    for page in [*tutorials(), *([GALLERY] if "gallery" in names else [])]:
        if names and page.stem not in names and page != GALLERY:
            continue
        began = time.perf_counter()
        with tempfile.TemporaryDirectory(prefix="tutorial-") as folder:
            text = run_page(page.read_text(), Path(folder), page.name)
            pictures = PICTURE.findall(text)
            for name in pictures:
                made = Path(folder) / name
                if not made.is_file():
                    print(f"{page.name}: no block made {name}", file=sys.stderr)
                    return 1
                if write:
                    keep(made, page.parent / "images" / name)
        if write:
            page.write_text(text)
            if page != GALLERY:
                write_notebook(page)
        print(f"{page.relative_to(PAGES.parent)}: {time.perf_counter() - began:.0f} s")
    return 0


def tutorials() -> list[Path]:
    """The pages whose blocks are all run."""
    return [page for page in sorted(PAGES.glob("*.md")) if page.name != "index.md"]


def write_notebook(page: Path) -> None:
    """Write the notebook of a page beside it."""
    whole = json.dumps(notebook(page.read_text(), page.stem), indent=1, ensure_ascii=False)
    page.with_suffix(".ipynb").write_text(whole + "\n")


def notebook(text: str, name: str) -> dict:
    """A tutorial as a Jupyter notebook (nbformat 4.5), with the outputs that the page shows."""
    cells: list[dict] = []

    def cell(kind: str, source: str) -> None:
        one = {"cell_type": kind, "id": f"{name}-{len(cells)}", "metadata": {}}
        if kind == "code":
            count = 1 + sum(other["cell_type"] == "code" for other in cells)
            one |= {"execution_count": count, "outputs": []}
        cells.append(one | {"source": source.rstrip("\n").splitlines(keepends=True)})

    def prose(part: str) -> None:
        at = 0
        for picture in SHOWN.finditer(part):
            words(part[at : picture.start()])
            at = picture.end()
            shown = picture["name"]
            cell(
                "code",
                f'# {picture["what"]}\nfrom IPython.display import Image\n\nImage("{shown}")',
            )
            data = base64.b64encode((PAGES / "images" / shown).read_bytes()).decode()
            plain = "<IPython.core.display.Image object>"
            cells[-1]["outputs"] = [
                {
                    "output_type": "execute_result",
                    "execution_count": cells[-1]["execution_count"],
                    "data": {"image/png": data, "text/plain": [plain]},
                    "metadata": {},
                }
            ]
        words(part[at:])

    def words(part: str) -> None:
        if part.strip():
            cell("markdown", part.strip("\n"))

    at, ran = 0, None  # ran: the cell that printed what the next block of text holds
    text = text.replace(LINK.replace("NAME", name), "")
    for block in BLOCK.finditer(text):
        prose(text[at : block.start()])
        at = block.end()
        info, body = block["info"], block["body"]
        language = info.split(" ")[0]
        title = re.search(r'title="([^"]+)"', info)
        needs = re.search(r'needs="([^"]+)"', info)
        if not any(one["cell_type"] == "code" for one in cells):
            cell("code", FIRST_CELL)
        if language == "text" and ran is not None:
            lines = body.splitlines(keepends=True)
            ran["outputs"] = [{"output_type": "stream", "name": "stdout", "text": lines}]
        elif title:
            cell("code", f"%%writefile {title[1]}\n{body}")
            lines = [f"Writing {title[1]}\n"]
            cells[-1]["outputs"] = [{"output_type": "stream", "name": "stdout", "text": lines}]
        elif language == "bash":
            cell("code", f"%%bash\nset -euo pipefail\n{body}")
        elif language == "python":
            cell("code", (f"# needs {needs[1].replace(',', ', ')}\n" if needs else "") + body)
        else:
            words(block[0])
        ran = cells[-1] if language in ("bash", "python") and not title else None
    prose(text[at:])
    python = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {
        "cells": cells,
        "metadata": {"kernelspec": python, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def guides() -> list[Path]:
    """Pages outside of the tutorials whose Python is run."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return sorted(
        page
        for page in pages
        if page.parent != PAGES
        and page.relative_to(ROOT).as_posix() not in NOT_RUN
        and PYTHON.search(page.read_text())
    )


def prepare(folder: Path) -> None:
    """Put what the guides' blocks read into a folder: recording, model, policy, scenes."""
    import surgisoft

    recording = surgisoft.collect("mixed", seed=0, points=900, hidden=["creep"])
    surgisoft.save_recording(recording, folder / "bench.parquet")
    surgisoft.save_model(surgisoft.load_model("default"), folder / "arm")
    shutil.copytree(ROOT / "surgisoft/assets/policies/ring", folder / "runs" / "ring")
    shutil.copytree(ROOT / "scenes", folder / "scenes")
    context = (ROOT / "docs/examples/credibility/phantom.toml").read_text()
    context = context.replace('"bench_1.parquet", "bench_2.parquet"', '"bench.parquet"')
    context = re.sub(r"\[\[sources\]\]\nname = \"bench_2\"\n(.+\n)*", "", context)
    (folder / "context.toml").write_text(context.replace("bench_1", "bench"))


def run_guide(text: str, folder: Path, name: str) -> None:
    """Run the blocks of Python of a guide, which share their names."""
    names: dict = {"__name__": "guide"}
    for block in PYTHON.finditer(text):
        indent = len(block["indent"])
        source = "".join(line[indent:] or "\n" for line in block["body"].splitlines(keepends=True))
        if titled := re.match(r"# (\w+\.py)\b", source):
            (folder / titled[1]).write_text(source)
        python(source, folder, names, name)


def run_page(text: str, folder: Path, name: str) -> str:
    """The page with the outputs of its blocks; raises SystemExit for one that fails."""
    names: dict = {"__name__": "tutorial"}
    said = None

    def run(block: re.Match) -> str:
        nonlocal said
        info, body = block["info"], block["body"]
        language = info.split(" ")[0]
        title = re.search(r'title="([^"]+)"', info)
        needs = re.search(r'needs="([^"]+)"', info)
        if language == "text" and not title:
            answer, said = block[0] if said is None else f"```text\n{said}```\n", None
            return answer
        said = None
        if title:
            (folder / title[1]).parent.mkdir(parents=True, exist_ok=True)
            (folder / title[1]).write_text(body)
        elif needs and (absent := not_installed(needs[1])):
            print(f"{name}: a block was left out, {', '.join(absent)} is not installed")
        elif language == "bash":
            said = shell(body, folder, name)
        elif language == "python":
            said = python(body, folder, names, name)
        return block[0]

    return BLOCK.sub(run, text)


def not_installed(modules: str) -> list[str]:
    """Those of the modules, with commas in between, that are not installed."""
    return [name for name in modules.split(",") if importlib.util.find_spec(name) is None]


def shell(lines: str, folder: Path, page: str) -> str:
    """What lines print in bash."""
    with tempfile.TemporaryDirectory() as programs:
        lines_of = {"surgisoft": f'exec "{sys.executable}" -m surgisoft "$@"'}
        if (browser := shutil.which("chromium")) and getattr(os, "geteuid", lambda: 1)() == 0:
            lines_of["chromium"] = f'exec "{browser}" --no-sandbox "$@"'  # root has no sandbox
        for program, line in lines_of.items():
            (Path(programs) / program).write_text(f"#!/bin/sh\n{line}\n")
            (Path(programs) / program).chmod(0o755)
        path = f"{programs}{os.pathsep}{Path(sys.executable).parent}{os.pathsep}"
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", lines],
            cwd=folder,
            env={**os.environ, "PATH": path + os.environ["PATH"]},
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        sys.exit(f"{page}: code {done.returncode} of\n{lines}{done.stdout}{done.stderr}")
    return done.stdout


def python(source: str, folder: Path, names: dict, page: str) -> str:
    """What a block of Python prints; its names stay in `names`."""
    out, before = io.StringIO(), Path.cwd()
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    try:
        with contextlib.redirect_stdout(out):
            exec(compile(source, f"{page}, a block of Python", "exec"), names)
    finally:
        os.chdir(before)
        sys.path.remove(str(folder))
    return out.getvalue()


def keep(made: Path, place: Path) -> None:
    """Copy a picture, no wider than the page and with few colours.

    The palette covers the colours that occur, however few pixels have them: a palette of equally
    frequent colours (Pillow's default) takes the colour of thin lines away. k-means then moves each
    colour to the mean of its pixels, without which broad areas are tinted.
    """
    from PIL import Image

    place.parent.mkdir(exist_ok=True)
    picture = Image.open(made).convert("RGB")
    if picture.width > MOST_PIXELS:
        height = round(picture.height * MOST_PIXELS / picture.width)
        picture = picture.resize((MOST_PIXELS, height), Image.Resampling.LANCZOS)
    shutil.rmtree(place, ignore_errors=True)
    picture.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=1).save(place, optimize=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
