"""Lens models: which terms they have, how they are named, and what these do to points of the plane."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kcal.dispatch import is_traced
from kcal.errors import InputError
from kcal.lens.field_modes import FieldModes, NetworkModes
from kcal.lens.zernike import ZernikeModes, unbind_last

# The terms of the hybrid lens: a base projection from pinhole to fisheye, corrected by a smooth field.

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
    steep = root.clamp(max=_STEEPEST)
    closed = torch.where(q > 0, torch.sin(steep) / torch.cos(steep), torch.tanh(root)) / root
    return torch.where(slow, series(_TAN, torch.where(slow, q, 0.0)), closed)


def angle_over_radius(u: Tensor) -> Tensor:
    """A(u) = θ / m for u = s m²; NaN for u ≤ -1, where no angle has that radius."""
    slow = u.abs() < _SMALL
    return torch.where(slow, series(_ARCTAN, torch.where(slow, u, 0.0)), _far(torch.where(slow, 1.0, u)))


def _far(u: Tensor) -> Tensor:
    """A(u) of u that are not small."""
    root = torch.sqrt(u.abs())
    inner = torch.where(u < 0, root, 0.0)
    return torch.where(u > 0, _arctangent(root), 0.5 * torch.log((1.0 + inner) / (1.0 - inner))) / root


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


def _arctangent(x: Tensor) -> Tensor:
    """Halve the angle three times, then add the series: exact to rounding."""
    if not is_traced():
        return torch.atan(x)
    for _ in range(3):
        x = x / (1.0 + torch.sqrt(1.0 + x * x))
    return 8.0 * x * series(_ARCTAN_FAR, x * x)


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

    def constants(self, like: Tensor) -> tuple[Tensor, ...]:
        """s₀ and 1 / ρ as tensors on the device of `like`: ONNX would write plain numbers as float32."""
        return torch.tensor((self.shape, 1.0 / self.radius), dtype=like.dtype, device=like.device).unbind()

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
        The fields of `kcal.lens.model.Distorted`; `positive` is the disc on which the lens is defined.
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


# Which terms a lens model has, and the names and order of its coefficients.

# The term and the order of every coefficient, in storage order: OpenCV's 14 first, so that its models are prefixes,
# then the higher orders of Eq. 10 of the paper and their continuation. A name means the same in every model.
_COEFFICIENTS = {
    "k1": ("numerator", 1), "k2": ("numerator", 2), "p1": ("tangential", 1), "p2": ("tangential", 1),
    "k3": ("numerator", 3), "k4": ("denominator", 1), "k5": ("denominator", 2), "k6": ("denominator", 3),
    "s1": ("prism_x", 1), "s2": ("prism_x", 2), "s3": ("prism_y", 1), "s4": ("prism_y", 2),
    "tau_x": ("tilt", 1), "tau_y": ("tilt", 1),
    "k7": ("numerator", 4), "k8": ("numerator", 5), "k9": ("denominator", 4), "k10": ("denominator", 5),
    "s5": ("prism_x", 3), "s6": ("prism_y", 3),
    "k11": ("numerator", 6), "k12": ("denominator", 6), "k13": ("numerator", 7), "k14": ("denominator", 7),
    "s7": ("prism_x", 4), "s8": ("prism_y", 4),
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class LensModel:
    """A lens model: the order of each distortion term (Eq. 4 and Eq. 10 of the paper).

    Most models have a name: `LensModel.named("opencv5")`. Functions that take a model also take its name.

    Args:
        numerator: highest power of r² in the radial numerator, 0 to 7.
        denominator: highest power of r² in the radial denominator, 0 to 7.
        tangential: whether the tangential terms p1, p2 are present.
        prism: highest power of r² in the thin-prism terms, 0 to 4, the same for x and y.
        tilt: whether the angles τx, τy of a tilted sensor are present.
        fisheye: whether the numerator's series acts on the angle θ from the axis instead of its tangent
            (Kannala-Brandt): r_D = θ (1 + k1 θ² + k2 θ⁴ + ...). A fisheye has no other terms, and its coefficients are
            called k1, k2, k3, ... in this order, as in `cv2.fisheye`.
        hybrid: the constants of a hybrid lens (base projection, field and entrance pupil; `kcal.lens.model`),
            which has no other terms.

    Attributes:
        names: names of the coefficients in storage order: OpenCV's 14 first, then higher orders.
        numerator_index: indices of the numerator's coefficients of r², r⁴, ...
        denominator_index: indices of the denominator's coefficients of r², r⁴, ...
        prism_index: indices of the prism coefficients of r², r⁴, ..., for x and for y.
        without_tilt: the same model without its tilt; None if it has none.
        untilted_index: indices of the coefficients of `untilted`.

    Raises:
        InputError: an order out of range, or a fisheye or hybrid lens with other terms.

    Example:
        >>> LensModel(numerator=3, tangential=True).names
        ('k1', 'k2', 'p1', 'p2', 'k3')
        >>> LensModel.named("opencv14").size
        14
    """

    numerator: int = 0
    denominator: int = 0
    tangential: bool = False
    prism: int = 0
    tilt: bool = False
    fisheye: bool = False
    hybrid: HybridForm | None = None

    # Computed once: compilers cannot trace lazily computed attributes.
    names: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)
    numerator_index: tuple[int, ...] = dataclasses.field(init=False, repr=False, compare=False)
    denominator_index: tuple[int, ...] = dataclasses.field(init=False, repr=False, compare=False)
    prism_index: tuple[tuple[int, ...], tuple[int, ...]] = dataclasses.field(init=False, repr=False, compare=False)
    without_tilt: LensModel | None = dataclasses.field(init=False, repr=False, compare=False)
    untilted_index: tuple[int, ...] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, limit in (("numerator", 7), ("denominator", 7), ("prism", 4)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= limit:
                raise InputError(f"lens model: {name} must be a whole number from 0 to {limit}, got {value!r}")
        if self.fisheye and (self.denominator or self.tangential or self.prism or self.tilt):
            raise InputError("lens model: a fisheye has a numerator only; leave out the other terms")
        others = (self.numerator, self.denominator, self.tangential, self.prism, self.tilt, self.fisheye)
        if self.hybrid and any(others):
            raise InputError("lens model: a hybrid lens has terms of its own; leave out the others")
        highest = {
            "numerator": self.numerator, "denominator": self.denominator, "tangential": self.tangential,
            "prism_x": self.prism, "prism_y": self.prism, "tilt": self.tilt,
        }  # fmt: skip
        table = {f"k{i}": ("numerator", i) for i in range(1, 8)} if self.fisheye else _COEFFICIENTS
        terms = {name: term for name, (term, order) in table.items() if order <= highest[term]}

        def index(*chosen: str) -> tuple[int, ...]:
            return tuple(i for i, term in enumerate(terms.values()) if term in chosen)

        derived = {
            "names": self.hybrid.names if self.hybrid else tuple(terms),
            "numerator_index": index("numerator"),
            "denominator_index": index("denominator"),
            "prism_index": (index("prism_x"), index("prism_y")),
            "without_tilt": dataclasses.replace(self, tilt=False) if self.tilt else None,
            "untilted_index": index(*(term for term in highest if term != "tilt")),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @classmethod
    def named(cls, name: str | LensModel) -> LensModel:
        """Return the model with a preset name such as `"opencv5"`; a model is returned as it is.

        Raises:
            InputError: an unknown name; the message lists the known ones.
        """
        if isinstance(name, LensModel):
            return name
        if name not in PRESETS:
            raise InputError(f"unknown lens model {name!r}; choose one of {', '.join(PRESETS)}")
        return PRESETS[name]

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.names)

    @property
    def radial(self) -> bool:
        """Whether the lens is symmetric about its axis."""
        return not (self.tangential or self.prism or self.tilt or self.hybrid)

    @property
    def wide(self) -> bool:
        """Whether points beside the camera and behind it have a place on the lens's plane."""
        return self.fisheye or self.hybrid is not None

    @property
    def network(self) -> nn.Module | None:
        """The module inside the field of a hybrid lens, if that is a network (`kcal.lens.field_modes`)."""
        modes = self.hybrid and self.hybrid.modes
        return modes.trunk if isinstance(modes, NetworkModes) else None

    @property
    def weights(self) -> tuple[Tensor, ...]:
        """Weights of that network, by which derivatives may be asked for besides those by coefficients."""
        return () if self.network is None else tuple(self.network.parameters())

    @property
    def untilted(self) -> LensModel:
        """The same model without its tilt."""
        return self if self.without_tilt is None else self.without_tilt

    def contains(self, other: LensModel) -> bool:
        """Whether every lens of `other` is also a lens of this model."""
        return self.fisheye == other.fisheye and self.hybrid == other.hybrid and set(other.names) <= set(self.names)

    def __str__(self) -> str:
        if self.hybrid:
            return "hybrid" if self.network is None else "network"
        kind = "fisheye " if self.fisheye else ""
        return next((name for name, model in PRESETS.items() if model == self), f"{kind}({', '.join(self.names)})")


PRESETS: dict[str, LensModel] = {
    "pinhole": LensModel(),
    "opencv4": LensModel(numerator=2, tangential=True),
    "opencv5": LensModel(numerator=3, tangential=True),
    "opencv8": LensModel(numerator=3, denominator=3, tangential=True),
    "opencv12": LensModel(numerator=3, denominator=3, tangential=True, prism=2),
    "opencv14": LensModel(numerator=3, denominator=3, tangential=True, prism=2, tilt=True),
    "ext16": LensModel(numerator=4, denominator=4, tangential=True, prism=2, tilt=True),
    "ext18": LensModel(numerator=5, denominator=5, tangential=True, prism=2, tilt=True),
    "ext20": LensModel(numerator=5, denominator=5, tangential=True, prism=3, tilt=True),
    "ext20b": LensModel(numerator=6, denominator=6, tangential=True, prism=2, tilt=True),
    "ext22": LensModel(numerator=6, denominator=6, tangential=True, prism=3, tilt=True),
    "ext24": LensModel(numerator=7, denominator=7, tangential=True, prism=3, tilt=True),
    "fisheye4": LensModel(numerator=4, fisheye=True),
}


def larger_model(count: int) -> str:
    """Which model to choose for that many coefficients of OpenCV, in words.

    Example:
        >>> larger_model(8)
        'choose model="opencv8"'
    """
    fit = [name for name, model in PRESETS.items() if name.startswith("opencv") and model.size >= count]
    return f'choose model="{fit[0]}"' if fit else "choose a model with more"


# Compute the distortion of Eq. 4 and Eq. 10, for any orders, with closed-form derivatives.
#
# Convention: `normalized` points are (x, y) on the plane z = 1 of the camera, y down. The terms apply in this order:
#
#     s = x² + y²,  g = (1 + k1 s + k2 s² + ...) / (1 + k4 s + k5 s² + ...)
#     x_I = g x + 2 p1 x y + p2 (s + 2 x²) + s1 s + s2 s² + ...
#     y_I = g y + p1 (s + 2 y²) + 2 p2 x y + s3 s + s4 s² + ...
#     x_D = cos τx x_I / w,  y_D = (cos τy y_I - sin τx sin τy x_I) / w,
#     w = sin τy x_I - cos τy sin τx y_I + cos τy cos τx
#
# The last two lines are OpenCV's tilted-sensor homography multiplied out. Sources: the paper's Eq. 4 and 10; OpenCV's
# camera-calibration documentation for the tilt. A fisheye uses g alone, on points whose distance from the origin is the
# angle from the axis (`kcal.lens.projection`): the model of Kannala and Brandt (2006) in the form of `cv2.fisheye`.
#
# Coordinates are separate tensors (..., N), because these loops are bound by memory and so touch each number once.


class Distorted(NamedTuple):
    """Distorted coordinates with what validity and derivatives need; tensors are (..., N).

    `coefficients` (..., K, 2, N) are the derivatives of x and y by the K coefficients that were asked for. `point` is
    the Jacobian ∂x/∂x, ∂x/∂y, ∂y/∂x, ∂y/∂y, or () if it was not asked for. `positive` is true before any pole: where
    both the radial denominator and the tilt's w are positive.
    """

    x: Tensor
    y: Tensor
    point: tuple[Tensor, ...]
    coefficients: Tensor
    positive: Tensor

    @property
    def determinant(self) -> Tensor:
        """Determinant of the Jacobian: positive before the lens folds."""
        a, b, d, e = self.point
        return torch.addcmul(a * e, b, d, value=-1.0)


def polynomial(s: Tensor, coefficients: Sequence[Tensor], constant: float, slopes: bool) -> tuple[Tensor, Tensor]:
    """Evaluate constant + c1 s + c2 s² + ... by Horner's rule; its derivative by s is zero unless asked for."""
    if not coefficients:
        return torch.full_like(s, constant), torch.zeros_like(s)
    value, *rest = reversed(coefficients)
    slope = torch.zeros_like(value)
    for coefficient in rest:
        if slopes:
            slope = torch.addcmul(value, slope, s)
        value = torch.addcmul(coefficient, value, s)
    # value is (p - constant) / s here.
    return constant + value * s, torch.addcmul(value, slope, s) if slopes else slope


def distort_components(
    x: Tensor,
    y: Tensor,
    coefficients: Tensor,
    model: LensModel,
    wanted: Sequence[int] = (),
    *,
    slopes: bool = True,
) -> Distorted:
    """Distort separate coordinates x, y (..., N), with the derivatives that are asked for.

    Args:
        x: (..., N) coordinates on the plane z = 1; for a fisheye, on the plane of angles.
        y: (..., N).
        coefficients: (..., P) in the order of `model.names`, broadcast against the leading shape of x.
        model: the lens model.
        wanted: indices of the coefficients by which `Distorted.coefficients` are derivatives, in that order.
        slopes: whether `Distorted.point` is needed; leaving it out saves a third of the work.
    """
    if model.hybrid:
        return Distorted(*hybrid_terms(x, y, coefficients, model.hybrid, wanted, slopes))
    c = unbind_last(coefficients)
    xx, xy, yy = x * x, x * y, y * y
    s = xx + yy

    g, g_slope = polynomial(s, [c[i] for i in model.numerator_index], 1.0, slopes)
    inverse, positive = torch.ones_like(s), torch.ones_like(s, dtype=torch.bool)
    if model.denominator:
        denominator, denominator_slope = polynomial(s, [c[i] for i in model.denominator_index], 1.0, slopes)
        inverse, positive = denominator.reciprocal(), denominator > 0
        g = g * inverse
        if slopes:
            g_slope = (g_slope - g * denominator_slope) * inverse
    u, v = g * x, g * y
    point: tuple[Tensor, ...] = ()
    if slopes:
        double = 2.0 * g_slope
        cross = double * xy
        point = (torch.addcmul(g, double, xx), cross, cross, torch.addcmul(g, double, yy))
    if model.prism:
        prism_x, prism_x_slope = polynomial(s, [c[i] for i in model.prism_index[0]], 0.0, slopes)
        prism_y, prism_y_slope = polynomial(s, [c[i] for i in model.prism_index[1]], 0.0, slopes)
        u, v = u + prism_x, v + prism_y
        if slopes:
            rates = ((prism_x_slope, x), (prism_x_slope, y), (prism_y_slope, x), (prism_y_slope, y))
            point = tuple(torch.addcmul(rate, r, z, value=2.0) for rate, (r, z) in zip(point, rates, strict=True))
    if model.tangential:
        p1, p2 = c[model.names.index("p1")], c[model.names.index("p2")]
        p1x, p1y, p2x, p2y = p1 * x, p1 * y, p2 * x, p2 * y
        # p1 s + 2 y (p1 y + p2 x) is p1 (s + 2 y²) + 2 p2 x y, and likewise for x.
        shear = 2.0 * (p1y + p2x)
        u = torch.addcmul(torch.addcmul(u, p2, s), x, shear)
        v = torch.addcmul(torch.addcmul(v, p1, s), y, shear)
        if slopes:
            a, b, d, e = point
            # By the product rule: shear + 2 p2 x + 2 p2 x and so on.
            turn = 2.0 * (p2y + p1x)
            a, e = torch.add(a + shear, p2x, alpha=4.0), torch.add(e + shear, p1y, alpha=4.0)
            point = (a, b + turn, d + turn, e)

    columns = _coefficient_columns((x, y, s, xx, xy, yy), g, inverse, model, wanted)
    if not model.tilt:
        return Distorted(u, v, point, as_columns([pair for pair in columns if pair is not None], u), positive)

    tau_x, tau_y = c[model.names.index("tau_x")], c[model.names.index("tau_y")]
    cos_x, sin_x, cos_y, sin_y = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
    w = sin_y * u - (cos_y * sin_x) * v + cos_y * cos_x
    scale = w.reciprocal()
    x_tilted = cos_x * u * scale
    y_tilted = (cos_y * v - (sin_x * sin_y) * u) * scale
    if slopes:
        # The 2x2 Jacobian of the homography, times the one before it.
        m00, m01 = (cos_x - sin_y * x_tilted) * scale, (cos_y * sin_x) * x_tilted * scale
        m10, m11 = -sin_y * (sin_x + y_tilted) * scale, cos_y * (1.0 + sin_x * y_tilted) * scale
        a, b, d, e = point
        point = (m00 * a + m01 * d, m00 * b + m01 * e, m10 * a + m11 * d, m10 * b + m11 * e)
    by_angle: dict[str, tuple[Tensor, ...]] = {}
    if wanted:
        by_angle = {
            "tau_x": (-sin_x * u, -cos_x * sin_y * u, -cos_y * (cos_x * v + sin_x)),
            "tau_y": (torch.zeros_like(u), -sin_x * cos_y * u - sin_y * v, cos_y * u + sin_y * (sin_x * v - cos_x)),
        }
    tilted = []
    for index, pair in zip(wanted, columns, strict=True):
        if pair is None:
            x_rate, y_rate, w_rate = by_angle[model.names[index]]
            tilted.append(((x_rate - x_tilted * w_rate) * scale, (y_rate - y_tilted * w_rate) * scale))
        else:
            du, dv = pair
            tilted.append((m00 * du + m01 * dv, m10 * du + m11 * dv))
    return Distorted(x_tilted, y_tilted, point, as_columns(tilted, x_tilted), positive & (w > 0))


def as_columns(pairs: Sequence[tuple[Tensor, Tensor]], like: Tensor) -> Tensor:
    """Pairs of tensors that broadcast against (..., N) as one (..., K, 2, N)."""
    if not pairs:
        return like.new_zeros((*like.shape[:-1], 0, 2, like.shape[-1]))
    flat = torch.broadcast_tensors(*(part for pair in pairs for part in pair))
    return torch.stack(flat, -2).unflatten(-2, (len(pairs), 2))


def _coefficient_columns(
    plane: tuple[Tensor, ...], g: Tensor, inverse: Tensor, model: LensModel, wanted: Sequence[int]
) -> list[tuple[Tensor, Tensor] | None]:
    """Derivatives by the wanted coefficients at x, y with their products, before the tilt; None: a tilt angle."""
    if not wanted:
        return []
    x, y, s, xx, xy, yy = plane
    powers = [s]
    while len(powers) < max(model.numerator, model.denominator, model.prism):
        powers.append(powers[-1] * s)
    zero = torch.zeros_like(s)
    x_radial, y_radial = x * inverse, y * inverse
    table: dict[int, tuple[Tensor, Tensor]] = {}
    for j, i in enumerate(model.numerator_index):
        if i in wanted:
            table[i] = (x_radial * powers[j], y_radial * powers[j])
    for j, i in enumerate(model.denominator_index):
        if i in wanted:
            ratio = -g * powers[j]
            table[i] = (x_radial * ratio, y_radial * ratio)
    for j, i in enumerate(model.prism_index[0]):
        table[i] = (powers[j], zero)
    for j, i in enumerate(model.prism_index[1]):
        table[i] = (zero, powers[j])
    if model.tangential:
        table[model.names.index("p1")] = (2.0 * xy, s + 2.0 * yy)
        table[model.names.index("p2")] = (s + 2.0 * xx, 2.0 * xy)
    return [table.get(i) for i in wanted]


def check_coefficients(coefficients: Tensor, model: LensModel) -> Tensor:
    """Return the coefficients as float64 (..., P), after checking that P fits the model."""
    coefficients = torch.as_tensor(coefficients)
    if coefficients.ndim < 1 or coefficients.shape[-1] != model.size:
        raise InputError(
            f"coefficients: shape (..., {model.size}) is needed for {model}, got {tuple(coefficients.shape)}"
        )
    return coefficients.to(torch.float64)
