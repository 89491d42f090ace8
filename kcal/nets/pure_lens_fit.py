"""Calibration with a pure network lens (`kcal.nets.pure_lens`): the least-squares problem for Levenberg-Marquardt."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.bundle.twist import apply_twist
from kcal.lens.pose import step_rows
from kcal.nets.pure_lens import PureNetLens
from kcal.solve.result import State
from kcal.solve.schur import SchurProblem


class NetLensProblem(SchurProblem):
    """Reprojection residuals (pixels) of boards through a pure network lens.

    The state is (intrinsics (4,), weights (W,), rotations (V, 3, 3), translations (V, 3)); shared parameters are the
    intrinsics and the weights, local ones the board's pose in each view.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2) observed corners.
        lens: the form of the lens; its own parameters are only a start.
        fixed: hold intrinsics and weights: poses alone are estimated.
    """

    local_size = 6
    batch: tuple[int, ...] = ()

    def __init__(self, board_points: Tensor, pixels: Tensor, lens: PureNetLens, *, fixed: bool = False) -> None:
        self._board, self._lens, self._fixed = board_points.T, lens, fixed
        self._target = pixels.transpose(-1, -2)
        self.residual_count = pixels.numel()
        self.shared_size = 0 if fixed else 4 + lens.weights.numel()

    def start(self, rotation: Tensor, translation: Tensor) -> State:
        """The lens as it is, with poses."""
        return self._lens.intrinsics.detach(), self._lens.weights.detach(), rotation, translation

    def _points(self, state: State) -> tuple[Tensor, Tensor]:
        rotated = state[2] @ self._board
        return rotated, rotated + state[3][..., None]

    def residuals(self, state: State) -> Tensor:
        """See `SchurProblem.residuals`; NaN where a corner lies behind the camera."""
        _, points = self._points(state)
        error = self._lens.pixels(points, state[0], state[1]) - self._target
        return torch.where(points[..., 2:, :] > 0, error, torch.nan).flatten(-2)

    def rows(self, state: State) -> Tensor:
        """See `SchurProblem.rows`."""
        rotated, points = self._points(state)
        net = self._lens.project(points, state[0], state[1])
        error = torch.where(points[..., 2:, :] > 0, net.pixels - self._target, torch.nan)[..., None, :, :]
        shared = [] if self._fixed else [net.by_intrinsics, net.by_weights]
        return torch.cat([step_rows(net.by_point, rotated), *shared, error], -3).flatten(-2)

    def retract(self, state: State, step: State) -> State:
        """See `SchurProblem.retract`."""
        intrinsics, weights, rotation, translation = state
        shared, local = step
        if not self._fixed:
            intrinsics, weights = intrinsics + shared[:4], weights + shared[4:]
        return (intrinsics, weights, *apply_twist(rotation, translation, local))
