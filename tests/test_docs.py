"""The documentation's links, commands, snippets and drawn picture are those of the code."""

import ast
import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer import BadParameter, Exit

from surgisoft.cli import command_line
from surgisoft.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
UsageError = BadParameter.__base__
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]


def without_code(text: str) -> str:
    """A page's text without its blocks of code."""
    return re.sub(r"^ *```.*?^ *```", "", text, flags=re.S | re.M)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and the site make them."""
    found = re.findall(r"^#+ (.*)$", without_code(page.read_text()), re.M)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in found)
    return {text.strip().replace(" ", "-") for text in plain}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page):
    text = without_code(page.read_text())
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("http://", "https://")):
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path) if path else page
        assert place.exists(), f"{page.name} links to {target}"
        if anchor:
            assert anchor in anchors(place), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_python_blocks_are_python(page):
    for block in re.findall(r"^ *```python\n(.*?)^ *```", page.read_text(), re.S | re.M):
        ast.parse(re.sub(r"^ {3}", "", block, flags=re.M) if block.startswith("   ") else block)


@pytest.mark.parametrize("page", ["README.md", "docs/commands.md"])
def test_the_readme_and_the_list_name_every_command(page):
    text = (ROOT / page).read_text()
    for name in command_line().commands:
        assert f"`surgisoft {name}" in text, name


def test_the_readme_is_short():
    """Below 150 lines, one picture, one table: what a newcomer reads first."""
    text = without_code((ROOT / "README.md").read_text())
    assert len((ROOT / "README.md").read_text().splitlines()) < 150
    assert text.count("![") == 1
    assert len(re.findall(r"^\|[-|: ]+\|$", text, re.M)) == 1


def test_the_site_has_every_page():
    listed = set(re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text()))
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert pages <= listed


def test_the_picture_of_the_architecture_is_that_of_the_imports():
    command = [sys.executable, ROOT / "docs" / "draw_architecture.py", "--check"]
    drawn = subprocess.run(command, capture_output=True, text=True, check=False)
    assert drawn.returncode == 0, drawn.stderr


NOT_FOUND = r"no such file|there is no|is no (file|folder)"
"""Answers to a line whose files are a reader's own."""
PLACEHOLDER = re.compile(r"(?:^|[=:,/-])[A-Z]{1,}\b|\$|\.\.\.")
"""A word in the place of a value: N, MODEL, $seed; `...`: options that are not repeated."""


def shell_lines(text: str):
    """Commands of this package in a page's blocks, up to a pipe or a redirection."""
    for info, body in re.findall(r"^ *```([^\n]*)\n(.*?)^ *```", text, re.S | re.M):
        if info.partition(" ")[0] in ("", "bash"):
            for line in re.sub(r"\\\n\s*", " ", body).splitlines():
                words = shlex.split(line, comments=True) if "surgisoft " in line else []
                if words[:1] == ["surgisoft"]:
                    ends = (k for k, word in enumerate(words) if re.match(r"\d?>|[|;&]", word))
                    yield words[1 : next(ends, None)]


def unknown(words: list[str]) -> str | None:
    """Why the command line does not know a command or an option of a line."""
    command, context = command_line(), None
    try:
        while True:
            context = command.make_context(command.name, list(words), parent=context)
            if not hasattr(command, "resolve_command"):
                return None
            _, command, words = command.resolve_command(
                context, context._protected_args + context.args
            )
    except (SystemExit, Exit):  # `--version` and lists print, and end
        return None
    except InputError as error:
        return None if re.search(NOT_FOUND, str(error)) else str(error)
    except UsageError as error:
        if isinstance(error, BadParameter) and any(map(PLACEHOLDER.search, words)):
            return None
        return error.format_message()


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_lines_for_the_shell_are_commands(page):
    for words in shell_lines(page.read_text()):
        assert unknown(words) is None, (page.name, words)


def test_an_unknown_option_in_a_page_is_found():
    lines = ("surgisoft replay a.rrd --screenshot a.png | cat", "surgisoft scene new x.stl --no")
    known, wrong = shell_lines("\n".join(("```", *lines, "```\n")))
    assert known == ["replay", "a.rrd", "--screenshot", "a.png"]
    assert unknown(known) is None
    assert "No such option" in unknown(wrong)


def test_the_site_shows_blocks_as_code():
    """A fence with an option that the site does not know is set as prose."""
    pytest.importorskip("mkdocs", reason="builds the site; pip install -e '.[docs]'")
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "docs" / "site_pages.py")
    site_pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(site_pages)
    block = 'A\n\n```python needs="supersuit"\nx = 1\n```\n\n```toml title="a.toml"\n```\n'
    shown = site_pages.on_page_markdown(block)
    assert shown == block.replace(' needs="supersuit"', "")


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_no_bar_is_escaped_inside_code(page):
    """The site shows the backslash of `a\\|b` in a table."""
    assert not re.findall(r"`[^`\n]*\\\|[^`\n]*`", without_code(page.read_text()))


def test_benchmarks_that_import_others_are_called_as_modules():
    """`python benchmarks/NAME.py` puts its own folder on Python's path and not the root, so that it
    cannot import `benchmarks`."""
    called = {
        (place.relative_to(ROOT), name)
        for place in [*PAGES, *(ROOT / "benchmarks").rglob("*.py")]
        for name in re.findall(r"python benchmarks/(\w+)\.py", place.read_text())
    }
    assert len(called) > 10
    for place, name in sorted(called):
        source = (ROOT / "benchmarks" / f"{name}.py").read_text()
        assert not re.search(r"^(from|import) benchmarks\b", source, re.MULTILINE), (place, name)
