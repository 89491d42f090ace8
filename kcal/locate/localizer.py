"""`StereoLocalizer`: a module from a detector's pixels to positions on the Earth with their errors."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from kcal.checks import as_covariance, expanded, exportable, scalar
from kcal.dispatch import is_differentiated
from kcal.errors import InputError
from kcal.io.rig_file import load_rig
from kcal.lens.pose import Movable, rotation_from_vector
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, Origin, Rig, RigCovariance, check_refraction
from kcal.locate.geodesy import anchor, enu_from_cam, mean_radius, place_enu
from kcal.locate.max_likelihood import by_pose, calibration_effect, inverse_variance, position_slope, symmetric
from kcal.locate.mounting import attitude, by_mounting
from kcal.locate.stereo import (
    PositionStatus,
    checked_pair_covariance,
    checked_pairs,
    checked_rig,
    piece_by_piece,
    range_where_ok,
    reprojection_errors,
    status_counts,
)
from kcal.locate.views import ViewsFit, fit_pairs, reach_of
from kcal.operation import Operations, shapes_of
from kcal.texts import brief


@exportable
class Localization(NamedTuple):
    """Result of `StereoLocalizer`; nothing in it is NaN, whatever went in. Look at `status` before anything else.

    Attributes:
        enu: (..., N, 3) meters east, north, up of the left camera; zeros unless the status is OK.
        covariance: (..., N, 3, 3) of `enu`, to first order; an infinite diagonal unless OK. At long range a position
            is skewed along the line of sight: quote the range interval.
        geodetic: (..., N, 3) latitude, longitude (degrees), ellipsoidal WGS84 height (meters); the origin unless OK.
        range_low: (..., N) meters from the left camera, lower end of the 95 % interval.
        range_high: (..., N) upper end, infinite where the point may be at infinity. The interval is 0 to infinity
            where nothing is known, infinite at both ends where the rays diverge by more than the noise explains.
        status: (..., N) int8, codes of `PositionStatus`. BEARING_ONLY: the parallax is below three of its sigmas, so
            that a range would be noise; PARALLEL: it is not positive. Both have a bearing and an interval.
        bearing: (..., N, 3) unit vector east, north, up; zeros where nothing is known.
        inverse_range: (..., N) one over meters; negative where the rays diverge. Unlike the range its errors are
            Gaussian at any distance: the quantity for losses and filters.
        inverse_range_sigma: (..., N) its standard deviation; zero where nothing is known.
        reprojection: (..., N, 2) distance in px between mark and reprojected point, left and right.
    """

    enu: Tensor
    covariance: Tensor
    geodetic: Tensor
    range_low: Tensor
    range_high: Tensor
    status: Tensor
    bearing: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    reprojection: Tensor

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))

    @property
    def range(self) -> Tensor:
        """(..., N) meters from the left camera; infinite unless the status is OK."""
        return range_where_ok(self.status, self.inverse_range)


class Sensitivity(NamedTuple):
    """Slopes of the range, infinite where there is no range; at long range they are valid for small errors only.

    Attributes:
        meters_per_pixel: (..., N) by a shift of one of the two marks in its worst direction.
        meters_per_degree: (..., N) by a turn of the right camera about its worst axis: relative yaw, for a rig whose
            cameras stand side by side.
    """

    meters_per_pixel: Tensor
    meters_per_degree: Tensor


class StereoLocalizer(Operations, Movable):
    """Locate matched pixels of a calibrated rig on the Earth, with an error bar.

    Pixels are triangulated in closed form, refined to the maximum-likelihood position (Gauss-Newton on reprojection
    errors, weighed by the pixels' covariances), and carried with their covariance to east, north, up and to WGS84.
    Geometry runs in float64 whatever the pipeline around it uses. There is no branch on values under `torch.compile`
    and `torch.export`; gradients by pixels, covariances, cameras, poses and errors are exact and finite.
    `free("origin")` and `free("attitude")` let them reach the mounting, as `Rig.free` the rig's pose.

    The covariance of a position is the sum of four parts: noise in the marks, errors in the calibration
    (`calibration`, a joint covariance of cameras and rig), errors in the mounting (`mounting`) and, upward, what is not
    known of refraction, together with the mounting where both come from the same landmarks. All but the noise move
    neighboring points together, so that averaging over frames does not reduce them.

    Light bends downward: a point at the level distance d is k d² / 2R lower than a straight line of sight says, with R
    the Earth's radius and k the coefficient of refraction: 0.26 ± 0.20 m at 5 km, 0.01 m at 1 km.

    Args:
        rig: two cameras and their relative pose. What is not given below is taken from the rig where it knows it.
        origin: position of the left camera's projection center; with `heading_deg`, or neither: `rig.mounting`.
        heading_deg: of the left camera's axis, clockwise from true north; see `enu_from_cam`.
        pitch_deg: of the same axis, positive up.
        roll_deg: of the left camera, positive clockwise as seen from behind.
        pixel_sigma: standard deviation of a mark along each axis, px, where no covariance is given.
        calibration: how well the rig is known; `rig.covariance` if left out, and exact if that is None.
        mounting: (6, 6) of `mounting_covariance`, or (7, 7) of `Mounting`; if left out, that of `rig.mounting`, and
            exact for an `origin` that is given.
        link: (P, 6) or (P, 7) covariance of the calibration with the mounting, where both come from the same landmarks;
            that of `rig.mounting` if all of origin, calibration and mounting come from the rig.
        refraction: k, bending of light as a share of the Earth's curvature; if left out, that of the landmarks of
            `rig.mounting`, and 0.13 where there were none. For simulations and other straight lines it and its sigma
            are 0.
        refraction_sigma: standard deviation of k; if left out, as it comes with the mounting, and 0.1 otherwise, which
            suits lines of sight some ten meters above the ground; near hot or cold ground 0.5 and more are usual. Where
            `refraction` or its sigma is given, as for another day, landmarks say nothing of it.

    Raises:
        InputError: an angle, sigma or covariance that cannot be, or a rig that does not say where it stands.
        DegenerateError: a rig without a baseline.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> localize = StereoLocalizer(rig, origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0,
        ...                            pixel_sigma=0.1)
        >>> left, right = torch.tensor([[960.0, 540.0]]), torch.tensor([[944.0, 540.0]])
        >>> found = localize(left, right)
        >>> [round(value, 2) for value in found.enu[0].tolist()], round(found.covariance[0, 1, 1].sqrt().item(), 2)
        ([0.0, 1000.0, -0.01], 8.84)
        >>> round(found.range_low.item(), 1), round(found.range_high.item(), 1), PositionStatus(int(found.status)).name
        (983.0, 1017.6, 'OK')
    """

    pixel_sigma: Tensor
    refraction: Tensor
    half_curvature: Tensor
    ecef_from_enu: Tensor
    ecef_of_origin: Tensor
    geodetic_of_origin: Tensor
    results = shapes_of(
        Localization, enu=(3,), covariance=(3, 3), geodetic=(3,), status=torch.int8, bearing=(3,), reprojection=(2,)
    )
    calibration_factor: Tensor | None
    mounting: Tensor | None
    link: Tensor | None

    def __init__(
        self,
        rig: Rig,
        *,
        origin: Origin | None = None,
        heading_deg: float | None = None,
        pitch_deg: float = 0.0,
        roll_deg: float = 0.0,
        pixel_sigma: float = 0.3,
        calibration: RigCovariance | None = None,
        mounting: Tensor | None = None,
        link: Tensor | None = None,
        refraction: float | None = None,
        refraction_sigma: float | None = None,
    ) -> None:
        super().__init__()
        place = rig.right_from_left_translation
        self.register_buffer("pixel_sigma", scalar(checked_rig(rig, pixel_sigma), place))
        stored, own = rig.covariance, refraction is not None or refraction_sigma is not None
        bending = (
            REFRACTION if refraction is None else refraction,
            REFRACTION_SIGMA if refraction_sigma is None else refraction_sigma,
        )
        check_refraction(*bending)
        if origin is None or heading_deg is None:
            if origin is not None or heading_deg is not None or pitch_deg or roll_deg:
                raise InputError("origin and heading_deg belong together, and pitch_deg and roll_deg to them")
            stands = rig.mounting
            if stands is None:
                raise InputError("this rig does not say where it stands; give origin and heading_deg")
            origin, heading_deg, pitch_deg, roll_deg = (
                stands.origin, stands.heading_deg, stands.pitch_deg, stands.roll_deg,
            )  # fmt: skip
            if not own and stands.refraction is not None:
                bending = (stands.refraction, bending[1])
            if mounting is None:
                mounting = stands.covariance
                link = stands.link if link is None and calibration is None else link
        calibration = stored if calibration is None else calibration
        self.rig = rig
        errors = (("marks", True), ("calibration", calibration is not None), ("mounting", mounting is not None))
        self.included = tuple(name for name, there in errors if there)
        device = place.device
        self.register_buffer("refraction", scalar(bending[0], place))
        self.register_buffer("half_curvature", scalar(0.5 / mean_radius(origin.lat), place))
        rotation, translation = anchor(origin, device)
        self._keep("enu_from_rig", enu_from_cam(heading_deg, pitch_deg, roll_deg).to(device))
        self.register_buffer("ecef_from_enu", rotation)
        self.register_buffer("ecef_of_origin", translation)
        self.register_buffer("geodetic_of_origin", origin.geodetic.to(device))
        factor = None
        if calibration is not None:
            calibration.check(rig)
            factor = calibration.half.T.to(device) if bool(calibration.half.any()) else None
        self.register_buffer("calibration_factor", factor)
        if link is not None:
            if calibration is None or mounting is None:
                raise InputError("link: it needs the covariances of both the calibration and the mounting")
            link = calibration.checked_link(mounting, link)
        if mounting is None and bending[1]:
            mounting = torch.zeros(6, 6, dtype=torch.float64)
        if mounting is not None:
            mounting = as_covariance("mounting", mounting, 7 if mounting.shape[-1:] == (7,) else 6)
            if own or len(mounting) == 6:
                mounting = torch.block_diag(mounting[:6, :6], torch.tensor([[bending[1] ** 2]], dtype=torch.float64))
                link = None if link is None else torch.nn.functional.pad(link[:, :6], (0, 1))
            mounting = mounting.to(device)
        self.register_buffer("mounting", mounting)
        self.register_buffer("link", None if link is None else link.to(device))

    @property
    def enu_from_rig(self) -> Tensor:
        """(3, 3) how the left camera looks, with the step of `free`."""
        kept, step = self._kept("enu_from_rig"), self.freed_step
        return kept if step is None else rotation_from_vector(step[1]) @ kept

    @property
    def origin(self) -> Origin:
        """Position of the left camera's projection center."""
        step, place = self.freed_step, self.geodetic_of_origin
        return Origin.at(place if step is None else place_enu(step[0], self.ecef_from_enu, self.ecef_of_origin))

    @property
    def attitude_deg(self) -> tuple[float, float, float]:
        """Heading, pitch and roll of the left camera."""
        heading, pitch, roll = (round(angle, 11) for angle in attitude(self.enu_from_rig))
        return heading, pitch, roll

    @property
    def pose_slots(self) -> dict[str, Any]:
        """What `free` takes: `mounting`, or `origin` and `attitude`; the step is that of `Mounting.covariance`."""
        return {"mounting": slice(0, 6), "origin": slice(0, 3), "attitude": slice(3, 6)}

    def _zero_step(self) -> Tensor:
        return torch.zeros_like(self.ecef_of_origin).repeat(2)

    @classmethod
    def from_file(cls, path: str | Path, **options: Any) -> Self:
        """Read a rig file; `options` are those of the class, and replace what the file says.

        Raises:
            FileError: see `kcal.load_rig`.

        Example:
            >>> import tempfile
            >>> from kcal import save_rig
            >>> from kcal.rig import Mounting, planned_rig
            >>> rig = planned_rig()
            >>> rig.mounting = Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     localize = StereoLocalizer.from_file(save_rig(rig, Path(folder, "rig.json")), pixel_sigma=0.1)
            >>> found = localize(torch.tensor([[959.5, 539.5]]), torch.tensor([[943.5, 539.5]]))
            >>> [round(value, 2) for value in found.enu[0].tolist()]
            [0.0, 1000.0, -0.01]
        """
        return cls(load_rig(path), **options)

    def forward(
        self, pixels_left: Tensor, pixels_right: Tensor, cov: Tensor | None = None, mask: Tensor | None = None
    ) -> Localization:
        """Locate pixel pairs.

        Args:
            pixels_left: (..., N, 2), integer coordinates at pixel centers.
            pixels_right: (..., N, 2), the same things in the right image.
            cov: covariance of (u_left, v_left, u_right, v_right), (..., N, 4, 4) or broadcastable to it;
                `pixel_sigma` squared times the identity if left out.
            mask: (..., N) bool; what is False is MASKED, and neither read nor differentiated.

        Raises:
            InputError: not floating point, or shapes that are wrong or unlike.
        """
        left, right = checked_pairs(pixels_left, pixels_right, self.rig)
        cov = checked_pair_covariance(cov, left)
        if mask is not None:
            mask = torch.as_tensor(mask, device=left.device)
            if mask.dtype != torch.bool:
                raise InputError(f"mask: bool is needed, got {mask.dtype}")
            mask = expanded("mask", mask, left.shape[:-1])
        if found := self.as_operation("forward", left, right, cov, mask):
            return Localization(*found)
        differentiated = is_differentiated(left, right, cov, self)

        def locate(left: Tensor, right: Tensor, cov: Tensor | None, mask: Tensor | None) -> Localization:
            by_camera = self.calibration_factor is not None
            return self._on_earth(
                fit_pairs(
                    self.rig, left, right, cov, mask, noise=self.pixel_sigma, by_camera=by_camera,
                    differentiated=differentiated,
                )
            )  # fmt: skip

        return piece_by_piece(locate, left, right, cov, mask, differentiated=differentiated)

    def _on_earth(self, found: ViewsFit) -> Localization:
        """Positions and all their errors."""
        fit, scale, usable = found.fit, found.scale, found.fitted
        spread = [found.variance * entry for entry in fit.covariance]
        if self.calibration_factor is not None:
            factors = [self.calibration_factor, *([] if self.link is None else [self.link])]
            effect = calibration_effect(fit, scale, torch.cat(factors, 1))  # (..., 3, K, N)
            moved, by_link = effect.tensor_split([self.calibration_factor.shape[1]], -2)
            for number, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
                spread[number] = spread[number] + (moved[..., i, :, :] * moved[..., j, :, :]).sum(-2)
        reach = reach_of(found, inverse_variance(fit, spread), PositionStatus.BEARING_ONLY)
        ok = reach.status == int(PositionStatus.OK)
        there = usable | (reach.status == int(PositionStatus.PARALLEL))
        bearing = (fit.direction / found.length[..., None, :]).mT @ self.enu_from_rig.mT
        depth = scale / torch.where(ok, fit.inverse, 1.0)
        enu = torch.where(ok[..., None], depth[..., None] * (fit.direction.mT @ self.enu_from_rig.mT), 0.0)
        slope = self.enu_from_rig @ position_slope(fit, scale, ok)
        covariance = slope @ symmetric(spread) @ slope.mT
        up = torch.stack([*torch.zeros_like(enu[..., :2]).unbind(-1), enu[..., :2].square().sum(-1)], -1)
        enu = enu - self.refraction * self.half_curvature * up
        if self.mounting is not None:
            turn = torch.cat([by_mounting(enu), -self.half_curvature * up[..., None]], -1)
            covariance = covariance + turn @ self.mounting @ turn.mT
            if self.link is not None and self.calibration_factor is not None:
                mixed = slope @ by_link.movedim(-1, -3) @ turn.mT
                covariance = covariance + mixed + mixed.mT
        covariance = torch.where(ok[..., None, None], covariance, torch.diag(covariance.new_full((3,), math.inf)))
        step = self.freed_step
        shifted = enu if step is None else enu + step[0]
        geodetic = place_enu(shifted, self.ecef_from_enu, self.ecef_of_origin)
        return Localization(
            enu=enu,
            covariance=covariance,
            geodetic=torch.where(ok[..., None], geodetic, self.geodetic_of_origin),
            range_low=reach.interval.low,
            range_high=reach.interval.high,
            status=reach.status,
            bearing=torch.where(there[..., None], bearing, 0.0),
            inverse_range=reach.value,
            inverse_range_sigma=reach.sigma,
            reprojection=reprojection_errors(fit.residual),
        )

    def extra_repr(self) -> str:
        """Where it stands, and which errors its covariances contain, for `repr`."""
        heading, pitch, roll = self.attitude_deg
        return (
            f"{self.origin}, heading={heading:.6g}°, pitch={pitch:.6g}°, roll={roll:.6g}°, "
            f"pixel_sigma={self.pixel_sigma:g}, errors of {' and '.join(self.included)}"
        )

    @torch.no_grad()
    def sensitivity(self, pixels_left: Tensor, pixels_right: Tensor) -> Sensitivity:
        """How far the range moves by one pixel of a mark and by one degree of the rig; see `Sensitivity`.

        Args:
            pixels_left: (..., N, 2).
            pixels_right: (..., N, 2).
        """
        return _sensitivity(fit_pairs(self.rig, *checked_pairs(pixels_left, pixels_right, self.rig)))

    def with_sensitivity(self, pixels_left: Tensor, pixels_right: Tensor) -> tuple[Localization, Sensitivity]:
        """`forward` and `sensitivity` for the work of one; without covariances, masks and derivatives.

        Args:
            pixels_left: (..., N, 2); in one piece, so give some ten thousand at once.
            pixels_right: (..., N, 2).
        """
        by_camera = self.calibration_factor is not None
        pairs = checked_pairs(pixels_left, pixels_right, self.rig)
        found = fit_pairs(self.rig, *pairs, noise=self.pixel_sigma, by_camera=by_camera)
        return self._on_earth(found), _sensitivity(found)


def _sensitivity(found: ViewsFit) -> Sensitivity:
    fit, scale, usable = found.fit, found.scale, found.fitted
    known = usable & (fit.inverse > 0)
    inverse = torch.where(known, fit.inverse, 1.0)
    # d range = -range dρ / ρ
    slope = scale * found.length / (inverse * inverse)
    by_mark = fit.gain[..., 2, :, :]
    by_side = by_mark.unflatten(-2, (2, 2)).square().sum(-2).sqrt()
    turn = (by_mark[..., None, 2:, :] * by_pose(fit, 1)[..., :3, :, :]).sum(-2)
    return Sensitivity(
        torch.where(known, slope * by_side.amax(-2), math.inf),
        torch.where(known, slope * turn.square().sum(-2).sqrt() * math.radians(1.0), math.inf),
    )
