"""Maximum-likelihood positions: Gauss-Newton on the reprojection errors of two or more cameras.

A point is sought as a direction and an inverse distance from the first camera,

    X = (r + a e1 + b e2) / ρ,   camera c sees   R_c (r + a e1 + b e2) + ρ t_c

with r the first guess of the direction and e1, e2 across it. Pixels are nearly linear in (a, b, ρ) at any range, also
at infinity (ρ = 0) and beyond (ρ < 0, rays that diverge), so that two steps reach rounding, the normal equations are
well conditioned, and the errors of (a, b, ρ) are Gaussian where those of a distance are not. ρ is in units of one over
`scale`, the rig's own size.

Source: the parametrization is that of Civera, Davison and Montiel (2008), "Inverse Depth Parametrization for Monocular
SLAM"; the optimum is the one of Hartley and Sturm (1997).
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import is_traced, known_true
from kcal.lens.camera import Camera
from kcal.lens.camera_like import project_each
from kcal.lens.pose import side_axes, step_rows
from kcal.lens.projection import Projection
from kcal.locate.angular import Surroundings, length_of_one, lifted

# Evaluations. Graphs cannot stop early: with three they err by 4e-6 of the noise where marks are 10 px off, with two by
# 1e-2.
_MOST_STEPS, _TRACED_STEPS = 5, 3
# The derivative of the optimum comes from this many steps with a fixed matrix; each leaves a share of about the
# residual over the focal length, 1e-4, of the error.
_CHORDS = 2
# A step that moves no pixel by more than this, in units of the noise, is the last.
_SHORT_STEP = 1e-5

Six = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


class RelativeCamera(NamedTuple):
    """A camera and its pose: points_cam = rotation @ points + translation, (3,), or (..., 3, N) for each point."""

    camera: Camera
    rotation: Tensor
    translation: Tensor


class PointFit(NamedTuple):
    """Points at the optimum, in the first camera's frame; K = 3 unknowns a, b, ρ; M = 2 C pixel coordinates.

    Attributes:
        direction: (..., 3, N), not of length one; the point is scale * direction / inverse.
        inverse: (..., N) ρ.
        sides: (..., 2, 3, N) the vectors e1 and e2.
        covariance: the six of the (..., N) symmetric 3x3 covariance of (a, b, ρ) from the noise of the pixels.
        gain: (..., 3, M, N) change of (a, b, ρ) by each pixel coordinate.
        jacobian: (..., 3, M, N) change of each pixel coordinate by (a, b, ρ).
        residual: (..., M, N) predicted minus measured pixels.
        projections: one for each camera, at the optimum.
        turned: one for each camera, (..., 3, N): the direction in the camera's axes, before its translation.
    """

    direction: Tensor
    inverse: Tensor
    sides: Tensor
    covariance: Six
    gain: Tensor
    jacobian: Tensor
    residual: Tensor
    projections: tuple[Projection, ...]
    turned: tuple[Tensor, ...]


class _Evaluated(NamedTuple):
    cost: Tensor
    jacobian: Tensor
    weighted: Tensor
    residual: Tensor
    turned: Tensor
    projections: tuple[Projection, ...]
    slope: Tensor


class _Fixed(NamedTuple):
    """What stays fixed while (a, b, ρ) moves.

    Attributes:
        cameras: C of them.
        scale: meters.
        base: (..., C, 3, N) the first guess of the direction in the axes of each camera.
        columns: (..., C, 3, 3, N) what a, b and ρ add to it.
        pixels: (..., 2 C, N).
        usable: (..., N).
        weight: (..., 2 C, 2 C, N) or None.
        wanted: for each camera the parameters by which derivatives are formed.
        start: (..., N) the first guess of ρ.
        around: what there is besides pixels.
    """

    cameras: Sequence[Camera]
    scale: Tensor
    base: Tensor
    columns: Tensor
    pixels: Tensor
    usable: Tensor
    weight: Tensor | None
    wanted: tuple[tuple[int, ...], ...]
    start: Tensor
    around: Surroundings


def most_likely(
    cameras: Sequence[RelativeCamera],
    scale: Tensor,
    start: tuple[Tensor, Tensor],
    pixels: Tensor,
    usable: Tensor,
    weight: Tensor | None = None,
    *,
    by_camera: bool = False,
    differentiated: bool = False,
    around: Surroundings | None = None,
) -> PointFit:
    """Minimize the weighted squares of the reprojection errors, each point on its own.

    Args:
        cameras: C cameras; the points' frame is the first one's where its pose is the identity.
        scale: meters, the size of the rig; sets the unit of ρ.
        start: unit directions (..., N, 3) in that frame, and ρ (..., N).
        pixels: (..., 2 C, N): u, v of the first camera, u, v of the second, ...
        usable: (..., N); what is not gets a harmless answer.
        weight: (..., 2 C, 2 C, N) inverse covariance of the pixels; None: independent with a variance of one.
        by_camera: also form derivatives by the cameras' own parameters (`projections[c].by_camera`).
        differentiated: let gradients flow to pixels, weights, cameras and poses.
        around: what there is besides pixels, if anything.
    """
    base = start[0].detach().mT
    sides = torch.stack([side.mT for side in side_axes(start[0].detach())], -3)
    lenses = [each.camera for each in cameras]
    wanted = tuple(tuple(range(lens.values.shape[-1])) if by_camera else () for lens in lenses)
    rotation = torch.stack([each.rotation for each in cameras])
    moves = [each.translation if each.translation.ndim > 1 else each.translation[:, None] for each in cameras]
    shift = torch.stack(moves, -3) / scale
    turned_sides = rotation[:, None] @ sides[..., None, :, :, :]
    columns = torch.cat([turned_sides, shift[..., None, :, :].expand_as(turned_sides[..., :1, :, :])], -3)
    turned_base = rotation @ base[..., None, :, :]
    nothing = tuple(() for _ in cameras)
    first = torch.where(usable, start[1], 0.0).detach()
    around = around or Surroundings()
    fixed = _Fixed(lenses, scale, turned_base, columns, pixels, usable, weight, nothing, first, around)
    whole = fixed._replace(wanted=wanted)
    # After a step, the evaluation that finds nothing left to move is also the last one.
    later = fixed if differentiated or is_traced() else whole
    zero = torch.zeros_like(start[1])
    # With gradients, an evaluation after which the step is short is also that of the first chord.
    recorded = differentiated and torch.is_grad_enabled() and not is_traced()
    inverse: Sequence[Tensor] = ()
    with torch.no_grad():
        theta = torch.stack([zero, zero, first], -2)
        best, step, cost = theta, torch.zeros_like(theta), torch.full_like(zero, torch.inf)
        # A lower bound of the pixels' noise.
        noise = 1.0 if weight is None else weight.diagonal(dim1=-3, dim2=-2).amax(-1).clamp_min(1e-30).rsqrt()
        length = torch.full_like(zero, torch.inf)
        for number in range(_TRACED_STEPS if is_traced() else _MOST_STEPS):
            # An exported graph must have no change of mode without any operation: it could not be loaded.
            with torch.enable_grad() if recorded and number else contextlib.nullcontext():
                at = _evaluate(later if number else fixed, theta)
            # After so short a step, rounding may raise the cost.
            better = (at.cost <= cost) | (length <= _SHORT_STEP * noise)
            every = known_true(better)
            covariance = _covariance_at(at, fixed)
            newton = -_product(covariance, at.slope)
            moved = (at.jacobian * newton[..., None, :]).sum(-3)
            farthest = moved.abs().amax(-2)
            if every:
                best, step, cost, length = theta, newton, at.cost, farthest
            else:
                best = torch.where(better[..., None, :], theta, best)
                step = torch.where(better[..., None, :], newton, 0.25 * step)
                cost = torch.where(better, at.cost, cost)
                length = torch.where(better, farthest, 0.25 * length)
            theta = best + step
            if every and known_true(length <= _SHORT_STEP * noise):
                if recorded and number:
                    theta, inverse = best, covariance
                if differentiated or (by_camera and not number):
                    break
                # So short a step is linear to rounding: it is taken without another evaluation.
                a, b = (newton[..., None, i, None, :] for i in (0, 1))
                turned = at.turned + a * columns[..., 0, :, :] + b * columns[..., 1, :, :]
                return _fit_at(at._replace(residual=at.residual + moved, turned=turned), theta, sides, covariance)
        else:
            theta = best
    if differentiated:
        known = bool(inverse)
        if not known:
            with torch.no_grad():
                inverse = [value.detach() for value in _covariance_at(_evaluate(fixed, theta), fixed)]
        for number in range(_CHORDS):
            if number or not known:
                at = _evaluate(fixed, theta)
            theta = theta - torch.where(usable[..., None, :], _product(inverse, at.slope), 0.0)
    at = _evaluate(whole, theta)
    return _fit_at(at, theta, sides, _covariance_at(at, fixed))


def _evaluate(fixed: _Fixed, theta: Tensor) -> _Evaluated:
    a, b, inverse = (value[..., None, None, :] for value in theta.unbind(-2))
    e1, e2, shift = fixed.columns.unbind(-3)
    turned = fixed.base + a * e1 + b * e2
    seen = turned + inverse * shift
    around = fixed.around
    if around.up is not None:
        seen = seen + lifted(seen, around, length_of_one(fixed.scale, inverse))
    with torch.no_grad():
        good = fixed.usable[..., None, :].expand(seen[..., 2, :].shape)
        if around.present is not None:
            good = good & around.present
        wide = [camera.wide for camera in fixed.cameras]
        if not all(wide):
            # A perspective lens sees nothing beside and behind the camera.
            good = good & ((seen[..., 2, :] > 1e-6) | torch.tensor(wide, device=seen.device)[:, None])
    if not known_true(good):
        # The axis is a harmless stand-in: no NaN in values or gradients.
        seen = torch.where(good[..., None, :], seen, seen.new_tensor([[0.0], [0.0], [1.0]]))
    # `seen` is the point times ρ / scale, so small that an entrance pupil seems to move too far.
    meter = inverse[..., 0, 0, :] / fixed.scale
    projections = project_each(fixed.cameras, seen, fixed.wanted, meter)
    by_point = torch.stack([projection.by_point for projection in projections], -4)
    # (..., C, 3 unknowns, 3 of the point, 2, N) summed over the point.
    slopes = (fixed.columns[..., None, :] * by_point[..., None, :, :, :]).sum(-3)
    rates = [projection.by_meter for projection in projections]
    if any(rate is not None for rate in rates):
        zero = torch.zeros_like(slopes[..., 0, 2, :, :])
        moved = torch.stack([zero if rate is None else rate / fixed.scale for rate in rates], -3)
        slopes = torch.cat([slopes[..., :2, :, :], (slopes[..., 2, :, :] + moved)[..., None, :, :]], -3)
    jacobian = slopes.movedim(-4, -3).flatten(-3, -2)
    predicted = torch.cat([projection.pixels for projection in projections], -2)
    counts = fixed.usable[..., None, :]
    if around.present is not None:
        counts = counts & around.present.repeat_interleave(2, -2)
        jacobian = torch.where(counts[..., None, :, :], jacobian, 0.0)
    residual = torch.where(counts, predicted - fixed.pixels, 0.0)
    weighted = jacobian
    if fixed.weight is None:
        cost = (residual * residual).sum(-2)
    else:
        weighted = (fixed.weight[..., None, :, :, :] * jacobian[..., None, :, :]).sum(-2)
        cost = (fixed.weight * residual[..., None, :, :] * residual[..., None, :]).sum((-3, -2))
    slope = (weighted * residual[..., None, :, :]).sum(-2)
    if around.held is not None:
        moved = torch.stack([*theta.unbind(-2)[:2], theta[..., 2, :] - fixed.start], -2)
        off = (around.held * moved).sum(-2) + around.held_off
        cost, slope = cost + off * off, slope + around.held * off[..., None, :]
    return _Evaluated(cost, jacobian, weighted, residual, turned, tuple(projections), slope)


def _covariance_at(at: _Evaluated, fixed: _Fixed) -> Six:
    """Of (a, b, ρ), from the noise of the pixels and a held row: entries 11, 12, 13, 22, 23, 33; zeros if singular."""
    j, w = at.jacobian.unbind(-3), at.weighted.unbind(-3)
    places = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    entries = torch.stack([j[row] * w[column] for row, column in places], -3).sum(-2)
    still = entries.new_tensor([[float(row == column)] for row, column in places])
    a, b, c, d, e, f = torch.where(fixed.usable[..., None, :], entries, still).unbind(-2)
    # ρ is eliminated first, so that a height which is known far better than pixels leaves their digits.
    held = None if fixed.around.held is None else fixed.around.held.unbind(-2)
    whole = f if held is None else f + held[2] * held[2]
    whole, known = torch.where(whole > 0, whole, 1.0), whole > 0
    A, B, D = a - c * c / whole, b - c * e / whole, d - e * e / whole
    if held is not None:
        p, q, r = held
        A = A + p * (f * p - 2.0 * r * c) / whole
        B = B + (f * p * q - r * (c * q + e * p)) / whole
        D = D + q * (f * q - 2.0 * r * e) / whole
        c, e = c + p * r, e + q * r
    determinant = A * D - B * B
    regular = known & (determinant > 0)
    scale = torch.where(regular, 1.0 / torch.where(regular, determinant, 1.0), 0.0)
    A, B, D, c, e = A * scale, B * scale, D * scale, c / whole, e / whole
    by_a, by_b = B * e - D * c, B * c - A * e
    return D, -B, by_a, A, by_b, torch.where(regular, 1.0 / whole - c * by_a - e * by_b, 0.0)


def _product(m: Sequence[Tensor], v: Tensor) -> Tensor:
    a, b, c, d, e, f = m
    x, y, z = v.unbind(-2)
    return torch.stack([a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + f * z], -2)


def _fit_at(at: _Evaluated, theta: Tensor, sides: Tensor, covariance: Six) -> PointFit:
    spread = [entry[..., None, :] for entry in covariance]
    gain = _product(spread, at.weighted.movedim(-3, -2)).movedim(-2, -3)
    turned = at.turned.unbind(-3)
    return PointFit(
        turned[0], theta[..., 2, :], sides, covariance, gain, at.jacobian, at.residual, at.projections, turned
    )


def by_pose(fit: PointFit, number: int) -> Tensor:
    """Derivatives (..., 6, 2, N) of the predicted pixels of a camera by a step of its pose: rotation, translation.

    The step is that of `kcal.lens.pose`: a rotation vector (radians) from the left and an added translation
    (in units of `scale`, as the inverse distance is).
    """
    rows = step_rows(fit.projections[number].by_point, fit.turned[number])
    turn, shift = rows[..., :3, :, :], rows[..., 3:, :, :]
    return torch.cat([turn, shift * fit.inverse[..., None, None, :]], -3)


def inverse_variance(fit: PointFit, spread: Sequence[Tensor]) -> Tensor:
    """(..., N) variance of ρ / |direction| times |direction|², given that of a, b and ρ in six entries."""
    aa, ab, ar, bb, br, rr = spread
    a, b = (fit.direction[..., None, :, :] * fit.sides).sum(-2).unbind(-2)
    # The direction was of length one where a and b are zero: they are small, and their derivatives are not.
    share = fit.inverse / fit.direction.square().sum(-2)
    return rr + share * (share * (a * a * aa + 2.0 * a * b * ab + b * b * bb) - 2.0 * (a * ar + b * br))


def symmetric(six: Sequence[Tensor]) -> Tensor:
    """Six entries (..., N) as symmetric matrices (..., N, 3, 3)."""
    a, b, c, d, e, f = six
    return torch.stack([a, b, c, b, d, e, c, e, f], -1).unflatten(-1, (3, 3))


def position_slope(fit: PointFit, scale: Tensor, ok: Tensor) -> Tensor:
    """(..., N, 3, 3) derivatives of points in the first camera's frame by a, b and ρ; finite where not `ok`."""
    inverse = torch.where(ok, fit.inverse, 1.0)
    ahead = torch.where(ok[..., None, :], fit.direction / inverse[..., None, :], 0.0)
    columns = torch.stack([*fit.sides.unbind(-3), -ahead], -1)  # (..., 3, N, 3)
    return ((scale / inverse)[..., None, :, None] * columns).movedim(-3, -2)


def calibration_effect(fit: PointFit, scale: Tensor, factor: Tensor) -> Tensor:
    """(..., R, K, N) effect on a, b and ρ (the R rows of `fit.gain`) of K independent errors; `fit` of two cameras.

    A rise of a parameter that moves predicted pixels acts as a measurement that moved the other way.

    Args:
        fit: with derivatives by the cameras' parameters.
        scale: meters, the unit of ρ.
        factor: (P, K) what the errors change in the parameters, in the order of `RigCovariance`.
    """
    left, right = (projection.by_camera for projection in fit.projections)
    pose = by_pose(fit, 1)
    pose = torch.cat([pose[..., :3, :, :], pose[..., 3:, :, :] / scale], -3)
    own, other = factor.split([left.shape[-3], len(factor) - left.shape[-3]])

    def pixels(factor: Tensor, moved: Tensor) -> Tensor:
        return (factor.mT @ moved.flatten(-2)).unflatten(-1, moved.shape[-2:])

    moved = torch.cat([pixels(own, left), pixels(other, torch.cat([right, pose], -3))], -2)  # (..., K, 4, N)
    # One of the four pixel coordinates after the other: all at once would take four times the memory.
    gain, moved = -fit.gain[..., :, None, :, :], moved[..., None, :, :, :]
    effect = gain[..., 0, :] * moved[..., 0, :]
    for k in range(1, moved.shape[-2]):
        effect = torch.addcmul(effect, gain[..., k, :], moved[..., k, :])
    return effect


def inverse_covariances(cov: Tensor | None) -> tuple[Tensor | None, Tensor]:
    """Inverses of covariances (..., N, M, M) as (..., M, M, N), and where they exist."""
    if cov is None:
        return None, torch.ones((), dtype=torch.bool)
    with torch.no_grad():
        mirrored = (cov - cov.mT).abs().amax((-2, -1)) <= 1e-6 * cov.abs().amax((-2, -1))
        finite = torch.isfinite(cov).all(-1).all(-1) & mirrored
        still = torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device)
        _, info = torch.linalg.cholesky_ex(torch.where(finite[..., None, None], cov, still))
        sound = finite & (info == 0)
    safe = torch.where(sound[..., None, None], 0.5 * (cov + cov.mT), still)
    # The forward derivative of `torch.cholesky_inverse` is wrong (PyTorch 2.11).
    inverse = torch.cholesky_solve(still.expand_as(safe), torch.linalg.cholesky_ex(safe)[0])
    return inverse.movedim(-3, -1), sound
