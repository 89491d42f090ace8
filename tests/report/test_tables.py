"""Tables of located points: numbers with their signs, and empty cells where nothing is known."""

import math

import pytest
import torch
from locate_rigs import located_pairs, pinhole_rig, tensor

from kcal import Board, Camera, InputError, Origin, Rig
from kcal.locate.budget import range_sigmas
from kcal.locate.positions import position_errors
from kcal.report.judge_rig import triangulated_sides
from kcal.report.tables import diagonal_rows, position_rows, range_sigma_rows, truth_rows

ORIGIN = Origin(lat=10.0, lon=20.0, height=0.0)


def test_positions_and_what_they_miss() -> None:
    left, right = pinhole_rig()(tensor([0.0, 0.0, 100.0]))[0].unbind(-2)
    left, right = torch.cat([left, tensor([5000.0, 1.0])]), torch.cat([right, tensor([1.0, 1.0])])
    located = located_pairs(pinhole_rig(), left, right, origin=ORIGIN, heading_deg=0.0, names=["gate", "lost"])
    heads, gate, lost = position_rows(located, position_errors(located, tensor([3.0, 96.0, 0.0], [math.nan] * 3)))
    assert gate[:1] + gate[4:5] == ["gate", "100.00"]
    assert dict(zip(heads, gate, strict=True))["off level m"] == "5.00"
    assert dict(zip(heads, gate, strict=True))["off in range m"] == "+3.95"
    assert lost[1:-1] == [""] * (len(heads) - 2)
    assert lost[-1].endswith("*")


def test_errors_along_and_across_the_line_of_sight() -> None:
    true = tensor([0.0, 100.0, 0.0])
    # The point that is located lies 1 m beyond and 2 m to the right.
    left, right = pinhole_rig()(tensor([2.0, 0.0, 101.0]))[0].unbind(-2)
    exact = pinhole_rig()(tensor([0.0, 0.0, 100.0]))[0].unbind(-2)
    located, noiseless = (
        located_pairs(pinhole_rig(), *pair, origin=ORIGIN, heading_deg=0.0, names=["gate"])
        for pair in ((left, right), exact)
    )
    row = dict(zip(*truth_rows(located, noiseless, true), strict=True))
    assert (row["error m"], row["%"], row["across m"]) == ("+1.00", "+1.00", "2.0")
    assert row["calibration m"] == "+0.00"


@pytest.mark.parametrize(
    ("scale", "distance", "heads", "cells"),
    [
        (0.01, 0.4, ["range mm", "interval mm"], ["400.00", "399.17 – 400.83"]),
        (1.0, 400.0, ["range m", "interval m"], ["400.0", "391.9 – 408.5"]),
        (10.0, 20e3, ["range km", "interval km"], ["20.0", "18.1 – 22.3"]),
    ],
    ids=["bench", "site", "sea"],
)
def test_units_fit_the_range_and_numbers_their_sigma(
    scale: float, distance: float, heads: list[str], cells: list[str]
) -> None:
    rig = pinhole_rig()
    rig = Rig.pair(rig.left, rig.right, rig.right_from_left_rotation, scale * rig.right_from_left_translation)
    pixels = rig(tensor([0.0, 0.0, distance]))[0].unbind(-2)
    head, row = position_rows(located_pairs(rig, *pixels, origin=ORIGIN, heading_deg=0.0))
    assert head[4:6] == heads
    assert row[4:6] == cells


def test_a_sum_is_not_known_where_a_part_is_not() -> None:
    rig = pinhole_rig()
    head, row = range_sigma_rows(range_sigmas(rig, [1000.0]), known=rig.covariance is not None)
    assert [row[head.index(name)] for name in ("σ of range", "lenses", "relative pose")] == ["not known"] * 3
    assert row[head.index("marks")].endswith(" m")


def test_diagonals_of_pairs_whose_ends_were_both_located() -> None:
    board = Board(columns=5, rows=4, square=1.0)
    left, right = pinhole_rig()(tensor([0.0, 0.0, 100.0], [4.0, 3.01, 100.0], [0.0, 0.0, 50.0]))[0].unbind(-2)
    located = located_pairs(
        pinhole_rig(), left, right, origin=ORIGIN, heading_deg=0.0, names=["a first", "a last", "b first"]
    )
    _, row = diagonal_rows(located, board)
    assert row[0] == "a"
    assert row[2:] == ["5.0000 m", "5.0060 m", "+6.0 mm"]


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
