"""Model the gray levels of the four squares around a corner, with derivatives: two blurred edges that cross.

A step edge blurred by a Gaussian is an error function of the distance from the edge. Two crossing edges blurred
together are E[sign(X₁) sign(X₂)] for two normal variables whose correlation is the cosine between the edges' normals.
For perpendicular edges this is the product of two error functions. For others, as on a tilted board, Mehler's series in
that correlation is added (F. G. Mehler 1866; M. G. Kendall, "Proof of relations connected with the tetrachoric series",
Biometrika 1941).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

NAMES = ("dx", "dy", "angle1", "angle2", "log_blur", "mean", "contrast", "ramp_x", "ramp_y", "bow")
PARAMETERS = len(NAMES)
ODD = (0, 1, 7, 8)  # the parameters whose derivatives are odd functions of the offset from the corner
_SERIES_ORDER = 5  # what is left out is below 0.1 % of the contrast for edges 50° apart


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
    parameters: Tensor, where: Tensor, bend: Tensor, lines: LineDistances | None = None
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
        next_lines = None if lines is None else LineDistances(*(value[..., i, :, :] for value in lines))
        scaled = (across - 0.5 * curve * (along**2 + blur**2)) / blur
        profiles.append(_profile(scaled, curve * blur, blur, next_lines))
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
    jacobian = torch.stack(
        [
            by_a * by_x[0] + by_b * by_x[1],
            by_a * by_y[0] + by_b * by_y[1],
            by_a * by_angle[0] - by_rho,
            by_b * by_angle[1] + by_rho,
            slope * by_blur,
            light_here.expand_as(sign),
            light_here * sign,
            px * level,
            py * level,
            light_here * edge,
        ],
        -2,
    )
    return light_here * level, jacobian


class _Profile(NamedTuple):
    """The profile across one edge: its blurred sign and the terms of Mehler's series, each with its derivatives.

    value[0] is the sign; value[k + 1] is the density times Hermite's polynomial of degree k. `slope` is the derivative
    with respect to the distance in sigmas, `widening` the one with respect to the logarithm of sigma.
    """

    value: list[Tensor]
    slope: list[Tensor]
    widening: list[Tensor]
    margin: Tensor
    margin_slope: Tensor
    margin_widening: Tensor


def _profile(scaled: Tensor, flat: Tensor, blur: Tensor, lines: LineDistances | None) -> _Profile:
    value, slope = _profile_terms(scaled)
    widening = [-(scaled + flat) * term for term in slope]
    margin = margin_slope = margin_widening = torch.zeros_like(scaled)
    for i, side in enumerate((1.0, -1.0) if lines is not None else ()):
        assert lines is not None
        distance, turn = lines.distance[..., i, :], lines.turn[..., i, :]
        from_line = scaled - side * distance / blur
        line, line_slope = _profile_terms(from_line)
        line[0] = line[0] + side  # 0 on the corner's side of the line
        value = [one - turn * other for one, other in zip(value, line, strict=True)]
        slope = [one - turn * other for one, other in zip(slope, line_slope, strict=True)]
        widening = [one + turn * (from_line + flat) * other for one, other in zip(widening, line_slope, strict=True)]
        light = 0.5 * side * (turn == 0.5)
        margin = margin + light * line[0]
        margin_slope = margin_slope + light * line_slope[0]
        margin_widening = margin_widening - light * (from_line + flat) * line_slope[0]
    return _Profile(value, slope, widening, margin, margin_slope, margin_widening)


def _profile_terms(a: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    density = torch.exp(-0.5 * a * a) * (1.0 / math.sqrt(2.0 * math.pi))
    hermite = [density, a * density]
    for k in range(1, _SERIES_ORDER):
        hermite.append(a * hermite[k] - k * hermite[k - 1])
    # The derivative of one is minus the next.
    return [torch.erf(a * math.sqrt(0.5)), *hermite[:-1]], [2.0 * density, *(-value for value in hermite[1:])]


def _signs(a: _Profile, b: _Profile, rho: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """E[sign(a + u) sign(b + v)] for standard normal u, v with correlation rho.

    Followed by its derivatives with respect to a, b, the logarithm of the blur, and rho.
    """
    value = a.value[0] * b.value[0]
    by_a, by_b = a.slope[0] * b.value[0], a.value[0] * b.slope[0]
    by_blur = a.widening[0] * b.value[0] + a.value[0] * b.widening[0]
    by_rho = torch.zeros_like(value)
    power = torch.full_like(rho, 4.0)
    for k in range(1, _SERIES_ORDER + 1):
        both = a.value[k] * b.value[k]
        by_rho = by_rho + power * both
        power = power * rho / k
        value = value + power * both
        by_a = by_a + power * a.slope[k] * b.value[k]
        by_b = by_b + power * a.value[k] * b.slope[k]
        by_blur = by_blur + power * (a.widening[k] * b.value[k] + a.value[k] * b.widening[k])
    return value, by_a, by_b, by_blur, by_rho
