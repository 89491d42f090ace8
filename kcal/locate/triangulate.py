"""`Triangulate`: pixel pairs of a stereo rig to points in the rig's own frame, without the Earth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import exportable, scalar
from kcal.dispatch import is_differentiated
from kcal.lens.rig import StereoRig
from kcal.locate.max_likelihood import inverse_variance, position_slope, symmetric
from kcal.locate.stereo import (
    PositionStatus,
    checked_pairs,
    checked_rig,
    fit_pairs,
    inverse_range,
    piece_by_piece,
    range_where_ok,
    reprojection_errors,
    status_counts,
)
from kcal.operation import Operations, shapes_of
from kcal.texts import brief


@exportable
class Triangulation(NamedTuple):
    """Result of `Triangulate`; no tensor contains NaN, whatever went in.

    Attributes:
        points: (..., N, 3) meters in the rig frame (the left camera's); zeros unless the status is OK.
        status: (..., N) int8, codes of `PositionStatus`; never BEARING_ONLY: see `bearing_only`.
        rays: (..., N, 3) unit vectors of the most likely direction from the left camera; its optical axis where the
            lens has no ray.
        reprojection: (..., N, 2) distance in px between mark and reprojected point, left and right; zeros unless OK.
        inverse_range: (..., N) one over meters from the left camera, negative where the rays diverge.
        inverse_range_sigma: (..., N) its standard deviation from the marks' noise; zero where nothing is known.
        range_low: (..., N) meters from the left camera, lower end of the 95 % interval of the marks' noise.
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
    covariance: Tensor = torch.empty(0)  # its place is the last: programs may build this result, or unpack it

    @property
    def range(self) -> Tensor:
        """(..., N) meters from the left camera; infinite unless the status is OK."""
        return range_where_ok(self.status, self.inverse_range)

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))


class Triangulate(Operations):
    """Locate pixel pairs in the rig frame: the positions of `StereoLocalizer`, without the Earth.

    The status of a pair is decided from the two rays before anything is divided: `NOT_FINITE` (NaN or infinite
    pixels), `OUTSIDE_IMAGE` (more than half a pixel outside), `OUTSIDE_LENS` (the lens model has no ray there),
    `BEHIND` (the rays' lines cross behind exactly one camera), `PARALLEL` (parallel or diverging rays: at or beyond
    infinity, or along the baseline), else `OK`. Points near infinity are `OK` with a wide range interval.

    There is no branch on values, so that the module compiles and exports. Geometry runs in float64 whatever the
    pixels' type; derivatives by the pixels are exact and finite, and zero for pairs that are not OK.

    Args:
        rig: two cameras and their relative pose; its covariance is not used.
        pixel_sigma: standard deviation of the marks, px along each axis. Covariance and range interval cover the marks'
            noise only; `StereoLocalizer` adds the errors of the calibration.

    Raises:
        InputError: a `pixel_sigma` that is not positive.
        DegenerateError: a rig without a baseline.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> left = torch.tensor([[960.0, 540.0]], dtype=torch.float64)
        >>> result = Triangulate(rig)(left, left - torch.tensor([3.2, 0.0], dtype=torch.float64))
        >>> round(result.points[0, 2].item(), 3), PositionStatus(int(result.status[0])).name
        (5000.0, 'OK')
    """

    results = shapes_of(
        Triangulation, points=(3,), status=torch.int8, rays=(3,), reprojection=(2,), bearing_only=torch.bool,
        covariance=(3, 3),
    )  # fmt: skip
    pixel_sigma: Tensor

    def __init__(self, rig: StereoRig, pixel_sigma: float = 0.3) -> None:
        super().__init__()
        self.register_buffer("pixel_sigma", scalar(checked_rig(rig, pixel_sigma), rig.right_from_left_translation))
        self.rig = rig

    def forward(self, pixels_left: Tensor, pixels_right: Tensor) -> Triangulation:
        """Triangulate matched pixels, both (..., N, 2), integer coordinates at pixel centers.

        Raises:
            InputError: not floating point, or shapes that are wrong or unlike.
        """
        left, right = checked_pairs(pixels_left, pixels_right, self.rig)
        if found := self.as_operation("forward", left, right):
            return Triangulation(*found)
        differentiated = is_differentiated(left, right, self)

        def triangulate(left: Tensor, right: Tensor) -> Triangulation:
            found = fit_pairs(self.rig, left, right, differentiated=differentiated)
            reach = inverse_range(
                found, self.pixel_sigma**2 * inverse_variance(found.fit, found.fit.covariance), PositionStatus.OK
            )
            ok = reach.status == int(PositionStatus.OK)
            depth = found.scale / torch.where(ok, found.fit.inverse, 1.0)
            slope = position_slope(found.fit, found.scale, ok)
            covariance = self.pixel_sigma**2 * (slope @ symmetric(found.fit.covariance) @ slope.mT)
            unknown = torch.diag(covariance.new_full((3,), torch.inf))
            return Triangulation(
                points=torch.where(ok[..., None], depth[..., None] * found.fit.direction.mT, 0.0),
                status=reach.status,
                rays=(found.fit.direction / found.length[..., None, :]).mT,
                reprojection=torch.where(ok[..., None], reprojection_errors(found.fit.residual), 0.0),
                inverse_range=reach.value,
                inverse_range_sigma=reach.sigma,
                range_low=reach.interval.low,
                range_high=reach.interval.high,
                bearing_only=reach.weak,
                covariance=torch.where(ok[..., None, None], covariance, unknown),
            )

        return piece_by_piece(triangulate, left, right, differentiated=differentiated)
