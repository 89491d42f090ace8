import numpy as np
import pytest
import torch
from board_render import homography, render
from hypothesis import given, settings
from hypothesis import strategies as st

from kcal.corners.board import Board
from kcal.corners.detect import detect_board
from kcal.corners.grid import as_grid, cell_levels, first_square_dark, goes_on, grid_trouble, local_side
from kcal.corners.search import canonical_order
from kcal.errors import InputError

SIZE = (220, 220)


def orders(grid):
    """All orders of a grid of corners that a detector could return for its columns and rows."""
    turned = [grid, grid.flip(0), grid.flip(1), grid.flip(0, 1)]
    if grid.shape[0] == grid.shape[1]:
        turned += [order.transpose(0, 1) for order in turned]
    return [order.reshape(-1, 2) for order in turned]


def flat(board, degrees, square=16, dark_first=True):
    H = homography(board, SIZE, square, roll=np.radians(degrees))
    return render(board, SIZE, H, noise=1, supersample=2, dark_first=dark_first)


@pytest.mark.parametrize("degrees", range(0, 360, 30))
@pytest.mark.parametrize(("columns", "rows"), [(6, 5), (5, 6)])
def test_unambiguous_board_keeps_its_order_however_it_is_held(columns, rows, degrees):
    board = Board(columns=columns, rows=rows, square=0.02)
    image, truth = flat(board, degrees)
    for order in orders(truth.reshape(rows, columns, 2)):
        assert bool((canonical_order(image, order, board) == truth).all())


@pytest.mark.parametrize("degrees", [0, 25, 90, 155, 180, 270, 335])
def test_detected_corners_are_the_true_ones(degrees):
    board = Board(columns=6, rows=5, square=0.02)
    image, truth = flat(board, degrees)
    found = detect_board(image, board)
    # A wrong order would be off by whole squares; 0.05 px is five sigma of the refinement.
    assert float((found.pixels - truth).abs().max()) < 0.05


@settings(max_examples=25, deadline=None)
@given(st.floats(-89, 89), st.sampled_from([(6, 4), (5, 3), (7, 5)]), st.booleans())
def test_ambiguous_board_is_read_upright(degrees, size, dark_first):
    board = Board(columns=size[0], rows=size[1], square=0.02)
    image, truth = flat(board, degrees, dark_first=dark_first)
    results = [canonical_order(image, order, board) for order in orders(truth.reshape(size[1], size[0], 2))]
    for result in results:
        assert bool((result == truth).all())
    upside_down, turned = flat(board, degrees + 180, dark_first=dark_first)
    result = canonical_order(upside_down, turned, board)
    assert bool((result == turned.flip(0)).all())


@pytest.mark.parametrize("count", [4, 5])
@pytest.mark.parametrize("degrees", [0, 20, 70, 90, 110, 180, 250, 290])
def test_square_boards(count, degrees):
    board = Board(columns=count, rows=count, square=0.02)
    image, truth = flat(board, degrees)
    results = [canonical_order(image, order, board) for order in orders(truth.reshape(count, count, 2))]
    for result in results:
        assert bool((result == results[0]).all())  # whatever the detector began with
    grid = as_grid(results[0], count, count)
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    assert float(across[0] * down[1] - across[1] * down[0]) > 0  # never mirrored
    lean = np.degrees(np.arctan2(float(across[1]), float(across[0])))
    if count % 2 == 0:  # all four corners look alike: nearest to upright
        assert abs(lean) <= 45 + 1e-6
    else:  # two of four have a dark outer square
        assert first_square_dark(image, results[0], count, count)[0]
        assert abs(lean) <= 90 + 1e-6


def test_uneven_light_does_not_change_the_order():
    board = Board(columns=6, rows=5, square=0.02)
    image, truth = flat(board, 200)
    ramp = np.linspace(0.2, 1, SIZE[0])[None] * np.linspace(0.3, 1, SIZE[1])[:, None]
    dim = np.rint(image * ramp).astype(np.uint8)
    assert dim[:60, :60].max() < image.min() * 2  # its light squares are nearly as dark as dark ones elsewhere
    assert bool((canonical_order(dim, truth.flip(0), board) == truth).all())


def test_local_side():
    board = Board(columns=4, rows=3, square=0.02)
    points = board.points[:, :2] / board.square * torch.tensor([10.0, 7.0])
    assert local_side(points, 4, 3).tolist() == [7.0] * 12
    stretched = points.clone()
    stretched[points[:, 0] == 30, 0] = 36
    stretched[:, 1] *= 2
    assert local_side(stretched, 4, 3).tolist() == [10.0, 10.0, 10.0, 14.0] * 3
    with pytest.raises(InputError, match=r"shape \(12, 2\) is needed for 4x3"):
        local_side(points[:-1], 4, 3)


def test_cell_levels_and_first_square():
    board = Board(columns=5, rows=4, square=0.02)
    image, truth = flat(board, 10)
    levels = cell_levels(image, truth, 5, 4)
    assert levels.shape == (3, 4)
    assert float(levels[0, 0]) == pytest.approx(40, abs=3)  # dark gray of the renderer, noise 1
    assert float(levels[0, 1]) == pytest.approx(215, abs=3)
    assert first_square_dark(image, truth, 5, 4) == (True, 1.0)
    light_first, _ = flat(board, 10, dark_first=False)
    assert first_square_dark(light_first, truth, 5, 4) == (False, 1.0)


@pytest.mark.parametrize("degrees", [0, 40, 180])
@pytest.mark.parametrize("part", ["left", "right", "top", "bottom", "middle"])
def test_part_of_a_larger_board_is_refused(part, degrees):
    board = Board(columns=7, rows=6, square=0.02)
    image, truth = flat(board, degrees)
    cut = {
        "left": (slice(None), slice(0, 6)),
        "right": (slice(None), slice(1, 7)),
        "top": (slice(0, 5), slice(None)),
        "bottom": (slice(1, 6), slice(None)),
        "middle": (slice(1, 5), slice(1, 5)),
    }[part]
    grid = truth.reshape(6, 7, 2)[cut]
    rows, columns = grid.shape[:2]
    assert "go on beyond" in str(grid_trouble(image, grid.reshape(-1, 2), columns, rows))
    assert grid_trouble(image, truth, 7, 6) is None


@pytest.mark.parametrize("surround", [0, 40, 128, 215, 255])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.35, 0.2), (-0.3, 0.35)])
def test_the_whole_board_is_accepted_on_any_background(surround, tilt):
    board = Board(columns=7, rows=6, square=0.02)
    H = homography(board, SIZE, 18, tilt, 0.3)
    image, truth = render(board, SIZE, H, noise=3, supersample=2)
    outline = np.array([[-1, -1, 1], [7, -1, 1], [7, 6, 1], [-1, 6, 1]]) @ H.T
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    inside = np.ones(x.shape, bool)
    corners = outline[:, :2] / outline[:, 2:]
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, 0), strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0
    image[~inside] = surround
    assert not goes_on(image, truth, 7, 6)
    assert grid_trouble(image, truth, 7, 6) is None


def test_wrong_grids_are_refused_with_a_reason():
    board = Board(columns=6, rows=5, square=0.02)
    image, truth = flat(board, 15)
    grid = truth.reshape(5, 6, 2)

    def trouble(changed, picture=image):
        return str(grid_trouble(picture, changed.reshape(-1, 2), 6, 5))

    skipped = grid.clone()
    skipped[:, 3:] += grid[:, 4:5] - grid[:, 3:4]  # a column jumped over
    assert "uneven" in trouble(skipped)
    one_off = grid.clone()
    one_off[2, 2] += torch.tensor([6.0, -5.0])
    assert "uneven" in trouble(one_off)
    folded = grid.clone()
    folded[2] = grid[4]
    assert "folded" in trouble(folded)
    swapped = grid.clone()
    swapped[2, 2], swapped[2, 3] = grid[2, 3], grid[2, 2]
    assert "folded" in trouble(swapped)
    assert "dark and light" in trouble(grid, np.random.default_rng(0).integers(0, 255, image.shape, dtype=np.uint8))
    assert "move closer" in trouble(grid / 5)
    assert "finite" in trouble(grid * float("nan"))


def test_strong_barrel_distortion_is_no_reason_to_refuse():
    board = Board(columns=9, rows=7, square=0.02)
    plane = (board.points[:, :2] / board.square - torch.tensor([4.0, 3.0])) / 4
    radius = plane.norm(dim=-1, keepdim=True)
    bent = plane * (radius.clamp(min=1e-9) * 1.1).atan() / radius.clamp(min=1e-9) * 90 + 110
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    direction = np.stack([x - 110, y - 110], -1) / 90
    length = np.linalg.norm(direction, axis=-1, keepdims=True).clip(1e-9, 1.4)
    seen = np.tan(length) / 1.1 / length * direction * 4 + np.array([4.0, 3.0])
    cell = np.floor(seen).astype(int)
    on_board = (cell >= -1).all(-1) & (cell[..., 0] < 9) & (cell[..., 1] < 7)
    image = np.where(on_board & (cell.sum(-1) % 2 == 0), 40, 215).astype(np.uint8)
    assert grid_trouble(image, bent, 9, 7) is None
