"""What a pair of detections costs: squared standard deviations of what no point explains, of its range and its size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.dispatch import is_differentiated
from kcal.locate.multi_localizer import MultiViewLocalizer, common_errors, posed_cameras
from kcal.locate.views import CommonErrors, PosedCameras, ViewsFit, fit_views
from kcal.pipeline.association_options import AssociationOptions

# Spread of the logarithm of an object's size between two views, besides what boxes err: it is seen from two sides.
_SIZE_SPREAD = 0.15
# Numbers that are held at once while pairs are compared, some 100 MB with what is derived from them.
_AT_ONCE = 1 << 19


class PairCosts(NamedTuple):
    """Of L pairs of detections.

    Attributes:
        cost: (L,) squared standard deviations: minus twice the logarithm of the likelihood; infinite where impossible.
        inverse: (L,) one over meters, from the first camera.
        sigma: (L,) its standard deviation.
    """

    cost: Tensor
    inverse: Tensor
    sigma: Tensor


def fit_some(localize: MultiViewLocalizer, cameras: list[int], pixels: Tensor, seen: Tensor, noise: float) -> ViewsFit:
    """Points of pixels (N, C, 2) of some cameras, with all errors that each camera's marks share."""
    posed, common = posed_cameras(localize), common_errors(localize)
    part = PosedCameras(
        [posed.cameras[c] for c in cameras], posed.rotation[cameras], posed.center[cameras],
        None if posed.up is None else posed.up[cameras], posed.bending,
    )  # fmt: skip
    if common is not None:
        common = CommonErrors(tuple(common.lens[c] for c in cameras), common.half[:, cameras], common.bending)
    return fit_views(part, pixels, seen, noise=noise, shared=common, differentiated=is_differentiated(pixels))


def pair_costs(
    localize: MultiViewLocalizer,
    cameras: Tensor,
    pixels: Tensor,
    boxes: Tensor,
    options: AssociationOptions,
    nearest: float | None,
) -> PairCosts:
    """Compare pairs of detections of any two cameras; differentiable by pixels and boxes.

    Args:
        localize: the rig and how well it is known.
        cameras: (L, 2) numbers of two cameras each, on the CPU; pairs of the same two stand together.
        pixels: (L, 2, 2) what stands for the objects.
        boxes: (L, 2, 4) x1, y1, x2, y2.
        options: of the association.
        nearest: smallest range, meters; None: any.

    Example:
        >>> from kcal.locate.stations import stations_of
        >>> from kcal.rig import planned_rig
        >>> rig, pixels = stations_of(planned_rig()), torch.tensor([[[960.0, 540.0], [944.0, 540.0]]]).double()
        >>> boxes, both = torch.cat([pixels - 5.0, pixels + 5.0], -1), torch.tensor([[0, 1]])
        >>> found = pair_costs(MultiViewLocalizer(rig), both, pixels, boxes, AssociationOptions(), 100.0)
        >>> round(float(found.cost), 6), round(1.0 / float(found.inverse))
        (0.0, 1000)
    """
    errors = 0 if localize.errors is None else len(localize.errors)
    count = _AT_ONCE // (16 + 8 * errors) + 1
    if len(cameras) > count:
        each = zip(cameras.split(count), pixels.split(count), boxes.split(count), strict=True)
        parts = [pair_costs(localize, *some, options, nearest) for some in each]
        return PairCosts(*(torch.cat(values) for values in zip(*parts, strict=True)))
    which, place = np.unique(cameras.numpy(), return_inverse=True)
    at = torch.from_numpy(place).reshape(-1, 2).to(pixels.device)
    rows = torch.arange(len(cameras), device=pixels.device)[:, None]
    spread = pixels.new_zeros(len(cameras), len(which), 2).index_put((rows, at), pixels)
    seen = torch.zeros(spread.shape[:2], dtype=torch.bool, device=pixels.device)
    seen[rows, at] = True
    found = fit_some(localize, which.tolist(), spread, seen, options.box_sigma)
    fit = found.fit
    total = found.chi2
    length = fit.direction.square().sum(0).sqrt()
    inverse = fit.inverse / (found.scale * length)
    variance = found.variance * fit.covariance[5]
    known = variance.detach() > 0
    sigma = torch.where(known, torch.where(known, variance, 1.0).sqrt() / (found.scale * length), 0.0)
    beyond = (1.0 / options.farthest - inverse).clamp_min(0.0)
    before = (inverse - 1.0 / nearest).clamp_min(0.0) if nearest else torch.zeros_like(inverse)
    total = total + (torch.maximum(beyond, before) / torch.where(known, sigma, 1.0)).square()
    magnified = torch.stack([torch.linalg.vector_norm(p.by_point, dim=(-3, -2)) for p in fit.projections], 1)
    rays = found.rays[rows, at]
    parallax = torch.linalg.vector_norm(torch.linalg.cross(rays[:, 0], rays[:, 1]), dim=-1)
    total = total + size_cost(magnified[rows, at], boxes, options.box_sigma, parallax)
    # On different sides of the line that joins the cameras, lines of sight meet nowhere: a false optimum.
    apart = localize.rig.center[cameras[:, 1].to(rays.device)] - localize.rig.center[cameras[:, 0].to(rays.device)]
    along = (rays * apart[:, None]).sum(-1).prod(-1)
    one_side = apart.square().sum(-1) * (rays[:, 0] * rays[:, 1]).sum(-1) > along
    good = found.fitted & one_side & known & (found.used.sum(-1) == 2)
    return PairCosts(torch.where(good, total, torch.inf), inverse, sigma)


def size_cost(magnified: Tensor, boxes: Tensor, box_sigma: float, parallax: Tensor) -> Tensor:
    """(L,) squared standard deviations between the sizes of boxes (L, 2, 4), given how much cameras magnify (L, 2).

    `parallax` (L,): sine of the angle between the lines of sight. From another side, an object may have another size.
    """
    sizes = boxes[..., 2:] - boxes[..., :2]
    ratio = (sizes[:, 0] / sizes[:, 1]).log() - (magnified[:, 0] / magnified[:, 1]).log()[:, None]
    # Middles of boxes err by box_sigma, so edges by √2 and sizes by twice as much.
    spread = (2.0 * box_sigma / sizes).square().sum(1) + _SIZE_SPREAD**2 + parallax.square()[:, None]
    return (ratio.square() / spread).sum(-1)
