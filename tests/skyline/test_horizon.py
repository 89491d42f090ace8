"""The horizon and the border of the sky."""

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from kcal import InputError, Origin
from kcal.locate import geodetic_to_enu
from kcal.locate.ground import Raster
from kcal.skyline.attitude import raised_horizon
from kcal.skyline.horizon import RasterError, sky_border, terrain_horizon
from tests.helpers.skyline_site import CELL, heights, raster_of, small_site

# The horizon of a raster, against the definition by brute force.


RADIUS = 6_371_000.0


def directions(raster: Raster, eye: Origin, refraction: float) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation of the middle of every cell, as seen from an eye."""
    count = len(raster.heights)
    middle = np.arange(count) + 0.5
    column, row = np.meshgrid(middle, middle)
    cell = 1.0 / raster.to_cell[0]
    x, y = cell * (column - 0.5 * count), cell * (0.5 * count - row)
    lon, lat = raster.into.transform(x.ravel(), y.ravel(), direction="INVERSE")
    enu = geodetic_to_enu(torch.from_numpy(np.stack([lat, lon, raster.heights.ravel()], -1)), eye).numpy()
    level = np.hypot(enu[:, 0], enu[:, 1])
    return np.arctan2(enu[:, 0], enu[:, 1]), np.arctan(enu[:, 2] / level + refraction * level / (2.0 * RADIUS))


def test_a_single_summit_stands_where_geodesy_puts_it() -> None:
    values = np.zeros((481, 481))
    values[100, 300] = 900.0
    raster, eye = raster_of(values), Origin(lat=47.0, lon=11.0, height=20.0)
    azimuth, elevation = directions(raster, eye, 0.13)
    summit = int(values.argmax())
    found = terrain_horizon(raster, eye, azimuth[summit] + np.radians([-5.0, 0.0, 5.0]))
    # Interpolated between samples 0.8 m apart, a summit whose sides fall by 36 m a meter loses some meters of 3.7 km.
    assert found.elevation[1] == pytest.approx(elevation[summit], abs=1e-3)
    assert found.distance[1] == pytest.approx(CELL * np.hypot(300 - 240, 100 - 240), abs=2.0)
    assert found.known[1]
    assert not found.known[[0, 2]].any()


def test_no_cell_stands_above_the_horizon_and_some_cell_near_it() -> None:
    site = small_site()
    azimuth, elevation = directions(site.raster, site.place, 0.13)
    far = np.hypot(*np.meshgrid(*[CELL * (np.arange(480) - 239.5)] * 2)).ravel() > 3 * CELL
    table = np.linspace(-np.pi, np.pi, 3601)
    found = terrain_horizon(site.raster, site.place, table)
    off = elevation - np.interp(azimuth, table, found.elevation)
    assert off[far].max() < 3e-4  # a cell between two rays
    highest = [elevation[far & (np.abs(azimuth - one) < 5e-3)].max() for one in table[50::400]]
    # Within 5 mrad there are several cells, but not one on the crest each time.
    assert np.median(np.abs(highest - found.elevation[50::400])) < 1e-3


def test_the_eye_on_the_earths_curve() -> None:
    # A plain at sea level: its horizon is at sqrt(2 R h / (1 - k)), below the level by sqrt(2 h (1 - k) / R).
    raster, eye = raster_of(np.zeros((400, 400)), cell=200.0), Origin(lat=47.0, lon=11.0, height=50.0)
    found = terrain_horizon(raster, eye, np.radians([30.0, 90.0, 200.0]))
    assert found.elevation == pytest.approx(-np.sqrt(2 * 50.0 * 0.87 / RADIUS), rel=0.01)
    assert found.distance == pytest.approx(np.sqrt(2 * RADIUS * 50.0 / 0.87), rel=0.1)
    assert found.known.all()
    assert not found.doubtful.any()


def test_a_raster_that_ends_is_no_horizon() -> None:
    found = terrain_horizon(raster_of(heights()[200:280, 200:280]), small_site().place, np.linspace(-3.0, 3.0, 100))
    # Its ground rises to its end nearly everywhere; where it does not, what is beyond may be higher.
    assert found.known.mean() < 0.5
    assert found.doubtful[found.known].mean() > 0.9
    assert (found.reach < 1.5 * 40 * CELL).all()


def test_cells_without_height_hide_what_is_behind_them() -> None:
    site = small_site()
    azimuth = np.radians([35.0, 40.0, 45.0])
    whole = terrain_horizon(site.raster, site.place, azimuth)
    assert whole.known.all()
    values = heights()
    way = 0.5 * whole.point[1, :2]
    row, column = int(240 - way[1] / CELL), int(240 + way[0] / CELL)
    values[row - 1 : row + 2, column - 1 : column + 2] = np.nan
    assert terrain_horizon(raster_of(values), site.place, azimuth).known.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("change", "said"),
    [({"lat": 48.0}, "no height at the camera's place"), ({"height": 150.0}, "below the raster's ground")],
)
def test_a_place_that_cannot_be(change: dict[str, float], said: str) -> None:
    site = small_site()
    with pytest.raises(InputError, match=said):
        terrain_horizon(site.raster, dataclasses.replace(site.place, **change), np.zeros(1))


def test_errors_of_heights_raise_a_horizon() -> None:
    site = small_site()
    azimuth = np.radians(np.linspace(0.0, 90.0, 60))
    exact = terrain_horizon(site.raster, site.place, azimuth)
    stated = raised_horizon(exact, site.raster, site.place, RasterError(sigma=2.0, correlation=60.0)).raised
    # Independent errors of cells, smoothed: many draws of whole rasters raise the horizon as much.
    random, rise = np.random.default_rng(1), []
    apart = CELL * np.hypot(*np.meshgrid(*[np.minimum(np.arange(480), 480 - np.arange(480))] * 2))
    root = np.sqrt(np.maximum(np.fft.rfft2(np.exp(-apart / 60.0)).real, 0.0))
    for _ in range(5):
        drawn = np.fft.irfft2(root * np.fft.rfft2(random.standard_normal((480, 480))), (480, 480))
        noisy = terrain_horizon(raster_of(heights() + 2.0 * drawn), site.place, azimuth)
        rise.append(float((noisy.elevation - exact.elevation).mean()))
    assert float(stated.mean()) == pytest.approx(np.mean(rise), rel=0.5)
    assert float(stated.mean()) > 0.0


@pytest.mark.parametrize("sharp", [True, False])
def test_cells_lower_a_crest_that_is_sharper(sharp: bool) -> None:
    """A crest with flanks of 45 degrees stands half a cell lower in cells of twice the size; a dome does not."""
    site = small_site()
    count = len(site.raster.heights)
    middle = CELL * (np.arange(count) - 0.5 * count + 0.5)
    north = np.broadcast_to(-middle[:, None], (count, count))
    crest = np.maximum(400.0 - np.abs(north - 1500.0 - 0.5 * CELL), 0.0)
    dome = 50.0 * (1.0 - np.square(np.hypot(north, north.T) / middle[-1]))
    raster = raster_of(crest if sharp else dome)
    here = (torch.tensor([value]).double() for value in (site.place.lat, site.place.lon))
    eye = dataclasses.replace(site.place, height=float(raster(*here)[0]) + 60.0)
    horizon = terrain_horizon(raster, eye, np.radians(np.linspace(-10.0, 10.0, 40)))
    assert not horizon.blunted.any()
    blunted = raised_horizon(horizon, raster, eye, RasterError()).blunted
    if sharp:
        # Aside from where a crest is seen in the middle of its cells, somewhat more.
        assert 0.45 * CELL < blunted.min() < blunted.max() < 0.65 * CELL
    else:
        assert 0.0 < blunted.min() < blunted.max() < 0.02


def test_what_cells_lower_counts_as_an_error_of_each_crest() -> None:
    places = np.array([[0.0, 0.0, 0.0], [30.0, 40.0, 9.0]])
    found = RasterError(sigma=3.0, correlation=50.0, offset=1.0).heights(places, np.array([4.0, 0.0]))
    np.testing.assert_allclose(found, [[26.0, 1.0 + 15.0 / np.e], [1.0 + 15.0 / np.e, 10.0]], rtol=1e-12)


def test_cells_of_twice_the_size_have_the_mean_of_four() -> None:
    values = np.arange(35.0).reshape(5, 7) ** 2
    coarse = raster_of(values).coarser
    assert coarse.heights.shape == (2, 3)
    assert coarse.heights[1, 2] == values[2:4, 4:6].mean()
    place = small_site().place
    fine = [float(part) for part in raster_of(values).cells(np.array(place.lat), np.array(place.lon))]
    # Counted from the middle of the first cell.
    assert [float(part) for part in coarse.cells(np.array(place.lat), np.array(place.lon))] == pytest.approx(
        [0.5 * part - 0.25 for part in fine], abs=1e-9
    )


# The border of sky and ground in images whose border is known.


COLUMNS, ROWS = 320, 200


def drawn(row: NDArray[np.float64], noise: float = 2.0, step: float = 80.0, seed: int = 0) -> NDArray[np.float64]:
    """Sky above a border (W,), ground below, blurred, with noise."""
    above = np.clip(row[None] - np.arange(ROWS)[:, None] + 0.5, 0.0, 1.0)
    random = np.random.default_rng(seed)
    return gaussian_filter(100.0 + step * above, 0.8) + noise * random.standard_normal((ROWS, COLUMNS))


def wavy() -> NDArray[np.float64]:
    """A border between pixels."""
    return 90.3 + 12.0 * np.sin(np.arange(COLUMNS) / 40.0)


@pytest.mark.parametrize("step", [80.0, -60.0])
def test_it_is_between_pixels_with_its_sigma(step: float) -> None:
    off = []
    for seed in range(4):
        found = sky_border(drawn(wavy(), step=step, seed=seed))
        assert found.clear.mean() > 0.95
        off.append(((found.row - wavy()) / found.sigma)[found.clear])
        assert np.nanmedian(found.sigma) < 0.1
    ratio = np.concatenate(off)
    assert 0.6 < ratio.std() < 1.3
    assert abs(ratio.mean()) < 0.3


def test_noise_says_how_well() -> None:
    low, high = (np.nanmedian(sky_border(drawn(wavy(), noise=noise)).sigma) for noise in (1.0, 4.0))
    assert high > 2.0 * low


def test_a_nearer_ridge_with_more_contrast_is_not_the_skyline() -> None:
    image = drawn(wavy(), step=25.0)
    image[140:] -= 60.0
    found = sky_border(image)
    assert found.clear.mean() > 0.95
    assert np.abs(found.row - wavy())[found.clear].max() < 1.0


def test_a_pole_in_front_is_left_out() -> None:
    image = drawn(wavy())
    image[40:, 150:155] = 100.0
    found = sky_border(image)
    assert not found.clear[149:156].any()
    assert np.abs(found.row - wavy())[found.clear].max() < 1.5
    assert found.clear.mean() > 0.9


def test_clouds_are_not_the_skyline() -> None:
    random = np.random.default_rng(3)
    cloud = gaussian_filter(random.standard_normal((ROWS, COLUMNS)), 15)
    image = drawn(wavy()) + np.where(np.arange(ROWS)[:, None] < wavy(), 25.0 * cloud / cloud.std(), 0.0)
    found = sky_border(image)
    assert np.median(np.abs(found.row - wavy())[found.clear]) < 0.3
    # Some rims are as sharp; the fit leaves them out.
    assert (np.abs(found.row - wavy())[found.clear] < 2.0).mean() > 0.9


@pytest.mark.parametrize(
    "image",
    [
        np.random.default_rng(0).normal(3.0, 1.0, (ROWS, COLUMNS)),
        gaussian_filter(np.random.default_rng(1).normal(0.0, 40.0, (ROWS, COLUMNS)), 1.5),
        drawn(np.full(COLUMNS, 3.0)),
    ],
    ids=["night", "texture everywhere", "no sky"],
)
def test_where_there_is_none_few_columns_are_clear(image: NDArray[np.float64]) -> None:
    assert sky_border(image).clear.mean() < 0.1


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (np.zeros((ROWS, COLUMNS)), "one gray level"),
        (np.zeros((ROWS, COLUMNS, 3)), "gray levels is needed"),
        (np.full((ROWS, COLUMNS), np.nan), "not finite"),
        (np.zeros((10, 10)), "is needed"),
    ],
)
def test_what_is_no_image(image: NDArray[np.float64], said: str) -> None:
    with pytest.raises(InputError, match=said):
        sky_border(image)
