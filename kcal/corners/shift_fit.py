"""Shift, contrast and brightness of patches by robust least squares, with covariance and implicit gradients."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.corners.filters import correlated, gaussian_kernel
from kcal.corners.patch_windows import IMAGE_BLUR, ImageWindows, grid_of, sample
from kcal.dispatch import is_differentiated

_MOST_STEPS = 25
_CONVERGED = 1e-4  # steps
# Residuals of pixels nearby, in standard deviations of all, at which the weight is zero. Background and what stands in
# front are areas, so that the mean square of a few pixels tells them from noise, which is 1 ± 0.3 there.
_BIWEIGHT = 3.0
_NEARBY = gaussian_kernel(1.0, 2)
# Blur of the noise in samples, steps: of the images, and of bilinear samples between pixels, σ² = 1/6 on average.
_NOISE_BLUR = gaussian_kernel(math.sqrt(IMAGE_BLUR**2 + 1.0 / 6.0), 4)
_TRIANGLE = 1.0 - torch.arange(-4, 5, dtype=torch.float64).abs() / 5.0
_MEDIAN = 1.4826  # standard deviations in the median absolute value of Gaussian noise


class ShiftFit(NamedTuple):
    """Shifts of N patches.

    Attributes:
        shift: (N, 2) steps of the plane.
        covariance: (N, 2, 2) of the shift.
        converged: (N,).
        share: (N,) share of the weight that robust weights left.
        shear: (N, 2) steps along the first axis by which a step along each axis stretches or shears the right patch; 0
            if not fitted.
    """

    shift: Tensor
    covariance: Tensor
    converged: Tensor
    share: Tensor
    shear: Tensor


class _Patches(NamedTuple):
    template: Tensor
    right: ImageWindows
    moved: Tensor
    slopes: Tensor
    weight: Tensor
    grid: Tensor | None

    def at(self, which: Tensor) -> _Patches:
        """The objects at some places."""
        right = self.right.at(which)
        slopes, weight = self.slopes[which], self.weight[which]
        return _Patches(self.template[which], right, self.moved[which], slopes, weight, self.grid)


def _residual(patches: _Patches, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Residual (N, K), slopes (N, K, 2) and design (N, K, 4 or 8) at theta.

    Theta is shift, gain, offset and, of sheared patches, scale and shear, and slopes of brightness.
    """
    across, down = patches.slopes.unbind(-1)
    shift = theta[:, None, None, :2]
    if patches.grid is not None:
        along = torch.einsum("hwk,nk->nhw", patches.grid, theta[:, 4:6])
        shift = torch.stack([shift[..., 0] + along, shift[..., 1].expand_as(along)], -1)
    at = torch.addcmul(torch.addcmul(patches.moved, across, shift[..., :1]), down, shift[..., 1:])
    # The value and, for the slopes, a step to each side along both axes.
    places = torch.stack([at, at + across, at - across, at + down, at - down], 1)
    values, *sides = sample(patches.right, places).flatten(2).unbind(1)
    slope = torch.stack([0.5 * (sides[0] - sides[1]), 0.5 * (sides[2] - sides[3])], -1)
    template = patches.template.flatten(1)
    residual = values - theta[:, 2:3] * template - theta[:, 3:4]
    design = torch.cat([slope, -template[..., None], -torch.ones_like(template)[..., None]], -1)
    if patches.grid is not None:
        steps = patches.grid.flatten(0, 1)
        residual = residual - theta[:, 6:] @ steps.T
        design = torch.cat([design, slope[..., :1] * steps, -steps.expand(len(slope), -1, -1)], -1)
    return residual, slope, design


def _biweight(residual: Tensor, scale: Tensor, patches: _Patches) -> Tensor:
    """(N, K) weights by the mean square of residuals (N, K) nearby."""
    kernel = _NEARBY.to(residual)
    squares = residual.square().reshape(patches.template.shape)[:, None]
    reach = len(kernel) // 2
    padded = torch.nn.functional.pad(squares, (reach,) * 4, mode="replicate")
    mean = correlated(padded, kernel, kernel).reshape(residual.shape)
    return (1.0 - mean / (_BIWEIGHT * scale[:, None]).square()).clamp_min(0.0).square()


def _scale(residual: Tensor, weight: Tensor) -> Tensor:
    """(N,) robust standard deviation: from the weighted median of absolute residuals."""
    ordered, order = residual.abs().sort(dim=1)
    cumulated = weight.gather(1, order).cumsum(1)
    at = (cumulated < 0.5 * cumulated[:, -1:]).sum(1).clamp_max(residual.shape[1] - 1)
    return (_MEDIAN * ordered.gather(1, at[:, None])[:, 0]).clamp_min(1e-9)


def _balance(patches: _Patches, theta: Tensor, scale: Tensor) -> Tensor:
    """(N, 4 or 8) what is zero at the solution."""
    residual, _, design = _residual(patches, theta)
    weight = patches.weight.flatten(1) * _biweight(residual, scale, patches)
    return ((weight * residual)[..., None] * design).sum(1)


def fit_shifts(
    template: Tensor,
    right: ImageWindows,
    moved: Tensor,
    slopes: Tensor,
    weight: Tensor,
    wanted: Tensor,
    *,
    robust: bool = True,
    sheared: bool = False,
) -> ShiftFit:
    """Fit right(moved + slopes shift) = gain template + offset.

    Args:
        template: (N, h, w) of the left image.
        right: windows of the right image.
        moved: (N, h, w, 2) pixels of the right image at zero shift.
        slopes: (N, h, w, 2, 2) their derivatives by a step along the plane's axes (last axis).
        weight: (N, h, w) of the pixels.
        wanted: (N,) bool: objects to fit. Others have not converged, and zeros.
        robust: pixels that do not fit lose their weight.
        sheared: the right patch may also be scaled and sheared along the plane's first axis, and its brightness may
            have a slope: the sun's reflection, haze and vignetting of one camera are others in the other.
    """
    which = wanted.nonzero()[:, 0]
    nothing = torch.zeros_like(moved[:, 0, 0])
    if not len(which):
        return ShiftFit(nothing, torch.zeros_like(slopes[:, 0, 0]), torch.zeros_like(wanted), nothing[:, 0], nothing)
    half = (template.shape[2] // 2, template.shape[1] // 2)
    grid = grid_of(half, template.device) if sheared else None
    patches = _Patches(template, right, moved, slopes, weight, grid).at(which)
    with torch.no_grad():
        values = patches.right.values.detach()
        still = patches._replace(template=patches.template.detach(), right=patches.right._replace(values=values))
        theta, scale, step = _fitted_shifts(still, robust)
        residual, slope, _ = _residual(still, theta)
        weight = still.weight.flatten(1)
        kept = weight * _biweight(residual, scale, still)
        covariance, sound = _covariance(still, theta, residual, slope, kept)
        # In a perfect fit a biweight takes a few percent.
        share = kept.sum(1) / weight.sum(1).clamp_min(1e-12)
        converged = (step < 10 * _CONVERGED) & sound & theta.isfinite().all(1)
        theta = torch.where(converged[:, None], theta, 0.0)
    shift = theta[:, :2]
    if is_differentiated(template, right.values):
        shift = _implicit(patches, theta, scale, converged)[:, :2]
    shear = theta.new_zeros(len(theta), 2) if grid is None else theta[:, 4:6]
    found = ShiftFit(shift, covariance, converged, share, shear)
    return ShiftFit(*(part.new_zeros(len(wanted), *part.shape[1:]).index_copy(0, which, part) for part in found))


def _fitted_shifts(patches: _Patches, robust: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Theta, scale of the residuals and length of the last step; each object stops when it has converged."""
    count = len(patches.weight)
    unknowns = 4 if patches.grid is None else 8
    theta = patches.template.new_zeros(count, unknowns)
    theta[:, 2] = 1.0
    eye = torch.eye(unknowns, dtype=theta.dtype, device=theta.device)
    step, scale = theta.new_full((count,), torch.inf), theta.new_full((count,), torch.inf)  # weights of one
    going = torch.arange(count, device=theta.device)
    for number in range(_MOST_STEPS):
        residual, _, design = _residual(patches, theta[going])
        weight = patches.weight.flatten(1)
        # Contrast and brightness are not known before the first step. Then the scale settles, so that the weights do.
        if robust and 0 < number < 6:
            scale[going] = _scale(residual, weight)
        weighted = (weight * _biweight(residual, scale[going], patches))[..., None] * design
        normal = weighted.mT @ design
        size = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).sqrt()
        normal = normal / (size[:, :, None] * size[:, None, :]) + 1e-9 * eye
        change = -torch.linalg.solve_ex(normal, (weighted * residual[..., None]).sum(1) / size)[0] / size
        length = torch.linalg.vector_norm(change[:, :2], dim=1)
        theta[going] += torch.nan_to_num(change * (1.0 / length.clamp_min(1.0))[:, None])
        step[going] = length
        if number > 6:
            moving = (~(length < _CONVERGED)).nonzero()[:, 0]
            if not len(moving):
                break
            if len(moving) < len(going):
                going, patches = going[moving], patches.at(moving)
    return theta, scale, step


def _covariance(
    patches: _Patches, theta: Tensor, residual: Tensor, slope: Tensor, robust: Tensor
) -> tuple[Tensor, Tensor]:
    """(N, 2, 2) of the shift, and where it exists.

    The normal matrix is the product of the slopes of *both* images, whose noise is independent, so that noise does not
    pass for texture. The noise of neighbors is correlated by the blur, which is applied once more for that.
    """
    count, height, width = patches.template.shape
    template = patches.template
    padded = torch.nn.functional.pad(template[:, None], (1,) * 4, mode="replicate")[:, 0]
    own = (
        torch.stack(
            [0.5 * (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]), 0.5 * (padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1])], -1
        ).flatten(1, 2)
        * theta[:, 2, None, None]
    )
    total = robust.sum(1).clamp_min(1e-12)
    # Free of contrast and brightness.
    flat = torch.stack([template.flatten(1), torch.ones_like(residual)], -1)
    mixed = 0.5 * (own + slope)
    if patches.grid is not None:
        # And of scale and shear, and of slopes of brightness.
        steps = patches.grid.flatten(0, 1)
        flat = torch.cat([flat, mixed[..., :1] * steps, steps.expand(count, -1, -1)], -1)
    size = (robust[..., None] * flat.square()).sum(1, keepdim=True).clamp_min(1e-12).sqrt()
    flat = flat / size
    gram = (robust[..., None] * flat).mT @ flat + 1e-9 * torch.eye(flat.shape[-1], dtype=flat.dtype, device=flat.device)
    share = torch.linalg.solve_ex(gram, (robust[..., None] * flat).mT @ mixed)[0]
    across = mixed - flat @ share
    normal = (robust[..., None] * own).mT @ (slope - flat @ torch.linalg.solve_ex(
        gram, (robust[..., None] * flat).mT @ slope)[0])  # fmt: skip
    normal = 0.5 * (normal + normal.mT)
    determinant = normal[:, 0, 0] * normal[:, 1, 1] - normal[:, 0, 1].square()
    sound = (normal[:, 0, 0] > 0) & (determinant > 1e-6 * normal[:, 0, 0] * normal[:, 1, 1])
    inverse = torch.linalg.inv_ex(torch.where(sound[:, None, None], normal, torch.eye(2).to(normal)))[0]
    columns = torch.cat([flat, across], -1)
    weighted = robust[..., None] * columns
    spread = _blurred(weighted.mT.reshape(count, -1, height, width))
    # What of the noise the fit takes away: of blurred noise, smooth columns take most.
    gram = weighted.mT @ columns + 1e-9 * torch.eye(columns.shape[-1]).to(gram)
    taken = torch.linalg.solve_ex(gram, spread @ spread.mT)[0].diagonal(dim1=-2, dim2=-1).sum(-1)
    share_of_noise = float(_NOISE_BLUR.square().sum()) ** 2
    freedom = (1.0 - taken / (total * share_of_noise)).clamp_min(0.2)
    noise = (robust * residual.square()).sum(1) / total / (share_of_noise * freedom)
    middle = noise[:, None, None] * (spread[:, -2:] @ spread[:, -2:].mT)
    # Residuals of another texture than noise, such as the background's, are correlated farther: then what they add up
    # to counts (W. Newey and K. West 1987).
    pull = (robust * residual)[..., None] * across
    pull = pull.mT.reshape(-1, 1, height, width)
    reach = _TRIANGLE.to(template)
    wider = correlated(pull, reach, reach, zeros=len(reach) // 2).reshape(count, 2, -1)
    found = pull.reshape(count, 2, -1) @ wider.mT / freedom[:, None, None]
    excess = torch.linalg.solve_ex(middle, found)[0].diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1.0)
    return excess[:, None, None] * inverse @ middle @ inverse, sound


def _blurred(columns: Tensor) -> Tensor:
    """(N, C, pixels) of columns (N, C, h, w), blurred as noise is, also beyond the patch."""
    kernel = _NOISE_BLUR.to(columns)
    reach = 2 * (len(kernel) // 2)
    wide = correlated(columns.flatten(0, 1)[:, None], kernel, kernel, zeros=reach)
    return wide.reshape(*columns.shape[:2], -1)


def _implicit(patches: _Patches, theta: Tensor, scale: Tensor, converged: Tensor) -> Tensor:
    """Theta with its gradient by both images: one Newton step from the solution has the exact one."""
    with torch.enable_grad():
        free = theta.detach().requires_grad_()
        fixed = patches._replace(
            template=patches.template.detach(), right=patches.right._replace(values=patches.right.values.detach())
        )
        balance = _balance(fixed, free, scale)
        rows = [torch.autograd.grad(balance[:, i].sum(), free, retain_graph=True)[0] for i in range(theta.shape[1])]
    jacobian = torch.stack(rows, 1)
    jacobian = torch.where(converged[:, None, None], jacobian, torch.eye(theta.shape[1]).to(jacobian))
    inverse = torch.linalg.inv_ex(jacobian)[0]
    change = (inverse @ _balance(patches, theta.detach(), scale)[..., None])[..., 0]
    return theta.detach() - torch.where(converged[:, None], change, 0.0)
