import datetime
import itertools
import json
import math
import struct
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import torch
from locate_rigs import located_pairs, pinhole_rig, tensor

from kcal import FileError, InputError, Localizer, Origin, PositionStatus
from kcal.locate import find_geoid, geodetic_to_enu
from kcal.locate.export import cot_events, write_positions
from kcal.locate.positions import Located, Position
from kcal.locate.stereo import range_interval
from kcal.rig import RigCovariance

ORIGIN = Origin(lat=-33.9, lon=151.2, height=40.0)
RIG = pinhole_rig()  # f b = 16 000 px m, center (959.5, 539.5)
# Light that does not bend.
STRAIGHT = {"refraction": 0.0, "refraction_sigma": 0.0}


def one(left: tuple[float, float], right: tuple[float, float], **options: float) -> Position:
    return located_pairs(RIG, tensor(left), tensor(right), origin=ORIGIN, heading_deg=0.0, **options).positions[0]


def mixed() -> Located:
    """A located pair, one of each failure that marks can cause, and a pair too far for a range."""
    left = tensor([975.5, 539.5], [960.0, 500.0], [955.0, 500.0], [900.0, 500.0], [-5.0, 3.0], [math.nan, 3.0])
    right = tensor([959.5, 539.5], [959.5, 500.0], [955.0, 500.0], [905.0, 500.0], [1.0, 3.0], [1.0, 3.0])
    names = ["mast", "far", "parallel", "mismatch", "outside", "nothing"]
    return located_pairs(RIG, left, right, origin=ORIGIN, heading_deg=90.0, names=names, **STRAIGHT)


def test_exchanged_columns_are_named() -> None:
    right = tensor([975.5, 539.5], [960.0, 500.0], [1055.0, 530.0])
    left = right - tensor([16.0, 0.0])
    options = {"origin": ORIGIN, "heading_deg": 90.0, **STRAIGHT}
    reasons = {row.reason.partition("°")[2] for row in located_pairs(RIG, left, right, **options).positions}
    (reason,) = reasons
    assert reason.endswith("meet with left and right exchanged, in all such rows: exchange columns or images")
    # A single mismatch among good rows says nothing of the columns.
    left[:2], right[:2] = right[:2].clone(), left[:2].clone()
    (reason,) = (row.reason for row in located_pairs(RIG, left, right, **options).positions if row.reason)
    assert "the rig has turned" in reason


def test_a_point_ahead_of_a_rig_that_looks_east_is_east() -> None:
    position = mixed().positions[0]
    east, north, up = position.enu
    # 16 px: 1000 m. The mark of the left camera is 16 px right of its center: 10 m, and right of east is south.
    assert (east, north, up) == pytest.approx((1000.0, -10.0, 0.0), abs=1e-6)
    assert position.lon > ORIGIN.lon
    assert position.lat < ORIGIN.lat
    # The tangent plane is 8 cm above the ellipsoid at 1 km.
    assert position.height == pytest.approx(40.078, abs=1e-3)


def test_each_failure_says_why_and_carries_no_number_that_could_be_mistaken() -> None:
    located = mixed()
    by_name = {position.name: position for position in located.positions}
    names = ["OK", "BEARING_ONLY", "PARALLEL", "PARALLEL", "OUTSIDE_IMAGE", "NOT_FINITE"]
    assert [position.status.name for position in located.positions] == names
    assert located.count == 1
    for name, position in by_name.items():
        if name != "mast":
            assert position.reason
            assert (position.lat, position.lon, position.height, position.enu, position.range_m) == (None,) * 5
    assert torch.isnan(located.enu[1:]).all()
    # 16 000 / (0.5 + 1.96 * 0.3 * sqrt 2) m, a little more along the slanted line of sight.
    assert by_name["far"].range_low_m == pytest.approx(12_017, abs=10)
    assert by_name["far"].range_high_m == math.inf
    assert by_name["far"].azimuth_deg == pytest.approx(90 + math.degrees(0.5 / 1600), abs=1e-6)
    assert "diverge by 0.179°" in by_name["mismatch"].reason
    # No range explains marks that diverge: the bearing is all there is.
    assert (by_name["mismatch"].range_low_m, by_name["mismatch"].range_high_m) == (None, None)
    assert by_name["mismatch"].azimuth_deg is not None
    assert by_name["nothing"].range_low_m is None
    assert by_name["nothing"].azimuth_deg is None


def test_a_match_that_cannot_be_right_is_called_doubtful() -> None:
    # 12 px of vertical disparity on a level rig, half of it in each image.
    position = one((975.5, 539.5), (959.5, 551.5))
    assert position.status == PositionStatus.OK
    assert position.reprojection_px == pytest.approx((6.0, 6.0), abs=0.01)
    assert "doubtful" in position.reason
    assert one((975.5, 539.5), (959.5, 540.0)).reason == ""


def test_pixel_sigma_widens_the_interval() -> None:
    fine, coarse = one((975.5, 539.5), (959.5, 539.5), pixel_sigma=0.1), one((975.5, 539.5), (959.5, 539.5))
    assert coarse.range_low_m < fine.range_low_m < fine.range_m < fine.range_high_m < coarse.range_high_m
    assert one((975.5, 539.5), (959.5, 539.5), pixel_sigma=4.0).status == PositionStatus.BEARING_ONLY


def test_bad_input_is_refused() -> None:
    marks = tensor([975.5, 539.5])
    for arguments, message in (
        ((marks[0], marks[0]), "shape"),
        ((marks[:0], marks[:0]), "at least one"),
        ((marks, tensor([1.0, 2.0], [3.0, 4.0])), "same shape"),
        (("marks", marks), "tensor or array"),
    ):
        with pytest.raises(InputError, match=message):
            located_pairs(RIG, *arguments, origin=ORIGIN, heading_deg=0.0)
    with pytest.raises(InputError, match="names"):
        located_pairs(RIG, marks, marks, origin=ORIGIN, heading_deg=0.0, names=["a", "b"])
    with pytest.raises(InputError, match="heading"):
        located_pairs(RIG, marks, marks, origin=ORIGIN, heading_deg=math.nan)


def test_cameras_stand_and_look_where_they_should() -> None:
    left, right = mixed().cameras
    assert left.enu == (0.0, 0.0, 0.0)
    assert left.geodetic == (ORIGIN.lat, ORIGIN.lon, ORIGIN.height)
    # Looking east, the right camera is 10 m to the south.
    assert right.enu == pytest.approx((0.0, -10.0, 0.0), abs=1e-12)
    half = math.degrees(math.atan(960 / 1600))
    assert left.azimuths_deg == pytest.approx((90 - half, 90 + half), abs=1e-9)


def test_geojson_follows_rfc_7946(tmp_path: Path) -> None:
    located = mixed()
    content = json.loads(write_positions(tmp_path / "points.geojson", located).read_text(encoding="utf-8"))
    # Section 4: no other coordinate system, hence no "crs"; section 3.3: these members and no others.
    assert set(content) == {"type", "features"}
    assert content["type"] == "FeatureCollection"
    for feature in content["features"]:
        assert set(feature) == {"type", "geometry", "properties"}
        assert feature["type"] == "Feature"
        if feature["properties"]["kind"] != "region" and feature["geometry"] is not None:
            assert feature["geometry"]["type"] == "Point"
            longitude, latitude, _ = feature["geometry"]["coordinates"]
            # Section 3.1.1: longitude first.
            assert longitude == pytest.approx(151.2, abs=0.1)
            assert latitude == pytest.approx(-33.9, abs=0.1)
    cameras, points, (region,) = content["features"][:2], content["features"][2:-1], content["features"][-1:]
    assert (region["properties"]["name"], region["properties"]["share"]) == ("mast", 0.95)
    (ring,) = region["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    # Section 3.1.6: counterclockwise.
    assert sum(a[0] * b[1] - b[0] * a[1] for a, b in itertools.pairwise(ring)) > 0
    east = [geodetic_to_enu(tensor(lat, lon, 40.0), ORIGIN)[0].item() for lon, lat in ring]
    # 0.3 px in each mark at 1 km: 26.5 m, times 2.45, and skewed outward.
    assert (1000 - min(east), max(east) - 1000) == pytest.approx((61.0, 69.5), abs=1.0)
    assert [camera["properties"]["name"] for camera in cameras] == ["left camera", "right camera"]
    assert cameras[0]["geometry"]["coordinates"] == [151.2, -33.9, 40.0]
    assert "are not included" in cameras[0]["properties"]["range_interval"]
    assert [point["geometry"] is None for point in points] == [False, True, True, True, True, True]
    mast, far = points[0]["properties"], points[1]["properties"]
    position = located.positions[0]
    assert points[0]["geometry"]["coordinates"] == [position.lon, position.lat, position.height]
    assert (mast["name"], mast["status"], mast["range_m"]) == ("mast", "ok", position.range_m)
    assert (mast["east_m"], mast["north_m"], mast["up_m"]) == position.enu
    assert (far["status"], far["range_high_m"], far["range_high_infinite"]) == ("bearing_only", None, True)
    assert far["reason"]


def test_covariances_circles_and_slopes_of_a_position() -> None:
    position = one((975.5, 539.5), (959.5, 539.5), pixel_sigma=0.1)
    # Z² / (f b) = 62.5 m/px at 1 km, and 17.45 m for 0.01 degrees.
    assert position.meters_per_pixel == pytest.approx(62.5, rel=1e-3)
    assert position.meters_per_degree == pytest.approx(1745, rel=1e-3)
    along = math.sqrt(position.covariance[1][1])
    assert along == pytest.approx(62.5 * 0.1 * math.sqrt(2), rel=1e-3)
    assert position.cep50_m == pytest.approx(0.6745 * along, rel=0.01)
    assert position.cep95_m == pytest.approx(1.96 * along, rel=0.01)
    wide = located_pairs(
        RIG, tensor([975.5, 539.5]), tensor([959.5, 539.5]), origin=ORIGIN, heading_deg=0.0, pixel_sigma=0.1,
        calibration=RigCovariance.of(RIG, pose=torch.diag(tensor(0, 1e-4, 0, 0, 0, 0) ** 2)),
    )  # fmt: skip
    assert "and of the errors in calibration; errors in mounting are not included" in wide.interval_note
    assert wide.positions[0].covariance[1][1] == pytest.approx(along**2 + (1e-4 * 1e6 / 10) ** 2, rel=1e-3)


def test_geoid_heights_are_stated(tmp_path: Path) -> None:
    # One degree around the place, N = 22.5 m everywhere.
    path = tmp_path / "flat.gtx"
    path.write_bytes(struct.pack(">4d2i9f", -35.0, 150.0, 1.0, 1.0, 3, 3, *[22.5] * 9))
    marks = tensor([975.5, 539.5]), tensor([959.5, 539.5])
    located = located_pairs(RIG, *marks, origin=ORIGIN, heading_deg=0.0, geoid=find_geoid(path))
    assert (located.geoid, located.positions[0].geoid_height) == ("flat", pytest.approx(22.5))
    document = ET.fromstring(write_positions(tmp_path / "points.kml", located).read_bytes())
    coordinates = [element.text.split(",") for element in document.iter("{http://www.opengis.net/kml/2.2}coordinates")]
    assert float(coordinates[2][2]) == pytest.approx(located.positions[0].height - 22.5)


def test_kml(tmp_path: Path) -> None:
    located = mixed()
    space = {"k": "http://www.opengis.net/kml/2.2"}
    raw = ET.fromstring(write_positions(tmp_path / "points.kml", located).read_bytes())
    mast = raw.find(".//k:Placemark[k:name='mast']/k:Point", space)
    # Without a geoid an ellipsoidal height must not be taken for one above the sea.
    assert mast.find("k:altitudeMode", space).text == "clampToGround"
    kml = pytest.importorskip("fastkml.kml", reason="fastkml is not installed")
    (document,) = kml.KML.parse(write_positions(tmp_path / "points.kml", located)).features
    places = {place.name: place for place in document.features}
    assert set(places) == {"left camera", "right camera", "mast", "mast, 95 %"}
    position = located.positions[0]
    assert places["mast"].geometry.coords == ((position.lon, position.lat),)
    assert places["mast, 95 %"].geometry.geom_type == "Polygon"


def test_cursor_on_target_in_another_reader() -> None:
    takproto = pytest.importorskip("takproto", reason="takproto is not installed")
    located = mixed()
    moment = datetime.datetime(2026, 5, 4, 10, 0, tzinfo=datetime.UTC)
    packed = takproto.xml2proto(cot_events(located.columns, located, time=moment, stale_s=60))
    event = takproto.parse_proto(packed).cotEvent
    position = located.positions[0]
    assert (event.type, event.detail.contact.callsign) == ("a-u-G", "mast")
    assert (event.lat, event.lon) == (position.lat, position.lon)
    assert event.hae == pytest.approx(position.height, abs=1e-3)
    assert event.ce == pytest.approx(position.cep95_m, abs=1e-3)
    assert event.staleTime - event.startTime == 60_000


def test_cursor_on_target() -> None:
    located = mixed()
    moment = datetime.datetime(2026, 5, 4, 12, 0, tzinfo=datetime.timezone(datetime.timedelta(hours=2)))
    event = ET.fromstring(cot_events(located.columns, located, time=moment, stale_s=60))
    assert (event.get("version"), event.get("type")) == ("2.0", "a-u-G")
    assert (event.get("start"), event.get("stale")) == ("2026-05-04T10:00:00.000Z", "2026-05-04T10:01:00.000Z")
    point, position = event.find("point"), located.positions[0]
    assert (float(point.get("lat")), float(point.get("lon"))) == (position.lat, position.lon)
    assert float(point.get("hae")) == pytest.approx(position.height, abs=1e-3)
    assert float(point.get("ce")) == pytest.approx(position.cep95_m, abs=1e-3)
    assert float(point.get("le")) == pytest.approx(1.96 * math.sqrt(position.covariance[2][2]), abs=1e-3)
    assert event.find("detail/contact").get("callsign") == "mast"
    with pytest.raises(InputError, match="time zone"):
        cot_events(located.columns, located, time=datetime.datetime(2026, 5, 4))
    unknown = located.columns.rows(np.array([0]))
    unknown.column("cep95_m")[:] = math.inf
    assert ET.fromstring(cot_events(unknown, located, time=moment)).find("point").get("ce") == "9999999.0"


def test_regions_across_the_antimeridian_are_cut(tmp_path: Path) -> None:
    origin = Origin(lat=10.0, lon=179.9921, height=0.0)
    rig = pinhole_rig()
    located = located_pairs(rig, tensor([975.5, 539.5]), tensor([959.5, 539.5]), origin=origin, heading_deg=60.0)
    content = json.loads(write_positions(tmp_path / "points.geojson", located).read_bytes())
    region = content["features"][-1]["geometry"]
    assert region["type"] == "MultiPolygon"
    sides = sorted((min(lon for lon, _ in ring), max(lon for lon, _ in ring)) for (ring,) in region["coordinates"])
    assert sides[0][0] == -180.0
    assert sides[1][1] == 180.0
    assert sides[0][1] - sides[0][0] + sides[1][1] - sides[1][0] < 0.01
    assert all(ring[0] == ring[-1] for (ring,) in region["coordinates"])


def test_unknown_formats_and_places_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.geojson, \.json, \.csv"):
        write_positions(tmp_path / "points.shp", mixed())
    with pytest.raises(FileError, match="does not exist"):
        write_positions(tmp_path / "no" / "points.csv", mixed())


N = 20_000


@pytest.mark.parametrize("z", [1000.0, 5000.0, 16_000.0])
def test_interval_covers_95_percent_of_noisy_marks(z: float) -> None:
    # f b = 16 000 px m: 16, 3.2 and 1 px of disparity against 0.42 px of noise in it.
    rig = pinhole_rig(1600.0, 10.0)
    point = tensor([150.0, -40.0, z])
    left, right = rig(point)[0].unbind(-2)
    noise = 0.3 * torch.randn(2, N, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(11))
    result = Localizer(rig, pixel_sigma=0.3)(left + noise[0], right + noise[1])
    true_range = point.norm()
    covered = (result.range_low <= true_range) & (true_range <= result.range_high)
    # 20 000 draws know 95 % to 0.15 %; the approximations of the interval must fit in the rest.
    assert 0.94 < covered.double().mean().item() < 0.96
    below, above = (true_range < result.range_low).double().mean(), (true_range > result.range_high).double().mean()
    assert 0.02 < below.item() < 0.03
    assert 0.02 < above.item() < 0.03


def test_disparity_at_and_below_zero_is_bearing_only_with_an_open_end() -> None:
    rig = pinhole_rig(1600.0, 10.0)
    disparity = tensor(3.2, 1.3, 1.25, 0.2, 0.0, -0.2, -5.0)
    left = torch.stack([960.0 + disparity, torch.full_like(disparity, 540.0)], -1)
    right = torch.stack([torch.full_like(disparity, 960.0), torch.full_like(disparity, 540.0)], -1)
    result = Localizer(rig, pixel_sigma=0.3)(left, right)
    # 3 sigma of the disparity are 3 * 0.3 * sqrt(2) = 1.27 px; 1.96 sigma are 0.83 px.
    assert torch.isinf(result.range_high).tolist() == [False, False, False, True, True, True, True]
    names = ["OK"] * 2 + ["BEARING_ONLY"] * 2 + ["PARALLEL"] * 3
    assert [PositionStatus(s).name for s in result.status.tolist()] == names
    # Nearest possible: 16 000 px m / (d + 0.83 px); diverging by 5 px no range explains the marks.
    expected = [16_000 / (d + 1.959964 * 0.3 * math.sqrt(2)) for d in (3.2, 1.3, 1.25, 0.2, 0.0, -0.2)]
    # Disparity over focal length is the tangent of the parallax: 1e-5 relative at these angles.
    assert result.range_low[:6].tolist() == pytest.approx(expected, rel=1e-4)
    assert result.range_low[6].item() == math.inf


def test_interval_is_skewed_outward() -> None:
    # Half a pixel of noise in the disparity at 5 km: 95 % is 3.8 to 7.2 km, not 5 ± 1.5.
    f = 1600.0
    low, high = range_interval(tensor(3.2 / (10.0 * f)), tensor(0.5 / (10.0 * f)))
    assert low.item() == pytest.approx(3828, abs=1)
    assert high.item() == pytest.approx(7207, abs=1)


def test_gradients_are_finite_at_infinity() -> None:
    inverse = tensor(1e-4, 0.0, -1e-4).requires_grad_()
    ranges = range_interval(inverse, torch.zeros(3, dtype=torch.float64))[1]
    gradient = torch.autograd.grad(ranges[torch.isfinite(ranges)].sum(), inverse)[0]
    assert gradient[0].item() == pytest.approx(-1e8, rel=1e-5)
    assert gradient[1:].tolist() == [0.0, 0.0]
