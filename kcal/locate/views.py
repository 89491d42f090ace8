"""Pixels of any subset of cameras to points with errors, each on its own, and as rows that are linear near them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.camera_like import CameraStack, camera_stack, project_each, project_stack, unproject_each
from kcal.lens.pose import side_axes, step_rows
from kcal.locate.angular import (
    LIGHT_HORIZON,
    Found,
    Surroundings,
    baseline_axes,
    first_seen,
    length_of_one,
    lifted,
    meeting_points,
    triangulate_angular,
)
from kcal.locate.max_likelihood import (
    PointFit,
    RelativeCamera,
    inverse_covariances,
    most_likely,
    position_slope,
    symmetric,
)
from kcal.locate.stereo import PositionStatus, flag_positions

# Pixels of any subset of cameras to points with errors, each point on its own.
#
# `TriangulateViews` and `MultiViewLocalizer` share what is here. A point is sought from the first camera that saw it,
# its anchor, as a direction and an inverse distance in the frame of all cameras. Errors that a camera's marks share
# (lens, center, attitude, refraction) are to first order correlated noise of the pixels: a point is weighed by the
# inverse covariance of all of them together, so that a camera whose attitude is poor counts less.

# Share of a view's information that the others must be able to check: below, leaving it out tells nothing.
_UNCHECKED = 1e-9


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

    @property
    def around(self) -> Surroundings:
        """How light bends, in the cameras' axes."""
        if self.up is None:
            return Surroundings()
        return Surroundings(up=(self.rotation @ self.up[..., None])[..., 0], bending=self.bending)


class CommonErrors(NamedTuple):
    """What all marks of a camera have in common: K independent errors.

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
        offset = self.fit.direction.mT[..., None, :] + (self.fit.inverse / self.scale)[..., None, None] * (
            self.place[..., None, :] - center
        )
        return (((offset * self.rays).sum(-1) < 0) & self.used).any(-1) & self.fitted

    @property
    def _weight(self) -> Tensor:
        if self.weight is not None:
            return self.weight
        still = torch.eye(len(self.fit.residual)).to(self.fit.residual)
        return (still / self.variance)[..., None]

    @property
    def chi2(self) -> Tensor:
        """χ² (N,) of the residuals."""
        return (self.fit.residual * (self._weight * self.fit.residual).sum(-2)).sum(-2)

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
        inside = torch.stack([camera.inside(pixels[..., c, :]) for c, camera in enumerate(posed.cameras)], -1)
        used = wanted & valid & inside & sound
        code = torch.full(used.shape[:-1], int(PositionStatus.OK), dtype=torch.int8, device=used.device)
        count = used.sum(-1)
        nothing = count == 0
        for condition, status in (
            (count == 1, PositionStatus.BEARING_ONLY),
            (nothing & ~seen.any(-1), PositionStatus.MASKED),
            (nothing & (seen & ~finite).any(-1), PositionStatus.NOT_FINITE),
            (nothing & (wanted & ~inside).any(-1), PositionStatus.OUTSIDE_IMAGE),
            (nothing & (wanted & inside & ~valid).any(-1), PositionStatus.OUTSIDE_LENS),
            ((wanted & ~sound).any(-1), PositionStatus.BAD_COVARIANCE),
        ):
            code = flag_positions(code, condition, status)
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
            code = flag_positions(code, alone, PositionStatus.OK)
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
    lines = [
        RelativeCamera(camera, turn, turn @ apart[..., c, :].mT)
        for c, (camera, turn) in enumerate(zip(posed.cameras, posed.rotation, strict=True))
    ]
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
    posed: PosedCameras,
    shared: CommonErrors,
    at: tuple[Tensor, Tensor, Tensor],
    used: Tensor,
    scale: Tensor,
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


def _weight(cov: Tensor | None, noise: Tensor | float, used: Tensor, moved: Tensor | None) -> Tensor:
    """(2 C, 2 C, N) inverse covariance of the pixels of used views; the identity for the others."""
    still = torch.eye(2, dtype=torch.float64, device=used.device)
    own = noise**2 * still if cov is None else cov
    own = torch.where(used[..., None, None], own, still)  # (N, C, 2, 2)
    among = torch.eye(used.shape[-1], dtype=torch.float64, device=used.device)
    whole = (own[..., :, :, None, :] * among[:, None, :, None]).flatten(-2).flatten(-3, -2)
    if moved is not None:
        each = moved.movedim(-1, 0)  # (N, K, 2 C)
        whole = whole + each.mT @ each
    weight, _ = inverse_covariances(whole)
    assert weight is not None
    return weight


# Pixels of any subset of cameras as rows that are linear around where their lines of sight meet.
#
# A filter takes these in as they are: it needs no optimum, and neither a status nor a covariance of each point. A point
# is told from its anchor, the first camera that saw it, by a direction and an inverse distance, as in
# `kcal.locate.views`. What does not change from one moment to the next is prepared once (`known_views`).

# Meters at which a bearing of one camera is taken; what light bends elsewhere follows from it.
ALONE_M = 20_000.0


class KnownViews(NamedTuple):
    """C cameras and K errors that their marks have in common.

    Attributes:
        posed: as they stand.
        stack: of the cameras.
        middle: (C, 2) principal points, px.
        size: (C, 2) of the images, px.
        wide: (C, 1) bool: sees also beside and behind itself.
        up: (C, 3, 1) the vertical in each camera's axes; zeros where lines of sight are straight.
        matrices: (C, 3, 4) of `PosedCameras`.
        axes: (3, 3) of two cameras: the line between them and across; None for more.
        baseline: meters between the first camera and the last.
        moves: (C, 3 (K + 1), 5) what each error, and a larger k / 2R, makes of a point in a camera's axes, over its
            distance: by this point, by one over its distance, and by how much one of `up` it is lifted by bending.
        lens: for each camera the parameters that are not exact.
        by_lens: (C, K + 1, Q) their change by each error.
    """

    posed: PosedCameras
    stack: CameraStack
    middle: Tensor
    size: Tensor
    wide: Tensor
    up: Tensor
    matrices: Tensor
    axes: Tensor | None
    baseline: Tensor
    moves: Tensor
    lens: tuple[tuple[int, ...], ...]
    by_lens: Tensor


class ViewRows(NamedTuple):
    """N points of M = 2 C pixel coordinates; the last axis counts points.

    Attributes:
        anchor: (N,) number of the camera from which a point is told; the first one where nobody saw it.
        place: (3, N) its center.
        direction: (3, N) unit vectors in the frame.
        sides: two (3, N) across it.
        inverse: (N,) one over meters; zero where lines of sight do not meet ahead.
        jacobian: (M, 3, N) pixels by steps along the sides and by the inverse distance; zeros of views that do not
            count.
        residual: (M, N) predicted minus measured.
        shared: (M, K + 1, N) pixels by each common error, and by k / 2R.
        white: (M, M, N) U⁻¹ of the covariance U Uᵀ of the pixels, U upper triangular; that of views that do not count
            is the identity.
        used: (C, N) which views count.
        alone: (N,) one view counts.
        fitted: (N,) the lines of sight exist.
    """

    anchor: Tensor
    place: Tensor
    direction: Tensor
    sides: tuple[Tensor, Tensor]
    inverse: Tensor
    jacobian: Tensor
    residual: Tensor
    shared: Tensor
    white: Tensor
    used: Tensor
    alone: Tensor
    fitted: Tensor


@torch.no_grad()
def known_views(posed: PosedCameras, common: CommonErrors | None) -> KnownViews:
    """Prepare cameras, and what is not known of them."""
    cameras, center = posed.cameras, posed.center
    count = len(cameras)
    exact = CommonErrors(tuple(() for _ in cameras), center.new_zeros(0, count, 6), center.new_zeros(0))
    lens, half, bending = exact if common is None else common
    half = torch.nn.functional.pad(half, (0, 0, 0, 0, 0, 1))
    bending = torch.cat([bending, bending.new_ones(1)])
    up = torch.zeros_like(center) if posed.up is None else (posed.rotation @ posed.up[..., None])[..., 0]
    by_center, turn = ((posed.rotation @ part[..., None])[..., 0] for part in (half[..., :3], half[..., 3:6]))
    still = torch.eye(3, dtype=center.dtype, device=center.device).expand(*turn.shape, 3)
    crossed = torch.linalg.cross(turn[..., None, :].expand_as(still), still).mT
    lifts = bending[:, None, None] * up
    moves = torch.cat([-crossed, -by_center[..., None], lifts[..., None]], -1).movedim(0, 1).flatten(1, 2)
    middle = torch.stack([camera.center.detach() for camera in cameras])
    size = center.new_tensor([camera.size for camera in cameras])
    wide = torch.tensor([[camera.model.wide] for camera in cameras], device=center.device)
    axes = baseline_axes(center[1] - center[0]) if count == 2 else None
    return KnownViews(
        posed, camera_stack(cameras), middle, size, wide, up[..., None], posed.matrices, axes,
        torch.linalg.vector_norm(center[-1] - center[0]), moves, lens, half[..., 6:].movedim(0, 1),
    )  # fmt: skip


@torch.no_grad()
def view_rows(known: KnownViews, pixels: Tensor, seen: Tensor, covariance: Tensor) -> ViewRows:
    """Linear rows of objects.

    Args:
        known: the cameras.
        pixels: (N, C, 2) float64, finite where seen.
        seen: (N, C) bool; what is False is not read.
        covariance: (N, 2 C, 2 C) of the pixels of a row, px².
    """
    posed, cameras = known.posed, len(known.middle)
    pixels = torch.where(seen[..., None], pixels, known.middle)
    blocks = covariance.unflatten(-1, (cameras, 2)).unflatten(-3, (cameras, 2)).diagonal(dim1=-4, dim2=-2)
    sound = sound_covariances(blocks.movedim(-1, 1))
    marks = pixels.movedim(0, 1)  # (C, N, 2)
    rays, valid = unproject_each(known.stack, marks)
    shifted = pixels + 0.5
    inside = ((shifted >= 0.0) & (shifted <= known.size)).all(-1)
    used = seen & valid.T & inside & sound
    count = used.sum(-1)
    alone = count == 1
    fitted = alone | ((count > 1) & ~(seen & ~sound).any(-1))
    anchor = first_seen(used).to(torch.int64).argmax(-1)
    in_frame = rays @ posed.rotation
    place = posed.center.T.index_select(1, anchor)
    ray = in_frame[anchor, torch.arange(len(anchor), device=anchor.device)].T
    if known.axes is not None:
        both = in_frame @ known.axes
        found = meeting_points(both[0], both[1], known.axes, known.baseline)
    elif cameras > 1:
        found = triangulate_angular(known.matrices, rays.movedim(0, 1), used)
    else:
        found = Found(torch.zeros_like(ray.T), torch.zeros_like(alone))
    away = torch.where(alone, ALONE_M * ray, found.points.T + (posed.center[0, :, None] - place))
    met = alone | (found.valid & (count > 1))
    away = torch.where(met, away, ray)
    nearness = away.square().sum(0).rsqrt()
    ahead, inverse = away * nearness, nearness * met
    first, second = (side.T for side in side_axes(ahead.T))

    # Axes of each camera: (C, 3, 3 columns, N), and what a larger inverse distance adds.
    turned = (posed.rotation @ torch.stack([first, second, ahead], 1).flatten(1)).unflatten(-1, (3, -1))
    shift = posed.rotation @ (place - posed.center[..., None])
    at = turned[:, :, 2] + inverse * shift
    along = (at * known.up).sum(1, keepdim=True)
    lift = (at.square().sum(1, keepdim=True) - along * along) / inverse.clamp_min(1.0 / LIGHT_HORIZON)
    at = at + (posed.bending * lift) * known.up
    counts = used.T & fitted
    good = counts & ((at[:, 2] > 1e-6) | known.wide)
    # The axis is a harmless stand-in.
    at = torch.where(good[:, None], at, at.new_tensor([[0.0], [0.0], [1.0]]))
    projected = project_stack(known.stack, at, known.lens, inverse)
    by_point, share = projected.by_point, counts.to(at.dtype)[:, None]
    columns = torch.cat([turned[:, :, :2], shift[:, :, None]], 2)
    jacobian = (columns[:, :, :, None] * by_point[:, :, None]).sum(1)  # (C, 3 columns, 2, N)
    if projected.by_meter is not None:
        jacobian = jacobian + torch.nn.functional.pad(projected.by_meter[:, None], (0, 0, 0, 0, 2, 0))
    point = torch.cat([at, inverse.expand_as(lift), lift], 1)
    moved = (known.moves @ point).unflatten(1, (-1, 3))  # (C, K + 1, 3, N)
    shared = (moved[:, :, :, None] * by_point[:, None]).sum(2)
    if known.by_lens.shape[-1]:
        shared = shared + (known.by_lens @ projected.by_camera.flatten(2)).unflatten(-1, (2, -1))
    return ViewRows(
        anchor,
        place,
        ahead,
        (first, second),
        inverse,
        (share[:, :, None] * jacobian).transpose(1, 2).flatten(0, 1),
        (share * (projected.pixels - marks.mT)).flatten(0, 1),
        (share[:, :, None] * shared).transpose(1, 2).flatten(0, 1),
        _whitening(covariance, used),
        used.T,
        alone,
        fitted,
    )


def _whitening(covariance: Tensor, used: Tensor) -> Tensor:
    """`ViewRows.white`; the identity where the covariance of all pixels of a row is none."""
    still = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    both = used[..., None].expand(-1, -1, 2).flatten(1)
    whole = torch.where(both[:, :, None] & both[:, None], covariance, still)
    mirrored = (whole - whole.mT).abs().amax((-2, -1)) <= 1e-6 * whole.abs().amax((-2, -1))
    lower, info = torch.linalg.cholesky_ex((0.5 * (whole + whole.mT)).flip(-2, -1))
    lower = torch.where((mirrored & (info == 0))[:, None, None], lower, still)
    inverse = torch.linalg.solve_triangular(lower, still, upper=False)
    return inverse.flip(-2, -1).movedim(0, -1)
