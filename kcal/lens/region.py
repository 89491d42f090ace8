"""Find the region where a lens model is valid, around the axis before a fold or pole, and its outline."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import known_true, may_branch
from kcal.lens.model import Distorted, LensModel, check_coefficients, distort_components
from kcal.lens.projection import largest_radius
from kcal.lens.zernike import unbind_last
from kcal.texts import briefly

# Find the region where a lens model is valid: the part around the optical axis before it folds or meets a pole.
#
# The distortion of Eq. 4 is no bijection of the plane. Along every direction from the axis there is a first place where
# the Jacobian's determinant, the radial denominator or the tilt's w is no longer positive. Beyond it the formula does
# not describe the lens. `valid_region` walks outward along 64 directions to that place. A map without folds that takes
# the edge of a region once around the origin is one-to-one inside. Where the edge does not (two folds can meet in a
# cusp, inside which a pixel has several preimages), the region is shrunk until it does.
#
# A walk in steps misses narrow folds. So it is then proven that each direction has no fold before the end of the region
# or a single one (`prove_regular`). Where this cannot be proven, narrow wedges are cut out of the region, or it
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


@briefly
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
        """Bound of the distance of the edge from the axis in each sector of `kcal.lens.region`, (..., 1024)."""
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
    return (cross > 0).all(-1) & (torch.atan2(cross, dot).sum(-1) < 3 * math.pi)


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
    return region._replace(radius=torch.where(positive < SURE * region.radius, positive / SURE, region.radius))


def _proven_part(coefficients: Tensor, model: LensModel, limits: Tensor, region: Region, single: Tensor) -> Region:
    """The part of a region where each direction has at most one fold, up to the radii `single` of the sectors."""
    # The two sixty-fourths of the circle beside each direction.
    blocks = single.unflatten(-1, (DIRECTIONS, -1)).amin(-1)
    within = torch.minimum(limits, _INSIDE * torch.minimum(blocks, blocks.roll(1, -1)))
    shrunk = sampled_region(coefficients, model, within, single)
    cuts = list(map(_narrow_cuts, single.reshape(-1, SECTORS), region.sector_reach().reshape(-1, SECTORS)))
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


# Bound smooth functions on intervals of the real line, with certainty: rounding is part of every bound.
#
# A `Jet` encloses all functions whose value and slope at the center of an interval are known to within errors, and
# whose second derivative is bounded on the whole interval. Sums and products of jets enclose those of the functions, so
# that a formula in jets bounds the formula. Where terms cancel at the center they cancel in the bound, too, which plain
# interval arithmetic cannot do; the bounds are exact to second order in the length of the interval.
#
# Source: Moore, Kearfott and Cloud, Introduction to Interval Analysis (2009), Taylor forms.

# Bounds the relative rounding of the value of each formula below, which sums at most 16 terms.
_ROUNDING = 32 * torch.finfo(torch.float64).eps
# Bounds are enlarged by this fraction before they decide, for the rounding of the bounds themselves.
_ENLARGED = 1.0 + 1e-9


@dataclasses.dataclass(frozen=True)
class Jet:
    """Functions on intervals; every tensor is (N,).

    Attributes:
        value: of the function at the center.
        slope: its derivative there.
        bend: bound of the absolute second derivative on the interval.
        value_error: bound of the error of `value`.
        slope_error: bound of the error of `slope`.
        half: half the length of the interval.
    """

    value: Tensor
    slope: Tensor
    bend: Tensor
    value_error: Tensor
    slope_error: Tensor
    half: Tensor

    def size(self) -> tuple[Tensor, Tensor]:
        """Bounds of the absolute value and of the absolute slope on the interval."""
        steepest = self.slope.abs() + self.slope_error + self.bend * self.half
        return self.value.abs() + self.value_error + steepest * self.half, steepest

    def __add__(self, other: Jet) -> Jet:
        value, slope = self.value + other.value, self.slope + other.slope
        return Jet(
            value,
            slope,
            self.bend + other.bend,
            self.value_error + other.value_error + _ROUNDING * value.abs(),
            self.slope_error + other.slope_error + _ROUNDING * slope.abs(),
            self.half,
        )

    def __neg__(self) -> Jet:
        return dataclasses.replace(self, value=-self.value, slope=-self.slope)

    def __sub__(self, other: Jet) -> Jet:
        return self + -other

    def __mul__(self, other: Jet) -> Jet:
        (a, a_slope), (b, b_slope) = self.size(), other.size()
        first, second = self.slope * other.value, self.value * other.slope
        value = self.value * other.value
        error = self.value.abs() * other.value_error + self.value_error * (other.value.abs() + other.value_error)
        slope_error = (
            (self.slope.abs() + self.slope_error) * other.value_error
            + self.slope_error * other.value.abs()
            + (other.slope.abs() + other.slope_error) * self.value_error
            + other.slope_error * self.value.abs()
        )
        return Jet(
            value,
            first + second,
            self.bend * b + 2.0 * a_slope * b_slope + other.bend * a,
            error + _ROUNDING * value.abs(),
            slope_error + _ROUNDING * (first.abs() + second.abs()),
            self.half,
        )

    def sign(self) -> Tensor:
        """1 where the function is positive on the whole interval, -1 where it is negative, 0 where neither is sure."""
        steepest = self.slope.abs() + self.slope_error + 0.5 * self.bend * self.half
        sure = self.value.abs() > (self.value_error + steepest * self.half) * _ENLARGED
        return torch.where(sure, torch.sign(self.value), 0.0)

    def falls(self) -> Tensor:
        """Where the function is certain to fall on the whole interval."""
        return -self.slope > (self.slope_error + self.bend * self.half) * _ENLARGED


class Span:
    """Intervals from `low` to `high` (N,), neither negative, with the powers of their centers and upper ends."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        self.half = (0.5 * (high - low) + _ROUNDING * high) * _ENLARGED
        center = 0.5 * (low + high)
        self._ends = center, center + self.half
        self._powers = [torch.ones_like(center)], [torch.ones_like(center)]

    def _power(self, which: int, power: int) -> Tensor:
        table = self._powers[which]
        while len(table) <= power:
            table.append(table[-1] * self._ends[which])
        return table[power]

    def polynomial(self, coefficients: Sequence[Tensor], powers: Sequence[int], constant: float = 0.0) -> Jet:
        """Bound a polynomial: a constant, and coefficients (N,) of powers of the variable."""
        magnitudes = [c.abs() for c in coefficients]

        def derivative(order: int, which: int, weights: Sequence[Tensor]) -> Tensor:
            total = torch.full_like(self.half, 0.0 if order else constant)
            for weight, power in zip(weights, powers, strict=True):
                if power >= order:
                    rest = self._power(which, power - order)
                    total = torch.addcmul(total, weight, rest, value=math.perm(power, order))
            return total

        bend = derivative(2, 0, coefficients).abs() + self.half * derivative(3, 1, magnitudes)
        return Jet(
            derivative(0, 0, coefficients),
            derivative(1, 0, coefficients),
            bend + _ROUNDING * derivative(2, 1, magnitudes),
            _ROUNDING * derivative(0, 1, magnitudes),
            _ROUNDING * derivative(1, 1, magnitudes),
            self.half,
        )


# Prove where a lens has neither fold nor pole, on cells that cover the plane around its axis.
#
# Between two samples of a determinant any number of folds can hide: where the numerator and the denominator of the
# radial factor nearly cancel, a fold may be as narrow as rounding. So the determinant of the Jacobian is bounded on
# whole cells, intervals of the radius in a sector, and cells that are too large for a
# decision are cut in four.
#
# The tilt is one-to-one wherever it is regular and is left out. Times the third power of the radial denominator D(r²),
# the determinant at radius r and angle φ is, in complex numbers,
#
#     E = H N + D³ |Q|² + Re((D H Q + D² N (3 Q + P)) exp(-iφ)) + Re(D³ Q (2 Q + P) exp(-2iφ)),
#     H = N D + r (N' D - N D')
#
# with the radial numerator N(r²), Q = 2 r (p2 + i p1), and the derivative P by r of the prism terms.
#
# Where in every cell E is positive, or negative, or falls with the radius, E changes its sign at most once in each
# direction. The sign at a point then tells on which side of the fold the point lies.

# Sectors around a lens that is not symmetric, the narrowest that are told apart.
SECTORS = 1024
# A ring has four cells to begin with. A lens may have so many undecided cells; those farthest out are given up first.
_RINGS, _MOST_CELLS = 128, 512
# Cells are cut along the radius down to this fraction of it, and not below this radius.
_SHORTEST, _INNERMOST = 1e-8, 1e-12


class _Cells(NamedTuple):
    """Parts of the plane: radii from `low` to `high` in `width` sectors from the number `sector` on; each (N,)."""

    lens: Tensor
    low: Tensor
    high: Tensor
    sector: Tensor
    width: Tensor

    def take(self, where: Tensor) -> _Cells:
        return _Cells(*(value[where] for value in self))

    def in_four(self, across: Tensor) -> _Cells:
        """Cut each cell in four: its sectors where `across`, else its radii."""
        lens, low, high, sector, width = (value[:, None].expand(-1, 4) for value in self)
        part, across = torch.arange(4, device=low.device), across[:, None]
        start = torch.where(part == 0, low, low + (high - low) * (part / 4))
        end = torch.cat([start[:, 1:], high[:, :1]], 1)
        fewer = width // 4
        cut = (
            lens,
            torch.where(across, low, start),
            torch.where(across, high, end),
            torch.where(across, sector + part * fewer, sector),
            torch.where(across, fewer, width),
        )
        return _Cells(*(value.flatten() for value in cut))


def prove_regular(coefficients: Tensor, model: LensModel, reach: Tensor, disc: Tensor) -> tuple[Tensor, Tensor]:
    """Find how far a lens is proven to be regular.

    Args:
        coefficients: (B, P).
        model: the lens model; not a hybrid one.
        reach: (B, S) how far to prove it in each of the `SECTORS`, the first of which begins at the x axis; S = 1 for a
            radial model.
        disc: (B,) the radius up to which `positive` is asked for.

    Returns:
        positive (B,), the radius of the disc on which the determinant is proven to be positive, as far as asked for;
        and single (B, S), the radius up to which it is proven to change its sign at most once in each direction.
    """
    columns = coefficients.unbind(-1)

    def radial(places: Sequence[int], cells: _Cells, span: Span, factor: int) -> Jet:
        """1 + Σ c_k r^2k; or, with factor 1, r times its derivative."""
        powers = [2 * (k + 1) for k in range(len(places))]
        weights = [columns[i][cells.lens] * float(power**factor) for i, power in zip(places, powers, strict=True)]
        return span.polynomial(weights, powers, constant=1.0 - factor)

    def denominator(cells: _Cells, span: Span) -> Jet:
        return radial(model.denominator_index, cells, span, 0)

    def determinant(cells: _Cells, span: Span) -> Jet:
        numerator = radial(model.numerator_index, cells, span, 0)
        along, pole = numerator + radial(model.numerator_index, cells, span, 1), None
        if model.denominator:
            pole = denominator(cells, span)
            along = along * pole - numerator * radial(model.denominator_index, cells, span, 1)
        if model.radial:
            return along * numerator
        return _around(_waves(columns, model, cells, span, along, numerator, pole), cells)

    positive, single = _prove(determinant, reach, disc)
    if model.denominator:
        pole_positive, pole_single = _prove(denominator, reach.amax(-1, keepdim=True), disc)
        positive, single = torch.minimum(positive, pole_positive), torch.minimum(single, pole_single)
    return positive, single


def _waves(
    columns: Sequence[Tensor], model: LensModel, cells: _Cells, span: Span, along: Jet, numerator: Jet, pole: Jet | None
) -> tuple[Jet, ...]:
    """E as a constant, the factors of the cosine and sine of φ, and those of 2φ; `along` is H, `pole` is D."""
    zero = span.polynomial([], [])
    qx = qy = px = py = zero
    if model.tangential:
        p1, p2 = (columns[model.names.index(name)][cells.lens] for name in ("p1", "p2"))
        qx, qy = span.polynomial([2.0 * p2], [1]), span.polynomial([2.0 * p1], [1])
    if model.prism:
        powers = [2 * k + 1 for k in range(model.prism)]
        px, py = (
            span.polynomial([(n + 1.0) * columns[i][cells.lens] for i, n in zip(index, powers, strict=True)], powers)
            for index in model.prism_index
        )
    more_x, more_y = qx + qx + px, qy + qy + py
    first = along, numerator
    second = qx * qx + qy * qy, qx * more_x - qy * more_y, qx * more_y + qy * more_x
    if pole is not None:
        square = pole * pole
        cube = square * pole
        first = along * pole, numerator * square
        second = second[0] * cube, second[1] * cube, second[2] * cube
    once = (first[0] * q + first[1] * (q + more) for q, more in ((qx, more_x), (qy, more_y)))
    return (along * numerator + second[0], *once, *second[1:])


def _around(waves: tuple[Jet, ...], cells: _Cells) -> Jet:
    """Bound constant + a cos φ + b sin φ + c cos 2φ + d sin 2φ in all directions of each cell."""
    middle, half = (cells.sector + 0.5 * cells.width) * (2 * math.pi / SECTORS), cells.width * (math.pi / SECTORS)
    cosine, sine = torch.cos(middle), torch.sin(middle)
    factors = [torch.ones_like(half), cosine, sine, cosine * cosine - sine * sine, 2.0 * cosine * sine]
    rates = [torch.zeros_like(half), -sine, cosine, -2.0 * factors[4], 2.0 * factors[3]]
    sizes, steepest = zip(*(wave.size() for wave in waves), strict=True)

    def total(parts: Sequence[Tensor], weights: Sequence[Tensor | float]) -> Tensor:
        return sum((part * weight for part, weight in zip(parts, weights, strict=True)), torch.zeros_like(half))

    def error(errors: Sequence[Tensor], centers: Sequence[Tensor], bounds: Sequence[Tensor]) -> Tensor:
        """Of the jets, of rounding, and of other directions than the middle one, to second order."""
        own = total(errors, (1.0,) * 5) + total(bounds, (1e-15,) * 5)
        return own + half * total(centers, rates).abs() + 0.5 * half * half * total(bounds, (0.0, 1.0, 1.0, 4.0, 4.0))

    values, slopes = [wave.value for wave in waves], [wave.slope for wave in waves]
    return Jet(
        total(values, factors),
        total(slopes, factors),
        total([wave.bend for wave in waves], (1.0,) * 5),
        error([wave.value_error for wave in waves], values, sizes),
        error([wave.slope_error for wave in waves], slopes, steepest),
        waves[0].half,
    )


def _prove(bound: Callable[[_Cells, Span], Jet], reach: Tensor, disc: Tensor) -> tuple[Tensor, Tensor]:
    """Radii (B,) and (B, S) up to which a function is positive, and changes its sign at most once per direction."""
    lenses, sectors = reach.shape
    quarters, count = (4, sectors // 4) if sectors > 1 else (1, 1)
    # Evenly in angle, as for a pinhole.
    ends = reach.reshape(lenses * quarters, count).amax(-1, keepdim=True)
    steps = torch.linspace(0.0, 1.0, _RINGS + 1, dtype=torch.float64, device=reach.device)
    edges = torch.cat([torch.tan(torch.atan(ends) * steps[:-1]), ends], 1)
    row = torch.arange(len(ends), device=reach.device)[:, None].expand(-1, _RINGS).flatten()
    cells = _Cells(
        row // quarters,
        edges[:, :-1].flatten(),
        edges[:, 1:].flatten(),
        row % quarters * count,
        torch.full_like(row, count),
    )
    done: list[tuple[_Cells, Tensor, Tensor]] = []
    while len(cells.lens):
        span = Span(cells.low, cells.high)
        jet = bound(cells, span)
        sign, falls = jet.sign(), jet.falls()
        # Shorter cells do not help where the error comes from the width of the sector, or from rounding.
        wide = jet.value_error > (jet.slope.abs() + jet.bend * jet.half) * jet.half
        across = wide & (cells.width > 1)
        helps = (~wide | (jet.slope_error < jet.bend * jet.half)) & (cells.high > _INNERMOST)
        helps &= span.half > _SHORTEST * cells.high
        undecided = (sign == 0) & ~(falls & (cells.low >= disc[cells.lens])) & (across | helps)
        if int(undecided.sum()) > _MOST_CELLS * lenses:
            undecided &= cells.low <= cells.low[undecided].kthvalue(_MOST_CELLS * lenses).values
        done.append((cells.take(~undecided), sign[~undecided], falls[~undecided]))
        cells = cells.take(undecided).in_four(across[undecided])

    every, signs, falling = zip(*done, strict=True)
    cells = _Cells(*(torch.cat(each) for each in zip(*every, strict=True)))
    sign, falls = torch.cat(signs), torch.cat(falling)
    positive = reach.amax(-1).scatter_reduce(0, cells.lens, torch.where(sign <= 0, cells.low, torch.inf), "amin")
    # A sign can change from negative to positive only in cells that remained undecided.
    cells = cells.take((sign == 0) & ~falls)
    row = torch.repeat_interleave(cells.lens * sectors + cells.sector, cells.width)
    before = torch.repeat_interleave(cells.width.cumsum(0) - cells.width, cells.width)
    row = row + torch.arange(len(row), device=row.device) - before
    low = torch.repeat_interleave(cells.low, cells.width)
    return positive, reach.flatten().scatter_reduce(0, row, low, "amin").reshape(reach.shape)
