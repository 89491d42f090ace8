"""What the corners of a board know of each other: how light falls on it, and where the next lines are."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.corners.crossing import PARAMETERS, Beside, crossing
from kcal.corners.erf_window import Window
from kcal.corners.grid import Neighbors

# A ramp of illumination looks like a shift of the corner where the window is hardly wider than the blur. A prior keeps
# it near that of the whole board: it counts at most as so many pixels one pixel away from the center.
RAMP_WEIGHT = 3000.0
UNKNOWN_RAMP = 1e-3  # share a pixel, where there are too few corners to know: a third of the light over 300 pixels
_LIGHT_CORNERS = 12  # fewer do not tell a quadratic from their noise
_NOWHERE = 1e6  # pixels
_LITTLE = 1e-4  # pixels, to differentiate by the distance of a line


class Prior(NamedTuple):
    """What is known of the ramp of illumination before the fit: its value (M, 2), a weight and its own error (M,)."""

    slope: Tensor
    weight: Tensor
    doubt: Tensor

    @staticmethod
    def of(parameters: Tensor, slope: Tensor, doubt: Tensor, noise: Tensor) -> Prior:
        """From a slope and its error (`light_slope`), and the variance of the gray levels (M,)."""
        most = RAMP_WEIGHT * parameters[:, 5:7].square().sum(-1)
        # A normal error on either side. Where nothing is known, none is better than a ramp made up of noise.
        known = (doubt > 0) & (doubt < UNKNOWN_RAMP)
        weight = torch.minimum(most, torch.where(known, noise / doubt.clamp_min(1e-9) ** 2, most))
        return Prior(slope, weight, doubt)

    def of_some(self, some: Tensor) -> Prior:
        """That of some of the corners."""
        return Prior(*(value[some] for value in self))

    def diagonal(self) -> Tensor:
        """What it adds to the diagonal of the normal matrix, (M, 10)."""
        return torch.nn.functional.pad(self.weight[:, None].expand(-1, 2), (7, 1))

    def value(self) -> Tensor:
        """Where it pulls the parameters, (M, 10); 0 where it does not pull."""
        return torch.nn.functional.pad(self.slope, (7, 1))


def light_at(parameters: Tensor, window: Window, bend: Tensor, beside: Beside | None, usable: Tensor) -> Tensor:
    """How light it is at each corner, in units of its image's typical corner (B, N).

    All corners of a board have the same black and white, and the image one blur: only position, directions and light
    are a corner's own.
    """
    common = parameters.reshape(*usable.shape, PARAMETERS).clone()
    turned = parameters[:, 6].sign()  # which squares are light
    common[..., 6] *= turned.reshape(usable.shape)
    common = common.masked_fill(~usable[..., None], math.nan).nanmedian(1).values.nan_to_num()[:, None]
    shape = parameters.clone()
    shape[:, 4:] = common[..., 4:].expand(*usable.shape, -1).reshape(-1, PARAMETERS - 4)
    shape[:, 6] *= turned
    shape[:, 7:9] = 0.0
    levels, _ = crossing(shape, window.where, bend, beside)
    weighted = window.weight * levels
    power = (weighted * levels).sum(-1)
    return ((weighted * window.levels).sum(-1) / torch.where(power > 0, power, 1.0)).reshape(usable.shape)


def light_slope(light: Tensor, place: Tensor, side: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """By which share light grows a pixel at each corner (M, 2), and the error of that (M,), from the whole image.

    A quadratic over the image explains vignetting and a lamp at one side; a window alone is too small to know.
    """
    light, place = torch.where(usable, light, 0.0), torch.where(usable[..., None], place, 0.0)
    count = usable.sum(-1).clamp_min(1)[:, None]
    center = (place * usable[..., None]).sum(1) / count
    away = (place - center[:, None]) * usable[..., None]
    size = (away.square().sum((1, 2)) / count[:, 0]).sqrt().clamp_min(1.0)[:, None]
    x, y = (away / size[..., None]).unbind(-1)
    design = torch.stack([usable.to(x), x, y, x * x, x * y, y * y], -1)
    known = (usable.sum(-1) >= _LIGHT_CORNERS)[:, None]
    solution = torch.linalg.lstsq(design, light[..., None], driver="gelsd").solution[..., 0]
    smooth = (design @ solution[..., None])[..., 0]
    _, by_x, by_y, xx, xy, yy = (value[:, None] for value in solution.unbind(-1))
    slope = torch.stack([by_x + 2 * xx * x + xy * y, by_y + xy * x + 2 * yy * y], -1) / size[..., None]
    good = known & usable & (smooth > 0)
    slope = torch.where(good[..., None], slope / torch.where(good, smooth, 1.0)[..., None], 0.0)
    # What light does beside the quadratic, it does from one corner to the next but one, at worst.
    freedom = (usable.sum(-1) - 6).clamp_min(1)[:, None]
    rest = ((light - smooth * usable).square().sum(-1, keepdim=True) / freedom).sqrt()
    doubt = rest / (2.0 * side * torch.where(good, smooth, 1.0))
    doubt = torch.where(good, doubt, UNKNOWN_RAMP).clamp_max(UNKNOWN_RAMP)
    return slope.reshape(-1, 2), doubt.reshape(-1)


def curvatures(bend: Tensor, parameters: Tensor) -> Tensor:
    """The curvature of each edge (M, 2): of the row's and the column's line, whichever each edge follows.

    A line's curvature vector is perpendicular to the line, so the edge that a line is has it along its normal.
    """
    normal = torch.stack([-parameters[:, 2:4].sin(), parameters[:, 2:4].cos()], -1)  # (M, edge, 2)
    along = torch.einsum("mei,mli->mel", normal, bend)
    length = torch.linalg.vector_norm(bend, dim=-1)
    # How well each of the two pairings explains both vectors.
    straight = (along[:, 0, 0].abs() - length[:, 0]) + (along[:, 1, 1].abs() - length[:, 1])
    swapped = (along[:, 0, 1].abs() - length[:, 1]) + (along[:, 1, 0].abs() - length[:, 0])
    return torch.where(
        (straight >= swapped)[:, None],
        torch.stack([along[:, 0, 0], along[:, 1, 1]], -1),
        torch.stack([along[:, 0, 1], along[:, 1, 0]], -1),
    )


class Lines(NamedTuple):
    """The lines next to each edge: (M, edge, sides), the normal's side first.

    Args:
        distance: pixels at the corner.
        change: how it changes a pixel along the edge.
        turn: see `Beside`.
    """

    distance: Tensor
    change: Tensor
    turn: Tensor

    def beside(self, parameters: Tensor, where: Tensor) -> Beside:
        """The lines as they are seen from pixels (K, 2)."""
        offset = where - parameters[:, None, :2]
        along = torch.einsum("mei,mki->mek", _directions(parameters), offset)[:, :, None]
        distance = self.distance[..., None] + self.change[..., None] * along
        return Beside(distance.clamp_min(1.0), self.turn[..., None])


def _directions(parameters: Tensor) -> Tensor:
    """Unit vectors along both edges (M, 2, 2)."""
    return torch.stack([parameters[:, 2:4].cos(), parameters[:, 2:4].sin()], -1)


def lines_beside(around: Neighbors, parameters: Tensor) -> Lines:
    """The lines through the neighbors across each edge."""
    direction = _directions(parameters)
    normal = torch.stack([-direction[..., 1], direction[..., 0]], -1)
    # (M, edge, row or column, back and forth)
    across, along = (torch.einsum("mei,mki->mek", v, around.step).unflatten(-1, (2, 2)) for v in (normal, direction))
    change = torch.einsum("mei,mki->mek", normal, around.change).unflatten(-1, (2, 2))
    outer = around.outer.unflatten(-1, (2, 2))[:, None].expand(across.shape)
    # The neighbors along an edge lie on it; those of the other line are across. `row` is the edge along the rows.
    size = across.abs().nansum(-1)
    swapped = (size[:, 0, 0] + size[:, 1, 1] > size[:, 0, 1] + size[:, 1, 0])[:, None, None]

    def choose(value: Tensor, straight: list[int]) -> Tensor:
        other = [1 - i for i in straight]
        return torch.where(swapped, value[:, [0, 1], other], value[:, [0, 1], straight])

    across, change, outer, along = (
        choose(across, [1, 0]),
        choose(change, [1, 0]),
        choose(outer, [1, 0]),
        choose(along, [0, 1]),
    )
    # A step from one corner to the next goes so far along the edge.
    forth = 0.5 * (along[..., 1:] - along[..., :1])
    change = change / torch.where(forth.abs() > 1.0, forth, math.inf)
    falls = across[..., :1] < across[..., 1:]  # the second of the two is on the normal's side
    across, change, outer = (torch.where(falls, value.flip(-1), value) for value in (across, change, outer))
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64, device=across.device)
    known = (across * sign > 0) & torch.isfinite(change)  # False for NaN
    turn = torch.where(known, torch.where(outer, 0.5, 1.0).to(across), 0.0)
    return Lines(torch.where(known, across * sign, _NOWHERE), torch.where(known, change * sign, 0.0), turn)


def line_spread(parameters: Tensor, window: Window, bend: Tensor, beside: Beside, gain: Tensor, own: Tensor) -> Tensor:
    """What the places of the next lines add to the covariance: steps between two corners that err alike."""
    levels, _ = crossing(parameters, window.where, bend, beside)
    direction = _directions(parameters)
    normal = torch.stack([-direction[..., 1], direction[..., 0]], -1)
    moves, errors = [], []
    for edge in (0, 1):
        for line in (0, 1):
            distance = beside.distance.clone()
            distance[:, edge, line] += _LITTLE
            moved, _ = crossing(parameters, window.where, bend, Beside(distance, beside.turn))
            moves.append((gain @ ((moved - levels) / _LITTLE)[..., None])[..., 0])
            errors.append(normal[:, edge])
    added = torch.zeros_like(own)
    for _ in range(2):  # their errors have grown, too
        total = own + added
        added = torch.zeros_like(own)
        for move, across in zip(moves, errors, strict=True):
            error = 2.0 * torch.einsum("mi,mij,mj->m", across, total, across)
            added = added + error[:, None, None] * move[:, :, None] * move[:, None, :]
    return added
