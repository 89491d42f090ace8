"""The terms of the hybrid lens: a base projection from pinhole to fisheye, corrected by a smooth field."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.dispatch import is_traced
from kcal.errors import InputError
from kcal.lens.field_modes import FieldModes
from kcal.lens.zernike import ZernikeModes, unbind_last

# Map angles to image radii by the base projection of the hybrid lens: one formula from pinhole to fisheye and beyond.
#
# A ray at the angle θ from the optical axis is seen at the distance m from the principal point, in focal lengths:
#
#     m(θ; s) = tan(√s θ) / √s,   for s < 0: tanh(√-s θ) / √-s
#
# The shape s is 1 for the pinhole, 1/4 for the stereographic and 0 for the equidistant projection (m = θ). The
# derivative by θ is 1 + s m². The functions of this module are ratios that are smooth on the axis, in q = s θ² or u = s
# m²:
#
#     T(q) = m / θ,   A(u) = θ / m,   G(u) = (A(u) (1 + u) - 1) / (2 u),   ∂m/∂s = m³ G(u)

# Where |q| or |u| is below this, the series are exact to rounding and the closed forms cancel.
_SMALL = 0.02
_TAN = (1.0, 1 / 3, 2 / 15, 17 / 315, 62 / 2835, 1382 / 155925, 21844 / 6081075, 929569 / 638512875)
_ARCTAN = tuple((-1.0) ** k / (2 * k + 1) for k in range(11))
# (A(u) (1 + u) - 1) / (2 u) from the series of A: the coefficient of u^k is (a_k + a_(k+1)) / 2.
_GROWTH = tuple(0.5 * (_ARCTAN[k] + _ARCTAN[k + 1]) for k in range(10))
# arctan x / x by powers of x², for x up to tan(90° / 8) = 0.199.
_ARCTAN_FAR = tuple((-1.0) ** k / (2 * k + 1) for k in range(12))
# Largest angle √|s| θ: the tangent grows without bound towards π/2, and tanh is almost flat beyond 3.
_STEEPEST, _FLATTEST = 1.5, 3.0
_WIDEST = math.radians(179.0)


def series(coefficients: Sequence[float], t: Tensor) -> Tensor:
    """Evaluate a polynomial with the coefficients of t⁰, t¹, ..."""
    # As a tensor: ONNX would write plain numbers as float32.
    *rest, value = torch.tensor(coefficients, dtype=t.dtype, device=t.device).unbind()
    for coefficient in reversed(rest):
        value = torch.addcmul(coefficient, value, t)
    return value


def largest_base_radius(shape: float) -> float:
    """Largest m that the projection is used for: that of 179°, or of 86° / √s where the tangent becomes too steep.

    Example:
        >>> round(largest_base_radius(0.0), 3), round(largest_base_radius(1.0), 3)
        (3.124, 13.808)
    """
    root = math.sqrt(abs(shape))
    # A little less than where `radius_over_angle` holds the tangent.
    limit = 0.999 * _STEEPEST if shape > 0 else _FLATTEST
    angle = min(_WIDEST, limit / root) if root else _WIDEST
    return float(radius_over_angle(torch.tensor(shape * angle * angle, dtype=torch.float64))) * angle


def radius_over_angle(q: Tensor) -> Tensor:
    """T(q) = m / θ for q = s θ²; the tangent is held beyond an angle √s θ of 86°."""
    slow = q.abs() < _SMALL
    root = torch.sqrt(torch.where(slow, 1.0, q).abs())
    closed = torch.where(q > 0, _tangent(root.clamp(max=_STEEPEST)), torch.tanh(root)) / root
    return torch.where(slow, series(_TAN, torch.where(slow, q, 0.0)), closed)


def angle_over_radius(u: Tensor) -> Tensor:
    """A(u) = θ / m for u = s m²; NaN for u ≤ -1, where no angle has that radius."""
    slow = u.abs() < _SMALL
    return torch.where(slow, series(_ARCTAN, torch.where(slow, u, 0.0)), _far(torch.where(slow, 1.0, u)))


def _far(u: Tensor) -> Tensor:
    """A(u) of u that are not small."""
    root = torch.sqrt(u.abs())
    return torch.where(u > 0, _arctangent(root), _artanh(torch.where(u < 0, root, 0.0))) / root


def growth_by_shape(u: Tensor) -> tuple[Tensor, Tensor]:
    """G(u) and its derivative: how the radius grows with the shape, ∂m/∂s = m³ G(s m²)."""
    slow = u.abs() < _SMALL
    near, far = torch.where(slow, u, 0.0), torch.where(slow, 1.0, u)
    ratio = _far(far)
    value = (ratio * (1.0 + far) - 1.0) / (2.0 * far)
    slope = (0.5 * ratio - 1.5 * value) / far
    by_u = tuple(k * c for k, c in enumerate(_GROWTH))[1:]
    return torch.where(slow, series(_GROWTH, near), value), torch.where(slow, series(by_u, near), slope)


# ONNX runtimes have none of these functions in float64.


def _tangent(x: Tensor) -> Tensor:
    return torch.sin(x) / torch.cos(x)


def _arctangent(x: Tensor) -> Tensor:
    """Halve the angle three times, then add the series: exact to rounding."""
    if not is_traced():
        return torch.atan(x)
    for _ in range(3):
        x = x / (1.0 + torch.sqrt(1.0 + x * x))
    return 8.0 * x * series(_ARCTAN_FAR, x * x)


def _artanh(x: Tensor) -> Tensor:
    return 0.5 * torch.log((1.0 + x) / (1.0 - x))


# Compute the terms of the hybrid lens: a base projection, corrected by a smooth field that is linear in its weights.
#
# On the plane of the base projection with shape s₀, where m = √(x² + y²),
#
#     (x_D, y_D) = (1 + δ m² G(s₀ m²)) (x, y) + Σ w_k Z_k(x / ρ, y / ρ)
#
# δ ("shape") corrects the shape of the base projection. Z_k are fields on the disc of radius ρ: those of
# `kcal.lens.zernike`, or another kind of `kcal.lens.field_modes`. Two more coefficients, ζ₁ and ζ₂ ("pupil1" and
# "pupil2"), move the entrance pupil: a ray at the angle θ from the optical axis starts at (0, 0, ζ₁ θ² + ζ₂ θ⁴), in
# meters (`kcal.lens.projection`). Behind a flat port there are three more: ζ₃ of θ⁶, and the slopes p and q of the
# port's normal (p, q, 1), which is the axis then.

# The coefficients before the field's weights; those of a port follow.
LEADING = ("shape", "pupil1", "pupil2")
PORT = ("pupil3", "port_x", "port_y")


@dataclasses.dataclass(frozen=True, kw_only=True)
class HybridForm:
    """The constants of a hybrid lens: where its field is evaluated. They are chosen before a fit and not estimated.

    Args:
        shape: s₀ of the base projection: 1 is a pinhole, 1/4 stereographic, 0 equidistant.
        radius: ρ of the disc on which the field is defined, on the plane of the base projection. Points outside the
            disc are not valid.
        modes: of the field: `ZernikeModes`, `GaussianModes` or `NetworkModes`.
        port: whether rays start on the normal of a flat port, not on the optical axis.

    Attributes:
        reach: largest distance from the origin of the plane that is valid: ρ, or less where the base projection ends.
        leading: names of the coefficients before the weights of the field: "shape", "pupil1", "pupil2"; with a port
            also "pupil3", "port_x", "port_y".
        names: names of all coefficients.

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
    port: bool = False

    # Computed once: compilers cannot trace lazily computed attributes.
    reach: float = dataclasses.field(init=False, repr=False, compare=False)
    leading: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)
    names: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (self.radius > 0 and math.isfinite(self.radius)):
            raise InputError(f"hybrid lens: the radius of its disc must be positive, got {self.radius}")
        if not abs(self.shape) <= 10:
            raise InputError(f"hybrid lens: the shape of its base projection must lie within ±10, got {self.shape}")
        object.__setattr__(self, "reach", min(self.radius, largest_base_radius(self.shape)))
        object.__setattr__(self, "leading", LEADING + PORT * self.port)
        object.__setattr__(self, "names", self.leading + self.modes.names)

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
    offset = len(form.leading)
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
