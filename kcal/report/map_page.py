"""Write an interactive map as one HTML file that needs no network, no server and no other file.

Leaflet (BSD-2-Clause, in the folder `leaflet`) draws. All geometry is computed here, on the ellipsoid, and written into
the page. The page's content policy allows its own scripts only and, without online tiles, forbids it to load
anything.
"""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.files import write_atomic
from kcal.locate.map_places import camera_place, field_azimuths, field_of_view, level_rim, map_places
from kcal.locate.positions import Located, Position
from kcal.locate.region import near, region_rings
from kcal.locate.stereo import PositionStatus
from kcal.quantities import Unit, length_text, number_text, range_text
from kcal.report.backdrop import local_image, local_tiles
from kcal.report.tables import interval_text, range_sigma, range_unit
from kcal.texts import page_data, page_policy, page_text

# Rings of a site and of the sea; on a bench, and where all is nearer than the first of them, round shares of the range.
ARCS_M = (250.0, 1000.0, 5000.0)
_ROUND = tuple(k * 10.0**e for e in range(-3, 3) for k in (1.0, 2.5, 5.0))
_ONLINE = {
    "url": "https://tile.openstreetmap.org/{z}/{x}/{y}.png",
    "attribution": "© OpenStreetMap contributors, openstreetmap.org/copyright",
}
_MAP_STYLE = """
html, body { margin: 0; height: 100%; font: 14px/1.4 system-ui, sans-serif; color: #111827; }
body { display: flex; flex-direction: column; }
header { padding: 8px 14px; border-bottom: 1px solid #d1d5db; }
header h1 { font-size: 16px; margin: 0; }
header p { margin: 2px 0 0; color: #4b5563; font-size: 12px; }
#map { flex: 1; background: #f3f1ea; }
.north { pointer-events: none; font: 700 14px system-ui, sans-serif; margin-left: 17px !important; }
.leaflet-control-layers-toggle::after { content: "\\2630"; display: block; text-align: center; line-height: 36px;
  color: #374151; font-size: 20px; }
.leaflet-control-layers-toggle { text-decoration: none; }
.leaflet-popup-content td { padding: 1px 8px 1px 0; white-space: nowrap; }
.head, .head svg { overflow: visible; }
"""
LatLon = tuple[float, float]


def map_page(
    located: Located,
    truth: Tensor | None = None,
    *,
    tiles: str | Path | None = None,
    image: str | Path | None = None,
    online: bool = False,
) -> str:
    """Make the page: positions with 95 % regions, true ones with arrows, cameras, fields of view, arcs of range.

    Args:
        located: from `kcal.locate_points`.
        truth: (N, 3) true east, north, up in meters, NaN where unknown; an arrow leads from each to its estimate.
        tiles: a folder of map tiles `z/x/y.png` (or .jpg, .webp) in Web Mercator; those in view are embedded.
        image: a GeoTIFF to show below the map, for example an orthophoto; embedded, at most 2048 pixels long.
        online: also load tiles of OpenStreetMap when the page is opened with a network.

    Raises:
        InputError: a truth of the wrong shape, or an image without georeference.
        FileError: a folder or file that cannot be read.
    """
    if truth is not None and tuple(truth.shape) != (len(located.positions), 3):
        raise InputError(f"truth: shape ({len(located.positions)}, 3) is needed, got {tuple(truth.shape)}")
    content = _content(located, truth)
    south, west, north, east = _box(content)
    content["bounds"] = [[south, west], [north, east]]
    margin = 0.25 * max(north - south, east - west, 1e-4)
    view = (south - margin, west - margin, north + margin, east + margin)
    content["tiles"] = None if tiles is None else local_tiles(tiles, view)
    content["image"] = None if image is None else local_image(image)
    content["online"] = _ONLINE if online else None
    library = resources.files("kcal.report") / "leaflet"
    style = (library / "leaflet.css").read_text(encoding="utf-8")
    # This page does not show the controls of these pictures.
    for picture in ("images/layers.png", "images/layers-2x.png", "images/marker-icon.png"):
        style = style.replace(f"url({picture})", "none")
    shared = resources.files("kcal.web") / "map"
    style += (shared / "map.css").read_text(encoding="utf-8")
    sources = (library / "leaflet.js", shared / "map.js", resources.files("kcal.report") / "map_page.js")
    scripts = [source.read_text(encoding="utf-8") for source in sources]
    allowed = "data: https://tile.openstreetmap.org" if online else "data:"
    title = located.count_note
    note = (
        f"From {located.origin.lat:.6f}°, {located.origin.lon:.6f}°, heading {located.heading_deg:g}° from true north. "
        f"Regions and intervals: {located.interval_note}. Geoid: {located.geoid or 'none found'}."
    )
    key = "White dots: estimated; click one for its numbers. Black outlines: 95 % regions."
    key += " Red dots: true, with an arrow to the estimate." if truth is not None else ""
    elements = "\n".join(f"<script>{script}</script>" for script in scripts)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="{page_policy(scripts=scripts, styles=(style, _MAP_STYLE), images=allowed)}">
<title>{page_text(title)}</title>
<style>{style}</style>
<style>{_MAP_STYLE}</style>
</head>
<body>
<header><h1>{page_text(title)}</h1><p>{page_text(note)}<br>{page_text(key)}</p></header>
<main id="map" aria-label="Map"></main>
<script type="application/json" id="data">{page_data(content)}</script>
{elements}
</body>
</html>
"""


def save_map(path: str | Path, located: Located, truth: Tensor | None = None, **options: Any) -> Path:
    """Write positions on a map to an .html file that needs no network; for the options see `map_page`.

    Raises:
        InputError: another suffix, or as `map_page`.
        FileError: the file cannot be written.
    """
    check_map_format(path)
    return write_atomic(path, map_page(located, truth, **options))


def check_map_format(path: str | Path) -> None:
    """Raise `InputError` unless `path` ends with .html or .htm."""
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: the map is a web page; the file name must end with .html")


def _content(located: Located, truth: Tensor | None) -> dict[str, Any]:
    ranges = [p.range_m or p.range_low_m or 0.0 for p in located.positions]
    farthest = max((one for one in ranges if math.isfinite(one)), default=0.0) or 300.0
    reach = 1.15 * farthest
    cameras, edges = [], []
    for view in located.cameras:
        sweep = field_azimuths(view)
        if sweep is not None:
            edges += [(float(a) - located.heading_deg + 180) % 360 - 180 for a in sweep[[0, -1]]]
        outline, place = field_of_view(view, located.origin, reach), camera_place(view, located.origin)
        cameras.append({"name": view.name, "place": place, "field": outline})
    low, high = (min(edges), max(edges)) if edges else (-180.0, 180.0)
    sweep = torch.linspace(low, high, 90, dtype=torch.float64) + located.heading_deg
    arcs = [
        {"name": range_text(arc), "line": map_places(level_rim((0, 0, 0), sweep, arc), located.origin)}
        for arc in (arcs_within(reach) if located.feet is None else [])
    ]
    feet = torch.zeros(len(located.positions), 3, dtype=torch.float64) if located.feet is None else located.feet
    bearings = [
        map_places(
            foot + level_rim((0.0, 0.0, 0.0), torch.full((2,), p.azimuth_deg, dtype=torch.float64), 1.0) * ends,
            located.origin,
        )
        for p, foot in zip(located.positions, feet, strict=True)
        if p.azimuth_deg is not None and p.status != PositionStatus.OK
        for ends in [torch.tensor([[min(p.range_low_m or 0.0, reach)], [reach]], dtype=torch.float64)]
    ]
    arrows, true = [], []
    for position, row in zip(located.positions, [] if truth is None else truth, strict=truth is not None):
        if not bool(torch.isfinite(row).all()):
            continue
        (spot,) = map_places(row[None], located.origin)
        true.append(spot)
        if position.enu is not None and position.lat is not None and position.lon is not None:
            miss = torch.tensor(position.enu, dtype=torch.float64) - row.detach().cpu().double()
            azimuth = math.degrees(math.atan2(float(miss[0]), float(miss[1])))
            arrows.append({"line": [spot, (position.lat, near(position.lon, located.origin.lon))], "azimuth": azimuth})
    unit = range_unit(located)
    points = [
        {"name": p.name, "place": (p.lat, near(p.lon, located.origin.lon)), "rows": _popup_rows(p, unit)}
        for p in located.positions
        if p.lat is not None and p.lon is not None
    ]
    rings = [[(lat, near(lon, located.origin.lon)) for lat, lon in ring] for ring in region_rings(located)]
    return {
        "cameras": cameras, "arcs": arcs, "regions": rings, "bearings": bearings, "arrows": arrows, "truth": true,
        "points": points,
    }  # fmt: skip


def arcs_within(reach: float) -> list[float]:
    """Ranges at which arcs are drawn, meters.

    Example:
        >>> arcs_within(2000.0), arcs_within(0.5)
        ([250.0, 1000.0], [0.05, 0.1, 0.25])
    """
    known = [arc for arc in ARCS_M if arc < reach]
    return known or [arc for arc in _ROUND if reach / 12.0 < arc < reach]


def _popup_rows(position: Position, unit: Unit) -> list[tuple[str, str]]:
    sigma = range_sigma(position)
    up = None if position.covariance is None else math.sqrt(position.covariance[2][2])
    height = position.height or 0.0
    rows = [
        ("latitude", f"{position.lat:.7f}°"),
        ("longitude", f"{position.lon:.7f}°"),
        ("ellipsoidal height", f"{number_text(height, up)} m"),
    ]
    if position.geoid_height is not None:
        rows.append(("above the geoid", f"{number_text(height - position.geoid_height, up)} m"))
    errors = [position.cep50_m, position.cep95_m, position.meters_per_pixel, 0.01 * (position.meters_per_degree or 0.0)]
    cep50, cep95, by_pixel, by_yaw = (length_text(error or 0.0, digits=2) for error in errors)
    rows += [
        ("range", length_text(position.range_m or 0.0, sigma, unit=unit)),
        ("95 % interval", f"{interval_text(position, unit)} {unit.name}"),
        ("CEP50, CEP95", f"{cep50}, {cep95}"),
        ("a pixel is", by_pixel),
        ("0.01° of yaw is", by_yaw),
    ]
    return [*rows, ("", position.reason)] if position.reason else rows


def _box(content: dict[str, Any]) -> tuple[float, float, float, float]:
    spots: list[LatLon] = [*content["truth"], *(spot["place"] for spot in content["points"])]
    spots += [camera["place"] for camera in content["cameras"]]
    for line in (*content["regions"], *content["bearings"]):
        spots += line
    lats, lons = zip(*spots, strict=True)
    return min(lats), min(lons), max(lats), max(lons)
