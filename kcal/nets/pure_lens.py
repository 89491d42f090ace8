"""A lens that is nothing but a network (Section 4.3.1 and Fig. 5 of the paper), for comparison.

    x = X / Z, y = Y / Z;  (x_D, y_D) = net(x, y);  u = fx x_D + cx,  v = fy y_D + cy

The paper puts a network of four layers in the place of the distortion vector K and finds that it does not converge. It
is here so that this can be looked at (`scripts/paper/train_net_lens.py`), not as a camera: it has no inverse, knows no
valid region, and beside its network the intrinsics mean nothing, since each can undo the other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from kcal.checks import as_points, keep_float64
from kcal.errors import InputError
from kcal.nets.mlp import Widths, evaluate, evaluate_with_slopes, initial_weights, weight_count


class NetProjection(NamedTuple):
    """Pixels (..., 2, N); derivatives by point (..., 3, 2, N), intrinsics (..., 4, 2, N) and weights (..., W, 2, N)."""

    pixels: Tensor
    by_point: Tensor
    by_intrinsics: Tensor
    by_weights: Tensor


class PureNetLens(nn.Module):
    """Pinhole, network, intrinsics: the pure network lens of the paper's Section 4.3.1 (four layers, Fig. 5).

    Convention: camera frame and pixels as in `Camera`; intrinsics are fx, fy, cx, cy. Float64; parameters do not
    require gradients until asked.

    Args:
        intrinsics: (4,) to begin with.
        reach: distance from the axis on the plane z = 1 that the network's inputs and outputs are divided by.
        hidden: features of each of the three hidden layers.
        skip: the network adds to x, y, beginning with zero (no distortion); False: as in the paper's figure, it
            replaces them, beginning with random numbers.
        seed: of the first weights.

    Raises:
        InputError: intrinsics that are not four numbers with positive focal lengths, or a reach that is not positive.

    Example:
        >>> lens = PureNetLens(torch.tensor([800.0, 800.0, 320.0, 240.0]), skip=True)
        >>> pixels, valid = lens(torch.tensor([[0.1, 0.2, 1.0], [0.0, 0.0, -1.0]]))
        >>> [round(value, 3) for value in pixels[0].tolist()], valid.tolist()
        ([400.0, 400.0], [True, False])
    """

    intrinsics: Tensor
    weights: Tensor
    reach: Tensor

    def __init__(
        self, intrinsics: Tensor, *, reach: float = 1.0, hidden: int = 8, skip: bool = False, seed: int = 0
    ) -> None:
        super().__init__()
        intrinsics = as_points("intrinsics", intrinsics, 4)
        if intrinsics.ndim != 1 or not bool((intrinsics[:2] > 0).all()) or not reach > 0:
            raise InputError("PureNetLens: fx, fy, cx, cy with positive focal lengths and a positive reach are needed")
        self.widths: Widths = (2, hidden, hidden, hidden, 2)
        self.skip = skip
        weights = initial_weights(self.widths, seed)
        if not skip:
            generator = torch.Generator().manual_seed(seed + 1)
            last = weight_count(self.widths[-2:])
            weights[-last:] = hidden**-0.5 * torch.randn(last, generator=generator, dtype=torch.float64)
        self.intrinsics = nn.Parameter(intrinsics.detach().clone(), requires_grad=False)
        self.weights = nn.Parameter(weights.to(intrinsics.device), requires_grad=False)
        self.register_buffer("reach", torch.tensor(float(reach), dtype=torch.float64, device=intrinsics.device))

    def forward(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., N, 3) to pixels (..., N, 2) and valid (..., N): in front of the camera, no more is known.

        Pixels that are not valid hold the principal point.
        """
        points = as_points("points_cam", points_cam, 3)
        valid = torch.isfinite(points).all(-1) & (points[..., 2] > 0)
        ahead = points.new_tensor([0.0, 0.0, 1.0])
        points = torch.where(valid[..., None], points, ahead)
        pixels = self.pixels(points.transpose(-1, -2), self.intrinsics, self.weights).transpose(-1, -2)
        return torch.where(valid[..., None], pixels, self.intrinsics[2:]), valid

    def pixels(self, points: Tensor, intrinsics: Tensor, weights: Tensor) -> Tensor:
        """Points (..., 3, N) in front of the camera to pixels (..., 2, N), for other parameters."""
        plane = points[..., :2, :] / points[..., 2:, :]
        distorted = self.reach * evaluate(plane / self.reach, weights, self.widths)
        if self.skip:
            distorted = distorted + plane
        return intrinsics[:2, None] * distorted + intrinsics[2:, None]

    def project(self, points: Tensor, intrinsics: Tensor, weights: Tensor) -> NetProjection:
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
        return NetProjection(
            pixels, torch.cat([slope, by_depth], -3), by_intrinsics, focal * self.reach * net.by_weights
        )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)
