"""Where the limits of grids, ends of boards, places and matches lie: just within, and just beyond."""

import math
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal import Board, InputError
from kcal.corners import search
from kcal.corners.circles import _degree, homography, local_maps
from kcal.corners.grid import false_sides, goes_on, grid_trouble, sides, skips, uneven
from kcal.corners.match import MatchOptions, MatchStatus, PatchMatch, fit_peak, joined
from kcal.corners.patches import Peak, grid_of, image_windows
from kcal.corners.saddle import _disc, _fits, _stationary, cut_patches
from kcal.corners.search import (
    _grown,
    _hidden_sides,
    _placements,
    board_ends,
    filled_grid,
    grown_grid,
    uprightness,
)

MIDDLE, CONTRAST = 120.0, 80.0


def alternating(rows: int, columns: int) -> NDArray[np.float64]:
    """-1 for dark and 1 for light squares; the first one is dark."""
    i, j = np.mgrid[:rows, :columns]
    return np.where((i + j) % 2 == 0, -1.0, 1.0)


def picture(
    signs: NDArray[np.float64], side: int = 20, margin: int = 40, ground: float = 1.0
) -> tuple[NDArray[np.uint8], Tensor]:
    """Squares of these contrasts on a margin, and the corners between them (rows - 1, columns - 1, 2)."""
    whole = np.pad(np.kron(signs, np.ones((side, side))), margin, constant_values=ground)
    i, j = torch.meshgrid(*(torch.arange(1, n).double() for n in signs.shape), indexing="ij")
    return (MIDDLE + CONTRAST * whole).round().astype(np.uint8), torch.stack([j, i], -1) * side + margin - 0.5


def seen_from(turn: int, image: NDArray[Any], grid: Tensor) -> tuple[NDArray[Any], Tensor]:
    """The same with the first row at the top, bottom, left or right."""
    across = turn >= 2
    image, grid = (image.T, grid.transpose(0, 1).flip(-1)) if across else (image, grid)
    if turn in (1, 3):
        image = image[:, ::-1] if across else image[::-1]
        size = image.shape[1] if across else image.shape[0]
        grid = grid.flip(1 if across else 0).clone()
        grid[..., 0 if across else 1] = size - 1 - grid[..., 0 if across else 1]
    return np.ascontiguousarray(image), grid


class TestWholeBoards:
    @pytest.mark.parametrize("turn", range(4))
    def test_squares_go_on_where_a_row_beyond_has_half_their_contrast(self, turn: int) -> None:
        """The mean of its contrast and that of the outer squares is more than three quarters."""
        for share, more in ((0.42, False), (0.6, True)):
            signs = alternating(7, 6)
            signs[0] *= share
            image, grid = seen_from(turn, *picture(signs))
            part = (grid[1:], grid[:-1], grid[:, 1:], grid[:, :-1])[turn]
            assert goes_on(image, part) is more
        # Where most of that row is outside of the image nothing goes on.
        signs = alternating(7, 6)
        image, grid = picture(signs, margin=0)
        part, cut = grid[1:] - torch.tensor([0.0, 15.0]), image[15:]
        assert not goes_on(cut, part)
        assert goes_on(image, grid[1:])

    @pytest.mark.parametrize("turn", range(4))
    def test_squares_go_on_a_quarter_of_a_square_beside_where_a_lens_bends_them(self, turn: int) -> None:
        """Squares of the row beyond are lower than those before: 8x6 was found on a 9x6 before a fisheye."""
        image, grid = picture(alternating(7, 6))
        low = np.delete(image, slice(62, 67), 0)
        low = np.concatenate([low, low[-5:]])  # the same size
        whole, grid = seen_from(turn, low, grid - torch.tensor([0.0, 5.0]))
        assert goes_on(whole, (grid[1:], grid[:-1], grid[:, 1:], grid[:, :-1])[turn])

    @pytest.mark.parametrize("turn", range(4))
    def test_an_outer_line_needs_a_third_of_the_contrast_outside(self, turn: int) -> None:
        for share, false in ((0.3, True), (0.4, False)):
            signs = alternating(7, 6)
            signs[0] *= share
            image, grid = seen_from(turn, *picture(signs, ground=0.0))
            assert false_sides(image, grid).tolist() == [false and k == turn for k in range(4)]

    @pytest.mark.parametrize("turned", [False, True])
    def test_a_line_is_skipped_where_four_colors_meet_between(self, turned: bool) -> None:
        """Half of a corner's contrast: (1 - g) / (1 + g) where halves of a square have contrasts of 1 and g."""
        for share, skipped in ((0.28, True), (0.4, False)):
            signs = np.repeat(alternating(5, 6), 2, 0)
            signs[1::2] *= share
            image, grid = picture(signs)
            lines = grid[1::2]
            if turned:
                image, lines = np.ascontiguousarray(image.T), lines.transpose(0, 1).flip(-1)
            assert skips(image, lines) is skipped

    @pytest.mark.parametrize(("wide", "meet", "even"), [(33, 0, True), (35, 0, False), (53, 1, True), (55, 1, False)])
    def test_sides_may_grow_by_seventy_percent(self, wide: int, meet: int, even: bool) -> None:
        """From one square to the next, and 2.7 times where four squares meet at each corner.

        Three corners on a line have a homography whatever their distances are.
        """
        image, grid = picture(alternating(4, 4))
        image = np.concatenate([image[:, :80], np.repeat(image[:, 80:81], wide - 20, 1), image[:, 80:]], 1)
        moved = grid.clone()
        moved[:, 2, 0] += wide - 20
        if not meet:
            image[50:70, 50:70] = 120  # at one corner
        assert (uneven(image, moved) is None) is even
        assert (uneven(np.ascontiguousarray(image.T), moved.transpose(0, 1).flip(-1)) is None) is even

    @pytest.mark.parametrize("axis", [0, 1])
    def test_a_corner_may_be_off_where_squares_meet(self, axis: int) -> None:
        """Off by d, it bends the homography of its block so that .8148 d are left; the smallest side is 1 - d."""
        image, grid = picture(alternating(4, 4), side=100)
        plain = image.copy()
        plain[190:290, 190:290] = 120  # at one corner
        cases = (0.230, True, plain), (0.240, False, plain), (0.29, True, image), (0.31, False, image)
        for share, even, seen in cases:
            assert seen is image or (0.8148 * share / (1.0 - share) < 0.25) is even
            moved = grid.clone()
            moved[1, 1, axis] += 100.0 * share
            assert (uneven(seen, moved) is None) is even

    def test_nine_of_ten_pairs_of_squares_alternate(self) -> None:
        for place, even in (((1, 1), True), ((1, 2), False)):
            signs = alternating(6, 6)
            signs[place] *= -1.0  # between 5 x 5 corners are 4 x 4 squares with 24 pairs; these have two or three
            image, grid = picture(signs)
            assert (uneven(image, grid) is None) is even

    def test_squares_of_five_pixels(self) -> None:
        for side, trouble in ((5, None), (4, "the smallest square is only 4.0 px wide")):
            image, grid = picture(alternating(6, 7), side=side)
            found = grid_trouble(image, grid.reshape(-1, 2), 6, 5)
            assert found is None if trouble is None else trouble in str(found)


class TestParts:
    @pytest.mark.parametrize("turn", range(4))
    def test_where_a_board_ends(self, turn: int) -> None:
        """Outer squares keep more than half of their contrast, and beyond is less than a third of it."""

        def end(inner: float, outer: float, spoilt: int = 0, ground: float = 1.0, paper: bool = False) -> bool:
            signs = np.pad(np.repeat(alternating(5, 6), 2, 0), ((2, 0), (0, 0)))
            signs[2] *= inner
            signs[0] = signs[1] = -outer * signs[3] + ground * (outer == 0.0)
            if spoilt:
                # Beyond one or two corners squares go on.
                signs[:2, spoilt - 1] = -ground
            # Two parts of each square; its corners are every other line.
            image, grid = picture(np.repeat(signs, 1, 0), side=10)
            image = np.repeat(image, 2, 1)
            lines = grid[3::2] * torch.tensor([2.0, 1.0]) + torch.tensor([0.5, 0.0])
            image, lines = seen_from(turn, image, lines)
            return board_ends(image, lines, paper)[turn]

        assert end(1.0, 0.0)
        assert end(0.65, 0.0)
        assert not end(0.35, 0.0)
        assert end(1.0, 0.25)
        assert not end(1.0, 0.45)
        # Of five corners four must show it.
        assert end(1.0, 0.0, spoilt=1)
        assert not end(1.0, 0.0, spoilt=2)
        # Paper is lighter than squares are on average.
        assert end(1.0, 0.0, ground=0.2, paper=True)
        assert end(1.0, 0.0, ground=-0.2)
        assert not end(1.0, 0.0, ground=-0.2, paper=True)

    def test_places_of_a_part(self) -> None:
        """Three columns of a board of four: by its left end, or not at all, because it may have been turned."""
        board = Board(columns=4, rows=3, square=0.1)
        image, grid = picture(alternating(4, 5))
        whole = _placements(image, grid, (True,) * 4, board)
        assert len(whole) == 1
        assert torch.equal(whole[0], grid)
        turned = _placements(image, grid.flip(0, 1), (True,) * 4, board)
        assert len(turned) == 1
        assert torch.equal(turned[0], grid)
        part = grid[:, :3]
        left = _placements(image, part, (True, True, True, False), board)
        assert len(left) == 1
        assert torch.equal(left[0][:, :3], part)
        assert bool(left[0][:, 3].isnan().all())
        right = _placements(image, grid[:, 1:], (True, True, False, True), board)
        assert len(right) == 1
        assert torch.equal(right[0][:, 1:], grid[:, 1:])
        # With dark for light, the left end is that of the board held upside down.
        other = _placements(255 - image, part, (True, True, True, False), board)
        assert len(other) == 1
        assert torch.equal(other[0][:, 1:], part.flip(0, 1))
        assert len(_placements(image, part, (True, True, False, False), board)) == 2
        # A quarter turn: the columns are seen as rows.
        tall = _placements(image, grid.transpose(0, 1).flip(1), (True,) * 4, board)
        assert len(tall) == 1
        assert torch.equal(tall[0], grid)
        assert _placements(image, part, (True,) * 4, board) == []

    @pytest.mark.parametrize(("columns", "rows", "count"), [(4, 3, 1), (5, 3, 2), (4, 4, 4), (5, 5, 2), (6, 4, 2)])
    def test_turns_that_look_the_same(self, columns: int, rows: int, count: int) -> None:
        board = Board(columns=columns, rows=rows, square=0.1)
        assert len(board.quarter_turns) == count
        image, grid = picture(alternating(rows + 1, columns + 1))
        assert len(_placements(image, grid, (True,) * 4, board)) == count

    def test_sides_are_named_as_in_the_image(self) -> None:
        image, grid = picture(alternating(6, 7))
        cut, part = image[60:, 70:], grid[1:, 2:] - torch.tensor([70.0, 60.0])
        words = "the board is cut by the image's edge at the {} and {}, "
        words += "its end at the bottom is covered, glaring or unclear"
        assert _hidden_sides(cut, part, (False, False, False, True)) == words.format("top", "left")
        # Rows that go down the image: the first side is its right one.
        turned = part.transpose(0, 1).flip(0)
        ends = (True, False, False, False)
        assert _hidden_sides(cut, turned, ends) == words.format("left", "top")
        assert _hidden_sides(image, grid, (True, True, False, False)).startswith("its end at the left and right is")
        assert _hidden_sides(image, grid, (True,) * 4) == ""

    def test_what_grows_must_be_enough_and_no_more_than_the_board(self) -> None:
        image, grid = picture(alternating(6, 7))
        seed = grid[1:4, 1:4]
        whole = _grown(image, seed, Board(columns=6, rows=5, square=0.1)).pixels
        assert whole is not None
        torch.testing.assert_close(whole, grid.reshape(-1, 2), rtol=0, atol=0.02)
        other = _grown(image, seed, Board(columns=5, rows=5, square=0.1))
        assert other.other
        assert other.reason == "a board of 6x5 inner corners was found, not 5x5: give --board 6x5"
        assert other.rejected is not None
        assert len(other.rejected) == 30
        # Without an end in sight it is only known to be larger.
        inner, part = image[70:130, 70:170], seed - 70.0
        for columns, rows, large in ((3, 3, True), (4, 3, True), (5, 3, False)):
            found = _grown(inner, part, Board(columns=columns, rows=rows, square=0.1))
            assert found.other is large
            assert ("larger than" in found.reason) is large

    def test_corners_need_a_seventh_of_the_contrast_beside_them(self) -> None:
        for share, found in ((0.1, False), (0.2, True)):
            signs = alternating(9, 9)
            signs[3:5, 3:5] *= share
            image, grid = picture(signs)
            holed = grid.clone()
            holed[3, 3] = math.nan
            filled = filled_grid(image, holed, 0.5)
            assert bool(filled[3, 3].isfinite().all()) is found
            if found:
                torch.testing.assert_close(filled[3, 3], grid[3, 3], rtol=0, atol=0.05)

    def test_grids_grow_up_to_the_lines_that_are_asked_for(self) -> None:
        image, grid = picture(alternating(9, 10))
        for most in (4, 5, 20):
            size = grown_grid(image, grid[2:5, 3:6], most).shape[:2]
            # One line on either side a time, until there are more, or no more.
            assert size == ((5, 5) if most == 4 else (7, 7) if most == 5 else (8, 9))
        for number, side in enumerate(sides(grid)):
            assert torch.equal(side[0], (grid[0], grid[-1], grid[:, 0], grid[:, -1])[number])


class TestMaps:
    def test_degrees_have_two_points_for_each_term(self) -> None:
        wanted = {0: 0, 1: 0, 2: 0, 5: 0, 6: 1, 11: 1, 12: 2, 19: 2, 20: 3, 29: 3, 30: 4, 41: 4, 42: 5, 900: 5}
        assert {points: _degree(points) for points in wanted} == wanted

    def test_derivatives_are_those_of_the_map(self) -> None:
        """Of a homography exactly, with those of a cubic beside it; unknown points count for nothing."""
        axis = torch.linspace(-0.8, 1.2, 6).double()
        points = torch.cartesian_prod(axis, axis)
        h = torch.tensor([[300.0, 20.0, 90.0], [-15.0, 250.0, 70.0], [0.2, -0.1, 1.0]], dtype=torch.float64)

        def perspective(q: Tensor) -> Tensor:
            there = torch.cat([q, torch.ones_like(q[..., :1])], -1) @ h.T
            return there[..., :2] / there[..., 2:]

        known = torch.ones(36, dtype=torch.bool)
        known[[7, 20]] = False
        pixels = perspective(points)
        pixels[7] = torch.tensor([-400.0, 900.0])
        torch.testing.assert_close(homography(points[known], pixels[known]), h, rtol=1e-9, atol=1e-8)
        maps = local_maps(points, pixels, known)
        steps = 1e-4 * torch.eye(2).double()
        for axis_number in (0, 1):
            step = steps[axis_number]
            slope = (perspective(points + step) - perspective(points - step)) / 2e-4
            torch.testing.assert_close(maps.first[:, :, axis_number], slope, rtol=1e-6, atol=1e-4)
            for other in (0, 1):
                up, down = points + step, points - step
                bend = (
                    perspective(up + steps[other]) - perspective(up - steps[other])
                    - perspective(down + steps[other]) + perspective(down - steps[other])
                ) / 4e-8  # fmt: skip
                torch.testing.assert_close(maps.second[:, :, axis_number, other], bend, rtol=1e-4, atol=0.05)

        def bent(q: Tensor) -> Tensor:
            x, y = q.unbind(-1)
            return torch.stack([100 * x + 3 * x**3 - 2 * x * y * y, 80 * y + 4 * x * x * y - y**3], -1)

        # Nearly a homography: what is left of it is followed by a polynomial.
        maps = local_maps(points, bent(points))
        x, y = points.unbind(-1)
        first = torch.stack([100 + 9 * x**2 - 2 * y * y, -4 * x * y, 8 * x * y, 80 + 4 * x * x - 3 * y * y], -1)
        second = torch.stack([18 * x, -4 * y, -4 * y, -4 * x, 8 * y, 8 * x, 8 * x, -6 * y], -1)
        torch.testing.assert_close(maps.first.flatten(1), first, rtol=0, atol=0.3)
        torch.testing.assert_close(maps.second.flatten(1), second, rtol=0, atol=2.0)
        inner = (points.abs() < 0.9).all(-1)
        torch.testing.assert_close(maps.second.flatten(1)[inner], second[inner], rtol=0, atol=0.6)


class TestSaddles:
    def test_the_disc_and_its_quadratic(self) -> None:
        offsets, design, inverse = _disc(torch.device("cpu"))
        assert len(offsets) == 29
        assert float(offsets.norm(dim=1).max()) == 3.0
        x, y = offsets.unbind(-1)
        coefficients = torch.tensor([5.0, 1.0, -2.0, 0.5, 3.0, -0.7]).double()
        values = 5 + x - 2 * y + 0.5 * x * x + 3 * x * y - 0.7 * y * y
        torch.testing.assert_close(inverse @ values, coefficients)
        torch.testing.assert_close(design @ coefficients, values)
        step, is_saddle = _stationary(coefficients[None])
        assert is_saddle.tolist() == [True]
        # Where 1 + x + 3 y = 0 and -2 + 3 x - 1.4 y = 0.
        assert step[0].tolist() == pytest.approx(np.linalg.solve([[1.0, 3.0], [3.0, -1.4]], [-1.0, 2.0]).tolist())
        bowl = torch.tensor([[0.0, 1.0, 1.0, 1.0, 1.9, 1.0], [0.0, 1.0, 1.0, 1.0, 2.1, 1.0]]).double()
        step, is_saddle = _stationary(bowl)
        assert is_saddle.tolist() == [False, True]
        assert step[0].tolist() == [0.0, 0.0]
        assert bool(_stationary(torch.tensor([[0.0, 0.0, 0.0, 1.0, 2.0, 1.0]]).double())[1]) is False

    def test_quadratics_explain_most_of_the_variance(self) -> None:
        samples = torch.tensor([[1.0, -1.0, 1.0, -1.0]]).double().expand(2, 4)
        off = torch.tensor([[0.38], [0.40]]).double()  # squares .1444 and .16, of a variance of 1
        assert _fits(samples, samples + off).tolist() == [True, False]

    def test_patches_repeat_the_border(self) -> None:
        image = torch.arange(20.0).reshape(1, 4, 5)
        cut = cut_patches(image, torch.tensor([[[0.0, 0.0], [4.0, 2.0]]]), 1)
        assert cut[0].tolist() == [[0, 0, 1], [0, 0, 1], [5, 5, 6]]
        assert cut[1].tolist() == [[8, 9, 9], [13, 14, 14], [18, 19, 19]]
        both = cut_patches(torch.cat([image, image + 100]), torch.ones(2, 1, 2), 1)
        assert both[1, 1].tolist() == [105, 106, 107]


class TestMatches:
    def found(self, score: float, rival: float, shift: tuple[float, float] = (0.0, 0.0), **options: Any) -> PatchMatch:
        """A patch of a smooth picture that is `shift` away from where it is looked for, tangent along x."""
        y, x = torch.meshgrid(torch.arange(40.0).double(), torch.arange(40.0).double(), indexing="ij")
        image = 100 + 30 * torch.sin(0.5 * x + 0.1 * y) + 30 * torch.cos(0.4 * y - 0.2 * x)
        where = torch.tensor([20.0, 20.0]).double() + grid_of((5, 5), torch.device("cpu"))
        room = where[5, 5] + grid_of((8, 8), torch.device("cpu"))
        windows = image_windows(image, room[None], 0, math.inf)
        moved = where + torch.tensor(shift, dtype=torch.float64)
        at = torch.stack([0.5 * moved[..., 0] + 0.1 * moved[..., 1], 0.4 * moved[..., 1] - 0.2 * moved[..., 0]])
        template = 100 + 30 * at[0].sin() + 30 * at[1].cos()
        peak = Peak(*(torch.tensor([value]) for value in (0, 0, score, rival, False)))
        tangent = torch.tensor([1.0, 0.0]).double()
        return fit_peak(windows, template, where, tangent, peak, MatchOptions(half=5, **options))

    def test_scores_and_rivals(self) -> None:
        assert self.found(0.75, 0.5, min_score=0.75).status == MatchStatus.GOOD
        assert self.found(0.75, 0.5, min_score=0.76) == PatchMatch(MatchStatus.NO_MATCH, 0.75)
        assert self.found(0.75, 0.375, min_score=0.5, max_rival=0.5).status == MatchStatus.GOOD
        assert self.found(0.75, 0.376, min_score=0.5, max_rival=0.5) == PatchMatch(MatchStatus.AMBIGUOUS, 0.75)
        assert self.found(-1.0, -1.0).status == MatchStatus.OUTSIDE
        assert self.found(math.nan, 0.1).status == MatchStatus.NO_MATCH

    def test_only_what_is_across_the_line_counts(self) -> None:
        along = self.found(0.9, 0.1, (1.2, 0.1), max_off_line=0.2)
        assert along.status == MatchStatus.GOOD
        assert along.off_line == pytest.approx(0.1, abs=0.02)
        assert torch.as_tensor(along.pixel).tolist() == pytest.approx([21.2, 20.1], abs=0.02)
        across = self.found(0.9, 0.1, (0.1, -0.7), max_off_line=0.5)
        assert across.status == MatchStatus.OFF_LINE
        assert across.off_line == pytest.approx(0.7, abs=0.02)
        assert self.found(0.9, 0.1, (0.1, -0.7), max_off_line=0.8).status == MatchStatus.GOOD

    def test_matches_are_joined_in_their_order(self) -> None:
        one = PatchMatch(MatchStatus.GOOD, 0.9, 0.2, torch.tensor([3.0, 4.0]), torch.tensor([[1.0, 2.0], [3.0, 5.0]]))
        found = joined([one, PatchMatch(MatchStatus.OFF_LINE, 0.8, 3.0)])
        assert found.status.tolist() == [MatchStatus.GOOD, MatchStatus.OFF_LINE]
        assert found.pixels[0].tolist() == [3.0, 4.0]
        assert found.covariance[0].tolist() == [[1.0, 2.0], [3.0, 5.0]]
        assert (found.score.tolist(), found.off_line.tolist()) == ([0.9, 0.8], [0.2, 3.0])
        assert bool(found.pixels[1].isnan().all() & found.covariance[1].isnan().all())

    @pytest.mark.parametrize(("good", "bad"), [
        ({"half": 2}, {"half": 1}), ({"half": 100}, {"half": 101}), ({"nearest": 1e-9}, {"nearest": 0.0}),
        ({"nearest": 1e9}, {"nearest": math.inf}), ({"min_score": 0.01}, {"min_score": 0.0}),
        ({"min_score": 0.99}, {"min_score": 1.0}), ({"max_rival": 1.0}, {"max_rival": 1.01}),
        ({"max_rival": 0.01}, {"max_rival": 0.0}), ({"max_off_line": 1e-3}, {"max_off_line": 0.0}),
    ])  # fmt: skip
    def test_options_at_their_limits(self, good: dict[str, Any], bad: dict[str, Any]) -> None:
        MatchOptions(**good)
        with pytest.raises(InputError, match="match option"):
            MatchOptions(**bad)


def test_quarter_turns_lean() -> None:
    """Of two equally upright orders that whose rows go down to the right wins."""
    i, j = torch.meshgrid(torch.arange(3.0).double(), torch.arange(3.0).double(), indexing="ij")
    falling = torch.stack([j - i, j + i], -1)
    rising = torch.stack([j + i, i - j], -1)
    assert uprightness(falling) == pytest.approx(math.sqrt(2.0) * (1.0 + 1e-6), abs=1e-9)
    assert uprightness(rising) == pytest.approx(math.sqrt(2.0) * (1.0 - 1e-6), abs=1e-9)
    assert uprightness(torch.stack([j, i], -1)) == 2.0
    assert uprightness(torch.stack([-j, -i], -1)) == -2.0


@pytest.mark.parametrize(("columns", "rows", "cut"), [(5, 4, 0), (9, 6, 100)])
def test_other_and_cut_boards_are_told_without_the_slow_detectors(
    monkeypatch: pytest.MonkeyPatch, columns: int, rows: int, cut: int
) -> None:
    refused = Mock(side_effect=AssertionError("the image shows for certain that no whole 9x6 board is there"))
    monkeypatch.setattr(search, "find_sector", refused)
    monkeypatch.setattr(search, "_find_shadowed", refused)
    y, x = np.mgrid[: 30 * rows + 110, : 30 * columns + 110]
    on = (x >= 40) & (x < 70 + 30 * columns) & (y >= 40) & (y < 70 + 30 * rows)
    image = np.where(on & (((x - 40) // 30 + (y - 40) // 30) % 2 == 0), 40, 220).astype(np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 0.8)[:, : image.shape[1] - cut]
    found = search.find_board(image, Board(columns=9, rows=6, square=0.025))
    if cut:
        assert found.pixels is not None
        assert 36 <= int(torch.isfinite(found.pixels).all(-1).sum()) < 54
    else:
        assert found.reason == "a board of 5x4 inner corners was found, not 9x6: give --board 5x4"


def test_a_board_of_which_a_corner_is_hidden_is_sought_further() -> None:
    board = Board(columns=9, rows=6, square=0.025)
    pixels = 20.0 * board.points[:, :2] / board.square + 40.0
    image = np.zeros((200, 300), np.uint8)
    assert search._is_all(image, search.FoundBoard(pixels), board)
    pixels[0] = torch.nan
    assert not search._is_all(image, search.FoundBoard(pixels), board)
    assert search._is_all(image, search.FoundBoard(pixels - 41.0), board)
