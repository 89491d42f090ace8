"""How fast `kcal mark` is with a pair of 24 megapixels, in Chromium: first picture, dragging, memory.

    python -m scripts.check.marking_speed            needs the extra `mark`, playwright and Chromium

Seconds of the processor are given beside those of the clock: on a busy machine only the former say anything.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from playwright.sync_api import sync_playwright

from kcal.io.images import write_png
from kcal.io.rig_file import save_rig
from scripts.shared.children import marking_server
from scripts.shared.marking_scene import background, finished, site_rig
from scripts.shared.page import peak_megabytes

SIZE = 6000, 4000
_DRAWN = "s => [...kcal.views[s].tiles.kept.values()].some(t => t.canvas)"
_DRAG = """async ([u, v]) => {
  const view = kcal.views.left, box = view.canvas.getBoundingClientRect();
  const send = (kind, x, y) => view.canvas.dispatchEvent(new PointerEvent(kind,
    {clientX: box.left + x, clientY: box.top + y, buttons: 1, button: 0, pointerId: 1, bubbles: true}));
  view.canvas.setPointerCapture = () => {};
  const [x0, y0] = view.screen(u, v), start = performance.now();
  let frames = 0;
  send('pointerdown', x0, y0);
  while (performance.now() - start < 3000) {
    const angle = (performance.now() - start) / 300;
    send('pointermove', x0 + 40 * Math.cos(angle), y0 + 40 * Math.sin(angle));
    await new Promise(requestAnimationFrame);
    frames += 1;
  }
  const seconds = (performance.now() - start) / 1000;
  send('pointerup', x0, y0);
  return [frames, seconds];
}"""


def processor(process: int | None = None) -> float:
    """Seconds of the processor that a process has used, or the pages' renderers of Chromium."""
    total = 0.0
    for one in psutil.process_iter() if process is None else [psutil.Process(process)]:
        with contextlib.suppress(psutil.Error):  # it has just ended
            if process is not None or {"--type=renderer", "--type=gpu-process"} & {*one.cmdline()}:
                total += sum(one.cpu_times()[:2])
    return total


def dragged(page: Any, what: str, at: tuple[float, float]) -> None:
    """Print frames a second while dragging, and seconds of the processor per frame."""
    before = processor()
    frames, seconds = page.evaluate(_DRAG, list(at))
    each = (processor() - before) / frames
    print(f"{what}: {frames / seconds:.0f} frames a second; processor {1000 * each:.1f} ms a frame")


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = site_rig(*SIZE)
        for side, word in enumerate(("left", "right")):
            light = background(rig, side, np.random.default_rng(0))
            write_png(folder / f"{word}.png", finished(light, 1.5, np.random.default_rng(side)))
        save_rig(rig, folder / "rig.json")
        start = time.perf_counter()
        with marking_server(folder, "--rig", "rig.json", "-o", "m.csv") as (address, server):
            print(
                f"command to address: {time.perf_counter() - start:.1f} s, processor {processor(server):.1f} s; "
                f"server at most {peak_megabytes(server):.0f} MB"
            )
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
                page = browser.new_page(viewport={"width": 1366, "height": 768})
                before = processor(server) + processor()
                page.goto(address, wait_until="commit")
                page.wait_for_function(f"() => window.kcal && ['left', 'right'].every({_DRAWN})")
                spent = processor(server) + processor() - before
                clock = page.evaluate("performance.now()") / 1000
                print(f"address to both pictures: {clock:.2f} s, processor {spent:.2f} s")
                page.wait_for_timeout(1000)
                dragged(page, "panning the whole image", (100, 100))
                page.evaluate("kcal.views.left.look(3000, 2000, 1); kcal.views.right.look(3000, 2000, 1)")
                page.wait_for_timeout(2000)
                dragged(page, "panning at 1:1", (2900, 1950))
                page.keyboard.press("n")
                page.keyboard.press("Enter")
                page.wait_for_function("() => kcal.item()")
                page.evaluate(
                    "kcal.place('left', 3000, 2000, false).then(() => kcal.place('right', 2900, 2000, false))"
                )
                page.wait_for_function("() => kcal.item().right")
                page.evaluate("kcal.views.left.look(3000, 2000, 10)")
                page.wait_for_timeout(2000)
                dragged(page, "dragging a mark at 10x, with curve and range", (3000, 2000))
                heap = page.evaluate("performance.memory.usedJSHeapSize / 1e6")
                print(f"server at most {peak_megabytes(server):.0f} MB; heap of the page {heap:.0f} MB")
                browser.close()


if __name__ == "__main__":
    main()
