"""`StereoLocalizer`: a detector's pixels in, positions on the Earth and their errors out, one module."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from kcal.checks import as_covariance, as_points, keep_float64
from kcal.errors import DegenerateError, InputError
from kcal.io.rig_file import load_rig
from kcal.lens.mounting import Origin
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.lens.tracing import CHUNK, is_differentiated, is_traced, known_true
from kcal.locate.ellipsoid import mean_radius
from kcal.locate.geodesy import anchor, enu_from_cam, place_enu
from kcal.locate.max_likelihood import Fit, Sight, by_pose, calibration_effect, inverse_covariances, refine
from kcal.locate.mounting import by_mounting
from kcal.locate.ranges import BEARING_SIGMAS, QUANTILE
from kcal.locate.stereo import Status, sight_lines


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
        status: (..., N) int8, codes of `Status`. BEARING_ONLY: the parallax is below three of its sigmas, so that a
            range would be noise; PARALLEL: it is not positive. Both have a bearing and an interval.
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


class Sensitivity(NamedTuple):
    """Slopes of the range, infinite where there is none; at long range they hold for small errors only.

    Attributes:
        meters_per_pixel: (..., N) by a shift of one of the two marks in its worst direction.
        meters_per_degree: (..., N) by a turn of the right camera about its worst axis: relative yaw, for a rig whose
            cameras stand side by side.
    """

    meters_per_pixel: Tensor
    meters_per_degree: Tensor


class StereoLocalizer(nn.Module):
    """Locate matched pixels of a calibrated rig on the Earth, with an error bar.

    Pixels are triangulated in closed form, refined to the maximum-likelihood position (Gauss-Newton on reprojection
    errors, weighed by the pixels' covariances), and carried with their covariance to east, north, up and to WGS84.
    Geometry runs in float64 whatever the pipeline around it uses. There is no branch on values under `torch.compile`
    and `torch.export`; gradients by pixels, covariances and freed camera parameters are exact and finite.

    Covariances: the marks' noise, the calibration (`calibration`, a joint covariance of cameras and rig) and the
    mounting (`mounting`) are added up. What the calibration does to several points it does to them together: errors
    of neighboring points are not independent, and averaging over frames does not reduce them.

    Args:
        rig: two cameras and their relative pose. What is not given below is taken from the rig where it knows it.
        origin: position of the left camera's projection center; with `heading_deg`, or neither: `rig.mounting`.
        heading_deg: of the left camera's axis, clockwise from true north; see `enu_from_cam`.
        pitch_deg: of the same axis, positive up.
        roll_deg: of the left camera, positive clockwise as seen from behind.
        pixel_sigma: standard deviation of a mark along each axis, px, where no covariance is given.
        calibration: how well the rig is known; `rig.covariance` if left out, and exact if that is None.
        mounting: (6, 6) of `mounting_covariance`; if left out, that of `rig.mounting`, and exact for an `origin` that
            is given.
        link: (P, 6) covariance of the calibration with the mounting, where both come from the same landmarks; that of
            `rig.mounting` if all of origin, calibration and mounting come from the rig.
        refraction: bending of light as a share of the Earth's curvature, 0.13 in standard air; 0: straight lines.

    Raises:
        InputError: an angle, sigma or covariance that cannot be, or a rig that does not say where it stands.
        DegenerateError: a rig without a baseline.

    Example:
        >>> from kcal.lens.camera import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> localize = StereoLocalizer(rig, origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0,
        ...                            pixel_sigma=0.1)
        >>> left, right = torch.tensor([[960.0, 540.0]]), torch.tensor([[944.0, 540.0]])
        >>> found = localize(left, right)
        >>> [round(value, 1) for value in found.enu[0].tolist()], round(found.covariance[0, 1, 1].sqrt().item(), 2)
        ([0.0, 1000.0, 0.0], 8.84)
        >>> round(found.range_low.item(), 1), round(found.range_high.item(), 1), Status(int(found.status)).name
        (983.0, 1017.6, 'OK')
    """

    enu_from_rig: Tensor
    ecef_from_enu: Tensor
    ecef_of_origin: Tensor
    geodetic_of_origin: Tensor
    calibration_factor: Tensor | None
    mounting: Tensor | None
    link: Tensor | None

    def __init__(
        self,
        rig: StereoRig,
        *,
        origin: Origin | None = None,
        heading_deg: float | None = None,
        pitch_deg: float = 0.0,
        roll_deg: float = 0.0,
        pixel_sigma: float = 0.3,
        calibration: RigCovariance | None = None,
        mounting: Tensor | None = None,
        link: Tensor | None = None,
        refraction: float = 0.0,
    ) -> None:
        super().__init__()
        if not 0 < pixel_sigma < math.inf:
            raise InputError(f"pixel_sigma: a positive number of pixels is needed, got {pixel_sigma}")
        if not -2.0 <= refraction <= 2.0:
            raise InputError(f"refraction {refraction}: a coefficient such as 0.13 is needed, not beyond ±2")
        if not float(rig.baseline) > 0:
            raise DegenerateError("the rig's cameras stand in the same place: no range can be measured")
        stored = rig.covariance
        if origin is None or heading_deg is None:
            if origin is not None or heading_deg is not None or pitch_deg or roll_deg:
                raise InputError("origin and heading_deg belong together, and pitch_deg and roll_deg to them")
            stands = rig.mounting
            if stands is None:
                raise InputError("this rig does not say where it stands; give origin and heading_deg")
            origin, heading_deg, pitch_deg, roll_deg = (
                stands.origin, stands.heading_deg, stands.pitch_deg, stands.roll_deg,
            )  # fmt: skip
            if mounting is None:
                mounting = stands.covariance
                link = stands.link if link is None and calibration is None else link
        calibration = stored if calibration is None else calibration
        self.rig = rig
        self.origin = origin
        self.attitude_deg = (heading_deg, pitch_deg, roll_deg)
        errors = (("marks", True), ("calibration", calibration is not None), ("mounting", mounting is not None))
        self.included = tuple(name for name, there in errors if there)
        self.pixel_sigma = float(pixel_sigma)
        self.drop = refraction / (2.0 * mean_radius(origin.lat))
        device = rig.right_from_left_rotation.device
        rotation, translation = anchor(origin, device)
        self.register_buffer("enu_from_rig", enu_from_cam(heading_deg, pitch_deg, roll_deg).to(device))
        self.register_buffer("ecef_from_enu", rotation)
        self.register_buffer("ecef_of_origin", translation)
        self.register_buffer("geodetic_of_origin", origin.geodetic.to(device))
        factor = None
        if calibration is not None:
            known = RigCovariance.of(rig, joint=calibration.matrix).factor()
            factor = known.to(device) if known.shape[1] else None
        self.register_buffer("calibration_factor", factor)
        standing = None if mounting is None else as_covariance("mounting", mounting, 6).to(device)
        self.register_buffer("mounting", standing)
        if link is not None:
            if calibration is None or mounting is None:
                raise InputError("link: it needs the covariances of both the calibration and the mounting")
            link = calibration.checked_link(mounting, link).to(device)
        self.register_buffer("link", link)

    @classmethod
    def from_file(cls, path: str | Path, **options: Any) -> Self:
        """Read a rig file; `options` are those of the class, and replace what the file tells.

        Raises:
            FileError: see `kcal.load_rig`.

        Example:
            >>> import tempfile
            >>> from kcal.io.rig_file import save_rig
            >>> from kcal.lens.mounting import Mounting
            >>> from kcal.locate.budget import planned_rig
            >>> rig = planned_rig()
            >>> rig.mounting = Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     localize = StereoLocalizer.from_file(save_rig(rig, Path(folder, "rig.json")), pixel_sigma=0.1)
            >>> found = localize(torch.tensor([[959.5, 539.5]]), torch.tensor([[943.5, 539.5]]))
            >>> [round(value, 1) for value in found.enu[0].tolist()]
            [0.0, 1000.0, 0.0]
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
        left, right = _checked_pairs(pixels_left, pixels_right)
        if cov is not None:
            cov = as_points("cov", cov, 4)
            if cov.ndim < 2 or cov.shape[-2] != 4:
                raise InputError(f"cov: shape (..., N, 4, 4) is needed, got {tuple(cov.shape)}")
            cov = cov.expand(*left.shape[:-1], 4, 4)
        if mask is not None:
            if mask.dtype != torch.bool:
                raise InputError(f"mask: bool is needed, got {mask.dtype}")
            mask = mask.expand(left.shape[:-1])
        tensors = [left, right, *(value for value in (cov,) if value is not None), *self.parameters()]
        differentiated = is_differentiated(*tensors)
        count = left.shape[-2]
        size = max(1, CHUNK // max(1, math.prod(left.shape[:-2])))
        if is_traced() or differentiated or count <= size:
            return self._locate(left, right, cov, mask, differentiated)
        pieces = []
        for first in range(0, count, size):
            part = slice(first, first + size)
            pieces.append(
                self._locate(
                    left[..., part, :], right[..., part, :], None if cov is None else cov[..., part, :, :],
                    None if mask is None else mask[..., part], False,
                )
            )  # fmt: skip
        axis = left.ndim - 2
        return Localization(*(torch.cat(values, axis) for values in zip(*pieces, strict=True)))

    def _locate(
        self, left: Tensor, right: Tensor, cov: Tensor | None, mask: Tensor | None, differentiated: bool
    ) -> Localization:
        return self._errors(*self._fit(left, right, cov, mask, differentiated), plain=cov is None)

    def _fit(
        self, left: Tensor, right: Tensor, cov: Tensor | None, mask: Tensor | None, differentiated: bool
    ) -> tuple[Fit, Tensor, Tensor, Tensor]:
        """The optimum, the unit of its ρ, the statuses so far, and which points have an optimum."""
        finite = torch.isfinite(left + right).all(-1)
        wanted = finite if mask is None else finite & mask
        if not known_true(wanted):
            left = torch.where(wanted[..., None], left, self.rig.left.center.detach())
            right = torch.where(wanted[..., None], right, self.rig.right.center.detach())
        with torch.no_grad():
            lines = sight_lines(self.rig, left, right)
            weight, sound = inverse_covariances(cov)
            code = lines.status
            reasons = [(~sound, Status.BAD_COVARIANCE), (~finite, Status.NOT_FINITE)]
            reasons += [] if mask is None else [(~mask, Status.MASKED)]
            for condition, status in reasons:
                code = torch.where(condition, code.new_full((), int(status)), code)
            met = code == int(Status.OK)
            usable = met | ((code == int(Status.PARALLEL)) & ~lines.pair.along_baseline)
            scale = self.rig.baseline.detach()
            distance = torch.linalg.vector_norm(lines.points, dim=-1)
            distance = torch.where(met, distance, 1.0)
            ahead = torch.where(met[..., None], lines.points / distance[..., None], lines.rays_left)
            start = torch.where(met, scale / distance, 0.0)
        if differentiated and cov is not None:
            weight, _ = inverse_covariances(cov)
        fit = refine(
            self._sights(), scale, (ahead, start), torch.cat([left, right], -1).mT, usable, weight,
            by_camera=self.calibration_factor is not None, differentiated=differentiated,
        )  # fmt: skip
        return fit, scale, code, usable

    def _sights(self) -> tuple[Sight, Sight]:
        rotation, translation = self.rig.right_from_left_rotation, self.rig.right_from_left_translation
        still = torch.eye(3, dtype=torch.float64, device=rotation.device)
        return Sight(self.rig.left, still, torch.zeros_like(translation)), Sight(self.rig.right, rotation, translation)

    def _errors(self, fit: Fit, scale: Tensor, code: Tensor, usable: Tensor, *, plain: bool) -> Localization:
        unit = self.pixel_sigma**2 if plain else 1.0
        spread = [unit * entry for entry in fit.covariance]
        if self.calibration_factor is not None:
            effect = calibration_effect(fit, scale)  # (..., N, 3, P)
            moved = effect @ self.calibration_factor  # (..., N, 3, K)
            for number, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
                spread[number] = spread[number] + (moved[..., i, :] * moved[..., j, :]).sum(-1)

        length = torch.linalg.vector_norm(fit.direction, dim=-2)
        inverse_range = torch.where(usable, fit.inverse / (scale * length), 0.0)
        with torch.no_grad():
            known = torch.isfinite(spread[5]) & (spread[5] > 0) & usable
        sigma = torch.sqrt(torch.where(known, spread[5], 1.0)) / (scale * length)
        sigma = torch.where(known, sigma, 0.0)
        with torch.no_grad():
            weak = usable & (~known | (inverse_range < BEARING_SIGMAS * sigma))
            lost = usable & ~(inverse_range > 0)
            code = torch.where(weak & (code == int(Status.OK)), code.new_full((), int(Status.BEARING_ONLY)), code)
            code = torch.where(lost, code.new_full((), int(Status.PARALLEL)), code)
            # What the closed form put at infinity may have come back in front of the rig.
            back = usable & ~lost & ~weak
            code = torch.where(back, code.new_full((), int(Status.OK)), code)
            ok = code == int(Status.OK)

        bearing = (fit.direction / length[..., None, :]).mT @ self.enu_from_rig.mT
        depth = scale / torch.where(ok, fit.inverse, 1.0)
        enu = torch.where(ok[..., None], depth[..., None] * (fit.direction.mT @ self.enu_from_rig.mT), 0.0)
        sides = (self.enu_from_rig @ fit.sides).movedim(-3, -1)  # (..., 3, N, 2)
        by_unknown = depth[..., None, :, None] * torch.cat(
            [sides, -(enu / scale).mT[..., None]], -1
        )  # (..., 3, N, 3): of enu by a, b and ρ
        p, q, r, s, t, u = (entry[..., None, :] for entry in spread)
        a, b, c = by_unknown.unbind(-1)
        half = torch.stack([a * p + b * q + c * r, a * q + b * s + c * t, a * r + b * t + c * u], -1)
        covariance = half.movedim(-3, -2) @ by_unknown.movedim(-3, -2).mT
        if self.drop:
            level = enu[..., :2]
            enu = torch.cat([level, enu[..., 2:] - self.drop * (level * level).sum(-1, keepdim=True)], -1)
        if self.mounting is not None:
            turn = by_mounting(enu)
            covariance = covariance + turn @ self.mounting @ turn.mT
            if self.link is not None and self.calibration_factor is not None:
                mixed = by_unknown.movedim(-3, -2) @ (effect @ self.link) @ turn.mT
                covariance = covariance + mixed + mixed.mT
        covariance = torch.where(ok[..., None, None], covariance, torch.diag(covariance.new_full((3,), math.inf)))
        geodetic = place_enu(enu, self.ecef_from_enu, self.ecef_of_origin)
        return Localization(
            enu=enu,
            covariance=covariance,
            geodetic=torch.where(ok[..., None], geodetic, self.geodetic_of_origin),
            range_low=_reach(inverse_range + QUANTILE * sigma, known, usable, 0.0),
            range_high=_reach(inverse_range - QUANTILE * sigma, known, usable, math.inf),
            status=code,
            bearing=torch.where((usable | (code == int(Status.PARALLEL)))[..., None], bearing, 0.0),
            inverse_range=inverse_range,
            inverse_range_sigma=sigma,
            reprojection=_lengths(fit.residual),
        )

    @torch.no_grad()
    def sensitivity(self, pixels_left: Tensor, pixels_right: Tensor) -> Sensitivity:
        """How far the range moves by one pixel of a mark and by one degree of the rig; see `Sensitivity`.

        Args:
            pixels_left: (..., N, 2).
            pixels_right: (..., N, 2).
        """
        left, right = _checked_pairs(pixels_left, pixels_right)
        fit, scale, _, usable = self._fit(left, right, None, None, False)
        known = usable & (fit.inverse > 0)
        inverse = torch.where(known, fit.inverse, 1.0)
        # d range = -range dρ / ρ
        slope = scale * torch.linalg.vector_norm(fit.direction, dim=-2) / (inverse * inverse)
        by_mark = fit.gain[..., 2, :, :]
        by_side = torch.linalg.vector_norm(by_mark.unflatten(-2, (2, 2)), dim=-2)
        turn = (by_mark[..., None, 2:, :] * by_pose(fit, 1)[..., :3, :, :]).sum(-2)
        return Sensitivity(
            torch.where(known, slope * by_side.amax(-2), math.inf),
            torch.where(known, slope * torch.linalg.vector_norm(turn, dim=-2) * math.radians(1.0), math.inf),
        )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)


def _checked_pairs(pixels_left: Tensor, pixels_right: Tensor) -> tuple[Tensor, Tensor]:
    left, right = as_points("pixels_left", pixels_left, 2), as_points("pixels_right", pixels_right, 2)
    if left.shape != right.shape or left.ndim < 2:
        raise InputError(
            "pixels_left and pixels_right: the same shape (..., N, 2) is needed, "
            f"got {tuple(left.shape)} and {tuple(right.shape)}"
        )
    return left, right


def _reach(inverse: Tensor, known: Tensor, usable: Tensor, otherwise: float) -> Tensor:
    finite = known & (inverse > 0)
    reach = torch.where(finite, 1.0 / torch.where(finite, inverse, 1.0), math.inf)
    return torch.where(known & usable, reach, otherwise)


def _lengths(residual: Tensor) -> Tensor:
    """(..., 4, N) to (..., N, 2), with a gradient of zero where there is no error."""
    squared = residual.unflatten(-2, (2, 2)).square().sum(-2)
    some = squared > 0
    return torch.where(some, torch.sqrt(torch.where(some, squared, 1.0)), 0.0).mT
