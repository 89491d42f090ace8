"""Give Newton's method a start: undo the radial part of a lens by a short polynomial, and the tilt in closed form.

For a lens with radial terms only, the undistorted radius is a function of the distorted one. Their ratio is fitted
once per lens by a polynomial in √(1 - r_D² / D²), where D is the largest distorted radius. In this variable the inverse
is smooth also at a fold, where it behaves as a square root. Within the image the polynomial is accurate to 1e-5 or
better for ordinary lenses. Newton's method does the rest, tangential and prism terms included.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.lens.distortion import distort_components, polynomial
from kcal.lens.model import LensModel
from kcal.lens.region import direction_limits
from kcal.lens.zernike import unbind_last

_DEGREE = 11
_NODES = 96
# An interval is split into so many parts, so many times: its end is a little beyond what was asked for, or the fold.
_PARTS, _SECTIONS = 64, 2
# Largest distorted radius for a lens without a camera: 56° through a pinhole.
_DEFAULT_REACH = 1.5


@torch.no_grad()
def fit_start(coefficients: Tensor, model: LensModel, reach: float | Tensor = _DEFAULT_REACH) -> Tensor:
    """Fit the polynomial of `start_from`.

    Args:
        coefficients: (..., P).
        model: the lens model.
        reach: (...) the largest distorted radius that will be asked for.

    Returns:
        (..., 1 + 12): D², then the coefficients by rising powers of 2 √(1 - r_D² / D²) - 1.
    """
    if model.hybrid:
        names = model.hybrid.radial_names
        radial, kept = model, torch.tensor([name in names for name in model.names])
        own = torch.where(kept.to(coefficients.device), coefficients, 0.0)
    else:
        radial = LensModel(numerator=model.numerator, denominator=model.denominator, fisheye=model.fisheye)
        own = coefficients[..., [model.names.index(name) for name in radial.names]]
    limit = direction_limits(own, radial, 1)

    def distorted(radius: Tensor) -> Tensor:
        return distort_components(radius, torch.zeros_like(radius), own, radial, slopes=False).x

    # D lies a little beyond the reach, or at the fold.
    wanted = torch.as_tensor(reach, dtype=torch.float64, device=own.device)[..., None]
    low, high = torch.zeros_like(limit), limit
    fractions = torch.linspace(0.0, 1.0, _PARTS + 1, dtype=torch.float64, device=own.device)
    for _ in range(_SECTIONS):
        # The interval is split into parts; the first whose end lies beyond is the next.
        ends = low + (high - low) * fractions[1:-1]
        part = (distorted(ends) <= 1.1 * wanted).to(torch.int64).cumprod(-1).sum(-1, keepdim=True)
        low, high = low + (high - low) * fractions[part], low + (high - low) * fractions[part + 1]
    # Evenly in angle: for a wide lens, equal steps on the plane would nearly all lie at its edge.
    steps = torch.linspace(1.0 / _NODES, 1.0, _NODES, dtype=torch.float64, device=own.device)
    radius = high * steps if model.wide else torch.tan(torch.atan(high) * steps)
    values = distorted(radius)
    largest = values[..., -1:] ** 2
    variable = 2.0 * torch.sqrt(torch.clamp(1.0 - values * values / largest, min=0.0)) - 1.0
    powers = variable[..., None] ** torch.arange(_DEGREE + 1, device=own.device)
    # A lens without any valid disc gives no equations; any ratio will do.
    usable = torch.isfinite(powers).all(-1).all(-1) & (largest[..., 0] > 0)
    plain = torch.zeros(_DEGREE + 1, dtype=torch.float64, device=own.device)
    plain[0] = 1.0
    powers = torch.where(usable[..., None, None], powers, 0.0)
    ratio = torch.where(usable[..., None], radius / values, 0.0)
    fitted = torch.linalg.pinv(powers, rtol=1e-13) @ ratio[..., None]
    fitted = torch.where(usable[..., None], fitted[..., 0], plain)
    return torch.cat([torch.where(usable[..., None], largest, 1.0), fitted], -1)


def start_from(x: Tensor, y: Tensor, model: LensModel, start: Tensor) -> tuple[Tensor, Tensor]:
    """Guess the undistorted coordinates for distorted ones (..., N) whose tilt is undone."""
    if not (model.numerator or model.denominator or model.hybrid):
        return x, y
    largest, constant, *rest = unbind_last(start)
    square = torch.addcmul(x * x, y, y)
    variable = 2.0 * torch.sqrt(torch.clamp(1.0 - square / largest, min=0.0)) - 1.0
    ratio, _ = polynomial(variable, rest, 0.0, False)
    ratio = ratio + constant
    return x * ratio, y * ratio


def undo_tilt(x: Tensor, y: Tensor, coefficients: Tensor, model: LensModel) -> tuple[Tensor, Tensor, Tensor, LensModel]:
    """Undo the tilt of distorted coordinates (..., N) in closed form: x, y, and the lens that remains."""
    if not model.tilt:
        return x, y, coefficients, model
    c = unbind_last(coefficients)
    tau_x, tau_y = c[model.names.index("tau_x")], c[model.names.index("tau_y")]
    cos_x, sin_x, cos_y, sin_y = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
    a, b = cos_x - sin_y * x, (cos_y * sin_x) * x
    d, e = -sin_y * (sin_x + y), cos_y * (1.0 + sin_x * y)
    scale = (cos_y * cos_x) * (a * e - b * d).reciprocal()
    return (
        (e * x - b * y) * scale,
        (a * y - d * x) * scale,
        coefficients[..., list(model.untilted_index)],
        model.untilted,
    )
