"""One Chromium for all tests of a process, and axe, which finds what a page keeps from some of its readers."""

import atexit
import functools
import importlib.util
import itertools
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from waiting import PATIENCE

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
_HERE = CHROMIUM is not None and importlib.util.find_spec("playwright") is not None
needs_browser = pytest.mark.skipif(
    not _HERE, reason="no page was opened: Chromium (Debian: apt-get install chromium) or the extra `dev` is missing"
)


@functools.cache
def _endpoint() -> str:
    """The address of a Chromium that runs until the process ends."""
    assert CHROMIUM is not None
    profile = tempfile.mkdtemp(prefix="kcal-browser-")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", f"--user-data-dir={profile}"]
    process = subprocess.Popen([CHROMIUM, *options, "about:blank"], stderr=subprocess.PIPE, text=True)

    def end() -> None:
        process.kill()
        process.wait()
        shutil.rmtree(profile, ignore_errors=True)

    atexit.register(end)
    assert process.stderr is not None
    said = []
    for line in process.stderr:
        said.append(line)
        if line.startswith("DevTools listening on "):
            return line.split()[-1]
    raise AssertionError(f"Chromium did not start: {''.join(said)[-2000:]}")


@contextmanager
def chromium_page(width: int = 1366, height: int = 768) -> Iterator[Any]:
    """A page of headless Chromium; what is wrong with it is collected in `page.complaints`.

    These are errors of scripts, messages of the content policy, and requests that leave this machine.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        context = playwright.chromium.connect_over_cdp(_endpoint(), timeout=1e3 * PATIENCE).new_context(
            viewport={"width": width, "height": height}
        )
        context.set_default_timeout(1e3 * PATIENCE)
        page: Any = context.new_page()
        page.complaints = []
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("console", lambda m: page.complaints.append(m.text) if "Content Security" in m.text else None)
        page.on("request", lambda request: None if _is_local(request.url) else page.complaints.append(request.url))
        try:
            yield page
        finally:
            context.close()


def _is_local(url: str) -> bool:
    return url.startswith(("http://127.0.0.1", "file:", "data:", "blob:"))


def at_rest(page: Any) -> None:
    """Wait until the page is drawn as it stands now, and nothing in it moves."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.wait_for_function("() => document.getAnimations().every((each) => each.playState !== 'running')")


def names_on_a_map(page: Any) -> tuple[int, int, list[Any]]:
    """How many names and dots a map shows, and pairs of a name and what it covers: a name, a dot or a control."""
    names, dots, controls = page.evaluate(
        "() => ['.leaflet-tooltip', '#map path[aria-label]', '.leaflet-control'].map((kind) =>"
        " [...document.querySelectorAll(kind)].filter((e) => getComputedStyle(e).visibility === 'visible')"
        " .map((e) => e.getBoundingClientRect()).map((b) => [b.left, b.top, b.right, b.bottom]))"
    )
    covered = [
        (a, b)
        for a, b in [*itertools.combinations(names, 2), *itertools.product(names, [*dots, *controls])]
        if min(a[2], b[2]) - max(a[0], b[0]) > 0.5 and min(a[3], b[3]) - max(a[1], b[1]) > 0.5
    ]
    return len(names), len(dots), covered


def violations(page: Any) -> list[str]:
    """What axe finds on the page as it stands: the rule, the element, and what is wrong, one line each."""
    from axe_playwright_python.sync_playwright import Axe

    return [
        f"{rule['id']} ({rule['impact']}): {node['html'][:120]}: {' '.join(node['failureSummary'].split())[:200]}"
        for rule in Axe().run(page).response["violations"]
        for node in rule["nodes"]
    ]
