"""Boards in tensors, and corners in pictures whose truth is known, as they were when last looked at."""

import functools
import os
from typing import Literal

import numpy as np
import pytest
import torch
from board_render import homography, render
from elsewhere import DEVICE, Elsewhere
from numpy.typing import NDArray
from torch import Tensor

from kcal import Board, CalibrationOptions, Camera, InputError
from kcal.calibrate import CalibrationLayer
from kcal.corners import CornerStatus, refine_point
from kcal.corners.detect import as_image, detect, detect_board, recognize_board
from kcal.corners.grid import local_side
from kcal.corners.refine import RefineCorners, refine_corners
from kcal.lens import rotation_from_vector
from scripts.shared.printed_board import Paper, pose

# Boards in tensors: `detect_board` for images as pipelines hold them, and `RefineCorners` before a calibration.


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


# Errors and stated sigmas of corners in pictures whose truth is known, as they were when last looked at.
#
# Thousandths of a pixel: mean error, root of the mean square, how errors go with the corner's number, mean stated
# sigma along both axes and their covariance's root. A slip of a weight, a window or a limit changes these long before
# a board is lost. After a change that is meant: KCAL_WRITE_CORNERS=1 and this file print them anew.


CAMERA = Camera.build(focal=(260, 262), center=(143, 107), size=(288, 216), coefficients=[-0.1, 0.02])

# Pattern, size of a square, tilt, distance, blur, noise, shift.
PRINTED = {
    "circles": ("circles:5x4", "30mm", (0.5, -0.3, 0.2), 0.28, 0.8, 1.5),
    "asymmetric": ("asymmetric:3x5", "30mm", (-0.3, 0.5, 0.4), 0.35, 0.7, 1.0),
    "charuco": ("charuco:6x4", "30mm", (0.4, 0.3, 0.2), 0.27, 0.7, 1.5),
    "charuco, steep": ("charuco:6x4", "30mm", (0.1, -0.8, -1.4), 0.25, 0.5, 1.0),
    "april": ("aprilgrid:3x2", "40mm", (0.3, -0.4, 0.3), 0.26, 0.7, 1.5),
    "april, turned": ("aprilgrid:3x2", "40mm", (0.1, 0.4, 2.8), 0.28, 0.6, 1.0),
}  # fmt: skip

# Refinement, square in pixels, tilt, roll, blur, noise, kind.
CHECKERED = {
    "sharp": ("erf", 24.0, (0.1, 0.2), 0.1, 0.5, 1.5, np.uint8),
    "blurred": ("erf", 20.0, (0.25, -0.1), 0.6, 2.2, 2.0, np.uint8),
    "small": ("erf", 9.0, (-0.15, 0.1), -0.2, 0.8, 1.0, np.uint8),
    "steep, 16 bits": ("erf", 22.0, (0.4, 0.3), -0.4, 0.9, 2.0, np.uint16),
    "saddle": ("saddle", 22.0, (0.2, 0.2), 0.3, 1.0, 2.0, np.uint8),
    "saddle, small": ("saddle", 11.0, (0.2, 0.1), -0.3, 0.7, 1.0, np.uint8),
}

BEFORE: dict[str, tuple[float, ...]] = {
    "circles": (20.0, 1.222, -0.989, 3.679, 0.168, -0.691, 4.224, 3.925, -1.282),
    "asymmetric": (15.0, -1.756, 0.292, 8.288, 0.469, -4.282, 2.352, 2.393, -0.864),
    "charuco": (24.0, 1.509, -1.133, 5.412, 0.19, -0.407, 5.587, 5.767, 1.735),
    "charuco, steep": (24.0, 1.116, 0.847, 3.869, -0.586, -0.603, 4.632, 4.861, 2.597),
    "april": (24.0, 0.337, 0.916, 3.854, -0.766, 0.331, 4.119, 3.873, -1.269),
    "april, turned": (24.0, 0.816, -0.505, 3.406, 0.186, -1.217, 2.5, 2.506, -0.465),
    "sharp": (35.0, 0.592, -0.647, 2.788, 0.786, -0.194, 2.871, 2.79, 0.313),
    "blurred": (35.0, 0.019, -0.204, 8.146, 0.882, -0.169, 8.786, 8.701, 0.301),
    "small": (35.0, 0.007, -0.278, 3.464, -0.361, 0.253, 3.915, 3.916, -0.141),
    "steep, 16 bits": (32.0, 1.004, -1.522, 6.587, -1.849, -0.834, 5.642, 5.47, -0.892),
    "saddle": (35.0, -0.371, 1.743, 9.981, 0.322, -0.467),
    "saddle, small": (35.0, -1.228, -0.865, 5.086, 0.236, 0.955),
}

# Of a single point: place, covariance xx, xy, yy in millionths.
POINT = (20764.8, 17439.1, 20438.2, -4561.61, 17772.5)


@functools.cache
def paper(pattern: str, square: str) -> Paper:
    return Paper(Board.parse(pattern, square), cell_mm=0.5)


def printed(name: str) -> tuple[NDArray[np.uint8], Board, Tensor]:
    pattern, square, tilt, distance, blur, noise = PRINTED[name]
    sheet = paper(pattern, square)
    image, truth = sheet.shoot(CAMERA, *pose(sheet.board, tilt, distance), blur, noise)
    return image, sheet.board, truth


def summary(found: Tensor, covariance: Tensor | None, truth: Tensor) -> tuple[float, ...]:
    good = torch.isfinite(found).all(1)
    error = found[good] - truth[good]
    along = torch.linspace(-1.0, 1.0, len(found)).double()[good]
    values = [*error.mean(0), error.square().mean().sqrt(), *(along[:, None] * error).mean(0)]
    if covariance is not None:
        spread = covariance[good]
        cross = spread[:, 0, 1].mean()
        values += [*spread.diagonal(dim1=1, dim2=2).sqrt().mean(0), cross.sign() * cross.abs().sqrt()]
    return (float(good.sum()), *(round(1e3 * float(value), 3) for value in values))


@pytest.mark.parametrize("name", [*PRINTED, *CHECKERED])
def test_as_before(name: str) -> None:
    if name in PRINTED:
        image, board, truth = printed(name)
        found = detect_board(image, board)
    else:
        refine, square, tilt, roll, blur, noise, kind = CHECKERED[name]
        board = Board(columns=7, rows=5, square=0.03)
        place = homography(board, (288, 216), square, tilt, roll, (3.3, -2.6))
        image, truth = render(board, (288, 216), place, blur, noise, 1, 4, dtype=kind)
        found = detect_board(image, board, refine)
    assert found.pixels is not None, found.reason
    now = summary(found.pixels, found.covariance, truth)
    if os.environ.get("KCAL_WRITE_CORNERS"):
        print(f'    "{name}": {now},')
        return
    assert now == pytest.approx(BEFORE[name], abs=0.2, rel=0.01)


def corner_image(noise: float = 1.0, beside: float = 40.0) -> Tensor:
    """A corner at 20.6, 17.3 and an edge some 15 px beside it, which a wider window takes for a part of it."""
    x = torch.arange(40.0, dtype=torch.float64)
    image = 100 * torch.outer(torch.sigmoid(2 * (x - 17.3)), torch.sigmoid(1.5 * (x - 20.6)))
    image += beside * torch.sigmoid(2 * (x[None] + 0.2 * x[:, None] - 38.0))
    return image + noise * torch.randn(40, 40, generator=torch.Generator().manual_seed(0)).double()


def test_a_point_as_before() -> None:
    found = refine_point(corner_image(), torch.tensor([20.0, 18.0]))
    covariance = found.covariance.flatten()[[0, 1, 3]]
    assert (1e3 * found.pixel).tolist() == pytest.approx(POINT[:2], abs=2.0)
    assert (1e6 * covariance).tolist() == pytest.approx(POINT[2:], rel=0.01)


def test_room_and_reach_of_a_point() -> None:
    """Five pixels from the border of the picture, three from where the mark is: on both sides."""
    image = corner_image(0.0, 0.0)
    corner = refine_point(image, torch.tensor([20.0, 18.0])).pixel
    assert corner.tolist() == pytest.approx([20.7, 17.4], abs=0.1)
    for x, y, good in ((2.0, 2.1, True), (2.2, 2.3, False), (-2.9, 0.0, True), (-3.1, 0.0, False), (0.0, -3.1, False)):
        at = corner + torch.tensor([x, y])
        if good:
            assert refine_point(image, at).pixel.tolist() == pytest.approx(corner.tolist(), abs=0.01)
        else:
            with pytest.raises(InputError, match="more than 3 px away"):
                refine_point(image, at)
    for cut, good in ((15, True), (16, False)):
        part, at = image[:, cut:], torch.tensor([20.0 - cut, 18.0])
        if good:
            refine_point(part, at)
        else:
            with pytest.raises(InputError, match="within 5 px"):
                refine_point(part, at)


@pytest.mark.parametrize("blur", [0.7, 1.5])
def test_the_blur_of_corners(blur: float) -> None:
    """That of the picture and of a pixel's area, variance 1/12 px²; none where a corner is not good."""
    board = Board(columns=5, rows=4, square=0.03)
    image, truth = render(board, (200, 160), homography(board, (200, 160), 22.0, roll=0.2), blur, 1.0, 1, 4)
    start = truth.clone()
    start[0] = torch.nan
    found = refine_corners(image, start, local_side(truth, 5, 4), grid=(5, 4))
    assert found.status.tolist() == [int(CornerStatus.MISSING)] + [int(CornerStatus.GOOD)] * 19
    assert bool(found.blur[0].isnan() & found.pixels[0].isnan().all() & found.covariance[0].isnan().all())
    assert found.blur[1:].tolist() == pytest.approx([(blur**2 + 1.0 / 12.0) ** 0.5] * 19, rel=0.1)


@pytest.mark.parametrize("pattern", ["checkerboard", "circles"])
@pytest.mark.parametrize("side", [0, 1, 15])
def test_images_without_room_for_a_board(side: int, pattern: Literal["checkerboard", "circles"]) -> None:
    image, board = np.zeros((side, side), np.uint8), Board(columns=5, rows=4, square=0.02, pattern=pattern)
    assert detect_board(image, board).reason == f"the image has only {side}x{side} pixels"
    with pytest.raises(InputError, match=f"image 0: the image has only {side}x{side} pixels"):
        detect([image] * 3, board)
    with pytest.raises(InputError, match="give --board"):
        recognize_board(image, "25mm")


def test_no_corners_to_refine() -> None:
    found = RefineCorners()(IMAGES[:2, None].double(), torch.zeros(2, 0, 2), torch.zeros(2, 0))
    assert found.pixels.shape == (2, 0, 2)
    assert found.status.shape == (2, 0)
