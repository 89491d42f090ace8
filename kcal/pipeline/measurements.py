"""Turn pixels of one moment into what a filter measures: rows of unit noise, with every error's effect on them.

Where the lines of sight of the cameras that saw an object meet (`kcal.locate.views`) is told by three numbers: two
across the line of sight of the first of them, and the inverse range from it. The pixels are nearly linear in them at
any range. They are rows, whitened, so that those of cameras that saw nothing are zeros beside a noise of one and change
nothing. One camera alone gives two rows: its inverse range is then that of the track.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.locate.multi_localizer import MultiViewLocalizer, common_errors, posed_cameras
from kcal.locate.views import ALONE_M, KnownViews, known_views, view_rows
from kcal.pipeline.small_matrices import outer, product


class Sightings(NamedTuple):
    """N objects of one moment, seen by some of V cameras; the last axis of all counts them. M = 2 V rows of unit noise.

    The point is place + direction / inverse, in the rig's frame.

    Attributes:
        anchor: (N,) number of the first camera that saw it.
        place: (3, N) where that camera stands.
        direction: (3, N), of unit length to first order.
        inverse: (N,) one over meters; may be negative.
        by_ray: (3, 3, N) rows: change of (a, b, inverse) by a change of the ray that is proportional to `direction`.
        value: (M, N) measured minus predicted at that point.
        late: (V, M, 3, N) change of the rows by (a, b, inverse), for the pixels of each camera: how they move by rates
            of these if its mark is a second late.
        shared: (M, K, N) effect of K independent unit errors on the rows: of the calibration, and those that last.
        bent: (M, N) change of the predicted rows by a larger k / 2R, for each meter; of one camera alone.
        time: (V, N) seconds; that of the anchor where nothing was seen.
        row: (V, N) row of the mark, -0.5 at the top of the image to 0.5 at its bottom.
        seen: (V, N) bool.
        alone: (N,) bool: one camera saw it.
        usable: (N,) bool: the rays exist.
    """

    anchor: Tensor
    place: Tensor
    direction: Tensor
    inverse: Tensor
    by_ray: Tensor
    value: Tensor
    late: Tensor
    shared: Tensor
    bent: Tensor
    time: Tensor
    row: Tensor
    seen: Tensor
    alone: Tensor
    usable: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value.index_select(-1, which) for value in self))


def known_sightings(localize: MultiViewLocalizer) -> KnownViews:
    """What `sightings` needs of a rig; the calibration's errors are those that `localize` includes."""
    return known_views(posed_cameras(localize), common_errors(localize))


@torch.no_grad()
def sightings(
    known: KnownViews,
    pixels: Tensor,
    seen: Tensor,
    covariance: Tensor,
    time: Tensor,
    lasting_px: float = 0.0,
) -> Sightings:
    """Measure objects of one moment.

    Args:
        known: from `known_sightings`.
        pixels: (N, V, 2), and what follows: as in `ObjectViews`.
        seen: (N, V) bool.
        covariance: (N, 2 V, 2 V).
        time: (N, V) seconds.
        lasting_px: standard deviation along each axis of errors that stay as long as a target, in the marks of all
            cameras but the first.
    """
    rows = view_rows(known, pixels, seen, covariance)
    white, used, cameras = rows.white, rows.used, len(rows.used)
    each = white.unflatten(1, (cameras, 2)).transpose(0, 1)  # (V, M, 2, N)
    late = (each[:, :, :, None] * rows.jacobian.unflatten(0, (cameras, 2))[:, None]).sum(2)
    # Of the common errors, of the residual, and of what light bends.
    changes = torch.cat([rows.shared, rows.residual[:, None]], 1)
    shared, more, value = (-product(white, changes)).split([changes.shape[1] - 2, 1, 1], 1)
    if lasting_px:
        shared = torch.cat([shared, lasting_px * white[:, 2:]], 1)
    first, second = rows.sides
    clock = time.T
    row = pixels[..., 1].T / known.size[:, 1:] - 0.5
    return Sightings(
        anchor=rows.anchor,
        place=rows.place,
        direction=rows.direction,
        inverse=rows.inverse,
        by_ray=torch.stack([first, second, -rows.inverse * rows.direction]),
        value=value[:, 0],
        late=late,
        shared=shared,
        bent=torch.where(rows.alone, more[:, 0] / -ALONE_M, 0.0),
        time=torch.where(used, clock, clock.gather(0, rows.anchor[None])),
        row=torch.where(used, row, 0.0),
        seen=used,
        alone=rows.alone,
        usable=rows.fitted,
    )


class Anchored(NamedTuple):
    """Sightings in frames of tracks: x / z, y / z and 1 / z there.

    Attributes:
        place: (3, N) of the point around which rows are linear.
        value: (M, N) measured minus predicted there.
        late: (V, M, 3, N) rows by the three.
        shared: (M, K, N).
        ahead: (N,) bool: in front of the frame's plane.
    """

    place: Tensor
    value: Tensor
    late: Tensor
    shared: Tensor
    ahead: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value.index_select(-1, which) for value in self))


def anchored(
    seen: Sightings,
    frame: Tensor,
    home: Tensor,
    predicted: Tensor | None = None,
    bending: Tensor | None = None,
    k: float = 0.0,
) -> Anchored:
    """Express sightings in frames.

    Args:
        seen: N of them.
        frame: (3, 3, N) rotations from the rig's axes.
        home: (3, N) where the frames have their origins, in the rig's frame.
        predicted: (3, N) x / z, y / z, 1 / z of tracks: where one camera alone saw something, its range is theirs.
        bending: (K,) change of k / 2R by the first K shared errors.
        k: k / 2R.
    """
    apart = seen.place - home
    inverse, value, shared, direction = seen.inverse, seen.value, seen.shared, seen.direction
    if predicted is not None:
        ray = torch.cat([predicted[:2], torch.ones_like(predicted[:1])])
        line = (frame * ray[:, None]).sum(0) - predicted[2] * apart
        along = (line * direction).sum(0)
        there = torch.where(along > 0, predicted[2] / along.clamp_min(1e-12), 0.0).clamp_min(2e-6)
        inverse = torch.where(seen.alone, there, inverse)
        # Light bends more on a longer way.
        more = seen.bent * (torch.where(seen.alone, 1.0 / inverse, ALONE_M) - ALONE_M)
        value = value - k * more
        if bending is not None:
            rest = len(shared[0]) - len(bending)
            shared = shared - torch.nn.functional.pad(outer(more, bending[:, None]), (0, 0, 0, rest))
    ray = (frame * (direction + inverse * apart)).sum(1)
    length = ray.square().sum(0).sqrt()
    ahead = seen.usable & (ray[2] > 0.1 * length)
    axis = torch.eye(3, dtype=ray.dtype, device=ray.device)[2, :, None]
    ray = torch.where(ahead, ray, axis)
    depth = ray[2]
    # What a change of (x, y, 1 / z) makes of the ray, times z; and of (a, b, inverse).
    by_ray = product(seen.by_ray, torch.cat([frame[:2].transpose(0, 1), -apart[:, None]], 1))
    last = torch.zeros_like(by_ray)
    last[2, 2] = 1.0
    turn = depth * (by_ray + last)
    late = (seen.late[:, :, :, None] * turn).sum(2)
    return Anchored(torch.cat([ray[:2], inverse[None]]) / depth, value, late, shared, ahead)
