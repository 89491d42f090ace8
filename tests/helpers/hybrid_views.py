"""Views of boards for a hybrid lens."""

from typing import Any

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.families import typical_hyperprior
from kcal.calibrate.hybrid.fitted_views import FittedViews


def views_of(points: Tensor, board: BoardModes, pixels: Tensor, **more: Any) -> FittedViews:
    """Views of a board for a hybrid lens, whose corners all count alike."""
    return FittedViews(
        points=points, board=board, pixels=pixels, size=(640, 480), weights=torch.ones_like(pixels[..., 0]),
        hyperprior=typical_hyperprior(), **more,
    )  # fmt: skip
