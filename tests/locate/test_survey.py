"""Surveys and their files."""

import json
import math
from pathlib import Path

import pyproj
import pytest
import torch

from kcal import FileError, InputError, KcalWarning, Origin
from kcal.lens import rotation_from_vector
from kcal.locate import enu_from_cam, enu_to_geodetic, read_marks
from kcal.locate.marks import COVARIANCE
from kcal.locate.mounting import attitude, mounting_of
from kcal.locate.survey import camera_positions, import_survey, match_landmarks, read_features, read_survey

# Surveys, features and mountings: read strictly, in one frame, on the Earth as PROJ has it.


def write(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


class TestSurvey:
    def test_latitudes_agree_with_proj_across_the_antimeridian(self, tmp_path: Path) -> None:
        origin = Origin(lat=-17.5, lon=179.9999, height=40.0)
        places = [(-17.47, -179.98, 55.0), (-17.51, 179.95, -3.0)]
        rows = "".join(f"p{i},{lat},{lon},{height},0.02\n" for i, (lat, lon, height) in enumerate(places))
        survey = read_survey(write(tmp_path, "name,lat,lon,height,sigma\n" + rows), origin)
        pipeline = pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            "+step +proj=topocentric +ellps=WGS84 +lat_0=-17.5 +lon_0=179.9999 +h_0=40.0"
        )
        for place, found in zip(places, survey.points.tolist(), strict=True):
            lat, lon, height = place
            assert found == pytest.approx(pipeline.transform(lon, lat, height), abs=1e-6)

    def test_projected_coordinates_are_no_local_meters(self, tmp_path: Path) -> None:
        path = write(tmp_path, "name,east,north,up,sigma\na,170000,400000,20,1\nb,170050,400030,21,1\n")
        with pytest.warns(KcalWarning, match=r"400 km from the origin.*Convert UTM.*they are flat"):
            assert read_survey(path).points[0].tolist() == [170000, 400000, 20]
        with pytest.raises(FileError, match=r"400 km from the origin.*Convert UTM"):
            read_survey(path, Origin(lat=3.6, lon=-78.0, height=0.0))

    def test_local_meters_and_unequal_sigmas(self, tmp_path: Path) -> None:
        survey = read_survey(write(tmp_path, "name,east,north,up,sigma,sigma_up\na,1,2,3,0.02,0.05\nb,4,5,6,0.1,\n"))
        assert survey.origin is None
        assert survey.points.tolist() == [[1, 2, 3], [4, 5, 6]]
        assert survey.sigma.tolist() == [[0.02, 0.02, 0.05], [0.1, 0.1, 0.1]]

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("name,lat,lon,height\na,1,2,3\n", "the column 'sigma' is missing"),
            ("name,lat,lon,height,sigma\na,1,2,3,\n", "line 2: sigma is empty"),
            ("name,lat,lon,height,sigma\na,1,2,3,0\n", "line 2: sigma is '0'; a positive number"),
            ("name,lat,lon,height,sigma\na,1,2,3,inf\n", "line 2: sigma is empty; write how well"),
            ("name,lat,lon,height,sigma\na,100,2,3,1\n", "line 2: latitude 100 is outside"),
            ("name,lat,lon,height,sigma\na,1,2,300000,1\n", "line 2: height 300000 m is outside"),
            ("name,lat,lon,sigma\na,1,2,1\n", "the columns lat, lon, height or east, north, up"),
            ("name,lat,lon,height,east,north,up,sigma\na,1,2,3,4,5,6,1\n", "not both"),
        ],
    )
    def test_bad_files_name_the_line(self, tmp_path: Path, text: str, message: str) -> None:
        with pytest.raises(FileError, match=message):
            read_survey(write(tmp_path, text))

    def test_names_bring_marks_and_places_together(self, tmp_path: Path) -> None:
        survey = read_survey(write(tmp_path, "name,east,north,up,sigma\na,1,2,3,1\nb,4,5,6,1\nc,7,8,9,1\n"))
        marks = read_marks(
            write(tmp_path, "name,left_u,left_v,right_u,right_v\nc,1,2,3,4\nd,5,6,7,8\na,,,9,9\n", "m.csv"), single=True
        )
        found = match_landmarks(survey, marks, 0.1)
        assert found.landmarks.names == ("a", "c")
        assert found.unmarked == ("b",)
        assert found.unsurveyed == ("d",)
        assert found.landmarks.pixels[1].tolist() == [[1, 2], [3, 4]]
        assert math.isnan(float(found.landmarks.pixels[0, 0, 0]))
        with pytest.raises(InputError, match="names must be the same in both files"):
            match_landmarks(survey, marks._replace(names=("x", "y", "z")), 0.1)

    def test_a_row_without_any_mark(self, tmp_path: Path) -> None:
        path = write(tmp_path, "name,left_u,left_v,right_u,right_v\na,,,,\n")
        with pytest.raises(FileError, match="neither image has a mark"):
            read_marks(path, single=True)

    def test_camera_positions(self, tmp_path: Path) -> None:
        survey = read_survey(write(tmp_path, "name,east,north,up,sigma\nright,1,2,3,1\n"))
        (position,) = camera_positions(survey, ("left", "right"))
        assert position.camera == 1
        with pytest.raises(InputError, match="'right' is no camera"):
            camera_positions(survey, ("a", "b"))


class TestFeatures:
    def test_what_the_table_states_of_its_marks_counts(self, tmp_path: Path) -> None:
        long = "name,camera,u,v,sigma,range,range_sigma\nroof,left,1,2,0.05,,\nroof,right,3,4,,500,10\n"
        found = read_features(write(tmp_path, long), 0.4)
        assert found.each_sigma.tolist() == [[0.05, 0.4]]
        assert found.inverse_range.tolist() == [1 / 500]
        with pytest.raises(FileError, match="line 3: range of 'roof' is 500, and 400 in an earlier line"):
            read_features(write(tmp_path, long.replace("0.05,,", "0.05,400,10")), 0.4)
        wide = "left_u,left_v,right_u,right_v," + ",".join(COVARIANCE) + "\n1,2,3,4,.01,0,0,0,.01,0,0,.04,0,.04\n"
        found = read_features(write(tmp_path, wide), 0.4)
        assert found.each_sigma.tolist() == [[pytest.approx(0.1), pytest.approx(0.2)]]

    def test_what_is_known_of_the_range(self, tmp_path: Path) -> None:
        header = "name,left_u,left_v,right_u,right_v,range,range_sigma,beyond\n"
        rows = ["peak,1,2,3,4,20000,2000,", "star,1,2,3,4,inf,,", "ridge,1,2,3,4,,,8000", "roof,1,2,3,4,,,"]
        found = read_features(write(tmp_path, header + "\n".join(rows) + "\n"), 0.1)
        assert found.inverse_range.tolist() == pytest.approx([5e-5, 0.0, 6.25e-5, 0.0])
        sigmas = found.inverse_range_sigma.tolist()
        assert sigmas[0] == pytest.approx(5e-6)
        assert 0 < sigmas[1] < 1e-9
        assert sigmas[2] == pytest.approx(1 / (8000 * 12**0.5))
        assert math.isinf(sigmas[3])

    @pytest.mark.parametrize(
        ("cells", "message"),
        [("100,,", "the range needs its range_sigma"), ("100,1,50", "range or beyond"), ("-1,1,", "a positive number")],
    )
    def test_contradictions(self, tmp_path: Path, cells: str, message: str) -> None:
        header = "name,left_u,left_v,right_u,right_v,range,range_sigma,beyond\n"
        with pytest.raises(FileError, match=f"csv: a: .*{message}"):
            read_features(write(tmp_path, header + f"a,1,2,3,4,{cells}\n"), 0.1)


class TestMounting:
    @pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (359.0, -80.0, 170.0), (123.4, 45.6, -78.9)])
    def test_attitude_is_the_inverse(self, angles: tuple[float, float, float]) -> None:
        assert attitude(enu_from_cam(*angles)) == pytest.approx(angles, abs=1e-9)

    def test_turns_are_those_of_the_covariance(self) -> None:
        """A small turn about an axis of the frame changes the attitude as its variance says."""
        origin = Origin(lat=48.0, lon=11.0, height=500.0)
        cam_from_enu = enu_from_cam(35.0, 0.0, 0.0).T
        covariance = torch.diag(torch.tensor([0, 0, 0, 0, 0, 1e-6], dtype=torch.float64))
        there = mounting_of(cam_from_enu, torch.zeros(3).double(), covariance, origin)
        up = rotation_from_vector(torch.tensor([0.0, 0.0, 1e-3], dtype=torch.float64))
        # Anticlockwise from above: the heading falls.
        assert attitude(up @ cam_from_enu.T)[0] == pytest.approx(35.0 - math.degrees(1e-3), abs=1e-9)
        assert float(there.covariance[5, 5]) == pytest.approx(1e-6)

    def test_north_and_up_are_those_at_the_camera(self) -> None:
        """20 km east of the origin at 60 degrees: meridians converge by 0.31°, the vertical tilts by 0.18°."""
        origin = Origin(lat=60.0, lon=11.0, height=0.0)
        center = torch.tensor([20_000.0, 0.0, 0.0], dtype=torch.float64)
        there = mounting_of(enu_from_cam(90.0).T, center, torch.zeros(6, 6).double(), origin)
        lon = float(enu_to_geodetic(center, origin)[1])
        assert there.heading_deg == pytest.approx(90.0 + (lon - 11.0) * math.sin(math.radians(60.0)), abs=1e-3)
        assert there.pitch_deg == pytest.approx(math.degrees(20_000 / 6_394_000), abs=1e-3)


# Surveys from GeoJSON and GPX.


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


def test_geojson_of_gdal_names_its_system(tmp_path: Path) -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    text = collection(feature("post", 72.87, 19.07, 14.0, sigma=1), crs=crs)
    assert import_survey(write(tmp_path, text, "a.geojson")).origin == Origin(lat=19.07, lon=72.87, height=14.0)


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
        import_survey(tmp_path / name, **({"sigma": 0.1, "geoid": 0.0} if name == "a.gpx" else {}))


def test_places_of_a_table_may_lack_a_sigma_that_is_given(tmp_path: Path) -> None:
    path = write(tmp_path, "name,east,north,up,sigma,sigma_up\na,1,2,3,0.1,\nb,4,5,6,,\nc,4,5,6,,2\n")
    assert import_survey(path, sigma=0.5).sigma.tolist() == [[0.1] * 3, [0.5] * 3, [0.5, 0.5, 2.0]]
    plain = write(tmp_path, "name,east,north,up\na,1,2,3\n")
    assert import_survey(plain, sigma=0.5).sigma.tolist() == [[0.5] * 3]
    with pytest.raises(InputError, match=r"sigma.*positive"):
        import_survey(plain, sigma=-1.0)


def test_elevations_need_a_geoid(tmp_path: Path) -> None:
    (tmp_path / "s.gpx").write_text(GPX)
    with pytest.raises(InputError, match="geoid"):
        import_survey(tmp_path / "s.gpx", sigma=0.02)
    for name in ("s.csv", "s.geojson"):  # of ellipsoidal heights, which would stay as they are
        with pytest.raises(InputError, match="GPX only"):
            import_survey(tmp_path / name, geoid=60.0)
