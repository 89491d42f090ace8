"""`TriangulateViews`: points seen by any number of cameras, linear (Eq. 9), in angle, or most likely."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from kcal.checks import StatedModule, as_points, exportable, require_finite, scalar
from kcal.dispatch import is_differentiated
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import Movable, rotation_from_vector
from kcal.locate.angular import HORIZON, checked_views, triangulate_angular
from kcal.locate.stereo import PositionStatus, flag_positions, reprojection_errors, status_counts
from kcal.locate.views import PosedCameras, fit_views
from kcal.texts import brief

# Linear triangulation (Eq. 9) from rays of two or more cameras, batched, with exact first and second derivatives.

# Below this gap of the squared singular values (the rays have unit length, the cameras a spread of one) the answer
# is not determined: all rays lie along the line through the camera centers.
_LEAST_GAP = 1e-18


def triangulate_linear(cam_from_world: Tensor, rays: Tensor, seen: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The point nearest to all rays in the sense of Eq. 9: the right singular vector of the smallest singular value.

    For each camera the three rows of `ray x (R X + t) = 0` are stacked. Eq. 9 has the first two of them in pixels;
    with unit rays all pixels of a wide lens weigh alike, and the third row keeps rays far off axis well determined.
    Before the decomposition the world is moved to the middle of the camera centers and scaled by their spread, so
    that a far origin (ECEF) or an unlike unit costs no digits.

    Derivatives do not come from the decomposition's own backward pass, which divides by differences of *all*
    singular values: two chord steps on the eigenvalue equation need only the gap above the smallest. Two steps from
    an exact root make first and second derivatives exact.

    Args:
        cam_from_world: (..., C, 3, 4) matrices [R | t] with R a rotation; leading dimensions broadcast with those of
            `rays`. C is at least 2.
        rays: (..., N, C, 3) directions in each camera's frame, any length but zero.
        seen: (..., N, C) bool: which cameras saw what, two at least; what is False is not read. All, if left out.

    Returns:
        points (..., N, 3) in the world frame, float64, and valid (..., N): true where the point is finite, determined
        and in front of every camera along its ray. Points that are not valid are the middle of the camera centers.

    Raises:
        InputError: wrong shapes or dtypes.

    Source: the paper, Eq. 8 and 9 (the DLT of Hartley and Zisserman, section 12.2).

    Example:
        >>> left = torch.eye(3, 4, dtype=torch.float64)
        >>> right = left.clone()
        >>> right[0, 3] = -10.0
        >>> rays = torch.tensor([[[0.0, 0.0, 1.0], [-0.002, 0.0, 1.0]]], dtype=torch.float64)
        >>> points, valid = triangulate_linear(torch.stack([left, right]), rays)
        >>> round(points[0, 2].item(), 6), valid.tolist()
        (5000.0, [True])
    """
    cam_from_world, rays = checked_views(cam_from_world, rays)
    rotation, translation = cam_from_world[..., :3], cam_from_world[..., 3]
    centers = -(rotation.mT @ translation[..., None])[..., 0]
    middle = centers.mean(-2, keepdim=True)
    spread = torch.linalg.vector_norm(centers - middle, dim=-1).amax(-1, keepdim=True)
    spread = 2.0 * torch.where(spread > 0, spread, 1.0)
    local = (rotation @ (middle - centers)[..., None]) / spread[..., None, None]

    counts = torch.ones_like(rays[..., 0], dtype=torch.bool) if seen is None else seen
    length = torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    usable = ((torch.isfinite(length) & (length > 0))[..., 0] | ~counts).all(-1) & (counts.sum(-1) > 1)
    usable = usable[..., None, None]
    ahead = rays.new_tensor([0.0, 0.0, 1.0])
    units = torch.where(usable, rays, ahead)
    units = units / torch.linalg.vector_norm(units, dim=-1, keepdim=True)
    if seen is not None:
        units = torch.where(seen[..., None], units, 0.0)

    cameras = torch.cat([rotation, local], -1)[..., None, :, :, :]
    # (..., N, C, 3, 4): the ray crossed with each column of [R | t].
    system = torch.linalg.cross(*torch.broadcast_tensors(units[..., None], cameras), dim=-2).flatten(-3, -2)
    solution, determined = _null_vector(system)
    weight = solution[..., 3:]
    nearer = weight.abs() * HORIZON > torch.linalg.vector_norm(solution[..., :3], dim=-1, keepdim=True)
    finite = nearer & determined[..., None]
    local_points = torch.where(finite, solution[..., :3], 0.0) / torch.where(finite, weight, 1.0)

    in_cameras = (cameras[..., :3] @ local_points[..., None, :, None] + cameras[..., 3:])[..., 0]
    ahead_of_all = (((in_cameras * units).sum(-1) > 0) | ~counts).all(-1, keepdim=True)
    valid = finite & ahead_of_all & usable[..., 0, :]
    points = middle + spread[..., None, :] * torch.where(valid, local_points, 0.0)
    return points, valid[..., 0]


def _null_vector(system: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector h minimizing |system h|, and whether it is unique; differentiable twice.

    G(h) = (M - λ(h)) h with M = systemᵀ system and λ the Rayleigh quotient vanishes at the answer. In the basis of
    the other singular vectors its Jacobian is diag(λ_i - λ), held fixed at the known root (a chord step).
    """
    with torch.no_grad():
        _, singular, basis = torch.linalg.svd(system, full_matrices=False)
        squared = singular * singular
        gap = squared[..., :3] - squared[..., 3:]
        determined = gap[..., 2] > _LEAST_GAP
        inverse_gap = torch.where(determined[..., None], 1.0 / torch.where(gap > _LEAST_GAP, gap, 1.0), 0.0)
        others, h = basis[..., :3, :].mT, basis[..., 3, :, None]
    for _ in range(2):
        residual = system @ h
        value = (residual * residual).sum((-2, -1), keepdim=True) / (h * h).sum((-2, -1), keepdim=True)
        # (system others)ᵀ residual, not othersᵀ (M h): a product of small numbers keeps its digits.
        gradient = (system @ others).mT @ residual - value * (others.mT @ h)
        h = h - others @ (inverse_gap[..., None] * gradient)
    return h[..., 0], determined


# `TriangulateViews`: points seen by any number of cameras, linear, in angle, or with the highest likelihood.

Method = Literal["linear", "angular", "likelihood"]


@exportable
class ViewsResult(NamedTuple):
    """Result of `TriangulateViews`; nothing in it is NaN.

    Attributes:
        points: (..., N, 3) meters in the world frame; the first camera's center unless the status is OK.
        covariance: (..., N, 3, 3) from the pixels' noise, to first order; an infinite diagonal unless OK.
        status: (..., N) int8, codes of `PositionStatus`; PARALLEL stands for all rays that do not meet in front of
            every camera that saw the point, NOT_FINITE for points that fewer than two cameras saw.
        reprojection: (..., N, C) distance in px between mark and reprojected point; zero unless OK, and where a camera
            did not see the point.
    """

    points: Tensor
    covariance: Tensor
    status: Tensor
    reprojection: Tensor

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))


class TriangulateViews(Movable, StatedModule):
    """Points from their pixels in any two or more of several cameras, with a covariance and a status each.

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

    pixel_sigma: Tensor

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
        self.register_buffer("pixel_sigma", scalar(pixel_sigma, poses))
        self._keep("cam_from_world", poses, turns=True)
        center = self.posed.center
        if not float((center - center[0]).norm(dim=-1).amax()) > 0:
            raise DegenerateError("all cameras stand in the same place: no range can be measured")

    @property
    def cam_from_world(self) -> Tensor:
        """(C, 3, 4) matrices [R | t], with the steps of `free`."""
        kept, step = self._kept("cam_from_world"), self.freed_step
        if step is None:
            return kept
        return torch.cat([rotation_from_vector(step[0]) @ kept[..., :3], kept[..., 3:] + step[1][..., None]], -1)

    @property
    def constants(self) -> object:
        """The method."""
        return self.method

    @property
    def pose_slots(self) -> dict[str, Any]:
        """What `free` takes; a step is that of `kcal.lens.pose`."""
        return {"pose": slice(None)}

    def _zero_step(self) -> Tensor:
        return torch.zeros_like(self._kept("cam_from_world")[:, :2].flatten(1)[:, :6])

    @property
    def posed(self) -> PosedCameras:
        """The cameras as they stand."""
        cameras: list[Camera] = list(self.cameras)  # type: ignore[arg-type]
        poses = self.cam_from_world
        turn, shift = poses[:, :, :3], poses[:, :, 3]
        return PosedCameras(cameras, turn, -(turn.mT @ shift[..., None])[..., 0])

    def forward(self, pixels: Tensor, cov: Tensor | None = None) -> ViewsResult:
        """Triangulate pixels (..., N, C, 2).

        Args:
            pixels: integer coordinates at pixel centers; NaN where a camera did not see a point.
            cov: (..., N, C, 2, 2) covariance of each pixel, or broadcastable to it.

        Raises:
            InputError: not floating point, or wrong shapes.
        """
        pixels = as_points("pixels", pixels, 2, self.cam_from_world)
        count, lead = len(self.cameras), pixels.shape[:-2]
        if pixels.ndim < 3 or pixels.shape[-2] != count:
            raise InputError(f"pixels: shape (..., N, {count}, 2) is needed, got {tuple(pixels.shape)}")
        cov = checked_views_covariance(cov, pixels)
        pixels = pixels.reshape(-1, count, 2)
        differentiated = is_differentiated(pixels, cov, self)
        posed, finite = self.posed, torch.isfinite(pixels).all(-1)
        views = fit_views(posed, pixels, finite, noise=self.pixel_sigma, cov=cov, differentiated=differentiated)
        code, off = views.status, finite & ~views.used
        with torch.no_grad():
            inside = [camera.inside(pixels[..., c, :]) for c, camera in enumerate(posed.cameras)]
        away = views.behind(posed.center) | (views.fit.inverse <= 0)
        for condition, status in (
            ((code == int(PositionStatus.OK)) & away, PositionStatus.PARALLEL),
            (code == int(PositionStatus.BEARING_ONLY), PositionStatus.NOT_FINITE),
            (off.any(-1), PositionStatus.OUTSIDE_LENS),
            ((finite & ~torch.stack(inside, -1)).any(-1), PositionStatus.OUTSIDE_IMAGE),
            (views.status == int(PositionStatus.BAD_COVARIANCE), PositionStatus.BAD_COVARIANCE),
        ):
            code = flag_positions(code, condition, status)
        ok = code == int(PositionStatus.OK)
        points, misses = views.points(ok), reprojection_errors(views.fit.residual)
        if self.method != "likelihood":
            points, misses = self._in_closed_form(posed, pixels, views.used, ok)
        result = ViewsResult(
            points=torch.where(ok[..., None], points, posed.center[0]),
            covariance=views.covariance(ok),
            status=code,
            reprojection=torch.where(ok[..., None] & views.used, misses, 0.0),
        )
        return ViewsResult(*(value.reshape(*lead[:-1], lead[-1], *value.shape[1:]) for value in result))

    def _in_closed_form(self, posed: PosedCameras, pixels: Tensor, used: Tensor, ok: Tensor) -> tuple[Tensor, Tensor]:
        """Points (N, 3) and what they miss the marks (N, C) by, px, by the other methods."""
        used = used & ok[..., None]
        middle = torch.stack([camera.center.detach() for camera in posed.cameras])
        marks = torch.where(used[..., None], pixels, middle)
        rays = torch.stack([camera.unproject(marks[..., c, :])[0] for c, camera in enumerate(posed.cameras)], -2)
        solve = triangulate_linear if self.method == "linear" else triangulate_angular
        found, _ = solve(posed.matrices, rays, used)
        misses = []
        for c, (camera, turn) in enumerate(zip(posed.cameras, posed.rotation, strict=True)):
            seen = (found + (posed.center[0] - posed.center[c])) @ turn.T
            seen = torch.where(used[..., c, None], seen, seen.new_tensor([0.0, 0.0, 1.0]))
            misses.append(torch.where(used[..., c, None], camera.project(seen)[0] - marks[..., c, :], 0.0))
        return found + posed.center[0], reprojection_errors(torch.cat(misses, -1).mT)


def checked_views_covariance(cov: Tensor | None, pixels: Tensor) -> Tensor | None:
    """(N, C, 2, 2) float64 of covariances that broadcast to those of pixels (..., N, C, 2); all rows in one axis."""
    if cov is None:
        return None
    cov = as_points("cov", cov, 2)
    if cov.ndim < 2 or cov.shape[-2] != 2:
        raise InputError(f"cov: shape (..., N, {pixels.shape[-2]}, 2, 2) is needed, got {tuple(cov.shape)}")
    return cov.expand(*pixels.shape, 2).reshape(-1, pixels.shape[-2], 2, 2)
