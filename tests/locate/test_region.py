"""The 95 % region on the map: its shape, its share and its sense."""

from __future__ import annotations

import math

import pytest
import torch
from locate_rigs import tensor
from torch import Tensor

from kcal.locate.positions import region_outline

# East, north; not along an axis, and an ellipse that is oblique to the line of sight.
PLACE = tensor(1500.0, 2500.0, 40.0)
OBLIQUE = tensor([4.0, 3.0, 0.5], [3.0, 9.0, 0.2], [0.5, 0.2, 1.0])


def area(ring: Tensor) -> float:
    """Positive if counterclockwise."""
    x, y = ring.unbind(-1)
    return float(0.5 * (x * y.roll(-1) - y * x.roll(-1)).sum())


@pytest.mark.parametrize("place", [PLACE, PLACE * tensor(-1.0, 1.0, 1.0), tensor(0.0, 3000.0, 0.0)])
def test_small_errors_give_the_usual_ellipse(place: Tensor) -> None:
    apart = region_outline(place, OBLIQUE) - place[:2]
    distance = (apart @ torch.linalg.inv(OBLIQUE[:2, :2]) * apart).sum(-1)
    # -2 ln(1 - 0.95); the skewness is some sigma over the distance, 1e-3.
    assert distance.tolist() == pytest.approx([5.9915] * len(apart), rel=0.02)
    assert area(apart) == pytest.approx(math.pi * 5.9915 * math.sqrt(float(OBLIQUE[:2, :2].det())), rel=0.01)


@pytest.mark.parametrize("scale", [10.0, 100.0, 150.0])
def test_skewed_regions_contain_their_share(scale: float) -> None:
    """Of errors that are Gaussian in X / |X|², as those of a stereo rig are."""
    spread = scale**2 * OBLIQUE[:2, :2]
    outline = region_outline(PLACE, torch.block_diag(spread, torch.eye(1).double()))
    assert area(outline) > 0
    squared = PLACE[:2].square().sum()
    slope = (torch.eye(2).double() - 2.0 * torch.outer(PLACE[:2], PLACE[:2]) / squared) / squared
    root = torch.linalg.cholesky(slope @ spread @ slope.T)
    draws = torch.randn(40_000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) @ root.T
    inverse = PLACE[:2] / squared + draws
    points = inverse / inverse.square().sum(-1, keepdim=True)
    # Inside, if the ring turns once around a point.
    along = torch.atan2(*(outline[None] - points[:, None]).flip(-1).unbind(-1))
    turns = along.roll(-1, 1) - along
    winding = (turns - 2 * math.pi * torch.round(turns / (2 * math.pi))).sum(1) / (2 * math.pi)
    share = float((winding.round() == 1).double().mean())
    # 40,000 draws know a share to 0.1 %; 72 corners cut off 0.1 % of the region.
    assert share == pytest.approx(0.95, abs=0.004)
