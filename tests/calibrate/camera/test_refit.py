"""A parametric camera in place of another one, with the misfit stated."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import SIZE, camera
from lenses import HYBRID, strong

from kcal.calibrate.camera.export import refit_camera
from kcal.errors import InputError
from kcal.lens.camera import Camera


def test_a_model_that_holds_the_lens_finds_it() -> None:
    truth = camera("opencv5")
    found = refit_camera(truth, "opencv14")
    assert found.rms < 1e-3
    assert found.covered == 1.0
    pixels = truth.grid(9, 7).reshape(-1, 2)
    rays, _ = truth.unproject(pixels)
    error = (found.camera.project(1e6 * rays)[0] - pixels).norm(dim=-1)
    assert float(error.max()) <= found.largest * 1.5


def test_the_misfit_is_that_over_the_image() -> None:
    """A richer model misses less; what is stated is what a comparison at other places of the image finds."""
    head = torch.tensor([520.0, 520.0, 325.0, 235.0, 0.0], dtype=torch.float64)
    truth = Camera(torch.cat([head, 0.3 * strong(HYBRID)]), size=SIZE, model=HYBRID)
    plain, rich = refit_camera(truth, "opencv4"), refit_camera(truth, "opencv14")
    assert 0 < rich.rms < plain.rms
    pixels = truth.grid(40, 30).reshape(-1, 2)
    rays, _ = truth.unproject(pixels)
    seen, valid = rich.camera.project(1e9 * rays)
    rms = float((seen - pixels)[valid].square().sum(-1).mean().sqrt())
    assert rms == pytest.approx(rich.rms, rel=0.1)


def test_refusals() -> None:
    with pytest.raises(InputError, match="parametric"):
        refit_camera(camera(), HYBRID)
    with pytest.raises(InputError, match="unknown lens model"):
        refit_camera(camera(), "opencv9")
