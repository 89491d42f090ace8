"""`MultiViewLocalizer`: a module from pixels of any subset of cameras to positions on the Earth with their errors."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from kcal.checks import StatedModule, as_points, expanded, exportable, scalar
from kcal.dispatch import is_differentiated, is_traced, known_true
from kcal.errors import InputError
from kcal.lens.rig import Rig
from kcal.locate.geodesy import anchor, ecef_from_enu_rotation, enu_to_geodetic, mean_radius, place_enu
from kcal.locate.ground import EarthFrame, Ground, stated_ahead
from kcal.locate.max_likelihood import inverse_variance
from kcal.locate.stereo import (
    PositionStatus,
    checked_views,
    checked_views_covariance,
    flag_positions,
    piece_by_piece,
    range_where_ok,
    reprojection_errors,
    status_counts,
)
from kcal.locate.views import CommonErrors, PosedCameras, ViewsFit, fit_views, reach_of
from kcal.texts import brief

# How seldom good views are taken for bad ones.
_BAD, _DOUBTFUL = 1e-4, 1e-2
# Sigma of a height, whether there are derivatives, and the ground.
_Options: TypeAlias = "tuple[float, bool, Ground | None]"


@exportable
class ViewsLocalization(NamedTuple):
    """Result of `MultiViewLocalizer`; nothing in it is NaN, whatever went in. Look at `status` before anything else.

    Attributes:
        enu: (..., 3) meters in the rig's frame: east, north, up of its origin; zeros unless the status is OK.
        covariance: (..., 3, 3) of `enu`, to first order; an infinite diagonal unless OK.
        geodetic: (..., 3) latitude, longitude (degrees), ellipsoidal WGS84 height (meters); the origin unless OK, and
            zeros where the rig has none.
        status: (...) int8, codes of `PositionStatus`. BEARING_ONLY: one camera saw it and its height is not known, or
            the parallax is below three of its sigmas; PARALLEL: the lines of sight meet nowhere before the cameras;
            CONTRADICTION: the views are not of one point, and which is wrong cannot be told.
        anchor: (...) int64, the first camera that saw the point: from where it is said to stand count the bearing and
            the ranges.
        bearing: (..., 3) unit vector in the frame; zeros where nothing is known.
        inverse_range: (...) one over meters, whose errors are Gaussian at any distance.
        inverse_range_sigma: (...) its standard deviation; zero where nothing is known.
        range_low: (...) meters, lower end of the 95 % interval.
        range_high: (...) upper end.
        used: (..., V) which views are part of the position.
        bad: (..., V) views that were left out because they contradict the others.
        misfit: (..., V) what leaving out each view changes, with all views: the root of the fall of χ² over two, in
            sigmas; 1 is typical. Of two views, either takes it all. It has no gradient.
        reprojection: (..., V) distance in px between mark and reprojected point; zero where a view is not used.
    """

    enu: Tensor
    covariance: Tensor
    geodetic: Tensor
    status: Tensor
    anchor: Tensor
    bearing: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    range_low: Tensor
    range_high: Tensor
    used: Tensor
    bad: Tensor
    misfit: Tensor
    reprojection: Tensor

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))

    @property
    def range(self) -> Tensor:
        """(...) meters from the camera `anchor`; infinite unless the status is OK."""
        return range_where_ok(self.status, self.inverse_range)


class MultiViewLocalizer(StatedModule):
    """Locate what any of several cameras saw, each row on its own, with an error bar and a check of each view.

    A point is the most likely one given the noise of its pixels and the errors that a camera's pixels share: lens,
    position, attitude and refraction (`Rig.root`), and clocks. All of them weigh the views, and the covariance
    contains them all. Two cameras or more give a position, one gives a bearing, or a position where the height is
    stated. With three views or more, one that contradicts the others is left out and named.

    Light bends at each camera about its own vertical, and the frame is straight: the Earth falls away below it.
    There is no branch on values under `torch.compile`, `torch.export` and `vmap`: bad views are then sought once, and
    one is found; otherwise again until two are left. Gradients by pixels, covariances, velocities, heights, cameras,
    poses and errors are exact. What one camera and a stated height locate has error bars without a gradient.

    Args:
        rig: the cameras, and what is known of them.
        pixel_sigma: standard deviation of a mark along each axis, px, where no covariance is given.
        root: (K, P) like `rig.root`, in its place: for example `rig.with_errors(...)`.
        clock_sigma: standard deviation of each camera's clock, seconds; counts where `forward` is told velocities.

    Raises:
        InputError: a sigma that is not positive, a `root` of another rig.

    Example:
        >>> from kcal import Camera
        >>> from kcal.lens.rig import Origin
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 315.0, 45.0)])
        >>> places = torch.tensor([[0.0, 0, 30], [5000.0, 0, 40], [-5000.0, 0, 35]])
        >>> rig = Rig([camera] * 3, ["mill", "church", "mast"], look, center=places, refraction=0.0)
        >>> rig.root = rig.with_errors(attitude_deg=0.01)
        >>> pixels, seen = rig(torch.tensor([[0.0, 5000, 100]]))
        >>> found = MultiViewLocalizer(rig)(pixels, seen)
        >>> found.enu.round(decimals=3).abs().tolist(), round(float(found.covariance[0, 0, 0].sqrt()), 2)
        ([[0.0, 5000.0, 100.0]], 1.05)
    """

    pixel_sigma: Tensor
    clock_sigma: Tensor
    half_curvature: Tensor
    up: Tensor | None
    heights: Tensor
    ecef_from_enu: Tensor | None
    ecef_of_origin: Tensor
    geodetic_of_origin: Tensor
    errors: Tensor | None
    bending_errors: Tensor
    limits: Tensor

    def __init__(
        self,
        rig: Rig,
        *,
        pixel_sigma: float = 0.3,
        root: Tensor | None = None,
        clock_sigma: float = 0.0,
    ) -> None:
        # SciPy takes long to load.
        from scipy.special import chdtri

        super().__init__()
        if not 1e-6 <= pixel_sigma <= 1e6:
            raise InputError(f"pixel_sigma: a positive number of pixels, 1e-6 to 1e6, is needed, got {pixel_sigma}")
        if not 0.0 <= clock_sigma < math.inf:
            raise InputError(f"clock_sigma: seconds, not negative, are needed, got {clock_sigma}")
        root = rig.root if root is None else root
        if root is not None:
            rig.check_root(root)
        self.rig = rig
        for name, value in (("pixel_sigma", pixel_sigma), ("clock_sigma", clock_sigma)):
            self.register_buffer(name, scalar(value, rig.center))
        half_curvature = 0.0
        device = rig.center.device
        up = heights = place = None
        if rig.origin is not None:
            half_curvature = 0.5 / mean_radius(rig.origin.lat)
            place = anchor(rig.origin, device)
            geodetic = enu_to_geodetic(rig.center.detach(), rig.origin)
            ups = [ecef_from_enu_rotation(lat, lon)[:, 2].to(device) for lat, lon, _ in geodetic.tolist()]
            up, heights = torch.stack(ups) @ place[0], geodetic[:, 2]
        self.register_buffer("half_curvature", scalar(half_curvature, rig.center))
        self.register_buffer("up", up)
        self.register_buffer("heights", heights)
        self.register_buffer("ecef_from_enu", None if place is None else place[0])
        self.register_buffer("ecef_of_origin", None if place is None else place[1])
        zero = torch.zeros(3, dtype=torch.float64) if rig.origin is None else rig.origin.geodetic
        self.register_buffer("geodetic_of_origin", zero.to(device))
        errors, bending, self.lens = errors_by_camera(rig, root)
        self.register_buffer("errors", errors)
        self.register_buffer("bending_errors", None if bending is None else bending * half_curvature)
        freedom = 2.0 * torch.arange(len(rig) + 1, dtype=torch.float64) - 3.0
        limits = [[float(chdtri(max(float(f), 1.0), p)) for f in freedom] for p in (_BAD, _DOUBTFUL)]
        self.register_buffer("limits", torch.tensor(limits, dtype=torch.float64, device=device))

    @property
    def constants(self) -> object:
        """By which parameters of each camera its marks have errors in common."""
        return self.lens

    def forward(
        self,
        pixels: Tensor,
        seen: Tensor | None = None,
        cov: Tensor | None = None,
        *,
        velocity: Tensor | None = None,
        height: Tensor | Ground | None = None,
        height_sigma: float = 1.0,
    ) -> ViewsLocalization:
        """Locate rows of pixels.

        Args:
            pixels: (..., V, 2) integer coordinates at pixel centers, in the order of the rig's cameras.
            seen: (..., V) bool; what is False is neither read nor differentiated, and what is NaN was not seen.
            cov: (..., V, 2, 2) covariance of each pixel, or broadcastable to it.
            velocity: (..., V, 2) motion in the images, px/s, with which errors of the clocks move the pixels.
            height: (...) meters above the ellipsoid of what one camera alone saw, NaN where it is not known; or the
                ground on which it stands, from `level_ground` or `terrain`: its line of sight is followed for 60 km
                until it meets that for the first time, in steps of a raster's cells.
            height_sigma: its standard deviation, meters.

        Raises:
            InputError: not floating point, wrong shapes, a height where the rig has no place on the Earth.
        """
        count = len(self.rig)
        pixels, seen = checked_views(pixels, seen, count, self.rig.center)
        lead, seen = pixels.shape[:-2], seen.reshape(-1, count)
        cov = checked_views_covariance(cov, pixels)
        cov = None if cov is None else cov.reshape(-1, count, 2, 2)
        if velocity is not None:
            moved = expanded("velocity", as_points("velocity", velocity, 2, pixels), pixels.shape)
            moved = self.clock_sigma * moved.reshape(-1, count, 2)
            still = torch.eye(2, dtype=torch.float64, device=pixels.device)
            cov = self.pixel_sigma**2 * still.expand(*moved.shape, 2) if cov is None else cov
            cov = cov + moved[..., :, None] * moved[..., None, :]
        if height is not None:
            if self.ecef_from_enu is None:
                raise InputError("height: this rig has no place on the Earth; give its origin")
            if not 0.0 < height_sigma < math.inf:
                raise InputError(f"height_sigma: a positive number of meters is needed, got {height_sigma}")
            if isinstance(height, Tensor):
                height = expanded("height", height.to(torch.float64), lead).reshape(-1)
        pixels = pixels.reshape(-1, count, 2)
        ground, heights = (None, height) if isinstance(height, Tensor) else (height, None)
        differentiated = is_differentiated(pixels, cov, heights, self)

        def locate(pixels: Tensor, seen: Tensor, cov: Tensor | None, height: Tensor | None) -> ViewsLocalization:
            return self._checked(pixels, seen, cov, height, (height_sigma, differentiated, ground))

        share = 1 if self.errors is None else max(1, count * self.errors.shape[0] // 8)
        found = piece_by_piece(locate, pixels, seen, cov, heights, differentiated=differentiated, axis=-3, share=share)
        return ViewsLocalization(*(value.reshape(*lead, *value.shape[1:]) for value in found))

    def _checked(
        self, pixels: Tensor, seen: Tensor, cov: Tensor | None, height: Tensor | None, options: _Options
    ) -> ViewsLocalization:
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
        return ViewsLocalization(*(old.index_copy(0, rows, new) for old, new in zip(whole, left, strict=True)))

    def _located(
        self, pixels: Tensor, seen: Tensor, cov: Tensor | None, height: Tensor | None, options: _Options
    ) -> tuple[ViewsLocalization, Tensor, Tensor]:
        """All rows; (N, V) the view that should be left out; (N,) rows whose views contradict each other for good."""
        sigma, differentiated, ground = options
        posed, shared = posed_cameras(self), common_errors(self)
        reach = None
        if self.up is not None and self.ecef_from_enu is not None:
            bending = self.rig.refraction, self.half_curvature
            frame = EarthFrame(self.up, self.heights, self.ecef_from_enu, self.ecef_of_origin, *bending)
            stated = height if ground is None else ground
            if stated is not None:
                reach = partial(stated_ahead, frame, height=stated, sigma=sigma, differentiated=differentiated)
        views = fit_views(
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
        return self._on_earth(posed, views, falls), bad, torn

    def _on_earth(self, posed: PosedCameras, views: ViewsFit, falls: Tensor) -> ViewsLocalization:
        fit, variance = views.fit, views.variance * inverse_variance(views.fit, views.fit.covariance)
        reach = reach_of(views, variance, PositionStatus.BEARING_ONLY, views.behind(posed.center))
        ok = reach.status == int(PositionStatus.OK)
        enu = torch.where(ok[..., None], views.points(ok), 0.0)
        geodetic = self.geodetic_of_origin.expand(enu.shape)
        if self.ecef_from_enu is not None:
            there = place_enu(enu, self.ecef_from_enu, self.ecef_of_origin)
            geodetic = torch.where(ok[..., None], there, geodetic)
        aimed = views.used.any(-1)
        own = (fit.direction / views.length[..., None, :]).mT
        sight = torch.where(views.fitted[..., None], own, (views.anchor[..., None] * views.rays).sum(-2))
        return ViewsLocalization(
            enu=enu,
            covariance=views.covariance(ok),
            geodetic=geodetic,
            status=reach.status,
            anchor=views.anchor.to(torch.int64).argmax(-1),
            bearing=torch.where(aimed[..., None], sight, 0.0),
            inverse_range=reach.value,
            inverse_range_sigma=reach.sigma,
            range_low=reach.interval.low,
            range_high=reach.interval.high,
            used=views.used,
            bad=torch.zeros_like(views.used),
            misfit=(0.5 * falls.clamp_min(0.0)).sqrt(),
            reprojection=torch.where((views.used & views.fitted[..., None]), reprojection_errors(fit.residual), 0.0),
        )

    def _contradicting(self, found: ViewsLocalization, torn: Tensor) -> ViewsLocalization:
        """The same, without a position where `torn` (N,)."""
        nowhere = torch.diag(found.covariance.new_full((3,), math.inf))
        return found._replace(
            enu=torch.where(torn[..., None], 0.0, found.enu),
            covariance=torch.where(torn[..., None, None], nowhere, found.covariance),
            geodetic=torch.where(torn[..., None], self.geodetic_of_origin, found.geodetic),
            status=flag_positions(found.status, torn, PositionStatus.CONTRADICTION),
        )


def posed_cameras(localize: MultiViewLocalizer) -> PosedCameras:
    """The cameras as they stand."""
    rig, bending = localize.rig, localize.rig.refraction * localize.half_curvature
    return PosedCameras(rig.each, rig.rotation, rig.center, localize.up, bending)


def common_errors(localize: MultiViewLocalizer) -> CommonErrors | None:
    """What marks of a camera have in common; None where all is exact."""
    if localize.errors is None:
        return None
    return CommonErrors(localize.lens, localize.errors, localize.bending_errors)


def errors_by_camera(rig: Rig, root: Tensor | None) -> tuple[Tensor | None, Tensor | None, tuple[tuple[int, ...], ...]]:
    """What `CommonErrors` contains: `half`, `bending` per unit of k, and `lens`."""
    if root is None or not bool(root.any()):
        return None, None, ()
    root = root.to(rig.center)
    lenses = root[:, : sum(rig.sizes)].split(list(rig.sizes), 1)
    wanted = [tuple(own.any(0).nonzero()[:, 0].tolist()) for own in lenses]
    if len(set(rig.sizes)) == 1:
        # Cameras of one kind are computed together, with the same parameters.
        wanted = [tuple(sorted(set().union(*wanted)))] * len(rig)
    most = max(map(len, wanted))
    rows = [
        torch.nn.functional.pad(
            torch.cat([root[:, rig.pose_columns(c)], lenses[c][:, list(own)]], 1), (0, most - len(own))
        )
        for c, own in enumerate(wanted)
    ]
    return torch.stack(rows, 1), root[:, -1], tuple(wanted)
