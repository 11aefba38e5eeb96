"""Reports: one self-contained HTML file that says its verdict first.

    page = Page("Arm 7 on test", "error 0.61 mm, floor 0.09 mm", parts=[Table(...), Text(...)])
    write_page(page, Path("report.html"))

No network, no script; pictures lie inside the file. Charts follow the reader's light or dark theme.
"""

from surgisoft.report.page import Page, render, write_page
from surgisoft.report.parts import (
    Command,
    Facts,
    Gallery,
    Part,
    Picture,
    Section,
    Share,
    Table,
    Text,
)

__all__ = [
    "Command",
    "Facts",
    "Gallery",
    "Page",
    "Part",
    "Picture",
    "Section",
    "Share",
    "Table",
    "Text",
    "render",
    "write_page",
]
