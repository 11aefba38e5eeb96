"""A report page: title, verdict, parts; rendered to one self-contained HTML file."""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from surgisoft import __version__
from surgisoft.errors import unknown_name
from surgisoft.files import write_atomically
from surgisoft.report.parts import Part, Section, anchor
from surgisoft.report.style import STYLE

TONES = ("plain", "good", "warn", "bad")
LEAST_CONTENTS = 3
"""Number of sections from which a page gets a table of contents."""
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""Content security policy: the page loads nothing, whatever text it contains."""


@dataclass(frozen=True)
class Page:
    """One report page."""

    title: str
    """What was examined."""
    verdict: str
    """The main result in one or two sentences, at the top of the page."""
    parts: Sequence[Part]
    """The parts of the page, in order."""
    about: str = ""
    """A line under the title: the command, the files."""
    tone: str = "plain"
    """Colour of the verdict: plain, good, warn or bad."""

    def __post_init__(self) -> None:
        if self.tone not in TONES:
            raise unknown_name("tone", self.tone, TONES)


def render(page: Page) -> str:
    """The page as one self-contained HTML document."""
    sections = [part for part in page.parts if isinstance(part, Section)]
    contents = ""
    if len(sections) >= LEAST_CONTENTS:
        links = "".join(
            f'<a href="#{anchor(section.title)}">{html.escape(section.title)}</a>'
            for section in sections
        )
        contents = f"<nav>{links}</nav>"
    about = f'<p class="about">{html.escape(page.about)}</p>' if page.about else ""
    inner = "".join(part.to_html() for part in page.parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<title>{html.escape(page.title)}</title><style>{STYLE}</style></head><body><main>"
        f'<header><h1>{html.escape(page.title)}</h1>{about}<p class="verdict {page.tone}">'
        f"{html.escape(_sentence(page.verdict))}</p>{contents}</header>{inner}"
        f"<footer>surgisoft {__version__}</footer></main></body></html>\n"
    )


def _sentence(text: str) -> str:
    """A verdict as a sentence of its own: a capital first, a full stop at its end."""
    ended = text if not text or text[-1] in ".!?:" else f"{text}."
    return ended[:1].upper() + ended[1:]


def write_page(page: Page, path: Path) -> Path:
    """Write the page to an .html file, whole or not at all; creates its folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, render(page).encode("utf-8"))
    return path
