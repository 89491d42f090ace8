"""Parts of boards, boards of another size, and pictures that cameras sharpened."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from board_render import homography, render

from kcal.corners.board import Board
from kcal.corners.detect import detect_board
from kcal.corners.grid import false_sides, skips, without_false_sides
from kcal.corners.images import read_gray
from kcal.corners.search import board_ends

BOARD = Board(columns=9, rows=6, square=0.025)
SIZE = (480, 360)


def picture(board=BOARD, shift=(0.0, 0.0), **options):
    H = homography(board, SIZE, 30, (0.1, 0.05), 0.08, shift)
    return render(board, SIZE, H, supersample=2, **options)


def rms(pixels, truth):
    seen = torch.isfinite(pixels).all(-1)
    return float((pixels - truth)[seen].square().mean().sqrt())


@pytest.mark.parametrize("shift", [(140, 0), (-150, 0), (0, 120), (0, -115)])
def test_a_board_cut_by_the_image_keeps_its_numbers(shift):
    image, truth = picture(shift=shift)
    found = detect_board(image, BOARD)
    seen = torch.isfinite(found.pixels).all(-1)
    assert 20 <= int(seen.sum()) < 54
    # A part one column off would be wrong by a square of 30 px.
    assert rms(found.pixels, truth) < 0.03


def test_glare_leaves_out_corners_only():
    image, truth = picture()
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    u, v = truth[22].tolist()
    spot = 500 * np.exp(-0.5 * (((x - u) / 22) ** 2 + ((y - v) / 18) ** 2))
    glaring = np.clip(image + spot, 0, 255).astype(np.uint8)
    found = detect_board(glaring, BOARD)
    assert 30 <= int(torch.isfinite(found.pixels).all(-1).sum()) < 54
    assert bool(found.pixels[22].isnan().all())
    assert float((found.pixels - truth).norm(dim=-1).nan_to_num().max()) < 1.0


def test_an_uncertain_part_is_refused_with_its_side():
    # Left and right are both outside: which 6 or so of the 9 columns these are cannot be known.
    image, _ = picture()
    found = detect_board(np.ascontiguousarray(image[:, 150:330]), BOARD)
    assert found.pixels is None
    assert "cut by the image's edge at the" in found.reason
    assert "left" in found.reason
    assert "right" in found.reason
    assert found.rejected is not None
    assert len(found.rejected) >= 12


def test_the_edge_of_a_cover_is_not_the_end_of_the_board():
    """A gray sheet hides the last columns along a line of the board, and the first ones are outside the image."""
    H = homography(BOARD, SIZE, 30, shift=(-165, 0))
    image, truth = render(BOARD, SIZE, H, supersample=2)
    image[:, round(float(truth[6, 0])) + 30 :] = 120
    grid = truth.reshape(6, 9, 2)[:, 3:7]
    assert board_ends(image, grid)[3]
    assert not board_ends(image, grid, paper=True)[3]
    found = detect_board(image, BOARD)
    assert found.pixels is None


def test_another_board_is_named():
    image, _ = picture(Board(columns=8, rows=6, square=0.025))
    found = detect_board(image, BOARD)
    assert found.reason == "a board of 8x6 inner corners was found, not 9x6: give --board 8x6"


def test_the_edge_of_the_paper_is_no_line_of_corners():
    board = Board(columns=8, rows=6, square=0.025)
    image, truth = picture(board)
    grid = truth.reshape(6, 8, 2)
    assert not bool(false_sides(image, truth, 8, 6).any())
    longer = torch.cat([grid, (2 * grid[:, -1:] - grid[:, -2:-1])], 1)
    # Dark ground begins a tenth of a square outside the outer squares.
    out = (longer[:, -1] - longer[:, -2]).mean(0)
    ends = longer[:, -1] + 0.1 * out
    down = grid[1, 0] - grid[0, 0]
    area = torch.stack(
        [ends[0] - 4 * down, ends[-1] + 4 * down, ends[-1] + 4 * down + 6 * out, ends[0] - 4 * down + 6 * out]
    )
    cv2.fillPoly(image, [area.round().int().numpy()], 50)
    assert false_sides(image, longer.reshape(-1, 2), 9, 6).tolist() == [False, False, False, True]
    assert without_false_sides(image, longer).shape == (6, 8, 2)


def test_every_other_line_is_noticed():
    image, truth = picture()
    assert not skips(image, truth, 9, 6)
    assert skips(image, truth.reshape(6, 9, 2)[:5:2].reshape(-1, 2), 9, 3)
    assert skips(image, truth.reshape(6, 9, 2)[:, ::2].reshape(-1, 2), 5, 6)


def test_sharpened_edges_lose_no_corners():
    light, truth = picture(blur=0.3, noise=0, dtype=np.float64)
    soft = cv2.GaussianBlur(light, (0, 0), 1.2)
    image = np.clip(40 + 0.5 * (light + 1.5 * (light - soft)), 0, 255)
    packed = cv2.imencode(".jpg", np.rint(image).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
    found = detect_board(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), BOARD)
    assert int(torch.isfinite(found.pixels).all(-1).sum()) == 54
    assert rms(found.pixels, truth) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "columns", "rows"), [("pi640", 7, 7), ("gloworm960", 8, 6)])
def test_real_boards_are_all_found(folder, columns, rows):
    data = os.environ.get("KCAL_DATA")
    if not data:
        pytest.skip("KCAL_DATA is not set: no real images")
    paths = sorted(Path(data, "captures", folder).glob("*.jpg"))
    board = Board(columns=columns, rows=rows, square=0.025)
    found = [detect_board(read_gray(path), board).pixels for path in paths]
    assert len(found) == 25
    assert all(one is not None and bool(torch.isfinite(one).all()) for one in found)
