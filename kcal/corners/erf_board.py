"""The gray levels around corners: two blurred edges that cross, in windows, with what only a whole board shows."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.corners.grid import Neighbors
from kcal.corners.saddle import cut_patches

# Model the gray levels of the four squares around a corner, with derivatives: two blurred edges that cross.
#
# A step edge blurred by a Gaussian is an error function of the distance from the edge. Two crossing edges blurred
# together are E[sign(X₁) sign(X₂)] for two normal variables whose correlation is the cosine between the edges' normals.
# For perpendicular edges this is the product of two error functions. For others, as on a tilted board, Mehler's series
# in that correlation is added (F. G. Mehler 1866; M. G. Kendall, "Proof of relations connected with the tetrachoric
# series", Biometrika 1941).

NAMES = ("dx", "dy", "angle1", "angle2", "log_blur", "mean", "contrast", "ramp_x", "ramp_y", "bow")
PARAMETERS = len(NAMES)
ODD = (0, 1, 7, 8)  # the parameters whose derivatives are odd functions of the offset from the corner
_SERIES_ORDER = 5  # what is left out is below 0.1 % of the contrast for edges 50° apart
_FAR_SIGMAS = 9.0  # of blur, where the density is 1e-18: products of smaller ones are denormal, and slow


class LineDistances(NamedTuple):
    """The next line on either side of each edge: what lies beyond the four squares around a corner.

    The lines move with the corner and blur with it; their distances are not fitted.

    Args:
        distance: (..., 2, 2, K) pixels from each edge to the next line, on the side of its normal and on the other, at
            each evaluated place.
        turn: (..., 2, 2, 1) how the edge's sign changes there: 1 where squares alternate once more, 0.5 where the
            board's light margin begins, 0 where nothing is known.
    """

    distance: Tensor
    turn: Tensor


def crossing(
    parameters: Tensor, where: Tensor, bend: Tensor, lines: LineDistances | None = None, *, slopes: bool = True
) -> tuple[Tensor, Tensor]:
    """Gray levels of crossing edges and their Jacobian.

    Args:
        parameters: (..., 10): the center (dx, dy) in pixels; the directions of both edges in radians; the logarithm of
            the blur's sigma in pixels; mean gray level; half the contrast, whose sign says which squares are light; a
            ramp of illumination, the share by which light grows per pixel; and by how much edges are lighter than the
            mean, because a camera's tone curve bends the profile of a blurred edge.
        where: (..., K, 2) pixels at which the gray levels are evaluated.
        bend: (..., 2) curvature of each edge, 1 / pixels, positive towards its normal (direction + 90°, x to y).
        lines: the next lines, if their blur reaches here.
        slopes: whether derivatives are needed, which are two thirds of the work.

    Returns:
        levels (..., K) and their derivatives (..., 10, K), or (..., 0, K).

    Example:
        >>> p = torch.tensor([0.0, 0.0, 0.0, math.pi / 2, 0.0, 128.0, 80.0, 0.0, 0.0, 0.0]).double()
        >>> where = torch.tensor([[0.0, 0.0], [5.0, 5.0], [-5.0, 5.0]]).double()
        >>> levels, _ = crossing(p, where, torch.zeros(2).double())
        >>> levels.round().tolist()
        [128.0, 48.0, 208.0]
    """
    dx, dy, angle1, angle2, log_blur, mean, contrast, ramp_x, ramp_y, bow = (
        value[..., None] for value in parameters.to(where.dtype).unbind(-1)
    )
    px, py = where.unbind(-1)
    x, y = (px - dx)[..., None, :], (py - dy)[..., None, :]
    blur = log_blur.exp()[..., None, :]
    angle = torch.stack([angle1, angle2], -2)  # from here on (..., edge, K)
    curve, cos, sin = bend.to(where.dtype)[..., None], angle.cos(), angle.sin()
    along, across = cos * x + sin * y, cos * y - sin * x
    scaled = (across - 0.5 * curve * (along.square() + blur**2)) / blur
    profile = _profile(scaled, blur, lines)
    sign, by_signs, widening, by_rho = _signs(profile, torch.cos(angle1 - angle2), slopes)
    light = contrast.detach().sign()
    if lines is not None:
        sign = sign + light * _both(profile.margin[0])
    light_here = 1.0 + ramp_x * px + ramp_y * py
    edge = 1.0 - sign * sign
    level = mean + contrast * sign + bow * edge
    if not slopes:
        return light_here * level, level[..., None, :][..., :0, :]
    if lines is not None:
        by_signs = by_signs + light[..., None] * profile.margin[1]
        widening = widening + light * _both(profile.margin[2])
    by_blur = widening - _both(by_signs * (scaled + curve * blur))
    steep = light_here * (contrast - 2.0 * bow * sign)
    by_rho = steep * by_rho * torch.sin(angle1 - angle2)
    by_distance = by_signs * (steep[..., None, :] / blur)
    bent = by_distance * along * curve
    by_angle1, by_angle2 = (by_distance * along + bent * across).unbind(-2)
    jacobian = torch.stack(
        [
            _both(by_distance * sin + bent * cos),
            _both(bent * sin - by_distance * cos),
            -by_angle1 - by_rho,
            by_rho - by_angle2,
            steep * by_blur,
            light_here.expand_as(sign),
            light_here * sign,
            px * level,
            py * level,
            light_here * edge,
        ],
        -2,
    )
    return light_here * level, jacobian


def _both(of_edges: Tensor) -> Tensor:
    """The sum over both edges (..., edge, K); `sum` takes five times as long."""
    first, second = of_edges.unbind(-2)
    return first + second


class _Profile(NamedTuple):
    """The profiles across both edges: blurred signs and the terms of Mehler's series, each (..., edge, K).

    Args:
        value: the sign, then the density times Hermite's polynomials of degree 0 and on.
        fall: minus the derivatives with respect to the distance in sigmas.
        widening: the part of the derivatives with respect to the logarithm of sigma that is due to lines; empty
            without.
        margin: what the board's light margin adds, with both derivatives; empty without lines.
    """

    value: list[Tensor]
    fall: list[Tensor]
    widening: list[Tensor]
    margin: list[Tensor]


def _profile(scaled: Tensor, blur: Tensor, lines: LineDistances | None) -> _Profile:
    value, fall = _profile_terms(scaled)
    if lines is None:
        return _Profile(value, fall, [], [])
    widening = [torch.zeros_like(scaled) for _ in value]
    margin = widening[:3]
    for i, side in enumerate((1.0, -1.0)):
        away, turn = side * lines.distance[..., i, :].to(scaled) / blur, lines.turn[..., i, :].to(scaled)
        line, line_fall = _profile_terms(scaled - away)
        line[0] = line[0] + side  # 0 on the corner's side of the line
        light = 0.5 * side * (turn == 0.5)
        terms = line[0], -line_fall[0], -away * line_fall[0]
        margin = [one + light * other for one, other in zip(margin, terms, strict=True)]
        value = [one - turn * other for one, other in zip(value, line, strict=True)]
        fall = [one - turn * other for one, other in zip(fall, line_fall, strict=True)]
        widening = [one + turn * away * other for one, other in zip(widening, line_fall, strict=True)]
    return _Profile(value, fall, widening, margin)


def _profile_terms(a: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    a = a.clamp(-_FAR_SIGMAS, _FAR_SIGMAS)
    density = torch.exp(-0.5 * a * a) * (1.0 / math.sqrt(2.0 * math.pi))
    hermite = [density, a * density]
    for k in range(1, _SERIES_ORDER):
        hermite.append(torch.sub(a * hermite[k], hermite[k - 1], alpha=k))
    # The derivative of one is minus the next.
    return [torch.erf(a * math.sqrt(0.5)), *hermite[:-1]], [-2.0 * density, *hermite[1:]]


def _signs(profile: _Profile, rho: Tensor, slopes: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """E[sign(a + u) sign(b + v)] for standard normal u, v with correlation rho.

    Followed by its derivatives, if wanted, with respect to a and b, the part of the one with respect to the logarithm
    of the blur that is due to lines, and the one with respect to rho.
    """
    value = by_rho = by_a = by_b = widening = torch.zeros_like(profile.value[0][..., 0, :])
    power, before = torch.ones_like(rho), torch.zeros_like(rho)
    for k, (here, fall) in enumerate(zip(profile.value, profile.fall, strict=True)):
        a, b = here.unbind(-2)
        both = a * b
        value = torch.addcmul(value, power, both)
        if slopes:
            fall_a, fall_b = fall.unbind(-2)
            by_rho = torch.addcmul(by_rho, before, both) if k else by_rho
            by_a = torch.addcmul(by_a, power * fall_a, b, value=-1.0)
            by_b = torch.addcmul(by_b, power * fall_b, a, value=-1.0)
        if slopes and profile.widening:
            wide_a, wide_b = profile.widening[k].unbind(-2)
            widening = widening + power * (wide_a * b + a * wide_b)
        before = power if k else torch.full_like(rho, 4.0)
        power = before * rho / (k + 1)
    return value, torch.stack([by_a, by_b], -2), widening, by_rho


# Cut out the pixels around corners that an erf fit explains.


class CornerWindow:
    """The pixels around each of M corners and their weights: 1 inside the radius, falling to 0 within a pixel.

    Args:
        levels: (M, K) gray levels of the pixels on a disc; float32, unless the image is float64.
        offset: (M, 2) starts relative to the patch's middle.
        radius: (M,) pixels.
        places: (K,) indices of these pixels in a patch, row by row.
        size: pixels on a side of the patch.
    """

    def __init__(self, levels: Tensor, offset: Tensor, radius: Tensor, places: Tensor, size: int) -> None:
        self.levels = levels
        self.offset = offset
        self.radius = radius
        self.places = places
        self.size = size
        self.where = torch.stack([places % size, places // size], -1).to(levels.dtype) - size // 2
        distance = torch.linalg.vector_norm(self.where - offset[:, None], dim=-1)
        self.weight = (radius[:, None] + 0.5 - distance).clamp(0.0, 1.0).to(levels.dtype)

    def of(self, some: Tensor) -> CornerWindow:
        """The window of some of the corners."""
        return CornerWindow(self.levels[some], self.offset[some], self.radius[some], self.places, self.size)

    def coarse(self) -> CornerWindow:
        """Every fifth pixel, a move of a chess knight apart: rows and columns have one alike."""
        x, y = self.where.long().unbind(-1)
        some = (x + 2 * y) % 5 == 0
        return CornerWindow(self.levels[:, some], self.offset, self.radius, self.places[some], self.size)

    def double(self) -> CornerWindow:
        """The window in float64."""
        return CornerWindow(self.levels.double(), self.offset, self.radius, self.places, self.size)

    def patches(self, values: Tensor) -> Tensor:
        """Values of the pixels (..., K) as (..., P, P), 0 outside the disc."""
        whole = values.new_zeros(*values.shape[:-1], self.size * self.size)
        return whole.index_copy(-1, self.places, values).unflatten(-1, (self.size, self.size))


def cut_windows(image: Tensor, base: Tensor, offset: Tensor, radius: Tensor) -> tuple[CornerWindow, Tensor]:
    """The windows around `base` + `offset`, and their gray levels (M, K) with gradients."""
    most = float(radius.max())
    half = math.ceil(most + 1.0)
    axis = torch.arange(-half, half + 1, device=radius.device)
    # A start lies at most half a pixel from the middle along each axis.
    places = (torch.hypot(axis[:, None].double(), axis[None].double()) < most + 1.21).flatten().nonzero()[:, 0]
    levels = cut_patches(image, base, half).flatten(-2)[:, places]
    # float32 resolves 1e-7 of the levels, and a corner to 1e-6 px, in half the time.
    kind = image.dtype if image.dtype == torch.float64 else torch.float32
    return CornerWindow(levels.detach().to(kind), offset, radius, places, len(axis)), levels


# Estimate from a whole board what one corner's window is too small to show: illumination and neighboring lines.

# Where the window is hardly wider than the blur, a ramp of illumination looks like a shift of the corner. A prior keeps
# the ramp near that of the whole board; it counts at most as this many pixels at 1 px from the center.
RAMP_WEIGHT = 3000.0
UNKNOWN_RAMP = 1e-3  # share per pixel, where too few corners determine it: a third of the light over 300 pixels
MIN_LIGHT_CORNERS = 12  # fewer do not separate a quadratic from their noise
FAR = 1e6  # pixels: the distance of a line that is not known


class RampPrior(NamedTuple):
    """Prior on the ramp of illumination: its value (M, 2), its weight and its standard error (M,)."""

    slope: Tensor
    weight: Tensor
    error: Tensor

    @staticmethod
    def of(parameters: Tensor, slope: Tensor, error: Tensor, noise: Tensor) -> RampPrior:
        """From a slope and its error (`light_slope`), and the variance of the gray levels (M,)."""
        most = RAMP_WEIGHT * parameters[:, 5:7].square().sum(-1)
        # Where the ramp is unknown, none is better than one fitted to noise.
        known = (error > 0) & (error < UNKNOWN_RAMP)
        weight = torch.minimum(most, torch.where(known, noise / error.clamp_min(1e-9) ** 2, most))
        return RampPrior(slope, weight, error)

    def of_some(self, some: Tensor) -> RampPrior:
        """The prior of some of the corners."""
        return RampPrior(*(value[some] for value in self))

    def diagonal(self) -> Tensor:
        """What it adds to the diagonal of the normal matrix, (M, 10)."""
        return torch.nn.functional.pad(self.weight[:, None].expand(-1, 2), (7, 1))

    def value(self) -> Tensor:
        """Its mean, (M, 10); 0 for parameters without a prior."""
        return torch.nn.functional.pad(self.slope, (7, 1))


def light_at(
    parameters: Tensor, window: CornerWindow, bend: Tensor, lines: LineDistances | None, usable: Tensor
) -> Tensor:
    """How light it is at each corner, relative to its image's typical corner (B, N).

    All corners of a board share black and white, and the image has one blur. Only position, directions and light
    differ between corners.
    """
    common = parameters.reshape(*usable.shape, PARAMETERS).clone()
    polarity = parameters[:, 6].sign()  # which squares are light
    common[..., 6] *= polarity.reshape(usable.shape)
    common = common.masked_fill(~usable[..., None], math.nan).nanmedian(1).values.nan_to_num()[:, None]
    shape = parameters.clone()
    shape[:, 4:] = common[..., 4:].expand(*usable.shape, -1).reshape(-1, PARAMETERS - 4)
    shape[:, 6] *= polarity
    shape[:, 7:9] = 0.0
    levels, _ = crossing(shape, window.where, bend, lines, slopes=False)
    weighted = window.weight * levels
    power = (weighted * levels).sum(-1)
    return ((weighted * window.levels).sum(-1) / torch.where(power > 0, power, 1.0)).reshape(usable.shape).double()


def light_slope(light: Tensor, place: Tensor, side: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """The share by which light grows per pixel at each corner (M, 2), and its standard error (M,).

    A quadratic over the whole image models vignetting and a lamp at one side.
    """
    light, place = torch.where(usable, light, 0.0), torch.where(usable[..., None], place, 0.0)
    count = usable.sum(-1).clamp_min(1)[:, None]
    center = (place * usable[..., None]).sum(1) / count
    away = (place - center[:, None]) * usable[..., None]
    size = (away.square().sum((1, 2)) / count[:, 0]).sqrt().clamp_min(1.0)[:, None]
    x, y = (away / size[..., None]).unbind(-1)
    design = torch.stack([usable.to(x), x, y, x * x, x * y, y * y], -1)
    solution = torch.linalg.lstsq(design, light[..., None], driver="gelsd").solution[..., 0]
    smooth = (design @ solution[..., None])[..., 0]
    _, by_x, by_y, xx, xy, yy = (value[:, None] for value in solution.unbind(-1))
    slope = torch.stack([by_x + 2 * xx * x + xy * y, by_y + xy * x + 2 * yy * y], -1) / size[..., None]
    good = (usable.sum(-1) >= MIN_LIGHT_CORNERS)[:, None] & usable & (smooth > 0)
    level = torch.where(good, smooth, 1.0)
    slope = torch.where(good[..., None], slope / level[..., None], 0.0)
    # What the quadratic does not explain varies over the distance of two corners at the fastest.
    freedom = (usable.sum(-1) - 6).clamp_min(1)[:, None]
    rest = ((light - smooth * usable).square().sum(-1, keepdim=True) / freedom).sqrt()
    error = torch.where(good, rest / (2.0 * side * level), UNKNOWN_RAMP).clamp_max(UNKNOWN_RAMP)
    return slope.reshape(-1, 2), error.reshape(-1)


def curvatures(bend: Tensor, parameters: Tensor) -> Tensor:
    """The curvature of each edge (M, 2), from the row's and the column's line, whichever of them the edge follows.

    A line's curvature vector is perpendicular to the line, hence along the normal of the edge that follows it.
    """
    along = torch.einsum("mei,mli->mel", _edge_normals(parameters), bend)
    length = torch.linalg.vector_norm(bend, dim=-1)
    # How well each of the two pairings explains both vectors.
    straight = (along[:, 0, 0].abs() - length[:, 0]) + (along[:, 1, 1].abs() - length[:, 1])
    swapped = (along[:, 0, 1].abs() - length[:, 1]) + (along[:, 1, 0].abs() - length[:, 0])
    return torch.where(
        (straight >= swapped)[:, None],
        torch.stack([along[:, 0, 0], along[:, 1, 1]], -1),
        torch.stack([along[:, 0, 1], along[:, 1, 0]], -1),
    )


class NeighborLines(NamedTuple):
    """The lines next to each edge: (M, edge, sides), the normal's side first.

    Args:
        distance: pixels at the corner.
        change: its change per pixel along the edge.
        turn: see `LineDistances`.
    """

    distance: Tensor
    change: Tensor
    turn: Tensor

    def distances(self, parameters: Tensor, where: Tensor) -> LineDistances:
        """The distances of the lines at pixels (K, 2)."""
        offset = where - parameters[:, None, :2]
        along = torch.einsum("mei,mki->mek", _edge_directions(parameters), offset)[:, :, None]
        distance = self.distance[..., None] + self.change[..., None] * along
        return LineDistances(distance.clamp_min(1.0), self.turn[..., None])


def neighbor_lines(around: Neighbors, parameters: Tensor) -> NeighborLines:
    """The lines through the neighbors across each edge."""
    direction, normal = _edge_directions(parameters), _edge_normals(parameters)
    # (M, edge, row or column, back and forth)
    across, along = (torch.einsum("mei,mki->mek", v, around.step).unflatten(-1, (2, 2)) for v in (normal, direction))
    change = torch.einsum("mei,mki->mek", normal, around.change).unflatten(-1, (2, 2))
    outer = around.outer.unflatten(-1, (2, 2))[:, None].expand(across.shape)
    # The neighbors along an edge lie on it; those on the other line lie across it.
    size = across.abs().nansum(-1)
    swapped = (size[:, 0, 0] + size[:, 1, 1] > size[:, 0, 1] + size[:, 1, 0])[:, None, None]
    edges = [0, 1]
    across, change, outer = (
        torch.where(swapped, value[:, edges, edges], value[:, edges, [1, 0]]) for value in (across, change, outer)
    )
    along = torch.where(swapped, along[:, edges, [1, 0]], along[:, edges, edges])
    # `change` is per step between two corners; a step goes this far along the edge.
    forth = 0.5 * (along[..., 1:] - along[..., :1])
    change = change / torch.where(forth.abs() > 1.0, forth, math.inf)
    falls = across[..., :1] < across[..., 1:]  # the second of the two is on the normal's side
    across, change, outer = (torch.where(falls, value.flip(-1), value) for value in (across, change, outer))
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64, device=across.device)
    known = (across * sign > 0) & torch.isfinite(change)  # False for NaN
    turn = torch.where(known, torch.where(outer, 0.5, 1.0).to(across), 0.0)
    return NeighborLines(torch.where(known, across * sign, FAR), torch.where(known, change * sign, 0.0), turn)


def _edge_directions(parameters: Tensor) -> Tensor:
    """Unit vectors along both edges (M, 2, 2)."""
    return torch.stack([parameters[:, 2:4].cos(), parameters[:, 2:4].sin()], -1)


def _edge_normals(parameters: Tensor) -> Tensor:
    """Unit normals of both edges (M, 2, 2): their directions turned from x to y."""
    return torch.stack([-parameters[:, 2:4].sin(), parameters[:, 2:4].cos()], -1)


def line_covariance(
    parameters: Tensor, window: CornerWindow, bend: Tensor, lines: LineDistances, gain: Tensor, own: Tensor
) -> Tensor:
    """What errors of the neighboring lines add to the covariance `own`; their corners have errors of the same size."""
    levels, _ = crossing(parameters, window.where, bend, lines, slopes=False)
    normal = _edge_normals(parameters)
    step = 30.0 * torch.finfo(levels.dtype).eps ** 0.5  # pixels, of a numerical derivative
    moves, normals = [], []
    for edge in (0, 1):
        for line in (0, 1):
            distance = lines.distance.clone()
            distance[:, edge, line] += step
            own_lines = LineDistances(distance, lines.turn)
            moved, _ = crossing(parameters, window.where, bend, own_lines, slopes=False)
            moves.append((gain @ ((moved - levels) / step)[..., None])[..., 0])
            normals.append(normal[:, edge])
    added = torch.zeros_like(own)
    for _ in range(2):  # the neighbors' errors grow by it as well
        total = own + added
        added = torch.zeros_like(own)
        for move, across in zip(moves, normals, strict=True):
            error = 2.0 * torch.einsum("mi,mij,mj->m", across, total, across)
            added = added + error[:, None, None] * move[:, :, None] * move[:, None, :]
    return added
