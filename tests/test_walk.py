"""As a user goes: a site is marked by clicks, and targets are watched while `kcal live` runs."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from browser import chromium_page, needs_browser
from command_line import rows_of
from track_scenes import ORIGIN, seen_by, tracked_site
from waiting import PATIENCE

pytest.importorskip("uvicorn", reason="the extra `mark` is not installed")
from marking_browser import click_at, on_screen, settled
from pages import desk_of, served

from kcal.io.rig_file import save_rig
from kcal.lens.rig import Mounting
from kcal.mark.server import marking_app

pytestmark = needs_browser


def zoom_and_click(page: Any, side: str, place: Any) -> None:
    """Zoom in on a pixel with the mouse's wheel, and click it."""
    for _ in range(8):
        page.mouse.move(*on_screen(page, side, *place))
        before = page.evaluate("side => kcal.views[side].scale", side)
        page.mouse.wheel(0, -240)
        page.wait_for_function("([side, before]) => kcal.views[side].scale > before", arg=[side, before])
    click_at(page, side, *place)


@pytest.mark.slow
def test_a_site_is_marked_by_clicks(tmp_path: Path) -> None:
    with (
        desk_of(tmp_path) as (desk, site),
        served(lambda token, hosts: marking_app(desk, token, hosts)) as address,
        chromium_page(1280, 800) as page,
    ):
        page.goto(address)
        settled(page)
        for name in ("post 1", "post 5"):
            page.get_by_role("cell", name=name, exact=False).first.click()
            for side, place in zip(("left", "right"), site.pixels[name], strict=True):
                zoom_and_click(page, side, place)
                page.wait_for_function("side => kcal.item() && kcal.item()[side]", arg=side)
                page.get_by_role("button", name="Fit").click()
        page.get_by_role("button", name="New target").click()
        page.get_by_role("dialog").get_by_label("Name").fill("gate")
        page.get_by_role("button", name="Add").click()
        page.wait_for_function("() => kcal.selected === 'gate'")
        for side, place in zip(("left", "right"), site.pixels["gate"], strict=True):
            zoom_and_click(page, side, place)
            page.wait_for_function("side => kcal.item()[side]", arg=side)
            page.get_by_role("button", name="Fit").click()
        settled(page)
        assert page.complaints == []
        # What was clicked is what is on the disk.
        files = tmp_path / "marks.csv", tmp_path / "marks.points.csv"
        marks, points = ({row["name"]: row for row in rows_of(path)} for path in files)
        assert (set(marks), set(points)) == ({"post 1", "post 5"}, {"gate"})
        for name, row in (*marks.items(), *points.items()):
            for side, place in zip(("left", "right"), site.pixels[name], strict=True):
                clicked = [float(row[f"{side}_{axis}"]) for axis in ("u", "v")]
                assert clicked == pytest.approx(place, abs=0.6), (name, side)
        page.get_by_role("button", name="Undo").click()
        page.wait_for_function("() => !kcal.item().right")
        assert rows_of(files[1]) == []
        # The page knows all of it when it is opened again.
        page.reload()
        settled(page)
        assert page.evaluate("kcal.items.filter((item) => item.left).length") == 3


@contextmanager
def live_on(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """`kcal live` on the standard input, with a map."""
    rig = tracked_site().rig
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=0.0)
    save_rig(rig, folder / "rig.json")
    words = ["live", "rig.json", "--detections", "-", "-o", "tracks.csv", "--port", "0"]
    process = subprocess.Popen(
        [sys.executable, "-m", "kcal", *words], cwd=folder, text=True, stdin=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "200"},
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_targets_are_watched_until_the_stream_ends(tmp_path: Path) -> None:
    site, generator = tracked_site(), torch.Generator().manual_seed(0)
    start = torch.tensor([[-30.0, 5.0, 150.0], [20.0, -10.0, 200.0]]).double()
    velocity = torch.tensor([[8.0, 4.0, 0.0], [-5.0, 3.0, 2.0]]).double()
    with live_on(tmp_path) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        address = None
        while address is None:
            line = process.stderr.readline()
            assert line, "kcal live ended"
            address = re.search(r"http://127\.0\.0\.1:\d+/#\S+", line)
        with chromium_page(1280, 800) as page:
            page.goto(address.group())
            page.wait_for_function("() => document.getElementById('status').textContent === 'running'")
            page.wait_for_function("() => document.querySelectorAll('.leaflet-tooltip').length === 2")
            assert page.locator(".leaflet-tooltip").all_inner_texts() == ["left camera", "right camera"]
            for frame in range(20):
                left, right = seen_by(site.rig, start + frame / 10.0 * velocity, 0.2, generator)
                moment = {"time": 1.7e9 + frame / 10, "left": left.tolist(), "right": right.tolist(), "sigma": 0.2}
                print(json.dumps(moment), file=process.stdin, flush=True)
                if frame == 9:
                    # They are there while more are to come.
                    page.wait_for_function("() => document.documentElement.dataset.sequence === '10'")
                    assert page.inner_text("#count") == "2 targets"
                    assert page.inner_text("#clock") == "2023-11-14 22:13:20 UTC"
                    assert page.inner_text("#status") == "running"
                    shown = page.locator(".leaflet-tooltip").all_inner_texts()
            process.stdin.close()
            page.wait_for_function("() => document.getElementById('status').textContent === 'finished'")
            assert page.inner_text("#count") == "2 targets"
            assert page.inner_text("#clock") == "2023-11-14 22:13:21 UTC"
            assert page.complaints == []
        assert process.wait(timeout=PATIENCE) == 0
    assert [text.split(",")[0] for text in shown] == ["left camera", "right camera", "track 1", "track 2"]
    rows = rows_of(tmp_path / "tracks.csv")
    assert (rows[-1]["sequence"], {row["name"] for row in rows}) == ("20", {"track 1", "track 2"})
