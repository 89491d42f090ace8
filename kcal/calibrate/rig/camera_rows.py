"""Rows of each camera of a rig, and their products, without the many columns that are zero for it.

What a camera sees depends on poses of boards, on its own pose and lens, and on the board: on no other camera. So the
work for C cameras grows with what they see, and not with what they see times C².
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.solve.schur import Products


class CameraRows(NamedTuple):
    """Rows of one camera, without the columns that are zero for it; or of what is known of the items beforehand.

    Attributes:
        camera: its number; None for what is known beforehand.
        columns: (U,) numbers of the shared unknowns that move what it sees.
        rows: (V, L + U + 1, R): derivatives of whitened residuals by local and these shared unknowns; last residuals.
    """

    camera: int | None
    columns: Tensor
    rows: Tensor


def summed_products(parts: Sequence[CameraRows], size: int, shared_size: int) -> Products:
    """Products of the rows of all cameras, each formed without the columns that are zero for the camera.

    Args:
        parts: of items.
        size: number of each item's own unknowns.
        shared_size: number of the shared ones.
    """
    count, width = len(parts[0].rows), shared_size + 1
    new = parts[0].rows.new_zeros
    local, right, score, total = new(count, size, size), new(count, size, width), new(count, width), new(width, width)
    for _, shared, rows in parts:
        own, columns = Products.of_rows(rows, size), torch.cat([shared, shared.new_tensor([-1])])
        local += own.local
        right[..., columns] += own.right
        score[:, columns] += own.score
        total[columns[:, None], columns] += own.total
    return Products(local, right, score, total)
