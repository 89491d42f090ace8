"""From distorted back to undistorted coordinates: damped Newton that says where it failed, and where it may be asked.

The distortion of Eq. 4 is no bijection of the plane: it folds back (det J = 0) or meets a pole at some radius. Only
the part around the optical axis before the first fold or pole is the lens; `valid_radius` measures it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.lens.distortion import check_coefficients, distort_components
from kcal.lens.model import LensModel

# tan 89°: nothing that projects through a plane is asked for beyond this.
MAX_RADIUS = math.tan(math.radians(89.0))
_ITERATIONS = 40
# Residual in normalized coordinates: 1e-13 is 2e-10 px at f = 2000 px, just above rounding.
_TOLERANCE = 1e-13


@torch.no_grad()
def valid_radius(coefficients: Tensor, model: LensModel | str) -> Tensor:
    """Radius of the disc on the plane z = 1 inside which the lens neither folds nor meets a pole.

    Walks outward along 64 directions, 1/6° a step, to the first place where the Jacobian's determinant, the radial
    denominator or the tilt's w is no longer positive, narrows it down, and takes the smallest.

    Args:
        coefficients: (..., P).
        model: a `LensModel` or a preset's name.

    Returns:
        (...) float64; tan 89° where nothing goes wrong before.

    Example:
        >>> k = torch.tensor([-1.0 / 12.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        >>> round(float(valid_radius(k, "opencv4")), 12)  # x - x³/12 turns back at x = 2
        2.0
    """
    model = LensModel.named(model)
    coefficients = check_coefficients(coefficients, model)
    kind, place = torch.float64, coefficients.device
    direction = torch.arange(64, dtype=kind, device=place) * (2 * math.pi / 64)

    def good(radius: Tensor) -> Tensor:
        """Radii (..., K, 64), one column a direction -> how many from the first on are regular, (..., 64)."""
        x, y = (radius * torch.cos(direction)).flatten(-2), (radius * torch.sin(direction)).flatten(-2)
        lens = distort_components(x, y, coefficients, model)
        a, b, d, e = lens.point
        regular = (lens.positive & (a * e - b * d > 0)).unflatten(-1, (-1, 64))
        return regular.to(torch.int64).cumprod(-2).sum(-2)

    # From the axis out, then each interval split in 32 again until it is as narrow as rounding.
    radii = torch.tan(torch.linspace(0, math.radians(89.0), 535, dtype=kind, device=place))[:, None].expand(-1, 64)
    for _ in range(11):
        count = good(radii)
        radii = radii.expand(*count.shape[:-1], -1, -1)
        # A lens that is irregular on the axis itself (a tilt beyond 90°, say) has no valid disc: radius zero.
        low = torch.gather(radii, -2, (count - 1).clamp(min=0)[..., None, :])
        high = torch.gather(radii, -2, count.clamp(max=radii.shape[-2] - 1)[..., None, :])
        radii = low + (high - low) * torch.linspace(0, 1, 33, dtype=kind, device=place)[:, None]
    return low[..., 0, :].amin(-1)


def _untilt(x: Tensor, y: Tensor, coefficients: Tensor, model: LensModel) -> tuple[Tensor, Tensor]:
    """Undo the tilt homography in closed form: a start for Newton."""
    if not model.tilt:
        return x, y
    tau_x = coefficients[..., model.names.index("tau_x"), None]
    tau_y = coefficients[..., model.names.index("tau_y"), None]
    cos_x, sin_x, cos_y, sin_y = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
    a, b = cos_x - sin_y * x, cos_y * sin_x * x
    d, e = -sin_y * (sin_x + y), cos_y * (1.0 + sin_x * y)
    right_x, right_y = cos_y * cos_x * x, cos_y * cos_x * y
    determinant = a * e - b * d
    return (e * right_x - b * right_y) / determinant, (a * right_y - d * right_x) / determinant


def undistort(
    distorted: Tensor, coefficients: Tensor, model: LensModel | str, radius: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Undo the distortion, or say that it cannot be undone.

    Newton's method with the 2x2 Jacobian, each point on its own: a step that does not lower the residual, or that
    leaves the valid disc, is halved. The last two steps stay in the autograd graph: at a solution, a Newton step
    has the exact implicit derivative by the point and by the coefficients, and two of them the second one too.

    Args:
        distorted: (..., N, 2) distorted coordinates on the plane z = 1.
        coefficients: (..., P).
        model: a `LensModel` or a preset's name.
        radius: (...) from `valid_radius`, computed here if not given.

    Returns:
        normalized (..., N, 2) and valid (..., N). Where `valid` is False there is no preimage inside the valid disc
        (or the input was not finite), and the coordinates are zero.

    Raises:
        InputError: wrong shapes or an integer dtype.

    Example:
        >>> k = torch.tensor([-0.2, 0.0, 0.0, 0.0])
        >>> undistort(torch.tensor([[0.475, 0.0], [3.0, 0.0]]), k, "opencv4")[1].tolist()
        [True, False]
    """
    model = LensModel.named(model)
    distorted = as_points("distorted", distorted, 2)
    coefficients = check_coefficients(coefficients, model)
    if radius is None:
        radius = valid_radius(coefficients, model)
    target_x, target_y = distorted[..., 0], distorted[..., 1]
    finite = torch.isfinite(target_x) & torch.isfinite(target_y)
    target_x = torch.where(finite, target_x, 0.0)
    target_y = torch.where(finite, target_y, 0.0)
    limit = radius[..., None]

    with torch.no_grad():
        x, y, converged = _newton(target_x, target_y, coefficients, model, limit)
        # The limit itself is a fold: a little inside, the Jacobian can still be inverted.
        valid = finite & converged & (torch.hypot(x, y) < limit)
        x, y = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0)
        target_x, target_y = torch.broadcast_tensors(target_x, target_y)
    if torch.is_grad_enabled() and (distorted.requires_grad or coefficients.requires_grad):
        for _ in range(2):
            step_x, step_y = _newton_step(x, y, target_x, target_y, coefficients, model)
            x, y = torch.where(valid, x - step_x, 0.0), torch.where(valid, y - step_y, 0.0)
    return torch.stack([x, y], -1), valid


def _newton_step(
    x: Tensor, y: Tensor, target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel
) -> tuple[Tensor, Tensor]:
    lens = distort_components(x, y, coefficients, model)
    a, b, d, e = lens.point
    inverse = 1.0 / (a * e - b * d)
    error_x, error_y = lens.x - target_x, lens.y - target_y
    return (e * error_x - b * error_y) * inverse, (a * error_y - d * error_x) * inverse


def _newton(
    target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel, limit: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    def evaluate(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        lens = distort_components(x, y, coefficients, model)
        a, b, d, e = lens.point
        error_x, error_y = lens.x - target_x, lens.y - target_y
        determinant = a * e - b * d
        inverse = torch.where(determinant > 0, 1.0 / determinant, 0.0)
        error = torch.where(lens.positive, torch.hypot(error_x, error_y), math.inf)
        return (e * error_x - b * error_y) * inverse, (a * error_y - d * error_x) * inverse, error

    x, y = _untilt(target_x, target_y, coefficients, model)
    step_x, step_y, error = evaluate(x, y)
    # Never start on the rim: beside a pole Newton only doubles its distance a step. The axis is always regular.
    lost = ~torch.isfinite(error) | ~(torch.hypot(x, y) < limit)
    x, y = torch.where(lost, 0.0, x), torch.where(lost, 0.0, y)
    step_x, step_y, error = evaluate(x, y)
    tolerance = _TOLERANCE * (1.0 + torch.hypot(target_x, target_y))
    fraction = torch.ones_like(error)
    for _ in range(_ITERATIONS):
        if not torch.compiler.is_compiling() and bool((error <= tolerance).all()):
            break
        trial_x, trial_y = x - fraction * step_x, y - fraction * step_y
        next_x, next_y, next_error = evaluate(trial_x, trial_y)
        # Refused, not moved to the rim: there, beside a fold, a point can get stuck.
        better = (next_error < error) & (torch.hypot(trial_x, trial_y) < limit)
        x, y = torch.where(better, trial_x, x), torch.where(better, trial_y, y)
        step_x, step_y = torch.where(better, next_x, step_x), torch.where(better, next_y, step_y)
        error = torch.where(better, next_error, error)
        fraction = torch.where(better, torch.clamp(2.0 * fraction, max=1.0), 0.5 * fraction)
    return x, y, error <= tolerance
