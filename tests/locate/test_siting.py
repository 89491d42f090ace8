"""Siting and error budgets of rigs."""

import dataclasses
import itertools
import math
import re
from pathlib import Path

import pytest
import torch
from command_line import Command
from locate_rigs import real_rig, tensor
from torch import Tensor

from kcal import FileError, InputError, Localizer, save_rig
from kcal.lens.rig import REFRACTION_SIGMA, Origin
from kcal.locate import BudgetErrors, level_ground, range_errors, terrain
from kcal.locate.geodesy import anchor, enu_to_geodetic, geodetic_to_enu, mean_radius, place_enu
from kcal.locate.positions import region_outline
from kcal.locate.siting import Area, Site, area_of, rank_sites, read_sites, seen_over, sites_of, siting_map, surface_of
from kcal.rig import planned_rig
from scripts.shared.station_scenes import ORIGIN, marks, ring

# Siting: hidden ground, the map of errors beside `Localizer`, and the order of candidates.


BOUNDS = (44.96, 5.95, 45.04, 6.05)


def hills(lat: Tensor, lon: Tensor) -> Tensor:
    """Rolling ground, 700 to 900 m high, ridges 2 km apart."""
    x, y = (lon - 6.0) * 78_800.0, (lat - 45.0) * 111_100.0
    return 800.0 + 60.0 * torch.sin(x / 640.0) * torch.cos(y / 520.0) + 40.0 * torch.sin((x + y) / 1500.0)


def site(name: str, lat: float, lon: float, mast: float = 30.0, **more: object) -> Site:
    here = torch.tensor([lat], dtype=torch.float64), torch.tensor([lon], dtype=torch.float64)
    return Site(name=name, origin=Origin(lat=lat, lon=lon, height=float(hills(*here)) + mast), **more)  # type: ignore[arg-type]


def test_hidden_ground_is_that_which_a_ray_by_itself_does_not_reach() -> None:
    """Every tenth of a percent of each line of sight, on the ground itself and on the ellipsoid."""
    tower, k = site("mill", 45.0, 6.0), 0.13
    area = area_of(BOUNDS, hills, [tower], cells=60, step=30.0)
    eye = geodetic_to_enu(tower.origin.geodetic, area.origin)
    points, curve = area.points.reshape(-1, 3), 0.5 / mean_radius(45.0)
    found = seen_over(area.surface, eye, points, k * curve)
    share = torch.linspace(0.002, 0.998, 997, dtype=torch.float64)
    lines = eye + share[:, None] * (points - eye)[:, None]
    level = (points - eye)[:, :2].square().sum(-1)[:, None]
    # Bent light runs above the straight line between eye and point.
    lines[..., 2] += k * curve * level * share * (1.0 - share)
    lat, lon, height = place_enu(lines, *anchor(area.origin)).unbind(-1)
    clearance = height - hills(lat, lon)
    near = (1.0 - share) * level.sqrt() < 60.0  # as close to the point as the ground's steps tell nothing
    direct = torch.where(near, math.inf, clearance).amin(-1) > 0
    assert 0.2 < direct.double().mean() < 0.8
    assert (found == direct).double().mean() > 0.97


@pytest.mark.parametrize(("refraction", "horizon"), [(0.0, 35_710.0), (0.13, 38_290.0)])
def test_the_sea_ends_at_the_horizon(refraction: float, horizon: float) -> None:
    """√(2 R h / (1 - k)) of an eye 100 m above it."""
    origin = Origin(lat=45.0, lon=6.0, height=0.0)
    far = torch.arange(30_000.0, 44_000.0, 100.0, dtype=torch.float64)
    surface = surface_of(level_ground(0.0), origin, torch.tensor([-500.0, -500]), torch.tensor([500.0, 45_000]), 50.0)
    there = torch.stack([torch.zeros_like(far), far, surface.at(torch.zeros_like(far), far)], -1)
    eye = torch.tensor([0.0, 0.0, 100.0], dtype=torch.float64)
    seen = seen_over(surface, eye, there, refraction * 0.5 / mean_radius(45.0))
    assert float(far[seen].max()) == pytest.approx(horizon, rel=0.01)
    assert bool((seen == (far <= far[seen].max())).all())


def test_errors_are_those_of_the_localizer() -> None:
    """For a rig whose cameras have nothing in common."""
    rig = ring(3, 6000.0)
    rig.root = rig.with_errors(position_m=0.5, attitude_deg=(0.01, 0.01, 0.05), refraction=REFRACTION_SIGMA)
    sites = sites_of(rig, pixel_sigma=1.0)
    area = area_of((44.99, 5.985, 45.01, 6.015), level_ground(800.0), sites, cells=8)
    found = siting_map(area, sites)
    geodetic = torch.stack([*torch.meshgrid(area.lat, area.lon, indexing="ij"), area.ground], -1)
    located = Localizer(rig, pixel_sigma=1.0)(marks(rig, geodetic_to_enu(geodetic, ORIGIN).reshape(-1, 3)))
    assert bool((located.status == 0).all())
    # Standard refraction is common to all in the localizer, and moves heights alone.
    there = located.covariance[:, :2, :2].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    assert bool(found.sees.all())
    torch.testing.assert_close(found.sigma.flatten(), there, rtol=0.02, atol=0.0)


def test_what_is_outside_an_image_is_not_seen() -> None:
    looking = sites_of(ring(2, 6000.0))[0]
    area = area_of((44.9, 5.9, 45.1, 6.1), level_ground(800.0), [looking], cells=20)
    through_lens = siting_map(area, [looking]).sees[0]
    width = 2 * math.degrees(math.atan(960 / 1600))
    wedge = siting_map(area, [dataclasses.replace(looking, camera=None, field_deg=width)]).sees[0]
    assert 0.05 < wedge.double().mean() < 0.6
    # Near the tower the ground is below the image.
    assert bool((wedge | ~through_lens).all())
    assert (wedge == through_lens).double().mean() > 0.95


def towers() -> tuple[list[Site], list[Site]]:
    standing = [site("mill", 44.965, 5.96), site("mast", 45.035, 5.97)]
    ways = itertools.product((44.965, 45.0, 45.035), (5.98, 6.04))
    return standing, [site(f"place {i + 1}", lat, lon, mast=25.0) for i, (lat, lon) in enumerate(ways)]


def scene(sites: list[Site]) -> Area:
    return area_of(BOUNDS, hills, sites, cells=30, above=20.0)


def test_the_first_site_is_the_best_of_all_and_the_second_the_best_beside_it() -> None:
    standing, candidates = towers()
    area = scene(standing + candidates)
    ranked = rank_sites(area, standing, candidates, build=2)
    means = {c.name: siting_map(area, [*standing, c]).mean_sigma for c in candidates}
    assert [r.order for r in ranked] == [1, 2, None, None, None, None]
    first = min(means, key=lambda name: means[name])
    assert ranked[0].site.name == first
    assert {r.site.name: r.mean_sigma for r in ranked} == pytest.approx(means)
    chosen = next(c for c in candidates if c.name == first)
    after = {c.name: siting_map(area, [*standing, chosen, c]).mean_sigma for c in candidates if c is not chosen}
    assert ranked[1].site.name == min(after, key=lambda name: after[name])
    assert ranked[1].after == pytest.approx(min(after.values()))
    assert ranked[0].covered == pytest.approx(siting_map(area, [*standing, chosen]).covered)
    assert ranked[2].mean_sigma <= ranked[3].mean_sigma


def test_weights_choose_another_site() -> None:
    """What counts lies where one candidate alone looks."""
    standing = [site("mill", 45.0, 6.0, mast=300.0)]
    west, east = (site(name, 45.0, lon, mast=300.0, reach_m=4000.0) for name, lon in (("west", 5.95), ("east", 6.05)))
    area = scene([*standing, west, east])
    half = torch.zeros(area.known.shape, dtype=torch.float64)
    for side, name in ((slice(None, 10), "west"), (slice(-10, None), "east")):
        weights = half.clone()
        weights[:, side] = 1.0
        assert rank_sites(area, standing, [west, east], weights=weights)[0].site.name == name
    with pytest.raises(InputError, match="weights"):
        rank_sites(area, standing, [west], weights=half)


def test_an_open_heading_is_turned_to_what_counts() -> None:
    standing, corner = [site("mill", 45.0, 5.97, mast=400.0)], site("corner", 44.961, 5.951, mast=400.0, field_deg=50.0)
    found = rank_sites(scene([*standing, corner]), standing, [corner])[0]
    assert found.site.heading_deg == pytest.approx(45.0, abs=15.0)
    with pytest.raises(InputError, match="corner: a tower with a field of view of 50° needs a heading"):
        siting_map(scene([corner]), [corner])


def test_a_site_in_the_ground_is_refused() -> None:
    with pytest.raises(InputError, match=r"site cellar: it stands 5\.0 m below the ground"):
        area_of(BOUNDS, hills, [site("cellar", 45.0, 6.0, mast=-5.0)], cells=50, step=20.0)


def test_unknown_ground_is_no_part_of_the_area() -> None:
    def half(lat: Tensor, lon: Tensor) -> Tensor:
        return torch.where(lon > 6.0, math.nan, 100.0)

    tower = Site(name="mill", origin=Origin(lat=45.0, lon=5.96, height=150.0))
    area = area_of(BOUNDS, half, [tower], cells=20)
    found = siting_map(area, [tower])
    east = area.lon > 6.0
    assert bool(found.sigma[:, east].isnan().all())
    assert bool(found.sigma[:, ~east].isfinite().all())
    assert not bool(found.sees[:, :, east].any())
    with pytest.raises(InputError, match="the terrain has no height there"):
        area_of(BOUNDS, lambda lat, lon: torch.full_like(lat, math.nan))


def test_an_area_may_cross_the_antimeridian() -> None:
    tower = Site(name="mill", origin=Origin(lat=-17.0, lon=179.98, height=100.0))
    area = area_of((-17.05, 179.95, -16.95, -179.95), level_ground(0.0), [tower], cells=20)
    plain = area_of((-17.05, 0.95, -16.95, 1.05), level_ground(0.0), cells=20)
    torch.testing.assert_close(area.points, plain.points)
    assert bool(siting_map(area, [tower]).sees.all())


def test_tables_of_sites(tmp_path: Path) -> None:
    path = tmp_path / "sites.csv"
    path.write_text("name,lat,lon,height,mast,field,sigma\nmill,45,6,900,,,\nmast,45,6.01,,30,60,0.2\n")
    mill, mast = read_sites(path, hills)
    assert (mill.origin.height, mill.field_deg, mill.sigma_deg) == (900.0, 360.0, 0.05)
    assert mast == site("mast", 45.0, 6.01, mast=30.0, field_deg=60.0, sigma_deg=0.2)
    with pytest.raises(FileError, match="line 3: 'mast' has a mast, and no terrain was given"):
        read_sites(path)
    path.write_text("name,lat,lon,height,sigma\nmill,45,6,900,-1\n")
    with pytest.raises(FileError, match="line 2: site mill: sigma -1"):
        read_sites(path)
    path.write_text("name,lat,lon\nmill,45,6\n")
    with pytest.raises(FileError, match="needs a height"):
        read_sites(path)


def grid(folder: Path, head: str, body: str = "1 2\n3 5\n7 11\n") -> Path:
    path = folder / "grid.asc"
    path.write_text(head + body)
    return path


def test_ascii_grids_need_no_other_package(tmp_path: Path) -> None:
    head = "NCOLS 2\nNROWS 3\nXLLCORNER 72.0\nYLLCORNER 18.7\nCELLSIZE 0.1\nNODATA_value -9999\n"
    ground = terrain(grid(tmp_path, head), geoid_height=10.0)
    lat, lon = [18.95 - 1e-9, 18.75 + 1e-9, 18.90, 19.0], [72.05 + 1e-9, 72.15 - 1e-9, 72.10, 72.10]
    found = ground(*torch.tensor([lat, lon], dtype=torch.float64))
    assert found[:3].tolist() == pytest.approx([11.0, 21.0, 12.75], abs=1e-6)
    assert found[3].isnan()
    assert ground.cell_m == pytest.approx(0.1 * 111_200 * math.cos(math.radians(18.85)), rel=0.01)
    centers = head.replace("CORNER 72.0", "CENTER 72.05").replace("CORNER 18.7", "CENTER 18.75")
    again = terrain(grid(tmp_path, centers), geoid_height=10.0)(*torch.tensor([lat, lon], dtype=torch.float64))
    torch.testing.assert_close(again, found, equal_nan=True, rtol=0, atol=1e-6)
    empty = terrain(grid(tmp_path, head, "1 2\n3 5\n7 -9999\n"))
    assert empty(*torch.tensor([lat, lon], dtype=torch.float64)).isnan().tolist() == [False, True, False, True]
    # As GDAL writes a raster that marks what is not known with NaN.
    empty = terrain(grid(tmp_path, head.replace("-9999", "nan"), "1 2\n3 5\n7 nan\n"))
    assert empty(*torch.tensor([lat, lon], dtype=torch.float64)).isnan().tolist() == [False, True, False, True]


def test_ascii_grids_in_meters_need_their_coordinate_system(tmp_path: Path) -> None:
    import pyproj

    head = "ncols 2\nnrows 3\nxllcorner 275000\nyllcorner 2110000\ncellsize 10\n"
    path = grid(tmp_path, head)
    with pytest.raises(FileError, match="put the coordinate system beside it as"):
        terrain(path)
    (tmp_path / "grid.prj").write_text(pyproj.CRS("EPSG:32643").to_wkt("WKT1_ESRI"))
    ground = terrain(path)
    lon, lat = pyproj.Transformer.from_crs("EPSG:32643", "EPSG:4326", always_xy=True).transform(275_010.0, 2_110_020.0)
    assert ground(*torch.tensor([[lat], [lon]], dtype=torch.float64)).tolist() == pytest.approx([2.75], abs=1e-3)
    scale = pyproj.Proj("EPSG:32643").get_factors(lon, lat).meridional_scale
    assert ground.cell_m == pytest.approx(10.0 / scale, rel=1e-6)
    for wrong, text in (
        (head.replace("nrows 3", "nrows 4"), "6 heights"), (head.replace("ncols 2\n", ""), "the line ncols"),
        (head.replace("cellsize 10", "cellsize"), "no line of"), (head + "hill\n", "must be numbers"),
    ):  # fmt: skip
        with pytest.raises(FileError, match=text):
            terrain(grid(tmp_path, wrong))


def test_ascii_grids_outside_the_earth(tmp_path: Path) -> None:
    import pyproj

    head = "ncols 2\nnrows 3\nxllcorner 6\nyllcorner {}\ncellsize {}\n"
    (tmp_path / "grid.prj").write_text(pyproj.CRS("EPSG:4326").to_wkt("WKT1_ESRI"))
    assert terrain(grid(tmp_path, head.format(88.4, 1))).cell_m == pytest.approx(194, abs=1)
    with pytest.raises(FileError, match=r"its middle row lies at latitude 91\.5:"):
        terrain(grid(tmp_path, head.format(90, 1)))
    (tmp_path / "grid.prj").write_text(pyproj.CRS("EPSG:32643").to_wkt("WKT1_ESRI"))
    with pytest.raises(FileError, match="no size on the ground"):
        terrain(grid(tmp_path, head.format(90, 1e-200)))


def test_positions_of_sites_are_those_of_the_rig() -> None:
    rig = ring(3, 6000.0)
    there = enu_to_geodetic(rig.center, ORIGIN)
    found = torch.stack([one.origin.geodetic for one in sites_of(rig)])
    torch.testing.assert_close(found, there, rtol=0, atol=1e-8)


# The paper's Table 2, and what is exact beside it.


SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"

# Disparity in px, ΔZ at 1 km and 5 km as printed in the paper.
TABLE_2 = [(2.0, 125.0, 3125.0), (1.0, 62.5, 1562.5), (0.5, 31.25, 781.25), (0.1, 6.25, 156.25)]


@pytest.mark.parametrize(("disparity", "at_1_km", "at_5_km"), TABLE_2)
def test_table_2_and_the_exact_values_beside_it(disparity: float, at_1_km: float, at_5_km: float) -> None:
    found = range_errors(planned_rig(), [1000.0, 5000.0], BudgetErrors(disparity_px=disparity))["disparity"]
    assert found.first_order.tolist() == pytest.approx([at_1_km, at_5_km], rel=1e-5)
    # f B = 16 000 px m: Z = 16 000 / d, by hand.
    for i, (z, d) in enumerate(((1000.0, 16.0), (5000.0, 3.2))):
        assert found.nearer[i].item() == pytest.approx(16_000 / (d + disparity) - z, rel=1e-6)
        assert found.farther[i].item() == pytest.approx(16_000 / (d - disparity) - z, rel=1e-6)
        assert found.nearer[i].abs() < found.first_order[i] < found.farther[i]


def test_two_pixels_at_5_km_are_eight_kilometers_and_four_are_beyond_infinity() -> None:
    found = range_errors(planned_rig(), [5000.0], BudgetErrors(disparity_px=2.0))["disparity"]
    assert (found.nearer.item(), found.farther.item()) == pytest.approx((-1923.1, 8333.3), abs=0.1)
    found = range_errors(planned_rig(), [5000.0], BudgetErrors(disparity_px=4.0))["disparity"]
    assert found.farther.item() == math.inf


def test_the_other_sources_by_hand() -> None:
    found = range_errors(planned_rig(), [1000.0, 5000.0])
    turn = math.radians(0.01)
    # The parallax is atan(B / Z); a turn adds to it.
    for i, z in enumerate((1000.0, 5000.0)):
        angle = math.atan(10 / z)
        assert found["yaw"].farther[i].item() == pytest.approx(10 / math.tan(angle - turn) - z, rel=1e-6)
        assert found["yaw"].nearer[i].item() == pytest.approx(10 / math.tan(angle + turn) - z, rel=1e-6)
    assert found["yaw"].first_order[1].item() == pytest.approx(436.3, abs=0.1)
    assert found["baseline"].farther.tolist() == pytest.approx([0.1, 0.5], rel=1e-6)
    # 0.2 m of motion during 10 ms in 10 m of baseline: 2 %.
    assert found["timing"].first_order.tolist() == pytest.approx([20.0, 100.0], rel=1e-4)
    assert found["timing"].farther.tolist() == pytest.approx([1000 / 0.98 - 1000, 5000 / 0.98 - 5000], rel=1e-4)


def test_a_calibrated_rig_with_lenses() -> None:
    rig = real_rig()
    found = range_errors(rig, [500.0, 4000.0])
    # About its f B, some 16 000 px m.
    assert found["disparity"].first_order[1].item() == pytest.approx(4000**2 / 16_000 * 0.1, rel=0.05)
    aside = range_errors(rig, [4000.0], pixel=(300.0, 500.0))["disparity"].first_order.item()
    assert aside != pytest.approx(found["disparity"].first_order[1].item(), rel=0.02)


def test_bad_arguments() -> None:
    for distances in ([], [0.0], [math.nan]):
        with pytest.raises(InputError, match="distances"):
            range_errors(planned_rig(), distances)
    with pytest.raises(InputError, match="does not see"):
        range_errors(planned_rig(), [1.0])
    with pytest.raises(InputError, match="not in the image"):
        range_errors(planned_rig(), [100.0], pixel=(-50.0, 0.0))
    with pytest.raises(InputError, match="yaw_deg"):
        BudgetErrors(yaw_deg=-1.0)
    with pytest.raises(InputError, match="larger than the baseline"):
        range_errors(planned_rig(), [100.0], BudgetErrors(baseline_m=20.0))


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.chdir(tmp_path)
    printed = command("budget --pixel-sigma 1.414213562373095 --picture budget.png").out
    assert "f B 16000 px m" in printed
    line = next(line for line in printed.splitlines() if line.split()[:2] == ["5", "km"])
    assert line.split()[-6:] == ["-1920", "m", "+8330", "m", "+3120", "m"]
    assert Path("budget.png").read_bytes().startswith(b"\x89PNG")
    save_rig(real_rig(), "rig.json")
    assert "rig.json: baseline 10.0" in command("budget rig.json --distances 500").out
    printed = command("budget", SAMPLE, "--distances 1000,5000").out
    table = printed.split("What the rig file knows, and 0.1 px of noise in each mark:")[1].splitlines()
    assert table[3].startswith("5 km ")
    total, marks, lenses, pose, sideways = map(float, re.findall(r"(\S+) m", table[3].removeprefix("5 km")))
    assert marks == pytest.approx(math.sqrt(2) * 0.1 * 5000**2 / 16_000, rel=0.1)
    assert total == pytest.approx(math.hypot(marks, lenses, pose), rel=0.03)
    assert min(pose, sideways) > 0
    assert "a positive number of pixels" in command("budget", SAMPLE, "--pixel-sigma 0", code=1).err
    printed = command("budget --baseline 0.08").out
    ranges = [line.strip().split("  ")[0] for line in printed.splitlines() if "disparity" in line]
    assert [float(text.removesuffix(" m")) for text in ranges] == [1, 2.5, 5, 10, 25, 50]
    assert "distances 'near'" in command("budget --distances near", code=1).err


# The 95 % region on the map: its shape, its share and its sense.


# East, north; not along an axis, and an ellipse that is oblique to the line of sight.
PLACE = tensor(1500.0, 2500.0, 40.0)

OBLIQUE = tensor([4.0, 3.0, 0.5], [3.0, 9.0, 0.2], [0.5, 0.2, 1.0])


def area(ring: Tensor) -> float:
    """Positive if counterclockwise."""
    x, y = ring.unbind(-1)
    return float(0.5 * (x * y.roll(-1) - y * x.roll(-1)).sum())


@pytest.mark.parametrize("place", [PLACE, PLACE * tensor(-1.0, 1.0, 1.0), tensor(0.0, 3000.0, 0.0)])
def test_small_errors_give_the_usual_ellipse(place: Tensor) -> None:
    apart = region_outline(place, OBLIQUE) - place[:2]
    distance = (apart @ torch.linalg.inv(OBLIQUE[:2, :2]) * apart).sum(-1)
    # -2 ln(1 - 0.95); the skewness is some sigma over the distance, 1e-3.
    assert distance.tolist() == pytest.approx([5.9915] * len(apart), rel=0.02)
    assert area(apart) == pytest.approx(math.pi * 5.9915 * math.sqrt(float(OBLIQUE[:2, :2].det())), rel=0.01)


@pytest.mark.parametrize("scale", [10.0, 100.0, 150.0])
def test_skewed_regions_contain_their_share(scale: float) -> None:
    """Of errors that are Gaussian in X / |X|², as those of a stereo rig are."""
    spread = scale**2 * OBLIQUE[:2, :2]
    outline = region_outline(PLACE, torch.block_diag(spread, torch.eye(1).double()))
    assert area(outline) > 0
    squared = PLACE[:2].square().sum()
    slope = (torch.eye(2).double() - 2.0 * torch.outer(PLACE[:2], PLACE[:2]) / squared) / squared
    root = torch.linalg.cholesky(slope @ spread @ slope.T)
    draws = torch.randn(40_000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) @ root.T
    inverse = PLACE[:2] / squared + draws
    points = inverse / inverse.square().sum(-1, keepdim=True)
    # Inside, if the ring turns once around a point.
    along = torch.atan2(*(outline[None] - points[:, None]).flip(-1).unbind(-1))
    turns = along.roll(-1, 1) - along
    winding = (turns - 2 * math.pi * torch.round(turns / (2 * math.pi))).sum(1) / (2 * math.pi)
    share = float((winding.round() == 1).double().mean())
    # 40,000 draws know a share to 0.1 %; 72 corners cut off 0.1 % of the region.
    assert share == pytest.approx(0.95, abs=0.004)
