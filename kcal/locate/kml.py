"""Positions as KML 2.2 (OGC 07-147r2), for Google Earth and every GIS: points, 95 % regions, cameras.

KML counts absolute altitudes from the EGM96 geoid. With a geoid grid, positions are written with `altitudeMode`
absolute and their height above that geoid; without one they are `clampToGround`, because an ellipsoidal height taken
for a height above the sea would be wrong by up to 100 m. Regions lie on the ground.
"""

from __future__ import annotations

from xml.sax.saxutils import escape

import numpy as np

from kcal.locate.columns import PositionColumns, number_lines
from kcal.locate.positions import Located
from kcal.locate.region import CORNER_DECIMALS, ring_blocks
from kcal.texts import visible

KML_END = " </Document>\n</kml>\n"
_STYLES = """  <Style id="camera">
   <IconStyle><color>ffb06c2b</color></IconStyle>
  </Style>
  <Style id="point">
   <IconStyle><color>ff6b2ac0</color></IconStyle>
  </Style>
  <Style id="region">
   <LineStyle><color>ff271811</color></LineStyle>
   <PolyStyle><color>33271811</color></PolyStyle>
  </Style>
"""


def kml_start(run: Located) -> str:
    """The beginning of the document: styles and cameras."""
    note = f"Regions: {run.interval_note}. Geoid: {run.geoid or 'none'}."
    cameras = "".join(
        _point(f"{camera.name} camera", "camera", f"{camera.geodetic[1]!r},{camera.geodetic[0]!r}", False, "")
        for camera in run.cameras
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n <Document>\n'
        f"  <name>kcal positions</name>\n  <description>{_xml(note)}</description>\n{_STYLES}{cameras}"
    )


def kml_points(columns: PositionColumns) -> str:
    """A placemark for each row that has a position."""
    found = columns.rows(np.flatnonzero(columns.located))
    height, geoid = found.column("height_ellipsoidal_m"), found.column("geoid_height_m")
    places = number_lines(np.stack([found.column("lon"), found.column("lat"), height - geoid], -1))
    ranges = np.stack([found.column(name) for name in ("range_m", "range_low_m", "range_high_m")], -1)
    placemarks = []
    for name, reason, place, (distance, low, high) in zip(
        found.names, found.reasons, places, ranges.tolist(), strict=True
    ):
        text = f"range {distance:.1f} m, 95 %: {low:.1f} to {high:.1f} m"
        known = not place.endswith(",")
        text = f"{text}. {reason}" if reason else text
        placemarks.append(_point(name, "point", place.removesuffix(","), known, text))
    return "".join(placemarks)


def kml_regions(columns: PositionColumns, run: Located) -> str:
    """A polygon for each row that has a position."""
    names = [columns.names[i] for i in np.flatnonzero(columns.located).tolist()]
    placemarks = []
    rings = (ring for block in ring_blocks(columns, run.origin, plain=run.feet is not None) for ring in block)
    for name, ring in zip(names, rings, strict=True):
        corners = np.stack([(ring[:, 1] + 180.0) % 360.0 - 180.0, ring[:, 0]], -1)
        places = number_lines(corners.round(CORNER_DECIMALS))
        placemarks.append(
            f"  <Placemark>\n   <name>{_xml(name)}, 95 %</name>\n   <styleUrl>#region</styleUrl>\n   <Polygon>\n"
            f"    <outerBoundaryIs><LinearRing><coordinates>{' '.join(places)}</coordinates></LinearRing>"
            "</outerBoundaryIs>\n   </Polygon>\n  </Placemark>\n"
        )
    return "".join(placemarks)


def _point(name: str, style: str, place: str, absolute: bool, description: str) -> str:
    about = f"   <description>{_xml(description)}</description>\n" if description else ""
    mode = "absolute" if absolute else "clampToGround"
    return (
        f"  <Placemark>\n   <name>{_xml(name)}</name>\n{about}   <styleUrl>#{style}</styleUrl>\n"
        f"   <Point>\n    <altitudeMode>{mode}</altitudeMode>\n    <coordinates>{place}</coordinates>\n   </Point>\n"
        "  </Placemark>\n"
    )


def _xml(text: str) -> str:
    return escape(visible(text))
