"""Pixel pairs of a stereo rig to points in meters, with a status for each: the module `Triangulate`."""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kcal.checks import as_points
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.rig import StereoRig
from kcal.locate.angular import triangulate_pairs
from kcal.locate.ranges import range_interval

# Radians. A smaller parallax is parallel for any camera: the point would be a billion baselines away.
_PARALLEL = 1e-9
# A ray this close (sine) to the line through both cameras meets the other camera's rays everywhere on that line.
_EPIPOLE = 1e-9
# Radians of turn for the angular size of a pixel by central differences: truncation and rounding both near 1e-9.
_TURN = 1e-5


class Status(enum.IntEnum):
    """What became of a pixel pair. Only `OK` comes with a point; `PARALLEL` still has a bearing and a nearest range."""

    OK = 0
    OUTSIDE_LENS = 1
    BEHIND = 2
    PARALLEL = 3
    NOT_FINITE = 4
    OUTSIDE_IMAGE = 5
    BEARING_ONLY = 6
    MASKED = 7
    BAD_COVARIANCE = 8


# Plain numbers: torch.compile cannot compare a tensor with an enum's member.
_OK, _AT_INFINITY = int(Status.OK), int(Status.PARALLEL)


class Triangulation(NamedTuple):
    """Result of `Triangulate`; no tensor holds NaN, whatever went in.

    Attributes:
        points: (..., N, 3) meters in the rig frame (the left camera's); zeros unless the status is OK.
        status: (..., N) int8, codes of `Status` (never BEARING_ONLY: the geometry alone cannot tell; nor the last two,
            which speak of what `StereoLocalizer` is given besides).
        rays: (..., N, 3) unit rays of the left camera; its optical axis where the lens has none.
        reprojection: (..., N, 2) distance in px between mark and reprojected point, left and right; zeros unless OK.
        parallax: (..., N) radians by which the rays converge in the epipolar plane, negative where they diverge.
        parallax_sigma: (..., N) its standard deviation from the marks' noise; carries no gradient.
        range_low: (..., N) meters from the left camera, lower end of the 95 % interval of the marks' noise.
        range_high: (..., N) its upper end, infinite where the point may be at infinity. The interval is 0 to infinity
            unless the status is OK or PARALLEL.
        bearing_only: (..., N) true where the parallax is below three sigma: trust the bearing, not the range.
    """

    points: Tensor
    status: Tensor
    rays: Tensor
    reprojection: Tensor
    parallax: Tensor
    parallax_sigma: Tensor
    range_low: Tensor
    range_high: Tensor
    bearing_only: Tensor


class Triangulate(nn.Module):
    """Locate pixel pairs in the rig frame.

    The status of a pair is decided from the two rays before anything is divided: `NOT_FINITE` (NaN or infinite
    pixels), `OUTSIDE_IMAGE` (more than half a pixel outside), `OUTSIDE_LENS` (the lens model has no ray there),
    `BEHIND` (the rays' lines cross behind exactly one camera), `PARALLEL` (parallel or diverging rays: at or beyond
    infinity, or along the baseline), else `OK`. Points near infinity are `OK` with a wide range interval.

    There is no branch on values, so that the module compiles and exports. Geometry runs in float64 whatever the
    pixels' type; derivatives by the pixels are exact and finite, and zero for pairs that are not OK.

    Args:
        rig: two cameras and their relative pose.
        pixel_sigma: standard deviation of the marks, px along each axis, for the range interval. It stands for the
            marks' noise only: calibration errors come on top.

    Raises:
        InputError: a `pixel_sigma` that is not positive.
        DegenerateError: a rig without a baseline.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> left = torch.tensor([[960.0, 540.0]], dtype=torch.float64)
        >>> result = Triangulate(rig)(left, left - torch.tensor([3.2, 0.0], dtype=torch.float64))
        >>> round(result.points[0, 2].item(), 3), Status(int(result.status[0])).name
        (5000.0, 'OK')
    """

    def __init__(self, rig: StereoRig, pixel_sigma: float = 0.3) -> None:
        super().__init__()
        if not 0 < pixel_sigma < math.inf:
            raise InputError(f"pixel_sigma: a positive number of pixels is needed, got {pixel_sigma}")
        if not float(rig.baseline) > 0:
            raise DegenerateError("the rig's cameras stand in the same place: no range can be measured")
        self.rig = rig
        self.pixel_sigma = float(pixel_sigma)

    def forward(self, pixels_left: Tensor, pixels_right: Tensor) -> Triangulation:
        """Triangulate matched pixels, both (..., N, 2), integer coordinates at pixel centers.

        Raises:
            InputError: not floating point, or shapes that are wrong or unlike.
        """
        pixels_left = as_points("pixels_left", pixels_left, 2)
        pixels_right = as_points("pixels_right", pixels_right, 2)
        if pixels_left.shape != pixels_right.shape or pixels_left.ndim < 2:
            raise InputError(
                "pixels_left and pixels_right: the same shape (..., N, 2) is needed, "
                f"got {tuple(pixels_left.shape)} and {tuple(pixels_right.shape)}"
            )
        rotation, translation = self.rig.right_from_left_rotation, self.rig.right_from_left_translation
        lines = sight_lines(self.rig, pixels_left, pixels_right)
        rays_left, pair, code, points = lines.rays_left, lines.pair, lines.status, lines.points

        ok = (code == _OK)[..., None]
        points = torch.where(ok, points, rays_left)
        reprojected_left, _ = self.rig.left.project(points)
        reprojected_right, _ = self.rig.right.project(points @ rotation.T + translation)
        misses = torch.stack([reprojected_left - pixels_left, reprojected_right - pixels_right], -2)
        reprojection = torch.linalg.vector_norm(torch.where(ok[..., None], misses, 0.0), dim=-1)

        known = ok[..., 0] | (code == _AT_INFINITY)
        with torch.no_grad():
            sizes = (
                _pixel_angle(self.rig.left, rays_left, pair.turn_left, pair.normal_left),
                _pixel_angle(
                    self.rig.right, lines.rays_right, pair.turn_right @ rotation.T, pair.normal_right @ rotation.T
                ),
            )
            sigma = self.pixel_sigma * torch.hypot(*sizes)
            # One pixel of a camera never spans more than this; a broken lens model may say anything.
            sigma = torch.where(known & torch.isfinite(sigma), sigma, math.pi)
        parallax = torch.where(known, pair.parallax, 0.0)
        low, high, bearing_only = range_interval(self.rig.baseline, pair.bearing, parallax, sigma)
        open_low = ~known | pair.along_baseline
        return Triangulation(
            points=torch.where(ok, points, 0.0),
            status=code,
            rays=rays_left,
            reprojection=reprojection,
            parallax=parallax,
            parallax_sigma=sigma,
            range_low=torch.where(open_low, 0.0, low),
            range_high=torch.where(open_low, math.inf, high),
            bearing_only=bearing_only,
        )


class SightLines(NamedTuple):
    """What the rays of pixel pairs say before any noise is thought of.

    Attributes:
        rays_left: (..., N, 3) unit rays in the left camera's frame.
        rays_right: (..., N, 3) likewise in the right camera's.
        points: (..., N, 3) in the same frame, of `triangulate_pairs`; zeros where the rays do not meet ahead.
        status: (..., N) int8, as in `Triangulation`.
        pair: the angles of the two rays.
    """

    rays_left: Tensor
    rays_right: Tensor
    points: Tensor
    status: Tensor
    pair: PairAngles


def sight_lines(rig: StereoRig, pixels_left: Tensor, pixels_right: Tensor) -> SightLines:
    """Rays, closed-form points and statuses of float64 pixels, both (..., N, 2)."""
    rotation, translation = rig.right_from_left_rotation, rig.right_from_left_translation
    rays_left, seen_left = rig.left.unproject(pixels_left)
    rays_right, seen_right = rig.right.unproject(pixels_right)
    inside = rig.left.inside(pixels_left) & rig.right.inside(pixels_right)
    finite = (torch.isfinite(pixels_left) & torch.isfinite(pixels_right)).all(-1)
    pair = _epipolar(rays_left, rays_right @ rotation, -translation @ rotation)
    points, solved = triangulate_pairs(rays_left, rays_right, (rotation, translation))
    code = torch.full(rays_left.shape[:-1], _OK, dtype=torch.int8, device=rays_left.device)
    for condition, status in (
        ((pair.parallax <= _PARALLEL) | pair.along_baseline, Status.PARALLEL),
        ((pair.opposite | (~solved & (pair.parallax > _PARALLEL))) & ~pair.along_baseline, Status.BEHIND),
        (~(seen_left & seen_right), Status.OUTSIDE_LENS),
        (~inside, Status.OUTSIDE_IMAGE),
        (~finite, Status.NOT_FINITE),
    ):
        code = torch.where(condition, code.new_full((), int(status)), code)
    return SightLines(rays_left, rays_right, points, code, pair)


class PairAngles(NamedTuple):
    """Two rays seen in the plane of the left ray and the baseline; vectors are in the rig frame."""

    bearing: Tensor
    parallax: Tensor
    opposite: Tensor
    along_baseline: Tensor
    turn_left: Tensor
    normal_left: Tensor
    turn_right: Tensor
    normal_right: Tensor


def _epipolar(left: Tensor, right: Tensor, baseline: Tensor) -> PairAngles:
    """Angles of unit rays (..., N, 3), both in the rig frame; `baseline` points from the left camera to the right."""
    axis = (baseline / torch.linalg.vector_norm(baseline)).expand_as(left)
    normal, sine, left_ok = _safe_unit(torch.linalg.cross(axis, left))
    side = torch.linalg.cross(normal, axis)
    cosine = (left * axis).sum(-1)
    along, across = (right * axis).sum(-1), (right * side).sum(-1)
    normal_right, _, right_ok = _safe_unit(torch.linalg.cross(axis, right))
    # The right ray in the plane: the rest of it, the epipolar error, says nothing about the range.
    in_plane = left_ok & right_ok & (torch.hypot(along, across) > _EPIPOLE)
    return PairAngles(
        bearing=torch.atan2(torch.where(left_ok, sine, 1.0), torch.where(left_ok, cosine, 0.0)),
        parallax=torch.atan2(
            torch.where(in_plane, cosine * across - sine * along, 0.0),
            torch.where(in_plane, cosine * along + sine * across, 1.0),
        ),
        opposite=across <= 0,
        along_baseline=~in_plane,
        turn_left=torch.linalg.cross(normal, left),
        normal_left=normal,
        turn_right=torch.linalg.cross(normal_right, right),
        normal_right=normal_right,
    )


def _safe_unit(vector: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vector, length and whether it is long enough; a fixed vector stands in for a short one."""
    squared = (vector * vector).sum(-1)
    long = squared > _EPIPOLE**2
    vector = torch.where(long[..., None], vector, vector.new_tensor([0.0, 1.0, 0.0]))
    length = torch.linalg.vector_norm(vector, dim=-1)
    return vector / length[..., None], torch.where(long, length, 0.0), long


def _pixel_angle(camera: Camera, rays: Tensor, turn: Tensor, normal: Tensor) -> Tensor:
    """Radians along `turn` per pixel of isotropic noise at each ray: the first row's norm of the inverse Jacobian.

    The Jacobian of pixels by turns of the ray along `turn` and `normal` is taken by central differences.
    """
    steps = torch.stack([turn, -turn, normal, -normal], -2) * _TURN
    pixels, _ = camera.project((rays[..., None, :] + steps).flatten(-3, -2))
    pixels = pixels.unflatten(-2, (rays.shape[-2], 4))
    by_turn = (pixels[..., 0, :] - pixels[..., 1, :]) / (2 * _TURN)
    by_normal = (pixels[..., 2, :] - pixels[..., 3, :]) / (2 * _TURN)
    determinant = by_turn[..., 0] * by_normal[..., 1] - by_turn[..., 1] * by_normal[..., 0]
    return torch.linalg.vector_norm(by_normal, dim=-1) / determinant.abs()
