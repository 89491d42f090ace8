"""How uncertain positions of a rig of any number of cameras are at a distance, by what to improve."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera_rig import CameraRig
from kcal.locate.multi_localizer import MultiViewLocalizer, ViewsLocalization
from kcal.locate.range_sigmas import RangeSigmas, row_space
from kcal.locate.ranges import BEARING_SIGMAS
from kcal.locate.stereo import PositionStatus

# Where along the middle row of each image, as shares of its width.
_PLACES = (0.2, 0.35, 0.5, 0.65, 0.8)


@torch.no_grad()
def station_sigmas(rig: CameraRig, distance: float, *, pixel_sigma: float = 0.3) -> RangeSigmas | None:
    """Split the standard deviation of ranges from each camera by its sources, where it is worst.

    Looked at are things at a distance from each camera, along the middle row of its image, that another camera sees
    too. Marks, lenses and poses are told apart as by `range_sigmas`; the poses are those of all
    cameras, and `sideways` is zero.

    Args:
        rig: with its `root`; None: lenses and poses count as exact.
        distance: meters.
        pixel_sigma: of a mark along each axis, px.

    Returns:
        the worst place, (1,) each; None where no two cameras see the same at this distance.

    Raises:
        InputError: a distance that is not positive.

    Example:
        >>> from kcal import Camera
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> look = enu_from_cam(0.0).T.repeat(3, 1, 1)
        >>> rig = CameraRig([camera] * 3, ["a", "b", "c"], look, torch.tensor([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]]))
        >>> found = station_sigmas(rig, 1000.0, pixel_sigma=0.1)
        >>> round(float(found.total), 1), bool(found.ranged)
        (4.4, True)
    """
    if not 0.0 < distance < float("inf"):
        raise InputError(f"distance {distance}: a positive number of meters is needed")
    points, rays = _points_before(rig, distance)
    pixels, seen = rig(points)
    some = seen.sum(-1) > 1
    pixels, seen, rays = pixels[some], seen[some], rays[some]
    if not len(pixels):
        return None
    root = torch.zeros(1, rig.quantities, dtype=torch.float64) if rig.root is None else rig.root
    lenses = root[:, : sum(rig.sizes)]
    within = row_space(lenses.T)
    # With exact lenses, what their errors have in common with the poses is known too.
    exact = root - within @ (within.T @ root)
    marks, without, total = (
        _range_sigma(MultiViewLocalizer(rig, pixel_sigma=pixel_sigma, root=known)(pixels, seen), rays, distance)
        for known in (torch.zeros_like(root), exact, root)
    )
    worst = total.nan_to_num(nan=torch.inf).argmax()
    total, marks, without = (value[worst][None] for value in (total, marks, without))
    pose = (without.square() - marks.square()).clamp_min(0.0).sqrt()
    by_lenses = (total.square() - without.square()).clamp_min(0.0).sqrt()
    far = torch.full_like(total, distance)
    return RangeSigmas(far, marks, by_lenses, pose, total, total * BEARING_SIGMAS <= far, torch.zeros_like(total))


def _points_before(rig: CameraRig, distance: float) -> tuple[Tensor, Tensor]:
    """(N, 3) places at a distance from each camera, along the middle row of its image, and their rays (N, 3)."""
    points, all_rays = [], []
    for camera, turn, center in zip(rig.each, rig.rotation, rig.center, strict=True):
        width, height = camera.size
        pixels = torch.tensor([[share * width, 0.5 * height] for share in _PLACES], dtype=torch.float64)
        rays, valid = camera.unproject(pixels)
        all_rays.append((rays / rays.norm(dim=-1, keepdim=True))[valid] @ turn)
        points.append(center + distance * all_rays[-1])
    return torch.cat(points), torch.cat(all_rays)


def _range_sigma(found: ViewsLocalization, rays: Tensor, distance: float) -> Tensor:
    """(N,) meters along rays (N, 3); by the inverse range of what has a bearing only; infinite if unknown."""
    ok = found.status == int(PositionStatus.OK)
    along = (rays * (torch.where(ok[:, None, None], found.covariance, 0.0) @ rays[..., None])[..., 0]).sum(-1).sqrt()
    weak = torch.where(found.inverse_range_sigma > 0, distance**2 * found.inverse_range_sigma, torch.inf)
    return torch.where(ok, along, weak)
