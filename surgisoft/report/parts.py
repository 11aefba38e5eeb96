"""The parts of a page: text, facts, tables, pictures, sections. All texts are escaped."""

import base64
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from surgisoft.errors import InputError

KINDS = {".png": "image/png", ".svg": "image/svg+xml", ".jpg": "image/jpeg"}
"""Picture files that can be embedded, by suffix."""
LONG_CELL = 24
"""Cells with more letters than this are wrapped, in a column of at least 18 em."""


class Part(Protocol):
    """The interface of everything that a page can hold."""

    def to_html(self) -> str:
        """The part as HTML; all texts in it are escaped."""


@dataclass(frozen=True)
class Text:
    """Paragraphs."""

    body: str
    """Plain text; an empty line starts a new paragraph, `backquotes` set code."""

    def to_html(self) -> str:
        paragraphs = (part.strip() for part in self.body.split("\n\n"))
        return "".join(f"<p>{_with_code(part)}</p>" for part in paragraphs if part)


@dataclass(frozen=True)
class Command:
    """Lines to type or to paste, set as code."""

    lines: str
    """The lines as they are typed."""

    def to_html(self) -> str:
        return f"<pre><code>{html.escape(self.lines)}</code></pre>"


@dataclass(frozen=True)
class Facts:
    """A few values in large type side by side."""

    items: Sequence[tuple[str, str]]
    """Name and value, the value with its unit."""

    def to_html(self) -> str:
        items = "".join(
            f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
            for name, value in self.items
        )
        return f'<dl class="facts">{items}</dl>'


@dataclass(frozen=True)
class Share:
    """A share between 0 and 1: a bar with its percentage, as the cell of a table."""

    value: float
    """The share; the bar is clipped to 0 and 1, the number is not."""

    def to_html(self) -> str:
        width = 100 * min(max(self.value, 0.0), 1.0)
        bar = f'<span class="bar"><i style="width:{width:.1f}%"></i></span>'
        return f"{bar}<span>{100 * self.value:.0f} %</span>"


@dataclass(frozen=True)
class Table:
    """A table; on a narrow screen it scrolls inside its own frame."""

    header: Sequence[str]
    """Names of the columns, with units."""
    rows: Sequence[Sequence[str | Share]]
    """Cells; a column whose cells all start with a number is aligned right."""
    title: str = ""
    """Heading above the table."""

    def __post_init__(self) -> None:
        for number, row in enumerate(self.rows):
            if len(row) != len(self.header):
                raise InputError(
                    f"table '{self.title}': row {number} has {len(row)} cells, "
                    f"expected {len(self.header)} as in the header"
                )

    def to_html(self) -> str:
        numeric = [_is_numeric([row[k] for row in self.rows]) for k in range(len(self.header))]
        head = "".join(
            f"<th{_flush(right)}>{html.escape(name)}</th>"
            for name, right in zip(self.header, numeric, strict=True)
        )
        body = "".join(
            "<tr>"
            + "".join(_cell(cell, right) for cell, right in zip(row, numeric, strict=True))
            + "</tr>"
            for row in self.rows
        )
        caption = f"<h3>{html.escape(self.title)}</h3>" if self.title else ""
        return (
            f'{caption}<div class="wide" tabindex="0"><table><thead><tr>{head}</tr></thead>'
            f"<tbody>{body}</tbody></table></div>"
        )


def _with_code(text: str) -> str:
    """Escaped text with what stands in backquotes as code."""
    return re.sub("`([^`\n]+)`", r"<code>\1</code>", html.escape(text))


def _flush(right: bool) -> str:
    return ' class="number"' if right else ""


def _cell(cell: str | Share, right: bool) -> str:
    if isinstance(cell, Share):
        return f'<td class="share">{cell.to_html()}</td>'
    attribute = _flush(right) or (' class="long"' if len(cell) > LONG_CELL else "")
    return f"<td{attribute}>{html.escape(cell)}</td>"


def _is_numeric(cells: Sequence[str | Share]) -> bool:
    known = [cell for cell in cells if not isinstance(cell, str) or cell not in ("", "-", "...")]
    return bool(known) and all(
        isinstance(cell, str) and cell.lstrip("+-−").lstrip("<").strip()[:1].isdigit()
        for cell in known
    )


@dataclass(frozen=True)
class Picture:
    """A picture inside the page."""

    data: bytes
    """The encoded picture."""
    alt: str
    """Alternative text: what the picture shows."""
    caption: str = ""
    """A line below it."""
    kind: str = "image/png"
    """MIME type of `data`."""
    least_px: int = 0
    """Smallest width in pixels; on a narrower page the picture scrolls in its own frame."""
    drawn: bool = False
    """Dark lines on white paper: a dark page shows the picture inverted, hues kept. Not for a
    picture with a colour scale, whose largest values would become the darkest."""

    @classmethod
    def from_file(
        cls, path: Path, alt: str, caption: str = "", least_px: int = 0, *, drawn: bool = False
    ) -> "Picture":
        """Read a picture file; its suffix gives the type."""
        kind = KINDS.get(path.suffix.lower())
        if kind is None:
            raise InputError(f"{path}: suffix '{path.suffix}', expected one of {', '.join(KINDS)}")
        return cls(path.read_bytes(), alt, caption, kind, least_px, drawn)

    def to_html(self) -> str:
        data = base64.b64encode(self.data).decode("ascii")
        caption = f"<figcaption>{html.escape(self.caption)}</figcaption>" if self.caption else ""
        framed = ""
        if self.kind != "image/svg+xml":
            framed = ' class="photo drawn"' if self.drawn else ' class="photo"'
        source = f"data:{self.kind};base64,{data}"
        least = f' style="min-width:{self.least_px}px"' if self.least_px else ""
        image = f'<img{framed}{least} alt="{html.escape(self.alt)}" src="{source}">'
        return f'<figure><div class="wide">{image}</div>{caption}</figure>'


@dataclass(frozen=True)
class Gallery:
    """Pictures side by side, or below each other on a narrow page."""

    pictures: Sequence[Picture]
    """The pictures, in order."""

    def to_html(self) -> str:
        inner = "".join(picture.to_html() for picture in self.pictures)
        return f'<div class="gallery">{inner}</div>'


@dataclass(frozen=True)
class Section:
    """A part of the page with a title, listed in the table of contents."""

    title: str
    """Heading."""
    parts: Sequence[Part]
    """The parts of the section, in order."""

    def to_html(self) -> str:
        inner = "".join(part.to_html() for part in self.parts)
        title = html.escape(self.title)
        return f'<section id="{anchor(self.title)}"><h2>{title}</h2>{inner}</section>'


def anchor(title: str) -> str:
    """The HTML id of a section, for links from the table of contents."""
    return "-".join("".join(c if c.isalnum() else " " for c in title.lower()).split())
