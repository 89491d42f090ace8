"""`TriangulateViews`: points seen by any number of cameras, linear, in angle, or with the highest likelihood."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from kcal.checks import as_points, keep_float64, require_finite
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.dispatch import is_differentiated
from kcal.locate.angular import triangulate_angular
from kcal.locate.linear import triangulate_linear
from kcal.locate.max_likelihood import RelativeCamera, inverse_covariances, most_likely, position_slope, symmetric
from kcal.locate.stereo import PositionStatus, flag_positions

Method = Literal["linear", "angular", "likelihood"]


class ViewsResult(NamedTuple):
    """Result of `TriangulateViews`; nothing in it is NaN.

    Attributes:
        points: (..., N, 3) meters in the world frame; the first camera's center unless the status is OK.
        covariance: (..., N, 3, 3) from the pixels' noise, to first order; an infinite diagonal unless OK.
        status: (..., N) int8, codes of `PositionStatus`; PARALLEL stands for all rays that do not meet in front of
            every camera.
        reprojection: (..., N, C) distance in px between mark and reprojected point; zero unless OK.
    """

    points: Tensor
    covariance: Tensor
    status: Tensor
    reprojection: Tensor


class TriangulateViews(nn.Module):
    """Points from their pixels in two or more cameras, with a covariance and a status each.

    Methods: `linear` is Eq. 9 by singular values, `angular` the closed form in angles, three to ten times faster and
    as accurate, `likelihood` (the default) the Gauss-Newton minimum of the reprojection errors, weighed by the pixels'
    covariances. All work in a local frame in float64, and have exact gradients.

    Args:
        cameras: C of them.
        cam_from_world: (C, 3, 4) matrices [R | t], meters.
        method: see above.
        pixel_sigma: standard deviation of a mark along each axis, px, where no covariance is given.

    Raises:
        InputError: fewer than two cameras, wrong shapes, a matrix that is no rotation.
        DegenerateError: all cameras in the same place.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> poses = torch.eye(3, 4, dtype=torch.float64).repeat(3, 1, 1)
        >>> poses[1, 0, 3], poses[2, 0, 3] = -10.0, -20.0  # ten and twenty meters to the right
        >>> pixels = torch.tensor([[[960.0, 540.0], [944.0, 540.0], [928.0, 540.0]]])
        >>> found = TriangulateViews([camera] * 3, poses, pixel_sigma=0.1)(pixels)
        >>> round(found.points[0, 2].item(), 3), round(found.covariance[0, 2, 2].sqrt().item(), 2)
        (1000.0, 4.42)
    """

    cam_from_world: Tensor

    def __init__(
        self,
        cameras: Sequence[Camera],
        cam_from_world: Tensor,
        *,
        method: Method = "likelihood",
        pixel_sigma: float = 0.3,
    ) -> None:
        super().__init__()
        poses = as_points("cam_from_world", cam_from_world, 4)
        if len(cameras) < 2 or tuple(poses.shape) != (len(cameras), 3, 4):
            raise InputError(
                f"cam_from_world: two cameras or more and shape (C, 3, 4) are needed, got {len(cameras)} cameras and "
                f"{tuple(poses.shape)}"
            )
        require_finite("cam_from_world", poses)
        rotation = poses[:, :, :3]
        still = torch.eye(3, dtype=torch.float64, device=poses.device)
        if not torch.allclose(rotation @ rotation.mT, still.expand_as(rotation), atol=1e-6) or bool(
            (torch.linalg.det(rotation) < 0).any()
        ):
            raise InputError("cam_from_world: not a rotation (R Rᵀ must be 1 and det R = +1)")
        if method not in get_args(Method):
            raise InputError(f"method {method!r}: one of {', '.join(get_args(Method))} is needed")
        if not 0 < pixel_sigma < float("inf"):
            raise InputError(f"pixel_sigma: a positive number of pixels is needed, got {pixel_sigma}")
        self.cameras = nn.ModuleList(cameras)
        self.method = method
        self.pixel_sigma = float(pixel_sigma)
        self.register_buffer("cam_from_world", poses.detach().clone())
        if not float(self._scale()) > 0:
            raise DegenerateError("all cameras stand in the same place: no range can be measured")

    def _from_first(self) -> tuple[Tensor, Tensor]:
        """Rotations (C, 3, 3) and translations (C, 3) from the first camera's frame."""
        rotation, translation = self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]
        turn = rotation @ rotation[0].mT
        return turn, translation - (turn @ translation[0][:, None])[..., 0]

    def _scale(self) -> Tensor:
        return torch.linalg.vector_norm(self._from_first()[1], dim=-1).amax()

    def forward(self, pixels: Tensor, cov: Tensor | None = None) -> ViewsResult:
        """Triangulate pixels (..., N, C, 2).

        Args:
            pixels: integer coordinates at pixel centers.
            cov: (..., N, C, 2, 2) covariance of each pixel, or broadcastable to it.

        Raises:
            InputError: not floating point, or wrong shapes.
        """
        pixels = as_points("pixels", pixels, 2)
        count = len(self.cameras)
        if pixels.ndim < 3 or pixels.shape[-2] != count:
            raise InputError(f"pixels: shape (..., N, {count}, 2) is needed, got {tuple(pixels.shape)}")
        finite = torch.isfinite(pixels).all(-1).all(-1)
        cameras: list[Camera] = list(self.cameras)  # type: ignore[arg-type]
        middle = torch.stack([camera.center.detach() for camera in cameras])
        pixels = torch.where(finite[..., None, None], pixels, middle)
        rays, seen, inside = [], [], []
        for number, camera in enumerate(cameras):
            ray, valid = camera.unproject(pixels[..., number, :])
            rays.append(ray)
            seen.append(valid)
            inside.append(camera.inside(pixels[..., number, :]))
        weight, sound = inverse_covariances(_joint_covariance(cov, pixels))
        turn, shift = self._from_first()
        solve = triangulate_linear if self.method == "linear" else triangulate_angular
        # The first camera's frame: a far world origin costs no digits.
        points, valid = solve(torch.cat([turn, shift[..., None]], -1), torch.stack(rays, -2))
        code = torch.zeros(points.shape[:-1], dtype=torch.int8, device=points.device)
        for condition, status in (
            (~valid, PositionStatus.PARALLEL),
            (~torch.stack(seen).all(0), PositionStatus.OUTSIDE_LENS),
            (~torch.stack(inside).all(0), PositionStatus.OUTSIDE_IMAGE),
            (~sound, PositionStatus.BAD_COVARIANCE),
            (~finite, PositionStatus.NOT_FINITE),
        ):
            code = flag_positions(code, condition, status)
        return self._refined(cameras, pixels, points, rays[0], code, weight)

    def _refined(
        self, cameras: list[Camera], pixels: Tensor, points: Tensor, ray: Tensor, code: Tensor, weight: Tensor | None
    ) -> ViewsResult:
        turn, shift = self._from_first()
        scale = torch.linalg.vector_norm(shift, dim=-1).amax()
        ok = code == int(PositionStatus.OK)
        with torch.no_grad():
            distance = torch.where(ok, torch.linalg.vector_norm(points, dim=-1), 1.0)
            ahead = torch.where(ok[..., None], points / distance[..., None], ray)
        posed = [RelativeCamera(*each) for each in zip(cameras, turn, shift, strict=True)]
        learns = self.method == "likelihood" and is_differentiated(
            pixels, *self.parameters(), *([] if weight is None else [weight])
        )
        fit = most_likely(
            posed, scale, (ahead, scale / distance), pixels.flatten(-2).mT, ok, weight, differentiated=learns,
        )  # fmt: skip
        if self.method == "likelihood":
            ok = ok & (fit.inverse > 0)
            code = flag_positions(code, (code == int(PositionStatus.OK)) & ~ok, PositionStatus.PARALLEL)
            points = (scale / torch.where(ok, fit.inverse, 1.0))[..., None] * fit.direction.mT
        points = torch.where(ok[..., None], points, 0.0)
        rotation, translation = self.cam_from_world[0, :, :3], self.cam_from_world[0, :, 3]
        variance = self.pixel_sigma**2 if weight is None else 1.0
        slope = rotation.mT @ position_slope(fit, scale, ok)
        covariance = variance * slope @ symmetric(fit.covariance) @ slope.mT
        misses = []
        for number, camera in enumerate(posed):
            again, _ = camera.camera.project(
                torch.where(ok[..., None], points, ray) @ camera.rotation.mT + camera.translation
            )
            misses.append(torch.where(ok[..., None], again - pixels[..., number, :], 0.0))
        return ViewsResult(
            points=(points - translation) @ rotation,
            covariance=torch.where(
                ok[..., None, None], covariance, torch.diag(covariance.new_full((3,), float("inf")))
            ),
            status=code,
            reprojection=torch.linalg.vector_norm(torch.stack(misses, -2), dim=-1),
        )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)


def _joint_covariance(cov: Tensor | None, pixels: Tensor) -> Tensor | None:
    """Covariances (..., N, C, 2, 2) of each pixel as blocks along the diagonal of (..., N, 2 C, 2 C)."""
    if cov is None:
        return None
    cov = as_points("cov", cov, 2)
    if cov.ndim < 2 or cov.shape[-2] != 2:
        raise InputError(f"cov: shape (..., N, {pixels.shape[-2]}, 2, 2) is needed, got {tuple(cov.shape)}")
    still = torch.eye(pixels.shape[-2], dtype=cov.dtype, device=cov.device)
    blocks = cov.expand(*pixels.shape, 2)[..., :, :, None, :] * still[:, None, :, None]  # (..., N, C, 2, C, 2)
    return blocks.flatten(-2).flatten(-3, -2)
