import pytest
import torch

from kcal import Board, Camera, InputError, Rig
from kcal.report.judge_rig import triangulated_sides


@pytest.mark.parametrize("text", ["aprilgrid:3x2:0.3", "asymmetric:4x5", "5x4"])
def test_sides_of_boards_of_unlike_distances(text):
    """Each distance of neighbors counts as that of the first two points: alike on an exact board of any kind."""
    board = Board.parse(text, "50mm")
    camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-0.5, 0.0, 0.0]))
    left, right = rig(board.points * 1.02 + torch.tensor([-0.2, 0.1, 2.0], dtype=torch.float64))[0].unbind(-2)
    sides = triangulated_sides(rig, board.columns, board.rows, torch.stack([left, right])[None], board.points)
    assert sides.mean == pytest.approx(1.02 * float((board.points[1] - board.points[0]).norm()), rel=1e-9)
    assert sides.spread < 1e-9
    with pytest.raises(InputError, match="points: shape"):
        triangulated_sides(rig, board.columns, board.rows, torch.stack([left, right])[None], board.points[1:])
