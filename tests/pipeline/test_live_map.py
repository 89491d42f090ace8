"""The live map: told to this machine's pages only, newest first, and drawn by a real browser if there is one."""

import multiprocessing
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import orjson
import pytest
import torch
from browser import chromium_page, names_on_a_map, needs_browser
from track_scenes import ORIGIN, pairs_of, run_of, tracked_site
from waiting import PATIENCE, wait_for

pytest.importorskip("uvicorn")
from pages import crowded_map

from kcal import Localizer, Origin
from kcal.locate import geodetic_to_enu
from kcal.locate.points import PointLocator
from kcal.locate.tables import PositionColumns
from kcal.pipeline.senders import LiveMap
from kcal.pipeline.stream import track_columns
from kcal.track import Tracker, TrackOptions
from scripts.shared.children import children

SITE = tracked_site()


@pytest.fixture
def page() -> Iterator[LiveMap]:
    live = LiveMap(run_of(SITE), 0)
    yield live
    live.close()


def show(page: LiveMap, category: str = "car") -> PositionColumns:
    tracker = Tracker(SITE, TrackOptions(confirm_hits=1))
    left, right = SITE.rig(torch.tensor([[0.0, 0.0, 500.0], [30.0, 0.0, 90_000.0]]).double())[0].unbind(-2)
    columns = track_columns(tracker(pairs_of(left, right, 1.0)), 1)
    columns.extras["category"][0] = category
    page.show(columns, 7, 1.0)
    return columns


def level(places: list[list[float]], origin: Origin = ORIGIN) -> np.ndarray:
    """East and north in meters of places on the map."""
    geodetic = torch.tensor([[*place, origin.height] for place in places], dtype=torch.float64)
    return geodetic_to_enu(geodetic, origin)[:, :2].numpy()


def events(page: LiveMap, count: int) -> dict[str, Any]:
    parts = urlsplit(page.address)
    found = {}
    with urllib.request.urlopen(f"http://{parts.netloc}/events?token={parts.fragment}", timeout=PATIENCE) as answer:
        while len(found) < count:
            name = answer.readline().decode().removeprefix("event: ").strip()
            found[name] = orjson.loads(answer.readline().removeprefix(b"data: "))
            answer.readline()
    return found


def test_site_and_tracks_are_told(page: LiveMap) -> None:
    show(page)
    told = events(page, 3)
    assert [camera["name"] for camera in told["site"]["cameras"]] == ["left camera", "right camera"]
    assert told["tracks"]["sequence"] == 7
    (track,) = told["tracks"]["tracks"]  # the other is too far for a position
    assert track["name"] == "track 1"
    assert track["place"] == pytest.approx([SITE.origin.lat + 500 / 110_700, SITE.origin.lon], abs=1e-4)
    assert track["text"] == "car 1, 500.0 m"
    assert told["tracks"]["clock"] == "1.0 s"


def test_regions_are_those_of_the_covariance(page: LiveMap) -> None:
    columns = show(page)
    (track,) = events(page, 3)["tracks"]["tracks"]
    ring = level(track["region"])
    east, north = (columns.column(f"cov_{axes}_m2")[0] ** 0.5 for axes in ("ee", "nn"))
    # 95 % of two Gaussian coordinates lie within 2.45 sigma; the target is north, and its range is the worst known.
    assert np.ptp(ring[:, 1]) / 2 == pytest.approx(2.4477 * north, rel=0.01)
    assert np.ptp(ring[:, 0]) / 2 == pytest.approx(2.4477 * east, rel=0.01)
    assert np.ptp(ring[:, 1]) > 20 * np.ptp(ring[:, 0])


def test_fields_of_view_are_those_of_the_cameras(page: LiveMap) -> None:
    for camera, seen in zip(events(page, 1)["site"]["cameras"], page.run.cameras, strict=True):
        foot, first, *_, last = level([*camera["field"]])
        assert foot == pytest.approx(level([camera["place"]])[0], abs=1e-3)
        for rim, azimuth in zip((first, last), seen.azimuths_deg, strict=True):
            east, north = rim - foot
            assert np.degrees(np.arctan2(east, north)) % 360 == pytest.approx(azimuth % 360, abs=1e-3)


def test_nothing_jumps_at_the_antimeridian() -> None:
    site = tracked_site(origin=Origin(lat=10.0, lon=179.9999, height=0.0), heading_deg=90.0)
    live = LiveMap(PointLocator(Localizer(site.rig.placed(origin=site.origin, heading_deg=90.0))).located(), 0)
    left, right = site.rig(torch.tensor([[0.0, 0.0, 500.0]]).double())[0].unbind(-2)
    live.show(track_columns(Tracker(site, TrackOptions(confirm_hits=1))(pairs_of(left, right, 1.0)), 1), 1, 1.0)
    told = events(live, 3)
    live.close()
    (track,) = told["tracks"]["tracks"]
    lons = [
        lon for _, lon in [track["place"], *track["region"], *(p for c in told["site"]["cameras"] for p in c["field"])]
    ]
    assert 179 < min(lons) < 180 < max(lons) < 182


def test_the_last_tracks_and_the_end_are_told(page: LiveMap) -> None:
    found: dict[str, Any] = {}
    reader = threading.Thread(target=lambda: found.update(events(page, 4)))
    reader.start()
    wait_for(lambda: page.readers == 1)
    show(page)
    page.close("stopped")
    reader.join()
    assert list(found) == ["site", "trails", "tracks", "end"]
    assert found["end"] == {"words": "stopped"}


@pytest.mark.parametrize(("path", "host"), [("/events?token=wrong", None), ("/events", None), ("/", "evil.example")])
def test_others_are_refused(page: LiveMap, path: str, host: str | None) -> None:
    place = urlsplit(page.address).netloc
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(
            urllib.request.Request(f"http://{place}{path}", headers={"Host": host or place}), timeout=PATIENCE
        )


def status(page: Any, words: str) -> None:
    page.wait_for_function("words => document.getElementById('status').textContent === words", arg=words)


def moving(page: LiveMap, seconds: float) -> None:
    """A car that drives east at 20 m/s, 500 m away, told ten times a second."""
    tracker = Tracker(SITE, TrackOptions(confirm_hits=1))
    for step in range(int(10 * seconds)):
        time = 1_767_225_600.0 + 0.1 * step
        left, right = SITE.rig(torch.tensor([[2.0 * step - 100.0, 0.0, 500.0]]).double())[0].unbind(-2)
        page.show(track_columns(tracker(pairs_of(left, right, time, 0.05)), step), step, time)


def test_speed_clock_and_where_it_has_been_are_told(page: LiveMap) -> None:
    moving(page, 10.0)
    told = events(page, 3)
    assert told["tracks"]["clock"] == "2026-01-01 00:00:09 UTC"
    (track,) = told["tracks"]["tracks"]
    name, distance, speed = track["text"].split(", ")
    assert name == "car 1"
    assert distance.endswith(" m")
    value, toward = speed.removesuffix("°").split(" m/s toward ")
    assert float(value) == pytest.approx(20.0, abs=0.5)
    assert float(toward) == pytest.approx(90.0, abs=3.0)
    # Twice a second, for pages that are opened later.
    trail = level(told["trails"]["track 1"])
    assert len(trail) == 20
    assert trail[-1, 0] - trail[0, 0] == pytest.approx(190.0, abs=3.0)
    # A minute after its end, a trail is gone.
    nothing = page._news[1].rows(np.arange(0))
    page.show(nothing, 100, 1_767_225_600.0 + 65.0)
    assert events(page, 2)["trails"]
    page.show(nothing, 101, 1_767_225_600.0 + 71.0)
    assert not events(page, 2)["trails"]


@needs_browser
def test_a_page_that_is_opened_later_shows_trails(page: LiveMap) -> None:
    moving(page, 5.0)
    with chromium_page() as tab:
        tab.goto(page.address)
        tab.wait_for_function("() => document.documentElement.dataset.sequence === '49'")
        trail = tab.locator("path[stroke='#c02a6b']")
        assert trail.bounding_box()["width"] > 20
        page.show(page._news[1].rows(np.arange(0)), 50, 1_767_225_606.0)
        tab.wait_for_function("() => document.documentElement.dataset.sequence === '50'")
        assert trail.count() == 1
        assert tab.inner_text("#count") == "0 targets"
        page.show(page._news[1].rows(np.arange(0)), 51, 1_767_225_670.0)
        tab.wait_for_function("() => document.documentElement.dataset.sequence === '51'")
        assert trail.count() == 0
        assert tab.complaints == []


@needs_browser
def test_the_page_in_a_browser(page: LiveMap) -> None:
    with chromium_page() as tab:
        tab.goto(page.address)
        show(page, "<img src=x onerror=alert(1)>")
        tab.wait_for_function("() => document.documentElement.dataset.sequence === '7'")
        status(tab, "running")
        assert tab.inner_text("#count") == "1 target"
        assert tab.inner_text("#clock") == "1.0 s"
        assert tab.locator("svg[aria-label='North is up']").is_visible()
        names = tab.locator(".leaflet-tooltip").all_inner_texts()
        assert names == ["left camera", "right camera", "<img src=x onerror=alert(1)> 1, 500.0 m"]
        assert tab.locator("#map img").count() == 0
        # A field of view for each camera, two cameras, a region, a trail, a target, the coast.
        assert tab.locator("#map path").count() == 2 + 2 + 1 + 1 + 1 + 1
        page.close()
        status(tab, "finished")
        tab.wait_for_timeout(500)
        status(tab, "finished")
        assert tab.complaints == []


@needs_browser
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_names_cover_neither_each_other_nor_dots(width: int, height: int) -> None:
    with crowded_map(40) as live, chromium_page(width, height) as tab:
        tab.goto(live.address)
        tab.wait_for_function("() => document.documentElement.dataset.sequence === '1'")
        names, dots, covered = names_on_a_map(tab)
        assert dots == 42
        assert names >= 15  # the others wait until there is room
        assert covered == []
        # With the keyboard every target can be reached, and then its name is there.
        hidden = tab.evaluate(
            "() => { const e = [...document.querySelectorAll('.leaflet-tooltip')]"
            ".find((e) => e.style.visibility === 'hidden'); return e.textContent; }"
        )
        tab.locator(f'path[aria-label="{hidden}"]').focus()
        assert tab.locator(".leaflet-tooltip.asked").inner_text() == hidden
        assert tab.locator(".leaflet-tooltip.asked").is_visible()


def serve(answer: Any) -> None:
    answer.send(LiveMap(run_of(SITE), 0).address)
    answer.recv()


@needs_browser
def test_a_lost_connection_is_not_an_end() -> None:
    here, there = multiprocessing.Pipe()
    process = children().Process(target=serve, args=(there,), daemon=True)
    process.start()
    with chromium_page() as tab:
        tab.goto(here.recv())
        status(tab, "running")
        process.kill()
        status(tab, "connection lost; trying again")
    process.join()
