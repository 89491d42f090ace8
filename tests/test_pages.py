"""Every page that kcal serves or writes, in a real browser: axe finds nothing, and nothing is wider than a telephone."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from browser import chromium_page, needs_browser, violations

pytest.importorskip("uvicorn", reason="the extra `mark` is not installed")
from pages import PAGES, build_site

pytestmark = needs_browser
# Wide, and as wide as a telephone.
SIZES = ((1280, 800), (390, 844))
SHOTS = os.environ.get("KCAL_SHOTS")  # a folder for pictures of all pages, to be looked at


def faults(page: Any, name: str) -> list[str]:
    """What is wrong at each size of the window."""
    found = []
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(300)
        if SHOTS:
            page.screenshot(path=f"{SHOTS}/{name}-{width}.png")
        found += [f"{name} at {width} px: {text}" for text in violations(page)]
        needed = page.evaluate("document.documentElement.scrollWidth")
        found += [f"{name} at {width} px: {needed} px wide"] if needed > width else []
    return found + page.complaints


@pytest.mark.parametrize("name", PAGES)
def test_axe_finds_nothing(name: str, tmp_path: Path) -> None:
    with PAGES[name](tmp_path) as (address, ready), chromium_page() as page:
        page.goto(address)
        page.wait_for_function(ready, timeout=60_000)
        found = faults(page, name)
    assert not found, "\n".join(found)


def test_axe_finds_nothing_in_the_documentation(tmp_path: Path) -> None:
    site = build_site(tmp_path / "site")
    with chromium_page() as page:
        found = []
        for name in ("index", "tutorial/guide", "reference/lens", "measured/one-camera"):
            page.goto((site / f"{name}.html").as_uri())
            found += faults(page, name.replace("/", "-"))
    assert not found, "\n".join(found)
