"""Positions in the rig's own frame, without the Earth: from pixels, and from disparities of rectified images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, get_args

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from kcal.checks import Float64Module, StatedModule, as_tensor, exportable, scalar
from kcal.dispatch import is_differentiated
from kcal.errors import InputError
from kcal.lens.images import StereoRectification
from kcal.lens.rig import Rig
from kcal.locate.angular import Method, triangulate
from kcal.locate.localizer import Localizer
from kcal.locate.max_likelihood import inverse_variance
from kcal.locate.stereo import (
    PositionStatus,
    checked_pair_covariance,
    checked_pairs,
    checked_rig,
    checked_views,
    checked_views_covariance,
    flag_positions,
    joint_covariance,
    piece_by_piece,
    range_where_ok,
    reprojection_errors,
    status_counts,
)
from kcal.locate.views import PosedCameras, ViewsFit, fit_pairs, fit_views, reach_of
from kcal.operation import Operations, shapes_of
from kcal.texts import brief, briefly

# `Triangulate`: pixels of two or more cameras to points in the rig's own frame, without the Earth.


@exportable
class Triangulation(NamedTuple):
    """Result of `Triangulate`, for N points and V cameras; no tensor contains NaN, whatever went in.

    Ranges and rays count from the first camera that saw a point: of two, always the left one.

    Attributes:
        points: (..., N, 3) meters in the rig's frame (of two cameras the left one's); the first camera's center unless
            the status is OK.
        status: (..., N) int8, codes of `PositionStatus`; never BEARING_ONLY: see `bearing_only`.
        rays: (..., N, 3) unit vectors of the most likely direction in the rig's frame; the first camera's optical axis
            where the lens has no ray.
        reprojection: (..., N, V) distance in px between mark and reprojected point; zeros unless OK, and where a camera
            did not see the point.
        inverse_range: (..., N) one over meters, negative where the rays diverge.
        inverse_range_sigma: (..., N) its standard deviation from the marks' noise; zero where nothing is known.
        range_low: (..., N) meters, lower end of the 95 % interval of the marks' noise.
        range_high: (..., N) its upper end, infinite where the point may be at infinity. The interval is 0 to infinity
            unless the status is OK or PARALLEL.
        bearing_only: (..., N) true where the parallax is below three sigma: trust the bearing, not the range.
        covariance: (..., N, 3, 3) of `points` from the marks' noise, to first order; an infinite diagonal unless OK. At
            long range a point is skewed along the line of sight: quote the range interval.
    """

    points: Tensor
    status: Tensor
    rays: Tensor
    reprojection: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    range_low: Tensor
    range_high: Tensor
    bearing_only: Tensor
    covariance: Tensor

    @property
    def range(self) -> Tensor:
        """(..., N) meters; infinite unless the status is OK."""
        return range_where_ok(self.status, self.inverse_range)

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))


class Triangulate(Operations, StatedModule):
    """Locate pixels of two or more cameras in the rig's frame: the positions of the localizers, without the Earth.

    Of two cameras the status of a pair is decided from the two rays before anything is divided: `NOT_FINITE` (NaN or
    infinite pixels), `OUTSIDE_IMAGE` (more than half a pixel outside), `OUTSIDE_LENS` (the lens model has no ray
    there), `BEHIND` (the rays' lines cross behind exactly one camera), `PARALLEL` (parallel or diverging rays: at or
    beyond infinity, or along the baseline), else `OK`. Points near infinity are `OK` with a wide range interval. Of
    more cameras any two may have seen a point; `NOT_FINITE` says that fewer did, `PARALLEL` that the rays do not meet,
    and `BEHIND` that they meet behind one of them.

    Methods: `linear` is Eq. 9 by singular values, `angular` the closed form in angles, three to ten times faster and
    as accurate, `likelihood` (the default) the Gauss-Newton minimum of the reprojection errors, weighed by the pixels'
    covariances. Status, range and covariance are those of the last, whatever the method.

    There is no branch on values, so that the module compiles and exports. Geometry runs in float64 whatever the
    pixels' type; derivatives by the pixels are exact and finite, and zero for points that are not OK.

    Args:
        rig: the cameras and their poses; their covariance is not used.
        pixel_sigma: standard deviation of the marks, px along each axis, where no covariance is given. Covariance and
            range interval cover the marks' noise only; the localizers add the errors of the calibration.
        method: see above.

    Raises:
        InputError: a `pixel_sigma` that is not positive, one camera, an unknown method.
        DegenerateError: all cameras in one place.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> left = torch.tensor([[960.0, 540.0]], dtype=torch.float64)
        >>> result = Triangulate(rig)(left, left - torch.tensor([3.2, 0.0], dtype=torch.float64))
        >>> round(result.points[0, 2].item(), 3), PositionStatus(int(result.status[0])).name
        (5000.0, 'OK')
        >>> centers = torch.tensor([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]])
        >>> three = Rig([camera] * 3, ["a", "b", "c"], torch.eye(3).repeat(3, 1, 1), center=centers)
        >>> pixels = torch.tensor([[[960.0, 540.0], [944.0, 540.0], [928.0, 540.0]]])
        >>> found = Triangulate(three, pixel_sigma=0.1)(pixels)
        >>> round(found.points[0, 2].item(), 3), round(found.covariance[0, 2, 2].sqrt().item(), 2)
        (1000.0, 4.42)
    """

    results = shapes_of(
        Triangulation, points=(3,), status=torch.int8, rays=(3,), reprojection=(2,), bearing_only=torch.bool,
        covariance=(3, 3),
    )  # fmt: skip
    pixel_sigma: Tensor

    def __init__(self, rig: Rig, pixel_sigma: float = 0.3, *, method: Method = "likelihood") -> None:
        super().__init__()
        if method not in get_args(Method):
            raise InputError(f"method {method!r}: one of {', '.join(get_args(Method))} is needed")
        self.register_buffer("pixel_sigma", scalar(checked_rig(rig, pixel_sigma), rig.translation))
        self.rig, self.method = rig, method
        self._pair = rig.is_pair

    @property
    def constants(self) -> object:
        """The method."""
        return self.method

    @property
    def posed(self) -> PosedCameras:
        """The cameras as they stand."""
        return PosedCameras(self.rig.each, self.rig.rotation, self.rig.center)

    def forward(
        self, pixels: Tensor | ArrayLike, other: Tensor | ArrayLike | None = None, cov: Tensor | None = None
    ) -> Triangulation:
        """Triangulate the pixels (..., N, 2) of two cameras, `forward(left, right)`, or (..., N, V, 2) of V cameras.

        Args:
            pixels: integer coordinates at pixel centers; NaN where a camera did not see a point.
            other: the same points in the right image, (..., N, 2); or (..., N, V) bool, which views count.
            cov: covariance of each pixel, (..., N, V, 2, 2) or broadcastable to it; of left and right that of each
                pair's four coordinates, (..., N, 4, 4).

        Raises:
            InputError: not floating point, or shapes that are wrong or unlike.
        """
        if other is not None and not (isinstance(other, Tensor) and other.dtype == torch.bool):
            return self._of_pairs(pixels, other, cov)
        posed = self.posed
        pixels, seen = checked_views(pixels, other, len(posed.cameras), posed.center)
        cov = checked_views_covariance(cov, pixels)
        if self._pair:
            left, right = torch.where(seen[..., None], pixels, torch.nan).unbind(-2)
            return self._of_pairs(left, right, None if cov is None else joint_covariance(cov))
        lead = pixels.shape[:-2]
        pixels, seen = pixels.reshape(-1, *pixels.shape[-2:]), seen.reshape(-1, seen.shape[-1])
        cov = None if cov is None else cov.reshape(-1, *cov.shape[-3:])
        differentiated = is_differentiated(pixels, cov, self)
        found = fit_views(posed, pixels, seen, noise=self.pixel_sigma, cov=cov, differentiated=differentiated)
        finite = seen & torch.isfinite(pixels).all(-1)
        with torch.no_grad():
            inside = posed.inside(pixels)
        flags = (
            (found.status == int(PositionStatus.BEARING_ONLY), PositionStatus.NOT_FINITE),
            ((finite & ~found.used).any(-1), PositionStatus.OUTSIDE_LENS),
            ((finite & ~inside).any(-1), PositionStatus.OUTSIDE_IMAGE),
            (found.status == int(PositionStatus.BAD_COVARIANCE), PositionStatus.BAD_COVARIANCE),
        )
        result = self._result(posed, found, pixels, flags)
        return Triangulation(*(value.reshape(*lead, *value.shape[1:]) for value in result))

    def _of_pairs(self, left: Tensor | ArrayLike, right: Tensor | ArrayLike, cov: Tensor | None) -> Triangulation:
        rig = self.rig
        if not self._pair:
            raise InputError(f"left and right pixels: this rig has {len(rig)} cameras; give all in one tensor")
        left, right = checked_pairs(left, right, rig)
        cov = checked_pair_covariance(cov, left)
        if found := self.as_operation("forward", left, right, cov):
            return Triangulation(*found)
        differentiated = is_differentiated(left, right, cov, self)

        def triangulate_piece(left: Tensor, right: Tensor, cov: Tensor | None) -> Triangulation:
            found = fit_pairs(rig, left, right, cov, noise=self.pixel_sigma, differentiated=differentiated)
            return self._result(self.posed, found, torch.stack([left, right], -2), ())

        return piece_by_piece(triangulate_piece, left, right, cov, differentiated=differentiated)

    def _result(
        self,
        posed: PosedCameras,
        found: ViewsFit,
        pixels: Tensor,
        flags: Sequence[tuple[Tensor, PositionStatus]],
    ) -> Triangulation:
        behind = None if self._pair else found.behind(posed.center)
        variance = found.variance * inverse_variance(found.fit, found.fit.covariance)
        reach = reach_of(found, variance, PositionStatus.OK, behind)
        code = reach.status
        for condition, status in flags:
            code = flag_positions(code, condition, status)
        ok = code == int(PositionStatus.OK)
        points, misses = found.points(ok), reprojection_errors(found.fit.residual)
        if self.method != "likelihood":
            points, misses = self._in_closed_form(posed, pixels, found.used & ok[..., None])
        return Triangulation(
            points=torch.where(ok[..., None], points, posed.center[0]),
            status=code,
            rays=(found.fit.direction / found.length[..., None, :]).mT,
            reprojection=torch.where(ok[..., None] & found.used, misses, 0.0),
            inverse_range=reach.value,
            inverse_range_sigma=reach.sigma,
            range_low=reach.interval.low,
            range_high=reach.interval.high,
            bearing_only=reach.weak,
            covariance=found.covariance(ok),
        )

    def _in_closed_form(self, posed: PosedCameras, pixels: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., N, 3) and what they miss the marks (..., N, V) by, px, by the other methods."""
        middle = torch.stack([camera.center.detach() for camera in posed.cameras])
        marks = torch.where(used[..., None], pixels, middle)
        rays = torch.stack([camera.unproject(marks[..., c, :])[0] for c, camera in enumerate(posed.cameras)], -2)
        found, _ = triangulate(posed.matrices, rays, used, method=self.method)
        misses = []
        for c, (camera, turn) in enumerate(zip(posed.cameras, posed.rotation, strict=True)):
            seen = (found + (posed.center[0] - posed.center[c])) @ turn.T
            seen = torch.where(used[..., c, None], seen, seen.new_tensor([0.0, 0.0, 1.0]))
            misses.append(torch.where(used[..., c, None], camera.project(seen)[0] - marks[..., c, :], 0.0))
        return found + posed.center[0], reprojection_errors(torch.cat(misses, -1).mT)


# Ranges, with their error bars, from the disparities of rectified images.

# Pixels for the derivatives of resampling, whose curvature is far below that of lenses over a pixel.
_STEP = 0.25
# Pixels located at a time.
_PIECE = 1 << 15


@briefly
@exportable
class RangeImage(NamedTuple):
    """Distances from the left camera, meters, each (..., H, W).

    Attributes:
        range: infinite where there is none.
        sigma: one standard deviation, from the disparity and from the rig's covariance; infinite where there is none.
        low: of the 95 % interval.
        high: likewise; infinite where the range has no upper bound.
        valid: whether there is a range.
    """

    range: Tensor
    sigma: Tensor
    low: Tensor
    high: Tensor
    valid: Tensor


class DisparityRanges(Float64Module):
    """Map disparities of rectified images to ranges and their standard deviations.

    Every pixel is located by `Localizer` in the images as they were taken, so that lenses, entrance pupils and
    the joint covariance of the rig (`Rig.covariance`, exact if there is none) count in full. Results carry no
    gradients; those of `StereoRectification.points` and `Localizer` do.

    Args:
        rectification: of the images.
        disparity_sigma: standard deviation of a disparity, px.

    Raises:
        InputError: a sigma that is not positive.

    Example:
        >>> from kcal import Camera, Rig
        >>> camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
        >>> ranges = DisparityRanges(StereoRectification(rig), disparity_sigma=0.5)
        >>> disparity = torch.full((480, 640), 10.0)
        >>> found = ranges(disparity)
        >>> round(float(found.range[240, 320]), 1), round(float(found.sigma[240, 320]), 1)  # 100² / (500 · 2) · 0.5
        (100.0, 5.0)
    """

    disparity_sigma: Tensor

    def __init__(self, rectification: StereoRectification, *, disparity_sigma: float = 0.3) -> None:
        super().__init__()
        if not 0 < disparity_sigma < math.inf:
            raise InputError(f"disparity_sigma {disparity_sigma}: positive pixels are needed")
        self.rectification = rectification
        self.register_buffer("disparity_sigma", scalar(disparity_sigma, rectification.rotation))
        # Ranges do not depend on where the rig stands, and light that bends moves them by nothing that can be measured.
        self.localize = Localizer(rectification.rig, weights="marks")

    @torch.no_grad()
    def forward(self, disparity: Tensor) -> RangeImage:
        """Map disparities (..., H, W) in pixels of the left rectified image; NaN and the wrong sign have no range.

        Raises:
            InputError: not floating point, or another size.
        """
        width, height = self.rectification.camera.size
        disparity = as_tensor("disparity", disparity)
        if not disparity.is_floating_point() or tuple(disparity.shape[-2:]) != (height, width):
            raise InputError(
                f"disparity: floating point (..., {height}, {width}) is needed, got {disparity.dtype} "
                f"{tuple(disparity.shape)}"
            )
        pixels = self.rectification.camera.grid(width, height).expand(*disparity.shape, 2).reshape(-1, 2)
        flat = disparity.double().reshape(-1)
        pieces = [self.at(*piece) for piece in zip(pixels.split(_PIECE), flat.split(_PIECE), strict=True)]
        return RangeImage(*(torch.cat(parts).reshape(disparity.shape) for parts in zip(*pieces, strict=True)))

    @torch.no_grad()
    def at(self, pixels: Tensor, disparity: Tensor) -> RangeImage:
        """The same for single pixels (N, 2) of the left rectified image and their disparities (N,)."""
        good = self.rectification.depth(disparity).isfinite() & disparity.isfinite()
        safe = torch.where(good, disparity, 1.0)
        left, right, seen = self.rectification.source_pixels(pixels, safe)
        slopes = []
        for step in torch.eye(2, dtype=torch.float64, device=pixels.device) * _STEP:
            ends = [self.rectification.source_pixels(pixels + sign * step, safe)[:2] for sign in (1.0, -1.0)]
            slopes.append([(high - low) / (2.0 * _STEP) for high, low in zip(*ends, strict=True)])
        # A disparity is the difference of two marks, which share its variance.
        variance = 0.5 * self.disparity_sigma**2
        parts = [torch.stack([slope[side] for slope in slopes], -1) for side in (0, 1)]
        cov = torch.zeros(*disparity.shape, 4, 4, dtype=torch.float64, device=pixels.device)
        cov[..., :2, :2], cov[..., 2:, 2:] = (variance * part @ part.mT for part in parts)
        valid = good & seen
        eye = torch.eye(4, dtype=torch.float64, device=pixels.device)
        found = self.localize(left, right, torch.where(valid[:, None, None], cov, eye), valid)
        valid = valid & (found.inverse_range > 0) & found.range_low.isfinite()
        inverse = torch.where(valid, found.inverse_range, 1.0)
        found = RangeImage(
            range=torch.where(valid, 1.0 / inverse, torch.inf),
            sigma=torch.where(valid, found.inverse_range_sigma / inverse**2, torch.inf),
            low=torch.where(valid, found.range_low, torch.nan),
            high=torch.where(valid, found.range_high, torch.nan),
            valid=valid,
        )
        return RangeImage(*(value.detach() for value in found))
