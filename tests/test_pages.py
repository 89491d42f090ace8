"""Every page that kcal serves or writes, in a real browser: axe finds nothing, also on a telephone."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from browser import at_rest, chromium_page, needs_browser, violations

pytest.importorskip("uvicorn", reason="the extra `mark` is not installed")
from pages import PAGES

ROOT = Path(__file__).parents[1]
# Wide, and as wide as a telephone.
SIZES = ((1280, 800), (390, 844))
SHOTS = os.environ.get("KCAL_SHOTS")  # a folder for pictures of all pages, to be looked at


def faults(page: Any, name: str, sizes: tuple[tuple[int, int], ...] = SIZES) -> list[str]:
    """What is wrong at each size of the window."""
    found = []
    for width, height in sizes:
        page.set_viewport_size({"width": width, "height": height})
        at_rest(page)
        if SHOTS:
            page.screenshot(path=f"{SHOTS}/{name}-{width}.png")
        found += [f"{name} at {width} px: {text}" for text in violations(page)]
        needed = page.evaluate("document.documentElement.scrollWidth")
        found += [f"{name} at {width} px: {needed} px wide"] if needed > width else []
    return found + page.complaints


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("name", PAGES)
def test_axe_finds_nothing(name: str, tmp_path: Path) -> None:
    with PAGES[name](tmp_path) as (address, ready), chromium_page() as page:
        page.goto(address)
        page.wait_for_function(ready)
        found = faults(page, name)
    assert not found, "\n".join(found)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The documentation's site, as `make docs` does it. Broken links and anchors are warnings, which are errors."""
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("docs") / "site"
    words = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.slow
def test_the_documentation_needs_no_other_site(site: Path) -> None:
    assert "Localizer" in (site / "search" / "search_index.js").read_text(encoding="utf-8")
    pages = [path.read_text(encoding="utf-8") for path in site.rglob("*.html")]
    assert [page for page in pages if re.search(r'<(script|link|img)[^>]*(src|href)="https?:', page)] == []


@needs_browser
@pytest.mark.slow
def test_axe_finds_nothing_in_the_documentation(site: Path) -> None:
    found = []
    with chromium_page() as page:
        # A page of each kind: commands with what they print, long options, docstrings, wide tables with empty corners.
        for name in ("tutorial/guide", "reference/commands", "reference/solve", "measured/lens"):
            page.goto((site / f"{name}.html").as_uri())
            found += faults(page, name.replace("/", "-"))
    with chromium_page() as page:
        page.emulate_media(color_scheme="dark")
        page.goto((site / "tutorial/guide.html").as_uri())
        assert page.evaluate("document.body.dataset.mdColorScheme") == "slate"
        found += faults(page, "dark", SIZES[:1])
    assert not found, "\n".join(found)


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize("width", [width for width, _ in SIZES])
def test_the_tutorial_is_found_and_read(site: Path, width: int) -> None:
    with chromium_page(width, 844) as page:
        page.goto((site / "index.html").as_uri())
        if width < 1000:
            page.locator("label.md-header__button[for=__drawer]").click()
            page.locator(".md-nav__link:has-text('Tutorial'):visible").first.click()
            page.locator(".md-nav__link:has-text('From a board to a position'):visible").first.click()
        else:
            page.locator(".md-tabs__link:has-text('Tutorial')").click()
        page.wait_for_url("**/tutorial/guide.html")
        assert page.inner_text("h1").startswith("From a board to a position")
        assert page.evaluate("[...document.images].every((image) => image.complete && image.naturalWidth > 0)")
        commands = page.locator(".language-sh code").all_inner_texts()
        assert [next(c for c in commands if f"kcal {word} " in c) for word in ("detect", "calibrate", "rig", "locate")]
        # The search works from the disk, and leads to a page.
        if width < 1000:
            page.locator("label.md-header__button[for=__search]").click()
        found = {"undistort": "Undistort and rectify", "K": "From OpenCV: K", "HEIC": "Choose a board"}
        for word, title in found.items():
            page.locator(".md-search__input").fill("")
            page.locator(".md-search__input").click()
            page.keyboard.type(word)
            page.locator(".md-search-result__item").first.locator(f"text={title}").first.wait_for()
        assert page.complaints == []
