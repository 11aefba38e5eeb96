"""The tutorials: their runner runs blocks in order, and their pictures stay small."""

import base64
import importlib.util
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from surgisoft.tasks.registry import TASKS

DOCS = Path(__file__).resolve().parents[1] / "docs"
spec = importlib.util.spec_from_file_location("run_tutorials", DOCS / "run_tutorials.py")
tutorials = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tutorials)

PAGE = """# A page

```toml title="a.toml"
n = 3
```

```python
import tomllib

n = tomllib.loads(open("a.toml").read())["n"]
```

```python
print(n + 1)
```

Words.

```text
old
```

```bash
cat a.toml | sed -n 1,1p
surgisoft --version | cut -c1-9
```

```text
```

```python needs="json,no_such_library"
raise ValueError
```

```text
kept
```
"""


def test_blocks_run_in_order_and_outputs_are_renewed(tmp_path):
    text = tutorials.run_page(PAGE, tmp_path, "page")
    outputs = [block["body"] for block in tutorials.BLOCK.finditer(text) if block["info"] == "text"]
    assert outputs == ["4\n", "n = 3\nsurgisoft\n", "kept\n"]
    assert (
        text.replace("4\n", "old\n").replace("n = 3\nsurgisoft\n```\n\n```p", "```\n\n```p") == PAGE
    )
    assert (tmp_path / "a.toml").read_text() == "n = 3\n"


def test_a_block_that_fails_stops_the_page(tmp_path):
    with pytest.raises(SystemExit, match="code 1"):
        tutorials.run_page("```bash\nfalse | cat\n```\n", tmp_path, "page")
    with pytest.raises(ZeroDivisionError):
        tutorials.run_page("```python\n1 / 0\n```\n", tmp_path, "page")


def test_every_picture_is_made_by_its_page_and_all_are_small():
    pages = sorted((DOCS / "tutorials").glob("*.md"))
    shown = {name for page in pages for name in tutorials.PICTURE.findall(page.read_text())}
    kept = list((DOCS / "tutorials" / "images").iterdir())
    assert shown == {path.name for path in kept}
    assert sum(path.stat().st_size for path in kept) < 2_000_000


def test_a_kept_picture_keeps_the_colour_of_a_thin_line(tmp_path):
    """A yellow path is a thousandth of a picture whose shades are many."""
    shades = np.random.default_rng(0).integers(90, 255, (400, 800))
    pixels = np.stack((shades, shades, np.roll(shades, 1)), -1).astype(np.uint8)
    pixels[200, 100:420] = yellow = (250, 200, 20)
    Image.fromarray(pixels).save(tmp_path / "made.png")
    tutorials.keep(tmp_path / "made.png", tmp_path / "images" / "kept.png")
    kept = np.asarray(Image.open(tmp_path / "images" / "kept.png").convert("RGB"), int)
    assert np.abs(kept[200, 100:420] - yellow).max() < 30


def test_every_output_of_a_tutorial_was_written():
    """Blocks of `text` are outputs: an empty one was never renewed."""
    for page in (DOCS / "tutorials").glob("*.md"):
        for block in tutorials.BLOCK.finditer(page.read_text()):
            assert block["info"] != "text" or block["body"].strip(), page.name


def test_a_notebook_has_the_cells_of_its_page_and_their_outputs():
    cells = tutorials.notebook(PAGE.replace("old", "4"), "page")["cells"]
    code = ["".join(one["source"]) for one in cells if one["cell_type"] == "code"]
    assert code[1:] == [
        "%%writefile a.toml\nn = 3",
        'import tomllib\n\nn = tomllib.loads(open("a.toml").read())["n"]',
        "print(n + 1)",
        "%%bash\nset -euo pipefail\ncat a.toml | sed -n 1,1p\nsurgisoft --version | cut -c1-9",
        "# needs json, no_such_library\nraise ValueError",
    ]
    printed = {
        "".join(one["source"]): "".join(one["outputs"][0]["text"])
        for one in cells
        if one["cell_type"] == "code" and one["outputs"]
    }
    assert printed["print(n + 1)"] == "4\n"
    words = ["".join(one["source"]) for one in cells if one["cell_type"] == "markdown"]
    assert words == ["# A page", "Words."]


@pytest.mark.parametrize("page", tutorials.tutorials(), ids=lambda page: page.stem)
def test_the_notebook_of_a_tutorial_is_that_of_its_page(page):
    """Also: each picture that the page shows is in the notebook as it is in the folder."""
    text = page.read_text()
    assert tutorials.LINK.replace("NAME", page.stem) in text
    made = json.loads(page.with_suffix(".ipynb").read_text())
    assert made == tutorials.notebook(text, page.stem), "python docs/run_tutorials.py --notebooks"
    drawn = [
        base64.b64decode(output["data"]["image/png"])
        for cell in made["cells"]
        for output in cell.get("outputs", [])
        if "data" in output
    ]
    shown = tutorials.PICTURE.findall(text)
    assert drawn == [(DOCS / "tutorials" / "images" / name).read_bytes() for name in shown]


GUIDE = """# A guide

```python
# mine.py: a file of the reader
n = 4
```

1. In a list:

   ```python
   from mine import n as same

   assert same == n
   n = same + 1
   ```

```
surgisoft --version
```
"""


def test_blocks_of_a_guide_share_names_and_are_files(tmp_path):
    tutorials.run_guide(GUIDE, tmp_path, "guide")
    assert (tmp_path / "mine.py").read_text().endswith("n = 4\n")
    with pytest.raises(AssertionError):
        tutorials.run_guide(GUIDE.replace("same == n", "same == n + 1"), tmp_path, "guide")


def test_python_of_every_guide_is_run_or_says_why_not():
    run = {page.relative_to(DOCS.parent).as_posix() for page in tutorials.guides()}
    assert {"README.md", "docs/your_model.md", "docs/tasks.md"} <= run
    assert all((DOCS.parent / page).is_file() for page in tutorials.NOT_RUN)


def test_the_gallery_has_every_task_and_the_command_of_each_picture():
    text = tutorials.GALLERY.read_text()
    shown, kept = tutorials.PICTURE.findall(text), [*(DOCS / "gallery" / "images").iterdir()]
    assert {f"{name}.png" for name in TASKS} <= set(shown)
    assert sorted(shown) == sorted(path.name for path in kept)
    assert sum(path.stat().st_size for path in kept) < 3_000_000
    for name in shown:
        above = text[: text.index(f"](images/{name})")]
        blocks = [block["body"] for block in tutorials.BLOCK.finditer(above)]
        assert re.search(rf"--screenshot[= ]{re.escape(name)}\b", blocks[-1]), name
