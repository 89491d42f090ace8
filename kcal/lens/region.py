"""Where a lens model is a lens: the part around the optical axis before it folds back or meets a pole.

The distortion of Eq. 4 is no bijection of the plane. Seen from the axis along any direction there is a first place
where the Jacobian's determinant, the radial denominator or the tilt's w is no longer positive, and what lies beyond it
is not the lens. `valid_region` walks outward along 64 directions to that place. A map without folds that takes the
edge of a region once around the origin is one-to-one inside; where the edge does not (two folds can meet in a cusp,
inside which a pixel has several preimages), the region is pulled in until it does.

For a lens without tangential, prism and tilt terms the region is a disc. For others it is the union of the largest
disc about the axis and the regular part of the polygon through the 64 places.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.distortion import check_coefficients, distort_components
from kcal.lens.eager import known_true
from kcal.lens.model import LensModel
from kcal.lens.plane import largest_radius

_QUARTER = 16
DIRECTIONS = 4 * _QUARTER
# How far beyond the smallest disc the region may reach, or how far inside it must stay, until it is one-to-one.
_CAPS = (math.inf, 8.0, 4.0, 2.5, 1.7, 1.3, 1.15, 1.05, 1.0, 0.8, 0.6, 0.4, 0.2)

# The limit is smooth along the directions: within this fraction of the smallest one no fold hides between two of them.
_SURE = 0.95


class Region(NamedTuple):
    """The valid region on the plane z = 1 (for a fisheye, on the plane of angles).

    Attributes:
        radius: (...) of the largest disc about the axis inside the region.
        corners: (..., 64, 2) of the polygon, clockwise as seen in the image, beginning on the x axis.
    """

    radius: Tensor
    corners: Tensor

    def covers(self, x: Tensor, y: Tensor, fraction: float = 1.0) -> Tensor:
        """Whether points (..., N) lie in the disc, or in a fraction of it."""
        radius = self.radius[..., None] * fraction
        return torch.addcmul(x * x, y, y) < radius * radius

    def fraction(self, x: Tensor, y: Tensor) -> Tensor:
        """How far out points (..., N) lie, as a fraction of the way to the polygon's edge.

        Directions are told by y / (|x| + |y|), a stand-in for the angle that needs no trigonometry. The corners are
        evenly spaced in it, and along an edge the reciprocal of |x| + |y| is linear in it.
        """
        length = x.abs() + y.abs()
        slope = y / torch.clamp(length, min=1e-300)
        turn = torch.where(x < 0, 2.0 - slope, torch.where(slope < 0, slope + 4.0, slope)) * _QUARTER
        index = torch.clamp(turn.floor(), 0, DIRECTIONS - 1)
        weight = turn - index
        near = torch.nan_to_num(index).to(torch.int64)
        reciprocal = self.corners.abs().sum(-1).reciprocal()
        reciprocal = torch.cat([reciprocal, reciprocal[..., :1]], -1)
        shape = torch.broadcast_shapes(near.shape[:-1], reciprocal.shape[:-1])
        table = reciprocal.expand(*shape, DIRECTIONS + 1)
        near = near.expand(*shape, near.shape[-1])
        low, high = torch.gather(table, -1, near), torch.gather(table, -1, near + 1)
        return length * (low + weight * (high - low))


def directions(count: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors (count,) around the origin, evenly spaced in y / (|x| + |y|) as `Region.fraction` wants them."""
    turn = torch.arange(count, dtype=torch.float64, device=like.device) * (4.0 / count)
    y = torch.where(turn <= 1.0, turn, torch.where(turn <= 3.0, 2.0 - turn, turn - 4.0))
    x = torch.where(turn <= 2.0, 1.0 - turn, turn - 3.0)
    length = torch.sqrt(x * x + y * y)
    return x / length, y / length


@torch.no_grad()
def first_limits(coefficients: Tensor, model: LensModel, count: int) -> Tensor:
    """How far the lens reaches along each of `count` directions, (..., count); see the module's first lines."""
    unit_x, unit_y = directions(count, coefficients)

    def good(radius: Tensor) -> Tensor:
        """Radii (..., K, count), one column a direction -> how many from the first on are regular, (..., count)."""
        x, y = (radius * unit_x).flatten(-2), (radius * unit_y).flatten(-2)
        lens = distort_components(x, y, coefficients, model)
        regular = (lens.positive & (lens.determinant > 0)).unflatten(-1, (-1, count))
        return regular.to(torch.int64).cumprod(-2).sum(-2)

    # From the axis out, 1/6° or so a step; then each interval is split in 32 again until it is as narrow as rounding.
    top = largest_radius(model)
    steps = torch.linspace(0, top if model.fisheye else math.atan(top), 535, dtype=torch.float64)
    radii = (steps if model.fisheye else torch.tan(steps)).to(coefficients.device)[:, None].expand(-1, count)
    fractions = torch.linspace(0, 1, 33, dtype=torch.float64, device=coefficients.device)[:, None]
    for _ in range(11):
        regular = good(radii)
        radii = radii.expand(*regular.shape[:-1], -1, -1)
        # A lens that is irregular on the axis itself (a tilt beyond 90°, say) reaches nowhere: radius zero.
        low = torch.gather(radii, -2, (regular - 1).clamp(min=0)[..., None, :])
        high = torch.gather(radii, -2, regular.clamp(max=radii.shape[-2] - 1)[..., None, :])
        radii = low + (high - low) * fractions
    return low[..., 0, :]


def _winds_once(x: Tensor, y: Tensor) -> Tensor:
    """Whether closed curves (..., M) run around the origin exactly once, never backwards: (...)."""
    scale = torch.sqrt(x * x + y * y).clamp(min=1e-300)
    x, y = x / scale, y / scale
    next_x, next_y = x.roll(-1, -1), y.roll(-1, -1)
    cross, dot = x * next_y - y * next_x, x * next_x + y * next_y
    total = torch.atan2(cross, dot).sum(-1)
    return (cross > 0).all(-1) & (total < 3 * math.pi)


@torch.no_grad()
def valid_region(coefficients: Tensor, model: LensModel | str) -> Region:
    """Measure where a lens is valid.

    Args:
        coefficients: (..., P).
        model: a `LensModel` or a preset's name.

    Raises:
        InputError: the wrong number of coefficients.

    Example:
        >>> k = torch.tensor([-1.0 / 12.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        >>> region = valid_region(k, "opencv4")  # x - x³/12 turns back at x = 2
        >>> round(float(region.radius), 12), [round(float(c), 12) for c in region.corners[0]]
        (2.0, [2.0, 0.0])
    """
    model = LensModel.named(model)
    coefficients = check_coefficients(coefficients, model)
    unit_x, unit_y = directions(DIRECTIONS, coefficients)
    if model.radial:
        radius = first_limits(coefficients, model, 1)[..., 0]
        limits = radius[..., None].expand(*radius.shape, DIRECTIONS)
        return Region(radius, torch.stack([limits * unit_x, limits * unit_y], -1))
    limits = first_limits(coefficients, model, DIRECTIONS)
    smallest = limits.amin(-1, keepdim=True)
    caps = torch.tensor(_CAPS, dtype=torch.float64, device=limits.device)[:, None]
    # No limit times a radius of zero would be NaN.
    capped = torch.minimum(limits[..., None, :], torch.nan_to_num(caps * smallest[..., None, :], nan=0.0, posinf=1e9))
    lens = distort_components(
        (capped * unit_x).flatten(-2), (capped * unit_y).flatten(-2), coefficients, model, slopes=False
    )
    fits = _winds_once(lens.x.unflatten(-1, (-1, DIRECTIONS)), lens.y.unflatten(-1, (-1, DIRECTIONS)))
    # The first cap that fits; close to the axis every regular lens is linear, so the last one stands for it.
    first = (fits.to(torch.int64).cumsum(-1) == 0).sum(-1).clamp(max=len(_CAPS) - 1)
    chosen = torch.gather(capped, -2, first[..., None, None].expand(*first.shape, 1, DIRECTIONS))[..., 0, :]
    return Region(chosen.amin(-1), torch.stack([chosen * unit_x, chosen * unit_y], -1))


def in_region(x: Tensor, y: Tensor, coefficients: Tensor, model: LensModel, region: Region) -> Tensor:
    """Whether points (..., N) of the plane lie in the valid region.

    Near the edge of a lens that is not symmetric the Jacobian itself is asked, so that a fold in between two of the
    64 directions does not go unseen.
    """
    if model.radial:
        return region.covers(x, y)
    sure = region.covers(x, y, _SURE)
    if known_true(sure):
        return sure
    lens = distort_components(x, y, coefficients, model)
    near = region.covers(x, y) | (region.fraction(x, y) < 1.0)
    return sure | (near & lens.positive & (lens.determinant > 0))


def valid_radius(coefficients: Tensor, model: LensModel | str) -> Tensor:
    """Radius (...) of the disc about the axis inside which the lens is valid; see `valid_region`.

    Example:
        >>> round(float(valid_radius(torch.tensor([-0.75, 0.0, 0.0, 0.0], dtype=torch.float64), "opencv4")), 12)
        0.666666666667
    """
    return valid_region(coefficients, model).radius
