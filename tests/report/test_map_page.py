"""The map as a file, and in a real browser where there is one."""

import html
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import at_rest, chromium_page, needs_browser
from drawn_scenes import PLACES
from drawn_scenes import located as four_things
from locate_rigs import located_pairs, pinhole_rig, tensor
from PIL import Image, TiffImagePlugin
from waiting import wait_for

from kcal import FileError, InputError, Origin
from kcal.locate import geodetic_to_enu
from kcal.locate.positions import Located
from kcal.report.map_page import local_image, local_tiles, map_page, save_map

ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)


def scene(origin: Origin = ORIGIN) -> tuple[Located, torch.Tensor]:
    return four_things(mast="</script><b>mast", origin=origin)


def data(page: str) -> dict[str, object]:
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))


def test_everything_is_where_it_should_be() -> None:
    located, truth = scene()
    content = data(map_page(located, truth))
    assert [point["name"] for point in content["points"]] == ["gate", "</script><b>mast", "ship"]
    assert [arc["name"] for arc in content["arcs"]] == ["250 m", "1 km", "5 km"]
    for arc, meters in zip(content["arcs"], (250, 1000, 5000), strict=True):
        places = torch.tensor([[*place, ORIGIN.height] for place in arc["line"]], dtype=torch.float64)
        horizontal = geodetic_to_enu(places, ORIGIN)[:, :2].norm(dim=-1)
        # Drawn at the origin's height, not in its tangent plane.
        assert (horizontal - meters).abs().max() < 0.02
    for spot, row in zip(content["truth"], truth, strict=True):
        # The drop of the ellipsoid at 60 km moves a horizontal place by less than a meter per meter of height.
        enu = geodetic_to_enu(tensor(*spot, ORIGIN.height), ORIGIN)
        assert (enu - row)[:2].norm() < 1e-5 * row.norm() * max(1.0, float(row.norm()) / 1000)
    assert len(content["regions"]) == 3
    assert len(content["bearings"]) == 1
    assert len(content["arrows"]) == 3
    assert data(map_page(located))["truth"] == []


def test_it_may_load_nothing_unless_asked() -> None:
    page = map_page(scene()[0])
    assert 'img-src data:"' in page
    assert "default-src 'none'" in page
    assert "unsafe" not in page.split("<title>")[0]
    # No element that loads, no style that does.
    assert not re.search(r"<(link|img|iframe|script[^>]* src)", page.split("<script")[0])
    assert "url(images" not in page
    assert data(page)["online"] is None
    assert "img-src data: https://tile.openstreetmap.org" in map_page(scene()[0], online=True)


def dom(file: Path) -> str:
    """What a browser makes of a page; it must not complain."""
    with chromium_page() as page:
        page.goto(file.as_uri())
        page.wait_for_function("() => document.documentElement.dataset.drawn")
        assert page.complaints == []
        return page.content()


@needs_browser
@pytest.mark.parametrize("lon", [72.87, 179.99])
def test_a_browser_draws_it_without_errors(tmp_path: Path, lon: float) -> None:
    located, truth = scene(Origin(lat=19.07, lon=lon, height=14.0))
    drawn = dom(save_map(tmp_path / "map.html", located, truth))
    # Points, true ones, cameras with fields, arcs with ends, regions, arrows with heads, a bearing; the coast of India.
    assert 'data-drawn="3/' in drawn
    coast = lon == 72.87
    assert int(re.search(r'data-drawn="3/(\d+)"', drawn).group(1)) == 3 + 4 + 4 + 6 + 3 + 6 + 1 + coast
    assert drawn.count("coast: Natural Earth ± 2 km") == 1 + coast  # once in the script
    for text in ("gate", "&lt;/script&gt;&lt;b&gt;mast", "ship", "5 km", "estimated positions"):
        assert text in drawn


# As a file's name or a point's: each of these ran, or blanked the map, where it was taken for HTML.
HOSTILE = (
    "<!--<script>",
    "<img src=x onerror=document.documentElement.dataset.ran=1>",
    "<svg onload=document.documentElement.dataset.ran=1>",
    "]]><style>*{display:none}",
)


@needs_browser
def test_names_are_texts_in_a_browser(tmp_path: Path) -> None:
    left, right = pinhole_rig()(PLACES)[0].unbind(-2)
    located = located_pairs(pinhole_rig(), left, right, origin=ORIGIN, heading_deg=300.0, names=list(HOSTILE))
    tiles = tmp_path / HOSTILE[1]
    (tiles / "13" / "5754").mkdir(parents=True)
    Image.new("RGB", (256, 256), "green").save(tiles / "13" / "5754" / "3654.png")
    image = geotiff(tmp_path / f"{HOSTILE[2]}.tif")
    drawn = dom(save_map(tmp_path / "map.html", located, PLACES, tiles=tiles, image=image))
    assert 'data-drawn="3/' in drawn
    assert "data-ran" not in drawn
    for name in HOSTILE[:3]:
        assert drawn.count(html.escape(name)) >= 1
        assert name not in drawn


@needs_browser
def test_nothing_else_runs_in_the_page(tmp_path: Path) -> None:
    """Even where markup gets into the page, the policy stops handlers, scripts and requests."""
    page = map_page(scene()[0])
    planted = (
        "<img src=x onerror=document.documentElement.dataset.ran=1><script>document.documentElement.dataset.ran=2"
        '</script><b onclick="" style="color:red">b</b><iframe src="data:text/html,x"></iframe><main id="map"'
    )
    path = tmp_path / "planted.html"
    path.write_text(page.replace('<main id="map"', planted))
    with chromium_page() as tab:
        tab.goto(path.as_uri())
        tab.wait_for_function("() => document.documentElement.dataset.drawn")

        def refused() -> list[str]:
            return [text for text in tab.complaints if "Content Security Policy" in text]

        wait_for(lambda: len(refused()) >= 4, lambda seconds: tab.wait_for_timeout(1e3 * seconds))
        at_rest(tab)
        drawn = tab.content()
    assert "data-ran" not in drawn
    assert 'data-drawn="3/' in drawn


def geotiff(path: Path) -> Path:
    """100 x 80 pixels of 20 m in UTM zone 43 north, its top left corner at 273 000 E, 2 111 000 N; a red square."""
    pixels = np.full((80, 100, 3), 200, np.uint8)
    pixels[38:43, 68:73] = (255, 0, 0)
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[33550], tags[33922] = (20.0, 20.0, 0.0), (0.0, 0.0, 0.0, 273_000.0, 2_111_000.0, 0.0)
    tags[34735] = (1, 1, 0, 2, 1025, 0, 1, 1, 3072, 0, 1, 32643)
    tags.tagtype[33550] = tags.tagtype[33922] = 12
    tags.tagtype[34735] = 3
    Image.fromarray(pixels).save(path, tiffinfo=tags)
    return path


def test_a_geotiff_lies_where_it_belongs(tmp_path: Path) -> None:
    import base64
    import io

    import pyproj

    image = local_image(geotiff(tmp_path / "ortho.tif"))
    raw = base64.b64decode(image["uri"].split(",")[1])
    pixels = np.asarray(Image.open(io.BytesIO(raw)).convert("RGBA")).astype(int)
    row, column = np.argwhere((pixels[..., 0] - pixels[..., 1] > 60) & (pixels[..., 3] > 0)).mean(0)
    (south, west), (north, east) = image["bounds"]
    lon = west + (column + 0.5) / pixels.shape[1] * (east - west)
    lat = north - (row + 0.5) / pixels.shape[0] * (north - south)
    x, y = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32643", always_xy=True).transform(lon, lat)
    # Half a pixel of 20 m, and the colors of WEBP spread over more.
    assert (x, y) == pytest.approx((273_000 + 70.5 * 20, 2_111_000 - 40.5 * 20), abs=30)
    assert data(map_page(scene()[0], image=tmp_path / "ortho.tif"))["image"]["name"] == "ortho.tif"


def test_tiles_in_view_are_embedded(tmp_path: Path) -> None:
    # Zoom 13 of Mumbai: x = (72.87 + 180) / 360 * 8192 = 5754, y = 3654.
    for x, y in ((5754, 3654), (100, 100)):
        (tmp_path / "13" / str(x)).mkdir(parents=True)
        Image.new("RGB", (256, 256), "green").save(tmp_path / "13" / str(x) / f"{y}.png")
    content = data(map_page(scene()[0], tiles=tmp_path))
    assert list(content["tiles"]["images"]) == ["13/5754/3654"]
    assert content["tiles"]["zooms"] == [13, 13]
    with pytest.raises(FileError, match="shows this place"):
        local_tiles(tmp_path, (50.0, 8.0, 51.0, 9.0))


@pytest.mark.parametrize("name", ["4000", "\u00b2", "999999999", "-1", "013", "28", "9" * 200])
def test_folders_that_are_no_zoom(tmp_path: Path, name: str) -> None:
    for folder in (tmp_path / name / "5754", tmp_path / "13" / name, tmp_path / "13" / "5754"):
        folder.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (256, 256), "green").save(folder / f"{name}.png")
    with pytest.raises(FileError, match="shows this place"):
        local_tiles(tmp_path, (19.0, 72.0, 20.0, 73.0))


@pytest.mark.parametrize(
    ("tag", "value", "kind"),
    [
        (33550, (math.nan, 20.0, 0.0), 12),
        (33550, (0.0, 0.0, 0.0), 12),
        (33550, (20.0,), 12),
        (33922, (0.0, 0.0), 12),
        (34735, (1, 1, 0), 3),
        (34735, (1, 1, 0, 1, 3072, 0, 1, 1), 3),
        (34264, (1.0,) * 15, 12),
    ],
)
def test_damaged_geotiffs(tmp_path: Path, tag: int, value: tuple[float, ...], kind: int) -> None:
    path = geotiff(tmp_path / "ortho.tif")
    with Image.open(path) as image:
        tags, pixels = image.tag_v2, np.asarray(image)
    tags[tag] = value
    tags.tagtype[tag] = kind
    Image.fromarray(pixels).save(path, tiffinfo=tags)
    with pytest.raises((FileError, InputError), match=r"ortho\.tif"):
        local_image(path)
    whole = geotiff(path).read_bytes()
    for cut in (0, 9, 100, len(whole) // 2):
        path.write_bytes(whole[:cut])
        with pytest.raises(FileError, match=r"ortho\.tif"):
            local_image(path)


def test_bad_arguments(tmp_path: Path) -> None:
    located, truth = scene()
    with pytest.raises(InputError, match=r"truth: shape \(4, 3\)"):
        map_page(located, truth[:2])
    with pytest.raises(InputError, match=r"end with \.html"):
        save_map(tmp_path / "map.png", located)
    with pytest.raises(FileError, match="no such folder"):
        map_page(located, tiles=tmp_path / "none")
    Image.new("RGB", (4, 4)).save(tmp_path / "plain.tif")
    with pytest.raises(InputError, match="no GeoTIFF"):
        map_page(located, image=tmp_path / "plain.tif")
    (tmp_path / "text.tif").write_text("no image")
    with pytest.raises(FileError, match="cannot read this image"):
        map_page(located, image=tmp_path / "text.tif")


@needs_browser
def test_numbers_are_within_the_keyboards_reach(tmp_path: Path) -> None:
    located, truth = scene()
    with chromium_page() as page:
        page.goto(save_map(tmp_path / "map.html", located, truth).as_uri())
        page.wait_for_function("() => document.documentElement.dataset.drawn")
        for _ in range(40):
            page.keyboard.press("Tab")
            if page.evaluate("document.activeElement.getAttribute('aria-label')") == "ship":
                break
        page.keyboard.press("Enter")
        assert page.locator(".leaflet-popup-content").inner_text().startswith("latitude")


COVERED = """() => {
  const boxes = (kind) => [...document.querySelectorAll(kind)].map((e) => e.getBoundingClientRect());
  const controls = boxes('.leaflet-control');
  return boxes('#map path[aria-label]').filter((a) => controls.some((b) =>
    a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)).length;
}"""


@needs_browser
@pytest.mark.parametrize(("width", "heading"), [(1280, 240.0), (1280, 120.0), (390, 212.0), (390, 148.0)])
def test_controls_cover_no_camera_and_no_point(tmp_path: Path, width: int, heading: float) -> None:
    """The cameras are in the corner of what is shown where the controls are, and the target in the opposite one."""
    left, right = pinhole_rig()(tensor([0.0, 0.0, 5000.0]))[0].unbind(-2)
    located = located_pairs(pinhole_rig(), left, right, origin=ORIGIN, heading_deg=heading, names=["ship"])
    with chromium_page(width, 800) as page:
        page.goto(save_map(tmp_path / "map.html", located).as_uri())
        page.wait_for_function("() => document.documentElement.dataset.drawn")
        assert page.locator("#map path[aria-label]").count() == 3
        assert page.evaluate(COVERED) == 0


@pytest.mark.parametrize(("scale", "digits"), [(1.0, 6), (1e-3, 8)])
def test_coordinates_have_the_digits_that_mean_something(scale: float, digits: int) -> None:
    left, right = pinhole_rig(baseline=10.0 * scale)(PLACES[:1] * scale)[0].unbind(-2)
    located = located_pairs(
        pinhole_rig(baseline=10.0 * scale), left, right, origin=ORIGIN, heading_deg=0.0, names=["a"]
    )
    rows = dict(data(map_page(located))["points"][0]["rows"])
    assert all(len(rows[name].rstrip("°").split(".")[1]) == digits for name in ("latitude", "longitude"))
