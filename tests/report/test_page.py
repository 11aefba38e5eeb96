"""Pages stand alone, escape what they are told, and fit a telephone."""

import io
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from surgisoft.errors import InputError
from surgisoft.report import (
    Command,
    Facts,
    Gallery,
    Page,
    Picture,
    Section,
    Share,
    Table,
    Text,
    render,
    write_page,
)
from surgisoft.report.charts import drawing
from tests.report.browser import chromium, look

HOSTILE = '<script src="https://example.org/x.js"></script><img src=https://example.org/y.png>'


def example() -> Page:
    from matplotlib import pyplot as plt

    from surgisoft.report.charts import CHART, RED, chart

    pictures = []
    with drawing():
        for name in ("dwell", "rate", "pressure"):
            figure, axis = plt.subplots(figsize=CHART)
            x = np.linspace(0, 10, 60)
            axis.plot(x, np.sin(x), c=RED)
            axis.set_xlabel(f"{name} [s]")
            axis.set_title(f"error over {name}")
            pictures.append(chart(figure, f"error over {name}", f"{name} and the error"))
    rows = [
        (f"a_rather_long_name_of_an_axis_{i}", Share(i / 8), f"{i * 0.1:.2f}") for i in range(8)
    ]
    wide = Table([f"column number {k}" for k in range(14)], [["0.123456"] * 14] * 2, "Wide")
    return Page(
        "Arm seven on a recording_with_a_name_that_never_ends_" + "x" * 60,
        "Error 0.61 mm, floor 0.09 mm: 96 % of the excess is explainable.",
        [
            Facts([("error", "0.61 mm"), ("floor", "0.09 mm"), ("rows", "12000")]),
            Section("Where it shows", [Table(["axis", "share", "mm"], rows, "Axes"), wide]),
            Section("Charts", [Gallery(pictures)]),
            Section("Words", [Text(HOSTILE + "\n\nsecond paragraph")]),
        ],
        about="surgisoft compare arm test.parquet",
        tone="warn",
    )


class Tags(HTMLParser):
    """Every tag with its attributes, and whether tags close in order."""

    VOID = ("meta", "link", "img", "br")

    def __init__(self):
        super().__init__()
        self.seen, self.stack = [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag


def test_foreign_text_is_escaped_and_nothing_is_referred_to():
    tags = Tags()
    tags.feed(render(example()))
    assert tags.stack == []
    assert not any(tag == "script" for tag, _ in tags.seen)
    for _, attributes in tags.seen:
        for name in ("src", "href"):
            assert attributes.get(name, "#").startswith(("data:", "#"))
    links = [a["href"][1:] for tag, a in tags.seen if tag == "a"]
    assert links == [a["id"] for tag, a in tags.seen if tag == "section"] != []


FOREIGN = 'a<b>&"c'
"""Text as a file name or a note may have it."""


@pytest.mark.parametrize(
    "part",
    [
        Text(FOREIGN),
        Text(f"`{FOREIGN}`"),
        Command(FOREIGN),
        Facts([(FOREIGN, "1")]),
        Facts([("name", FOREIGN)]),
        Table([FOREIGN], [["1"]]),
        Table(["name"], [[FOREIGN]]),
        Table(["name"], [["1"]], FOREIGN),
        Picture(b"1", FOREIGN),
        Picture(b"1", "alt", FOREIGN),
        Section(FOREIGN, []),
    ],
)
def test_every_text_of_every_part_is_escaped(part):
    """No tag of its own, no end of an attribute; a browser shows it as it was given."""
    text, tags = [], []
    parser = HTMLParser(convert_charrefs=True)
    parser.handle_data = text.append
    parser.handle_starttag = lambda tag, values: tags.append((tag, dict(values)))
    parser.feed(part.to_html())
    parser.close()
    alternative = [values["alt"] for _, values in tags if values.get("alt")]
    assert FOREIGN in ["".join(text), *text, *alternative] or FOREIGN in "".join(text)
    assert "b" not in [tag for tag, _ in tags]
    assert all("c" not in values and 'c"' not in values for _, values in tags)


@pytest.mark.parametrize(
    ("value", "width", "said"), [(1.25, "100.0", "125 %"), (-0.1, "0.0", "-10 %")]
)
def test_the_bar_of_a_share_ends_at_none_and_all(value, width, said):
    shown = Share(value).to_html()
    assert f"width:{width}%" in shown
    assert f">{said}<" in shown


def test_verdict_comes_before_everything_else():
    text = render(example())
    assert text.index("96 % of the excess") < text.index("<dl") < text.index("<section")


def test_columns_of_numbers_are_flush_right():
    text = Table(["name", "value"], [("a", "-1.5"), ("b", "-"), ("c", "2 mm")]).to_html()
    assert text.count('<td class="number">') == 3


def test_uneven_tables_and_unknown_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="row 1 has 1 cells, expected 2"):
        Table(["a", "b"], [("1", "2"), ("3",)])
    with pytest.raises(InputError, match=r"expected one of \.png"):
        Picture.from_file(tmp_path / "x.bmp", "x")
    with pytest.raises(InputError, match="unknown tone 'loud'"):
        Page("a", "b", [], tone="loud")


def test_the_same_page_is_the_same_file(tmp_path):
    """No date, no random ids: reports can be compared as files."""
    first = write_page(example(), tmp_path / "deep" / "a.html").read_bytes()
    assert first == write_page(example(), tmp_path / "b.html").read_bytes()
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.html"]


def test_page_in_a_browser(tmp_path):
    """At desk and telephone width, light and dark: no overflow, no request, whole pictures."""
    path = write_page(example(), tmp_path / "report.html")
    with chromium() as browser:
        colours = set()
        for width, scheme in ((1280, "light"), (400, "dark")):
            overflow, asked, broken, colour = look(browser, path, width, scheme)
            assert overflow <= 0, width
            assert asked == []
            assert broken == 0
            colours.add(colour)
        assert len(colours) == 2


def test_a_narrow_page_wraps_commands_and_marks_what_goes_on(tmp_path):
    """A table that is wider than a telephone has a shadow on the side that it can scroll to."""
    table = Table([f"column {n}" for n in range(12)], [[f"value {n}" for n in range(12)]])
    command = Command("surgisoft amend default --effect creep --data monday.parquet -o amended")
    path = write_page(Page("a", "b", [Section("One", [command, table])]), tmp_path / "a.html")
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 400, "height": 900})
        page.goto(path.as_uri())
        assert page.evaluate("(e => e.scrollWidth <= e.clientWidth)(document.querySelector('pre'))")
        box = page.locator(".wide").bounding_box()

        def edges():
            """Darkest pixels of the columns left and right of the table's last line."""
            found = []
            for x in (box["x"], box["x"] + box["width"] - 1):
                at = {"x": x, "y": box["y"] + 4, "width": 1, "height": 4}
                shown = Image.open(io.BytesIO(page.screenshot(clip=at))).convert("L")
                found.append(int(np.asarray(shown).min()))
            return found

        left, right = edges()
        assert (left, right < 230) == (255, True)
        page.evaluate("document.querySelector('.wide').scrollLeft = 10000")
        left, right = edges()
        assert (left < 230, right) == (True, 255)
