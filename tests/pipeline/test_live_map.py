"""The live map: told to this machine's pages only, newest first, and drawn by a real browser if there is one."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Iterator
from urllib.parse import urlsplit

import orjson
import pytest
import torch
from marking_browser import CHROMIUM
from track_scenes import pairs_of, tracked_site

pytest.importorskip("uvicorn")
from kcal.locate.positions import located_by
from kcal.locate.tabulate import Locator
from kcal.pipeline.live_map import LiveMap
from kcal.pipeline.track_columns import track_columns
from kcal.pipeline.tracks import Tracker, TrackOptions

SITE = tracked_site()


@pytest.fixture
def page() -> Iterator[LiveMap]:
    live = LiveMap(located_by(Locator(SITE.rig, origin=SITE.origin, heading_deg=0.0)), 0)
    yield live
    live.close()


def show(page: LiveMap, category: str = "car") -> None:
    tracker = Tracker(SITE, TrackOptions(confirm_hits=1))
    left, right, _ = SITE.rig(torch.tensor([[0.0, 0.0, 500.0], [30.0, 0.0, 90_000.0]]).double())
    columns = track_columns(tracker(pairs_of(left, right, 1.0)), 1)
    columns.extras["category"][0] = category
    page.show(columns, 7)


def events(page: LiveMap, count: int) -> dict[str, object]:
    parts = urlsplit(page.address)
    found = {}
    with urllib.request.urlopen(f"http://{parts.netloc}/events?token={parts.fragment}", timeout=5) as answer:
        while len(found) < count:
            name = answer.readline().decode().removeprefix("event: ").strip()
            found[name] = orjson.loads(answer.readline().removeprefix(b"data: "))
            answer.readline()
    return found


def test_site_and_tracks_are_told(page: LiveMap) -> None:
    show(page)
    told = events(page, 2)
    assert [camera["name"] for camera in told["site"]["cameras"]] == ["left camera", "right camera"]
    assert told["tracks"]["sequence"] == 7
    (track,) = told["tracks"]["tracks"]  # the other is too far for a position
    assert track["name"] == "track 1"
    assert track["place"] == pytest.approx([SITE.origin.lat + 500 / 110_700, SITE.origin.lon], abs=1e-4)
    assert track["text"] == "car, 500 m"
    assert 0 < track["radius"] < 50


@pytest.mark.parametrize(("path", "host"), [("/events?token=wrong", None), ("/events", None), ("/", "evil.example")])
def test_others_are_refused(page: LiveMap, path: str, host: str | None) -> None:
    place = urlsplit(page.address).netloc
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(
            urllib.request.Request(f"http://{place}{path}", headers={"Host": host or place}), timeout=5
        )


def test_the_page_in_a_browser(page: LiveMap) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no browser")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        tab = browser.new_page()
        errors: list[str] = []
        tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.goto(page.address)
        show(page, "<img src=x onerror=alert(1)>")
        tab.wait_for_function("() => document.documentElement.dataset.sequence === '7'", timeout=60_000)
        assert tab.locator("#status").inner_text() == "1 track, moment 7"
        assert "<img src=x onerror=alert(1)>, 500 m" in tab.locator(".leaflet-tooltip").first.inner_text()
        assert tab.locator("#map img").count() == 0
        assert errors == []
        browser.close()
