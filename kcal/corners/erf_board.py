"""Estimate from a whole board what one corner's window is too small to show: illumination and neighboring lines."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.corners.crossing import PARAMETERS, LineDistances, crossing
from kcal.corners.erf_window import CornerWindow
from kcal.corners.grid import Neighbors

# Where the window is hardly wider than the blur, a ramp of illumination looks like a shift of the corner. A prior keeps
# the ramp near that of the whole board; it counts at most as this many pixels at 1 px from the center.
RAMP_WEIGHT = 3000.0
UNKNOWN_RAMP = 1e-3  # share per pixel, where too few corners determine it: a third of the light over 300 pixels
MIN_LIGHT_CORNERS = 12  # fewer do not separate a quadratic from their noise
FAR = 1e6  # pixels: the distance of a line that is not known
_SMALL = 1e-4  # pixels: the step of the numerical derivative with respect to a line's distance


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
    levels, _ = crossing(shape, window.where, bend, lines)
    weighted = window.weight * levels
    power = (weighted * levels).sum(-1)
    return ((weighted * window.levels).sum(-1) / torch.where(power > 0, power, 1.0)).reshape(usable.shape)


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
    levels, _ = crossing(parameters, window.where, bend, lines)
    normal = _edge_normals(parameters)
    moves, normals = [], []
    for edge in (0, 1):
        for line in (0, 1):
            distance = lines.distance.clone()
            distance[:, edge, line] += _SMALL
            moved, _ = crossing(parameters, window.where, bend, LineDistances(distance, lines.turn))
            moves.append((gain @ ((moved - levels) / _SMALL)[..., None])[..., 0])
            normals.append(normal[:, edge])
    added = torch.zeros_like(own)
    for _ in range(2):  # the neighbors' errors grow by it as well
        total = own + added
        added = torch.zeros_like(own)
        for move, across in zip(moves, normals, strict=True):
            error = 2.0 * torch.einsum("mi,mij,mj->m", across, total, across)
            added = added + error[:, None, None] * move[:, :, None] * move[:, None, :]
    return added
