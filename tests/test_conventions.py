"""docs/reference/conventions.md: conventions of more than one floor, and every test that the page names exists."""

from __future__ import annotations

import ast
import math
import re
from pathlib import Path

import pytest
import torch

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector

TESTS = Path(__file__).parent
PAGE = (TESTS.parent / "docs" / "reference" / "conventions.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`([\w/]+\.py(?:::\w+)*)`", PAGE)))


def test_board_points() -> None:
    points = Board(columns=3, rows=2, square=0.5).points
    assert points.tolist() == [
        [0.0, 0.0, 0.0],
        [0.5, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 0.5, 0.0],
        [0.5, 0.5, 0.0],
        [1.0, 0.5, 0.0],
    ]
    assert points.dtype == torch.float64


def test_rms_is_over_points() -> None:
    """Residuals that no parameter can take up: a known pattern of ±0.1 px, alike on both axes."""
    board = Board(columns=9, rows=8, square=0.05)
    camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.02])
    tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
    checker = torch.tensor([(-1.0) ** (i // 9 + i % 9) for i in range(72)], dtype=torch.float64)[:, None] * 0.1
    views = []
    for i, rotation in enumerate(rotation_from_vector(tilts)):
        points = board.points @ rotation.T + torch.tensor([-0.2, -0.17, 1.0], dtype=torch.float64)
        views.append(View(name=str(i), pixels=(camera.project(points)[0] + checker).tolist()))
    result = calibrate_camera(Observations(board=board, image_size=(640, 480), views=tuple(views)))
    finite = result.residuals[torch.isfinite(result.residuals).all(-1)]
    assert result.rms == pytest.approx(float((finite**2).sum(-1).mean().sqrt()), rel=1e-12)
    # Were it over coordinates it would be 0.1. The fit takes up a little of the pattern, hence the room.
    assert result.rms == pytest.approx(0.1 * math.sqrt(2), rel=0.03)


def test_the_table_of_coefficients_is_the_order() -> None:
    rows = re.findall(r"^\| (\d+)(?:(?:, | to )(\d+))? \| ([\w, ]+) \| (.*) \|$", PAGE, re.MULTILINE)
    names: list[str] = []
    for first, last, listed, _ in rows:
        assert int(first) == len(names) + 1
        names += listed.split(", ")
        assert int(last or first) == len(names)
    assert tuple(names) == LensModel(numerator=7, denominator=7, tangential=True, prism=4, tilt=True).names


@pytest.mark.parametrize("named", NAMED)
def test_named_tests_exist(named: str) -> None:
    path, *parts = named.split("::")
    scope = ast.parse((TESTS / path).read_text(encoding="utf-8")).body
    for part in parts:
        found = [node for node in scope if getattr(node, "name", None) == part]
        assert found, f"{part} is not in {path}"
        scope = getattr(found[0], "body", [])


def test_the_page_names_tests() -> None:
    assert len(NAMED) > 20
