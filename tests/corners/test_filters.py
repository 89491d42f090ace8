"""Gaussian kernels and filters of single images."""

from __future__ import annotations

import pytest
import torch
from scipy import ndimage

from kcal.corners.patches import filtered, gaussian_kernel


@pytest.mark.parametrize("sigma", [0.8, 1.5, 3.0])
def test_kernel_is_a_gaussian_of_its_sigma(sigma: float) -> None:
    reach = round(6 * sigma)
    kernel = gaussian_kernel(sigma, reach)
    offset = torch.arange(-reach, reach + 1, dtype=torch.float64)
    assert kernel.sum().item() == pytest.approx(1.0, rel=1e-14)
    # Whole pixels sample the narrowest to 2e-4.
    assert (kernel * offset**2).sum().item() == pytest.approx(sigma**2, rel=3e-4)
    assert torch.equal(kernel, kernel.flip(0))


def test_filtering_is_that_of_scipy() -> None:
    """Along rows with one kernel and down columns with another; edges repeat."""
    image = torch.rand(20, 31, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    across, down = torch.tensor([1.0, 2.0, 4.0]).double(), torch.tensor([-1.0, 0.5, 3.0]).double()
    expected = ndimage.correlate1d(image.numpy(), across.numpy(), axis=1, mode="nearest")
    expected = ndimage.correlate1d(expected, down.numpy(), axis=0, mode="nearest")
    torch.testing.assert_close(filtered(image, across, down), torch.from_numpy(expected), rtol=1e-13, atol=1e-13)
