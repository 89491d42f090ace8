"""A real browser: a site is marked by script as an operator would, and the server is killed in between."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import chromium_page, names_on_a_map, needs_browser
from command_line import invoked
from marking_browser import Server, choose, click_at, look_at, settled
from ports import free_port

from kcal import load_rig, save_camera, save_rig
from kcal.io.images import write_png
from kcal.locate import read_marks
from scripts.shared.marking_scene import LANDMARKS, TARGETS, MarkingSite, marking_site

for library in ("starlette", "uvicorn"):
    pytest.importorskip(library, reason="the extra `mark` is not installed")
pytestmark = needs_browser

# Each start of the server takes seconds; `test_session.py` kills sessions at ten moments, without a browser.
KILLS = int(os.environ.get("KCAL_KILLS", "2"))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MarkingSite]:
    folder = tmp_path_factory.mktemp("site")
    scene = marking_site(seed=0)
    for side, image, camera in zip(("left", "right"), scene.images, (scene.rig.left, scene.rig.right), strict=True):
        write_png(folder / f"{side}.png", image)
        save_camera(camera, folder / f"{side}.camera.json")
    save_rig(scene.rig, folder / "true-rig.json")
    (folder / "survey.csv").write_text(scene.survey(0.02, np.random.default_rng(1)))
    return folder, scene


def mark_both(page: Any, scene: MarkingSite, name: str, random: np.random.Generator) -> None:
    """Click within 2 px in the left image; accept the proposal in the right one, or click there too."""
    left, right = scene.pixels[name]
    # A rig that came later would ask for a proposal again, and its answer moves the right view.
    settled(page)
    choose(page, name)
    for side, at in (("left", left), ("right", right)):
        look_at(page, side, float(at[0]), float(at[1]), 6.0)
    page.evaluate("delete document.documentElement.dataset.proposal")
    click_at(page, "left", *(left + random.uniform(-2, 2, 2)))
    page.wait_for_function("() => kcal.item() && kcal.item().left")
    # Without a rig there is no proposal; with one, it is there or refused.
    if page.evaluate("kcal.rig.known"):
        page.wait_for_function("() => document.documentElement.dataset.proposal")
    found = page.evaluate("kcal.proposals.right && !kcal.proposals.right.refusal ? kcal.proposals.right : null")
    if found is not None and math.hypot(found["u"] - right[0], found["v"] - right[1]) < 1:
        page.keyboard.press("Enter")
    else:
        page.keyboard.press("r")
        click_at(page, "right", *(right + random.uniform(-2, 2, 2)))
    page.wait_for_function("() => kcal.item().right")


@pytest.mark.slow
def test_a_whole_site_while_the_server_is_killed(site: tuple[Path, MarkingSite], tmp_path: Path) -> None:
    folder, scene = site
    arguments = [str(folder / f"{side}.png") for side in ("left", "right")]
    arguments += ["--cameras", *(str(folder / f"{side}.camera.json") for side in ("left", "right"))]
    arguments += ["--landmarks", str(folder / "survey.csv"), "-o", str(tmp_path / "marks.csv")]
    random, port = np.random.default_rng(2), free_port()
    names = [point.name for point in (*LANDMARKS[:8], *TARGETS[:2])]
    # Each at another moment of its thing: right after a click was made, or after all was answered.
    kills = dict(zip(random.choice(len(names), KILLS, replace=False).tolist(), range(KILLS), strict=True))
    server = Server(arguments, port, tmp_path)
    try:
        with chromium_page() as page:
            page.goto(server.address)
            settled(page)
            for number, name in enumerate(names):
                if name in {target.name for target in TARGETS}:
                    # Others may still be on their way to the server: a new target is selected all the same.
                    page.evaluate("kcal.nudge(0.1, 0), kcal.nudge(-0.1, 0)")
                    page.keyboard.press("n")
                    page.keyboard.type(name)
                    page.keyboard.press("Enter")
                    page.wait_for_function("name => kcal.selected === name", arg=name)
                mark_both(page, scene, name, random)
                if number in kills:
                    before = page.evaluate("kcal.items.filter(i => i.left).length")
                    if kills[number] % 2:
                        # Not yet answered: the page keeps it and sends it to the next server.
                        server.process.send_signal(19)
                        page.evaluate("kcal.nudge(0.1, 0)")
                        page.evaluate("kcal.nudge(-0.1, 0)")
                    server.kill()
                    server = Server(arguments, port, tmp_path)
                    page.goto("about:blank")
                    page.goto(server.address)
                    settled(page)
                    assert page.evaluate("kcal.items.filter(i => i.left).length") == before == number + 1
            settled(page)
            solved = page.evaluate("kcal.rig")
            things = page.evaluate("kcal.items")
            page.screenshot(path=str(tmp_path / "page.png"))
            names, dots, covered = names_on_a_map(page)
            complaints = page.complaints
    finally:
        server.stop()
    assert complaints == []
    assert covered == []
    assert (dots, names >= 6) == (2 + len(LANDMARKS) + 2, True)
    assert solved["solved"]
    assert len(solved["promises"]) == 3
    assert [item["name"] for item in things if item["residual"] and not item["residual"]["used"]] == []
    ranges = {item["name"]: item["position"] for item in things if item["kind"] == "target"}
    for target in TARGETS[:2]:
        # Left camera at the origin: the range is the length of the point.
        found = ranges[target.name]
        true = float(torch.linalg.vector_norm(scene.points[target.name]))
        assert found["low"] - 0.02 * true < true < found["high"] + 0.02 * true

    # What `kcal rig` and `kcal locate` make of the files is what the page said.
    output = tmp_path / "rig.json"
    marks = read_marks(tmp_path / "marks.csv")
    errors = [np.abs(marks.pixels[i].numpy() - np.stack(scene.pixels[name])) for i, name in enumerate(marks.names)]
    assert np.max(errors) < 0.6
    cameras = (folder / f"{side}.camera.json" for side in ("left", "right"))
    files = ["--landmarks", tmp_path / "marks.landmarks.csv", "--marks", tmp_path / "marks.csv"]
    invoked("rig", *cameras, *files, "--site", "40,-113,1280", "--pixel-sigma", solved["sigma"], "-o", output)
    assert float(load_rig(output).baseline) == pytest.approx(float(scene.rig.baseline), abs=0.1)
    assert "the noise that the CSV states" in invoked(
        "locate", output, tmp_path / "marks.points.csv", "--refraction", "0"
    )
