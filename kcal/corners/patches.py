"""Patches around points and objects: windows, correlation, planes that look at objects, and shifts by least squares."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.checks import require_finite
from kcal.dispatch import is_differentiated
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.rig import Rig

# Check single gray images and filter them with separable Gaussian kernels.
#
# `kornia.filters.filter2d_separable` gives the same numbers. It takes three times as long for a patch of 40 pixels, as
# long for whole images, and 0.3 s to load, also for commands that filter nothing.


def gaussian_kernel(sigma: float, reach: int) -> Tensor:
    """Weights at -reach to reach that sum to 1, (2 reach + 1,) float64."""
    offset = torch.arange(-reach, reach + 1, dtype=torch.float64)
    weights = torch.exp(-0.5 * (offset / sigma) ** 2)
    return weights / weights.sum()


def filtered(images: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Correlate rows of (..., H, W) with one kernel and columns with another of equal odd length; edges repeat."""
    reach, (height, width) = len(across) // 2, images.shape[-2:]
    padded = torch.nn.functional.pad(images.reshape(-1, 1, height, width), (reach,) * 4, mode="replicate")
    return correlated(padded, across, down).reshape(images.shape)


def correlated(images: Tensor, across: Tensor, down: Tensor, *, zeros: int = 0) -> Tensor:
    """Correlate rows of (N, 1, H, W) with one kernel, columns with another, with so many zeros beyond each edge."""
    rows = torch.nn.functional.conv2d(images, across.reshape(1, 1, 1, -1), padding=(0, zeros))
    result: Tensor = torch.nn.functional.conv2d(rows, down.reshape(1, 1, -1, 1), padding=(zeros, 0))
    return result


def as_gray(name: str, image: Tensor) -> Tensor:
    """Gray levels (H, W) as float64.

    Raises:
        InputError: not a tensor of this shape, or a gray level that is not finite.
    """
    if not isinstance(image, Tensor) or image.ndim != 2:
        found = tuple(image.shape) if isinstance(image, Tensor) else type(image).__name__
        raise InputError(f"{name}: a tensor of gray levels (H, W) is needed, got {found}")
    require_finite(name, image)
    return image.to(torch.float64)


# Blurred windows of images around points or objects, and bilinear samples of them: what patches are compared in.

IMAGE_BLUR = 0.8  # steps, of both images: bilinear samples of it are good to 0.005 px


def grid_of(half: tuple[int, int], device: torch.device) -> Tensor:
    """(2 half_y + 1, 2 half_x + 1, 2) whole steps x, y around zero."""
    x, y = (torch.arange(-side, side + 1, dtype=torch.float64, device=device) for side in half)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


class ImageWindows(NamedTuple):
    """Blurred parts of one image, one for each object.

    Attributes:
        values: (N, h, w) blurred gray levels.
        saturated: (N, h, w) share of saturated pixels there.
        corner: (N, 2) pixel of the first value of each.
        size: (width, height) of the whole image.
        level: of blur.
    """

    values: Tensor
    saturated: Tensor
    corner: Tensor
    size: tuple[int, int]
    level: int

    def at(self, which: Tensor) -> Self:
        """Those of the objects at some places."""
        return self._replace(values=self.values[which], saturated=self.saturated[which], corner=self.corner[which])


def image_windows(image: Tensor, pixels: Tensor, level: int, brightest: float) -> ImageWindows:
    """Windows that cover pixels (N, ..., 2) of an image (H, W) with room for blur and slopes; edges repeat."""
    kernel = gaussian_kernel(IMAGE_BLUR * 2**level, 3 * 2**level).to(image.device)
    raw, low = _raw_windows(image, pixels, len(kernel) // 2, level)
    # Without a brightest level nothing is saturated.
    parts = [raw] if math.isinf(brightest) else [raw, (raw.detach() >= brightest).double()]
    blurred = correlated(torch.cat(parts)[:, None], kernel, kernel)[:, 0]
    values, saturated = blurred.chunk(2) if len(parts) == 2 else (blurred, torch.zeros_like(blurred))
    return ImageWindows(values, saturated, low, (image.shape[1], image.shape[0]), level)


def warped_blur_windows(image: Tensor, pixels: Tensor, warp: Tensor) -> ImageWindows:
    """As `image_windows` at level 0 without saturation, but blurred as the other image is, seen from this one.

    Args:
        image: (H, W) gray levels.
        pixels: (N, ..., 2) px.
        warp: (N, 2, 2) pixels of this image by those of the other one.
    """
    covariance = IMAGE_BLUR**2 * warp @ warp.mT
    reach = math.ceil(3.0 * float(torch.linalg.matrix_norm(covariance, 2).amax().sqrt()))
    raw, low = _raw_windows(image, pixels, reach, 0)
    offset = grid_of((reach, reach), image.device)
    kernel = torch.exp(-0.5 * torch.einsum("hwi,nij,hwj->nhw", offset, torch.linalg.inv(covariance), offset))
    kernel = kernel / kernel.sum((1, 2), keepdim=True)
    values = torch.nn.functional.conv2d(raw[None], kernel[:, None], groups=len(raw))[0]
    return ImageWindows(values, torch.zeros_like(values), low, (image.shape[1], image.shape[0]), 0)


def _raw_windows(image: Tensor, pixels: Tensor, reach: int, level: int) -> tuple[Tensor, Tensor]:
    """Gray levels (N, h, w) of windows with a margin of `reach`, and the first pixel (N, 2) inside of it."""
    height, width = image.shape
    flat = pixels.detach().flatten(1, -2)
    # One more for the slopes' steps, and one for bilinear samples.
    low = (flat.amin(1) - reach - 2**level - 1).floor().long()
    counts = ((flat.amax(1) - low).amax(0).ceil().long() + reach + 2**level + 2).tolist()
    columns, rows = (
        (low[:, i : i + 1] + torch.arange(min(count, 3 * max(width, height)), device=image.device)).clamp(0, side - 1)
        for i, (count, side) in enumerate(zip(counts, (width, height), strict=True))
    )
    return image[rows[:, :, None], columns[:, None, :]].to(torch.float64), low + float(reach)


def sample(windows: ImageWindows, pixels: Tensor, *, saturated: bool = False) -> Tensor:
    """Bilinear samples (N, ...) at pixels (N, ..., 2) of the full image."""
    values = windows.saturated if saturated else windows.values
    last = pixels.new_tensor([values.shape[2] - 1, values.shape[1] - 1])
    lead = (len(pixels), *[1] * (pixels.ndim - 2), 2)
    scale = 2.0 / last
    place = torch.addcmul(-scale * windows.corner.reshape(lead) - 1.0, pixels, scale)
    found = torch.nn.functional.grid_sample(
        values[:, None], place.reshape(len(pixels), 1, -1, 2), padding_mode="border", align_corners=True
    )
    return found.reshape(pixels.shape[:-1])


def slopes_of(values: Tensor) -> Tensor:
    """(N, h, w, ..., 2) half the change of values (N, h + 2, w + 2, ...) from neighbor to neighbor, across and down."""
    across, down = values[:, 1:-1, 2:] - values[:, 1:-1, :-2], values[:, 2:, 1:-1] - values[:, :-2, 1:-1]
    return 0.5 * torch.stack([across, down], -1)


def has_samples(windows: ImageWindows, pixels: Tensor) -> Tensor:
    """(N, ...) where a sample and its slope are of the image and in the window, not of a repeated edge."""
    margin = 2.0**windows.level
    last = pixels.new_tensor(windows.size) - 1.0
    corner = windows.corner.reshape(len(windows.corner), *[1] * (pixels.ndim - 2), 2)
    end = corner + pixels.new_tensor([windows.values.shape[2] - 1, windows.values.shape[1] - 1])
    low, high = corner.clamp_min(0.0) + margin, torch.minimum(end, last) - margin
    return ((pixels >= low) & (pixels <= high)).all(-1)


# Normalized correlation of patches with places of another image, and its peaks.

RIVAL_DISTANCE = 3.0  # pixels or steps from which two places count as different matches


@torch.no_grad()
def is_textured(template: Tensor, weight: Tensor) -> Tensor:
    """(N,) whether templates (N, h, w) are not flat where they count."""
    full = weight.sum((1, 2)).clamp_min(1e-12)
    level = (weight * template).sum((1, 2)) / full
    contrast = (weight * (template - level[:, None, None]).square()).sum((1, 2)) / full
    return contrast.sqrt() > 1e-6 * (1.0 + level.abs())


def weighted_correlation(template: Tensor, weight: Tensor, wide: Tensor, usable: Tensor) -> Tensor:
    """Normalized correlation (N, rows, columns) of templates (N, h, w) with wider patches, at every whole shift.

    Shifts that touch what is not usable have -1, and so have flat templates. Patches (N, h, w), which have one place
    each, may share one template (1, h, w).
    """
    count = len(template)
    total = weight.sum((1, 2)).clamp_min(1e-12)
    mean = (weight * template).sum((1, 2)) / total
    centered = weight * (template - mean[:, None, None])
    # Centered, so that squares do not cancel.
    other = wide - (wide.mean((1, 2)))[:, None, None]

    def over(values: Tensor, kernel: Tensor) -> Tensor:
        if values.shape[1:] == kernel.shape[1:]:
            return (values * kernel).sum((1, 2), keepdim=True)
        found: Tensor = torch.nn.functional.conv2d(values[None], kernel[:, None], groups=count)[0]
        return found

    product = over(other, centered)
    average = over(other, weight) / total[:, None, None]
    power = (over(other.square(), weight) / total[:, None, None] - average.square()).clamp_min(0.0)
    own = ((weight * (template - mean[:, None, None]).square()).sum((1, 2)) / total).clamp_min(0.0)
    norm = total[:, None, None] * (power * own[:, None, None]).sqrt()
    blocked = over((~usable).double(), (weight > 0).double()) > 0.5
    good = ~blocked & (norm > 1e-9 * total[:, None, None] * (1.0 + template.abs().amax((1, 2))[:, None, None]))
    return torch.where(good, product / torch.where(good, norm, 1.0), -1.0)


class Peak(NamedTuple):
    """The best of the places of each of N patches.

    Attributes:
        number: (N,) its number, row by row.
        place: (N, 2).
        score: (N,) correlation there.
        rival: (N,) that of the best other peak farther than `RIVAL_DISTANCE`; -1 without one.
        edge: (N,) whether it is in the first or last column.
    """

    number: Tensor
    place: Tensor
    score: Tensor
    rival: Tensor
    edge: Tensor


def highest_peak(scores: Tensor, places: Tensor) -> Peak:
    """The highest of correlations (N, rows, columns) at places (rows, columns, 2), and its rival.

    Example:
        >>> row = torch.tensor([[[0.1, 0.9, 0.2, 0.1, 0.3, 0.8, 0.2]]])
        >>> places = torch.stack([torch.arange(7.0), torch.zeros(7)], -1)[None]
        >>> peak = highest_peak(row, places)
        >>> peak.place.tolist(), round(float(peak.rival), 1)
        ([[1.0, 0.0]], 0.8)
    """
    columns = scores.shape[2]
    score, index = scores.flatten(1).max(1)
    place, column = places.flatten(0, 1)[index], index % columns
    inner = torch.nn.functional.max_pool2d(scores[:, None], 3, stride=1, padding=1)[:, 0]
    away = torch.linalg.vector_norm(places - place[:, None, None], dim=-1) > RIVAL_DISTANCE
    x = torch.arange(columns, device=scores.device)
    peaks = (scores >= inner) & away & (x > 0) & (x < columns - 1)
    rival = torch.where(peaks, scores, -1.0).flatten(1).amax(1)
    return Peak(index, place, score, rival, (column == 0) | (column == columns - 1))


# Shift, contrast and brightness of patches by robust least squares, with covariance and implicit gradients.

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
        """The fits of the objects at these indices."""
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
    mean = filtered(residual.square().reshape(patches.template.shape), kernel, kernel).reshape(residual.shape)
    return (1.0 - mean / (_BIWEIGHT * scale[:, None]).square()).clamp_min(0.0).square()


def _scale(residual: Tensor, weight: Tensor) -> Tensor:
    """(N,) robust standard deviation: from the weighted median of absolute residuals."""
    ordered, order = residual.abs().sort(dim=1)
    cumulated = weight.gather(1, order).cumsum(1)
    at = (cumulated < 0.5 * cumulated[:, -1:]).sum(1).clamp_max(residual.shape[1] - 1)
    return (_MEDIAN * ordered.gather(1, at[:, None])[:, 0]).clamp_min(1e-9)


def _balance(patches: _Patches, theta: Tensor, scale: Tensor) -> Tensor:
    """(N, 4 or 8) the estimating equations, which are zero at the solution."""
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
        shift = _implicit(patches, still, theta, scale, converged)[:, :2]
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
    own = slopes_of(padded).flatten(1, 2) * theta[:, 2, None, None]
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
    # What of the noise the fit takes away. Of smooth noise, only smooth columns take as much as an unknown does; but
    # weights that follow the noise of a small object take more, and by a count of the unknowns its intervals hold.
    taken: Tensor | float = columns.shape[-1]
    if patches.grid is not None:
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


def _implicit(patches: _Patches, still: _Patches, theta: Tensor, scale: Tensor, converged: Tensor) -> Tensor:
    """Theta with its gradient by both images: one Newton step from the solution has the exact one.

    `still`: the same patches without a gradient.
    """
    with torch.enable_grad():
        free = theta.detach().requires_grad_()
        balance = _balance(still, free, scale)
        rows = [torch.autograd.grad(balance[:, i].sum(), free, retain_graph=True)[0] for i in range(theta.shape[1])]
    jacobian = torch.stack(rows, 1)
    jacobian = torch.where(converged[:, None, None], jacobian, torch.eye(theta.shape[1]).to(jacobian))
    inverse = torch.linalg.inv_ex(jacobian)[0]
    change = (inverse @ _balance(patches, theta.detach(), scale)[..., None])[..., 0]
    return theta.detach() - torch.where(converged[:, None], change, 0.0)


# Patches of both images on one plane: a virtual camera that looks at each object, with its columns along the baseline.
#
# On this plane the same object at any distance appears at the same row in both images, whatever lenses the cameras have
# and however they are turned; only its column differs. One step of the plane is about one pixel of the left image, or
# 2^level pixels for large objects, whose images are blurred by as much before.

# Slope of the left image is measured over this many radians on each side.
_SMALL = 1e-4


class ObjectPlanes(NamedTuple):
    """The virtual cameras of N objects.

    Attributes:
        axes: (N, 3, 3) rows x (along the baseline), y, z of each plane in the left camera's frame.
        left: (N, 2) where the left anchor's ray meets the plane z = 1.
        right: (N, 2) where the right anchor's ray does.
        step: (N,) size of one step on that plane.
        valid: (N,) whether both rays exist and cross the baseline.
    """

    axes: Tensor
    left: Tensor
    right: Tensor
    step: Tensor
    valid: Tensor


def object_planes(rig: Rig, left: Tensor, right: Tensor, level: Tensor) -> ObjectPlanes:
    """Planes for anchors (N, 2) in both images, with steps of about 2^level (N,) pixels of the left image."""
    rotation = rig.right_from_left_rotation
    along = -(rotation.T @ rig.right_from_left_translation)
    along = along / torch.linalg.vector_norm(along)
    rays, seen_left = rig.left.unproject(left)
    others, seen_right = rig.right.unproject(right)
    others = others @ rotation
    across = rays - (rays @ along)[:, None] * along
    length = torch.linalg.vector_norm(across, dim=-1)
    # Along the baseline there is no parallax.
    sound = length > 0.05
    ahead = across / torch.where(sound, length, 1.0)[:, None]
    x = along.expand_as(ahead)
    axes = torch.stack([x, torch.linalg.cross(ahead, x), ahead], 1)
    depth = (others * ahead).sum(-1)
    valid = seen_left & seen_right & sound & (depth > 0.05)
    plane = torch.stack([(rays @ along) / torch.where(sound, length, 1.0), torch.zeros_like(length)], -1)
    safe = torch.where(valid, depth, 1.0)[:, None]
    other = torch.stack([others @ along, (others * axes[:, 1]).sum(-1)], -1) / safe
    made = ObjectPlanes(axes, plane, other, torch.ones_like(length), valid)
    sides = torch.tensor([[-_SMALL, 0.0], [_SMALL, 0.0]], dtype=torch.float64, device=left.device)
    pixels, _ = plane_pixels(rig.left, made, plane[:, None] + sides)
    slope = torch.linalg.vector_norm(pixels[:, 1] - pixels[:, 0], dim=-1) / (2.0 * _SMALL)
    return made._replace(step=2.0**level / slope.clamp_min(1e-9))


def plane_pixels(
    camera: Camera, planes: ObjectPlanes, places: Tensor, rotation: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Pixels (N, ..., 2) of places (N, ..., 2) on the planes, and valid; `rotation`: of the right camera."""
    rays = torch.cat([places, torch.ones_like(places[..., :1])], -1).reshape(len(places), -1, 3) @ planes.axes
    if rotation is not None:
        rays = rays @ rotation.T
    pixels, valid = camera.project_rays(rays.flatten(0, 1))
    return pixels.reshape(places.shape), valid.reshape(places.shape[:-1])


def plane_places(camera: Camera, planes: ObjectPlanes, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Places (N, 2) on the planes that the left camera's pixels (N, 2) show, and valid."""
    rays, seen = camera.unproject(pixels)
    x, y, z = (planes.axes @ rays[..., None])[..., 0].unbind(-1)
    valid = seen & (z > 0.05)
    return torch.stack([x, y], -1) / torch.where(valid, z, 1.0)[:, None], valid
