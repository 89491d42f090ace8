"""Find the region where a lens model is valid, around the axis before a fold or pole, and its outline."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import known_true, may_branch
from kcal.lens.distortion import Distorted, check_coefficients, distort_components
from kcal.lens.fold_proof import SECTORS, prove_regular
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, largest_radius, to_pixels
from kcal.lens.zernike import unbind_last

# Find the region where a lens model is valid: the part around the optical axis before it folds or meets a pole.
#
# The distortion of Eq. 4 is no bijection of the plane. Along every direction from the axis there is a first place where
# the Jacobian's determinant, the radial denominator or the tilt's w is no longer positive. Beyond it the formula does
# not describe the lens. `valid_region` walks outward along 64 directions to that place. A map without folds that takes
# the edge of a region once around the origin is one-to-one inside. Where the edge does not (two folds can meet in a
# cusp, inside which a pixel has several preimages), the region is shrunk until it does.
#
# A walk in steps misses narrow folds. So it is then proven that each direction has no fold before the end of the region
# or a single one (`kcal.lens.fold_proof`). Where this cannot be proven, narrow wedges are cut out of the region, or it
# is shrunk. For a lens without prism terms that is all within a disc: its Jacobian is symmetric, and a disc where it is
# positive definite is one-to-one. With prism terms, and beyond the disc, samples of the edge, 1024 around, tell whether
# it goes once around.
#
# For a lens without tangential, prism and tilt terms the region is a disc. For others it is the union of the largest
# disc about the axis and the regular part of what a short Fourier series encloses. The series describes the reciprocal
# of the limit as a function of the direction, rounded up so that it stays inside the 64 places.

DIRECTIONS = 64
_HARMONICS = 6
# Largest reach of the region, relative to the largest disc; tried in this order until the lens is one-to-one inside.
_CAPS = (math.inf, 8.0, 4.0, 2.5, 1.7, 1.3, 1.15, 1.05, 1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.05, 0.02, 0.01, 0.0)
# The limit is smooth along the directions: within this fraction of the smallest limit, no fold lies between two.
SURE = 0.95
# Farthest that regularity is proven. An edge beyond it is one that the series leaves open.
_FARTHEST = 1e3
# A region that is shrunk stays so far inside what is proven, because its series is smooth and the proof is not.
_INSIDE = 0.999
# Sectors of 1024 by which a cut is wider, on either side, than what could not be proven: around the end of a fold, the
# images of points beside it overlap, too.
_BESIDE = 2


class Region(NamedTuple):
    """The valid region of a lens on the plane z = 1 (for a fisheye, on the plane of angles).

    Attributes:
        radius: (...) radius of the largest disc about the axis inside the region.
        edge: (..., 13) Fourier series of the reciprocal distance of the edge: the constant, then cosine and sine of
            once, twice, ... the direction.
        cuts: (..., K, 4) wedges that do not belong to it: the points at a distance beyond the last number in directions
            whose cosine to (first, second) is above the third. K is zero for nearly all lenses.
    """

    radius: Tensor
    edge: Tensor
    cuts: Tensor

    def covers(self, x: Tensor, y: Tensor, fraction: float = 1.0) -> Tensor:
        """Whether points (..., N) lie in the disc, or in a fraction of it."""
        radius = self.radius[..., None] * fraction
        return torch.addcmul(x * x, y, y) < radius * radius

    def fraction(self, x: Tensor, y: Tensor) -> Tensor:
        """Distance of points (..., N) from the axis, as a fraction of that to the edge that the series describes."""
        distance = torch.sqrt(torch.addcmul(x * x, y, y))
        scale = torch.clamp(distance, min=1e-300).reciprocal()
        return distance * _evaluate_series(self.edge, x * scale, y * scale)

    def encloses(self, x: Tensor, y: Tensor) -> Tensor:
        """Whether points (..., N) lie within the outline and in no cut, as the whole valid region does."""
        enclosed = self.covers(x, y) | (self.fraction(x, y) < 1.0)
        if not self.cuts.shape[-2]:
            return enclosed
        along_x, along_y, cosine, start = self.cuts[..., None].unbind(-2)
        distance = torch.sqrt(torch.addcmul(x * x, y, y))[..., None, :]
        inside = along_x * x[..., None, :] + along_y * y[..., None, :] > cosine * distance
        return enclosed & ~(inside & (distance > start)).any(-2)

    def outline(self, count: int) -> Tensor:
        """Points (..., count, 2) on the edge of the region, clockwise as seen in the image, the first on the x axis."""
        unit_x, unit_y = directions(count, self.edge)
        reciprocal = _evaluate_series(self.edge, unit_x, unit_y)
        reach = torch.maximum(self.radius[..., None], reciprocal.reciprocal())
        return torch.stack([reach * unit_x, reach * unit_y], -1)

    def sector_reach(self) -> Tensor:
        """Bound of the distance of the edge from the axis in each sector of `kcal.lens.fold_proof`, (..., 1024)."""
        reciprocal = _evaluate_series(self.edge, *directions(SECTORS, self.edge))
        lowest = torch.minimum(reciprocal, reciprocal.roll(-1, -1))
        # Between two places the series dips no deeper than its second derivative lets it.
        squares = torch.arange(1, _HARMONICS + 1, dtype=torch.float64, device=self.edge.device) ** 2
        curvature = self.edge[..., 1:].abs() @ squares.repeat_interleave(2)
        lowest = lowest - curvature[..., None] * (0.125 * (2 * math.pi / SECTORS) ** 2)
        # An edge that is nowhere is beyond every proof.
        return torch.maximum(self.radius[..., None], torch.where(lowest > 0, lowest.reciprocal(), torch.inf))


def _evaluate_series(edge: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Evaluate the series at directions given by their cosine and sine."""
    constant, *rest = unbind_last(edge)
    double = 2.0 * cosine
    value = torch.addcmul(torch.addcmul(constant, rest[0], cosine), rest[1], sine)
    c, c_before, s, s_before = cosine, torch.ones_like(cosine), sine, torch.zeros_like(sine)
    for k in range(1, _HARMONICS):
        c, c_before, s, s_before = double * c - c_before, c, double * s - s_before, s
        value = torch.addcmul(torch.addcmul(value, rest[2 * k], c), rest[2 * k + 1], s)
    return value


def _fit_series(limits: Tensor) -> Tensor:
    """Fit a series (..., 13) that stays within limits (..., 64) at each of the directions."""
    angle = torch.arange(DIRECTIONS, dtype=torch.float64, device=limits.device) * (2 * math.pi / DIRECTIONS)
    waves = [f(k * angle) for k in range(1, _HARMONICS + 1) for f in (torch.cos, torch.sin)]
    basis = torch.stack([torch.ones_like(angle), *waves], -1)
    weights = basis * (2.0 / DIRECTIONS)
    weights[:, 0] *= 0.5
    # A lens that is irregular on the axis has a limit of zero; 1e100 stands for its reciprocal.
    wanted = limits.clamp(min=1e-100).reciprocal()
    series = wanted @ weights
    raise_by = (wanted - series @ basis.T).amax(-1).clamp(min=0.0)
    return torch.cat([series[..., :1] + raise_by[..., None], series[..., 1:]], -1)


def directions(count: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine (count,) of evenly spread directions, the first on the x axis."""
    angle = torch.arange(count, dtype=torch.float64, device=like.device) * (2 * math.pi / count)
    return torch.cos(angle), torch.sin(angle)


@torch.no_grad()
def direction_limits(coefficients: Tensor, model: LensModel, count: int) -> Tensor:
    """Distance (..., count) of the first place along each of `count` directions where the lens is not regular."""
    unit_x, unit_y = directions(count, coefficients)

    def determinants(radius: Tensor) -> Tensor:
        """For radii (..., K, count), one column per direction: the determinant before any pole, -1 beyond."""
        x, y = (radius * unit_x).flatten(-2), (radius * unit_y).flatten(-2)
        lens = distort_components(x, y, coefficients, model)
        return torch.where(lens.positive, lens.determinant, -1.0).unflatten(-1, (-1, count))

    # Outward in steps of 1/6°; then the interval is split in 32 again and again, until it is as narrow as rounding.
    # Rounding does not put the last of them beyond the disc of a hybrid lens, which is regular there as a rule.
    top = largest_radius(model) * (1.0 - 1e-15)
    steps = torch.linspace(0, top if model.wide else math.atan(top), 535, dtype=torch.float64)
    radii = (steps if model.wide else torch.tan(steps)).to(coefficients.device)[:, None].expand(-1, count)
    if model.hybrid:
        # Its field is smooth: where every third is farther above zero than it bends, those between are above zero, too.
        few = determinants(radii[::3])
        if known_true(few.amin((-2, -1)) > few.diff(n=2, dim=-2).abs().amax((-2, -1))):
            return radii[-1].expand(*few.shape[:-2], -1)
    fractions = torch.linspace(0, 1, 33, dtype=torch.float64, device=coefficients.device)[:, None]
    for _ in range(11):
        regular = (determinants(radii) > 0).to(torch.int64).cumprod(-2).sum(-2)
        radii = radii.expand(*regular.shape[:-1], -1, -1)
        # A lens that is irregular on the axis itself, for example with a tilt beyond 90°, has a limit of zero.
        low = torch.gather(radii, -2, (regular - 1).clamp(min=0)[..., None, :])
        high = torch.gather(radii, -2, regular.clamp(max=radii.shape[-2] - 1)[..., None, :])
        if known_true(low == high):
            break
        radii = low + (high - low) * fractions
    return low[..., 0, :]


def _winds_once(x: Tensor, y: Tensor) -> Tensor:
    """Whether closed curves (..., M) run around the origin exactly once and never backwards, (...)."""
    scale = torch.sqrt(x * x + y * y).clamp(min=1e-300)
    x, y = x / scale, y / scale
    next_x, next_y = x.roll(-1, -1), y.roll(-1, -1)
    cross, dot = x * next_y - y * next_x, x * next_x + y * next_y
    total = torch.atan2(cross, dot).sum(-1)
    return (cross > 0).all(-1) & (total < 3 * math.pi)


@torch.no_grad()
def valid_region(coefficients: Tensor, model: LensModel | str) -> Region:
    """Find where a lens is valid.

    The region of a hybrid lens is found by samples alone. So is that of every lens while Python must not branch on
    values (compile, export, vmap); cameras bring theirs along. A pinhole is valid everywhere.

    Args:
        coefficients: (..., P).
        model: a `LensModel` or the name of one.

    Raises:
        InputError: the wrong number of coefficients.

    Example:
        >>> k = torch.tensor([-1.0 / 12.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        >>> region = valid_region(k, "opencv4")  # x - x³/12 turns back at x = 2
        >>> round(float(region.radius), 12), [round(float(c), 12) for c in region.outline(4)[0]]
        (2.0, [2.0, 0.0])
    """
    model = LensModel.named(model)
    coefficients = check_coefficients(coefficients, model)
    limits = direction_limits(coefficients, model, 1 if model.radial else DIRECTIONS)
    region = sampled_region(coefficients, model, limits)
    if model.hybrid or not model.size or not may_branch(coefficients):
        return region
    reach = limits if model.radial else region.sector_reach()
    lenses = coefficients.expand(*limits.shape[:-1], model.size).reshape(limits[..., 0].numel(), model.size)
    wanted = lenses, reach.reshape(-1, reach.shape[-1]).clamp(max=_FARTHEST), SURE * region.radius.reshape(-1)
    # A few lenses at a time, because each has thousands of cells.
    proofs = [prove_regular(c, model, r, d) for c, r, d in zip(*(value.split(16) for value in wanted), strict=True)]
    positive, single = (torch.cat(part) for part in zip(*proofs, strict=True))
    positive, single = positive.reshape(limits.shape[:-1]), single.reshape(reach.shape)
    settled = bool((single >= reach).all())
    if model.radial:
        if settled:
            return region
        positive = prove_regular(lenses, model, wanted[1], wanted[1][:, 0])[0].reshape(limits.shape)
        return sampled_region(coefficients, model, torch.where(single >= reach, limits, positive))
    if not settled:
        region = _proven_part(coefficients, model, limits, region, single)
    # The disc in which no further check is needed must be proven, too.
    smaller = positive < SURE * region.radius
    return region._replace(radius=torch.where(smaller, positive / SURE, region.radius))


def _proven_part(coefficients: Tensor, model: LensModel, limits: Tensor, region: Region, single: Tensor) -> Region:
    """The part of a region where each direction has at most one fold, up to the radii `single` of the sectors."""
    # The two sixty-fourths of the circle beside each direction.
    blocks = single.unflatten(-1, (DIRECTIONS, -1)).amin(-1)
    within = torch.minimum(limits, _INSIDE * torch.minimum(blocks, blocks.roll(1, -1)))
    shrunk = sampled_region(coefficients, model, within, single)
    cuts = [
        _narrow_cuts(own, reach)
        for own, reach in zip(single.reshape(-1, SECTORS), region.sector_reach().reshape(-1, SECTORS), strict=True)
    ]
    count = max(0 if own is None else len(own) for own in cuts)
    none = single.new_tensor([0.0, 0.0, 1.0, math.inf])
    padded = [
        none.expand(count, 4) if own is None else torch.cat([own, none.expand(count - len(own), 4)]) for own in cuts
    ]
    narrow = torch.tensor([own is not None for own in cuts], device=single.device).reshape(single.shape[:-1])
    return Region(
        torch.where(narrow, region.radius, shrunk.radius),
        torch.where(narrow[..., None], region.edge, shrunk.edge),
        torch.stack(padded).reshape(*single.shape[:-1], count, 4),
    )


def _narrow_cuts(single: Tensor, reach: Tensor) -> Tensor | None:
    """Wedges (K, 4) around the sectors (1024,) whose `single` falls short of `reach`; None if they are not narrow."""
    short = single < reach
    if int(short.sum()) > SECTORS // 16:
        return None
    wide = short.clone()
    for shift in range(1, _BESIDE + 1):
        wide |= short.roll(shift) | short.roll(-shift)
    first, last = ((wide & ~wide.roll(shift)).nonzero()[:, 0].tolist() for shift in (1, -1))
    wedges = []
    for begin in first:
        count = min((end - begin) % SECTORS for end in last) + 1
        members = torch.arange(begin, begin + count, device=single.device) % SECTORS
        middle, half = (begin + 0.5 * count) * (2 * math.pi / SECTORS), count * (math.pi / SECTORS)
        start = float(torch.where(short[members], single[members], math.inf).amin())
        wedges.append([math.cos(middle), math.sin(middle), math.cos(half), start])
    return single.new_tensor(wedges).reshape(-1, 4)


def sampled_region(coefficients: Tensor, model: LensModel, limits: Tensor, single: Tensor | None = None) -> Region:
    """The largest region within `direction_limits` whose edge is taken once around the origin, by samples.

    With `single`, it also stays within these radii (..., 1024) in each sector.
    """
    none = limits.new_zeros(*limits.shape[:-1], 0, 4)
    if model.radial:
        return Region(limits[..., 0], _fit_series(limits.expand(*limits.shape[:-1], DIRECTIONS)), none)
    smallest = limits.amin(-1, keepdim=True)
    caps = torch.tensor(_CAPS, dtype=torch.float64, device=limits.device)[:, None]
    # An infinite cap times a limit of zero would be NaN.
    capped = torch.minimum(limits[..., None, :], torch.nan_to_num(caps * smallest[..., None, :], nan=0.0, posinf=1e9))
    candidates = Region(capped.amin(-1), _fit_series(capped), none[..., None, :, :])
    # The first is enough for nearly every lens.
    for count in (1, len(_CAPS)):
        some = candidates._replace(radius=candidates.radius[..., :count], edge=candidates.edge[..., :count, :])
        outline = some.outline(SECTORS).flatten(-3, -2)
        lens = distort_components(outline[..., 0], outline[..., 1], coefficients, model, slopes=False)
        fits = _winds_once(lens.x.unflatten(-1, (-1, SECTORS)), lens.y.unflatten(-1, (-1, SECTORS)))
        if single is not None:
            fits = fits & (some.sector_reach() <= single[..., None, :]).all(-1)
        if known_true(fits[..., 0]):
            break
    # The first cap that fits, or the last one, with which nothing is valid.
    first = (fits.to(torch.int64).cumsum(-1) == 0).sum(-1).clamp(max=fits.shape[-1] - 1)[..., None]
    radius = torch.gather(candidates.radius, -1, first)[..., 0]
    edge = torch.gather(candidates.edge, -2, first[..., None].expand(*first.shape, candidates.edge.shape[-1]))
    return Region(radius, edge[..., 0, :], none)


def in_region(
    x: Tensor,
    y: Tensor,
    coefficients: Tensor,
    model: LensModel,
    region: Region,
    lens: Distorted | None = None,
) -> Tensor:
    """Whether points (..., N) of the plane lie in the valid region.

    Near the edge of a lens that is not symmetric, the Jacobian itself is checked, because a fold may lie between two of
    the 64 directions.

    Args:
        x: (..., N).
        y: (..., N).
        coefficients: (..., P).
        model: the lens model.
        region: of the lens.
        lens: the lens at these points with its Jacobian, if already known.
    """
    if model.radial:
        return region.covers(x, y)
    sure = surely_in_region(x, y, region)
    if known_true(sure):
        return sure
    if lens is None:
        lens = distort_components(x, y, coefficients, model)
    return sure | (region.encloses(x, y) & lens.positive & (lens.determinant > 0))


def surely_in_region(x: Tensor, y: Tensor, region: Region) -> Tensor:
    """Whether points (..., N) lie so far inside that no further check is needed."""
    return region.covers(x, y, SURE)


# The valid region of a lens as a polygon in the image.


def image_outline(parameters: Tensor, model: LensModel, region: Region, size: tuple[int, int]) -> Tensor:
    """Map the valid region to the image (width, height): a polygon (V, 2) in pixels.

    Args:
        parameters: (5 + P,) of a single camera.
        model: its lens model.
        region: its valid region.
        size: (width, height) of the image.
    """
    # A little inside the edge: at a pole the edge itself is mapped to infinity.
    x, y = (region.outline(256) * (1.0 - 1e-6)).unbind(-1)
    lens = distort_components(x, y, parameters[len(INTRINSICS) :], model, slopes=False)
    polygon = torch.stack(to_pixels(lens.x, lens.y, parameters), -1)
    return clip_to_image(polygon, size) if bool(region.radius > 0) else polygon[:0]


def clip_to_image(polygon: Tensor, size: tuple[int, int]) -> Tensor:
    """Clip a polygon (V, 2) to the image, whose edges lie half a pixel beyond the outer pixel centers.

    Source: Sutherland and Hodgman (1974), one edge of the image after the other.

    Example:
        >>> triangle = torch.tensor([[-0.5, -0.5], [9.5, -0.5], [-0.5, 9.5]], dtype=torch.float64)
        >>> clip_to_image(triangle, (5, 10)).tolist()
        [[-0.5, -0.5], [4.5, -0.5], [4.5, 4.5], [-0.5, 9.5]]
    """
    width, height = size
    for axis, edge, sign in ((0, -0.5, 1.0), (0, width - 0.5, -1.0), (1, -0.5, 1.0), (1, height - 0.5, -1.0)):
        height_over = sign * (polygon[:, axis] - edge)
        following, height_after = polygon.roll(-1, 0), height_over.roll(-1, 0)
        weight = (height_over / (height_over - height_after))[:, None]
        crossing = polygon + weight * (following - polygon)
        crossing[:, axis] = edge
        keep = torch.stack([height_over >= 0, (height_over > 0) != (height_after > 0)], -1)
        # A corner on the edge is kept as such; its crossing would repeat it.
        keep[:, 1] &= (height_over != 0) & (height_after != 0)
        polygon = torch.stack([polygon, crossing], 1)[keep]
    return polygon


def polygon_area(polygon: Tensor) -> float:
    """Area of a polygon (V, 2) whose corners run clockwise as seen in the image (x right, y down)."""
    (x, y), (next_x, next_y) = polygon.T, polygon.roll(-1, 0).T
    return float(0.5 * (x * next_y - y * next_x).sum())
