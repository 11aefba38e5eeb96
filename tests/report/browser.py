"""A headless Chromium that counts what a page asks of the network."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

CHROMIUM = Path("/usr/bin/chromium")
LONGEST_MS = 180_000
"""Longest time that a page may take: a busy machine starts the browser's processes slowly, ms."""


@contextlib.contextmanager
def chromium() -> Iterator:
    """The browser; skips the test where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api")
    if not CHROMIUM.exists():
        pytest.skip(f"{CHROMIUM} is not here (Debian: apt install chromium)")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=str(CHROMIUM), args=["--no-sandbox", "--disable-gpu"]
        )
        try:
            yield browser
        finally:
            browser.close()


def look(browser, path: Path, width: int, scheme: str = "light", picture: Path | None = None):
    """(overflow in px, requests other than the file, broken images, text colour) of a page."""
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme, device_scale_factor=1
    )
    page = context.new_page()
    page.set_default_timeout(LONGEST_MS)
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    overflow = page.evaluate(
        "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    )
    broken = page.evaluate("[...document.images].filter(i => !i.naturalWidth).length")
    colour = page.evaluate("getComputedStyle(document.body).color")
    if picture is not None:
        page.screenshot(path=str(picture), full_page=True)
    context.close()
    foreign = [url for url in asked if not url.startswith(("data:", path.as_uri()))]
    return overflow, foreign, broken, colour
