"""What the fit of shifts of patches computes, against dense matrices of NumPy and values by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.corners.patches import (
    ImageWindows,
    _biweight,
    _covariance,
    _Patches,
    _residual,
    _scale,
    gaussian_kernel,
    grid_of,
)

UNUSED = torch.zeros(0)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def ramps(count: int, height: int, width: int) -> ImageWindows:
    """Windows whose gray levels grow by 2 per column and 3 per row of the whole image."""
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    corner = torch.tensor([[10.0, 20.0]], dtype=torch.float64).expand(count, 2)
    values = 2.0 * (x + 10.0) + 3.0 * (y + 20.0)
    return ImageWindows(values.expand(count, -1, -1), torch.zeros(count, height, width), corner, (400, 300), 0)


class TestShifts:
    def test_residuals_of_ramps(self) -> None:
        """Of a sheared patch: right(moved + slopes shift) - gain template - offset - ramp, and its derivatives."""
        grid = grid_of((2, 1), torch.device("cpu"))  # three rows of five
        template = draw(1, 3, 5)
        moved = (grid + torch.tensor([25.0, 32.0]))[None]
        slopes = torch.tensor([[1.1, -0.2], [0.1, 0.9]], dtype=torch.float64)
        across, down = slopes[:, 0], slopes[:, 1]
        patches = _Patches(template, ramps(1, 30, 40), moved, slopes.expand(1, 3, 5, 2, 2), torch.ones(1, 3, 5), grid)
        theta = torch.tensor([[0.4, -0.3, 1.5, 7.0, 0.02, -0.05, 0.6, -0.9]], dtype=torch.float64)
        residual, slope, design = _residual(patches, theta)
        ahead = 0.4 + 0.02 * grid[..., 0] - 0.05 * grid[..., 1]
        at = moved[0] + ahead[..., None] * across - 0.3 * down
        wanted = 2.0 * at[..., 0] + 3.0 * at[..., 1] - 1.5 * template[0] - 7.0
        wanted = wanted - 0.6 * grid[..., 0] + 0.9 * grid[..., 1]
        torch.testing.assert_close(residual[0], wanted.flatten())
        # A step along the first axis is (1.1, 0.1) px, along the second (-0.2, 0.9).
        assert slope[0, 4].tolist() == pytest.approx([2.2 + 0.3, -0.4 + 2.7])
        columns = torch.stack(
            [torch.full((15,), 2.5).double(), torch.full((15,), 2.3).double(), -template.flatten(),
             -torch.ones(15).double(), 2.5 * grid[..., 0].flatten(), 2.5 * grid[..., 1].flatten(),
             -grid[..., 0].flatten(), -grid[..., 1].flatten()], -1)  # fmt: skip
        torch.testing.assert_close(design[0], columns)
        assert _residual(patches._replace(grid=None), theta[:, :4])[2].shape == (1, 15, 4)

    def test_scales_are_weighted_medians(self) -> None:
        residual = torch.tensor(
            [[1.0, -2.0, 3.0, -4.0], [1.0, -2.0, 3.0, -4.0], [5.0, 5.0, 0.0, 0.0]], dtype=torch.float64
        )
        weight = torch.tensor([[1.0, 1.0, 1.0, 1.0], [0.1, 0.1, 1.0, 0.1], [0.0, 0.0, 1.0, 1.0]], dtype=torch.float64)
        assert _scale(residual, weight).tolist() == pytest.approx([1.4826 * 2.0, 1.4826 * 3.0, 1e-9])

    def test_weights_by_the_residuals_nearby(self) -> None:
        """Zero from three standard deviations; a single one counts as much as the kernel says."""
        patches = _Patches(torch.zeros(2, 7, 9), ramps(2, 9, 9), UNUSED, UNUSED, UNUSED, None)
        flat = torch.tensor([[1.5], [6.5]], dtype=torch.float64).expand(2, 63)
        weight = _biweight(flat, torch.tensor([1.0, 2.0], dtype=torch.float64), patches)
        assert weight[0].tolist() == pytest.approx([(1.0 - 0.25) ** 2] * 63)
        assert weight[1].tolist() == [0.0] * 63
        single = torch.zeros(2, 7, 9).double()
        single[0, 3, 4] = 2.0
        weight = _biweight(single.flatten(1), torch.ones(2).double(), patches).reshape(2, 7, 9)
        kernel = gaussian_kernel(1.0, 2).numpy()
        wanted = np.ones((7, 9))
        wanted[1:6, 2:7] = (1.0 - 4.0 * np.outer(kernel, kernel) / 9.0) ** 2
        np.testing.assert_allclose(weight[0], wanted)

    @pytest.mark.parametrize("sheared", [False, True])
    @pytest.mark.parametrize("alike", [False, True])
    def test_covariance_is_that_of_dense_matrices(self, alike: bool, sheared: bool) -> None:
        """Also where residuals nearby are alike: then what they add up to counts."""
        height, width, n = 7, 9, 63
        grid = grid_of((4, 3), torch.device("cpu")) if sheared else None
        blur = gaussian_kernel(1.2, 4)
        smooth = torch.nn.functional.conv2d(20.0 * draw(1, 1, height + 8, width + 8), blur[None, None, None])
        template = torch.nn.functional.conv2d(smooth, blur[None, None, :, None])[0]
        # In turn above and below zero.
        residual = draw(1, n, seed=3).abs() * (1.0 - 2.0 * (torch.arange(n) % 2))
        if alike:
            rough = torch.nn.functional.conv2d(draw(1, 1, height + 8, width + 8, seed=3), blur[None, None, None])
            residual = 9.0 * torch.nn.functional.conv2d(rough, blur[None, None, :, None])[0].flatten(1)
        theta = torch.tensor([[0.1, 0.2, 1.3, 4.0, 0.01, 0.02, 0.3, -0.1][: 8 if sheared else 4]], dtype=torch.float64)
        robust = 0.3 + draw(1, n, seed=4).abs().clamp_max(1.0)
        padded = np.pad(template[0].numpy(), 1, mode="edge")
        along = 0.5 * (padded[1:-1, 2:] - padded[1:-1, :-2])
        across = 0.5 * (padded[2:, 1:-1] - padded[:-2, 1:-1])
        own = 1.3 * np.stack([along.ravel(), across.ravel()], -1)
        slope = own + 0.1 * draw(n, 2, seed=6).numpy()
        patches = _Patches(template, ramps(1, 9, 9), UNUSED, UNUSED, UNUSED, grid)
        found, sound = _covariance(patches, theta, residual, torch.from_numpy(slope)[None], robust)
        assert sound.tolist() == [True]

        w, r = robust[0].numpy(), residual[0].numpy()
        mixed = 0.5 * (own + slope)
        free = [template[0].flatten().numpy(), np.ones(n)]
        if grid is not None:
            free += [mixed[:, 0] * grid[..., k].flatten().numpy() for k in (0, 1)]
            free += [grid[..., k].flatten().numpy() for k in (0, 1)]
        design, root = np.stack(free, -1), np.sqrt(w)

        def beyond(values: NDArray[np.float64]) -> NDArray[np.float64]:
            best = np.linalg.lstsq(design * root[:, None], values * root[:, None], rcond=None)[0]
            return values - design @ best

        normal = (own.T * w) @ beyond(slope)
        inverse = np.linalg.inv(0.5 * (normal + normal.T))
        sigma = math.sqrt(0.8**2 + 1.0 / 6.0)
        y, x = np.divmod(np.arange(n), width)

        def spread_by(kernel: NDArray[np.float64]) -> NDArray[np.float64]:
            """(pixels anywhere, n): what each pixel becomes."""
            reach = len(kernel) // 2
            rows, columns = np.mgrid[-reach : height + reach, -reach : width + reach].reshape(2, -1)
            dy, dx = rows[:, None] - y, columns[:, None] - x
            near = (abs(dy) <= reach) & (abs(dx) <= reach)
            return np.where(
                near, kernel[np.clip(dy, -reach, reach) + reach] * kernel[np.clip(dx, -reach, reach) + reach], 0.0
            )

        kernel = np.exp(-0.5 * (np.arange(-4, 5) / sigma) ** 2)
        kernel /= kernel.sum()
        left = float((kernel**2).sum()) ** 2  # the variance that blur leaves of noise
        # The fit takes the part of the noise that lies in the space of its columns.
        columns = np.concatenate([design, mixed], 1)
        blurred = spread_by(kernel) @ (w[:, None] * columns)
        taken = np.trace(np.linalg.inv((columns.T * w) @ columns) @ blurred.T @ blurred)
        freedom = max(1.0 - taken / (w.sum() * left), 0.2)
        noise = (w * r**2).sum() / w.sum() / (left * freedom)
        force = w[:, None] * beyond(mixed)
        blurred = spread_by(kernel) @ force
        middle = noise * blurred.T @ blurred
        pull = force * r[:, None]
        triangle = 1.0 - abs(np.arange(-4, 5)) / 5.0
        rows, columns = np.mgrid[-4 : height + 4, -4 : width + 4].reshape(2, -1)
        inner = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        wider = spread_by(triangle)[inner] @ pull
        excess = max(1.0, np.linalg.solve(middle, pull.T @ wider / freedom).diagonal().mean())
        assert bool(excess > 1.0) == alike
        np.testing.assert_allclose(found[0], excess * inverse @ middle @ inverse, rtol=1e-5)
