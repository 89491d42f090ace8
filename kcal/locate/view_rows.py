"""Pixels of any subset of cameras as rows that are linear around where their lines of sight meet.

A filter takes these in as they are: it needs no optimum, and neither a status nor a covariance of each point. A point
is told from its anchor, the first camera that saw it, by a direction and an inverse distance, as in
`kcal.locate.views`. What does not change from one moment to the next is prepared once (`known_views`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.camera_stack import CameraStack, camera_stack, project_stack, unproject_each
from kcal.lens.pose import side_axes
from kcal.locate.angular import Found, baseline_axes, first_seen, meeting_points, triangulate_angular
from kcal.locate.bent_light import LIGHT_HORIZON
from kcal.locate.views import CommonErrors, PosedCameras, sound_covariances

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
