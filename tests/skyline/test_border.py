"""The border of sky and ground in images whose border is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from kcal.errors import InputError
from kcal.skyline.horizon import sky_border

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
