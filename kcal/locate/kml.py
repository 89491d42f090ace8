"""Positions as KML 2.2 (OGC 07-147r2), for Google Earth and every GIS: points, 95 % regions, cameras."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from kcal.locate.positions import Located, Position
from kcal.locate.region import region_rings

_NAMESPACE = "http://www.opengis.net/kml/2.2"


def to_kml(located: Located) -> str:
    """A KML document: longitude, latitude, height; heights are those of KML's own datum, see below.

    KML counts absolute altitudes from the EGM96 geoid. With a geoid grid, positions are written with `altitudeMode`
    absolute and their height above that geoid; without one they are `clampToGround`, because an ellipsoidal height
    taken for a height above the sea would be wrong by up to 100 m. Regions lie on the ground.
    """
    ET.register_namespace("", _NAMESPACE)
    root = ET.Element(_tag("kml"))
    document = ET.SubElement(root, _tag("Document"))
    _text(document, "name", "kcal positions")
    _text(document, "description", f"Regions: {located.interval_note}. Geoid: {located.geoid or 'none'}.")
    _style(document, "camera", "ffb06c2b", None)
    _style(document, "point", "ff6b2ac0", None)
    _style(document, "region", "ff271811", "33271811")
    for camera in located.cameras:
        lat, lon, _ = camera.geodetic
        _point(document, f"{camera.name} camera", "camera", (lat, lon, None), "")
    for position in located.positions:
        if position.lat is None or position.lon is None or position.height is None:
            continue
        above = None if position.geoid_height is None else position.height - position.geoid_height
        _point(document, position.name, "point", (position.lat, position.lon, above), _description(position))
    for position, ring in region_rings(located):
        placemark = ET.SubElement(document, _tag("Placemark"))
        _text(placemark, "name", f"{position.name}, 95 %")
        _text(placemark, "styleUrl", "#region")
        polygon = ET.SubElement(placemark, _tag("Polygon"))
        boundary = ET.SubElement(ET.SubElement(polygon, _tag("outerBoundaryIs")), _tag("LinearRing"))
        _text(boundary, "coordinates", " ".join(f"{(lon + 180) % 360 - 180!r},{lat!r}" for lat, lon in ring))
    ET.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _tag(name: str) -> str:
    return f"{{{_NAMESPACE}}}{name}"


def _text(parent: ET.Element, name: str, text: str) -> None:
    # XML has no control characters.
    ET.SubElement(parent, _tag(name)).text = "".join(c for c in text if c >= " " or c in "\n\t")


def _style(document: ET.Element, name: str, line: str, fill: str | None) -> None:
    style = ET.SubElement(document, _tag("Style"), id=name)
    if fill is None:
        _text(ET.SubElement(style, _tag("IconStyle")), "color", line)
        return
    _text(ET.SubElement(style, _tag("LineStyle")), "color", line)
    _text(ET.SubElement(style, _tag("PolyStyle")), "color", fill)


def _point(
    document: ET.Element, name: str, style: str, place: tuple[float, float, float | None], description: str
) -> None:
    lat, lon, height = place
    placemark = ET.SubElement(document, _tag("Placemark"))
    _text(placemark, "name", name)
    if description:
        _text(placemark, "description", description)
    _text(placemark, "styleUrl", f"#{style}")
    point = ET.SubElement(placemark, _tag("Point"))
    _text(point, "altitudeMode", "clampToGround" if height is None else "absolute")
    _text(point, "coordinates", f"{lon!r},{lat!r}" if height is None else f"{lon!r},{lat!r},{height!r}")


def _description(position: Position) -> str:
    low, high = position.range_low_m or 0.0, position.range_high_m or 0.0
    text = f"range {position.range_m or 0.0:.1f} m, 95 %: {low:.1f} to {high:.1f} m"
    return f"{text}. {position.reason}" if position.reason else text
