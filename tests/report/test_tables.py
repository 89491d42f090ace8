"""Tables of located points: numbers with their signs, and empty cells where nothing is known."""

from __future__ import annotations

import math

import torch
from locate_rigs import pinhole_rig, tensor

from kcal.corners.board import Board
from kcal.locate.geodesy import Origin
from kcal.locate.positions import locate_points
from kcal.locate.truth import position_errors
from kcal.report.tables import diagonal_rows, position_rows, truth_rows

ORIGIN = Origin(lat=10.0, lon=20.0, height=0.0)


def test_positions_and_what_they_miss() -> None:
    left, right, _ = pinhole_rig()(tensor([0.0, 0.0, 100.0]))
    left, right = torch.cat([left, tensor([5000.0, 1.0])]), torch.cat([right, tensor([1.0, 1.0])])
    located = locate_points(pinhole_rig(), left, right, origin=ORIGIN, heading_deg=0.0, names=["gate", "lost"])
    truth = tensor([3.0, 96.0, 0.0], [math.nan] * 3)
    heads, gate, lost = position_rows(located, position_errors(located, truth))
    assert gate[:1] + gate[4:5] == ["gate", "100.0"]
    assert dict(zip(heads, gate, strict=True))["off level m"] == "5.0"
    assert dict(zip(heads, gate, strict=True))["off in range m"] == "+4.0"
    assert lost[1:-1] == [""] * (len(heads) - 2)
    assert lost[-1].endswith("*")


def test_errors_along_and_across_the_line_of_sight() -> None:
    true = tensor([0.0, 100.0, 0.0])
    # The point that is located lies 1 m beyond and 2 m to the right.
    left, right, _ = pinhole_rig()(tensor([2.0, 0.0, 101.0]))
    exact = pinhole_rig()(tensor([0.0, 0.0, 100.0]))[:2]
    located, noiseless = (
        locate_points(pinhole_rig(), *pair, origin=ORIGIN, heading_deg=0.0, names=["gate"])
        for pair in ((left, right), exact)
    )
    row = dict(zip(*truth_rows(located, noiseless, true), strict=True))
    assert (row["error m"], row["%"], row["across m"]) == ("+1.00", "+1.00", "2.00")
    assert row["calibration m"] in ("+0.00", "-0.00")


def test_diagonals_of_pairs_whose_ends_were_both_located() -> None:
    board = Board(columns=5, rows=4, square=1.0)
    points = tensor([0.0, 0.0, 100.0], [4.0, 3.01, 100.0], [0.0, 0.0, 50.0])
    left, right, _ = pinhole_rig()(points)
    located = locate_points(
        pinhole_rig(), left, right, origin=ORIGIN, heading_deg=0.0, names=["a first", "a last", "b first"]
    )
    _, row = diagonal_rows(located, board)
    assert row[0] == "a"
    assert row[2:] == ["5000.00", "5006.01", "+6.01"]
