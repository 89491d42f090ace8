"""Boards in tensors: `detect_board` for images as pipelines hold them, and `RefineCorners` before a calibration."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import torch
from board_render import homography, render
from elsewhere import DEVICE, Elsewhere
from torch import Tensor

from kcal.calibrate.camera.layer import CalibrationLayer
from kcal.calibrate.camera.result import CalibrationOptions
from kcal.corners.board import Board
from kcal.corners.detect import as_image, detect_board
from kcal.corners.grid import local_side
from kcal.corners.refine import RefineCorners, refine_corners
from kcal.corners.saddle import CornerStatus
from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector

BOARD, SIZE = Board(columns=5, rows=4, square=0.03), (200, 160)
VIEWS = [
    render(BOARD, SIZE, homography(BOARD, SIZE, 22, tilt, roll, (3.3, -2.7)), blur, noise=1.0, seed=seed)
    for seed, (tilt, roll, blur) in enumerate(
        [((0.2, 0.0), 0.1, 1.0), ((-0.1, 0.2), -0.2, 0.8), ((0.0, -0.25), 0.3, 0.3), ((-0.2, -0.1), 0.0, 4.5)]
    )
]
IMAGES = torch.stack([torch.from_numpy(image) for image, _ in VIEWS])
TRUTH = torch.stack([corners for _, corners in VIEWS])
STARTS = TRUTH + 0.4 * torch.randn(TRUTH.shape, generator=torch.Generator().manual_seed(0)).double()


def test_an_image_may_be_a_tensor_of_any_ordinary_kind() -> None:
    gray = IMAGES[0]
    wanted = detect_board(gray.numpy(), BOARD)
    assert wanted.pixels is not None
    colors = gray.expand(3, -1, -1)
    for image in (
        gray,
        gray[None],
        gray.to(torch.uint16),
        gray / 255,
        (gray.double() / 255)[None],
        colors,
        colors / 255,
    ):
        found = detect_board(image, BOARD)
        assert found.pixels is not None
        assert found.covariance is not None
        torch.testing.assert_close(found.pixels, wanted.pixels, rtol=0, atol=1e-3)
    assert torch.equal(detect_board(gray / 255, BOARD).pixels, wanted.pixels)
    with Elsewhere():
        found = detect_board((gray / 255).to(DEVICE), BOARD)
        assert found.pixels is not None
        assert found.pixels.device == DEVICE
        assert torch.equal(found.pixels.cpu(), wanted.pixels)


def test_colors_become_gray_by_the_weights_of_opencv() -> None:
    red = torch.tensor([200, 0, 0], dtype=torch.uint8)[:, None, None].expand(3, 2, 2)
    assert as_image(red).tolist() == [[60, 60]] * 2
    assert as_image(0.123456 * torch.ones(2, 2)).dtype == np.uint16


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (torch.full((100, 100), 128.0), "lie in 0 to 1, got 128 to 128; divide by the brightest"),
        (torch.linspace(-2, 2, 10000).reshape(100, 100), "got -2 to 2; .*undo a normalization"),
        (torch.full((100, 100), torch.nan), "got nan to nan"),
        (torch.zeros(100, 100, dtype=torch.int64), r"\(3, H, W\) of uint8 or uint16.*got \(100, 100\) int64"),
        (torch.zeros(2, 1, 100, 100), r"got \(2, 1, 100, 100\) float32"),
        (torch.zeros(100, 100, 3), r"got \(100, 100, 3\)"),
    ],
)
def test_other_ranges_and_shapes_are_refused(image: Tensor, message: str) -> None:
    with pytest.raises(InputError, match=message):
        detect_board(image, BOARD)


@pytest.mark.parametrize("method", ["erf", "saddle"])
def test_a_batch_is_refined_as_each_of_its_images(method: Literal["erf", "saddle"]) -> None:
    grid = (BOARD.columns, BOARD.rows)
    starts = STARTS.clone()
    starts[1, 3] = torch.nan
    found = RefineCorners(method, grid)(IMAGES[:, None], starts)
    for b in range(len(IMAGES)):
        wanted = refine_corners(IMAGES[b].numpy(), starts[b], local_side(starts[b], *grid), method, grid)
        assert torch.equal(found.status[b], wanted.status)
        torch.testing.assert_close(found.pixels[b], wanted.pixels, equal_nan=True, rtol=0, atol=1e-9)
        if method == "erf":
            torch.testing.assert_close(found.covariance[b], wanted.covariance, equal_nan=True)  # type: ignore[index]
    assert int(found.status[1, 3]) == int(CornerStatus.MISSING)
    good = found.status == CornerStatus.GOOD
    assert int(good[:3].sum()) == 59
    assert float((found.pixels - TRUTH)[good].square().sum(-1).mean().sqrt()) < 0.05


def test_gray_levels_may_have_any_scale() -> None:
    side = torch.full(STARTS.shape[:2], 15.0)
    one, other = (RefineCorners()(some, STARTS, side) for some in (IMAGES[:, None].double(), IMAGES[:, None] / 255))
    torch.testing.assert_close(one.pixels[:2], other.pixels[:2], rtol=0, atol=1e-5)


# The third image's edges are so sharp that it is smoothed first.
@pytest.mark.parametrize("number", [0, 2])
def test_corners_have_the_derivatives_of_refining_anew(number: int) -> None:
    image = IMAGES[number : number + 1, None].double()
    refine, side = RefineCorners(), torch.full(STARTS[:1].shape[:2], 15.0)
    way = torch.randn(image.shape, generator=torch.Generator().manual_seed(1)).double()
    assert bool((refine(image, STARTS[number : number + 1], side).status == CornerStatus.GOOD).all())

    def corners(amount: Tensor) -> Tensor:
        return refine(image + amount * way, STARTS[number : number + 1], side).pixels

    (along,) = torch.autograd.functional.jacobian(corners, torch.zeros(1).double(), strategy="reverse-mode").unbind(-1)
    step = 1.0
    numeric = (corners(torch.tensor([step]).double()) - corners(torch.tensor([-step]).double())) / (2 * step)
    # What the corners of a board know together, such as its illumination, counts as constant.
    assert float((along - numeric).norm()) < 0.05 * float(numeric.norm())


def test_a_calibration_is_differentiable_by_its_images() -> None:
    camera = torch.tensor([[260.0, 0, 99.5], [0, 260.0, 79.5], [0, 0, 1]]).double()
    turns = rotation_from_vector(
        torch.tensor([[0.4, 0.1, 0], [-0.4, 0.2, 0.1], [0.1, 0.5, 0], [0, -0.5, 0.2]]).double()
    )
    middle = torch.cat([BOARD.points.mean(0)[:2] / BOARD.square, torch.zeros(1)]).double()
    shift = torch.tensor([0.0, 0.0, 11.0]).double() - (turns @ middle[:, None])[..., 0]
    maps = camera @ torch.stack([turns[..., 0], turns[..., 1], shift], -1)
    drawn = [render(BOARD, SIZE, each.numpy(), 1.0, 1.0) for each in maps]
    images = torch.stack([torch.from_numpy(image) for image, _ in drawn])[:, None].double().requires_grad_(True)
    starts = torch.stack([corners for _, corners in drawn]) + 0.3
    starts[0, 0] = torch.nan
    refine = RefineCorners(grid=(BOARD.columns, BOARD.rows))
    layer = CalibrationLayer(SIZE, CalibrationOptions(model="pinhole"))
    found = layer(refine(images, starts).pixels, BOARD.points)
    assert abs(float(found.parameters[0].detach()) - 260.0) < 1.0
    (by_image,) = torch.autograd.grad(found.parameters[0], images)
    change = 2.0 * by_image / by_image.abs().max()
    with torch.no_grad():
        moved = layer(refine(images + change, starts).pixels, BOARD.points)
    gain = float((moved.parameters[0] - found.parameters[0]).detach())
    assert gain == pytest.approx(float((by_image * change).sum()), rel=0.2)


@pytest.mark.parametrize("method", ["erf", "saddle"])
def test_corners_come_back_on_the_device_of_the_image(method: Literal["erf", "saddle"]) -> None:
    refine = RefineCorners(method, (BOARD.columns, BOARD.rows))
    here = refine(IMAGES[1:2, None].double(), STARTS[1:2])
    with Elsewhere():
        there = refine(IMAGES[1:2, None].double().to(DEVICE), STARTS[1:2].to(DEVICE))
        for one, other in zip(there, here, strict=True):
            if other is not None:
                assert one.device == DEVICE
                torch.testing.assert_close(one.cpu(), other, rtol=1e-9, atol=1e-9)


def test_what_cannot_be_refined_is_refused() -> None:
    refine, image = RefineCorners(), IMAGES[:1, None].double()
    with pytest.raises(InputError, match="side is needed"):
        refine(image, STARTS[:1])
    with pytest.raises(InputError, match=r"image \(B, 1, H, W\)"):
        refine(IMAGES[:1].double(), STARTS[:1], torch.ones(1, 20))
    with pytest.raises(InputError, match="'opencv' has no gradients"):
        RefineCorners("opencv")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="not finite"):
        refine(image * torch.nan, STARTS[:1], torch.full((1, 20), 15.0))
