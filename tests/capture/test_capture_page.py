"""The capture page in a real browser: it shows what was kept, and asks nothing beyond this machine."""

from pathlib import Path

import pytest
from browser import chromium_page, needs_browser
from capture_frames import BOARD, images
from marking_browser import Server
from waiting import PATIENCE

from kcal.corners.observations import Observations
from kcal.io.images import write_png

for library in ("starlette", "uvicorn"):
    pytest.importorskip(library, reason="the extra `mark` is not installed")
pytestmark = needs_browser


@pytest.mark.slow
def test_frames_are_shown_and_the_page_ends_it(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for i, image in enumerate(images()[:2]):
        write_png(folder / f"{i}.png", image)
    output = tmp_path / "x.obs.json"
    board = f"{BOARD.columns}x{BOARD.rows}"
    server = Server(
        [str(folder), "--board", board, "--square", "20mm", "-o", str(output)], 0, tmp_path, program="capture"
    )
    with chromium_page() as page:
        page.goto(server.address)
        page.wait_for_function("() => document.documentElement.dataset.views === '2'")
        # The first proposal comes from a thread of its own.
        words = "document.getElementById('words').innerText"
        page.wait_for_function(f"() => {words}.includes('Match the orange outline')")
        assert page.evaluate("document.querySelectorAll('#where polygon').length") == 3
        # The frame is on the canvas: it is not of one color.
        colors = page.evaluate(
            "() => { const c = document.getElementById('view'); const d = c.getContext('2d')"
            ".getImageData(0, 0, c.width, c.height).data; return new Set(d).size; }"
        )
        assert colors > 20
        page.screenshot(path=str(tmp_path / "page.png"))
        page.click("#stop")
        server.process.wait(timeout=PATIENCE)
        assert page.complaints == []
    assert server.process.returncode == 0
    assert len(Observations.load(output).views) == 2
