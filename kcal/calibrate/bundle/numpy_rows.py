"""The rows of `BoardProblem` and `CompressedProblem` by NumPy: on the CPU, where nothing is differentiated."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.lens.model import LensModel
from kcal.lens.projection_numpy import fill_rows
from kcal.lens.tracing import plain_on_host

Array = npt.NDArray[np.float64]


def on_host(model: LensModel, *tensors: Tensor) -> bool:
    """Whether the functions of this module may be used."""
    return not model.wide and plain_on_host(*tensors)


def camera_rows(
    points: Array, parameters: Array, model: LensModel, free: FreeParameters, out: Array, extra: int
) -> Array:
    """Write derivatives by the free parameters of a camera into `out`, and return the pixels.

    Args:
        points: (..., 3, N).
        parameters: (..., 5 + P), as `fill_rows` takes them.
        model: the lens model.
        free: the unknowns.
        out: (..., 3 + U + extra, 2, N): first by the point, then by each of the U unknowns.
        extra: rows behind these that are left alone.

    Returns:
        (2, ..., N) pixels; NaN where there is no image.
    """
    tied = len(free) != len(free.indices)
    shape = (*out.shape[:-3], len(free.indices), *out.shape[-2:])
    last = out.shape[-3] - extra
    by_camera = np.empty(shape) if tied else out[..., 3:last, :, :]
    wanted = {i: k for k, i in enumerate(free.indices)}
    with np.errstate(all="ignore"):
        u, v, regular = fill_rows(points, parameters, model, wanted, out[..., :3, :, :], by_camera)
    if tied:
        target = out[..., 3:last, :, :]
        target[...] = 0.0
        for k, slot in enumerate(free.slots):
            target[..., slot, :, :] += by_camera[..., k, :, :]
    pixels = np.stack([u, v])
    if not regular.all():
        pixels[:, ~regular] = np.nan
    return pixels


def board_rows(
    rotated: Tensor,
    points: Tensor,
    parameters: Tensor,
    model: LensModel,
    free: FreeParameters,
    target: Tensor,
    bend: Tensor | None,
) -> Tensor:
    """`BoardProblem.rows` before anything is masked or weighted.

    Args:
        rotated: (..., V, 3, N) board points, rotated only.
        points: (..., V, 3, N) in the camera's frame.
        parameters: (..., 5 + P).
        model: the lens model.
        free: the unknowns.
        target: (..., V, 2, N) observed corners.
        bend: (..., V, 2, 3, N) derivatives of each point by the warp, or None.

    Returns:
        (..., V, 6 + S + 1, 2, N).
    """
    moved = points.numpy()
    warps = 0 if bend is None else 2
    out = np.empty((*moved.shape[:-2], 6 + len(free) + warps + 1, 2, moved.shape[-1]))
    values = parameters.numpy() if parameters.ndim == 1 else parameters[..., None, :].numpy()
    pixels = camera_rows(moved, values, model, free, out[..., 3:, :, :], warps + 1)
    by_point = out[..., 3:6, :, :]
    _turn_rows(by_point, rotated.numpy(), out[..., :3, :, :])
    if bend is not None:
        moves = bend.numpy()
        for w in range(2):
            out[..., -3 + w, :, :] = (by_point * moves[..., w, :, None, :]).sum(-3)
    seen = target.numpy()
    for k in range(2):
        np.subtract(pixels[k], seen[..., k, :], out=out[..., -1, k, :])
    return torch.from_numpy(out)


def node_rows(points: Tensor, parameters: Tensor, model: LensModel, free: FreeParameters, pixels: Tensor) -> Tensor:
    """The rows of `CompressedProblem`: derivatives by the unknowns and by a rotation of the points, and the shifts.

    Args:
        points: (..., 3, K).
        parameters: (..., 5 + P).
        model: the lens model.
        free: the unknowns.
        pixels: (..., 2, K) images before the shifts.
    """
    moved, before = points.numpy(), pixels.numpy()
    out = np.empty((*moved.shape[:-2], 3 + len(free) + 4, 2, moved.shape[-1]))
    values = parameters.numpy() if parameters.ndim == 1 else parameters[..., None, :].numpy()
    # `fill_rows` expects a dimension of views.
    if parameters.ndim > 1:
        found = camera_rows(moved[..., None, :, :], values, model, free, out[..., None, :, :, :], 4)[..., 0, :]
    else:
        found = camera_rows(moved, values, model, free, out, 4)
    _turn_rows(out[..., :3, :, :], moved, out[..., -4:-1, :, :])
    for k in range(2):
        np.subtract(found[k], before[..., k, :], out=out[..., -1, k, :])
    return torch.from_numpy(out)[..., 3:, :, :]


def _turn_rows(by_point: Array, rotated: Array, out: Array) -> None:
    """The first half of `kcal.lens.pose.step_rows`, written in place: derivatives by ω, as point × derivative."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        row = out[..., i, :, :]
        np.multiply(by_point[..., k, :, :], rotated[..., j, None, :], out=row)
        row -= by_point[..., j, :, :] * rotated[..., k, None, :]
