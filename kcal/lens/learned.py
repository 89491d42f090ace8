"""The terms of the hybrid lens: smooth fields that are linear in their coefficients, and a wandering entrance pupil.

On the plane of the base projection (`kcal.lens.plane`), with m = |(x, y)|, s₀ its shape and ρ the radius of the disc,

    (x_D, y_D) = (1 + δ m² G(s₀ m²)) (x, y) + Σ w_k Z_k((x, y) / ρ)

δ changes the shape of the base (`kcal.lens.base_map`), Z_k are Zernike fields (`kcal.lens.zernike`). A point at the
angle θ off the axis is seen from the place (ζ₁ θ² + ζ₂ θ⁴) on the axis, meters: the entrance pupil wanders with the
angle (Gennery 2006). At infinity that has no effect.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.base_map import growth_by_shape
from kcal.lens.zernike import RADIAL, ZernikeModes, unbind_last

LEADING = ("shape", "pupil1", "pupil2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearnedForm:
    """The constants of a hybrid lens: they say where its fields are looked up, and are not estimated.

    Args:
        shape: s₀ of the base projection.
        radius: ρ of the disc on which the fields live, on the plane of the base projection.
        modes: which fields there are.
    """

    shape: float
    radius: float
    modes: ZernikeModes = dataclasses.field(default_factory=ZernikeModes)

    def __post_init__(self) -> None:
        if not self.radius > 0 or not abs(self.shape) <= 10:
            raise InputError(f"hybrid lens: shape {self.shape} or radius {self.radius} is no projection")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients: δ, ζ₁, ζ₂, then the fields'."""
        return LEADING + self.modes.names

    @property
    def radial_names(self) -> frozenset[str]:
        """Names of the coefficients of a lens that is symmetric about its axis."""
        modes = zip(self.modes.names, self.modes.real_modes, strict=True)
        return frozenset({LEADING[0], *(name for name, (_, _, family, _) in modes if family == RADIAL)})


class LearnedTerms(NamedTuple):
    """Distorted coordinates (..., N), their derivatives, and where they are usable; see `Distorted`."""

    x: Tensor
    y: Tensor
    point: tuple[Tensor, ...]
    coefficients: list[tuple[Tensor, Tensor]]
    inside: Tensor


def learned_terms(
    x: Tensor, y: Tensor, coefficients: Tensor, form: LearnedForm, wanted: Sequence[int], slopes: bool
) -> LearnedTerms:
    """Move points (..., N) of the plane by the fields.

    Args:
        x: (..., N).
        y: (..., N).
        coefficients: (..., P), broadcast against the leading shape of the points.
        form: the constants.
        wanted: indices of coefficients whose derivatives are needed.
        slopes: whether the derivatives by the point are needed.
    """
    square = x * x + y * y
    growth, growth_slope = growth_by_shape(form.shape * square)
    bend = unbind_last(coefficients[..., :1])[0]
    scale = 1.0 + bend * square * growth
    f, g, *by_place = form.modes.field(coefficients[..., len(LEADING) :], x / form.radius, y / form.radius, slopes)
    point: tuple[Tensor, ...] = ()
    if slopes:
        # d scale / d x = 2 x rate.
        rate = 2.0 * bend * (growth + form.shape * square * growth_slope)
        f_x, f_y, g_x, g_y = (slope / form.radius for slope in by_place)
        cross = rate * x * y
        point = (scale + rate * x * x + f_x, cross + f_y, cross + g_x, scale + rate * y * y + g_y)
    columns: list[tuple[Tensor, Tensor]] = []
    if wanted:
        fields = form.modes.columns(x / form.radius, y / form.radius)
        zero, by_bend = torch.zeros_like(x), square * growth
        leading = [(by_bend * x, by_bend * y), (zero, zero), (zero, zero)]
        offset = len(LEADING)
        columns = [leading[i] if i < offset else (fields[i - offset, 0], fields[i - offset, 1]) for i in wanted]
    return LearnedTerms(x * scale + f, y * scale + g, point, columns, square <= form.radius**2)
