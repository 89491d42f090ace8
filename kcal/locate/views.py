"""Pixels of any subset of cameras to the most likely points, each on its own, and to the ranges of these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import known_true
from kcal.lens.camera import Camera
from kcal.lens.camera_like import project_each, unproject_each
from kcal.lens.pose import side_axes, step_rows
from kcal.lens.rig import Rig
from kcal.locate.angular import Found, Surroundings, first_seen, length_of_one, lifted, triangulate_angular
from kcal.locate.max_likelihood import (
    PointFit,
    RelativeCamera,
    inverse_covariances,
    most_likely,
    position_slope,
    symmetric,
)
from kcal.locate.stereo import (
    BEARING_SIGMAS,
    PositionStatus,
    flagged,
    joint_covariance,
    range_interval,
    sight_lines,
)
from kcal.texts import briefly

# Pixels of any subset of cameras to points with errors, each point on its own.
#
# A point is sought from the first camera that saw it, its anchor, as a direction and an inverse distance in the frame
# of all cameras. Errors that a camera's marks share (lens, center, attitude, refraction) are to first order correlated
# noise of the pixels: a point is weighed by the inverse covariance of all of them together, so that a camera whose
# attitude is poor counts less.

# Share of a view's information that the others must be able to check: below, leaving it out tells nothing.
_UNCHECKED = 1e-9
# Meters: so far away that errors of positions do not count.
_FAR = 1e8


@briefly
class PosedCameras(NamedTuple):
    """Cameras as they stand: points_cam = rotation @ (points - center).

    Attributes:
        cameras: C of them.
        rotation: (C, 3, 3) cam_from_frame.
        center: (C, 3) meters.
        up: (C, 3) the vertical at each camera, in the frame; None where lines of sight are straight.
        bending: k / 2R, 1/m.
    """

    cameras: Sequence[Camera]
    rotation: Tensor
    center: Tensor
    up: Tensor | None = None
    bending: Tensor | float = 0.0

    @property
    def scale(self) -> Tensor:
        """The largest distance of a camera from the first one, meters; one where all stand in one place."""
        far = torch.linalg.vector_norm(self.center - self.center[0], dim=-1).amax()
        return torch.where(far > 0, far, 1.0)

    @property
    def matrices(self) -> Tensor:
        """(C, 3, 4) [R | t] of points from the first camera's center: a far origin costs no digits."""
        moved = self.rotation @ (self.center[0] - self.center)[..., None]
        return torch.cat([self.rotation, moved], -1)

    def inside(self, pixels: Tensor) -> Tensor:
        """Which pixels (..., C, 2), one of each camera, are in its image: (..., C) bool."""
        return torch.stack([camera.inside(pixels[..., c, :]) for c, camera in enumerate(self.cameras)], -1)

    @property
    def around(self) -> Surroundings:
        """How light bends, in the cameras' axes."""
        if self.up is None:
            return Surroundings()
        return Surroundings(up=(self.rotation @ self.up[..., None])[..., 0], bending=self.bending)


@briefly
class CommonErrors(NamedTuple):
    """Errors that all marks of a camera share: K independent ones.

    Attributes:
        lens: for each camera the numbers of its parameters that are not exact.
        half: (K, C, Q) change of a camera's center, of its turn and of these, by each error; padded with zeros.
        bending: (K,) change of k / 2R.
    """

    lens: tuple[tuple[int, ...], ...]
    half: Tensor
    bending: Tensor


class StatedHeight(NamedTuple):
    """Where lines of sight reach a known height, by which one camera is enough.

    Attributes:
        point: (N, 3) in the frame.
        up: (N, 3) the vertical there; over terrain the slope of the height above the ground.
        sigma: (N,) of the height, meters.
        reached: (N,) bool.
        off: (N,) meters by which the points lie too high: zeros, with the derivatives by what states the height.
    """

    point: Tensor
    up: Tensor
    sigma: Tensor
    reached: Tensor
    off: Tensor | float = 0.0


class ViewsFit(NamedTuple):
    """The most likely points.

    Attributes:
        fit: the optimum, its direction in the cameras' frame.
        scale: meters, the unit of `fit.inverse`.
        anchor: (N, C) bool: the camera from which a point is told; the first one where nobody saw it.
        place: (N, 3) the anchor's center.
        rays: (N, C, 3) in the frame.
        used: (N, C) which views count.
        status: (N,) int8, before anything is known of the range.
        fitted: (N,) which points have an optimum.
        weight: (2 C, 2 C, N) of the pixels; None: all have the variance `variance`.
        variance: px².
        alone: (N,) points that one camera and a stated height determine, whose error bars carry no gradient; or None.
    """

    fit: PointFit
    scale: Tensor
    anchor: Tensor
    place: Tensor
    rays: Tensor
    used: Tensor
    status: Tensor
    fitted: Tensor
    weight: Tensor | None
    variance: Tensor | float
    alone: Tensor | None

    def points(self, ok: Tensor) -> Tensor:
        """(N, 3) in the frame; the anchor's center unless `ok`."""
        depth = self.scale / torch.where(ok, self.fit.inverse, 1.0)
        return self.place + torch.where(ok[..., None], depth[..., None] * self.fit.direction.mT, 0.0)

    def covariance(self, ok: Tensor) -> Tensor:
        """(N, 3, 3) of the points; an infinite diagonal unless `ok`."""
        slope = position_slope(self.fit, self.scale, ok)
        found = self.steady(self.variance * (slope @ symmetric(self.fit.covariance) @ slope.mT))
        return torch.where(ok[..., None, None], found, torch.diag(found.new_full((3,), torch.inf)))

    def steady(self, values: Tensor) -> Tensor:
        """Values (N, ...) without derivatives where a stated height was needed."""
        if self.alone is None:
            return values
        return torch.where(self.alone.reshape(-1, *[1] * (values.ndim - 1)), values.detach(), values)

    @torch.no_grad()
    def behind(self, center: Tensor) -> Tensor:
        """(N,) whether a point is behind a camera that saw it; `center` (C, 3)."""
        apart = self.place[..., None, :] - center
        offset = self.fit.direction.mT[..., None, :] + (self.fit.inverse / self.scale)[..., None, None] * apart
        return (((offset * self.rays).sum(-1) < 0) & self.used).any(-1) & self.fitted

    @property
    def length(self) -> Tensor:
        """(N,) of `fit.direction`."""
        # `vector_norm` takes twenty times as long along this axis.
        return self.fit.direction.square().sum(-2).sqrt()

    @property
    def _weight(self) -> Tensor:
        if self.weight is not None:
            return self.weight
        return (torch.eye(len(self.fit.residual)).to(self.fit.residual) / self.variance)[..., None]

    @property
    def chi2(self) -> Tensor:
        """χ² (..., N) of the residuals."""
        residual = self.fit.residual
        if self.weight is None:
            return residual.square().sum(-2) / self.variance
        return (residual * (self.weight * residual[..., None, :, :]).sum(-2)).sum(-2)

    @property
    def pair_misfit(self) -> Tensor:
        """(..., N, 2) of two views: the root of half of χ², which either takes when it is left out; no gradient."""
        misfit = torch.where(self.fitted, (0.5 * self.chi2.detach()).sqrt(), 0.0)
        return misfit[..., None].expand(self.used.shape)

    @torch.no_grad()
    def misfits(self) -> tuple[Tensor, Tensor]:
        """χ² (N,) of the residuals, and (N, C) by how much it falls when a view is left out.

        Of two views, either takes all of it. To first order, which is exact to rounding for views some sigmas off.
        """
        jacobian, weight, chi2 = self.fit.jacobian, self._weight, self.chi2
        pulled = (weight * self.fit.residual).sum(-2)
        weighted = (weight[None] * jacobian[:, None]).sum(-2)  # (3, 2 C, N)
        a, b, c, d, e, f = (self.variance * entry for entry in self.fit.covariance)
        spread = torch.stack([a, b, c, b, d, e, c, e, f]).unflatten(0, (3, 3))
        gained = (spread[:, :, None] * weighted).sum(1)

        def rest(i: int, j: int) -> Tensor:
            """(C, N) entries of W - W J C Jᵀ W of each view."""
            own = weight[i::2, j::2].diagonal(dim1=0, dim2=1).mT
            return own - (weighted[:, i::2] * gained[:, j::2]).sum(0)

        q, r, s = rest(0, 0), rest(0, 1), rest(1, 1)
        u, v = pulled[0::2], pulled[1::2]
        determinant = q * s - r * r
        checked = determinant > _UNCHECKED * torch.maximum(q, s).square()
        fall = (s * u * u - 2.0 * r * u * v + q * v * v) / torch.where(checked, determinant, 1.0)
        several = (self.used.sum(-1) > 2)[..., None]
        fall = torch.where(several, torch.where(checked, fall, 0.0).mT, chi2[..., None])
        return chi2, torch.where(self.used & self.fitted[..., None], fall, 0.0)


def fit_views(
    posed: PosedCameras,
    pixels: Tensor,
    seen: Tensor,
    *,
    noise: Tensor | float,
    cov: Tensor | None = None,
    shared: CommonErrors | None = None,
    height: Callable[[Tensor, Tensor, Tensor, Tensor], StatedHeight] | None = None,
    differentiated: bool = False,
) -> ViewsFit:
    """The most likely point of each row of views: in closed form first, then by `most_likely`.

    Args:
        posed: C cameras.
        pixels: (N, C, 2) float64; what is not finite was not seen.
        seen: (N, C) bool; what is False is neither read nor differentiated.
        noise: standard deviation of a pixel along each axis where there is no covariance, px.
        cov: (N, C, 2, 2) covariance of each pixel.
        shared: what marks of a camera have in common.
        height: of places, rays, anchors, and which points one camera alone saw: where their height is known.
        differentiated: see `most_likely`.
    """
    finite = torch.isfinite(pixels).all(-1)
    wanted = seen & finite
    middle = torch.stack([camera.center.detach() for camera in posed.cameras])
    pixels = torch.where(wanted[..., None], pixels, middle)
    sound = wanted if cov is None else sound_covariances(cov)
    if cov is not None:
        still = torch.eye(2, dtype=cov.dtype, device=cov.device)
        cov = torch.where((sound & wanted)[..., None, None], cov, still)
    center = posed.center
    rays, valid = unproject_each(posed.cameras, pixels.movedim(-2, -3))
    rays, valid = rays.movedim(-3, -2), valid.mT
    in_frame = (rays[..., None, :] @ posed.rotation)[..., 0, :]
    # Weights follow the place where a point is sought first, and derivatives follow them.
    with torch.set_grad_enabled(differentiated and shared is not None):
        inside = posed.inside(pixels)
        used = wanted & valid & inside & sound
        code = torch.full(used.shape[:-1], int(PositionStatus.OK), dtype=torch.int8, device=used.device)
        count = used.sum(-1)
        nothing = count == 0
        code = flagged(
            code,
            (count == 1, PositionStatus.BEARING_ONLY),
            (nothing & ~seen.any(-1), PositionStatus.MASKED),
            (nothing & (seen & ~finite).any(-1), PositionStatus.NOT_FINITE),
            (nothing & (wanted & ~inside).any(-1), PositionStatus.OUTSIDE_IMAGE),
            (nothing & (wanted & inside & ~valid).any(-1), PositionStatus.OUTSIDE_LENS),
            ((wanted & ~sound).any(-1), PositionStatus.BAD_COVARIANCE),
        )
        anchor = first_seen(used)
        anchor = torch.cat([anchor[..., :1] | nothing[..., None], anchor[..., 1:]], -1)
        ray = (anchor[..., None] * in_frame).sum(-2)
        with torch.set_grad_enabled(differentiated):
            place = (anchor[..., None] * center).sum(-2)
        found = Found(torch.zeros_like(ray), torch.zeros_like(nothing))
        if len(posed.cameras) > 1:
            found = triangulate_angular(posed.matrices, rays, used)
        met, scale = found.valid & (count > 1), posed.scale.detach()
        away = found.points + center[0] - place
        alone: Tensor | None = None
        if height is not None:
            stated = height(place, ray, anchor, count == 1)
            alone = (count == 1) & stated.reached
            away, met = torch.where(alone[..., None], stated.point - place, away), met | alone
            code = flagged(code, (alone, PositionStatus.OK))
        away = torch.where(met[..., None], away, ray)
        distance = torch.linalg.vector_norm(away, dim=-1)
        ahead, inverse = away / distance[..., None], torch.where(met, scale / distance, 0.0)
    around = posed.around._replace(present=used.mT)
    if alone is not None:
        held = torch.where(alone[..., None, :], _height_row(ahead.detach(), inverse.detach(), scale, stated), 0.0)
        off = ((place - place.detach()) * stated.up).sum(-1) + stated.off
        around = around._replace(held=held, held_off=torch.where(alone, off / stated.sigma, 0.0))
    fitted = code == int(PositionStatus.OK)
    weight: Tensor | None = None
    variance: Tensor | float = noise**2
    if cov is not None or shared is not None:
        moved = None if shared is None else shared_pixels(posed, shared, (place, ahead, inverse), used, scale)
        weight, variance = _weight(cov, noise, used, moved), 1.0
    apart = place[..., None, :] - center
    each = zip(posed.cameras, posed.rotation, apart.unbind(-2), strict=True)
    lines = [RelativeCamera(camera, turn, turn @ own.mT) for camera, turn, own in each]
    fit = most_likely(
        lines, scale, (ahead, inverse), pixels.flatten(-2).mT, fitted, weight, differentiated=differentiated,
        around=around,
    )  # fmt: skip
    fit = fit._replace(direction=posed.rotation[0].mT @ fit.turned[0])
    return ViewsFit(fit, scale, anchor, place, in_frame, used, code, fitted, weight, variance, alone)


def sound_covariances(cov: Tensor) -> Tensor:
    """(N, C) which covariances (N, C, 2, 2) are those of a pixel."""
    with torch.no_grad():
        a, b, c, d = cov.flatten(-2).unbind(-1)
        largest = torch.maximum(a.abs(), d.abs())
        return torch.isfinite(a + b + c + d) & (a > 0) & (a * d > b * c) & ((b - c).abs() <= 1e-6 * largest)


def _height_row(ahead: Tensor, inverse: Tensor, scale: Tensor, stated: StatedHeight) -> Tensor:
    """(3, N) the slope of the height by (a, b, ρ) over its sigma."""
    first, second = side_axes(ahead)
    range_ = scale / torch.where(inverse > 0, inverse, 1.0)
    climb = [(axis * stated.up).sum(-1) * range_ / stated.sigma for axis in (first, second, ahead)]
    return torch.stack([climb[0], climb[1], -climb[2] * range_ / scale], -2)


def shared_pixels(
    posed: PosedCameras, shared: CommonErrors, at: tuple[Tensor, Tensor, Tensor], used: Tensor, scale: Tensor
) -> Tensor:
    """(K, 2 C, N) what each shared error moves in the pixels of points: anchor (N, 3), direction, inverse distance."""
    place, ahead, inverse = at
    line = ahead[..., None, :] + (inverse / scale)[..., None, None] * (place[..., None, :] - posed.center)
    seen = (posed.rotation @ line[..., None])[..., 0].movedim(-3, -1)  # (C, 3, N)
    around, unit = posed.around, length_of_one(scale, inverse)
    seen = torch.where(used.mT[:, None], seen, seen.new_tensor([[0.0], [0.0], [1.0]]))
    higher = None
    if around.up is not None:
        higher = lifted(seen, around._replace(bending=1.0), unit)
        seen = seen + around.bending * higher
    moved = []
    for c, found in enumerate(project_each(posed.cameras, seen, shared.lens, inverse / scale)):
        turn = posed.rotation[c]
        turned = step_rows(found.by_point, seen[c])[:3]
        by_center = torch.einsum("ij,iun->jun", -turn, found.by_point) * (inverse / scale)
        by_turn = torch.einsum("ij,iun->jun", -turn, turned)
        rows = torch.cat([by_center, by_turn, found.by_camera[: len(shared.lens[c])]])
        pixels = torch.einsum("kq,qun->kun", shared.half[:, c, : len(rows)], rows)
        if higher is not None:
            by_air = (found.by_point * higher[c, :, None]).sum(0)
            pixels = pixels + shared.bending[:, None, None] * by_air
        moved.append(torch.where(used[..., c], pixels, 0.0))
    return torch.cat(moved, -2)


def common_variance(posed: PosedCameras, common: CommonErrors | None, camera: int, rays: Tensor) -> Tensor:
    """(N, 2) variance that common errors of a camera give its pixels of what is far away along rays (N, 3), px²."""
    if common is None:
        return torch.zeros_like(rays[:, :2])
    alone = PosedCameras(posed.cameras[camera : camera + 1], *(part[[camera]] for part in posed[1:3]))
    common = CommonErrors(common.lens[camera : camera + 1], common.half[:, [camera]], common.bending)
    at = alone.center.expand_as(rays), rays, torch.full_like(rays[:, 0], 1.0 / _FAR)
    moved = shared_pixels(alone, common, at, torch.ones_like(rays[:, :1], dtype=torch.bool), alone.scale)
    return moved.square().sum(0).T


def _weight(cov: Tensor | None, noise: Tensor | float, used: Tensor, moved: Tensor | None) -> Tensor:
    """(2 C, 2 C, N) inverse covariance of the pixels of used views; the identity for the others."""
    still = torch.eye(2, dtype=torch.float64, device=used.device)
    own = noise**2 * still if cov is None else cov
    whole = joint_covariance(torch.where(used[..., None, None], own, still))
    if moved is not None:
        each = moved.movedim(-1, 0)  # (N, K, 2 C)
        whole = whole + each.mT @ each
    weight, _ = inverse_covariances(whole)
    assert weight is not None
    return weight


def fit_pairs(
    rig: Rig,
    left: Tensor,
    right: Tensor,
    cov: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    noise: Tensor | float = 1.0,
    by_camera: bool = False,
    differentiated: bool = False,
) -> ViewsFit:
    """The most likely point of each pixel pair, in the left camera's frame: weighed by the marks' noise alone.

    A pair counts as a whole: `sight_lines` says which have a point.

    Args:
        rig: two cameras and their relative pose.
        left: (..., N, 2) float64 pixels.
        right: (..., N, 2).
        cov: (..., N, 4, 4) covariance of each pair's four coordinates; `noise` squared times the identity if left out.
        mask: (..., N) bool; what is False is neither read nor differentiated.
        noise: standard deviation of a pixel along each axis where there is no covariance, px.
        by_camera: see `most_likely`.
        differentiated: see `most_likely`.
    """
    finite = torch.isfinite(left + right).all(-1)
    wanted = finite if mask is None else finite & mask
    if not known_true(wanted):
        left = torch.where(wanted[..., None], left, rig.left.center.detach())
        right = torch.where(wanted[..., None], right, rig.right.center.detach())
    with torch.no_grad():
        lines = sight_lines(rig, left, right)
        weight, sound = inverse_covariances(cov)
        flags = (~sound, PositionStatus.BAD_COVARIANCE), (~finite, PositionStatus.NOT_FINITE)
        code = flagged(lines.status, *flags, *([] if mask is None else [(~mask, PositionStatus.MASKED)]))
        met = code == int(PositionStatus.OK)
        usable = met | ((code == int(PositionStatus.PARALLEL)) & ~lines.along_baseline)
        scale = rig.baseline.detach()
        distance = torch.where(met, torch.linalg.vector_norm(lines.points, dim=-1), 1.0)
        ahead = torch.where(met[..., None], lines.points / distance[..., None], lines.rays[..., 0, :])
        start = torch.where(met, scale / distance, 0.0)
    if differentiated and cov is not None:
        weight, _ = inverse_covariances(cov)
    rotation, translation = rig.right_from_left_rotation, rig.right_from_left_translation
    still = torch.eye(3, dtype=torch.float64, device=rotation.device)
    cameras = (
        RelativeCamera(rig.left, still, torch.zeros_like(translation)),
        RelativeCamera(rig.right, rotation, translation),
    )
    pixels = torch.cat([left, right], -1).mT
    fit = most_likely(
        cameras, scale, (ahead, start), pixels, usable, weight, by_camera=by_camera, differentiated=differentiated
    )
    used = usable[..., None].expand(*usable.shape, 2)
    first = torch.tensor([True, False], device=used.device).expand(used.shape)
    variance = noise**2 if cov is None else 1.0
    return ViewsFit(
        fit, scale, first, torch.zeros_like(translation), lines.rays, used, code, usable, weight, variance, None
    )


class Reach(NamedTuple):
    """One over the range, whose errors are Gaussian at any distance, and what follows from it: see `Localization`."""

    inverse_range: Tensor
    inverse_range_sigma: Tensor
    range_low: Tensor
    range_high: Tensor
    status: Tensor


def reach_of(found: ViewsFit, variance: Tensor, behind: Tensor | None = None) -> Reach:
    """Range and status of fitted points, given the variance (..., N) of `fit.inverse`.

    `BEARING_ONLY` where the parallax is below three of its sigmas, PARALLEL where the inverse range is not positive,
    BEHIND what is `behind` (..., N) a camera that saw it.
    """
    fit, usable, code, unit = found.fit, found.fitted, found.status, found.scale * found.length
    value = torch.where(usable, fit.inverse / unit, 0.0)
    with torch.no_grad():
        known = torch.isfinite(variance) & (variance > 0) & usable
    sigma = torch.sqrt(torch.where(known, variance, 1.0)) / unit
    sigma = found.steady(torch.where(known, sigma, 0.0))
    with torch.no_grad():
        weak = usable & (~known | (value < BEARING_SIGMAS * sigma))
        lost = usable & ~(value > 0)
        # What the closed form put at infinity may have come back in front of the rig.
        back = usable & ~lost & ~weak
        code = flagged(
            code,
            (weak & (code == int(PositionStatus.OK)), PositionStatus.BEARING_ONLY),
            *([] if behind is None else [(behind, PositionStatus.BEHIND)]),
            (lost, PositionStatus.PARALLEL),
            (back if behind is None else back & ~behind, PositionStatus.OK),
        )
    low, high = map(found.steady, range_interval(value, sigma, known))
    return Reach(value, sigma, low, high, code)


def errors_by_camera(rig: Rig) -> tuple[Tensor | None, Tensor | None, tuple[tuple[int, ...], ...]]:
    """What `CommonErrors` contains: `half`, `bending` per unit of k, and `lens`."""
    if rig.root is None or not bool(rig.root.any()):
        return None, None, ()
    root = rig.root.to(rig.center)
    lenses = root[:, : sum(rig.sizes)].split(list(rig.sizes), 1)
    wanted = [tuple(own.any(0).nonzero()[:, 0].tolist()) for own in lenses]
    if len(set(rig.sizes)) == 1:
        # Cameras of one kind are computed together, with the same parameters.
        wanted = [tuple(sorted(set().union(*wanted)))] * len(rig)
    most = max(map(len, wanted))
    parts = [torch.cat([root[:, rig.pose_columns(c)], lenses[c][:, list(own)]], 1) for c, own in enumerate(wanted)]
    rows = [torch.nn.functional.pad(part, (0, most - len(own))) for part, own in zip(parts, wanted, strict=True)]
    return torch.stack(rows, 1), root[:, -1], tuple(wanted)
