"""Surveys from GeoJSON and GPX."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kcal.errors import FileError, InputError
from kcal.locate.survey import import_survey, read_survey

GPX = """<?xml version="1.0"?>
<gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1">
 <wpt lat="19.07" lon="72.87"><ele>80</ele><name>post</name></wpt>
 <wpt lat="19.08" lon="72.87"><ele>90.5</ele><name>mast</name></wpt>
</gpx>"""


def feature(name: str, lon: float, lat: float, *height: float, **properties: float) -> dict[str, object]:
    return {
        "type": "Feature",
        "properties": {"name": name, **properties},
        "geometry": {"type": "Point", "coordinates": [lon, lat, *height]},
    }


def collection(*features: dict[str, object], **more: object) -> str:
    return json.dumps({"type": "FeatureCollection", "features": features, **more})


def test_three_formats_of_the_same_places(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("name,lat,lon,height,sigma\npost,19.07,72.87,14,0.02\nmast,19.08,72.87,24.5,0.02\n")
    places = feature("post", 72.87, 19.07, 14.0, sigma=0.02), feature("mast", 72.87, 19.08, 24.5, sigma=0.02)
    (tmp_path / "s.geojson").write_text(collection(*places))
    (tmp_path / "s.gpx").write_text(GPX)
    expected = read_survey(tmp_path / "s.csv")
    for found in (import_survey(tmp_path / "s.geojson"), import_survey(tmp_path / "s.gpx", sigma=0.02, geoid=-66.0)):
        assert found.names == expected.names
        assert found.origin == expected.origin
        assert found.points.tolist() == expected.points.tolist()
        assert found.sigma.tolist() == expected.sigma.tolist()


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("a.geojson", collection(feature("post", 19.07, 172.87, 14.0, sigma=1)), "latitude 172.87"),
        ("a.geojson", collection(feature("post", 72.87, 19.07, sigma=1)), "height"),
        ("a.geojson", collection(feature("post", 72.87, 19.07, 14.0)), "no sigma"),
        ("a.geojson", collection(feature("post", 72.87, 19.07, 14.0, sigma=-1)), "positive meters"),
        ("a.geojson", collection(feature("post", 72.87, 19.07, 14.0, sigma="")), "'post' has no sigma"),
        ("a.geojson", collection(feature("post", 72.87, 19.07, 14.0, sigma="good")), "sigma of 'post' is 'good'"),
        ("a.geojson", collection(feature("post", 72.87, 19.07, True, sigma=1)), "coordinate of 'post' is True"),
        (
            "a.geojson",
            collection(feature("post", 72.87, 19.07, 14.0, sigma=1)).replace("14.0", "9" * 400),
            "400 digits",
        ),
        ("a.geojson", collection(feature("post", 72.87, 19.07, 14.0, sigma=1)).replace("14.0", "9" * 5000), "digits"),
        ("a.csv", "name,lat,lon,height,sigma\na,1,2,3,0.1\nb,1,2,3,\n", "line 3: sigma is empty"),
        ("a.csv", "name,lat,lon,height,sigma\na,1,2,3,0.1\nb,1,2,3,good\n", "line 3: sigma is 'good'"),
        ("a.geojson", collection(feature("p", 72.0, 19.0, 1.0, sigma=1), crs={"type": "name"}), "crs"),
        ("a.geojson", collection(*[feature("p", 72.0, 19.0, 1.0, sigma=1)] * 2), "occurs twice"),
        ("a.geojson", collection(), "no places"),
        ("a.geojson", "[", "not a JSON file"),
        ("a.gpx", "<gpx", "not XML"),
        ("a.gpx", "<!DOCTYPE a><gpx/>", "document types"),
        ("a.gpx", GPX.replace("<ele>80</ele>", ""), "post: no elevation"),
    ],
)
def test_bad_files(tmp_path: Path, name: str, text: str, what: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FileError, match=what):
        import_survey(tmp_path / name, geoid=0.0, **({"sigma": 0.1} if name == "a.gpx" else {}))


def test_elevations_need_a_geoid(tmp_path: Path) -> None:
    (tmp_path / "s.gpx").write_text(GPX)
    with pytest.raises(InputError, match="geoid"):
        import_survey(tmp_path / "s.gpx", sigma=0.02)
