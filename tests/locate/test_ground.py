"""One camera: places on level ground and terrain, hidden ones, and errors as large as stated."""

import math
from pathlib import Path

import numpy as np
import pyproj
import pytest
import torch

from kcal import Camera, FileError, InputError, Localizer, Origin, PositionStatus, Rig, locate_points
from kcal.locate import Marks, enu_from_cam, geodetic_to_enu, level_ground, terrain
from kcal.locate.ground import Ground, Raster
from kcal.locate.localizer import Localization
from kcal.rig import Mounting, mounting_covariance, station_rig

CAMERA = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
ORIGIN = Origin(lat=19.07, lon=72.87, height=60.0)


def stands(**more: object) -> Mounting:
    known = {"origin": ORIGIN, "heading_deg": 35.0, "pitch_deg": -2.0, "roll_deg": 1.0, "refraction": 0.0}
    return Mounting(**(known | more))  # type: ignore[arg-type]


def pixels_of(mounting: Mounting, enu: torch.Tensor) -> torch.Tensor:
    return CAMERA.project(enu @ mounting.enu_from_cam)[0]


def on_ground(
    mounting: Mounting, pixels: torch.Tensor, ground: Ground, pixel_sigma: float, sigma: float = 1e-4
) -> Localization:
    """What one camera sees; straight light where its covariance says nothing of it."""
    rig = station_rig({"one": CAMERA}, [mounting], refraction=mounting.refraction, refraction_sigma=0.0)
    return Localizer(rig, pixel_sigma=pixel_sigma)(pixels[:, None], height=ground, height_sigma=sigma)


@pytest.mark.parametrize("distance", [200.0, 1000.0, 5000.0])
def test_a_place_on_the_ellipsoid_is_found_again(distance: float) -> None:
    """Pyproj says where the ground is at that distance: the ellipsoid has fallen 1.96 m at 5 km."""
    lon, lat, _ = pyproj.Geod(ellps="WGS84").fwd(ORIGIN.lon, ORIGIN.lat, 40.0, distance)
    true = geodetic_to_enu(torch.tensor([[lat, lon, 12.0]], dtype=torch.float64), ORIGIN)
    found = on_ground(stands(), pixels_of(stands(), true), level_ground(12.0), 0.02)
    torch.testing.assert_close(found.enu, true, rtol=0, atol=1e-6 * distance)
    # A place on known ground errs along the ground only.
    down = torch.cat([true[0, :2] / 6.35e6, torch.ones(1).double()])
    assert float(down @ found.covariance[0] @ down) < 1e-6 * float(found.covariance[0].diagonal().sum())
    assert found.geodetic[0].tolist() == pytest.approx([lat, lon, 12.0], abs=1e-4)


def test_refraction_lowers_what_is_far() -> None:
    """Bent light comes from lower places: the ground is met nearer."""
    true = torch.tensor([[0.0, 4000.0, 0.0]]).double() @ torch.eye(3).double()
    mark = pixels_of(stands(heading_deg=0.0), true - torch.tensor([0.0, 0.0, 50.0]))
    straight = on_ground(stands(heading_deg=0.0), mark, level_ground(10.0), 0.1)
    bent = on_ground(stands(heading_deg=0.0, refraction=0.5), mark, level_ground(10.0), 0.1)
    lower = 0.5 * 4000.0**2 / 2 / 6.35e6
    slope = 50.0 / 4000.0 - 4000.0 / 6.35e6
    assert float(straight.enu[0, 1] - bent.enu[0, 1]) == pytest.approx(lower / slope, rel=0.1)


def test_refraction_counts_the_level_distance() -> None:
    """Seen steeply from above: light bends by the level distance squared, whatever the height."""
    high = Origin(lat=19.07, lon=72.87, height=5000.0)
    steep = {"origin": high, "heading_deg": 0.0, "pitch_deg": -60.0, "roll_deg": 0.0}
    mark = torch.tensor([[960.0, 540.0]], dtype=torch.float64)
    straight, bent = (on_ground(stands(**steep, refraction=k), mark, level_ground(0.0), 0.1).enu[0] for k in (0.0, 0.5))
    lower = 0.5 * float(straight[1]) ** 2 / 2 / 6.35e6
    # It falls by tan 60° for each meter forward, and the ground by 0.0005.
    assert float(straight[1] - bent[1]) == pytest.approx(lower / math.tan(math.radians(60.0)), rel=0.01)


def test_errors_are_as_large_as_stated() -> None:
    generator = torch.Generator().manual_seed(0)
    known = mounting_covariance(origin_m=(0.5, 0.5, 0.3), attitude_deg=(0.01, 0.01, 0.02))
    true = geodetic_to_enu(torch.tensor([[19.076, 72.874, 12.0]], dtype=torch.float64), ORIGIN)
    mounting = stands(covariance=torch.block_diag(known, torch.zeros(1, 1).double()))
    stated = on_ground(mounting, pixels_of(mounting, true), level_ground(12.0), 0.5, 0.4)
    marks, places = [], []
    for _ in range(400):
        error = known.diagonal().sqrt() * torch.randn(6, generator=generator).double()
        # The true camera stands and looks otherwise; the ground has another height.
        turn = enu_from_cam(35.0, -2.0, 1.0)
        angle = torch.linalg.matrix_exp(torch.tensor([[0, -error[5], error[4]], [error[5], 0, -error[3]],
                                                      [-error[4], error[3], 0]]).double())  # fmt: skip
        height = 12.0 + 0.4 * torch.randn((), generator=generator).item()
        real = geodetic_to_enu(torch.tensor([[19.076, 72.874, height]], dtype=torch.float64), ORIGIN)
        noise = 0.5 * torch.randn(1, 2, generator=generator).double()
        marks.append(CAMERA.project((real - error[:3]) @ angle @ turn)[0] + noise)
        places.append(real)
    found = on_ground(mounting, torch.cat(marks), level_ground(12.0), 0.5).enu
    found = found - torch.cat(places)
    ratio = torch.linalg.eigvals(torch.linalg.solve(stated.covariance[0, :2, :2], torch.cov(found.T)[:2, :2])).real
    assert float(ratio.min()) > 0.8
    assert float(ratio.max()) < 1.25
    assert float(stated.range_low) < float(torch.linalg.vector_norm(true)) < float(stated.range_high)


def raster_file(folder: Path) -> Path:
    """Flat at 10 m, with a ridge of 60 m that runs east and west 500 m north, and a hole without heights beyond."""
    rasterio = pytest.importorskip("rasterio")
    heights = np.full((300, 100), 10.0, dtype=np.float32)
    heights[194:206] = 60.0
    heights[:40] = -9999.0
    x, y = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32643", always_xy=True).transform(ORIGIN.lon, ORIGIN.lat)
    transform = rasterio.transform.from_origin(x - 500.0, y + 2500.0, 10.0, 10.0)
    path = folder / "terrain.tif"
    with rasterio.open(path, "w", driver="GTiff", height=300, width=100, count=1, dtype="float32", crs="EPSG:32643",
                       transform=transform, nodata=-9999.0) as file:  # fmt: skip
        file.write(heights, 1)
    return path


def test_a_ridge_hides_what_is_behind_it(tmp_path: Path) -> None:
    ground = terrain(raster_file(tmp_path))
    level = stands(heading_deg=0.0, pitch_deg=0.0, roll_deg=0.0)
    # The camera is at 60 m. Down to the plain before the ridge; toward the plain behind it; into the sky.
    true = torch.tensor([[0.0, 300.0, -50.0], [0.0, 1000.0, -50.0], [0.0, 1000.0, 50.0]]).double()
    found = on_ground(level, pixels_of(level, true), ground, 0.3)
    assert found.status.tolist() == [0, 0, 6]
    assert float(found.enu[0, 1]) == pytest.approx(300.0, abs=1.0)
    assert 430.0 < float(found.enu[1, 1]) < 450.0, "the near slope of the ridge"
    assert found.range_high[2] == math.inf
    plain = on_ground(level, pixels_of(level, true), level_ground(10.0), 0.3)
    assert float(plain.enu[1, 1]) == pytest.approx(1000.0, rel=0.01)


def test_ground_in_the_first_cell_is_found(tmp_path: Path) -> None:
    """Of a coarse raster, in cells of a kilometer; nothing where it buries the camera."""
    (tmp_path / "flat.asc").write_text(
        "ncols 9\nnrows 9\nxllcorner 72.83\nyllcorner 19.03\ncellsize 0.01\n" + ("10 " * 9 + "\n") * 9
    )
    pixels = pixels_of(stands(), torch.tensor([[200.0, 250.0, -50.0]]).double())
    flat = on_ground(stands(), pixels, terrain(tmp_path / "flat.asc"), 0.3)
    torch.testing.assert_close(flat.enu, on_ground(stands(), pixels, level_ground(10.0), 0.3).enu, rtol=0, atol=1e-3)
    assert on_ground(stands(), pixels, terrain(tmp_path / "flat.asc", 51.0), 0.3).status.tolist() == [6]


def test_a_crest_of_one_row_of_cells_is_met(tmp_path: Path) -> None:
    """By lines of sight that pass below it for less than a cell; of a map whose meters are half as long, too."""
    grid = "ncols 9\nnrows 60\ncellsize {}\nxllcorner {}\nyllcorner {}\n" + "10 10 10 10 10 10 10 10 10\n" * 29
    rows = grid + "48 48 48 48 48 48 48 48 48\n" + "10 10 10 10 10 10 10 10 10\n" * 30
    (tmp_path / "degrees.asc").write_text(rows.format(0.001, ORIGIN.lon - 0.0045, ORIGIN.lat - 0.0235))
    north = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(ORIGIN.lon, ORIGIN.lat)
    (tmp_path / "map.asc").write_text(rows.format(100.0, north[0] - 450.0, north[1] - 2350.0))
    (tmp_path / "map.prj").write_text(pyproj.CRS("EPSG:3857").to_wkt())
    level = stands(heading_deg=0.0, pitch_deg=0.0, roll_deg=0.0)
    # The crest is 7 cells to the north; the camera is at 60 m.
    true = torch.tensor([[0.0, 600.0, -up] for up in (12.5, 13.5, 15.0, 18.0, 21.0)]).double()
    for name, cell in (("degrees.asc", 110.7), ("map.asc", 100.0 * math.cos(math.radians(ORIGIN.lat)))):
        ground = terrain(tmp_path / name)
        assert ground.cell_m == pytest.approx(min(cell, 105.3), rel=0.02)
        found = on_ground(level, pixels_of(level, true), ground, 0.3)
        far = 7.0 * cell
        assert found.status.tolist() == [0] * 5
        assert bool((found.enu[:, 1] - far).abs().lt(cell).all()), found.enu[:, 1]


def test_ground_on_both_sides_of_the_antimeridian(tmp_path: Path) -> None:
    """As GDAL writes it, to longitudes beyond 180°, and with longitudes of 0 to 360°."""
    for first, lons in ((179.5, (179.9, -179.9)), (-180.5, (179.9, -179.9)), (355.0, (-4.9, 355.1))):
        (tmp_path / "both.asc").write_text(
            f"ncols 10\nnrows 10\nxllcorner {first}\nyllcorner -17.5\ncellsize 0.1\n" + ("7 " * 10 + "\n") * 10
        )
        (tmp_path / "both.prj").write_text(pyproj.CRS("EPSG:4326").to_wkt())
        ground = terrain(tmp_path / "both.asc")
        assert ground(torch.full((2,), -17.0).double(), torch.tensor(lons).double()).tolist() == pytest.approx([7, 7])


def test_a_fine_raster_is_searched_no_farther_than_it_reaches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A window of a few cells of a decimeter is no table of 600,000 places for each line of sight."""
    (tmp_path / "fine.asc").write_text(
        f"ncols 9\nnrows 9\nxllcorner {ORIGIN.lon}\nyllcorner {ORIGIN.lat}\ncellsize 0.000001\n"
        + ("10 " * 9 + "\n") * 9
    )
    sizes: list[int] = []
    asked = Raster.cells
    monkeypatch.setattr(Raster, "cells", lambda self, lat, lon: sizes.append(lat.size) or asked(self, lat, lon))
    assert on_ground(stands(), torch.zeros(1, 2).double(), terrain(tmp_path / "fine.asc"), 0.3).status.tolist() == [6]
    assert 0 < max(sizes) < 5000


def test_a_camera_below_the_terrain_or_beside_it_is_named(tmp_path: Path) -> None:
    """In place of "only the bearing is known", which is true of a place in the sky as well."""
    rig = station_rig({"one": CAMERA}, [stands(pitch_deg=0.0)], refraction=0.0, refraction_sigma=0.0)
    marks = Marks(names=["low", "sky"], pixels=torch.tensor([[[960.0, 640.0]], [[960.0, 100.0]]]).double())
    (tmp_path / "flat.asc").write_text(
        "ncols 3\nnrows 3\nxllcorner 72.8\nyllcorner 19.0\ncellsize 0.05\n" + ("60 " * 3 + "\n") * 3
    )
    (tmp_path / "away.asc").write_text("ncols 2\nnrows 2\nxllcorner 7\nyllcorner 45\ncellsize 0.05\n60 60\n60 60\n")

    def why(name: str, geoid: float) -> list[str]:
        found = locate_points(rig, marks, ground=terrain(tmp_path / name, geoid), height=(0.0, 1.0))
        assert [PositionStatus(k) for k in found.columns.status] != [PositionStatus.OK, PositionStatus.OK]
        return [reason.partition(": ")[2] for reason in found.columns.reasons]

    below = "camera one stands 12.5 m below the terrain: is its height above the ellipsoid, as the terrain's is?"
    assert why("flat.asc", 12.5) == [below, below]
    beside = "camera one stands where the terrain has no height: does the terrain cover its latitude and longitude?"
    assert why("away.asc", 0.0) == [beside, beside]
    low, sky = why("flat.asc", -12.5)
    assert (low, "one camera" in sky) == ("", True)


def test_unknown_ground_is_not_guessed(tmp_path: Path) -> None:
    """Over the ridge, into the hole of the raster."""
    ground = terrain(raster_file(tmp_path))
    level = stands(heading_deg=0.0, pitch_deg=0.0, roll_deg=0.0)
    true = torch.tensor([[0.0, 2000.0, 1.0]]).double()
    assert on_ground(level, pixels_of(level, true), ground, 1.0).status.tolist() == [6]
    assert terrain(raster_file(tmp_path), geoid_height=-60.0)(
        torch.tensor([ORIGIN.lat]).double(), torch.tensor([ORIGIN.lon]).double()
    ).tolist() == [-50.0]


def test_heights_are_interpolated_between_the_centers_of_cells(tmp_path: Path) -> None:
    """To the centers of the outermost cells, and no farther."""
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "four.tif"
    transform = rasterio.transform.from_origin(72.0, 19.0, 0.1, 0.1)
    with rasterio.open(path, "w", driver="GTiff", height=3, width=2, count=1, dtype="float32", crs="EPSG:4326",
                       transform=transform) as file:  # fmt: skip
        file.write(np.array([[1.0, 2.0], [3.0, 5.0], [7.0, 11.0]], dtype=np.float32), 1)
    # Just inside the centers at the northwest and the southeast, in the middle, and just beyond the centers.
    lat = [18.95 - 1e-9, 18.75 + 1e-9, 18.90, 18.95 + 1e-6, 18.75 - 1e-6, 18.90, 18.90]
    lon = [72.05 + 1e-9, 72.15 - 1e-9, 72.10, 72.10, 72.10, 72.05 - 1e-6, 72.15 + 1e-6]
    found = terrain(path)(*torch.tensor([lat, lon], dtype=torch.float64))
    assert found[:3].tolist() == pytest.approx([1.0, 11.0, 2.75], abs=1e-6)
    assert found[3:].isnan().all()


@pytest.mark.parametrize(
    ("scale", "offset", "unit", "crs", "meters"),
    [
        (0.1, 0.0, None, "EPSG:4326", 0.1), (1.0, 3.0, "metre", "EPSG:4326", 1.0),
        (1.0, 0.0, "feet", "EPSG:4326", 0.3048), (1.0, 0.0, "US survey foot", "EPSG:4326", 1200 / 3937),
        (1.0, 0.0, "", "EPSG:4326+8228", 0.3048), (1.0, 0.0, "m", "EPSG:4326+5703", 1.0),
    ],
)  # fmt: skip
def test_scale_offset_and_unit_of_a_raster(
    scale: float, offset: float, unit: str | None, crs: str, meters: float, tmp_path: Path
) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "four.tif"
    transform = rasterio.transform.from_origin(72.0, 19.0, 0.1, 0.1)
    system = pyproj.CRS(crs).to_wkt()
    with rasterio.open(path, "w", driver="GTiff", height=2, width=2, count=1, dtype="int16", crs=system,
                       transform=transform) as file:  # fmt: skip
        file.write(np.array([[100, 200], [300, 400]], dtype=np.int16), 1)
        file.scales, file.offsets = (scale,), (offset,)
        if unit is not None:
            file.units = (unit,)
    place = torch.tensor([[18.9], [72.1]], dtype=torch.float64)
    if "+" in crs:
        with pytest.raises(InputError, match=r"above the sea \(NAVD88 height.*\): give the height of the geoid"):
            terrain(path)
    assert terrain(path, 7.0)(*place).tolist() == pytest.approx([7.0 + (offset + 250.0) * meters])


def test_heights_in_no_unit_of_length_are_refused(tmp_path: Path) -> None:
    with pytest.importorskip("rasterio").open(raster_file(tmp_path), "r+") as file:
        file.units = ("kelvin",)
    with pytest.raises(FileError, match="in 'kelvin', which is no known unit of length"):
        terrain(tmp_path / "terrain.tif")


def test_a_flat_line_of_sight_is_a_bearing_only() -> None:
    level = stands(pitch_deg=0.0, roll_deg=0.0)
    grazing = torch.tensor([[960.0, 549.0], [5000.0, 700.0], [math.nan, 0.0]]).double()
    found = on_ground(level, grazing, level_ground(58.0), 4.0)
    assert found.status.tolist() == [6, 5, 4]
    assert all(bool(torch.isfinite(value).all()) for value in (found.enu, found.geodetic, found.bearing))
    assert found.bearing[2].tolist() == [0.0, 0.0, 0.0]


def test_impossible_values() -> None:
    with pytest.raises(InputError, match="height_sigma"):
        on_ground(stands(), torch.zeros(1, 2), level_ground(0.0), 1.0, 0.0)
    with pytest.raises(InputError, match="ground height"):
        level_ground(math.nan)


def test_a_file_that_is_no_raster(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    path = tmp_path / "terrain.tif"
    path.write_text("no raster")
    with pytest.raises(FileError, match="cannot be read"):
        terrain(path)


def test_what_two_cameras_see_needs_no_ground(tmp_path: Path) -> None:
    ground = terrain(raster_file(tmp_path))
    look = enu_from_cam(0.0).T
    centers = torch.tensor([[0.0, 0, 0], [200.0, 0, 0]], dtype=torch.float64)
    rig = Rig([CAMERA] * 2, ["a", "b"], torch.stack([look, look]), center=centers, origin=ORIGIN, refraction=0.2)
    rig.root = rig.with_errors(position_m=(0.5, 0.5, 0.3), attitude_deg=(0.01, 0.01, 0.02), refraction=0.1)
    # The plain, the ridge, unknown ground over it, the sky.
    aims = [[0.0, 300, -50], [40, 700, -50], [0, 1000, -50], [0, 2000, 1], [0, 1000, 50]]
    marks = torch.full((6, 2, 2), math.nan, dtype=torch.float64)
    marks[:5, 0] = CAMERA.project(torch.tensor(aims, dtype=torch.float64) @ look.T)[0]
    marks[5] = rig(torch.tensor([[20.0, 900.0, -10.0]]))[0][0]
    found = Localizer(rig, pixel_sigma=0.3)(marks, height=ground, height_sigma=2.0)
    assert found.status.tolist() == [0, 0, 0, 6, 6, 0]
    without = Localizer(rig, pixel_sigma=0.3)(marks)
    assert without.status.tolist() == [6, 6, 6, 6, 6, 0]
    torch.testing.assert_close(found.enu[5], without.enu[5])


def test_a_place_follows_the_stated_height() -> None:
    """The slope is along the ellipsoid's own normal there: that of a sphere is off by 2.4e-6."""
    rig = station_rig({"one": CAMERA}, [stands(pitch_deg=-12.0)], refraction_sigma=0.0)
    pixels = torch.tensor([[[700.0, 600.0]], [[1300.0, 400.0]]]).double()
    height = torch.tensor([-400.0, -900.0], dtype=torch.float64).requires_grad_()
    localize = Localizer(rig)
    (slope,) = torch.autograd.grad(localize(pixels, height=height).enu.norm(dim=-1).sum(), height)
    higher, lower = (localize(pixels, height=height.detach() + by).enu.norm(dim=-1) for by in (0.1, -0.1))
    torch.testing.assert_close(slope, (higher - lower) / 0.2, rtol=1e-6, atol=0)
