"""A lens that is only a network (Section 4.3.1 and Fig. 5 of the paper), for comparison.

    x = X / Z, y = Y / Z;  (x_D, y_D) = net(x, y);  u = fx x_D + cx,  v = fy y_D + cy

The paper replaces the distortion vector K by a network of four layers and finds that it does not converge.
`scripts/paper/train_net_lens.py` repeats this. The network lens is no camera: it has no inverse and no valid region,
and its intrinsics are not determined, because the network can undo any change of them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.pose import apply_twist, step_rows
from kcal.nets.inverse import Network, Widths, evaluate, evaluate_with_slopes, fit_weights, initial_weights
from kcal.solve.lm import LMOptions, Result, State
from kcal.solve.schur import SchurProblem


class PureLensPixels(NamedTuple):
    """Pixels (..., 2, N); derivatives by point (..., 3, 2, N), intrinsics (..., 4, 2, N) and weights (..., W, 2, N)."""

    pixels: Tensor
    by_point: Tensor
    by_intrinsics: Tensor
    by_weights: Tensor


class PureLensNet(Network):
    """Project points through a pinhole, a network of four layers, and intrinsics (the paper's Section 4.3.1, Fig. 5).

    Convention: camera frame and pixels as in `Camera`; intrinsics are fx, fy, cx, cy. Float64; parameters do not
    require gradients until asked.

    Args:
        intrinsics: (4,) initial values.
        reach: distance from the axis on the plane z = 1 by which the network's inputs and outputs are divided.
        hidden: number of features in each of the three hidden layers.
        skip: add the network's output to x, y, initially zero (no distortion); False: replace x, y by it, initially
            random, as in the paper's figure.
        seed: seed of the initial weights.

    Raises:
        InputError: intrinsics that are not four numbers with positive focal lengths, or a reach that is not positive.

    Example:
        >>> lens = PureLensNet(torch.tensor([800.0, 800.0, 320.0, 240.0]), skip=True)
        >>> pixels, valid = lens(torch.tensor([[0.1, 0.2, 1.0], [0.0, 0.0, -1.0]]))
        >>> [round(value, 3) for value in pixels[0].tolist()], valid.tolist()
        ([400.0, 400.0], [True, False])
    """

    intrinsics: Tensor
    reach: Tensor

    def __init__(
        self, intrinsics: Tensor, *, reach: float = 1.0, hidden: int = 8, skip: bool = False, seed: int = 0
    ) -> None:
        intrinsics = as_points("intrinsics", intrinsics, 4)
        if intrinsics.ndim != 1 or not bool((intrinsics[:2] > 0).all()) or not reach > 0:
            raise InputError("PureLensNet: fx, fy, cx, cy with positive focal lengths and a positive reach are needed")
        widths: Widths = (2, hidden, hidden, hidden, 2)
        weights = initial_weights(widths, seed)
        if not skip:
            generator = torch.Generator().manual_seed(seed + 1)
            last = widths[-1] * (widths[-2] + 1)
            weights[-last:] = hidden**-0.5 * torch.randn(last, generator=generator, dtype=torch.float64)
        super().__init__(widths, weights.to(intrinsics.device))
        self.skip = skip
        self.intrinsics = nn.Parameter(intrinsics.detach().clone(), requires_grad=False)
        self.register_buffer("reach", torch.tensor(float(reach), dtype=torch.float64, device=intrinsics.device))

    def forward(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Map points (..., N, 3) to pixels (..., N, 2) and valid (..., N), which only says "in front of the camera".

        Pixels that are not valid are set to the principal point.
        """
        points = as_points("points_cam", points_cam, 3)
        valid = torch.isfinite(points).all(-1) & (points[..., 2] > 0)
        ahead = points.new_tensor([0.0, 0.0, 1.0])
        points = torch.where(valid[..., None], points, ahead)
        pixels = self.pixels(points.transpose(-1, -2), self.weights, self.intrinsics).transpose(-1, -2)
        return torch.where(valid[..., None], pixels, self.intrinsics[2:]), valid

    def pixels(self, points: Tensor, weights: Tensor, intrinsics: Tensor) -> Tensor:
        """Map points (..., 3, N) in front of the camera to pixels (..., 2, N), with other parameters."""
        plane = points[..., :2, :] / points[..., 2:, :]
        distorted = self.reach * evaluate(plane / self.reach, weights, self.widths)
        if self.skip:
            distorted = distorted + plane
        return intrinsics[:2, None] * distorted + intrinsics[2:, None]

    def pixels_with_slopes(self, points: Tensor, weights: Tensor, intrinsics: Tensor) -> PureLensPixels:
        """As `pixels`, with all derivatives in closed form."""
        depth = points[..., 2:, :]
        plane = points[..., :2, :] / depth
        net = evaluate_with_slopes(plane / self.reach, weights, self.widths)
        distorted, by_plane = self.reach * net.values, net.by_input
        if self.skip:
            distorted = distorted + plane
            by_plane = by_plane + torch.eye(2, dtype=plane.dtype, device=plane.device)[..., None]
        focal = intrinsics[:2, None]
        slope = focal * by_plane / depth[..., None, :]
        by_depth = -(slope * plane[..., None, :]).sum(-3, keepdim=True)
        zero, one = torch.zeros_like(distorted[..., 0, :]), torch.ones_like(distorted[..., 0, :])
        x, y = distorted.unbind(-2)
        by_intrinsics = torch.stack([x, zero, zero, y, one, zero, zero, one], -2).unflatten(-2, (4, 2))
        pixels = focal * distorted + intrinsics[2:, None]
        return PureLensPixels(
            pixels, torch.cat([slope, by_depth], -3), by_intrinsics, focal * self.reach * net.by_weights
        )


class PureLensProblem(SchurProblem):
    """Reprojection residuals (pixels) of boards through a pure network lens.

    A state is (weights (W,), intrinsics (4,), rotations (V, 3, 3), translations (V, 3)). The shared part of a step is
    intrinsics, then weights; the local part is the pose of the board in each view.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2) observed corners.
        net: the form of the lens; its parameters are only the start.
        fixed: hold weights and intrinsics, and estimate the poses alone.
    """

    local_size = 6
    batch: tuple[int, ...] = ()

    def __init__(self, board_points: Tensor, pixels: Tensor, net: PureLensNet, *, fixed: bool = False) -> None:
        self._board, self._net, self._fixed = board_points.T, net, fixed
        self._target = pixels.transpose(-1, -2)
        self.residual_count = pixels.numel()
        self.shared_size = 0 if fixed else 4 + net.weights.numel()

    def start(self, rotation: Tensor, translation: Tensor) -> State:
        """The state of the lens as it is, with these poses."""
        return self._net.weights.detach().clone(), self._net.intrinsics.detach().clone(), rotation, translation

    def _points(self, state: State) -> tuple[Tensor, Tensor]:
        rotated = state[2] @ self._board
        return rotated, rotated + state[3][..., None]

    def residuals(self, state: State) -> Tensor:
        """See `SchurProblem.residuals`; NaN where a corner lies behind the camera."""
        _, points = self._points(state)
        error = self._net.pixels(points, *state[:2]) - self._target
        return torch.where(points[..., 2:, :] > 0, error, torch.nan).flatten(-2)

    def rows(self, state: State) -> Tensor:
        """See `SchurProblem.rows`."""
        rotated, points = self._points(state)
        lens = self._net.pixels_with_slopes(points, *state[:2])
        error = torch.where(points[..., 2:, :] > 0, lens.pixels - self._target, torch.nan)[..., None, :, :]
        shared = [] if self._fixed else [lens.by_intrinsics, lens.by_weights]
        return torch.cat([step_rows(lens.by_point, rotated), *shared, error], -3).flatten(-2)

    def retract(self, state: State, step: State) -> State:
        """See `SchurProblem.retract`."""
        weights, intrinsics, rotation, translation = state
        shared, local = step
        if not self._fixed:
            intrinsics, weights = intrinsics + shared[:4], weights + shared[4:]
        return (weights, intrinsics, *apply_twist(rotation, translation, local))


@torch.no_grad()
def train_pure_lens(
    net: PureLensNet,
    board_points: Tensor,
    pixels: Tensor,
    poses: tuple[Tensor, Tensor],
    options: LMOptions | None = None,
) -> Result:
    """Minimize the reprojection error over weights, intrinsics and board poses.

    Args:
        net: receives the weights and intrinsics found.
        board_points: (N, 3) meters.
        pixels: (V, N, 2) observed corners.
        poses: initial cam_from_board rotations (V, 3, 3) and translations (V, 3).
        options: of the solver.

    Returns:
        The solver's result; its state is (weights, intrinsics, rotations, translations).
    """
    problem = PureLensProblem(board_points, pixels, net)
    result = fit_weights(net, problem, problem.start(*poses), options)
    net.intrinsics.copy_(result.state[1])
    return result
