"""Geodesy and datums."""

import math
import struct
from pathlib import Path

import numpy as np
import onnxruntime
import pyproj
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from locate_rigs import tensor

from kcal import FileError, InputError, KcalWarning, Origin
from kcal.lens import save_onnx
from kcal.lens.pose import enu_from_cam
from kcal.locate.geodesy import (
    anchor,
    arc_tangent,
    azimuth_elevation,
    ecef_to_geodetic,
    enu_to_geodetic,
    geodetic_to_ecef,
    geodetic_to_enu,
    place_enu,
)
from kcal.locate.tabulate import find_geoid, geoid_column, true_from_grid

ORIGINS = [
    Origin(lat=0.0, lon=0.0, height=0.0),
    Origin(lat=19.07, lon=72.87, height=14.0),
    Origin(lat=-33.9, lon=151.2, height=250.0),
    Origin(lat=80.0, lon=-179.999, height=-20.0),
    Origin(lat=-80.0, lon=180.0, height=3000.0),
]


def test_attitude_conventions() -> None:
    right, down, forward = 0, 1, 2
    north = enu_from_cam(0.0)
    assert torch.allclose(north, tensor([1, 0, 0], [0, 0, 1], [0, -1, 0]), atol=1e-15)
    # Heading 90 looks east; its right hand is south.
    east = enu_from_cam(90.0)
    assert torch.allclose(east[:, forward], tensor(1, 0, 0), atol=1e-15)
    assert torch.allclose(east[:, right], tensor(0, -1, 0), atol=1e-15)
    # Pitch raises the view: 30 degrees up has sin 30 of up.
    assert enu_from_cam(0.0, 30.0)[:, forward].tolist() == pytest.approx([0, math.sqrt(0.75), 0.5], abs=1e-15)
    assert enu_from_cam(123.0, 30.0)[2, forward].item() == pytest.approx(0.5, abs=1e-15)
    # Roll clockwise as seen from behind: the right side goes down, the axis stays.
    rolled = enu_from_cam(0.0, 0.0, 30.0)
    assert rolled[:, right].tolist() == pytest.approx([math.sqrt(0.75), 0, -0.5], abs=1e-15)
    assert torch.allclose(rolled[:, forward], north[:, forward], atol=1e-15)
    assert rolled[:, down].tolist() == pytest.approx([-0.5, 0, -math.sqrt(0.75)], abs=1e-15)


@given(st.floats(-360, 360), st.floats(-89.9, 89.9), st.floats(-180, 180))
def test_attitude_is_a_rotation_whose_axis_has_the_heading_and_pitch(heading: float, pitch: float, roll: float) -> None:
    rotation = enu_from_cam(heading, pitch, roll)
    assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-14)
    assert torch.linalg.det(rotation).item() == pytest.approx(1.0, abs=1e-14)
    azimuth, elevation = azimuth_elevation(rotation[:, 2]).tolist()
    # Azimuths lose digits towards the zenith: 1 / cos(89.9°) = 573.
    assert math.sin(math.radians(azimuth - heading)) == pytest.approx(0.0, abs=1e-12)
    assert elevation == pytest.approx(pitch, abs=1e-10)


@pytest.mark.parametrize("angles", [(math.nan, 0, 0), (361, 0, 0), (0, 91, 0), (0, 0, math.inf)])
def test_bad_angles_are_refused(angles: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="degrees between"):
        enu_from_cam(*angles)


def around(distance: float) -> torch.Tensor:
    azimuth = torch.deg2rad(torch.arange(0, 360, 15, dtype=torch.float64))
    up = torch.linspace(-200, 400, len(azimuth), dtype=torch.float64)
    return torch.stack([distance * azimuth.sin(), distance * azimuth.cos(), up], -1)


@pytest.mark.parametrize("lat", [-85.0, -60.0, -33.9, 0.0, 19.07, 45.0, 85.0])
@pytest.mark.parametrize("lon", [-180.0, -179.999, 0.0, 72.87, 179.999])
def test_positions_agree_with_proj(lat: float, lon: float) -> None:
    origin = Origin(lat=lat, lon=lon, height=120.0)
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={lat!r} +lon_0={lon!r} +h_0=120.0"
    )
    for distance in (0.0, 100.0, 5000.0, 10_000.0):
        enu = around(distance)
        geodetic = enu_to_geodetic(enu, origin)
        latitudes, longitudes, heights = geodetic.numpy().T
        by_proj = np.stack(pipeline.transform(longitudes, latitudes, heights), -1)
        # The requirement is 1e-6 m; ECEF coordinates hold 1e-9 m.
        assert np.abs(by_proj - enu.numpy()).max() < 2e-8
        assert bool(((longitudes >= -180) & (longitudes < 180)).all())
        assert (geodetic_to_enu(geodetic, origin) - enu).abs().max() < 2e-8


def test_gradients_of_the_closed_form_also_at_a_pole() -> None:
    origin = Origin(lat=60.0, lon=25.0, height=0.0)
    enu = tensor([300.0, -2000.0, 50.0], [0.0, 0.0, 0.0]).requires_grad_()
    scale = tensor(1e5, 1e5, 1.0)
    home = origin.geodetic
    # Degrees hold 1e-14: with steps of 1 m that is 1e-9 of a slope in meters.
    assert torch.autograd.gradcheck(
        lambda p: (enu_to_geodetic(p, origin) - home) * scale, enu, eps=1.0, rtol=1e-3, atol=1e-4
    )
    pole = tensor([0.0, 0.0, 6_356_752.3142 + 10.0]).requires_grad_()
    found = ecef_to_geodetic(pole)
    assert found[0].tolist() == pytest.approx([90.0, 0.0, 10.0], abs=1e-4)
    (gradient,) = torch.autograd.grad(found.sum(), pole)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("height", [-10_000.0, 0.0, 9000.0, 4e5, 3.6e7])
def test_heights_from_the_sea_floor_to_geostationary_orbits(height: float) -> None:
    lat = torch.linspace(-90, 90, 37, dtype=torch.float64)
    geodetic = torch.stack([lat, torch.linspace(-179, 179, 37, dtype=torch.float64), torch.full_like(lat, height)], -1)
    again = ecef_to_geodetic(geodetic_to_ecef(geodetic))
    assert (again - geodetic)[:, 2].abs().max() < 2e-8
    assert (again - geodetic)[1:-1, :2].abs().max() < 1e-12


@pytest.mark.parametrize("origin", ORIGINS, ids=str)
def test_distances_and_azimuths_agree_with_geodesics(origin: Origin) -> None:
    geod = pyproj.Geod(ellps="WGS84")
    on_ellipsoid = Origin(lat=origin.lat, lon=origin.lon, height=0.0)
    azimuths = np.arange(0.0, 360.0, 15.0)
    for distance in (100.0, 5000.0, 10_000.0):
        start = np.full_like(azimuths, origin.lon), np.full_like(azimuths, origin.lat)
        lon, lat, _ = geod.fwd(*start, azimuths, np.full_like(azimuths, distance))
        target = torch.tensor(np.stack([lat, lon, np.zeros_like(lat)], -1))
        enu = geodetic_to_enu(target, on_ellipsoid)
        # The chord is shorter than the geodesic by d³ / 24 R²: 1.03 mm at 10 km.
        chord = distance - distance**3 / (24 * 6.371e6**2)
        assert (enu.norm(dim=-1) - chord).abs().max() < 1e-4
        # Normal-section and geodesic azimuths differ by less than 1e-6 degrees at 10 km: 0.2 mm.
        difference = (azimuth_elevation(enu)[:, 0] - torch.tensor(azimuths) + 180) % 360 - 180
        assert difference.abs().max() < 1e-6


def test_up_is_not_height() -> None:
    # A point 5 km off on the tangent plane is 1.96 m above the ellipsoid (d² / 2 R).
    heights = enu_to_geodetic(around(5000.0) * tensor(1, 1, 0), Origin(lat=19.07, lon=72.87, height=0.0))[:, 2]
    assert heights.tolist() == pytest.approx([1.96] * len(heights), abs=0.02)


def test_longitude_is_normalized_across_the_antimeridian() -> None:
    east = enu_to_geodetic(tensor([5000.0, 0.0, 0.0]), Origin(lat=10.0, lon=179.99, height=0.0))[0, 1].item()
    west = enu_to_geodetic(tensor([-5000.0, 0.0, 0.0]), Origin(lat=10.0, lon=-179.99, height=0.0))[0, 1].item()
    # 5 km is 0.0456 degrees of longitude at 10 degrees north.
    assert east == pytest.approx(-179.9644, abs=1e-4)
    assert west == pytest.approx(179.9644, abs=1e-4)


def test_shapes_and_bad_points() -> None:
    origin = ORIGINS[1]
    assert enu_to_geodetic(torch.zeros(2, 4, 3), origin).shape == (2, 4, 3)
    assert enu_to_geodetic(torch.zeros(3), origin).tolist() == pytest.approx([19.07, 72.87, 14.0], abs=1e-8)
    assert enu_to_geodetic(torch.zeros(0, 3), origin).shape == (0, 3)
    for place in ([[19.07, 72.87, 24.0]], np.array([[19.07, 72.87, 24.0]])):
        assert torch.equal(geodetic_to_enu(place, origin), geodetic_to_enu(tensor(place[0]), origin))
    with pytest.raises(InputError, match="not finite"):
        enu_to_geodetic(tensor([0.0, math.nan, 0.0]), origin)
    for rounded in (torch.tensor([[19.07, 72.87, 14.0]]), np.array([[19.07, 72.87, 14.0]], np.float32)):
        with pytest.raises(InputError, match="float64"):
            geodetic_to_enu(rounded, origin)
    with pytest.raises(InputError, match="latitude, longitude, height"):
        geodetic_to_enu(tensor([[151.2, -33.9, 14.0]])[0], origin)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("19.07,72.87", "three numbers"),
        ("19.07 72.87 14", "three numbers"),
        ("19.07,72.87,14,1", "three numbers"),
        ("19.07N,72.87E,14", "three numbers"),
        ("", "three numbers"),
        ("151.2,-33.9,10", "longitude came first"),
        ("95,120,10", "latitude 95 is outside"),
        ("10,190,0", "write -170"),
        ("10,190.5,0", "write -169.5"),
        ("4319.2162,20,0", "degrees and minutes it is 43.32027"),
        ("10,400,0", "longitude 400 is outside"),
        ("nan,0,0", "finite"),
        ("10,20,inf", "finite"),
        ("10,20,200000", "meters are needed"),
    ],
)
def test_bad_origins_say_what_to_write(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Origin.parse(text)


def test_origin_keeps_every_digit() -> None:
    assert Origin.parse(" -33.856784123456, 151.2152961234 ,-1e1") == Origin(
        lat=-33.856784123456, lon=151.2152961234, height=-10.0
    )


def test_the_arc_tangent_of_exported_graphs_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    angle = torch.cat([torch.linspace(-math.pi, math.pi, 4001), torch.tensor([1e-12, -1e-12, math.pi - 1e-9])]).double()
    length = torch.tensor([1e-3, 1.0, 6e6], dtype=torch.float64)[:, None]
    y, x = length * angle.sin(), length * angle.cos()
    y, x = (torch.cat([a.flatten(), torch.tensor(b).double()]) for a, b in ((y, [0, 1, -1, 0]), (x, [-1, 0, 0, 2])))
    wanted = torch.atan2(y, x)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    assert torch.allclose(arc_tangent(y, x), wanted, rtol=1e-15, atol=1e-300)


class Places(torch.nn.Module):
    def forward(self, enu: torch.Tensor) -> torch.Tensor:
        return place_enu(enu, *anchor(ORIGINS[1]))


def test_places_in_onnxruntime(tmp_path: Path) -> None:
    """It has no arc tangent in float64; and float32 constants would be off by half a meter."""
    enu = 5000.0 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    # The anchor is part of the graph.
    session = onnxruntime.InferenceSession(save_onnx(Places(), enu[:5], tmp_path / "places.onnx"))
    (found,) = session.run(None, {session.get_inputs()[0].name: enu.numpy()})
    apart = geodetic_to_enu(torch.from_numpy(found), ORIGINS[1]) - enu
    assert float(apart.abs().max()) < 1e-8


def grid(path: Path) -> Path:
    """A .gtx file of one degree around 19° N, 73° E: N = -60 m + 10 m for each degree east."""
    header = struct.pack(">4d2i", 18.0, 72.0, 1.0, 1.0, 3, 3)
    rows = [[-70.0, -60.0, -50.0]] * 3
    path.write_bytes(header + b"".join(struct.pack(">3f", *row) for row in rows))
    return path


def test_heights_of_a_grid_and_outside_of_it(tmp_path: Path) -> None:
    geoid = find_geoid(grid(tmp_path / "here.gtx"))
    assert geoid.name == "here"
    heights = geoid_column(geoid, np.array([19.0, 18.5, 50.0]), np.array([73.0, 72.25, 8.0]))
    assert heights[:2] == pytest.approx([-60.0, -67.5], abs=1e-6)
    assert np.isnan(heights[2])


def test_no_grid_and_bad_grids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pyproj.datadir, "get_data_dir", lambda: str(tmp_path))
    monkeypatch.setattr(pyproj.datadir, "get_user_data_dir", lambda *_: str(tmp_path / "none"))
    assert find_geoid() is None
    found = grid(tmp_path / "egm96_15.gtx")
    assert find_geoid() == (found, "egm96_15")
    (tmp_path / "bad.gtx").write_bytes(b"no grid")
    with pytest.raises(FileError, match="cannot read this geoid grid"):
        geoid_column(find_geoid(tmp_path / "bad.gtx"), np.array([19.0]), np.array([73.0]))
    (tmp_path / "grid.txt").write_text("")
    with pytest.raises(FileError, match=r"ends with \.tif"):
        find_geoid(tmp_path / "grid.txt")


def test_grid_north_is_not_true_north() -> None:
    # Mumbai lies west of its zone's central meridian: grid north points west of true north there, by 0.70°.
    mumbai = Origin(lat=19.07, lon=72.87, height=14.0)
    assert true_from_grid(90.0, mumbai, "EPSG:32643") == pytest.approx(89.304, abs=1e-3)
    # Independent of PROJ's factors: the grid azimuth of a short step due north.
    project = pyproj.Proj("EPSG:32643")
    (e0, n0), (e1, n1) = project(72.87, 19.07), project(72.87, 19.0701)
    assert (e1 - e0) / (n1 - n0) == pytest.approx(0.01215, abs=1e-5)
    assert true_from_grid(12.0, Origin(lat=19.07, lon=75.0, height=0.0), "EPSG:32643") == pytest.approx(12.0, abs=1e-9)
    east = Origin(lat=19.07, lon=77.0, height=0.0)
    # Longitudes of these count from Paris (in grads), Bern, Rome, Oslo.
    for crs, lat, lon in (("EPSG:27572", 46.0, 6.5), ("EPSG:21780", 46.5, 9.0), ("EPSG:26591", 45.5, 8.5),
                          ("EPSG:27393", 60.0, 10.8), ("EPSG:2154", 46.0, 6.5)):  # fmt: skip
        grid = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
        x, y = grid.transform(lon, lat)
        north = grid.transform(x, y + 200.0, direction="INVERSE")
        azimuth = pyproj.Geod(ellps="WGS84").inv(lon, lat, *north)[0]
        assert true_from_grid(0.0, Origin(lat=lat, lon=lon, height=0.0), crs) == pytest.approx(azimuth, abs=0.01), crs
    assert true_from_grid(359.9, east, "EPSG:32643") == pytest.approx(0.553, abs=1e-3)
    with pytest.warns(KcalWarning, match=r"longitudes 78 to 84, not for 19.07, 72.87, .* -2.67° from true north"):
        assert true_from_grid(90.0, mumbai, "EPSG:32644") == pytest.approx(87.335, abs=0.01)
    # Areas may contain the antimeridian, or all longitudes.
    for crs, lon in (("EPSG:3832", -170.0), ("EPSG:3395", 72.0)):
        true_from_grid(90.0, Origin(lat=0.0, lon=lon, height=0.0), crs)


@pytest.mark.parametrize(("crs", "message"), [("EPSG:4326", "has no grid"), ("nonsense", "does not know")])
def test_what_has_no_grid_north(crs: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        true_from_grid(0.0, Origin(lat=19.0, lon=73.0, height=0.0), crs)
