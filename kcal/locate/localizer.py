"""`Localizer`: a module from pixels to positions on the Earth, or in the rig's own frame, with their errors."""

from __future__ import annotations

import copy
import math
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

import kcal.locate.stereo as stereo
import kcal.locate.views as viewing
from kcal.checks import StatedModule, as_points, as_tensor, chi2_quantile, expanded, scalar
from kcal.dispatch import is_differentiated, is_traced, known_true
from kcal.errors import InputError
from kcal.io.rig_file import load_rig
from kcal.lens.calibration import noise_of_marks
from kcal.lens.camera_like import check_single
from kcal.lens.pose import Movable, rotation_from_vector
from kcal.lens.rig import Origin, Rig
from kcal.locate.geodesy import anchor, ecef_from_enu_rotation, enu_to_geodetic, mean_radius, place_enu
from kcal.locate.ground import EarthFrame, Ground, stated_ahead
from kcal.locate.max_likelihood import by_pose, calibration_effect, inverse_variance, position_slope, symmetric
from kcal.locate.mounting import attitude, by_mounting, leveled, station_mounting
from kcal.locate.stereo import Localization, PositionStatus, Sensitivity
from kcal.locate.views import CommonErrors, PosedCameras
from kcal.operation import Operations, shapes_of

Weights = Literal["marks", "all"]
# How seldom good views are taken for bad ones.
_BAD, _DOUBTFUL = 1e-4, 1e-2
# Sigma of a height, whether there are derivatives, and the ground.
_Options: TypeAlias = "tuple[float, bool, Ground | None]"


class Localizer(Operations, Movable, StatedModule):
    """Locate what two or more cameras of a calibrated rig saw, with an error bar.

    A point is the most likely one (Gauss-Newton on reprojection errors). What weighs its pixels is an option:

    * `marks`, the default of two cameras in the left one's frame: the pixels' covariances alone. Errors in the
      calibration, in the mounting and in refraction are added to the covariance. A pair counts as a whole.
    * `all`, the default of any other rig: also the errors that a camera's pixels share, which are lens, position,
      attitude and refraction, and clocks. Any views of a point count: two give a position, one gives a
      bearing, or a position where the height is stated. With three or more, one that contradicts the others is left
      out and named.

    Only the noise differs from point to point; all other errors move neighboring points together, so that averaging
    over frames does not reduce them.

    A rig that says where it stands gives positions on the Earth: east, north, up of the origin, and WGS84. Otherwise
    they are in the rig's own frame, which is the left camera's for two cameras.

    Light bends downward: a point at the horizontal distance d is k d² / 2R lower than a straight line of sight says,
    with R the Earth's radius and k the coefficient of refraction: 0.26 ± 0.20 m at 5 km, 0.01 m at 1 km. With all
    weights, it bends at each camera about that one's vertical.

    Geometry runs in float64 whatever the pipeline around it uses. There is no branch on values under `torch.compile`,
    `torch.export` and `vmap`: bad views are then sought once, and one is found; otherwise again until two are left.
    Gradients by pixels, covariances, velocities, heights, cameras, poses and errors are exact and finite; those of what
    one camera and a stated height locate are good to 1e-4, and its error bars have none. `free("origin")` and
    `free("attitude")` let gradients reach the mounting of two cameras, as `Rig.free` the poses.

    Args:
        rig: cameras, their poses, and what is known of them: `Rig.root`. `Rig.placed` puts two cameras elsewhere, or
            into other light.
        weights: see above.
        pixel_sigma: standard deviation of a mark along each axis, px, where no covariance is given. If left out: what
            the rig's calibration states, as files of kcal do, otherwise 0.3.
        clock_sigma: standard deviation of each camera's clock, seconds; counts where `forward` is told velocities.
        root: (K, P) like `rig.root`, in its place: for example `rig.with_errors(...)`.

    Raises:
        InputError: a sigma or root that cannot be, or weights that do not suit the rig.
        DegenerateError: weights by marks alone of a rig without a baseline.

    Example:
        >>> from kcal import Camera
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> there = rig.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
        >>> localize = Localizer(there, pixel_sigma=0.1)
        >>> left, right = torch.tensor([[960.0, 540.0]]), torch.tensor([[944.0, 540.0]])
        >>> found = localize(left, right)
        >>> [round(value, 2) for value in found.enu[0].tolist()], round(found.covariance[0, 1, 1].sqrt().item(), 2)
        ([0.0, 1000.0, -0.01], 8.84)
        >>> round(found.range_low.item(), 1), round(found.range_high.item(), 1), PositionStatus(int(found.status)).name
        (983.0, 1017.6, 'OK')
        >>> [round(value, 2) for value in Localizer(rig)(left, right).enu[0].tolist()]  # in the left camera's frame
        [0.0, 0.0, 1000.0]
        >>> look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 315.0, 45.0)])
        >>> places = torch.tensor([[0.0, 0, 30], [5000.0, 0, 40], [-5000.0, 0, 35]])
        >>> rig = Rig([camera] * 3, ["mill", "church", "mast"], look, center=places, refraction=0.0)
        >>> rig.root = rig.with_errors(attitude_deg=0.01)
        >>> pixels, seen = rig(torch.tensor([[0.0, 5000, 100]]))
        >>> found = Localizer(rig)(pixels, seen)
        >>> found.enu.round(decimals=3).abs().tolist(), round(float(found.covariance[0, 0, 0].sqrt()), 2)
        ([[0.0, 5000.0, 100.0]], 1.05)
    """

    pixel_sigma: Tensor
    clock_sigma: Tensor
    half_curvature: Tensor
    ecef_from_enu: Tensor | None
    ecef_of_origin: Tensor
    geodetic_of_origin: Tensor
    refraction: Tensor
    calibration_factor: Tensor | None
    mounting: Tensor | None
    link: Tensor | None
    up: Tensor | None
    heights: Tensor
    errors: Tensor | None
    bending_errors: Tensor
    limits: Tensor
    results = shapes_of(
        Localization, enu=(3,), covariance=(3, 3), geodetic=(3,), status=torch.int8, bearing=(3,), reprojection=(2,),
        anchor=torch.int64, used=((2,), torch.bool), bad=((2,), torch.bool), misfit=(2,),
    )  # fmt: skip

    def __init__(
        self,
        rig: Rig,
        *,
        weights: Weights | None = None,
        pixel_sigma: float | None = None,
        clock_sigma: float = 0.0,
        root: Tensor | None = None,
    ) -> None:
        super().__init__()
        if weights not in (None, *get_args(Weights)):
            raise InputError(f"weights {weights!r}: marks or all is needed")
        if not 0.0 <= clock_sigma < math.inf:
            raise InputError(f"clock_sigma: seconds, not negative, are needed, got {clock_sigma}")
        if root is not None:
            rig = copy.copy(rig)
            rig.root = root
        self.weights: Weights = weights or ("marks" if rig.is_pair else "all")
        noise, _ = noise_of_marks(pixel_sigma, rig.calibration)
        for name, value in (("pixel_sigma", noise), ("clock_sigma", clock_sigma)):
            self.register_buffer(name, scalar(value, rig.translation))
        self.lens: tuple[tuple[int, ...], ...] = ()
        if self.weights == "marks":
            if not rig.is_pair:
                raise InputError('weights "marks": two cameras in the left one\'s frame are needed')
            stereo.checked_rig(rig, pixel_sigma)
            self._stand(rig)
            self._weigh(rig)
            return
        check_single(rig.names, rig.each, 'weights "all"')
        self.rig = rig = Localizer(rig, weights="marks").apart() if rig.is_pair else rig
        known = rig.root is not None and bool(rig.root.any())
        self.included: tuple[str, ...] = ("marks", "calibration", "mounting") if known else ("marks",)
        self._place(rig.origin, rig.translation)
        for name in ("refraction", "calibration_factor", "mounting", "link"):
            self.register_buffer(name, None)
        self._weigh(rig)

    def _place(self, origin: Origin | None, like: Tensor) -> None:
        """Anchor the frame on the Earth, or nowhere."""
        place = (None, None) if origin is None else anchor(origin, like.device)
        self.register_buffer("ecef_from_enu", place[0])
        self.register_buffer("ecef_of_origin", place[1])
        zero = torch.zeros(3, dtype=torch.float64) if origin is None else origin.geodetic
        self.register_buffer("geodetic_of_origin", zero.to(like.device))
        self.register_buffer("half_curvature", scalar(0.5 / mean_radius(origin.lat) if origin else 0.0, like))

    def _weigh(self, rig: Rig) -> None:
        """Prepare weights by all errors; nothing of it where marks alone weigh."""
        up = heights = errors = bending = limits = None
        if self.weights == "all":
            if rig.origin is not None:
                assert self.ecef_from_enu is not None
                geodetic = enu_to_geodetic(rig.center.detach(), rig.origin)
                ups = [ecef_from_enu_rotation(lat, lon)[:, 2].to(geodetic) for lat, lon, _ in geodetic.tolist()]
                up, heights = torch.stack(ups) @ self.ecef_from_enu, geodetic[:, 2]
            errors, bending, self.lens = viewing.errors_by_camera(rig)
            bending = None if bending is None else bending * self.half_curvature
            freedom = 2.0 * torch.arange(len(rig) + 1, dtype=torch.float64) - 3.0
            limits = torch.stack([chi2_quantile(freedom.clamp_min(1.0), 1.0 - p) for p in (_BAD, _DOUBTFUL)])
            limits = limits.to(rig.translation.device)
        values = {"up": up, "heights": heights, "errors": errors, "bending_errors": bending, "limits": limits}
        for name, value in values.items():
            self.register_buffer(name, value)

    def _stand(self, rig: Rig) -> None:
        """Where two cameras stand, and how well that and the rig are known."""
        place, stands, known, calibration = rig.translation, rig.mounting, rig.relative_root, rig.covariance
        self.rig = rig
        self._place(None if stands is None else stands.origin, place)
        self.register_buffer("refraction", scalar(0.0 if stands is None else stands.refraction, place))
        look = torch.eye(3, dtype=torch.float64) if stands is None else stands.enu_from_cam
        self._keep("enu_from_rig", look.to(place.device))
        factor = None if calibration is None else calibration.half.T.to(place.device)
        mounting = link = None
        self.included = ("marks",) if factor is None else ("marks", "calibration")
        if known is not None and bool(known[:, -7:].any()):
            own = known[:, -7:].to(place.device)
            mounting, cross = own.T @ own, known[:, :-7].to(place.device).T @ own
            link = cross if bool(cross.any()) else None
            self.included += ("mounting",) * bool(own[:, :6].any())
        for name, value in (("calibration_factor", factor), ("mounting", mounting), ("link", link)):
            self.register_buffer(name, value)

    @property
    def constants(self) -> object:
        """By what it weighs, and by which parameters of each camera its marks have errors in common."""
        return self.weights, self.lens

    @property
    def on_earth(self) -> bool:
        """Whether positions are on the Earth; otherwise they are in the rig's own frame."""
        return self.ecef_from_enu is not None

    @property
    def enu_from_rig(self) -> Tensor:
        """(3, 3) how the left of two cameras looks, with the step of `free`."""
        kept, step = self._kept("enu_from_rig"), self.freed_step
        return kept if step is None else rotation_from_vector(step[1]) @ kept

    @property
    def origin(self) -> Origin | None:
        """Where the frame is anchored on the Earth, which is the projection center of the left of two cameras."""
        if self.ecef_from_enu is None:
            return None
        step, place = self.freed_step, self.geodetic_of_origin
        return Origin.at(place if step is None else place_enu(step[0], self.ecef_from_enu, self.ecef_of_origin))

    @property
    def attitude_deg(self) -> tuple[float, float, float]:
        """Heading, pitch and roll of the first camera, at its own vertical; in a frame of its own, about the axes."""
        if self.weights == "all" and self.on_earth:
            stands = station_mounting(self.rig, 0)
            return stands.heading_deg, stands.pitch_deg, stands.roll_deg
        look = self.enu_from_rig if self.weights == "marks" else self.rig.rotation[0].T
        return tuple(round(angle, 11) for angle in attitude(look.detach()))  # type: ignore[return-value]

    @property
    def pose_slots(self) -> dict[str, Any]:
        """What `free` takes: `mounting`, or `origin` and `attitude`; the step is that of `Mounting.covariance`."""
        if self.weights == "all" or not self.on_earth:
            raise InputError("this localizer has no mounting to free; free the poses of its rig")
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
            >>> from kcal.rig import planned_rig
            >>> rig = planned_rig().placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     localize = Localizer.from_file(save_rig(rig, Path(folder, "rig.json")), pixel_sigma=0.1)
            >>> localize.origin
            Origin(lat=19.07, lon=72.87, height=14.0)
        """
        return cls(load_rig(path), **options)

    def apart(self, errors: int | None = None) -> Rig:
        """Two cameras as a rig whose frame is that of the positions, with all that is known of it as its `root`.

        Args:
            errors: how many shared errors the root has, some of them zero: a filter needs as many at every time, and
                those of the calibration in the same order.
        """
        return leveled(self.rig, self.enu_from_rig, self.origin, float(self.refraction), errors)

    def weighing_all(self, errors: int | None = None) -> Localizer:
        """The same with weights by all errors; `errors` as for `apart`.

        Example:
            >>> from kcal.rig import planned_rig
            >>> localize = Localizer(planned_rig()).weighing_all()
            >>> localize.weights, localize.rig.names
            ('all', ('left', 'right'))
        """
        if self.weights == "all":
            return self
        noise = float(self.pixel_sigma), float(self.clock_sigma)
        return Localizer(self.apart(errors), weights="all", pixel_sigma=noise[0], clock_sigma=noise[1])

    def forward(
        self,
        pixels: Tensor | ArrayLike,
        other: Tensor | ArrayLike | None = None,
        cov: Tensor | None = None,
        mask: Tensor | None = None,
        *,
        velocity: Tensor | None = None,
        height: Tensor | ArrayLike | Ground | None = None,
        height_sigma: float = 1.0,
    ) -> Localization:
        """Locate the pixels (..., N, 2) of two cameras, `forward(left, right)`, or rows (..., V, 2) of V cameras.

        Args:
            pixels: integer coordinates at pixel centers; where they are NaN, a camera did not see a point.
            other: the same points in the right image, (..., N, 2); or (..., V) bool, what was seen: what is False is
                neither read nor differentiated.
            cov: covariance of each pixel, (..., V, 2, 2) or broadcastable to it; of left and right that of
                (u_left, v_left, u_right, v_right), (..., N, 4, 4).
            mask: (..., N) bool; what is False is MASKED, and neither read nor differentiated.
            velocity: (..., V, 2) motion in the images, px/s, with which errors of the clocks move the pixels.
            height: (..., N) meters above the ellipsoid of what one camera alone saw, NaN where it is not known; or the
                ground on which it stands, from `level_ground` or `terrain`: its line of sight is followed for 60 km
                until it meets that for the first time, in steps of a raster's cells.
            height_sigma: its standard deviation, meters.

        Raises:
            InputError: not floating point, shapes that are wrong or unlike, a height where marks alone weigh or the rig
                has no place on the Earth.
        """
        count, like = len(self.rig), self.rig.translation
        if other is not None and not _is_bool(other):
            if count != 2:
                raise InputError(
                    f"seen: bool is needed; left and right are pixels of two cameras, and this rig has {count}"
                )
            left, right = stereo.checked_pairs(pixels, other, self.rig)
            if self.weights == "marks" and velocity is None and height is None:
                return self._of_pairs(left, right, stereo.checked_covariance(cov, left.shape[:-1], (4, 4), left), mask)
            pixels, other = torch.stack([left, right], -2), None
        pixels, seen = stereo.checked_views(pixels, other, count, like)
        lead = pixels.shape[:-2]
        if mask is not None:
            seen = seen & stereo.checked_mask(mask, lead, pixels.device)[..., None]
        mixed: Tensor | None = None
        if cov is not None and count == 2 and as_tensor("cov", cov).shape[-2:] == (4, 4):
            joint = stereo.checked_covariance(cov, lead, (4, 4), pixels)
            assert joint is not None
            cov = torch.stack([joint[..., :2, :2], joint[..., 2:, 2:]], -3)
            mixed = joint - stereo.joint_covariance(cov)
            if self.weights == "all" and not known_true(mixed == 0):
                raise InputError('cov: with weights="all" marks are independent; give shape (..., N, 2, 2, 2)')
        cov = stereo.checked_covariance(cov, lead, (count, 2, 2))
        if velocity is not None:
            moved = self.clock_sigma * expanded("velocity", as_points("velocity", velocity, 2, pixels), pixels.shape)
            still = torch.eye(2, dtype=torch.float64, device=pixels.device)
            cov = self.pixel_sigma**2 * still.expand(*moved.shape, 2) if cov is None else cov
            cov = cov + moved[..., :, None] * moved[..., None, :]
        if self.weights == "marks":
            if height is not None:
                raise InputError('height: a rig of two cameras uses it with weights="all"')
            left, right = pixels.unbind(-2)
            cov = None if cov is None else stereo.joint_covariance(cov) + (0.0 if mixed is None else mixed)
            return self._of_pairs(left, right, cov, None if known_true(seen) else seen.all(-1))
        if height is not None:
            if not self.on_earth:
                raise InputError("height: this rig has no place on the Earth; give its origin")
            if not 0.0 < height_sigma < math.inf:
                raise InputError(f"height_sigma: a positive number of meters is needed, got {height_sigma}")
            if not callable(height):
                height = expanded("height", as_tensor("height", height).to(pixels), lead).reshape(-1)
        pixels, seen = pixels.reshape(-1, count, 2), seen.reshape(-1, count)
        cov = None if cov is None else cov.reshape(-1, count, 2, 2)
        ground, heights = (None, height) if isinstance(height, Tensor) else (height, None)
        differentiated = is_differentiated(pixels, cov, heights, self)

        def locate(pixels: Tensor, seen: Tensor, cov: Tensor | None, height: Tensor | None) -> Localization:
            return self._checked(pixels, seen, cov, height, (height_sigma, differentiated, ground))

        share = 1 if self.errors is None else max(1, count * self.errors.shape[0] // 8)
        found = stereo.piece_by_piece(
            locate, pixels, seen, cov, heights, differentiated=differentiated, axis=-3, share=share
        )
        return Localization(*(value.reshape(*lead, *value.shape[1:]) for value in found))

    def _of_pairs(self, left: Tensor, right: Tensor, cov: Tensor | None, mask: Tensor | None) -> Localization:
        if mask is not None:
            mask = stereo.checked_mask(mask, left.shape[:-1], left.device)
        if found := self.as_operation("forward", left, right, cov, mask):
            return Localization(*found)
        differentiated = is_differentiated(left, right, cov, self)
        noise, by_camera = self.pixel_sigma, self.calibration_factor is not None

        def locate(left: Tensor, right: Tensor, cov: Tensor | None, mask: Tensor | None) -> Localization:
            found = viewing.fit_pairs(
                self.rig, left, right, cov, mask, noise=noise, by_camera=by_camera, differentiated=differentiated
            )
            return self._by_marks(found)

        return stereo.piece_by_piece(locate, left, right, cov, mask, differentiated=differentiated)

    def _by_marks(self, found: viewing.ViewsFit) -> Localization:
        """Positions of pairs and all their errors."""
        fit, scale = found.fit, found.scale
        spread = [found.variance * entry for entry in fit.covariance]
        if self.calibration_factor is not None:
            factors = [self.calibration_factor, *([] if self.link is None else [self.link])]
            effect = calibration_effect(fit, scale, torch.cat(factors, 1))  # (..., 3, K, N)
            moved, by_link = effect.tensor_split([self.calibration_factor.shape[1]], -2)
            for number, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
                spread[number] = spread[number] + (moved[..., i, :, :] * moved[..., j, :, :]).sum(-2)
        reach = viewing.reach_of(found, inverse_variance(fit, spread))
        ok = reach.status == int(PositionStatus.OK)
        look = self.enu_from_rig
        bearing = (fit.direction / found.length[..., None, :]).mT @ look.mT
        enu = found.points(ok) @ look.mT
        slope = look @ position_slope(fit, scale, ok)
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
        there = found.fitted | (reach.status == int(PositionStatus.PARALLEL))
        bearing = torch.where(there[..., None], bearing, 0.0)
        return self._told(found, reach, (enu, covariance, bearing, found.pair_misfit))

    def _told(
        self, found: viewing.ViewsFit, reach: viewing.Reach, positions: tuple[Tensor, Tensor, Tensor, Tensor]
    ) -> Localization:
        """The result, given (positions, covariances, bearings, misfits)."""
        enu, covariance, bearing, misfit = positions
        step, ok = self.freed_step, reach.status == int(PositionStatus.OK)
        return Localization(
            enu=enu,
            covariance=covariance,
            geodetic=self._geodetic(enu if step is None else enu + step[0], ok),
            bearing=bearing,
            reprojection=stereo.reprojection_errors(found.fit.residual),
            anchor=found.anchor.to(torch.int64).argmax(-1),
            used=found.used,
            bad=torch.zeros_like(found.used),
            misfit=misfit,
            **reach._asdict(),
        )

    def _geodetic(self, enu: Tensor, ok: Tensor) -> Tensor:
        if self.ecef_from_enu is None:
            return self.geodetic_of_origin.expand(enu.shape)
        there = place_enu(enu, self.ecef_from_enu, self.ecef_of_origin)
        return torch.where(ok[..., None], there, self.geodetic_of_origin)

    def _checked(
        self, pixels: Tensor, seen: Tensor, cov: Tensor | None, height: Tensor | None, options: _Options
    ) -> Localization:
        """All rows, those with a bad view again without it."""
        once, bad, torn = self._located(pixels, seen, cov, height, options)
        again = bad.any(-1)
        if not is_traced() and known_true(~again):
            return self._contradicting(once, torn)
        try:
            rows = None if is_traced() else again.nonzero()[:, 0]
        except RuntimeError:  # under vmap
            rows = None
        if rows is None:
            left, worse, still = self._located(pixels, seen & ~bad, cov, height, options)
            left = self._contradicting(left._replace(bad=bad), torn | still | worse.any(-1))
            return left._replace(misfit=once.misfit)
        part = [None if value is None else value[rows] for value in (cov, height)]
        left = self._checked(pixels[rows], (seen & ~bad)[rows], part[0], part[1], options)
        left = left._replace(bad=left.bad | bad[rows], misfit=once.misfit[rows])
        whole = self._contradicting(once, torn)
        return Localization(*(old.index_copy(0, rows, new) for old, new in zip(whole, left, strict=True)))

    def _located(
        self, pixels: Tensor, seen: Tensor, cov: Tensor | None, height: Tensor | None, options: _Options
    ) -> tuple[Localization, Tensor, Tensor]:
        """All rows; (N, V) the view that should be left out; (N,) rows whose views contradict each other for good."""
        sigma, differentiated, ground = options
        posed, shared = self.posed, self.common
        reach = None
        if self.up is not None and self.ecef_from_enu is not None:
            bending = self.rig.refraction, self.half_curvature
            frame = EarthFrame(self.up, self.heights, self.ecef_from_enu, self.ecef_of_origin, *bending)
            stated = height if ground is None else ground
            if stated is not None:
                reach = partial(stated_ahead, frame, height=stated, sigma=sigma, differentiated=differentiated)
        views = viewing.fit_views(
            posed, pixels, seen, noise=self.pixel_sigma, cov=cov, shared=shared, height=reach,
            differentiated=differentiated,
        )  # fmt: skip
        with torch.no_grad():
            chi2, falls = (value.detach() for value in views.misfits())
            count = views.used.sum(-1)
            wrong = views.fitted & (chi2 > self.limits[0][count]) & (count > 1)
            rest = chi2[..., None] - falls
            best = torch.where(views.used, falls, -1.0).argmax(-1)
            chosen = torch.arange(len(self.rig), device=pixels.device) == best[..., None]
            # If others would do as well, nobody knows which it is.
            others = (rest < self.limits[1][(count - 1).clamp_min(0)][..., None]) & views.used & ~chosen
            torn = wrong & ((count < 3) | others.any(-1))
            bad = chosen & (wrong & ~torn)[..., None]
        return self._by_all(posed, views, falls), bad, torn

    def _by_all(self, posed: PosedCameras, views: viewing.ViewsFit, falls: Tensor) -> Localization:
        fit, variance = views.fit, views.variance * inverse_variance(views.fit, views.fit.covariance)
        reach = viewing.reach_of(views, variance, views.behind(posed.center))
        ok = reach.status == int(PositionStatus.OK)
        own = (fit.direction / views.length[..., None, :]).mT
        sight = torch.where(views.fitted[..., None], own, (views.anchor[..., None] * views.rays).sum(-2))
        bearing = torch.where(views.used.any(-1)[..., None], sight, 0.0)
        enu = torch.where(ok[..., None], views.points(ok), 0.0)
        return self._told(views, reach, (enu, views.covariance(ok), bearing, (0.5 * falls.clamp_min(0.0)).sqrt()))

    def _contradicting(self, found: Localization, torn: Tensor) -> Localization:
        """The same, without a position where `torn` (N,)."""
        nowhere = torch.diag(found.covariance.new_full((3,), math.inf))
        return found._replace(
            enu=torch.where(torn[..., None], 0.0, found.enu),
            covariance=torch.where(torn[..., None, None], nowhere, found.covariance),
            geodetic=torch.where(torn[..., None], self.geodetic_of_origin, found.geodetic),
            status=stereo.flagged(found.status, (torn, PositionStatus.CONTRADICTION)),
        )

    @property
    def posed(self) -> PosedCameras:
        """The cameras as they stand, where all errors weigh."""
        rig = self.rig
        return PosedCameras(rig.each, rig.rotation, rig.center, self.up, rig.refraction * self.half_curvature)

    @property
    def common(self) -> CommonErrors | None:
        """What marks of a camera have in common; None where all is exact."""
        return None if self.errors is None else CommonErrors(self.lens, self.errors, self.bending_errors)

    @property
    def _two(self) -> Rig:
        """The rig, if marks alone weigh."""
        if self.weights == "all":
            raise InputError('sensitivity: it is known of two cameras with weights="marks"')
        return self.rig

    def extra_repr(self) -> str:
        """Where it stands, and which errors its covariances contain, for `repr`."""
        stands = "in the frame of the rig"
        if self.on_earth:
            heading, pitch, roll = self.attitude_deg
            stands = f"{self.origin}, heading={heading:.6g}°, pitch={pitch:.6g}°, roll={roll:.6g}°"
        return f"{stands}, pixel_sigma={self.pixel_sigma:g}, errors of {' and '.join(self.included)}"

    @torch.no_grad()
    def sensitivity(self, pixels_left: Tensor, pixels_right: Tensor) -> Sensitivity:
        """How far the range moves by one pixel of a mark and by one degree of the rig; see `Sensitivity`.

        Args:
            pixels_left: (..., N, 2).
            pixels_right: (..., N, 2).
        """
        return _sensitivity(viewing.fit_pairs(self._two, *stereo.checked_pairs(pixels_left, pixels_right, self._two)))

    def with_sensitivity(self, pixels_left: Tensor, pixels_right: Tensor) -> tuple[Localization, Sensitivity]:
        """`forward` and `sensitivity` for the work of one; without covariances, masks and derivatives.

        Args:
            pixels_left: (..., N, 2); in one piece, so give some ten thousand at once.
            pixels_right: (..., N, 2).
        """
        by_camera = self.calibration_factor is not None
        pairs = stereo.checked_pairs(pixels_left, pixels_right, self._two)
        found = viewing.fit_pairs(self.rig, *pairs, noise=self.pixel_sigma, by_camera=by_camera)
        return self._by_marks(found), _sensitivity(found)


def _is_bool(values: Tensor | ArrayLike) -> bool:
    return values.dtype == torch.bool if isinstance(values, Tensor) else np.asarray(values).dtype == bool


def _sensitivity(found: viewing.ViewsFit) -> Sensitivity:
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
