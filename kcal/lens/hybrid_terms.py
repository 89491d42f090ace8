"""Compute the terms of the hybrid lens: a base projection, corrected by a smooth field that is linear in its weights.

On the plane of the base projection with shape s₀ (`kcal.lens.base_map`), where m = √(x² + y²),

    (x_D, y_D) = (1 + δ m² G(s₀ m²)) (x, y) + Σ w_k Z_k(x / ρ, y / ρ)

δ ("shape") corrects the shape of the base projection. Z_k are fields on the disc of radius ρ: those of
`kcal.lens.zernike`, or another kind of `kcal.lens.field_modes`. Two more coefficients, ζ₁ and ζ₂ ("pupil1" and
"pupil2"), move the entrance pupil: a ray at the angle θ from the optical axis starts at (0, 0, ζ₁ θ² + ζ₂ θ⁴), in
meters (`kcal.lens.pupil`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.base_map import growth_by_shape, largest_base_radius
from kcal.lens.field_modes import FieldModes
from kcal.lens.zernike import ZernikeModes, unbind_last

# The coefficients before the field's weights.
LEADING = ("shape", "pupil1", "pupil2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class HybridForm:
    """The constants of a hybrid lens: where its field is evaluated. They are chosen before a fit and not estimated.

    Args:
        shape: s₀ of the base projection: 1 is a pinhole, 1/4 stereographic, 0 equidistant.
        radius: ρ of the disc on which the field is defined, on the plane of the base projection. Points outside the
            disc are not valid.
        modes: of the field: `ZernikeModes`, `GaussianModes` or `NetworkModes`.

    Attributes:
        reach: largest distance from the origin of the plane that is valid: ρ, or less where the base projection ends.
        names: names of the coefficients: "shape", "pupil1", "pupil2", then the weights of the field.

    Raises:
        InputError: a radius that is not positive, or a shape beyond ±10.

    Example:
        >>> form = HybridForm(shape=1.0, radius=0.8, modes=ZernikeModes(radial=5, decentered=2, astigmatic=0, other=0))
        >>> form.names
        ('shape', 'pupil1', 'pupil2', 'z2+0', 'z5+1', 'z2+2', 'z2+0i', 'z3+1i', 'z5+1i', 'z2+2i')
    """

    shape: float
    radius: float
    modes: FieldModes = dataclasses.field(default_factory=ZernikeModes)

    # Computed once: compilers cannot trace lazily computed attributes.
    reach: float = dataclasses.field(init=False, repr=False, compare=False)
    names: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (self.radius > 0 and math.isfinite(self.radius)):
            raise InputError(f"hybrid lens: the radius of its disc must be positive, got {self.radius}")
        if not abs(self.shape) <= 10:
            raise InputError(f"hybrid lens: the shape of its base projection must lie within ±10, got {self.shape}")
        object.__setattr__(self, "reach", min(self.radius, largest_base_radius(self.shape)))
        object.__setattr__(self, "names", LEADING + self.modes.names)

    def constants(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """s₀ and 1 / ρ as tensors on the device of `like`: ONNX would write plain numbers as float32."""
        shape, inverse = torch.tensor((self.shape, 1.0 / self.radius), dtype=like.dtype, device=like.device).unbind()
        return shape, inverse

    @property
    def radial_names(self) -> frozenset[str]:
        """Names of the coefficients of a lens that is symmetric about its axis."""
        return self.modes.radial_names | {LEADING[0]}


def hybrid_terms(
    x: Tensor, y: Tensor, coefficients: Tensor, form: HybridForm, wanted: Sequence[int], slopes: bool
) -> tuple[Tensor, Tensor, tuple[Tensor, ...], Tensor, Tensor]:
    """Distort points (..., N) of the plane of the base projection.

    Args:
        x: (..., N).
        y: (..., N).
        coefficients: (..., P), broadcast against the leading shape of the points.
        form: the constants.
        wanted: indices of the coefficients whose derivatives are needed.
        slopes: whether the derivatives by the point are needed.

    Returns:
        The fields of `kcal.lens.distortion.Distorted`; `positive` is the disc on which the lens is defined.
    """
    square = x * x + y * y
    shape, to_disc = form.constants(x)
    growth, growth_slope = growth_by_shape(shape * square)
    bend = unbind_last(coefficients[..., :1])[0]
    scale = 1.0 + bend * square * growth
    offset = len(LEADING)
    f, g, *by_place = form.modes.field(coefficients[..., offset:], x * to_disc, y * to_disc, slopes)
    point: tuple[Tensor, ...] = ()
    if slopes:
        # The derivative of scale by x is rate x.
        rate = 2.0 * bend * (growth + shape * square * growth_slope)
        f_x, f_y, g_x, g_y = (slope * to_disc for slope in by_place)
        cross = rate * x * y
        point = (scale + rate * x * x + f_x, cross + f_y, cross + g_x, scale + rate * y * y + g_y)
    if wanted:
        # The entrance pupil acts before this plane.
        by_bend = square * growth
        lead = torch.stack([by_bend * x, by_bend * y], -2)[..., None, :, :]
        columns = torch.cat([lead, torch.zeros_like(lead).expand(*(-1,) * (lead.ndim - 3), offset - 1, -1, -1)], -3)
        if max(wanted) >= offset:
            fields = form.modes.columns(x * to_disc, y * to_disc).movedim((0, 1), (-3, -2))
            columns = torch.cat([columns, fields], -3)
        if list(wanted) != list(range(columns.shape[-3])):
            columns = columns[..., list(wanted), :, :]
    else:
        columns = x.new_zeros((*x.shape[:-1], 0, 2, x.shape[-1]))
    return x * scale + f, y * scale + g, point, columns, square <= form.reach**2


def fill_field_columns(out: Tensor, x: Tensor, y: Tensor, scale: Tensor, form: HybridForm) -> None:
    """Derivatives of points of that plane by the field's weights, times a scale, into memory.

    Args:
        out: (M, ..., 2, N).
        x: (..., N) before the lens acts.
        y: (..., N).
        scale: (..., 2, N) pixels per unit of the plane, times weights.
        form: the constants.
    """
    to_disc = form.constants(x)[1]
    form.modes.fill_columns(out, x * to_disc, y * to_disc, scale)
