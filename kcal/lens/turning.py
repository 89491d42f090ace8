"""Rotate a camera until its projections agree with what was seen: Gauss-Newton on rotations."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.pose import nearest_rotation, rotation_from_vector, step_rows
from kcal.lens.projection import project_components

# Singular values of the rows below this share of the largest are rounding: what they would turn stays as it is.
_ROUNDING = math.sqrt(3.0 * torch.finfo(torch.float64).eps)


def rotation_between(first: Tensor, second: Tensor) -> Tensor:
    """The rotation (..., 3, 3) with second ≈ R first, both (..., N, 3), in the least-squares sense.

    Source: Kabsch (1976); Wahba's problem.

    Example:
        >>> e = torch.eye(3, dtype=torch.float64)
        >>> rotation_between(e, e[[1, 2, 0]]).tolist()
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    return nearest_rotation(second.transpose(-1, -2) @ first) + 0.0


def seen_turned(camera: Camera, points: Tensor, rotation: Tensor, shift: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Where a camera sees points after a motion, and how that changes with a further step.

    Args:
        camera: a single camera; its parameters are held.
        points: (N, 3).
        rotation: (3, 3) the camera's axes from those of the points.
        shift: (3,) added after the rotation; none if left out.

    Returns:
        pixels (2, N), NaN where the camera has no image; and their derivatives (6, 2, N) by a turn about the camera's
        axes and by a shift, as `kcal.lens.pose.step_rows`.
    """
    turned = rotation @ points.T
    moved = turned if shift is None else turned + shift[:, None]
    seen = project_components(moved, camera.params.detach(), camera.model, ())
    return torch.where(seen.regular, seen.pixels, torch.nan), step_rows(seen.by_point, turned)


class TurnFit(NamedTuple):
    """What `fit_turn` found.

    Attributes:
        rotation: (3, 3).
        more: (S,) the other unknowns.
        converged: whether the last step was small enough.
    """

    rotation: Tensor
    more: Tensor
    converged: bool


def fit_turn(
    rotation: Tensor,
    look: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    *,
    more: int = 0,
    steps: int = 50,
    settled: float = 1e-10,
    longest: float = math.inf,
) -> TurnFit:
    """Turn something until residuals are smallest, by Gauss-Newton steps whose weights may follow the residuals.

    Args:
        rotation: (3, 3) to begin with.
        look: from a rotation and the other unknowns (S,) to rows (M, 3 + S) and residuals (M,), both times the square
            roots of their weights; a residual that is NaN counts nothing. Rows are derivatives of the residuals by a
            turn that comes after the rotation, and by the other unknowns, in units that change the residuals about as
            much as a radian does. Weights that depend on the residuals make the fit robust.
        more: S, how many other unknowns there are; they begin at zero.
        steps: at most.
        settled: radians below which a turn ends the iteration.
        longest: radians; no turn is longer, and the other unknowns of a step are shortened with it.

    Example:
        >>> wanted = rotation_from_vector(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
        >>> directions = torch.eye(3, dtype=torch.float64)
        >>> def look(rotation, _):
        ...     turned = directions @ rotation.T
        ...     rows = torch.linalg.cross(torch.eye(3).double()[None], turned[:, None]).transpose(1, 2)
        ...     return rows.flatten(0, 1), (turned - directions @ wanted.T).flatten()
        >>> bool(torch.allclose(fit_turn(directions, look).rotation, wanted))
        True
    """
    others, converged = torch.zeros(more, dtype=torch.float64), False
    for _ in range(steps):
        rows, residuals = look(rotation, others)
        rows, residuals = torch.where(residuals.isnan()[:, None], 0.0, rows), residuals.nan_to_num(0.0)
        solution = torch.linalg.lstsq(rows, residuals[:, None], rcond=_ROUNDING, driver="gelsd").solution[:, 0]
        size = float(solution[:3].norm())
        step = -solution * min(1.0, longest / max(size, 1e-300))
        rotation, others = rotation_from_vector(step[:3]) @ rotation, others + step[3:]
        if size < settled:
            converged = True
            break
    return TurnFit(rotation, others, converged)
