"""How uncertain a camera's image is, and how that carries over to another lens model that stands for it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.gaussian import triangular, whitened
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.pose import step_rows
from kcal.lens.projection import FAR, project_components
from kcal.texts import measured_text

# How uncertain a camera's image is, from what its calibration knows.


def pixel_covariance(
    camera: Camera,
    places: Tensor,
    covariance: Tensor | None = None,
    *,
    at: float = math.inf,
    grid: tuple[int, int] = (25, 17),
) -> Tensor:
    """Covariance of where the camera sees points, after the best-fit rotation of the camera.

    No board determines how the camera's frame is turned in its housing, and a rig solves its cameras' attitudes anew.
    So the change of the image that a turn undoes does not count: the turn for which the squared change at infinity is
    smallest, summed over a grid of the image (mrcal calls it the implied rotation at infinity).

    Args:
        camera: a single camera.
        places: (..., N, 2) pixels, or (..., N, 3) rays in the camera's frame.
        covariance: (5 + P, 5 + P) of its parameters; None: that of its calibration.
        at: distance of the points, meters; lenses whose entrance pupil moves differ near and far.
        grid: columns and rows.

    Returns:
        (..., N, 2, 2) px²; NaN where the camera has no ray.

    Raises:
        InputError: a batch of cameras, a camera without a covariance, or a distance that is not positive.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> shifts = torch.diag(torch.tensor([0.0, 0, 1, 1, 0], dtype=torch.float64))  # 1 px of the principal point
        >>> found = pixel_covariance(camera, torch.tensor([[319.5, 239.5], [0.0, 0.0]]), shifts)
        >>> [round(float(value), 2) for value in found[:, 0, 0].sqrt()]  # nearly a turn
        [0.06, 0.15]
    """
    params = camera.params.detach()
    if params.ndim != 1:
        raise InputError("pixel_covariance: a single camera is needed, not a batch")
    known = None if camera.calibration is None else camera.calibration.known(params)
    if covariance is not None:
        known = CameraInformation.from_covariance(params, covariance)
    if known is None:
        raise InputError("pixel_covariance: the camera has no covariance: calibrate it with kcal, or give one")
    if not at > 0:
        raise InputError(f"pixel_covariance: a positive distance is needed, got {at}")
    rays = isinstance(places, Tensor) and places.ndim > 0 and places.shape[-1] == 3
    places = as_points("rays" if rays else "pixels", places, 3 if rays else 2)
    flat = places.reshape(-1, places.shape[-1])
    wanted = [index for index, slot in enumerate(known.slots) if slot >= 0]
    half = known.by_parameter(known.half())[:, wanted]
    undo = turns_like(camera, camera.grid(*grid).reshape(-1, 2), wanted)
    by_camera, by_motion, good = pixel_slopes(camera, flat, at, wanted)
    by_camera = by_camera - by_motion[..., :3] @ undo
    spread = by_camera @ half.T
    found = spread @ spread.transpose(-1, -2)
    return torch.where(good[:, None, None], found, torch.nan).reshape(*places.shape[:-1], 2, 2)


def turns_like(camera: Camera, pixels: Tensor, wanted: list[int]) -> Tensor:
    """(3, C) the turn, radians, that does to the image at pixels (N, 2) most nearly what a unit of each parameter does.

    Of points at infinity; `wanted` are the numbers of the C parameters.
    """
    by_camera, by_motion, good = pixel_slopes(camera, pixels, math.inf, wanted)
    return torch.linalg.lstsq(by_motion[good][..., :3].flatten(0, 1), by_camera[good].flatten(0, 1)).solution


@torch.no_grad()
def pixel_errors(camera: Camera, truth: Camera, places: Tensor, *, at: float = math.inf) -> Tensor:
    """Where a camera sees points minus where the true camera sees them: the errors that `pixel_covariance` predicts.

    The turn that no board determines is taken out in the same way.

    Args:
        camera: a single camera.
        truth: a single camera of the same image size.
        places: (N, 2) pixels of the camera.
        at: distance of the points, meters.

    Returns:
        (N, 2) px; NaN where one of the two has no image.

    Example:
        >>> truth = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> camera = Camera.build(focal=(800, 800), center=(320.5, 239.5), size=(640, 480), model="pinhole")
        >>> error = pixel_errors(camera, truth, torch.tensor([[319.5, 239.5], [0.0, 0.0]]))
        >>> [round(float(value), 2) for value in error[:, 0]]  # nearly a turn
        [0.06, -0.09]
    """

    def seen_apart(pixels: Tensor, at: float) -> Tensor:
        rays, valid = camera.unproject(pixels)
        seen, visible = truth.project(FAR * rays if math.isinf(at) else camera.ray_origins(rays) + at * rays)
        return torch.where((valid & visible)[:, None], pixels - seen, torch.nan)

    everywhere = camera.grid(25, 17).reshape(-1, 2)
    away, (_, by_motion, good) = seen_apart(everywhere, math.inf), pixel_slopes(camera, everywhere, math.inf, [])
    good = good & away.isfinite().all(-1)
    turn = torch.linalg.lstsq(by_motion[good][..., :3].flatten(0, 1), away[good].reshape(-1, 1)).solution
    _, by_motion, good = pixel_slopes(camera, places, at, [])
    error = seen_apart(places, at) - (by_motion[..., :3] @ turn)[..., 0]
    return torch.where(good[:, None], error, torch.nan)


def projection_sigma(camera: Camera, places: Tensor, *, at: float = math.inf) -> Tensor:
    """Standard deviation in pixels of where the camera sees points, in the direction in which it is largest.

    After the best-fit rotation of the camera (`pixel_covariance`); it grows where no board was.

    Args:
        camera: a single camera, with its calibration.
        places: (..., N, 2) pixels, or (..., N, 3) rays in the camera's frame.
        at: distance of the points, meters.

    Returns:
        (..., N); NaN where the camera has no ray.

    Raises:
        InputError: see `pixel_covariance`.

    Example:
        >>> from kcal.lens import CameraCalibration
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> longer = torch.diag(torch.tensor([1.0, 0, 0, 0, 0], dtype=torch.float64))  # fx ± 1 px
        >>> camera.calibration = CameraCalibration(covariance=longer)
        >>> [round(float(value), 2) for value in projection_sigma(camera, torch.tensor([[0.0, 239.5], [319.5, 239.5]]))]
        [0.4, 0.0]
    """
    return largest_sigma(pixel_covariance(camera, places, at=at))


def largest_sigma(covariance: Tensor) -> Tensor:
    """(...) standard deviation in the direction in which it is largest, of covariances (..., 2, 2); NaN of NaN."""
    a, b, _, d = covariance.flatten(-2).unbind(-1)
    return (0.5 * (a + d) + torch.hypot(0.5 * (a - d), b)).sqrt()


def image_sigma(camera: Camera, columns: int = 33, rows: int = 25) -> Tensor:
    """(rows, columns) `projection_sigma` at infinity on a grid whose outermost points are the outermost pixels.

    Example:
        >>> from kcal.lens import CameraCalibration
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> longer = torch.diag(torch.tensor([1.0, 0, 0, 0, 0], dtype=torch.float64))  # fx ± 1 px
        >>> camera.calibration = CameraCalibration(covariance=longer)
        >>> [round(float(value), 2) for value in image_sigma(camera, 3, 3)[1]]
        [0.4, 0.0, 0.4]
    """
    return projection_sigma(camera, camera.grid(columns, rows))


def pixel_slopes(camera: Camera, places: Tensor, at: float, wanted: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of the pixels of pixels or rays by parameters (N, 2, C) and a step (N, 2, 6), and which have them.

    A step is that of `kcal.lens.pose`: a turn, then a shift. `wanted` are the numbers of the C parameters.
    """
    if places.shape[-1] == 3:
        length = torch.linalg.vector_norm(places, dim=-1)
        rays, valid = places / length[:, None], length > 0
    else:
        rays, valid = camera.unproject(places)
    rays = torch.where(valid[:, None], rays, rays.new_tensor([0.0, 0.0, 1.0]))
    points = FAR * rays if math.isinf(at) else camera.ray_origins(rays) + at * rays
    seen = project_components(points.T, camera.params.detach(), camera.model, wanted)
    return seen.by_camera.permute(2, 1, 0), step_rows(seen.by_point, points.T).permute(2, 1, 0), valid & seen.regular


@torch.no_grad()
def lens_changes(camera: Camera, size: float) -> Tensor:
    """(5 + P, 2) changes of a camera's parameters that scale its image and bend it as r³, as closely as its model can.

    Each by so many pixels at the image's corner.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> lens_changes(camera, 0.1)[:2, 0]  # 0.1 of 400 px
        tensor([0.2000, 0.2000], dtype=torch.float64)
    """
    places = camera.grid(25, 17).reshape(-1, 2)
    by_camera, _, good = pixel_slopes(camera, places, math.inf, [*range(camera.params.shape[-1])])
    away = (places + 0.5 - 0.5 * places.new_tensor(camera.size)) / (0.5 * math.hypot(*camera.size))
    fields = size * torch.stack([away, away * away.square().sum(-1, keepdim=True)], -1)
    return torch.linalg.lstsq(by_camera[good].flatten(0, 1), fields[good].flatten(0, 1), driver="gelsd").solution


# Carry what is known of a camera over to another lens model that stands for it, misfit included.

# Pixels by which parameters that a calibration held may move the image: other programs have no exact parameters.
_HELD_PX = 1e-4
# Pixels in proportion to which limits of parameters count where a lens is fitted to another, as in `refit_camera`.
FIT_PX = 0.01
# Pixels a unit that no parameter is as weak as.
_ROUNDING = 1e-12


def carried_covariance(
    camera: Camera, substitute: Camera, *, misfit: float = 0.0, width: Tensor | None = None
) -> Tensor | None:
    """Covariance (5 + Q, 5 + Q) of the parameters of a camera that stands for another one; None if nothing is known.

    Parameters of the same name keep their covariance where the substitute has all that were estimated. Otherwise each
    change of the camera is fitted by the substitute over the image at infinity, as the substitute itself was. Where in
    the image a lens that is not quite the camera's will be used is unknown, and with it which lens of the model is
    best there. So a change is added whose RMS over the image is the misfit, spread as the substitute's own parameters
    move the image (a g-prior; Zellner, 1986). What the substitute cannot follow of the camera's changes counts as
    misfit.

    Args:
        camera: a single camera with its calibration.
        substitute: a single camera of a parametric model, in the same frame.
        misfit: root mean square of the distance between both over the image, pixels.
        width: (5 + Q,) what limits the substitute's parameters otherwise; infinite, or None for all: nothing.

    Example:
        >>> from kcal.lens import CameraCalibration
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> camera.calibration = CameraCalibration(covariance=torch.diag(torch.tensor([4.0, 4, 1, 1, 0]).double()))
        >>> richer = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="opencv4")
        >>> [round(float(value), 6) for value in carried_covariance(camera, richer).diagonal()]
        [4.0, 4.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """
    known = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
    if known is None:
        return None
    half = known.by_parameter(known.half())
    free = [index for index, slot in enumerate(known.slots) if slot >= 0]
    names, wanted = camera.names, substitute.names
    same = camera.model.fisheye == substitute.model.fisheye and all(names[index] in wanted for index in free)
    if same and not misfit:
        moved = half.new_zeros(len(half), len(wanted))
        moved[:, [wanted.index(names[index]) for index in free]] = half[:, free]
        return moved.T @ moved
    rays, valid = camera.unproject(camera.grid(33, 25).reshape(-1, 2))
    own, _, seen = pixel_slopes(camera, rays, torch.inf, free)
    adjustable = [index for index, name in enumerate(wanted) if name != "skew"]
    theirs, _, shown = pixel_slopes(substitute, rays, torch.inf, adjustable)
    good = valid & seen & shown
    count, theirs, own = int(good.sum()), theirs[good].flatten(0, 1), own[good].flatten(0, 1)
    limits = torch.zeros(len(adjustable)).double() if width is None else 1.0 / width.double()[adjustable]
    rows = fitted_errors(half[:, free] @ own.T, theirs, limits, misfit, count)
    out = half.new_zeros(len(wanted), len(wanted))
    out[torch.tensor(adjustable)[:, None], torch.tensor(adjustable)] = rows.T @ rows
    return out


def fitted_errors(by_image: Tensor, slopes: Tensor, limits: Tensor, misfit: float, count: int) -> Tensor:
    """Errors (K', C) of the parameters of a lens that is fitted to another one, of errors (K, 2N) of that one's image.

    With `misfit` and with what the lens cannot follow as in `carried_covariance`.

    Args:
        by_image: pixels by which the other lens may be wrong, in rows that are independent, each one sigma.
        slopes: (2N, C) pixels by parameters.
        limits: (C,) one over the widths of the parameters' priors.
        misfit: root mean square of the distance between both, pixels.
        count: N.
    """
    fitted, size = inverse_half(slopes, FIT_PX * limits)
    moved = by_image @ slopes @ fitted.T @ fitted
    missed = (by_image - moved @ slopes.T).square().sum() / count
    total = (misfit**2 + float(missed)) ** 0.5
    noise = total * (count / size) ** 0.5
    spread = noise * inverse_half(slopes, noise * limits)[0]
    # Limits keep some of it back.
    reached = float(((spread @ slopes.T).square().sum() / count).sqrt())
    return torch.cat([moved, spread * (total / reached)]) if total > 0 else moved


def inverse_half(rows: Tensor, limits: Tensor) -> tuple[Tensor, int]:
    """H (C, C) with HᵀH the inverse of rowsᵀ rows + diag(limits²) where that is determined, and in how many ways."""
    found = whitened(torch.cat([rows, torch.diag(limits)]), rows.new_zeros(len(rows) + len(limits)))
    return torch.where(found.known, found.change, 0.0).T, int(found.known.sum())


def square_root_information(camera: Camera, order: Sequence[int]) -> tuple[Tensor, tuple[str, ...]] | None:
    """Upper triangle R (N, N) with RᵀR the inverse covariance of parameters of a camera, and the names of those held.

    Parameters that are held get the standard deviation that moves no pixel by more than 1e-4: R is never singular.

    Args:
        camera: a single camera.
        order: numbers of the N parameters in `Camera.names`; nothing is said of the others.

    Returns:
        None if the camera has no covariance.

    Example:
        >>> from kcal.lens import CameraCalibration
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> camera.calibration = CameraCalibration(covariance=torch.diag(torch.tensor([4.0, 4, 1, 1, 0]).double()))
        >>> root, held = square_root_information(camera, [2, 0, 4])
        >>> root.diagonal()[:2].tolist(), held
        ([1.0, 0.5], ('skew',))
    """
    known = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
    if known is None:
        return None
    lens = known.without_board()
    every = list(range(len(camera.names)))
    slopes, _, good = pixel_slopes(camera, camera.grid(17, 13).reshape(-1, 2), torch.inf, every)
    stiff = slopes[good].abs().flatten(0, 1).amax(0).clamp_min(_ROUNDING) / _HELD_PX
    # Each unknown is the mean of the parameters that share it; these are equal.
    share = lens.selection()
    mean = (share / share.sum(0)).T
    held = share.sum(1) == 0
    rows = [
        lens.whole.rows[:, :-1] @ mean,
        torch.diag(stiff)[held],
        stiff[:, None] * (torch.diag(1.0 * ~held) - share @ mean),
    ]
    # Columns of what is not asked for first: below their triangle, rows say nothing of them.
    others = [index for index in every if index not in order]
    triangle = triangular(torch.cat(rows)[:, [*others, *order]])[len(others) :, len(others) :]
    upright = torch.where(triangle.diagonal() < 0, -1.0, 1.0)
    return upright[:, None] * triangle, tuple(name for name, fixed in zip(camera.names, held, strict=True) if fixed)


# The focal length of a camera as people mean it: pixels per radian on the optical axis.
#
# The parameter fx of a hybrid lens is that of its base projection, part of which the field shifts: it is no focal
# length by itself. What every lens has is the derivative of its projection on the axis,
#
#     f_u = ∂u/∂(X/Z),   f_v = ∂v/∂(Y/Z)   at (0, 0, 1),
#
# the paraxial magnification. It is fx, fy for a parametric lens without tilt. It is a smooth function of all
# parameters, so that its sigma follows from their covariance.

# Standard deviations beyond which both focal lengths are told apart, and relative rounding.
_UNEQUAL, _SAME = 3.0, 1e-9


class ParaxialFocal(NamedTuple):
    """Focal lengths along u and v.

    Attributes:
        value: (2,) pixels per radian.
        sigma: (2,) standard deviations; NaN where the camera's calibration does not tell.
        covariance: (2, 2) px²; NaN likewise.

    Example:
        >>> str(ParaxialFocal(torch.tensor([800.0, 800.0]), torch.ones(2), torch.ones(2, 2)))
        '800.0 ± 1.0 px'
    """

    value: Tensor
    sigma: Tensor
    covariance: Tensor

    @property
    def mean(self) -> tuple[float, float]:
        """The mean of both focal lengths, and its standard deviation."""
        return float(self.value.mean()), math.sqrt(max(float(self.covariance.mean()), 0.0))

    @property
    def aspect(self) -> tuple[float, float]:
        """The second focal length over the first, and its standard deviation."""
        ratio = self.value[1] / self.value[0]
        slope = torch.stack([-ratio, torch.ones_like(ratio)]) / self.value[0]
        variance = float(slope @ self.covariance @ slope)
        return float(ratio), math.sqrt(max(variance, 0.0)) if variance == variance else math.nan

    def __str__(self) -> str:
        """In words: one focal length where both are equal as far as is known."""

        def shown(value: float, sigma: float) -> str:
            return measured_text(value, sigma) if sigma == sigma else f"{value:.3f}"

        (aspect, error), (u, v), (s, t) = self.aspect, self.value.tolist(), self.sigma.tolist()
        if abs(aspect - 1.0) > _UNEQUAL * (error if error == error else 0.0) + _SAME:
            return f"{shown(u, s)} px along rows, {shown(v, t)} px along columns"
        return f"{shown(*self.mean)} px"


def paraxial_focal(camera: Camera) -> ParaxialFocal:
    """The focal lengths of a camera: the derivative of its projection on the optical axis.

    Args:
        camera: a single camera of any lens model; error bars are those of its `calibration`.

    Raises:
        InputError: a batch of cameras.

    Example:
        >>> from kcal.lens import CameraCalibration
        >>> camera = Camera.build(focal=(800, 801), center=(320, 240), size=(640, 480), coefficients=[-0.3, 0.1])
        >>> camera.calibration = CameraCalibration(covariance=torch.diag(torch.tensor([4.0, 1] + 8 * [0]).double()))
        >>> [value.tolist() for value in paraxial_focal(camera)[:2]]
        [[800.0, 801.0], [2.0, 1.0]]
    """
    params = camera.params.detach()
    if params.ndim != 1:
        raise InputError("paraxial_focal: a single camera is needed, not a batch")

    def magnification(values: Tensor) -> Tensor:
        axis = values.new_tensor([[0.0], [0.0], [1.0]])
        by_point = project_components(axis, values, camera.model, ()).by_point[..., 0]
        return torch.stack([by_point[0, 0], by_point[1, 1]])

    with torch.enable_grad():
        slopes: Tensor = torch.autograd.functional.jacobian(magnification, params)
    value = magnification(params)
    variance = _variance(camera, slopes)
    if variance is None:
        variance = value.new_full((2, 2), torch.nan)
    return ParaxialFocal(value, variance.diagonal().clamp_min(0.0).sqrt(), variance)


def _variance(camera: Camera, slopes: Tensor) -> Tensor | None:
    """(2, 2) covariance of the focal lengths with these derivatives (2, 5 + P) by the parameters; None if unknown."""
    known = camera.calibration
    if known is None:
        return None
    if known.covariance is not None:
        if known.information is not None:
            # By the root: a covariance of hundreds of parameters loses what cancels in it to rounding.
            spread = slopes @ known.information.by_parameter(known.information.half()).T
            return spread @ spread.T
        return slopes @ known.covariance.to(slopes) @ slopes.T
    felt = slopes.abs().sum(0).nonzero()[:, 0].tolist()
    sigma = [known.sigma.get(camera.names[i]) if known.sigma else None for i in felt]
    # Files with sigmas alone tell of focal lengths that are parameters, not of how parameters vary together.
    if len(felt) > 2 or None in sigma:
        return None
    return (slopes[:, felt] * slopes.new_tensor(sigma)).square().sum(1).diag()
