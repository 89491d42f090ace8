"""Parts of detection against hand calculations: grids, light, neighboring lines, correlation of patches, sizes."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.circles import _goes_on, _symmetric, wrong_size
from kcal.corners.erf import _bounded, _odd
from kcal.corners.erf_board import (
    RAMP_WEIGHT,
    UNKNOWN_RAMP,
    CornerWindow,
    RampPrior,
    curvatures,
    light_slope,
    neighbor_lines,
)
from kcal.corners.grid import (
    Neighbors,
    _bend,
    _beyond,
    _change,
    _corner_areas,
    _curvature,
    _ratio,
    _smooth,
    cell_levels,
    checkered,
    contrast,
    false_sides,
    first_square_dark,
    levels_at,
    levels_beside,
    neighbors,
    sharpness,
    without_false_sides,
)
from kcal.corners.marker_boards import in_place, inliers
from kcal.corners.recognize import like_sized, smallest
from kcal.corners.search import (
    _predicted,
    filled_grid,
    grown_grid,
    local_steps,
    reduced,
    search_sizes,
    to_full_size,
)
from kcal.corners.video import Frame, _sharpness, is_new_view, sharpest


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


SQUARE = 20


def squares(columns: int, rows: int, margin: int = 30) -> tuple[np.ndarray[Any, Any], Tensor]:
    """A board of so many squares with its first one dark, and its inner corners (rows - 1, columns - 1, 2)."""
    image = np.full((rows * SQUARE + 2 * margin, columns * SQUARE + 2 * margin), 220, np.uint8)
    for i in range(rows):
        for j in range(columns):
            if (i + j) % 2 == 0:
                y, x = margin + i * SQUARE, margin + j * SQUARE
                image[y : y + SQUARE, x : x + SQUARE] = 20
    y, x = torch.meshgrid(torch.arange(1, rows).double(), torch.arange(1, columns).double(), indexing="ij")
    return image, torch.stack([margin + SQUARE * x - 0.5, margin + SQUARE * y - 0.5], -1)


def seen_aside(rows: int = 5, columns: int = 6) -> Tensor:
    """A grid in perspective: marks at b t / (1 + c t) along rows."""
    y, x = torch.meshgrid(torch.arange(rows).double(), torch.arange(columns).double(), indexing="ij")
    w = 1 + 0.03 * x + 0.02 * y
    return torch.stack([(40 + 30 * x + 4 * y) / w, (25 + 2 * x + 28 * y) / w], -1)


class TestGrid:
    def test_perspective_bends_no_block_and_changes_sides_slowly(self) -> None:
        grid = seen_aside()
        assert float(_bend(grid)) < 1e-9
        side = torch.linalg.vector_norm(grid.diff(dim=1), dim=-1)
        down = torch.linalg.vector_norm(grid.diff(dim=0), dim=-1)
        ratios = [torch.maximum(a / b, b / a).max() for a, b in ((side[:, 1:], side[:, :-1]), (down[1:], down[:-1]))]
        assert float(_ratio(grid)) == pytest.approx(float(max(ratios)))
        assert bool((_corner_areas(grid) > 0).all())
        assert bool((_corner_areas(grid.flip(0)) < 0).all())
        # Parallelograms: twice the area of each triangle is that of the square.
        assert _corner_areas(squares(4, 4)[1]).unique().tolist() == [SQUARE**2]
        # A corner of a regular grid that is off by a tenth of a square, least squares of its blocks.
        moved = squares(6, 6)[1].clone()
        moved[0, 0, 0] += 2.0
        assert 0.02 < float(_bend(moved)) < 0.1
        assert float(_ratio(moved)) == pytest.approx(20 / 18)

    def test_levels_beside_a_corner(self) -> None:
        image, grid = squares(6, 5)
        along, down = torch.tensor([20.0, 0.0]).double(), torch.tensor([0.0, 20.0]).double()
        after, before = levels_beside(image, grid[0, 0], along, down)
        # The square outside the first corner is dark, so is the one inside.
        assert (float(after), float(before)) == (20.0, 220.0)
        assert float(contrast(image, grid[0, 0], along, down)) == pytest.approx(-400.0)
        assert float(contrast(image, grid[0, 1], along, down)) == pytest.approx(400.0)
        cells = cell_levels(image, grid)
        assert cells[0, 0] == 20.0
        assert cells[0, 1] == cells[1, 0] == 220.0
        assert first_square_dark(image, grid) == (True, 1.0)
        assert first_square_dark(255 - image, grid) == (False, 1.0)
        outside = levels_at(image, torch.tensor([[-9.0, 3.0], [1e4, 1e4], [math.nan, 0.0]]))
        assert outside[:2].tolist() == [220.0, 220.0]
        assert math.isnan(outside[2])

    @pytest.mark.parametrize(("share", "expected"), [(0.2, 0.64), (0.25, 0.54)])
    def test_sharpness_of_blurred_squares(self, share: float, expected: float) -> None:
        image, grid = squares(8, 7)
        blurred = cv2.GaussianBlur(image.astype(np.float64), (0, 0), share * SQUARE)
        assert sharpness(image, grid) == pytest.approx(1.0)
        assert sharpness(blurred, grid) == pytest.approx(expected, abs=0.03)

    def test_the_edge_of_the_board_is_no_line_of_corners(self) -> None:
        """On dark ground the outer edge looks like another line."""
        image, grid = squares(8, 7, margin=40)
        image[:30], image[-30:], image[:, :30], image[:, -30:] = 20, 20, 20, 20
        step = torch.tensor([0.0, 20.0]).double()
        for line, side in ((torch.cat([grid[:1] - step, grid]), 0), (torch.cat([grid, grid[-1:] + step]), 1)):
            assert false_sides(image, line).tolist() == [k == side for k in range(4)]
            kept = without_false_sides(image, line)
            assert kept is not None
            torch.testing.assert_close(kept, grid)
        assert not false_sides(image, grid).any()

    def test_lines_on_circles(self) -> None:
        angle = torch.linspace(-0.2, 0.2, 5, dtype=torch.float64)
        line = torch.stack([50 * angle.sin(), 50 - 50 * angle.cos()], -1)[None]
        bend = _curvature(line)
        assert bool(torch.isnan(bend[0, [0, -1]]).all())
        # Towards the center, as much as one over the radius.
        towards = torch.nn.functional.normalize(torch.tensor([0.0, 50.0]) - line[0, 2], dim=0)
        torch.testing.assert_close(bend[0, 2], towards / 50)
        torch.testing.assert_close(torch.linalg.vector_norm(bend[0, 1:-1], dim=-1), torch.full((3,), 0.02).double())

    def test_quadratics_are_followed_exactly(self) -> None:
        i, j = torch.meshgrid(torch.arange(4).double(), torch.arange(5).double(), indexing="ij")
        values = torch.stack([1 + i - 2 * j + 0.3 * i * j, 0.2 * i * i - 0.1 * j * j], -1)
        holed = values.clone()
        holed[1, 2] = math.nan
        torch.testing.assert_close(_smooth(holed), values, rtol=0, atol=1e-9)
        assert not _smooth(torch.full((3, 3, 2), math.nan).double()).any()
        # Where lines are quadratic, the next corner is where they lead.
        inner = values.clone()
        inner[0, 3] = math.nan
        torch.testing.assert_close(_predicted(inner)[0, 3], values[0, 3])
        along, down = local_steps(values[:2, :2])
        torch.testing.assert_close(along[0, 0], values[:2, :2].diff(dim=1).mean((0, 1)))
        torch.testing.assert_close(down[0, 0], values[:2, :2].diff(dim=0).mean((0, 1)))
        assert checkered(values).tolist()[:2] == [[1, -1, 1, -1, 1], [-1, 1, -1, 1, -1]]

    def test_the_step_beyond_a_border_follows_perspective(self) -> None:
        t = torch.arange(4).double()
        at = 60 * t / (1 + 0.05 * t)
        marks = torch.stack([at, 0 * at], -1)[None]
        before = 60 * -1.0 / (1 - 0.05)
        step, following = marks[:, 1] - marks[:, 0], marks[:, 2] - marks[:, 1]
        torch.testing.assert_close(
            _beyond(step[:, None], following[:, None])[0, 0], torch.tensor([before, 0.0]).double()
        )
        # Without a second one: the mirror image of the first.
        unknown = torch.full_like(following, math.nan)
        torch.testing.assert_close(_beyond(step[:, None], unknown[:, None])[0, 0], -step[0])
        assert _change(torch.tensor([[1.0], [3.0], [9.0]]).double())[:, 0].tolist() == [2.0, 4.0, 6.0]

    def test_grids_grow_and_are_filled(self) -> None:
        image, grid = squares(8, 7)
        image = cv2.GaussianBlur(image, (0, 0), 0.8)
        found = grown_grid(image, grid[2:5, 2:5], 9)
        assert found.shape == grid.shape
        torch.testing.assert_close(found, grid, rtol=0, atol=0.05)
        holed = grid.clone()
        holed[1, 2] = holed[3, 0] = math.nan
        torch.testing.assert_close(filled_grid(image, holed, 0.4), grid, rtol=0, atol=0.05)


class TestLight:
    def test_its_slope_is_that_of_a_quadratic(self) -> None:
        place = torch.cartesian_prod(torch.arange(6).double(), torch.arange(5).double())[None] * 30
        x, y = place.unbind(-1)
        light = 1.0 + 0.002 * x - 0.001 * y + 2e-6 * x * x - 1e-6 * x * y
        usable = torch.ones(1, 30, dtype=torch.bool)
        slope, error = light_slope(light, place, torch.full((1, 30), 30.0).double(), usable)
        by_hand = torch.stack([0.002 + 4e-6 * x - 1e-6 * y, -0.001 - 1e-6 * x], -1) / light[..., None]
        torch.testing.assert_close(slope, by_hand[0], rtol=1e-7, atol=1e-12)
        assert float(error.max()) < 1e-9
        # What it does not explain varies over two corners at the fastest.
        rough = light + 0.01 * draw(1, 30)
        _, error = light_slope(rough, place, torch.full((1, 30), 30.0).double(), usable)
        design = torch.stack([torch.ones(30).double(), x[0], y[0], x[0] ** 2, x[0] * y[0], y[0] ** 2], -1)
        smooth = design @ torch.linalg.lstsq(design, rough[0, :, None], driver="gelsd").solution
        rest = float((rough[0] - smooth[:, 0]).square().sum() / 24) ** 0.5
        torch.testing.assert_close(error, rest / (60 * smooth[:, 0]), rtol=1e-6, atol=0)
        few = usable.clone()
        few[0, 11:] = False
        slope, error = light_slope(light, place, torch.full((1, 30), 30.0).double(), few)
        assert not slope.any()
        assert error.unique().tolist() == [UNKNOWN_RAMP]

    def test_the_prior_counts_as_much_as_it_is_known(self) -> None:
        parameters = torch.zeros(3, 10).double()
        parameters[:, 5], parameters[:, 6] = 3.0, 4.0
        most = RAMP_WEIGHT * 25.0
        error = torch.tensor([1e-4, 1e-2, 1e-9]).double()
        prior = RampPrior.of(parameters, torch.ones(3, 2).double(), error, torch.full((3,), 1e-6).double())
        torch.testing.assert_close(prior.weight, torch.tensor([1e-6 / 1e-8, most, most]).double())
        assert prior.diagonal()[0].tolist() == [0.0] * 7 + [pytest.approx(100.0)] * 2 + [0.0]
        assert prior.value()[1].tolist() == [0.0] * 7 + [1.0, 1.0, 0.0]
        assert prior.of_some(torch.tensor([True, False, False])).error.tolist() == pytest.approx([1e-4])


def edges(first: float, second: float) -> Tensor:
    """Parameters of two edges at these angles."""
    parameters = torch.zeros(1, 10).double()
    parameters[0, 2], parameters[0, 3] = first, second
    return parameters


class TestLines:
    def test_each_edge_has_the_bend_of_the_line_that_it_follows(self) -> None:
        # The row's line lies along x and bends downwards (y), the column's along y and bends to the left.
        bend = torch.tensor([[[0.0, 0.03], [-0.01, 0.0]]]).double()
        # Normals of edges along x and y are y and -x.
        torch.testing.assert_close(curvatures(bend, edges(0.0, math.pi / 2)), torch.tensor([[0.03, 0.01]]).double())
        torch.testing.assert_close(curvatures(bend, edges(math.pi / 2, 0.0)), torch.tensor([[0.01, 0.03]]).double())

    def test_lines_beside_each_edge(self) -> None:
        """Neighbors 10 px to the left and right, 8 px above and 12 px below; the board ends below."""
        step = torch.tensor([[[-10.0, 0.0], [10.0, 0.0], [0.0, -8.0], [0.0, 12.0]]]).double()
        change = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [0.0, -0.5], [0.0, 0.7]]]).double()
        outer = torch.tensor([[False, False, False, True]])
        found = neighbor_lines(Neighbors(step, change, outer), edges(0.0, math.pi / 2))
        # Across the edge along x, whose normal is y: 12 px below first, then 8 px above.
        assert found.distance[0, 0].tolist() == [12.0, 8.0]
        assert found.turn[0, 0].tolist() == [0.5, 1.0]
        # Per pixel along the edge: a step along the row is 10 px.
        torch.testing.assert_close(found.change[0, 0], torch.tensor([0.07, 0.05]).double())
        # Across the edge along y, whose normal is -x: the left one first.
        assert found.distance[0, 1].tolist() == [10.0, 10.0]
        assert found.turn[0, 1].tolist() == [1.0, 1.0]
        swapped = neighbor_lines(Neighbors(step, change, outer), edges(math.pi / 2, 0.0))
        assert swapped.distance[0, 1].tolist() == [12.0, 8.0]
        assert swapped.distance[0, 0].tolist() == [10.0, 10.0]
        unseen = step.clone()
        unseen[0, 2:] = math.nan
        alone = neighbor_lines(Neighbors(unseen, change, outer), edges(0.0, math.pi / 2))
        assert alone.turn[0].tolist() == [[0.0, 0.0], [1.0, 1.0]]
        assert alone.distance[0, 0].tolist() == [1e6, 1e6]
        lines = found.distances(edges(0.0, math.pi / 2), torch.tensor([[3.0, 1.0], [-400.0, 0.0]]).double())
        torch.testing.assert_close(lines.distance[0, 0, 0], torch.tensor([12.21, 1.0]).double())

    def test_neighbors_of_a_real_grid(self) -> None:
        grid = seen_aside()
        around = neighbors(grid.reshape(-1, 2), 6, 5)
        torch.testing.assert_close(around.step[8, 0], grid[1, 1] - grid[1, 2])
        torch.testing.assert_close(around.step[8, 3], grid[2, 2] - grid[1, 2])
        torch.testing.assert_close(around.change[8, 3], 0.5 * ((grid[2, 3] - grid[1, 3]) - (grid[2, 1] - grid[1, 1])))
        assert around.outer[5].tolist() == [False, True, True, False]


class TestSpread:
    def test_bounds_of_a_covariance(self) -> None:
        """In the directions in which it is too small or too large beside that of white noise."""
        white = torch.diag(torch.tensor([4.0, 1.0])).double()
        found = _bounded(torch.diag(torch.tensor([0.04, 30.0])).double(), white)
        torch.testing.assert_close(found, torch.diag(torch.tensor([0.4, 10.0])).double())
        within = torch.tensor([[5.0, 0.5], [0.5, 2.0]]).double()
        torch.testing.assert_close(_bounded(within, white), within)

    def test_the_odd_part_about_a_corner(self) -> None:
        axis = torch.arange(5).double() - 2
        odd = (axis[:, None] + 2 * axis[None])[None, None]
        even = (axis[:, None] * axis[None])[None, None]
        weight = torch.ones(1, 1, 5, 5).double()
        found, pair = _odd(odd + even, weight, torch.zeros(1, 1, 2).double())
        torch.testing.assert_close(found, 2.0 * odd * 0.5**0.5)
        assert bool((pair == 1).all())
        # About a corner half a pixel to the right, the first column has no opposite.
        _, pair = _odd(odd, weight, torch.tensor([[[0.5, 0.0]]]).double())
        assert pair[0, 0, 0].tolist() == [0, 1, 1, 1, 1]
        _, pair = _odd(odd, weight, torch.tensor([[[0.0, 1.0]]]).double())
        assert pair[0, 0, :, 0].tolist() == [0, 0, 1, 1, 1]
        lopsided = weight.clone()
        lopsided[0, 0, 2, 4] = 0.3
        _, pair = _odd(odd, lopsided, torch.zeros(1, 1, 2).double())
        assert pair[0, 0, 2].tolist() == [0.3, 1, 1, 1, 0.3]

    def test_windows(self) -> None:
        places = torch.arange(49)
        window = CornerWindow(
            torch.zeros(1, 49), torch.tensor([[0.25, 0.0]]).double(), torch.tensor([2.0]).double(), places, 7
        )
        assert window.where[0].tolist() == [-3.0, -3.0]
        weight = window.patches(window.weight)[0]
        # 2.5 less the distance, within 0 and 1.
        assert weight[3].tolist() == pytest.approx([0.0, 0.25, 1.0, 1.0, 1.0, 0.75, 0.0])
        assert float(weight[1, 3]) == pytest.approx(2.5 - math.hypot(2, 0.25))
        assert window.of(torch.tensor([0])).radius.tolist() == [2.0]
        coarse = window.coarse()
        # Each row and each column of five has one pixel.
        assert coarse.where.long().tolist() == [
            [1, -3], [-1, -2], [-3, -1], [2, -1], [0, 0], [-2, 1], [3, 1], [1, 2], [-1, 3]
        ]  # fmt: skip


class TestFrames:
    def test_views_that_are_new(self) -> None:
        corners = torch.tensor([[0.0, 0.0], [10.0, 0.0]]).double()
        moved = corners + torch.tensor([3.0, 4.0])
        assert not is_new_view(moved, [corners], 5.1)
        assert is_new_view(moved, [corners], 4.9)
        assert not is_new_view(moved, [corners + 900, corners], 5.1)
        assert is_new_view(torch.full_like(corners, math.nan), [corners], 5.0)

    def test_the_sharpest_of_seven(self) -> None:
        frames = [Frame(i, np.full((8, 8), 7, np.uint8)) for i in range(9)]
        for number, level in ((2, 40), (5, 90), (8, 20)):
            frames[number].image[3, 3] = level
        assert [frame.number for frame in sharpest(iter(frames))] == [5, 8]
        step = np.zeros((4, 5), np.uint8)
        step[:, 2:] = 10
        assert _sharpness(step) == pytest.approx(100 / 4)
        # Of large images every other row, or fewer.
        tall = np.zeros((1080, 4), np.uint8)
        tall[1::2, 2:] = 10
        assert _sharpness(tall) == 0.0


class TestSizes:
    def test_reduced_images_have_the_same_edges(self) -> None:
        image = np.arange(30 * 40, dtype=np.uint16).reshape(30, 40)
        small, scale = reduced(image, 2.0, (40, 30))
        assert (small.shape, scale.tolist(), small.dtype) == ((15, 20), [2.0, 2.0], np.uint16)
        assert abs(float(small[0, 0]) - (0 + 1 + 40 + 41) / 4) <= 0.5
        # The middle of the first small pixel lies between the first two.
        assert to_full_size(torch.zeros(2).double(), scale).tolist() == [0.5, 0.5]
        same, scale = reduced(image, 1.0, (40, 30))
        assert same is image
        assert [factor for factor, _, _ in search_sizes(np.zeros((3600, 10), np.uint8))] == [3.0, 1.5]
        assert [factor for factor, _, _ in search_sizes(np.zeros((900, 1200), np.uint8))] == [1.0]
        assert [factor for factor, _, _ in search_sizes(np.zeros((900, 2000), np.uint8))] == [2000 / 1200, 1.0]

    def test_sizes_of_circles(self) -> None:
        board = Board.parse("circles:7x6:10mm", "20mm")
        assert wrong_size(board, 0.0062) == ""
        assert "12.6 mm wide where their distance is 20 mm, the board's are 10 mm" in wrong_size(board, 0.0063)
        assert wrong_size(board, 0.00401) == ""
        assert wrong_size(board, 0.0039)
        assert wrong_size(Board.parse("circles:7x6", "20mm"), 0.5) == ""
        matrix = draw(3, 2, 2)
        found = _symmetric(matrix)
        torch.testing.assert_close(found @ found, matrix.mT @ matrix)
        torch.testing.assert_close(found, found.mT)

    @pytest.mark.parametrize("text", ["circles:5x4", "asymmetric:4x7"])
    def test_circles_beside_the_grid(self, text: str) -> None:
        board = Board.parse(text, "20mm")
        grid = 1e3 * board.points[:, :2] + 100
        assert not _goes_on(grid, grid, board)
        places = grid.reshape(board.rows, board.columns, 2)
        wide = 40.0 if board.pattern == "asymmetric" else 20.0
        beyond = places[:, -1] + torch.tensor([wide, 0.0])
        assert _goes_on(torch.cat([grid, beyond]), grid, board)
        # A half of them is not enough.
        assert not _goes_on(torch.cat([grid, beyond[: len(beyond) // 2]]), grid, board)
        last = (
            places[-2] + torch.tensor([0.0, 40.0])
            if board.pattern == "asymmetric"
            else places[-1] + torch.tensor([0.0, 20.0])
        )
        assert _goes_on(torch.cat([grid, last]), grid, board)

    def test_the_smallest_dictionary_with_a_number(self) -> None:
        assert smallest("5x5_250", 49) == "5x5_50"
        assert smallest("5x5_250", 50) == "5x5_100"
        assert smallest("5x5_250", 249) == "5x5_250"
        assert smallest("apriltag_16h5", 3) == "apriltag_16h5"

    def test_spots_of_like_size(self) -> None:
        image = np.full((400, 400), 230, np.uint8)
        for k in range(15):
            cv2.circle(image, (50 + 70 * (k % 5), 60 + 90 * (k // 5)), 14, 20, -1)
        cv2.circle(image, (350, 350), 40, 20, -1)
        assert len(like_sized(image)) == 15
        assert len(like_sized(255 - image)) == 15
        assert like_sized(np.full((100, 100), 200, np.uint8)) == []

    def test_markers_in_their_places(self) -> None:
        square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        placed = np.stack([square + np.array([2.0 * (k % 4), 2.0 * (k // 4)]) for k in range(12)])
        # A lens that bends the board: a marker at its end is off the homography of those at its beginning.
        seen = 10 * placed + 0.12 * placed**2
        assert in_place(placed, seen, 0.2).all()
        wrong = seen.copy()
        wrong[5] = seen[6]
        assert in_place(placed, wrong, 0.2).tolist() == [k != 5 for k in range(12)]
        assert inliers(placed[:1], seen[:1], 0.2).tolist() == [True]
        assert inliers(placed, 10 * placed + 3, 0.01).all()
