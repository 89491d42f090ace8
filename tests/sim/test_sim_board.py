import pytest
import torch

from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.sim.captures import BoardPose, BoardSize, area_colors, board_points, check_pose, project_board


def test_points_are_those_of_the_library_board():
    assert torch.equal(board_points(BoardSize(9, 6, 0.06)), Board(columns=9, rows=6, square=0.06).points)


def test_a_library_board_can_be_used_as_it_is():
    assert torch.equal(board_points(Board(columns=5, rows=4, square=0.1)), board_points(BoardSize(5, 4, 0.1)))


def test_border_goes_on_outside():
    grid = board_points(BoardSize(3, 2, 0.5), border=1).reshape(4, 5, 3)
    assert grid[0, 0].tolist() == [-0.5, -0.5, 0.0]
    assert torch.equal(grid[1:-1, 1:-1].reshape(-1, 3), board_points(BoardSize(3, 2, 0.5)))


@pytest.mark.parametrize(
    ("a", "b", "paper", "black"),
    [
        (-0.5, -0.5, 1, 1),  # diagonally outside corner 0
        (0.5, -0.5, 1, 0),
        (0.5, 0.5, 1, 1),
        (8.5, -0.5, 1, 0),  # 10 x 7 squares: the top right one is white
        (8.5, 5.5, 1, 0),
        (-0.5, 5.5, 1, 1),
        (-1.5, 0.5, 1, 0),  # the margin
        (9.5, 2.5, 1, 0),
        (-2.5, 0.5, 0, 0),  # beyond it
        (3.0, 6.0 + 1.5, 0, 0),
    ],
)
def test_colors_of_squares(a, b, paper, black):
    a, b, width = (torch.tensor([value], dtype=torch.float64) for value in (a, b, 0.01))
    colors = area_colors(a, b, width, width, BoardSize(9, 6, 1.0), 1)
    assert float(colors.paper) == pytest.approx(paper, abs=1e-12)
    assert float(colors.black) == pytest.approx(black, abs=1e-12)


def test_area_averages_are_integrals():
    # Midpoint sums over boxes of any size, also many squares wide; n midpoints err by less than edges * width / n.
    generator = torch.Generator().manual_seed(3)
    board, n = BoardSize(5, 4, 1.0), 400
    center = 9 * torch.rand((40, 2), dtype=torch.float64, generator=generator) - 2.5
    width = 2.5 * torch.rand((40, 2), dtype=torch.float64, generator=generator) + 1e-3
    colors = area_colors(center[:, 0], center[:, 1], width[:, 0], width[:, 1], board, 1)
    step = (torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5
    a = (center[:, 0, None] + width[:, 0, None] * step)[:, :, None]
    b = (center[:, 1, None] + width[:, 1, None] * step)[:, None, :]
    paper = (a > -2) & (a < 6) & (b > -2) & (b < 5)
    black = (a > -1) & (a < 5) & (b > -1) & (b < 4) & ((a.floor() + b.floor()) % 2 == 0)
    torch.testing.assert_close(colors.paper, paper.double().mean((1, 2)), rtol=0, atol=6 / n)
    torch.testing.assert_close(colors.black, black.double().mean((1, 2)), rtol=0, atol=6 / n)


def test_visible_is_valid_and_inside():
    camera = Camera.build(focal=(800, 800), center=(319.0, 239.5), size=(640, 480))
    pose = BoardPose(torch.eye(3), torch.tensor([0.0, 0.0, 1.0]))
    pixels, visible = project_board(camera, pose, BoardSize(9, 2, 0.1))
    assert pixels[:, 0].tolist() == pytest.approx([319.0 + 80 * i for i in range(9)] * 2)
    assert visible.tolist() == ([True] * 5 + [False] * 4) * 2  # the fifth lies half a pixel inside the edge at 639.5


def test_bad_boards_and_poses():
    for board in (BoardSize(1, 6, 0.1), BoardSize(9, 6, 0.0), BoardSize(9, 6, float("nan"))):
        with pytest.raises(InputError, match="at least 2x2"):
            board_points(board)
    identity, zero = torch.eye(3), torch.zeros(3)
    with pytest.raises(InputError, match="not a rotation"):
        check_pose((-identity, zero))
    with pytest.raises(InputError, match="shapes"):
        check_pose((identity, zero[None]))
    with pytest.raises(InputError, match="not finite"):
        check_pose((identity, zero / 0))
