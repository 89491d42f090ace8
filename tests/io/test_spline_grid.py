"""mrcal's splined model: its basis, its grid, and fits to rays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.interpolate import BSpline

from kcal.errors import InputError
from kcal.io.format_mrcal import SplineGrid, fit_spline, project_spline, stereographic

GRID = SplineGrid(11, 8, 100)


def test_grid() -> None:
    """Its columns but two cover the field of view, at equal distances of u = 2 tan(angle / 2)."""
    assert GRID.name == "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=11_Ny=8_fov_x_deg=100"
    assert GRID.per_unit * 2 * 2 * math.tan(math.radians(100) / 4) == pytest.approx(11 - 3)
    rays = np.array([[math.sin(a), 0.0, math.cos(a)] for a in (0.0, 0.5, -1.2)])
    np.testing.assert_allclose(stereographic(3.0 * rays)[:, 0], [2 * math.tan(a / 2) for a in (0.0, 0.5, -1.2)])


def test_weights_are_those_of_cubic_b_splines() -> None:
    u = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 2)) * [1.0, 0.5]
    index, weight = GRID.weights(u)
    dense = np.zeros((len(u), GRID.rows, GRID.columns))
    np.put_along_axis(dense.reshape(len(u), -1), index, weight, 1)
    basis = []
    for values, count in ((u[:, 0], GRID.columns), (u[:, 1], GRID.rows)):
        place = values * GRID.per_unit + 0.5 * (count - 1)
        basis.append(
            np.stack(
                [BSpline.basis_element(np.arange(-2.0, 3.0) + k, extrapolate=False)(place) for k in range(count)], -1
            )
        )
    np.testing.assert_allclose(
        dense, np.nan_to_num(basis[1])[:, :, None] * np.nan_to_num(basis[0])[:, None], atol=1e-12
    )


def test_beyond_the_grid_the_last_piece_goes_on() -> None:
    for u in (np.array([[5.0, 0.0]]), np.array([[-5.0, 0.0]]), np.array([[0.0, 5.0]]), np.array([[0.0, -5.0]])):
        index, weight = GRID.weights(u)
        assert index.min() >= 0
        assert index.max() < GRID.rows * GRID.columns
        assert weight.sum() == pytest.approx(1.0)


def rays_and_pixels(reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Of an equidistant lens of 500 px per radian with another scale and a shift along y."""
    angle, around = (part.ravel() for part in np.meshgrid(np.linspace(0, reach, 40), np.linspace(0, 2 * np.pi, 60)))
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1)
    pixels = angle[:, None] * np.stack([500 * np.cos(around), 510 * np.sin(around)], -1) + [640.0, 400.0]
    return rays, pixels


def test_a_fit_is_exact_where_rays_are() -> None:
    rays, pixels = rays_and_pixels(1.2)
    grid, intrinsics = fit_spline(rays, pixels, (1280, 800))
    assert len(intrinsics) == 4 + 2 * grid.columns * grid.rows
    assert np.abs(project_spline(grid, intrinsics, rays) - pixels).max() < 1e-3
    # The field of view with a margin, and rows for as much of it as is used.
    assert grid.fov_deg == math.ceil(math.degrees(2.4) * 1.02)
    assert grid.columns == 30
    tallest = 2 * math.tan(1.2 / 2)
    assert (grid.rows - 3) / 2 / grid.per_unit >= tallest > (grid.rows - 5) / 2 / grid.per_unit
    # The core is the best line through the places; control points add to it.
    assert intrinsics[2:4] == pytest.approx([640, 400], abs=1.0)
    nothing = np.concatenate([intrinsics[:4], np.zeros(2 * grid.columns * grid.rows)])
    u = stereographic(rays)
    np.testing.assert_allclose(project_spline(grid, nothing, rays), u * intrinsics[:2] + intrinsics[2:4])
    for i in (0, 1):
        assert np.polyfit(u[:, i], pixels[:, i], 1) == pytest.approx(intrinsics[[i, 2 + i]])


def test_too_wide_a_lens() -> None:
    fit_spline(*rays_and_pixels(math.radians(340) / 2), (1280, 800))
    with pytest.raises(InputError, match="reaches to 350°"):
        fit_spline(*rays_and_pixels(math.radians(345) / 2), (1280, 800))
