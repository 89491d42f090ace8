"""Carry what is known of a camera over to another lens model that stands for it, misfit included."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.gaussian import triangular, whitened
from kcal.lens.camera import Camera
from kcal.lens.uncertainty import pixel_slopes

# Pixels by which parameters that a calibration held may move the image: other programs have no exact parameters.
_HELD_PX = 1e-4
# Pixels in proportion to which limits of parameters count where a lens is fitted to another, as in `refit_camera`.
FIT_PX = 0.01
# Pixels a unit that no parameter is as weak as.
_ROUNDING = 1e-12


def carried_covariance(
    camera: Camera,
    substitute: Camera,
    *,
    misfit: float = 0.0,
    width: Tensor | None = None,
    grid: tuple[int, int] = (33, 25),
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
        grid: columns and rows of the image on which changes are compared.

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
        for index in free:
            moved[:, wanted.index(names[index])] = half[:, index]
        return moved.T @ moved
    rays, valid = camera.unproject(camera.grid(*grid).reshape(-1, 2))
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
    slopes, _, good = pixel_slopes(
        camera, camera.grid(17, 13).reshape(-1, 2), torch.inf, list(range(len(camera.names)))
    )
    stiff = slopes[good].abs().flatten(0, 1).amax(0).clamp_min(_ROUNDING) / _HELD_PX
    # Each unknown is the mean of the parameters that share it; these are equal.
    share = lens.selection()
    mean = (share / share.sum(0)).T
    held = share.sum(1) == 0
    rows = [
        lens.all_rows()[:, :-1] @ mean,
        torch.diag(stiff)[held],
        stiff[:, None] * (torch.diag(1.0 * ~held) - share @ mean),
    ]
    # Columns of what is not asked for first: below their triangle, rows say nothing of them.
    others = [index for index in range(len(camera.names)) if index not in order]
    triangle = triangular(torch.cat(rows)[:, [*others, *order]])[len(others) :, len(others) :]
    upright = torch.where(triangle.diagonal() < 0, -1.0, 1.0)
    return upright[:, None] * triangle, tuple(name for name, fixed in zip(camera.names, held, strict=True) if fixed)
