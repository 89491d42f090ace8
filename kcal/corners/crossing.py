"""Two blurred edges that cross: the gray levels of four squares round a corner, and their derivatives.

A step edge blurred by a Gaussian is an error function of the distance from the edge. Two crossing edges blurred
together are E[sign(X₁) sign(X₂)] for two normal variables whose correlation is the cosine between the edges' normals:
the product of two error functions where they are perpendicular, plus Mehler's series in that correlation
(F. G. Mehler 1866; M. G. Kendall, "Proof of relations connected with the tetrachoric series", Biometrika 1941) where
they are not, as on a tilted board.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

NAMES = ("dx", "dy", "angle1", "angle2", "log_blur", "mean", "contrast", "ramp_x", "ramp_y", "bow")
PARAMETERS = len(NAMES)
ODD = (0, 1, 7, 8)  # the parameters whose derivatives change their sign from one side of the corner to the opposite one
_ORDER = 5  # of the series: what is left out is below 0.1 % of the contrast for edges 50° apart


class Beside(NamedTuple):
    """What lies beyond the four squares round a corner: the next line on either side of each edge.

    They move with the corner, and widen with the blur; how far they are is not fitted.

    Args:
        distance: (..., 2, 2, K) pixels from each edge to the next line, on the side of its normal and on the other, at
            each place where gray levels are wanted.
        turn: (..., 2, 2, 1) what the edge's sign does there: 1 where squares alternate once more, 0.5 where the light
            margin of the board begins, 0 where nothing is known.
    """

    distance: Tensor
    turn: Tensor


def crossing(parameters: Tensor, where: Tensor, bend: Tensor, beside: Beside | None = None) -> tuple[Tensor, Tensor]:
    """Gray levels of crossing edges and their Jacobian.

    Args:
        parameters: (..., 10): the center (dx, dy) in pixels, the directions of both edges in radians, the logarithm of
            the blur's sigma in pixels, mean gray level, half the contrast (its sign says which squares are light),
            a ramp of illumination (by which share light grows a pixel), and by how much edges are lighter than the mean
            (a camera's tone curve bends the profile of a blurred edge).
        where: (..., K, 2) pixels at which the gray levels are wanted.
        bend: (..., 2) curvature of each edge, 1 / pixels, positive towards its normal (direction + 90°, x to y).
        beside: the lines next to the edges, if their blur reaches here.

    Returns:
        levels (..., K) and their derivatives (..., 10, K).

    Example:
        >>> p = torch.tensor([0.0, 0.0, 0.0, math.pi / 2, 0.0, 128.0, 80.0, 0.0, 0.0, 0.0]).double()
        >>> where = torch.tensor([[0.0, 0.0], [5.0, 5.0], [-5.0, 5.0]]).double()
        >>> levels, _ = crossing(p, where, torch.zeros(2).double())
        >>> levels.round().tolist()
        [128.0, 48.0, 208.0]
    """
    dx, dy, angle1, angle2, log_blur, mean, contrast, ramp_x, ramp_y, bow = (
        value[..., None] for value in parameters.unbind(-1)
    )
    px, py = where.unbind(-1)
    x, y = px - dx, py - dy
    blur = log_blur.exp()
    profiles, by_x, by_y, by_angle = [], [], [], []
    for i, angle in enumerate((angle1, angle2)):
        curve = bend[..., i, None]
        cos, sin = angle.cos(), angle.sin()
        along, across = cos * x + sin * y, cos * y - sin * x
        lines = None if beside is None else Beside(*(value[..., i, :, :] for value in beside))
        profiles.append(_profile((across - 0.5 * curve * (along**2 + blur**2)) / blur, curve * blur, blur, lines))
        by_x.append((sin + curve * along * cos) / blur)
        by_y.append((-cos + curve * along * sin) / blur)
        by_angle.append(-along * (1.0 + curve * across) / blur)
    a, b = profiles
    rho = torch.cos(angle1 - angle2)
    sign, by_a, by_b, by_blur, by_rho = _signs(a, b, rho)
    light = contrast.detach().sign()
    sign = sign + light * (a.margin + b.margin)
    by_a, by_b = by_a + light * a.margin_slope, by_b + light * b.margin_slope
    by_blur = by_blur + light * (a.margin_widening + b.margin_widening)
    light_here = 1.0 + ramp_x * px + ramp_y * py
    slope = light_here * (contrast - 2.0 * bow * sign)
    by_a, by_b, by_rho = slope * by_a, slope * by_b, slope * by_rho * torch.sin(angle1 - angle2)
    edge = 1.0 - sign * sign
    level = mean + contrast * sign + bow * edge
    one = torch.ones_like(sign)
    jacobian = torch.stack(
        [
            by_a * by_x[0] + by_b * by_x[1],
            by_a * by_y[0] + by_b * by_y[1],
            by_a * by_angle[0] - by_rho,
            by_b * by_angle[1] + by_rho,
            slope * by_blur,
            light_here * one,
            light_here * sign,
            px * level,
            py * level,
            light_here * edge,
        ],
        -2,
    )
    return light_here * level, jacobian


class _Profile(NamedTuple):
    """One edge across: its blurred sign, and the terms of Mehler's series, each with its derivatives.

    value[0] is the sign, value[k + 1] the density times Hermite's polynomial of degree k; slope is the derivative by
    the distance in sigmas, widening the one by the logarithm of sigma.
    """

    value: list[Tensor]
    slope: list[Tensor]
    widening: list[Tensor]
    margin: Tensor
    margin_slope: Tensor
    margin_widening: Tensor


def _profile(scaled: Tensor, flat: Tensor, blur: Tensor, beside: Beside | None) -> _Profile:
    value, slope = _terms(scaled)
    widening = [-(scaled + flat) * term for term in slope]
    margin = margin_slope = margin_widening = torch.zeros_like(scaled)
    if beside is None:
        return _Profile(value, slope, widening, margin, margin_slope, margin_widening)
    for i, side in enumerate((1.0, -1.0)):
        distance, turn = beside.distance[..., i, :], beside.turn[..., i, :]
        from_line = scaled - side * distance / blur
        line, line_slope = _terms(from_line)
        line[0] = line[0] + side  # 0 on the corner's side of the line
        value = [one - turn * other for one, other in zip(value, line, strict=True)]
        slope = [one - turn * other for one, other in zip(slope, line_slope, strict=True)]
        widening = [one + turn * (from_line + flat) * other for one, other in zip(widening, line_slope, strict=True)]
        light = 0.5 * side * (turn == 0.5)
        margin = margin + light * line[0]
        margin_slope = margin_slope + light * line_slope[0]
        margin_widening = margin_widening - light * (from_line + flat) * line_slope[0]
    return _Profile(value, slope, widening, margin, margin_slope, margin_widening)


def _terms(a: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    density = torch.exp(-0.5 * a * a) * (1.0 / math.sqrt(2.0 * math.pi))
    hermite = [density, a * density]
    for k in range(1, _ORDER):
        hermite.append(a * hermite[k] - k * hermite[k - 1])
    # The derivative of one is minus the next.
    return [torch.erf(a * math.sqrt(0.5)), *hermite[:-1]], [2.0 * density, *(-value for value in hermite[1:])]


def _signs(a: _Profile, b: _Profile, rho: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """E[sign(a + u) sign(b + v)] for standard normal u, v with correlation rho, and its derivatives.

    By a, b, the logarithm of the blur, and rho.
    """
    value = a.value[0] * b.value[0]
    by_a, by_b = a.slope[0] * b.value[0], a.value[0] * b.slope[0]
    by_blur = a.widening[0] * b.value[0] + a.value[0] * b.widening[0]
    by_rho = torch.zeros_like(value)
    power = torch.full_like(rho, 4.0)
    for k in range(1, _ORDER + 1):
        both = a.value[k] * b.value[k]
        by_rho = by_rho + power * both
        power = power * rho / k
        value = value + power * both
        by_a = by_a + power * a.slope[k] * b.value[k]
        by_b = by_b + power * a.value[k] * b.slope[k]
        by_blur = by_blur + power * (a.widening[k] * b.value[k] + a.value[k] * b.widening[k])
    return value, by_a, by_b, by_blur, by_rho
